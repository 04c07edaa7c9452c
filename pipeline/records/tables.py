"""Dictionary of stored columns. A column has the same Arrow type, unit and meaning in all tables.

Each table is a tuple of column names. `table_files` writes and reads the files of tables.
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
    """Stored column: Arrow type, unit for translation, unit for rotation, meaning, and whether it may be null.

    A ``sensed`` column is in SI even if the commands are in units of a drive.
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
# Parquet assigns this name
_L = pa.list_(pa.field("element", _F))
_LI = pa.list_(pa.field("element", _I))
_LS = pa.list_(pa.field("element", _S))


def _cost(criterion: Criterion) -> dict[str, Column]:
    """Return the columns of the measured cost by a criterion, and of its interval."""
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
    "trial_id": _same(
        _S, "", "first 16 digits of the SHA-256 of the source log, or of this SHA-256 combined with the label"
    ),
    "label": _same(_S, "", "label of the trial, if its source has several trials", True),
    "device": _same(_S, "", "device name as in the log"),
    "experiment": _same(_S, "", "experiment name as in the log"),
    "motion": _same(
        _S,
        "",
        "translation or rotation, followed by the unit of the commands if it is that of a drive; it determines the "
        "other units",
    ),
    "stiffness": Column(_F, "N/m", "Nm/rad", "virtual stiffness K"),
    "damping": Column(_F, "Ns/m", "Nms/rad", "virtual damping B"),
    "step": Column(_F, "N", "Nm", "size of the external force step F_0"),
    "sampling_period_s": _same(_F, "s", "sampling period T"),
    "added_delay_samples": _same(_I, "samples", "delay that was added on purpose"),
    "grip": _same(_S, "", "none, comfortable or firm"),
    "simulated": _same(_B, "", "true if the log states that it was simulated"),
    "rows": _same(_I, "", "number of samples"),
    "extra": _same(_S, "", "metadata of the log without a dedicated column, as JSON"),
    "time_quality": _same(_S, "", "gaps, dropped samples, jitter, and repairs of the rows, as JSON"),
    # origin of the trial
    "source_path": _same(_S, "", "path of the source log at the time of its ingest"),
    "source_sha256": _same(_S, "", "SHA-256 of the source log (of both files, in order, for a pair)"),
    "source_trials": _same(_I, "", "number of trials in the source"),
    "source_size": _same(_I, "byte", "size of the source log"),
    "source_mtime_ns": _same(_I, "ns", "modification time of the source log"),
    "profile": _same(_S, "", "log profile that read the source"),
    "profile_sha256": _same(_S, "", "SHA-256 of the profile"),
    "claims": _same(_S, "", "hash of all profiles that were considered for the source"),
    "package_version": _same(_S, "", "version that stored the trial"),
    "sample_file": _same(_S, "", "file below processed/ with the trial; added by the reader, not stored"),
    "sample_row": _same(_I, "", "row of the trial in sample_file"),
    # corrections
    "exclusion_reason": _same(_S, "", "why the trial is excluded manually; empty if it is used"),
    "excluded_since": _same(_S, "", "time of the exclusion, UTC, ISO 8601"),
    "moved_device": _same(_S, "", "device to which the trial was moved; null for the device of its log", True),
    "moved_experiment": _same(
        _S, "", "experiment to which the trial was moved; null for the experiment of its log", True
    ),
    "deleted": _same(_B, "", "true if the trial is deleted manually"),
    "corrected_ns": _same(_I, "ns", "time of the correction; the newest correction of a trial is valid"),
    # samples of a trial, one value for each sample
    "time_s": _same(_L, "s", "time stamp of the sample"),
    "command": Column(_L, "N", "Nm", "total commanded force before any delay: external step minus wall force"),
    "position": Column(_L, "m", "rad", "measured position"),
    "force": Column(_L, "N", "Nm", "measured force, if the log has it", True, sensed=True),
    "velocity": Column(_L, "m/s", "rad/s", "velocity as logged, not used by costs and estimates", True),
    "raw_time": _same(_L, "", "time stamp in the source, if it is not an integer and differs from time_s", True),
    "raw_count": _same(_LI, "", "integer time stamp in the source (for a date, without its decimal sign)", True),
    # stages with one row for each trial
    "samples_sha256": _same(_S, "", "first 16 digits of the SHA-256 of the trial's conditions and samples"),
    # response stage
    "verdict": _same(_S, "", "stable, unstable or undecided, from the log"),
    "reason": _same(_S, "", "reason why a value is missing or uncertain; empty if there is none", True),
    "growth_per_s": _same(_F, "1/s", "growth rate of the slowest visible mode; negative if the mode decays", True),
    "edge_row": _same(_I, "", "row of the command edge k0, counted from 0", True),
    "position_start": Column(_F, "m", "rad", "rest position of the wall, which is the first position"),
    "position_final_expected": Column(_F, "m", "rad", "x_0 + F_0/K (6.1)", True),
    "position_final_measured": Column(_F, "m", "rad", "mean position over the last tenth of the log", True),
    "sensor_quantum": Column(_F, "m", "rad", "smallest change of the position that occurs in the log", True),
    "sensor_noise": Column(_F, "m", "rad", "standard deviation of the white measurement noise of the position", True),
    # wall_law stage
    "law_residual": _same(_F, "1", "largest deviation of the command from the wall law, relative to F_0", True),
    "law_rounding": _same(_F, "1", "largest part of law_residual that is due to rounding of printed numbers", True),
    "law_codes": _same(_S, "", "codes of the deviations (`departures`), separated by commas; empty if there is none"),
    "law_evidence": _same(_S, "", "sentence with the evidence for law_codes"),
    "law_rows": _same(_I, "", "number of rows with the most frequent of these deviations"),
    "obeyed_stiffness": Column(
        _F,
        "N/m",
        "Nm/rad",
        "stiffness of the wall that the command follows, if this wall differs from the stated wall",
        True,
    ),
    "obeyed_damping": Column(_F, "Ns/m", "Nms/rad", "damping of the wall that the command follows", True),
    "obeyed_step": Column(_F, "N", "Nm", "step that the command follows", True),
    "velocity_filter": _same(_S, "", "filter b(z)/a(z) of the velocity, as identified from the log, as JSON", True),
    # outcome stage
    "outcome": _same(_S, "", "outcome of the trial, see `outcome.OUTCOMES`"),
    "evidence": _same(_S, "", "sentence with the evidence for the outcome"),
    "outcome_row": _same(_I, "", "first row of the evidence, counted from 0", True),
    "band": Column(_F, "m", "rad", "half-width of the band about the final position", True),
    "amplitude_end": Column(_F, "m", "rad", "half the range of positions over the last fifth of the log", True),
    "findings": _same(
        _S, "", "faults of the recording: code, rows, evidence, remedy and severity of each, as JSON", True
    ),
    # model, delay and mass stages
    "first_change_samples": _same(_I, "samples", "integer delay factor by the first position change (6.2, 6.3)", True),
    "model_mass": Column(
        _F, "kg", "kg m^2", "mass of the trial, by one Newton step of the likelihood from the common value", True
    ),
    "model_mass_error": Column(_F, "kg", "kg m^2", "standard error of model_mass", True),
    "model_damping": Column(_F, "Ns/m", "Nms/rad", "viscous damping b, estimated like model_mass", True),
    "model_damping_error": Column(_F, "Ns/m", "Nms/rad", "standard error of model_damping", True),
    "model_delay": _same(_F, "samples", "mean delay of the applied command, estimated like model_mass", True),
    "model_delay_error": _same(_F, "samples", "standard error of model_delay", True),
    "mass_momentum": Column(_F, "kg", "kg m^2", "mass from the momentum balance (6.4), biased by b", True),
    "mass_momentum_longer": Column(_F, "kg", "kg m^2", "mass_momentum over a window that is twice as long", True),
    "mass_momentum_later": Column(_F, "kg", "kg m^2", "mass_momentum over the second half of the longer window", True),
    # cost stages
    **{name: column for criterion in MEASURED for name, column in _cost(criterion_of(criterion)).items()},
    "overshoot_floor": _same(_F, "1", "overshoot that can be caused by the sensor and chatter alone"),
    **dict.fromkeys(
        _BIASES, _same(_F, "1", "part of the sum that is due to noise and resolution, and is subtracted", True)
    ),
    **dict.fromkeys(_TAILS, _same(_F, "1", "extrapolated part of the cost beyond the horizon", True)),
    "horizon_samples": _same(_I, "samples", "number of summed samples, up to the noise floor or the end", True),
    # stage of the parts of a device, in units in which the numbers of its logs are near 1
    "start_names": _same(_LS, "", "names of the parameters that the estimator varies", True),
    "start_values": _same(_L, "", "values of start_names at the start of the fit to all trials", True),
    "noise_force": _same(
        _F, "", "variance of the random force over a sample, relative to the variance of a reading", True
    ),
    "noise_late": _same(
        _F, "", "variance of the force due to jitter of a unit command, relative to the variance of a reading", True
    ),
    "reading_variance": _same(_F, "", "variance of a reading of the position", True),
    "unit_period": _same(_F, "s", "unit of time of the numbers in this table", True),
    "unit_position": Column(_F, "m", "rad", "unit of position of the numbers in this table", True),
    "unit_command": Column(_F, "N", "Nm", "unit of the command of the numbers in this table", True),
    "origin": Column(_F, "m", "rad", "rest position of a spring; null if it is the start of each log", True),
    "lead_rows": _same(
        _I, "", "number of rows before a segment whose commands may still act in the segment, due to the delay", True
    ),
    "part_names": _same(_LS, "", "parts that some of the trials show or do not exclude", True),
    "part_gains": _same(_L, "1", "gain of the cross-validated log-likelihood due to each part; 0 if undecided", True),
    "assumed": _same(_LS, "", "parameters that are assumed to be zero", True),
    "free_run_filter": _same(
        _L, "", "filter that whitens the errors of free runs; empty if no free runs are used", True
    ),
    "open_parts": _same(
        _LS, "", "parts of the drive that are required by left-out logs but not confirmed by free runs", True
    ),
    # device stage
    "parameter_names": _same(_LS, "", "names in `PARAMETERS` of the P parameters of the identified loop", True),
    "parameter_values": _same(_L, "SI", "values of parameter_names", True),
    "covariance": _same(_L, "SI", "covariance of parameter_values, P rows of P numbers", True),
    "parts": _same(_LS, "", "parts of the loop in addition to mass, damper and delay", True),
    "mode_sensor": _same(_S, "", "motor or load: side of the vibration mode with the position sensor", True),
    "unidentifiable": _same(_LS, "", "parameters that are not identifiable", True),
    "bound_names": _same(_LS, "", "parameters with an upper bound, or with a second bound of their interval", True),
    "bound_values": _same(_L, "SI", "the ends of bound_names", True),
    "scatter_names": _same(_LS, "", "parameters that differ between trials", True),
    "scatter_values": _same(_L, "SI", "standard deviations of scatter_names between trials", True),
    "fold_values": _same(
        _L, "SI", "values estimated without each fifth of the trials (five rows of P numbers), or none", True
    ),
    "combination_codes": _same(_LS, "", "identifiable combinations of inseparable parameters", True),
    "combination_members": _same(_LS, "", "parameters of each combination, separated by commas", True),
    "combination_values": _same(
        _L, "SI", "value, ends of the 95 % interval and standard error of each combination", True
    ),
    "combination_units": _same(_LS, "", "dimension or unit of each combination", True),
    "combination_remedies": _same(_LS, "", "recordings that would identify the parameters of each combination", True),
    "jitter": _same(_F, "samples", "standard deviation of the delay within a trial", True),
    "jitter_error": _same(_F, "samples", "standard error of jitter", True),
    "fitted_trials": _same(_LS, "", "trials to which the loop was fitted, in the order of the folds", True),
    "explained": _same(_I, "", "number of the fitted trials that the loop explains with its noise", True),
    "fit_percent": _same(_F, "%", "median fit of free runs of the loop to logs that were left out of its fit", True),
    "saturated": _same(_F, "1", "share of the stable trials whose command exceeds the largest force", True),
    "largest_command": Column(_F, "N", "Nm", "largest command of the logs", True),
    "largest_step": Column(_F, "N", "Nm", "largest step of the logs", True),
    "travel": Column(_F, "m", "rad", "range of the positions of the logs", True),
    "remedy": _same(_S, "", "recordings that would separate parts with similar effects", True),
    # boundary stage
    "stable": Column(_F, "N/m", "Nm/rad", "largest stable stiffness below the smallest unstable stiffness", True),
    "unstable": Column(_F, "N/m", "Nm/rad", "smallest unstable stiffness", True),
    "censored": _same(_B, "", "true if the tested range ended without an unstable trial"),
    "estimate": Column(_F, "N/m", "Nm/rad", "largest stable stiffness, estimated from the growth rates", True),
    "low": Column(_F, "N/m", "Nm/rad", "lower end of the 95 % interval of the limit", True),
    "high": Column(_F, "N/m", "Nm/rad", "upper end of the 95 % interval of the limit", True),
    "trials": _same(_I, "", "number of trials with K > 0 at this damping"),
    "undecided": _same(_I, "", "number of undecided trials at this damping below the largest stable stiffness"),
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
"""Columns of each table. The columns of a stage are the fields of its record."""

SIGNALS = ("time_s", "command", "position", "force", "velocity")
"""Columns of the samples of a response. The last two may be missing from a log."""

SAMPLES = (*SIGNALS, "raw_time", "raw_count")
"""Columns of the trials table that contain a list of samples in each row."""

LOCATION = ("sample_file", "sample_row")
"""Location at which a trial is stored. The reader adds these columns."""

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
    """Return the Arrow schema of a stored table, with unit and meaning in the metadata of each field.

    Parameters
    ----------
    table : str
        A key of `TABLES`.
    motion : Motion
        Kind of motion, which determines the units.
    metadata : mapping of str to str, optional
        Provenance that is written into the file.
    also : tuple of str
        Columns that follow the columns of the table.
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
    """Build an Arrow table from arrays or lists, one for each column. NaN becomes null in nullable columns."""
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
