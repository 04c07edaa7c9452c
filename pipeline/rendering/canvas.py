"""What the figures of a report share: size, axes with their ticks, and the ranges that panels have in common.

Ticks and grid are drawn as one path each. The library's own axes make every tick an object: two thirds of the time
of a figure, and half of its size.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import IdentityTransform

from pipeline.records.batch import Floats
from pipeline.records.figure_records import CostMap, Curve
from pipeline.records.models import Motion
from pipeline.rendering import style
from pipeline.rendering.labels import KILO_ABOVE, UNITS, shortened

DOTS_PER_INCH = 72.0
MARGIN = 1.06
"""Space beyond the largest value on an axis."""
TICK = 3.0
"""Length of a tick [px]."""
LABEL_OF_ORDINATE = 44.0
"""Distance of the ordinate's label from its axis [px]: room for tick labels of four digits."""
LABEL_OF_ABSCISSA = 32.0
"""Distance of the abscissa's label from its axis [px]."""
TITLE_LETTER = 6.6
"""Mean width of a letter in a title [px]; longer titles, as of experiments with long names, are cut."""
ROUNDING = 1e-9
"""Error, relative to the step, up to which a tick counts as the round number that it stands for."""


@contextmanager
def drawing_of(width: float, height: float) -> Iterator[Figure]:
    """Yield an empty figure of a size in pixels, drawn and saved with the settings of `style`."""
    with matplotlib.rc_context({**style.RC, "axes.grid": False}):
        yield Figure(figsize=(width / DOTS_PER_INCH, height / DOTS_PER_INCH), dpi=DOTS_PER_INCH)


def add_axes(drawing: Figure, left: float, bottom: float, right: float, top: float) -> Axes:
    """Add axes with margins in pixels, without ticks; a layout engine would take longer than the drawing."""
    width, height = drawing.get_size_inches() * DOTS_PER_INCH
    axes = drawing.add_axes(
        (left / width, bottom / height, (width - left - right) / width, (height - bottom - top) / height)
    )
    axes.set_axis_off()
    return axes


def wipe(drawing: Figure) -> None:
    """Take everything off the axes of a figure, whose next panel is drawn on them: making axes takes longer."""
    for axes in drawing.axes:
        for collection in list(axes.collections):
            collection.remove()  # contour lines, with the labels that belong to them
        for artist in (*axes.lines, *axes.patches, *axes.texts, *axes.artists):
            artist.remove()
    for legend in drawing.legends[:]:
        legend.remove()


def frame(
    axes: Axes,
    x_label: str,
    y_label: str,
    *,
    x_ticks: int = 6,
    y_ticks: int = 6,
    title: str = "",
    whole: bool = False,
    numbers: bool = True,
) -> None:
    """Draw grid, axes, ticks and their numbers; the limits of the axes are set before.

    Parameters
    ----------
    axes : matplotlib.axes.Axes
    x_label, y_label : str
        Quantity and unit.
    x_ticks, y_ticks : int
        Largest number of intervals.
    title : str
        Name of the panel, above its left corner.
    whole : bool
        Whether the abscissa counts in whole numbers.
    numbers : bool
        Whether the abscissa has numbers; not where the panel below has the same axis.
    """
    box = axes.bbox
    x = _ticks(axes.get_xlim(), x_ticks, whole=whole)
    y = _ticks(axes.get_ylim(), y_ticks)
    at_x = axes.transData.transform(np.column_stack([x, np.zeros(len(x))]))[:, 0]
    at_y = axes.transData.transform(np.column_stack([np.zeros(len(y)), y]))[:, 1]
    grid = [*_lines(at_x, box.y0, box.y1), *_lines(at_y, box.x0, box.x1, across=True)]
    rule = [[(box.x0, box.y1), (box.x0, box.y0), (box.x1, box.y0)]]
    rule += [*_lines(at_x, box.y0, box.y0 - TICK), *_lines(at_y, box.x0, box.x0 - TICK, across=True)]
    _draw(axes, grid, style.FAINT, 0.6, 0.5)
    _draw(axes, rule, style.INK, 0.8, 2.5)
    look: dict[str, Any] = {"transform": IdentityTransform(), "fontsize": 10.0}
    for place, text in zip(at_y, _numbers(y), strict=True):
        axes.text(box.x0 - 6.5, place, text, ha="right", va="center_baseline", **look)
    for place, text in zip(at_x, _numbers(x), strict=True) if numbers else ():
        axes.text(place, box.y0 - 7.0, text, ha="center", va="top", **look)
    look["fontsize"] = 11.0
    if y_label:
        middle = (box.y0 + box.y1) / 2
        axes.text(box.x0 - LABEL_OF_ORDINATE, middle, y_label, rotation=90, ha="center", va="center", **look)
    if x_label:
        axes.text((box.x0 + box.x1) / 2, box.y0 - LABEL_OF_ABSCISSA, x_label, ha="center", va="baseline", **look)
    if title:
        title = shortened(title, int(box.width / TITLE_LETTER))
        axes.text(box.x0, box.y1 + 6.0, title, ha="left", va="baseline", **look)


def _ticks(limits: tuple[float, float], intervals: int, *, whole: bool = False) -> Floats:
    locator = MaxNLocator(intervals, steps=style.TICK_STEPS, integer=whole)
    found = np.asarray(locator.tick_values(*limits), dtype=np.float64)
    low, high = float(limits[0]), float(limits[1])
    room = ROUNDING * (high - low)
    return found[(found >= low - room) & (found <= high + room)]


def _numbers(ticks: Floats) -> list[str]:
    """Return ticks as text, with as many decimals as the finest of them needs."""
    step = float(np.diff(ticks).min()) if len(ticks) > 1 else 1.0
    decimals = next(n for n in range(16) if n == 15 or np.allclose(ticks, np.round(ticks, n), rtol=0, atol=1e-6 * step))
    return [f"{value + 0.0:.{decimals}f}".replace("-", "\N{MINUS SIGN}") for value in np.round(ticks, decimals)]


def _lines(places: Floats, start: float, end: float, *, across: bool = False) -> list[list[tuple[float, float]]]:
    """Return lines that stand at places of the abscissa, or lie at places of the ordinate."""
    if across:
        return [[(start, y), (end, y)] for y in places.tolist()]
    return [[(x, start), (x, end)] for x in places.tolist()]


def _draw(axes: Axes, lines: Sequence[Sequence[tuple[float, float]]], colour: str, width: float, order: float) -> None:
    if lines:
        path = Path.make_compound_path(*(Path(line) for line in lines))
        look: dict[str, Any] = {"fill": False, "edgecolor": colour, "lw": width, "zorder": order}
        axes.add_artist(PathPatch(path, transform=IdentityTransform(), clip_on=False, **look))


def reach(curves: Sequence[Curve], maps: Sequence[CostMap] = ()) -> tuple[float, float, float]:
    """Return the largest stiffness, lowest and largest damping of all curves and trials, for shared axes."""
    stiffness = [c.stiffness for c in curves] + [m.trial_stiffness for m in maps]
    damping = [c.damping for c in curves if c.kind != "linear"] + [m.trial_damping for m in maps]
    if not any(np.isfinite(part).any() for part in stiffness):  # no boundary: the grids are all there is
        stiffness, damping = [m.stiffness for m in maps], [m.damping for m in maps]
    k = np.concatenate([*stiffness, np.zeros(1)])
    b = np.concatenate([*damping, np.zeros(1)])
    k, b = k[np.isfinite(k)], b[np.isfinite(b)]
    return float(k.max() * MARGIN or 1.0), float(b.min() * MARGIN), float(b.max() * MARGIN or 1.0)


def plane(axes: Axes, limits: tuple[float, float, float]) -> float:
    """Set up axes of stiffness and damping by the result of `reach`; return the factor from SI to its abscissa."""
    largest, lowest, highest = limits
    scale = 1e-3 if largest > KILO_ABOVE else 1.0
    axes.set_xlim(0, largest * scale)
    axes.set_ylim(lowest, highest)
    return scale


def stiffness_label(motion: Motion, scale: float) -> str:
    """Return quantity and unit of the stiffness axis."""
    return f"stiffness K [{'k' if scale < 1 else ''}{UNITS[motion].stiffness}]"


def damping_label(motion: Motion) -> str:
    """Return quantity and unit of the damping axis."""
    return f"damping B [{UNITS[motion].damping}]"
