"""The simulated loop against plain loops with the matrix exponential; its sensor, delay, limits singly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from pipeline.base.errors import ParameterError
from pipeline.device.parts import SimulationParts
from pipeline.device_data.devices import load_device
from pipeline.records.trials import Floats, Trial
from pipeline.simulation.radius import spectral_radius
from pipeline.simulation.setup import Setup, idealise, setup_of
from pipeline.simulation.simulate import applied_delay_moments, applied_delays, delays_of, simulate

T = 0.001
FALCON = setup_of(load_device("falcon"), load_device("falcon").experiments[0])
IDEAL = idealise(FALCON)


def fine_loop(setup: Setup, K: float, B: float, p: int, q: int) -> tuple[Floats, Floats]:
    """Displacement and command of the ideal loop with d = p/q: q matrix exponential steps per sample."""
    plant = setup.loop
    gamma, delta = plant.stiffness / plant.mass, plant.damping / plant.mass
    step = expm(np.array([[0, 1, 0], [-gamma, -delta, 1 / plant.mass], [0, 0, 0]]) * T / q)
    state = np.zeros(3)
    sent: list[float] = []
    position: list[float] = []
    command: list[float] = []
    for fine in range(setup.rows * q):
        if fine % q == 0:
            position.append(state[0])
            before = position[-2] if len(position) > 1 else 0.0
            external = setup.step if len(position) > setup.edge_row else 0.0
            command.append(external - K * state[0] - B * (state[0] - before) / T)
        sent.append(command[-1])
        state[2] = sent[fine - p] if fine >= p else 0.0
        state = step @ state
    return np.array(position), np.array(command)


@pytest.mark.parametrize(("k", "b"), [(0.0, 4.0), (0.0, 0.0), (300.0, 2.0)])
@pytest.mark.parametrize(("p", "q"), [(0, 1), (1, 1), (4, 1), (9, 2), (1, 4), (7, 3)])
def test_ideal_loop_equals_an_independent_loop(p: int, q: int, k: float, b: float) -> None:
    setup = IDEAL.with_loop(mass=0.58, damping=b, stiffness=k, delay_samples=p / q)
    K, B = np.array([400.0, 4400.0, 200.0]), np.array([4.0, 72.0, -1.0])
    for i, trial in enumerate(simulate(setup, K, B)):
        position, command = fine_loop(setup, K[i], B[i], p, q)
        rows = trial.rows
        assert rows > 100
        # positions are read at 0.12 m: rounding of 1e-17 m, 1e-14 of a response, times the gain of the loop
        assert np.abs(trial.displacement - position[:rows]).max() <= 1e-12 * np.abs(position).max()
        assert np.abs(trial.command - command[:rows]).max() <= 1e-12 * np.abs(command).max() * 20


def test_spectral_radius_at_zero_stiffness_leaves_out_the_integrator() -> None:
    rho = spectral_radius(IDEAL.with_loop(mass=0.58, damping=4.0), np.zeros(3), np.array([0.0, -3.9, -4.1]))
    assert rho[0] == pytest.approx(np.exp(-4.0 / 0.58 * T), rel=1e-9)  # only the device's own damping
    assert rho[1] < 1 < rho[2]


def test_trial_starts_at_rest_at_centre_minus_step_over_stiffness() -> None:
    trials = simulate(IDEAL, np.array([400.0, 4000.0, 0.0]), np.array([20.0, 60.0, 0.0]))
    quiet = IDEAL.edge_row + 5  # the plant feels the step 4 samples later and shows it at the sample after
    for trial, start in zip(trials, (0.12 - 8 / 400, 0.12 - 8 / 4000, 0.12), strict=True):
        assert (trial.position[:quiet] == start).all()
        assert trial.position[quiet] > start
        assert (trial.command[: IDEAL.edge_row] == 0).all()
        assert trial.command[IDEAL.edge_row] == 8
    assert trials[1].position[-1] == pytest.approx(0.12, rel=1e-4)


def test_without_stiffness_the_travel_is_reached_after_85_ms() -> None:
    setup = IDEAL.with_loop(mass=0.58, damping=0.0)
    (trial,) = simulate(setup, np.zeros(1), np.zeros(1))
    arrival = np.sqrt(2 * 0.05 * 0.58 / 8)  # 85.1 ms
    assert trial.rows - 1 == IDEAL.edge_row + 4 + np.ceil(arrival / T)
    assert trial.displacement[-1] > 0.05 >= trial.displacement[-2]


def test_a_wall_of_negative_stiffness_takes_from_a_spring() -> None:
    """An arm of 1,000 N/m with a wall of -600 N/m rests where 400 N/m hold the step."""
    setup = replace(IDEAL, rows=3000).with_loop(mass=0.58, damping=20.0, stiffness=1000.0)
    (trial,) = simulate(setup, np.array([-600.0]), np.array([20.0]))
    assert trial.displacement[-1] == pytest.approx(8 / 400, rel=1e-3)


def test_a_trial_ends_with_the_first_sample_outside_its_travel_and_the_others_go_on() -> None:
    stays, leaves = simulate(IDEAL, np.array([4000.0, 30_000.0]), np.array([60.0, 0.0]))
    assert stays.rows == IDEAL.rows > leaves.rows
    distance = np.abs(leaves.position - 0.12)
    assert distance[-1] > 0.05
    assert (distance[:-1] <= 0.05).all()
    (alone,) = simulate(IDEAL, np.array([30_000.0]), np.zeros(1))
    assert alone.rows == leaves.rows


def test_a_start_outside_the_travel_does_not_end_the_trial_at_once() -> None:
    (trial,) = simulate(FALCON, np.array([40.0]), np.array([30.0]))  # starts 0.2 m from the centre, travel 0.05 m
    assert trial.rows == FALCON.rows


@given(st.lists(st.integers(0, 6), min_size=1, max_size=40))
@settings(max_examples=180, deadline=None)
def test_newest_arrived_command_holds(delays: list[int]) -> None:
    found = applied_delays(np.array(delays))
    for row in range(len(delays)):
        arrived = [sent for sent in range(row + 1) if sent + delays[sent] <= row]
        assert found[row] == max(arrived, default=-1)
    assert (np.diff(found) >= 0).all()  # no overtaking


@pytest.mark.parametrize("delays", [(4,), (2, 3), (3, 5), (3, 4, 5), (0, 1, 2, 7)])
def test_moments_of_the_age_in_force_are_those_of_long_draws(delays) -> None:
    drawn = np.random.default_rng(1).choice(delays, 100_000).astype(np.int64)
    age = (np.arange(len(drawn)) - applied_delays(drawn))[100:]
    assert applied_delay_moments(delays) == pytest.approx((age.mean(), age.std()), abs=0.02)


@pytest.mark.parametrize("age", [0.0, 0.3, 1.5, 3.92, 7.25, 80.4])
@pytest.mark.parametrize("jitter", [0.05, 0.3, 0.74, 1.2])
def test_whole_delays_stand_for_any_mean_and_deviation_of_the_age(age, jitter) -> None:
    delays = delays_of(age, jitter)
    mean, deviation = applied_delay_moments(delays) if delays else (age, 0.0)
    assert mean == pytest.approx(age, abs=0.06)
    assert deviation == pytest.approx(jitter, abs=0.12 if age > 1.2 * jitter and jitter > 0.5 else jitter)


def felt_command(trial: Trial, row: int, mass: float) -> float:
    """Command that an undamped plant felt in the interval after a row, from three positions."""
    x = trial.position
    state = np.array([0.0, 0.0])
    for k in range(row):
        force = mass * (x[k + 1] - x[0] - state[0] - T * state[1]) * 2 / T**2
        state = state + np.array([T * state[1] + force / mass * T**2 / 2, force / mass * T])
    return float(mass * (x[row + 1] - x[0] - state[0] - T * state[1]) * 2 / T**2)


def test_jitter_delays_lie_in_the_set_and_commands_do_not_overtake() -> None:
    # an undamped mass: the felt force follows from the positions alone, without the simulator's bookkeeping
    setup = replace(IDEAL, rows=60, edge_row=2, centre=0.0)
    setup = setup.with_loop(mass=0.58, damping=0.0, jitter_samples=(3, 4, 5))
    (trial,) = simulate(setup, np.array([3000.0]), np.array([60.0]), seed=7)
    command = trial.command
    assert len(np.unique(command[10:])) == 50  # every command of the response can be told from the others
    sources = []
    for row in range(16, 40):
        distance = np.abs(command[: row + 1] - felt_command(trial, row, 0.58))
        assert distance.min() < 1e-6
        sources.append(int(distance.argmin()))
    age = np.arange(16, 40) - np.array(sources)
    # what is in force is never older than the longest delay: the command of that age has arrived for certain
    assert set(age.tolist()) == {3, 4, 5}
    assert (np.diff(sources) >= 0).all()


def test_positions_lie_on_the_grid_of_the_quantum() -> None:
    setup = FALCON.with_loop(sensor={"quantum": 1e-5, "noise": FALCON.loop.sensor.noise})
    steps = simulate(setup, np.array([500.0, 4000.0]), np.array([10.0, 60.0])).position / 1e-5
    assert np.abs(steps - np.rint(steps)).max() < 1e-9
    assert len(np.unique(np.rint(steps))) > 100


def test_noise_has_the_given_size_and_is_not_filtered_into_the_plant() -> None:
    # K = B = 0: the plant rests until the step, so that the baseline is noise alone
    setup = replace(IDEAL, rows=4100, edge_row=4099, travel=1.0).with_loop(sensor={"noise": 1e-6})
    x = simulate(setup, np.zeros(1), np.zeros(1)).position
    assert x.std() == pytest.approx(1e-6, rel=0.05)  # standard error of 4,100 values: 1.1 %
    assert x.mean() == pytest.approx(0.12, abs=1e-7)
    assert abs(np.corrcoef(x[1:], x[:-1])[0, 1]) < 0.06  # white: 4 standard errors


def test_force_limit_clips_what_the_plant_feels_and_the_log_only_where_it_says_so() -> None:
    limited = simulate(IDEAL.with_loop(force_limit=3.0), np.array([400.0]), np.array([4.0]))
    assert limited.command.max() == 8.0
    hidden = SimulationParts(clipped_command_logged=True)
    clipped = replace(IDEAL, hidden=hidden).with_loop(force_limit=3.0)
    shown = simulate(clipped, np.array([400.0]), np.array([4.0]))
    assert np.array_equal(shown.command, np.clip(limited.command, -3.0, 3.0))
    assert shown.command.min() == -3.0
    assert np.array_equal(shown.position, limited.position)
    free = simulate(replace(IDEAL, step=3.0), np.zeros(1), np.zeros(1))
    head = IDEAL.edge_row + 12  # as long as the wall takes less than 5 N off the 8 N
    assert np.allclose(limited[0].displacement[:head], free[0].displacement[:head], rtol=0, atol=1e-15)
    assert limited[0].displacement[head - 1] > 1e-4


def test_a_longer_trial_begins_like_the_shorter_one() -> None:
    K, B = np.array([3000.0]), np.array([60.0])
    short, long = simulate(FALCON, K, B), simulate(replace(FALCON, rows=1000), K, B)
    assert np.array_equal(short.position, long.position[:400])


@pytest.mark.parametrize("change", [{"seed": 1}, {"stream": "falcon/2"}, {"repetition": 1}])
def test_seed_experiment_and_repetition_change_the_trial(change: dict[str, object]) -> None:
    K, B = np.array([3000.0]), np.array([60.0])
    one, other = simulate(FALCON, K, B), simulate(FALCON, K, B, **change)  # type: ignore[arg-type]
    assert not np.array_equal(one.position, other.position)


@pytest.mark.parametrize(("K", "B", "seed"), [(-np.inf, 0.0, 0), (np.nan, 0.0, 0), (1.0, np.inf, 0), (1.0, 0.0, -1)])
def test_conditions_out_of_range_are_refused(K: float, B: float, seed: int) -> None:
    with pytest.raises(ParameterError):
        simulate(IDEAL, np.array([K]), np.array([B]), seed=seed)


@pytest.mark.parametrize("change", [{"delay_samples": -1.0}, {"jitter_samples": (3, -1)}, {"sensor": {"noise": -1e-6}}])
def test_loops_out_of_range_are_refused(change: dict[str, object]) -> None:
    with pytest.raises(ParameterError):
        IDEAL.with_loop(**change)


def test_a_step_outside_the_log_is_refused() -> None:
    with pytest.raises(ParameterError):
        replace(IDEAL, edge_row=400)


def test_a_stated_constant_force_acts_like_a_hidden_one() -> None:
    K, B = np.array([3000.0]), np.array([60.0])
    stated = simulate(IDEAL.with_loop(constant_force=0.7), K, B)
    hidden = simulate(replace(IDEAL, hidden=SimulationParts(constant_force=0.7)), K, B)
    assert np.array_equal(stated.command, hidden.command)
    assert not np.array_equal(stated.command, simulate(IDEAL, K, B).command)
    assert idealise(IDEAL.with_loop(constant_force=0.7)) == IDEAL


def test_no_walls_give_no_trials() -> None:
    assert len(simulate(FALCON, np.empty(0), np.empty(0))) == 0
