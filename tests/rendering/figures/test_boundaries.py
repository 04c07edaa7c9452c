"""Limits that are drawn, held against the formulas that define them."""

from __future__ import annotations

import re

import numpy as np
import pytest
import simulated
from report_data import experiment

from pipeline.device.loop import Loop
from pipeline.device_data.published import published_bound
from pipeline.records.findings import BoundaryPoint, Limit
from pipeline.records.models import Shown
from pipeline.records.results import Cause, NextWall, PassiveWall, SourcedLoop, StraightBound, UsePoint, UseRegion
from pipeline.rendering.figures.boundaries import (
    answer_figure,
    boundary_figures,
    by_theory,
    conditions,
    limits_figure,
    limits_panel,
    measured,
    plane_figure,
)
from pipeline.rendering.figures.drawing import GREY, SERIES, draw
from pipeline.theory.predictions import Theory


def theory(mass: float = 0.58, damping: float = 4.0, delay: float = 4.0, period: float = 1e-3) -> Theory:
    return Theory(
        SourcedLoop(
            mass=mass, damping=damping, stiffness=0, sampling_period_s=period, delay_samples=delay, source="test"
        )
    )


@pytest.mark.parametrize("plant", [simulated.FALCON, {**simulated.FALCON, "mass": 1.0, "b": 34.0}])
def test_drawn_boundary_is_the_limit_of_an_independent_loop(plant) -> None:
    curve = by_theory(theory(plant["mass"], plant["b"], plant["delay"]), "x")
    assert curve.x[-1] == 0  # closed along K = -k
    for K, B in zip(curve.x[1:-1:6], curve.y[1:-1:6], strict=True):
        if 0.05 * curve.x.max() < K:  # near K = 0 the pole at z = 1 hides the others
            assert simulated.spectral_radius(K, B, **plant) == pytest.approx(1, abs=1e-9)


@pytest.mark.parametrize("delay", [0.0, 1.0, 4.0])
def test_outline_of_the_passive_region_needs_all_of_the_device_damping(delay: float) -> None:
    curve = next(s for s in conditions(theory(delay=delay)) if s.kind == "passive")
    w = np.linspace(1e-6, np.pi, 40_001)
    inner = curve.x > 1e-6 * curve.x.max()
    k, b = curve.x[inner] * 1e-3, curve.y[inner]
    # (4.6): b must exceed this at every frequency; on the outline the largest of them is b itself
    need = (np.sin((delay + 0.5) * w) * k[:, None] + 2 * np.sin(w / 2) * np.cos((delay + 1) * w) * -b[:, None]) / (
        2 * np.sin(w / 2)
    )
    assert need.max(axis=1) == pytest.approx(4.0, rel=1e-3)  # a pixel of the drawing is 0.3 %


@pytest.mark.slow
def test_walls_stable_with_any_spring_hold_the_passive_ones_and_are_drawn_where_asked_for() -> None:
    found = {s.kind: s for s in conditions(theory())}
    inner = found["passive"].x > 0.05 * found["passive"].x.max()
    for stiffness, damping in zip(found["passive"].x[inner][::6], found["passive"].y[inner][::6], strict=True):
        # a chord of the outline, 0.2 Ns/m long, is 0.1 % inside it at most
        assert stiffness < 1.001 * np.interp(damping, found["robust"].y, found["robust"].x)
    assert {s.kind for s in conditions(theory(damping=0.0))} == {"linear"}, "nothing is passive without damping"
    assert not Shown().has_overlay("robust")


def test_measured_limits_have_the_interval_of_their_estimate_or_their_trials() -> None:
    points = (
        BoundaryPoint(damping=0, stable=100, unstable=300, censored=False),
        BoundaryPoint(damping=4, stable=500, unstable=700, censored=False, estimate=590, low=560, high=640),
        BoundaryPoint(damping=8, stable=900, unstable=None, censored=True, low=850),
    )
    line, bound = measured(points, "limit", 3, intervals=True)
    assert line.low.tolist() == [100, 560, 900]
    assert line.high[:2].tolist() == [300, 640]
    assert np.isnan(line.high[2])
    assert (line.x[:2].tolist(), bound.x.tolist(), bound.number) == ([200, 590], [900], 3)
    assert (line.low[:2] <= line.x[:2]).all(), "line and bar are of one quantity"
    assert (line.x[:2] <= line.high[:2]).all()
    plain, _ = measured(points, "limit", 3)
    assert plain.x[:2].tolist() == line.x[:2].tolist(), "one limit in all figures"
    assert plain.low is None
    assert np.isnan(line.x[2]), "a lower bound is no limit: a line through it would claim one"


@pytest.mark.slow
def test_experiments_share_colours_over_all_figures_and_overlays_are_those_asked_for() -> None:
    results = [experiment("1"), experiment("2"), experiment("6", "firm")]
    theories = {"1": theory(), "6": theory(mass=0.7)}
    everything = boundary_figures(results, theories, "translation", Shown(), sweep=False)
    assert [f.identifier for f in everything] == ["boundaries-all", "boundaries-loop", "boundaries-normalised"]
    for figure in everything:
        lines = [s for panel in figure.panels for s in panel.series if s.label.startswith("experiment ")]
        numbers = {s.label.split(" ")[1].strip(","): s.number for s in lines}
        assert numbers.items() <= {"1": 0, "2": 1, "6": 2}.items()
    few = boundary_figures(results, theories, "translation", Shown(overlays=()), sweep=False)
    assert {s.kind for f in few for p in f.panels for s in p.series} == {"measured", "bound"}
    delays = boundary_figures(results, theories, "translation", Shown(delays=(2, 3), overlays=("theory",)), sweep=True)
    assert [s.label for s in delays[0].panels[0].series if s.kind == "theory"] == [
        "theory of experiment 1, d = 2",
        "theory of experiment 1, d = 3",
    ]


def test_theory_for_a_range_of_delays_never_has_the_colour_of_an_experiment() -> None:
    results = [experiment(str(n)) for n in range(1, 9)]
    shown = Shown(delays=(2, 3, 4, 5), overlays=("theory",))
    figure, *_ = boundary_figures(results, {"1": theory()}, "translation", shown, sweep=True)
    curves = [s for s in figure.panels[0].series if s.variant is not None]
    assert [s.label for s in curves] == [f"theory of experiment 1, d = {d}" for d in (2, 3, 4, 5)]
    assert "Grey: theory for other delays." in figure.caption
    assert GREY not in SERIES
    (svg,) = draw(figure).panels
    tags = [tag for tag in re.findall(r"<[^>]*>", svg) if f'stroke="{GREY}"' in tag]
    dashes = {re.search(r'stroke-dasharray="([^"]*)"', tag)[1] for tag in tags}
    assert len(dashes) == 4, "each with its own dashes"
    plain, *_ = boundary_figures(results[:2], {}, "translation", Shown(overlays=("theory",)), sweep=True)
    assert "Grey" not in plain.caption


def test_experiments_without_an_operator_are_together_and_configurations_with_one_apart() -> None:
    grips = {"1": "none", "2": "none", "3": "none", "4": "comfortable"}
    results = [experiment(name, grip) for name, grip in grips.items()]
    figure, *_ = boundary_figures(results, {}, "translation", Shown(overlays=()), sweep=False)
    shown = {p.title: {s.label for s in p.series if s.label.startswith("experiment")} for p in figure.panels}
    assert shown["no operator"] == {"experiment 1", "experiment 2", "experiment 3"}
    assert "experiment 4, comfortable grip" in shown[results[3].configuration]
    (free, *_) = boundary_figures(results[:3], {}, "translation", Shown(overlays=()), sweep=False)
    assert [len(p.series) >= 3 for p in free.panels] == [True]


def test_identified_loop_is_drawn_with_its_interval_and_the_limit_for_a_harder_push() -> None:
    limits = tuple(Limit(damping=b, stiffness=900, low=800, high=1000, stiffness_large_motion=700) for b in (0, 4))
    rubs = Cause(code="coulomb_friction", sentence="", evidence="")
    result = experiment("1").model_copy(update={"loop_boundary": limits, "causes": (rubs,)})
    (figure,) = boundary_figures([result], {}, "translation", Shown(), sweep=False)
    found = {s.kind: s for s in figure.panels[0].series}
    assert (found["identified"].x.tolist(), found["friction"].x.tolist()) == ([900, 900], [700, 700])
    assert (found["envelope"].low.tolist(), found["envelope"].high.tolist()) == ([800, 800], [1000, 1000])
    # without friction, the limit does not depend on the push
    smooth = result.model_copy(update={"causes": ()})
    (figure,) = boundary_figures([smooth], {}, "translation", Shown(), sweep=False)
    assert "friction" not in {s.kind for s in figure.panels[0].series}


def test_answer_shows_every_trial_behind_a_wall() -> None:
    K, B = np.array([0.0, 100, 200, 300]), np.array([0.0, 4, 4, 8])
    verdict = np.array(["stable", "stable", "unstable", "undecided"])
    figure = answer_figure(experiment("1"), theory(), "rotation", 0, (K, B, verdict))
    found = {s.kind: s for s in figure.panels[0].series}
    assert (found["stable"].x.tolist(), found["unstable"].x.tolist()) == ([100], [200])
    assert figure.panels[0].names[0] == "stiffness K [Nm/rad]"


def test_answer_shows_the_limits_of_other_experiments_within_its_own_range() -> None:
    nothing = np.array([]), np.array([]), np.array([])
    alone = answer_figure(experiment("1"), theory(), "translation", 0, nothing)
    factor = {"stable": 9.0, "unstable": 9.0}
    stiff = tuple(
        p.model_copy(update={name: by * (getattr(p, name) or 0.0) or None for name, by in factor.items()})
        for p in experiment("1").boundary
    )
    others = [experiment(name).model_copy(update={"boundary": stiff}) for name in ("2", "3")]
    figure = answer_figure(experiment("1"), theory(), "translation", 0, nothing, others)
    lines = [s for s in figure.panels[0].series if s.kind == "others"]
    assert [s.label for s in lines] == ["other experiments", "_experiment 3"], "one entry of the legend"
    assert [s.tag for s in lines] == ["2", "3"], "each line has a name in the drawing"
    near = [experiment(name) for name in ("zwei", "drei")]
    svg = draw(answer_figure(experiment("1"), theory(), "translation", 0, nothing, near)).panels[0]
    assert re.findall(r">(zwei|drei)</text>", svg) == ["zwei", "drei"]
    first, second = (float(y) for y in re.findall(r' y="([\d.]+)">(?:zwei|drei)</text>', svg))
    assert abs(first - second) >= 10.0, "names of curves that end at one place are below each other"
    own = next(measured(experiment("1").boundary, "", None, intervals=True))
    assert np.nanmax(lines[0].x) == pytest.approx(9 * np.nanmax(own.x))
    assert figure.panels[0].limits == alone.panels[0].limits


def test_the_box_of_walls_to_use_is_explained_and_a_single_wall_has_none() -> None:
    point = UsePoint(stiffness=900.0, damping=4.0, trial_id="a", costs={}, margin=2.0)
    ends = {"stiffness_low": 800.0, "stiffness_high": 1000.0, "damping_low": 0.0, "damping_high": 8.0}
    nothing = np.array([]), np.array([]), np.array([])
    for trials, boxes in ((6, 1), (1, 0)):
        use = UseRegion(criterion="overshoot", **ends, trials=trials, costs={}, margin=2.0, bound=False, point=point)
        result = experiment("1").model_copy(update={"use": use})
        figure = answer_figure(result, theory(), "translation", 0, nothing)
        labels = [s.label for s in figure.panels[0].series]
        assert labels.count("box: walls to use") == figure.caption.count("Box: ") == boxes
        assert "recommended wall" in labels


def test_answer_shows_the_limits_with_friction_that_it_tells_of() -> None:
    limits = tuple(Limit(damping=b, stiffness=900, low=800, high=1000, stiffness_large_motion=700) for b in (0, 4))
    rubs = Cause(code="coulomb_friction", sentence="", evidence="")
    result = experiment("1").model_copy(update={"loop_boundary": limits, "causes": (rubs,)})
    nothing = np.array([]), np.array([]), np.array([])
    (panel,) = answer_figure(result, theory(), "translation", 0, nothing).panels
    found = {s.label: s.x.tolist() for s in panel.series}
    assert found["theory with friction"] == [900, 900]
    assert "theory without friction" in found


def test_normalised_plane_holds_several_devices_each_with_its_theory() -> None:
    light, heavy = theory(), theory(mass=1.16, damping=8.0)  # twice all: the same loop in alpha and beta
    slow = theory(mass=0.2, damping=0.0, delay=2.0, period=2e-3)
    entries = [(f"device {i}", experiment("1"), t, i) for i, t in enumerate((light, heavy, slow))]
    (panel,) = plane_figure(entries).panels
    lines = [s for s in panel.series if s.kind == "measured"]
    assert [s.label for s in lines] == [
        "device 0 (d = 4, δ = 0.0069)",
        "device 1 (d = 4, δ = 0.0069)",
        "device 2 (d = 2, δ = 0)",
    ]
    predicted = [s for s in panel.series if s.kind == "theory"]
    assert predicted[0].x == pytest.approx(predicted[1].x)
    physical = next(measured(experiment("1").boundary, "", None))
    # alpha = K T^2/m, beta = B T/m (Table 3.1)
    assert lines[2].x == pytest.approx(physical.x * 4e-6 / 0.2, nan_ok=True)
    assert lines[2].y == pytest.approx(physical.y * 2e-3 / 0.2)


def test_a_printed_bound_is_a_line_from_the_stiffest_wall_on() -> None:
    printed = published_bound("falcon")
    assert (printed.stiffness, printed.slope) == (38000.0, -230.0)  # (6.5)
    assert published_bound("lwr") is None
    (all_, *_) = boundary_figures([experiment("1")], {}, "translation", Shown(), sweep=False, printed=printed)
    (line,) = (s for s in all_.panels[0].series if s.kind == "linear")
    np.testing.assert_allclose(line.x, 38000 - 230 * line.y)
    assert "(6.5)" in line.label


def test_a_line_joins_limits_alone() -> None:
    """As 40 logs of a Falcon: of dampings with an unstable trial alone, the limit is anywhere below it."""
    points = (
        BoundaryPoint(damping=0, stable=None, unstable=1000, censored=False, low=0.0, high=1000.0),
        BoundaryPoint(damping=4, stable=1800, unstable=None, censored=True),
        BoundaryPoint(damping=100, stable=None, unstable=15000, censored=False, low=0.0, high=15000.0),
        BoundaryPoint(damping=116, stable=12600, unstable=None, censored=True),
        BoundaryPoint(damping=120, stable=None, unstable=None, censored=True),
        BoundaryPoint(damping=128, stable=11800, unstable=14200, censored=False, estimate=13914, low=11800, high=17258),
    )
    line, bound = measured(points, "limit", 0)
    assert dict(zip(line.y, line.x, strict=True)) == pytest.approx(
        {0: 0, 4: np.nan, 100: np.nan, 116: np.nan, 120: np.nan, 128: 13914}, nan_ok=True
    )
    assert bound.x.tolist() == [1800, 12600]


def test_dampings_of_theory_that_were_not_tested_are_an_area() -> None:
    """As the joint without delay: tests end at 40 % of the damping up to which theory is stable."""
    tested = measured(experiment("1").boundary, "limit", 0)
    (panel,) = limits_figure(
        "", "", [limits_panel("", [*tested, by_theory(theory(), "theory")], "translation")], "x"
    ).panels
    last = max(point.damping for point in experiment("1").boundary)
    assert last < 0.9 * np.nanmax(by_theory(theory(), "").y)
    (area,) = (s for s in panel.series if s.kind == "untested")
    assert (area.y.min(), area.x.max(), area.y.max()) == (last, panel.limits[0][1], panel.limits[1][1])
    # where the tests reach as far as theory, there is none
    tested = measured(experiment("1").boundary, "limit", 0)
    near = by_theory(theory(mass=0.45), "theory")
    (panel,) = limits_figure("", "", [limits_panel("", [*tested, near], "translation")], "x").panels
    assert "untested" not in {s.kind for s in panel.series}


def test_a_printed_bound_ends_where_its_stiffness_is_zero() -> None:
    """A line to K = 0 at a larger damping would have another slope."""
    beyond = BoundaryPoint(damping=340, stable=100, unstable=None, censored=True)
    wide, printed = experiment("1").model_copy(update={"boundary": (beyond,)}), published_bound("falcon")
    (all_, *_) = boundary_figures([wide], {}, "translation", Shown(), sweep=False, printed=printed)
    (line,) = (s for s in all_.panels[0].series if s.kind == "linear")
    assert line.y[-1] == pytest.approx(38000 / 230)
    np.testing.assert_allclose(line.x, 38000 - 230 * line.y, atol=1e-9)


def test_theory_is_drawn_at_the_ends_of_a_jittering_delay_in_colours_of_no_experiment() -> None:
    loop = Loop(0.58, 4.0, 0.001, 4.0, jitter_samples=(3, 4, 5))
    theories = {"1": Theory(SourcedLoop(loop=loop, source="device file falcon"))}
    results = [experiment("1"), experiment("2")]
    panel = boundary_figures(results, theories, "translation", Shown(), sweep=False)[0].panels[0]
    ends = {s.label: s for s in panel.series if s.label.startswith("theory of experiment 1, d")}
    assert list(ends) == ["theory of experiment 1, d = 3", "theory of experiment 1, d = 5"]
    assert {s.number for s in ends.values()}.isdisjoint({0, 1})
    assert np.nanmax(ends["theory of experiment 1, d = 3"].x) > np.nanmax(ends["theory of experiment 1, d = 5"].x)


def test_overlays_that_were_asked_for_are_drawn_or_the_caption_says_why_not() -> None:
    asked = Shown(overlays=("linear", "passive", "friction"))
    result = experiment("1").model_copy(update={"passive": PassiveWall(stiffness=500, damping=2)})
    figures = boundary_figures([result], {"1": theory()}, "translation", asked, sweep=False)
    (figure,) = (f for f in figures if f.identifier == "boundaries-loop")
    assert {"linear", "passive"} <= {s.kind for s in figure.panels[0].series}
    assert figure.caption.endswith("Not drawn: friction (no friction was found).")


@pytest.mark.parametrize("wall", [None, PassiveWall(stiffness=500, damping=2)])
def test_a_passive_region_is_drawn_where_the_logs_prove_a_passive_wall_alone(wall: PassiveWall | None) -> None:
    """It would promise stability with every hand, although the delay jitters or a hand damps the device."""
    asked = Shown(overlays=("linear", "passive"))
    result = experiment("1").model_copy(update={"passive": wall})
    (figure,) = boundary_figures([result], {"1": theory()}, "translation", asked, sweep=False)
    kinds = {s.kind for s in figure.panels[0].series}
    assert "linear" in kinds
    assert ("passive" in kinds) == (wall is not None)
    assert ("passive (not proven by these logs" in figure.caption) == (wall is None)


def test_the_line_through_the_limits_is_drawn_between_its_dampings() -> None:
    line = StraightBound(stiffness=900.0, slope=-10.0, slope_low=-12.0, slope_high=-8.0, damping_first=4.0,
                         damping_last=8.0, limits=4)  # fmt: skip
    limits = tuple(Limit(damping=b, stiffness=900, low=800, high=1000) for b in (0, 4))
    result = experiment("1").model_copy(update={"loop_boundary": limits, "straight_bound": line})
    (figure,) = boundary_figures([result], {}, "translation", Shown(), sweep=False)
    (drawn,) = (s for s in figure.panels[0].series if s.kind == "straight")
    assert (drawn.x.tolist(), drawn.y.tolist()) == ([860, 820], [4, 8])


def test_the_next_wall_to_measure_is_marked_in_the_answer() -> None:
    nothing = np.array([]), np.array([]), np.array([])
    step = NextWall(stiffness=12_000.0, damping=300.0, why="", command="")
    figure = answer_figure(experiment("1"), theory(), "translation", 0, nothing, (), step)
    (mark,) = (s for s in figure.panels[0].series if s.kind == "next")
    assert (mark.x.tolist(), mark.y.tolist(), mark.label) == ([12_000.0], [300.0], "next wall")
    assert figure.panels[0].limits[1][1] > 300.0, "it is within the axes"
    without = answer_figure(experiment("1"), theory(), "translation", 0, nothing)
    assert "next" not in {s.kind for s in without.panels[0].series}
