"""How the stages of an experiment are computed, stored and reused; of what each of them computes it knows nothing.

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
from typing import Any, ClassVar, Self, TypeVar

import numpy as np
import pyarrow as pa

from pipeline.base.disk import if_writable, write_kept
from pipeline.base.errors import StoreError
from pipeline.base.provenance import code_digest, digest, stamp
from pipeline.device.parameters import Motion
from pipeline.measured.experiment.stored import Experiment
from pipeline.measured.law.stamps import EVEN
from pipeline.measured.signal.verdict import Verdicts
from pipeline.measured.stages.stage_groups import Columns, Given, TrialGroup
from pipeline.measured.stages.stage_rows import Sources, stage_rows
from pipeline.records.batch import Booleans, Floats, TrialGroups
from pipeline.records.table_files import parquet_bytes, read_metadata, read_table
from pipeline.records.tables import arrow_schema, to_arrow
from pipeline.store.samples import load_groups
from pipeline.store.storage import (
    TABLE,
    Exclusion,
    read_exclusions,
    read_trials,
    split_trials,
    stage_file,
    stage_folder,
)

SAMPLED = "response"
"""Stage that every scene needs; its result is stored with a hash of the samples."""

ROW_KEY = "samples_sha256"
"""Column by which a row of a stage is known; what else it rests on is the same for all rows of a file."""

Result = TypeVar("Result")


@dataclass(frozen=True)
class Stage:
    """What computes a stage.

    Parameters
    ----------
    needs : tuple of str
        Stages whose results it takes.
    rows : callable, optional
        Makes the columns of some trials, for a stage with one row a trial.
    given : callable
        What the rows take from the whole experiment.
    whole : callable, optional
        Makes the columns from the whole experiment, for a stage without a row a trial.
    derived : callable, optional
        Makes columns that follow from the others by a value of the whole experiment, anew with each.
    sprung : bool
        Whether the rows take the declared spring of the experiment.
    """

    needs: tuple[str, ...] = ()
    rows: Callable[[TrialGroup, Given], Sources] | None = None
    given: Callable[[Experiment], Given] = lambda _: {}
    whole: Callable[[Experiment], Columns] | None = None
    derived: Callable[[Experiment, pa.Table], Columns] | None = None
    sprung: bool = False


@dataclass
class StageTables:
    """The tables of the stages of one experiment: what is stored, what is stale, and how to compute it.

    A class made from it says which stages there are.

    Parameters
    ----------
    processed : Path
    device, experiment : str
    trials : pyarrow.Table
        Rows of the trials table that belong to the experiment and are in use.
    excluded : tuple of Exclusion
        Its trials that are not.
    spring : float
        Stiffness k [N/m, Nm/rad] of the device that its file declares, 0 for none; see `declared_spring`.
    """

    stages: ClassVar[Mapping[str, Stage]]

    processed: Path
    device: str
    experiment: str
    trials: pa.Table
    excluded: tuple[Exclusion, ...] = ()
    spring: float = 0.0
    _tables: dict[str, pa.Table] = field(default_factory=dict)
    _found: dict[Callable[..., Any], Any] = field(default_factory=dict, init=False)
    _mapped: Callable[..., Iterable[Any]] = map

    @classmethod
    def stored(cls, processed: Path, device: str, experiment: str, spring: float = 0.0) -> Self:
        """Return the stages of a stored experiment; the table of trials has no row where all are excluded."""
        trials, excluded = split_trials(read_trials(processed, device, experiment), read_exclusions(processed))
        return cls(processed, device, experiment, trials, excluded, spring)

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

    @property
    def motion(self) -> Motion:
        """Kind of motion, which decides the units; errors as of `rotation`."""
        return "rotation" if self.rotation else "translation"

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

    def once(self, function: Callable[[Any], Result]) -> Result:
        """Return what a function finds in this experiment, which is kept."""
        if function not in self._found:
            self._found[function] = function(self)
        found: Result = self._found[function]
        return found

    def of_each(self, function: Callable[..., Result], **given: Any) -> list[Result]:
        """Return the results of a function of each group or part of one, `TrialGroup` and what is given, in order."""
        return list(self._mapped(partial(function, given=given), self._judged))

    def key(self, stage: str) -> str:
        """Return the key under which the result of a stage is valid."""
        made = self.stages[stage]
        spring = [self.spring] if made.sprung else []
        return digest(
            [stage, self.inputs_digest, code_digest("stages"), *spring, *(self.key(need) for need in made.needs)]
        )

    def is_stored(self, stage: str) -> bool:
        """Return whether a result with the present key is stored."""
        return self._stored_key(stage) == self.key(stage)

    def why_run(self, stage: str) -> str:
        """Return in words why a stage that is not reused has to run."""
        stored = self._stored_key(stage)
        return (
            "no result is stored"
            if stored is None
            else "logs, exclusions, code or an earlier stage changed since it was stored"
        )

    def _stored_key(self, stage: str) -> str | None:
        file = self._file(stage)
        return None if file is None else read_metadata(file).get("pipeline.key")

    def _file(self, stage: str) -> Path | None:
        return stage_file(self.processed, self.device, self.experiment, stage)

    def table(self, stage: str) -> pa.Table:
        """Return the result of a stage: from memory, from its file, or by computing and storing it."""
        if stage not in self._tables:
            file = self._file(stage)
            if file is not None and self.is_stored(stage):
                with suppress(StoreError):  # what is damaged is computed anew
                    self._tables[stage] = read_table(file)
            if stage not in self._tables:
                self._tables[stage] = self._computed(stage)
                folder = stage_folder(self.processed, self.device, self.experiment)
                with if_writable():
                    write_kept(folder, stage, TABLE, parquet_bytes(self._tables[stage]))
        return self._tables[stage]

    def compute(self, stages: Sequence[str], mapped: Callable[..., Iterable[Any]]) -> None:
        """Compute and store some stages, in this order, by a ``map`` that may cut groups and send them elsewhere."""
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
        return digest([stage, code_digest("stages"), given, self.rotation])

    def _computed(self, stage: str) -> pa.Table:
        made = self.stages[stage]
        if made.whole is not None:
            return to_arrow(stage, made.whole(self), rotation=self.rotation, metadata=self._stamp(stage))
        return self._of_trials(stage, made)

    def _of_trials(self, stage: str, made: Stage) -> pa.Table:
        """Compute a stage with one row a trial, but for the rows that are stored and rest on the same."""
        assert made.rows is not None, "a stage is made by rows or as a whole"
        given = made.given(self)
        common = self._common(stage, given)
        former = self._former(stage, common)
        kept = set(former.column(ROW_KEY).to_pylist())
        groups = self._groups if stage == SAMPLED else self._judged
        masks = [np.array([key not in kept for key in group.logged.digests]) for group in groups]
        new = [number for number, mask in enumerate(masks) if mask.any()]
        compute = partial(_new_rows, stage=stage, columns=made.rows, given=given, rotation=self.rotation)
        rows = pa.concat_tables([former, *self._mapped(compute, [groups[i] for i in new], [masks[i] for i in new])])
        if made.derived is not None:
            for name, values in made.derived(self, rows).items():
                index = rows.schema.get_field_index(name)
                rows = rows.set_column(index, rows.schema.field(name), pa.array(values, from_pandas=True))
        place = {key: row for row, key in enumerate(rows.column(ROW_KEY).to_pylist())}
        order = [place[key] for key in self.samples.of_trials("digests").tolist()]
        samples = {"samples": self.samples.digest} if stage == SAMPLED else {}
        if stage == SAMPLED and self.excluded:
            samples["excluded"] = " ".join(one.trial_id for one in self.excluded)
        metadata = self._stamp(stage, given=json.dumps(given), common=common, **samples)
        return rows.take(order).cast(arrow_schema(stage, rotation=self.rotation, metadata=metadata))

    def _former(self, stage: str, common: str) -> pa.Table:
        """Return the stored rows of a stage that rest on the same of the experiment; none where they are damaged."""
        schema = arrow_schema(stage, rotation=self.rotation)
        file = self._file(stage)
        if file is not None and read_metadata(file).get("pipeline.common") == common:
            with suppress(StoreError):
                return read_table(file).replace_schema_metadata(schema.metadata)
        return schema.empty_table()

    def _stamp(self, stage: str, **more: str) -> Mapping[str, str]:
        code = code_digest("stages")
        return stamp(stage=stage, key=self.key(stage), inputs=self.inputs_digest, code=code, **more)

    def column(self, stage: str, name: str) -> Floats:
        """Return a numeric column of a stage as float64, null as NaN."""
        values = self.table(stage).column(name).to_numpy(zero_copy_only=False)
        return np.asarray(values, dtype=np.float64)

    def texts(self, stage: str, name: str) -> list[str]:
        """Return a text column of a stage, null as an empty string."""
        return [text or "" for text in self.table(stage).column(name).to_pylist()]

    def text(self, stage: str, name: str, row: int) -> str:
        """Return one cell of a text column of a stage, null as an empty string."""
        return self.table(stage).column(name)[row].as_py() or ""

    @property
    def step_sizes(self) -> Floats:
        """Step F_0 of each trial by its header [N, Nm]."""
        return np.asarray(self.trials.column("step").to_numpy(), dtype=np.float64)

    @cached_property
    def verdicts(self) -> Verdicts:
        """Verdict of each trial, as stored."""
        return Verdicts(
            np.array(self.texts("response", "verdict"), dtype="<U9"),
            self.column("response", "growth_per_s"),
            tuple(self.texts("response", "reason")),
        )

    @cached_property
    def sampling_period_s(self) -> float:
        """Sampling period T [s], the same for all trials up to the error of clocks.

        Raises
        ------
        StoreError
            If trials differ.
        """
        periods = sorted(set(self.trials.column("sampling_period_s").to_pylist()))
        if periods[-1] - periods[0] > EVEN * periods[-1]:
            raise StoreError(
                f"device {self.device!r}, experiment {self.experiment!r}: sampling periods differ ({periods[:5]} s); "
                "expected one. Name the experiments apart in the logs' headers and ingest them into a new folder."
            )
        return float(periods[len(periods) // 2])


def _new_rows(of: TrialGroup, new: Booleans, **what: Any) -> pa.Table:
    return stage_rows(of.select(new), **what)
