"""File names and foreign texts as text that every output can hold (UTF-8), and paths back from it.

On Linux a file name is any bytes; Python keeps those that are no UTF-8 as lone surrogates, which neither JSON nor
Parquet can hold. JSON, HDF5 and MATLAB files may hold lone surrogates, too.
"""

from __future__ import annotations

import os
from pathlib import Path
from urllib.parse import unquote_to_bytes, urlsplit

_SCHEME = "file:"


def storable(text: str) -> str:
    r"""Return a text with lone surrogates written as ``\udcff``, which no UTF-8 text can hold as such."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def path_text(path: Path | str) -> str:
    r"""Return a path as text: as it is, or as ``file:`` URI of the absolute path where its bytes are no UTF-8.

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
    r"""Return the path that `path_text` made a text of.

    Examples
    --------
    >>> path_of_text("file:///logs/K100%FF.csv").name
    'K100\udcff.csv'
    """
    return Path(os.fsdecode(unquote_to_bytes(urlsplit(text).path))) if text.startswith(_SCHEME) else Path(text)
