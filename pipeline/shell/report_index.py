"""The index page of all reports in a folder, made from their JSON documents.

Reports may come from other versions, be damaged, or be incomplete. Unreadable reports are listed with the reason. The
page depends only on the reports, so the same reports give the same bytes.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import unescape
from pathlib import Path
from urllib.parse import quote

from pipeline.base.disk import write_text
from pipeline.base.json_object import JsonObject
from pipeline.base.paths import storable
from pipeline.base.wording import unbroken
from pipeline.rendering.labels import UNITS, decimal, percent_text, stiffness_text
from pipeline.rendering.report.page_template import fill_template, policy, script_text

INDEX_FILE = "index.html"
INDEX_MARK = '<meta name="generator" content="pipeline index">'
"""Mark of an index page of this package. The page of another program is never replaced."""

MOST_NAMES = 4
"""Largest number of experiments listed by name. If there are more, only the first and the last one are listed."""

_HEAD = 8192
"""Number of characters at the start of a page that contain its title and marks."""

_REPORT_MARK = 'name="pipeline-cells"'
"""Part of the head of a report of `pipeline compare` (`report_parts.CELLS_META`)."""


def _row(document: JsonObject) -> JsonObject:
    """Return the index row of a document. Fields that are not needed here may be missing from documents of other
    versions."""
    experiments = document["experiments"]
    names = [e["experiment"] for e in experiments]
    origin = document.get("provenance", {})
    return {
        "simulated": document["simulated"],
        "summary": document.get("summary", ()),
        "names": ", ".join(names) if len(names) <= MOST_NAMES else f"{names[0]} … {names[-1]} ({len(names)})",
        "trials": sum(e["trials"] for e in experiments),
        "stiffness": _stiffness(experiments, UNITS[document["motion"]].stiffness),
        "warnings": document.get("warnings", ()),
        "newest": str(origin.get("log files written", "")).split(" to ")[-1],
        "provenance": origin,
    }


def _stiffness(experiments: Sequence[JsonObject], unit: str) -> dict[str, str]:
    """Return the measured and theoretical largest stable stiffness of the first experiment that has one, and their
    deviation."""
    for e in experiments:
        score = e["scores"][0]["stiffness"] if e.get("scores") else None
        if score:
            return {
                "experiment": e["experiment"],
                "measured": f"{'≥ ' if score.get('lower_bound') else ''}{stiffness_text(score['measured'])} {unit}",
                "theory": f"{stiffness_text(score['theory'])} {unit}",
                "deviation": percent_text(score["deviation_percent"]),
            }
    for e in experiments:
        stable = [point["stable"] for point in e.get("boundary", ()) if point["stable"] is not None]
        if stable:
            return {"experiment": e["experiment"], "measured": f"{decimal(max(stable), 0)} {unit}"}
    return {}


@dataclass(frozen=True)
class IndexEntry:
    """Page in the folder: a report with its document, a report that cannot be read (``problem``), or a different
    page."""

    page: str
    title: str
    problem: str = ""
    document: JsonObject | None = None

    @property
    def shown(self) -> str:
        """File name as text."""
        return storable(self.page)

    @property
    def address(self) -> str:
        """Relative address of the page for a link."""
        return "./" + quote(os.fsencode(self.page))


def read_reports(folder: Path) -> tuple[tuple[IndexEntry, ...], tuple[IndexEntry, ...]]:
    """Return the reports of a folder, sorted by title with damaged reports last, and the other pages of the folder.

    A page (``*.html``) is a report if its head has the mark of a report. The JSON document of the comparison must be in
    the same folder. Nothing is written.
    """
    pages = (p for p in folder.glob("*.html") if p.name != INDEX_FILE and not p.name.startswith(".") and p.is_file())
    found = [_entry(page) for page in sorted(pages)]
    reports = [entry for entry in found if entry.document or entry.problem]
    reports.sort(key=lambda entry: (bool(entry.problem), entry.title.casefold(), entry.page))
    return tuple(reports), tuple(entry for entry in found if entry not in reports)


def render_index(entries: Sequence[IndexEntry], others: Sequence[IndexEntry] = ()) -> str:
    """Return the index as an HTML document that needs no network. A script sorts its table."""
    script = script_text("report/tables.js")
    page = fill_template(
        "index.html.j2",
        mark=INDEX_MARK,
        policy=policy((script,)),
        script=script,
        entries=[entry for entry in entries if not entry.problem],
        damaged=[entry for entry in entries if entry.problem],
        others=others,
        trials=sum(entry.document["trials"] for entry in entries if entry.document),
    )
    return unbroken(page)


def write_index(folder: Path, only_renew: bool = False) -> Path | None:
    """Update the index page of a folder. A reader sees either the old or the new page.

    Parameters
    ----------
    folder : Path
        Folder of the reports. It is created if it does not exist.
    only_renew : bool
        If True, no index is created where none exists, because the folder may belong to other users.

    Returns
    -------
    Path or None
        The page, or None if it is unchanged, or if a page of another program has the same name.

    Raises
    ------
    OSError
        If the page cannot be written.
    """
    path = folder / INDEX_FILE
    present = _text(path) if path.exists() else None
    if (present is None and only_renew) or (present is not None and INDEX_MARK not in present):
        return None
    before = present
    # During this call, another process may write a report, and an index without this page. Therefore, check again after
    # each write.
    while (page := render_index(*read_reports(folder))) != present:
        write_text(path, page)
        present = page
    return None if present == before else path


def _text(path: Path) -> str:
    """Return the text of a page. The text is empty if the page cannot be read, for example a page of another user."""
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""


def _entry(page: Path) -> IndexEntry:
    """Return the index entry of a page."""
    text = _text(page)
    found = re.search(r"<title>(.*?)</title>", text[:_HEAD], flags=re.DOTALL)
    title = " ".join(unescape(found[1]).split()) if found else ""
    document = page.with_suffix(".json")
    name = storable(document.name)
    if not text:
        return IndexEntry(page.name, title, "the page is empty or cannot be read")
    if _REPORT_MARK not in text[:_HEAD]:  # a different kind of page, such as the accuracy page
        return IndexEntry(page.name, title or storable(page.name))
    if not text.rstrip().endswith("</html>"):
        return IndexEntry(page.name, title, "the page is incomplete; write the report again")
    if not document.is_file():
        return IndexEntry(page.name, title, f"{name} is missing from its folder; write the report again")
    try:
        found = json.loads(document.read_bytes())
        return IndexEntry(page.name, found["title"], document=_row(found))
    except OSError as error:
        return IndexEntry(page.name, title, f"{name} cannot be read ({error.strerror})")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        why = f"{type(error).__name__}: {error}; write the report again"
        return IndexEntry(page.name, title, f"{name} is not a document of a comparison ({why})")
