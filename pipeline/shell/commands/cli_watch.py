"""The command that keeps reports current: parse, call, print."""

from __future__ import annotations

import os
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from pipeline.base.process import Ended
from pipeline.shell import console
from pipeline.shell.commands.options import Processed, ProfileFile, Reports
from pipeline.shell.watch import Event, Watched, follow, run_pass, status_of

SETTLE_S = 2.0
NICENESS = 10
"""Lower priority: the same machine may be recording logs at 1 kHz."""

WORDS = {
    "started": "watching {folders} every {interval_s:g} s, settle {settle_s:g} s; {processed} -> {reports}",
    "ingest": "logs: {ingested} new, {found} in all, {quarantined} in quarantine, {waiting} still settle",
    "refused": "refused: {path}, row {row}: {reason}",
    "changed": "changed: {path}: {outcome}",
    "report": "report: {report} ({trials} trials, {seconds:.1f} s)",
    "unchanged": "report: {report} is up to date",
    "index": "index: {path}",
    "failed": "failed: {what}: {reason}",
    "unreachable": "unreachable: {path} ({reason})",
    "reachable": "reachable again: {path}",
    "busy": "{reason}; left to it",
    "stopped": "stopped",
}
"""Events in words."""


def watch(
    folders: Annotated[list[Path], typer.Argument(help="Folders in which logs arrive (searched below, too).")],
    processed: Processed = Path("processed"),
    reports: Reports = Path("reports"),
    profile: ProfileFile = None,
    scene: Annotated[
        list[Path] | None, typer.Option("--scene", help="Scene file of a report (default: all devices). Repeat.")
    ] = None,
    settle: Annotated[float, typer.Option("--settle", help="Seconds a log must stay the same.")] = SETTLE_S,
    once: Annotated[bool, typer.Option("--once", help="Make one pass; leave logs that still settle.")] = False,
) -> int:
    """Keep reports and the index current while logs arrive.

    Only reports whose logs changed are renewed. Logs that are refused go into quarantine, and the watch goes on.
    Nothing is lost when it is killed: the next start does what is left. With --json each line is a document. Exit
    status with --once: 1 where something failed, 3 where logs are in quarantine.

    Example: pipeline watch raw

    Example: pipeline watch raw --once --processed processed --reports reports
    """
    watched = Watched(tuple(folders), processed, reports, profile, tuple(scene or ()), settle)
    if once:
        events = []
        for event in run_pass(watched):
            events.append(event)
            _tell(event)
        return status_of(events)
    os.nice(NICENESS)
    try:
        for event in follow(watched, settle or SETTLE_S):
            _tell(event)
    except Ended:
        _tell({"event": "stopped"})
    return 0


def _tell(event: Event) -> None:
    """Print an event with its time (UTC), at once: somebody may be reading the lines as they come."""
    now = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    console.tell_line({"time": now, **event}, [f"{now} {line_of(event)}".replace("\n", " ")])


def line_of(event: Event) -> str:
    """Return an event in words; a list of files is their number."""
    shown = {name: len(value) if name == "waiting" else value for name, value in event.items()}
    return WORDS[event["event"]].format(**shown)
