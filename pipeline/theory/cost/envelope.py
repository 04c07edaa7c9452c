"""What slow modes can still do: bounds of the motion from its samples' modes, also between samples.

Of a mode with pole z the motion between two samples follows the plant, not z^t. `excess` bounds the difference; with it
the sum of the modes' envelopes bounds the motion at every later time.
"""

from __future__ import annotations

import numpy as np

from pipeline.loop.loop import Loop
from pipeline.loop.plant import turning_time
from pipeline.records.batch import Floats
from pipeline.theory.cost.slowmodes import Complexes, SlowModes, force_factor

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
