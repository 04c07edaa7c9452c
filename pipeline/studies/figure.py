"""What a theory figure consists of: panels of lines, contours, areas and words, all as finished numbers.

`pipeline.studies.drawing` draws them; nothing here knows of a drawing library.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.records.batch import Floats


@dataclass(frozen=True, eq=False)
class Trace:
    """A line, or marks where ``dash`` is ``none``.

    Parameters
    ----------
    x, y : float64, shape (n,)
        NaN interrupts the line.
    colour : str
        Name of a colour of `pipeline.rendering.figures.style`, in small letters.
    dash : {"solid", "dashed", "dashdot", "dotted", "none"}
    label : str
        Entry of the legend; none where empty.
    marker : str
        Sign at each point, as matplotlib names it; none where empty.
    width : float
        Width of the line [px].
    filled : bool
        Whether signs are filled.
    """

    x: Floats
    y: Floats
    colour: str = "ink"
    dash: str = "solid"
    label: str = ""
    marker: str = ""
    width: float = 1.4
    filled: bool = False

    def moved(self, x: Floats, y: Floats, **changes: Any) -> Trace:
        """Return the line through other points, with what else changes."""
        return replace(self, x=x, y=y, **changes)


@dataclass(frozen=True, eq=False)
class Contours:
    """Lines of equal cost.

    Parameters
    ----------
    x, y : float64, shapes (p,), (q,)
    z : float64, shape (q, p)
        NaN where there is no cost.
    levels : float64, shape (n,)
    labelled : tuple of float
        Levels that are written on their lines.
    scale, digits
        Factor and decimals with which they are written.
    """

    x: Floats
    y: Floats
    z: Floats
    levels: Floats
    labelled: tuple[float, ...] = ()
    scale: float = 1.0
    digits: int = 0


@dataclass(frozen=True, eq=False)
class Area:
    """A shaded polygon, corners of shape (n,)."""

    x: Floats
    y: Floats
    colour: str = "green"
    label: str = ""


@dataclass(frozen=True)
class Note:
    """Words at a point, shifted by (right, up) pixels; ``align`` is the side of the words at the point."""

    x: float
    y: float
    text: str
    align: str = "left"
    right: float = 5.0
    up: float = 0.0
    colour: str = "ink"


@dataclass(frozen=True, eq=False)
class Panel:
    """One pair of axes; ``below`` shares its abscissa and stands under it.

    ``name`` and ``description`` are for readers who cannot see it; made of the labels where empty.
    """

    title: str
    x_label: str
    y_label: str
    x_range: tuple[float, float]
    y_range: tuple[float, float]
    traces: tuple[Trace, ...] = ()
    contours: tuple[Contours, ...] = ()
    areas: tuple[Area, ...] = ()
    notes: tuple[Note, ...] = ()
    logarithmic: bool = False
    square: bool = False
    below: Panel | None = None
    name: str = ""
    description: str = ""


@dataclass(frozen=True, eq=False)
class TheoryFigure:
    """A figure of the thesis's theory chapters, computed anew.

    Parameters
    ----------
    number : str
        As in the thesis, such as ``3.6``.
    title, caption : str
        In words of our own; the caption names parameters and what is seen.
    panels : tuple of Panel
        Row by row.
    columns : int
        Panels in a row, 1 to 3.
    """

    number: str
    title: str
    caption: str
    panels: tuple[Panel, ...]
    columns: int = 2


def mark(x: float, y: float, colour: str, sign: str, label: str = "") -> Trace:
    """Return a mark at one point."""
    return Trace(np.array([x]), np.array([y]), colour, "none", label, sign)
