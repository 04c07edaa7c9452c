"""Second methods for the theory branch: none of them shares a formula or a line with `pipeline`.

A loop in physical units that is stepped through time (matrix exponential, absolute coordinates, force in a list),
polynomials in many digits, and costs read off dense samples.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import mpmath as mp
import numpy as np
from scipy.linalg import expm

DIGITS = 50


def flow_in_many_digits(gamma: float, delta: float, time: float) -> mp.matrix:
    """Matrix exponential of (x, v, u) for x'' = u - delta x' - gamma x."""
    with mp.workdps(DIGITS):
        g, d, t = mp.mpf(gamma), mp.mpf(delta), mp.mpf(time)
        return mp.expm(mp.matrix([[0, t, 0], [-g * t, -d * t, t], [0, 0, 0]]))


@lru_cache(maxsize=4096)
def plant_polynomials(gamma: float, delta: float, delay: float) -> tuple[tuple[mp.mpf, ...], tuple[mp.mpf, ...]]:
    """Denominator of the plant, highest power first, and numerator of the delayed one (modified z-transform)."""
    with mp.workdps(DIGITS):
        fraction = mp.mpf(delay) - math.floor(delay)
        rate = mp.matrix([[0, 1, 0], [-mp.mpf(gamma), -mp.mpf(delta), 1], [0, 0, 0]])
        full = mp.expm(rate)
        late, first = (mp.expm(rate * (1 - fraction)), mp.expm(rate * fraction)) if fraction else (full, mp.eye(3))
        new = (late[0, 2], late[1, 2])
        old = [late[i, 0] * first[0, 2] + late[i, 1] * first[1, 2] for i in (0, 1)]
        a, b, c, d = full[0, 0], full[0, 1], full[1, 0], full[1, 1]
        # first row of adj(z I - A) is (z - d, b); new acts with delay floor(d), old one sample later
        numerator = (new[0], b * new[1] - d * new[0] + old[0], b * old[1] - d * old[0])
        return (mp.mpf(1), -(a + d), a * d - b * c), numerator


def characteristic(gamma: float, delta: float, delay: float, alpha: float, beta: float) -> list[mp.mpf]:
    """Characteristic polynomial, highest power first, from the modified z-transform of the delayed plant."""
    plant, numerator = plant_polynomials(gamma, delta, delay)
    with mp.workdps(DIGITS):
        wall = [mp.mpf(alpha) + mp.mpf(beta), -mp.mpf(beta)]
        right = [mp.mpf(0)] * 4
        for i, n in enumerate(numerator):
            for j, w in enumerate(wall):
                right[i + j] += n * w
        left = [*plant, *[mp.mpf(0)] * (math.floor(delay) + 2)]
        right = [mp.mpf(0)] * (len(left) - 4) + right
        return [x + y for x, y in zip(left, right, strict=True)]


def stable_by_schur_cohn(polynomial: list[mp.mpf], radius: float = 1.0) -> bool:
    """Whether all roots lie inside a circle, by reducing the degree with reflection coefficients."""
    with mp.workdps(4 * DIGITS):
        degree = len(polynomial) - 1
        p = [c * mp.mpf(radius) ** (degree - i) for i, c in enumerate(polynomial)]
        while len(p) > 1:
            ratio = p[-1] / p[0]
            if abs(ratio) >= 1:
                return False
            p = [x - ratio * y for x, y in zip(p[:-1], reversed(p[1:]), strict=True)]
        return True


def radius_by_polynomial(gamma: float, delta: float, delay: float, alpha: float, beta: float) -> float:
    """Largest root of the characteristic polynomial: the smallest circle that holds all roots, by bisection."""
    polynomial = characteristic(gamma, delta, delay, alpha, beta)
    low, high = 0.0, 1.0 + float(max(abs(c) for c in polynomial[1:]))  # Cauchy's bound
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if stable_by_schur_cohn(polynomial, middle) else (middle, high)
    return high


@dataclass(frozen=True, eq=False)
class Motion:
    """Dense motion: time in samples, displacement and velocity per final displacement (or as is), index of samples."""

    time: np.ndarray
    x: np.ndarray
    v: np.ndarray
    every: int
    piece: int
    acceleration: float


@lru_cache(maxsize=1024)
def _piece(mass: float, damping: float, stiffness: float, time: float, fine: int) -> np.ndarray:
    """Rows of position and velocity at the `fine` points of a piece, shape (fine, 2, 3), by matrix exponentials."""
    m = np.array([[0, 1, 0], [-stiffness / mass, -damping / mass, 1 / mass], [0, 0, 0]])
    one, rows = expm(m * time / fine), [np.eye(3)]
    for _ in range(fine):
        rows.append(one @ rows[-1])
    return np.array(rows[1:])[:, :2]


def simulate(
    alpha: float,
    beta: float,
    *,
    delay: tuple[int, int],
    samples: int,
    gamma: float = 0.0,
    delta: float = 0.0,
    mass: float = 1.0,
    period: float = 1.0,
    signal: str = "step",
    fine: int = 16,
) -> Motion:
    """Step a physical mass with wall through time: delay p/q samples, 1/(q fine) samples a step.

    ``alpha``, ``beta``, ``gamma``, ``delta`` are the physical K, B, k, b; the external step is 1 N (an impulse 1 Ns)
    at sample 0, undelayed. The wall samples every q-th piece and its force arrives p pieces later.
    """
    rows = _piece(mass, delta, gamma, period / delay[1], fine)
    case = np.array([[alpha, beta]])
    state = _stepped(case, rows[None, -1], np.array([delay[0]]), delay[1], samples, (mass, period), signal)[0]
    return _motion(state, rows, (alpha, gamma, delta), delay[1], fine, mass, period)


def simulate_many(
    cases: list[tuple[float, ...]], samples: list[int], signal: str = "step", fine: int = 16
) -> list[Motion]:
    """The motions of `simulate` for normalised cases (gamma, delta, p, q, alpha, beta), those of one q side by side."""
    result: list[Motion | None] = [None] * len(cases)
    for q in sorted({int(case[3]) for case in cases}):
        # those of like length together, so that a long one does not make all others be stepped as far
        group = sorted((i for i, case in enumerate(cases) if case[3] == q), key=lambda i: samples[i])
        for some in (group[k : k + 40] for k in range(0, len(group), 40)):
            rows = [_piece(1.0, cases[i][1], cases[i][0], 1.0 / q, fine) for i in some]
            walls = np.array([cases[i][4:] for i in some])
            delays = np.array([int(cases[i][2]) for i in some])
            last = np.array([r[-1] for r in rows])
            states = _stepped(walls, last, delays, q, max(samples[i] for i in some), (1.0, 1.0), signal)
            for i, state, row in zip(some, states, rows, strict=True):
                gamma, delta, _, _, alpha, _ = cases[i]
                result[i] = _motion(state[: samples[i] * q], row, (alpha, gamma, delta), q, fine, 1.0, 1.0)
    return [motion for motion in result if motion is not None]


def _stepped(
    walls: np.ndarray,
    maps: np.ndarray,
    delays: np.ndarray,
    q: int,
    samples: int,
    units: tuple[float, float],
    signal: str,
) -> np.ndarray:
    """Position, velocity and force at the start of each piece, shape (cases, pieces, 3)."""
    mass, period = units
    alpha, beta = walls.T
    x, before = np.zeros(len(walls)), np.zeros(len(walls))
    v = np.full(len(walls), 1.0 / mass if signal == "impulse" else 0.0)
    external = 1.0 if signal == "step" else 0.0
    arriving = np.zeros((samples * q + int(delays.max()) + q, len(walls)))
    (xx, xv, xu), (vx, vv, vu) = (row.T for row in np.swapaxes(maps, 0, 1))
    which = np.arange(len(walls))
    states = np.empty((samples * q, 3, len(walls)))
    for piece in range(samples * q):
        if piece % q == 0:
            wall = -alpha * x - beta * (x - before) / period
            before = x
            for i in range(q):
                arriving[piece + delays + i, which] = wall
        u = external + arriving[piece]
        states[piece] = x, v, u
        x, v = xx * x + xv * v + xu * u, vx * x + vv * v + vu * u
    return np.moveaxis(states, 2, 0)


def _motion(
    state: np.ndarray,
    rows: np.ndarray,
    plant: tuple[float, float, float],
    q: int,
    fine: int,
    mass: float,
    period: float,
) -> Motion:
    alpha, gamma, delta = plant
    dense = np.einsum("frc,pc->rpf", rows, state).reshape(2, -1)
    xs, vs = (np.concatenate([[state[0, i]], dense[i]]) for i in (0, 1))
    forces = np.repeat(state[:, 2], fine)
    largest = float(np.abs(forces - delta * vs[1:] - gamma * xs[1:]).max()) / mass
    largest = max(largest, float(np.abs(state @ np.array([-gamma, -delta, 1.0])).max()) / mass)
    # between two points the acceleration differs from that at the points by little; 1.1 covers it
    return Motion(np.arange(len(xs)) / (q * fine), xs, vs, q * fine, fine, 1.1 * largest * period**2 * (alpha + gamma))


def deviation(motion: Motion, stiffness: float) -> np.ndarray:
    """Distance from the final position of a unit step, relative to the final displacement."""
    return motion.x * stiffness - 1.0


def between_points(motion: Motion) -> float:
    """Bound of how far the relative position strays from a straight line between two dense points: a h^2/8."""
    return motion.acceleration / motion.every**2 / 8


def settling_bracket(motion: Motion, stiffness: float, band: float) -> tuple[float, float]:
    """Interval that holds the last entry into the band: the band widened and narrowed by what lies between points."""
    e = np.abs(deviation(motion, stiffness))
    slack = between_points(motion)

    def entry(level: float) -> float:
        last = int(np.flatnonzero(e > level)[-1])
        share = (e[last] - level) / (e[last] - e[last + 1])
        return float(motion.time[last] + share / motion.every)

    return entry(band + slack), entry(band - slack)


def discrete_settling(motion: Motion, stiffness: float, band: float) -> int:
    """Smallest k with samples k, k+1, ... inside the band."""
    outside = np.abs(deviation(motion, stiffness)[:: motion.every]) > band
    return int(np.flatnonzero(outside)[-1]) + 1


def continuous_energy(motion: Motion, stiffness: float, mass: float, w: int, signal: str) -> float:
    """Integral (5.14) by Simpson's rule on each piece of constant force."""
    final, norm = (1 / stiffness, 0.5 / stiffness) if signal == "step" else (0.0, 0.5 / mass)
    energy = 0.5 * stiffness * (motion.x - final) ** 2 + 0.5 * mass * motion.v**2
    weighted = motion.time**w * energy / norm
    assert motion.piece % 2 == 0, "a panel of Simpson's rule must not straddle a jump of the force"
    weights = np.ones(len(weighted))
    weights[1:-1:2], weights[2:-1:2] = 4.0, 2.0
    return float(weights @ weighted / (3 * motion.every))


def discrete_energy(motion: Motion, stiffness: float, mass: float, period: float, w: int, signal: str) -> float:
    """Left rectangle rule with the backward difference, term by term."""
    final, norm = (1 / stiffness, 0.5 / stiffness) if signal == "step" else (0.0, 0.5 / mass)
    x = motion.x[:: motion.every]
    speed = np.diff(x, prepend=x[0]) / period
    k = np.arange(len(x), dtype=float)
    return float(np.sum(k**w * (0.5 * stiffness * (x - final) ** 2 + 0.5 * mass * speed**2)) / norm)


def wall_of_radius(gamma: float, delay: float, delta: float, radius: float) -> tuple[float, float]:
    """A wall whose largest pole has a radius, by moving its stiffness between a stable and an unstable one."""
    beta = 0.4 * (1 + 0.5 * delta) / (0.5 + delay)
    low, high = 0.15 * (1 + delta) / (1 + delay) ** 2, 4.0 * (1 + delta)
    for _ in range(70):
        middle = 0.5 * (low + high)
        inside = stable_by_schur_cohn(characteristic(gamma, delta, delay, middle, beta), radius)
        low, high = (middle, high) if inside else (low, middle)
    return low, beta


Loops = list[tuple[float, float, int, int]]
"""gamma, delta and the delay p/q."""


def random_loops(count: int, seed: int) -> Loops:
    """Random plants and delays p/q up to 4 samples, at least half of them fractional; seeded."""
    rng = np.random.default_rng(seed)
    result: Loops = []
    for _ in range(count):
        q = int(rng.choice([1, 1, 2, 3, 4, 5, 8]))
        p = int(rng.integers(0, 4 * q + 1))
        spring = 10.0 ** rng.uniform(-9, -0.5) / (1 + p / q) ** 2
        gamma = float(rng.choice([0.0, spring, spring]))
        delta = float(rng.choice([0.0, 10.0 ** rng.uniform(-9, 0), 10.0 ** rng.uniform(-3, 0.7)]))
        result.append((gamma, delta, p, q))
    return result


def stable_walls(loops: Loops, each: int, seed: int, slowest: float = 0.93) -> list[tuple[float, ...]]:
    """Cases (gamma, delta, p, q, alpha, beta): so many random walls for each loop, fast enough to be stepped."""
    rng = np.random.default_rng(seed)
    cases: list[tuple[float, ...]] = []
    for gamma, delta, p, q in loops:
        d, found = p / q, 0
        for _ in range(400):
            alpha = float(rng.uniform(0.02, 0.7) / (1 + d) ** 2 * (1 + delta))
            beta = float(rng.uniform(0.05, 0.9) / (0.5 + d) * (1 + 0.5 * delta))
            polynomial = [float(c) for c in characteristic(gamma, delta, d, alpha, beta)]
            if float(np.abs(np.roots(polynomial)).max()) < 1 - (1 - slowest) / (1 + d):
                cases.append((gamma, delta, p, q, alpha, beta))
                found += 1
            if found == each:
                break
    return cases


NYQUIST = math.pi**2 * (1 - 1e-12)
"""Just below the stiffest plant that is sampled fast enough (4.15) without damping."""


def extreme_cases() -> list[tuple[float, ...]]:
    """Stable (gamma, delta, p, q, alpha, beta) at the ends of the domain whose responses can be stepped.

    Springs from 1e-16 to the limit of sampling, damping to 1e3, critical damping to 12 digits, delays to 256 samples,
    walls of 1e-11, slow decay.
    """
    cases: list[tuple[float, ...]] = []
    near_critical = [(0.01, 0.2 * (1 + off)) for off in (0.0, 1e-12, -1e-12, 1e-8)]
    for gamma, delta in [(1e-16, 0.0), (1e-16, 1e-16), (1e-9, 2e-9**0.5), *near_critical]:
        for p, q in [(0, 1), (1, 8), (1, 2), (7, 3), (16, 1)]:
            d = p / q
            cases.append((gamma, delta, p, q, 0.25 / (1 + d) ** 2, 0.8 / (1.2 + d)))
    for delta in (10.0, 100.0, 1e3):
        for p, q in [(0, 1), (1, 3), (2, 1), (9, 4)]:
            share = delta / (1 + 2 * p / q)
            cases.append((0.0, delta, p, q, 0.4 * share, 0.2 * share))
            cases.append(
                (0.25 * delta**2 * (1 - 1e-12) if delta < 50 else 1e-16, delta, p, q, 0.3 * share, 0.1 * share)
            )
    for delta in (0.3, 0.6):
        for p, q in [(0, 1), (1, 2), (3, 1)]:
            cases += [(NYQUIST, delta, p, q, 1e-11, 1e-11), (NYQUIST, delta, p, q, 0.05, -0.02)]
    for p, q in [(64, 1), (129, 2), (256, 1), (511, 2)]:
        d = p / q
        cases.append((0.0, 0.0, p, q, 0.27 / (d + 1) ** 2, 0.85 / (d + 1.2)))
    # pole radii 1 - 1e-2 to 1 - 2e-3
    cases += [(0.0, 0.0, 0, 1, 0.02 * beta, beta) for beta in (0.03, 0.02)]
    cases += [(1e-3, 0.02, 1, 2, 0.04, beta) for beta in (0.03, 0.025)]
    return cases


def horizon(case: tuple[float, ...], decades: float = 14.0) -> int:
    """Samples after which a response has decayed by that many decades."""
    gamma, delta, p, q, alpha, beta = case
    polynomial = [float(c) for c in characteristic(gamma, delta, p / q, alpha, beta)]
    radius = float(np.abs(np.roots(polynomial)).max())
    return int(decades * math.log(10) / -math.log(max(radius, 0.3))) + 20


def maximum_passive_stiffness(delays):
    """Largest passive K T/b and its B/b over delay factors d, as printed in eq. 4.11."""
    d = np.atleast_1d(np.asarray(delays, dtype=float))
    quarter = 0.25 * np.pi / (d + 1)
    damping = np.where(d == 0, 0.0, (np.cos(2 * quarter) - d / (d + 1)) / np.sin(2 * quarter))
    return 2 * np.tan(quarter), damping
