"""Look of the figures: colours, line styles, and SVG that fits into a page in light and dark.

Figures are drawn in fixed colours; afterwards each becomes a variable of the page's style sheet, so that one
SVG serves both colour schemes. Output depends on the input only: no date, no random identifiers.
"""

from __future__ import annotations

from html import escape
from typing import Any

from matplotlib.figure import Figure

from pipeline.rendering.figures.svg import SEEN, UNIT, Writer

# Colours of Okabe and Ito (2008), told apart by all common kinds of colour blindness; their yellow and black
# are left out: one vanishes on white, the other on a dark page.
BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY = (
    "#0072b2",
    "#d55e00",
    "#009e73",
    "#cc79a7",
    "#e69f00",
    "#56b4e9",
)
# Stand-ins for colours of the page; no other element is drawn in them.
INK, FAINT, PAPER = "#010203", "#010204", "#010205"

PAGE_COLOURS = {
    INK: "currentColor",
    FAINT: "var(--fig-faint,#ccc)",
    PAPER: "var(--paper,#fff)",
    BLUE: f"var(--fig-blue,{BLUE})",
    VERMILLION: f"var(--fig-vermillion,{VERMILLION})",
    GREEN: f"var(--fig-green,{GREEN})",
    PURPLE: f"var(--fig-purple,{PURPLE})",
    ORANGE: f"var(--fig-orange,{ORANGE})",
    SKY: f"var(--fig-sky,{SKY})",
}
BEHIND_TEXT: Any = {"facecolor": PAPER, "edgecolor": "none", "pad": 0.8, "alpha": 0.85}
"""Ground that keeps a text in a drawing readable."""
TICK_STEPS = (1, 2, 2.5, 5, 10)
"""Ticks at round numbers only."""
SERIES = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY, INK)
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
"""Markers that tell the series apart in grey, in the order of `SERIES`."""
LINES: dict[str, Any] = {
    "measured": "-",
    "theory": (0, (5, 2)),
    "linear": (0, (1, 1.8)),
    "band": (0, (1, 2.5)),
    "bound": (0, (4, 1.5, 1, 1.5)),
    "friction": (0, (3, 1, 1, 1, 1, 1)),
    "passive": "-",
    "robust": "-.",
    "envelope": "-",
    "use": "-",
    "stable": "none",
    "unstable": "none",
}
DOTS: dict[str, Any] = {
    "stable": {"marker": "o", "ms": 2.6, "mew": 0},
    "unstable": {"marker": "x", "ms": 5.0, "mew": 1.3},
}
"""Marks of single trials."""

RC: Any = {
    "text.parse_math": False,  # a dollar sign in a name is no formula
    "path.simplify_threshold": SEEN,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "font.size": 11.0,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.titlesize": 11.5,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": FAINT,
    "grid.linewidth": 0.6,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.labelsize": 10.0,
    "ytick.labelsize": 10.0,
    "legend.fontsize": 10.0,
    "legend.frameon": False,
    "figure.dpi": 72.0,  # one unit of the SVG is one pixel of the layout
}

HEAD = (
    'font-family="system-ui,\'Helvetica Neue\',Arial,sans-serif" fill="none" stroke-width="10" stroke-linejoin="round"'
)
"""What holds in a figure unless an element says otherwise."""


WATERMARK = 'font-size="110" text-anchor="end" fill="var(--note-line,#b87503)">simulated</text>'
"""What a drawing of simulated logs bears, wherever it is taken to."""


def svg(figure: Figure, identifier: str, title: str, description: str, *, simulated: bool = False) -> str:
    """Return a figure as an ``<svg>`` element for an HTML page.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
        Drawn with the settings `RC` in the colours of this module.
    identifier : str
        Prefix of every ``id`` in the element; must be unique in the page, letters, digits, ``-`` and ``_``.
    title, description : str
        Name and content for readers who cannot see the figure; escaped here.
    simulated : bool
        Whether it shows simulated logs.
    """
    width, height = figure.get_size_inches() * figure.dpi
    writer = Writer(width, height, identifier, PAGE_COLOURS)
    figure.draw(writer)
    mark = f'<text x="{(width - 16) * UNIT:.0f}" y="{12 * UNIT}" {WATERMARK}' if simulated else ""
    return (
        f'<svg viewBox="0 0 {width * UNIT:.0f} {height * UNIT:.0f}" role="img" '
        f'aria-labelledby="{identifier}-title {identifier}-desc" {HEAD}>'
        f'<title id="{identifier}-title">{escape(title)}</title>'
        f'<desc id="{identifier}-desc">{escape(description)}</desc>{writer.elements()}{mark}</svg>'
    )
