"""Stable or unstable, judged from the log alone: no mass, no delay, no model of the loop.

The free motion after the step is a sum of modes about a resting place; the trial is unstable if a visible mode grows.
With K = 0 the position runs away at constant force, and the trial is stable if its acceleration decays, at the rate
(b + B)/m. Either way one growth rate with its standard error decides, by the modes, else by the size of the motion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.measured.signal.edge import BENT, external_force, first_step_alone
from pipeline.measured.signal.modes import FEWEST_SAMPLES, NARROW, WIDE, fastest_growth
from pipeline.measured.signal.release import at_rest_before, find_release
from pipeline.measured.signal.response import Response, find_response
from pipeline.measured.signal.sensor import NOISE_FACTOR
from pipeline.measured.student import SIGMAS
from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch

REST_FLOORS = 8.0
"""Amplitude at the end, in sensor floors, up to which quanta may keep an oscillation up in a stable loop: the
describing function of a quantizer departs from 1 by 0.16 (q/A)^1.5 at most, so that a larger one needs a wall within
0.7 % of the limit."""

LEAST_FALL = 3.0
"""Factor by which a motion falls to what is left of it at the floor of the sensor, where a mode of a third of it has
not grown, and by which the size of a motion without modes changes, to decide."""

END = 0.8
"""Part of the motion behind which is its end, by which it has come down to the floor of the sensor."""

FADES = 0.9
"""Ratio of the sizes of neighbouring quarters up to which a motion fades: parts of a period make 5 % of difference."""

BLOCKS = 8
"""Parts of the motion whose size tells a growth rate: half a period each of what a wall does within its log."""

NOT_TOLD = "growth rate not told: the motion has died away"
"""Reason of a stable trial without a growth rate."""

ROUNDING = 1e3 * float(np.finfo(np.float64).eps)
"""Motion relative to the positions that is arithmetic in a log without a sensor; of its own peak a billionth is."""


@dataclass(frozen=True, eq=False)
class Verdicts:
    """Verdict of each trial, all of length n.

    Parameters
    ----------
    verdict : array of str
        ``stable``, ``unstable`` or ``undecided``.
    growth_per_s : float64
        Growth rate of the fastest growing (slowest decaying) visible mode [1/s]; NaN where none can be told.
        Where K = 0: growth rate of the acceleration, -(b + B)/m for small (b + B).
    reason : tuple of str
        Why a trial is undecided, or has no growth rate; empty otherwise.
    """

    verdict: np.ndarray[tuple[int, ...], np.dtype[np.str_]]
    growth_per_s: Floats
    reason: tuple[str, ...]

    def select(self, some: Integers | slice) -> Verdicts:
        """Return the verdicts of the trials at indices or in a slice."""
        reason = self.reason[some] if isinstance(some, slice) else tuple(self.reason[i] for i in some)
        return Verdicts(self.verdict[some], self.growth_per_s[some], reason)


def judge(batch: TrialBatch, response: Response | None = None) -> Verdicts:
    """Judge the stability of each trial from its log.

    Parameters
    ----------
    batch : TrialBatch
    response : Response, optional
        What `find_response` said of the same trials, if it is there already.

    Returns
    -------
    Verdicts

    Notes
    -----
    A growth rate that is `SIGMAS` standard errors from zero decides. What comes down to the floor of the sensor from
    far above it is stable, a limit cycle of quantum size included, unless a mode grows in what is left. An oscillation
    that lasts above `REST_FLOORS` floors while the command stands at a limit is unstable. What neither grows nor decays
    by more than its standard errors, a motion that hardly exceeds the floor, and one shorter than `FEWEST_SAMPLES` or
    still in its first swing cannot be judged; of several steps the response to the first is. A trial without a step is
    judged by its free motion, as `release.find_release` finds it: a growth rate needs no step. What else moves a device
    without one, such as a trajectory, says nothing of the loop.

    Source: Hulin 2017, sec. 3.3 (stability), eq. 3.25 (K = 0) and sec. 6.1.1 (procedure).
    """
    response = find_response(batch) if response is None else response
    parts = [_judge(part, response.select(some), _stepped(part)) for some, part in batch.portions()]
    verdict = np.concatenate([part.verdict for part in parts] or [np.empty(0, dtype="<U9")])
    growth = np.concatenate([part.growth_per_s for part in parts] or [np.empty(0)])
    reason = [text for part in parts for text in part.reason]
    some = np.flatnonzero(batch.step == 0)
    if len(some):
        released = _judge_released(batch.select(some), response.select(some))
        verdict[some], growth[some] = released.verdict, released.growth_per_s
        for place, text in zip(some.tolist(), released.reason, strict=True):
            reason[place] = text
    for i in np.flatnonzero(response.steps > 1):
        alone = judge(first_step_alone(batch.select(slice(i, i + 1))))
        verdict[i], growth[i], reason[i] = alone.verdict[0], alone.growth_per_s[0], alone.reason[0]
    return Verdicts(verdict, growth, tuple(reason))


@dataclass(frozen=True, eq=False)
class _Excitation:
    """What set each trial in motion, shape (n,): row from which on it acts no more, size of its force, direction."""

    free: Integers | None
    size: Floats
    way: Floats


def _stepped(batch: TrialBatch) -> _Excitation:
    return _Excitation(None, np.abs(batch.step), np.sign(batch.step))


def _judge_released(batch: TrialBatch, response: Response) -> Verdicts:
    """Judge trials without a step by their free motion."""
    found = find_release(batch)
    verdict = np.full(len(batch), "undecided", dtype="<U9")
    growth = np.full(len(batch), np.nan)
    reason = [f"{no_step}; {why}" for no_step, why in zip(response.edge_reason, found.reason, strict=True)]
    some = np.flatnonzero(found.free >= 0)
    if len(some):
        batch, response = batch.select(some), response.select(some)
        floor, noise = at_rest_before(batch, found.begin[some])
        displacement = np.nan_to_num(batch.displacement)
        onset = np.argmax(np.abs(displacement) > floor[:, None], axis=1)
        begun = np.take_along_axis(displacement, onset[:, None], axis=1)[:, 0]
        level = found.level[some]
        final = np.divide(level, batch.stiffness, out=np.full(len(some), np.nan), where=batch.stiffness > 0)
        final[level == 0] = np.nan
        response = replace(
            response,
            edge_row=found.begin[some],
            floor=floor,
            sensor_noise=noise,
            position_final_expected=response.position_start + final,
        )
        way = np.where(level != 0, np.sign(level), np.sign(begun))
        cause = _Excitation(found.free[some], found.size[some], way)
        judged = _judge(replace(batch, step=level), response, cause)
        verdict[some], growth[some] = judged.verdict, judged.growth_per_s
        for i, text in zip(some.tolist(), judged.reason, strict=True):
            reason[i] = text
    return Verdicts(verdict, growth, tuple(reason))


def _judge(batch: TrialBatch, response: Response, cause: _Excitation) -> Verdicts:
    floor, wall = response.floor, batch.stiffness != 0
    rounding = ROUNDING * np.nanmax(np.abs(batch.position), axis=1, initial=0.0)
    signal, start, count = _free_motion(batch, response, cause.free)
    size = np.abs(signal)
    peak = size.max(axis=1, initial=0.0)
    rest = np.where(floor > 0, floor, np.maximum(1e-9 * peak, rounding))
    moving = size > np.where(wall, rest, 2 * rest)[:, None]
    lasted = np.where(moving.any(axis=1), signal.shape[1] - np.argmax(moving[:, ::-1], axis=1), 0)
    begin = _half_range(batch, start, count, 0.0)
    # at a turn a swing looks like rest: its end is no shorter than from one turn to the next
    end = _half_range(batch, start, count, np.minimum(END, 1 - _last_swing(signal, moving) / np.maximum(count, 1)))
    # what is left may be a limit cycle of the sensor, if it came down from far above
    left = np.where(floor > 0, end <= REST_FLOORS * floor, lasted < END * count) & wall
    above = (begin >= LEAST_FALL * np.where(left, end, np.minimum(end, floor))) | ~wall
    enough = (count >= FEWEST_SAMPLES) & (peak > np.where(wall, 0.0, 4 * floor))
    # a motion that comes to rest is seen while it lasts, with some rest behind it where that is too short
    seen = np.where(~wall | left | (floor == 0), np.maximum(lasted, np.minimum(count, 2 * FEWEST_SAMPLES)), count)
    # the floor is six standard deviations of the noise wide, or one quantum, whose error is far smaller
    noise = np.where(wall, 1.0, np.sqrt(6)) * np.maximum(floor / NOISE_FACTOR, 1e-3 * rounding)
    rate, error, clean = _growth(signal, seen, noise)
    slope, scatter, fades = _slope(signal, seen, noise)
    # a motion without modes, or whose views differ, has the rate of its size
    sized = ~clean & ~(np.abs(rate) > SIGMAS * error)
    change = np.maximum(SIGMAS * scatter, np.log(LEAST_FALL) / np.maximum(seen, 1))
    falls, grows = slope < -SIGMAS * scatter, slope > change
    # a growing mode shows once the others have died away: what fades to its end is braked
    rises = np.where(sized, grows, (rate > SIGMAS * error) & (clean | ~fades))
    lasts = _bent(batch, start, count, cause.size) & ~falls & wall
    early = wall & _in_first_swing(batch, response, cause.way) & ~falls & ~left
    rises = (rises | lasts) & enough & ~left & ~early
    sinks = (np.where(sized, slope < -change, rate < -SIGMAS * error) & ~lasts) | left
    sinks &= above & enough & ~rises & ~early
    # a mode that the step hardly excites begins below the floor, whatever has died away above it
    hidden = np.full(len(batch), np.nan)
    some = np.flatnonzero(sinks & wall & (floor > 0))
    if len(some):
        hidden[some] = _hidden(signal[some], count[some], noise[some], response.select(some))
    sinks &= np.isnan(hidden)
    verdict = np.where(rises, "unstable", np.where(sinks, "stable", "undecided"))
    rate = np.where(np.isnan(hidden), np.where(sized & (rises | sinks), np.where(rises, slope, rate), rate), hidden)
    rate = np.where((sinks & (rate > 0)) | ~enough, np.nan, rate) / batch.sampling_period_s
    reason = [
        NOT_TOLD if text == "stable" and np.isnan(r) else _undecided(*each) if text == "undecided" else ""
        for text, r, *each in zip(
            verdict, rate, enough, early, count, end, hidden / batch.sampling_period_s, rate,
            SIGMAS * error / batch.sampling_period_s, strict=True,
        )
    ]  # fmt: skip
    return Verdicts(verdict, rate, tuple(reason))


def _undecided(visible: bool, early: bool, samples: int, left: float, hidden: float, rate: float, error: float) -> str:
    if not visible:
        return (
            f"no visible motion to judge: {samples} samples after the step, of which {FEWEST_SAMPLES} must stand above "
            "the sensor floor"
        )
    if early:
        return "the log ends before the motion turns or passes its final position: behind any wall it speeds up so far"
    if hidden > 0:
        return f"a mode grows at {hidden:.3g} 1/s in a motion that falls to an amplitude of {left:.3g}"
    told = f" (growth rate {rate:.3g} +- {error:.2g} 1/s)" if np.isfinite(rate) else ""
    return f"at the limit: an amplitude of {left:.3g} is left that neither grows nor decays for sure{told}"


def _free_motion(batch: TrialBatch, response: Response, free: Integers | None) -> tuple[Floats, Integers, Integers]:
    """Return the free motion without a constant part, its first row, and its number of samples.

    The input is constant, from ``free`` on where that is not the edge, and the delay line filled by it: the first
    movement after the edge shows one delay; after another one the past before the step is forgotten. Behind a wall it
    is the change from sample to sample; with K = 0 the second difference over a third of the motion, in which the
    uniform motion leaves nothing.
    """
    edge = np.maximum(response.edge_row, 0)
    column = np.arange(batch.position.shape[1])[None, :]
    moved = (np.abs(np.nan_to_num(batch.displacement)) > response.floor[:, None]) & (column > edge[:, None])
    onset = np.where(moved.any(axis=1), np.argmax(moved, axis=1), edge)
    start = 2 * onset - edge if free is None else free + 2 * (onset - edge)
    wall = batch.stiffness != 0
    # without a wall the fast modes of the delay line are forgotten after some more delays
    extra = np.minimum(3 * np.maximum(start - edge, 2), (batch.rows - start) // 4)
    start = np.where(wall, start, start + np.maximum(extra, 0))
    lag = np.where(wall, 1, np.maximum((batch.rows - start) // 3, 1))
    count = np.maximum(batch.rows - start - np.where(wall, 1, 2) * lag, 0)
    here, there, beyond = (
        np.take_along_axis(
            batch.position, np.minimum(start[:, None] + column + times * lag[:, None], len(column[0]) - 1), axis=1
        )
        for times in (0, 1, 2)
    )
    motion = np.where(wall[:, None], there - here, beyond - 2 * there + here)
    return np.where(column < count[:, None], motion, 0.0), start.astype(np.int64), count.astype(np.int64)


def _growth(signal: Floats, length: Integers, noise: Floats) -> tuple[Floats, Floats, Booleans]:
    """Return the growth of the slowest mode and its standard error, per sample, and where few modes explain all.

    Over n samples that of a mode of amplitude A in the middle is sqrt(6) s/(A n^1.5) by white noise s at least. What
    neither modes nor sensor explain (jitter, friction) is no independent noise and does not average out: it may move
    the amplitude over the log by twice itself. Two views, by windows of different width, err by their difference, too:
    the nearer to zero counts, and none where one grows and one decays.
    """
    views = [fastest_growth(signal, length, noise, part) for part in (WIDE, NARROW)]
    errors = []
    for view in views:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            middle = view.amplitude * np.exp(np.minimum(-view.per_sample * length / 2, 300.0))
            white = np.sqrt(6 / np.maximum(length, 1)) * np.minimum(view.noise, 3 * noise)
            unexplained = np.sqrt(np.maximum(view.noise**2 - (3 * noise) ** 2, 0.0))
            errors.append(np.hypot(white, 2 * unexplained) / (middle * length))
    rates = np.stack([view.per_sample for view in views])
    rate = np.where(np.abs(rates[0]) <= np.abs(rates[1]), *rates)
    error = np.where(rates[0] * rates[1] > 0, np.hypot(np.maximum(*errors), rates[1] - rates[0]), np.inf)
    clean = views[0].clean
    # as far as rounding of positions lets a rate be told over a log
    least = 1e-9 / np.maximum(length, 1)
    return np.where(clean, rates[0], rate), np.maximum(np.where(clean, errors[0], error), least), clean


def _hidden(signal: Floats, count: Integers, noise: Floats, response: Response) -> Floats:
    """Return the growth per sample of what grows beside or below a motion that falls, NaN where none is told.

    Differences show it where a slow motion hides a vibration; they bear twice the error. A quantum errs by a pattern
    and not by chance, as far as noise does not blur it: growth must add more than half of it.
    """
    growth = np.full(len(signal), np.nan)
    pattern = np.maximum(0.5 * response.sensor_quantum - np.nan_to_num(response.sensor_noise), 0.0)
    for motion, n, more in ((signal, count, 1), (np.diff(signal, axis=1), count - 1, 2)):
        views = []
        for part in (WIDE, NARROW):
            view = fastest_growth(motion, n, more * noise, part, 0.0)
            rate = view.per_sample
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                error = np.sqrt(6) * view.noise / (view.amplitude * np.exp(-rate * n / 2) * n**1.5)
                told = (rate > SIGMAS * error) & (-view.amplitude * np.expm1(-rate * n) > more * pattern)
            views.append(np.where(told, rate, np.nan))
        growth = np.fmax(growth, np.minimum(*views))
    return growth


def _slope(signal: Floats, length: Integers, noise: Floats) -> tuple[Floats, Floats, Booleans]:
    """Return the growth per sample of the size of a motion over its parts, with its standard error by their scatter.

    And whether it fades: from each of its last quarters to the next.
    """
    place = np.arange(signal.shape[1])[None, :] * BLOCKS / np.maximum(length, 1)[:, None]
    blocks = [(place >= i) & (place < i + 1) for i in range(BLOCKS)]
    power = np.stack([np.where(part, signal**2, 0.0).sum(axis=1) / np.maximum(part.sum(axis=1), 1) for part in blocks])
    size = 0.5 * np.log(np.maximum(power - noise**2, np.finfo(np.float64).tiny) + noise**2)
    x = np.arange(BLOCKS) - 0.5 * (BLOCKS - 1)
    square = float(x @ x)
    slope = x @ size / square
    rest = size - size.mean(axis=0) - np.outer(x, slope)
    step = np.maximum(length, 1) / BLOCKS
    quarter = power[2::2] + power[3::2]
    fades = (quarter[2] < FADES**2 * quarter[1]) & (quarter[1] < FADES**2 * quarter[0])
    return slope / step, np.sqrt((rest**2).sum(axis=0) / (BLOCKS - 2) / square) / step, fades


def _bent(batch: TrialBatch, start: Integers, count: Integers, size: Floats) -> Booleans:
    """Return whether the command stands at a limit, or at the step alone, late in the motion, shape (n,).

    It does so in two rows or more of the last quarter although the wall law asks for more: it is clipped, or the wall
    does not push.
    """
    column = np.arange(batch.position.shape[1])[None, :] - start[:, None]
    after = batch.valid & (column >= 0)
    step = batch.step[:, None]
    off = after & (column >= (0.75 * count)[:, None])
    off &= np.abs(np.nan_to_num(external_force(batch) - step)) > BENT * size[:, None]
    lowest = np.where(after, batch.command, np.inf).min(axis=1, initial=np.inf)
    highest = np.where(after, batch.command, -np.inf).max(axis=1, initial=-np.inf)
    bent = np.zeros(len(batch), dtype=np.bool_)
    for limit in (lowest, highest, batch.step):
        bent |= (off & np.isclose(batch.command, limit[:, None], rtol=1e-9, atol=0.0)).sum(axis=1) >= 2
    return bent


def _last_swing(signal: Floats, moving: Booleans) -> Floats:
    """Return the rows between the last two changes of direction of each motion, 0 where there are fewer, shape (n,)."""
    rows = np.arange(signal.shape[1])
    seen = np.maximum.accumulate(np.where(moving, rows, -1), axis=1)
    ahead = np.take_along_axis(signal, np.maximum(seen, 0), axis=1) > 0
    turns = (ahead[:, 1:] != ahead[:, :-1]) & (seen[:, :-1] >= 0)
    last = np.where(turns, rows[1:], 0).max(axis=1, initial=0)
    before = np.where(turns & (rows[1:] < last[:, None]), rows[1:], 0).max(axis=1, initial=0)
    return np.where(before > 0, last - before, 0).astype(np.float64)


def _half_range(batch: TrialBatch, start: Integers, count: Integers, since: float | Floats) -> Floats:
    """Return half the range of the position from a part of the motion on, shape (n,)."""
    inside = batch.valid & (np.arange(batch.position.shape[1])[None, :] >= (start + since * count)[:, None])
    high = np.max(np.where(inside, batch.position, -np.inf), axis=1, initial=-np.inf)
    low = np.min(np.where(inside, batch.position, np.inf), axis=1, initial=np.inf)
    result: Floats = np.where(high >= low, 0.5 * (high - low), 0.0)
    return result


def _in_first_swing(batch: TrialBatch, response: Response, way: Floats) -> Booleans:
    """Return which motions have neither turned nor passed their final position: behind any wall these speed up."""
    way, floor = way[:, None], response.floor[:, None]
    travel = np.abs(response.position_final_expected - response.position_start)[:, None]
    moved = np.nan_to_num(batch.displacement) * way
    turns = (np.nan_to_num(np.diff(batch.position, axis=1)) * way < -floor).any(axis=1)
    return np.asarray(~(turns | (moved > travel + floor).any(axis=1)))
