"""Branches of a loop whose device has two states and whose velocity is the plain difference: sampled, which is faster.

A fast path of `crossings`, seen by nothing else. Such branches are smooth on the scale of a turn of the delayed device,
and towards theta = pi on the scale of its zeros and poles there. Mostly the first branch alone encloses what is stable.

Source: Hulin 2017, sec. 3.4.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial

import numpy as np

from pipeline.loop.loop import Loop
from pipeline.records.batch import Floats, Integers
from pipeline.theory.circle import LOWEST, Cells, CirclePoints, circle_points, ends, place_of, solved
from pipeline.theory.zoom import bisect

_PER_TURN = 48
"""Samples of each turn of the delayed device."""

_PER_DECADE = 8
"""Samples per decade of the distance from theta = pi, where zeros or poles of the device may lie close together."""

_NONE = 1e-90
"""Scale up to which it is none."""

_CLOSE = 1e-6
"""Smallest sampled distance from theta = pi, relative to that of the nearest zero or pole."""

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
    return _is_smooth(loop) and loop.oldest_force > _LONG


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


def sampled_cells(loop: Loop) -> Cells:
    """Return the cells of all branches."""
    place = _places(loop)
    turns = _zeros(loop, place, lambda p: p.beta_slope)
    edges = np.concatenate([[LOWEST], turns, [-LOWEST]])
    beta = np.append(ends(loop).start, circle_points(loop, edges[1:]).beta)
    return Cells(edges[:-1], edges[1:], beta[:-1], beta[1:])


def sampled_turns(loop: Loop, levels: list[float]) -> Floats:
    """Return beta where alpha has an extremum along a branch, or one of some values."""
    place = _places(loop)
    found = [_zeros(loop, place, lambda p: p.alpha_slope)]
    found += [_zeros(loop, place, partial(_above, level)) for level in levels]
    return circle_points(loop, np.concatenate(found)).beta


def _above(level: float, p: CirclePoints) -> Floats:
    return p.alpha - level


def _zeros(loop: Loop, place: Floats, of: Callable[[CirclePoints], Floats]) -> Floats:
    positive = of(circle_points(loop, place)) > 0
    at = np.flatnonzero(positive[1:] != positive[:-1])
    low, high = bisect(lambda x: (of(circle_points(loop, x)) > 0) == positive[at], place[at], place[at + 1])
    return np.asarray(0.5 * (low + high))


def _places(loop: Loop) -> Floats:
    """Return places that sample all branches, in order."""
    step = np.pi / int(_PER_TURN * (loop.delay + 1))
    theta = np.arange(step, np.pi - 0.5 * step, step)
    scales = [1.0]
    for part in (loop.sampled.motion, loop.sampled.force):
        last = [abs(float(c)) for c in part[::-1]]
        scales += [scale for n, c in enumerate(last[1:], 1) if c and (scale := (last[0] / c) ** (1 / n)) > _NONE]
    decades = max(1.0, np.log10(step / (min(scales) * _CLOSE)))
    close = step * 10.0 ** -np.linspace(0, decades, int(_PER_DECADE * decades) + 2)[1:]
    near = -2 * np.log(np.tan(0.5 * close))
    return np.append(place_of(theta), near[near < -LOWEST])


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
