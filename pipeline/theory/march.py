"""Settling time and overshoot of very many points: the motion of `transient` in blocks that fit the cache.

Points go in chunks through a buffer of samples; the forces of d + 1 samples are known at once, and what is read from
the motion (last sample outside the band, extrema between samples) is read from whole buffers. When all but three
modes have died out, the envelope of these bounds the settling time from above; the march goes on only in front of
that bound, however far away it is, and it ends where no later extremum can exceed the overshoot found. Integer delays
only.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pipeline.loop.loop import Loop
from pipeline.loop.plant import turning_time
from pipeline.records.batch import Booleans, Floats, Integers
from pipeline.theory.ahead import envelope_end, excess, untouched
from pipeline.theory.slowmodes import SlowModes, slow_modes, velocity_factor

_CHUNK = 2048
"""Points at a time: three buffers of some 20 samples then stay in a cache of 1 MiB."""

_ROWS = 16
"""Least samples in a buffer."""

_FIRST = 80
"""Least samples before modes are looked for; then again after each doubling."""

_TURNS = 24
"""The same in units of d + 1: by then all but three modes of a double integrator's loop have usually died out."""

_NEAR = 4
"""Buffers for which a chunk is followed on its own before all that is left goes on together."""

_WIDER = 4.0
"""Growth of the window in front of the end where nothing outside the band was met in it."""

_HALF_TURNS = 1.2
"""Length of that window in half turns of the mode that is largest at the end."""

_BEFORE = 8.0
"""Samples before a later overshoot at which the march goes on."""

_SETTLED = 0.1
"""As in `pipeline.theory.transient`: finished below this share of the band or of the overshoot found."""


@dataclass
class _Crossing:
    """Last entry into a band: start, length, state and input of the segment in which it happened."""

    start: Floats
    low: Floats
    high: Floats
    position: Floats
    velocity: Floats
    force: Floats
    level: Floats

    @classmethod
    def empty(cls, n: int) -> _Crossing:
        """Return crossings of n points, none of them known yet."""
        return cls(*(np.full(n, np.nan) for _ in range(7)))


@dataclass
class _Found:
    """What is known of each point."""

    settled: Floats
    peak: Floats
    sampled_peak: Floats
    crossing: _Crossing
    unfinished: list[Integers] = field(default_factory=list)


def step_transients(
    loop: Loop, alpha: Floats, beta: Floats, band: float, *, longest: int, quiet: float
) -> dict[str, Floats]:
    """Return settling time and overshoot of stable points, continuous and sampled.

    Parameters
    ----------
    loop : Loop
        With an integer delay.
    alpha, beta : float64, shape (n,)
        Stable points with alpha + gamma > 0.
    band, longest, quiet
        As of `transient.transient_costs`.

    Returns
    -------
    dict of float64, shape (n,)
        ``settle``, ``settle_discrete``, ``overshoot``, ``overshoot_discrete``; NaN where the response still moves after
        ``longest`` samples.

    Source: Hulin 2017, eqs. 5.10 to 5.12.
    """
    n = len(alpha)
    found = _Found(np.zeros(n), np.zeros(n), np.zeros(n), _Crossing.empty(n))
    motion = _Motion(loop, band, quiet)
    rest: list[Buffer] = []
    ahead: list[Buffer] = []
    jumps: list[_Jump] = []
    for i in range(0, n, _CHUNK):
        index = np.arange(i, min(i + _CHUNK, n))
        at = motion.run(motion.start(index, alpha[index], beta[index]), found, motion.first)
        at, near = motion.look_ahead(at, found, jumps)
        rest.append(at)
        ahead += [motion.run(buffer, found, _NEAR * motion.rows) for buffer in near]
    at, count = joined(rest), motion.first
    while len(at.index) and count < longest:  # ends: the count grows by half each round
        more = max(motion.first, count // 2)
        at = motion.run(at, found, more)
        count += more
        at, near = motion.look_ahead(at, found, jumps)
        ahead += near
    unfinished = at.index
    if ahead:
        motion.run(joined(ahead), found, longest)
    if jumps:
        motion.mend(_joined_jumps(jumps), found, longest)
    found.peak = np.maximum(found.peak, found.sampled_peak)
    result = {
        "settle_discrete": found.settled + 1,
        "settle": _parabolic_entries(found.crossing) if motion.parabolic else _entry_times(loop, found.crossing),
        "overshoot_discrete": found.sampled_peak,
        "overshoot": found.peak,
    }
    for values in result.values():
        values[unfinished] = np.nan
    return result


@dataclass
class _Jump:
    """Points whose samples up to shortly before ``end`` were left out."""

    before: Buffer
    modes: SlowModes
    end: Floats
    window: Floats

    def keep(self, mask: Booleans) -> _Jump:
        return _Jump(self.before.keep(mask), self.modes.part(mask), self.end[mask], self.window[mask])


def _joined_jumps(jumps: list[_Jump]) -> _Jump:
    parts = [jump.modes for jump in jumps]
    modes = SlowModes(
        np.concatenate([m.pole for m in parts], axis=1),
        np.concatenate([m.amplitude for m in parts], axis=1),
        np.concatenate([m.good for m in parts]),
    )
    ends, windows = (np.concatenate([getattr(jump, name) for jump in jumps]) for name in ("end", "window"))
    return _Jump(joined([jump.before for jump in jumps]), modes, ends, windows)


def _lever(loop: Loop, alpha: Floats) -> Floats:
    """Samples for which a velocity may carry on before the wall turns it: the delay, or an eighth of an oscillation."""
    return np.maximum(8 * (loop.delay + 1), 2 / np.sqrt(alpha + loop.gamma))


def _entry_times(loop: Loop, crossing: _Crossing) -> Floats:
    """Time of entry into the band: root of a monotone motion, by bisection to the last bit."""
    low, high = np.nan_to_num(crossing.low), np.nan_to_num(crossing.high)
    outside = np.sign(crossing.level)
    for _ in range(54):  # halves an interval of one sample to below 1e-16
        middle = 0.5 * (low + high)
        excess = loop.position_after(middle, crossing.position, crossing.velocity, crossing.force) - crossing.level
        still = excess * outside > 0
        low, high = np.where(still, middle, low), np.where(still, high, middle)
    return crossing.start + 0.5 * (low + high)  # NaN where the band was never entered


def _parabolic_entries(crossing: _Crossing) -> Floats:
    """Time of entry into the band of a double integrator: the root of a parabola at which it moves inwards."""
    v, u = crossing.velocity, crossing.force
    above = crossing.position - crossing.level
    speed = -np.sign(crossing.level) * np.sqrt(np.maximum(v * v - 2 * u * above, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        # two forms of one root, each where it does not cancel
        time = np.where(v * speed > 0, -2 * above / (v + speed), (speed - v) / u)
    return np.asarray(crossing.start + np.clip(time, crossing.low, crossing.high))


class _Motion:
    """The loop's constants, and the march."""

    def __init__(self, loop: Loop, band: float, quiet: float) -> None:
        self.loop, self.band, self.quiet = loop, band, quiet
        self.batch = int(loop.delay) + 1
        self.parabolic = loop.gamma == 0 and loop.delta == 0
        self.rows = self.batch * max(6, -(-_ROWS // self.batch))  # enough for `slow_modes`
        self.history = self.batch
        self.first = max(_FIRST, _TURNS * self.batch)
        motion = loop.period
        (self.xx, self.xv), (self.vx, self.vv) = motion.transition.tolist()
        self.gx, self.gv = motion.gain.tolist()
        self.steps = np.arange(1, self.rows + 2, dtype=np.uint8 if self.rows < 255 else np.uint16)[:, None]

    def start(self, index: Integers, alpha: Floats, beta: Floats) -> Buffer:
        n = len(index)
        position = np.empty((self.history + self.rows + 1, n))
        velocity, push = np.empty((self.rows + 1, n)), np.empty((self.rows, n))
        position[-self.history - 1 :] = -1.0  # `run` begins with the end of the buffer before
        velocity[-1] = 0.0
        sample, stop = np.zeros(n), np.full(n, np.inf)
        return Buffer(index, alpha, beta, _lever(self.loop, alpha), position, velocity, push, sample, stop)

    def run(self, at: Buffer, found: _Found, samples: int) -> Buffer:
        """March on by at least so many samples; return the points that still move."""
        for k in range(0, samples, self.rows):
            if not len(at.index):
                break
            at.position[: self.history + 1] = at.position[-self.history - 1 :]
            at.velocity[0] = at.velocity[-1]
            self._fill(at)
            done = self._read(at, found)
            at.sample += self.rows
            done |= at.sample >= at.stop
            if done.sum() > 0.1 * len(done) or (done.any() and k + self.rows >= samples):
                at = at.keep(~done, whole=True)
        return at

    def look_ahead(self, at: Buffer, found: _Found, jumps: list[_Jump]) -> tuple[Buffer, list[Buffer]]:
        """Move points whose motion is known by its modes to where they settle; return the others, and these."""
        if not len(at.index):
            return at, []
        modes = slow_modes(self.loop, at.alpha, at.beta, at.position)
        beyond = excess(self.loop, at.alpha, at.beta, np.where(modes.good, modes.pole, 0.5))
        size = np.abs(modes.amplitude) * (1 + beyond)
        rate = -np.log(np.abs(modes.pole), where=modes.good, out=np.ones_like(size))
        # a later sample may exceed the samples so far where nothing exceeds the motion between them
        peaks = (np.maximum(values[at.index], self.quiet) for values in (found.peak, found.sampled_peak))
        free = np.minimum.reduce([untouched(modes, size, rate, beyond, peak) for peak in peaks])
        free = np.where(modes.good, free, 0.0)
        known = free > 0
        end = np.where(known, envelope_end(np.where(known, size, 0.0), rate, self.band), 0.0)
        known &= free > end + self.rows
        end[~known] = 0
        lead = np.argmax(size * np.exp(-rate * end), axis=0)[None]
        angle = np.abs(np.angle(np.take_along_axis(modes.pole, lead, 0)[0]))
        slack = np.log1p(np.take_along_axis(beyond, lead, 0)[0]) / np.take_along_axis(rate, lead, 0)[0]
        window = 8 + 1.1 * slack + _HALF_TURNS * np.pi / np.maximum(angle, 1e-3) * (angle > 0)
        end[end > 0] += 1
        later = known & np.isfinite(free)
        behind = self._ahead(_Jump(at.keep(later), modes.part(later), free[later], np.full(later.sum(), _BEFORE)))
        at.stop[known] = at.sample[known] + end[known]
        far = known & (end - window > self.history)
        near = [at.keep(known & ~far & (end > 0))]
        if far.any():
            jump = _Jump(at.keep(far), modes.part(far), end[far], window[far])
            jumps.append(jump)
            near.append(self._ahead(jump))
        return joined([at.keep(~known), behind]), near

    def mend(self, jump: _Jump, found: _Found, longest: int) -> None:
        """Start earlier where the march met no sample outside the band.

        Ends after log4(end/8) rounds, 30 for any double: the window grows fourfold and then reaches the jump's start.
        """
        while True:
            skipped = self._skipped(jump)
            jump = jump.keep((skipped > 0) & (found.settled[jump.before.index] < jump.before.sample + skipped))
            if not len(jump.end):
                return
            jump.window *= _WIDER
            self.run(self._ahead(jump), found, longest)

    def _skipped(self, jump: _Jump) -> Floats:
        """Return the samples left out; none where the window reaches back to the samples that are known."""
        ahead = np.floor(jump.end - jump.window)
        return np.where(ahead > self.history, ahead, 0.0)

    def _ahead(self, jump: _Jump) -> Buffer:
        """Return the points one window before their end, or as they are where that is earlier."""
        ahead = self._skipped(jump)
        far = ahead > 0
        at = jump.before.keep(np.ones_like(far))
        moved = jump.before.keep(far)
        self._jump(moved, jump.modes.part(far), ahead[far])
        for name in ("position", "velocity", "sample"):
            getattr(at, name)[..., far] = getattr(moved, name)
        return at

    def _jump(self, at: Buffer, modes: SlowModes, jump: Floats) -> None:
        """Set the end of the buffers to the modes' motion some samples later."""
        with np.errstate(divide="ignore", invalid="ignore"):
            moved = np.where(modes.amplitude == 0, 0, modes.amplitude * np.exp(jump * np.log(modes.pole)))
            factor = velocity_factor(self.loop, at.alpha, at.beta, modes.pole)
        at.velocity[-1] = np.where(moved == 0, 0, moved * factor).sum(axis=0).real
        for j in range(self.history + 1):
            at.position[-1 - j] = moved.sum(axis=0).real
            moved = moved / modes.pole
        at.sample += jump

    def _fill(self, at: Buffer) -> None:
        h, d = self.history, self.batch - 1
        e, v, push = at.position, at.velocity, at.push
        minus_alpha, minus_beta = -at.alpha, -at.beta
        kick = np.empty((self.batch, len(at.index)))
        scaled = np.empty_like(kick)
        spare = np.empty_like(at.alpha)
        for j in range(0, self.rows, self.batch):
            now, u = e[h + j - d : h + j + 1], push[j : j + self.batch]
            np.subtract(now, e[h + j - d - 1 : h + j], out=kick)
            kick *= minus_beta
            np.multiply(now, minus_alpha, out=u)
            u += kick
            np.multiply(u, self.gx, out=scaled)
            np.multiply(u, self.gv, out=kick)
            for i in range(self.batch):
                row, target, speed, faster = e[h + j + i], e[h + j + i + 1], v[j + i], v[j + i + 1]
                if self.xv == 1:
                    np.add(row, speed, out=target)
                else:
                    np.multiply(speed, self.xv, out=target)
                    target += np.multiply(row, self.xx, out=spare)
                target += scaled[i]
                if self.vv == 1 and self.vx == 0:
                    np.add(speed, kick[i], out=faster)
                else:
                    np.multiply(speed, self.vv, out=faster)
                    faster += np.multiply(row, self.vx, out=spare)
                    faster += kick[i]

    def _read(self, at: Buffer, found: _Found) -> Booleans:
        """Note what the new samples tell; return which points are finished."""
        e, v = at.position[self.history :], at.velocity
        size = np.abs(e)
        outside = size > self.band
        last = np.multiply(outside.view(np.uint8), self.steps).max(axis=0)
        some = last > 0
        known = found.settled[at.index]
        found.settled[at.index] = np.where(some, at.sample - 1 + last, known)
        sampled = np.maximum(e.max(axis=0), found.sampled_peak[at.index])
        found.sampled_peak[at.index] = sampled
        entered = np.flatnonzero(some & (last <= self.rows))
        row = last[entered].astype(np.intp) - 1
        self._note(at, found.crossing, row, entered, np.sign(e[row, entered]), after_turn=False)
        forward = v > 0
        turns = np.flatnonzero(forward[1:] != forward[:-1])
        if len(turns):
            self._extrema(at, found, turns, outside, last)
        largest = size.max(axis=0)
        limit = np.minimum(_SETTLED * self.band, np.maximum(_SETTLED * sampled, self.quiet))
        return np.asarray(largest + at.lever * np.abs(v[-1]) <= limit)

    def _extrema(self, at: Buffer, found: _Found, turns: Integers, outside: Booleans, last: Integers) -> None:
        n = len(at.index)
        row, point = turns // n, turns % n
        e, v, u = at.position[self.history :].ravel()[turns], at.velocity.ravel()[turns], at.push.ravel()[turns]
        if self.parabolic:
            with np.errstate(divide="ignore", invalid="ignore"):
                extreme = e - np.where(u == 0, 0.0, 0.5 * v * v / u)
        else:
            when = turning_time(self.loop.gamma, self.loop.delta, e, v, u, 1.0)
            extreme = self.loop.position_after(when, e, v, u)
        higher = np.flatnonzero(extreme > found.peak[at.index[point]])
        np.maximum.at(found.peak, at.index[point[higher]], extreme[higher])
        out = np.flatnonzero((np.abs(extreme) > self.band) & ~outside.ravel()[turns + n] & (row + 1 >= last[point]))
        if len(out):
            self._note(at, found.crossing, row[out], point[out], np.sign(extreme[out]), after_turn=True)

    def _note(
        self,
        at: Buffer,
        crossing: _Crossing,
        row: Integers,
        point: Integers,
        side: Floats,
        after_turn: bool,
    ) -> None:
        """Note entries into the band during the sampling intervals ``row``."""
        e, v, u = at.position[self.history + row, point], at.velocity[row, point], at.push[row, point]
        turned = v * at.velocity[row + 1, point] < 0
        when = np.where(turned, turning_time(self.loop.gamma, self.loop.delta, e, v, u, 1.0), 1.0)
        index = at.index[point]
        low, high = (when, np.ones_like(when)) if after_turn else (np.zeros_like(when), when)
        crossing.start[index] = at.sample[point] + row
        for name, values in zip(
            ("low", "high", "position", "velocity", "force", "level"),
            (low, high, e, v, u, side * self.band),
            strict=True,
        ):
            getattr(crossing, name)[index] = values


@dataclass
class Buffer:
    """Samples of the points that still move: row j of ``position`` is sample k + j - history."""

    index: Integers
    alpha: Floats
    beta: Floats
    lever: Floats
    position: Floats
    velocity: Floats
    push: Floats
    sample: Floats
    """Number of the sample in the row after the history, before the next round."""
    stop: Floats
    """Sample from which on the response surely stays inside the band; infinity where that is not known."""

    def keep(self, mask: Booleans, whole: bool = False) -> Buffer:
        """Return some of the points; of the samples only those that `_Motion.run` goes on from, or all positions."""
        return _collected([self], [mask], whole)


def _collected(buffers: list[Buffer], masks: list[Booleans], whole: bool = False) -> Buffer:
    counts = [int(mask.sum()) for mask in masks]
    places = np.cumsum([0, *counts])
    shapes = {name: getattr(buffers[0], name).shape[:-1] for name in Buffer.__dataclass_fields__}
    result = Buffer(
        *(
            np.empty((*shapes[name], places[-1]), getattr(buffers[0], name).dtype)
            for name in Buffer.__dataclass_fields__
        )
    )
    rows = len(result.position)
    kept = {"position": rows if whole else rows - len(result.push), "velocity": 1, "push": 0}
    for buffer, mask, i, j in zip(buffers, masks, places[:-1], places[1:], strict=True):
        for name in Buffer.__dataclass_fields__:
            values, into = getattr(buffer, name), getattr(result, name)
            first = len(values) - kept[name] if name in kept else 0
            if values.ndim == 2:
                into[first:, i:j] = values[first:, mask]
            else:
                into[i:j] = values[mask]
    return result


def joined(buffers: list[Buffer]) -> Buffer:
    """Return the points of several buffers in one."""
    return _collected(buffers, [np.ones(len(buffer.index), np.bool_) for buffer in buffers])
