"""Compiled loops of the estimator against independent methods: dense normal densities, finite differences, Python."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import expm, expm_frechet
from scipy.stats import multivariate_normal

from pipeline.loop.state_space import state_space
from pipeline.measured.identification import kernels
from pipeline.measured.identification.drive import applied_command
from pipeline.measured.identification.likelihood import Device, columns_of
from pipeline.measured.identification.motion import Ages, PlantShape, Transitions
from pipeline.measured.identification.noise import Noise, gains_of
from pipeline.measured.identification.recordings import LogUnits, Recording
from pipeline.measured.identification.segments import Segments, segments_of

SHAPES = {
    "rigid": PlantShape(delta=0.05, gamma=0.02, delay=2.4),
    "lag": PlantShape(delta=0.05, gamma=0.02, delay=2.4, lag=1.3),
    "mode": PlantShape(
        delta=0.05,
        gamma=0.01,
        delay=1.7,
        mode_frequency=0.4,
        mode_damping_ratio=0.05,
        load_mass_fraction=0.3,
        load_damping=0.01,
    ),
    "mode at the load": PlantShape(
        delta=0.05, delay=1.7, mode_frequency=0.4, mode_damping_ratio=0.05, spring_damping_fraction=0.6, lag=0.6
    ),
}
NOISES = {"white": Noise(), "force": Noise(0.3), "jitter": Noise(0.1, 0.2, 0.8)}
GAIN, COULOMB, FORCE = 0.9, 0.05, 0.02


def segments(*, even: bool, rests: bool = False, friction: bool = False, seed: int = 1) -> Segments:
    """Two segments of two logs; the readings are noise."""
    rng, logs = np.random.default_rng(seed), []
    for name, rows in (("a", 17), ("b", 12)):
        time = np.cumsum(np.ones(rows) if even else rng.uniform(0.6, 1.4, rows))
        command = np.cumsum(rng.normal(size=rows))
        logs.append(Recording(name, time, command, rng.normal(size=rows), 1.0))
    whole = segments_of(logs, LogUnits(1.0, 1.0, 1.0, 0.0), 5, False)
    edge = whole.first + 3 if rests else whole.edge
    return replace(whole, edge=edge, direction=np.array([1.0, -1.0]) if friction else whole.direction)


def force_at(each: Segments, s: int, age: float, time: float) -> tuple[float, float]:
    """Command in force at a time, and whether it acts, by the log alone."""
    first, behind = int(each.begin[s]), int(each.behind[s])
    late = each.time[first:behind] + age
    row = max(int(np.searchsorted(late, time, side="right")) - 1, -1)
    acts = first + row >= each.edge[s]
    return float(each.command[first + max(row, 0)]) * acts, float(acts)


def motion(each: Segments, s: int, shape: PlantShape, ages: Ages, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Readings of a segment from a start, and the mean command by age in each interval, by exponentials of pieces."""
    system, first, behind = state_space(shape.plant), int(each.first[s]), int(each.behind[s])
    A, n, x, readings, commands = system.matrix, system.states, start.copy(), [], []
    for row in range(first, behind):
        readings.append(system.sensor @ x)
        begin, end = each.time[row], each.time[min(row + 1, len(each.time) - 1)]
        mean = np.zeros(len(ages.age))
        if row + 1 < behind:
            moved = expm(A * (end - begin)) @ x
            for place, (age, chance) in enumerate(zip(ages.age, ages.chance, strict=True)):
                inner = [t + age for t in each.time if begin < t + age < end]
                bounds = [begin, *sorted(inner), end]
                for a, b in pairwise(bounds):
                    command, acts = force_at(each, s, float(age), 0.5 * (a + b))
                    direct = (FORCE - COULOMB * each.direction[s]) * acts + shape.gamma * (1 - acts) * start[0]
                    whole = np.zeros((n + 1, n + 1))
                    whole[:n, :n] = A
                    whole[:n, n] = system.command * GAIN * command + system.force * direct
                    one = expm(whole * (b - a))[:n, n]
                    moved = moved + chance * expm(A * (end - b)) @ one
                    mean[place] += command * (b - a) / (end - begin)
            x = moved
        commands.append(mean)
    return np.array(readings), np.array(commands)


def lag_start(each: Segments, s: int, shape: PlantShape) -> float:
    """Force of the actuator at the first row by the commands before, of which the first was there for ever."""
    first, at = int(each.begin[s]), float(each.time[each.first[s]]) - shape.delay
    value = float(each.command[first]) * (first >= each.edge[s])
    for row in range(first, int(each.first[s])):
        since = max(at - each.time[row], 0.0)
        before = 0.0 if row == first else float(each.command[row - 1]) * (row - 1 >= each.edge[s])
        if row > first:
            value += (float(each.command[row]) * (row >= each.edge[s]) - before) * (1 - np.exp(-since / shape.lag))
    return GAIN * value


def steady_covariance(system, force):
    """Covariance of the prediction of a state by a filter that has worked for ever, by many rows."""
    n = system.states
    whole = np.zeros((n + 1, n + 1))
    whole[:n, :n], whole[:n, n] = system.matrix, system.force
    F, W, H, P = expm(whole)[:n, :n], expm(whole)[:n, n], system.sensor, np.zeros((n, n))
    for _ in range(2000):
        gain = P @ H / (1 + H @ P @ H)
        P = F @ (P - np.outer(gain, P @ H)) @ F.T + force * np.outer(W, W)
    return P


@pytest.mark.parametrize("rests", [False, True])
@pytest.mark.parametrize("even", [True, False])
@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("kind", SHAPES)
def test_likelihood_is_the_dense_normal_density_of_all_readings(kind, noise, even, rests):
    shape, noise = SHAPES[kind], NOISES[noise]
    each = segments(even=even, rests=rests, friction=True)
    names = {name: value for name, value in vars(shape).items() if value}
    device = Device({"gain": GAIN, "coulomb": COULOMB, "force": FORCE} | names, noise, reading=1.0)
    each = replace(each, position=4 * each.position)  # third differences above the variance of 1 that is known
    columns = columns_of(each, device, ())
    ages = Ages.of(shape.delay, noise.jitter)
    system = state_space(shape.plant)
    of_mode = [GAIN / shape.mode_frequency**2, GAIN / shape.mode_frequency] if shape.load_mass else []
    sizes = np.array([1 + each.largest, 1.0, *of_mode, *([GAIN] if shape.lag else [])])[: 1 if rests else None]
    dense = 0.0
    for s in range(len(each)):
        y = each.position[each.first[s] : each.behind[s]]
        rows, zero = len(y), np.zeros(system.states)
        if shape.lag:
            zero[-1] = lag_start(each, s, shape)
        mean, commands = motion(each, s, shape, ages, zero)
        unknown = np.zeros((rows, len(sizes)))
        for state in range(len(sizes)):
            unit = zero.copy()
            reach = each.time[each.first[s]] - shape.delay - each.time[max(each.first[s] - each.lead, each.begin[s])]
            reach += max(each.lead - (each.first[s] - each.begin[s]), 0)
            held = np.exp(-max(reach, 0.0) / shape.lag) if shape.lag and state == system.states - 1 else 1.0
            unit[state] += held
            unknown[:, state] = motion(each, s, shape, ages, unit)[0] - mean
        pulse = np.zeros((rows, rows))
        spans = np.diff(each.time[each.first[s] : each.behind[s]])
        for first in range(rows - 1):
            whole = np.zeros((system.states + 1,) * 2)
            whole[:-1, :-1], whole[:-1, -1] = system.matrix, system.force
            state = expm(whole * spans[first])[:-1, -1]
            for row in range(first + 1, rows):
                pulse[row, first] = system.sensor @ state
                if row + 1 < rows:
                    state = expm(system.matrix * spans[row]) @ state
        forces = noise.force * np.eye(rows)
        for k in range(rows if noise.late else 0):
            for m in range(k, rows):
                both = ages.covariance @ np.linalg.matrix_power(dense_ageing(ages), m - k)
                forces[k, m] += noise.late * commands[k] @ both @ commands[m]
                forces[m, k] = forces[k, m]
        covariance = np.eye(rows) + pulse @ forces @ pulse.T + (unknown * sizes**2) @ unknown.T
        if even and noise.force and not noise.late:
            # a steady filter has worked for ever: its state is known as well as that leaves it
            moved = np.array([system.sensor @ expm(system.matrix * row) for row in range(rows)])
            covariance += moved @ steady_covariance(system, noise.force) @ moved.T
        dense += multivariate_normal(mean, covariance).logpdf(y)
    squares, rows = float((columns.values[:, -1] ** 2).sum()), int(each.rows.sum())
    assert -0.5 * squares - columns.lost - 0.5 * rows * np.log(2 * np.pi) == pytest.approx(dense, rel=1e-9)


def dense_ageing(ages):
    """Chances (A, A) of an age after another less those of it after any."""
    result = np.empty_like(ages.covariance)
    kernels.next_ages(result, ages.ageing, np.eye(len(result)), 0, len(result))
    return result.T


DRIVE = {"limit": 1.5, "asymmetry": 0.2}


def loop_arguments(each, shape, along, gains=None, noise=None, drive=DRIVE):
    """What `kernels.whitened` takes for a shape, without unknown starts."""
    commands = applied_command(each.command, drive)
    transitions = Transitions.of(each, shape, noise.jitter, along)
    own = np.tile([GAIN, COULOMB, FORCE], (len(each), 1))
    places = [along.index(name) if name in along else -1 for name in ("gamma", "lag", "delay")]
    codes = [kernels.GAIN, kernels.COULOMB, kernels.FORCE, -1, -2, *(kernels.SHAPE + np.arange(len(along)))]
    constants = [shape.gamma, shape.lag, shape.delay, 1.0, each.lead]
    return (
        (each.time, commands, each.position, np.empty((1, 0))),
        (each.first, each.behind, each.begin, each.edge, each.direction, own, np.zeros((len(each), len(codes)))),
        transitions.motion,
        transitions.pieces,
        gains_of(each, transitions, noise, commands[0]) if gains is None else gains,
        (np.array(codes), np.array(places), np.array(constants), np.empty(0)),
    )


@pytest.mark.parametrize("even", [True, False])
@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("kind", SHAPES)
def test_tangents_are_those_of_differences(kind, noise, even):
    shape, noise, each = SHAPES[kind], NOISES[noise], segments(even=even, rests=True, friction=True)
    along = [name for name, value in vars(shape).items() if value]
    arguments = loop_arguments(each, shape, along, noise=noise)
    columns = kernels.whitened(*arguments)[0]
    for place, name in enumerate(along):
        ends = (replace(shape, **{name: getattr(shape, name) + by}) for by in (1e-5, -1e-5))
        high, low = (kernels.whitened(*loop_arguments(each, end, along, arguments[4], noise))[0][:, -1] for end in ends)
        slope = columns[:, 5 + place]
        np.testing.assert_allclose(slope, (low - high) / 2e-5, atol=3e-6 * np.abs(slope).max(), err_msg=name)
    for place in range(3):
        errors = []
        for by in (1e-5, -1e-5):
            changed = [list(group) for group in arguments]
            changed[1][5] = arguments[1][5] + by * (np.arange(3) == place)
            errors.append(kernels.whitened(*map(tuple, changed))[0][:, -1])
        slope = columns[:, place]
        np.testing.assert_allclose(slope, (errors[1] - errors[0]) / 2e-5, atol=1e-6 * max(np.abs(slope).max(), 1e-3))
    # the forces by which a filter follows a jitter are those of the command that acts, and not part of the tangent
    for place, name in enumerate(() if noise.late else DRIVE, start=3):
        ends = (DRIVE | {name: DRIVE[name] + by} for by in (1e-5, -1e-5))
        high, low = (
            kernels.whitened(*loop_arguments(each, shape, along, arguments[4], noise, end))[0][:, -1] for end in ends
        )
        np.testing.assert_allclose(columns[:, place], (low - high) / 2e-5, atol=1e-6, err_msg=name)


@pytest.mark.parametrize("even", [True, False])
def test_squares_fall_along_gravity(even):
    each = segments(even=even, rests=True)
    each = replace(each, scale=0.7, origins=np.full(each.trials, 0.4))
    numbers = {"gain": GAIN, "delta": 0.02, "gravity_sine": 0.03, "gravity_cosine": -0.01}
    columns = columns_of(each, Device(numbers, reading=1.0), tuple(numbers)).values
    for place, name in enumerate(numbers):
        ends = (Device(numbers | {name: numbers[name] + by}, reading=1.0) for by in (1e-5, -1e-5))
        high, low = (float((columns_of(each, end, ()).values ** 2).sum()) for end in ends)
        assert (low - high) / 2e-5 == pytest.approx(2 * columns[:, place] @ columns[:, -1], rel=1e-4), name


def test_squares_without_the_start_fall_along_the_columns():
    """The likeliest start is another one for other numbers, but to first order it changes nothing."""
    each, shape = segments(even=False), SHAPES["rigid"]
    names = {"gain": GAIN} | {name: value for name, value in vars(shape).items() if value}
    columns = columns_of(each, Device(names, reading=1.0), tuple(names)).values
    for place, name in enumerate(names):
        ends = (Device(names | {name: names[name] + by}, reading=1.0) for by in (1e-5, -1e-5))
        high, low = (float((columns_of(each, end, ()).values ** 2).sum()) for end in ends)
        assert -2 * columns[:, place] @ columns[:, -1] == pytest.approx((high - low) / 2e-5, rel=1e-4, abs=1e-4), name


@pytest.mark.parametrize("even", [True, False])
def test_machine_code_gives_the_numbers_of_python(even):
    each, shape, noise = segments(even=even, rests=True), SHAPES["lag"], NOISES["jitter"]
    along = ["delta", "gamma", "delay", "lag"]
    arguments = loop_arguments(each, shape, along, noise=noise)
    for fast, slow in zip(kernels.whitened(*arguments), kernels.whitened.__wrapped__(*arguments), strict=True):
        np.testing.assert_allclose(fast, slow, rtol=1e-10, atol=1e-12)
    transitions = Transitions.of(each, shape, noise.jitter)
    kind, F, _, W, _, H, _ = transitions.motion
    of_filter = (
        (each.first, each.behind, each.begin, each.edge),
        each.command,
        (kind, F, W, H),
        transitions.pieces[:4],
        (transitions.ages.ageing, transitions.ages.covariance),
        (noise.force, np.sqrt(noise.late)),
    )
    for fast, slow in zip(kernels.filter_gains(*of_filter), kernels.filter_gains.__wrapped__(*of_filter), strict=True):
        np.testing.assert_allclose(fast, slow, rtol=1e-10, atol=1e-13)


def test_exponentials_and_their_tangents_are_those_of_scipy():
    rng = np.random.default_rng(2)
    for size in (3, 5, 7):
        matrix, along, times = rng.normal(size=(size, size)), rng.normal(size=(size, size)), np.array([0.0, 0.3, 4.0])
        found = kernels.exponentials(np.stack([matrix, along]), times)
        for value, time in zip(found, times, strict=True):
            exact, slope = expm_frechet(matrix * time, along * time)
            np.testing.assert_allclose(value[0], exact, atol=1e-12 * np.abs(exact).max())
            np.testing.assert_allclose(value[1], slope, atol=1e-11 * max(np.abs(slope).max(), 1e-3))


def test_triangular_factors_have_the_products_of_all_rows():
    rng = np.random.default_rng(3)
    columns = rng.normal(size=(230, 5)) * [1.0, 1e-8, 1e8, 1.0, 1.0]
    columns[:, 3] = 0.0
    first, behind, unit = np.array([0, 70, 100]), np.array([70, 100, 230]), np.array([1, 0, 1])
    factors = np.zeros((2, 5, 5))
    kernels.triangles(factors, columns.copy(), first, behind, unit)
    assert (np.tril(factors, -1) == 0).all()
    for which in (0, 1):
        rows = np.concatenate([columns[a:b] for a, b, of in zip(first, behind, unit, strict=True) if of == which])
        size = np.sqrt((rows**2).sum(axis=0))
        size[size == 0] = 1.0
        found, exact = (each.T @ each / np.outer(size, size) for each in (factors[which], rows))
        np.testing.assert_allclose(found, exact, atol=1e-13)


def test_triangles_of_a_response_that_has_decayed_are_finite():
    """Squares of 1e-160 are subnormal, and the inverse of their sum overflows."""
    rng = np.random.default_rng(5)
    columns = rng.normal(size=(40, 3)) * [1.0, 1e-160, 1.0]
    factors = np.zeros((1, 3, 3))
    kernels.triangles(factors, columns.copy(), np.array([0]), np.array([40]), np.array([0]))
    assert np.isfinite(factors).all()
    others = columns[:, [0, 2]]
    assert factors[0][:, [0, 2]].T @ factors[0][:, [0, 2]] == pytest.approx(others.T @ others, rel=1e-12)


@pytest.mark.parametrize("states", [2, 3, 4, 5])
def test_a_steady_filter_is_that_of_many_rows(states):
    rng = np.random.default_rng(states)
    F = rng.normal(size=(states, states))
    F /= 1.05 * np.abs(np.linalg.eigvals(F)).max()
    W, H, P = rng.normal(size=states), rng.normal(size=states), np.zeros((states, states))
    for _ in range(4000):
        gain = P @ H / (1 + H @ P @ H)
        P = F @ (P - np.outer(gain, gain) * (1 + H @ P @ H)) @ F.T + 0.3 * np.outer(W, W)
    gain, variance = kernels.steady_gain(F, W, H, 0.3)
    np.testing.assert_allclose(gain, P @ H / (1 + H @ P @ H), rtol=1e-9)
    assert variance == pytest.approx(1 + H @ P @ H, rel=1e-10)
