"""Stages of costs that are counted from the delay on."""

from __future__ import annotations

from pipeline.measured.cost.reading_error import as_known
from pipeline.measured.experiment.estimates import explaining_factor, standard_error
from pipeline.measured.experiment.fitted_device import explaining_device
from pipeline.measured.experiment.known_delay import delay_estimate, delay_range, with_delay
from pipeline.measured.experiment.rest_forces import rest_spring
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
    return {**sensor_of(of, samples, _spring(of)), "delay_range": (first, last)}


def _spring(of: Experiment) -> float:
    """Return the stiffness k [N/m, Nm/rad]: as declared, else of the device that explains the trials, else by rest."""
    device = of.once(explaining_device)
    if of.spring or device is None:
        return rest_spring(of)
    k = device.estimate("stiffness", "")
    return max(as_known(k.value, standard_error(k)), 0.0) if k is not None and k.value is not None else 0.0
