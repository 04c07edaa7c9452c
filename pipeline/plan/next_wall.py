"""Goal `boundary`: walls to try until the limit at each damping lies between two verdicts that are close enough."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import inf

import numpy as np
from scipy.special import ndtr

from pipeline.base.errors import ParameterError
from pipeline.records.batch import Booleans, Floats

VOTES = 3
"""Trials of one wall after which a contradiction is no chance: most of them decide. As many undecided ones, costs of a
wall, or trials of an end in place of a wall inside a bracket are enough."""

MISFIT = 0.007
"""Error of foretold limits, relative to the largest, before any is known: verdicts call what grows unseen stable."""

SMOOTH = 0.15
"""Length over which what a device misses changes, relative to the range of dampings."""

DOUBT = 0.08
"""Chance that the limit lies anywhere in its bracket whatever the device says."""

PRICE = 6.0
"""What an unstable trial costs, in stable ones, where a rig is to be spared."""

SAFE, BOLD = 1.5, 0.3
"""Where a rig is to be spared: standard errors by which a wall stays below the expected limit; but no softer than this
share of it, else nothing would be learnt, and no stiffer at first."""

WEAK = 0.08
"""Change of the amplitude over a log, as logarithm, below which a verdict is asked for twice: noise and friction may
have made it."""

CLOSE = 1.8
"""Width of a bracket that is narrow enough, in wanted accuracies: a little less than twice, since a verdict next to the
limit may be wrong, and the largest limit is not known to the last."""

START = 0.5
"""Stiffest first wall, relative to the limit that a device file predicts: a file may state half the true delay."""

HIGHER = 1.3
"""How far above the largest limit known a limit is looked for, relative to it."""


@dataclass(frozen=True, eq=False)
class Tried:
    """Trials so far, a row each.

    Parameters
    ----------
    stiffness, damping : float64, shape (n,)
        K > 0 [N/m, Nm/rad] and B [Ns/m, Nms/rad].
    verdict : array of str, shape (n,)
        ``stable``, ``unstable`` or ``undecided``, as `measured.signal.verdict.judge` says.
    growth : float64, shape (n,)
        Growth rate of the slowest visible mode [1/s], NaN where it is not told.
    force : float64, shape (n,)
        Largest absolute command [N, Nm], NaN where it does not matter.
    cost : float64, shape (n,)
        Cost by the criterion of the goal, NaN where there is none.
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
            raise ParameterError(f"trials with columns of {sorted(lengths)} rows: expected one value each per trial.")

    def __len__(self) -> int:
        return len(self.stiffness)

    def select(self, rows: Booleans) -> Tried:
        """Return some of the trials."""
        return Tried(**{name: column[rows] for name, column in vars(self).items()})


@dataclass(frozen=True)
class Bracket:
    """Where the limit of one damping lies by verdicts.

    Parameters
    ----------
    low, high : float or None
        Stiffest stable and softest unstable wall that enclose it [N/m, Nm/rad]; None where none was tried.
    again : tuple of float
        Stiffness of walls whose verdicts contradict others and that must be tried again, those of fewest trials first.
    lasting : bool
        Whether stable walls lie above unstable ones although each was tried `VOTES` times.
    trials : int
    """

    low: float | None = None
    high: float | None = None
    again: tuple[float, ...] = ()
    lasting: bool = False
    trials: int = 0

    @property
    def bottom(self) -> float:
        """Lower end, 0 where no wall was stable: without stiffness there is no wall."""
        return 0.0 if self.low is None else self.low

    @property
    def top(self) -> float:
        """Upper end, infinite where no wall was unstable."""
        return inf if self.high is None else self.high


def bracket(stiffness: Floats, verdict: np.ndarray, width: float = 0.0) -> Bracket:
    """Return where the limit of one damping lies.

    Parameters
    ----------
    stiffness : float64, shape (n,)
    verdict : array of str, shape (n,)
    width : float
        Contradictions within this range of K [N/m, Nm/rad] are the chance of the limit itself, and no reason to repeat.

    Notes
    -----
    A wall counts as what most of its trials say, and not at all where they are even or undecided. Where a stable wall
    lies above an unstable one, low and high enclose both, until each of them was tried `VOTES` times. What contradicts
    itself then has several limits (a mode, friction), of which the lowest counts.

    Examples
    --------
    >>> bracket(np.array([1000.0, 2000.0, 3000.0]), np.array(["stable", "undecided", "unstable"]))
    Bracket(low=1000.0, high=3000.0, again=(), lasting=False, trials=3)
    >>> bracket(np.array([1000.0, 2000.0, 3000.0]), np.array(["stable", "unstable", "stable"])).again
    (2000.0, 3000.0)
    """
    walls, column = np.unique(stiffness, return_inverse=True)
    votes = np.zeros(len(walls))
    tried = np.zeros(len(walls), dtype=np.int64)
    np.add.at(votes, column, np.where(verdict == "unstable", 1.0, np.where(verdict == "stable", -1.0, 0.0)))
    np.add.at(tried, column, 1)
    stable, unstable = walls[votes < 0], walls[votes > 0]
    low, high = stable.max(initial=-inf), unstable.min(initial=inf)
    again: tuple[float, ...] = ()
    lasting = False
    if low > high:
        doubtful = (walls >= high) & (walls <= low) & (tried < VOTES)
        if low - high > width and doubtful.any():
            order = np.flatnonzero(doubtful)[np.argsort(tried[doubtful], kind="stable")]
            again = tuple(walls[order].tolist())
        lasting = low - high > width and not again
        if lasting:
            low = stable[stable < high].max(initial=-inf)
        else:
            low, high = stable[stable < high].max(initial=-inf), unstable[unstable > low].min(initial=inf)
    return Bracket(
        low=float(low) if np.isfinite(low) else None,
        high=float(high) if np.isfinite(high) else None,
        again=again,
        lasting=lasting,
        trials=len(stiffness),
    )


@dataclass(frozen=True)
class Aim:
    """What is to be known, and within what limits.

    Parameters
    ----------
    dampings : tuple of float
        B at which limits are wanted [Ns/m, Nms/rad], rising.
    accuracy : float
        Wanted largest error of a limit, relative to the largest limit.
    gentle : bool
        Whether unstable trials are avoided.
    lowest, highest : float
        Smallest and largest K that may be tried [N/m, Nm/rad].
    force : float
        Largest command that a trial may have shown [N, Nm]; no stiffer wall is tried at its damping.
    """

    dampings: tuple[float, ...]
    accuracy: float = 0.02
    gentle: bool = False
    lowest: float = 0.0
    highest: float = inf
    force: float = inf

    @property
    def start(self) -> float:
        """Stiffest first wall, relative to the foretold limit."""
        return BOLD if self.gentle else START


@dataclass(frozen=True, eq=False)
class Forecast:
    """Limit at each damping before it is measured: value and standard error [N/m, Nm/rad], both of shape (n,).

    NaN where nothing foretells it. ``misfit`` is the error, relative to the largest limit, where limits are known.
    """

    limit: Floats
    error: Floats
    misfit: float = MISFIT

    @classmethod
    def none(cls, count: int) -> Forecast:
        """Return that nothing foretells limits."""
        return cls(np.full(count, np.nan), np.full(count, np.nan), inf)


@dataclass(frozen=True)
class Split:
    """Best wall to try: its place among the edges, the chance that it is unstable, and the trials expected in all."""

    place: int
    unstable: float
    trials: float


@dataclass(frozen=True)
class Column:
    """One damping: what verdicts and forecast say of its limit, and the wall to try; None where it is done.

    ``estimate`` is None where nothing tells it, ``split`` None where a wall is tried again.
    """

    damping: float
    bracket: Bracket
    estimate: float | None
    split: Split | None = None
    wall: float | None = None
    note: str = ""

    @property
    def left(self) -> float:
        """Trials that are expected until it is done."""
        return self.split.trials if self.split else float(self.wall is not None)


@dataclass(frozen=True, eq=False)
class State:
    """All dampings, the largest limit, and the forecast that they rest on."""

    columns: tuple[Column, ...]
    largest: float
    forecast: Forecast

    @property
    def done(self) -> bool:
        """Whether nothing is left to try."""
        return all(column.wall is None for column in self.columns)


def state(tried: Tried, aim: Aim, by: Forecast | None = None, trial_s: float = inf) -> State:
    """Return what is known and left to do at each damping.

    Parameters
    ----------
    tried : Tried
        Trials at any damping with K > 0.
    aim : Aim
    by : Forecast, optional
        Limits by the device that the logs show, else by its file; without one verdicts are bisected.
    trial_s : float
        How long a log goes on after its step [s].
    """
    rows = [tried.select(tried.damping == b) for b in aim.dampings]
    found = [bracket(own.stiffness, own.verdict) for own in rows]
    ends = np.array([(of.bottom, of.top) for of in found])
    ahead = corrected(by, ends, np.array(aim.dampings)) if by is not None else Forecast.none(len(found))
    largest = _largest(ahead.limit, ends, aim.accuracy * float(tried.stiffness.max(initial=0.0)))
    width = CLOSE * aim.accuracy * largest
    columns = []
    for i, own in enumerate(rows):
        of = bracket(own.stiffness, own.verdict, width)
        task = Task(aim, largest, trial_s, float(ahead.limit[i]), float(ahead.error[i]))
        column = _wall_to_try(aim.dampings[i], of, own, task, holds=ahead.misfit <= aim.accuracy)
        if len(tried) and not len(own) and task.limit <= 0 and task.error <= width:
            # a verdict there changes no map: it is known closely enough that nothing is stable
            column = Column(aim.dampings[i], of, 0.0, note="no stable wall")
        if not len(tried) and column.wall is not None:
            column = replace(column, wall=min(column.wall, aim.start * max(task.limit, task.half)))
        columns.append(column)
    return State(tuple(columns), largest, ahead)


def corrected(by: Forecast, ends: Floats, dampings: Floats) -> Forecast:
    """Return a forecast with what it missed so far.

    What it misses at dampings with both ends of a bracket, shape (n, 2), is carried on to their neighbours as a random
    function of the damping (kriging) with the misfit as standard deviation and `SMOOTH` of the range as length.
    """
    low, high = ends.T
    largest = max(float(by.limit.max()), float(low.max())) or 1.0  # any size where all are none
    missed = (np.clip(by.limit, low, high) - by.limit) / largest
    tried, known = (low > 0) | np.isfinite(high), np.isfinite(high)
    misfit = float(np.hypot(MISFIT, np.sqrt(np.mean(missed[tried] ** 2)) if tried.any() else 0.0))
    size = np.hypot(misfit, by.error / largest)
    if not known.any():
        return Forecast(by.limit, largest * size, misfit)
    apart = (dampings[:, None] - dampings[known]) / (SMOOTH * float(np.ptp(dampings) or 1.0))
    toward = np.exp(-0.5 * apart**2) * size[:, None] * size[known]
    noise = (high - low)[known] / largest / np.sqrt(12)
    gain = np.linalg.solve(toward[known] + np.diag(noise**2 + 1e-8), toward.T).T
    limit = np.maximum(by.limit + largest * (gain @ missed[known]), 0.0)
    return Forecast(limit, largest * np.sqrt(np.maximum(size**2 - (gain * toward).sum(axis=1), 1e-6)), misfit)


def _largest(limit: Floats, ends: Floats, least: float) -> float:
    """Return the largest limit, or the least that is looked for: of dampings that were tried, or a little more where
    the forecast says so of others."""
    low, high = ends.T
    expected = np.clip(np.where(np.isnan(limit), 0.5 * (low + np.where(np.isinf(high), low, high)), limit), low, high)
    tested = (low > 0) & np.isfinite(high)
    known = max(float(expected[tested].max(initial=0.0)), float(low.max()))
    largest = float(expected.max())
    return max(min(largest, HIGHER * known) if tested.any() else largest, known, least)


@dataclass(frozen=True)
class Task:
    """What is to be known, the largest limit, how long a log goes on [s], and what is expected of one damping: limit
    and standard error [N/m, Nm/rad]."""

    aim: Aim
    largest: float
    trial_s: float
    limit: float
    error: float

    @property
    def half(self) -> float:
        """Wanted largest error of a limit [N/m, Nm/rad]."""
        return self.aim.accuracy * self.largest

    @property
    def width(self) -> float:
        """Width of a bracket at which a damping is done [N/m, Nm/rad]."""
        return CLOSE * self.half


def _wall_to_try(damping: float, of: Bracket, own: Tried, task: Task, *, holds: bool) -> Column:
    aim, half, width = task.aim, task.half, task.width
    top = min(of.top, aim.highest, own.stiffness[own.force > aim.force].min(initial=inf))
    far = top if np.isfinite(top) else max(2 * of.bottom, HIGHER * task.largest, width)
    value = 0.5 * (of.bottom + far) if np.isnan(task.limit) else float(np.clip(task.limit, of.bottom, far))
    if of.again:
        return Column(damping, of, value, None, of.again[0], "contradiction")
    if of.high is not None and of.high - of.bottom <= width:
        if weak := doubtful_ends(own, of, task.trial_s, gentle=aim.gentle):
            return Column(damping, replace(of, again=weak), value, None, weak[0], "weak")
        return Column(damping, of, float(np.clip(value, of.high - half, of.bottom + half)))
    inside = own.select((own.stiffness > of.bottom) & (own.stiffness < of.top) & (own.verdict == "undecided"))
    if len(inside) >= VOTES:
        return Column(damping, of, None, note="undecided")
    if of.bottom >= 0.99 * top or top <= aim.lowest:
        return Column(damping, of, value, note="limit of the tests")
    if repeats(own, of):
        return Column(damping, of, value, note="step of the rig")
    if aim.gentle and holds and of.low is not None and abs(task.limit - of.low) + task.error <= half:
        return Column(damping, of, value, note="from below")
    edges = walls(max(of.bottom, aim.lowest), far, value, task.error, width)
    # no walls next to undecided ones
    kept = np.asarray((np.abs(edges[:, None] - inside.stiffness) > 0.25 * width).all(axis=1))
    kept[[0, -1]] = True
    edges = edges[kept]
    split = best_split(edges, chances(edges, task.limit, task.error), width, PRICE if aim.gentle else 1.0)
    if split is None:
        return Column(damping, of, value, note="step of the rig")
    wall = float(edges[split.place])
    if aim.gentle and not np.isnan(task.limit):
        safe = max(task.limit - SAFE * task.error, BOLD * task.limit)
        if safe > of.bottom + 0.2 * half:
            wall = safe if holds else min(wall, safe)
    return Column(damping, of, value, split, wall)


def doubtful_ends(own: Tried, of: Bracket, trial_s: float, *, gentle: bool) -> tuple[float, ...]:
    """Return the ends of a bracket that were tried once, with a growth that hardly changes the motion over the log.

    A second trial of the wall must say the same. Where a rig is to be spared no unstable wall is tried twice, since to
    call a stable one unstable is on the safe side.
    """
    ends = []
    for wall in (of.low,) if gentle else (of.low, of.high):
        trials = np.flatnonzero(own.stiffness == wall)
        if len(trials) == 1 and abs(own.growth[trials[0]]) * trial_s < WEAK:
            ends.append(float(own.stiffness[trials[0]]))
    return tuple(ends)


def repeats(own: Tried, of: Bracket) -> bool:
    """Return whether a rig answers by an end of the bracket each time: it sets no wall inside.

    An end is then tried `VOTES` times more than walls usually are, though no verdict contradicts another.
    """
    walls, place, count = np.unique(own.stiffness, return_inverse=True, return_counts=True)
    grew, fell = (np.bincount(place, own.verdict == said, len(walls)) for said in ("unstable", "stable"))
    ends = np.isin(walls, [end for end in (of.low, of.high) if end is not None])
    usual = np.median(count[~ends]) if not ends.all() else 1.0
    return bool(count[ends].max(initial=0) >= usual + VOTES and not (grew * fell).any())


def walls(bottom: float, far: float, value: float, error: float, width: float) -> Floats:
    """Return walls that may be tried between two ends, dense where the limit is expected and closing trials lie."""
    apart = 0.98 * width
    near = [bottom + apart, far - apart, value - 0.5 * apart, value + 0.5 * apart]
    about = [value + error * np.linspace(-2.5, 2.5, 21), value + apart * np.arange(-4, 5) / 4]
    inner = np.unique(np.concatenate([np.linspace(bottom, far, 9)[1:-1], near, *(about if np.isfinite(error) else [])]))
    # walls nearer than this tell nothing new
    kept = [bottom]
    for wall in inner[(inner > bottom) & (inner < far)]:
        if wall - kept[-1] > 0.05 * width:
            kept.append(float(wall))
    return np.array([*kept, far])


def chances(edges: Floats, limit: float, error: float) -> Floats:
    """Return the chance that the limit lies between two edges: by the forecast, and with `DOUBT` anywhere."""
    anywhere = np.diff(edges) / (edges[-1] - edges[0])
    if np.isnan(limit):
        return np.asarray(anywhere)
    by = np.diff(ndtr((edges - limit) / error))
    return np.asarray((1 - DOUBT) * by / max(by.sum(), 1e-12) + DOUBT * anywhere)


def best_split(edges: Floats, chance: Floats, width: float, price: float = 1.0) -> Split | None:
    """Return where a trial shortens the search most.

    Parameters
    ----------
    edges : float64, shape (n + 1,)
        Walls that may be tried, rising; the first is known to be stable, the last to be unstable.
    chance : float64, shape (n,)
        Chance that the limit lies between two edges; any positive scale.
    width : float
        The search ends when the limit is known to lie between walls no further apart.
    price : float
        What an unstable trial costs, in stable ones: above 1 the limit is approached from below.

    Returns
    -------
    Split or None
        None where nothing is left to search.

    Notes
    -----
    Least cost V(i, j) of a limit between edges i and j, weighted by its chance: 0 where they are within ``width``,
    else the least over k of the trial's own price and V(i, k) + V(k, j). As optimal search trees (Knuth 1971), with
    prices. About n^3/6 operations, in n steps of numpy.

    Examples
    --------
    >>> best_split(np.arange(5.0), np.ones(4), 1.0)
    Split(place=2, unstable=0.5, trials=2.0)
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
    first = int(place[0, n])
    if first == 0:  # two edges, too far apart
        return None
    return Split(first, float(total[first] / total[n]), float(trials[0, n] / total[n]))


def order(columns: tuple[Column, ...]) -> list[int]:
    """Return places of dampings that are left, in the order in which to try them.

    Contradictions first; then dampings that were begun, the nearest to its end first; then those farthest from all
    that were tried, where the device is learnt best.
    """
    left = [i for i, column in enumerate(columns) if column.wall is not None]
    begun = sorted(
        (i for i in left if columns[i].bracket.trials), key=lambda i: (not columns[i].bracket.again, columns[i].left)
    )
    new, last = [i for i in left if i not in begun], len(columns) - 1
    known = [i for i in range(len(columns)) if i not in new]
    ordered: list[int] = []
    while new:
        pick = max(new, key=lambda i: (min([abs(i - j) for j in known] + [i + 1, last - i + 1]), -abs(i - 0.5 * last)))
        new.remove(pick)
        known.append(pick)
        ordered.append(pick)
    return begun + ordered
