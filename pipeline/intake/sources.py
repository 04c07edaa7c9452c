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
from pipeline.base.errors import Code, UsageError
from pipeline.base.paths import OutsideError, open_regular, path_text, real_file, storable
from pipeline.profiles.patterns import find_groups
from pipeline.profiles.profile_files import claim
from pipeline.profiles.profile_model import CONDITION_QUANTITIES, Profile

METADATA = "metadata.yaml"
ENDINGS = (".db3", ".mcap")

LARGEST_METADATA = 1 << 20
"""Bytes of ``metadata.yaml`` that are read; it has some hundred for each file and topic."""

_MARK = "rosbag2_bagfile_information"
_LISTED = re.compile(r"relative_file_paths:\s*(\[[^\]]*\]|(?:[ ]*-[^\n]*(?:\n|$))+)")
_RECORDED = re.compile(rf"""[^/'",\[\]\n]*({"|".join(map(re.escape, ENDINGS))})(\.zstd)?\b""")
"""List of the files in the metadata, and the name of one in it, without its folder."""


@dataclass(frozen=True)
class Bag:
    """A folder that is one recording: its files in their order, and why it is not whole."""

    folder: Path
    files: tuple[Path, ...]
    problem: str | None = None


def bag_of(file: Path, within: str | None = None) -> Bag | None:
    """Return the bag that a file belongs to, or None where it stands for itself.

    Parameters
    ----------
    file : Path
        A recorded file, or ``metadata.yaml``. Other files, and those that their folder's metadata does not list, belong
        to no bag.
    within : str, optional
        As for `open_regular`: metadata elsewhere are not opened.
    """
    if file.name != METADATA and file.suffix.lower() not in ENDINGS:
        return None
    folder, own = file.parent, _numbered(file.parent)
    try:
        with open_regular(folder / METADATA, within) as stream:
            text = stream.read(LARGEST_METADATA).decode("utf-8", "replace")
    except OSError:
        if len(own) < 2 or file.name not in own:
            return None
        unlisted = (
            f"{len(own)} files {own[0]}, ... look like one bag, but {METADATA}, which lists its files, is missing. "
            "Run `ros2 bag reindex` on the folder; if each is a recording of its own, rename the folder."
        )
        return Bag(folder, tuple(folder / name for name in own), unlisted)
    if _MARK not in text:
        return None
    # early versions wrote folders; one that was unpacked by hand has lost its second ending
    section = _LISTED.search(text)
    listed = [name[0].lstrip("- ") for name in _RECORDED.finditer(section[1])] if section else []
    listed = [plain if os.path.exists(folder / (plain := name.removesuffix(".zstd"))) else name for name in listed]
    if not listed:
        return Bag(
            folder, (folder / METADATA,), f"{METADATA} lists no files; expected relative_file_paths. Reindex it."
        )
    if file.name not in {METADATA, *listed, *own}:
        return None
    problem: str | None = None
    # unlike that of a path this takes names that no file system allows
    if lost := [name for name in listed if not os.path.exists(folder / name)]:
        problem = f"{lost} of the bag {_title(folder)} are missing, which {METADATA} lists; expected all together."
    elif more := [name for name in own if name not in listed]:
        problem = f"{more} of the bag {_title(folder)} are not listed in {METADATA}. Run `ros2 bag reindex` on it."
    return Bag(folder, tuple(folder / name for name in listed), problem)


def _title(folder: Path) -> str:
    return os.path.basename(os.path.abspath(folder))


def _numbered(folder: Path) -> list[str]:
    """Return the files that `ros2 bag record` calls by their folder and counts, in that order."""
    try:
        names = os.listdir(folder)
    except OSError:  # whoever opens the file says why
        return []
    pattern = re.compile(rf"{re.escape(_title(folder))}_(\d+)({'|'.join(map(re.escape, ENDINGS))})")
    return [match[0] for match in sorted(filter(None, map(pattern.fullmatch, names)), key=lambda found: int(found[1]))]


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
    problem : str or None
        Why it cannot be read at all.
    code : str
        The same as one of `errors.Code`.
    within : str or None
        Real path of the folder that no link may lead out of; None for a link that was given itself.
    mode : int
        Who may read all of its files.
    """

    path: Path
    key: str
    files: tuple[Path, ...]
    size: int
    mtime_ns: int
    profile: Profile | None
    problem: str | None = None
    code: Code = "unreadable"
    within: str | None = None
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

    Links to files are followed where they stay inside the searched folder, and where they are given themselves. Links
    to folders inside a searched folder are not, since they may lead in a circle or out of the data: `notice` is told.

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
        folder = path if path.is_dir() else path.parent
        # a link that is given itself is the user's own choice
        within = None if folder != path and path.is_symlink() else os.path.realpath(folder)
        look = _files(path, excluded, notice, {} if unchanged is None else unchanged)
        for file in look if folder == path else [path]:
            source = _source(file, profiles, within)
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


_Problem = tuple[str, Code]
"""Why a source cannot be read: in words, and as one of the codes."""


def _source(file: Path, profiles: tuple[Profile, ...], within: str | None) -> Source:
    bag = bag_of(file, within)
    profile, path, problem = _claimed(bag.files[0] if bag else file, profiles)
    partner = profile.partner_of(path) if profile else None
    files: tuple[Path, ...] = (path, partner) if partner else (path,)
    if bag:
        path, files, partner = bag.folder, bag.files, None
        problem = (bag.problem, "partner-missing") if bag.problem else problem
    size, mtime_ns, present = 0, 0, []
    seen = list[os.stat_result]()
    for part in files:
        status = _status(part, within)
        if isinstance(status, os.stat_result):
            seen.append(status)
            present.append(part)
            size += status.st_size
            mtime_ns = max(mtime_ns, status.st_mtime_ns)
            continue
        if profile and part == partner and status[1] == "unreadable":
            text = f"{(problem or status)[0]} Profile {profile.name} reads a log from two files; add the second."
            problem = text, "partner-missing"
        problem = problem or status
    key = path_text(os.path.abspath(path))
    reason, code = problem or (None, "unreadable")
    mode = shared_mode(seen, path.parent)
    return Source(path, key, tuple(present), size, mtime_ns, profile, reason, code, within, mode)


def _status(file: Path, within: str | None) -> os.stat_result | _Problem:
    """Return size and times of a file of a log, or why it is not read."""
    try:
        status = os.stat(file if within is None else real_file(file, within))
    except OutsideError as error:
        text = f"{file.name} {error.strerror}, which was not given. Copy the log, or give the link itself to ingest it."
        return text, "link-outside"
    except OSError as error:
        return f"{file.name} cannot be read ({error.strerror}); expected it in {file.parent}.", "unreadable"
    if not stat.S_ISREG(status.st_mode):
        return f"{file.name} is no regular file; expected a log. Copy the log's content to a file.", "not-regular"
    return status


def _claimed(file: Path, profiles: tuple[Profile, ...]) -> tuple[Profile | None, Path, _Problem | None]:
    """Return the profile that claims a file, the log that the file belongs to, and the problem with it."""
    for profile in profiles:
        log = profile.log_of_partner(file)
        if log is None:
            continue
        # unlike that of a path this takes names that no file system allows
        if os.path.exists(log):
            return profile, log, None
        text = f"the other file of this log, {log.name}, is missing; expected it in {file.parent}."
        return None, file, (text, "partner-missing")
    claimant = claim(file.name, profiles)
    if claimant is None:
        accepted = "; ".join(f"{p.name}: {', '.join(p.files)}" for p in profiles)
        text = f"no profile claims a file of this name; accepted are {accepted}. Remove it or give --profile."
        return None, file, (text, "no-profile")
    return claimant, file, None
