"""Draw figures with matplotlib, and write them as SVG in the colours of a page, as PDF, and as a data frame.

A figure consists of panels, and a panel consists of series. `LOOKS` describes the look of each kind of series. Only the
contours and marks of a map are not series (`Panel.paint`).
"""

from __future__ import annotations

import io
import re
import unicodedata
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.base.disk import replacing, write_text
from pipeline.base.errors import UsageError
from pipeline.records.models import FigureKind
from pipeline.records.trials import Floats
from pipeline.rendering.labels import shortened

if TYPE_CHECKING:  # importing matplotlib takes half a second, and only drawing needs it
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing

# Colours of Okabe and Ito (2008), which remain distinct with all common kinds of colour blindness. Their yellow is left
# out because it vanishes on white, and their black because it vanishes on a dark page.
BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY = "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"
INK, FAINT, PAPER, NOTE = "#010101", "#dddddd", "#fffffe", "#b87503"
GREY = "#767676"
"""Colour of curves that belong to no experiment. It has enough contrast in light and dark mode."""

SERIES = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY, INK)
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
"""Markers that distinguish the series in grey, in the order of `SERIES`."""

ON_PAGE = {
    INK: "currentColor",
    FAINT: "var(--fig-faint,#ccc)",
    PAPER: "var(--paper,#fff)",
    NOTE: f"var(--note-line,{NOTE})",
} | {
    colour: f"var(--fig-{name},{colour})"
    for name, colour in zip(("blue", "vermillion", "green", "purple", "orange", "sky"), SERIES[:6], strict=True)
}
"""Variables of the page's style sheet that replace the colours. One drawing thereby suits light and dark mode."""

RC: Any = {
    "text.parse_math": False,  # a dollar sign in a name does not start a formula
    "svg.fonttype": "none",
    "pdf.fonttype": 42,
    "path.simplify_threshold": 0.15,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "axes.formatter.limits": (-4, 7),
    "axes.formatter.useoffset": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.labelsize": 11.0,
    "axes.titlesize": 11.0,
    "axes.titlelocation": "left",
    "axes.titley": 1.0,  # otherwise all tick labels are laid out twice, to find whether one of them is above the axes
    "grid.color": FAINT,
    "grid.linewidth": 0.6,
    "font.size": 10.0,
    "lines.solid_capstyle": "butt",
    "legend.frameon": False,
    **dict.fromkeys(("axes.edgecolor", "axes.labelcolor", "text.color", "xtick.color", "ytick.color"), INK),
}

MISSING_GLYPH = r"Glyph \d+ .* missing from font"
"""Matplotlib's warning about a character that its font lacks."""

TAG_WIDTH, TAG_HEIGHT = 5.0, 11.0
"""Width of a character and height of a line of the names of curves [px]."""

LARGER = 1.4
"""Largest text size in print and on a phone, relative to the drawing. Legends leave room for this size."""

_DASHED, _DOTTED = (0, (5, 2)), (0, (1, 1.8))
VARIANTS = (_DASHED, _DOTTED, (0, (5, 1.5, 1, 1.5)), (0, (9, 3)), (0, (5, 1.5, 1, 1.5, 1, 1.5)), (0, (2.5, 2.5)))
"""Dashes that distinguish the variants of a curve, such as theory for several delays."""

STEPS = (4.0, 6.0, 8.5, 11.0)
"""Sizes of square marks [px] for deviations of increasing size."""

LOOKS: dict[str, dict[str, Any]] = {
    "others": {"color": INK, "lw": 0.8, "alpha": 0.45},
    "untested": {"color": GREY, "lw": 0.0, "fill": 0.16},
    "use": {"color": GREEN, "lw": 1.4, "fill": 0.3},
    "stable": {"color": INK, "dots": 2.6},
    "unstable": {"color": INK, "ls": "none", "marker": "x", "ms": 5.0, "mew": 1.3},
    "envelope": {"color": INK, "fill": 0.13},
    "passive": {"color": INK, "lw": 0.8, "fill": 0.22},
    "robust": {"color": INK, "lw": 0.8, "ls": "-."},
    "measured": {"lw": 1.4, "ms": 3.4, "mew": 0, "interval": 6.0},
    "bound": {"ls": "none", "ms": 5, "mfc": PAPER, "mew": 1.1},
    "theory": {"lw": 1.4, "ls": _DASHED},
    "identified": {"color": INK, "lw": 1.2, "ls": (0, (4, 1.5, 1, 1.5))},
    "straight": {"color": GREY, "lw": 2.0},
    "linear": {"color": INK, "lw": 1.6, "ls": _DOTTED},
    "friction": {"color": INK, "lw": 1.2, "ls": (0, (3, 1, 1, 1, 1, 1))},
    "edge": {"color": INK, "lw": 1.2},
    "dots": {"color": GREEN, "dots": 2.6},
    "residual": {"dots": 3.4},
    "bar": {"bar": 0.8},
    "hover": {"color": INK},
    "course": {"lw": 1.6},
    "line": {"color": INK, "lw": 1.3},
    "best": {"color": BLUE, "lw": 1.1},
    "best other": {"color": BLUE, "lw": 1.1, "ls": _DASHED},
    "optimum": {"color": BLUE, "ls": "none", "marker": "+", "ms": 12, "mew": 2.3},
    "log": {"color": BLUE, "lw": 1.2},
    "wide log": {"color": BLUE, "lw": 3.4, "alpha": 0.45},
    "model": {"color": VERMILLION, "lw": 1.2, "ls": _DOTTED},
    "fitted": {"color": GREEN, "lw": 1.2, "ls": (0, (4, 1.5, 1, 1.5))},
    "final": {"color": INK, "lw": 0.8, "ls": _DOTTED},
    "span": {"color": SKY, "span": 0.3},
    "gap": {"color": VERMILLION, "span": 0.5},
    "next": {"color": PURPLE, "ls": "none", "marker": "D", "ms": 6, "mfc": "none", "mew": 1.6},
    "mark": {"color": VERMILLION, "ls": "none", "marker": "o", "ms": 7, "mfc": "none", "mew": 1.5},
    "estimate": {"color": BLUE, "ls": "none", "marker": "o", "ms": 6, "mew": 0, "interval": 1.4},
    "group": {"ls": "none", "ms": 4.5, "mew": 0, "interval": 1.4},
    "free run": {"color": VERMILLION, "lw": 1.2},
    **{f"step {n}": {"color": INK, "ls": "none", "marker": "s", "ms": size, "mew": 0} for n, size in enumerate(STEPS)},
}
"""Appearance of each kind of series, in the order of drawing and of the legend: arguments of `plot`; ``fill`` is the
opacity of an area, ``dots`` the size of dots drawn as one path, ``interval`` the width of the bar from ``low`` to
``high``, ``span`` the opacity of a strip over the whole height, ``bar`` the width that the bars of all series share. A
series without a colour gets that of its number."""


PALE_INTERVAL = "95 % interval"
"""Name in the legend of the pale bars along a limit."""

THIN_INTERVAL = 2.0
"""Largest width of an interval [points] that is drawn as an opaque line. Wider intervals are pale bars."""


@dataclass(frozen=True, eq=False)
class Series:
    """Series to draw, with x and y of shape (n,) and a kind in `LOOKS`.

    ``low`` and ``high`` are the ends of an interval in the direction ``along`` ("x" or "y"). ``value`` is a third
    number for each point, and ``value_name`` is its name. ``number`` is the index of an experiment in the report, which
    gives it the same colour in each figure. ``bars`` is the number of series of bars that share the width. ``variant``
    is the index of a curve that belongs to no experiment; variants are grey, with different dashes. ``tag`` is a text
    at the visible point of a curve with the largest x. A label that begins with an underscore is left out of legends.
    """

    label: str
    kind: str
    x: Floats
    y: Floats
    low: Floats | None = None
    high: Floats | None = None
    number: int | None = None
    along: str = "x"
    value: Floats | None = None
    value_name: str = ""
    bars: int = 1
    variant: int | None = None
    tag: str = ""


@dataclass(frozen=True, eq=False)
class Panel:
    """Axes with series, labelled by quantity and unit, and a description. The panel ``below`` shares the abscissa.

    ``paint`` draws everything that is not a series. ``ticks`` are texts at the positions 0, 1, 2 ... of the abscissa.
    """

    title: str
    names: tuple[str, str]
    series: tuple[Series, ...]
    words: str
    limits: tuple[tuple[float, float] | None, tuple[float, float] | None] = (None, None)
    paint: Callable[[Axes], None] | None = None
    below: Panel | None = None
    ticks: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Figure:
    """Figure of a report, which consists of panels side by side, a title and a caption.

    ``show`` and ``criterion`` select a figure of costs among the others. ``size`` is the size of a panel.
    """

    kind: FigureKind
    identifier: str
    title: str
    caption: str
    panels: tuple[Panel, ...]
    criterion: str = ""
    show: str = ""
    size: tuple[float, float] = (440.0, 345.0)
    simulated: bool = False

    @property
    def frame(self) -> pd.DataFrame:
        """All points: ``panel``, ``abscissa``, ``ordinate``, ``series``, ``x``, ``y``, ``low``, ``high``, ``value``."""
        import pandas as pd

        parts = [
            pd.DataFrame(
                {"x": s.x, "y": s.y, "low": s.low, "high": s.high, "value": s.value}, index=range(len(s.x))
            ).assign(panel=panel.title, abscissa=own.names[0], ordinate=own.names[1], series=s.label.lstrip("_"))
            for panel in self.panels
            for own in _both(panel)
            for s in own.series
        ]
        columns = ["panel", "abscissa", "ordinate", "series", "x", "y", "low", "high", "value"]
        return pd.concat(parts, ignore_index=True)[columns] if parts else pd.DataFrame(columns=columns)


@dataclass(frozen=True)
class Drawn:
    """Figure on the page.

    Panels are ``<svg>`` elements, with the numbers that are shown when the pointer hovers over them.
    """

    figure: Figure
    panels: tuple[str, ...]
    shown: tuple[dict[str, Any], ...]


def draw(figure: Figure) -> Drawn:
    """Draw the panels of a figure for a page."""
    svgs, shown = [], []
    for index, (panel, drawing) in enumerate(_drawings(figure)):
        name = f"{figure.identifier}-{index}"
        title = f"{figure.title}{': ' if panel.title else ''}{panel.title}"
        svgs.append(svg_of(drawing, name, title, panel.words))
        height = float(drawing.get_size_inches()[1] * 72)
        axes = [_numbers(own, axes, height) for own, axes in zip(_both(panel), drawing.axes, strict=True)]
        shown.append({"name": panel.title, "axes": [each for each in axes if each["series"]]})
    return Drawn(figure, tuple(svgs), tuple(shown))


def svg_of(drawing: Drawing, identifier: str, title: str, words: str) -> str:
    """Return a drawing as a reproducible ``<svg>`` element in the colours of the page."""
    import matplotlib

    stream = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": identifier}), warnings.catch_warnings():
        # text stays text in the file, and the viewer provides the fonts
        warnings.filterwarnings("ignore", MISSING_GLYPH, UserWarning)
        drawing.savefig(stream, format="svg", metadata={"Date": None})
    return _for_page(stream.getvalue(), identifier, title, words)


def spell_missing_glyphs(drawing: Drawing) -> None:
    """Replace the characters that the font of a drawing lacks by their code points, as in ``[U+673A]``.

    This is meant for formats that contain glyphs instead of text. In these formats, all missing characters would look
    like the same box. Combining marks are left out.
    """
    from matplotlib.font_manager import findfont, get_font
    from matplotlib.text import Text

    known = get_font(findfont("DejaVu Sans")).get_charmap()
    for text in drawing.findobj(Text):
        spelt = "".join(each if ord(each) in known else _code_point(each) for each in text.get_text())
        if spelt != text.get_text():
            text.set_text(spelt)


def _code_point(character: str) -> str:
    if unicodedata.category(character) == "Cc":
        return "\n" if character == "\n" else " "
    return "" if unicodedata.category(character) in ("Mn", "Me", "Cf") else f"[U+{ord(character):04X}]"


def write_figures(figures: Sequence[Figure], folder: Path) -> tuple[Path, ...]:
    """Write each panel as SVG and PDF, and the numbers of each figure as CSV. Other files are not changed."""
    written = []
    for figure in figures:
        written.append(folder / f"{figure.identifier}.csv")
        write_text(written[-1], figure.frame.to_csv(index=False, lineterminator="\n"))
        svgs = draw(figure).panels
        for index, (_, drawing) in enumerate(_drawings(figure)):
            path = folder / f"{figure.identifier}-{index}"
            stream = io.BytesIO()
            spell_missing_glyphs(drawing)
            drawing.savefig(stream, format="pdf", metadata=PLAIN["pdf"])
            for ending, content in ((".svg", standalone(svgs[index]).encode()), (".pdf", stream.getvalue())):
                with replacing(path.with_name(path.name + ending)) as file:
                    file.write(content)
                written.append(path.with_name(path.name + ending))
    return tuple(written)


def write_picture(figure: Figure, path: Path) -> None:
    """Write a figure with one panel as SVG, PDF or PNG, depending on the file extension.

    Raises
    ------
    UsageError
        For another extension.
    """
    kind = path.suffix.lower().removeprefix(".")
    if kind not in PICTURES:
        raise UsageError(f"{path}: expected a name that ends with .{', .'.join(PICTURES[:-1])} or .{PICTURES[-1]}.")
    ((panel, drawing),) = _drawings(figure)
    if kind == "svg":
        content = standalone(svg_of(drawing, figure.identifier, figure.title, panel.words)).encode()
    else:
        stream = io.BytesIO()
        spell_missing_glyphs(drawing)
        drawing.savefig(stream, format=kind, dpi=144, metadata=PLAIN[kind])
        content = stream.getvalue()
    with replacing(path) as file:
        file.write(content)


PICTURES = ("svg", "pdf", "png")
"""File extensions of a picture."""

PLAIN: dict[str, dict[str, str | None]] = {
    "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
    "png": {"Software": None},
}
"""Metadata that are omitted, so that equal figures give equal files."""


def standalone(svg: str) -> str:
    """Return a drawing of a page as a standalone file with namespaces and in print colours."""
    plain = re.sub(r"var\(--[\w-]+,([^()]*)\)", r"\1", svg).replace("currentColor", "#000000")
    spaces = 'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink"'
    return plain.replace("<svg ", f"<svg {spaces} ", 1) + "\n"


def reach(*values: Floats) -> tuple[float, float]:
    """Return axis limits that start at zero or below and end slightly beyond all finite values."""
    known = np.concatenate([np.zeros(1), *(each[np.isfinite(each)] for each in values)])
    return float(known.min()) * 1.06, float(known.max()) * 1.06 or 1.0


def around(*values: Floats) -> tuple[float, float]:
    """Return axis limits with a margin on both sides of all finite values."""
    known = np.concatenate([each[np.isfinite(each)] for each in values])
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    room = 0.06 * (high - low) or 0.05 * abs(high) or 1.0
    return low - room, high + room


def _both(panel: Panel) -> Iterator[Panel]:
    yield panel
    if panel.below is not None:
        yield panel.below


def _drawings(figure: Figure) -> Iterator[tuple[Panel, Drawing]]:
    """Yield each panel with its drawing, all of equal size, with the settings of `RC`."""
    import matplotlib
    from matplotlib.figure import Figure as Drawing

    width, height = figure.size
    lines = max((_legend_lines(panel, width)[1] for panel in figure.panels), default=0)
    legend = 18.0 * lines + 8.0 * bool(lines)
    for panel in figure.panels:
        with matplotlib.rc_context(RC):
            drawing = Drawing(figsize=(width / 72, (height + legend) / 72), dpi=72)
            top = 24.0 if any(each.title for each in figure.panels) else 10.0
            floors = [44.0, 0.44 * height] if panel.below is not None else [44.0]
            tops = [0.44 * height - 22.0, height - top] if panel.below is not None else [height - top]
            for own, floor, end in zip(_both(panel), reversed(floors), reversed(tops), strict=True):
                whole = height + legend
                box = 66 / width, (floor + legend) / whole, 1 - 90 / width, (end - floor) / whole
                _paint(drawing.add_axes(box), own)
            if panel.below is not None:
                drawing.axes[0].tick_params(labelbottom=False)
            drawing.axes[0].set_title(shortened(panel.title, int(width / 6.6)))
            columns, _ = _legend_lines(panel, width)
            handles = [artist for axes in drawing.axes for artist in _named(axes)]
            if handles and columns:
                longest = max(len(str(each.get_label())) for each in handles)
                look: dict[str, Any] = {"handlelength": 2.2, "labelspacing": 0.55, "borderpad": 0.1}
                look |= {"columnspacing": 1.4 + (LARGER - 1) * 0.56 * longest, "loc": "upper left"}
                anchor = 60 / width, legend / (height + legend)
                drawing.legend(handles=handles, ncols=columns, bbox_to_anchor=anchor, **look)
            if figure.simulated:
                drawing.text(1 - 12 / width, 1.0, "simulated", ha="right", va="top", fontsize=10, color=NOTE)
            yield panel, drawing


def _legend_lines(panel: Panel, width: float) -> tuple[int, int]:
    """Return the number of columns and lines of a panel's legend. They are zero if a single series needs no name."""
    series = [s for own in _both(panel) for s in own.series if not s.label.startswith("_")]
    labels = [s.label for s in series] + [PALE_INTERVAL for s in series if _has_pale_interval(s)]
    if not labels:
        return 0, 0
    columns = max(1, min(4, int((width - 60) / (36 + LARGER * 5.6 * min(max(map(len, labels)), 60)))))
    return columns, -(-len(labels) // columns)


def _has_pale_interval(series: Series) -> bool:
    """Return whether a series has intervals that are drawn as pale bars."""
    return series.low is not None and LOOKS[series.kind].get("interval", 0.0) > THIN_INTERVAL


def _named(axes: Axes) -> list[Any]:
    artists = [*axes.patches, *axes.lines, *axes.artists]
    found = [artist for artist in artists if (label := str(artist.get_label())) and not label.startswith("_")]
    return sorted(found, key=lambda artist: artist.get_gid() or "")


def _paint(axes: Axes, panel: Panel) -> None:
    order = list(LOOKS)
    axes.set_xlabel(panel.names[0])
    axes.set_ylabel(panel.names[1], labelpad=11.0)
    axes.locator_params(nbins=6, steps=[1, 2, 2.5, 5, 10])
    if panel.limits[0] is not None:
        axes.set_xlim(*panel.limits[0])
    if panel.limits[1] is not None:
        axes.set_ylim(*panel.limits[1])
    if panel.paint is not None:
        panel.paint(axes)
    for series in sorted(panel.series, key=lambda series: order.index(series.kind)):
        _paint_series(axes, series, f"{order.index(series.kind):02d}")
    _name_curves(axes, [series for series in panel.series if series.tag])
    if panel.ticks:
        axes.set_xticks(range(len(panel.ticks)), panel.ticks, fontsize=9.0)


def _paint_series(axes: Axes, series: Series, place: str) -> None:
    if series.kind == "hover":  # `Panel.paint` draws these series. They are needed here for hovering and for files.
        return
    look = dict(LOOKS[series.kind])
    fill, dots_, interval, span, bar = (look.pop(name, 0.0) for name in ("fill", "dots", "interval", "span", "bar"))
    number = series.number or 0
    look.setdefault("color", INK if series.number is None else SERIES[number % len(SERIES)])
    if series.variant is not None:
        look |= {"color": GREY, "ls": VARIANTS[series.variant % len(VARIANTS)]}
    if series.kind in ("measured", "bound", "group"):
        look["marker"] = MARKERS[number % len(MARKERS)]
    if "mfc" in look:
        look["mec"] = look["color"]
    named: dict[str, Any] = {"label": shortened(series.label, 60), "gid": place}
    x, y = series.x, series.y
    if span:
        axes.axvspan(x[0], x[-1], color=look["color"], alpha=span, lw=0, **named)
        return
    if bar:
        axes.bar(x, y, width=bar / series.bars, color=look["color"])
        axes.fill([], [], color=look["color"], lw=0, **named)
        return
    if dots_:
        dots(axes, x, y, look["color"], dots_)
        axes.plot([], [], "o", ms=dots_ + 1, mew=0, color=look["color"], **named)
        return
    if series.low is not None and series.high is not None and fill:
        known = np.isfinite(series.low) & np.isfinite(series.high)
        axes.fill_betweenx(y[known], series.low[known], series.high[known], color=look["color"], alpha=fill, lw=0)
        axes.fill([], [], color=look["color"], alpha=fill, lw=0, **named)
        return
    if series.low is not None and series.high is not None and interval:
        # an interval from zero has no lower bound
        known = np.isfinite(series.low) & np.isfinite(series.high) & ((series.low > 0) | (series.along == "y"))
        lines = axes.hlines if series.along == "x" else axes.vlines
        at = y if series.along == "x" else x
        alpha = 0.45 if interval > THIN_INTERVAL else 1.0
        lines(at[known], series.low[known], series.high[known], color=look["color"], alpha=alpha, lw=interval)
        if _has_pale_interval(series):
            axes.plot([], [], color=look["color"], alpha=alpha, lw=interval, label=PALE_INTERVAL, gid=place)
    if fill:
        axes.fill(x, y, color=look["color"], alpha=fill, lw=0, label="_")
        axes.plot(x, y, **look)
        axes.fill([], [], fc=(look["color"], fill), ec=look["color"], lw=look.get("lw", 0.0), **named)
        return
    axes.plot(x, y, **look, **named)


def _name_curves(axes: Axes, named: Sequence[Series]) -> None:
    """Write the tag of each curve at its visible point with the largest x.

    From the top down, a name that would cover another name is written below that name.
    """
    box: dict[str, Any] = {"facecolor": PAPER, "edgecolor": "none", "pad": 0.6, "alpha": 0.8}
    names = []
    for series in named:
        seen = (series.x <= axes.get_xlim()[1]) & (series.y <= axes.get_ylim()[1]) & np.isfinite(series.x)
        if seen.any():
            farthest = int(np.argmax(np.where(seen, series.x, -np.inf)))
            at = float(series.x[farthest]), float(series.y[farthest])
            text = axes.annotate(
                shortened(series.tag, 14), at, (2, 0), textcoords="offset points", va="center", fontsize=8.0, bbox=box
            )
            names.append((*axes.transData.transform(at).tolist(), text))
    taken: list[tuple[float, float, float]] = []
    for x, y, text in sorted(names, key=lambda name: -name[1]):
        end, height = x + TAG_WIDTH * len(text.get_text()), y
        for first, last, above in taken:
            if first < end and x < last and height > above - TAG_HEIGHT:
                height = above - TAG_HEIGHT
        taken.append((x, end, height))
        text.set_position((2, height - y))


def dots(axes: Axes, x: Floats, y: Floats, colour: str, size: float, *, square: bool = False) -> None:
    """Draw points as one compact path whose dots are lines of zero length with round caps."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline

    known = np.isfinite(x) & np.isfinite(y)
    if known.any():
        ends = np.repeat(np.column_stack([x[known], y[known]]), 2, axis=0)
        outline = Outline(ends, np.tile(np.array([Outline.MOVETO, Outline.LINETO], dtype=np.uint8), known.sum()))
        outline.should_simplify = False  # simplification would drop lines without length
        cap: Any = "projecting" if square else "round"
        look: dict[str, Any] = {"fill": False, "edgecolor": colour, "lw": size, "capstyle": cap, "zorder": 2.1}
        axes.add_artist(PathPatch(outline, transform=axes.transData, label="_", **look))


_STYLE = re.compile(r'style="([^"]*)"')
_SHORTER = [
    (re.compile(pattern, re.DOTALL), text)
    for pattern, text in (
        (r"<metadata>.*?</metadata>|<!--.*?-->|<defs>\s*<style.*?</style>\s*</defs>", ""),
        (r'<g id="[^"]*"', "<g"),
        (r' transform="rotate\(-0 [^)]*\)"', ""),
        (r'<path d="[^"]*"(?: clip-path="[^"]*")? fill="none"/>', ""),  # empty areas
        (r"M (\S+) (\S+)\s+L \1 \2\s+(?=[M\"])", r"M\1 \2h0"),  # dots
        (r"(?<=\d)\s+L (?=[-\d])", " "),
        (r"\s*\n\s*", " "),
        (r"> <", "><"),
        (r' "(?=[ /])', '"'),
    )
]
_NUMBER = re.compile(r"-?\d+\.\d{2,}(?:e-?\d+)?(?=[\s\"),z])")


def _for_page(text: str, identifier: str, title: str, words: str) -> str:
    """Return matplotlib's output as a short ``<svg>`` element with a name and in the colours of the page.

    Coordinates are rounded to a tenth of a pixel. Styles become attributes, which the page's policy allows.
    """
    text = text[text.index("<svg ") :]
    box = re.search(r'viewBox="[^"]*"', text)
    body = _STYLE.sub(_attributes, text[text.index(">") + 1 : text.rindex("</svg>")])
    # only in attributes: a text may be an equation number
    body = re.sub(r"<[^>]*>", lambda tag: _NUMBER.sub(_tenths, tag[0]), body)
    for pattern, shorter in _SHORTER:
        body = pattern.sub(shorter, body)
    body = _without_plain_groups(body)
    for colour, variable in ON_PAGE.items():
        body = body.replace(colour, variable)
    return (
        f'<svg {box[0] if box else ""} role="img" aria-labelledby="{identifier}-title {identifier}-desc" '
        f'font-family="system-ui,\'Helvetica Neue\',Arial,sans-serif" stroke-linejoin="round" fill="currentColor">'
        f'<title id="{identifier}-title">{escape(title)}</title><desc id="{identifier}-desc">{escape(words)}</desc>'
        f"{body}</svg>"
    )


def _tenths(number: re.Match[str]) -> str:
    return f"{float(number[0]):.1f}".removesuffix(".0")


def _without_plain_groups(body: str) -> str:
    """Return SVG text without empty groups, and without the tags of groups that have no attributes.

    The content of these groups is kept.
    """
    open_groups: list[bool] = []

    def kept(tag: re.Match[str]) -> str:
        if tag[0].endswith("/>"):
            return ""
        if tag[0] == "</g>":
            return "" if open_groups.pop() else tag[0]
        open_groups.append(tag[0] == "<g>")
        return "" if open_groups[-1] else tag[0]

    return re.sub(r"<g(?: [^>]*)?>|</g>", kept, body)


def _attributes(style: re.Match[str]) -> str:
    pairs = (part.partition(":") for part in style[1].split(";") if part.strip())
    kept = {name.strip(): value.strip() for name, _, value in pairs}
    if "font" in kept:  # "font: 700 10px 'DejaVu Sans', ..."
        found = re.search(r"([\d.]+)px", kept.pop("font"))
        kept["font-size"] = found[1] if found else "10"
    kept = {
        name: value.removesuffix("px") for name, value in kept.items() if name not in ("font-family", "stroke-linejoin")
    }
    return " ".join(f'{name}="{value}"' for name, value in kept.items())


def _numbers(panel: Panel, axes: Axes, height: float) -> dict[str, Any]:
    """Return the data of the axes that the page shows when the pointer hovers over them.

    The data are the box of the axes in the drawing, the values at the ends of this box, the names and the series.
    """
    box = axes.bbox
    third = next((s.value_name for s in panel.series if s.value_name), "")
    found = []
    for s in panel.series:
        known = np.isfinite(s.x) & np.isfinite(s.y)
        columns = [s.x, s.y, *([s.value] if s.value is not None else [])]
        if known.any() and LOOKS[s.kind].get("fill") is None and "span" not in LOOKS[s.kind]:
            found.append([s.label.lstrip("_"), *([few_digits(v, 4) for v in column[known]] for column in columns)])
    return {
        "box": [round(float(end), 1) for end in (box.x0, height - box.y1, box.x1, height - box.y0)],
        "x": [float(f"{end:.6g}") for end in axes.get_xlim()],
        "y": [float(f"{end:.6g}") for end in axes.get_ylim()],
        "names": [*panel.names, third],
        "series": found,
    }


def few_digits(value: float, digits: int) -> float | int | None:
    """Return a number rounded to ``digits`` digits, as an integer if it is whole, or None if it is not finite."""
    found = float(f"{value:.{digits}g}") if np.isfinite(value) else None
    return int(found) if found is not None and found == int(found) else found
