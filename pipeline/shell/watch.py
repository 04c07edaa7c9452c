"""Updates of reports and plans while logs arrive. Folders are watched, and files are read when they stop changing.

The state is stored only in `processed/`, so that after any termination the next start does the remaining work.
"""

from __future__ import annotations

import os
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.base.errors import EXIT_ERROR, EXIT_OK, EXIT_QUARANTINED, PipelineError, StoreError, UsageError
from pipeline.base.json_object import JsonObject
from pipeline.base.provenance import user_device_folder
from pipeline.shell import console

if TYPE_CHECKING:
    from concurrent.futures import Future

    from pipeline.planning.campaign import PlanOptions
    from pipeline.planning.planner import Plan

FileState = tuple[int, int, int]
"""Size [byte], and times of the last change of the content and of metadata such as permissions [ns since 1970]."""

Event = JsonObject
"""Event, with its kind under ``event`` and further keys that depend on the kind."""

LOOK_SHARE = 200
"""Smallest ratio of a waiting time to the duration of the scan before it. Scans take at most 0.5 % of a processor."""

SHORTEST_WAIT_S = 0.05
"""Shortest waiting time [s]. It applies if a file will soon have been unchanged for long enough."""

RETRY_S, LONGEST_RETRY_S = 60.0, 3600.0
"""Time after which a failed pass is repeated [s], for example after a full disk. This time doubles after each further
failure, up to the second number."""

PLAN_SETTLE_S = 0.3
"""Time for which a log must be unchanged before the planner reads it [s]. It is short, so that the next wall appears
within a second."""


@dataclass(frozen=True)
class Watched:
    """Watched folders, and folders of the results.

    Parameters
    ----------
    folders : tuple of Path
        Folders that are searched for logs recursively.
    processed, reports : Path
    profile : str or None
        Log profile by name, or a profile file.
    scenes : tuple of Path
        Scene files, each with a report. By default, there is one report for each device.
    settle_s : float
        Time for which a log must be unchanged before it is read [s].

    Raises
    ------
    UsageError
        If the folder of reports is inside a folder of logs.
    """

    folders: tuple[Path, ...]
    processed: Path
    reports: Path
    profile: str | None = None
    scenes: tuple[Path, ...] = ()
    settle_s: float = 2.0

    def __post_init__(self) -> None:
        for folder in self.folders:
            if Path(os.path.abspath(self.reports)).is_relative_to(os.path.abspath(folder)):
                raise UsageError(
                    f"{self.reports}: is inside the watched folder {folder}, where reports would be read as logs. Name "
                    "a different folder for reports (--reports), or watch only the folder of the logs."
                )

    @property
    def files(self) -> tuple[Path, ...]:
        """Individual files whose changes affect reports."""
        devices = user_device_folder()
        profile = [Path(self.profile)] if self.profile and os.path.isfile(self.profile) else []
        return *self.scenes, *profile, *(sorted(devices.glob("*.toml")) if devices else [])


@dataclass
class Arrivals:
    """States of files, to find those that are at rest and are new or changed since they were last processed.

    A file is at rest if this process has seen it unchanged for some time. Clocks of file servers and copied time stamps
    have no influence.

    Parameters
    ----------
    settle_s : float
        Time for which a file must be unchanged to be at rest [s].
    """

    settle_s: float
    troubles: dict[str, str] = field(default_factory=dict)
    _seen: dict[str, tuple[FileState, float]] = field(default_factory=dict)
    _taken: dict[str, FileState] = field(default_factory=dict)

    def look(self, folders: Sequence[Path], files: Sequence[Path] = (), exclude: Sequence[Path] = ()) -> float:
        """Record the current states of all files. Folders that could not be read are listed in ``troubles``, with the
        reasons.

        Hidden files and folders are skipped, and links to folders are not followed, as in `ingest`. Return the time [s]
        of a monotonic clock.
        """
        self.troubles = {}
        left_out = {os.path.abspath(path) for path in exclude}

        def note(error: OSError) -> None:
            self.troubles[str(error.filename)] = error.strerror or str(error)

        paths = [os.path.abspath(file) for file in files]
        for folder in folders:
            for here, below, names in os.walk(os.path.abspath(folder), onerror=note):
                below[:] = [n for n in below if not n.startswith(".") and os.path.join(here, n) not in left_out]
                paths += [os.path.join(here, name) for name in names if not name.startswith(".")]
        states = {}
        for path in paths:
            with suppress(OSError):  # the file was removed, or is a broken link
                status = os.stat(path)
                states[path] = status.st_size, status.st_mtime_ns, status.st_ctime_ns
        now = time.monotonic()
        self.update(states, now)
        return now

    def update(self, states: Mapping[str, FileState], now: float) -> None:
        """Record the states of files at a time [s] of a monotonic clock."""
        before = self._seen
        known = {path: before[path] for path, state in states.items() if path in before and before[path][0] == state}
        self._seen = {path: known.get(path, (state, now)) for path, state in states.items()}
        # Forget missing files, so that the memory is limited by the number of existing files.
        self._taken = {path: state for path, state in self._taken.items() if path in self._seen}

    def restless(self, now: float) -> dict[str, float]:
        """Return the files that are not at rest, with the time [s] at which each will be at rest."""
        times = ((path, since + self.settle_s) for path, (_, since) in self._seen.items())
        return {path: rests for path, rests in times if rests > now}

    def ready(self, now: float) -> bool:
        """Return True if a file is at rest and is new or changed since it was last processed."""
        return any(self._taken.get(path) != state for path, state in self._resting(now))

    def take(self, now: float) -> None:
        """Mark all files at rest as processed."""
        self._taken |= dict(self._resting(now))

    def _resting(self, now: float) -> Iterator[tuple[str, FileState]]:
        return ((path, state) for path, (state, since) in self._seen.items() if since + self.settle_s <= now)


def follow(watched: Watched, interval_s: float) -> Iterator[Event]:
    """Yield events endlessly while logs arrive. Unchanged states and repeated messages are skipped."""
    places = {"folders": [str(f) for f in watched.folders], "interval_s": interval_s, "settle_s": watched.settle_s}
    yield {"event": "started", **places, "processed": str(watched.processed), "reports": str(watched.reports)}
    arrivals, unreachable, reported = Arrivals(watched.settle_s), set[str](), dict[tuple[str, str], Event]()
    # Reports may be out of date even if no logs arrive.
    due, retry_s = time.monotonic() + watched.settle_s, RETRY_S
    while True:
        began = time.monotonic()
        now = arrivals.look(watched.folders, watched.files, (watched.processed,))
        yield from (_failed(path, arrivals.troubles[path]) for path in sorted(arrivals.troubles.keys() - unreachable))
        unreachable, growing = {*arrivals.troubles}, arrivals.restless(now)
        if arrivals.ready(now) or due <= now:
            arrivals.take(now)
            failed, waiting = set(), False
            for event in run_pass(watched, tuple(growing)):
                key = event["event"], str(event.get("what") or event.get("path"))
                waiting |= bool(event.get("waiting"))
                failed |= {key} if key[0] == "failed" else set()
                is_news = event["event"] not in ("unchanged", "ingest") or event.get("ingested")
                if is_news and reported.get(key) != event:
                    yield event
                if key[0] in ("failed", "refused"):
                    reported[key] = event
            reported = {key: event for key, event in reported.items() if key[0] == "refused" or key in failed}
            wait_s = retry_s if failed else watched.settle_s if waiting and not growing else float("inf")
            retry_s = min(2 * retry_s, LONGEST_RETRY_S) if failed else RETRY_S
            due = time.monotonic() + wait_s
            continue
        until = min([due, now + interval_s, *growing.values()]) - now
        time.sleep(max(until, SHORTEST_WAIT_S, LOOK_SHARE * (now - began)))


def status_of(events: Sequence[Event]) -> int:
    """Return the exit status of a pass. It is 1 if something failed, and 3 if logs are in quarantine."""
    if any(event["event"] == "failed" for event in events):
        return EXIT_ERROR
    return EXIT_QUARANTINED if any(event.get("quarantined") for event in events) else EXIT_OK


def run_pass(watched: Watched, growing: Sequence[str] = ()) -> Iterator[Event]:
    """Store new logs, update the affected reports and the index page, and yield each event as it happens.

    Expected errors are events. Defects are also events, with their traceback on stderr, so that one device does not
    block the reports of others. ``growing`` contains absolute paths of files that are not at rest, regardless of their
    time stamps.
    """
    yield from _ingest(watched, growing)
    yield from _reports(watched)


def _failed(what: str, reason: object) -> Event:
    return {"event": "failed", "what": what, "reason": str(reason)}


def _ingest(watched: Watched, growing: Sequence[str]) -> Iterator[Event]:
    """Store new logs, and yield the events."""
    from pipeline.intake.ingest import ingest

    folders = [folder for folder in watched.folders if folder.is_dir()]
    if not folders:
        return
    try:
        report = ingest(folders, watched.processed, watched.profile, settle_s=watched.settle_s, growing=growing)
    except PipelineError as error:
        yield _failed("ingest", error)
        return
    counts = {name: getattr(report, name) for name in ("found", "ingested", "skipped")}
    counts |= {name: len(getattr(report, name)) for name in ("quarantined", "warnings")}
    yield {"event": "ingest", **counts, "waiting": list(report.waiting)}
    for refusal in report.quarantined:
        yield {"event": "refused", "path": refusal.path, "row": refusal.row, "reason": refusal.reason}
    for source in report.changed:
        yield {"event": "changed", "path": source.path, "outcome": source.outcome}
    for text in report.damaged:
        yield _failed("store", text)


def _reports(watched: Watched) -> Iterator[Event]:
    """Update each report and the index, and yield the events."""
    from pipeline.base.paths import path_text
    from pipeline.shell.report_index import write_index
    from pipeline.store.storage import list_devices

    for name in map(str, watched.scenes or list_devices(watched.processed)):
        try:
            yield _report(watched, name)
        except (PipelineError, OSError) as error:
            yield _failed(name, error)
        except Exception as error:  # a defect due to one device must not stop other reports
            traceback.print_exc()
            yield _failed(name, f"defect in the program: {error!r}; please report it")
    try:
        index = write_index(watched.reports)
    except (PipelineError, OSError) as error:
        yield _failed("index", error)
    else:
        if index is not None:
            yield {"event": "index", "path": path_text(index)}


def _report(watched: Watched, name: str) -> Event:
    """Update the report of a device or scene, and return the event."""
    from pipeline.base.paths import path_text
    from pipeline.comparison.compare import run, write_report
    from pipeline.comparison.plan import ComparisonSelection, ReportOptions, plan_comparison
    from pipeline.comparison.scene.scene_file import read_scene
    from pipeline.store.names import report_of

    scene = read_scene(Path(name)) if watched.scenes else None
    device = scene.device if scene else name
    report = Path(scene.report) if scene and scene.report else report_of(watched.reports, device)
    began = time.monotonic()
    options = (scene.experiments, scene.chosen_criteria, scene.shown) if scene else ()
    finished = run(plan_comparison(ComparisonSelection(device, watched.processed, *options), ReportOptions(report)))
    write_report(finished)
    trials = sum(each.trials for each in finished.document.experiments)
    places = {"what": name, "device": device, "report": path_text(report)}
    seconds = round(time.monotonic() - began, 3)
    renewed = finished.plan.unchanged is None
    return {"event": "report" if renewed else "unchanged", **places, "trials": trials, "seconds": seconds}


def plan_beside(
    folders: Sequence[Path],
    name: str,
    processed: Path,
    experiment: str | None,
    options: PlanOptions,
    profile: str | None,
) -> Iterator[Plan]:
    """Yield the plan at the start and after each new log, until the plan is complete. The arguments are those of
    `planner.plan`.

    The parts of a device are identified in another process, so that plans do not wait for them.
    """
    from pipeline.base.process import process_pool
    from pipeline.intake.ingest import ingest
    from pipeline.measured.identification.parts import ChosenParts, choose_parts
    from pipeline.measured.identification.recordings import Recording
    from pipeline.planning.campaign import open_campaign
    from pipeline.planning.planner import plan_of, remember

    reported, running = set[tuple[str, str]](), list["Future[ChosenParts]"]()

    def parts(recordings: list[Recording]) -> ChosenParts | None:
        if not running:
            running.append(pool.submit(choose_parts, recordings))
        return running.pop().result() if running[0].done() else None

    with process_pool(1) as pool:
        arrivals, known, first = Arrivals(PLAN_SETTLE_S), None, True
        now = arrivals.look(folders, (), (processed,))
        while True:
            if not (first or arrivals.ready(now)):
                time.sleep(PLAN_SETTLE_S / 3)
                now = arrivals.look(folders, (), (processed,))
                continue
            arrivals.take(now)
            try:
                report = ingest(folders, processed, profile, growing=tuple(arrivals.restless(now)))
            except StoreError as error:  # another command is writing there, and the next scan tries again
                console.note(str(error))
                arrivals = Arrivals(PLAN_SETTLE_S)
                time.sleep(1.0)
                continue
            for path, reason in {(refusal.path, refusal.reason) for refusal in report.quarantined} - reported:
                console.note(f"refused: {path}: {reason}")
                reported.add((path, reason))
            campaign = open_campaign(name, processed, experiment, options, known, parts)
            known, first, answer = campaign.learnt, False, plan_of(campaign, options)
            remember(answer, campaign, processed)
            yield answer
            if answer.done:
                return
