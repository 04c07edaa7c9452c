"""Stiffest wall without overshoot.

The region without overshoot ends in narrow tips, which a grid in the plane misses. Its edge is a function of
damping: seen from small stiffness the region is left once (checked by test). So the edge is followed over all dampings,
the highest parts are followed to their tips, and the stiffest tip wins.
"""

from __future__ import annotations

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.loop import Loop, as_points
from pipeline.records.batch import Booleans, Floats
from pipeline.theory.poles import REAL, poles
from pipeline.theory.search import OptimalPoint, box, where_stable
from pipeline.theory.transient import NO_OVERSHOOT, transient_costs

_FAINT = 1e-60
"""Deviation down to which a response is looked at for overshoot of any size. From there on the slowest modes have
outlived every other: one that decays by a tenth faster has shrunk by six more decades."""

_FLOORS = (0.2, 0.05, 0.01)
"""Shares of the stable stiffness from which on the edge is looked for; it lies near 0.35, and softer walls creep."""

_RIDGE = 73
"""Samples of the edge of the region without overshoot around its highest part."""

_TIPS = 3
"""Tips of that edge that are followed."""

_CLIMBS = 7
"""Zooms onto a tip: its damping is found to 0.4^7 = 2e-3 of a sample of the ridge, its stiffness to 1e-8."""

_EQUAL = 1e-4
"""Relative stiffness within which two tips count as equal; the thesis's tables print four digits."""


def stiffest_without_overshoot(loop: Loop, *, continuous: bool = True, at_all: bool = False) -> OptimalPoint:
    """Return the stiffest point whose step response has no overshoot; its cost is 0.

    Parameters
    ----------
    loop : Loop
    continuous : bool
        Whether the motion between samples counts, or the samples only.
    at_all : bool
        Whether there may be none whatever its size (`never_overshoots`), or at most 1e-12 as in the thesis.

    Raises
    ------
    ParameterError
        If no point without overshoot was found.

    Source: Hulin 2017, sec. 5.2.2 with footnote 4.
    """
    _, high = box(loop)
    name = "overshoot" if continuous else "overshoot_discrete"

    def clean(alpha: Floats, beta: Floats, _: float) -> Floats:
        if at_all:
            return np.where(never_overshoots(loop, alpha, beta, continuous=continuous), 0.0, np.inf)
        costs = transient_costs(loop, alpha, beta, (), continuous=continuous, enough=NO_OVERSHOOT)
        return np.where(costs[name] <= NO_OVERSHOOT, 0.0, np.inf)

    guarded = where_stable(loop, clean)

    def edge(beta: Floats, floor: Floats, top: Floats, passes: int) -> Floats:
        """Largest alpha without overshoot at each beta in [floor, top] (floor if none), by 24 sections a pass.

        Seen from small alpha, the region is left once: its lower part is clean throughout (checked by test).
        """
        lower, upper = floor.copy(), top.copy()
        share, row = np.linspace(0, 1, 25), np.arange(len(beta))
        for _ in range(passes):
            alpha = lower[:, None] + share * (upper - lower)[:, None]
            good = np.isfinite(guarded(alpha.ravel(), np.repeat(beta, 25), np.inf)).reshape(alpha.shape)
            last = np.where(good.all(axis=1), 24, good.argmin(axis=1) - 1)
            lower = alpha[row, np.maximum(last, 0)]
            upper = np.where(last < 0, lower, alpha[row, np.minimum(last + 1, 24)])
        return lower

    betas = np.linspace(0.0, high[1], 61)[1:]
    for share in _FLOORS:
        lowest = share * high[0] - (1 - share) * loop.gamma
        edges = edge(betas, np.full(60, lowest), np.full(60, high[0]), 2)
        highest = float(edges.max())
        if highest > lowest:
            break
    else:
        raise ParameterError(f"{loop}: no point without overshoot was found.")
    ridge = betas[np.argmax(edges)] + np.linspace(-3, 3, _RIDGE) * (betas[1] - betas[0])
    edges = edge(ridge, np.full(_RIDGE, 0.8 * highest), np.full(_RIDGE, min(1.1 * highest, high[0])), 3)
    tips = _local_maxima(edges)[:_TIPS]
    alpha, beta = edges[tips], ridge[tips]
    half, width = 1.5 * (ridge[1] - ridge[0]), 0.01 * highest
    for _ in range(_CLIMBS):
        window = beta[:, None] + half * np.linspace(-1, 1, 19)
        middle = np.repeat(alpha, 19)
        values = edge(window.ravel(), middle - width, middle + width, 2).reshape(window.shape)
        peak, tip = values.argmax(axis=1), np.arange(len(alpha))
        better = values[tip, peak] > alpha
        alpha = np.where(better, values[tip, peak], alpha)
        beta = np.where(better, window[tip, peak], beta)
        half, width = half * 0.4, width * 0.35
    # tips of practically equal stiffness: the least damping is reported, so that rounding cannot decide between them
    equal = np.flatnonzero(alpha >= alpha.max() * (1 - _EQUAL))
    best = equal[np.argmin(beta[equal])]
    return OptimalPoint(float(alpha[best]), float(beta[best]), 0.0)


def _local_maxima(values: Floats) -> list[int]:
    """Indices of inner local maxima, highest first."""
    inner = np.flatnonzero((values[1:-1] >= values[:-2]) & (values[1:-1] > values[2:])) + 1
    if not len(inner):
        inner = np.array([int(np.argmax(values))])
    return [int(i) for i in inner[np.argsort(values[inner])[::-1]]]


def never_overshoots(loop: Loop, alpha: object, beta: object, *, continuous: bool = True) -> Booleans:
    """Return where the step response has no overshoot at all, however small.

    Parameters
    ----------
    loop : Loop
    alpha, beta : array_like, shape (n,)
        Normalised virtual stiffness and damping; stable, alpha + gamma > 0.
    continuous : bool
        Whether the motion between samples counts, or the samples only.

    Notes
    -----
    In the long run the slowest mode decides: with a pole that is not real and positive the response crosses its final
    position again and again, by less and less. So the largest pole must be real and positive, and the response
    must stay below its final position until it has shrunk to 1e-60, which it does without loss of relative precision.

    The thesis, which allows 1e-12 (footnote 4 of 5.2.2), finds a region that reaches 3 to 4 % further.
    """
    a, b = as_points(alpha, beta)
    z = poles(loop, a, b)
    size = np.abs(z)
    real = np.where((np.abs(z.imag) <= REAL * size) & (z.real > 0), size, 0.0)
    result = np.asarray(real.max(axis=1) >= size.max(axis=1) * (1 - REAL))
    slow_is_real = np.flatnonzero(result)
    if len(slow_is_real):
        name = "overshoot" if continuous else "overshoot_discrete"
        costs = transient_costs(
            loop, a[slow_is_real], b[slow_is_real], (), continuous=continuous, quiet=_FAINT, enough=0.0
        )
        result[slow_is_real] = costs[name] == 0
    return result
