"""The command that keeps reports current: parse, call, print."""

from __future__ import annotations

import json
import os
import sys
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipeline.base.errors import UsageError
from pipeline.base.process import end_when, on_stop_signals
from pipeline.shell import console
from pipeline.shell.commands.options import JsonLines, Processed, ProfileFile, Reports

if TYPE_CHECKING:
    from pipeline.shell.watch import Watched

SETTLE_S = 2.0


def watch(
    folders: Annotated[list[Path], typer.Argument(help="Folders in which logs arrive (searched below, too).")],
    processed: Processed = Path("processed"),
    reports: Reports = Path("reports"),
    profile: ProfileFile = None,
    scene: Annotated[
        list[Path] | None,
        typer.Option(
            "--scene",
            help="Scene file (.toml) of a report; may be given several times. Without it: one report for each device.",
        ),
    ] = None,
    settle: Annotated[
        float, typer.Option("--settle", help="Seconds a log must stay the same before it is read, and between looks.")
    ] = SETTLE_S,
    once: Annotated[
        bool, typer.Option("--once", help="One pass, which waits for nothing; logs that still settle are left.")
    ] = False,
    held: Annotated[bool, typer.Option("--held", hidden=True, help="As a pass of a watch, and no longer.")] = False,
    as_json: JsonLines = False,
) -> None:
    """Keep reports and the index current while logs arrive.

    Only reports whose logs changed are renewed. Logs that are refused go into quarantine, and the watch goes on.
    Nothing is lost when it is killed: the next start does what is left. Exit status with --once: 1 where something
    failed, 3 where logs are in quarantine.

    Example: pipeline watch raw

    Example: pipeline watch raw --once --processed processed --reports reports
    """
    watched = _watched(folders, processed, reports, profile, scene or [], settle)
    if once:
        from pipeline.shell.watch import run_pass

        growing = json.loads(sys.stdin.readline()) if held else []
        if held:
            end_when(partial(os.read, sys.stdin.fileno(), 1))
        raise typer.Exit(run_pass(watched, lambda event: _print(event, as_json), growing))
    _until_stopped(watched, as_json)


def _watched(
    folders: list[Path],
    processed: Path,
    reports: Path,
    profile: str | None,
    scenes: list[Path],
    settle: float,
) -> Watched:
    from pipeline.shell.watch import Watched

    if not 0 <= settle < float("inf"):
        raise UsageError(f"--settle {settle:g}: expected a time of 0 s or more.")
    for folder in folders:
        if not os.path.isdir(folder):
            raise UsageError(f"{folder}: no such folder. Give folders in which logs arrive.")
        if Path(os.path.abspath(reports)).is_relative_to(os.path.abspath(folder)):
            raise UsageError(
                f"{reports}: lies in the watched folder {folder}, where reports would be taken for logs. Give another "
                "folder for them (--reports), or watch the folder of the logs alone."
            )
        if Path(os.path.abspath(folder)).is_relative_to(os.path.abspath(processed)):
            raise UsageError(f"{folder}: lies in {processed}, where results are kept. Give folders with logs.")
    for scene in scenes:
        if not scene.is_file():
            raise UsageError(f"{scene}: no such file. `pipeline compare --save-scene` writes one.")
    return Watched(tuple(folders), processed, reports, profile, tuple(scenes), settle)


def _until_stopped(watched: Watched, as_json: bool) -> None:
    from pipeline.shell.watch import Watch

    running = Watch(watched, watched.settle_s or SETTLE_S, lambda event: _print(event, as_json))

    def stop(number: int, frame: FrameType | None) -> None:
        if running.stop():
            # not by the buffered streams, which may be in use at the moment of the signal
            os.write(2, b"stopping; a second signal stops at once\n")

    with on_stop_signals(stop):
        running.run()


def _print(event: dict[str, Any], as_json: bool) -> None:
    """Print an event as a line with its time (UTC), at once: somebody may be reading the lines as they come."""
    now = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    if as_json:
        sys.stdout.write(json.dumps({"time": now, **event}, allow_nan=False) + "\n")
    else:
        console.say(f"{now} {line_of(event)}".replace("\n", " "))
    sys.stdout.flush()


def line_of(event: dict[str, Any]) -> str:
    """Return an event in words."""
    match event["event"]:
        case "started":
            return (
                f"watching {', '.join(event['folders'])} (every {event['interval_s']:g} s, settle "
                f"{event['settle_s']:g} s); tables in {event['processed']}, reports in {event['reports']}"
            )
        case "ingest":
            waiting = f", {len(event['waiting'])} still settle" if event["waiting"] else ""
            refused = f", {event['quarantined']} in quarantine" if event["quarantined"] else ""
            return f"logs: {event['ingested']} new, {event['found']} in all{refused}{waiting}"
        case "refused":
            row = "" if event["row"] is None else f", row {event['row']}"
            return f"refused: {event['path']}{row}: {event['reason']}"
        case "changed":
            return f"changed: {event['path']}: {event['outcome']}"
        case "report":
            return f"report: {event['report']} ({event['trials']} trials, {event['seconds']:.1f} s)"
        case "unchanged":
            return f"report: {event['report']} is up to date"
        case "index":
            return f"index: {event['path']}"
        case "failed":
            return f"failed: {event['what']}: {event['reason']}"
        case "unreachable":
            return f"cannot be looked at: {event['path']} ({event['reason']})"
        case "reachable":
            return f"can be looked at again: {event['path']}"
        case "busy":
            return f"{event['reason']}; left to it"
        case kind:
            return str(kind)
