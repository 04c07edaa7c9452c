"""Read the logs of a report again into a temporary folder, and find changes since the report was written.

No computed results are reused: the temporary folder contains only trials and samples, not intermediate results or
theory.
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
    """A log, or its stored data, that differs from the log used for the report. ``path`` may also name an
    experiment."""

    path: str
    problem: str
    expected: str | None = None
    found: str | None = None


class ReportedLogs(Record):
    """Statements of a page about the logs of an experiment: number of files, joint SHA-256, hash of the samples."""

    files: int
    sha256: str
    samples: str


@dataclass
class FreshStore:
    """A temporary folder with the current logs of a report.

    Parameters
    ----------
    folder : Path
    problems : list of LogProblem
    notes : list of str
        Parts that could not be checked, with the reasons.
    read, kept : int
        Number of trials read from their logs, and number of trials taken from stored samples.
    """

    folder: Path
    problems: list[LogProblem] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    read: int = 0
    kept: int = 0

    def differs(self, path: str, problem: str, expected: str | None = None, found: str | None = None) -> None:
        """Record that a log differs from the log used for the report."""
        self.problems.append(LogProblem(path=path, problem=problem, expected=expected, found=found))


def read_again(
    device: str,
    processed: Path,
    reported: Mapping[str, ReportedLogs],
    lists: Mapping[str, LogList],
    folder: Path,
    profiles: Sequence[Path] | None,
    excluded: Sequence[Exclusion],
) -> FreshStore:
    """Read the logs of a report from their original paths. If a log no longer exists, copy its stored samples.

    Parameters
    ----------
    device : str
    processed : Path
        Store with the paths of the logs.
    reported : mapping of str to ReportedLogs
        Statements of the page, keyed by experiment.
    lists : mapping of str to LogList
        Lists of logs in the document, keyed by experiment, if available.
    folder : Path
        Folder in which the trials are stored.
    profiles : sequence of Path or None
        Profile files of the lab, in addition to the shipped profiles. With None, no log is read, and stored samples are
        copied.
    excluded : sequence of Exclusion
        Trials that were excluded manually according to the page.

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
    # A bundle contains no corrections. Only the page lists them.
    now = excluded if profiles is None else tuple(read_exclusions(processed).values())
    for experiment in sorted({*reported, *(one.experiment for one in excluded)}):
        every = read_trials(processed, device, experiment)
        _compare_exclusions(store, every, excluded, now)
        used, left_out = _of_the_report(store, every, excluded, lists.get(experiment))
        if experiment in reported and not used.num_rows:
            store.differs(f"experiment {experiment}", "none of its logs are stored")
            continue
        columns = (used.column(name).to_pylist() for name in ("source_path", "source_sha256", "profile"))
        rows = list(zip(*columns, strict=True))
        here = [os.path.isfile(path) and profile in files for path, _, profile in rows]
        for profile in sorted({profile for _, _, profile in rows} if profiles is not None else ()):
            if profile not in files:
                store.notes.append(
                    f"profile {profile!r} is not shipped. To read its logs again, name its file with --profile"
                )
                continue
            paths = {path: sha for (path, sha, own), there in zip(rows, here, strict=True) if there and own == profile}
            _read(store, experiment, paths, files[profile])
        gone = used.filter(pc.invert(pa.array(here, pa.bool_())))
        lost = sum(not os.path.isfile(path) for path, _, _ in rows)
        for count, why in ((lost, "logs no longer exist"), (gone.num_rows - lost, "profiles are not given")):
            if count and profiles is not None:
                store.notes.append(f"{counted(count, 'trial')}: stored samples were used, because the {why}")
        store.read += sum(here)
        store.kept += gone.num_rows
        _keep(store, device, experiment, processed, pa.concat_tables([gone, left_out]))
        if experiment in reported:
            _compare_samples(store, device, experiment, reported[experiment])
    for kept in result_files(processed, STORED, ".json") if folder.is_dir() else ():
        shutil.copy(kept, folder / kept.name)
    return store


def _compare_exclusions(
    store: FreshStore, trials: pa.Table, stated: Iterable[Exclusion], now: Iterable[Exclusion]
) -> None:
    """Compare the exclusions in the report, and their reasons, with the current exclusions."""
    paths = dict(zip(*(trials.column(name).to_pylist() for name in ("trial_id", "source_path")), strict=True))
    before, after = ({one.trial_id: one.exclusion_reason for one in each} for each in (stated, now))
    for trial in sorted({*before, *after} & paths.keys()):
        if before.get(trial) != after.get(trial):
            expected, found = (each.get(trial, "no exclusion") for each in (before, after))
            store.differs(paths[trial], "its exclusion differs from that in the report", expected=expected, found=found)


def _among(table: pa.Table, column: str, values: Collection[str]) -> pa.ChunkedArray:
    return pc.is_in(table.column(column), value_set=pa.array(sorted(values), pa.string()))


def _of_the_report(
    store: FreshStore, trials: pa.Table, excluded: Sequence[Exclusion], listed: LogList | None
) -> tuple[pa.Table, pa.Table]:
    """Return the stored trials of the report's logs, and the manually excluded trials. Trials stored later are left
    out."""
    used, _ = split_trials(trials, {one.trial_id: one for one in excluded})
    left_out = trials.filter(pc.invert(_among(trials, "trial_id", used.column("trial_id").to_pylist())))
    if listed is None:
        return used, left_out
    stored = dict(zip(*(used.column(name).to_pylist() for name in ("source_path", "source_sha256")), strict=True))
    expected = {os.path.join(listed.folder, name): sha for name, sha in listed.files.items()}
    for path in sorted(path for path, sha in expected.items() if sha not in stored.values()):
        text = "its stored data have changed since the report was written"
        store.differs(path, text, expected=expected[path], found=stored.get(path))
    # A changed log with the path of a log of the report is used, so that the effect of the change on the numbers is
    # shown.
    ours = pc.or_(_among(used, "source_sha256", set(expected.values())), _among(used, "source_path", set(expected)))
    if later := used.num_rows - (pc.sum(ours).as_py() or 0):
        store.notes.append(
            f"experiment {listed.experiment}: {later} trials were stored after the report and are not used"
        )
    return used.filter(ours), left_out


def _read(store: FreshStore, experiment: str, sources: Mapping[str, str], profile: Path | str) -> None:
    """Ingest logs from their sources, and report each log whose hash differs from the hash in the report."""
    if not sources:
        return
    report = ingest([Path(path) for path in sources], store.folder, profile)
    for refusal in report.quarantined:
        store.differs(refusal.path, f"is now refused: {refusal.reason}", expected=sources[refusal.path])
    found = read_trials(store.folder, columns=["source_path", "source_sha256"])
    for path, sha in set(zip(*(found.column(name).to_pylist() for name in found.column_names), strict=True)):
        if sources.get(path, sha) != sha:
            text = f"has changed since it was ingested (experiment {experiment})"
            store.differs(path, text, expected=sources[path], found=sha)


def _keep(store: FreshStore, device: str, experiment: str, processed: Path, trials: pa.Table) -> None:
    """Copy the stored samples of trials."""
    if not trials.num_rows:
        return
    files, rows = (np.array(trials.column(name).to_pylist()) for name in LOCATION)
    masks = {
        processed / name: np.isin(np.arange(pq.read_metadata(processed / name).num_rows), rows[files == name])
        for name in np.unique(files).tolist()
    }
    parts = chain.from_iterable(trials_of(file, kept) for file, kept in masks.items())
    write_batch(store.folder, ExperimentKey(device, experiment, trials.column("motion")[0].as_py()), parts)


def _compare_samples(store: FreshStore, device: str, experiment: str, stated: ReportedLogs) -> None:
    """Compare the hash of all samples with the page. This requires that the hashes of the logs are those of the
    report."""
    trials = split_trials(read_trials(store.folder, device, experiment), read_exclusions(store.folder))[0]
    if joint_sha256(trials.column("source_sha256").to_pylist()) != stated.sha256:
        if not store.problems:
            store.differs(
                f"experiment {experiment}", "its logs differ from those of the report", expected=stated.sha256
            )
        return
    found = load_trials(store.folder, trials).digest
    if found != stated.samples:
        text = "its samples differ from those of the report"
        store.differs(f"experiment {experiment}", text, expected=stated.samples, found=found)
