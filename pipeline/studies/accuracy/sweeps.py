"""Numerical stability: error of each method along paths towards the limits of double precision."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from pipeline.accuracy import accuracy_methods as methods
from pipeline.accuracy import accuracy_optional as optional
from pipeline.accuracy.accuracy_ladders import reference, worst
from pipeline.base.errors import PipelineError
from pipeline.records.accuracy import OURS, Sweep, largest, starts_wrong
from pipeline.records.batch import Booleans, Floats
from pipeline.theory.energy import energy_costs
from pipeline.theory.loop import LARGEST_DELAY, Loop
from pipeline.theory.plant import flow
from pipeline.theory.region import is_inside
from pipeline.theory.stability import is_stable, spectral_radius

FAILURES = (ArithmeticError, np.linalg.LinAlgError, PipelineError, ValueError)
"""What a method raises that cannot give a number; anything else is a defect here."""

PLANT_SWEEPS = ("gamma", "gamma_damped", "critical", "delta")
RADIUS_SWEEPS = ("delay", "resonant")
QUICK_DELAY = 64
"""Largest delay of a quick run."""

MARGINS = range(1, 15)
"""Relative distances 10^-k from the boundary."""

KRONECKER = "Lyapunov equations (numpy)"
"""Needs a linear system of (d + 3)^2 unknowns: not along the delays."""

WEIGHTS = (0, 1, 2)

SHORT, LONG = 512, 8192
"""Horizons of the truncated recurrence near the limit of stability."""

_SQUARINGS = 40
"""2^40 samples: the norm of a power of the loop matrix tells the spectral radius to rounding."""

Energy = Callable[[methods.Case, Floats, Floats], dict[int, Floats]]
Transfer = Callable[[float, float], tuple[float, float, float, float]]


@dataclass(frozen=True)
class _Verdict:
    radius: float
    stable: bool


def sweeps(quick: bool) -> Iterator[Sweep]:
    """Yield all sweeps, each by all methods; a quick run leaves out the largest delays, which take longest."""
    largest_delay = QUICK_DELAY if quick else LARGEST_DELAY
    for name in PLANT_SWEEPS:
        yield from (_plant_sweep(name, method, transfer) for method, transfer in _transfers())
    for name in RADIUS_SWEEPS:
        yield from (_radius_sweep(name, method, radius, largest_delay) for method, radius in _radii())
    yield from (_margin_sweep(method, judge) for method, judge in _judges())
    energies = list(_energies())
    yield from (
        _delay_energy_sweep(method, energy, largest_delay) for method, energy in energies if method != KRONECKER
    )
    for method, energy in energies:
        yield from _limit_sweeps(method, energy)


def _transfers() -> Iterator[tuple[str, Transfer]]:
    def by(plant: Callable[[float, float], methods.Sampled]) -> Transfer:
        return lambda gamma, delta: methods.transfer_of(plant(gamma, delta))

    def ours(gamma: float, delta: float) -> methods.Sampled:
        motion = flow(gamma, delta, 1.0)
        return methods.Sampled(motion.transition, motion.gain)

    yield "printed formula (3.7)", methods.printed_transfer
    yield "matrix exponential", by(methods.plant_by_expm)
    yield "Taylor series, 24 terms", by(partial(methods.plant_by_taylor, terms=24))
    yield "Runge-Kutta, 256 steps", by(partial(methods.plant_by_runge_kutta, steps=256))
    if linalg := optional.load("scipy.linalg"):
        yield "scipy expm", by(partial(optional.plant_by_scipy_expm, linalg))
    if control := optional.load("control"):
        yield "python-control", by(partial(optional.plant_by_control, control))
    yield OURS, by(ours)


def _plant_sweep(name: str, method: str, transfer: Transfer) -> Sweep:
    rows = reference()["sweeps"][name]
    errors: list[float | None] = []
    for row in rows:
        try:
            with np.errstate(all="ignore"):
                found = np.array(transfer(row["gamma"], row["delta"])[:2])
            errors.append(worst(found, np.array(row["numerator"])) if np.isfinite(found).all() else None)
        except FAILURES:
            errors.append(None)
    return _sweep(name, method, [row["x"] for row in rows], errors)


def _radii() -> Iterator[tuple[str, Callable[[dict[str, Any]], _Verdict]]]:
    def plain(function: Callable[[methods.Case, Floats, Floats], Floats]) -> Callable[[dict[str, Any]], _Verdict]:
        def judge(row: dict[str, Any]) -> _Verdict:
            case = methods.Case(row["gamma"], row["delta"], row["delay"])
            radius = float(function(case, np.array([row["alpha"]]), np.array([row["beta"]]))[0])
            return _Verdict(radius, radius < 1)

        return judge

    def polynomial(case: methods.Case, alpha: Floats, beta: Floats) -> Floats:
        transfer = methods.transfer_of(methods.plant_by_expm(case.gamma, case.delta))
        return methods.polynomials(transfer, case.delay, alpha, beta)

    def states(case: methods.Case, alpha: Floats, beta: Floats) -> Floats:
        return methods.radius_by_eigenvalues(methods.plant_by_expm(case.gamma, case.delta), case.delay, alpha, beta)

    def squaring(case: methods.Case, alpha: Floats, beta: Floats) -> Floats:
        plant = methods.plant_by_expm(case.gamma, case.delta)
        return methods.radius_by_squaring(plant, case.delay, alpha, beta, _SQUARINGS)

    def ours(row: dict[str, Any]) -> _Verdict:
        loop = Loop(row["gamma"], row["delta"], float(row["delay"]))
        radius = float(spectral_radius(loop, row["alpha"], row["beta"])[0])
        return _Verdict(radius, bool(is_stable(loop, row["alpha"], row["beta"])[0]))

    yield "polynomial roots", plain(lambda case, a, b: methods.radius_by_roots(polynomial(case, a, b)))
    yield "eigenvalues, matrix exponential", plain(states)
    yield "squaring of the loop matrix", plain(squaring)
    if control := optional.load("control"):

        def by_states(case: methods.Case, alpha: Floats, beta: Floats) -> Floats:
            plant = methods.plant_by_expm(case.gamma, case.delta)
            return optional.radius_by_control_states(control, plant, case.delay, alpha, beta)

        def by_transfer(case: methods.Case, alpha: Floats, beta: Floats) -> Floats:
            transfer = methods.transfer_of(methods.plant_by_expm(case.gamma, case.delta))
            return optional.radius_by_control_transfer(control, transfer, case.delay, alpha, beta)

        yield "python-control, state space", plain(by_states)
        yield "python-control, transfer function", plain(by_transfer)
    yield OURS, ours


def _radius_sweep(name: str, method: str, judge: Callable[[dict[str, Any]], _Verdict], largest_delay: int) -> Sweep:
    rows = [row for row in reference()["sweeps"][name] if row["delay"] <= largest_delay]
    errors: list[float | None] = []
    wrong = []
    for row in rows:
        try:
            with np.errstate(all="ignore"):
                found = judge(row)
            errors.append(abs(found.radius - row["radius"]) / row["radius"])
            wrong.append(found.stable != (row["excess"] < 0))
        except FAILURES:
            errors.append(None)
            wrong.append(True)
    return _sweep(name, method, [row["x"] for row in rows], errors, wrong)


def _energies() -> Iterator[tuple[str, Energy]]:
    def plant(case: methods.Case) -> methods.Sampled:
        return methods.plant_by_expm(case.gamma, case.delta)

    def ours(case: methods.Case, alpha: Floats, beta: Floats) -> dict[int, Floats]:
        costs = energy_costs(Loop(case.gamma, case.delta, float(case.delay)), alpha, beta)
        return {w: costs[f"energy_step_w{w}"] for w in WEIGHTS}

    yield KRONECKER, lambda case, a, b: methods.lyapunov_energy(plant(case), case, a, b)
    if linalg := optional.load("scipy.linalg"):
        solve = linalg.solve_discrete_lyapunov
        yield "Lyapunov equations (scipy)", lambda case, a, b: methods.lyapunov_energy(plant(case), case, a, b, solve)
    for samples in (SHORT, LONG):
        run = partial(_truncated, samples=samples)
        yield f"truncated recurrence, {samples} samples", run
    yield OURS, ours


def _truncated(case: methods.Case, alpha: Floats, beta: Floats, samples: int) -> dict[int, Floats]:
    plant = methods.plant_by_expm(case.gamma, case.delta)
    return methods.truncated_energy(plant, case, alpha, beta, samples)


def _limit_sweeps(method: str, energy: Energy) -> Iterator[Sweep]:
    rows = reference()["sweeps"]["limit"]
    errors = [_energy_errors(energy, row, 1) for row in rows]
    for w in WEIGHTS:
        yield _sweep(f"limit_w{w}", method, [row["x"] for row in rows], [e[w] for e in errors])


def _delay_energy_sweep(method: str, energy: Energy, largest_delay: int) -> Sweep:
    rows = [row for row in reference()["sweeps"]["delay"] if row["delay"] <= largest_delay]
    errors = [largest(_energy_errors(energy, row, row["delay"])) for row in rows]
    return _sweep("delay_energy", method, [row["x"] for row in rows], errors)


def _energy_errors(energy: Energy, row: dict[str, Any], delay: int) -> list[float | None]:
    """Relative error of each weight at one point; None without a number."""
    entry = reference()["loop"]
    try:
        with np.errstate(all="ignore"):
            found = energy(
                methods.Case(entry["gamma"], entry["delta"], delay), np.array([row["alpha"]]), np.array([row["beta"]])
            )
    except FAILURES:
        return [None] * len(WEIGHTS)
    values = [(float(found[w][0]), float(row[f"energy_step_w{w}"])) for w in WEIGHTS]
    return [abs(value - exact) / exact if np.isfinite(value) else None for value, exact in values]


def _margin_sweep(method: str, judge: Callable[[Floats, Floats], Booleans]) -> Sweep:
    """Share of wrong verdicts at points a little inside and outside the boundary."""
    entry = reference()["boundary"]
    alpha, beta = np.array(entry["alpha"]), np.array(entry["beta"])
    margins = [10.0**-k for k in MARGINS]
    shares: list[float | None] = []
    for margin in margins:
        inside, outside = (judge(alpha * (1 + sign * margin), beta) for sign in (-1, 1))
        shares.append(float(np.mean(np.concatenate([~inside, outside]))))
    return _sweep("margin", method, margins, shares)


def _judges() -> Iterator[tuple[str, Callable[[Floats, Floats], Booleans]]]:
    entry = reference()["loop"]
    case = methods.Case(entry["gamma"], entry["delta"], entry["delay"])
    plant = methods.plant_by_expm(case.gamma, case.delta)
    loop = Loop(case.gamma, case.delta, float(case.delay))

    def roots(alpha: Floats, beta: Floats) -> Booleans:
        printed = methods.printed_transfer(case.gamma, case.delta)
        return np.asarray(methods.radius_by_roots(methods.polynomials(printed, case.delay, alpha, beta)) < 1)

    def states(alpha: Floats, beta: Floats) -> Booleans:
        return np.asarray(methods.radius_by_eigenvalues(plant, case.delay, alpha, beta) < 1)

    yield "polynomial roots", roots
    yield "eigenvalues, matrix exponential", states
    yield OURS, lambda alpha, beta: is_inside(loop, alpha, beta)


def _sweep(
    name: str, method: str, x: list[float], errors: list[float | None], wrong: list[bool] | None = None
) -> Sweep:
    return Sweep(
        sweep=name,
        method=method,
        x=tuple(x),
        error=tuple(errors),
        starts=starts_wrong(x, errors, wrong),
        worst=largest(errors),
        wrong_verdicts=None if wrong is None else sum(wrong),
    )
