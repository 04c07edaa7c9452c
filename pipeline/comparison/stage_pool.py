"""Computation of stages in several processes. A small experiment is computed by one process, a large one by all.

A `StageJob` is an experiment as it is sent to another process. A process keeps the trials that it receives, because
sending them with each job would take longer than the jobs.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import Executor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa

from pipeline.base.compiled import load_compiled
from pipeline.base.disk import if_writable
from pipeline.base.errors import StoreError
from pipeline.base.process import process_pool
from pipeline.base.progress import part_of_work, report
from pipeline.base.provenance import __version__, code_digest, digest
from pipeline.measured.signal.verdict import Verdict
from pipeline.measured.stages.measured_trial import MeasuredTrial, MeasuredTrials
from pipeline.measured.stages.stage_needs import NEEDS
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.records.models import Measuring
from pipeline.records.trials import Trials
from pipeline.store.objects import is_url, opened, origin, publish, renewed

Result = TypeVar("Result")

COMPILED = ("pipeline.measured", "pipeline.loop.free_run")
"""Modules and packages whose compiled functions the stages call."""

LARGE = 1000
"""Smallest number of new trials for which an experiment is shared between two processes, and number of further trials
for each further process. A thousand trials take about 3 s, and starting a process takes 1 s of processor time. For
2,220 trials, a second process saves 3 s of waiting and costs 2 s of processor time."""


def compute_stages(experiments: Collection[ExperimentStages], needed: Collection[str]) -> None:
    """Compute and store missing stages if there is work for more than one process.

    With less work, stages are computed when they are needed.

    Parameters
    ----------
    experiments : collection of ExperimentStages
        All trials of each experiment.
    needed : collection of str
        Stages that will be needed.
    """
    processors, waiting = os.cpu_count() or 1, unstored(experiments, needed)
    if processors < 2:
        return
    # An experiment with less than the share of one processor is not split, and need not wait for other processes after
    # each stage.
    share = sum(e.trials.num_rows for e in waiting) / processors
    new = [e.count_new_trials() if e.trials.num_rows > max(share, LARGE - 1) else 0 for e in waiting]
    large = [e for e, trials in zip(waiting, new, strict=True) if trials >= LARGE]
    small = [e for e, trials in zip(waiting, new, strict=True) if trials < LARGE]
    processes = min(max(len(small), 1 + max(new, default=0) // LARGE), processors)
    if processes < 2:
        return
    wanted = sorted(needed, key=list(NEEDS).index)
    load_compiled(*COMPILED)
    with single_processes(processes) as pools:
        try:
            count = len(large) + bool(small)
            for number, experiment in enumerate(large):
                with part_of_work("", number / count, (number + 1) / count):
                    experiment.compute(wanted, SharedTrials(pools, experiment.samples))
            done = map_jobs(pools, partial(do, stored_suffices=False), [job_of(e, wanted) for e in small])
            for experiment, tables in zip(small, done, strict=True):
                take(experiment, tables)
        except BrokenProcessPool:
            # A process was killed, or could not import the caller's main program (typed in, or without a guard). The
            # stages are then computed in this process when they are needed.
            return


def unstored(experiments: Collection[ExperimentStages], needed: Collection[str]) -> list[ExperimentStages]:
    """Return the experiments that lack a stage, sorted by decreasing length, so that processes finish at similar
    times."""
    waiting = [e for e in experiments if not all(e.is_stored(stage) for stage in needed)]
    return sorted(waiting, key=lambda e: -e.trials.num_rows)


@dataclass(frozen=True)
class StageJob:
    """An experiment whose stages are to be computed, in the form in which it is sent to another process.

    Parameters
    ----------
    place : str
        Folder or URL of its trials.
    device, experiment : str
    spring, measuring : float, Measuring
        As for `ExperimentStages`.
    wanted : tuple of str
        Stages in the order of computation.
    code : str
        Hash of the code that must compute them.
    """

    place: str
    device: str
    experiment: str
    spring: float
    measuring: Measuring
    wanted: tuple[str, ...]
    code: str


def job_of(experiment: ExperimentStages, needed: Collection[str]) -> StageJob:
    """Return the job of computing the given stages of an experiment."""
    place = origin(experiment.processed)
    place = place if is_url(place) else str(Path(place).absolute())
    wanted = tuple(sorted(needed, key=list(NEEDS).index))
    e = experiment
    return StageJob(place, e.device, e.experiment, e.spring, e.measuring, wanted, _code())


def do(job: StageJob, stored_suffices: bool) -> dict[str, pa.Table]:
    """Compute and store the stages of a job, and return their tables.

    Parameters
    ----------
    job : StageJob
    stored_suffices : bool
        Whether to return only the tables that could not be stored.

    Raises
    ------
    StoreError
        If this process cannot access the trials, or has other code than the sender.
    """
    if job.code != _code():
        raise StoreError(
            f"a worker runs other code (version {__version__}) than the command that sends it work, so its results "
            "could differ. Install the same version for all workers, and restart them."
        )
    if not is_url(job.place) and not Path(job.place).is_dir():
        raise StoreError(
            f"{job.place}: a worker cannot access this folder. All workers need the same folder under the same path, "
            "or an object store (--processed s3://BUCKET/PREFIX)."
        )
    with opened(job.place, job.device, job.experiment) as processed:
        stages = ExperimentStages.stored(processed, job.device, job.experiment, job.spring, job.measuring)
        tables = {stage: stages.table(stage) for stage in job.wanted}
        with if_writable():
            publish(processed)
            if stored_suffices:
                tables = {stage: table for stage, table in tables.items() if not stages.is_stored(stage)}
        return tables


def take(experiment: ExperimentStages, tables: dict[str, pa.Table]) -> None:
    """Add the tables of a finished job to an experiment."""
    renewed(experiment.processed, "stages")
    experiment.take_over(tables)


def _code() -> str:
    return digest([__version__, code_digest("stages")])


@contextmanager
def single_processes(count: int) -> Iterator[Sequence[Executor]]:
    """Yield pools with one process each, which are closed as described in `process_pool`."""
    with ExitStack() as stack:
        yield [stack.enter_context(process_pool(1)) for _ in range(count)]


def map_jobs(pools: Sequence[Executor], function: Callable[..., Result], jobs: Sequence[Any]) -> list[Result]:
    """Return the results of a function for jobs, which must be sorted by decreasing length."""
    # Jobs are distributed back and forth, so that the pool with the longest job receives the shortest next one.
    order = [*range(len(pools)), *reversed(range(len(pools)))]
    running = [pools[order[n % len(order)]].submit(function, job) for n, job in enumerate(jobs)]
    results = list[Result]()
    for number, job in enumerate(running):
        report(number / len(running))
        results.append(job.result())
    return results


class SharedTrials:
    """Map functions over the trials of an experiment in processes, as a `MapTrials`.

    Parameters
    ----------
    pools : sequence of Executor
        Pools with one process each. Trials are assigned in turn, because neighbours take similar times.
    trials : Trials
    """

    def __init__(self, pools: Sequence[Executor], trials: Trials) -> None:
        self._pools, self._number = pools, next(_numbers)
        shares = (trials.select(np.arange(first, len(trials), len(pools))) for first in range(len(pools)))
        for sent in [pool.submit(_keep, self._number, share) for pool, share in zip(pools, shares, strict=True)]:
            sent.result()

    def __call__(
        self, function: Callable[[MeasuredTrial], Result], places: Sequence[int], verdicts: Sequence[Verdict] | None
    ) -> list[Result]:
        """Return the results of a function for the trials at the given places, with the given verdicts, in this
        order."""
        count, jobs = len(self._pools), []
        for first, pool in enumerate(self._pools):
            dealt = [i for i, place in enumerate(places) if place % count == first]
            if dealt:
                own = [places[i] // count for i in dealt]
                judged = None if verdicts is None else [verdicts[i] for i in dealt]
                jobs.append((dealt, pool.submit(_apply, self._number, function, own, judged)))
        results = dict(pair for dealt, job in jobs for pair in zip(dealt, job.result(), strict=True))
        return [results[i] for i in range(len(places))]


_numbers = itertools.count()

_kept: dict[int, MeasuredTrials] = {}
"""Trials sent to this process, by the number of their `SharedTrials`."""


def _keep(number: int, trials: Trials) -> None:
    _kept[number] = MeasuredTrials(trials)


def _apply(
    number: int,
    function: Callable[[MeasuredTrial], Result],
    places: Sequence[int],
    verdicts: Sequence[Verdict] | None,
) -> list[Result]:
    return _kept[number](function, places, verdicts)
