"""What each stage makes of an experiment: rows of some trials, or columns of the whole; the table of them is `stages`.

A stage of trials returns where its columns are found: results that bear the columns' names, and a mapping of the rest.
What is stored of it is declared once, in `records.tables`: by that each column is found, a negative row or count and an
empty text are null, and the columns by which trials are known are added.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, replace

import numpy as np
import pyarrow as pa

from pipeline.measured.cost.costs import Measure, joined
from pipeline.measured.cost.reading_error import (
    as_known,
    gain_at_rest,
    reading_error,
    sensor_error,
    usual_gain,
)
from pipeline.measured.device import damping, delay, forces, friction, mass, onset
from pipeline.measured.experiment.boundary_band import boundary_band
from pipeline.measured.experiment.estimates import damping_estimate, explaining_factor, mass_estimate, standard_error
from pipeline.measured.experiment.fitted_device import explaining_device
from pipeline.measured.experiment.known_delay import delay_estimate, delay_range, with_delay
from pipeline.measured.experiment.rest_forces import rest_spring
from pipeline.measured.fit import fit
from pipeline.measured.fit.ghost import simulate_ghost
from pipeline.measured.signal import outcome, verdict
from pipeline.measured.signal.disturbance import Device, learn_device
from pipeline.measured.signal.events import usual_length
from pipeline.measured.signal.response import NO_ROW, sensor_floor
from pipeline.measured.stages.stage_given import Experiment, is_open_loop
from pipeline.measured.stages.stage_groups import Columns, Given, TrialGroup
from pipeline.records.batch import Floats
from pipeline.records.tables import COLUMNS, TABLES, to_arrow

Sources = Sequence[object]
"""Where the columns of a stage are found: records with attributes of their names, and mappings."""

BALANCE_TERMS = ("damping", "friction")
"""Forces that the corrected momentum balance allows for beside the inertia: those of every drive."""

OPEN_LOOP_TERMS = ("damping", "friction", "start")
"""As `BALANCE_TERMS` for logs without a wall: their delay is uncertain, so that momentum may be missing at the start.
A rotating device in the open loop may be a pendulum, for which gravity is added."""


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
    # whatever it shows, it shows of another wall
    other = np.array([bool(text) for text in of.other_walls.reason])
    told = {
        "verdict": np.where(other, "undecided", judged.verdict).tolist(),
        "reason": joined(of.other_walls.reason, judged.reason, of.found.reason),
        "growth_per_s": np.where(other, np.nan, judged.growth_per_s),
    }
    return told, of.found


def wall_law(of: TrialGroup, given: Given) -> Sources:
    """Return whether the logged command of each trial obeys the wall law, and why not."""
    law, obeyed = of.law, of.other_walls.obeyed
    filters = [next((each.filter for each in found if each.filter is not None), None) for found in law.departures]
    return (
        {
            "law_residual": law.residual,
            "law_rounding": law.rounding,
            "law_codes": [",".join(each.code for each in found) for found in law.departures],
            "law_evidence": ["; ".join(each.evidence for each in found) for found in law.departures],
            "law_rows": [max((each.rows for each in found), default=0) for found in law.departures],
            **{f"obeyed_{name}": obeyed[:, i] for i, name in enumerate(("stiffness", "damping", "step"))},
            "velocity_filter": [found and json.dumps(asdict(found)) for found in filters],
        },
    )


def given_to_outcome(of: Experiment) -> Given:
    """Return what the outcome of a trial takes from the whole experiment."""
    quantum, noise = (of.column("response", f"sensor_{name}") for name in ("quantum", "noise"))
    edge = np.nan_to_num(of.column("response", "edge_row"), nan=NO_ROW).astype(np.int64)
    rows, step, period = (of.samples.of_trials(name) for name in ("rows", "step", "sampling_period_s"))
    device = learn_device(of.samples, edge, sensor_floor(quantum, noise), rows, step, period)
    return {"usual_rows": usual_length(rows), "device": asdict(device)}


def outcomes(of: TrialGroup, given: Given) -> Sources:
    """Return how each trial ended, and what shows it."""
    device = Device(**given["device"])
    found = outcome.classify(of.batch, of.found, of.verdicts, usual_rows=given["usual_rows"], device=device)
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
    """Return the delay of each trial by its first position change and by the onset of its motion."""
    first = delay.first_change(of.batch, of.found)
    began = onset.motion_onset(of.batch, of.found, first)
    told = {"delay_samples": onset.rounded(first, began), "first_change_samples": first.delay_samples}
    return told, {"onset_samples": began.delay_samples, "onset_error": began.standard_error}, first


def model(of: TrialGroup, given: Given) -> Sources:
    """Return the model fitted to the whole response of each trial, and the loop simulated with it."""
    begin, first = of.beginning()
    found = fit.fit_trials(begin.batch, begin.found)
    beside = simulate_ghost(of.batch, of.found, found.mass, found.damping, found.delay)
    numbers = [end for name in ("mass", "damping", "delay", "jitter") for end in (name, f"{name}_error")]
    told = {
        **{f"model_{name}": getattr(found, name) for name in (*numbers, "start")},
        "leaves_row": np.where(found.leaves_row < 0, NO_ROW, found.leaves_row + first),
        "ghost_deviation": beside.deviation,
        "ghost_relative": beside.relative,
        "ghost_row": beside.leaves_row,
    }
    return told, found


def given_to_damping(of: Experiment) -> Given:
    """Return what the damping of a trial takes from the whole experiment."""
    return {**with_delay(of), "pendulum": of.rotation and is_open_loop(of)}


def dampings(of: TrialGroup, given: Given) -> Sources:
    """Return the viscous damping of each trial by its momentum balance, and its part of the joint balance."""
    begin, _ = of.beginning()
    found = damping.from_trials(begin.batch, begin.found, given["delay"])
    sums = forces.balance_sums(begin.batch, begin.found, given["delay"], pendulum=given["pendulum"])
    return found, {"balance_sums": list(sums)}


def given_to_mass(of: Experiment) -> Given:
    """Return what the mass of a trial takes from the whole experiment."""
    return {**with_delay(of), "open_loop": is_open_loop(of), "rotation": of.rotation}


def masses(of: TrialGroup, given: Given) -> Sources:
    """Return the mass of each trial by momentum balances, as those of the thesis and with friction."""
    nothing = np.full(len(of.batch), np.nan)
    samples = given["delay"]
    begin, _ = of.beginning()
    found = mass.by_momentum(begin.batch, begin.found, samples)
    terms: tuple[str, ...] = BALANCE_TERMS
    if given["open_loop"]:
        terms = (*OPEN_LOOP_TERMS, "gravity") if given["rotation"] else OPEN_LOOP_TERMS
        samples = 0  # the start term stands for the delay, which friction hides
    balance = _with_friction(friction.fit_balance(begin.batch, begin.found, samples, terms=terms))
    told: Columns = {
        "mass": nothing,
        "balance_mass": balance.mass,
        "balance_mass_error": balance.mass_error,
        "force_mass": nothing,
        "force_mass_error": nothing,
        "reason": joined(found.reason, balance.reason),
    }
    if begin.batch.force is not None:
        # a force measured at the device has passed the delay already
        measured = friction.fit_balance(begin.batch, begin.found, 0, terms=terms, force=begin.batch.force, held=False)
        force = _with_friction(measured)
        told |= {"force_mass": force.mass, "force_mass_error": force.mass_error}
    return told, found


def _with_friction(balance: friction.BalanceFit) -> friction.BalanceFit:
    """Return the balance without the masses of which friction may be a part: those of trials that do not tell it."""
    lost = ["friction is not told" in text for text in balance.dropped]
    reason = tuple(
        f"no balance with friction: {text}" if without else ""
        for text, without in zip(balance.dropped, lost, strict=True)
    )
    return replace(balance, mass=np.where(lost, np.nan, balance.mass), reason=reason)


def corrected(of: Experiment, rows: pa.Table) -> Columns:
    """Return the masses that follow from the others by the damping of the whole experiment."""
    plain, share = (rows.column(name).to_numpy() for name in ("mass_momentum", "damping_share"))
    b = of.once(damping_estimate).value
    return {"mass": np.full(rows.num_rows, np.nan) if b is None else mass.correct(mass.Masses(plain, share, ()), b)}


def given_to_costs(of: Experiment) -> Given:
    """Return what costs take from the whole experiment that need nothing of the device."""
    return _sensor(of, 0, rest_spring(of))


def given_to_timed(of: Experiment) -> Given:
    """Return what costs take from the whole experiment that are counted from the delay on."""
    found = with_delay(of)
    if "missing" in found:
        return found
    first, last = delay_range(of.once(delay_estimate))
    first, samples, last = of.once(explaining_factor) or (first, found["delay"], last)
    return {**_sensor(of, samples, _spring(of)), "delay_range": (first, last)}


def given_to_energy(of: Experiment) -> Given:
    """Return what energies take from the whole experiment: the mass, too."""
    device = of.once(explaining_device)
    found = (device and device.estimate("mass", "")) or of.once(mass_estimate)
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
    """Return the stiffness k [N/m, Nm/rad]: as declared, else of the device that explains the trials, else by rest."""
    device = of.once(explaining_device)
    if of.spring or device is None:
        return rest_spring(of)
    k = device.estimate("stiffness", "")
    return max(as_known(k.value, standard_error(k)), 0.0) if k is not None and k.value is not None else 0.0


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
