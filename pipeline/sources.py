"""Which files are logs: walks folders, lets a profile claim each file, joins the files of a pair."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.errors import UsageError
from pipeline.profiles import Profile, claim

UNCOUNTED = frozenset({"truth.json", "readme", "readme.md", "readme.txt", "license", "license.md", "license.txt"})
"""Files that stand beside logs and are none (the first by the simulator), in small letters; not counted in folders."""


@dataclass(frozen=True)
class Source:
    """One log before it is read.

    Parameters
    ----------
    path : Path
        First file, as found.
    key : str
        Its absolute path: what `processed/` knows the log by, whatever folder the command is called from.
    files : tuple of Path
        All files of the log.
    size, mtime_ns : int
        Size of all files together [byte] and newest modification time [ns].
    profile : Profile or None
        What reads it.
    problem : str or None
        Why it cannot be read at all.
    """

    path: Path
    key: str
    files: tuple[Path, ...]
    size: int
    mtime_ns: int
    profile: Profile | None
    problem: str | None = None


def find_sources(paths: Sequence[Path], profiles: tuple[Profile, ...], exclude: Path | None = None) -> list[Source]:
    """Return every log below the given folders and files, each once, in order of path.

    Parameters
    ----------
    paths : sequence of Path
        Folders, searched with all folders below, and files.
    profiles : tuple of Profile
        Profiles that may claim a file.
    exclude : Path, optional
        Folder that is left out (`processed/`, which may lie inside a searched folder).

    Raises
    ------
    UsageError
        If a path does not exist or lies in the excluded folder.
    ProfileError
        If two profiles claim one file.
    """
    found: dict[str, Source] = {}
    excluded = None if exclude is None else Path(os.path.abspath(exclude))
    for path in paths:
        if not path.exists():
            raise UsageError(f"{path}: no such file or folder. Give folders with logs, or single logs.")
        if excluded in (here := Path(os.path.abspath(path)), *here.parents):
            raise UsageError(f"{path}: lies in {exclude}, where results are kept. Give folders with logs.")
        for file in _walk(path, excluded) if path.is_dir() else [path]:
            source = _source(file, profiles)
            found.setdefault(source.key, source)
    return [found[key] for key in sorted(found)]


def _walk(folder: Path, exclude: Path | None) -> Iterator[Path]:
    for here, folders, files in os.walk(folder):
        folders[:] = [f for f in folders if not f.startswith(".") and Path(os.path.abspath(here), f) != exclude]
        for name in files:
            if not name.startswith(".") and name.lower() not in UNCOUNTED:
                yield Path(here, name)


def _source(file: Path, profiles: tuple[Profile, ...]) -> Source:
    profile, path, problem = _claimed(file, profiles)
    partner = profile.partner_of(path) if profile else None
    files = (path, partner) if partner else (path,)
    size, mtime_ns, present = 0, 0, []
    for part in files:
        try:
            status = part.stat()
        except OSError as error:
            problem = problem or f"{part.name} cannot be read ({error.strerror}); expected it in {part.parent}."
            if part == partner:
                problem += f" Profile {profile.name if profile else ''} reads a log from two files; add the second."
            continue
        if not stat.S_ISREG(status.st_mode):
            problem = problem or f"{part.name} is no regular file; expected a log. Copy the log's content to a file."
            continue
        present.append(part)
        size += status.st_size
        mtime_ns = max(mtime_ns, status.st_mtime_ns)
    return Source(path, os.path.abspath(path), tuple(present), size, mtime_ns, profile, problem)


def _claimed(file: Path, profiles: tuple[Profile, ...]) -> tuple[Profile | None, Path, str | None]:
    """Return the profile that claims a file, the log that the file belongs to, and the problem with it."""
    for profile in profiles:
        log = profile.log_of_partner(file)
        if log is None:
            continue
        if log.exists():
            return profile, log, None
        return (
            None,
            file,
            f"the other file of this log, {log.name}, is missing; expected it in {file.parent}.",
        )
    claimant = claim(file.name, profiles)
    if claimant is None:
        accepted = "; ".join(f"{p.name}: {', '.join(p.files)}" for p in profiles)
        return (
            None,
            file,
            f"no profile claims a file of this name; accepted are {accepted}. Remove it or give --profile.",
        )
    return claimant, file, None
