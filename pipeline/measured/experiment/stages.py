"""Stages of the measured branch: each takes the samples of one experiment and writes one table.

A stage is reused while its key is the same: a hash of the trials (source and profile hashes), of the code that
computes it, and of the values it takes from stages before it. Where it is not, the rows of those trials are still
reused whose samples are the same, computed by the same code with the same values of the experiment.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa

from pipeline.base.disk import if_writable
from pipeline.base.errors import StoreError
from pipeline.base.provenance import code_digest, digest, stamp
from pipeline.base.wording import commonest
from pipeline.measured.experiment import aggregate, estimates
from pipeline.measured.experiment.stage_columns import stage_rows
from pipeline.measured.experiment.stage_given import DERIVED, GIVEN, WHOLE
from pipeline.measured.experiment.stage_groups import Given, TrialGroup
from pipeline.measured.signal import verdict
from pipeline.records.batch import Floats
from pipeline.records.criteria import FAMILIES, criterion_of
from pipeline.records.groups import TrialGroups
from pipeline.records.models import BoundaryPoint, Estimate, ModelCheck, Optimum
from pipeline.records.table_files import read_metadata, read_table, write_table
from pipeline.records.tables import arrow_schema, to_arrow
from pipeline.store.samples import load_groups
from pipeline.store.storage import stage_file

STAGES = (
    *("response", "outcome", "boundary", "delay", "model", "damping", "mass"),
    *FAMILIES,
    "windows",
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
    **{name: family.needs for name, family in FAMILIES.items()},
    "windows": ("response", "delay"),
}
"""Stages whose results a stage takes; the plan is made backwards along these."""

SAMPLED = "response"
"""Stage that every scene needs; its result is stored with a hash of the samples."""

_SHARED_CODE = (
    "batch",
    "groups",
    "stages",
    "stage_groups",
    "stage_given",
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
_COSTS = (
    *("criteria", "families", "response", "horizon", "costs", "reading_error", "cost_intervals", "step_metrics"),
    *("energy_intervals", "tail"),
)
_CODE: dict[str, tuple[str, ...]] = {
    "response": _MOTION,
    "outcome": (*_MOTION, "outcome", "events", "disturbance"),
    "boundary": ("boundary", "boundary_band"),
    "delay": ("response", "delay", "onset"),
    "model": ("response", "delay", *_FIT),
    "damping": (*_BALANCE, "damping"),
    "mass": (*_BALANCE, "mass", "friction"),
    **dict.fromkeys(FAMILIES, _COSTS),
    "windows": (*_BALANCE, "mass"),
}

ROW_KEY = "samples_sha256"
"""Column by which a row of a stage is known; what else it rests on is the same for all rows of a file."""

Result = TypeVar("Result")


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
    _mapped: Callable[..., Iterable[Any]] = map

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
    def samples(self) -> TrialGroups:
        """All samples of the experiment, read when a stage has to be computed."""
        return load_groups(self.processed, self.trials)

    @cached_property
    def _groups(self) -> list[TrialGroup]:
        return [TrialGroup(part) for part in self.samples.parts]

    @cached_property
    def _judged(self) -> list[TrialGroup]:
        """The groups with the verdicts of their trials."""
        for group, places in zip(self._groups, self.samples.places, strict=True):
            group.verdicts = self.verdicts.select(places)
        return self._groups

    def of_each(self, function: Callable[..., Result], **given: Any) -> list[Result]:
        """Return the results of a function of each group, `TrialGroup` and what is given, in order of the groups."""
        return list(self._mapped(partial(function, given=given), self._judged))

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
                self._tables[stage] = self._whole(stage) if stage in WHOLE else self._of_trials(stage)
                with if_writable():
                    write_table(self._file(stage), self._tables[stage])
        return self._tables[stage]

    def compute(self, stages: Sequence[str], mapped: Callable[..., Iterable[Any]]) -> None:
        """Compute and store some stages, in this order, by a ``map`` that may send groups to other processes."""
        self._mapped = mapped
        try:
            for stage in stages:
                self.table(stage)
        finally:
            self._mapped = map

    def take_over(self, tables: Mapping[str, pa.Table]) -> None:
        """Take results that another process has computed of the same trials."""
        self._tables |= tables

    def count_new_trials(self) -> int:
        """Return how many trials have no stored row of the first stage that would be reused."""
        former = self._former(SAMPLED, self._common(SAMPLED, {}))
        return len(set(self.samples.of_trials("digests").tolist()) - set(former.column(ROW_KEY).to_pylist()))

    def _common(self, stage: str, given: Given) -> str:
        """Return a hash of all that the rows of a stage rest on beside their samples."""
        code = code_digest(*_SHARED_CODE, *(name for each in required([stage]) for name in _CODE[each]))
        return digest([stage, code, given, self.rotation])

    def _whole(self, stage: str) -> pa.Table:
        return to_arrow(stage, WHOLE[stage](self), rotation=self.rotation, metadata=self._stamp(stage))

    def _of_trials(self, stage: str) -> pa.Table:
        """Compute a stage with one row a trial, but for the rows that are stored and rest on the same."""
        given = GIVEN[stage](self)
        common = self._common(stage, given)
        former = self._former(stage, common)
        kept = set(former.column(ROW_KEY).to_pylist())
        groups = self._groups if stage == SAMPLED else self._judged
        new = [group.select(np.array([key not in kept for key in group.batch.digests])) for group in groups]
        compute = partial(stage_rows, stage=stage, given=given, rotation=self.rotation)
        rows = pa.concat_tables([former, *self._mapped(compute, [group for group in new if len(group.batch)])])
        if stage in DERIVED:
            for name, values in DERIVED[stage](self, rows).items():
                index = rows.schema.get_field_index(name)
                rows = rows.set_column(index, rows.schema.field(name), pa.array(values, from_pandas=True))
        place = {key: row for row, key in enumerate(rows.column(ROW_KEY).to_pylist())}
        order = [place[key] for key in self.samples.of_trials("digests").tolist()]
        samples = {"samples": self.samples.digest} if stage == SAMPLED else {}
        metadata = self._stamp(stage, given=json.dumps(given), common=common, **samples)
        return rows.take(order).cast(arrow_schema(stage, rotation=self.rotation, metadata=metadata))

    def _former(self, stage: str, common: str) -> pa.Table:
        """Return the stored rows of a stage that rest on the same of the experiment; none where they are damaged."""
        schema = arrow_schema(stage, rotation=self.rotation)
        if read_metadata(self._file(stage)).get("pipeline.common") == common:
            with suppress(StoreError):
                return read_table(self._file(stage)).replace_schema_metadata(schema.metadata)
        return schema.empty_table()

    def _stamp(self, stage: str, **more: str) -> Mapping[str, str]:
        code = code_digest(*_SHARED_CODE, *_CODE[stage])
        return stamp(stage=stage, key=self.key(stage), inputs=self.inputs_digest, code=code, **more)

    @property
    def samples_digest(self) -> str:
        """Hash of the samples that the results rest on, as they were when the first stage was computed."""
        return str(self.table(SAMPLED).schema.metadata[b"pipeline.samples"].decode())

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

    def floor(self, criterion: str) -> Floats | None:
        """Return the cost of each trial that sensor and chatter alone can cause; None where they cause none."""
        family = criterion_of(criterion).family
        return self.column(family.name, family.floor) if family.floor else None

    def sure_cost(self, criterion: str) -> Floats:
        """Return the cost of each trial as `cost`, zero where it counts as none."""
        cost, floor = self.column(*cost_column(criterion)), self.floor(criterion)
        return cost if floor is None else np.where(aggregate.without_overshoot(cost, floor), 0.0, cost)

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
            floor=self.floor(criterion),
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
    known = criterion_of(criterion)
    return known.family.name, known.column
