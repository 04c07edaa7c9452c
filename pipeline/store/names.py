"""Conversion of device and experiment names to portable names of folders and reports, and back.

Windows refuses some characters and names. On Windows and on most macOS disks, two names that differ only in case denote
the same file. Characters that are not portable for these reasons are written as % and two hexadecimal digits.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from urllib.parse import quote, unquote

from pipeline.base.provenance import digest

_RESERVED = re.compile(r"(con|prn|aux|nul|com\d|lpt\d) *(\.|$)", re.IGNORECASE)
"""Pattern of names that Windows reserves for its devices, with or without an extension."""

_OWN_PAGES = ("index", "accuracy", "theory")
"""Names of other pages in the folder of reports, written by `pipeline watch`, `pipeline accuracy` and, in earlier
versions, `pipeline theory`."""

_AGAINST = "-against"
"""Part of the name of a page that compares two experiments, or two versions of a report."""


def folder_name(name: str) -> str:
    """Return a portable folder name for a device or experiment name. `name_of_folder` is the inverse.

    Readers of Parquet folders skip names that begin with a dot or an underscore, and interpret "a=b" as a column.
    Therefore, these characters are escaped. The first letter of a name reserved by Windows is escaped, and so is a
    final dot or space, which Windows drops.

    Examples
    --------
    >>> folder_name("arm 2"), folder_name("a/b"), folder_name("con"), folder_name("x.")
    ('arm 2', 'a%2Fb', '%63on', 'x%2E')
    """
    safe = quote(name, safe=" +,@")
    if safe.startswith((".", "_")) or _RESERVED.match(safe):
        safe = _escaped(safe[0]) + safe[1:]
    return safe[:-1] + _escaped(safe[-1]) if safe.endswith((".", " ")) else safe


def name_of_folder(folder: str) -> str:
    """Return the device or experiment name that `folder_for` encoded in a folder name."""
    return unquote(folder)


def folder_for(parent: Path, name: str) -> Path:
    """Return the folder of a device or experiment in a parent folder. It need not exist.

    A name that differs only in case from an existing name is written in hexadecimal digits.
    """
    return _place(parent, folder_name(name), _in_digits(name))


def report_of(reports: Path, device: str) -> Path:
    """Return the file of the report of a device. No page of a different kind or device has this name."""
    plain = _without_against(device)
    if plain.casefold() in _OWN_PAGES:
        plain = _escaped(plain[0]) + plain[1:]
    return _place(reports, f"{plain}.html", f"{_in_digits(device)}.html")


def page_against(reports: Path, first: tuple[str, str], second: tuple[str, str]) -> Path:
    """Return the file of the page that compares two experiments (device, experiment). No other page has this name."""
    # Folder names never contain the character that separates device and experiment.
    one, other = ("=".join(map(_without_against, pair)) for pair in (first, second))
    if first[0] == second[0]:
        other = _without_against(second[1])
    plain = f"{one}{_AGAINST}-{other}"
    return _place(reports, f"{plain}.html", f"{_in_digits(plain)}.html")


def page_against_document(report: Path, document: Path) -> Path:
    """Return the file of the page that compares a report with an earlier document, in the folder of the report.

    Documents of different versions may have the same name in different folders. Therefore, a hash of the path of the
    document is part of the file name.
    """
    place = digest(os.path.realpath(document))
    return report.with_name(f"{report.stem}{_AGAINST}-earlier-{place[:8]}.html")


def _without_against(name: str) -> str:
    return folder_name(name).replace(_AGAINST, _escaped(_AGAINST[0]) + _AGAINST[1:])


def _place(parent: Path, name: str, other: str) -> Path:
    """Return the path for ``name``, or for ``other`` if it exists or ``name`` differs only in case from a file."""
    try:
        there = set(os.listdir(parent))
    except (FileNotFoundError, NotADirectoryError):
        there = set()
    taken = name not in there and (other in there or name.casefold() in {one.casefold() for one in there})
    return parent / (other if taken else name)


def _in_digits(name: str) -> str:
    return "".join(f"%{byte:02X}" for byte in name.encode())


def _escaped(sign: str) -> str:
    return f"%{ord(sign):02X}"
