"""The columns of a log, one below the other, with the step, rests, jumps and gaps that were found in them."""

from __future__ import annotations

from functools import partial

import numpy as np
from matplotlib.axes import Axes

from pipeline.records.batch import Floats
from pipeline.records.figure_records import Figure, RecordedColumn
from pipeline.rendering.figures import canvas, style
from pipeline.rendering.figures.shown import Panel

SIZE = (880.0, 190.0)
MARGINS = [(76.0, 44.0, 14.0, 26.0)]

MOST_POINTS = 1600
"""Points of a line; of more rows the least and the largest of each pixel are drawn."""


def recorded(figure: Figure[RecordedColumn], abscissa: str) -> tuple[Panel, ...]:
    """Draw the columns of a log over an abscissa, each by itself."""
    return canvas.draw_panels(figure, SIZE, MARGINS, partial(_column, abscissa=abscissa))


def _column(shown: RecordedColumn, axes: Axes, *, abscissa: str) -> tuple[str, str]:
    known = np.isfinite(shown.values)
    at = shown.place[known]
    low, high = (float(f(shown.values[known])) for f in (np.min, np.max)) if known.any() else (0.0, 1.0)
    room = 0.06 * (high - low) or 1.0
    axes.set_xlim(float(at[0]) if len(at) else 0.0, float(at[-1]) if len(at) > 1 else 1.0)
    axes.set_ylim(low - room, high + room)
    for first, end in shown.rests:
        axes.axvspan(shown.place[first], shown.place[end - 1], color=style.SKY, alpha=0.3, lw=0)
    for row in shown.gaps:
        axes.axvspan(shown.place[row - 1], shown.place[row], color=style.VERMILLION, alpha=0.5, lw=0)
    axes.plot(*thinned(shown.place, shown.values), color=style.BLUE, lw=1.0)
    rows = list(shown.jumps)
    axes.plot(shown.place[rows], shown.values[rows], "o", ms=6, mfc=style.VERMILLION, mew=0)
    if shown.step_row is not None:
        axes.axvline(shown.place[shown.step_row], color=style.INK, lw=0.9, ls=style.LINES["linear"])
    label = f"{shown.name} [{shown.unit}]" if shown.unit else shown.name
    canvas.frame(axes, abscissa, "", x_ticks=10, y_ticks=4, title=label)
    return f": {shown.name}", words(shown)


def words(shown: RecordedColumn) -> str:
    """Return what was found in a column as a sentence."""
    found = []
    if shown.step_row is not None:
        found.append(f"step in row {shown.step_row}")
    if shown.jumps:
        found.append(f"jumps in row {', '.join(map(str, shown.jumps))}")
    if shown.rests:
        found.append(f"rests in rows {', '.join(f'{first} to {end - 1}' for first, end in shown.rests)}")
    if shown.gaps:
        found.append(f"rows missing before row {', '.join(map(str, shown.gaps))}")
    return f"{shown.name}: {'; '.join(found) or 'no jump, rest or gap'}."


def thinned(place: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Return a line with at most `MOST_POINTS` points that looks the same: least and largest of each part, in order."""
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
