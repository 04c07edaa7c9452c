"""Settling time and overshoot of a general loop's step response, from the exact motion between samples.

As `cost.transient`, for devices with more states: all points are advanced sample by sample, and leave as soon as
nothing that is asked for can change any more. A device's motion is small only where all its states are, so that a
beat's silence is not taken for its end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from pipeline.loop.device_loop import DeviceLoop
from pipeline.records.batch import Booleans, Floats, Integers
from pipeline.theory.device.pieces import DEGREE, Piece, pieces

_BLOCK = 16
"""Samples between two checks of which points are finished."""

_SETTLED = 0.1
"""Share of the band (or of the overshoot found) below which all motion has to stay for a block and a delay."""

_TOGETHER = 4096
"""Points that are advanced together: their states fit a cache."""

_NEWTON = 5
"""Steps to a turning point from a first guess within a piece of at most one radian: each doubles its digits."""

_HALVINGS = 54
"""Halves a piece to below 1e-16."""


@dataclass(frozen=True)
class Asked:
    """What is asked for, as of `cost.transient.transient_costs`."""

    bands: Sequence[float]
    overshoot: bool
    continuous: bool
    longest: int
    quiet: float
    cutoff: float = np.inf
    enough: float = np.inf
    unfinished_overshoot: bool = False


@dataclass
class _Entry:
    """Last entry into a band: start and duration of the piece, the motion over it, bracket of the entry and level."""

    start: Floats
    duration: Floats
    motion: Floats
    low: Floats
    high: Floats
    level: Floats

    @classmethod
    def empty(cls, n: int) -> _Entry:
        unknown, zero = np.full(n, np.nan), np.zeros(n)
        return cls(unknown, unknown.copy(), np.zeros((DEGREE + 1, n)), zero, zero.copy(), zero.copy())

    def note(self, index: Integers, start: float, piece: Piece, motion: Floats, *bracket: Floats | float) -> None:
        self.start[index], self.duration[index], self.motion[:, index] = start, piece.duration, motion
        self.low[index], self.high[index], self.level[index] = bracket

    def time(self) -> Floats:
        low, high, side = self.low.copy(), self.high.copy(), np.sign(self.level)
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            still = (_at(self.motion, middle) - self.level) * side > 0
            low, high = np.where(still, middle, low), np.where(still, high, middle)
        return self.start + 0.5 * (low + high) * self.duration


@dataclass(frozen=True, eq=False)
class _Course:
    """A piece of the sampling interval: its device state and input from the loop's state, and from the wall's force."""

    piece: Piece
    given: Floats
    given_by_force: Floats


@lru_cache(maxsize=64)
def _interval(loop: DeviceLoop) -> tuple[Floats, Floats, tuple[_Course, ...]]:
    """Return what a sampling interval makes of the loop's state: rows (r, states), and the force's part (r,).

    Rows: sensed position, filtered velocity, the next state, and for each piece the position at its end and the
    velocities at both ends.
    """
    free, push, position, velocity = loop.open_loop
    p, n, sensor = len(loop.device[1]), loop.states, loop.device[2]
    rows, by_force, courses = [position, velocity, *free], [0.0, 0.0, *push], []
    start, start_by_force = np.eye(p, n), np.zeros(p)
    for piece in pieces(loop):
        force = np.zeros(n) if piece.age == 0 else np.eye(n)[n - loop.oldest_force + piece.age - 1]
        given, by = np.vstack([start, force]), np.append(start_by_force, float(piece.age == 0))
        courses.append(_Course(piece, given, by))
        motion = np.column_stack([piece.transition, piece.gain])
        start, start_by_force = motion @ given, motion @ by
        for row in (sensor @ motion, piece.speed[0], piece.speed.sum(axis=0)):
            rows.append(row @ given)
            by_force.append(float(row @ by))
    return np.array(rows), np.array(by_force), tuple(courses)


class Motion:
    """Points of a general loop in motion after a step.

    Parameters
    ----------
    loop : DeviceLoop
    alpha, beta : float64, shape (n,)
    between : bool
        Whether the motion between samples is asked for.
    """

    def __init__(self, loop: DeviceLoop, alpha: Floats, beta: Floats, *, between: bool) -> None:
        self.loop, self.index, self.alpha, self.beta = loop, np.arange(len(alpha)), alpha, beta
        self.rows, self.by_force, courses = _interval(loop)
        self.courses = courses if between else ()
        if not between:
            self.rows, self.by_force = self.rows[: 2 + loop.states], self.by_force[: 2 + loop.states]
        self.driven = np.flatnonzero(self.by_force)
        self.state = np.ascontiguousarray(loop.starts(alpha, "step").T)
        self.scale = _levers(loop, alpha)

    def step(self) -> None:
        """Move by a sampling interval."""
        self.before = self.state
        self.made = self.rows @ self.state
        self.force = -self.alpha * self.made[0] - self.beta * self.made[1]
        for row in self.driven:
            self.made[row] += self.by_force[row] * self.force
        self.state = self.made[2 : 2 + self.loop.states]

    @property
    def sensed(self) -> Floats:
        """Position at the end of the interval."""
        return np.asarray(self.loop.open_loop[2] @ self.state)

    def ends(self, number: int) -> tuple[Floats, Floats, Floats, Floats]:
        """Return positions at the start and end of a piece, and velocities there."""
        first = 2 + self.loop.states + 3 * number
        return self.made[first - 3 if number else 0], *self.made[first : first + 3]

    def given(self, course: _Course, at: Integers) -> Floats:
        """Return the device's state at the start of a piece, and its input, of some points."""
        return np.asarray(course.given @ self.before[:, at] + course.given_by_force[:, None] * self.force[at])

    def size(self) -> Floats:
        """Return all motion as a deviation."""
        return np.asarray((np.abs(self.state[: len(self.scale)]) * self.scale).sum(axis=0))

    def keep(self, mask: Booleans) -> None:
        """Leave out points."""
        for name in ("index", "alpha", "beta"):
            setattr(self, name, getattr(self, name)[mask])
        self.state, self.scale = np.ascontiguousarray(self.state[:, mask]), self.scale[:, mask]

    @property
    def memory(self) -> int:
        """Samples that filter and delay remember."""
        return self.loop.oldest_force + len(self.loop.filter_in_z[0]) + 1


def step_costs(loop: DeviceLoop, alpha: Floats, beta: Floats, asked: Asked) -> dict[str, Floats]:
    """Return settling times and overshoot, named and defined as by `cost.transient.transient_costs`."""
    names = [f"settle_{100 * band:g}pct" for band in asked.bands] + ["overshoot"] * asked.overshoot
    suffixes = ("", "_discrete") if asked.continuous else ("_discrete",)
    result = {name + suffix: np.empty(len(alpha)) for name in names for suffix in suffixes}
    for first in range(0, len(alpha), _TOGETHER):
        part = slice(first, first + _TOGETHER)
        found = _followed(Motion(loop, alpha[part], beta[part], between=asked.continuous), asked)
        for name, values in result.items():
            values[part] = found[name]
    return result


def late_sample(loop: DeviceLoop, alpha: Floats, beta: Floats, first: int, longest: int, faded: float) -> Floats:
    """Return the largest deviation of samples from ``first`` on, until all motion is below a share ``faded`` of it."""
    run, largest, calm = Motion(loop, alpha, beta, between=False), np.zeros(len(alpha)), np.zeros(len(alpha))
    for k in range(1, longest + 1):
        run.step()
        if k < first:
            continue
        largest = np.maximum(largest, np.abs(run.sensed))
        if (k - first) % _BLOCK == _BLOCK - 1:
            calm = np.where(run.size() > faded * largest, 0.0, calm + 1)
            if np.all(calm * _BLOCK > run.memory):
                break
    return largest


def _followed(run: Motion, asked: Asked) -> dict[str, Floats]:
    n = len(run.alpha)
    found = _Found(asked, n)
    quiet, calm = np.zeros(n), np.zeros(n)
    still = _SETTLED * min(asked.bands) if asked.bands else 1.0
    given_up: list[Integers] = []
    for k in range(asked.longest):
        if not len(run.index):
            break
        run.step()
        for number, course in enumerate(run.courses):
            _note(run, number, course, k, found)
        sensed = run.sensed
        size = np.abs(sensed)
        for band in asked.bands:
            found.settled[band][run.index[size > band]] = k + 1
        found.sampled_peak[run.index] = np.maximum(found.sampled_peak[run.index], sensed)
        done = np.zeros(len(run.index), dtype=bool)
        if k > asked.cutoff and not asked.overshoot:
            done |= size > max(asked.bands)
            given_up.append(run.index[done])
        if k % _BLOCK == 0:
            motion, limit = run.size(), np.full(len(run.index), still)
            if asked.overshoot:
                limit = np.minimum(limit, np.maximum(_SETTLED * found.sampled_peak[run.index], asked.quiet))
            quiet = np.where(motion > limit, 0.0, quiet + 1)
            calm = np.where(motion > still, 0.0, calm + 1)
            done |= quiet * _BLOCK > run.memory
            if not asked.bands:
                done |= np.maximum(found.peak, found.sampled_peak)[run.index] > asked.enough
        if done.any():
            run.keep(~done)
            quiet, calm = quiet[~done], calm[~done]
    restless = np.concatenate([run.index[calm * _BLOCK <= run.memory], *given_up]).astype(np.intp)
    return found.costs(restless, np.concatenate([run.index, *given_up]).astype(np.intp))


class _Found:
    """What is known of each point."""

    def __init__(self, asked: Asked, n: int) -> None:
        self.asked = asked
        self.peak, self.sampled_peak = np.zeros(n), np.zeros(n)
        self.settled = {band: np.zeros(n) for band in asked.bands}
        self.entry = {band: _Entry.empty(n) for band in asked.bands}

    def costs(self, restless: Integers, unfinished: Integers) -> dict[str, Floats]:
        result = {}
        for band in self.asked.bands:
            name = f"settle_{100 * band:g}pct"
            result[f"{name}_discrete"] = self.settled[band] + 1
            if self.asked.continuous:
                result[name] = self.entry[band].time()
        for values in result.values():
            values[restless] = np.nan
        if self.asked.overshoot:
            peaks = {"overshoot_discrete": self.sampled_peak, "overshoot": np.maximum(self.peak, self.sampled_peak)}
            if not self.asked.unfinished_overshoot:
                for values in peaks.values():
                    values[unfinished] = np.nan
            result |= peaks
        return result


def _note(run: Motion, number: int, course: _Course, k: int, found: _Found) -> None:
    """Note extrema inside a piece, and entries into the bands."""
    before, after, start_speed, end_speed = run.ends(number)
    piece, size_before, size_after = course.piece, np.abs(before), np.abs(after)
    turned = start_speed * end_speed < 0
    further = piece.duration * np.minimum(np.abs(start_speed), np.abs(end_speed))
    events = turned & (start_speed > 0) & (np.maximum(before, after) + further > found.peak[run.index])
    if not found.asked.overshoot and found.asked.bands:
        events[:] = False
    for band in found.asked.bands:
        # it enters the band, or leaves it for a moment
        out = (size_before > band) | (turned & (np.maximum(size_before, size_after) + further > band))
        events |= (size_after <= band) & out
    at = np.flatnonzero(events)
    if not len(at):
        return
    motion = piece.place @ run.given(course, at)
    turn, extreme = np.ones(len(at)), np.zeros(len(at))
    some = np.flatnonzero(turned[at])
    if len(some):
        turn[some] = _turning(motion[:, some], start_speed[at[some]], end_speed[at[some]])
        extreme[some] = _at(motion[:, some], turn[some])
    which = run.index[at]
    found.peak[which] = np.maximum(found.peak[which], extreme)
    time = k + piece.start
    for band, entry in found.entry.items():
        inside = size_after[at] <= band
        enter = inside & (size_before[at] > band)
        level = np.sign(before[at][enter]) * band
        entry.note(which[enter], time, piece, motion[:, enter], 0.0, turn[enter], level)
        out = inside & (np.abs(extreme) > band)
        entry.note(which[out], time, piece, motion[:, out], turn[out], 1.0, np.sign(extreme[out]) * band)


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
        bend = _at(change, share)
        share = np.minimum(np.maximum(share - _at(speed, share) / np.where(bend == 0, np.inf, bend), 0.0), 1.0)
    return share


def _levers(loop: DeviceLoop, alpha: Floats) -> Floats:
    """Return what each state of the device may do to the position, shape (states, n)."""
    lever = np.maximum(8 * (loop.delay + loop.lag + 1), 2 / np.sqrt(alpha + loop.gamma))
    rows = [np.ones_like(lever), lever]
    if loop.mode is not None:
        near = 1 - loop.mode.far_mass
        turn = np.sqrt(loop.mode.stiffness * (1 / near + 1 / loop.mode.far_mass))
        rows += [np.ones_like(lever), np.minimum(lever, 1 / turn)]
    if loop.lag > 0:
        rows.append(loop.lag * lever)
    return np.array(rows)
