"""Search strategy for the goal `boundary`.

The search selects walls to try until two verdicts bracket the limit at each damping closely enough.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import inf
from statistics import NormalDist
from typing import Literal

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.planning.requests import RigRange
from pipeline.records.trials import Booleans, Floats

VOTES = 3
"""Number of trials of a wall after which contradicting verdicts are not attributed to chance, and the majority decides.

The same number limits undecided trials at a damping and repeated trials for a cost. A rig that sets an end of a bracket
this often, instead of a wall inside, counts as unable to set a wall inside.
"""

MISFIT = 0.007
"""Smallest error of predicted limits, relative to the largest limit. It is assumed before a limit is measured.

The error is not zero, because verdicts do not detect growth below the noise.
"""

SMOOTH = 0.15
"""Correlation length of the model error over damping, relative to the range of dampings."""

DOUBT = 0.08
"""Probability that the forecast is wrong. The limit may then lie anywhere in its bracket."""

PRICE = 6.0
"""Number of stable trials that cost as much as an unstable trial, if the rig is to be protected."""

SAFE, BOLD = 1.5, 0.3
"""Factors for protection of the rig.

The first is the margin of a wall below the expected limit, in standard errors. The second is a fraction of this limit:
softer walls are not tried, because they would give no information. This fraction also limits the first wall.
"""

WEAK = 0.08
"""Threshold for the logarithmic change of the amplitude over a log.

Below it, a second verdict is requested, because noise and friction may cause such a change.
"""

CLOSE = 1.8
"""Width of a sufficiently narrow bracket in units of the wanted accuracy.

It is slightly less than 2, because a verdict next to the limit may be wrong, and the largest limit is not known
exactly.
"""

START = 0.5
"""Stiffest first wall, relative to the limit that a device file predicts. A smaller delay raises the limit, and a file
may state half the true delay."""

BOLDER, GENTLER = 2.0, 1.3
"""Stiffest wall to try, relative to the stiffest stable wall.

The first number applies while no device is identified reliably, the second if the rig is to be protected.
"""

APART = 0.7
"""Stiffness of the next wall if walls are undecided, relative to the softest undecided wall."""

SOFT = 0.1
"""Stiffness, relative to the stiffest stable wall, that counts as stable at any damping."""

SOFTEST = 1e-3
"""Stiffness, relative to the largest limit, that is tried if a device file predicts no stable wall at a damping."""

HIGHER = 1.3
"""Largest stiffness in the search for a limit, relative to the largest known limit."""


@dataclass(frozen=True, eq=False)
class TriedWalls:
    """Trials so far, one row for each trial.

    Parameters
    ----------
    stiffness, damping : float64, shape (n,)
        K > 0 [N/m, Nm/rad] and B [Ns/m, Nms/rad].
    verdict : array of str, shape (n,)
        ``stable``, ``unstable`` or ``undecided``, by `measured.signal.verdict.judge`.
    growth : float64, shape (n,)
        Growth rate of the slowest visible mode [1/s], or NaN if it is unknown.
    force : float64, shape (n,)
        Largest absolute command [N, Nm], or NaN if not needed.
    cost : float64, shape (n,)
        Cost by the criterion of the goal, or NaN if there is none.
    """

    stiffness: Floats
    damping: Floats
    verdict: np.ndarray
    growth: Floats
    force: Floats = field(default_factory=lambda: np.empty(0))
    cost: Floats = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        for name in ("force", "cost"):
            if not len(getattr(self, name)):
                object.__setattr__(self, name, np.full(len(self.stiffness), np.nan))
        lengths = {len(column) for column in vars(self).values()}
        if len(lengths) > 1:
            raise ParameterError(
                f"columns of trials have {sorted(lengths)} rows: expected one value per trial in each column."
            )

    def __len__(self) -> int:
        return len(self.stiffness)

    def select(self, rows: Booleans) -> TriedWalls:
        """Return a subset of the trials."""
        return TriedWalls(**{name: column[rows] for name, column in vars(self).items()})


@dataclass(frozen=True)
class Bracket:
    """Range of the limit at a damping, according to verdicts.

    Parameters
    ----------
    low, high : float or None
        Stiffest stable and softest unstable wall that enclose the limit [N/m, Nm/rad]. None if none was tried.
    again : tuple of float
        Stiffness of walls to try again because their verdicts contradict other verdicts, fewest trials first.
    even : tuple of float
        Stiffness of those walls that have equal numbers of stable and unstable trials.
    lasting : bool
        Whether stable walls remain above unstable walls although each was tried `VOTES` times.
    trials : int
    """

    low: float | None = None
    high: float | None = None
    again: tuple[float, ...] = ()
    lasting: bool = False
    trials: int = 0
    even: tuple[float, ...] = ()

    @property
    def bottom(self) -> float:
        """Lower end, or 0 if no wall was stable, because K = 0 is no wall."""
        return 0.0 if self.low is None else self.low

    @property
    def top(self) -> float:
        """Upper end, or infinity if no wall was unstable."""
        return inf if self.high is None else self.high


def bracket(stiffness: Floats, verdict: np.ndarray, width: float = 0.0) -> Bracket:
    """Return the bracket of the limit at a damping.

    Parameters
    ----------
    stiffness : float64, shape (n,)
    verdict : array of str, shape (n,)
    width : float
        Range of K [N/m, Nm/rad] within which contradictions are normal near the limit and are not repeated.

    Notes
    -----
    The majority of the trials of a wall decides whether the wall is stable. Undecided trials do not count. A wall with
    equal numbers of stable and unstable trials counts as neither stable nor unstable, and low and high enclose it.
    After twice `VOTES` trials, such a wall counts as unstable. If a stable wall lies above an unstable wall, low and
    high enclose both until each was tried `VOTES` times. If the contradiction remains, there are several limits (due to
    a mode or friction), and the lowest is used.

    Examples
    --------
    >>> bracket(np.array([1000.0, 2000.0, 3000.0]), np.array(["stable", "undecided", "unstable"]))
    Bracket(low=1000.0, high=3000.0, again=(), lasting=False, trials=3, even=())
    >>> bracket(np.array([1000.0, 2000.0, 3000.0]), np.array(["stable", "unstable", "stable"])).again
    (2000.0, 3000.0)
    >>> bracket(np.array([1000.0, 2000.0, 2000.0, 3000.0]), np.array(["stable", "stable", "unstable", "unstable"]))
    Bracket(low=1000.0, high=3000.0, again=(2000.0,), lasting=False, trials=4, even=(2000.0,))
    """
    walls, column = np.unique(stiffness, return_inverse=True)
    votes = np.zeros(len(walls))
    tried = np.zeros(len(walls), dtype=np.int64)
    np.add.at(votes, column, np.where(verdict == "unstable", 1.0, np.where(verdict == "stable", -1.0, 0.0)))
    np.add.at(tried, column, 1)
    even = (votes == 0) & np.isin(walls, stiffness[verdict == "stable"])
    votes[even & (tried >= 2 * VOTES)] = 1.0
    stable, unstable = walls[votes < 0], walls[votes > 0]
    low, high = stable.max(initial=-inf), unstable.min(initial=inf)
    again = np.zeros(len(walls), dtype=np.bool_)
    lasting = False
    if low > high:
        if low - high > width:
            again = (walls >= high) & (walls <= low) & (tried < VOTES)
            lasting = not again.any()
        below = stable[stable < high].max(initial=-inf)
        if not lasting:
            high = unstable[unstable > low].min(initial=inf)
        low = below
    even &= (votes == 0) & (walls < high)
    if even.any():
        low = min(low, stable[stable < walls[even].min()].max(initial=-inf))
        even &= high - low > width
        again |= even
    repeated = np.flatnonzero(again)[np.argsort(tried[again], kind="stable")]
    return Bracket(
        low=float(low) if np.isfinite(low) else None,
        high=float(high) if np.isfinite(high) else None,
        again=tuple(walls[repeated].tolist()),
        lasting=lasting,
        trials=len(stiffness),
        even=tuple(walls[even].tolist()),
    )


@dataclass(frozen=True)
class PlanGoal:
    """Wanted limits of a plan, and bounds of its trials.

    Parameters
    ----------
    dampings : tuple of float
        B at which limits are wanted [Ns/m, Nms/rad], in increasing order.
    accuracy : float
        Wanted largest error of a limit, relative to the largest limit.
    gentle : bool
        Whether unstable trials are avoided.
    lowest, highest : float
        Smallest and largest K that may be tried [N/m, Nm/rad].
    force : float
        Largest permitted command [N, Nm]. If a trial exceeded it, no stiffer wall is tried at its damping.
    bold : float
        Stiffest wall to try, relative to the stiffest stable wall. It is infinite if a device is identified reliably.
    few : bool
        Whether the logs are so few that all possibly unstable walls are avoided.
    foresees : bool
        Whether predictions of the device for walls stiffer than all stable walls are trusted. They are not trusted if
        there are few logs, or if no log has a verdict that could contradict the device.
    """

    dampings: tuple[float, ...]
    accuracy: float = 0.02
    gentle: bool = False
    lowest: float = 0.0
    highest: float = inf
    force: float = inf
    bold: float = inf
    few: bool = False
    foresees: bool = True

    @property
    def start(self) -> float:
        """Stiffest first wall, relative to the predicted limit."""
        return BOLD if self.gentle else START


@dataclass(frozen=True, eq=False)
class Forecast:
    """Forecast of the limit at each damping before it is measured: value and standard error [N/m, Nm/rad], shape (n,)
    each.

    A limit that cannot be predicted is NaN. ``misfit`` is the error at measured limits, relative to the largest limit.
    ``low`` is the lowest limit of all devices consistent with the logs. By default, it equals the limit. ``scale`` is
    the largest limit at any damping, or 0 if unknown.
    """

    limit: Floats
    error: Floats
    misfit: float = MISFIT
    low: Floats = field(default_factory=lambda: np.empty(0))
    scale: float = 0.0

    def __post_init__(self) -> None:
        if not len(self.low):
            object.__setattr__(self, "low", self.limit)

    @classmethod
    def none(cls, count: int) -> Forecast:
        """Return an empty forecast."""
        return cls(np.full(count, np.nan), np.full(count, np.nan), inf)


@dataclass(frozen=True)
class NextTrial:
    """Best wall to try, with its index among the edges, the probability of instability, and the expected total number
    of trials."""

    place: int
    unstable: float
    trials: float


@dataclass(frozen=True)
class DampingState:
    """State of a damping, with its limit by verdicts and forecast, and the wall to try (None if the damping is done).

    ``estimate`` is the estimated limit, or None if it is unknown. ``split`` is None if a wall is tried again. ``most``
    is the stiffest wall that may be tried now.
    """

    damping: float
    bracket: Bracket
    estimate: float | None
    split: NextTrial | None = None
    wall: float | None = None
    note: str = ""
    most: float = inf

    @property
    def left(self) -> float:
        """Expected number of trials until this damping is done."""
        return self.split.trials if self.split else float(self.wall is not None)


@dataclass(frozen=True, eq=False)
class PlanState:
    """States of all dampings, the largest limit, and the forecast on which they are based."""

    columns: tuple[DampingState, ...]
    largest: float
    forecast: Forecast

    @property
    def done(self) -> bool:
        """Whether no wall remains to be tried."""
        return all(column.wall is None for column in self.columns)


def plan_state(
    tried: TriedWalls, goal: PlanGoal, by: Forecast | None = None, trial_s: float = inf, rig: RigRange | None = None
) -> PlanState:
    """Determine the limit and the wall to try next at each damping.

    Parameters
    ----------
    tried : TriedWalls
        Trials with K > 0 at any damping.
    goal : PlanGoal
    by : Forecast, optional
        Limits predicted from the device identified from the logs, or otherwise from its file. Without a forecast, the
        range between verdicts is bisected.
    trial_s : float
        Duration of a log after its step [s].
    rig : RigRange, optional
        Walls that the rig sets in place of requested walls. By default, the rig sets walls as requested.
    """
    rows = [tried.select(tried.damping == b) for b in goal.dampings]
    found = [bracket(own.stiffness, own.verdict) for own in rows]
    ends = np.array([(of.bottom, of.top) for of in found])
    ahead = corrected(by, ends, np.array(goal.dampings)) if by is not None else Forecast.none(len(found))
    known = len(tried) and (ends[:, 0].any() or np.isfinite(ends[:, 1]).any() or np.isfinite(ahead.limit).any())
    least = (goal.accuracy if known else 1.0) * float(tried.stiffness.max(initial=0.0))
    largest = _largest(ahead.limit, ends, least)
    largest = largest or (by.scale if by is not None else 0.0) or 1.0  # any value is valid if nothing is stable
    width = CLOSE * goal.accuracy * largest
    columns, decided = [], bool((tried.verdict != "undecided").any())
    for i, own in enumerate(rows):
        of = bracket(own.stiffness, own.verdict, width)
        stable = stiffest_stable(tried, goal.dampings[i])
        task = PlanTask(
            goal, largest, trial_s, float(ahead.limit[i]), float(ahead.error[i]), float(ahead.low[i]), stable, decided
        )
        column = _wall_to_try(goal.dampings[i], of, own, task, tried.stiffness, holds=ahead.misfit <= goal.accuracy)
        refuted = (own.verdict != "unstable").any()
        if (
            len(tried)
            and not refuted
            and goal.bold == inf
            and task.limit <= task.half
            and (task.error <= width or goal.gentle)
        ):
            # The limit is 0 within the accuracy, so every wall above it would be unstable.
            column = DampingState(goal.dampings[i], of, max(task.limit, 0.0), note="no stable wall")
        if rig is not None:
            column = _as_set(column, rig, goal)
        if by is not None and not len(tried) and column.wall is not None:
            limit = by.low[i] if by.low[i] > 0 else SOFT * by.limit[i]
            most = goal.start * float(limit if limit > 0 else SOFTEST * max(by.scale, largest))
            column = replace(column, wall=min(column.wall, most), most=most)
        columns.append(column)
    return PlanState(tuple(columns), largest, ahead)


def _as_set(column: DampingState, rig: RigRange, goal: PlanGoal) -> DampingState:
    """Return the state with a wall that the rig can set, or without a wall if the rig can set none inside the
    bracket."""
    of = column.bracket
    if column.note == "limit of the tests" and (goal.highest == rig.highest or 0 < goal.lowest == rig.lowest):
        return replace(column, note="step of the rig")
    if column.wall is None or column.split is None:
        return column
    low, high = (0.0, of.bottom) if column.note == "softer" else (of.bottom, of.top)
    wall = rig.wall(column.wall, low, high, max(min(column.most, goal.highest), column.wall))
    if wall is not None:
        return replace(column, wall=wall)
    return column if column.note == "softer" else replace(column, wall=None, split=None, note="step of the rig")


def stiffest_stable(tried: TriedWalls, damping: float) -> float:
    """Return the stiffness up to which walls with the given damping count as stable.

    Notes
    -----
    The result follows from the tried walls at all dampings. A stable wall counts as stable with more damping. With less
    damping, its stiffness is reduced in proportion, because the stable region is convex next to K = B = 0. At any
    damping, a wall with `SOFT` times the stiffness of the stiffest stable wall counts as stable. Stable walls above an
    unstable wall are ignored. Without a stable wall, half the stiffness of the softest wall is returned, or a quarter
    if this wall is unstable. The result is infinite without trials.

    Examples
    --------
    >>> tried = TriedWalls(np.array([2000.0]), np.array([10.0]), np.array(["stable"]), np.array([-9.0]))
    >>> [stiffest_stable(tried, damping) for damping in (0.0, 5.0, 20.0)]
    [200.0, 1000.0, 2000.0]
    """
    if not len(tried):
        return inf
    unstable = tried.select(tried.verdict == "unstable")
    below = np.array(
        [
            k < unstable.stiffness[unstable.damping == b].min(initial=inf)
            for k, b in zip(tried.stiffness, tried.damping, strict=True)
        ]
    )
    stable = tried.select((tried.verdict == "stable") & below)
    if not len(stable):
        first = np.argmin(tried.stiffness)
        return float(tried.stiffness[first]) * (0.25 if tried.verdict[first] == "unstable" else 0.5)
    share = np.where(stable.damping > damping, damping / np.maximum(stable.damping, 1e-300), 1.0)
    return float(max((share * stable.stiffness).max(), SOFT * stable.stiffness.max()))


def corrected(by: Forecast, ends: Floats, dampings: Floats) -> Forecast:
    """Return a forecast that is corrected by its errors so far.

    ``ends`` (n, 2) contains the bracket at each damping. At dampings with a closed bracket, the errors of the forecast
    are interpolated over damping by a Gaussian process (kriging). Its standard deviation combines the misfit with the
    error of the forecast, and its correlation length is `SMOOTH` times the range of dampings. A correction exceeds no
    error so far. Otherwise, two errors of opposite sign at the last dampings would give a larger error beyond them.
    """
    low, high = ends.T
    largest = max(float(by.limit.max()), float(low.max())) or 1.0  # any value is valid if all are zero
    missed = (np.clip(by.limit, low, high) - by.limit) / largest
    tried, known = (low > 0) | np.isfinite(high), np.isfinite(high)
    misfit = float(np.hypot(MISFIT, np.sqrt(np.mean(missed[tried] ** 2)) if tried.any() else 0.0))
    size = np.hypot(misfit, by.error / largest)
    if not known.any():
        return Forecast(by.limit, largest * size, misfit, by.low)
    apart = (dampings[:, None] - dampings[known]) / (SMOOTH * float(np.ptp(dampings) or 1.0))
    toward = np.exp(-0.5 * apart**2) * size[:, None] * size[known]
    noise = (high - low)[known] / largest / np.sqrt(12)
    gain = np.linalg.solve(toward[known] + np.diag(noise**2 + 1e-8), toward.T).T
    seen = missed[known]
    correction = np.clip(gain @ seen, min(seen.min(), 0.0), max(seen.max(), 0.0))
    limit = np.maximum(by.limit + largest * correction, 0.0)
    error = largest * np.sqrt(np.maximum(size**2 - (gain * toward).sum(axis=1), 1e-6))
    # Verdicts at other dampings do not exclude the device with the lowest limit here.
    low = np.clip(limit - (by.limit - by.low) * error / (largest * size), 0.0, by.low)
    return Forecast(limit, error, misfit, low)


def _largest(limit: Floats, ends: Floats, least: float) -> float:
    """Return the largest expected limit.

    A forecast at an untested damping counts only up to `HIGHER` times the largest limit at tested dampings. The result
    is at least ``least``.
    """
    low, high = ends.T
    expected = np.clip(np.where(np.isnan(limit), 0.5 * (low + np.where(np.isinf(high), low, high)), limit), low, high)
    tested = (low > 0) & np.isfinite(high)
    known = max(float(expected[tested].max(initial=0.0)), float(low.max()))
    largest = float(expected.max())
    return max(min(largest, HIGHER * known) if tested.any() else largest, known, least)


@dataclass(frozen=True)
class PlanTask:
    """Goal, largest limit, duration of a log [s], and the expectation at one damping.

    The expectation has the limit, its standard error, the lowest consistent limit, and the stiffness that counts as
    stable [N/m, Nm/rad]. ``decided`` states whether any trial has a verdict.
    """

    goal: PlanGoal
    largest: float
    trial_s: float
    limit: float
    error: float
    low: float
    stable: float
    decided: bool

    @property
    def half(self) -> float:
        """Wanted accuracy of a limit, as the largest acceptable error [N/m, Nm/rad]."""
        return self.goal.accuracy * self.largest

    @property
    def width(self) -> float:
        """Width of a bracket at which a damping is done [N/m, Nm/rad]."""
        return CLOSE * self.half


def _wall_to_try(
    damping: float, of: Bracket, own: TriedWalls, task: PlanTask, everywhere: Floats, *, holds: bool
) -> DampingState:
    goal, half, width = task.goal, task.half, task.width
    top = min(of.top, goal.highest, own.stiffness[own.force > goal.force].min(initial=inf))
    bold = goal.bold * task.stable if goal.bold < inf else 0.0
    far = top if np.isfinite(top) else max(2 * of.bottom, HIGHER * task.largest, width, bold)
    value = 0.5 * (of.bottom + far) if np.isnan(task.limit) else float(np.clip(task.limit, of.bottom, far))
    if of.again:
        return DampingState(damping, of, value, None, of.again[0], "contradiction")
    if of.high is not None and of.high - of.bottom <= width:
        if weak := doubtful_ends(own, of, task.trial_s, gentle=goal.gentle):
            return DampingState(damping, replace(of, again=weak), value, None, weak[0], "weak")
        return DampingState(damping, of, float(np.clip(value, of.high - half, of.bottom + half)))
    inside = own.select((own.stiffness > of.bottom) & (own.stiffness < of.top) & (own.verdict == "undecided"))
    blind, often = of.low is None and of.high is None, len(inside) >= VOTES
    if len(inside) and blind and (goal.bold < inf or len(inside) >= 2 * VOTES):
        if goal.bold == inf and task.decided and len(inside) >= 3 * VOTES:
            return DampingState(damping, of, None, note="undecided")
        return _longer(damping, of, inside)
    if often and of.low is None and len(inside) < 2 * VOTES:
        # Undecided walls are near the limit. Walls farther away are tried, because their verdicts bracket it.
        softer = APART * float(inside.stiffness.min())
        stiffer = blind and not goal.gentle and len(inside) == 2 * VOTES - 1
        lowest = task.low if task.low > goal.lowest else inf
        wall = float(inside.stiffness.max()) / APART if stiffer else min(softer, lowest)
        if wall > goal.lowest:
            most = max(_most(of, task, inside), goal.lowest)
            wall = min(wall, most)
            unstable = 0.5 if np.isnan(task.limit) else NormalDist().cdf((wall - task.limit) / max(task.error, 1e-300))
            return DampingState(damping, of, value, NextTrial(0, max(unstable, float(stiffer)), 1.0), wall, most=most)
    if often and (of.high is not None or goal.gentle):
        return DampingState(damping, of, None, note="undecided")
    if of.bottom >= 0.99 * top or top <= goal.lowest:
        return DampingState(damping, of, value, note="limit of the tests")
    answer = answers(own, of, everywhere, gentle=goal.gentle)
    if answer == "step of the rig":
        return DampingState(damping, of, value, note=answer)
    if goal.gentle and holds and of.low is not None and abs(task.limit - of.low) + task.error <= half:
        return DampingState(damping, of, value, note="from below")
    repeated = answer == "middle" and len(np.unique(own.stiffness)) > 1
    most = _most(of, task, inside, repeated=repeated)
    if most <= of.bottom or answer == "softer":
        return _softer(damping, of, own, value)
    limit, error = task.limit, task.error
    if goal.gentle and of.high is not None and limit - SAFE * error > of.high:
        # An unstable wall refutes the forecast, which would request neighbouring walls again and again.
        limit = error = np.nan
    edges = walls(max(of.bottom, goal.lowest), far, value, error, width)
    # No walls next to undecided walls are requested.
    kept = np.asarray((np.abs(edges[:, None] - inside.stiffness) > 0.25 * width).all(axis=1))
    kept[[0, -1]] = True
    edges = edges[kept]
    if edges[0] < most < edges[-1]:
        edges = np.unique(np.append(edges, most))
    chance = chances(edges, limit, error)
    split = best_split(edges, chance, width, PRICE if goal.gentle else 1.0, most)
    if split is None and len(inside):
        return (
            DampingState(damping, of, None, note="undecided") if of.high is not None else _longer(damping, of, inside)
        )
    if split is None:
        split = NextTrial(0, 0.5, 1.0)
        return DampingState(
            damping, of, value, split, min(max(0.5 * (of.bottom + far), goal.lowest), max(most, goal.lowest))
        )
    wall = float(edges[split.place])
    if answer == "middle":
        wall = 0.5 * (of.bottom + min(far, most))
    elif goal.gentle and not np.isnan(limit):
        safe = max(limit - SAFE * error, BOLD * limit)
        if safe > of.bottom + 0.2 * half:
            wall = safe if holds else min(wall, safe)
    wall = min(wall, max(most, goal.lowest))
    unstable = np.interp(wall, edges, np.concatenate([[0.0], np.cumsum(chance)])) / chance.sum()
    split = replace(split, unstable=float(unstable))
    return DampingState(damping, of, value, split, wall, most=most)


def _most(of: Bracket, task: PlanTask, inside: TriedWalls, *, repeated: bool = False) -> float:
    """Return the stiffest wall that may be tried now, or at most the bracket's lower end if none may be tried.

    The wall does not exceed the lowest limit consistent with the logs until one of three conditions is true. A wall
    near this limit was stable, or such a wall was undecided inside the bracket, or ``repeated`` shows that the rig sets
    no wall there. Then only a stiffer wall can close the bracket.
    """
    goal = task.goal
    most = goal.bold * task.stable
    low = min(task.low, task.limit - min(SAFE * task.error, task.half))
    near = max(of.bottom, 0.0 if goal.gentle else inside.stiffness.max(initial=0.0))
    if low > near + task.half and (goal.gentle or not repeated):
        return min(most, low)
    if goal.gentle and goal.few:
        return of.bottom if of.bottom > 0 else 0.5 * min(most, task.stable)
    return min(most, GENTLER * task.stable) if goal.gentle and goal.bold < inf else most


def _longer(damping: float, of: Bracket, inside: TriedWalls) -> DampingState:
    """Return the state that requests the softest undecided wall again, with a longer log."""
    return DampingState(damping, of, None, None, float(inside.stiffness.min()), "longer")


def _softer(damping: float, of: Bracket, own: TriedWalls, value: float) -> DampingState:
    """Return the state that requests a wall in the largest gap between the tried walls up to the stiffest stable wall.
    Its log helps to identify the device."""
    ends = np.unique(np.append(0.0, own.stiffness[own.stiffness <= of.bottom]))
    widest = int(np.argmax(np.diff(ends)))
    wall = 0.5 * float(ends[widest] + ends[widest + 1])
    return DampingState(damping, of, value, NextTrial(0, 0.0, 1.0), wall, "softer", of.bottom)


def doubtful_ends(own: TriedWalls, of: Bracket, trial_s: float, *, gentle: bool) -> tuple[float, ...]:
    """Return the ends of a bracket that were tried only once, and whose amplitude hardly changed over the log.

    A second trial of the wall must confirm the verdict. If the rig is to be protected, no unstable wall is tried twice,
    because judging a stable wall as unstable is safe.
    """
    ends = []
    for wall in (of.low,) if gentle else (of.low, of.high):
        trials = np.flatnonzero(own.stiffness == wall)
        if len(trials) == 1 and abs(own.growth[trials[0]]) * trial_s < WEAK:
            ends.append(float(own.stiffness[trials[0]]))
    return tuple(ends)


def answers(
    own: TriedWalls, of: Bracket, everywhere: Floats, *, gentle: bool = False
) -> Literal["", "middle", "softer", "step of the rig"]:
    """Return how a rig seems to respond to requests for walls inside a bracket.

    Parameters
    ----------
    own : TriedWalls
        Trials at the damping.
    of : Bracket
        Bracket at this damping. Its ends are walls of these trials.
    everywhere : float64, shape (n,)
        Stiffness of the walls tried at all dampings [N/m, Nm/rad].
    gentle : bool
        Whether requested walls stay below the limit. A rig that rounds down may then repeat an end of the bracket that
        is not its stiffest wall.

    Returns
    -------
    str
        Empty, or one of three words. ``softer``: all trials have the same wall, so a softer wall is requested to show
        whether the rig sets requested walls. ``step of the rig``: the rig sets no wall inside the bracket. ``middle``:
        an end was set repeatedly, but the rig may set other walls inside, so the middle is requested.

    Notes
    -----
    The rig sets no wall inside if two conditions are true: an end has at least `VOTES` trials more than the median of
    the other walls, and no two walls at any damping are closer than the width of the bracket. With 2 `VOTES` trials
    more, the second condition is not required. If the bracket has only one end, 2 `VOTES` trials more are required, and
    this end must be the stiffest (or softest) wall at all dampings.
    """
    own = own.select(own.verdict != "undecided")
    walls, place, count = np.unique(own.stiffness, return_inverse=True, return_counts=True)
    ends = np.isin(walls, [end for end in (of.low, of.high) if end is not None])
    grew, fell = (np.bincount(place, own.verdict == verdict, len(walls)) for verdict in ("unstable", "stable"))
    if not ends.any() or (grew * fell).any():
        return ""
    repeated = int(np.argmax(np.where(ends, count, 0)))
    more = count[repeated] - (np.median(np.delete(count, repeated)) if len(walls) > 1 else 1)
    if len(walls) == 1 and of.low is not None and count[0] % (2 * VOTES) == 0:
        return "softer"
    if more < VOTES:
        return ""
    if of.low is not None and of.high is not None:
        fits = bool(np.diff(np.unique(everywhere)).min() >= 0.99 * (of.high - of.low))
        return "step of the rig" if fits or more >= 2 * VOTES else "middle"
    last = gentle or walls[repeated] == (everywhere.max() if of.high is None else everywhere.min())
    return "step of the rig" if len(walls) > 1 and last and more >= 2 * VOTES else "middle"


def walls(bottom: float, far: float, value: float, error: float, width: float) -> Floats:
    """Return candidate walls between two ends, dense near the expected limit and near walls that close the bracket."""
    apart = 0.98 * width
    near = [bottom + apart, far - apart, value - 0.5 * apart, value + 0.5 * apart]
    about = [value + error * np.linspace(-2.5, 2.5, 21), value + apart * np.arange(-4, 5) / 4]
    inner = np.unique(np.concatenate([np.linspace(bottom, far, 9)[1:-1], near, *(about if np.isfinite(error) else [])]))
    # Walls closer together than this give no new information.
    kept = [bottom]
    for wall in inner[(inner > bottom) & (inner < far)]:
        if wall - kept[-1] > 0.05 * width:
            kept.append(float(wall))
    return np.array([*kept, far])


def chances(edges: Floats, limit: float, error: float) -> Floats:
    """Return the probability that the limit lies between edges, from the forecast and a uniform share `DOUBT`."""
    from scipy.special import ndtr

    anywhere = np.diff(edges) / (edges[-1] - edges[0])
    if np.isnan(limit):
        return np.asarray(anywhere)
    by = np.diff(ndtr((edges - limit) / error))
    return np.asarray((1 - DOUBT) * by / max(by.sum(), 1e-12) + DOUBT * anywhere)


def best_split(edges: Floats, chance: Floats, width: float, price: float = 1.0, most: float = inf) -> NextTrial | None:
    """Return the trial that shortens the search most.

    Parameters
    ----------
    edges : float64, shape (n + 1,)
        Candidate walls in increasing order. The first wall is known to be stable, and the last is known to be unstable.
    chance : float64, shape (n,)
        Probability that the limit lies between two edges, on any positive scale.
    width : float
        Largest stiffness difference between two adjacent edges at which the search ends once the limit is known to lie
        between them.
    price : float
        Number of stable trials that cost as much as an unstable trial. If the price is above 1, the search approaches
        the limit from below.
    most : float
        Stiffest wall of this trial. Later trials may be stiffer.

    Returns
    -------
    NextTrial or None
        The trial, or None if the search is finished.

    Notes
    -----
    V(i, j) is the lowest cost of finding a limit between edges i and j, weighted by its probability. The cost is 0 if
    these edges are within ``width``. Otherwise, it is the minimum over k of the price of the trial plus V(i, k) + V(k,
    j). These are optimal search trees (Knuth 1971) with prices. The recursion takes about n^3/6 operations, in n steps
    of numpy.

    Examples
    --------
    >>> best_split(np.arange(5.0), np.ones(4), 1.0)
    NextTrial(place=2, unstable=0.5, trials=2.0)
    >>> best_split(np.arange(5.0), np.array([0.01, 0.01, 0.01, 1.0]), 1.0).place
    3
    """
    n = len(chance)
    total = np.concatenate([[0.0], np.cumsum(chance)])
    if edges[-1] - edges[0] <= width or total[-1] <= 0:
        return None
    cost, trials = np.zeros((n + 1, n + 1)), np.zeros((n + 1, n + 1))
    place = np.zeros((n + 1, n + 1), dtype=np.int64)
    for span in range(2, n + 1):
        i = np.flatnonzero(edges[span:] - edges[:-span] > width)
        j, inner = i + span, i[:, None] + np.arange(1, span)
        paid = (total[j] - total[i])[:, None] + (price - 1) * (total[inner] - total[i][:, None])
        options = cost[i[:, None], inner] + cost[inner, j[:, None]] + paid
        best = np.argmin(options, axis=1)
        k = i + 1 + best
        place[i, j], cost[i, j] = k, options[np.arange(len(i)), best]
        trials[i, j] = trials[i, k] + trials[k, j] + total[j] - total[i]
    allowed = np.flatnonzero(edges[1:n] <= most) + 1
    if not len(allowed):  # there is no edge between the two ends, or no such edge is permitted
        return None
    first = min(int(place[0, n]), int(allowed[-1]))
    needed = trials[0, first] + trials[first, n] + total[n]
    return NextTrial(first, float(total[first] / total[n]), float(needed / total[n]))


def order(columns: tuple[DampingState, ...]) -> list[int]:
    """Return the indices of dampings that are not done, in the order in which to try them.

    Contradictions come first, then started dampings (the nearest to completion first), then the dampings farthest from
    all tried dampings, which give most information about the device. Undecided walls that need longer logs are last,
    unless no trial has a verdict yet.
    """
    left = [i for i, column in enumerate(columns) if column.wall is not None]
    begun = sorted(
        (i for i in left if columns[i].bracket.trials and columns[i].note != "longer"),
        key=lambda i: (not columns[i].bracket.again, columns[i].left),
    )
    longer = [i for i in left if columns[i].note == "longer"]
    new, last = [i for i in left if i not in begun + longer], len(columns) - 1
    known = [i for i in range(len(columns)) if i not in new]
    ordered: list[int] = []
    while new:
        pick = max(new, key=lambda i: (min([abs(i - j) for j in known] + [i + 1, last - i + 1]), -abs(i - 0.5 * last)))
        new.remove(pick)
        known.append(pick)
        ordered.append(pick)
    decided = any(column.bracket.low is not None or column.bracket.high is not None for column in columns)
    return [*begun, *ordered, *longer] if decided else [*begun, *longer, *ordered]
