"""Least squares of one device over all trials, and what the trials leave open of its numbers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pipeline.measured.fit.fit import LEAST_WHITENESS
from pipeline.measured.fit.fit_noise import portmanteau
from pipeline.measured.ladder.device import LARGEST_STEP, LIMITS, Device
from pipeline.measured.ladder.open_loop import Commands
from pipeline.measured.ladder.trials import LadderTrials
from pipeline.records.batch import Booleans, Floats

MOST_STEPS = 30
"""Steps of a search; from a sound start six to ten are needed."""

CONVERGED = 1e-4
"""Promised fall of the cost, relative to it, from which on a search has converged."""

FIRST_FACTOR, LARGEST_FACTOR = 1e-3, 1e8
"""Levenberg-Marquardt factor to begin with, and the one at which no step lowers the cost."""

DIFFERENCE = 1e-5
"""Change of a number by which a derivative is taken: between rounding of 1e-12 and a bend of the same."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A device beside trials.

    Parameters
    ----------
    device : Device
    error : float64, shape (n, N)
        Weighted errors; each trial's start is where it fits best.
    slopes : float64, shape (P, n, N)
        Derivatives of the weighted motion by each number.
    """

    device: Device
    error: Floats
    slopes: Floats

    @cached_property
    def cost(self) -> float:
        """Sum of squared weighted errors."""
        return float(np.vdot(self.error, self.error))

    @cached_property
    def normal(self) -> tuple[Floats, Floats]:
        """Normal equations of a step, shapes (P, P) and (P,)."""
        slopes = self.slopes.reshape(len(self.slopes), -1)
        return np.asarray(slopes @ slopes.T), np.asarray(slopes @ self.error.ravel())


def _motions(trials: LadderTrials, devices: list[Device]) -> Iterator[Floats]:
    """Yield the motion of each of some devices with the same parts, shape (n, N)."""
    for device in devices:
        commands = Commands.of(device.obeyed(trials.command)) if "bound" in device.numbers else trials.commands
        answer = commands.response(device.loop)
        yield np.exp(device.numbers["gain"]) * (answer[:-1] + device.numbers.get("force", 0.0) * answer[-1])


def _about_start(trials: LadderTrials, values: Floats) -> Floats:
    """Return weighted values less the constant that fits each trial best."""
    square = trials.weight**2
    mean = (square * values).sum(axis=1) / np.maximum(square.sum(axis=1), 1e-300)
    return np.asarray(trials.weight * (values - mean[:, None]))


def fit_of(trials: LadderTrials, device: Device) -> Fit:
    """Return a device as it is, beside trials."""
    others, spans = [device], []
    for i, name in enumerate(device.names):
        step = DIFFERENCE * (0.1 if name in ("delta", "gamma") else 1.0)
        changed = device.values
        changed[i] += step if changed[i] + step <= LIMITS[name][1] else -step
        others.append(device.at(changed))
        spans.append(changed[i] - device.values[i])
    here, *motions = _motions(trials, others)
    slopes = [_about_start(trials, (each - here) / span) for each, span in zip(motions, spans, strict=True)]
    return Fit(device, _about_start(trials, trials.position - here), np.stack(slopes))


def search(trials: LadderTrials, start: Device, most_steps: int = MOST_STEPS) -> Fit:
    """Return the device of least squares near a start (Levenberg and Marquardt, numbers within their limits)."""
    now, factor = fit_of(trials, start), FIRST_FACTOR
    for _ in range(most_steps):
        normal, right = now.normal
        step = _step(now.device, normal, right, factor)
        promised = float(2 * step @ right - step @ normal @ step)
        if promised <= CONVERGED * now.cost / now.error.size**0.5 or factor > LARGEST_FACTOR:
            break
        there = fit_of(trials, now.device.at(now.device.values + step))
        if there.cost < now.cost:
            now, factor = there, factor * 0.1
        else:
            factor *= 10.0
    return now


def _step(device: Device, normal: Floats, right: Floats, factor: float) -> Floats:
    """Return a step without what stands at a limit and would pass it, shortened to where the response is straight."""
    limits = np.array([LIMITS[name] for name in device.names])
    held = ((device.values <= limits[:, 0]) & (right < 0)) | ((device.values >= limits[:, 1]) & (right > 0))
    step = np.zeros(len(right))
    free = np.flatnonzero(~held)
    size = np.sqrt(np.maximum(np.diag(normal)[free], 1e-300))
    scaled = normal[np.ix_(free, free)] / np.outer(size, size) + (factor + 1e-13) * np.eye(len(free))
    step[free] = np.linalg.solve(scaled, right[free] / size) / size
    most = np.array([LARGEST_STEP.get(name, np.inf) for name in device.names])
    return np.asarray(step * min(1.0, float((most / np.maximum(np.abs(step), 1e-300)).min())))


def judged(trials: LadderTrials, device: Device) -> tuple[Floats, Booleans]:
    """Return the misfit of each trial under a device, and which it explains within what the sensor leaves open."""
    (motion,) = _motions(trials, [device])
    error = _about_start(trials, trials.position - motion)
    misfit = np.sqrt((error**2).sum(axis=1) / np.maximum(trials.information - 1, 1.0))
    whiteness = portmanteau(error.T, trials.independent.T)
    return misfit, np.asarray((misfit <= trials.misfit_allowed) & ~(whiteness < LEAST_WHITENESS))


def covariance_of(trials: LadderTrials, fit: Fit) -> Floats:
    """Return the covariance of a device's numbers at their least squares, shape (P, P).

    Notes
    -----
    The larger, number by number, of what the readings leave open and of what the trials do: the sandwich of the
    trials' scores, which holds what differs between them and what the model misses.
    """
    P, n = fit.slopes.shape[:2]
    normal, _ = fit.normal
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    inverse = np.linalg.pinv(normal / np.outer(size, size), rcond=1e-13, hermitian=True) / np.outer(size, size)
    scores = np.einsum("pnk,nk->pn", fit.slopes, fit.error)
    scale = max(fit.cost / max(float(trials.information.sum()) - P - n, 1.0), 1.0)
    readings = inverse * scale
    between = inverse @ (scores @ scores.T) @ inverse * n / max(n - P, 1)
    wider = np.sqrt(np.maximum(np.diag(between), np.diag(readings)) / np.maximum(np.diag(readings), 1e-300))
    return np.asarray(readings * np.outer(wider, wider))
