"""The likeliest device near one: Newton's steps on the likelihood of all trials, and the noise behind them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.base.progress import approach
from pipeline.measured.identification.likelihood import (
    DONE,
    LIMITS,
    SCATTERED,
    WORTH,
    Device,
    Fit,
    fitted,
    phases_of,
)
from pipeline.measured.identification.noise import WHITE
from pipeline.measured.identification.noise_search import noise_and_jitter, with_jitter_error
from pipeline.measured.identification.scatter import FEWEST, inverse
from pipeline.measured.identification.segments import Segments
from pipeline.records.trials import Floats

FIXED_STEPS = 2
"""Steps at first without such scatter, before each search for noise."""

STEPS = 18
"""Newton's steps at most; seven are usual, a mode may take all."""

LAST_STEPS = 3
"""Steps on all logs from what some of them have shown: the last one is smaller than rounding."""

CUTS = (1.0, 0.3, 0.1)
"""Parts of a step that are tried."""

STEP_SHARE = 0.03
"""Part of what is left of a search that is done with a step: some thirty are usual."""

NOISE_ROUNDS = 4
"""Most searches for the noise behind the steps: with a mode the random force fell by a third to a tenth in each."""


def refined(
    segments: Segments,
    device: Device,
    steps: int = STEPS,
    *,
    far: bool = True,
    noisy: bool = True,
    jitters: bool = True,
) -> Fit:
    """Return the likeliest device near one, with the noise that makes its errors independent.

    Parameters
    ----------
    segments : Segments
    device : Device
    steps : int
        Most steps.
    far : bool
        Whether it starts far from the solution, where scatter between trials would explain everything.
    noisy : bool
        Whether the noise is looked for, too; else it stays as it is.
    jitters : bool
        Whether a jitter of the delay may be part of it.
    """
    scattered = SCATTERED if segments.trials >= FEWEST else ()
    places = np.array([i for i, name in enumerate(device.names) if name in scattered], dtype=np.int64)
    if far:
        for late in (False, jitters):
            device = _climbed(fitted(segments, device, places[:0]), segments, FIXED_STEPS).device
            device = replace(device, noise=noise_and_jitter(segments, device, jitters=late)) if noisy else device
    elif noisy:
        device = replace(device, noise=noise_and_jitter(segments, device, jitters=jitters))
    start = fitted(segments, device, places)
    found = _climbed(start, segments, steps)
    for number in range(NOISE_ROUNDS if noisy else 0):
        # noise is found with the numbers as they are, and far from the solution some of these are not
        if found.likelihood - start.likelihood < WORTH and not (far and number == 0):
            break
        # what was noise where the search began may be motion where it ends
        device = replace(found.device, noise=noise_and_jitter(segments, found.device, jitters=jitters))
        start = fitted(segments, device, places)
        again = _climbed(start, segments, steps)
        if again.likelihood <= found.likelihood:
            break
        found = again
    if noisy and found.device.noise != WHITE:
        plain = fitted(segments, replace(found.device, noise=WHITE), places)
        # what a step foretells from afar is too good
        if plain.likelihood > found.likelihood - WORTH:
            plain = _climbed(plain, segments, steps)
            found = plain if plain.likelihood > found.likelihood else found
    return found


def climbed(segments: Segments, device: Device, steps: int = STEPS) -> Fit:
    """Return the local optimum of the likelihood near a device, with its noise fixed and no scatter between trials."""
    return _climbed(fitted(segments, device, np.empty(0, dtype=np.int64)), segments, steps)


def ended(segments: Segments, device: Device) -> Fit:
    """Return the likeliest fit from a device on that is near it, with what its jitter leaves open."""
    fit = refined(segments, device, LAST_STEPS, far=False, noisy=False)
    fit = replace(fit, phases=phases_of(segments, fit))
    if not fit.device.noise.jitter:
        return fit
    noise = with_jitter_error(segments, fit.device)
    fit = replace(fit, device=replace(fit.device, noise=noise))
    other = replace(noise, jitter=noise.jitter + noise.jitter_error)
    return replace(fit, open=fitted(segments, replace(fit.device, noise=other), fit.places).solved.step)


def _climbed(fit: Fit, segments: Segments, steps: int) -> Fit:
    """Return the likeliest fit that Newton's steps lead to, each of them cut until the likelihood does not fall."""
    for _ in range(steps):
        approach(STEP_SHARE)
        step = _inner_step(fit)
        for cut in CUTS:
            device = fit.device.stepped(cut * step)
            change = np.array(list(device.numbers.values())) - np.array(list(fit.device.numbers.values()))
            if float(change @ fit.solved.total @ change) < DONE:
                return fit
            tried = fitted(segments, device, fit.places)
            gain = tried.solved.here - fit.solved.here
            if gain > 0:
                break
        else:
            return fit
        fit = tried
        if gain < 0.5 * DONE:
            break
    return fit


def _inner_step(fit: Fit) -> Floats:
    """Return Newton's step along the numbers that do not stand at a limit beyond which the likelihood rises."""
    step, total = fit.solved.step, fit.solved.total
    values = np.array(list(fit.device.numbers.values()))
    low, high = np.array([LIMITS.get(name, (-np.inf, np.inf)) for name in fit.device.names]).T
    slope, free = total @ step, np.ones(len(step), dtype=bool)
    while (beyond := free & np.where(step < 0, values <= low, (step > 0) & (values >= high))).any():
        free &= ~beyond
        step = np.zeros(len(step))
        step[free] = inverse(total[np.ix_(free, free)]) @ slope[free]
    return step
