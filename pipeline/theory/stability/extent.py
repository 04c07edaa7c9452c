"""Limits of the stable region: largest stiffness, dampings, and how far the linear condition carries.

Everything is read from the exact branches of `region`. Where several branches bound the region, its corners are found
by bisection of the verdict.

Source: Hulin 2017, secs. 3.4, 3.5 and 4.3.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import ParameterError
from pipeline.loop.loop import Loop
from pipeline.records.batch import Booleans, Floats
from pipeline.theory.stability.branches import Cells, curve_points
from pipeline.theory.stability.region import Region, region, solve, stable_intervals, stiffness_limit
from pipeline.theory.stability.stability import bisect

_SWEEP = 400
"""Dampings of a sweep through a region that several branches bound; parts below 1/400 of its height are not seen."""

_ZOOMS = 24
"""Rounds of a search that narrows to a fifth each time: to rounding, for corners; a flat maximum needs half of them."""

_BRANCHES = 1 << 12
"""More than the branches between two of which an interval may lie."""

_MOST_CORNERS = 20
"""Corners between two neighbours of a sweep that are told apart; more than one is rare."""


def damping_range(loop: Loop) -> tuple[float, float]:
    """Return the infimum and supremum of stable beta.

    Raises
    ------
    ParameterError
        If no wall with alpha > -gamma is stable.
    """
    r = region(loop)
    if r.first is not None:
        return r.curve.start, float(curve_points(r.curve, np.array([_first_end(r, r.first)])).beta[0])
    levels = _levels(r)
    found = np.flatnonzero(_any_stable(loop, levels))
    if not len(found):
        raise ParameterError(
            f"gamma = {loop.gamma}, delta = {loop.delta}, delay = {loop.delay}: no stable wall with alpha > -gamma."
        )
    inner = levels[found[[0, -1]]]
    outer = levels[[max(found[0] - 1, 0), min(found[-1] + 1, len(levels) - 1)]]
    ends, _ = bisect(lambda b: _any_stable(loop, b), inner, outer)
    return float(ends[0]), float(ends[1])


def stiffest_point(loop: Loop) -> tuple[float, float]:
    """Return the supremum of stable alpha and the beta at which it is reached.

    Raises
    ------
    ParameterError
        If no wall with alpha > -gamma is stable.
    """
    r = region(loop)
    if r.first is not None:
        p = curve_points(r.curve, np.array([_peak(r, r.first)[1]]))
        return float(p.alpha[0]), float(p.beta[0])
    levels = _corners(loop, r)
    best = int(np.argmax(stiffness_limit(loop, levels)))
    low, high = levels[max(best - 1, 0)], levels[min(best + 1, len(levels) - 1)]
    peak, at = -np.inf, 0.0
    for _ in range(_ZOOMS):
        grid = np.append(np.linspace(low, high, 11), levels[best])
        limit = stiffness_limit(loop, grid)
        i = int(np.argmax(limit))
        if limit[i] > peak:
            peak, at = float(limit[i]), float(grid[i])
        reach = 0.2 * (high - low)
        low, high = max(low, at - 0.5 * reach), min(high, at + 0.5 * reach)
    return peak, at


def _any_stable(loop: Loop, beta: Floats) -> Booleans:
    return np.isin(np.arange(len(beta)), stable_intervals(loop, beta).index)


def _levels(r: Region) -> Floats:
    """Sweep of beta over all of the plane that a stable region can lie in, with the values at which branches turn."""
    cells = r.cells
    assert cells is not None
    near = np.maximum(cells.alpha_low, cells.alpha_high) >= -r.loop.gamma
    turn = np.flatnonzero(np.diff(np.sign(cells.beta_high - cells.beta_low)) != 0)
    meet = cells.alpha_low + r.loop.gamma, cells.alpha_high + r.loop.gamma
    at = np.flatnonzero((meet[0] > 0) != (meet[1] > 0))
    share = meet[0][at] / (meet[0][at] - meet[1][at])
    values = np.concatenate(
        [
            cells.beta_high[turn][near[turn]],
            cells.beta_low[at] + share * (cells.beta_high[at] - cells.beta_low[at]),
            [r.curve.start, 0.0],
            [0.5 * (r.curve.level + r.loop.gamma)] if np.isfinite(r.curve.level) else [],
        ]
    )
    largest = 4 / (r.loop.delay + 0.5) + 4 * (1 + r.loop.delta + r.loop.gamma)
    values = np.unique(np.clip(values, -largest, largest))
    beyond = 0.05 * (values[-1] - values[0])  # the values that were interpolated may lie inside
    values = np.concatenate([[values[0] - beyond], values, [values[-1] + beyond]])
    fine = np.linspace(0, 1, 12)[1:-1]
    between = values[:-1, None] + np.diff(values)[:, None] * fine
    return np.unique(np.concatenate([values, between.ravel(), np.linspace(values[0], values[-1], _SWEEP)]))


def _outline(loop: Loop, beta: Floats) -> NDArray[np.intp]:
    """Number for the branches that bound the region on each line of beta; the same branches have the same number."""
    found = stable_intervals(loop, beta)
    result = np.zeros(len(beta), dtype=np.intp)
    np.add.at(result, found.index, (found.low_of * _BRANCHES + found.high_of + 1) ** 2)
    return result


def _has_outline(loop: Loop, expected: NDArray[np.intp], beta: Floats) -> Booleans:
    return np.asarray(_outline(loop, beta) == expected)


def _corners(loop: Loop, r: Region) -> Floats:
    """Values of beta between which the length of stable alpha is smooth."""
    bottom, top = damping_range(loop)
    levels = _levels(r)
    levels = np.concatenate(
        [levels[(levels > bottom) & (levels < top)], bottom + (top - bottom) * np.linspace(0, 1, _SWEEP)]
    )
    levels = np.unique(levels)
    known = _outline(loop, levels)
    low, high = levels[:-1], levels[1:]
    left, right = known[:-1], known[1:]
    corners = [levels]
    for _ in range(_MOST_CORNERS):
        differ = left != right
        if not differ.any():
            break
        low, high, left, right = (v[differ] for v in (low, high, left, right))
        first, after = bisect(partial(_has_outline, loop, left), low, high)
        corners += [first, after]
        low, left = after, _outline(loop, after)
    return np.unique(np.concatenate(corners))


def smooth_levels(loop: Loop, points: int, also: float) -> Floats:
    """Return dampings, in order, over the range of stable ones: both sides of each corner, even ones, and another."""
    bottom, top = damping_range(loop)
    even = bottom + (top - bottom) * 0.5 * (1 - np.cos(np.pi * np.linspace(0, 1, points)))
    r = region(loop)
    corners = np.zeros(0) if r.first is not None else _corners(loop, r)
    return np.unique(np.concatenate([corners, even, [also]]))


def _peak(r: Region, first: Cells) -> tuple[int, float]:
    """Cell and angle of the stiffest point of the first branch."""
    cell = int(np.flatnonzero(~first.rises)[0])
    ends = first.low[[cell]], first.high[[cell]]
    low, high = bisect(lambda angle: curve_points(r.curve, angle).alpha_slope > 0, *ends)
    return cell, float(0.5 * (low + high)[0])


def _first_end(r: Region, first: Cells) -> float:
    """Angle at which the first branch returns to alpha = -gamma."""
    last = np.array([len(first.low) - 1])
    return float(solve(r.curve, first, last, np.array([-r.loop.gamma]), "alpha")[0])
