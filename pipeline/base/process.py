"""Processes of this package: what each does before anything else, and when it ends.

No process outlives the one that started it, whatever ends that. A worker waits on a pipe the other end of which its
parent alone holds: the operating system closes it when the parent ends. (The death signal of Linux would come when the
*thread* ends that started the worker.) A signal that asks for an end becomes an exception, so that files which are not
complete are taken away; a second one ends the process where it stands.
"""

from __future__ import annotations

import os
import select
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.machinery import ModuleSpec, PathFinder
from types import FrameType, ModuleType
from typing import Any

from pipeline.base.errors import EXIT_ERROR, UsageError

STOP_SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK") if hasattr(signal, name)
)
"""Signals that ask for an end: Ctrl-C, a service manager, a terminal that is closed; as far as the system has them."""


ADDRESS_SPACE = 2 << 30
"""Bytes of address space that a comparison reserves, of which it uses a tenth. With less OpenBLAS tries again and again
to get its buffers, without end."""


def check_address_space() -> None:
    """Refuse to compute under a limit that numerical libraries do not live with.

    Raises
    ------
    UsageError
        If the process may reserve less than `ADDRESS_SPACE`.
    """
    try:
        resource = import_module("resource")
    except ImportError:  # Windows has no such limit
        return
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit != resource.RLIM_INFINITY and limit < ADDRESS_SPACE:
        raise UsageError(
            f"this process may reserve {limit / 1e6:.0f} MB of address space; expected at least "
            f"{ADDRESS_SPACE / 1e6:.0f} MB, of which a tenth is used. Raise the limit (ulimit -v unlimited); to "
            "bound memory, limit what is used (a container, or systemd-run -p MemoryMax=600M)."
        )


class _AfterPyarrow:
    """Lets pyarrow look for pandas as soon as it is loaded, while there is none."""

    def find_spec(self, fullname: str, path: object = None, target: object = None) -> ModuleSpec | None:
        spec = PathFinder.find_spec(fullname) if fullname == "pyarrow" else None
        if spec is None or spec.loader is None:
            return None
        sys.meta_path.remove(self)
        load = spec.loader.exec_module

        def execute(module: ModuleType) -> None:
            load(module)
            _look_for_pandas(module)

        spec.loader.exec_module = execute  # type: ignore[method-assign]
        return spec


class _NoPandas:
    """Finds pandas nowhere, and leaves other modules to others."""

    def find_spec(self, fullname: str, path: object = None, target: object = None) -> None:
        if fullname == "pandas":
            raise ModuleNotFoundError("pandas is left out while pyarrow looks for it: see pipeline.base.process")


def _look_for_pandas(pyarrow: Any) -> None:
    if "pandas" in sys.modules:  # which may be what loads pyarrow
        return
    nowhere = _NoPandas()
    sys.meta_path.insert(0, nowhere)
    try:
        pyarrow.array([])
    finally:
        sys.meta_path.remove(nowhere)


def begin_alone() -> None:
    """Begin a process that runs nothing but this package, before it loads numpy.

    Matrices are small here, and many processes compute at once: threads of the linear algebra would take as much
    processor time again to wait for each other, and sums would depend on their number. Who sets
    ``OPENBLAS_NUM_THREADS`` keeps it.

    And pyarrow is kept from importing pandas with the first ``pyarrow.array``, for 0.2 s and 40 MB: that looks once
    whether there is pandas; here it looks when there is none. Whoever imports pandas himself gets it, and so does
    ``pyarrow.Table.to_pandas``; ``pyarrow.array`` takes data frames and series of pandas for mere sequences there.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if "pyarrow" in sys.modules:
        _look_for_pandas(sys.modules["pyarrow"])
    else:
        sys.meta_path.insert(0, _AfterPyarrow())


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
def on_stop_signals(handler: Callable[[int, FrameType | None], object]) -> Iterator[None]:
    """Call a handler on signals that ask for an end; one that is ignored (nohup) stays so."""
    former = {number: signal.getsignal(number) for number in STOP_SIGNALS}
    handled = [number for number, before in former.items() if before not in (signal.SIG_IGN, None)]
    try:
        for number in handled:
            signal.signal(number, handler)
        yield
    finally:
        for number in handled:
            signal.signal(number, former[number])


@contextmanager
def ending_on_signals() -> Iterator[None]:
    """Raise `Ended` in the block on a signal that asks for an end; the next one ends the process, which is safe, too.

    What others make of that exception is an end, too: an extension module says that its import failed.
    """
    asked: list[int] = []

    def handle(number: int, frame: FrameType | None) -> None:
        asked.append(number)
        for other in STOP_SIGNALS:
            if signal.getsignal(other) == handle:
                signal.signal(other, signal.SIG_DFL)
        raise Ended(number)

    with on_stop_signals(handle):
        try:
            yield
        except Exception as error:
            if asked:
                raise Ended(asked[0]) from error
            raise


def end_when(gone: Callable[[], object]) -> None:
    """End this process when a function returns that waits for the end of its parent."""

    def wait() -> None:
        try:
            gone()
        finally:
            os._exit(EXIT_ERROR)

    threading.Thread(target=wait, name="end with the parent", daemon=True).start()


@contextmanager
def ended_through(pipe: int) -> Iterator[None]:
    """Let the kernel end this process when the other end of a pipe closes, or writes, while the block runs.

    For libraries that keep the interpreter to themselves, so that `end_when` has no say. Linux does so; elsewhere the
    block runs as it would without.
    """
    if not hasattr(os, "O_ASYNC"):
        yield
        return
    fcntl = import_module("fcntl")
    flags = fcntl.fcntl(pipe, fcntl.F_GETFL)
    fcntl.fcntl(pipe, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(pipe, fcntl.F_SETFL, flags | os.O_ASYNC)  # its signal, SIGIO, ends a process that does not handle it
    try:
        if select.select([pipe], [], [], 0)[0]:  # closed before
            os._exit(EXIT_ERROR)
        yield
    finally:
        fcntl.fcntl(pipe, fcntl.F_SETFL, flags)
