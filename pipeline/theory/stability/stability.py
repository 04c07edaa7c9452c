"""Stability of the loop: poles, spectral radius, and the closed form of its boundary.

Source: Hulin 2017, secs. 3.4 and 3.5; the boundary by the closed form on |z| = 1 instead of the gridding of 3.4.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pipeline.loop.loop import Loop, as_points
from pipeline.records.batch import Booleans, Floats
from pipeline.theory.device.circle import circle_points, place_of

_CHUNK = 8192
"""Points whose eigenvalues are computed at a time; bounds memory to about 40 MB at d = 16."""


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


def boundary_points(loop: Loop, theta: Floats) -> tuple[Floats, Floats]:
    """Return the points (alpha, beta) at which a pole pair lies on the unit circle at the angles +-theta.

    On |z| = 1 the characteristic equation is linear in alpha and beta: alpha + beta N = -1/G (`device.circle`).

    Parameters
    ----------
    loop : Loop
    theta : float64, shape (n,)
        Angles, 0 < theta < pi.
    """
    found = circle_points(loop, place_of(theta))
    return found.alpha, found.beta


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
