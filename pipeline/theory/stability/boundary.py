"""The boundary of the stable region.

Source: Hulin 2017, sec. 3.4; the closed form on |z| = 1 instead of the gridding there.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.loop import Loop
from pipeline.records.batch import Floats
from pipeline.theory.device.circle import angle_of, circle_points, place_of
from pipeline.theory.device.outline import outline
from pipeline.theory.device.plain_branches import FirstBranch, first_branch

_FEWEST = 8
"""Points of an outline of which only the islands are asked for: they are known whatever its points."""


@dataclass(frozen=True, eq=False)
class Boundary:
    """Stability boundary: upper ends of the stable intervals that begin with the softest walls, over the damping.

    Parameters
    ----------
    alpha, beta, theta : float64, shape (n,)
        Points in order of beta, then back along what bounds the region from below, then those of islands; the angle
        of the pole that leaves the unit circle there, nan where that is not told.
    alpha_max, beta_at_alpha_max : float
        Largest stable alpha and its beta.
    beta_max, alpha_at_beta_max : float
        Largest stable beta and its alpha.
    beta_min : float
        Infimum of stable beta.
    islands : float64, shape (i, 3)
        Other stable intervals, as of `device.outline.Outline`.
    """

    alpha: Floats
    beta: Floats
    theta: Floats
    alpha_max: float
    beta_at_alpha_max: float
    beta_max: float
    alpha_at_beta_max: float
    beta_min: float
    islands: Floats = field(default_factory=lambda: np.zeros((0, 3)))


def boundary(loop: Loop, points: int = 400) -> Boundary:
    """Return the boundary of the stable region.

    Parameters
    ----------
    loop : Loop
    points : int
        About how many, >= 8.

    Raises
    ------
    ParameterError
        If fewer than 8 points are asked for, or nothing is stable.

    Notes
    -----
    Mostly it is one branch: it starts at theta -> 0 on the line alpha = -gamma, and ends where it meets that line
    again. Where several branches bound the region (a plant that resonates within the delay, damping above about 2 m/T
    without delay, filters), it is followed over the damping, with both sides of each corner. Walls softer than none
    count on a loop without parts only.

    Source: Hulin 2017, sec. 3.4; reproduces Tables B.1 to B.4.
    """
    if points < 8:
        raise ParameterError(f"points = {points}: expected at least 8.")
    first = first_branch(loop)
    return _along(first, points) if first is not None else _over_dampings(loop, points)


def has_islands(loop: Loop) -> bool:
    """Return whether walls are stable somewhere beyond an unstable stretch of softer ones, down to alpha -> 0."""
    return first_branch(loop) is None and len(outline(loop, _FEWEST).islands) > 0


def stabilises(loop: Loop) -> bool:
    """Return whether any damping stabilises a soft wall."""
    return first_branch(loop) is not None or len(outline(loop, _FEWEST).beta) > 0


def _along(first: FirstBranch, points: int) -> Boundary:
    """Boundary by the angle, whose largest damping is that of its end."""
    # cosine spacing: dense at both ends, where the branch meets the line alpha = -gamma
    share = 0.5 * (1 - np.cos(np.pi * (np.arange(points) + 0.5) / points))
    place = np.minimum(place_of(float(angle_of(np.array(first.end))) * share), first.end)
    place = np.append(np.sort(np.append(place, first.peak)), first.end)
    p, peak = circle_points(first.loop, place), circle_points(first.loop, np.array([first.peak]))
    p.alpha[-1] = 0.0 - first.loop.gamma  # by definition of the end
    ends = float(p.beta[-1]), float(p.alpha[-1]), float(first.cells.beta_low[0])
    return Boundary(p.alpha, p.beta, angle_of(place), float(peak.alpha[0]), float(peak.beta[0]), *ends)


def _over_dampings(loop: Loop, points: int) -> Boundary:
    floor = 0.0 if loop.has_parts else -loop.gamma
    found = outline(loop, points, floor)
    if not len(found.beta):
        raise ParameterError(f"{loop}: no damping stabilises a soft wall. Check delay, lag and velocity filter.")
    f, b, extremes = found.limits, found.beta, [(found.alpha_max, found.beta_at_alpha_max)]
    lowest, top = found.ends[0], (found.ends[1], float(f.alpha[-1]))
    if loop.has_parts:
        return Boundary(f.alpha, b, f.angle, *extremes[0], *top, lowest, found.islands)
    extremes += [(high, beta) for beta, _, high in found.islands.tolist()]
    # back along what bounds it from below; what is stable beyond gaps follows
    below, (at, ends) = np.flatnonzero(f.low > -loop.gamma)[::-1], (found.islands[:, 0], found.islands[:, 1:].T)
    alpha = np.concatenate([f.alpha, f.low[below], ends[1], ends[0][::-1]])
    beta = np.concatenate([b, b[below], at, at[::-1]])
    theta = np.concatenate([f.angle, f.low_angle[below], np.full(2 * len(at), np.nan)])
    lowest = min([lowest, *found.islands[:, 0].tolist()])
    top = max([top, *((b, high) for b, _, high in found.islands.tolist())])
    return Boundary(alpha, beta, theta, *max(extremes), *top, lowest, found.islands)
