"""Commands for theory and its accuracy. Without a device, the parameters are normalised."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from pipeline.base.errors import DeviceError, ParameterError, UsageError
from pipeline.base.json_object import JsonObject
from pipeline.base.paths import check_output
from pipeline.shell import console
from pipeline.shell.commands.options import (
    PROCESSED,
    Criteria,
    One,
    Signal,
    Store,
    device_of,
    reports_folder,
    stiffness_of,
)
from pipeline.shell.console import argument, option

if TYPE_CHECKING:
    from pipeline.explorer.entries import Entry
    from pipeline.theory.cases import Boundary, Case, Optimum

Row = TypeVar("Row")

Delay = Annotated[float | None, option("--delay", "Delay d in samples, at most 256.", show_default=False)]
OfDevice = Annotated[
    str | None, option("--device", "Device (name or file), in SI. It replaces the normalised options above.")
]
Gamma = Annotated[float, option("--gamma", "Normalised stiffness of the device.")]
Delta = Annotated[float, option("--delta", "Normalised viscous damping of the device.")]
Rows = Annotated[Path | None, option("--out", "File for the rows: .csv or .parquet.", show_default=False)]
Picture = Annotated[Path | None, option("--picture", "Picture to draw: .svg, .pdf or .png.", show_default=False)]


def points(
    cases: Annotated[Path, argument("CSV: alpha, beta, gamma, delta, delay; or stiffness, damping.", metavar="CSV")],
    criteria: Criteria = None,
    device: OfDevice = None,
    experiment: One = None,
    out: Rows = None,
    picture: Picture = None,
) -> None:
    """Compute stability and costs of the points in a CSV file.

    With --device, the columns are stiffness and damping. The picture shows points of one loop and its stability limit.

    Example: pipeline theory points cases.csv --out costs.csv --picture points.svg
    """
    from pipeline.shell.points_file import read_cases
    from pipeline.theory import cases as theory

    _check_files(out, picture)
    names = tuple(criteria or theory.POINT_COSTS)
    columns = theory.CASE_COLUMNS if device is None else theory.WALL_COLUMNS
    rows = read_cases(cases, columns)
    if device is None:
        answer, case = theory.costs_of_cases(rows, names), theory.one_case(rows) if picture else None
    else:
        case = _case(None, 0.0, 0.0, device, experiment)
        answer = theory.costs_of_walls(case, rows.values, names)
    files = []
    if out is not None:
        files += _rows_file(out, answer.columns(), case)
    if picture is not None and case is not None:
        from pipeline.rendering.theory_files import draw_walls, limit_series, point_series

        draw_walls(picture, "Stability of walls", case, [limit_series(case), *point_series(answer)])
        files += _written(picture, "picture")
    shown = names if criteria else ("settle_2pct", "overshoot", "energy_step_w0")
    document = answer.to_json()
    lines = console.table(document, (*columns, "stable", "spectral_radius", *shown, "reason"))
    console.show(document, [*lines, *_beside({} if device is None or case is None else case.loop_entries), *files])


def boundary(
    delay: Delay = None,
    gamma: Gamma = 0.0,
    delta: Delta = 0.0,
    device: OfDevice = None,
    experiment: One = None,
    robust: Annotated[bool, option("--robust", "Walls that are stable with any spring at the device.")] = False,
    out: Rows = None,
    picture: Picture = None,
) -> None:
    """Compute the stability boundary and its extreme points.

    With --robust, compute the boundary of the walls that stay stable with any spring attached to the device.

    Example: pipeline theory boundary --delay 2 --gamma 0.001 --delta 0.02 --json

    Example: pipeline theory boundary --device falcon --out limit.csv --picture limit.svg
    """
    from pipeline.theory.cases import limits_of_walls, robust_boundary

    _check_files(out, picture)
    case = _case(delay, gamma, delta, device, experiment)
    answer = robust_boundary(case) if robust else limits_of_walls(case)
    files = [] if out is None else _rows_file(out, answer.columns(), case)
    if picture is not None:
        from pipeline.rendering.theory_files import draw_walls, limit_series, robust_series

        series = [limit_series(case), *([robust_series(answer)] if robust else [])]
        draw_walls(picture, "Walls that are stable with any spring" if robust else "Limit of stability", case, series)
        files += _written(picture, "picture")
    console.show(answer.to_json(), [*_boundary_lines(answer), *files])


_SHOWN_POINTS = 9
"""Number of printed points of a boundary."""

_ROUNDING = 1e-12
"""Threshold below which a number is printed as 0, relative to the largest number of its column."""


def _boundary_lines(answer: Boundary) -> Iterator[str]:
    facts, axes = answer.case.loop_entries, answer.case.axes
    if "device" in facts:
        yield f"device {facts['device']}, experiment {facts['experiment']}"
    columns = answer.columns()
    count = len(columns[axes[0]])
    some = sorted({round(i * (count - 1) / (_SHOWN_POINTS - 1)) for i in range(_SHOWN_POINTS)}) if count else []
    extremes = ((f"largest {axes[0]}", answer.stiffest), (f"largest {axes[1]}", answer.most_damped))
    walls = [(name, wall) for name, wall in extremes if wall is not None]
    walls += [("limit", (columns[axes[0]][i], columns[axes[1]][i])) for i in some]
    tops = [max(abs(wall[place]) for _, wall in walls) for place in (0, 1)] if walls else []
    rows = [
        {"point": name}
        | {k: v if abs(v) > _ROUNDING * top else 0.0 for k, v, top in zip(axes, wall, tops, strict=True)}
        for name, wall in walls
    ]
    yield from console.table(rows, ("point", *axes))
    if answer.case.units is not None and len(answer.islands):
        yield f"stable intervals beyond the limit: {len(answer.islands)}"
    yield from _beside(facts)
    yield f"({count} points along the boundary; use --out FILE or --json)"


def _beside(facts: JsonObject) -> Iterator[str]:
    """Yield remarks on a device: a delay that jitters, and parts that the theory does not include."""
    if facts.get("delay_samples_low") != facts.get("delay_samples_high"):
        low, high = facts["delay_samples_low"], facts["delay_samples_high"]
        yield (
            f"the delay of {facts['delay_samples']:.4g} samples is the mean of a delay that jitters from {low:g} to "
            f"{high:g}"
        )
    if facts.get("left_out"):
        yield f"parts not included in linear theory: {', '.join(facts['left_out'])}"


def optimum(
    criterion: Annotated[str, option("--criterion", "Criterion, such as settle_2pct or energy_impulse_w1.")],
    delay: Delay = None,
    gamma: Gamma = 0.0,
    delta: Delta = 0.0,
    device: OfDevice = None,
    experiment: One = None,
    signal: Annotated[Signal | None, option("--signal", "Response (default: the response of the criterion).")] = None,
    stiffness: Annotated[
        str | None, option("--stiffness", "Stiffness of the wall, '5 N/mm' (alpha without --device).")
    ] = None,
    out: Rows = None,
    picture: Picture = None,
) -> None:
    """Compute the optimal stiffness and damping for a criterion.

    With --stiffness, compute the best damping for this stiffness, and the damping by the rules for continuous time
    (5.17).

    Example: pipeline theory optimum --criterion settle_2pct --delay 1 --signal discrete --json

    Example: pipeline theory optimum --criterion overshoot --device falcon --picture optimum.png

    Example: pipeline theory optimum --criterion settle_2pct --device falcon --stiffness '3 N/mm'
    """
    from pipeline.theory.cases import best_damping_for, best_wall, criterion_for

    _check_files(out, picture)
    case = _case(delay, gamma, delta, device, experiment)
    if stiffness is not None:
        if picture is not None:
            raise UsageError("--picture cannot be combined with --stiffness. Omit one of them.")
        given = stiffness_of(stiffness, case.motion)
        best = best_damping_for(case, criterion_for(criterion, signal), given)
        document, files = best.to_json(), [] if out is None else _rows_file(out, best.columns(), case)
        k, b = case.axes
        columns = ("criterion", k, b, "cost", f"critical_{b}", f"amplitude_optimal_{b}")
        words = [best.reason] if best.reason else []
        console.show(document, [*console.table([document], columns), *words, *_beside(case.loop_entries), *files])
        return
    with console.progress("optimum"):
        answer = best_wall(case, criterion, signal)
    files = [] if out is None else _rows_file(out, answer.columns(), case)
    if picture is not None:
        from pipeline.rendering.theory_files import draw_walls, limit_series, optimum_series

        draw_walls(picture, f"Optimum of {answer.criterion}", case, [limit_series(case), optimum_series(answer)])
        files += _written(picture, "picture")
    document = answer.to_json()
    lines = console.table([document], ("criterion", *case.axes, "cost"))
    words = [text for text in (answer.reason, answer.note, _reachable_line(answer)) if text]
    console.show(document, [*lines, *words, *_beside(case.loop_entries), *files])


def _reachable_line(answer: Optimum) -> str:
    """Return a sentence with the smallest cost that the delay allows, and the reduction for one sample less of
    delay."""
    from pipeline.records.criteria import criterion_of

    best = answer.reachable
    if best is None:
        return ""
    unit = " samples" if criterion_of(best.criterion).family.unit == "samples" else ""
    return (
        f"with this delay, the cost of every wall is at least about {best.cost:.4g}{unit}, without damping of the "
        f"device (5.19, within {100 * best.within:.2g} %); one sample less of delay saves {best.per_sample:.3g}{unit}"
    )


def _check_files(out: Path | None, picture: Path | None) -> None:
    if out is not None or picture is not None:
        from pipeline.rendering.theory_files import check_files

        check_files(out, picture)


def _rows_file(out: Path, columns: dict[str, list[Any]], case: Case | None) -> list[str]:
    """Write columns to a file, and return the lines to print about this file."""
    from pipeline.rendering.theory_files import write_rows

    write_rows(out, columns, case)
    return _written(out, f"{len(next(iter(columns.values())))} rows")


def _written(path: Path, what: str) -> list[str]:
    return [f"{path}: {what}"]


def cost_map(
    out: Annotated[Path, option("--out", "Parquet file to write.", show_default=False)],
    delay: Delay = None,
    gamma: Gamma = 0.0,
    delta: Delta = 0.0,
    size: Annotated[int, option("--size", "Grid points along each axis.")] = 251,
    criteria: Criteria = None,
) -> None:
    """Compute costs on a grid over the stable region, as Parquet.

    For a device in SI, use `Loop.map` in Python.

    Example: pipeline theory map --delay 1 --criteria settle_2pct,energy_step_w0 --out map.parquet
    """
    from pipeline.rendering.map_file import write_map
    from pipeline.theory.costs import MAP_DEFAULT, CostMap

    check_output(out, "--out")
    made = CostMap(_case(delay, gamma, delta, None, None).loop, size, tuple(criteria or MAP_DEFAULT))
    with console.progress("map", "points") as advance:
        stable = write_map(out, made, advance)
    answer = {"file": str(out), "stable": stable, **made.to_json()}
    console.show(answer, [f"{out}: {size**2} points, {stable} of them stable, columns {answer['columns']}"])


def explore(
    device: Annotated[
        str | None, option("--device", "Device: name or file (.toml); default: all shipped devices.")
    ] = None,
    experiment: One = None,
    out: Annotated[
        Path | None, option("--out", "HTML file to write (default: explore.html).", show_default=False)
    ] = None,
    module: Annotated[
        Path | None, option("--module", "Write only the computation, as a module (.mjs).", show_default=False)
    ] = None,
    processed: Store = "processed",
) -> None:
    """Write an HTML page with sliders for the theory of a loop.

    If reports/DEVICE.json contains a comparison, the page includes the identified loop, trials, limits and best wall of
    this comparison.

    Example: pipeline explore --device falcon --experiment 1 --out falcon-explore.html

    Example: pipeline explore --module loop.mjs
    """
    from pipeline.base.disk import write_text
    from pipeline.explorer import page

    written = []
    if module is not None:
        check_output(module, "--module")
        write_text(module, page.module())
        written.append(module)
    if module is None or out is not None or device is not None:
        target = Path("explore.html") if out is None else out
        check_output(target, "--out")
        write_text(target, page.page(_entries(device, experiment, processed)))
        written.append(target)
    console.show({"files": [str(path) for path in written]}, [f"{path} written" for path in written])


def _entries(device: str | None, experiment: str | None, processed: str) -> list[Entry]:
    """Return the entries of the `explore` page: first measured experiments, then the device file, then other
    devices."""
    from pipeline.device.parameters import drive_of
    from pipeline.device_data.devices import find_experiment, known_devices
    from pipeline.explorer.entries import device_entries

    if device is None:
        return device_entries(known_devices().values())
    measured = _measured_entries(device, experiment, processed)
    try:
        known = device_of(device)
    except DeviceError:
        if not measured:
            raise
        return measured
    if drive := drive_of(known.motion):
        raise DeviceError(
            f"device {known.name!r}: its commands are in {drive}, but the page computes with forces or torques. State "
            "the gain of the drive when the logs are read (--gain '2.3 N/V', or [units] gain in a profile)."
        )
    if experiment is not None:
        find_experiment(known, experiment)
    return [*measured, *device_entries([known], ", by its device file" if measured else "", experiment)]


def _measured_entries(device: str, experiment: str | None, processed: str) -> list[Entry]:
    """Return the experiments of a stored comparison with their trials. The list is empty if there is no report."""
    from pipeline.base.errors import PipelineError
    from pipeline.explorer.entries import measured_entries, with_trials
    from pipeline.surface.comparisons import load
    from pipeline.surface.stored import costs

    document = reports_folder() / f"{Path(device).stem}.json"
    if not document.is_file():
        return []
    result = load(document).result
    entries = measured_entries(result, experiment)
    for i, entry in enumerate(entries):
        try:
            rows = costs(processed, result.device, entry["experiment"])
        except PipelineError:  # without stored trials, only trials at the limits are shown
            continue
        rows = rows[rows["verdict"].isin(["stable", "unstable"])].drop_duplicates("trial_id")
        entries[i] = with_trials(
            entry, list(zip(rows["stiffness"], rows["damping"], rows["verdict"] == "stable", strict=True))
        )
    return entries


def tables(
    table: Annotated[list[str] | None, argument("Tables such as B.1, C.3, 5.1(a), D.2 (default: all).")] = None,
) -> None:
    """Recompute Tables B, C, D and 5.1 of the thesis.

    The theoretical rows of Tables D are recomputed. The printed measurements are listed with their deviations from
    theory.

    Example: pipeline theory tables C.1 D.6
    """
    from dataclasses import asdict

    from pipeline.device_data.published import MEASURED_TABLES, THEORY_TABLES
    from pipeline.studies import thesis_tables as theory
    from pipeline.studies.printed_optima import optima_lines, printed_optima

    rows: list[theory.TheoryRow] = []
    optima: list[JsonObject] = []
    lines: list[str] = []
    known = (*THEORY_TABLES, *MEASURED_TABLES)
    if unknown := [name for name in table or () if name not in known]:
        raise ParameterError(f"table {unknown[0]!r} is unknown; expected one of {', '.join(known)}.")
    for name in table or known:
        if name in MEASURED_TABLES:
            found = list(_shown(name, *printed_optima(name)))
            lines += optima_lines(name, found, console.table)
            optima += [asdict(row) for row in found]
            continue
        for _, count, of_table in theory.recomputed_tables([name]):
            of_theory = list(_shown(name, count, of_table))
            lines += theory.table_lines(name, of_theory, console.table)
            rows += of_theory
    document = theory.document(rows)
    document["rows"] += optima
    console.show(document, [*lines, *([theory.summary_line(rows)] if rows else [])])


def _shown(table: str, count: int, rows: Iterator[Row]) -> Iterator[Row]:
    """Yield the rows of a table, and show progress."""
    with console.progress(f"Table {table}", "rows") as advance:
        for number, row in enumerate(rows, start=1):
            yield row
            advance(number, count)


def accuracy(
    quick: Annotated[
        bool, option("--quick", "Use fewer settings and repetitions, so that the run takes only seconds.")
    ] = False,
) -> None:
    """Measure the error and the run time of each numerical method.

    The command writes accuracy.html and accuracy.json into the folder of reports. Reports of comparisons show the part
    on theory as long as the code and the machine are unchanged. The results are stored in processed, or in
    PIPELINE_PROCESSED.

    Example: pipeline accuracy --quick
    """
    from pipeline.base.disk import write_text
    from pipeline.records import accuracy as results
    from pipeline.studies.accuracy import run

    out = reports_folder() / "accuracy.html"
    check_output(out, "", document_beside=True)
    report = run.measure(quick, console.step)
    document, machine = report.model_dump(mode="json"), report.machine
    write_text(out, run.render(report))
    write_text(out.with_suffix(".json"), report.model_dump_json(indent=1) + "\n")
    results.store(report, Path(os.environ.get(PROCESSED, "processed")))
    lines = console.table(run.summary_rows(report), ("quantity", "error", "time", "other", "other time"))
    lines.append(f"{machine['processor']}, Python {machine['python']}, numpy {machine['numpy']}")
    console.show(document, [*lines, f"report: {out}"])


def _case(delay: float | None, gamma: float, delta: float, device: str | None, experiment: str | None) -> Case:
    """Return the loop of normalised numbers, or the loop of a device with the given name or file."""
    from pipeline.theory.cases import Case, case_of

    if device is not None:
        from pipeline.device_data.devices import find_experiment

        known = device_of(device)
        return case_of(known, find_experiment(known, experiment))
    if delay is None:
        raise ParameterError("expected --delay, or --device for the loop of a device file.")
    from pipeline.loop.normalised_loop import NormalisedLoop

    return Case(NormalisedLoop.ideal(gamma, delta, delay))
