"""Panels of lines, contours, areas and words as SVG. The numbers come finished (`pipeline.studies.figure`)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator

from pipeline.base.wording import power_of_ten
from pipeline.records.batch import Floats
from pipeline.rendering.figures import style
from pipeline.rendering.labels import decimal
from pipeline.studies.figure import Area, Contours, Note, Panel, TheoryFigure, Trace

_DOTS_PER_INCH = 72.0

_SIZES = {1: (480.0, 330.0), 2: (440.0, 310.0), 3: (350.0, 260.0)}
"""Width and height [px] of a panel without its legend, by panels in a row: their scale on the page is about one."""

_FRONT = 0.55
"""Height of the axes below a map, relative to that of the map's panel."""

_MARGINS = {"left": 56.0, "right": 16.0, "top": 26.0, "bottom": 44.0}
_LEGEND_LINE = 15.0

_LETTER = 6.0
"""Mean width [px] of a letter of the legend, to tell how many entries fit into a line."""

_DASHES: dict[str, Any] = {
    "solid": "-",
    "dashed": (0, (5, 2)),
    "dashdot": (0, (6, 2, 1, 2)),
    "dotted": (0, (1, 1.8)),
    "none": "none",
}

_MARKER_SIZE = {"+": 12.0, "*": 11.0, "x": 7.0}
"""Marks that need more room than a dot [px]."""

_BESIDE = 0.05
"""Share of the axes' range around them inside which points are kept; lines beyond would only fill the file."""


def draw(figure: TheoryFigure) -> tuple[str, ...]:
    """Return one ``<svg>`` element a panel.

    Parameters
    ----------
    figure : TheoryFigure

    Notes
    -----
    All panels have the same size, with room for the longest legend among them.
    """
    size = _SIZES[figure.columns]
    legend = max(_legend_lines(panel, size[0]) for panel in figure.panels) * _LEGEND_LINE
    name, title = f"fig-{figure.number.replace('.', '-')}", f"Figure {figure.number}"
    return tuple(
        draw_panel(replace(panel, name=f"{title} {panel.title}".strip()), f"{name}-{i}", size, legend)
        for i, panel in enumerate(figure.panels)
    )


def draw_panel(panel: Panel, identifier: str, size: tuple[float, float], legend: float | None = None) -> str:
    """Return a panel as an ``<svg>`` element.

    Parameters
    ----------
    panel : Panel
    identifier : str
        Prefix of all ``id`` in it, unique on its page.
    size : tuple of float
        Width and height of the axes with their labels [px].
    legend : float, optional
        Height below that is left for the legend [px]; as much as it needs where not given.
    """
    width, height = size
    front = _FRONT * height if panel.below else 0.0
    below = _legend_lines(panel, width) * _LEGEND_LINE if legend is None else legend
    with matplotlib.rc_context(style.RC):
        inches = (width / _DOTS_PER_INCH, (height + front + below) / _DOTS_PER_INCH)
        drawing = Figure(figsize=inches, dpi=_DOTS_PER_INCH)
        _draw_panel(drawing, panel, front, below)
        return style.svg(drawing, identifier, panel.name, panel.description or _description(panel))


def _draw_panel(drawing: Figure, panel: Panel, front: float, legend: float) -> None:
    height = drawing.get_figheight() * _DOTS_PER_INCH
    lowest = _MARGINS["bottom"] + legend
    if panel.below is None:
        axes = [(panel, _add_axes(drawing, lowest, height - _MARGINS["top"], panel))]
    else:
        split = lowest + front
        axes = [
            (panel, _add_axes(drawing, split, height - _MARGINS["top"], panel)),
            (panel.below, _add_axes(drawing, lowest, split - 16.0, panel.below)),
        ]
        axes[0][1].set_xlabel("")
        axes[0][1].tick_params(labelbottom=False)
    handles: list[Any] = []
    for content, place in axes:
        for area in content.areas:
            handles += _draw_area(place, area)
        for contours in content.contours:
            _draw_contours(place, contours)
        for trace in content.traces:
            handles += _draw_trace(place, content, trace)
        for note in content.notes:
            _write_note(place, note)
    named = {handle.get_label(): handle for handle in handles if not str(handle.get_label()).startswith("_")}
    if named:
        columns, _ = _legend_shape(list(named), drawing.get_figwidth() * _DOTS_PER_INCH)
        corner = (_MARGINS["left"] / (drawing.get_figwidth() * _DOTS_PER_INCH), legend / height)
        drawing.legend(
            handles=list(named.values()), ncols=columns, loc="upper left", bbox_to_anchor=corner, handlelength=2.2,
            columnspacing=1.2, labelspacing=0.25, borderpad=0.0, borderaxespad=0.0,
        )  # fmt: skip


def _add_axes(drawing: Figure, bottom: float, top: float, panel: Panel) -> Axes:
    width, height = drawing.get_size_inches() * _DOTS_PER_INCH
    left, right = _MARGINS["left"], width - _MARGINS["right"]
    if panel.square:
        right = left + min(right - left, top - bottom)
    axes = drawing.add_axes((left / width, bottom / height, (right - left) / width, (top - bottom) / height))
    axes.set_xlim(*panel.x_range)
    axes.set_ylim(*panel.y_range)
    if panel.logarithmic:
        axes.set_xscale("log")
        axes.set_yscale("log")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(LogLocator(base=10, numticks=8))
            axis.set_major_formatter(lambda value, _: power(value))
    else:
        axes.xaxis.set_major_locator(MaxNLocator(6, steps=style.TICK_STEPS))
        axes.yaxis.set_major_locator(MaxNLocator(6 if top - bottom > 150 else 4, steps=style.TICK_STEPS))
    axes.tick_params(length=3)
    axes.minorticks_off()
    axes.set_xlabel(panel.x_label)
    axes.set_ylabel(panel.y_label)
    axes.set_title(panel.title, loc="left")
    return axes


def power(value: float) -> str:
    """Return a power of ten as people write it."""
    return f"{value:g}" if 1 <= value <= 1e4 else power_of_ten(round(np.log10(value)))


def _colour(name: str) -> str:
    return str(getattr(style, name.upper()))


def _draw_trace(axes: Axes, panel: Panel, trace: Trace) -> list[Any]:
    x, y = _inside(panel, trace)
    look: dict[str, Any] = {"color": _colour(trace.colour), "ls": _DASHES[trace.dash], "lw": trace.width}
    if trace.marker:
        wide = trace.marker in _MARKER_SIZE
        look |= {"marker": trace.marker, "ms": _MARKER_SIZE.get(trace.marker, 6.0), "mew": 2.2 if wide else 1.4}
        if not wide and not trace.filled:
            look["mfc"] = style.PAPER
        look["zorder"] = 4
        look["clip_on"] = trace.marker != "x"  # crosses stand on the edge
    return list(axes.plot(x, y, label=trace.label or "_", **look))


def _inside(panel: Panel, trace: Trace) -> tuple[Floats, Floats]:
    """Points inside the axes with one more on either side of each stretch, the rest as one gap each."""
    x, y = np.asarray(trace.x, dtype=np.float64), np.asarray(trace.y, dtype=np.float64)
    if panel.logarithmic:
        return x, y
    near = np.ones(len(x), dtype=np.bool_)
    for values, (low, high) in ((x, panel.x_range), (y, panel.y_range)):
        margin = _BESIDE * (high - low)
        near &= (values >= low - margin) & (values <= high + margin)
    keep = near.copy()
    keep[:-1] |= near[1:]
    keep[1:] |= near[:-1]
    # a line may cross the axes between two points outside of them: these are kept where both are next to it
    gap = ~keep
    x, y = np.where(gap, np.nan, x), np.where(gap, np.nan, y)
    wanted = ~(gap & np.append(False, gap[:-1]))
    return x[wanted], y[wanted]


def _draw_area(axes: Axes, area: Area) -> list[Any]:
    colour = _colour(area.colour)
    return list(axes.fill(area.x, area.y, facecolor=colour, edgecolor="none", alpha=0.22, label=area.label or "_"))


def _draw_contours(axes: Axes, contours: Contours) -> None:
    count = len(contours.levels)
    if not count:
        return
    shade = [(*to_rgb(style.GREEN), strength) for strength in np.linspace(1.0, 0.5, count)]
    lines = axes.contour(
        contours.x, contours.y, np.ma.masked_invalid(contours.z), contours.levels, colors=shade, linewidths=0.9
    )
    if contours.labelled:
        axes.clabel(
            lines, [level for level in contours.levels if level in contours.labelled],
            fmt=lambda level: decimal(level * contours.scale, contours.digits), fontsize=8.5, colors=style.INK,
            inline_spacing=2,
        )  # fmt: skip


def _write_note(axes: Axes, note: Note) -> None:
    axes.annotate(
        note.text, (note.x, note.y), xytext=(note.right, note.up), textcoords="offset points", ha=note.align,
        va="center", fontsize=9.0, color=_colour(note.colour), annotation_clip=False,
    )  # fmt: skip


def _labels(panel: Panel) -> list[str]:
    parts = [panel, *([panel.below] if panel.below else [])]
    words = [area.label for part in parts for area in part.areas]
    words += [trace.label for part in parts for trace in part.traces]
    return [word for word in dict.fromkeys(words) if word]


def _legend_shape(labels: list[str], width: float) -> tuple[int, int]:
    """Columns and lines of a legend."""
    entry = max(len(label) for label in labels) * _LETTER + 40.0
    columns = int(np.clip((width - _MARGINS["left"]) // entry, 1, len(labels)))
    return columns, -(-len(labels) // columns)


def _legend_lines(panel: Panel, width: float) -> int:
    labels = _labels(panel)
    return _legend_shape(labels, width)[1] if labels else 0


def _description(panel: Panel) -> str:
    words = [f"{panel.y_label or 'no unit'} over {panel.x_label or 'no unit'}"]
    if labels := _labels(panel):
        words.append("shown: " + ", ".join(labels))
    if panel.contours:
        words.append("lines of equal cost")
    return f"{panel.title}: " + "; ".join(words) + "."
