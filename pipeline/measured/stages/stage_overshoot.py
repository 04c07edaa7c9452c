"""Stages of costs, whose families are in `pipeline.measured.cost.families`: those that need nothing of the device."""

from __future__ import annotations

import numpy as np

from pipeline.measured.cost.families import Measure
from pipeline.measured.cost.reading_error import ReadingError, motion_at_rest, reading_error, sensor_error, usual_rest
from pipeline.measured.stages.stage_columns import conditions
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


def _error_of(of: TrialGroup, given: Given) -> ReadingError:
    sensor = float("nan") if given["sensor"] is None else given["sensor"]
    return reading_error(of.batch, of.found, given["delay"], sensor=sensor, rest=given["rest"])


def columns(of: TrialGroup, given: Given, measure: Measure) -> Columns:
    """Return the columns of a family of costs for some trials."""
    return conditions(of) | measure(of.batch, of.found, of.verdicts, _error_of(of, given), given)
