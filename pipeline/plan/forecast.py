"""The limit at each damping before it is measured: what a model says, corrected by what it missed so far."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.plan.evidence import Evidence, told_by_rates
from pipeline.records.batch import Floats

INADEQUATE = 0.25
"""Misfit from which on the model is said not to fit, and no longer proposes."""

SMOOTH = 0.15
"""Length over which the misfit changes, relative to the range of dampings."""

MISFITS = np.geomspace(0.003, 0.5, 40)
"""Misfits that are thought of, relative to the limits."""

PRIOR_SPREAD = 1.0
"""Standard deviation of ln misfit before any limit is known."""

TAILS = 1.5
"""Degrees of freedom of Student's distribution of what a model misses: one damping may be quite another thing."""


@dataclass(frozen=True, eq=False)
class Foretold:
    """What a model says of limits [N/m, Nm/rad].

    Parameters
    ----------
    limit, spread : float64, shape (n,)
        At the wanted dampings: value, and what the model leaves open of it.
    there, slope : float64, shape (levels,)
        Limits at the dampings that were tried, and how the growth rate rises over K there [1/s per N/m].
    largest : float
    misfit : float
        Relative error of its limits that is usual, or that was found.
    explains : bool
        Whether it explains the logs: then growth rates tell nothing that is not in it.
    """

    limit: Floats
    spread: Floats
    there: Floats
    slope: Floats
    largest: float
    misfit: float
    explains: bool = False


@dataclass(frozen=True, eq=False)
class Forecast:
    """Limit at each damping before it is measured: value and standard error [N/m, Nm/rad], both of shape (n,).

    ``misfit`` is the relative error that the model has where the limits are known; ``explains`` whether it explains
    the logs, too.
    """

    limit: Floats
    error: Floats
    misfit: float
    explains: bool = False

    @property
    def adequate(self) -> bool:
        """Whether the model may propose."""
        return self.misfit < INADEQUATE


def scale_of(limit: Floats, largest: Floats | float) -> Floats:
    """What a relative misfit is relative to: limits near 0 are as hard to foretell as others."""
    return 0.7 * limit + 0.3 * largest


def known_limits(by: Foretold, seen: Evidence) -> tuple[Floats, Floats]:
    """Return limits that verdicts and growth rates tell, and their standard errors; infinite where they tell none.

    Of a model that explains the logs a bracket tells that it holds, or by how much it does not.
    """
    by_ends = (seen.high - seen.low) / np.sqrt(12)
    if by.explains:
        return np.clip(by.there, seen.low, seen.high), by_ends
    told, error = told_by_rates(seen, by.slope)
    told = np.clip(np.where(np.isnan(told), 0.5 * (seen.low + seen.high), told), seen.low, seen.high)
    return told, np.fmin(np.where(np.isnan(error), np.inf, error + 0.003 * by.largest), by_ends)


def found_misfit(by: Foretold, seen: Evidence) -> float:
    """Return the misfit of a model: its usual one, and what known limits and brackets say of it."""
    told, error = known_limits(by, seen)
    known = np.isfinite(told) & np.isfinite(error)
    scale = scale_of(by.there, by.largest)
    missed, noise = ((told - by.there) / scale)[known], (error / scale)[known]
    outside = (np.maximum(np.maximum(seen.low - by.there, by.there - seen.high), 0.0) / scale)[~known]
    size = np.hypot(MISFITS[:, None], noise)
    fit = -np.log(size) - 0.5 * (TAILS + 1) * np.log1p((missed / size) ** 2 / TAILS)
    beyond = -0.5 * (TAILS + 1) * np.log1p((outside / MISFITS[:, None]) ** 2 / TAILS)
    prior = -0.5 * (np.log(MISFITS / by.misfit) / PRIOR_SPREAD) ** 2
    chance = fit.sum(axis=1) + beyond.sum(axis=1) + prior
    weight = np.exp(chance - chance.max())
    return float(np.exp(weight @ np.log(MISFITS) / weight.sum()))


def forecast(by: Foretold, seen: Evidence, dampings: Floats) -> Forecast:
    """Return the limit at each damping as a model, and what it missed at neighbouring ones, tell.

    Parameters
    ----------
    by : Foretold
    seen : Evidence
    dampings : float64, shape (n,)

    Notes
    -----
    What the model misses at dampings that were tried is carried on to their neighbours as a random function of the
    damping (kriging) with the misfit as standard deviation and `SMOOTH` of the range as length.
    """
    value, spread = by.limit, by.spread
    told, error = known_limits(by, seen)
    known = np.isfinite(told) & np.isfinite(error)
    scale = scale_of(value, by.largest)
    if not known.any():
        return Forecast(value, np.hypot(spread, by.misfit * scale), by.misfit, by.explains)
    there = scale_of(by.there, by.largest)
    missed, noise = ((told - by.there) / there)[known], (error / there)[known]
    length = SMOOTH * float(np.ptp(dampings) or 1.0)
    place = seen.damping[known]
    # where a damping was tried, its own model's spread is as unknown as the misfit
    size = np.hypot(by.misfit, np.interp(place, dampings, spread / scale))
    ahead = np.hypot(by.misfit, spread / scale)
    among = _likeness(place, place, length) * size[:, None] * size + np.diag(noise**2 + 1e-8)
    toward = _likeness(dampings, place, length) * ahead[:, None] * size
    gain = np.linalg.solve(among, toward.T).T
    value = np.maximum(value + scale * (gain @ missed), 0.0)
    spread = scale * np.sqrt(np.maximum(ahead**2 - (gain * toward).sum(axis=1), 1e-6))
    return Forecast(value, spread, by.misfit, by.explains)


def _likeness(first: Floats, second: Floats, length: float) -> Floats:
    return np.exp(-0.5 * ((first[:, None] - second) / length) ** 2)
