"""Find the optimal wall of a loop for each criterion.

Each kind of criterion has a search that is suitable for its costs. Energy is smooth. Settling time jumps where an
extremum of the response crosses the band, and its optimum is in the corner of such a jump. The discrete settling time
has steps. Pole radius and damping ratio have kinks where poles meet. The region without overshoot ends in cusps.
`search` and `curves` explain why each search finds the global optimum.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.normalised_loop import NormalisedLoop, as_points
from pipeline.records.criteria import CRITERIA, DISCRETE, OVERSHOOT, criterion_of, is_criterion
from pipeline.records.trials import Booleans, Floats, Integers
from pipeline.theory.boundary import boundary, is_well_inside, stiffness_limit
from pipeline.theory.costs import point_costs_by_name
from pipeline.theory.energy import energy_costs
from pipeline.theory.poles import REAL, damping_ratio, pole_settling_time, poles, spectral_radius, threefold_pole
from pipeline.theory.search import (
    JUMPING,
    SMOOTH,
    Cost,
    Landscape,
    OptimalPoint,
    bounding_box,
    box,
    chart,
    grid,
    region,
    search,
    search_lines,
    search_plane,
    where_stable,
)
from pipeline.theory.settling_overshoot import NO_OVERSHOOT, late_deviation, transient_costs

UNDAMPED_LOSS = 1e-9
"""Largest distance of a damping ratio from 1 that is attributed to rounding. If a triple pole splits by 1e-5, the ratio
decreases by 2e-10."""

_CLEAR = 1e-8
"""Threshold for the distance from the edge of the stable region, as a share of alpha + gamma. Below it, an optimum lies
on the edge. A search keeps a tenth of this distance."""

_ENDLESS = 60
"""Number of samples per d + 1 after which a response is not settled in a search. Optima settle in about 5 (d + 1)."""

_ENDLESS_LOSS = 1e-9
"""Threshold for the distance of the smallest pole radius from 1. Below it, no response settles in a search."""

_IMPULSE_INSET = 0.002
"""Distance of the first grid for an impulse from alpha = -gamma, as a share of the width."""

_NEAR_LINE = 1e-4
"""Distance from alpha = -gamma, relative to the width, from which a parabola extrapolates the limit. The cost is smooth
in the distance, so the error is about 1e-10. Sums over 1e4 samples and more have the same error."""

_CREEP = 1e-9
"""Smallest (alpha + gamma) and |beta|, relative to the largest, in the search for the largest damping ratio. With a
delay, this optimum is close to the line alpha = -gamma (5.1.2)."""

_CORNER = 1e-5
"""Relative distance within which a closed form replaces the result of a search."""

_KINK_LEVELS = 16
"""Number of levels of a search near kinks, 0.35^16 = 5e-8 of a first step. With more levels, rounding of multiple poles
would decide between points."""


@lru_cache(maxsize=1024)
def optimal_point(loop: NormalisedLoop, criterion: str) -> OptimalPoint:
    """Return the optimal point for a criterion.

    Parameters
    ----------
    loop : NormalisedLoop
    criterion : str
        One of `records.criteria.CRITERIA`. For criteria of a response, ``_discrete`` may be appended for the costs of
        the sampled response.

    Returns
    -------
    OptimalPoint
        The cost is as printed in the tables: pole modulus, damping ratio (the largest ratio, not its negative as in
        5.3), settling time [samples], overshoot, or energy. If several points are optimal, the result for the discrete
        settling time is the centre of their bounding box. For overshoot and for a damping ratio of 1, it is the
        stiffest point. ``attained`` is False if the optimum is a limit. This may be the edge of the stable region, or,
        for E_0 of an impulse, alpha -> -gamma. With a delay and gamma = 0, the damping ratio tends to 1 for alpha, beta
        -> 0, since the additional poles tend to 0 and the poles of the plant are real.

    Raises
    ------
    ParameterError
        If the criterion is unknown.

    Source: Hulin 2017, secs. 5.1 and 5.2; reproduces C.1 to C.3 and the theory rows of D.1 to D.6.
    """
    if not is_criterion(criterion, CRITERIA):
        raise ParameterError(
            f"criterion {criterion!r} is unknown; expected one of {[*CRITERIA]}, or a criterion of a response with "
            "_discrete appended."
        )
    found = SEARCHES.get(criterion_of(criterion).family.name, _least)(loop, criterion)
    # a vibration inside the band may have no cost even close to instability
    inside = is_well_inside(loop, np.array([found.alpha]), np.array([found.beta]), _CLEAR)
    return found if inside[0] else replace(found, attained=False)


def _least(loop: NormalisedLoop, criterion: str) -> OptimalPoint:
    """Return the smallest cost inside the stable region, or, as a limit, along its edge.

    The cost must be continuous at the edge.
    """
    longest = int(_ENDLESS * (loop.delay + 1))

    def at(place: Floats) -> tuple[Floats, Floats]:
        """Return the edge at the given dampings."""
        return stiffness_limit(loop, place), place

    def cost(alpha: Floats, beta: Floats, _: float) -> Floats:
        return point_costs_by_name(loop, alpha, beta, (criterion,), longest)[criterion]

    def along(_: Integers, place: Floats, best: float) -> Floats:
        alpha, beta = at(place)
        found = np.full(len(place), np.inf)
        steep = alpha > lowest
        found[steep] = cost(alpha[steep], beta[steep], best)
        return np.where(np.isnan(found), np.inf, found)

    lowest, ends = float(box(loop)[0][0]), boundary(loop).beta
    edge = search_lines(along, np.nanmin(ends, keepdims=True), np.nanmax(ends, keepdims=True))
    inside = search(loop, cost, SMOOTH, region())
    if edge.cost[0] > inside.cost:
        return inside
    alpha, beta = at(edge.place)
    return OptimalPoint(float(alpha[0]), float(beta[0]), float(edge.cost[0]), attained=False)


def _best_poles(loop: NormalisedLoop, criterion: str) -> OptimalPoint:
    return _smallest_radius(loop) if criterion == "pole_radius" else _most_damped(loop)


def _least_energy(loop: NormalisedLoop, criterion: str) -> OptimalPoint:
    base = criterion_of(criterion)
    if base.name == "energy_impulse_w0":
        return _least_impulse_energy(loop, criterion)
    return search(loop, energy(loop, criterion), SMOOTH, region() if base.signal == "step" else region(_IMPULSE_INSET))


def energy(loop: NormalisedLoop, criterion: str, lowest: float = -np.inf) -> Cost:
    """Return the energy cost for a search. It is infinite below ``lowest``, where a limit replaces it."""
    of = criterion_of(criterion)
    return lambda a, b, _: np.where(a >= lowest, energy_costs(loop, a, b, of.signal, (of.weight,))[criterion], np.inf)


def _soonest_settled(loop: NormalisedLoop, criterion: str) -> OptimalPoint:
    if criterion.endswith(DISCRETE):
        return _settling_region(loop, band_of(criterion), criterion)
    try:
        return search(loop, settling(loop, criterion, int(_ENDLESS * (loop.delay + 1))))
    except ParameterError:  # no response of the first grid settles
        slowest = _smallest_radius(loop)
        if slowest.cost < 1 - _ENDLESS_LOSS:
            raise
        return replace(slowest, cost=np.nan)


def band_of(criterion: str) -> float:
    """Return the half-width of the band of a settling time, relative to the final displacement."""
    band = criterion_of(criterion).band
    assert band is not None, "only settling times have a band"
    return band


def settling(loop: NormalisedLoop, criterion: str, longest: int) -> Cost:
    """Return the settling time for a search, from responses of at most ``longest`` samples."""
    band, continuous = band_of(criterion), not criterion.endswith(DISCRETE)

    def cost(a: Floats, b: Floats, best: float) -> Floats:
        found = transient_costs(
            loop, a, b, (band,), overshoot=False, continuous=continuous, longest=longest, cutoff=best
        )
        return found[criterion]

    return cost


def _smallest_radius(loop: NormalisedLoop) -> OptimalPoint:
    """Return the smallest pole modulus, in closed form if three real poles coincide there."""
    (low, high), walls = region(inset=0.0), chart(loop)
    radius = Landscape(walls, lambda alpha, beta, _: spectral_radius(loop, alpha, beta))
    *at, cost = search_plane(radius, low, high, levels=_KINK_LEVELS)
    alpha, beta, _ = (float(values[0]) for values in walls.wall(*(np.array([value]) for value in at)))
    exact = threefold_pole(loop, cost)
    if exact is not None and abs(exact[2] - cost) <= _CORNER * 10 and exact[2] < 1:
        away = max(abs(exact[0] - alpha) / (high[0] - low[0]), abs(exact[1] - beta) / (high[1] - low[1]))
        if away <= 100 * _CORNER:
            return OptimalPoint(*exact)
    return OptimalPoint(alpha, beta, cost)


def _most_damped(loop: NormalisedLoop) -> OptimalPoint:
    """Return the largest damping ratio. Among points without oscillation, return the stiffest one.

    With a delay, the best points are close to alpha = -gamma and beta = 0, so both are searched on logarithmic scales.
    """
    low, high = box(loop, inset=0.0)
    width, largest = float(high[0] - low[0]), float(max(high[1], -low[1]))
    unit = _CREEP * largest

    def cost(alpha: Floats, beta: Floats, _: float) -> Floats:
        ratio = damping_ratio(loop, alpha, beta)
        return np.where(ratio < 1 - UNDAMPED_LOSS, -ratio, -1 - (alpha + loop.gamma) / width)

    guarded = where_stable(loop, cost)

    def by_magnitude(first: Floats, second: Floats, best: float) -> Floats:
        return guarded(-loop.gamma + width * np.exp(first), unit * np.sinh(second), best)

    reach = float(np.arcsinh(1 / _CREEP))
    corners = np.array([np.log(_CREEP), -reach]), np.array([0.0, reach])
    first, second, found = search_plane(by_magnitude, *corners, coarse=(61, 241), levels=_KINK_LEVELS)
    alpha, beta = -loop.gamma + width * float(np.exp(first)), unit * float(np.sinh(second))
    plant_is_real = loop.delta**2 >= 4 * loop.gamma
    if plant_is_real and (found > -1 or alpha < _CREEP * width):
        # without a wall, no pole oscillates; for gamma = 0, the pole at z = 1 makes this a limit
        return OptimalPoint(0.0, 0.0, 1.0, attained=loop.gamma > 0)
    if found > -1:
        return OptimalPoint(alpha, beta, -found)
    radius = float(spectral_radius(loop, alpha, beta)[0])
    exact = threefold_pole(loop, radius)
    if exact is not None and abs(exact[0] - alpha) <= _CORNER * width:
        alpha, beta, _ = exact
    return OptimalPoint(alpha, beta, 1.0)


def _least_impulse_energy(loop: NormalisedLoop, criterion: str) -> OptimalPoint:
    """Return the optimum of E_0 after an impulse, along the limit alpha -> -gamma or inside the stable region."""
    low, high = box(loop)
    # closer to the line, the limit replaces the cost, so that a search cannot benefit from rounding errors
    inside = search(loop, energy(loop, criterion, nearest_to_line(loop)), SMOOTH, region(_IMPULSE_INSET))
    end = np.array([low[1]]), np.array([high[1]])
    line = search_lines(lambda _, beta, __: impulse_energy_limit(loop, beta, criterion), *end, coarse=61, levels=12)
    if line.cost[0] <= inside.cost:
        return OptimalPoint(0.0 - loop.gamma, float(line.place[0]), float(line.cost[0]), attained=False)
    return inside


def nearest_to_line(loop: NormalisedLoop) -> float:
    """Return the alpha below which the limit alpha -> -gamma replaces the impulse energy with w = 0."""
    return _NEAR_LINE * (float(box(loop)[1][0]) + loop.gamma) - loop.gamma


def impulse_energy_limit(loop: NormalisedLoop, beta: Floats, criterion: str = "energy_impulse_w0") -> Floats:
    """Return the limit of the impulse energy with w = 0 for alpha -> -gamma from above, or infinity if unstable.

    Parameters
    ----------
    loop : NormalisedLoop
    beta : float64, shape (n,)
    criterion : str
        ``energy_impulse_w0`` or ``energy_impulse_w0_discrete``.

    Notes
    -----
    Towards the line, the potential energy decreases with alpha + gamma, but it is stored for a time that increases with
    the reciprocal. Its integral therefore has a positive limit, although it is zero on the line. The cost is a smooth
    function of the distance. A parabola through three points close to the line extrapolates it to the limit.

    Source: Hulin 2017, sec. 5.2.3.
    """
    step = nearest_to_line(loop) + loop.gamma
    cost = where_stable(loop, energy(loop, criterion))
    near, far, farther = (cost(np.full(len(beta), -loop.gamma + step * n), beta, np.inf) for n in (1, 2, 4))
    usable = np.isfinite(near) & np.isfinite(far) & np.isfinite(farther)
    result = np.full(len(beta), np.inf)
    result[usable] = (8 * near[usable] - 6 * far[usable] + farther[usable]) / 3
    return result


def _settling_region(loop: NormalisedLoop, band: float, criterion: str) -> OptimalPoint:
    """Return the smallest discrete settling time, and the bounding box of all points that have it.

    A number of samples n is possible if the largest deviation of samples n, n + 1, ... is inside the band for some
    wall. This deviation is continuous, so its minimum can be searched for, although the settling time has steps.
    """
    longest = int(_ENDLESS * (loop.delay + 1))

    def deviation(alpha: Floats, beta: Floats, _: float, first: int) -> Floats:
        return late_deviation(loop, alpha, beta, first, longest)

    # start with a number that is certainly possible, and then try smaller numbers in turn
    landscape, places = Landscape(chart(loop), settling(loop, criterion, longest)), grid(*region(), JUMPING.coarse)
    alpha, beta, _ = landscape.chart.wall(*places)
    tried = landscape(*places, longest)
    index = int(np.argmin(tried))
    if not np.isfinite(tried[index]):
        raise ParameterError(f"no response settles into a band of {band} within {longest} samples.")
    samples = int(tried[index])
    point = OptimalPoint(float(alpha[index]), float(beta[index]), float(samples))
    while samples > 1:  # the loop terminates, because each further round needs one sample less
        better = search(loop, partial(deviation, first=samples - 1))
        if better.cost > band:
            break
        samples, point = samples - 1, better

    def feasible(alpha: Floats, beta: Floats, _: float) -> Floats:
        return np.where(deviation(alpha, beta, np.inf, samples) <= band, 0.0, np.inf)

    ends = bounding_box(where_stable(loop, feasible), np.array([point.alpha, point.beta]), box(loop))
    return OptimalPoint(0.5 * (ends[0] + ends[1]), 0.5 * (ends[2] + ends[3]), float(samples), ends)


POINT_CRITERIA = ("alpha_max", "beta_max", "ziegler_nichols")
"""Points of the plane that are not the optimum of a cost."""

REFERENCE_DELAY = 8.0
"""Delay factor for the scaling factors of Table 5.1."""


def marked_point(loop: NormalisedLoop, name: str) -> OptimalPoint:
    """Return the stable point of largest stiffness or damping, or the Ziegler-Nichols point. Its cost is nan.

    Parameters
    ----------
    loop : NormalisedLoop
    name : {"alpha_max", "beta_max", "ziegler_nichols"}

    Raises
    ------
    ParameterError
        If the name is unknown.

    Notes
    -----
    The Ziegler-Nichols rule is for a PI controller of the velocity. At the critical gain beta_max, the loop oscillates
    with a period of T_u = 2 pi/theta samples. The rule gives a gain of 0.45 beta_max and an integral time of T_u/1.2,
    so that alpha = 0.54 beta_max/T_u. Without physical stiffness and damping, T_u = 4, 8, 12 for d = 0, 1, 2.

    Source: Hulin 2017, secs. 3.4 and 5.3 (Fig. 5.14); Tables C.1 to C.3.
    """
    if name not in POINT_CRITERIA:
        raise ParameterError(f"point {name!r} is unknown; expected one of {list(POINT_CRITERIA)}.")
    border = boundary(loop)
    if name == "alpha_max":
        return OptimalPoint(border.alpha_max, border.beta_at_alpha_max, np.nan)
    if name == "beta_max":
        return OptimalPoint(border.alpha_at_beta_max, border.beta_max, np.nan)
    top = np.nanargmax(np.where(np.isnan(border.theta), np.nan, border.beta))
    period = 2 * np.pi / float(border.theta[top])
    return OptimalPoint(0.54 * border.beta_max / period, 0.45 * border.beta_max, np.nan)


def scaling_factor(criterion: str, reference: float = REFERENCE_DELAY, gamma: float = 0.0, delta: float = 0.0) -> float:
    """Return the scaling factor of the polynomial cost approximation, optimal cost/(d + 1)^(w + 1) at one delay.

    Parameters
    ----------
    criterion : str
        Pole radius (for the settling time that it predicts, 5.4), settling time or energy. For criteria of a response,
        ``_discrete`` may be appended.
    reference : float
        Delay factor at which the approximation is exact.
    gamma, delta : float
        Normalised stiffness and damping of the device, which are 0 in the table.

    Raises
    ------
    ParameterError
        If the criterion is unknown, or is overshoot or damping ratio, whose optimal costs do not depend on the delay.

    Source: Hulin 2017, eq. 5.19 and Table 5.1.
    """
    if criterion == "damping" or criterion_of(criterion).family is OVERSHOOT:
        raise ParameterError(f"criterion {criterion!r}: its optimal cost does not depend on delay (5.4.2).")
    cost = optimal_point(NormalisedLoop.ideal(gamma, delta, reference), criterion).cost
    cost = float(pole_settling_time(cost)[0]) if criterion == "pole_radius" else cost
    return float(cost / (reference + 1) ** (criterion_of(criterion).weight + 1))


_FAINT = 1e-60
"""Deviation down to which a response is checked for an overshoot of any size. Below it, the slowest modes dominate,
because a mode that decays 10 % faster is smaller by six more decades."""

_FLOORS = (0.2, 0.05, 0.01)
"""Lower ends of the search for the edge, as shares of the stable stiffness. The edge is near 0.35, and softer walls
creep."""

_RIDGE = 73
"""Number of points of the edge of the region without overshoot around its highest part."""

_TIPS = 3
"""Number of tips of this edge that are refined."""

_CLIMBS = 7
"""Number of refinements of a tip. Its damping is then accurate to 0.4^7 = 2e-3 of the spacing of the points, and its
stiffness to 1e-8."""

_EQUAL = 1e-4
"""Threshold for the relative difference of stiffness. Below it, two tips are equal. The tables of the thesis have four
digits."""


def _stiffest(loop: NormalisedLoop, criterion: str) -> OptimalPoint:
    """Return the stiffest point whose step response has no overshoot. Its cost is 0.

    The criterion determines whether the motion between samples or only the samples are evaluated. It also determines
    whether overshoot of any size is excluded (`never_overshoots`) or up to 1e-12 is allowed, as in the thesis.

    Source: Hulin 2017, sec. 5.2.2 with footnote 4.
    """
    base, (low, high) = criterion_of(criterion), box(loop)
    clean = CleanRegion(loop, criterion == base.name, base.optimum_only, float(high[0]))
    # the optimal damping for the spring of a device may be negative
    sides = [np.linspace(0.0, high[1], 61)[1:]]
    sides += [np.linspace(low[1], 0.0, 61)] if loop.gamma > 0 else []
    tips = [point for point in map(clean.stiffest, sides) if point is not None]
    if not tips:
        raise ParameterError("no point without overshoot was found.")
    return max(tips, key=lambda point: point.alpha)


@dataclass(frozen=True, eq=False)
class CleanRegion:
    """Walls of a loop without overshoot of motion or samples, of any size or above the tolerance, up to an alpha."""

    loop: NormalisedLoop
    continuous: bool
    at_all: bool
    alpha_max: float

    def cost(self, alpha: Floats, beta: Floats, _: float) -> Floats:
        """Return 0 if there is no overshoot, otherwise infinity."""
        if self.at_all:
            none = never_overshoots(self.loop, alpha, beta, continuous=self.continuous)
        else:
            costs = transient_costs(self.loop, alpha, beta, (), continuous=self.continuous, cutoff=NO_OVERSHOOT)
            none = costs["overshoot" if self.continuous else "overshoot_discrete"] <= NO_OVERSHOOT
        return np.where(none, 0.0, np.inf)

    def contains(self, alpha: Floats, beta: Floats) -> Booleans:
        """Return whether each wall is stable without overshoot."""
        return np.isfinite(where_stable(self.loop, self.cost)(alpha, beta, np.inf))

    def edge(self, beta: Floats, floor: Floats, top: Floats, passes: int) -> Floats:
        """Return the largest alpha at each beta in [floor, top] (floor if none), with 24 sections in each pass.

        With increasing alpha, a wall leaves the region only once, because no softer wall has overshoot. A test checks
        this.
        """
        lower, upper = floor.copy(), top.copy()
        share, row = np.linspace(0, 1, 25), np.arange(len(beta))
        for _ in range(passes):
            alpha = lower[:, None] + share * (upper - lower)[:, None]
            good = self.contains(alpha.ravel(), np.repeat(beta, 25)).reshape(alpha.shape)
            last = np.where(good.all(axis=1), 24, good.argmin(axis=1) - 1)
            lower = alpha[row, np.maximum(last, 0)]
            upper = np.where(last < 0, lower, alpha[row, np.minimum(last + 1, 24)])
        return lower

    def stiffest(self, betas: Floats) -> OptimalPoint | None:
        """Return the stiffest point between sorted dampings, or None if all points have overshoot."""
        count, soft = len(betas), -self.loop.gamma
        stiff = self.alpha_max - soft
        for share in _FLOORS:
            edges = self.edge(betas, np.full(count, share * stiff + soft), np.full(count, self.alpha_max), 2)
            highest = float(edges.max()) - soft
            if highest > share * stiff:
                break
        else:
            return None
        ridge = betas[np.argmax(edges)] + np.linspace(-3, 3, _RIDGE) * (betas[1] - betas[0])
        floor, ceiling = 0.8 * highest + soft, min(1.1 * highest, stiff) + soft
        edges = self.edge(ridge, np.full(_RIDGE, floor), np.full(_RIDGE, ceiling), 3)
        tips = _local_maxima(edges)[:_TIPS]
        alpha, beta = self._climbed(edges[tips], ridge[tips], 1.5 * (ridge[1] - ridge[0]), 0.01 * highest)
        # of tips with practically equal stiffness, report the smallest damping, so that rounding does not decide
        known = self.contains(alpha, beta)  # a floor means that there is no edge
        if not known.any():
            return None
        alpha, beta = alpha[known], beta[known]
        equal = np.flatnonzero(alpha - soft >= (alpha - soft).max() * (1 - _EQUAL))
        best = equal[np.argmin(beta[equal])]
        return OptimalPoint(float(alpha[best]), float(beta[best]), 0.0)

    def _climbed(self, alpha: Floats, beta: Floats, half: float, width: float) -> tuple[Floats, Floats]:
        """Return refined tips of the edge."""
        for _ in range(_CLIMBS):
            window, middle = beta[:, None] + half * np.linspace(-1, 1, 19), np.repeat(alpha, 19)
            values = self.edge(window.ravel(), middle - width, middle + width, 2).reshape(window.shape)
            peak, tip = values.argmax(axis=1), np.arange(len(alpha))
            better = values[tip, peak] > alpha
            alpha = np.where(better, values[tip, peak], alpha)
            beta = np.where(better, window[tip, peak], beta)
            half, width = half * 0.4, width * 0.35
        return alpha, beta


def _local_maxima(values: Floats) -> list[int]:
    """Return the indices of inner local maxima, the highest one first."""
    inner = np.flatnonzero((values[1:-1] >= values[:-2]) & (values[1:-1] > values[2:])) + 1
    if not len(inner):
        inner = np.array([int(np.argmax(values))])
    return [int(i) for i in inner[np.argsort(values[inner])[::-1]]]


def never_overshoots(loop: NormalisedLoop, alpha: object, beta: object, *, continuous: bool = True) -> Booleans:
    """Return whether the step response of each wall has no overshoot of any size.

    Parameters
    ----------
    loop : NormalisedLoop
    alpha, beta : array_like, shape (n,)
        Normalised virtual stiffness and damping. Walls must be stable with alpha + gamma > 0.
    continuous : bool
        Whether the motion between samples is evaluated, or only the samples.

    Notes
    -----
    After a long time, the slowest mode dominates. If its pole is not real and positive, the response repeatedly crosses
    its final position, with decreasing amplitude. Therefore, the largest pole must be real and positive, and the
    response must stay below its final position until its deviation is 1e-60. This is computed without loss of relative
    precision.

    The thesis allows 1e-12 (footnote 4 of 5.2.2). Its region extends 3 to 4 % further.
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
            loop, a[slow_is_real], b[slow_is_real], (), continuous=continuous, quiet=_FAINT, cutoff=0.0
        )
        result[slow_is_real] = costs[name] == 0
    return result


SEARCHES = {"settling": _soonest_settled, "overshoot": _stiffest, "energy": _least_energy, "poles": _best_poles}
"""Searches for families of criteria that do not use the default search."""
