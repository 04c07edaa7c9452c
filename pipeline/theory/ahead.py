"""Where responses settle, told from their modes, so that what lies before need not be followed.

A mode's motion between samples is bounded by the coefficients of its polynomials (Bernstein's form); the sum of these
envelopes bounds the response at every later time. Nothing is believed of modes that do not reproduce the present
state.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from math import comb

import numpy as np

from pipeline.loop.loop import Loop
from pipeline.records.batch import Booleans, Floats, Integers
from pipeline.theory.modes import TOGETHER, Modes, modes
from pipeline.theory.motion import DEGREE, Motion, joined, pieces, starts
from pipeline.theory.zoom import bisect

_REPRODUCED = 1e-11
"""Largest difference of a state and its modes, relative to its motion."""

_HALF_TURNS = 1.2
"""Length of the window in front of the end, in half turns of the mode that is largest there."""

_SHORTEST = 8.0
"""Length of that window at least [samples]."""

_WIDER = 4.0
"""Growth of the window where nothing outside the band was met in it."""

_FEW_STATES = 32
"""States up to which modes of 4,096 points fit a memory of some 100 MB."""

_ROUNDING = 0.99
"""Share of a leading negative mode that all others together may have for it to keep its sign."""

_REAL = 1e-12
"""Imaginary part of a real pole, which rounding may leave."""

_STRAIGHT = 1e-3
"""Angle of a pole [rad/sample] that counts as none for the window: 3,800 samples."""


class Outlook:
    """What modes tell of points that move.

    Parameters
    ----------
    run : Motion
        The points.
    past : Modes
        Theirs.

    Notes
    -----
    ``run`` are those of which modes tell, ``unknown`` the others.
    """

    def __init__(self, run: Motion, past: Modes) -> None:
        known = _told(run, past)
        known &= (past.rate > 0).all(axis=1)  # one that rounding leaves no decay never ends
        self.run, self.unknown, self.past = run.part(known), run.part(~known), past.part(known)
        self.pole, self.rate = self.past.pole, self.past.rate
        seen = run.loop.seen(run.loop.law(self.run.alpha, self.run.beta), self.past.state)
        seen *= self.past.grown(self.run.sample)[:, None, :]
        # real times complex, as two real ones
        self.sensed = (_bernstein(run.loop) @ seen.view(np.float64)).view(np.complex128)
        """Coefficients of each mode's motion in the next interval, shape (n, coefficients, modes)."""
        self.size = np.abs(self.sensed).max(axis=1)

    def before_the_end(self, band: float) -> Motion:
        """Return the points a window before their envelope is inside the band."""
        run, end = self.run.part(slice(None)), _envelope_end(self.size.T, self.rate.T, band)
        lead = np.argmax(self.size * np.exp(-self.rate * end[:, None]), axis=1)[:, None]
        angle, largest, actual, decay = (
            np.take_along_axis(values, lead, 1)[:, 0]
            for values in (np.angle(self.pole), self.size, np.abs(self.sensed[:, 0]), self.rate)
        )
        turns = _HALF_TURNS * np.pi / np.maximum(np.abs(angle), _STRAIGHT) * (angle != 0)
        window = _SHORTEST + 1.1 * np.log(largest / actual) / decay + turns
        run.since, run.begun, run.stop = run.sample, run.state, run.sample + end + 1
        return _placed(run, self.past, np.maximum(np.floor(run.stop - window), run.since))

    def before_a_peak(self, peak: Floats) -> Motion:
        """Return the points whose motion may exceed a peak, shape (n,), at a sample before it does."""
        with np.errstate(all="ignore"):  # of no motion at all nothing is finite
            free = np.nan_to_num(self._below(peak), nan=0.0, posinf=np.inf)
            may = np.flatnonzero(np.isfinite(free))
            free = np.maximum(free[may], self._leap(may, peak[may]))
        sample = self.run.sample[may] + np.where(free >= _SHORTEST, np.floor(free), 0.0)
        return _placed(self.run.part(may), self.past.part(may), sample)

    def _below(self, peak: Floats) -> Floats:
        """Return samples in which the envelopes keep the motion below a peak; infinity where they always do.

        They do where all modes that may rise above the final position are smaller than the peak; also while a real mode
        below it outweighs them. The ratio of a sum of exponentials to one exponential is convex in time: it suffices to
        know it now and where the others are below the peak.
        """
        # what a motion below zero keeps of itself within an interval
        least = np.maximum(-self.sensed.real.max(axis=1), 0.0)
        below = (np.abs(self.pole.imag) < _REAL) & (self.pole.real > 0) & (least > 0)
        others = np.where(below, 0.0, self.size)
        total = others.sum(axis=1)
        result = np.where(total <= peak, np.inf, 0.0)
        lead = np.argmax(np.where(below, self.size, -1.0), axis=1)[:, None]
        decay, outweighs = (np.take_along_axis(values, lead, 1) for values in (self.rate, _ROUNDING * least))
        some = np.flatnonzero((total > peak) & (total <= outweighs[:, 0]))
        others, faster, outweighs = others[some], self.rate[some] - decay[some], outweighs[some, 0]
        slowest = np.where(others > 0, self.rate[some], np.inf).min(axis=1)

        def holds(time: Floats) -> Booleans:
            return np.asarray((others * np.exp(-faster * time[:, None])).sum(axis=1) <= outweighs)

        span = np.log(total[some] / peak[some]) / slowest
        result[some] = np.where(holds(span), np.inf, bisect(holds, np.zeros(len(some)), span)[0])
        return result

    def _leap(self, which: Integers, peak: Floats) -> Floats:
        """Return samples in which the motion stays below a peak, or rises in each interval above the one before.

        Its coefficients change by sum_i sensed_i (pole_i^h - 1) in h samples, which is h times their first step up to
        h^2/2 sum_i size_i |pole_i - 1|^2; a later step differs from the first by at most h times that sum.
        """
        turn, sensed = self.pole[which] - 1, self.sensed[which]
        bend = (self.size[which] * np.abs(turn) ** 2).sum(axis=1)
        step = (sensed @ turn[:, :, None])[..., 0].real
        room, fastest = np.maximum(peak - sensed.sum(axis=2).real.max(axis=1), 0.0), step.max(axis=1)
        below = (np.sqrt(fastest**2 + 2 * bend * room) - fastest) / bend
        return np.asarray(np.maximum(below, step.min(axis=1) / bend))


def outlooks(run: Motion, everyone: Motion) -> Iterator[Outlook]:
    """Yield what modes tell of points, of which some may be unknown; ``everyone`` are all that were started with them.

    Modes of few states are those of everyone, since energies take them too; of many states they would fill the memory.
    """
    states = run.loop.states
    if states <= _FEW_STATES:
        yield Outlook(run, modes(run.loop, everyone.alpha, everyone.beta, "step").part(run.index - everyone.index[0]))
        return
    together = max(1, TOGETHER * _FEW_STATES**2 // (4 * states**2))
    for first in range(0, len(run.index), together):
        some = run.part(slice(first, first + together))
        yield Outlook(some, modes(run.loop, some.alpha, some.beta, "step"))


def earlier(run: Motion) -> Motion:
    """Return points a wider window before their stop; from where samples were left out, if modes fail for them."""
    parts = [run.part(slice(first, first + TOGETHER)) for first in range(0, len(run.index), TOGETHER)]
    for part in parts:
        past = modes(part.loop, part.alpha, part.beta, "step")
        start = np.maximum(np.floor(part.stop - _WIDER * (part.stop - part.sample)), part.since)
        part.sample, part.state = part.since, part.begun
        _placed(part, past, np.where(_told(part, past), start, part.since))
    return joined(parts) if parts else run


def _told(run: Motion, past: Modes) -> Booleans:
    """Return which points are where their modes say."""
    off = np.abs(past.at(run.sample) - run.state)[: len(run.scale)]
    return np.asarray((off * run.scale).sum(axis=0) <= _REPRODUCED * run.size())  # nan compares false


def _placed(run: Motion, past: Modes, sample: Floats) -> Motion:
    """Return points at other samples; where that is none, as they are."""
    moved = sample != run.sample
    run.state, run.sample = np.where(moved, past.at(sample), run.state), sample
    return run


@lru_cache(maxsize=64)
def _bernstein(loop: Loop) -> Floats:
    """Return the coefficients of the sensed position over all pieces as forms of `Loop.seen`, (13 pieces, q)."""
    change = [[comb(j, i) / comb(DEGREE, i) for i in range(DEGREE + 1)] for j in range(DEGREE + 1)]
    return np.concatenate(
        [np.array(change) @ piece.place @ given for piece, given in zip(pieces(loop), starts(loop), strict=True)]
    )


def _envelope_end(size: Floats, rate: Floats, band: float) -> Floats:
    """Return a time from which on the sum of size exp(-rate t) is inside the band, at most a sample too late."""
    time = np.zeros(size.shape[1])
    log_band = np.log(band)
    for _ in range(30):
        parts = size * np.exp(-rate * time)
        total = parts.sum(axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            # Newton's method on the logarithm, a convex function, comes from below
            step = (np.log(total) - log_band) * total / (rate * parts).sum(axis=0)
        step = np.where(total > band, step, 0.0)
        time += step
        if not (step > 0.5).any():
            break
    return np.where(time > 0, time + 1, 0.0)
