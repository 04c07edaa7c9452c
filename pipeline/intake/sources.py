"""From folders to checked logs, read-only: find logs, find the profile that claims each, read in batches.

``ros2 bag record`` makes a folder with ``metadata.yaml`` and one or more ``.db3`` or ``.mcap`` files: a long recording
is split over several. Together they are one log.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import stat
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from functools import cached_property, partial
from glob import escape
from itertools import islice
from pathlib import Path

from pipeline.base.disk import READABLE, shared_mode
from pipeline.base.errors import LogError, ParameterError, UsageError, refusal
from pipeline.base.paths import open_regular, path_text, storable
from pipeline.device.parameters import drive_of
from pipeline.profiles.profile_files import claim, load_profile, shipped_profiles
from pipeline.profiles.profile_model import CONDITION_QUANTITIES, Profile, conditions_in_name, number_in_name
from pipeline.readers import Log, RawLog, find_together, reader_of
from pipeline.readers.file_columns import LARGEST_LOG
from pipeline.readers.sheets import with_sheet
from pipeline.records.findings import Motion
from pipeline.store.names import folder_name

MANY = 400
"""Number of sources above which checking their recordings together saves more time than loading machine code takes."""

BATCH_LOGS = 256
BATCH_BYTES = 6 << 20
"""Number of logs and bytes of text parsed at once: enough to make the cost per call negligible, with little memory."""

LONGEST_FOLDER = 200
"""Longest folder name [byte] of a device or experiment; file systems allow 255 bytes."""

METADATA = "metadata.yaml"
ENDINGS = (".db3", ".mcap")

LARGEST_METADATA = 1 << 20
"""Number of bytes of ``metadata.yaml`` that are read; it has a few hundred per file and topic."""

_LISTED = re.compile(r"relative_file_paths:\s*(\[[^\]]*\]|(?:[ ]*-[^\n]*(?:\n|$))+)")
_RECORDED = re.compile(rf"""[^/'",\[\]\n]*({"|".join(map(re.escape, ENDINGS))})(\.zstd)?\b""")
"""Patterns of the list of files in the metadata, and of a file name in it, without its folder."""


def files_of_bag(file: Path) -> tuple[Path, ...]:
    """Return the files of the bag that a file belongs to, listed in its folder's ``metadata.yaml``, if any."""
    if file.name != METADATA and file.suffix.lower() not in ENDINGS:
        return ()
    try:
        with open_regular(file.parent / METADATA) as stream:
            text = stream.read(LARGEST_METADATA).decode("utf-8", "replace")
    except OSError:
        return ()
    section = _LISTED.search(text)
    found = [name[0].lstrip("- ") for name in _RECORDED.finditer(section[1])] if section else []
    # a file unpacked by hand has lost its second extension
    names = [plain if os.path.exists(file.with_name(plain := name.removesuffix(".zstd"))) else name for name in found]
    return tuple(map(file.with_name, names)) if file.name in (METADATA, *names) else ()


UNCOUNTED = frozenset({"truth.json"})
"""Files that the simulator writes next to logs, in lower case; they are not reported."""

_PAPERS = ("readme", "license", "licence", "copying", "changelog", "citation", "makefile", "dockerfile", "thumbs.db")
_NO_LOGS = {
    "papers": "md rst tex bib pdf doc docx odt ppt pptx html htm css cff",
    "scripts": "py pyc ipynb m mlx slx mdl r jl c cc cpp h hpp rs ino js sh bat ps1",
    "settings": "toml yaml yml ini cfg conf lock",
    "pictures": "png jpg jpeg gif svg bmp tif tiff webp eps mp4 avi mov mkv",
}
"""Prefixes and suffixes of names of files without samples."""

_ENDINGS = frozenset(" ".join(_NO_LOGS.values()).split())


def is_no_log(name: str) -> bool:
    """Return whether a file is a paper, script, setting or picture according to its name.

    >>> [is_no_log(name) for name in ("README.txt", "lab.toml", "look.html", "run_1.csv", "run.txt")]
    [True, True, True, False, False]
    """
    lower = name.lower()
    return os.path.splitext(lower)[1][1:] in _ENDINGS or lower.split(".")[0] in _PAPERS or lower in _PAPERS


@dataclass
class Notices:
    """Folders and files that a search skips.

    Parameters
    ----------
    folders : list of (Path, str)
        Folders that are not searched, each with the reason: a link, or no read permission.
    ignored : list of Path
        Files in searched folders that are no logs, by their names or by the caller's patterns.
    """

    folders: list[tuple[Path, str]] = field(default_factory=list)
    ignored: list[Path] = field(default_factory=list)


@dataclass(frozen=True)
class Source:
    """A log before it is read.

    Parameters
    ----------
    path : Path
        First file, as found; the folder of a ROS 2 bag, which is one log.
    key : str
        Its absolute path in the form of `file_names.path_text`: the key of the log in `processed/`, independent of the
        current folder.
    files : tuple of Path
        All files of the log.
    size, mtime_ns : int
        Size of all files together [byte] and newest modification time [ns].
    profile : Profile or None
        Profile that reads it.
    problem : LogError or None
        Why it cannot be read at all.
    mode : int
        Permission bits common to all of its files.
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

    @property
    def profile_sha256(self) -> str | None:
        """Hash of the profile."""
        return self.profile.digest if self.profile else None

    @cached_property
    def named_conditions(self) -> str | None:
        """Conditions that the profile reads from the name of the log, as text; None if it does not read names.

        Names with the same meaning, such as 2 and 2.0, give the same text.
        """
        profile, name = self.profile, storable(self.path.name)
        if profile is None or not profile.reads_names:
            return None
        try:
            found = (conditions_in_name(profile.name_pattern, name) if profile.name_pattern else None) or {}
        except ParameterError:  # the log is refused when it is read
            found = {}
        for key in found.keys() & CONDITION_QUANTITIES:
            with suppress(ValueError):
                found[key] = str(number_in_name(found[key], profile.decimal_sign))
        entries = [entry.match for entry in profile.entries_for(name)]
        return json.dumps([found, entries], sort_keys=True)


@dataclass(frozen=True)
class AskedProfiles:
    """Profiles that may claim logs, ready for use.

    Parameters
    ----------
    profiles : tuple of Profile
    ignore : tuple of str
        Patterns of files that are no logs, such as the sheet of conditions.
    notices : tuple of (Path, str)
        Mismatches between the sheet and the logs.
    """

    profiles: tuple[Profile, ...]
    ignore: tuple[str, ...] = ()
    notices: tuple[tuple[Path, str], ...] = ()


def asked_profiles(profile: str | Path | Profile | None, paths: Sequence[Path]) -> AskedProfiles:
    """Return the named profile with its sheet read, or the shipped profiles if none is named.

    Raises
    ------
    ProfileError
        If there is no such profile, or the profile or its sheet is wrong.
    """
    if profile is None:
        return AskedProfiles(shipped_profiles())
    loaded = load_profile(profile)
    if loaded.sheet is None:
        return AskedProfiles((loaded,))
    sheet = Path(loaded.sheet.file)
    names = {file.name for path in paths for file in (_files(path, None, [], {}) if path.is_dir() else [path])}
    read = with_sheet(loaded, names)
    # if a single log is given, the other logs of the sheet are elsewhere
    notices = tuple((sheet, text) for text in read.notices) if any(path.is_dir() for path in paths) else ()
    return AskedProfiles((read.profile,), (escape(os.path.abspath(sheet)),), notices)


def find_sources(
    paths: Sequence[Path],
    profiles: tuple[Profile, ...],
    exclude: Path | None = None,
    notices: Notices | None = None,
    unchanged: dict[str, tuple[int, int]] | None = None,
    ignore: Sequence[str] = (),
) -> list[Source]:
    """Return every log below the given folders and files, each once, in order of path.

    Links to files are followed. Links to folders inside a searched folder are not, since they may be circular; they are
    added to `notices`. A file in a searched folder that is a paper, script, setting or picture by its name is no log,
    unless a profile names its extension; an explicitly given file always is.

    Parameters
    ----------
    paths : sequence of Path
        Files, and folders searched with all subfolders.
    profiles : tuple of Profile
        Profiles that may claim a file.
    exclude : Path, optional
        Folder to skip (`processed/`, which may be inside a searched folder).
    notices : Notices, optional
        Receives the skipped folders and files.
    unchanged : dict of str to (int, int), optional
        Size [byte] and time [ns] of files, by absolute path. Files that still match are skipped and removed from this
        mapping.
    ignore : sequence of str
        Patterns of files in searched folders that are no logs: matched with names or absolute paths.

    Raises
    ------
    UsageError
        If a path does not exist, is not readable, or is in the excluded folder.
    ProfileError
        If two profiles claim one file.
    """
    found: dict[str, Source] = {}
    excluded, seen = check_places(paths, exclude), Notices() if notices is None else notices
    for path in paths:
        if not path.is_dir():
            source = _source(path, profiles)
            found.setdefault(source.key, source)
            continue
        for file in _files(path, excluded, seen.folders, {} if unchanged is None else unchanged):
            if _matches(file, ignore):
                seen.ignored.append(file)
                continue
            source = _source(file, profiles)
            if is_no_log(file.name) and source.path == file and not _names_ending(source.profile, file):
                seen.ignored.append(file)
                continue
            found.setdefault(source.key, source)
    return [found[key] for key in sorted(found)]


def _matches(file: Path, patterns: Sequence[str]) -> bool:
    if not patterns:
        return False
    places = (file.name, os.path.abspath(file))
    return any(fnmatchcase(place, pattern) for pattern in patterns for place in places)


def _names_ending(profile: Profile | None, file: Path) -> bool:
    """Return whether a pattern of a profile names the extension of a file, so that the file is a log."""
    ending = file.suffix.lower() or file.name.lower()
    return profile is not None and any(pattern.lower().endswith(ending) for pattern in profile.files)


def check_places(paths: Sequence[Path], exclude: Path | None) -> str | None:
    """Check that the folders may be searched; return the real path of the excluded one. Errors as `find_sources`."""
    # the target of a link may also be reached by its real path
    excluded = None if exclude is None else os.path.realpath(exclude)
    for path in paths:
        if not os.path.exists(path):
            raise UsageError(f"{path}: no such file or folder, or it cannot be read. Give folders with logs, or logs.")
        if excluded is not None and os.path.join(os.path.realpath(path), "").startswith(os.path.join(excluded, "")):
            raise UsageError(f"{path}: lies in {exclude}, where results are kept. Give folders with logs.")
    return excluded


def _files(
    folder: Path, excluded: str | None, notices: list[tuple[Path, str]], unchanged: dict[str, tuple[int, int]]
) -> Iterator[Path]:
    """Yield the files below a folder except hidden ones and `UNCOUNTED`; links to folders are not followed."""

    def refused(error: OSError) -> None:
        notices.append((Path(error.filename), f"folder cannot be read ({error.strerror}). Correct its permissions."))

    for here, folders, names in os.walk(folder, onerror=refused):
        shown = [Path(here, name) for name in folders if name[0] != "."]
        text = "is a link to a folder, which is not followed. Give that folder if it has logs."
        notices += [(path, text) for path in shown if path.is_symlink()]
        folders[:] = [path.name for path in shown if os.path.realpath(path) != excluded]
        below = os.path.join(os.path.abspath(here), "")
        for name in names:
            path = below + name
            if path in unchanged and _state(path) == unchanged[path]:
                del unchanged[path]
            elif name[0] != "." and name.lower() not in UNCOUNTED:
                yield Path(here, name)


def _state(path: str) -> tuple[int, int] | None:
    """Return size and time of a path; for a link, those of the link itself."""
    with suppress(OSError):
        status = os.lstat(path)
        return status.st_size, status.st_mtime_ns
    return None


def is_settled(mtime_ns: int, settle_s: float) -> bool:
    """Return whether a modification time [ns] is at least `settle_s` ago, so that recording has ended."""
    # a time in the future, due to a wrong clock, must not cause endless waiting
    return abs(time.time_ns() - mtime_ns) >= settle_s * 1e9


def _source(file: Path, profiles: tuple[Profile, ...]) -> Source:
    bag, problem = files_of_bag(file), None
    profile, path = _claimed(bag[0] if bag else file, profiles)
    if profile is None:
        accepted = re.sub(r"(\[0-9\])+", "#", "; ".join(f"{p.name}: {', '.join(p.files)}" for p in profiles))
        problem = refusal("no-profile", "", f"no profile claims a file of this name; accepted are {accepted}")
    partner = profile.partner_of(path) if profile and not bag else None
    files = bag or tuple(filter(None, (path, partner)))
    path = file.parent if bag else path
    seen = dict[Path, os.stat_result]()
    for part in files:
        try:
            seen[part] = _status(part, bool(bag) or len(files) > 1)
        except LogError as error:
            problem = error if bag or problem is None else problem
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


@dataclass(frozen=True, eq=False)
class Read:
    """A source after reading: its logs, a refusal, or neither if its content is already stored.

    ``source`` has the size and time that the files had while they were read.
    """

    source: Source
    sha256: str | None
    result: tuple[Log, ...] | LogError | None


def read_and_check(
    sources: Sequence[Source], known: Callable[[Source, str], bool], *, together: bool = False
) -> list[Read]:
    """Read, hash, parse and check sources of one profile, in the order given.

    It writes nothing and keeps no state, so that it may run in a thread.

    Parameters
    ----------
    sources : sequence of Source
        All claimed by the same profile, or by none; at most a few MB in total, since they are kept in memory.
    known : callable
        Function that returns whether a source with a given SHA-256 is already stored; such a source is not parsed.
    together : bool, optional
        Whether their recordings are checked together, which is faster for more than `MANY`.
    """
    reads, raws = list[Read](), dict[int, RawLog]()
    for index, source in enumerate(sources):
        try:
            raw, sha256, seen = load_source(source)
            reads.append(Read(seen, sha256, None))
            if not known(source, sha256):
                raws[index] = raw
        except LogError as error:
            reads.append(Read(source, None, error))
    if raws and (profile := sources[0].profile):
        outcomes = reader_of(profile)(profile, list(raws.values()))
        for index, outcome in zip(raws, outcomes, strict=True):
            reads[index] = replace(reads[index], result=outcome)
    for read in reads:
        if isinstance(why := read.result, LogError):
            # the traceback would keep the bytes of logs in memory
            why.__traceback__ = why.__cause__ = why.__context__ = None
    if together:
        find_together([log for read in reads if isinstance(read.result, tuple) for log in read.result])
    return reads


def logs_of(source: Source) -> tuple[Profile, RawLog, tuple[Log, ...]]:
    """Read one source: the profile that claims it, the raw log, and the logs that the profile reads from it.

    Raises
    ------
    LogError
        If it is refused, with the row at fault.
    """
    raw, _, _ = load_source(source)
    assert source.profile is not None, "a source that no profile claims is refused by load_source"
    (outcome,) = reader_of(source.profile)(source.profile, [raw])
    if isinstance(outcome, LogError):
        raise outcome
    return source.profile, raw, outcome


def load_source(source: Source) -> tuple[RawLog, str, Source]:
    """Return the bytes and the SHA-256 of a source, and the source with its size and time during reading.

    Raises
    ------
    LogError
        If it is too large, cannot be read, changes while it is read, or no profile claims it.
    """
    if source.size > LARGEST_LOG:
        expected = f"a log of one step response, at most {LARGEST_LOG}"
        raise refusal("too-large", "", f"file has {source.size} bytes", expected)
    if source.problem:
        raise source.problem
    data = []
    size, mtime_ns = 0, 0
    for file in source.files:
        try:
            with open_regular(file) as stream:
                before = os.fstat(stream.fileno())
                data.append(stream.read(min(before.st_size, LARGEST_LOG) + 1))
                after = os.fstat(stream.fileno())
        except OSError as error:
            raise refusal("unreadable", "", f"file cannot be read ({error.strerror})") from error
        if (before.st_size, before.st_mtime_ns) != (len(data[-1]), after.st_mtime_ns):
            raise refusal("changed-while-read", "", "file changed while it was read", "a finished recording")
        size, mtime_ns = size + after.st_size, max(mtime_ns, after.st_mtime_ns)
    sha256 = content_hash([hashlib.sha256(part).hexdigest() for part in data])
    raw = RawLog(tuple(storable(file.name) for file in source.files), tuple(data))
    if (size, mtime_ns) != (source.size, source.mtime_ns):
        source = replace(source, size=size, mtime_ns=mtime_ns)
    return raw, sha256, source


def content_hash(hashes: Sequence[str]) -> str:
    """Return the SHA-256 of a log from those of its files, in their order."""
    return hashes[0] if len(hashes) == 1 else hashlib.sha256("".join(hashes).encode()).hexdigest()


def motion_of(log: Log, known: Mapping[str, Motion]) -> Motion:
    """Return the type of motion of a log, and check that its names can be stored.

    Parameters
    ----------
    log : Log
    known : mapping of str to {"translation", "rotation"}
        Motion of each device that has a device file.

    Raises
    ------
    LogError
        If a name is too long for a folder, or the log contradicts the device file.
    """
    header = log.header
    for key in ("device", "experiment"):
        name = getattr(header, key)
        if len(folder_name(name)) > LONGEST_FOLDER:
            cure = "Shorten it, or use ASCII letters."
            raise refusal("condition-wrong", "", f"{key} {name!r} is too long for a folder name", cure=cure)
    device = known.get(header.device)
    if device and header.motion and device != header.motion:
        found = f"motion is {header.motion}, but the device {header.device!r} has {device}"
        cure = "Correct the log, or give the device of this log another name."
        if drive_of(header.motion) != drive_of(device):
            cure = (
                f"State the force per unit of command with --gain '2.3 N/{drive_of(header.motion)}', or give the "
                "device of this log another name."
            )
        raise refusal("condition-wrong", "", found, cure=cure)
    return header.motion or device or "translation"


def batches_of(sources: Sequence[Source]) -> Iterator[list[Source]]:
    """Split sources into batches of one profile with at most `BATCH_LOGS` logs or `BATCH_BYTES` bytes (or one log)."""
    batch: list[Source] = []
    size = 0
    for source in sources:
        full = len(batch) >= BATCH_LOGS or size + source.size > BATCH_BYTES
        if batch and (full or batch[0].profile is not source.profile):
            yield batch
            batch, size = [], 0
        batch.append(source)
        size += source.size
    if batch:
        yield batch


def reads_of(sources: Sequence[Source], known: Callable[[Source, str], bool], jobs: int) -> Iterator[list[Read]]:
    """Read sources in batches in `jobs` threads, and yield the results in order.

    At most `jobs` batches are read ahead, so that memory is bounded. Parameters as for `read_and_check`.
    """
    batches, running = batches_of(sources), list[Future[list[Read]]]()
    read = partial(read_and_check, known=known, together=len(sources) >= MANY)
    with ThreadPoolExecutor(jobs) as pool:
        while True:
            running += [pool.submit(read, batch) for batch in islice(batches, jobs - len(running))]
            if not running:
                return
            yield running.pop(0).result()
