"""Estimate the error of each reading, compared with the same trial with an ideal sensor.

A sensor error has two effects. It shifts its own reading, and the wall responds with a force that moves the device.
Both effects can be estimated from the log. The wall force due to an error acts at the same point as the external force,
so the response of the loop to an error follows from its step response.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pipeline.base.compiled import compiled
from pipeline.base.errors import ParameterError
from pipeline.measured.signal.response import Response, RestPositions
from pipeline.measured.signal.verdict import REST_FLOORS
from pipeline.measured.student import NORMAL_QUARTILE
from pipeline.records.criteria import SETTLING_BANDS
from pipeline.records.trials import Floats, Integers, Trial

NOISES = np.linspace(1e-3, 1.0, 200)
"""Values of the noise, relative to the quantum. Above 1, the rounding errors of readings are independent."""

HARMONICS = np.arange(1, 201)[:, None]
"""Harmonics of the sawtooth of rounding. The omitted harmonics contain 0.3 % of its variance."""

READING = NOISES**2 + 1 / 12
"""Variance of the error of a rounded reading [squared quanta], for `NOISES`."""

LASTING = np.sum(np.exp(-((2 * np.pi * HARMONICS * NOISES) ** 2)) / HARMONICS**2, axis=0) / (2 * np.pi**2)
"""Persistent part of the variance `READING` while a device rests, averaged over all positions relative to the grid. It
is not visible at rest."""

LASTING_PART = LASTING / READING
"""Persistent part relative to the variance of the error."""

WANDERING = READING - LASTING
"""Variance of the readings of a device that rests anywhere on the grid [squared quanta]."""

PULLED_ROWS = 25
"""Number of rows after which a wall has pulled half of the chattering devices away from the edge of a quantum, from
simulated baselines of the shipped devices (20 to 200 rows)."""

BLURRED = 0.25
"""Noise relative to the quantum that moves most devices over the next edge in spite of the wall, from the same
simulations as `PULLED_ROWS`."""

HELD = np.exp(-((NOISES / BLURRED) ** 2))
"""Share of `WANDERING` that vanishes when a wall has pulled the device away from an edge, for `NOISES`."""

POOLED = 4.0
"""Largest noise of a baseline, relative to the median or the quantum, that is attributed to the sensor. An estimate
from ten rows scatters by a quarter."""

LAST_PART = 5
"""Number of parts of a response. The motion at rest is evaluated in the last part (a fifth) and in the two parts before
it."""

STAYS = 0.7
"""Smallest motion in the last fifth, relative to the fifth before, for which the motion counts as not decaying. Above
`REST_FLOORS` sensor floors, the same limit is required relative to the fifth before that, since a slow mode may decay
by only 0.7 per fifth (LWR, d = 7)."""

EXCESS = 2.0
"""Smallest motion at rest, relative to the motion due to sensor and weights, that is attributed to further
amplification of errors by the loop. Without jitter, a slow response with two independent values in a fifth exceeds it
by chance in 2 % of the trials."""

LARGEST_REST = max(SETTLING_BANDS.values())
"""Largest motion, relative to the final displacement, that is treated as rest: the widest settling band."""


ERROR_OF_MEDIAN = 1.2533
"""Standard error of the median of normal values, relative to that of their mean (root of pi/2)."""


@dataclass(frozen=True, eq=False)
class ReadingError:
    """Standard errors due to sensor noise and quantum in a log, or NaN if a reason is given.

    Parameters
    ----------
    sensor : float
        Standard deviation of the error of one reading due to noise and quantum [m, rad]; the same for all trials.
    lasting, wandering : float
        Shares of this variance while a device rests: the rounding error that all readings share, and the rest of the
        error of each reading after the wall has pulled the device away from the edge of a quantum.
    gain : float
        Variance of the loop's response to earlier errors, relative to the variance predicted by the weights.
    weight : float64, shape (rows,)
        Response of a reading to an error of 1 m (1 rad) j samples earlier, through the wall; 1 for j = 0, and 0 after
        the end of the log.
    deviation, change : float64, shape (rows,)
        Standard error of each reading relative to the first reading [m, rad], and of its change since the previous
        sample, both compared with the same trial with an ideal sensor.
    reason : str
        Reason why there are no values.
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
    """Return the standard deviation of the error of one reading [m, rad], common to all trials of an experiment.

    Parameters
    ----------
    noise, quantum : float64, shape (n,)
        Noise and quantum of each trial [m, rad], or NaN if unknown. Pooled short baselines are far more accurate than a
        single baseline. The median of different quanta is used, because a trial with little motion does not show the
        quantum.
    rows : int64, shape (n,)
        Number of rows of each baseline. In a longer baseline, the wall hides more of the rounding error.
    """
    seen = np.isfinite(noise) & np.isfinite(quantum)
    if not seen.any():
        return float("nan")
    # Pool the noise, except for baselines moved by a push or chatter. A baseline within one quantum shows no noise.
    square, step = noise[seen] ** 2, float(np.median(quantum[seen])) ** 2
    scatter = float(np.mean(square[square <= POOLED**2 * max(float(np.median(square)), step)]))
    if step > 0:
        # part of noise^2 + quantum^2/12 that is invisible at rest
        pulled = float(np.median(rows[seen] / (rows[seen] + PULLED_ROWS)))
        visible = WANDERING * (1 - pulled * HELD)
        scatter += step * np.interp(scatter / step, visible, np.maximum(READING - visible, 0.0))
    return as_known(float(np.sqrt(scatter)))


def usual_gain(gain: Floats) -> float:
    """Return the gain for trials with an unknown gain: the median of the known gains, or 1 if there are none."""
    finite = gain[np.isfinite(gain)]
    if not len(finite):
        return 1.0
    usual = float(np.median(finite))
    scatter = float(np.median(np.abs(finite - usual))) / NORMAL_QUARTILE
    return as_known(usual, ERROR_OF_MEDIAN * scatter / math.sqrt(len(finite)))


def as_known(value: float, error: float | None = None) -> float:
    """Return a value rounded to between an eighth and a quarter of its error, or to three digits without an error.

    Values on which all trials depend are rounded. An additional log of n changes such a value by its error divided by
    the root of n, so the results of the other trials seldom change. Rounding to a quarter of the error increases it by
    0.3 %.

    >>> as_known(0.58013, 0.0003), as_known(0.123456)
    (0.58013916015625, 0.123)
    """
    scale = value if error is None else error
    if not np.isfinite(scale) or scale <= 0:
        return value
    if error is None:
        return round(value, 2 - math.floor(math.log10(scale)))
    step = 2.0 ** (math.floor(math.log2(error)) - 2)
    return round(value / step) * step


def gain_at_rest(trial: Trial, response: Response | RestPositions, delay_samples: int, sensor: float) -> float:
    """Return the gain from the motion at the end of a trial, or NaN if the trial is not at rest there.

    Parameters
    ----------
    trial, response, delay_samples
        As in `reading_error`.
    sensor : float
        Standard deviation of the error of one reading [m, rad] (see `sensor_error`).
    """
    if response.edge_row < 0 or trial.step == 0 or not np.isfinite(sensor):
        return float("nan")
    return _gain_at_rest(trial, response, sensor, _answers_of(trial, response, delay_samples, sensor)[1])


def reading_error(
    trial: Trial, response: Response, delay_samples: int = 0, *, sensor: float, gain: float = 1.0
) -> ReadingError:
    """Return the standard error of each reading, compared with the same trial with an ideal sensor.

    Parameters
    ----------
    trial : Trial
    response : Response
        Response of this trial.
    delay_samples : int
        Integer delay factor, before which no feedback is possible. If it is too small (0 if unknown), the noise of a
        few more samples is treated as a response.
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
    Let h_j be the response of the position to a force of 1 N for one sample, i.e. the differences of the step response
    in the log divided by F_0. An error e_i of reading i shifts reading i + j by c_j e_i, with c_0 = 1 and
    c_j = -(K h_j + B (h_j - h_{j-1})/T). The first reading is the rest position of the wall. Its error shifts all later
    readings by a constant. The variance is the sum of squares. The weights are also noisy, which adds a known variance
    to each square; this variance is subtracted.

    All trials of an experiment are assumed to have the same sensor error. It is the pooled variance of their baselines
    plus the part of noise and rounding that is invisible at rest. Errors are assumed to be independent between
    readings. They are dependent if the device moves by less than a quantum per sample. If the quantum is a tenth of the
    final displacement, the weights are mostly noise.

    The loop may respond more strongly than its step response shows. If the delay jitters, the forces of two successive
    errors no longer cancel (Falcon, 3 to 5 samples: 4 to 7 times the deviation). This is visible in the motion at rest
    at the end of the log, which neither decays (`STAYS`) nor reaches `LARGEST_REST`. If this motion exceeds the
    expected motion by a factor of `EXCESS`, the part of the error that acts through the wall is scaled accordingly.
    Trials that have not come to rest use the median gain of the other trials. Two standard errors then cover 94 to 99 %
    of the readings of simulated Falcon trials (2 and 10 um quantum, noise of 0 to 1 um), 90 to 92 % with jitter, and 86
    % at 60 um.

    Direct effects of jitter, friction and force limits on the response are not included, since the reference is the
    same trial.

    Source: Hulin 2017, eq. 3.18 (wall force, here due to the error of the sensor).
    """
    if delay_samples < 0:
        raise ParameterError(f"delay of {delay_samples} samples: expected an integer >= 0.")
    edge, quantum, nothing = response.edge_row, response.sensor_quantum, np.full(trial.rows, np.nan)
    if edge < 0 or trial.step == 0 or not np.isfinite(sensor):
        reason = f"no start of the response: {response.edge_reason or 'the step is 0'}"
        if edge >= 0 and trial.step != 0:
            reason = "the sensor noise is unknown: all trials have too few rows before the step"
        return ReadingError(np.nan, np.nan, np.nan, np.nan, nothing, nothing, nothing, reason)
    (weight, kept, answered, change), at_end = _answers_of(trial, response, delay_samples, sensor)
    at_rest = _gain_at_rest(trial, response, sensor, at_end)
    gain = gain if math.isnan(at_rest) else at_rest
    # slow motion hardly contributes to the changes from reading to reading
    deviation = sensor * np.sqrt(kept + gain * answered)
    change = sensor * np.sqrt(change)
    # the first reading is its own reference, so its error is 0
    deviation[0] = change[0] = 0.0
    quanta = sensor / quantum if quantum > 0 else 1.0
    lasting, hidden = (float(np.interp(quanta * quanta, READING, part)) for part in (LASTING_PART, HELD))
    wandering = (1 - lasting) * (1 - hidden * edge / (edge + PULLED_ROWS))
    return ReadingError(sensor, lasting, wandering, gain, weight, deviation, change)


def _answers_of(
    trial: Trial, response: Response | RestPositions, delay_samples: int, sensor: float
) -> tuple[Floats, Floats]:
    final = response.position_final_expected
    x = (trial.position - (response.position_start if math.isnan(final) else final)) / trial.step
    damping = trial.damping / trial.sampling_period_s
    return _answers(x, response.edge_row, trial.stiffness, damping, delay_samples, sensor / trial.step)


@compiled("Tuple((f8[:, ::1], f8[::1]))(f8[::1], i8, f8, f8, i8, f8)")
def _answers(x: Floats, edge: int, K: float, B: float, d: int, sigma: float) -> tuple[Floats, Floats]:
    """Return the effects of reading errors through the wall, shape (4, rows), and means at the end, shape (5,).

    ``x`` (rows,) are the positions relative to the final position, divided by the step [m/N, 1/Nm]. ``K`` and ``B`` are
    stiffness and damping per sample [N/m, Nm/rad], ``d`` is the delay [samples], and ``sigma`` is the error of a
    reading divided by the step. Row 0 of the first result contains the weights. With h_j = x_{e+j} - x_{e+j-1} for j >
    d, else 0, and the row e of the command edge,

        c_0 = 1,    c_j = -(K h_j + B (h_j - h_{j-1})).

    Rows 1 to 3 contain variances of reading k, relative to the variance of a reading error. Row 1 is due to its own
    error and the persistent error of the first reading, 1 + (sum_{j<k} c_j)^2. Row 2 is due to the responses to the
    errors in between, sum_{0<j<k} c_j^2. Row 3 is the variance of the change of the reading,
    1 + c_{k-1}^2 + sum_{0<j<k} (c_j - c_{j-1})^2. The contribution of noise to the squares is subtracted. The means are
    the means of x^2 in the last, second to last and third to last fifth, followed by the means of rows 1 and 2 in the
    last fifth.

    Source: Hulin 2017, eq. 3.18 (wall force, here due to the error of the sensor).
    """
    rows = len(x)
    result, means = np.empty((4, rows)), np.zeros(5)
    # coefficients of the neighbouring readings in a weight (three) and in the change of a weight (four)
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


def _gain_at_rest(trial: Trial, response: Response | RestPositions, sensor: float, at_end: Floats) -> float:
    """Return the gain that explains the motion at rest, or NaN if the device is not at rest.

    ``at_end`` is a result of `_answers`.
    """
    last, before, first = (float(mean) * trial.step**2 for mean in at_end[:3])
    kept, fed_back = (float(mean) * sensor**2 for mean in at_end[3:])
    travel = abs(response.position_final_expected - response.position_start)
    # comparisons with NaN are false, so that there is no rest if K <= 0
    rests = last <= (LARGEST_REST * travel) ** 2 and fed_back > 0 and last >= STAYS**2 * before
    if not rests or (last > (REST_FLOORS * response.floor) ** 2 and last < STAYS**2 * first):
        return float("nan")
    return (last - kept) / fed_back if last > EXCESS**2 * (kept + fed_back) else 1.0
