"""Parts of a report and the same parts computed anew: which differ, and which by rounding only."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

from pipeline.records.findings import Record
from pipeline.records.results import ComparisonResult
from pipeline.rendering.report import report_parts
from pipeline.rendering.report.report_parts import Parts
from pipeline.shell.verify.verify_rounding import same_text, same_value

Kind = Literal["cell", "sentence", "value", "page"]

ROUNDING = 1e-9
"""Relative difference of two values of the JSON document that counts as none: other processors and builds of numpy
round the last digits of a sum in another way."""

MOST_CHARACTERS = 200
"""Characters of a part that are quoted."""

MISSING = "(missing)"


class Difference(Record):
    """A part of the report that differs: ``expected`` was computed anew, ``found`` stands in the report."""

    name: str
    kind: Kind
    expected: str
    found: str


@dataclass
class Comparison:
    """How parts are compared.

    Parameters
    ----------
    rounding : bool
        Whether parts that differ by rounding only count as equal.
    rounded : int
        How many did.
    """

    rounding: bool
    rounded: int = 0

    def equal(self, new: Any, old: Any, same: Callable[[Any, Any], bool]) -> bool:
        """Tell whether two parts count as equal; ``same`` tells it of parts that differ, none of them None."""
        if new == old:
            return True
        if self.rounding and new is not None and old is not None and same(new, old):
            self.rounded += 1
            return True
        return False


def part_differences(expected: Parts, found: Parts, comparison: Comparison) -> Iterator[Difference]:
    """Yield which cells and sentences of a page (``found``) are not those computed anew; drawings are not compared."""
    cells = ({n: t for n, t in p.cells.items() if not report_parts.is_free_cell(n)} for p in (expected, found))
    yield from _text_differences("cell", comparison, *cells)
    texts = ({n: t for n, t in p.texts.items() if not report_parts.is_free_text(n)} for p in (expected, found))
    yield from _text_differences("sentence", comparison, *texts)


def free_differences(found: Parts) -> Iterator[Difference]:
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


def _text_differences(
    kind: Kind, comparison: Comparison, expected: Mapping[str, str], found: Mapping[str, str]
) -> Iterator[Difference]:
    for name in {**expected, **found}:
        new, old = expected.get(name), found.get(name)
        if not comparison.equal(new, old, same_text):
            yield _difference(kind, name, *(MISSING if text is None else text for text in (new, old)))


def value_differences(
    expected: ComparisonResult, found: ComparisonResult, comparison: Comparison
) -> Iterator[Difference]:
    """Yield which values of a JSON document (``found``) are not those computed anew."""
    new, old = (dict(leaves(result.numbers())) for result in (expected, found))
    for place in {**new, **old}:
        a, b = new.get(place, MISSING), old.get(place, MISSING)
        if isinstance(a, float) and isinstance(b, float) and math.isclose(a, b, rel_tol=ROUNDING):
            continue
        if not comparison.equal(a, b, partial(same_value, place)):
            yield _difference("value", f"json{place}", str(a), str(b))


def leaves(value: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """Yield place and value of everything in a document that is no list and no object."""
    items: Iterable[tuple[Any, Any]]
    if isinstance(value, dict):
        items = value.items()
    elif isinstance(value, list):
        items = enumerate(value)
    else:
        yield place, value
        return
    for key, part in items:
        yield from leaves(part, f"{place}/{key}")


def _difference(kind: Kind, name: str, expected: str, found: str) -> Difference:
    return Difference(name=name, kind=kind, expected=_cut(expected), found=_cut(found))


def _cut(text: str) -> str:
    return text if len(text) <= MOST_CHARACTERS else f"{text[:MOST_CHARACTERS]} ..."
