"""Executors for independent stages of experiments, which run in processes on this machine or on a Dask cluster.

A cluster needs the extra ``cluster``, which is imported when a cluster is first used.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sized
from concurrent.futures import CancelledError
from contextlib import contextmanager
from functools import partial
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any

from pipeline.base.errors import PipelineError, UsageError
from pipeline.comparison.stage_pool import compute_stages, do, job_of, take, unstored
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.store.objects import check_installed

if TYPE_CHECKING:
    from distributed import Client, Future

LOCAL, SCHEME = "local", "dask://"

CONNECT_S = 10.0
"""Time limit for connecting to a scheduler [s]. A restarted scheduler has lost its jobs in any case."""

NO_WORKER_S = 30.0
"""Time for which a run waits for a worker [s]. A nanny restarts a killed worker within seconds."""

_LOOK_S = 1.0
"""Interval at which the number of workers is checked [s]."""


Executor = Callable[[Collection[ExperimentStages], Collection[str]], None]
"""Function that computes and stores missing stages of experiments. Each experiment has all of its trials."""


class ClusterError(PipelineError):
    """A cluster completed only part of the requested work. The completed part is stored."""


def executor_of(text: str) -> Executor:
    """Return the executor with the given name.

    Raises
    ------
    UsageError
        If there is no such executor, or its package is not installed.
    """
    if text == LOCAL:
        return compute_stages
    host, colon, port = text.removeprefix(SCHEME).rpartition(":")
    if not text.startswith(SCHEME) or not (host and colon and port.isdecimal()):
        raise UsageError(f"executor {text!r} is unknown; expected {LOCAL}, or {SCHEME}HOST:PORT of a Dask scheduler.")
    check_installed("distributed", f"executor {text}")
    return partial(compute_on_cluster, f"tcp://{host}:{port}")


def compute_on_cluster(address: str, experiments: Collection[ExperimentStages], needed: Collection[str]) -> None:
    """Compute missing stages with the workers of a Dask scheduler. Each worker computes complete experiments.

    Parameters
    ----------
    address : str
        Address ``tcp://host:port`` of the scheduler.
    experiments, needed : collection
        As for `compute_stages`.

    Raises
    ------
    ClusterError
        If the scheduler or all workers are lost. Finished stages are stored, and the message gives the remedy.
    StoreError
        If a worker cannot read the store, or runs another version of the code.
    """
    waiting = unstored(experiments, needed)
    if not waiting:
        return
    from distributed import Client

    done: list[str] = []
    with (
        _reported(address, done, len(waiting)),
        Client(address, timeout=CONNECT_S, set_as_default=False) as client,  # type: ignore[no-untyped-call]
    ):
        jobs = {client.submit(do, job_of(e, needed), stored_suffices=True, pure=False): e for e in waiting}
        for job in _finished(client, jobs):
            take(jobs[job], job.result())
            done.append(jobs[job].experiment)


def _finished(client: Client, jobs: Mapping[Future[Any], ExperimentStages]) -> Iterator[Future[Any]]:
    """Yield jobs as they finish, fail or are cancelled.

    Raises
    ------
    ClusterError
        If there is no worker.
    """
    ended: SimpleQueue[Future[Any]] = SimpleQueue()
    for job in jobs:
        job.add_done_callback(ended.put)  # type: ignore[no-untyped-call]  # the package has no type annotations here
    left, seen = len(jobs), time.monotonic()
    while left:
        try:
            yield ended.get(timeout=_LOOK_S)
            left, seen = left - 1, time.monotonic()
        except Empty:
            if client.scheduler_info()["workers"]:
                seen = time.monotonic()
            elif time.monotonic() - seen > NO_WORKER_S:
                raise ClusterError(
                    f"it has had no worker for {NO_WORKER_S:g} s; start workers with `dask worker`"
                ) from None


@contextmanager
def _reported(address: str, done: Sized, waiting: int) -> Iterator[None]:
    """Convert errors of the cluster to a `ClusterError`, which states what is done and what to repeat."""
    try:
        yield
    except Exception as error:
        reason = _reason(error)
        if reason is None:
            raise
        raise ClusterError(
            f"Dask at {address}: {reason}. {len(done)} of {waiting} experiments are done and stored. Repeat the "
            "command when the cluster runs again; it computes the remaining experiments. Without a cluster, use "
            "--executor local."
        ) from error


def _reason(error: Exception) -> str | None:
    """Return the description of a cluster error, or None for any other error."""
    from distributed import KilledWorker

    if isinstance(error, ClusterError):
        return str(error)
    if isinstance(error, KilledWorker):
        return f"one experiment ended {error.allowed_failures + 1} workers in a row, perhaps because they lack memory"
    if isinstance(error, RuntimeError) and "deserialization" in str(error):
        return "the scheduler or a worker lacks haptic-pipeline; install the same version for all of them"
    if isinstance(error, (CancelledError, OSError)) and not isinstance(error, PermissionError):
        first = (str(error).splitlines() or [type(error).__name__])[0]
        return f"its scheduler cannot be reached ({first})"
    return None
