"""Why a measured boundary deviates from theory, as far as the logs tell: sentences by rules, each from one score."""

from __future__ import annotations

from pipeline.base.wording import counted
from pipeline.records.findings import Estimate, Trend
from pipeline.records.results import ExperimentResult
from pipeline.records.score_records import BandScore, BoundScore
from pipeline.rendering.labels import Units, damping_text, decimal, significant

SMALL = 0.02
"""Median distance of the boundaries below which there is nothing to explain: a course brackets a limit no closer."""

MOSTLY = 0.95
"""Share of limits inside the band from which on the intervals explain a deviation: so many lie inside by chance."""


def causes(result: ExperimentResult, units: Units) -> list[str]:
    """Return what may make the boundary of an experiment deviate, most certain first; empty where nothing is known.

    Parameters
    ----------
    result : ExperimentResult
        With its scores.
    units : Units
    """
    if not result.scores:
        return []
    first = result.scores[0]
    texts = []
    if first.bound is not None:
        texts.append(_bound(first.bound, units))
    band = next((s.band for s in result.scores if s.band is not None), None)
    distance = first.distance
    if band is not None and (distance is None or abs(distance.median) >= SMALL or band.share < MOSTLY):
        texts.append(_band(band, units))
    jitter = _jitter(result)
    if jitter:
        texts.append(jitter)
    elif first.delay is not None and not first.delay.agree:
        d = first.delay
        texts.append(
            f"The boundary fits a delay of {significant(d.implied, 3)} samples ({significant(d.implied_low, 3)} to "
            f"{significant(d.implied_high, 3)}), the trials show {significant(d.trials, 3)} "
            f"({significant(d.trials_low, 3)} to {significant(d.trials_high, 3)}): something beside delay acts near "
            "the boundary."
        )
    drift = _drift(result)
    if drift:
        texts.append(drift)
    return texts


def _bound(bound: BoundScore, units: Units) -> str:
    return (
        f"From B = {damping_text(bound.damping_low)} {units.damping} on the boundary is a straight line, "
        f"K ≤ {significant(bound.stiffness, 3)} {units.stiffness} \N{MINUS SIGN} {significant(bound.slope, 3)} s⁻¹ B, "
        f"that theory does not have; it cuts off {decimal(100 * bound.cut, 0)} % of the region. Vibration modes of the "
        "device and encoder resolution are known causes (6.1.3)."
    )


def _band(band: BandScore, units: Units) -> str:
    low, high = (significant(d, 3) for d in band.delay_samples)
    ranges = f"m, b and d = {low} to {high}" if low != high else "m, b and d"
    if band.share >= MOSTLY:
        return (
            f"The intervals of {ranges} allow this deviation: {band.inside} of {counted(band.points, 'limit')} meet "
            "the band of theory that they span."
        )
    where = max(band.departures, key=lambda d: d.dampings)
    return (
        f"The intervals of {ranges} do not explain it: only {band.inside} of {counted(band.points, 'limit')} meet "
        f"their band; the boundary lies {where.side} it from B = {damping_text(where.damping_low)} to "
        f"{damping_text(where.damping_high)} {units.damping}."
    )


def _jitter(result: ExperimentResult) -> str:
    """Where the delay takes several factors: which one the boundary follows, as a whole and near the origin."""
    trials = result.estimates["delay_samples"]
    if trials.value is None or trials.low is None or trials.high is None or trials.high - trials.low < 2:
        return ""
    text = f"The delay jitters over d = {significant(trials.low, 3)} to {significant(trials.high - 1, 3)} samples"
    implied = result.estimates.get("implied_delay")
    if implied is None or implied.value is None:
        return text + "."
    slope = implied.by_method.get("slope_near_origin")
    near = f", near the origin that of d = {significant(slope.value, 3)}" if slope and slope.value is not None else ""
    return f"{text}; the boundary as a whole follows theory for d = {significant(implied.value, 3)}{near}."


def _drift(result: ExperimentResult) -> str:
    """Parameters that change with the wall, which the model with constant ones cannot have."""
    names = {"mass": "mass", "damping": "viscous damping"}
    found = [
        f"{name} over {' and '.join(t.over for t in drifts)}"
        for key, name in names.items()
        if (drifts := _significant(result.estimates[key]))
    ]
    if not found:
        return ""
    return f"Parameters drift ({'; '.join(found)}), which friction, play or a controller of the drive would cause."


def _significant(estimate: Estimate) -> list[Trend]:
    return [t for t in estimate.trend if t.significant]
