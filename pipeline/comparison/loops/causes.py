"""Why an experiment deviates from the ideal loop, as far as its logs show it directly."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pipeline.base.wording import counted
from pipeline.comparison.loops.adequacy import Shown
from pipeline.comparison.loops.log_evidence import coarse, friction_words, law_causes, rest_words
from pipeline.comparison.loops.loop_range import MATTERS, LoopRange, explains, loop_delay
from pipeline.comparison.loops.part_causes import part_causes
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.records.findings import Estimate
from pipeline.records.loop_records import Cause
from pipeline.records.results import ExperimentResult
from pipeline.rendering.labels import Units, percent_text, share_text, significant, span

FEW = 10
"""Trials below which nothing that differs between trials can be told."""

MOST = 5
"""Causes that are named of what single logs show."""


def direct_causes(
    result: ExperimentResult,
    stages: ExperimentStages,
    loop: LoopRange | None,
    shown: Shown,
    stated_mass: float | None,
    units: Units,
    *,
    adequate: bool,
) -> tuple[Cause, ...]:
    """Return the causes that logs show directly, most certain first; empty for an ideal loop.

    Parameters
    ----------
    result : ExperimentResult
    stages : ExperimentStages
    loop : LoopRange or None
        By the estimates.
    shown : Shown
        What single logs and all together show.
    stated_mass : float or None
        Mass by the device file.
    units : Units
    adequate : bool
        Whether the loop is; a delay or a gain of one that is not means something else.

    Notes
    -----
    A cause whose effect on the limit is known and below `MATTERS` is not told.
    """
    departures, fitted = shown.departures, shown.fitted
    found = [] if shown.gains is None or shown.gains.few else [shown.gains.cause]
    found += law_causes(departures, stages)[:MOST]
    if fitted is not None and fitted.tells and "delay_samples" not in fitted.open:
        parts = part_causes(stages, fitted, shown.velocity, units)
        found += [cause for cause in parts if all(cause.code != other.code for other in found)]
    elif not departures:  # a command that is not the wall law's tells of no force beside it
        found += _force(result, shown, units, stages)
    if loop is not None:
        found += _jitter(result, stages, loop)
        found += [] if not adequate or loop.parts.actuator_lag_s else [*_part_of_a_sample(result, loop)]
        found += _gain(result, loop, stated_mass)
    found += _sensor(stages)
    found += _trials(result, stages)
    return tuple(found)


def _force(result: ExperimentResult, shown: Shown, units: Units, stages: ExperimentStages) -> Iterator[Cause]:
    """A constant force or friction, by the estimates where they are and by where the device rests.

    Friction with stiction is seen by the balance of all trials and by the likeliest device, though that explains few of
    them; either alone may be another part's likeness.
    """
    rest, fitted = shown.rest, shown.fitted
    constant, friction = (result.estimates.get(name) for name in ("constant_force", "friction"))
    walls = any(point.stable is not None for point in result.boundary)
    if constant is not None and _is_sure(constant) and (rest.tells or not walls):
        yield Cause(
            code="constant_force",
            sentence=f"A constant force of {significant(constant.value or 0.0, 3)} {constant.unit} acts on the device.",
            evidence=f"estimated from the logs, 95 %: {_interval(constant)}",
        )
    elif rest.tells and rest.constant:
        unit = "Nm" if "rad" in units.stiffness else "N"
        yield Cause(
            code="constant_force",
            sentence=f"A constant force of about {significant(rest.typical, 2)} {unit} acts on the device.",
            evidence=rest_words(rest, unit),
        )
    both = fitted is not None and "friction" in fitted.parts
    if friction is not None and (friction.low or 0.0) > 0 and (rest.tells or not walls or both):
        also = ", and of the devices fitted to all trials the likeliest has friction" if both else ""
        yield Cause(
            code="coulomb_friction",
            sentence=friction_words(friction.value or 0.0, friction.unit, stages),
            evidence=f"estimated from the logs, 95 %: {_interval(friction)}{also}",
        )


def _part_of_a_sample(result: ExperimentResult, loop: LoopRange) -> Iterator[Cause]:
    delay = loop_delay(result)
    value = delay.value or 0.0
    part = value - round(value)
    if part and loop.effect(delay=-part) > MATTERS:
        yield Cause(
            code="fractional_delay",
            sentence=f"The delay is no whole number of samples, {significant(value, 3)}, or an actuator lag of less "
            "than a sample adds to a whole one: logs do not tell which.",
            evidence=f"model fitted to the whole response, 95 %: {_interval(delay)}",
        )


def _jitter(result: ExperimentResult, stages: ExperimentStages, loop: LoopRange) -> Iterator[Cause]:
    """Jitter of the delay: within trials, by an amount that matters, and between them.

    Friction and lag look like jitter within a trial; the first motion, which nothing but the step causes, comes after
    the same delay with them.
    """
    jitter = result.estimates.get("jitter_samples")
    if jitter is None or (jitter.low or 0.0) <= 0 or loop.effect(delay=jitter.low or 0.0) <= MATTERS:
        return
    yield Cause(
        code="delay_jitter",
        sentence=f"The delay jitters, by {significant(jitter.value or 0.0, 2)} samples within a trial.",
        evidence=f"estimated from the logs, 95 %: {_interval(jitter)}",
    )


def _gain(result: ExperimentResult, loop: LoopRange, stated_mass: float | None) -> Iterator[Cause]:
    """A gain of the actuator: a mass per unit of command that is not the one that the device file states."""
    if stated_mass is None or not explains(result):
        return
    mass = loop.mass
    outside = max(mass.low - stated_mass, stated_mass - mass.high, 0.0)
    if outside <= MATTERS * stated_mass or loop.effect(mass=stated_mass - mass.value) <= MATTERS:
        return
    change = percent_text(100 * (stated_mass / mass.value - 1))
    yield Cause(
        code="force_gain",
        sentence=f"Force per unit of command, or the stated mass, is off by {change} %.",
        evidence=f"mass by the logs {significant(mass.value, 4)} ({significant(mass.low, 4)} to "
        f"{significant(mass.high, 4)}), by the device file {significant(stated_mass, 4)}",
    )


def _sensor(stages: ExperimentStages) -> Iterator[Cause]:
    share = coarse(stages)
    if len(share) and float(np.median(share)) > MATTERS:
        yield Cause(
            code="coarse_sensor",
            sentence="The position sensor is coarse for the motions that were recorded.",
            evidence=f"its quantum is {share_text(float(np.median(share)))} % of the final displacement in the median "
            f"of {counted(len(share), 'stable trial')}",
        )


def _trials(result: ExperimentResult, stages: ExperimentStages) -> Iterator[Cause]:
    tested = stages.column("response", "stiffness") > 0
    verdict = stages.verdicts.verdict[tested]
    if result.trials < FEW:
        yield Cause(
            code="few_trials",
            sentence="There are few trials.",
            evidence=f"{counted(result.trials, 'trial')}; what differs between trials shows from {FEW} on",
        )
    tried = f"{counted(int(tested.sum()), 'trial')} at K > 0"
    unstable, stable = (int((verdict == said).sum()) for said in ("unstable", "stable"))
    if unstable > 0.5 * len(verdict) and not stable:
        yield Cause(code="no_stable_trial", sentence="No trial was stable.", evidence=tried)
    if stable > 0.5 * len(verdict) and not unstable:
        yield Cause(code="no_unstable_trial", sentence="No trial was unstable.", evidence=tried)


def _is_sure(estimate: Estimate) -> bool:
    low, high = estimate.low, estimate.high
    return estimate.value is not None and low is not None and high is not None and low * high > 0


def _interval(estimate: Estimate) -> str:
    return span(lambda value: significant(value, 4), estimate.low, estimate.high)
