"""Writes accepted logs to `processed/`: samples first, then the trials file that makes them visible."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipeline import __version__
from pipeline.batch import Floats, Integers
from pipeline.models import Motion
from pipeline.provenance import digest, stamp
from pipeline.provenance import sha256 as hash_of
from pipeline.readers import Log
from pipeline.readers.time_axis import step_flags
from pipeline.sources import Source
from pipeline.storage import read_trials, samples_folder, trials_folder
from pipeline.tables import read_table, to_arrow, write_table


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
    def bytes(self) -> int:
        """Memory of the samples [byte]."""
        log = self.log
        columns = (log.time, log.command, log.position, log.force, log.velocity, log.raw_time)
        return sum(values.nbytes for values in columns if values is not None)


@dataclass
class TrialWriter:
    """Collects accepted logs and writes them as one batch per device, experiment and motion.

    Parameters
    ----------
    processed : Path
    limit : int
        Bytes of samples that are kept in memory before they are written.
    """

    processed: Path
    limit: int
    _pending: list[Accepted] = field(default_factory=list)
    _bytes: int = 0

    def add(self, accepted: Sequence[Accepted]) -> list[Accepted]:
        """Take the logs of one more source; return those that were written because the limit was reached."""
        self._pending += accepted
        self._bytes += sum(log.bytes for log in accepted)
        return self.flush() if self._bytes >= self.limit else []

    def flush(self) -> list[Accepted]:
        """Write all that is pending and return it; after an error all that is stored is valid."""
        groups: dict[tuple[str, str, Motion], list[Accepted]] = defaultdict(list)
        for accepted in self._pending:
            header = accepted.log.header
            groups[header.device, header.experiment, accepted.motion].append(accepted)
        for (device, experiment, motion), members in groups.items():
            _write_batch(self.processed, device, experiment, motion, members)
        written, self._pending, self._bytes = self._pending, [], 0
        return written


def _write_batch(processed: Path, device: str, experiment: str, motion: Motion, members: list[Accepted]) -> None:
    rows = np.array([len(m.log.time) for m in members], dtype=np.int64)
    name = digest([[m.trial_id, m.profile_sha256] for m in members]) + ".parquet"
    samples_file = samples_folder(processed, device, experiment) / name
    rotation = motion == "rotation"
    metadata = stamp(device=device, experiment=experiment)
    trial = pa.DictionaryArray.from_arrays(
        pa.array(np.repeat(np.arange(len(members), dtype=np.int32), rows)),
        pa.array([m.trial_id for m in members]),
    )
    samples = {
        "trial_id": trial.cast(pa.string()),
        "time_s": np.concatenate([m.log.time for m in members]),
        "command": np.concatenate([m.log.command for m in members]),
        "position": np.concatenate([m.log.position for m in members]),
        "force": _optional([m.log.force for m in members], rows, pa.float64()),
        "velocity": _optional([m.log.velocity for m in members], rows, pa.float64()),
        "raw_time": _optional([_raw(m.log, "f") for m in members], rows, pa.float64()),
        "raw_count": _optional([_raw(m.log, "i") for m in members], rows, pa.int64()),
    }
    flags = step_flags(
        samples["time_s"], rows, np.array([m.log.header.sampling_period_s for m in members], dtype=np.float64)
    )
    headers = [m.log.header for m in members]
    plain = ("device", "experiment", "stiffness", "damping", "step", "sampling_period_s")
    trials: dict[str, object] = {
        key: [getattr(h, key) for h in headers] for key in (*plain, "added_delay_samples", "grip", "simulated")
    }
    trials |= {
        "trial_id": [m.trial_id for m in members],
        "label": [m.log.label for m in members],
        "motion": [motion] * len(members),
        "rows": rows,
        "extra": [json.dumps(h.extra, sort_keys=True, ensure_ascii=False) for h in headers],
        "time_quality": [json.dumps({**f, **m.log.counts}) for f, m in zip(flags, members, strict=True)],
        "source_path": [m.source.key for m in members],
        "source_sha256": [m.sha256 for m in members],
        "source_trials": [m.siblings for m in members],
        "source_size": [m.source.size for m in members],
        "source_mtime_ns": [m.source.mtime_ns for m in members],
        "profile": [m.profile for m in members],
        "profile_sha256": [m.profile_sha256 for m in members],
        "package_version": [__version__] * len(members),
        "sample_file": [samples_file.relative_to(processed).as_posix()] * len(members),
        "first_row": np.cumsum(rows) - rows,
    }
    write_table(samples_file, to_arrow("samples", samples, rotation=rotation, metadata=metadata))
    write_table(
        trials_folder(processed, device, experiment) / name,
        to_arrow("trials", trials, rotation=rotation, metadata=metadata),
    )


def _raw(log: Log, kind: str) -> Floats | Integers | None:
    """Return the time stamps of the file where they are numbers of a kind: "f" with a fraction, "i" whole."""
    return log.raw_time if log.raw_time is not None and log.raw_time.dtype.kind == kind else None


def _optional(columns: Sequence[Floats | Integers | None], rows: Integers, dtype: pa.DataType) -> pa.ChunkedArray:
    """Return a column that some logs lack; null where they do."""
    if all(values is None for values in columns):
        return pa.chunked_array([pa.nulls(int(rows.sum()), dtype)])
    parts = [
        pa.nulls(int(count), dtype) if values is None else pa.array(values)
        for values, count in zip(columns, rows, strict=True)
    ]
    return pa.chunked_array(parts, type=dtype)


@dataclass(frozen=True)
class StoredSource:
    """What is stored of a source.

    Parameters
    ----------
    sha256, size, mtime_ns, profile_sha256
        Content, size [byte], modification time [ns] and profile when it was read.
    trials : frozenset of str
        Ids of its trials.
    whole : bool
        Whether these are all that the source holds: an interrupted run may have written some of them.
    """

    sha256: str
    size: int
    mtime_ns: int
    profile_sha256: str
    trials: frozenset[str]
    whole: bool

    def keys(self, path: str) -> set[tuple[str, str, str]]:
        """Return its trials as `drop_superseded` takes them."""
        return {(trial, self.profile_sha256, path) for trial in self.trials}


def trial_id(sha256: str, label: str | None) -> str:
    """Return the id of a trial: of its source, or of source and label where the source holds several.

    Parameters
    ----------
    sha256 : str
        Of the source, 64 hexadecimal digits.
    label : str or None
        Which trial of the source it is.
    """
    return sha256[:16] if label is None else hash_of((sha256 + label).encode())[:16]


def stored_sources(processed: Path) -> dict[str, StoredSource]:
    """Return what is stored of each source, by its path."""
    of_source = ("source_sha256", "source_size", "source_mtime_ns", "profile_sha256", "source_trials")
    table = read_trials(processed).select(["source_path", "trial_id", *of_source])
    trials: dict[str, set[str]] = defaultdict(set)
    values: dict[str, tuple[str, int, int, str, int]] = {}
    for path, trial, *rest in zip(*(column.to_pylist() for column in table.columns), strict=True):
        trials[path].add(trial)
        values[path] = tuple(rest)
    return {
        path: StoredSource(sha256, size, mtime_ns, profile, frozenset(trials[path]), len(trials[path]) >= count)
        for path, (sha256, size, mtime_ns, profile, count) in values.items()
    }


def drop_superseded(processed: Path, replaced: Collection[tuple[str, str, str]]) -> None:
    """Remove former versions of trials whose source or profile has changed and that were stored again.

    Parameters
    ----------
    processed : Path
    replaced : collection of (trial_id, profile_sha256, source_path)
        Rows to remove; samples that share a file with others stay behind, nothing names them.
    """
    if not replaced:
        return
    old = pa.array(sorted(" ".join(row) for row in replaced))
    for file in sorted((processed / "trials").rglob("*.parquet")):
        table = read_table(file)
        keys = pc.binary_join_element_wise(
            *(table.column(name) for name in ("trial_id", "profile_sha256", "source_path")), " "
        )
        kept = table.filter(pc.invert(pc.is_in(keys, value_set=old)))
        if kept.num_rows == table.num_rows:
            continue
        if kept.num_rows:
            write_table(file, kept)
            continue
        samples = {processed / name for name in table.column("sample_file").to_pylist()}
        file.unlink()
        for path in samples:
            path.unlink(missing_ok=True)
