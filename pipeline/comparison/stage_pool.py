"""Stages of several experiments computed at once, each experiment in a process of its own."""

from __future__ import annotations

import os
from collections.abc import Collection
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

from pipeline.base.process_pool import process_pool
from pipeline.measured.stages import STAGES, ExperimentStages
from pipeline.store.storage import read_trials


def compute_stages(experiments: Collection[ExperimentStages], needed: Collection[str]) -> None:
    """Compute and store what is not stored yet, where more than one experiment and one processor are there.

    With less there is nothing to gain, and the stages are computed when they are asked for.

    Parameters
    ----------
    experiments : collection of ExperimentStages
        All trials of each experiment.
    needed : collection of str
        Stages that will be asked for.
    """
    waiting = [e for e in experiments if not all(e.is_stored(stage) for stage in needed)]
    workers = min(len(waiting), os.cpu_count() or 1)
    if workers < 2:
        return
    # the longest first, so that no processor ends up waiting for the last
    waiting.sort(key=lambda e: -e.trials.num_rows)
    with process_pool(workers) as pool:
        jobs = [pool.submit(_compute, e.processed, e.device, e.experiment, tuple(needed)) for e in waiting]
        try:
            for job in jobs:
                job.result()
        except BrokenProcessPool:
            # a process was killed, or could not import the caller's main program (typed in, or without a guard): the
            # stages are computed here when they are asked for
            return


def _compute(processed: Path, device: str, experiment: str, needed: tuple[str, ...]) -> None:
    stages = ExperimentStages(processed, device, experiment, read_trials(processed, device, experiment))
    for stage in sorted(needed, key=STAGES.index):
        stages.table(stage)
