"""Numerical stability: error of each method along paths towards the limits of double precision."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from typing import Any, TypeVar

import numpy as np

from pipeline.loop.loop import LARGEST_DELAY, Loop
from pipeline.records.accuracy import OURS, WRONG, Sweep
from pipeline.records.batch import Booleans, Floats
from pipeline.studies.accuracy import methods
from pipeline.studies.accuracy.ladder import FAILURES, largest
from pipeline.studies.accuracy.methods import Case
from pipeline.studies.accuracy.theory_ladders import case_of, loop_of, own_energies, own_plant, reference
from pipeline.theory.limits import is_inside
from pipeline.theory.poles import is_stable, spectral_radius

PLANT_SWEEPS = ("gamma", "gamma_damped", "critical", "delta")
RADIUS_SWEEPS = ("delay", "resonant")
QUICK_DELAY = 64
"""Largest delay of a quick run."""

MARGINS = range(1, 15)
"""Relative distances 10^-k from the boundary."""

WEIGHTS = (0, 1, 2)

SHORT, LONG = 512, 8192
"""Horizons of the truncated recurrence near the limit of stability."""

_SQUARINGS = 40
"""2^40 samples: the norm of a power of the loop matrix tells the spectral radius to rounding."""

_ROOTS, _EIGENVALUES = "polynomial roots", "eigenvalues, matrix exponential"

Row = dict[str, Any]
"""A point of a path: its abscissa x, the loop and wall there, and the exact values."""

Verdict = tuple[float, bool]
"""Spectral radius, and whether the point counts as stable."""

Energy = Callable[[Case, Floats, Floats], dict[int, Floats]]
Errors = Sequence[float | None]

_T = TypeVar("_T")


def sweeps(quick: bool) -> Iterator[Sweep]:
    """Yield all sweeps, each by all methods; a quick run leaves out the largest delays, which take longest."""
    longest = QUICK_DELAY if quick else LARGEST_DELAY
    paths: dict[str, list[Row]] = reference()["sweeps"]
    paths = {name: [row for row in rows if row.get("delay", 0) <= longest] for name, rows in paths.items()}
    for name in PLANT_SWEEPS:
        for method, transfer in _transfers().items():
            yield _sweep(name, method, paths[name], [_attempt(_plant_error, transfer, row) for row in paths[name]])
    for name in RADIUS_SWEEPS:
        for method, judge in _radii().items():
            yield _radius_sweep(name, method, judge, paths[name])
    for method, inside in _judges().items():
        yield _margin_sweep(method, inside)
    for method, energy in _energies().items():
        found = [_attempt(_energy_errors, energy, row, row["delay"]) or {} for row in paths["delay"]]
        yield _sweep("delay_energy", method, paths["delay"], [worst([f.get(w) for w in WEIGHTS]) for f in found])
        found = [_attempt(_energy_errors, energy, row, 1) or {} for row in paths["limit"]]
        for w in WEIGHTS:
            yield _sweep(f"limit_w{w}", method, paths["limit"], [f.get(w) for f in found])


def starts_wrong(x: Sequence[float], errors: Errors, wrong: Sequence[bool] | None = None) -> float | None:
    """Return the first x, in the order of the sweep, at which a result is wrong."""
    for i, (place, error) in enumerate(zip(x, errors, strict=True)):
        if error is None or error > WRONG or (wrong is not None and wrong[i]):
            return place
    return None


def worst(errors: Errors) -> float | None:
    """Return the largest error, None if a result is missing."""
    known = [e for e in errors if e is not None]
    return max(known) if known and len(known) == len(errors) else None


def _attempt(function: Callable[..., _T], *arguments: Any) -> _T | None:
    """Result of a method, None where it cannot give one."""
    try:
        with np.errstate(all="ignore"):
            return function(*arguments)
    except FAILURES:
        return None


def _sweep(name: str, method: str, path: Sequence[Row], errors: Errors, wrong: Sequence[bool] | None = None) -> Sweep:
    x = [row["x"] for row in path]
    return Sweep(
        sweep=name,
        method=method,
        x=tuple(x),
        error=tuple(errors),
        starts=starts_wrong(x, errors, wrong),
        worst=worst(errors),
        wrong_verdicts=None if wrong is None else sum(wrong),
    )


def _transfers() -> dict[str, methods.TransferOf]:
    """Ways to the plant's transfer function."""
    runge_kutta = methods.transfer_by(partial(methods.plant_by_runge_kutta, steps=256))
    return methods.transfers() | {"Runge-Kutta, 256 steps": runge_kutta, OURS: methods.transfer_by(own_plant)}


def _plant_error(transfer: methods.TransferOf, row: Row) -> float | None:
    found, exact = np.array(transfer(row["gamma"], row["delta"])[:2]), np.array(row["numerator"])
    return largest((found - exact) / exact)[0] if np.isfinite(found).all() else None


def _radii() -> dict[str, Callable[[Row], Verdict]]:
    """Ways to a verdict on a point."""
    known = {
        _ROOTS: _judged_by(methods.radius_by_roots, methods.transfer_by_expm),
        _EIGENVALUES: _judged_by(methods.radius_by_eigenvalues),
        "squaring of the loop matrix": _judged_by(methods.radius_by_squaring, _SQUARINGS),
    }
    if find_spec("control"):
        known["python-control, state space"] = _judged_by(methods.radius_by_control)
    return known | {OURS: _own_verdict}


def _judged_by(radius: Callable[..., Floats], *more: object) -> Callable[[Row], Verdict]:
    def judge(row: Row) -> Verdict:
        found = float(radius(case_of(row), np.array([row["alpha"]]), np.array([row["beta"]]), *more)[0])
        return found, found < 1

    return judge


def _own_verdict(row: Row) -> Verdict:
    point = loop_of(row), row["alpha"], row["beta"]
    return float(spectral_radius(*point)[0]), bool(is_stable(*point)[0])


def _radius_sweep(name: str, method: str, judge: Callable[[Row], Verdict], path: Sequence[Row]) -> Sweep:
    found = [_attempt(judge, row) for row in path]
    errors = [f and abs(f[0] - row["radius"]) / row["radius"] for f, row in zip(found, path, strict=True)]
    wrong = [f is None or f[1] != (row["excess"] < 0) for f, row in zip(found, path, strict=True)]
    return _sweep(name, method, path, errors, wrong)


def _energies() -> dict[str, Energy]:
    """Ways to the energy costs of a step, by weight."""
    known: dict[str, Energy] = {"Lyapunov equations (scipy)": methods.lyapunov_energy}
    for samples in (SHORT, LONG):
        known[f"truncated recurrence, {samples} samples"] = partial(methods.truncated_energy, samples=samples)
    return known | {OURS: lambda case, *wall: own_energies(Loop(case.gamma, case.delta, float(case.delay)), *wall)}


def _energy_errors(energy: Energy, row: Row, delay: int) -> dict[int, float]:
    """Relative error of each weight at one point; none of a weight without a number."""
    case = replace(case_of(reference()["loop"]), delay=delay)
    found = energy(case, np.array([row["alpha"]]), np.array([row["beta"]]))
    pairs = {w: (float(found[w][0]), float(row[f"energy_step_w{w}"])) for w in WEIGHTS}
    return {w: abs(value - exact) / exact for w, (value, exact) in pairs.items() if np.isfinite(value)}


def _judges() -> dict[str, Callable[[Floats, Floats], Booleans]]:
    """Ways to verdicts next to the boundary."""
    entry = reference()["loop"]
    case, loop = case_of(entry), loop_of(entry)
    return {
        _ROOTS: lambda alpha, beta: methods.radius_by_roots(case, alpha, beta) < 1,
        _EIGENVALUES: lambda alpha, beta: methods.radius_by_eigenvalues(case, alpha, beta) < 1,
        OURS: lambda alpha, beta: is_inside(loop, alpha, beta),
    }


def _margin_sweep(method: str, inside: Callable[[Floats, Floats], Booleans]) -> Sweep:
    """Share of wrong verdicts at points a little inside and outside the boundary."""
    entry = reference()["boundary"]
    alpha, beta = np.array(entry["alpha"]), np.array(entry["beta"])
    path = [{"x": 10.0**-k} for k in MARGINS]
    shares = []
    for row in path:
        within, beyond = (inside(alpha * (1 + sign * row["x"]), beta) for sign in (-1, 1))
        shares.append(float(np.mean(np.concatenate([~within, beyond]))))
    return _sweep("margin", method, path, shares)
