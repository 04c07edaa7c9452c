"""Branches by samples, which is faster: the first one of a plain device, and all behind a long delay.

A fast path of `crossings`. Branches are smooth on the scale of a turn of the delayed device, and on that of the
distance of its zeros and poles, and of the filter's. Mostly the first branch alone encloses what is stable.

Source: Hulin 2017, sec. 3.4.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial

import numpy as np

from pipeline.loop.loop import Loop
from pipeline.loop.many_digits import as_floats
from pipeline.records.batch import Floats, Integers
from pipeline.theory.circle import LOWEST, Cells, CirclePoints, circle_points, ends, inverse_and_rate, place_of, solved
from pipeline.theory.zoom import bisect

_PER_TURN = 48
"""Samples of each turn of the delayed device."""

_SPACING = 0.5
"""Places between both ends of these turns and all zeros and poles of device and filter: ln s, 9 a decade of s."""

_BEFORE, _BEYOND = 5.0, 28.0
"""Places before the first of them, an angle of a tenth; and beyond the last, a distance from pi of 1e-6 of it."""

_AROUND = np.linspace(-5, 5, 33)
"""Places around each zero and pole, in units of its distance from the circle: sinh of this."""

_BESIDE = 1e-12
"""Distance of places beside a break."""

_LONG = 16
"""Delay from which on polynomials, whose degree is the delay's, take longer."""

_APART = 0.05
"""Distance between the first branch and all others, relative to the width, from which on the first surely encloses."""


@dataclass(frozen=True, eq=False)
class FirstBranch:
    """The branch from alpha = -gamma at theta -> 0 to where it meets that line again; beta rises all along it.

    Parameters
    ----------
    loop : Loop
    cells : Cells
        Between its samples; it ends in the last one.
    turn : int
        Cell in which alpha is largest.
    """

    loop: Loop
    cells: Cells
    turn: int

    @cached_property
    def peak(self) -> float:
        """Place of the largest alpha."""
        return self._within(self.turn, lambda p: p.alpha_slope)

    @cached_property
    def end(self) -> float:
        """Place of its end."""
        return self._within(-1, lambda p: p.alpha + self.loop.gamma)

    def met(self, beta: Floats) -> tuple[Integers, Floats]:
        """Return the indices of the beta that are met, and the places."""
        inside = np.flatnonzero((beta > self.cells.beta_low[0]) & (beta < self.cells.beta_high[-1]))
        cell = np.searchsorted(self.cells.beta_high, beta[inside])
        return inside, solved(self.loop, self.cells, cell, beta[inside])

    def _within(self, cell: int, of: Callable[[CirclePoints], Floats]) -> float:
        low, high = self.cells.low[[cell]], self.cells.high[[cell]]
        return float(bisect(lambda place: of(circle_points(self.loop, place)) > 0, low, high)[0][0])


def is_sampled(loop: Loop) -> bool:
    """Return whether the branches of a loop are better known by samples than by their polynomials' roots."""
    return loop.oldest_force > _LONG


def _is_smooth(loop: Loop) -> bool:
    return len(loop.sampled.motion) <= 3 and len(loop.sampled.filter) == 1


@lru_cache(maxsize=512)
def first_branch(loop: Loop) -> FirstBranch | None:
    """Return the first branch where it alone encloses what is stable.

    It does if beta grows along it, alpha has one maximum and returns to -gamma, all other branches, also where they
    pass alpha = -gamma, and the line of z = -1 lie outside, and the count of unstable poles inside is 0.
    """
    if not _is_smooth(loop):
        return None
    place, known = _places(loop), ends(loop)
    p = circle_points(loop, place)
    width = p.alpha + loop.gamma
    back = int(np.argmax(width <= 0))
    if width[back] > 0 or back == 0:
        return None
    end, falls = back + 1, p.alpha_slope[: back + 1] < 0
    a, b, others = p.alpha[:end], np.append(known.start, p.beta[:end]), slice(end, None)
    if (
        falls[0]
        or not falls[-1]
        or np.diff(falls).sum() != 1
        or (np.diff(b) <= 0).any()
        or (p.beta_slope[:end] <= 0).any()
    ):
        return None
    room = 1 + _APART
    limit = np.interp(p.beta[others], b[1:], a, left=-np.inf, right=-np.inf)
    outside = (width[others] <= 0) | (width[others] >= room * (limit + loop.gamma))
    # what enters between two samples enters by the line alpha = -gamma
    meets, beyond = _passings(width[back:], p.beta[back:]), _APART * (b[-1] - b[0])
    line = np.append(known.slope * b[0] - loop.gamma, a + known.slope * b[1:])
    beside = known.last > line.max() * room or known.last < line.min()
    apart = ((meets < b[0] - beyond) | (meets > b[-1] + beyond)).all()
    if not (outside.all() and apart and beside and _unstable_poles(loop, p, int(np.argmax(a))) == 0):
        return None
    edges = np.append(LOWEST, place[:end])
    return FirstBranch(loop, Cells(edges[:-1], edges[1:], b[:-1], b[1:]), int(np.argmax(falls)))


def sampled_cells(loop: Loop, breaks: Floats) -> tuple[Cells, Integers]:
    """Return the cells of all branches, and unstable poles that alpha gains or loses by rising through each.

    ``breaks`` are the places, in order, at which beta is infinite.
    """
    place = _places(loop)
    inner = np.sort(np.append(_zeros(loop, place, breaks, lambda p: p.beta_slope), breaks))
    edges = np.concatenate([[LOWEST], inner, [-LOWEST]])
    beta, start = circle_points(loop, edges).beta, ends(loop).start
    beta[0] = beta[0] if np.isnan(start) else start
    middle = 0.5 * (np.maximum(edges[:-1], place[0]) + np.minimum(edges[1:], place[-1]))
    rises, rate = circle_points(loop, middle).beta_slope > 0, inverse_and_rate(loop, middle)[0, 1].imag
    endless, far = np.isin(edges, breaks), np.where(rises, np.inf, -np.inf)
    low, high = np.where(endless[:-1], -far, beta[:-1]), np.where(endless[1:], far, beta[1:])
    return Cells(edges[:-1], edges[1:], low, high), np.where(rises == (rate > 0), 2, -2)


def sampled_turns(loop: Loop, levels: list[float], breaks: Floats) -> Floats:
    """Return beta where alpha has an extremum along a branch, or one of some values."""
    place = _places(loop)
    found = [_zeros(loop, place, breaks, lambda p: p.alpha_slope)]
    found += [_zeros(loop, place, breaks, partial(_above, level)) for level in levels]
    return circle_points(loop, np.concatenate(found)).beta


def _above(level: float, p: CirclePoints) -> Floats:
    return p.alpha - level


def _zeros(loop: Loop, place: Floats, breaks: Floats, of: Callable[[CirclePoints], Floats]) -> Floats:
    place = np.unique(np.concatenate([place, breaks * (1 - _BESIDE), breaks * (1 + _BESIDE)]))
    positive, part = of(circle_points(loop, place)) > 0, np.searchsorted(breaks, place)
    at = np.flatnonzero((positive[1:] != positive[:-1]) & (part[1:] == part[:-1]))
    low, high = bisect(lambda x: (of(circle_points(loop, x)) > 0) == positive[at], place[at], place[at + 1])
    return np.asarray(0.5 * (low + high))


def _places(loop: Loop) -> Floats:
    """Return places that sample all branches, in order: on the scale of a turn, and around all zeros and poles."""
    step = np.pi / int(_PER_TURN * (loop.delay + 1))
    b, a = (np.roots(part) for part in loop.filter_in_z)
    root = np.concatenate([np.roots(as_floats(part)[::-1]) for part in (loop.sampled.motion, loop.sampled.force)])
    with np.errstate(divide="ignore", invalid="ignore"):
        root = np.concatenate([root, (b - 1) / (b + 1), (a - 1) / (a + 1)])
        middle = 2 * np.log(np.abs(root))
    root, middle = (values[np.abs(middle) < -LOWEST] for values in (root, middle))
    around = middle[:, None] + np.abs(root.real / root)[:, None] * np.sinh(_AROUND)
    turns = place_of(np.arange(step, np.pi - 0.5 * step, step))
    low, high = np.append(middle, turns[0]).min() - _BEFORE, np.append(middle, turns[-1]).max() + _BEYOND
    tails = np.append(np.arange(low, turns[0], _SPACING), np.arange(turns[-1], high, _SPACING)[1:])
    found = np.sort(np.concatenate([turns, tails, around.ravel()]))
    apart = np.append(True, np.diff(found) > 0)  # np.unique would load numpy.ma
    return np.asarray(found[apart & (found >= low) & (found <= min(high, -LOWEST))])


def _passings(width: Floats, beta: Floats) -> Floats:
    """Return beta where the width between successive points passes zero."""
    at = np.flatnonzero((width[:-1] > 0) != (width[1:] > 0))
    return np.asarray(beta[at] + width[at] / (width[at] - width[at + 1]) * (beta[at + 1] - beta[at]))


def _unstable_poles(loop: Loop, p: CirclePoints, index: int) -> int:
    """Count the unstable poles just left of a sampled point, by crossings to its right read from the samples."""
    known, alpha, beta = ends(loop), np.append(-loop.gamma, p.alpha), np.append(ends(loop).start, p.beta)
    level = p.beta[index] * (1 - 1e-9)
    at = np.flatnonzero((beta[:-1] < level) != (beta[1:] < level))
    crossing = alpha[at] + (level - beta[at]) / (beta[at + 1] - beta[at]) * (alpha[at + 1] - alpha[at])
    point = p.alpha[index] - 1e-3 * (p.alpha[index] + loop.gamma)
    gained = 2 * int((np.sign(beta[at + 1] - beta[at]) * (crossing > point)).sum())
    line = known.last - level * known.slope
    return known.unstable - gained - (int(known.outward(level)) if point < line < np.inf else 0)
