"""Keeps processes that work at jobs: begins them with the server, and again when one ends."""

from __future__ import annotations

import subprocess
import sys
import threading

from pipeline.service.database import Database
from pipeline.service.settings import Settings


class Workers:
    """The workers of a server; they end with it, in whatever way that ends."""

    def __init__(self, settings: Settings, database: Database) -> None:
        self.settings, self.database = settings, database
        self._running: list[subprocess.Popen[bytes]] = []
        self._ended = threading.Event()

    def start(self) -> None:
        """Begin both: one for logs and their verdicts, one for what is looked at."""
        for kind in ("urgent", "other"):
            threading.Thread(target=self._keep, args=(kind,), daemon=True).start()

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

    def _keep(self, kind: str) -> None:
        given = [str(self.settings.processed), str(self.settings.reports), self.settings.executor, kind]
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
