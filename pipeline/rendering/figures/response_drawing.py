"""A step response and a close-up of its beginning, drawn as in Fig. 6.2 of the thesis.

Source: Hulin 2017, sec. 6.1.2.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from pipeline.records.batch import Floats
from pipeline.records.figure_records import Figure, Response
from pipeline.records.models import Motion
from pipeline.rendering.figures import canvas, style
from pipeline.rendering.figures.shown import Panel
from pipeline.rendering.labels import decimal

BEFORE, AFTER = 2, 6
"""Sampling periods that the close-up shows before the command edge and after the first change."""
SIZE = (440.0, 290.0)
MILLI = 1e3
"""From m to mm, rad to mrad."""


def responses(figure: Figure[Response], motion: Motion = "translation") -> tuple[Panel, ...]:
    """Draw a response and, beside it, its beginning."""
    whole, beginning = partial(_whole, motion=motion), partial(_beginning, motion=motion)
    close = replace(figure, identifier=f"{figure.identifier}-close")
    return (
        *canvas.draw_panels(figure, SIZE, [(52, 44, 14, 26)], whole),
        *canvas.draw_panels(close, SIZE, [(52, 108, 14, 26), (52, 44, 14, 212)], beginning),
    )


def _whole(shown: Response, axes: Axes, *, motion: Motion) -> tuple[str, str]:
    t, x, final = 1e3 * shown.time, MILLI * shown.position, MILLI * shown.final
    axes.set_xlim(float(t[0]), float(t[-1]))
    axes.set_ylim(*_range(x, final))
    axes.axhline(final, color=style.INK, lw=0.9, ls=style.LINES["linear"])
    axes.plot(t, x, color=style.BLUE, lw=1.4, label="log")
    text = f"Displacement over time, final value {decimal(final, 2)} {_unit(motion)}."
    if shown.period is not None:
        first, second = (1e3 * time for time in shown.period)
        level = 0.5 * final
        arrow: dict[str, Any] = {"color": style.INK, "lw": 0.9}
        for time in (first, second):
            axes.plot([time, time], [level, float(np.interp(time, t, x))], ls=style.LINES["band"], **arrow)
        axes.plot([first, second], [level, level], marker="|", ms=8, mew=0.9, **arrow)
        period = f"{decimal(second - first, 0)} ms"
        look: dict[str, Any] = {"ha": "center", "va": "bottom", "fontsize": 10, "bbox": style.BEHIND_TEXT}
        middle = ((first + second) / 2, level)
        axes.annotate(f"T_osc = {period}", middle, (0, 5), "data", textcoords="offset points", **look)
        text += f" Oscillation period {period}."
    canvas.frame(axes, "time after the command edge [ms]", f"displacement [{_unit(motion)}]", title="step response")
    return "", text


def _beginning(shown: Response, upper: Axes, lower: Axes, *, motion: Motion) -> tuple[str, str]:
    period = 1e3 * shown.sampling_period_s
    start, end = -(BEFORE + 0.5) * period, (shown.first_change + AFTER + 0.5) * period
    t, x = 1e3 * shown.time, MILLI * shown.position
    near = (t >= start) & (t <= end)
    t, x, force = t[near], x[near], shown.command[near]
    observed = shown.first_change * period
    for axes in (upper, lower):
        axes.set_xlim(start, end)
        axes.axvspan(observed - period, observed, color=style.SKY, alpha=0.3, lw=0)
    upper.set_ylim(*_range(x, 0.0))
    upper.plot(t, x, color=style.BLUE, lw=0.9, marker="o", ms=4.4, mew=0, label="log")
    change = float(x[np.argmin(np.abs(t - observed))])
    upper.plot([observed], [change], "o", ms=9, mfc="none", mec=style.VERMILLION, mew=1.6)
    note: dict[str, Any] = {"textcoords": "offset points", "fontsize": 10, "ha": "right", "va": "bottom"}
    upper.annotate(f"first change, t_obs = {decimal(observed, 3)} ms", (observed, change), (-8, 9), "data", **note)
    upper.text(observed - period / 2, upper.get_ylim()[1], "t_d", ha="center", va="top", fontsize=10)
    lower.set_ylim(*_range(force, 0.0))
    lower.step(t, force, where="post", color=style.INK, lw=1.3, label="command")
    canvas.frame(upper, "", f"displacement [{_unit(motion)}]", title="close-up", numbers=False, y_ticks=5)
    force_unit = "N" if motion == "translation" else "Nm"
    canvas.frame(lower, "time after the command edge [ms]", f"force [{force_unit}]", x_ticks=8, y_ticks=2)
    return ", beginning", (
        f"Command edge at 0, first change of position after {decimal(observed, 3)} ms; the delay lies between "
        f"{decimal(observed - period, 3)} and {decimal(observed, 3)} ms."
    )


def _unit(motion: Motion) -> str:
    return "mm" if motion == "translation" else "mrad"


def _range(values: Floats, other: float) -> tuple[float, float]:
    """Limits of an axis with some room beyond all values."""
    low, high = min(float(values.min()), other), max(float(values.max()), other)
    room = 0.06 * (high - low) or 1.0
    return low - room, high + room
