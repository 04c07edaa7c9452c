"""The likelihood of all trials together: common numbers, their scatter from trial to trial, and trials that lie apart.

Each trial is a linear regression known by its moments: whitened errors e_i = X_i (theta + b_i) + noise, with b_i of
unknown variances. Restricted maximum likelihood estimates these; a noisier trial weighs less.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.records.trials import Floats, Integers

FEWEST = 8
"""Trials from which on a scatter between them is estimated: fewer give a variance to a factor of three at best."""

OWN_ROWS = 20.0
"""Degrees of freedom of the noise of single trials: one that was bumped is noisier than the others, and weighs less."""

ROUNDS = 4
"""Rounds of weights and variances between trials, each of which depends on the other."""

ROUNDED = 1e-16
"""Share of the motion below which what is left of it is rounding."""

LEAST_NOISE = 1e-100
"""Noise of logs without any motion, by which everything is identified."""

FLAT = 1e-8
"""Change of the noise, relative to it, at which its search ends."""

NEWTON = 40
"""Most steps of that search, each by a factor of e^2 at most."""

ENOUGH = 1e-6
"""Gain of log-likelihood that a step of the search for variances must promise."""

LEAST_SHARE = 1e-6
"""Share of the mean square from which on it is looked for: most units are as noisy as the others."""

RIDGE = 1e-12
"""Share of a number's own information below which a direction has none, but rounding: it gets a step of 0."""


@dataclass(frozen=True, eq=False)
class Moments:
    """Triangular factors R of each trial's whitened columns and errors (T, p + 1, p + 1); its free rows (T,).

    R'R are the sums of their products, without the digits that squares lose.

    ``least`` is the variance of an error that rounding of the readings alone leaves, ``log_spread`` the sum of the
    logarithms of the filter's spreads over all rows, and of what the readings determine of the unknown starts.
    ``before`` (2, p) is what is known of each number without logs: information, and the slope of its likelihood.
    """

    factors: Floats
    rows: Floats
    least: float = 0.0
    log_spread: float = 0.0
    before: Floats = field(default_factory=lambda: np.zeros((2, 1)))

    @property
    def products(self) -> Floats:
        """Sums of products of the columns of each trial, (T, p + 1, p + 1)."""
        return np.asarray(self.factors.transpose(0, 2, 1) @ self.factors)

    def some(self, places: Sequence[int]) -> Moments:
        """Return the moments of the numbers at some places alone."""
        factors: Floats = np.linalg.qr(self.factors[:, :, [*places, -1]]).R
        return replace(self, factors=factors, before=self.before[:, list(places)])


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
    """Return the inverse of an information matrix, 0 along directions without information."""
    scale, values, vectors = _scaled(information)
    known = np.where(values > RIDGE, 1 / np.maximum(values, RIDGE), 0.0)
    return np.asarray((vectors * known) @ vectors.T * scale[:, None] * scale[None, :])


def unidentified(information: Floats) -> Floats:
    """Return the directions in which an information matrix has no information, shape (k, p)."""
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

    p = moments.factors.shape[1] - 1
    size = (moments.factors[:, :, :p] ** 2).sum(axis=(0, 1))
    scale = 1 / np.sqrt(np.where(size > 0, size, 1.0))
    factors = moments.factors * np.append(scale, 1.0)
    rows = np.maximum(moments.rows, 1.0)
    prior, slope = moments.before * np.stack([scale**2, scale])
    # at first by what each unit leaves at its own best numbers
    rest = np.maximum(factors[:, p, p] ** 2, 1e-300)
    # numbers are rounded by as much, and of readings that never change nothing is left
    moved = float((factors[:, :, p] ** 2).sum())
    least = max(moved * ROUNDED**2 / float(rows.sum()), LEAST_NOISE, moments.least)
    noise = max(float(np.median(rest / rows)), least)
    weight, variances = (rows + OWN_ROWS) / (OWN_ROWS + rest / noise), np.zeros(p)
    for count in range(ROUNDS):
        mixed = _Mixed(factors * np.sqrt(weight / noise)[:, None, None])
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
        return found.determinants + float(of_rows.sum()) - moments.log_spread - apart

    information, score = found.information / (scale[:, None] * scale[None, :]), found.score
    return Solved(
        found.step * scale,
        information,
        score / scale,
        variances * scale**2,
        variances * score * scale,
        noise,
        weight,
        likelihood(squares, noise, slope - prior * found.step),
        likelihood(before, _weighed(before, rows, noise, least)[0], slope),
        information.sum(axis=0) + moments.before[0] * np.eye(p),
    )


def _weighed(squares: Floats, rows: Floats, noise: float, least: float) -> tuple[float, Floats]:
    """Return the likeliest variance of errors, from one near it on, and the weights of units with some squares.

    Of s_i = squares, n_i = rows and f = `OWN_ROWS`: sum (n_i + f) s_i/(f v + s_i) = sum n_i, by Newton's steps in ln v.
    """
    free, total = rows + OWN_ROWS, float(rows.sum())
    noise = max(noise, float(squares.sum()) * LEAST_SHARE / total, least)
    for _ in range(NEWTON):
        ratio = squares / (OWN_ROWS * noise + squares)
        off, slope = float(free @ ratio) - total, float(free @ (ratio * (1 - ratio)))
        step = min(max(off / max(slope, 1e-3 * total), -2.0), 2.0)
        former, noise = noise, max(noise * float(np.exp(step)), least)
        # the likelihood is flat along the noise: an error in it is squared
        if abs(noise - former) <= FLAT * noise:
            break
    return noise, free / (OWN_ROWS + squares / noise)


@dataclass(frozen=True, eq=False)
class _Solution:
    """The step of units whose columns (T, p, p) are whitened by the scatter between them, and what it leaves.

    ``left`` (T, p) are the errors behind the step; ``determinants`` the sum of minus half the logarithms of the
    units' covariances; ``squares`` and ``before`` (T,) the sums of squares behind and before the step; ``total`` (p, p)
    the information of all units.
    """

    step: Floats
    columns: Floats
    left: Floats
    determinants: float
    squares: Floats
    before: Floats
    total: Floats

    @property
    def information(self) -> Floats:
        """Information of each unit, (T, p, p)."""
        return np.asarray(self.columns.transpose(0, 2, 1) @ self.columns)

    @property
    def score(self) -> Floats:
        """Slope of the likelihood of each unit, (T, p)."""
        return np.asarray((self.left[:, None, :] @ self.columns)[:, 0])

    @property
    def likelihood(self) -> float:
        """Restricted logarithm of the likelihood for given noise, without constants."""
        freed = 0.5 * float(np.log(np.maximum(np.linalg.eigvalsh(self.total), RIDGE)).sum())
        return self.determinants - 0.5 * float(self.squares.sum()) - freed

    def slopes(self, random: Integers) -> tuple[Floats, Floats]:
        """Return slope (r,) and information (r, r) of the likelihood along the variances between units of numbers."""
        information = self.information
        own = information[:, random] @ (np.eye(len(self.total)) - inverse(self.total) @ information)
        own = own[:, :, random]
        slope = 0.5 * (self.score[:, random] ** 2 - np.einsum("tii->ti", own)).sum(axis=0)
        return np.asarray(slope), np.asarray(0.5 * (own**2).sum(axis=0))


class _Mixed:
    """Units with columns of unit size, over their noise, by their triangular factors."""

    def __init__(self, factors: Floats) -> None:
        p = factors.shape[1] - 1
        self.columns, self.errors = factors[:, :p, :p], factors[:, :p, p]
        self.rest = np.maximum(factors[:, p, p] ** 2, 1e-300)

    def solution(self, variances: Floats, prior: Floats | float = 0.0, slope: Floats | float = 0.0) -> _Solution:
        """Return the likeliest step for some variances between units, with what is known of it before."""
        p, columns, errors, determinants = len(variances), self.columns, self.errors, 0.0
        if variances.any():
            covariance = np.eye(p) + (columns * variances) @ columns.transpose(0, 2, 1)
            root = np.linalg.cholesky(covariance)
            columns, errors = np.linalg.solve(root, columns), np.linalg.solve(root, errors[..., None])[..., 0]
            determinants = -float(np.log(np.einsum("tii->ti", root)).sum())
        rows = columns.reshape(-1, p)
        total = rows.T @ rows
        step = inverse(total + prior * np.eye(p)) @ (errors.reshape(-1) @ rows + slope)
        left = errors - (rows @ step).reshape(errors.shape)
        squares, before = (self.rest + (each**2).sum(axis=1) for each in (left, errors))
        return _Solution(step, columns, left, determinants, squares, before, total)


LEAST_LOG, MOST_LOG = -9.0, 25.0
"""Logarithms of the variances between units that are tried, relative to the variance of a number by a usual unit."""

SCORING = 30
"""Most steps of the search for these variances."""

FARTHEST = 3.0
"""Largest change of such a logarithm in a step."""


def _variances(work: _Mixed, random: Integers, start: Floats | None = None) -> Floats:
    """Return the variances between units of some numbers, 0 of the others, of the largest restricted likelihood.

    By Fisher's scoring in their logarithms, cut until the likelihood does not fall.

    Source: Searle, Casella and McCulloch 1992, Variance Components, sec. 8.3.
    """
    p = work.columns.shape[2]
    usual: Floats = (work.columns**2).sum(axis=1).mean(axis=0)
    # columns have a unit size: what is less is rounding, and has no scatter
    random = random[usual[random] > ROUNDED]
    unit = 1 / usual[random]

    def solved(logs: Floats) -> tuple[Floats, _Solution]:
        variances = np.zeros(p)
        variances[random] = unit * np.exp(logs)
        return variances, work.solution(variances)

    if not len(random):
        return np.zeros(p)
    logs = np.full(len(random), 1.0)
    if start is not None:
        logs = np.clip(np.log(np.maximum(start[random] / unit, 1e-12)), LEAST_LOG, MOST_LOG)
    at, best = solved(logs)
    for _ in range(SCORING):
        slope, information = best.slopes(random)
        slope, information = slope * at[random], information * np.outer(at[random], at[random])
        free = ((logs > LEAST_LOG) | (slope > 0)) & ((logs < MOST_LOG) | (slope < 0))
        if not free.any():
            break
        step = np.zeros(len(random))
        size = np.diag(np.maximum(np.diagonal(information), 1e-12))[np.ix_(free, free)]
        step[free] = np.linalg.solve(information[np.ix_(free, free)] + 1e-6 * size, slope[free])
        step *= min(1.0, FARTHEST / max(float(np.abs(step).max()), 1e-300))
        if float(slope @ step) < ENOUGH:
            break
        for cut in (1.0, 0.5, 0.25, 0.1, 0.01):
            tried = np.clip(logs + cut * step, LEAST_LOG, MOST_LOG)
            beyond, other = solved(tried)
            if other.likelihood > best.likelihood:
                break
        else:
            break
        logs, at, best = tried, beyond, other
    return np.where(np.isin(np.arange(p), random[logs <= LEAST_LOG + 1e-6]), 0.0, at)
