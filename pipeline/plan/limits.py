"""Goal `boundary`: walls to try until the limit at each damping lies between two verdicts that are close enough."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import erf, inf, sqrt

import numpy as np

from pipeline.plan.evidence import Evidence, evidence, informative, told_by_rates
from pipeline.plan.fitted import Fitted
from pipeline.plan.forecast import INADEQUATE, Forecast, forecast, found_misfit
from pipeline.plan.model import Range, foretold
from pipeline.plan.requests import NOTHING_ASKED, Answers, Requests
from pipeline.plan.split import Split, best_split
from pipeline.plan.verdicts import Bracket, Tried, bracket
from pipeline.records.batch import Booleans, Floats

DOUBT = 0.08
"""Chance that the limit lies anywhere in its bracket whatever the model says."""

GENTLE_PRICE = 6.0
"""What an unstable trial costs, in stable ones, where a rig is to be spared."""

WEAK = 0.08
"""Change of the amplitude over a log, as logarithm, below which a verdict is asked for twice."""

NEAR, SAFE, BOLD = 0.4, 1.5, 0.3
"""Where a rig is to be spared: how far below the expected limit a wall stays, in wanted accuracies and in standard
errors; but no farther than this share of it, else nothing would be learnt."""

CLOSE = 1.8
"""Width of a bracket that is narrow enough, in wanted accuracies: a little less than twice, since a verdict next to the
limit may be wrong, and the largest limit is not known to the last."""

ASIDE = 0.25
"""Distance from an undecided wall, in widths of a bracket, from which on another one may tell more."""

BEGIN, STAIRS = 0.95, (0.8, 0.92)
"""Where a rig is to be spared: first wall of a damping, relative to the limit that a loop foretells which explains the
logs; its decay and that of a stiffer one then make a line. And the first walls where no loop explains them."""

UNTOLD = 3
"""Undecided trials between the ends of a bracket after which verdicts do not tell the limit."""

LEAST = 0.01
"""Largest limit below which no stable wall is looked for any more, relative to that expected at first."""

START, GENTLE_START = 0.5, 0.3
"""Stiffest first wall, relative to the limit that a device file predicts: a file may state half the true delay."""

HIGHER = 1.3
"""How far above the largest limit known a limit is looked for, relative to it."""


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
    area : bool
        Whether the accuracy is that of the area under the limits, relative to it.
    """

    dampings: tuple[float, ...]
    accuracy: float = 0.02
    gentle: bool = False
    lowest: float = 0.0
    highest: float = inf
    force: float = inf
    area: bool = False


@dataclass(frozen=True)
class Column:
    """One damping: what verdicts and model say of its limit, and what is left to do.

    ``estimate`` is None where nothing tells it; ``split`` None where the damping is done.
    ``nothing`` where no stable wall is expected: such dampings wait until the largest limit is known.
    """

    damping: float
    bracket: Bracket
    estimate: float | None
    split: Split | None
    wall: float | None = None
    note: str = ""
    nothing: bool = False


@dataclass(frozen=True)
class Expected:
    """What is expected of one damping: limit and standard error, and whether a loop that explains the logs says so.

    ``adequate`` is whether it may propose; ``beyond`` whether softer dampings have shown that the region has ended.
    """

    damping: float
    limit: float
    error: float
    adequate: bool
    explains: bool = False
    beyond: bool = False


@dataclass(frozen=True)
class Task:
    """What is to be known of each damping, how long a log goes on after its step [s], and the largest limit."""

    aim: Aim
    trial_s: float
    largest: float

    @property
    def half(self) -> float:
        """Wanted largest error of a limit [N/m, Nm/rad]."""
        return self.aim.accuracy * self.largest

    @property
    def width(self) -> float:
        """Width of a bracket at which a damping is done [N/m, Nm/rad]."""
        return CLOSE * self.aim.accuracy * self.largest


@dataclass(frozen=True, eq=False)
class State:
    """All dampings, and the forecast that they rest on."""

    columns: tuple[Column, ...]
    largest: float
    forecast: Forecast

    @property
    def done(self) -> bool:
        """Whether nothing is left to try."""
        return all(column.wall is None for column in self.columns)

    @property
    def trials_left(self) -> float:
        """Trials that are expected until all is done."""
        return sum(_trials_left(column) for column in self.columns)


def state(
    tried: Tried,
    aim: Aim,
    around: Range,
    start: Forecast | None = None,
    device: Fitted | None = None,
    requests: Requests = NOTHING_ASKED,
) -> State:
    """Return what is known and left to do at each damping.

    Parameters
    ----------
    tried : Tried
        Trials at any damping with K > 0.
    aim : Aim
    around : Range
        Where limits are looked for before trials tell.
    start : Forecast, optional
        What is known before any trial; used where there is none.
    device : Fitted, optional
        The device that the logs show.
    requests : Requests
        What was asked for so far.
    """
    levels = np.unique(np.concatenate([tried.damping, aim.dampings]))
    rows = {float(b): tried.select(tried.damping == b) for b in levels}
    found = {b: bracket(own.stiffness, own.verdict) for b, own in rows.items()}
    seen = evidence(tried, levels, [(found[float(b)].bottom, found[float(b)].top) for b in levels])
    wanted = np.array(aim.dampings)
    ahead = start if start is not None and not len(tried) else likeliest(around, seen, wanted, device)
    ends = np.array([(found[b].bottom, min(found[b].top, aim.highest)) for b in aim.dampings])
    value, error = beyond_zero(ahead, wanted, ends, aim)
    largest = _largest(np.clip(value, ends[:, 0], ends[:, 1]), ends, around)
    if aim.area:
        # limits that are known to the accuracy of the mean one make an area that is
        mean = float(np.trapezoid(np.clip(value, ends[:, 0], ends[:, 1]), wanted)) / max(float(np.ptp(wanted)), 1e-300)
        largest = min(max(mean, LEAST * largest), largest) if len(wanted) > 1 else largest
    task = Task(aim, around.trial_s, largest)
    found |= {b: bracket(rows[b].stiffness, rows[b].verdict, task.width) for b in aim.dampings}
    ended = region_ended(wanted, ends)
    expected = [
        Expected(b, float(v), float(e), ahead.adequate, ahead.explains, bool(after))
        for b, v, e, after in zip(aim.dampings, value, error, ended, strict=True)
    ]
    by_rig = requests.by_damping([found[b] for b in aim.dampings], aim.dampings, tried.stiffness)
    columns = tuple(
        _column(found[told.damping], rows[told.damping], told, task, rig)
        for told, rig in zip(expected, by_rig, strict=True)
    )
    if start is not None and not len(tried):
        share = GENTLE_START if aim.gentle else START
        columns = tuple(
            replace(c, wall=min(c.wall, share * max(v, aim.accuracy * largest))) if c.wall is not None else c
            for c, v in zip(columns, value.tolist(), strict=True)
        )
    return State(columns, largest, ahead)


def likeliest(around: Range, seen: Evidence, dampings: Floats, device: Fitted | None) -> Forecast:
    """Return the forecast of the device that the logs show, or of a set of loops where that misses less."""
    by = None if device is None else device.foretold(dampings, seen.damping)
    if by is not None and by.largest > 0:
        by = replace(by, misfit=found_misfit(by, seen))
        if by.explains and by.misfit < INADEQUATE:
            return forecast(by, seen, dampings)
    loops = foretold(around, seen, dampings)
    better = by is not None and by.largest > 0 and by.misfit <= loops.misfit
    return forecast(by if by is not None and better else loops, seen, dampings)


def beyond_zero(ahead: Forecast, dampings: Floats, ends: Floats, aim: Aim) -> tuple[Floats, Floats]:
    """Return the forecast with a limit of zero beyond dampings whose own limit is surely next to zero.

    Above the damping of the largest limit, a region that has ended does not begin again, but for rare devices.
    """
    tiny = aim.accuracy * max(float(ahead.limit.max()), float(ends[:, 0].max()))
    value, error = ahead.limit.copy(), ahead.error.copy()
    peak = dampings[np.argmax(np.where(ends[:, 0] > 0, ends[:, 0], -1.0))] if (ends[:, 0] > 0).any() else 0.0
    gone = (ends[:, 0] == 0) & (value + error < tiny) & np.isfinite(ends[:, 1]) & (dampings > peak)
    if gone.any():
        after = (dampings > dampings[gone].min()) & (ends[:, 0] == 0)
        value[after], error[after] = 0.0, tiny
    return value, error


def _largest(limit: Floats, ends: Floats, around: Range) -> float:
    """Return the largest limit: of dampings that were tried, or a little more where the model says so of others."""
    tested = (ends[:, 0] > 0) & np.isfinite(ends[:, 1])
    if not tested.any():
        least = LEAST * around.stiffness
        return float(max(min(around.stiffness, ends[:, 1].max()), ends[:, 0].max(), least))
    known = max(float(limit[tested].max()), float(ends[:, 0].max()))
    return float(np.clip(limit.max(), known, HIGHER * known))


def region_ended(dampings: Floats, ends: Floats) -> Booleans:
    """Return which dampings lie beyond one, itself beyond that of a stable wall, where no wall was stable."""
    none = (ends[:, 0] == 0) & np.isfinite(ends[:, 1])
    stable = dampings[ends[:, 0] > 0]
    none &= dampings > stable.max(initial=-inf) if len(stable) else False
    return np.asarray((dampings > dampings[none].min(initial=inf)) & (ends[:, 0] == 0))


def _column(of: Bracket, own: Tried, told: Expected, task: Task, rig: Answers) -> Column:
    damping, value, aim = told.damping, told.limit, task.aim
    top = min(of.top, aim.highest, own.stiffness[own.force > aim.force].min(initial=inf))
    width, half = task.width, task.half
    of = replace(of, again=tuple(wall for wall in of.again if rig.sets(wall)))
    if of.again:
        return Column(damping, of, float(np.clip(value, of.bottom, top)), None, of.again[0], "contradiction")
    if of.high is not None and of.high - of.bottom <= width:
        doubted = doubtful_ends(own, of, task.trial_s, gentle=aim.gentle, explains=told.explains)
        doubted = tuple(wall for wall in doubted if rig.sets(wall))
        if doubted:
            again = replace(of, again=doubted)
            return Column(damping, again, float(np.clip(value, of.bottom, top)), None, doubted[0], "weak")
        return Column(damping, of, float(np.clip(value, of.high - half, of.bottom + half)), None)
    open_walls = undecided(own, of)
    if len(open_walls) >= UNTOLD:
        return Column(damping, of, None, None, None, "undecided")
    estimate = float(np.clip(value, of.bottom, of.top))
    if of.bottom >= 0.99 * top or top <= aim.lowest:
        return Column(damping, of, estimate, None, None, "limit of the tests")
    if rig.ends(of):
        return Column(damping, of, estimate, None, None, "step of the rig")
    if aim.gentle and told.explains and told.beyond and value < half:
        return Column(damping, of, estimate, None, None, "beyond the region")
    if aim.gentle and from_below(own, of, half, told):
        return Column(damping, of, estimate, None, None, "from below")
    edges = walls(max(of.bottom, aim.lowest), top, estimate, told.error, width, task.largest)
    # neither walls next to undecided ones, nor what a rig that rounds made another wall of
    away = ASIDE * width
    rounded = rig.rounded(of, half, away)
    for low, high in [(wall - away, wall + away) for wall in open_walls] + rounded:
        edges = edges[(edges < low) | (edges > high) | (edges == edges[0]) | (edges == edges[-1])]
    chance = chances(edges, value, told.error if told.adequate else inf)
    split = best_split(edges, chance, width, GENTLE_PRICE if aim.gentle else 1.0)
    if split is None:
        return Column(damping, of, estimate, None, None, "step of the rig" if len(rig.missed) else "")
    wall = float(edges[split.place])
    if aim.gentle:
        safe = _safe(own, told, half)
        free = not any(low <= safe <= high for low, high in rounded)
        wall = min(wall, safe) if free and safe > of.bottom + 0.2 * half else wall
    return Column(damping, of, estimate, split, wall, nothing=of.bottom == 0 and value < half)


def undecided(own: Tried, of: Bracket) -> Floats:
    """Return the walls between the ends of a bracket whose trials were undecided, one for each trial."""
    inside = (own.stiffness > of.bottom) & (own.stiffness < of.top)
    return np.asarray(own.stiffness[inside & (own.verdict == "undecided")])


def _safe(own: Tried, told: Expected, half: float) -> float:
    """Return the stiffest wall that spares the rig: one whose decay tells something, then one close to the limit."""
    stairs = (BEGIN - half / max(told.limit, half),) if told.explains else STAIRS
    climbed = int((own.verdict == "stable").sum() if not told.explains else np.isfinite(informative(own)).sum())
    if climbed < len(stairs):
        return stairs[climbed] * told.limit
    return max(told.limit - max(NEAR * half, SAFE * told.error), BOLD * told.limit)


def doubtful_ends(own: Tried, of: Bracket, trial_s: float, *, gentle: bool, explains: bool) -> tuple[float, ...]:
    """Return the ends of a bracket that were tried once, with a growth that hardly changes the motion over the log.

    Noise and friction may have made such a verdict; a second trial of the wall must say the same. Where a rig is to be
    spared no unstable wall is tried twice, since to call a stable one unstable is on the safe side; but the stable one
    is wherever no loop explains the logs.
    """
    ends = []
    for wall in (of.low,) if gentle else (of.low, of.high):
        trials = np.flatnonzero(own.stiffness == wall)
        weak = len(trials) == 1 and abs(own.growth[trials[0]]) * trial_s < WEAK
        if weak or (gentle and not explains and len(trials) == 1):
            ends.append(float(own.stiffness[trials[0]]))
    return tuple(ends)


def from_below(own: Tried, of: Bracket, half: float, told: Expected) -> bool:
    """Whether the decay of stable trials at one damping tells its limit without an unstable one.

    Two growth rates must tell it by the line through them, the loop that explains the logs must say the same, and the
    stiffest stable wall lie no farther below both than the wanted accuracy. Without such a loop it takes an unstable
    wall: friction bends the line.
    """
    if of.low is None or not told.explains or abs(told.limit - of.low) + told.error > half:
        return False
    seen = evidence(own, own.damping[:1], [(of.bottom, of.top)])
    limit, error = told_by_rates(seen, seen.slope)
    return bool(np.isfinite(seen.slope[0]) and abs(limit[0] - of.low) + error[0] < half and limit[0] <= of.top)


def walls(bottom: float, top: float, value: float, error: float, width: float, largest: float) -> Floats:
    """Return walls that may be tried between two ends, dense where the limit is expected and closing trials lie.

    The first and the last are the ends; an infinite one is far above the expected limit.
    """
    far = top if np.isfinite(top) else max(2 * bottom, HIGHER * largest, width)
    apart = 0.98 * width
    spread = value + error * np.linspace(-2.5, 2.5, 21)
    near = np.array([bottom + apart, far - apart, value - 0.5 * apart, value + 0.5 * apart])
    ladder = value + apart * np.arange(-4, 5) / 4
    inner = np.concatenate([np.linspace(bottom, far, 9)[1:-1], spread, near, ladder])
    inner = np.unique(inner[(inner > bottom) & (inner < far)])
    # walls nearer than this tell nothing new
    kept = [bottom]
    for wall in inner:
        if wall - kept[-1] > 0.05 * width:
            kept.append(float(wall))
    return np.array([*kept, far])


def chances(edges: Floats, value: float, error: float) -> Floats:
    """Return the chance that the limit lies between two edges: by the forecast, and with `DOUBT` anywhere."""
    anywhere = np.diff(edges) / (edges[-1] - edges[0])
    if not np.isfinite(error):
        return np.asarray(anywhere)
    below = np.array([_normal((edge - value) / error) for edge in edges])
    told = np.diff(below)
    return np.asarray((1 - DOUBT) * told / max(told.sum(), 1e-12) + DOUBT * anywhere)


def _trials_left(column: Column) -> float:
    return column.split.trials if column.split else float(column.wall is not None)


def _normal(z: float) -> float:
    return 0.5 * (1 + erf(z / sqrt(2)))


def order(columns: tuple[Column, ...]) -> list[int]:
    """Return places of dampings that are left, in the order in which to try them.

    Contradictions first; then dampings that were begun, the nearest to its end first; then those farthest from all
    that were tried, where the model learns most.
    """
    left = [i for i, column in enumerate(columns) if column.wall is not None]
    again = [i for i in left if columns[i].bracket.again]
    last_of_all = [i for i in left if i not in again and columns[i].nothing]
    begun = [i for i in left if columns[i].bracket.trials and i not in again + last_of_all]
    begun.sort(key=lambda i: _trials_left(columns[i]))
    new = [i for i in left if i not in again + begun + last_of_all]
    known = [i for i in range(len(columns)) if i not in new]
    ordered: list[int] = []
    last = len(columns) - 1
    while new:
        pick = max(new, key=lambda i: (min([abs(i - j) for j in known] + [i + 1, last - i + 1]), -abs(i - 0.5 * last)))
        new.remove(pick)
        known.append(pick)
        ordered.append(pick)
    return again + begun + ordered + last_of_all
