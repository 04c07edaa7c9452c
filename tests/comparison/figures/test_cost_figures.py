"""Drawn costs: free of the noise of single trials and of the steps of whole numbers, and nowhere far from them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.comparison.compare_experiment import nominal_theories
from pipeline.comparison.figures.cost_figures import _smoothed, measured_map, without_steps
from pipeline.comparison.scene.scene import open_scene
from pipeline.loop.loop import Loop
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.theory.costs import cost_maps
from pipeline.theory.predictions import Predictions

pytestmark = pytest.mark.usefixtures("one_process")


def roughness(values: np.ndarray) -> float:
    """Mean size of second differences along an axis: zero on a plane."""
    return float(np.nanmean(np.abs(np.diff(values, 2, axis=0))))


def test_steps_of_whole_settling_times_are_taken_off_and_costs_stay() -> None:
    loop = Loop(0.0, 0.0, 3.0)
    cost = cost_maps(loop, np.linspace(0.005, 0.06, 60), np.linspace(0.05, 0.25, 60), ["settle_2pct"])["settle_2pct"]
    smooth = without_steps(cost)
    assert (np.isfinite(smooth) == np.isfinite(cost)).all()
    assert roughness(np.log(smooth)) < 0.4 * roughness(np.log(cost))
    # near the limit of stability times rise without end, and a step of one sample is none of their size
    inside = cost < 420
    assert inside.sum() > 1300
    assert np.median(np.abs(smooth / cost - 1)[inside]) < 0.03


def test_a_smooth_map_is_left_as_it_is() -> None:
    x, y = np.meshgrid(np.linspace(0, 1, 30), np.linspace(0, 1, 30))
    plane = np.exp(1.0 + 0.3 * x + 0.2 * y)
    inside = np.s_[2:-2, 2:-2]
    assert without_steps(plane)[inside] == pytest.approx(plane[inside], rel=1e-12)


class Course:
    """Trials on a grid whose costs are theory's times a ratio that changes slowly, and noise of 20 %."""

    def __init__(self, seed: int) -> None:
        x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(0.05, 1, 20), np.linspace(0, 1, 15)))
        self.places = {"stiffness": 8000 * x, "damping": 100 * y}
        self.expected = np.exp(1 + 6 * ((x - 0.5) ** 2 + (y - 0.5) ** 2))
        self.truth = self.expected * np.exp(0.1 + 0.2 * x)
        self.cost = self.truth * np.exp(np.random.default_rng(seed).normal(0, 0.2, len(x)))
        self.verdicts = SimpleNamespace(verdict=np.full(len(x), "stable"))

    def column(self, stage: str, name: str) -> np.ndarray:
        return self.places[name]

    def costs_at(self, theory: object, stiffness: object, damping: object, criteria: list[str]) -> dict:
        return dict.fromkeys(criteria, self.expected)


@pytest.mark.parametrize("seed", range(4))
def test_the_noise_of_single_trials_is_smoothed_away_and_the_valley_stays(seed: int) -> None:
    course = Course(seed)
    for theory, left in ((object(), 0.4), (None, 0.75)):
        smooth = _smoothed(course, course.cost, "energy_step_w1", theory, course)
        before, after = (np.log(each / course.truth) for each in (course.cost, smooth))
        assert np.sqrt(np.mean(after**2)) < left * np.sqrt(np.mean(before**2))
    # beside a theory, which holds the curvature, the valley is not filled
    least = _smoothed(course, course.cost, "energy_step_w1", object(), course).min()
    assert least == pytest.approx(course.truth.min(), rel=0.12)


def test_where_theory_lacks_costs_the_measured_ones_are_smoothed_alone() -> None:
    course = Course(1)
    alone = _smoothed(course, course.cost, "energy_step_w1", None, course)
    course.expected = np.where(course.places["stiffness"] > 6000, np.nan, course.expected)
    assert (_smoothed(course, course.cost, "energy_step_w1", object(), course) == alone).all()


@pytest.mark.parametrize(("known", "drawn"), [(19, False), (60, True)])
def test_lines_are_drawn_where_enough_trials_have_a_cost(falcon, falcon_outcome, monkeypatch, known, drawn) -> None:
    result, stages = falcon_outcome.result.experiments[0], ExperimentStages.stored(falcon.processed, "falcon", "1")
    cost = stages.sure_cost("settle_2pct")
    cost[np.flatnonzero(np.isfinite(cost))[known:]] = np.nan
    monkeypatch.setattr(stages, "sure_cost", lambda name: cost)
    found = measured_map(result, stages, "settle_2pct", None, Predictions(falcon.processed / "theory"))
    assert np.isfinite(found.cost).any() == drawn
    assert np.isfinite(found.trial_cost).sum() == known


def test_costs_at_trials_are_computed_once(monkeypatch, falcon) -> None:
    data = open_scene("falcon", falcon.processed, None, ["settle_2pct"])
    theory, predictions = nominal_theories(data)["1"], Predictions(falcon.processed / "theory")
    points = np.array([1000.0, 5000.0]), np.array([20.0, 60.0])
    first = predictions.costs_at(theory, *points, ["settle_2pct"])
    monkeypatch.setattr("pipeline.theory.predictions.costs_at", None)
    assert predictions.costs_at(theory, *points, ["settle_2pct"]).keys() == first.keys()
    with pytest.raises(TypeError):
        predictions.costs_at(theory, *points, ["overshoot"])
