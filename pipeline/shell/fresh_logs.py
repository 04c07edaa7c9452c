"""Logs of a report, read again into a temporary folder, and their differences from the time of the report.

No computed results are reused: the folder gets trials and samples, but no stages and no theory.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from pipeline.base.disk import result_files
from pipeline.base.wording import counted
from pipeline.comparison.scene.origin import joint_sha256
from pipeline.intake.ingest import ingest
from pipeline.profiles.profile_files import load_profile, shipped_profiles
from pipeline.records.accuracy import STORED
from pipeline.records.findings import Record
from pipeline.records.results import LogList
from pipeline.records.tables import LOCATION
from pipeline.store.batch_files import ExperimentKey, trials_of, write_batch
from pipeline.store.corrections import write_corrections
from pipeline.store.samples import load_trials
from pipeline.store.storage import Correction, Exclusion, read_exclusions, read_trials, split_trials


class LogProblem(Record):
    """A log, or its stored data, that differs from the one used for the report; ``path`` may be an experiment."""

    path: str
    problem: str
    expected: str | None = None
    found: str | None = None


class ReportedLogs(Record):
    """Logs of an experiment according to a page: number of files, joint SHA-256, hash of their samples."""

    files: int
    sha256: str
    samples: str


@dataclass
class FreshStore:
    """A folder with the logs as they are now.

    Parameters
    ----------
    folder : Path
    problems : list of LogProblem
    notes : list of str
        Parts that could not be checked, and the reasons.
    read, kept : int
        Number of trials read from their logs, and number of those with only stored samples left.
    """

    folder: Path
    problems: list[LogProblem] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    read: int = 0
    kept: int = 0

    def differs(self, path: str, problem: str, expected: str | None = None, found: str | None = None) -> None:
        """Record a log that differs from that of the report."""
        self.problems.append(LogProblem(path=path, problem=problem, expected=expected, found=found))


def read_anew(
    device: str,
    processed: Path,
    reported: Mapping[str, ReportedLogs],
    lists: Mapping[str, LogList],
    folder: Path,
    profiles: Sequence[Path] | None,
    excluded: Sequence[Exclusion],
) -> FreshStore:
    """Read the logs of a report from their original places; for logs that are gone, copy the stored samples.

    Parameters
    ----------
    device : str
    processed : Path
        Store that records the paths of the logs.
    reported : mapping of str to ReportedLogs
        Statements of the page, by experiment.
    lists : mapping of str to LogList
        Lists of its document, by experiment, if available.
    folder : Path
        Gets the trials.
    profiles : sequence of Path or None
        Profile files of the lab; the shipped profiles are known. None reads no log: stored samples are copied.
    excluded : sequence of Exclusion
        Trials excluded by hand according to the page.

    Raises
    ------
    StoreError
        If `processed` is damaged.
    """
    store = FreshStore(folder)
    files: dict[str, Path | str] = {}
    if profiles is not None:
        files = {profile.name: profile.name for profile in shipped_profiles()}
        files |= {load_profile(path).name: path for path in profiles}
    if excluded:
        write_corrections(folder, [Correction(**one.model_dump()) for one in excluded])
    # a bundle contains no corrections; only the page lists them
    now = excluded if profiles is None else tuple(read_exclusions(processed).values())
    for experiment in sorted({*reported, *(one.experiment for one in excluded)}):
        every = read_trials(processed, device, experiment)
        _hold_exclusions(store, every, excluded, now)
        used, left_out = _of_the_report(store, every, excluded, lists.get(experiment))
        if experiment in reported and not used.num_rows:
            store.differs(f"experiment {experiment}", "none of its logs are stored")
            continue
        columns = (used.column(name).to_pylist() for name in ("source_path", "source_sha256", "profile"))
        rows = list(zip(*columns, strict=True))
        here = [os.path.isfile(path) and profile in files for path, _, profile in rows]
        for profile in sorted({profile for _, _, profile in rows} if profiles is not None else ()):
            if profile not in files:
                store.notes.append(f"profile {profile!r} is not shipped: give it with --profile to read its logs again")
                continue
            paths = {path: sha for (path, sha, own), there in zip(rows, here, strict=True) if there and own == profile}
            _read(store, experiment, paths, files[profile])
        gone = used.filter(pc.invert(pa.array(here, pa.bool_())))
        if gone.num_rows and profiles is not None:
            store.notes.append(f"{counted(gone.num_rows, 'trial')}: the stored samples count, not the log")
        store.read += sum(here)
        store.kept += gone.num_rows
        _keep(store, device, experiment, processed, pa.concat_tables([gone, left_out]))
        if experiment in reported:
            _hold_samples(store, device, experiment, reported[experiment])
    for kept in result_files(processed, STORED, ".json") if folder.is_dir() else ():
        shutil.copy(kept, folder / kept.name)
    return store


def _hold_exclusions(store: FreshStore, trials: pa.Table, said: Iterable[Exclusion], now: Iterable[Exclusion]) -> None:
    """Compare the exclusions in the report, and their reasons, with the present ones."""
    paths = dict(zip(*(trials.column(name).to_pylist() for name in ("trial_id", "source_path")), strict=True))
    before, after = ({one.trial_id: one.exclusion_reason for one in each} for each in (said, now))
    for trial in sorted({*before, *after} & paths.keys()):
        if before.get(trial) != after.get(trial):
            expected, found = (each.get(trial, "no exclusion") for each in (before, after))
            store.differs(paths[trial], "is excluded otherwise than in the report", expected=expected, found=found)


def _among(table: pa.Table, column: str, values: Collection[str]) -> pa.ChunkedArray:
    return pc.is_in(table.column(column), value_set=pa.array(sorted(values), pa.string()))


def _of_the_report(
    store: FreshStore, trials: pa.Table, excluded: Sequence[Exclusion], listed: LogList | None
) -> tuple[pa.Table, pa.Table]:
    """Return the stored trials of the report's logs, and those excluded by hand, both without later trials."""
    used, _ = split_trials(trials, {one.trial_id: one for one in excluded})
    left_out = trials.filter(pc.invert(_among(trials, "trial_id", used.column("trial_id").to_pylist())))
    if listed is None:
        return used, left_out
    stored = dict(zip(*(used.column(name).to_pylist() for name in ("source_path", "source_sha256")), strict=True))
    expected = {os.path.join(listed.folder, name): sha for name, sha in listed.files.items()}
    for path in sorted(path for path, sha in expected.items() if sha not in stored.values()):
        text = "is not stored as it was when the report was made"
        store.differs(path, text, expected=expected[path], found=stored.get(path))
    # a log at the path of a report's log shows the effect of its change on the numbers
    ours = pc.or_(_among(used, "source_sha256", set(expected.values())), _among(used, "source_path", set(expected)))
    if later := used.num_rows - (pc.sum(ours).as_py() or 0):
        store.notes.append(f"experiment {listed.experiment}: {later} trials were stored later and are left out")
    return used.filter(ours), left_out


def _read(store: FreshStore, experiment: str, sources: Mapping[str, str], profile: Path | str) -> None:
    """Ingest logs from their sources, whose hashes are those of the report."""
    if not sources:
        return
    report = ingest([Path(path) for path in sources], store.folder, profile)
    for refusal in report.quarantined:
        store.differs(refusal.path, f"is refused now: {refusal.reason}", expected=sources[refusal.path])
    found = read_trials(store.folder, columns=["source_path", "source_sha256"])
    for path, sha in set(zip(*(found.column(name).to_pylist() for name in found.column_names), strict=True)):
        if sources.get(path, sha) != sha:
            text = f"has changed since it was ingested (experiment {experiment})"
            store.differs(path, text, expected=sources[path], found=sha)


def _keep(store: FreshStore, device: str, experiment: str, processed: Path, trials: pa.Table) -> None:
    """Copy stored samples."""
    if not trials.num_rows:
        return
    files, rows = (np.array(trials.column(name).to_pylist()) for name in LOCATION)
    masks = {
        processed / name: np.isin(np.arange(pq.read_metadata(processed / name).num_rows), rows[files == name])
        for name in np.unique(files).tolist()
    }
    parts = chain.from_iterable(trials_of(file, kept) for file, kept in masks.items())
    write_batch(store.folder, ExperimentKey(device, experiment, trials.column("motion")[0].as_py()), parts)


def _hold_samples(store: FreshStore, device: str, experiment: str, said: ReportedLogs) -> None:
    """Compare all samples with the hash in the page, if logs with the same hashes were found."""
    trials = split_trials(read_trials(store.folder, device, experiment), read_exclusions(store.folder))[0]
    if joint_sha256(trials.column("source_sha256").to_pylist()) != said.sha256:
        if not store.problems:
            store.differs(f"experiment {experiment}", "its logs are not those of the report", expected=said.sha256)
        return
    found = load_trials(store.folder, trials).digest
    if found != said.samples:
        text = "its samples are not those of the report"
        store.differs(f"experiment {experiment}", text, expected=said.samples, found=found)
