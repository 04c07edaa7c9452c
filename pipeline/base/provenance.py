"""Determine the provenance of stored numbers by hashes of inputs, parameters and code, and by the package version."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path

__version__ = "1.0.0rc1"
"""Version of the package."""

PACKAGE_FOLDER = Path(__file__).parents[1]


def schema_folder() -> Path:
    """Return the folder with device, profile and schema files. In a source checkout, this folder is next to the
    package."""
    installed = PACKAGE_FOLDER / "_schemas"
    return installed if installed.is_dir() else PACKAGE_FOLDER.parent / "schemas"


USER_FOLDER_VARIABLE = "PIPELINE_DEVICES"
"""Environment variable that names a folder with device files of the user."""


def user_device_folder() -> Path | None:
    """Return the folder with device files of the user, or None if the environment variable is not set."""
    own = os.environ.get(USER_FOLDER_VARIABLE)
    return Path(own) if own else None


def sha256(data: bytes) -> str:
    """Return the SHA-256 hash of bytes as 64 hexadecimal digits."""
    return hashlib.sha256(data).hexdigest()


def digest(value: object) -> str:
    """Return a 16-digit hash of a JSON value. Equal values have equal hashes on every machine."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return sha256(text.encode())[:16]


def digest_all(parts: Iterable[str]) -> str:
    """Return a 16-digit hash of a sequence of strings."""
    joined = hashlib.sha256()
    for part in parts:
        joined.update(part.encode())
        joined.update(b"\0")
    return joined.hexdigest()[:16]


CODE = {
    "stages": ("base", "device", "records", "store", "loop", "recording", "measured"),
    "theory": ("base", "device", "records", "loop", "theory"),
    "report": (".",),
}
"""Folders of the package whose code, including imports, produces each kind of stored result."""


@cache
def code_digest(result: str) -> str:
    """Return a hash of all files in the folders of `CODE` for a kind of stored result.

    A stored result is reused only while this hash is unchanged.
    """
    every = {file for folder in CODE[result] for file in (PACKAGE_FOLDER / folder).rglob("*")}
    files = {file for file in every if file.suffix != ".pyc" and file.is_file()}
    named = sorted((file.relative_to(PACKAGE_FOLDER).as_posix(), file) for file in files)
    return digest_all([text for name, file in named for text in (name, sha256(_source(file)))])


def _source(file: Path) -> bytes:
    return file.read_bytes()


def stamp(**entries: str) -> Mapping[str, str]:
    """Return the metadata of an output file: the given hashes and the package version."""
    return {"pipeline.version": __version__, **{f"pipeline.{key}": value for key, value in entries.items()}}
