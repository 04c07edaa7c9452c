"""Responses that are drawn: period and delay of a log, theory beside it against a simulator that shares no code."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import simulated

from pipeline.comparison.figures.responses import (
    oscillation_period,
    overlaid_figure,
    response,
    response_figures,
    softest,
    trial_figure,
    wall_figure,
)
from pipeline.comparison.scene.scene import open_scene
from pipeline.device.parts import Butterworth, LoopTable
from pipeline.records.results import SourcedLoop
from pipeline.rendering.figures.drawing import draw
from pipeline.theory.predictions import Theory


@pytest.fixture(scope="module")
def first(falcon, falcon_outcome):
    (stages,) = open_scene("falcon", falcon.processed, ["1"], None).experiments
    result = next(e for e in falcon_outcome.result.experiments if e.experiment == "1")
    return stages, result


def second_order(frequency: float, decay: float, end: float = 0.6) -> tuple[np.ndarray, np.ndarray]:
    """Step response of a second-order system with final value 2, sampled at 1 ms."""
    t = np.arange(0, end, 1e-3)
    return t, 2 * (1 - np.exp(-decay * t) * (np.cos(frequency * t) + decay / frequency * np.sin(frequency * t)))


@pytest.mark.parametrize("decay", [0.5, 3.0])
def test_period_is_that_of_the_damped_oscillation(decay: float) -> None:
    t, x = second_order(30.0, decay)
    first, second = oscillation_period(t, x, 2.0) or (0.0, 0.0)
    # maxima stand at pi/w and 3 pi/w; half a sample is what the sampling leaves open
    assert (first, second) == pytest.approx((np.pi / 30, 3 * np.pi / 30), abs=6e-4)
    assert oscillation_period(t, -x, -2.0) == (first, second)


def test_no_period_without_two_whole_maxima() -> None:
    t, x = second_order(30.0, 0.5)
    assert oscillation_period(t[:250], x[:250], 2.0) is None, "the log ends in the second rise"
    assert oscillation_period(*second_order(30.0, 60.0), 2.0) is None, "hardly any overshoot"


def test_softest_stable_walls_each_at_its_least_damping() -> None:
    k, b = np.array([0.0, 400, 200, 200, 200, 600]), np.array([0.0, 4, 8, 0, 4, 0])
    assert softest(k, b, np.array([1, 1, 1, 0, 1, 1], dtype=bool)).tolist() == [4, 1, 5]
    assert len(softest(k, b, np.zeros(6, dtype=bool))) == 0


def test_first_response_of_a_device_shows_its_delay_and_its_period(falcon) -> None:
    data = open_scene("falcon", falcon.processed, None, None)
    (figure,) = response_figures(data)
    whole, begin = figure.panels
    series = {s.label: s for s in whole.series}
    (mark,) = (s for s in begin.series if s.label == "first change")
    assert mark.x[0] == simulated.FALCON["delay"] + 1  # [ms] at 1 kHz: d_obs = floor(d + 1) (6.2)
    stiffness = 8e3 / series["_final value"].y[0]
    damping = float(figure.caption.partition("B = ")[2].split(" ")[0])
    # the wall's spring on the mass, with the delay as lost damping: K t_r of (3.25)
    mass, viscous = simulated.FALCON["mass"], simulated.FALCON["b"]
    decay = (viscous + damping - stiffness * 4.5e-3) / (2 * mass)
    period = 2 * np.pi / np.sqrt(stiffness / mass - decay**2)
    found = 1e-3 * float(np.ptp(series["oscillation period"].x))
    assert found == pytest.approx(period, rel=0.03)  # second order of a loop of seventh


def test_no_first_response_without_a_stable_wall(falcon) -> None:
    data = open_scene("falcon", falcon.processed, None, None)
    stages = data.experiments[0]
    stages.__dict__["verdicts"] = replace(stages.verdicts, verdict=np.full_like(stages.verdicts.verdict, "unstable"))
    assert response_figures(replace(data, experiments=(stages,))) == []


def trial_of(stages, verdict):
    return stages.texts("response", "trial_id")[stages.verdicts.verdict.tolist().index(verdict)]


@pytest.mark.slow
def test_theory_and_fits_lie_on_a_simulated_log(first):
    """The shared course is simulated with the numbers of the device file, noise and quantum beside."""
    stages, result = first
    figure = trial_figure(stages, result, trial_of(stages, "stable"), "translation")
    course, command, law = figure.panels
    assert [series.label for series in command.series] == ["command"]
    beside = {s.label: s for s in course.series if not s.label.startswith("_")}
    assert list(beside) == ["log", "theory", "fitted loop"]
    largest = np.abs(beside["log"].y).max()
    for series in list(beside.values())[1:]:
        assert np.sqrt(np.mean((series.y - beside["log"].y) ** 2)) < 0.02 * largest, series.label
    residual, rounding, _ = law.series
    assert np.abs(residual.y).max() <= rounding.y[0]
    assert "The logged command agrees with the wall law" in figure.caption
    assert result.theory.source in figure.caption
    assert figure.simulated
    both = overlaid_figure([figure, figure], ["a", "b"])
    assert [s.kind for s in both.panels[0].series] == ["course", "theory"] * 2
    drawn = draw(figure).panels
    assert "displacement [mm]" in drawn[0]
    assert "style=" not in "".join(drawn), "a policy of a page may forbid styles"


def test_an_unstable_response_ends_where_it_is_out_of_proportion(first):
    stages, result = first
    course = trial_figure(stages, result, trial_of(stages, "unstable"), "translation").panels[0]
    log, *beside = (s for s in course.series if not s.label.startswith("_"))
    assert len(beside) > 1
    for each in beside:
        assert 0 < np.nanmax(np.abs(each.y)) <= 100 * np.abs(log.y).max()


def test_an_excluded_trial_is_drawn_beside_the_loop(first):
    stages, result = first
    trial = trial_of(stages, "stable")
    others = stages.trials.filter([name != trial for name in stages.trials.column("trial_id").to_pylist()])
    other = type(stages)(stages.processed, stages.device, stages.experiment, others)
    other._tables |= {name: stages.table(name).slice(0, 0) for name in ("response", "model", "wall_law")}
    other._tables["device"] = stages.table("device")
    course = trial_figure(other, result, trial, "translation").panels[0]
    assert [s.label for s in course.series if not s.label.startswith("_")] == ["log", "theory", "fitted loop"]


def test_a_loop_with_filter_and_lag_moves_as_its_equations_say():
    """Against a fine integration of lag and mass, with the filter by its difference equation."""
    period, mass, damping, lag, stiffness, wall = 1e-3, 0.2, 1.5, 2e-3, 400.0, 3.0
    parts = LoopTable(velocity=Butterworth(kind="butterworth", order=1, cutoff_hz=80.0), actuator_lag_s=lag)
    theory = Theory(
        SourcedLoop(mass=mass, damping=damping, stiffness=0.0, sampling_period_s=period, delay_samples=2.5,
                         source="", loop=parts)
    )  # fmt: skip
    rows, fine = 120, 2000
    force = np.where(np.arange(rows) >= 5, 2.0, 0.0)
    tangent = np.tan(np.pi * 80.0 * period)
    b, a = tangent / (1 + tangent), (tangent - 1) / (tangent + 1)
    x = v = u = filtered = change_before = before = 0.0
    commands, positions = [], []
    for k in range(rows):
        positions.append(x)
        change = (x - before) / period
        filtered = b * (change + change_before) - a * filtered
        commands.append(force[k] - stiffness * x - wall * filtered)
        before, change_before = x, change
        for step in range(fine):
            of = k - 3 if step < fine / 2 else k - 2
            demand = commands[of] if of >= 0 else 0.0
            u += period / fine * (demand - u) / lag
            v += period / fine * (u - damping * v) / mass
            x += period / fine * v
    found = response(theory, stiffness, wall, force)
    # one step of the integration is 1/2000 of a period: errors of first order
    np.testing.assert_allclose(found, positions, rtol=0, atol=2e-3 * np.abs(positions).max())
    assert np.abs(found).max() > 1e-3


def test_the_recommended_wall_is_drawn_beside_theory_s_optimum(falcon, falcon_outcome):
    """On an ideal log both lines of the recommended wall coincide, and the optimum has settled when theory says."""
    data = open_scene("falcon", falcon.processed, None, None)
    result = falcon_outcome.result
    theory = Theory(result.experiments[0].theory)
    rows = [row for row in result.tables if row.criterion == "settle_2pct" and row.condition == "theory_discrete"]
    figure = wall_figure(data.experiments[0], result.experiments[0], theory, rows[0])
    log, line, best = figure.panels[0].series
    np.testing.assert_allclose(log.y, line.y, atol=2e-3)
    outside = np.flatnonzero(np.abs(best.y - 1) > 0.02)
    assert outside[-1] + 1 - int(theory.loop.delay_samples) == round(rows[0].cost)
    assert 'id="recommended-wall"' in falcon_outcome.report.read_text(encoding="utf-8")
