"""Settling time and overshoot of the loop's step response, from the exact motion between samples.

`device.step_response` computes them; what follows here is for devices whose own motion ends within 1e-7 samples. The
deviation from the final position is advanced sample by sample for all points at once; points leave the computation as
soon as nothing that is asked for can change any more.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.device_loop import general, has_general
from pipeline.loop.loop import Loop, as_points
from pipeline.loop.plant import turning_time
from pipeline.records.batch import Booleans, Floats, Integers
from pipeline.theory.device.step_response import Asked, late_sample, step_costs

LONGEST = 1 << 18
"""Samples after which a response that still moves is given up (no settling time): spectral radius about 1 - 1e-5."""

NO_OVERSHOOT = 1e-12
"""Overshoot up to this fraction counts as none. Part of the definition: Hulin 2017, footnote 4 of 5.2.2."""

_BLOCK = 16
"""Samples between two checks of which points are finished."""

_SETTLED = 0.1
"""A point is finished when its motion has stayed below this share of the band (or of the overshoot found) for a block
and a delay. Motion is position plus velocity times `lever`: from such a state no stable loop with d <= 16 swings out
further than fourfold (largest row sums of the powers of A over the stable region)."""

_FADED = 0.25
"""Motion relative to the largest deviation found below which no larger one follows: the reciprocal of fourfold."""

QUIET = 0.1 * NO_OVERSHOOT
"""Motion below which a response is no longer followed for overshoot, by the same margin."""


Move = tuple[float, float, Floats, Floats, Floats]
"""A segment of the motion: start and duration [samples], the force in it, and position and velocity at its end."""


@dataclass
class Crossing:
    """Last entry into a band: start, length, state and input of the segment in which it happened."""

    start: Floats
    low: Floats
    high: Floats
    position: Floats
    velocity: Floats
    force: Floats
    level: Floats

    @classmethod
    def empty(cls, n: int) -> Crossing:
        """Return crossings of n points, none of them known yet."""
        return cls(*(np.full(n, np.nan) for _ in range(7)))

    def set(self, index: Integers, start: float, low: Floats | float, high: Floats | float, *values: Floats) -> None:
        """Note a crossing of some points; ``values`` are position, velocity, force and level."""
        self.start[index] = start
        self.low[index] = low
        self.high[index] = high
        for name, value in zip(("position", "velocity", "force", "level"), values, strict=True):
            getattr(self, name)[index] = value


@dataclass
class Active:
    """State of the points of a step response that still move."""

    index: Integers
    alpha: Floats
    beta: Floats
    position: Floats
    before: Floats
    velocity: Floats
    lever: Floats
    forces: list[Floats]
    quiet: Floats = field(init=False)
    calm: Floats = field(init=False)
    motion: Floats = field(init=False)

    @classmethod
    def start(cls, loop: Loop, alpha: Floats, beta: Floats) -> Active:
        """Return all points at rest, a final displacement away from their final position."""
        n = len(alpha)
        start, forces = np.full(n, -1.0), [alpha] * (loop.oldest_force + 1)
        return cls(np.arange(n), alpha, beta, start, start, np.zeros(n), lever(loop, alpha), forces)

    def __post_init__(self) -> None:
        self.quiet = np.zeros_like(self.alpha)
        self.calm = np.zeros_like(self.alpha)
        self.motion = np.zeros_like(self.alpha)

    def keep(self, mask: np.ndarray) -> None:
        """Go on with some of the points only."""
        for name in ("index", "alpha", "beta", "position", "before", "velocity", "lever", "quiet", "calm", "motion"):
            setattr(self, name, getattr(self, name)[mask])
        self.forces = [f[mask] for f in self.forces]

    def moves(self, loop: Loop, k: int) -> Iterator[Move]:
        """Move all points from sample k to the next.

        Yields each segment before the points are at its end.
        """
        force = self.beta * self.before - (self.alpha + self.beta) * self.position
        self.forces = [force, *self.forces[:-1]]
        self.before = self.position
        time = float(k)
        for segment, motion in zip(loop.segments, loop.flows, strict=True):
            u = self.forces[segment.age]
            (xx, xv), (vx, vv) = motion.transition
            position = xx * self.position + xv * self.velocity + motion.gain[0] * u
            velocity = vx * self.position + vv * self.velocity + motion.gain[1] * u
            yield time, segment.duration, u, position, velocity
            self.position, self.velocity = position, velocity
            time += segment.duration
        # a burst may last a sample: of the largest since the last look, not of the one at a look
        self.motion = np.maximum(self.motion, np.abs(self.position) + self.lever * np.abs(self.velocity))


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
    return step_costs(general(loop), a, b, asked) if has_general(loop) else _followed(loop, a, b, asked)


def _followed(loop: Loop, a: Floats, b: Floats, asked: Asked) -> dict[str, Floats]:
    """Return the costs of an ideal loop, each point followed until nothing that is asked for can change."""
    n, bands = len(a), asked.bands
    peaks = {"overshoot": np.zeros(n), "overshoot_discrete": np.zeros(n)}
    settled = {band: np.zeros(n) for band in bands}
    crossings = {band: Crossing.empty(n) for band in bands}
    run = Active.start(loop, a, b)
    given_up: list[Integers] = []
    for k in range(asked.longest):
        if not len(run.index):
            break
        for move in run.moves(loop, k):
            if asked.continuous:
                _note(loop, run, move, peaks["overshoot"], crossings)
        size = np.abs(run.position)
        for band in bands:
            settled[band][run.index[size > band]] = k + 1
        peaks["overshoot_discrete"][run.index] = np.maximum(peaks["overshoot_discrete"][run.index], run.position)
        if k > asked.cutoff and not asked.overshoot:
            late = size > max(bands)
            if late.any():
                given_up.append(run.index[late])
                run.keep(~late)
        if k % _BLOCK == 0:
            done = _are_done(loop, run, asked, peaks)
            if done.any():
                run.keep(~done)
    result: dict[str, Floats] = {}
    for band in bands:
        name = f"settle_{100 * band:g}pct"
        result[f"{name}_discrete"] = settled[band] + 1
        if asked.continuous:
            result[name] = entry_times(loop, crossings[band])
    if asked.overshoot:
        result["overshoot_discrete"] = peaks["overshoot_discrete"]
        if asked.continuous:
            result["overshoot"] = np.maximum(peaks["overshoot"], peaks["overshoot_discrete"])
    # a slow response may have settled long before it is known not to overshoot
    restless = np.concatenate([run.index[run.calm * _BLOCK <= loop.oldest_force + 2], *given_up])
    unfinished = np.concatenate([run.index, *given_up])
    for name, values in result.items():
        if name.startswith("settle"):
            values[restless] = np.nan
        elif not asked.unfinished_overshoot:
            values[unfinished] = np.nan
    return result


def _are_done(loop: Loop, run: Active, asked: Asked, peaks: dict[str, Floats]) -> Booleans:
    """Count the blocks for which points have hardly moved, and return which need no longer be followed."""
    calm = _SETTLED * min(asked.bands) if asked.bands else 1.0
    limit = np.full(len(run.index), calm)
    if asked.overshoot:
        limit = np.minimum(limit, np.maximum(_SETTLED * peaks["overshoot_discrete"][run.index], asked.quiet))
    run.quiet = np.where(run.motion > limit, 0.0, run.quiet + 1)
    run.calm = np.where(run.motion > calm, 0.0, run.calm + 1)
    run.motion[:] = 0.0
    # small at one check may be a moment between two motions: what is on its way has acted by the next
    done: Booleans = (run.quiet - 1) * _BLOCK > loop.oldest_force + 2
    if not asked.bands:
        done |= np.maximum(peaks["overshoot"], peaks["overshoot_discrete"])[run.index] > asked.enough
    return done


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
    if has_general(loop):
        return late_sample(general(loop), a, b, first, longest, _FADED)
    run = Active.start(loop, a, b)
    largest = np.zeros(len(a))
    for k in range(1, longest + 1):
        for _ in run.moves(loop, k - 1):
            pass
        if k < first:
            continue
        largest = np.maximum(largest, np.abs(run.position))
        if (k - first) % _BLOCK == _BLOCK - 1:
            run.quiet = np.where(run.motion > _FADED * largest, 0.0, run.quiet + 1)
            run.motion[:] = 0.0
            if np.all((run.quiet - 1) * _BLOCK > loop.oldest_force + 2):
                break
    return largest


def lever(loop: Loop, alpha: Floats) -> Floats:
    """Samples for which a velocity may carry on before the wall turns it: the delay, or an eighth of an oscillation."""
    return np.maximum(8 * (loop.delay + 1), 2 / np.sqrt(alpha + loop.gamma))


def _note(
    loop: Loop,
    run: Active,
    move: Move,
    peak: Floats,
    crossings: dict[float, Crossing],
) -> None:
    """Note extrema in a segment and entries into the bands."""
    start, duration, force, position, velocity = move
    turn = np.flatnonzero(run.velocity * velocity < 0)
    e, v, u = run.position[turn], run.velocity[turn], force[turn]
    when = turning_time(loop.gamma, loop.delta, e, v, u, duration)
    extreme = loop.position_after(when, e, v, u)
    which = run.index[turn]
    peak[which] = np.maximum(peak[which], extreme)
    size_before, size_after = np.abs(run.position), np.abs(position)
    turned = np.full(len(size_before), np.nan)
    turned[turn] = when
    for band, crossing in crossings.items():
        inside = size_after <= band
        enter = np.flatnonzero(inside & (size_before > band))
        if len(enter):
            # an extremum inside the band follows the entry; one outside it is met below
            high = np.where(np.isnan(turned[enter]), duration, turned[enter])
            at = run.position[enter]
            crossing.set(run.index[enter], start, 0.0, high, at, run.velocity[enter], force[enter], np.sign(at) * band)
        peaked = np.abs(extreme) > band
        out = turn[peaked & inside[turn]]
        if len(out):
            crossing.set(
                *(run.index[out], start, turned[out], duration, run.position[out], run.velocity[out]),
                *(force[out], np.sign(extreme[peaked & inside[turn]]) * band),
            )


def entry_times(loop: Loop, crossing: Crossing) -> Floats:
    """Time of entry into the band: root of a monotone motion, by bisection to the last bit."""
    low, high = np.nan_to_num(crossing.low), np.nan_to_num(crossing.high)
    outside = np.sign(crossing.level)
    for _ in range(54):  # halves an interval of one sample to below 1e-16
        middle = 0.5 * (low + high)
        excess = loop.position_after(middle, crossing.position, crossing.velocity, crossing.force) - crossing.level
        still = excess * outside > 0
        low, high = np.where(still, middle, low), np.where(still, high, middle)
    return crossing.start + 0.5 * (low + high)  # NaN where the band was never entered
