from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import simulated

from pipeline.comparison.compare_experiment import nominal_theories
from pipeline.comparison.figures.boundary_curves import linear_curve, measured_curve, theory_curve
from pipeline.comparison.figures.figure_data import FigureBuilder, requests_of_delay_figure
from pipeline.comparison.loops.told_loop import adequate_theory
from pipeline.comparison.scene.scene import open_scene
from pipeline.records.models import Shown, TableLayout
from pipeline.theory.predictions import Predictions


@pytest.fixture(scope="module")
def of_falcon(falcon, falcon_outcome):
    data = open_scene("falcon", falcon.processed, None, None)
    theories = nominal_theories(data)
    return FigureBuilder(data, theories, falcon_outcome.result.experiments)


@pytest.fixture(scope="module")
def of_lwr(lwr, lwr_outcome):
    data = open_scene("lwr", lwr.processed, None, None)
    return FigureBuilder(data, nominal_theories(data), lwr_outcome.result.experiments)


def known_predictions(builder, lab):
    from pipeline.comparison.tables_d import TableBuilder

    found = Predictions(lab.processed / "theory")
    wanted = TableBuilder(builder.data, builder.theories).requests()
    assert found.missing(wanted + requests_of_delay_figure(builder.data, builder.theories)) == []
    return found


@pytest.mark.parametrize(("builder", "name", "plant"), [
    ("of_falcon", "1", simulated.FALCON), ("of_falcon", "6", {**simulated.FALCON, "mass": 1.0, "b": 34.0}),
    ("of_lwr", "delay-4", {**simulated.LWR, "delay": 4}),
])  # fmt: skip
def test_drawn_boundary_is_the_limit_of_an_independent_loop(builder, name, plant, request):
    theory = request.getfixturevalue(builder).theories[name]
    curve = theory_curve(theory, "x")
    assert curve.stiffness[-1] == 0  # closed along K = -k
    inner = curve.stiffness[1:-1:6], curve.damping[1:-1:6]
    for K, B in zip(*inner, strict=True):
        if 0.05 * curve.stiffness.max() < K:  # near K = 0 the pole at z = 1 hides the others
            assert simulated.spectral_radius(K, B, **plant) == pytest.approx(1, abs=1e-9)
            assert simulated.spectral_radius(0.98 * K, B, **plant) < 1 or 0.5 * curve.stiffness.max() > K


def test_measured_curve_shows_the_last_stable_trials(of_falcon, falcon_outcome):
    result = falcon_outcome.result.experiments[0]
    curve = measured_curve(result)
    assert curve.kind == "measured"
    points = {p.damping: p.stable or 0.0 for p in result.boundary}
    for K, B in zip(curve.stiffness, curve.damping, strict=True):
        assert points[B] == K
    assert not curve.censored.any()
    empty = result.model_copy(update={"boundary": ()})
    assert len(measured_curve(empty).stiffness) == 0


def test_linear_condition_touches_the_boundary_at_the_origin(of_falcon):
    theory = of_falcon.theories["1"]
    line = linear_curve(theory)
    # (3.25): B = K t_r - b with t_r = (d + 1/2) T
    assert line.damping[0] == pytest.approx(-4.0)
    slope = (line.damping[1] - line.damping[0]) / line.stiffness[1]
    assert slope == pytest.approx(4.5e-3)
    near = 20.0  # the tangent: a little above the line is stable, a little below unstable
    for offset, stable in ((0.05, True), (-0.05, False)):
        radius = simulated.spectral_radius(near, near * 4.5e-3 - 4.0 + offset, **simulated.FALCON)
        assert (radius < 1) is stable


def test_boundary_figures_of_a_free_device(of_falcon):
    figures = {f.identifier: f for f in of_falcon.boundaries()}
    assert set(figures) == {"boundaries-free", "boundaries-estimates"}
    ((_, curves),) = figures["boundaries-free"].panels
    assert [c.label for c in curves if c.kind == "theory"] == ["d = 3", "d = 4", "d = 5", "d = 6"]
    assert [c.kind for c in curves].count("measured") == 1
    tops = [c.stiffness.max() for c in curves if c.kind == "theory"]
    assert tops == sorted(tops, reverse=True)  # more delay, less stiffness
    ((title, panel),) = figures["boundaries-estimates"].panels
    assert title == "experiment 1"
    estimated = next(c for c in panel if c.kind == "theory")
    assert estimated.stiffness.max() == pytest.approx(tops[1], rel=1e-3)


def test_boundary_figures_of_a_sweep(of_lwr):
    figures = {f.identifier: f for f in of_lwr.boundaries()}
    assert set(figures) == {"boundaries-delay", "boundaries-estimates", "boundaries-normalised"}
    panels = dict(figures["boundaries-delay"].panels)
    assert [c.label for c in panels["theory"]] == ["d = 2", "d = 4"]
    assert [c.label for c in panels["measured"]] == ["delay-2", "delay-4"]


def test_captions_tell_of_nothing_that_is_not_drawn(of_falcon, of_lwr, lwr):
    def captions(builder, **shown):
        scene = builder.data.scene.model_copy(update={"shown": Shown(**shown)})
        return {f.identifier: f.caption for f in replace(builder, data=replace(builder.data, scene=scene)).boundaries()}

    assert "Theory for m" in captions(of_falcon)["boundaries-free"]
    assert "passive region" in captions(of_falcon)["boundaries-estimates"]
    assert "passive region" not in captions(of_lwr)["boundaries-estimates"]  # b = 0: no wall is passive
    for builder in (of_falcon, of_lwr):
        alone = captions(builder, overlays=("estimates",))
        for name, caption in alone.items():
            assert "Shaded" not in caption
            assert "passive region" not in caption
            assert name == "boundaries-estimates" or not re.search("[Tt]heor", caption)
    found = known_predictions(of_lwr, lwr)
    assert all("Optima as in" in f.caption for f in of_lwr.costs(found))
    scene = of_lwr.data.scene.model_copy(update={"shown": Shown(tables=())})
    unlisted = replace(of_lwr, data=replace(of_lwr.data, scene=scene)).costs(found)
    assert unlisted
    assert not any("Optima as in" in f.caption for f in unlisted)


def test_experiments_of_one_delay_are_all_drawn_over_delay(of_lwr, lwr, lwr_outcome):
    rows = [r for r in lwr_outcome.result.tables if r.table == "D.6"]
    again = [
        r if r.condition == "theory_discrete" else r.model_copy(update={"experiment": "again", "cost": r.cost + 1})
        for r in rows
        if r.delay_samples == 2
    ]
    (figure,) = of_lwr.delays([*rows, *again], known_predictions(of_lwr, lwr))
    for panel in figure.panels:
        costs = [r.cost for r in rows if r.criterion == panel.criterion and r.condition == "experiment"]
        assert panel.delay_samples.tolist() == [2, 2, 4]
        assert panel.measured.tolist() == [costs[0], costs[0] + 1, costs[1]]
        assert panel.theory[0] == panel.theory[1]


def test_cost_figures_name_the_figure_of_the_thesis_and_bear_names_of_their_own(of_lwr, lwr):
    figures = of_lwr.costs(known_predictions(of_lwr, lwr))
    told = {f.identifier: re.search(r"Fig\. ([\d.]+)\.", f.caption)[1] for f in figures}
    assert told["D-4-settle_2pct"] == "6.10"
    assert told["D-5-energy_step_w2"] == "6.11"


def test_names_that_differ_in_punctuation_give_figures_of_different_names(of_lwr, lwr, monkeypatch):
    """Equal identifiers would let one drawing refer to the clip path of the other."""
    layout = TableLayout(name="x", criteria=("overshoot",), experiments=("delay-2",), theory_from="delay-2")
    names = ("experiment a b", "experiment a-b", "experiment a/b")
    made = tuple(layout.model_copy(update={"name": name}) for name in names)
    predictions = known_predictions(of_lwr, lwr)
    monkeypatch.setattr("pipeline.comparison.figures.figure_data.layouts", lambda data: made)
    found = [f.identifier for f in of_lwr.costs(predictions)]
    assert found == [f"experiment-a-b-overshoot{end}" for end in ("", "-2", "-3")]


def test_no_overlay_without_the_estimates_it_needs(falcon, falcon_outcome):
    data = open_scene("falcon", falcon.processed, None, ["overshoot"])
    builder = FigureBuilder(data, nominal_theories(data), falcon_outcome.result.experiments)
    assert {f.identifier for f in builder.boundaries()} == {"boundaries-free"}


def test_theory_by_estimates_needs_an_adequate_loop(of_falcon, falcon_outcome):
    result, (stages, *_) = falcon_outcome.result.experiments[0], of_falcon.data.experiments
    found = adequate_theory(result, stages).parameters
    assert found.mass == pytest.approx(result.loop.mass.value, rel=0.05)
    assert found.damping >= 0.0
    doubtful = result.loop.model_copy(update={"adequate": False})
    assert adequate_theory(result.model_copy(update={"loop": doubtful}), stages) is None


def test_cost_figures_show_theory_beside_the_trials(of_falcon, falcon):
    figures = of_falcon.costs(known_predictions(of_falcon, falcon))
    assert [f.criterion for f in figures] == [
        "settle_2pct", "overshoot", "energy_step_w0", "energy_step_w1", "energy_step_w2",
    ]  # fmt: skip
    assert len({f.identifier for f in figures}) == 5
    stages = falcon.stages("1")
    for figure in figures:
        theory, measured = figure.panels
        assert (theory.kind, measured.kind) == ("theory", "measured")
        assert theory.cost.shape == (len(theory.damping), len(theory.stiffness))
        assert measured.cost.shape == (len(measured.damping), len(measured.stiffness))
        # no grid point beats the optimum that is marked
        assert np.nanmin(theory.cost) >= theory.optimum.cost * (1 - 1e-9)
        assert np.nanmin(measured.trial_cost) == measured.optimum.cost
        stable = (stages.column("response", "stiffness") > 0) & (stages.verdicts.verdict != "unstable")
        assert len(measured.trial_cost) == stable.sum()
        # trials of an ideal course hardly scatter: what is drawn is close to most of them where one was made
        away = []
        for K, B, cost in zip(measured.trial_stiffness, measured.trial_damping, measured.trial_cost, strict=True):
            at = np.flatnonzero(measured.stiffness == K)
            known = np.isfinite(measured.trial_cost) & (measured.trial_damping == B)
            if len(at) and np.isfinite(cost) and known.sum() > 1:  # a line of one trial is only its marker
                drawn = measured.cost[np.flatnonzero(measured.damping == B)[0], at[0]]
                away += [abs(drawn - cost)] if figure.criterion == "overshoot" else [abs(drawn / cost - 1)]
        assert len(away) > 50
        assert np.nanmedian(away) < 0.02


def test_cost_maps_claim_nothing_beyond_the_tested_range(of_falcon, falcon):
    measured = of_falcon.costs(known_predictions(of_falcon, falcon))[2].panels[1]
    for row, B in enumerate(measured.damping):
        tested = measured.trial_stiffness[(measured.trial_damping == B) & np.isfinite(measured.trial_cost)]
        shown = measured.stiffness[np.isfinite(measured.cost[row])]
        if len(shown):
            assert tested.min() <= shown.min()
            assert shown.max() <= tested.max()


def test_delay_figure_holds_the_rows_of_the_table(of_lwr, lwr, lwr_outcome):
    rows = lwr_outcome.result.tables
    (figure,) = of_lwr.delays(rows, known_predictions(of_lwr, lwr))
    assert [p.criterion for p in figure.panels] == ["settle_2pct", "energy_step_w0", "energy_step_w1", "energy_step_w2"]
    for panel in figure.panels:
        assert panel.delay_samples.tolist() == [2.0, 4.0]
        costs = {
            (r.condition, r.delay_samples): r.cost for r in rows if r.table == "D.6" and r.criterion == panel.criterion
        }
        assert panel.theory.tolist() == [costs["theory_discrete", 2], costs["theory_discrete", 4]]
        assert panel.measured.tolist() == [costs["experiment", 2], costs["experiment", 4]]
        assert (panel.damped < panel.theory).all() or panel.criterion == "settle_2pct"  # damping helps
        assert (np.diff(panel.theory) > 0).all()


def test_no_delay_figure_without_a_sweep(of_falcon, falcon, falcon_outcome):
    assert requests_of_delay_figure(of_falcon.data, of_falcon.theories) == []
    assert of_falcon.delays(falcon_outcome.result.tables, known_predictions(of_falcon, falcon)) == ()


def test_device_without_theory_still_has_its_measured_maps(unknown, unknown_outcome):
    data = open_scene("mydevice", unknown.processed, None, ["overshoot"])
    builder = FigureBuilder(data, {}, unknown_outcome.result.experiments)
    (figure,) = builder.costs(Predictions(unknown.processed / "theory"))
    assert [m.kind for m in figure.panels] == ["measured"]
    assert {f.identifier for f in builder.boundaries()} <= {"boundaries-estimates"}
