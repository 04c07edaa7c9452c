"""Stored rows of the stages for logs. The fields of a record are the columns of its table, in order.

Units and meanings of the columns are in `tables.COLUMNS`. A missing value is NaN, a negative row number or an empty
text, and is stored as null.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

OF_TRIAL = ("trial_id", "samples_sha256", "stiffness", "damping")
"""Columns that identify a row in all stages with one row for each trial."""


@dataclass(frozen=True)
class ResponseRow:
    """Verdict, edge, rest positions and resolution of a trial, with the faults of its recording."""

    verdict: str
    reason: str
    growth_per_s: float
    edge_row: int
    position_start: float
    position_final_expected: float
    position_final_measured: float
    sensor_quantum: float
    sensor_noise: float
    findings: str


@dataclass(frozen=True)
class WallLawRow:
    """Comparison of the command of a trial with the wall law, and the wall that the command follows if it differs from
    the stated wall."""

    law_residual: float
    law_rounding: float
    law_codes: str
    law_evidence: str
    law_rows: int
    obeyed_stiffness: float
    obeyed_damping: float
    obeyed_step: float
    velocity_filter: str


@dataclass(frozen=True)
class OutcomeRow:
    """Outcome of a trial.

    Parameters
    ----------
    outcome : str
        One of `outcome.OUTCOMES`.
    evidence : str
        A sentence with numbers in SI units.
    outcome_row : int
        First row of the evidence: the first row in the band (good), the first clipped row, the first row at the stop or
        outside the travel, or the first disturbed row. -1 if there is none.
    band : float
        Half-width of the band about the final position [m, rad], or NaN if K <= 0.
    amplitude_end : float
        Half the range of the last fifth of the response [m, rad].
    """

    outcome: str
    evidence: str
    outcome_row: int
    band: float
    amplitude_end: float


@dataclass(frozen=True)
class PartsRow:
    """Parts of the device, chosen from some of the trials, and starting point of the fit to all trials.

    Without parts, only ``reason``.
    """

    start_names: Sequence[str] | None = None
    start_values: Sequence[float] | None = None
    noise_force: float | None = None
    noise_late: float | None = None
    jitter: float | None = None
    reading_variance: float | None = None
    unit_period: float | None = None
    unit_position: float | None = None
    unit_command: float | None = None
    origin: float | None = None
    lead_rows: int | None = None
    part_names: Sequence[str] | None = None
    part_gains: Sequence[float] | None = None
    assumed: Sequence[str] | None = None
    bound_names: Sequence[str] | None = None
    bound_values: Sequence[float] | None = None
    free_run_filter: Sequence[float] | None = None
    open_parts: Sequence[str] | None = None
    reason: str | None = None


@dataclass(frozen=True)
class DeviceRow:
    """Device identified from all trials of an experiment. Without a device, all fields except ``reason`` are None."""

    parameter_names: Sequence[str] | None = None
    parameter_values: Sequence[float] | None = None
    covariance: Sequence[float] | None = None
    parts: Sequence[str] | None = None
    mode_sensor: str | None = None
    unidentifiable: Sequence[str] | None = None
    bound_names: Sequence[str] | None = None
    bound_values: Sequence[float] | None = None
    scatter_names: Sequence[str] | None = None
    scatter_values: Sequence[float] | None = None
    fold_values: Sequence[float] | None = None
    combination_codes: Sequence[str] | None = None
    combination_members: Sequence[str] | None = None
    combination_values: Sequence[float] | None = None
    combination_units: Sequence[str] | None = None
    combination_remedies: Sequence[str] | None = None
    jitter: float | None = None
    jitter_error: float | None = None
    fitted_trials: Sequence[str] | None = None
    explained: int | None = None
    fit_percent: float | None = None
    saturated: float | None = None
    largest_command: float | None = None
    largest_step: float | None = None
    travel: float | None = None
    remedy: str | None = None
    reason: str | None = None


@dataclass(frozen=True)
class ModelRow:
    """Mass, damping and delay from a single trial. They are None, with a reason, if they cannot be identified from the
    trial.
    """

    trial_id: str
    samples_sha256: str
    stiffness: float
    damping: float
    model_mass: float | None
    model_mass_error: float | None
    model_damping: float | None
    model_damping_error: float | None
    model_delay: float | None
    model_delay_error: float | None
    reason: str | None


@dataclass(frozen=True)
class DelayRow:
    """Delay of a trial from the first change of its position."""

    first_change_samples: int
    reason: str


@dataclass(frozen=True)
class MassRow:
    """Mass of a trial from the momentum balance over its window, over twice this window, and over its second half."""

    mass_momentum: float
    mass_momentum_longer: float
    mass_momentum_later: float
    reason: str


@dataclass(frozen=True)
class OvershootRow:
    """Overshoot of a trial with its interval, and the apparent overshoot due to the sensor alone."""

    overshoot: float
    overshoot_low: float
    overshoot_high: float
    overshoot_floor: float
    reason: str


@dataclass(frozen=True)
class SettlingRow:
    """Settling times of a trial with their intervals, for the bands of 1, 2 and 5 %."""

    settle_1pct: float
    settle_1pct_low: float
    settle_1pct_high: float
    settle_2pct: float
    settle_2pct_low: float
    settle_2pct_high: float
    settle_5pct: float
    settle_5pct_low: float
    settle_5pct_high: float
    reason: str


@dataclass(frozen=True)
class RiseRow:
    """Rise time of a trial with its interval."""

    rise_time: float
    rise_time_low: float
    rise_time_high: float
    reason: str


@dataclass(frozen=True)
class EnergyRow:
    """Energies of a trial for each weight, with their intervals, the contribution of noise, and the part after the end
    of the log."""

    energy_w0: float
    energy_w0_low: float
    energy_w0_high: float
    energy_w1: float
    energy_w1_low: float
    energy_w1_high: float
    energy_w2: float
    energy_w2_low: float
    energy_w2_high: float
    energy_w0_bias: float
    energy_w0_tail: float
    energy_w1_bias: float
    energy_w1_tail: float
    energy_w2_bias: float
    energy_w2_tail: float
    horizon_samples: float
    reason: str


@dataclass(frozen=True)
class OtherCostRow:
    """Cost of a trial with its interval, for a criterion without a stored column."""

    cost: float
    cost_low: float
    cost_high: float
    reason: str


CostRow = OvershootRow | SettlingRow | EnergyRow | RiseRow | OtherCostRow
TrialRow = ResponseRow | WallLawRow | OutcomeRow | DelayRow | MassRow | CostRow
ExperimentRow = PartsRow | DeviceRow | ModelRow

ROWS: Mapping[str, type[TrialRow | ExperimentRow]] = {
    "response": ResponseRow,
    "wall_law": WallLawRow,
    "outcome": OutcomeRow,
    "parts": PartsRow,
    "device": DeviceRow,
    "model": ModelRow,
    "delay": DelayRow,
    "mass": MassRow,
    "overshoot": OvershootRow,
    "settling": SettlingRow,
    "energy": EnergyRow,
    "rise": RiseRow,
}
"""Record of each stage. The rows of the boundary are those of `BoundaryPoint` instead."""

BOUNDARY = ("damping", "stable", "unstable", "censored", "estimate", "low", "high", "trials", "undecided")
"""Columns of the measured boundary. Other fields of a point are known only in a comparison."""


def columns_of(stage: str) -> tuple[str, ...]:
    """Return the columns of the table of a stage, in order.

    >>> columns_of("delay")
    ('trial_id', 'samples_sha256', 'stiffness', 'damping', 'first_change_samples', 'reason')
    """
    own = BOUNDARY if stage == "boundary" else tuple(field.name for field in fields(ROWS[stage]))
    return own if stage in ("parts", "device", "model", "boundary") else OF_TRIAL + own
