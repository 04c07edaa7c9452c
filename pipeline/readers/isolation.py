"""Reads files in a process of its own, with bounded time and memory: one place for all formats.

A log comes from a foreign computer: cut, changed on the way, or larger than it looks. libhdf5 loops for ever on some
changed bytes, and the Arrow IPC reader is killed by the operating system on others (h5py 3.16, pyarrow 26.0); no
exception can be caught then. A worker reads many files; one that dies costs only its file.
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
from functools import partial
from importlib import import_module
from pathlib import Path
from queue import SimpleQueue
from typing import IO, Any

from pipeline.base.errors import LogError
from pipeline.base.process import begin_alone, end_when, without_pandas
from pipeline.readers.limits import (
    COPIES,
    CPU_SECONDS,
    EXPANSION,
    GRACE_SECONDS,
    LARGEST_LOG,
    SLACK,
    SMALL_FILE,
    WALL_FACTOR,
)
from pipeline.readers.refusals import refusal

_SERVE = "from pipeline.readers.isolation import serve; serve()"


def isolated(
    place: str, name: str, kind: str, data: bytes, *more: Any, imports: tuple[str, ...], seconds_per_byte: float = 2e-7
) -> Any:
    """Return what the function at a place makes of a file, called in a worker process.

    Parameters
    ----------
    place : str
        The function, as ``module:function``; it is called with ``name, data, *more``.
    name : str
        The file.
    kind : str
        What it was expected to be, such as "an HDF5 file".
    data : bytes
        Content of the file.
    *more
        Further arguments, such as wanted columns.
    imports : tuple of str
        Modules that the function imports; the time to do so does not count.
    seconds_per_byte : float
        Processor time allowed above `CPU_SECONDS`.

    Returns
    -------
    object
        Whatever it returns; arguments and result are pickled.

    Raises
    ------
    LogError
        What the function raises, or that the file crashed the library or took more than the time allowed.
    """
    seconds = CPU_SECONDS + seconds_per_byte * len(data)
    worker = _take()
    outcome = worker.call((place, imports, kind, (name, data, *more), seconds), WALL_FACTOR * seconds)
    if outcome is None:
        found = f"cannot be read as {kind}: the library that reads it {worker.end()}. The file is damaged"
        raise refusal("damaged", name, found, cure="Copy or export it again.")
    _IDLE.append(worker)
    succeeded, value = outcome
    if not succeeded:
        assert isinstance(value, LogError), "the worker sends the refusal itself"
        raise value
    return value


def library(module: str, extra: str) -> Any:
    """Import a module that needs a library which only some formats need.

    Raises
    ------
    LogError
        If it is not installed; says how to install it.
    """
    try:
        return import_module(module)
    except ImportError as error:
        found = f"reading this format needs {error.name or module}, which is not installed"
        cure = f"Run pip install '.[{extra}]' in the project's folder, then ingest with --rehash."
        raise refusal("library-missing", "", found, cure=cure) from error


def allowed_bytes(size: int) -> int:
    """Return how many bytes a file of this size [byte] may unpack to."""
    return min(4 * LARGEST_LOG, max(SMALL_FILE, EXPANSION * size))


def serve() -> None:
    """Work on calls from standard input; the main loop of a worker process, which ends when its parent does."""
    begin_alone()
    without_pandas(import_module("pyarrow"))
    pipe, results = sys.stdin.fileno(), os.fdopen(os.dup(1), "wb")
    # whatever a library prints must not get between the results
    os.dup2(2, 1)
    calls: SimpleQueue[Any] = SimpleQueue()
    end_when(partial(_receive, pipe, calls))
    while True:
        place, imports, kind, arguments, seconds = calls.get()
        module, _, function = place.partition(":")
        work = getattr(import_module(module), function)
        for needed in imports:
            # the function itself says what is missing and how to install it
            with contextlib.suppress(ImportError):
                import_module(needed)
        _alarm(seconds)
        size = len(arguments[1])
        with memory_for(allowed_bytes(size) + size):
            try:
                with reading(arguments[0], kind):
                    outcome: tuple[bool, Any] = (True, work(*arguments))
            except LogError as error:
                outcome = (False, error)
        _alarm(0.0)
        pickle.dump(outcome, results, pickle.HIGHEST_PROTOCOL)
        results.flush()


@contextlib.contextmanager
def reading(name: str, kind: str) -> Iterator[None]:
    """Turn whatever a library raises on a damaged file into the `LogError` that says so.

    Parameters
    ----------
    name : str
        The file.
    kind : str
        What it was expected to be, such as "an HDF5 file".

    Raises
    ------
    LogError
        For every exception inside; a `LogError` passes, with the file in front.
    """
    try:
        yield
    except LogError as error:
        raise error if error.reason.startswith(name) else error.reworded(f"{name}: {error.reason}") from error
    except RecursionError as error:
        found = f"cannot be read as {kind}: lists or objects are nested too deep"
        raise refusal("too-deep", name, found, "records of one form") from error
    except MemoryError as error:
        raise refusal("unpacks-too-large", name, "takes more memory than a file of its size may") from error
    except Exception as error:  # libraries document no complete list of what damage makes them raise
        found = " ".join(str(error).split())[:200] or type(error).__name__
        raise refusal("damaged", name, f"cannot be read as {kind}: {found}") from error


def _receive(pipe: int, calls: SimpleQueue[Any]) -> None:
    """Hand calls on until the parent has no more, or is gone."""
    with open(pipe, "rb", closefd=False) as stream, contextlib.suppress(EOFError, pickle.UnpicklingError):
        while True:
            calls.put(pickle.load(stream))


def _alarm(seconds: float) -> None:
    """Let the operating system end this process after so much processor time; 0 calls that off."""
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_PROF, seconds)


@contextlib.contextmanager
def memory_for(claimed: int) -> Iterator[None]:
    """Let a library take no more memory than what it says that it will unpack needs; only on Linux, in a worker.

    Parameters
    ----------
    claimed : int
        Bytes.
    """
    try:
        resource = import_module("resource")
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    except (ImportError, OSError):
        yield
        return
    most = pages * resource.getpagesize() + COPIES * claimed + SLACK
    resource.setrlimit(resource.RLIMIT_AS, (most if soft == resource.RLIM_INFINITY else min(most, soft), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


class _Worker:
    """A process that waits for calls."""

    def __init__(self) -> None:
        # threads for linear algebra would only reserve address space
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "OPENBLAS_NUM_THREADS": "1"}
        self.process = subprocess.Popen(
            [sys.executable, "-c", _SERVE],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment,
        )
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.calls: IO[bytes] = self.process.stdin
        self.results: IO[bytes] = self.process.stdout

    def call(
        self, call: tuple[str, tuple[str, ...], str, tuple[Any, ...], float], wait: float
    ) -> tuple[bool, Any] | None:
        """Return what a call gives, or None where the process died of it."""
        watch = threading.Timer(wait, self.process.kill)
        watch.daemon = True
        watch.start()
        try:
            pickle.dump(call, self.calls, pickle.HIGHEST_PROTOCOL)
            self.calls.flush()
            outcome: tuple[bool, Any] = pickle.load(self.results)
        except (EOFError, OSError, pickle.UnpicklingError):
            return None
        except BaseException:
            # an interrupted call would leave its result to the next one
            self.process.kill()
            self.end()
            raise
        finally:
            watch.cancel()
        return outcome

    def end(self) -> str:
        """Stop the process and return how it ended."""
        for pipe in (self.calls, self.results):
            with contextlib.suppress(OSError):
                pipe.close()
        try:
            status = self.process.wait(GRACE_SECONDS)
        except subprocess.TimeoutExpired:
            self.process.kill()
            status = self.process.wait()
        if status == -getattr(signal, "SIGPROF", 0) or status == -getattr(signal, "SIGKILL", 0):
            return "does not come to an end"
        return f"crashes (status {status})"


_IDLE: list[_Worker] = []
"""Workers without a call; as many were made as threads read at a time."""


def _take() -> _Worker:
    try:
        return _IDLE.pop()
    except IndexError:
        return _Worker()


@atexit.register
def _end_all() -> None:
    while _IDLE:
        _IDLE.pop().end()
