"""What each stage makes of an experiment: the row of a trial, or columns of the whole; the table of them is `stages`.

A stage of trials returns where its columns are found: records that have the columns' names, and a mapping of the rest.
What is stored of it is declared once, in `records.tables`: by that each column is found, and a negative row or count
and an empty text are null.
"""

from __future__ import annotations

import json
from collections import ChainMap
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial

import numpy as np

from pipeline.measured import thesis
from pipeline.measured.cost.costs import Measure, joined
from pipeline.measured.cost.reading_error import as_known, gain_at_rest, sensor_error, usual_gain
from pipeline.measured.experiment.boundary import boundary_band
from pipeline.measured.experiment.estimates import by_model, delay_factor, first_change, standard_error
from pipeline.measured.experiment.rest_forces import rest_spring
from pipeline.measured.experiment.stored import Experiment
from pipeline.measured.signal import outcome, verdict
from pipeline.measured.signal.disturbance import PushResponse, fit_push_response
from pipeline.measured.signal.events import usual_length
from pipeline.measured.signal.response import NO_ROW
from pipeline.measured.signal.sensor import sensor_floor
from pipeline.measured.stages.measured_trial import Columns, Given, MeasuredTrial, ReadingInputs
from pipeline.records.tables import COLUMNS, TABLES

Sources = Sequence[object]
"""Where the columns of a stage are found: records with fields of their names, and dictionaries."""

OF_TRIAL = ("trial_id", "samples_sha256", "stiffness", "damping")
"""Columns by which the rows of all stages are known."""


def stage_row(
    of: MeasuredTrial, stage: str, columns: Callable[[MeasuredTrial, Given], Sources], given: Given
) -> Columns:
    """Return the row of a stage for a trial, but for the columns by which the trial is known."""
    values = ChainMap(*(source if isinstance(source, dict) else vars(source) for source in columns(of, given)))
    return {name: _stored(name, values[name]) for name in TABLES[stage] if name not in OF_TRIAL}


def _stored(name: str, value: object) -> object:
    """Return a value in the form in which it is stored."""
    missing = value == "" or (isinstance(value, int) and value < 0)
    return None if missing and COLUMNS[name].nullable else value


def response(of: MeasuredTrial, given: Given) -> Sources:
    """Return edge, final position, resolution and verdict of a trial."""
    judged = verdict.judge(of.trial, of.response)
    # whatever it shows, it shows of another wall, or of a wrong recording
    columns = {
        "verdict": "undecided" if of.unsafe else judged.verdict,
        "reason": joined(of.unsafe, judged.reason, of.response.reason),
        "growth_per_s": np.nan if of.unsafe else judged.growth_per_s,
        "findings": json.dumps([finding.model_dump() for finding in of.findings]) if of.findings else "",
    }
    return columns, of.response


def wall_law(of: MeasuredTrial, given: Given) -> Sources:
    """Return whether the logged command of a trial obeys the wall law, and why not."""
    law, (stiffness, damping, step) = of.law, of.other_walls.obeyed
    columns = {
        "law_residual": law.residual,
        "law_rounding": law.rounding,
        "law_codes": ",".join(departure.code for departure in law.departures),
        "law_evidence": law.evidence,
        "law_rows": max((departure.rows for departure in law.departures), default=0),
        "obeyed_stiffness": stiffness,
        "obeyed_damping": damping,
        "obeyed_step": step,
        "velocity_filter": law.filter and json.dumps(asdict(law.filter)),
    }
    return (columns,)


def given_to_outcome(of: Experiment) -> Given:
    """Return what the outcome of a trial takes from the whole experiment."""
    quantum, noise = (of.column("response", f"sensor_{name}") for name in ("quantum", "noise"))
    edge = np.nan_to_num(of.column("response", "edge_row"), nan=NO_ROW).astype(np.int64)
    device = fit_push_response(of.samples, edge, sensor_floor(quantum, noise))
    return {"usual_rows": usual_length(of.samples.rows), "device": asdict(device)}


def outcomes(of: MeasuredTrial, given: Given) -> Sources:
    """Return how a trial ended, and what shows it."""
    device = PushResponse(**given["device"])
    ended = outcome.classify(of.trial, of.response, of.verdict, given["usual_rows"], device)
    return ended, {"outcome_row": ended.first_row}


def boundary(of: Experiment) -> Columns:
    """Return the measured boundary, a row a damping, of the trials whose command obeys the stated wall."""
    stated = np.isnan(of.column("wall_law", "obeyed_stiffness"))
    points = boundary_band(
        of.column("response", "stiffness")[stated],
        of.column("response", "damping")[stated],
        of.verdicts.verdict[stated],
        of.verdicts.growth_per_s[stated],
    )
    return {name: [getattr(p, name) for p in points] for name in TABLES["boundary"]}


def delays(of: MeasuredTrial, given: Given) -> Sources:
    """Return the delay of a trial by its first position change."""
    change = thesis.first_change(of.trial, of.response)
    return {"first_change_samples": change.delay_samples}, change


def given_to_mass(of: Experiment) -> Given:
    """Return what the momentum balance takes from the whole experiment: the delay that the thesis would take."""
    value = of.once(first_change).value
    return {"missing": "needs the delay, which is not known"} if value is None else {"delay": int(value)}


def masses(of: MeasuredTrial, given: Given) -> Sources:
    """Return the mass of a trial by the momentum balance."""
    return (thesis.by_momentum(of.trial, of.response, given["delay"]),)


def given_to_costs(of: Experiment) -> Given:
    """Return what costs take from the whole experiment that need nothing of the device."""
    return _sensor(of, 0, rest_spring(of))


def given_to_timed(of: Experiment) -> Given:
    """Return what costs take from the whole experiment that are counted from the delay on."""
    factor = of.once(delay_factor)
    if factor is None:
        return {"missing": "needs the delay, which is not known"}
    first, samples, last = factor
    return {**_sensor(of, samples, _spring(of)), "delay_range": (first, last)}


def given_to_energy(of: Experiment) -> Given:
    """Return what energies take from the whole experiment: the mass, too."""
    found = by_model(of, "mass")
    if found.value is None:
        return {"missing": f"energy needs the mass: {found.reason}"}
    error = as_known(standard_error(found))
    return {**of.once(given_to_timed), "mass": as_known(found.value, error), "mass_error": error}


def _sensor(of: Experiment, samples: int, spring: float) -> Given:
    """What a cost and the error of a reading take from all trials: a spring, the sensor, the usual gain."""
    noise, quantum, rows = (of.column("response", name) for name in ("sensor_noise", "sensor_quantum", "edge_row"))
    begun = np.isfinite(rows)
    sensor = sensor_error(noise[begun], quantum[begun], rows[begun].astype(np.int64))
    if not np.isfinite(sensor):
        return {"delay": samples, "sensor": None, "gain": 1.0, "spring": spring}
    gain = np.array(of.map_trials(partial(_gain_at_rest, delay=samples, sensor=sensor, spring=spring)))
    return {"delay": samples, "sensor": sensor, "gain": usual_gain(gain), "spring": spring}


def _gain_at_rest(of: MeasuredTrial, delay: int, sensor: float, spring: float) -> float:
    return gain_at_rest(*of.with_spring(of.trial, of.response, spring), delay, sensor)


def _spring(of: Experiment) -> float:
    """Return the stiffness k [N/m, Nm/rad]: as declared, else of the likeliest device, else by where it rests."""
    k = by_model(of, "stiffness")
    if of.spring or k.value is None:
        return rest_spring(of)
    return max(as_known(k.value, standard_error(k)), 0.0)


def costs(of: MeasuredTrial, given: Given, measure: Measure, names: Sequence[str]) -> Sources:
    """Return the columns of a family of costs for a trial; ``names`` are those of costs that count time.

    Of logs with missing or repeated rows they are counted on the grid of samples, with intervals that include those of
    rows which lie on straight lines.
    """
    inputs = ReadingInputs(given["delay"], given["sensor"], given["gain"], given["spring"])
    columns, *others = (
        measure(read.trial, read.response, of.verdict, read.error, given)
        for read in of.readings(inputs, on_grid=bool(names))
    )
    ends = {f"{name}_low": np.fmin for name in names} | {f"{name}_high": np.fmax for name in names}
    for other in others:
        columns |= {end: widest(columns[end], other[end]) for end, widest in ends.items()}
    return (columns,)
