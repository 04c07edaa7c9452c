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
from pipeline.store.objects import is_url, opened, origin, publish, renewed


@dataclass(frozen=True)
class StageJob:
    """An experiment whose stages are to be computed, as it is sent to another process.

    Parameters
    ----------
    place : str
        Folder or URL of its trials.
    device, experiment : str
    spring : float
        As for `ExperimentStages`.
    wanted : tuple of str
        Stages, in the order in which they are computed.
    code : str
        Hash of the code that is to compute them.
    """

    place: str
    device: str
    experiment: str
    spring: float
    wanted: tuple[str, ...]
    code: str


def job_of(experiment: ExperimentStages, needed: Collection[str]) -> StageJob:
    """Return the job of computing some stages of an experiment."""
    place = origin(experiment.processed)
    place = place if is_url(place) else str(Path(place).absolute())
    wanted = tuple(sorted(needed, key=list(STAGES).index))
    return StageJob(place, experiment.device, experiment.experiment, experiment.spring, wanted, _code())


def do(job: StageJob, stored_suffices: bool) -> dict[str, pa.Table]:
    """Compute the stages of a job and store them; return their tables.

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
    if not is_url(job.place) and not Path(job.place).is_dir():
        raise StoreError(
            f"{job.place}: a worker sees no such folder. Workers need the same folder under the same path, or an "
            "object store (--processed s3://BUCKET/PREFIX)."
        )
    with opened(job.place, job.device, job.experiment) as processed:
        stages = ExperimentStages.stored(processed, job.device, job.experiment, job.spring)
        tables = {stage: stages.table(stage) for stage in job.wanted}
        with if_writable():
            publish(processed)
            if stored_suffices:
                tables = {stage: table for stage, table in tables.items() if not stages.is_stored(stage)}
        return tables


def take(experiment: ExperimentStages, tables: dict[str, pa.Table]) -> None:
    """Take what a job came to."""
    renewed(experiment.processed, "stages")
    experiment.take_over(tables)


def _code() -> str:
    return digest([__version__, code_digest("stages")])
