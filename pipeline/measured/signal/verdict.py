"""Stable or unstable, judged from the log alone: no mass, no delay, no model of the loop.

With K other than 0 the free motion after the step is a sum of modes about a resting place; the trial is
unstable if a visible mode grows. With K = 0 the position runs away at constant force; there the trial is
stable if the acceleration decays, and the rate at which it does is (b + B)/m.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.measured.signal.course import LASTING, Course, course_of, in_first_swing, sizes
from pipeline.measured.signal.edge import first_step_alone
from pipeline.measured.signal.modes import FEWEST_SAMPLES, NARROW, WIDE, Growth, fastest_growth
from pipeline.measured.signal.response import NOISE_FACTOR, Response, find_response
from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch

CHUNK = 128
"""Trials judged at once: bounds the memory of the windows to about 8 MB."""

FLOOR_FACTOR = 2.0
"""Motion below this many sensor floors at the end is a rest or a limit cycle that only the sensor causes."""

NOT_TOLD = "growth rate not told: the motion has died away"
"""Reason of a stable trial without a growth rate."""

IDEAL_RANGE = 1e-9
"""Motion below this fraction of its peak counts as rest in a log without noise and quantum."""

ROUNDING_RANGE = 1e3
"""As `IDEAL_RANGE`, in units of rounding of the position."""

AT_REST_FROM = 0.8
"""Part of the motion after which it must be at rest to be called stable without asking for a growth rate."""

TREND_FACTOR = 3.0
"""Change from first to last quarter that decides a motion that no mode explains; noise alone changes less."""

REST_FLOORS = 8.0
"""Amplitude at the end, in sensor floors, up to which quanta may keep an oscillation up in a stable loop: the
describing function of a quantizer departs from 1 by 0.16 (q/A)^1.5 at most, so that a larger one needs a wall within
0.7 % of the limit."""

SENSOR_SHARE = 0.5
"""Standard deviation of what the sensor adds to a motion from sample to sample, in floors: the noise of a baseline is
told badly, and a quantum adds 0.4."""

LEAST_FALL = 3.0
"""Motion relative to what is left of it, or to the sensor floor where that is less, from which on its end there is a
decay: a mode of a third of the motion at the start has not grown."""

LEFT = 0.5
"""Part of the motion that may be left of it at its end for a limit cycle that only the sensor causes."""

LIMIT_SIGMAS = 3.0
"""Rates within this many standard errors of zero decide nothing: where K = 0, and of a motion near the floor."""

FEWEST_TURNS = 8
"""Changes of sign, of what no rigid device explains with K = 0, that show a vibration: a smooth error has three."""

TONE = 7.0
"""How far, in ln, the power of a vibration stands above the largest of white errors: a chance of 1e-3."""

RATE_ROUNDING = 1e-9
"""Smallest change of the acceleration over a whole log that double precision positions can tell."""


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
    In a log without noise and quantum a mode that grows at all makes the trial unstable. With a sensor floor growth or
    decay over the log must exceed the floor to decide. An oscillation that lasts above `REST_FLOORS` floors is
    unstable where the command stands at a limit in it, or where it has grown before; a motion that falls ever faster
    (friction) is stable; what has come down to the floor from far above it is stable, a limit cycle of quantum size
    included, unless a mode grows in what is left. What neither grows nor decays beyond the floor, a motion that hardly
    exceeds it, one shorter than `FEWEST_SAMPLES`, and a trial without a step (F_0 = 0) cannot be judged; of several
    steps the response to the first
    is. With K = 0 a vibration beside the motion of a rigid device makes a trial unstable where it grows, and leaves it
    open where it lasts.

    Source: Hulin 2017, sec. 3.3 (stability), eq. 3.25 (K = 0) and sec. 6.1.1 (procedure).
    """
    response = find_response(batch) if response is None else response
    verdict = np.full(len(batch), "undecided", dtype="<U9")
    growth = np.full(len(batch), np.nan)
    reason = [""] * len(batch)
    for first in range(0, len(batch), CHUNK):
        chunk = np.arange(first, min(first + CHUNK, len(batch)))
        for judged, free in ((_judge_wall, False), (_judge_free, True)):
            index = chunk[(batch.stiffness[chunk] == 0) == free]
            if not len(index):
                continue
            found = judged(batch.select(index), response.select(index))
            verdict[index], growth[index] = found.verdict, found.growth_per_s
            for i, text in zip(index, found.reason, strict=True):
                reason[i] = text
    # what moves a device without a step says nothing of the loop: a hand, a trajectory
    for i in np.flatnonzero(batch.step == 0):
        verdict[i], growth[i], reason[i] = "undecided", np.nan, response.edge_reason[i]
    for i in np.flatnonzero(response.steps > 1):
        alone = judge(first_step_alone(batch.select(slice(i, i + 1))))
        verdict[i], growth[i], reason[i] = alone.verdict[0], alone.growth_per_s[0], alone.reason[0]
    return Verdicts(verdict, growth, tuple(reason))


def _free_motion(batch: TrialBatch, edge: Integers, floor: Floats) -> Integers:
    """First row from which the motion is free: the input constant and the delay line filled by it.

    The first movement after the edge shows one delay; after another one the past before the step is
    forgotten.
    """
    start = np.maximum(edge, 0)
    moved = np.abs(np.nan_to_num(batch.displacement)) > floor[:, None]
    moved &= np.arange(moved.shape[1])[None, :] > start[:, None]
    onset = np.where(moved.any(axis=1), np.argmax(moved, axis=1), start)
    return (2 * onset - start).astype(np.int64)


def _judge_wall(batch: TrialBatch, response: Response) -> Verdicts:
    floor = response.floor
    start = _free_motion(batch, response.edge_row, floor)
    change = np.nan_to_num(np.diff(batch.position, axis=1))
    column = np.arange(change.shape[1])[None, :]
    count = np.maximum(batch.rows - 1 - start, 0)
    free = (column >= start[:, None]) & (column < (batch.rows - 1)[:, None])
    size = np.where(free, np.abs(change), 0.0)
    peak = size.max(axis=1, initial=0.0)
    ideal = floor == 0
    rounding = np.finfo(np.float64).eps * np.nanmax(np.abs(batch.position), axis=1, initial=0.0)
    rest = np.where(ideal, np.maximum(IDEAL_RANGE * peak, ROUNDING_RANGE * rounding), floor)
    moving = size > rest[:, None]
    lasted = np.where(moving.any(axis=1), size.shape[1] - np.argmax(moving[:, ::-1], axis=1) - start, 0)
    still = np.where(ideal, lasted < AT_REST_FROM * count, _end_spread(batch, start, count) <= 2 * FLOOR_FACTOR * floor)
    at_rest = still & (count >= FEWEST_SAMPLES) & (peak > 0)
    # a motion that comes to rest is fitted while it lasts, with some rest behind it where that is too short
    length = np.where(at_rest | ideal, np.maximum(lasted, np.minimum(count, 2 * FEWEST_SAMPLES)), count)
    take = np.minimum(start[:, None] + column, change.shape[1] - 1)
    signal = np.take_along_axis(change, take, axis=1)
    # the floor is six standard deviations of the noise wide, or one quantum, whose error is far smaller
    grown = fastest_growth(signal, length, np.maximum(floor / NOISE_FACTOR, rounding))
    rate = grown.per_sample
    grows = _adds(grown, floor) & ~at_rest
    course = course_of(batch, start, count)
    told = _told(rate, grown, course.end, floor)
    _look_again(signal, length, course, floor, grown, grows, told)
    # motion that no mode explains to its end: it has died away in the noise, or it has risen out of it
    unexplained = np.isnan(rate)
    grows = np.where(grown.clean, grows, (grows | (told & (rate > 0))) & ~course.falls)
    grows |= unexplained & (course.trend > TREND_FACTOR)
    grows |= ~grown.clean & (course.bent & course.lasts | course.risen) & (course.end > REST_FLOORS * floor)
    falls = np.where(
        grown.clean, ~grows, told & (rate < 0) & ~(course.bent & ~course.falls) & ~course.contradicts(rate)
    )
    falls |= unexplained & (course.trend < 1 / TREND_FACTOR)
    # what is left may be a limit cycle of the sensor only if it came down from far above
    falls |= ~grows & (course.end <= np.minimum(REST_FLOORS * floor, LEFT * course.begin))
    falls |= ~grown.clean & (course.brakes | (course.falls & (rate < 0)))
    high = course.begin >= LEAST_FALL * np.minimum(course.end, floor)
    enough = (count >= FEWEST_SAMPLES) & (peak > 0)
    # a mode that the step hardly excites begins below the floor, whatever has died away above it
    rising = _rising(signal, count, response, enough & ~ideal & (falls | at_rest) & ~course.brakes)
    sunk = np.isnan(rising)
    rate = np.where(sunk, rate, rising)
    early = in_first_swing(batch, response, change)
    grows &= enough & ~at_rest & sunk & ~early
    falls = enough & (at_rest | falls) & ~grows & high & sunk
    verdict = np.where(grows, "unstable", np.where(falls, "stable", "undecided"))
    rate = np.where(falls & (rate > 0), np.nan, rate)
    reason = [
        _undecided(*each) if text == "undecided" else NOT_TOLD if np.isnan(r) else ""
        for text, r, *each in zip(
            verdict, rate, enough, high, early, count, course.end, rising / batch.sampling_period_s, strict=True
        )
    ]
    return Verdicts(verdict, rate / batch.sampling_period_s, tuple(reason))


def _look_again(
    signal: Floats, length: Integers, course: Course, floor: Floats, grown: Growth, grows: Booleans, told: Booleans
) -> None:
    """Keep of the growth and of what is told of a noisy motion that which windows of another width show, too.

    There a mode may grow by chance. Changes ``grows``, ``told`` and the rates of ``grown``.
    """
    rate = grown.per_sample
    doubtful = np.flatnonzero((grows | (told & (rate > 0))) & ~grown.clean)
    if len(doubtful):
        again = fastest_growth(signal[doubtful], length[doubtful], grown.noise[doubtful], NARROW)
        agree = _told(again.per_sample, again, course.end[doubtful], floor[doubtful])
        told[doubtful] &= agree & (np.sign(again.per_sample) == np.sign(rate[doubtful]))
        rate[doubtful] = np.where(rate[doubtful] > 0, np.fmin(rate[doubtful], again.per_sample), rate[doubtful])
        grows[doubtful] &= _adds(again, floor[doubtful])


def _rising(signal: Floats, count: Integers, response: Response, falls: Booleans) -> Floats:
    """Growth per sample of what grows beside or below a motion that falls, NaN where none is told.

    Differences show it where a slow motion hides a vibration. However small the mode, its standard error tells it: the
    standard error of the growth of one mode over n samples is sqrt(6) noise/(amplitude n^1.5) at least, with the root
    mean square of the mode in the middle; the mode must grow by `LIMIT_SIGMAS` of it in both views. A quantum errs by a
    pattern and not by chance, as far as noise does not blur it: growth must add more than it can, as a limit cycle that
    it keeps up seems to grow a bit.
    """
    growth = np.full(len(signal), np.nan)
    noise = response.floor / NOISE_FACTOR
    pattern = np.maximum(SENSOR_SHARE * response.sensor_quantum - np.nan_to_num(response.sensor_noise), 0.0)
    # a difference of differences bears more of the errors: sqrt(3) times where they are white
    index = np.flatnonzero(falls)
    for motion, length, more in ((signal, count, 1), (np.diff(signal, axis=1), count - 1, 2)) if len(index) else ():
        n, views = length[index], []
        for part in (WIDE, NARROW):
            view = fastest_growth(motion[index], n, more * noise[index], part, 0.0)
            least = view.per_sample
            error = np.sqrt(6) * view.noise / (view.amplitude * np.exp(-least * n / 2) * n**1.5)
            told = (least > LIMIT_SIGMAS * error) & (-view.amplitude * np.expm1(-least * n) > more * pattern[index])
            views.append(np.where(told, least, np.nan))
        growth[index] = np.fmax(growth[index], np.minimum(*views))
    return growth


def _undecided(visible: bool, high: bool, early: bool, samples: int, left: float, rate: float) -> str:
    if early and visible:
        return "the log ends before the motion turns or passes its final position: behind any wall it speeds up so far"
    if rate > 0:
        return f"a mode grows at {rate:.3g} 1/s in a motion that falls to an amplitude of {left:.3g}"
    if not visible:
        return (
            f"no visible motion to judge: {samples} samples after the step, of which {FEWEST_SAMPLES} must stand above "
            "the sensor floor"
        )
    if not high:
        return "the motion hardly exceeds what the sensor can cause: growth would not show"
    return f"at the limit: an amplitude of {left:.3g} is left that grows or decays by no more than the sensor can cause"


def _told(rate: Floats, grown: Growth, end: Floats, floor: Floats) -> Booleans:
    """Whether a rate changes the amplitude of the position over the log by more than the sensor can."""
    with np.errstate(over="ignore", invalid="ignore"):
        change = np.abs(np.expm1(-rate * grown.span))
        # what neither modes nor the sensor explain (jitter) is no independent noise, and does not average out
        unexplained = np.sqrt(np.maximum(grown.noise**2 - (SENSOR_SHARE * floor) ** 2, 0.0))
    result: Booleans = (end * change > floor) & (end > REST_FLOORS * floor)
    return result & (np.nan_to_num(grown.amplitude) * change > NOISE_FACTOR * unexplained)


def _adds(grown: Growth, floor: Floats) -> Booleans:
    """Whether growth adds more to the motion over the log than sensor and unexplained motion can."""
    with np.errstate(over="ignore", invalid="ignore"):
        added = grown.amplitude * -np.expm1(-grown.per_sample * grown.span)
    noise = np.where(grown.clean, 0.0, NOISE_FACTOR * grown.noise)
    result: Booleans = np.nan_to_num(added) > np.maximum(floor, noise)
    return result


def _end_spread(batch: TrialBatch, start: Integers, count: Integers) -> Floats:
    """Peak to peak of the position over the last part of the motion."""
    column = np.arange(batch.position.shape[1])[None, :]
    end = batch.valid & (column >= (start + AT_REST_FROM * count)[:, None])
    largest = np.max(np.where(end, batch.position, -np.inf), axis=1, initial=-np.inf)
    spread: Floats = largest - np.min(np.where(end, batch.position, np.inf), axis=1, initial=np.inf)
    return spread


def _judge_free(batch: TrialBatch, response: Response) -> Verdicts:
    """Judge trials with K = 0 by x = A + C t + E exp(rate t), fitted without knowing A, C, E.

    For samples of this form x_k is linear in 1, k, k^2 and the running sum of x, and the factor of the sum is
    exp(rate T) - 1, exactly. Sums average the noise, where differences would amplify it.
    """
    edge, floor = response.edge_row, response.floor
    start = _free_motion(batch, edge, floor)
    # fast modes of the delay line are forgotten after some more delays; a third of the log is left at least
    extra = np.minimum(3 * np.maximum(start - np.maximum(edge, 0), 2), (batch.rows - start) // 4)
    start = start + np.maximum(extra, 0)
    count = np.maximum(batch.rows - start, 0)
    column = np.arange(batch.position.shape[1])[None, :]
    inside = column < count[:, None]
    take = np.minimum(start[:, None] + column, batch.position.shape[1] - 1)
    x = np.where(inside, np.take_along_axis(batch.position, take, axis=1), 0.0)
    x = np.where(inside, x - x[:, :1], 0.0)
    scale = np.maximum(np.abs(x).max(axis=1, initial=0.0), np.finfo(np.float64).tiny)
    t = np.where(inside, 2 * column / np.maximum(count - 1, 1)[:, None] - 1, 0.0)
    running = np.cumsum(x, axis=1) - x
    design = np.stack([np.where(inside, 1.0, 0.0), t, np.where(inside, t * t, 0.0)], axis=2)
    basis, _ = np.linalg.qr(design)
    left = _project_out(basis, np.where(inside, running, 0.0))
    right = _project_out(basis, x)
    power = (left * left).sum(axis=1)
    enough = (count >= FEWEST_SAMPLES) & (power > 0) & (scale > 4 * floor)
    factor = np.where(enough, (left * right).sum(axis=1) / np.where(power > 0, power, 1.0), 0.0)
    unfitted = right - factor[:, None] * left
    residual = np.sqrt((unfitted**2).sum(axis=1) / np.maximum(count - 4, 1))
    error = residual / np.sqrt(np.where(power > 0, power, 1.0))
    error = np.maximum(error, RATE_ROUNDING / np.maximum(count, 1))
    rate = np.log1p(np.maximum(factor, -0.999))
    resolved = enough & (np.abs(rate) > LIMIT_SIGMAS * error)
    turns = (inside[:, 1:] & (unfitted[:, 1:] * unfitted[:, :-1] < 0)).sum(axis=1)
    vibrates = enough & (residual > np.maximum(0.5 * floor, IDEAL_RANGE * scale)) & (turns >= FEWEST_TURNS)
    vibrates &= _is_tone(np.where(inside, unfitted, 0.0), count)
    grown = _vibration(x, count, floor, vibrates)
    size = sizes(unfitted, count)
    lasts = vibrates & np.isnan(grown) & (size[:, 3] >= LASTING * size[:, 2])
    rate, resolved = np.fmax(rate, grown), (resolved & ~lasts) | np.isfinite(grown)
    verdict = np.where(~resolved, "undecided", np.where(rate > 0, "unstable", "stable"))
    growth = np.where(enough & ~lasts, rate / batch.sampling_period_s, np.nan)
    spread = LIMIT_SIGMAS * error / batch.sampling_period_s
    reasons = []
    for done, usable, shakes, g, s in zip(resolved, enough, lasts, growth, spread, strict=True):
        if done:
            reasons.append("")
        elif shakes:
            reasons.append("a vibration lasts that neither grows nor decays by more than the sensor can cause")
        elif usable:
            reasons.append(f"at the limit: growth of the acceleration {g:.3g} +- {s:.2g} 1/s does not differ from 0")
        else:
            reasons.append(
                f"too little motion at K = 0: at least {FEWEST_SAMPLES} samples above the sensor floor needed"
            )
    return Verdicts(verdict, growth, tuple(reasons))


def _is_tone(rest: Floats, count: Integers) -> Booleans:
    """Whether one frequency bears more of a motion than chance gives it among errors that know nothing of each other.

    Of m powers of white noise the largest is above (ln m + TONE)/m of their sum with a chance of exp(-TONE).
    """
    power = np.abs(np.fft.rfft(rest, axis=1)) ** 2
    total, number = power.sum(axis=1), np.maximum(count / 2, 1.0)
    share = power.max(axis=1, initial=0.0) / np.where(total > 0, total, 1.0)
    # zeros behind a log make its spectrum finer, not its powers more
    finer = power.shape[1] / number
    result: Booleans = share * finer > (np.log(number) + TONE) / number
    return result


def _vibration(x: Floats, count: Integers, floor: Floats, vibrates: Booleans) -> Floats:
    """Growth per sample of vibrations beside the motion of a rigid device, NaN where none is seen to grow.

    Second differences leave nothing of the uniform motion, and hardly anything of its slow growth or decay.
    """
    growth, some = np.full(len(x), np.nan), np.flatnonzero(vibrates)
    if len(some):
        bend, length = np.diff(x[some], n=2, axis=1), count[some] - 2
        noise = np.maximum(2 * floor[some] / NOISE_FACTOR, np.finfo(np.float64).eps * np.abs(x[some]).max(axis=1))
        wide, narrow = (fastest_growth(bend, length, noise, part) for part in (WIDE, NARROW))
        grows = _adds(wide, 2 * floor[some]) & _adds(narrow, 2 * floor[some])
        growth[some] = np.where(grows, np.fmin(wide.per_sample, narrow.per_sample), np.nan)
    return growth


def _project_out(basis: Floats, values: Floats) -> Floats:
    """Remove from each row of values what the columns of its orthonormal basis explain."""
    for _ in range(2):  # twice: once leaves rounding of the large part in the small one
        values = values - (basis @ (np.swapaxes(basis, 1, 2) @ values[:, :, None]))[:, :, 0]
    return values
