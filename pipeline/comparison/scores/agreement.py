"""Measure the agreement of measured and theoretical stability by the distance of the boundaries and by equal
verdicts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.comparison.limits import MeasuredLimits
from pipeline.records.findings import MATTERS
from pipeline.records.results import DampingSpan, DistanceScore, VerdictScore
from pipeline.records.trials import Booleans, Floats

NEAR_ZERO = 0.25
"""Smallest theoretical limit, relative to the largest, by which a distance is divided.

The limit tends to zero at both ends of a boundary. There, one stiffness step (200 N/m of 13,000) could be any
percentage of the limit.
"""

FEWEST_COMPARISONS = 5
"""Smallest number of comparisons whose median may be shown as a main result."""

MOSTLY, FEWEST_DEVIATING = 0.8, 3
"""Smallest share of deviating limits that a range of damping must have, and smallest number of them. Two neighbours may
deviate by chance."""

NEGLIGIBLE = 1e-3
"""Threshold for the magnitude of a median. Below it, the sign of the median is not significant. Such a median is
reported as less than 0.1 %."""


def boundary_distance(limits: MeasuredLimits, theory: Floats) -> DistanceScore | None:
    """Return the signed distance of a measured boundary from theory, or None if no limit can be compared.

    Parameters
    ----------
    limits : MeasuredLimits
        Limits at n dampings.
    theory : float64, shape (n,)
        Limits [N/m, Nm/rad]. A negative limit counts as zero.

    Notes
    -----
    A lower bound below theory gives no information and is left out. A lower bound above theory is a lower bound of the
    distance. Relative distances are computed where theory exceeds `NEAR_ZERO` of its largest limit.
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
    # An interval that begins at zero contains any theoretical limit.
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
        apart=deviating_span(limits.damping[known][relative][bounded], (above | below)[bounded]),
    )


def deviating_span(damping: Floats, deviates: Booleans) -> DampingSpan | None:
    """Return the range of neighbouring dampings at which limits deviate from theory, or None if they are scattered.

    Parameters
    ----------
    damping : float64, shape (n,)
        Increasing dampings of the compared limits [Ns/m, Nms/rad].
    deviates : bool, shape (n,)

    Notes
    -----
    The range has the largest number of deviating limits minus the number of other limits. It must contain `MOSTLY` of
    the deviating limits, `MOSTLY` of its limits must deviate, and there must be at least `FEWEST_DEVIATING` of them.

    >>> deviating_span(np.arange(6.0), np.array([False, False, False, True, True, True]))
    DampingSpan(low=3.0, high=None)
    >>> deviating_span(np.arange(6.0), np.array([True, False, False, True, False, True])) is None
    True
    """
    count, total = len(damping), int(deviates.sum())
    best, first, last = 0, 0, -1
    for begin in range(count):
        surplus = np.cumsum(np.where(deviates[begin:], 1, -1))
        place = len(surplus) - 1 - int(np.argmax(surplus[::-1]))
        if surplus[place] > best:
            best, first, last = int(surplus[place]), begin, begin + place
    inside = int(deviates[first : last + 1].sum())
    if inside < max(FEWEST_DEVIATING, MOSTLY * total) or inside < MOSTLY * (last + 1 - first):
        return None
    low = None if first == 0 else float(damping[first])
    return DampingSpan(low=low, high=None if last == count - 1 else float(damping[last]))


def is_steady(values: Floats) -> bool:
    """Return whether a median may be shown as a main result.

    There must be at least five values, none of which determines the median.

    If any single value is left out, the median must keep its sign and move by less than half of the half width of its
    95 % interval (by order statistics).

    >>> is_steady(np.array([0.27, 0.28, 0.29, 0.3, 0.31])), is_steady(np.array([0.1, 0.2, 0.21, 0.3, 0.4]))
    (True, True)
    >>> is_steady(np.array([-0.3, -0.2, -0.1, 0.15, 0.2, 0.3])), is_steady(np.ones(4))
    (False, False)
    """
    from scipy.special import bdtr

    n, ordered, middle = len(values), np.sort(values), float(np.median(values))
    if n < FEWEST_COMPARISONS:
        return False
    rank = max(int(np.argmax(bdtr(np.arange(n), n, 0.5) >= 0.025)) - 1, 0)
    half = 0.5 * (ordered[n - 1 - rank] - ordered[rank])
    without = [float(np.median(np.delete(ordered, place))) for place in (0, n // 2, n - 1)]
    kept = abs(middle) < NEGLIGIBLE or all(value * middle > 0 for value in without)
    return kept and all(abs(value - middle) <= 0.5 * half for value in without)


def verdict_agreement(stiffness: Floats, verdict: NDArray[np.str_], predicted: Booleans) -> VerdictScore | None:
    """Count how often logs and theory agree on stability. The result is None without a decided trial at K > 0.

    Parameters
    ----------
    stiffness : float64, shape (n,)
        K [N/m, Nm/rad]. At K <= 0 there is no equilibrium position, so "stable" means a decaying velocity.
    verdict : array of str, shape (n,)
        ``stable``, ``unstable`` or ``undecided``.
    predicted : bool, shape (n,)
        Whether (K, B) is stable according to theory.
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
