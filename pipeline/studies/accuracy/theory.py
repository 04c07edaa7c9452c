"""Provide reference values for limits, responses, costs and optima of loops, and a table with a row for each method.

The truth is given by reference values that are shipped with the package (docs/make_reference.py). The error of a method
is the largest error over all reference points. Errors are relative, except for overshoot, which is already relative to
the final displacement. A missing result counts as an error of 1.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial
from importlib.util import find_spec
from itertools import count
from typing import Any

import numpy as np

from pipeline.base.json_object import JsonObject
from pipeline.device.parts import Butterworth
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.loop.state_space import Plant
from pipeline.records.accuracy import OURS, reference_file
from pipeline.records.trials import Floats
from pipeline.studies.accuracy import peers
from pipeline.studies.accuracy.measure import Row, Table, Values
from pipeline.studies.accuracy.peers import Case
from pipeline.theory.boundary import stiffness_limit
from pipeline.theory.costs import cost_maps, point_costs_by_name
from pipeline.theory.optimum import optimal_point
from pipeline.theory.poles import spectral_radius
from pipeline.theory.settling_overshoot import LONGEST

ENERGIES = ("energy, w = 0", "energy, w = 1", "energy, w = 2")
COSTS = {"settling time": "settle_2pct", "overshoot": "overshoot"}
COSTS |= {quantity: f"energy_step_w{w}" for w, quantity in enumerate(ENERGIES)}
"""Quantities of a response, and their criteria."""

HARD = {"settling time, hard loops": "settle_1pct", "overshoot, hard loops": "overshoot"}
OWN_ENERGIES = {quantity: COSTS[quantity] for quantity in ENERGIES}
HARD |= {f"{quantity}, hard loops": f"{name}_discrete" for quantity, name in OWN_ENERGIES.items()}
OPTIMA = {"optimum of energy": "energy_step_w0", "optimum of settling time": "settle_2pct"}
GENERAL = ("boundary, general loop", "spectral radius, general loop")

PEER = "python-control"

DENSE_SAMPLES = 2048
"""Horizon of the dense simulation, at which the slowest reference point has decayed to 1e-7."""

SEARCH_SAMPLES, SEARCH_FINE = 256, 8
"""Horizon and points per sample in the searches for an optimum. The optima settle within 30 samples."""

SEARCH_BOX, START = (0.3, 1.0), (0.05, 0.3)
"""Largest alpha and beta of the searches for d = 1, and the start of a search.

The optima are at (0.070, 0.471) and (0.045, 0.304).
"""

_TOLERANCE, _SAMPLES = "tolerance {:.0e}", "{} samples"
_FINE = "{} points a sample", (1, 4, 16, 64), 3
_Method = Callable[[Case, Floats, Floats], Floats]
_repetition = count()


@cache
def reference() -> JsonObject:
    """Return the high-precision values that are shipped with the package (made by docs/make_reference.py)."""
    document: JsonObject = json.loads(reference_file().read_text(encoding="utf-8"))
    return document


def case_of(entry: JsonObject) -> Case:
    """Return the loop of a reference entry in the form that the common methods take."""
    return Case(entry["gamma"], entry["delta"], entry["delay"])


def normalised_loop(entry: JsonObject) -> NormalisedLoop:
    """Return the loop of a reference entry in the form that this package uses."""
    numbers = {"lag": entry.get("lag", 0.0), "load_mass": entry.get("far_mass", 0.0)}
    if numbers["load_mass"]:
        numbers |= {"spring": entry["spring"], "spring_damping": entry["damper"]}
    order, cutoff = entry.get("order", 2), entry.get("cutoff")
    velocity = Butterworth(kind="butterworth", order=order, cutoff_hz=cutoff) if cutoff else None
    return NormalisedLoop(Plant(1.0, entry["delta"], entry["gamma"], **numbers), float(entry["delay"]), velocity)


def unknown(loop: NormalisedLoop) -> NormalisedLoop:
    """Return a loop without cached results of earlier calls. The damping is increased by a few rounding errors."""
    return loop.with_delta(loop.delta + next(_repetition) * 2.0**-57)


def own_numerator(gamma: float, delta: float) -> tuple[float, float]:
    """Return n1 and n0 of the sampled plant as computed by this package."""
    matrix, push, _, _ = NormalisedLoop.ideal(gamma, delta, 0.0).open_loop
    return peers.numerator(np.column_stack((matrix[:2, :2], push[:2])))


def own_costs(loop: NormalisedLoop, alpha: Floats, beta: Floats, names: Mapping[str, str]) -> Values:
    """Return costs by quantity as computed by this package."""
    found = point_costs_by_name(loop, alpha, beta, list(names.values()), LONGEST)
    return {quantity: found[name] for quantity, name in names.items()}


PLANTS: dict[str, Callable[[float, float], tuple[float, float]]] = {
    "printed formula (3.7)": peers.printed_numerator,
    "matrix exponential": lambda *loop: peers.numerator(peers.plant_by_expm(*loop)),
    "scipy cont2discrete": lambda *loop: peers.numerator(peers.plant_by_scipy(*loop)),
    "Runge-Kutta, 128 steps": lambda *loop: peers.numerator(peers.plant_by_runge_kutta(*loop)),
    OURS: own_numerator,
}
"""Methods for the numerator of the sampled plant."""

RADII: dict[str, _Method] = {
    "polynomial roots": peers.radius_by_roots,
    "eigenvalues": peers.radius_by_eigenvalues,
    "squaring of the loop matrix": lambda case, *wall: peers.radius_by_squaring(peers.matrices(case, *wall), 40),
    PEER: peers.radius_by_control,
    OURS: lambda case, *wall: spectral_radius(normalised_loop(vars(case)), *wall),
}
"""Methods for the spectral radius."""


def installed_radii() -> dict[str, _Method]:
    """Return the methods for the spectral radius that need no optional library, or whose library is installed."""
    return {name: method for name, method in RADII.items() if name != PEER or find_spec("control")}


ENERGY: dict[str, _Method] = {
    "truncated recurrence, 512 samples": partial(peers.truncated_energy, samples=512),
    "truncated recurrence, 8192 samples": partial(peers.truncated_energy, samples=8192),
    "Lyapunov equations (scipy)": peers.lyapunov_energy,
    OURS: lambda case, a, b: np.array([*own_costs(normalised_loop(vars(case)), a, b, OWN_ENERGIES).values()]),
}
"""Methods for the energies of a step, shape (3, n)."""


def theory_tables() -> Iterator[Table]:
    """Yield the tables of the ideal loop, then the tables of loops with parts."""
    known = reference()["points"]
    case, loop = case_of(reference()["loop"]), normalised_loop(reference()["loop"])
    points = {name: np.array([row[name] for row in known["rows"]]) for name in known["rows"][0]}
    wall = points["alpha"], points["beta"]
    plants = reference()["plant"]
    yield Table(
        {"plant": np.array([row["numerator"] for row in plants])},
        [
            Row(name, _one("plant", lambda of=of: [of(row["gamma"], row["delta"]) for row in plants]))
            for name, of in PLANTS.items()
        ],
    )
    yield _edge(case, loop)
    quantity = "spectral radius"
    radii = [Row(name, _one(quantity, of, case, *wall)) for name, of in installed_radii().items()]
    yield Table({quantity: points["radius"]}, radii)
    yield _costs(case, loop, points)
    yield from (_optimum(quantity, criterion) for quantity, criterion in OPTIMA.items())
    yield _map(case, loop, known)
    yield from _with_parts()


def _one(quantity: str, run: Callable[..., Any], *first: Any) -> Callable[..., Values]:
    """Return a function that wraps the result of ``run`` for a setting as values of a quantity."""
    return lambda *setting: {quantity: np.asarray(run(*first, *setting))}


def _edge(case: Case, loop: NormalisedLoop) -> Table:
    """Return the table of the boundary: the largest stable alpha for each beta."""
    edge = reference()["boundary"]
    beta, high = np.array(edge["beta"]), 1.1 * edge["alpha_max"]

    def bisection(radius: Callable[..., Floats]) -> Callable[..., Values]:
        return _one("boundary", peers.bisect_limit, partial(radius, case), beta, high)

    gridding, poles = _one("boundary", peers.grid_limit, case, beta, high), bisection(peers.radius_by_control)
    states, roots = bisection(peers.radius_by_eigenvalues), bisection(peers.radius_by_roots)
    return Table(
        {"boundary": np.array(edge["alpha"])},
        (
            Row("gridding with poles (3.4)", gridding, _TOLERANCE, (1e-2, 1e-4, 1e-6), 1),
            Row("eigenvalues and bisection", states, _TOLERANCE, (1e-2, 1e-6, 1e-10, 1e-14), 3),
            Row("polynomial roots and bisection", roots, _TOLERANCE, (1e-2, 1e-6, 1e-12), 2),
            Row(f"{PEER} and bisection", poles, _TOLERANCE, (1e-2, 1e-6), 1, needs="control"),
            Row(OURS, lambda: {"boundary": stiffness_limit(unknown(loop), beta)}),
        ),
    )


def _costs(case: Case, loop: NormalisedLoop, points: Mapping[str, Floats]) -> Table:
    """Return the table of costs of the responses at given walls."""
    wall = points["alpha"], points["beta"]

    def simulated(fine: int) -> Values:
        place, speed = peers.dense(case, *wall, DENSE_SAMPLES, fine)
        both = peers.settling_of(place, fine), np.maximum(place.max(axis=0), 0.0)
        return dict(zip(COSTS, (*both, *peers.energy_of(place, speed, case, wall[0], fine)), strict=True))

    def sampled(samples: int) -> Values:
        place = peers.response_by_dlsim(case, *wall, samples)
        return {"settling time": peers.settling_of(place, 1), "overshoot": np.maximum(place.max(axis=0), 0.0)}

    def energy(of: Callable[..., Floats]) -> Callable[..., Values]:
        return lambda: dict(zip(ENERGIES, of(case, *wall), strict=True))

    responses = ("settling time", "overshoot")
    return Table(
        {quantity: points[name] for quantity, name in COSTS.items()},
        (
            Row("dense simulation", simulated, *_FINE),
            Row("scipy dlsim", sampled, _SAMPLES, (256, 1024), 1, of=responses),
            *(Row(name, energy(of), of=ENERGIES) for name, of in ENERGY.items()),
            Row(OURS, lambda: own_costs(loop, *wall, {q: COSTS[q] for q in responses}), of=responses),
        ),
        scale={"overshoot": 1.0},
    )


def _optimum(quantity: str, criterion: str) -> Table:
    """Return the table of the optimal point by a criterion."""
    best = reference()["optimum"]
    cost = partial(_simulated_cost, case_of(best), tuple(COSTS.values()).index(criterion))

    def ours() -> Values:
        point = optimal_point(unknown(normalised_loop(best)), criterion)
        return {quantity: np.array([point.alpha, point.beta])}

    grid = _one(quantity, peers.grid_optimum, cost, SEARCH_BOX)
    simplex = _one(quantity, peers.nelder_mead, cost, START)
    return Table(
        {quantity: np.array([best[criterion]["alpha"], best[criterion]["beta"]])},
        (
            Row("iterated gridding (5.1.2)", grid, _TOLERANCE, (1e-2, 1e-3, 1e-5), 1),
            Row("Nelder-Mead, one start", simplex, _TOLERANCE, (1e-2, 1e-4, 1e-6), 1),
            Row(OURS, ours),
        ),
    )


def _simulated_cost(case: Case, place: int, alpha: Floats, beta: Floats) -> Floats:
    """Return the cost of points by dense simulation, or infinity if not stable or not settled.

    ``place`` is the index in `COSTS`.
    """
    result = np.full(len(alpha), np.inf)
    use = np.flatnonzero(alpha > 0)
    use = use[peers.radius_by_eigenvalues(case, alpha[use], beta[use]) < 1]
    if len(use):
        position, velocity = peers.dense(case, alpha[use], beta[use], SEARCH_SAMPLES, SEARCH_FINE)
        settle, energy = peers.settling_of(position, SEARCH_FINE), (position, velocity, case, alpha[use], SEARCH_FINE)
        cost = settle if place == 0 else peers.energy_of(*energy)[place - 2]
        result[use] = np.where(np.isfinite(cost), cost, np.inf)
    return result


def _map(case: Case, loop: NormalisedLoop, known: JsonObject) -> Table:
    """Return the table of methods that compute sampled costs over a grid. A row covers all criteria."""
    axes = np.array(known["axis_alpha"]), np.array(known["axis_beta"])
    usable = axes[0] > 0  # at alpha = 0 the wall has no restoring force
    alpha, beta = (g.ravel() for g in np.meshgrid(axes[0][usable], axes[1]))
    at = np.array([row["j"] * usable.sum() + row["i"] - (~usable).sum() for row in known["rows"]])
    exact = {name: np.array([row[f"{name}_discrete"] for row in known["rows"]]) for name in COSTS.values()}

    def truncated(samples: int) -> Values:
        found, stable = np.full((len(COSTS), len(alpha)), np.nan), peers.radius_by_eigenvalues(case, alpha, beta) < 1
        found[:, stable] = peers.sampled_costs(case, alpha[stable], beta[stable], samples)
        return {"map": found[:, at].ravel()}

    def ours() -> Values:
        found = cost_maps(loop, axes[0][usable], axes[1], tuple(COSTS.values()))
        return {"map": np.concatenate([found[name].ravel()[at] for name in COSTS.values()])}

    scales = exact | {"overshoot": np.ones(len(at))}
    horizons = _SAMPLES, (128, 512, 2048), 2
    return Table(
        {"map": np.concatenate(list(exact.values()))},
        (Row("eigenvalues and truncated recurrence", truncated, *horizons), Row(OURS, ours)),
        scale={"map": np.concatenate(list(scales.values()))},
    )


def _with_parts() -> Iterator[Table]:
    """Yield the tables of a loop with filter, lag, mode and fractional delay, and the table of loops for which common
    methods fail."""
    known, hard = reference()["device"], reference()["hard"]
    shape, (edge, radius) = normalised_loop(known["loop"]), GENERAL
    beta, wall = np.array(known["limit_beta"]), (np.array(known["alpha"]), np.array(known["beta"]))
    # A Butterworth filter of order 2 delays slow motion by sqrt(2)/cut-off.
    late = shape.delay + shape.lag + np.sqrt(2) / (2 * np.pi * known["loop"]["cutoff"])

    def bisection(tolerance: float) -> Values:
        return {edge: peers.bisect_limit(partial(spectral_radius, shape), beta, 0.02, tolerance)}

    yield Table(
        {edge: np.array(known["limit_alpha"])},
        (
            Row(
                "filter and lag as additional delay",
                lambda: {edge: stiffness_limit(NormalisedLoop.ideal(0.0, shape.delta, late), beta)},
            ),
            Row("eigenvalues and bisection", bisection, _TOLERANCE, (1e-2, 1e-6, 1e-10), 2),
            Row(OURS, lambda: {edge: stiffness_limit(unknown(shape), beta)}),
        ),
    )
    yield Table(
        {radius: np.array(known["radius"])},
        (
            Row(
                "squaring of the loop matrix",
                lambda squarings: {radius: peers.radius_by_squaring(shape.matrix(*wall), squarings)},
                *("{} squarings", (4, 16, 40)),
            ),
            Row(OURS, lambda: own_costs(unknown(shape), *wall, {radius: "pole_radius"})),
        ),
    )

    def ours() -> Values:
        walls = [(normalised_loop(row), np.array([row["alpha"]]), np.array([row["beta"]])) for row in hard]
        found = [own_costs(*each, HARD) for each in walls]
        return {quantity: np.concatenate([costs[quantity] for costs in found]) for quantity in HARD}

    exact = {quantity: np.array([row[name] for row in hard]) for quantity, name in HARD.items()}
    yield Table(exact, (Row(OURS, ours),), scale={"overshoot, hard loops": 1.0})
