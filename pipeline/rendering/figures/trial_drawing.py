"""A trial beside theory and fitted loops, and below, with a scale of its own, the residual of the wall law."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import cycle

import numpy as np
from matplotlib.axes import Axes

from pipeline.records.batch import Floats
from pipeline.records.figure_records import Figure, TrialCourse
from pipeline.records.models import Motion
from pipeline.rendering.figures import canvas, style
from pipeline.rendering.figures.figures import LEGEND
from pipeline.rendering.figures.log_drawing import thinned

SIZE = (440.0, 310.0)
LEGEND_HEIGHT = 23.0
"""Of each line of the legend, two names a line [px]."""
LOG = 3.4
"""Width of the log's line [px]: those over it, which it often lies under, leave it to be seen."""
MILLI = 1e3
"""From m to mm, rad to mrad, s to ms."""
PREFIXES = {0: "", -3: "m", -6: "µ", -9: "n", -12: "p"}
"""Of the unit of the residual, by powers of ten: it may be rounding alone."""
LOOKS = {
    "theory": (style.INK, style.LINES["theory"]),
    "fitted loop": (style.GREEN, style.LINES["bound"]),
    "model of this log": (style.VERMILLION, style.LINES["linear"]),
}
"""Colour and line of each response beside the log."""


def courses(figure: Figure[TrialCourse], motion: Motion = "translation") -> tuple[str, ...]:
    """Draw the responses of a trial and, beside them, the residual of the wall law."""
    names = 1 + max(len(course.beside) for course in figure.panels)
    legend = LEGEND_HEIGHT * (1 + names // 3)
    responses, residuals = partial(_responses, motion=motion), partial(_residual, motion=motion)
    other = replace(figure, identifier=f"{figure.identifier}-law")
    return (
        *canvas.draw_panels(figure, SIZE, [(52, 44 + legend, 14, 26)], responses),
        *canvas.draw_panels(other, SIZE, [(52, 44 + legend, 14, 26)], residuals),
    )


def overlaid(
    figures: Sequence[Figure[TrialCourse]], labels: Sequence[str], motion: Motion = "translation"
) -> tuple[str, ...]:
    """Draw the responses of several trials over each other, each with that of theory (dashed, in its colour)."""
    unit, size = "mm" if motion == "translation" else "mrad", (440.0, 290.0 + LEGEND_HEIGHT * len(labels))
    shown = [figure.panels[0] for figure in figures]

    def paint(_: object, axes: Axes) -> tuple[str, str]:
        handles = []
        for course, label, colour in zip(shown, labels, cycle(style.SERIES), strict=False):
            handles += axes.plot(*_line(course.time, course.position), color=colour, lw=1.6, label=label)
            for each in course.beside:
                if each.label == "theory":
                    axes.plot(*_line(course.time, each.position), color=colour, ls=style.LINES["theory"], lw=1.0)
        axes.set_xlim(min(course.time[0] for course in shown) * MILLI, max(course.time[-1] for course in shown) * MILLI)
        axes.set_ylim(*_range(MILLI * np.concatenate([course.position for course in shown])))
        canvas.frame(axes, "time after the command edge [ms]", f"displacement [{unit}]")
        axes.figure.legend(handles=handles, ncols=1, loc="lower left", bbox_to_anchor=(52 / size[0], 0.0), **LEGEND)
        return ": responses", f"Displacement over time of {len(shown)} trials; dashed: theory."

    margins = [(52, 44 + LEGEND_HEIGHT * len(labels), 14, 12)]
    return canvas.draw_panels(
        replace(figures[0], identifier="trials", title="Trials", panels=figures[0].panels[:1]), size, margins, paint
    )


def _responses(shown: TrialCourse, axes: Axes, *, motion: Motion) -> tuple[str, str]:
    unit = "mm" if motion == "translation" else "mrad"
    low, high = _range(np.append(shown.position, shown.final) * MILLI)
    axes.set_xlim(*_time_range(shown.time))
    axes.set_ylim(low, high)
    if np.isfinite(shown.final):
        axes.axhline(MILLI * shown.final, color=style.INK, lw=0.7, ls=style.LINES["linear"])
    handles = axes.plot(*_line(shown.time, shown.position), color=style.BLUE, lw=LOG, alpha=0.45, label="log")
    for each in shown.beside:
        colour, line = LOOKS[each.label]
        handles += axes.plot(*_line(shown.time, each.position), color=colour, ls=line, lw=1.2, label=each.label)
    canvas.frame(axes, "time after the command edge [ms]", f"displacement [{unit}]", title="response")
    axes.figure.legend(handles=handles, ncols=2, loc="lower left", bbox_to_anchor=(52 / SIZE[0], 0.0), **LEGEND)
    return ": response", f"Displacement over time: {', '.join(['log', *(each.label for each in shown.beside)])}."


def _residual(shown: TrialCourse, axes: Axes, *, motion: Motion) -> tuple[str, str]:
    both = np.concatenate([shown.residual, [-shown.rounding, shown.rounding]])
    power = _power(float(np.nanmax(np.abs(both), initial=0.0)))
    unit = PREFIXES[power] + ("N" if motion == "translation" else "Nm")
    low, high = _range(both * 10.0**-power)
    rounding = shown.rounding * 10.0**-power
    axes.set_xlim(*_time_range(shown.time))
    axes.set_ylim(low, high)
    axes.axhspan(-rounding, rounding, color=style.SKY, alpha=0.3, lw=0)
    time, residual = thinned(shown.time, shown.residual)
    axes.plot(MILLI * time, residual * 10.0**-power, color=style.BLUE, lw=1.0)
    canvas.frame(axes, "time after the command edge [ms]", f"residual [{unit}]", title="command minus wall law")
    return ": residual of the wall law", "Logged command minus that of the wall law over time; shaded: rounding."


def _power(largest: float) -> int:
    """Return the power of ten of `PREFIXES` in which a number has few digits before its point."""
    power = 3 * int(np.floor(np.log10(largest) / 3)) if largest > 0 else 0
    return min(max(power, min(PREFIXES)), max(PREFIXES))


def _line(time: Floats, position: Floats) -> tuple[Floats, Floats]:
    at, values = thinned(time, position)
    return MILLI * at, MILLI * values


def _time_range(time: Floats) -> tuple[float, float]:
    first, last = MILLI * float(time[0]), MILLI * float(time[-1])
    return first, last if last > first else first + 1.0


def _range(values: Floats) -> tuple[float, float]:
    """Return limits of an axis with some room beyond all values and zero."""
    known = np.append(values[np.isfinite(values)], 0.0)
    room = 0.06 * float(np.ptp(known)) or 1.0
    return float(known.min()) - room, float(known.max()) + room
