"""What a file may ask for: bounds on the memory it claims, and one error for all that damage makes a library raise.

A log comes from a foreign computer. It may be cut, changed on the way, or made to break its reader.
"""

from __future__ import annotations

import bz2
import sys
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from pipeline.base.errors import LogError
from pipeline.readers.limits import EXPANSION, LARGEST_FRAME, MOST_COLUMNS, SMALL_FRAME

_BLOCK = 1 << 20


def allowed_bytes(size: int) -> int:
    """Return how many bytes a file of this size [byte] may unpack to."""
    return min(LARGEST_FRAME, max(SMALL_FRAME, EXPANSION * size))


def check_claim(name: str, what: str, claimed: int, size: int, most: int = LARGEST_FRAME) -> None:
    """Refuse a file that claims more memory than its size makes likely, before that memory is asked for.

    Parameters
    ----------
    name : str
        The file.
    what : str
        The part that claims.
    claimed : int
        Bytes it would unpack to.
    size : int
        Bytes of the file.
    most : int
        Bytes that are too many for this kind of file whatever its size.

    Raises
    ------
    LogError
        If the claim is above `allowed_bytes` or `most`.
    """
    limit = min(allowed_bytes(size), most)
    if claimed < 0 or claimed > limit:
        raise LogError(
            f"{name}: {what} claims {claimed} bytes in a file of {size}; expected at most {limit}. The file is "
            "damaged or no log of one step response. Export it again, with the columns that are needed.",
            code="unpacks-too-large",
        )


def check_columns(name: str, count: int) -> None:
    """Refuse a file with more than `MOST_COLUMNS` columns.

    Raises
    ------
    LogError
        If it has.
    """
    if count > MOST_COLUMNS:
        raise LogError(
            f"{name} has {count} columns; expected at most {MOST_COLUMNS}. Export the columns that are needed.",
            code="too-many-columns",
        )


@contextmanager
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
        For every exception inside; a `LogError` passes as it is.
    """
    try:
        yield
    except LogError:
        raise
    except RecursionError as error:
        raise LogError(
            f"{name} cannot be read as {kind}: lists or objects are nested too deep; expected records of one form. "
            "Export the samples as a table.",
            code="too-deep",
        ) from error
    except MemoryError as error:
        raise LogError(
            f"{name} takes more memory than a file of its size may. It is damaged or no log of one step response. "
            "Export it again, with the columns that are needed.",
            code="unpacks-too-large",
        ) from error
    except Exception as error:  # libraries document no complete list of what damage makes them raise
        found = " ".join(str(error).split())[:200] or type(error).__name__
        raise LogError(
            f"{name} cannot be read as {kind}: {found}. The file is cut, damaged or of another format. "
            "Copy or export it again, or correct `format` in the profile.",
            code="damaged",
        ) from error


def library(module: str, package: str, extra: str) -> Any:
    """Import a library that only one format needs.

    Raises
    ------
    LogError
        If it is not installed; says how to install it.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise LogError(
            f"reading this format needs the package {package}, which is not installed. "
            f"Run pip install '.[{extra}]' in the project's folder, then ingest with --rehash.",
            code="library-missing",
        ) from error


def unpack(name: str, packing: str, packed: bytes | memoryview, limit: int, size: int) -> bytes:
    """Unpack a block, never to more than a limit; ``""`` and ``"none"`` are not packed.

    Parameters
    ----------
    name : str
        The file.
    packing : {"", "none", "zlib", "bz2", "lz4", "zstd"}
    packed : bytes
    limit : int
        Bytes that are left of what the file may unpack to.
    size : int
        Bytes of the file.

    Raises
    ------
    LogError
        If there is more, the packing is not known, or its library is not installed.
    EOFError
        If the block is cut.
    Exception
        What the library raises on damage; call it inside `reading`.
    """
    if packing in ("", "none"):
        return bytes(packed)
    if packing not in _UNPACKERS:
        raise LogError(
            f"{name}: data are packed by {packing[:40]!r}; expected one of {list(_UNPACKERS)}. Unpack the file first.",
            code="unsupported",
        )
    stream = _UNPACKERS[packing]()
    parts: list[bytes] = []
    total = 0
    waiting = packed
    while not stream.eof:
        part = stream.decompress(waiting, _BLOCK)
        # zlib hands back what it did not use; the others keep it
        waiting = getattr(stream, "unconsumed_tail", b"")
        if not part and not waiting and not stream.eof:
            raise EOFError("packed data end too early")
        parts.append(part)
        total += len(part)
        if total > limit:
            check_claim(name, "packed data", total + allowed_bytes(size) - limit, size)
    return b"".join(parts)


def _zstd() -> Any:
    module = "compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd"
    return library(module, "rosbags", "bags").ZstdDecompressor()


_UNPACKERS: dict[str, Callable[[], Any]] = {
    "zlib": zlib.decompressobj,
    "bz2": bz2.BZ2Decompressor,
    "lz4": lambda: library("lz4.frame", "rosbags", "bags").LZ4FrameDecompressor(),
    "zstd": _zstd,
}
