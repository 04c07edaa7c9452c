"""Stability boundaries, cost maps and the influence of delay, drawn as in Figs. 6.3 to 6.12 of the thesis.

Every function returns one ``<svg>`` element a panel, all of one scale: the page sets them side by side or, on
a narrow screen, one below the other. The numbers come finished; nothing is estimated here.

Source: Hulin 2017, sec. 6.1.3 to 6.2.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from pipeline.records.figure_records import BoundaryFigure, CostFigure, CostMap, Curve, DelayFigure, DelayPanel
from pipeline.records.models import Motion
from pipeline.rendering import canvas, panels, style
from pipeline.rendering.labels import (
    UNITS,
    cost_text,
    criterion_label,
    damping_text,
    decimal,
    printed_scale,
    shortened,
    stiffness_text,
)

LEGEND_ORDER = ("measured", "theory", "band", "linear", "bound", "passive", "envelope")
"""Kinds of curves in the order of a legend: what is compared first."""

LETTER = 6.2
"""Width of a wide letter in a legend [pixels]; a lab may give an experiment a name of 200 of them."""

HALF = 0.56
"""Part of the letters of a whole line that a legend of two columns holds: words of usual letters are narrower."""


def boundaries(figure: BoundaryFigure, motion: Motion = "translation") -> tuple[str, ...]:
    """Draw stability boundaries, one ``<svg>`` a panel with axes of equal range (Figs. 6.3, 6.4, 6.9).

    Parameters
    ----------
    figure : BoundaryFigure
        Curves in SI; points that are not finite interrupt a line.
    motion : {"translation", "rotation"}
        Decides the units on the axes.

    Returns
    -------
    tuple of str
        Measured curves solid with small markers (open where censored), theory dashed, linear dotted.
    """
    curves = [curve for _, panel in figure.panels for curve in panel]
    reach = canvas.reach(curves)
    largest, damping = reach[0], (reach[1], reach[2])
    width = 350.0 if len(figure.panels) > 2 else 440.0
    longest = max((len(curve.label) for curve in curves), default=0)
    letters = int((width - 80) / LETTER)  # of a label that has the width for itself, beside its line
    columns = 4 if longest <= panels.SHORT_LABEL else 2 if longest <= HALF * letters else 1
    # One height for all panels, so that they line up: room for the longest legend.
    lines = max(
        (
            -(-(panels.legend_entries(panel, largest, damping) + bool(figure.theory_label)) // columns)
            for _, panel in figure.panels
        ),
        default=0,
    )
    legend_height = 15.0 * lines + 8.0 * bool(lines)
    height = 0.78 * width + legend_height
    look: dict[str, Any] = {"handlelength": 2.2, "columnspacing": 1.4, "labelspacing": 0.25, "borderpad": 0.1}
    room = 26 if any(title for title, _ in figure.panels) else 10
    result = []
    with canvas.drawing_of(width, height) as drawing:
        axes = canvas.add_axes(drawing, 52, 44 + legend_height, 14, room)
        scale = canvas.plane(axes, reach)
        for index, (title, panel) in enumerate(figure.panels):
            canvas.wipe(drawing)
            written = panels.draw_curves(axes, panel, scale, thin=figure.normalised)
            names = (canvas.stiffness_label(motion, scale), canvas.damping_label(motion))
            if figure.normalised:
                names = ("α = K T²/m", "β = B T/m")
            canvas.frame(axes, *names, title=title)
            handles = _handles(axes, panel, written, figure.theory_label, letters)
            if handles:
                place = (52 / width, legend_height / height)
                drawing.legend(handles=handles, ncols=columns, loc="upper left", bbox_to_anchor=place, **look)
            text = f"{title}: stability boundaries " + "; ".join(_describe(curve, motion) for curve in panel)
            result.append(style.svg(drawing, f"{figure.identifier}-{index}", f"{figure.title} {title}", text))
    return tuple(result)


def _handles(axes: Axes, curves: Sequence[Curve], written: set[str], theory_label: str, letters: int) -> list[Artist]:
    """Return what the legend holds: curves without a label beside them, measured ones and theory first."""
    kinds = {curve.label: curve.kind for curve in curves}
    named = [(str(artist.get_label()), artist) for artist in (*axes.get_lines(), *axes.patches)]
    shown: list[tuple[int, Artist]] = [
        (LEGEND_ORDER.index(kinds[name]), artist)
        for name, artist in named
        if name in kinds and name not in written and not name.startswith("_")
    ]
    if theory_label and "theory" in kinds.values():
        colour = panels.theory_colour(curves) or style.INK
        line = Line2D([], [], color=colour, ls=style.LINES["theory"], lw=panels.LINE_WIDTHS["theory"])
        line.set_label(theory_label)
        shown.append((LEGEND_ORDER.index("theory"), line))
    for _, artist in shown:
        artist.set_label(shortened(str(artist.get_label()), letters))
    return [artist for _, artist in sorted(shown, key=lambda entry: entry[0])]


def cost_maps(figure: CostFigure, motion: Motion = "translation") -> tuple[str, ...]:
    """Draw cost maps of one criterion, each above its front view, one ``<svg>`` a map (Figs. 6.5 to 6.11).

    Parameters
    ----------
    figure : CostFigure
        Maps in SI; overshoot as a fraction. A map without any cost shows its boundary and says so.
    motion : {"translation", "rotation"}
        Decides the units on the axes.
    """
    reach = canvas.reach([m.boundary for m in figure.maps], figure.maps)
    top = panels.front_top(figure)
    columns = len(figure.maps)
    width, height = (350.0, 430.0) if columns > 2 else (440.0, 500.0)
    split = 0.42 * height
    result = []
    with canvas.drawing_of(width, height) as drawing:
        plane = canvas.add_axes(drawing, 52, split, 12, 24)
        front = canvas.add_axes(drawing, 52, 42, 12, height - split + 12)
        scale = canvas.plane(plane, reach)
        front.set_xlim(plane.get_xlim())
        for index, cost_map in enumerate(figure.maps):
            canvas.wipe(drawing)
            panels.draw_map(plane, cost_map, figure.criterion, scale)
            canvas.frame(plane, "", canvas.damping_label(motion), title=cost_map.label, numbers=False)
            panels.draw_front(front, cost_map, figure.criterion, scale, top)
            cost_axis = panels.cost_axis_label(figure.criterion)
            canvas.frame(front, canvas.stiffness_label(motion, scale), cost_axis, y_ticks=4)
            text = _describe_map(cost_map, figure.criterion, motion)
            result.append(style.svg(drawing, f"{figure.identifier}-{index}", f"{figure.title} {cost_map.label}", text))
    return tuple(result)


def delays(figure: DelayFigure) -> tuple[str, ...]:
    """Draw optimal costs over total delay, one ``<svg>`` a criterion (Fig. 6.12)."""
    result = []
    for index, panel in enumerate(figure.panels):
        with canvas.drawing_of(440.0, 300.0) as drawing:
            axes = canvas.add_axes(drawing, 60, 44, 12, 26)
            factor = printed_scale(panel.criterion)
            handles: list[Any] = []
            for values, look, label in (
                (panel.theory, {"color": style.GREEN, "lw": 1.6}, "theory"),
                (
                    panel.damped,
                    {"color": style.GREEN, "lw": 1.4, "ls": style.LINES["theory"]},
                    panel.damped_label,
                ),
                (
                    panel.measured,
                    {"color": style.BLUE, "ls": "none", "marker": "+", "ms": 10, "mew": 2},
                    "experiment",
                ),
            ):
                known = np.isfinite(values)
                if known.any():
                    handles += axes.plot(panel.delay_samples[known], values[known] * factor, label=label, **look)
            axes.set_ylim(0, None)
            axes.set_xlim(panel.delay_samples.min() - 0.3, panel.delay_samples.max() + 0.3)
            label = criterion_label(panel.criterion)
            canvas.frame(axes, "total delay d [samples]", "", title=label, y_ticks=5, whole=True)
            axes.legend(handles=handles, loc="upper left", handlelength=2.4, borderpad=0.1)
            text = _describe_delay(panel)
            title = f"{figure.title} {criterion_label(panel.criterion)}"
            result.append(style.svg(drawing, f"{figure.identifier}-{index}", title, text))
    return tuple(result)


def _describe(curve: Curve, motion: Motion) -> str:
    known = np.isfinite(curve.stiffness) & np.isfinite(curve.damping)
    if not known.any():
        return f"{curve.label} ({curve.kind}): no point"
    units = UNITS[motion]
    stiffness = stiffness_text(float(curve.stiffness[known].max()))
    damping = damping_text(float(curve.damping[known].max()))
    return f"{curve.label} ({curve.kind}): up to {stiffness} {units.stiffness} and {damping} {units.damping}"


def _describe_map(cost_map: CostMap, criterion: str, motion: Motion) -> str:
    text = f"{cost_map.label}, {criterion_label(criterion)}: contour lines over stiffness and damping."
    best = cost_map.optimum
    if best is None:
        return f"{text} No optimum is known."
    stiffness = f"{stiffness_text(best.stiffness)} {UNITS[motion].stiffness}"
    damping = f"{damping_text(best.damping)} {UNITS[motion].damping}"
    return f"{text} Optimum {cost_text(criterion, best.cost)} at {stiffness} and {damping}."


def _describe_delay(panel: DelayPanel) -> str:
    parts = []
    for label, values in (("theory", panel.theory), ("experiment", panel.measured)):
        entries = [
            f"d = {decimal(float(d), 1)}: {cost_text(panel.criterion, float(v))}"
            for d, v in zip(panel.delay_samples, values, strict=True)
            if np.isfinite(v)
        ]
        parts.append(f"{label} {', '.join(entries) or 'without data'}")
    return f"Optimal cost over delay. {'; '.join(parts)}."
