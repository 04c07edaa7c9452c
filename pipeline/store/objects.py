"""A store given by a URL, such as S3. Its files are copied to a temporary folder, and changes are copied back.

Files are named by the hash of their content, are complete and never change. Therefore, an object store works like a
folder. New files are uploaded, and then the files that they replace are deleted. Writers never wait for each other,
because two writers store different files or the same file. The temporary folder is removed at the end. A store that is
a folder is used directly, and the package for object stores (the extra ``cluster``) is not imported.
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
"""Scheme of the URL of a store."""

RETRIES = 10
"""Number of retries after a network failure or a response of a busy server. Pauses grow from 0.1 s."""

PATIENCE_S = 30.0
"""Time for which a request is retried [s]. This is long enough for a server to restart, and short enough to report a
server that is down.
"""

_TREES = ("trials", "stages", "theory", "corrections", "quarantine")
"""Folders that are stored. Locks and incomplete files stay local. Trials are uploaded before results based on them."""

REPEATS = 20
"""Maximum number of attempts to read a store. The store is listed again if its files were merged during the
download."""

_AT_ONCE = 8
"""Number of parallel requests. Requests mostly wait. A batch takes about 10 MiB of memory, and at most 256 MiB."""

Listed = tuple[str, int, datetime]
"""Name, size [byte] and upload time of an object."""


class Objects:
    """Objects below a URL, with the few atomic requests that a store needs.

    Parameters
    ----------
    url : str
        ``s3://bucket/prefix``. Credentials and endpoint are taken from the usual variables (``AWS_ACCESS_KEY_ID``,
        ``AWS_ENDPOINT_URL``, ``AWS_ALLOW_HTTP`` ...).

    Raises
    ------
    UsageError
        If the URL is not the URL of a store, or the required package is not installed.
    """

    def __init__(self, url: str) -> None:
        self.url = url.rstrip("/")
        if not self.url.startswith(SCHEME) or len(self.url) == len(SCHEME):
            raise UsageError(f"{url}: not the URL of a store. Name a folder, or {SCHEME}BUCKET/PREFIX.")
        check_installed("obstore", f"a store at {self.url}")
        from obstore.store import S3Store

        http = os.environ.get("AWS_ALLOW_HTTP", "").lower() in ("1", "true", "yes", "on")
        try:
            self._store = S3Store.from_url(
                self.url,
                retry_config={"max_retries": RETRIES, "retry_timeout": timedelta(seconds=PATIENCE_S)},
                # Explicit options override environment variables.
                client_options={"connect_timeout": "5s", "timeout": "120s", "allow_http": http},
            )
        except Exception as error:  # the errors of the package have no common base class
            raise UsageError(f"{url}: cannot be opened ({_first_line(error)}).") from error

    def get(self, name: str) -> bytes | None:
        """Return the content of an object, or None if it does not exist."""
        with self._reported():
            try:
                return bytes(self._store.get(name).bytes())
            except FileNotFoundError:
                return None

    def put(self, name: str, file: Path) -> None:
        """Store a file as an object. The request is atomic."""
        with self._reported():
            self._store.put(name, file)

    def list(self, prefix: str) -> list[Listed]:
        """Return the name, size and time of all objects below a prefix."""
        with self._reported():
            pages = self._store.list(prefix, chunk_size=1000)
            return [(meta["path"], meta["size"], meta["last_modified"]) for page in pages for meta in page]

    def delete(self, names: Iterable[str]) -> None:
        """Remove objects."""
        with self._reported():
            self._store.delete(list(names))

    @contextmanager
    def _reported(self) -> Iterator[None]:
        """Convert a failed request to an error that states the remedy."""
        from obstore.exceptions import BaseError, PermissionDeniedError, UnauthenticatedError

        try:
            yield
        except (PermissionDeniedError, UnauthenticatedError) as error:
            # A read-only folder raises the same error.
            raise PermissionError(errno.EACCES, _first_line(error), self.url) from error
        except (BaseError, FileNotFoundError) as error:
            raise StoreError(
                f"{self.url}: a request failed ({_first_line(error)}). Files published so far are complete and stay "
                "stored. Check that the server runs, that the bucket exists and that AWS_ENDPOINT_URL is right. Then "
                "repeat the command, which does the remaining work."
            ) from error


def check_installed(package: str, purpose: str) -> None:
    """Raise a UsageError with the install command if a package of the extra ``cluster`` is missing."""
    if find_spec(package) is None:
        raise UsageError(
            f"{purpose} needs {package}, which a plain installation does not include. Install it with "
            "pip install '.[cluster]' in the project's folder."
        )


def is_url(place: str | os.PathLike[str]) -> bool:
    """Return True if the given place of a store is the URL of an object store, and not a folder."""
    return "://" in os.fspath(place)


def _first_line(error: object) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:300]


@dataclass
class _Mirror:
    """Local folder of an object store, and the files that are in both. ``place`` restricts it to a device or
    experiment."""

    objects: Objects
    folder: Path
    place: tuple[str, ...]
    known: dict[str, int] = field(default_factory=dict)
    """Modification time [ns] of each file that is also in the store. A repair that rewrites a file changes its time."""

    def bring(self, trees: tuple[str, ...] = _TREES) -> bool:
        """Download files that were added to the store since the last call. Return True if there were any."""
        before = len(self.known)
        for _ in range(REPEATS):
            listed = [one for one in self.objects.list("") if _is_stored(one[0])]
            self._fetch([one for one in listed if one[0].startswith("corrections/")])
            own = self.place
            if any(one.changes_place for one in read_corrections(self.folder).values()):
                own = ()  # trials of any device may have been moved to this device
            elif not any(_is_of(name.split("/"), own) for name, _, _ in listed if name.startswith("trials/")):
                own = ()  # without files, the error message lists the existing devices
            if self._fetch([one for one in listed if one[0].startswith(trees) and _is_of(one[0].split("/"), own)]):
                return len(self.known) > before
        raise StoreError(f"{self.objects.url}: changed during each of {REPEATS} attempts to read it. Try again later.")

    def _fetch(self, listed: list[Listed]) -> bool:
        """Download the missing files of a listing. Return False if a file is missing because it was replaced."""

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
    """Return True if an external name follows the naming scheme of the store and stays inside its folder."""
    tree, *parts = name.split("/")
    return tree in _TREES and "\\" not in name and not any(part in ("", ".", "..") for part in parts)


def _is_of(parts: list[str], place: tuple[str, ...]) -> bool:
    """Return True if a file belongs to a device or experiment. Without a place, this is true for all files."""
    if not place or parts[0] in ("theory", "corrections"):
        return True
    return parts[0] != "quarantine" and tuple(map(name_of_folder, parts[1 : 1 + len(place)])) == place


_mirrors: dict[Path, _Mirror] = {}
"""Mirrors of this process, keyed by their folders."""


@contextmanager
def opened(place: str | Path, *only: str) -> Iterator[Path]:
    """Yield the folder of a store. For an object store, the folder is a mirror, which is published if the block
    succeeds.

    Parameters
    ----------
    place : str or Path
        Folder, or URL of an object store.
    *only : str
        A device, or a device and one of its experiments. The trials of other devices or experiments are then not
        downloaded.

    Raises
    ------
    UsageError, StoreError
        If the store cannot be opened or read, or rejects the changes.
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
    """Call a function that writes to a store, and return its result. An error is raised if the store is read-only."""
    with opened(place) as folder:
        result = work(folder)
        publish(folder)
        return result


def publish(processed: Path) -> None:
    """Upload files stored in a mirror, so that others can read them. Files in a folder are visible immediately."""
    if processed in _mirrors:
        _mirrors[processed].publish()


def renewed(processed: Path, tree: str) -> bool:
    """Download files of one kind that other processes have stored since the last call. Return True if there were
    any."""
    return processed in _mirrors and _mirrors[processed].bring((tree,))


def origin(processed: Path) -> str:
    """Return the folder of a store as text, or the URL of the object store for a mirror."""
    return _mirrors[processed].objects.url if processed in _mirrors else os.fspath(processed)
