"""Methods for the loop that others use: what `pipeline accuracy` measures this package against.

They are written as a careful user of numpy, scipy or python-control would write them, vectorised where possible, and
share nothing with the exact methods of the theory branch. Loops have an integer delay.
"""

from __future__ import annotations

import cmath
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.polynomial.legendre import leggauss
from scipy.linalg import expm

from pipeline.records.batch import Booleans, Floats

_NODES = 24
"""Gauss points over a sample for the energy; exact to rounding for the plants of the ladder."""


@dataclass(frozen=True, eq=False)
class Sampled:
    """The plant over one sample: transition (2, 2) and gain (2,)."""

    transition: Floats
    gain: Floats

    @classmethod
    def of(cls, motion: Floats) -> Sampled:
        """Return the plant from the motion of (x, v, u) over one sample, shape (3, 3)."""
        return cls(motion[:2, :2], motion[:2, 2])


@dataclass(frozen=True)
class Case:
    """A loop with integer delay d in normalised parameters."""

    gamma: float
    delta: float
    delay: int

    @property
    def plant(self) -> Sampled:
        """The sampled plant by the matrix exponential, for methods whose own error is asked for."""
        return plant_by_expm(self.gamma, self.delta)


def generator(gamma: float, delta: float) -> Floats:
    """Return the matrix of the equation of motion of (x, v, u)."""
    return np.array([[0.0, 1.0, 0.0], [-gamma, -delta, 1.0], [0.0, 0.0, 0.0]])


def plant_by_expm(gamma: float, delta: float) -> Sampled:
    """Return the sampled plant from a matrix exponential."""
    return Sampled.of(expm(generator(gamma, delta)))


def plant_by_runge_kutta(gamma: float, delta: float, steps: int) -> Sampled:
    """Return the sampled plant from classical Runge-Kutta steps."""
    a = generator(gamma, delta) / steps
    one = np.eye(3) + a @ (np.eye(3) + a @ (np.eye(3) / 2 + a @ (np.eye(3) / 6 + a / 24)))
    return Sampled.of(np.linalg.matrix_power(one, steps))


def plant_by_scipy(gamma: float, delta: float) -> Sampled:
    """Return the sampled plant from `scipy.signal.cont2discrete`, zero-order hold."""
    from scipy.signal import cont2discrete  # takes a second that the sweeps of other commands do without

    g = generator(gamma, delta)
    a, b, *_ = cont2discrete((g[:2, :2], g[:2, 2:], np.eye(2), np.zeros((2, 1))), 1.0, method="zoh")
    return Sampled(np.asarray(a), np.asarray(b)[:, 0])


def plant_by_control(gamma: float, delta: float) -> Sampled:
    """Return the sampled plant from `control.c2d`, zero-order hold."""
    control, g = import_module("control"), generator(gamma, delta)
    system = control.c2d(control.ss(g[:2, :2], g[:2, 2:], np.eye(2), np.zeros((2, 1))), 1.0, method="zoh")
    return Sampled(np.asarray(system.A), np.asarray(system.B)[:, 0])


Transfer = tuple[float, float, float, float]
"""Coefficients n1, n0, trace and determinant of (n1 z + n0)/(z^2 - trace z + determinant)."""

TransferOf = Callable[[float, float], Transfer]
"""Transfer function of the plant by gamma and delta."""


def transfer_of(plant: Sampled) -> Transfer:
    """Return the transfer function of a sampled plant."""
    (xx, xv), (vx, vv) = plant.transition.tolist()
    gx, gv = plant.gain.tolist()
    return gx, xv * gv - vv * gx, xx + vv, xx * vv - xv * vx


def transfer_by(plant: Callable[..., Sampled]) -> Callable[..., Transfer]:
    """Return a way to the transfer function from a way to the sampled plant."""
    return lambda gamma, delta, *setting: transfer_of(plant(gamma, delta, *setting))


def printed_transfer(gamma: float, delta: float) -> Transfer:
    """Return the same from the formula that the source prints.

    Source: Hulin 2017, eqs. 3.7 and 3.8. Divides by gamma and c_1.
    """
    c1 = cmath.sqrt(delta * delta - 4 * gamma)
    c2, c3 = cmath.exp(-(delta + c1) / 2), cmath.exp(-(delta - c1) / 2)
    decay = cmath.exp(-delta)
    swing = delta * (c2 - c3) / c1
    n1 = (2 - (c2 + c3) + swing) / (2 * gamma)
    n0 = (2 * decay - (c2 + c3) - swing) / (2 * gamma)
    return n1.real, n0.real, (c2 + c3).real, decay.real


transfer_by_runge_kutta = transfer_by(plant_by_runge_kutta)
transfer_by_expm = transfer_by(plant_by_expm)


def transfers() -> dict[str, TransferOf]:
    """Return ways of others to the plant's transfer function that need no setting, by name."""
    known: dict[str, TransferOf] = {
        "printed formula (3.7)": printed_transfer,
        "matrix exponential": transfer_by_expm,
        "scipy cont2discrete": transfer_by(plant_by_scipy),
    }
    return known | ({"python-control": transfer_by(plant_by_control)} if find_spec("control") else {})


def polynomials(case: Case, alpha: Floats, beta: Floats, transfer: TransferOf = printed_transfer) -> Floats:
    """Return characteristic polynomials, highest power first, shape (n, d + 4).

    Source: Hulin 2017, eq. 3.11.
    """
    delay = case.delay
    n1, n0, trace, det = transfer(case.gamma, case.delta)
    result = np.zeros((len(alpha), delay + 4))
    result[:, :3] = 1.0, -trace, det
    result[:, delay + 1] += n1 * (alpha + beta)
    result[:, delay + 2] += n0 * (alpha + beta) - n1 * beta
    result[:, delay + 3] -= n0 * beta
    return result


def radius_by_roots(case: Case, alpha: Floats, beta: Floats, transfer: TransferOf = printed_transfer) -> Floats:
    """Return the largest root modulus of each characteristic polynomial, one `np.roots` at a time."""
    return np.array([np.abs(np.roots(row)).max() for row in polynomials(case, alpha, beta, transfer)])


def held(delay: int) -> tuple[int, int]:
    """Return the places in the state of the two positions that the force of a sample depends on."""
    return (0, 2) if delay == 0 else (delay + 1, delay + 2)


def step_state(delay: int) -> Floats:
    """Return the state at the step, shape (delay + 3,): all positions one away from the final one, at rest."""
    start = np.full(delay + 3, -1.0)
    start[1] = 0.0
    return start


def matrices(case: Case, alpha: Floats, beta: Floats) -> Floats:
    """Return loop matrices over the state (x, v, x_{k-1}, ..., x_{k-d-1}), shape (n, d + 3, d + 3)."""
    plant, size = case.plant, case.delay + 3
    result = np.zeros((len(alpha), size, size))
    result[:, :2, :2] = plant.transition
    now, before = held(case.delay)
    result[:, :2, now] -= plant.gain * (alpha + beta)[:, None]
    result[:, :2, before] += plant.gain * beta[:, None]
    result[:, 2, 0] = 1.0
    result[:, np.arange(3, size), np.arange(2, size - 1)] = 1.0
    return result


def radius_by_eigenvalues(case: Case, alpha: Floats, beta: Floats) -> Floats:
    """Return the spectral radius of each loop matrix from batched eigenvalues."""
    return np.asarray(np.abs(np.linalg.eigvals(matrices(case, alpha, beta))).max(axis=1))


def radius_by_squaring(case: Case, alpha: Floats, beta: Floats, squarings: int) -> Floats:
    """Return the spectral radius as the limit of the norm of A^N to the power 1/N, N = 2^squarings."""
    power = matrices(case, alpha, beta)
    log = np.zeros(len(alpha))
    for _ in range(squarings):
        power = power @ power
        norm = np.sqrt((power * power).sum(axis=(1, 2)))
        power /= norm[:, None, None]
        log = 2 * log + np.log(norm)
    return np.exp(log / 2.0**squarings)


def _systems(case: Case, alpha: Floats, beta: Floats) -> Iterator[tuple[Any, ...]]:
    """State spaces (A, B, C, D, T) of the loop without input, whose output is the position."""
    size = case.delay + 3
    for matrix in matrices(case, alpha, beta):
        yield matrix, np.zeros((size, 1)), np.eye(1, size), np.zeros((1, 1)), 1.0


def radius_by_control(case: Case, alpha: Floats, beta: Floats) -> Floats:
    """Return spectral radii from the poles of python-control state spaces."""
    control = import_module("control")
    return np.array([np.abs(control.ss(*system).poles()).max() for system in _systems(case, alpha, beta)])


def response_by_control(case: Case, alpha: Floats, beta: Floats, samples: int) -> Floats:
    """Return the deviation at the samples of a step from `control.forced_response`, shape (samples, n)."""
    control = import_module("control")
    rest = np.arange(samples), np.zeros(samples), step_state(case.delay)
    found = (control.forced_response(control.ss(*system), *rest) for system in _systems(case, alpha, beta))
    return np.array([np.ravel(motion.outputs) for motion in found]).T


def response_by_dlsim(case: Case, alpha: Floats, beta: Floats, samples: int) -> Floats:
    """Return the deviation at the samples of a step from `scipy.signal.dlsim`, shape (samples, n)."""
    from scipy.signal import dlsim

    rest, start = np.zeros((samples, 1)), step_state(case.delay)
    found = (dlsim(system, rest, x0=start)[1] for system in _systems(case, alpha, beta))
    return np.array([np.asarray(position)[:, 0] for position in found]).T


def march(case: Case, alpha: Floats, beta: Floats, samples: int) -> Iterator[tuple[Floats, Floats, Floats, Floats]]:
    """Yield deviation, velocity, input and former deviation at the start of each sample of a step, shape (n,) each.

    Deviations from the final position, relative to the final displacement.
    """
    x, v = np.full(len(alpha), -1.0), np.zeros(len(alpha))
    before, forces = x, [alpha] * case.delay
    plant = case.plant
    (xx, xv), (vx, vv) = plant.transition.tolist()
    gx, gv = plant.gain.tolist()
    for _ in range(samples):
        forces.append(-alpha * x - beta * (x - before))
        u = forces.pop(0)
        yield x, v, u, before
        before, x, v = x, xx * x + xv * v + gx * u, vx * x + vv * v + gv * u


def response(case: Case, alpha: Floats, beta: Floats, samples: int) -> Floats:
    """Return deviation, velocity and input at the start of each sample of a step, shape (samples, 3, n)."""
    states = np.empty((samples, 3, len(alpha)))
    for state, (x, v, u, _) in zip(states, march(case, alpha, beta, samples), strict=True):
        state[:] = x, v, u
    return states


def dense(case: Case, alpha: Floats, beta: Floats, samples: int, fine: int) -> tuple[Floats, Floats]:
    """Return position and velocity of a step at ``fine`` points a sample, each of shape (samples fine, n)."""
    states = response(case, alpha, beta, samples)
    one, row = expm(generator(case.gamma, case.delta) / fine), np.eye(3)
    rows = []
    for _ in range(fine):
        rows.append(row[:2])
        row = one @ row
    both = np.einsum("fri,kin->rkfn", np.array(rows), states, optimize=True)
    return both[0].reshape(samples * fine, -1), both[1].reshape(samples * fine, -1)


def settling_of(position: Floats, fine: int, band: float) -> Floats:
    """Return the last entry into the band, interpolated along straight lines; NaN where there is none."""
    outside = np.abs(position) > band
    last = len(position) - 1 - np.argmax(outside[::-1], axis=0)
    column = np.arange(position.shape[1])
    following = np.minimum(last + 1, len(position) - 1)
    here, there = position[last, column], position[following, column]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (np.abs(here) - band) / np.abs(here - there)
    return np.where(outside[-1] | ~outside.any(axis=0), np.nan, (last + share) / fine)


def energy_of(position: Floats, velocity: Floats, case: Case, alpha: Floats, fine: int, w: int) -> Floats:
    """Return the energy cost of a step by the trapezoidal rule over dense points.

    Source: Hulin 2017, eqs. 5.7 and 5.14.
    """
    energy = position**2 + velocity**2 / (alpha + case.gamma)
    time = np.arange(len(position)) / fine
    weights = time**w / fine
    weights[[0, -1]] *= 0.5
    return np.asarray(weights @ energy)


def forms(case: Case, w: int) -> tuple[Floats, Floats]:
    """Return the integrals of tau^w p p' over a sample, for position and velocity, by Gauss quadrature."""
    nodes, weights = leggauss(_NODES)
    time = 0.5 * (nodes + 1)
    rows = np.array([expm(generator(case.gamma, case.delta) * t)[:2] for t in time])
    weight = 0.5 * weights * time**w
    place, speed = (np.einsum("t,ti,tj->ij", weight, rows[:, i], rows[:, i]) for i in (0, 1))
    return place, speed


def truncated_energy(case: Case, alpha: Floats, beta: Floats, samples: int) -> dict[int, Floats]:
    """Return the energy costs of a step summed over a fixed number of samples, exact within each."""
    states = response(case, alpha, beta, samples)
    stiffness = alpha + case.gamma
    moments = []
    for w in range(3):
        place, speed = forms(case, w)
        both = [np.einsum("kin,ij,kjn->kn", states, form, states, optimize=True) for form in (place, speed)]
        moments.append(both[0] + both[1] / stiffness)
    k = np.arange(samples, dtype=np.float64)
    zero, first, second = moments
    return {
        0: zero.sum(axis=0),
        1: k @ zero + first.sum(axis=0),
        2: (k * k) @ zero + 2 * (k @ first) + second.sum(axis=0),
    }


def lyapunov_energy(case: Case, alpha: Floats, beta: Floats) -> dict[int, Floats]:
    """Return the energy costs of a step from discrete Lyapunov equations (scipy), one after another."""
    from scipy.linalg import solve_discrete_lyapunov

    start = step_state(case.delay)
    rows = np.zeros((3, len(start)))
    rows[0, 0] = rows[1, 1] = 1.0
    now, before = held(case.delay)
    parts = [forms(case, w) for w in range(3)]
    result: dict[int, list[float]] = {0: [], 1: [], 2: []}
    for a, b, matrix in zip(alpha, beta, matrices(case, alpha, beta), strict=True):
        rows[2] = 0.0
        rows[2, now], rows[2, before] = -(a + b), b
        x0 = solve_discrete_lyapunov(matrix, np.outer(start, start))
        x1 = solve_discrete_lyapunov(matrix, matrix @ x0 @ matrix.T)
        x2 = solve_discrete_lyapunov(matrix, matrix @ (2 * x1 + x0) @ matrix.T)
        m = [rows.T @ (place + speed / (a + case.gamma)) @ rows for place, speed in parts]
        result[0].append(float((m[0] * x0).sum()))
        result[1].append(float((m[0] * x1).sum() + (m[1] * x0).sum()))
        result[2].append(float((m[0] * x2).sum() + 2 * (m[1] * x1).sum() + (m[2] * x0).sum()))
    return {w: np.array(values) for w, values in result.items()}


def discrete_map(case: Case, alpha: Floats, beta: Floats, samples: int) -> dict[str, Floats]:
    """Return stability and the discrete costs of all points from a recurrence of fixed length.

    Settling time NaN where the response is outside the band at its end; all NaN where not stable.
    """
    stable: Booleans = radius_by_eigenvalues(case, alpha, beta) < 1
    a, b = alpha[stable], beta[stable]
    settle, peak, energy = np.zeros(len(a)), np.zeros(len(a)), [np.zeros(len(a)) for _ in range(3)]
    for k, (x, _, _, before) in enumerate(march(case, a, b, samples)):
        term = x * x + (x - before) ** 2 / (a + case.gamma)
        settle[np.abs(x) > 0.02] = k + 1
        np.maximum(peak, x, out=peak)
        for w in range(3):
            energy[w] += float(k) ** w * term
    values = {"settle_2pct": np.where(settle == samples, np.nan, settle), "overshoot": peak}
    values |= {f"energy_step_w{w}": energy[w] for w in range(3)}
    result = {name: np.full(len(alpha), np.nan) for name in values}
    for name, column in values.items():
        result[name][stable] = column
    return result
