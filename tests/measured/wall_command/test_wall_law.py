"""The wall law: rounding where it holds, and the one right cause where a log departs from it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal
from simulated import FALCON, plant, simulate

from pipeline.measured.signal.response import find_response
from pipeline.measured.wall_command.wall_law import wall_law
from pipeline.records.trials import Trial

T = 1e-3


def log(
    K=2000.0, B=30.0, *, mass=0.58, b=4.0, delay=3, step=8.0, rows=500, edge=20, force=None, filtered=None, wall=None,
    limit=np.inf, quantum=0.0, noise=0.0, start=0.1, seed=0,
):  # fmt: skip
    """One log as arrays (time, command as logged, position as read) of a loop stepped sample by sample."""
    A, g = plant(mass, b, T)
    random = np.random.default_rng(seed)
    force = (np.arange(rows) >= edge) * step if force is None else force
    line, state = [0.0] * delay, np.zeros(2)
    x, u, v = np.zeros(rows), np.zeros(rows), np.zeros(rows)
    for k in range(rows):
        reading = start + state[0] + noise * random.standard_normal()
        x[k] = np.rint(reading / quantum) * quantum if quantum else reading
        v[k] = (x[k] - x[max(k - 1, 0)]) / T
        rate = v[k] if filtered is None else filtered(v[: k + 1], x[: k + 1])
        pull = K * (x[k] - x[0]) + B * rate
        u[k] = np.clip(force[k] - (pull if wall is None else wall(pull, x[k] - x[0])), -limit, limit)
        line.append(u[k])
        state = A @ state + g * line.pop(0)
    return np.arange(rows) * T, u, x


def trial_of(entry, K=2000.0, B=30.0, step=8.0):
    return Trial("1", K, B, step, T, *entry)


def found(entry, **conditions):
    trial = trial_of(entry, **conditions)
    return wall_law(trial, find_response(trial))


def only(entry, code, **conditions):
    departures = found(entry, **conditions).departures
    assert [d.code for d in departures] == [code], departures
    return departures[0]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("sensor", [{}, {"quantum": 5e-6}, {"quantum": 2e-4, "noise": 1e-5}, {"noise": 3e-5}])
def test_ideal_logs_leave_rounding(sensor, seed):
    random = np.random.default_rng(seed)
    K, B = random.uniform(0, 9000, 24), random.uniform(0, 120, 24)
    trials = list(simulate(K, B, **FALCON, **sensor, seed=seed))
    responses = [find_response(trial) for trial in trials]
    laws = [wall_law(trial, seen) for trial, seen in zip(trials, responses, strict=True) if seen.has_edge]
    assert len(laws) > 15
    assert max(law.residual for law in laws) < 1e-9
    assert [law.departures for law in laws if law.departures] == []


@pytest.mark.parametrize(("command", "position"), [(4, 7), (3, 6), (6, 9), (2, 12)])
def test_printed_decimals_are_rounding(command, position):
    t, u, x = log(quantum=1e-6)
    law = found((t, np.round(u, command), np.round(x, position)))
    assert law.departures == ()
    assert law.rounding < 0.2


def test_single_precision_is_rounding():
    t, u, x = log()
    assert found((t, u.astype(np.float32).astype(float), x.astype(np.float32).astype(float))).departures == ()


def test_clipped_command():
    d = only(log(K=6000.0, B=15.0, limit=8.5), "saturation", K=6000.0, B=15.0)
    assert "clipped at 8.5 in" in d.evidence


@pytest.mark.parametrize(
    "wall", [lambda f, x: f * (x > 0), lambda f, x: max(f, 0.0), lambda f, x: max(f, 0.0) * (x > 0)]
)
def test_one_sided_wall(wall):
    only(log(K=6000.0, B=5.0, wall=wall), "unilateral_wall", K=6000.0, B=5.0)


@pytest.mark.parametrize("value", [0.7, -0.3])
def test_constant_beside_the_law(value):
    force = (np.arange(500) >= 20) * 8.0 + value
    assert f"a constant {value} in addition" in only(log(force=force), "constant_force").evidence


@pytest.mark.parametrize(("quanta", "codes"), [(2, []), (-2, []), (30, ["constant_force"])])
def test_a_wall_that_rests_two_quanta_beside_the_first_reading_is_followed(quanta, codes):
    force = (np.arange(500) >= 20) * 8.0 - 500.0 * 2e-6 * quanta
    departures = found(log(K=500.0, B=0.0, b=20.0, force=force, quantum=2e-6, noise=1e-6), K=500.0, B=0.0).departures
    assert [d.code for d in departures] == codes


def test_step_of_another_size():
    assert "the step is 7.5, " in only(log(step=7.5), "step_not_a_step").evidence


@pytest.mark.parametrize("rows", [3, 5, 12, 25])
@pytest.mark.parametrize("wall", [{}, {"K": 3200.0, "B": 160.0}])  # a stiff wall, and numbers that are all decimals
def test_ramp(rows, wall):
    force = 8.0 * np.clip((np.arange(500) - 19) / rows, 0, 1)
    entry = log(force=force, quantum=2e-6 if wall else 0.0, **wall)
    assert f"rises over {rows} rows" in only(entry, "step_not_a_step", **wall).evidence


def test_a_slow_ramp_is_an_edge_and_a_command_in_another_unit_is_none():
    wall = {"K": 6400.0, "B": 160.0}
    time, command, position = log(force=8.0 * np.clip((np.arange(500) - 19) / 40, 0, 1), **wall)
    half_way = (39, 40)  # of a ramp of 40 rows
    assert find_response(trial_of((time, command, position), **wall)).edge_row in half_way
    for unit in (1e-3, 1e-2, 0.3):
        assert find_response(trial_of((time, unit * command, position), **wall)).edge_row < 0


def test_staircase():
    force = 8.0 * (np.arange(500) >= 20) - 4.0 * (np.arange(500) >= 200) + 6.0 * (np.arange(500) >= 350)
    d = only(log(force=force), "several_steps")
    assert "row 200 (8 to 4)" in d.evidence


@pytest.mark.parametrize("share", [0.005, 0.02, 0.1])
@pytest.mark.parametrize("shown", [True, False])
def test_missing_rows(share, shown):
    t, u, x = log(B=60.0, K=4000.0)
    keep = np.random.default_rng(3).random(len(t)) > share
    keep[:25] = True
    hidden = np.arange(keep.sum()) * T
    d = only((t[keep] if shown else hidden, u[keep], x[keep]), "missing_rows", B=60.0, K=4000.0)
    assert 0.5 * (~keep).sum() <= d.rows <= 1.1 * (~keep).sum()


def test_repeated_rows():
    t, u, x = log(B=10.0, K=4000.0)
    random = np.random.default_rng(1)
    rows = np.sort(random.choice(np.arange(30, 300), 12, replace=False))
    for k in rows:
        u[k], x[k] = u[k - 1], x[k - 1]
    d = only((t, u, x), "repeated_rows", B=10.0, K=4000.0)
    assert d.rows >= 8


@pytest.mark.parametrize("samples", [2, 4])
@pytest.mark.parametrize("quantum", [5e-6, 2e-5])
@pytest.mark.parametrize("seed", range(3))
def test_a_slow_device_before_a_coarse_sensor_repeats_and_misses_no_rows(samples, quantum, seed):
    def filtered(v, x):
        return (x[-1] - x[max(len(x) - 1 - samples, 0)]) / (samples * T)

    sensor = {"quantum": quantum, "noise": 0.1 * quantum, "seed": seed}
    departures = found(log(K=3000.0, B=80.0, filtered=filtered, **sensor), K=3000.0, B=80.0).departures
    assert [d.code for d in departures] == ["velocity_filter"], departures


@pytest.mark.parametrize("samples", [2, 3, 8, 25])
def test_velocity_as_difference_over_samples(samples):
    def filtered(v, x):
        return (x[-1] - x[max(len(x) - 1 - samples, 0)]) / (samples * T)

    d = only(log(filtered=filtered), "velocity_filter")
    assert d.filter.difference == samples


@pytest.mark.parametrize("order", [1, 2, 3, 4])
@pytest.mark.parametrize("cutoff", [15.0, 40.0, 150.0])
@pytest.mark.parametrize("quantum", [0.0, 1e-5])
def test_butterworth_velocity(order, cutoff, quantum):
    b, a = signal.butter(order, cutoff, fs=1 / T)
    d = only(log(B=20.0, filtered=lambda v, x: signal.lfilter(b, a, v)[-1], quantum=quantum), "velocity_filter", B=20.0)
    # equal where it matters: over all angles
    angles = np.linspace(1e-3, np.pi, 50)
    ours, truth = signal.freqz(d.filter.b, d.filter.a, angles)[1], signal.freqz(b, a, angles)[1]
    assert np.abs(ours - truth).max() < 1e-3


def test_filter_with_a_clipped_command():
    b, a = signal.butter(2, 40.0, fs=1 / T)
    departures = found(
        log(K=6000.0, B=30.0, filtered=lambda v, x: signal.lfilter(b, a, v)[-1], limit=8.5), K=6000.0
    ).departures
    assert [d.code for d in departures] == ["saturation", "velocity_filter"]


def test_other_wall_than_the_header_says():
    d = only(log(), "other_wall", K=1500.0, B=30.0)
    assert "K = 2000" in d.evidence
    assert "B = 0 and" in only(log(B=0.0), "other_wall", K=1500.0, B=0.0).evidence


@pytest.mark.parametrize("filtered", [None, lambda v, x: signal.lfilter(*signal.butter(2, 40.0, fs=1 / T), v)[-1]])
def test_a_power_of_ten_is_called_so_with_and_without_a_filter(filtered):
    t, u, x = log(filtered=filtered)
    d = only((t, u, 1e3 * x), "other_unit")
    assert d.obeyed[0] == pytest.approx(2000e-3, rel=0.2)


def test_another_signal_is_unknown():
    t, u, x = log()
    only((t, u + 0.01 * np.sin(np.arange(500) / 3.0), x), "unknown")


def test_what_does_not_touch_the_law_leaves_it():
    """A device that is not ideal behind the right command: friction, lag and mode are no matter of the wall law."""
    t, _, x = log()
    x2 = x + 1e-4 * np.sin(np.arange(500) / 7.0) * (np.arange(500) > 30)
    u2 = 8.0 * (np.arange(500) >= 20) - 2000.0 * (x2 - x2[0]) - 30.0 * np.diff(x2, prepend=x2[0]) / T
    assert found((t, u2, x2)).departures == ()
