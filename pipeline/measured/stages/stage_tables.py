"""Compute, store and reuse the stages of an experiment, independently of what a stage computes.

The result of a stage is reused while its key is unchanged. The key is a hash of the trials (source and profile hashes),
of the code that computes the stage, and of its inputs from previous stages. If only some trials have changed, the rows
of all other trials are reused, provided that the code and the inputs from the experiment are unchanged.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeVar

import numpy as np
import pyarrow as pa

from pipeline.base.disk import if_writable, write_result
from pipeline.base.errors import StoreError
from pipeline.base.progress import part_of_work
from pipeline.base.provenance import code_digest, digest, stamp
from pipeline.base.wording import commonest
from pipeline.device.parameters import Motion
from pipeline.measured.experiment.best_trial import choose_optimum, without_overshoot
from pipeline.measured.experiment.optimum_place import (
    cost_scatter,
    is_alone,
    near_optimum,
    nearly_as_good,
    stable_damping_range,
)
from pipeline.measured.experiment.stored import Verdicts
from pipeline.measured.stages.stage_needs import NEEDS, SPRUNG, cost_column
from pipeline.records.criteria import criterion_of
from pipeline.records.findings import BoundaryPoint, Optimum
from pipeline.records.models import Measuring
from pipeline.records.stage_records import OF_TRIAL
from pipeline.records.table_files import parquet_bytes, read_metadata, read_table
from pipeline.records.tables import COLUMNS, TABLES, arrow_schema, to_arrow
from pipeline.records.trials import Floats, Trials
from pipeline.store.samples import in_order, load_trials
from pipeline.store.storage import (
    APART,
    TABLE,
    Exclusion,
    read_exclusions,
    read_trials,
    split_trials,
    stage_file,
    stage_folder,
)

if TYPE_CHECKING:
    from pipeline.measured.stages.measured_trial import MapTrials, MeasuredTrial
    from pipeline.measured.stages.stage import TrialStage

SAMPLED = "response"
"""Stage that every view needs. Its result is stored with a hash of the samples."""

ROW_KEY = "samples_sha256"
"""Column that identifies a row of a stage. All other inputs are the same for all rows of a file."""

Result = TypeVar("Result")


def stage_row(of: MeasuredTrial, measure: Callable[[MeasuredTrial, Any], object], inputs: object) -> object:
    """Return the row of a stage for a trial, as a record of `stage_records`."""
    return measure(of, inputs)


def stored_value(name: str, value: object) -> object:
    """Return a column value in stored form, which is null for a negative row number or an empty text.

    >>> stored_value("edge_row", -1), stored_value("edge_row", 20), stored_value("reason", "")
    (None, 20, None)
    """
    missing = value == "" or (isinstance(value, int) and value < 0)
    return None if missing and COLUMNS[name].nullable else value


@dataclass
class ExperimentStages:
    """Stages of one experiment: stored and computed results, their tables, and derived values.

    Parameters
    ----------
    processed : Path
    device, experiment : str
    trials : pyarrow.Table
        Rows of the trials table that belong to the experiment and are not excluded.
    excluded : tuple of Exclusion
        Trials of the experiment that are excluded.
    spring : float
        Stiffness k [N/m, Nm/rad] declared in the device file, or 0 (see `declared_spring`).
    measuring : Measuring
        Measuring conventions that follow the thesis.
    """

    processed: Path
    device: str
    experiment: str
    trials: pa.Table
    excluded: tuple[Exclusion, ...] = ()
    spring: float = 0.0
    measuring: Measuring = field(default_factory=Measuring)
    _tables: dict[str, pa.Table] = field(default_factory=dict)
    _found: dict[Callable[..., Any], Any] = field(default_factory=dict, init=False)
    _keys: dict[str, str] = field(default_factory=dict, init=False)
    _known_costs: dict[str, tuple[Floats, Floats, Floats, list[str]]] = field(default_factory=dict, init=False)

    @classmethod
    def stored(
        cls, processed: Path, device: str, experiment: str, spring: float = 0.0, measuring: Measuring | None = None
    ) -> Self:
        """Return the stages of a stored experiment. The table of trials is empty if all trials are excluded."""
        trials, excluded = split_trials(read_trials(processed, device, experiment), read_exclusions(processed))
        return cls(processed, device, experiment, trials, excluded, spring, measuring or Measuring())

    @cached_property
    def motion(self) -> Motion:
        """Kind of motion, which determines the units.

        Raises
        ------
        StoreError
            If the experiment mixes kinds of motion.
        """
        motions = set(self.trials.column("motion").to_pylist())
        if len(motions) != 1:
            raise StoreError(
                f"device {self.device!r}, experiment {self.experiment!r}: its logs mix {sorted(motions)}. "
                "Give the experiments different names in the headers of the logs, and ingest them into a new folder."
            )
        kind: Motion = motions.pop()
        return kind

    @cached_property
    def inputs_digest(self) -> str:
        """Hash of the logs and profiles from which the samples are computed."""
        # the location of the samples is excluded, since merged batches do not change results
        columns = ("trial_id", "source_sha256", "profile_sha256")
        rows = zip(*(self.trials.column(c).to_pylist() for c in columns), strict=True)
        return digest(sorted("|".join(map(str, row)) for row in rows))

    @cached_property
    def samples(self) -> Trials:
        """All trials of the experiment with their samples, which are read when a stage is computed."""
        return load_trials(self.processed, self.trials)

    @cached_property
    def _map(self) -> MapTrials:
        """Map of functions over the trials, in this process unless a stage is computed in other processes."""
        from pipeline.measured.stages.measured_trial import MeasuredTrials

        return MeasuredTrials(self.samples)

    def once(self, function: Callable[[Any], Result]) -> Result:
        """Return the cached result of a function of this experiment."""
        if function not in self._found:
            self._found[function] = function(self)
        found: Result = self._found[function]
        return found

    def map_trials(
        self, function: Callable[[MeasuredTrial], Result], places: Sequence[int] | None = None
    ) -> list[Result]:
        """Return the results of a function for each trial, or for those at the given places, in order."""
        from pipeline.measured.signal.verdict import Verdict

        places = range(len(self.samples)) if places is None else places
        columns = self.verdicts.verdict, self.verdicts.growth_per_s, self.verdicts.reason
        judged = [Verdict(str(columns[0][place]), float(columns[1][place]), columns[2][place]) for place in places]
        return self._map(function, places, judged)

    def key(self, stage: str) -> str:
        """Return the key of a valid result of a stage."""
        if stage not in self._keys:
            chosen: list[object] = [self.spring, self.measuring.final] if stage in SPRUNG else []
            chosen += [self.measuring.model_dump(exclude={"final"})] if stage == "mass" else []
            needs = [self.key(need) for need in NEEDS[stage]]
            self._keys[stage] = digest([stage, self.inputs_digest, code_digest("stages"), *chosen, *needs])
        return self._keys[stage]

    def is_stored(self, stage: str) -> bool:
        """Return whether a result with the current key is stored."""
        return self._stored_key(stage) == self.key(stage)

    def why_run(self, stage: str) -> str:
        """Return a text that explains why a stage is not reused."""
        stored = self._stored_key(stage)
        return (
            "no result is stored"
            if stored is None
            else "logs, exclusions, code or an earlier stage changed since the result was stored"
        )

    def _stored_key(self, stage: str) -> str | None:
        file = self._file(stage)
        return None if file is None else read_metadata(file).get("pipeline.key")

    def _file(self, stage: str) -> Path | None:
        return stage_file(self.processed, self.device, self.experiment, stage)

    def table(self, stage: str) -> pa.Table:
        """Return the result of a stage, from memory or from its file. If it is not stored, compute and store it."""
        if stage not in self._tables:
            file = self._file(stage)
            if file is not None and self.is_stored(stage):
                with suppress(StoreError):  # recompute a damaged result
                    self._tables[stage] = read_table(file)
            if stage not in self._tables:
                self._tables[stage] = self._computed(stage)
                folder = stage_folder(self.processed, self.device, self.experiment)
                with if_writable():
                    write_result(folder, stage, TABLE, parquet_bytes(self._tables[stage]))
        return self._tables[stage]

    def compute(self, stages: Sequence[str], mapped: MapTrials) -> None:
        """Compute and store stages in the given order, with a map that may send trials to other processes."""
        self.__dict__["_map"] = mapped
        try:
            for number, stage in enumerate(stages):
                with part_of_work("", number / len(stages), (number + 1) / len(stages)):
                    self.table(stage)
        finally:
            del self.__dict__["_map"]

    def take_over(self, tables: Mapping[str, pa.Table]) -> None:
        """Adopt results that another process has computed from the same trials."""
        self._tables |= tables

    def count_new_trials(self) -> int:
        """Return the number of trials without a reusable stored row of the first stage."""
        former = self._former(SAMPLED, self._common(SAMPLED, {}))
        return len(set(self.samples.digests) - set(former.column(ROW_KEY).to_pylist()))

    def _common(self, stage: str, inputs: Mapping[str, object]) -> str:
        """Return a hash of all inputs of the rows of a stage except their samples."""
        return digest([stage, code_digest("stages"), inputs, self.motion])

    def _computed(self, stage: str) -> pa.Table:
        # imported only for a computation, since stored results are read without the estimators
        from pipeline.measured.stages.stage import TrialStage
        from pipeline.measured.stages.stages import STAGES

        computation = STAGES[stage]
        if isinstance(computation, TrialStage):
            return self._of_trials(stage, computation)
        if computation.rests_on is None:
            more = {}
        else:
            more = {"common": self._common(stage, {"rests_on": self.once(computation.rests_on)})}
            if len(former := self._former(stage, more["common"])):
                return former.cast(arrow_schema(stage, motion=self.motion, metadata=self._stamp(stage, **more)))
        rows = computation.measure(self)
        columns = {name: [vars(row)[name] for row in rows] for name in TABLES[stage]}
        return to_arrow(stage, columns, motion=self.motion, metadata=self._stamp(stage, **more))

    def _of_trials(self, stage: str, computation: TrialStage[Any, Any]) -> pa.Table:
        """Compute a stage with one row per trial. Stored rows with the same inputs are reused."""
        from pipeline.measured.stages.stage import Missing

        inputs, samples = self.once(computation.inputs), self.samples
        given = {} if inputs is None else asdict(inputs)
        common = self._common(stage, given)
        former = self._former(stage, common)
        kept = set(former.column(ROW_KEY).to_pylist())
        new = [place for place, key in enumerate(samples.digests) if key not in kept]
        columns: dict[str, object] = {
            "trial_id": [samples.trial_id[place] for place in new],
            ROW_KEY: [samples.digests[place] for place in new],
            "stiffness": samples.stiffness[new],
            "damping": samples.damping[new],
        }
        names = [name for name in TABLES[stage] if name not in OF_TRIAL]
        if isinstance(inputs, Missing):
            columns |= dict.fromkeys(names, [None] * len(new)) | {"reason": [inputs.reason] * len(new)}
        else:
            measure = partial(stage_row, measure=computation.measure, inputs=inputs)
            rows = self._map(measure, new, None) if stage == SAMPLED else self.map_trials(measure, new)
            columns |= {name: [stored_value(name, vars(row)[name]) for row in rows] for name in names}
        table = pa.concat_tables([former, to_arrow(stage, columns, motion=self.motion)])
        place = {key: row for row, key in enumerate(table.column(ROW_KEY).to_pylist())}
        order = [place[key] for key in samples.digests]
        more = {"samples": samples.digest} if stage == SAMPLED else {}
        if stage == SAMPLED and self.excluded:
            more["excluded"] = " ".join(trial.trial_id for trial in self.excluded)
        metadata = self._stamp(stage, given=json.dumps(given), common=common, **more)
        return table.take(order).cast(arrow_schema(stage, motion=self.motion, metadata=metadata))

    def _former(self, stage: str, common: str) -> pa.Table:
        """Return the stored rows of a stage with the same inputs from the experiment, or none if they are damaged."""
        schema = arrow_schema(stage, motion=self.motion)
        file = self._file(stage)
        if file is not None and read_metadata(file).get("pipeline.common") == common:
            with suppress(StoreError):
                return read_table(file).replace_schema_metadata(schema.metadata)
        return schema.empty_table()

    def _stamp(self, stage: str, **more: str) -> Mapping[str, str]:
        code = code_digest("stages")
        return stamp(stage=stage, key=self.key(stage), inputs=self.inputs_digest, code=code, **more)

    def column(self, stage: str, name: str) -> Floats:
        """Return a numeric column of a stage as float64, with NaN for null."""
        values = self.table(stage).column(name).to_numpy(zero_copy_only=False)
        return np.asarray(values, dtype=np.float64)

    def texts(self, stage: str, name: str) -> list[str]:
        """Return a text column of a stage, with an empty string for null."""
        return [text or "" for text in self.table(stage).column(name).to_pylist()]

    def text(self, stage: str, name: str, row: int) -> str:
        """Return one cell of a text column of a stage, with an empty string for null."""
        return self.table(stage).column(name)[row].as_py() or ""

    @property
    def step_sizes(self) -> Floats:
        """Step F_0 of each trial from its header [N, Nm]."""
        return np.asarray(in_order(self.trials).column("step").to_numpy(), dtype=np.float64)

    @cached_property
    def verdicts(self) -> Verdicts:
        """Stored verdict of each trial."""
        return Verdicts(
            np.array(self.texts("response", "verdict"), dtype="<U9"),
            self.column("response", "growth_per_s"),
            tuple(self.texts("response", "reason")),
        )

    @cached_property
    def sampling_period_s(self) -> float:
        """Sampling period T [s], which is the same for all trials up to clock errors.

        Raises
        ------
        StoreError
            If the sampling periods of the trials differ.
        """
        periods = sorted(set(self.trials.column("sampling_period_s").to_pylist()))
        if periods[-1] - periods[0] > APART * periods[-1]:
            raise StoreError(
                f"device {self.device!r}, experiment {self.experiment!r}: sampling periods differ ({periods[:5]} s); "
                "expected one. Give the experiments different names in the headers of the logs, and ingest them into a "
                "new folder."
            )
        return float(periods[len(periods) // 2])

    @property
    def samples_digest(self) -> str:
        """Hash of the samples from which the results were computed, stored with the first stage."""
        return str(self.table(SAMPLED).schema.metadata[b"pipeline.samples"].decode())

    @cached_property
    def boundary_points(self) -> tuple[BoundaryPoint, ...]:
        """Stored stability boundary."""
        rows = self.table("boundary").to_pylist()
        return tuple(BoundaryPoint(**row) for row in rows)

    def cost(self, criterion: str) -> tuple[Floats, str]:
        """Return the cost of each trial by a criterion (NaN if none), and the reason if no trial has a cost."""
        return self._costs(criterion)[0], commonest(self.cost_reasons(criterion))

    def cost_reasons(self, criterion: str) -> list[str]:
        """Return the reason why each trial has no cost by a criterion, or a doubtful cost. It may be empty."""
        return self._costs(criterion)[3]

    def _costs(self, criterion: str) -> tuple[Floats, Floats, Floats, list[str]]:
        """Return costs, both ends of their intervals, and reasons. They are computed if no column stores them."""
        if criterion not in self._known_costs:
            stage, column = cost_column(criterion)
            if column in TABLES[stage]:
                value, low, high = (self.column(stage, f"{column}{end}") for end in ("", "_low", "_high"))
                self._known_costs[criterion] = value, low, high, self.texts(stage, "reason")
            else:
                self._known_costs[criterion] = self._other_costs(criterion)
        return self._known_costs[criterion]

    def _other_costs(self, criterion: str) -> tuple[Floats, Floats, Floats, list[str]]:
        """Return costs as in `_costs` by a criterion without a stored column."""
        from pipeline.measured.stages.stage import Missing
        from pipeline.measured.stages.stages import other_cost

        computation, nothing = other_cost(criterion_of(criterion)), np.full(len(self.samples), np.nan)
        inputs = self.once(computation.inputs)
        if isinstance(inputs, Missing):
            return nothing, nothing, nothing, [inputs.reason] * len(nothing)
        rows = self.map_trials(partial(stage_row, measure=computation.measure, inputs=inputs))
        names = ("cost", "cost_low", "cost_high")
        value, low, high = (np.array([vars(row)[name] for row in rows]) for name in names)
        return value, low, high, [vars(row)["reason"] for row in rows]

    def floor(self, criterion: str) -> Floats | None:
        """Return the apparent cost of each trial due to sensor and chatter, or None if the criterion has no such
        cost."""
        family = criterion_of(criterion).family
        return self.column(family.name, family.floor) if family.floor else None

    def sure_cost(self, criterion: str) -> Floats:
        """Return the cost of each trial as in `cost`, with 0 for a cost that is not significant."""
        cost, floor = self._costs(criterion)[0], self.floor(criterion)
        return cost if floor is None else np.where(without_overshoot(cost, floor), 0.0, cost)

    def cost_interval(self, criterion: str) -> tuple[Floats, Floats]:
        """Return the lower and the upper end of the 95 % interval of each trial's cost, or NaN if there is none."""
        return self._costs(criterion)[1:3]

    def optimum(self, criterion: str, limits: Sequence[BoundaryPoint] = ()) -> Optimum | None:
        """Return the best trial by a criterion, with its margin to measured limits, or None if no trial has this
        cost."""
        cost, _ = self.cost(criterion)
        trials, floor = self.texts("response", "trial_id"), self.floor(criterion)
        # a trial whose command follows a different wall did not test the stated wall
        stated = np.flatnonzero(np.isnan(self.column("wall_law", "obeyed_stiffness")))
        K, B = (self.column("response", name)[stated] for name in ("stiffness", "damping"))
        unstable, cost = self.verdicts.verdict[stated] == "unstable", cost[stated]
        floor = None if floor is None else floor[stated]
        best = choose_optimum(cost, K, B, tuple(trials[i] for i in stated), unstable=unstable, floor=floor)
        if best is None:
            return None
        free = np.zeros(len(cost), np.bool_) if floor is None else without_overshoot(cost, floor) & ~unstable
        decided = np.where(unstable, np.nan, cost)
        near = nearly_as_good(decided, K, best.cost, best.stiffness, free)
        point = next((each for each in limits if each.damping == best.damping), None)
        place: dict[str, object] = {
            "near": near_optimum(near, K, B),
            "margin": None if point is None or point.low is None else point.low / best.stiffness,
            "damping_range": stable_damping_range(limits, best.stiffness, best.damping),
            "scatter_percent": cost_scatter(decided, K, B),
        }
        trial = trials.index(str(best.trial_id))
        if (floors := self.floor(criterion)) is not None:
            place |= {"resolution": float(floors[trial]), "free_of_overshoot": bool(free.any())}
            place["is_alone"] = is_alone(free, K, B, best.stiffness, best.damping) if free.any() else None
        low, high = (float(ends[trial]) for ends in self.cost_interval(criterion))
        interval = {"cost_low": None if np.isnan(low) else low, "cost_high": None if np.isnan(high) else high}
        return Optimum(**{**dict(best), **interval, **place, "trials": int(np.isfinite(cost).sum())})
