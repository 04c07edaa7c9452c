"""Reading of files in a separate process with limited time and memory, for all formats.

A log comes from another computer. It may be truncated, corrupted, or larger than it looks. libhdf5 loops forever on
some corrupted bytes, and the operating system kills the Arrow IPC reader on others (h5py 3.16, pyarrow 26.0). In these
cases, no exception can be caught. A worker reads many files. If the process crashes, only the current file is lost.
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
[byte] for caches, buffers and the allocator of a library."""

CPU_SECONDS, CPU_SECONDS_PER_BYTE = 0.6, 4e-6
"""Limit of the processor time: a constant part [s], and a part for each byte [s].

Libraries take 3e-9 s per byte, and ten times as long for compressed files. Other machines may be six times slower.
Messages and text objects are decoded one by one, which takes about 20 us for 60 bytes.
"""

WALL_FACTOR = 30
"""Longest waiting time, as a multiple of the limit of the processor time, because the machine may be busy."""


def read_file(
    settings: Profile, names: Sequence[str], data: Sequence[bytes], wanted: Sequence[str] = ()
) -> FileColumns:
    """Return the contents of a file after reading it in a worker process.

    Parameters
    ----------
    settings : Profile
        Profile with the ``format`` and the keys of this format.
    names, data : sequence of str and bytes
        Names and contents of the files of a log. A split bag has several files.
    wanted : sequence of str
        Columns to read. If it is empty, all columns are read.

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
    """Read a file in the worker process, on behalf of `read_file`."""
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
            # Read all columns, so that the error message can list the columns of the file.
            contents = FileColumns(name, most=most)
            read(paths[0], settings, contents)
            contents.wanted = wanted
    return contents


def isolated(place: str, kind: str, size: int, name: str, *more: Any, imports: str = "") -> Any:
    """Call a function on a file in a worker process, and return its result.

    Parameters
    ----------
    place : str
        The function as ``module:function``. It is called with ``name, *more``.
    kind : str
        Expected kind of file, such as "an HDF5 file".
    size : int
        Size of the file [byte].
    name : str
        Name of the file.
    *more
        Further arguments, such as the content.
    imports : str
        Modules that the function imports, separated by blanks. Their import time does not count towards the limit.

    Returns
    -------
    object
        Result of the function. Arguments and result are pickled.

    Raises
    ------
    LogError
        If the function raises a `LogError`, the file crashes the library, or reading exceeds the time limit.
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
        found = f"cannot be read as {kind}: its library {error}. The file is damaged"
        raise refusal("damaged", name, found, cure="Copy or export it again.") from error


def call(place: str, kind: str, arguments: tuple[Any, ...]) -> Any:
    """Call the function in the worker process, on behalf of `isolated`."""
    module, _, function = place.partition(":")
    with reading(arguments[0], kind):
        return getattr(import_module(module), function)(*arguments)


@contextlib.contextmanager
def reading(name: str, kind: str) -> Iterator[None]:
    """Convert any exception of a library on a damaged file to a `LogError`.

    Parameters
    ----------
    name : str
        Name of the file.
    kind : str
        Expected kind of file, such as "an HDF5 file".

    Raises
    ------
    LogError
        For every exception inside the block. A `LogError` is raised again, preceded by the file name.
    """
    try:
        yield
    except LogError as error:
        raise error if error.reason.startswith(name) else error.reworded(f"{name}: {error.reason}") from error
    except MemoryError as error:
        raise refusal("unpacks-too-large", name, "needs more memory than a file of its size may use") from error
    except Exception as error:  # libraries do not document all exceptions that damaged files cause
        found = " ".join(str(error).split())[:200] or type(error).__name__
        raise refusal("damaged", name, f"cannot be read as {kind}: {found}") from error
