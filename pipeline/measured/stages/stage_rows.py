"""What each stage makes of an experiment: rows of some trials, or columns of the whole; the table of them is `stages`.

A stage of trials returns where its columns are found: results that bear the columns' names, and a mapping of the rest.
What is stored of it is declared once, in `records.tables`: by that each column is found, a negative row or count and an
empty text are null, and the columns by which trials are known are added.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict

import numpy as np
import pyarrow as pa

from pipeline.measured import thesis
from pipeline.measured.cost.costs import Measure, joined
from pipeline.measured.cost.reading_error import (
    as_known,
    gain_at_rest,
    reading_error,
    sensor_error,
    usual_gain,
)
from pipeline.measured.experiment.boundary import boundary_band
from pipeline.measured.experiment.estimates import by_model, delay_factor, first_change, standard_error
from pipeline.measured.experiment.rest_forces import rest_spring
from pipeline.measured.experiment.stored import Experiment
from pipeline.measured.signal import outcome, verdict
from pipeline.measured.signal.disturbance import PushResponse, fit_push_response
from pipeline.measured.signal.events import usual_length
from pipeline.measured.signal.response import NO_ROW
from pipeline.measured.signal.sensor import sensor_floor
from pipeline.measured.stages.stage_groups import Columns, Given, TrialGroup
from pipeline.records.batch import Floats
from pipeline.records.tables import COLUMNS, TABLES, to_arrow

Sources = Sequence[object]
"""Where the columns of a stage are found: records with attributes of their names, and mappings."""


def stage_rows(
    of: TrialGroup, stage: str, columns: Callable[[TrialGroup, Given], Sources], given: Given, *, rotation: bool
) -> pa.Table:
    """Return the rows of a stage for some trials; nulls and the reason where the experiment lacks what it needs."""
    known: Columns = {
        "trial_id": list(of.batch.trial_id),
        "samples_sha256": list(of.logged.digests),
        "stiffness": of.batch.stiffness,
        "damping": of.batch.damping,
    }
    if "missing" in given:
        nothing: Columns = dict.fromkeys(TABLES[stage], [None] * len(of.batch))
        return to_arrow(stage, nothing | known | {"reason": [given["missing"]] * len(of.batch)}, rotation=rotation)
    sources = [known, *columns(of, given)]
    return to_arrow(stage, {name: _stored(name, sources) for name in TABLES[stage]}, rotation=rotation)


def _stored(name: str, sources: Sources) -> object:
    """Return a column from the first source that has it, in the form in which it is stored."""
    found = (one[name] if isinstance(one, Mapping) else getattr(one, name) for one in sources if _has(one, name))
    values = next(found)
    column = COLUMNS[name]
    if isinstance(values, np.ndarray) and values.dtype.kind == "i" and column.nullable:
        return pa.array(values, mask=values < 0)
    if column.nullable and isinstance(values, tuple):
        return [text or None for text in values]
    return values if isinstance(values, np.ndarray) else list(values)


def _has(source: object, name: str) -> bool:
    return name in source if isinstance(source, Mapping) else hasattr(source, name)


def response(of: TrialGroup, given: Given) -> Sources:
    """Return edge, final position, resolution and verdict of each trial."""
    judged = verdict.judge(of.batch, of.found)
    # whatever it shows, it shows of another wall, or of a wrong recording
    other = np.array([bool(text) for text in of.unsafe])
    told = {
        "verdict": np.where(other, "undecided", judged.verdict).tolist(),
        "reason": joined(of.unsafe, judged.reason, of.found.reason),
        "growth_per_s": np.where(other, np.nan, judged.growth_per_s),
        "findings": tuple(
            json.dumps([finding.model_dump() for finding in found]) if found else "" for found in of.findings
        ),
    }
    return told, of.found


def wall_law(of: TrialGroup, given: Given) -> Sources:
    """Return whether the logged command of each trial obeys the wall law, and why not."""
    law, obeyed = of.law, of.other_walls.obeyed
    return (
        {
            "law_residual": law.residual,
            "law_rounding": law.rounding,
            "law_codes": [",".join(each.code for each in found) for found in law.departures],
            "law_evidence": law.evidence,
            "law_rows": [max((each.rows for each in found), default=0) for found in law.departures],
            **{f"obeyed_{name}": obeyed[:, i] for i, name in enumerate(("stiffness", "damping", "step"))},
            "velocity_filter": [found and json.dumps(asdict(found)) for found in law.filters],
        },
    )


def given_to_outcome(of: Experiment) -> Given:
    """Return what the outcome of a trial takes from the whole experiment."""
    quantum, noise = (of.column("response", f"sensor_{name}") for name in ("quantum", "noise"))
    edge = np.nan_to_num(of.column("response", "edge_row"), nan=NO_ROW).astype(np.int64)
    rows, step, period = (of.samples.of_trials(name) for name in ("rows", "step", "sampling_period_s"))
    device = fit_push_response(of.samples, edge, sensor_floor(quantum, noise), rows, step, period)
    return {"usual_rows": usual_length(rows), "device": asdict(device)}


def outcomes(of: TrialGroup, given: Given) -> Sources:
    """Return how each trial ended, and what shows it."""
    found = outcome.classify(of.batch, of.found, of.verdicts, given["usual_rows"], PushResponse(**given["device"]))
    return found, {"outcome_row": found.first_row}


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


def delays(of: TrialGroup, given: Given) -> Sources:
    """Return the delay of each trial by its first position change."""
    found = thesis.first_change(of.batch, of.found)
    return {"first_change_samples": found.delay_samples}, found


def given_to_mass(of: Experiment) -> Given:
    """Return what the momentum balance takes from the whole experiment: the delay that the thesis would take."""
    value = of.once(first_change).value
    return {"missing": "needs the delay, which is not known"} if value is None else {"delay": int(value)}


def masses(of: TrialGroup, given: Given) -> Sources:
    """Return the mass of each trial by the momentum balance."""
    return (thesis.by_momentum(of.batch, of.found, given["delay"]),)


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
    return {**given_to_timed(of), "mass": as_known(found.value, error), "mass_error": error}


def _sensor(of: Experiment, samples: int, spring: float) -> Given:
    """What a cost and the error of a reading take from all trials: a spring, the sensor, the usual gain."""
    noise, quantum, rows = (of.column("response", name) for name in ("sensor_noise", "sensor_quantum", "edge_row"))
    begun = np.isfinite(rows)
    sensor = sensor_error(noise[begun], quantum[begun], rows[begun].astype(np.int64))
    if not np.isfinite(sensor):
        return {"delay": samples, "sensor": None, "gain": 1.0, "spring": spring}
    gain = np.concatenate(of.of_each(_gain_at_rest, delay=samples, sensor=sensor, spring=spring))
    return {"delay": samples, "sensor": sensor, "gain": usual_gain(gain), "spring": spring}


def _gain_at_rest(of: TrialGroup, given: Given) -> Floats:
    return of.held_by(given["spring"]).once(gain_at_rest, given["delay"], given["sensor"])


def _spring(of: Experiment) -> float:
    """Return the stiffness k [N/m, Nm/rad]: as declared, else of the likeliest device, else by where it rests."""
    k = by_model(of, "stiffness")
    if of.spring or k.value is None:
        return rest_spring(of)
    return max(as_known(k.value, standard_error(k)), 0.0)


def costs(of: TrialGroup, given: Given, measure: Measure, names: Sequence[str]) -> Sources:
    """Return the columns of a family of costs for some trials; ``names`` are those of costs that count time.

    Of logs with missing or repeated rows they are counted on the grid of samples, with intervals that hold those of
    rows which lie on straight lines, too.
    """
    if not names:
        return (_costs(of, given, measure),)
    made, straight = _costs(of.on_grid, given, measure), of.on_straight_grid
    return (made if straight is None else _hull(made, _costs(straight, given, measure), names),)


def _costs(of: TrialGroup, given: Given, measure: Measure) -> Columns:
    held = of.held_by(given["spring"])
    sensor = float("nan") if given["sensor"] is None else given["sensor"]
    error = reading_error(held.batch, held.found, given["delay"], sensor=sensor, gain=given["gain"])
    return measure(held.batch, held.found, held.verdicts, error, given)


def _hull(made: Columns, other: Columns, names: Iterable[str]) -> Columns:
    """Return columns whose intervals ``<name>_low`` and ``<name>_high`` hold those of other ones, too."""
    ends = {f"{name}_low": np.fmin for name in names} | {f"{name}_high": np.fmax for name in names}
    return made | {end: widest(made[end], other[end]) for end, widest in ends.items()}
