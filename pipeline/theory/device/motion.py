"""Settling time and overshoot of a general loop's step response, from the exact motion between samples.

As `cost.transient`, for devices with more states: all points are advanced sample by sample, and leave as soon as
nothing that is asked for can change any more. A device's motion is small only where all its states are, so that a
beat's silence is not taken for its end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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


class Motion:
    """Points of a general loop in motion after a step.

    Parameters
    ----------
    loop : DeviceLoop
    alpha, beta : float64, shape (n,)
    """

    def __init__(self, loop: DeviceLoop, alpha: Floats, beta: Floats) -> None:
        p = len(loop.device[1])
        start = loop.starts(alpha, "step").T
        self.loop, self.index, self.alpha, self.beta = loop, np.arange(len(alpha)), alpha, beta
        self.b, self.a = loop.filter_in_z
        self.state, self.before = start[:p].copy(), start[p].copy()
        self.filter = np.zeros((len(self.b) - 1, len(alpha)))
        self.forces = [alpha] * (loop.oldest_force + 1)
        self.scale = _levers(loop, alpha)
        self.sensed = self.before

    def push(self) -> None:
        """Sample: the wall's new force."""
        rate = self.sensed - self.before
        velocity = self.b[0] * rate
        if len(self.filter):
            velocity = velocity + self.filter[0]
            later = np.zeros_like(self.filter)
            later[:-1] = self.filter[1:]
            self.filter = later + self.b[1:, None] * rate - self.a[1:, None] * velocity
        self.before = self.sensed
        self.forces = [-self.alpha * self.sensed - self.beta * velocity, *self.forces[:-1]]

    def move(self, piece: Piece) -> None:
        """Move by a piece of the sampling interval."""
        self.state = piece.transition @ self.state + piece.gain[:, None] * self.forces[piece.age]
        self.sensed = self.loop.device[2] @ self.state

    def size(self) -> Floats:
        """Return all motion as a deviation."""
        return np.asarray((np.abs(self.state) * self.scale).sum(axis=0))

    def keep(self, mask: Booleans) -> None:
        """Leave out points."""
        for name in ("index", "alpha", "beta", "before", "sensed"):
            setattr(self, name, getattr(self, name)[mask])
        for name in ("state", "filter", "scale"):
            setattr(self, name, getattr(self, name)[:, mask])
        self.forces = [force[mask] for force in self.forces]

    @property
    def memory(self) -> int:
        """Samples that filter and delay remember."""
        return self.loop.oldest_force + len(self.filter) + 2


def step_costs(loop: DeviceLoop, alpha: Floats, beta: Floats, asked: Asked) -> dict[str, Floats]:
    """Return settling times and overshoot, named and defined as by `cost.transient.transient_costs`."""
    names = [f"settle_{100 * band:g}pct" for band in asked.bands] + ["overshoot"] * asked.overshoot
    suffixes = ("", "_discrete") if asked.continuous else ("_discrete",)
    result = {name + suffix: np.empty(len(alpha)) for name in names for suffix in suffixes}
    for first in range(0, len(alpha), _TOGETHER):
        part = slice(first, first + _TOGETHER)
        found = _followed(Motion(loop, alpha[part], beta[part]), asked)
        for name, values in result.items():
            values[part] = found[name]
    return result


def late_sample(loop: DeviceLoop, alpha: Floats, beta: Floats, first: int, longest: int, faded: float) -> Floats:
    """Return the largest deviation of samples from ``first`` on, until all motion is below a share ``faded`` of it."""
    run, largest, calm = Motion(loop, alpha, beta), np.zeros(len(alpha)), np.zeros(len(alpha))
    for k in range(1, longest + 1):
        run.push()
        for piece in pieces(loop):
            run.move(piece)
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
        run.push()
        for piece in pieces(run.loop):
            _advance(run, piece, k, found)
        size = np.abs(run.sensed)
        for band in asked.bands:
            found.settled[band][run.index[size > band]] = k + 1
        found.sampled_peak[run.index] = np.maximum(found.sampled_peak[run.index], run.sensed)
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


def _advance(run: Motion, piece: Piece, k: int, found: _Found) -> None:
    """Move all points by a piece; note extrema inside it and entries into the bands."""
    if not found.asked.continuous:
        run.move(piece)
        return
    state, force, before = run.state, run.forces[piece.age], run.sensed
    run.move(piece)
    given = np.concatenate([state, force[None]])
    start_speed, end_speed = piece.speed[0] @ given, piece.speed.sum(axis=0) @ given
    size_before, size_after = np.abs(before), np.abs(run.sensed)
    reach = np.maximum(size_before, size_after) + piece.duration * np.minimum(np.abs(start_speed), np.abs(end_speed))
    turned = start_speed * end_speed < 0
    events = turned & (reach > found.peak[run.index]) & (found.asked.overshoot or not found.asked.bands)
    for band in found.asked.bands:
        # it enters the band, or leaves it for a moment
        events |= (size_after <= band) & ((size_before > band) | (turned & (reach > band)))
    at = np.flatnonzero(events)
    if not len(at):
        return
    motion = piece.place @ given[:, at]
    turn = np.where(turned[at], _turning(motion, start_speed[at], end_speed[at]), 1.0)
    extreme = np.where(turned[at], _at(motion, turn), 0.0)
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
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.nan_to_num(start / (start - end), nan=0.5)
        for _ in range(_NEWTON):
            step = np.nan_to_num(_at(speed, share) / _at(change, share), posinf=0.0, neginf=0.0)
            share = np.clip(share - step, 0.0, 1.0)
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
