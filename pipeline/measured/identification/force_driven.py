"""Identify a device from its measured force, and the drive between command and force.

Device and drive are then identified separately: the mass from force and motion, the gain of the drive from command and
force.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.measured.identification.identifiability import PER_MASS
from pipeline.measured.identification.identified import Identification, check_recordings, identified, no_fit
from pipeline.measured.identification.intervals import Interval
from pipeline.measured.identification.measured_drive import MeasuredDrive, identified_drive
from pipeline.measured.identification.part_table import DRIVE_PARTS
from pipeline.measured.identification.parts import choose_parts
from pipeline.measured.identification.recordings import Recording

TRAPEZOIDAL, CUBIC = (0.5,), (13 / 24, -1 / 24)
"""Weights of the force readings in the mean over an interval, on each side, from the ends of the interval outwards."""

FORCE_AHEAD = 1.0
"""Number of rows by which the command of `driven_by_force` is ahead of the measured force."""

PER_FORCE = PER_MASS | {"mass"}
"""Parameters that are proportional to the force."""


@dataclass(frozen=True, eq=False)
class ForceDriven:
    """Device and drive that were identified separately.

    Parameters
    ----------
    device : Identification
        Device in units of the measured force. Its delay is the delay of the motion behind the command, and it includes
        the lag and the limit of the drive.
    by_command : Identification
        The same device per unit of the command, as in a loop with a wall.
    drive : MeasuredDrive
    """

    device: Identification
    by_command: Identification
    drive: MeasuredDrive


def driven_by_force(each: Recording, weights: tuple[float, ...] = TRAPEZOIDAL) -> Recording:
    """Return a recording whose command is the measured force, one row ahead.

    The command of a row is the mean force over the interval between the next two rows. A delay of one sample therefore
    means that force and motion are measured at the same time. The motion may also precede the force.
    """
    assert each.force is not None, "only recordings with a measured force can be driven by this force"
    force, reach = each.force, len(weights)
    padded = np.pad(force, reach - 1, mode="edge")
    count = len(force) - 2
    mean = np.zeros(count)
    for out, weight in enumerate(weights):
        left, right = reach - out, reach + 1 + out
        mean += weight * (padded[left : left + count] + padded[right : right + count])
    rows = slice(0, count)
    return replace(each, time=each.time[rows], command=mean, position=each.position[rows], edge=None, force=force[rows])


def identified_by_force(recordings: list[Recording]) -> ForceDriven:
    """Identify device and drive from recordings that all have a measured force.

    The force between rows is unknown. The difference between the results of two rules of integration is the error that
    this causes, and is added to the intervals, as is the bias due to the noise of the force readings.

    Raises
    ------
    ParameterError
        As `identified`.
    """
    trapezoidal, cubic = ([driven_by_force(each, rule) for each in recordings] for rule in (TRAPEZOIDAL, CUBIC))
    check_recordings(trapezoidal)
    try:
        chosen = choose_parts(trapezoidal, DRIVE_PARTS)
    except np.linalg.LinAlgError as error:
        raise no_fit(error) from error
    found, other = identified(trapezoidal, chosen), identified(cubic, chosen)
    drive = identified_drive(recordings)
    parameters = {}
    for name, each in found.parameters.items():
        moved = abs(other.parameters[name].value - each.value) if name in other.parameters else 0.0
        biased = drive.noise_share * abs(each.value) if name in PER_FORCE else 0.0
        parameters[name] = _widened(each, moved + biased)
    found = _behind_command(replace(found, parameters=parameters), drive)
    return ForceDriven(found, _per_command(found, drive), drive)


def _widened(each: Interval, more: float) -> Interval:
    """Return an interval with ``more`` at each end. A nonnegative interval stays nonnegative."""
    if not np.isfinite(more):
        return each
    low = each.low - more
    return Interval(
        each.value, max(low, 0.0) if each.low >= 0 else low, each.high + more, float(np.hypot(each.error, more))
    )


def _behind_command(found: Identification, drive: MeasuredDrive) -> Identification:
    """Return a device with the delay behind the command instead of behind the force, and with the lag and the limit of
    the drive."""
    parameters, unknown, reasons = dict(found.parameters), set(found.unidentifiable), dict(found.reasons)
    if "delay_samples" not in parameters:
        return found
    behind_force, period = parameters["delay_samples"], found.units.period
    if drive.reason:
        unknown.add("delay_samples")
        reasons["delay_samples"] = drive.reason
        return replace(found, unidentifiable=unknown, reasons=reasons)
    parameters["delay_samples"] = _sum(behind_force, drive.delay_samples, -FORCE_AHEAD)
    lag = drive.lag_samples
    if lag.value > 0:
        parameters["actuator_lag_s"] = Interval(*(period * end for end in (lag.value, lag.low, lag.high, lag.error)))
    if drive.limit is not None:
        parameters["force_limit"] = drive.limit
    bounds = {
        name: bound for name, bound in found.choice.bounds.items() if name not in ("actuator_lag_s", "delay_samples")
    }
    if not lag.value and lag.high > 0:
        bounds["actuator_lag_s"] = period * lag.high
    others = [each for each in found.combinations if "delay_samples" not in each.members]
    return replace(found, parameters=parameters, choice=replace(found.choice, bounds=bounds), combinations=others)


def _sum(first: Interval, second: Interval, more: float) -> Interval:
    """Return the sum of two independent nonnegative quantities and a constant."""
    value = first.value + second.value + more
    low, high = (
        value + way * float(np.hypot(*(getattr(each, end) - each.value for each in (first, second))))
        for way, end in ((-1, "low"), (1, "high"))
    )
    error = float(np.hypot(first.error, second.error))
    return Interval(max(value, 0.0), max(low, 0.0), max(high, 0.0), error)


def _per_command(found: Identification, drive: MeasuredDrive) -> Identification:
    """Return a device per unit of the command. Without a gain, all parameters in `PER_FORCE` are unidentifiable."""
    if drive.reason:
        return replace(found, unidentifiable=found.unidentifiable | (PER_FORCE & found.parameters.keys()))
    gain = drive.gain
    parameters = {name: _quotient(each, gain) if name in PER_FORCE else each for name, each in found.parameters.items()}
    return replace(found, parameters=parameters)


def _quotient(each: Interval, gain: Interval) -> Interval:
    """Return a quantity divided by an independent gain. The relative errors are added in quadrature."""
    value = each.value / gain.value
    relative = max(gain.value - gain.low, gain.high - gain.value) / gain.value
    low, high = (
        value + way * float(np.hypot((end - each.value) / gain.value, relative * value))
        for way, end in ((-1, each.low), (1, each.high))
    )
    error = float(np.hypot(each.error / gain.value, gain.error / gain.value * value))
    return Interval(value, max(low, 0.0) if each.low >= 0 else low, high, error)
