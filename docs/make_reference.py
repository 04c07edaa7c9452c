"""Write ``schemas/reference/accuracy.json``: high-precision values that `pipeline accuracy` measures errors against.

Everything is computed in `DIGITS` digits (mpmath) from the equation of motion alone; nothing of the package under test
is used. Inputs are doubles, taken as exact; results are rounded to doubles once, at the end. Takes about a minute:

    python docs/make_reference.py
"""

from __future__ import annotations

import json
import time
from dataclasses import asdict
from functools import lru_cache
from itertools import pairwise
from math import comb
from pathlib import Path
from typing import Any

import mpmath as mp
import numpy as np
from hard_loops import HARD_LOOPS, HardLoop, followed

DIGITS = 60
SERIES = 32
"""Terms of the Taylor series of the plant's motion over one sample; for gamma, delta << 1 the next is below 1e-36."""
GAMMA, DELTA, DELAY = 0.001, 0.02, 4
"""Loop of the main part: upper ends of the ranges of the thesis, and the Falcon's delay."""
GRID = 61
POINTS = 40
SLOWEST = 0.992
BAND = 0.02
GENERAL = {
    "gamma": 0.0,
    "delta": 0.006,
    "delay": 2.4,
    "lag": 1.5,
    "far_mass": 0.3,
    "spring": 0.5,
    "damper": 0.03,
    "cutoff": 0.08,
}
"""Loop with all parts; names are those of `hard_loops.HardLoop`."""
TARGET = Path(__file__).parents[1] / "schemas" / "reference" / "accuracy.json"

mp.mp.dps = DIGITS
Matrix = Any


def motion(gamma: float, delta: float, time: Any = 1) -> Matrix:
    """Return exp of the equation of motion of (x, v, u) over a time."""
    with mp.workdps(DIGITS + 500 if delta > 100 else DIGITS + 60):
        t = mp.mpf(time)
        return mp.expm(mp.matrix([[0, 1, 0], [-mp.mpf(gamma), -mp.mpf(delta), 1], [0, 0, 0]]) * t)


@lru_cache(maxsize=256)
def transfer(gamma: float, delta: float) -> tuple[Any, Any, Any, Any]:
    """Return n1, n0, trace and determinant of (n1 z + n0)/(z^2 - trace z + determinant)."""
    m = motion(gamma, delta)
    with mp.workdps(DIGITS + 500):
        n0 = m[0, 1] * m[1, 2] - m[1, 1] * m[0, 2]
        return m[0, 2], n0, m[0, 0] + m[1, 1], mp.exp(-mp.mpf(delta))


def polynomial(gamma: float, delta: float, delay: int, alpha: Any, beta: Any) -> list[Any]:
    """Return the characteristic polynomial, highest power first."""
    n1, n0, trace, det = transfer(gamma, delta)
    p = [mp.mpf(1), -trace, det] + [mp.mpf(0)] * (delay + 1)
    a, b = mp.mpf(alpha), mp.mpf(beta)
    for i, c in enumerate((n1 * (a + b), n0 * (a + b) - n1 * b, -n0 * b)):
        p[delay + 1 + i] += c
    return p


def inside(poly: list[Any], radius: Any) -> bool:
    """Whether all roots lie within a circle (Schur-Cohn)."""
    degree = len(poly) - 1
    with mp.workdps(4 * DIGITS):
        p = [c * radius ** (degree - i) for i, c in enumerate(poly)]
        while len(p) > 1:
            ratio = p[-1] / p[0]
            if abs(ratio) >= 1:
                return False
            p = [x - ratio * y for x, y in zip(p[:-1], reversed(p[1:]), strict=True)]
    return True


def radius_of(poly: list[Any]) -> Any:
    """Largest root modulus: Newton from double precision, confirmed by counting roots on both sides of it."""
    starts = np.roots([float(c) for c in poly])
    starts = starts[np.argsort(-np.abs(starts))][:6]
    found = []
    for start in starts:
        z = mp.mpc(complex(start) * (1 + 1e-9j))
        for _ in range(200):
            value, slope = mp.polyval(poly, z, derivative=True)
            step = value / slope
            z -= step
            if abs(step) < mp.mpf(10) ** (-DIGITS + 10):
                break
        found.append(abs(z))
    largest = max(found)
    gap = mp.mpf(10) ** (-25)
    if not inside(poly, largest * (1 + gap)) or inside(poly, largest * (1 - gap)):
        low, high = mp.mpf(0), 1 + max(abs(c) for c in poly[1:])
        for _ in range(110):
            middle = (low + high) / 2
            low, high = (low, middle) if inside(poly, middle) else (middle, high)
        largest = high
    return largest


class Plant:
    """Exact motion within a sample as power series: rows of position and velocity over (x, v, u)."""

    def __init__(self, gamma: float, delta: float) -> None:
        g, d = mp.mpf(gamma), mp.mpf(delta)
        generator = mp.matrix([[0, 1, 0], [-g, -d, 1], [0, 0, 0]])
        power = mp.eye(3)
        self.rows: list[list[list[Any]]] = [[[] for _ in range(3)] for _ in range(2)]
        for n in range(SERIES):
            for i in range(2):
                for j in range(3):
                    self.rows[i][j].append(power[i, j] / mp.factorial(n))
            power = power * generator
        self.end = [[mp.fsum(c) for c in row] for row in self.rows]
        self.forms = [self._integrals(w) for w in range(3)]

    def _integrals(self, w: int) -> list[list[list[Any]]]:
        """Integrals over tau in [0, 1] of tau^w p p' for position and for velocity."""
        forms = []
        for row in self.rows:
            form = [[mp.mpf(0)] * 3 for _ in range(3)]
            for i in range(3):
                for j in range(3):
                    product = [mp.mpf(0)] * (2 * SERIES)
                    for n, a in enumerate(row[i]):
                        if a:
                            for m, b in enumerate(row[j]):
                                product[n + m] += a * b
                    form[i][j] = mp.fsum(c / (n + w + 1) for n, c in enumerate(product))
            forms.append(form)
        return forms

    def series(self, row: int, state: list[Any]) -> list[Any]:
        """Power series of position (0) or velocity (1) after a state, highest power first."""
        return [sum(self.rows[row][j][n] * state[j] for j in range(3)) for n in reversed(range(SERIES))]

    def turn(self, state: list[Any]) -> tuple[Any, Any]:
        """Time and place at which the velocity changes its sign within the sample."""
        time = _root(self.series(1, state))
        return time, mp.polyval(self.series(0, state), time)


def response(plant: Plant, alpha: Any, beta: Any, delay: int, samples: int) -> list[list[Any]]:
    """States (e, v, u) at the start of each sample; e is the deviation relative to the final displacement."""
    a, b = mp.mpf(alpha), mp.mpf(beta)
    x, v = mp.mpf(-1), mp.mpf(0)
    before = mp.mpf(-1)
    # at rest the deviation is -1 and the wall's force, as a deviation from the final one, is alpha
    forces = [a] * delay
    states = []
    for _ in range(samples):
        forces.append(-(a * x) - b * (x - before))
        before = x
        u = forces.pop(0)
        states.append([x, v, u])
        x, v = (sum(c * s for c, s in zip(row, states[-1], strict=True)) for row in plant.end)
    return states


def costs_of(plant: Plant, alpha: float, beta: float, gamma: float, delay: int, radius: Any) -> dict[str, Any]:
    """All costs of one step response, by summing until nothing is left."""
    samples = int(14 * mp.log(10) / -mp.log(radius)) + 60
    states = response(plant, alpha, beta, delay, samples)
    stiffness = mp.mpf(alpha) + mp.mpf(gamma)
    combined = [[[f[0][i][j] + f[1][i][j] / stiffness for j in range(3)] for i in range(3)] for f in plant.forms]
    energy, discrete = [mp.mpf(0)] * 3, [mp.mpf(0)] * 3
    peak = peak_samples = mp.mpf(0)
    band, last, last_sample = mp.mpf(BAND), None, 0
    before = states[0][0]
    for k, s in enumerate(states):
        moments = []
        for w in range(3):
            form = combined[w]
            moments.append(sum(s[i] * sum(form[i][j] * s[j] for j in range(3)) for i in range(3)))
        term = s[0] ** 2 + (s[0] - before) ** 2 / stiffness
        before = s[0]
        for w in range(3):
            energy[w] += sum(comb(w, i) * mp.mpf(k) ** (w - i) * moments[i] for i in range(w + 1))
            discrete[w] += mp.mpf(k) ** w * term
        after = states[k + 1] if k + 1 < samples else [mp.mpf(0)] * 3
        pieces = [(mp.mpf(0), s[0]), (mp.mpf(1), after[0])]
        if s[1] * after[1] < 0 and max(abs(s[0]), abs(after[0])) > min(band, peak or band) / 2:
            pieces.insert(1, plant.turn(s))
        peak = max([peak, *(e for _, e in pieces)])
        peak_samples = max(peak_samples, s[0])
        if abs(s[0]) > band:
            last_sample = k + 1
        for (t0, e0), (t1, e1) in pairwise(pieces):
            if abs(e0) > band and abs(e1) <= band:
                last = (k, s, t0, t1, band if e0 > 0 else -band)
    assert last is not None
    k, s, t0, t1, level = last
    settle = k + _root(plant.series(0, s), t0, t1, level)
    result = {"settle_2pct": settle, "overshoot": peak}
    result |= {"settle_2pct_discrete": mp.mpf(last_sample), "overshoot_discrete": peak_samples}
    for w in range(3):
        result[f"energy_step_w{w}"], result[f"energy_step_w{w}_discrete"] = energy[w], discrete[w]
    return result


def _root(series: list[Any], low: Any = 0, high: Any = 1, level: Any = 0) -> Any:
    """Where a power series takes a level, by bisection."""
    low, high = mp.mpf(low), mp.mpf(high)
    sign = mp.polyval(series, low) > level
    for _ in range(90):
        middle = (low + high) / 2
        low, high = (middle, high) if (mp.polyval(series, middle) > level) == sign else (low, middle)
    return (low + high) / 2


def on_circle(gamma: float, delta: float, delay: int, angle: Any, radius: Any = 1) -> tuple[Any, Any]:
    """Return alpha and beta that put a pole pair at radius exp(+-j angle)."""
    n1, n0, trace, det = transfer(gamma, delta)
    z = radius * mp.expj(angle)
    w = -(z * z - trace * z + det) * z**delay / (n1 * z + n0)
    lever = 1 - 1 / z
    beta = w.imag / lever.imag
    return w.real - beta * lever.real, beta


def boundary() -> dict[str, Any]:
    """Alpha of the boundary's right side for 51 dampings."""
    angles = [mp.mpf(i) / 800 for i in range(20, 800)]
    curve = [on_circle(GAMMA, DELTA, DELAY, t) for t in angles]
    end = next(i for i, (a, _) in enumerate(curve) if a < 0 and i > 20)  # the first branch is back at the left side
    angles, curve = angles[:end], curve[:end]
    alpha_max, beta_max = (max(float(p[i]) for p in curve) for i in (0, 1))
    beta = np.linspace(0.0, 0.9 * beta_max, 51)
    alpha = []
    for value in beta:
        found = []
        for i in range(len(curve) - 1):
            low, high = curve[i][1] - value, curve[i + 1][1] - value
            if low * high <= 0:
                found.append(
                    mp.findroot(
                        lambda t, value=value: on_circle(GAMMA, DELTA, DELAY, t)[1] - value,
                        (angles[i], angles[i + 1]),
                        solver="anderson",
                        tol=1e-70,
                    )
                )
        alphas = [on_circle(GAMMA, DELTA, DELAY, t)[0] for t in found]
        alpha.append(max(alphas))
        for scale, expected in (("0.9999999", True), ("1.0000001", False)):
            assert inside(polynomial(GAMMA, DELTA, DELAY, alpha[-1] * mp.mpf(scale), value), 1) == expected
    return {"beta": beta.tolist(), "alpha": alpha, "alpha_max": alpha_max, "beta_max": beta_max}


def points(alpha_max: float, beta_max: float) -> dict[str, Any]:
    """Costs of stable points of a grid over the bounding box."""
    plant = Plant(GAMMA, DELTA)
    rng = np.random.default_rng(2017)
    axis_alpha, axis_beta = np.linspace(0, alpha_max, GRID), np.linspace(0, beta_max, GRID)
    rows: list[dict[str, Any]] = []
    while len(rows) < POINTS:
        i, j = int(rng.integers(1, GRID)), int(rng.integers(1, GRID))
        a, b = float(axis_alpha[i]), float(axis_beta[j])
        poly = polynomial(GAMMA, DELTA, DELAY, a, b)
        if np.abs(np.roots([float(c) for c in poly])).max() > SLOWEST or any(r["i"] == i and r["j"] == j for r in rows):
            continue
        radius = radius_of(poly)
        rows.append({"i": i, "j": j, "alpha": a, "beta": b, "radius": radius})
        rows[-1] |= costs_of(plant, a, b, GAMMA, DELAY, radius)
    return {"axis_alpha": axis_alpha.tolist(), "axis_beta": axis_beta.tolist(), "rows": rows}


def optimum() -> dict[str, Any]:
    """Optimal points for gamma = delta = 0, d = 1."""
    plant, delay = Plant(0.0, 0.0), 1

    def energy(alpha: Any, beta: Any) -> Any:
        radius = mp.mpf("0.75")
        return costs_of_mp(plant, alpha, beta, delay, int(24 * mp.log(10) / -mp.log(radius)))

    def gradient(alpha: Any, beta: Any) -> list[Any]:
        h = mp.mpf(10) ** -12
        return [
            (energy(alpha + h, beta) - energy(alpha - h, beta)) / (2 * h),
            (energy(alpha, beta + h) - energy(alpha, beta - h)) / (2 * h),
        ]

    a, b = mp.findroot(gradient, (mp.mpf("0.070228"), mp.mpf("0.471013")), tol=1e-40)

    def touch(alpha: Any, beta: Any) -> list[Any]:
        states = response(plant, alpha, beta, delay, 60)
        extrema = []
        for s, after in pairwise(states):
            if s[1] * after[1] < 0:
                extrema.append(plant.turn(s)[1])
            if len(extrema) == 2:
                break
        return [extrema[0] - mp.mpf(BAND), extrema[1] + mp.mpf(BAND)]

    sa, sb = mp.findroot(touch, (mp.mpf("0.044892"), mp.mpf("0.303749")), tol=1e-40)
    states = response(plant, sa, sb, delay, 40)
    k = max(k for k in range(12) if states[k][0] < -BAND)
    settle = k + _root(plant.series(0, states[k]), level=-mp.mpf(BAND))
    return {
        "energy_step_w0": {"alpha": a, "beta": b, "cost": energy(a, b)},
        "settle_2pct": {"alpha": sa, "beta": sb, "cost": settle},
    }


def costs_of_mp(plant: Plant, alpha: Any, beta: Any, delay: int, samples: int) -> Any:
    """Energy cost with w = 0 of a step, gamma = 0."""
    total = mp.mpf(0)
    for s in response(plant, alpha, beta, delay, samples):
        place, speed = (sum(f[i][j] * s[i] * s[j] for i in range(3) for j in range(3)) for f in plant.forms[0])
        total += place + speed / alpha
    return total


def sums(matrix: Matrix, start: list[Any], doublings: int) -> list[Matrix]:
    """Sums of k^w z z' by doubling."""
    z = mp.matrix(start)
    x0, x1, x2 = z * z.T, mp.zeros(len(start)), mp.zeros(len(start))
    power, count = matrix.copy(), mp.mpf(1)
    for _ in range(doublings):
        t = power.T
        add2, add1, add0 = (
            power * (x2 + 2 * count * x1 + count**2 * x0) * t,
            power * (x1 + count * x0) * t,
            power * x0 * t,
        )
        x0, x1, x2 = x0 + add0, x1 + add1, x2 + add2
        power, count = power * power, 2 * count
    return [x0, x1, x2]


def near_the_limit() -> list[dict[str, Any]]:
    """Energy costs at spectral radii 1 - 10^-k, d = 1 (few states keep this short)."""
    delay, angle = 1, mp.mpf("0.45")
    plant = Plant(GAMMA, DELTA)
    rows = []
    for k in range(1, 13):
        a, b = (float(v) for v in on_circle(GAMMA, DELTA, delay, angle, 1 - mp.mpf(10) ** -k))
        radius = radius_of(polynomial(GAMMA, DELTA, delay, a, b))
        assert 1 - radius < mp.mpf(10) ** -k * mp.mpf("1.01")
        n = delay + 3
        matrix = mp.zeros(n)
        for i in range(2):
            for j in range(2):
                matrix[i, j] = plant.end[i][j]
            matrix[i, delay + 1] += -(mp.mpf(a) + mp.mpf(b)) * plant.end[i][2]
            matrix[i, delay + 2] += mp.mpf(b) * plant.end[i][2]
        matrix[2, 0] = 1
        for i in range(3, n):
            matrix[i, i - 1] = 1
        start = [mp.mpf(-1)] * n
        start[1] = mp.mpf(0)
        doublings = int(mp.log(80 * mp.log(10) / -mp.log(radius), 2)) + 2
        x = sums(matrix, start, doublings)
        rows3 = mp.zeros(3, n)
        rows3[0, 0] = rows3[1, 1] = 1
        rows3[2, delay + 1], rows3[2, delay + 2] = -(mp.mpf(a) + mp.mpf(b)), mp.mpf(b)
        stiffness = mp.mpf(a) + mp.mpf(GAMMA)
        moments = []
        for w in range(3):
            form = mp.matrix(plant.forms[w][0]) + mp.matrix(plant.forms[w][1]) / stiffness
            moments.append(rows3.T * form * rows3)
        row: dict[str, Any] = {"x": float(mp.mpf(10) ** -k), "alpha": a, "beta": b, "radius_gap": 1 - radius}
        for w in range(3):
            value = mp.mpf(0)
            for i in range(w + 1):
                product = moments[i] * x[w - i]
                value += comb(w, i) * sum(product[j, j] for j in range(n))
            row[f"energy_step_w{w}"] = value
        rows.append(row)
    return rows


def plant_rows(cases: list[tuple[float, float, float]]) -> list[dict[str, Any]]:
    """Numerator and motion of plants (x, gamma, delta)."""
    rows = []
    for x, gamma, delta in cases:
        m, (n1, n0, trace, _) = motion(gamma, delta), transfer(gamma, delta)
        rows.append({"x": x, "gamma": gamma, "delta": delta, "numerator": [n1, n0], "trace": trace})
        rows[-1]["transition"] = [[m[0, 0], m[0, 1]], [m[1, 0], m[1, 1]]]
        rows[-1]["gain"] = [m[0, 2], m[1, 2]]
    return rows


def radius_row(x: float, gamma: float, delta: float, delay: int, alpha: float, beta: float) -> dict[str, Any]:
    """Spectral radius of one point, and how far it is from 1."""
    radius = radius_of(polynomial(gamma, delta, delay, alpha, beta))
    row = {"x": x, "gamma": gamma, "delta": delta, "delay": delay, "alpha": alpha, "beta": beta}
    return row | {"radius": radius, "excess": radius - 1}


def energy_over_delay(delays: tuple[int, ...]) -> list[dict[str, Any]]:
    """Energy costs at corresponding points of loops with growing delay."""
    plant = Plant(GAMMA, DELTA)
    rows = []
    for d in delays:
        row = radius_row(float(d), GAMMA, DELTA, d, 0.2 / (d + 0.5) ** 2, 0.6 / (d + 0.5))
        costs = costs_of(plant, row["alpha"], row["beta"], GAMMA, d, row["radius"])
        rows.append(row | {f"energy_step_w{w}": costs[f"energy_step_w{w}"] for w in range(3)})
    return rows


def sweeps() -> dict[str, Any]:
    """Series over one parameter each, towards where double precision gets into trouble."""
    decades = [10.0**-k for k in range(17)]
    plain = [(x, x, 0.0) for x in decades]
    damped = [(x, x, 50.0) for x in decades]
    critical = [(x, 0.25 * (1 - x * x), 1.0) for x in decades[1:]]
    strong = [(x, 1e-3, x) for x in (10.0 ** (0.5 * k) for k in range(-6, 7))]
    swing = float(mp.pi**2)
    return {
        "gamma": plant_rows(plain),
        "gamma_damped": plant_rows(damped),
        "critical": plant_rows(critical),
        "delta": plant_rows(strong),
        "delay": energy_over_delay((1, 2, 4, 8, 16, 32, 48, 64, 96, 128, 192, 256)),
        "resonant": [radius_row(10.0**-k, swing * (1 - 10.0**-k), 0.0, 1, 1e-11, 1e-11) for k in range(1, 15)],
        "limit": near_the_limit(),
    }


def general_radius(alpha: Any, beta: Any) -> Any:
    """Return the spectral radius of the loop `GENERAL` with a wall, from the matrix of one sample.

    States: position and velocity of the motor's side and of the far mass, force behind the lag, two of the filter, the
    last position, the three last commands.
    """
    g = GENERAL
    m, f = 1 - mp.mpf(g["far_mass"]), mp.mpf(g["far_mass"])
    k, c = mp.mpf(g["spring"]), mp.mpf(g["damper"])
    rates = mp.matrix(6, 6)
    rates[0, 1] = rates[2, 3] = 1
    for column, (near, far) in enumerate(((-k - g["gamma"], k), (-c - mp.mpf(g["delta"]), c), (k, -k), (c, -c))):
        rates[1, column], rates[3, column] = near / m, far / f
    rates[1, 4] = 1 / m
    rates[4, 4], rates[4, 5] = -1 / mp.mpf(g["lag"]), 1 / mp.mpf(g["lag"])
    whole = int(g["delay"])
    late = mp.mpf(g["delay"]) - whole
    first, second = mp.expm(rates * late), mp.expm(rates * (1 - late))
    # Butterworth of order two by the bilinear transform with its cut-off kept
    w = mp.tan(mp.pi * mp.mpf(g["cutoff"]))
    a0 = 1 + mp.sqrt(2) * w + w * w
    b0, a1, a2 = w * w / a0, 2 * (w * w - 1) / a0, (1 - mp.sqrt(2) * w + w * w) / a0
    loop = mp.matrix(11, 11)
    both, now = second[:5, :5] * first[:5, :5], second[:5, :5] * first[:5, 5]
    for i in range(5):
        for j in range(5):
            loop[i, j] = both[i, j]
        loop[i, 8 + whole], loop[i, 7 + whole] = now[i], second[i, 5]
    # filtered speed = b0 (x - x_before) + s1; s1' = b1 speed - a1 filtered + s2; s2' = b2 speed - a2 filtered
    filtered = {0: b0, 7: -b0, 5: mp.mpf(1)}
    for j in (0, 5, 7):
        speed = {0: 1, 7: -1}.get(j, 0)
        loop[5, j] = 2 * b0 * speed - a1 * filtered[j]
        loop[6, j] = b0 * speed - a2 * filtered[j]
        loop[8, j] = -beta * filtered[j] - (alpha if j == 0 else 0)
    loop[5, 6] = loop[7, 0] = loop[9, 8] = loop[10, 9] = 1
    return max(abs(value) for value in mp.eig(loop, left=False, right=False))


def general_loop() -> dict[str, Any]:
    """Limits of the loop with filter, lag, mode and fractional delay, and pole radii well inside."""
    betas = [float(x) for x in np.linspace(0.02, 0.16, 6)]
    with mp.workdps(40):
        limits = []
        for beta in betas:
            low, high = mp.mpf("1e-4"), mp.mpf("0.02")
            for _ in range(60):
                middle = (low + high) / 2
                low, high = (middle, high) if general_radius(middle, mp.mpf(beta)) < 1 else (low, middle)
            limits.append(low)
        alphas = [0.35 * float(limit) for limit in limits[1:5]]
        radii = [general_radius(mp.mpf(a), mp.mpf(b)) for a, b in zip(alphas, betas[1:5], strict=True)]
    return {
        "loop": GENERAL,
        "limit_beta": betas,
        "limit_alpha": limits,
        "alpha": alphas,
        "beta": betas[1:5],
        "radius": radii,
    }


def hard(device: dict[str, Any]) -> list[dict[str, Any]]:
    """Return walls of the general loop and the loops of `hard_loops` with their costs, by differential equations."""
    walls = enumerate(zip(device["alpha"], device["beta"], strict=True), start=1)
    loops = {f"general loop {i}": HardLoop(*wall, samples=1200, **device["loop"]) for i, wall in walls} | HARD_LOOPS
    names = {"settle": "settle_1pct", "overshoot": "overshoot"}
    names |= {f"energy_w{w}": f"energy_step_w{w}_discrete" for w in range(3)}
    rows = []
    for name, loop in loops.items():
        shape = {field: value for field, value in asdict(loop).items() if field != "samples"}
        rows.append({"name": name, **shape, **{names[key]: cost for key, cost in followed(loop).items()}})
    return rows


def rounded(value: Any) -> Any:
    """Turn high-precision numbers into doubles."""
    if isinstance(value, dict):
        return {k: rounded(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(v) for v in value]
    return float(value) if isinstance(value, mp.mpf) else value


def main() -> None:
    """Write the file."""
    edge = boundary()
    panel = [(0.0, g, d) for g in (1e-4, 1e-3, 0.01, 0.1, 1.0) for d in (1e-3, 0.05, 0.3, 1.5)]
    steps = {
        "plant": lambda: plant_rows(panel),
        "points": lambda: points(edge["alpha_max"], edge["beta_max"]),
        "optimum": lambda: {"gamma": 0.0, "delta": 0.0, "delay": 1, **optimum()},
        "sweeps": sweeps,
        "device": general_loop,
        "hard": lambda: hard(rounded(document["device"])),
    }
    document: dict[str, Any] = {
        "about": f"computed in {DIGITS} digits by docs/make_reference.py; inputs are exact doubles",
        "loop": {"gamma": GAMMA, "delta": DELTA, "delay": DELAY},
        "boundary": edge,
    }
    for name, compute in steps.items():
        begin = time.perf_counter()
        document[name] = compute()
        print(f"{name}: {time.perf_counter() - begin:.0f} s", flush=True)
    TARGET.parent.mkdir(parents=True, exist_ok=True)
    TARGET.write_text(json.dumps(rounded(document), indent=None, separators=(",", ":")) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
