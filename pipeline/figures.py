"""Stability boundaries, cost maps and the influence of delay, drawn as in Figs. 6.3 to 6.12 of the thesis.

Every function returns one ``<svg>`` element a panel, all of one scale: the page sets them side by side or, on
a narrow screen, one below the other. The numbers come finished; nothing is estimated here.

Source: Hulin 2017, sec. 6.1.3 to 6.2.5.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from pipeline import panels, style
from pipeline.labels import (
    KILO_ABOVE,
    UNITS,
    cost_text,
    criterion_label,
    damping_text,
    decimal,
    printed_scale,
    stiffness_text,
)
from pipeline.models import Motion
from pipeline.results import BoundaryFigure, CostFigure, CostMap, Curve, DelayFigure, DelayPanel

DOTS_PER_INCH = 72.0
MARGIN = 1.06
"""Space beyond the largest value on an axis."""


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
    reach = _reach(curves)
    largest, damping = reach[0], (reach[1], reach[2])
    width = 350.0 if len(figure.panels) > 2 else 440.0
    longest = max((len(curve.label) for curve in curves), default=0)
    columns = 4 if longest <= panels.SHORT_LABEL else 2
    # One height for all panels, so that they line up: room for the longest legend.
    lines = max(
        (-(-panels.legend_entries(panel, largest, damping) // columns) for _, panel in figure.panels),
        default=0,
    )
    legend_height = 15.0 * lines + 8.0 * bool(lines)
    height = 0.78 * width + legend_height
    look: dict[str, Any] = {"handlelength": 2.2, "columnspacing": 1.4, "labelspacing": 0.25, "borderpad": 0.1}
    result = []
    for index, (title, panel) in enumerate(figure.panels):
        with _drawing(width, height) as drawing:
            axes = _add_axes(drawing, 52, 44 + legend_height, 14, 26 if title else 10)
            scale = _plane(axes, reach, motion)
            axes.set_title(title, loc="left")
            written = panels.draw_curves(axes, panel, scale)
            handles = [line for line in axes.get_lines() if line.get_label() not in written]
            handles = [line for line in handles if not str(line.get_label()).startswith("_")]
            if handles:
                place = (52 / width, legend_height / height)
                drawing.legend(handles=handles, ncols=columns, loc="upper left", bbox_to_anchor=place, **look)
            text = f"{title}: stability boundaries " + "; ".join(_describe(curve, motion) for curve in panel)
            result.append(style.svg(drawing, f"{figure.identifier}-{index}", f"{figure.title} {title}", text))
    return tuple(result)


def cost_maps(figure: CostFigure, motion: Motion = "translation") -> tuple[str, ...]:
    """Draw cost maps of one criterion, each above its front view, one ``<svg>`` a map (Figs. 6.5 to 6.11).

    Parameters
    ----------
    figure : CostFigure
        Maps in SI; overshoot as a fraction. A map without any cost shows its boundary and says so.
    motion : {"translation", "rotation"}
        Decides the units on the axes.
    """
    reach = _reach([m.boundary for m in figure.maps], figure.maps)
    top = panels.front_top(figure)
    columns = len(figure.maps)
    width, height = (350.0, 430.0) if columns > 2 else (440.0, 500.0)
    split = 0.42 * height
    result = []
    for index, cost_map in enumerate(figure.maps):
        with _drawing(width, height) as drawing:
            plane = _add_axes(drawing, 52, split, 12, 24)
            front = _add_axes(drawing, 52, 42, 12, height - split + 12)
            scale = _plane(plane, reach, motion)
            plane.set_xlabel("")
            plane.tick_params(labelbottom=False)
            plane.set_title(cost_map.label, loc="left")
            panels.draw_map(plane, cost_map, figure.criterion, scale)
            front.set_xlim(plane.get_xlim())
            front.xaxis.set_major_locator(_stiffness_ticks())
            panels.draw_front(front, cost_map, figure.criterion, scale, top)
            front.set_xlabel(_stiffness_label(motion, scale))
            text = _describe_map(cost_map, figure.criterion, motion)
            result.append(style.svg(drawing, f"{figure.identifier}-{index}", f"{figure.title} {cost_map.label}", text))
    return tuple(result)


def delays(figure: DelayFigure) -> tuple[str, ...]:
    """Draw optimal costs over total delay, one ``<svg>`` a criterion (Fig. 6.12)."""
    result = []
    for index, panel in enumerate(figure.panels):
        with _drawing(440.0, 300.0) as drawing:
            axes = _add_axes(drawing, 60, 44, 12, 26)
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
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
            axes.yaxis.set_major_locator(MaxNLocator(5, steps=style.TICK_STEPS))
            axes.set_xlabel("total delay d [samples]")
            axes.set_title(criterion_label(panel.criterion), loc="left")
            axes.legend(handles=handles, loc="upper left", handlelength=2.4, borderpad=0.1)
            text = _describe_delay(panel)
            title = f"{figure.title} {criterion_label(panel.criterion)}"
            result.append(style.svg(drawing, f"{figure.identifier}-{index}", title, text))
    return tuple(result)


@contextmanager
def _drawing(width: float, height: float) -> Iterator[Figure]:
    """Yield an empty figure of a size in pixels, drawn and saved with the settings of `style`."""
    with matplotlib.rc_context(style.RC):
        yield Figure(figsize=(width / DOTS_PER_INCH, height / DOTS_PER_INCH), dpi=DOTS_PER_INCH)


def _add_axes(drawing: Figure, left: float, bottom: float, right: float, top: float) -> Axes:
    """Add axes with margins in pixels; a layout engine would take longer than the drawing."""
    width, height = drawing.get_size_inches() * DOTS_PER_INCH
    axes = drawing.add_axes(
        (left / width, bottom / height, (width - left - right) / width, (height - bottom - top) / height)
    )
    axes.tick_params(length=3)
    return axes


def _reach(curves: Sequence[Curve], maps: Sequence[CostMap] = ()) -> tuple[float, float, float]:
    """Return the largest stiffness, lowest and largest damping of all curves and trials, for shared axes."""
    stiffness = [c.stiffness for c in curves] + [m.trial_stiffness for m in maps]
    damping = [c.damping for c in curves if c.kind != "linear"] + [m.trial_damping for m in maps]
    if not any(np.isfinite(part).any() for part in stiffness):  # no boundary: the grids are all there is
        stiffness, damping = [m.stiffness for m in maps], [m.damping for m in maps]
    k = np.concatenate([*stiffness, np.zeros(1)])
    b = np.concatenate([*damping, np.zeros(1)])
    k, b = k[np.isfinite(k)], b[np.isfinite(b)]
    return float(k.max() * MARGIN or 1.0), float(b.min() * MARGIN), float(b.max() * MARGIN or 1.0)


def _plane(axes: Axes, reach: tuple[float, float, float], motion: Motion) -> float:
    """Set up axes of stiffness and damping; return the factor from SI to the stiffness axis."""
    largest, lowest, highest = reach
    scale = 1e-3 if largest > KILO_ABOVE else 1.0
    axes.set_xlim(0, largest * scale)
    axes.set_ylim(lowest, highest)
    axes.xaxis.set_major_locator(_stiffness_ticks())
    axes.yaxis.set_major_locator(MaxNLocator(6, steps=style.TICK_STEPS))
    axes.set_xlabel(_stiffness_label(motion, scale))
    axes.set_ylabel(f"damping B [{UNITS[motion].damping}]")
    return scale


def _stiffness_ticks() -> MaxNLocator:
    """Return the ticks that a map and its front view have in common."""
    return MaxNLocator(6, steps=style.TICK_STEPS)


def _stiffness_label(motion: Motion, scale: float) -> str:
    return f"stiffness K [{'k' if scale < 1 else ''}{UNITS[motion].stiffness}]"


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
