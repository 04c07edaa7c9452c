"""Compute settling time, overshoot and rise time of recorded step responses, with intervals for the reading errors.

Cost index 0 is the row k0 + d. The response starts at the command edge k0, and the command reaches the device after d
samples. Each cost uses only the quantities that it needs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.measured.cost.reading_error import ReadingError
from pipeline.measured.signal.response import SETTLED_SAMPLES, Response, reach
from pipeline.measured.signal.verdict import Verdict
from pipeline.measured.student import CONFIDENCE, NORMAL_95
from pipeline.records.criteria import OVERSHOOT, RISE_LEVELS, SETTLING_BANDS, Criterion
from pipeline.records.stage_records import CostRow, OtherCostRow, OvershootRow, RiseRow, SettlingRow
from pipeline.records.trials import Floats, Trial

TAIL = 0.5 * (1 - CONFIDENCE)
"""Probability of a value beyond each end of an interval."""


@dataclass(frozen=True)
class Cost:
    """Cost of a trial with its 95 % interval. The value is NaN, with a reason, if the trial has no cost.

    ``low`` and ``high`` are also NaN if the reading errors are missing or unknown.
    """

    value: float = np.nan
    low: float = np.nan
    high: float = np.nan
    reason: str = ""


def joined(*reasons: str) -> str:
    """Join the distinct reasons. The result is empty if there are none."""
    return "; ".join(dict.fromkeys(text for text in reasons if text))


def cost_start(trial: Trial, response: Response, verdict: Verdict, delay_samples: int) -> tuple[int, str]:
    """Return the row of cost index 0, and the reason why a trial has no cost (empty if it has a cost).

    Parameters
    ----------
    trial : Trial
    response, verdict : Response, Verdict
        Of this trial.
    delay_samples : int
        Integer delay factor d of the experiment.

    Raises
    ------
    ParameterError
        If the delay is negative.

    Source: Hulin 2017, sec. 6.1.4 (first d samples dropped).
    """
    if delay_samples < 0:
        raise ParameterError(f"delay of {delay_samples} samples: expected an integer >= 0.")
    first, stiffness = max(response.edge_row, 0) + delay_samples, trial.stiffness
    if verdict.verdict == "unstable":
        return first, "unstable: no cost"
    if response.edge_row < 0 or trial.step == 0:
        return first, f"no start of the response: {response.edge_reason or 'the step is 0'}"
    if stiffness <= 0:
        return first, f"no final position: x_0 + F_0/K needs K > 0, found K = {stiffness:g}"
    if response.position_final_expected == response.position_start:
        travel = trial.step / stiffness
        return first, f"no final displacement: F_0/K = {travel:.3g} is lost in the rounding of the rest position"
    if first >= trial.rows:
        return first, f"the log of {trial.rows} rows ends before the command takes effect in row {first}"
    return first, ""


def delay_bounds(delay_samples: int, delay_range: tuple[int, int] | None) -> tuple[int, int]:
    """Return the smallest and largest integer delay factor. Both equal the delay if no range is given.

    Raises
    ------
    ParameterError
        If the range does not contain the delay, or is negative.
    """
    low, high = (delay_samples, delay_samples) if delay_range is None else delay_range
    if not 0 <= low <= delay_samples <= high:
        raise ParameterError(
            f"range of the delay {low} to {high} samples: expected 0 <= low <= {delay_samples} <= high, "
            "where the number in the middle is the delay used for the cost."
        )
    return low, high


@dataclass(frozen=True, eq=False)
class _Readings:
    """Readings of a trial, starting at cost index 0, shape (rows,).

    ``offset`` is the distance from the final position, and ``deviation`` its standard error. ``deviation`` is None if
    it is unknown; ``reason`` then states why, if there is a reason.
    """

    first: int
    final: float
    travel: float
    offset: Floats
    deviation: Floats | None
    reason: str = ""


def _readings(
    trial: Trial, response: Response, verdict: Verdict, delay_samples: int, error: ReadingError | None
) -> _Readings | Cost:
    """Return the readings from which a cost is computed. If there is no cost, return a cost with the reason."""
    first, reason = cost_start(trial, response, verdict, delay_samples)
    if reason:
        return Cost(reason=reason)
    final, reason = response.position_final_expected, "" if error is None else error.reason
    deviation = None if error is None or reason else error.deviation[first:]
    return _Readings(first, final, final - response.position_start, trial.position[first:] - final, deviation, reason)


def settling(
    trial: Trial,
    response: Response,
    verdict: Verdict,
    delay_samples: int,
    error: ReadingError | None = None,
    *,
    delay_range: tuple[int, int] | None = None,
    bands: Mapping[str, float] = SETTLING_BANDS,
) -> dict[str, Cost]:
    """Return the discrete settling time by criterion: the smallest k from which all samples are inside the band.

    Parameters
    ----------
    trial : Trial
    response, verdict : Response, Verdict
        Response and verdict of this trial.
    delay_samples : int
        Integer delay factor d of the experiment.
    error : ReadingError, optional
        Reading errors of this trial. Without them, the costs have no interval.
    delay_range : tuple of int, optional
        Smallest and largest integer delay factor compatible with the experiment.
    bands : mapping of str to float
        Half-widths of the bands relative to the final displacement, with criteria as keys.

    Raises
    ------
    ParameterError
        If the delay is negative, or outside its range.

    Notes
    -----
    The band is centred at x_0 + F_0/K, not at the last sample. There is no settling time for a band narrower than the
    effect of quantum and noise. The ends of the interval are the settling times for a band that is wider or narrower by
    the error of one reading, because only the last reading outside the band decides. A larger delay shifts cost index 0
    and thus shortens the settling time. There is no upper end if the motion may leave the band after the end of the log
    (`reach`).

    Source: Hulin 2017, secs. 5.1.1 and 6.1.4 (discrete settling time, first d samples dropped).
    """
    low, high = delay_bounds(delay_samples, delay_range)
    readings = _readings(trial, response, verdict, delay_samples, error)
    if isinstance(readings, Cost):
        return dict.fromkeys(bands, readings)
    rows, size, deviation = len(readings.offset), np.abs(readings.offset), readings.deviation
    growth = verdict.growth_per_s * trial.sampling_period_s
    costs = {}
    for name, band in bands.items():
        width = band * abs(readings.travel)
        settled = _settled(size, width)
        text = ""
        if width < response.floor:
            text = f"band of {width:.3g} is below the sensor floor {response.floor:.3g}"
        elif rows - settled < SETTLED_SAMPLES:
            text = "not settled at the end of the log"
        if text or deviation is None:
            prefix = f"{name}: " if text and not readings.reason else ""
            costs[name] = Cost(np.nan if text else settled, reason=prefix + (text or readings.reason))
            continue
        soonest, latest = (_settled(size, width + shift * deviation) for shift in (NORMAL_95, -NORMAL_95))
        entry = readings.first + latest
        far, off = reach(trial, readings.final, readings.first, entry, growth, float(deviation[-1]))
        stays = far <= width + NORMAL_95 * off and rows - latest >= SETTLED_SAMPLES
        costs[name] = Cost(
            settled,
            max(soonest - (high - delay_samples), 0),
            latest + (delay_samples - low) if stays else np.nan,
            "" if stays else f"{name}: the motion may leave the band again after the end of the log",
        )
    return costs


def _settled(size: Floats, width: float | Floats) -> int:
    """Return the index after the last reading outside a band."""
    outside = np.flatnonzero(size > width)
    return int(outside[-1]) + 1 if len(outside) else 0


def overshoot_floor(trial: Trial, response: Response) -> float:
    """Return the apparent overshoot due to quantum, noise and motion before the step, or 0 without wall or step."""
    if trial.stiffness <= 0 or trial.step == 0:
        return 0.0
    return (response.floor + response.baseline_motion) / abs(trial.step / trial.stiffness)


def overshoot(trial: Trial, response: Response, verdict: Verdict, error: ReadingError | None = None) -> Cost:
    """Return the overshoot over the whole response, max(0, max (x - x_inf)/(x_inf - x_0)).

    Parameters
    ----------
    trial : Trial
    response, verdict : Response, Verdict
        Response and verdict of this trial.
    error : ReadingError, optional
        Reading errors of this trial. Without them, the cost has no interval.

    Notes
    -----
    Neither delay nor mass is needed. The largest of many noisy readings exceeds the largest true position. The upper
    bound follows from the error of the largest reading. The lower bound follows from the largest error of all readings
    that may be the largest, i.e. readings within twice that error of the largest reading. Motion after the end of the
    log is bounded by `reach`. If the interval begins at 0, there may be no overshoot.

    Source: Hulin 2017, sec. 5.1.1; the tolerance 1e-12 of "no overshoot" is from footnote 4 of 5.2.2.
    """
    readings = _readings(trial, response, verdict, 0, error)
    if isinstance(readings, Cost):
        return readings
    relative, size = readings.offset / readings.travel, abs(readings.travel)
    peak = int(np.argmax(relative))
    largest = float(relative[peak])
    if readings.deviation is None:
        return Cost(max(largest, 0.0), reason=readings.reason)
    spread, late = float(readings.deviation[peak]) / size, float(readings.deviation[-1])
    everywhere = _quantile(TAIL / len(relative))
    rivals = int((relative >= largest - 2 * everywhere * spread).sum())
    last = max(trial.rows - SETTLED_SAMPLES, readings.first)
    growth = verdict.growth_per_s * trial.sampling_period_s
    far, off = reach(trial, readings.final, readings.first, last, growth, late)
    low = largest - _quantile(TAIL / rivals) * spread
    high = max(largest, (far - everywhere * off) / size) + NORMAL_95 * spread
    return Cost(max(largest, 0.0), max(low, 0.0), max(high, OVERSHOOT.none))


def _quantile(chance: float) -> float:
    """Return the standard normal deviate that is exceeded with the given probability."""
    return -NormalDist().inv_cdf(chance)


def rise_time(trial: Trial, response: Response, verdict: Verdict, error: ReadingError | None = None) -> Cost:
    """Return the rise time [samples] from 10 to 90 % of the final displacement, with interpolated readings."""
    readings = _readings(trial, response, verdict, 0, error)
    if isinstance(readings, Cost):
        return readings
    size = abs(readings.travel)
    share, (low, high) = 1 + readings.offset / readings.travel, RISE_LEVELS
    if low * size < response.floor:
        text = f"rise_time: {low:.0%} of the final displacement lies below the sensor floor"
        return Cost(reason=joined(readings.reason, text))
    begin, end = _reached(share, low), _reached(share, high)
    if np.isnan(end):
        text = f"rise_time: {high:.0%} of the final displacement is not reached by the end of the log"
        return Cost(reason=joined(readings.reason, text))
    if readings.deviation is None:
        return Cost(end - begin, reason=readings.reason)
    margin = NORMAL_95 * readings.deviation / size
    (soonest_begin, soonest_end), (latest_begin, latest_end) = (
        [_reached(shifted, level) for level in RISE_LEVELS] for shifted in (share + margin, share - margin)
    )
    shortest = end - begin - np.hypot(end - soonest_end, latest_begin - begin)
    longest = end - begin + np.hypot(latest_end - end, begin - soonest_begin)
    late = f"rise_time: within the reading error, {high:.0%} may not be reached by the end of the log"
    return Cost(end - begin, float(np.fmax(shortest, 0.0)), float(longest), late if np.isnan(longest) else "")


def _reached(share: Floats, level: float) -> float:
    """Return the interpolated index at which a share is first reached, or NaN if it is never reached."""
    index = int(np.argmax(share >= level))
    if share[index] < level:
        return np.nan
    if index == 0:
        return 0.0
    before, after = float(share[index - 1]), float(share[index])
    return index - 1 + (level - before) / (after - before)


@dataclass(frozen=True)
class ReadingInputs:
    """Inputs of the reading errors of a trial that are common to all trials of the experiment.

    Parameters
    ----------
    delay : int
        Number of samples before any feedback takes effect.
    sensor : float, optional
        Standard deviation of the error of one reading [m, rad], or None if unknown.
    gain : float
        `usual_gain` of the trials.
    spring : float
        Stiffness k [N/m, Nm/rad] that acts on the device.
    final : {"expected", "measured"}
        As in `Measuring`.
    """

    delay: int
    sensor: float | None
    gain: float
    spring: float
    final: str = "expected"


@dataclass(frozen=True)
class CostInputs:
    """Inputs of the costs of a trial that are common to all trials of the experiment.

    Parameters
    ----------
    readings : ReadingInputs
    delay_range : tuple of int, optional
        Smallest and largest integer delay factor, for costs counted from the end of the delay.
    mass, mass_error : float
        Effective mass or inertia at the wall, and its standard error [kg, kg m^2], or 0 for costs that do not need it.
    """

    readings: ReadingInputs
    delay_range: tuple[int, int] | None = None
    mass: float = 0.0
    mass_error: float = 0.0


Measure = Callable[[Trial, Response, Verdict, ReadingError, CostInputs], CostRow]
"""Function that computes the stored costs of one family from a trial's response, verdict and reading error."""


def _columns(costs: Mapping[str, Cost]) -> dict[str, float]:
    """Return the stored columns of costs, with column names as keys."""
    return {
        f"{name}{end}": value
        for name, cost in costs.items()
        for end, value in (("", cost.value), ("_low", cost.low), ("_high", cost.high))
    }


def settling_row(
    trial: Trial, response: Response, verdict: Verdict, error: ReadingError, inputs: CostInputs
) -> SettlingRow:
    """Return the settling times of a trial in stored form."""
    costs = settling(trial, response, verdict, inputs.readings.delay, error, delay_range=inputs.delay_range)
    return SettlingRow(**_columns(costs), reason=joined(*(cost.reason for cost in costs.values())))


def other_settling(
    trial: Trial,
    response: Response,
    verdict: Verdict,
    error: ReadingError,
    inputs: CostInputs,
    *,
    criterion: Criterion,
) -> OtherCostRow:
    """Return the settling time of a trial for a band without a stored column."""
    bands, d = {criterion.name: criterion.band or 0.0}, inputs.readings.delay
    (cost,) = settling(trial, response, verdict, d, error, delay_range=inputs.delay_range, bands=bands).values()
    return OtherCostRow(cost.value, cost.low, cost.high, cost.reason)


def overshoot_row(
    trial: Trial, response: Response, verdict: Verdict, error: ReadingError, _: CostInputs
) -> OvershootRow:
    """Return the overshoot of a trial in stored form."""
    cost = overshoot(trial, response, verdict, error)
    return OvershootRow(cost.value, cost.low, cost.high, overshoot_floor(trial, response), cost.reason)


def rise_row(trial: Trial, response: Response, verdict: Verdict, error: ReadingError, _: CostInputs) -> RiseRow:
    """Return the rise time of a trial in stored form."""
    cost = rise_time(trial, response, verdict, error)
    return RiseRow(cost.value, cost.low, cost.high, cost.reason)
