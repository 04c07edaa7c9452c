"""Commands of `pipeline theory`: parse, call, print. Parameters are normalised (T = 1, m = 1)."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipeline.base.errors import ParameterError, UsageError
from pipeline.base.paths import check_output
from pipeline.shell import console
from pipeline.shell.commands.options import Criteria, Json

if TYPE_CHECKING:
    from pipeline.theory.cases import Case

app = typer.Typer(
    no_args_is_help=True,
    help="Stability boundary, costs and optimal points of the sampled, delayed loop. Parameters are normalised "
    "by sampling period T and mass m: alpha = K T^2/m, beta = B T/m, gamma = k T^2/m, delta = b T/m. "
    "With --device all is in SI, for the loop of a device file with its filter, lag, mode and operator.",
)

Delay = Annotated[
    float | None,
    typer.Option("--delay", help="Delay d in samples, integer or fractional, at most 256.", show_default=False),
]
OfDevice = Annotated[
    str | None,
    typer.Option(
        "--device", help="Name of a device or its TOML file, in place of --delay, --gamma, --delta: all is then in SI."
    ),
]
OfExperiment = Annotated[
    str | None, typer.Option("--experiment", help="Experiment of the device; its first where not given.")
]
Gamma = Annotated[float, typer.Option("--gamma", help="Normalised stiffness of the device itself.")]
Delta = Annotated[float, typer.Option("--delta", help="Normalised viscous damping of the device itself.")]


class Signal(StrEnum):
    """Which response a cost is taken from."""

    continuous = "continuous"
    discrete = "discrete"


@app.command("points")
def points(
    cases: Annotated[
        Path,
        typer.Argument(
            help="CSV file with the columns alpha, beta, gamma, delta, delay; with --device stiffness, damping.",
            metavar="CSV",
        ),
    ],
    criteria: Criteria = None,
    device: OfDevice = None,
    experiment: OfExperiment = None,
    as_json: Json = False,
) -> None:
    """Compute stability and costs of the points in a CSV file.

    Example: pipeline theory points cases.csv --json
    """
    from pipeline.theory import cases as theory

    names = theory.POINT_COSTS if criteria is None else split(criteria)
    columns = theory.CASE_COLUMNS if device is None else theory.WALL_COLUMNS
    found = theory.read_cases(cases, columns)
    if device is None:
        documents = theory.case_documents(found, names)
    else:
        documents = theory.point_documents(_case(None, 0.0, 0.0, device, experiment), found.values, names)
    if as_json:
        console.print_json(documents)
        return
    shown = ("settle_2pct", "overshoot", "energy_step_w0") if criteria is None else names
    for line in console.table(documents, (*columns, "stable", "spectral_radius", *shown, "reason")):
        console.say(line)


@app.command("boundary")
def boundary(
    delay: Delay = None,
    gamma: Gamma = 0.0,
    delta: Delta = 0.0,
    device: OfDevice = None,
    experiment: OfExperiment = None,
    robust: Annotated[
        bool, typer.Option("--robust", help="Also the region that is stable with every spring, whatever --gamma says.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Compute the stability boundary and its extreme points.

    Example: pipeline theory boundary --delay 2 --gamma 0.001 --delta 0.02 --json

    Example: pipeline theory boundary --delay 1 --delta 0.02 --robust --json
    """
    if device is not None and robust:
        raise UsageError("--robust is of the normalised loop. Give --delay and --delta in place of --device.")
    from pipeline.theory.cases import boundary_document

    case = _case(delay, gamma, delta, device, experiment)
    document = boundary_document(case, robust)
    if as_json:
        console.print_json(document)
        return
    if device is not None:
        console.say(f"device {document['device']}, experiment {document['experiment']}")
    for first, second in (case.axes, case.axes[::-1]):
        if document.get(f"{first}_max") is not None:
            at = f"{document[f'{first}_max']:.6g} at {second} {document[f'{second}_at_{first}_max']:.6g}"
            console.say(f"largest {first} {at}")
    if robust:
        largest = max(document["robust"]["alpha"], default=None)
        console.say("no wall is stable with every spring" if largest is None else f"with every spring {largest:.6g}")
    if document.get("islands"):
        console.say(f"stable stretches beyond the limit: {len(document['islands'])}")
    if document.get("left_out"):
        console.say(f"left out of linear theory: {', '.join(document['left_out'])}")
    console.say(f"({len(document[case.axes[0]])} points along the boundary: --json)")


@app.command("optimum")
def optimum(
    criterion: Annotated[
        str,
        typer.Option(
            "--criterion",
            help="Such as settle_2pct, pole_radius, energy_impulse_w1; a wrong one lists all.",
            show_default=False,
        ),
    ],
    delay: Delay = None,
    gamma: Gamma = 0.0,
    delta: Delta = 0.0,
    device: OfDevice = None,
    experiment: OfExperiment = None,
    signal: Annotated[
        Signal | None,
        typer.Option("--signal", help="Response that is judged; as the criterion's name says where not given."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Compute the optimal stiffness and damping for a criterion.

    Example: pipeline theory optimum --criterion settle_2pct --delay 1 --signal discrete --json
    """
    from pipeline.theory.cases import optimum_document

    case = _case(delay, gamma, delta, device, experiment)
    document = optimum_document(case, criterion, signal.value if signal else None)
    if as_json:
        console.print_json(document)
        return
    cost = "" if document["cost"] is None else f", cost {document['cost']:.6g}"
    wall = ", ".join(f"{name} {document[name]:.6g}" for name in case.axes)
    console.say(f"{document['criterion']}: {wall}{cost}")


@app.command("map")
def cost_map(
    out: Annotated[Path, typer.Option("--out", help="Parquet file to write.", show_default=False)],
    delay: Delay = None,
    gamma: Gamma = 0.0,
    delta: Delta = 0.0,
    device: OfDevice = None,
    experiment: OfExperiment = None,
    size: Annotated[int, typer.Option("--size", help="Grid points along each axis.")] = 251,
    criteria: Annotated[
        str | None,
        typer.Option(
            "--criteria",
            help="Separated by commas; settle_2pct, overshoot and energy_step_w0..2 where not given.",
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Compute costs on a grid over the stable region, as Parquet.

    Example: pipeline theory map --delay 1 --criteria settle_2pct,energy_step_w0 --out map.parquet
    """
    from pipeline.theory.costs import MAP_DEFAULT, CostMap, write_map

    check_output(out, "--out")
    names = MAP_DEFAULT if criteria is None else split(criteria)
    case = _case(delay, gamma, delta, device, experiment)
    cost_map = CostMap(case.loop, size, names, units=case.units)
    with console.progress("map", "points", silent=as_json) as advance:
        stable = write_map(out, cost_map, advance)
    if as_json:
        console.print_json({"file": str(out), "rows": size**2, "stable": stable})
        return
    columns = [*cost_map.axes, "stable", *cost_map.names]
    console.say(f"{out}: {size**2} points, {stable} of them stable, columns {columns}")


@app.command("tables")
def tables(
    table: Annotated[
        list[str] | None, typer.Argument(help="Such as B.1, C.3, 5.1(a); all where none is given.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Compute Tables B.1 to B.4, C.1 to C.3 and 5.1 of the thesis anew.

    Example: pipeline theory tables C.1 C.2
    """
    from pipeline.device_data.published_theory import THEORY_TABLES
    from pipeline.studies import thesis_tables as theory

    rows: list[theory.TheoryRow] = []
    for name, count, of_table in theory.recomputed_tables(table or THEORY_TABLES):
        found = []
        with console.progress(f"Table {name}", "rows", silent=as_json) as advance:
            for row in of_table:
                found.append(row)
                advance(len(found), count)
        rows += found
        if not as_json:
            for line in theory.table_lines(name, found, console.table):
                console.say(line)
    if as_json:
        console.print_json(theory.document(rows))
        return
    console.say(theory.summary_line(rows))


def _case(delay: float | None, gamma: float, delta: float, device: str | None, experiment: str | None) -> Case:
    """Return the loop of numbers, or of a device by name or file."""
    from pipeline.theory.cases import Case, case_of

    if device is not None:
        from pipeline.device_data.devices import find_experiment, load_device, read_device

        known = read_device(Path(device)) if device.endswith(".toml") else load_device(device)
        return case_of(known, find_experiment(known, experiment) if experiment else known.experiments[0])
    if delay is None:
        raise ParameterError("expected --delay, or --device for the loop of a device file.")
    from pipeline.loop.loop import Loop

    return Case(Loop(gamma, delta, delay))


def split(text: str) -> tuple[str, ...]:
    """Return the words between commas; an empty word is kept, so that its reader refuses it."""
    return tuple(word.strip() for word in text.split(","))
