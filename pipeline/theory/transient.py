"""Settling time, overshoot and rise time of a general loop's step response, from the exact motion between samples.

As `march`, for devices with more states: all points are advanced sample by sample, and leave as soon
as nothing that is asked for can change any more, which is mostly known ahead from their modes (`ahead`). A device's
motion is small only where all its states are, so that a beat's silence is not taken for its end.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.loop import Loop, as_points
from pipeline.records.batch import Booleans, Floats, Integers
from pipeline.theory.ahead import earlier, outlooks
from pipeline.theory.modes import TOGETHER
from pipeline.theory.motion import DEGREE, Motion, joined

_BLOCK = 16
"""Samples before the first check of which points are finished."""

_LARGEST_BLOCK = 8192
"""Samples of all points together between two checks: fewer points take longer to check than to advance."""

_FARTHEST = 1 << 18
"""Samples before the end of an envelope that are followed: next to the limit it may lie far above the motion."""

_AT_ONCE = 512
"""Points that are advanced together: products of their matrices stay in a cache, and on one processor."""

_FIRST = 64
"""Samples before modes are looked at."""

_LOOK = 0.25
"""Samples of a point, times the square of its states, that take as long as a look: the modes of many are slow."""

_AGAIN = 32
"""Samples before those that may still overshoot are looked at again: about what a look costs."""

_FEW, _LONGER = 256, 7
"""Points below which a look costs more than so many samples, whatever their number, and how many more pass then."""

_SETTLED = 0.1
"""Share of the band (or of the overshoot found) below which all motion has to stay for a block and a delay."""

_NEWTON = 5
"""Steps to a turning point from a first guess within a piece of at most one radian: each doubles its digits."""

_DIGITS = 1e-9
"""Step after which the next would be rounding."""

_HALVINGS = 54
"""Halves a piece to below 1e-16."""


@dataclass(frozen=True)
class Asked:
    """What is asked for, as of `transient.transient_costs`."""

    bands: Sequence[float]
    overshoot: bool
    continuous: bool
    longest: int
    quiet: float
    cutoff: float = np.inf
    enough: float = np.inf
    unfinished_overshoot: bool = False


@dataclass
class _Passing:
    """Last passing of a level: start and duration of the piece, the motion over it, bracket of the passing, level."""

    start: Floats
    duration: Floats
    motion: Floats
    low: Floats
    high: Floats
    level: Floats

    @classmethod
    def empty(cls, n: int) -> _Passing:
        unknown, zero = np.full(n, np.nan), np.zeros(n)
        return cls(unknown, unknown.copy(), np.zeros((DEGREE + 1, n)), zero, zero.copy(), zero.copy())

    @classmethod
    def of_pieces(cls, run: Motion, row: Integers, at: Integers, turned: Booleans, speed: Floats) -> _Passing:
        """Return the motion over pieces in order of time, up to where it turns.

        ``row`` and ``at`` are rows and columns of `Motion.ends`, ``speed`` (2, events) is that at both ends.
        """
        motion, high = run.motion(row, at), np.ones(len(at))
        some = np.flatnonzero(turned)
        if len(some):
            high[some] = _turning(motion[:, some], *speed[:, some])
        interval, number = np.divmod(row, len(run.pieces))
        start, duration = (
            np.array([getattr(piece, name) for piece in run.pieces])[number] for name in ("start", "duration")
        )
        time = run.sample[at] - len(run.made) + interval + start
        return cls(time, duration, motion, np.zeros(len(at)), high, np.zeros(len(at)))

    def part(self, which: Booleans | Integers) -> _Passing:
        return _Passing(*(getattr(self, f.name)[..., which] for f in fields(self)))

    def set(self, index: Integers, other: _Passing) -> None:
        for f in fields(self):
            getattr(self, f.name)[..., index] = getattr(other, f.name)

    def time(self) -> Floats:
        low, high, side = self.low.copy(), self.high.copy(), np.sign(self.level)
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            still = (_at(self.motion, middle) - self.level) * side > 0
            low, high = np.where(still, middle, low), np.where(still, high, middle)
        return self.start + 0.5 * (low + high) * self.duration


def step_costs(loop: Loop, alpha: Floats, beta: Floats, asked: Asked) -> dict[str, Floats]:
    """Return settling times and overshoot, named and defined as by `transient.transient_costs`."""
    found, everyone = _Found(asked, len(alpha)), Motion(loop, alpha, beta, between=asked.continuous)
    for first in range(0, len(alpha), TOGETHER):
        _follow(everyone.part(slice(first, first + TOGETHER)), found)
    for band in asked.bands:
        _enter(found, band)
    return found.costs()


def late_sample(loop: Loop, alpha: Floats, beta: Floats, first: int, longest: int, faded: float) -> Floats:
    """Return the largest deviation of samples from ``first`` on, until all motion is below a share ``faded`` of it."""
    run, largest, calm = Motion(loop, alpha, beta, between=False), np.zeros(len(alpha)), np.zeros(len(alpha))
    for count in _rounds(first - 1, _BLOCK):
        run.advance(count)
    for count in _rounds(longest - first + 1, _BLOCK):
        run.advance(count)
        deviation = np.abs(run.sensed).max(axis=0)
        largest = np.maximum(largest, deviation)
        calm = np.where(np.maximum(run.size(), deviation) > faded * largest, 0.0, calm + 1)
        if np.all(calm * _BLOCK > run.memory):
            break
    return largest


def first_reached(
    loop: Loop, alpha: Floats, beta: Floats, levels: Sequence[float], longest: int, between: bool
) -> tuple[Floats, Floats]:
    """Return when a step's motion first reaches deviations below zero, shape (levels, n); nan where it does not.

    First of the exact motion (nan where that is not asked for, ``between``), then of its samples joined by lines.
    """
    run, n = Motion(loop, alpha, beta, between=between), len(alpha)
    exact, sampled = [_Passing.empty(n) for _ in levels], np.full((len(levels), n), np.nan)
    for count in _rounds(longest, _BLOCK):
        place = run.position[None]
        run.advance(count)
        place = np.concatenate([place, run.sensed])
        for level, passing, row in zip(levels, exact, sampled, strict=True):
            over = place[1:] >= level
            new = np.flatnonzero(np.isnan(row[run.index]) & over.any(axis=0))
            k = over.argmax(axis=0)[new]
            share = (level - place[k, new]) / (place[k + 1, new] - place[k, new])
            row[run.index[new]] = run.sample[new] - count + k + share
            if between:
                _note_first(run, level, passing)
        run = run.part(np.isnan(sampled[:, run.index]).any(axis=0))
        if not len(run.index):
            break
    return np.array([passing.time() for passing in exact]), sampled


def _rounds(samples: float, least: int, most: int = 0) -> Iterator[int]:
    """Yield numbers of samples, so many in all: ``least``, and up to ``most`` a quarter of those before."""
    passed = 0
    while passed < samples:  # rises
        count = int(min(max(least, min(passed // 4, most)), samples - passed))
        yield count
        passed += count


class _Found:
    """What is known of each point."""

    def __init__(self, asked: Asked, n: int) -> None:
        self.asked = asked
        self.peak, self.sampled_peak = np.zeros(n), np.zeros(n)
        self.settled = {band: np.zeros(n) for band in asked.bands}
        self.entry = {band: _Passing.empty(n) for band in asked.bands}
        self.quiet, self.calm = np.zeros(n), np.zeros(n)
        self.ahead: dict[float, list[Motion]] = {band: [] for band in asked.bands}
        self.late: dict[float, list[Integers]] = {band: [] for band in asked.bands}
        self.restless: list[Integers] = []
        self.unfinished: list[Integers] = []

    def in_reach(self, ahead: Motion, band: float) -> Motion:
        """Return the points that settle soon enough after a sample to follow them there; of the others note no time."""
        late = ahead.stop - ahead.sample > _FARTHEST
        self.late[band].append(ahead.index[late])
        return ahead.part(~late)

    def known_peak(self, run: Motion) -> Floats:
        """Return the deviation of each point above which a later one counts."""
        return np.asarray(np.maximum(self.sampled_peak[run.index], self.asked.quiet))

    def costs(self) -> dict[str, Floats]:
        result: dict[str, Floats] = {}
        restless, unfinished = (
            np.concatenate([np.zeros(0, np.intp), *parts]) for parts in (self.restless, self.unfinished)
        )
        for band in self.asked.bands:
            name = f"settle_{100 * band:g}pct"
            told = {f"{name}_discrete": self.settled[band] + 1}
            if self.asked.continuous:
                told[name] = self.entry[band].time()
            for at in self.late[band]:
                for values in told.values():
                    values[at] = np.nan
            result |= told
        for values in result.values():
            values[restless] = np.nan
        if self.asked.overshoot:
            peaks = {"overshoot_discrete": self.sampled_peak}
            if self.asked.continuous:
                peaks["overshoot"] = np.maximum(self.peak, self.sampled_peak)
            if not self.asked.unfinished_overshoot:
                for values in peaks.values():
                    values[unfinished] = np.nan
            result |= peaks
        return result


def _follow(run: Motion, found: _Found) -> None:
    """Follow points until all is known, or modes tell where they settle."""
    asked, everyone, climbing = found.asked, run, [run.part(slice(0))]
    look = run.loop.states**2 * _LOOK
    for samples in _rounds(asked.longest, max(_FIRST, int(look))):
        run = _marched(run, found, asked.bands, samples)
        if not len(run.index):
            break
        unknown = [run.part(slice(0))]
        for view in outlooks(run, everyone):
            unknown.append(view.unknown)
            for band in asked.bands:
                ahead = view.before_the_end(band)
                found.ahead[band].append(found.in_reach(ahead, band))
            if asked.overshoot:
                climbing.append(view.before_a_peak(found.known_peak(view.run)))
        run = joined(unknown)
    found.restless.append(run.index[found.calm[run.index] <= run.memory])
    found.unfinished.append(run.index)
    run, left = joined(climbing), asked.longest
    while left > 0:  # falls
        samples = min(max(_AGAIN, int(look)) * (1 + min(_FEW // max(len(run.index), 1), _LONGER)), left)
        left -= samples
        found.quiet[run.index] = 0  # some were moved ahead
        run = _marched(run, found, (), samples)
        if not len(run.index):
            break
        run = joined(
            [
                part
                for view in outlooks(run, everyone)
                for part in (view.before_a_peak(found.known_peak(view.run)), view.unknown)
            ]
        )
    found.unfinished.append(run.index)


def _enter(found: _Found, band: float) -> None:
    """Follow points before they settle; from earlier where no sample outside the band was met."""
    run = joined(found.ahead[band]) if found.ahead[band] else None
    while run is not None and len(run.index):  # ends: each round starts earlier, at last where all before is known
        out = np.abs(run.position) > band
        found.settled[band][run.index[out]] = run.sample[out]
        _marched(run, found, (band,), np.inf)
        missed = (found.settled[band][run.index] < run.sample) & (run.sample > run.since)
        run = found.in_reach(earlier(run.part(missed)), band)


def _marched(run: Motion, found: _Found, bands: Sequence[float], samples: float) -> Motion:
    """Advance points by so many samples, noting what they do; return those that still move."""
    order = np.argsort(run.stop - run.sample)
    parts = [run.part(order[first : first + _AT_ONCE]) for first in range(0, len(order), _AT_ONCE)]
    return joined([_advanced(part, found, bands, samples) for part in parts]) if parts else run


def _advanced(run: Motion, found: _Found, bands: Sequence[float], samples: float) -> Motion:
    for count in _rounds(samples, _BLOCK, _LARGEST_BLOCK // len(run.index)):
        run.advance(count)
        if run.pieces:
            _note(run, found, bands)
        sensed, at = run.sensed, run.index
        size = np.abs(sensed)
        number = np.arange(1.0, count + 1)[:, None]
        for band in bands:
            last = ((size > band) * number).max(axis=0)
            found.settled[band][at] = np.where(last > 0, run.sample - count + last, found.settled[band][at])
        found.sampled_peak[at] = np.maximum(found.sampled_peak[at], sensed.max(axis=0))
        done = (run.sample >= run.stop) | _finished(run, found, size)
        if done.any():
            run = run.part(~done)
        if not len(run.index):
            break
    return run


def _finished(run: Motion, found: _Found, size: Floats) -> Booleans:
    """Return which points have nothing more to show, or are of no interest, by all deviations of a block, (count, n).

    At one sample alone all states of the device may be small while a delayed force or a filter holds what is to come.
    """
    asked, at = found.asked, run.index
    still = _SETTLED * min(asked.bands) if asked.bands else 1.0
    motion, limit = np.maximum(run.size(), size.max(axis=0)), np.full(len(at), still)
    if asked.overshoot:
        limit = np.minimum(limit, np.maximum(_SETTLED * found.sampled_peak[at], asked.quiet))
    found.quiet[at] = np.where(motion > limit, 0.0, found.quiet[at] + len(size))
    found.calm[at] = np.where(motion > still, 0.0, found.calm[at] + len(size))
    done = found.quiet[at] > run.memory
    if not asked.bands:
        done |= np.maximum(found.peak, found.sampled_peak)[at] > asked.enough
    elif not asked.overshoot:
        late = (size[-1] > max(asked.bands)) & (run.sample > asked.cutoff) & np.isinf(run.stop)
        found.unfinished.append(at[late])
        found.restless.append(at[late])
        done |= late
    return np.asarray(done)


def _note(run: Motion, found: _Found, bands: Sequence[float]) -> None:
    """Note extrema inside pieces, and entries into the bands."""
    ends = run.ends()
    event = ends[2] * ends[3] < 0
    outside = np.abs(ends[:2])
    for band in bands:
        event |= (outside[0] > band) & (outside[1] <= band)
    row, at = np.nonzero(event)
    before, after, *speed = ends[:, row, at]
    size_before, size_after = np.abs(before), np.abs(after)
    turned = speed[0] * speed[1] < 0
    duration = np.array([piece.duration for piece in run.pieces])[row % len(run.pieces)]
    further = duration * np.minimum(np.abs(speed[0]), np.abs(speed[1]))
    event = turned & (speed[0] > 0) & (np.maximum(before, after) + further > found.peak[run.index[at]])
    if not found.asked.overshoot and bands:
        event[:] = False
    for band in bands:
        # it enters the band, or leaves it for a moment
        out = (size_before > band) | (turned & (np.maximum(size_before, size_after) + further > band))
        event |= (size_after <= band) & out
    row, at, turned, before, size_before, size_after = (
        values[event] for values in (row, at, turned, before, size_before, size_after)
    )
    passing = _Passing.of_pieces(run, row, at, turned, np.array(speed)[:, event])
    extreme, which = np.where(turned, _at(passing.motion, passing.high), 0.0), run.index[at]
    np.maximum.at(found.peak, which, extreme)
    for band in bands:
        out = np.abs(extreme) > band
        new = (size_after <= band) & (out | (size_before > band))
        low, high = np.where(out, passing.high, 0.0), np.where(out, 1.0, passing.high)
        level = np.sign(np.where(out, extreme, before)) * band
        found.entry[band].set(which[new], replace(passing, low=low, high=high, level=level).part(new))


def _note_first(run: Motion, level: float, first: _Passing) -> None:
    """Note where the motion reaches a level for the first time: within a piece, at its end or at an extremum."""
    _, after, *speed = run.ends()
    turned = (speed[0] > 0) & (speed[1] < 0)
    row, at = np.nonzero(np.isnan(first.start[run.index]) & ((after >= level) | turned))
    passing = _Passing.of_pieces(run, row, at, turned[row, at], np.array(speed)[:, row, at])
    passing.level[:] = level
    over = (after[row, at] >= level) | (_at(passing.motion, passing.high) >= level)
    which, rows = np.unique(run.index[at][over], return_index=True)
    first.set(which, passing.part(np.flatnonzero(over)[rows]))


def _at(motion: Floats, share: Floats) -> Floats:
    """Return polynomials, shape (13, n), at shares of their piece."""
    result: Floats = motion[-1].copy()
    for coefficient in motion[-2::-1]:
        result = result * share + coefficient
    return result


def _turning(motion: Floats, start: Floats, end: Floats) -> Floats:
    """Return the shares at which motions that turn have no velocity."""
    speed = motion[1:] * np.arange(1, len(motion))[:, None]
    change = speed[1:] * np.arange(1, len(speed))[:, None]
    share: Floats = start / (start - end)  # of different sign
    for _ in range(_NEWTON):
        bend, before = _at(change, share), share
        share = np.minimum(np.maximum(share - _at(speed, share) / np.where(bend == 0, np.inf, bend), 0.0), 1.0)
        if np.abs(share - before).max() < _DIGITS:
            break
    return share


LONGEST = 1 << 18
"""Samples after which a response that still moves is given up (no settling time): spectral radius about 1 - 1e-5."""

NO_OVERSHOOT = 1e-12
"""Overshoot up to this fraction counts as none. Part of the definition: Hulin 2017, footnote 4 of 5.2.2."""

_FADED = 0.25
"""Motion relative to the largest deviation found below which no larger one follows: the reciprocal of fourfold."""

QUIET = 0.1 * NO_OVERSHOOT
"""Motion below which a response is no longer followed for overshoot, by the same margin."""


def transient_costs(
    loop: Loop,
    alpha: object,
    beta: object,
    bands: Sequence[float] = (0.01, 0.02, 0.05),
    *,
    overshoot: bool = True,
    continuous: bool = True,
    longest: int = LONGEST,
    quiet: float = QUIET,
    cutoff: float = np.inf,
    enough: float = np.inf,
    unfinished_overshoot: bool = False,
) -> dict[str, Floats]:
    """Return settling times and overshoot of the step response of stable points.

    Parameters
    ----------
    loop : Loop
    alpha, beta : array_like, shape (n,)
        Normalised virtual stiffness and damping; stable, alpha + gamma > 0.
    bands : sequence of float
        Half widths of the settling bands relative to the final displacement, in (0, 1).
    overshoot : bool
        Whether the overshoot is asked for; without it responses are followed only until they have settled.
    continuous : bool
        Whether the motion between samples is asked for, besides the samples.
    longest : int
        Samples after which a point that still moves, and of which its modes tell nothing, gets no result.
    quiet : float
        Deviation below which a response without overshoot so far is no longer followed; a map that is only drawn
        does not need the default.
    cutoff : float
        Settling time [samples] from which on a point is of no interest: one still outside all bands then is given
        up. A search knows the best value so far.
    enough : float
        Overshoot above which a point is of no further interest; only for calls without bands.
    unfinished_overshoot : bool
        Whether points that still move after ``longest`` samples get the overshoot found so far instead of none.

    Returns
    -------
    dict of float64, shape (n,)
        ``settle_<band in percent>pct_discrete`` [samples]: smallest k with all samples from k on inside the band;
        ``settle_<..>pct`` [samples]: last entry of the continuous position into the band; ``overshoot`` and
        ``overshoot_discrete``: largest excess over the final position relative to the final displacement, >= 0.
        NaN where the response still moves too much after ``longest`` samples to know; a settling time may be known
        where the overshoot, which has the finer limit, is not.

    Source: Hulin 2017, eqs. 5.10 to 5.12.
    """
    a, b = as_points(alpha, beta)
    if np.any(a + loop.gamma <= 0):
        raise ParameterError("a step response needs alpha + gamma > 0: without stiffness there is no final position.")
    if any(not 0 < band < 1 for band in bands):
        raise ParameterError(f"bands = {list(bands)}: expected fractions between 0 and 1, such as 0.02.")
    asked = Asked(bands, overshoot, continuous, longest, quiet, cutoff, enough, unfinished_overshoot)
    return step_costs(loop, a, b, asked)


def late_deviation(loop: Loop, alpha: object, beta: object, first: int, longest: int) -> Floats:
    """Return the largest deviation of the samples from ``first`` on, relative to the final displacement.

    A discrete settling time of at most ``first`` can be had where this lies inside the band; unlike the settling time
    it is continuous in alpha and beta.

    Parameters
    ----------
    loop : Loop
    alpha, beta : array_like, shape (n,)
        Normalised virtual stiffness and damping; stable, alpha + gamma > 0.
    first : int
        First sample that counts, >= 1.
    longest : int
        Samples after which the largest deviation so far is returned.
    """
    a, b = as_points(alpha, beta)
    return late_sample(loop, a, b, first, longest, _FADED)
