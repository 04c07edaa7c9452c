"""Goal `optimum`: walls to try until the best cost by a criterion is found.

The loop of all logs foretells the cost of each wall; what measured costs differ from it by is a random function of the
place. A wall is best only by its own measured cost.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import erf

from pipeline.loop.loop import Loop, Normalised
from pipeline.plan.requests import NOTHING_ASKED, SAME, Requests
from pipeline.plan.verdicts import Tried
from pipeline.records.batch import Booleans, Floats
from pipeline.records.criteria import criterion_of
from pipeline.theory.costs import point_costs_by_name
from pipeline.theory.limits import stiffness_limit

LENGTHS = (0.12, 0.08)
"""Lengths over which the logarithm of a cost changes, relative to the ranges of B and K."""

HIGHEST_OF_OWN = 0.95
"""Share of the loop's own limit from which on its responses last too long to be followed."""

NUGGET = 0.03
"""Part of the logarithm of a cost that does not change smoothly: settling times jump from one swing to the next."""

DAMPINGS, SHARES, HIGHEST = 36, np.linspace(0.03, 0.9, 32), 0.9
"""Places of the grid over the stable region: dampings, and shares of the limit at each."""

SPACING = float(SHARES[1] - SHARES[0])
"""Distance of shares."""

ZOOM, ZOOMS = np.linspace(-1.0, 1.0, 9), ((1.5, 6), (0.5, 6), (0.2, 6), (0.08, 3))
"""Places about the lowest of the grid, how far they reach in its distances, and about how many: the shortest settling
times lie in a narrow valley beside a jump, of which a grid sees any place by chance."""

LONGEST = 1000
"""Samples after which a response that still moves has no cost."""

FIRST, FIRST_ELSE = 6, 15
"""Costs below which no search is done, however right the loop seems; and where it does not explain the logs."""

SURE = 1.0
"""Standard errors that the least cost may lie below what is expected."""

LEAST_SIZE, WRONG_LOOP, NO_LOOP = 0.03, 0.15, 0.5
"""Least standard deviation of what the logarithm of a cost differs by from that of a loop that explains the logs, of
one that does not, and without one."""

USUAL_OFFSET = 0.15
"""Logarithm by which all measured costs may differ from those of the loop alike: whole samples, friction."""

TIE, MIDDLE = 1e-3, np.array([0.5, 0.3])
"""Weight of the distance from where one begins without a loop: damping and stiffness, relative to the largest."""

FINALISTS, BESIDE = 150, ((-0.004, 0.0), (0.004, 0.0), (0.0, -0.004), (0.0, 0.004))
"""Most promising walls, and how far from each others are looked at: so far the loop and a rig's numbers may be off."""

NO_COST = 1.0
"""Logarithm by which a wall without a cost counts as worse than expected: it keeps the search away."""

OFTEN = 2
"""Trials of one wall after which its cost is known."""

OFFSET = 0.01
"""Added to costs that may be zero, so that they have a logarithm: one percent of overshoot is as good as none."""


@dataclass(frozen=True, eq=False)
class Foreseen:
    """The loop by which costs are foretold, its units, and whether it explains the logs."""

    loop: Loop
    units: Normalised
    explains: bool = True

    def costs(self, stiffness: Floats, damping: Floats, criterion: str) -> Floats:
        """Return the costs of walls [N/m, Nm/rad; Ns/m, Nms/rad]; NaN near and beyond the limit of its own walls."""
        alpha, beta = stiffness / self.units.stiffness, damping / self.units.damping
        levels, place = np.unique(beta, return_inverse=True)
        limit = stiffness_limit(self.loop, levels)[place]
        cost = np.full(len(alpha), np.nan)
        inside = np.flatnonzero((alpha > 0) & (alpha < HIGHEST_OF_OWN * limit))
        if len(inside):
            found = point_costs_by_name(self.loop, alpha[inside], beta[inside], [criterion], LONGEST, part=True)
            cost[inside] = found[criterion]
        return cost


@dataclass(frozen=True, eq=False)
class Target:
    """What is looked for, and where.

    Parameters
    ----------
    criterion : str
    dampings, highest : float64, shape (n,)
        Dampings B, rising, and the largest stiffness that is thought to be stable at each.
    by : Foreseen or None
        What foretells costs.
    requests : Requests
        What was asked for so far: only walls that the rig sets are looked at.
    """

    criterion: str
    dampings: Floats
    highest: Floats
    by: Foreseen | None
    requests: Requests = NOTHING_ASKED

    @property
    def offset(self) -> float:
        """Added to costs that may be zero."""
        return OFFSET if criterion_of(self.criterion).family.levels else 0.0

    @property
    def scale(self) -> Floats:
        """Largest damping and stiffness, by which places are counted."""
        return np.array([float(self.dampings[-1]) or 1.0, max(float(self.highest.max()), 1e-300)])

    def highest_at(self, damping: Floats) -> Floats:
        """Return the largest stiffness that is thought to be stable at dampings."""
        return np.interp(damping, self.dampings, self.highest)

    def foretold(self, K: Floats, B: Floats) -> Floats:
        """Return the logarithm of foretold costs; 0 without a loop, NaN where it has none."""
        if self.by is None:
            return np.zeros(len(K))
        found = self.by.costs(K, B, self.criterion) + self.offset
        return np.asarray(np.log(np.where(found > 0, found, np.nan)))


@dataclass(frozen=True, eq=False)
class Search:
    """What is known of the best cost.

    Parameters
    ----------
    walls : tuple of (float, float, float)
        Walls to try next: K [N/m, Nm/rad], B [Ns/m, Nms/rad], expected cost.
    done : bool
        Whether no wall is thought to be better than the best trial by more than the wanted accuracy.
    best : int or None
        Place of the best trial.
    least : float or None
        Least cost that is expected anywhere.
    region : (float, float, float, float) or None
        Smallest and largest K and B of walls within the accuracy of it.
    """

    walls: tuple[tuple[float, float, float], ...]
    done: bool
    best: int | None
    least: float | None
    region: tuple[float, float, float, float] | None


def look_for(tried: Tried, target: Target, accuracy: float, count: int) -> Search:
    """Return walls to try and whether the best cost is found.

    Parameters
    ----------
    tried : Tried
        With the costs.
    target : Target
    accuracy : float
        By which the best trial may be worse than the best wall, relative.
    count : int

    Notes
    -----
    The logarithm of measured over foretold costs is a Gaussian random function with lengths `LENGTHS`; the wall with
    the largest expected improvement is tried (Jones 1998). Of a batch, each wall is taken as tried with the expected
    cost.
    """
    by, offset, scale = target.by, target.offset, target.scale
    K, B, ahead = _places(target)
    seen, value = _seen(tried, target)
    cost = np.log(tried.cost + offset)
    known = np.isfinite(cost)
    best = _best(tried, cost, target)
    place, seen = np.column_stack([B, K]) / scale, seen / scale
    walls_tried = np.column_stack([tried.damping, tried.stiffness]) / scale
    walls, done = [], False
    region, least = None, None
    for number in range(count):
        mean, spread = _expected(seen, value, place, by)
        mean = mean + ahead
        record = float(cost[best]) if best is not None else np.inf
        gain = _gain(record - mean, spread) if best is not None else _hope(mean, spread, place)
        top = np.argsort(-np.where(_known(place, walls_tried), -np.inf, gain), kind="stable")[:FINALISTS]
        around = mean[top] + _beside(K[top], B[top], ahead[top], target)
        again = _gain(record - around, spread[top]) if best is not None else _hope(around, spread[top], place[top])
        pick = int(top[np.argmax(np.where(_known(place[top], walls_tried), -np.inf, again))])
        if number == 0:
            lowest = float((mean - SURE * spread).min())
            done = _is_done(int(known.sum()), record, lowest, accuracy, by)
            least = float(np.exp(mean.min()) - offset)
            near = mean <= mean.min() + np.log1p(accuracy)
            own = [] if best is None else [best]  # a wall that is called the best is one of the best
            in_K, in_B = np.append(K[near], tried.stiffness[own]), np.append(B[near], tried.damping[own])
            region = (float(in_K.min()), float(in_K.max()), float(in_B.min()), float(in_B.max()))
        walls.append((float(K[pick]), float(B[pick]), float(np.exp(mean[pick]) - offset)))
        seen, value = np.vstack([seen, place[pick]]), np.append(value, mean[pick] - ahead[pick])
    return Search(tuple(walls), done, best, least, region if by is not None else None)


def _known(place: Floats, walls: Floats) -> Booleans:
    """Return which places are walls that were tried `OFTEN`: another trial of them tells nothing."""
    near = (np.abs(place[:, None, :] - walls[None, :, :]) <= SAME).all(axis=2)
    return np.asarray(near.sum(axis=1) >= OFTEN)


def _is_done(costs: int, record: float, lowest: float, accuracy: float, by: Foreseen | None) -> bool:
    """Return whether so many costs, of which the least has this logarithm, are enough."""
    enough = FIRST if by is not None and by.explains else FIRST_ELSE
    return bool(costs >= enough and record <= np.log1p(accuracy) + lowest)


def _best(tried: Tried, cost: Floats, target: Target) -> int | None:
    """Return the trial of least cost; of those alike the one for which the least is foretold."""
    if not np.isfinite(cost).any():
        return None
    alike = np.flatnonzero(cost == np.nanmin(cost))
    if target.by is None or len(alike) == 1:
        return int(alike[0])
    foretold = target.by.costs(tried.stiffness[alike], tried.damping[alike], target.criterion)
    return int(alike[np.argmin(np.nan_to_num(foretold, nan=np.inf))])


def _places(target: Target) -> tuple[Floats, Floats, Floats]:
    """Return K, B and the logarithm of the foretold cost of walls that may be tried: a grid, denser at its best."""
    dampings, requests = target.dampings, target.requests
    B = np.linspace(dampings[0], dampings[-1], DAMPINGS) if len(dampings) > 1 else dampings
    K, B = np.outer(target.highest_at(B), SHARES).ravel(), np.repeat(B, len(SHARES))
    K, B = requests.as_set(K[K > 0], B[K > 0])
    cost = target.foretold(K, B)
    cell = float(np.ptp(dampings)) / (DAMPINGS - 1)
    for reach, starts in ZOOMS if target.by is not None and np.isfinite(cost).any() else ():
        more_K, more_B = [], []
        for best in _lowest(K, B, cost, starts):
            more_B.append(B[best] + reach * cell * np.repeat(ZOOM, len(ZOOM)))
            more_K.append(K[best] + reach * target.highest_at(B[best]) * SPACING * np.tile(ZOOM, len(ZOOM)))
        near_B = np.clip(np.concatenate(more_B), dampings[0], dampings[-1])
        near_K, near_B = requests.as_set(np.concatenate(more_K), near_B)
        some = (near_K > 0) & (near_K <= HIGHEST * target.highest_at(near_B))
        K, B = np.append(K, near_K[some]), np.append(B, near_B[some])
        cost = np.append(cost, target.foretold(near_K[some], near_B[some]))
    good = np.isfinite(cost)
    return K[good], B[good], cost[good]


def _lowest(K: Floats, B: Floats, cost: Floats, count: int) -> list[int]:
    """Return the places of lowest cost, each at another damping than those before."""
    found: list[int] = []
    for place in np.argsort(np.nan_to_num(cost, nan=np.inf), kind="stable"):
        if all(abs(B[place] - B[other]) > 1e-9 for other in found):
            found.append(int(place))
        if len(found) == count:
            break
    return found


def _seen(tried: Tried, target: Target) -> tuple[Floats, Floats]:
    """Return B and K of the trials, and by how much the logarithm of their costs differs from the foretold one."""
    K, B = tried.stiffness, tried.damping
    inside = HIGHEST * target.highest_at(B) > K
    foretold = np.full(len(K), np.nan)
    foretold[inside] = target.foretold(K[inside], B[inside])
    value = np.log(tried.cost + target.offset) - foretold
    usual = float(np.nanmean(value)) if np.isfinite(value).any() else 0.0
    value = np.where(inside & np.isnan(tried.cost), usual + NO_COST, value)
    told = np.isfinite(value)
    return np.column_stack([B, K])[told], value[told]


def _beside(K: Floats, B: Floats, ahead: Floats, target: Target) -> Floats:
    """Return by how much walls beside others are foretold to be worse, as logarithm: the best ones stand at a jump."""
    if target.by is None:
        return np.zeros(len(K))
    off = [target.foretold(K * (1 + k), B * (1 + b)) - ahead for k, b in BESIDE]
    return np.asarray(np.mean([np.where(np.isnan(each), NO_COST, each) for each in off], axis=0))


def _hope(mean: Floats, spread: Floats, place: Floats) -> Floats:
    """Return how good a wall may be before any cost is known; of those alike soft ones amid the dampings are better."""
    return np.asarray(spread - mean - TIE * np.abs(place - MIDDLE).sum(axis=1))


def _gain(better: Floats, spread: Floats) -> Floats:
    """Return the expected improvement of a cost that is expected to be better by so much."""
    z = better / spread
    return np.asarray(spread * (z * 0.5 * (1 + erf(z / np.sqrt(2))) + np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi)))


def _expected(seen: Floats, value: Floats, place: Floats, by: Foreseen | None) -> tuple[Floats, Floats]:
    """Return mean and standard deviation of the random function at places, given what was seen."""
    least = NO_LOOP if by is None else LEAST_SIZE if by.explains else WRONG_LOOP
    if not len(value):
        return np.zeros(len(place)), np.full(len(place), least)
    # a loop may be off a little everywhere; one that is off by more is wrong, and not its scale
    most = np.inf if by is None else USUAL_OFFSET
    usual = float(np.clip(np.median(value), -most, most))
    size = max(float(np.sqrt(np.mean((value - usual) ** 2))), least)
    among = _likeness(seen, seen) + np.eye(len(seen)) * ((NUGGET / size) ** 2 + 1e-9)
    toward = _likeness(place, seen)
    gain = np.linalg.solve(among, toward.T).T
    variance = np.maximum(1 - (gain * toward).sum(axis=1), 1e-9)
    return usual + gain @ (value - usual), size * np.sqrt(variance)


def _likeness(first: Floats, second: Floats) -> Floats:
    apart = ((first[:, None, :] - second[None, :, :]) / np.array(LENGTHS)) ** 2
    distance = np.sqrt(3 * apart.sum(axis=2))
    return np.asarray((1 + distance) * np.exp(-distance))
