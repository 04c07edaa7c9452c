"""A quantity over the experiments of a device: a mark with its interval for each, the experiments named below."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from pipeline.records.batch import Floats
from pipeline.records.figure_records import Figure, TrendPanel
from pipeline.records.models import Motion
from pipeline.rendering.figures import canvas, style
from pipeline.rendering.figures.shown import Panel, name_axes, tell
from pipeline.rendering.labels import shortened, significant

SIZE = (350.0, 240.0)
LETTER = 6.0
"""Mean width of a letter below a mark [px]."""
ROOM = 0.12
"""Room above and below all intervals, relative to what they span."""


def trends(figure: Figure[TrendPanel], motion: Motion = "translation") -> tuple[Panel, ...]:
    """Draw each quantity on axes of its own, the experiments at the same places."""
    return canvas.draw_panels(figure, SIZE, [(64, 38, 12, 24)], _paint)


def _paint(shown: TrendPanel, axes: Axes) -> tuple[str, str]:
    value, low, high = (np.array(part, dtype=np.float64) for part in (shown.value, shown.low, shown.high))
    at = np.arange(len(value), dtype=np.float64)
    ends = np.concatenate([part[np.isfinite(part)] for part in (value, low, high)])
    least, most = float(ends.min()), float(ends.max())
    room = ROOM * (most - least) or 0.05 * abs(most) or 1.0
    axes.set_xlim(-0.5, len(value) - 0.5)
    axes.set_ylim(least - room, most + room)
    both = np.isfinite(low) & np.isfinite(high)
    axes.vlines(at[both], low[both], high[both], color=style.BLUE, lw=1.4)
    known, bound = np.isfinite(value), np.array(shown.bound)
    for where, filled in ((known & ~bound, True), (known & bound, False)):
        look = {"mew": 0} if filled else {"mfc": style.PAPER, "mec": style.BLUE, "mew": 1.1}
        label = shown.label.partition(" [")[0] + ("" if filled else ": at least")
        axes.plot(at[where], value[where], "o", ms=6, color=style.BLUE, label=label, **look)
    for side, values in (("from", low), ("to", high)):
        tell(axes, f"95 % {side}", at, values)
    canvas.frame(axes, "", "", title=shown.label, y_ticks=4, numbers=False)
    name_axes(axes, "experiment, counted from 0", shown.label)
    _name(axes, at, shown.names)
    return f" {shown.label}", _describe(shown)


def _name(axes: Axes, at: Floats, names: tuple[tuple[str, str], ...]) -> None:
    """Write experiment and header line below each place; of many each second, third ... one."""
    box = axes.bbox
    letters = int(box.width / max(len(names), 1) / LETTER)
    step = 1 if letters >= 3 else -(-3 // max(letters, 1))
    for place, (name, line) in list(zip(at, names, strict=True))[::step]:
        x = box.x0 + (place + 0.5) * box.width / len(names)
        for text, below in ((name, 7.0), (line, 19.0)):
            fits = shortened(text, max(letters * step, 3)) if text else ""
            axes.text(x, box.y0 - below, fits, transform=None, ha="center", va="top", fontsize=9.5)


def _describe(shown: TrendPanel) -> str:
    told = [
        f"experiment {name}{f' ({line})' if line else ''}: {'at least ' if bound else ''}{significant(value, 3)}"
        for (name, line), value, bound in zip(shown.names, shown.value, shown.bound, strict=True)
        if value is not None
    ]
    return f"{shown.label} over experiments: {'; '.join(told)}."
