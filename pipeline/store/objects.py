"""An object store such as S3: the few requests that the stored tables need of it, each whole or not done at all.

The package is the extra ``cluster``; it is imported with the first store that is opened.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import datetime, timedelta
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pipeline.base.errors import StoreError, UsageError

SCHEME = "s3://"
"""What the URL of a store begins with."""

RETRIES = 10
"""Attempts after one that failed by the network or a busy server, with growing pauses of 0.1 to 5 s: some 15 s."""

PATIENCE_S = 30.0
"""How long one request is tried [s]: a server that restarts is back by then, one that is gone is told soon."""


class Objects:
    """The objects below a URL.

    Parameters
    ----------
    url : str
        ``s3://bucket/prefix``; credentials and endpoint are those of the usual variables (``AWS_ACCESS_KEY_ID``,
        ``AWS_ENDPOINT_URL``, ``AWS_ALLOW_HTTP`` ...).

    Raises
    ------
    UsageError
        If the URL is none of a store, or the package for it is not installed.
    """

    def __init__(self, url: str) -> None:
        self.url = url.rstrip("/")
        if not self.url.startswith(SCHEME) or len(self.url) == len(SCHEME):
            raise UsageError(f"{url}: is no URL of a store; expected a folder, or {SCHEME}BUCKET/PREFIX.")
        check_installed("obstore", f"a store at {self.url}")
        from obstore.store import S3Store

        try:
            self._store = S3Store.from_url(
                self.url,
                retry_config={
                    "max_retries": RETRIES,
                    "retry_timeout": timedelta(seconds=PATIENCE_S),
                    "backoff": {
                        "init_backoff": timedelta(milliseconds=100),
                        "max_backoff": timedelta(seconds=5),
                        "base": 4,  # each pause is drawn at random below this multiple of the one before
                    },
                },
                # options that are given take the place of those in variables
                client_options={"connect_timeout": "5s", "timeout": "120s", "allow_http": _allows_http()},
            )
        except Exception as error:  # the errors of the package have no base that is not this one
            raise UsageError(f"{url}: cannot be opened ({_first_line(error)}).") from error

    def get(self, name: str) -> bytes | None:
        """Return an object, None where there is none."""
        import obstore

        with self._told():
            try:
                return bytes(obstore.get(self._store, name).bytes())
            except FileNotFoundError:
                return None

    def put(self, name: str, file: Path) -> None:
        """Store a file as an object: all of it, or nothing."""
        import obstore

        with self._told():
            obstore.put(self._store, name, file)

    def list(self, prefix: str) -> list[tuple[str, int, datetime]]:
        """Return name, size [byte] and time of putting of all objects below a prefix."""
        import obstore

        found: list[tuple[str, int, datetime]] = []
        with self._told():
            for page in obstore.list(self._store, prefix, chunk_size=1000):
                found += [(meta["path"], meta["size"], meta["last_modified"]) for meta in page]
        return found

    def delete(self, names: Iterable[str]) -> None:
        """Remove objects."""
        import obstore

        gone = list(names)
        if gone:
            with self._told():
                obstore.delete(self._store, gone)

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Turn the failure of a request into an error that says what to do."""
        from obstore.exceptions import BaseError, PermissionDeniedError, UnauthenticatedError

        try:
            yield
        except (PermissionDeniedError, UnauthenticatedError) as error:
            # as a folder says it that may only be read
            raise PermissionError(errno.EACCES, _first_line(error), self.url) from error
        except (BaseError, FileNotFoundError) as error:
            raise StoreError(
                f"{self.url}: the store does not answer as it should ({_first_line(error)}). What was published is "
                "whole and stays. See that it runs, that the bucket is there and AWS_ENDPOINT_URL is right, and repeat "
                "the command: it does what is left."
            ) from error


def check_installed(package: str, purpose: str) -> None:
    """Raise a UsageError that says what to install, where a package of the extra ``cluster`` is missing."""
    if find_spec(package) is None:
        raise UsageError(
            f"{purpose} needs {package}, which a plain installation leaves out. Install it: "
            "pip install '.[cluster]' in the project's folder."
        )


def is_url(place: str | os.PathLike[str]) -> bool:
    """Return whether a place of stored tables is the URL of an object store and no folder."""
    return "://" in os.fspath(place)


def _allows_http() -> bool:
    return os.environ.get("AWS_ALLOW_HTTP", "").lower() in ("1", "true", "yes", "on")


def _first_line(error: object) -> str:
    lines: Any = str(error).strip().splitlines() or [type(error).__name__]
    return str(lines[0])[:300]
