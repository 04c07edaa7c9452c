"""The columns of each stage of the measured branch: which functions make them, from what."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from math import ceil, floor
from typing import Any, Protocol

import numpy as np
import pyarrow as pa

from pipeline.measured import costs, damping, delay, fit, friction, mass, onset, outcome, verdict
from pipeline.measured.boundary_band import boundary_band
from pipeline.measured.cost_intervals import overshoot_interval, settling_interval
from pipeline.measured.energy_intervals import HORIZON_PARTS, energy_interval
from pipeline.measured.ghost import simulate_ghost
from pipeline.measured.intervals import NORMAL_95
from pipeline.measured.reading_error import ReadingError, reading_error
from pipeline.measured.response import NO_ROW, Response
from pipeline.measured.step_metrics import TOOLS, reconcile
from pipeline.measured.verdict import Verdicts
from pipeline.records.batch import Floats, TrialBatch
from pipeline.records.models import SETTLING_BANDS, Estimate
from pipeline.records.tables import TABLES

WINDOWS_S = (0.005, 0.010, 0.015, 0.020, 0.030, 0.040, 0.060, 0.080)
"""Windows of the momentum balance [s] whose masses are compared; the thesis took 15 ms (6.1.2)."""

BALANCE_TERMS = ("damping", "friction")
"""Forces that the corrected momentum balance allows for beside the inertia: those of every drive."""

OPEN_LOOP_TERMS = ("damping", "friction", "start")
"""As `BALANCE_TERMS` for logs without a wall: their delay is uncertain, so that momentum may be missing at the start.
A rotating device in the open loop may be a pendulum, for which gravity is added."""

Columns = dict[str, Any]


class Trials(Protocol):
    """What a stage computes from: the samples of an experiment, and what the stages before it found."""

    @property
    def rotation(self) -> bool:
        """Whether units are rotational."""

    @property
    def batch(self) -> TrialBatch:
        """All samples."""

    @property
    def found(self) -> Response:
        """Edge and resolution of each trial."""

    @property
    def verdicts(self) -> Verdicts:
        """Verdict of each trial."""

    @property
    def delay_estimate(self) -> Estimate:
        """Integer delay factor of the experiment."""

    @property
    def damping_estimate(self) -> Estimate:
        """Viscous damping of the experiment."""

    @property
    def mass_estimate(self) -> Estimate:
        """Mass of the experiment."""

    def column(self, stage: str, name: str) -> Floats:
        """Numeric column of an earlier stage."""


def standard_error(estimate: Estimate) -> float:
    """Return the standard error that an interval of 95 % stands for; 0 where there is none."""
    if estimate.low is None or estimate.high is None:
        return 0.0
    return (estimate.high - estimate.low) / (2 * NORMAL_95)


def delay_range(estimate: Estimate) -> tuple[int, int]:
    """Return the smallest and largest integer delay factor of an interval, whose upper end is one sample more (6.3)."""
    value = int(estimate.value or 0)
    low = value if estimate.low is None else min(floor(estimate.low), value)
    high = value if estimate.high is None else max(ceil(estimate.high) - 1, value)
    return low, high


def _conditions(of: Trials) -> Columns:
    return {"trial_id": list(of.batch.trial_id), "stiffness": of.batch.stiffness, "damping": of.batch.damping}


def _texts(*reasons: Iterable[str]) -> list[str | None]:
    """Reasons of each trial, joined; None where there is none."""
    return ["; ".join(dict.fromkeys(text for text in texts if text)) or None for texts in zip(*reasons, strict=True)]


def _integer(values: Floats) -> pa.Array:
    missing = ~np.isfinite(values)
    return pa.array(np.where(missing, 0, values).astype(np.int64), mask=missing)


def _row(values: np.ndarray) -> pa.Array:
    """Rows or counts of which a negative one stands for none."""
    return pa.array(values, mask=values < 0)


def _response(of: Trials) -> Columns:
    found = of.found
    judged = verdict.judge(of.batch, found)
    return _conditions(of) | {
        "verdict": list(judged.verdict),
        "reason": _texts(judged.reason, found.reason),
        "growth_per_s": judged.growth_per_s,
        "edge_row": _row(found.edge_row),
        **{name: getattr(found, name) for name in ("position_start", "position_final_expected")},
        **{name: getattr(found, name) for name in ("position_final_measured", "sensor_quantum", "sensor_noise")},
    }


def _outcome(of: Trials) -> Columns:
    found = outcome.classify(of.batch, of.found, of.verdicts)
    return _conditions(of) | {
        "outcome": list(found.outcome),
        "evidence": list(found.evidence),
        "outcome_row": _row(found.first_row),
        "band": found.band,
        "amplitude_end": found.amplitude_end,
    }


def _boundary(of: Trials) -> Columns:
    points = boundary_band(
        of.column("response", "stiffness"),
        of.column("response", "damping"),
        of.verdicts.verdict,
        of.verdicts.growth_per_s,
    )
    return {name: [getattr(p, name) for p in points] for name in TABLES["boundary"]}


def _delay(of: Trials) -> Columns:
    first = delay.first_change(of.batch, of.found)
    began = onset.motion_onset(of.batch, of.found, first)
    return _conditions(of) | {
        "delay_samples": _row(onset.rounded(first, began)),
        "first_change_samples": _row(first.delay_samples),
        "onset_samples": began.delay_samples,
        "onset_error": began.standard_error,
        "reason": _texts(first.reason),
    }


def _model(of: Trials) -> Columns:
    found = fit.fit_trials(of.batch, of.found)
    beside = simulate_ghost(of.batch, of.found, found.mass, found.damping, found.delay)
    named = ("mass", "damping", "delay", "jitter")
    return _conditions(of) | {
        **{f"model_{name}": getattr(found, name) for name in named},
        **{f"model_{name}_error": getattr(found, f"{name}_error") for name in named},
        "model_start": found.start,
        "misfit": found.misfit,
        "whiteness": found.whiteness,
        "leaves_row": _row(found.leaves_row),
        "ghost_deviation": beside.deviation,
        "ghost_relative": beside.relative,
        "ghost_row": _row(beside.leaves_row),
        "reason": _texts(found.reason),
    }


def _damping(of: Trials) -> Columns:
    def compute(samples: int) -> Columns:
        found = damping.from_trials(of.batch, of.found, samples)
        return {"viscous_damping": found.viscous_damping, "reason": _texts(found.reason)}

    return _with_delay(of, "damping", compute)


def _mass(of: Trials) -> Columns:
    nothing = np.full(len(of.batch), np.nan)

    def compute(samples: int) -> Columns:
        found = mass.by_momentum(of.batch, of.found, samples)
        b = of.damping_estimate.value
        terms: tuple[str, ...] = BALANCE_TERMS
        if not (of.batch.stiffness.any() or of.batch.damping.any()):
            terms = (*OPEN_LOOP_TERMS, "gravity") if of.rotation else OPEN_LOOP_TERMS
            samples = 0  # the start term stands for the delay, which friction hides
        balance = friction.fit_balance(of.batch, of.found, samples, terms=terms)
        columns = {
            "mass_momentum": found.mass_momentum,
            "mass": nothing if b is None else mass.correct(found, b),
            "balance_mass": balance.mass,
            "balance_mass_error": balance.mass_error,
            "force_mass": nothing,
            "force_mass_error": nothing,
            "reason": _texts(found.reason),
        }
        if of.batch.force is not None:
            # a force measured at the device has passed the delay already
            force = friction.fit_balance(of.batch, of.found, 0, terms=terms, force=of.batch.force, held=False)
            columns |= {"force_mass": force.mass, "force_mass_error": force.mass_error}
        return columns

    return _with_delay(of, "mass", compute)


def _with_delay(of: Trials, stage: str, compute: Callable[[int], Columns]) -> Columns:
    """Columns of a stage that takes the delay of the experiment; nulls and the reason where there is none."""
    estimate = of.delay_estimate
    if estimate.value is None:
        return _missing(of, stage, "needs the delay, which is not known")
    return _conditions(of) | compute(int(estimate.value))


def _missing(of: Trials, stage: str, why: str) -> Columns:
    nothing: Columns = dict.fromkeys(TABLES[stage], [None] * len(of.batch))
    return nothing | _conditions(of) | {"reason": [why] * len(of.batch)}


def _reading_error(of: Trials, samples: int) -> ReadingError:
    return reading_error(of.batch, of.found, samples)


def _overshoot(of: Trials) -> Columns:
    found = costs.overshoot(of.batch, of.found, of.verdicts)
    interval = overshoot_interval(of.batch, of.found, _reading_error(of, 0), found)
    return _conditions(of) | {
        "overshoot": found.overshoot,
        "overshoot_floor": found.floor,
        "overshoot_low": interval.low,
        "overshoot_high": interval.high,
        "overshoot_last_sample": reconcile(of.batch, of.found, of.verdicts, 0).overshoot["matlab_final_value"].value,
        "reason": _texts(found.reason, interval.reason),
    }


def _settling(of: Trials) -> Columns:
    def compute(samples: int) -> Columns:
        found = costs.settling(of.batch, of.found, of.verdicts, samples)
        interval = settling_interval(
            *(of.batch, of.found, _reading_error(of, samples), found, samples),
            delay_range=delay_range(of.delay_estimate),
        )
        columns: Columns = {"reason": _texts(found.reason, interval.reason)}
        others = reconcile(of.batch, of.found, of.verdicts, samples).settling
        columns |= {f"settle_{tool}": others[tool].value for tool in TOOLS}
        for name in SETTLING_BANDS:
            columns[name] = _integer(found.samples[name])
            columns[f"{name}_low"], columns[f"{name}_high"] = (
                _integer(interval.low[name]),
                _integer(interval.high[name]),
            )
        return columns

    return _with_delay(of, "settling", compute)


def _energy(of: Trials) -> Columns:
    weight = of.mass_estimate
    if weight.value is None:
        return _missing(of, "energy", f"energy needs the mass: {weight.reason}")
    value = weight.value

    def compute(samples: int) -> Columns:
        found = energy_interval(
            *(of.batch, of.found, of.verdicts, _reading_error(of, samples), samples, value),
            mass_error=standard_error(weight),
            delay_range=delay_range(of.delay_estimate),
        )
        half, full = HORIZON_PARTS.index(0.5), HORIZON_PARTS.index(1.0)
        columns: Columns = {
            "horizon_samples": _row(np.where(found.horizon_samples > 0, found.horizon_samples, NO_ROW)),
            "reason": _texts(found.reason),
        }
        for w in costs.WEIGHTS:
            parts = {"": found.value, "_low": found.low, "_high": found.high, "_bias": found.bias, "_tail": found.tail}
            columns |= {f"energy_w{w}{end}": values[:, w] for end, values in parts.items()}
            columns |= {
                f"energy_w{w}_half": found.by_horizon[:, w, half],
                f"energy_w{w}_full": found.by_horizon[:, w, full],
            }
        return columns

    return _with_delay(of, "energy", compute)


def _windows(of: Trials) -> Columns:
    samples = of.delay_estimate.value
    if samples is None:
        return {name: [] for name in TABLES["windows"]}
    scan = mass.window_scan(of.batch, of.found, int(samples), np.array(WINDOWS_S))
    return {
        "window_s": scan.window_s,
        "mass_median": scan.median,
        "mass_scatter": scan.scatter,
        "trials": scan.trials,
        "reason": _texts(scan.reason),
    }


COMPUTE: dict[str, Callable[[Trials], Columns]] = {
    "response": _response,
    "outcome": _outcome,
    "boundary": _boundary,
    "delay": _delay,
    "model": _model,
    "damping": _damping,
    "mass": _mass,
    "overshoot": _overshoot,
    "settling": _settling,
    "energy": _energy,
    "windows": _windows,
}
"""What computes each stage."""
