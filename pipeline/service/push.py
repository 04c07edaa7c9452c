"""Upload logs to a server in batches. The module uses only the standard library."""

from __future__ import annotations

import json
import os
import secrets
import time
from collections.abc import Callable, Iterator
from glob import escape
from http.client import HTTPException
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.parse import quote, urlsplit
from urllib.request import Request, urlopen

from pipeline.base.errors import UsageError
from pipeline.base.json_object import JsonObject
from pipeline.base.paths import path_text
from pipeline.intake.sources import Notices, find_sources, requested_profiles
from pipeline.profiles.profile_model import Profile
from pipeline.profiles.profile_text import profile_toml

AT_A_TIME, BYTES = 200, 64 << 20
"""Largest number of logs and of bytes in a request. After an interruption, at most one request must be repeated."""

POLL_S = 0.2

Advance = Callable[[int, int | None], None]


def push(folder: Path, to: str, profile: str | Profile | None, token: str | None, advance: Advance) -> JsonObject:
    """Upload logs, wait until they are stored, and return the document that ``ingest --json`` would print for all of
    them.

    Raises
    ------
    UsageError
        If there are no logs, or if the server cannot be reached or refuses the logs. Logs that the server accepted
        before remain stored.
    """
    files = [folder] if folder.is_file() else sorted(_logs(folder))
    if not files:
        raise UsageError(f"{folder}: no files. Give a folder with logs.")
    server = _Server(to, token)
    if isinstance(profile, Profile) or (profile is not None and profile.endswith(".toml")):
        asked = requested_profiles(profile, [folder])
        (ready,) = asked.profiles
        # a server reads no sheet, so the rows are sent as entries of the profile
        made = isinstance(profile, Profile) or bool(asked.ignore)
        text = profile_toml(ready) if made else Path(str(profile)).read_text("utf-8")
        profile = server.keep(ready.name, text)
        files = [file for file in files if escape(os.path.abspath(file)) not in asked.ignore]
    notices = Notices()
    find_sources([folder], (), None, notices)
    total: JsonObject = {"found": 0, "ingested": 0, "skipped": 0, "quarantined": [], "warnings": [], "changed": []}
    total |= {"damaged": [], "ignored": []}
    jobs = []
    sent = 0
    for group in _groups(files):
        jobs.append(server.upload(group, folder, profile)["job"])
        sent += len(group)
        advance(sent, len(files))
    for job in jobs:
        result = server.wait(job)
        for name, value in total.items():
            total[name] = value + result.get(name, type(value)())
    total["warnings"] += [{"path": path_text(path), "warning": text} for path, text in notices.folders]
    total["warnings"].sort(key=lambda warning: warning["path"])
    return total


def _logs(folder: Path) -> Iterator[Path]:
    for here, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        yield from (Path(here, name) for name in names if not name.startswith(".") and name != "truth.json")


def _groups(files: list[Path]) -> Iterator[list[Path]]:
    """Yield files in groups. Files in one folder stay together because a log may consist of two files."""
    group: list[Path] = []
    size = 0
    for file in files:
        length = file.stat().st_size
        if group and (len(group) >= AT_A_TIME or size + length > BYTES) and file.stem != group[-1].stem:
            yield group
            group, size = [], 0
        group.append(file)
        size += length
    yield group


class _Server:
    def __init__(self, address: str, token: str | None) -> None:
        self.address = address.rstrip("/")
        if urlsplit(address).scheme not in ("http", "https") or not urlsplit(address).hostname:
            raise UsageError(f"--to {address}: expected an address such as http://127.0.0.1:8000.")
        self.headers = {"Authorization": f"Bearer {token}"} if token else {}

    def upload(self, files: list[Path], folder: Path, profile: str | None) -> Any:
        boundary = secrets.token_hex(16)
        root = folder if folder.is_dir() else folder.parent
        pieces = []
        if profile is not None:
            head = f'--{boundary}\r\nContent-Disposition: form-data; name="profile"\r\n\r\n'
            pieces.append(f"{head}{profile}\r\n".encode())
        for file in files:
            name = file.relative_to(root).as_posix().replace("\\", "\\\\").replace('"', '\\"').replace("\n", "%0A")
            head = f'--{boundary}\r\nContent-Disposition: form-data; name="files"; filename="{name}"\r\n\r\n'
            pieces += [head.encode(), file.read_bytes(), b"\r\n"]
        body = b"".join([*pieces, f"--{boundary}--\r\n".encode()])
        return self._ask("POST", "/api/v1/logs", body, {"Content-Type": f"multipart/form-data; boundary={boundary}"})

    def keep(self, name: str, text: str) -> str:
        """Send a profile to the server, which stores it, and return its name."""
        body = json.dumps({"profile": text}).encode()
        self._ask("PUT", f"/api/v1/profiles/{quote(name)}", body, {"Content-Type": "application/json"})
        return name

    def wait(self, job: str) -> JsonObject:
        while True:
            found = self._ask("GET", f"/api/v1/jobs/{quote(job)}")
            if found["state"] == "done":
                return dict(found["result"])
            if found["state"] in ("failed", "cancelled"):
                why = found["problem"]["detail"] if found["problem"] else "it was cancelled"
                raise UsageError(f"{self.address}: the logs were received but not stored: {why}")
            time.sleep(POLL_S)

    def _ask(self, method: str, path: str, body: bytes | None = None, headers: dict[str, str] | None = None) -> Any:
        request = Request(self.address + path, body, {**self.headers, **(headers or {})}, method=method)
        try:
            with urlopen(request, timeout=120.0) as response:
                status, text = response.status, response.read()
        except HTTPError as error:
            status, text = error.code, error.read()
        except (OSError, HTTPException) as error:
            raise UsageError(
                f"{self.address}: cannot be reached ({error}). The logs that the server acknowledged are stored there. "
                "The same command sends the rest."
            ) from error
        try:
            document = json.loads(text)
        except ValueError:
            raise UsageError(f"{self.address}: this is not a pipeline server (status {status}).") from None
        if status >= 400:
            raise UsageError(f"{self.address}: {document.get('detail', text[:200])} (status {status})")
        return document
