"""Each quantity by each method over a ladder of settings: what is run, and how its error is taken.

An error is the largest one over all reference points: relative, but for overshoot, which is relative to the final
displacement already. A result that a method could not give counts as an error of 1.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np

from pipeline.accuracy import accuracy_methods as methods
from pipeline.accuracy import accuracy_optional as optional
from pipeline.accuracy import accuracy_searches as searches
from pipeline.records.accuracy import OURS, reference_file
from pipeline.records.batch import Floats
from pipeline.theory.energy import energy_costs
from pipeline.theory.loop import Loop
from pipeline.theory.maps import cost_maps
from pipeline.theory.optimum import optimal_point
from pipeline.theory.plant import flow
from pipeline.theory.region import region, stiffness_limit
from pipeline.theory.stability import spectral_radius
from pipeline.theory.transient import transient_costs

BAND = 0.02
"""Settling band of the ladder; that of the reference values."""

DENSE_SAMPLES = 2048
"""Horizon of the dense simulation: the slowest reference point has decayed to 1e-7 there."""

SEARCH_SAMPLES = 256
"""Horizon of the responses inside the searches for an optimum, whose best points settle within 30 samples."""

STARTS = ((0.05, 0.3), (0.02, 0.5), (0.1, 0.6))
"""Starts of Nelder-Mead inside the stable region, whose optima lie at (0.070, 0.471) and (0.045, 0.304)."""

MAP_CRITERIA = ("settle_2pct", "overshoot", "energy_step_w0", "energy_step_w1", "energy_step_w2")

TRANSIENT = ("settling time", "overshoot")
ENERGIES = ("energy, w = 0", "energy, w = 1", "energy, w = 2")
QUANTITIES = (
    *("plant", "boundary", "spectral radius", *TRANSIENT, *ENERGIES),
    *("optimum of energy", "optimum of settling time", "map"),
)


@dataclass(frozen=True)
class Trial:
    """One method at one setting, and the errors that follow from its result, by quantity."""

    quantities: tuple[str, ...]
    method: str
    setting: str
    run: Callable[[], Any]
    errors: Callable[[Any], dict[str, float]]


@cache
def reference() -> dict[str, Any]:
    """Return the high-precision values that ship with the package (made by docs/make_reference.py)."""
    document: dict[str, Any] = json.loads(reference_file().read_text(encoding="utf-8"))
    return document


def worst(found: Floats, exact: Floats, *, relative: bool = True) -> float:
    """Return the largest error; a missing number counts as 1."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        error = np.abs(found - exact) / (np.abs(exact) if relative else 1.0)
    return float(np.where(np.isfinite(error), error, 1.0).max())


def trials(quick: bool) -> Iterator[Trial]:
    """Yield all that is to be measured."""
    yield from _plant(quick)
    yield from _boundary(quick)
    yield from _radius(quick)
    yield from _responses(quick)
    yield from _optima(quick)
    yield from _map(quick)


def _case() -> methods.Case:
    entry = reference()["loop"]
    return methods.Case(entry["gamma"], entry["delta"], entry["delay"])


def _loop() -> Loop:
    entry = reference()["loop"]
    return Loop(entry["gamma"], entry["delta"], float(entry["delay"]))


def _exact_plant() -> methods.Sampled:
    """Plant for methods whose own error is asked for: the matrix exponential, good to 1e-15 here."""
    entry = reference()["loop"]
    return methods.plant_by_expm(entry["gamma"], entry["delta"])


def _plant(quick: bool) -> Iterator[Trial]:
    rows = reference()["plant"]
    exact = np.array([row["numerator"] for row in rows])

    def errors(found: Any) -> dict[str, float]:
        return {"plant": worst(np.array([transfer[:2] for transfer in found]), exact)}

    def each(function: Callable[[float, float], Any]) -> Callable[[], Any]:
        return lambda: [function(row["gamma"], row["delta"]) for row in rows]

    def by(plant: Callable[[float, float], methods.Sampled]) -> Callable[[], Any]:
        return each(lambda gamma, delta: methods.transfer_of(plant(gamma, delta)))

    def ours(gamma: float, delta: float) -> methods.Sampled:
        motion = flow(gamma, delta, 1.0)
        return methods.Sampled(motion.transition, motion.gain)

    one = partial(Trial, ("plant",), errors=errors)
    yield one("printed formula (3.7)", "one setting", each(methods.printed_transfer))
    for steps in (1, 16, 128) if quick else (1, 2, 4, 8, 16, 32, 64, 128, 256):
        run = by(partial(methods.plant_by_runge_kutta, steps=steps))
        yield one("simulation (Runge-Kutta)", f"{steps} steps", run)
    for terms in (4, 8, 16) if quick else (2, 4, 6, 8, 10, 12, 16, 20, 24):
        run = by(partial(methods.plant_by_taylor, terms=terms))
        yield one("Taylor series", f"{terms} terms", run)
    yield one("matrix exponential", "one setting", by(methods.plant_by_expm))
    if linalg := optional.load("scipy.linalg"):
        yield one("scipy expm", "one setting", by(partial(optional.plant_by_scipy_expm, linalg)))
    if signal := optional.load("scipy.signal"):
        yield one("scipy cont2discrete", "one setting", by(partial(optional.plant_by_scipy_signal, signal)))
    if control := optional.load("control"):
        yield one("python-control", "c2d", by(partial(optional.plant_by_control, control)))
    yield one(OURS, "one setting", by(ours))


def _boundary(quick: bool) -> Iterator[Trial]:
    entry = reference()["boundary"]
    beta, exact, high = np.array(entry["beta"]), np.array(entry["alpha"]), 1.1 * entry["alpha_max"]
    case, loop = _case(), _loop()

    def eigenvalues(alpha: Floats, damping: Floats) -> Floats:
        return methods.radius_by_eigenvalues(_exact_plant(), case.delay, alpha, damping)

    def roots(alpha: Floats, damping: Floats) -> Floats:
        transfer = methods.printed_transfer(case.gamma, case.delta)
        return methods.radius_by_roots(methods.polynomials(transfer, case.delay, alpha, damping))

    def ours() -> Floats:
        region.cache_clear()
        return stiffness_limit(loop, beta)

    one = partial(Trial, ("boundary",), errors=lambda found: {"boundary": worst(found, exact)})
    for tolerance in (1e-2, 1e-5) if quick else (1e-2, 1e-4, 1e-6, 1e-8, 1e-10):
        setting = f"tolerance {tolerance:.0e}"
        yield one("gridding with poles (3.4)", setting, partial(searches.grid_limit, case, beta, high, tolerance))
    for tolerance in (1e-2, 1e-6, 1e-10) if quick else (1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-14):
        setting = f"tolerance {tolerance:.0e}"
        run = partial(searches.bisect_limit, eigenvalues, beta, high, tolerance)
        yield one("eigenvalues and bisection", setting, run)
    for tolerance in (1e-2, 1e-6) if quick else (1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12):
        setting = f"tolerance {tolerance:.0e}"
        yield one(
            "polynomial roots and bisection", setting, partial(searches.bisect_limit, roots, beta, high, tolerance)
        )
    if control := optional.load("control"):

        def poles(alpha: Floats, damping: Floats) -> Floats:
            return optional.radius_by_control_states(control, _exact_plant(), case.delay, alpha, damping)

        for tolerance in (1e-2,) if quick else (1e-2, 1e-5, 1e-8):
            run = partial(searches.bisect_limit, poles, beta, high, tolerance)
            yield one("python-control", f"poles and bisection, {tolerance:.0e}", run)
    yield one(OURS, "closed form", ours)


def _points() -> tuple[Floats, Floats, dict[str, Floats]]:
    rows = reference()["points"]["rows"]
    columns = {name: np.array([row[name] for row in rows], dtype=np.float64) for name in rows[0]}
    return columns["alpha"], columns["beta"], columns


def _radius(quick: bool) -> Iterator[Trial]:
    alpha, beta, exact = _points()
    case, loop = _case(), _loop()

    def errors(found: Floats) -> dict[str, float]:
        return {"spectral radius": worst(found, exact["radius"])}

    def transfer() -> tuple[float, float, float, float]:
        return methods.printed_transfer(case.gamma, case.delta)

    one = partial(Trial, ("spectral radius",), errors=errors)

    def squared(squarings: int) -> Floats:
        return methods.radius_by_squaring(_exact_plant(), case.delay, alpha, beta, squarings)

    for squarings in (4, 16) if quick else (2, 4, 6, 8, 12, 16, 20, 24, 30, 40):
        yield one(
            "squaring of the loop matrix",
            f"{squarings} squarings",
            partial(squared, squarings),
        )
    yield one(
        "polynomial roots, one by one",
        "numpy.roots of (3.11)",
        lambda: methods.radius_by_roots(methods.polynomials(transfer(), case.delay, alpha, beta)),
    )
    yield one(
        "polynomial roots, batched",
        "companion matrices",
        lambda: methods.radius_by_companion(methods.polynomials(transfer(), case.delay, alpha, beta)),
    )
    if control := optional.load("control"):
        yield one(
            "python-control",
            "state space",
            lambda: optional.radius_by_control_states(control, _exact_plant(), case.delay, alpha, beta),
        )
        yield one(
            "python-control, transfer function",
            "transfer function",
            lambda: optional.radius_by_control_transfer(control, transfer(), case.delay, alpha, beta),
        )
    yield one(OURS, "eigenvalues, batched", lambda: spectral_radius(loop, alpha, beta))


def _responses(quick: bool) -> Iterator[Trial]:
    alpha, beta, exact = _points()
    case, loop = _case(), _loop()

    def transient(found: tuple[Floats, Floats]) -> dict[str, float]:
        settle = worst(found[0], exact["settle_2pct"])
        return {"settling time": settle, "overshoot": worst(found[1], exact["overshoot"], relative=False)}

    def energies(found: dict[int, Floats]) -> dict[str, float]:
        return {name: worst(found[w], exact[f"energy_step_w{w}"]) for w, name in enumerate(ENERGIES)}

    def simulate(fine: int) -> tuple[Floats, Floats]:
        return methods.dense(_exact_plant(), case, alpha, beta, DENSE_SAMPLES, fine)

    def read_transient(position: Floats, fine: int) -> tuple[Floats, Floats]:
        return methods.settling_of(position, fine, BAND), np.maximum(position.max(axis=0), 0.0)

    def read_energies(fine: int) -> dict[int, Floats]:
        position, velocity = simulate(fine)
        return {w: methods.energy_of(position, velocity, case, alpha, fine, w) for w in range(3)}

    def by_simulation(fine: int) -> tuple[Floats, Floats]:
        return read_transient(simulate(fine)[0], fine)

    def by_library(function: Callable[..., Floats], samples: int) -> tuple[Floats, Floats]:
        return read_transient(function(_exact_plant(), case, alpha, beta, samples), 1)

    def truncated(samples: int) -> dict[int, Floats]:
        return methods.truncated_energy(_exact_plant(), case, alpha, beta, samples)

    def lyapunov(solve: object) -> dict[int, Floats]:
        return methods.lyapunov_energy(_exact_plant(), case, alpha, beta, solve)

    def ours_transient() -> tuple[Floats, Floats]:
        costs = transient_costs(loop, alpha, beta, (BAND,))
        return costs["settle_2pct"], costs["overshoot"]

    def ours_energies() -> dict[int, Floats]:
        costs = energy_costs(loop, alpha, beta)
        return {w: costs[f"energy_step_w{w}"] for w in range(3)}

    ladder = (1, 4, 16) if quick else (1, 2, 4, 8, 16, 32, 64)
    for fine in ladder:
        run = partial(by_simulation, fine)
        yield Trial(TRANSIENT, "dense simulation", f"{fine} points a sample", run, transient)
    for samples in (256,) if quick else (256, 512, 1024):
        found = f"{samples} samples"
        if signal := optional.load("scipy.signal"):
            library = partial(by_library, partial(optional.response_by_dlsim, signal), samples)
            yield Trial(TRANSIENT, "scipy dlsim", found, library, transient)
        if control := optional.load("control"):
            library = partial(by_library, partial(optional.response_by_control, control), samples)
            yield Trial(TRANSIENT, "python-control", found, library, transient)
    yield Trial(TRANSIENT, OURS, "exact", ours_transient, transient)
    for fine in ladder:
        yield Trial(ENERGIES, "dense simulation", f"{fine} points a sample", partial(read_energies, fine), energies)
    for samples in (64, 512) if quick else (64, 128, 256, 512, 1024, 2048, 4096, 8192):
        setting = f"{samples} samples"
        yield Trial(ENERGIES, "truncated recurrence", setting, partial(truncated, samples), energies)
    solvers: list[tuple[str, Any]] = [("Lyapunov equations (numpy)", None)]
    if linalg := optional.load("scipy.linalg"):
        solvers.append(("Lyapunov equations (scipy)", linalg.solve_discrete_lyapunov))
    for name, solve in solvers:
        yield Trial(ENERGIES, name, "one setting", partial(lyapunov, solve), energies)
    yield Trial(ENERGIES, OURS, "exact sum", ours_energies, energies)


def _optima(quick: bool) -> Iterator[Trial]:
    entry = reference()["optimum"]
    case = methods.Case(entry["gamma"], entry["delta"], entry["delay"])
    loop = Loop(entry["gamma"], entry["delta"], float(entry["delay"]))
    plant = methods.plant_by_expm(case.gamma, case.delta)
    high = (0.3, 1.0)  # around the stable region of d = 1

    def stable_cost(alpha: Floats, beta: Floats, fine: int, criterion: str) -> Floats:
        result = np.full(len(alpha), np.inf)
        use = np.flatnonzero(alpha > 0)
        use = use[methods.radius_by_eigenvalues(plant, case.delay, alpha[use], beta[use]) < 1]
        a, b = alpha[use], beta[use]
        for i in range(0, len(a), 512):  # bounds the memory of the dense motion
            part = slice(i, i + 512)
            position, velocity = methods.dense(plant, case, a[part], b[part], SEARCH_SAMPLES, fine)
            if criterion == "settle_2pct":
                cost = methods.settling_of(position, fine, BAND)
            else:
                cost = methods.energy_of(position, velocity, case, a[part], fine, 0)
            result[use[part]] = np.where(np.isfinite(cost), cost, np.inf)
        return result

    for criterion, quantity in (("energy_step_w0", "optimum of energy"), ("settle_2pct", "optimum of settling time")):
        exact = np.array([entry[criterion]["alpha"], entry[criterion]["beta"]])

        def errors(found: Any, exact: Floats = exact, quantity: str = quantity) -> dict[str, float]:
            return {quantity: worst(np.array(found[:2]), exact)}

        def ours(criterion: str = criterion) -> tuple[float, float]:
            point = optimal_point.__wrapped__(loop, criterion)  # without its cache
            return point.alpha, point.beta

        one = partial(Trial, (quantity,), errors=errors)
        cost = partial(stable_cost, fine=8, criterion=criterion)
        for points in (11,) if quick else (11, 31, 71):
            yield one("plain grid", f"{points} x {points}", partial(searches.grid_optimum, cost, high, points))
        for tolerance in (1e-2,) if quick else (1e-1, 1e-2, 1e-3, 1e-5):
            run = partial(searches.iterated_grid_optimum, cost, high, tolerance)
            yield one("iterated gridding (5.1.2)", f"tolerance {tolerance:.0e}", run)
        for tolerance in (1e-2,) if quick else (1e-1, 1e-2, 1e-4, 1e-6):
            run = partial(searches.nelder_mead, cost, STARTS[0], 0.2, tolerance)
            yield one("Nelder-Mead, one start", f"tolerance {tolerance:.0e}", run)
        yield one(OURS, "global search", ours)


def _map(quick: bool) -> Iterator[Trial]:
    entry = reference()["points"]
    case, loop = _case(), _loop()
    axes = [np.array(entry[name]) for name in ("axis_alpha", "axis_beta")]
    usable = axes[0] > 0  # at alpha = 0 the wall does not hold the device
    rows, columns = (np.array([row[name] for row in entry["rows"]]) for name in ("j", "i"))
    alpha, beta = (g.ravel() for g in np.meshgrid(axes[0][usable], axes[1]))
    skipped = int((~usable).sum())
    exact = _points()[2]

    def errors(found: dict[str, Floats]) -> dict[str, float]:
        largest = 0.0
        for name in MAP_CRITERIA:
            values = found[name].reshape(len(axes[1]), -1)[rows, columns - skipped]
            error = worst(values, exact[f"{name}_discrete"], relative=name != "overshoot")
            largest = max(largest, error)
        return {"map": largest}

    def truncated(samples: int) -> dict[str, Floats]:
        return methods.discrete_map(_exact_plant(), case, alpha, beta, samples)

    one = partial(Trial, ("map",), errors=errors)
    for samples in (128, 512) if quick else (64, 128, 256, 512, 1024, 2048):
        yield one("eigenvalues and truncated recurrence", f"{samples} samples", partial(truncated, samples))
    yield one(OURS, "61 x 61 points", lambda: cost_maps(loop, axes[0][usable], axes[1], MAP_CRITERIA))
