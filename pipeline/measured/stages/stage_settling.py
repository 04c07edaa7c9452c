"""Stages of costs that are counted from the delay on."""

from __future__ import annotations

from math import floor

from pipeline.measured.experiment.estimates import explaining_delay
from pipeline.measured.experiment.known_delay import delay_estimate, delay_range, whole_delay, with_delay
from pipeline.measured.stages.stage_given import Experiment
from pipeline.measured.stages.stage_groups import Given
from pipeline.measured.stages.stage_overshoot import sensor_of


def given_of(of: Experiment) -> Given:
    """Return what the stage takes from the whole experiment."""
    found = with_delay(of)
    if "missing" in found:
        return found
    first, last = delay_range(of.once(delay_estimate))
    samples = found["delay"]
    model = of.once(explaining_delay)
    if model is not None and model.value is not None:
        samples, first, last = (floor(whole_delay(model, end)) for end in (model.value, model.low, model.high))
    return {**sensor_of(of, samples), "delay_range": (min(first, samples), max(last, samples))}
