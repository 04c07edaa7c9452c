"""Reading of files in a separate process with limited time and memory, for all formats.

A log comes from another computer: it may be truncated, corrupted, or larger than it looks. libhdf5 loops forever on
some corrupted bytes, and the Arrow IPC reader is killed by the operating system on others (h5py 3.16, pyarrow 26.0); no
exception can be caught then. A worker reads many files; if it crashes, only the current file is lost.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from pipeline.base.errors import LogError, refusal
from pipeline.base.isolated import IsolationError, run_isolated
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
    seconds, module = CPU_SECONDS + CPU_SECONDS_PER_BYTE * size, place.partition(":")[0]
    try:
        return run_isolated(
            f"{__name__}:{call.__name__}",
            place,
            kind,
            (name, *more),
            wait_s=WALL_FACTOR * seconds,
            processor_s=seconds,
            memory=COPIES * (allowed_bytes(size) + size) + SLACK,
            imports=f"{module} {imports}",
        )
    except IsolationError as error:
        found = f"cannot be read as {kind}: the library that reads it {error}. The file is damaged"
        raise refusal("damaged", name, found, cure="Copy or export it again.") from error


def call(place: str, kind: str, arguments: tuple[Any, ...]) -> Any:
    """Do what `isolated` does, in the worker process."""
    module, _, function = place.partition(":")
    with reading(arguments[0], kind):
        return getattr(import_module(module), function)(*arguments)


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
