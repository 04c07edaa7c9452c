"""Asks for reports anew when logs have come, once nothing else waits, and removes what is old."""

from __future__ import annotations

import logging
import threading
import time

from pipeline.base.errors import PipelineError
from pipeline.service.database import KEPT_S, Database
from pipeline.service.settings import Settings
from pipeline.service.shared import Service

LOOK_S, TIDY_S = 1.0, 3600.0
"""Time between two looks at the jobs, and between two removals [s]."""


class Renewal:
    """A thread of the server, from `start` to `stop`."""

    def __init__(self, service: Service) -> None:
        self.service = service
        self._ended = threading.Event()

    def start(self) -> None:
        """Begin to look."""
        threading.Thread(target=self._watch, daemon=True).start()

    def stop(self) -> None:
        """Look no more."""
        self._ended.set()

    def _watch(self) -> None:
        database, settings = self.service.database, self.service.settings
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
                    self.service.renew()
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
