"""Compute the limits of walls for a general loop, at given dampings and over the whole stable region.

The limit at a damping is the upper end of the stable interval that begins at alpha -> 0. Another stable interval is an
island, which lies beyond an unstable gap or above unstable soft walls.
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
"""Relative positions between two dampings at which intervals change. Limits next to both dampings still have 11 digits.
The other positions show whether the limit has a corner."""

_MIDDLE = len(_NODES) // 2

_ASIDE = 1e-12
"""Relative distance from a corner at which limits are computed, on both sides."""

_MOST_CORNERS = 8
"""Largest number of corners between two neighbours that are resolved. More than one corner is rare."""


@dataclass(frozen=True, eq=False)
class Limits:
    """Normalised limits at given dampings.

    Parameters
    ----------
    alpha : float64, shape (n,)
        Stiffest wall of the interval that begins at alpha -> 0, or nan if there is no such interval.
    angle : float64, shape (n,)
        Angle of the pole that leaves the unit circle at the limit [rad/sample]. It is pi for a real pole.
    low, low_angle : float64, shape (n,)
        Lower end of the interval and the angle there. If the interval begins on the line alpha = -gamma, they are
        -gamma and nan.
    islands : float64, shape (i, 3)
        Further stable intervals, each given by beta and the lowest and the highest alpha > 0.
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
    """Limit of walls over the damping.

    Parameters
    ----------
    beta : float64, shape (n,)
        Sorted dampings. The array is empty if no soft wall is stable.
    limits : Limits
        Limits at these dampings.
    part : int, shape (n,)
        Index of the contiguous range of dampings that contains each damping.
    islands : float64, shape (i, 3)
        Islands as in `Limits`, at these dampings and between the first and the last damping with a stable wall.
    tried : float64, shape (t,)
        Sorted dampings at which islands were searched for. They include both sides of each damping at which an island
        begins or ends.
    alpha_max, beta_at_alpha_max : float
        Stiffest wall, without islands, or nan if there is none.
    ends : tuple of float
        Infimum and supremum of beta, to the last bit. The limit may be defined only next to them.
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
        """The limits at the dampings."""
        return self.limits.alpha


def limits(loop: NormalisedLoop, beta: Floats, *, exact: bool = True, floor: float = 0.0) -> Limits:
    """Return the limit of walls at each beta.

    Parameters
    ----------
    loop : NormalisedLoop
    beta : float64, shape (n,)
    exact : bool
        Whether crossings are refined with many digits. Otherwise, they have double precision.
    floor : float
        Softest wall, between -gamma and 0. Intervals that begin there or contain it are not islands. Intervals below it
        are ignored.
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
        Number of dampings of the outline, at least 8. They are spread over its parts and denser towards their ends.
        Both sides of every corner and jump are added.
    floor : float
        Softest wall, as in `limits`.

    Notes
    -----
    The dampings at which limits begin, end, jump or have extrema are not searched for by sampling.
    `crossings.turning_dampings` returns all of them except corners. A corner is detected if different branches bound
    neighbouring dampings.
    """
    turning, nodes = turning_dampings(loop), _nodes(loop)
    marks = nodes[:, [0, -1]].ravel()
    marks = np.append(marks, _corners(loop, np.unique(nodes)))
    levels = np.unique(np.append(nodes, marks))
    islands = limits(loop, levels, exact=False, floor=floor).islands
    # the middle of a gap represents the whole gap
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
    # even spacing is relative to usual dampings; with far larger dampings, an island near the end of a gap would be
    # lost
    turning = turning_dampings(loop)
    usual = float(np.median(np.abs(np.append(turning, 1.0)))) or 1.0
    evenly = np.arcsinh(turning / usual)
    return np.asarray(usual * np.sinh(evenly[:-1, None] + np.diff(evenly)[:, None] * _NODES))


def _corners(loop: NormalisedLoop, levels: Floats) -> Floats:
    """Return one damping just below and one just above each damping at which the bounding branches change.

    Changes are located between neighbouring ``levels``, which must be sorted.
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
        # slightly off the corner, because rounding would decide at the corner
        corners += [np.maximum(good - _ASIDE * np.abs(good), low), np.minimum(bad + _ASIDE * np.abs(bad), high)]
        low, left = bad, _bounds(loop, bad)
    return np.concatenate(corners)


def _are_bounded(loop: NormalisedLoop, by: Integers, beta: Floats) -> Booleans:
    return np.asarray(_bounds(loop, beta) == by)


def _bounds(loop: NormalisedLoop, beta: Floats) -> Integers:
    """Return a number for each beta that identifies the branches that bound its stable intervals."""
    found, result = stable_intervals(loop, beta), np.zeros(len(beta), np.intp)
    np.add.at(result, found.index, (found.bounds + 1) ** 2)
    return result


_FEWEST = 8
"""Number of points of an outline that is computed only for its islands. The islands do not depend on it."""


@dataclass(frozen=True, eq=False)
class Boundary:
    """Stability boundary, which is the edge of the stable region over the damping.

    Parameters
    ----------
    alpha, beta, theta : float64, shape (n,)
        Points sorted by beta, followed by the lower edge of the region in reverse order; nan between separate regions.
        theta is the angle of the pole that leaves the unit circle at the point; nan if unknown.
    alpha_max, beta_at_alpha_max : float
        Largest stable alpha without islands, and its beta.
    beta_max, alpha_at_beta_max : float
        Largest stable beta without islands, and its alpha.
    beta_min : float
        Infimum of stable beta without islands.
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
        Approximate number of points, at least 8.

    Raises
    ------
    ParameterError
        If fewer than 8 points are requested, or no wall is stable.

    Notes
    -----
    Usually, the boundary is one branch. It starts at theta -> 0 on the line alpha = -gamma and ends at the next point
    on this line. Several branches bound the region if the plant resonates within the delay, if the damping exceeds
    about 2 m/T without a delay, or with filters. The boundary is then computed over the damping, with both sides of
    each corner.

    Source: Hulin 2017, sec. 3.4; reproduces Tables B.1 to B.4.
    """
    if points < 8:
        raise ParameterError(f"points = {points}: expected at least 8.")
    first = first_branch(loop)
    return _along(loop, first, points) if first is not None else _over_dampings(loop, points)


def has_islands(loop: NormalisedLoop) -> bool:
    """Return whether a stable wall exists beyond an unstable range of softer walls, down to alpha -> 0."""
    return first_branch(loop) is None and len(outline(loop, _FEWEST).islands) > 0


def stabilises(loop: NormalisedLoop) -> bool:
    """Return whether some damping stabilises a soft wall."""
    return first_branch(loop) is not None or len(outline(loop, _FEWEST).beta) > 0


def _along(loop: NormalisedLoop, first: FirstBranch, points: int) -> Boundary:
    """Return the boundary parametrised by the angle. Its largest damping is at its end point."""
    # cosine spacing is dense at both ends, where the branch meets the line alpha = -gamma
    share = 0.5 * (1 - np.cos(np.pi * (np.arange(points) + 0.5) / points))
    place, turns = np.minimum(place_of(float(angle_of(np.array(first.end))) * share), first.end), stiffness_turns(loop)
    peak_at = np.log(turns[:1])
    place = np.append(np.sort(np.append(place, peak_at)), first.end)
    p, peak = circle_points(loop, place), circle_points(loop, peak_at)
    alpha = np.append(p.alpha[:-1], 0.0 - loop.gamma)  # the branch ends on this line
    ends = float(p.beta[-1]), float(alpha[-1]), first.start
    return Boundary(alpha, p.beta, angle_of(place), float(peak.alpha[0]), float(peak.beta[0]), *ends)


def _over_dampings(loop: NormalisedLoop, points: int) -> Boundary:
    found = outline(loop, points, -loop.gamma)
    if not len(found.beta):
        raise ParameterError("no damping stabilises a soft wall. Check the delay, the lag and the velocity filter.")
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
    """Return alpha, beta and angle along the edges of all regions, shape (n, 3), with a row of nan between regions.

    Rows are stable intervals in ascending order of beta. A row contains beta, low, high, and the angles at low and
    high. Intervals of neighbouring levels are matched by their order, or by overlap if their number changes. An edge
    ends where regions join.
    """
    chains: list[list[int]] = []
    joined = np.zeros(len(rows), np.bool_)
    for number in np.unique(level):
        here = np.flatnonzero(level == number).tolist()
        before = sorted((c for c in chains if level[c[-1]] == number - 1), key=lambda c: c[-1])
        ends = np.array([c[-1] for c in before], dtype=np.intp)
        low, high = rows[ends, 1:3].T
        meets = (low < rows[here, 2, None]) & (high > rows[here, 1, None])
        # for equal numbers, no region begins, ends or joins another one
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
        # for an edge along the line, only the ends are needed
        kept = off | np.append(off[1:], False) | np.append(False, off[:-1])
        up, down = rows[chain][:, [2, 0, 4]], rows[chain][kept][::-1, [1, 0, 3]]
        found += [gap, up, gap[: int(joined[chain[-1]])], down]
    return np.concatenate(found[2:])


def is_inside(loop: NormalisedLoop, alpha: object, beta: object) -> Booleans:
    """Return whether each point is stable, i.e. has all poles inside the unit circle.

    Parameters
    ----------
    loop : NormalisedLoop
    alpha, beta : array_like, shape (n,)
        Normalised virtual stiffness and damping.

    Notes
    -----
    The result is exact up to rounding of the boundary. It is not guaranteed for spectral radii closer to 1 than 1e-12.

    Source: Hulin 2017, sec. 3.4.
    """
    return np.asarray(_margins(loop, *as_points(alpha, beta)) > 0)


MARGIN = 1e-9
"""Threshold for the distance from the boundary, as a share of alpha + gamma. Below it, rounding dominates costs."""


def is_well_inside(
    loop: NormalisedLoop, alpha: Floats, beta: Floats, share: float = MARGIN, *, islands: bool = True
) -> Booleans:
    """Return whether each point stays stable if alpha changes by a share of alpha + gamma in either direction, (n,).

    Costs of points closer to the boundary are sums over billions of samples, which rounding dominates. Without
    ``islands``, every softer wall at the same damping must also be stable, down to alpha -> 0.
    """
    away = share * (alpha + loop.gamma)
    return np.asarray((away > 0) & (_margins(loop, alpha, beta, islands=islands) > away))


def stiffness_limit(loop: NormalisedLoop, beta: object) -> Floats:
    """Return the alpha at each beta up to which all softer walls are stable, down to alpha -> 0, shape (n,).

    The limit is -inf if there is no such alpha. The accuracy is that of `is_inside`.

    Source: Hulin 2017, sec. 3.4.
    """
    _, b = as_points(0.0, beta)
    return soft_interval(loop, b)[1]


def soft_interval(loop: NormalisedLoop, beta: Floats) -> tuple[Floats, Floats]:
    """Return both ends of the stable interval at each beta that begins at or below alpha = 0, or nan and -inf."""
    found = stable_intervals(loop, beta)
    kept = np.flatnonzero(found.low <= 0)
    low, high = np.full(len(beta), np.nan), np.full(len(beta), -np.inf)
    # the last interval is the highest
    low[found.index[kept]], high[found.index[kept]] = found.low[kept], found.high[kept]
    return low, high


def _margins(loop: NormalisedLoop, alpha: Floats, beta: Floats, *, islands: bool = True) -> Floats:
    """Return the distance of alpha to the closer end of its stable interval, shape (n,).

    It is negative if alpha is unstable.
    """
    levels, of = np.unique(beta, return_inverse=True)
    found = stable_intervals(loop, levels)
    kept = np.flatnonzero(islands | (found.low <= 0))
    index, low, high = found.index[kept], found.low[kept], found.high[kept]
    result = np.full(len(alpha), -np.inf)
    counts = np.bincount(index, minlength=len(levels))
    start = np.cumsum(counts) - counts
    for number in range(int(counts.max(initial=0))):  # one iteration per stable interval of a line
        has = np.flatnonzero(counts[of] > number)
        row = start[of[has]] + number
        result[has] = np.maximum(result[has], np.minimum(alpha[has] - low[row], high[row] - alpha[has]))
    return result


_STIFFNESSES = 65
"""Number of springs in the first sweep, denser towards both ends. Between a few kinks, the limit is smooth in gamma."""

_ROUNDS = 4
"""Number of refinements around the worst spring of each beta."""

_FINER = 8
"""Number of parts per round into which gaps next to a worst spring are divided. After all rounds, the gaps are divided
by 8^4, with an error of 1e-9 at a smooth minimum."""


_POINTS = 40
"""Number of dampings of an outline on each side of the damping of the device."""


def robust_outline(delta: float, delay: float) -> tuple[Floats, Floats, Floats]:
    """Return alpha, beta and the worst gamma along the outline of the region that is stable with every spring, shape
    (n,).

    The arrays are empty if there is no such region, e.g. for delta = 0. Parameters and errors are as in
    `robust_limits`.

    Source: Hulin 2017, Fig. 4.5.
    """
    beyond = np.geomspace(1.0, 1 + 4 / (delta * (delay + 0.5)), _POINTS) if delta > 0 else np.empty(0)
    beta = delta * np.concatenate([np.linspace(-1.0, 1.0, _POINTS), beyond[1:]])
    alpha, gamma = robust_limits(delta, delay, beta)
    inside = alpha > 1e-9 * alpha.max(initial=0.0)  # at B = -b, alpha is 0 up to rounding
    return alpha[inside], beta[inside], gamma[inside]


def robust_limits(delta: float, delay: float, beta: object) -> tuple[Floats, Floats]:
    """Return the largest alpha at each beta that is stable with every spring, and the worst spring gamma.

    Parameters
    ----------
    delta, delay : float
        Normalised damping of the device, and delay factor.
    beta : array_like, shape (n,)

    Returns
    -------
    limit, gamma : float64, shape (n,)
        The limit is -inf if no alpha > 0 is stable with every spring, e.g. for delta = 0.

    Raises
    ------
    ParameterError
        If delta or delay is out of range.

    Notes
    -----
    gamma is between 0 and pi^2 + delta^2/4 (4.15). Every alpha between 0 and the limit is robustly stable. For each
    spring, the stable interval that starts at or below 0 has an upper end. The limit is the smallest of these ends. It
    is found by a sweep over gamma, refined around the worst springs. For long delays it is conservative, by 0.5 % at
    d = 128 and 0.7 % at d = 256.

    Source: Hulin 2017, sec. 4.3.3.
    """
    _, b = as_points(0.0, beta)
    if not (math.isfinite(delta) and delta >= 0):
        raise ParameterError(f"delta = {delta}: expected a finite nonnegative number.")
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
        for row, value in zip(rows, new, strict=True):  # only for beta whose worst spring is near
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
"""Largest friction, relative to the inertial force at the turning points, for which a sine approximates the motion."""

_EQUIVALENTS = 12
"""Number of equivalent dampings for which limits are computed. Neighbouring dampings differ by at most one half."""

_SEEN = 0.1
"""Smallest limit, relative to the largest one, at dampings that determine the range of equivalent dampings."""


def step_limits(loop: NormalisedLoop, beta: Floats, share: float) -> Floats:
    """Return the limit at dampings for oscillations with the amplitude of a step, F_0/(K + k), or nan if not valid.

    Parameters
    ----------
    loop : NormalisedLoop
    beta : float64, shape (n,)
    share : float
        Ratio of friction to step, f_c/F_0, > 0.

    Notes
    -----
    The equivalent damping 4 f_c/(pi omega A) depends on the limit and its frequency. Limits are therefore computed for
    several equivalent dampings and the corresponding friction, and interpolated linearly. The error is about 1 % of the
    effect of friction. The limit is valid if the device never sticks, i.e. if f_c <= m omega^2 A/2.

    The describing function replaces the square wave of friction by its first harmonic. A wall is less stable for larger
    oscillations. The linear limit applies to large oscillations.

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
        over = np.flatnonzero(shares[:, i] >= share)  # the first one, since the oscillation decays with softer walls
        if len(over) and over[0] > 0:
            some = slice(over[0] - 1, over[0] + 1)
            stiff, turn = (np.interp(share, shares[some, i], values[some, i]) for values in (alpha, angle))
            if share * (stiff + loop.gamma) <= _SLIDING * turn**2:
                result[i] = stiff
    return result


def quantum_limit(coulomb: float, quantum: float, force_gain: float = 1.0) -> float:
    """Return the stiffness up to which the sensor resolution causes no limit cycle, 2 f_c/(g quantum), in SI.

    Parameters
    ----------
    coulomb : float
        Coulomb friction f_c of the device [N, Nm].
    quantum : float
        Sensor resolution [m, rad], > 0.
    force_gain : float
        Force per command, g.

    Notes
    -----
    The condition is sufficient but not necessary. Stiffer walls may also be free of limit cycles.

    Source: Diolaiti et al. 2006; Abbott and Okamura 2005.
    """
    return 2 * coulomb / (force_gain * quantum)
