"""Weighted nonlinear least squares of one model per trial, all trials at once (Levenberg-Marquardt)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.measured.fit.fit_filter import (
    DAMPING,
    DELAY,
    GAIN,
    Gains,
    filter_gains,
    jitter_force,
    open_loop,
    predict,
    spread_force,
)
from pipeline.measured.fit.fit_motion import LARGEST_RATE
from pipeline.measured.fit.fit_noise import over_rows
from pipeline.measured.fit.fit_window import ROUNDING, Window
from pipeline.records.batch import Booleans, Floats, Integers

MOST_STEPS = 20
"""Steps of the search: from a sound start five are needed, a chattering log needs some fifteen."""

CONVERGED = 0.05
"""Step in standard errors from which on the search has converged: what is left does not show in an interval."""

NEARLY_CONVERGED = 0.25
"""As `CONVERGED`, for a search that has used up its steps: the response has kinks at whole delays, between which a
search goes to and fro; a quarter of a standard error widens an interval by 3 %."""

LARGEST_DELAY_STEP = 1.5
"""Change of the delay in one step [samples]: the response is smooth over a sample or two, not over more."""

FIRST_FACTOR = 1e-4
"""Levenberg-Marquardt factor to begin with, and the one at which no step lowers the cost: rounding is reached."""

RIDGE = 1e-14
"""Added to the unit diagonal of the normal equations, so that a parameter without influence stays where it is."""

SMALLEST_DAMPING = -0.05
"""Least delta: noise may put the damping of an undamped device below zero, but a motion that grows by itself e-fold in
20 samples is not one of these; over 3,000 rows it also stays within the range of double precision."""

SMALLEST_DELAY = -0.999
"""Noise may put the delay of an undelayed loop below zero; a command is not known before its row. Where the log
begins with the step, it is 0."""

SEARCH_ROWS = 100
"""Rows behind the first movement for the start: there damping is a small correction to the motion."""

SEARCH_REACH = 12
"""Whole samples around the first change that are tried for the start of the delay."""


@dataclass(frozen=True, eq=False)
class Solution:
    """Where a search is: parameters and normal equations of each trial.

    Parameters
    ----------
    parameters : float64, shape (P, n)
    normal : float64, shape (n, P, P)
        J' V^-1 J with the expected variances V.
    right : float64, shape (n, P)
        J' V^-1 r.
    cost, log_variance, information : float64, shape (n,)
        r' V^-1 r, log det V and number of independent readings.
    converged : bool, shape (n,)
    """

    parameters: Floats
    normal: Floats
    right: Floats
    cost: Floats
    log_variance: Floats
    information: Floats
    converged: Booleans

    def select(self, which: Booleans | Integers) -> Solution:
        """Return the trials picked by a mask or by indices."""
        return Solution(
            self.parameters[:, which],
            *(getattr(self, name)[which] for name in list(self.__dataclass_fields__)[1:]),
        )

    def put(self, where: Booleans | Integers, other: Solution) -> None:
        """Take over the trials of another solution at a mask or at indices."""
        self.parameters[:, where] = other.parameters
        for name in list(self.__dataclass_fields__)[1:]:
            getattr(self, name)[where] = getattr(other, name)

    @property
    def scale(self) -> Floats:
        """Variance of the residuals relative to the expected one, shape (n,)."""
        freedom = np.maximum(self.information - len(self.parameters), 1.0)
        return self.cost / freedom


def starting_values(window: Window, lag: Integers, rows: int = SEARCH_ROWS) -> Floats:
    """Return parameters to start from, by linear least squares over a ladder of whole delays, shape (P, n).

    Parameters
    ----------
    window : Window
    lag : int64, shape (n,)
        Delay by the first position change [samples].
    rows : int
        Rows behind the first movement that are used.

    Notes
    -----
    Over the first rows the response is linear in 1/m and delta/m: the undamped one, and its derivative.
    """
    base = np.maximum(lag - SEARCH_REACH, 0)
    n = len(lag)
    rows = int(min(len(window.position), (window.edge + np.maximum(lag, SEARCH_REACH)).max(initial=0) + rows))
    z, inside = window.position[:rows], window.inside[:rows]
    weight = np.where(inside, 1.0, 0.0)
    zero = np.zeros(n)
    undamped = np.stack([zero, zero + 1.0, base + zero, zero])
    motion = predict(np.zeros((rows, n)), window.force[:rows], open_loop(np.ones((rows, n))), undamped)
    sources = (-motion[:, 0], motion[:, 1 + DAMPING])
    best, cost = np.zeros((4, n)), np.full(n, np.inf)
    for shift in range(2 * SEARCH_REACH + 1):
        columns = np.ones((3, rows, n))
        for column, source in zip(columns, sources, strict=False):
            column[:shift] = 0.0
            column[shift:] = source[: rows - shift] if shift < rows else 0.0
        normal = np.stack([[over_rows("kn,kn,kn->n", a, b, weight) for b in columns] for a in columns])
        right = np.stack([over_rows("kn,kn->n", a * weight, z) for a in columns])
        solved = _solve(np.moveaxis(normal, 2, 0), right.T, 0.0)
        residual = over_rows("kn,kn->n", z * weight, z) - np.einsum("nc,cn->n", solved, right)
        with np.errstate(divide="ignore", invalid="ignore"):
            delta = np.clip(np.nan_to_num(solved[:, 1] / solved[:, 0]), 0.0, 0.3 * LARGEST_RATE)
        better = (residual < cost) & (solved[:, 0] > 0)
        found = np.stack([solved[:, 2], solved[:, 0], base + float(shift), delta])
        best = np.where(better, found, best)
        cost = np.where(better, residual, cost)
    best[GAIN] = np.where(best[GAIN] > 0, best[GAIN], 1e-6)
    return best


def search(window: Window, start: Floats, jitter: Floats, *, most_steps: int = MOST_STEPS) -> Solution:
    """Return the parameters of the smallest weighted sum of squares near the start.

    Parameters
    ----------
    window : Window
    start : float64, shape (P, n)
    jitter : float64, shape (n,)
        Standard deviation of the delay [samples] that the weights assume.
    most_steps : int

    Notes
    -----
    The weights are those of the start and stay while the search goes on.
    """
    gains = gains_at(window, start, jitter)
    position, force = window.position, spread_force(window.force, jitter)
    now = _solution(position, force, gains, start)
    final = now.select(np.arange(start.shape[1]))
    active = np.arange(start.shape[1])
    factor = np.full(start.shape[1], FIRST_FACTOR)
    smallest, smallest_delay = ROUNDING**2 / window.variance[0], np.maximum(-window.edge, SMALLEST_DELAY)
    for _ in range(most_steps):
        step = _solve(now.normal, now.right, factor)
        left = np.einsum("np,np->n", step, now.right) / np.maximum(now.scale, smallest)
        done = left <= CONVERGED**2
        # trials that have converged leave, so that the slow ones do not cost the time of all
        if done.any():
            now.converged[done] = True
            final.put(active[done], now.select(done))
            keep = ~done
            if not keep.any():
                return final
            position, force, gains, now = position[:, keep], force[:, keep], gains.select(keep), now.select(keep)
            active, factor, step = active[keep], factor[keep], step[keep]
            smallest, smallest_delay = smallest[keep], smallest_delay[keep]
        parameters = limited(now.parameters, step.T, smallest_delay)
        tried = _solution(position, force, gains, parameters)
        better = tried.cost < now.cost
        factor = np.where(better, factor * 0.1, factor * 10.0)
        now.put(better, tried.select(better))
    now.converged[:] = left[~done] <= NEARLY_CONVERGED**2 if done.any() else left <= NEARLY_CONVERGED**2
    final.put(active, now)
    return final


def gains_at(window: Window, parameters: Floats, jitter: Floats) -> Gains:
    """Return the filter's gains for given parameters and jitter [samples]."""
    shock = shock_at(window, parameters, jitter)
    return filter_gains(window.variance * window.run, window.run, shock, parameters)


def shock_at(window: Window, parameters: Floats, jitter: Floats) -> Floats:
    """Return the variance of the acceleration error by a jitter [samples] of given parameters, shape (N, n)."""
    if not jitter.any():
        return np.zeros_like(window.force)
    variance: Floats = (jitter * parameters[GAIN]) ** 2 * jitter_force(window.force, parameters[DELAY])
    return variance


def predicted(window: Window, parameters: Floats, gains: Gains, jitter: Floats, *, derivatives: bool = True) -> Floats:
    """Return whitened errors of the prediction of a window, and their derivatives, shape (N, 1 + P, n)."""
    force = spread_force(window.force, jitter)
    return predict(window.position, force, gains, parameters, derivatives=derivatives)


def _solution(position: Floats, force: Floats, gains: Gains, parameters: Floats) -> Solution:
    """Return the normal equations at given parameters."""
    P, n = parameters.shape
    product = np.empty((n, 1 + P, 1 + P))
    columns = predict(position, force, gains, parameters)
    for i in range(1 + P):
        for j in range(i + 1):
            product[:, i, j] = product[:, j, i] = over_rows("kn,kn->n", columns[:, i], columns[:, j])
    return Solution(
        parameters=parameters.copy(),
        normal=product[:, 1:, 1:],
        right=product[:, 1:, 0],
        cost=product[:, 0, 0],
        log_variance=gains.log_variance,
        information=gains.information,
        converged=np.zeros(n, dtype=np.bool_),
    )


def _solve(normal: Floats, right: Floats, factor: Floats | float) -> Floats:
    """Solve the normal equations of each trial, scaled to a unit diagonal, with a damping factor, shape (n, P)."""
    size = np.sqrt(np.einsum("npp->np", normal))
    size = np.where(size > 0, size, 1.0)
    scaled = normal / (size[:, :, None] * size[:, None, :])
    ridge = np.broadcast_to(factor, len(right)) + RIDGE
    scaled = scaled + ridge[:, None, None] * np.eye(normal.shape[1])
    solved: Floats = np.linalg.solve(scaled, (right / size)[:, :, None])[:, :, 0] / size
    return solved


def inverse(normal: Floats) -> Floats:
    """Return the inverse of each normal matrix, infinite variances where a parameter has no influence, (n, P, P)."""
    variances = np.einsum("npp->np", normal)
    size = np.sqrt(np.where(variances > 0, variances, 1.0))
    outer = size[:, :, None] * size[:, None, :]
    with np.errstate(over="ignore"):
        result: Floats = np.linalg.inv(normal / outer + RIDGE * np.eye(normal.shape[1])) / outer
    flat = variances <= 0
    result[flat[:, :, None] & np.eye(normal.shape[1], dtype=np.bool_)] = np.inf
    return result


def limited(parameters: Floats, step: Floats, smallest_delay: Floats) -> Floats:
    """Take a step, shortened so that delay and gain stay within the reach of the linear model."""
    gain_room = 0.7 * parameters[GAIN] / np.maximum(np.abs(step[GAIN]), 1e-300)
    delay_room = LARGEST_DELAY_STEP / np.maximum(np.abs(step[DELAY]), 1e-300)
    after: Floats = parameters + step * np.minimum(1.0, np.minimum(gain_room, delay_room))
    after[DELAY] = np.maximum(after[DELAY], smallest_delay)
    after[DAMPING] = np.clip(after[DAMPING], SMALLEST_DAMPING, LARGEST_RATE)
    return after
