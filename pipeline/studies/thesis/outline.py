"""Outline of the stable region as lines to draw: the whole of it, or what lies in a window.

Source: Hulin 2017, secs. 3.4 and 4.3.3.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.loop.loop import Loop
from pipeline.records.batch import Floats
from pipeline.theory.stability.boundary import boundary
from pipeline.theory.stability.stability import boundary_points, spectral_radius

Window = tuple[float, float, float, float]
"""Lowest and highest alpha, lowest and highest beta."""

_ON_CIRCLE = 1e-7
"""Excess of a pole modulus that counts as on the unit circle: poles that nearly meet there are split by sqrt(1e-16)."""

_INWARDS = 1e-6
"""Distance from alpha = -gamma, relative to the window, at which its verdict is taken: on it a pole lies at z = 1."""

_NEAR_SWING = np.logspace(-7, -0.5, 500)
"""Relative distances from the plant's own angle: a lightly damped plant turns fast there."""

_CLOSE_TO_LINE = 1e-7
"""Distance from theta = pi that stands for it."""


def outline(loop: Loop, points: int = 300) -> tuple[Floats, Floats]:
    """Return alpha and beta along the closed outline of the stable region, for ordinary loops.

    For loops whose first branch does not enclose the region use `outline_in`. Both have the shape (points + 2,).
    """
    border = boundary(loop, points)
    start = boundary_points(loop, np.array([1e-4]))[1]  # the limit theta -> 0, off by theta^2
    alpha = np.concatenate([[-loop.gamma], border.alpha, [-loop.gamma]])
    beta = np.concatenate([start, border.beta, start])
    return alpha, beta


def outline_in(loop: Loop, window: Window, points: int = 3000) -> tuple[Floats, Floats]:
    """Return those parts of the outline of the stable region that lie in a window, separated by NaN.

    Parameters
    ----------
    loop : Loop
        Of any stiffness and damping.
    window : tuple
    points : int
        Angles at which all branches are sampled; more are added around the plant's own angle.

    Notes
    -----
    Of all branches, the line of a pole at z = -1 and the line alpha = -gamma, those points are kept at which no pole
    lies outside of the unit circle. Ends of a line are not refined: they are off by one step.

    Source: Hulin 2017, sec. 3.4 by the closed form in place of a grid.
    """
    theta = np.pi * (np.arange(points) + 0.5) / points
    swing = math.sqrt(max(loop.gamma - 0.25 * loop.delta**2, 0.0))
    theta = np.concatenate([theta, theta[:40] ** 2, swing * (1 - _NEAR_SWING), swing * (1 + _NEAR_SWING)])
    theta = np.unique(theta[(theta > _CLOSE_TO_LINE) & (theta < np.pi - _CLOSE_TO_LINE)])
    low, high, bottom, top = window
    alpha, beta = boundary_points(loop, np.array([np.pi * (1 - _CLOSE_TO_LINE)]))
    level = float((alpha + 2 * beta)[0])  # -1/G(-1); alpha + 2 beta is even about pi
    along = np.linspace(0, 1, max(points // 10, 20))
    beta_line, alpha_line = bottom + (top - bottom) * along, low + (high - low) * along
    curves = (
        boundary_points(loop, theta),
        (alpha_line, 0.5 * (level - alpha_line)),
        (np.full(len(along), -loop.gamma), beta_line),
    )
    pieces: list[tuple[Floats, Floats]] = []
    for a, b in curves:
        keep = (a >= low) & (a <= high) & (b >= bottom) & (b <= top) & (a >= -loop.gamma)
        at = np.flatnonzero(keep)
        inside = np.maximum(a[at], -loop.gamma + _INWARDS * (high - low))
        keep[at] = spectral_radius(loop, inside, b[at]) <= 1 + _ON_CIRCLE
        a, b = np.where(keep, a, np.nan), np.where(keep, b, np.nan)
        wanted = keep | np.append(False, keep[:-1])  # one NaN behind each stretch
        pieces.append((np.append(a[wanted], np.nan), np.append(b[wanted], np.nan)))
    return np.concatenate([p[0] for p in pieces]), np.concatenate([p[1] for p in pieces])
