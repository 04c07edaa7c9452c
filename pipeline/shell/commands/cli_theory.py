"""Commands of theory and of its accuracy: parse, call, print. Without a device parameters are normalised."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pipeline.base.errors import DeviceError, ParameterError
from pipeline.base.paths import check_output
from pipeline.shell import console
from pipeline.shell.commands.options import PROCESSED, Criteria, One, Signal, Store, device_of, reports_folder
from pipeline.shell.console import argument, option

if TYPE_CHECKING:
    from pipeline.theory.cases import Case

Delay = Annotated[float | None, option("--delay", "Delay d in samples, at most 256.", show_default=False)]
OfDevice = Annotated[str | None, option("--device", "Device (name or file) in SI; replaces the above.")]
Gamma = Annotated[float, option("--gamma", "Normalised stiffness of the device itself.")]
Delta = Annotated[float, option("--delta", "Normalised viscous damping of the device itself.")]


def points(
    cases: Annotated[Path, argument("CSV: alpha, beta, gamma, delta, delay; or stiffness, damping.", metavar="CSV")],
    criteria: Criteria = None,
    device: OfDevice = None,
    experiment: One = None,
) -> None:
    """Compute stability and costs of the points in a CSV file.

    With --device, columns are stiffness and damping.

    Example: pipeline theory points cases.csv --json
    """
    from pipeline.theory import cases as theory

    names = tuple(criteria or theory.POINT_COSTS)
    columns = theory.CASE_COLUMNS if device is None else theory.WALL_COLUMNS
    found, said = theory.read_cases(cases, columns), {}
    if device is None:
        documents = theory.case_documents(found, names)
    else:
        case = _case(None, 0.0, 0.0, device, experiment)
        documents, said = theory.point_documents(case, found.values, names), case.said
    shown = names if criteria else ("settle_2pct", "overshoot", "energy_step_w0")
    lines = console.table(documents, (*columns, "stable", "spectral_radius", *shown, "reason"))
    console.tell(documents, [*lines, *_beside(said)])


def boundary(
    delay: Delay = None,
    gamma: Gamma = 0.0,
    delta: Delta = 0.0,
    device: OfDevice = None,
    experiment: One = None,
) -> None:
    """Compute the stability boundary and its extreme points.

    Example: pipeline theory boundary --delay 2 --gamma 0.001 --delta 0.02 --json
    """
    from pipeline.theory.cases import boundary_document

    case = _case(delay, gamma, delta, device, experiment)
    document = boundary_document(case)
    console.tell(document, _boundary_lines(document, case.axes))


def _boundary_lines(document: dict[str, Any], axes: tuple[str, str]) -> Iterator[str]:
    if "device" in document:
        yield f"device {document['device']}, experiment {document['experiment']}"
    for first, second in (axes, axes[::-1]):
        if (most := document.get(f"{first}_max")) is not None:
            yield f"largest {first} {most:.6g} at {second} {document[f'{second}_at_{first}_max']:.6g}"
    if document.get("islands"):
        yield f"stable stretches beyond the limit: {len(document['islands'])}"
    yield from _beside(document)
    yield f"({len(document[axes[0]])} points along the boundary: --json)"


def _beside(document: dict[str, Any]) -> Iterator[str]:
    """Yield what a document of a device says beside its numbers: a delay that jitters, and what is left out."""
    if document.get("delay_samples_low") != document.get("delay_samples_high"):
        low, high = document["delay_samples_low"], document["delay_samples_high"]
        yield f"delay {document['delay_samples']:.4g} samples, the mean of one that jitters from {low:g} to {high:g}"
    if document.get("left_out"):
        yield f"left out of linear theory: {', '.join(document['left_out'])}"


def optimum(
    criterion: Annotated[str, option("--criterion", "Such as settle_2pct or energy_impulse_w1.")],
    delay: Delay = None,
    gamma: Gamma = 0.0,
    delta: Delta = 0.0,
    device: OfDevice = None,
    experiment: One = None,
    signal: Annotated[Signal | None, option("--signal", "Response (default: the criterion's).")] = None,
) -> None:
    """Compute the optimal stiffness and damping for a criterion.

    Example: pipeline theory optimum --criterion settle_2pct --delay 1 --signal discrete --json
    """
    from pipeline.theory.cases import optimum_document

    case = _case(delay, gamma, delta, device, experiment)
    document = optimum_document(case, criterion, signal)
    cost = "" if document["cost"] is None else f", cost {document['cost']:.6g}"
    wall = ", ".join(f"{name} {document[name]:.6g}" for name in case.axes)
    words = [document[name] for name in ("reason", "note") if document.get(name)]
    console.tell(document, [f"{document['criterion']}: {wall}{cost}", *words, *_beside(document)])


def cost_map(
    out: Annotated[Path, option("--out", "Parquet file to write.", show_default=False)],
    delay: Delay = None,
    gamma: Gamma = 0.0,
    delta: Delta = 0.0,
    size: Annotated[int, option("--size", "Grid points along each axis.")] = 251,
    criteria: Criteria = None,
) -> None:
    """Compute costs on a grid over the stable region, as Parquet.

    In SI, for a device: `Loop.map` in Python.

    Example: pipeline theory map --delay 1 --criteria settle_2pct,energy_step_w0 --out map.parquet
    """
    from pipeline.theory.costs import MAP_DEFAULT, CostMap, write_map

    check_output(out, "--out")
    made = CostMap(_case(delay, gamma, delta, None, None).loop, size, tuple(criteria or MAP_DEFAULT))
    with console.progress("map", "points") as advance:
        stable = write_map(out, made, advance)
    columns = ["alpha", "beta", "stable", *made.names]
    lines = [f"{out}: {size**2} points, {stable} of them stable, columns {columns}"]
    console.tell({"file": str(out), "rows": size**2, "stable": stable}, lines)


def explore(
    device: Annotated[
        str | None, option("--device", "Device: name or file (.toml); default: all shipped ones.")
    ] = None,
    experiment: One = None,
    out: Annotated[
        Path | None, option("--out", "HTML file to write (default: explore.html).", show_default=False)
    ] = None,
    module: Annotated[
        Path | None, option("--module", "Write the computation alone, as .mjs.", show_default=False)
    ] = None,
    processed: Store = "processed",
) -> None:
    """Write one HTML page with sliders for the theory of a loop.

    Where reports/DEVICE.json has a comparison, its identified loop, trials, limits and wall are in the page.

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
    console.tell({"files": [str(path) for path in written]}, [f"{path} written" for path in written])


def _entries(device: str | None, experiment: str | None, processed: str) -> list[dict[str, Any]]:
    """Return what the page of `explore` begins with: what was measured first, then the device file, then others."""
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
    chosen = (
        known if experiment is None else known.model_copy(update={"experiments": (find_experiment(known, experiment),)})
    )
    return [*measured, *device_entries([chosen], ", by its device file" if measured else "")]


def _measured_entries(device: str, experiment: str | None, processed: str) -> list[dict[str, Any]]:
    """Return the experiments of a stored comparison with their trials; none where there is no report."""
    from pipeline.base.errors import PipelineError
    from pipeline.explorer.entries import measured_entries, with_trials
    from pipeline.surface.comparisons import load
    from pipeline.surface.stored import costs

    document = reports_folder() / f"{Path(device).stem}.json"
    if not document.is_file():
        return []
    result = load(document).result
    kept = tuple(each for each in result.experiments if experiment in (None, each.experiment))
    entries = measured_entries(result.model_copy(update={"experiments": kept}))
    for i, entry in enumerate(entries):
        try:
            rows = costs(processed, result.device, entry["experiment"])
        except PipelineError:  # without the stored trials those at the limits are shown
            continue
        rows = rows[rows["verdict"].isin(["stable", "unstable"])].drop_duplicates("trial_id")
        entries[i] = with_trials(
            entry, list(zip(rows["stiffness"], rows["damping"], rows["verdict"] == "stable", strict=True))
        )
    return entries


def tables(
    table: Annotated[list[str] | None, argument("Such as B.1, C.3, 5.1(a) (default: all).")] = None,
) -> None:
    """Compute Tables B.1 to B.4, C.1 to C.3 and 5.1 of the thesis anew.

    Example: pipeline theory tables C.1 C.2
    """
    from pipeline.device_data.published import THEORY_TABLES
    from pipeline.studies import thesis_tables as theory

    rows: list[theory.TheoryRow] = []
    lines: list[str] = []
    for name, count, of_table in theory.recomputed_tables(table or THEORY_TABLES):
        found = []
        with console.progress(f"Table {name}", "rows") as advance:
            for row in of_table:
                found.append(row)
                advance(len(found), count)
        rows += found
        lines += theory.table_lines(name, found, console.table)
    console.tell(theory.document(rows), [*lines, theory.summary_line(rows)])


def accuracy(
    quick: Annotated[bool, option("--quick", "Take fewer settings and repetitions: seconds.")] = False,
) -> None:
    """Measure error against run time of each numerical method.

    Writes accuracy.html and accuracy.json into the folder of reports. Reports of comparisons show the part on theory
    while code and machine are unchanged (stored in processed, or where PIPELINE_PROCESSED says).

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
    console.tell(document, [*lines, f"report: {out}"])


def _case(delay: float | None, gamma: float, delta: float, device: str | None, experiment: str | None) -> Case:
    """Return the loop of numbers, or of a device by name or file."""
    from pipeline.theory.cases import Case, case_of

    if device is not None:
        from pipeline.device_data.devices import find_experiment

        known = device_of(device)
        return case_of(known, find_experiment(known, experiment) if experiment else known.experiments[0])
    if delay is None:
        raise ParameterError("expected --delay, or --device for the loop of a device file.")
    from pipeline.loop.normalised_loop import NormalisedLoop

    return Case(NormalisedLoop.ideal(gamma, delta, delay))
