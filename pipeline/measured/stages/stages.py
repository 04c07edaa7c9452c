"""Stages of the measured branch: each takes the samples of one experiment and writes one table."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property, partial

import numpy as np

from pipeline.base.wording import commonest
from pipeline.measured.cost.costs import BY_FAMILY, Measure
from pipeline.measured.cost.energy import energy
from pipeline.measured.experiment import best_trial, estimates
from pipeline.measured.stages import stage_device
from pipeline.measured.stages import stage_rows as rows
from pipeline.measured.stages.stage_tables import SAMPLED, Stage, StageTables
from pipeline.records.criteria import ENERGY, FAMILIES, Family, criterion_of, members
from pipeline.records.findings import BoundaryPoint, Estimate, ModelCheck, Optimum
from pipeline.records.trials import Floats

MEASURES: dict[str, Measure] = {**BY_FAMILY, "energy": energy}
"""What computes the costs of each family of criteria."""


def _cost_stage(family: Family) -> Stage:
    mass, delay = "mass" in family.needs, "delay" in family.needs
    given = rows.given_to_energy if mass else rows.given_to_timed if delay else rows.given_to_costs
    timed = tuple(c.column for c in members(family)) if family.unit == "samples" or family is ENERGY else ()
    return Stage(
        family.needs,
        partial(rows.costs, measure=MEASURES[family.name], names=timed),
        lambda of: of.once(given),
        sprung=True,
    )


STAGES: dict[str, Stage] = {
    "response": Stage(rows=rows.response),
    "wall_law": Stage(("response",), rows.wall_law),
    "outcome": Stage(("response",), rows.outcomes, rows.given_to_outcome),
    "boundary": Stage(("response", "wall_law"), whole=rows.boundary),
    "device": Stage(("response", "wall_law"), whole=stage_device.device),
    "model": Stage(("response", "wall_law", "device"), whole=stage_device.model),
    "delay": Stage(("response",), rows.delays),
    "mass": Stage(("response", "delay"), rows.masses, rows.given_to_mass),
    **{name: _cost_stage(family) for name, family in FAMILIES.items()},
}
"""Stages in the order in which they can be computed; the plan is made backwards along what they need."""


class ExperimentStages(StageTables):
    """The stages of one experiment, and what follows from them."""

    stages = STAGES

    @property
    def samples_digest(self) -> str:
        """Hash of the samples that the results rest on, as they were when the first stage was computed."""
        return str(self.table(SAMPLED).schema.metadata[b"pipeline.samples"].decode())

    @cached_property
    def delay_estimate(self) -> Estimate:
        """Integer delay factor of the experiment."""
        return self.once(estimates.delay_estimate)

    @cached_property
    def damping_estimate(self) -> Estimate:
        """Viscous damping of the experiment."""
        return self.once(estimates.damping_estimate)

    @cached_property
    def mass_estimate(self) -> Estimate:
        """Mass of the experiment, beside that of the thesis's momentum balance."""
        return self.once(estimates.mass_estimate)

    @cached_property
    def jitter_estimate(self) -> Estimate:
        """Standard deviation of the delay within a trial."""
        return estimates.jitter_estimate(self)

    @cached_property
    def model_check(self) -> ModelCheck:
        """How well the fitted model explains the logs."""
        return estimates.model_check(self)

    @cached_property
    def boundary_points(self) -> tuple[BoundaryPoint, ...]:
        """Measured stability boundary, as stored."""
        rows = self.table("boundary").to_pylist()
        return tuple(BoundaryPoint(**row) for row in rows)

    def cost(self, criterion: str) -> tuple[Floats, str]:
        """Return the cost of each trial by a criterion (NaN where there is none) and, if none has one, why."""
        stage, column = cost_column(criterion)
        return self.column(stage, column), commonest(self.texts(stage, "reason"))

    def floor(self, criterion: str) -> Floats | None:
        """Return the cost of each trial that sensor and chatter alone can cause; None where they cause none."""
        family = criterion_of(criterion).family
        return self.column(family.name, family.floor) if family.floor else None

    def sure_cost(self, criterion: str) -> Floats:
        """Return the cost of each trial as `cost`, zero where it counts as none."""
        cost, floor = self.column(*cost_column(criterion)), self.floor(criterion)
        return cost if floor is None else np.where(best_trial.without_overshoot(cost, floor), 0.0, cost)

    def cost_interval(self, criterion: str) -> tuple[Floats, Floats]:
        """Return lower and upper end of the 95 % interval of each trial's cost, NaN where there is none."""
        stage, column = cost_column(criterion)
        return self.column(stage, f"{column}_low"), self.column(stage, f"{column}_high")

    def optimum(self, criterion: str) -> Optimum | None:
        """Return the best trial by a criterion, or None where no trial has that cost."""
        cost, _ = self.cost(criterion)
        trials, floor = self.texts("response", "trial_id"), self.floor(criterion)
        # what obeys another wall than stated was not tested there
        stated = np.flatnonzero(np.isnan(self.column("wall_law", "obeyed_stiffness")))
        best = best_trial.choose_optimum(
            cost[stated],
            self.column("response", "stiffness")[stated],
            self.column("response", "damping")[stated],
            tuple(trials[i] for i in stated),
            unstable=self.verdicts.verdict[stated] == "unstable",
            floor=None if floor is None else floor[stated],
        )
        if best is None:
            return None
        trial = trials.index(str(best.trial_id))
        low, high = (float(ends[trial]) for ends in self.cost_interval(criterion))
        return best.model_copy(
            update={"cost_low": None if np.isnan(low) else low, "cost_high": None if np.isnan(high) else high}
        )


def required(stages: Iterable[str]) -> set[str]:
    """Return the stages and all that they need."""
    result: set[str] = set()
    for stage in stages:
        result |= {stage} | required(STAGES[stage].needs)
    return result


def cost_column(criterion: str) -> tuple[str, str]:
    """Return stage and column that hold the cost by a criterion."""
    known = criterion_of(criterion)
    return known.family.name, known.column
