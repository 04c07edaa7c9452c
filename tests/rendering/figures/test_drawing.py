"""Figures by matplotlib: short, the same each time, in the page's colours, with their numbers and links to nothing."""

from __future__ import annotations

import re
import time
import xml.etree.ElementTree as ElementTree

import numpy as np
import pandas as pd
import pytest

from pipeline.rendering.figures.drawing import LOOKS, Figure, Panel, Series, draw, standalone, write_figures
from pipeline.rendering.figures.overview import RecordedColumn, recorded_figure, thinned

X = np.linspace(0.0, 1000.0, 40)
NAMES = ("stiffness K [N/m]", "damping B [Ns/m]")


def figure(**more) -> Figure:
    series = (
        Series("measured limit", "measured", X, X / 10, X - 50, X + 50, number=0),
        Series("theory & $K_1$ <b>", "theory", X, X / 9),
        Series("stable trial", "stable", X, X / 20),
        Series("_hidden", "line", X, X / 30),
    )
    panels = tuple(Panel(f"panel {n}", NAMES, series, "Words <of> it.") for n in (1, 2))
    return Figure("boundaries", "some-figure", "Title", "Caption.", panels, **more)


@pytest.fixture(scope="module")
def drawn():
    return draw(figure())


def test_each_panel_is_one_element_with_name_words_and_text_as_text(drawn) -> None:
    assert len(drawn.panels) == 2
    for n, svg in enumerate(drawn.panels):
        root = ElementTree.fromstring(standalone(svg))
        space = {"s": "http://www.w3.org/2000/svg"}
        assert root.find("s:title", space).text == f"Title: panel {n + 1}"
        assert root.find("s:desc", space).text == "Words <of> it."
        words = [element.text for element in root.iter("{http://www.w3.org/2000/svg}text")]
        assert {*NAMES, "measured limit", "theory & $K_1$ <b>"} <= set(words)
        assert "_hidden" not in words


def test_a_series_without_a_point_leaves_the_element_whole() -> None:
    unknown = Series("measured limit", "measured", np.array([np.nan]), np.array([1.0]))
    panel = Panel("panel", NAMES, (unknown, Series("stable trial", "stable", X, X / 20)), "Words.")
    (svg,) = draw(Figure("boundaries", "some-figure", "Title", "Caption.", (panel,))).panels
    assert ElementTree.fromstring(standalone(svg)) is not None


def test_same_figure_same_bytes_without_date_style_or_reference_outside(drawn) -> None:
    assert draw(figure()).panels == drawn.panels
    for svg in drawn.panels:
        assert not re.search(r"style=|<metadata|20\d\d-\d\d|https?:", svg)
        references = set(re.findall(r'(?:url\(|href=")#([^)"]+)', svg))
        assert references
        assert references <= set(re.findall(r'id="([^"]+)"', svg))
        assert len(svg) < 18_000


def test_colours_are_those_of_the_page_and_in_files_those_of_print(drawn) -> None:
    assert "currentColor" in drawn.panels[0]
    assert "var(--fig-blue,#0072b2)" in drawn.panels[0]
    assert not re.search(r'"#0(?:1010|072)', drawn.panels[0])
    alone = standalone(drawn.panels[0])
    assert "var(" not in alone
    assert "currentColor" not in alone
    assert 'stroke="#0072b2"' in alone


def test_many_dots_are_one_path(drawn) -> None:
    paths = re.findall(r'<path d="([^"]*)"', drawn.panels[0])
    assert max(path.count("h0") for path in paths) == len(X)


def test_a_line_that_begins_with_one_point_twice_is_no_dot() -> None:
    twice = Series("twice", "line", np.array([0.0, 0.0, 1.0, 2.0]), np.array([0.0, 0.0, 3.0, 1.0]))
    svg = draw(Figure("plane", "twice", "Twice", "", (Panel("", ("x", "y"), (twice,), ""),))).panels[0]
    assert "h0" not in svg


def test_numbers_for_pointing_are_those_of_the_series(drawn) -> None:
    (axes,) = drawn.shown[0]["axes"]
    assert axes["names"][:2] == list(NAMES)
    label, x, y = axes["series"][0]
    assert label == "measured limit"
    assert x == pytest.approx(X, rel=1e-3)
    assert y == pytest.approx(X / 10, rel=1e-3)
    left, top, right, bottom = axes["box"]
    assert 0 < left < right < 440
    assert 0 < top < bottom


def test_simulated_logs_are_named_on_each_panel(drawn) -> None:
    assert all(">simulated<" in svg for svg in draw(figure(simulated=True)).panels)
    assert not any(">simulated<" in svg for svg in drawn.panels)


def test_files_are_svg_pdf_and_csv_and_the_same_each_time(tmp_path) -> None:
    written = write_figures([figure()], tmp_path / "a")
    names = [path.name for path in written]
    assert names == ["some-figure.csv", *(f"some-figure-{n}.{end}" for n in (0, 1) for end in ("svg", "pdf"))]
    again = write_figures([figure()], tmp_path / "b")
    assert [path.read_bytes() for path in written] == [path.read_bytes() for path in again]
    assert (tmp_path / "a" / "some-figure-0.pdf").read_bytes().startswith(b"%PDF")
    frame = pd.read_csv(tmp_path / "a" / "some-figure.csv")
    measured = frame[(frame["panel"] == "panel 1") & (frame["series"] == "measured limit")]
    assert measured["x"].to_numpy() == pytest.approx(X)
    assert measured["low"].to_numpy() == pytest.approx(X - 50)


def test_every_kind_of_series_can_be_drawn_also_of_nothing() -> None:
    series = tuple(Series(kind, kind, X, X, X - 1, X + 1, number=n) for n, kind in enumerate(LOOKS))
    nan = np.full(2, np.nan)
    empty = tuple(Series(kind, kind, nan, nan) for kind, look in LOOKS.items() if "span" not in look)
    below = Panel("", ("x", "force [N]"), series[:2], "")
    panels = (Panel("all", ("x", "y"), series, "", below=below), Panel("none", ("x", "y"), empty, ""))
    svg, nothing = draw(Figure("boundaries", "kinds", "T", "", panels)).panels
    assert "force [N]" in svg
    assert "<svg" in nothing


def test_a_panel_takes_a_tenth_of_a_second() -> None:
    draw(figure())
    start = time.process_time()
    draw(figure())
    assert time.process_time() - start < 1.0  # 0.2 s for both on one free core; five times that leaves room


def test_a_long_line_is_thinned_to_its_extremes() -> None:
    place, values = np.arange(100_001.0), np.sin(np.arange(100_001.0))
    values[77_777] = 5.0
    at, shown = thinned(place, values)
    assert len(at) < 2000
    assert (shown.min(), shown.max()) == (values.min(), 5.0)
    assert (np.diff(at) > 0).all()


def test_a_column_of_a_log_says_what_was_found_in_it() -> None:
    column = RecordedColumn("position", "m", X, np.sin(X), (3,), ((0, 3),), (9,), 4)
    assert column.words == "position: step in row 4; jumps in row 3; rests in rows 0 to 2; rows missing before row 9."
    assert RecordedColumn("a", "", X, X, (), (), ()).words == "a: no jump, rest or gap."
    (svg,) = draw(recorded_figure("log-0", "log", [column], "time [s]")).panels
    assert "position [m]" in svg
    assert "time [s]" in svg
