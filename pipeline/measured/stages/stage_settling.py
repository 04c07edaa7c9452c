"""Stages of costs that are counted from the delay on."""

from __future__ import annotations

from pipeline.measured.experiment.estimates import explaining_factor
from pipeline.measured.experiment.known_delay import delay_estimate, delay_range, with_delay
from pipeline.measured.stages.stage_given import Experiment
from pipeline.measured.stages.stage_groups import Given
from pipeline.measured.stages.stage_overshoot import sensor_of


def given_of(of: Experiment) -> Given:
    """Return what the stage takes from the whole experiment."""
    found = with_delay(of)
    if "missing" in found:
        return found
    first, last = delay_range(of.once(delay_estimate))
    first, samples, last = of.once(explaining_factor) or (first, found["delay"], last)
    return {**sensor_of(of, samples), "delay_range": (first, last)}
