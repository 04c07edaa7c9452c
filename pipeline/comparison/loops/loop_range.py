"""The parameters of a loop with their 95 % intervals, and how far changes of them move its stability limit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pipeline.comparison.loops.loop_record import parts_of
from pipeline.comparison.scores.theory_band import ParameterBox, theory_band
from pipeline.loop.device_loop import loop_of, wall_units
from pipeline.loop.loop import LARGEST_DELAY, Loop
from pipeline.measured.experiment.known_delay import whole_delay
from pipeline.measured.explained import holds
from pipeline.records.batch import Floats
from pipeline.records.findings import Estimate
from pipeline.records.loop_parts import LoopParts
from pipeline.records.loop_records import Parameter
from pipeline.records.models import Experiment
from pipeline.records.results import ExperimentResult, TheoryParameters
from pipeline.theory.limits import boundary, stabilises, stiffness_limit
from pipeline.theory.predictions import Theory

MATTERS = 0.02
"""Change of the stability limit, relative to it, that is worth a word: a course brackets a limit no closer."""

LEAST_MASS = 1e-3
"""Mass relative to the estimated one that stands for none: an interval or a change may reach below zero."""

_ALONG = np.linspace(0.0, 1.0, 6)
"""Dampings, relative to that of the stiffest wall, at which a change of the limit is looked for: beyond it the limit
falls so steeply that any change is large."""

_OUTLINE = 60
"""Points of an outline by which the stiffest wall is found: the limit is flat there."""

IDEAL = LoopParts()

_LOW = 0.25
"""Limit relative to the largest one below which no change is divided by it: at its ends a boundary tends to zero."""


@dataclass(frozen=True)
class LoopPoint:
    """One loop: m [kg, kg m^2], b [Ns/m, Nms/rad], delay [samples], k [N/m, Nm/rad], T [s], and its other parts."""

    mass: float
    damping: float
    delay_samples: float
    stiffness: float
    sampling_period_s: float
    parts: LoopParts = IDEAL

    @property
    def loop(self) -> Loop:
        """Normalised; a damping, delay or stiffness below zero counts as zero."""
        damping, stiffness = max(self.damping, 0.0), max(self.stiffness, 0.0)
        delay = min(max(self.delay_samples, 0.0), LARGEST_DELAY)
        return loop_of(self.mass, damping, stiffness, delay, self.sampling_period_s, self.parts)

    def limit(self, wall_damping: Floats) -> Floats:
        """Return the largest stable stiffness [N/m, Nm/rad] at dampings B, 0 where none is."""
        scale = wall_units(self.mass, self.sampling_period_s, self.parts)
        return np.maximum(stiffness_limit(self.loop, wall_damping / scale.damping), 0.0) * scale.stiffness

    @property
    def stiffest(self) -> float:
        """Damping B [Ns/m, Nms/rad] of the stiffest stable wall; 0 where there is none."""
        loop = self.loop
        damping = max(0.0, boundary(loop, _OUTLINE).beta_at_alpha_max) if stabilises(loop) else 0.0
        return damping * wall_units(self.mass, self.sampling_period_s, self.parts).damping


@dataclass(frozen=True)
class LoopRange:
    """Mass [kg, kg m^2], damping [Ns/m, Nms/rad] and delay [samples] with intervals; k [N/m, Nm/rad] and T [s].

    ``parts`` are what else it has. Where all of its numbers were fitted together, ``apart`` holds the loops at both
    ends of each principal axis of their 95 % range. Where they are ``stated`` by a device file, its limits reach to
    those of the loop that the logs have ``shown``. ``held`` is the part of the damping that an operator has.
    """

    mass: Parameter
    damping: Parameter
    delay_samples: Parameter
    stiffness: float
    sampling_period_s: float
    parts: LoopParts = IDEAL
    apart: tuple[tuple[LoopPoint, LoopPoint], ...] = ()
    stated: bool = False
    shown: LoopRange | None = None
    held: float = 0.0

    @property
    def point(self) -> LoopPoint:
        """The loop itself."""
        values = (self.mass.value, self.damping.value, self.delay_samples.value)
        return LoopPoint(*values, self.stiffness, self.sampling_period_s, self.parts)

    def at_values(self, wall_damping: Floats) -> Floats:
        """Return the largest stable stiffness of the loop itself."""
        return self.point.limit(wall_damping)

    def band(self, wall_damping: Floats) -> tuple[Floats, Floats]:
        """Return the least and the largest limit over all intervals."""
        middle = self.at_values(wall_damping)
        if self.stated:
            low, high = (middle, middle) if self.shown is None else self.shown.band(wall_damping)
            return np.minimum(low, middle), np.maximum(high, middle)
        if self.apart:
            off = [[end.limit(wall_damping) - middle for end in both] for both in self.apart]
            largest = [np.maximum(*np.abs(both)) for both in off]
            reach = np.sqrt(np.sum(np.square(largest), axis=0))
            return np.maximum(middle - reach, 0.0), middle + reach
        least = LEAST_MASS * self.mass.value
        mass = max(self.mass.low, least), max(self.mass.high, least)
        damping, delay = ((max(p.low, 0.0), max(p.high, 0.0)) for p in (self.damping, self.delay_samples))
        box = ParameterBox(mass, damping, delay, self.sampling_period_s, self.stiffness, self.parts)
        return theory_band(box, wall_damping)

    @cached_property
    def _typical(self) -> tuple[Floats, Floats]:
        """Dampings B at which changes are looked at, and the limits there."""
        damping = _ALONG * self.point.stiffest
        limit = self.at_values(damping)
        some = limit > _LOW * limit.max(initial=0.0)
        return damping[some], limit[some]

    def effect(self, *, mass: float = 0.0, damping: float = 0.0, delay: float = 0.0) -> float:
        """Return the largest relative change of the limit when parameters change by these amounts."""
        where, limit = self._typical
        here, least = self.point, LEAST_MASS * self.mass.value
        changed = replace(
            here,
            mass=max(here.mass + mass, least),
            damping=here.damping + damping,
            delay_samples=here.delay_samples + delay,
        )
        return float(np.abs(changed.limit(where) / limit - 1).max(initial=0.0))

    def beside(self, other: LoopPoint) -> tuple[float, float, float]:
        """Return damping B and limits of this and of another loop where they differ most for their size."""
        where = np.concatenate([_ALONG * self.point.stiffest, _ALONG * other.stiffest])
        own, others = self.at_values(where), other.limit(where)
        larger = np.maximum(own, others)
        some = larger > _LOW * larger.max(initial=0.0)
        if not some.any():
            return 0.0, 0.0, 0.0
        place = int(np.argmax(np.where(some, np.abs(own - others) / np.where(some, larger, 1.0), 0.0)))
        return float(where[place]), float(own[place]), float(others[place])

    @property
    def off(self) -> tuple[float, float, float] | None:
        """Damping B, limit there, and share of it by which it is off all that the logs leave open; None where near."""
        if self.shown is None:
            return None
        where, limit = self._typical
        low, high = self.shown.band(where)
        share = np.maximum(np.maximum(low / limit - 1, 1 - high / limit), 0.0)
        place = int(np.argmax(share)) if len(share) else 0
        if not len(share) or share[place] <= MATTERS:
            return None
        return float(where[place]), float(limit[place]), float(np.copysign(share[place], high[place] - limit[place]))


def loop_delay(result: ExperimentResult) -> Estimate:
    """Return the delay that theory takes: the model's where it explains the logs, else the integer factor.

    The model's is the whole number next to it where its interval holds that; see `known_delay.whole_delay`. Where a
    device is fitted to all trials, it is that one's.
    """
    delay, check = result.estimates["delay_samples"], result.model_check
    if "ladder" in delay.by_method:
        return delay.by_method["ladder"]
    model = delay.by_method.get("model")
    if model is None or model.value is None or check is None or not explains(result):
        return delay
    return model.model_copy(update={"value": whole_delay(model)})


def explains(result: ExperimentResult) -> bool:
    """Return whether the fitted model explains nearly all logs of an experiment."""
    check = result.model_check
    return check is not None and holds(check.explained, check.trials)


def estimated_range(result: ExperimentResult, sampling_period_s: float) -> LoopRange | None:
    """Return the loop by the estimates of an experiment, or None where mass, damping or delay are not known."""
    mass, damping, delay = result.estimates["mass"], result.estimates["damping"], loop_delay(result)
    if None in (mass.value, damping.value, delay.value) or (delay.value or 0.0) > LARGEST_DELAY:
        return None
    if (mass.value or 0.0) <= 0:
        return None
    return LoopRange(_parameter(mass), _parameter(damping), _parameter(delay), 0.0, sampling_period_s)


def adequate_theory(result: ExperimentResult, sampling_period_s: float) -> Theory | None:
    """Return the theory by the estimates of an experiment whose loop is adequate and has stable walls, else None.

    A damping below zero counts as zero: the theory asks for b >= 0. Parts that a device file declares are in it, and
    its stiffness where the estimates have none.
    """
    if result.loop is None or not result.loop.adequate or result.loop.has_friction:
        return None
    loop = estimated_range(result, sampling_period_s)
    if loop is None:
        return None
    fitted = "ladder" in result.estimates["delay_samples"].by_method
    delay, stiffness, parts = loop.delay_samples.value, 0.0, parts_of(result.loop)
    if result.loop.source == "device file" and (p := result.theory) is not None:
        _, _, stiffness, parts = p.loop.felt(p.mass, p.damping, p.stiffness)
        # to a model that has none a lag is a delay
        delay -= 0.0 if fitted else parts.actuator_lag_s / sampling_period_s
    spring = result.estimates.get("device_stiffness") if fitted else None
    theory = Theory(
        TheoryParameters(
            mass=loop.mass.value,
            damping=max(loop.damping.value, 0.0),
            stiffness=max(spring.value or 0.0, 0.0) if spring is not None else stiffness,
            sampling_period_s=sampling_period_s,
            delay_samples=max(delay, 0.0),
            loop=parts,
            source="estimated from the logs",
        )
    )
    return theory if theory.stabilised else None


def stated_range(
    entry: Experiment, parts: LoopParts, estimated: LoopRange | None, sampling_period_s: float
) -> LoopRange | None:
    """Return the loop that a device file states, its intervals as wide as the estimates leave it in doubt.

    A filter, a lag or a mode is as stated; the limits then reach to those of the loop that the logs show.
    """
    if entry.delay_samples > LARGEST_DELAY:
        return None
    mass, damping, stiffness, left = parts.felt(entry.mass, entry.damping, entry.stiffness)
    left = left.model_copy(update={"friction": None})
    # to a loop that has no lag it is a delay
    lags = [each.actuator_lag_s / sampling_period_s for each in (left, estimated.parts if estimated else left)]

    def hull(value: float, name: str, off: float = 0.0) -> Parameter:
        found = [] if estimated is None else [getattr(estimated, name)]
        low, high = min([value, *(p.low - off for p in found)]), max([value, *(p.high - off for p in found)])
        return Parameter(value=value, low=low, high=high)

    return LoopRange(
        hull(mass, "mass"),
        hull(damping, "damping"),
        hull(entry.delay_samples, "delay_samples", lags[0] - lags[1]),
        stiffness,
        sampling_period_s,
        left,
        shown=None if left == IDEAL else estimated,
        held=parts.operator.damping / parts.force_gain if parts.operator else 0.0,
        stated=left != IDEAL,
    )


def _parameter(estimate: Estimate) -> Parameter:
    value = estimate.value or 0.0
    low, high = (value if end is None else end for end in (estimate.low, estimate.high))
    return Parameter(value=value, low=min(low, value), high=max(high, value))
