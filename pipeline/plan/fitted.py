"""The loop that the logs so far show: one device fitted to all of them, which foretells limits and costs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pipeline.loop.loop import Loop, Normalised
from pipeline.loop.velocity_filter import per_sample
from pipeline.measured.explained import holds
from pipeline.measured.fit.fit import fit_trials
from pipeline.measured.ladder.device import Device
from pipeline.measured.ladder.ladder import FEWEST_TRIALS, Rung, climb
from pipeline.measured.ladder.parts import GROUPS
from pipeline.measured.ladder.search import covariance_of, judged, search
from pipeline.measured.ladder.trials import LadderTrials, windowed
from pipeline.measured.law.wall_law import wall_law
from pipeline.measured.signal.response import Response, find_response
from pipeline.plan.forecast import Foretold
from pipeline.records.batch import Floats, TrialBatch
from pipeline.records.loop_parts import VelocityFilter
from pipeline.theory.limits import limits

MOST_TRIALS = 16
"""Trials that a device is fitted to: a number known to 1 % from one is known to 0.3 %, and a log waits for it."""

CLIMB_TRIALS, CLIMB_ROWS = 10, 300
"""Trials, half of them held out, and rows by which the parts of a device are looked for: a second or two."""

AGAIN = 3
"""A device that does not explain the logs is looked for anew when there are so many times as many."""

MISFIT_HOLDS, MISFIT_ELSE = 0.007, 0.04
"""Relative error of limits by a device that explains the logs, and by one that does not, before any is known: verdicts
call what grows unseen stable."""

FITTED = tuple(group for group in GROUPS if not {"friction", "saturation"} & set(group))
"""Parts that are looked for: those of a linear loop, which has limits. Friction takes ten times as long, too."""

BELOW = 0.98
"""Wall relative to the limit at which the slope of the growth rate is read."""

FEWEST = 3
"""Logs from which on a device may count as explaining them: one or two are explained by much."""

STEPS = 8
"""Steps of a search with one log more; what has not converged goes on with the next."""

Climb = Callable[[LadderTrials, Device], Rung | None]
"""What looks for the parts of a device; None as long as that goes on."""


@dataclass(frozen=True, eq=False)
class Fitted:
    """A device fitted to all logs of an experiment.

    Parameters
    ----------
    device : Device
    covariance : float64, shape (P, P)
        Of its numbers.
    explains : bool
        Whether it explains nearly all logs.
    sampling_period_s : float
        T [s].
    velocity : VelocityFilter or None
        As the wall law shows it.
    climbed : int
        Number of logs when its parts were looked for; 0 as long as they were not.
    """

    device: Device
    covariance: Floats
    explains: bool
    sampling_period_s: float
    velocity: VelocityFilter | None = None
    climbed: int = 0

    @property
    def units(self) -> Normalised:
        """Units of its walls."""
        return Normalised(
            self.sampling_period_s**2 / float(np.exp(self.device.numbers["gain"])), self.sampling_period_s
        )

    @cached_property
    def loop(self) -> Loop:
        """Its loop, normalised, with the filter."""
        return replace(self.device.loop, velocity=per_sample(self.velocity, self.sampling_period_s))

    def limits(self, dampings: Floats) -> Floats:
        """Return the largest stable stiffness [N/m, Nm/rad] at dampings; 0 where there is none."""
        alpha = limits(self.loop, np.asarray(dampings) / self.units.damping, exact=False).alpha
        return np.asarray(np.nan_to_num(alpha, nan=0.0) * self.units.stiffness)

    def slopes(self, dampings: Floats, limit: Floats) -> Floats:
        """Return how the growth rate rises over K at limits [1/s per N/m], NaN where the limit is 0."""
        wall = BELOW * np.maximum(limit, 1e-12)
        matrices = self.loop.matrix(wall / self.units.stiffness, dampings / self.units.damping)
        rate = np.log(np.abs(np.linalg.eigvals(matrices)).max(axis=1)) / self.sampling_period_s
        return np.where((limit > 0) & (rate < 0), -rate / np.maximum(limit - wall, 1e-300), np.nan)

    def spread(self, dampings: Floats, limit: Floats) -> Floats:
        """Return the standard error of limits that the numbers leave open."""
        off = np.zeros(len(limit))
        scale = np.sqrt(np.diag(self.covariance))
        size = np.where(scale > 0, scale, 1.0)
        variance, axes = np.linalg.eigh(self.covariance / np.outer(size, size))
        for square, axis in zip(variance, axes.T, strict=True):
            other = self.device.at(self.device.values + np.sqrt(max(float(square), 0.0)) * axis * size)
            off = off + np.minimum(np.abs(replace(self, device=other).limits(dampings) - limit), limit.max()) ** 2
        return np.asarray(np.sqrt(off))

    def foretold(self, dampings: Floats, tried: Floats) -> Foretold:
        """Return its limits at dampings, and at those that were tried."""
        levels, place = np.unique(np.concatenate([dampings, tried]), return_inverse=True)
        limit, there = np.split(self.limits(levels)[place], [len(dampings)])
        misfit = MISFIT_HOLDS if self.explains else MISFIT_ELSE
        slope = self.slopes(tried, there)
        largest = max(float(limit.max(initial=0.0)), float(there.max(initial=0.0)))
        return Foretold(limit, self.spread(dampings, limit), there, slope, largest, misfit, self.explains)


def learn(batch: TrialBatch, known: Fitted | None, look: Climb) -> Fitted | None:
    """Return the device that trials of an experiment show, from that of fewer; None where none of them tells a mass.

    Parameters
    ----------
    batch : TrialBatch
        Trials with K > 0.
    known : Fitted or None
    look : Climb
    """
    response = find_response(batch)
    good, trials = windowed(batch, response)
    if trials is None:
        return known
    start = known or first_guess(batch.select(good[:FEWEST]), response.select(good[:FEWEST]))
    if start is None:
        return None
    if start.velocity is None:
        # a filter shows most where there is most damping; one that comes in is a part as others
        most = good[[np.argmax(batch.damping[good])]]
        start = replace(start, velocity=filter_of(batch.select(most), response.select(most)))
    order = np.lexsort((batch.stiffness[good], batch.damping[good]))
    return fitted(trials.select(order), start, look)


def first_guess(batch: TrialBatch, response: Response) -> Fitted | None:
    """Return the ideal device that single trials show, by their median; None where none does."""
    found, T = fit_trials(batch, response), float(np.median(batch.sampling_period_s))
    some = np.isfinite(found.mass)
    if not some.any():
        return None
    mass, damping, delay = (float(np.median(each[some])) for each in (found.mass, found.damping, found.delay))
    numbers = {"gain": float(np.log(T**2 / mass)), "delta": max(damping, 0.0) * T / mass, "delay": max(delay, 0.0)}
    return Fitted(Device(numbers), np.zeros((3, 3)), False, T)


def filter_of(batch: TrialBatch, response: Response) -> VelocityFilter | None:
    """Return the velocity filter that the wall law of the first trial shows."""
    departures = wall_law(batch, response).departures[0]
    found = next((each.filter for each in departures if each.filter is not None), None)
    return None if found is None else found.declared


def fitted(trials: LadderTrials, start: Fitted, look: Climb) -> Fitted:
    """Return the device that explains all trials so far.

    Parameters
    ----------
    trials : LadderTrials
        In the order of damping and stiffness.
    start : Fitted
        That of fewer trials, or a first guess.
    look : Climb
        Asked where the parts of the device are not known, or no longer explain the trials.
    """
    count = len(trials)
    few = trials.select(np.unique(np.linspace(0, count - 1, MOST_TRIALS).astype(np.int64)))
    found = _refitted(few, start, start.device)
    wanting = not start.climbed or (not found.explains and count >= AGAIN * start.climbed)
    if count >= FEWEST_TRIALS and wanting and (rung := look(few, _ideal(found.device))) is not None:
        other = _refitted(few, start, rung.device)
        best = other if other.explains or not found.explains else found
        return replace(best, climbed=count)
    return found


def at_once(trials: LadderTrials, ideal: Device) -> Rung:
    """Look for the parts of a device, and wait for it."""
    few = np.unique(np.linspace(0, len(trials) - 1, CLIMB_TRIALS).astype(np.int64))
    return climb(trials.select(few).head(CLIMB_ROWS), ideal, FITTED).best


def _refitted(trials: LadderTrials, start: Fitted, device: Device) -> Fitted:
    fit = search(trials, device, STEPS)
    _, good = judged(trials, fit.device)
    right = len(good) >= FEWEST and holds(int(good.sum()), len(good))
    return replace(start, device=fit.device, covariance=covariance_of(trials, fit), explains=right)


def _ideal(device: Device) -> Device:
    return device.without("gamma", "lag", "force", "turn", "ratio", "share")
