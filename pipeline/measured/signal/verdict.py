"""Judge the stability of a trial from its log, without a mass, a delay or a model of the loop.

The free motion after the step is a sum of modes about a rest position. The trial is unstable if a visible mode grows.
With K = 0, the position diverges under a constant force; the trial is stable if its acceleration decays, at the rate
(b + B)/m. In both cases, one growth rate with its standard error decides. It is estimated from the modes, or else from
the size of the motion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from pipeline.measured.signal.edge import BENT, NO_ROW, external_force, first_step_alone
from pipeline.measured.signal.modes import FEWEST_SAMPLES, NARROW, WIDE, Growth, MotionWindows
from pipeline.measured.signal.release import at_rest_before, find_release
from pipeline.measured.signal.response import Response, find_response
from pipeline.measured.signal.sensor import NOISE_FACTOR
from pipeline.measured.student import SIGMAS
from pipeline.records.trials import Floats, Integers, Trial

REST_FLOORS = 8.0
"""Largest final amplitude, in sensor floors, of an oscillation that quanta may sustain in a stable loop. The describing
function of a quantizer differs from 1 by at most 0.16 (q/A)^1.5, so a larger oscillation requires a wall within 0.7 %
of the limit."""

LEAST_FALL = 3.0
"""Smallest factor by which a motion must decay to the sensor floor, to exclude growth of a mode with a third of the
remaining amplitude. The size of a motion without modes must change by the same factor for a verdict."""

END = 0.8
"""Fraction of the motion at which its end begins. The motion must have reached the sensor floor by then."""

FADES = 0.9
"""Largest ratio of the sizes of neighbouring quarters for a fading motion. Incomplete periods cause a difference of
5 %."""

BLOCKS = 8
"""Number of parts of the motion whose sizes show a growth rate. If the log contains four periods, a part is half a
period."""

NOT_TOLD = "the growth rate is unknown, because the motion has decayed"
"""Reason for a stable trial without a growth rate."""

Views = tuple[MotionWindows, MotionWindows]
"""Wide and narrow windows of the same motion."""

ROUNDING = 1e3 * float(np.finfo(np.float64).eps)
"""Motion, relative to the positions, that is attributed to rounding in a log without sensor errors. Relative to the
peak of the motion, the limit is 1e-9."""


@dataclass(frozen=True)
class Verdict:
    """Verdict of a trial.

    Parameters
    ----------
    verdict : str
        ``stable``, ``unstable`` or ``undecided``.
    growth_per_s : float
        Growth rate of the fastest growing (slowest decaying) visible mode [1/s], or NaN if unknown. If K = 0, the
        growth rate of the acceleration, which is -(b + B)/m for small (b + B).
    reason : str
        Reason why a trial is undecided or has no growth rate. It is empty otherwise.
    """

    verdict: str
    growth_per_s: float
    reason: str


def judge(trial: Trial, response: Response | None = None) -> Verdict:
    """Judge the stability of a trial from its log.

    Parameters
    ----------
    trial : Trial
    response : Response, optional
        Response of this trial, if already available.

    Returns
    -------
    Verdict

    Notes
    -----
    A growth rate that is `SIGMAS` standard errors from zero decides. A motion that decays to the sensor floor from far
    above it is stable unless a mode grows in the remainder; this includes a limit cycle of quantum size. A sustained
    oscillation above `REST_FLOORS` floors with the command at a limit is unstable. A motion is undecided if its growth
    is within its standard errors, if it hardly exceeds the floor, if it is shorter than `FEWEST_SAMPLES`, or if it is
    still in its first half-period. If there are several steps, the response to the first step is judged. A trial
    without a step is judged by its free motion from `release.find_release`, since a growth rate requires no step. Other
    motion without a step, such as a trajectory, contains no information on the loop.

    Source: Hulin 2017, sec. 3.3 (stability), eq. 3.25 (K = 0) and sec. 6.1.1 (procedure).
    """
    response = find_response(trial) if response is None else response
    if trial.step == 0:
        return _judge_released(trial, response)
    if response.steps > 1:
        return judge(first_step_alone(trial))
    return _judge(trial, response, _Excitation(NO_ROW, abs(trial.step), float(np.sign(trial.step))))


@dataclass(frozen=True)
class _Excitation:
    """Excitation of a trial: row after which it has ended (-1 for the edge), size of its force, and direction."""

    free: int
    size: float
    way: float


def _judge_released(trial: Trial, response: Response) -> Verdict:
    """Return the verdict of a trial without a step, from its free motion."""
    release = find_release(trial)
    if release.free < 0:
        return Verdict("undecided", np.nan, f"{response.edge_reason}; {release.reason}")
    floor, noise = at_rest_before(trial, release.begin)
    displacement, level = trial.displacement, release.level
    begun = displacement[np.argmax(np.abs(displacement) > floor)]
    final = level / trial.stiffness if trial.stiffness > 0 and level != 0 else np.nan
    response = replace(
        response,
        edge_row=release.begin,
        floor=floor,
        sensor_noise=noise,
        position_final_expected=response.position_start + final,
    )
    way = float(np.sign(level if level != 0 else begun))
    return _judge(replace(trial, step=level), response, _Excitation(release.free, release.size, way))


def _judge(trial: Trial, response: Response, cause: _Excitation) -> Verdict:
    floor, wall = response.floor, trial.stiffness != 0
    rounding = ROUNDING * float(np.abs(trial.position).max())
    signal, start = _free_motion(trial, response, cause.free)
    count, size = len(signal), np.abs(signal)
    peak = float(size.max(initial=0.0))
    rest = floor if floor > 0 else max(1e-9 * peak, rounding)
    moving = np.flatnonzero(size > (rest if wall else 2 * rest))
    lasted = int(moving[-1]) + 1 if len(moving) else 0
    begin = _half_range(trial.position[start:])
    # near a reversal, an oscillation looks like rest, so its end must include at least two reversals
    since = min(END, 1 - _last_swing(signal, moving) / max(count, 1))
    end = _half_range(trial.position[math.ceil(start + since * count) :])
    # if the motion has decayed from far above, the remainder may be a limit cycle of the sensor
    left = wall and (end <= REST_FLOORS * floor if floor > 0 else lasted < END * count)
    above = not wall or begin >= LEAST_FALL * (end if left else min(end, floor))
    enough = count >= FEWEST_SAMPLES and peak > (0.0 if wall else 4 * floor)
    # use the motion before it comes to rest, extended by some rest if it is too short
    seen = max(lasted, min(count, 2 * FEWEST_SAMPLES)) if not wall or left or floor == 0 else count
    # the floor is six standard deviations of the noise, or one quantum; the error due to a quantum is far smaller
    noise = (1.0 if wall else np.sqrt(6)) * max(floor / NOISE_FACTOR, 1e-3 * rounding)
    views = _views(signal[:seen], noise)
    rate, error, clean = _growth(views)
    slope, scatter, fades = _slope(signal[:seen], noise)
    # use the growth of the size if there are no modes, or if the two views differ
    sized = not clean and not abs(rate) > SIGMAS * error
    change = max(SIGMAS * scatter, np.log(LEAST_FALL) / max(seen, 1))
    falls = slope < -SIGMAS * scatter
    # a growing mode is visible once the other modes have decayed, so a motion that fades to its end contains no such
    # mode
    rises = slope > change if sized else rate > SIGMAS * error and (clean or not fades)
    sinks = slope < -change if sized else rate < -SIGMAS * error
    lasts = wall and not falls and _bent(trial, start, count, cause.size)
    early = wall and not falls and not left and _in_first_swing(trial, response, cause.way)
    rises = (rises or lasts) and enough and not left and not early
    sinks = ((sinks and not lasts) or left) and above and enough and not rises and not early
    # a mode that the step hardly excites begins below the floor, hidden by modes that decay above it
    hidden = np.nan
    if sinks and wall and floor > 0:
        hidden = _hidden(views if seen == count else _views(signal, noise), response)
    sinks = sinks and np.isnan(hidden)
    rate = hidden if not np.isnan(hidden) else slope if sized and rises else rate
    rate = np.nan if (sinks and rate > 0) or not enough else rate / trial.sampling_period_s
    if rises:
        return Verdict("unstable", rate, "")
    if sinks:
        return Verdict("stable", rate, NOT_TOLD if np.isnan(rate) else "")
    if not enough:
        reason = (
            f"no visible motion to judge: {count} samples after the step, of which {FEWEST_SAMPLES} must exceed the "
            "sensor floor"
        )
    elif early:
        reason = (
            "the log ends before the motion reverses or passes its final position, so the motion still accelerates at "
            "any wall"
        )
    elif hidden > 0:
        reason = f"a mode grows at {rate:.3g} 1/s while the motion decays to an amplitude of {end:.3g}"
    else:
        reason = f"at the limit: the remaining amplitude of {end:.3g} neither grows nor decays significantly"
        if np.isfinite(rate):
            reason += f" (growth rate {rate:.3g} +- {SIGMAS * error / trial.sampling_period_s:.2g} 1/s)"
    return Verdict("undecided", rate, reason)


def _free_motion(trial: Trial, response: Response, free: int) -> tuple[Floats, int]:
    """Return the free motion without a constant part, shape (samples,), and its first row.

    In a free motion, the input is constant and fills the delay line. The input is constant from the edge onward, or
    from ``free`` onward if that row is given. The first movement after the edge shows one delay. After a second delay,
    commands from before the step have no effect. With a wall, the free motion is the change between samples. With K =
    0, it is the second difference over a third of the motion, which removes uniform motion.
    """
    edge = max(response.edge_row, 0)
    moved = np.abs(trial.displacement[edge + 1 :]) > response.floor
    delay = int(moved.argmax()) + 1 if moved.any() else 0
    start = (edge if free == NO_ROW else free) + 2 * delay
    if trial.stiffness != 0:
        position = trial.position[start:]
        return position[1:] - position[:-1], start
    # without a wall, the fast modes of the delay line decay within some more delays
    start += max(min(3 * max(start - edge, 2), (trial.rows - start) // 4), 0)
    position = trial.position[start:]
    lag = max(len(position) // 3, 1)
    return position[2 * lag :] - 2 * position[lag:-lag] + position[: -2 * lag], start


def _views(motion: Floats, noise: float) -> Views:
    """Return two views of a motion, with windows of different widths."""
    return MotionWindows(motion, noise, WIDE), MotionWindows(motion, noise, NARROW)


def _growth(views: Views) -> tuple[float, float, bool]:
    """Return the growth of the slowest mode per sample, its standard error, and whether few modes explain the motion.

    For n samples, white noise s and a mode of amplitude A in the middle of the motion, the standard error is at least
    sqrt(6) s/(A n^1.5). A residual that is neither modes nor sensor noise (jitter, friction) is not independent and
    does not average out. Its share of the error corresponds to a change of the amplitude over the log by twice this
    residual. The difference between two views, with windows of different widths, is a further error. The rate closer to
    zero is used, and the error is infinite if one view grows and the other decays.
    """
    # error of the rate over a log due to rounding of positions
    samples, noise = len(views[0].signal), views[0].noise
    least = 1e-9 / max(samples, 1)
    wide = views[0].fastest_growth()
    error = _error(wide, samples, noise)
    if wide.clean:
        return wide.per_sample, max(error, least), True
    narrow = views[1].fastest_growth()
    rates = wide.per_sample, narrow.per_sample
    rate = rates[0] if abs(rates[0]) <= abs(rates[1]) else rates[1]
    if not rates[0] * rates[1] > 0:
        return rate, np.inf, False
    error = math.hypot(max(error, _error(narrow, samples, noise)), rates[1] - rates[0])
    return rate, max(error, least), False


def _error(view: Growth, samples: int, noise: float) -> float:
    """Return the standard error of a growth rate, per sample."""
    if np.isnan(view.per_sample):
        return np.nan
    middle = view.amplitude * math.exp(min(-view.per_sample * samples / 2, 300.0))
    white = math.sqrt(6 / samples) * min(view.noise, 3 * noise)
    unexplained = math.sqrt(max(view.noise**2 - (3 * noise) ** 2, 0.0))
    return math.hypot(white, 2 * unexplained) / (middle * samples) if middle > 0 else np.inf


def _hidden(views: Views, response: Response) -> float:
    """Return the growth per sample of a component that grows within or below a decaying motion, or NaN if unknown.

    Differences reveal a vibration that a slow motion hides. The error of differences is twice as large. Unless noise
    blurs it, the quantisation error is a pattern and not random. Growth must therefore exceed half a quantum.
    """
    blur = 0.0 if np.isnan(response.sensor_noise) else response.sensor_noise
    pattern = max(0.5 * response.sensor_quantum - blur, 0.0)
    growth = np.nan
    for both, more in ((views, 1), (_views(np.diff(views[0].signal), 2 * views[0].noise), 2)):
        rates = []
        for view in both:
            if not view.grows:
                break
            n, mode = len(view.signal), view.fastest_growth(0.0)
            rate = mode.per_sample
            if not rate > 0 or -mode.amplitude * math.expm1(-rate * n) <= more * pattern:
                break
            if not rate * mode.amplitude * math.exp(-rate * n / 2) * n**1.5 > SIGMAS * math.sqrt(6) * mode.noise:
                break
            rates.append(rate)
        if len(rates) == 2:
            growth = np.fmax(growth, min(rates))
    return float(growth)


def _slope(signal: Floats, noise: float) -> tuple[float, float, bool]:
    """Return the growth per sample of the size of a motion, its standard error, and whether the motion fades.

    The size is evaluated in parts of the motion, and their scatter gives the standard error. The motion fades if each
    of its last quarters is smaller than the quarter before.
    """
    bounds = [-(-block * len(signal) // BLOCKS) for block in range(BLOCKS + 1)]
    blocks = [signal[first:end] for first, end in pairwise(bounds)]
    power = np.array([block @ block / max(len(block), 1) for block in blocks])
    size = 0.5 * np.log(np.maximum(power - noise**2, np.finfo(np.float64).tiny) + noise**2)
    x = np.arange(BLOCKS) - 0.5 * (BLOCKS - 1)
    square = float(x @ x)
    slope = float(x @ size) / square
    rest = size - size.mean() - slope * x
    step = max(len(signal), 1) / BLOCKS
    quarter = power[2::2] + power[3::2]
    fades = bool((quarter[1:] < FADES**2 * quarter[:-1]).all())
    return slope / step, math.sqrt(float(rest @ rest) / (BLOCKS - 2) / square) / step, fades


def _bent(trial: Trial, start: int, count: int, size: float) -> bool:
    """Return whether, late in the motion, the command stays at a limit or at the step.

    This is the case if the command has the same extreme value in at least two rows of the last quarter in which the
    wall law requires a different value. Then, the command is clipped or the wall is inactive.
    """
    command, late = trial.command[start:], math.ceil(0.75 * count)
    off = command[late:][np.abs((external_force(trial) - trial.step)[start + late :]) > BENT * size]
    limits = (command.min(), command.max(), trial.step) if len(off) >= 2 else ()
    return any((np.abs(off - limit) <= 1e-9 * abs(limit)).sum() >= 2 for limit in limits)


def _last_swing(signal: Floats, moving: Integers) -> int:
    """Return the number of rows between the last two reversals of a motion, or 0 if there are fewer reversals.

    ``moving`` are the rows in which the motion exceeds the sensor floor.
    """
    ahead = signal[moving] > 0
    turns = moving[1:][ahead[1:] != ahead[:-1]]
    return int(turns[-1] - turns[-2]) if len(turns) > 1 else 0


def _half_range(position: Floats) -> float:
    """Return half the range of positions, or 0 for an empty array."""
    return 0.5 * float(position.max() - position.min()) if len(position) else 0.0


def _in_first_swing(trial: Trial, response: Response, way: float) -> bool:
    """Return whether a motion has neither reversed nor passed its final position, and may therefore still
    accelerate."""
    travel = abs(response.position_final_expected - response.position_start)
    if (trial.displacement * way > travel + response.floor).any():
        return False
    return not ((trial.position[1:] - trial.position[:-1]) * way < -response.floor).any()
