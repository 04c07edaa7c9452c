"""An SVG of the drawing library in few characters: same picture, without its groups, names and repeated styles.

The library writes each tick as an element of its own with its whole style. Here elements that look the same share
one group, ticks and grid lines of an axis share one path, and small marks are written at their places. Text stays
text. Numbers count in tenths of a pixel (`svg_paths.UNIT`).
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import groupby
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from pipeline.base.errors import PipelineError
from pipeline.rendering.svg_paths import UNIT, compact_path

_SVG = "{http://www.w3.org/2000/svg}"
_LINK = "{http://www.w3.org/1999/xlink}href"
_NONE = {"fill": "none", "stroke-dashoffset": "0", "opacity": "1", "stroke-linejoin": "round"}
"""Values that hold anyway, by the SVG standard or by the head that `style.svg` writes."""
_LENGTHS = ("stroke-width", "font-size")
_FONT_FAMILY = "font-family"
_ROTATE = re.compile(r"rotate\((\S+)(?: (\S+) (\S+))?\)")
_TRANSLATE = re.compile(r"translate\((\S+) (\S+)\)")
_CURVES = re.compile(r"[CQ]")

_NUMBER = re.compile(r"-?[\d.]+(?:e-?\d+)?")
ROUND = 0.05
"""Relative spread of the radius that still is a circle: coordinates are rounded."""

Look = tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class _Shape:
    """A marker: path data around the pen; ``width`` is the diameter of a circle [units]."""

    data: str
    width: float | None = None


@dataclass(frozen=True)
class _Mark:
    """One drawn element: ``kind`` is path or text; ``body`` its path data, or its place and words.

    ``axis``: belongs to an axis; ``small``: may share a path with those of equal look.
    """

    kind: str
    look: Look
    body: str
    axis: bool
    small: bool


@dataclass
class _Reader:
    """Collects marks in drawing order, with the clip rectangles and marker shapes they refer to."""

    prefix: str
    marks: list[_Mark] = field(default_factory=list)
    shapes: dict[str, _Shape] = field(default_factory=dict)
    clips: dict[str, str] = field(default_factory=dict)
    used_clips: dict[str, str] = field(default_factory=dict)

    def read(self, element: ElementTree.Element, clip: str = "", axis: bool = False) -> None:
        tag = element.tag.removeprefix(_SVG)
        clip = element.get("clip-path", clip)
        if tag == "g":
            if element.get("transform") or element.get("style"):
                raise PipelineError(f"drawing: a group with {element.attrib} is not expected from the drawing library")
            inside = axis or element.get("id", "").startswith("matplotlib.axis")
            for child in element:
                self.read(child, clip, inside)
        elif tag == "path":
            self._add("path", element, clip, compact_path(element.get("d", "")), axis)
        elif tag == "use":
            self._add_marker(self.shapes[element.get(_LINK, "").removeprefix("#")], element, clip, axis)
        elif tag == "text":
            self._add("text", element, "", f"{_place(element)}>{escape(element.text or '')}", axis)
        elif tag != "defs":
            raise PipelineError(f"drawing: an element {tag!r} is not expected from the drawing library")

    def definitions(self, root: ElementTree.Element) -> None:
        for found in root.iter(f"{_SVG}clipPath"):
            self.clips[f"url(#{found.get('id')})"] = _rectangle(found[0])
        for defs in root.iter(f"{_SVG}defs"):
            for shape in defs.iter(f"{_SVG}path"):
                self.shapes[shape.get("id", "")] = _shape(shape.get("d", ""))

    def _add_marker(self, shape: _Shape, element: ElementTree.Element, clip: str, axis: bool) -> None:
        place = f"M{_units(element.get('x', '0'))} {_units(element.get('y', '0'))}".replace(" -", "-")
        look = dict(_look(element.get("style", "")))
        if shape.width and "stroke" not in look and "fill" in look:
            # a disc is a line without length and with round ends: a tenth of the characters of a circle
            dot = {"stroke": look.pop("fill"), "stroke-linecap": "round", "stroke-width": str(round(shape.width))}
            self._add_look("path", tuple({**look, **dot}.items()), clip, f"{place}h0", axis, small=True)
        else:
            self._add_look("path", tuple(look.items()), clip, place + shape.data, axis, small=True)

    def _add(self, kind: str, element: ElementTree.Element, clip: str, body: str, axis: bool) -> None:
        if body:
            self._add_look(kind, _look(element.get("style", "")), clip, body, axis, small=axis)

    def _add_look(self, kind: str, look: Look, clip: str, body: str, axis: bool, *, small: bool) -> None:
        if not {"fill", "stroke"} & {name for name, _ in look}:
            return  # nothing to see
        if clip:
            name = self.used_clips.setdefault(self.clips[clip], f"{self.prefix}-c{len(self.used_clips)}")
            look = (("clip-path", f"url(#{name})"), *look)
        self.marks.append(_Mark(kind, look, body, axis, small))


def compact(text: str, prefix: str) -> str:
    """Return what an ``<svg>`` element of matplotlib draws, without the element itself.

    Parameters
    ----------
    text : str
        The element as the library wrote it, with text as text. Groups must not transform.
    prefix : str
        Begins every ``id``.

    Returns
    -------
    str
        Elements for an ``<svg>`` whose view box counts in tenths of a pixel and whose default is
        ``fill="none" stroke-width="10" stroke-linejoin="round"``.

    Raises
    ------
    PipelineError
        If an element is none that matplotlib writes for lines, areas, markers and text.
    """
    root = ElementTree.fromstring(text)
    reader = _Reader(prefix)
    reader.definitions(root)
    for child in root:
        if child.tag != f"{_SVG}metadata":
            reader.read(child)
    clips = "".join(f'<clipPath id="{name}">{shape}</clipPath>' for shape, name in reader.used_clips.items())
    return (f"<defs>{clips}</defs>" if clips else "") + _write(_sorted_axes(reader.marks))


def _sorted_axes(marks: list[_Mark]) -> list[_Mark]:
    """Put marks of an axis that look the same side by side: they do not overlap, so the order is free."""
    result: list[_Mark] = []
    for axis, run in groupby(marks, key=lambda mark: mark.axis):
        group = list(run)
        if axis:
            first: dict[Look, int] = {}
            for mark in group:
                first.setdefault(mark.look, len(first))
            group.sort(key=lambda mark: first[mark.look])
        result += group
    return result


def _write(marks: list[_Mark]) -> str:
    text = []
    for look, run in groupby(marks, key=lambda mark: mark.look):
        attributes = "".join(f" {name}={quoteattr(value)}" for name, value in look)
        bodies = []
        for (kind, joined), same in groupby(run, key=lambda mark: (mark.kind, mark.small)):
            if kind == "text":
                bodies += [f"<text{{}}{mark.body}</text>" for mark in same]
            elif joined:
                bodies.append(f'<path{{}} d="{"".join(mark.body for mark in same)}"/>')
            else:
                bodies += [f'<path{{}} d="{mark.body}"/>' for mark in same]
        if len(bodies) == 1:
            text.append(bodies[0].replace("{}", attributes, 1))
        else:
            text.append(f"<g{attributes}>{''.join(body.replace('{}', '', 1) for body in bodies)}</g>")
    return "".join(text)


@lru_cache(maxsize=1024)
def _look(style: str) -> Look:
    """Return the attributes of a style that change anything, lengths in units."""
    pairs = [tuple(part.strip() for part in entry.split(":", 1)) for entry in style.split(";") if entry.strip()]
    look = []
    for name, value in pairs:
        if name == _FONT_FAMILY or _NONE.get(name) == value:
            continue
        if name in _LENGTHS:
            value = _units(value.removesuffix("px"))
        elif name == "stroke-dasharray":
            value = ",".join(_units(part) for part in value.split(","))
        elif name.endswith("opacity"):
            value = f"{float(value):.2f}".rstrip("0").lstrip("0")
        look.append((name, value))
    return tuple(look)


def _units(text: str) -> str:
    return str(round(float(text) * UNIT))


def _place(element: ElementTree.Element) -> str:
    """Return where a text stands and how it is turned, as attributes."""
    transform = element.get("transform", "")
    moved = _TRANSLATE.search(transform)
    x, y = moved.groups() if moved else (element.get("x", "0"), element.get("y", "0"))
    x, y = _units(x), _units(y)
    turned = _ROTATE.search(transform)
    angle = round(float(turned[1])) if turned else 0
    if angle == 0:
        return f' x="{x}" y="{y}"'
    return f' transform="translate({x} {y})rotate({angle})"'


def _rectangle(element: ElementTree.Element) -> str:
    sides = "".join(f' {name}="{_units(element.get(name, "0"))}"' for name in ("x", "y", "width", "height"))
    return f"<rect{sides}/>"


def _shape(data: str) -> _Shape:
    """Return a marker as path data around the pen, and its radius where it is a disc."""
    if not _CURVES.search(data):
        return _Shape("m" + compact_path(data)[1:])  # all but the first point are relative already
    points = np.array(_NUMBER.findall(data), dtype=np.float64).reshape(-1, 2) * UNIT
    ends = points[::3]  # every third one lies on the line, the others pull it
    radius = float(np.hypot(ends[:, 0], ends[:, 1]).mean())
    if np.ptp(np.hypot(ends[:, 0], ends[:, 1])) > ROUND * radius:
        raise PipelineError("drawing: a marker with curves that is no circle is not expected")
    r = round(radius)
    return _Shape(f"m-{r} 0a{r} {r} 0 1 0 {2 * r} 0a{r} {r} 0 1 0-{2 * r} 0z", 2 * radius)
