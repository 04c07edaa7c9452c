"""Figures as files: SVG that any program reads, PDF with the words of the drawing, equal bytes for equal drawings."""

from __future__ import annotations

import re
import zlib
from xml.etree import ElementTree

import numpy as np
import pytest
from report_data import boundary_figures, cost_figure

from pipeline.rendering.figures.figure_files import _lines, pdf, standalone, write_figures
from pipeline.rendering.figures.figures import boundaries, cost_maps
from pipeline.rendering.figures.svg import UNIT, line_data


@pytest.fixture(scope="module")
def drawings() -> dict[str, str]:
    limits = boundaries(boundary_figures()[0])
    maps = cost_maps(cost_figure("settle_2pct"))
    return {f"d-{n}": drawing for n, drawing in enumerate((*limits, *maps))}


def test_a_file_needs_nothing_of_a_page(drawings: dict[str, str]) -> None:
    for drawing in drawings.values():
        text = standalone(drawing)
        assert "var(" not in text
        assert "currentColor" not in text
        root = ElementTree.fromstring(text)
        assert root.tag == "{http://www.w3.org/2000/svg}svg"
        assert float(root.get("width", "0")) > 300


def test_pdf_shows_the_words_of_the_drawing_and_is_the_same_each_time(drawings: dict[str, str]) -> None:
    drawing = next(iter(drawings.values()))
    content = pdf(drawing)
    assert content == pdf(drawing)
    assert content.startswith(b"%PDF-")
    streams = [zlib.decompress(part) for part in _streams(content)]
    shown = max(streams, key=lambda stream: stream.count(b"BT"))
    assert shown.count(b"BT") >= len(re.findall("<text", drawing))
    box = re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", content)
    size = re.search(r'viewBox="0 0 (\d+) (\d+)"', drawing)
    assert box
    assert size
    assert [float(x) for x in box.groups()] == pytest.approx([float(x) / UNIT for x in size.groups()], abs=0.01)


def _streams(content: bytes) -> list[bytes]:
    found = re.findall(rb"stream\r?\n(.*?)\r?\nendstream", content, re.DOTALL)
    return [part for part in found if part[:1] == b"\x78"]


@pytest.mark.parametrize("seed", range(5))
def test_lines_are_read_as_they_were_written(seed: int) -> None:
    random = np.random.default_rng(seed)
    written = [
        (random.uniform(-50, 400, (int(random.integers(2, 30)), 2)).round(1), bool(random.integers(2)))
        for _ in range(6)
    ]
    read = _lines(line_data(written))
    assert [closed for _, closed, _ in read] == [closed for _, closed in written]
    for (points, _, radius), (line, _) in zip(read, written, strict=True):
        assert radius == 0
        steps = np.abs(np.diff(np.round(line * UNIT), axis=0)).any(axis=1)
        expected = np.round(line * UNIT)[np.append(True, steps)]
        assert np.array(points) == pytest.approx(expected)


def test_round_markers_are_read_as_discs() -> None:
    ((points, closed, radius),) = _lines("M100 200m-15 0a15 15 0 1 0 30 0a15 15 0 1 0-30 0z")
    assert (points, closed, radius) == ([(100.0, 200.0)], True, 15.0)
    assert _lines("M10 20h0M30 40h0") == [([(10.0, 20.0), (10.0, 20.0)], False, 0.0), ([(30.0, 40.0)] * 2, False, 0.0)]


def test_each_drawing_becomes_two_files(drawings: dict[str, str], tmp_path) -> None:
    first = dict(list(drawings.items())[:1])
    (tmp_path / "mine.txt").write_text("kept")
    written = write_figures(first, tmp_path)
    assert [path.name for path in written] == ["d-0.svg", "d-0.pdf"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["d-0.pdf", "d-0.svg", "mine.txt"]
