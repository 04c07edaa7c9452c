"""Tables of scores of a report: one row a score, one column an experiment.

What answers whether theory predicts the device stands first; costs at equal (K, B) and optima against the rules stand
beside the other tables of costs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from pipeline.base.wording import counted
from pipeline.records.results import ComparisonResult
from pipeline.records.score_records import (
    BandScore,
    BoundScore,
    DelayScore,
    DistanceScore,
    MapScore,
    OptimumScore,
    RegionScore,
    Scores,
    StiffnessScore,
    VerdictScore,
)
from pipeline.records.trial_codec import NO_TRIALS, TrialPage
from pipeline.rendering.labels import (
    MISSING,
    UNITS,
    criterion_name,
    damping_text,
    decimal,
    fixed,
    percent_text,
    share_text,
    significant,
    span,
)
from pipeline.rendering.table import Cell, Column, Table, missing, number, words

_NOT_KNOWN = "not available"
_NO_OPTIMUM = "the tables of optima do not hold this criterion for this experiment, or no trial has its cost"
_THREE = partial(significant, digits=3)
_TWO_PLACES = partial(fixed, places=2)
_RATIO = partial(fixed, places=3)


@dataclass(frozen=True)
class Row:
    """One score: name of the row, printed head with its unit, and where it is taken from.

    ``part`` names the score among those of an experiment, or picks it; ``cell`` prints it. Where it is missing the
    experiment's own reason stands, else ``why``, with ``nothing`` in the place of the number.
    """

    name: str
    head: str
    part: str | Callable[[Scores], Any]
    cell: Callable[[Any], Cell]
    why: str = _NOT_KNOWN
    nothing: str = MISSING

    def of(self, scores: Scores) -> Cell:
        """Return the cell of an experiment."""
        found = getattr(scores, self.part) if isinstance(self.part, str) else self.part(scores)
        if found is not None:
            return self.cell(found)
        why = scores.missing.get(self.part, self.why) if isinstance(self.part, str) else self.why
        return Cell(None, self.nothing, why=why)


def score_table(result: ComparisonResult, trials: TrialPage = NO_TRIALS) -> Table | None:
    """Return the scores of each experiment against the theory of the tables, or None where there are none."""
    found = _first_scores(result)
    bases = {s.basis for s in found.values()}
    basis = "theory by the device file" if bases == {"device file"} else "theory by the estimates of each experiment"
    if len(bases) > 1:
        basis = "theory by the device file, by the estimates where it has no such experiment"
    table = _table("scores", f"Measured against theory ({basis})", result, found)
    own = {e.experiment: s for e in result.experiments for s in e.scores if s.band or "band" in s.missing}
    _add(table, _stability_rows(result), found, "stability")
    _add(table, [BAND], own, "stability")
    _add(table, _evidence_rows(result), found, "stability")
    optima = [_optimum_row(c) for c in result.criteria if any(_of(c, s.optima) for s in found.values())]
    _add(table, optima, found, "optimal points: measured against discrete theory")
    return table if found else None


def cost_score_table(result: ComparisonResult, trials: TrialPage = NO_TRIALS) -> Table | None:
    """Return how costs of the trials follow theory at their own (K, B), or None where there are none."""
    found = {name: scores for name, scores in _first_scores(result).items() if scores.maps}
    caption = (
        "Costs of the trials against theory at the same K and B: rank correlation [1], median ratio of measured to "
        "theoretical cost, and trials with both"
    )
    table = _table("scores-costs", caption, result, found)
    _add(table, [_map_row(criterion) for criterion in result.criteria], found)
    return table if found else None


def rule_score_table(result: ComparisonResult, trials: TrialPage = NO_TRIALS) -> Table | None:
    """Return measured optimal costs against (5.19) and the damped curve of Fig. 6.12, or None where neither applies."""
    found = _first_scores(result)
    table = _table("scores-rules", "Measured optimal costs against rules of theory: deviation [%]", result, found)
    shown = [o for s in found.values() for o in s.optima]
    upper = "" if all(o.polynomial_valid for o in shown) else ", an upper estimate with damping"
    for rule, block in (("polynomial", f"(5.19){upper}"), ("damped", "theory with δ = 0.02")):
        known = {o.criterion for o in shown if getattr(o, f"{rule}_percent") is not None}
        _add(table, [_rule_row(rule, c) for c in result.criteria if c in known], found, block)
    return table.filled


def estimate_score_table(result: ComparisonResult, trials: TrialPage = NO_TRIALS) -> Table | None:
    """Return the scores against theory by the estimates of a device that has a file too, or None."""
    found = {e.experiment: s for e in result.experiments for s in e.scores[1:]}
    table = _table("scores-estimates", "Measured against theory by the estimates of each experiment", result, found)
    _add(table, _stability_rows(result), found, "stability")
    _add(table, [_map_row(c) for c in result.criteria], found, "costs of the trials at the same K and B")
    return table if found else None


def _first_scores(result: ComparisonResult) -> dict[str, Scores]:
    return {e.experiment: e.scores[0] for e in result.experiments if e.scores}


def _table(name: str, caption: str, result: ComparisonResult, found: Mapping[str, Scores]) -> Table:
    shown = [e.experiment for e in result.experiments if e.experiment in found]
    head = "score"
    while head in shown:  # an experiment may have any name
        head += "'"
    why = "no scores: theory or the estimates that it needs are not known"
    return Table(name, caption, (words(head, "score"), *(Column(e, group="experiment", why=why) for e in shown)))


def _add(table: Table, rows: list[Row], found: Mapping[str, Scores], block: str = "") -> None:
    head, *experiments = (column.name for column in table.columns)
    for row in rows:
        cells = {name: row.of(found[name]) for name in experiments if name in found}
        table.add(row.name, {head: row.head, **cells}, block)


def _stability_rows(result: ComparisonResult) -> list[Row]:
    K, B = UNITS[result.motion].stiffness, UNITS[result.motion].damping
    return [
        Row("covered", "share of the theoretical region that is measured as stable [%]", "region", _covered),
        Row("overlap", "overlap of the regions (intersection over union) [%]", "region", _overlap),
        Row("area_ratio", "area of the region, measured : theory [1]", "region", _area_ratio),
        Row("stiffness", f"largest stable stiffness, deviation [%] (measured : theory [{K}])", "stiffness", _stiffness),
        Row("distance_median", "distance of the boundary from theory, median [%]", "distance", _median),
        Row("distance_largest", f"largest distance [%] (at damping [{B}])", "distance", _largest),
        Row("distance_rms", f"distance, root mean square [{K}]", "distance", lambda d: Cell(d.rms, _THREE(d.rms))),
        Row(
            "verdicts",
            "verdicts that agree with theory [%] (trials stable in theory only : in the log only)",
            "verdicts",
            _verdicts,
        ),
    ]


def _covered(r: RegionScore) -> Cell:
    return number(r.covered, share_text, ends=(r.covered_low, r.covered_high))


def _overlap(r: RegionScore) -> Cell:
    aside = span(share_text, r.overlap_low, r.overlap_high)
    if r.censored:
        aside += f"; no unstable trial at {r.censored} of {r.dampings} dampings"
    return Cell(r.overlap, share_text(r.overlap), aside=aside)


def _area_ratio(r: RegionScore) -> Cell:
    return number(r.area_ratio, _RATIO, ends=(r.area_ratio_low, r.area_ratio_high))


def _median(d: DistanceScore) -> Cell:
    return Cell(d.median, percent_text(100 * d.median))


def _largest(d: DistanceScore) -> Cell:
    return Cell(d.largest, percent_text(100 * d.largest), aside=f"at B = {damping_text(d.largest_damping)}")


def _stiffness(k: StiffnessScore) -> Cell:
    text = ("≥ " if k.lower_bound else "") + percent_text(k.deviation_percent)
    return Cell(k.deviation_percent, text, aside=f"{decimal(k.measured, 0)} : {decimal(k.theory, 0)}")


def _verdicts(v: VerdictScore) -> Cell:
    return Cell(v.agreement, share_text(v.agreement), aside=f"{v.only_theory_stable} : {v.only_log_stable}")


def _band(b: BandScore) -> Cell:
    where = [
        f"{d.side} at B = " + " to ".join(dict.fromkeys((damping_text(d.damping_low), damping_text(d.damping_high))))
        for d in b.departures
    ]
    return Cell(b.share, share_text(b.share), aside="; ".join(where[:2]) + (" ..." if len(where) > 2 else ""))


BAND = Row("band", "limits inside the band of the estimates' intervals [%]", "band", _band)


def _evidence_rows(result: ComparisonResult) -> list[Row]:
    unit = UNITS[result.motion].stiffness
    return [
        Row("delay", "delay implied by the boundary [samples]", "delay", _delay),
        Row("bound", f"linear upper bound of K (6.1.3) [{unit}]", "bound", _bound, nothing="none"),
    ]


def _delay(d: DelayScore) -> Cell:
    own, trials = span(_TWO_PLACES, d.implied_low, d.implied_high), span(_THREE, d.trials_low, d.trials_high)
    aside = f"{own}; trials: {_THREE(d.trials)}, {trials}" + ("" if d.agree else "; they differ")
    return number(d.implied, _TWO_PLACES, aside=aside)


def _bound(b: BoundScore) -> Cell:
    reach = f"{span(_THREE, b.stiffness_low, b.stiffness_high)}; {span(_THREE, b.slope_low, b.slope_high)}"
    text = f"{_THREE(b.stiffness)} − {_THREE(b.slope)} B"
    return Cell(b.stiffness, text, aside=f"{reach}; cuts off {share_text(b.cut)} %")


def _optimum_row(criterion: str) -> Row:
    head = f"{criterion_name(criterion)}: cost [%]"
    return Row(f"optimum/{criterion}", head, lambda s: _of(criterion, s.optima), _optimum, _NO_OPTIMUM)


def _optimum(o: OptimumScore) -> Cell:
    where = f"K {_percent(o.stiffness_percent)}, B {_percent(o.damping_percent)}"
    aside = where + (", edge of the tested range" if o.censored else "")
    if o.cost_percent is None:
        return missing("the cost of theory is zero: nothing to divide by", aside=aside)
    return Cell(o.cost_percent, percent_text(o.cost_percent), aside=aside)


def _rule_row(rule: str, criterion: str) -> Row:
    def deviation(o: OptimumScore) -> Cell:
        return number(getattr(o, f"{rule}_percent"), percent_text, _NO_OPTIMUM)

    name = criterion_name(criterion)
    return Row(f"{rule}/{criterion}", name, lambda s: _of(criterion, s.optima), deviation, _NO_OPTIMUM)


def _map_row(criterion: str) -> Row:
    name = criterion_name(criterion)
    return Row(f"map/{criterion}", name, lambda s: _of(criterion, s.maps), _map)


def _map(m: MapScore) -> Cell:
    ratio = "" if m.median_ratio is None else f"ratio {_RATIO(m.median_ratio)}, "
    aside = f"{ratio}{counted(m.trials, 'trial')}"
    if m.rank_correlation is None:
        return missing(m.reason or _NOT_KNOWN, aside=aside)
    return number(m.rank_correlation, _RATIO, aside=aside)


def _of(criterion: str, scores: tuple[Any, ...]) -> Any:
    """Return the score of a criterion, or None."""
    return next((score for score in scores if score.criterion == criterion), None)


def _percent(value: float | None) -> str:
    return MISSING if value is None else f"{percent_text(value)} %"
