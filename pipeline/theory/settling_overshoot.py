"""Settling time, overshoot and rise time of the step response, from the exact motion between samples.

All points are advanced sample by sample, and leave as soon as nothing that is asked for can change any more, which is
mostly known ahead from their modes. A device's motion is small only where all its states are, so that a
beat's silence is not taken for its end.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.normalised_loop import NormalisedLoop, as_points
from pipeline.records.criteria import OVERSHOOT
from pipeline.records.trials import Booleans, Floats, Integers
from pipeline.theory.modes import TOGETHER, WINDOW, earlier, outlooks
from pipeline.theory.motion import Motion, at_share, joined, pieces, turning_share, within_pieces

LONGEST = 1 << 18
"""Samples after which a response that still moves is given up (no settling time): spectral radius about 1 - 1e-5."""

NO_OVERSHOOT = OVERSHOOT.none
"""Overshoot up to this fraction counts as none. Part of the definition: Hulin 2017, footnote 4 of 5.2.2."""

QUIET = 0.1 * NO_OVERSHOOT
"""Motion below which a response is no longer followed for overshoot, by the same margin."""

_BLOCK = 16
"""Samples before the first check of which points are finished."""

_LARGEST_BLOCK = 32768
"""Samples of all points together between two checks: fewer points take longer to check than to advance."""

_FARTHEST = 1 << 18
"""Samples before the end of an envelope that are followed: next to the limit it may lie far above the motion."""

_CREEPING = 4.0
"""The same in cutoffs: what an envelope, larger than the motion where modes cancel, may end later."""

_AT_ONCE = 1024
"""Points that are advanced together: products of their matrices stay in a cache, and on one processor."""

_FIRST = 32
"""Samples before modes are looked at."""

_LOOK = 0.25
"""Samples of a point, times the square of its states, that take as long as a look: the modes of many are slow."""

_AGAIN = 64
"""Samples before those that may still overshoot are looked at again: about what a look costs."""

_FEW, _LONGER = 256, 7
"""Points below which a look costs more than so many samples, whatever their number, and how many more pass then."""

_WIDER = 2.0
"""Growth of the window in front of an end where nothing outside the band was met in it."""

_SETTLED = 0.1
"""Share of the band (or of the overshoot found) below which all motion has to stay for a block and a delay."""

_FADED = 0.25
"""The same for the largest deviation from a sample on."""

_STEPS, _FINE = 55, 1e-13
"""Newton's steps or halvings at most, which find a passing after the turn of its piece to below this share of it."""


@dataclass(frozen=True)
class _Asked:
    bands: Sequence[float]
    overshoot: bool
    continuous: bool
    longest: int
    quiet: float
    cutoff: float
    unfinished_overshoot: bool


def transient_costs(
    loop: NormalisedLoop,
    alpha: object,
    beta: object,
    bands: Sequence[float] = (0.01, 0.02, 0.05),
    *,
    overshoot: bool = True,
    continuous: bool = True,
    longest: int = LONGEST,
    quiet: float = QUIET,
    cutoff: float = np.inf,
    unfinished_overshoot: bool = False,
) -> dict[str, Floats]:
    """Return settling times and overshoot of the step response of stable points.

    Parameters
    ----------
    loop : NormalisedLoop
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
    asked = _Asked(bands, overshoot, continuous, longest, quiet, cutoff, unfinished_overshoot)
    found, everyone = _Found(loop, asked, len(a)), Motion(loop, a, b, between=continuous)
    for first in range(0, len(a), TOGETHER):
        _follow(everyone.part(slice(first, first + TOGETHER)), found)
    for band in bands:
        _enter(found, band)
    return found.costs()


def late_deviation(loop: NormalisedLoop, alpha: object, beta: object, first: object, longest: int) -> Floats:
    """Return the largest deviation of the samples from ``first`` on, relative to the final displacement.

    A discrete settling time of at most ``first`` can be had where this lies inside the band; unlike the settling time
    it is continuous in alpha and beta.

    Parameters
    ----------
    loop : NormalisedLoop
    alpha, beta : array_like, shape (n,)
        Normalised virtual stiffness and damping; stable, alpha + gamma > 0.
    first : array_like, shape (n,)
        First sample that counts, >= 1.
    longest : int
        Samples after which the largest deviation so far is returned.
    """
    a, b = as_points(alpha, beta)
    largest, begin = np.zeros(len(a)), np.broadcast_to(np.asarray(first, dtype=np.float64), a.shape)
    run, calm = Motion(loop, a, b, between=False), np.zeros(len(a))
    for count in _rounds(longest, _BLOCK):
        run.advance(count)
        at, size = run.index, np.abs(run.position[1:])
        counts = run.sample - count + np.arange(1, count + 1)[:, None] >= begin[at]
        largest[at] = np.maximum(largest[at], np.where(counts, size, 0.0).max(axis=0))
        moves = (np.maximum(run.size(), size.max(axis=0)) > _FADED * largest[at]) | (run.sample < begin[at])
        calm[at] = np.where(moves, 0.0, calm[at] + count)
        run = run.part(calm[at] <= run.memory)
        if not len(run.index):
            break
    return largest


def first_reached(
    loop: NormalisedLoop, alpha: Floats, beta: Floats, levels: Sequence[float], longest: int, between: bool
) -> tuple[Floats, Floats]:
    """Return when a step's motion first reaches deviations below zero, shape (levels, n); nan where it does not.

    First of the exact motion (nan where that is not asked for, ``between``), then of its samples joined by lines.
    """
    run, n = Motion(loop, alpha, beta, between=between), len(alpha)
    exact, sampled = [_Passing(run, n) for _ in levels], np.full((len(levels), n), np.nan)
    for count in _rounds(longest, _BLOCK):
        run.advance(count)
        place = run.position[:: run.each]
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


class _Passing:
    """Passing of a level by each point: number of its interval and piece, what the interval starts with, the level."""

    def __init__(self, run: Motion, n: int) -> None:
        self.loop, self.sample = run.loop, np.full(n, np.nan)
        self.piece, self.level = np.zeros(n, np.intp), np.zeros(n)
        self.given = np.zeros((run.rows.shape[1], n))

    def set(self, run: Motion, row: Integers, at: Integers, level: Floats) -> None:
        """Note passings in rows of the latest motion; of several of a point the last one counts."""
        later = ~(run.sample[at] - len(run.start) + row // run.each < self.sample[run.index[at]])
        row, at, level = row[later], at[later], level[later]
        interval, piece = np.divmod(row, run.each)
        index = run.index[at]
        self.sample[index] = run.sample[at] - len(run.start) + interval
        self.piece[index], self.level[index] = piece, level
        self.given[:, index] = run.start[interval, :, at].T

    def time(self) -> Floats:
        motion, side = within_pieces(self.loop, self.piece, self.given), np.sign(self.level)
        speed, share, high = motion[1:] * np.arange(1, len(motion))[:, None], turning_share(motion), np.ones(len(side))
        low = np.zeros_like(high)
        for step in range(_STEPS):
            miss = at_share(motion, share) - self.level
            still = miss * side > 0
            low, high = np.where(still, share, low), np.where(still, high, share)
            with np.errstate(divide="ignore", invalid="ignore"):
                new = share - miss / at_share(speed, share)
            # from the turn, beyond which the motion comes back, there is no tangent
            inside = (new >= low) & (new <= high) & (step > 0)
            before, share = share, np.where(inside, new, 0.5 * (low + high))
            if np.abs(share - before).max(initial=0.0) <= _FINE:
                break
        start, duration = _timing(self.loop)
        return np.asarray(self.sample + start[self.piece] + share * duration[self.piece])


class _Found:
    """What is known of each point."""

    def __init__(self, loop: NormalisedLoop, asked: _Asked, n: int) -> None:
        self.asked = asked
        self.peak, self.sampled_peak = np.zeros(n), np.zeros(n)
        self.settled = {band: np.zeros(n) for band in asked.bands}
        none = Motion(loop, np.zeros(0), np.zeros(0), between=asked.continuous)
        self.entry = {band: _Passing(none, n) for band in asked.bands}
        self.ahead = {band: [none] for band in asked.bands}
        self.late = {band: [none.index] for band in asked.bands}
        self.quiet, self.calm = np.zeros(n), np.zeros(n)
        self.restless, self.unfinished = [none.index], [none.index]

    def in_reach(self, ahead: Motion, band: float) -> Motion:
        """Return the points that settle soon enough after a sample to follow them there; of the others note no time."""
        late = ahead.stop - ahead.sample > min(_FARTHEST, _CREEPING * self.asked.cutoff)
        self.late[band].append(ahead.index[late])
        return ahead.part(~late)

    def known_peak(self, run: Motion) -> Floats:
        """Return the deviation of each point above which a later one counts."""
        return np.asarray(np.maximum(self.sampled_peak[run.index], self.asked.quiet))

    def costs(self) -> dict[str, Floats]:
        result: dict[str, Floats] = {}
        for band in self.asked.bands:
            name, unknown = f"settle_{100 * band:g}pct", np.concatenate([*self.restless, *self.late[band]])
            result[f"{name}_discrete"] = self.settled[band] + 1
            result[f"{name}_discrete"][unknown] = np.nan
            if self.asked.continuous:
                result[name] = self.entry[band].time()
                result[name][unknown] = np.nan
        if self.asked.overshoot:
            unknown = np.concatenate(self.unfinished) if not self.asked.unfinished_overshoot else self.unfinished[0]
            peaks = {"overshoot_discrete": self.sampled_peak, "overshoot": np.maximum(self.peak, self.sampled_peak)}
            for name in peaks if self.asked.continuous else ("overshoot_discrete",):
                result[name] = peaks[name]
                result[name][unknown] = np.nan
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
        views = list(outlooks(run, everyone))
        run = joined([view.before_a_peak(found.known_peak(view.run)) for view in views] + [v.unknown for v in views])
    found.unfinished.append(run.index)


def _enter(found: _Found, band: float) -> None:
    """Follow points before they settle; from earlier where no sample outside the band was met."""
    run, window = joined(found.ahead[band]), WINDOW
    while len(run.index):  # ends: each round starts earlier, at last where all before is known
        out = np.abs(run.watched[0] @ run.state[: run.own]) > band
        found.settled[band][run.index[out]] = run.sample[out]
        _marched(run, found, (band,), np.inf)
        missed = (found.settled[band][run.index] < run.sample) & (run.sample > run.since)
        window *= _WIDER
        run = found.in_reach(earlier(run.part(missed), band, window), band)


def _rounds(samples: float, least: int, most: int = 0) -> Iterator[int]:
    """Yield numbers of samples, so many in all: ``least``, and up to ``most`` a quarter of those before."""
    passed = 0
    while passed < samples:  # rises
        count = int(min(max(least, min(passed // 4, most)), samples - passed))
        yield count
        passed += count


def _marched(run: Motion, found: _Found, bands: Sequence[float], samples: float) -> Motion:
    """Advance points by so many samples, noting what they do; return those that still move."""
    order = np.argsort(run.stop - run.sample)
    parts = [run.part(order[first : first + _AT_ONCE]) for first in range(0, len(order), _AT_ONCE)]
    return joined([_advanced(part, found, bands, samples) for part in parts]) if parts else run


def _advanced(run: Motion, found: _Found, bands: Sequence[float], samples: float) -> Motion:
    for count in _rounds(samples, _BLOCK, _LARGEST_BLOCK // len(run.index)):
        run.advance(count)
        size, at = np.abs(run.position), run.index
        found.sampled_peak[at] = np.maximum(found.sampled_peak[at], run.position[:: run.each].max(axis=0))
        lasts = [_last_true(size > band) for band in bands]
        for band, last in zip(bands, lasts, strict=True):
            sampled = last if run.each == 1 else _last_true(size[:: run.each] > band)
            found.settled[band][at] = np.where(sampled > 0, run.sample - count + sampled, found.settled[band][at])
        if found.asked.continuous:
            _note(run, found, dict(zip(bands, lasts, strict=True)), size)
        done = (run.sample >= run.stop) | _finished(run, found, size[1:].max(axis=0))
        if done.any():
            run = run.part(~done)
        if not len(run.index):
            break
    return run


def _last_true(values: Booleans) -> Integers:
    """Return the last row of each column that is true, shape (n,); -1 where none is."""
    rows = np.arange(1, len(values) + 1, dtype=np.int8 if len(values) < 1 << 7 else np.int32)[:, None]
    return np.asarray((values * rows).max(axis=0).astype(np.intp) - 1)


def _finished(run: Motion, found: _Found, size: Floats) -> Booleans:
    """Return which points have nothing more to show, or are of no interest, by the largest deviation of a block, (n,).

    At one sample alone all states of the device may be small while a delayed force or a filter holds what is to come.
    """
    asked, at, count = found.asked, run.index, len(run.start)
    still = _SETTLED * min(asked.bands) if asked.bands else 1.0
    motion, limit = np.maximum(run.size(), size), np.full(len(at), still)
    if asked.overshoot:
        limit = np.minimum(limit, np.maximum(_SETTLED * found.sampled_peak[at], asked.quiet))
    found.quiet[at] = np.where(motion > limit, 0.0, found.quiet[at] + count)
    found.calm[at] = np.where(motion > still, 0.0, found.calm[at] + count)
    done = found.quiet[at] > run.memory
    if asked.bands and not asked.overshoot:
        late = (np.abs(run.position[-1]) > max(asked.bands)) & (run.sample >= asked.cutoff) & np.isinf(run.stop)
        found.unfinished.append(at[late])
        found.restless.append(at[late])
        done |= late
    return np.asarray(done)


def _note(run: Motion, found: _Found, lasts: dict[float, Integers], size: Floats) -> None:
    """Note extrema inside pieces, and entries into the bands after the last row outside each."""
    row, at, reach = _turns(run)
    event = np.maximum(run.position[row, at], run.position[row + 1, at]) + reach > found.known_peak(run)[at]
    event &= (run.velocity[row, at] > 0) & (found.asked.overshoot or not lasts)
    away = np.maximum(size[row, at], size[row + 1, at]) + reach
    for band, last in lasts.items():
        event |= (away > band) & (row >= last[at]) & (size[row + 1, at] <= band)
    row, at = row[event], at[event]
    extreme = _extremes(run, row, at)
    np.maximum.at(found.peak, run.index[at], extreme)
    for band, last in lasts.items():
        entered = np.flatnonzero((last >= 0) & (last < len(size) - 1))
        side = np.sign(run.position[last[entered], entered])
        found.entry[band].set(run, last[entered], entered, side * band)
        out = (np.abs(extreme) > band) & (row >= last[at]) & (size[row + 1, at] <= band)
        found.entry[band].set(run, row[out], at[out], np.sign(extreme[out]) * band)


def _turns(run: Motion) -> tuple[Integers, Integers, Floats]:
    """Return the pieces over which the motion turns, in order of time, their points, and how far it goes beyond."""
    forward = run.velocity > 0
    row, at = np.nonzero(forward[1:] != forward[:-1])
    speed = np.minimum(np.abs(run.velocity[row, at]), np.abs(run.velocity[row + 1, at]))
    return row, at, _timing(run.loop)[1][row % run.each] * speed


def _extremes(run: Motion, row: Integers, at: Integers) -> Floats:
    """Return the positions at which the motion turns within pieces."""
    interval, piece = np.divmod(row, run.each)
    motion = within_pieces(run.loop, piece, run.start[interval, :, at].T)
    return at_share(motion, turning_share(motion))


def _note_first(run: Motion, level: float, first: _Passing) -> None:
    """Note where the motion reaches a level for the first time: within a piece, at its end or at an extremum."""
    row, at, reach = _turns(run)
    near = np.maximum(run.position[row, at], run.position[row + 1, at]) + reach >= level
    near &= (run.velocity[row, at] > 0) & np.isnan(first.sample[run.index[at]])
    row, at = row[near], at[near]
    over = _extremes(run, row, at) >= level
    further, which = np.nonzero((run.position[1:] >= level) & np.isnan(first.sample[run.index]))
    row, at = np.concatenate([row[over], further]), np.concatenate([at[over], which])
    order = np.lexsort((row, at))
    earliest = order[np.unique(at[order], return_index=True)[1]]
    first.set(run, row[earliest], at[earliest], np.full(len(earliest), level))


def _timing(loop: NormalisedLoop) -> tuple[Floats, Floats]:
    """Return start and duration of each piece [T]."""
    start, duration = np.array([(piece.start, piece.duration) for piece in pieces(loop)]).T
    return start, duration
