"""The loop with its parts against a second simulator (`fine_loop`), and friction by what mechanics demands of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fine_loop import Body, run, velocity_filter
from scipy.signal import butter

from pipeline.device.loop import Loop
from pipeline.device.parts import Butterworth, Difference, Friction, LaterStep, Mode, SimulationParts
from pipeline.loop.motion import FrictionalMotion
from pipeline.loop.state_space import Plant
from pipeline.records.trials import Trial
from pipeline.simulation.radius import spectral_radius
from pipeline.simulation.setup import Setup
from pipeline.simulation.simulate import coefficients, external_force, simulate

T = 0.001
ROWS = 60
FRICTION = Friction(coulomb=1.0)
STRIBECK = Friction(coulomb=0.8, stiction=1.2, stribeck_velocity=0.02)
K, B = 2500.0, 12.0


def mode(motor: float, load: float, spring: float, damper: float, **more: object) -> Mode:
    """Mode of two masses on a spring with a damper."""
    reduced = motor * load / (motor + load)
    turn = np.sqrt(spring / reduced)
    return Mode(frequency_hz=turn / (2 * np.pi), damping_ratio=damper / (2 * turn * reduced), mass=load, **more)


def body_of(loop: Loop) -> Body:
    friction, joint = loop.friction, loop.mode
    load, turn = (joint.mass, 2 * np.pi * joint.frequency_hz) if joint else (0.0, 0.0)
    reduced = (loop.mass - load) * load / loop.mass
    damper = 2 * joint.damping_ratio * turn * reduced if joint else 0.0
    return Body(
        *(loop.mass - load, loop.damping - loop.load_damping, loop.stiffness, load, reduced * turn**2, damper),
        lag=loop.actuator_lag_s,
        coulomb=friction.coulomb if friction else 0.0,
        stiction=(friction.stiction or friction.coulomb) if friction else 0.0,
        stribeck=friction.stribeck_velocity if friction and friction.stiction else np.inf,
        sensor_at_load=joint is not None and joint.sensor == "load",
        load_damping=loop.load_damping,
    )


BASE = Setup(Loop(0.5, 4.0, T, 2.0), step=8.0, rows=ROWS, edge_row=3)
JOINT = (0.4, 0.1, 3000.0, 0.8)
LOOPS = {
    "lag": {"actuator_lag_s": 0.003},
    "short lag": {"actuator_lag_s": 2e-5},
    "mode, motor": {"mode": mode(*JOINT)},
    "mode, damped load": {"damping": 5.5, "mode": mode(*JOINT, load_damping=1.5)},
    "mode, load": {"mode": mode(*JOINT, sensor="load")},
    "spring and lag": {"stiffness": 300.0, "actuator_lag_s": 0.002},
    "coulomb": {"friction": FRICTION},
    "stribeck": {"friction": STRIBECK},
    "stribeck and lag": {"actuator_lag_s": 0.002, "friction": STRIBECK},
    "all": {
        "stiffness": 300.0,
        "mode": mode(*JOINT, sensor="load"),
        "actuator_lag_s": 0.002,
        "friction": STRIBECK,
    },
}


@pytest.mark.parametrize("name", sorted(LOOPS))
def test_a_device_moves_as_the_second_simulator_says(name: str) -> None:
    setup = BASE.with_loop(**LOOPS[name], delay_samples=1.5)
    (found,) = simulate(setup, np.array([K]), np.array([B]))
    b, a = velocity_filter(None, T)
    x, u = run(body_of(setup.loop), K=K, B=B, T=T, external=external_force(setup), delay=(3, 2), b=b, a=a)
    # 1e-12 of the second simulator, for each of 60 rows with a gain of K T^2/m below 1
    assert np.abs(found.displacement - x).max() < 1e-9 * np.abs(x).max()
    assert np.abs(found.command - u).max() < 1e-8 * np.abs(u).max()
    assert np.abs(x).max() > 1e-4


@pytest.mark.parametrize("seed", range(3))
def test_random_combinations_move_as_the_second_simulator_says(seed: int) -> None:
    random = np.random.default_rng(seed)
    motor, damping, stiffness = random.uniform(0.2, 1), random.uniform(0, 8), random.choice([0.0, 400.0])
    load, *joint = random.uniform(0.03, 0.2), random.uniform(500, 9000), random.uniform(0, 2)
    lag = random.choice([0.0, 0.0015])
    friction = Friction(coulomb=random.uniform(0.1, 1), stiction=1.1, stribeck_velocity=random.uniform(0.005, 0.05))
    sensor, load_damping = ("motor", "load")[random.integers(2)], random.uniform(0, 2)
    order, cutoff = int(random.integers(1, 5)), random.uniform(30, 200)
    hidden = SimulationParts(clock_error=0.02, gain_error=-0.1, one_sided_wall=bool(random.integers(2)))
    low_pass = Butterworth(kind="butterworth", order=order, cutoff_hz=cutoff)
    loop = Loop(
        *(motor + load, damping + load_damping, T, 1.25, stiffness),
        mode=mode(motor, load, *joint, sensor=sensor, load_damping=load_damping),
        actuator_lag_s=lag,
        friction=friction,
        velocity=low_pass,
        force_limit=9.0,
        force_gain=1.2,
    )
    setup = replace(BASE, loop=loop, hidden=hidden)
    stiffness, damping = random.uniform(500, 4000), random.uniform(0, 30)
    (found,) = simulate(setup, np.array([stiffness]), np.array([damping]))
    b, a = velocity_filter("butterworth", T, order, cutoff)
    timing = {"T": T, "external": external_force(setup), "delay": (5, 4), "b": b, "a": a, "true_period": T * 1.02}
    force = {"gain": 1.2 * 0.9, "limit": 9.0, "one_sided": hidden.one_sided_wall}
    x, u = run(body_of(loop), K=stiffness, B=damping, **timing, **force)
    assert np.abs(found.displacement - x).max() < 1e-8 * np.abs(x).max()
    assert np.abs(found.command - u).max() < 1e-7 * np.abs(u).max()


@pytest.mark.parametrize("order", [1, 2, 3, 4])
@pytest.mark.parametrize("cutoff", [5.0, 30.0, 480.0])
def test_butterworth_is_that_of_scipy(order: int, cutoff: float) -> None:
    b, a = coefficients(Butterworth(kind="butterworth", order=order, cutoff_hz=cutoff), T)
    wanted = butter(order, cutoff, fs=1 / T)
    assert b == pytest.approx(wanted[0], rel=1e-9)
    assert a == pytest.approx(wanted[1], rel=1e-9)


def test_difference_over_samples_is_the_mean_of_single_ones() -> None:
    setup = BASE.with_loop(velocity=Difference(kind="difference", samples=5))
    (found,) = simulate(setup, np.array([K]), np.array([B]))
    speed = np.diff(found.position, prepend=found.position[0]) / T
    mean = np.convolve(speed, np.ones(5) / 5)[:ROWS]
    assert found.command == pytest.approx(external_force(setup) - K * found.displacement - B * mean, abs=1e-11)


def test_a_sliding_mass_stops_at_the_known_distance_and_stays() -> None:
    mass, coulomb, speed = 0.5, 1.0, 0.03
    motion = FrictionalMotion(Plant(mass, 0.0, 0.0), FRICTION)
    state = np.array([[0.0, 0.0], [speed, -speed]])
    for _ in range(20):
        state = motion.advance(state, np.zeros(2), 0.0, 0.001)
    way = mass * speed**2 / (2 * coulomb)
    assert state[0] == pytest.approx([way, -way], rel=1e-13)
    assert (state[1] == 0).all()


def test_a_resting_device_moves_at_stiction_and_not_before() -> None:
    motion = FrictionalMotion(Plant(0.5, 0.0, 0.0), STRIBECK)
    state = motion.advance(motion.rest(np.zeros(3)), np.array([1.1999999, -1.2000001, 1.2]), 0.0, 0.01)
    assert state[:, 0].tolist() == state[:, 2].tolist() == [0.0, 0.0]
    assert state[1, 1] < 0


def test_energy_is_never_created() -> None:
    motion = FrictionalMotion(Plant(0.5, 0.0, 300.0, load_mass=0.1, spring=3000.0, spring_damping=0.8), STRIBECK)
    random = np.random.default_rng(1)
    state = random.standard_normal((4, 200)) * np.array([[0.02], [0.3], [0.02], [0.3]])

    def energy(s: np.ndarray) -> np.ndarray:
        across = s[0] - s[2]
        return 0.5 * (0.4 * s[1] ** 2 + 0.1 * s[3] ** 2 + 300 * s[0] ** 2 + 3000 * across**2)

    before = energy(state)
    for _ in range(3000):
        state = motion.advance(state, np.zeros(200), 0.0, 0.001)
        after = energy(state)
        assert (after <= before * (1 + 1e-12) + 1e-15).all()
        before = after
    assert (state[1] == 0).all()
    assert (np.abs(300 * state[0]) <= 1.2 + 1e-9).all()


def test_a_trial_with_friction_does_not_depend_on_the_others() -> None:
    low_pass = Butterworth(kind="butterworth", order=3, cutoff_hz=60)
    setup = BASE.with_loop(**LOOPS["all"], delay_samples=1.5, velocity=low_pass)
    stiffness, damping = np.linspace(300, 4000, 13), np.linspace(0, 30, 13)
    together = simulate(setup, stiffness, damping)
    for some in ([4], [4, 7], [0, 4, 12]):
        alone = simulate(setup, stiffness[some], damping[some])
        assert np.array_equal(alone[some.index(4)].position, together[4].position)


@pytest.mark.parametrize("name", ["lag", "mode, load", "spring and lag"])
def test_spectral_radius_is_the_growth_of_the_simulated_response(name: str) -> None:
    low_pass = Butterworth(kind="butterworth", order=2, cutoff_hz=80)
    setup = replace(BASE, rows=1500).with_loop(**LOOPS[name], velocity=low_pass, delay_samples=2.5)
    rho = spectral_radius(setup, np.array([20_000.0]), np.array([10.0]))[0]
    rows = min(1500, int(np.log(1e12) / np.log(rho)))
    x = simulate(replace(setup, rows=rows), np.array([20_000.0]), np.array([10.0]))[0].displacement[-60:]
    recurrence = np.linalg.lstsq(np.stack((x[1:-1], x[:-2]), axis=1) / x[-1], x[2:] / x[-1])[0]
    assert np.sqrt(-recurrence[1]) == pytest.approx(rho, rel=1e-6)
    assert rho > 1.003


def friction_cycle(stiffness: float) -> float:
    """Largest distance from rest in the last fifth of a long trial that starts with a kick."""
    setup = replace(BASE, rows=4000).with_loop(mass=0.58, friction=FRICTION, delay_samples=4.0)
    x = simulate(setup, np.array([stiffness]), np.array([20.0]))[0].displacement[-800:]
    return float(np.abs(x - 8 / stiffness).max())


def test_friction_holds_a_wall_that_linear_theory_calls_unstable_up_to_the_describing_function() -> None:
    # equivalent damping 4 c/(pi w A) with A = F_0/K: the limit at B = 20, d = 4 rises from about 4.6 to 7.5 kN/m
    setup = BASE.with_loop(mass=0.58, delay_samples=4.0)
    assert spectral_radius(setup, np.array([6000.0]), np.array([20.0]))[0] > 1
    assert friction_cycle(6000.0) < 1.0 / 6000
    assert friction_cycle(9500.0) > 8 / 9500


def one(hidden: SimulationParts, **change: object) -> Trial:
    return simulate(replace(BASE, hidden=hidden).with_loop(**change), np.array([K]), np.array([B]), seed=3)[0]


def test_lost_rows_are_missing_and_show_in_the_time_stamps_unless_hidden() -> None:
    whole = one(SimulationParts())
    lost, hidden = (one(SimulationParts(lost_rows=0.2, lost_rows_hidden=h)) for h in (False, True))
    kept = np.rint(lost.time / T).astype(int)
    assert 30 < len(kept) < 58
    assert kept[0] == 0
    assert np.array_equal(lost.position, whole.position[kept])
    assert np.array_equal(lost.command, whole.command[kept])
    assert np.array_equal(hidden.position, lost.position)
    assert np.array_equal(hidden.time, T * np.arange(len(kept)))


def residual(trial: Trial, setup: Setup = BASE) -> np.ndarray:
    """What the logged command lacks of the wall law on the logged positions."""
    speed = np.diff(trial.position, prepend=trial.position[0]) / T
    return trial.command + K * trial.displacement + B * speed - external_force(setup)


def test_held_samples_reach_the_controller_and_repeated_rows_the_log_alone() -> None:
    held, repeated = one(SimulationParts(held_samples=0.2)), one(SimulationParts(repeated_rows=0.2))
    for trial in (held, repeated):
        assert 4 < (np.diff(trial.position[10:]) == 0).sum() < 20
    assert np.abs(residual(held)).max() < 1e-11
    assert np.abs(residual(repeated)).max() > 0.1
    assert np.array_equal(repeated.command, one(SimulationParts()).command)


def test_a_constant_force_is_held_by_the_wall_and_shows_as_a_constant() -> None:
    trial = one(SimulationParts(constant_force=0.7), force_gain=1.25)
    assert np.abs(trial.displacement[:5]).max() < 1e-15
    assert residual(trial) == pytest.approx(-0.7 / 1.25, abs=1e-11)


def test_a_wrong_clock_stretches_the_motion_and_not_the_stamps() -> None:
    slow, true = one(SimulationParts(clock_error=0.1)), one(SimulationParts())
    assert np.array_equal(slow.time, true.time)
    # the first motion after the step: a mass under a constant force, with the square of the true period
    assert slow.displacement[6] / true.displacement[6] == pytest.approx(1.21, rel=1e-3)


def test_ramp_and_later_steps_shape_the_external_force() -> None:
    hidden = SimulationParts(ramp_samples=4, later_steps=(LaterStep(time_s=0.02, size=-3.0),))
    force = external_force(replace(BASE, hidden=hidden))
    assert force[[2, 3, 4, 5, 6, 19, 20, 59]].tolist() == [0.0, 2.0, 4.0, 6.0, 8.0, 8.0, 5.0, 5.0]


def test_a_one_sided_wall_never_acts_outside() -> None:
    setup = replace(BASE, hidden=SimulationParts(one_sided_wall=True), rows=400)
    (trial,) = simulate(setup, np.array([30_000.0]), np.array([0.0]))
    outside = trial.displacement < 0
    assert outside.any()
    assert (trial.command[outside] == 8.0).all()
