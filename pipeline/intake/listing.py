"""Which files lie below a folder: name, size and time of each, by one look at each folder and each file.

A search of 100,000 logs that finds nothing new costs little more than this: only the standard library is used.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

UNCOUNTED = frozenset({"truth.json", "readme", "readme.md", "readme.txt", "license", "license.md", "license.txt"})
"""Files that stand beside logs and are none (the first by the simulator), in small letters; not counted in folders."""

UNKNOWN = "?"

Notice = Callable[[Path, str], None]
"""Told of a folder that is not searched, and why."""


class Folder(NamedTuple):
    """The files in a folder that may be logs.

    Parameters
    ----------
    path : str
        As found.
    absolute : str
    plain : dict of str to str
        Size [byte] and modification time [ns], as text, of each file that is no link and whose path is text that can be
        stored as it is; by name.
    others : dict of str to str
        Of all other files, with the real path; `UNKNOWN` for size and time where they may not be looked at.
    """

    path: str
    absolute: str
    plain: dict[str, str]
    others: dict[str, str]


class Listing(NamedTuple):
    """The folders below one; those that are not searched, each with the reason; and a line of text for each of both.

    Lines of two searches are equal only where both found the same.
    """

    folders: list[Folder]
    notices: list[tuple[Path, str]]
    lines: list[str]


def listing_of(folder: Path | str, excluded: frozenset[str], deep: bool = True) -> Listing:
    """Return what `list_folders` finds."""
    notices: list[tuple[Path, str]] = []
    folders = list(list_folders(folder, excluded, lambda *told: notices.append(told), deep))
    # in the order of the folder, which stays while nothing in it changes
    lines = [f"{here.path}\0{here.plain}{here.others}" for here in folders]
    return Listing(folders, notices, [*lines, *(f"{place}\0{text}" for place, text in notices)])


def list_folders(folder: Path | str, excluded: frozenset[str], notice: Notice, deep: bool = True) -> Iterator[Folder]:
    """Yield a folder and, if `deep`, those below it; hidden files and `UNCOUNTED` are left out.

    Links to folders are not followed.

    Parameters
    ----------
    folder : Path or str
    excluded : frozenset of str
        Real paths of folders that are left out.
    notice : callable
        Called with each folder that is not searched, and why.
    deep : bool
    """
    waiting = [os.fspath(folder)]
    while waiting:
        here = waiting.pop()
        try:
            with os.scandir(here) as entries:
                listed, below = _listed(here, entries)
        except OSError as error:
            notice(Path(here), f"folder cannot be read ({error.strerror}). Correct its permissions.")
            continue
        for entry in below:
            if not deep or os.path.realpath(entry.path) in excluded:
                continue
            if entry.is_symlink():
                notice(
                    Path(entry.path), "is a link to a folder, which is not followed. Give that folder if it has logs."
                )
            else:
                waiting.append(entry.path)
        yield listed


def _listed(here: str, entries: Iterable[os.DirEntry[str]]) -> tuple[Folder, list[os.DirEntry[str]]]:
    """Return the files of a folder, and the folders in it."""
    absolute = os.path.abspath(here)
    listed = Folder(here, absolute, {}, {})
    storable, below = _is_text(absolute), []
    for entry in entries:
        name = entry.name
        if name[0] == ".":
            continue
        if _is_folder(entry):
            below.append(entry)
            continue
        if name.lower() in UNCOUNTED:
            continue
        state = _state(entry)
        if storable and not entry.is_symlink() and (name.isascii() or _is_text(name)) and state != UNKNOWN:
            listed.plain[name] = state
        else:
            listed.others[name] = f"{state} {os.path.realpath(entry.path)}"
    return listed, below


def _state(entry: os.DirEntry[str]) -> str:
    try:
        status = entry.stat()
    except OSError:
        return UNKNOWN
    return f"{status.st_size} {status.st_mtime_ns}"


def _is_folder(entry: os.DirEntry[str]) -> bool:
    try:
        return entry.is_dir()
    except OSError:
        return False


def _is_text(name: str) -> bool:
    """Return whether a name is text in UTF-8."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return True
