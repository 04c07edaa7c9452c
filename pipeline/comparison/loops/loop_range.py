"""The parameters of a loop with their 95 % intervals, and how far changes of them move its stability limit."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pipeline.comparison.scores.theory_band import ParameterBox, theory_band
from pipeline.loop.loop import LARGEST_DELAY, Normalised
from pipeline.measured.experiment.estimates import EXPLAINED
from pipeline.measured.experiment.known_delay import whole_delay
from pipeline.records.batch import Floats
from pipeline.records.findings import Estimate
from pipeline.records.loop_records import Parameter
from pipeline.records.models import Experiment
from pipeline.records.results import ExperimentResult, TheoryParameters
from pipeline.theory.predictions import Theory
from pipeline.theory.stability.extent import stiffest_point
from pipeline.theory.stability.region import stiffness_limit

MATTERS = 0.02
"""Change of the stability limit, relative to it, that is worth a word: a course brackets a limit no closer."""

LEAST_MASS = 1e-3
"""Mass relative to the estimated one that stands for none: an interval or a change may reach below zero."""

_ALONG = np.linspace(0.0, 1.0, 6)
"""Dampings, relative to that of the stiffest wall, at which a change of the limit is looked for: beyond it the limit
falls so steeply that any change is large."""

_LOW = 0.25
"""Limit relative to the largest one below which no change is divided by it: at its ends a boundary tends to zero."""


@dataclass(frozen=True)
class LoopRange:
    """Mass [kg, kg m^2], damping [Ns/m, Nms/rad] and delay [samples] with intervals; k [N/m, Nm/rad] and T [s]."""

    mass: Parameter
    damping: Parameter
    delay_samples: Parameter
    stiffness: float
    sampling_period_s: float

    def limit(self, wall_damping: Floats, mass: float, damping: float, delay: float) -> Floats:
        """Return the largest stable stiffness [N/m, Nm/rad] at dampings B, 0 where none is, for some parameters."""
        scale = Normalised(mass, self.sampling_period_s)
        loop = scale.loop(self.stiffness, max(damping, 0.0), min(max(delay, 0.0), LARGEST_DELAY))
        return np.maximum(stiffness_limit(loop, wall_damping / scale.damping), 0.0) * scale.stiffness

    def at_values(self, wall_damping: Floats) -> Floats:
        """Return the largest stable stiffness of the loop itself."""
        return self.limit(wall_damping, self.mass.value, self.damping.value, self.delay_samples.value)

    def band(self, wall_damping: Floats) -> tuple[Floats, Floats]:
        """Return the least and the largest limit over all intervals."""
        least = LEAST_MASS * self.mass.value
        mass = max(self.mass.low, least), max(self.mass.high, least)
        damping, delay = ((max(p.low, 0.0), max(p.high, 0.0)) for p in (self.damping, self.delay_samples))
        return theory_band(ParameterBox(mass, damping, delay, self.sampling_period_s, self.stiffness), wall_damping)

    @cached_property
    def _typical(self) -> tuple[Floats, Floats]:
        """Dampings B at which changes are looked at, and the limits there."""
        scale = Normalised(self.mass.value, self.sampling_period_s)
        loop = scale.loop(self.stiffness, max(self.damping.value, 0.0), self.delay_samples.value)
        damping = _ALONG * max(stiffest_point(loop)[1], 0.0) * scale.damping
        limit = self.at_values(damping)
        some = limit > _LOW * limit.max(initial=0.0)
        return damping[some], limit[some]

    def effect(self, *, mass: float = 0.0, damping: float = 0.0, delay: float = 0.0) -> float:
        """Return the largest relative change of the limit when parameters change by these amounts."""
        where, limit = self._typical
        least = LEAST_MASS * self.mass.value
        changed = self.limit(
            where,
            max(self.mass.value + mass, least),
            self.damping.value + damping,
            self.delay_samples.value + delay,
        )
        return float(np.abs(changed / limit - 1).max(initial=0.0))


def loop_delay(result: ExperimentResult) -> Estimate:
    """Return the delay that theory takes: the model's where it explains the logs, else the integer factor.

    The model's is the whole number next to it where its interval holds that; see `known_delay.whole_delay`.
    """
    delay, check = result.estimates["delay_samples"], result.model_check
    model = delay.by_method.get("model")
    if model is None or model.value is None or check is None or not explains(result):
        return delay
    return model.model_copy(update={"value": whole_delay(model)})


def explains(result: ExperimentResult) -> bool:
    """Return whether the fitted model explains nearly all logs of an experiment."""
    check = result.model_check
    return check is not None and check.trials > 0 and check.explained >= EXPLAINED * check.trials


def estimated_range(result: ExperimentResult, sampling_period_s: float) -> LoopRange | None:
    """Return the loop by the estimates of an experiment, or None where mass, damping or delay are not known."""
    mass, damping, delay = result.estimates["mass"], result.estimates["damping"], loop_delay(result)
    if None in (mass.value, damping.value, delay.value) or (delay.value or 0.0) > LARGEST_DELAY:
        return None
    if (mass.value or 0.0) <= 0:
        return None
    return LoopRange(_parameter(mass), _parameter(damping), _parameter(delay), 0.0, sampling_period_s)


def adequate_theory(result: ExperimentResult, sampling_period_s: float, stiffness: float = 0.0) -> Theory | None:
    """Return the theory by the estimates of an experiment whose loop is adequate; None for all others.

    A damping below zero counts as zero: the theory asks for b >= 0. The stiffness k is not estimated.
    """
    if result.loop is None or not result.loop.adequate:
        return None
    loop = estimated_range(result, sampling_period_s)
    if loop is None:
        return None
    return Theory(
        TheoryParameters(
            mass=loop.mass.value,
            damping=max(loop.damping.value, 0.0),
            stiffness=stiffness,
            sampling_period_s=sampling_period_s,
            delay_samples=loop.delay_samples.value,
            source="estimated from the logs",
        )
    )


def stated_range(entry: Experiment, estimated: LoopRange | None, sampling_period_s: float) -> LoopRange | None:
    """Return the loop that a device file states, its intervals as wide as the estimates leave it in doubt."""
    if entry.delay_samples > LARGEST_DELAY:
        return None

    def hull(name: str) -> Parameter:
        value = float(getattr(entry, name))
        found = [] if estimated is None else [getattr(estimated, name)]
        low, high = min([value, *(p.low for p in found)]), max([value, *(p.high for p in found)])
        return Parameter(value=value, low=low, high=high)

    return LoopRange(hull("mass"), hull("damping"), hull("delay_samples"), entry.stiffness, sampling_period_s)


def _parameter(estimate: Estimate) -> Parameter:
    value = estimate.value or 0.0
    low, high = (value if end is None else end for end in (estimate.low, estimate.high))
    return Parameter(value=value, low=min(low, value), high=max(high, value))
