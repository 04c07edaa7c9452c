"""Threads of a server that see to jobs: one keeps the processes that work at them, one asks for reports anew.

Reports follow the logs once nothing else waits; what is old is removed.
"""

from __future__ import annotations

import logging
import subprocess
import sys
import threading
import time
from collections.abc import Callable

from pipeline.base.errors import PipelineError
from pipeline.service.database import KEPT_S, WORKS, Database
from pipeline.service.settings import Settings

LOOK_S, TIDY_S = 1.0, 3600.0
"""Time between two looks at the jobs, and between two removals [s]."""


class Workers:
    """The workers of a server; they end with it, in whatever way that ends."""

    def __init__(self, settings: Settings, database: Database) -> None:
        self.settings, self.database = settings, database
        self._running: list[subprocess.Popen[bytes]] = []
        self._ended = threading.Event()

    def start(self) -> None:
        """Begin all."""
        for kinds in WORKS:
            threading.Thread(target=self._keep, args=(kinds,), daemon=True).start()

    def stop(self) -> None:
        """End all; what they work at is another's when its lease has run out."""
        self._ended.set()
        for process in list(self._running):
            process.kill()

    def wake(self) -> None:
        """Say that a job waits."""
        for process in list(self._running):
            try:
                assert process.stdin is not None
                process.stdin.write(b"\n")
            except OSError:  # it has just ended, and its follower looks by itself
                pass

    def _keep(self, kinds: str) -> None:
        given = [str(self.settings.processed), str(self.settings.reports), kinds]
        command = [sys.executable, "-m", "pipeline.service.jobs.worker", *given]
        while not self._ended.is_set():
            # a session of its own: Ctrl-C ends the server, and the server its workers
            with subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0, start_new_session=True
            ) as process:
                self._running.append(process)
                assert process.stdout is not None
                owner = process.stdout.readline().decode().strip()
                if self._ended.is_set():
                    process.kill()
                process.wait()
                self._running.remove(process)
            self.database.free(owner, blamed=not self._ended.is_set())
            self._ended.wait(0.2)
        self.database.close()


class Renewal:
    """A thread of the server, from `start` to `stop`."""

    def __init__(self, settings: Settings, database: Database, renew: Callable[[], None]) -> None:
        self.settings, self.database, self.renew = settings, database, renew
        self._ended = threading.Event()

    def start(self) -> None:
        """Begin to look."""
        threading.Thread(target=self._watch, daemon=True).start()

    def stop(self) -> None:
        """Look no more."""
        self._ended.set()

    def _watch(self) -> None:
        database, settings = self.database, self.settings
        done, tidied = _stages(database), 0.0
        while not self._ended.wait(LOOK_S):
            try:
                if time.monotonic() - tidied > TIDY_S or not tidied:
                    tidied = time.monotonic()
                    remove_old(settings, database.forget_old())
                counts, now = database.job_counts(), _stages(database)
                if now == done or counts.get("queued") or counts.get("running"):
                    continue
                done = now
                if settings.renew:
                    self.renew()
            except (PipelineError, OSError):
                logging.getLogger("pipeline.service").exception("reports could not be renewed")
        database.close()


def _stages(database: Database) -> int:
    """Return how often verdicts and costs of all that is stored were computed."""
    return database.job_counts("kind = 'stages'").get("done", 0)


def remove_old(settings: Settings, keys: set[str]) -> None:
    """Remove old documents and reports that no job names any more; they can be made again."""
    for folder in (settings.comparisons, settings.data / "documents"):
        for file in folder.glob("*"):
            if file.is_file() and file.stem not in keys and time.time() - file.stat().st_mtime > KEPT_S:
                file.unlink(missing_ok=True)
