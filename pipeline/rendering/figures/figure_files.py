"""Figures of a report as files of their own: SVG that any program reads, and PDF, both from the drawings on the page.

A drawing on a page takes its colours from the page; in a file each is the one of print. The PDF is drawn from the SVG:
what `svg.Writer` writes is few kinds of elements, and so both are the same picture.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from pipeline.base.disk import replacing, write_text
from pipeline.rendering.figures.shown import figure_csv
from pipeline.rendering.figures.svg import UNIT

_VARIABLE = re.compile(r"var\(--[\w-]+,([^()]*)\)")
_TOKEN = re.compile(r"[Mmlhvaz]|-?\d+(?:\.\d+)?")
_NUMBERS = {"M": 2, "m": 2, "l": 2, "h": 1, "v": 1, "a": 7, "z": 0}
_NAMESPACE = "http://www.w3.org/2000/svg"
_ANCHORS = {"": "left", "end": "right", "middle": "center"}

Places = list[tuple[float, float]]


def write_figures(
    drawings: Mapping[str, str], folder: Path, numbers: Mapping[str, Sequence[Mapping[str, Any]]] | None = None
) -> tuple[Path, ...]:
    """Write each drawing of a page, by its name, as ``NAME.svg`` and ``NAME.pdf``; leave other files alone.

    Parameters
    ----------
    drawings : mapping of str to str
    folder : Path
    numbers : mapping, optional
        What the panels of each figure show, which goes into ``FIGURE.csv``; see `shown.Panel`.
    """
    written = []
    for name, panels in (numbers or {}).items():
        path = folder / f"{name}.csv"
        write_text(path, figure_csv(panels))
        written.append(path)
    for name, drawing in drawings.items():
        for path, content in (
            (folder / f"{name}.svg", standalone(drawing).encode()),
            (folder / f"{name}.pdf", pdf(drawing)),
        ):
            with replacing(path) as stream:
                stream.write(content)
            written.append(path)
    return tuple(written)


def standalone(drawing: str) -> str:
    """Return a drawing of a page as an SVG file: with its namespace, in colours of print, sized in pixels."""
    plain = _VARIABLE.sub(r"\1", drawing).replace("currentColor", "#000000")
    width, height = (int(size) / UNIT for size in _sizes(plain))
    return plain.replace("<svg ", f'<svg xmlns="{_NAMESPACE}" width="{width:g}" height="{height:g}" ', 1) + "\n"


def pdf(drawing: str) -> bytes:
    """Return a drawing of a page as a PDF of one page, with its text as text; equal drawings give equal bytes."""
    import matplotlib
    from matplotlib.figure import Figure

    text = standalone(drawing)
    root = ElementTree.fromstring(text)  # our own drawing: no entities, no external references
    width, height = (int(size) / UNIT for size in _sizes(text))
    with matplotlib.rc_context({"pdf.fonttype": 42, "text.parse_math": False, "path.simplify": False}):
        figure = Figure(figsize=(width / 72, height / 72), dpi=72)
        _add(figure, root, {}, _clips(root), height)
        stream = io.BytesIO()
        # no time, no name: the same report gives the same file
        figure.savefig(stream, format="pdf", metadata={"CreationDate": None, "Creator": None, "Producer": None})
    return stream.getvalue()


def _sizes(svg: str) -> tuple[str, str]:
    found = re.search(r'viewBox="0 0 (\d+) (\d+)"', svg)
    if found is None:
        raise ValueError("a drawing without its size")
    return found[1], found[2]


def _clips(root: ElementTree.Element) -> dict[str, tuple[float, ...]]:
    """Return the rectangles that drawings are cut to, in units, by their names."""
    found = {}
    for clip in root.iter(f"{{{_NAMESPACE}}}clipPath"):
        (rectangle,) = clip
        found[f"url(#{clip.get('id')})"] = tuple(float(rectangle.get(s, "0")) for s in ("x", "y", "width", "height"))
    return found


def _add(
    figure: Any,
    element: ElementTree.Element,
    held: Mapping[str, str],
    clips: Mapping[str, tuple[float, ...]],
    height: float,
) -> None:
    """Draw an element and what it holds; attributes of a group hold for its parts."""
    look = {**held, **element.attrib}
    kind = element.tag.removeprefix(f"{{{_NAMESPACE}}}")
    if kind in ("svg", "g"):
        for part in element:
            _add(figure, part, look, clips, height)
    elif kind == "path":
        _add_path(figure, look, clips, height)
    elif kind == "text":
        _add_text(figure, element.text or "", look, height)


def _add_path(figure: Any, look: Mapping[str, str], clips: Mapping[str, tuple[float, ...]], height: float) -> None:
    from matplotlib.patches import Circle, Patch, PathPatch, Rectangle
    from matplotlib.path import Path as Outline
    from matplotlib.transforms import Affine2D

    # units of the drawing, y downwards, to points, y upwards
    place = Affine2D().scale(1 / UNIT, -1 / UNIT).translate(0, height)
    width = float(look.get("stroke-width", UNIT)) / UNIT
    style = {
        "facecolor": _colour(look.get("fill", "none"), look, "fill-opacity"),
        "edgecolor": _colour(look.get("stroke", "none"), look, "stroke-opacity"),
        "linewidth": width if look.get("stroke", "none") != "none" else 0.0,
        "joinstyle": look.get("stroke-linejoin", "round"),
        "capstyle": {"square": "projecting"}.get(cap := look.get("stroke-linecap", "butt"), cap),
    }
    if dashes := look.get("stroke-dasharray"):
        style["linestyle"] = (0, [float(length) / UNIT / max(width, 1e-9) for length in dashes.split(",")])
    vertices: Places = []
    codes: list[Any] = []
    patches: list[Patch] = []
    for line, closed, radius in _lines(look["d"]):
        if radius:
            patches.append(Circle(line[0], radius, **style))
        elif len(set(line)) == 1 and cap == "round":  # a dot is a line without length
            patches.append(Circle(line[0], width * UNIT / 2, facecolor=style["edgecolor"], edgecolor="none"))
        else:
            vertices += [*line, line[0]] if closed else line
            codes += [Outline.MOVETO, *[Outline.LINETO] * (len(line) - 1), *([Outline.CLOSEPOLY] if closed else [])]
    if vertices:
        patches.append(PathPatch(Outline(np.array(vertices), codes), **style))
    for patch in patches:
        patch.set_transform(place)
        figure.add_artist(patch)
        if rectangle := clips.get(look.get("clip-path", "")):
            x, y, wide, high = rectangle
            patch.set_clip_path(Rectangle((x, y), wide, high, transform=place))


def _lines(data: str) -> list[tuple[Places, bool, float]]:
    """Return the lines of path data: their points, whether they are closed, and the radius of those that are discs."""
    found: list[tuple[Places, bool, float]] = []
    tokens = _TOKEN.findall(data)
    at, x, y = 0, 0.0, 0.0
    command = ""
    line: Places = []
    radius = 0.0

    def end(closed: bool) -> None:
        if len(line) > 1 or radius:
            found.append((list(line), closed, radius))

    while at < len(tokens):
        if not tokens[at].lstrip("-").replace(".", "").isdigit():
            command, at = tokens[at], at + 1
        count = _NUMBERS[command]
        n = [float(token) for token in tokens[at : at + count]]
        at += count
        if command in "Mm":
            if not radius:
                end(closed=False)
            x, y = (n[0], n[1]) if command == "M" else (x + n[0], y + n[1])
            line, radius = [(x, y)], 0.0
        elif command == "a":  # half of a round marker, the only curve that is written: left end to right end and back
            radius, line = n[0], [(x + n[5] / 2, y)] if not radius else line
            x, y = x + n[5], y + n[6]
        elif command == "z":
            end(closed=True)
            x, y = line[0] if not radius else (x, y)
            line, radius = [], 0.0
        else:
            dx, dy = {"h": (n[0], 0.0), "v": (0.0, n[0])}.get(command) or (n[0], n[1])
            x, y = x + dx, y + dy
            line.append((x, y))
    end(closed=False)
    return found


def _add_text(figure: Any, text: str, look: Mapping[str, str], height: float) -> None:
    turned = re.match(r"translate\((-?\d+) (-?\d+)\)rotate\((-?\d+)\)", look.get("transform", ""))
    x, y = (turned[1], turned[2]) if turned else (look["x"], look["y"])
    figure.text(
        float(x) / UNIT,
        height - float(y) / UNIT,
        text,
        transform=None,
        rotation=-float(turned[3]) if turned else 0.0,
        rotation_mode="anchor",
        fontsize=float(look.get("font-size", "110")) / UNIT,
        color=_colour(look.get("fill", "#000000"), look, "fill-opacity"),
        ha=_ANCHORS[look.get("text-anchor", "")],
        va="baseline",
        fontweight="bold" if look.get("font-weight") == "700" else "normal",
        fontstyle=look.get("font-style", "normal"),
    )


def _colour(name: str, look: Mapping[str, str], opacity: str) -> Any:
    alpha = float(look.get("opacity", "1")) * float(look.get(opacity, "1"))
    return "none" if name == "none" else (name, alpha)
