"""Draw numbers over experiments (trends, and costs over delay) and columns of a log over time.

Source: Hulin 2017, Fig. 6.12 (costs over delay).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.records.criteria import criterion_of
from pipeline.records.models import ComparisonRow
from pipeline.records.results import ChangeCode, ComparisonResult, ExperimentNumbers
from pipeline.records.trials import Floats
from pipeline.rendering.figures.drawing import LOOKS, Figure, Panel, Series, around
from pipeline.rendering.frames import frames
from pipeline.rendering.labels import (
    CHANGES,
    UNITS,
    criterion_label,
    percent_text,
    printed_scale,
    quantity_name,
    shortened,
    significant,
    unit_text,
    with_unit,
)
from pipeline.rendering.table import is_sweep, records

MOST_POINTS = 1600
"""Largest number of points of a line. If there are more rows, only the minimum and maximum in each pixel are drawn."""


def trend_figure(result: ComparisonResult) -> list[Figure]:
    """Return the figure of limits and estimates over experiments.

    It is absent if no header line differs between them.
    """
    rows = records(frames(result)["trend"])
    if not rows:
        return []
    panels = []
    for quantity in dict.fromkeys(row["quantity"] for row in rows):
        own = [row for row in rows if row["quantity"] == quantity]
        value, low, high = (np.array([row[name] for row in own], dtype=np.float64) for name in ("value", "low", "high"))
        place, bound = np.arange(len(own), dtype=np.float64), np.array([bool(row["bound"]) for row in own])
        name = f"{quantity_name(quantity)} [{unit_text(own[0]['unit'])}]"
        series = [Series("at least", "bound", place[bound], value[bound], number=0)] if bound.any() else []
        x, y, lowest, highest = (each[~bound] for each in (place, value, low, high))
        series.insert(0, Series("value, 95 % interval", "estimate", x, y, lowest, highest, along="y"))
        ticks = tuple(f"{row['experiment']}\n{shortened(row['line'].partition(': ')[2], 12)}" for row in own)
        values = "; ".join(f"experiment {row['experiment']}: {significant(row['value'], 3)}" for row in own)
        limits = (-0.5, len(own) - 0.5), around(value, low, high)
        panels.append(
            Panel(name, ("", name), tuple(series), f"{name} over experiments: {values}.", limits, ticks=ticks)
        )
    caption = f"Values with their 95 % intervals. Each has its header line ({rows[0]['line'].partition(':')[0]}) below."
    title = "Limits and estimates over the experiments"
    return [Figure("trend", "trend", title, caption, tuple(panels), size=(350.0, 250.0))]


def replay_figure(result: ComparisonResult) -> list[Figure]:
    """Return the figure of the identified loops' residuals over K and B of all replayed walls, if there was a
    replay."""
    residuals = {e.experiment: e.replay.residuals for e in result.experiments if e.replay and e.replay.residuals}
    residuals = {name: of for name, of in residuals.items() if of.percent}
    if not residuals:
        return []
    units, number = UNITS[result.motion], [e.experiment for e in result.experiments].index
    percent = np.array([value for of in residuals.values() for value in of.percent])
    described = (
        f"experiment {name}: median {significant(float(np.median(of.percent)), 2)} %, "
        f"largest {significant(max(of.percent), 2)} %"
        for name, of in residuals.items()
    )
    words, top = f"Residuals of the loop at the walls: {'; '.join(described)}.", 1.05 * float(percent.max()) or 1.0
    panels = []
    for name, unit in (("stiffness", f"K [{units.stiffness}]"), ("damping", f"B [{units.damping}]")):
        walls = {e: np.array(getattr(of, name)) for e, of in residuals.items()}
        series = tuple(
            Series(f"experiment {e}", "residual", at, np.array(residuals[e].percent), number=number(e))
            for e, at in walls.items()
        )
        limits = around(*walls.values()), (0.0, top)
        panels.append(Panel(f"over {name}", (f"{name} {unit}", "residual [%]"), series, words, limits))
    caption = (
        "Logged minus predicted position, relative to the logged motion, at every stable wall. The loop is fitted "
        "without this wall. Residuals are large where a part is missing from the loop, or where friction scatters and "
        "the motion is small."
    )
    title = "Residuals of the identified loop at all walls"
    return [Figure("response", "replay", title, caption, tuple(panels), size=(350.0, 250.0))]


def sensitivity_figure(results: Sequence[ExperimentNumbers]) -> list[Figure]:
    """Return the bar chart of what limits each device, if a loop was identified.

    A bar is the change in the largest stable stiffness due to one sample less of delay, or without a part of the loop.
    """
    known = [(number, e) for number, e in enumerate(results) if e.sensitivities]
    codes = [code for code in CHANGES if any(code == each.code for _, e in known for each in e.sensitivities)]
    if not codes:
        return []
    series, words, values = [], [], []
    for place, (number, e) in enumerate(known):
        percent = {each.code: each.percent for each in e.sensitivities}
        x = np.array([codes.index(code) for code in percent], dtype=np.float64)
        y = np.array([*percent.values()])
        width = LOOKS["bar"]["bar"] / len(known)
        x += width * (place - 0.5 * (len(known) - 1))
        label = f"{'_' if len(known) == 1 else ''}experiment {e.experiment}"  # one experiment needs no legend
        series.append(Series(label, "bar", x, y, number=number, bars=len(known)))
        values.append(y)
        texts = ", ".join(f"{_changed(code)} {percent_text(p)} %" for code, p in percent.items())
        words.append(f"experiment {e.experiment}: {texts}")
    ticks = tuple(_changed(code, "\n") for code in codes)
    name = "change of largest K [%]"
    panel = Panel(
        "",
        ("", name),
        tuple(series),
        f"Changes in the largest stable stiffness. {'; '.join(words)}.",
        ((-0.6, len(codes) - 0.4), around(np.zeros(1), *values)),
        ticks=ticks,
    )
    caption = (
        "Change in the largest stable stiffness of the identified loop due to one sample less of delay, or without one "
        "of its parts. A part with a positive bar limits the device; a part with a negative bar keeps it stable."
    )
    return [
        Figure("boundaries", "boundaries-sensitivity", "What limits the device", caption, (panel,), size=(560.0, 260.0))
    ]


def _changed(code: ChangeCode, space: str = " ") -> str:
    """Describe a change to a loop in words. The line may be broken at the ``space``."""
    return f"a sample less{space}of delay" if code == "delay" else f"without{space}{CHANGES[code]}"


def delay_figure(rows: Sequence[ComparisonRow]) -> list[Figure]:
    """Return theoretical and experimental optimal costs over total delay, for each table that is a sweep."""
    figures: list[Figure] = []
    for table in dict.fromkeys(row.table for row in rows):
        own = [row for row in rows if row.table == table and row.delay_samples is not None and row.cost is not None]
        if not is_sweep([dict(row) for row in own]):
            continue
        panels = []
        for criterion in dict.fromkeys(row.criterion for row in own):
            of = sorted((row for row in own if row.criterion == criterion), key=lambda row: row.delay_samples or 0.0)
            scale, series = printed_scale(criterion), []
            for label, kind, points in _over_delay(of):
                x, y = np.array(points, dtype=np.float64).T if points else (np.empty(0), np.empty(0))
                series += [Series(label, kind, x, y * scale)] if points else []
            costs = "; ".join(
                f"{s.label} {', '.join(f'd = {x:g}: {y:.3g}' for x, y in zip(s.x, s.y, strict=True))}" for s in series
            )
            top = 1.05 * max(float(s.y.max()) for s in series)
            name, words = criterion_label(criterion), f"Optimal cost over delay: {costs}."
            limits = None, (0.0, top or 1.0)
            axes = "total delay d [samples]", with_unit("optimal cost", criterion_of(criterion).family.printed_unit)
            panels.append(Panel(name, axes, tuple(series), words, limits))
        caption = (
            "Costs of the sampled response at the optimum, theory and experiment, as in Fig. 6.12. The additional "
            "cost of theory at the tested walls is no error of theory, because its optimum lies between them."
        )
        if any(row.condition == "theory_damped" for row in own):
            caption += " Dashed: theory with the damping that the logs show in place of the device file's."
        else:
            caption += " A dashed curve for another damping is drawn only if the logs show one."
        if any(row.published_cost is not None for row in own if not row.condition.startswith("theory")):
            caption += " Circles: costs in the thesis, measured on the real device; they do not depend on these logs."
        name, title = f"delay{len(figures) or ''}", "Optimal costs over delay"
        figures.append(Figure("delay", name, title, caption, tuple(panels), size=(440.0, 300.0)))
    return figures


def _over_delay(rows: Sequence[ComparisonRow]) -> Iterator[tuple[str, str, list[tuple[float, float]]]]:
    """Yield label, kind and points (delay, cost) of each series.

    The series are theory, theory on the tested walls, experiment, published values, and theory with the measured
    damping.
    """
    theory = {row.delay_samples or 0.0: row.cost or 0.0 for row in rows if row.condition == "theory_discrete"}
    measured = [row for row in rows if not row.condition.startswith("theory")]
    tested, printed = [], []
    for row in measured:
        delay, parts = row.delay_samples or 0.0, row.deviation
        if parts is not None and delay in theory:
            tested.append((delay, theory[delay] * (1 + parts.range / 100) * (1 + parts.grid / 100)))
        if row.published_cost is not None:
            printed.append((delay, row.published_cost))
    yield "theory", "line", list(theory.items())
    yield "theory on the tested walls", "linear", tested
    yield "experiment", "optimum", [(row.delay_samples or 0.0, row.cost or 0.0) for row in measured]
    yield "printed in the thesis", "mark", printed
    damped = [(row.delay_samples or 0.0, row.cost or 0.0) for row in rows if row.condition == "theory_damped"]
    yield "theory, measured damping", "theory", damped


@dataclass(frozen=True, eq=False)
class RecordedColumn:
    """A raw column of a log over time [s] or row number.

    Parameters
    ----------
    name, unit : str
        Name and unit of the column. The unit is empty if it is unknown.
    place, values : float64, shape (rows,)
    jumps : tuple of int
        Rows at which the value jumps.
    rests : tuple of (int, int)
        First row of each rest, and the row after its last.
    gaps : tuple of int
        Rows before which rows are missing.
    step_row : int or None
        Row of the step, if known.
    """

    name: str
    unit: str
    place: Floats
    values: Floats
    jumps: tuple[int, ...]
    rests: tuple[tuple[int, int], ...]
    gaps: tuple[int, ...]
    step_row: int | None = None

    @property
    def words(self) -> str:
        """Findings in the column as a sentence."""
        found = [] if self.step_row is None else [f"step in row {self.step_row}"]
        found += [f"jumps in row {', '.join(map(str, self.jumps))}"] if self.jumps else []
        found += [f"rests in rows {', '.join(f'{a} to {b - 1}' for a, b in self.rests)}"] if self.rests else []
        found += [f"rows missing before row {', '.join(map(str, self.gaps))}"] if self.gaps else []
        return f"{self.name}: {'; '.join(found) or 'no jump, rest or gap'}."


def recorded_figure(identifier: str, title: str, columns: Sequence[RecordedColumn], abscissa: str) -> Figure:
    """Return a figure of the columns of a log over an abscissa, with one panel per column."""
    panels = []
    for c in columns:
        at, label = c.place, f"{c.name} [{c.unit}]" if c.unit else c.name
        series = [Series("_rest", "span", at[[a, b - 1]], np.zeros(2)) for a, b in c.rests]
        series += [Series("_gap", "gap", at[[row - 1, row]], np.zeros(2)) for row in c.gaps]
        series.append(Series(f"_{c.name}", "log", *thinned(at, c.values)))
        rows, limits = list(c.jumps), around(c.values)
        series += [Series("_jump", "mark", at[rows], c.values[rows])] if rows else []
        series += (
            [Series("_step", "final", np.full(2, at[c.step_row]), np.array(limits))] if c.step_row is not None else []
        )
        panels.append(Panel(label, (abscissa, ""), tuple(series), c.words, (None, limits)))
    return Figure("response", identifier, title, "", tuple(panels), size=(880.0, 190.0))


def thinned(place: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Return a line of at most `MOST_POINTS` points that looks like the given line.

    It consists of the minimum and the maximum of each part, in order.
    """
    parts = MOST_POINTS // 2
    each = len(values) // parts
    if each <= 2:
        return place, values
    whole = values[: each * parts].reshape(parts, each)
    blank = np.isnan(whole)
    least, largest = np.where(blank, np.inf, whole).argmin(axis=1), np.where(blank, -np.inf, whole).argmax(axis=1)
    rows = (np.sort(np.stack([least, largest], axis=1), axis=1) + each * np.arange(parts)[:, None]).ravel()
    rows = np.append(rows, np.arange(each * parts, len(values)))
    return place[rows], values[rows]
