"""Ladders of a loop with filter, lag, mode and fractional delay; its truth by other roads, in 100 digits and more.

Limits and pole radii are bisected by Routh's criterion, costs summed over a response that is followed sample by sample.
"""

from __future__ import annotations

from collections.abc import Iterator
from decimal import Decimal
from functools import cache

import numpy as np

from pipeline.loop.device_loop import DeviceLoop, Vibration
from pipeline.loop.loop import Loop
from pipeline.loop.many_digits import as_exact, as_floats, bilinear, many_digits
from pipeline.loop.velocity_filter import filter_in_z
from pipeline.records.accuracy import OURS
from pipeline.records.batch import Floats
from pipeline.records.loop_parts import Butterworth
from pipeline.studies.accuracy.rungs import Ladder, Method, Values
from pipeline.studies.accuracy.searches import bisect_limit
from pipeline.theory.cost.settling_overshoot import transient_costs
from pipeline.theory.device.crossings import branches, on_circle, right_half
from pipeline.theory.device.slowest_pole import characteristic, slowest_poles
from pipeline.theory.device.state_sums import device_energy
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

BOUNDARY, RADIUS, OVERSHOOT = "boundary, general loop", "spectral radius, general loop", "overshoot, general loop"
ENERGIES = tuple(f"energy, w = {w}, general loop" for w in range(3))
DEVICE_QUANTITIES = (BOUNDARY, RADIUS, OVERSHOOT, *ENERGIES)


def device() -> DeviceLoop:
    """Return the loop, made anew: nothing is known of it yet."""
    velocity = Butterworth(kind="butterworth", order=2, cutoff_hz=CUTOFF)
    return DeviceLoop(0.0, 0.006, 2.4, LAG, Vibration(0.3, 0.5, 0.03, sensor_far=False), velocity)


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
def exact_costs() -> dict[str, Floats]:
    """Return the costs of the sampled responses."""
    alpha, _ = walls()
    sampled = np.array([_followed(float(a), float(b)) for a, b in zip(*walls(), strict=True)]).T
    return _costs_of(sampled, alpha)


def _followed(alpha: float, beta: float) -> Floats:
    """Return the deviations of a step response, in SAMPLES samples: each part moved by itself, without a matrix."""
    loop, result = device(), []
    with many_digits(loop.digits):
        b, a = filter_in_z(loop.velocity)
        state, sensor = as_exact(np.zeros(len(loop.device[1]))), as_exact(loop.device[2])
        state[0], before = Decimal(-1), Decimal(-1)
        rates, speeds = [Decimal(0)] * len(b), [Decimal(0)] * (len(a) - 1)
        forces = [Decimal(alpha)] * (loop.oldest_force + 1)
        for _ in range(SAMPLES):
            place = sensor @ state
            result.append(place)
            rates = [place - before, *rates[:-1]]
            speed = b @ np.array(rates, dtype=object) - a[1:] @ np.array(speeds, dtype=object)
            speeds, before = [speed, *speeds[:-1]], place
            forces = [-Decimal(alpha) * place - Decimal(beta) * speed, *forces[:-1]]
            for segment, (transition, gain) in zip(loop.segments, loop.over_segments, strict=True):
                state = transition @ state + gain * forces[segment.age]
    return as_floats(np.array(result, dtype=object))


def _costs_of(sampled: Floats, alpha: Floats) -> dict[str, Floats]:
    """Return overshoot and energies of sampled deviations, shape (samples, n)."""
    change = np.diff(sampled, axis=0, prepend=sampled[:1])
    energy, k = sampled**2 + change**2 / alpha, np.arange(len(sampled))[:, None]
    found = {name: (k**w * energy).sum(axis=0) for w, name in enumerate(ENERGIES)}
    return {OVERSHOOT: np.maximum(sampled.max(axis=0), 0.0), **found}


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
    alpha, beta = walls()

    def recurrence(samples: int) -> Values:
        loop = device()
        matrix, state, seen = loop.matrix(alpha, beta), loop.starts(alpha, "step")[:, :, None], []
        for _ in range(samples):
            seen.append(state[:, :, 0] @ loop.open_loop[2])
            state = matrix @ state
        return _costs_of(np.array(seen), alpha)

    def ours() -> Values:
        loop = device()
        energies = device_energy(loop, alpha, beta, "step")
        peak = transient_costs(loop, alpha, beta, (), continuous=False)["overshoot_discrete"]
        return {OVERSHOOT: peak, **{n: energies[f"energy_step_w{w}_discrete"] for w, n in enumerate(ENERGIES)}}

    return Ladder(
        exact_costs(),
        (
            Method("truncated recurrence", recurrence, "{} samples", (64, 128, 256, 512, 1024), (64, 512)),
            Method(OURS, ours, "modes"),
        ),
        scale={OVERSHOOT: 1.0},
    )
