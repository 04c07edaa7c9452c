"""Stability boundaries, cost maps and the influence of delay, drawn as in Figs. 6.3 to 6.12 of the thesis.

Every function returns one ``<svg>`` element a panel, all of one scale: the page sets them side by side or, on
a narrow screen, one below the other. The numbers come finished; nothing is estimated here.

Source: Hulin 2017, sec. 6.1.3 to 6.2.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from pipeline.records.figure_records import CostMap, Curve, DelayPanel, Figure, Limits
from pipeline.records.models import Motion
from pipeline.rendering.figures import canvas, panels, style
from pipeline.rendering.figures.shown import Panel
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

LEGEND_ORDER = (
    "measured",
    "theory",
    "band",
    "linear",
    "bound",
    "friction",
    "passive",
    "robust",
    "envelope",
    "use",
    "stable",
    "unstable",
)
"""Kinds of curves in the order of a legend: what is compared first."""

LETTER = 6.2
"""Width of a wide letter in a legend [pixels]; a lab may give an experiment a name of 200 of them."""

HALF = 0.56
"""Part of the letters of a whole line that a legend of two columns holds: words of usual letters are narrower."""


LEGEND: dict[str, Any] = {"handlelength": 2.2, "columnspacing": 1.4, "labelspacing": 0.25, "borderpad": 0.1}


def boundaries(figure: Figure[Limits], motion: Motion = "translation") -> tuple[Panel, ...]:
    """Draw stability boundaries on axes of equal range (Figs. 6.3, 6.4, 6.9).

    Measured curves are solid with small markers (open where censored), theory dashed, linear conditions dotted; points
    that are not finite interrupt a line.
    """
    curves = [curve for _, panel in figure.panels for curve in panel]
    reach = canvas.reach(curves)
    width = 350.0 if len(figure.panels) > 2 else 440.0
    longest = max((len(curve.label) for curve in curves), default=0)
    letters = int((width - 80) / LETTER)  # of a label that has the width for itself, beside its line
    columns = 4 if longest <= panels.SHORT_LABEL else 2 if longest <= HALF * letters else 1
    # One height for all panels, so that they line up: room for the longest legend.
    entries = [panels.legend_entries(panel, reach) + bool(figure.theory_label) for _, panel in figure.panels]
    lines = -(-max(entries, default=0) // columns)
    legend = 15.0 * lines + 8.0 * bool(lines)
    height = 0.78 * width + legend
    names = ("α = K T²/m", "β = B T/m") if figure.kind == "plane" else canvas.plane_labels(motion)

    def paint(panel: Limits, axes: Axes) -> tuple[str, str]:
        title, shown = panel
        canvas.plane(axes, reach)
        entries = panels.draw_curves(axes, shown, thin=figure.kind == "plane")
        canvas.frame(axes, *names, title=title)
        if figure.theory_label and any(curve.kind == "theory" for curve in shown):
            entries.setdefault("theory", []).append(_theory_line(shown, figure.theory_label))
        handles = [artist for kind in LEGEND_ORDER for artist in entries.get(kind, ())]
        for artist in handles:
            artist.set_label(shortened(str(artist.get_label()), letters))
        if handles:
            axes.figure.legend(
                handles=handles, ncols=columns, loc="upper left", bbox_to_anchor=(52 / width, legend / height), **LEGEND
            )
        told = "; ".join(_describe(curve, motion) for curve in shown)
        return f" {title}" if title else "", f"{f'{title}: s' if title else 'S'}tability boundaries {told}"

    top = 26 if any(title for title, _ in figure.panels) else 10
    return canvas.draw_panels(figure, (width, height), [(52, 44 + legend, 14, top)], paint)


def _theory_line(curves: Sequence[Curve], label: str) -> Line2D:
    colour = panels.theory_colour(curves) or style.INK
    return Line2D([], [], color=colour, ls=style.LINES["theory"], lw=panels.LINE_WIDTHS["theory"], label=label)


def cost_maps(figure: Figure[CostMap], motion: Motion = "translation") -> tuple[Panel, ...]:
    """Draw cost maps of one criterion, each above its front view (Figs. 6.5 to 6.11).

    A map without any cost shows its boundary and says so.
    """
    reach = canvas.reach([m.boundary for m in figure.panels], figure.panels)
    top = panels.front_top(figure)
    width, height = (350.0, 430.0) if len(figure.panels) > 2 else (440.0, 500.0)
    split = 0.42 * height
    stiffness, damping = canvas.plane_labels(motion)

    def paint(shown: CostMap, plane: Axes, front: Axes) -> tuple[str, str]:
        canvas.plane(plane, reach)
        front.set_xlim(plane.get_xlim())
        panels.draw_map(plane, shown, figure.criterion)
        canvas.frame(plane, "", damping, title=shown.label, numbers=False)
        panels.draw_front(front, shown, figure.criterion, top)
        canvas.frame(front, stiffness, panels.cost_axis_label(figure.criterion), y_ticks=4)
        return f" {shown.label}", _describe_map(shown, figure.criterion, motion)

    margins = [(52, split, 12, 24), (52, 42, 12, height - split + 12)]
    return canvas.draw_panels(figure, (width, height), margins, paint)


def delays(figure: Figure[DelayPanel], motion: Motion = "translation") -> tuple[Panel, ...]:
    """Draw optimal costs over total delay (Fig. 6.12)."""

    def paint(panel: DelayPanel, axes: Axes) -> tuple[str, str]:
        label = criterion_label(panel.criterion)
        for values, name, look in (
            (panel.theory, "theory", {"color": style.INK, "lw": 1.6}),
            (panel.damped, panel.damped_label, {"color": style.INK, "lw": 1.4, "ls": style.LINES["theory"]}),
            (panel.measured, "experiment", {"color": style.BLUE, "ls": "none", "marker": "+", "ms": 10, "mew": 2}),
        ):
            known = np.isfinite(values)
            if known.any():
                cost = values[known] * printed_scale(panel.criterion)
                axes.plot(panel.delay_samples[known], cost, label=name, **look)
        costs = np.concatenate([line.get_ydata() for line in axes.lines]) if axes.lines else np.ones(1)
        axes.set_ylim(0, costs.max() + 0.05 * np.ptp(costs))
        axes.set_xlim(panel.delay_samples.min() - 0.3, panel.delay_samples.max() + 0.3)
        handles = list(axes.lines)
        canvas.frame(axes, "total delay d [samples]", "", title=label, y_ticks=5, whole=True)
        axes.legend(handles=handles, loc="upper left", handlelength=2.4, borderpad=0.1)
        return f" {label}", _describe_delay(panel)

    return canvas.draw_panels(figure, (440.0, 300.0), [(60, 44, 12, 26)], paint)


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
