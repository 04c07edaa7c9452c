"""Stored sources with their trials, and rows of the trials table for new sources."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from pipeline.base.disk import readers_of
from pipeline.base.errors import StoreError
from pipeline.base.provenance import __version__
from pipeline.base.provenance import sha256 as hash_of
from pipeline.intake.sources import ENDINGS, Source, motion_of
from pipeline.readers import Log
from pipeline.readers.gain_check import gain_mismatch
from pipeline.readers.log import step_flags
from pipeline.records.findings import FINDINGS, Motion
from pipeline.records.table_files import open_table
from pipeline.records.tables import COLUMNS, to_arrow
from pipeline.store.batch_files import GROUP_BYTES, GROUP_TRIALS, ExperimentKey, Key
from pipeline.store.names import name_of_folder
from pipeline.store.storage import read_rows, same_period, trials_files

SEEN = ("source_path", "source_size", "source_mtime_ns", "source_trials", "claims")
"""Columns that show whether a source is new. With row groups of 64 rows, each further column adds a tenth to the
reading time."""

MORE = ("source_sha256", "profile_sha256", "profile", "source_size", "source_mtime_ns", "device", "trial_id")
"""Further columns, which are read only if details of a stored log are needed."""


class StoredSource(NamedTuple):
    """Stored data of a source.

    Parameters
    ----------
    sha256, profile_sha256, profile : str
        Hash of the content, and hash and name of the profile that read it.
    size, mtime_ns : int
        Size [byte] and modification time [ns] of the source when it was read.
    devices, trials : tuple of str
        Device of each trial of the source, and id of each trial.
    whole : bool
        True if these are all trials of the source. An interrupted run may have written only some of them.
    """

    sha256: str
    profile_sha256: str
    profile: str
    size: int
    mtime_ns: int
    devices: tuple[str, ...]
    trials: tuple[str, ...]
    whole: bool = True

    def keys(self, path: str) -> set[Key]:
        """Return the keys under which the trials of this source are stored."""
        return {(path, trial, self.profile_sha256) for trial in self.trials}


class StoredSources:
    """Stored data of each source, keyed by path. Data that are not needed to detect new sources are read on demand.

    Parameters
    ----------
    processed : Path
    claims : str
        Hash of all profiles that may currently claim a file.
    damaged : dict of Path to str
        As in `storage.read_trials`.
    """

    def __init__(self, processed: Path, claims: str, damaged: dict[Path, str]) -> None:
        self.processed, self.damaged = processed, damaged
        self.rows = read_rows(processed, SEEN, damaged)
        path, size, mtime_ns, held, by = map(self.rows.column, SEEN)
        trials = dict(zip(path, held, strict=True))
        missing = {name: trials[name] - count for name, count in Counter(path).items() if count != trials[name]}
        self.paths, self.partly = trials.keys(), missing.keys()
        self.doubled = min(missing.values(), default=0) < 0
        """True if any log is stored twice with different content."""
        states = zip(path, size, mtime_ns, by, strict=True)
        self.states = {name: (of, at) for name, of, at, claimed in states if claimed == claims}
        """Size [byte] and time [ns] of each completely stored source with a single file and an unambiguous profile."""
        for name in (*missing, *(name for name in self.states if name.endswith(ENDINGS))):
            self.states.pop(name, None)
        self.taken = dict[str, StoredSource]()
        """Sources stored since this object was created."""

    @cached_property
    def _former(self) -> dict[str, StoredSource]:
        names, found = ("source_path", *MORE), dict[str, StoredSource]()
        rows = read_rows(self.processed, names, self.damaged)
        for path, sha256, by, profile, size, mtime_ns, device, trial in zip(*map(rows.column, names), strict=True):
            devices, trials = (found[path].devices, found[path].trials) if path in found else ((), ())
            ours, whole = ((*devices, device), (*trials, trial)), path not in self.partly
            found[path] = StoredSource(sha256, by, profile, size, mtime_ns, *ours, whole)
        return found

    def get(self, path: str) -> StoredSource | None:
        """Return the stored data of a path. For data in a damaged file, the result is None, so the log counts as
        new."""
        return self.taken.get(path) or (self._former.get(path) if path in self.paths else None)

    def places(self, but: set[str]) -> dict[str, str]:
        """Return the path of the log of each stored trial, except the trials of the sources in ``but`` and of
        incomplete sources."""
        rows = read_rows(self.processed, ("trial_id", "source_path"), self.damaged)
        pairs = zip(rows.column("trial_id"), rows.column("source_path"), strict=True)
        return {trial: path for trial, path in pairs if path not in but and path not in self.partly}


@dataclass
class Periods:
    """Sampling period [s] of each experiment in a store, keyed by device and experiment. The first log of an experiment
    determines its period. A log with a different period belongs to a different loop, and is therefore assigned to a
    separate experiment.
    """

    processed: Path

    @cached_property
    def known(self) -> dict[tuple[str, str], float]:
        """Periods in the store, and periods of newly assigned experiments."""
        found: dict[tuple[str, str], float] = {}
        for file in trials_files(self.processed):
            place = name_of_folder(file.parent.parent.name), name_of_folder(file.parent.name)
            if place not in found:
                # The damage is reported by functions that read more of the file.
                with suppress(StoreError, FileNotFoundError), open_table(file) as stored:
                    found[place] = stored.read_row_group(0, ["sampling_period_s"]).column(0)[0].as_py()
        return found

    def assign(self, log: Log) -> Log:
        """Return a log, assigned to the experiment with its period. If this experiment differs from the header, the log
        has a warning."""
        header, period = log.header, log.header.sampling_period_s
        common = self.known.setdefault((header.device, header.experiment), period)
        if same_period(common, period):
            return log
        stem = f"{header.experiment}-T"
        of_device = [(name, known) for (device, name), known in self.known.items() if device == header.device]
        names = (name for name, known in of_device if name.startswith(stem) and same_period(known, period))
        name = next(names, f"{stem}{1e3 * period:.4g}ms")
        self.known.setdefault((header.device, name), period)
        text = (
            f"the sampling period is {1e3 * period:.4g} ms, but logs of experiment {header.experiment!r} have "
            f"{1e3 * common:.4g} ms. This log is stored as experiment {name!r}, because a different period is a "
            "different loop."
        )
        return replace(log, header=replace(header, experiment=name), warnings=(*log.warnings, text))


OTHER_GAINS = "other_gains"
"""Key in ``extra`` for a sentence on gains that the command follows and that differ from the header."""

LOG_BYTES = 2048
"""Memory of a log without its samples [byte]."""


_CONDITIONS = ("device", "experiment", "stiffness", "damping", "step", "sampling_period_s", "grip", "simulated")


@dataclass(frozen=True, eq=False)
class Accepted:
    """A checked log with its row in the trials table. Columns that are computed for many logs together are still
    missing."""

    source: Source
    log: Log
    row: dict[str, Any]

    @property
    def trial(self) -> str:
        """Id of the trial."""
        return str(self.row["trial_id"])

    @property
    def bytes(self) -> int:
        """Memory of the log [byte]."""
        return LOG_BYTES + sum(values.nbytes for values in vars(self.log).values() if isinstance(values, np.ndarray))

    @property
    def place(self) -> ExperimentKey:
        """Key that the trial shares with all trials of its file."""
        device, experiment, motion = (self.row[name] for name in ("device", "experiment", "motion"))
        return ExperimentKey(device, experiment, motion, readers_of(self.source.mode))


def accepted_logs(
    source: Source, sha256: str, logs: Sequence[Log], known: Mapping[str, Motion], claims: str
) -> list[Accepted]:
    """Return the trials of a source.

    A trial is flagged with a warning if its command was computed with gains other than those in the header.

    Parameters
    ----------
    source : Source
    sha256 : str
    logs : sequence of Log
    known : mapping of str to Motion
        Motion of each device with a device file.
    claims : str
        Hash of all profiles that might have claimed the source.

    Raises
    ------
    LogError
        If a log cannot be stored (see `sources.motion_of`).
    """
    assert source.profile is not None, "a source without a profile is refused before it is read"
    common = {
        "source_path": source.key,
        "source_size": source.size,
        "source_mtime_ns": source.mtime_ns,
        "source_sha256": sha256,
        "source_trials": len(logs),
        "profile": source.profile.name,
        "profile_sha256": source.profile_sha256,
        "claims": claims,
        "package_version": __version__,
    }
    found = []
    for log in logs:
        row = common | {"motion": motion_of(log, known), "label": log.label, "rows": len(log.time)}
        # A distortion of the command by a faulty recording does not indicate a different wall.
        is_safe = not any(finding.is_unsafe for finding in log.findings)
        if is_safe and (text := gain_mismatch(source.profile, log)) is not None:
            header = replace(log.header, extra=log.header.extra | {OTHER_GAINS: text})
            log = log.with_warning(header, text)
        row |= {name: getattr(log.header, name) for name in (*_CONDITIONS, "added_delay_samples")}
        row["extra"] = json.dumps(log.header.extra, sort_keys=True, ensure_ascii=False)
        row["trial_id"] = trial_id(sha256, log.label, source.named_conditions)
        found.append(Accepted(source, log, row))
    return found


def batches_of(accepted: Sequence[Accepted]) -> dict[ExperimentKey, Iterator[pa.Table]]:
    """Return the trials of logs for each file key, as one table for each row group."""
    places = defaultdict[ExperimentKey, list[Accepted]](list)
    for one in accepted:
        places[one.place].append(one)
    return {place: _tables(members) for place, members in places.items()}


def _tables(members: Sequence[Accepted]) -> Iterator[pa.Table]:
    """Yield the trials of logs, one row group at a time."""
    step = max(min(GROUP_TRIALS, GROUP_BYTES // max(one.bytes for one in members)), 1)
    for first in range(0, len(members), step):
        yield _table(members[first : first + step])


def _table(members: Sequence[Accepted]) -> pa.Table:
    """Return the trials table of logs."""
    logs = [member.log for member in members]
    period = np.array([log.header.sampling_period_s for log in logs], dtype=np.float64)
    rows = np.array([len(log.time) for log in logs], dtype=np.int64)
    flags = step_flags(np.concatenate([log.time for log in logs]), rows, period)
    columns: dict[str, object] = {name: [member.row[name] for member in members] for name in members[0].row}
    columns["time_quality"] = [
        json.dumps({**flag, **log.counts} | ({FINDINGS: [each.model_dump() for each in log.findings]}))
        for flag, log in zip(flags, logs, strict=True)
    ]
    samples: dict[str, list[Any]] = {"time_s": [log.time for log in logs]}
    samples |= {name: [getattr(log, name) for log in logs] for name in ("command", "position", "force", "velocity")}
    for name, kind in (("raw_time", "f"), ("raw_count", "i")):  # fractional and integer time stamps of the file
        stamps = [log.raw_time for log in logs]
        samples[name] = [None if values is None or values.dtype.kind != kind else values for values in stamps]
    columns |= {name: pa.array(values, COLUMNS[name].dtype) for name, values in samples.items()}
    return to_arrow("trials", columns, motion=members[0].row["motion"])


def trial_id(sha256: str, label: str | None, conditions: str | None = None) -> str:
    """Return the id of a trial. It depends on the source and, if the source has several trials, on the label.

    Parameters
    ----------
    sha256 : str
        Hash of the source, 64 hexadecimal digits.
    label : str or None
        Label of the trial in the source.
    conditions : str, optional
        Conditions read from the file name. The same samples with different conditions are a different trial.
    """
    parts = [part for part in (label, conditions) if part is not None]
    # Neither a label nor a name contains a NUL character.
    return hash_of((sha256 + "\0".join(parts)).encode())[:16] if parts else sha256[:16]
