"""Search for logs, choice of the profile that claims each log, and reading in batches. Nothing is written.

``ros2 bag record`` creates a folder with ``metadata.yaml`` and ``.db3`` or ``.mcap`` files. It splits a long recording
into several files, which together form one log.
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
"""Threshold for the number of sources above which checking recordings together saves more time than loading the
compiled code takes."""

BATCH_LOGS = 256
BATCH_BYTES = 6 << 20
"""Number of logs, and bytes of text, that are parsed together. The overhead of each call is then negligible, and the
memory is small."""

LONGEST_FOLDER = 200
"""Longest folder name of a device or experiment [byte]. File systems allow 255 bytes."""

METADATA = "metadata.yaml"
ENDINGS = (".db3", ".mcap")

LARGEST_METADATA = 1 << 20
"""Number of bytes of ``metadata.yaml`` that are read. The file has a few hundred bytes for each file and topic."""

_LISTED = re.compile(r"relative_file_paths:\s*(\[[^\]]*\]|(?:[ ]*-[^\n]*(?:\n|$))+)")
_RECORDED = re.compile(rf"""[^/'",\[\]\n]*({"|".join(map(re.escape, ENDINGS))})(\.zstd)?\b""")
"""Patterns of the list of files in the metadata, and of a file name without folder in this list."""


def files_of_bag(file: Path) -> tuple[Path, ...]:
    """Return the files of the bag to which a file belongs, as listed in ``metadata.yaml`` in its folder.

    Otherwise, return ().
    """
    if file.name != METADATA and file.suffix.lower() not in ENDINGS:
        return ()
    try:
        with open_regular(file.parent / METADATA) as stream:
            text = stream.read(LARGEST_METADATA).decode("utf-8", "replace")
    except OSError:
        return ()
    section = _LISTED.search(text)
    found = [name[0].lstrip("- ") for name in _RECORDED.finditer(section[1])] if section else []
    # A file that was unpacked manually has lost its second extension.
    names = [plain if os.path.exists(file.with_name(plain := name.removesuffix(".zstd"))) else name for name in found]
    return tuple(map(file.with_name, names)) if file.name in (METADATA, *names) else ()


UNCOUNTED = frozenset({"truth.json"})
"""Files that the simulator writes next to logs, in lower case. They are not reported."""

_PAPERS = ("readme", "license", "licence", "copying", "changelog", "citation", "makefile", "dockerfile", "thumbs.db")
_NO_LOGS = {
    "papers": "md rst tex bib pdf doc docx odt ppt pptx html htm css cff",
    "scripts": "py pyc ipynb m mlx slx mdl r jl c cc cpp h hpp rs ino js sh bat ps1",
    "settings": "toml yaml yml ini cfg conf lock",
    "pictures": "png jpg jpeg gif svg bmp tif tiff webp eps mp4 avi mov mkv",
}
"""Base names and extensions of files without samples."""

_ENDINGS = frozenset(" ".join(_NO_LOGS.values()).split())


def is_no_log(name: str) -> bool:
    """Return True if the name of a file shows that it is a paper, script, settings file or picture.

    >>> [is_no_log(name) for name in ("README.txt", "lab.toml", "look.html", "run_1.csv", "run.txt")]
    [True, True, True, False, False]
    """
    lower = name.lower()
    return os.path.splitext(lower)[1][1:] in _ENDINGS or lower.split(".")[0] in _PAPERS or lower in _PAPERS


@dataclass
class Notices:
    """Folders and files that a search skipped.

    Parameters
    ----------
    folders : list of (Path, str)
        Folders that were not searched, each with the reason (a link, or unreadable).
    ignored : list of Path
        Files in searched folders that are not logs, according to their names or to the patterns of the caller.
    """

    folders: list[tuple[Path, str]] = field(default_factory=list)
    ignored: list[Path] = field(default_factory=list)


@dataclass(frozen=True)
class Source:
    """A log before it is read.

    Parameters
    ----------
    path : Path
        Path of the first file, as found. For a ROS 2 bag, the path of the folder, because the folder is one log.
    key : str
        Absolute path in the form of `file_names.path_text`, which does not depend on the current folder. Key of the log
        in `processed/`.
    files : tuple of Path
        All files of the log.
    size, mtime_ns : int
        Total size of the files [byte], and time of the newest modification [ns].
    profile : Profile or None
        Profile that reads the log.
    problem : LogError or None
        Reason why the log cannot be read at all.
    mode : int
        Permission bits that all files of the log have.
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
        """Conditions that the profile reads from the name of the log, as text. None if the profile does not read names.

        Equivalent names, such as names with 2 and 2.0, give the same text.
        """
        profile, name = self.profile, storable(self.path.name)
        if profile is None or not profile.reads_names:
            return None
        try:
            found = (conditions_in_name(profile.name_pattern, name) if profile.name_pattern else None) or {}
        except ParameterError:  # reading the log raises this error again
            found = {}
        for key in found.keys() & CONDITION_QUANTITIES:
            with suppress(ValueError):
                found[key] = str(number_in_name(found[key], profile.decimal_sign))
        entries = [entry.match for entry in profile.entries_for(name)]
        return json.dumps([found, entries], sort_keys=True)


@dataclass(frozen=True)
class RequestedProfiles:
    """Profiles that may claim logs, with their sheets of conditions read.

    Parameters
    ----------
    profiles : tuple of Profile
    ignore : tuple of str
        Patterns of files that are not logs, such as the sheet of conditions.
    notices : tuple of (Path, str)
        Differences between the sheet and the logs.
    """

    profiles: tuple[Profile, ...]
    ignore: tuple[str, ...] = ()
    notices: tuple[tuple[Path, str], ...] = ()


def requested_profiles(profile: str | Path | Profile | None, paths: Sequence[Path]) -> RequestedProfiles:
    """Return the given profile with its sheet read, or the shipped profiles if no profile is given.

    Raises
    ------
    ProfileError
        If the profile does not exist, or the profile or its sheet is invalid.
    """
    if profile is None:
        return RequestedProfiles(shipped_profiles())
    loaded = load_profile(profile)
    if loaded.sheet is None:
        return RequestedProfiles((loaded,))
    sheet = Path(loaded.sheet.file)
    names = {file.name for path in paths for file in (_files(path, None, [], {}) if path.is_dir() else [path])}
    read, found = with_sheet(loaded, names)
    # If single files are given, rows of the sheet for other logs are no mismatch.
    notices = tuple((sheet, text) for text in found) if any(path.is_dir() for path in paths) else ()
    return RequestedProfiles((read,), (escape(os.path.abspath(sheet)),), notices)


def find_sources(
    paths: Sequence[Path],
    profiles: tuple[Profile, ...],
    exclude: Path | None = None,
    notices: Notices | None = None,
    unchanged: dict[str, tuple[int, int]] | None = None,
    ignore: Sequence[str] = (),
) -> list[Source]:
    """Return every log in the given folders and files once, sorted by path.

    Links to files are followed. Links to folders inside a searched folder are added to `notices`, because they may be
    circular. A paper, script, settings file or picture in a searched folder, as recognised by its name, is not a log
    unless a profile names its extension. A file that is named explicitly is always treated as a log.

    Parameters
    ----------
    paths : sequence of Path
        Files, and folders that are searched recursively.
    profiles : tuple of Profile
        Profiles that may claim a file.
    exclude : Path, optional
        Folder to skip. (`processed/` may be inside a searched folder.)
    notices : Notices, optional
        Receives the skipped folders and files.
    unchanged : dict of str to (int, int), optional
        Size [byte] and time [ns] of known files, by absolute path. Files that are unchanged are skipped, and their
        entries are removed from this mapping.
    ignore : sequence of str
        Patterns of files in searched folders that are not logs. The patterns are matched with names and absolute paths.

    Raises
    ------
    UsageError
        If a path does not exist, cannot be read, or is in the excluded folder.
    ProfileError
        If two profiles claim the same file.
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
    """Return True if a pattern of the profile names the extension of a file. The file is then a log."""
    ending = file.suffix.lower() or file.name.lower()
    return profile is not None and any(pattern.lower().endswith(ending) for pattern in profile.files)


def check_places(paths: Sequence[Path], exclude: Path | None) -> str | None:
    """Return the real path of the excluded folder, after checking that the folders may be searched. Errors are raised
    as by `find_sources`.
    """
    # The target of a link may also be reached by its real path.
    excluded = None if exclude is None else os.path.realpath(exclude)
    for path in paths:
        if not os.path.exists(path):
            raise UsageError(f"{path}: does not exist or cannot be read. Name logs, or folders with logs.")
        if excluded is not None and os.path.join(os.path.realpath(path), "").startswith(os.path.join(excluded, "")):
            raise UsageError(f"{path}: is inside {exclude}, the folder of results. Give folders with logs.")
    return excluded


def _files(
    folder: Path, excluded: str | None, notices: list[tuple[Path, str]], unchanged: dict[str, tuple[int, int]]
) -> Iterator[Path]:
    """Yield the files below a folder, except hidden files and `UNCOUNTED`. Links to folders are not followed."""

    def refused(error: OSError) -> None:
        notices.append(
            (Path(error.filename), f"folder cannot be read ({error.strerror}). Correct the permissions of the folder.")
        )

    for here, folders, names in os.walk(folder, onerror=refused):
        shown = [Path(here, name) for name in folders if name[0] != "."]
        text = "is a link to a folder, which is not followed. If the folder has logs, name its path."
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
    """Return the size and the modification time of the file at a path. For a link, they are those of the link
    itself."""
    with suppress(OSError):
        status = os.lstat(path)
        return status.st_size, status.st_mtime_ns
    return None


def is_settled(mtime_ns: int, settle_s: float) -> bool:
    """Return True if a modification time [ns] is at least `settle_s` ago. The recording has then ended."""
    # A time in the future, due to a wrong clock, must not cause an endless wait.
    return abs(time.time_ns() - mtime_ns) >= settle_s * 1e9


def _source(file: Path, profiles: tuple[Profile, ...]) -> Source:
    bag, problem = files_of_bag(file), None
    profile, path = _claimed(bag[0] if bag else file, profiles)
    if profile is None:
        accepted = re.sub(r"(\[0-9\])+", "#", "; ".join(f"{p.name}: {', '.join(p.files)}" for p in profiles))
        problem = refusal("no-profile", "", f"no profile claims a file of this name; accepted names are {accepted}")
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
    """Return the size and the times of a file of a log.

    Raises
    ------
    LogError
        If the file cannot be read.
    """
    try:
        status = os.stat(file)
    except OSError as error:
        missing = one_of_several and not os.path.lexists(file)
        found = f"{file.name} {'is missing' if missing else f'cannot be read ({error.strerror})'}"
        raise refusal("partner-missing" if missing else "unreadable", "", found, f"it in {file.parent}") from error
    if not stat.S_ISREG(status.st_mode):
        raise refusal("not-regular", "", f"{file.name} is not a regular file", "a log")
    return status


def _claimed(file: Path, profiles: tuple[Profile, ...]) -> tuple[Profile | None, Path]:
    """Return the profile that claims a file, and the path of the log to which the file belongs."""
    for profile in profiles:
        if (log := profile.log_of_partner(file)) is not None:
            return profile, log
    return claim(file.name, profiles), file


@dataclass(frozen=True, eq=False)
class Read:
    """A source after reading, with its logs, or with a refusal, or with None if its content is already stored.

    ``source`` has the size and time of the files while they were read.
    """

    source: Source
    sha256: str | None
    result: tuple[Log, ...] | LogError | None


def read_and_check(
    sources: Sequence[Source], known: Callable[[Source, str], bool], *, together: bool = False
) -> list[Read]:
    """Read, hash, parse and check sources of one profile, in the given order.

    The function does not write and has no state, so it may run in a thread.

    Parameters
    ----------
    sources : sequence of Source
        Sources that are all claimed by one profile, or by none. Their total size must be at most a few MB, because all
        of them are kept in memory.
    known : callable
        Function that returns True if a source with the given SHA-256 is already stored. Such a source is not parsed.
    together : bool, optional
        True if the recordings are checked together, which is faster for more than `MANY` sources.
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
            # The traceback is removed, because it would keep the content of logs in memory.
            why.__traceback__ = why.__cause__ = why.__context__ = None
    if together:
        find_together([log for read in reads if isinstance(read.result, tuple) for log in read.result])
    return reads


def logs_of(source: Source) -> tuple[Profile, RawLog, tuple[Log, ...]]:
    """Read one source, and return the profile that claims it, the raw log, and the logs read from it.

    Raises
    ------
    LogError
        If the source is refused. The error states the faulty row.
    """
    raw, _, _ = load_source(source)
    assert source.profile is not None, "a source that no profile claims is refused by load_source"
    (outcome,) = reader_of(source.profile)(source.profile, [raw])
    if isinstance(outcome, LogError):
        raise outcome
    return source.profile, raw, outcome


def load_source(source: Source) -> tuple[RawLog, str, Source]:
    """Return the content and SHA-256 of a source, and the source with its size and time during reading.

    Raises
    ------
    LogError
        If the source is too large, cannot be read, changes while it is read, or is not claimed by a profile.
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
            raise refusal("changed-while-read", "", "the file changed while it was read", "a finished recording")
        size, mtime_ns = size + after.st_size, max(mtime_ns, after.st_mtime_ns)
    sha256 = content_hash([hashlib.sha256(part).hexdigest() for part in data])
    raw = RawLog(tuple(storable(file.name) for file in source.files), tuple(data))
    if (size, mtime_ns) != (source.size, source.mtime_ns):
        source = replace(source, size=size, mtime_ns=mtime_ns)
    return raw, sha256, source


def content_hash(hashes: Sequence[str]) -> str:
    """Return the SHA-256 of a log from the hashes of its files, in the order of the files."""
    return hashes[0] if len(hashes) == 1 else hashlib.sha256("".join(hashes).encode()).hexdigest()


def motion_of(log: Log, known: Mapping[str, Motion]) -> Motion:
    """Return the type of motion of a log, and check that its names can be stored.

    Parameters
    ----------
    log : Log
    known : mapping of str to {"translation", "rotation"}
        Motion of each device with a device file.

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
        cure = "Correct the log, or give the device of this log a different name."
        if drive_of(header.motion) != drive_of(device):
            cure = (
                f"State the force per unit of command with --gain '2.3 N/{drive_of(header.motion)}', or give the "
                "device of this log a different name."
            )
        raise refusal("condition-wrong", "", found, cure=cure)
    return header.motion or device or "translation"


def batches_of(sources: Sequence[Source]) -> Iterator[list[Source]]:
    """Split sources into batches.

    A batch has one profile, and at most `BATCH_LOGS` logs and `BATCH_BYTES` (or one log).
    """
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
    """Read sources in batches in `jobs` threads, and yield the results in the given order.

    At most `jobs` batches are read ahead, which limits memory. The parameters are those of `read_and_check`.
    """
    batches, running = batches_of(sources), list[Future[list[Read]]]()
    read = partial(read_and_check, known=known, together=len(sources) >= MANY)
    with ThreadPoolExecutor(jobs) as pool:
        while True:
            running += [pool.submit(read, batch) for batch in islice(batches, jobs - len(running))]
            if not running:
                return
            yield running.pop(0).result()
