"""`pipeline verify`: every number of a report computed anew from the logs, and the names of those that differ."""

from __future__ import annotations

import json
import math
import shutil
import tempfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ValidationError

from pipeline.base.errors import PipelineError, StoreError, UsageError
from pipeline.base.provenance import code_digest
from pipeline.comparison.compare import REPORT_CODE, compare
from pipeline.records.models import Record, Scene
from pipeline.records.results import ComparisonResult
from pipeline.records.trial_codec import unpack
from pipeline.rendering import report_parts
from pipeline.rendering.report_parts import Parts, take_apart
from pipeline.shell.verify_logs import LogProblem, ReportedLogs, read_anew

Kind = Literal["cell", "figure", "data", "sentence", "value", "page"]

ROUNDING = 1e-9
"""Relative difference of two values of the JSON document that counts as none: other processors and builds of numpy
round the last digits of a sum in another way."""

MOST_CHARACTERS = 200
"""Characters of a part that are quoted."""

MISSING = "(missing)"

TRIAL_DATA = "trial-data"
"""Data block with the trials of the page."""

PACKED = ("/columns", "/responses")
"""Ends of the places in it that `trial_codec.pack` packed."""


class Difference(Record):
    """A part of the report that differs: ``expected`` was computed anew, ``found`` stands in the report."""

    name: str
    kind: Kind
    expected: str
    found: str


class Verification(Record):
    """What `verify` found.

    Parameters
    ----------
    report : str
    equal : bool
        Whether all numbers are those of the logs, and all logs those of the report.
    checked : dict of str to int
        Number of parts that were held against the logs, or against the hashes in the page, by kind.
    differences : tuple of Difference
    logs : tuple of LogProblem
    notes : tuple of str
        What could not be checked, and why.
    """

    report: str
    equal: bool
    checked: dict[str, int]
    differences: tuple[Difference, ...]
    logs: tuple[LogProblem, ...]
    notes: tuple[str, ...]


class _Request(BaseModel):
    processed: str
    scene: Scene
    logs: dict[str, ReportedLogs]
    code: str
    full: bool = False


def verify(
    report: Path,
    processed: Path | None = None,
    profiles: Sequence[Path] = (),
    progress: Callable[[str], None] | None = None,
) -> Verification:
    """Compute the numbers of a report anew and compare them, part by part.

    The logs are read again from where they lay, or from the stored samples where they are gone; stages, costs and
    theory are computed in a temporary folder. Nothing in ``processed`` is changed.

    Parameters
    ----------
    report : Path
        HTML page by `compare`.
    processed : Path, optional
        Folder of the stored tables; by default the one that the report names, looked for in the current folder and
        beside the report.
    profiles : sequence of Path
        Profile files of the lab that read the logs.
    progress : callable, optional
        Gets the name of each step when it begins.

    Raises
    ------
    UsageError
        If the file is no report, or the folder is not found.
    StoreError
        If `processed` is damaged.
    """
    say = progress or (lambda _: None)
    try:
        page = report.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{report}: cannot be read ({error}). Give a report by `pipeline compare`.") from error
    found = take_apart(page)
    request = _request(report, found)
    folder = _processed(report, processed or Path(request.processed), given=processed is not None)
    document, notes = _document(report)
    if request.code != code_digest(*REPORT_CODE):
        notes.append("the report was made by another version of the code: numbers may differ for that reason")
    with tempfile.TemporaryDirectory(prefix="pipeline-verify-") as temporary:
        store = Path(temporary) / "processed"
        say("reading the logs")
        lists = {logs.experiment: logs for logs in document.logs} if document else {}
        fresh = read_anew(request.scene.device, folder, request.logs, lists, store, profiles)
        if (folder / "accuracy.json").is_file():
            shutil.copy(folder / "accuracy.json", store / "accuracy.json")
        say(f"computing anew: {fresh.read} trials from logs, {fresh.kept} from stored samples")
        again = Path(temporary) / "report.html"
        try:
            outcome = compare(
                request.scene.device,
                store,
                experiments=request.scene.experiments,
                criteria=request.scene.criteria,
                report=again,
                full=request.full,
                responses=_responses(found, len(request.scene.experiments)),
                shown=request.scene.shown,
                progress=progress,
            )
        except (UsageError, StoreError):
            raise
        except PipelineError as error:
            raise StoreError(f"{report}: its numbers cannot be computed anew: {error}") from error
        expected = take_apart(again.read_text(encoding="utf-8"))
    differences = [*_part_differences(expected, found), *_free_differences(found)]
    checked = {
        "cells": len(found.cells),
        "figures": len(found.figures),
        "sentences": len(found.texts),
        "data": len(found.data),
    }
    if document and outcome.result:
        values = list(_value_differences(outcome.result, document))
        differences += values
        checked["values"] = sum(1 for _ in _leaves(_comparable(document)))
    stored = found.digests
    if not differences and stored and stored.page != report_parts.page_digest(page):
        text = "the page was changed outside its numbers, sentences and figures"
        differences.append(Difference(name="page", kind="page", expected=stored.page, found=text))
    return Verification(
        report=str(report),
        equal=not differences and not fresh.problems,
        checked=checked,
        differences=tuple(differences),
        logs=tuple(fresh.problems),
        notes=(*notes, *fresh.notes),
    )


def lines_of(verification: Verification) -> list[str]:
    """Return a verification as lines for a terminal: what differs first, the outcome last."""
    lines = [
        f"{problem.path}: {problem.problem}"
        + (f"; expected {problem.expected}, found {problem.found or MISSING}" if problem.expected else "")
        for problem in verification.logs
    ]
    lines += [f"{d.name}: computed anew {d.expected}, the report says {d.found}" for d in verification.differences]
    lines += [f"Note: {note}" for note in verification.notes]
    counts = ", ".join(f"{count} {kind}" for kind, count in verification.checked.items())
    if verification.equal:
        return [*lines, f"{verification.report}: all equal ({counts})"]
    told = (
        f"{len(verification.differences)} parts differ, {len(verification.logs)} logs or stored samples are not those"
    )
    return [*lines, f"{verification.report}: {told} of the report ({counts} checked)"]


def _request(report: Path, parts: Parts) -> _Request:
    try:
        return _Request.model_validate(parts.request)
    except ValidationError as error:
        raise UsageError(
            f"{report}: holds no request of a comparison that can be read; expected a report by `pipeline compare`, of "
            "this version or a later one. Write it anew with the command in its section on origin."
        ) from error


def _processed(report: Path, folder: Path, given: bool) -> Path:
    places = [folder] if given else [folder, report.parent / folder, report.parent.parent / folder]
    for place in places:
        if (place / "trials").is_dir():
            return place
    raise UsageError(
        f"{', '.join(str(p) for p in dict.fromkeys(places))}: no stored trials; expected the folder that the report "
        "was made from. Give it with --processed."
    )


def _document(report: Path) -> tuple[ComparisonResult | None, list[str]]:
    path = report.with_suffix(".json")
    try:
        return ComparisonResult.model_validate_json(path.read_bytes()), []
    except FileNotFoundError:
        return None, [f"{path}: is not there, so that only the page was checked"]
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        return None, [
            f"{path}: is no result of this version ({place}: {first['msg']}), so that only the page was checked"
        ]


def _part_differences(expected: Parts, found: Parts) -> Iterator[Difference]:
    cells = [{n: t for n, t in p.cells.items() if not report_parts.is_free_cell(n)} for p in (expected, found)]
    yield from _compared("cell", *cells)
    for name in {**expected.figures, **found.figures}:
        pair = (expected.figures.get(name), found.figures.get(name))
        if pair[0] != pair[1]:
            new, old = ("(missing)" if text is None else f"drawing {report_parts.short(text)}" for text in pair)
            yield Difference(name=f"figure {name}", kind="figure", expected=new, found=old)
    for name in {**expected.data, **found.data}:
        yield from _data_differences(name, expected.data.get(name), found.data.get(name))
    texts = [{n: t for n, t in p.texts.items() if not report_parts.is_free_text(n)} for p in (expected, found)]
    yield from _compared("sentence", *texts)


def _free_differences(found: Parts) -> Iterator[Difference]:
    """Parts that no log determines, held against the hashes in the page."""
    stored = found.digests
    if stored is None:
        yield Difference(name="page", kind="page", expected="hashes of the parts in the head", found=MISSING)
        return
    now = report_parts.digests_of("", found)
    kinds: tuple[tuple[Kind, dict[str, str], dict[str, str], dict[str, str]], ...] = (
        ("cell", stored.cells, now.cells, found.cells),
        ("sentence", stored.texts, now.texts, found.texts),
    )
    for kind, before, after, texts in kinds:
        for name in {**before, **after}:
            if before.get(name) != after.get(name):
                expected = f"a text with the hash {before[name]}" if name in before else MISSING
                yield _difference(kind, name, expected, texts.get(name, MISSING))


def _compared(kind: Kind, expected: Mapping[str, str], found: Mapping[str, str]) -> Iterator[Difference]:
    for name in {**expected, **found}:
        new, old = expected.get(name, MISSING), found.get(name, MISSING)
        if new != old:
            yield _difference(kind, name, new, old)


def _responses(found: Parts, experiments: int) -> list[int] | None:
    """Return how many responses of each experiment a page holds; None where it does not say."""
    try:
        numbers = [int(e["shown"]) for e in json.loads(found.data[TRIAL_DATA])["experiments"]]
    except (KeyError, TypeError, ValueError):
        return None
    return numbers if len(numbers) == experiments and min(numbers, default=0) >= 0 else None


def _data_differences(name: str, expected: str | None, found: str | None) -> Iterator[Difference]:
    if expected == found:
        return
    try:
        new, old = (dict(_leaves(json.loads(text or "null"))) for text in (expected, found))
    except json.JSONDecodeError:
        new, old = ({"": report_parts.short(text) if text is not None else None} for text in (expected, found))
    for place in {**new, **old}:
        if new.get(place) != old.get(place):
            yield _difference("data", f"{name}{place}", str(new.get(place, MISSING)), str(old.get(place, MISSING)))


def _value_differences(expected: ComparisonResult, found: ComparisonResult) -> Iterator[Difference]:
    new, old = (dict(_leaves(_comparable(result))) for result in (expected, found))
    for place in {**new, **old}:
        a, b = new.get(place, MISSING), old.get(place, MISSING)
        if a == b or (isinstance(a, float) and isinstance(b, float) and math.isclose(a, b, rel_tol=ROUNDING)):
            continue
        yield _difference("value", f"json{place}", str(a), str(b))


def _comparable(result: ComparisonResult) -> Any:
    """The document without what tells of files and runs."""
    return result.model_dump(mode="json", exclude={"provenance", "logs", "report"})


def _leaves(value: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """Yield place and value of everything in a document that is no list and no object, also of what is packed in it."""
    items: Iterable[tuple[Any, Any]]
    if place.endswith(PACKED):
        value = _unpacked(value)
    if isinstance(value, dict):
        items = value.items()
    elif isinstance(value, list):
        items = enumerate(value)
    else:
        yield place, value
        return
    for key, part in items:
        yield from _leaves(part, f"{place}/{key}")


def _unpacked(value: Any) -> Any:
    """Return what is packed in a value; the value where nothing is. The same content packs to other bytes elsewhere."""
    try:
        return unpack(value)
    except (TypeError, ValueError, zlib.error):
        return value


def _difference(kind: Kind, name: str, expected: str, found: str) -> Difference:
    return Difference(name=name, kind=kind, expected=_cut(expected), found=_cut(found))


def _cut(text: str) -> str:
    return text if len(text) <= MOST_CHARACTERS else f"{text[:MOST_CHARACTERS]} ..."
