"""Commands for reports: `compare`, `verify`, `bundle` and `watch`."""

from __future__ import annotations

import os
from collections.abc import Sequence
from datetime import UTC, datetime
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from pipeline.base.errors import EXIT_ERROR, EXIT_OK, UsageError
from pipeline.base.paths import check_output
from pipeline.base.process import Ended
from pipeline.shell import console
from pipeline.shell.commands.options import (
    Criteria,
    ExecutorName,
    Experiments,
    Processed,
    ProfileFile,
    Reports,
    Store,
    device_of,
    quantity,
    reports_folder,
)
from pipeline.shell.console import argument, option

if TYPE_CHECKING:
    from pipeline.records.models import Shown
    from pipeline.records.results import ComparisonResult
    from pipeline.rendering.report.report_against import AgainstPage
    from pipeline.shell.watch import Event


def compare(
    device: Annotated[
        str | None, option("--device", "Device: name or file (.toml) (default: of the scene, or the only one).")
    ] = None,
    experiment: Experiments = None,
    criteria: Criteria = None,
    processed: Store = "processed",
    executor: ExecutorName = "local",
    report: Annotated[Path | None, option("--report", "HTML file (default: reports/DEVICE.html).")] = None,
    scene: Annotated[
        Path | None, option("--scene", "Scene file (.toml) that defines the content of the report.")
    ] = None,
    export: Annotated[Path | None, option("--export", "Folder for tables and figures in all formats.")] = None,
    against: Annotated[str | None, option("--against", "EXPERIMENT, DEVICE:EXPERIMENT or a report (.json).")] = None,
    save_scene: Annotated[Path | None, option("--save-scene", "Only write a scene file of the stored data.")] = None,
    dry_run: Annotated[bool, option("--dry-run", "Only list what would be done, and why.")] = False,
    full: Annotated[
        bool, option("--full", "Show the responses of all trials, even if the report becomes large.")
    ] = False,
    final: Annotated[
        Literal["expected", "measured"] | None,
        option("--final", "Final position for costs: x_0 + F_0/K, or as logged."),
    ] = None,
    momentum_delay: Annotated[
        int | None, option("--momentum-delay", "Delay of the momentum balance (6.4), in samples.", min=0)
    ] = None,
    momentum_window: Annotated[
        str | None, option("--momentum-window", "Window of the momentum balance (default: '15 ms').")
    ] = None,
) -> None:
    """Judge trials, compare them with theory, and write the report.

    With --against, two experiments, devices (in the plane of alpha and beta) or code versions are compared with each
    other on a separate page.

    Example: pipeline compare --device falcon --experiment 1 --criteria settle_2pct,overshoot
    """
    from pipeline.comparison.executors import executor_of
    from pipeline.comparison.scene.scene_file import read_scene
    from pipeline.shell.report_index import write_index
    from pipeline.store.names import page_against_document, report_of
    from pipeline.store.objects import opened

    earlier = Path(against) if against is not None and against.endswith(".json") else None
    alone = {"--dry-run": dry_run, "--full": full, "--final": final, "--momentum-window": momentum_window}
    alone["--momentum-delay"] = None if momentum_delay is None else str(momentum_delay)
    without = {"--export": export} | ({} if earlier else alone)
    if against is not None and (other := next((name for name, given in without.items() if given), None)):
        raise UsageError(
            f"--against and {other} cannot be combined, because a page that compares two experiments does not have "
            "this option. Omit one of them."
        )
    chosen = None if scene is None else read_scene(scene)
    of_file = device_of(device) if device is not None and device.endswith(".toml") else None
    name = of_file.name if of_file else device or (chosen.device if chosen else _only_device(processed))
    if save_scene is not None:
        _save_scene(name, processed, save_scene)
        return
    wanted = criteria or (chosen.chosen_criteria if chosen else None)
    names = experiment or (chosen.experiments if chosen else None)
    if against is not None and earlier is None:
        with opened(processed) as folder:
            _compare_against((name, names), against, folder, wanted, report)
        return
    target = report or (Path(chosen.report) if chosen and chosen.report else report_of(reports_folder(), name))
    if not dry_run:
        check_output(target, "--report", document_beside=True)
    compute, document = executor_of(executor), None
    shown = _shown(chosen.shown if chosen else None, final, momentum_delay, momentum_window)
    if earlier is not None:
        from pipeline.comparison.against import against_document, read_document

        # Read the document first, because the comparison may replace it.
        document = read_document(earlier, name)
    with console.progress("compare"), opened(processed, name) as folder:
        from pipeline.comparison.plan import ComparisonSelection, ReportOptions, plan_comparison

        selection = ComparisonSelection(of_file or name, folder, names, wanted, shown)
        plan = plan_comparison(selection, ReportOptions(target, full, scene, export and export / "figures"))
        result = plan.unchanged
        if result is None and not dry_run:
            from pipeline.comparison.compare import run, write_report  # slow import (half a second)

            finished = run(plan, compute)
            write_report(finished)
            result = finished.document
    if dry_run or result is None:
        stages = [row._asdict() for row in plan.stages]
        console.show(stages, console.table(stages, ("stage", "action", "reason")))
        return
    # In other folders, an existing index is updated, but no index is created.
    write_index(target.parent, only_renew=target.parent != reports_folder())
    if document is not None and earlier is not None:
        _show_against(against_document(result, document), page_against_document(target, earlier))
    else:
        _show(result, target, export)


def _only_device(processed: str) -> str:
    """Return the device of a store that contains logs of only one device. An object store is not downloaded for this
    purpose."""
    from pipeline.base.wording import listed
    from pipeline.store.objects import is_url
    from pipeline.store.storage import list_devices

    devices = None if is_url(processed) else list_devices(Path(processed))
    if devices is not None and len(devices) == 1:
        return devices[0]
    reason = "no device is given. Name it with --device or in a scene file."
    if devices:
        reason = f"no device is given, and {processed} contains {listed(devices)}. Name one of them with --device."
    elif devices is not None:
        reason = f"{processed} contains no logs. Ingest logs first: pipeline ingest LOGS --processed {processed}"
    raise typer.BadParameter(reason, param_hint="--device")


def _shown(shown: Shown | None, final: str | None, momentum_delay: int | None, momentum_window: str | None) -> Shown:
    """Return the content of a scene after applying the measurement options."""
    from pipeline.records.models import Measuring, Shown

    shown = shown or Shown()
    window = None if momentum_window is None else quantity("--momentum-window", momentum_window, "time")
    if window is not None and window <= 0:
        raise UsageError(f"--momentum-window {momentum_window}: expected a time above 0, such as '15 ms'.")
    options = {"final": final, "momentum_delay": momentum_delay, "momentum_window_s": window}
    given = {name: value for name, value in options.items() if value is not None}
    return Shown(**dict(shown) | {"measuring": Measuring(**dict(shown.measuring) | given)})


def _show(result: ComparisonResult, report: Path, export: Path | None) -> None:
    """Print the result of a comparison, and export its tables if a folder is given."""
    from pipeline.rendering.table_export import export_tables

    lines = [*result.summary, *(f"Warning: {text}" for text in result.warnings), f"report: {report}"]
    if export is not None:
        export_tables(result, export / "tables")
        lines.append(f"tables and figures: {export}")
    console.show(result.model_dump(mode="json"), lines)


def _compare_against(
    of: tuple[str, Sequence[str] | None],
    against: str,
    processed: Path,
    criteria: Sequence[str] | None,
    report: Path | None,
) -> None:
    """Compare an experiment of a device with another experiment, and print the differences."""
    from pipeline.comparison.against import against_experiments, names_of
    from pipeline.store.names import page_against
    from pipeline.store.storage import list_experiments

    device, experiments = of
    if experiments is None or len(experiments) != 1:
        raise UsageError("--against compares two experiments. Name the first one with --experiment.")
    first = (device, experiments[0])
    second = names_of(against, device, list_experiments(processed, device))
    target = report or page_against(reports_folder(), first, second)
    check_output(target, "--report", document_beside=True)
    with console.progress("compare"):
        page = against_experiments(processed, first, second, criteria)
    _show_against(page, target)


def _show_against(page: AgainstPage, report: Path) -> None:
    """Write a page of differences, and print its summary."""
    from pipeline.rendering.report.report_against import write

    result = write(page, report)
    lines = []
    for pair in result.pairs:
        lines += [f"experiment {pair.first.experiment}:"] if len(result.pairs) > 1 else []
        lines += pair.sentences
    console.show(result.model_dump(mode="json"), [*lines, f"report: {result.report}"])


def _save_scene(device: str, processed: str, path: Path) -> None:
    """Write a scene file with all stored experiments of a device, from which the user may remove entries."""
    from pipeline.base.disk import write_text
    from pipeline.comparison.scene.scene_file import draft_scene
    from pipeline.store.objects import opened

    check_output(path, "--save-scene")
    if path.exists():
        raise UsageError(f"{path}: already exists. Name another file, or remove this one.")
    with opened(processed, device) as folder:
        write_text(path, draft_scene(device, folder))
    console.show({"scene": str(path)}, [f"scene: {path}"])


def verify(
    report: Annotated[Path, argument("Report (HTML) by `pipeline compare`, or bundle (.zip).")],
    processed: Annotated[str | None, option("--processed", "Stored tables (default: those of the report).")] = None,
    profile: Annotated[list[Path] | None, option("--profile", "Profile file (.toml) of the logs. Repeatable.")] = None,
) -> int:
    """Recompute the numbers of a report, and list those that differ.

    The logs are read from their original folders or from a bundle. If a log no longer exists, its stored samples are
    used. All results are recomputed in a temporary folder, and each cell and value is compared. Values that no log
    determines, such as run times, are compared with hashes in the page. The exit status is 1 if something differs.

    Example: pipeline verify reports/falcon.html
    """
    from pipeline.shell.bundle import ENDING, verify_bundle
    from pipeline.shell.verify import lines_of
    from pipeline.shell.verify import verify as verify_report

    if report.suffix.lower() == ENDING:
        if processed or profile:
            raise UsageError(f"{report}: a bundle contains all inputs. Omit the options.")
        with console.progress("verify"):
            found = verify_bundle(report)
    else:
        with console.progress("verify"):
            found = verify_report(report, processed, profile or ())
    console.show(found.model_dump(mode="json"), lines_of(found))
    return EXIT_OK if found.equal else EXIT_ERROR


def bundle(report: Annotated[Path, argument("Report (HTML) by `pipeline compare`.")]) -> None:
    """Pack a report and all inputs of `pipeline verify` into a zip.

    The zip is written into the folder of the report.

    Example: pipeline bundle reports/falcon.html
    """
    from pipeline.shell.bundle import bundle as write

    with console.progress("bundle"):
        written = write(report)
    console.show(written.model_dump(mode="json"), [f"bundle: {written.bundle}, {written.trials} trials"])


SETTLE_S = 2.0
NICENESS = 10
"""Increment of the process niceness, because the same machine may be recording logs at 1 kHz."""

WORDS = {
    "started": "watching {folders} every {interval_s:g} s; a log is read after {settle_s:g} s without change; "
    "{processed} -> {reports}",
    "ingest": "logs: {ingested} new, {found} in total, {quarantined} in quarantine, {waiting} waiting",
    "refused": "refused: {path}, row {row}: {reason}",
    "changed": "changed: {path}: {outcome}",
    "report": "report: {report} ({trials} trials, {seconds:.1f} s)",
    "unchanged": "report: {report} is up to date",
    "index": "index: {path}",
    "failed": "failed: {what}: {reason}",
    "stopped": "stopped",
}
"""Texts of events."""


def watch(
    folders: Annotated[list[Path], argument("Folders where logs arrive.", exists=True, file_okay=False)],
    processed: Processed = Path("processed"),
    reports: Reports = Path("reports"),
    profile: ProfileFile = None,
    scene: Annotated[
        list[Path] | None, option("--scene", "Scene file (default: all devices). Repeatable.", exists=True)
    ] = None,
    settle: Annotated[str, option("--settle", "Time for which a log must stay unchanged.")] = f"{SETTLE_S:g} s",
    once: Annotated[bool, option("--once", "Make only one pass, and skip logs that may still change.")] = False,
) -> int:
    """Keep reports and the index up to date while logs arrive.

    Only reports whose logs changed are written again. A refused log goes into quarantine, and the watch continues. No
    data are lost if the command is killed, because the next start does the remaining work. With --json, each line is a
    document. With --once, the exit status is 1 if something failed, and 3 if logs are in quarantine.

    Example: pipeline watch raw

    Example: pipeline watch raw --once --processed processed --reports reports
    """
    from pipeline.shell.watch import Watched, follow, run_pass, status_of

    settle_s = quantity("--settle", settle, "time")
    if not 0 <= settle_s < inf:
        raise UsageError(f"--settle {settle}: expected a time of 0 s or more.")
    watched = Watched(tuple(folders), processed, reports, profile, tuple(scene or ()), settle_s)
    if once:
        events = []
        for event in run_pass(watched):
            events.append(event)
            _show_event(event)
        return status_of(events)
    os.nice(NICENESS)
    try:
        for event in follow(watched, settle_s or SETTLE_S):
            _show_event(event)
    except Ended:
        _show_event({"event": "stopped"})
    return 0


def _show_event(event: Event) -> None:
    """Print an event with its time (UTC), without buffering."""
    now = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    console.show_line({"time": now, **event}, [f"{now} {line_of(event)}".replace("\n", " ")])


def line_of(event: Event) -> str:
    """Return the text of an event, with the number of waiting files instead of their names."""
    shown = {name: len(value) if name == "waiting" else value for name, value in event.items()}
    return WORDS[event["event"]].format(**shown)
