"""Loops that the trials so far allow: a set of mass, damping and delay, weighted by limits and growth rates.

The set proposes where to try next and decides nothing: a device that no such loop describes costs more trials, and the
limits that are reported are those of verdicts all the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from pipeline.loop.loop import Loop
from pipeline.plan.evidence import Evidence, told_by_rates
from pipeline.plan.forecast import TAILS, Foretold, scale_of
from pipeline.records.batch import Floats
from pipeline.theory.poles import boundary_points

SIZE, ROUNDS = 1200, 4
"""Loops in the set, and how often it is drawn anew around those that fit."""

DELAYS = np.geomspace(1.0, 60.0, 40)
"""Delays whose curves are computed [samples]; between them the nearest: the shapes hardly differ."""

PLACES = 128
"""Dampings at which a curve is kept."""

RANGE_SPREAD = (0.8, 0.35)
"""Standard deviation of ln K and ln B of the set before any trial, around the range."""

MISFIT = (0.01, 0.4)
"""Range of the relative error that loops of the set may have at each damping."""

OWN, LARGEST_OWN = 0.03, 0.3
"""Share of the device's own damping in the largest B: that of a Falcon, and the most that is thought of."""

MISFIT_USUAL = 0.03
"""Misfit that is as likely to be exceeded as not, before any trial."""

CAP = 3.0
"""Largest penalty of a loop for one bracket, as logarithm: a mode may cut off what any loop of the set would allow."""

JITTER = 0.4
"""Part of the set's spread that is drawn anew in each round."""


@dataclass(frozen=True, eq=False)
class Curves:
    """Limits of undamped devices by delay, relative to their peaks, shape (delays, `PLACES`).

    ``limit`` is K over the largest K, ``slope`` d growth/dK times largest K and T, at dampings evenly from 0 to the
    largest; ``ratio`` is largest K T over largest B, which tells the delay.
    """

    limit: Floats
    slope: Floats
    ratio: Floats


@cache
def curves() -> Curves:
    """Return the curves of all `DELAYS`.

    Notes
    -----
    On the limit K + B (1 - 1/z)/T = W(z), z = exp(i theta); so a change of K moves the pole by
    d ln z = dK / (-i W' - B/(z T)).

    Source: Hulin 2017, sec. 3.4, closed form of the boundary.
    """
    limits, slopes, ratios = [], [], []
    for delay in DELAYS:
        theta = np.pi / (delay + 0.5) * np.sin(0.5 * np.pi * np.linspace(0, 1, 600)[1:-1])
        theta = theta[theta < np.pi]
        alpha, beta = boundary_points(Loop(0.0, 0.0, float(delay)), theta)
        end = int(np.argmax(alpha)) + int(np.argmax(alpha[np.argmax(alpha) :] < 0))
        alpha, beta, theta = alpha[:end], beta[:end], theta[:end]
        turn = np.exp(-1j * theta)
        curve = alpha + beta * (1 - turn)
        moved = 1 / (-1j * np.gradient(curve, theta) - beta * turn)
        place = np.linspace(0, 1, PLACES) * beta[-1]
        limits.append(np.interp(place, beta, alpha) / alpha.max())
        slopes.append(np.interp(place, beta, moved.real) * alpha.max())
        ratios.append(alpha.max() / beta[-1])
    return Curves(np.maximum(limits, 0.0), np.array(slopes), np.array(ratios))


@dataclass(frozen=True)
class Range:
    """Where limits are looked for: a stiffness near them [N/m, Nm/rad], and the largest damping [Ns/m, Nms/rad].

    ``trial_s`` is how long a log goes on after its step [s].
    """

    stiffness: float
    damping: float
    sampling_period_s: float
    trial_s: float = 0.0


@dataclass(frozen=True, eq=False)
class Loops:
    """The set of loops: logarithms of largest stiffness and damping and of the misfit, and the device's own damping.

    Shape (`SIZE`, 4): ln K, ln B, ln of the share of B that the device's damping is, ln misfit.
    """

    values: Floats
    sampling_period_s: float

    @property
    def largest(self) -> Floats:
        """Largest stable stiffness of each loop, shape (loops,)."""
        return np.exp(self.values[:, 0])

    def limits(self, dampings: Floats) -> tuple[Floats, Floats]:
        """Return limits [N/m, Nm/rad] and slopes of the growth rate over K there, shape (loops, dampings) both."""
        table = curves()
        largest, reach, own, _ = np.exp(self.values).T
        ratio = largest * self.sampling_period_s / reach
        # the ratio falls with the delay
        shape = len(DELAYS) - 1 - np.searchsorted(table.ratio[::-1], ratio).clip(0, len(DELAYS) - 1)
        at = dampings / reach[:, None] + own[:, None]
        place = np.clip(at, 0, 1) * (PLACES - 1)
        lower = np.minimum(place.astype(np.int64), PLACES - 2)
        part = place - lower
        limit, slope = (
            of[shape[:, None], lower] * (1 - part) + of[shape[:, None], lower + 1] * part
            for of in (table.limit, table.slope)
        )
        limit = np.where((at < 0) | (at > 1), 0.0, limit)
        slope = np.maximum(slope, 1e-3)
        return limit * largest[:, None], slope / (largest[:, None] * self.sampling_period_s)


def weigh(loops: Loops, seen: Evidence) -> Floats:
    """Return the logarithm of how well each loop fits what was seen, shape (loops,)."""
    limit, slope = loops.limits(seen.damping)
    scale = scale_of(limit, loops.largest[:, None])
    misfit = np.exp(loops.values[:, 3])[:, None] * scale
    told, error = told_by_rates(seen, slope)
    spread = np.hypot(misfit, error)
    known = np.isfinite(told)
    off = (limit - np.where(known, told, limit)) / spread
    by_rate = np.where(known, -0.5 * (TAILS + 1) * np.log1p(off**2 / TAILS) - np.log(spread / scale), 0.0)
    outside = np.maximum(np.maximum(seen.low - limit, limit - seen.high), 0.0) / misfit
    return np.asarray((by_rate - np.minimum(0.5 * outside**2, CAP)).sum(axis=1))


def draw(around: Range, seen: Evidence) -> Loops:
    """Return loops that fit what was seen.

    Notes
    -----
    Tempered importance sampling: loops from around the range are weighted by a growing power of how well they fit,
    drawn anew and spread a little, so that spread and mean stay. The same input gives the same set.
    """
    random = np.random.default_rng(0)
    values = np.column_stack(
        [
            random.normal(np.log(around.stiffness), RANGE_SPREAD[0], SIZE),
            random.normal(np.log(around.damping), RANGE_SPREAD[1], SIZE),
            random.normal(np.log(OWN), 1.0, SIZE),
            random.normal(np.log(MISFIT_USUAL), 0.8, SIZE),
        ]
    )
    powers = np.geomspace(0.02, 1.0, ROUNDS)
    loops = Loops(values, around.sampling_period_s)
    for step in np.diff(powers, prepend=0.0):
        fit = step * weigh(loops, seen)
        weight = np.exp(fit - fit.max())
        cumulated = np.cumsum(weight / weight.sum())
        chosen = np.minimum(np.searchsorted(cumulated, (np.arange(SIZE) + 0.5) / SIZE), SIZE - 1)
        values = loops.values[chosen]
        spread = values.std(axis=0)
        shaken = values.mean(axis=0) + np.sqrt(1 - JITTER**2) * (values - values.mean(axis=0))
        values = shaken + JITTER * spread * random.standard_normal(values.shape)
        values[:, 2] = np.minimum(values[:, 2], np.log(LARGEST_OWN))
        values[:, 3] = np.clip(values[:, 3], np.log(MISFIT[0]), np.log(MISFIT[1]))
        loops = Loops(values, around.sampling_period_s)
    return loops


def foretold(around: Range, seen: Evidence, dampings: Floats) -> Foretold:
    """Return the limits at dampings, shape (n,), as loops that fit what was seen tell."""
    loops = draw(around, seen)
    limits, _ = loops.limits(dampings)
    there, slopes = loops.limits(seen.damping)
    low, value, high = np.percentile(limits, (16, 50, 84), axis=0)
    return Foretold(
        value,
        0.5 * (high - low),
        np.median(there, axis=0),
        np.median(slopes, axis=0),
        float(np.median(loops.largest)),
        float(np.exp(loops.values[:, 3].mean())),
    )
