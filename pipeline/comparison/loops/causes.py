"""Why an experiment deviates from the ideal loop: departures from the wall law and parts of the device, in one list."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pipeline.base.wording import counted
from pipeline.comparison.loops.departures import SENTENCES, CourseFilter, LawDeparture, OtherGains
from pipeline.comparison.loops.recording_faults import cause_of
from pipeline.comparison.loops.wall_replay import LOW, coarse
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.plan.found_device import FoundDevice, LoopPoint, Trial
from pipeline.records.findings import MATTERS, Parameter
from pipeline.records.results import Cause, CauseCode, ExperimentResult
from pipeline.rendering.labels import Units, percent_text, share_text, significant, span

FEW = 10
"""Trials below which nothing that differs between trials can be told: a share of them is known to 30 % at best."""

ALONG = np.linspace(0.0, 1.0, 6)
"""Dampings, relative to that of the stiffest wall, at which a change of the limit is looked for: beyond it the limit
falls so steeply that any change is large."""


@dataclass(frozen=True)
class Candidate:
    """A cause that may be told: ``effect`` is the largest change of a result by it, or its share of the logs."""

    code: CauseCode
    effect: float
    sentence: str
    evidence: str


@dataclass(frozen=True, eq=False)
class Shown:
    """What causes are read from: the experiment, its usual trial, departures, filter, the device that was found, and
    the error of its limits by replay, relative."""

    result: ExperimentResult
    stages: ExperimentStages
    trial: Trial
    units: Units
    departures: list[LawDeparture]
    velocity: CourseFilter | None
    gains: OtherGains | None
    found: FoundDevice | None
    stated_mass: float | None
    error: float

    @property
    def force(self) -> str:
        """Unit of a force."""
        return "Nm" if "rad" in self.units.stiffness else "N"


def causes_of(shown: Shown) -> tuple[Cause, ...]:
    """Return the causes that change a result by more than `MATTERS`: departures in the order of their logs, then parts
    of the device by what they change, then what the course itself leaves open; empty for an ideal loop."""
    first = [cause_of(each) for each in shown.result.recording if each.is_unsafe]
    first += [] if shown.gains is None or shown.gains.few else [shown.gains.cause]
    found = [*_departures(shown), *sorted(_parts(shown), key=lambda each: -each.effect), *_course(shown)]
    told: dict[str, Cause] = {cause.code: cause for cause in first}
    for each in found:
        if each.effect > MATTERS and each.code not in told:
            told[each.code] = Cause(code=each.code, sentence=each.sentence, evidence=each.evidence)
    return tuple(told.values())


UNNAMED = {"other_wall", "other_unit", "unknown"}
"""Departures that are no cause: what they are is not known, or `other_gains` names it."""


def _departures(shown: Shown) -> Iterator[Candidate]:
    for each in shown.departures:
        sentence = SENTENCES[each.code]
        if each.code == "velocity_filter":
            # a controller filters the velocity in all trials or in none; single logs can imitate it
            if not each.most or shown.velocity is None:
                continue
            sentence = f"The velocity of the wall law {shown.velocity.words}."
        if each.code not in UNNAMED:
            yield Candidate(each.code, each.logs / each.of, sentence, each.shown)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Part:
    """A part of a device as a cause: code, the number that tells most, its unit in SI, and the sentence.

    ``over`` is what its number moves the rest position relative to: the step's force or the softest wall's stiffness.
    """

    code: CauseCode
    number: str
    sentence: str
    over: str = ""
    unit: float = 1.0


PARTS = {
    "friction": Part(
        "coulomb_friction", "coulomb", "The device has Coulomb friction of {value} {force}{more}.", "step"
    ),
    "lag": Part(
        "actuator_lag", "actuator_lag_s", "The force lags the command by a time constant of {value} ms{more}.", "", 1e3
    ),
    "spring": Part(
        "operator", "stiffness", "A spring of {value} {stiffness} holds the device: a hand, or its own.", "wall"
    ),
    "force": Part(
        "constant_force", "constant_force", "A constant force of {value} {force} acts on the device.", "step"
    ),
    "saturation": Part(
        "saturation", "force_limit", "The drive gives no more than {value} {force}, whatever is commanded."
    ),
    "mode": Part("vibration_mode", "frequency_hz", "The device vibrates at {value} Hz, as seen by a sensor {at}."),
}


def _parts(shown: Shown) -> Iterator[Candidate]:
    """Yield the parts of the found device, and numbers that it would share with another one."""
    found = shown.found
    if found is None:
        return
    fitted, values = found.fitted, found.fitted.values
    force = fitted.parameter("constant_force")
    known = force is not None and not fitted.why_unknown("constant_force")
    beside = ["force"] if force is not None and known and force.low * force.high > 0 else []
    stable = shown.stages.column("response", "stiffness")[shown.stages.verdicts.verdict == "stable"]
    least = {"step": abs(shown.trial.step) or np.inf, "wall": float(stable[stable > 0].min(initial=np.inf)), "": np.inf}
    for name in dict.fromkeys([*fitted.parts, *beside]):
        kind, _, at = name.partition(" ")
        if (part := PARTS.get(kind)) is None or fitted.why_unknown(part.number):
            continue
        number, rest = fitted.with_interval(part.number), abs(values[part.number]) / least[part.over]
        left = {key: value for key, value in values.items() if kind != "mode" or key != "far_mass"}
        left |= {part.number: 0.0} if kind != "mode" else {}
        effect, change = _beside(found.point, found.at(left), shown)
        if kind == "saturation":
            effect, change = fitted.saturated, f"{share_text(fitted.saturated)} % of the stable trials command more"
        elif rest > effect:
            effect, change = rest, f"{significant(100 * rest, 2)} % of the final displacement at most"
        more = _held(number.value, shown.trial.step) if kind == "friction" else ""
        if kind == "lag" and "delay_samples" in fitted.bounds:
            more = ", or a fast mode vibrates and the delay is longer by as much: logs do not tell which"
        words = {"value": significant(part.unit * number.value, 3), "stiffness": shown.units.stiffness, "at": at}
        words |= {"force": shown.force, "more": more}
        ends = span(lambda value: significant(value, 4), part.unit * number.low, part.unit * number.high)
        yield Candidate(part.code, effect, part.sentence.format(**words), f"95 %: {ends}; {change}")
    yield from _shared(shown, found)


def _held(coulomb: float, step: float) -> str:
    """Return what friction does where it is more than half the usual settling band, 2 %."""
    if not step or abs(coulomb) <= MATTERS * abs(step):
        return ""
    return f", {share_text(coulomb / abs(step), 0)} % of the step: it rests off target, and settling times show that"


def _beside(point: LoopPoint, other: LoopPoint, shown: Shown) -> tuple[float, str]:
    """Return how far limits of two devices are apart where they differ most for their size, and both in words."""
    where = np.unique(np.concatenate([ALONG * each.damping_of_stiffest for each in (point, other)]))
    own, others = point.limit(where), other.limit(where)
    if point.coulomb != other.coulomb:  # for the step: to large motions friction is none
        own = np.maximum(np.nan_to_num(point.step_limits(where, shown.trial, np.zeros(len(where)))[0]), own)
    larger = np.maximum(own, others)
    some = larger > LOW * larger.max(initial=0.0)
    apart = np.divide(np.abs(own - others), larger, out=np.zeros(len(where)), where=some)
    if not some.any():
        return 0.0, ""
    place = int(np.argmax(apart))
    K, B = shown.units.stiffness, shown.units.damping
    text = f"limit at B = {significant(where[place], 3)} {B}, for example: K = {significant(own[place], 3)} {K} "
    return float(apart[place]), f"{text}with it, {significant(others[place], 3)} without"


def _shared(shown: Shown, found: FoundDevice) -> Iterator[Candidate]:
    """Yield a delay that is no whole number, jitter, and a mass that is not the stated one."""
    point, delay, mass = found.point, found.fitted.with_interval("delay_samples"), found.fitted.with_interval("mass")
    part = delay.value - round(delay.value)
    jitter = list(_jitter(shown, point))
    yield from jitter
    if not (jitter or point.parts.actuator_lag_s or abs(part) <= delay.high - delay.value):
        effect, _ = _beside(point, replace(point, delay_samples=delay.value - part), shown)
        yield Candidate(
            "fractional_delay",
            effect * (effect > shown.error),
            f"The delay is no whole number of samples, {significant(delay.value, 3)}, or an actuator lag of less than "
            "a sample adds to a whole one: logs do not tell which.",
            f"by the likelihood of all trials, 95 %: {_span(delay)}",
        )
    stated = shown.stated_mass
    if stated is not None and max(mass.low - stated, stated - mass.high) > MATTERS * stated:
        change = percent_text(100 * (stated / mass.value - 1))
        yield Candidate(
            "force_gain",
            _beside(point, replace(point, mass=stated), shown)[0],
            f"Force per unit of command, or the stated mass, is off by {change} %.",
            f"mass by the logs {significant(mass.value, 4)} ({_span(mass)}), by the device file "
            f"{significant(stated, 4)}",
        )


def _jitter(shown: Shown, point: LoopPoint) -> Iterator[Candidate]:
    """Yield jitter of the delay within trials."""
    jitter = shown.result.estimates.get("jitter_samples")
    if jitter is not None and (jitter.low or 0.0) > 0:
        yield Candidate(
            "delay_jitter",
            _beside(point, replace(point, delay_samples=point.delay_samples + (jitter.low or 0.0)), shown)[0],
            f"The delay jitters within a trial: standard deviation {significant(jitter.value or 0.0, 2)} samples.",
            f"95 %: {span(lambda value: significant(value, 2), jitter.low, jitter.high)} samples",
        )


def _course(shown: Shown) -> Iterator[Candidate]:
    """Yield what the trials themselves leave open."""
    stages, result, share = shown.stages, shown.result, coarse(shown.stages)
    middle = float(np.median(share)) if len(share) else 0.0
    yield Candidate(
        "coarse_sensor",
        middle,
        "The position sensor is coarse for the motions that were recorded.",
        f"its quantum is {share_text(middle)} % of the final displacement in the median of "
        f"{counted(len(share), 'stable trial')}",
    )
    yield Candidate(
        "few_trials",
        float(result.trials < FEW),
        "There are few trials.",
        f"{counted(result.trials, 'trial')}; what differs between trials shows from {FEW} on",
    )
    verdict = stages.verdicts.verdict[stages.column("response", "stiffness") > 0]
    counts = {said: int((verdict == said).sum()) for said in ("stable", "unstable")}
    for none, other in (("stable", "unstable"), ("unstable", "stable")):
        yield Candidate(
            "no_stable_trial" if none == "stable" else "no_unstable_trial",
            float(not counts[none] and counts[other] > 0.5 * len(verdict)),
            f"No trial was {none}.",
            f"{counted(len(verdict), 'trial')} at K > 0",
        )


def _span(number: Parameter) -> str:
    return span(lambda value: significant(value, 4), number.low, number.high)
