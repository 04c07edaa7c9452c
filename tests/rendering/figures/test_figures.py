"""Figures: the geometry that was drawn is read back from the SVG and held against the data."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from report_data import (
    HOSTILE,
    boundary,
    boundary_figures,
    cost_figure,
    cost_map,
    delay_figure,
)

from pipeline.records.figure_records import CostMap, Curve, Figure, Limits
from pipeline.rendering.figures import canvas, figures, panels, style


def parse(svg: str) -> ElementTree.Element:
    return ElementTree.fromstring(svg)


def paths(svg: str, colour: str) -> list[str]:
    """Return the data of all paths that are stroked in a colour, also by their group."""
    found = []
    for element in parse(svg).iter():
        group = element.get("stroke", "") if element.tag == "g" else ""
        for path in element.findall("path") if element.tag in ("g", "svg") else ():
            if colour in path.get("stroke", group):
                found.append(path.get("d", ""))
    return found


def texts(svg: str) -> list[str]:
    return ["".join(e.itertext()) for e in parse(svg).iter("text")]


@pytest.mark.parametrize("figure", boundary_figures(), ids=lambda f: f.identifier)
def test_boundaries_give_one_well_formed_svg_a_panel(figure: Figure[Limits]) -> None:
    drawn = figures.boundaries(figure)
    assert len(drawn) == len(figure.panels)
    for svg, (_, curves) in zip(drawn, figure.panels, strict=True):
        root = parse(svg)
        assert root.get("role") == "img"
        assert root[0].tag == "title"
        assert root[1].tag == "desc"
        assert {c.label for c in curves} <= set(texts(svg)), "every curve is named, at the curve or in the legend"


def test_identifiers_are_unique_over_the_page_and_references_resolve() -> None:
    page = "".join(s for f in boundary_figures() for s in figures.boundaries(f))
    page += "".join(figures.delays(delay_figure()))
    defined = re.findall(r'\bid="([^"]+)"', page)
    assert len(defined) == len(set(defined))
    used = re.findall(r"url\(#([^)]+)\)", page) + re.findall(r'href="#([^"]+)"', page)
    assert used
    assert set(used) <= set(defined)


def test_output_is_deterministic_and_names_no_date_and_no_address() -> None:
    figure = delay_figure()
    first = figures.delays(figure)
    assert first == figures.delays(figure)
    assert not re.search(r"https?:|20\d\d-\d\d", "".join(first), re.IGNORECASE)


def test_page_colours_replace_every_fixed_colour() -> None:
    svg = figures.boundaries(boundary_figures()[1])[0]
    assert "currentColor" in svg
    left = re.sub(r"var\([^)]*\)", "", svg).lower()
    assert not [c for c in style.PAGE_COLOURS if c in left]
    assert not re.search(r"#0{6}|#f{6}", left), "black or white would vanish in one of the colour schemes"


def test_measured_is_solid_theory_dashed_and_censored_points_are_open() -> None:
    measured = Curve("m", "measured", np.array([1.0, 2, 1]), np.array([1.0, 2, 3]), np.array([0.0, 0, 1]))
    theory = Curve("t", "theory", np.array([1.0, 3, 1]), np.array([1.0, 2, 3]))
    solid, dashed = (
        figures.boundaries(Figure("boundaries", "f", "t", "c", (("", (curve,)),)))[0] for curve in (measured, theory)
    )
    assert "dasharray" in dashed
    assert "dasharray" not in solid
    assert solid.count("var(--paper") > dashed.count("var(--paper")


def test_stiffness_axis_has_the_unit_of_the_tables() -> None:
    assert "stiffness K [N/m]" in texts(figures.boundaries(boundary_figures()[0])[0])
    assert "stiffness K [Nm/rad]" in texts(figures.boundaries(boundary_figures()[0], "rotation")[0])


def test_optimum_is_drawn_where_it_lies_and_front_view_names_its_cost() -> None:
    figure = cost_figure("energy_step_w0")
    places = []
    for svg, drawn in zip(figures.cost_maps(figure), figure.panels, strict=True):
        best = drawn.optimum
        assert best is not None
        assert f"{best.cost:.2f}" in texts(svg)
        # a plus is two strokes, first the one across: its middle is where the optimum lies
        found = [re.match(r"M(-?\d+)[ ]?(-?\d+)h(\d+)m-(\d+)[ -]", d) for d in paths(svg, "--fig-blue")]
        plus = [int(m[1]) + int(m[4]) for m in found if m and int(m[3]) == 2 * int(m[4])]
        assert len(plus) == 2, "once in the map, once in the front view"
        assert plus[0] == plus[1]
        places.append((plus[0], best.stiffness))
    # All maps share their axes, and stiffness zero is at the left margin of 52 pixels; places count in 0.1 px.
    (x, k), *others = places
    for other_x, other_k in others:
        assert other_x - 520 == pytest.approx((x - 520) * other_k / k, abs=1.5)


@pytest.mark.parametrize(("criterion", "ratio"), [("energy_step_w1", 2**0.5), ("settle_2pct", 2**0.5)])
def test_two_contour_levels_double_the_cost(criterion: str, ratio: float) -> None:
    levels = panels._levels(criterion, np.geomspace(20.0, 1e6, 50))
    assert len(levels) == 10
    assert levels[0] == pytest.approx(20 * ratio, rel=1e-5)
    assert levels[1:] / levels[:-1] == pytest.approx(ratio)


def test_overshoot_levels_are_ten_points_apart_and_inside_the_data() -> None:
    levels = panels._levels("overshoot", np.array([0.0, 0.2, 0.57]))
    assert levels[1:] == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5])
    assert 0 < levels[0] < 0.01


def test_triangles_bridge_one_missing_trial_but_no_untested_region() -> None:
    m = cost_map("m", "measured", "energy_step_w0")
    known = np.zeros(m.cost.shape, dtype=bool)
    known[:20, :20] = True
    known[5, 5] = False
    known[:20, 40:50] = True  # 20 untested columns between the two blocks
    triangles = panels._triangles(m, known)
    assert triangles is not None
    finder: Any = triangles.get_trifinder()
    assert finder(m.stiffness[5], m.damping[5]) >= 0
    assert finder(m.stiffness[30], m.damping[10]) == -1


def test_dots_are_where_the_trials_are() -> None:
    with canvas.drawing_of(200, 200) as drawing:
        axes = canvas.add_axes(drawing, 0, 0, 0, 0)
        axes.set_xlim(0, 10)
        axes.set_ylim(0, 10)
        x, y = np.array([2.0, 2.0, 7.5]), np.array([1.0, 1.001, 9.0])
        panels.dots(axes, x, y, style.INK, 2)
        svg = style.svg(drawing, "f", "t", "d")
    # 200 pixels for 10 units, in tenths of a pixel, y downwards; the first two trials share a pixel.
    assert paths(svg, "currentColor") == ["M400 1800h0m1100-1600h0"]


def test_the_line_of_the_least_cost_is_nowhere_above_a_trial() -> None:
    m = cost_map("m", "measured", "settle_2pct")
    K = np.array([float(m.stiffness[3]), 0.5 * float(m.stiffness[3] + m.stiffness[4]), 1.5 * float(m.stiffness[-1])])
    cost = np.array([1.0, 2.0, 5.0])
    lucky = replace(m, trial_stiffness=K, trial_damping=np.zeros(3), trial_cost=cost)
    at, line = panels._least(lucky, 1.0)
    assert np.interp(K, at, line) == pytest.approx(cost)
    bare = replace(m, trial_stiffness=np.empty(0), trial_damping=np.empty(0), trial_cost=np.empty(0))
    known = np.isfinite(m.cost).any(axis=0)
    assert (panels._least(bare, 1.0)[1] == np.nanmin(m.cost[:, known], axis=0)).all()


@pytest.mark.parametrize("points", [0, 1, 2, 5])
def test_a_map_with_few_trials_is_drawn_without_contours(points: int) -> None:
    m = cost_map("m", "measured", "settle_2pct")
    sparse = np.full(m.cost.shape, np.nan)
    sparse[10, 5 : 5 + points] = 30.0
    figure = Figure[CostMap]("maps", "f", "t", "c", (replace(m, cost=sparse, optimum=None),), "settle_2pct")
    (svg,) = figures.cost_maps(figure)
    assert ("too few trials with this cost" in texts(svg)) == (points == 0)


def test_empty_boundary_and_empty_delay_panel_do_not_fail() -> None:
    none: Any = np.zeros(0)
    (svg,) = figures.boundaries(Figure("boundaries", "f", "t", "c", (("", (Curve("m", "measured", none, none),)),)))
    assert "no point" in svg
    figure = delay_figure()
    nothing = np.full(7, np.nan)
    panel = replace(figure.panels[0], theory=nothing, damped=nothing, measured=nothing)
    assert "without data" in figures.delays(replace(figure, panels=(panel,)))[0]


def test_hostile_label_is_text() -> None:
    curve = replace(boundary("m", "measured"), label=HOSTILE)
    (svg,) = figures.boundaries(Figure("boundaries", "f", HOSTILE, "c", ((HOSTILE, (curve,)),)))
    assert not list(parse(svg).iter("script"))
    assert HOSTILE in texts(svg)


def test_size_of_every_panel_is_bounded() -> None:
    # A report of seven experiments has about a hundred panels in 1.2 MB, 12 kB each. These have 6 to 15 kB, the largest
    # one of a thesis-size course 36 kB; as the library writes them they have four times as many.
    for criterion in ("settle_2pct", "overshoot"):
        assert max(map(len, figures.cost_maps(cost_figure(criterion)))) < 20_000
    assert max(len(s) for f in boundary_figures() for s in figures.boundaries(f)) < 14_000
    assert max(map(len, figures.delays(delay_figure()))) < 5_000


def test_shaded_areas_follow_their_ends_and_normalised_axes_are_named() -> None:
    b = np.array([0.0, 10, 20])
    low, high = np.array([100.0, 200, 100]), np.array([300.0, 400, np.nan])
    envelope = Curve("band", "envelope", high[:2], b[:2], None, low[:2], high[:2])
    measured = Curve("m", "measured", np.array([200.0, 300, 100]), b, None, low, high)
    (svg,) = figures.boundaries(Figure("plane", "f", "t", "c", (("", (envelope, measured)),)))
    assert {"α = K T²/m", "β = B T/m", "band"} <= set(texts(svg))
    # the envelope and its sample in the legend; the measured limits have a bar each, but for that with an open end
    shaded = [p for p in parse(svg).iter("path") if p.get("fill", "none") not in ("none", "")]
    areas = [p.get("d", "") for p in shaded if float(p.get("opacity", p.get("fill-opacity", "1"))) < 0.5]
    assert len(areas) == 2
    (bars,) = [p.get("d", "") for p in parse(svg).iter("path") if p.get("stroke-width") == "60"]
    assert bars.count("M") + bars.count("m") == 2
    ends = [float(x) for x in re.findall(r"[Mm](-?[\d.]+)", areas[0])]
    assert float(re.findall(r"M([\d.]+)", bars)[0]) == ends[0], "both begin at the same stiffness"


def test_long_names_are_cut_in_a_drawing_and_whole_in_its_words() -> None:
    figure = boundary_figures()[0]
    name = "experiment " + "x" * 190
    curves = tuple(replace(curve, label=name) for curve in figure.panels[0][1] if curve.kind == "measured")
    drawn = figures.boundaries(replace(figure, panels=((name, curves),)))[0]
    longest = [text for text in texts(drawn) if "xxx" in text]
    assert longest
    assert all(text.endswith("…") and len(text) < 75 for text in longest)
    assert name in drawn  # in its title and description
