"""Which files are logs: walks folders, lets a profile claim each file, joins the files of a pair or a ROS 2 bag.

``ros2 bag record`` makes a folder with ``metadata.yaml`` and one or more ``.db3`` or ``.mcap`` files: a long recording
is split over several. Together they are one log.
"""

from __future__ import annotations

import json
import os
import re
import stat
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

from pipeline.base.disk import READABLE, shared_mode
from pipeline.base.errors import LogError, UsageError, refusal
from pipeline.base.paths import open_regular, path_text, storable
from pipeline.profiles.patterns import find_groups
from pipeline.profiles.profile_files import claim
from pipeline.profiles.profile_model import CONDITION_QUANTITIES, Profile

METADATA = "metadata.yaml"
ENDINGS = (".db3", ".mcap")

LARGEST_METADATA = 1 << 20
"""Bytes of ``metadata.yaml`` that are read; it has some hundred for each file and topic."""

_LISTED = re.compile(r"relative_file_paths:\s*(\[[^\]]*\]|(?:[ ]*-[^\n]*(?:\n|$))+)")
_RECORDED = re.compile(rf"""[^/'",\[\]\n]*({"|".join(map(re.escape, ENDINGS))})(\.zstd)?\b""")
"""List of the files in the metadata, and the name of one in it, without its folder."""


def files_of_bag(file: Path) -> tuple[Path, ...]:
    """Return the files of the bag that a file belongs to, as ``metadata.yaml`` beside it lists them; else none."""
    if file.name != METADATA and file.suffix.lower() not in ENDINGS:
        return ()
    try:
        with open_regular(file.parent / METADATA) as stream:
            text = stream.read(LARGEST_METADATA).decode("utf-8", "replace")
    except OSError:
        return ()
    section = _LISTED.search(text)
    found = [name[0].lstrip("- ") for name in _RECORDED.finditer(section[1])] if section else []
    # one that was unpacked by hand has lost its second ending
    names = [plain if os.path.exists(file.with_name(plain := name.removesuffix(".zstd"))) else name for name in found]
    return tuple(map(file.with_name, names)) if file.name in (METADATA, *names) else ()


UNCOUNTED = frozenset({"truth.json", "readme", "readme.md", "readme.txt", "license", "license.md", "license.txt"})
"""Files that stand beside logs and are none (the first by the simulator), in small letters; not counted in folders."""

Notice = Callable[[Path, str], None]
"""Told of a folder that is not searched, and why."""


@dataclass(frozen=True)
class Source:
    """One log before it is read.

    Parameters
    ----------
    path : Path
        First file, as found; the folder of a ROS 2 bag, which is one log.
    key : str
        Its absolute path as `file_names.path_text` has it: what `processed/` knows the log by, whatever folder the
        command is called from.
    files : tuple of Path
        All files of the log.
    size, mtime_ns : int
        Size of all files together [byte] and newest modification time [ns].
    profile : Profile or None
        What reads it.
    problem : LogError or None
        Why it cannot be read at all.
    mode : int
        Who may read all of its files.
    """

    path: Path
    key: str
    files: tuple[Path, ...]
    size: int
    mtime_ns: int
    profile: Profile | None
    problem: LogError | None = None
    mode: int = READABLE

    @property
    def shown(self) -> str:
        """The path as found, as text that can be stored."""
        return path_text(self.path)


def find_sources(
    paths: Sequence[Path],
    profiles: tuple[Profile, ...],
    exclude: Path | None = None,
    notice: Notice = lambda folder, reason: None,
    unchanged: dict[str, tuple[int, int]] | None = None,
) -> list[Source]:
    """Return every log below the given folders and files, each once, in order of path.

    Links to files are followed. Links to folders inside a searched folder are not, since they may lead in a circle:
    `notice` is told.

    Parameters
    ----------
    paths : sequence of Path
        Folders, searched with all folders below, and files.
    profiles : tuple of Profile
        Profiles that may claim a file.
    exclude : Path, optional
        Folder that is left out (`processed/`, which may lie inside a searched folder).
    notice : callable, optional
        Called with each folder that is not searched, and why: it is a link, or may not be read.
    unchanged : dict of str to (int, int), optional
        Size [byte] and time [ns] of files, by absolute path; it loses those that have them, which are left out.

    Raises
    ------
    UsageError
        If a path does not exist, may not be looked at, or lies in the excluded folder.
    ProfileError
        If two profiles claim one file.
    """
    found: dict[str, Source] = {}
    # what a link leads to may be reached by its own name, too
    excluded = None if exclude is None else os.path.realpath(exclude)
    for path in paths:
        try:
            there = path.exists()
        except OSError as error:
            raise UsageError(f"{path}: cannot be looked at ({error.strerror}). Correct its permissions.") from error
        if not there:
            raise UsageError(f"{path}: no such file or folder. Give folders with logs, or single logs.")
        if excluded is not None and os.path.join(os.path.realpath(path), "").startswith(os.path.join(excluded, "")):
            raise UsageError(f"{path}: lies in {exclude}, where results are kept. Give folders with logs.")
        look = _files(path, excluded, notice, {} if unchanged is None else unchanged)
        for file in look if path.is_dir() else [path]:
            source = _source(file, profiles)
            found.setdefault(source.key, source)
    return [found[key] for key in sorted(found)]


def _files(folder: Path, excluded: str | None, notice: Notice, unchanged: dict[str, tuple[int, int]]) -> Iterator[Path]:
    """Yield the files below a folder but hidden ones and `UNCOUNTED`; links to folders are not followed."""
    waiting = [os.fspath(folder)]
    while waiting:
        here = waiting.pop()
        below = os.path.join(os.path.abspath(here), "")
        try:
            with os.scandir(here) as entries:
                for entry in entries:
                    path = below + entry.name
                    known = unchanged.get(path)
                    if known is not None and _state(entry) == known:
                        del unchanged[path]
                    elif entry.name[0] == ".":
                        continue
                    elif not _is_folder(entry):
                        if entry.name.lower() not in UNCOUNTED:
                            yield Path(entry.path)
                    elif entry.is_symlink():
                        text = "is a link to a folder, which is not followed. Give that folder if it has logs."
                        notice(Path(entry.path), text)
                    elif os.path.realpath(entry.path) != excluded:
                        waiting.append(entry.path)
        except OSError as error:
            notice(Path(here), f"folder cannot be read ({error.strerror}). Correct its permissions.")


def _state(entry: os.DirEntry[str]) -> tuple[int, int] | None:
    """Return size and time of what has a name: of a link those of the link itself."""
    try:
        status = entry.stat(follow_symlinks=False)
    except OSError:
        return None
    return status.st_size, status.st_mtime_ns


def _is_folder(entry: os.DirEntry[str]) -> bool:
    try:
        return entry.is_dir()
    except OSError:
        return False


def told_by_name(profile: Profile, path: Path) -> str | None:
    """Return what a profile reads from the name of a log, as text; None where it reads names not.

    Names that tell the same, as 2 and 2.0, give the same text.
    """
    if not profile.reads_names:
        return None
    name = storable(path.name)
    told = (find_groups(profile.name_pattern, name) if profile.name_pattern else None) or {}
    for key in told.keys() & CONDITION_QUANTITIES:
        with suppress(ValueError):
            told[key] = str(float(told[key]))
    entries = [entry.match for entry in profile.file if fnmatchcase(name.lower(), entry.match.lower())]
    return json.dumps([told, entries], sort_keys=True)


def is_settled(mtime_ns: int, settle_s: float) -> bool:
    """Return whether a time [ns] is so long ago [s] that a file is not recorded to any more."""
    # one in the future, by a clock that is wrong, is no reason to wait for ever
    return abs(time.time_ns() - mtime_ns) >= settle_s * 1e9


def _source(file: Path, profiles: tuple[Profile, ...]) -> Source:
    bag, problem = files_of_bag(file), None
    profile, path = _claimed(bag[0] if bag else file, profiles)
    if profile is None:
        accepted = "; ".join(f"{p.name}: {', '.join(p.files)}" for p in profiles)
        problem = refusal("no-profile", "", f"no profile claims a file of this name; accepted are {accepted}")
    partner = profile.partner_of(path) if profile and not bag else None
    files = bag or tuple(filter(None, (path, partner)))
    path = file.parent if bag else path
    seen = dict[Path, os.stat_result]()
    for part in files:
        try:
            seen[part] = _status(part, len(files) > 1)
        except LogError as error:
            problem = problem or error
    size, newest = sum(s.st_size for s in seen.values()), max((s.st_mtime_ns for s in seen.values()), default=0)
    mode, key = shared_mode([*seen.values()], path.parent), path_text(os.path.abspath(path))
    return Source(path, key, tuple(seen), size, newest, profile, problem, mode)


def _status(file: Path, one_of_several: bool) -> os.stat_result:
    """Return size and times of a file of a log.

    Raises
    ------
    LogError
        If it cannot be read.
    """
    try:
        status = os.stat(file)
    except OSError as error:
        missing = one_of_several and not os.path.lexists(file)
        found = f"{file.name} {'is missing' if missing else f'cannot be read ({error.strerror})'}"
        raise refusal("partner-missing" if missing else "unreadable", "", found, f"it in {file.parent}") from error
    if not stat.S_ISREG(status.st_mode):
        raise refusal("not-regular", "", f"{file.name} is no regular file", "a log")
    return status


def _claimed(file: Path, profiles: tuple[Profile, ...]) -> tuple[Profile | None, Path]:
    """Return the profile that claims a file, and the log that the file belongs to."""
    for profile in profiles:
        if (log := profile.log_of_partner(file)) is not None:
            return profile, log
    return claim(file.name, profiles), file
