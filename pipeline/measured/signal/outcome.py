"""What happened in a trial, told from its log alone, with the evidence.

`verdict` says whether the loop is stable; the outcome says what the log shows, and whether it is a response of the
loop at all: a clipped command, a stop, a push or a missing step are no properties of stiffness and damping.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.measured.signal.disturbance import Disturbance, PushResponse, find_disturbance
from pipeline.measured.signal.events import (
    UNMOVED_SAMPLES,
    first_clipped,
    first_stop,
    free_samples,
    left_travel,
)
from pipeline.measured.signal.modes import FEWEST_SAMPLES
from pipeline.measured.signal.response import NO_ROW, SETTLED_SAMPLES, Response, reach
from pipeline.measured.signal.sensor import AT_REST, NOISE_FACTOR
from pipeline.measured.signal.verdict import REST_FLOORS, Verdicts
from pipeline.measured.student import NORMAL_95
from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch
from pipeline.records.criteria import SETTLING_BANDS

BAND = SETTLING_BANDS["settle_2pct"]
"""Half width of the band relative to the final displacement: the settling criterion that the tables use."""

LASTING = 0.8
"""Smallest ratio of amplitudes of the last and the third fifth of the response, up to its inverse, of an oscillation
that lasts: those that a sensor keeps up are irregular."""

LASTING_CHANGE = 0.1
"""Change of its amplitude over the response by the growth rate of the verdict, up to which it lasts."""

CROSSINGS = 4
"""Crossings of the final position in the last three fifths: two periods, fewer show no lasting oscillation."""


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
    usual_rows: int,
    device: PushResponse,
) -> Outcomes:
    """Say of each trial what happened in it.

    Parameters
    ----------
    batch : TrialBatch
        Trials of one experiment: its usual length tells early ends, its device what is a disturbance.
    response, verdicts : Response, Verdicts
        Of the same trials.
    usual_rows, device : int, PushResponse
        `usual_length` of the logs of the experiment, and its device (`fit_push_response`).

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
    parts = [
        _classified(part, response.select(some), verdicts.select(some), usual_rows, device)
        for some, part in batch.portions()
    ]
    arrays = ("outcome", "first_row", "band", "amplitude_end")
    joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in arrays}
    return Outcomes(**joined, evidence=tuple(text for part in parts for text in part.evidence))


def _classified(
    batch: TrialBatch, response: Response, verdicts: Verdicts, usual: int, device: PushResponse
) -> Outcomes:
    with np.errstate(divide="ignore", invalid="ignore"):
        stepped = (batch.stiffness > 0) & (batch.step != 0)
        travel = np.where(stepped, np.abs(batch.step / batch.stiffness), np.nan)
    band = np.where(stepped, np.maximum(BAND * travel, response.floor), np.nan)
    push, unstable = find_disturbance(batch, response, device), verdicts.verdict == "unstable"
    free = free_samples(batch, response)
    within = travel <= band
    waiting = batch.rows - response.edge_row <= UNMOVED_SAMPLES
    unmoved = (free == 0) & ~waiting & ~within
    evidence = _Evidence(
        *(batch, response, verdicts.growth_per_s, unstable, band, _end(batch, response, verdicts, band)),
        *(*first_clipped(batch), push, first_stop(batch, response, push, device), left_travel(batch, response, usual)),
        *(free, unmoved, (free < FEWEST_SAMPLES) & ~unmoved & ~within),
    )
    holds, rows = (np.stack(each) for each in zip(*(tells(evidence) for tells in RULES.values()), strict=True))
    which = np.argmax(holds, axis=0)
    outcome = np.array(OUTCOMES)[which]
    return Outcomes(
        outcome=outcome,
        first_row=rows[which, np.arange(len(batch))].astype(np.int64),
        evidence=tuple(getattr(evidence, str(name))(i) for i, name in enumerate(outcome)),
        band=band,
        amplitude_end=evidence.end.amplitude,
    )


def _end(batch: TrialBatch, response: Response, verdicts: Verdicts, band: Floats) -> _End:
    column = np.arange(batch.position.shape[1])[None, :]
    edge = np.maximum(response.edge_row, 0)
    after = batch.valid & (column >= edge[:, None])
    final = np.where(np.isnan(band), response.position_start, response.position_final_expected)
    error = np.where(after, batch.position - final[:, None], 0.0)
    width = np.where(np.isnan(band), -1.0, band)
    last = np.max(np.where(after & (np.abs(error) > width[:, None]), column, -1), axis=1, initial=-1)
    entry = np.maximum(last + 1, edge).astype(np.int64)
    far, open_ = reach(
        *(batch, final, edge, entry, verdicts.growth_per_s * batch.sampling_period_s, response.floor / NOISE_FACTOR)
    )
    settled = (batch.rows - entry >= SETTLED_SAMPLES) & (far <= width + NORMAL_95 * open_)
    fifth = np.maximum(batch.rows - edge, 1) / 5
    ranges, means = [], []
    for number in (2, 3, 4):
        start = edge + number * fifth
        part = after & (column >= start[:, None]) & (column < (start + fifth)[:, None])
        high = np.max(np.where(part, error, -np.inf), axis=1, initial=-np.inf)
        low = np.min(np.where(part, error, np.inf), axis=1, initial=np.inf)
        ranges.append(np.where(high >= low, high - low, 0.0))
        means.append(np.where(part, error, 0.0).sum(axis=1) / np.maximum(part.sum(axis=1), 1))
    third, fourth, fifth_range = ranges
    late = after[:, 1:] & (column[:, 1:] >= (edge + 2 * fifth)[:, None])
    crossings = (late & ((error[:, 1:] > 0) != (error[:, :-1] > 0))).sum(axis=1)
    lasting = (crossings >= CROSSINGS) & (fifth_range > response.floor) & ~np.isnan(band)
    lasting &= np.minimum(third, fifth_range) >= LASTING * np.maximum(third, fifth_range)
    # above what quanta keep up, a rate that the verdict tells is surer than ratios of amplitudes
    told = (verdicts.verdict != "undecided") & (fifth_range > 2 * REST_FLOORS * response.floor)
    change = np.abs(verdicts.growth_per_s) * batch.sampling_period_s * (batch.rows - edge)
    lasting &= ~(told & (change > LASTING_CHANGE))
    # an oscillation about the edge of the band leaves it now and then, and a growing one may pass it at its smallest
    settled &= ~((lasting | (verdicts.verdict == "unstable")) & (entry >= edge + 4 * fifth))
    rests = np.maximum(fourth, fifth_range) <= AT_REST * response.floor
    elsewhere = rests & (np.abs(means[2]) > np.nan_to_num(band, nan=np.inf) + response.floor)
    return _End(entry, settled, lasting, elsewhere, means[2], 0.5 * fifth_range)
