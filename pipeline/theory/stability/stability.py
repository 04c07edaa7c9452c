"""Stability of the loop: spectral radius, closed-form boundary, linear condition.

Source: Hulin 2017, secs. 3.4 and 3.5; the boundary by the closed form on |z| = 1 instead of the gridding of 3.4.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.device_loop import DeviceLoop
from pipeline.loop.loop import Loop, as_points
from pipeline.records.batch import Booleans, Floats
from pipeline.theory.device.outline import outline

_CHUNK = 8192
"""Points whose eigenvalues are computed at a time; bounds memory to about 40 MB at d = 16."""

_ON_CIRCLE = 1e-9
"""Excess of a pole modulus that counts as on the unit circle; eigenvalues of simple poles are good to about 1e-12."""

_CLOSED = 1e-3
"""Distance from alpha = -gamma, relative to the region's width, at which the first branch counts as closed; without
delay it ends at z = -1, which `_last_angle` approaches to 1e-7."""

_PER_TURN = 64
"""Samples of each turn of the delayed plant along all branches."""


def poles(loop: Loop, alpha: object, beta: object) -> np.ndarray:
    """Return all poles z of each point, shape (n, states), complex, in no order."""
    a, b = as_points(alpha, beta)
    found = np.empty((len(a), loop.states), dtype=np.complex128)
    for i in range(0, len(a), _CHUNK):
        part = slice(i, i + _CHUNK)
        found[part] = np.linalg.eigvals(loop.matrix(a[part], b[part]))
    return found


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
    radius: Floats = np.abs(poles(loop, alpha, beta)).max(axis=1)
    return radius


def is_stable(loop: Loop, alpha: object, beta: object) -> Booleans:
    """Return where all poles lie inside the unit circle.

    Parameters
    ----------
    loop : Loop
    alpha, beta : array_like, shape (n,)
        Normalised virtual stiffness and damping.

    Returns
    -------
    bool, shape (n,)

    Source: Hulin 2017, sec. 3.4 (poles of 3.9).
    """
    a, b = as_points(alpha, beta)
    return stable_by_radius(loop, a, spectral_radius(loop, a, b))


def stable_by_radius(loop: Loop, alpha: Floats, radius: Floats) -> Booleans:
    """Return where points of known alpha and spectral radius are stable, shape (n,) all.

    With alpha + gamma <= 0 there is a real pole at or above z = 1, whatever beta is, which rounding may show just below
    it: there the sign of alpha + gamma decides and not the last bit of an eigenvalue.
    """
    return np.asarray((radius < 1) & (alpha + loop.gamma > 0))


@dataclass(frozen=True)
class SampledPlant:
    """The plant behind its delay, G = sum of z^-age (slope zeta + offset) / (zeta^2 + linear zeta + constant).

    Parameters
    ----------
    linear, constant : float
        Of the denominator in zeta = z - 1.
    pushes : tuple of (int, float, float)
        Age [samples], slope and offset of each part of a sampling interval.
    """

    linear: float
    constant: float
    pushes: tuple[tuple[int, float, float], ...]


def sampled_plant(loop: Loop) -> SampledPlant:
    """Return the transfer function from the wall's force to the sampled position.

    Notes
    -----
    With velocity gain S and position gain G of a sampling interval, zeta = z - 1, the denominator is zeta^2 +
    zeta (2 gamma G + delta S) + gamma (G (gamma G + delta S) + S^2): a sum without cancellation for small zeta and
    stiffness.

    Source: Hulin 2017, eqs. 3.9 and 3.11, in another form; modified z-transform for fractional d.
    """
    gain, impulse = (float(entry) for entry in loop.period.gain)
    slip = loop.gamma * gain + loop.delta * impulse  # 1 - transition[1, 1]
    pushes = []
    for index, (segment, motion) in enumerate(zip(loop.segments, loop.flows, strict=True)):
        push = motion.gain
        for later in loop.flows[index + 1 :]:
            push = later.transition @ push
        pushes.append((segment.age, float(push[0]), float(push[0] * slip + impulse * push[1])))
    return SampledPlant(loop.gamma * gain + slip, loop.gamma * (gain * slip + impulse**2), tuple(pushes))


def boundary_points(loop: Loop, theta: Floats) -> tuple[Floats, Floats]:
    """Return the points (alpha, beta) at which a pole pair lies on the unit circle at the angles +-theta.

    On |z| = 1 the characteristic equation is linear in alpha and beta: with the delayed plant G and W = -1/G(z),
    beta = Im W / sin theta and alpha = Re W - beta (1 - cos theta).

    Parameters
    ----------
    loop : Loop
    theta : float64, shape (n,)
        Angles, 0 < theta < pi.
    """
    zeta = -2 * np.sin(theta / 2) ** 2 + 1j * np.sin(theta)
    plant = sampled_plant(loop)
    denominator = zeta**2 + zeta * plant.linear + plant.constant
    response = sum(np.exp(-1j * theta * age) * (slope * zeta + offset) for age, slope, offset in plant.pushes)
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
    resonates within the delay, or damping above about 2 m/T without delay), the region is put together by
    all branches and the line of a pole at z = -1, corners to about 1e-9; a region of several parts then gives the
    parts one after another, and theta is pi on that line. This takes eigenvalues along all branches: 0.1 s at
    d = 2, seconds at d = 64.

    Source: Hulin 2017, sec. 3.4; reproduces Tables B.1 to B.4.
    """
    if points < 8:
        raise ParameterError(f"points = {points}: expected at least 8.")
    if isinstance(loop, DeviceLoop):
        return _of_device(loop, points)
    end = _branch_end(loop)
    if not _encloses(loop, end):
        return _from_all_branches(loop, points)
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


def _of_device(loop: DeviceLoop, points: int) -> Boundary:
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


def bisect(holds: Callable[[Floats], Booleans], good: Floats, bad: Floats, halvings: int = 60) -> tuple[Floats, Floats]:
    """Return the last values towards ``bad`` at which a condition holds, and the next ones, to the last bit.

    Parameters
    ----------
    holds : callable
    good, bad : float64, shape (n,)
        Where it holds, and where it does not.
    halvings : int
    """
    for _ in range(halvings):
        middle = 0.5 * (good + bad)
        fine = holds(middle)
        good, bad = np.where(fine, middle, good), np.where(fine, bad, middle)
    return good, bad


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


def _encloses(loop: Loop, end: float) -> bool:
    """Whether the first branch up to an angle bounds the stable region: all other poles are inside, and it closes."""
    # eigenvalues of many states are slow; 12 angles still see a second branch that cuts off more than 4 % of the first
    count = int(np.clip(4000 / loop.states, 12, 200))
    theta = end * 0.5 * (1 - np.cos(np.pi * (np.arange(count) + 0.5) / count))
    alpha, beta = boundary_points(loop, np.append(theta, end))
    width = alpha.max() + loop.gamma
    closes = alpha[-1] + loop.gamma < _CLOSED * width
    return bool(closes and np.all(spectral_radius(loop, alpha[:-1], beta[:-1]) < 1 + _ON_CIRCLE))


def _from_all_branches(loop: Loop, points: int) -> Boundary:
    """Boundary as those parts of all branches, and of the line z = -1, on which every other pole is inside."""
    count = max(points, int(_PER_TURN * (loop.delay + 1)))
    swing = np.sqrt(max(loop.gamma - 0.25 * loop.delta**2, 0.0))
    near = swing * np.logspace(-6, -1, 40)  # a lightly damped plant has a small region around its own angle
    theta = np.concatenate([np.pi * (np.arange(count) + 0.5) / count, swing - near, swing + near])
    theta = np.unique(theta[(theta > 0) & (theta < np.pi)])
    parts = _kept_parts(loop, lambda t: boundary_points(loop, t), theta)
    level = _line_at_minus_one(loop)
    top = max([float(part[1].max()) for part in parts], default=0.0) + loop.gamma
    along = -loop.gamma + (top + abs(level) + 1) * np.linspace(0, 1, count + 1)[1:] ** 2
    line = _kept_parts(loop, lambda a: (a, 0.5 * (level - a)), along)
    parts += [(np.full(len(part[0]), np.pi), *part[1:]) for part in line]
    if not parts:
        raise ParameterError(
            f"gamma = {loop.gamma}, delta = {loop.delta}, delay = {loop.delay}: no stable wall with alpha > -gamma."
        )
    theta, alpha, beta = (np.concatenate(c) for c in zip(*_chained(parts), strict=True))
    peak, top_index = int(np.argmax(alpha)), int(np.argmax(beta))
    return Boundary(
        alpha=alpha,
        beta=beta,
        theta=theta,
        alpha_max=float(alpha[peak]),
        beta_at_alpha_max=float(beta[peak]),
        beta_max=float(beta[top_index]),
        alpha_at_beta_max=float(alpha[top_index]),
    )


_Curve = Callable[[Floats], tuple[Floats, Floats]]
_Part = tuple[Floats, Floats, Floats]


def _line_at_minus_one(loop: Loop) -> float:
    """Value of alpha + 2 beta for which a real pole lies at z = -1: -1/G(-1)."""
    theta = np.array([np.pi * (1 - 1e-7)])  # W is even about pi: off by 1e-14; at pi itself beta divides by zero
    alpha, beta = boundary_points(loop, theta)
    return float((alpha + 2 * beta * np.sin(theta / 2) ** 2)[0])


def _kept_parts(loop: Loop, curve: _Curve, place: Floats) -> list[_Part]:
    """Return place, alpha and beta of each part of a curve that bounds the region, its ends and extrema refined."""

    def kept(t: Floats) -> Booleans:
        alpha, beta = curve(t)
        result = alpha + loop.gamma > 0
        inside = np.flatnonzero(result)
        result[inside] = spectral_radius(loop, alpha[inside], beta[inside]) < 1 + _ON_CIRCLE
        return result

    status = kept(place)
    flips = np.flatnonzero(status[1:] != status[:-1])
    good, bad = (np.where(status[flips] == want, place[flips], place[flips + 1]) for want in (True, False))
    good, _ = bisect(kept, good, bad)
    parts = []
    edges = np.concatenate([[0], flips + 1, [len(place)]])
    for first, last in pairwise(edges):
        if not status[first]:
            continue
        ends = good[(flips + 1 == first) | (flips + 1 == last)]
        part = np.unique(np.concatenate([place[first:last], ends]))
        extrema = [_maximise(partial(_component, curve, axis), part) for axis in (0, 1)]
        part = np.unique(np.concatenate([part, extrema]))
        parts.append((part, *curve(part)))
    return parts


def _chained(parts: list[_Part]) -> list[_Part]:
    """Order and turn parts so that each starts at the end of the one before, or nearest to it."""
    rest = sorted(parts, key=lambda part: float(part[2][0]))
    chain = [rest.pop(0)]
    while rest:  # ends: each round takes one part away
        end = np.array([chain[-1][1][-1], chain[-1][2][-1]])
        gaps = [min((float(np.hypot(p[1][i] - end[0], p[2][i] - end[1])), i) for i in (0, -1)) for p in rest]
        nearest = min(range(len(rest)), key=lambda j: gaps[j][0])
        part = rest.pop(nearest)
        chain.append(part if gaps[nearest][1] == 0 else (part[0][::-1], part[1][::-1], part[2][::-1]))
    return chain


def _last_angle(loop: Loop, theta: float) -> float:
    """Branch that reaches z = -1 (d < 1/2): the last angle below pi at which sin theta still has full precision."""
    for exponent in range(3, 8):
        candidate = np.pi * (1 - 10.0**-exponent)
        if boundary_points(loop, np.array([candidate]))[0][0] + loop.gamma > 0:
            theta = candidate
    return float(theta)


def _component(curve: Callable[[Floats], tuple[Floats, Floats]], axis: int, theta: Floats) -> Floats:
    return curve(theta)[axis]


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
