"""Stages of costs, whose families are in `pipeline.measured.cost.families`: those that need nothing of the device."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.measured.cost.families import Measure
from pipeline.measured.cost.reading_error import ReadingError, gain_at_rest, reading_error, sensor_error, usual_gain
from pipeline.measured.experiment.rest_forces import rest_spring
from pipeline.measured.stages.stage_columns import conditions, hull
from pipeline.measured.stages.stage_given import Experiment
from pipeline.measured.stages.stage_groups import Columns, Given, TrialGroup
from pipeline.records.batch import Floats


def given_of(of: Experiment) -> Given:
    """Return what the stage takes from the whole experiment."""
    return sensor_of(of, 0, rest_spring(of))


def sensor_of(of: Experiment, delay: int, spring: float) -> Given:
    """What a cost and the error of a reading take from all trials: a spring, the sensor, the usual gain."""
    noise, quantum, rows = (of.column("response", name) for name in ("sensor_noise", "sensor_quantum", "edge_row"))
    sensor = sensor_error(noise, quantum, rows.astype(np.int64))
    if not np.isfinite(sensor):
        return {"delay": delay, "sensor": None, "gain": 1.0, "spring": spring}
    gain = np.concatenate(of.of_each(_gain_at_rest, delay=delay, sensor=sensor, spring=spring))
    return {"delay": delay, "sensor": sensor, "gain": usual_gain(gain), "spring": spring}


def _gain_at_rest(of: TrialGroup, given: Given) -> Floats:
    return of.held_by(given["spring"]).once(gain_at_rest, given["delay"], given["sensor"])


def _error_of(of: TrialGroup, given: Given) -> ReadingError:
    sensor = float("nan") if given["sensor"] is None else given["sensor"]
    return reading_error(of.batch, of.found, given["delay"], sensor=sensor, gain=given["gain"])


def columns(of: TrialGroup, given: Given, measure: Measure, names: Sequence[str]) -> Columns:
    """Return the columns of a family of costs for some trials; ``names`` are those of costs that count time.

    Of logs with missing or repeated rows they are counted on the grid of samples, with intervals that hold those of
    rows which lie on straight lines, too.
    """
    if not names:
        return _columns(of, given, measure) | conditions(of)
    made, straight = _columns(of.on_grid, given, measure) | conditions(of), of.on_straight_grid
    return made if straight is None else hull(made, _columns(straight, given, measure), names)


def _columns(of: TrialGroup, given: Given, measure: Measure) -> Columns:
    held = of.held_by(given["spring"])
    return measure(held.batch, held.found, held.verdicts, _error_of(held, given), given)
