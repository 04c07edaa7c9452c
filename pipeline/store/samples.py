"""Samples of stored trials as arrays: one batch, or groups of like length.

Batches of files may be merged while samples are read: where a file is gone, its trials are looked up anew.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa

from pipeline.base.errors import REMEDY, StoreError
from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch
from pipeline.records.groups import TrialGroups, group_trials, padded_length
from pipeline.records.table_files import open_table
from pipeline.store.storage import ATTEMPTS, read_trials
from pipeline.store.working_copy import bring

_OPTIONAL = ("force", "velocity")
"""Columns of samples that a log may lack."""

_SAMPLES = ("time_s", "command", "position", *_OPTIONAL)


Length = Callable[[Integers], int]


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
        If a samples file is missing or shorter than its trials say, or a trial was removed meanwhile.
    """
    return _load(processed, in_order(trials), [np.arange(trials.num_rows)], lambda rows: rows.max(initial=0))[0]


def load_groups(processed: Path, trials: pa.Table) -> TrialGroups:
    """Read the samples of trials in groups of like length; parameters and errors as those of `load_batch`."""
    trials = in_order(trials)
    places = group_trials(trials.column("rows").to_numpy())
    return TrialGroups(tuple(places), tuple(_load(processed, trials, places, lambda rows: padded_length(rows)[0])))


def in_order(trials: pa.Table) -> pa.Table:
    """Return the rows of a trials table by damping, stiffness and trial id."""
    return trials.sort_by([("damping", "ascending"), ("stiffness", "ascending"), ("trial_id", "ascending")])


def _load(processed: Path, trials: pa.Table, places: list[Integers], length: Length) -> list[TrialBatch]:
    """Read the trials at some places into a batch each, of the length that their rows have."""
    for _ in range(ATTEMPTS):
        bring(processed, set(trials.column("sample_file").to_pylist()))
        try:
            return _read_samples(processed, trials, places, length)
        except StoreError:
            files = sorted(set(trials.column("sample_file").to_pylist()))
            missing = next((processed / file for file in files if not (processed / file).is_file()), None)
            if missing is None:
                raise
        located = _located(processed, trials)
        if located.equals(trials):
            raise StoreError(f"{missing}: samples file is missing, but its trials are stored. {REMEDY}")
        trials = located
    raise StoreError(f"{processed}: samples were moved during each of {ATTEMPTS} attempts to read them.")


def _read_samples(processed: Path, trials: pa.Table, places: list[Integers], length: Length) -> list[TrialBatch]:
    file = np.array(trials.column("sample_file").to_pylist(), dtype=np.str_)
    first, rows = (trials.column(name).to_numpy().astype(np.int64) for name in ("first_row", "rows"))
    # a file after the other and a column after the other: beside the result, one column of one file is in memory
    samples: list[dict[str, Floats]] = [{} for _ in places]
    for name in np.unique(file).tolist():
        inside = [place[file[place] == name] for place in places]
        with open_table(processed / name) as stored:
            for column in _SAMPLES:
                values = stored.read([column]).column(0)
                if values.null_count == len(values) and column in _OPTIONAL:
                    continue
                if any((first[of] + rows[of] > len(values)).any() for of in inside):
                    raise StoreError(f"{processed / name}: is shorter than its trials say. {REMEDY}")
                read = values.to_numpy()
                for of, place, found in zip(inside, places, samples, strict=True):
                    if len(of):
                        wide = found.setdefault(column, np.full((len(place), int(length(rows[place]))), np.nan))
                        for row, at in zip(np.searchsorted(place, of).tolist(), of.tolist(), strict=True):
                            wide[row, : rows[at]] = read[first[at] : first[at] + rows[at]]
    return [_batch(trials.take(place), found) for place, found in zip(places, samples, strict=True)]


def _batch(trials: pa.Table, samples: dict[str, Floats]) -> TrialBatch:
    nothing = np.empty((0, 0))
    present = {name: None if np.isnan(samples.get(name, nothing)).all() else samples[name] for name in _OPTIONAL}
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
        step_row=_declared_step_rows(trials.column("extra").to_pylist()),
        integrated=_integrated(trials.column("extra").to_pylist()),
    )


def _located(processed: Path, trials: pa.Table) -> pa.Table:
    """Return trials with the present place of their samples, which a merge of batches may have moved."""
    keys = ("source_path", "trial_id", "profile_sha256")
    present = read_trials(processed, columns=[*keys, "sample_file", "first_row"]).to_pydict()
    places = dict(
        zip(
            zip(*(present[key] for key in keys), strict=True),
            zip(present["sample_file"], present["first_row"], strict=True),
            strict=True,
        )
    )
    wanted = list(zip(*(trials.column(key).to_pylist() for key in keys), strict=True))
    gone = [key for key in wanted if key not in places]
    if gone:
        raise StoreError(
            f"{processed}: {len(gone)} trials were removed while they were read, the first of {gone[0][0]}: "
            "their source changed. Run the command again."
        )
    moved = {
        "sample_file": pa.array([places[key][0] for key in wanted]),
        "first_row": pa.array([places[key][1] for key in wanted], pa.int64()),
    }
    for name, values in moved.items():
        index = trials.schema.get_field_index(name)
        trials = trials.set_column(index, trials.schema.field(index), values)
    return trials


def _declared_step_rows(extra: list[str]) -> Integers | None:
    """Rows of the command edge that profiles or logs declare (``step_row``), -1 for the others."""
    declared = [json.loads(text).get("step_row") if "step_row" in text else None for text in extra]
    if not any(declared):
        return None
    return np.array([-1 if row is None else int(row) for row in declared], dtype=np.int64)


def _integrated(extra: list[str]) -> Booleans | None:
    """Whether positions are integrals of a velocity by the trapezoidal rule."""
    found = np.array(["integrated" in text and json.loads(text).get("integrated") == "trapezoid" for text in extra])
    return found if found.any() else None
