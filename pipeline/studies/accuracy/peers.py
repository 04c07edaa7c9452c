"""Common methods for limits, responses, costs and optima. `pipeline accuracy` compares this package with them.

They are written as a careful user of numpy, scipy or python-control would write them, and vectorised if possible. They
share no code with the exact methods of theory. Loops have an integer delay.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
from numpy.polynomial.legendre import leggauss
from scipy.linalg import expm, solve_discrete_lyapunov
from scipy.optimize import minimize
from scipy.signal import cont2discrete, dlsim

from pipeline.records.trials import Floats

_NODES = 24
"""Number of Gauss points in a sample for the energy. The quadrature is exact up to rounding for the plants of the
study."""

_GRID = 11
"""Number of grid points per axis and round of an iterated gridding. The next round covers two cells on each side of the
best point."""

BAND = 0.02
"""Settling band of the compared methods and of the reference values."""

Points = Callable[[Floats, Floats], Floats]
"""Function that returns a number for each point (alpha, beta)."""


@dataclass(frozen=True)
class Case:
    """A loop with integer delay d in normalised parameters."""

    gamma: float
    delta: float
    delay: int


def generator(gamma: float, delta: float) -> Floats:
    """Return the matrix of the equation of motion of (x, v, u)."""
    return np.array([[0.0, 1.0, 0.0], [-gamma, -delta, 1.0], [0.0, 0.0, 0.0]])


def plant_by_expm(gamma: float, delta: float) -> Floats:
    """Return the sampled plant from a matrix exponential."""
    return np.array(expm(generator(gamma, delta))[:2])


def plant_by_runge_kutta(gamma: float, delta: float, steps: int = 128) -> Floats:
    """Return the sampled plant from classical Runge-Kutta steps."""
    a = generator(gamma, delta) / steps
    one = np.eye(3) + a @ (np.eye(3) + a @ (np.eye(3) / 2 + a @ (np.eye(3) / 6 + a / 24)))
    return np.linalg.matrix_power(one, steps)[:2]


def plant_by_scipy(gamma: float, delta: float) -> Floats:
    """Return the sampled plant from `scipy.signal.cont2discrete`, zero-order hold."""
    g = generator(gamma, delta)
    a, b, *_ = cont2discrete((g[:2, :2], g[:2, 2:], np.eye(2), np.zeros((2, 1))), 1.0, method="zoh")
    return np.hstack((a, b))


def numerator(plant: Floats) -> tuple[float, float]:
    """Return n1 and n0 of (n1 z + n0)/(z^2 - trace z + determinant)."""
    (_, xv, gx), (_, vv, gv) = plant.tolist()
    return gx, xv * gv - vv * gx


def printed_numerator(gamma: float, delta: float) -> tuple[float, float]:
    """Return n1 and n0 from the printed formula of the source, which divides by gamma and c_1.

    Source: Hulin 2017, eqs. 3.7 and 3.8.
    """
    c1 = cmath.sqrt(delta * delta - 4 * gamma)
    c2, c3 = cmath.exp(-(delta + c1) / 2), cmath.exp(-(delta - c1) / 2)
    decay = cmath.exp(-delta)
    swing = delta * (c2 - c3) / c1
    n1 = (2 - (c2 + c3) + swing) / (2 * gamma)
    n0 = (2 * decay - (c2 + c3) - swing) / (2 * gamma)
    return n1.real, n0.real


def radius_by_roots(case: Case, alpha: Floats, beta: Floats) -> Floats:
    """Return the largest root modulus of each characteristic polynomial. `np.roots` is called once for each polynomial.

    Source: Hulin 2017, eq. 3.11.
    """
    plant, delay = plant_by_expm(case.gamma, case.delta), case.delay
    n1, n0 = numerator(plant)
    result = np.zeros((len(alpha), delay + 4))
    result[:, :3] = 1.0, -plant[0, 0] - plant[1, 1], plant[0, 0] * plant[1, 1] - plant[0, 1] * plant[1, 0]
    result[:, delay + 1] += n1 * (alpha + beta)
    result[:, delay + 2] += n0 * (alpha + beta) - n1 * beta
    result[:, delay + 3] -= n0 * beta
    return np.array([np.abs(np.roots(row)).max() for row in result])


def held(delay: int) -> tuple[int, int]:
    """Return the indices of the two positions in the state that determine the force of a sample."""
    return (0, 2) if delay == 0 else (delay + 1, delay + 2)


def step_state(delay: int) -> Floats:
    """Return the state at the step, shape (delay + 3,).

    The device is at rest, and all positions are one unit below the final position.
    """
    start = np.full(delay + 3, -1.0)
    start[1] = 0.0
    return start


def matrices(case: Case, alpha: Floats, beta: Floats) -> Floats:
    """Return loop matrices over the state (x, v, x_{k-1}, ..., x_{k-d-1}), shape (n, d + 3, d + 3)."""
    plant, size = plant_by_expm(case.gamma, case.delta), case.delay + 3
    result = np.zeros((len(alpha), size, size))
    result[:, :2, :2] = plant[:, :2]
    now, before = held(case.delay)
    result[:, :2, now] -= plant[:, 2] * (alpha + beta)[:, None]
    result[:, :2, before] += plant[:, 2] * beta[:, None]
    result[:, 2, 0] = 1.0
    result[:, np.arange(3, size), np.arange(2, size - 1)] = 1.0
    return result


def radius_by_eigenvalues(case: Case, alpha: Floats, beta: Floats) -> Floats:
    """Return the spectral radius of each loop matrix from batched eigenvalues."""
    return np.asarray(np.abs(np.linalg.eigvals(matrices(case, alpha, beta))).max(axis=1))


def radius_by_squaring(matrix: Floats, squarings: int) -> Floats:
    """Return the spectral radius as the limit of the norm of A^N to the power 1/N, N = 2^squarings."""
    power, log = matrix, np.zeros(len(matrix))
    for _ in range(squarings):
        power = power @ power
        norm = np.linalg.norm(power, axis=(1, 2))
        power, log = power / norm[:, None, None], 2 * log + np.log(norm)
    return np.exp(log / 2.0**squarings)


def _systems(case: Case, alpha: Floats, beta: Floats) -> Iterator[tuple[Any, ...]]:
    """Yield state spaces (A, B, C, D, T) of the loop without input. The output is the position."""
    size = case.delay + 3
    for matrix in matrices(case, alpha, beta):
        yield matrix, np.zeros((size, 1)), np.eye(1, size), np.zeros((1, 1)), 1.0


def radius_by_control(case: Case, alpha: Floats, beta: Floats) -> Floats:
    """Return spectral radii from the poles of python-control state spaces."""
    control = import_module("control")
    return np.array([np.abs(control.ss(*system).poles()).max() for system in _systems(case, alpha, beta)])


def response_by_dlsim(case: Case, alpha: Floats, beta: Floats, samples: int) -> Floats:
    """Return the sampled deviation of a step response as computed by `scipy.signal.dlsim`, shape (samples, n)."""
    rest, start = np.zeros((samples, 1)), step_state(case.delay)
    found = (dlsim(system, rest, x0=start)[1] for system in _systems(case, alpha, beta))
    return np.array([np.asarray(position)[:, 0] for position in found]).T


def response(case: Case, alpha: Floats, beta: Floats, samples: int) -> Floats:
    """Return deviation, velocity and input at the start of each sample of a step, shape (samples, 3, n).

    Deviations are measured from the final position, relative to the final displacement.
    """
    plant, states = plant_by_expm(case.gamma, case.delta), np.empty((samples, 3, len(alpha)))
    x, v = np.full(len(alpha), -1.0), np.zeros(len(alpha))
    before, forces = x, [alpha] * case.delay
    for state in states:
        forces.append(-alpha * x - beta * (x - before))
        state[:] = x, v, forces.pop(0)
        before = x
        x, v = (row[0] * state[0] + row[1] * state[1] + row[2] * state[2] for row in plant)
    return states


def dense(case: Case, alpha: Floats, beta: Floats, samples: int, fine: int) -> tuple[Floats, Floats]:
    """Return position and velocity of a step at ``fine`` points per sample, each of shape (samples fine, n)."""
    rows = np.array([expm(generator(case.gamma, case.delta) * k / fine)[:2] for k in range(fine)])
    both = np.einsum("fri,kin->rkfn", rows, response(case, alpha, beta, samples), optimize=True)
    return both[0].reshape(samples * fine, -1), both[1].reshape(samples * fine, -1)


def settling_of(position: Floats, fine: int) -> Floats:
    """Return the time of the last entry into the band, interpolated linearly, or NaN if there is none."""
    outside = np.abs(position) > BAND
    last = len(position) - 1 - np.argmax(outside[::-1], axis=0)
    column = np.arange(position.shape[1])
    following = np.minimum(last + 1, len(position) - 1)
    here, there = position[last, column], position[following, column]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (np.abs(here) - BAND) / np.abs(here - there)
    return np.where(outside[-1] | ~outside.any(axis=0), np.nan, (last + share) / fine)


def energy_of(position: Floats, velocity: Floats, case: Case, alpha: Floats, fine: int) -> Floats:
    """Return the energy costs of a step by the trapezoidal rule over dense points, shape (3 weights, n).

    Source: Hulin 2017, eqs. 5.7 and 5.14.
    """
    energy = position**2 + velocity**2 / (alpha + case.gamma)
    weights = (np.arange(len(position)) / fine) ** np.arange(3)[:, None] / fine
    weights[:, [0, -1]] *= 0.5
    return np.asarray(weights @ energy)


@cache
def _forms(case: Case) -> list[tuple[Floats, Floats]]:
    """Return the integrals of tau^w p p' over a sample for each weight, for position and velocity.

    They are computed by Gauss quadrature.
    """
    nodes, weights = leggauss(_NODES)
    time = 0.5 * (nodes + 1)
    rows = np.array([expm(generator(case.gamma, case.delta) * t)[:2] for t in time])
    scaled = [0.5 * weights * time**w for w in range(3)]
    place, speed = ([np.einsum("t,ti,tj->ij", s, rows[:, i], rows[:, i]) for s in scaled] for i in (0, 1))
    return list(zip(place, speed, strict=True))


def truncated_energy(case: Case, alpha: Floats, beta: Floats, samples: int) -> Floats:
    """Return the energy costs of a step, summed over a fixed number of samples and exact within each sample, shape (3,
    n)."""
    states, stiffness, moments = response(case, alpha, beta, samples), alpha + case.gamma, []
    for place, speed in _forms(case):
        both = [np.einsum("kin,ij,kjn->kn", states, form, states, optimize=True) for form in (place, speed)]
        moments.append(both[0] + both[1] / stiffness)
    k = np.arange(samples, dtype=np.float64)
    zero, first, second = moments
    w2 = (k * k) @ zero + 2 * (k @ first) + second.sum(axis=0)
    return np.stack((zero.sum(axis=0), k @ zero + first.sum(axis=0), w2))


def lyapunov_energy(case: Case, alpha: Floats, beta: Floats) -> Floats:
    """Return the energy costs of a step from discrete Lyapunov equations (scipy), one for each point, shape (3, n)."""
    start, parts = step_state(case.delay), _forms(case)
    rows, (now, before) = np.zeros((3, len(start))), held(case.delay)
    rows[0, 0] = rows[1, 1] = 1.0
    result = []
    for a, b, matrix in zip(alpha, beta, matrices(case, alpha, beta), strict=True):
        rows[2] = 0.0
        rows[2, now], rows[2, before] = -(a + b), b
        x0 = solve_discrete_lyapunov(matrix, np.outer(start, start))
        x1 = solve_discrete_lyapunov(matrix, matrix @ x0 @ matrix.T)
        x2 = solve_discrete_lyapunov(matrix, matrix @ (2 * x1 + x0) @ matrix.T)
        m = [rows.T @ (place + speed / (a + case.gamma)) @ rows for place, speed in parts]
        w0, w1 = (m[0] * x0).sum(), (m[0] * x1).sum() + (m[1] * x0).sum()
        result.append((w0, w1, (m[0] * x2).sum() + 2 * (m[1] * x1).sum() + (m[2] * x0).sum()))
    return np.array(result).T


def sampled_costs(case: Case, alpha: Floats, beta: Floats, samples: int) -> Floats:
    """Return settling time, overshoot and the three energies from samples of a step of fixed length, shape (5, n)."""
    x = response(case, alpha, beta, samples)[:, 0]
    k, energy = (
        np.arange(samples, dtype=np.float64),
        x**2 + np.diff(x, axis=0, prepend=x[:1]) ** 2 / (alpha + case.gamma),
    )
    settle = np.where(np.abs(x) > BAND, k[:, None] + 1, 0.0).max(axis=0)
    settled = np.where(settle == samples, np.nan, settle)
    return np.array((settled, np.maximum(x.max(axis=0), 0.0), *(k**w @ energy for w in range(3))))


def bisect_limit(radius: Points, beta: Floats, high: float, tolerance: float) -> Floats:
    """Return the largest stable alpha below ``high`` for each beta, by a batched scan and bisection."""
    scan = np.linspace(0, high, _GRID)
    alpha, many = (g.ravel() for g in np.meshgrid(scan[1:-1], beta))
    stable = (radius(alpha, many) < 1).reshape(len(beta), -1)
    last = np.where(stable.any(axis=1), stable.shape[1] - np.argmax(stable[:, ::-1], axis=1), 0)
    low, up = scan[last], scan[last + 1]
    for _ in range(math.ceil(math.log2(1 / (tolerance * (_GRID - 1))))):
        middle = 0.5 * (low + up)
        inside = radius(middle, beta) < 1
        low, up = np.where(inside, middle, low), np.where(inside, up, middle)
    return np.asarray(0.5 * (low + up))


def grid_limit(case: Case, beta: Floats, high: float, tolerance: float) -> Floats:
    """Return the largest stable alpha for each beta by the method of the source, with poles on increasingly fine grids.

    Source: Hulin 2017, sec. 3.4, with poles of the transfer function (3.9) at each grid point.
    """
    result = np.empty(len(beta))
    for i, value in enumerate(beta):
        low, up = 0.0, high
        while up - low > tolerance * high:
            alpha = np.linspace(low, up, _GRID)[1:-1]
            stable = radius_by_roots(case, alpha, np.full(len(alpha), value)) < 1
            last = len(alpha) - int(np.argmax(stable[::-1])) if stable.any() else 0
            edges = np.concatenate([[low], alpha, [up]])
            low, up = float(edges[last]), float(edges[last + 1])
        result[i] = 0.5 * (low + up)
    return result


def grid_optimum(cost: Points, high: tuple[float, float], tolerance: float) -> tuple[float, float]:
    """Return the best point of increasingly fine grids. Each grid covers two cells on each side of the best point so
    far.

    Source: Hulin 2017, sec. 5.1.2 (gridding with thresholds as in 3.4).
    """
    centre, half = np.array(high) / 2, np.array(high) / 2
    while float((half / high).max()) > tolerance:
        axes = (np.linspace(c - h, c + h, _GRID) for c, h in zip(centre, half, strict=True))
        alpha, beta = (g.ravel() for g in np.meshgrid(*axes))
        best = int(np.argmin(cost(alpha, beta)))
        centre, half = np.array([alpha[best], beta[best]]), half * 4 / (_GRID - 1)
    return float(centre[0]), float(centre[1])


def nelder_mead(cost: Points, start: tuple[float, float], tolerance: float) -> tuple[float, float]:
    """Return the result of a Nelder-Mead simplex search from one start, with a tolerance relative to the start."""
    options = {"xatol": tolerance * min(start), "fatol": np.inf, "maxiter": 400}
    found = minimize(lambda p: float(cost(p[:1], p[1:])[0]), start, method="Nelder-Mead", options=options)
    return float(found.x[0]), float(found.x[1])
