"""Ladders of a loop with filter, lag, mode and fractional delay; its truth by other roads.

Limits and pole radii are bisected by Routh's criterion; costs are those of responses that `integrated` follows.
"""

from __future__ import annotations

from collections.abc import Iterator
from decimal import Decimal
from functools import cache

import numpy as np

from pipeline.loop.loop import Loop, Vibration
from pipeline.loop.many_digits import as_exact, bilinear, many_digits
from pipeline.records.accuracy import OURS
from pipeline.records.batch import Floats
from pipeline.records.loop_parts import Butterworth
from pipeline.studies.accuracy.integrated import HARD_LOOPS, HardLoop, followed
from pipeline.studies.accuracy.rungs import Ladder, Method, Values
from pipeline.studies.accuracy.searches import bisect_limit
from pipeline.theory.cost.pointcosts import point_costs_by_name
from pipeline.theory.cost.settling_overshoot import LONGEST
from pipeline.theory.device.crossings import branches, on_circle
from pipeline.theory.device.ends import right_half
from pipeline.theory.device.slowest_pole import characteristic, slowest_poles
from pipeline.theory.stability.region import stiffness_limit
from pipeline.theory.stability.stability import spectral_radius

LAG, CUTOFF = 1.5, 0.08
"""Time constant of the actuator [T], and cut-off of the filter per sampling rate."""

BETA, HIGH = np.linspace(0.02, 0.16, 6), 0.02
"""Dampings of the limits that are looked for, and an alpha beyond them."""

SAMPLES = 1200
"""Length of the followed responses: all pole radii are below 0.98, so that 1e-10 of the motion is left."""

_HALVINGS = 52
_RADIUS_BRACKET = 1e-6

BOUNDARY, RADIUS, OVERSHOOT = "boundary, general loop", "spectral radius, general loop", "overshoot, hard loops"
COSTS = {
    "settling time, hard loops": ("settle", "settle_1pct"),
    OVERSHOOT: ("overshoot", "overshoot"),
    **{f"energy, w = {w}, hard loops": (f"energy_w{w}", f"energy_step_w{w}_discrete") for w in range(3)},
}
"""What `integrated.followed` calls each quantity, and what theory does."""

DEVICE_QUANTITIES = (BOUNDARY, RADIUS, *COSTS)


def device() -> Loop:
    """Return the loop, made anew: nothing is known of it yet."""
    velocity = Butterworth(kind="butterworth", order=2, cutoff_hz=CUTOFF)
    return Loop(0.0, 0.006, 2.4, LAG, Vibration(0.3, 0.5, 0.03, sensor_far=False), velocity)


@cache
def walls() -> tuple[Floats, Floats]:
    """Return alpha and beta of the points whose poles and costs are looked at: well inside."""
    return 0.35 * exact_limits()[1:5], BETA[1:5]


@cache
def exact_limits() -> Floats:
    """Return the stiffest alpha of each damping, by counting poles of ever narrower brackets."""
    loop, result = device(), []
    with many_digits(loop.digits):
        for beta in BETA:
            low, high = 1e-4, HIGH
            for _ in range(_HALVINGS):
                middle = 0.5 * (low + high)
                stable = right_half(characteristic(loop, middle, float(beta))) == 0
                low, high = (middle, high) if stable else (low, middle)
            result.append(low)
    return np.array(result)


@cache
def exact_radii() -> Floats:
    """Return the largest pole modulus of each wall, by counting poles outside of circles."""
    loop, result = device(), []
    rough = spectral_radius(loop, *walls())
    with many_digits(loop.digits):
        for alpha, beta, radius in zip(*walls(), rough, strict=True):
            # w = (1 + u)/(1 - u) with u = -1/z: powers of 1/z with signs in turn
            polynomial = characteristic(loop, float(alpha), float(beta))
            n = len(polynomial) - 1
            in_z = (bilinear(polynomial, n) * as_exact([(-1) ** k for k in range(n + 1)]))[::-1]
            low, high = radius * (1 - _RADIUS_BRACKET), radius * (1 + _RADIUS_BRACKET)
            for _ in range(_HALVINGS - 18):
                middle = 0.5 * (low + high)
                scaled = in_z * np.array([Decimal(middle) ** k for k in range(n + 1)], dtype=object)
                inside = right_half(bilinear(scaled, n)) == 0
                low, high = (low, middle) if inside else (middle, high)
            result.append(0.5 * (low + high))
    return np.array(result)


@cache
def hard_loops() -> tuple[HardLoop, ...]:
    """Return loops with their walls whose costs are looked at: those of `walls`, and the hard ones."""
    d = device()
    mode = d.mode or Vibration(0.0, 0.0, 0.0, sensor_far=False)
    far = mode.far_mass, mode.stiffness, mode.damping
    own = [
        HardLoop(float(a), float(b), d.gamma, d.delta, d.delay, SAMPLES, d.lag, *far, CUTOFF)
        for a, b in zip(*walls(), strict=True)
    ]
    return (*own, *HARD_LOOPS.values())


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
    def bisection(tolerance: float) -> Values:
        loop = device()
        return {BOUNDARY: bisect_limit(lambda a, b: spectral_radius(loop, a, b), BETA, HIGH, tolerance)}

    def longer_delay() -> Values:
        # a Butterworth filter of order 2 delays slow motion by sqrt(2) over its cut-off
        filtered = np.sqrt(2) / (2 * np.pi * CUTOFF)
        return {BOUNDARY: stiffness_limit(Loop(0.0, 0.006, 2.4 + LAG + filtered), BETA)}

    def ours() -> Values:
        for known in (branches, on_circle):
            known.cache_clear()
        return {BOUNDARY: stiffness_limit(device(), BETA)}

    return Ladder(
        {BOUNDARY: exact_limits()},
        (
            Method("a longer delay in place of filter and lag", longer_delay),
            Method("eigenvalues and bisection", bisection, "tolerance {:.0e}", (1e-2, 1e-4, 1e-7, 1e-10), (1e-2, 1e-6)),
            Method(OURS, ours, "roots of polynomials"),
        ),
    )


def _radius() -> Ladder:
    def squared(squarings: int) -> Values:
        power, log = device().matrix(*walls()), np.zeros(len(walls()[0]))
        for _ in range(squarings):
            power = power @ power
            norm = np.linalg.norm(power, axis=(1, 2))
            power, log = power / norm[:, None, None], 2 * log + np.log(norm)
        return {RADIUS: np.exp(log / 2.0**squarings)}

    return Ladder(
        {RADIUS: exact_radii()},
        (
            Method("squaring of the loop matrix", squared, "{} squarings", (4, 8, 16, 24, 40), (4, 16)),
            Method("eigenvalues", lambda: {RADIUS: spectral_radius(device(), *walls())}, "batched"),
            Method(OURS, lambda: {RADIUS: np.array([p.radius for p in slowest_poles(device(), *walls())])}, "Newton"),
        ),
    )


def _costs() -> Ladder:
    def ours() -> Values:
        found = [_own_costs(loop) for loop in hard_loops()]
        return {quantity: np.array([costs[name] for costs in found]) for quantity, (_, name) in COSTS.items()}

    return Ladder(
        exact_costs(),
        (
            Method("solve_ivp (scipy), hold by hold", costs_of, "tolerance {:.0e}", (1e-6, 1e-9, 1e-11), (1e-6,)),
            Method(OURS, ours, "modes"),
        ),
        scale={OVERSHOOT: 1.0},
    )


def _own_costs(hard: HardLoop) -> dict[str, float]:
    mode = Vibration(hard.far_mass, hard.spring, hard.damper, sensor_far=False) if hard.far_mass else None
    velocity = Butterworth(kind="butterworth", order=hard.order, cutoff_hz=hard.cutoff) if hard.cutoff else None
    loop = Loop(hard.gamma, hard.delta, hard.delay, hard.lag, mode, velocity)
    wall = np.array([hard.alpha]), np.array([hard.beta])
    found = point_costs_by_name(loop, *wall, [name for _, name in COSTS.values()], LONGEST)
    return {name: float(values[0]) for name, values in found.items()}
