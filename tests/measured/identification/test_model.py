"""The model of an experiment against independent methods: fine integration, dense covariances, known truths."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pipeline.base.errors import ParameterError
from pipeline.loop.motion import FrictionalMotion
from pipeline.loop.state_space import Plant
from pipeline.measured.identification import kernels
from pipeline.measured.identification.identified import identified
from pipeline.measured.identification.likelihood import Device, moments_of
from pipeline.measured.identification.motion import Ages, PlantShape, Transitions
from pipeline.measured.identification.noise import Noise, gains_of
from pipeline.measured.identification.part_table import PARTS
from pipeline.measured.identification.parts import _promise, _takes_away
from pipeline.measured.identification.recordings import LogUnits, Recording, motion_of
from pipeline.measured.identification.scatter import Moments, solve
from pipeline.measured.identification.segments import segments_of
from pipeline.simulation.simulate import applied_delay_moments

T = 1e-3
TURNING = {"mass": 1.1e-4, "damping": 7e-5, "friction.coulomb": 0.034, "delay_samples": 2.3}


def moved(
    rng,
    commands,
    *,
    mass=1.1e-4,
    damping=7e-5,
    friction=0.034,
    stiffness=0.0,
    delay=2.3,
    noise=2e-4,
    quantum=1e-12,
    walls=(0, 0),
):
    """Recordings of devices under commands, shape (rows, n), by twenty small steps a sample; friction may be (n,)."""
    rows, n = commands.shape
    commands = commands.copy()
    parts = 20
    h, late = T / parts, round(delay * parts)
    x, v, seen = np.zeros(n), np.zeros(n), np.zeros((rows, n))
    for row in range(rows):
        seen[row] = np.round((x + noise * rng.standard_normal(n)) / quantum) * quantum
        commands[row] -= walls[0] * (seen[row] - seen[0]) + walls[1] * (seen[row] - seen[max(row - 1, 0)]) / T
        for part in range(parts):
            drive = commands[max((row * parts + part - late) // parts, 0)]
            free = drive - stiffness * x - damping * v
            sticks = (v == 0) & (np.abs(free) <= friction)
            pull = np.where(sticks, 0.0, free - friction * np.where(v == 0, np.sign(free), np.sign(v)))
            after = v + pull / mass * h
            after = np.where((v * after < 0) & (np.abs(free) <= friction), 0.0, after)
            x, v = x + 0.5 * (v + after) * h, after
    time = T * np.arange(rows)
    return [Recording(str(i), time, commands[:, i], seen[:, i], T) for i in range(n)]


def steps(sizes, rows=300, at=20):
    """Commands that step once, shape (rows, n)."""
    return (np.arange(rows)[:, None] >= at) * np.asarray(sizes, dtype=float)[None]


TEN = np.array([0.05, -0.05, 0.06, -0.07, 0.08, -0.09, 0.1, -0.1, 0.12, -0.12])


def holds(found, truth):
    """Names of parameters whose interval does not hold the truth."""
    return [name for name, value in truth.items() if not found[name].low <= value <= found[name].high]


def responses(segments, shape):
    """Positions of a shape from rest at 0 under the commands of one segment."""
    transitions, nothing = Transitions.of(segments, shape), np.zeros(len(segments.time))
    columns, _, _ = kernels.whitened(
        (segments.time, segments.command[None], nothing, np.empty((1, 0))),
        (
            *(segments.first, segments.behind, segments.begin, segments.edge, segments.direction),
            *(np.zeros((1, 3)), np.zeros((1, 1))),
        ),
        transitions.motion,
        transitions.pieces,
        gains_of(segments, transitions, Noise(), segments.command),
        (
            *(np.array([kernels.GAIN]), np.full(3, -1)),
            *(np.array([shape.gamma, shape.lag, shape.delay, 1.0, segments.lead]), np.empty(0)),
        ),
    )
    return columns[:, 0]


@pytest.mark.parametrize("irregular", [False, True])
@pytest.mark.parametrize("lag", [0.0, 1.7])
def test_a_late_command_moves_a_device_as_an_integration_does(irregular, lag):
    rng = np.random.default_rng(4)
    time = np.cumsum(np.where(irregular, rng.uniform(0.6, 1.4, 40), 1.0))
    command = rng.standard_normal(40)
    log = Recording("a", time, command, command, 1.0)
    held = segments_of([log], LogUnits(1.0, 1.0, 1.0, 0.0), 5, False)
    shape = PlantShape(delta=0.03, gamma=0.02, delay=2.4, lag=lag)
    columns = responses(held, shape)
    first = 5 if held.rows[0] < 40 else 0

    def rate(t, z):
        j = max(int(np.searchsorted(time, t - 2.4, side="right")) - 1, 0)
        force = (command[j] - z[2]) / lag if lag else 0.0
        return [z[1], (z[2] if lag else command[j]) - 0.02 * z[0] - 0.03 * z[1], force]

    def moved(state, begin, end):
        for until in (*(t for t in time + 2.4 if begin < t < end), end):
            inside = 0.5 * (begin + until)
            ends = solve_ivp(lambda _, z, at=inside: rate(at, z), (begin, until), state, rtol=1e-10, atol=1e-12).y
            state, begin = ends[:, -1].tolist(), until
        return state

    # the drive has followed the commands before the first reading, of which the first stood for ever
    force = moved([0.0, 0.0, command[0]], time[0] + 2.4, time[first])[2]
    state, expected = [0.0, 0.0, force], [0.0]
    for row in range(first, 39):
        state = moved(state, time[row], time[row + 1])
        expected.append(state[0])
    np.testing.assert_allclose(columns, expected, rtol=1e-7, atol=1e-8)


def test_where_a_log_begins_weighs_nothing():
    """An absolute encoder reads each run from elsewhere, a thousand ways away."""
    rng = np.random.default_rng(3)
    logs = behind_walls(rng, {"mass": 0.6, "damping": 4.0}, {}, 8, quantum=5e-6)
    near, places = identified(logs), rng.uniform(-20, 20, 8)
    far = identified([replace(log, position=log.position + place) for log, place in zip(logs, places, strict=True)])
    for name in ("mass", "damping", "delay_samples"):
        assert far.parameters[name].value == pytest.approx(near.parameters[name].value, rel=1e-3)
    assert far.choice.fit.solved.weight == pytest.approx(near.choice.fit.solved.weight, rel=0.05)


@pytest.mark.slow
def test_a_lag_of_nothing_is_as_likely_as_none():
    rng = np.random.default_rng(4)
    logs = behind_walls(rng, {"mass": 0.6, "damping": 4.0}, {}, 12, quantum=5e-6)
    kept = [np.flatnonzero(rng.uniform(size=len(log.time)) > 0.03) for log in logs]
    logs = [
        replace(log, **{n: getattr(log, n)[k] for n in ("time", "command", "position")})
        for log, k in zip(logs, kept, strict=True)
    ]
    units = LogUnits.of(logs)
    held = segments_of(logs, units, 6, False)
    device = replace(identified(logs).choice.fit.device, effects=None)
    late = replace(device, numbers=device.numbers | {"delay": device.numbers["delay"] - 0.02, "lag": 0.02})
    assert len(held) > 4 * len(logs)
    assert _promise(held, late, PARTS["lag"]) == pytest.approx(_promise(held, device, PARTS["lag"]), abs=0.5)


def test_ages_of_commands_follow_each_other_as_newly_drawn_delays_have_it():
    found, seen = Ages.of(35 / 9, applied_delay_moments((3, 4, 5))[1]), np.zeros((3, 3))
    for drawn in product((3, 4, 5), repeat=7):
        before, now = (min(age for age in (3, 4, 5) if drawn[row - age] <= age) for row in (5, 6))
        seen[before - 3, now - 3] += 1 / 3**7
    chances = seen.sum(axis=1)
    np.testing.assert_allclose(found.chance, chances, atol=1e-4)
    moved = np.empty((3, 3))
    kernels.next_ages(moved, found.ageing, np.eye(3), 0, 3)
    np.testing.assert_allclose(moved.T, seen / chances[:, None] - chances, atol=1e-4)


def test_scatter_between_trials_is_that_of_the_dense_likelihood():
    rng = np.random.default_rng(6)
    trials, rows = 40, 50
    columns = rng.standard_normal((trials, rows, 2))
    own = np.array([1.0, -2.0]) + np.stack([0.4 * rng.standard_normal(trials), np.zeros(trials)], axis=1)
    errors = np.einsum("tni,ti->tn", columns, own) + 0.1 * rng.standard_normal((trials, rows))
    both = np.concatenate([columns, errors[..., None]], axis=2)
    found = solve(Moments(np.linalg.qr(both, mode="r"), np.full(trials, float(rows))), np.array([0, 1]))
    assert np.sqrt(found.noise) == pytest.approx(0.1, rel=0.05)
    assert np.sqrt(found.scatter[0]) == pytest.approx(own[:, 0].std(), rel=0.05)
    assert np.sqrt(found.scatter[1]) < 0.02
    # generalised least squares with the covariances of all trials written out
    total, right = np.zeros((2, 2)), np.zeros(2)
    for x, e, weight in zip(columns, errors, found.weight, strict=True):
        inverse = np.linalg.inv(found.noise / weight * np.eye(rows) + (x * found.scatter) @ x.T)
        total, right = total + x.T @ inverse @ x, right + x.T @ inverse @ e
    np.testing.assert_allclose(found.step, np.linalg.solve(total, right), rtol=2e-3)
    np.testing.assert_allclose(np.linalg.inv(found.total), np.linalg.inv(total), rtol=2e-2, atol=1e-7)


@pytest.mark.sampled
@pytest.mark.parametrize("scatter", [pytest.param(0.0, marks=pytest.mark.slow), 0.05, 0.3])
def test_scatter_of_friction_is_a_slope_and_no_cliff(scatter):
    rng = np.random.default_rng(31)
    friction = 0.034 * (1 + scatter * rng.standard_normal(10))
    found = identified(moved(rng, steps(TEN), friction=friction)).parameters
    half = (found["mass"].high - found["mass"].low) / 2 / TURNING["mass"]
    assert holds(found, TURNING) == []
    assert half <= 0.05 + 3 * scatter
    assert half >= 0.2 * scatter


def excitation(name, rng):
    rows = 2000
    if name == "relay":
        return 0.12 * np.sign(np.sin(2 * np.pi * np.arange(rows) / 400))
    if name == "staircase":
        return np.repeat(rng.uniform(-0.15, 0.15, 10), 200)
    time = T * np.arange(rows)
    return 0.15 * np.sin(2 * np.pi * (time + 2 * time**2))


@pytest.mark.sampled
@pytest.mark.parametrize(
    "name", [pytest.param("relay", marks=pytest.mark.slow), "staircase", pytest.param("sweep", marks=pytest.mark.slow)]
)
def test_one_log_of_any_excitation_is_enough(name):
    rng = np.random.default_rng(7)
    log = moved(rng, excitation(name, rng)[:, None])
    found = identified(log)
    assert found.unidentifiable == set()
    assert found.parameters["mass"].value == pytest.approx(TURNING["mass"], rel=2e-3)
    assert found.parameters["friction.coulomb"].value == pytest.approx(TURNING["friction.coulomb"], rel=0.02)


def test_a_log_may_begin_in_motion():
    rng = np.random.default_rng(8)
    (log,) = moved(rng, excitation("relay", rng)[:, None])
    cut = Recording("late", log.time[137:], log.command[137:], log.position[137:], T)
    found = identified([cut]).parameters
    assert found["mass"].value == pytest.approx(TURNING["mass"], rel=2e-3)


def test_a_device_without_friction_and_with_a_spring():
    rng = np.random.default_rng(9)
    log = moved(rng, excitation("staircase", rng)[:, None], friction=0.0, stiffness=0.02, noise=1e-4)
    found = identified(log)
    assert set(found.parts) <= {"stiffness", "friction"}
    truth = {"mass": 1.1e-4, "stiffness": 0.02}
    assert {name: found.parameters[name].value for name in truth} == pytest.approx(truth, rel=5e-3)


@pytest.mark.parametrize(("friction", "seed"), [(0.002, 5), (0.0, 5), pytest.param(0.0, 6, marks=pytest.mark.slow)])
def test_a_part_is_found_where_the_likelihood_asks_for_it(friction, seed):
    found = identified(moved(np.random.default_rng(seed), steps(TEN), friction=friction, noise=0.03))
    assert (found.parts.get("friction", 0.0) > 0) == (friction > 0)


def test_one_step_tells_the_acceleration_and_no_mass():
    rng = np.random.default_rng(10)
    found = identified(moved(rng, steps([0.1])))
    assert {"mass", "damping", "friction.coulomb"} <= found.unidentifiable
    known = {each.code: each for each in found.combinations}
    assert known["acceleration"].interval.value == pytest.approx((0.1 - 0.034) / 1.1e-4, rel=2e-3)
    assert known["damping_per_mass"].interval.value == pytest.approx(7e-5 / 1.1e-4, rel=0.05)
    assert "two sizes" in known["acceleration"].record


@pytest.mark.parametrize("friction", [0.0, 0.034])
def test_equal_steps_however_many_tell_no_mass_either(friction):
    """Rows before the step have no direction: gain, friction and a constant force make one number, and no interval."""
    logs = moved(np.random.default_rng(5), steps(np.full(12, 0.1)), friction=friction, delay=2.0, quantum=2e-4)
    found = identified(logs)
    assert {"mass", "damping", "friction.coulomb", "constant_force"} <= found.unidentifiable
    known = {each.code: each.interval for each in found.combinations}
    assert known["acceleration"].low <= (0.1 - friction) / 1.1e-4 <= known["acceleration"].high


def test_what_is_asked_for_was_not_recorded_already():
    rng = np.random.default_rng(11)
    found = identified(moved(rng, steps([0.1, 0.06])))
    (known,) = found.combinations
    assert known.code == "friction_less_force"
    assert known.interval.value == pytest.approx(0.034, rel=5e-3)
    assert "two sizes" not in known.record
    assert holds(found.parameters, {"mass": 1.1e-4}) == []


@pytest.mark.slow
def test_a_bumped_trial_weighs_little():
    rng = np.random.default_rng(12)
    logs = moved(rng, steps(TEN))
    x = logs[3].position.copy()
    x[200:] += 0.3 * np.sin(0.3 * np.arange(100))
    found = identified([*logs[:3], Recording("bumped", logs[3].time, logs[3].command, x, T), *logs[4:]]).parameters
    assert found["mass"].value == pytest.approx(TURNING["mass"], rel=0.01)


@pytest.mark.slow
def test_lost_rows_are_left_out():
    rng = np.random.default_rng(13)
    logs = []
    for log in moved(rng, steps(TEN)):
        keep = np.sort(rng.choice(300, 290, replace=False))
        logs.append(Recording(log.name, log.time[keep], log.command[keep], log.position[keep], T))
    found = identified(logs).parameters
    assert {name: found[name].value for name in TURNING} == pytest.approx(TURNING, rel=0.02)


@pytest.mark.slow
def test_free_runs_follow_held_out_logs():
    rng = np.random.default_rng(14)
    found = identified(moved(rng, steps(TEN)))
    assert found.fit_percent > 99


def test_no_motion_and_no_command_are_named():
    time = T * np.arange(100)
    with pytest.raises(ParameterError, match="position does not change"):
        identified([Recording("a", time, np.ones(100), np.zeros(100), T)])
    with pytest.raises(ParameterError, match="command is 0"):
        identified([Recording("a", time, np.zeros(100), time, T)])


@pytest.mark.parametrize("name", ["gain", "force", "delta", "gamma"])
def test_slopes_are_those_of_the_errors_however_long_a_log_and_weak_a_spring(name):
    """Of a free device: a spring of 1e-8 moves it by a thousandth of its way in 800 rows."""
    rng = np.random.default_rng(21)
    log = moved(rng, steps([0.05], rows=800), friction=0.0)
    held = segments_of(log, units := LogUnits.of(log), 6, False)
    true = {"gain": units.command / 1.1e-4 * units.period**2 / units.position, "force": 0.0}
    true |= {"delta": 1e-3, "gamma": 1e-9, "delay": 2.2, "lag": 0.4}

    def squares(by=0.0):
        return moments_of(held, Device(true | {name: true[name] + by})).products.sum(axis=0)

    size = 1e-9 if name == "gamma" else 1e-6
    whole, place = squares(), list(true).index(name)
    change = (squares(size)[-1, -1] - squares(-size)[-1, -1]) / (2 * size)
    # as a part of the largest that errors and slopes of these sizes may have
    largest = 2 * np.sqrt(whole[place, place] * whole[-1, -1])
    assert -2 * whole[place, -1] == pytest.approx(change, abs=1e-3 * largest)


def test_direction_of_motion_is_not_seen_at_rest():
    rng = np.random.default_rng(15)
    (log,) = moved(rng, steps([0.1]))
    seen = motion_of(log)
    assert (seen.direction[:15] == 0).all()
    assert (seen.direction[40:] == 1).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "stiffest", "noise", "quantum"),
    [pytest.param(24, 380, 1e-5, 1e-12, marks=pytest.mark.slow), (31, 500, 0, 1e-4)],
)
def test_friction_behind_stiff_walls_is_taken_for_nothing_else(seed, stiffest, noise, quantum):
    rng = np.random.default_rng(seed)
    damping = rng.uniform(2e-3, 1e-2, 40)
    walls = rng.uniform(60, stiffest, 40) * damping, damping
    friction = 0.034 * (1 + 0.05 * rng.standard_normal(40))
    sensor = {"noise": noise, "quantum": quantum}
    found = identified(moved(rng, steps([0.12] * 40), friction=friction, delay=2.0, walls=walls, **sensor))
    assert set(found.parts) == {"friction"}
    assert found.choice.fit.device.noise.jitter == 0
    assert holds(found.parameters, TURNING | {"delay_samples": 2.0}) == []


@pytest.mark.slow
def test_intervals_hold_the_truth_as_often_as_they_say():
    inside = {name: [] for name in TURNING}
    for seed in range(60):
        rng = np.random.default_rng(500 + seed)
        sizes = rng.uniform(0.05, 0.12, 10) * np.where(np.arange(10) % 2, 1, -1)
        friction = 0.034 * (1 + 0.05 * rng.standard_normal(10))
        missed = holds(identified(moved(rng, steps(sizes), friction=friction)).parameters, TURNING)
        for name, each in inside.items():
            each.append(name not in missed)
    # 60 courses of 95 %: below 52 of them once in 300
    assert {name: sum(each) for name, each in inside.items() if sum(each) < 52} == {}


def behind_walls(rng, device, parts, n=16, rows=250, walls=None, quantum=0.0):
    """Recordings of simulated wall trials of a device with other parts, by the simulator's own exact motion."""
    stiffness, damping = (rng.uniform(200, 1500, n), rng.uniform(5, 25, n)) if walls is None else walls
    motion = FrictionalMotion(Plant(**device, stiffness=0.0, **parts))
    late = int(np.floor(2.4))
    state, delayed = motion.rest(np.zeros(n)), np.zeros((late + 2, n))
    seen, sent = np.zeros((rows, n)), np.zeros((rows, n))
    for row in range(rows):
        seen[row] = state[motion.sensed] + 2e-6 * rng.standard_normal(n)
        seen[row] = quantum * np.rint(seen[row] / quantum) if quantum else seen[row]
        sent[row] = 4.0 * (row >= 20) - stiffness * (seen[row] - seen[0])
        sent[row] -= damping * (seen[row] - seen[max(row - 1, 0)]) / T
        delayed = np.vstack([sent[row], delayed[:-1]])
        state = motion.advance(state, delayed[late + 1], 0.0, 0.4 * T)
        state = motion.advance(state, delayed[late], 0.0, 0.6 * T)
    return [Recording(str(i), T * np.arange(rows), sent[:, i], seen[:, i], T) for i in range(n)]


@pytest.mark.slow
def test_a_lag_is_found_behind_walls():
    logs = behind_walls(np.random.default_rng(16), {"mass": 0.6, "damping": 4.0}, {"lag": 0.003})
    found = identified(logs)
    assert set(found.parts) == {"lag"}
    assert holds(found.parameters, {"mass": 0.6, "damping": 4.0, "actuator_lag_s": 0.003, "delay_samples": 2.4}) == []


def test_a_lag_is_found_where_each_trial_has_another_force():
    """Another force in each trial makes far more likely what has scatter between trials; both sides must have it."""
    rng = np.random.default_rng(16)
    logs = behind_walls(rng, {"mass": 0.6, "damping": 4.0}, {"lag": 0.003})
    forces = 0.02 * rng.standard_normal(16)
    found = identified([replace(log, command=log.command + f) for log, f in zip(logs, forces, strict=True)])
    assert set(found.parts) == {"lag"}
    truth = {"mass": 0.6, "damping": 4.0, "actuator_lag_s": 0.003, "delay_samples": 2.4}
    assert {name: found.parameters[name].value for name in truth} == pytest.approx(truth, rel=0.01)
    assert found.scatter["constant_force"] == pytest.approx(forces.std(), rel=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 3])
def test_a_lag_is_found_in_long_free_motion_with_a_coarse_sensor(seed):
    rng, rows, quantum = np.random.default_rng(seed), 800, 2 * np.pi / 4096
    sent = steps(np.outer([0.02, 0.04, 0.06, 0.1, 0.15, 0.08], [1, -1]).ravel(), rows)
    motion = FrictionalMotion(Plant(mass=3e-4, damping=1e-3, stiffness=0.0, lag=3e-3))
    state, seen = motion.rest(np.zeros(12)), np.zeros((rows, 12))
    for row in range(rows):
        reading = state[motion.sensed] + 1e-4 * rng.standard_normal(12)
        seen[row] = quantum * np.rint(reading / quantum)
        state = motion.advance(state, sent[max(row - 2, 0)], 0.0, T)
    found = identified([Recording(str(i), T * np.arange(rows), sent[:, i], seen[:, i], T) for i in range(12)])
    assert set(found.parts) == {"lag"}
    assert holds(found.parameters, {"mass": 3e-4, "damping": 1e-3, "actuator_lag_s": 3e-3, "delay_samples": 2.0}) == []


@pytest.mark.parametrize("quantum", [3e-6, 2.5e-5])
def test_a_lag_of_half_a_sample_is_no_mode_and_may_be_in_the_delay(quantum):
    rng, walls = np.random.default_rng(4), (np.linspace(500, 2500, 24), np.linspace(10, 30, 24))
    logs = behind_walls(rng, {"mass": 0.6, "damping": 4.0}, {"lag": 5e-4}, 24, walls=walls, quantum=quantum)
    found = identified(logs)
    assert found.parts == {}
    assert found.choice.bounds["actuator_lag_s"] > 5e-4
    assert holds(found.parameters, {"delay_samples": 2.4}) == []
    assert [each.code for each in found.combinations] == ["delay_and_lag"]


@pytest.mark.parametrize(
    ("before", "behind", "takes"),
    [
        (Noise(), Noise(1e-4), False),
        (Noise(1e-3), Noise(1e-4), True),
        (Noise(1e-3), Noise(8e-4), False),
        (Noise(0.0, 80.0, 0.9), Noise(1e-4), True),
        (Noise(0.0, 80.0, 0.9), Noise(0.0, 80.0, 0.8), False),
    ],
)
def test_a_part_takes_most_of_a_random_force_or_of_a_jitter_away(before, behind, takes):
    """A lag in a position loop left a small force where a jitter of a longer delay left none."""
    fits = (SimpleNamespace(device=Device({}, noise), solved=SimpleNamespace(noise=1.0)) for noise in (before, behind))
    assert _takes_away(*fits) == takes


@pytest.mark.slow
def test_a_mode_is_found_behind_walls():
    far, near = 0.15, 0.45
    spring = (2 * np.pi * 40) ** 2 * far * near / (far + near)
    damper = 2 * 0.03 * 2 * np.pi * 40 * far * near / (far + near)
    load = {"load_mass": far, "spring": spring, "spring_damping": damper}
    found = identified(behind_walls(np.random.default_rng(17), {"mass": near + far, "damping": 4.0}, load))
    assert {name for name, gain in found.parts.items() if gain > 0} == {"mode"}
    truth = {"mass": 0.6, "mode.frequency_hz": 40.0, "mode.mass": far}
    assert {name: found.parameters[name].value for name in truth} == pytest.approx(truth, rel=0.02)
    # the damping of the load is unknown, so that of the spring is, too
    assert holds(found.parameters, truth | {"mode.damping_ratio": 0.03, "mode.load_damping": 0.0}) == []


@pytest.mark.slow
@pytest.mark.parametrize("at_load", [False, True])
def test_damping_of_a_load_is_told_where_the_motor_is_read(at_load):
    far, near, frequency = 0.15, 0.45, 2 * np.pi * 25
    reduced = far * near / (far + near)
    load = {"load_mass": far, "spring": frequency**2 * reduced, "spring_damping": 2 * 0.03 * frequency * reduced}
    load |= {"load_damping": 3.0, "sensor_at_load": at_load}
    rng = np.random.default_rng(18)
    walls = rng.uniform(30, 150, 16), rng.uniform(1, 5, 16)
    found = identified(behind_walls(rng, {"mass": near + far, "damping": 5.0}, load, walls=walls))
    truth = {"mass": 0.6, "damping": 5.0, "mode.frequency_hz": 25.0}
    parts = {name for name, gain in found.parts.items() if gain > 0}
    assert parts == ({"mode at the load"} if at_load else {"mode", "load damping"})
    assert {name: found.parameters[name].value for name in truth} == pytest.approx(truth, rel=0.01)
    assert (
        holds(
            found.parameters, {"delay_samples": 2.4, "mode.mass": far} | ({} if at_load else {"mode.load_damping": 3.0})
        )
        == []
    )
    if not at_load:
        assert found.parameters["mode.damping_ratio"].value == pytest.approx(0.03, rel=0.03)
    delay = found.parameters["delay_samples"]
    assert delay.high - delay.low < (0.5 if at_load else 0.05)


@pytest.mark.slow
def test_a_mode_near_the_nyquist_frequency_is_no_lag():
    far, near, frequency = 0.06, 0.13, 2 * np.pi * 300
    reduced = far * near / (far + near)
    load = {"load_mass": far, "spring": frequency**2 * reduced, "spring_damping": 2 * 0.02 * frequency * reduced}
    rng = np.random.default_rng(2)
    walls = rng.uniform(500, 3800, 24), rng.uniform(13, 63, 24)
    found = identified(behind_walls(rng, {"mass": near + far, "damping": 1.3}, load, n=24, walls=walls))
    assert set(found.parts) == {"mode"}
    assert holds(found.parameters, {"mass": 0.19, "delay_samples": 2.4, "mode.mass": far}) == []
    assert found.parameters["mode.frequency_hz"].value == pytest.approx(300.0, rel=0.01)


@pytest.mark.slow
def test_friction_is_found_beside_a_mode_that_hid_it():
    """A flexible link: a random force stood for the mode, friction and lag for what was left of it."""
    rng, n, rows, parts, period = np.random.default_rng(20), 4, 500, 60, 2e-3
    near, far, friction, frequency = 0.03, 0.05, 0.08, 2 * np.pi * 9
    spring, h = frequency**2 * near * far / (near + far), period / parts
    damper = 2 * 0.03 * spring / frequency
    sizes = np.linspace(0.6, 1.35, n) * rng.choice([-1.0, 1.0], (rows // 50, n))
    commands, seen = np.repeat(sizes, 50, axis=0), np.zeros((rows, n))
    x, v, y, w = np.zeros((4, n))
    for row in range(rows):
        seen[row] = x
        for _ in range(parts):
            between = spring * (x - y) + damper * (v - w)
            free = commands[row] - 0.05 * v - between
            sticks = (v == 0) & (np.abs(free) <= friction)
            pull = np.where(sticks, 0.0, free - friction * np.where(v == 0, np.sign(free), np.sign(v)))
            after = v + pull / near * h
            after = np.where(v * after < 0, 0.0, after)
            faster = w + between / far * h
            x, y, v, w = x + 0.5 * (v + after) * h, y + 0.5 * (w + faster) * h, after, faster
    seen = np.round(seen / 3e-4) * 3e-4
    found = identified(
        [Recording(str(i), period * np.arange(rows), commands[:, i], seen[:, i], period) for i in range(n)]
    )
    assert {name for name, gain in found.parts.items() if gain > 0} == {"friction", "mode"}
    truth = {"mass": near + far, "friction.coulomb": friction, "mode.frequency_hz": 9.0, "mode.mass": far}
    assert {name: found.parameters[name].value for name in truth} == pytest.approx(truth, rel=0.005)


def test_an_ideal_device_behind_walls_has_no_parts():
    found = identified(behind_walls(np.random.default_rng(18), {"mass": 0.6, "damping": 4.0}, {}))
    assert found.parts == {}
    assert holds(found.parameters, {"mass": 0.6, "damping": 4.0, "delay_samples": 2.4}) == []
    assert found.parameters["mass"].high - found.parameters["mass"].low < 1e-3 * 0.6


def test_walls_far_beyond_their_limit_do_not_say_all_alone():
    walls = np.repeat([300, 500, 800, 1200, 2000, 3000, 5000, 8000, 12000, 20000], 2), np.tile([12.0, 5.0], 10)
    logs = behind_walls(np.random.default_rng(19), {"mass": 0.6, "damping": 4.0}, {}, n=20, rows=380, walls=walls)
    found = identified(logs).parameters
    assert max(np.ptp(log.position) for log in logs) > 1.0
    assert found["delay_samples"].value == pytest.approx(2.4, abs=0.02)
    assert found["mass"].value == pytest.approx(0.6, rel=2e-3)


def reading(position):
    """A log of a step at row 20, read by a sensor of 2 um."""
    command = np.where(np.arange(len(position)) >= 20, 8.0, 0.0)
    return Recording("log", 1e-3 * np.arange(len(position)), command, 2e-6 * np.round(position / 2e-6), 1e-3, 20)


def test_behind_the_first_turn_nothing_comes_from_rest():
    t = np.maximum(np.arange(300) - 24, 0) * 1e-3
    swing = reading(4e-3 * (1 - np.exp(-3 * t) * np.cos(90 * t)))
    held = segments_of([swing], LogUnits.of([swing]), 5, True)
    assert len(held) > 3
    assert held.rests.sum() == 1


def test_a_reading_that_flickers_at_rest_is_no_turn():
    t = np.maximum(np.arange(400) - 24, 0) * 1e-3
    position = 2e-3 * (1 - (1 + 300 * t) * np.exp(-300 * t))
    position[[200, 240, 300, 360]] -= 6e-6
    slow = reading(position)
    held = segments_of([slow], LogUnits.of([slow]), 5, True)
    assert held.rows.sum() < 120
