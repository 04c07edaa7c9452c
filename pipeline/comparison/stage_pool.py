"""Stages computed by several processes: small experiments each in one, the groups of trials of large ones by all."""

from __future__ import annotations

import os
from collections.abc import Collection
from concurrent.futures.process import BrokenProcessPool
from functools import partial

from pipeline.comparison.shared_groups import shared_groups
from pipeline.comparison.stage_job import do, job_of, take
from pipeline.measured.stages.stages import STAGES, ExperimentStages

LARGE = 1000
"""New trials from which on an experiment is shared among processes: some 3 s of work, against 1 s to start them."""


def compute_stages(experiments: Collection[ExperimentStages], needed: Collection[str]) -> None:
    """Compute and store what is not stored yet, where there is work for more than one process.

    With less there is nothing to gain, and the stages are computed when they are asked for.

    Parameters
    ----------
    experiments : collection of ExperimentStages
        All trials of each experiment.
    needed : collection of str
        Stages that will be asked for.
    """
    processors = os.cpu_count() or 1
    waiting = [e for e in experiments if not all(e.is_stored(stage) for stage in needed)]
    if processors < 2:
        return
    # what is less than the share of a processor need not be cut, and waits for no other process after each stage
    share = sum(e.trials.num_rows for e in waiting) / processors
    large = [e for e in waiting if e.trials.num_rows > share and e.count_new_trials() >= LARGE]
    small = [e for e in waiting if all(e is not other for other in large)]
    if not large and len(small) < 2:
        return
    # the longest first, so that no processor ends up waiting for the last
    small.sort(key=lambda e: -e.trials.num_rows)
    wanted = sorted(needed, key=list(STAGES).index)
    with shared_groups(processors if large else min(len(small), processors)) as shared:
        try:
            for experiment in large:
                experiment.compute(wanted, shared.map)
            done = shared.each(partial(do, stored_suffices=False), [job_of(e, wanted) for e in small])
            for experiment, tables in zip(small, done, strict=True):
                take(experiment, tables)
        except BrokenProcessPool:
            # a process was killed, or could not import the caller's main program (typed in, or without a guard): the
            # stages are computed here when they are asked for
            return
