"""Calls of functions in a separate process with limited time and memory.

A crash or an endless loop of a function does not affect the calling process. A worker process serves one call after the
other. It is replaced after a crash or after a call that exceeds its limits.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import IO, Any, cast

from pipeline.base.process import begin_alone, without_pandas


class IsolationError(Exception):
    """A function crashed its process or exceeded its limits. The text of the error is a predicate, such as "crashes
    (status 1)"."""


def run_isolated(
    place: str,
    *arguments: Any,
    wait_s: float,
    processor_s: float | None = None,
    memory: int | None = None,
    imports: str = "",
) -> Any:
    """Call a function in a worker process and return its result.

    The function runs with the current environment variables and working folder of the caller, which may have changed
    since the worker was started.
    Parameters
    ----------
    place : str
        The function, written as ``module:function``.
    *arguments
        Arguments of the function. The arguments and the result are pickled.
    wait_s : float
        Longest wait for the result [s].
    processor_s : float, optional
        CPU time limit [s], enforced only on Unix. Unlimited by default.
    memory : int, optional
        Memory that the function may use in addition to that of the worker [byte], enforced only on Linux. Unlimited by
        default.
    imports : str
        Modules that the function imports, separated by blanks. Importing them does not count towards the limits.

    Raises
    ------
    IsolationError
        If the function crashes the process or exceeds its limits.
    Exception
        Any exception that the function raises.
    """
    try:
        worker = _IDLE.pop()
    except IndexError:
        worker = _Worker()
    answer = worker.call((dict(os.environ), _folder(), place, imports, arguments, processor_s, memory), wait_s)
    if answer is None:
        raise IsolationError(worker.end())
    _IDLE.append(worker)
    returned, value = answer
    if not returned:
        raise value
    return value


def serve() -> None:
    """Serve calls from standard input. This is the main loop of a worker process, which ends with its parent."""
    begin_alone()
    without_pandas(import_module("pyarrow"))
    calls, results = os.fdopen(0, "rb"), os.fdopen(os.dup(1), "wb")
    # the output of libraries must not mix with the results
    os.dup2(2, 1)
    with contextlib.suppress(EOFError):
        while True:
            environment, folder, place, imports, arguments, processor_s, memory = pickle.load(calls)
            _adopt(environment, folder)
            module, _, function = place.partition(":")
            work = getattr(import_module(module), function)
            with contextlib.suppress(ImportError):  # the function itself reports a missing module
                for needed in imports.split():
                    import_module(needed)
            with _bounded(processor_s, memory):
                try:
                    answer = True, work(*arguments)
                except Exception as error:
                    answer = False, error.with_traceback(None)  # the traceback would keep the data in memory
            pickle.dump(answer, results, pickle.HIGHEST_PROTOCOL)
            results.flush()
            del arguments, answer


def _folder() -> str | None:
    """Return the working folder, or None if it has been removed."""
    with contextlib.suppress(OSError):
        return os.getcwd()
    return None


def _adopt(environment: dict[str, str], folder: str | None) -> None:
    """Adopt the working folder and the environment variables of the caller, except the variables that a worker
    keeps."""
    wanted = environment | {name: os.environ[name] for name in _OWN if name in os.environ}
    if wanted != dict(os.environ):
        os.environ.clear()
        os.environ.update(wanted)
    if folder is not None:
        with contextlib.suppress(OSError):
            os.chdir(folder)


@contextlib.contextmanager
def _bounded(processor_s: float | None, memory: int | None) -> Iterator[None]:
    """Limit the time and memory of a call, even while the call blocks the interpreter.

    The operating system ends this process after the given processor time. It also ends this process when the parent
    ends, because the pipe of calls then closes and raises SIGIO. The memory is limited only on Linux.
    """
    try:
        resource, fcntl = import_module("resource"), import_module("fcntl")
        pages = int(Path("/proc/self/statm").read_text().split()[0])
    except (ImportError, OSError):
        yield
        return
    (soft, hard), flags = resource.getrlimit(resource.RLIMIT_AS), fcntl.fcntl(0, fcntl.F_GETFL)
    if memory is not None:
        most = pages * resource.getpagesize() + memory
        resource.setrlimit(resource.RLIMIT_AS, (most if soft == resource.RLIM_INFINITY else min(most, soft), hard))
    fcntl.fcntl(0, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(0, fcntl.F_SETFL, flags | os.O_ASYNC)  # an unhandled SIGIO ends the process when the pipe closes
    signal.setitimer(signal.ITIMER_PROF, processor_s or 0.0)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        fcntl.fcntl(0, fcntl.F_SETFL, flags)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


class _Worker:
    """A process that waits for calls."""

    def __init__(self) -> None:
        # more threads for linear algebra would only reserve address space
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "OPENBLAS_NUM_THREADS": "1"}
        command = [sys.executable, "-c", f"from {__name__} import serve; serve()"]
        pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
        self.process: subprocess.Popen[bytes] = subprocess.Popen(command, env=environment, **pipes)
        self.calls: IO[bytes] = cast(IO[bytes], self.process.stdin)
        self.results: IO[bytes] = cast(IO[bytes], self.process.stdout)

    def call(self, call: tuple[Any, ...], wait: float) -> tuple[bool, Any] | None:
        """Return True and the result of a call, or False and the exception that it raised. Return None if the process
        crashed or did not answer within `wait` seconds."""
        watch = threading.Timer(wait, self.process.kill)
        watch.daemon = True
        watch.start()
        try:
            pickle.dump(call, self.calls, pickle.HIGHEST_PROTOCOL)
            self.calls.flush()
            answer: tuple[bool, Any] = pickle.load(self.results)
            return answer
        except (EOFError, OSError, pickle.UnpicklingError):
            return None
        except BaseException:
            self.end()  # the next call would read the result of the interrupted call
            raise
        finally:
            watch.cancel()

    def end(self) -> str:
        """Stop the process, and return a text that describes its end."""
        self.process.kill()
        status = self.process.wait()
        for pipe in (self.calls, self.results):
            with contextlib.suppress(OSError):
                pipe.close()
        endless = status in (-getattr(signal, "SIGPROF", 0), -getattr(signal, "SIGKILL", 0))
        return "does not end in time" if endless else f"crashes (status {status})"


_OWN = ("PYTHONPATH", "OPENBLAS_NUM_THREADS")
"""Environment variables that a worker receives at its start and keeps."""

_IDLE: list[_Worker] = []
"""Idle workers. There are as many workers as threads that call simultaneously."""


@atexit.register
def end_all() -> None:
    """Stop the idle workers."""
    while _IDLE:
        _IDLE.pop().end()
