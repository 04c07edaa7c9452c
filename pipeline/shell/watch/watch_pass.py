"""One pass of a watch: store what is new, renew the reports that this changes, and the index page.

A pass keeps no state of its own: what it has to do follows from the logs, `processed/` and the reports. It may be
ended at any moment, also by a loss of power, and the next one does what is left.
"""

from __future__ import annotations

import json
import os
import sys
import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path

from pipeline.base.errors import EXIT_ERROR, EXIT_OK, EXIT_QUARANTINED, PipelineError, StoreError
from pipeline.base.lock import WAIT_S, holder, writing
from pipeline.base.paths import path_of_text, path_text
from pipeline.base.process import Ended, begin_alone, end_when, ending_on_signals
from pipeline.base.provenance import digest
from pipeline.comparison.compare import compare
from pipeline.comparison.scene.scene import RUN
from pipeline.comparison.scene.scene_file import read_scene
from pipeline.intake.ingest import ingest
from pipeline.intake.ingest_report import IngestReport, Refusal
from pipeline.intake.quarantine import list_quarantine
from pipeline.records.models import SceneFile
from pipeline.shell.report_index import write_index
from pipeline.store.corrections import read_exclusions, split_trials
from pipeline.store.names import report_of
from pipeline.store.storage import list_devices, read_trials

PASS_FOLDER = ".watch"
"""Folder below `processed/` with the lock that lets one pass work at a time; an ingest by hand is not kept waiting."""

NICENESS = 10
"""Lower priority of a pass: the same machine may be recording logs at 1 kHz."""

Event = dict[str, object]
"""Something that happened: its kind under ``event``, the rest by kind."""

Emit = Callable[[Event], None]


@dataclass(frozen=True)
class PassRequest:
    """What a pass works on.

    Parameters
    ----------
    folders : tuple of str
        Searched for logs; one that is not there is left out.
    processed, reports : str
    profile : str or None
        As for `ingest`.
    scenes : tuple of str
        Scene files, one report each; without any, one report for each stored device.
    settle_s : float
        Logs modified less than this time ago are left for later [s].
    growing : tuple of str
        Absolute paths of files that are not at rest, whatever their times say.
    failed : mapping of str to str
        Hash of the logs of which no report could be made, by its name: it is tried again when they change.
    wait_s : float
        How long to wait for another pass on the same folder [s].
    quiet : bool
        Whether nothing is told of what did not change.
    """

    folders: tuple[str, ...]
    processed: str
    reports: str
    profile: str | None = None
    scenes: tuple[str, ...] = ()
    settle_s: float = 0.0
    growing: tuple[str, ...] = ()
    failed: Mapping[str, str] = field(default_factory=dict)
    wait_s: float = WAIT_S
    quiet: bool = False


@dataclass
class PassOutcome:
    """What is left after a pass.

    Parameters
    ----------
    status : int
        Exit status: 1 where something failed, 3 where logs are in quarantine.
    retry : bool
        Whether something failed that may go well without a change of the logs: a full disk, another writer.
    late : bool
        Whether a log was too young that nobody saw growing.
    failed : dict of str to str
        As in `PassRequest`.
    """

    status: int = EXIT_OK
    retry: bool = False
    late: bool = False
    failed: dict[str, str] = field(default_factory=dict)


def run_pass(request: PassRequest, emit: Emit) -> PassOutcome:
    """Ingest, compare and renew the index once.

    Parameters
    ----------
    request : PassRequest
    emit : callable
        Gets each event when it happens.

    Returns
    -------
    PassOutcome
        Named errors are told as events, and so are defects, with their traceback on stderr: one device must not keep
        the reports of others from being renewed.
    """
    outcome = PassOutcome()
    with ExitStack() as stack:
        lock = Path(request.processed, PASS_FOLDER)
        try:
            stack.enter_context(writing(lock, request.wait_s))
        except StoreError as error:
            other = holder(lock)
            emit({"event": "busy", "reason": f"{other} is at work on {request.processed}" if other else str(error)})
            outcome.retry = True
            return outcome
        except OSError as error:
            _fail(emit, outcome, "pass", f"{request.processed}: cannot be written ({error})", retry=True)
            return outcome
        _ingest(request, emit, outcome)
        _reports(request, emit, outcome)
        try:
            index = write_index(Path(request.reports))
        except (PipelineError, OSError) as error:
            _fail(emit, outcome, "index", str(error), retry=True)
        else:
            if index is not None:
                emit({"event": "index", "path": path_text(index)})
    return outcome


def _ingest(request: PassRequest, emit: Emit, outcome: PassOutcome) -> None:
    folders = [Path(folder) for folder in request.folders if os.path.isdir(folder)]
    if not folders:
        return
    processed = Path(request.processed)
    try:
        before = {record.path: record.reason for record in list_quarantine(processed, {})}
        report = ingest(
            folders,
            processed,
            request.profile,
            settle_s=request.settle_s,
            growing=request.growing,
        )
    except PipelineError as error:
        _fail(emit, outcome, "ingest", str(error), retry=True)
        return
    new = [r for r in report.quarantined if before.get(_key(r.path)) != r.reason]
    told_before = {refusal.path for refusal in report.quarantined} - {refusal.path for refusal in new}
    changed = [source for source in report.changed if source.path not in told_before]
    if report.ingested or changed or new or not request.quiet:
        emit(_ingest_event(report))
    for refusal in new:
        emit(_refusal_event(refusal))
    for source in changed:
        emit({"event": "changed", "path": source.path, "outcome": source.outcome})
    for text in report.damaged:
        _fail(emit, outcome, "store", text, retry=False)
    # where files grow, another pass follows in any case
    outcome.late = bool(report.waiting) and not request.growing
    if report.quarantined and outcome.status == EXIT_OK:
        outcome.status = EXIT_QUARANTINED


def _key(shown: str) -> str:
    """Return what quarantine knows a source by."""
    return path_text(os.path.abspath(path_of_text(shown)))


def _ingest_event(report: IngestReport) -> Event:
    counts = {key: getattr(report, key) for key in ("found", "ingested", "skipped")}
    more = {"quarantined": len(report.quarantined), "warnings": len(report.warnings), "waiting": list(report.waiting)}
    return {"event": "ingest", **counts, **more}


def _refusal_event(refusal: Refusal) -> Event:
    return {"event": "refused", "path": refusal.path, "row": refusal.row, "reason": refusal.reason}


def _reports(request: PassRequest, emit: Emit, outcome: PassOutcome) -> None:
    for name in request.scenes or list_devices(Path(request.processed)):
        inputs = ""
        try:
            scene = read_scene(Path(name)) if request.scenes else None
            device = scene.device if scene else name
            inputs = _inputs(Path(request.processed), device, scene)
            if request.failed.get(name) == inputs:
                outcome.failed[name] = inputs
                outcome.status = EXIT_ERROR
                continue
            _report(request, name, device, scene, emit)
        except (PipelineError, OSError) as error:
            # a full disk may be emptied and a damaged file mended; too few logs stay too few until others come
            retry = isinstance(error, (StoreError, OSError))
            if inputs and not retry:
                outcome.failed[name] = inputs
            _fail(emit, outcome, name, str(error), retry=retry)
        except Exception as error:  # a defect that the logs of one device show must not stop the reports of others
            traceback.print_exc()
            if inputs:
                outcome.failed[name] = inputs
            _fail(emit, outcome, name, f"defect in the program: {error!r}; please report it", retry=False)


def _report(request: PassRequest, what: str, device: str, scene: SceneFile | None, emit: Emit) -> None:
    """Bring one report up to date."""
    report = Path(scene.report) if scene and scene.report else report_of(Path(request.reports), device)
    began = time.monotonic()
    found = compare(
        device,
        Path(request.processed),
        experiments=scene.experiments if scene else None,
        criteria=scene.chosen_criteria if scene else None,
        shown=scene.shown if scene else None,
        report=report,
    )
    renewed = any(stage == "report" and action == RUN for stage, action, _ in found.stages)
    if renewed or not request.quiet:
        kind = "report" if renewed else "unchanged"
        trials = sum(e.trials for e in found.result.experiments) if found.result else 0
        seconds = round(time.monotonic() - began, 3)
        emit(
            {
                "event": kind,
                "what": what,
                "device": device,
                "report": path_text(report),
                "trials": trials,
                "seconds": seconds,
            }
        )


def _inputs(processed: Path, device: str, scene: SceneFile | None) -> str:
    """Return a hash of what the report of a device rests on besides the code."""
    # a damaged experiment that a scene leaves out does not concern its report
    experiments = scene.experiments if scene and scene.experiments else (None,)
    tables = [read_trials(processed, device, name) for name in experiments]
    excluded = [one.model_dump() for table in tables for one in split_trials(table, read_exclusions(processed))[1]]
    names = ("trial_id", "profile_sha256")
    rows = sorted(row for table in tables for row in zip(*(table.column(n).to_pylist() for n in names), strict=True))
    return digest([rows, excluded, scene.model_dump_json() if scene else None])


def _fail(emit: Emit, outcome: PassOutcome, what: str, reason: str, retry: bool) -> None:
    outcome.status = EXIT_ERROR
    outcome.retry |= retry
    emit({"event": "failed", "what": what, "reason": reason})


def main() -> None:
    """Do one pass as a process of its own: a `PassRequest` as JSON on stdin, events and outcome as lines on stdout.

    A signal ends it, and so does the end of stdin, which its parent holds open.
    """
    begin_alone()
    # lines of events alone: what a library prints goes to the errors
    lines, sys.stdout = sys.stdout, sys.stderr
    request = PassRequest(**json.loads(sys.stdin.readline()))
    end_when(partial(os.read, sys.stdin.fileno(), 1))
    if hasattr(os, "nice"):
        os.nice(NICENESS)

    def emit(event: Event) -> None:
        print(json.dumps(event), file=lines, flush=True)

    try:
        with ending_on_signals():
            outcome = run_pass(request, emit)
            emit({"event": "outcome", **asdict(outcome)})
    except Ended as end:
        end.leave()
