"""The command that compares and writes reports: parse, call, print."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipeline.base.errors import UsageError
from pipeline.base.paths import check_output
from pipeline.shell import console
from pipeline.shell.commands import cli_theory
from pipeline.shell.commands.options import Criteria, ExecutorName, Experiments, Json, Store

if TYPE_CHECKING:
    from pipeline.rendering.report.report_against import AgainstPage


def compare(
    device: Annotated[
        str | None, typer.Option("--device", help="Device whose logs are compared; may stand in the scene file.")
    ] = None,
    experiment: Experiments = None,
    criteria: Criteria = None,
    processed: Store = "processed",
    executor: ExecutorName = "local",
    report: Annotated[
        Path | None,
        typer.Option("--report", help="HTML file; reports/DEVICE.html where not given.", show_default=False),
    ] = None,
    scene: Annotated[
        Path | None,
        typer.Option("--scene", help="Scene file (.toml): what the report shows. Options given here come first."),
    ] = None,
    tables_format: Annotated[
        list[str] | None,
        typer.Option(
            "--tables-format", help="Write the tables beside the report, too: csv, json, markdown, latex, with commas."
        ),
    ] = None,
    figures: Annotated[
        Path | None,
        typer.Option("--figures", help="Write the figures as SVG, PDF and CSV files into this folder, too."),
    ] = None,
    against: Annotated[
        str | None,
        typer.Option("--against", help="Compare against EXPERIMENT, DEVICE:EXPERIMENT, or an earlier report (.json)."),
    ] = None,
    save_scene: Annotated[
        Path | None,
        typer.Option("--save-scene", help="Write a scene file of all that is stored of the device, nothing else."),
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what would be done and why, do nothing.")] = False,
    full: Annotated[
        bool, typer.Option("--full", help="Put the response of every trial into the page, whatever its size.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Estimate, judge and compare with theory; write the report.

    With --against two experiments, devices (in the plane of alpha and beta) or code versions are compared with each
    other, on a page of their own.

    Example: pipeline compare --device falcon --experiment 1 --criteria settle_2pct,overshoot
    """
    from pipeline.comparison.against import against_document, read_document
    from pipeline.comparison.compare import compare as compare_device
    from pipeline.comparison.executors import executor_of
    from pipeline.comparison.scene.scene_file import read_scene
    from pipeline.rendering.table_export import export_tables, parse_formats, tables_folder
    from pipeline.shell.report_index import write_index
    from pipeline.store.names import page_against_document, report_of
    from pipeline.store.objects import opened

    earlier = Path(against) if against is not None and against.endswith(".json") else None
    two = against is not None and earlier is None
    if two:
        _refuse(dry_run=dry_run, full=full)
    if against is not None:
        _refuse(tables_format=tables_format is not None, figures=figures is not None)
    asked = None if scene is None else read_scene(scene)
    name = device or (asked.device if asked else None)
    if name is None:
        raise typer.BadParameter("no device is given. Name it here, or in a scene file.", param_hint="--device")
    if save_scene is not None:
        _save_scene(name, processed, save_scene)
        return
    formats = parse_formats(tables_format or ())
    wanted = cli_theory.split(criteria) if criteria is not None else asked.chosen_criteria if asked else None
    names = experiment or (asked.experiments if asked else None)
    if against is not None and two:
        with opened(processed) as folder:
            _compare_against((name, names), against, folder, wanted, report, as_json)
        return
    computes = executor_of(executor)
    drawn = Path(asked.report) if asked and asked.report else report_of(Path("reports"), name)
    target = report or drawn
    if not dry_run:
        check_output(target, "--report", document_beside=True)
    # read before the comparison, which may replace it
    document = None if earlier is None else read_document(earlier, name)
    with opened(processed, name) as folder:
        outcome = compare_device(
            name,
            folder,
            experiments=names,
            criteria=wanted,
            report=target,
            dry_run=dry_run,
            full=full,
            shown=asked.shown if asked else None,
            scene_file=scene,
            progress=None if as_json else console.note,
            executor=computes,
            figures=figures,
        )
    if outcome.result is None:
        stages = [dict(zip(("stage", "action", "reason"), row, strict=True)) for row in outcome.stages]
        if as_json:
            console.print_json(stages)
            return
        for line in console.table(stages, ("stage", "action", "reason")):
            console.say(line)
        return
    # other folders may be anybody's: there an index is kept current, but not begun
    write_index(target.parent, only_renew=target.parent != Path("reports"))
    if document is not None and earlier is not None:
        _print_against(against_document(outcome.result, document), page_against_document(target, earlier), as_json)
        return
    written = export_tables(outcome.result, tables_folder(target), formats) if formats else ()
    if as_json:
        console.print_json(outcome.result.model_dump(mode="json"))
        return
    for line in (*outcome.result.summary, *(f"Warning: {text}" for text in outcome.result.warnings)):
        console.say(line)
    if outcome.report is not None:
        console.say(f"report: {outcome.report}")
    if written:
        console.say(f"tables: {len(written)} files in {tables_folder(target)}")
    if figures is not None:
        console.say(f"figures: {figures}")


def _compare_against(
    of: tuple[str, Sequence[str] | None],
    against: str,
    processed: Path,
    criteria: Sequence[str] | None,
    report: Path | None,
    as_json: bool,
) -> None:
    """Compare the experiment of a device with another one, and print what differs."""
    from pipeline.comparison.against import against_experiments, names_of
    from pipeline.store.names import page_against
    from pipeline.store.storage import list_experiments

    device, experiments = of
    if experiments is None or len(experiments) != 1:
        raise UsageError("--against compares one experiment with another one. Name the first with --experiment.")
    (first,) = experiments
    second = names_of(against, device, list_experiments(processed, device))
    target = report or page_against(Path("reports"), (device, first), second)
    check_output(target, "--report", document_beside=True)
    progress = None if as_json else console.note
    page = against_experiments(processed, (device, first), second, criteria, progress)
    _print_against(page, target, as_json)


def _refuse(**others: bool) -> None:
    """Refuse options that --against would leave without effect."""
    for other, given in others.items():
        if given:
            raise UsageError(
                f"--against and --{other.replace('_', '-')} do not go together: the page of two experiments knows no "
                "such choice. Leave one of them out."
            )


def _print_against(page: AgainstPage, report: Path, as_json: bool) -> None:
    """Write a page of differences, and print what it comes to."""
    from pipeline.rendering.report.report_against import write

    result = write(page, report)
    if as_json:
        console.print_json(result.model_dump(mode="json"))
        return
    for pair in result.pairs:
        if len(result.pairs) > 1:
            console.say(f"experiment {pair.first.experiment}:")
        for line in pair.sentences:
            console.say(line)
    console.say(f"report: {result.report}")


def _save_scene(device: str, processed: str, path: Path) -> None:
    """Write a scene file with all that is stored of a device, to be shortened."""
    from pipeline.base.disk import write_text
    from pipeline.comparison.scene.scene_file import draft_scene
    from pipeline.store.objects import opened

    check_output(path, "--save-scene")
    if path.exists():
        raise UsageError(f"{path}: exists. Give another file, or remove it.")
    with opened(processed, device) as folder:
        write_text(path, draft_scene(device, folder))
    console.say(f"scene: {path}")
