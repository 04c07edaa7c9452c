"""Dictionary of stored columns: each has one Arrow type, unit and meaning wherever it occurs.

Each table is a tuple of column names; files of them are written and read by `table_files`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import pyarrow as pa

from pipeline.base.process import without_pandas
from pipeline.device.parameters import Motion, drive_of, is_rotation, unit_in
from pipeline.records.criteria import MEASURED, Criterion, criterion_of
from pipeline.records.stage_records import ROWS, columns_of

without_pandas(pa)

Metadata = Mapping[str, str]


@dataclass(frozen=True)
class Column:
    """Stored column: Arrow type, unit for translation, unit for rotation, meaning, whether it may be null.

    A ``sensed`` column is in SI even if the commands are those of a drive.
    """

    dtype: pa.DataType
    unit: str
    unit_rotation: str
    meaning: str
    nullable: bool = False
    sensed: bool = False


def _same(dtype: pa.DataType, unit: str, meaning: str, nullable: bool = False) -> Column:
    return Column(dtype, unit, unit, meaning, nullable)


_F, _I, _S, _B = pa.float64(), pa.int64(), pa.string(), pa.bool_()
# name assigned by Parquet
_L = pa.list_(pa.field("element", _F))
_LI = pa.list_(pa.field("element", _I))
_LS = pa.list_(pa.field("element", _S))


def _cost(criterion: Criterion) -> dict[str, Column]:
    """Return the columns of the measured cost by a criterion and of its interval."""
    family, name = criterion.family, criterion.column
    dtype = _I if family.whole else _F
    return {
        name: _same(dtype, family.unit, criterion.meaning, True),
        f"{name}_low": _same(dtype, family.unit, f"lower end of the 95 % interval of {name}", True),
        f"{name}_high": _same(dtype, family.unit, f"upper end of the 95 % interval of {name}", True),
    }


_BIASES, _TAILS = (tuple(f"energy_w{w}_{part}" for w in (0, 1, 2)) for part in ("bias", "tail"))

COLUMNS: dict[str, Column] = {
    # identity and conditions of a trial
    "trial_id": _same(_S, "", "first 16 digits of the SHA-256 of the source log, or of that SHA-256 with the label"),
    "label": _same(_S, "", "which trial of its source it is, where there are several", True),
    "device": _same(_S, "", "device name as in the log"),
    "experiment": _same(_S, "", "experiment name as in the log"),
    "motion": _same(_S, "", "translation or rotation, and the unit of a drive's command; decides the other units"),
    "stiffness": Column(_F, "N/m", "Nm/rad", "virtual stiffness K"),
    "damping": Column(_F, "Ns/m", "Nms/rad", "virtual damping B"),
    "step": Column(_F, "N", "Nm", "size of the external force step F_0"),
    "sampling_period_s": _same(_F, "s", "sampling period T"),
    "added_delay_samples": _same(_I, "samples", "delay added on purpose"),
    "grip": _same(_S, "", "none, comfortable or firm"),
    "simulated": _same(_B, "", "true where the log says that it was simulated"),
    "rows": _same(_I, "", "number of samples"),
    "extra": _same(_S, "", "metadata of the log without a dedicated column, as JSON"),
    "time_quality": _same(_S, "", "gaps, drops, jitter, and what was settled in the rows, as JSON"),
    # origin of the trial
    "source_path": _same(_S, "", "source log as found"),
    "source_sha256": _same(_S, "", "SHA-256 of the source log (of both files, in order, for a pair)"),
    "source_trials": _same(_I, "", "number of trials in the source"),
    "source_size": _same(_I, "byte", "size of the source log"),
    "source_mtime_ns": _same(_I, "ns", "modification time of the source log"),
    "profile": _same(_S, "", "log profile that read it"),
    "profile_sha256": _same(_S, "", "SHA-256 of that profile"),
    "claims": _same(_S, "", "hash of all profiles that might have claimed it"),
    "package_version": _same(_S, "", "version that stored it"),
    "sample_file": _same(_S, "", "file below processed/ that contains the trial; not stored, added by the reader"),
    "sample_row": _same(_I, "", "row of that file"),
    # corrections
    "exclusion_reason": _same(_S, "", "why the trial is excluded by hand; empty where it is in use"),
    "excluded_since": _same(_S, "", "when it was excluded, UTC, ISO 8601"),
    "moved_device": _same(_S, "", "device that the trial counts as one of; null for that of its log", True),
    "moved_experiment": _same(_S, "", "experiment that the trial counts as one of; null for that of its log", True),
    "deleted": _same(_B, "", "true where the trial is deleted by hand"),
    "corrected_ns": _same(_I, "ns", "when the correction was made: of two of a trial the newer counts"),
    # samples of a trial, one value a sample
    "time_s": _same(_L, "s", "time stamp of the sample"),
    "command": Column(_L, "N", "Nm", "total commanded force before any delay: external step minus wall force"),
    "position": Column(_L, "m", "rad", "measured position"),
    "force": Column(_L, "N", "Nm", "measured force, where the log has one", True, sensed=True),
    "velocity": Column(_L, "m/s", "rad/s", "velocity as logged; no cost or estimate uses it", True),
    "raw_time": _same(_L, "", "time stamp in the source, where it is no whole number and not time_s", True),
    "raw_count": _same(_LI, "", "whole time stamp in the source (a date: without its decimal sign)", True),
    # stages with one row per trial
    "samples_sha256": _same(_S, "", "first 16 digits of the SHA-256 of the conditions and samples behind the row"),
    # response stage
    "verdict": _same(_S, "", "stable, unstable or undecided, from the log alone"),
    "reason": _same(_S, "", "why a value is missing or uncertain; empty where it is neither", True),
    "growth_per_s": _same(_F, "1/s", "growth rate of the slowest visible mode; negative where it decays", True),
    "edge_row": _same(_I, "", "row of the command edge k0, counted from 0", True),
    "position_start": Column(_F, "m", "rad", "position at which the wall rests: the first one"),
    "position_final_expected": Column(_F, "m", "rad", "x_0 + F_0/K (6.1)", True),
    "position_final_measured": Column(_F, "m", "rad", "mean position over the last tenth of the log", True),
    "sensor_quantum": Column(_F, "m", "rad", "smallest change of the position seen in the log", True),
    "sensor_noise": Column(_F, "m", "rad", "standard deviation of the white noise of the position", True),
    # wall_law stage
    "law_residual": _same(_F, "1", "largest departure of the command from the wall law, relative to F_0", True),
    "law_rounding": _same(_F, "1", "what rounding of the printed numbers leaves of it at most", True),
    "law_codes": _same(_S, "", "why it departs: codes of `departures`, comma separated; empty where it does not"),
    "law_evidence": _same(_S, "", "the evidence for them, in words"),
    "law_rows": _same(_I, "", "rows concerned"),
    "obeyed_stiffness": Column(_F, "N/m", "Nm/rad", "stiffness that the command obeys, if not the stated", True),
    "obeyed_damping": Column(_F, "Ns/m", "Nms/rad", "damping of the same wall", True),
    "obeyed_step": Column(_F, "N", "Nm", "step of the same command", True),
    "velocity_filter": _same(_S, "", "filter b(z)/a(z) of the velocity that the log shows, as JSON", True),
    # outcome stage
    "outcome": _same(_S, "", "what happened in the trial, see `outcome.OUTCOMES`"),
    "evidence": _same(_S, "", "the evidence for it, in words"),
    "outcome_row": _same(_I, "", "first row of the evidence, counted from 0", True),
    "band": Column(_F, "m", "rad", "half width of the band about the final position that was used", True),
    "amplitude_end": Column(_F, "m", "rad", "half of peak to peak over the last fifth of the log", True),
    "findings": _same(
        _S, "", "faults of the recording: code, rows, evidence, remedy and severity of each, as JSON", True
    ),
    # model, delay and mass stages
    "first_change_samples": _same(_I, "samples", "integer delay factor by the first position change (6.2, 6.3)", True),
    "model_mass": Column(
        _F, "kg", "kg m^2", "mass of the trial, a step by its own likelihood from the common one", True
    ),
    "model_mass_error": Column(_F, "kg", "kg m^2", "its standard error", True),
    "model_damping": Column(_F, "Ns/m", "Nms/rad", "viscous damping b in the same way", True),
    "model_damping_error": Column(_F, "Ns/m", "Nms/rad", "its standard error", True),
    "model_delay": _same(_F, "samples", "mean delay of the applied command in the same way", True),
    "model_delay_error": _same(_F, "samples", "its standard error", True),
    "mass_momentum": Column(_F, "kg", "kg m^2", "mass by the momentum balance (6.4), biased by b", True),
    "mass_momentum_longer": Column(_F, "kg", "kg m^2", "the same over twice its window", True),
    "mass_momentum_later": Column(_F, "kg", "kg m^2", "the same over the second half of that", True),
    # cost stages
    **{name: column for criterion in MEASURED for name, column in _cost(criterion_of(criterion)).items()},
    "overshoot_floor": _same(_F, "1", "overshoot that sensor and chatter alone can cause"),
    **dict.fromkeys(_BIASES, _same(_F, "1", "what noise and quantum add to the sum, taken off", True)),
    **dict.fromkeys(_TAILS, _same(_F, "1", "part of the cost that lies beyond the horizon, extrapolated", True)),
    "horizon_samples": _same(_I, "samples", "number of samples summed before the noise floor or the end", True),
    # stage of the parts of a device, in units in which its logs are near 1
    "start_names": _same(_LS, "", "numbers of the device that the estimator varies", True),
    "start_values": _same(_L, "", "their values, from which the fit of all trials begins", True),
    "noise_force": _same(_F, "", "variance of the random force over a sample, in that of a reading", True),
    "noise_late": _same(
        _F, "", "variance of the force that jitter makes of a unit command, in that of a reading", True
    ),
    "reading_variance": _same(_F, "", "variance of a reading", True),
    "unit_period": _same(_F, "s", "unit of time of these numbers", True),
    "unit_position": Column(_F, "m", "rad", "unit of position of these numbers", True),
    "unit_command": Column(_F, "N", "Nm", "unit of the command of these numbers", True),
    "origin": Column(_F, "m", "rad", "where a spring is relaxed; none where that is the begin of each log", True),
    "lead_rows": _same(
        _I, "", "number of rows before a segment whose commands may still act in it because of the delay", True
    ),
    "part_names": _same(_LS, "", "parts that some of the trials show or do not exclude", True),
    "part_gains": _same(_L, "1", "gain of cross-validated log-likelihood by each; 0 where undecided", True),
    "assumed": _same(_LS, "", "parameters that are taken as none", True),
    # device stage
    "parameter_names": _same(_LS, "", "parameters of the identified loop by names of `PARAMETERS`, P of them", True),
    "parameter_values": _same(_L, "SI", "their values", True),
    "covariance": _same(_L, "SI", "their covariance, P rows of P numbers", True),
    "parts": _same(_LS, "", "parts of the loop in addition to mass, damper and delay", True),
    "mode_sensor": _same(_S, "", "motor or load: side of a vibration mode at which the position is read", True),
    "unidentifiable": _same(_LS, "", "those of the parameters whose value cannot be identified", True),
    "bound_names": _same(_LS, "", "parameters with an upper end or a second end", True),
    "bound_values": _same(_L, "SI", "these ends", True),
    "scatter_names": _same(_LS, "", "parameters that differ from trial to trial", True),
    "scatter_values": _same(_L, "SI", "their standard deviations between trials", True),
    "fold_values": _same(_L, "SI", "values without each fifth of the trials, five rows of P numbers, or none", True),
    "combination_codes": _same(_LS, "", "combinations of parameters that can be identified where these cannot", True),
    "combination_members": _same(_LS, "", "their parameters, comma separated", True),
    "combination_values": _same(_L, "SI", "value, ends of the 95 % interval and standard error of each", True),
    "combination_units": _same(_LS, "", "dimension, or unit, of each", True),
    "combination_remedies": _same(_LS, "", "what to record to identify each of the parameters", True),
    "jitter": _same(_F, "samples", "standard deviation of the delay within a trial", True),
    "jitter_error": _same(_F, "samples", "its standard error", True),
    "fitted_trials": _same(_LS, "", "trials that the loop was fitted to, in the order of the folds", True),
    "explained": _same(_I, "", "how many of them it explains with its noise", True),
    "fit_percent": _same(_F, "%", "median fit of its free runs to logs that it was not fitted to", True),
    "saturated": _same(_F, "1", "share of the stable trials that command more force than it has", True),
    "largest_command": Column(_F, "N", "Nm", "largest command of these logs", True),
    "largest_step": Column(_F, "N", "Nm", "largest step of these logs", True),
    "travel": Column(_F, "m", "rad", "range of the positions of these logs", True),
    "remedy": _same(_S, "", "what to record to separate parts with similar effects", True),
    # boundary stage
    "stable": Column(_F, "N/m", "Nm/rad", "largest stable stiffness below the smallest unstable one", True),
    "unstable": Column(_F, "N/m", "Nm/rad", "smallest unstable stiffness", True),
    "censored": _same(_B, "", "true where the tested range ended before an unstable trial"),
    "estimate": Column(_F, "N/m", "Nm/rad", "limit of the stiffness by the growth rates", True),
    "low": Column(_F, "N/m", "Nm/rad", "lower end of its 95 % interval", True),
    "high": Column(_F, "N/m", "Nm/rad", "upper end of its 95 % interval", True),
    "trials": _same(_I, "", "trials with K > 0 at that damping"),
    "undecided": _same(_I, "", "undecided ones of them below the largest stable stiffness"),
}

_NAMES = {
    "trials": """
        trial_id label device experiment motion stiffness damping step sampling_period_s added_delay_samples grip
        simulated rows extra time_quality source_path source_sha256 source_trials source_size source_mtime_ns
        profile profile_sha256 claims package_version
        time_s command position force velocity raw_time raw_count""",
    "corrections": """trial_id label device experiment source_path source_sha256 exclusion_reason excluded_since
        moved_device moved_experiment deleted corrected_ns""",
}

TABLES: dict[str, tuple[str, ...]] = {
    **{table: tuple(names.split()) for table, names in _NAMES.items()},
    **{stage: columns_of(stage) for stage in (*ROWS, "boundary")},
}
"""Columns of each table; those of a stage are the fields of its record."""

SAMPLES = ("time_s", "command", "position", "force", "velocity", "raw_time", "raw_count")
"""Columns of the trials table that contain a list of samples in each row."""

LOCATION = ("sample_file", "sample_row")
"""Location at which a trial is stored; added by the reader."""

OF_TRIALS = (*(name for name in TABLES["trials"] if name not in SAMPLES), *LOCATION)
"""Columns of a trial without its samples."""


def unit_of_column(column: Column, motion: Motion) -> str:
    """Return the unit of a stored column for a kind of motion."""
    if drive_of(motion) and not column.sensed:
        return unit_in(column.unit, motion)
    return column.unit_rotation if is_rotation(motion) else column.unit


def arrow_schema(
    table: str, *, motion: Motion = "translation", metadata: Metadata | None = None, also: tuple[str, ...] = ()
) -> pa.Schema:
    """Return the Arrow schema of a stored table with unit and meaning on each field.

    Parameters
    ----------
    table : str
        A key of `TABLES`.
    motion : Motion
        Kind of motion, which determines the units.
    metadata : mapping of str to str, optional
        Provenance that is written into the file.
    also : tuple of str
        Columns that follow those of the table.
    """
    fields = []
    for name in (*TABLES[table], *also):
        column = COLUMNS[name]
        unit = unit_of_column(column, motion)
        fields.append(pa.field(name, column.dtype, column.nullable, metadata={"unit": unit, "meaning": column.meaning}))
    return pa.schema(fields, metadata={"pipeline.table": table, **(metadata or {})})


def to_arrow(
    table: str, columns: Mapping[str, Any], *, motion: Motion = "translation", metadata: Metadata | None = None
) -> pa.Table:
    """Build an Arrow table from arrays or lists, one per column of the dictionary; NaN becomes null if nullable."""
    schema = arrow_schema(table, motion=motion, metadata=metadata)
    arrays = []
    for field in schema:
        values = columns[field.name]
        arrays.append(
            values
            if isinstance(values, (pa.Array, pa.ChunkedArray))
            else pa.array(values, type=field.type, from_pandas=field.nullable)
        )
    return pa.table(arrays, schema=schema)
