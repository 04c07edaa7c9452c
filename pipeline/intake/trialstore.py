"""Writes accepted logs to `processed/`: a file for each experiment, group by group, visible when it is whole."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from pipeline import __version__
from pipeline.base.disk import each, readers_of
from pipeline.base.provenance import sha256 as hash_of
from pipeline.intake.reading import motion_of
from pipeline.intake.sources import Source, told_by_name
from pipeline.profiles.profile_model import Profile
from pipeline.readers import Log
from pipeline.readers.obeyed import cure, obeyed
from pipeline.readers.time_axis import step_flags
from pipeline.records.batch import Floats, Integers
from pipeline.records.models import Motion
from pipeline.records.tables import to_arrow
from pipeline.store.batch_files import GROUP_BYTES, GROUP_TRIALS, NewBatch
from pipeline.store.mirror import publish

OTHER_GAINS = "other_gains"
"""Key in ``extra`` of a trial whose command obeys other gains than its header says: which, and what cures it."""

OPEN_FILES = 8
"""Files that are written at once: each recording may be an experiment of its own, and open files are few."""


@dataclass(frozen=True, eq=False)
class Accepted:
    """A checked log with its identity, its motion, and the profile that read it; the columns of its row but samples."""

    source: Source
    log: Log
    motion: Motion
    row: dict[str, Any]

    @property
    def bytes(self) -> int:
        """Memory of the samples [byte]."""
        log = self.log
        columns = (log.time, log.command, log.position, log.force, log.velocity, log.raw_time)
        return sum(values.nbytes for values in columns if values is not None)


def accepted_logs(
    source: Source, sha256: str, logs: Sequence[Log], profile: Profile, profile_sha256: str, known: Mapping[str, Motion]
) -> list[Accepted]:
    """Return the trials of a source that was read; `known` is the motion of each device that has a device file.

    Raises
    ------
    LogError
        If a log cannot be stored (`reading.motion_of`).
    """
    told = told_by_name(profile, source.path)
    return [
        Accepted(
            source,
            log,
            motion := motion_of(log, known),
            {
                "trial_id": trial_id(sha256, log.label, told),
                "source_sha256": sha256,
                "source_trials": len(logs),
                "profile": profile.name,
                "profile_sha256": profile_sha256,
                "motion": motion,
                "formerly": None,
            },
        )
        for log in (_marked(profile, log) for log in logs)
    ]


def _marked(profile: Profile, log: Log) -> Log:
    """Return a log with a mark and a warning where its command obeys other gains than its header says."""
    if (found := obeyed(log)) is None:
        return log
    text = f"{found.sentence}. To cure it: {cure(profile, found)}"
    header = replace(log.header, extra=log.header.extra | {OTHER_GAINS: text})
    return replace(log, header=header, warnings=(*log.warnings, text))


class TrialWriter:
    """Collects accepted logs and writes them as one batch per device, experiment, motion and who may read them.

    Samples go to disk group by group, so that memory does not grow with a batch. The file of a batch is opened for its
    first group: logs of thousands of experiments wait in memory, of which `limit` is the bound, and not in as many open
    files.

    Parameters
    ----------
    processed : Path
    limit : int
        Bytes of samples after which what was collected is made visible: what an interruption may cost.
    claims : str
        As for `known.StoredSources`.
    latest : int
        Highest version that is stored.
    """

    def __init__(self, processed: Path, limit: int, claims: str, latest: int) -> None:
        self.processed, self.limit = processed, limit
        self._common = {"claims": claims, "version": latest + 1}
        self._batches: dict[tuple[str, str, Motion, int], _Batch] = {}
        self._sources: list[Source] = []
        self._bytes = 0
        self.folders: set[Path] = set()
        """Folders of all that was made visible."""
        self.visible: set[str] = set()
        """Paths of the sources of trials that were made visible."""

    def add(self, accepted: Sequence[Accepted]) -> list[Source]:
        """Take the logs of one more source; return the sources that became visible because the limit was reached."""
        for one in accepted:
            header = one.log.header
            key = header.device, header.experiment, one.motion, readers_of(one.source.mode)
            if key not in self._batches:
                self._batches[key] = _Batch((self.processed, *key), self._common)
            self._batches[key].add(one)
            self._bytes += one.bytes
        self._sources += [one.source for one in accepted]
        return self.flush() if self._bytes >= self.limit else []

    def flush(self) -> list[Source]:
        """Make all that was collected visible and return its sources; after an error all that is stored is valid."""
        batches = list(self._batches.values())
        for start in range(0, len(batches), OPEN_FILES):
            some = batches[start : start + OPEN_FILES]
            for batch in some:  # one after the other: the name of a folder depends on those that are there
                batch.write_pending()
            self.folders.update(path.parent for path in each(_Batch.publish, some))
        self._batches.clear()
        publish(self.processed)
        sources, self._sources, self._bytes = self._sources, [], 0
        self.visible.update(source.key for source in sources)
        return sources

    def discard(self) -> None:
        """Remove what was not made visible."""
        for batch in self._batches.values():
            if batch.file is not None:
                batch.file.discard()


class _Batch:
    """Logs of one experiment on their way into a file."""

    def __init__(self, place: tuple[Path, str, str, Motion, int], common: Mapping[str, Any]) -> None:
        self.place, self.common = place, common
        self.file: NewBatch | None = None
        self.pending: list[Accepted] = []
        self.bytes = 0

    def add(self, accepted: Accepted) -> None:
        if len(self.pending) >= GROUP_TRIALS or self.bytes + accepted.bytes > GROUP_BYTES:
            self.write_pending()
        self.pending.append(accepted)
        self.bytes += accepted.bytes

    def write_pending(self) -> None:
        if self.pending:
            self.file = self.file or NewBatch(*self.place)
            self.file.write(_table(self.pending, self.file.schema, self.common))
        self.pending, self.bytes = [], 0

    def publish(self) -> Path:
        """Make all that was written visible."""
        assert self.file is not None, "a batch is made for a log, and written before"
        return self.file.publish()


def _table(members: Sequence[Accepted], schema: pa.Schema, common: Mapping[str, Any]) -> pa.Table:
    """Return the trials table of some logs."""
    logs = [member.log for member in members]
    rows = np.array([len(log.time) for log in logs], dtype=np.int64)
    period = np.array([log.header.sampling_period_s for log in logs], dtype=np.float64)
    flags = step_flags(np.concatenate([log.time for log in logs]), rows, period)
    trials = [_trial(member, flag, common) for member, flag in zip(members, flags, strict=True)]
    samples: dict[str, Sequence[Any]] = {
        "time_s": [log.time for log in logs],
        "command": [log.command for log in logs],
        "position": [log.position for log in logs],
        "force": [log.force for log in logs],
        "velocity": [log.velocity for log in logs],
        "raw_time": [_raw(log, "f") for log in logs],
        "raw_count": [_raw(log, "i") for log in logs],
    }
    columns: dict[str, Any] = {name: [trial[name] for trial in trials] for name in trials[0]}
    columns |= {name: _lists(values, schema.field(name).type) for name, values in samples.items()}
    return to_arrow("trials", columns, rotation=members[0].motion == "rotation")


def _trial(accepted: Accepted, flags: Mapping[str, Any], common: Mapping[str, Any]) -> dict[str, Any]:
    """Return the row of a log in the trials table, but its samples."""
    log, source = accepted.log, accepted.source
    header = log.header
    plain = ("device", "experiment", "stiffness", "damping", "step", "sampling_period_s")
    return {
        **{key: getattr(header, key) for key in (*plain, "added_delay_samples", "grip", "simulated")},
        **accepted.row,
        **common,
        "label": log.label,
        "rows": len(log.time),
        "extra": json.dumps(header.extra, sort_keys=True, ensure_ascii=False) if header.extra else "{}",
        "time_quality": json.dumps({**flags, **log.counts}),
        "source_path": source.key,
        "source_size": source.size,
        "source_mtime_ns": source.mtime_ns,
        "package_version": __version__,
    }


def _raw(log: Log, kind: str) -> Floats | Integers | None:
    """Return the time stamps of the file where they are numbers of a kind: "f" with a fraction, "i" whole."""
    return log.raw_time if log.raw_time is not None and log.raw_time.dtype.kind == kind else None


def _lists(columns: Sequence[Floats | Integers | None], dtype: pa.DataType) -> pa.Array:
    """Return samples as a column of lists; null for a log that has none."""
    there = [values for values in columns if values is not None]
    if not there:
        return pa.nulls(len(columns), dtype)
    edges = np.cumsum([0, *(0 if values is None else len(values) for values in columns)], dtype=np.int32)
    missing = np.array([values is None for values in columns])
    mask = pa.array(missing) if missing.any() else None
    return pa.ListArray.from_arrays(pa.array(edges), pa.array(np.concatenate(there)), type=dtype, mask=mask)


def trial_id(sha256: str, label: str | None, told: str | None = None) -> str:
    """Return the id of a trial: of its source, with its label where the source holds several.

    Parameters
    ----------
    sha256 : str
        Of the source, 64 hexadecimal digits.
    label : str or None
        Which trial of the source it is.
    told : str, optional
        What is read from the name of the file: under a name that tells otherwise the same samples are another trial.
    """
    parts = [part for part in (label, told) if part is not None]
    # neither label nor name holds a NUL
    return hash_of((sha256 + "\0".join(parts)).encode())[:16] if parts else sha256[:16]
