"""The columns of each stage that has one row a trial: which functions make them, from what."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import pyarrow as pa

from pipeline.measured.cost.families import FAMILIES, joined
from pipeline.measured.cost.reading_error import reading_error
from pipeline.measured.device import damping, delay, friction, mass, onset
from pipeline.measured.experiment.stage_groups import Columns, Given, TrialGroup
from pipeline.measured.fit import fit
from pipeline.measured.fit.ghost import simulate_ghost
from pipeline.measured.signal import outcome, verdict
from pipeline.measured.signal.disturbance import Device
from pipeline.measured.signal.response import NO_ROW
from pipeline.records.tables import TABLES, to_arrow

BALANCE_TERMS = ("damping", "friction")
"""Forces that the corrected momentum balance allows for beside the inertia: those of every drive."""

OPEN_LOOP_TERMS = ("damping", "friction", "start")
"""As `BALANCE_TERMS` for logs without a wall: their delay is uncertain, so that momentum may be missing at the start.
A rotating device in the open loop may be a pendulum, for which gravity is added."""


def _conditions(of: TrialGroup) -> Columns:
    return {
        "trial_id": list(of.batch.trial_id),
        "samples_sha256": list(of.batch.digests),
        "stiffness": of.batch.stiffness,
        "damping": of.batch.damping,
    }


def _row(values: np.ndarray) -> pa.Array:
    """Rows or counts of which a negative one stands for none."""
    return pa.array(values, mask=values < 0)


def _response(of: TrialGroup, given: Given) -> Columns:
    found = of.found
    judged = verdict.judge(of.batch, found)
    return _conditions(of) | {
        "verdict": list(judged.verdict),
        "reason": joined(judged.reason, found.reason),
        "growth_per_s": judged.growth_per_s,
        "edge_row": _row(found.edge_row),
        **{name: getattr(found, name) for name in ("position_start", "position_final_expected")},
        **{name: getattr(found, name) for name in ("position_final_measured", "sensor_quantum", "sensor_noise")},
    }


def _outcome(of: TrialGroup, given: Given) -> Columns:
    device = Device(**given["device"])
    found = outcome.classify(of.batch, of.found, of.verdicts, usual_rows=given["usual_rows"], device=device)
    return _conditions(of) | {
        "outcome": list(found.outcome),
        "evidence": list(found.evidence),
        "outcome_row": _row(found.first_row),
        "band": found.band,
        "amplitude_end": found.amplitude_end,
    }


def _delay(of: TrialGroup, given: Given) -> Columns:
    first = delay.first_change(of.batch, of.found)
    began = onset.motion_onset(of.batch, of.found, first)
    return _conditions(of) | {
        "delay_samples": _row(onset.rounded(first, began)),
        "first_change_samples": _row(first.delay_samples),
        "onset_samples": began.delay_samples,
        "onset_error": began.standard_error,
        "reason": joined(first.reason),
    }


def _model(of: TrialGroup, given: Given) -> Columns:
    begin, first = of.beginning()
    found = fit.fit_trials(begin.batch, begin.found)
    beside = simulate_ghost(of.batch, of.found, found.mass, found.damping, found.delay)
    named = ("mass", "damping", "delay", "jitter")
    return _conditions(of) | {
        **{f"model_{name}": getattr(found, name) for name in named},
        **{f"model_{name}_error": getattr(found, f"{name}_error") for name in named},
        "model_start": found.start,
        "misfit": found.misfit,
        "whiteness": found.whiteness,
        "leaves_row": _row(np.where(found.leaves_row < 0, NO_ROW, found.leaves_row + first)),
        "ghost_deviation": beside.deviation,
        "ghost_relative": beside.relative,
        "ghost_row": _row(beside.leaves_row),
        "reason": joined(found.reason),
    }


def _damping(of: TrialGroup, given: Given) -> Columns:
    begin, _ = of.beginning()
    found = damping.from_trials(begin.batch, begin.found, given["delay"])
    return _conditions(of) | {"viscous_damping": found.viscous_damping, "reason": joined(found.reason)}


def _mass(of: TrialGroup, given: Given) -> Columns:
    nothing = np.full(len(of.batch), np.nan)
    samples = given["delay"]
    begin, _ = of.beginning()
    found = mass.by_momentum(begin.batch, begin.found, samples)
    terms: tuple[str, ...] = BALANCE_TERMS
    if given["open_loop"]:
        terms = (*OPEN_LOOP_TERMS, "gravity") if given["rotation"] else OPEN_LOOP_TERMS
        samples = 0  # the start term stands for the delay, which friction hides
    balance = friction.fit_balance(begin.batch, begin.found, samples, terms=terms)
    columns = _conditions(of) | {
        "mass_momentum": found.mass_momentum,
        "damping_share": found.damping_share,
        "mass": nothing,
        "balance_mass": balance.mass,
        "balance_mass_error": balance.mass_error,
        "force_mass": nothing,
        "force_mass_error": nothing,
        "reason": joined(found.reason),
    }
    if begin.batch.force is not None:
        # a force measured at the device has passed the delay already
        force = friction.fit_balance(begin.batch, begin.found, 0, terms=terms, force=begin.batch.force, held=False)
        columns |= {"force_mass": force.mass, "force_mass_error": force.mass_error}
    return columns


def _costs(of: TrialGroup, given: Given, family: str) -> Columns:
    sensor = float("nan") if given["sensor"] is None else given["sensor"]
    error = reading_error(of.batch, of.found, given["delay"], sensor=sensor, rest=given["rest"])
    return _conditions(of) | FAMILIES[family](of.batch, of.found, of.verdicts, error, given)


COMPUTE: dict[str, Callable[[TrialGroup, Given], Columns]] = {
    "response": _response,
    "outcome": _outcome,
    "delay": _delay,
    "model": _model,
    "damping": _damping,
    "mass": _mass,
    **{name: partial(_costs, family=name) for name in FAMILIES},
}
"""What computes the columns of a stage with one row a trial."""


def stage_rows(of: TrialGroup, stage: str, given: Given, *, rotation: bool) -> pa.Table:
    """Return the rows of a stage for some trials; nulls and the reason where the experiment lacks what it needs."""
    if "missing" in given:
        nothing: Columns = dict.fromkeys(TABLES[stage], [None] * len(of.batch))
        columns = nothing | _conditions(of) | {"reason": [given["missing"]] * len(of.batch)}
    else:
        columns = COMPUTE[stage](of, given)
    return to_arrow(stage, columns, rotation=rotation)
