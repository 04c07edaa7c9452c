"""Start and end of this package's processes, and pools of worker processes.

A worker ends when the process that started it ends for any reason. The worker waits on a pipe whose other end is open
only in its parent. The operating system closes the pipe when the parent ends. (Linux's parent-death signal would be
sent when the starting *thread* ends.) A termination signal is raised as an exception, so that incomplete files are
removed. A second signal ends the process immediately.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import TYPE_CHECKING, Any

from pipeline.base.errors import EXIT_ERROR

if TYPE_CHECKING:
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing.connection import Connection

STOP_SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK") if hasattr(signal, name)
)
"""Termination signals of this system, sent by Ctrl-C, a service manager or a closed terminal."""

_alone = False
"""True if this process executes only code of this package."""


def begin_alone() -> None:
    """Configure a process that executes only code of this package, before numpy is imported.

    The linear algebra library uses one thread, unless the user has set ``OPENBLAS_NUM_THREADS``. Matrices are small,
    and many processes compute simultaneously. Threads that wait for each other would double the processor time, and
    sums would depend on the number of threads. In addition, pyarrow is prevented from importing pandas
    (`without_pandas`).
    """
    global _alone
    _alone = True
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


class _NoPandas:
    """Import finder that hides pandas and leaves other modules to the next finder."""

    @staticmethod
    def find_spec(name: str, *_: object) -> None:
        if name == "pandas":
            raise ModuleNotFoundError("pandas is hidden from pyarrow")


def without_pandas(pyarrow: Any) -> None:
    """Prevent pyarrow from importing pandas with its first array (0.2 s, 40 MB), but only in processes of this package.

    pyarrow searches for pandas only once. This function triggers the search while pandas is hidden. An explicit import
    of pandas and ``Table.to_pandas`` still work. ``pyarrow.array`` then treats a pandas series as a plain sequence.
    """
    if _alone and "pandas" not in sys.modules:
        sys.meta_path.insert(0, _NoPandas)
        pyarrow.array([])
        sys.meta_path.remove(_NoPandas)


class Ended(BaseException):
    """Exception for a received termination signal.

    It is a ``BaseException``, so that error handlers do not catch it by accident.

    Parameters
    ----------
    number : int
        Number of the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number

    def leave(self) -> None:
        """End this process as the unhandled signal would have done, so that its parent sees the reason."""
        signal.signal(self.number, signal.SIG_DFL)
        signal.raise_signal(self.number)


@contextmanager
def ending_on_signals() -> Iterator[None]:
    """Raise `Ended` in the block on the first termination signal. The next signal ends the process.

    A signal that is ignored, for example by nohup, stays ignored. Any exception after the signal is replaced by `Ended`
    because an extension module reports an interrupted import as a failed import.
    """
    received: list[int] = []
    former = {number: signal.getsignal(number) for number in STOP_SIGNALS}
    handled = [number for number, before in former.items() if before not in (signal.SIG_IGN, None)]

    def handle(number: int, frame: FrameType | None) -> None:
        received.append(number)
        for other in handled:
            signal.signal(other, signal.SIG_DFL)
        raise Ended(number)

    try:
        for number in handled:
            signal.signal(number, handle)
        yield
    except Exception as error:
        if received:
            raise Ended(received[0]) from error
        raise
    finally:
        for number in handled:
            signal.signal(number, former[number])


@contextmanager
def process_pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Yield a pool of processes, which end immediately if the block raises an exception or this process ends.

    Notes
    -----
    A call raises ``BrokenProcessPool`` if a process was killed. This exception is also raised if a process cannot
    import the main program of the caller, for example in an interactive session. The caller may then compute in its own
    process.
    """
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    # a fork would copy locks of Arrow's threads in an undefined state and keep the pipe open
    context = get_context("spawn")
    watched, held = context.Pipe(duplex=False)
    with watched, held, ProcessPoolExecutor(workers, context, _begin, (watched,)) as pool:
        try:
            yield pool
        except BaseException:
            held.close()  # the results are no longer needed
            pool.shutdown(cancel_futures=True)
            raise


def _begin(parent: Connection) -> None:
    """Initialise a worker of a pool. A worker ignores Ctrl-C, because its parent handles signals and ends the
    worker."""
    threading.Thread(target=_end_with, args=(parent,), name="end with the parent", daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    begin_alone()


def _end_with(parent: Connection) -> None:
    """End this process when the other end of a pipe is closed. No data are ever sent through it."""
    with suppress(EOFError, OSError):
        parent.recv_bytes()
    os._exit(EXIT_ERROR)
