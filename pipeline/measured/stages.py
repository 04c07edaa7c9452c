"""Stages of the measured branch: each takes the samples of one experiment and writes one table.

A stage is reused while its key is the same: a hash of the trials (source and profile hashes), of the code that
computes it, and of the values it takes from stages before it.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import pyarrow as pa

from pipeline.base.errors import StoreError
from pipeline.base.provenance import code_digest, digest, stamp
from pipeline.base.wording import commonest
from pipeline.measured import aggregate, estimates, response, verdict
from pipeline.measured.stage_columns import COMPUTE
from pipeline.records.batch import Floats, TrialBatch
from pipeline.records.models import ENERGY_CRITERIA, SETTLING_BANDS, BoundaryPoint, Estimate, ModelCheck, Optimum
from pipeline.records.tables import read_metadata, read_table, to_arrow, write_table
from pipeline.store.storage import load_batch, stage_file

STAGES = (
    *("response", "outcome", "boundary", "delay", "model", "damping", "mass"),
    *("overshoot", "settling", "energy", "windows"),
)
"""Stages in the order in which they can be computed."""

NEEDS: dict[str, tuple[str, ...]] = {
    "response": (),
    "outcome": ("response",),
    "boundary": ("response",),
    "delay": ("response",),
    "model": ("response",),
    "damping": ("response", "delay", "model"),
    "mass": ("response", "delay", "model", "damping"),
    "overshoot": ("response",),
    "settling": ("response", "delay"),
    "energy": ("response", "delay", "model", "damping", "mass"),
    "windows": ("response", "delay"),
}
"""Stages whose results a stage takes; the plan is made backwards along these."""

SAMPLED = "response"
"""Stage that every scene needs; its result is stored with a hash of the samples."""

_SHARED_CODE = (
    "batch",
    "stages",
    "stage_columns",
    "aggregate",
    "estimates",
    "combine",
    "trend",
    "intervals",
    "wording",
)
_MOTION = ("response", "verdict", "modes")
_BALANCE = ("response", "momentum", "averaging", "correlated")
_FIT = ("fit", "fit_filter", "fit_jitter", "fit_motion", "fit_noise", "fit_search", "fit_window", "ghost")
_COSTS = ("response", "horizon", "costs", "reading_error", "cost_intervals", "step_metrics")
_CODE: dict[str, tuple[str, ...]] = {
    "response": _MOTION,
    "outcome": (*_MOTION, "outcome", "events", "disturbance"),
    "boundary": ("boundary", "boundary_band"),
    "delay": ("response", "delay", "onset"),
    "model": ("response", "delay", *_FIT),
    "damping": (*_BALANCE, "damping"),
    "mass": (*_BALANCE, "mass", "friction"),
    "overshoot": _COSTS,
    "settling": _COSTS,
    "energy": (*_COSTS, "energy_intervals", "tail"),
    "windows": (*_BALANCE, "mass"),
}


@dataclass
class ExperimentStages:
    """The stages of one experiment: what is stored, what is stale, and how to compute it.

    Parameters
    ----------
    processed : Path
    device, experiment : str
    trials : pyarrow.Table
        Rows of the trials table that belong to the experiment.
    """

    processed: Path
    device: str
    experiment: str
    trials: pa.Table
    _tables: dict[str, pa.Table] = field(default_factory=dict)

    @cached_property
    def rotation(self) -> bool:
        """Whether units are rotational.

        Raises
        ------
        StoreError
            If the experiment mixes translation and rotation.
        """
        motions = set(self.trials.column("motion").to_pylist())
        if len(motions) != 1:
            raise StoreError(
                f"device {self.device!r}, experiment {self.experiment!r}: its logs mix {sorted(motions)}. "
                "Name the experiments apart in the logs' headers and ingest them into a new folder."
            )
        return motions == {"rotation"}

    @cached_property
    def inputs_digest(self) -> str:
        """Hash of the logs and profiles that the samples came from."""
        # not where the samples lie: merging batches changes no result
        columns = ("trial_id", "source_sha256", "profile_sha256")
        rows = zip(*(self.trials.column(c).to_pylist() for c in columns), strict=True)
        return digest(sorted("|".join(map(str, row)) for row in rows))

    @cached_property
    def batch(self) -> TrialBatch:
        """All samples of the experiment, read when a stage has to be computed."""
        return load_batch(self.processed, self.trials)

    @cached_property
    def found(self) -> response.Response:
        """Edge and resolution of each trial; a declared step row stands for what the log does not show."""
        found = response.find_response(self.batch)
        declared = self.batch.step_row
        return found if declared is None else response.declare_edge(self.batch, found, declared)

    def key(self, stage: str) -> str:
        """Return the key under which the result of a stage is valid."""
        code = code_digest(*_SHARED_CODE, *_CODE[stage])
        return digest([stage, self.inputs_digest, code, *(self.key(need) for need in NEEDS[stage])])

    def is_stored(self, stage: str) -> bool:
        """Return whether a result with the present key is stored."""
        return self._stored_key(stage) == self.key(stage)

    def why_run(self, stage: str) -> str:
        """Return in words why a stage that is not reused has to run."""
        stored = self._stored_key(stage)
        return "no result is stored" if stored is None else "logs, code or an earlier stage changed since it was stored"

    def _stored_key(self, stage: str) -> str | None:
        return read_metadata(self._file(stage)).get("pipeline.key")

    def _file(self, stage: str) -> Path:
        return stage_file(self.processed, self.device, self.experiment, stage)

    def table(self, stage: str) -> pa.Table:
        """Return the result of a stage: from memory, from its file, or by computing and storing it."""
        if stage not in self._tables:
            if self.is_stored(stage):
                self._tables[stage] = read_table(self._file(stage))
            else:
                columns = COMPUTE[stage](self)
                metadata = stamp(
                    stage=stage,
                    key=self.key(stage),
                    inputs=self.inputs_digest,
                    code=code_digest(*_SHARED_CODE, *_CODE[stage]),
                    parameters=json.dumps(self._parameters(stage)),
                    **({"samples": self.batch.digest} if stage == SAMPLED else {}),
                )
                result = to_arrow(stage, columns, rotation=self.rotation, metadata=metadata)
                write_table(self._file(stage), result)
                self._tables[stage] = result
        return self._tables[stage]

    @property
    def samples_digest(self) -> str:
        """Hash of the samples that the results rest on, as they were when the first stage was computed."""
        return str(self.table(SAMPLED).schema.metadata[b"pipeline.samples"].decode())

    def _parameters(self, stage: str) -> dict[str, float | None]:
        """Values from earlier stages that a stage was computed with."""
        parameters: dict[str, float | None] = {}
        if "delay" in NEEDS[stage]:
            parameters["delay_samples"] = self.delay_estimate.value
        if "damping" in NEEDS[stage]:
            parameters["viscous_damping"] = self.damping_estimate.value
        return parameters

    def column(self, stage: str, name: str) -> Floats:
        """Return a numeric column of a stage as float64, null as NaN."""
        values = self.table(stage).column(name).to_numpy(zero_copy_only=False)
        return np.asarray(values, dtype=np.float64)

    def texts(self, stage: str, name: str) -> list[str]:
        """Return a text column of a stage, null as an empty string."""
        return [text or "" for text in self.table(stage).column(name).to_pylist()]

    @cached_property
    def verdicts(self) -> verdict.Verdicts:
        """Verdict of each trial, as stored."""
        return verdict.Verdicts(
            np.array(self.texts("response", "verdict"), dtype="<U9"),
            self.column("response", "growth_per_s"),
            tuple(self.texts("response", "reason")),
        )

    @cached_property
    def delay_estimate(self) -> Estimate:
        """Integer delay factor of the experiment."""
        return estimates.delay_estimate(self)

    @cached_property
    def damping_estimate(self) -> Estimate:
        """Viscous damping of the experiment."""
        return estimates.damping_estimate(self, estimates.model_mass(self), self.delay_estimate)

    @cached_property
    def mass_estimate(self) -> Estimate:
        """Mass of the experiment."""
        return estimates.mass_estimate(self)

    @cached_property
    def jitter_estimate(self) -> Estimate:
        """Standard deviation of the delay within a trial."""
        return estimates.jitter_estimate(self)

    @cached_property
    def model_check(self) -> ModelCheck:
        """How well the fitted model explains the logs."""
        return estimates.model_check(self)

    @cached_property
    def sampling_period_s(self) -> float:
        """Sampling period T [s], the same for all trials.

        Raises
        ------
        StoreError
            If trials differ.
        """
        periods = sorted(set(self.trials.column("sampling_period_s").to_pylist()))
        if len(periods) != 1:
            raise StoreError(
                f"device {self.device!r}, experiment {self.experiment!r}: sampling periods differ ({periods[:5]} s); "
                "expected one. Name the experiments apart in the logs' headers and ingest them into a new folder."
            )
        return float(periods[0])

    @cached_property
    def boundary_points(self) -> tuple[BoundaryPoint, ...]:
        """Measured stability boundary, as stored."""
        rows = self.table("boundary").to_pylist()
        return tuple(BoundaryPoint(**row) for row in rows)

    def cost(self, criterion: str) -> tuple[Floats, str]:
        """Return the cost of each trial by a criterion (NaN where there is none) and, if none has one, why."""
        stage, column = cost_column(criterion)
        return self.column(stage, column), commonest(self.texts(stage, "reason"))

    def cost_interval(self, criterion: str) -> tuple[Floats, Floats]:
        """Return lower and upper end of the 95 % interval of each trial's cost, NaN where there is none."""
        stage, column = cost_column(criterion)
        return self.column(stage, f"{column}_low"), self.column(stage, f"{column}_high")

    def optimum(self, criterion: str) -> Optimum | None:
        """Return the best trial by a criterion, or None where no trial has that cost."""
        cost, _ = self.cost(criterion)
        table = self.table("response")
        best = aggregate.choose_optimum(
            cost,
            self.column("response", "stiffness"),
            self.column("response", "damping"),
            tuple(table.column("trial_id").to_pylist()),
            unstable=self.verdicts.verdict == "unstable",
            floor=self.column("overshoot", "overshoot_floor") if criterion == "overshoot" else None,
        )
        if best is None:
            return None
        trial = list(self.texts("response", "trial_id")).index(str(best.trial_id))
        low, high = (float(ends[trial]) for ends in self.cost_interval(criterion))
        return best.model_copy(
            update={"cost_low": None if np.isnan(low) else low, "cost_high": None if np.isnan(high) else high}
        )


def required(stages: Iterable[str]) -> set[str]:
    """Return the stages and all that they need."""
    result: set[str] = set()
    for stage in stages:
        result |= {stage} | required(NEEDS[stage])
    return result


def cost_column(criterion: str) -> tuple[str, str]:
    """Return stage and column that hold the cost by a criterion."""
    if criterion == "overshoot":
        return "overshoot", "overshoot"
    if criterion in SETTLING_BANDS:
        return "settling", criterion
    return "energy", f"energy_w{ENERGY_CRITERIA.index(criterion)}"
