"""Verify a report. Every number is recomputed from the logs, and differences are listed."""

from __future__ import annotations

import math
import re
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ValidationError

from pipeline.base.errors import DeviceError, PipelineError, StoreError, UsageError
from pipeline.base.progress import part_of_work
from pipeline.base.provenance import USER_FOLDER_VARIABLE, digest
from pipeline.base.wording import counted
from pipeline.comparison.compare import run, write_report
from pipeline.comparison.plan import ComparisonSelection, ReportOptions, plan_comparison, report_code
from pipeline.device_data.devices import digest_of, known_devices
from pipeline.records.findings import Note, Record
from pipeline.records.models import Scene
from pipeline.records.results import ComparisonResult, Truth
from pipeline.rendering.report.report_parts import (
    Parts,
    digests_of,
    is_free_cell,
    is_free_text,
    page_digest,
    take_apart,
)
from pipeline.shell.fresh_logs import LogProblem, ReportedLogs, read_again
from pipeline.store.objects import is_url, opened
from pipeline.store.storage import Exclusion

ROUNDING = 1e-9
"""Largest relative difference of two values that count as equal.

Other processors and builds of numpy round the last digits of a sum differently.
"""

ELSEWHERE = 1e-5
"""Largest relative difference (absolute for percentages) that a different processor may cause in an unmodified report.

The location of a flat optimum is accurate only to the square root of the machine precision. A difference of nearly
equal numbers is even less accurate.
"""

NOTHING = 1e-9
"""Threshold below which numbers in such a report count as zero. For example, a growth of 2e-13 1/s is a rounding
error."""

MOST_CHARACTERS = 200
"""Largest number of quoted characters of a part."""

MISSING = "(missing)"

_NUMBER = re.compile(r"[\N{MINUS SIGN}-]?\d+(?:\.\d+)?(?:[eE][+\N{MINUS SIGN}-]?\d+)?")


class Difference(Record):
    """A part of the report that differs. ``expected`` was recomputed, and ``found`` is in the report."""

    name: str
    kind: Literal["cell", "sentence", "value", "page"]
    expected: str
    found: str


class Verification(Record):
    """Result of `verify`.

    Parameters
    ----------
    report : str
    equal : bool
        True if all numbers agree with the logs, and all logs agree with the report.
    checked : dict of str to int
        Number of parts that were compared with the logs or with hashes in the page, by kind.
    differences : tuple of Difference
    logs : tuple of LogProblem
    notes : tuple of str
        Parts that could not be checked, with the reasons.
    """

    report: str
    equal: bool
    checked: dict[str, int]
    differences: tuple[Difference, ...]
    logs: tuple[LogProblem, ...]
    notes: tuple[str, ...]


class Request(BaseModel):
    """Metadata in the head of a page: the request of its comparison, and its inputs."""

    processed: str
    scene: Scene
    logs: dict[str, ReportedLogs]
    code: str
    full: bool = False
    document: str = ""
    excluded: tuple[Exclusion, ...] = ()
    truth: dict[str, Truth] = {}
    device_file: str | None = None
    notes: tuple[Note, ...] = ()


LOGS_READ = 0.1
"""Usual share of reading the logs in the time of a verification."""


def verify(
    report: Path,
    processed: Path | str | None = None,
    profiles: Sequence[Path] | None = (),
    bundle: Path | None = None,
) -> Verification:
    """Recompute the numbers of a report, and compare them part by part.

    The logs are read again from their original paths, or from the stored samples if they no longer exist. Stages, costs
    and theory are computed in a temporary folder. Nothing in ``processed`` is changed.

    Parameters
    ----------
    report : Path
        HTML page that `compare` wrote.
    processed : Path or str, optional
        Folder or URL of the stored tables. By default, the folder named in the report is searched for in the current
        folder and in the folder of the report.
    profiles : sequence of Path or None
        Profile files of the lab that read the logs. With None, only the stored samples are used.
    bundle : Path, optional
        Bundle that contains the report. The result then names the bundle.

    Raises
    ------
    UsageError
        If the file is not a report, or the folder is not found.
    StoreError
        If `processed` is damaged.
    """
    page, found, request = read_report(report)
    document, notes = read_document(report)
    devices = device_problems(request)
    device = request.scene.device
    place = stored_place(report, request.processed, processed)
    if request.code != report_code():
        notes.append("the report was written by a different version of the code, which may explain differences")
    with (
        tempfile.TemporaryDirectory(prefix="pipeline-verify-") as temporary,
        opened(place, device) as folder,
    ):
        store = Path(temporary) / "processed"
        lists = {logs.experiment: logs for logs in document.logs} if document else {}
        with part_of_work("reading the logs", 0.0, LOGS_READ):
            fresh = read_again(device, folder, request.logs, lists, store, profiles, request.excluded)
        if not fresh.read + fresh.kept:
            raise StoreError(
                f"{report}: none of its logs are in {place}. Name the folder of stored tables with --processed, or "
                "verify a bundle."
            )
        again = Path(temporary) / "report.html"
        with part_of_work("", LOGS_READ, 1.0):
            result = _compare_again(report, request, store, again)
        expected = take_apart(again.read_text(encoding="utf-8"))
    untouched = found.digests is not None and found.digests.page == page_digest(page)
    problems = (*devices, *fresh.problems)
    # If the page was edited or the logs differ, numbers must agree to the last digit.
    as_made = untouched and not problems
    differences = [*_cell_differences(expected, found, as_made)]
    said, anew = ({n: t for n, t in parts.texts.items() if not is_free_text(n)} for parts in (found, expected))
    differences += _differences("sentence", anew, said, same_text if as_made else _equal)
    checked = {"cells": len(found.cells), "sentences": len(said)}
    if document:
        new, old = (dict(leaves(one.numbers(), "json")) for one in (result, document))
        same = as_made and request.document == digest(document.numbers())
        differences += _differences("value", new, old, same_value if same else _equal)
        checked["values"] = len(old)
    elif not document and request.document and report.with_suffix(".json").exists() and request.code == report_code():
        text = notes[0].partition("; only")[0]
        differences.append(Difference(name="document", kind="value", expected=request.document, found=text))
    if not differences and not untouched:
        text = "the page was changed outside its cells: in a sentence, a figure, a script or the surrounding HTML"
        hashes = found.digests.page if found.digests else "hashes of the parts in the head"
        differences.append(Difference(name="page", kind="page", expected=hashes, found=text))
    return Verification(
        report=str(bundle or report),
        equal=not differences and not problems,
        checked=checked,
        differences=tuple(differences),
        logs=problems,
        notes=(*notes, *fresh.notes),
    )


def _cell_differences(expected: Parts, found: Parts, rounding: bool) -> Iterator[Difference]:
    """Yield the cells that differ from the recomputed cells, or from their hashes if no log determines them."""
    new, old = ({n: t for n, t in parts.cells.items() if not is_free_cell(n)} for parts in (expected, found))
    yield from _differences("cell", new, old, same_text if rounding else _equal)
    stored = found.digests.cells if found.digests else {}
    now = digests_of("", found).cells
    for name in {**stored, **now}:
        if stored.get(name) != now.get(name):
            kept = f"a text with the hash {stored[name]}" if name in stored else MISSING
            yield Difference(name=name, kind="cell", expected=kept, found=_cut(found.cells.get(name, MISSING)))


def _differences(
    kind: Literal["cell", "sentence", "value"],
    new: Mapping[str, Any],
    old: Mapping[str, Any],
    same: Callable[[str, Any, Any], bool],
) -> Iterator[Difference]:
    for name in {**new, **old}:
        a, b = new.get(name, MISSING), old.get(name, MISSING)
        if not same(name, a, b):
            yield Difference(name=name, kind=kind, expected=_cut(str(a)), found=_cut(str(b)))


def _cut(text: str) -> str:
    return text if len(text) <= MOST_CHARACTERS else f"{text[:MOST_CHARACTERS]} ..."


def _equal(name: str, a: Any, b: Any) -> bool:
    both = isinstance(a, float) and isinstance(b, float)
    return a == b or (both and math.isclose(a, b, rel_tol=ROUNDING))


def same_value(name: str, a: Any, b: Any) -> bool:
    """Return True if two values of a JSON document differ at most by rounding errors. ``name`` ends with the key of the
    value."""
    if isinstance(a, str) and isinstance(b, str):
        return same_text(name, a, b)
    if not (isinstance(a, float) and isinstance(b, float)):
        return type(a) is type(b) and bool(a == b)
    floor = ELSEWHERE if name.endswith("_percent") else 1e-12 if "/trend/" in name else 0.0
    return math.isclose(a, b, rel_tol=ELSEWHERE, abs_tol=floor)


def same_text(name: str, a: str, b: str) -> bool:
    """Return True if two texts differ at most by one in the last digit of numbers with a decimal point.

    Examples
    --------
    >>> [same_text("", "K = 1.25 kN/m", other) for other in ("K = 1.26 kN/m", "K = 1.27 kN/m", "K = 1.25 N/m")]
    [True, False, False]
    """
    first, second = _NUMBER.findall(a), _NUMBER.findall(b)
    return _NUMBER.sub("#", a) == _NUMBER.sub("#", b) and all(map(_same_number, first, second))


def _same_number(a: str, b: str) -> bool:
    if a == b:
        return True
    a, b = (
        text.replace("\N{MINUS SIGN}", "-").replace("\N{NARROW NO-BREAK SPACE}", "").replace(",", "") for text in (a, b)
    )
    if "e" in (a + b).lower():
        return max(abs(float(a)), abs(float(b))) < NOTHING
    places = len(a.partition(".")[2])
    return 0 < places == len(b.partition(".")[2]) and abs(round((float(a) - float(b)) * 10**places)) <= 1


def leaves(value: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the place and the value of every leaf of a document. A leaf is neither a list nor an object."""
    if not isinstance(value, dict | list):
        yield place, value
        return
    for key, part in value.items() if isinstance(value, dict) else enumerate(value):
        yield from leaves(part, f"{place}/{key}")


def _compare_again(report: Path, request: Request, store: Path, page: Path) -> ComparisonResult:
    """Write a page with the same options from logs that were read again, and return its document."""
    scene, truth, notes = request.scene, request.truth, request.notes
    what = scene.experiments, scene.criteria, scene.shown
    selection = ComparisonSelection(scene.device, store, *what, truth=truth, notes=notes)
    try:
        finished = run(plan_comparison(selection, ReportOptions(page, full=request.full)))
        write_report(finished)
        return finished.document
    except (UsageError, StoreError):
        raise
    except PipelineError as error:
        raise StoreError(f"{report}: its numbers cannot be recomputed: {error}") from error


def lines_of(verification: Verification) -> list[str]:
    """Return a verification as lines for a terminal. The differences come first, the outcome last."""
    lines = [
        f"{problem.path}: {problem.problem}"
        + (f"; expected {problem.expected}, found {problem.found or MISSING}" if problem.expected else "")
        for problem in verification.logs
    ]
    lines += [f"{d.name}: recomputed {d.expected}, the report has {d.found}" for d in verification.differences]
    lines += [f"Note: {note}" for note in verification.notes]
    counts = ", ".join(f"{count} {kind}" for kind, count in verification.checked.items())
    if verification.equal:
        return [*lines, f"{verification.report}: all equal ({counts})"]
    number = len(verification.differences)
    parts = f"{counted(number, 'part')} {'differs' if number == 1 else 'differ'}"
    changed = f"{parts}, {counted(len(verification.logs), 'log')} or stored samples differ from those"
    return [*lines, f"{verification.report}: {changed} of the report ({counts} checked)"]


def read_report(report: Path) -> tuple[str, Parts, Request]:
    """Return the text of a page, its parts, and the request of the comparison in its head.

    Raises
    ------
    UsageError
        If the page cannot be read or has no such head.
    """
    try:
        page = report.read_text(encoding="utf-8")
        parts = take_apart(page)
        return page, parts, Request.model_validate(parts.request)
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or error
        raise UsageError(f"{report}: cannot be read ({why}). Name a report by `pipeline compare`.") from error
    except ValidationError as error:
        raise UsageError(
            f"{report}: contains no readable request of a comparison; expected a report by `pipeline compare` of this "
            "version or a later one. Write it again with the command in its section on origin."
        ) from error


def device_problems(request: Request) -> tuple[LogProblem, ...]:
    """Return a problem if the local device file differs from the device file that a page used.

    Raises
    ------
    DeviceError
        If the page uses a device file that is not available here. Without it, all theoretical numbers would differ.
    """
    name = request.scene.device
    if request.device_file is None:
        return ()
    here = known_devices().get(name)
    if here is None:
        raise DeviceError(
            f"device {name!r}: the report uses its device file, which was not found. Without it, theory cannot be "
            f"recomputed. Set {USER_FOLDER_VARIABLE} to the folder of the file, or verify a bundle (`pipeline bundle`)."
        )
    if digest_of(here) == request.device_file:
        return ()
    text = "its device file differs from the one that the report used"
    return (LogProblem(path=f"device {name}", problem=text, expected=request.device_file, found=digest_of(here)),)


def stored_place(report: Path, named: str, given: Path | str | None) -> Path | str:
    """Return the folder or URL of the stored tables of a report: the given one, or the one that the report names.

    Raises
    ------
    UsageError
        If no trials are stored there.
    """
    place = given or named
    if is_url(place):
        return place
    folder = Path(place)
    places = [folder] if given else [folder, report.parent / folder, report.parent.parent / folder]
    for each in places:
        if (each / "trials").is_dir():
            return each
    raise UsageError(
        f"{', '.join(str(p) for p in dict.fromkeys(places))}: no stored trials; expected the folder from which the "
        "report was computed. Name this folder with --processed, or verify a bundle."
    )


def read_document(report: Path) -> tuple[ComparisonResult | None, list[str]]:
    """Return the JSON document of a page, or None and a note if there is no document of this version."""
    path = report.with_suffix(".json")
    try:
        return ComparisonResult.model_validate_json(path.read_bytes()), []
    except FileNotFoundError:
        return None, [f"{path}: the file is missing; only the page was checked"]
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        return None, [f"{path}: not a result of this version ({place}: {first['msg']}); only the page was checked"]
