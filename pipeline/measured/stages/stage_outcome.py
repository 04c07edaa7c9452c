"""Stage `outcome`: how each trial ended, and what shows it."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np

from pipeline.measured.signal import outcome
from pipeline.measured.signal.disturbance import Device, largest_force, learn_device, with_least
from pipeline.measured.signal.events import usual_length
from pipeline.measured.signal.response import NO_ROW, sensor_floor
from pipeline.measured.stages.stage_columns import conditions, row_column
from pipeline.measured.stages.stage_given import Experiment
from pipeline.measured.stages.stage_groups import Columns, Given, TrialGroup
from pipeline.records.batch import Floats


def given_of(of: Experiment) -> Given:
    """Return what the stage takes from the whole experiment."""
    quantum, noise = (of.column("response", f"sensor_{name}") for name in ("quantum", "noise"))
    edge = np.nan_to_num(of.column("response", "edge_row"), nan=NO_ROW).astype(np.int64)
    rows, step, period = (of.samples.of_trials(name) for name in ("rows", "step", "sampling_period_s"))
    device = learn_device(of.samples, edge, sensor_floor(quantum, noise), rows, step, period)
    forces = np.concatenate(of.of_each(_largest_force, device=asdict(device)))
    return {"usual_rows": usual_length(rows), "device": asdict(with_least(device, forces))}


def _largest_force(of: TrialGroup, given: Given) -> Floats:
    return of.once(largest_force, Device(**given["device"])).ratio


def columns(of: TrialGroup, given: Given) -> Columns:
    """Return the columns of the stage for some trials."""
    device = Device(**given["device"])
    largest = of.once(largest_force, replace(device, least=1.0))
    found = outcome.classify(
        *(of.batch, of.found, of.verdicts), usual_rows=given["usual_rows"], device=device, largest=largest
    )
    return conditions(of) | {
        "outcome": list(found.outcome),
        "evidence": list(found.evidence),
        "outcome_row": row_column(found.first_row),
        "band": found.band,
        "amplitude_end": found.amplitude_end,
    }
