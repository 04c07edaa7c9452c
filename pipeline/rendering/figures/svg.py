"""What a figure of the drawing library draws, as SVG elements in few characters.

The library's own writer repeats the whole style for each element and keeps six decimals, which makes a report of 44
panels 1.7 MB instead of 0.4 MB. Here neighbours that look the same share their style or one path, points that nobody
sees are left out by the library's own rule, and places are whole tenths of a pixel, relative to each other.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from html import escape
from itertools import groupby, pairwise
from typing import Any, NamedTuple

import numpy as np
from matplotlib.backend_bases import GraphicsContextBase, RendererBase
from matplotlib.colors import to_hex
from matplotlib.font_manager import FontProperties
from matplotlib.path import Path
from matplotlib.text import Text
from matplotlib.transforms import Affine2D, Transform

from pipeline.records.batch import Floats

UNIT = 10
"""Units a pixel: a tenth of a pixel is below what any screen or printer shows of a line."""

SEEN = 0.15
"""Largest distance of a left-out point from its line [px]: a tenth of the usual line."""

_CAPS = {"projecting": "square", "round": "round"}
_ANCHORS = {"left": "", "right": "end", "center": "middle"}
_SIGN = re.compile(r" (?=-)")

Look = tuple[tuple[str, str], ...]


class Mark(NamedTuple):
    """One drawn element: its kind (path or text), its look, and its path data or the text with its place."""

    kind: str
    look: Look
    body: str


class Writer(RendererBase):
    """Collects what a figure draws, in drawing order; images and gradients are refused by the library's base class.

    Parameters
    ----------
    width, height : float
        Of the figure [px].
    prefix : str
        Begins every ``id``.
    colours : mapping of str to str
        What stands for a colour on the page, by its hexadecimal code.
    """

    def __init__(self, width: float, height: float, prefix: str, colours: Mapping[str, str]) -> None:
        super().__init__()
        self.width, self.height, self.prefix, self.colours = width, height, prefix, colours
        self.marks: list[Mark] = []
        self.clips: dict[str, str] = {}

    def elements(self) -> str:
        """Return all that was drawn; its places count in tenths of a pixel."""
        clips = "".join(f'<clipPath id="{name}"><rect{shape}/></clipPath>' for shape, name in self.clips.items())
        drawn = "".join(_element(look, list(run)) for look, run in groupby(self.marks, key=lambda mark: mark.look))
        return (f"<defs>{clips}</defs>" if clips else "") + drawn

    def flipy(self) -> bool:
        """Tell that texts are placed from above."""
        return True

    def get_canvas_width_height(self) -> tuple[float, float]:
        """Return the size of the figure [px]."""
        return self.width, self.height

    def draw_path(self, gc: GraphicsContextBase, path: Path, transform: Transform, rgbFace: Any = None) -> None:
        """Add a line, an area, or a marker."""
        look = self._look(gc, rgbFace)
        curved = path.codes is not None and bool(np.any(np.asarray(path.codes) == Path.CURVE4))
        clip = (0.0, 0.0, self.width, self.height) if rgbFace is None else None
        flipped = transform + Affine2D().scale(1.0, -1.0).translate(0.0, self.height)
        lines = _lines(path.cleaned(flipped, remove_nans=True, clip=clip, simplify=not curved))
        if lines and {"fill", "stroke"} & look.keys():  # else there is nothing to see
            body = _disc(lines[0][0], look) if curved else line_data(lines)
            self.marks.append(Mark("path", tuple(look.items()), body))

    def draw_text(
        self,
        gc: GraphicsContextBase,
        x: float,
        y: float,
        s: str,
        prop: FontProperties,
        angle: float,
        ismath: Any = False,
        mtext: Text | None = None,
    ) -> None:
        """Add a text, as text: searchable, and in the page's font."""
        look = {"font-size": _units(prop.get_size()), "fill": self._colour(gc.get_rgb())}
        if prop.get_weight() == "bold":
            look["font-weight"] = "700"
        if prop.get_style() != "normal":
            look["font-style"] = prop.get_style()
        if mtext is None or angle:
            place = f' transform="translate({_units(x)} {_units(y)})rotate({round(-angle)})"'
        else:  # letters of the page's font are not as wide as the library's: the text keeps its anchor
            x = mtext.get_transform().transform(mtext.get_unitless_position())[0]
            anchor = _ANCHORS[mtext.get_horizontalalignment()]
            look |= {"text-anchor": anchor} if anchor else {}
            place = f' x="{_units(x)}" y="{_units(y)}"'
        self.marks.append(Mark("text", tuple(look.items()), f"{place}>{escape(s, quote=False)}"))

    def _colour(self, rgb: Any) -> str:
        name = to_hex(rgb)
        return self.colours.get(name, name)

    def _look(self, gc: GraphicsContextBase, face: Any) -> dict[str, str]:
        """Return clipping and style as attributes, without what holds anyway (see `style.HEAD`)."""
        look: dict[str, str] = {}
        alpha = gc.get_alpha() if gc.get_forced_alpha() else None
        rectangle = gc.get_clip_rectangle()
        if rectangle is not None:
            x, y, width, height = rectangle.bounds
            sides = (("x", x), ("y", self.height - y - height), ("width", width), ("height", height))
            shape = "".join(f' {side}="{_units(value)}"' for side, value in sides)
            look["clip-path"] = f"url(#{self.clips.setdefault(shape, f'{self.prefix}-c{len(self.clips)}')})"
        if alpha is not None:
            look |= _opacity("opacity", alpha)
        if face is not None:
            look["fill"] = self._colour(face)
            look |= _opacity("fill-opacity", face[3] if len(face) == 4 and alpha is None else 1.0)
        if gc.get_linewidth():
            look |= {"stroke": self._colour(gc.get_rgb()), "stroke-width": _units(gc.get_linewidth())}
            look |= _opacity("stroke-opacity", gc.get_rgb()[3] if alpha is None else 1.0)
            dashes: Any = gc.get_dashes()[1]
            if dashes is not None:
                look["stroke-dasharray"] = ",".join(_units(length) for length in dashes)
            if gc.get_joinstyle() != "round":
                look["stroke-linejoin"] = gc.get_joinstyle()
            if gc.get_capstyle() in _CAPS:
                look["stroke-linecap"] = _CAPS[gc.get_capstyle()]
        return look


def line_data(lines: list[tuple[Floats, bool]]) -> str:
    """Return path data of polylines, each point written relative to the one before.

    Parameters
    ----------
    lines : list of (float64, shape (n, 2); bool)
        Points [px] of each line, and whether it returns to its first one.
    """
    text: list[str] = []
    pen = np.zeros(2, dtype=np.int64)
    for line, closed in lines:
        places = np.round(line * UNIT).astype(np.int64)
        steps = np.diff(places, axis=0)
        if closed and len(places) > 1 and (places[-1] == places[0]).all():
            steps = steps[:-1]  # closing the path draws the last step
        steps = steps[steps.any(axis=1)]
        across, down = (places[0] - pen).tolist()
        text.append(f"{'m' if text else 'M'}{across} {down}{_steps(steps.tolist())}")
        text.append("z" if closed else "" if len(steps) else "h0")
        # after "z" a path stands at its beginning again
        pen = places[0] if closed else places[0] + steps.sum(axis=0)
    return _SIGN.sub("", "".join(text))


def _disc(outline: Floats, look: dict[str, str]) -> str:
    """Return path data of the only curves there are, round markers, and make one without a border a dot.

    A dot is a line without length and with round ends: a fourth of the characters of a circle.
    """
    low, high = outline.min(axis=0) * UNIT, outline.max(axis=0) * UNIT
    x, y = np.round(0.5 * (low + high)).astype(int).tolist()
    r = round(0.5 * float(high[0] - low[0]))
    if "stroke" in look:
        return f"M{x} {y}m-{r} 0a{r} {r} 0 1 0 {2 * r} 0a{r} {r} 0 1 0-{2 * r} 0z"
    look |= {"stroke": look.pop("fill"), "stroke-linecap": "round", "stroke-width": str(round(float(high[0] - low[0])))}
    return f"M{x} {y}h0"


def _steps(steps: list[list[int]]) -> str:
    if len(steps) == 1 and 0 in steps[0]:
        across, down = steps[0]
        return f"h{across}" if down == 0 else f"v{down}"
    return "l" + " ".join(f"{across} {down}" for across, down in steps) if steps else ""


def _lines(path: Path) -> list[tuple[Floats, bool]]:
    """Return the points of each line of a cleaned path, and whether it is closed."""
    codes, points = np.asarray(path.codes), np.asarray(path.vertices)
    drawn, closing = (codes == Path.MOVETO) | (codes == Path.LINETO), codes == Path.CLOSEPOLY
    bounds = [*np.flatnonzero(codes == Path.MOVETO).tolist(), len(codes)]
    return [
        (points[first:stop][drawn[first:stop]], bool(closing[first:stop].any())) for first, stop in pairwise(bounds)
    ]


def _element(look: Look, marks: list[Mark]) -> str:
    """Return marks that look the same as one element, a group where it takes several."""
    attributes = "".join(f' {name}="{value}"' for name, value in look)
    bodies: list[tuple[str, str]] = []
    for kind, same in groupby(marks, key=lambda mark: mark.kind):
        parts = [mark.body for mark in same]
        if kind == "text":
            bodies += [("<text", f"{part}</text>") for part in parts]
        elif "opacity" in attributes:  # where two overlap it would be seen
            bodies += [("<path", f' d="{part}"/>') for part in parts]
        else:
            bodies.append(("<path", f' d="{"".join(parts)}"/>'))
    if len(bodies) == 1:
        return f"{bodies[0][0]}{attributes}{bodies[0][1]}"
    return f"<g{attributes}>{''.join(tag + body for tag, body in bodies)}</g>"


def _opacity(name: str, value: float) -> dict[str, str]:
    return {} if value == 1.0 else {name: f"{value:.2f}".rstrip("0").lstrip("0").rstrip(".") or "0"}


def _units(value: float) -> str:
    return str(round(float(value) * UNIT))
