"""Processes of this package: what each does before anything else, when it ends, and pools that compute.

No process outlives the one that started it, whatever ends that. A worker waits on a pipe the other end of which its
parent alone holds: the operating system closes it when the parent ends. (The death signal of Linux would come when the
*thread* ends that started the worker.) A signal that asks for an end becomes an exception, so that files which are not
complete are taken away; a second one ends the process where it stands.
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
"""Signals that ask for an end: Ctrl-C, a service manager, a terminal that is closed; as far as the system has them."""

_alone = False
"""Whether this process runs nothing but this package."""


def begin_alone() -> None:
    """Begin a process that runs nothing but this package, before it loads numpy.

    Matrices are small here, and many processes compute at once: threads of the linear algebra would take as much
    processor time again to wait for each other, and sums would depend on their number. Who sets
    ``OPENBLAS_NUM_THREADS`` keeps it. And pyarrow is kept from importing pandas (`without_pandas`).
    """
    global _alone
    _alone = True
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


class _NoPandas:
    """Finds pandas nowhere, and leaves other modules to others."""

    @staticmethod
    def find_spec(name: str, *_: object) -> None:
        if name == "pandas":
            raise ModuleNotFoundError("pandas is left out while pyarrow looks for it")


def without_pandas(pyarrow: Any) -> None:
    """Keep pyarrow from importing pandas with its first array (0.2 s, 40 MB), in a process of this package alone.

    It looks once whether there is pandas; here it looks while there is none. Whoever imports pandas himself gets it,
    and so does ``Table.to_pandas``; ``pyarrow.array`` takes series of pandas for mere sequences then.
    """
    if _alone and "pandas" not in sys.modules:
        sys.meta_path.insert(0, _NoPandas)
        pyarrow.array([])
        sys.meta_path.remove(_NoPandas)


class Ended(BaseException):
    """A signal asked for the end of this process. No handler of errors catches it by accident.

    Parameters
    ----------
    number : int
        Of the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number

    def leave(self) -> None:
        """End this process as the signal does where nobody handles it, so that its parent is told of it."""
        signal.signal(self.number, signal.SIG_DFL)
        signal.raise_signal(self.number)


@contextmanager
def ending_on_signals() -> Iterator[None]:
    """Raise `Ended` in the block on a signal that asks for an end; the next one ends the process, which is safe, too.

    A signal that is ignored (nohup) stays so. What others make of that exception is an end, too: an extension module
    says that its import failed.
    """
    asked: list[int] = []
    former = {number: signal.getsignal(number) for number in STOP_SIGNALS}
    handled = [number for number, before in former.items() if before not in (signal.SIG_IGN, None)]

    def handle(number: int, frame: FrameType | None) -> None:
        asked.append(number)
        for other in handled:
            signal.signal(other, signal.SIG_DFL)
        raise Ended(number)

    try:
        for number in handled:
            signal.signal(number, handle)
        yield
    except Exception as error:
        if asked:
            raise Ended(asked[0]) from error
        raise
    finally:
        for number in handled:
            signal.signal(number, former[number])


@contextmanager
def process_pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Yield processes that compute, and that end at once when the block is left by an exception or this process ends.

    Notes
    -----
    ``BrokenProcessPool`` is raised for a call where a process was killed, or could not import the caller's main program
    (typed in, or without a guard); the caller may then do the work himself.
    """
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    # spawn: a fork would copy the locks of Arrow's threads in an unknown state, and hold the pipe open
    context = get_context("spawn")
    watched, held = context.Pipe(duplex=False)
    with watched, held, ProcessPoolExecutor(workers, context, _begin, (watched,)) as pool:
        try:
            yield pool
        except BaseException:
            held.close()  # nobody waits for what they compute
            pool.shutdown(cancel_futures=True)
            raise


def _begin(parent: Connection) -> None:
    """Begin a process of a pool; signals are for its parent, which ends it."""
    threading.Thread(target=_end_with, args=(parent,), name="end with the parent", daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    begin_alone()


def _end_with(parent: Connection) -> None:
    """End this process when the other end of a pipe is closed; nothing is ever sent."""
    with suppress(EOFError, OSError):
        parent.recv_bytes()
    os._exit(EXIT_ERROR)
