"""Asks for reports anew when logs have come, once nothing else waits: the watch of the service."""

from __future__ import annotations

import logging
import threading

from pipeline.base.errors import PipelineError
from pipeline.service.shared import Service

LOOK_S = 1.0
"""Time between two looks at the jobs [s]."""


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
        database, done = self.service.database, self.service.database.stages_done()
        while not self._ended.wait(LOOK_S):
            counts, now = database.job_counts(), database.stages_done()
            if now == done or counts.get("queued") or counts.get("running"):
                continue
            done = now
            try:
                self.service.renew()
            except (PipelineError, OSError):
                logging.getLogger("pipeline.service").exception("reports could not be renewed")
        database.close()
