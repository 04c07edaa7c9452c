"""Determine the outcome of a trial with its evidence, only from the log.

`verdict` states whether the loop is stable. The outcome states what the log shows, and whether the log is a response of
the loop. A clipped command, a stop, a push or a missing step is not an effect of stiffness and damping.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.measured.signal.disturbance import Disturbance, PushResponse, find_disturbance
from pipeline.measured.signal.log_events import (
    UNMOVED_SAMPLES,
    first_clipped,
    first_stop,
    free_samples,
    left_travel,
)
from pipeline.measured.signal.modes import FEWEST_SAMPLES
from pipeline.measured.signal.response import NO_ROW, SETTLED_SAMPLES, Response, reach
from pipeline.measured.signal.sensor import AT_REST, NOISE_FACTOR
from pipeline.measured.signal.verdict import REST_FLOORS, Verdict
from pipeline.measured.student import NORMAL_95
from pipeline.records.criteria import SETTLING_BANDS
from pipeline.records.stage_records import OutcomeRow
from pipeline.records.trials import Trial

BAND = SETTLING_BANDS["settle_2pct"]
"""Half-width of the band relative to the final displacement, for the settling criterion that the tables use."""

LASTING = 0.8
"""Smallest ratio between the amplitudes in the third and the last fifth of a response for a sustained oscillation.
Oscillations that a sensor sustains are irregular."""

LASTING_CHANGE = 0.1
"""Largest change of the amplitude over the response for a sustained oscillation, from the growth rate of the
verdict."""

CROSSINGS = 4
"""Smallest number of crossings of the final position in the last three fifths of a sustained oscillation, i.e. two
periods."""


@dataclass(frozen=True)
class _End:
    """Properties of the end of a response."""

    entry: int
    settled: bool
    lasting: bool
    rests_elsewhere: bool
    offset: float
    amplitude: float


@dataclass(frozen=True)
class _Evidence:
    """Evidence for the outcome of a trial. It has a method for each outcome, which returns the explaining sentence."""

    trial: Trial
    response: Response
    verdict: Verdict
    band: float
    end: _End
    clipped: int
    limit: float
    push: Disturbance
    stop: int
    left: int
    free: int
    unmoved: bool
    short: bool

    def growth(self) -> str:
        """Return the growth rate as the end of a sentence. The text is empty if the rate is unknown."""
        rate = self.verdict.growth_per_s
        return "" if np.isnan(rate) else f"; {'grows' if rate > 0 else 'decays'} by {abs(rate):.3g} per second"

    def no_step(self) -> str:
        return self.response.edge_reason

    def travel_limit(self) -> str:
        row = self.stop if self.stop >= 0 else self.left
        place = f"{self.trial.position[row]:.6g}"
        if self.stop >= 0:
            return f"the device stops abruptly at {place}, first in row {row}"
        text = f"the log ends earlier than the others, in row {row}, while the device moves outwards at {place}"
        return text + self.growth()

    def too_short(self) -> str:
        samples = self.trial.rows - self.response.edge_row
        return (
            f"the log has {samples} samples from the step onward, {self.free} of them in free motion, but needs "
            f"{FEWEST_SAMPLES}"
        )

    def saturated(self) -> str:
        clipped = f"the command is clipped at {self.limit:.4g} from row {self.clipped} on, below the wall law"
        return clipped + self.growth()

    def disturbed(self) -> str:
        if self.push.first_row >= 0:
            force = f"an additional force of {self.push.force:.3g} begins near row {self.push.first_row}"
            return f"{force}; the step is {self.trial.step:.4g}"
        offset = f"the device rests at a distance of {self.end.offset:.3g} from x_0 + F_0/K, outside +-{self.band:.3g}"
        return f"{offset}: another force acts on the device"

    def diverged(self) -> str:
        return f"the motion grows to an amplitude of {self.end.amplitude:.3g} in the last fifth{self.growth()}"

    def limit_cycle(self) -> str:
        cycle = f"the device oscillates with a steady amplitude of {self.end.amplitude:.3g}, outside +-{self.band:.3g}"
        return cycle + self.growth()

    def moving(self) -> str:
        if np.isnan(self.band):
            return f"K = {self.trial.stiffness:g} has no final position; the motion does not diverge{self.growth()}"
        return f"the motion is not permanently inside +-{self.band:.3g} by sample {self.trial.rows - 1}{self.growth()}"

    def settled(self) -> str:
        wide = "" if self.band > self.response.floor else ", which is the sensor floor"
        entry = f"the motion is inside +-{self.band:.3g} from sample {self.end.entry} of the log on"
        return f"{entry}{wide}{self.growth()}"


RULES: dict[str, Callable[[_Evidence], tuple[bool, int]]] = {
    "no_step": lambda of: (not of.response.has_edge, NO_ROW),
    "travel_limit": lambda of: (max(of.stop, of.left) >= 0, of.stop if of.stop >= 0 else of.left),
    "too_short": lambda of: (of.short, NO_ROW),
    "saturated": lambda of: (of.clipped >= 0, of.clipped),
    "disturbed": lambda of: (of.push.first_row >= 0 or of.end.rests_elsewhere or of.unmoved, of.push.first_row),
    "diverged": lambda of: (of.verdict.verdict == "unstable" and not of.end.settled and not of.end.lasting, NO_ROW),
    "limit_cycle": lambda of: (of.end.lasting and not of.end.settled, NO_ROW),
    "moving": lambda of: (not of.end.settled, NO_ROW),
    "settled": lambda of: (of.end.settled, of.end.entry),
}
"""Rules of the outcomes in order of precedence. Each rule returns whether the outcome applies, and the row in which its
evidence begins. Outcomes that end a log or make it useless take precedence over outcomes of the loop."""

OUTCOMES = tuple(RULES)


def classify(trial: Trial, response: Response, verdict: Verdict, usual_rows: int, device: PushResponse) -> OutcomeRow:
    """Determine the outcome of a trial.

    Parameters
    ----------
    trial, response, verdict : Trial, Response, Verdict
    usual_rows : int
        `usual_length` of the logs of the experiment, to detect logs that end early.
    device : PushResponse
        Device fitted to the experiment (`fit_push_response`), to detect disturbances.

    Returns
    -------
    OutcomeRow

    Notes
    -----
    The first outcome of `OUTCOMES` that applies is used: there is no identifiable step; the log ended outside the
    travel or at a stop; there are too few samples of free motion; the command is clipped; a force in addition to the
    command moved the device, or the device does not rest at x_0 + F_0/K; the motion grows; an oscillation is sustained
    outside the band; the response is not yet permanently in the band; the response has settled. A limit cycle inside
    the band is settled.

    The band is 2 % of the final displacement, or the sensor floor if the floor is wider. With K <= 0, there is no final
    position. The outcome of such a trial is divergence or motion.
    """
    stepped = trial.stiffness > 0 and trial.step != 0
    travel = abs(trial.step / trial.stiffness) if stepped else np.nan
    band = max(BAND * travel, response.floor) if stepped else np.nan
    push, free = find_disturbance(trial, response, device), free_samples(trial, response)
    within = bool(travel <= band)
    unmoved = free == 0 and trial.rows - response.edge_row > UNMOVED_SAMPLES and not within
    clipped, limit = first_clipped(trial)
    evidence = _Evidence(
        *(trial, response, verdict, band, _end(trial, response, verdict, band), clipped, limit, push),
        stop=first_stop(trial, response, push, device),
        left=left_travel(trial, response, usual_rows),
        free=free,
        unmoved=unmoved,
        short=free < FEWEST_SAMPLES and not unmoved and not within,
    )
    rows = {name: row for name, rule in RULES.items() for holds, row in [rule(evidence)] if holds}
    outcome = next(iter(rows))
    return OutcomeRow(outcome, getattr(evidence, outcome)(), rows[outcome], band, evidence.end.amplitude)


def _end(trial: Trial, response: Response, verdict: Verdict, band: float) -> _End:
    edge, has_final = max(response.edge_row, 0), not np.isnan(band)
    final = response.position_final_expected if has_final else response.position_start
    error, width = trial.position[edge:] - final, band if has_final else -1.0
    outside = np.flatnonzero(np.abs(error) > width)
    entry = edge + (int(outside[-1]) + 1 if len(outside) else 0)
    growth = verdict.growth_per_s * trial.sampling_period_s
    far, open_ = reach(trial, final, edge, entry, growth, response.floor / NOISE_FACTOR)
    settled = trial.rows - entry >= SETTLED_SAMPLES and far <= width + NORMAL_95 * open_
    fifth = max(trial.rows - edge, 1) / 5
    parts = [error[_rows(number * fifth, edge) : _rows((number + 1) * fifth, edge)] for number in (2, 3, 4)]
    third, fourth, last = (float(np.ptp(part)) if len(part) else 0.0 for part in parts)
    offset = float(parts[2].mean()) if len(parts[2]) else 0.0
    late = error[max(_rows(2 * fifth, edge) - 1, 0) :] > 0
    crossings = int((late[1:] != late[:-1]).sum())
    lasting = crossings >= CROSSINGS and last > response.floor and has_final
    lasting = lasting and min(third, last) >= LASTING * max(third, last)
    # above the level that quanta sustain, the growth rate of the verdict is more reliable than amplitude ratios
    if verdict.verdict != "undecided" and last > 2 * REST_FLOORS * response.floor:
        lasting = lasting and not abs(growth) * (trial.rows - edge) > LASTING_CHANGE
    # an oscillation about the edge of the band leaves the band occasionally, and a growing oscillation may begin inside
    # it
    settled = settled and not ((lasting or verdict.verdict == "unstable") and entry >= edge + 4 * fifth)
    rests = max(fourth, last) <= AT_REST * response.floor
    elsewhere = rests and has_final and abs(offset) > band + response.floor
    return _End(entry, bool(settled), lasting, elsewhere, offset, 0.5 * last)


def _rows(samples: float, edge: int) -> int:
    """Return the number of whole rows, counted from the edge, that begin within the given number of samples."""
    return math.ceil(edge + samples) - edge
