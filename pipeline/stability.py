"""Stability of the loop: spectral radius, closed-form boundary, linear condition.

Source: Hulin 2017, secs. 3.4 and 3.5; the boundary by the closed form on |z| = 1 instead of the gridding of 3.4.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.batch import Booleans, Floats
from pipeline.errors import ParameterError
from pipeline.loop import Loop, as_points

_CHUNK = 8192
"""Points whose eigenvalues are computed at a time; bounds memory to about 40 MB at d = 16."""


def spectral_radius(loop: Loop, alpha: object, beta: object) -> Floats:
    """Return the largest pole modulus r = |z|_max of each point.

    Parameters
    ----------
    loop : Loop
    alpha, beta : array_like, shape (n,)
        Normalised virtual stiffness and damping.

    Returns
    -------
    float64, shape (n,)

    Source: Hulin 2017, eq. 5.2.
    """
    a, b = as_points(alpha, beta)
    radius = np.empty(len(a))
    for i in range(0, len(a), _CHUNK):
        part = slice(i, i + _CHUNK)
        radius[part] = np.abs(np.linalg.eigvals(loop.matrix(a[part], b[part]))).max(axis=1)
    return radius


def is_stable(loop: Loop, alpha: object, beta: object) -> Booleans:
    """Return where all poles lie inside the unit circle."""
    return np.asarray(spectral_radius(loop, alpha, beta) < 1)


def boundary_points(loop: Loop, theta: Floats) -> tuple[Floats, Floats]:
    """Return the points (alpha, beta) at which a pole pair lies on the unit circle at the angles +-theta.

    On |z| = 1 the characteristic equation is linear in alpha and beta: with the delayed plant G and W = -1/G(z),
    beta = Im W / sin theta and alpha = Re W - beta (1 - cos theta).

    Parameters
    ----------
    loop : Loop
    theta : float64, shape (n,)
        Angles, 0 < theta < pi.

    Notes
    -----
    With zeta = z - 1 the plant's denominator is zeta^2 + zeta (2 gamma G + delta S) + gamma (G (gamma G + delta S) +
    S^2), S and G being velocity and position gain: a sum without cancellation for small angles and stiffness.
    """
    zeta = -2 * np.sin(theta / 2) ** 2 + 1j * np.sin(theta)
    gain, impulse = (float(entry) for entry in loop.period.gain)
    slip = loop.gamma * gain + loop.delta * impulse  # 1 - transition[1, 1]
    denominator = zeta**2 + zeta * (loop.gamma * gain + slip) + loop.gamma * (gain * slip + impulse**2)
    response = np.zeros_like(zeta)
    for index, (segment, motion) in enumerate(zip(loop.segments, loop.flows, strict=True)):
        push = motion.gain
        for later in loop.flows[index + 1 :]:
            push = later.transition @ push
        numerator = push[0] * (zeta + slip) + impulse * push[1]
        response = response + numerator * np.exp(-1j * theta * segment.age)
    w = -denominator / response
    beta = w.imag / np.sin(theta)
    return w.real - 2 * beta * np.sin(theta / 2) ** 2, beta


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
    """

    alpha: Floats
    beta: Floats
    theta: Floats
    alpha_max: float
    beta_at_alpha_max: float
    beta_max: float
    alpha_at_beta_max: float


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
    and the point with the largest alpha are refined to rounding.

    Source: Hulin 2017, sec. 3.4; reproduces Tables B.1 to B.4.
    """
    if points < 8:
        raise ParameterError(f"points = {points}: expected at least 8.")
    end = _branch_end(loop)
    # cosine spacing: dense at both ends, where the branch meets the line alpha = -gamma
    theta = end * 0.5 * (1 - np.cos(np.pi * (np.arange(points) + 0.5) / points))
    theta_peak = _maximise(lambda t: boundary_points(loop, t)[0], theta)
    theta_top = _maximise(lambda t: boundary_points(loop, t)[1], np.append(theta, end))
    theta = np.unique(np.concatenate([theta, [theta_peak, theta_top, end]]))
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
        alpha_at_beta_max=-loop.gamma if theta_top == end else float(top[0][0]),
    )


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
    high = theta[inside[0] + after[0]]
    low = theta[inside[0] + after[0] - 1]
    for _ in range(60):  # bisection to the last bit of a double
        middle = 0.5 * (low + high)
        if boundary_points(loop, np.array([middle]))[0][0] + loop.gamma > 0:
            low = middle
        else:
            high = middle
    return float(0.5 * (low + high))


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


def linear_condition(loop: Loop, alpha: object) -> Floats:
    """Return the smallest beta that the linear condition calls stable: alpha (1/2 + d) - delta.

    Valid near the origin (alpha, beta << 1); above its crossing with the exact boundary it is not safe (3.5).

    Source: Hulin 2017, eq. 3.27.
    """
    return np.atleast_1d(np.asarray(alpha, dtype=np.float64)) * (0.5 + loop.delay) - loop.delta


def stiffness_at(border: Boundary, beta: NDArray[np.float64]) -> Floats:
    """Return the largest alpha of the boundary at given beta by linear interpolation between its points; NaN outside.

    For figures and scores; the error falls with the square of the number of boundary points.
    """
    result = np.full(len(beta), np.nan)
    for i, level in enumerate(beta):
        below, above = border.beta[:-1], border.beta[1:]
        hit = np.flatnonzero((below - level) * (above - level) <= 0)
        if len(hit):
            share = (level - below[hit]) / np.where(above[hit] == below[hit], 1.0, above[hit] - below[hit])
            result[i] = np.max(border.alpha[hit] + share * (border.alpha[hit + 1] - border.alpha[hit]))
    return result
