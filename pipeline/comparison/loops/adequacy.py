"""Whether the loop of an experiment may bear statements: one decision, with its reasons.

A loop is adequate where nothing that the logs show speaks against it: they obey the wall law, the fitted model explains
them, its parameters do not depend on the wall, and the measured limits are those that it predicts.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.base.wording import counted, listed
from pipeline.comparison.loops.log_evidence import OF_NO_LOOP, LawDeparture, rest_words
from pipeline.comparison.loops.loop_range import MATTERS, LoopRange, explains, loop_delay
from pipeline.comparison.loops.other_gains import OtherGains
from pipeline.comparison.scores.overlap import measured_limits
from pipeline.measured.experiment.fitted_device import FittedDevice
from pipeline.measured.experiment.rest_forces import RestForces
from pipeline.records.batch import Floats
from pipeline.records.findings import Estimate
from pipeline.records.loop_parts import LoopParts, VelocityFilter
from pipeline.records.results import ExperimentResult
from pipeline.rendering.labels import Units, percent_text, share_text, significant

SCATTER = 3.0
"""Scatter between trials, in errors of one trial, from which on the device itself differs from trial to trial."""

DISAGREE = 0.1
"""Share of the measured limits that may lie off the loop's: both have intervals of 95 %."""

FEWEST_OFF = 2
"""Limits off the loop's that are no chance."""

_LOW = 0.25
"""Limit relative to the largest one below which measured and predicted ones are not compared."""


@dataclass(frozen=True)
class Doubt:
    """What speaks against a loop, and what would help; a soft one does not where the replay is right."""

    text: str
    help: str = ""
    soft: bool = False


@dataclass(frozen=True)
class Shown:
    """What the logs show of a loop: departures from the wall law, rest, the device that explains them, the filter.

    ``of_logs`` are the filters that single logs show, ``gains`` the logs that obey another wall than stated.
    """

    departures: list[LawDeparture]
    rest: RestForces
    fitted: FittedDevice | None
    velocity: VelocityFilter | None
    of_logs: Sequence[VelocityFilter] = ()
    gains: OtherGains | None = None

    @property
    def known(self) -> set[str]:
        """Departures that the loop holds, or that concern the external force or the stamps alone."""
        found = set(OF_NO_LOOP)
        found |= {"velocity_filter"} if self.velocity is not None else set()
        return found | ({"constant_force"} if self.explained else set())

    def named(self, loop: LoopRange | None) -> bool:
        """Whether a loop has all the parts of the device that explains the logs."""
        if self.fitted is None or loop is None:
            return False
        mode = loop.parts.mode
        has = {"spring": loop.stiffness > 0, "lag": loop.parts.actuator_lag_s > 0, "saturation": True}
        has |= {f"mode at the {mode.sensor}": True} if mode else {}
        return all(has.get(part, False) for part in self.fitted.parts)

    @property
    def explained(self) -> bool:
        """Whether one device explains the logs."""
        return self.fitted is not None and self.fitted.tells


def doubts(
    result: ExperimentResult, loop: LoopRange | None, shown: Shown, parts: LoopParts | None, units: Units
) -> list[Doubt]:
    """Return what speaks against the loop of an experiment, gravest first; nothing where it is adequate.

    Parameters
    ----------
    result : ExperimentResult
        Without its loop.
    loop : LoopRange or None
        What the statements would rest on.
    shown : Shown
    parts : LoopParts or None
        What the device file of the experiment declares: parts that it does not name speak against it. None without one.
    units : Units
    """
    held = shown.known
    if parts is not None:
        held -= {"constant_force"} | (set() if parts.velocity else {"velocity_filter"})
    if shown.gains is not None and shown.gains.most:
        return [Doubt(shown.gains.cause.sentence.rstrip("."), _UNIT)]
    found = [
        Doubt(f"{each.sentence.rstrip('.')} ({each.shown})", _HELP.get(each.code, _LAW))
        for each in shown.departures
        if each.code not in held
    ]
    found += _unknown(result, loop)
    if not shown.explained or (parts is not None and not shown.named(loop)):
        declared = parts is not None and (parts.words() or parts.friction)
        found += _unexplained(result, shown.fitted, "" if declared else _PARTS)
        if shown.rest.tells:
            would_help = (
                "" if parts is not None and parts.friction else "a device file with the force or friction in it"
            )
            found.append(Doubt(rest_words(shown.rest, _force(units)), would_help))
    if shown.explained and shown.fitted is not None and shown.fitted.saturated > MATTERS:
        many = share_text(shown.fitted.saturated, 0)
        text = f"{many} % of the stable trials command more than the drive gives, which linear theory cannot hold"
        found.append(Doubt(text, "a smaller step"))
    if loop is not None and (off := loop.off) is not None:
        damping, limit, share = off
        found.append(
            Doubt(
                f"the loop that the logs show is another than that of the device file: its limit at B = "
                f"{significant(damping, 3)} {units.damping} is {percent_text(100 * share)} % off K = "
                f"{significant(limit, 3)} {units.stiffness} beyond its interval",
                "a device file with the parts and numbers that the logs show",
            )
        )
    if loop is not None:
        found += _changing(result, loop, units, parts)
        found += _disagreeing(result, loop, units)
    return found


_LAW = "log the command that the controller computes by the wall law, before filter and limit, with every row"
_PARTS = "a device file whose [loop] table names what the device has beside mass, damping and delay"
_HELP = {
    "command_shifted": "command and position of the same sample in a row; the delay is as many samples off as rows",
    "sampling_period": "the sampling period by which the stamps are apart, in the header",
    "saturation": "a smaller step, or the command before it is clipped in the log",
    "velocity_filter": "a device file that declares the filter",
    "adaptive_velocity": "a velocity over a constant number of samples, which theory can hold",
}
_UNIT = "the unit of the position, or of K, B and the step, corrected in the profile (see `pipeline profile check`)"


def _force(units: Units) -> str:
    return "Nm" if "rad" in units.stiffness else "N"


def _unknown(result: ExperimentResult, loop: LoopRange | None) -> Iterator[Doubt]:
    mass, damping = result.estimates["mass"], result.estimates["damping"]
    known = {"mass": mass, "viscous damping": damping, "delay": loop_delay(result)}
    missing: dict[str | None, list[str]] = {}
    for name, estimate in known.items():
        if estimate.value is None:
            missing.setdefault(estimate.reason, []).append(f"the {name}")
    for reason, names in missing.items():
        yield Doubt(f"{listed(names)} {'is' if len(names) == 1 else 'are'} not known ({reason})")
    if loop is None and not missing:
        yield Doubt("the mass is not positive, or the delay longer than theory is computed for")


def _unexplained(result: ExperimentResult, fitted: FittedDevice | None, would_help: str) -> Iterator[Doubt]:
    check = result.model_check
    if check is None:
        yield Doubt("no model was fitted to the logs, since nothing that was asked for needs one")
    elif not explains(result):
        what = listed(["mass", "damping", "delay", *(fitted.parts if fitted else ())])
        yield Doubt(f"{what} explain {check.explained} of {counted(check.trials, 'log')} only", would_help)


def _changing(result: ExperimentResult, loop: LoopRange, units: Units, parts: LoopParts | None) -> Iterator[Doubt]:
    """Parameters that depend on the wall or on the trial by more than the limit bears."""
    found = {
        "mass": ("mass", result.estimates["mass"]),
        "damping": ("viscous damping", result.estimates["damping"]),
        "delay": ("delay", loop_delay(result)),
    }
    for key, (name, estimate) in found.items():
        for trend in estimate.trend:
            change = trend.slope * (trend.span or 0.0)
            effect = loop.effect(**{key: change})
            if trend.significant and effect > MATTERS:
                yield Doubt(
                    f"the {name} drifts by {significant(change, 2)} {_unit(estimate)} over the tested {trend.over}, "
                    f"which moves the limit by {share_text(effect)} %"
                )
        spread, within = estimate.spread or 0.0, estimate.within or 0.0
        if spread > SCATTER * within and loop.effect(**{key: spread}) > MATTERS:
            yield Doubt(
                f"the {name} differs between trials by {significant(spread, 2)} {_unit(estimate)}, "
                f"{significant(spread / within, 2) if within else 'many'} times what one trial leaves open"
            )
    jitter = result.estimates.get("jitter_samples")
    if jitter is not None and (jitter.low or 0.0) > 0:
        effect = loop.effect(delay=jitter.low or 0.0)
        if effect > MATTERS:
            yield Doubt(
                f"the delay seems to jitter by {significant(jitter.value or 0.0, 2)} samples within a trial (or what "
                f"looks like it), which moves the limit by up to {share_text(effect)} %"
            )
    friction = result.estimates.get("friction")
    if friction is not None and (friction.low or 0.0) > 0:
        stated = parts.friction.coulomb if parts is not None and parts.friction else None
        by_file = f" ({significant(stated, 2)} by the device file)" if stated else ""
        yield Doubt(
            f"there is Coulomb friction of {significant(friction.value or 0.0, 2)} {friction.unit}{by_file}, which "
            "linear theory leaves out",
            soft=True,
        )


def _unit(estimate: Estimate) -> str:
    return estimate.unit.replace("^2", "²")


def _disagreeing(result: ExperimentResult, loop: LoopRange, units: Units) -> Iterator[Doubt]:
    """Measured limits off those of the loop by more than both intervals and `MATTERS`."""
    limits = measured_limits(result.boundary)
    known = limits.known
    if not known.any():
        return
    damping = limits.damping[known]
    value = loop.at_values(damping)
    low, high = loop.band(damping)
    some = value > _LOW * value.max(initial=0.0)
    above = np.maximum(limits.low[known] - high, 0.0)
    # a tested range that ended at a stable trial leaves the limit open upwards
    below = np.where(limits.censored[known], 0.0, np.maximum(low - limits.high[known], 0.0))
    off: Floats = np.where(some, (above - below) / np.where(some, value, 1.0), 0.0)
    far = np.abs(off) > MATTERS
    if far.sum() < FEWEST_OFF or far.sum() <= DISAGREE * some.sum():
        return
    worst = int(np.argmax(np.abs(off)))
    yield Doubt(
        f"{int(far.sum())} of {counted(int(some.sum()), 'measured limit')} lie off those of the loop, "
        f"at B = {significant(float(damping[worst]), 3)} {units.damping} by {percent_text(100 * float(off[worst]))} % "
        "beyond all intervals",
        soft=True,
    )
