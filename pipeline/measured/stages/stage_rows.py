"""Functions of the stages. They compute the row of a trial, or all rows of an experiment. `stages` is their table."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from pipeline.measured import thesis
from pipeline.measured.cost.costs import CostInputs, Measure, ReadingInputs, joined
from pipeline.measured.cost.reading_error import as_known, gain_at_rest, sensor_error, usual_gain
from pipeline.measured.experiment.boundary import boundary_band
from pipeline.measured.experiment.estimates import by_model, delay_factor, first_change, standard_error
from pipeline.measured.experiment.rest_forces import rest_spring
from pipeline.measured.experiment.stored import Experiment
from pipeline.measured.signal.disturbance import PushResponse, fit_push_response
from pipeline.measured.signal.log_events import usual_length
from pipeline.measured.signal.outcome import classify
from pipeline.measured.signal.response import NO_ROW, RestPositions
from pipeline.measured.signal.sensor import sensor_floor
from pipeline.measured.signal.verdict import judge
from pipeline.measured.stages.measured_trial import MeasuredTrial, with_spring
from pipeline.measured.stages.stage import Missing
from pipeline.measured.stages.stage_device import recording_findings
from pipeline.records.findings import BoundaryPoint
from pipeline.records.stage_records import (
    CostRow,
    DelayRow,
    MassRow,
    OutcomeRow,
    ResponseRow,
    WallLawRow,
)


def response(of: MeasuredTrial, _: None) -> ResponseRow:
    """Return edge, final position, resolution and verdict of a trial."""
    judged, shown = judge(of.trial, of.response), of.response
    # the verdict of an unsafe log would apply to a different wall, or to a faulty recording
    return ResponseRow(
        verdict="undecided" if of.unsafe else judged.verdict,
        reason=joined(of.unsafe, judged.reason, shown.reason),
        growth_per_s=np.nan if of.unsafe else judged.growth_per_s,
        edge_row=shown.edge_row,
        position_start=shown.position_start,
        position_final_expected=shown.position_final_expected,
        position_final_measured=shown.position_final_measured,
        sensor_quantum=shown.sensor_quantum,
        sensor_noise=shown.sensor_noise,
        findings=json.dumps([finding.model_dump() for finding in of.findings]) if of.findings else "",
    )


def wall_law(of: MeasuredTrial, _: None) -> WallLawRow:
    """Compare the logged command of a trial with the wall law."""
    law, (stiffness, damping, step) = of.law, of.law.obeyed
    return WallLawRow(
        law_residual=law.residual,
        law_rounding=law.rounding,
        law_codes=",".join(departure.code for departure in law.departures),
        law_evidence=law.evidence,
        law_rows=max((departure.rows for departure in law.departures), default=0),
        obeyed_stiffness=stiffness,
        obeyed_damping=damping,
        obeyed_step=step,
        velocity_filter=json.dumps(asdict(law.filter)) if law.filter else "",
    )


@dataclass(frozen=True)
class OutcomeInputs:
    """Inputs of outcomes that are common to the experiment: the usual number of rows, and the device."""

    usual_rows: int
    device: PushResponse


def outcome_inputs(of: Experiment) -> OutcomeInputs:
    """Return the inputs of outcomes that are common to the experiment."""
    quantum, noise = (of.column("response", f"sensor_{name}") for name in ("quantum", "noise"))
    edge = np.nan_to_num(of.column("response", "edge_row"), nan=NO_ROW).astype(np.int64)
    device = fit_push_response(of.samples, edge, sensor_floor(quantum, noise))
    return OutcomeInputs(usual_length(of.samples.rows), device)


def outcome(of: MeasuredTrial, inputs: OutcomeInputs) -> OutcomeRow:
    """Return the outcome of a trial with its evidence."""
    return classify(of.trial, of.response, of.verdict, inputs.usual_rows, inputs.device)


def boundary(of: Experiment) -> tuple[BoundaryPoint, ...]:
    """Return the measured boundary, one row per damping, from the trials whose command obeys the stated wall."""
    stated = np.isnan(of.column("wall_law", "obeyed_stiffness"))
    return boundary_band(
        of.column("response", "stiffness")[stated],
        of.column("response", "damping")[stated],
        of.verdicts.verdict[stated],
        of.verdicts.growth_per_s[stated],
    )


def delay(of: MeasuredTrial, _: None) -> DelayRow:
    """Return the delay of a trial from its first position change."""
    change = thesis.first_change(of.trial, of.response)
    return DelayRow(change.delay_samples, change.reason)


@dataclass(frozen=True)
class MassInputs:
    """Common inputs of momentum balances: the delay [samples] and the length of the window [s]."""

    delay: int
    window_s: float


def mass_inputs(of: Experiment) -> MassInputs | Missing:
    """Return the inputs of the momentum balance that are common to the experiment."""
    value = of.once(first_change).value if of.measuring.momentum_delay is None else of.measuring.momentum_delay
    return Missing(NO_DELAY) if value is None else MassInputs(int(value), of.measuring.momentum_window_s)


NO_DELAY = "the delay is required, but it is unknown"


def mass(of: MeasuredTrial, inputs: MassInputs) -> MassRow:
    """Return the mass of a trial from momentum balances over the window, over twice the window, and over the window
    that follows the first one."""
    window = inputs.window_s
    first, longer, later = (
        thesis.by_momentum(of.trial, of.response, inputs.delay, window_s=end, after_s=begin)
        for begin, end in ((0.0, window), (0.0, 2 * window), (window, 2 * window))
    )
    return MassRow(first.mass_momentum, longer.mass_momentum, later.mass_momentum, first.reason)


def cost_inputs(of: Experiment) -> CostInputs:
    """Return the common inputs of costs that need no parameter of the device."""
    return CostInputs(_reading_inputs(of, 0, rest_spring(of)))


def timed_inputs(of: Experiment) -> CostInputs | Missing:
    """Return the common inputs of costs that are counted from the end of the delay."""
    factor = of.once(delay_factor)
    if factor is None:
        return Missing(NO_DELAY)
    first, samples, last = factor
    return CostInputs(_reading_inputs(of, samples, _spring(of)), (first, last))


def energy_inputs(of: Experiment) -> CostInputs | Missing:
    """Return the common inputs of energy costs, including the mass."""
    found = by_model(of, "mass")
    if found.value is None:
        return Missing(f"energy costs require the mass: {found.reason}")
    error, timed = standard_error(found), of.once(timed_inputs)
    # a standard deviation from n values has the relative standard error 1/sqrt(2 n)
    error = as_known(error, error / math.sqrt(2 * max(found.trials or 1, 1)))
    if isinstance(timed, Missing):
        return timed
    return replace(timed, mass=as_known(found.value, error), mass_error=error)


def _reading_inputs(of: Experiment, samples: int, spring: float) -> ReadingInputs:
    """Return the common inputs of reading errors: the spring, the sensor error, and the usual gain."""
    noise, quantum, rows = (of.column("response", name) for name in ("sensor_noise", "sensor_quantum", "edge_row"))
    begun = np.isfinite(rows)
    sensor, final = sensor_error(noise[begun], quantum[begun], rows[begun].astype(np.int64)), of.measuring.final
    if not np.isfinite(sensor):
        return ReadingInputs(samples, None, 1.0, spring, final)
    rests = enumerate(_rest_positions(of))
    gains = [gain_at_rest(*with_spring(of.samples[place], rest, spring), samples, sensor) for place, rest in rests]
    return ReadingInputs(samples, sensor, usual_gain(np.array(gains)), spring, final)


def _rest_positions(of: Experiment) -> list[RestPositions]:
    """Return the stored rest positions of each trial. An unsafe log has no command edge."""
    names = ("edge_row", "position_start", "position_final_expected", "sensor_quantum", "sensor_noise")
    edge, start, final, quantum, noise = (of.column("response", name) for name in names)
    safe = np.isnan(of.column("wall_law", "obeyed_stiffness"))
    safe &= [not any(finding.is_unsafe for finding in findings) for findings in recording_findings(of)]
    rows = np.where(safe & np.isfinite(edge), edge, NO_ROW).astype(np.int64)
    values = (rows, start, final, sensor_floor(quantum, noise))
    return [RestPositions(*each) for each in zip(*(column.tolist() for column in values), strict=True)]


def _spring(of: Experiment) -> float:
    """Return the declared stiffness k [N/m, Nm/rad], or otherwise the identified stiffness, or otherwise the stiffness
    that follows from the rest positions."""
    k = by_model(of, "stiffness")
    if of.spring or k.value is None:
        return rest_spring(of)
    return max(as_known(k.value, standard_error(k)), 0.0)


def costs(of: MeasuredTrial, inputs: CostInputs, measure: Measure, names: Sequence[str]) -> CostRow:
    """Return the costs of a family for a trial. ``names`` are the time-based costs.

    For logs with missing or repeated rows, these costs are computed on the sample grid, and their intervals include the
    intervals of the linear interpolation.
    """
    row, *others = (
        measure(read.trial, read.response, of.verdict, read.error, inputs)
        for read in of.readings(inputs.readings, on_grid=bool(names))
    )
    ends = {f"{name}_low": np.fmin for name in names} | {f"{name}_high": np.fmax for name in names}
    for other in others:
        row = replace(row, **{end: widest(vars(row)[end], vars(other)[end]) for end, widest in ends.items()})
    return row
