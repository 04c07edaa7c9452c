"""Limits of walls on a general loop: at given dampings, and along the whole region.

The limit at a damping is the upper end of the stable interval that begins at alpha -> 0; what is stable beyond an
unstable gap, or where soft walls are not, is an island.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.loop.device_loop import DeviceLoop
from pipeline.records.batch import Booleans, Floats
from pipeline.theory.device.crossings import branches, points_at, polished, stretches

_PER_CELL = 32
"""Places of each cell whose dampings are looked at first."""

_SECTIONS = 32
"""Parts of an interval of damping that are looked at together: a call costs as much as hundreds of dampings."""

_EDGE_ROUNDS = 11
"""32^11 = 2^55: the damping at which limits begin or end, to the last bit of a double."""

_PEAK_ROUNDS = 9
"""16^9 = 7e10: the damping of the stiffest wall, about which the limit is flat."""


@dataclass(frozen=True, eq=False)
class Limits:
    """Limits at dampings, normalised.

    Parameters
    ----------
    alpha : float64, shape (n,)
        Stiffest wall of the interval that begins at alpha -> 0; nan where there is none.
    angle : float64, shape (n,)
        Angle of the pole that leaves the unit circle there [rad/sample], pi of a real one.
    islands : float64, shape (i, 3)
        Further stable intervals: beta, lowest and highest alpha > 0.
    """

    alpha: Floats
    angle: Floats
    islands: Floats


@dataclass(frozen=True, eq=False)
class Outline:
    """The limit of walls over damping.

    Parameters
    ----------
    beta, alpha : float64, shape (n,)
        In order of beta; empty where no soft wall is stable.
    islands : float64, shape (i, 3)
        As of `Limits`, at these beta and at those of stable walls without a limit.
    alpha_max, beta_at_alpha_max : float
        The stiffest wall of all, islands left out; nan where there is none.
    """

    beta: Floats
    alpha: Floats
    islands: Floats
    alpha_max: float
    beta_at_alpha_max: float


def limits(loop: DeviceLoop, beta: Floats, *, exact: bool = True) -> Limits:
    """Return the limit of walls at each beta.

    Parameters
    ----------
    loop : DeviceLoop
    beta : float64, shape (n,)
    exact : bool
        Whether crossings are polished in many digits; some 11 digits else.
    """
    found = stretches(loop, beta)
    above = np.flatnonzero(found.high > 0)
    index, ends, at = found.index[above], np.stack([found.low, found.high])[:, above], (found.low_at, found.high_at)
    if exact:
        for end, place in zip(ends, at, strict=True):
            known = np.flatnonzero(np.isfinite(place[above]) & (end > 0))
            end[known] = polished(loop, beta[index[known]], place[above][known])
    low, high = ends
    soft = low <= 0
    alpha = np.full(len(beta), np.nan)
    alpha[index[soft]] = np.maximum(high[soft], 0.0)
    angle = np.full(len(beta), np.nan)
    angle[index[soft]] = np.nan_to_num(2 * np.arctan(np.exp(0.5 * found.high_at[above][soft])), nan=np.pi)
    return Limits(alpha, angle, np.stack([beta[index], low, high], axis=1)[~soft])


def outline(loop: DeviceLoop, points: int = 400) -> Outline:
    """Return the limit of walls over all dampings at which there is one.

    Parameters
    ----------
    loop : DeviceLoop
    points : int
        Number of dampings of the outline, >= 8, spread over its parts and denser towards their ends.
    """
    tried = _dampings(loop)
    known = limits(loop, tried, exact=False)
    ends = _ends(loop, tried, np.isfinite(known.alpha))
    if not len(ends):
        return Outline(np.zeros(0), np.zeros(0), known.islands, np.nan, np.nan)
    widths = ends[:, 1] - ends[:, 0]
    parts = []
    for (low, _high), width in zip(ends, widths, strict=True):
        count = max(8, int(points * width / widths.sum()))
        parts.append(low + width * 0.5 * (1 - np.cos(np.pi * np.linspace(0, 1, count))))
    beta = np.concatenate(parts)
    stiffest = _stiffest(loop, np.sort(np.concatenate([tried, beta])))
    beta = np.unique(np.append(beta, stiffest))
    found = limits(loop, beta)
    beta, alpha = beta[np.isfinite(found.alpha)], found.alpha[np.isfinite(found.alpha)]
    without = known.islands[~((known.islands[:, :1] >= ends[:, 0]) & (known.islands[:, :1] <= ends[:, 1])).any(axis=1)]
    best = int(np.argmax(alpha))
    islands = np.concatenate([found.islands, without])
    return Outline(beta, alpha, islands[np.argsort(islands[:, 0])], float(alpha[best]), float(beta[best]))


def _dampings(loop: DeviceLoop) -> Floats:
    """Return dampings of places all along the branches where alpha is no spring that pulls, in order."""
    b = branches(loop)
    share = (np.arange(_PER_CELL) + 0.5) / _PER_CELL
    place = (b.low[:, None] + (b.high - b.low)[:, None] * share).ravel()
    alpha, beta = points_at(loop, place)
    turning = b.beta_low[np.isfinite(b.beta_low)]
    # the line of a pole at z = -1 bounds what the branches leave open
    far = (b.last + loop.gamma) / b.last_slope if b.last_slope and np.isfinite(b.last) else 0.0
    line = far * np.linspace(0, 1, _PER_CELL + 1)
    return np.unique(np.concatenate([beta[np.isfinite(beta) & (alpha > -loop.gamma)], turning, line]))


def _ends(loop: DeviceLoop, beta: Floats, has: Booleans) -> Floats:
    """Return the first and last damping of each part that has limits, shape (parts, 2)."""
    padded = np.concatenate([[False], has, [False]])
    changes = np.flatnonzero(padded[1:] != padded[:-1])
    inner, outer = (
        np.where(padded[1:][changes], changes, changes - 1),
        np.where(padded[1:][changes], changes - 1, changes),
    )
    good, bad = beta[inner], beta[np.clip(outer, 0, len(beta) - 1)]
    share = np.linspace(0, 1, _SECTIONS + 1)
    for _ in range(_EDGE_ROUNDS):
        between = good[:, None] + share * (bad - good)[:, None]
        holds = np.isfinite(limits(loop, between.ravel(), exact=False).alpha).reshape(between.shape)
        holds[:, 0] = True
        last = np.where(holds.all(axis=1), _SECTIONS, holds.argmin(axis=1) - 1)
        row = np.arange(len(good))
        good, bad = between[row, last], between[row, np.minimum(last + 1, _SECTIONS)]
    return good.reshape(-1, 2)


def _stiffest(loop: DeviceLoop, beta: Floats) -> float:
    """Return the damping of the stiffest wall: the best of those given, then zooms around it."""
    for _ in range(_PEAK_ROUNDS):
        alpha = limits(loop, beta, exact=False).alpha
        best = int(np.nanargmax(alpha))
        low, high = beta[max(best - 1, 0)], beta[min(best + 1, len(beta) - 1)]
        beta = np.append(np.linspace(low, high, _SECTIONS + 1), beta[best])
        beta.sort()
    return float(beta[np.nanargmax(limits(loop, beta, exact=False).alpha)])
