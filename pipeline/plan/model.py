"""Loops that the trials so far allow: a set of mass, damping and delay, weighted by limits and growth rates.

The set proposes where to try next and decides nothing: a device that no such loop describes costs more trials, and the
limits that are reported are those of verdicts all the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from pipeline.loop.loop import Loop
from pipeline.plan.verdicts import Tried
from pipeline.records.batch import Floats
from pipeline.theory.stability.stability import boundary_points

SIZE, ROUNDS = 1200, 4
"""Loops in the set, and how often it is drawn anew around those that fit."""

DELAYS = np.geomspace(1.0, 60.0, 40)
"""Delays whose curves are computed [samples]; between them the nearest: the shapes hardly differ."""

PLACES = 128
"""Dampings at which a curve is kept."""

RANGE_SPREAD = (0.8, 0.35)
"""Standard deviation of ln K and ln B of the set before any trial, around the range."""

RATE_TRUST = 0.2
"""Error of a limit that one growth rate tells, relative to its distance from the trial. In simulations of Falcons with
filter, lag, mode and friction 0.05 to 0.3; the rate is convex over K."""

CREEP = 0.8
"""Share of the rate K/B of a creeping motion: a mode that decays nearly so fast is that motion, and tells nothing."""

MISFIT = (0.01, 0.4)
"""Range of the relative error that loops of the set may have at each damping."""

OWN, LARGEST_OWN = 0.03, 0.3
"""Share of the device's own damping in the largest B: that of a Falcon, and the most that is thought of."""

MISFIT_USUAL = 0.03
"""Misfit that is as likely to be exceeded as not, before any trial."""

TAILS = 1.5
"""Degrees of freedom of Student's distribution of what loops miss: one damping may be quite another thing."""

CAP = 3.0
"""Largest penalty of a loop for one bracket, as logarithm: a mode may cut off what any loop of the set would allow."""

JITTER = 0.4
"""Part of the set's spread that is drawn anew in each round."""

APART = 0.03
"""Distance of two walls relative to K from which on their rates tell a slope."""

INADEQUATE = 0.25
"""Misfit from which on the model is said not to fit, and no longer proposes."""

SMOOTH = 0.15
"""Length over which the misfit changes, relative to the range of dampings."""


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
class Forecast:
    """Limit at each damping before it is measured: value and standard error [N/m, Nm/rad], both of shape (n,).

    ``misfit`` is the relative error that loops of the set have where the limits are known.
    """

    limit: Floats
    error: Floats
    misfit: float

    @property
    def adequate(self) -> bool:
        """Whether the model may propose."""
        return self.misfit < INADEQUATE


@dataclass(frozen=True, eq=False)
class Evidence:
    """What was seen at dampings, shape (n,) each.

    Ends of the bracket by verdicts (0 and infinite where there is none), the wall whose growth rate is nearest to 0,
    that rate [1/s], and how it rises over K as two trials show; NaN where there is none.
    """

    damping: Floats
    low: Floats
    high: Floats
    wall: Floats
    rate: Floats
    slope: Floats


def informative(tried: Tried) -> Floats:
    """Return the growth rates that tell of the limit, NaN elsewhere: a creeping motion does not."""
    creep = CREEP * tried.stiffness / np.maximum(np.abs(tried.damping), 1e-300)
    decay = -tried.growth
    known = np.isfinite(tried.growth) & ((decay < 0) | (decay < creep) & (tried.verdict == "stable"))
    return np.where(known, tried.growth, np.nan)


def evidence(tried: Tried, dampings: Floats, brackets: list[tuple[float, float]]) -> Evidence:
    """Return what the trials at each damping tell of its limit.

    Parameters
    ----------
    tried : Tried
    dampings : float64, shape (n,)
    brackets : list of (float, float), n of them
        Ends by the verdicts, 0 and infinity where there is none.
    """
    count = len(dampings)
    wall, rate, slope = np.full(count, np.nan), np.full(count, np.nan), np.full(count, np.nan)
    rates = informative(tried)
    for place, damping in enumerate(dampings):
        own = np.flatnonzero((tried.damping == damping) & np.isfinite(rates))
        own = own[np.argsort(np.abs(rates[own]), kind="stable")]
        if not len(own):
            continue
        first = own[0]
        wall[place], rate[place] = tried.stiffness[first], rates[first]
        for other in own[1:]:
            apart = tried.stiffness[other] - wall[place]
            if abs(apart) > APART * wall[place]:
                rise = (rates[other] - rate[place]) / apart
                slope[place] = rise if rise > 0 else np.nan
                break
    ends = np.array(brackets, dtype=np.float64).reshape(count, 2)
    return Evidence(dampings, ends[:, 0], ends[:, 1], wall, rate, slope)


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
    scale = _scale(limit, loops.largest[:, None])
    misfit = np.exp(loops.values[:, 3])[:, None] * scale
    told, error = told_by_rates(seen, slope)
    spread = np.hypot(misfit, error)
    known = np.isfinite(told)
    off = (limit - np.where(known, told, limit)) / spread
    by_rate = np.where(known, -0.5 * (TAILS + 1) * np.log1p(off**2 / TAILS) - np.log(spread / scale), 0.0)
    outside = np.maximum(np.maximum(seen.low - limit, limit - seen.high), 0.0) / misfit
    return np.asarray((by_rate - np.minimum(0.5 * outside**2, CAP)).sum(axis=1))


def told_by_rates(seen: Evidence, slope: Floats) -> tuple[Floats, Floats]:
    """Return the limits that growth rates tell and their errors, NaN where there is none; shape of the slope.

    A slope that two trials show is better than one of a model, which holds near the limit alone. A limit below zero is
    one at zero, the surer the farther below.
    """
    own = np.isfinite(seen.slope)
    away = seen.rate / np.where(own, seen.slope, slope)
    error = RATE_TRUST * np.abs(away) * np.where(own, 1, 1 + 2 * np.abs(away) / seen.wall)
    told = seen.wall - away
    below = np.maximum(-told, 0.0)
    return np.maximum(told, 0.0), error / (1 + below / np.maximum(error, 1e-300))


def _scale(limit: Floats, largest: Floats | float) -> Floats:
    """What a relative misfit is relative to: limits near 0 are as hard to foretell as others."""
    return 0.7 * limit + 0.3 * largest


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


def forecast(around: Range, seen: Evidence, dampings: Floats) -> Forecast:
    """Return the limit at each damping as loops that fit, and the neighbours' misfit, tell.

    Parameters
    ----------
    around : Range
    seen : Evidence
    dampings : float64, shape (n,)

    Notes
    -----
    What the loops miss at dampings that were tried is carried on to their neighbours as a random function of the
    damping (kriging) with the misfit as standard deviation and `SMOOTH` of the range as length.
    """
    loops = draw(around, seen)
    limits, _ = loops.limits(dampings)
    there, slopes = loops.limits(seen.damping)
    low, value, high = np.percentile(limits, (16, 50, 84), axis=0)
    spread = 0.5 * (high - low)
    misfit = float(np.exp(loops.values[:, 3].mean()))
    expected, rise = np.median(there, axis=0), np.median(slopes, axis=0)
    largest = float(np.median(loops.largest))
    told, error = told_by_rates(seen, rise)
    told = np.clip(np.where(np.isnan(told), 0.5 * (seen.low + seen.high), told), seen.low, seen.high)
    by_ends = (seen.high - seen.low) / np.sqrt(12)
    error = np.fmin(np.where(np.isnan(error), np.inf, error + 0.003 * largest), by_ends)
    known = np.isfinite(told) & np.isfinite(error)
    scale = _scale(value, largest)
    if known.any():
        missed = ((told - expected) / _scale(expected, largest))[known]
        noise = (error / _scale(expected, largest))[known]
        length = SMOOTH * float(np.ptp(dampings) or 1.0)
        place = seen.damping[known]
        # where a damping was tried, its own loops' spread is as unknown as the misfit
        size = np.hypot(misfit, np.interp(place, dampings, spread / scale))
        ahead = np.hypot(misfit, spread / scale)
        among = _likeness(place, place, length) * size[:, None] * size + np.diag(noise**2 + 1e-8)
        toward = _likeness(dampings, place, length) * ahead[:, None] * size
        gain = np.linalg.solve(among, toward.T).T
        value = np.maximum(value + scale * (gain @ missed), 0.0)
        spread = scale * np.sqrt(np.maximum(ahead**2 - (gain * toward).sum(axis=1), 1e-6))
    else:
        spread = np.hypot(spread, misfit * scale)
    return Forecast(value, spread, misfit)


def _likeness(first: Floats, second: Floats, length: float) -> Floats:
    return np.exp(-0.5 * ((first[:, None] - second) / length) ** 2)
