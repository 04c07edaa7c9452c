"""Names of devices and experiments as portable names of folders and reports, and back.

Windows refuses some characters and names. There, and on most disks of macOS, two names that differ only in case are one
file. Characters that are not portable for these reasons are written as % and two digits.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from urllib.parse import quote, unquote

from pipeline.base.provenance import digest

_RESERVED = re.compile(r"(con|prn|aux|nul|com\d|lpt\d) *(\.|$)", re.IGNORECASE)
"""Names that Windows reserves for its devices, with any extension."""

_OWN_PAGES = ("index", "accuracy", "theory")
"""Pages in the folder of device reports: `pipeline watch`, `pipeline accuracy`, and `theory` of earlier versions."""

_AGAINST = "-against"
"""Part of the names of pages that compare two experiments, or two versions of a report."""


def folder_name(name: str) -> str:
    """Turn a device or experiment name into a safe folder name; `name_of_folder` turns it back.

    Readers of folders of Parquet files skip names that begin with a dot or an underscore, and read "a=b" as a column:
    these characters are escaped. So are the first letter of a name reserved by Windows, and a final dot or space, which
    Windows drops.

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
    """Return the device or experiment name of a folder name from `folder_for`."""
    return unquote(folder)


def folder_for(parent: Path, name: str) -> Path:
    """Return the folder of a device or experiment in a parent folder, existing or not.

    A name that differs only in case from an existing one is written in digits only.
    """
    return _place(parent, folder_name(name), _in_digits(name))


def report_of(reports: Path, device: str) -> Path:
    """Return the file of the report of a device, which no other page or device uses."""
    plain = _without_against(device)
    if plain.casefold() in _OWN_PAGES:
        plain = _escaped(plain[0]) + plain[1:]
    return _place(reports, f"{plain}.html", f"{_in_digits(device)}.html")


def page_against(reports: Path, first: tuple[str, str], second: tuple[str, str]) -> Path:
    """Return the file of the page on two experiments (device, experiment), which no other page uses."""
    # folder names never contain the character between device and experiment
    one, other = ("=".join(map(_without_against, pair)) for pair in (first, second))
    if first[0] == second[0]:
        other = _without_against(second[1])
    plain = f"{one}{_AGAINST}-{other}"
    return _place(reports, f"{plain}.html", f"{_in_digits(plain)}.html")


def page_against_document(report: Path, document: Path) -> Path:
    """Return the page, in the folder of a report, that compares it with an earlier document.

    Documents of several versions have the same name in different folders, so the folder is part of the page's name.
    """
    place = digest(os.path.realpath(document))
    return report.with_name(f"{report.stem}{_AGAINST}-earlier-{place[:8]}.html")


def _without_against(name: str) -> str:
    return folder_name(name).replace(_AGAINST, _escaped(_AGAINST[0]) + _AGAINST[1:])


def _place(parent: Path, name: str, other: str) -> Path:
    """Return the first name; the other if it exists, or if the first differs only in case from an existing one."""
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
