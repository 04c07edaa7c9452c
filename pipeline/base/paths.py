"""Conversion and checks of paths that users provide.

On Linux a file name is any sequence of bytes. Python represents bytes that are not UTF-8 as lone surrogates, which
neither JSON nor Parquet can store. JSON, HDF5 and MATLAB files may also contain lone surrogates. A path may name a pipe
or a device instead of a regular file.
"""

from __future__ import annotations

import errno
import os
import stat
import tempfile
from pathlib import Path
from typing import BinaryIO
from urllib.parse import unquote_to_bytes, urlsplit

from pipeline.base.errors import PipelineError, UsageError

_SCHEME = "file:"


def storable(text: str) -> str:
    r"""Replace lone surrogates by escapes such as ``\udcff``, so that the text can be encoded as UTF-8."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def path_text(path: Path | str) -> str:
    r"""Return a path as text, or as a ``file:`` URI of the absolute path if the path is not valid UTF-8.

    Examples
    --------
    >>> path_text("/logs/K100.csv")
    '/logs/K100.csv'
    >>> path_text("/logs/K100\udcff.csv")
    'file:///logs/K100%FF.csv'
    """
    text = os.fspath(path)
    try:
        text.encode()
    except UnicodeEncodeError:
        return Path(os.path.abspath(text)).as_uri()
    return text


def path_of_text(text: str) -> Path:
    r"""Return the path of a text that `path_text` produced.

    Examples
    --------
    >>> path_of_text("file:///logs/K100%FF.csv").name
    'K100\udcff.csv'
    """
    return Path(os.fsdecode(unquote_to_bytes(urlsplit(text).path))) if text.startswith(_SCHEME) else Path(text)


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file for reading.

    Reading a pipe could block forever, and reading a device may have side effects.
    Raises
    ------
    OSError
        If the path cannot be opened or is not a regular file.
    """
    # a pipe may have replaced the file since `find_sources`; O_NONBLOCK prevents opening it from blocking
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise OSError(errno.EINVAL, "no regular file")
    return os.fdopen(handle, "rb")


def is_gone(path: Path) -> bool:
    """Return True if the path does not exist. An unreadable path counts as existing."""
    try:
        os.lstat(path)
    except OSError as error:
        return isinstance(error, FileNotFoundError | NotADirectoryError)
    return False


def check_output(path: Path, option: str, *, document_beside: bool = False) -> None:
    """Check that an output file can be written, without creating it.

    Parameters
    ----------
    path : Path
        File that the command will write. Its parent folders may be missing.
    option : str
        Name of the command-line option for the message. Empty if the path is not given by an option.
    document_beside : bool
        True if a JSON document with the same name is written next to the file.

    Raises
    ------
    UsageError
        If the path is a folder, or if its suffix is .json and the JSON document would overwrite it.
    PipelineError
        If files cannot be created in the folder.
    """
    place = f"{option} {path}".strip()
    if path.is_dir():
        raise UsageError(f"{place}: is a folder; expected a file. Add a file name, such as {path / 'report.html'}.")
    if document_beside and path.suffix.lower() == ".json":
        raise UsageError(
            f"{place}: is the name of the JSON document that is written next to the page and would replace it. "
            f"Expected the name of the page. Give {path.with_suffix('.html')}."
        )
    # The nearest existing parent is checked. For a removed working folder, the error below is raised.
    folder = next((above for above in path.parents if above.exists()), Path("."))
    try:
        with tempfile.TemporaryFile(dir=folder):  # permission bits alone do not show whether files can be created
            pass
    except OSError as error:
        raise PipelineError(
            f"{place}: cannot be written, because no file can be created in {folder} ({error.strerror or error}). "
            "Choose a different place, or correct the permissions."
        ) from error
