"""Writes accepted logs to `processed/`: samples first, then the trials file that makes them visible."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipeline import __version__
from pipeline.batch import Floats, Integers
from pipeline.models import Motion
from pipeline.provenance import digest, stamp
from pipeline.readers import Log
from pipeline.sources import Source
from pipeline.storage import samples_folder, trials_folder
from pipeline.tables import read_table, to_arrow, write_table


@dataclass(frozen=True, eq=False)
class Accepted:
    """A checked log with its identity, its motion, and the hash of the profile that read it."""

    trial_id: str
    sha256: str
    source: Source
    log: Log
    motion: Motion
    profile: str
    profile_sha256: str

    @property
    def bytes(self) -> int:
        """Memory of the samples [byte]."""
        log = self.log
        columns = (log.time, log.command, log.position, log.force, log.velocity)
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

    def add(self, accepted: Accepted) -> list[Accepted]:
        """Take one more log; return those that were written because the limit was reached."""
        self._pending.append(accepted)
        self._bytes += accepted.bytes
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
        "force": _optional([m.log.force for m in members], rows),
        "velocity": _optional([m.log.velocity for m in members], rows),
    }
    headers = [m.log.header for m in members]
    plain = ("device", "experiment", "stiffness", "damping", "step", "sampling_period_s")
    trials: dict[str, object] = {
        key: [getattr(h, key) for h in headers] for key in (*plain, "added_delay_samples", "grip", "simulated")
    }
    trials |= {
        "trial_id": [m.trial_id for m in members],
        "motion": [motion] * len(members),
        "rows": rows,
        "extra": [json.dumps(h.extra, sort_keys=True, ensure_ascii=False) for h in headers],
        "source_path": [m.source.key for m in members],
        "source_sha256": [m.sha256 for m in members],
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


def _optional(columns: list[Floats | None], rows: Integers) -> pa.ChunkedArray:
    """Return a column that some logs lack; null where they do."""
    parts = [
        pa.nulls(int(count), pa.float64()) if values is None else pa.array(values)
        for values, count in zip(columns, rows, strict=True)
    ]
    return pa.chunked_array(parts, type=pa.float64())


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
