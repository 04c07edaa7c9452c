"""Joint likelihood of all trials, with common numbers, their scatter from trial to trial, and outliers among trials.

Each trial is a linear regression with whitened errors e_i = X_i (theta + b_i) + noise, represented by its moments. The
unknown variances of b_i are estimated by restricted maximum likelihood. A noisier trial has less weight.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from math import lgamma, log

import numpy as np

from pipeline.measured.identification.mixed_loops import OWN_ROWS, RIDGE, SPACE, mixed_effects
from pipeline.measured.identification.recordings import median
from pipeline.records.trials import Floats, Integers

FEWEST = 8
"""Smallest number of trials for which the scatter between them is estimated. A variance from fewer trials is uncertain
by more than a factor of three."""

FOLDS = 5
"""Number of folds of units. Each fold is left out once."""

ROUNDED = 1e-16
"""Threshold for the residual, relative to the motion. Below it, the residual is a rounding error."""

LEAST_NOISE = 1e-100
"""Noise that is assumed for logs without any motion or residual."""


@dataclass(frozen=True, eq=False)
class Moments:
    """Triangular factors R of each trial's whitened columns and errors (T, p + 1, p + 1), and degrees of freedom (T,).

    R'R contains the sums of products. R avoids the loss of digits by squaring. ``least`` is the variance of an error
    due to rounding of the readings only. ``log_spread`` is the sum of the logarithms of the filter's standard
    deviations and of the information on the unknown initial states. ``before`` (2, p) is the prior of each number, as
    information and slope of its likelihood. ``of_phases`` (T, 8, p, p + 1) contains the sums of products of the columns
    with all columns and the errors in each phase of the motion, if requested.
    """

    factors: Floats
    rows: Floats
    least: float = 0.0
    log_spread: float = 0.0
    before: Floats = field(default_factory=lambda: np.zeros((2, 1)))
    of_phases: Floats = field(default_factory=lambda: np.zeros((0, 0, 0, 1)), repr=False)

    @property
    def products(self) -> Floats:
        """Sums of products of the columns of each trial, (T, p + 1, p + 1)."""
        return np.asarray(self.factors.transpose(0, 2, 1) @ self.factors)


@dataclass(frozen=True, eq=False)
class Solved:
    """Estimate of the common numbers as a step from the point of linearisation.

    Parameters
    ----------
    step : float64, shape (p,)
    information : float64, shape (T, p, p)
        Information of each trial at the solution.
    score : float64, shape (T, p)
        Score of each trial at the solution.
    scatter : float64, shape (p,)
        Variances between trials.
    effects : float64, shape (T, p)
        Deviations of each trial.
    noise : float
        Variance of a whitened error.
    weight : float64, shape (T,)
        Weight of each trial.
    likelihood : float
        Restricted log-likelihood without constants after the step, as predicted by the columns.
    here : float
        Restricted log-likelihood before the step, for the maximum-likelihood initial states.
    total : float64, shape (p, p)
        Information of all trials and of the prior.
    """

    step: Floats
    information: Floats
    score: Floats
    scatter: Floats
    effects: Floats
    noise: float
    weight: Floats
    likelihood: float
    here: float
    total: Floats

    def folds(self, trials: Integers | None = None) -> Iterator[tuple[Floats, Floats, Floats]]:
        """Yield information and score of each fold of units, and the Newton step to the fit of the other folds.

        ``trials`` contains the trial of each unit, if units are not trials.
        """
        trials = np.arange(len(self.score)) if trials is None else trials
        for fold in range(FOLDS):
            inside = trials % FOLDS == fold
            information, score = self.information[inside].sum(axis=0), self.score[inside].sum(axis=0)
            yield information, score, -inverse(self.total - information) @ score


def inverse(information: Floats) -> Floats:
    """Return the inverse of information matrices (..., p, p). It is 0 along directions without information."""
    scale, values, vectors = _scaled(information)
    known = np.where(values > RIDGE, 1 / np.maximum(values, RIDGE), 0.0)
    whole = (vectors * known[..., None, :]) @ vectors.swapaxes(-1, -2)
    return np.asarray(whole * scale[..., :, None] * scale[..., None, :])


def unidentified(information: Floats) -> Floats:
    """Return the directions along which an information matrix is zero, shape (k, p)."""
    scale, values, vectors = _scaled(information)
    return np.asarray(vectors[:, values <= RIDGE].T * scale)


def _scaled(information: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the scaling of information matrices to a unit diagonal, and their eigenvalues and eigenvectors."""
    known = np.diagonal(information, axis1=-2, axis2=-1)
    scale = 1 / np.sqrt(np.where(known > 0, known, 1.0))
    return scale, *np.linalg.eigh(information * scale[..., :, None] * scale[..., None, :])


def solve(moments: Moments, random: Integers) -> Solved:
    """Return the estimate of the numbers. The numbers at the places ``random`` vary between trials.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the estimate cannot be computed in double precision.
    """
    T, p = len(moments.factors), moments.factors.shape[1] - 1
    size = np.einsum("tij,tij->j", moments.factors, moments.factors)[:p]
    scale = 1 / np.sqrt(np.where(size > 0, size, 1.0))
    factors, rows = moments.factors * np.append(scale, 1.0), np.maximum(moments.rows, 1.0)
    known = moments.before * np.stack([scale**2, scale])
    # smallest residual: rounding errors of the numbers, since readings that never change have no residual
    least = max(float((factors[:, :, p] ** 2).sum()) * ROUNDED**2 / float(rows.sum()), LEAST_NOISE, moments.least)
    # initial noise: the residual of each unit with its separate optimum
    noise = max(median(np.maximum(factors[:, p, p] ** 2, 1e-300) / rows), least)
    space = np.empty((T, p, p + 1)), np.empty((T, p, p + 1)), np.empty(T), np.empty((SPACE, p + 1, p + 1))
    vectors = np.empty(p), np.empty(p), *np.empty((3, T)), np.empty((p, p)), np.empty(3)
    mixed_effects((factors, rows, random, known, noise, least), space, vectors)
    step, variances, weight, before, behind, _, (noise, noise_before, determinants) = vectors
    if not np.isfinite(step).all():
        raise np.linalg.LinAlgError("the normal equations have no solution")
    columns, errors = space[1][:, :, :p], space[1][:, :, p]
    information = columns.transpose(0, 2, 1) @ columns / (scale[:, None] * scale[None, :])
    score = ((errors - columns @ step)[:, None, :] @ columns)[:, 0]

    free, of_rows = rows + OWN_ROWS, float(rows.sum())
    without_noise = float(determinants + sum(map(lgamma, (0.5 * free).tolist()))) - moments.log_spread

    def likelihood(squares: Floats, noise: float, slope: Floats) -> float:
        spread = float(free @ np.log1p(squares / (OWN_ROWS * noise)))
        apart = float((slope**2 / np.maximum(known[0], 1e-300)).sum())
        return without_noise - 0.5 * (of_rows * log(0.5 * OWN_ROWS * noise) + spread + apart)

    return Solved(
        step * scale,
        information,
        score / scale,
        variances * scale**2,
        variances * score * scale,
        float(noise),
        weight,
        likelihood(behind, noise, known[1] - known[0] * step),
        likelihood(before, noise_before, known[1]),
        information.sum(axis=0) + moments.before[0] * np.eye(p),
    )
