"""A store by URL, such as S3: its files are copied to a temporary folder, and changes are copied back.

Files are named by the hash of their content, are complete and never change, so an object store works like a folder: new
files are put, then the files that they replace are deleted. Writers never wait for each other, because two writers
store different files, or the same one. The temporary folder is removed at the end. A store that is a folder is used
directly, and the package for object stores (the extra ``cluster``) is not imported.
"""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from importlib.util import find_spec
from pathlib import Path
from typing import TypeVar

from pipeline.base.disk import if_writable, map_in_threads
from pipeline.base.errors import PipelineError, StoreError, UsageError
from pipeline.store.names import name_of_folder
from pipeline.store.storage import read_corrections

Result = TypeVar("Result")

SCHEME = "s3://"
"""Beginning of the URL of a store."""

RETRIES = 10
"""Number of retries after a failure of the network or a busy server, with growing pauses from 0.1 s."""

PATIENCE_S = 30.0
"""Time for which a request is retried [s]: long enough for a server restart, short enough to report a server that is
down."""

_TREES = ("trials", "stages", "theory", "corrections", "quarantine")
"""Folders that are stored; locks and incomplete files stay local. Trials are put before results that depend on them."""

REPEATS = 20
"""Largest number of repeated listings of a store whose files were merged during download."""

_AT_ONCE = 8
"""Number of parallel requests: they mostly wait; a batch takes about 10 MiB of memory, at most 256 MiB."""

Listed = tuple[str, int, datetime]
"""Name, size [byte] and upload time of an object."""


class Objects:
    """The objects below a URL, and the few atomic requests that stored tables need.

    Parameters
    ----------
    url : str
        ``s3://bucket/prefix``; credentials and endpoint are taken from the usual variables (``AWS_ACCESS_KEY_ID``,
        ``AWS_ENDPOINT_URL``, ``AWS_ALLOW_HTTP`` ...).

    Raises
    ------
    UsageError
        If the URL is not a store URL, or the package for it is not installed.
    """

    def __init__(self, url: str) -> None:
        self.url = url.rstrip("/")
        if not self.url.startswith(SCHEME) or len(self.url) == len(SCHEME):
            raise UsageError(f"{url}: is no URL of a store; expected a folder, or {SCHEME}BUCKET/PREFIX.")
        check_installed("obstore", f"a store at {self.url}")
        from obstore.store import S3Store

        http = os.environ.get("AWS_ALLOW_HTTP", "").lower() in ("1", "true", "yes", "on")
        try:
            self._store = S3Store.from_url(
                self.url,
                retry_config={"max_retries": RETRIES, "retry_timeout": timedelta(seconds=PATIENCE_S)},
                # explicit options override environment variables
                client_options={"connect_timeout": "5s", "timeout": "120s", "allow_http": http},
            )
        except Exception as error:  # the errors of the package have no other base class
            raise UsageError(f"{url}: cannot be opened ({_first_line(error)}).") from error

    def get(self, name: str) -> bytes | None:
        """Return an object, or None if it does not exist."""
        with self._told():
            try:
                return bytes(self._store.get(name).bytes())
            except FileNotFoundError:
                return None

    def put(self, name: str, file: Path) -> None:
        """Store a file as an object: all of it, or nothing."""
        with self._told():
            self._store.put(name, file)

    def list(self, prefix: str) -> list[Listed]:
        """Return all objects below a prefix."""
        with self._told():
            pages = self._store.list(prefix, chunk_size=1000)
            return [(meta["path"], meta["size"], meta["last_modified"]) for page in pages for meta in page]

    def delete(self, names: Iterable[str]) -> None:
        """Remove objects."""
        with self._told():
            self._store.delete(list(names))

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Convert the failure of a request to an error that states the remedy."""
        from obstore.exceptions import BaseError, PermissionDeniedError, UnauthenticatedError

        try:
            yield
        except (PermissionDeniedError, UnauthenticatedError) as error:
            # the same error as for a read-only folder
            raise PermissionError(errno.EACCES, _first_line(error), self.url) from error
        except (BaseError, FileNotFoundError) as error:
            raise StoreError(
                f"{self.url}: the store does not answer as it should ({_first_line(error)}). What was published is "
                "whole and stays. See that it runs, that the bucket is there and AWS_ENDPOINT_URL is right, and repeat "
                "the command: it does what is left."
            ) from error


def check_installed(package: str, purpose: str) -> None:
    """Raise a UsageError with the install command if a package of the extra ``cluster`` is missing."""
    if find_spec(package) is None:
        raise UsageError(
            f"{purpose} needs {package}, which a plain installation leaves out. Install it: "
            "pip install '.[cluster]' in the project's folder."
        )


def is_url(place: str | os.PathLike[str]) -> bool:
    """Return whether a place of stored tables is the URL of an object store, not a folder."""
    return "://" in os.fspath(place)


def _first_line(error: object) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:300]


@dataclass
class _Mirror:
    """The local folder of an object store, and the files in both; of one device or experiment if named."""

    objects: Objects
    folder: Path
    place: tuple[str, ...]
    known: dict[str, int] = field(default_factory=dict)
    """Modification time [ns] of each file that is also in the store; a file rewritten by a repair has another one."""

    def bring(self, trees: tuple[str, ...] = _TREES) -> bool:
        """Download files added to the store since; return whether there were any."""
        before = len(self.known)
        for _ in range(REPEATS):
            listed = [one for one in self.objects.list("") if _is_stored(one[0])]
            self._fetch([one for one in listed if one[0].startswith("corrections/")])
            own = self.place
            if any(one.changes_place for one in read_corrections(self.folder).values()):
                own = ()  # trials of any other device may have been moved to this one
            elif not any(_is_of(name.split("/"), own) for name, _, _ in listed if name.startswith("trials/")):
                own = ()  # if the device has no files, the error lists the existing ones
            if self._fetch([one for one in listed if one[0].startswith(trees) and _is_of(one[0].split("/"), own)]):
                return len(self.known) > before
        raise StoreError(f"{self.objects.url}: changed during each of {REPEATS} attempts to read it. Wait for others.")

    def _fetch(self, listed: list[Listed]) -> bool:
        """Download the new ones of some files; return whether all are here and none was replaced in the meantime."""

        def fetch(one: Listed) -> bool:
            name, _, put = one
            if (found := self.objects.get(name)) is None:
                return False
            file = self.folder / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(found)
            os.utime(file, (put.timestamp(), put.timestamp()))
            self.known[name] = file.stat().st_mtime_ns
            return True

        return all(map_in_threads(fetch, [one for one in listed if one[0] not in self.known], _AT_ONCE))

    def publish(self) -> None:
        """Upload new files, then delete removed ones."""
        present = {
            file.relative_to(self.folder).as_posix(): file.stat().st_mtime_ns
            for tree in _TREES
            for file in sorted((self.folder / tree).rglob("*"))
            if file.is_file() and not file.name.startswith(".")
        }
        new = [name for name, mtime_ns in present.items() if self.known.get(name) != mtime_ns]
        map_in_threads(lambda name: self.objects.put(name, self.folder / name), new, _AT_ONCE)
        self.objects.delete(self.known.keys() - present.keys())
        self.known = present


def _is_stored(name: str) -> bool:
    """Return whether an external name follows the naming scheme of the store and stays inside the folder."""
    tree, *parts = name.split("/")
    return tree in _TREES and "\\" not in name and not any(part in ("", ".", "..") for part in parts)


def _is_of(parts: list[str], place: tuple[str, ...]) -> bool:
    """Return whether a file concerns a device, or an experiment of it; without one, every file does."""
    if not place or parts[0] in ("theory", "corrections"):
        return True
    return parts[0] != "quarantine" and tuple(map(name_of_folder, parts[1 : 1 + len(place)])) == place


_mirrors: dict[Path, _Mirror] = {}
"""Mirrors of this process, by folder."""


@contextmanager
def opened(place: str | Path, *only: str) -> Iterator[Path]:
    """Yield the folder of a store: itself, or a mirror of an object store, published if the block succeeds.

    Parameters
    ----------
    place : str or Path
        Folder, or URL of an object store.
    *only : str
        A device, or a device and one of its experiments, if no other trials are needed.

    Raises
    ------
    UsageError, StoreError
        If the store cannot be opened or read, or does not accept the changes.
    """
    if not is_url(place):
        yield Path(place)
        return
    objects = Objects(os.fspath(place))
    with tempfile.TemporaryDirectory(prefix="pipeline-") as folder:
        mirror = _mirrors[Path(folder)] = _Mirror(objects, Path(folder), only)
        try:
            mirror.bring()
            yield mirror.folder
            with if_writable():
                mirror.publish()
        except PipelineError as error:
            error.args = tuple(str(part).replace(folder, objects.url) for part in error.args)
            raise
        finally:
            del _mirrors[mirror.folder]


def stored_by(place: str | Path, work: Callable[[Path], Result]) -> Result:
    """Return the result of a function that writes to a store; raise an error if the store is read-only."""
    with opened(place) as folder:
        result = work(folder)
        publish(folder)
        return result


def publish(processed: Path) -> None:
    """Make files stored in a mirror visible to others; in a folder they are visible immediately."""
    if processed in _mirrors:
        _mirrors[processed].publish()


def renewed(processed: Path, tree: str) -> bool:
    """Download files of one kind that others have stored since into a mirror; return whether there were any."""
    return processed in _mirrors and _mirrors[processed].bring((tree,))


def origin(processed: Path) -> str:
    """Return the folder of a store as text, or the URL that it mirrors."""
    return _mirrors[processed].objects.url if processed in _mirrors else os.fspath(processed)
