"""Pools of processes that compute, of which none is left when the one that started them ends."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection

from pipeline.base.process import begin_alone, end_when


@contextmanager
def process_pool(workers: int, begin: Callable[[], object] | None = None) -> Iterator[ProcessPoolExecutor]:
    """Yield processes that compute, and that end at once when the block is left by an exception or this process ends.

    Parameters
    ----------
    workers : int
    begin : callable, optional
        Called in each process before all else that it is asked for.

    Notes
    -----
    ``BrokenProcessPool`` is raised for a call where a process was killed, or could not import the caller's main program
    (typed in, or without a guard); the caller may then do the work himself.
    """
    # spawn: a fork would copy the locks of Arrow's threads in an unknown state, and hold the pipe open
    context = get_context("spawn")
    watched, held = context.Pipe(duplex=False)
    with watched, held, ProcessPoolExecutor(workers, context, _begin, (watched, begin)) as pool:
        try:
            yield pool
        except BaseException:
            held.close()  # nobody waits for what they compute
            pool.shutdown(cancel_futures=True)
            raise


def _begin(parent: Connection, begin: Callable[[], object] | None) -> None:
    """Begin a process of a pool; signals are for its parent, which ends it."""
    end_when(lambda: _closed(parent))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    begin_alone()
    if begin is not None:
        begin()


def _closed(parent: Connection) -> None:
    """Return when the other end of a pipe is closed; nothing is ever sent."""
    with suppress(EOFError, OSError):
        parent.recv_bytes()
