"""How far each reading may lie from what an ideal sensor would have shown in the same trial.

A sensor error does two things: it shifts its own reading, and the wall answers it with a force that moves the
device. Both are in the log, and both can be told from the log alone: the wall's answer to an error enters where
the external force does, so that the step response itself is the answer of the loop to it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.measured.signal.response import Response
from pipeline.measured.signal.verdict import REST_FLOORS
from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch
from pipeline.records.criteria import SETTLING_BANDS

NOISES = np.linspace(1e-3, 1.0, 200)
"""Noise relative to the quantum: with more of it the rounding is independent from reading to reading."""

HARMONICS = np.arange(1, 201)[:, None]
"""Harmonics of the sawtooth of rounding, those left out have 0.3 % of its variance."""

READING = NOISES**2 + 1 / 12
"""Variance of the error of a rounded reading [squared quanta], for `NOISES`."""

LASTING = np.sum(np.exp(-((2 * np.pi * HARMONICS * NOISES) ** 2)) / HARMONICS**2, axis=0) / (2 * np.pi**2)
"""Part of it that lasts while a device rests, as the mean over all places on the grid, and so is not seen there."""

WANDERING = READING - LASTING
"""Scatter of the readings of a device that rests anywhere on the grid [squared quanta]."""

PULLED_ROWS = 25
"""Rows within which a wall has pulled half of the devices at rest away from the edge of a quantum, on which they
chatter: simulated baselines of the shipped devices, 20 to 200 rows long."""

BLURRED = 0.25
"""Noise relative to the quantum at which it moves most devices over the next edge all the same (as `PULLED_ROWS`)."""

HELD = np.exp(-((NOISES / BLURRED) ** 2))
"""Part of `WANDERING` that is gone from devices that a wall has pulled away from an edge, for `NOISES`."""

POOLED = 4.0
"""Noise of a baseline relative to the median, or to the quantum, up to which it is the sensor's: that of ten rows
scatters by a quarter."""

LAST_PART = 5
"""Part of the response (a fifth) at its end in which its motion at rest is seen, and before it once more."""

STAYS = 0.7
"""Motion of the last fifth relative to the fifth before from which on it does not decay; one of more than `REST_FLOORS`
sensor floors also relative to the fifth before that, since a slow mode may keep 0.7 a fifth (LWR, d = 7)."""

EXCESS = 2.0
"""Motion at rest relative to what sensor and weights tell, from which on the loop answers by more: without jitter that
of a slow response, which has two independent values in a fifth, is larger by chance in 2 % of the trials."""

LARGEST_REST = max(SETTLING_BANDS.values())
"""Motion relative to the final displacement up to which it may be rest: the widest settling band."""


@dataclass(frozen=True, eq=False)
class ReadingError:
    """Standard errors that sensor noise and quantum leave in a log; NaN where there is a reason.

    Parameters
    ----------
    sensor : float64, shape (n,)
        Standard deviation of the error of one reading [m, rad], noise and quantum; the same for all trials.
    lasting, wandering : float64, shape (n,)
        Parts of its variance while a device rests: of the rounding, which all readings share, and what is left to each
        reading after the wall has pulled the device away from the edge of a quantum.
    gain : float64, shape (n,)
        Variance of what the loop made of earlier errors, relative to what the weights tell.
    weight : float64, shape (n, N)
        Answer of a reading to an error of 1 m (1 rad) j samples before, as the wall feeds it back: 1 for
        j = 0, 0 behind the end of the log.
    deviation, change : float64, shape (n, N)
        Standard error of each reading relative to the first one [m, rad], and of its change since the sample
        before, both against the same trial with an ideal sensor.
    reason : tuple of str
        Why there is no value.
    """

    sensor: Floats
    lasting: Floats
    wandering: Floats
    gain: Floats
    weight: Floats
    deviation: Floats
    change: Floats
    reason: tuple[str, ...]

    def select(self, some: slice) -> ReadingError:
        """Return the errors of the trials in a slice."""
        return ReadingError(*(getattr(self, name)[some] for name in self.__dataclass_fields__))


@dataclass(frozen=True, eq=False)
class _Variances:
    """Variances of some trials in squared sensor errors, shape (n, N) unless said otherwise.

    ``answered`` is what the wall's answers make of the errors of row 1 up to the row before, ``kept`` the other errors:
    the row's own and, as an error that lasts, that of the first reading. ``change`` is that of the change since the
    sample before. ``gain`` (n,) is what ``answered`` needs to explain the motion at rest, NaN where there is none.
    """

    weight: Floats
    answered: Floats
    kept: Floats
    change: Floats
    gain: Floats


def sensor_error(noise: Floats, quantum: Floats, rows: Integers) -> float:
    """Return the standard deviation of the error of one reading [m, rad], one for all trials of an experiment.

    Parameters
    ----------
    noise, quantum : float64, shape (n,)
        Of each trial [m, rad]; NaN where not known. Pooled over many short baselines it is far surer than in each; of
        several quanta, which a trial that hardly moves does not show, the usual one counts.
    rows : int64, shape (n,)
        Of the baselines: the longer it is the more of the rounding the wall has hidden.
    """
    seen = np.isfinite(noise) & np.isfinite(quantum)
    if not seen.any():
        return float("nan")
    # noise is pooled without the baselines that a push or a chatter moves; a baseline within a quantum shows none
    square, step = noise[seen] ** 2, float(np.median(quantum[seen])) ** 2
    scatter = float(np.mean(square[square <= POOLED**2 * max(float(np.median(square)), step)]))
    if step > 0:
        # what a device at rest does not show of noise^2 + quantum^2/12
        pulled = float(np.median(rows[seen] / (rows[seen] + PULLED_ROWS)))
        visible = WANDERING * (1 - pulled * HELD)
        scatter += step * np.interp(scatter / step, visible, np.maximum(READING - visible, 0.0))
    return as_known(float(np.sqrt(scatter)))


def usual_gain(gain: Floats) -> float:
    """Return the gain of trials without any of their own: the median of the others; 1 without any."""
    told = gain[np.isfinite(gain)]
    return as_known(float(np.median(told))) if len(told) else 1.0


def as_known(value: float, error: float | None = None) -> float:
    """Return a value in three digits more than its error has, or a spread in its own first three.

    What all trials rest on is taken so: a log more, which moves it by far less than it is known, then leaves their
    results alone.
    """
    scale = value if error is None else error
    if not np.isfinite(scale) or scale <= 0:
        return value
    return round(value, 2 - int(np.floor(np.log10(scale))) + (error is not None))


def gain_at_rest(batch: TrialBatch, response: Response, delay_samples: int, sensor: float) -> Floats:
    """Return the gain that the motion at the end of each trial shows, NaN where it is not at rest, shape (n,).

    Parameters
    ----------
    batch, response, delay_samples
        As in `reading_error`.
    sensor : float
        Standard deviation of the error of one reading [m, rad], see `sensor_error`.
    """
    known = response.has_edge & np.isfinite(sensor)
    found = (
        _variances(part, response.select(some), delay_samples, np.full(len(part), sensor), known[some]).gain
        for some, part in batch.portions()
    )
    return np.concatenate(list(found))


def reading_error(
    batch: TrialBatch,
    response: Response,
    delay_samples: int = 0,
    *,
    sensor: float | None = None,
    gain: float | None = None,
) -> ReadingError:
    """Return the standard error of each reading against the same trial with an ideal sensor.

    Parameters
    ----------
    batch : TrialBatch
    response : Response
        Of the same trials.
    delay_samples : int
        Integer delay factor, up to which nothing can be fed back; a smaller one (0 where none is known) does no
        harm but takes the noise of some more samples for an answer.
    sensor, gain : float, optional
        `sensor_error` and `usual_gain` of the experiment; by default those of these trials.

    Returns
    -------
    ReadingError

    Raises
    ------
    ParameterError
        If the delay is negative.

    Notes
    -----
    With h_j the answer of the position to a force of 1 N that lasts one sample, read from the log as the
    differences of the step response over F_0, an error e_i of reading i shifts reading i + j by
    c_j e_i, c_0 = 1, c_j = -(K h_j + B (h_j - h_{j-1})/T); the error of the first reading, on which the wall
    rests, shifts all later ones as an error that lasts. The variance is the sum of squares. The weights are noisy
    themselves, which adds a known variance to each square: it is taken off.

    The sensor is taken as one for all trials, as in one experiment: the variance of their baselines' scatter, pooled,
    and what of noise and rounding a device at rest does not show. Errors are taken as independent from reading to
    reading; a motion of less than a quantum a sample makes them dependent. Where the quantum is a tenth of the
    final displacement the weights are mostly noise.

    The loop may answer by more than its step response tells: where the delay jitters, the forces of two successive
    errors no longer cancel (Falcon, 3 to 5 samples: 4 to 7 times the deviation). That is seen in the motion at
    rest at the end of the log, where it neither decays (`STAYS`) nor is as large as `LARGEST_REST`; the fed back
    part is scaled to it, where it is `EXCESS` times what is told. Trials that have not come to rest take the median
    gain of the others. Two standard errors then hold 94 to 99 % of the readings of simulated Falcon trials
    (2 and 10 um quantum, noise of 0 to 1 um), 90 to 92 % with jitter, and 86 % at 60 um.

    What jitter itself does to the response, friction and force limits are not told: the truth is the same trial.

    Source: Hulin 2017, eq. 3.18 (the wall force, here driven by the error of the sensor).
    """
    if delay_samples < 0:
        raise ParameterError(f"delay of {delay_samples} samples: expected an integer >= 0.")
    n, columns = batch.position.shape
    one = sensor_error(response.sensor_noise, response.sensor_quantum, response.edge_row) if sensor is None else sensor
    reason = tuple(
        ("" if edge >= 0 else f"no start of the response: {why}")
        or ("" if np.isfinite(one) else "noise of the sensor not known: too few rows before the step in all trials")
        for edge, why in zip(response.edge_row, response.edge_reason, strict=True)
    )
    known = np.array([not text for text in reason], dtype=np.bool_)
    each = np.where(known, one, np.nan)
    found = [
        _variances(part, response.select(some), delay_samples, each[some], known[some])
        for some, part in batch.portions()
    ]
    weight, own = (np.concatenate([getattr(part, name) for part in found]) for name in ("weight", "gain"))
    gain_of_each = np.where(np.isfinite(own), own, usual_gain(own) if gain is None else gain)
    deviation, change = np.empty((n, columns)), np.empty((n, columns))
    for (some, part), variances in zip(batch.portions(), found, strict=True):
        hidden = ~(known[some, None] & part.valid)
        # slow motion, which hardly adds to the changes from reading to reading
        square = variances.kept + gain_of_each[some, None] * variances.answered
        for result, value in ((deviation, square), (change, variances.change)):
            result[some] = np.where(hidden, np.nan, each[some, None] * np.sqrt(value))
            # the first reading is its own reference
            result[some, 0] = np.where(hidden[:, 0], np.nan, 0.0)
    quanta = np.where(
        response.sensor_quantum > 0, np.nan_to_num(each) / np.maximum(response.sensor_quantum, 1e-100), 1.0
    )
    lasting, held = (np.interp(quanta**2, READING, part) for part in (LASTING / READING, HELD))
    baseline = np.maximum(response.edge_row, 0)
    return ReadingError(
        sensor=each,
        lasting=lasting,
        wandering=(1 - lasting) * (1 - held * baseline / (baseline + PULLED_ROWS)),
        gain=gain_of_each,
        weight=weight,
        deviation=deviation,
        change=change,
        reason=reason,
    )


def _variances(
    batch: TrialBatch, response: Response, delay_samples: int, sensor: Floats, known: Booleans
) -> _Variances:
    edge = np.maximum(response.edge_row, 0)
    lag = np.arange(batch.position.shape[1])[None, :]
    take = np.minimum(edge[:, None] + lag, np.maximum(batch.rows - 1, 0)[:, None])
    moved = np.take_along_axis(batch.position, take, axis=1)
    step = np.where(known, batch.step, 1.0)  # a trial without a step has no edge, and is not known
    impulse = np.diff(moved, axis=1, prepend=moved[:, :1]) / step[:, None]
    impulse = np.where(known[:, None] & (lag > delay_samples), impulse, 0.0)
    stiffness, damping = batch.stiffness, batch.damping / batch.sampling_period_s
    weight = -(stiffness[:, None] * impulse + damping[:, None] * np.diff(impulse, axis=1, prepend=0.0))
    weight[:, :1] = 1.0
    # coefficients of three, and four, neighbouring readings in one weight, and in one change of it
    of_weight = (stiffness + damping, -(stiffness + 2 * damping), damping)
    of_change = (stiffness + damping, -(2 * stiffness + 3 * damping), stiffness + 3 * damping, -damping)
    relative = (np.where(known, sensor, 0.0) / step) ** 2
    weight_noise, change_noise = (relative * sum(part**2 for part in parts) for parts in (of_weight, of_change))
    fed_back = np.maximum(lag - delay_samples, 0)
    change = np.diff(weight, axis=1, prepend=0.0)
    # the first column of both is 1: the reading's own error
    answered, answered_change = (
        # a row has the errors of row 1 up to itself
        np.maximum(_one_later(np.cumsum(part**2, axis=1) - 1.0 - added[:, None] * fed_back), 0.0)
        for part, added in ((weight, weight_noise), (change, change_noise))
    )
    # of the first reading: what has not yet been answered of an error that lasts
    kept, kept_change = (1.0 + _one_later(part) ** 2 for part in (np.cumsum(weight, axis=1), weight))
    square = sensor[:, None] ** 2
    gain = _gain_at_rest(batch, response, square * kept, square * answered, known)
    return _Variances(weight, answered, kept, kept_change + answered_change, gain)


def _one_later(values: Floats) -> Floats:
    result: Floats = np.concatenate([np.zeros((len(values), 1)), values[:, :-1]], axis=1)
    return result


def _gain_at_rest(batch: TrialBatch, response: Response, kept: Floats, answered: Floats, known: Booleans) -> Floats:
    """Gain of the variances ``answered`` that with ``kept`` explains the motion at rest, NaN where none, shape (n,)."""
    column = np.arange(batch.position.shape[1])[None, :]
    part = np.maximum((batch.rows - response.edge_row) // LAST_PART, 1)
    distance = (batch.position - response.position_final_expected[:, None]) ** 2
    last = [
        batch.valid
        & (column >= (batch.rows - number * part)[:, None])
        & (column < (batch.rows - (number - 1) * part)[:, None])
        for number in (1, 2, 3)
    ]
    squares = [_mean(distance, some) for some in last]
    own, fed_back = (_mean(variance, last[0]) for variance in (kept, answered))
    # NaN, and so false, where K <= 0
    travel = np.abs(response.position_final_expected - response.position_start)
    rests = known & (np.sqrt(squares[0]) <= LARGEST_REST * travel) & (fed_back > 0)
    rests &= squares[0] >= STAYS**2 * squares[1]
    small = squares[0] <= (REST_FLOORS * response.floor) ** 2
    rests &= small | (squares[0] >= STAYS**2 * squares[2])
    more = rests & (squares[0] > EXCESS**2 * (own + fed_back))
    gain = np.divide(squares[0] - own, fed_back, out=np.ones(len(batch)), where=more)
    result: Floats = np.where(rests, gain, np.nan)
    return result


def _mean(values: Floats, some: Booleans) -> Floats:
    """Mean of some values of each trial, 0 where there are none, shape (n,)."""
    result: Floats = np.where(some, values, 0.0).sum(axis=1) / np.maximum(some.sum(axis=1), 1)
    return result
