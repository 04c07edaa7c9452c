"""What the theory has to reach whatever the machine: errors against high precision, verdicts, and run times.

Each function returns a `Limit` and stands in `LIMITS`; `theory.py` runs and prints them.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
from timing import fastest, once, run

from pipeline.loop.loop import Loop
from pipeline.studies.accuracy.theory_ladders import reference
from pipeline.theory.cost.energy import WEIGHTS, energy_costs
from pipeline.theory.stability.extent import damping_range
from pipeline.theory.stability.region import is_inside, stiffness_limit
from pipeline.theory.stability.stability import spectral_radius

TESTS = Path(__file__).parents[1] / "tests" / "support"
"""Holds `independent`: the second methods of the tests."""

NYQUIST = float(np.pi**2)

LOOPS = [
    (0.0, 0.0, 0.0),
    (0.0, 0.0, 0.5),
    (0.0, 0.0, 1.0),
    (1e-16, 1e-16, 3.0),
    (1e-3, 0.02, 4.0),
    (1e-3, 0.1, 2.75),
    (0.25 * (1 - 1e-12), 1.0, 2.0),
    (5.0, 1.0, 1.5),
    (9.8, 0.0, 0.5),
    (9.8, 0.0, 1.0),
    (NYQUIST * (1 - 1e-12), 0.3, 0.25),
    (0.0, 10.0, 2.5),
    (0.0, 1000.0, 1.0),
    (3.0, 1000.0, 7.3),
    (0.0, 0.0, 16.0),
    (1e-3, 0.02, 100.25),
    (0.0, 0.0, 256.0),
    (1e-3, 0.02, 255.6),
]
"""gamma, delta and d: corners of the domain, critical and strong damping, resonance, fractional and long delays."""

QUICK = 10
"""Largest delay of a quick run."""

NEAR_LIMIT = 1e-4
"""Distance of the spectral radius from 1 up to which the energy costs are exact to `EXACT`."""

NEAREST = 1.3 * NEAR_LIMIT
"""Up to here a point counts as at that distance: it is found in a few steps."""

EXACT = 1e-10

ROUNDING = 1e-16
"""An error of zero counts as this where exponents are fitted."""

MAP_POINTS = 2048
"""Points from which on `energy_costs` takes the method for maps."""

SURE = 1e-12
"""Distance of the spectral radius from 1 from which on a verdict has to be right, and error of a boundary."""


@dataclass(frozen=True)
class Limit:
    """One absolute number: what is reached and what is wanted, as printed, and whether it holds."""

    name: str
    reached: str
    wanted: str
    holds: bool


def loops(quick: bool) -> list[tuple[float, float, float]]:
    return [values for values in LOOPS if values[2] <= QUICK or not quick]


def second_methods() -> None:
    """Make `independent` importable; it needs mpmath and scipy."""
    if str(TESTS) not in sys.path:
        sys.path.append(str(TESTS))


def stable_points(loop: Loop, rng: np.random.Generator, count: int, near: int) -> Iterator[tuple[float, float, float]]:
    """Yield alpha, beta and spectral radius of random points, and of some just beyond `NEAR_LIMIT` from instability."""
    low, high = damping_range(loop)
    beta = low + (high - low) * rng.uniform(0.05, 0.95, count)
    alpha = -loop.gamma + (stiffness_limit(loop, beta) + loop.gamma) * rng.uniform(0.03, 0.97, count)
    radius = spectral_radius(loop, alpha, beta)
    inside = is_inside(loop, alpha, beta) & (radius <= 1 - NEAR_LIMIT)
    yield from zip(alpha[inside].tolist(), beta[inside].tolist(), radius[inside].tolist(), strict=True)
    beta = low + (high - low) * np.append(rng.uniform(0.05, 0.95), [0.05, 0.95])[:near]
    for b, limit in zip(beta.tolist(), stiffness_limit(loop, beta).tolist(), strict=True):
        # the distance of the radius from 1 is all but proportional to that of alpha from its limit
        distance = 1e-3 * (limit + loop.gamma)
        for _ in range(6):
            gap = 1 - float(spectral_radius(loop, limit - distance, b)[0])
            if NEAR_LIMIT <= gap <= NEAREST and is_inside(loop, limit - distance, b)[0]:
                yield limit - distance, b, 1 - gap
                break
            distance *= 1.1 * NEAR_LIMIT / max(gap, 1e-2 * NEAR_LIMIT)


def energy_costs_of_the_domain(quick: bool) -> Limit:
    """All energy costs, step and impulse, continuous and discrete, of few points and as a map computes them."""
    second_methods()
    from many_digits import Energies

    rng = np.random.default_rng(2017)
    errors, at, near = [], [], 0
    for values in loops(quick):
        loop, exact = Loop(*values), Energies(*values)
        for alpha, beta, radius in stable_points(loop, rng, 4 if quick else 8, 1 if quick else 3):
            near += radius > 1 - NEAREST
            for signal in ("step", "impulse"):
                truth = exact.costs(alpha, beta, signal, radius)
                for count in (1, MAP_POINTS):
                    found = energy_costs(loop, np.full(count, alpha), beta, signal)
                    errors.append(max(abs(float(found[name][0]) / value - 1) for name, value in truth.items()))
                    at.append((values, alpha, beta, radius))
    worst = int(np.argmax(errors))
    values, alpha, beta, radius = at[worst]
    # what the last bit of alpha does to the cost itself
    here, beside = (Energies(*values).costs(a, beta, "step", radius) for a in (alpha, np.nextafter(alpha, np.inf)))
    bit = max(abs(beside[name] / here[name] - 1) for name in here)
    reached = (
        f"{errors[worst]:.2e} ({len(set(at))} points, {near} of them at radius 1 - 1e-4; worst at {described(values)}, "
        f"alpha {alpha!r}, beta {beta!r}, where the last bit of alpha counts {bit:.0e})"
    )
    return Limit("energy costs, error for radius <= 1 - 1e-4", reached, f"{EXACT:g}", errors[worst] <= EXACT)


def described(values: tuple[float, float, float]) -> str:
    return f"gamma {values[0]:.4g}, delta {values[1]:g}, d {values[2]:g}"


def energy_costs_near_the_limit(quick: bool) -> Limit:
    """Growth of the error for spectral radii 1 - 10^-k, k = 4 to 12, d = 1."""
    entry = reference()
    gamma, delta = entry["loop"]["gamma"], entry["loop"]["delta"]
    rows = [row for row in entry["sweeps"]["limit"] if row["radius_gap"] < 1.5 * NEAR_LIMIT]
    gap, alpha, beta = (np.array([row[name] for row in rows]) for name in ("radius_gap", "alpha", "beta"))
    found = energy_costs(Loop(gamma, delta, 1.0), alpha, beta)
    exponents, holds, last = [], True, 0.0
    for w in WEIGHTS:
        name = f"energy_step_w{w}"
        error = np.maximum(np.abs(found[name] / np.array([row[name] for row in rows]) - 1), ROUNDING)
        slope, covariance = np.polyfit(-np.log10(gap), np.log10(error), 1, cov=True)
        spread = float(np.sqrt(covariance[0, 0]))  # rounding scatters; two standard errors are no faster growth
        exponents.append(f"{slope[0]:.2f} ± {spread:.2f}")
        bound = EXACT * (gap / NEAR_LIMIT) ** -(w + 1.0)
        holds &= bool(slope[0] - 2 * spread <= w + 1 and np.all(error <= bound))
        last = max(last, float(error[-1]))
    reached = f"{' / '.join(exponents)} (error {last:.1e} at {gap[-1]:.0e})"
    return Limit("energy costs, exponent of 1/(1 - radius), w = 0/1/2", reached, "1 / 2 / 3", holds)


def verdict_cases(quick: bool) -> Iterator[tuple[tuple[float, float, float], np.ndarray, np.ndarray]]:
    """Yield loops with points: beside the boundary, anywhere around it, and next to the origin at resonance."""
    rng = np.random.default_rng(34)
    for values in loops(quick):
        loop = Loop(*values)
        low, high = damping_range(loop)
        lines = 3 if loop.delay > 50 else 4  # a point of 256 samples of delay takes half a second in many digits
        steps = 10.0 ** -(np.array([3, 8, 11]) if loop.delay > 50 else np.array([2, 4, 6, 8, 10, 11, 12]))
        beta = low + (high - low) * rng.uniform(0.03, 0.97, lines)
        limit = stiffness_limit(loop, beta)
        near = limit[:, None] + (limit + loop.gamma)[:, None] * np.concatenate([-steps, steps])
        count = 2 * lines
        far = -loop.gamma + rng.uniform(-0.2, 1.5, count) * (limit.max() + loop.gamma)
        around = low + (high - low) * rng.uniform(-0.3, 1.3, count)
        yield (
            values,
            np.concatenate([near.ravel(), far]),
            np.concatenate([np.repeat(beta, near.shape[1]), around]),
        )
    signs = np.array(list(product((1, -1, 0.1, 3), (1, -1)))) * 1e-11
    for delta, d in ((0.0, 0.0), (0.0, 1.0), (0.0, 2.5), (0.3, 1.0), (0.0, 16.0)):
        yield (NYQUIST * (1 - 1e-12), delta, d), signs[:, 0], signs[:, 1]
    if not quick:
        for gamma in (NYQUIST * (1 - 1e-12), 0.0):
            yield (gamma, 0.0, 256.0), np.array([1e-11]), np.array([1e-11])


def stability_verdicts(quick: bool) -> Limit:
    """Verdicts beside a Schur-Cohn test in many digits, for circles of radius 1 - 1e-12 and 1 + 1e-12."""
    second_methods()
    from independent import characteristic, stable_by_schur_cohn

    points = wrong = 0
    for values, alphas, betas in verdict_cases(quick):
        found = is_inside(Loop(*values), alphas, betas)
        for alpha, beta, verdict in zip(alphas.tolist(), betas.tolist(), found.tolist(), strict=True):
            polynomial = characteristic(*values, alpha, beta)
            # the case that matters is the one that the verdict contradicts; between the two circles either is right
            points += 1
            if verdict:
                wrong += not stable_by_schur_cohn(polynomial, 1 + SURE)
            else:
                wrong += stable_by_schur_cohn(polynomial, 1 - SURE)
    reached = f"{wrong} wrong of {points}"
    return Limit("stability verdict where |radius - 1| > 1e-12", reached, "0 wrong", wrong == 0)


def boundary_error(quick: bool) -> Limit:
    """Largest stable alpha at values of beta beside a root in many digits, relative to |alpha| + gamma."""
    second_methods()
    from many_digits import limit_of_alpha

    rng = np.random.default_rng(78)
    worst, points, place = 0.0, 0, ""
    for values in loops(quick):
        loop = Loop(*values)
        low, high = damping_range(loop)
        beta = low + (high - low) * np.append([1e-3, 0.97], rng.uniform(0.01, 0.95, 2 if loop.delay > 50 else 8))
        for b, limit in zip(beta.tolist(), stiffness_limit(loop, beta).tolist(), strict=True):
            exact = limit_of_alpha(*values, limit, b)
            error = float(abs(exact - limit) / (abs(exact) + loop.gamma))
            points += 1
            if error > worst:
                worst, place = error, f"{described(values)}, beta {b!r}"
    reached = f"{worst:.1e} ({points} points; worst at {place})"
    return Limit("boundary, relative error, d <= 256", reached, f"{SURE:g}", worst <= SURE)


TABLES_C = """
from pipeline.studies.thesis.tables import recomputed_tables
rows = sum(len(list(found)) for _, _, found in recomputed_tables(("C.1", "C.2", "C.3"), workers=1))
assert rows == 171, rows
"""


def tables_c_as_a_process(quick: bool) -> Limit:
    """All 171 rows of Tables C.1 to C.3 in one process."""
    seconds = once(partial(run, [sys.executable, "-c", TABLES_C]))
    return Limit("Tables C.1 to C.3, 171 rows, process", f"{seconds:.1f} s", "60 s", seconds <= 60)


def boundary_as_a_process(quick: bool) -> Limit:
    """The command `theory boundary` with all of its start."""
    command = [sys.executable, "-m", "pipeline", "theory", "boundary", "--delay", "8"]
    seconds = fastest(partial(run, command))
    return Limit("theory boundary --delay 8, process", f"{seconds:.2f} s", "0.6 s", seconds <= 0.6)


LIMITS: list[Callable[[bool], Limit]] = [
    energy_costs_of_the_domain,
    energy_costs_near_the_limit,
    stability_verdicts,
    boundary_error,
    tables_c_as_a_process,
    boundary_as_a_process,
]
