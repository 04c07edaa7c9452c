"""What computes the stages of experiments, which are independent: the processes of this machine, or a Dask cluster.

The package for the latter is the extra ``cluster``; it is imported with the first cluster that is asked.
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
"""How long a scheduler is waited for [s]; one that restarts has lost what it was asked for anyway."""

NO_WORKER_S = 30.0
"""How long a run waits without any worker [s]: one that was killed is begun again by its nanny within seconds."""

_LOOK_S = 1.0
"""Time between two looks whether there is a worker [s]."""


Executor = Callable[[Collection[ExperimentStages], Collection[str]], None]
"""Computes and stores some stages of experiments, as far as it pays; each experiment has all of its trials."""


class ClusterError(PipelineError):
    """A cluster did not do all that it was asked for; what it did is stored."""


def executor_of(text: str) -> Executor:
    """Return the executor that a command names.

    Raises
    ------
    UsageError
        If the words name none, or the package for it is not installed.
    """
    if text == LOCAL:
        return compute_stages
    host, colon, port = text.removeprefix(SCHEME).rpartition(":")
    if not text.startswith(SCHEME) or not (host and colon and port.isdecimal()):
        raise UsageError(f"executor {text!r} is not known; expected {LOCAL}, or {SCHEME}HOST:PORT of a Dask scheduler.")
    check_installed("distributed", f"executor {text}")
    return partial(compute_on_cluster, f"tcp://{host}:{port}")


def compute_on_cluster(address: str, experiments: Collection[ExperimentStages], needed: Collection[str]) -> None:
    """Compute what is not stored yet by the workers of a Dask scheduler, each of which computes whole experiments.

    Parameters
    ----------
    address : str
        ``tcp://host:port`` of the scheduler.
    experiments, needed : collection
        As for `compute_stages`.

    Raises
    ------
    ClusterError
        If scheduler or workers are gone; what was computed until then is stored, and the message says what to do.
    StoreError
        If a worker cannot read what is stored, or runs other code.
    """
    waiting = unstored(experiments, needed)
    if not waiting:
        return
    from distributed import Client

    done: list[str] = []
    with (
        _told(address, done, len(waiting)),
        Client(address, timeout=CONNECT_S, set_as_default=False) as client,  # type: ignore[no-untyped-call]
    ):
        jobs = {client.submit(do, job_of(e, needed), stored_suffices=True, pure=False): e for e in waiting}
        for job in _finished(client, jobs):
            take(jobs[job], job.result())
            done.append(jobs[job].experiment)


def _finished(client: Client, jobs: Mapping[Future[Any], ExperimentStages]) -> Iterator[Future[Any]]:
    """Yield jobs as they end, in whatever way.

    Raises
    ------
    ClusterError
        If there is no worker.
    """
    ended: SimpleQueue[Future[Any]] = SimpleQueue()
    for job in jobs:
        job.add_done_callback(ended.put)  # type: ignore[no-untyped-call]  # the package leaves out its types
    left, seen = len(jobs), time.monotonic()
    while left:
        try:
            yield ended.get(timeout=_LOOK_S)
            left, seen = left - 1, time.monotonic()
        except Empty:
            if client.scheduler_info()["workers"]:
                seen = time.monotonic()
            elif time.monotonic() - seen > NO_WORKER_S:
                raise ClusterError(f"it has no worker since {NO_WORKER_S:g} s; start some with `dask worker`") from None


@contextmanager
def _told(address: str, done: Sized, waiting: int) -> Iterator[None]:
    """Turn errors of the cluster into one that says what is done and what to repeat."""
    try:
        yield
    except Exception as error:
        reason = _reason(error)
        if reason is None:
            raise
        raise ClusterError(
            f"Dask at {address}: {reason}. {len(done)} of {waiting} experiments are done and stored. Repeat the "
            "command when the cluster runs again: it does the rest. Without a cluster: --executor local."
        ) from error


def _reason(error: Exception) -> str | None:
    """Return in words what is wrong with a cluster, None where an error is none of a cluster."""
    from distributed import KilledWorker

    if isinstance(error, ClusterError):
        return str(error)
    if isinstance(error, KilledWorker):
        return f"an experiment ended {error.allowed_failures + 1} workers in a row; they may lack memory"
    if isinstance(error, RuntimeError) and "deserialization" in str(error):
        return "the scheduler or a worker lacks haptic-pipeline; install the same version for all of them"
    if isinstance(error, (CancelledError, OSError)) and not isinstance(error, PermissionError):
        first = (str(error).splitlines() or [type(error).__name__])[0]
        return f"its scheduler is gone or not to be reached ({first})"
    return None
