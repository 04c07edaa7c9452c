"""The stages of one experiment as a job for another process: what it is given, and what it hands back."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa

from pipeline import __version__
from pipeline.base.disk import if_writable
from pipeline.base.errors import StoreError
from pipeline.base.provenance import code_digest, digest
from pipeline.measured.stages.stages import STAGES, ExperimentStages
from pipeline.store.manifests import Manifest
from pipeline.store.working_copy import Snapshot, publish, reopened, results_in, snapshot, take_results


@dataclass(frozen=True)
class StageJob:
    """An experiment whose stages are to be computed, as it is sent to another process.

    Parameters
    ----------
    place : Path or Snapshot
        Where its trials are.
    device, experiment : str
    spring : float
        As for `ExperimentStages`.
    wanted : tuple of str
        Stages, in the order in which they are computed.
    code : str
        Hash of the code that is to compute them.
    """

    place: Path | Snapshot
    device: str
    experiment: str
    spring: float
    wanted: tuple[str, ...]
    code: str


@dataclass(frozen=True)
class StagesDone:
    """What a job came to: tables that are handed back, and the manifests by which the others are found."""

    tables: dict[str, pa.Table]
    manifests: tuple[Manifest, ...]


def job_of(experiment: ExperimentStages, needed: Collection[str]) -> StageJob:
    """Return the job of computing some stages of an experiment."""
    place = snapshot(experiment.processed, experiment.device, experiment.experiment)
    wanted = tuple(sorted(needed, key=list(STAGES).index))
    return StageJob(place, experiment.device, experiment.experiment, experiment.spring, wanted, _code())


def do(job: StageJob, stored_suffices: bool) -> StagesDone:
    """Compute the stages of a job and store them.

    Parameters
    ----------
    job : StageJob
    stored_suffices : bool
        Whether only tables are handed back that could not be stored.

    Raises
    ------
    StoreError
        If the trials are not to be seen from here, or the code here is another one.
    """
    if job.code != _code():
        raise StoreError(
            f"a worker runs other code (version {__version__}) than the command that sends it work, and its results "
            "would not be those of the command. Install the same version for the workers and start them again."
        )
    if isinstance(job.place, Path) and not job.place.is_dir():
        raise StoreError(
            f"{job.place}: a worker sees no such folder. Workers need the same folder under the same path, or an "
            "object store (--processed s3://BUCKET/PREFIX)."
        )
    with reopened(job.place) as processed:
        stages = ExperimentStages.stored(processed, job.device, job.experiment, job.spring)
        tables = {stage: stages.table(stage) for stage in job.wanted}
        with if_writable():
            publish(processed)
            if stored_suffices:
                tables = {stage: table for stage, table in tables.items() if not stages.is_stored(stage)}
        return StagesDone(tables, results_in(processed))


def take(experiment: ExperimentStages, done: StagesDone) -> None:
    """Take what a job came to."""
    take_results(experiment.processed, done.manifests)
    experiment.take_over(done.tables)


def _code() -> str:
    return digest([__version__, code_digest("stages")])
