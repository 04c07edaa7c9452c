"""Where responses of a general loop settle, told from their modes, so that what lies before need not be followed.

A mode's motion between samples is bounded by the coefficients of its polynomials (Bernstein's form); the sum of these
envelopes bounds the response at every later time. Nothing is believed of modes that do not reproduce the present
state. As `march` does for ideal loops, whose three slowest modes it reads from their samples.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from math import comb

import numpy as np

from pipeline.loop.loop import Loop
from pipeline.loop.plant import turning_time
from pipeline.records.batch import Floats, Integers
from pipeline.theory.modes import TOGETHER, Modes, modes
from pipeline.theory.motion import DEGREE, Motion, joined, pieces, starts
from pipeline.theory.slowmodes import Complexes, SlowModes, force_factor

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
        off = np.abs(past.at(run.sample) - run.state)[: len(run.scale)]
        known = (off * run.scale).sum(axis=0) <= _REPRODUCED * run.size()  # nan compares false
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
        run, end = self.run.part(slice(None)), envelope_end(self.size.T, self.rate.T, band)
        lead = np.argmax(self.size * np.exp(-self.rate * end[:, None]), axis=1)[:, None]
        angle, largest, actual, decay = (
            np.take_along_axis(values, lead, 1)[:, 0]
            for values in (np.angle(self.pole), self.size, np.abs(self.sensed[:, 0]), self.rate)
        )
        turns = _HALF_TURNS * np.pi / np.maximum(np.abs(angle), _STRAIGHT) * (angle != 0)
        window = _SHORTEST + 1.1 * np.log(largest / actual) / decay + turns
        run.since, run.stop = run.sample, run.sample + end + 1
        return _placed(run, self.past, np.maximum(np.floor(run.stop - window), run.since))

    def before_a_peak(self, peak: Floats) -> Motion:
        """Return the points whose motion may exceed a peak, shape (n,), at a sample before it does."""
        with np.errstate(all="ignore"):  # of no motion at all nothing is finite
            free = self._below(peak)
            may = np.flatnonzero(np.isfinite(free))
            free = np.maximum(free[may], self._leap(may, peak[may]))
        sample = self.run.sample[may] + np.where(free >= _SHORTEST, np.floor(free), 0.0)
        return _placed(self.run.part(may), self.past.part(may), sample)

    def _below(self, peak: Floats) -> Floats:
        """Return samples in which the envelopes keep the motion below a peak; infinity where they always do."""
        # how far a motion below zero comes up again within an interval
        least = np.maximum(-self.sensed.real.max(axis=1), 0.0)
        slow = SlowModes(self.pole.T, self.sensed[:, 0].T, np.ones(len(peak), np.bool_))
        share = ((self.size - least) / (self.size + least)).T
        return np.nan_to_num(untouched(slow, self.size.T, self.rate.T, share, peak), nan=0.0, posinf=np.inf)

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
    """Return points a wider window before their stop."""
    parts = [run.part(slice(first, first + TOGETHER)) for first in range(0, len(run.index), TOGETHER)]
    for i, part in enumerate(parts):
        start = np.maximum(np.floor(part.stop - _WIDER * (part.stop - part.sample)), part.since)
        parts[i] = _placed(part, modes(part.loop, part.alpha, part.beta, "step"), start)
    return joined(parts) if parts else run


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


_TURN = 1.6
"""Size of log z up to which the two constants below hold."""

_CUBIC, _QUARTIC = 0.0081, 0.0102
"""|parabola|/|z|^t - 1 <= _CUBIC |Re w^3| + _QUARTIC |w|^4 with w = log z, for |z| <= 1 and |w| <= _TURN.

The cubic part is max |s^3 - s/4|/6, the quartic one the largest found on a dense grid; a test repeats that."""

_ROUNDING = 0.99
"""Share of a leading negative mode that all others together may have for it to keep its sign."""


def excess(loop: Loop, alpha: Floats, beta: Floats, pole: Complexes) -> Floats:
    """Return a bound of the share by which the motion of modes between samples exceeds |z|^t.

    Parameters
    ----------
    loop : Loop
        With an integer delay.
    alpha, beta : float64, shape (n,)
    pole : complex128, shape (k, n)
        Inside the unit circle, not 0.

    Notes
    -----
    The difference r(t) of the mode's motion and z^t solves r'' + delta r' + gamma r = u - (w^2 + delta w + gamma) z^t
    with r = 0 at both samples, so it is at most the right side's bound times the largest value of the motion that
    starts and ends at zero under a constant unit force: Green's function has one sign for gamma < pi^2 + delta^2/4.
    For the double integrator and |w| <= 1.6 the motion is a parabola known by its ends, and the bound is sharper.
    """
    w = np.log(pole)
    turn = np.abs(w)
    if loop.gamma == 0 and loop.delta == 0:
        r, t = w.real, w.imag
        result = _CUBIC * np.abs(r * (r * r - 3 * t * t)) + _QUARTIC * turn**4
        rough = np.flatnonzero((turn > _TURN).any(axis=0))
        if len(rough):
            bound = _by_green(loop, alpha[rough], beta[rough], pole[:, rough], w[:, rough])
            result[:, rough] = np.where(turn[:, rough] > _TURN, bound, result[:, rough])
    else:
        result = _by_green(loop, alpha, beta, pole, w)
    return np.asarray(result)


def _by_green(loop: Loop, alpha: Floats, beta: Floats, pole: Complexes, w: Complexes) -> Floats:
    characteristic = w * (w + loop.delta) + loop.gamma
    push = force_factor(loop, alpha, beta, pole)
    right = np.abs(push - characteristic * np.sqrt(pole)) + 0.5 * np.abs(characteristic * w)
    return np.asarray(_largest_arc(loop) * right / np.abs(pole))


def _largest_arc(loop: Loop) -> float:
    """Largest value of y with y'' + delta y' + gamma y = -1 and y(0) = y(1) = 0; 1/8 for a double integrator."""
    start = loop.period.gain[0] / loop.period.transition[0, 1]
    if not 0 < start < np.inf:
        return np.inf
    top = turning_time(loop.gamma, loop.delta, np.zeros(1), np.array([start]), np.array([-1.0]), 1.0)
    return float(loop.position_after(top, np.zeros(1), np.array([start]), np.array([-1.0]))[0])


def untouched(modes: SlowModes, size: Floats, rate: Floats, beyond: Floats, peak: Floats) -> Floats:
    """Return a time until which no deviation exceeds a peak; infinity where none ever does.

    Parameters
    ----------
    modes : SlowModes
    size, rate, beyond : float64, shape (3, n)
        Bound of each mode's motion now [final displacement], its decay per sample, and its `excess`.
    peak : float64, shape (n,)
        Largest deviation so far.

    Returns
    -------
    float64, shape (n,)
        Samples from now; 0 where nothing is known.

    Notes
    -----
    Infinite where all modes on the far side of the final position are smaller than the peak; also where a real mode on
    the near side outweighs them until they are. The ratio of a sum of exponentials to one exponential is convex in
    time: it suffices to look at both ends, and where it exceeds 1 at the far end, Newton's method from there comes to
    the time of overtaking from above.
    """
    below = (np.abs(modes.pole.imag) < 1e-12) & (modes.pole.real > 0) & (modes.amplitude.real < 0)
    others = np.where(below, 0.0, size)
    total = others.sum(axis=0)
    result = np.where(total <= peak, np.inf, 0.0)
    some = np.flatnonzero((total > peak) & below.any(axis=0))
    if not len(some):
        return np.asarray(result)
    lead = np.argmax(np.where(below[:, some], size[:, some], -1.0), axis=0)[None]
    leading, decay, share = (np.take_along_axis(values[:, some], lead, 0)[0] for values in (size, rate, beyond))
    outweighs = _ROUNDING * leading * (1 - share) / (1 + share)
    others, total, faster = others[:, some], total[some], rate[:, some] - decay
    slowest = np.where(others > 0, rate[:, some], np.inf).min(axis=0)
    span = np.log(total / peak[some]) / slowest
    overtaking = _overtaking(others, faster, outweighs, span)
    safe = total <= outweighs
    result[some] = np.where(safe & ((slowest >= decay) | (overtaking >= span)), np.inf, np.where(safe, overtaking, 0.0))
    return np.asarray(result)


def _overtaking(others: Floats, faster: Floats, outweighs: Floats, span: Floats) -> Floats:
    """Time before ``span`` at which sum of others exp(-faster t) passes ``outweighs``; span where it does not."""
    time = span.copy()
    with np.errstate(divide="ignore", invalid="ignore"):
        size, goal = np.log(others), np.log(outweighs)
        for _ in range(30):
            exponent = size - faster * time
            top = exponent.max(axis=0)  # the ratio itself may overflow at the far end
            parts = np.exp(exponent - top)
            total = parts.sum(axis=0)
            excess_log = np.log(total) + top - goal
            step = excess_log * total / -(faster * parts).sum(axis=0)
            step = np.where((excess_log > 0) & (step > 0), np.minimum(step, time), 0.0)
            time -= step
            if not (step > 0.5).any():
                break
    # Newton's method stops above the passing by less than its last step
    return np.where(time < span, np.maximum(time - 1, 0.0), time)


def envelope_end(size: Floats, rate: Floats, band: float) -> Floats:
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
