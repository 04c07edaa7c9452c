"""Receive logs by HTTP.

Logs are written while they arrive, then hashed and synced. Only then are they acknowledged.

Each request has a separate folder, so that files that belong together stay together. The job of the request is the
acknowledgement. A folder without a job was never acknowledged, and is removed when a server starts.
"""

from __future__ import annotations

import hashlib
import os
import secrets
import shutil
from collections.abc import AsyncGenerator, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from starlette.concurrency import run_in_threadpool
from starlette.datastructures import FormData, UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser
from starlette.requests import Request

from pipeline.base.disk import make_folder, map_in_threads, sync_file, sync_folder
from pipeline.base.paths import path_of_text, path_text
from pipeline.intake.quarantine import list_quarantine
from pipeline.intake.sources import Source, content_hash, find_sources
from pipeline.intake.stored_sources import StoredSource, StoredSources, trial_id
from pipeline.profiles.profile_files import load_profile, shipped_profiles
from pipeline.records.findings import Record
from pipeline.service.database import Database
from pipeline.service.problems import Problem
from pipeline.service.profiles import profile_path
from pipeline.service.settings import Settings
from pipeline.store.names import folder_name

LONGEST_NAME = 200
"""Largest number of bytes in a component of a stored path."""

DEEPEST = 8
"""Largest number of folders in a file name. A browser sends the names of the folders when a folder is uploaded."""

LONGEST_FIELD = 1000
"""Largest number of bytes of a field that is not a file."""

MOST_FIELDS = 20

END_BYTES = 256
"""Number of bytes at the end of a body that are searched for its last boundary, which has at most 70 bytes."""

Check = Callable[[dict[str, str]], object]

_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)


class UploadedFile(Record):
    """Outcome for a file of an upload."""

    name: str
    size: int
    sha256: str
    state: Literal["queued", "skipped"]


class Accepted(Record):
    """An upload that is stored, and the job that ingests it."""

    job: str
    files: list[UploadedFile]


@dataclass(frozen=True)
class _Part:
    """Stored file of a form."""

    name: str
    path: Path
    size: int
    sha256: str


@dataclass(frozen=True)
class _Earlier:
    """Part of an upload that the service already has.

    Parameters
    ----------
    files : set of Path
        Files of the request that are already stored and are not stored again.
    again : dict of str to set of Path
        Files of the request that make up each log that is read again, keyed by the stored path of the log.
    versions : dict of str to str
        Hash of the profile that read each of these logs before, except for refused logs.
    """

    files: set[Path]
    again: dict[str, set[Path]]
    versions: dict[str, str]


class Upload:
    """One request with logs.

    Parameters
    ----------
    settings : Settings
    folder : Path, optional
        Folder for the files of the request. By default, a new folder is made among the uploads.
    """

    def __init__(self, settings: Settings, folder: Path | None = None) -> None:
        self.settings = settings
        self.name = secrets.token_hex(8)
        self.folder = folder or settings.data / "logs" / self.name
        self.fields: dict[str, str] = {}
        self.files: list[_Part] = []

    async def receive(self, request: Request) -> None:
        """Store the files of a request. If the request is refused, no file is kept."""
        kind = request.headers.get("content-type", "")
        if not kind.startswith("multipart/form-data") or "boundary=" not in kind:
            raise Problem(422, "Send logs as multipart/form-data, in the field `files`.", where="Content-Type")
        end = bytearray()

        async def stream() -> AsyncGenerator[bytes, None]:
            async for data in request.stream():
                end.extend(data)
                del end[:-END_BYTES]
                yield data

        most = self.settings.max_files
        parser = MultiPartParser(
            request.headers, stream(), max_files=most, max_fields=MOST_FIELDS, max_part_size=LONGEST_FIELD
        )
        try:
            form = await parser.parse()
            boundary = kind.partition("boundary=")[2].partition(";")[0].strip('" ')
            if f"--{boundary}--".encode() not in end:
                raise Problem(422, "The form ends before its last boundary.", where="body")
            await run_in_threadpool(self._store, form)
        except MultiPartException as error:
            if error.message.startswith("Too many files"):
                raise Problem(413, "There are too many files. Send them in parts.", expected=f"<= {most}") from error
            large = error.message.startswith(("Too many", "Part exceeded"))
            raise Problem(413 if large else 422, f"The form cannot be read: {error.message}", where="body") from error
        finally:
            for file in parser._files_to_close_on_error:  # all parts, including those of an incomplete form
                file.close()

    def _store(self, form: FormData) -> None:
        for name, value in form.multi_items():
            if not isinstance(value, UploadFile):
                self.fields[name] = value
            elif name != "files":
                raise Problem(422, "Send files in the field `files`.", where="form", found=name)
            elif value.filename:  # else a form without a file
                self.files.append(self._stored(value.filename, value))

    def _stored(self, name: str, file: UploadFile) -> _Part:
        if (file.size or 0) > self.settings.max_file:
            raise Problem(
                413, "A log is too large. No file of this request was stored.", where=name,
                expected=f"<= {self.settings.max_file}",
            )  # fmt: skip
        path = self.folder.joinpath(*_parts(name))
        make_folder(path.parent)
        try:
            with os.fdopen(os.open(path, _NEW, 0o600), "wb") as stream:
                shutil.copyfileobj(file.file, stream)
        except FileExistsError:
            raise Problem(422, "Two files have the same name. Send them in separate requests.", where=name) from None
        with path.open("rb") as stream:
            return _Part(name, path, path.stat().st_size, hashlib.file_digest(stream, "sha256").hexdigest())

    def accept(self, database: Database, author: str) -> Accepted:
        """Sync all new files and queue their job. Files that were uploaded before are skipped."""
        profile = self.fields.get("profile", "")
        own = profile_path(self.settings, profile)
        earlier = self._earlier(database, profile, own)
        queued = set[Path]().union(*earlier.again.values())
        listed, new = list[UploadedFile](), []
        for part in self.files:
            if part.path in earlier.files:
                part.path.unlink()
            else:
                new.append(part)
            state: Literal["queued", "skipped"] = "skipped" if part.path in earlier.files - queued else "queued"
            listed.append(UploadedFile(name=part.name, size=part.size, sha256=part.sha256, state=state))
        self._sync([part.path for part in new])
        with database.transaction():
            for path in earlier.again:  # from now on, a refused log belongs to this profile
                database.run("UPDATE uploads SET profile = ? WHERE path = ?", profile, path)
            for part in new:
                place = (self.name, str(part.path), part.name)
                database.run("INSERT INTO uploads VALUES (?, ?, ?, ?, ?)", part.sha256, profile, *place)
            skipped = sum(file.state == "skipped" for file in listed)
            request = {"folder": self.name, "profile": profile, "skipped": skipped, "again": sorted(earlier.again)}
            request |= {"versions": earlier.versions, "author": author}
            job = database.add_job("upload", request, job=self.name, author=author)
        return Accepted(job=job, files=listed)

    def _earlier(self, database: Database, profile: str, own: str | Path | None) -> _Earlier:
        """Return the files of this request that the service already has, and the logs that an ingest has to read again.

        The reading of a log depends on its name and on the neighbouring files. A log is therefore known if all of its
        files were uploaded together under the same names. A log with the same content that an earlier version of its
        profile read is known under any path.
        """
        earlier = _Earlier(set(), {}, {})
        parts = {part.path: part for part in self.files}
        refused = {record.path for record in list_quarantine(self.settings.processed, {})}
        refused_folders = {Path(path).parent for path in map(path_of_text, refused)}
        stored = StoredSources(self.settings.processed, "", {})
        trial_paths = stored.places(set())
        seen = set[tuple[tuple[str, str], ...]]()
        for source in find_sources([self.folder], shipped_profiles() if own is None else (load_profile(own),)):
            files = [file for file in source.files if file in parts]
            names = tuple((file.name, parts[file].sha256) for file in files)
            places = [self._places(database, sha256, profile, name, refused_folders) for name, sha256 in names]
            # a bag is a folder, and any other log is a file in this folder
            inside = () if source.path in {file.parent for file in files} else (source.path.name,)
            folders = sorted(set.intersection(*places)) if places else []
            former = [path_text(os.path.abspath(folder.joinpath(*inside))) for folder in folders]
            twin = _twin(source, [sha256 for _, sha256 in names], trial_paths)
            again = {path for path in former if path in refused or not _is_current(stored.get(path), source, twin)}
            if twin is not None and _is_outdated(stored.get(twin), source, twin):
                again.add(twin)
            if names in seen or former or again:
                earlier.files.update(files)
            if names not in seen:
                earlier.again.update({path: earlier.again.get(path, set()) | {*files} for path in again})
            seen.add(names)
        versions = {path: stored.get(path) for path in earlier.again}
        earlier.versions.update({path: one.profile_sha256 for path, one in versions.items() if one is not None})
        return earlier

    def _places(self, database: Database, sha256: str, profile: str, name: str, refused: set[Path]) -> set[Path]:
        """Return the folders that contain a file with this content and name, if the file was uploaded for the same
        profile or refused."""
        rows = database.run(
            "SELECT path, job, profile FROM uploads JOIN jobs ON jobs.id = uploads.job WHERE sha256 = ? "
            "AND state NOT IN ('cancelled', 'failed')",
            sha256,
        )
        same = {self._path(row["job"], row["path"]): row["profile"] == profile for row in rows}
        usable = [path for path, own in same.items() if own or path.absolute().parent in refused]
        return {path.parent for path in usable if path.name == name and path.is_file()}

    def _path(self, job: str, path: str) -> Path:
        """Return the path of an upload, even if folders have been moved since."""
        return self.settings.data / "logs" / job / path.rpartition(f"{os.sep}{job}{os.sep}")[2]

    def _sync(self, files: list[Path]) -> None:
        """Sync contents and names of files to disk."""
        folders = {parent for file in files for parent in file.parents if self.folder in (parent, *parent.parents)}
        map_in_threads(sync_file, files)
        map_in_threads(sync_folder, [*folders, self.folder.parent] if files else [])


def _twin(source: Source, hashes: list[str], trial_paths: Mapping[str, str]) -> str | None:
    """Return the path under which a log with this content is stored, or None if there is no such log."""
    if source.profile is None or not hashes:
        return None
    return trial_paths.get(trial_id(content_hash(hashes), None, source.named_conditions))


def _is_current(stored: StoredSource | None, source: Source, twin: str | None) -> bool:
    """Return True if a log is stored as its current profile reads it, under this path or, failing that, under another
    path."""
    if stored is None:
        return twin is not None
    return stored.whole and stored.profile_sha256 == source.profile_sha256


def _is_outdated(stored: StoredSource | None, source: Source, path: str) -> bool:
    """Return True if a different version of the same profile read a log whose files are unchanged since."""
    if stored is None or source.profile is None or stored.profile != source.profile.name:
        return False
    if stored.profile_sha256 == source.profile_sha256:
        return False
    now = find_sources([place], (source.profile,)) if (place := path_of_text(path)).exists() else []
    return [(one.size, one.mtime_ns) for one in now] == [(stored.size, stored.mtime_ns)]


@asynccontextmanager
async def received(
    settings: Settings, request: Request, check: Check, folder: Path | None = None
) -> AsyncGenerator[Upload, None]:
    """Store the files of a request, and remove them if the block fails. Before the block, ``check`` inspects the fields
    of the form.
    """
    upload = Upload(settings, folder)
    try:
        await upload.receive(request)
        check(upload.fields)
        if not upload.files:
            raise Problem(422, "The form contains no file.", where="files", expected="one or more")
        yield upload
    except BaseException:
        shutil.rmtree(upload.folder, ignore_errors=True)
        raise


def _parts(name: str) -> list[str]:
    """Split a name in a request into the names of folders and of a file. None of the names leads outside the upload
    folder.
    """
    parts = [folder_name(part) for part in name.replace("\\", "/").split("/") if part]
    if not parts or len(parts) > DEEPEST or any(len(part.encode()) > LONGEST_NAME for part in parts):
        raise Problem(
            422, "The name of a file is too long, or contains too many folders.", where=name[:LONGEST_NAME],
            expected=f"at most {DEEPEST} parts of {LONGEST_NAME} bytes",
        )  # fmt: skip
    return parts


def remove_unacknowledged(settings: Settings, database: Database) -> None:
    """Remove the folders of uploads that were interrupted before they had a job. A server calls this function at its
    start.
    """
    folder = settings.data / "logs"
    if folder.is_dir():
        jobs = {row["id"] for row in database.run("SELECT id FROM jobs WHERE kind = 'upload'")}
        for one in folder.iterdir():
            if one.name not in jobs:
                shutil.rmtree(one, ignore_errors=True)
