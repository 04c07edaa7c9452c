"""A step response and a close-up of its beginning, drawn as in Fig. 6.2 of the thesis.

Source: Hulin 2017, sec. 6.1.2.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.records.batch import Floats
from pipeline.records.figure_records import ResponseFigure
from pipeline.records.models import Motion
from pipeline.rendering import canvas, style
from pipeline.rendering.labels import decimal

BEFORE, AFTER = 2, 6
"""Sampling periods that the close-up shows before the command edge and after the first change."""
SIZE = (440.0, 290.0)


def response(figure: ResponseFigure, motion: Motion = "translation") -> tuple[str, ...]:
    """Draw a response and its beginning, one ``<svg>`` each.

    Parameters
    ----------
    figure : ResponseFigure
    motion : {"translation", "rotation"}
        Decides the unit of the position.
    """
    return _whole(figure, motion), _beginning(figure, motion)


def _whole(figure: ResponseFigure, motion: Motion) -> str:
    t, x, scale, unit = _scaled(figure, motion)
    with canvas.drawing_of(*SIZE) as drawing:
        axes = canvas.add_axes(drawing, 52, 44, 14, 26)
        axes.set_xlim(float(t[0]), float(t[-1]))
        axes.set_ylim(*_range(x, figure.final * scale))
        axes.axhline(figure.final * scale, color=style.INK, lw=0.9, ls=style.LINES["linear"])
        axes.plot(t, x, color=style.BLUE, lw=1.4)
        text = f"Displacement over time, final value {decimal(figure.final * scale, 2)} {unit}."
        if figure.period is not None:
            first, second = (1e3 * time for time in figure.period)
            level = 0.5 * figure.final * scale
            arrow: dict[str, Any] = {"color": style.INK, "lw": 0.9}
            for time in (first, second):
                axes.plot([time, time], [level, float(np.interp(time, t, x))], ls=style.LINES["band"], **arrow)
            axes.plot([first, second], [level, level], marker="|", ms=8, mew=0.9, **arrow)
            period = f"{decimal(1e3 * (figure.period[1] - figure.period[0]), 0)} ms"
            axes.annotate(
                f"T_osc = {period}",
                ((first + second) / 2, level),
                (0, 5),
                "data",
                textcoords="offset points",
                ha="center",
                va="bottom",
                fontsize=10,
                bbox=style.BEHIND_TEXT,
            )
            text += f" Oscillation period {period}."
        canvas.frame(axes, "time after the command edge [ms]", f"displacement [{unit}]", title="step response")
        return style.svg(drawing, f"{figure.identifier}-0", figure.title, text)


def _beginning(figure: ResponseFigure, motion: Motion) -> str:
    period = 1e3 * figure.sampling_period_s
    t, x, _, unit = _scaled(figure, motion)
    near = (t >= -(BEFORE + 0.5) * period) & (t <= (figure.first_change + AFTER + 0.5) * period)
    t, x, force = t[near], x[near], figure.command[near]
    observed = figure.first_change * period
    with canvas.drawing_of(*SIZE) as drawing:
        upper = canvas.add_axes(drawing, 52, 108, 14, 26)
        lower = canvas.add_axes(drawing, 52, 44, 14, 212)
        for axes in (upper, lower):
            axes.set_xlim(-(BEFORE + 0.5) * period, (figure.first_change + AFTER + 0.5) * period)
            axes.axvspan(observed - period, observed, color=style.SKY, alpha=0.3, lw=0)
        upper.set_ylim(*_range(x, 0.0))
        upper.plot(t, x, color=style.BLUE, lw=0.9, marker="o", ms=4.4, mew=0)
        change = float(x[np.argmin(np.abs(t - observed))])
        upper.plot([observed], [change], "o", ms=9, mfc="none", mec=style.VERMILLION, mew=1.6)
        note: dict[str, Any] = {"textcoords": "offset points", "fontsize": 10, "ha": "right", "va": "bottom"}
        upper.annotate(f"first change, t_obs = {decimal(observed, 3)} ms", (observed, change), (-8, 9), "data", **note)
        top = upper.get_ylim()[1]
        upper.text(observed - period / 2, top, "t_d", ha="center", va="top", fontsize=10)
        lower.set_ylim(*_range(force, 0.0))
        lower.step(t, force, where="post", color=style.INK, lw=1.3)
        canvas.frame(upper, "", f"displacement [{unit}]", title="close-up", numbers=False, y_ticks=5)
        force_unit = "N" if motion == "translation" else "Nm"
        canvas.frame(lower, "time after the command edge [ms]", f"force [{force_unit}]", x_ticks=8, y_ticks=2)
        text = (
            f"Command edge at 0, first change of position after {decimal(observed, 3)} ms; the delay lies between "
            f"{decimal(observed - period, 3)} and {decimal(observed, 3)} ms."
        )
        return style.svg(drawing, f"{figure.identifier}-1", f"{figure.title}, beginning", text)


def _scaled(figure: ResponseFigure, motion: Motion) -> tuple[Floats, Floats, float, str]:
    """Time [ms], displacement, and its factor and unit."""
    scale, unit = (1e3, "mm") if motion == "translation" else (1e3, "mrad")
    return figure.time * 1e3, figure.position * scale, scale, unit


def _range(values: Floats, other: float) -> tuple[float, float]:
    """Limits of an axis with some room beyond all values."""
    low, high = min(float(values.min()), other), max(float(values.max()), other)
    room = 0.06 * (high - low) or 1.0
    return low - room, high + room
