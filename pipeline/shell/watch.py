"""Keeps reports current while logs arrive.

The process that looks is small: it knows sizes and times of files, and opens none. When new logs are at rest it runs
the same command with ``--once`` and hands its events on; that process takes its memory with it when it ends. Nothing is
kept but what lies in `processed/`: after an end of any kind the next start does what is left.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from pipeline.base.errors import EXIT_ERROR, EXIT_OK, EXIT_QUARANTINED, PipelineError, StoreError
from pipeline.base.provenance import PACKAGE_FOLDER, user_device_folder

FileState = tuple[int, int, int]
"""Size [byte], and times of the last change of the content and of anything else, as permissions [ns since 1970]."""

Event = dict[str, Any]
"""Something that happened: its kind under ``event``, the rest by kind."""

Emit = Callable[[Event], None]

LOOK_SHARE = 200
"""A wait lasts at least this many times as long as the look before it: looking takes 0.5 % of a processor at most."""

PATIENCE_S, LONGEST_WAIT = 60.0, 5.0
"""Time without news [s] after which the wait between two looks has doubled, and the longest wait in intervals."""

SHORTEST_WAIT_S = 0.05
"""Shortest wait [s], where a file is about to settle."""

RETRY_S, LONGEST_RETRY_S = 60.0, 3600.0
"""Time after which a pass that failed is tried again [s], as after a full disk; doubles up to the second number."""

NICENESS = 10
"""Lower priority of a pass: the same machine may be recording logs at 1 kHz."""

PASS_FOLDER = ".watch"
"""Folder below `processed/` with the lock that lets one pass work at a time; an ingest by hand is not kept waiting."""

_PROGRAM = "import sys; sys.path.append(sys.argv.pop(1)); from pipeline.shell.cli import run; run()"
"""Program of a pass. Not ``-m``, which would take modules from the current folder."""


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

    @property
    def files(self) -> tuple[Path, ...]:
        """Single files a change of which changes reports."""
        devices = user_device_folder()
        profile = [Path(self.profile)] if self.profile and os.path.isfile(self.profile) else []
        return *self.scenes, *profile, *(sorted(devices.glob("*.toml")) if devices else [])

    @property
    def command(self) -> list[str]:
        """Command line of one pass that ends with the process that started it."""
        options = [("--processed", self.processed), ("--reports", self.reports), ("--settle", self.settle_s)]
        options += [("--profile", self.profile)] if self.profile else []
        options += [("--scene", scene) for scene in self.scenes]
        words = [f"{name}={value}" for name, value in options]
        program = [sys.executable, "-P", "-c", _PROGRAM, str(PACKAGE_FOLDER.parent)]
        return [*program, "watch", "--once", "--held", "--json", *words, "--", *map(str, self.folders)]


def look_at(
    folders: Sequence[Path], files: Sequence[Path] = (), exclude: Sequence[Path] = ()
) -> tuple[dict[str, FileState], dict[str, str]]:
    """Return the state of each file by its absolute path, and why folders could not be looked at.

    Parameters
    ----------
    folders : sequence of Path
        Searched with all folders below, hidden ones left out. Links to folders are not followed, as by `ingest`.
    files : sequence of Path
        Single files that matter, too.
    exclude : sequence of Path
        Folders that are left out.
    """
    troubles: dict[str, str] = {}
    left_out = {os.path.abspath(path) for path in exclude}

    def note(error: OSError) -> None:
        troubles[str(error.filename)] = error.strerror or str(error)

    paths = [os.path.abspath(file) for file in files]
    for folder in folders:
        for here, below, names in os.walk(os.path.abspath(folder), onerror=note):
            below[:] = [n for n in below if not n.startswith(".") and os.path.join(here, n) not in left_out]
            paths += [os.path.join(here, name) for name in names if not name.startswith(".")]
    states = {}
    for path in paths:
        with suppress(OSError):  # gone again, or a link that leads nowhere (yet)
            status = os.stat(path)
            states[path] = status.st_size, status.st_mtime_ns, status.st_ctime_ns
    return states, troubles


class Arrivals:
    """Which files are new or changed since they were last taken, and which of them are at rest.

    A file is at rest when its state was the same for a time that this process has seen itself: clocks of file servers,
    and times that a copy brought along, do not matter.

    Parameters
    ----------
    settle_s : float
        How long a state must last [s].
    """

    def __init__(self, settle_s: float) -> None:
        self.settle_s = settle_s
        self._seen: dict[str, tuple[FileState, float]] = {}
        self._taken: dict[str, FileState] = {}

    def update(self, states: Mapping[str, FileState], now: float) -> bool:
        """Take in a look at a moment [s] of a clock that never goes back; return whether a file came or changed."""
        before = self._seen
        known = {path: before[path] for path, state in states.items() if path in before and before[path][0] == state}
        self._seen = {path: known.get(path, (state, now)) for path, state in states.items()}
        # a file that is gone and comes back as it was is known; memory stays bounded by what is there
        self._taken = {path: state for path, state in self._taken.items() if path in self._seen}
        return len(known) < len(self._seen)

    def restless(self, now: float) -> dict[str, float]:
        """Return the files that are not at rest, and the moment [s] at which each will be."""
        times = ((path, since + self.settle_s) for path, (_, since) in self._seen.items())
        return {path: rests for path, rests in times if rests > now}

    def ready(self, now: float) -> bool:
        """Return whether a file is at rest and new or changed since it was taken."""
        return any(self._taken.get(path) != state for path, state in self._resting(now))

    def take(self, now: float) -> None:
        """Note that all files at rest are seen to."""
        self._taken |= dict(self._resting(now))

    def _resting(self, now: float) -> Iterator[tuple[str, FileState]]:
        return ((path, state) for path, (state, since) in self._seen.items() if since + self.settle_s <= now)


def wait_after(look_s: float, interval_s: float, quiet_s: float, until_s: float | None) -> float:
    """Return how long to wait for the next look [s].

    Parameters
    ----------
    look_s : float
        How long the last look took [s].
    interval_s : float
        Wait that is asked for [s].
    quiet_s : float
        Time since the last news [s]; the wait grows with it.
    until_s : float or None
        Time until a file is at rest or something is to be tried again [s]; None where nothing is due.

    Examples
    --------
    >>> wait_after(0.005, 2, 0, None), wait_after(0.005, 2, 120, None), wait_after(0.005, 2, 9999, None)
    (2.0, 6.0, 10.0)
    >>> wait_after(0.005, 2, 0, 1.5), wait_after(0.5, 2, 0, None)
    (1.5, 100.0)
    """
    wait = interval_s * min(1 + quiet_s / PATIENCE_S, LONGEST_WAIT)
    if until_s is not None:
        wait = min(wait, max(until_s, SHORTEST_WAIT_S))
    return max(wait, LOOK_SHARE * look_s)


class Watch:
    """A watch that runs until it is asked to stop.

    Parameters
    ----------
    watched : Watched
    interval_s : float
        Time between two looks [s] while logs arrive; it grows fivefold when none do (`wait_after`).
    emit : callable
        Gets each event when it happens.
    """

    def __init__(self, watched: Watched, interval_s: float, emit: Emit) -> None:
        self.watched, self.interval_s, self.emit = watched, interval_s, emit
        self._arrivals = Arrivals(watched.settle_s)
        self._asked = False
        # not an Event, whose lock a signal may find held by the thread that it interrupts
        self._wake: SimpleQueue[None] = SimpleQueue()
        self._child: subprocess.Popen[str] | None = None
        self._told: dict[tuple[str, str], Event] = {}
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
        places = {"folders": [str(f) for f in watched.folders], "interval_s": self.interval_s}
        places |= {"settle_s": watched.settle_s, "processed": str(watched.processed), "reports": str(watched.reports)}
        self.emit({"event": "started", **places})
        news_at = time.monotonic()
        # reports may be out of date from before, whether logs come or not
        due: float | None = news_at + watched.settle_s
        unreachable: set[str] = set()
        while not self._asked:
            began = time.monotonic()
            states, troubles = look_at(watched.folders, watched.files, (watched.processed,))
            now = time.monotonic()
            unreachable = self._tell_troubles(troubles, unreachable)
            if self._arrivals.update(states, now):
                news_at = now
            restless = self._arrivals.restless(now)
            if self._arrivals.ready(now) or (due is not None and due <= now):
                self._arrivals.take(now)
                due = self._pass(sorted(restless))
                news_at = time.monotonic()
                continue
            moments = [*restless.values(), *([] if due is None else [due])]
            until = min(moments) - now if moments else None
            with suppress(Empty):
                self._wake.get(timeout=wait_after(now - began, self.interval_s, now - news_at, until))
        self.emit({"event": "stopped"})

    def _tell_troubles(self, troubles: Mapping[str, str], before: set[str]) -> set[str]:
        for path in troubles.keys() - before:
            self.emit({"event": "unreachable", "path": path, "reason": troubles[path]})
        for path in before - troubles.keys():
            self.emit({"event": "reachable", "path": path})
        return set(troubles)

    def _pass(self, growing: Sequence[str]) -> float | None:
        """Have a pass done; return the moment at which another one is due in any case, None where there is none."""
        late = False
        # a session of its own: Ctrl-C reaches this process alone, which hands it on as a request to end
        with subprocess.Popen(
            self.watched.command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        ) as child:
            self._child = child
            with suppress(OSError, AttributeError):  # ended already; a system without priorities
                os.setpriority(os.PRIO_PROCESS, child.pid, NICENESS)
            if self._asked:  # a signal came while the process was made
                child.terminate()
            assert child.stdin is not None, "a pipe was asked for"
            assert child.stdout is not None, "a pipe was asked for"
            with suppress(OSError):  # it ended before it read; what that means is told by its status
                print(json.dumps(growing), file=child.stdin, flush=True)
            for line in child.stdout:
                if not line.endswith("\n"):  # the process was killed while it wrote
                    break
                event = json.loads(line)
                late |= bool(event.get("waiting"))
                self._tell(event)
            status = child.wait()
            self._child = None
            with suppress(OSError):  # open until now: the pass ends when this pipe does
                child.stdin.close()
        if self._asked:
            return None
        if status not in (EXIT_OK, EXIT_ERROR, EXIT_QUARANTINED):
            reason = f"the pass ended with status {status}; its last words stand in the error output"
            self._tell({"event": "failed", "what": "pass", "reason": reason})
        if status not in (EXIT_OK, EXIT_QUARANTINED):
            wait, self._retry_s = self._retry_s, min(2 * self._retry_s, LONGEST_RETRY_S)
            return time.monotonic() + wait
        self._told = {key: event for key, event in self._told.items() if key[0] == "refused"}
        self._retry_s = RETRY_S
        # where this process saw files grow, another pass follows when they rest
        return time.monotonic() + self.watched.settle_s if late and not growing else None

    def _tell(self, event: Event) -> None:
        """Hand an event on, but not what is as it was, nor what was told before."""
        event = {name: value for name, value in event.items() if name != "time"}
        kind, what = event["event"], str(event.get("what") or event.get("path"))
        if kind == "unchanged" or (kind == "ingest" and not event["ingested"]):
            return
        if kind in ("refused", "failed"):
            if self._told.get((kind, what)) == event:
                return
            self._told[kind, what] = event
        elif kind == "report":
            self._told.pop(("failed", what), None)
        self.emit(event)


def run_pass(watched: Watched, emit: Emit, growing: Sequence[str] = ()) -> int:
    """Store what is new, renew the reports that this changes, and the index page.

    Parameters
    ----------
    watched : Watched
    emit : callable
        Gets each event when it happens. Named errors are events, and so are defects, with their traceback on stderr:
        one device must not keep the reports of others from being renewed.
    growing : sequence of str
        Absolute paths of files that are not at rest, whatever their times say.

    Returns
    -------
    int
        Exit status: 1 where something failed, 3 where logs are in quarantine.
    """
    from pipeline.base.lock import holder, writing

    failed = False

    def fail(what: str, reason: str) -> None:
        nonlocal failed
        failed = True
        emit({"event": "failed", "what": what, "reason": reason})

    lock = watched.processed / PASS_FOLDER
    with ExitStack() as held:
        try:
            held.enter_context(writing(lock, 0.0))
        except StoreError as error:
            if other := holder(lock):
                emit({"event": "busy", "reason": f"{other} is at work on {watched.processed}"})
            else:
                fail("pass", str(error))
            return EXIT_ERROR
        quarantined = _ingest(watched, growing, emit, fail)
        _reports(watched, emit, fail)
    return EXIT_ERROR if failed else EXIT_QUARANTINED if quarantined else EXIT_OK


def _ingest(watched: Watched, growing: Sequence[str], emit: Emit, fail: Callable[[str, str], None]) -> bool:
    """Store new logs; return whether some are in quarantine."""
    from pipeline.intake.ingest import ingest

    folders = [folder for folder in watched.folders if folder.is_dir()]
    if not folders:
        return False
    try:
        report = ingest(folders, watched.processed, watched.profile, settle_s=watched.settle_s, growing=growing)
    except PipelineError as error:
        fail("ingest", str(error))
        return False
    counts = {name: getattr(report, name) for name in ("found", "ingested", "skipped")}
    counts |= {name: len(getattr(report, name)) for name in ("quarantined", "warnings")}
    emit({"event": "ingest", **counts, "waiting": list(report.waiting)})
    for refusal in report.quarantined:
        emit({"event": "refused", "path": refusal.path, "row": refusal.row, "reason": refusal.reason})
    for source in report.changed:
        emit({"event": "changed", "path": source.path, "outcome": source.outcome})
    for text in report.damaged:
        fail("store", text)
    return bool(report.quarantined)


def _reports(watched: Watched, emit: Emit, fail: Callable[[str, str], None]) -> None:
    """Bring each report up to date, and the index."""
    from pipeline.base.paths import path_text
    from pipeline.shell.report_index import write_index
    from pipeline.store.storage import list_devices

    for name in watched.scenes or list_devices(watched.processed):
        try:
            emit(_report(watched, str(name)))
        except (PipelineError, OSError) as error:
            fail(str(name), str(error))
        except Exception as error:  # a defect that the logs of one device show must not stop the reports of others
            traceback.print_exc()
            fail(str(name), f"defect in the program: {error!r}; please report it")
    try:
        index = write_index(watched.reports)
    except (PipelineError, OSError) as error:
        fail("index", str(error))
    else:
        if index is not None:
            emit({"event": "index", "path": path_text(index)})


def _report(watched: Watched, name: str) -> Event:
    """Bring the report of a device or scene up to date; return the event."""
    from pipeline.base.paths import path_text
    from pipeline.comparison.compare import compare
    from pipeline.comparison.scene.scene import RUN
    from pipeline.comparison.scene.scene_file import read_scene
    from pipeline.store.names import report_of

    scene = read_scene(Path(name)) if watched.scenes else None
    device = scene.device if scene else name
    report = Path(scene.report) if scene and scene.report else report_of(watched.reports, device)
    began = time.monotonic()
    found = compare(
        device,
        watched.processed,
        experiments=scene.experiments if scene else None,
        criteria=scene.chosen_criteria if scene else None,
        shown=scene.shown if scene else None,
        report=report,
    )
    renewed = any(stage == "report" and action == RUN for stage, action, _ in found.stages)
    trials = sum(e.trials for e in found.result.experiments) if found.result else 0
    places = {"what": name, "device": device, "report": path_text(report)}
    seconds = round(time.monotonic() - began, 3)
    return {"event": "report" if renewed else "unchanged", **places, "trials": trials, "seconds": seconds}
