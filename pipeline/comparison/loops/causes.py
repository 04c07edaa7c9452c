"""List the causes of deviations from the ideal loop, which are departures from the wall law and parts of the device."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pipeline.base.wording import counted
from pipeline.comparison.loops.departures import SENTENCES, CourseFilter, LawDeparture, OtherGains
from pipeline.comparison.loops.loop_basis import LoopBasis
from pipeline.comparison.loops.recording_faults import cause_of
from pipeline.comparison.loops.wall_replay import LOW, coarse
from pipeline.device.loop import Loop
from pipeline.device.parameters import PARAMETERS, Motion
from pipeline.loop.normalised_loop import LARGEST_DELAY
from pipeline.measured.experiment.identified_loop import IdentifiedLoop
from pipeline.measured.identification.intervals import Interval
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.planning.loop_limits import StepTrial, damping_of_stiffest, linear_limits, step_limits
from pipeline.records.findings import MATTERS, Estimate
from pipeline.records.results import Cause, CauseCode, MeasuredExperiment
from pipeline.records.trials import Floats
from pipeline.rendering.labels import Units, percent_text, share_text, significant, span

FEW = 10
"""Smallest number of trials for which differences between trials are reported. With fewer, their share is uncertain by
more than 30 %."""

ALONG = np.linspace(0.0, 1.0, 6)
"""Dampings, relative to that of the stiffest wall, at which changes in the limit are evaluated.

At larger dampings the limit decreases so steeply that any change is large.
"""


Candidate = tuple[float, Cause]
"""Possible cause, with the largest change that it causes in a result, or the share of logs that show it."""


@dataclass(frozen=True, eq=False)
class LoopEvidence:
    """Input for the search of causes.

    It has the experiment, its usual trial, departures, velocity filter, other gains, the loop if there is one, the loop
    of the device file, and the delay of the logs.
    """

    result: MeasuredExperiment
    stages: ExperimentStages
    trial: StepTrial
    units: Units
    departures: list[LawDeparture]
    velocity: CourseFilter | None
    gains: OtherGains | None
    basis: LoopBasis | None
    stated: Loop | None
    delay: Estimate

    @property
    def motion(self) -> Motion:
        """Kind of motion, which determines the units."""
        return self.stages.motion


def causes_of(evidence: LoopEvidence) -> tuple[Cause, ...]:
    """Return the causes that change a result by more than `MATTERS`.

    Departures are listed first, by number of logs, then parts of the device by their effect, then gaps in the tested
    walls. The tuple is empty for an ideal loop.
    """
    first = [cause_of(each) for each in evidence.result.recording if each.is_unsafe]
    first += [] if evidence.gains is None or evidence.gains.few else [evidence.gains.cause]
    parts = sorted(_parts(evidence), key=lambda candidate: -candidate[0])
    found = [*_departures(evidence), *parts, *_course(evidence)]
    causes = [*first, *(cause for effect, cause in found if effect > MATTERS)]
    by_code: dict[str, Cause] = {}
    for cause in causes:
        by_code.setdefault(cause.code, cause)
    return tuple(by_code.values())


def _candidate(code: CauseCode, effect: float, sentence: str, evidence: str) -> Candidate:
    return effect, Cause(code=code, sentence=sentence, evidence=evidence)


UNNAMED = {"other_wall", "other_unit", "unknown"}
"""Departures that are not reported as causes, because their nature is unknown or `other_gains` reports them."""


def _departures(evidence: LoopEvidence) -> Iterator[Candidate]:
    for each in evidence.departures:
        sentence = SENTENCES[each.code]
        if each.code == "velocity_filter":
            # A controller filters the velocity in all trials or in none. Single logs can imitate a filter.
            if not each.most or evidence.velocity is None:
                continue
            sentence = f"The velocity of the wall law {evidence.velocity.words}."
        if each.code not in UNNAMED:
            yield _candidate(each.code, each.logs / each.of, sentence, each.shown)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Part:
    """Part of a device as a cause, with a code, the name of its main parameter in `PARAMETERS`, and a sentence.

    ``over`` is the reference for the shift of the rest position by the parameter. It is the force of the step or the
    stiffness of the softest wall. ``scale`` and ``unit`` override those of `PARAMETERS`.
    """

    code: CauseCode
    number: str
    sentence: str
    over: str = ""
    scale: float = 1.0
    unit: str = ""


PARTS = {
    "friction": Part(
        "coulomb_friction", "friction.coulomb", "The device has Coulomb friction of {value}{more}.", "step"
    ),
    "lag": Part(
        "actuator_lag",
        "actuator_lag_s",
        "The force lags the command with a time constant of {value}{more}.",
        scale=1e3,
        unit="ms",
    ),
    "spring": Part(
        "operator",
        "stiffness",
        "A spring of {value} acts on the device. It may be a hand or part of the device.",
        "wall",
    ),
    "force": Part("constant_force", "constant_force", "A constant force of {value} acts on the device.", "step"),
    "saturation": Part("saturation", "force_limit", "The drive is limited to {value}."),
    "mode": Part("vibration_mode", "mode.frequency_hz", "The device vibrates at {value}, as seen by a sensor {at}."),
}


def _parts(evidence: LoopEvidence) -> Iterator[Candidate]:
    """Yield the parts of the identified loop, and parameters that any loop has."""
    basis = evidence.basis
    device = basis.identified if basis is not None else None
    if basis is None or device is None:
        return
    is_known = "constant_force" in device.values and not device.why_unknown("constant_force")
    force = device.interval("constant_force") if is_known else None
    more_parts = ["force"] if force is not None and force.low * force.high > 0 else []
    stable = evidence.stages.column("response", "stiffness")[evidence.stages.verdicts.verdict == "stable"]
    wall = float(stable[stable > 0].min(initial=np.inf))
    least = {"step": abs(evidence.trial.step) or np.inf, "wall": wall, "": np.inf}
    for name in dict.fromkeys([*device.parts, *more_parts]):
        if (part := PARTS.get(name)) is None or device.why_unknown(part.number):
            continue
        number, rest = device.interval(part.number), abs(device.values[part.number]) / least[part.over]
        effect, change = _limit_change(device.loop, _without(device, name), evidence)
        if name == "saturation":
            effect, change = (
                device.saturated,
                f"{share_text(device.saturated)} % of the stable trials command a larger force",
            )
        elif rest > effect:
            effect, change = rest, f"{significant(100 * rest, 2)} % of the final displacement at most"
        more = _rest_off_target(number.value, evidence.trial.step) if name == "friction" else ""
        if name == "lag" and "delay_samples" in device.bounds:
            more = ", or there is a fast mode and the delay is longer by this time (not distinguishable by logs)"
        unit = part.unit or PARAMETERS[part.number].unit(evidence.motion)
        value = f"{significant(part.scale * number.value, 3)} {unit}"
        sentence = part.sentence.format(value=value, more=more, at=f"at the {device.mode_sensor}")
        ends = span(lambda value: significant(value, 4), part.scale * number.low, part.scale * number.high)
        yield _candidate(part.code, effect, sentence, f"95 %: {ends}; {change}")
    yield from _shared(evidence, basis, device)


def _without(device: IdentifiedLoop, part: str) -> Loop:
    """Return the identified loop without one of its parts."""
    if part == "mode":
        return device.at({name: value for name, value in device.values.items() if PARAMETERS[name].part != "mode"})
    return device.at({**device.values, PARTS[part].number: 0.0})


def _rest_off_target(coulomb: float, step: float) -> str:
    """Return a clause on the effect of friction if it exceeds half the usual settling band, 2 %."""
    if not step or abs(coulomb) <= MATTERS * abs(step):
        return ""
    return f", {share_text(coulomb / abs(step), 0)} % of the step; it affects rest positions and settling times"


def _limit_change(loop: Loop, other: Loop, evidence: LoopEvidence) -> tuple[float, str]:
    """Return the largest relative difference between the limits of two devices, and a text with both limits."""
    where = np.unique(np.concatenate([ALONG * damping_of_stiffest(each) for each in (loop, other)]))
    limits, others = linear_limits(loop, where), linear_limits(other, where)
    if loop.value("friction.coulomb") != other.value("friction.coulomb"):  # for large motions friction is negligible
        limits = np.maximum(np.nan_to_num(step_limits(loop, where, evidence.trial, np.zeros(len(where)))[0]), limits)
    larger = np.maximum(limits, others)
    some = larger > LOW * larger.max(initial=0.0)
    apart = np.divide(np.abs(limits - others), larger, out=np.zeros(len(where)), where=some)
    if not some.any():
        return 0.0, ""
    place = int(np.argmax(apart))
    K, B = evidence.units.stiffness, evidence.units.damping
    text = f"limit at B = {significant(where[place], 3)} {B}, for example: K = {significant(limits[place], 3)} {K} "
    return float(apart[place]), f"{text}with it, {significant(others[place], 3)} without"


def _shared(evidence: LoopEvidence, basis: LoopBasis, device: IdentifiedLoop) -> Iterator[Candidate]:
    """Yield a non-integer delay, jitter, and a mass that differs from that of the device file."""
    loop, delay, mass = device.loop, device.interval("delay_samples"), device.interval("mass")
    part = delay.value - round(delay.value)
    jitter = list(_jitter(evidence, device))
    yield from jitter
    if not (jitter or loop.actuator_lag_s or abs(part) <= delay.high - delay.value):
        effect, _ = _limit_change(loop, loop.replace({"delay_samples": max(delay.value - part, 0.0)}), evidence)
        yield _candidate(
            "fractional_delay",
            effect * (effect > basis.error),
            f"The delay is not an integer, {significant(delay.value, 3)} samples, or an actuator lag of less than a "
            "sample adds to an integer delay (not distinguishable by logs).",
            f"likelihood of all trials, 95 %: {_span(delay)}",
        )
    stated = basis.loop.mass if basis.nominal is not None else None
    if stated is not None and max(mass.low - stated, stated - mass.high) > MATTERS * stated:
        change = percent_text(100 * (stated / mass.value - 1))
        yield _candidate(
            "force_gain",
            _limit_change(loop, device.at({**device.values, "mass": stated}), evidence)[0],
            f"Force per unit of command, or the stated mass, deviates by {change} %.",
            f"mass from the logs {significant(mass.value, 4)} ({_span(mass)}), by the device file "
            f"{significant(stated, 4)}",
        )


def _jitter(evidence: LoopEvidence, device: IdentifiedLoop) -> Iterator[Candidate]:
    """Yield the jitter of the delay within trials."""
    jitter = evidence.result.estimates.get("jitter_samples")
    if jitter is not None and (jitter.low or 0.0) > 0:
        later = device.values["delay_samples"] + (jitter.low or 0.0)
        effect, _ = _limit_change(device.loop, device.at({**device.values, "delay_samples": later}), evidence)
        dampings = np.array([point.damping for point in evidence.result.boundary])
        yield effect, jitter_cause(jitter, evidence.delay, evidence.stated, dampings)


def jitter_cause(jitter: Estimate, delay: Estimate, stated: Loop | None, dampings: Floats) -> Cause:
    """Return a jittering delay as a cause. It is compared with the constant delay of the device file if the two
    disagree.

    Parameters
    ----------
    jitter, delay : Estimate
        Standard deviation of the delay within a trial, and delay of the logs [samples].
    stated : Loop or None
        Loop of the device file.
    dampings : float64, shape (n,)
        Tested dampings [Ns/m, Nms/rad]. The sentence states the median change in the theoretical limits at these
        dampings if the delay of the logs is used.
    """
    interval = f"95 %: {span(lambda value: significant(value, 2), jitter.low, jitter.high)} samples"
    change = None if stated is None else _delay_effect(delay, stated.apparent(), dampings)
    if stated is None or change is None or delay.value is None:
        sentence = (
            f"The delay jitters within a trial: standard deviation {significant(jitter.value or 0.0, 2)} samples."
        )
        return Cause(code="delay_jitter", sentence=sentence, evidence=interval)
    sentence = (
        f"The delay jitters and acts like {significant(delay.value, 3)} samples, theory uses "
        f"{significant(stated.delay_samples, 3)}: this changes limits by {percent_text(100 * change)} %."
    )
    return Cause(code="delay_jitter", sentence=sentence, evidence=f"standard deviation of the jitter, {interval}")


def _delay_effect(delay: Estimate, stated: Loop, dampings: Floats) -> float | None:
    """Return the median relative change in the limits if the delay of the logs is used, or None if it agrees with the
    stated delay."""
    if delay.value is None or delay.low is None or delay.high is None or stated.delay_samples > LARGEST_DELAY:
        return None
    constant = linear_limits(stated, dampings)
    if delay.low <= stated.delay_samples <= delay.high or not (constant > 0).any():
        return None
    jittering = linear_limits(replace(stated, delay_samples=delay.value, jitter_samples=()), dampings)
    return float(np.median(jittering[constant > 0] / constant[constant > 0])) - 1


def _course(evidence: LoopEvidence) -> Iterator[Candidate]:
    """Yield the causes that lie in the choice of trials."""
    stages, result, share = evidence.stages, evidence.result, coarse(evidence.stages)
    middle = float(np.median(share)) if len(share) else 0.0
    yield _candidate(
        "coarse_sensor",
        middle,
        "The position sensor is coarse for the recorded motions.",
        f"its resolution is {share_text(middle)} % of the final displacement in the median of "
        f"{counted(len(share), 'stable trial')}",
    )
    yield _candidate(
        "few_trials",
        float(result.trials < FEW),
        "There are few trials.",
        f"{counted(result.trials, 'trial')}; differences between trials need at least {FEW}",
    )
    verdict = stages.verdicts.verdict[stages.column("response", "stiffness") > 0]
    counts = {said: int((verdict == said).sum()) for said in ("stable", "unstable")}
    for none, other in (("stable", "unstable"), ("unstable", "stable")):
        yield _candidate(
            "no_stable_trial" if none == "stable" else "no_unstable_trial",
            float(not counts[none] and counts[other] > 0.5 * len(verdict)),
            f"No trial was {none}.",
            f"{counted(len(verdict), 'trial')} at K > 0",
        )


def _span(number: Interval) -> str:
    return span(lambda value: significant(value, 4), number.low, number.high)
