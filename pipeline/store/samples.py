"""Functions that read samples of stored trials as `Trials`.

Files may be merged while samples are read. If a file no longer exists, its trials are looked up again.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa

from pipeline.base.errors import StoreError
from pipeline.base.json_object import JsonObject
from pipeline.records.table_files import damaged_file
from pipeline.records.tables import LOCATION, OF_TRIALS, SIGNALS
from pipeline.records.trials import NO_STEP_ROW, Floats, Trial, Trials, common_motion
from pipeline.store.storage import ATTEMPTS, read_trials, row_parts


def load_trials(processed: Path, trials: pa.Table) -> Trials:
    """Read the samples of trials, and order the trials by damping, stiffness and trial id.

    Parameters
    ----------
    processed : Path
    trials : pyarrow.Table
        Rows of the trials table, as returned by `read_trials`.

    Raises
    ------
    StoreError
        If a file is missing or damaged, or a trial was removed in the meantime.
    """
    trials = in_order(trials)
    for _ in range(ATTEMPTS):
        try:
            return _read_samples(processed, trials)
        except FileNotFoundError:
            trials = _located(processed, trials)
    raise StoreError(f"{processed}: samples were moved during each of {ATTEMPTS} attempts to read them.")


def load_trial(processed: Path, trial: str, file: str, row: int) -> tuple[pa.Table, Trial] | None:
    """Return a trial and its samples from its last known file and row, or None if the trial is no longer there."""
    names = [*(name for name in OF_TRIALS if name not in LOCATION), *SIGNALS]
    try:
        ((_, table),) = row_parts(processed / file, np.array([row]), names)
    except (FileNotFoundError, ValueError):
        return None
    if table.column("trial_id").to_pylist() != [trial]:
        return None
    samples = {name: values.copy() for name in SIGNALS for values in _lists(table, name) if values is not None}
    return table, _trials(table, samples)[0]


def in_order(trials: pa.Table) -> pa.Table:
    """Return the rows of a trials table, sorted by damping, stiffness and trial id."""
    return trials.sort_by([("damping", "ascending"), ("stiffness", "ascending"), ("trial_id", "ascending")])


def _read_samples(processed: Path, trials: pa.Table) -> Trials:
    file = np.array(trials.column("sample_file").to_pylist(), dtype=np.str_)
    at = trials.column("sample_row").to_numpy().astype(np.int64)
    offsets = _offsets(trials).tolist()
    samples: dict[str, Floats] = {}
    for name in np.unique(file).tolist():
        own = np.flatnonzero(file == name)
        for which, part in row_parts(processed / name, at[own], list(SIGNALS)):
            for column in SIGNALS:
                for place, values in zip(own[which].tolist(), _lists(part, column), strict=True):
                    if values is None:
                        continue
                    first, end = offsets[place : place + 2]
                    if len(values) != end - first:
                        raise damaged_file(processed / name, "a trial has more or fewer samples than rows")
                    if column not in samples:
                        samples[column] = np.full(offsets[-1], np.nan)
                    samples[column][first:end] = values
    return _trials(trials, samples)


def _offsets(trials: pa.Table) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    return np.concatenate([[0], np.cumsum(trials.column("rows").to_numpy())]).astype(np.int64)


def _lists(table: pa.Table, column: str) -> Iterator[Floats | None]:
    """Yield the samples of each trial, or None for a trial without this column."""
    for chunk in table.column(column).chunks:
        values, edges = chunk.values.to_numpy(zero_copy_only=False), chunk.offsets.to_numpy().tolist()
        for there, (begin, end) in zip(chunk.is_valid().to_pylist(), pairwise(edges), strict=True):
            yield values[begin:end] if there else None


def _trials(table: pa.Table, samples: dict[str, Floats]) -> Trials:
    """Return trials from rows of their table, with all samples in flat arrays."""
    extra: list[JsonObject] = [json.loads(text) for text in table.column("extra").to_pylist()]
    declared = [metadata.get("step_row") for metadata in extra]
    integrated = np.array([metadata.get("integrated") == "trapezoid" for metadata in extra], dtype=np.bool_)
    nothing = np.empty(0)
    rows = np.array([NO_STEP_ROW if row is None else int(row) for row in declared], dtype=np.int64)
    force, velocity = (samples.get(name) for name in SIGNALS[3:])
    return Trials(
        trial_id=tuple(table.column("trial_id").to_pylist()),
        **{name: table.column(name).to_numpy() for name in ("stiffness", "damping", "step", "sampling_period_s")},
        offsets=_offsets(table),
        time=samples.get("time_s", nothing),
        command=samples.get("command", nothing),
        position=samples.get("position", nothing),
        force=None if force is None or np.isnan(force).all() else force,
        velocity=None if velocity is None or np.isnan(velocity).all() else velocity,
        step_row=rows if (rows != NO_STEP_ROW).any() else None,
        integrated=integrated if integrated.any() else None,
        motion=common_motion(table.column("motion").to_pylist()) if "motion" in table.column_names else None,
    )


def _located(processed: Path, trials: pa.Table) -> pa.Table:
    """Return trials with the current file and row of their samples, which a merge of batches may have changed."""
    keys = ("trial_id", "profile_sha256")
    present = read_trials(processed, columns=[*keys, *LOCATION])
    places = {key: at for at, key in enumerate(zip(*(present.column(key).to_pylist() for key in keys), strict=True))}
    wanted = list(zip(*(trials.column(key).to_pylist() for key in keys), strict=True))
    gone = [key for key in wanted if key not in places]
    if gone:
        raise StoreError(
            f"{processed}: {len(gone)} trials were removed while they were read, because their logs changed. The first "
            f"is {gone[0][0]}. Run the command again."
        )
    present = present.take([places[key] for key in wanted])
    for name in LOCATION:
        trials = trials.set_column(trials.schema.get_field_index(name), trials.schema.field(name), present.column(name))
    return trials
