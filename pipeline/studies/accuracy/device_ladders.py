"""Ladders of a loop with filter, lag, mode and fractional delay, and of loops at which a method may stop too early.

Limits and pole radii are known in many digits (docs/make_reference.py); costs are those of motions that `integrated`
follows by the differential equations.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np

from pipeline.loop.loop import Loop, Vibration
from pipeline.records.accuracy import OURS
from pipeline.records.batch import Floats
from pipeline.records.loop_parts import Butterworth
from pipeline.studies.accuracy.integrated import HARD_LOOPS, HardLoop, followed
from pipeline.studies.accuracy.ladder import Ladder, Method, Values
from pipeline.studies.accuracy.searches import bisect_limit
from pipeline.studies.accuracy.theory_ladders import reference, unknown
from pipeline.theory.costs import point_costs_by_name
from pipeline.theory.limits import stiffness_limit
from pipeline.theory.poles import spectral_radius
from pipeline.theory.transient import LONGEST

HIGH = 0.02
"""An alpha beyond all limits."""

SAMPLES = 1200
"""Length of the followed responses: all pole radii are below 0.98, so that 1e-10 of the motion is left."""

BOUNDARY, RADIUS, OVERSHOOT = "boundary, general loop", "spectral radius, general loop", "overshoot, hard loops"
COSTS = {
    "settling time, hard loops": ("settle", "settle_1pct"),
    OVERSHOOT: ("overshoot", "overshoot"),
    **{f"energy, w = {w}, hard loops": (f"energy_w{w}", f"energy_step_w{w}_discrete") for w in range(3)},
}
"""What `integrated.followed` calls each quantity, and what theory does."""

DEVICE_QUANTITIES = (BOUNDARY, RADIUS, *COSTS)


def _known() -> dict[str, Any]:
    return dict(reference()["device"])


def _loop(hard: HardLoop) -> Loop:
    mode = Vibration(hard.far_mass, hard.spring, hard.damper, sensor_far=False) if hard.far_mass else None
    velocity = Butterworth(kind="butterworth", order=hard.order, cutoff_hz=hard.cutoff) if hard.cutoff else None
    return Loop(hard.gamma, hard.delta, hard.delay, hard.lag, mode, velocity)


@cache
def hard_loops() -> tuple[HardLoop, ...]:
    """Return loops with their walls whose costs are looked at: the general loop at its points, and the hard ones."""
    known = _known()
    walls = zip(known["alpha"], known["beta"], strict=True)
    return (*(HardLoop(a, b, samples=SAMPLES, **known["loop"]) for a, b in walls), *HARD_LOOPS.values())


def costs_of(tolerance: float) -> Values:
    """Return the costs of all `hard_loops` by `integrated.followed`."""
    found = [followed(loop, tolerance=tolerance) for loop in hard_loops()]
    return {quantity: np.array([costs[name] for costs in found]) for quantity, (name, _) in COSTS.items()}


@cache
def exact_costs() -> Values:
    """Return the true costs."""
    return costs_of(1e-13)


def device_ladders() -> Iterator[Ladder]:
    """Yield the ladders of the general loop."""
    yield _boundary()
    yield _radius()
    yield _costs()


def _boundary() -> Ladder:
    known, shape = _known(), HardLoop(0.0, 0.0, samples=0, **_known()["loop"])
    beta = np.array(known["limit_beta"])

    def bisection(tolerance: float) -> Values:
        loop = _loop(shape)
        return {BOUNDARY: bisect_limit(lambda a, b: spectral_radius(loop, a, b), beta, HIGH, tolerance)}

    def longer_delay() -> Values:
        # a Butterworth filter of order 2 delays slow motion by sqrt(2) over its cut-off
        filtered = np.sqrt(2) / (2 * np.pi * shape.cutoff)
        return {BOUNDARY: stiffness_limit(Loop(shape.gamma, shape.delta, shape.delay + shape.lag + filtered), beta)}

    return Ladder(
        {BOUNDARY: np.array(known["limit_alpha"])},
        (
            Method("a longer delay in place of filter and lag", longer_delay),
            Method("eigenvalues and bisection", bisection, "tolerance {:.0e}", (1e-2, 1e-4, 1e-7, 1e-10), (1e-2, 1e-6)),
            Method(OURS, lambda: {BOUNDARY: stiffness_limit(unknown(_loop(shape)), beta)}, "roots of polynomials"),
        ),
    )


def _radius() -> Ladder:
    known, shape = _known(), HardLoop(0.0, 0.0, samples=0, **_known()["loop"])
    walls = np.array(known["alpha"]), np.array(known["beta"])

    def squared(squarings: int) -> Values:
        power, log = _loop(shape).matrix(*walls), np.zeros(len(walls[0]))
        for _ in range(squarings):
            power = power @ power
            norm = np.linalg.norm(power, axis=(1, 2))
            power, log = power / norm[:, None, None], 2 * log + np.log(norm)
        return {RADIUS: np.exp(log / 2.0**squarings)}

    def ours() -> Values:
        return {RADIUS: point_costs_by_name(_loop(shape), *walls, ["pole_radius"], LONGEST)["pole_radius"]}

    return Ladder(
        {RADIUS: np.array(known["radius"])},
        (
            Method("squaring of the loop matrix", squared, "{} squarings", (4, 8, 16, 24, 40), (4, 16)),
            Method(OURS, ours, "eigenvalues"),
        ),
    )


def _costs() -> Ladder:
    def ours() -> Values:
        found = [_own_costs(loop) for loop in hard_loops()]
        return {quantity: np.array([costs[name][0] for costs in found]) for quantity, (_, name) in COSTS.items()}

    return Ladder(
        exact_costs(),
        (
            Method("solve_ivp (scipy), hold by hold", costs_of, "tolerance {:.0e}", (1e-6, 1e-9, 1e-11), (1e-6,)),
            Method(OURS, ours, "modes"),
        ),
        scale={OVERSHOOT: 1.0},
    )


def _own_costs(hard: HardLoop) -> dict[str, Floats]:
    wall = np.array([hard.alpha]), np.array([hard.beta])
    return point_costs_by_name(_loop(hard), *wall, [name for _, name in COSTS.values()], LONGEST)
