"""Define the stages `parts`, `device` and `model`.

These stages identify one device from the likelihood of all trials, and estimate the parameters of each trial.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.base.provenance import digest
from pipeline.measured.experiment.identified_loop import MOST, parts_of
from pipeline.measured.experiment.stored import Experiment
from pipeline.measured.identification.identified import (
    Identification,
    check_recordings,
    identified,
    no_fit,
    own_numbers,
)
from pipeline.measured.identification.intervals import with_delay
from pipeline.measured.identification.noise import Noise
from pipeline.measured.identification.parts import ChosenParts, choose_parts, subset
from pipeline.measured.identification.recordings import SHORTEST, LogUnits, Recording
from pipeline.measured.identification.scatter import FEWEST
from pipeline.measured.identification.segments import GAP
from pipeline.measured.stages.measured_trial import MeasuredTrial
from pipeline.records.findings import Finding, unsafe_reason
from pipeline.records.stage_records import DeviceRow, ModelRow, PartsRow
from pipeline.records.trials import Trial

MOST_ROWS = 600
"""Largest number of rows of a log, counted from shortly before the step. With any useful wall, the motion has ended by
then."""

AHEAD = 40
"""Number of rows before the step that are used."""

LEAST = 1e-300
"""Smallest variance of a parameter. It replaces the variance 0 of an exactly known parameter."""

WITHOUT = {"command_shifted", "sampling_period"}
"""Departures from the wall law for which the logged command does not drive the device at the logged time, or the time
is unknown."""

INSEPARABLE = "mass and force gain cannot be separated from these logs; record {}, or trials with a wall"

OTHER_WALLS = (
    "the command of most logs does not match their stated wall and time, so these logs are left out; the mass is not "
    "identifiable from the other logs; correct K, B and the units in the profile"
)


def recordings_of(of: Experiment) -> list[Recording] | str:
    """Return the trials of an experiment as inputs of the estimator, or the reason why none is usable."""
    codes = [set(filter(None, text.split(","))) for text in of.texts("wall_law", "law_codes")]
    stiffness = of.column("response", "stiffness")
    usable = np.array([each.isdisjoint(WITHOUT) for each in codes])
    # without a wall, a device may end anywhere, and its log contains less information on the motion at walls
    usable &= (stiffness > 0) | (stiffness <= 0).all()
    usable &= np.isnan(of.column("wall_law", "obeyed_stiffness"))
    findings = of.once(recording_findings)
    if reason := unsafe_reason(findings):
        return reason
    usable &= ~np.array([any(each.leaves_out for each in found) for found in findings])
    edges = of.column("response", "edge_row")
    found = [
        cut(MeasuredTrial(of.samples[place]).trial, int(np.nan_to_num(edges[place])), findings[place])
        for place in np.flatnonzero(usable).tolist()
    ]
    if not found:
        fault = next((each for some in findings for each in some if each.leaves_out), None)
        return fault.sentence if fault is not None else "no log has a command that matches its wall and time"
    # logs that are too short to show motion are left out, unless all logs are too short
    found = [one for one in found if len(one.time) >= SHORTEST] or found
    try:
        check_recordings(found)
    except ParameterError as error:
        return str(error)
    return found


def chosen_by(of: Experiment) -> str:
    """Return a hash of the recordings from which the parts of the device are chosen, or the reason if there are
    none."""
    found = of.once(recordings_of)
    return found if isinstance(found, str) else digest([each.digest for each in subset(found)])


def parts(of: Experiment) -> list[PartsRow]:
    """Return the single row of the stage `parts`."""
    found = of.once(recordings_of)
    if isinstance(found, str):
        return [PartsRow(reason=found)]
    try:
        chosen = choose_parts(found)
    except ParameterError as error:
        return [PartsRow(reason=str(error))]
    except np.linalg.LinAlgError as error:
        return [PartsRow(reason=str(no_fit(error)))]
    return [parts_row(chosen)]


def parts_row(chosen: ChosenParts) -> PartsRow:
    """Return the row of the stage `parts` for the chosen parts, without their tests."""
    noise, units = chosen.noise, chosen.units
    return PartsRow(
        [*chosen.numbers],
        [*chosen.numbers.values()],
        noise.force,
        noise.late,
        noise.jitter,
        chosen.reading,
        units.period,
        units.position,
        units.command,
        units.origin,
        chosen.lead,
        [*chosen.parts],
        [*chosen.parts.values()],
        chosen.assumed,
        [*chosen.bounds],
        [*chosen.bounds.values()],
        chosen.free,
        chosen.open,
    )


def chosen_by_row(row: Mapping[str, Any]) -> ChosenParts:
    """Return the parts of a device from a row of the stage `parts`."""

    def named(names: str, values: str) -> dict[str, float]:
        return dict(zip(row[names], row[values], strict=True))

    return ChosenParts(
        named("start_names", "start_values"),
        Noise(row["noise_force"], row["noise_late"], row["jitter"]),
        row["reading_variance"],
        LogUnits(row["unit_period"], row["unit_position"], row["unit_command"], row["origin"]),
        row["lead_rows"],
        named("part_names", "part_gains"),
        tuple(row["assumed"]),
        named("bound_names", "bound_values"),
        tuple(row["free_run_filter"]),
        tuple(row["open_parts"]),
    )


def identification(of: Experiment) -> tuple[Identification | None, str]:
    """Return the maximum-likelihood device of an experiment with a remedy, or None with a reason."""
    found = of.once(recordings_of)
    if isinstance(found, str):
        return None, found
    (row,) = of.table("parts").to_pylist()
    if row["reason"]:
        return None, row["reason"]
    try:
        result = identified(found, chosen_by_row(row))
    except ParameterError as error:
        return None, str(error)
    remedy = result.recorded.remedy()
    if "mass" not in result.unidentifiable:
        return result, remedy
    # if most logs follow a wall other than the stated wall, this is the reason, whatever faults the other logs have
    why = INSEPARABLE.format(remedy) if len(found) > MOST * of.trials.num_rows else OTHER_WALLS
    return None, why


def recording_findings(of: Experiment) -> list[list[Finding]]:
    """Return the recording faults of each trial, from the stage `response`."""
    return [
        [Finding.model_validate(each) for each in json.loads(text)] if text else []
        for text in of.texts("response", "findings")
    ]


def device(of: Experiment) -> list[DeviceRow]:
    """Return the single row of the stage `device`."""
    found, words = of.once(identification)
    if found is None:
        return [DeviceRow(reason=words)]
    limit = found.parameters["force_limit"].value if "force_limit" in found.parameters else np.inf
    row = device_row(found, words, float(np.abs(of.samples.step).max(initial=0.0)))
    return [replace(row, saturated=_saturated(of, limit))]


def model(of: Experiment) -> list[ModelRow]:
    """Return mass, damping and delay of each trial, computed by one Newton step from the common values."""
    found, reason = of.once(identification)
    ids, hashes = (of.texts("response", name) for name in ("trial_id", "samples_sha256"))
    walls = zip(*(of.column("response", name).tolist() for name in ("stiffness", "damping")), strict=True)
    own = {} if found is None else own_numbers(found)
    fitted = set(ids) if found is None else set(found.names)
    if found is not None:
        few = f"with fewer than {FEWEST} logs, trials are not identified individually"
        reason = few if found.choice.fit.few else "its motion does not identify mass, damping or delay"
    rows = []
    for trial, samples, (stiffness, damping) in zip(ids, hashes, walls, strict=True):
        numbers: Sequence[float | None] = own.get(trial, [None] * 6)
        m, m_error, b, b_error, d, d_error = numbers
        why = reason if trial in fitted else "left out: its command does not drive the device"
        words = None if trial in own else why
        rows.append(ModelRow(trial, samples, stiffness, damping, m, m_error, b, b_error, d, d_error, words))
    return rows


def device_row(found: Identification, remedy: str, largest_step: float) -> DeviceRow:
    """Return the identified device in stored form. ``largest_step`` [N, Nm] is from the headers, or 0."""
    # the interval of a parameter may be wider than its interval from the likelihood
    errors = np.array([each.error for each in found.parameters.values()])
    wider = np.maximum(errors / np.sqrt(np.maximum(found.covariance.diagonal(), LEAST)), 1.0)
    covariance = found.covariance * np.outer(wider, wider)
    # an exactly known parameter has the numerical error
    np.fill_diagonal(covariance, np.maximum(covariance.diagonal(), errors**2))
    values, covariance = with_delay({name: each.value for name, each in found.parameters.items()}, covariance)
    unknown = found.unidentifiable | (values.keys() - found.parameters.keys())
    parts, mode_sensor = parts_of(found.parts)
    intervals = [each.interval for each in found.combinations]
    noise, bounds = found.choice.fit.device.noise, found.choice.bounds
    return DeviceRow(
        parameter_names=[*values],
        parameter_values=[*values.values()],
        covariance=covariance.ravel().tolist(),
        parts=parts,
        mode_sensor=mode_sensor,
        unidentifiable=sorted(unknown),
        bound_names=[*bounds],
        bound_values=[*bounds.values()],
        scatter_names=[*found.scatter],
        scatter_values=[*found.scatter.values()],
        fold_values=[fold.get(name, 0.0) for fold in found.folds for name in values],
        combination_codes=[each.code for each in found.combinations],
        combination_members=[",".join(each.members) for each in found.combinations],
        combination_values=[value for each in intervals for value in (each.value, each.low, each.high, each.error)],
        combination_units=[each.unit for each in found.combinations],
        combination_remedies=[each.record for each in found.combinations],
        jitter=noise.jitter,
        jitter_error=noise.jitter_error,
        fitted_trials=found.names,
        explained=found.explained,
        fit_percent=found.fit_percent,
        saturated=0.0,
        largest_command=found.units.command,
        largest_step=largest_step or found.units.command,
        travel=found.units.position,
        remedy=remedy,
    )


def _saturated(of: Experiment, limit: float) -> float:
    """Return the share of the stable trials that command more than the given force."""
    if not np.isfinite(limit):
        return 0.0
    stable = of.verdicts.verdict == "stable"
    largest = np.array(of.map_trials(_largest_command))[stable]
    return float((largest > limit).mean()) if len(largest) else 0.0


def _largest_command(of: MeasuredTrial) -> float:
    return float(np.abs(of.trial.command).max())


def recording(of: MeasuredTrial) -> Recording:
    """Return a trial as an input of the estimator."""
    return cut(of.trial, max(of.response.edge_row, 0), of.findings)


def cut(trial: Trial, edge: int, findings: Sequence[Finding]) -> Recording:
    """Return a trial, with given edge row and findings, as an input of the estimator, up to a travel stop.

    A trial with a step begins shortly before the step. Of its ranges between lost rows, only the range with the most
    motion is used. Without a step, all rows are used.
    """
    last = min([trial.rows, *(finding.first_row or 0 for finding in findings if finding.severity == "cut")])
    rows = slice(0, last)
    if trial.step != 0:
        first = max(edge - AHEAD, 0)
        rows = _complete(trial, slice(first, min(last, first + MOST_ROWS)))
    declared = trial.step_row is not None and rows.start <= edge < rows.stop and rows.start == max(edge - AHEAD, 0)
    return Recording(
        trial.trial_id,
        trial.time[rows],
        trial.command[rows],
        trial.position[rows],
        trial.sampling_period_s,
        edge - rows.start if declared else None,
        (trial.damping, trial.stiffness),
    )


def usable_recordings(trials: Sequence[MeasuredTrial]) -> list[Recording]:
    """Return the usable trials of logs that are not stored, as inputs of the estimator.

    `identification` would use the same trials. The command need not obey the wall in the header, because it drives the
    device in any case.
    """
    unusable = unusable_trials(trials)
    found = [recording(each) for each in trials if each.logged.trial_id not in unusable]
    return [each for each in found if len(each.time) >= SHORTEST] or found


def unusable_trials(trials: Sequence[MeasuredTrial]) -> dict[str, str]:
    """Return why trials are not used for a device: a sentence for each such trial, with its id as the key.

    The trials are those of logs that are not stored.
    """
    walls, reasons = any(each.trial.stiffness > 0 for each in trials), dict[str, str]()
    for each in trials:
        fault = next((finding.sentence for finding in each.findings if finding.leaves_out), "")
        if not fault and walls and not each.trial.stiffness > 0:
            fault = "Logs without a wall are not used together with logs that have one."
        if not fault and walls:
            departures = (departure for departure in each.law.departures if departure.code in WITHOUT)
            fault = next((departure.evidence for departure in departures), "")
        if fault:
            reasons[each.logged.trial_id] = fault
    return reasons


def _complete(trial: Trial, rows: slice) -> slice:
    """Return the range between lost rows with the most motion, or all rows if none is lost."""
    time, position = trial.time[rows], trial.position[rows]
    gaps = np.flatnonzero(np.diff(time) > GAP * trial.sampling_period_s) + 1
    bounds = [0, *gaps.tolist(), len(time)]
    way = [float(np.abs(np.diff(position[a:b])).sum()) for a, b in pairwise(bounds)]
    best = int(np.argmax(way)) if way else 0
    return slice(rows.start + bounds[best], rows.start + bounds[best + 1])
