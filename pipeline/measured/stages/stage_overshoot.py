"""Stage `overshoot`: the overshoot of each trial with its interval."""

from __future__ import annotations

import numpy as np

from pipeline.measured.cost import costs
from pipeline.measured.cost.cost_intervals import overshoot_interval
from pipeline.measured.cost.reading_error import ReadingError, motion_at_rest, reading_error, sensor_error, usual_rest
from pipeline.measured.cost.step_metrics import reconcile
from pipeline.measured.stages.stage_columns import conditions, joined_texts
from pipeline.measured.stages.stage_given import Experiment
from pipeline.measured.stages.stage_groups import Columns, Given, TrialGroup
from pipeline.records.batch import Floats


def given_of(of: Experiment) -> Given:
    """Return what the stage takes from the whole experiment."""
    return sensor_of(of, 0)


def sensor_of(of: Experiment, delay: int) -> Given:
    """What the error of a reading takes from all trials: the sensor, and the usual motion at rest."""
    sensor = sensor_error(*(of.column("response", f"sensor_{name}") for name in ("noise", "quantum")))
    if not np.isfinite(sensor):
        return {"delay": delay, "sensor": None, "rest": 1.0}
    rest = np.concatenate(of.of_each(_motion_at_rest, delay=delay, sensor=sensor))
    return {"delay": delay, "sensor": sensor, "rest": usual_rest(rest)}


def _motion_at_rest(of: TrialGroup, given: Given) -> Floats:
    return of.once(motion_at_rest, given["delay"], given["sensor"])


def error_of(of: TrialGroup, given: Given) -> ReadingError:
    """Return the error of the readings of some trials."""
    sensor = float("nan") if given["sensor"] is None else given["sensor"]
    return reading_error(of.batch, of.found, given["delay"], sensor=sensor, rest=given["rest"])


def columns(of: TrialGroup, given: Given) -> Columns:
    """Return the columns of the stage for some trials."""
    found = costs.overshoot(of.batch, of.found, of.verdicts)
    interval = overshoot_interval(of.batch, of.found, error_of(of, given), found)
    return conditions(of) | {
        "overshoot": found.overshoot,
        "overshoot_floor": found.floor,
        "overshoot_low": interval.low,
        "overshoot_high": interval.high,
        "overshoot_last_sample": reconcile(of.batch, of.found, of.verdicts, 0).overshoot["matlab_final_value"].value,
        "reason": joined_texts(found.reason, interval.reason),
    }
