"""Stage `energy`: the energy costs of each trial with their intervals, which need the mass."""

from __future__ import annotations

import numpy as np

from pipeline.measured.cost.energy_intervals import HORIZON_PARTS, energy_interval
from pipeline.measured.cost.families import joined
from pipeline.measured.cost.reading_error import ReadingError, as_known
from pipeline.measured.experiment.estimates import mass_estimate, standard_error
from pipeline.measured.experiment.fitted_device import explaining_device
from pipeline.measured.signal.response import Response
from pipeline.measured.signal.verdict import Verdicts
from pipeline.measured.stages.stage_given import Experiment
from pipeline.measured.stages.stage_groups import Columns, Given
from pipeline.measured.stages.stage_settling import given_of as given_to_settling
from pipeline.records.batch import TrialBatch
from pipeline.records.criteria import ENERGY, members


def given_of(of: Experiment) -> Given:
    """Return what the stage takes from the whole experiment."""
    device = of.once(explaining_device)
    mass = (device and device.estimate("mass", "")) or of.once(mass_estimate)
    if mass.value is None:
        return {"missing": f"energy needs the mass: {mass.reason}"}
    error = as_known(standard_error(mass))
    return {**given_to_settling(of), "mass": as_known(mass.value, error), "mass_error": error}


def energy(batch: TrialBatch, response: Response, verdicts: Verdicts, error: ReadingError, given: Given) -> Columns:
    """Return the energies of some trials with their intervals, as a family of costs."""
    found = energy_interval(
        *(batch, response, verdicts, error, given["delay"], given["mass"]),
        mass_error=given["mass_error"],
        delay_range=tuple(given["delay_range"]),
    )
    half, full = (found.by_horizon[:, :, HORIZON_PARTS.index(part)] for part in (0.5, 1.0))
    ends = {"": found.value, "_low": found.low, "_high": found.high}
    parts = {**ends, "_bias": found.bias, "_tail": found.tail, "_half": half, "_full": full}
    return {
        **{f"{c.column}{part}": values[:, c.weight] for c in members(ENERGY) for part, values in parts.items()},
        "horizon_samples": np.where(found.horizon_samples > 0, found.horizon_samples, np.nan),
        "reason": joined(found.reason),
    }
