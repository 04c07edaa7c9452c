"""Compute the passivity of a wall with lag, fractional delay and velocity filter.

Since the wall is sampled, a motion of frequency omega causes forces at all aliases omega + 2 pi n/T. These forces can
generate energy. With T = 1, u = 1/z and z = exp(j omega), the damping that absorbs this energy is

    [Re(y S1) + sqrt(Re(y S1)^2 + |y|^2 (S0 S2 - |S1|^2))]/2,    y = (1 - u) (alpha + beta F (1 - u)).

S0, S1 and S2 are the sums of 1, L and |L|^2 over omega_n^2. L = exp(-j omega_n d) G(j omega_n), with the actuator G,
such as 1/(1 + j omega_n lag). The required damping is homogeneous and convex in alpha and beta. The passive region is
therefore convex, contains 0, and scales with the damping of the device. Mass, spring, hand, and a vibration mode with
the sensor at the motor have no influence.

Source: Hulin 2017, ch. 4. For integer delays without lag, this is (4.6). The sums in closed form are an addition.
"""

from __future__ import annotations

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.records.trials import Floats
from pipeline.theory.search import search_lines

_ANGLES = 40
"""Number of angles per turn of the delayed force. Maxima are searched for between these angles."""

_NEAR_ZERO = 8e-3
"""Smallest angle times delay and lag. Below it, 1/angle^2 loses digits. The required damping is an even function of the
angle, and is extrapolated to 0 with an error of 1e-9."""

_SLOW, _STILL = 0.3, 1e-4
"""Threshold for the corner frequency of a velocity filter [rad/sample], and smallest examined angle relative to this
frequency. Small angles are examined below the threshold only."""

_SLOW_ANGLES, _SLOW_STARTS = 241, 6
"""Number of these angles, which are logarithmically spaced, and number of peaks that are refined."""

_DIRECTIONS = 181

_BISECTIONS = 40
"""Number of bisections of a stiffness interval, for an accuracy of 1e-12 of the interval."""


def required_damping(loop: NormalisedLoop, alpha: Floats, beta: Floats) -> Floats:
    """Return the normalised damping that walls require on the motor side of the device, shape (n,), at least 0.

    Parameters
    ----------
    loop : NormalisedLoop
        Only its delay, lag and filter are used.
    alpha, beta : float64, shape (n,)

    Raises
    ------
    ParameterError
        If the position is sensed at the load. No damping of the motor side makes such a wall passive.
    """
    if loop.plant.sensor_at_load:
        raise ParameterError("the position is sensed beyond the vibration mode: no wall is passive for every hand.")
    lowest = _NEAR_ZERO / (loop.delay + loop.lag + 1)
    found = search_lines(
        lambda line, angle, _: -_needed(loop, alpha[line], beta[line], np.clip(angle, lowest, np.pi)),
        *(np.full(len(alpha), lowest), np.full(len(alpha), np.pi)),
        coarse=int(_ANGLES * (loop.oldest_force + 2)) + 1,
        starts=loop.oldest_force + 2,  # refine one maximum for each turn, because their peaks may be nearly equal
    )
    most = np.maximum(-found.cost, 0.0)
    slowest = _slowest(loop)
    if slowest > _SLOW:
        near, twice = (_needed(loop, alpha, beta, np.array([a])) for a in (lowest, 2 * lowest))
        return np.asarray(np.maximum(most, (4 * near - twice) / 3))
    # the corner of a slow filter may be between two of the angles above, or below the first angle
    slow = search_lines(
        lambda line, x, _: -_needed_slowly(loop, alpha[line], beta[line], np.exp(x), lowest),
        *(np.full(len(alpha), np.log(_STILL * slowest)), np.full(len(alpha), np.log(_SLOW))),
        coarse=_SLOW_ANGLES,
        starts=_SLOW_STARTS,
    )
    return np.asarray(np.maximum(most, -slow.cost))


def _slowest(loop: NormalisedLoop) -> float:
    """Return the smallest distance of a filter pole from 1, which is its corner [rad/sample], or 1 without a filter."""
    poles = np.roots(loop.filter_in_z[1])
    return float(np.abs(1 - poles).min(initial=1.0))


def _needed_slowly(loop: NormalisedLoop, alpha: Floats, beta: Floats, angle: Floats, lowest: float) -> Floats:
    """Return the required damping at angles, which may be below the angle ``lowest``.

    Below this angle, the share of aliases grows with 1/angle^2.
    """
    exact = _needed(loop, alpha, beta, np.maximum(angle, lowest))
    s0, s1, s2 = _alias_sums(loop, np.array([lowest]))
    rest = np.maximum(s0 * s2 - np.abs(s1) ** 2, 0.0) * (lowest / angle) ** 2
    u = np.exp(-1j * angle)
    b, a = loop.filter_in_z
    y = -np.expm1(-1j * angle) * (
        alpha - np.expm1(-1j * angle) * beta * np.polyval(b[::-1], u) / np.polyval(a[::-1], u)
    )
    A, B, C = loop.device.actuator
    gain = np.ones(len(angle), np.complex128)
    if len(A):
        gain = np.array([C @ np.linalg.solve(1j * w * np.eye(len(A)) - A, B) for w in angle])
    real = (y * np.exp(-1j * angle * loop.delay) * gain).real / angle**2
    return np.where(angle < lowest, 0.5 * (real + np.sqrt(real**2 + np.abs(y) ** 2 * rest)), exact)


def passive_outline(loop: NormalisedLoop, delta: float) -> tuple[Floats, Floats]:
    """Return alpha and beta of the outline of the passive region, starting at (0, -delta).

    They are zero if delta is 0.
    """
    return _reached(loop, delta, np.linspace(-0.5 * np.pi, 0.5 * np.pi, _DIRECTIONS))


def stiffest_passive(loop: NormalisedLoop, delta: float) -> tuple[float, float]:
    """Return alpha and beta of the stiffest passive wall. The region is convex and has a single peak."""
    best = search_lines(
        lambda _, angle, __: -_reached(loop, delta, angle)[0], np.array([-0.5 * np.pi]), np.array([0.5 * np.pi])
    )
    alpha, beta = _reached(loop, delta, best.place)
    return float(alpha[0]), float(beta[0])


def passive_stiffness(loop: NormalisedLoop, delta: float, beta: Floats) -> Floats:
    """Return the largest passive alpha at each beta, shape (n,), or 0 if no wall with this damping is passive."""
    # slow motion requires delta + beta >= alpha (d + lag + 1/2)
    low, high = np.zeros(len(beta)), np.maximum(delta + beta, 0.0) / (loop.delay + loop.lag + 0.5)
    for _ in range(_BISECTIONS):
        alpha = 0.5 * (low + high)
        passive = required_damping(loop, alpha, beta) <= delta
        low, high = np.where(passive, alpha, low), np.where(passive, high, alpha)
    return low


def _reached(loop: NormalisedLoop, delta: float, angle: Floats) -> tuple[Floats, Floats]:
    """Return the last passive walls in the given directions. Direction 0 is that of alpha."""
    # the range of beta exceeds that of alpha by about the delay, so directions are equidistant in
    # alpha (delay + lag + 1/2) and beta
    alpha, beta = np.cos(angle) / (loop.delay + loop.lag + 0.5), np.sin(angle)
    reach = delta / required_damping(loop, alpha, beta)
    return alpha * reach, beta * reach


def _needed(loop: NormalisedLoop, alpha: Floats, beta: Floats, angle: Floats) -> Floats:
    u = np.exp(-1j * angle)
    b, a = loop.filter_in_z
    rate = (1 - u) * np.polyval(b[::-1], u) / np.polyval(a[::-1], u)
    y = (1 - u) * (alpha + beta * rate)
    s0, s1, s2 = _alias_sums(loop, angle)
    real = (y * s1).real
    return np.asarray(0.5 * (real + np.sqrt(real**2 + np.abs(y) ** 2 * np.maximum(s0 * s2 - np.abs(s1) ** 2, 0.0))))


def _alias_sums(loop: NormalisedLoop, angle: Floats) -> tuple[Floats, np.ndarray, Floats]:
    """Return S0, S1 and S2, which are sums over aliases that are computed as sums over samples (Poisson).

    The actuator x' = A x + B u, f = C x has a static gain of 1 and the ramp response t - C A^-2 B + C exp(A t) A^-2 B.
    With A P + P A' + B B' = 0, (|G|^2 - 1)/omega^2 is the spectrum of -C exp(A |t|) A^-2 P C'.
    """
    u = np.exp(-1j * angle)
    first = int(np.ceil(loop.delay))
    share = first - loop.delay  # share of a sample between the delay and the next sample
    s0 = 0.25 / np.sin(0.5 * angle) ** 2
    ramp, s2 = u / (1 - u) ** 2 + (share - loop.lag) / (1 - u), s0
    A, B, C = loop.device.actuator
    if len(A):
        from scipy.linalg import expm, solve_continuous_lyapunov

        square = np.linalg.inv(A) @ np.linalg.inv(A)
        ramp = ramp + _sampled(A, expm(A * share) @ square @ B, u)
        spectrum = square @ solve_continuous_lyapunov(A, -np.outer(B, B)) @ C
        s2 = s0 - 2 * _sampled(A, spectrum, u).real + float(C @ spectrum)
    return s0, -(u**first) * ramp, s2


def _sampled(A: Floats, start: Floats, u: np.ndarray) -> np.ndarray:
    """Return the sum of u^k times the first entry of exp(A k) start over the samples k >= 0."""
    from scipy.linalg import expm

    # from the determinants of z - exp(A) with and without feedback of the entry
    first = np.eye(1, len(A))[0]
    poles = np.poly(expm(A))
    weights = (poles - np.poly(expm(A) + np.outer(start, first)))[1:]
    return np.asarray(np.polyval(weights[::-1], u) / np.polyval(poles[::-1], u))
