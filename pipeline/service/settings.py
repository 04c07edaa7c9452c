"""Settings of a server: its data, address and limits."""

from __future__ import annotations

import ipaddress
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.base.errors import UsageError

RATE = 3000
"""Largest number of requests per minute. It corresponds to 50 requests per second, which is more than a page or a
program of a lab sends."""


MOST_CONNECTIONS = 512
"""Largest number of connections from one address, which may be a proxy for all users."""


def half_of_files() -> int:
    """Return the number of permitted connections: half of the limit of open files, and at most `MOST_CONNECTIONS`."""
    try:
        import resource
    except ImportError:  # Windows has no such limit
        return MOST_CONNECTIONS
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    return MOST_CONNECTIONS if most < 0 else min(MOST_CONNECTIONS, most // 2)


LIMITS = {"PIPELINE_MAX_FILE": ("max_file", 1 << 20, 1), "PIPELINE_MAX_REQUEST": ("max_request", 1 << 20, 1),
          "PIPELINE_RATE": ("rate", 1, 0), "PIPELINE_RENEW": ("renew", 1, 0)}  # fmt: skip
"""Environment variables that set limits, each with the name of the setting, the unit and the smallest value."""


def limits(environment: Mapping[str, str]) -> dict[str, Any]:
    """Return the settings that environment variables define.

    Raises
    ------
    UsageError
        If a value is not an integer or is too small.
    """
    found = {}
    for name, (setting, unit, least) in LIMITS.items():
        if text := environment.get(name):
            if not text.isdecimal() or int(text) < least:
                raise UsageError(f"{name}={text}: expected a whole number of {least} or more.")
            found[setting] = int(text) * unit
    return found


@dataclass(frozen=True)
class Settings:
    """Folders and limits of a server.

    Parameters
    ----------
    processed, reports : Path
        Folders as on the command line.
    host, port
        Address on which the server listens.
    read_only : bool
        True if every change is refused.
    max_file, max_request : int
        Largest size of a log, and of a whole request with logs [byte].
    max_files : int
        Largest number of logs in a request.
    rate : int, optional
        Largest number of requests per minute by a token or from an address, or 0 for no limit. By default, there is no
        limit on loopback, and `RATE` elsewhere.
    renew : bool
        True if reports made by this server are renewed when logs arrive.
    connections : int
        Largest number of connections that one address may keep open.
    header_s, body_s, theory_s, wait_s : float
        Time limits [s] for the header of a request, for its body, for a computation of theory, and for the time that a
        request waits for a job. For a body with logs, ``body_s`` is the longest time between two pieces.
    """

    processed: Path
    reports: Path
    host: str = "127.0.0.1"
    port: int = 8000
    read_only: bool = False
    max_file: int = 64 << 20
    max_request: int = 1 << 30
    max_files: int = 10_000
    rate: int | None = None
    renew: bool = True
    connections: int = field(default_factory=half_of_files)
    header_s: float = 10.0
    body_s: float = 30.0
    theory_s: float = 20.0
    wait_s: float = 20.0

    @property
    def data(self) -> Path:
        """Folder with uploaded logs and the database. This folder is next to `processed`, not inside it, because an
        ingest does not search `processed`.
        """
        whole = self.processed.absolute()
        return whole.with_name(f"{whole.name}-service")

    @property
    def per_minute(self) -> int:
        """Largest number of requests that one sender may make per minute, or 0 for no limit."""
        return self.rate if self.rate is not None else 0 if self.loopback else RATE

    @property
    def comparisons(self) -> Path:
        """Folder of the reports requested from this server. The name of a report is its key."""
        return self.reports / "comparisons"

    @property
    def loopback(self) -> bool:
        """True if only programs on this computer can reach the server."""
        if self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False
