"""How measured and theoretical stability agree: overlap of two regions, distance of two boundaries, equal verdicts.

Regions are stretches of stiffness over damping, linear between the dampings. All are numbers of arrays alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import ParameterError
from pipeline.base.wording import counted
from pipeline.comparison.loops.departures import MATTERS
from pipeline.records.batch import Booleans, Floats
from pipeline.records.findings import BoundaryPoint
from pipeline.records.results import DistanceScore, VerdictScore

NEAR_ZERO = 0.25
"""Theoretical limit relative to the largest one below which no distance is divided by it: at both ends of a boundary it
tends to zero, and one step of the stiffness (200 N/m of 13,000) would be any percentage of it."""

FEWEST_COMPARISONS = 5
"""Comparisons from which on their median may be a headline."""

NEGLIGIBLE = 1e-3
"""Size of a median whose sign says nothing: it is told as less than 0.1 %."""


@dataclass(frozen=True, eq=False)
class Stretches:
    """Stable stiffness [N/m, Nm/rad] from ``low`` to ``high`` at each damping, shape (layers, n) each.

    Layers do not overlap; one that a damping does not have is empty there (low = high).
    """

    low: Floats
    high: Floats

    @classmethod
    def up_to(cls, limit: Floats) -> Stretches:
        """Return the region from K = 0 to a limit, shape (n,); a limit below 0 leaves nothing."""
        high = np.maximum(limit, 0.0)[None, :]
        return cls(np.zeros_like(high), high)


@dataclass(frozen=True, eq=False)
class MeasuredLimits:
    """Limits of a measured boundary [N/m, Nm/rad] over damping [Ns/m, Nms/rad], shape (n,) each.

    ``low`` and ``high`` are the interval of a limit. Where it is censored, all three are the stiffest stable trial: a
    lower bound. ``known`` is False where not even that exists, and where no trial is stable: there ``high`` is an upper
    bound, and the others are 0.
    """

    damping: Floats
    limit: Floats
    low: Floats
    high: Floats
    censored: Booleans
    known: Booleans


@dataclass(frozen=True)
class Overlap:
    """Areas of two regions, of what they share and of what either covers, in stiffness times damping."""

    first: float
    second: float
    shared: float

    @property
    def union(self) -> float:
        """Area that at least one of both covers."""
        return self.first + self.second - self.shared


def measured_limits(points: Sequence[BoundaryPoint]) -> MeasuredLimits:
    """Return the limits of a measured boundary with what their verdicts or growth rates leave open.

    Parameters
    ----------
    points : sequence of BoundaryPoint
        In order of damping.

    Notes
    -----
    The limit by the growth rates with its 95 % interval where there is one, else the middle between the stiffest
    stable trial and the softest unstable one, and these as the interval.
    """

    def column(values: Sequence[float | None]) -> Floats:
        return np.array(values, dtype=np.float64)

    stable, unstable = column([p.stable for p in points]), column([p.unstable for p in points])
    value, low, high = (column([getattr(p, name) for p in points]) for name in ("estimate", "low", "high"))
    censored = np.array([p.censored for p in points], dtype=np.bool_)
    floor = np.nan_to_num(stable)
    fitted = np.isfinite(value) & np.isfinite(low) & np.isfinite(high)
    known = fitted | np.isfinite(stable)
    return MeasuredLimits(
        column([p.damping for p in points]),
        np.where(censored, floor, np.where(fitted, value, np.where(known, 0.5 * (floor + unstable), 0.0))),
        np.where(censored | ~fitted, floor, low),
        np.where(censored, floor, np.where(fitted, high, unstable)),
        censored,
        known,
    )


def overlap(damping: Floats, first: Stretches, second: Stretches, top: Floats | None = None) -> Overlap:
    """Return the areas of two regions and of their intersection.

    Parameters
    ----------
    damping : float64, shape (n,)
        Dampings of the regions, strictly increasing [Ns/m, Nms/rad]; the areas lie between the first and the last.
    first, second : Stretches
    top : float64, shape (n,), optional
        Stiffness above which nothing counts; infinite where there is no such end.

    Raises
    ------
    ParameterError
        If there are fewer than two dampings, or they do not increase.

    Notes
    -----
    All ends are linear between two dampings. Where two of them cross there, a damping is added: between the dampings
    that result, lengths of stretches and of their intersections are linear too, so that trapezoids are exact. Where
    only one of two neighbours has an infinite top, the top between them runs to the higher region of that one.
    """
    if len(damping) < 2 or not (np.diff(damping) > 0).all():
        raise ParameterError(
            f"overlap of regions at {counted(len(damping), 'damping')}: expected at least two, increasing."
        )
    ends = [first.low, first.high, second.low, second.high]
    if top is not None:
        most = np.maximum(first.high.max(axis=0), second.high.max(axis=0))
        ends.append(np.where(np.isfinite(top), top, most)[None, :])
    B, rows = _with_crossings(damping, np.concatenate(ends))
    parts = np.split(rows, np.cumsum([len(e) for e in ends])[:-1], axis=0)
    if top is not None:
        parts = [np.minimum(p, parts[4]) for p in parts[:4]]
    a_low, a_high, b_low, b_high = parts
    common = np.minimum(a_high[:, None], b_high[None]) - np.maximum(a_low[:, None], b_low[None])
    lengths = [(a_high - a_low).sum(axis=0), (b_high - b_low).sum(axis=0), np.maximum(common, 0.0).sum(axis=(0, 1))]
    return Overlap(*(float(np.trapezoid(length, B)) for length in lengths))


def _with_crossings(B: Floats, rows: Floats) -> tuple[Floats, Floats]:
    """Add the dampings at which two of several rows, linear between dampings, cross; rows of shape (m, n)."""
    added = [B]
    for one, other in combinations(range(len(rows)), 2):
        gap = rows[one] - rows[other]
        cell = np.flatnonzero(gap[:-1] * gap[1:] < 0)
        added.append(B[cell] + np.diff(B)[cell] * gap[cell] / (gap[cell] - gap[cell + 1]))
    nodes = np.unique(np.concatenate(added))
    return nodes, np.stack([np.interp(nodes, B, row) for row in rows])


def boundary_distance(limits: MeasuredLimits, theory: Floats) -> DistanceScore | None:
    """Return the signed distance of a measured boundary from theory, or None where no limit can be compared.

    Parameters
    ----------
    limits : MeasuredLimits
        At n dampings.
    theory : float64, shape (n,)
        Limits [N/m, Nm/rad]; one below zero counts as zero.

    Notes
    -----
    A lower bound below theory tells nothing and is left out; one above it is a distance that is at least that
    large. Relative distances are taken where theory exceeds `NEAR_ZERO` of its largest limit.
    """
    known = limits.known
    limit, measured, censored = np.maximum(theory, 0.0)[known], limits.limit[known], limits.censored[known]
    open_ = censored & (measured < limit)
    use = ~open_
    relative = use & (limit > NEAR_ZERO * limit.max(initial=0.0))
    if not relative.any():
        return None
    share = (measured[relative] - limit[relative]) / limit[relative]
    low, high = limits.low[known][relative], limits.high[known][relative]
    # an interval from zero on holds any theory
    bounded = (low > 0) & np.isfinite(high)
    size = np.abs(share)
    largest = int(np.argmax(np.where(bounded, size, -1.0) if bounded.any() else size))
    reach = MATTERS * limit[relative]
    above = bounded & (low - limit[relative] > reach)
    below = bounded & ~censored[relative] & (limit[relative] - high > reach)
    return DistanceScore(
        median=float(np.median(share)),
        largest=float(share[largest]),
        largest_damping=float(limits.damping[known][relative][largest]),
        rms=float(np.sqrt(np.mean((measured[use] - limit[use]) ** 2))),
        dampings=int(relative.sum()),
        near_zero=int((use & ~relative).sum()),
        lower_bounds=int((relative & censored).sum()),
        open=int(open_.sum()),
        bounded=int(bounded.sum()),
        agreeing=int((bounded & ~above & ~below).sum()),
        above=int(above.sum()),
        steady=is_steady(share),
    )


def is_steady(values: Floats) -> bool:
    """Tell whether the median of values may be a headline: of five or more, and no single one decides it.

    Leaving out any of them moves it by less than half the half width of its 95 % interval (by order statistics), and
    keeps its sign.

    >>> is_steady(np.array([0.27, 0.28, 0.29, 0.3, 0.31])), is_steady(np.array([0.1, 0.2, 0.21, 0.3, 0.4]))
    (True, True)
    >>> is_steady(np.array([-0.3, -0.2, -0.1, 0.15, 0.2, 0.3])), is_steady(np.ones(4))
    (False, False)
    """
    from scipy.stats import binom

    n, ordered, middle = len(values), np.sort(values), float(np.median(values))
    if n < FEWEST_COMPARISONS:
        return False
    rank = max(int(binom.ppf(0.025, n, 0.5)) - 1, 0)
    half = 0.5 * (ordered[n - 1 - rank] - ordered[rank])
    without = [float(np.median(np.delete(ordered, place))) for place in (0, n // 2, n - 1)]
    kept = abs(middle) < NEGLIGIBLE or all(value * middle > 0 for value in without)
    return kept and all(abs(value - middle) <= 0.5 * half for value in without)


def verdict_agreement(stiffness: Floats, verdict: NDArray[np.str_], predicted: Booleans) -> VerdictScore | None:
    """Return how often logs and theory agree on stability, or None without a decided trial at K > 0.

    Parameters
    ----------
    stiffness : float64, shape (n,)
        K [N/m, Nm/rad]. At K <= 0 nothing holds a position, so that stable means that the velocity decays.
    verdict : array of str, shape (n,)
        ``stable``, ``unstable`` or ``undecided``.
    predicted : bool, shape (n,)
        Whether theory calls (K, B) stable.
    """
    wall = stiffness > 0
    stable, unstable = wall & (verdict == "stable"), wall & (verdict == "unstable")
    counts = [int((said & side).sum()) for said in (stable, unstable) for side in (predicted, ~predicted)]
    both_stable, only_log, only_theory, both_unstable = counts
    if not sum(counts):
        return None
    return VerdictScore(
        both_stable=both_stable,
        both_unstable=both_unstable,
        only_theory_stable=only_theory,
        only_log_stable=only_log,
        undecided=int((wall & ~stable & ~unstable).sum()),
        without_wall=int((~wall).sum()),
        agreement=(both_stable + both_unstable) / sum(counts),
    )
