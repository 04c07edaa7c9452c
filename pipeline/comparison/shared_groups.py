"""Groups of trials that several processes compute from: their samples lie in one file that all of them map into memory.

Sent through a pipe with each job they would take longer than the jobs. The file has no name, so that nothing is left of
it however the processes end. Where there is none (Windows, no room for it) the samples go through the pipe.
"""

from __future__ import annotations

import errno
import mmap
import os
import pickle
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache, partial
from io import FileIO
from multiprocessing import reduction
from tempfile import TemporaryFile
from typing import Any, TypeVar

from pipeline.base.process_pool import process_pool
from pipeline.measured.signal.verdict import Verdicts
from pipeline.measured.stages.stage_groups import TrialGroup
from pipeline.records.batch import Booleans, TrialBatch

Result = TypeVar("Result")

FEWEST = 500
"""Trials of a job, at least: the rounds of a fit over fewer cost a fifth more, over 250 three quarters."""

_ALIGNMENT = 64
"""Arrays begin at multiples of so many bytes, as numpy's own do."""

Spans = tuple[tuple[int, int], ...]
"""Where each array of a batch begins and ends in the file, and last the batch without them."""


class _Inherited:
    """A file that processes inherit when they are started."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        self.content = memoryview(b"")

    def until(self, end: int) -> memoryview:
        """Return the content, which is mapped anew where it has grown since: each mapping keeps the file open."""
        if len(self.content) < end:
            self.content = memoryview(mmap.mmap(self.descriptor, 0, access=mmap.ACCESS_READ))
        return self.content

    def __reduce__(self) -> tuple[Callable[..., _Inherited], tuple[Any]]:
        return _detached, (reduction.DupFd(self.descriptor),)


def _detached(inherited: Any) -> _Inherited:
    return _Inherited(inherited.detach())


@dataclass
class SharedGroups:
    """Maps functions over groups of trials in the processes of a pool.

    Parameters
    ----------
    pool : Executor
    workers : int
        Number of its processes; a group is cut into as many jobs, so that all of them have as much to do.
    """

    pool: Executor
    workers: int
    _file: FileIO | None
    _shared: dict[int, tuple[TrialBatch, list[tuple[slice, Spans | TrialBatch]]]] = field(default_factory=dict)

    def map(
        self, function: Callable[..., Result], groups: Sequence[TrialGroup], *masks: Sequence[Booleans]
    ) -> Iterable[Result]:
        """Return the results of a function of parts of the groups, in order.

        Parameters
        ----------
        function : callable
            Takes a group, and a mask of its trials where masks are given.
        groups : sequence of TrialGroup
        *masks : sequence of bool, shape (n,)
            A mask for each group; parts of which it picks no trial are left out.
        """
        jobs = [
            (part, group.verdicts.select(some), *(mask[some] for mask in of))
            for group, *of in zip(groups, *masks, strict=True)
            for some, part in self._parts(group.batch)
            if all(mask[some].any() for mask in of)
        ]
        return self.pool.map(partial(_apply, function), *zip(*jobs, strict=True)) if jobs else ()

    def _parts(self, batch: TrialBatch) -> list[tuple[slice, Spans | TrialBatch]]:
        # the batch is kept with its parts, so that no other one gets its id
        if id(batch) not in self._shared:
            jobs = max(min(self.workers, len(batch) // FEWEST), 1)
            parts = [(some, self._share(part)) for some, part in batch.portions(-(-len(batch) // jobs))]
            self._shared[id(batch)] = batch, parts
        return self._shared[id(batch)][1]

    def _share(self, batch: TrialBatch) -> Spans | TrialBatch:
        if self._file is not None:
            with suppress(OSError):
                return _write(batch, self._file)
        return batch


@contextmanager
def shared_groups(workers: int) -> Iterator[SharedGroups]:
    """Yield a pool of processes that share groups of trials; it ends as `process_pool` says."""
    with ExitStack() as stack:
        file, begin = None, None
        if sys.platform != "win32":
            with suppress(OSError):
                file = stack.enter_context(TemporaryFile(buffering=0))
                begin = partial(_take, _Inherited(file.fileno()))
        pool = stack.enter_context(process_pool(workers, begin))
        yield SharedGroups(pool, workers, file)


def _write(batch: TrialBatch, file: FileIO) -> Spans:
    buffers: list[pickle.PickleBuffer] = []
    rest = pickle.dumps(batch, protocol=5, buffer_callback=buffers.append)
    spans = []
    for content in (*(buffer.raw() for buffer in buffers), memoryview(rest)):
        begin = file.seek(-(-file.tell() // _ALIGNMENT) * _ALIGNMENT)
        if file.write(content) < len(content):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        spans.append((begin, file.tell()))
    return tuple(spans)


_taken: list[_Inherited] = []
"""The file of a process of the pool."""


def _take(file: _Inherited) -> None:
    _taken.append(file)


@cache
def _read(spans: Spans) -> TrialGroup:
    """Return the trials of a batch whose arrays are those of the file; once in each process."""
    content = _taken[0].until(spans[-1][1])
    *buffers, rest = (content[begin:end] for begin, end in spans)
    return TrialGroup(pickle.loads(rest, buffers=buffers))


def _apply(function: Callable[..., Result], part: Spans | TrialBatch, verdicts: Verdicts, *mask: Booleans) -> Result:
    group = TrialGroup(part) if isinstance(part, TrialBatch) else _read(part)
    group.verdicts = verdicts
    return function(group, *mask)
