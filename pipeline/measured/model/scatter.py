"""The likelihood of all trials together: common numbers, their scatter from trial to trial, and trials that lie apart.

Each trial is a linear regression known by its moments: whitened errors e_i = X_i (theta + b_i) + noise, with b_i of
unknown variances. Restricted maximum likelihood estimates these; a noisier trial weighs less.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pipeline.records.batch import Floats, Integers

FEWEST = 8
"""Trials from which on a scatter between them is estimated: fewer tell a variance to a factor of three at best."""

OWN_ROWS = 20.0
"""Degrees of freedom of the noise of single trials: one that was bumped is noisier than the others, and weighs less."""

ROUNDS = 4
"""Rounds of weights and variances between trials, of which each rests on the other."""

ROUNDED = 1e-16
"""Share of the motion below which what is left of it is rounding."""

LEAST_NOISE = 1e-100
"""Noise of logs without any motion, by which everything is identified."""

RIDGE = 1e-12
"""Share of a number's own information below which a direction has none, but rounding: it gets a step of 0."""


@dataclass(frozen=True, eq=False)
class Moments:
    """Sums of products of each trial's whitened columns and errors (T, p + 1, p + 1); its free rows (T,).

    ``least`` is the variance of an error that rounding of the readings alone leaves, ``log_spread`` the sum of the
    logarithms of the filter's spreads over all rows, and of what the readings tell of the unknown starts.
    ``before`` (2, p) is what is known of each number without logs: information, and the slope of its likelihood.
    """

    products: Floats
    rows: Floats
    least: float = 0.0
    log_spread: float = 0.0
    before: Floats = field(default_factory=lambda: np.zeros((2, 1)))


@dataclass(frozen=True, eq=False)
class Solved:
    """Estimate of the common numbers as a step from where the columns were taken.

    ``step`` (p,); ``information`` (T, p, p) and ``score`` (T, p) of each trial at the solution; ``scatter`` (p,) the
    variances between trials; ``effects`` (T, p) each trial's deviations; ``noise`` the variance of a whitened error,
    ``weight`` (T,) of each trial; ``likelihood`` its restricted logarithm, without constants, as the columns foretell
    it behind the step, and ``here`` before it, for the likeliest starts; ``total`` (p, p) is the information of all
    trials and of what is known without them.
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


def inverse(information: Floats) -> Floats:
    """Return the inverse of an information matrix, 0 along directions of which it tells nothing."""
    scale, values, vectors = _scaled(information)
    known = np.where(values > RIDGE, 1 / np.maximum(values, RIDGE), 0.0)
    return np.asarray((vectors * known) @ vectors.T * scale[:, None] * scale[None, :])


def unidentified(information: Floats) -> Floats:
    """Return the directions of which an information matrix tells nothing, shape (k, p)."""
    scale, values, vectors = _scaled(information)
    return np.asarray(vectors[:, values <= RIDGE].T * scale)


def _scaled(information: Floats) -> tuple[Floats, Floats, Floats]:
    """Return what scales an information matrix to a unit diagonal, and eigenvalues and vectors of that."""
    known = np.diagonal(information)
    scale = 1 / np.sqrt(np.where(known > 0, known, 1.0))
    return scale, *np.linalg.eigh(information * scale[:, None] * scale[None, :])


def solve(moments: Moments, random: Integers) -> Solved:
    """Return the estimate, with scatter of the numbers at some places."""
    from scipy.special import gammaln

    p = moments.products.shape[1] - 1
    size = np.einsum("tpp->p", moments.products[:, :p, :p])
    scale = 1 / np.sqrt(np.where(size > 0, size, 1.0))
    factors = np.append(scale, 1.0)
    products = moments.products * factors[:, None] * factors[None, :]
    rows = np.maximum(moments.rows, 1.0)
    prior, slope = moments.before * np.stack([scale**2, scale])
    # at first by what each unit leaves at its own best numbers
    rest = _Mixed(products).rest
    # numbers are rounded by as much, and of readings that never change nothing is left
    least = max(float(products[:, p, p].sum()) * ROUNDED**2 / float(rows.sum()), LEAST_NOISE, moments.least)
    noise = max(float(np.median(rest / rows)), least)
    weight, variances = (rows + OWN_ROWS) / (OWN_ROWS + rest / noise), np.zeros(p)
    for count in range(ROUNDS):
        mixed = _Mixed(products * (weight / noise)[:, None, None])
        if len(random):
            variances = _variances(mixed, random, variances if count else None)
        found = mixed.solution(variances, prior, slope)
        before = found.before * noise / weight
        squares = found.squares * noise / weight
        noise, weight = _weighed(squares, rows, noise, least)

    def likelihood(squares: Floats, noise: float, slope: Floats) -> float:
        free, spread = rows + OWN_ROWS, np.log1p(squares / (OWN_ROWS * noise))
        of_rows = gammaln(0.5 * free) - 0.5 * (rows * np.log(0.5 * OWN_ROWS * noise) + free * spread)
        apart = 0.5 * float((slope**2 / np.maximum(prior, 1e-300)).sum())
        return float(found.determinants.sum() + of_rows.sum()) - moments.log_spread - apart

    information = found.information / (scale[:, None] * scale[None, :])
    return Solved(
        found.step * scale,
        information,
        found.score / scale,
        variances * scale**2,
        found.effects * scale,
        noise,
        weight,
        likelihood(squares, noise, slope - prior * found.step),
        likelihood(before, _weighed(before, rows, noise, least)[0], slope),
        information.sum(axis=0) + moments.before[0] * np.eye(p),
    )


def _weighed(squares: Floats, rows: Floats, noise: float, least: float) -> tuple[float, Floats]:
    """Return the likeliest variance of errors, from one near it on, and the weights of units with some squares."""
    for _ in range(20):
        weight = (rows + OWN_ROWS) / (OWN_ROWS + squares / noise)
        noise = max(float((weight * squares).sum() / rows.sum()), least)
    return noise, weight


@dataclass(frozen=True, eq=False)
class _Solution:
    """Step, information and score of units, their effects, half determinants, weighted squares behind and before it."""

    step: Floats
    information: Floats
    score: Floats
    effects: Floats
    determinants: Floats
    squares: Floats
    before: Floats

    @property
    def likelihood(self) -> float:
        """Restricted logarithm of the likelihood for given noise, without constants."""
        values = np.linalg.eigvalsh(self.information.sum(axis=0))
        freed = 0.5 * float(np.log(np.maximum(values, RIDGE)).sum())
        return float((self.determinants - 0.5 * self.squares).sum()) - freed


SEEN = 1e-11
"""Share of a unit's largest information below which a direction is rounding: products have 1e-16 of their size."""


class _Mixed:
    """Units with columns of unit size, over their noise: as the fewest rows that have the same moments."""

    def __init__(self, products: Floats) -> None:
        p = products.shape[1] - 1
        values, vectors = np.linalg.eigh(products[:, :p, :p])
        size = np.sqrt(np.where(values > SEEN * values[:, -1:], values, 0.0))
        self.columns = size[:, :, None] * vectors.transpose(0, 2, 1)
        turned = np.einsum("tij,ti->tj", vectors, products[:, :p, p])
        self.errors = np.where(size > 0, turned / np.where(size > 0, size, 1.0), 0.0)
        self.rest = np.maximum(products[:, p, p] - (self.errors**2).sum(axis=1), 1e-300)

    def solution(self, variances: Floats, prior: Floats | float = 0.0, slope: Floats | float = 0.0) -> _Solution:
        p = len(variances)
        covariance = np.eye(p) + (self.columns * variances) @ self.columns.transpose(0, 2, 1)
        known = np.linalg.inv(covariance)
        weighted = known @ self.columns
        information = self.columns.transpose(0, 2, 1) @ weighted
        information = (information + information.transpose(0, 2, 1)) / 2
        total = np.einsum("tij,ti->j", weighted, self.errors) + slope
        step = inverse(information.sum(axis=0) + prior * np.eye(p)) @ total
        left = self.errors - self.columns @ step
        score = np.einsum("tij,ti->tj", weighted, left)
        squares, before = (self.rest + np.einsum("ti,tij,tj->t", each, known, each) for each in (left, self.errors))
        determinants = -0.5 * np.linalg.slogdet(covariance)[1]
        return _Solution(step, information, score, variances * score, determinants, squares, before)

    def slopes(self, found: _Solution) -> Floats:
        """Return the slope of the likelihood along each variance, (p,)."""
        information = found.information
        known = inverse(information.sum(axis=0))
        own = np.einsum("tii->ti", information) - np.einsum("tij,jk,tki->ti", information, known, information)
        return np.asarray(0.5 * (found.score**2 - own).sum(axis=0))


def _variances(work: _Mixed, random: Integers, start: Floats | None = None) -> Floats:
    """Return the variances between trials of some numbers, 0 of the others."""
    from scipy.optimize import minimize

    p = work.columns.shape[2]
    unit = 1 / np.maximum((work.columns**2).sum(axis=1).mean(axis=0)[random], 1e-300)

    def variances(logs: Floats) -> Floats:
        result = np.zeros(p)
        result[random] = unit * np.exp(logs)
        return result

    def cost(logs: Floats) -> tuple[float, Floats]:
        at = variances(logs)
        found = work.solution(at)
        return -found.likelihood, -work.slopes(found)[random] * at[random]

    least, most = -9.0, 25.0
    begin = np.full(len(random), 1.0)
    if start is not None:
        begin = np.clip(np.log(np.maximum(start[random] / unit, 1e-12)), least, most)
    found = minimize(cost, begin, jac=True, method="L-BFGS-B", bounds=[(least, most)] * len(random))
    return variances(np.where(found.x <= least + 1e-6, -60.0, found.x))
