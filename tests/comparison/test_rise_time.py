"""Rise time: a criterion by its record and two functions, in theory, in logs and in everything that shows costs."""

from __future__ import annotations

import json

import numpy as np
import pytest
from columns import Columns
from measured_logs import Logs
from scipy.linalg import expm
from sensor_trials import DELAY, FEWEST, FREE, SENSORS, measured, trials, truth
from simulated import simulate
from typer.testing import CliRunner

from pipeline.device.loop import Loop
from pipeline.loop.normalised_loop import LoopUnits, NormalisedLoop
from pipeline.measured.cost.costs import rise_time
from pipeline.records.criteria import MEASURED, REPORTED
from pipeline.rendering.table_export import export_tables
from pipeline.shell.cli import app
from pipeline.theory.boundary import boundary, is_well_inside
from pipeline.theory.costs import cost_maps, point_costs_by_name
from pipeline.theory.optimum import optimal_point
from pipeline.theory.poles import spectral_radius

NAMES = ("rise_time", "rise_time_discrete")
LOOPS = [
    NormalisedLoop.ideal(0, 0, 0),
    NormalisedLoop.ideal(0.001, 0.02, 1.5),
    NormalisedLoop.ideal(0, 0, 4),
    NormalisedLoop.ideal(0.25, 1.0, 1),
]


def stable_points(loop, count=200):
    border = boundary(loop)
    random = np.random.default_rng(7)
    alpha = random.uniform(0.02, 1, 40 * count) * (border.alpha_max + loop.gamma) - loop.gamma
    beta = random.uniform(border.beta.min(), border.beta_max, 40 * count)
    inside = np.flatnonzero(is_well_inside(loop, alpha, beta))[:count]
    return alpha[inside], beta[inside]


def motion(loop, alpha, beta, parts, rows):
    """Share of the way to the final position at each of so many parts of a sample, by scipy's matrix exponential."""
    block = np.array([[0, 1, 0], [-loop.gamma, -loop.delta, 1], [0, 0, 0]]) / parts
    step, lag = expm(block), round(loop.delay * parts)
    forces = np.full(rows * parts + lag, alpha, dtype=float)  # until the wall answers
    e, v, before, seen = -1.0, 0.0, -1.0, []
    for k in range(rows * parts):
        if k % parts == 0:
            forces[k + lag : k + lag + parts] = -alpha * e - beta * (e - before)
            before = e
        seen.append(1 + e)
        e, v, _ = step @ (e, v, forces[k])
    return np.array(seen)


def first_reached(share, level):
    k = int(np.argmax(share >= level))
    return k - 1 + (level - share[k - 1]) / (share[k] - share[k - 1])


def test_free_flight_before_the_wall_answers():
    """With a delay the first samples are a parabola, alpha t^2/2 of the way: known in closed form."""
    alpha = np.array([0.5, 0.8, 1.7])
    found = point_costs_by_name(NormalisedLoop.ideal(0, 0, 1), alpha, np.full(3, 0.3), NAMES, 100)
    np.testing.assert_allclose(found["rise_time"], (np.sqrt(1.8) - np.sqrt(0.2)) / np.sqrt(alpha), rtol=1e-13)
    expected = [
        first_reached(a * np.arange(3) ** 2 / 2, 0.9) - first_reached(a * np.arange(3) ** 2 / 2, 0.1) for a in alpha
    ]
    np.testing.assert_allclose(found["rise_time_discrete"], expected, rtol=1e-13)


@pytest.mark.parametrize("loop", LOOPS)
def test_theory_is_that_of_the_motion_between_samples(loop):
    alpha, beta = stable_points(loop, 12)
    found = point_costs_by_name(loop, alpha, beta, NAMES, 5000)
    told = 0
    for i in range(len(alpha)):
        share = motion(loop, alpha[i], beta[i], 100, 80)
        for samples, parts, name, digits in (
            (share[::100], 1, "rise_time_discrete", 1e-11),
            (share, 100, "rise_time", 1e-3),
        ):
            if samples.max() >= 0.9:
                expected = (first_reached(samples, 0.9) - first_reached(samples, 0.1)) / parts
                assert found[name][i] == pytest.approx(expected, abs=digits), (alpha[i], beta[i], name)
                told += 1
    assert told >= 12


def test_a_response_that_does_not_rise_in_time_has_none():
    found = point_costs_by_name(NormalisedLoop.ideal(0, 0, 0), np.array([0.001, 0.4]), np.array([0.5, 0.6]), NAMES, 50)
    for name in NAMES:
        assert np.isnan(found[name][0])
        assert np.isfinite(found[name][1])


@pytest.mark.sampled
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("loop", LOOPS)
def test_optimum_is_a_limit_that_no_stable_point_beats(loop, name):
    best = optimal_point(loop, name)
    assert not best.attained
    assert spectral_radius(loop, best.alpha, best.beta)[0] == pytest.approx(1.0, abs=1e-9)
    alpha, beta = stable_points(loop, 2000)
    others = point_costs_by_name(loop, alpha, beta, (name,), 2000)[name]
    assert np.nanmin(others) >= best.cost
    # points inside come as close as they like
    near = point_costs_by_name(loop, *stable_neighbours(loop, best), (name,), 2000)[name]
    assert near.min() == pytest.approx(best.cost, rel=1e-3)


def stable_neighbours(loop, best):
    random = np.random.default_rng(3)
    span = 1e-4 * (best.alpha + loop.gamma), 1e-4 * (abs(best.beta) + loop.delta)
    alpha, beta = (
        at + size * random.uniform(-1, 1, 500) for at, size in zip((best.alpha, best.beta), span, strict=True)
    )
    inside = is_well_inside(loop, alpha, beta)
    assert inside.sum() > 50
    return alpha[inside], beta[inside]


def rise(logs):
    """Rise time of each log with its interval, and the reasons."""
    return Columns(logs.each(rise_time, errors=[logs.errors]))


def ideal():
    return rise(Logs(truth()[0], DELAY))


def test_ideal_logs_have_that_of_the_sampled_theory():
    found = ideal()
    (K, B), units = trials(), LoopUnits(FREE["mass"], 1e-3)
    loop = NormalisedLoop.of(Loop(FREE["mass"], FREE["b"], 1e-3, DELAY))
    theory = point_costs_by_name(loop, K / units.stiffness, B / units.damping, NAMES, 3000)
    np.testing.assert_allclose(found.value, theory["rise_time_discrete"], atol=1e-7)
    # the straight line makes little of a difference
    assert np.nanmax(np.abs(theory["rise_time"] - theory["rise_time_discrete"])) < 0.2
    # an ideal sensor leaves nothing open
    np.testing.assert_allclose(found.low, found.value, atol=1e-6)
    np.testing.assert_allclose(found.high, found.value, atol=1e-6)


@pytest.mark.parametrize(("quantum", "noise"), SENSORS)
def test_intervals_hold_the_truth(quantum, noise):
    true = ideal().value
    found = rise(measured(quantum, noise))
    value, low, high = found.value, found.low, found.high
    told = np.isfinite(high)
    assert told.mean() > 0.5
    assert ((low <= value) & (value <= high))[told].all()
    assert ((low <= true) & (true <= high))[told].mean() >= FEWEST
    # and they say something
    assert np.median((high - low)[told] / value[told]) < 0.5
    for i in np.flatnonzero(np.isnan(value) | np.isnan(high)):
        assert found.reason[i], i


def test_what_a_log_cannot_tell_has_a_reason():
    found = rise(Logs(simulate([4000.0, 9000.0], [70.0, 110.0], **FREE, quantum=2e-4), DELAY))
    assert "sensor floor" in found.reason[1]
    assert np.isnan(found.value[1])
    found = rise(Logs(simulate([500.0], [170.0], **FREE, rows=60), DELAY))
    assert "not reached by the end of the log" in found.reason[0]
    assert np.isnan(found.value).all()


@pytest.mark.slow
def test_reports_hold_it_where_it_is_asked_for(falcon, one_process, tmp_path):
    assert "rise_time" in MEASURED
    assert "rise_time" not in REPORTED
    outcome = falcon.compare(criteria=["settle_2pct", "rise_time"], report=tmp_path / "r.html")
    result, page = outcome.result, (tmp_path / "r.html").read_text(encoding="utf-8")
    rows = {row.condition: row for row in result.tables if row.criterion == "rise_time"}
    assert set(rows) == {"theory_discrete", "theory_continuous", "experiment"}
    best = result.experiments[0].optimum["rise_time"]
    assert best.cost_low <= best.cost <= best.cost_high
    assert rows["experiment"].cost == best.cost >= rows["theory_discrete"].cost
    for text in ("rise time, 10 % to 90 % [samples]", "Rise time <i>C</i>", "Cost maps, rise time"):
        assert text in page
    export_tables(result, tmp_path / "tables")
    assert any("rise_time" in path.read_text(encoding="utf-8") for path in (tmp_path / "tables").glob("*.csv"))
    planned = {stage for stage, action, _ in outcome.stages if action != "leave out"}
    assert "1: rise" in planned
    assert not {"1: energy", "1: overshoot"} & planned
    assert "rise_time" in json.dumps(json.loads(result.model_dump_json()))


def test_commands_of_theory_know_it(tmp_path):
    cases = tmp_path / "cases.csv"
    cases.write_text("alpha,beta,gamma,delta,delay\n0.1,0.3,0,0,1\n", encoding="utf-8")
    run = CliRunner().invoke(app, ["theory", "points", str(cases), "--criteria", ",".join(NAMES), "--json"])
    (point,) = json.loads(run.stdout)
    expected = point_costs_by_name(NormalisedLoop.ideal(0, 0, 1), np.array([0.1]), np.array([0.3]), NAMES, 1000)
    assert [point[name] for name in NAMES] == [float(expected[name][0]) for name in NAMES]
    assert "settle_2pct" not in point
    run = CliRunner().invoke(app, ["theory", "optimum", "--criterion", "rise_time", "--delay", "1", "--json"])
    assert json.loads(run.stdout)["cost"] == optimal_point(NormalisedLoop.ideal(0, 0, 1), "rise_time").cost
    out = tmp_path / "m.parquet"
    options = ["--delay", "1", "--size", "9", "--criteria", "rise_time,rise_time_discrete", "--out", str(out), "--json"]
    run = CliRunner().invoke(app, ["theory", "map", *options])
    assert run.exit_code == 0, run.output
    assert out.is_file()


def test_drawn_maps_are_those_of_the_points():
    loop, alpha, beta = NormalisedLoop.ideal(0, 0, 2), np.linspace(0.005, 0.05, 5), np.linspace(0.05, 0.3, 4)
    found = cost_maps(loop, alpha, beta, ["rise_time"])["rise_time"]
    a, b = (axis.ravel() for axis in np.meshgrid(alpha, beta))
    inside = is_well_inside(loop, a, b)
    expected = point_costs_by_name(loop, a[inside], b[inside], ["rise_time_discrete"], 1000)["rise_time_discrete"]
    assert (np.isfinite(found.ravel()) == inside).all()
    np.testing.assert_array_equal(found.ravel()[inside], expected)
