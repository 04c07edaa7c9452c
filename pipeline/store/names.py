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
"""Names that Windows keeps for its devices, with any ending."""

_OWN_PAGES = ("index", "accuracy", "theory")
"""Pages in the folder of device reports: `pipeline watch`, `pipeline accuracy`, and `theory` of earlier versions."""

_AGAINST = "-against"
"""Part of the names of pages that set two experiments, or two versions of a report, against each other."""


def folder_name(name: str) -> str:
    """Turn a device or experiment name into a safe folder name; `name_of_folder` turns it back.

    Readers of folders of Parquet files leave out those that begin with a dot or an underscore, and take "a=b" for a
    column: these signs are escaped there. So is the first letter of a name that Windows keeps for itself, and a dot or
    space at the end, which it drops.

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
    """Return the device or experiment name that `folder_for` made a folder name of."""
    return unquote(folder)


def folder_for(parent: Path, name: str) -> Path:
    """Return the folder of a device or experiment in a folder, whether it is there or not.

    A name that differs from another one there in case only is written in digits alone.
    """
    return _place(parent, folder_name(name), _in_digits(name))


def report_of(reports: Path, device: str) -> Path:
    """Return the file of the report of a device, which is that of no other page and no other device."""
    plain = _without_against(device)
    if plain.casefold() in _OWN_PAGES:
        plain = _escaped(plain[0]) + plain[1:]
    return _place(reports, f"{plain}.html", f"{_in_digits(device)}.html")


def page_against(reports: Path, first: tuple[str, str], second: tuple[str, str]) -> Path:
    """Return the file of the page on two experiments (device, experiment), which is that of no other page."""
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
    """Return the first name, or the other where that is there, or the first differs in case alone from one there."""
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
