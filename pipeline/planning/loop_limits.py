"""Compute stability limits of a loop, both for its linear motion and for a step with friction or jitter."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.device.loop import Loop
from pipeline.device.parts import Sensor
from pipeline.loop.normalised_loop import LoopUnits, NormalisedLoop
from pipeline.measured.experiment.identified_loop import IdentifiedLoop
from pipeline.measured.signal.verdict import judge
from pipeline.records.trials import Floats, Integers, Trials
from pipeline.simulation.setup import Setup
from pipeline.simulation.simulate import delays_of, simulate
from pipeline.theory.boundary import boundary, stabilises, stiffness_limit

LONGEST = 2000
"""Number of samples of a simulated log.

If the motion neither grows nor decays within these samples, the wall is at the limit, within the resolution of a log.
"""

BEYOND = 1.5
"""Range above the linear limit in which the limit for a step is searched for, relative to the largest linear limit.

Friction of a tenth of the step doubles a limit.
"""

WALLS, ROUNDS = 17, 3
"""Number of walls in each round between a stable and an unstable wall. Three rounds resolve a limit to 1/2700 of the
largest limit."""

DIGITS = 9
"""Significant digits of simulated walls. The rounding error is far below the accuracy of a limit."""

DIRECTIONS = 24
"""Number of random directions, in addition to the axes, in which the range of consistent devices is searched for the
lowest limit."""

NARROW = 0.2
"""Threshold for the relative half width of a limit's interval. Below it, the limit counts as linear in the
parameters."""

OUTLINE = 60
"""Number of points of the boundary on which the stiffest wall is located. Few points are enough, because the limit is
flat there."""


@dataclass(frozen=True)
class StepTrial:
    """Usual conditions of a trial.

    Parameters
    ----------
    step : float
        F_0 [N, Nm].
    rows : int
        Number of rows from the step onward.
    quantum : float
        Resolution of the sensor [m, rad].
    jitter : float
        Standard deviation of the delay [samples].
    """

    step: float
    rows: int
    quantum: float = 0.0
    jitter: float = 0.0


def linear_limits(loop: Loop, damping: Floats) -> Floats:
    """Return the largest stable stiffness of the linear loop at each damping, or 0 if no wall is stable.

    Parameters
    ----------
    loop : Loop
    damping : float64, shape (n,)
        B [Ns/m, Nms/rad].

    Returns
    -------
    float64, shape (n,)
        K [N/m, Nm/rad].

    Examples
    --------
    >>> loop = Loop(mass=0.5, damping=3.0, sampling_period_s=0.001, delay_samples=4)
    >>> linear_limits(loop, np.array([0.0, 40.0])).round().tolist()
    [670.0, 7936.0]
    """
    units = LoopUnits.of(loop)
    return np.maximum(stiffness_limit(NormalisedLoop.of(loop), damping / units.damping), 0.0) * units.stiffness


def damping_of_stiffest(loop: Loop) -> float:
    """Return the damping B [Ns/m, Nms/rad] of the stiffest stable wall, or 0 if there is none."""
    normalised = NormalisedLoop.of(loop)
    damping = max(0.0, boundary(normalised, OUTLINE).beta_at_alpha_max) if stabilises(normalised) else 0.0
    return damping * LoopUnits.of(loop).damping


def simulate_behind(loop: Loop, K: Floats, B: Floats, trial: StepTrial, repetition: int = 0) -> Trials:
    """Simulate trials of a loop with walls, without noise and travel limit. Each repetition has different jitter."""
    delays = delays_of(loop.delay_samples, trial.jitter)
    noiseless = replace(loop, sensor=Sensor(quantum=trial.quantum), jitter_samples=delays)
    return simulate(Setup(noiseless, trial.step, min(trial.rows, LONGEST), edge_row=1), K, B, repetition=repetition)


def step_limits(loop: Loop, damping: Floats, trial: StepTrial, softest: Floats) -> tuple[Floats, Floats]:
    """Return the limit for a step at each damping, found by simulation, and its uncertainty.

    Parameters
    ----------
    loop : Loop
    damping : float64, shape (n,)
        B [Ns/m, Nms/rad].
    trial : StepTrial
    softest : float64, shape (n,)
        Softest walls of the search [N/m, Nm/rad]. Behind very soft walls, the device moves so far that friction is
        negligible.

    Returns
    -------
    limits, open : float64, shape (n,)
        Centre and half width of the range of stiffness in which logs leave the verdict undecided [N/m, Nm/rad]. The
        centre is NaN if no wall is unstable up to the linear limit plus `BEYOND` times the largest linear limit, or if
        the softest wall is unstable. Friction can only raise a limit. Jitter may raise or lower a limit.
    """
    if not len(damping):
        return np.empty(0), np.empty(0)
    linear = linear_limits(loop, damping)
    least = linear if loop.friction and not trial.jitter else 0.5 * linear
    low, high = np.maximum(least, softest), linear + BEYOND * linear.max()
    begin, ends = low.copy(), high > low
    for _ in range(ROUNDS):
        walls = _rounded(np.linspace(low, high, WALLS + 1)[1:])
        last, first = _brackets(loop, walls, np.where(ends, damping, np.nan), trial)
        ends = first >= 0
        # Verdicts are undecided between the stiffest stable and the first unstable wall.
        step = (high - low) / WALLS
        low, high = low + np.where(ends, last, 0) * step, low + np.where(ends, first + 1, 1) * step
    known = ends & (low > np.where(begin > least, begin, -1.0))
    return np.where(known, 0.5 * (low + high), np.nan), 0.5 * (high - low)


def _brackets(loop: Loop, K: Floats, damping: Floats, trial: StepTrial) -> tuple[Integers, Integers]:
    """Return at each damping the row after the last stable wall, and the row of the first unstable wall above it.

    Parameters
    ----------
    loop : Loop
    K : float64, shape (walls, n)
        Stiffness in increasing order [N/m, Nm/rad]. Walls above the first unstable one are not simulated.
    damping : float64, shape (n,)
        B [Ns/m, Nms/rad], or NaN for a damping that is left out.
    trial : StepTrial

    Returns
    -------
    last, first : int64, shape (n,)
        Rows of K. ``first`` is -1 if no wall is unstable.
    """
    last, first = np.zeros(len(damping), dtype=np.int64), np.full(len(damping), -1)
    for row, stiffness in enumerate(K):
        places = np.flatnonzero(np.isfinite(damping) & (first < 0))
        if not len(places):
            break
        runs = simulate_behind(loop, stiffness[places], damping[places], trial)
        for place, run in zip(places.tolist(), runs, strict=True):
            verdict = judge(run).verdict
            if verdict == "unstable":
                first[place] = row
            elif verdict == "stable":
                last[place] = row + 1
    return last, first


def _rounded(stiffness: Floats) -> Floats:
    """Round stiffnesses to `DIGITS` digits.

    The random numbers of a simulated log depend on the digits of its wall. Rounding prevents floating-point errors from
    changing these numbers.
    """
    unit = 10.0 ** (np.floor(np.log10(np.maximum(np.abs(stiffness), 1e-300))) + 1 - DIGITS)
    return np.asarray(np.round(stiffness / unit) * unit)


def lowest_limits(device: IdentifiedLoop, damping: Floats) -> Floats:
    """Return the lowest linear limit at dampings B of all loops consistent with the logs (95 %), (n,) [N/m, Nm/rad].

    Notes
    -----
    The result is the smallest limit on the ellipsoid of the parameters whose projections are their 95 % intervals. For
    a limit that is linear in the parameters, it is the lower end of the limit's interval. If the interval is wide,
    limits are computed along the axes, along the steepest descent at each damping, and along random directions.
    """
    limit = linear_limits(device.loop, damping)
    if not device.ends:
        return limit
    ends = np.array([[linear_limits(end, damping) for end in both] for both in device.ends])
    reach = np.sqrt(np.sum(np.square(np.abs(ends - limit).max(axis=1)), axis=0))
    if (reach <= NARROW * limit).all():
        return np.asarray(np.minimum(limit - reach, ends.min(axis=(0, 1))))
    axes = device.axes
    slope = 0.5 * (ends[: len(axes), 0] - ends[: len(axes), 1])
    steepest = (slope / np.maximum(np.sqrt(np.sum(slope**2, axis=0)), 1e-300)).T
    random = np.random.default_rng(0).standard_normal((DIRECTIONS, len(axes)))
    random /= np.sqrt(np.sum(random**2, axis=1, keepdims=True))
    others = [linear_limits(device.shifted(way @ axes), damping) for way in np.concatenate([steepest, random])]
    return np.asarray(np.minimum(limit, np.minimum(ends.min(axis=(0, 1)), np.min(others, axis=0))))


def limits_of(
    device: IdentifiedLoop, damping: Floats, trial: StepTrial | None = None, softest: Floats | float = 0.0
) -> tuple[Floats, Floats]:
    """Return the limits at dampings B, and their 95 % uncertainty, both (n,) [N/m, Nm/rad].

    The limits are those of the linear loop. With friction or jitter, they are the limits for the step of the trial
    (`step_limits`). The uncertainty then includes the increase due to friction, times the relative half width of the
    friction estimate. Sensor resolution alone does not shift a limit, because the oscillation that it sustains ends
    below the limit.
    """
    loop = device.loop
    limit = linear_limits(loop, damping)
    off = [np.abs([linear_limits(end, damping) - limit for end in both]).max(axis=0) for both in device.ends]
    reach = np.sqrt(np.sum(np.square(off), axis=0)) if off else np.zeros(len(damping))
    if trial is None or not (loop.friction or trial.jitter):
        return limit, reach
    limits, undecided = step_limits(loop, damping, trial, np.broadcast_to(softest, limit.shape))
    reach = np.hypot(reach, undecided)
    if loop.friction:
        friction = device.interval("friction.coulomb")
        reach = np.hypot(reach, (limits - limit) * (friction.high - friction.low) / (2 * friction.value))
    return limits, reach
