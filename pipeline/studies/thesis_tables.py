"""Recomputed Tables B.1 to B.4, C.1 to C.3 and 5.1, next to the printed numbers.

Every printed number has one mark. ``equal``: the computed number rounds to it. ``within``: the difference is within one
of three tolerances, which is named (`ROUNDING`, `FLAT`, `LIMIT`). ``erratum``: the printed number cannot be reproduced,
and the reason is stored with it. ``unexplained``: none of these applies. Computed numbers depend only on the parameters
of the loop and the criterion. Nothing is tuned to the printed numbers.

Source: Hulin 2017, Table 5.1, appendices B and C.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np

from pipeline.base.json_object import JsonObject
from pipeline.device_data.published import QUANTITIES, THEORY_TABLES, PrintedNumber, PublishedPoint, published_points
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.records.criteria import ENERGY, criterion_of
from pipeline.theory.costs import point_costs_by_name
from pipeline.theory.energy import energy_costs
from pipeline.theory.optimum import POINT_CRITERIA, impulse_energy_limit, marked_point, optimal_point, scaling_factor
from pipeline.theory.search import where_stable

Mark = Literal["equal", "within", "erratum", "unexplained"]

MARKS: tuple[Mark, ...] = ("equal", "within", "erratum", "unexplained")

ROUNDING = "rounding"
"""The difference is at most one unit of the last printed digit: half a unit due to rounding, and half a unit due to the
error of the printed result."""

FLAT = "flat optimum"
"""Some point that rounds to the printed one has the optimal cost, within the printed precision."""

LIMIT = "limit"
"""The optimum is only approached, at alpha = -gamma. The printed cost is that of a point whose alpha rounds to
-gamma."""

_SLACK = 1e-6
"""Tolerance, as a fraction of a unit, for differences of half a unit, because rounding errors may increase them."""

_BOX = 11
"""Number of points along each axis of the box of points that round to the printed point."""

_LONGEST = 120
"""Largest number of samples of a response. The criteria evaluated here, poles and energies, do not need more."""

_NEAR = 5e-5
"""Largest alpha + gamma that rounds to 0 in the four printed digits of alpha in Tables C."""


SIGNS: dict[Mark, str] = {"equal": "", "within": " ~", "erratum": " !", "unexplained": " ?"}
"""Sign after a computed number, by mark."""

LEGEND = "~ within one unit of the last printed digit, or as stated below; ! erratum; ? unexplained"

_MORE = 2
"""Number of digits of a computed number in addition to the printed digits, so that the reader sees how it rounds."""


@dataclass(frozen=True)
class Entry:
    """A printed number with the computed number.

    Parameters
    ----------
    name : str
        One of `published.QUANTITIES`.
    printed : str
    computed : float
    mark : {"equal", "within", "erratum", "unexplained"}
    tolerance : str or None
        For ``within``: `ROUNDING`, `FLAT` or `LIMIT`.
    reason : str or None
        Reason for an erratum, or finding for `FLAT` and `LIMIT`.
    """

    name: str
    printed: str
    computed: float
    mark: Mark
    tolerance: str | None = None
    reason: str | None = None


@dataclass(frozen=True)
class TheoryRow:
    """A row of Tables C or 5.1, or one of the two points of a row of Tables B.

    Parameters
    ----------
    table, criterion : str
    delay, gamma, delta : float
    attained : bool
        False if the optimum is a limit that no stable point reaches.
    entries : tuple of Entry
        All printed numbers of the row.
    """

    table: str
    criterion: str
    delay: float
    gamma: float
    delta: float
    attained: bool
    entries: tuple[Entry, ...]


def recompute(point: PublishedPoint) -> TheoryRow:
    """Return a printed point with all its numbers recomputed.

    Raises
    ------
    ParameterError
        If the criterion is unknown.
    """
    loop = NormalisedLoop.ideal(point.gamma, point.delta, point.delay)
    attained = True
    if point.criterion in POINT_CRITERIA:
        place = marked_point(loop, point.criterion)
        values = {"alpha": place.alpha, "beta": place.beta}
        if point.percent is not None:
            largest = "alpha" if point.criterion == "alpha_max" else "beta"
            undelayed = marked_point(NormalisedLoop.ideal(point.gamma, point.delta, 0.0), point.criterion)
            values["percent"] = 100 * values[largest] / getattr(undelayed, largest)
    else:
        optimum = optimal_point(loop, point.criterion)
        attained = optimum.attained
        values = {"alpha": optimum.alpha, "beta": optimum.beta, "cost": optimum.cost}
        if point.scaling is not None:
            values["scaling"] = scaling_factor(point.criterion, point.delay, point.gamma, point.delta)
    entries = tuple(_entry(point, name, printed, values, attained) for name, printed in point.printed().items())
    return TheoryRow(point.table, point.criterion, point.delay, point.gamma, point.delta, attained, entries)


def _entry(point: PublishedPoint, name: str, printed: PrintedNumber, values: dict[str, float], attained: bool) -> Entry:
    computed = values[name]

    def marked(mark: Mark, tolerance: str | None = None, reason: str | None = None) -> Entry:
        return Entry(name, printed.text, computed, mark, tolerance, reason)

    mark, tolerance = mark_of(computed, printed)
    if mark != "unexplained":
        return marked(mark, tolerance)
    if name in point.erratum_of:
        return marked("erratum", reason=point.erratum)
    if name in ("alpha", "beta"):
        reason = _flatness(point, values["cost"]) if "cost" in values else None
        return marked("within", FLAT, reason) if reason else marked("unexplained")
    reason = None if attained else _distance(point, printed, values, values["cost"] / computed)
    return marked("within", LIMIT, reason) if reason else marked("unexplained")


def mark_of(computed: float, printed: PrintedNumber) -> tuple[Mark, str | None]:
    """Return the mark of a computed number from its distance to the printed number, and the tolerance that it needs.

    >>> mark_of(13.844, PrintedNumber("13.84")), mark_of(13.848, PrintedNumber("13.84"))
    (('equal', None), ('within', 'rounding'))
    """
    units = abs(computed - printed.value) / printed.unit
    if units <= 0.5 + _SLACK:
        return "equal", None
    return ("within", ROUNDING) if units <= 1 + _SLACK else ("unexplained", None)


def _flatness(point: PublishedPoint, optimal: float) -> str | None:
    """Return a finding if some point that rounds to the printed one has the optimal cost, within the printed precision.

    Otherwise, return None.
    """
    loop, printed = NormalisedLoop.ideal(point.gamma, point.delta, point.delay), point.printed()
    continuous = point.criterion == "pole_radius" or criterion_of(point.criterion).family is ENERGY
    if not continuous or not {"alpha", "beta", "cost"} <= set(printed):
        return None
    alpha, beta = (
        printed[name].value + printed[name].unit * np.linspace(-0.5, 0.5, _BOX) for name in ("alpha", "beta")
    )
    cost = where_stable(
        loop, lambda a, b, _: point_costs_by_name(loop, a, b, (point.criterion,), _LONGEST)[point.criterion]
    )
    least = float(cost(np.repeat(alpha, _BOX), np.tile(beta, _BOX), np.inf).min())
    if abs(least - optimal) > 0.5 * printed["cost"].unit:
        return None
    return f"some point that rounds to the printed one has the cost {least:.7g}; the optimal cost is {optimal:.7g}"


def _distance(point: PublishedPoint, printed: PrintedNumber, values: dict[str, float], factor: float) -> str | None:
    """Return a text with the costs on and next to the line alpha = -gamma, if the printed cost lies between them.

    ``factor`` converts costs to the printed number. It is 1 for a cost.
    """
    loop = NormalisedLoop.ideal(point.gamma, point.delta, point.delay)
    if not point.criterion.startswith("energy_impulse_w0"):
        return None
    beta = PrintedNumber(point.beta).value if point.beta else values["beta"]
    at = np.array([beta])
    limit = float(impulse_energy_limit(loop, at, point.criterion)[0]) / factor
    near = float(energy_costs(loop, np.array([_NEAR - loop.gamma]), at, "impulse")[point.criterion][0]) / factor
    if not limit - 0.5 * printed.unit <= printed.value <= near + 0.5 * printed.unit:
        return None
    return (
        f"the value is {limit:.7g} on the line alpha = -gamma, and {near:.7g} at a distance of {_NEAR:g}, which the "
        "printed digits of alpha do not show"
    )


def recomputed_tables(tables: Sequence[str] = THEORY_TABLES) -> Iterator[tuple[str, int, Iterator[TheoryRow]]]:
    """Yield the recomputed tables in the requested order, each as its name, its number of rows, and an iterator over
    its rows.

    Raises
    ------
    ParameterError
        If a table is unknown.

    Notes
    -----
    The computation takes about 30 s on one core for C.1 to C.3, 4 s for 5.1, and half a second for each of B.1 to B.4.
    """
    points = published_points(tables)
    for name in tables:
        rows = [point for point in points if point.table == name]
        yield name, len(rows), map(recompute, rows)


def count_marks(rows: Sequence[TheoryRow]) -> dict[Mark, int]:
    """Return the number of printed numbers with each mark."""
    found = Counter(entry.mark for row in rows for entry in row.entries)
    return {mark: found[mark] for mark in MARKS}


def table_lines(name: str, rows: Sequence[TheoryRow], align: Callable[..., list[str]]) -> list[str]:
    """Return a table as aligned lines, followed by the reasons for marked numbers and an empty line."""
    names = [quantity for quantity in QUANTITIES if any(e.name == quantity for row in rows for e in row.entries)]
    columns = ["criterion", "d", "gamma", "delta", *(c for n in names for c in (n, f"{n} printed"))]
    lines = [f"Table {name}: {_counts(rows)}", *align([_cells(row, names) for row in rows], columns)]
    for row in rows:
        reasons: dict[str, list[str]] = {}
        for entry in row.entries:
            if text := _reason(entry):
                reasons.setdefault(text, []).append(entry.name)
        place = f"{row.criterion}, d = {row.delay:g}, gamma = {row.gamma:g}, delta = {row.delta:g}"
        lines += [f"  {place}: {' and '.join(of)}: {text}" for text, of in reasons.items()]
    return [*lines, ""]


def _cells(row: TheoryRow, names: Sequence[str]) -> JsonObject:
    cells: JsonObject = {"criterion": row.criterion, "d": row.delay, "gamma": row.gamma, "delta": row.delta}
    for name in names:
        entry = next((e for e in row.entries if e.name == name), None)
        cells[name] = entry and _computed(entry)
        cells[f"{name} printed"] = entry and entry.printed
    return cells


def _computed(entry: Entry) -> str:
    digits = PrintedNumber(entry.printed).digits + _MORE
    # Adding 0.0 turns a -0.0 due to rounding into 0.0.
    return f"{round(entry.computed, digits) + 0.0:.{digits}f}{SIGNS[entry.mark]}"


def _reason(entry: Entry) -> str | None:
    if entry.tolerance in (FLAT, LIMIT):
        return f"{entry.tolerance}, {entry.reason}"
    if entry.mark == "unexplained":
        return f"printed {entry.printed}, computed {entry.computed:.10g}"
    return entry.reason


def _counts(rows: Sequence[TheoryRow]) -> str:
    return ", ".join(f"{count} {mark}" for mark, count in count_marks(rows).items())


def summary_line(rows: Sequence[TheoryRow]) -> str:
    """Return a summary with the number of printed numbers for each mark."""
    return f"{sum(len(row.entries) for row in rows)} printed numbers: {_counts(rows)}. ({LEGEND}.)"


def document(rows: Sequence[TheoryRow]) -> JsonObject:
    """Return rows and counts as a JSON document."""
    return {
        "marks": list(MARKS),
        "tolerances": {
            ROUNDING: "within one unit of the last printed digit",
            FLAT: "some point that rounds to the printed one has the optimal cost, within the printed precision",
            LIMIT: "the printed cost is that of a point whose alpha rounds to the limit alpha = -gamma",
        },
        "count": dict(count_marks(rows)),
        "rows": [asdict(row) for row in rows],
    }
