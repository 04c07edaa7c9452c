"""The index page over all reports of a folder, made from the JSON document beside each.

Reports may come from other versions, be damaged, or be written at this moment: what cannot be read is listed with the
reason. The page depends on the reports alone, so that the same reports give the same bytes.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import unescape
from itertools import count
from pathlib import Path
from typing import Any
from urllib.parse import quote

from pydantic import BaseModel, ValidationError

from pipeline.base.disk import replacing, write_text
from pipeline.base.paths import open_regular, storable
from pipeline.base.wording import unbroken
from pipeline.records.findings import BoundaryPoint
from pipeline.records.models import Motion
from pipeline.rendering.labels import UNITS, decimal, percent_text, stiffness_text
from pipeline.rendering.report.page_template import fill_template
from pipeline.rendering.report.report_scripts import policy, script_text

INDEX_FILE = "index.html"
INDEX_MARK = '<meta name="generator" content="pipeline index">'
"""Tells our index from a page of somebody else, which is never replaced."""


LARGEST_DOCUMENT = 256 << 20
"""Bytes of JSON that are read at most: a report of 2,300 trials has 1.4 MB, so what is larger is something else."""

MOST_NAMES = 4
"""Experiments that are named one by one: a list of all delays of a sweep says less than its ends."""

_HEAD = 8192
"""Bytes at the start of a page in which its title and marks stand."""

_TAIL = 64
"""Bytes at the end of a page that hold its last tag, with some white space behind."""

_REPORT_MARK = b'name="pipeline-cells"'
"""Part of the head of a report of `pipeline compare` (`report_parts.CELLS_META`)."""

_ATTEMPTS = 5
"""How often the page is made anew because a report came meanwhile; who writes more often renews the index himself."""


class _Largest(BaseModel):
    measured: float
    theory: float
    deviation_percent: float
    lower_bound: bool = False


class _Score(BaseModel):
    stiffness: _Largest | None = None


class _Experiment(BaseModel):
    experiment: str
    trials: int
    boundary: tuple[BoundaryPoint, ...] = ()
    scores: tuple[_Score, ...] = ()


class Document(BaseModel):
    """The entries of a `results.ComparisonResult` that the index needs; documents of other versions may lack others."""

    device: str
    title: str
    motion: Motion
    simulated: bool
    experiments: tuple[_Experiment, ...]
    summary: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    provenance: dict[str, Any] = {}

    @property
    def trials(self) -> int:
        """Number of trials."""
        return sum(e.trials for e in self.experiments)

    @property
    def names(self) -> str:
        """Names of the experiments; first, last and number where there are many."""
        names = [e.experiment for e in self.experiments]
        return ", ".join(names) if len(names) <= MOST_NAMES else f"{names[0]} … {names[-1]} ({len(names)})"

    @property
    def newest(self) -> str:
        """When the newest log was written."""
        return str(self.provenance.get("log files written", "")).split(" to ")[-1]

    @property
    def stiffness(self) -> dict[str, str]:
        """Largest stable stiffness of the first experiment that has one: measured, by theory, deviation."""
        unit = UNITS[self.motion].stiffness
        for e in self.experiments:
            score = e.scores[0].stiffness if e.scores else None
            if score is not None:
                return {
                    "experiment": e.experiment,
                    "measured": f"{'≥ ' if score.lower_bound else ''}{stiffness_text(score.measured)} {unit}",
                    "theory": f"{stiffness_text(score.theory)} {unit}",
                    "deviation": percent_text(score.deviation_percent),
                }
        for e in self.experiments:
            stable = [point.stable for point in e.boundary if point.stable is not None]
            if stable:
                return {"experiment": e.experiment, "measured": f"{decimal(max(stable), 0)} {unit}"}
        return {}


@dataclass(frozen=True)
class IndexEntry:
    """A page: a report with its document, or why nothing can be said of it (``problem``), or another page."""

    page: str
    title: str
    problem: str = ""
    document: Document | None = None

    @property
    def shown(self) -> str:
        """File name as text."""
        return storable(self.page)

    @property
    def address(self) -> str:
        """Relative address of the page, for a link."""
        return "./" + quote(os.fsencode(self.page))


def read_reports(folder: Path) -> tuple[tuple[IndexEntry, ...], tuple[IndexEntry, ...]]:
    """Return the reports of a folder, sorted by title, damaged ones last, and its other pages.

    A page (``*.html``) with the JSON document of a comparison beside it is a report. Nothing is written.
    """
    found = [entry for name in _pages(folder) if (entry := _entry(folder, name)) is not None]
    reports = [entry for entry in found if entry.document or entry.problem]
    reports.sort(key=lambda entry: (bool(entry.problem), entry.title.casefold(), entry.page))
    return tuple(reports), tuple(entry for entry in found if entry not in reports)


def render_index(entries: Sequence[IndexEntry], others: Sequence[IndexEntry] = ()) -> str:
    """Return the index as one HTML document that needs no network; a script sorts its table."""
    script = script_text("report/tables.js")
    page = fill_template(
        "index.html.j2",
        mark=INDEX_MARK,
        policy=policy((script,)),
        script=script,
        entries=[entry for entry in entries if not entry.problem],
        damaged=[entry for entry in entries if entry.problem],
        others=others,
        trials=sum(entry.document.trials for entry in entries if entry.document),
    )
    return unbroken(page)


def write_index(folder: Path, only_renew: bool = False) -> Path | None:
    """Bring the index page of a folder up to date; a reader sees all of it or nothing.

    Parameters
    ----------
    folder : Path
        Folder of the reports; made if needed.
    only_renew : bool
        Whether nothing is done where there is no index: the folder may be anybody's.

    Returns
    -------
    Path or None
        The page; None where it is as it was, or a page of somebody else has its name. A report that an earlier version
        wrote there, of a device of that name, is kept beside it.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    path = folder / INDEX_FILE
    changed = False
    for _ in range(_ATTEMPTS):
        present = _former(path)
        taken = present is not None and INDEX_MARK not in present
        if (only_renew and (taken or present is None)) or (taken and not _keep_report(folder)):
            return None
        state = _state(folder)
        page = render_index(*read_reports(folder))
        if page != present:
            write_text(path, page)
            changed = True
            if taken:
                _document(path).unlink(missing_ok=True)
        # another process may have written a report, and an index without ours
        if _state(folder) == state:
            break
    return path if changed else None


def _former(path: Path) -> str | None:
    """Return the page that stands there; None where there is none. What cannot be read is a page of somebody else."""
    try:
        with open_regular(path) as stream:
            return stream.read().decode("utf-8", "replace")
    except FileNotFoundError:
        return None
    except OSError:
        return ""


def _keep_report(folder: Path) -> bool:
    """Copy the report of a device ``index`` from the index's place to a free name; return whether one is there.

    Earlier versions wrote it there. That of any other device was put there by somebody.
    """
    report = folder / INDEX_FILE
    entry = _entry(folder, INDEX_FILE)
    if entry is None or entry.document is None or f"{entry.document.device.casefold()}.html" != INDEX_FILE:
        return False
    page = report.read_bytes()
    # as `names.report_of` writes it now, which a newer report may have; no other device has such a name
    names = (folder / f"%69ndex{f'-{number}' if number else ''}.html" for number in count())
    kept = next(name for name in names if not name.exists() or name.read_bytes() == page)
    # the page last: with it, all is kept
    for file, data in ((_document(kept), _document(report).read_bytes()), (kept, page)):
        with replacing(file) as stream:
            stream.write(data)
    return True


def _document(page: Path) -> Path:
    return page.with_suffix(".json")


def _state(folder: Path) -> list[tuple[str, int, int]]:
    """Return name, size and time of all pages and documents but the index."""
    if not folder.is_dir():
        return []
    with os.scandir(folder) as entries:
        found = [(e.name, e.stat(follow_symlinks=False)) for e in entries if e.name.endswith((".html", ".json"))]
    return sorted((name, status.st_size, status.st_mtime_ns) for name, status in found if name != INDEX_FILE)


def _pages(folder: Path) -> list[str]:
    if not folder.is_dir():
        return []
    return sorted(n for n in os.listdir(folder) if n.endswith(".html") and n != INDEX_FILE and not n.startswith("."))


def _entry(folder: Path, name: str) -> IndexEntry | None:
    """Return what a page is; None where it vanished meanwhile."""
    try:
        head, tail = _ends(folder / name)
    except FileNotFoundError:
        return None
    except OSError as error:
        return IndexEntry(name, "", f"the page cannot be read ({error.strerror})")
    is_report = _REPORT_MARK in head
    title = _title(head)
    other = IndexEntry(name, title or storable(name))
    document = storable(name.removesuffix(".html") + ".json")
    try:
        with open_regular(folder / (name.removesuffix(".html") + ".json")) as stream:
            text = stream.read(LARGEST_DOCUMENT + 1)
    except FileNotFoundError:
        problem = f"{document} is missing beside it; make the report again"
        return IndexEntry(name, title, problem) if is_report else other
    except OSError as error:
        return IndexEntry(name, title, f"{document} cannot be read ({error.strerror})")
    if len(text) > LARGEST_DOCUMENT:
        return IndexEntry(name, title, f"{document} is larger than {LARGEST_DOCUMENT >> 20} MB")
    try:
        result = Document.model_validate_json(text)
    except ValidationError as error:
        if not is_report and head:  # a page with another document, such as that on accuracy
            return other
        return IndexEntry(name, title, f"{document}: {_why(error)}; make the report again")
    if not is_report or not tail.rstrip().endswith(b"</html>"):
        return IndexEntry(name, result.title, "the page is not complete; make the report again")
    return IndexEntry(name, result.title, document=result)


def _ends(path: Path) -> tuple[bytes, bytes]:
    """Return the beginning and the end of a file."""
    with open_regular(path) as stream:
        head = stream.read(_HEAD)
        size = stream.seek(0, os.SEEK_END)
        stream.seek(max(size - _TAIL, 0))
        return head, stream.read()


def _title(head: bytes) -> str:
    found = re.search(r"<title>(.*?)</title>", head.decode("utf-8", "replace"), flags=re.DOTALL)
    return " ".join(unescape(found[1]).split()) if found else ""


def _why(error: ValidationError) -> str:
    first = error.errors()[0]
    place = ".".join(str(part) for part in first["loc"])
    return f"{place}: {first['msg']}" if place else str(first["msg"])
