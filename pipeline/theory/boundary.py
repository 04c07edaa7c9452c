"""Limits of walls on a general loop: at given dampings, and along the whole region.

The limit at a damping is the upper end of the stable interval that begins at alpha -> 0; a stable interval beyond an
unstable gap, or above unstable soft walls, is an island.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache, partial

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.normalised_loop import NormalisedLoop, as_points
from pipeline.records.trials import Booleans, Floats, Integers
from pipeline.theory.crossings import (
    FirstBranch,
    angle_of,
    bisect,
    circle_points,
    first_branch,
    place_of,
    polished,
    stable_intervals,
    stiffness_turns,
    turning_dampings,
)

_NODES = np.concatenate([[1e-9], 0.5 * (1 - np.cos(np.pi * np.linspace(0, 1, 9)[1:-1])), [1 - 1e-9]])
"""Relative positions between two dampings at which intervals change: next to both, where limits still have 11 digits,
and between, to detect corners."""

_MIDDLE = len(_NODES) // 2

_ASIDE = 1e-12
"""Relative distance on both sides of a corner at which limits are computed."""

_MOST_CORNERS = 8
"""Largest number of corners resolved between two neighbours; more than one is rare."""


@dataclass(frozen=True, eq=False)
class Limits:
    """Limits at dampings, normalised.

    Parameters
    ----------
    alpha : float64, shape (n,)
        Stiffest wall of the interval that begins at alpha -> 0; nan without such an interval.
    angle : float64, shape (n,)
        Angle of the pole that leaves the unit circle there [rad/sample]; pi for a real pole.
    low, low_angle : float64, shape (n,)
        Lower end of the interval, -gamma if it begins on that line, and the angle there, nan on the line.
    islands : float64, shape (i, 3)
        Further stable intervals: beta, lowest and highest alpha > 0.
    """

    alpha: Floats
    angle: Floats
    low: Floats
    low_angle: Floats
    islands: Floats

    def part(self, which: Booleans) -> Limits:
        """Return the limits at a subset of dampings, with all islands."""
        return Limits(self.alpha[which], self.angle[which], self.low[which], self.low_angle[which], self.islands)


@dataclass(frozen=True, eq=False)
class Outline:
    """The limit of walls over damping.

    Parameters
    ----------
    beta : float64, shape (n,)
        Sorted; empty if no soft wall is stable.
    limits : Limits
        There.
    part : int, shape (n,)
        Number of the contiguous range of dampings to which each belongs.
    islands : float64, shape (i, 3)
        As in `Limits`: at these beta, and between the first and the last beta with any stable wall.
    tried : float64, shape (t,)
        Sorted dampings at which islands were searched, including both sides of each damping at which one begins or
        ends.
    alpha_max, beta_at_alpha_max : float
        The stiffest wall of all, islands excluded; nan without any.
    ends : tuple of float
        Infimum and supremum of beta, to the last bit, if the limit is defined only next to them.
    """

    beta: Floats
    limits: Limits
    part: Integers
    islands: Floats
    tried: Floats
    alpha_max: float
    beta_at_alpha_max: float
    ends: tuple[float, float]

    @property
    def alpha(self) -> Floats:
        """The limits themselves."""
        return self.limits.alpha


def limits(loop: NormalisedLoop, beta: Floats, *, exact: bool = True, floor: float = 0.0) -> Limits:
    """Return the limit of walls at each beta.

    Parameters
    ----------
    loop : NormalisedLoop
    beta : float64, shape (n,)
    exact : bool
        Whether crossings are polished in many digits; else they have double precision.
    floor : float
        Softest wall, -gamma to 0: intervals that begin there or contain it are not islands; intervals below it are
        ignored.
    """
    found = stable_intervals(loop, beta)
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


def outline(loop: NormalisedLoop, points: int = 400, floor: float = 0.0) -> Outline:
    """Return the limit of walls over all dampings that have one.

    Parameters
    ----------
    loop : NormalisedLoop
    points : int
        Number of dampings of the outline, >= 8, spread over its parts and denser towards their ends; both sides of
        every corner and jump are added.
    floor : float
        As of `limits`.

    Notes
    -----
    Begins, ends, jumps and extrema of limits are not searched by sampling: `crossings.turning_dampings` are all of
    these except corners. A corner is detected if neighbouring dampings are bounded by different branches.
    """
    turning, nodes = turning_dampings(loop), _nodes(loop)
    marks = nodes[:, [0, -1]].ravel()
    marks = np.append(marks, _corners(loop, np.unique(nodes)))
    levels = np.unique(np.append(nodes, marks))
    islands = limits(loop, levels, exact=False, floor=floor).islands
    # the middle of a gap is representative of all of it
    holds = np.isfinite(limits(loop, nodes[:, _MIDDLE], exact=False, floor=floor).alpha)
    inside = np.concatenate([[False], holds, [False]])
    low, high = turning[np.flatnonzero(inside[1:] > inside[:-1])], turning[np.flatnonzero(inside[1:] < inside[:-1])]
    if not len(low):
        nothing = np.zeros(0)
        part, unknown = nothing.astype(int), (np.nan, np.nan)
        return Outline(nothing, limits(loop, nothing), part, islands, levels, np.nan, np.nan, unknown)
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
    peak, at, part = float(found.alpha[best]), float(beta[best]), np.searchsorted(low, beta)
    return Outline(beta, found, part, islands, levels, peak, at, (float(low[0]), float(high[-1])))


def _nodes(loop: NormalisedLoop) -> Floats:
    """Return dampings between the turning dampings, shape (gaps, nodes)."""
    # evenly spaced at usual dampings: with far larger ones an island next to the end of a gap would be missed
    turning = turning_dampings(loop)
    usual = float(np.median(np.abs(np.append(turning, 1.0)))) or 1.0
    evenly = np.arcsinh(turning / usual)
    return np.asarray(usual * np.sinh(evenly[:-1, None] + np.diff(evenly)[:, None] * _NODES))


def _corners(loop: NormalisedLoop, levels: Floats) -> Floats:
    """Return one damping just below and one just above each damping at which the bounding branches change.

    Changes are located between adjacent ``levels``, which are sorted.
    """
    known = _bounds(loop, levels)
    low, high, left, right = levels[:-1], levels[1:], known[:-1], known[1:]
    corners = [np.zeros(0)]
    for _ in range(_MOST_CORNERS):
        differ = left != right
        low, high, left, right = (values[differ] for values in (low, high, left, right))
        if not len(low):
            break
        good, bad = bisect(partial(_are_bounded, loop, left), low, high)
        # slightly off the corner, where rounding would decide
        corners += [np.maximum(good - _ASIDE * np.abs(good), low), np.minimum(bad + _ASIDE * np.abs(bad), high)]
        low, left = bad, _bounds(loop, bad)
    return np.concatenate(corners)


def _are_bounded(loop: NormalisedLoop, by: Integers, beta: Floats) -> Booleans:
    return np.asarray(_bounds(loop, beta) == by)


def _bounds(loop: NormalisedLoop, beta: Floats) -> Integers:
    """Return a number that identifies the branches that bound the stable intervals at each beta."""
    found, result = stable_intervals(loop, beta), np.zeros(len(beta), np.intp)
    np.add.at(result, found.index, (found.bounds + 1) ** 2)
    return result


_FEWEST = 8
"""Number of points of an outline computed only for its islands, which do not depend on it."""


@dataclass(frozen=True, eq=False)
class Boundary:
    """Stability boundary: the edge of the stable set over the damping.

    Parameters
    ----------
    alpha, beta, theta : float64, shape (n,)
        Points sorted by beta, then back along the lower edge of the region; nan between separate regions. The
        angle is that of the pole that leaves the unit circle there, nan where it is unknown.
    alpha_max, beta_at_alpha_max : float
        Largest stable alpha and its beta, islands excluded here and below.
    beta_max, alpha_at_beta_max : float
        Largest stable beta and its alpha.
    beta_min : float
        Infimum of stable beta.
    islands : float64, shape (i, 3)
        Other stable intervals, as in `Outline`.
    """

    alpha: Floats
    beta: Floats
    theta: Floats
    alpha_max: float
    beta_at_alpha_max: float
    beta_max: float
    alpha_at_beta_max: float
    beta_min: float
    islands: Floats = field(default_factory=lambda: np.zeros((0, 3)))


@lru_cache(maxsize=64)
def boundary(loop: NormalisedLoop, points: int = 400) -> Boundary:
    """Return the boundary of the stable region.

    Parameters
    ----------
    loop : NormalisedLoop
    points : int
        Approximate number of points, >= 8.

    Raises
    ------
    ParameterError
        If fewer than 8 points are asked for, or nothing is stable.

    Notes
    -----
    Usually it is one branch: it starts at theta -> 0 on the line alpha = -gamma, and ends where it meets that line
    again. Where several branches bound the region (a plant that resonates within the delay, damping above about 2 m/T
    without delay, filters), it is followed over the damping, with both sides of each corner.

    Source: Hulin 2017, sec. 3.4; reproduces Tables B.1 to B.4.
    """
    if points < 8:
        raise ParameterError(f"points = {points}: expected at least 8.")
    first = first_branch(loop)
    return _along(loop, first, points) if first is not None else _over_dampings(loop, points)


def has_islands(loop: NormalisedLoop) -> bool:
    """Return whether any stable wall lies beyond an unstable range of softer ones, down to alpha -> 0."""
    return first_branch(loop) is None and len(outline(loop, _FEWEST).islands) > 0


def stabilises(loop: NormalisedLoop) -> bool:
    """Return whether any damping stabilises a soft wall."""
    return first_branch(loop) is not None or len(outline(loop, _FEWEST).beta) > 0


def _along(loop: NormalisedLoop, first: FirstBranch, points: int) -> Boundary:
    """Return the boundary parametrised by the angle; its largest damping is at its end point."""
    # cosine spacing: dense at both ends, where the branch meets the line alpha = -gamma
    share = 0.5 * (1 - np.cos(np.pi * (np.arange(points) + 0.5) / points))
    place, turns = np.minimum(place_of(float(angle_of(np.array(first.end))) * share), first.end), stiffness_turns(loop)
    peak_at = np.log(turns[:1])
    place = np.append(np.sort(np.append(place, peak_at)), first.end)
    p, peak = circle_points(loop, place), circle_points(loop, peak_at)
    alpha = np.append(p.alpha[:-1], 0.0 - loop.gamma)  # by the definition of the end
    ends = float(p.beta[-1]), float(alpha[-1]), first.start
    return Boundary(alpha, p.beta, angle_of(place), float(peak.alpha[0]), float(peak.beta[0]), *ends)


def _over_dampings(loop: NormalisedLoop, points: int) -> Boundary:
    found = outline(loop, points, -loop.gamma)
    if not len(found.beta):
        raise ParameterError("no damping stabilises a soft wall. Check delay, lag and velocity filter.")
    at, levels, known = found.islands[:, 0], found.beta, found.limits
    if len(at):
        levels = np.unique(np.concatenate([levels, found.tried, np.linspace(at.min(), at.max(), points)]))
        known = limits(loop, levels, floor=-loop.gamma)
    soft = np.isfinite(known.alpha)
    ends = [levels[soft], known.low[soft], known.alpha[soft], known.low_angle[soft], known.angle[soft]]
    islands = np.column_stack([known.islands, np.full((len(known.islands), 2), np.nan)])
    rows = np.concatenate([np.transpose(ends), islands])
    rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
    alpha, beta, theta = _edges(rows, np.searchsorted(levels, rows[:, 0]), -loop.gamma).T
    return Boundary(
        alpha,
        beta,
        theta,
        alpha_max=found.alpha_max,
        beta_at_alpha_max=found.beta_at_alpha_max,
        beta_max=found.ends[1],
        alpha_at_beta_max=float(found.alpha[-1]),
        beta_min=found.ends[0],
        islands=found.islands,
    )


def _edges(rows: Floats, level: Integers, line: float) -> Floats:
    """Return alpha, beta and angle along the edges of all regions, shape (n, 3), with a row of nan between them.

    Rows are stable intervals, upwards in beta: beta, low, high and their angles. Intervals of neighbouring levels are
    matched by their order, or by overlap if their number changes; an edge ends where regions join.
    """
    chains: list[list[int]] = []
    joined = np.zeros(len(rows), np.bool_)
    for number in np.unique(level):
        here = np.flatnonzero(level == number).tolist()
        before = sorted((c for c in chains if level[c[-1]] == number - 1), key=lambda c: c[-1])
        ends = np.array([c[-1] for c in before], dtype=np.intp)
        low, high = rows[ends, 1:3].T
        meets = (low < rows[here, 2, None]) & (high > rows[here, 1, None])
        # with equal numbers, no region begins, ends or joins
        meets = np.eye(len(here), dtype=np.bool_) if len(here) == len(ends) else meets
        for i, met in zip(here, meets, strict=True):
            if met.sum() == 1 and meets[:, met].sum() == 1:
                before[int(met.argmax())].append(i)
            else:
                chains.append([i])
                joined[ends[met]] = True
    gap, found = np.full((1, 3), np.nan), [np.zeros((0, 3))]
    for chain in chains:
        off = rows[chain, 1] > line
        off[-1] |= off.any()
        # an edge along the line needs only its ends
        kept = off | np.append(off[1:], False) | np.append(False, off[:-1])
        up, down = rows[chain][:, [2, 0, 4]], rows[chain][kept][::-1, [1, 0, 3]]
        found += [gap, up, gap[: int(joined[chain[-1]])], down]
    return np.concatenate(found[2:])


def is_inside(loop: NormalisedLoop, alpha: object, beta: object) -> Booleans:
    """Return which points are stable: all poles inside the unit circle.

    Parameters
    ----------
    loop : NormalisedLoop
    alpha, beta : array_like, shape (n,)
        Normalised virtual stiffness and damping.

    Notes
    -----
    Exact up to rounding of the boundary: no guarantee for spectral radii closer to 1 than 1e-12.

    Source: Hulin 2017, sec. 3.4.
    """
    return np.asarray(_margins(loop, *as_points(alpha, beta)) > 0)


def is_well_inside(
    loop: NormalisedLoop, alpha: Floats, beta: Floats, share: float = 1e-9, *, islands: bool = True
) -> Booleans:
    """Return which points are stable and stay stable if alpha moves either way by a share of alpha + gamma, shape (n,).

    Costs of points closer to the boundary are sums over billions of samples, dominated by rounding. Without ``islands``
    a wall counts only if every softer one at its damping is stable, too, down to alpha -> 0.
    """
    away = share * (alpha + loop.gamma)
    return np.asarray((away > 0) & (_margins(loop, alpha, beta, islands=islands) > away))


def stiffness_limit(loop: NormalisedLoop, beta: object) -> Floats:
    """Return the alpha up to which every softer wall is stable at each beta, down to alpha -> 0; both (n,).

    -inf without such an alpha. Accuracy as for `is_inside`.

    Source: Hulin 2017, sec. 3.4.
    """
    _, b = as_points(0.0, beta)
    found = stable_intervals(loop, b)
    kept = np.flatnonzero(found.low <= 0)
    result = np.full(len(b), -np.inf)
    np.maximum.at(result, found.index[kept], found.high[kept])
    return result


def _margins(loop: NormalisedLoop, alpha: Floats, beta: Floats, *, islands: bool = True) -> Floats:
    """Return the distance of alpha to the nearer end of its stable interval, negative outside of any, shape (n,)."""
    levels, of = np.unique(beta, return_inverse=True)
    found = stable_intervals(loop, levels)
    kept = np.flatnonzero(islands | (found.low <= 0))
    index, low, high = found.index[kept], found.low[kept], found.high[kept]
    result = np.full(len(alpha), -np.inf)
    counts = np.bincount(index, minlength=len(levels))
    start = np.cumsum(counts) - counts
    for number in range(int(counts.max(initial=0))):  # one round per stable interval of a line: few
        has = np.flatnonzero(counts[of] > number)
        row = start[of[has]] + number
        result[has] = np.maximum(result[has], np.minimum(alpha[has] - low[row], high[row] - alpha[has]))
    return result


_STIFFNESSES = 65
"""Number of springs in the first sweep, denser towards both ends; the limit is smooth in gamma between a few kinks."""

_ROUNDS = 4
"""Number of refinements around the worst spring of each beta."""

_FINER = 8
"""Number of new springs per round in each gap next to a worst one: finally 8^4 finer, an error of 1e-9 at a smooth
minimum."""


_POINTS = 40
"""Number of dampings of an outline below the device damping, and above it."""


def robust_outline(delta: float, delay: float) -> tuple[Floats, Floats, Floats]:
    """Return the outline of the region stable with every spring: alpha, beta and the worst spring gamma, shape (n,).

    Empty without such a region, as for delta = 0. Parameters and errors as for `robust_limits`.

    Source: Hulin 2017, Fig. 4.5.
    """
    beyond = np.geomspace(1.0, 1 + 4 / (delta * (delay + 0.5)), _POINTS) if delta > 0 else np.empty(0)
    beta = delta * np.concatenate([np.linspace(-1.0, 1.0, _POINTS), beyond[1:]])
    alpha, gamma = robust_limits(delta, delay, beta)
    inside = alpha > 1e-9 * alpha.max(initial=0.0)  # at B = -b it is 0 up to rounding
    return alpha[inside], beta[inside], gamma[inside]


def robust_limits(delta: float, delay: float, beta: object) -> tuple[Floats, Floats]:
    """Return the largest alpha that is stable with every spring, and the worst spring gamma, at each beta.

    Parameters
    ----------
    delta, delay : float
        Normalised damping of the device and delay factor.
    beta : array_like, shape (n,)

    Returns
    -------
    limit, gamma : float64, shape (n,)
        -inf where no alpha > 0 is stable with every spring (always for delta = 0, where the region vanishes).

    Raises
    ------
    ParameterError
        If delta or delay is out of range.

    Notes
    -----
    gamma runs from 0 to pi^2 + delta^2/4 (4.15). Every alpha between 0 and the limit is robustly stable: the limit is
    the smallest upper end, over all springs, of the stable interval that starts at or below 0. It is found by a sweep
    over gamma, refined around the worst springs. At long delays it is too low (conservative) by 0.5 % at d = 128 and
    0.7 % at d = 256.

    Source: Hulin 2017, sec. 4.3.3.
    """
    _, b = as_points(0.0, beta)
    if not (math.isfinite(delta) and delta >= 0):
        raise ParameterError(f"delta = {delta}: expected a finite number that is not negative.")
    largest = math.pi**2 + delta**2 / 4
    gamma = 0.5 * largest * (1 - np.cos(np.pi * np.linspace(0, 1, _STIFFNESSES)))
    limits = np.stack([stiffness_limit(NormalisedLoop.ideal(float(g), delta, delay), b) for g in gamma])
    for _ in range(_ROUNDS):
        alive = np.flatnonzero((limits > 0).all(axis=0))
        worst = np.unique(np.argmin(limits[:, alive], axis=0)) if len(alive) else np.zeros(0, np.intp)
        gaps = np.unique(np.clip(np.concatenate([worst - 1, worst]), 0, len(gamma) - 2))
        if not len(worst):
            break
        share = np.arange(1, _FINER) / _FINER
        new = (gamma[gaps, None] + (gamma[gaps + 1] - gamma[gaps])[:, None] * share).ravel()
        rows = np.full((len(new), len(b)), np.inf)
        nearest = gamma[np.argmin(limits, axis=0)]
        for row, value in zip(rows, new, strict=True):  # each spring only for the beta with a neighbouring worst spring
            near = np.flatnonzero((limits > 0).all(axis=0) & (np.abs(value - nearest) <= _reach(gamma, value)))
            if len(near):
                row[near] = stiffness_limit(NormalisedLoop.ideal(float(value), delta, delay), b[near])
        gamma, limits = np.concatenate([gamma, new]), np.concatenate([limits, rows])
        order = np.argsort(gamma)
        gamma, limits = gamma[order], limits[order]
    result = limits.min(axis=0)
    return np.where(result > 0, result, -np.inf), gamma[np.argmin(limits, axis=0)]


def _reach(gamma: Floats, value: float) -> float:
    """Return the width of the gap between springs that contains a value."""
    at = int(np.clip(np.searchsorted(gamma, value), 1, len(gamma) - 1))
    return float(gamma[at] - gamma[at - 1])


_SLIDING = 0.5
"""Largest friction, relative to the inertial force at the turning points, for which motion is approximated by a
sine."""

_EQUIVALENTS = 12
"""Number of equivalent dampings tried: neighbours differ by at most half."""

_SEEN = 0.1
"""Smallest limit, relative to the largest, of the dampings that determine the range of equivalent dampings."""


def step_limits(loop: NormalisedLoop, beta: Floats, share: float) -> Floats:
    """Return the limit at dampings for oscillations with the amplitude of a step, F_0/(K + k); nan where not valid.

    Parameters
    ----------
    loop : NormalisedLoop
    beta : float64, shape (n,)
    share : float
        Friction over the step, f_c/F_0, > 0.

    Notes
    -----
    The equivalent damping 4 f_c/(pi omega A) depends on the limit and its frequency. Therefore limits are computed at
    several equivalent dampings, each with its friction, and interpolated linearly: to about 1 % of the effect of
    friction. Valid if the motion slides throughout: f_c <= m omega^2 A/2.

    The describing function replaces the square wave of the friction by its first harmonic. A larger oscillation makes
    the wall less stable, so the linear limit remains for large ones.

    Source: Slotine and Li 1991, Applied Nonlinear Control, ch. 5 (describing function of a relay).
    """
    first = limits(loop, beta, exact=False)
    typical = 4 * share * (first.alpha + loop.gamma) / (np.pi * first.angle)
    typical = typical[first.alpha > _SEEN * np.nanmax(first.alpha)]
    more = np.geomspace(0.7 * typical.min(), 5 * typical.max(), _EQUIVALENTS)
    each = [first] + [limits(loop.with_delta(loop.delta + float(one)), beta, exact=False) for one in more]
    added = np.append(0.0, more)[:, None]
    alpha, angle = np.array([one.alpha for one in each]), np.array([one.angle for one in each])
    shares = np.pi * angle * added / (4 * (alpha + loop.gamma))
    result = np.full(len(beta), np.nan)
    for i in range(len(beta)):
        over = np.flatnonzero(shares[:, i] >= share)  # the first: with softer walls the oscillation decays
        if len(over) and over[0] > 0:
            some = slice(over[0] - 1, over[0] + 1)
            stiff, turn = (np.interp(share, shares[some, i], values[some, i]) for values in (alpha, angle))
            if share * (stiff + loop.gamma) <= _SLIDING * turn**2:
                result[i] = stiff
    return result


def quantum_limit(coulomb: float, quantum: float, force_gain: float = 1.0) -> float:
    """Return the stiffness up to which the sensor resolution causes no limit cycle: 2 f_c/(g quantum), in SI.

    Parameters
    ----------
    coulomb : float
        Coulomb friction f_c of the device [N, Nm].
    quantum : float
        Sensor resolution [m, rad], > 0.
    force_gain : float
        Force over command, g.

    Notes
    -----
    The condition is sufficient, not necessary: stiffer walls may be free of limit cycles, too.

    Source: Diolaiti et al. 2006; Abbott and Okamura 2005.
    """
    return 2 * coulomb / (force_gain * quantum)
