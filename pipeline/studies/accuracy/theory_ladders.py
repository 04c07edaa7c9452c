"""Each quantity of the ideal loop by each method over its settings: what is true, what is run.

An error is the largest one over all reference points: relative, but for overshoot, which is relative to the final
displacement already. A result that a method could not give counts as an error of 1.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from itertools import count
from typing import Any

import numpy as np

from pipeline.loop.loop import Loop
from pipeline.loop.plant import flow
from pipeline.records.accuracy import OURS, reference_file
from pipeline.records.batch import Floats
from pipeline.studies.accuracy import methods, searches
from pipeline.studies.accuracy.ladder import Ladder, Method, Values
from pipeline.theory.costs import cost_maps
from pipeline.theory.energy import energy_costs
from pipeline.theory.limits import stiffness_limit
from pipeline.theory.optimum import optimal_point
from pipeline.theory.poles import spectral_radius
from pipeline.theory.transient import transient_costs

BAND = 0.02
"""Settling band of the ladder; that of the reference values."""

DENSE_SAMPLES = 2048
"""Horizon of the dense simulation: the slowest reference point has decayed to 1e-7 there."""

SEARCH_SAMPLES = 256
"""Horizon of the responses inside the searches for an optimum, whose best points settle within 30 samples."""

START = (0.05, 0.3)
"""Start of Nelder-Mead inside the stable region, whose optima lie at (0.070, 0.471) and (0.045, 0.304)."""

SEARCH_BOX = (0.3, 1.0)
"""Largest alpha and beta of the searches, around the stable region of d = 1."""

MAP_CRITERIA = ("settle_2pct", "overshoot", "energy_step_w0", "energy_step_w1", "energy_step_w2")

ENERGIES = ("energy, w = 0", "energy, w = 1", "energy, w = 2")
OPTIMA = {"optimum of energy": "energy_step_w0", "optimum of settling time": "settle_2pct"}
"""Criterion of each optimum that is looked for."""

IDEAL = ("plant", "boundary", "spectral radius", "settling time", "overshoot", *ENERGIES, *OPTIMA, "map")

_TOLERANCE = "tolerance {:.0e}"
_SAMPLES = "{} samples"
_FINE = "{} points a sample", (1, 2, 4, 8, 16, 32, 64), (1, 4, 16)
"""Settings that several methods share."""

_repetition = count()


@cache
def reference() -> dict[str, Any]:
    """Return the high-precision values that ship with the package (made by docs/make_reference.py)."""
    document: dict[str, Any] = json.loads(reference_file().read_text(encoding="utf-8"))
    return document


def theory_ladders() -> Iterator[Ladder]:
    """Yield all ladders of the ideal loop."""
    yield _plant()
    yield _boundary()
    yield _radius()
    yield _transients()
    yield _energies()
    yield from (_optimum(quantity, criterion) for quantity, criterion in OPTIMA.items())
    yield _map()


def case_of(entry: dict[str, Any]) -> methods.Case:
    """Return the loop of reference values, as the methods of others take it."""
    return methods.Case(entry["gamma"], entry["delta"], entry["delay"])


def loop_of(entry: dict[str, Any]) -> Loop:
    """Return the loop of reference values, as this package takes it."""
    return Loop(entry["gamma"], entry["delta"], float(entry["delay"]))


def unknown(loop: Loop) -> Loop:
    """Return a loop of which nothing is kept from earlier calls: each has a damping some roundings larger."""
    return replace(loop, delta=loop.delta + next(_repetition) * 2.0**-57)


def _main() -> tuple[methods.Case, Loop]:
    """Loop of all quantities but the optima, for others and for this package."""
    return case_of(reference()["loop"]), loop_of(reference()["loop"])


def _points() -> tuple[Floats, Floats, dict[str, Floats]]:
    rows = reference()["points"]["rows"]
    columns = {name: np.array([row[name] for row in rows], dtype=np.float64) for name in rows[0]}
    return columns["alpha"], columns["beta"], columns


def own_energies(loop: Loop, alpha: Floats, beta: Floats) -> dict[int, Floats]:
    """Return the energy costs of a step by weight, as this package has them."""
    costs = energy_costs(loop, alpha, beta)
    return {w: costs[f"energy_step_w{w}"] for w in range(3)}


def own_plant(gamma: float, delta: float) -> methods.Sampled:
    """Return the sampled plant by the closed form of this package."""
    motion = flow(gamma, delta, 1.0)
    return methods.Sampled(motion.transition, motion.gain)


def _named(quantity: str, run: Callable[..., Any], *arguments: Any) -> Callable[..., Values]:
    """Return a run whose result is the values of one quantity; arguments of the setting follow those given here."""
    return lambda *setting: {quantity: np.asarray(run(*arguments, *setting))}


def _plant() -> Ladder:
    rows = reference()["plant"]

    def by(transfer: Callable[..., methods.Transfer]) -> Callable[..., Values]:
        return _named("plant", lambda *at: [transfer(row["gamma"], row["delta"], *at)[:2] for row in rows])

    steps = (1, 2, 4, 8, 16, 32, 64, 128, 256)
    known = methods.transfers()
    return Ladder(
        {"plant": np.array([row["numerator"] for row in rows])},
        (
            Method("simulation (Runge-Kutta)", by(methods.transfer_by_runge_kutta), "{} steps", steps, (1, 16, 128)),
            *(Method(name, by(transfer)) for name, transfer in known.items()),
            Method(OURS, by(methods.transfer_by(own_plant))),
        ),
    )


def _boundary() -> Ladder:
    entry = reference()["boundary"]
    beta, high = np.array(entry["beta"]), 1.1 * entry["alpha_max"]
    case, loop = _main()

    def bisection(radius: Callable[..., Floats]) -> Callable[..., Values]:
        return _named("boundary", searches.bisect_limit, partial(radius, case), beta, high)

    states, roots = bisection(methods.radius_by_eigenvalues), bisection(methods.radius_by_roots)
    poles, gridding = bisection(methods.radius_by_control), _named("boundary", searches.grid_limit, case, beta, high)
    widths = (1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-14)
    by_poles = "poles and bisection, {:.0e}"
    return Ladder(
        {"boundary": np.array(entry["alpha"])},
        (
            Method("gridding with poles (3.4)", gridding, _TOLERANCE, widths[:5], (1e-2, 1e-5)),
            Method("eigenvalues and bisection", states, _TOLERANCE, widths, (1e-2, 1e-6, 1e-10)),
            Method("polynomial roots and bisection", roots, _TOLERANCE, widths[:6], (1e-2, 1e-6)),
            Method("python-control", poles, by_poles, (1e-2, 1e-5, 1e-8), (1e-2,), needs="control"),
            Method(OURS, lambda: {"boundary": stiffness_limit(unknown(loop), beta)}, "closed form"),
        ),
    )


def _radius() -> Ladder:
    alpha, beta, exact = _points()
    case, loop = _main()

    def of(radius: Callable[..., Floats]) -> Callable[..., Values]:
        return _named("spectral radius", radius, case, alpha, beta)

    squarings = "{} squarings", (2, 4, 6, 8, 12, 16, 20, 24, 30, 40), (4, 16)
    return Ladder(
        {"spectral radius": exact["radius"]},
        (
            Method("squaring of the loop matrix", of(methods.radius_by_squaring), *squarings),
            Method("polynomial roots, one by one", of(methods.radius_by_roots), "numpy.roots of (3.11)"),
            Method("python-control", of(methods.radius_by_control), "state space", needs="control"),
            Method(OURS, _named("spectral radius", spectral_radius, loop, alpha, beta), "eigenvalues, batched"),
        ),
    )


def _transients() -> Ladder:
    alpha, beta, exact = _points()
    case, loop = _main()

    def read(position: Floats, fine: int = 1) -> Values:
        settle = methods.settling_of(position, fine, BAND)
        return {"settling time": settle, "overshoot": np.maximum(position.max(axis=0), 0.0)}

    def simulated(fine: int) -> Values:
        return read(methods.dense(case, alpha, beta, DENSE_SAMPLES, fine)[0], fine)

    def by(response: Callable[..., Floats]) -> Callable[[int], Values]:
        return lambda samples: read(response(case, alpha, beta, samples))

    def ours() -> Values:
        costs = transient_costs(loop, alpha, beta, (BAND,))
        return {"settling time": costs["settle_2pct"], "overshoot": costs["overshoot"]}

    horizons = _SAMPLES, (256, 512, 1024), (256,)
    return Ladder(
        {"settling time": exact["settle_2pct"], "overshoot": exact["overshoot"]},
        (
            Method("dense simulation", simulated, *_FINE),
            Method("scipy dlsim", by(methods.response_by_dlsim), *horizons),
            Method("python-control", by(methods.response_by_control), *horizons, needs="control"),
            Method(OURS, ours, "exact"),
        ),
        scale={"overshoot": 1.0},
    )


def _energies() -> Ladder:
    alpha, beta, exact = _points()
    case, loop = _main()

    def simulated(fine: int) -> Values:
        motion = methods.dense(case, alpha, beta, DENSE_SAMPLES, fine)
        return {name: methods.energy_of(*motion, case, alpha, fine, w) for w, name in enumerate(ENERGIES)}

    def by(energy: Callable[..., dict[int, Floats]], first: object) -> Callable[..., Values]:
        def run(*setting: object) -> Values:
            found = energy(first, alpha, beta, *setting)
            return {name: found[w] for w, name in enumerate(ENERGIES)}

        return run

    horizons = _SAMPLES, tuple(64 * 2**n for n in range(8)), (64, 512)
    return Ladder(
        {name: exact[f"energy_step_w{w}"] for w, name in enumerate(ENERGIES)},
        (
            Method("dense simulation", simulated, *_FINE),
            Method("truncated recurrence", by(methods.truncated_energy, case), *horizons),
            Method("Lyapunov equations (scipy)", by(methods.lyapunov_energy, case)),
            Method(OURS, by(own_energies, loop), "exact sum"),
        ),
    )


def _simulated_cost(case: methods.Case, criterion: str, alpha: Floats, beta: Floats, fine: int = 8) -> Floats:
    """Cost of points by dense simulation, infinite where not stable or not settled."""
    result = np.full(len(alpha), np.inf)
    use = np.flatnonzero(alpha > 0)
    use = use[methods.radius_by_eigenvalues(case, alpha[use], beta[use]) < 1]
    for i in range(0, len(use), 512):  # bounds the memory of the dense motion
        part = use[i : i + 512]
        position, velocity = methods.dense(case, alpha[part], beta[part], SEARCH_SAMPLES, fine)
        if criterion == "settle_2pct":
            cost = methods.settling_of(position, fine, BAND)
        else:
            cost = methods.energy_of(position, velocity, case, alpha[part], fine, 0)
        result[part] = np.where(np.isfinite(cost), cost, np.inf)
    return result


def _optimum(quantity: str, criterion: str) -> Ladder:
    entry = reference()["optimum"]
    cost = partial(_simulated_cost, case_of(entry), criterion)

    def ours() -> Values:
        point = optimal_point(unknown(loop_of(entry)), criterion)
        return {quantity: np.array([point.alpha, point.beta])}

    iterated = _named(quantity, searches.iterated_grid_optimum, cost, SEARCH_BOX)
    simplex = _named(quantity, searches.nelder_mead, cost, START, 0.2)
    return Ladder(
        {quantity: np.array([entry[criterion]["alpha"], entry[criterion]["beta"]])},
        (
            Method("iterated gridding (5.1.2)", iterated, _TOLERANCE, (1e-1, 1e-2, 1e-3, 1e-5), (1e-2,)),
            Method("Nelder-Mead, one start", simplex, _TOLERANCE, (1e-1, 1e-2, 1e-4, 1e-6), (1e-2,)),
            Method(OURS, ours, "global search"),
        ),
    )


def _map() -> Ladder:
    entry, exact = reference()["points"], _points()[2]
    case, loop = _main()
    axes = [np.array(entry[name]) for name in ("axis_alpha", "axis_beta")]
    usable = axes[0] > 0  # at alpha = 0 the wall does not hold the device
    alpha, beta = (g.ravel() for g in np.meshgrid(axes[0][usable], axes[1]))
    rows, columns = (np.array([row[name] for row in entry["rows"]]) for name in ("j", "i"))
    columns -= int((~usable).sum())

    def at_points(found: dict[str, Floats]) -> Values:
        """Values at the reference points, all criteria in a row."""
        values = [found[name].reshape(len(axes[1]), -1)[rows, columns] for name in MAP_CRITERIA]
        return {"map": np.concatenate(values)}

    def truncated(samples: int) -> Values:
        return at_points(methods.discrete_map(case, alpha, beta, samples))

    def ours() -> Values:
        return at_points(cost_maps(loop, axes[0][usable], axes[1], MAP_CRITERIA))

    horizons = (64, 128, 256, 512, 1024, 2048)
    values = {name: exact[f"{name}_discrete"] for name in MAP_CRITERIA}
    scales = values | {"overshoot": np.ones(len(rows))}
    return Ladder(
        {"map": np.concatenate(list(values.values()))},
        (
            Method("eigenvalues and truncated recurrence", truncated, _SAMPLES, horizons, (128, 512)),
            Method(OURS, ours, "61 x 61 points"),
        ),
        scale={"map": np.concatenate(list(scales.values()))},
    )
