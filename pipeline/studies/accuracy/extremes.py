"""Measure the error of each method in stiff and extreme cases, along parameter paths to the limits of double
precision."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from pipeline.base.json_object import JsonObject
from pipeline.loop.normalised_loop import LARGEST_DELAY
from pipeline.records.accuracy import OURS, WRONG, Sweep
from pipeline.studies.accuracy.measure import FAILURES, largest
from pipeline.studies.accuracy.peers import Case
from pipeline.studies.accuracy.theory import ENERGY, PLANTS, RADII, case_of, installed_radii, normalised_loop, reference
from pipeline.theory.boundary import is_inside
from pipeline.theory.poles import is_stable

QUICK_DELAY = 64
"""Largest delay of a quick run, because larger delays take most of the time."""

MARGINS = range(1, 15)
"""Relative distances 10^-k from the boundary."""

Point = JsonObject
"""Point of a path in the file of reference values, with its abscissa x, its loop and wall, and the exact values."""

Errors = Sequence[float | None]

_T = TypeVar("_T")


def sweeps(quick: bool) -> Iterator[Sweep]:
    """Yield all paths with all methods. A quick run stops at a delay of `QUICK_DELAY`."""
    paths: dict[str, list[Point]] = reference()["sweeps"]
    longest = QUICK_DELAY if quick else LARGEST_DELAY
    paths = {name: [row for row in rows if row.get("delay", 0) <= longest] for name, rows in paths.items()}
    for name in ("gamma", "gamma_damped", "critical", "delta"):
        for method, plant in PLANTS.items():
            yield _sweep(name, method, paths[name], [_attempt(_plant_error, plant, row) for row in paths[name]])
    for name in ("delay", "resonant"):
        for method, radius in installed_radii().items():
            yield _radius_sweep(name, method, radius, paths[name])
    yield from _margins()
    case = case_of(reference()["loop"])
    for method, of in ENERGY.items():
        found = [_attempt(_energy_errors, of, row, replace(case, delay=row["delay"])) for row in paths["delay"]]
        yield _sweep("delay_energy", method, paths["delay"], [worst(each or (None,)) for each in found])
        found = [_attempt(_energy_errors, of, row, replace(case, delay=1)) for row in paths["limit"]]
        for w in range(3):
            yield _sweep(f"limit_w{w}", method, paths["limit"], [each[w] if each else None for each in found])


def starts_wrong(x: Sequence[float], errors: Errors, wrong: Sequence[bool] | None = None) -> float | None:
    """Return the first x along the path at which a result is wrong, or None."""
    for i, (place, error) in enumerate(zip(x, errors, strict=True)):
        if error is None or error > WRONG or (wrong is not None and wrong[i]):
            return place
    return None


def worst(errors: Errors) -> float | None:
    """Return the largest error, or None if a result is missing."""
    known = [e for e in errors if e is not None]
    return max(known) if known and len(known) == len(errors) else None


def _attempt(function: Callable[..., _T], *arguments: Any) -> _T | None:
    """Return the result of a method, or None if it fails."""
    try:
        with np.errstate(all="ignore"):
            return function(*arguments)
    except FAILURES:
        return None


def _sweep(name: str, method: str, path: Sequence[Point], errors: Errors, wrong: Sequence[bool] | None = None) -> Sweep:
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


def _plant_error(of: Callable[[float, float], tuple[float, float]], row: Point) -> float | None:
    found, exact = np.array(of(row["gamma"], row["delta"])), np.array(row["numerator"])
    return largest((found - exact) / exact)[0] if np.isfinite(found).all() else None


def _radius_sweep(name: str, method: str, of: Callable[..., Any], path: Sequence[Point]) -> Sweep:
    """Return errors of the spectral radius, and wrong verdicts. The verdicts of this package are those of `is_stable`,
    which does not use the radius."""
    walls = [(case_of(row), np.array([row["alpha"]]), np.array([row["beta"]])) for row in path]
    found = [_attempt(lambda *wall: float(of(*wall)[0]), *wall) for wall in walls]
    stable = [radius is not None and radius < 1 for radius in found]
    if method == OURS:
        stable = [bool(is_stable(normalised_loop(row), *wall[1:])[0]) for row, wall in zip(path, walls, strict=True)]
    errors = [f and abs(f - row["radius"]) / row["radius"] for f, row in zip(found, path, strict=True)]
    missing = [f is None for f in found]
    wrong = [m or s != (row["excess"] < 0) for m, s, row in zip(missing, stable, path, strict=True)]
    return _sweep(name, method, path, errors, wrong)


def _energy_errors(of: Callable[..., Any], row: Point, case: Case) -> list[float | None]:
    """Return the relative error of the energy cost with each weight at a point, or None if a cost has no value."""
    found = np.asarray(of(case, np.array([row["alpha"]]), np.array([row["beta"]])))[:, 0]
    exact = [row[f"energy_step_w{w}"] for w in range(3)]
    return [abs(f - e) / e if np.isfinite(f) else None for f, e in zip(found.tolist(), exact, strict=True)]


def _margins() -> Iterator[Sweep]:
    """Yield shares of wrong verdicts at points slightly inside and outside the boundary."""
    case, loop = case_of(reference()["loop"]), normalised_loop(reference()["loop"])
    alpha, beta = (np.array(reference()["boundary"][name]) for name in ("alpha", "beta"))
    path = [{"x": 10.0**-k} for k in MARGINS]
    for method in ("polynomial roots", "eigenvalues", OURS):
        shares = []
        for row in path:
            walls = [(alpha * (1 + sign * row["x"]), beta) for sign in (-1, 1)]
            inside = [is_inside(loop, *wall) if method == OURS else RADII[method](case, *wall) < 1 for wall in walls]
            shares.append(float(np.mean(np.concatenate([~inside[0], inside[1]]))))
        yield _sweep("margin", method, path, shares)
