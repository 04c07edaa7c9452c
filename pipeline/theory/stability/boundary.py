"""The boundary of the stable region: as a curve for ideal loops, over the damping for general ones.

Source: Hulin 2017, sec. 3.4; the closed form on |z| = 1 instead of the gridding there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.loop import Loop
from pipeline.records.batch import Floats
from pipeline.theory.device.outline import outline
from pipeline.theory.stability.extent import damping_range, smooth_levels, stiffest_point
from pipeline.theory.stability.region import region, stable_intervals
from pipeline.theory.stability.stability import bisect, boundary_points

_FEWEST = 8
"""Points of an outline of which only the islands are asked for: they are known whatever its points."""

_LEVELS = 241
"""Dampings at which an ideal loop's second stable stretches are looked for; those of two springs are wide."""


@dataclass(frozen=True, eq=False)
class Boundary:
    """Stability boundary: the line alpha = -gamma and the first branch of the closed form.

    Parameters
    ----------
    alpha, beta, theta : float64, shape (n,)
        Points of the first branch in order of the pole angle theta.
    alpha_max, beta_at_alpha_max : float
        Largest stable alpha and its beta.
    beta_max, alpha_at_beta_max : float
        Largest stable beta and its alpha.
    islands : float64, shape (i, 3)
        Of a general loop, as `device.outline.Outline` tells them.
    """

    alpha: Floats
    beta: Floats
    theta: Floats
    alpha_max: float
    beta_at_alpha_max: float
    beta_max: float
    alpha_at_beta_max: float
    islands: Floats = field(default_factory=lambda: np.zeros((0, 3)))


def boundary(loop: Loop, points: int = 400) -> Boundary:
    """Return the boundary of the stable region.

    Parameters
    ----------
    loop : Loop
    points : int
        Number of points along the first branch, >= 8.

    Raises
    ------
    ParameterError
        If fewer than 8 points are asked for, or the first branch does not close (no stable region with alpha > -gamma).

    Notes
    -----
    The first branch starts at theta -> 0 on the line alpha = -gamma, and ends where it meets that line again. Its end
    and the point with the largest alpha are refined to rounding. Where it does not enclose the region (a plant that
    resonates within the delay, or damping above about 2 m/T without delay), the ends of all stable intervals are put
    together over the damping, corners to the last bits; a region of several parts then gives the parts one after
    another, and theta is pi on the line of a pole at z = -1.

    Source: Hulin 2017, sec. 3.4; reproduces Tables B.1 to B.4.
    """
    if points < 8:
        raise ParameterError(f"points = {points}: expected at least 8.")
    if loop.has_parts:
        return _of_device(loop, points)
    first = region(loop).first
    if first is None or first.high[-1] < 0:  # several branches, or an end that only counts its angle from pi
        return _over_dampings(loop, points)
    end = _branch_end(loop)
    # cosine spacing: dense at both ends, where the branch meets the line alpha = -gamma
    theta = end * 0.5 * (1 - np.cos(np.pi * (np.arange(points) + 0.5) / points))
    theta_peak = _maximise(lambda t: boundary_points(loop, t)[0], theta)
    theta_top = _maximise(lambda t: boundary_points(loop, t)[1], np.append(theta, end))
    theta = _distinct(np.concatenate([theta, [theta_peak, theta_top, end]]))
    alpha, beta = boundary_points(loop, theta)
    alpha[-1] = -loop.gamma  # by definition of the end
    peak = boundary_points(loop, np.array([theta_peak]))
    top = boundary_points(loop, np.array([theta_top]))
    return Boundary(
        alpha=alpha,
        beta=beta,
        theta=theta,
        alpha_max=float(peak[0][0]),
        beta_at_alpha_max=float(peak[1][0]),
        beta_max=float(top[1][0]),
        alpha_at_beta_max=0.0 - loop.gamma if theta_top == end else float(top[0][0]),
    )


def has_islands(loop: Loop) -> bool:
    """Return whether walls are stable somewhere beyond an unstable stretch of softer ones, down to alpha -> 0."""
    if loop.has_parts:
        return len(outline(loop, _FEWEST).islands) > 0
    found = stable_intervals(loop, np.linspace(*damping_range(loop), _LEVELS))
    return bool((found.low > 0).any())


def _of_device(loop: Loop, points: int) -> Boundary:
    """Boundary of a general loop over beta; its angles are not given."""
    found = outline(loop, points)
    if not len(found.beta):
        raise ParameterError("no damping stabilises a soft wall of this loop. Check delay, lag and velocity filter.")
    unknown, top = np.full(len(found.beta), np.nan), (float(found.beta[-1]), float(found.alpha[-1]))
    return Boundary(found.alpha, found.beta, unknown, found.alpha_max, found.beta_at_alpha_max, *top, found.islands)


def _distinct(values: Floats) -> Floats:
    """Return values in order, each once; `np.unique` would load numpy's masked arrays first."""
    ordered = np.sort(values)
    return np.asarray(ordered[np.append(True, ordered[1:] != ordered[:-1])])


def _branch_end(loop: Loop) -> float:
    """Angle at which the first branch meets alpha = -gamma again."""
    # the branch ends before the delayed plant has turned by pi once more, about pi/(d + 1/2); 64 samples of each turn
    theta = np.linspace(0, np.pi, int(64 * (loop.delay + 1)) + 1)[1:-1]
    rise = boundary_points(loop, theta)[0] + loop.gamma
    inside = np.flatnonzero(rise > 0)
    if not len(inside):
        raise ParameterError(
            f"gamma = {loop.gamma}, delta = {loop.delta}, delay = {loop.delay}: no stable wall with alpha > -gamma."
        )
    after = np.flatnonzero(rise[inside[0] :] <= 0)
    if not len(after):
        return _last_angle(loop, theta[-1])
    low, high = (theta[[inside[0] + after[0] + side]] for side in (-1, 0))
    low, high = bisect(lambda angle: boundary_points(loop, angle)[0] + loop.gamma > 0, low, high)
    return float(0.5 * (low + high)[0])


def _over_dampings(loop: Loop, points: int) -> Boundary:
    """Boundary by the ends of the stable intervals of alpha at many dampings, along each branch."""
    peak, at = stiffest_point(loop)
    beta = smooth_levels(loop, points, at)
    found = stable_intervals(loop, beta)
    parts: list[_Part] = []
    for end, of, angle in ((found.low, found.low_of, found.low_angle), (found.high, found.high_of, found.high_angle)):
        for branch in np.unique(of[of > 0]):  # 0 is the line alpha = -gamma
            some = np.flatnonzero(of == branch)
            for piece in np.split(some, np.flatnonzero(np.diff(found.index[some]) > 1) + 1):
                parts.append((angle[piece], end[piece], beta[found.index[piece]]))
    theta, alpha, beta = (np.concatenate(c) for c in zip(*_chained(parts), strict=True))
    top = int(np.argmax(beta))
    return Boundary(alpha, beta, theta, peak, at, float(beta[top]), float(alpha[top]))


_Part = tuple[Floats, Floats, Floats]
"""Angles, alpha and beta of points along a branch."""


def _chained(parts: list[_Part]) -> list[_Part]:
    """Order and turn parts so that each goes on where those before it begin or end, or nearest to that."""
    rest = sorted(parts, key=lambda part: float(part[2][0]))
    chain = [rest.pop(0)]
    while rest:  # ends: each round takes one part away
        _, which, touching, end = min(
            (float(np.hypot(part[1][i] - chain[k][1][k], part[2][i] - chain[k][2][k])), j, i, k)
            for j, part in enumerate(rest)
            for i in (0, -1)
            for k in (0, -1)
        )
        part = _turned(rest.pop(which), touching == end)
        chain = [part, *chain] if end == 0 else [*chain, part]
    turn = chain[0][2][0] > chain[-1][2][-1]
    return [_turned(part, turn) for part in chain[:: -1 if turn else 1]]


def _turned(part: _Part, turn: bool) -> _Part:
    theta, alpha, beta = (values[::-1] if turn else values for values in part)
    return theta, alpha, beta


def _last_angle(loop: Loop, theta: float) -> float:
    """Branch that reaches z = -1 (d < 1/2): the last angle below pi at which sin theta still has full precision."""
    for exponent in range(3, 8):
        candidate = np.pi * (1 - 10.0**-exponent)
        if boundary_points(loop, np.array([candidate]))[0][0] + loop.gamma > 0:
            theta = candidate
    return float(theta)


def _maximise(function: Callable[[Floats], Floats], theta: Floats) -> float:
    """Angle of the largest value: the best sample, then nine-fold zooms around it."""
    values = function(theta)
    best = int(np.argmax(values))
    if best == len(theta) - 1:
        return float(theta[-1])
    low, high = theta[max(best - 1, 0)], theta[best + 1]
    for _ in range(24):
        grid = np.linspace(low, high, 19)
        best = int(np.argmax(function(grid)))
        low, high = grid[max(best - 1, 0)], grid[min(best + 1, 18)]
    return float(0.5 * (low + high))
