"""The compact SVG is the same picture: its paths are read back and held against the library's own."""

from __future__ import annotations

import io
import re
import xml.etree.ElementTree as ElementTree
from itertools import pairwise

import matplotlib
import numpy as np
import pytest

from pipeline.rendering.figures import canvas, style
from pipeline.rendering.figures.svg import SEEN, UNIT, line_data

NUMBER = re.compile(r"[A-Za-z]|-?\d+(?:\.\d+)?")


def points_of(data: str) -> list[list[tuple[float, float]]]:
    """Follow relative and absolute path commands by the SVG standard; one list of points a subpath."""
    tokens = NUMBER.findall(data)
    lines: list[list[tuple[float, float]]] = []
    x = y = 0.0
    command = ""
    at = 0
    while at < len(tokens):
        if tokens[at].isalpha():
            command = tokens[at]
            at += 1
        if command in "zZ":
            x, y = lines[-1][0]
            lines[-1].append((x, y))
            continue
        if command in "hv":
            step = float(tokens[at])
            at += 1
            x, y = (x + step, y) if command == "h" else (x, y + step)
        else:
            a, b = float(tokens[at]), float(tokens[at + 1])
            at += 2
            x, y = (a, b) if command in "ML" else (x + a, y + b)
        if command in "Mm":
            lines.append([])
            command = "L" if command == "M" else "l"
        lines[-1].append((x, y))
    return lines


def distance(point: np.ndarray, line: np.ndarray) -> float:
    """Distance of a point from a polyline, by trying 2,000 places on each of its parts."""
    share = np.linspace(0, 1, 2001)[:, None]
    parts = [a + share * (b - a) for a, b in pairwise(line)] or [line]
    return min(float(np.hypot(*(part - point).T).min()) for part in parts)


def test_relative_whole_numbers_give_the_places_of_the_absolute_ones() -> None:
    triangle, upright, point = ([(1.04, 2), (30.5, 40.26), (10, -3.5)], [(7, 7), (7, 9)], [(3, 3), (3, 3)])
    lines = [(np.array(line), closed) for line, closed in ((triangle, True), (upright, False), (point, False))]
    truth = [[(10, 20), (305, 403), (100, -35), (10, 20)], [(70, 70), (70, 90)], [(30, 30), (30, 30)]]
    assert points_of(line_data(lines)) == [[tuple(map(float, p)) for p in line] for line in truth]
    assert " -" not in line_data(lines)
    assert line_data([]) == ""


def raw_and_compact() -> tuple[str, str]:
    """A figure with lines, dashes, markers, an area, a legend and contours: as the library writes it, and compact."""
    with (
        canvas.drawing_of(300, 200) as drawing,
        matplotlib.rc_context({"svg.fonttype": "none", "path.simplify": False}),
    ):
        axes = drawing.add_axes((0.15, 0.15, 0.8, 0.8))
        x = np.linspace(0, 10, 400)
        axes.plot(x, np.sin(x), color=style.BLUE, label="<sine> & $x$")
        axes.plot(x[::40], np.cos(x[::40]), "s", color=style.GREEN, ms=4, mew=0)
        axes.plot(x[::50], 0.5 * np.cos(x[::50]), "o", color=style.SKY, ms=5, mew=0)
        axes.plot(x, 0 * x, ls=style.LINES["theory"], lw=1.4, color=style.VERMILLION)
        axes.fill([1, 2, 2], [0, 0, 0.5], color=style.ORANGE, alpha=0.3, lw=0)
        grid = np.linspace(-1, 1, 40)
        axes.contour(5 + grid, 0.5 * grid, np.hypot(*np.meshgrid(grid, grid)), colors=[style.PURPLE])
        axes.legend()
        short = style.svg(drawing, "f", "t", "d")
        buffer = io.StringIO()
        drawing.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
        text = buffer.getvalue()
        return text[text.index("<svg") :], short


def lines_by_colour(root: ElementTree.Element, colour: str, unit: float, small: bool) -> list[np.ndarray]:
    """Polylines of a colour [px]; those with two points or more that differ."""
    found = []
    for group in root.iter():
        for path in group:
            look = " ".join([*path.attrib.values(), *(group.attrib.values() if group.tag.endswith("g") else ())])
            if (
                path.tag.endswith("path")
                and colour in look
                and "C" not in path.get("d", "")
                and "a" not in path.get("d", "")
            ):
                found += [np.array(line) / unit for line in points_of(path.get("d", ""))]
    return [line for line in found if (len(line) > 20) != small and len(line) > 1]


def test_every_line_stays_within_two_tenths_of_a_pixel() -> None:
    raw, short = raw_and_compact()
    before, after = ElementTree.fromstring(raw), ElementTree.fromstring(short)
    for colour, name in ((style.BLUE, "--fig-blue"), (style.PURPLE, "--fig-purple")):
        lines = lines_by_colour(before, colour, 1.0, small=False)
        thinned = [line for small in (True, False) for line in lines_by_colour(after, name, UNIT, small=small)]
        assert lines
        worst = max(min(distance(p, t) for t in thinned) for line in lines for p in line[::7])
        # 0.15 px are left out, and half a unit is rounded in both directions
        assert worst < SEEN + 0.08


def test_compact_svg_keeps_texts_and_dashes_in_a_fraction_of_the_bytes() -> None:
    raw, short = raw_and_compact()
    words = ["".join(e.itertext()) for e in ElementTree.fromstring(short).iter("text")]
    assert "<sine> & $x$" in words
    assert sorted(words) == sorted(
        "".join(e.itertext()) for e in ElementTree.fromstring(raw).iter("{http://www.w3.org/2000/svg}text")
    )
    assert 'stroke-dasharray="70,28"' in short  # 5 and 2 line widths of 1.4 px
    assert 'fill-opacity=".3"' in short or 'opacity=".3"' in short
    assert len(short) < 0.25 * len(raw)
    defined = re.findall(r'\bid="([^"]+)"', short)
    assert all(name.startswith("f-") for name in defined)
    assert set(re.findall(r"url\(#([^)]+)\)", short)) <= set(defined)


def test_discs_are_dots_of_their_diameter_at_their_places() -> None:
    _, short = raw_and_compact()
    (dots,) = re.findall(r'<path[^>]*stroke="var\(--fig-sky[^>]*>', short)
    assert 'stroke-width="50"' in dots
    assert 'stroke-linecap="round"' in dots
    x = [int(v) / UNIT for v in re.findall(r"M(\d+) \d+h0", dots)]
    share = np.linspace(0, 10, 400)[::50] / 10
    gaps = np.diff(share) / np.diff(share)[0]
    assert np.diff(x) / np.diff(x)[0] == pytest.approx(gaps, abs=0.01)


def test_what_does_not_follow_the_colours_of_a_page_is_refused_not_dropped() -> None:
    with canvas.drawing_of(300, 200) as drawing:
        drawing.add_axes((0, 0, 1, 1)).imshow(np.eye(3))
        with pytest.raises(NotImplementedError):
            style.svg(drawing, "f", "t", "d")
