"""Find the maximum-likelihood noise of a device, which consists of a random force and a jitter of the delay."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pipeline.measured.identification.likelihood import ROUNDED_ROW, WORTH, Device, columns_of
from pipeline.measured.identification.motion import Transitions
from pipeline.measured.identification.noise import WHITE, Noise
from pipeline.measured.identification.segments import Segments
from pipeline.records.trials import Floats

MEMORIES = (1e-12, 3e5)
"""Smallest and largest variance of the random force per sample, relative to the variance of a reading. The memory of
the filter is then between a thousand samples and one sample."""

JITTERS = (0.02, 1.5)
"""Smallest and largest jitter of the delay in the search [samples]. The largest jitter requires nine ages of the
applied command. If eight whole delays are equally likely, the age of the applied command has a jitter of 1.5
samples."""

FIRST_JITTERS, FIRST_FORCES = (0.08, 0.25, 0.6, 1.2), (1.0, 0.1, 1e-2, 1e-4)
"""Initial jitters [samples] of the search, and initial random forces relative to the random force without jitter."""

FORCE_ROUNDS = 2
"""Number of searches over the range of random forces. A force far below the local optimum may be more likely."""

READINGS = (1e-6, 10.0)
"""Smallest and largest variance of a reading in a search with jitter, relative to the variance from third differences.
Third differences of exact readings contain the effects of jitter, which may be 1e3 times as large."""

ROUGH = 0.7
"""Tolerance of the logarithm of a variance in a starting value. Intervals scale with the square root of a variance."""

NEAR = 0.05
"""Change of the logarithm of a variance or a jitter for which the likelihood is approximately parabolic."""

ASIDE = 0.1
"""Step of the logarithm of a variance or a jitter for numerical derivatives."""

SCORING, FARTHEST = 6, 1.5
"""Largest number of steps in the search for jitter, reading noise and random force, and largest change of a logarithm
in a step."""

ENOUGH = 0.05
"""Threshold for the gain of log-likelihood in a step. Below it, the search ends."""

OTHER_AGES = 0.08
"""Relative error of a jitter due to the unknown shape of its distribution, per sample of jitter above one half. It is
up to 0.15 for delays drawn from two to four whole values."""

LEAST_JITTER = 0.05
"""Smallest jitter [samples] that is accepted. Rounding may imitate smaller jitter."""

NOISE_SEGMENTS, NOISE_ROWS = 24, 150
"""Number of segments for the noise estimate, and largest number of rows of the parts into which they are split. The
variance from 8,000 rows has an error of 2 %."""

IMPOSSIBLE = 1e30
"""Cost, as a negative log-likelihood, of a noise for which the device cannot be computed. Any other cost is lower."""


@dataclass(frozen=True, eq=False)
class NoiseLikelihood:
    """Cost of a noise, errors of all rows (R,) divided by their standard deviations, and logarithms of these
    deviations."""

    lost: float
    errors: Floats
    log_deviations: Floats


@dataclass(eq=False)
class NoiseCost:
    """Likelihood of a device in some segments as a function of its noise, with all other numbers fixed."""

    segments: Segments
    device: Device
    _transitions: tuple[float, Transitions] | None = None

    @classmethod
    def of(cls, segments: Segments, device: Device) -> NoiseCost:
        """Return the likelihood for parts of some segments, which are spread evenly over all segments."""
        return cls(segments.subset(NOISE_SEGMENTS).split(NOISE_ROWS), device)

    @cached_property
    def white(self) -> float:
        """Variance of a reading from third differences."""
        return self.segments.white

    def __call__(self, force: float, jitter: float = 0.0, reading: float = 1.0) -> float:
        """Return the negative log-likelihood."""
        return self.likelihood(force, jitter, reading).lost

    @np.errstate(all="ignore")  # as in `likelihood.moments_of`
    def likelihood(self, force: float, jitter: float = 0.0, reading: float = 1.0) -> NoiseLikelihood:
        """Return the likelihood of a noise.

        ``force`` is as in `Noise`, and ``jitter`` is in samples. With jitter, ``reading`` is the variance of a reading,
        relative to the variance from third differences. A constant force is estimated for each segment, so that it is
        not mistaken for a random force.
        """
        some, noise = self.segments, self.noise(force, jitter, reading)
        if self._transitions is None or self._transitions[0] != jitter:
            self._transitions = (jitter, Transitions.of(some, self.device.shape, jitter))
        columns = columns_of(some, replace(self.device, noise=noise), ("force",), self._transitions[1])
        pushed, errors = columns.values.T
        squares = np.maximum(np.add.reduceat(pushed**2, columns.first), 1e-300)
        own_force = np.add.reduceat(pushed * errors, columns.first) / squares
        errors = errors - pushed * np.repeat(own_force, some.rows + columns.starts)
        rows = np.maximum(some.rows - columns.known - 1, 1)
        # jitter causes forces, whose variance is relative to the measurement noise
        left = np.add.reduceat(errors**2, columns.first)
        variance = np.full(len(some), reading * self.white) if jitter else np.maximum(left / rows, some.least)
        lost = 0.5 * float((rows * np.log(variance) + left / variance + np.log(squares)).sum()) + columns.lost
        deviations = np.log(columns.spread) + 0.5 * np.log(np.repeat(variance, some.rows))
        errors = errors / np.sqrt(np.repeat(variance, some.rows + columns.starts))
        return NoiseLikelihood(lost if np.isfinite(lost) else IMPOSSIBLE, errors, deviations)

    def noise(self, force: float, jitter: float = 0.0, reading: float = 1.0) -> Noise:
        """Return the noise with the given values."""
        command = self.device.numbers["gain"] ** 2
        return Noise(force, command / (reading * self.white) if jitter else 0.0, jitter)


def noise_and_jitter(segments: Segments, device: Device, *, jitters: bool) -> Noise:
    """Return the maximum-likelihood noise of a device, without insignificant contributions.

    The search starts at the present noise of the device. It includes jitter of the delay if ``jitters`` is true.
    """
    cost, former = NoiseCost.of(segments, device), device.noise

    def lowest(numbers: list[float]) -> tuple[list[float], float]:
        if numbers[0]:
            return _minimum(cost.likelihood, numbers, (MEMORIES, JITTERS, READINGS))
        found, lost = _minimum(lambda *near: cost.likelihood(0.0, *near), numbers[1:], (JITTERS, READINGS))
        return [0.0, *found], lost

    none = cost(0.0)
    if none >= IMPOSSIBLE:
        return WHITE
    force, by_force = _likeliest(cost, MEMORIES, 0.0 if former.jitter else former.force)
    # rounding may imitate a small random force or jitter
    still, least = (Noise(force), by_force) if by_force < none - WORTH else (WHITE, none)
    if not jitters or none - by_force <= WORTH + ROUNDED_ROW * float(cost.segments.rows.sum()):
        return still
    near = former.jitter or min(FIRST_JITTERS, key=lambda jitter: cost(0.0, jitter))
    reading = device.numbers["gain"] ** 2 / (former.late * cost.white) if former.late else 1.0
    numbers, lost = lowest([former.force if former.jitter else 0.0, near, reading])
    for _ in range(FORCE_ROUNDS if numbers[0] or not former.jitter else 0):
        tried = {
            strength: cost(strength, *numbers[1:]) for strength in (0.0, *(share * force for share in FIRST_FORCES))
        }
        strength = min(tried, key=lambda each: tried[each])
        if numbers[0] and tried[0.0] < lost + WORTH:
            strength = 0.0
        elif tried[strength] >= lost - WORTH:
            break
        numbers, lost = lowest([strength, *numbers[1:]])
    strength, jitter, reading = numbers
    return still if lost >= least - WORTH or jitter < LEAST_JITTER else cost.noise(strength, jitter, reading)


def with_jitter_error(segments: Segments, device: Device) -> Noise:
    """Return the noise of a device with the standard error of its jitter."""
    noise, cost = device.noise, NoiseCost.of(segments, device)
    reading = device.numbers["gain"] ** 2 / (noise.late * cost.white)
    lost = [cost(noise.force, noise.jitter * float(np.exp(way * NEAR)), reading) for way in range(-2, 3)]
    # The likelihood has a kink at a jitter and a delay of half a sample. The flatter side determines the error.
    bends = np.diff(lost, 2)[[0, 2]]
    bend = max(float(min(bends, key=lambda each: each if each > 0 else np.inf)), 2e-3)
    error = float(np.hypot(NEAR / np.sqrt(bend), OTHER_AGES * max(noise.jitter - 0.5, 0.0)))
    return replace(noise, jitter_error=noise.jitter * error)


def _likeliest(cost: Callable[[float], float], limits: tuple[float, float], near: float = 0.0) -> tuple[float, float]:
    """Return the approximate minimum of a cost within limits, and the cost there. Start at ``near`` if nonzero."""
    from scipy.optimize import minimize_scalar

    if limits[0] < near < limits[1]:
        low, middle, high = (cost(near * float(np.exp(way * ROUGH))) for way in (-1, 0, 1))
        if middle <= min(low, high) < IMPOSSIBLE:
            vertex = near * float(np.exp(0.5 * ROUGH * (low - high) / max(low - 2 * middle + high, 1e-12)))
            lowest = cost(vertex)
            return (vertex, lowest) if lowest < middle else (near, middle)
    bounds, options = tuple(np.log(limits).tolist()), {"xatol": ROUGH, "maxiter": 9}
    result = minimize_scalar(lambda log: cost(float(np.exp(log))), bounds=bounds, method="bounded", options=options)
    return float(np.exp(result.x)), float(result.fun)


def _minimum(
    likelihood: Callable[..., NoiseLikelihood], near: Sequence[float], limits: tuple[tuple[float, float], ...]
) -> tuple[list[float], float]:
    """Return the positive numbers within limits that have the lowest cost, and this cost. The search starts at
    ``near``.

    The method is Fisher scoring in the logarithms of the numbers. With the errors e, divided by their standard
    deviations s, the information is

        e_i' e_j + (ln s)_i' (ln s)_j          subscripts are derivatives

    Derivatives are forward differences over `ASIDE`, corrected by the information. Smaller differences would mislead
    near the kinks of the likelihood, at which the number of ages changes. If a step with forward differences does not
    lower the cost, the slope is computed from central differences.

    Source: Gupta and Mehra 1974, IEEE Transactions on Automatic Control 19, p. 774.
    """
    bounds, n = np.log(limits), len(near)
    steps = ASIDE * np.eye(n)

    def at(logs: Floats) -> tuple[Floats, NoiseLikelihood]:
        inside = np.clip(logs, bounds[:, 0], bounds[:, 1])
        return inside, likelihood(*np.exp(inside).tolist())

    here, value = at(np.clip(np.log(near), bounds[:, 0] + ASIDE, bounds[:, 1] - ASIDE))
    for _ in range(SCORING):
        ahead = [at(here + step) for step in steps]
        errors = np.array([(other.errors - value.errors) / ASIDE for _, other in ahead])
        deviations = np.array([(other.log_deviations - value.log_deviations) / ASIDE for _, other in ahead])
        information = np.nan_to_num(errors @ errors.T + deviations @ deviations.T, posinf=0.0)
        values, vectors = np.linalg.eigh(information)
        inverse = (vectors / np.maximum(values, 1.0)) @ vectors.T
        slope = np.array([other.lost - value.lost for _, other in ahead]) / ASIDE - 0.5 * ASIDE * np.diag(information)
        tried = ahead
        for one_sided in (True, False):
            if not one_sided:
                behind = [at(here - step) for step in steps]
                differences = [up.lost - down.lost for (_, up), (_, down) in zip(ahead, behind, strict=True)]
                slope, tried = np.array(differences) / (2 * ASIDE), tried + behind
            if slope @ inverse @ slope < 2 * ENOUGH:
                break
            tried = [*tried, at(here + np.clip(-inverse @ slope, -FARTHEST, FARTHEST))]
            if tried[-1][1].lost < value.lost:
                break
        best = min(tried, key=lambda each: each[1].lost)
        if (gain := value.lost - best[1].lost) <= 0:
            break
        here, value = best
        if gain < ENOUGH:
            break
    return np.exp(here).tolist(), value.lost
