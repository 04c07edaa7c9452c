"""Recompute the theoretical rows of Tables D.1 to D.6, and the deviations of the printed measurements from theory.

No logs are needed. The marks are those of `pipeline.studies.thesis_tables`.

Source: Hulin 2017, appendix D.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from pipeline.base.errors import ParameterError
from pipeline.device.loop import Loop
from pipeline.device_data.devices import load_device
from pipeline.device_data.published import (
    PrintedNumber,
    PublishedRow,
    published_deviation,
    published_rows,
)
from pipeline.loop.normalised_loop import LoopUnits, NormalisedLoop
from pipeline.records.criteria import DISCRETE, criterion_of
from pipeline.rendering.labels import significant
from pipeline.studies.thesis_tables import SIGNS, Entry, mark_of
from pipeline.theory.optimum import optimal_point
from pipeline.theory.search import OptimalPoint

DECIMALS = {"stiffness": 0, "damping": 2, "cost": 2}
"""Number of printed decimals in Tables D.1 to D.5. In Table D.6 it depends on the costs."""


@dataclass(frozen=True)
class PrintedOptimum:
    """A row of Tables D.1 to D.6.

    Parameters
    ----------
    table, device, criterion, condition : str
        As in `pipeline.device_data.published.PublishedRow`.
    delay : float
        Total delay [samples].
    entries : tuple of Entry
        For theory, each printed number with the computed number. Empty for a measurement.
    printed : dict
        All printed numbers of the row: stiffness [N/m, Nm/rad], damping [Ns/m, Nms/rad], cost (overshoot in %).
    deviation_percent : float or None
        For a measurement, the deviation of its printed cost from the cost by discrete theory. None if the theoretical
        cost is 0.
    """

    table: str
    device: str
    criterion: str
    condition: str
    delay: float
    entries: tuple[Entry, ...]
    printed: dict[str, str]
    deviation_percent: float | None


def printed_optima(table: str) -> tuple[int, Iterator[PrintedOptimum]]:
    """Return the number of rows of a table, and an iterator over the rows, which are computed one by one.

    Examples
    --------
    >>> count, rows = printed_optima("D.2")
    >>> measured = [row for row in rows if row.condition == "experiment_1" and row.criterion == "energy_step_w2"]
    >>> count, round(measured[0].deviation_percent, 1)
    (12, -45.4)
    """
    rows = [row for row in published_rows() if row.table == table]
    return len(rows), map(_recomputed, rows)


def _recomputed(row: PublishedRow) -> PrintedOptimum:
    loop, printed = _published_loop(row), _printed(row)
    entries: tuple[Entry, ...] = ()
    if row.is_theory:
        name = f"{row.criterion}{DISCRETE}" if row.condition == "theory_discrete" else row.criterion
        values = _in_si(optimal_point(NormalisedLoop.of(loop), name), LoopUnits.of(loop), row.criterion)
        entries = tuple(_entry(name, text, values[name], row.erratum) for name, text in printed.items())
    about = (row.table, row.device, row.criterion, row.condition, loop.delay_samples)
    return PrintedOptimum(*about, entries, printed, published_deviation(row))


def _published_loop(row: PublishedRow) -> Loop:
    """Return the loop for the theory of a table. Table D.6 has a loop for each delay."""
    device = load_device(row.device)
    layout = next(table for table in device.tables if table.name == row.table)
    for experiment in device.experiments:
        leads = experiment.name == layout.theory_from if row.delay_samples is None else False
        if leads or (row.delay_samples is not None and experiment.delay_samples == row.delay_samples):
            return device.loop_for(experiment)
    raise ParameterError(f"device {row.device!r} has no experiment for Table {row.table}.")


def _printed(row: PublishedRow) -> dict[str, str]:
    """Return the numbers of a row with their printed digits."""
    scale = criterion_of(row.criterion).family.scale
    values = {"stiffness": row.stiffness, "damping": row.damping, "cost": row.cost * scale}
    if row.delay_samples is not None:
        return {"cost": f"{row.cost:g}"}
    return {name: f"{value:.{DECIMALS[name]}f}" for name, value in values.items() if value is not None}


def _in_si(point: OptimalPoint, units: LoopUnits, criterion: str) -> dict[str, float]:
    cost = point.cost * criterion_of(criterion).family.scale
    return {"stiffness": point.alpha * units.stiffness, "damping": point.beta * units.damping, "cost": cost}


def _entry(name: str, text: str, computed: float, erratum: str | None) -> Entry:
    mark, tolerance = mark_of(computed, PrintedNumber(text))
    if mark != "unexplained":
        return Entry(name, text, computed, mark, tolerance)
    return Entry(name, text, computed, "erratum" if erratum else mark, reason=erratum)


def optima_lines(table: str, rows: Sequence[PrintedOptimum], align: Callable[..., list[str]]) -> list[str]:
    """Return a table as aligned lines, followed by the reasons for marked numbers and an empty line."""
    names = [name for name in DECIMALS if any(name in row.printed for row in rows)]
    columns = ["criterion", "condition", "d", *(c for n in names for c in (n, f"{n} printed")), "deviation %"]
    lines = [f"Table {table}", *align([_cells(row, names) for row in rows], columns)]
    for row in rows:
        for reason in dict.fromkeys(entry.reason for entry in row.entries if entry.reason):
            lines.append(f"  {row.criterion}, {row.condition}, d = {row.delay:g}: {reason}")
    return [*lines, ""]


def _cells(row: PrintedOptimum, names: Sequence[str]) -> dict[str, str]:
    off = "" if row.deviation_percent is None else f"{row.deviation_percent:+.1f}"
    cells = {"criterion": row.criterion, "condition": row.condition, "d": f"{row.delay:g}", "deviation %": off}
    computed = {entry.name: f"{significant(entry.computed, 7)}{SIGNS[entry.mark]}" for entry in row.entries}
    for name in names:
        cells |= {name: computed.get(name, ""), f"{name} printed": row.printed.get(name, "")}
    return cells
