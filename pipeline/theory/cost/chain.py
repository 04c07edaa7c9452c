"""Linear two-point boundary problems along a chain of equal sites, for many points at once, in log2(sites) steps.

A value x runs to the right and another one, z, to the left; each site passes both on and turns a part of each back. Two
neighbouring segments are one segment with other constants, so a chain is known after as many joins as its length has
binary digits, and its inner values follow from its ends in as many steps back. Nothing is ever continued against its
decay, as powers of one site's constants would do: strong damping costs no digits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.records.batch import Floats

Inside = Callable[[Floats, Floats], Floats]
"""From what enters segments at their left and right ends, (groups, q, n) each, to x into each of their sites."""


@dataclass(frozen=True, eq=False)
class Segment:
    """Sites in a row: what they let through and what they turn back, shape (q, q, n) each; both ways alike."""

    through: Floats
    back: Floats


@dataclass(frozen=True, eq=False)
class _Join:
    """Two segments side by side, and (1 - back back)^-1 of x between them."""

    left: Segment
    right: Segment
    between: Floats
    doubled: bool


@dataclass(frozen=True, eq=False)
class Inputs:
    """What groups of segments do with their inputs alone.

    Parameters
    ----------
    out, turned : float64, shape (groups, q, n)
        What leaves them at their right and left end.
    last : float64, shape (groups, q, n)
        x at the last join.
    inside : Inside
        The inputs' part included.
    """

    out: Floats
    turned: Floats
    last: Floats
    inside: Inside


class Chain:
    """Equal sites in a row, and one more of them at the right end.

    Parameters
    ----------
    site : Segment
    count : int
        Sites before the last one, >= 0.
    """

    def __init__(self, site: Segment, count: int) -> None:
        self._joins: list[_Join] = []
        one = np.broadcast_to(np.eye(len(site.through))[..., None], site.through.shape)
        segment = site if count else Segment(one, np.zeros_like(one))  # an empty chain lets all pass
        for digit in f"{count:b}"[1:]:
            segment = self._joined(segment, segment, doubled=True)
            if digit == "1":
                segment = self._joined(segment, site)
        self._joined(segment, site)
        last = self._joins[-1]
        self.to_last = times(last.between, last.left.through + times(last.left.back, last.right.through))
        """x into the last site from equal values into both ends, shape (q, q, n)."""

    def _joined(self, left: Segment, right: Segment, doubled: bool = False) -> Segment:
        between = _inverse(np.eye(len(left.through))[..., None] - times(left.back, right.back))
        self._joins.append(_Join(left, right, between, doubled))
        onward = times(right.through, between)
        turned = right.back + times(onward, times(left.back, right.through))
        return Segment(times(onward, left.through), turned)

    def solve(self, forward: Floats, backward: Floats) -> Inputs:
        """Return what inputs come to.

        Parameters
        ----------
        forward, backward : float64, shape (count + 1, q, n)
            What each site adds to x on its right and to z on its left.
        """
        return self._inputs(len(self._joins), forward[None], backward[None])

    def _inputs(self, joins: int, forward: Floats, backward: Floats) -> Inputs:
        """Return the inputs of groups of segments, shape (groups, sites, q, n), of the first so many joins."""
        groups, sites = forward.shape[:2]
        if joins == 0:  # one site, or none
            return Inputs(forward.sum(axis=1), backward.sum(axis=1), forward[:, :0], lambda x, _: x[:, None][:, :sites])
        join = self._joins[joins - 1]
        if join.doubled:
            halves = (2 * groups, sites // 2, *forward.shape[2:])
            part = self._inputs(joins - 1, forward.reshape(halves), backward.reshape(halves))
            out, turned, out_right, turned_right = part.out[::2], part.turned[::2], part.out[1::2], part.turned[1::2]
        else:
            part = self._inputs(joins - 1, forward[:, :-1], backward[:, :-1])
            out, turned, out_right, turned_right = part.out, part.turned, forward[:, -1], backward[:, -1]
        left, right = join.left, join.right
        middle = apply(join.between, out + apply(left.back, turned_right))

        def inside(x: Floats, z: Floats) -> Floats:
            entering = apply(right.through, z)
            at = middle + apply(join.between, apply(left.through, x) + apply(left.back, entering))
            into = entering + apply(right.back, at) + turned_right
            if not join.doubled:
                return np.concatenate([part.inside(x, into), at[:, None]], axis=1)
            ends = (2 * groups, *x.shape[1:])
            found = part.inside(np.stack([x, at], 1).reshape(ends), np.stack([into, z], 1).reshape(ends))
            return found.reshape(forward.shape)

        back = apply(right.back, middle) + turned_right
        return Inputs(apply(right.through, middle) + out_right, apply(left.through, back) + turned, middle, inside)


def times(left: Floats, right: Floats) -> Floats:
    """Return products of small matrices, shape (p, q, n) times (q, r, n)."""
    return np.asarray(np.einsum("ijn,jkn->ikn", left, right))


def apply(matrix: Floats, values: Floats) -> Floats:
    """Return small matrices times vectors, shape (p, q, n) times (groups, q, n)."""
    return np.asarray(np.einsum("ijn,gjn->gin", matrix, values))


def _inverse(matrix: Floats) -> Floats:
    """Invert matrices of shape (q, q, n) without exchanging rows: those of a stable loop are near 1."""
    q = len(matrix)
    rows = np.concatenate([matrix, np.broadcast_to(np.eye(q)[..., None], matrix.shape)], axis=1)
    for k in range(q):
        rows[k] /= rows[k, k]
        for i in range(q):
            if i != k:
                rows[i] -= rows[i, k] * rows[k]
    return rows[:, q:]
