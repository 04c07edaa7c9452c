"""Sees what the last ingest has looked at: nothing new needs no ingest, and of one log more only that is looked at.

After an ingest a note in `processed/` says which files were found, with size and modification time, which of them are
stored, and the state of the store. Its first line tells whether anything changed at all, without opening a stored
table: the same command would find the same logs, all known. The second line is the index by which an ingest passes over
each stored log that is as it was. A note of another command, store, version or profile, or one that is damaged, is not
believed: then everything is looked at.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from pipeline import __version__
from pipeline.base.disk import replacing
from pipeline.base.json_seal import sealed_json, unsealed_json
from pipeline.base.provenance import code_digest, digest, schema_folder
from pipeline.intake.listing import Folder, Listing, Notice, listing_of

NOTE_FILE = ".last_ingest.json"

Index = dict[str, dict[str, str]]
"""Size and modification time of stored logs, as `listing.Folder` has them, by folder and name."""


@dataclass(frozen=True)
class Search:
    """Which logs are looked for: paths and profile as given; ``listed`` hands on what was listed for `recall`."""

    paths: tuple[str, ...]
    processed: str
    profile: str | None
    listed: dict[str, Listing] = field(default_factory=dict, compare=False)

    def key(self) -> str:
        """Return a hash of the search, and of the profiles and code by which it is done."""
        given = self.profile is not None and os.path.isfile(self.profile)
        profiles = sorted((schema_folder() / "profiles").glob("*.toml")) + ([Path(str(self.profile))] if given else [])
        texts = [hashlib.sha256(path.read_bytes()).hexdigest() for path in profiles]
        place = [os.getcwd(), self.processed, *self.paths, str(self.profile)]
        return digest([__version__, code_digest("ingest"), place, texts])


class Look:
    """What a search finds now, beside what the last ingest left.

    Parameters
    ----------
    search : Search
    believe : bool
        Whether the note of the last ingest counts.
    at_rest : callable, optional
        Whether a file (path, modification time [ns]) is not recorded to any more; by default all are at rest.
    """

    def __init__(self, search: Search, believe: bool, at_rest: Callable[[str, int], bool] | None = None) -> None:
        self.search, self.at_rest = search, at_rest
        head, index = _read(search) if believe else ({}, {})
        self.store = head.get("store")
        """State of the store that the index holds for; None without an index."""
        self._index = index
        self._lines = _beside(search)
        self._new: Index = {}
        self._found: dict[str, Folder] = {}
        self.passed: set[str] = set()
        """Paths of stored logs that are as they were."""

    def files(self, folder: Path, excluded: frozenset[str], notice: Notice) -> Iterator[Path]:
        """Yield the files below a folder that are to be looked at: all but stored logs that are as they were."""
        # the next look lists anew
        listing = self.search.listed.pop(str(folder), None) or listing_of(folder, excluded)
        self._lines += listing.lines
        for place, text in listing.notices:
            notice(place, text)
        for here in listing.folders:
            for name in self._passes(here):
                yield Path(here.path, name)

    def _passes(self, folder: Folder) -> list[str]:
        self._found[folder.absolute] = folder
        plain, known = folder.plain, self._index.get(folder.absolute, {})
        same = {name: state for name, state in plain.items() if known.get(name) == state}
        if self.at_rest is not None:
            same = {n: s for n, s in same.items() if self.at_rest(_path(folder.absolute, n), int(s.split()[1]))}
        self._new[folder.absolute] = same
        place = _path(folder.absolute, "")
        self.passed.update([place + name for name in same])
        return [*(name for name in plain if name not in same), *folder.others]

    def holds(self) -> bool:
        """Return whether the store still is as the index says."""
        return self.store is None or self.store == _store(self.search.processed)

    def remember(self, stored: Iterable[tuple[str, int, int]], report: Mapping[str, Any] | None) -> None:
        """Write the note.

        Parameters
        ----------
        stored : iterable of (path, size, mtime_ns)
            Logs that are stored under their path, beside those that were passed: size [byte] and time [ns] when read.
        report : mapping or None
            What the same command will report if nothing changes; None where it has to look at a file again.
        """
        for path, size, mtime_ns in stored:
            folder, name = os.path.split(path)
            state = f"{size} {mtime_ns}"
            if folder in self._found and self._found[folder].plain.get(name) == state:
                self._new[folder][name] = state
        key = self.search.key()
        head = {"key": key, "store": _store(self.search.processed), "report": report}
        if report is not None:
            head["found"] = _digest(self._lines)
        with replacing(Path(self.search.processed) / NOTE_FILE) as stream:
            index = json.dumps({"folders": self._new}, separators=(",", ":"))
            stream.write("".join(sealed_json(line + "\n") for line in (json.dumps(head), index)).encode())


def recall(search: Search) -> dict[str, Any] | None:
    """Return the report of an ingest that would find nothing new, None where it has to be done."""
    head = _believed(search, lambda stream: stream.readline())
    if head.get("report") is None or head.get("found") != _found(search):
        return None
    report: dict[str, Any] = head["report"]
    return report


def _read(search: Search) -> tuple[dict[str, Any], Index]:
    """Return both lines of the note, where they are to be believed."""
    lines: list[bytes] = []

    def first(stream: BinaryIO) -> bytes:
        lines.extend(stream)
        return b"".join(lines[:1])

    head = _believed(search, first)
    try:
        return (head, unsealed_json(lines[1])["folders"]) if head else ({}, {})
    except (ValueError, IndexError, KeyError):
        return {}, {}


def _believed(search: Search, first: Callable[[BinaryIO], bytes]) -> dict[str, Any]:
    """Return the first line of the note; nothing where it is of another command or store, or damaged."""
    try:
        with open(Path(search.processed) / NOTE_FILE, "rb") as stream:
            head = unsealed_json(first(stream))
        if head["key"] == search.key() and head["store"] == _store(search.processed):
            return head
    except (OSError, ValueError, KeyError, TypeError, ModuleNotFoundError):
        pass
    return {}


def _found(search: Search) -> str:
    """Return the hash of all that a search finds."""
    lines = _beside(search)
    excluded = frozenset((os.path.realpath(search.processed),))
    for path in search.paths:
        if os.path.isdir(path):
            search.listed[path] = listing_of(path, excluded)
            lines += search.listed[path].lines
    return _digest(lines)


def _beside(search: Search) -> list[str]:
    """Return what lies beside each file that is given itself: the other one of a pair, or a bag."""
    lines: list[str] = []
    for path in search.paths:
        if not os.path.isdir(path):
            lines += listing_of(os.path.dirname(os.path.abspath(path)), frozenset(), deep=False).lines
    return lines


def _path(folder: str, name: str) -> str:
    return f"{folder.rstrip(os.sep)}{os.sep}{name}"


def _digest(lines: Iterable[str]) -> str:
    """Return a hash of lines in any order."""
    return hashlib.sha256("\n".join(sorted(lines)).encode("utf-8", "surrogateescape")).hexdigest()


def _store(processed: str) -> str:
    """Return a hash of the names, sizes and times of all trials files and quarantine records."""
    state = []
    for name in ("trials", "quarantine"):
        for here, folders, files in os.walk(os.path.join(processed, name)):
            folders.sort()
            for file in sorted(files):
                if file.endswith((".parquet", "reason.json")):
                    status = os.stat(os.path.join(here, file))
                    state.append([here, file, status.st_size, status.st_mtime_ns])
    return digest(state)
