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

from pipeline.measured.fit.fit_motion import Step, acting, step_change, step_of
from pipeline.measured.fit.fit_noise import over_rows
from pipeline.records.batch import Booleans, Floats, Integers

START, GAIN, DELAY, DAMPING = range(4)
"""Rows of the parameter array: x_0, 1/m, delay, delta, all normalised."""

SMALLEST_SHARE = 0.3
"""Share of commands that are in time below which a jitter is spread over more samples, so that none is negative."""


@dataclass(frozen=True, eq=False)
class Gains:
    """What the filter takes over from each reading, and how it weighs the errors of its predictions.

    Parameters
    ----------
    correction : float64, shape (N, 2, n), or None
        Share of the error of a prediction by which position and velocity are corrected; None where all are 0.
    weight : float64, shape (N, n)
        One over the standard deviation of the error; 0 where there is no reading.
    log_variance : float64, shape (n,)
        Sum of the logarithms of the errors' expected variances.
    information : float64, shape (n,)
        Number of independent readings: a run of equal readings counts once.
    """

    correction: Floats | None
    weight: Floats
    log_variance: Floats
    information: Floats

    def select(self, which: Booleans | Integers) -> Gains:
        """Return the trials picked by a mask or by indices."""
        correction = None if self.correction is None else self.correction[:, :, which]
        return Gains(correction, self.weight[:, which], self.log_variance[which], self.information[which])


def jitter_force(force: Floats, delay: Floats) -> Floats:
    """Return the variance of the force error per row for a jitter of one sample, shape (N, n) [force^2].

    A command that arrives early or late by eps samples leaves an impulse of its change times eps, around the
    row where it was expected: half before and half behind, by the share of [d - 1, d + 1] in each row.
    """
    whole = np.floor(delay).astype(np.int64)
    part = delay - whole
    now = acting(np.diff(force, axis=0, prepend=0.0) ** 2, whole)[1:]
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
    gains: Gains,
    parameters: Floats,
    *,
    derivatives: bool = True,
) -> Floats:
    """Return the errors of the one-step prediction, whitened, and their derivatives, shape (N, 1 + P, n).

    First the error, then the derivative of the predicted reading by each parameter, all divided by the standard
    deviation of the error; 0 in rows without a reading.

    Parameters
    ----------
    position, force : float64, shape (N, n)
        Readings and commands, finite everywhere, time along the first axis.
    gains : Gains
        Of the filter for the same readings.
    parameters : float64, shape (P, n)
    derivatives : bool
        Without, there is the column of errors only.

    Notes
    -----
    Errors and readings differ by what does not depend on the gain: the first column is that of the readings alone,
    from which the answer to the command, the derivative by the gain, times the gain is taken off in the end.
    """
    C, n = 1 + (len(parameters) if derivatives else 0), parameters.shape[1]
    gain, delay = parameters[GAIN], parameters[DELAY]
    whole = np.floor(delay).astype(np.int64)
    commands = acting(force, whole)
    step = step_of(parameters[DAMPING], delay - whole)
    change = step_change(parameters[DAMPING], delay - whole) if derivatives else step
    driven_from = 1 + GAIN if C > 1 else 0
    # without corrections the columns that no command drives have no state
    state_from = driven_from if gains.correction is None else 0
    drive = _drive(step, change, gain) if C > 1 else -gain * _effect(step)[:, :, None]
    columns = np.empty((len(position), C, n))
    x, v = state = np.zeros((2, C - state_from, n))
    driven, coupled = state[:, driven_from - state_from :], state[:, 1 + DAMPING - state_from :]
    work, pushed = np.empty_like(state), np.empty((2, *driven.shape))
    # what the velocity adds to the derivatives by damping; the position by itself changes nothing
    coupling, motion = np.array([[change.xv], [change.vv]]), np.empty((2, n))
    answer = np.empty_like(coupling)
    readings = position - parameters[START]
    for k in range(len(position)):
        now = columns[k]
        if state_from:
            now[0], now[1 + START] = readings[k], 1.0
            now[driven_from:] = x
        else:
            np.copyto(now, x)
            now[0] += readings[k]
            if C > 1:
                now[1 + START] += 1.0
        if gains.correction is not None:
            np.multiply(gains.correction[k][:, None, :], now, out=work)
            state -= work
        if C > 1:
            np.multiply(gain, state[:, 1 + GAIN - state_from], out=motion)
            if not state_from:
                motion -= state[:, 0]
            now[0] -= gain * now[1 + GAIN]
        now *= gains.weight[k]
        np.multiply(step.xv, v, out=work[0])
        v *= step.vv
        x += work[0]
        np.multiply(drive, commands[k : k + 2, None, None, :], out=pushed)
        driven += pushed[0]
        driven += pushed[1]
        if C > 1:
            np.multiply(coupling, motion[1], out=answer)
            coupled += answer
    return columns


def _effect(step: Step) -> Floats:
    """Return what the old and the new command add to position and velocity, shape (2, 2, n)."""
    return np.array([[step.old_x, step.old_v], [step.new_x, step.new_v]])


def _drive(step: Step, change: Step, gain: Floats) -> Floats:
    """Return what old and new command add to position and velocity of the driven columns, shape (2, 2, D, n)."""
    jump = gain * np.array([step.jump_x, step.jump_v])
    return np.stack([_effect(step), np.array([jump, -jump]), gain * _effect(change)], axis=2)


def open_loop(weight: Floats) -> Gains:
    """Return the gains of a model that no reading corrects, for given weights of its errors, shape (N, n)."""
    return Gains(None, weight, np.zeros(weight.shape[1]), np.count_nonzero(weight, axis=0).astype(np.float64))


def filter_gains(weighed: Floats, run: Floats, shock: Floats, parameters: Floats) -> Gains:
    """Return the gains of the Kalman filter for a model.

    Parameters
    ----------
    weighed : float64, shape (N, n)
        Variance of each reading times the length of its run; infinite where there is no reading.
    run : float64, shape (N, n)
        Length of the run of equal readings that each reading belongs to.
    shock : float64, shape (N, n)
        Variance of the acceleration error over the sample from each row; all 0 for an open-loop model.
    parameters : float64, shape (P, n)
        Damping below 0 counts as 0, since a gain for an unstable device would explain any motion as
        a small error that grew.
    """
    inside = np.isfinite(weighed)
    if not shock.any():
        spread = np.where(inside, weighed, 1.0)
        correction = None
        information = over_rows("kn->n", np.where(inside, 1 / run, 0.0))
    else:
        correction, spread = _kalman(weighed, shock, parameters)
        spread = np.where(inside, spread, 1.0)
        # of the variance of an error, the reading's part counts once a run
        reading = np.where(inside, weighed, 0.0) / spread
        information = over_rows("kn->n", np.where(inside, 1 - reading * (1 - 1 / run), 0.0))
    weight = np.where(inside, 1 / np.sqrt(spread), 0.0)
    return Gains(correction, weight, over_rows("kn->n", np.log(spread)), information)


def _kalman(weighed: Floats, shock: Floats, parameters: Floats) -> tuple[Floats, Floats]:
    """Return the corrections, shape (N, 2, n), and the variance of each prediction's error, shape (N, n)."""
    N, n = weighed.shape
    s, one, none = step_of(np.maximum(parameters[DAMPING], 0.0), np.zeros(n)), np.ones(n), np.zeros(n)
    share = np.array([s.hold_x**2, s.hold_x * s.hold_v, s.hold_v**2])
    # of the covariance xx, xv, vv from one row to the next
    transition = np.array([[one, 2 * s.xv, s.xv * s.xv], [none, s.vv, s.xv * s.vv], [none, none, s.vv * s.vv]])
    correction, spread = np.empty((N, 2, n)), np.empty((N, n))
    covariance, work, moved = np.zeros((3, n)), np.empty((3, n)), np.empty((3, 3, n))
    for k in range(N):
        np.add(covariance[0], weighed[k], out=spread[k])
        np.divide(covariance[:2], spread[k], out=correction[k])
        np.multiply(correction[k], covariance[1], out=work[1:])
        covariance[1:] -= work[1:]
        np.multiply(correction[k, 0], covariance[0], out=work[0])
        covariance[0] -= work[0]
        np.multiply(transition, covariance, out=moved)
        np.add.reduce(moved, axis=1, out=covariance)
        np.multiply(share, shock[k], out=work)
        covariance += work
    return correction, spread
