"""Table of the stages of the measured branch. Each stage computes the rows of one table from one experiment."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from pipeline.measured.cost.costs import CostInputs, Measure, other_settling, overshoot_row, rise_row, settling_row
from pipeline.measured.cost.energy import energy_row, other_energy
from pipeline.measured.stages import stage_device, stage_rows
from pipeline.measured.stages.stage import ExperimentStage, TrialStage, no_inputs
from pipeline.records.criteria import ENERGY, FAMILIES, Criterion, Family, members
from pipeline.records.stage_records import CostRow

MEASURES: Mapping[str, Measure] = {
    "settling": settling_row,
    "overshoot": overshoot_row,
    "rise": rise_row,
    "energy": energy_row,
}
"""Function that computes the costs of each family of criteria."""


def other_cost(criterion: Criterion) -> TrialStage[CostInputs, CostRow]:
    """Return the stage for a cost that has no stored column, such as a cost with a different settling band or
    exponent."""
    energies = criterion.family is ENERGY
    measure = partial(other_energy if energies else other_settling, criterion=criterion)
    inputs = stage_rows.energy_inputs if energies else stage_rows.timed_inputs
    return TrialStage(partial(stage_rows.costs, measure=measure, names=("cost",)), inputs)


def _cost_stage(family: Family) -> TrialStage[CostInputs, CostRow]:
    timed = "delay" in family.needs
    inputs = stage_rows.energy_inputs if "mass" in family.needs else stage_rows.timed_inputs
    names = tuple(c.column for c in members(family)) if family.unit == "samples" or family is ENERGY else ()
    measure = partial(stage_rows.costs, measure=MEASURES[family.name], names=names)
    return TrialStage(measure, inputs if timed else stage_rows.cost_inputs)


STAGES: Mapping[str, TrialStage[Any, Any] | ExperimentStage[Any]] = {
    "response": TrialStage(stage_rows.response, no_inputs),
    "wall_law": TrialStage(stage_rows.wall_law, no_inputs),
    "outcome": TrialStage(stage_rows.outcome, stage_rows.outcome_inputs),
    "boundary": ExperimentStage(stage_rows.boundary),
    "parts": ExperimentStage(stage_device.parts, stage_device.chosen_by),
    "device": ExperimentStage(stage_device.device),
    "model": ExperimentStage(stage_device.model),
    "delay": TrialStage(stage_rows.delay, no_inputs),
    "mass": TrialStage(stage_rows.mass, stage_rows.mass_inputs),
    **{name: _cost_stage(family) for name, family in FAMILIES.items()},
}
"""Computation of each stage."""
