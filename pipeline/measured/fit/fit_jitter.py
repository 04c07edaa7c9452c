"""The fit of a window with the jitter of its delay: how strong it is, and what it leaves of the other parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pipeline.measured.fit.fit_filter import Gains, filter_gains
from pipeline.measured.fit.fit_friction import with_friction
from pipeline.measured.fit.fit_noise import over_rows, portmanteau
from pipeline.measured.fit.fit_search import (
    SEARCH_REACH,
    SEARCH_ROWS,
    Solution,
    gains_at,
    inverse,
    predicted,
    search,
    shock_at,
    starting_values,
)
from pipeline.measured.fit.fit_window import Window
from pipeline.records.batch import Booleans, Floats, Integers

JITTERS = (0.05, 0.1, 0.2, 0.35, 0.6, 1.0, 1.6, 2.5)
"""Standard deviations of the delay [samples] that are tried; between them the likelihood is a parabola."""

LIKELY_JITTER = 1.0
"""Value of `JITTERS` that is tried first, with its neighbours: delays that scatter by a sample have 0.7."""

FIRST_JITTER = 0.5
"""Jitter to begin with: it carries a search through any jitter of the ladder, at some loss of precision."""

SHORT_ROWS = 25
"""Rows behind the first movement for a second start, before the answer of a chattering wall has built up."""

ASTRAY = 25.0
"""As `SUSPICIOUS`, for the first rows, from which on the whole window is not tried without jitter."""

JITTER_ROWS = 200
"""Rows beyond the first ones from which the strength of the jitter is read: some 300 arrivals tell it to 6 %."""

LONGEST_WITH_JITTER = 600
"""Rows behind the first movement that are used of a trial with jitter: the response is over, and what goes on is
chatter, which tells little of the parameters and takes twice as long."""

STEPS_WITH_JITTER = 12
"""Steps of the last search with jitter, which starts from a search over most of the information."""

HEAD_STEPS = 10
"""Steps of the search over the first rows, from which that over the whole window starts."""

FEW_STEPS = 5
"""Steps of a search from which only the next one starts."""

SUSPICIOUS = 1.5
"""Variance of the residuals, relative to the expected one, from which on jitter is looked for: ten standard
deviations of 1,000 readings. A baseline of 20 rows passes it by chance in one trial of fifteen, which costs time."""

SUSPICIOUS_WHITENESS = 1e-4
"""p-value of correlated errors below which jitter is looked for too: slow motion hides it from their variance."""

LEAST_GAIN = 10.0
"""Fall of the deviance from which on jitter is believed: a chance of 0.2 %."""

LEAST_GAIN_PER_ROW = 0.1
"""As `LEAST_GAIN`, for each row: rounding errors are not independent, and what they share can look like jitter."""

CORRELATED_ROWS = 6
"""Rows over which errors by jitter are correlated: a command in force holds on by up to the spread of the delay."""

ARRIVAL_CORRELATION = 0.18
"""Correlation of the delays in force in successive rows for delays drawn from d - 1, d, d + 1: covariance 8/81,
variance 44/81 (by enumeration of three commands)."""

STEADY_SHARES = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
"""Variances of a steady unknown force that are tried, relative to the mean variance of the force by jitter."""

LARGEST_LEVERAGE = 0.75
"""Share of its own error that a row may have taken into the fit: beyond it what is left of the error is noise."""

LARGEST_SCALE = 4.0
"""Variance relative to the expected one that the sensor may have, as its noise is known from a short baseline."""

SMALLEST_SCALE = 0.25
"""As `LARGEST_SCALE`, for noise; of the quantum's share nothing is taken away."""

MEASURE = 0.1
"""Jitter [samples] at which the deviance is read to say how much jitter could have gone unseen."""


@dataclass(frozen=True, eq=False)
class JitterFit:
    """Solution with its prediction errors, shape (n,) unless said otherwise.

    Parameters
    ----------
    window : Window
        What was used in the end.
    solution : Solution
    jitter, jitter_error : float64
        Standard deviation of the delay [samples]; the error is infinite where the log does not tell it.
    error : float64, shape (N, n)
        Whitened errors of the prediction.
    scale : float64
        Variance of the errors relative to the expected one, and at least what the quantum alone makes.
    inflation : float64, shape (P, n)
        Factor on the standard error of each parameter for errors that are correlated; 1 without jitter.
    steady : float64
        By how much an unknown force that does not follow the command explains the readings better than the jitter
        (fall of the deviance); -inf without jitter.
    friction : float64
        By how much Coulomb friction beside the jitter explains them better; -inf without jitter.
    """

    window: Window
    solution: Solution
    jitter: Floats
    jitter_error: Floats
    error: Floats
    scale: Floats
    inflation: Floats
    steady: Floats
    friction: Floats


def fit_window(window: Window, start: Floats, lag: Integers) -> JitterFit:
    """Return the fit of each trial, without jitter where that explains the readings.

    Parameters
    ----------
    window : Window
    start : float64, shape (P, n)
    lag : int64, shape (n,)
        Delay by the first position change [samples].

    Notes
    -----
    The first rows give what the whole window starts from, since a long chattering record has many local minima.
    """
    rows = int((window.edge + np.maximum(lag, SEARCH_REACH)).max(initial=0)) + SEARCH_ROWS
    longest = rows - SEARCH_ROWS + LONGEST_WITH_JITTER
    solution = _without_jitter(window, start, rows)
    jitter, lowest = np.zeros(start.shape[1]), np.full(start.shape[1], np.inf)
    look = _suspicious(window, solution)
    if look.any():
        # with jitter the device moves between equal readings too: each counts
        part = window.select(look).head(longest)
        part = replace(part, run=np.ones_like(part.run))
        found, strength = _likeliest(part, start[:, look], lag[look], rows)
        without = deviance(part, solution.parameters[:, look], np.zeros_like(strength))
        least = np.maximum(LEAST_GAIN, LEAST_GAIN_PER_ROW * part.inside.sum(axis=0))
        with_it = deviance(part, found.parameters, strength)
        better = without > with_it + least
        where = np.flatnonzero(look)[better]
        lowest[where] = with_it[better]
        solution.put(where, found.select(better))
        jitter[where] = strength[better]
    window = replace(window.shortened(jitter > 0, longest), run=np.where(jitter > 0, 1.0, window.run))
    return _with_errors(window, solution, jitter, lowest, longest)


def _without_jitter(window: Window, start: Floats, rows: int) -> Solution:
    """Return the fit without jitter; it has not converged where the first rows need one."""
    none = np.zeros(start.shape[1])
    solution = search(window.head(rows), start, none, most_steps=HEAD_STEPS)
    # where the first rows need jitter, a search without it would go astray over the whole window
    calm = (solution.scale <= ASTRAY) | ~window.noise_known
    if calm.any():
        solution.put(calm, search(window.select(calm), solution.parameters[:, calm], none[calm]))
    solution.converged[~calm] = False
    return solution


def _suspicious(window: Window, solution: Solution) -> Booleans:
    """Return for which trials the fit without jitter misses more than the sensor explains, or in a correlated way."""
    look: Booleans = (solution.scale > SUSPICIOUS) | ~solution.converged
    unsure = ~look & window.noise_known
    if unsure.any():
        part, p, none = window.select(unsure), solution.parameters[:, unsure], np.zeros(int(unsure.sum()))
        plain = predicted(part, p, gains_at(part, p, none), none, derivatives=False)
        look[unsure] = portmanteau(plain[:, 0], part.independent) < SUSPICIOUS_WHITENESS
    return look


def _likeliest(window: Window, start: Floats, lag: Integers, rows: int) -> tuple[Solution, Floats]:
    """Return the solution with jitter from the better of two starts, and that jitter [samples]."""
    found, strength = _with_jitter(window, start, rows)
    poor = (found.scale > LARGEST_SCALE) | ~found.converged
    if poor.any():
        # chatter can drown the response in as many rows as the start is read from: then fewer do better
        again = window.select(poor)
        other, other_strength = _with_jitter(again, starting_values(again, lag[poor], rows=SHORT_ROWS), rows)
        first = deviance(again, found.parameters[:, poor], strength[poor])
        won = deviance(again, other.parameters, other_strength) < first
        where = np.flatnonzero(poor)[won]
        found.put(where, other.select(won))
        strength[where] = other_strength[won]
    return found, strength


def _with_errors(window: Window, solution: Solution, jitter: Floats, lowest: Floats, longest: int) -> JitterFit:
    """Return a fit with its errors; ``lowest`` is the deviance of those with jitter."""
    n, jittery = len(jitter), jitter > 0
    error, steady, friction = np.full(n, np.inf), np.full(n, -np.inf), np.full(n, -np.inf)
    inflation, white = np.ones(solution.parameters.shape), np.zeros(window.position.shape)
    scale = np.maximum(solution.scale, smallest_scale(window))
    for which in (jittery, ~jittery):
        if not which.any():
            continue
        part, p, s = window.select(which), solution.parameters[:, which], jitter[which]
        if which is jittery:
            part = part.head(longest)
        run = predicted(part, p, gains_at(part, p, s), s, derivatives=which is jittery)
        white[: len(part.position), which] = run[:, 0]
        if which is jittery:
            error[which] = _jitter_error(part, p, s, lowest[which])
            steady[which] = lowest[which] - steady_force_deviance(part, p, s)
            moved, q = with_friction(part, p, s)
            # friction does not jitter: the gains are those of the command alone
            friction[which] = lowest[which] - _finite(_deviance(moved, q, gains_at(part, q, s), s))
            model = inverse(solution.normal[which]) * scale[which, None, None]
            inflation[:, which] = _inflation(run, solution.normal[which], model)
        else:
            error[which] = _unseen(part, p)
    return JitterFit(window, solution, jitter, error, white, scale, inflation, steady, friction)


def _with_jitter(window: Window, start: Floats, rows: int) -> tuple[Solution, Floats]:
    """Return the solution with the most likely jitter, and that jitter [samples]."""
    first = np.full(start.shape[1], FIRST_JITTER)
    found = search(window.head(rows), start, first, most_steps=FEW_STEPS)
    early = window.head(rows + JITTER_ROWS)
    found = search(early, found.parameters, first, most_steps=FEW_STEPS)
    strength = strongest(early, found.parameters)
    return search(window, found.parameters, strength, most_steps=STEPS_WITH_JITTER), strength


def _inflation(columns: Floats, normal: Floats, covariance: Floats) -> Floats:
    """Return by how much correlated, unequal errors raise the standard error of each parameter, shape (P, n).

    The arrivals of successive commands are not independent, and few of them carry a large change. The variance of
    the estimate is summed from the products of neighbouring rows' contributions (Newey and West), with each
    error put back to what it was before the fit took its share of it (leverage). A few hundred rows tell this sum
    poorly, so that it is at least what commands that do not overtake make of a steadily changing force.
    """
    weight_of = over_rows("ijn,kjn->kin", np.moveaxis(inverse(normal), 0, -1), columns[:, 1:])
    leverage = over_rows("kin,kin->kn", weight_of, columns[:, 1:])
    share = weight_of * (columns[:, 0] / (1 - np.minimum(leverage, LARGEST_LEVERAGE)))[:, None, :]
    total = over_rows("kin,kin->in", share, share)
    for lag in range(1, CORRELATED_ROWS + 1):
        weight = 2 * (1 - lag / (CORRELATED_ROWS + 1))
        total += weight * over_rows("kin,kin->in", share[lag:], share[:-lag])
    expected = np.einsum("nii->in", covariance)
    result: Floats = np.sqrt(np.maximum(total / expected, 1 + 2 * ARRIVAL_CORRELATION))
    return result


def smallest_scale(window: Window) -> Floats:
    """Return the least variance of the readings relative to the expected one: what the quantum alone makes."""
    return np.where(window.noise_known, np.maximum(window.quantum_share, SMALLEST_SCALE), 0.0)


def deviance(window: Window, parameters: Floats, jitter: Floats) -> Floats:
    """Return minus twice the logarithm of the likelihood, up to a constant, at given parameters, shape (n,)."""
    return _deviance(window, parameters, gains_at(window, parameters, jitter), jitter)


def _deviance(window: Window, parameters: Floats, gains: Gains, jitter: Floats) -> Floats:
    white = predicted(window, parameters, gains, jitter, derivatives=False)[:, 0]
    cost = over_rows("kn,kn->n", white, white)
    mean = cost / np.maximum(gains.information - len(parameters), 1.0)
    lowest = np.where(window.noise_known, smallest_scale(window), 1e-300)
    highest = np.where(window.noise_known, LARGEST_SCALE, np.inf)
    scale = np.clip(mean, lowest, highest)
    result: Floats = window.inside.sum(axis=0) * np.log(scale) + cost / scale + gains.log_variance
    return result


def steady_force_deviance(window: Window, parameters: Floats, jitter: Floats) -> Floats:
    """Return the least deviance with a force error that does not follow the command, shape (n,).

    In place of the jitter there is an unknown force of the same variance in every row: jitter acts only where the
    command changes, friction and resonances act all the time.
    """
    mean = over_rows("kn->n", shock_at(window, parameters, jitter) * window.inside) / window.inside.sum(axis=0)
    shares = np.array(STEADY_SHARES)

    def at(trials: Integers, rung: Integers) -> Floats:
        part, p = window.select(trials), parameters[:, trials]
        shock = np.broadcast_to(shares[rung] * mean[trials], part.force.shape)
        gains = filter_gains(part.variance * part.run, part.run, shock, p)
        return _deviance(part, p, gains, np.zeros(len(trials)))

    lowest: Floats = _down_the_ladder(at, len(jitter), len(shares), len(shares) - 2).min(axis=0)
    return lowest


def strongest(window: Window, parameters: Floats) -> Floats:
    """Return the most likely jitter [samples] at given parameters, within the ladder."""
    ladder = np.array(JITTERS)

    def at(trials: Integers, rung: Integers) -> Floats:
        return deviance(window.select(trials), parameters[:, trials], ladder[rung])

    trial = np.arange(parameters.shape[1])
    values = _down_the_ladder(at, len(trial), len(ladder), JITTERS.index(LIKELY_JITTER))
    best = np.argmin(values, axis=0)
    inner = (best > 0) & (best < len(ladder) - 1)
    at_least = np.clip(best, 1, len(ladder) - 2)
    x = np.log(ladder)
    x0, x1, x2 = (x[at_least + offset] for offset in (-1, 0, 1))
    y0, y1, y2 = (values[at_least + offset, trial] for offset in (-1, 0, 1))
    with np.errstate(invalid="ignore", divide="ignore"):
        left, right = (y1 - y0) / (x1 - x0), (y2 - y1) / (x2 - x1)
        bend = (right - left) / (x2 - x0)
        vertex = 0.5 * (x0 + x1) - left / (2 * bend)
    fits = inner & np.isfinite(vertex)
    result: Floats = np.where(fits, np.exp(np.clip(np.where(fits, vertex, 0.0), x0, x2)), ladder[best])
    return result


def _down_the_ladder(
    deviance_at: Callable[[Integers, Integers], Floats], trials: int, rungs: int, middle: int
) -> Floats:
    """Return the deviances about the least one on a ladder, shape (rungs, trials), infinite where not needed.

    Each trial begins with the ``middle`` rung and the two beside it, and goes on to the side that is lower until both
    neighbours of the lowest are known: a likelihood has one peak.
    """
    values, known = np.full((rungs, trials), np.inf), np.zeros((rungs, trials), dtype=np.bool_)
    every = np.arange(trials)
    for rung in (middle - 1, middle, middle + 1):
        values[rung] = _finite(deviance_at(every, np.full(trials, rung)))
        known[rung] = True
    while True:  # ends after as many rounds as there are rungs: each makes one more known, of each open trial
        best = np.argmin(values, axis=0)
        below, above = np.maximum(best - 1, 0), np.minimum(best + 1, rungs - 1)
        rung = np.where(known[below, every], above, below)
        open_trials = np.flatnonzero(~known[rung, every])
        if not len(open_trials):
            return values
        at = rung[open_trials]
        values[at, open_trials] = _finite(deviance_at(open_trials, at))
        known[at, open_trials] = True


def _finite(values: Floats) -> Floats:
    return np.where(np.isfinite(values), values, np.inf)


def _jitter_error(window: Window, parameters: Floats, jitter: Floats, middle: Floats) -> Floats:
    """Return the standard error of a jitter by the bend of the deviance, infinite where it has none, shape (n,).

    ``middle`` is the deviance at that jitter.
    """
    span = 0.2 * jitter
    low, high = (deviance(window, parameters, jitter + sign * span) for sign in (-1, 1))
    # the deviance rises by (change/error)^2
    with np.errstate(divide="ignore"):
        result: Floats = span / np.sqrt(np.maximum(0.5 * (low + high) - middle, 0.0))
    return result


def _unseen(window: Window, parameters: Floats) -> Floats:
    """Return the standard error of a jitter of 0: the one at which the deviance has risen by 1, shape (n,)."""
    none = np.zeros(parameters.shape[1])
    rise = deviance(window, parameters, none + MEASURE) - deviance(window, parameters, none)
    with np.errstate(divide="ignore"):
        result: Floats = MEASURE / np.sqrt(np.maximum(rise, 0.0))
    return result
