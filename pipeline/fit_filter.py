"""Prediction of each reading from the command and the readings before it, with derivatives, for all trials at once.

The sensor adds an error to each reading. A command that arrives early or late adds a force error over the
sample in which it was expected, whose effect on the motion stays: residuals of an open-loop model are then
correlated. A Kalman filter corrects the model's state by each reading as far as such errors allow; what it
fails to predict is white, and its least squares is the maximum-likelihood estimate. Without jitter its gains
are 0, and it is the open-loop model.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.batch import Booleans, Floats, Integers
from pipeline.fit_motion import Order, Step, arrived, step_changes, step_of

GAIN, START, DELAY, DAMPING, STIFFNESS = range(5)
"""Rows of the parameter array: 1/m (1/b for the first order), x_0, delay, delta, gamma, all normalised."""

SMALLEST_SHARE = 0.3
"""Share of commands that are in time below which a jitter is spread over more samples, so that none is negative."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """Errors of the prediction and its derivatives, divided by the standard deviation of the error.

    Parameters
    ----------
    columns : float64, shape (N, 1 + P, n)
        Error, then the derivative of the predicted reading by each parameter; 0 in rows without a reading.
    log_variance : float64, shape (n,)
        Sum of the logarithms of the expected variances.
    information : float64, shape (n,)
        Number of independent readings: a run of equal readings counts once.
    """

    columns: Floats
    log_variance: Floats
    information: Floats


@dataclass(frozen=True, eq=False)
class Gains:
    """What the filter takes over from each reading, shape (N, n).

    Parameters
    ----------
    to_position, to_velocity : float64 or None
        Share of the error of a prediction by which the state is corrected; None where all are 0.
    spread : float64
        Expected variance of the error; infinite where there is no reading.
    """

    to_position: Floats | None
    to_velocity: Floats | None
    spread: Floats

    def select(self, which: Booleans | Integers) -> Gains:
        """Return the trials picked by a mask or by indices."""
        if self.to_position is None or self.to_velocity is None:
            return Gains(None, None, self.spread[:, which])
        return Gains(self.to_position[:, which], self.to_velocity[:, which], self.spread[:, which])


def jitter_force(force: Floats, delay: Floats) -> Floats:
    """Return the variance of the force error per row for a jitter of one sample, shape (N, n) [force^2].

    A command that arrives early or late by eps samples leaves an impulse of its change times eps, around the
    row where it was expected: half before and half behind, by the share of [d - 1, d + 1] in each row.
    """
    whole = np.floor(delay).astype(np.int64)
    part = delay - whole
    now = arrived(np.diff(force, axis=0, prepend=0.0) ** 2, whole)
    early, late = np.zeros_like(now), np.zeros_like(now)
    early[:-1], late[1:] = now[1:], now[:-1]
    variance: Floats = 0.5 * ((1 - part) * early + now + part * late)
    return variance


def spread_force(force: Floats, jitter: Floats) -> Floats:
    """Return the mean force of a command whose delay jitters, shape (N, n): the command, blurred by the jitter.

    A jitter of s samples blurs by the variance s^2: shares of s^2/2 come one sample early and late. From the jitter
    on where less than `SMALLEST_SHARE` would be in time, the shares come w samples early and late instead.
    """
    blurred = force
    reach = np.ceil(jitter / np.sqrt(1 - SMALLEST_SHARE)).astype(np.int64)
    for w in np.unique(reach[reach > 0]):
        share = np.where(reach == w, 0.5 * (jitter / w) ** 2, 0.0)
        early, late = force.copy(), np.zeros_like(force)
        early[:-w], late[w:] = force[w:], force[:-w]
        blurred = blurred + share * (early - 2 * force + late)
    return blurred


def predict(
    position: Floats,
    force: Floats,
    weighed: Floats,
    run: Floats,
    gains: Gains,
    parameters: Floats,
    *,
    order: Order = "second",
    derivatives: bool = True,
) -> Prediction:
    """Return the errors of the one-step prediction, whitened, and their derivatives.

    Parameters
    ----------
    position, force : float64, shape (N, n)
        Readings and commands, finite everywhere, time along the first axis.
    weighed : float64, shape (N, n)
        Variance of each reading times the length of its run; infinite where there is no reading.
    run : float64, shape (N, n)
        Length of the run of equal readings that each reading belongs to.
    gains : Gains
        Of the filter for the same readings.
    parameters : float64, shape (P, n)
    order : {"second", "first"}
    derivatives : bool
        Without, ``columns`` holds the errors only.
    """
    P, n = parameters.shape if derivatives else (0, parameters.shape[1])
    inside = np.isfinite(weighed)
    whole = np.floor(parameters[DELAY]).astype(np.int64)
    part = parameters[DELAY] - whole
    new = arrived(force, whole)
    old = arrived(force, whole + 1)
    gamma = parameters[STIFFNESS] if len(parameters) > STIFFNESS else np.zeros(n)
    step = step_of(parameters[DAMPING], gamma, part, order)
    by_old, by_new, changes = _drives(step, parameters, gamma, part, order, P)
    to_x, to_v = gains.to_position, gains.to_velocity
    columns = np.empty((len(position), 1 + P, n))
    x, v = np.zeros((1 + P, n)), np.zeros((1 + P, n))
    drive, work = np.empty((2, 1 + P, n)), np.empty((2, 1 + P, n))
    error = position - parameters[START]
    for k in range(len(position)):
        now = columns[k]
        np.copyto(now, x)
        np.subtract(error[k], x[0], out=now[0])
        if P:
            now[1 + START] += 1.0
        if to_x is not None and to_v is not None:
            _correct(x, v, now, to_x[k], to_v[k])
        np.multiply(by_old, old[k], out=drive)
        np.multiply(by_new, new[k], out=work)
        drive += work
        for column, change in changes:
            drive[0, column] += change.xx * x[0] + change.xv * v[0]
            drive[1, column] += change.vx * x[0] + change.vv * v[0]
        np.multiply(step.xv, v, out=work[0])
        np.multiply(step.vx, x, out=work[1])
        x *= step.xx
        v *= step.vv
        x += work[0]
        v += work[1]
        x += drive[0]
        v += drive[1]
    spread = np.where(inside, gains.spread, 1.0)
    columns *= np.where(inside, 1 / np.sqrt(spread), 0.0)[:, None, :]
    logarithm = np.log(spread).sum(axis=0)
    # of the variance of an error, the reading's part counts once a run
    reading = np.where(inside, weighed, 0.0) / spread
    information = np.where(inside, 1 - reading * (1 - 1 / run), 0.0).sum(axis=0)
    return Prediction(columns, logarithm, information)


def _correct(x: Floats, v: Floats, now: Floats, to_x: Floats, to_v: Floats) -> None:
    """Correct the state by an error, and its derivatives by those of the error, which have the other sign."""
    x[0] += to_x * now[0]
    v[0] += to_v * now[0]
    x[1:] -= to_x * now[1:]
    v[1:] -= to_v * now[1:]


def _drives(
    step: Step, parameters: Floats, gamma: Floats, part: Floats, order: Order, count: int
) -> tuple[Floats, Floats, list[tuple[int, Step]]]:
    """Return what old and new command add to position and velocity of each column, shape (2, 1 + P, n)."""
    n = parameters.shape[1]
    by_old, by_new = np.zeros((2, 1 + count, n)), np.zeros((2, 1 + count, n))
    gain = parameters[GAIN]
    by_old[:, 0], by_new[:, 0] = gain * np.stack([step.old_x, step.old_v]), gain * np.stack([step.new_x, step.new_v])
    changes: list[tuple[int, Step]] = []
    if count:
        by_old[:, 1 + GAIN], by_new[:, 1 + GAIN] = (step.old_x, step.old_v), (step.new_x, step.new_v)
        jump = gain * np.stack([step.jump_x, step.jump_v])
        by_old[:, 1 + DELAY], by_new[:, 1 + DELAY] = jump, -jump
        both = step_changes(parameters[DAMPING], gamma, part, order)
        for column, change in zip(range(1 + DAMPING, 1 + count), both, strict=False):
            by_old[:, column] = gain * np.stack([change.old_x, change.old_v])
            by_new[:, column] = gain * np.stack([change.new_x, change.new_v])
            changes.append((column, change))
    return by_old, by_new, changes


def filter_gains(weighed: Floats, shock: Floats, parameters: Floats, order: Order) -> Gains:
    """Return the gains of the Kalman filter for a model.

    Parameters
    ----------
    weighed : float64, shape (N, n)
        As for `predict`.
    shock : float64, shape (N, n)
        Variance of the acceleration error (of the rate for the first order) over the sample from each row; all 0
        for an open-loop model.
    parameters : float64, shape (P, n)
        Damping and stiffness below 0 count as 0, since a gain for an unstable device would explain any motion as
        a small error that grew.
    order : {"second", "first"}
    """
    if not shock.any():
        return Gains(None, None, weighed)
    n = weighed.shape[1]
    zero = np.zeros(n)
    gamma = np.maximum(parameters[STIFFNESS], 0.0) if len(parameters) > STIFFNESS else zero
    s = step_of(np.maximum(parameters[DAMPING], 0.0), gamma, zero, order)
    share_xx, share_xv, share_vv = s.hold_x**2, s.hold_x * s.hold_v, s.hold_v**2
    xx, xv, vv = zero, zero, zero
    spread, to_x, to_v = (np.empty(weighed.shape) for _ in range(3))
    for k in range(len(weighed)):
        np.add(xx, weighed[k], out=spread[k])
        np.divide(xx, spread[k], out=to_x[k])
        np.divide(xv, spread[k], out=to_v[k])
        vv = vv - to_v[k] * xv
        left = 1 - to_x[k]
        xv, xx = left * xv, left * xx
        a, b = s.xx * xx + s.xv * xv, s.xx * xv + s.xv * vv
        c, d = s.vx * xx + s.vv * xv, s.vx * xv + s.vv * vv
        xx = s.xx * a + s.xv * b + share_xx * shock[k]
        xv = s.vx * a + s.vv * b + share_xv * shock[k]
        vv = s.vx * c + s.vv * d + share_vv * shock[k]
    return Gains(to_x, to_v, spread)
