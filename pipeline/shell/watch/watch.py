"""Keeps reports current while logs arrive: looks at the folders, and has a pass done when logs came to rest.

The process that looks is small and opens no log. A pass runs in a process of its own (`watch_pass`), which takes its
memory with it when it ends. Nothing is kept but what lies in `processed/`: after an end of any kind the next start
does what is left.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from pipeline.base.provenance import PACKAGE_FOLDER, user_device_folder
from pipeline.shell.watch.watch_files import Arrivals, Look, look_at, wait_after

RETRY_S, LONGEST_RETRY_S = 60.0, 3600.0
"""Time after which a pass is tried again that failed for a reason that may pass without a change of the logs [s], such
as a full disk. It doubles each time up to the second number, so that a lasting fault costs next to nothing."""

_PASS = "import sys; sys.path.append(sys.argv[1]); from pipeline.shell.watch.watch_pass import main; main()"
"""Program of a pass. Not ``-m``: processes that the pass starts for theory would import that module, too."""

Event = dict[str, Any]
"""Something that happened: its kind under ``event``, the rest by kind."""


@dataclass(frozen=True)
class Watched:
    """What is watched, and where results go.

    Parameters
    ----------
    folders : tuple of Path
        Searched for logs, with all folders below.
    processed, reports : Path
    profile : str or None
        Log profile by name, or a profile file.
    scenes : tuple of Path
        Scene files, one report each; without any, one report for each device.
    settle_s : float
        A log is read when it was the same for this time [s].
    """

    folders: tuple[Path, ...]
    processed: Path
    reports: Path
    profile: str | None = None
    scenes: tuple[Path, ...] = ()
    settle_s: float = 2.0

    def request(self) -> dict[str, Any]:
        """Return what `watch_pass.PassRequest` is made of."""
        return {
            "folders": [str(folder) for folder in self.folders],
            "processed": str(self.processed),
            "reports": str(self.reports),
            "profile": self.profile,
            "scenes": [str(scene) for scene in self.scenes],
            "settle_s": self.settle_s,
        }

    @property
    def files(self) -> tuple[Path, ...]:
        """Single files a change of which changes reports."""
        devices = user_device_folder()
        return (
            *self.scenes,
            *([Path(self.profile)] if self.profile and os.path.isfile(self.profile) else []),
            *(sorted(devices.glob("*.toml")) if devices else []),
        )


class Watch:
    """A watch that runs until it is asked to stop.

    Parameters
    ----------
    watched : Watched
    interval_s : float
        Time between two looks [s] while logs arrive; it grows fivefold when none do (`watch_files.wait_after`).
    emit : callable
        Gets each event when it happens.
    """

    def __init__(self, watched: Watched, interval_s: float, emit: Callable[[Event], None]) -> None:
        self.watched, self.interval_s, self.emit = watched, interval_s, emit
        self._arrivals = Arrivals(watched.settle_s)
        self._asked = False
        # not an Event, whose lock a signal may find held by the thread that it interrupts
        self._wake: SimpleQueue[None] = SimpleQueue()
        self._child: subprocess.Popen[str] | None = None
        self._failed: dict[str, str] = {}
        self._told: dict[str, str] = {}
        self._troubles: dict[str, str] = {}
        self._retry_s = RETRY_S

    def stop(self) -> bool:
        """Ask for the end, with that of a running pass; asked again, kill the pass. A signal may call it.

        Returns
        -------
        bool
            Whether a pass is running, for the end of which the watch has to wait.
        """
        again, self._asked = self._asked, True
        self._wake.put(None)
        child = self._child
        if child is not None:
            (child.kill if again else child.terminate)()
        return child is not None

    def run(self) -> None:
        """Watch until `stop` is called."""
        watched = self.watched
        self.emit({"event": "started", **watched.request(), "interval_s": self.interval_s})
        news_at = time.monotonic()
        again_at: float | None = None
        first = True
        while not self._asked:
            began = time.monotonic()
            look = look_at(watched.folders, watched.files, (watched.processed,))
            now = time.monotonic()
            self._tell_troubles(look)
            if first:  # reports may be out of date from before, whether logs come or not
                first, again_at = False, now + watched.settle_s
            if self._arrivals.update(look.states, now):
                news_at = now
            restless = self._arrivals.restless(now)
            if self._arrivals.ready(now) or (again_at is not None and again_at <= now):
                self._arrivals.take(now)
                again_at = self._pass(sorted(restless))
                news_at = time.monotonic()
                continue
            due = [*restless.values(), *([] if again_at is None else [again_at])]
            until = min(due) - now if due else None
            with suppress(Empty):
                self._wake.get(timeout=wait_after(now - began, self.interval_s, now - news_at, until))
        self.emit({"event": "stopped"})

    def _tell_troubles(self, look: Look) -> None:
        for path, reason in look.troubles.items():
            if self._troubles.get(path) != reason:
                self.emit({"event": "unreachable", "path": path, "reason": reason})
        for path in self._troubles.keys() - look.troubles.keys():
            self.emit({"event": "reachable", "path": path})
        self._troubles = dict(look.troubles)

    def _pass(self, growing: Sequence[str]) -> float | None:
        """Have a pass done; return the moment at which another one is due in any case, None where there is none."""
        document = self.watched.request() | {"growing": growing, "failed": self._failed, "quiet": True}
        outcome: Event = {}
        command = [sys.executable, "-P", "-c", _PASS, str(PACKAGE_FOLDER.parent)]
        # a session of its own: Ctrl-C reaches this process alone, which hands it on as a request to end
        with subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
            creationflags=getattr(subprocess, "BELOW_NORMAL_PRIORITY_CLASS", 0),  # what `os.nice` is on Windows
        ) as child:
            self._child = child
            assert child.stdin is not None, "a pipe was asked for"
            assert child.stdout is not None, "a pipe was asked for"
            if self._asked:  # a signal came while the process was made
                child.terminate()
            with suppress(OSError):  # it ended before it read; what that means is told by its status
                print(json.dumps(document), file=child.stdin, flush=True)
            for line in child.stdout:
                if not line.endswith("\n"):  # the process was killed while it wrote
                    break
                event = json.loads(line)
                if event["event"] == "outcome":
                    outcome = event
                else:
                    self._tell(event)
            status = child.wait()
            self._child = None
            # open until now: the pass ends when this pipe does
            with suppress(OSError):
                child.stdin.close()
        if self._asked:
            return None
        if not outcome:
            reason = f"the pass ended with status {status}; its last words stand in the error output"
            self._tell({"event": "failed", "what": "pass", "reason": reason})
            return self._retry_at()
        self._failed = outcome["failed"]
        if outcome["status"] == 0:
            self._told = {}
        if outcome["retry"]:
            return self._retry_at()
        self._retry_s = RETRY_S
        return time.monotonic() + self.watched.settle_s if outcome["late"] else None

    def _retry_at(self) -> float:
        """Return the moment at which a pass that failed is tried again, later each time."""
        wait, self._retry_s = self._retry_s, min(2 * self._retry_s, LONGEST_RETRY_S)
        return time.monotonic() + wait

    def _tell(self, event: Event) -> None:
        """Hand an event on, but not a failure that was told before."""
        if event["event"] == "failed":
            if self._told.get(event["what"]) == event["reason"]:
                return
            self._told[event["what"]] = event["reason"]
        elif event["event"] == "report":
            self._told.pop(event["what"], None)
        self.emit(event)
