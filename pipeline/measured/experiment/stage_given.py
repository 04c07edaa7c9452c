"""What a stage takes from a whole experiment, and the stages that are about nothing else."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from math import ceil, floor
from typing import Any, Protocol, TypeVar

import numpy as np
import pyarrow as pa

from pipeline.measured.cost.reading_error import motion_at_rest, sensor_error, usual_rest
from pipeline.measured.device.mass import Masses, by_momentum, correct, scan_of
from pipeline.measured.experiment.boundary_band import boundary_band
from pipeline.measured.experiment.stage_groups import Columns, Given, TrialGroup
from pipeline.measured.intervals import NORMAL_95
from pipeline.measured.signal.disturbance import Device, largest_force, learn_device, with_typical
from pipeline.measured.signal.events import usual_length
from pipeline.measured.signal.response import NO_ROW, sensor_floor
from pipeline.measured.signal.verdict import Verdicts
from pipeline.records.batch import Floats
from pipeline.records.criteria import FAMILIES, Family
from pipeline.records.groups import TrialGroups
from pipeline.records.models import Estimate
from pipeline.records.tables import TABLES

WINDOWS_S = (0.005, 0.010, 0.015, 0.020, 0.030, 0.040, 0.060, 0.080)
"""Windows of the momentum balance [s] whose masses are compared; the thesis took 15 ms (6.1.2)."""

Result = TypeVar("Result")


class Experiment(Protocol):
    """What there is of an experiment: its samples, and what the stages before found."""

    @property
    def rotation(self) -> bool:
        """Whether units are rotational."""

    @property
    def trials(self) -> pa.Table:
        """Rows of the trials table, in any order."""

    @property
    def samples(self) -> TrialGroups:
        """All samples."""

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

    def of_each(self, function: Callable[..., Result], **given: Any) -> list[Result]:
        """Results of a function of each group."""


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


def _nothing(of: Experiment) -> Given:
    return {}


def _outcome(of: Experiment) -> Given:
    quantum, noise = (of.column("response", f"sensor_{name}") for name in ("quantum", "noise"))
    edge = np.nan_to_num(of.column("response", "edge_row"), nan=NO_ROW).astype(np.int64)
    rows, step, period = (of.samples.of_trials(name) for name in ("rows", "step", "sampling_period_s"))
    device = learn_device(of.samples, edge, sensor_floor(quantum, noise), rows, step, period)
    forces = np.concatenate(of.of_each(_largest_force, device=asdict(device)))
    return {"usual_rows": usual_length(rows), "device": asdict(with_typical(device, forces))}


def _largest_force(of: TrialGroup, given: Given) -> Floats:
    return largest_force(of.batch, of.found, Device(**given["device"]))


def _with_delay(of: Experiment) -> Given:
    value = of.delay_estimate.value
    return {"missing": "needs the delay, which is not known"} if value is None else {"delay": int(value)}


def _mass(of: Experiment) -> Given:
    walls = (of.trials.column(name).to_numpy() for name in ("stiffness", "damping"))
    return {
        **_with_delay(of),
        "open_loop": not any(values.any() for values in walls),
        "rotation": of.rotation,
    }


def _sensor(of: Experiment, delay: int) -> Given:
    """What the error of a reading takes from all trials: the sensor, and the usual motion at rest."""
    sensor = sensor_error(*(of.column("response", f"sensor_{name}") for name in ("noise", "quantum")))
    if not np.isfinite(sensor):
        return {"delay": delay, "sensor": None, "rest": 1.0}
    rest = np.concatenate(of.of_each(_motion_at_rest, delay=delay, sensor=sensor))
    return {"delay": delay, "sensor": sensor, "rest": usual_rest(rest)}


def _motion_at_rest(of: TrialGroup, given: Given) -> Floats:
    return motion_at_rest(of.batch, of.found, given["delay"], given["sensor"])


def _cost(of: Experiment, family: Family) -> Given:
    weight = of.mass_estimate if "mass" in family.needs else None
    if weight and weight.value is None:
        return {"missing": f"{family.name} needs the mass: {weight.reason}"}
    given = _with_delay(of) if "delay" in family.needs else {"delay": 0}
    if "missing" in given:
        return given
    reach = {"delay_range": delay_range(of.delay_estimate)} if "delay" in family.needs else {}
    heavy = {"mass": weight.value, "mass_error": standard_error(weight)} if weight else {}
    return {**_sensor(of, given["delay"]), **reach, **heavy}


GIVEN: dict[str, Callable[[Experiment], Given]] = {
    "response": _nothing,
    "outcome": _outcome,
    "delay": _nothing,
    "model": _nothing,
    "damping": _with_delay,
    "mass": _mass,
    **{name: partial(_cost, family=family) for name, family in FAMILIES.items()},
}
"""What each stage with one row a trial takes from the whole experiment."""


def _corrected_mass(of: Experiment, rows: pa.Table) -> Columns:
    plain, share = (rows.column(name).to_numpy() for name in ("mass_momentum", "damping_share"))
    found = Masses(plain, share, ())
    b = of.damping_estimate.value
    return {"mass": np.full(rows.num_rows, np.nan) if b is None else correct(found, b)}


DERIVED: dict[str, Callable[[Experiment, pa.Table], Columns]] = {"mass": _corrected_mass}
"""Columns that follow from the others of a stage by a value of the whole experiment, and are made anew with each."""


def _boundary(of: Experiment) -> Columns:
    points = boundary_band(
        of.column("response", "stiffness"),
        of.column("response", "damping"),
        of.verdicts.verdict,
        of.verdicts.growth_per_s,
    )
    return {name: [getattr(p, name) for p in points] for name in TABLES["boundary"]}


def _windows(of: Experiment) -> Columns:
    given = _with_delay(of)
    if "missing" in given:
        return {name: [] for name in TABLES["windows"]}
    found = of.of_each(_window_masses, **given)
    reasons = [[text for _, each in found for text in each[i]] for i in range(len(WINDOWS_S))]
    scan = scan_of(np.array(WINDOWS_S), np.concatenate([masses for masses, _ in found]), reasons)
    return {
        "window_s": scan.window_s,
        "mass_median": scan.median,
        "mass_scatter": scan.scatter,
        "trials": scan.trials,
        "reason": [text or None for text in scan.reason],
    }


def _window_masses(of: TrialGroup, given: Given) -> tuple[Floats, list[tuple[str, ...]]]:
    found = [by_momentum(of.batch, of.found, given["delay"], window_s=window) for window in WINDOWS_S]
    return np.stack([f.mass_momentum for f in found], axis=1), [f.reason for f in found]


WHOLE: dict[str, Callable[[Experiment], Columns]] = {"boundary": _boundary, "windows": _windows}
"""What computes the columns of a stage without a row a trial."""
