"""Samples of stored trials as arrays: one batch, or groups of like length.

Files may be merged while samples are read: where one is gone, its trials are looked up anew.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa

from pipeline.base.errors import StoreError
from pipeline.records.batch import Floats, Integers, TrialBatch, TrialGroups, group_trials, padded_length
from pipeline.records.table_files import damaged_file
from pipeline.records.tables import LOCATION, OF_TRIALS
from pipeline.store.storage import ATTEMPTS, read_trials, row_parts

_OPTIONAL = ("force", "velocity")
"""Columns of samples that a log may lack."""

_SAMPLES = ("time_s", "command", "position", *_OPTIONAL)


def load_batch(processed: Path, trials: pa.Table) -> TrialBatch:
    """Read the samples of trials into padded arrays, ordered by damping, stiffness and trial id.

    One long trial makes all as long: `load_groups` reads any trials in what they need.

    Parameters
    ----------
    processed : Path
    trials : pyarrow.Table
        Rows of the trials table, as `read_trials` returns them.

    Raises
    ------
    StoreError
        If a file is missing or damaged, or a trial was removed meanwhile.
    """
    lengths = trials.column("rows").to_numpy()
    return _load(processed, in_order(trials), [np.arange(len(lengths))], [lengths.max(initial=0)])[0]


def load_groups(processed: Path, trials: pa.Table) -> TrialGroups:
    """Read the samples of trials in groups of like length; parameters and errors as those of `load_batch`."""
    trials = in_order(trials)
    rows = trials.column("rows").to_numpy()
    places = group_trials(rows)
    return TrialGroups(
        tuple(places), tuple(_load(processed, trials, places, [padded_length(rows[place])[0] for place in places]))
    )


def load_trial(processed: Path, trial: str, file: str, row: int) -> tuple[pa.Table, TrialBatch] | None:
    """Return a trial and its samples by where it was stored a moment ago; None where it is there no more."""
    names = [*(name for name in OF_TRIALS if name not in LOCATION), *_SAMPLES]
    try:
        ((_, table),) = row_parts(processed / file, np.array([row]), names)
    except (FileNotFoundError, ValueError):
        return None
    if table.column("trial_id").to_pylist() != [trial]:
        return None
    found = {name: values[None, :] for name in _SAMPLES for values in _lists(table, name) if values is not None}
    return table, _batch(table, found)


def in_order(trials: pa.Table) -> pa.Table:
    """Return the rows of a trials table by damping, stiffness and trial id."""
    return trials.sort_by([("damping", "ascending"), ("stiffness", "ascending"), ("trial_id", "ascending")])


def _load(processed: Path, trials: pa.Table, places: list[Integers], lengths: list[int]) -> list[TrialBatch]:
    """Read the trials at some places into a batch each, of so many samples."""
    for _ in range(ATTEMPTS):
        try:
            return _read_samples(processed, trials, places, lengths)
        except FileNotFoundError:
            trials = _located(processed, trials)
    raise StoreError(f"{processed}: samples were moved during each of {ATTEMPTS} attempts to read them.")


def _read_samples(processed: Path, trials: pa.Table, places: list[Integers], lengths: list[int]) -> list[TrialBatch]:
    file = np.array(trials.column("sample_file").to_pylist(), dtype=np.str_)
    at, rows = (trials.column(name).to_numpy().astype(np.int64) for name in ("sample_row", "rows"))
    where = {int(one): (group, i) for group, place in enumerate(places) for i, one in enumerate(place)}
    samples: list[dict[str, Floats]] = [{} for _ in places]
    for name in np.unique(file).tolist():
        own = np.flatnonzero(file == name)
        for which, part in row_parts(processed / name, at[own], list(_SAMPLES)):
            for column in _SAMPLES:
                for one, values in zip(own[which].tolist(), _lists(part, column), strict=True):
                    if values is None:
                        continue
                    if len(values) != rows[one]:
                        raise damaged_file(processed / name, "a trial has more or fewer samples than it says")
                    group, row = where[one]
                    if column not in samples[group]:
                        samples[group][column] = np.full((len(places[group]), lengths[group]), np.nan)
                    samples[group][column][row, : len(values)] = values
    return [_batch(trials.take(place), found) for place, found in zip(places, samples, strict=True)]


def _lists(table: pa.Table, column: str) -> Iterator[Floats | None]:
    """Yield the samples of each trial; None where it has none of the column."""
    for chunk in table.column(column).chunks:
        values, edges = chunk.values.to_numpy(zero_copy_only=False), chunk.offsets.to_numpy().tolist()
        for there, (begin, end) in zip(chunk.is_valid().to_pylist(), pairwise(edges), strict=True):
            yield values[begin:end] if there else None


def _batch(trials: pa.Table, samples: dict[str, Floats]) -> TrialBatch:
    nothing = np.empty((0, 0))
    present = {name: None if np.isnan(samples.get(name, nothing)).all() else samples[name] for name in _OPTIONAL}
    extra = [json.loads(text) for text in trials.column("extra").to_pylist()]
    declared = [told.get("step_row") for told in extra]
    integrated = np.array([told.get("integrated") == "trapezoid" for told in extra])
    return TrialBatch(
        trial_id=tuple(trials.column("trial_id").to_pylist()),
        stiffness=trials.column("stiffness").to_numpy(),
        damping=trials.column("damping").to_numpy(),
        step=trials.column("step").to_numpy(),
        sampling_period_s=trials.column("sampling_period_s").to_numpy(),
        rows=trials.column("rows").to_numpy().astype(np.int64),
        time=samples.get("time_s", nothing),
        command=samples.get("command", nothing),
        position=samples.get("position", nothing),
        **present,
        step_row=np.array([-1 if row is None else int(row) for row in declared]) if any(declared) else None,
        integrated=integrated if integrated.any() else None,
    )


def _located(processed: Path, trials: pa.Table) -> pa.Table:
    """Return trials with the present place of their samples, which a merge of batches may have moved."""
    keys = ("trial_id", "profile_sha256")
    present = read_trials(processed, columns=[*keys, *LOCATION])
    places = {key: at for at, key in enumerate(zip(*(present.column(key).to_pylist() for key in keys), strict=True))}
    wanted = list(zip(*(trials.column(key).to_pylist() for key in keys), strict=True))
    gone = [key for key in wanted if key not in places]
    if gone:
        raise StoreError(
            f"{processed}: {len(gone)} trials were removed while they were read, the first {gone[0][0]}: "
            "their source changed. Run the command again."
        )
    present = present.take([places[key] for key in wanted])
    for name in LOCATION:
        trials = trials.set_column(trials.schema.get_field_index(name), trials.schema.field(name), present.column(name))
    return trials
