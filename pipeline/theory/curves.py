"""Compute optimal curves, which are the best damping for each stiffness and the best stiffness for each damping.

All lines of a curve are searched together (`theory.search`). The search along a line does not depend on its neighbours,
so a curve may jump where the optimum jumps (settling time and overshoot, Figs. 5.4 and 5.8).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.records.criteria import CRITERIA, DISCRETE, criterion_of, is_criterion
from pipeline.records.trials import Booleans, Floats, Integers
from pipeline.theory.boundary import boundary, stiffness_limit
from pipeline.theory.optimum import UNDAMPED_LOSS, band_of, energy, impulse_energy_limit, nearest_to_line, settling
from pipeline.theory.poles import damping_ratio, spectral_radius
from pipeline.theory.search import LEVELS, Cost, LineCost, LineOptima, extents, search_lines, where_stable
from pipeline.theory.settling_overshoot import NO_OVERSHOOT, late_deviation, transient_costs

_LONGEST = 1024
"""Number of samples after which a response of a curve is not settled. The curves of Fig. 5.4 end at about 60
samples."""

_DECIDED = 60
"""Number of samples per d + 1 in which a response reaches its largest overshoot or deviation, unless it has slow
beats."""

_MARGIN = 0.02
"""Share by which a line extends beyond the polygon of boundary points. The polygon is up to 1e-3 inside the
boundary."""

_BOUNDARY_POINTS = 400

_STEP_LOOK = 121
"""Number of points of the first scan of the deviation, which has no jumps. The late deviations of slow responses have
ripples. With half as many points, the result was wrong by one sample on one of 170 random lines."""

_STEP_LEVELS = 12
"""Number of levels of the search. 0.35^12 = 3e-6 of a first step suffices to decide whether a number of samples is
possible. No corner is located."""

_LINE = 1e-9
"""Distance from alpha = -gamma, relative to the length of a line, at which the limit at -gamma is used."""

_KINK_LEVELS = 30
"""Number of levels of the search near kinks. They reduce a step to 0.35^30 = 2e-14 of a first step. The error of the
radius of a triple pole is the cube root of this number."""


@dataclass(frozen=True, eq=False)
class Curve:
    """Best values of one wall parameter for given values of the other.

    Parameters
    ----------
    given : float64, shape (n,)
        Values of the given parameter.
    best, cost : float64, shape (n,)
        Best value of the other parameter, and its cost (for damping ratios, the ratio itself), or NaN if ``found`` is
        False.
    low, high : float64, shape (n,)
        Ends of the range of equally good values. ``best`` is in the middle. Such ranges exist for the discrete settling
        time (steps), the overshoot (region without overshoot), and the damping ratio (region with a ratio of 1).
    found : bool, shape (n,)
        False if no point of the line is stable, or no response settles within 1024 samples.
    """

    given: Floats
    best: Floats
    cost: Floats
    low: Floats
    high: Floats
    found: Booleans


def best_damping(loop: NormalisedLoop, criterion: str, alpha: object) -> Curve:
    """Return the best beta for each alpha.

    Parameters
    ----------
    loop : NormalisedLoop
    criterion : str
        One of `CURVE_CRITERIA`. For criteria of a response, ``_discrete`` may be appended.
    alpha : array_like, shape (n,)
        Normalised virtual stiffness. Values outside of (-gamma, alpha_max) have no best damping.

    Raises
    ------
    ParameterError
        If the criterion is unknown, or a value is not finite.

    Notes
    -----
    These are the solid curves of the figures in the thesis. The accuracy is 1e-9 of the stable region.

    Source: Hulin 2017, secs. 5.1 and 5.2, Figs. 5.2 to 5.4, 5.8, 5.10.
    """
    return _curve(loop, criterion, alpha, stiffness_given=True)


def best_stiffness(loop: NormalisedLoop, criterion: str, beta: object) -> Curve:
    """Return the best alpha for each beta, i.e. the dashed curves of the figures in the thesis.

    Parameters and errors are as in `best_damping`, with alpha and beta exchanged. If the best stiffness is a limit at
    alpha = -gamma (E_0 of an impulse; damping ratio with a delay), the value is -gamma.
    """
    return _curve(loop, criterion, beta, stiffness_given=False)


def _curve(loop: NormalisedLoop, criterion: str, values: object, *, stiffness_given: bool) -> Curve:
    given = np.atleast_1d(np.asarray(values, dtype=np.float64))
    if given.ndim != 1 or not np.isfinite(given).all():
        raise ParameterError("values of a curve: expected a list of finite numbers.")
    if not is_criterion(criterion, CURVE_CRITERIA):
        raise ParameterError(
            f"criterion {criterion!r} has no optimal curve; expected one of {list(CURVE_CRITERIA)}, or one of a "
            "response with _discrete appended."
        )
    low, high = _ends(loop, given, stiffness_given)
    inside = np.flatnonzero(np.isfinite(low))
    lines = _Lines(loop, given[inside], low[inside], high[inside], stiffness_given)
    result = np.full((4, len(given)), np.nan)
    if len(inside):
        result[:, inside] = _optima(lines, criterion)
    best, cost, first, last = result
    return Curve(given, best, cost, first, last, np.isfinite(best))


@dataclass(frozen=True, eq=False)
class _Lines:
    """Lines through the stable region, given by values of one parameter and both ends of the other parameter."""

    loop: NormalisedLoop
    given: Floats
    low: Floats
    high: Floats
    stiffness_given: bool

    def cost(self, cost: Callable[..., Floats], *of_line: Floats) -> LineCost:
        """Return the cost along the lines, infinite if not stable. ``of_line`` are further arguments for each line."""
        guarded = where_stable(self.loop, cost)

        def along(line: Integers, place: Floats, best: float) -> Floats:
            pair = (self.given[line], place) if self.stiffness_given else (place, self.given[line])
            return guarded(*pair, best, *(each[line] for each in of_line))

        return along

    def search(self, cost: Cost, levels: int = LEVELS) -> LineOptima:
        return search_lines(self.cost(cost), self.low, self.high, levels=levels)

    def some(self, which: Integers) -> _Lines:
        return _Lines(self.loop, self.given[which], self.low[which], self.high[which], self.stiffness_given)

    def late_deviation(self, first: Floats) -> LineCost:
        """Return the largest deviation from sample ``first`` onward. This sample may differ between lines."""
        decided = int(_DECIDED * (self.loop.delay + 1))

        def deviation(alpha: Floats, beta: Floats, _: float, begin: Floats) -> Floats:
            return late_deviation(self.loop, alpha, beta, begin, max(2 * int(begin.max()), decided))

        return self.cost(deviation, first)


def _ends(loop: NormalisedLoop, given: Floats, stiffness_given: bool) -> tuple[Floats, Floats]:
    """Return the slightly widened ends of the line through the stable region at each value, or NaN if there is no
    line."""
    if stiffness_given:
        border, value = boundary(loop, _BOUNDARY_POINTS), given[:, None]
        level, other = border.alpha, border.beta
        # one end is included, so a line through a corner intersects exactly one of its sides; a side with nan, which
        # separates regions, is never intersected
        meets = (np.minimum(level[:-1], level[1:]) <= value) & (value < np.maximum(level[:-1], level[1:]))
        rise = np.where(level[1:] == level[:-1], 1.0, level[1:] - level[:-1])
        at = other[:-1] + (value - level[:-1]) * (other[1:] - other[:-1]) / rise
        low, high = np.where(meets, at, np.inf).min(axis=1), np.where(meets, at, -np.inf).max(axis=1)
    else:
        high = stiffness_limit(loop, given)
        low = np.full(len(given), 0.0 - loop.gamma)
    missed = ~(low < high)
    low, high = np.where(missed, np.nan, low), np.where(missed, np.nan, high)
    margin = _MARGIN * (high - low)
    return low - margin * stiffness_given, high + margin


def _optima(lines: _Lines, criterion: str) -> Floats:
    """Return the best value, its cost, and the ends of the range of equally good values, shape (4, lines)."""
    return OPTIMA[criterion_of(criterion).family.name](lines, criterion)


def _poles(lines: _Lines, criterion: str) -> Floats:
    loop = lines.loop
    if criterion == "pole_radius":
        return _plain(lines.search(lambda a, b, _: spectral_radius(loop, a, b), _KINK_LEVELS))

    def oscillation(alpha: Floats, beta: Floats, _: float) -> Floats:
        ratio = damping_ratio(loop, alpha, beta)
        return np.where(ratio >= 1 - UNDAMPED_LOSS, -1.0, -ratio)

    place, cost, low, high = _flat(lines, oscillation, _KINK_LEVELS)
    if not lines.stiffness_given:
        at_line = place + loop.gamma <= _LINE * (lines.high - lines.low)
        place, low, high = (np.where(at_line, 0.0 - loop.gamma, v) for v in (place, low, high))
    return np.array([place, -cost, low, high])


def _overshoot(lines: _Lines, criterion: str) -> Floats:
    loop = lines.loop

    def overshoot(alpha: Floats, beta: Floats, _: float) -> Floats:
        found = transient_costs(
            loop,
            alpha,
            beta,
            (),
            continuous=not criterion.endswith(DISCRETE),
            longest=int(_DECIDED * (loop.delay + 1)),
            unfinished_overshoot=True,
        )[criterion]
        return np.where(found <= NO_OVERSHOOT, 0.0, found)

    return _flat(lines, overshoot)


def _energy(lines: _Lines, criterion: str) -> Floats:
    if criterion_of(criterion).name == "energy_impulse_w0":
        return _impulse(lines, criterion)
    return _plain(lines.search(energy(lines.loop, criterion)))


def _settling(lines: _Lines, criterion: str) -> Floats:
    if criterion.endswith(DISCRETE):
        return _steps(lines, criterion)
    return _plain(lines.search(settling(lines.loop, criterion, _LONGEST)))


def _plain(found: LineOptima) -> Floats:
    return np.array([found.place, np.where(np.isfinite(found.place), found.cost, np.nan), found.place, found.place])


def _flat(lines: _Lines, cost: Cost, levels: int = LEVELS) -> Floats:
    """Return the optima of a cost that is constant over a part of the region."""
    found = lines.search(cost, levels)
    low, high = extents(lines.cost(cost), found, lines.low, lines.high)
    # outside of a constant part, only rounding would determine the extent of the range
    whole = np.isin(found.cost, (0.0, -1.0))
    low, high = np.where(whole, low, found.place), np.where(whole, high, found.place)
    return np.array([0.5 * (low + high), np.where(np.isfinite(found.place), found.cost, np.nan), low, high])


def _impulse(lines: _Lines, criterion: str) -> Floats:
    """Return the optima of the impulse energy with w = 0. The best stiffness may be the limit alpha -> -gamma."""
    loop = lines.loop
    found = lines.search(energy(loop, criterion, -np.inf if lines.stiffness_given else nearest_to_line(loop)))
    if lines.stiffness_given:
        return _plain(found)
    limit = impulse_energy_limit(loop, lines.given, criterion)
    at_line = limit <= found.cost
    place = np.where(at_line & np.isfinite(limit), 0.0 - loop.gamma, found.place)
    return _plain(LineOptima(place, np.where(at_line, limit, found.cost)))


def _steps(lines: _Lines, criterion: str) -> Floats:
    """Return the optima of the discrete settling time. The number of samples of each line is decreased as long as it is
    possible.

    A number of samples n is possible on a line if the largest deviation from sample n onward is inside the band
    somewhere on the line. This deviation is a continuous function.
    """
    band = band_of(criterion)
    first_look = lines.search(settling(lines.loop, criterion, _LONGEST), levels=0)
    place, count = first_look.place.copy(), first_look.cost.copy()
    open_lines = np.flatnonzero(np.isfinite(count) & (count > 1))
    while len(open_lines):  # the loop terminates, because each remaining line needs one sample less, down to 1
        part = lines.some(open_lines)
        deviation = part.late_deviation(count[open_lines] - 1)
        found = search_lines(deviation, part.low, part.high, coarse=_STEP_LOOK, starts=3, levels=_STEP_LEVELS)
        better = found.cost <= band
        open_lines = open_lines[better]
        place[open_lines] = found.place[better]
        count[open_lines] -= 1
        open_lines = open_lines[count[open_lines] > 1]
    low, high = np.full_like(place, np.nan), np.full_like(place, np.nan)
    which = np.flatnonzero(np.isfinite(count))
    part = lines.some(which)
    inside = LineOptima(place[which], np.full(len(which), band))
    deviation = part.late_deviation(count[which])
    low[which], high[which] = extents(deviation, inside, part.low, part.high, coarse=_STEP_LOOK, halvings=30)
    return np.array([0.5 * (low + high), np.where(np.isfinite(place), count, np.nan), low, high])


OPTIMA = {"settling": _settling, "overshoot": _overshoot, "energy": _energy, "poles": _poles}
"""Functions that find the optima along lines, with families of criteria as keys."""

CURVE_CRITERIA = tuple(c.name for c in CRITERIA.values() if c.family.name in OPTIMA and not c.optimum_only)
"""Criteria with optimal curves. For criteria of a response, ``_discrete`` may be appended."""
