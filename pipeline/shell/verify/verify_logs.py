"""Logs of a report read anew into a folder of their own, and what is not as it was when the report was made.

Nothing that was computed from the logs is taken over: the folder gets trials and samples, no stages and no theory.
"""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from pipeline.base.errors import UsageError
from pipeline.comparison.scene.origin import joint_sha256
from pipeline.intake.ingest import ingest
from pipeline.intake.sources import find_sources
from pipeline.profiles.profile_files import load_profile, shipped_profiles
from pipeline.records.batch import Floats, TrialBatch
from pipeline.records.findings import Record
from pipeline.records.results import LogList
from pipeline.records.tables import LOCATION
from pipeline.store.batch_files import Place, trials_of, write_batch
from pipeline.store.corrections import Correction, Exclusion, read_exclusions, split_trials, write_corrections
from pipeline.store.samples import load_groups
from pipeline.store.storage import read_trials

_COLUMNS = ("time", "command", "position", "force", "velocity")


class LogProblem(Record):
    """A log, or what is stored of it, that is not the one behind the report; ``path`` may be an experiment."""

    path: str
    problem: str
    expected: str | None = None
    found: str | None = None


class ReportedLogs(Record):
    """What a page says of the logs of an experiment: number of files, their joint SHA-256, hash of their samples."""

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
        What could not be looked at, and why.
    read, kept : int
        Trials that were read from their logs, and those of which only the stored samples are left.
    """

    folder: Path
    problems: list[LogProblem] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    read: int = 0
    kept: int = 0


def read_anew(
    device: str,
    processed: Path,
    reported: Mapping[str, ReportedLogs],
    lists: Mapping[str, LogList],
    folder: Path,
    profiles: Sequence[Path] = (),
    excluded: Sequence[Exclusion] = (),
) -> FreshStore:
    """Read the logs behind a report again.

    Parameters
    ----------
    device : str
    processed : Path
        Folder of the stored tables: it says where the logs lie, and has the samples of logs that are gone.
    reported : mapping of str to ReportedLogs
        What the page says of the logs of each experiment.
    lists : mapping of str to LogList
        Logs of each experiment by the JSON beside the page; may lack some.
    folder : Path
        Gets trials and samples.
    profiles : sequence of Path
        Profile files of the lab; the shipped profiles are known.
    excluded : sequence of Exclusion
        Trials that the page says were excluded by hand.

    Returns
    -------
    FreshStore

    Raises
    ------
    StoreError
        If `processed` is damaged.
    """
    store = FreshStore(folder)
    known = {one.key: one for one in excluded}
    _exclude(folder, excluded)
    stored = read_exclusions(processed)
    for experiment in sorted({*reported, *(one.experiment for one in excluded)}):
        every = read_trials(processed, device, experiment)
        _compare_exclusions(store, experiment, *(split_trials(every, which)[1] for which in (known, stored)))
        used = split_trials(every, known)[0]
        # what enters no number is taken over as it is stored, to be named
        left_out = every.filter(pc.invert(_among(every, "trial_id", used.column("trial_id").to_pylist())))
        if experiment in reported:
            said = reported[experiment]
            used = _of_the_report(store, used, said, lists.get(experiment))
            if not used.num_rows:
                store.problems.append(
                    LogProblem(path=f"experiment {experiment}", problem="none of its logs are stored")
                )
                continue
        again = _read(store, experiment, used.filter(_readable(store, used, profiles)), profiles)
        kept = used.filter(pc.invert(_among(used, "source_path", sorted(again))))
        _keep(store, device, experiment, processed, pa.concat_tables([kept, left_out]))
        store.read += used.num_rows - kept.num_rows
        store.kept += kept.num_rows
        if experiment in reported:
            _compare_samples(store, device, experiment, processed, used, said)
    return store


def store_of(logs: Sequence[tuple[Path | None, Path]], folder: Path, excluded: Sequence[Exclusion]) -> Path:
    """Store what lies in folders of logs, as a lab's ``processed/`` would have it, and return the folder of that.

    Parameters
    ----------
    logs : sequence of (Path or None, Path)
        Profile file, or None for whichever shipped profile claims a log that is not stored by then; folder of logs.
    folder : Path
        Gets trials and samples.
    excluded : sequence of Exclusion
        Trials that were excluded by hand.

    Raises
    ------
    UsageError
        If a folder is not there, or no log is found.
    """
    for profile, place in logs:
        if profile is not None:
            ingest([place], folder, profile)
            continue
        stored = set(read_trials(folder, columns=["source_path"]).column("source_path").to_pylist())
        sources = find_sources([place], shipped_profiles(), folder)
        ingest([source.path for source in sources if source.key not in stored], folder)
    if not read_trials(folder, columns=["source_path"]).num_rows:
        places = ", ".join(str(place) for _, place in logs)
        raise UsageError(f"{places}: found no log that can be read. Give the folder of the logs behind the report.")
    _exclude(folder, excluded)
    return folder


def _exclude(folder: Path, excluded: Sequence[Exclusion]) -> None:
    if excluded:
        write_corrections(folder, [Correction(**one.model_dump()) for one in excluded])


def _among(table: pa.Table, column: str, values: Collection[str]) -> pa.ChunkedArray:
    return pc.is_in(table.column(column), value_set=pa.array(values, pa.string()))


def _compare_exclusions(
    store: FreshStore, experiment: str, reported: Sequence[Exclusion], stored: Sequence[Exclusion]
) -> None:
    """Hold the exclusions that a page names against those of the store."""
    said, now = ({one.key: one.exclusion_reason for one in part} for part in (reported, stored))
    for one in {one.key: one for one in (*reported, *stored)}.values():
        if said.get(one.key) == now.get(one.key):
            continue
        what = "is excluded now, and was used" if one.key not in said else "was excluded, and is not excluded now"
        problem = "its exclusion has another reason" if one.key in said and one.key in now else what
        store.problems.append(
            LogProblem(
                path=one.source_path,
                problem=f"{problem} (experiment {experiment}, trial {one.trial_id})",
                expected=said.get(one.key, "no exclusion"),
                found=now.get(one.key, "no exclusion"),
            )
        )


def _of_the_report(store: FreshStore, trials: pa.Table, said: ReportedLogs, listed: LogList | None) -> pa.Table:
    """Return the stored trials of the report's logs; logs that came later are no part of it."""
    hashes = trials.column("source_sha256").to_pylist()
    if joint_sha256(hashes) == said.sha256:
        return trials
    if listed is None or joint_sha256(list(listed.files.values())) != said.sha256:
        found = f"{len(set(hashes))} files, {joint_sha256(hashes)}"
        text = "the stored logs are not those of the report, and no list of these lies beside it"
        name = trials.column("experiment")[0].as_py() if trials.num_rows else "?"
        expected = f"{said.files} files, {said.sha256}"
        store.problems.append(LogProblem(path=f"experiment {name}", problem=text, expected=expected, found=found))
        return trials
    stored = dict(zip(trials.column("source_path").to_pylist(), hashes, strict=True))
    present = set(hashes)
    for name, sha in listed.files.items():
        path = os.path.join(listed.folder, name)
        if sha not in present:
            text = "is not stored as it was when the report was made"
            store.problems.append(LogProblem(path=path, problem=text, expected=sha, found=stored.get(path)))
    # the log that stands where one of the report stood shows what its change does to the numbers
    paths = [os.path.join(listed.folder, name) for name in listed.files]
    ours = pc.or_(_among(trials, "source_sha256", list(listed.files.values())), _among(trials, "source_path", paths))
    if later := trials.num_rows - (pc.sum(ours).as_py() or 0):
        store.notes.append(f"experiment {listed.experiment}: {later} trials were stored later and are left out")
    return trials.filter(ours)


def _readable(store: FreshStore, trials: pa.Table, profiles: Sequence[Path]) -> pa.Array:
    """Return which trials can be read again: the log is there, and so is the profile that read it."""
    known = {p.name: p.digest() for p in (*shipped_profiles(), *(load_profile(path) for path in profiles))}
    here: list[bool] = []
    gone: list[str] = []
    foreign: dict[str, int] = defaultdict(int)
    changed: set[str] = set()
    columns = ("source_path", "profile", "profile_sha256")
    for path, profile, sha in zip(*(trials.column(c).to_pylist() for c in columns), strict=True):
        there = os.path.isfile(path)
        if not there:
            gone.append(path)
        elif profile not in known:
            foreign[profile] += 1
        elif known[profile] != sha:
            changed.add(profile)
        here.append(there and profile in known)
    if gone:
        store.notes.append(
            f"{len(gone)} logs are no longer where they were, such as {gone[0]}: of these the stored samples count"
        )
    for name, count in sorted(foreign.items()):
        store.notes.append(
            f"{count} logs were read by profile {name!r}, which is not shipped: of these the stored samples count. "
            "Give it with --profile to read them again."
        )
    for name in sorted(changed):
        store.notes.append(f"profile {name!r} has changed since the logs were read; they are read by it as it is now")
    return pa.array(here, pa.bool_())


def _read(store: FreshStore, experiment: str, trials: pa.Table, profiles: Sequence[Path]) -> set[str]:
    """Ingest logs from their sources; return the paths that need no stored samples."""
    files = {load_profile(path).name: path for path in profiles}
    by_profile: dict[str, dict[str, str]] = defaultdict(dict)
    columns = ("source_path", "source_sha256", "profile")
    for path, sha, profile in zip(*(trials.column(c).to_pylist() for c in columns), strict=True):
        by_profile[profile][path] = sha
    for profile, sources in by_profile.items():
        report = ingest([Path(path) for path in sources], store.folder, files.get(profile, profile))
        for refusal in report.quarantined:
            store.problems.append(
                LogProblem(
                    path=refusal.path, problem=f"is refused now: {refusal.reason}", expected=sources[refusal.path]
                )
            )
    found = read_trials(store.folder, columns=["source_path", "source_sha256", "experiment"])
    now = dict(zip(*(found.column(c).to_pylist() for c in ("source_path", "source_sha256")), strict=True))
    before = {path: sha for sources in by_profile.values() for path, sha in sources.items()}
    for path, sha in before.items():
        if path in now and now[path] != sha:
            text = f"has changed since it was ingested (experiment {experiment})"
            store.problems.append(LogProblem(path=path, problem=text, expected=sha, found=now[path]))
    return set(before)


def _keep(store: FreshStore, device: str, experiment: str, processed: Path, trials: pa.Table) -> None:
    """Take stored samples over."""
    if not trials.num_rows:
        return
    files, rows = (np.array(trials.column(name).to_pylist()) for name in LOCATION)
    masks = {
        processed / name: np.isin(np.arange(pq.read_metadata(processed / name).num_rows), rows[files == name])
        for name in np.unique(files).tolist()
    }
    parts = chain.from_iterable(trials_of(file, kept) for file, kept in masks.items())
    write_batch(store.folder, Place(device, experiment, trials.column("motion")[0].as_py()), parts)


def _compare_samples(
    store: FreshStore, device: str, experiment: str, processed: Path, trials: pa.Table, said: ReportedLogs
) -> None:
    """Hold what is stored against what was read just now, and against the hash in the report."""
    stored = load_groups(processed, trials)
    fresh_trials = split_trials(read_trials(store.folder, device, experiment), read_exclusions(store.folder))[0]
    fresh = load_groups(store.folder, fresh_trials)
    both = sorted(set(stored.of_trials("trial_id")) & set(fresh.of_trials("trial_id")))
    paths = dict(zip(*(trials.column(c).to_pylist() for c in ("trial_id", "source_path")), strict=True))
    before = len(store.problems)
    for trial in both:
        differs = _difference(fresh.named(trial), stored.named(trial))
        if differs is not None:
            words, expected, found = differs
            problem = f"its stored {words} differs from the log (experiment {experiment}, trial {trial})"
            store.problems.append(LogProblem(path=paths[trial], problem=problem, expected=expected, found=found))
    told = len(store.problems) > before
    same_logs = joint_sha256(trials.column("source_sha256").to_pylist()) == said.sha256
    if same_logs and not told and stored.digest != said.samples:
        text = "its stored samples are not those of the report"
        store.problems.append(
            LogProblem(path=f"experiment {experiment}", problem=text, expected=said.samples, found=stored.digest)
        )


def _difference(fresh: TrialBatch, stored: TrialBatch) -> tuple[str, str, str] | None:
    """Return what differs first in one trial, its value by the log and the stored one; None where nothing does."""
    if fresh.digests == stored.digests:
        return None
    for name in ("rows", "stiffness", "damping", "step", "sampling_period_s"):
        a, b = getattr(fresh, name)[0].item(), getattr(stored, name)[0].item()
        if a != b:
            return name.replace("_", " "), repr(a), repr(b)
    for name in _COLUMNS:
        x, y = (_samples(batch, name)[0, : int(batch.rows[0])] for batch in (fresh, stored))
        differ = (x != y) & ~(np.isnan(x) & np.isnan(y))
        if differ.any():
            sample = int(np.argmax(differ))
            return f"{name} of sample {sample}", repr(x[sample].item()), repr(y[sample].item())
    return None


def _samples(batch: TrialBatch, column: str) -> Floats:
    """Return a column of samples; one that no trial has as NaN."""
    values = getattr(batch, column)
    return np.full_like(batch.position, np.nan) if values is None else np.asarray(values, dtype=np.float64)
