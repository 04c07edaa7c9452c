"""Search for the goal `optimum`, which selects walls to try until the best cost by a criterion is found.

The device identified from all logs predicts the cost of each wall. The deviation of the measured from the predicted
costs is modelled as a random function of (K, B). The best wall always has a measured cost.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.device.loop import Loop
from pipeline.loop.normalised_loop import LoopUnits, NormalisedLoop
from pipeline.planning.campaign import SAME
from pipeline.planning.next_wall import VOTES, TriedWalls
from pipeline.records.criteria import criterion_of
from pipeline.records.trials import Floats
from pipeline.theory.boundary import stiffness_limit
from pipeline.theory.costs import point_costs_by_name

LENGTHS = np.array([0.12, 0.08])
"""Correlation lengths of the logarithm of a cost along B and K, relative to the ranges of B and K."""

HIGHEST = 0.95
"""Threshold for the stiffness as a fraction of the limit. Above it, costs are not computed, because the responses are
slow and their costs high."""

DAMPINGS, SHARES = 36, np.linspace(0.03, 0.9, 32)
"""Grid over the stable region: the number of dampings, and the fractions of the limit at each damping."""

ZOOM, ZOOMS = np.linspace(-1.0, 1.0, 9), ((1.5, 6), (0.5, 6), (0.2, 6), (0.08, 3))
"""Refinement around the lowest grid points: relative positions, and pairs of a range (in grid spacings) and a number of
points.

The shortest settling times lie in a narrow valley next to a jump, which a grid finds only by chance.
"""

LONGEST = 1000
"""Number of simulated samples. A response that still moves after them has no cost."""

FIRST, FIRST_ELSE = 6, 15
"""Smallest number of measured costs at which a search may end.

The first number applies if the device is correct, and the second number if its limits are wrong.
"""

ROUGH, WRONG = 0.03, 0.15
"""Standard deviations of the logarithm of a cost relative to its prediction.

The first applies if the device has the measured limits, and the second if it does not.

Costs scatter because a settling time jumps if a further swing leaves the band. A common offset of all costs may be as
large as the second number.
"""

FINALISTS, NEIGHBOUR_OFFSETS = 150, ((-0.004, 0.0), (0.004, 0.0), (0.0, -0.004), (0.0, 0.004))
"""Number of the most promising walls whose neighbours are checked, and offsets of these neighbours.

The identified device and the gains that the rig sets may be wrong by these offsets.
"""

NO_COST = 1.0
"""Penalty, as logarithm, of a wall without a cost relative to its expected cost, so that the search avoids it."""

OFFSET = 0.01
"""Offset of costs that may be zero, so that they have a logarithm. One percent of overshoot is equivalent to none."""


def costs_of(loop: Loop, stiffness: Floats, damping: Floats, criterion: str) -> Floats:
    """Return the costs of walls of a loop [N/m, Nm/rad; Ns/m, Nms/rad]. They are NaN near and beyond the limit."""
    normalised, units = NormalisedLoop.of(loop), LoopUnits.of(loop)
    alpha, beta = stiffness / units.stiffness, damping / units.damping
    levels, place = np.unique(beta, return_inverse=True)
    cost, limit = np.full(len(alpha), np.nan), stiffness_limit(normalised, levels)[place]
    inside = np.flatnonzero((alpha > 0) & (alpha < HIGHEST * limit))
    if len(inside):
        found = point_costs_by_name(normalised, alpha[inside], beta[inside], [criterion], LONGEST)
        cost[inside] = found[criterion]
    return cost


@dataclass(frozen=True, eq=False)
class CostTarget:
    """Goal and range of the search for the best cost.

    Parameters
    ----------
    criterion : str
    dampings, highest : float64, shape (n,)
        Dampings B in increasing order, and the estimated largest stable stiffness at each.
    by : Loop or None
        Loop that predicts the costs.
    holds : bool
        Whether this loop agrees with the measured limits.
    """

    criterion: str
    dampings: Floats
    highest: Floats
    by: Loop | None
    holds: bool = True

    @property
    def offset(self) -> float:
        """Offset of costs that may be zero."""
        return OFFSET if criterion_of(self.criterion).family.levels else 0.0

    @property
    def scale(self) -> Floats:
        """Largest damping and stiffness, which are the units of the coordinates."""
        return np.array([float(self.dampings[-1]) or 1.0, max(float(self.highest.max()), 1e-300)])

    @property
    def least_size(self) -> float:
        """Smallest standard deviation of the logarithm of a cost from its prediction."""
        return ROUGH if self.by is not None and self.holds else WRONG

    def highest_at(self, damping: Floats) -> Floats:
        """Return the estimated largest stable stiffness at the given dampings."""
        return np.interp(damping, self.dampings, self.highest)

    def predicted(self, K: Floats, B: Floats) -> Floats:
        """Return the logarithm of predicted costs. It is 0 without a device, and NaN if the device predicts no cost."""
        if self.by is None:
            return np.zeros(len(K))
        found = costs_of(self.by, K, B, self.criterion) + self.offset
        return np.asarray(np.log(np.where(found > 0, found, np.nan)))


@dataclass(frozen=True, eq=False)
class Search:
    """State of the search for the best cost.

    Parameters
    ----------
    walls : tuple of (float, float, float)
        Walls to try next, each with K [N/m, Nm/rad], B [Ns/m, Nms/rad] and the expected cost.
    done : bool
        Whether no wall is expected to improve on the best trial by more than the accuracy. If so, the search ends.
    best : int or None
        Index of the best trial.
    least : float
        Smallest expected cost of all walls.
    region : (float, float, float, float) or None
        Smallest and largest K, then smallest and largest B, of walls whose expected cost is within the accuracy of
        ``least``. None without a device.
    """

    walls: tuple[tuple[float, float, float], ...]
    done: bool
    best: int | None
    least: float
    region: tuple[float, float, float, float] | None


def search_walls(
    tried: TriedWalls, target: CostTarget, accuracy: float, count: int, unset: Floats | None = None
) -> Search:
    """Return the walls to try, and whether the best cost is found.

    Parameters
    ----------
    tried : TriedWalls
        Trials with their costs.
    target : CostTarget
    accuracy : float
        Largest relative excess of the best tried cost over the best possible cost.
    count : int
    unset : float64, shape (n, 2), optional
        K and B of requested walls in place of which the rig set different walls. They are not requested again.

    Notes
    -----
    The logarithm of measured over predicted costs is a Gaussian process with the correlation lengths `LENGTHS`. The
    wall with the largest expected improvement is tried (Jones 1998). Within a batch, each chosen wall counts as tried
    with its expected cost.
    """
    K, B, ahead = _candidates(target)
    seen, value = _observations(tried, target)
    cost = np.log(tried.cost + target.offset)
    best = _best(tried, cost, target)
    record = float(cost[best]) if best is not None else np.inf
    place, seen = np.column_stack([B, K]) / target.scale, seen / target.scale
    tests = np.column_stack([tried.damping, tried.stiffness]) / target.scale
    often = ((np.abs(place[:, None] - tests) <= SAME).all(axis=2)).sum(axis=1) >= VOTES
    if unset is not None and len(unset):
        others = unset[:, ::-1] / target.scale
        often |= np.any((np.abs(place[:, None] - others) <= SAME).all(axis=2), axis=1)
    walls: list[tuple[float, float, float]] = []
    first = mean, spread = _expected(seen, value, place, ahead, target)
    for _ in range(count):
        top = np.argsort(-np.where(often, -np.inf, _gain(record, mean, spread)), kind="stable")[:FINALISTS]
        around = mean[top] + _neighbour_rise(K[top], B[top], ahead[top], target)
        pick = int(top[np.argmax(np.where(often[top], -np.inf, _gain(record, around, spread[top])))])
        walls.append((float(K[pick]), float(B[pick]), float(np.exp(mean[pick]) - target.offset)))
        seen, value = np.vstack([seen, place[pick]]), np.append(value, mean[pick] - ahead[pick])
        mean, spread = _expected(seen, value, place, ahead, target)
    mean, spread = first
    enough = np.isfinite(cost).sum() >= (FIRST if target.by is not None and target.holds else FIRST_ELSE)
    done = bool(enough and record <= np.log1p(accuracy) + float((mean - spread).min()))
    region = None
    if target.by is not None:
        near, own = mean <= mean.min() + np.log1p(accuracy), [] if best is None else [best]
        # The best wall must be part of the best region.
        in_K, in_B = np.append(K[near], tried.stiffness[own]), np.append(B[near], tried.damping[own])
        region = (float(in_K.min()), float(in_K.max()), float(in_B.min()), float(in_B.max()))
    return Search(tuple(walls), done, best, float(np.exp(mean.min()) - target.offset), region)


def _best(tried: TriedWalls, cost: Floats, target: CostTarget) -> int | None:
    """Return the index of the trial with the lowest cost. Among equal costs, the lowest predicted cost decides."""
    if not np.isfinite(cost).any():
        return None
    alike = np.flatnonzero(cost == np.nanmin(cost))
    predicted = target.predicted(tried.stiffness[alike], tried.damping[alike])
    return int(alike[np.argmin(np.nan_to_num(predicted, nan=np.inf))])


def _candidates(target: CostTarget) -> tuple[Floats, Floats, Floats]:
    """Return K, B and the logarithm of the predicted cost of candidate walls.

    The walls form a grid that is denser around the lowest predicted costs.
    """
    dampings = target.dampings
    B = np.linspace(dampings[0], dampings[-1], DAMPINGS) if len(dampings) > 1 else dampings
    K, B = np.outer(target.highest_at(B), SHARES).ravel(), np.repeat(B, len(SHARES))
    K, B = K[K > 0], B[K > 0]
    cost = target.predicted(K, B)
    cell = float(np.ptp(dampings)) / (DAMPINGS - 1)
    for reach, starts in ZOOMS if target.by is not None and np.isfinite(cost).any() else ():
        # the lowest points, each at a different damping
        order = np.argsort(np.nan_to_num(cost, nan=np.inf), kind="stable")
        low = order[np.sort(np.unique(np.round(B[order], 9), return_index=True)[1])[:starts], None]
        near_B = np.clip(B[low] + reach * cell * np.repeat(ZOOM, len(ZOOM)), dampings[0], dampings[-1]).ravel()
        about = reach * target.highest_at(B[low]) * (SHARES[1] - SHARES[0])
        near_K = (K[low] + about * np.tile(ZOOM, len(ZOOM))).ravel()
        some = (near_K > 0) & (near_K <= SHARES[-1] * target.highest_at(near_B))
        K, B = np.append(K, near_K[some]), np.append(B, near_B[some])
        cost = np.append(cost, target.predicted(near_K[some], near_B[some]))
    good = np.isfinite(cost)
    return K[good], B[good], cost[good]


def _observations(tried: TriedWalls, target: CostTarget) -> tuple[Floats, Floats]:
    """Return B and K of the trials, and the difference between the logarithms of the measured and the predicted
    cost."""
    K, B = tried.stiffness, tried.damping
    inside = SHARES[-1] * target.highest_at(B) > K
    predicted = np.full(len(K), np.nan)
    predicted[inside] = target.predicted(K[inside], B[inside])
    value = np.log(tried.cost + target.offset) - predicted
    usual = float(np.nanmean(value)) if np.isfinite(value).any() else 0.0
    value = np.where(inside & np.isnan(tried.cost), usual + NO_COST, value)
    known = np.isfinite(value)
    return np.column_stack([B, K])[known], value[known]


def _neighbour_rise(K: Floats, B: Floats, ahead: Floats, target: CostTarget) -> Floats:
    """Return the mean increase of the predicted log cost at the neighbours of walls.

    This increase matters because the best walls are next to a jump of the cost.
    """
    off = [target.predicted(K * (1 + k), B * (1 + b)) - ahead for k, b in NEIGHBOUR_OFFSETS]
    return np.asarray(np.mean([np.where(np.isnan(each), NO_COST, each) for each in off], axis=0))


def _gain(record: float, mean: Floats, spread: Floats) -> Floats:
    """Return the expected improvement of the smallest log cost. Without any cost, return the negative lower bound of
    the log cost."""
    if not np.isfinite(record):
        return np.asarray(spread - mean)
    z = (record - mean) / spread
    from scipy.special import ndtr

    return np.asarray(spread * (z * ndtr(z) + np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi)))


def _expected(seen: Floats, value: Floats, place: Floats, ahead: Floats, target: CostTarget) -> tuple[Floats, Floats]:
    """Return mean and standard deviation of the logarithm of the cost at the given walls, given the observations."""
    if not len(value):
        return ahead, np.full(len(place), target.least_size)
    # A small common offset is plausible. A larger deviation means a wrong device, not a wrong scale.
    most = np.inf if target.by is None else WRONG
    usual = float(np.clip(np.median(value), -most, most))
    size = max(float(np.sqrt(np.mean((value - usual) ** 2))), target.least_size)
    among = _correlation(seen, seen) + np.eye(len(seen)) * ((ROUGH / size) ** 2 + 1e-9)
    toward = _correlation(place, seen)
    gain = np.linalg.solve(among, toward.T).T
    variance = np.maximum(1 - (gain * toward).sum(axis=1), 1e-9)
    return ahead + usual + gain @ (value - usual), size * np.sqrt(variance)


def _correlation(first: Floats, second: Floats) -> Floats:
    apart = ((first[:, None, :] - second[None, :, :]) / LENGTHS) ** 2
    distance = np.sqrt(3 * apart.sum(axis=2))
    return np.asarray((1 + distance) * np.exp(-distance))
