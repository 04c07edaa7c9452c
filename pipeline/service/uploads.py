"""Logs that come by HTTP: written while they come, hashed, synced, and only then acknowledged.

Each request has a folder of its own, so that files that belong together stay together; its job is the acknowledgement.
A folder without a job was never acknowledged, and is removed when a server starts.
"""

from __future__ import annotations

import hashlib
import os
import secrets
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request

from pipeline.base.disk import make_folder, sync_folder
from pipeline.base.errors import ProfileError
from pipeline.base.file_names import path_text
from pipeline.intake.quarantine import list_quarantine
from pipeline.intake.sources import find_sources
from pipeline.profiles.profile_files import load_profile, shipped_profiles
from pipeline.service.database import Database
from pipeline.service.problems import Problem
from pipeline.service.settings import Settings
from pipeline.store.names import folder_name

LONGEST_NAME = 200
"""Bytes of a part of a path, as stored."""

DEEPEST = 8
"""Folders in the name of a file; a browser that is given a folder sends them."""

LONGEST_FIELD = 1000
"""Bytes of a field that is no file."""

PIECE = 1 << 20
"""Bytes that are written at a time."""


_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)


@dataclass
class _Part:
    """A part of a form: a field, or a file that is written while it comes."""

    header: dict[str, bytes] = field(default_factory=dict)
    value: bytearray = field(default_factory=bytearray)
    name: str = ""
    path: Path | None = None
    stream: BinaryIO | None = None
    size: int = 0
    sha256: Any = field(default_factory=hashlib.sha256)


class Upload:
    """One request with logs.

    Parameters
    ----------
    settings : Settings
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.name = secrets.token_hex(8)
        self.folder = settings.data / "logs" / self.name
        self.fields: dict[str, str] = {}
        self.files: list[_Part] = []
        self._part = _Part()
        self._header: tuple[bytearray, bytearray] = (bytearray(), bytearray())
        self.ended = False

    async def receive(self, request: Request) -> None:
        """Write what a request sends; nothing is kept where it cannot be accepted."""
        kind, options = parse_options_header(request.headers.get("content-type", ""))
        if kind != b"multipart/form-data" or not options.get(b"boundary"):
            raise Problem(422, "Send logs as multipart/form-data, in the field `files`.", where="Content-Type")
        try:
            parser = MultipartParser(options[b"boundary"], self._callbacks())
            pending = bytearray()
            async for data in request.stream():
                pending += data
                if len(pending) >= PIECE:
                    await run_in_threadpool(parser.write, bytes(pending))
                    pending.clear()
            await run_in_threadpool(parser.write, bytes(pending))
            parser.finalize()
        except FormParserError as error:
            raise Problem(422, f"The form cannot be read: {error}.", where="body") from error
        if not self.ended:
            raise Problem(422, "The form ends before its last boundary.", where="body")

    def discard(self) -> None:
        """Remove what was written."""
        if self._part.stream is not None:
            self._part.stream.close()
        shutil.rmtree(self.folder, ignore_errors=True)

    def accept(self, database: Database) -> dict[str, Any]:
        """Sync all that is new and queue its job; what was uploaded before is left out."""
        profile = _profile(self.fields.get("profile", ""))
        if not self.files:
            raise Problem(422, "There is no file in the form.", where="files", expected="one or more")
        known, again = self._known(database, profile)
        listed, new, refused = [], [], set[str]()
        for part in self.files:
            assert part.path is not None, "it was written"
            if part.path in known:
                part.path.unlink()
            else:
                new.append(part)
            refused |= {again[part.path]} if part.path in again else set()
            state = "skipped" if part.path in known - again.keys() else "queued"
            listed.append({"name": part.name, "size": part.size, "sha256": part.sha256.hexdigest(), "state": state})
        self._sync([part.path for part in new if part.path is not None])
        with database.transaction():
            for part in new:
                place = (self.name, str(part.path), part.name)
                database.run("INSERT INTO uploads VALUES (?, ?, ?, ?, ?)", part.sha256.hexdigest(), profile, *place)
            skipped = sum(file["state"] == "skipped" for file in listed)
            request = {"folder": self.name, "profile": profile, "skipped": skipped, "again": sorted(refused)}
            job = database.add_job("upload", request, job=self.name)
        return {"job": job, "files": listed}

    def _known(self, database: Database, profile: str) -> tuple[set[Path], dict[Path, str]]:
        """Return the files that lie here from before, and of those that were refused the path of the log they are.

        What is read of a log depends on the name and on the files beside it, too: known is a log all of whose files
        were uploaded together under these names.
        """
        known: set[Path] = set()
        again: dict[Path, str] = {}
        parts = {part.path: part for part in self.files if part.path is not None}
        refused = {record.path for record in list_quarantine(self.settings.processed, {})}
        seen = set[tuple[tuple[str, str], ...]]()
        for source in find_sources([self.folder], (load_profile(profile),) if profile else shipped_profiles()):
            files = [file for file in source.files if file in parts]
            names = tuple((file.name, parts[file].sha256.hexdigest()) for file in files)
            places = [self._places(database, sha256, profile, name) for name, sha256 in names]
            before = sorted(set.intersection(*places)) if places else []
            if names in seen or before:
                known.update(files)
            seen.add(names)
            for folder in before:
                if (log := path_text(os.path.abspath(folder / source.path.name))) in refused:
                    again |= dict.fromkeys(files, log)
        return known, again

    def _places(self, database: Database, sha256: str, profile: str, name: str) -> set[Path]:
        """Return the folders in which a content lies under a name, uploaded before for the same profile."""
        rows = database.run(
            "SELECT path, job FROM uploads JOIN jobs ON jobs.id = uploads.job WHERE sha256 = ? AND profile = ? "
            "AND state NOT IN ('cancelled', 'failed')",
            *(sha256, profile),
        )
        places = [self._path(row["job"], row["path"]) for row in rows]
        return {place.parent for place in places if place.name == name and place.is_file()}

    def _path(self, job: str, path: str) -> Path:
        """Return where an upload lies; its path is that of before, where a backup was restored elsewhere."""
        return self.settings.data / "logs" / job / path.rpartition(f"{os.sep}{job}{os.sep}")[2]

    def _sync(self, files: list[Path]) -> None:
        """Return when content and names of files are on the disk."""
        folders = {parent for file in files for parent in file.parents if self.folder in (parent, *parent.parents)}
        with ThreadPoolExecutor(16) as pool:
            list(pool.map(_sync_file, files))
            list(pool.map(sync_folder, [*folders, self.folder.parent] if files else []))

    def _callbacks(self) -> Any:
        return {
            "on_part_begin": self._begin,
            "on_header_field": lambda data, start, end: self._header[0].extend(data[start:end]),
            "on_header_value": lambda data, start, end: self._header[1].extend(data[start:end]),
            "on_header_end": self._header_end,
            "on_headers_finished": self._open,
            "on_part_data": self._data,
            "on_part_end": self._part_end,
            "on_end": self._end,
        }

    def _begin(self) -> None:
        self._part = _Part()

    def _header_end(self) -> None:
        name, value = self._header
        self._part.header[name.decode("latin-1").lower()] = bytes(value)
        self._header = (bytearray(), bytearray())

    def _open(self) -> None:
        _, options = parse_options_header(self._part.header.get("content-disposition", b""))
        self._part.name = options.get(b"name", b"").decode("utf-8", "replace")
        if b"filename" not in options:
            return
        name = options[b"filename"].decode("utf-8", "replace")
        if not name:  # a form without a file
            return
        if self._part.name != "files":
            raise Problem(422, "Files belong into the field `files`.", where="form", found=self._part.name)
        if len(self.files) >= self.settings.max_files:
            raise Problem(
                413, "There are too many files. Send them in parts.", expected=f"<= {self.settings.max_files}"
            )
        path = self.folder.joinpath(*_parts(name))
        if any(other.path == path for other in self.files):
            raise Problem(422, "Two files have one name. Send one of them by itself.", where=name)
        make_folder(path.parent)
        self._part.name, self._part.path = name, path
        # closed at the end of the part
        self._part.stream = os.fdopen(os.open(path, _NEW, 0o600), "wb")
        self.files.append(self._part)

    def _data(self, data: bytes, start: int, end: int) -> None:
        part = self._part
        part.size += end - start
        if part.stream is None:
            if part.size > LONGEST_FIELD:
                raise Problem(413, "A field of the form is too long.", expected=f"<= {LONGEST_FIELD}")
            part.value += data[start:end]
            return
        if part.size > self.settings.max_file:
            raise Problem(
                413, "A log is too large. Nothing was stored of this request.", where=part.name,
                expected=f"<= {self.settings.max_file}",
            )  # fmt: skip
        part.sha256.update(data[start:end])
        part.stream.write(data[start:end])

    def _part_end(self) -> None:
        if self._part.stream is not None:
            self._part.stream.close()
            return
        self.fields[self._part.name] = self._part.value.decode("utf-8", "replace")

    def _end(self) -> None:
        self.ended = True


def _parts(name: str) -> list[str]:
    """Return a name from a request as names of folders and a file; none of them leads anywhere else."""
    parts = [folder_name(part) for part in name.replace("\\", "/").split("/") if part]
    if not parts or len(parts) > DEEPEST or any(len(part.encode()) > LONGEST_NAME for part in parts):
        raise Problem(
            422, "The name of a file is too long, or too deep.", where=name[:LONGEST_NAME],
            expected=f"at most {DEEPEST} parts of {LONGEST_NAME} bytes",
        )  # fmt: skip
    return parts


def _profile(name: str) -> str:
    """Return the name of a shipped profile, or an empty one; a path is none."""
    if not name:
        return ""
    shipped = [profile.name for profile in shipped_profiles()]
    if name not in shipped:
        raise Problem(422, "There is no such profile.", where="profile", expected=shipped, found=name)
    try:
        return load_profile(name).name
    except ProfileError as error:
        raise Problem(422, str(error), where="profile") from error


def _sync_file(file: Path) -> None:
    descriptor = os.open(file, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def remove_unacknowledged(settings: Settings, database: Database) -> None:
    """Remove folders of uploads that were interrupted before they had a job; for a server that starts."""
    folder = settings.data / "logs"
    if folder.is_dir():
        jobs = {row["id"] for row in database.run("SELECT id FROM jobs WHERE kind = 'upload'")}
        for one in folder.iterdir():
            if one.name not in jobs:
                shutil.rmtree(one, ignore_errors=True)
