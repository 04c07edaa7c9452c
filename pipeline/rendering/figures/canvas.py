"""What the figures of a report share: size, axes with their ticks, and the ranges that panels have in common.

Ticks and grid are drawn as one path each. The library's own axes make every tick an object: two thirds of the time
of a figure, and half of its size.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.markers import TICKDOWN, TICKLEFT
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import IdentityTransform

from pipeline.records.batch import Floats
from pipeline.records.figure_records import CostMap, Curve
from pipeline.records.figure_records import Figure as Content
from pipeline.records.models import Motion
from pipeline.rendering.figures import style
from pipeline.rendering.figures.shown import Panel, forget, name_axes, shown_on
from pipeline.rendering.labels import UNITS, shortened

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


def draw_panels(
    figure: Content[Any],
    size: tuple[float, float],
    margins: Sequence[tuple[float, float, float, float]],
    paint: Callable[..., tuple[str, str]],
) -> tuple[Panel, ...]:
    """Draw the panels of a figure one after the other on the same axes; return one ``<svg>`` each, with its numbers.

    Parameters
    ----------
    figure : Figure
    size : tuple of float
        Width and height [px].
    margins : sequence of (left, bottom, right, top)
        Of each of the axes [px].
    paint : callable
        Draws a panel, its first argument, on the axes that follow; returns its name and what it shows in words.
    """
    drawn = []
    with drawing_of(*size) as drawing:
        all_axes = [add_axes(drawing, *sides) for sides in margins]
        for index, panel in enumerate(figure.panels):
            name, text = paint(panel, *all_axes)
            names = f"{figure.identifier}-{index}", f"{figure.title}{name}", text
            shown = shown_on(drawing, name)
            drawn.append(Panel(style.svg(drawing, *names, simulated=figure.simulated), shown))
            _wipe(drawing)
    return tuple(drawn)


def _wipe(drawing: Figure) -> None:
    """Take everything off the axes of a figure, whose next panel is drawn on them: making axes takes longer."""
    for axes in drawing.axes:
        forget(axes)
        for collection in list(axes.collections):
            collection.remove()  # contour lines, with the labels that belong to them
        for artist in (*axes.lines, *axes.patches, *axes.texts, *axes.artists, *filter(None, [axes.get_legend()])):
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
    name_axes(axes, x_label, y_label or title)
    x = _ticks(axes.get_xlim(), x_ticks, whole=whole)
    y = _ticks(axes.get_ylim(), y_ticks)
    at_x = axes.transData.transform(np.column_stack([x, np.zeros(len(x))]))[:, 0]
    at_y = axes.transData.transform(np.column_stack([np.zeros(len(y)), y]))[:, 1]
    along_x, along_y = axes.get_xaxis_transform(), axes.get_yaxis_transform()
    grid: dict[str, Any] = {"colors": style.FAINT, "lw": 0.6, "zorder": 0.5, "clip_on": False}
    axes.vlines(x, 0, 1, transform=along_x, **grid)
    axes.hlines(y, 0, 1, transform=along_y, **grid)
    rule: dict[str, Any] = {"color": style.INK, "lw": 0.8, "zorder": 2.5, "clip_on": False}
    axes.plot([0, 0, 1], [1, 0, 0], transform=axes.transAxes, **rule)
    tick: dict[str, Any] = {**rule, "ls": "none", "ms": TICK, "mew": 0.8}
    axes.plot(x, np.zeros(len(x)), marker=TICKDOWN, transform=along_x, **tick)
    axes.plot(np.zeros(len(y)), y, marker=TICKLEFT, transform=along_y, **tick)
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


def plane(axes: Axes, limits: tuple[float, float, float]) -> None:
    """Set up axes of stiffness and damping by the result of `reach`."""
    largest, lowest, highest = limits
    axes.set_xlim(0, largest)
    axes.set_ylim(lowest, highest)


def plane_labels(motion: Motion) -> tuple[str, str]:
    """Return quantity and unit of both axes of `plane`: in SI, as in all tables."""
    units = UNITS[motion]
    return f"stiffness K [{units.stiffness}]", f"damping B [{units.damping}]"
