"""Why a measured boundary deviates from theory, as far as the logs tell: rules, each from one score."""

from __future__ import annotations

from pipeline.base.wording import counted
from pipeline.comparison.figures.boundary_curves import too_late
from pipeline.comparison.loops.departures import MATTERS
from pipeline.comparison.scores.overlap import measured_limits
from pipeline.comparison.scores.theory_band import ParameterBox, band_score
from pipeline.records.results import AnswerCause, ExperimentResult
from pipeline.records.score_records import BandScore, BoundScore
from pipeline.rendering.labels import Units, damping_text, decimal, significant

MOSTLY = 0.95
"""Share of limits inside the band from which on the intervals explain a deviation: so many lie inside by chance."""

SOME = 0.8
"""The same from which on it is told that they could, with the number of limits beside."""


def causes(result: ExperimentResult, units: Units) -> list[AnswerCause]:
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
    found = []
    if first.bound is not None:
        found.append(_bound(first.bound, units))
    band = next((s.band for s in result.scores if s.band is not None), None)
    distance = first.distance
    if distance is not None and abs(distance.median) >= MATTERS:
        found += _delay_alone(result) if band is None and not result.causes else []
        found += [] if band is None else [_band(band, units)]
    return found


def _delay_alone(result: ExperimentResult) -> list[AnswerCause]:
    """Return that the delays that the logs leave open explain the limits by themselves, where they do.

    Asked only where the logs show no cause: a wide range of delays explains what friction did.
    """
    theory, delay = result.scores[0].parameters, result.estimates["delay_samples"]
    if delay.low is None or delay.high is None or delay.low == delay.high or too_late(delay):
        return []
    box = ParameterBox(
        (theory.mass, theory.mass),
        (theory.damping, theory.damping),
        (delay.low, delay.high),
        theory.sampling_period_s,
        theory.stiffness,
        theory.loop,
    )
    met = band_score(measured_limits(result.boundary), box)
    if met is None or met.share < SOME:
        return []
    low, high, own = (significant(d, 3) for d in (delay.low, delay.high, theory.delay_samples))
    sentence = f"Another delay could explain it: {low} to {high} samples in the logs, {own} in theory."
    evidence = f"{met.inside} of {counted(met.points, 'limit')} agree with some delay of that range"
    return [AnswerCause(code="delay_range", sentence=sentence, evidence=evidence)]


def _bound(bound: BoundScore, units: Units) -> AnswerCause:
    line = f"K ≤ {significant(bound.stiffness, 3)} {units.stiffness} \N{MINUS SIGN} {significant(bound.slope, 3)} s⁻¹ B"
    return AnswerCause(
        code="straight_limit",
        sentence="A straight line cuts the boundary off, as vibration modes and a coarse encoder do (6.1.3).",
        evidence=f"{line} from B = {damping_text(bound.damping_low)} {units.damping}; "
        f"{decimal(100 * bound.cut, 0)} % of the region is cut off",
    )


def _band(band: BandScore, units: Units) -> AnswerCause:
    low, high = (significant(d, 3) for d in band.delay_samples)
    ranges = f"m, b and d = {low} to {high}" if low != high else "m, b and d"
    evidence = f"{band.inside} of {counted(band.points, 'limit')} agree with the band of theory"
    if band.share >= MOSTLY:
        sentence = f"The intervals of {ranges} allow the deviation."
    else:
        where = max(band.departures, key=lambda d: d.dampings)
        sentence = f"Not the parameters: the intervals of {ranges} do not explain the deviation."
        evidence += (
            f"; the boundary lies {where.side} it from B = {damping_text(where.damping_low)} to "
            f"{damping_text(where.damping_high)} {units.damping}"
        )
    return AnswerCause(code="parameter_range", sentence=sentence, evidence=evidence)
