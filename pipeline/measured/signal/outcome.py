"""What happened in a trial, told from its log alone, with the evidence.

`verdict` says whether the loop is stable; the outcome says what the log shows, and whether it is a response of the
loop at all: a clipped command, a stop, a push or a missing step are no properties of stiffness and damping.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.measured.signal.disturbance import Device, Disturbance, LargestForce, find_disturbance
from pipeline.measured.signal.events import (
    UNMOVED_SAMPLES,
    first_clipped,
    first_stop,
    free_samples,
    left_travel,
    usual_length,
)
from pipeline.measured.signal.modes import FEWEST_SAMPLES
from pipeline.measured.signal.response import NO_ROW, Response
from pipeline.measured.signal.verdict import Verdicts
from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch

BAND = 0.02
"""Half width of the band relative to the final displacement: the settling criterion that the tables use."""

SETTLED_SAMPLES = 5
"""Samples in the band at the end of the log: fewer may be a mere passage, as for the settling cost."""

SPEED_SAMPLES = 4
"""Samples over which a speed is taken: it divides the sensor's noise, and is short against a period."""

CREEP_SAMPLES = (4, 16)
"""As `SPEED_SAMPLES` for a creeping motion, whose speed may be a quantum in many samples."""

STILL_FALLING = 0.995
"""Largest ratio of successive speeds that tells where a creeping motion ends."""

CREEP_FLOORS = 3.0
"""Smallest change over `CREEP_SAMPLES` in sensor floors from which the fall of a speed is told."""

LASTING_CHANGE = 0.1
"""Change of the amplitude over the whole motion, up to which it neither grows nor decays."""

LASTING_RATE = 1e-3
"""As `LASTING_CHANGE`, per sample: a short log would call everything lasting."""

LASTING_RATIO = 0.6
"""Smallest ratio of amplitudes in the last two fifths of the response, up to its inverse, of a limit cycle that the
sensor keeps up: such oscillations are irregular."""

FALLING_RATIO = 0.4
"""As `LASTING_RATIO`, from the last fifth to the third."""

FLAT_RATIO = 0.9
"""As `FALLING_RATIO`, against a slow decay that the modes show."""

CROSSINGS = 4
"""Crossings of the final position in the last three fifths: two periods, fewer show no lasting oscillation."""

REST_FLOORS = 2.0
"""Range of the last fifth, in sensor floors, up to which the device is at rest."""

SENSOR_FLOORS = 20.0
"""Largest range, in sensor floors, of an oscillation that quantum and noise keep up at the stiffest walls."""

CHUNK = 64
"""Trials whose end is looked at together: an array of theirs, 0.5 MB at 1,000 rows, stays in a processor's cache."""


@dataclass(frozen=True, eq=False)
class Outcomes:
    """Outcome of each trial, all of length n.

    Parameters
    ----------
    outcome : array of str
        One of `OUTCOMES`.
    first_row : int64
        First row of the evidence: in the band for good, first clipped, first at the stop or outside the travel,
        first disturbed; -1 where there is none.
    evidence : tuple of str
        One sentence with its numbers in SI units.
    band : float64
        Half width of the band about the final position that was used [m, rad]; NaN where K <= 0.
    amplitude_end : float64
        Half the range of the last fifth of the response [m, rad].
    """

    outcome: np.ndarray[tuple[int, ...], np.dtype[np.str_]]
    first_row: Integers
    evidence: tuple[str, ...]
    band: Floats
    amplitude_end: Floats


@dataclass(frozen=True, eq=False)
class _End:
    """How the response ends, shape (n,) each."""

    entry: Integers
    settled: Booleans
    lasting: Booleans
    rests_elsewhere: Booleans
    offset: Floats
    amplitude: Floats


@dataclass(frozen=True, eq=False)
class _Evidence:
    """What tells an outcome, shape (n,) each, and the sentence on one trial for every outcome."""

    batch: TrialBatch
    response: Response
    growth_per_s: Floats
    unstable: Booleans
    band: Floats
    end: _End
    clipped: Integers
    limit: Floats
    push: Disturbance
    stop: Integers
    left: Integers
    free: Integers
    unmoved: Booleans
    short: Booleans

    def growth(self, i: int) -> str:
        """The growth rate as the end of a sentence; nothing where none is told."""
        rate = self.growth_per_s[i]
        return "" if np.isnan(rate) else f"; {'grows' if rate > 0 else 'decays'} by {abs(rate):.3g} per second"

    def no_step(self, i: int) -> str:
        return self.response.edge_reason[i]

    def travel_limit(self, i: int) -> str:
        row = self.stop[i] if self.stop[i] >= 0 else self.left[i]
        place = f"{self.batch.position[i, row]:.6g}"
        if self.stop[i] >= 0:
            return f"held by a stop at {place}, first in row {row}, reached at speed"
        text = f"the log ends in row {row}, before the others, at {place}, farther out than ever and moving outwards"
        return text + self.growth(i)

    def too_short(self, i: int) -> str:
        samples = self.batch.rows[i] - self.response.edge_row[i]
        return f"{samples} samples from the step on, {self.free[i]} of free motion: {FEWEST_SAMPLES} are needed"

    def saturated(self, i: int) -> str:
        clipped = f"command clipped at {self.limit[i]:.4g} from row {self.clipped[i]} on, against the wall law"
        return clipped + self.growth(i)

    def disturbed(self, i: int) -> str:
        if self.push.first_row[i] >= 0:
            force = f"a force of {self.push.force[i]:.3g} beside the command, first about row {self.push.first_row[i]}"
            return f"{force}; the step is {self.batch.step[i]:.4g}"
        offset = f"rests {self.end.offset[i]:.3g} from x_0 + F_0/K, outside +-{self.band[i]:.3g}"
        return f"{offset}: another force holds it"

    def diverged(self, i: int) -> str:
        return f"grows to an amplitude of {self.end.amplitude[i]:.3g} in the last fifth{self.growth(i)}"

    def limit_cycle(self, i: int) -> str:
        cycle = f"oscillates with an amplitude of {self.end.amplitude[i]:.3g} that lasts, outside +-{self.band[i]:.3g}"
        return cycle + self.growth(i)

    def moving(self, i: int) -> str:
        if np.isnan(self.band[i]):
            return f"no final position with K = {self.batch.stiffness[i]:g}; does not run away{self.growth(i)}"
        return f"not inside +-{self.band[i]:.3g} for good by sample {self.batch.rows[i] - 1}{self.growth(i)}"

    def settled(self, i: int) -> str:
        wide = "" if self.band[i] > self.response.floor[i] else ", which is the sensor floor"
        entry = f"inside +-{self.band[i]:.3g} from sample {self.end.entry[i]} of the log on"
        return f"{entry}{wide}{self.growth(i)}"


def _without_row(holds: Booleans) -> tuple[Booleans, Integers]:
    return holds, np.full(len(holds), NO_ROW)


RULES: dict[str, Callable[[_Evidence], tuple[Booleans, Integers]]] = {
    "no_step": lambda of: _without_row(~of.response.has_edge),
    "travel_limit": lambda of: (np.maximum(of.stop, of.left) >= 0, np.where(of.stop >= 0, of.stop, of.left)),
    "too_short": lambda of: _without_row(of.short),
    "saturated": lambda of: (of.clipped >= 0, of.clipped),
    "disturbed": lambda of: ((of.push.first_row >= 0) | of.end.rests_elsewhere | of.unmoved, of.push.first_row),
    "diverged": lambda of: _without_row(of.unstable & ~of.end.settled & ~of.end.lasting),
    "limit_cycle": lambda of: _without_row(of.end.lasting & ~of.end.settled),
    "moving": lambda of: _without_row(~of.end.settled),
    "settled": lambda of: (of.end.settled, of.end.entry),
}
"""Where each outcome holds, and the first row of its evidence, by precedence: what ends a log or makes it useless comes
before what the loop did in it."""

OUTCOMES = tuple(RULES)


def classify(
    batch: TrialBatch,
    response: Response,
    verdicts: Verdicts,
    *,
    usual_rows: int | None = None,
    device: Device | None = None,
    largest: LargestForce | None = None,
) -> Outcomes:
    """Say of each trial what happened in it.

    Parameters
    ----------
    batch : TrialBatch
        Trials of one experiment: its usual length tells early ends, its device what is a disturbance.
    response, verdicts : Response, Verdicts
        Of the same trials.
    usual_rows, device : int, Device, optional
        `usual_length` of the logs of the experiment, and its device (`find_disturbance`); by default by these trials.
    largest : LargestForce, optional
        `largest_force` of the trials beside that device, where it is known already.

    Returns
    -------
    Outcomes

    Notes
    -----
    The first that holds, in the order of `OUTCOMES`: no identifiable step; ended outside the travel or stood at a
    stop; too few samples of free motion to say anything; command clipped; moved by a force beside the command, or
    at rest elsewhere than at x_0 + F_0/K; growing; an oscillation that lasts outside the band; not yet in the band
    for good; settled. A limit cycle inside the band is settled.

    The band is 2 % of the final displacement, or the sensor floor where that is wider. K <= 0 has no final
    position: such a trial diverged or moves.
    """
    n = len(batch)
    with np.errstate(divide="ignore", invalid="ignore"):
        travel = np.where(batch.stiffness > 0, np.abs(batch.step / batch.stiffness), np.nan)
    band = np.where(batch.stiffness > 0, np.maximum(BAND * travel, response.floor), np.nan)
    push = find_disturbance(batch, response, device, largest)
    free = free_samples(batch, response)
    within = travel <= band
    waiting = batch.rows - response.edge_row <= UNMOVED_SAMPLES
    unmoved = (free == 0) & ~waiting & ~within
    evidence = _Evidence(
        *(batch, response, verdicts.growth_per_s, verdicts.verdict == "unstable", band),
        *(_end(batch, response, verdicts, band), *first_clipped(batch), push, first_stop(batch, response, push)),
        left_travel(batch, response, usual_length(batch.rows) if usual_rows is None else usual_rows),
        *(free, unmoved, (free < FEWEST_SAMPLES) & ~unmoved & ~within),
    )
    holds, rows = (np.stack(each) for each in zip(*(tells(evidence) for tells in RULES.values()), strict=True))
    outcome = np.array(OUTCOMES)[np.argmax(holds, axis=0)]
    return Outcomes(
        outcome=outcome,
        first_row=rows[np.argmax(holds, axis=0), np.arange(n)].astype(np.int64),
        evidence=tuple(getattr(evidence, str(name))(i) for i, name in enumerate(outcome)),
        band=band,
        amplitude_end=evidence.end.amplitude,
    )


def _end(batch: TrialBatch, response: Response, verdicts: Verdicts, band: Floats) -> _End:
    rate, unstable = verdicts.growth_per_s * batch.sampling_period_s, verdicts.verdict == "unstable"
    ends = [
        _end_of(part, response.select(some), rate[some], unstable[some], band[some])
        for some, part in batch.portions(CHUNK)
    ]
    return _End(*(np.concatenate([getattr(end, name) for end in ends]) for name in _End.__dataclass_fields__))


def _end_of(batch: TrialBatch, response: Response, rate: Floats, unstable: Booleans, band: Floats) -> _End:
    column = np.arange(batch.position.shape[1])[None, :]
    edge = np.maximum(response.edge_row, 0)
    after = batch.valid & (column >= edge[:, None])
    final = np.where(np.isnan(band), response.position_start, response.position_final_expected)
    error = np.where(after, batch.position - final[:, None], 0.0)
    width = np.where(np.isnan(band), -1.0, band)[:, None]
    last = np.max(np.where(after & (np.abs(error) > width), column, -1), axis=1, initial=-1)
    entry = np.maximum(last + 1, edge).astype(np.int64)
    long_enough = batch.rows - entry >= SETTLED_SAMPLES
    settled = long_enough & _turns_inside(error, entry, batch.rows, band, response.floor, rate)
    fifth = np.maximum(batch.rows - edge, 1) / 5
    ranges, means = [], []
    for number in (2, 3, 4):
        start = edge + number * fifth
        part = after & (column >= start[:, None]) & (column < (start + fifth)[:, None])
        high = np.max(np.where(part, error, -np.inf), axis=1, initial=-np.inf)
        low = np.min(np.where(part, error, np.inf), axis=1, initial=np.inf)
        ranges.append(np.where(high >= low, high - low, 0.0))
        means.append(np.where(part, error, 0.0).sum(axis=1) / np.maximum(part.sum(axis=1), 1))
    positive = error > 0
    late = column >= (edge + 2 * fifth)[:, None]
    crossings = (late[:, 1:] & after[:, 1:] & (positive[:, 1:] != positive[:, :-1])).sum(axis=1)
    third, fourth, fifth_range = ranges
    with np.errstate(invalid="ignore"):
        decays = (rate < -LASTING_RATE) | (rate * 5 * fifth < -LASTING_CHANGE)
        # growth that the verdict does not tell from noise is none
        grows = (rate > LASTING_RATE) | ((rate * 5 * fifth > LASTING_CHANGE) & unstable)
    steady = ~decays & ~grows & np.isfinite(rate)
    held = np.isnan(rate)
    held &= np.minimum(fourth, fifth_range) >= LASTING_RATIO * np.maximum(fourth, fifth_range)
    held &= np.minimum(third, fifth_range) >= FALLING_RATIO * np.maximum(third, fifth_range)
    # where the modes show a slow decay that the amplitude does not, the decay is that of the first part
    slow = (np.abs(np.nan_to_num(rate)) < LASTING_RATE) & np.isfinite(rate)
    held |= slow & (np.minimum(third, fifth_range) >= FLAT_RATIO * np.maximum(third, fifth_range))
    held &= fifth_range <= SENSOR_FLOORS * response.floor
    swings = (crossings >= CROSSINGS) & (fifth_range > response.floor) & ~np.isnan(band)
    # an oscillation about the edge of the band leaves it now and then; one inside it has settled
    # and a growing one may pass it at its smallest
    settled &= ~(((held & swings) | unstable) & (entry >= edge + 4 * fifth))
    rests = (fifth_range <= REST_FLOORS * response.floor) & (fourth <= REST_FLOORS * response.floor)
    elsewhere = rests & (np.abs(means[2]) > np.nan_to_num(band, nan=np.inf) + response.floor)
    return _End(entry, settled, swings & (steady | held), elsewhere, means[2], 0.5 * fifth_range)


def _turns_inside(
    error: Floats, entry: Integers, rows: Integers, band: Floats, floor: Floats, rate: Floats
) -> Booleans:
    """Whether the motion came to lie within the band, and does not merely pass it.

    In the plane of distance and speed the state must come within a circle of the band's size: there it would turn
    back inside. Speeds are made distances by the largest speed per largest distance of the response. A motion
    inwards has a quarter of a period to decay in before it turns. A creeping motion is inside where its speed falls
    so fast that it ends inside.
    """
    speed = np.zeros_like(error)
    speed[:, SPEED_SAMPLES:] = (error[:, SPEED_SAMPLES:] - error[:, :-SPEED_SAMPLES]) / SPEED_SAMPLES
    inwards, speed = speed * error < 0, np.abs(speed)
    column = np.arange(error.shape[1])[None, :]
    inside = column < rows[:, None]
    # over the edge the error jumps from 0, where it is not defined, to its first value
    moving = np.where(inside & (column >= np.argmax(error != 0, axis=1)[:, None] + SPEED_SAMPLES), speed, 0.0)
    fastest, farthest = moving.max(axis=1, initial=0.0), np.abs(error).max(axis=1, initial=0.0)
    swing = np.divide(farthest, fastest, out=np.zeros(len(error)), where=fastest > 0)
    state = np.hypot(error, moving * swing[:, None])
    decay = np.exp(np.minimum(np.nan_to_num(rate), 0.0) * 0.5 * np.pi * swing)
    state = np.where(inwards, np.maximum(np.abs(error), decay[:, None] * state), state)
    for samples in CREEP_SAMPLES:
        state = np.minimum(state, _limit(error, floor, samples))
    stay = inside & (column >= (entry + SPEED_SAMPLES)[:, None])
    result: Booleans = np.min(np.where(stay, state, np.inf), axis=1, initial=np.inf) <= np.nan_to_num(band, nan=-1.0)
    return result


def _limit(error: Floats, floor: Floats, samples: int) -> Floats:
    """Distance at which a motion would end whose speed falls on as it did last; infinite where it does not fall."""
    step, before = np.zeros_like(error), np.zeros_like(error)
    step[:, samples:] = error[:, samples:] - error[:, :-samples]
    before[:, samples:] = step[:, :-samples]
    falls = (step * before > 0) & (np.abs(step) < STILL_FALLING * np.abs(before))
    falls &= np.abs(step) > CREEP_FLOORS * floor[:, None]
    end = error + np.divide(step * step, before - step, out=np.zeros_like(error), where=falls)
    result: Floats = np.where(falls, np.maximum(np.abs(end), np.abs(error)), np.inf)
    return result
