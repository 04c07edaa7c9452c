"""Tables of scores of a report: one row a score, one column an experiment.

What answers whether theory predicts the device stands first; costs at equal (K, B) and optima against the rules stand
beside the other tables of costs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from pipeline.base.wording import counted, true_minus
from pipeline.records.results import ComparisonResult
from pipeline.records.score_records import MapScore, OptimumScore, Scores
from pipeline.rendering.labels import (
    CRITERION_NAMES,
    MISSING,
    UNITS,
    Units,
    damping_text,
    decimal,
    percent_text,
    share_text,
    significant,
)
from pipeline.rendering.report_tables import Cell, Head, Table, missing_cell, text_cell

_NOT_KNOWN = "not available"
_NO_OPTIMUM = "the tables of optima do not hold this criterion for this experiment, or no trial has its cost"


@dataclass(frozen=True)
class _Row:
    """One score: name of the row, printed head with its unit, and the cell of an experiment."""

    name: str
    head: str
    cell: Callable[[Scores], Cell]


def score_table(result: ComparisonResult) -> Table | None:
    """Return the scores of each experiment against the theory of the tables, or None where there are none."""
    found = {e.experiment: e.scores[0] for e in result.experiments if e.scores}
    if not found:
        return None
    bases = {s.basis for s in found.values()}
    basis = "theory by the device file" if bases == {"device file"} else "theory by the estimates of each experiment"
    if len(bases) > 1:
        basis = "theory by the device file, by the estimates where it has no such experiment"
    table = _table("scores", f"Measured against theory ({basis})", result, found)
    units = UNITS[result.motion]
    own = {e.experiment: s for e in result.experiments for s in e.scores if s.band or "band" in s.missing}
    for row in _stability_rows(units):
        _add(table, "stability", row, result, found)
    _add(table, "stability", _band_row(), result, own)
    for row in _evidence_rows(units):
        _add(table, "stability", row, result, found)
    for criterion in result.criteria:
        if any(_optimum(s, criterion) for s in found.values()):
            _add(table, "optimal points: measured against discrete theory", _optimum_row(criterion), result, found)
    return table


def cost_score_table(result: ComparisonResult) -> Table | None:
    """Return how costs of the trials follow theory at their own (K, B), or None where there are none."""
    found = {e.experiment: e.scores[0] for e in result.experiments if e.scores and e.scores[0].maps}
    if not found:
        return None
    caption = (
        "Costs of the trials against theory at the same K and B: rank correlation [1], median ratio of measured to "
        "theoretical cost, and trials with both"
    )
    table = _table("scores-costs", caption, result, found)
    for criterion in result.criteria:
        _add(table, "", _map_row(criterion), result, found)
    return table


def rule_score_table(result: ComparisonResult) -> Table | None:
    """Return measured optimal costs against (5.19) and the damped curve of Fig. 6.12, or None where neither applies."""
    found = {e.experiment: e.scores[0] for e in result.experiments if e.scores}
    table = _table("scores-rules", "Measured optimal costs against rules of theory: deviation [%]", result, found)
    shown = [o for s in found.values() for o in s.optima]
    upper = "" if all(o.polynomial_valid for o in shown) else ", an upper estimate with damping"
    rules: tuple[tuple[str, str, Callable[[OptimumScore], float | None]], ...] = (
        ("polynomial", f"(5.19){upper}", lambda o: o.polynomial_percent),
        ("damped", "theory with δ = 0.02", lambda o: o.damped_percent),
    )
    for rule, block, pick in rules:
        for criterion in result.criteria:
            if any(pick(o) is not None for o in shown if o.criterion == criterion):
                _add(table, block, _rule_row(rule, criterion, pick), result, found)
    return table if table.blocks else None


def estimate_score_table(result: ComparisonResult) -> Table | None:
    """Return the scores against theory by the estimates of a device that has a file too, or None."""
    found = {e.experiment: s for e in result.experiments for s in e.scores[1:]}
    if not found:
        return None
    table = _table("scores-estimates", "Measured against theory by the estimates of each experiment", result, found)
    for row in _stability_rows(UNITS[result.motion]):
        _add(table, "stability", row, result, found)
    for criterion in result.criteria:
        _add(table, "costs of the trials at the same K and B", _map_row(criterion), result, found)
    return table


def _table(identifier: str, caption: str, result: ComparisonResult, found: Mapping[str, Scores]) -> Table:
    shown = [e for e in result.experiments if e.experiment in found]
    return Table(
        identifier, caption, (Head("score", numeric=False), *(Head(e.experiment, "experiment") for e in shown))
    )


def _add(table: Table, block: str, row: _Row, result: ComparisonResult, found: Mapping[str, Scores]) -> None:
    names = [head.text for head in table.heads[1:]]
    head = "score"
    while head in names:  # an experiment may have any name
        head += "'"
    nothing = missing_cell("no scores: theory or the estimates that it needs are not known")
    cells = [row.cell(found[name]) if name in found else nothing for name in names]
    table.add(block, row.name, (head, *names), [text_cell(row.head), *cells])


def _stability_rows(units: Units) -> list[_Row]:
    K, B = units.stiffness, units.damping

    def covered(s: Scores) -> Cell:
        r = s.region
        if r is None:
            return missing_cell(s.missing.get("region", _NOT_KNOWN))
        return Cell(share_text(r.covered), aside=_range(share_text, r.covered_low, r.covered_high))

    def shared(s: Scores) -> Cell:
        r = s.region
        if r is None:
            return missing_cell(s.missing.get("region", _NOT_KNOWN))
        aside = _range(share_text, r.overlap_low, r.overlap_high)
        if r.censored:
            aside += f"; no unstable trial at {r.censored} of {r.dampings} dampings"
        return Cell(share_text(r.overlap), aside=aside)

    def ratio(s: Scores) -> Cell:
        r = s.region
        if r is None:
            return missing_cell(s.missing.get("region", _NOT_KNOWN))
        return Cell(_ratio(r.area_ratio), aside=_range(_ratio, r.area_ratio_low, r.area_ratio_high))

    def median(s: Scores) -> Cell:
        d = s.distance
        return _gone(s, "distance") if d is None else Cell(percent_text(100 * d.median))

    def largest(s: Scores) -> Cell:
        d = s.distance
        if d is None:
            return _gone(s, "distance")
        return Cell(percent_text(100 * d.largest), aside=f"at B = {damping_text(d.largest_damping)}")

    def rms(s: Scores) -> Cell:
        return _gone(s, "distance") if s.distance is None else Cell(significant(s.distance.rms, 3))

    def stiffness(s: Scores) -> Cell:
        k = s.stiffness
        if k is None:
            return _gone(s, "stiffness")
        text = f"{decimal(k.measured, 0)} : {decimal(k.theory, 0)}"
        return Cell(("≥ " if k.lower_bound else "") + percent_text(k.deviation_percent), aside=text)

    def verdicts(s: Scores) -> Cell:
        v = s.verdicts
        if v is None:
            return _gone(s, "verdicts")
        text = f"{v.only_theory_stable} : {v.only_log_stable}"
        return Cell(share_text(v.agreement), aside=text)

    return [
        _Row("covered", "share of the theoretical region that is measured as stable [%]", covered),
        _Row("overlap", "overlap of the regions (intersection over union) [%]", shared),
        _Row("area_ratio", "area of the region, measured : theory [1]", ratio),
        _Row("stiffness", f"largest stable stiffness, deviation [%] (measured : theory [{K}])", stiffness),
        _Row("distance_median", "distance of the boundary from theory, median [%]", median),
        _Row("distance_largest", f"largest distance [%] (at damping [{B}])", largest),
        _Row("distance_rms", f"distance, root mean square [{K}]", rms),
        _Row(
            "verdicts", "verdicts that agree with theory [%] (trials stable in theory only : in the log only)", verdicts
        ),
    ]


def _band_row() -> _Row:
    def cell(s: Scores) -> Cell:
        b = s.band
        if b is None:
            return _gone(s, "band")
        where = [
            f"{d.side} at B = "
            + " to ".join(dict.fromkeys((damping_text(d.damping_low), damping_text(d.damping_high))))
            for d in b.departures
        ]
        return Cell(share_text(b.share), aside="; ".join(where[:2]) + (" ..." if len(where) > 2 else ""))

    return _Row("band", "limits inside the band of the estimates' intervals [%]", cell)


def _evidence_rows(units: Units) -> list[_Row]:
    def delay(s: Scores) -> Cell:
        d = s.delay
        if d is None:
            return _gone(s, "delay")
        trials = f"trials: {_three(d.trials)}, {_three(d.trials_low)} to {_three(d.trials_high)}"
        own = f"{_decimals(d.implied_low, 2)} to {_decimals(d.implied_high, 2)}"
        return Cell(_decimals(d.implied, 2), aside=f"{own}; {trials}" + ("" if d.agree else "; they differ"))

    def bound(s: Scores) -> Cell:
        b = s.bound
        if b is None:
            return Cell("none", why=s.missing.get("bound", _NOT_KNOWN))
        reach = (
            f"{_three(b.stiffness_low)} to {_three(b.stiffness_high)}; {_three(b.slope_low)} to {_three(b.slope_high)}"
        )
        return Cell(f"{_three(b.stiffness)} − {_three(b.slope)} B", aside=f"{reach}; cuts off {share_text(b.cut)} %")

    return [
        _Row("delay", "delay implied by the boundary [samples]", delay),
        _Row("bound", f"linear upper bound of K (6.1.3) [{units.stiffness}]", bound),
    ]


def _optimum_row(criterion: str) -> _Row:
    def point(s: Scores) -> Cell:
        o = _optimum(s, criterion)
        if o is None:
            return missing_cell(_NO_OPTIMUM)
        where = f"K {_percent(o.stiffness_percent)}, B {_percent(o.damping_percent)}"
        marked = ", edge of the tested range" if o.censored else ""
        if o.cost_percent is None:
            return Cell(MISSING, aside=where + marked, why="the cost of theory is zero: nothing to divide by")
        return Cell(percent_text(o.cost_percent), aside=where + marked)

    return _Row(f"optimum/{criterion}", f"{CRITERION_NAMES.get(criterion, criterion)}: cost [%]", point)


def _rule_row(rule: str, criterion: str, pick: Callable[[OptimumScore], float | None]) -> _Row:
    def cell(s: Scores) -> Cell:
        o = _optimum(s, criterion)
        value = pick(o) if o else None
        return missing_cell(_NO_OPTIMUM) if value is None else Cell(percent_text(value))

    return _Row(f"{rule}/{criterion}", CRITERION_NAMES.get(criterion, criterion), cell)


def _map_row(criterion: str) -> _Row:
    def cell(s: Scores) -> Cell:
        m = _map(s, criterion)
        if m is None:
            return missing_cell(_NOT_KNOWN)
        ratio = "" if m.median_ratio is None else f"ratio {_ratio(m.median_ratio)}, "
        aside = f"{ratio}{counted(m.trials, 'trial')}"
        if m.rank_correlation is None:
            return Cell(MISSING, aside=aside, why=m.reason or _NOT_KNOWN)
        return Cell(_decimals(m.rank_correlation, 3), aside=aside)

    name = CRITERION_NAMES.get(criterion, criterion)
    return _Row(f"map/{criterion}", name, cell)


def _optimum(scores: Scores, criterion: str) -> OptimumScore | None:
    return next((o for o in scores.optima if o.criterion == criterion), None)


def _map(scores: Scores, criterion: str) -> MapScore | None:
    return next((m for m in scores.maps if m.criterion == criterion), None)


def _gone(scores: Scores, what: str) -> Cell:
    return missing_cell(scores.missing.get(what, _NOT_KNOWN))


def _decimals(value: float, places: int) -> str:
    """Number with all its decimals, so that those of a row have equally many."""
    return true_minus(f"{value:.{places}f}")


def _ratio(value: float) -> str:
    return _decimals(value, 3)


def _percent(value: float | None) -> str:
    return MISSING if value is None else f"{percent_text(value)} %"


def _three(value: float) -> str:
    return significant(value, 3)


def _range(text: Callable[[float], str], low: float, high: float) -> str:
    return f"{text(low)} to {text(high)}"
