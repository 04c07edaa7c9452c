"""Find the maximum-likelihood device near a starting value by Newton steps, together with its noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from pipeline.base.progress import approach
from pipeline.measured.identification.likelihood import (
    DONE,
    FREE_LIMITS,
    LIMITS,
    SCATTERED,
    WORTH,
    Device,
    Fit,
    fitted,
    phases_of,
)
from pipeline.measured.identification.noise import WHITE
from pipeline.measured.identification.noise_search import ENOUGH, MEMORIES, noise_and_jitter, with_jitter_error
from pipeline.measured.identification.scatter import FEWEST, inverse
from pipeline.measured.identification.segments import Segments
from pipeline.records.trials import Floats, Integers

FIRST_FORCES = (1e-8, 1e-6, 1e-4, 1e-2)
"""Variances of a random force that the search for the noise may miss, relative to the variance of a reading."""

FORCE_FACTOR = 10**0.5
"""Ratio of the variances of successive random forces in a search over whole segments."""

FIXED_STEPS = 2
"""Number of initial steps without scatter between trials, before each search for the noise."""

STEPS = 18
"""Largest number of Newton steps. Seven are usual, but a mode may need all of them."""

LAST_STEPS = 3
"""Number of steps on all logs from the result of a subset. The last step is below rounding."""

CUTS = (1.0, 0.3, 0.1)
"""Fractions of a step that are evaluated in this order."""

STEP_SHARE = 0.03
"""Share of the remaining search that each step reports as progress. About thirty steps are usual."""

NOISE_ROUNDS = 4
"""Largest number of searches for the noise after the steps. With a mode, each search reduced the random force to
between a tenth and a third."""


def refined(
    segments: Segments,
    device: Device,
    steps: int = STEPS,
    *,
    far: bool = True,
    noisy: bool = True,
    jitters: bool = True,
) -> Fit:
    """Return the maximum-likelihood device near a starting value, with the noise that whitens its errors.

    Parameters
    ----------
    segments : Segments
    device : Device
    steps : int
        Largest number of steps.
    far : bool
        Whether the search starts far from the solution, so that scatter between trials could explain everything.
    noisy : bool
        Whether the noise is estimated. Otherwise, it is not changed.
    jitters : bool
        Whether the noise may include a jitter of the delay.
    """
    places = _scattered(segments, device)
    if far:
        for late in (False, jitters):
            device = _climbed(fitted(segments, device, places[:0]), segments, FIXED_STEPS).device
            device = _with_noise(segments, device, places[:0], jitters=late).device if noisy else device
    elif noisy:
        device = _with_noise(segments, device, places, jitters=jitters).device
    start = fitted(segments, device, places)
    found = _climbed(start, segments, steps)
    for number in range(NOISE_ROUNDS if noisy else 0):
        # noise is estimated with the current numbers, which may be wrong far from the solution
        if found.likelihood - start.likelihood < WORTH and not (far and number == 0):
            break
        # motion may be mistaken for noise at the start of the search
        start = _with_noise(segments, found.device, places, jitters=jitters)
        again = _climbed(start, segments, steps)
        if again.likelihood <= found.likelihood:
            break
        found = again
    if noisy and found.device.noise != WHITE:
        plain = fitted(segments, replace(found.device, noise=WHITE), places)
        # a step predicted far from the solution is too optimistic
        if plain.likelihood > found.likelihood - WORTH:
            plain = _climbed(plain, segments, steps)
            found = plain if plain.likelihood > found.likelihood else found
    return found


def _scattered(segments: Segments, device: Device) -> Integers:
    """Return the places of the numbers that vary between trials."""
    scattered = SCATTERED if segments.trials >= FEWEST else ()
    return np.array([i for i, name in enumerate(device.names) if name in scattered], dtype=np.int64)


def _with_noise(segments: Segments, device: Device, places: Integers, *, jitters: bool) -> Fit:
    """Return the fit of a device with the noise that whitens its errors.

    The search for the noise uses short parts of the segments, each with a constant force, so a force that changes
    slowly has no effect. With many logs, the constant force of each log contains such a force. With few logs, a further
    search from this noise therefore finds the maximum-likelihood random force over whole segments.
    """
    fit = fitted(segments, replace(device, noise=noise_and_jitter(segments, device, jitters=jitters)), places)
    noise = fit.device.noise
    if segments.trials >= FEWEST or (noise.jitter and not noise.force):
        return fit

    def with_force(force: float) -> Fit:
        return fitted(segments, replace(fit.device, noise=replace(noise, force=force), effects=None), places)

    if not noise.force:
        best = max((with_force(force) for force in FIRST_FORCES), key=lambda each: each.likelihood)
        if best.likelihood < fit.likelihood + WORTH:
            return fit
        fit = best
    for factor in (FORCE_FACTOR, 1 / FORCE_FACTOR):
        while MEMORIES[0] < (force := factor * fit.device.noise.force) < MEMORIES[1]:
            tried = with_force(force)
            if tried.likelihood < fit.likelihood + ENOUGH:
                break
            fit = tried
    return fit


def climbed(segments: Segments, device: Device, steps: int = STEPS) -> Fit:
    """Return the local optimum of the likelihood near a device, with fixed noise and no scatter between trials."""
    return _climbed(fitted(segments, device, np.empty(0, dtype=np.int64)), segments, steps)


def ended(segments: Segments, device: Device) -> Fit:
    """Return the final maximum-likelihood fit near a device, with the uncertainty due to its jitter."""
    fit = _climbed(fitted(segments, device, _scattered(segments, device), phased=True), segments, LAST_STEPS)
    # a number at its limit, such as a delay of 0, shifts the other numbers: the optimum without limits is different
    inside = _inner_step(fit, FREE_LIMITS if segments.free else LIMITS)
    beyond = [fit.solved.step] if (inside != fit.solved.step).any() else []
    optima = np.stack([np.zeros(len(fit.device.names)), *beyond])
    fit = replace(fit, phases=phases_of(fit), optima=optima)
    if not fit.device.noise.jitter:
        return fit
    noise = with_jitter_error(segments, fit.device)
    fit = replace(fit, device=replace(fit.device, noise=noise))
    other = replace(noise, jitter=noise.jitter + noise.jitter_error)
    return replace(fit, open=fitted(segments, replace(fit.device, noise=other), fit.places).solved.step)


def _climbed(fit: Fit, segments: Segments, steps: int) -> Fit:
    """Return the fit after Newton steps. Each step is shortened until the likelihood increases."""
    limits = FREE_LIMITS if segments.free else LIMITS
    for _ in range(steps):
        approach(STEP_SHARE)
        step = _inner_step(fit, limits)
        for cut in CUTS:
            device = fit.device.stepped(cut * step, limits)
            change = np.array(list(device.numbers.values())) - np.array(list(fit.device.numbers.values()))
            if float(change @ fit.solved.total @ change) < DONE:
                return fit
            tried = fitted(segments, device, fit.places, phased=len(fit.moments.of_phases) > 0)
            gain = tried.solved.here - fit.solved.here
            if gain > 0:
                break
        else:
            return fit
        fit = tried
        if gain < 0.5 * DONE:
            break
    return fit


def _inner_step(fit: Fit, limits: Mapping[str, tuple[float, float]]) -> Floats:
    """Return the Newton step without the numbers at a limit beyond which the likelihood would increase."""
    step, total = fit.solved.step, fit.solved.total
    values = np.array(list(fit.device.numbers.values()))
    low, high = np.array([limits.get(name, (-np.inf, np.inf)) for name in fit.device.names]).T
    slope, free = total @ step, np.ones(len(step), dtype=bool)
    while (beyond := free & np.where(step < 0, values <= low, (step > 0) & (values >= high))).any():
        free &= ~beyond
        step = np.zeros(len(step))
        step[free] = inverse(total[np.ix_(free, free)]) @ slope[free]
    return step
