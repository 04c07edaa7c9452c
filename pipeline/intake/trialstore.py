"""Writes accepted logs to `processed/`: samples first, then the trials file that makes them visible."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass, replace
from itertools import count, islice
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from pipeline import __version__
from pipeline.base.disk import make_folders
from pipeline.base.file_names import path_text
from pipeline.base.provenance import sha256 as hash_of
from pipeline.intake.reading import motion_of
from pipeline.intake.sources import Source
from pipeline.profiles.profile_model import Profile
from pipeline.readers import Log
from pipeline.readers.obeyed import cure, obeyed
from pipeline.readers.time_axis import step_flags
from pipeline.records.batch import Floats, Integers
from pipeline.records.models import Motion
from pipeline.records.table_files import GROUP_ROWS
from pipeline.records.tables import to_arrow
from pipeline.store.batch_files import NewBatch, next_number, publish_batches
from pipeline.store.storage import FORMERLY, samples_folder, trials_folder
from pipeline.store.working_copy import publish

OTHER_GAINS = "other_gains"
"""Key in ``extra`` of a trial whose command obeys other gains than its header says: which, and what cures it."""

PUBLISHED_TOGETHER = 8
"""Batches that become visible at once, with two open files each: their syncs take the time of one."""


@dataclass(frozen=True, eq=False)
class Accepted:
    """A checked log with its identity, its motion, and the hash of the profile that read it.

    ``siblings`` is the number of trials that its source holds, this one included.
    """

    trial_id: str
    sha256: str
    source: Source
    log: Log
    motion: Motion
    profile: str
    profile_sha256: str
    siblings: int = 1

    @property
    def warnings(self) -> tuple[str, ...]:
        """What was accepted and should be known."""
        other = self.log.header.extra.get(OTHER_GAINS)
        return self.log.warnings if other is None else (*self.log.warnings, other)

    @property
    def bytes(self) -> int:
        """Memory of the samples [byte]."""
        log = self.log
        columns = (log.time, log.command, log.position, log.force, log.velocity, log.raw_time)
        return sum(values.nbytes for values in columns if values is not None)


def accepted_logs(
    source: Source,
    sha256: str,
    logs: Sequence[Log],
    profile: Profile,
    profile_sha256: str,
    known: Mapping[str, Motion],
    formerly: str | None = None,
) -> list[Accepted]:
    """Return the trials of a source that was read; `known` is the motion of each device that has a device file.

    ``formerly`` is the path under which it is stored, where it was renamed.

    Raises
    ------
    LogError
        If a log cannot be stored (`reading.motion_of`).
    """
    name = path_text(source.path.name) if profile.reads_names else None
    logs = [_marked(profile, log, {} if formerly is None else {FORMERLY: formerly}) for log in logs]
    return [
        Accepted(
            trial_id(sha256, log.label, name),
            sha256,
            source,
            log,
            motion_of(log, known),
            profile.name,
            profile_sha256,
            len(logs),
        )
        for log in logs
    ]


def _marked(profile: Profile, log: Log, marks: dict[str, str]) -> Log:
    """Return a log with marks, among them that its command obeys other gains than its header says."""
    if (found := obeyed(log)) is not None:
        marks = marks | {OTHER_GAINS: f"{found.sentence}. To cure it: {cure(profile, found)}"}
    return replace(log, header=replace(log.header, extra=log.header.extra | marks)) if marks else log


class TrialWriter:
    """Collects accepted logs and writes them as one batch per device, experiment and motion.

    Samples go to disk group by group, so that memory does not grow with a batch; with an executor one group of a batch
    is written while the next is collected, and those of several batches at a time. The file of a batch is opened for
    its first group: logs of thousands of experiments wait in memory, of which `limit` is the bound, and not in as many
    open files.

    Parameters
    ----------
    processed : Path
    limit : int
        Bytes of samples after which what was collected is made visible: what an interruption may cost.
    executor : Executor, optional
        Where groups are written.
    """

    def __init__(self, processed: Path, limit: int, executor: Executor | None = None) -> None:
        self.processed, self.limit, self.executor = processed, limit, executor
        self._batches: dict[tuple[str, str, Motion], _Batch] = {}
        self._sources: list[Source] = []
        self._bytes = 0
        self.experiments: set[tuple[str, str]] = set()
        """Device and experiment of all that was collected."""
        self.visible: set[str] = set()
        """Paths of the sources of trials that were made visible."""

    def add(self, accepted: Sequence[Accepted]) -> list[Source]:
        """Take the logs of one more source; return the sources that became visible because the limit was reached."""
        for one in accepted:
            header = one.log.header
            key = header.device, header.experiment, one.motion
            if key not in self._batches:
                self._batches[key] = _Batch(self.processed, *key, self.executor)
            self.experiments.add(key[:2])
            self._batches[key].add(one)
            self._bytes += one.bytes
        self._sources += [one.source for one in accepted]
        return self.flush() if self._bytes >= self.limit else []

    def flush(self) -> list[Source]:
        """Make all that was collected visible and return its sources; after an error all that is stored is valid."""
        # the caller holds the lock, so that nobody else takes a number meanwhile
        number = next_number(self.processed) if self._batches else 0
        while self._batches:
            keys = list(islice(self._batches, PUBLISHED_TOGETHER))
            batches = [self._batches[key] for key in keys]
            make_folders(f(self.processed, *key[:2]) for key in keys for f in (samples_folder, trials_folder))
            for batch in batches:
                batch.write_rest()
            # each waits for what it has begun to write, which stands before it in the queue
            each = map if self.executor is None else self.executor.map
            publish_batches(list(each(_Batch.finished, batches, count(number))))
            for key, batch in zip(keys, batches, strict=True):
                self.visible.update(batch.trials["source_path"])
                del self._batches[key]
            number += len(keys)
        publish(self.processed)
        sources, self._sources, self._bytes = self._sources, [], 0
        return sources

    def discard(self) -> None:
        """Remove what was not made visible."""
        for batch in self._batches.values():
            batch.discard()


class _Batch:
    """Logs of one experiment on their way into a pair of files."""

    def __init__(
        self, processed: Path, device: str, experiment: str, motion: Motion, executor: Executor | None
    ) -> None:
        self.place, self.executor = (processed, device, experiment, motion), executor
        self.file: NewBatch | None = None
        self.writing: Future[None] | None = None
        self.pending: list[Accepted] = []
        self.pending_rows = 0
        self.trials: dict[str, list[Any]] = defaultdict(list)

    def add(self, accepted: Accepted) -> None:
        self.pending.append(accepted)
        self.pending_rows += len(accepted.log.time)
        if self.pending_rows >= GROUP_ROWS:
            self._write_pending()

    def write_rest(self) -> None:
        """Begin to write what is pending."""
        if self.pending:
            self._write_pending()

    def finished(self, number: int) -> NewBatch:
        """Return the files of the batch when all of it is written."""
        if self.writing is not None:
            self.writing.result()
        assert self.file is not None, "a batch is made for a log, which is pending or written"
        self.file.finish(self.trials, number)
        return self.file

    def discard(self) -> None:
        if self.writing is not None:
            # what it raised was raised to who waited for it, or comes from the same cause
            self.writing.exception()
        if self.file is not None:
            self.file.discard()

    def _write_pending(self) -> None:
        members, self.pending, self.pending_rows = self.pending, [], 0
        if self.file is None:
            self.file = NewBatch(*self.place)
        if self.executor is None:
            self._write_group(self.file, members)
            return
        if self.writing is not None:
            # groups stand in order, and no more than one waits in memory
            self.writing.result()
        self.writing = self.executor.submit(self._write_group, self.file, members)

    def _write_group(self, file: NewBatch, members: Sequence[Accepted]) -> None:
        rows = np.array([len(m.log.time) for m in members], dtype=np.int64)
        time = np.concatenate([m.log.time for m in members])
        period = np.array([m.log.header.sampling_period_s for m in members], dtype=np.float64)
        flags = step_flags(time, rows, period)
        first = file.rows + np.cumsum(rows) - rows
        for member, flag, length, at in zip(members, flags, rows.tolist(), first.tolist(), strict=True):
            for name, value in _trial(member, flag).items():
                self.trials[name].append(value)
            self.trials["rows"].append(length)
            self.trials["first_row"].append(at)
        samples = {
            "trial_id": _repeated([m.trial_id for m in members], rows),
            "time_s": time,
            "command": np.concatenate([m.log.command for m in members]),
            "position": np.concatenate([m.log.position for m in members]),
            "force": _optional([m.log.force for m in members], rows, pa.float64()),
            "velocity": _optional([m.log.velocity for m in members], rows, pa.float64()),
            "raw_time": _optional([_raw(m.log, "f") for m in members], rows, pa.float64()),
            "raw_count": _optional([_raw(m.log, "i") for m in members], rows, pa.int64()),
        }
        file.write(to_arrow("samples", samples))


def _trial(accepted: Accepted, flags: Mapping[str, Any]) -> dict[str, object]:
    """Return the row of a log in the trials table, but where its samples lie."""
    log, source = accepted.log, accepted.source
    header = log.header
    plain = ("device", "experiment", "stiffness", "damping", "step", "sampling_period_s")
    return {
        **{key: getattr(header, key) for key in (*plain, "added_delay_samples", "grip", "simulated")},
        "trial_id": accepted.trial_id,
        "label": log.label,
        "motion": accepted.motion,
        "extra": json.dumps(header.extra, sort_keys=True, ensure_ascii=False) if header.extra else "{}",
        "time_quality": json.dumps({**flags, **log.counts}),
        "source_path": source.key,
        "source_sha256": accepted.sha256,
        "source_trials": accepted.siblings,
        "source_size": source.size,
        "source_mtime_ns": source.mtime_ns,
        "profile": accepted.profile,
        "profile_sha256": accepted.profile_sha256,
        "package_version": __version__,
    }


def _raw(log: Log, kind: str) -> Floats | Integers | None:
    """Return the time stamps of the file where they are numbers of a kind: "f" with a fraction, "i" whole."""
    return log.raw_time if log.raw_time is not None and log.raw_time.dtype.kind == kind else None


def _optional(columns: Sequence[Floats | Integers | None], rows: Integers, dtype: pa.DataType) -> pa.ChunkedArray:
    """Return a column that some logs lack; null where they do."""
    if all(values is None for values in columns):
        return _nulls(int(rows.sum()), dtype)
    parts = [
        pa.nulls(int(count), dtype) if values is None else pa.array(values)
        for values, count in zip(columns, rows, strict=True)
    ]
    return pa.chunked_array(parts, type=dtype)


def _repeated(ids: Sequence[str], rows: Integers) -> pa.StringArray:
    """Return a column of the id of each row's trial; ids have one length, so that no text is touched row by row."""
    column = np.repeat(np.array(ids, dtype=np.bytes_), rows)
    offsets = np.arange(len(column) + 1, dtype=np.int32) * np.int32(column.dtype.itemsize)
    return pa.StringArray.from_buffers(len(column), pa.py_buffer(offsets), pa.py_buffer(column))


def _nulls(rows: int, dtype: pa.DataType) -> pa.ChunkedArray:
    """Return a column of nulls that shares one small piece of memory."""
    piece = pa.nulls(min(rows, 1 << 16), dtype)
    whole, rest = divmod(rows, max(len(piece), 1))
    return pa.chunked_array([*([piece] * whole), piece[:rest]], type=dtype)


def trial_id(sha256: str, label: str | None, name: str | None = None) -> str:
    """Return the id of a trial: of its source, with its label where the source holds several.

    Parameters
    ----------
    sha256 : str
        Of the source, 64 hexadecimal digits.
    label : str or None
        Which trial of the source it is.
    name : str, optional
        File name, where conditions are read from it: under another name the same samples are another trial.
    """
    parts = [part for part in (label, name) if part is not None]
    # no name of a file holds a NUL
    return hash_of((sha256 + "\0".join(parts)).encode())[:16] if parts else sha256[:16]
