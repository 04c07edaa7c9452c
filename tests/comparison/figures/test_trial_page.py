"""Trials in the page: those of the stages, those of tables first; responses come back as a browser reads them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from stored import trials_of
from trial_pages import decode, unpack

from pipeline.comparison.experiment_result import experiment_numbers, nominal_theories
from pipeline.comparison.figures import trial_page as page_module
from pipeline.comparison.figures.trial_page import (
    COLUMNS,
    LEVELS,
    WHOLE,
    code,
    reason_of,
    step_size,
    trial_page,
    visible_rows,
)
from pipeline.comparison.scene.scene import open_scene
from pipeline.records.criteria import REPORTED
from pipeline.rendering.labels import cost_text
from pipeline.rendering.report.page_template import json_text

pytestmark = pytest.mark.slow

SIGNALS = arrays(np.float64, st.integers(2, 60), elements=st.floats(-1e3, 1e3))


@pytest.fixture(scope="module")
def scene(noisy):
    data = open_scene("falcon", noisy.processed, None, None)
    theories = nominal_theories(data)
    return data, [experiment_numbers(data, data.experiments[0], theories["1"])], theories


@pytest.fixture(scope="module")
def page(scene):
    return trial_page(*scene)


def parts(page):
    entry = page.content["experiments"][0]
    return unpack(entry["columns"]), unpack(entry["responses"])


def test_every_trial_is_there_with_its_condition_verdict_outcome_and_costs(scene, page):
    stages = scene[0].experiments[0]
    columns, _ = parts(page)
    assert page.trials == len(trials_of(stages)) == len(columns["k"]) > 150
    assert columns["k"] == pytest.approx(stages.column("response", "stiffness"), rel=1e-5)
    assert columns["b"] == pytest.approx(stages.column("response", "damping"), rel=1e-5)
    assert [page.content["verdicts"][int(v)] for v in columns["v"]] == stages.texts("response", "verdict")
    named = [page.content["outcomes"][int(o)] for o in columns["o"]]
    assert named == [text.replace("_", " ") for text in stages.texts("outcome", "outcome")]
    for criterion, costs in zip(REPORTED, columns["c"], strict=True):
        expected = stages.cost(criterion)[0] * (100 if criterion == "overshoot" else 1)
        found = np.array([np.nan if c is None else c for c in costs])
        # three digits: half of the last is at most 0.5 %
        assert found == pytest.approx(expected, rel=5.1e-3, nan_ok=True)


def test_responses_are_those_of_the_logs_within_half_a_step(scene, page):
    trials = trials_of(scene[0].experiments[0])
    _, responses = parts(page)
    assert len(responses) == page.responses > 50
    for trial in responses[::7]:
        row = trial["i"]
        assert trial["id"] == trials.trial_id[row]
        log = trials[row].displacement
        # "q" is written with six digits, which some hundred steps turn into a thousandth of a step
        assert np.abs(decode(trial["x"], trial["q"]) - log).max() <= 0.51 * trial["q"]
        assert trial["q"] <= max(1.001 * np.ptp(log) / LEVELS, 2.1e-6)


def test_model_follows_the_log_of_a_calm_trial(scene, page):
    best = scene[1][0].optimum["settle_2pct"]
    trial = next(t for t in parts(page)[1] if t["id"] == best.trial_id)
    log, model = decode(trial["x"], trial["q"]), decode(trial["g"], trial["gq"])
    # the delay jitters by a sample about the fitted one, which moves the rise by up to a seventh of its height
    assert np.abs(log - model).max() < 0.15 * trial["f"]
    assert "m = 0.5" in trial["model"]
    assert trial["costs"][REPORTED.index("settle_2pct")].startswith(cost_text("settle_2pct", best.cost))


def test_trials_that_tables_name_come_first_and_are_found_by_their_place(scene, page):
    stages, result = scene[0].experiments[0], scene[1][0]
    columns, responses = parts(page)
    best = {str(o.trial_id) for o in result.optimum.values()}
    assert {t["id"] for t in responses[: len(best) + 1]} >= best
    for trial in best:
        assert trials_of(stages).trial_id[int(page.places["1", trial].split("-")[1])] == trial
    edges = [(p.damping, k, v) for p in result.boundary for k, v in ((p.stable, "0"), (p.unstable, "1")) if k]
    assert len(edges) > 10
    for damping, stiffness, verdict in edges:
        row = int(page.limits["1", damping, stiffness].split("-")[1])
        assert (columns["b"][row], columns["k"][row], columns["v"][row]) == (damping, stiffness, verdict)


def test_few_responses_cover_the_plane_and_the_number_of_samples_holds(scene, monkeypatch):
    monkeypatch.setattr(page_module, "SAMPLES", 20_000)
    columns, responses = parts(trial_page(*scene))
    taken = sum(len(trial["x"]["r"]) for trial in responses)
    assert 18_000 < taken <= 20_000
    stable = [t["i"] for t in responses if columns["v"][t["i"]] == "0"]
    k, b = (np.array(columns[name], dtype=float) for name in "kb")
    assert len({(bool(k[i] > np.median(k)), bool(b[i] > np.median(b))) for i in stable}) == 4
    full = trial_page(*scene, full=True)
    assert sorted(t["i"] for t in parts(full)[1]) == list(range(full.trials))
    assert json_text(trial_page(*scene, full=True).content) == json_text(full.content)


def test_without_theory_and_model_trials_are_shown_all_the_same(noisy):
    data = open_scene("falcon", noisy.processed, None, ["overshoot"])
    page = trial_page(data, [experiment_numbers(data, data.experiments[0], None)], {})
    columns, responses = parts(page)
    assert columns["theory"] is None
    assert len(page.content["criteria"]) == 1
    assert responses


def test_a_cost_has_its_own_reason_once():
    reasons = "settle_1pct: not settled; settle_1pct: not settled; settle_2pct: coarse; too short: 3 rows"
    assert reason_of("settle_1pct", reasons) == "not settled; too short: 3 rows"
    assert reason_of("overshoot", "") == ""


@given(SIGNALS, st.sampled_from([0.0, 1e-3, 2.0]))
def test_a_signal_comes_back_within_half_a_step(values, quantum):
    step = step_size(values, quantum)
    assert step >= max(quantum, np.ptp(values) / LEVELS)
    # rounding to whole steps errs by half a step; the factor leaves room for rounding of the product itself
    assert np.abs(decode(code(values, step), step) - values).max() <= 0.5001 * step + 1e-12


def test_gaps_repeat_the_value_before_and_nothing_is_none():
    assert decode(code(np.array([1.0, np.nan, 3.0]), 1.0), 1.0).tolist() == [1, 1, 3]
    assert code(np.full(4, np.nan), 1.0) is None
    assert step_size(np.full(4, np.nan), 0.0) == step_size(np.zeros(4), 0.0) == 1.0


@pytest.mark.parametrize("rows", [731, 10_007])
def test_thinning_keeps_the_envelope_of_each_column_of_pixels_and_the_onset(rows):
    rng = np.random.default_rng(4)
    log, model = np.cumsum(rng.normal(size=rows)), np.sin(np.arange(rows) / 3)
    kept = visible_rows((log, model), 23, rows)
    assert kept is not None
    assert len(kept) <= 4 * COLUMNS + WHOLE + 2
    assert np.isin(np.arange(23, 23 + WHOLE), kept).all()
    assert (kept[0], kept[-1]) == (0, rows - 1)
    for column in range(COLUMNS):
        inside = np.arange(-(-column * rows // COLUMNS), -(-(column + 1) * rows // COLUMNS))
        shown = kept[(kept >= inside[0]) & (kept <= inside[-1])]
        for signal in (log, model):
            assert (signal[shown].min(), signal[shown].max()) == (signal[inside].min(), signal[inside].max())
    assert visible_rows((np.zeros(COLUMNS + WHOLE),), 5, COLUMNS + WHOLE) is None
