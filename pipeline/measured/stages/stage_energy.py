"""Stage `energy`: the energy costs of each trial with their intervals."""

from __future__ import annotations

import numpy as np

from pipeline.measured.cost import costs
from pipeline.measured.cost.energy_intervals import HORIZON_PARTS, energy_interval
from pipeline.measured.experiment.estimates import mass_estimate, standard_error
from pipeline.measured.signal.response import NO_ROW
from pipeline.measured.stages.stage_columns import conditions, hull, joined_texts, row_column
from pipeline.measured.stages.stage_given import Experiment
from pipeline.measured.stages.stage_groups import Columns, Given, TrialGroup
from pipeline.measured.stages.stage_overshoot import error_of
from pipeline.measured.stages.stage_settling import given_of as given_to_settling


def given_of(of: Experiment) -> Given:
    """Return what the stage takes from the whole experiment."""
    mass = of.once(mass_estimate)
    if mass.value is None:
        return {"missing": f"energy needs the mass: {mass.reason}"}
    return {**given_to_settling(of), "mass": mass.value, "mass_error": standard_error(mass)}


def columns(of: TrialGroup, given: Given) -> Columns:
    """Return the columns of the stage for some trials; of logs with missing rows by their samples."""
    made, straight = _columns(of.on_grid, given) | conditions(of), of.on_straight_grid
    names = [f"energy_w{w}" for w in costs.WEIGHTS]
    return made if straight is None else hull(made, _columns(straight, given), names)


def _columns(of: TrialGroup, given: Given) -> Columns:
    found = energy_interval(
        *(of.batch, of.found, of.verdicts, error_of(of, given), given["delay"], given["mass"]),
        mass_error=given["mass_error"],
        delay_range=tuple(given["delay_range"]),
    )
    half, full = HORIZON_PARTS.index(0.5), HORIZON_PARTS.index(1.0)
    made = conditions(of) | {
        "horizon_samples": row_column(np.where(found.horizon_samples > 0, found.horizon_samples, NO_ROW)),
        "reason": joined_texts(found.reason),
    }
    for w in costs.WEIGHTS:
        parts = {"": found.value, "_low": found.low, "_high": found.high, "_bias": found.bias, "_tail": found.tail}
        made |= {f"energy_w{w}{end}": values[:, w] for end, values in parts.items()}
        made |= {
            f"energy_w{w}_half": found.by_horizon[:, w, half],
            f"energy_w{w}_full": found.by_horizon[:, w, full],
        }
    return made
