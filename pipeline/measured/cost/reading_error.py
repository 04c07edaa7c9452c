"""How far each reading may lie from what an ideal sensor would have shown in the same trial.

A sensor error does two things: it shifts its own reading, and the wall answers it with a force that moves the
device. Both are in the log, and both can be estimated from the log alone: the wall's answer to an error enters where
the external force does, so that the step response itself is the answer of the loop to it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pipeline.base.compiled import compiled
from pipeline.base.errors import ParameterError
from pipeline.measured.signal.response import Response
from pipeline.measured.signal.verdict import REST_FLOORS
from pipeline.records.criteria import SETTLING_BANDS
from pipeline.records.trials import Floats, Integers, Trial

NOISES = np.linspace(1e-3, 1.0, 200)
"""Noise relative to the quantum: with more of it the rounding is independent from reading to reading."""

HARMONICS = np.arange(1, 201)[:, None]
"""Harmonics of the sawtooth of rounding, those left out have 0.3 % of its variance."""

READING = NOISES**2 + 1 / 12
"""Variance of the error of a rounded reading [squared quanta], for `NOISES`."""

LASTING = np.sum(np.exp(-((2 * np.pi * HARMONICS * NOISES) ** 2)) / HARMONICS**2, axis=0) / (2 * np.pi**2)
"""Part of it that lasts while a device rests, as the mean over all places on the grid, and so is not seen there."""

LASTING_PART = LASTING / READING
"""The same relative to the variance of the error."""

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
"""Motion at rest relative to that by sensor and weights, from which on the loop answers by more: without jitter that
of a slow response, which has two independent values in a fifth, is larger by chance in 2 % of the trials."""

LARGEST_REST = max(SETTLING_BANDS.values())
"""Motion relative to the final displacement up to which it may be rest: the widest settling band."""


@dataclass(frozen=True, eq=False)
class ReadingError:
    """Standard errors that sensor noise and quantum leave in a log; NaN where there is a reason.

    Parameters
    ----------
    sensor : float
        Standard deviation of the error of one reading [m, rad], noise and quantum; the same for all trials.
    lasting, wandering : float
        Parts of its variance while a device rests: of the rounding, which all readings share, and what is left to each
        reading after the wall has pulled the device away from the edge of a quantum.
    gain : float
        Variance of what the loop made of earlier errors, relative to that by the weights.
    weight : float64, shape (rows,)
        Answer of a reading to an error of 1 m (1 rad) j samples before, as the wall feeds it back: 1 for
        j = 0, 0 behind the end of the log.
    deviation, change : float64, shape (rows,)
        Standard error of each reading relative to the first one [m, rad], and of its change since the sample
        before, both against the same trial with an ideal sensor.
    reason : str
        Why there is no value.
    """

    sensor: float
    lasting: float
    wandering: float
    gain: float
    weight: Floats
    deviation: Floats
    change: Floats
    reason: str = ""


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
    """Return the gain for trials whose gain is unknown: the median of the others; 1 without any."""
    finite = gain[np.isfinite(gain)]
    return as_known(float(np.median(finite))) if len(finite) else 1.0


def as_known(value: float, error: float | None = None) -> float:
    """Return a value in three digits more than its error has, or a spread in its own first three.

    Values that all trials depend on are rounded so: one more log, which moves them by far less than their error,
    leaves the results of the others as they are.
    """
    scale = value if error is None else error
    if not np.isfinite(scale) or scale <= 0:
        return value
    return round(value, 2 - int(np.floor(np.log10(scale))) + (error is not None))


def gain_at_rest(trial: Trial, response: Response, delay_samples: int, sensor: float) -> float:
    """Return the gain that the motion at the end of a trial shows, NaN where it is not at rest.

    Parameters
    ----------
    trial, response, delay_samples
        As in `reading_error`.
    sensor : float
        Standard deviation of the error of one reading [m, rad], see `sensor_error`.
    """
    if response.edge_row < 0 or trial.step == 0 or not np.isfinite(sensor):
        return float("nan")
    return _gain_at_rest(trial, response, sensor, _answers_of(trial, response, delay_samples, sensor)[1])


def reading_error(
    trial: Trial, response: Response, delay_samples: int = 0, *, sensor: float, gain: float = 1.0
) -> ReadingError:
    """Return the standard error of each reading against the same trial with an ideal sensor.

    Parameters
    ----------
    trial : Trial
    response : Response
        Of this trial.
    delay_samples : int
        Integer delay factor, up to which nothing can be fed back; a smaller one (0 where none is known) does no
        harm but takes the noise of some more samples for an answer.
    sensor, gain : float
        `sensor_error` and `usual_gain` of the experiment.

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

    The loop may answer by more than its step response shows: where the delay jitters, the forces of two successive
    errors no longer cancel (Falcon, 3 to 5 samples: 4 to 7 times the deviation). That is seen in the motion at
    rest at the end of the log, where it neither decays (`STAYS`) nor is as large as `LARGEST_REST`; the fed back
    part is scaled to it, where it is `EXCESS` times the expected one. Trials that have not come to rest take the median
    gain of the others. Two standard errors then cover 94 to 99 % of the readings of simulated Falcon trials
    (2 and 10 um quantum, noise of 0 to 1 um), 90 to 92 % with jitter, and 86 % at 60 um.

    What jitter itself does to the response, friction and force limits are not included: the truth is the same trial.

    Source: Hulin 2017, eq. 3.18 (the wall force, here driven by the error of the sensor).
    """
    if delay_samples < 0:
        raise ParameterError(f"delay of {delay_samples} samples: expected an integer >= 0.")
    edge, quantum, nothing = response.edge_row, response.sensor_quantum, np.full(trial.rows, np.nan)
    if edge < 0 or trial.step == 0 or not np.isfinite(sensor):
        reason = f"no start of the response: {response.edge_reason or 'the step is 0'}"
        if edge >= 0 and trial.step != 0:
            reason = "noise of the sensor not known: too few rows before the step in all trials"
        return ReadingError(np.nan, np.nan, np.nan, np.nan, nothing, nothing, nothing, reason)
    (weight, kept, answered, change), at_end = _answers_of(trial, response, delay_samples, sensor)
    at_rest = _gain_at_rest(trial, response, sensor, at_end)
    gain = gain if math.isnan(at_rest) else at_rest
    # slow motion, which hardly adds to the changes from reading to reading
    deviation = sensor * np.sqrt(kept + gain * answered)
    change = sensor * np.sqrt(change)
    # the first reading is its own reference
    deviation[0] = change[0] = 0.0
    quanta = sensor / quantum if quantum > 0 else 1.0
    lasting, hidden = (float(np.interp(quanta * quanta, READING, part)) for part in (LASTING_PART, HELD))
    wandering = (1 - lasting) * (1 - hidden * edge / (edge + PULLED_ROWS))
    return ReadingError(sensor, lasting, wandering, gain, weight, deviation, change)


def _answers_of(trial: Trial, response: Response, delay_samples: int, sensor: float) -> tuple[Floats, Floats]:
    final = response.position_final_expected
    x = (trial.position - (response.position_start if math.isnan(final) else final)) / trial.step
    damping = trial.damping / trial.sampling_period_s
    return _answers(x, response.edge_row, trial.stiffness, damping, delay_samples, sensor / trial.step)


@compiled("Tuple((f8[:, ::1], f8[::1]))(f8[::1], i8, f8, f8, i8, f8)")
def _answers(x: Floats, edge: int, K: float, B: float, d: int, sigma: float) -> tuple[Floats, Floats]:
    """Return what the wall makes of errors of the readings, shape (4, rows), and means at the end, shape (5,).

    ``x`` (rows,) are the positions from the final one over the step [m/N, 1/Nm], ``K`` and ``B`` stiffness and damping
    per sample [N/m, Nm/rad], ``d`` the delay [samples], ``sigma`` the error of a reading over the step. Row 0 of the
    first result are the weights: with h_j = x_{e+j} - x_{e+j-1} for j > d, else 0, e the row of the command edge,

        c_0 = 1,    c_j = -(K h_j + B (h_j - h_{j-1})).

    The others are variances of reading k in squared errors of a reading: its own error and that of the first reading,
    which lasts, 1 + (sum_{j<k} c_j)^2; the answers to the errors in between, sum_{0<j<k} c_j^2; and the change of the
    reading, 1 + c_{k-1}^2 + sum_{0<j<k} (c_j - c_{j-1})^2. Less what noise adds to the squares. The means are those of
    x^2 in the last fifth of the response and in two more before it, then those of the first two variances in the last.

    Source: Hulin 2017, eq. 3.18 (the wall force, here driven by the error of the sensor).
    """
    rows = len(x)
    result, means = np.empty((4, rows)), np.zeros(5)
    # coefficients of three, and four, neighbouring readings in one weight, and in one change of it
    of_weight = sigma**2 * ((K + B) ** 2 + (K + 2 * B) ** 2 + B**2)
    of_change = sigma**2 * ((K + B) ** 2 + (2 * K + 3 * B) ** 2 + (K + 3 * B) ** 2 + B**2)
    part = max((rows - edge) // LAST_PART, 1)
    h, c, total, squares, changes = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(rows):
        noisy = max(k - 1 - d, 0)
        result[1, k] = 1 + total**2
        result[2, k] = max(squares - 1 - of_weight * noisy, 0.0)
        result[3, k] = 1 + c**2 + max(changes - 1 - of_change * noisy, 0.0)
        h_before, c_before = h, c
        h = x[edge + k] - x[edge + k - 1] if d < k < rows - edge else 0.0
        c = 1.0 if k == 0 else -(K * h + B * (h - h_before))
        result[0, k] = c
        total += c
        squares += c**2
        changes += (c - c_before) ** 2
        fifth = (rows - 1 - k) // part
        if fifth < 3:
            means[fifth] += x[k] ** 2 / min(part, rows - fifth * part)
        if fifth == 0:
            means[3] += result[1, k] / part
            means[4] += result[2, k] / part
    return result, means


def _gain_at_rest(trial: Trial, response: Response, sensor: float, at_end: Floats) -> float:
    """Gain of the answers that explains the motion at rest, NaN where it is none; ``at_end`` as of `_answers`."""
    last, before, first = (float(mean) * trial.step**2 for mean in at_end[:3])
    kept, fed_back = (float(mean) * sensor**2 for mean in at_end[3:])
    travel = abs(response.position_final_expected - response.position_start)
    # NaN, and so false, where K <= 0
    rests = last <= (LARGEST_REST * travel) ** 2 and fed_back > 0 and last >= STAYS**2 * before
    if not rests or (last > (REST_FLOORS * response.floor) ** 2 and last < STAYS**2 * first):
        return float("nan")
    return (last - kept) / fed_back if last > EXCESS**2 * (kept + fed_back) else 1.0
