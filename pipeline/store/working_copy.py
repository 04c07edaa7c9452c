"""A working copy of an object store: a folder with the files of one moment, on which all code works as on any folder.

It holds the small files (trials, results, exclusions) from the begin on; samples are brought when they are asked for.
What changed in it is published by the manifests (`manifests.advance`). For a store that is a folder nothing of this
happens: the functions here do nothing then, and the package for object stores is not imported.
"""

from __future__ import annotations

import hashlib
import os
import secrets
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TypeVar

from pipeline.base.disk import if_writable, remove
from pipeline.base.errors import PipelineError, StoreError
from pipeline.records.table_files import read_table
from pipeline.store.manifests import (
    STORE,
    ConflictError,
    Files,
    Manifest,
    advance,
    device_of,
    list_manifests,
    manifest_of,
    object_folder,
    read_manifest,
)
from pipeline.store.objects import Objects, is_url
from pipeline.store.storage import EXCLUSIONS_FILE, stage_file

Result = TypeVar("Result")

Sign = tuple[int, int, int]
"""Inode, size [byte] and time [ns] of a file: another content has another one."""

_TREES = ("trials", "samples", "stages", "theory", "quarantine")
"""Folders that are published, with the exclusions; locks, notes and incomplete files are of one machine."""

_SMALL_AT_ONCE, _LARGE_AT_ONCE = 16, 4
"""Requests at a time: they mostly wait; samples of one batch may take 64 MiB in memory."""

REPEATS = 20
"""Times that a command is done anew because others stored into the same experiment: each time one of them succeeds."""

KEPT = timedelta(days=7)
"""Age from which an object that no manifest names is removed: who reads by an older manifest, or was about to name it,
is done by then."""

_SHA256 = 64
"""Digits of a SHA-256, by which the name of an object begins."""


@dataclass(frozen=True)
class Snapshot:
    """An experiment of an object store as one process sees it, for others: they compute from the same trials."""

    url: str
    manifests: tuple[Manifest, ...]


@dataclass
class _Copy:
    """The folder of a working copy, with what it was made from."""

    objects: Objects
    folder: Path
    manifests: dict[str, Manifest] = field(default_factory=dict)
    signs: dict[str, Sign] = field(default_factory=dict)
    """Of each file as it was brought or published."""

    def take(self, manifests: Iterable[Manifest], later: tuple[str, ...] = ("samples/",)) -> None:
        """Take files into the copy, and bring them but for those in some folders."""
        new = {manifest.name: manifest for manifest in manifests}
        self.manifests |= new
        self.bring([path for one in new.values() for path in one.files if not path.startswith(later)], _SMALL_AT_ONCE)

    def bring(self, paths: Iterable[str], at_once: int) -> None:
        """Fetch those of some files that the store has and the folder has not."""
        missing = [path for path in paths if self._object(path) and not self._is_there(path)]
        _each(self._fetch, missing, at_once)

    def _is_there(self, path: str) -> bool:
        return path in self.signs and (self.folder / path).exists()

    def _object(self, path: str) -> str | None:
        name = manifest_of(path)
        return self.manifests[name].files.get(path) if name in self.manifests else None

    def _fetch(self, path: str) -> None:
        name = f"{object_folder(manifest_of(path))}{self._object(path)}"
        found = self.objects.get(name)
        if found is None or hashlib.sha256(found[0]).hexdigest() != os.path.basename(name)[:_SHA256]:
            fault = "is missing" if found is None else "is not as it was written"
            raise StoreError(
                f"{self.objects.url}/{name}: {fault}; it holds {path}. Restore it by a backup of the store, or ingest "
                "the logs into another one."
            )
        file = self.folder / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(found[0])
        self.signs[path] = _sign(file)

    def publish(self) -> None:
        """Publish what changed in the folder, experiment by experiment; samples then need not stay.

        Raises
        ------
        ConflictError
            If others changed the same experiment; all others are published.
        """
        present = _files_of(self.folder)
        there: dict[str, dict[str, Sign]] = defaultdict(dict)
        for path, sign in present.items():
            there[manifest_of(path)][path] = sign
        gone: dict[str, set[str]] = defaultdict(set)
        for path in self.signs.keys() - present.keys():
            gone[manifest_of(path)].add(path)
        conflicts: list[ConflictError] = []

        def published(name: str) -> None:
            try:
                self._publish(name, there[name], gone[name])
            except ConflictError as error:
                conflicts.append(error)

        _each(published, list({**there, **gone}), _SMALL_AT_ONCE)
        if conflicts:
            raise conflicts[0]
        for path in present:
            if path.startswith("samples/"):
                remove(self.folder / path)
                self.signs.pop(path, None)

    def _publish(self, name: str, present: Mapping[str, Sign], gone: Set[str]) -> None:
        base = self.manifests.get(name) or Manifest(name)
        changed = [path for path, sign in present.items() if self.signs.get(path) != sign]
        if not changed and all(path.startswith("samples/") for path in gone):
            return
        kept = {path: held for path, held in base.files.items() if path not in gone or path.startswith("samples/")}
        if any(path.startswith("trials/") for path in (*changed, *gone)):
            # samples stay as long as a trial names them
            named = self._named_samples(present)
            kept = {path: held for path, held in kept.items() if not path.startswith("samples/") or path in named}
            changed = [path for path in changed if not path.startswith("samples/") or path in named]
        files = kept | {path: self._put(path) for path in changed}
        after = advance(self.objects, base, files)
        # where others stored trials meanwhile, this copy does not have them: its ETag stays the old one
        self.manifests[name] = Manifest(name, files, after.etag if after.files == files else base.etag)
        # other threads change other keys
        for path in gone:
            self.signs.pop(path, None)
        self.signs.update({path: present[path] for path in changed})

    def _named_samples(self, present: Iterable[str]) -> set[str]:
        tables = (read_table(self.folder / path, ["sample_file"]) for path in present if path.startswith("trials/"))
        return {str(name) for table in tables for name in table.column("sample_file").to_pylist()}

    def _put(self, path: str) -> str:
        with open(self.folder / path, "rb") as stream:
            sha256 = hashlib.file_digest(stream, "sha256").hexdigest()
        # a name of its own: what a sweep of unused objects has listed is never used again
        name = f"{sha256}-{secrets.token_hex(8)}"
        self.objects.put(f"{object_folder(manifest_of(path))}{name}", self.folder / path)
        return name


_copies: dict[str, _Copy] = {}
"""Working copies of this process, by folder."""


@contextmanager
def opened(place: str | Path, device: str | None = None) -> Iterator[Path]:
    """Yield the folder of a store: itself, or a working copy of an object store, published when the block ends well.

    Parameters
    ----------
    place : str or Path
        Folder, or URL of an object store.
    device : str, optional
        Only its trials; refused logs are left out, too.

    Raises
    ------
    UsageError, StoreError
        If the store cannot be opened or read, or does not take what changed.
    """
    if not is_url(place):
        yield Path(place)
        return
    with _copy(os.fspath(place)) as copy:
        every = list_manifests(copy.objects)
        # where there is nothing of the device, the error names what there is
        names = [name for name in every if device is None or device_of(name) == device] or every
        found = _each(lambda name: read_manifest(copy.objects, name), [STORE, *names], _SMALL_AT_ONCE)
        copy.take(found, ("samples/",) if device is None else ("samples/", "quarantine/"))
        yield copy.folder
        with if_writable():
            copy.publish()


@contextmanager
def reopened(part: Path | Snapshot) -> Iterator[Path]:
    """Yield the folder of what `snapshot` handed to this process; what changed is published with `publish`."""
    if isinstance(part, Path):
        yield part
        return
    with _copy(part.url) as copy:
        copy.take(part.manifests)
        yield copy.folder


@contextmanager
def _copy(url: str) -> Iterator[_Copy]:
    objects = Objects(url)
    with tempfile.TemporaryDirectory(prefix="pipeline-") as folder:
        copy = _copies[folder] = _Copy(objects, Path(folder))
        try:
            yield copy
        except PipelineError as error:
            error.args = tuple(str(part).replace(folder, objects.url) for part in error.args)
            raise
        finally:
            del _copies[folder]


def stored_by(place: str | Path, work: Callable[[Path], Result]) -> Result:
    """Return what a function that stores into a folder returns; it is called anew where another one was faster."""
    for attempt in range(REPEATS):
        try:
            with opened(place) as folder:
                result = work(folder)
                publish(folder)  # here it is an error where the store may only be read
                return result
        except ConflictError:
            if attempt == REPEATS - 1:
                raise
    raise AssertionError("the last attempt returns or raises")


def bring(processed: Path, files: Iterable[str]) -> None:
    """Fetch stored files, by their path in `processed`, that a working copy does not have yet."""
    copy = _copies.get(os.fspath(processed))
    if copy is not None:
        copy.bring(files, _LARGE_AT_ONCE)


def publish(processed: Path) -> None:
    """Make what was stored into a working copy visible to others, as it is at once in a folder."""
    copy = _copies.get(os.fspath(processed))
    if copy is not None:
        copy.publish()


def unused_objects(processed: Path) -> dict[str, int]:
    """Return the old objects of the store of a working copy that no manifest names, with their sizes [byte]."""
    copy = _copies.get(os.fspath(processed))
    if copy is None:
        return {}
    # listed first: what is put and named meanwhile is not in the list
    now = datetime.now(UTC)
    old = {name: size for name, size, put in copy.objects.list("objects/") if now - put > KEPT}
    manifests = _each(
        lambda name: read_manifest(copy.objects, name), [STORE, *list_manifests(copy.objects)], _SMALL_AT_ONCE
    )
    used = {f"{object_folder(one.name)}{name}" for one in manifests for name in one.files.values()}
    return {name: size for name, size in old.items() if name not in used}


def remove_objects(processed: Path, names: Iterable[str]) -> None:
    """Remove objects that `unused_objects` named."""
    copy = _copies.get(os.fspath(processed))
    if copy is not None:
        copy.objects.delete(names)


def origin(processed: Path) -> str:
    """Return the folder of a store as text, or the URL that it is a working copy of."""
    copy = _copies.get(os.fspath(processed))
    return os.fspath(processed) if copy is None else copy.objects.url


def snapshot(processed: Path, device: str, experiment: str) -> Path | Snapshot:
    """Return an experiment for `reopened` in other processes: its folder, or the manifests by which it is seen here."""
    copy = _copies.get(os.fspath(processed))
    if copy is None:
        return processed.absolute()
    name = manifest_of(stage_file(processed, device, experiment, "any").relative_to(processed).as_posix())
    exclusions = copy.manifests[STORE].files.get(EXCLUSIONS_FILE)
    store = Manifest(STORE, {} if exclusions is None else {EXCLUSIONS_FILE: exclusions})
    return Snapshot(copy.objects.url, (store, copy.manifests.get(name) or Manifest(name)))


def results_in(processed: Path) -> tuple[Manifest, ...]:
    """Return the manifests of a working copy after `publish`, for `take_results` where it was made from."""
    copy = _copies.get(os.fspath(processed))
    return () if copy is None else tuple(one for name, one in copy.manifests.items() if name != STORE)


def take_results(processed: Path, manifests: Iterable[Manifest]) -> None:
    """Take the stages that other processes published into a working copy."""
    copy = _copies.get(os.fspath(processed))
    if copy is None:
        return
    for one in manifests:
        stages: Files = {path: there for path, there in one.files.items() if path.startswith("stages/")}
        base = copy.manifests.get(one.name) or Manifest(one.name)
        copy.manifests[one.name] = Manifest(one.name, {**base.files, **stages}, one.etag)
        for path in stages:
            copy.signs.pop(path, None)
        copy.bring(stages, _SMALL_AT_ONCE)


def _each(work: Callable[[str], Result], names: Sequence[str], at_once: int) -> list[Result]:
    if len(names) < 2:
        return [work(name) for name in names]
    with ThreadPoolExecutor(min(at_once, len(names))) as pool:
        return list(pool.map(work, names))


def _files_of(folder: Path) -> dict[str, Sign]:
    """Return the complete files of a working copy that are published, with their signs."""
    found: dict[str, Sign] = {}
    for tree in _TREES:
        for here, _, names in os.walk(folder / tree):
            for name in names:
                if not name.startswith("."):
                    file = Path(here, name)
                    found[file.relative_to(folder).as_posix()] = _sign(file)
    exclusions = folder / EXCLUSIONS_FILE
    return found | ({EXCLUSIONS_FILE: _sign(exclusions)} if exclusions.exists() else {})


def _sign(file: Path) -> Sign:
    status = file.stat()
    return status.st_ino, status.st_size, status.st_mtime_ns
