"""Cost maps and departures from theory: numbers that are drawn are those of the trials."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.comparison.experiment_result import nominal_theories
from pipeline.comparison.figures.maps import departure_figures, departures, map_figures
from pipeline.comparison.scene.scene import open_scene
from pipeline.comparison.thesis_tables_d import TableBuilder
from pipeline.records.results import SourcedLoop
from pipeline.rendering.figures.drawing import LOOKS, draw
from pipeline.theory.predictions import Predictions, Theory

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def of_falcon(falcon, falcon_outcome):
    data = open_scene("falcon", falcon.processed, None, None)
    theories = nominal_theories(data)
    predictions = Predictions(falcon.processed / "theory")
    assert predictions.missing(TableBuilder(data, theories).requests()) == []
    return data, falcon_outcome.result.experiments, theories, predictions


def test_each_criterion_of_each_table_has_a_figure_with_theory_first(of_falcon):
    figures = map_figures(*of_falcon)
    assert [f.identifier for f in figures][:2] == ["D-1-settle_2pct", "D-1-overshoot"]
    assert all(f.panels[0].title.startswith("theory, d = 4") for f in figures)
    assert all(panel.title.startswith("experiment") for f in figures for panel in f.panels[1:])
    assert len({panel.limits for panel in figures[0].panels}) == 1, "panels of a figure share their axes"


def test_a_map_has_no_limit_where_no_trial_was_unstable(of_falcon):
    """A line through stiffest stable trials would be read as the limit, with stable walls beyond it."""
    data, results, *rest = of_falcon
    censored = [
        point.model_copy(update={"censored": True, "unstable": None, "estimate": None, "low": None, "high": None})
        for point in results[0].boundary
    ]
    shown = [results[0].model_copy(update={"boundary": tuple(censored)}), *results[1:]]
    drawn = {s.kind: s for s in map_figures(data, shown, *rest)[0].panels[1].series}
    assert np.isnan(drawn["edge"].x).all()
    assert sorted(drawn["bound"].x) == sorted(p.stable for p in censored if p.stable is not None)


def test_a_map_shows_which_dampings_were_not_tested(of_falcon):
    figure = map_figures(*of_falcon)[0]
    assert "untested" not in {s.kind for panel in figure.panels for s in panel.series}, "tests reach as far as theory"
    data, results, theories, predictions = of_falcon
    device = theories["1"].loop
    stable_longer = Theory(SourcedLoop(loop=device.replace({"delay_samples": 2.0}), source="test"))
    with predictions:
        predictions.start(TableBuilder(data, {"1": stable_longer}).requests())
        predictions.finish()
    figure = map_figures(data, results, {"1": stable_longer}, predictions)[0]
    theory, logs = ({s.kind: s for s in panel.series} for panel in figure.panels)
    assert "untested" not in theory
    assert logs["untested"].y.min() == max(point.damping for point in results[0].boundary)
    assert "Grey area: dampings that were not tested." in figure.caption


def test_front_view_holds_the_trials_and_the_optimum_of_the_document(of_falcon):
    data, results, *_ = of_falcon
    figure = map_figures(*of_falcon)[0]
    panel = figure.panels[1]
    front = {s.label: s for s in panel.below.series}
    best = results[0].optimum["settle_2pct"]
    assert (front["_optimum"].x[0], front["_optimum"].y[0]) == (best.stiffness, best.cost)
    cost = data.experiments[0].sure_cost("settle_2pct")
    assert set(front["_trials"].y.tolist()) <= set(cost[np.isfinite(cost)].tolist())
    line = front["_least cost"]
    # where a stiffness was tested at many dampings, the line of least cost lies nowhere above a single trial
    least = dict(zip(line.x.tolist(), line.y.tolist(), strict=True))
    trials = [(x, y) for x, y in zip(front["_trials"].x, front["_trials"].y, strict=True) if x in least]
    assert len(trials) > 50
    assert all(least[x] <= y + 1e-9 for x, y in trials)
    svg, *_ = draw(figure).panels
    assert "settling time" in svg


def test_where_all_trials_cost_as_theory_says_no_departure_is_drawn(of_falcon):
    data, _, theories, predictions = of_falcon
    figures = departure_figures(data, theories, predictions)
    assert {f.identifier for f in figures} == {
        f"residual-{c}" for c in data.scene.criteria if "1pct" not in c and "5pct" not in c
    }
    # the shared course is simulated by the device file: medians are small
    settling = next(f for f in figures if f.identifier == "residual-settle_2pct")
    for panel in settling.panels:
        told = next(s for s in panel.series if s.kind == "hover")
        assert abs(np.median(told.value)) < 10
        # the key of the marks has the sizes and the deviations from which they are drawn
        key = {s.label: LOOKS[s.kind]["ms"] for s in panel.series if s.kind.startswith("step")}
        assert key == {"from 5 % on": 4.0, "from 10 % on": 6.0, "from 25 % on": 8.5, "from 50 % on": 11.0}
    assert "dots: less than 5 %" in settling.caption


def test_departure_is_a_ratio_or_a_difference():
    one = np.array([2.0, 0.0, 3.0])
    assert departures(one, np.array([1.0, 1.0, 4.0]), "settle_2pct")[[0, 2]].tolist() == [1.0, -0.25]
    assert np.isnan(departures(one, np.array([1.0, 1.0, 4.0]), "settle_2pct")[1])
    assert departures(np.array([0.1]), np.array([1e-13]), "overshoot").tolist() == [0.1]
