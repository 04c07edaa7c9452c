"""An object store worked on as a folder: its files are brought, and what changed in the folder goes back.

Files bear the hash of their content, are whole by themselves and never change, so that an object store needs no more
than a folder does: what is new is put, and then what it stands in the place of is deleted. Nobody waits for anybody:
what two writers store at once are other files, or the same one. For a store that is a folder nothing of this happens,
and the package for object stores is not imported.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TypeVar

from pipeline.base.disk import each, if_writable
from pipeline.base.errors import PipelineError, StoreError
from pipeline.store.corrections import read_corrections
from pipeline.store.names import name_of_folder
from pipeline.store.objects import Objects, is_url

Result = TypeVar("Result")

_TREES = ("trials", "stages", "theory", "corrections", "quarantine")
"""What is stored; locks and incomplete files are of one machine. Trials are put before anything that rests on them."""

Listed = tuple[str, int, datetime]
"""Name, size [byte] and time of putting of an object."""

REPEATS = 20
"""Times that a store is listed again because files were merged while they were brought."""

_AT_ONCE = 8
"""Requests at a time: they mostly wait; a batch takes some 10 MiB in memory, 256 at most."""


@dataclass
class _Mirror:
    """The folder of an object store, and what is in both; of a device or an experiment alone where one is named."""

    objects: Objects
    folder: Path
    place: tuple[str, ...]
    known: dict[str, tuple[int, int]] = field(default_factory=dict)
    """Size and time of each file that the store has, too."""

    def bring(self, trees: tuple[str, ...] = _TREES) -> bool:
        """Bring what came to the store since; return whether anything did."""
        brought = False
        for _ in range(REPEATS):
            listed = [one for one in self.objects.list("") if _is_stored(one[0])]
            self._fetch_new([one for one in listed if one[0].startswith("corrections/")])
            own = self.place
            if any(one.changes_place for one in read_corrections(self.folder).values()):
                own = ()  # trials of any other device may count as of this one
            elif not any(_is_of(name.split("/"), own) for name, _, _ in listed if name.startswith("trials/")):
                own = ()  # where there is nothing of the device, the error names what there is
            wanted = {name for name, _, _ in listed if name.startswith(trees) and _is_of(name.split("/"), own)}
            new, missing = self._fetch_new([one for one in listed if one[0] in wanted])
            brought |= new
            if not missing:
                return brought
        raise StoreError(f"{self.objects.url}: changed during each of {REPEATS} attempts to read it. Wait for others.")

    def _fetch_new(self, listed: Sequence[Listed]) -> tuple[bool, bool]:
        """Bring what is new of some files; return whether there was any, and whether another one has replaced one."""
        new = [one for one in listed if one[0] not in self.known]
        return bool(new), not all(each(self._fetch, new, _AT_ONCE))

    def _fetch(self, one: Listed) -> bool:
        name, _, put = one
        found = self.objects.get(name)
        if found is None:
            return False
        file = self.folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(found)
        os.utime(file, (put.timestamp(), put.timestamp()))
        self.known[name] = _sign(file)
        return True

    def publish(self) -> None:
        """Put what is new, then delete what is gone."""
        present = {
            file.relative_to(self.folder).as_posix(): _sign(file)
            for tree in _TREES
            for file in sorted((self.folder / tree).rglob("*"))
            if file.is_file() and not file.name.startswith(".")
        }
        new = [name for name, sign in present.items() if self.known.get(name) != sign]
        each(lambda name: self.objects.put(name, self.folder / name), new, _AT_ONCE)
        self.objects.delete(self.known.keys() - present.keys())
        self.known = present


def _is_stored(name: str) -> bool:
    """Return whether a name, which others gave, is one of ours and stays below the folder."""
    tree, *parts = name.split("/")
    return tree in _TREES and "\\" not in name and not any(part in ("", ".", "..") for part in parts)


def _is_of(parts: list[str], place: tuple[str, ...]) -> bool:
    """Return whether a file concerns a device, or an experiment of it; everything concerns all of a store."""
    if not place or parts[0] in ("theory", "corrections"):
        return True
    return parts[0] != "quarantine" and tuple(map(name_of_folder, parts[1 : 1 + len(place)])) == place


_mirrors: dict[str, _Mirror] = {}
"""Mirrors of this process, by folder."""


@contextmanager
def opened(place: str | Path, *only: str) -> Iterator[Path]:
    """Yield the folder of a store: itself, or a mirror of an object store, published when the block ends well.

    Parameters
    ----------
    place : str or Path
        Folder, or URL of an object store.
    *only : str
        A device, or a device and one of its experiments, where no other trials are needed.

    Raises
    ------
    UsageError, StoreError
        If the store cannot be opened or read, or does not take what changed.
    """
    if not is_url(place):
        yield Path(place)
        return
    objects = Objects(os.fspath(place))
    with tempfile.TemporaryDirectory(prefix="pipeline-") as folder:
        mirror = _mirrors[folder] = _Mirror(objects, Path(folder), only)
        try:
            mirror.bring()
            yield mirror.folder
            with if_writable():
                mirror.publish()
        except PipelineError as error:
            error.args = tuple(str(part).replace(folder, objects.url) for part in error.args)
            raise
        finally:
            del _mirrors[folder]


def stored_by(place: str | Path, work: Callable[[Path], Result]) -> Result:
    """Return what a function that stores into a folder returns; an error where the store may only be read."""
    with opened(place) as folder:
        result = work(folder)
        publish(folder)
        return result


def publish(processed: Path) -> None:
    """Make what was stored into a mirror visible to others, as it is at once in a folder."""
    if os.fspath(processed) in _mirrors:
        _mirrors[os.fspath(processed)].publish()


def renewed(processed: Path, tree: str) -> bool:
    """Bring what others stored of a kind into the store of a mirror since; return whether there was anything."""
    mirror = _mirrors.get(os.fspath(processed))
    return mirror is not None and mirror.bring((tree,))


def origin(processed: Path) -> str:
    """Return the folder of a store as text, or the URL that it is a mirror of."""
    mirror = _mirrors.get(os.fspath(processed))
    return os.fspath(processed) if mirror is None else mirror.objects.url


def _sign(file: Path) -> tuple[int, int]:
    status = file.stat()
    return status.st_size, status.st_mtime_ns
