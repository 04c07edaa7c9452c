"""Limits of walls on a general loop: at given dampings, and along the whole region.

The limit at a damping is the upper end of the stable interval that begins at alpha -> 0; what is stable beyond an
unstable gap, or where soft walls are not, is an island.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.loop.loop import Loop
from pipeline.records.batch import Booleans, Floats, Integers
from pipeline.theory.device.circle import angle_of
from pipeline.theory.device.crossings import polished, stretches, turning_dampings

_NODES = np.concatenate([[1e-9], 0.5 * (1 - np.cos(np.pi * np.linspace(0, 1, 9)[1:-1])), [1 - 1e-9]])
"""Places between two dampings at which stretches change: next to both, where limits still have 11 digits, and where
corners are noticed."""

_MIDDLE = len(_NODES) // 2

_HALVINGS = 60
"""A gap between two dampings to the last bit of a double."""

_MOST_CORNERS = 8
"""Corners between two neighbours that are told apart; more than one is rare."""


@dataclass(frozen=True, eq=False)
class Limits:
    """Limits at dampings, normalised.

    Parameters
    ----------
    alpha : float64, shape (n,)
        Stiffest wall of the interval that begins at alpha -> 0; nan where there is none.
    angle : float64, shape (n,)
        Angle of the pole that leaves the unit circle there [rad/sample], pi of a real one.
    low, low_angle : float64, shape (n,)
        Its other end, -gamma where it begins on that line, and the angle there, nan on the line.
    islands : float64, shape (i, 3)
        Further stable intervals: beta, lowest and highest alpha > 0.
    """

    alpha: Floats
    angle: Floats
    low: Floats
    low_angle: Floats
    islands: Floats

    def part(self, which: Booleans) -> Limits:
        """Return those of some dampings, islands of all."""
        return Limits(self.alpha[which], self.angle[which], self.low[which], self.low_angle[which], self.islands)


@dataclass(frozen=True, eq=False)
class Outline:
    """The limit of walls over damping.

    Parameters
    ----------
    beta : float64, shape (n,)
        In order; empty where no soft wall is stable.
    limits : Limits
        There.
    islands : float64, shape (i, 3)
        As of `Limits`: at these beta, and between the first and the last at which anything is stable.
    alpha_max, beta_at_alpha_max : float
        The stiffest wall of all, islands left out; nan where there is none.
    ends : tuple of float
        Infimum and supremum of beta, to the last bit, where a limit can only be told beside it.
    """

    beta: Floats
    limits: Limits
    islands: Floats
    alpha_max: float
    beta_at_alpha_max: float
    ends: tuple[float, float]

    @property
    def alpha(self) -> Floats:
        """The limits themselves."""
        return self.limits.alpha


def limits(loop: Loop, beta: Floats, *, exact: bool = True, floor: float = 0.0) -> Limits:
    """Return the limit of walls at each beta.

    Parameters
    ----------
    loop : Loop
    beta : float64, shape (n,)
    exact : bool
        Whether crossings are polished in many digits; those of doubles else.
    floor : float
        Softest wall, -gamma to 0: intervals that begin there, or hold it, are no islands; none below it counts.
    """
    found = stretches(loop, beta)
    above = np.flatnonzero(found.high > floor)
    index, ends, at = found.index[above], np.stack([found.low, found.high])[:, above], (found.low_at, found.high_at)
    if exact:
        for end, place in zip(ends, at, strict=True):
            known = np.flatnonzero(np.isfinite(place[above]) & (end > floor))
            end[known] = polished(loop, beta[index[known]], place[above][known])
    low, high = ends
    soft = (low <= floor) | ((low <= 0) & (high > 0))
    ends = np.full((4, len(beta)), np.nan)
    angle = np.nan_to_num(angle_of(found.high_at[above]), nan=np.pi)
    ends[:, index[soft]] = np.array([np.maximum(high, floor), angle, low, angle_of(found.low_at[above])])[:, soft]
    return Limits(ends[0], ends[1], ends[2], ends[3], np.stack([beta[index], low, high], axis=1)[~soft])


def outline(loop: Loop, points: int = 400, floor: float = 0.0) -> Outline:
    """Return the limit of walls over all dampings at which there is one.

    Parameters
    ----------
    loop : Loop
    points : int
        Number of dampings of the outline, >= 8, spread over its parts and denser towards their ends; both sides of
        every corner and jump come beside these.
    floor : float
        As of `limits`.

    Notes
    -----
    Nothing is sampled to find where limits begin, end, jump or turn: `crossings.turning_dampings` are all of these but
    corners, and corners are met where neighbours are bounded by other branches.
    """
    turning = turning_dampings(loop)
    gaps = np.diff(turning)
    nodes = turning[:-1, None] + gaps[:, None] * _NODES
    marks = nodes[:, [0, -1]].ravel()
    marks = np.append(marks, _corners(loop, np.unique(nodes)))
    known = limits(loop, np.unique(np.append(nodes, marks)), exact=False, floor=floor)
    # what holds in the middle of a gap holds all over it
    holds = np.isfinite(limits(loop, nodes[:, _MIDDLE], exact=False, floor=floor).alpha)
    inside = np.concatenate([[False], holds, [False]])
    low, high = turning[np.flatnonzero(inside[1:] > inside[:-1])], turning[np.flatnonzero(inside[1:] < inside[:-1])]
    if not len(low):
        return Outline(np.zeros(0), limits(loop, np.zeros(0)), known.islands, np.nan, np.nan, (np.nan, np.nan))
    counts = np.maximum(8, points * (high - low) / (high - low).sum()).astype(int)
    spread = [
        start + (end - start) * 0.5 * (1 - np.cos(np.pi * np.linspace(0, 1, count)[1:-1]))
        for start, end, count in zip(low, high, counts, strict=True)
    ]
    beta = np.unique(np.concatenate([marks, *spread]))
    found = limits(loop, beta, floor=floor)
    kept = np.isfinite(found.alpha)
    beta, found = beta[kept], found.part(kept)
    best = int(np.argmax(found.alpha))
    peak, at = float(found.alpha[best]), float(beta[best])
    return Outline(beta, found, known.islands, peak, at, (float(low[0]), float(high[-1])))


def _corners(loop: Loop, levels: Floats) -> Floats:
    """Return both sides of each damping between levels, in order, at which other branches begin to bound."""
    known = _bounds(loop, levels)
    low, high, left, right = levels[:-1], levels[1:], known[:-1], known[1:]
    corners = [np.zeros(0)]
    for _ in range(_MOST_CORNERS):
        differ = left != right
        low, high, left, right = (values[differ] for values in (low, high, left, right))
        if not len(low):
            break
        good, bad = low, high
        for _ in range(_HALVINGS):
            middle = 0.5 * (good + bad)
            same = _bounds(loop, middle) == left
            good, bad = np.where(same, middle, good), np.where(same, bad, middle)
        corners += [good, bad]
        low, left = bad, _bounds(loop, bad)
    return np.concatenate(corners)


def _bounds(loop: Loop, beta: Floats) -> Integers:
    """Return a number for the branches that bound what is stable at each beta."""
    found, result = stretches(loop, beta), np.zeros(len(beta), np.intp)
    np.add.at(result, found.index, (found.outline + 1) ** 2)
    return result
