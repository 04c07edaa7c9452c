"""Reading of files in a separate process with limited time and memory, for all formats.

A log comes from another computer: it may be truncated, corrupted, or larger than it looks. libhdf5 loops forever on
some corrupted bytes, and the Arrow IPC reader is killed by the operating system on others (h5py 3.16, pyarrow 26.0); no
exception can be caught then. A worker reads many files; if it crashes, only the current file is lost.
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
from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO, Any, cast

from pipeline.base.errors import LogError, refusal
from pipeline.base.process import begin_alone, without_pandas
from pipeline.profiles.profile_model import Profile
from pipeline.readers.file_columns import MOST_VALUES, FileColumns, allowed_bytes, library
from pipeline.readers.formats import FORMATS

COPIES, SLACK = 3, 32 << 20
"""Number of copies of the unpacked file that may be in memory (as read, as numbers, as columns), and additional memory
for a library's caches, buffers and allocator [byte]."""

CPU_SECONDS, CPU_SECONDS_PER_BYTE = 0.6, 4e-6
"""Processor time [s] for any file, and per byte: libraries take 3e-9 s, ten times that for compressed files, and other
machines are six times slower. Messages and text objects are decoded one by one: about 20 us for 60 bytes."""

WALL_FACTOR = 30
"""Longest wait as a multiple of the processor time, for busy machines."""


def read_file(
    settings: Profile, names: Sequence[str], data: Sequence[bytes], wanted: Sequence[str] = ()
) -> FileColumns:
    """Return the contents of a file, read in a worker process.

    Parameters
    ----------
    settings : Profile
        ``format``, and the keys of that format.
    names, data : sequence of str and bytes
        The file; a split bag has several.
    wanted : sequence of str
        Wanted columns; empty means all.

    Raises
    ------
    LogError
        If the file cannot be read.
    """
    form, size = FORMATS[settings.format], sum(map(len, data))
    work = (names[0], dict(zip(names, data, strict=False)), settings, tuple(wanted))
    imports = f"{form.place} {form.library}"
    contents: FileColumns = isolated(f"{__name__}:{read_here.__name__}", form.title, size, *work, imports=imports)
    return contents


def read_here(name: str, files: dict[str, bytes], settings: Profile, wanted: tuple[str, ...]) -> FileColumns:
    """Do what `read_file` does, in the worker process."""
    form = FORMATS[settings.format]
    read = getattr(library(form.place, form.extra), form.function)
    most = min(MOST_VALUES, allowed_bytes(sum(map(len, files.values()))) // 8)
    with TemporaryDirectory() as folder:
        paths = [Path(folder) / f"{number}{Path(part).suffix[:10]}" for number, part in enumerate(files)]
        for path, data in zip(paths, files.values(), strict=True):
            path.write_bytes(data)
        contents = FileColumns(name, wanted, most)
        read(paths[0], settings, contents)
        if contents.lacks():
            # the error message lists the columns of the file
            contents = FileColumns(name, most=most)
            read(paths[0], settings, contents)
            contents.wanted = wanted
    return contents


def isolated(place: str, kind: str, size: int, name: str, *more: Any, imports: str = "") -> Any:
    """Call a function on a file in a worker process, and return its result.

    Parameters
    ----------
    place : str
        The function, as ``module:function``; it is called with ``name, *more``.
    kind : str
        What the file was expected to be, such as "an HDF5 file".
    size : int
        Of the file [byte].
    name : str
        The file.
    *more
        Further arguments, such as its content.
    imports : str
        Modules that the function imports, separated by blanks; the import time does not count.

    Returns
    -------
    object
        Whatever it returns; arguments and result are pickled.

    Raises
    ------
    LogError
        If the function raises one, if the file crashes the library, or if reading exceeds the time limit.
    """
    seconds = CPU_SECONDS + CPU_SECONDS_PER_BYTE * size
    worker = _IDLE.pop() if _IDLE else _Worker()
    outcome = worker.call((place, imports, kind, (name, *more), seconds, size), WALL_FACTOR * seconds)
    if outcome is None:
        found = f"cannot be read as {kind}: the library that reads it {worker.end()}. The file is damaged"
        raise refusal("damaged", name, found, cure="Copy or export it again.")
    _IDLE.append(worker)
    if isinstance(outcome, LogError):
        raise outcome
    return outcome


def serve() -> None:
    """Serve calls from standard input: the main loop of a worker process, which ends with its parent."""
    begin_alone()
    without_pandas(import_module("pyarrow"))
    calls, results = os.fdopen(0, "rb"), os.fdopen(os.dup(1), "wb")
    # output of libraries must not mix with the results
    os.dup2(2, 1)
    with contextlib.suppress(EOFError):
        while True:
            place, imports, kind, arguments, seconds, size = pickle.load(calls)
            module, _, function = place.partition(":")
            work = getattr(import_module(module), function)
            with contextlib.suppress(ImportError):  # the function itself reports what is missing and how to install it
                for needed in imports.split():
                    import_module(needed)
            with _bounded(seconds, size):
                try:
                    with reading(arguments[0], kind):
                        outcome = work(*arguments)
                except LogError as error:
                    outcome = error.with_traceback(None)  # it would keep the data in memory until the next call
            pickle.dump(outcome, results, pickle.HIGHEST_PROTOCOL)
            results.flush()
            del arguments, outcome


@contextlib.contextmanager
def reading(name: str, kind: str) -> Iterator[None]:
    """Convert any exception of a library on a damaged file to a `LogError`.

    Parameters
    ----------
    name : str
        The file.
    kind : str
        What it was expected to be, such as "an HDF5 file".

    Raises
    ------
    LogError
        For every exception inside; a `LogError` is raised again with the file name prepended.
    """
    try:
        yield
    except LogError as error:
        raise error if error.reason.startswith(name) else error.reworded(f"{name}: {error.reason}") from error
    except MemoryError as error:
        raise refusal("unpacks-too-large", name, "takes more memory than a file of its size may") from error
    except Exception as error:  # libraries do not document all exceptions that damaged files cause
        found = " ".join(str(error).split())[:200] or type(error).__name__
        raise refusal("damaged", name, f"cannot be read as {kind}: {found}") from error


@contextlib.contextmanager
def _bounded(seconds: float, size: int) -> Iterator[None]:
    """Limit time and memory of a library for a file of this size [byte], even while it blocks the interpreter.

    The system ends this process after the given processor time, or with its parent (which closes the pipe of calls),
    and limits its memory to the need of the largest allowed content; only on Linux.
    """
    try:
        resource, fcntl = import_module("resource"), import_module("fcntl")
        pages = int(Path("/proc/self/statm").read_text().split()[0])
    except (ImportError, OSError):
        yield
        return
    (soft, hard), flags = resource.getrlimit(resource.RLIMIT_AS), fcntl.fcntl(0, fcntl.F_GETFL)
    most = pages * resource.getpagesize() + COPIES * (allowed_bytes(size) + size) + SLACK
    resource.setrlimit(resource.RLIMIT_AS, (most if soft == resource.RLIM_INFINITY else min(most, soft), hard))
    fcntl.fcntl(0, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(0, fcntl.F_SETFL, flags | os.O_ASYNC)  # its signal, SIGIO, ends a process that does not handle it
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        fcntl.fcntl(0, fcntl.F_SETFL, flags)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


class _Worker:
    """A process that waits for calls."""

    def __init__(self) -> None:
        # threads for linear algebra would only reserve address space
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "OPENBLAS_NUM_THREADS": "1"}
        command = [sys.executable, "-c", "from pipeline.readers.isolation import serve; serve()"]
        pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
        self.process: subprocess.Popen[bytes] = subprocess.Popen(command, env=environment, **pipes)
        self.calls: IO[bytes] = cast(IO[bytes], self.process.stdin)
        self.results: IO[bytes] = cast(IO[bytes], self.process.stdout)

    def call(self, call: tuple[Any, ...], wait: float) -> Any:
        """Return the result of a call, or None if the process crashed or did not answer within `wait` seconds."""
        watch = threading.Timer(wait, self.process.kill)
        watch.daemon = True
        watch.start()
        try:
            pickle.dump(call, self.calls, pickle.HIGHEST_PROTOCOL)
            self.calls.flush()
            return pickle.load(self.results)
        except (EOFError, OSError, pickle.UnpicklingError):
            return None
        except BaseException:
            self.end()  # the result of an interrupted call would be read by the next one
            raise
        finally:
            watch.cancel()

    def end(self) -> str:
        """Stop the process and return how it ended."""
        self.process.kill()
        status = self.process.wait()
        for pipe in (self.calls, self.results):
            with contextlib.suppress(OSError):
                pipe.close()
        endless = status in (-getattr(signal, "SIGPROF", 0), -getattr(signal, "SIGKILL", 0))
        return "does not come to an end" if endless else f"crashes (status {status})"


_IDLE: list[_Worker] = []
"""Idle workers; there are as many workers as threads that read at the same time."""


@atexit.register
def _end_all() -> None:
    while _IDLE:
        _IDLE.pop().end()
