"""The output of all readers, a checked log in SI, and the regularity of its time stamps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from hashlib import sha256

import numpy as np

from pipeline.base.errors import LogError, refusal
from pipeline.device.parameters import is_rotation
from pipeline.recording.check import check_recording, check_recordings
from pipeline.recording.samples import Samples
from pipeline.recording.timing import MISSING
from pipeline.recording.wrapping import unwrapped
from pipeline.records.findings import Finding
from pipeline.records.native import OF_WALL, NativeHeader
from pipeline.records.trials import Booleans, Floats, Integers

GAP = 30.0
"""Threshold above which a reading is an outlier. It is a ratio of distances from the median of the log: the distance of
the reading is divided by the next smaller distance, or by the trimmed range of the readings if that is larger. An
unstable loop that grows tenfold in each sample has a ratio of 10.
"""

LARGEST = {"time": 1e12, "command": 1e7, "position": 1e5, "force": 1e7, "velocity": 1e6}
"""Largest magnitude of a reading [SI].

Larger values (above 100 km or 16,000 turns, 1,000 t, 1,000 km/s) are codes for missing values, such as 1e20 or 3.4e38,
or numbers in a different unit. A single such cell would corrupt all results of a device.
"""

LARGEST_CONDITION = 1e12
"""Largest stiffness, damping and step [SI]. A metre of steel has 1e11 N/m."""

SMALLEST_CONDITION = 1e-30
"""Smallest nonzero stiffness, damping and step [SI].

This is far below any real value, and its square does not underflow.
"""

PERIODS = (1e-9, 1e6)
"""Shortest and longest sampling period [s], which correspond to 1 GHz and ten days."""

_LARGE = (
    "If this number marks a missing value, declare it by `sentinels`. Otherwise, correct the unit or repair the row."
)

OUTSIDE = 20
"""Reciprocal of the fraction of readings (1/20) that are trimmed at either end before the range is computed, so that a
few outliers do not change the range.
"""

LONGEST_PAUSE = 1e6
"""Largest factor by which the longest time between two rows may exceed the sampling period or fall below it.

A response sampled at 1 kHz has no pause of minutes, and rows at intervals of 1 ms have no sampling period of minutes.
"""


@dataclass(frozen=True)
class RawLog:
    """The bytes of a log, which is a file or a pair of files."""

    names: tuple[str, ...]
    data: tuple[bytes, ...]


@dataclass(frozen=True, eq=False)
class Log:
    """Step response, with its conditions, and time [s], command [N, Nm] and position [m, rad] of shape (rows,).

    Parameters
    ----------
    header : NativeHeader
    time, command, position : float64, shape (rows,)
    force, velocity : float64, shape (rows,), optional
        Measured force [N, Nm] and logged velocity [m/s, rad/s], if the log has them.
    raw_time : float64 or int64, shape (rows,), optional
        Time stamps as in the file, or None if they equal ``time``.
    counts : mapping of str to int
        Number of repaired rows by kind. Kinds are for example counter wraps and rows out of order.
    warnings : tuple of str
        Irregularities that were accepted.
    label : str, optional
        Name of the trial in its file, if the file has several trials.
    noted : tuple of Finding
        Findings from reading: repairs of the samples, and other files with the same samples.
    """

    header: NativeHeader
    time: Floats
    command: Floats
    position: Floats
    force: Floats | None = None
    velocity: Floats | None = None
    raw_time: Floats | Integers | None = None
    counts: Mapping[str, int] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    label: str | None = None
    noted: tuple[Finding, ...] = ()

    @cached_property
    def samples_sha256(self) -> str:
        """Hash of commands and positions, which does not depend on header and time stamps."""
        joined = sha256()
        for values in (self.command, self.position):
            joined.update(np.ascontiguousarray(values).data)
        return joined.hexdigest()

    def with_warning(self, header: NativeHeader, warning: str) -> Log:
        """Return the log with a different header that states the same conditions, and with an additional warning.

        Findings are kept.
        """
        log = replace(self, header=header, warnings=(*self.warnings, warning))
        log.__dict__["findings"] = self.findings
        return log

    @property
    def recording(self) -> Samples:
        """The samples of the log, with the conditions that checks need."""
        header = self.header
        row = header.extra.get("step_row")
        return Samples(
            *(self.time, self.command, self.position, header.sampling_period_s),
            *(header.stiffness, header.damping, header.step, None if row is None else int(row)),
            motion=header.motion,
        )

    @cached_property
    def findings(self) -> tuple[Finding, ...]:
        """Faults of the recording, found while reading or in the samples."""
        return (*self.noted, *check_recording(self.recording))


def find_together(logs: Sequence[Log]) -> None:
    """Find the faults of many logs together, and store the faults in each log.

    Parameters
    ----------
    logs : sequence of Log
    """
    for log, found in zip(logs, check_recordings([each.recording for each in logs]), strict=True):
        log.__dict__["findings"] = (*log.noted, *found)


def check_samples(
    header: NativeHeader,
    time: Floats,
    command: Floats,
    position: Floats,
    row: int | Integers,
    force: Floats | None = None,
    velocity: Floats | None = None,
    unwrap: bool | float | None = None,
) -> Log:
    """Return a log after checking that its samples can be a step response.

    Parameters
    ----------
    header : NativeHeader
    time, command, position : float64, shape (rows,)
    row : int or int64, shape (rows,)
        Position of each sample in the file, counted from 1. A single number is the line of the first sample in a file
        with one sample per line.
    force, velocity : float64, shape (rows,), optional
    unwrap : bool or float, optional
        As in `recording.wrapping.unwrapped` [m, rad]. By default, only a rotation is unwrapped.

    Raises
    ------
    LogError
        If there are fewer than two samples, a step row is declared for a step of 0, a condition or the sampling period
        is out of range, a value is not finite or is outside the range of readings (`LARGEST`, `stray`), or time does
        not increase strictly or has a pause beyond `LONGEST_PAUSE`.
    """

    def refused(code: str, at: int, found: str, expected: str = "", cure: str = "") -> LogError:
        place = row + at if isinstance(row, int) else int(row[at]) if at < len(row) else None
        return refusal(code, "", found, expected, cure, place)

    if len(time) < 2:
        raise refused("too-short", 0, f"log has {len(time)} samples", "at least 2")
    step_row = int(header.extra.get("step_row", 0))
    if step_row >= len(time):
        found = f"step_row is {step_row}, but the log has {len(time)} samples"
        raise refused("condition-wrong", 0, found, cure="Rows are counted from 0. Correct the header or the profile.")
    if header.step == 0 and "step_row" in header.extra:
        found = f"step is 0 (none was commanded), but the step is declared in row {step_row}"
        raise refusal("condition-wrong", "", found, "", "Give the size of the step, or remove the declared row.")
    for name in OF_WALL:
        if abs(value := getattr(header, name)) > LARGEST_CONDITION:
            expected = f"at most {LARGEST_CONDITION:g} [SI]"
            raise refusal("out-of-range", "", f"{name} is {value:.6g}", expected, "Correct the value or its unit.")
        if 0 < abs(value) < SMALLEST_CONDITION:
            expected = f"0, or at least {SMALLEST_CONDITION:g} [SI]"
            raise refusal("out-of-range", "", f"{name} is {value:.6g}", expected, "Correct the value or its unit.")
    columns = {"time": time, "command": command, "position": position, "force": force, "velocity": velocity}
    travel = abs(header.step) / header.stiffness if header.stiffness > 0 else 0.0
    for name, values in columns.items():
        if values is None:
            continue
        if not (-LARGEST[name] <= values.min() and values.max() <= LARGEST[name]):  # a NaN also fails these comparisons
            finite, beyond = np.isfinite(values), np.abs(values) > LARGEST[name]
            if not finite.all():
                at = int(np.argmin(finite))
                raise refused("not-finite", at, f"{name} is {values[at]}", "a finite number")
            at, expected = int(np.argmax(beyond)), f"at most {LARGEST[name]:g} [SI]"
            raise refused("out-of-range", at, f"{name} is {values[at]:.6g}", expected, _LARGE)
        scale = {"position": travel, "velocity": 0.0}.get(name)
        if scale is not None and (off := stray(values, scale)) is not None:
            found = (
                f"{name} is {values[off]:.6g}, but the other readings are about {np.median(values):.6g}: no motion has "
                "such "
            )
            raise refused("out-of-range", off, f"{found}a gap")
    steps, period = time[1:] - time[:-1], header.sampling_period_s
    at = int(np.argmin(steps > 0)) + 1
    if steps[at - 1] <= 0:
        found = f"time is {time[at]:.17g} s after {time[at - 1]:.17g} s"
        raise refused("time-backwards", at, found, "time to increase in each row")
    at = int(np.argmax(steps)) + 1
    if not period / LONGEST_PAUSE <= steps[at - 1] <= period * LONGEST_PAUSE:
        found = f"time is {time[at]:.9g} s after {time[at - 1]:.9g} s, but sampling_period_s is {period:.9g} s"
        raise refused("time-wrong", at, f"{found}. The two are incompatible")
    if not PERIODS[0] <= header.sampling_period_s <= PERIODS[1]:
        found, expected = f"sampling_period_s is {header.sampling_period_s:.6g}", "{:g} to {:g} s".format(*PERIODS)
        raise refusal("out-of-range", "", found, expected, "Correct the value or its unit.")
    rule = False if unwrap is None and not is_rotation(header.motion or "rotation") else unwrap
    position, wrapped = unwrapped(position, rule)
    return Log(header, time, command, position, force, velocity, noted=() if wrapped is None else (wrapped,))


def stray(readings: Floats, scale: float) -> int | None:
    """Return the first row that is an outlier beyond any motion, such as a lost bit, a counter overflow, or a missing
    value.

    Parameters
    ----------
    readings : float64, shape (rows,)
    scale : float
        Smallest expected change of the readings, in their unit, or 0 if unknown.
    """
    if readings.max() - readings.min() <= GAP * scale:
        return None
    rows = len(readings)
    few, middle = rows // OUTSIDE, rows // 2
    ordered = np.partition(readings, (few, middle, rows - 1 - few))
    typical = max(float(ordered[rows - 1 - few] - ordered[few]), scale)
    distance = np.abs(readings - ordered[middle])
    if typical == 0 or distance.max() <= GAP * typical:
        return None
    nearer = np.sort(distance)
    beyond = nearer[1:] > GAP * np.maximum(nearer[:-1], typical)
    return int(np.argmax(distance >= nearer[1:][beyond].min())) if beyond.any() else None


def step_flags(time: Floats, rows: Integers, period: Floats) -> list[dict[str, float | int | None]]:
    """Compute the regularity of the samples of trials.

    Parameters
    ----------
    time : float64, shape (m,)
        Strictly increasing time stamps [s] of all trials, one trial after the other.
    rows : int64, shape (n,)
        Number of samples of each trial, at least 2.
    period : float64, shape (n,)
        Sampling period T [s] that each trial states.

    Returns
    -------
    list of dict, length n
        ``gaps``: number of steps longer than `MISSING` periods. ``dropped``: number of samples missing in them,
        rounded. ``dropped_fraction``: their share of all expected samples. ``longest_step_s``. ``mean_step_s``,
        ``jitter_rms_s`` and ``jitter_max_s``: mean of the other steps, and their deviation from T, or None if all steps
        are gaps.
    """
    inside = np.ones(max(len(time) - 1, 0), dtype=np.bool_)
    inside[np.cumsum(rows)[:-1] - 1] = False
    steps = np.diff(time)[inside]
    nominal = np.repeat(period, rows - 1)
    gap = steps > MISSING * nominal

    first = np.cumsum(rows - 1) - (rows - 1)

    def total(values: Floats | Booleans) -> Floats:
        return np.add.reduceat(values, first, dtype=np.float64)

    deviation = np.where(gap, 0.0, steps - nominal)
    gaps = total(gap)
    dropped = total(np.where(gap, np.rint(steps / nominal) - 1, 0.0))
    regular = np.maximum(rows - 1 - gaps, 1)
    columns = {
        "dropped_fraction": dropped / (rows + dropped),
        "longest_step_s": np.maximum.reduceat(steps, first),
        "mean_step_s": total(np.where(gap, 0.0, steps)) / regular,
        "jitter_rms_s": np.sqrt(total(deviation**2) / regular),
        "jitter_max_s": np.maximum.reduceat(np.abs(deviation), first),
    }
    flags = []
    for index, values in enumerate(zip(*(column.tolist() for column in columns.values()), strict=True)):
        entry: dict[str, float | int | None] = {"gaps": int(gaps[index]), "dropped": int(dropped[index])}
        entry |= dict(zip(columns, values, strict=True))
        if gaps[index] == rows[index] - 1:
            entry |= dict.fromkeys(("mean_step_s", "jitter_rms_s", "jitter_max_s"))
        flags.append(entry)
    return flags
