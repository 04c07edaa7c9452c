"""A trial beside theory: what is drawn is the motion of the simulator, which shares no code with it."""

import numpy as np
import pytest

from pipeline.comparison.compare_experiment import nominal_theories
from pipeline.comparison.figures.figure_trial import response, trial_figure
from pipeline.comparison.scene.scene import open_scene
from pipeline.records.loop_parts import Butterworth, LoopParts
from pipeline.records.score_records import TheoryParameters
from pipeline.rendering.figures.trial_drawing import courses
from pipeline.theory.predictions import Theory


@pytest.fixture(scope="module")
def first(falcon, falcon_outcome):
    (stages,) = open_scene("falcon", falcon.processed, ["1"], None).experiments
    result = next(e for e in falcon_outcome.result.experiments if e.experiment == "1")
    return stages, result


def trial_of(stages, verdict):
    names = stages.texts("response", "trial_id")
    return names[stages.verdicts.verdict.tolist().index(verdict)]


def test_theory_and_fits_lie_on_a_simulated_log(first):
    """The shared course is simulated with the numbers of the device file, noise and quantum beside."""
    stages, result = first
    figure = trial_figure(stages, result, trial_of(stages, "stable"), "translation")
    (course,) = figure.panels
    assert [each.label for each in course.beside] == ["theory", "fitted loop", "model of this log"]
    largest = np.abs(course.position).max()
    for each in course.beside:
        assert each.deviation < 0.02 * largest, each.label
    assert np.abs(course.residual).max() <= course.rounding
    assert "The logged command is that of the wall law" in figure.caption
    assert figure.simulated


def test_an_unstable_response_ends_where_it_is_out_of_proportion(first):
    stages, result = first
    (course,) = trial_figure(stages, result, trial_of(stages, "unstable"), "translation").panels
    for each in course.beside:
        shown = each.position[np.isfinite(each.position)]
        assert len(shown)
        assert np.abs(shown).max() <= 100 * np.abs(course.position).max()


def test_a_loop_with_filter_and_lag_moves_as_its_equations_say():
    """Against a fine integration of lag and mass, with the filter by its difference equation."""
    period, mass, damping, lag, stiffness, wall = 1e-3, 0.2, 1.5, 2e-3, 400.0, 3.0
    parts = LoopParts(velocity=Butterworth(kind="butterworth", order=1, cutoff_hz=80.0), actuator_lag_s=lag)
    theory = Theory(
        TheoryParameters(mass=mass, damping=damping, stiffness=0.0, sampling_period_s=period, delay_samples=2.5,
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


def test_an_excluded_trial_has_no_model_of_its_own(first):
    stages, result = first
    trial = trial_of(stages, "stable")
    others = stages.trials.filter([name != trial for name in stages.trials.column("trial_id").to_pylist()])
    other = type(stages)(stages.processed, stages.device, stages.experiment, others)
    other._tables |= {name: stages.table(name).slice(0, 0) for name in ("response", "model", "wall_law")}
    (course,) = trial_figure(other, result, trial, "translation").panels
    assert [each.label for each in course.beside] == ["theory", "fitted loop"]


def test_the_drawing_names_what_it_shows(first):
    stages, result = first
    figure = trial_figure(stages, result, trial_of(stages, "stable"), "translation")
    both = courses(figure, "translation")
    assert len(both) == 2
    for word in ("log", "theory", "fitted loop", "model of this log", "displacement [mm]"):
        assert word in both[0]
    assert "residual [" in both[1]
    assert "simulated" in both[1]
    assert "style=" not in "".join(both)


def test_theory_of_the_device_file_is_the_nominal_one(first, falcon):
    data = open_scene("falcon", falcon.processed, ["1"], None)
    stages, result = first
    theory = nominal_theories(data)["1"]
    figure = trial_figure(stages, result, trial_of(stages, "stable"), "translation")
    assert theory.parameters.source in figure.caption
