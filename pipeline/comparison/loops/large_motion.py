"""Limits of a device with friction: those of the step that was used, and those of large motions beside them."""

from __future__ import annotations

import numpy as np

from pipeline.comparison.loops.fitted_loop import found_loop, velocity_of
from pipeline.comparison.loops.log_evidence import law_departures
from pipeline.comparison.loops.loop_range import LoopRange
from pipeline.comparison.loops.wall_replay import Replayed, setup_of_found
from pipeline.measured.intervals import NORMAL_95
from pipeline.measured.signal.verdict import judge
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.records.batch import Floats
from pipeline.records.findings import Estimate
from pipeline.records.loop_records import LoopLimit
from pipeline.records.results import ExperimentResult
from pipeline.rendering.labels import significant
from pipeline.simulation.setup import Setup
from pipeline.simulation.simulate import simulate

NARROW = 1.25
"""Least limit of large motions over the stiffness of a wall to use, as for the limit that was measured."""

HIGHEST = 1.5
"""How far above its linear limit a limit for the step is looked for, in largest linear limits."""

WALLS = 17
"""Walls of one round between a stable and an unstable one: three rounds tell a limit to 1/2700 of the largest."""

ROUNDS = 3

TYPICAL = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


def with_large_motion(result: ExperimentResult, stages: ExperimentStages) -> ExperimentResult:
    """Return a result with causes, with limits for the step and for large motions where its logs show friction.

    Coulomb friction takes a part of a motion that falls with its size: to a large one it is none. A wall to use that
    large motions make unstable is none.
    """
    if all(cause.code != "coulomb_friction" for cause in result.causes):
        return result
    loop = found_loop(result, stages, velocity_of(stages, law_departures(stages)))
    if loop is None or not result.boundary:
        return result
    linear = loop.at_values(np.array([point.damping for point in result.boundary]))
    points = tuple(
        point.model_copy(update={"stiffness_large_motion": float(limit)})
        for point, limit in zip(result.boundary, linear, strict=True)
    )
    result = result.model_copy(update={"boundary": points})
    if (use := result.use) is None:
        return result
    limit = float(loop.at_values(np.array([use.point.damping]))[0])
    margin = limit / use.point.stiffness
    if margin >= NARROW:
        point = use.point.model_copy(update={"margin_large_motion": margin})
        return result.model_copy(update={"use": use.model_copy(update={"point": point})})
    why = (
        f"the best wall for this step has K = {significant(use.point.stiffness, 3)}, and a harder push is unstable "
        f"from {significant(limit, 3)} on: friction holds less of it"
    )
    return result.model_copy(update={"use": None, "use_reason": why})


def limits_for_step(
    result: ExperimentResult, stages: ExperimentStages, loop: LoopRange, friction: Estimate
) -> tuple[LoopLimit, ...]:
    """Return the limits of the found device for the step; none where it is stable as far as is looked.

    Their intervals hold those of the linear limit and of the friction, whose part grows with it, and the error that
    the device makes at the measured limits.
    """
    damping = np.array([point.damping for point in result.boundary])
    linear = loop.at_values(damping)
    tried, at = stages.column("response", "stiffness"), stages.column("response", "damping")
    softest = np.array([tried[(tried > 0) & (at == B)].min() for B in damping])
    coulomb = friction.value or 0.0
    setup = setup_of_found(Replayed(loop.point, coulomb), stages)
    value = step_limits(setup, damping, linear, 0.5 * softest)
    low, high = loop.band(damping)
    shares = [(coulomb if end is None else end) / coulomb for end in (friction.low, friction.high)]
    low, high = (np.minimum(low, linear), np.maximum(high, linear))
    low, high = (end + share * (value - linear) for end, share in zip((low, high), shares, strict=True))
    measured = np.array([p.estimate if p.estimate and p.high else np.nan for p in result.boundary])
    missed = np.abs(measured / np.where(value > 0, value, np.nan) - 1)
    missed = missed[np.isfinite(missed)]
    reach = NORMAL_95 * TYPICAL * float(np.median(missed)) * value if len(missed) else np.zeros_like(value)
    low, high = value - np.hypot(value - low, reach), value + np.hypot(high - value, reach)
    rows = np.stack((damping, value, low, high, linear), axis=1).tolist()
    return tuple(
        LoopLimit(damping=B, stiffness=K, low=max(a, 0.0), high=b, stiffness_large_motion=far)
        for B, K, a, b, far in rows
        if np.isfinite(K)
    )


def step_limits(setup: Setup, damping: Floats, linear: Floats, softest: Floats) -> Floats:
    """Return the softest wall at each damping that a step makes unstable, by simulation [N/m, Nm/rad].

    Parameters
    ----------
    setup : Setup
        Device with friction, and its step.
    damping, linear : float64, shape (n,)
        B [Ns/m, Nms/rad] and the linear limit there [N/m, Nm/rad], which friction can but raise.
    softest : float64, shape (n,)
        Walls above which it is looked for [N/m, Nm/rad]: so far as very soft ones move, friction is none.

    Returns
    -------
    float64, shape (n,)
        NaN where no wall is unstable up to `HIGHEST` times the largest linear limit above the linear one, and where
        the softest one is already: the limit lies below all that were tried.
    """
    low, high = np.maximum(linear, softest), linear + HIGHEST * linear.max()
    begin, ends = low, high > low
    for _ in range(ROUNDS):
        K = np.linspace(low, high, WALLS + 1)[1:]
        said = judge(simulate(setup, K.ravel(), np.tile(damping, WALLS))).verdict.reshape(K.shape)
        grows = said == "unstable"
        ends &= grows.any(axis=0)
        first, step = np.argmax(grows, axis=0), (high - low) / WALLS
        low, high = low + first * step, low + (first + 1) * step
    return np.where(ends & (low > np.where(begin > linear, begin, -1.0)), 0.5 * (low + high), np.nan)
