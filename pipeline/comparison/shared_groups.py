"""Groups of trials that several processes compute from: each process keeps the parts that it was given once.

Sent with each job they would take longer than the jobs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Any, TypeVar

from pipeline.base.process import process_pool
from pipeline.measured.signal.verdict import Verdicts
from pipeline.measured.stages.stage_groups import TrialGroup
from pipeline.records.batch import Booleans, TrialBatch

Result = TypeVar("Result")

FEWEST = 500
"""Trials of a job, at least: the rounds of a fit over fewer cost a fifth more, over 250 three quarters."""


@dataclass
class SharedGroups:
    """Maps functions over groups of trials in processes, each of which is a pool of its own.

    Parameters
    ----------
    pools : sequence of Executor
        A group is cut into as many jobs, so that all of them have as much to do.
    """

    pools: Sequence[Executor]
    _parts: dict[int, tuple[TrialBatch, list[tuple[slice, TrialBatch, int]]]] = field(default_factory=dict)
    _sent: set[int] = field(default_factory=set)

    def map(
        self, function: Callable[..., Result], groups: Sequence[TrialGroup], *masks: Sequence[Booleans]
    ) -> list[Result]:
        """Return the results of a function of parts of the groups, in order.

        Parameters
        ----------
        function : callable
            Takes a group, and a mask of its trials where masks are given.
        groups : sequence of TrialGroup
        *masks : sequence of bool, shape (n,)
            A mask for each group; parts of which it picks no trial are left out.
        """
        jobs = []
        for group, *of in zip(groups, *masks, strict=True):
            for some, part, number in self._cut(group.batch):
                if all(mask[some].any() for mask in of):
                    given = None if number in self._sent else part
                    self._sent.add(number)
                    what = (function, number, given, group.verdicts.select(some), *(mask[some] for mask in of))
                    jobs.append(self.pools[number % len(self.pools)].submit(_apply, *what))
        return [job.result() for job in jobs]

    def _cut(self, batch: TrialBatch) -> list[tuple[slice, TrialBatch, int]]:
        # the batch is kept with its parts, so that no other one gets its id
        if id(batch) not in self._parts:
            number = sum(len(parts) for _, parts in self._parts.values())
            jobs = max(min(len(self.pools), len(batch) // FEWEST), 1)
            cut = enumerate(batch.portions(-(-len(batch) // jobs)), number)
            self._parts[id(batch)] = batch, [(some, part, number) for number, (some, part) in cut]
        return self._parts[id(batch)][1]

    def each(self, function: Callable[..., Result], jobs: Sequence[Any]) -> list[Result]:
        """Return the results of a function of some jobs, the longest of which come first."""
        # in turns there and back, so that the second longest has no shorter ones behind it than the longest
        order = [*range(len(self.pools)), *reversed(range(len(self.pools)))]
        running = [self.pools[order[n % len(order)]].submit(function, job) for n, job in enumerate(jobs)]
        return [job.result() for job in running]


@contextmanager
def shared_groups(workers: int) -> Iterator[SharedGroups]:
    """Yield processes that share groups of trials; they end as `process_pool` says."""
    with ExitStack() as stack:
        yield SharedGroups([stack.enter_context(process_pool(1)) for _ in range(workers)])


_kept: dict[int, TrialGroup] = {}
"""What this process was given."""


def _apply(
    function: Callable[..., Result], number: int, part: TrialBatch | None, verdicts: Verdicts, *masks: Booleans
) -> Result:
    if part is not None:
        _kept[number] = TrialGroup(part)
    group = _kept[number]
    group.verdicts = verdicts
    return function(group, *masks)
