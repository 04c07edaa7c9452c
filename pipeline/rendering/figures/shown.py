"""What a panel shows, in numbers: for pointing at it on the page, and as a CSV file beside its SVG.

Lines are taken from the axes that they were drawn on, so that picture and numbers cannot differ.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipeline.records.batch import Floats
from pipeline.rendering.figures.svg import UNIT

DIGITS = 4
"""Digits of the numbers: a figure of 350 px shows three. The tables have all."""

HEAD = ("panel", "abscissa", "ordinate", "series", "x", "y", "value")
"""Columns of the CSV of a figure; ``value`` is what points have beside their place, else empty."""

_MORE = "_pipeline_points"


class Panel(str):
    """The ``<svg>`` element of a panel, with what it shows.

    ``shown`` has the name of the panel and one entry for each of its axes: ``box`` (left, top, right, bottom in units
    of the drawing), ``x`` and ``y`` (values at the ends of the box), ``names`` of both and of a third value, and
    ``series``: label, x, y and, where there is one, that value.
    """

    shown: dict[str, Any]

    def __new__(cls, svg: str, shown: dict[str, Any]) -> Panel:
        """Return the text with what it shows."""
        panel = super().__new__(cls, svg)
        panel.shown = shown
        return panel


def tell(axes: Axes, label: str, x: Floats, y: Floats, value: Floats | None = None, name: str = "") -> None:
    """Add points that are drawn by no line of their own, on request with a third value and its name."""
    points = getattr(axes, _MORE, [])
    points.append((label, x, y, value, name))
    setattr(axes, _MORE, points)


def name_axes(axes: Axes, x: str, y: str) -> None:
    """Say what the axes are."""
    axes.set_gid(f"{x}|{y}")


def forget(axes: Axes) -> None:
    """Take from axes what `tell` added: the next panel is drawn on them."""
    setattr(axes, _MORE, [])


def shown_on(drawing: Figure, name: str) -> dict[str, Any]:
    """Return what all axes of a drawing show; see `Panel`."""
    height = float(drawing.get_size_inches()[1] * drawing.dpi)
    below = next((axes.get_gid() for axes in reversed(drawing.axes) if axes.get_gid()), None) or "|"
    found = [_of_axes(axes, height, below.partition("|")[0]) for axes in drawing.axes]
    return {"name": name.strip(" ,:"), "axes": [each for each in found if each]}


def figure_csv(panels: Sequence[Mapping[str, Any]]) -> str:
    """Return what the panels of a figure show as CSV: one row a point."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(HEAD)
    for panel in panels:
        for axes in panel["axes"]:
            for label, *columns in axes["series"]:
                place = (panel["name"], *axes["names"][:2], label)
                writer.writerows([*place, *row][: len(HEAD)] for row in zip(*columns, strict=True))
    return stream.getvalue()


def _of_axes(axes: Axes, height: float, abscissa: str) -> dict[str, Any] | None:
    series: list[list[Any]] = []
    for line in axes.lines:
        label = str(line.get_label())
        if not label.startswith("_") and line.get_transform() == axes.transData:
            x, y = (np.asarray(part, dtype=np.float64) for part in line.get_data())
            series += _series(label, x, y, None)
    third = ""
    for label, x, y, value, name in getattr(axes, _MORE, []):
        series += _series(label, x, y, value)
        third = name or third
    if not series:
        return None
    own, _, ordinate = str(axes.get_gid() or "|").partition("|")
    box = axes.bbox
    ends = (box.x0, height - box.y1, box.x1, height - box.y0)
    return {
        "box": [round(end * UNIT) for end in ends],
        "x": [_rounded(end, 6) for end in axes.get_xlim()],
        "y": [_rounded(end, 6) for end in axes.get_ylim()],
        "names": [own or abscissa, ordinate, third],
        "series": series,
    }


def _series(label: str, x: Floats, y: Floats, value: Floats | None) -> list[list[Any]]:
    known = np.isfinite(x) & np.isfinite(y)
    if not known.any():
        return []
    columns = [x[known], y[known], *([value[known]] if value is not None else [])]
    return [[label, *([_rounded(float(v), DIGITS) for v in column] for column in columns)]]


def _rounded(value: float, digits: int) -> float | int | None:
    if not np.isfinite(value):
        return None
    found = float(f"{value:.{digits}g}")
    return int(found) if found == int(found) else found
