"""Sees in a tenth of a second that an ingest would find nothing new, without opening a stored table.

After an ingest a note in `processed/` says what was looked at: each searched folder with its modification time, each
file with size and modification time, and the state of the store. Where all of it is as it was, the same command would
find the same logs, all known. Anything else, a note that is damaged included, means that the ingest is done.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline import __version__
from pipeline.base.disk import remove, replacing
from pipeline.base.provenance import code_digest, digest, schema_folder
from pipeline.base.seal import sealed_json, unsealed_json

NOTE_FILE = ".last_ingest.json"

COARSEST_CLOCK_NS = 2_000_000_000
"""A folder that changed less than this before it was searched may change again with the same time: FAT counts 2 s."""

_CODE = ("ingest", "sources", "reading", "profile_files", "profile_model", "rerun")
"""Modules that decide which files are logs, and which of them are known."""

Folders = dict[str, int]
"""Modification time [ns] of each folder, by path."""


@dataclass(frozen=True)
class Search:
    """Which logs are looked for: paths and profile as given."""

    paths: tuple[str, ...]
    processed: str
    profile: str | None

    @property
    def key(self) -> str:
        """Hash of the search, and of the profiles and code by which it is done."""
        given = self.profile is not None and os.path.isfile(self.profile)
        profiles = sorted((schema_folder() / "profiles").glob("*.toml")) + ([Path(str(self.profile))] if given else [])
        texts = [hashlib.sha256(path.read_bytes()).hexdigest() for path in profiles]
        place = [os.getcwd(), self.processed, *self.paths, str(self.profile)]
        return digest([__version__, code_digest(*_CODE), place, texts])


def folders_of(search: Search) -> Folders | None:
    """Return all folders that decide which logs are found, with their modification time, below hidden ones none.

    None where one of them went away while it was looked at: what is remembered would not hold.
    """
    try:
        return _folders_of(search)
    except OSError:
        return None


def _folders_of(search: Search) -> Folders:
    found: Folders = {}
    processed = os.path.realpath(search.processed)
    for path in search.paths:
        if not os.path.isdir(path):
            # the other file of a pair lies beside it
            path = os.path.dirname(os.path.abspath(path))
            found[path] = os.stat(path).st_mtime_ns
            continue
        for here, names, _ in os.walk(path):
            found[here] = os.stat(here).st_mtime_ns
            names[:] = [n for n in names if n[0] != "." and os.path.realpath(os.path.join(here, n)) != processed]
    return found


def remember(
    search: Search,
    before: Folders | None,
    began_ns: int,
    files: Iterable[tuple[Sequence[str], int, int]],
    report: Mapping[str, Any],
) -> None:
    """Write the note, or remove it where a folder changed so recently that it might change unseen.

    Parameters
    ----------
    search : Search
    before : dict or None
        `folders_of` the search before it was done.
    began_ns : int
        Time before that [ns since 1970].
    files : iterable of (paths, size, mtime_ns)
        The files of each log with the size of all [byte] and the newest modification [ns] that are known for it.
    report : mapping
        What the same command will report if nothing changes.
    """
    clock = 0 if before is None else max(before.values(), default=0) + COARSEST_CLOCK_NS
    if before is None or clock > began_ns or before != folders_of(search):
        forget(search)
        return
    document = {
        "key": search.key,
        "store": _store(search.processed),
        "folders": before,
        "files": [[list(paths), size, mtime_ns] for paths, size, mtime_ns in files],
        "report": report,
    }
    with replacing(Path(search.processed) / NOTE_FILE) as stream:
        stream.write(sealed_json(json.dumps(document)).encode())


def forget(search: Search) -> None:
    """Remove the note, so that the next run looks at the files."""
    remove(Path(search.processed) / NOTE_FILE)


def recall(search: Search) -> dict[str, Any] | None:
    """Return the report of an ingest that would find nothing new, None where it has to be done."""
    try:
        document = unsealed_json((Path(search.processed) / NOTE_FILE).read_bytes())
        if document["key"] != search.key or document["store"] != _store(search.processed):
            return None
        for path, mtime_ns in document["folders"].items():
            if os.stat(path).st_mtime_ns != mtime_ns:
                return None
        for paths, size, mtime_ns in document["files"]:
            states = [os.stat(path) for path in paths]
            if sum(s.st_size for s in states) != size or max(s.st_mtime_ns for s in states) != mtime_ns:
                return None
        report: dict[str, Any] = document["report"]
        return report
    except (OSError, ValueError, KeyError, TypeError):
        return None


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
