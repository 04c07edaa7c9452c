"""The stable region from its closed-form boundary: verdicts, margins, limits and size, without eigenvalues.

On a line of constant beta, pole pairs cross the unit circle where a branch has that beta, each time in the direction
that the branch turns there, and real poles at alpha = -gamma (z = 1) and on the line of z = -1. With the number of
unstable poles of infinitely stiff walls, which is that of the zeros and the delay, this counts the unstable poles
everywhere. For ordinary loops the first branch alone encloses the region and the count is needed once.

Source: Hulin 2017, sec. 3.4; counting of crossings in place of gridding and poles.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import lru_cache

import numpy as np

from pipeline.loop.loop import Loop, as_points
from pipeline.records.batch import Booleans, Floats
from pipeline.theory.device.crossings import stretches
from pipeline.theory.stability.branches import (
    FOLD,
    Cells,
    Curve,
    Indices,
    beta_above_start,
    cells_between,
    curve,
    curve_points,
    folded,
)
from pipeline.theory.stability.stability import bisect, is_stable

_PER_TURN = 48
"""Samples of each turn of the delayed plant; the branches are smooth on that scale."""

_PER_DECADE = 8
"""Samples per decade of the distance from theta = pi, where zeros or poles of the plant may lie close together."""

_NONE = 1e-90
"""Scale of the curve [1] up to which it is none: products of three reciprocals of smaller numbers overflow."""

_CLOSE = 1e-6
"""Smallest sampled distance from theta = pi, relative to that of the nearest zero or pole of the plant."""

_APART = 0.05
"""Distance between the first branch and all others, relative to the width, from which on the first surely encloses."""

_ITERATIONS = 100
"""More than any bracketed Newton iteration needs: bisection of a double's range of mantissas takes 53."""

_CONVERGED = 1e-10
"""Newton step, relative to the angle, after which the next one is below rounding."""

_PAIRS = 4_000_000
"""Pairs of a damping and a cell looked at together; bounds memory to some 10 MB."""


def _angles(c: Curve) -> Floats:
    """Folded angles that sample all branches, in order of theta."""
    theta = np.linspace(0.0, np.pi, int(_PER_TURN * (c.delay + 1)) + 1)[:-1]
    scales = [1.0, c.chi, c.k / c.f, abs(c.last) / c.total if c.total else 0.0]
    scales += [scale**0.5 for scale in scales[3:]]
    nearest = min(scale for scale in scales if scale > _NONE)  # nan compares false
    step = np.pi - theta[-1]
    decades = np.log10(step / (nearest * _CLOSE))
    close = step * 10.0 ** -np.linspace(0, decades, int(_PER_DECADE * decades) + 2)[1:]
    lower = theta[theta < FOLD]
    return np.concatenate([lower, [FOLD], folded(np.append(np.nextafter(FOLD, 4), theta[theta > FOLD])), -close])


@dataclass(frozen=True, eq=False)
class Region:
    """What is known of a loop's stable region once, for all questions.

    Parameters
    ----------
    loop, curve
        The loop and the constants of its branches.
    first : Cells or None
        The first branch up to the line alpha = -gamma, where it alone encloses the region.
    cells : Cells or None
        All branches, where they are needed.
    """

    loop: Loop
    curve: Curve
    first: Cells | None
    cells: Cells | None


@lru_cache(maxsize=512)
def region(loop: Loop) -> Region:
    """Return the stable region of a loop.

    Notes
    -----
    The first branch encloses the region if beta grows along it, alpha has one maximum and returns to -gamma, all
    other branches, also where they pass alpha = -gamma, and the line of z = -1 lie outside, and the count of unstable
    poles inside is 0. Otherwise all branches are kept.
    """
    c = curve(loop)
    angle = _angles(c)
    p = curve_points(c, angle)
    width = p.alpha + loop.gamma
    back = np.flatnonzero(width[1:] <= 0)
    if len(back) and back[0] > 0:
        end = int(back[0]) + 2
        a, b = p.alpha[:end], p.beta[:end]
        grows = bool((np.diff(b) >= 0).all() and (p.beta_slope[1:end] > 0).all())
        turns = int(np.count_nonzero(np.diff(np.sign(p.alpha_slope[1:end]))))
        if grows and turns == 1:
            others = slice(end, None)
            limit = np.interp(p.beta[others], b, a, left=-np.inf, right=-np.inf)
            room = 1 + _APART
            outside = bool(((width[others] <= 0) | (width[others] >= room * (limit + loop.gamma))).all())
            # what enters between two samples enters by the line alpha = -gamma
            meets = _passings(width[end - 1 :], p.beta[end - 1 :])
            beyond = _APART * (b[-1] - b[0])
            outside &= bool(((meets < b[0] - beyond) | (meets > b[-1] + beyond)).all())
            line = a + 2 * b
            beside = bool(c.level > line.max() * room or c.level < min(line.min(), -loop.gamma + 2 * float(b[0])))
            middle = int(np.argmax(a))
            if outside and beside and _unstable_poles(c, p.alpha, p.beta, middle) == 0:
                return Region(loop, c, cells_between(c, angle[:end]), None)
    return Region(loop, c, None, cells_between(c, _with_extrema(c, angle, p.beta_slope)))


def _passings(width: Floats, beta: Floats) -> Floats:
    """Return beta where the width between successive points passes zero."""
    at = np.flatnonzero((width[:-1] > 0) != (width[1:] > 0))
    return beta[at] + width[at] / (width[at] - width[at + 1]) * (beta[at + 1] - beta[at])


def _unstable_poles(c: Curve, alpha: Floats, beta: Floats, index: int) -> int:
    """Count the unstable poles just left of a sampled point, by crossings to its left read from the samples."""
    level = beta[index] * (1 - 1e-9)
    below = beta < level
    at = np.flatnonzero(below[:-1] != below[1:])
    share = (level - beta[at]) / (beta[at + 1] - beta[at])
    crossing = alpha[at] + share * (alpha[at + 1] - alpha[at])
    point = alpha[index] - 1e-3 * (alpha[index] + c.gamma)
    count = c.whole + 1 + c.zeros_outside() + _extra_zero(c, -1)
    count += 2 * int((np.sign(beta[at + 1] - beta[at]) * (crossing < point)).sum())
    count += -1 if level > c.start else 1
    if c.level - 2 * level < point:
        count += -1 if level < beta[-1] else 1
    return count


def _extra_zero(c: Curve, side: int) -> int:
    """Whether the pole that tends to a zero at z = -1 for alpha -> -inf (side -1) or inf (1) does so from outside."""
    if np.isfinite(c.level):
        return 0
    return int((c.whole % 2 == 1) == (side < 0))


def _with_extrema(c: Curve, angle: Floats, slope: Floats) -> Floats:
    """Angles with the extrema of beta among them."""
    turns = (slope[:-1] > 0) != (slope[1:] > 0)
    turns &= ((angle[:-1] < 0) == (angle[1:] < 0)) & (angle[:-1] != 0)
    at = np.flatnonzero(turns)
    low, high = angle[at], angle[at + 1]
    rising = slope[at] > 0
    low, high = bisect(lambda t: (curve_points(c, t).beta_slope > 0) == rising, low, high)
    return np.insert(angle, at + 1, 0.5 * (low + high))


def solve(c: Curve, cells: Cells, cell: Indices, target: Floats, axis: str) -> Floats:
    """Return the folded angles at which ``axis``, "beta" or "alpha", takes target values in cells where it is monotone.

    Newton's method from an interpolation in the square of the angle, of which both are smooth functions; a step that
    leaves the bracket is replaced by bisection.
    """
    low, high = cells.low[cell], cells.high[cell]
    ends = getattr(cells, axis + "_low")[cell], getattr(cells, axis + "_high")[cell]
    rising = ends[1] > ends[0]
    share = (target - ends[0]) / (ends[1] - ends[0])
    root = np.where(high > 0, 1.0, -1.0) * np.sqrt(low**2 + share * (high**2 - low**2))
    active = np.arange(len(target))
    near_start = axis == "beta" and c.gamma == 0 and c.h > 0
    for _ in range(_ITERATIONS):
        if not len(active):
            break
        x = root[active]
        p = curve_points(c, x)
        miss = getattr(p, axis) - target[active]
        if near_start:
            first = np.flatnonzero(x >= 0)
            miss[first] = beta_above_start(c, x[first]) - (target[active[first]] - c.start)
        above = (miss > 0) == rising[active]
        high[active] = np.where(above, x, high[active])
        low[active] = np.where(above, low[active], x)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = miss / getattr(p, axis + "_slope")
        new = x - step
        newton = (new >= low[active]) & (new <= high[active])
        root[active] = np.where(newton, new, 0.5 * (low[active] + high[active]))
        done = newton & (np.abs(step) <= _CONVERGED * np.abs(x))
        done |= (miss == 0) | (high[active] - low[active] <= 2e-16 * np.abs(high[active]))
        root[active] = np.where(miss == 0, x, root[active])
        active = active[~done]
    return np.asarray(root)


def _first_limit(r: Region, first: Cells, beta: Floats) -> tuple[Floats, Floats]:
    """Alpha on the first branch at given beta, -inf where it has no stable point, and its angle theta."""
    at = np.searchsorted(first.beta_high, beta)
    inside = (beta > first.beta_low[0]) & (at < len(first.low))
    cell = at[inside]
    root = solve(r.curve, first, cell, beta[inside], "beta")
    alpha = curve_points(r.curve, root).alpha
    result, angle = np.full(len(beta), -np.inf), np.full(len(beta), np.nan)
    result[inside] = np.where(alpha > -r.loop.gamma, alpha, -np.inf)
    angle[inside] = np.where(root < 0, root + np.pi, root)
    return result, angle


@dataclass(frozen=True, eq=False)
class Intervals:
    """Stable intervals of alpha, shape (n,): index of their beta, lower and upper end, beta by beta and upwards.

    ``low_of`` and ``high_of`` are numbers of the branches that bound an interval (0 is the line alpha = -gamma), of an
    ideal loop that several bound; ``low_angle`` and ``high_angle`` the angles of the poles there, pi on the line of
    z = -1. ``doubtful`` are the indices of beta at which the count does not come out and nothing can be said.
    """

    index: Indices
    low: Floats
    high: Floats
    low_of: Indices
    high_of: Indices
    low_angle: Floats
    high_angle: Floats
    doubtful: Indices

    @classmethod
    def plain(cls, index: Indices, low: Floats, high: Floats) -> Intervals:
        """Return intervals of which no branch is told."""
        none, unknown = np.zeros(len(index), np.intp), np.full(len(index), np.nan)
        return cls(index, low, high, none, none, unknown, unknown, none[:0])


def stable_intervals(loop: Loop, beta: object) -> Intervals:
    """Return the intervals of alpha that are stable at each beta, array_like of shape (n,)."""
    _, b = as_points(0.0, beta)
    if loop.has_parts:
        found = stretches(loop, b)
        return Intervals.plain(found.index, found.low, found.high)
    r = region(loop)
    if r.first is not None:
        limit, angle = _first_limit(r, r.first, b)
        index = np.flatnonzero(limit > -np.inf)
        plain = Intervals.plain(index, np.full(len(index), -loop.gamma), limit[index])
        return replace(plain, high_of=plain.high_of + 2, high_angle=angle[index])
    assert r.cells is not None
    chunk = max(1, _PAIRS // len(r.cells.low))
    parts = [_counted(r, r.cells, b[i : i + chunk]) for i in range(0, len(b), chunk)]
    for part, offset in zip(parts, range(0, len(b), chunk), strict=True):
        part.index[:] += offset
        part.doubtful[:] += offset
    return Intervals(*(np.concatenate([getattr(p, field.name) for p in parts]) for field in fields(Intervals)))


def _counted(r: Region, cells: Cells, beta: Floats) -> Intervals:
    """Stable intervals by counting unstable poles over all crossings of each beta."""
    c, n = r.curve, len(beta)
    crossed = (cells.beta_low[None] < beta[:, None]) != (cells.beta_high[None] < beta[:, None])
    which, cell = np.nonzero(crossed)
    rising = cells.beta_high[cell] > cells.beta_low[cell]
    root = solve(c, cells, cell, beta[which], "beta")
    everyone = np.arange(n)
    at = [curve_points(c, root).alpha, np.full(n, -r.loop.gamma)]
    index = [which, everyone]
    jump = [np.where(rising, 2, -2), np.where(beta > c.start, -1, 1)]
    source = [2 + cells.stretch[cell], np.zeros(n, np.intp)]
    angle = [np.where(root < 0, root + np.pi, root), np.zeros(n)]
    if np.isfinite(c.level):
        at.append(c.level - 2 * beta)
        index.append(everyone)
        jump.append(np.where(beta < cells.beta_high[-1], -1, 1))
        source.append(np.ones(n, np.intp))
        angle.append(np.full(n, np.pi))
    a, i, j = np.concatenate(at), np.concatenate(index), np.concatenate(jump)
    order = np.lexsort((a, i))
    a, i, j, of, theta = a[order], i[order], j[order], np.concatenate(source)[order], np.concatenate(angle)[order]
    base = c.whole + 1 + c.zeros_outside()
    total = np.cumsum(j)
    last = np.searchsorted(i, everyone, side="right") - 1
    before = np.concatenate([[0], total[last[:-1]]])
    count = total - before[i] + base + _extra_zero(c, -1)
    doubtful = np.zeros(n, np.bool_)
    doubtful[i[count < 0]] = True
    doubtful |= count[last] != base + _extra_zero(c, 1)
    stable = np.flatnonzero((count[:-1] == 0) & (i[1:] == i[:-1]) & (a[:-1] >= -r.loop.gamma) & (a[1:] > a[:-1]))
    stable = stable[~doubtful[i[stable]]]
    above = stable + 1
    ends = a[stable], a[above], of[stable], of[above], theta[stable], theta[above]
    return Intervals(i[stable], *ends, np.flatnonzero(doubtful))


def is_inside(loop: Loop, alpha: object, beta: object) -> Booleans:
    """Return which points are stable: all poles inside the unit circle.

    Parameters
    ----------
    loop : Loop
    alpha, beta : array_like, shape (n,)
        Normalised virtual stiffness and damping.

    Notes
    -----
    Most points lie beside the whole cell of the first branch at their beta and need no more than a comparison; for
    the others the branch is solved for their beta. Right up to rounding of the boundary: nothing is promised for
    spectral radii nearer to 1 than 1e-12. Where the count of crossings does not come out, eigenvalues decide.

    Source: Hulin 2017, sec. 3.4.
    """
    a, b = as_points(alpha, beta)
    if loop.has_parts:
        return np.asarray(_margins(loop, a, b) > 0)
    r = region(loop)
    if r.first is None:
        return np.asarray(_margins(loop, a, b) > 0)
    first = r.first
    at = np.searchsorted(first.beta_high, b)
    result = (b > first.beta_low[0]) & (at < len(first.low)) & (a > -loop.gamma)
    cell = np.minimum(at, len(first.low) - 1)
    lowest = np.minimum(first.alpha_low, first.alpha_high)
    highest = np.where(first.rises | first.falls, np.maximum(first.alpha_low, first.alpha_high), np.inf)
    lowest = np.where(first.rises | first.falls, lowest, -np.inf)
    result &= a < highest[cell]
    open_ = np.flatnonzero(result & (a >= lowest[cell]))
    result[open_] = a[open_] < _first_limit(r, first, b[open_])[0]
    return np.asarray(result)


def is_well_inside(loop: Loop, alpha: Floats, beta: Floats, share: float = 1e-9, *, islands: bool = True) -> Booleans:
    """Return where points are stable and stay so when alpha is moved either way by a share of alpha + gamma, (n,).

    Costs of points closer to the boundary are sums over billions of samples, and rounding errors. Without ``islands``
    a wall counts only if every softer one at its damping is stable too, down to alpha -> 0.
    """
    away = share * (alpha + loop.gamma)
    return np.asarray((away > 0) & (_margins(loop, alpha, beta, islands=islands) > away))


def _margins(loop: Loop, alpha: Floats, beta: Floats, *, islands: bool = True) -> Floats:
    """Return the distance of alpha to the nearer end of its stable interval, below zero where it is in none, (n,)."""
    levels, of = np.unique(beta, return_inverse=True)
    found = stable_intervals(loop, levels)
    kept = np.flatnonzero(islands | (found.low <= 0))
    index, low, high = found.index[kept], found.low[kept], found.high[kept]
    result = np.full(len(alpha), -np.inf)
    counts = np.bincount(index, minlength=len(levels))
    start = np.cumsum(counts) - counts
    for number in range(int(counts.max(initial=0))):  # as many rounds as a line has stable intervals: few
        has = np.flatnonzero(counts[of] > number)
        row = start[of[has]] + number
        result[has] = np.maximum(result[has], np.minimum(alpha[has] - low[row], high[row] - alpha[has]))
    unknown = np.flatnonzero(np.isin(of, found.doubtful))
    if len(unknown):
        result[unknown] = np.where(is_stable(loop, alpha[unknown], beta[unknown]), np.inf, -np.inf)
    return result


def stiffness_limit(loop: Loop, beta: object, *, islands: bool = True) -> Floats:
    """Return the largest stable alpha at each beta, -inf where there is none; both (n,), errors as of `is_inside`.

    Without ``islands`` up to which every softer wall is stable too, down to alpha -> 0.

    Source: Hulin 2017, sec. 3.4.
    """
    _, b = as_points(0.0, beta)
    found = stable_intervals(loop, b)
    kept = np.flatnonzero(islands | (found.low <= 0))
    result = np.full(len(b), -np.inf)
    np.maximum.at(result, found.index[kept], found.high[kept])
    return result
