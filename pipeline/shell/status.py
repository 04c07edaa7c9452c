"""What is stored, and what of it no longer fits the logs, the code or each other; nothing is changed."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipeline.base.errors import PipelineError, StoreError
from pipeline.base.lock import holder
from pipeline.base.paths import is_gone, path_of_text
from pipeline.comparison.compare import compare
from pipeline.comparison.scene.scene import RUN
from pipeline.device_data.devices import declared_spring, known_devices
from pipeline.intake.quarantine import list_quarantine
from pipeline.measured.stages.stages import STAGES, ExperimentStages
from pipeline.profiles.profile_files import shipped_profiles
from pipeline.records.findings import Record
from pipeline.store.corrections import Exclusion, Key, read_exclusions, split_trials
from pipeline.store.names import report_of
from pipeline.store.storage import natural_key, read_trials, stage_file, steadily

UNCODED = "other"
"""Key of refusals by a version that gave no codes."""


class ExperimentStatus(Record):
    """What is stored of an experiment.

    Parameters
    ----------
    device, experiment : str
    trials, rows : int
        Trials and their samples, those of excluded trials included.
    batches : int
        Files.
    stale : tuple of str
        Stored stages whose logs, code or earlier stages changed; they are computed anew when they are needed.
    """

    device: str
    experiment: str
    trials: int
    rows: int
    batches: int
    stale: tuple[str, ...]


class ExcludedStatus(Exclusion):
    """A trial that is excluded by hand; not ``stored`` where its log has had other content since."""

    stored: bool


class ReportStatus(Record):
    """A report, and which of its parts would be made anew and why; nothing where it is up to date."""

    report: str
    device: str
    stale: tuple[str, ...]


class Writer(Record):
    """Who holds the lock: process, host, since when (UTC)."""

    pid: int | None
    host: str | None
    since: str | None


class Status(Record):
    """State of a store.

    Parameters
    ----------
    processed : str
    devices, trials, rows : int
    files, bytes : int
        Parquet files below `processed`, and the size of all files there [byte].
    experiments : tuple of ExperimentStatus
    reports : tuple of ReportStatus
    removed : tuple of str
        Stored sources whose file is gone.
    changed : tuple of str
        Stored sources whose file has another size or time than when it was read. Of a log of several files, only the
        time of the first is compared: `pipeline ingest` knows for certain.
    excluded : tuple of ExcludedStatus
        Trials that are kept and not used.
    quarantined : dict of str to int
        Refused logs by the code of the reason.
    lock : Writer or None
        Who writes at this moment.
    damaged : tuple of str
        Files that cannot be read, with what to do; they are not counted. `pipeline check` looks at every byte.
    """

    processed: str
    devices: int
    trials: int
    rows: int
    files: int
    bytes: int
    experiments: tuple[ExperimentStatus, ...]
    reports: tuple[ReportStatus, ...]
    removed: tuple[str, ...]
    changed: tuple[str, ...]
    excluded: tuple[ExcludedStatus, ...]
    quarantined: dict[str, int]
    lock: Writer | None
    damaged: tuple[str, ...] = ()


def status(processed: Path, reports: Path | None = None) -> Status:
    """Return the state of a store.

    Parameters
    ----------
    processed : Path
        An absent folder is an empty store.
    reports : Path, optional
        Folder with the reports of `pipeline compare`; without it none is looked at.

    Raises
    ------
    StoreError
        If others write there all the time.
    """
    return steadily(processed / "trials", lambda: _status(processed, reports))


def _status(processed: Path, reports: Path | None) -> Status:
    held = holder(processed)
    damaged: dict[Path, str] = {}
    trials = read_trials(processed, damaged=damaged)
    exclusions = _exclusions(processed, damaged)
    experiments = _experiments(processed, trials, exclusions)
    removed, changed = _sources(trials)
    sizes = _sizes(processed)
    refused = list_quarantine(processed, damaged)
    # who ended meanwhile may have written what was just listed
    held = held or holder(processed)
    return Status(
        processed=str(processed),
        devices=len({e.device for e in experiments}),
        trials=trials.num_rows,
        rows=sum(e.rows for e in experiments),
        files=sum(path.suffix == ".parquet" for path in sizes),
        bytes=sum(sizes.values()),
        experiments=experiments,
        reports=_reports(processed, reports, sorted({e.device for e in experiments})),
        removed=removed,
        changed=changed,
        excluded=_excluded(trials, exclusions),
        quarantined=dict(sorted(Counter(r.code or UNCODED for r in refused).items())),
        lock=None if held is None else Writer(pid=held.pid, host=held.host, since=held.since),
        damaged=tuple(sorted(damaged.values())),
    )


def _sizes(folder: Path) -> dict[Path, int]:
    """Return the size of each file below a folder [byte]."""
    sizes = {}
    for here, _, names in os.walk(folder):
        for name in names:
            with suppress(FileNotFoundError):  # renamed or removed by who writes there
                sizes[Path(here, name)] = os.lstat(os.path.join(here, name)).st_size
    return sizes


def _experiments(
    processed: Path, trials: pa.Table, exclusions: Mapping[Key, Exclusion]
) -> tuple[ExperimentStatus, ...]:
    pairs = set(zip(trials.column("device").to_pylist(), trials.column("experiment").to_pylist(), strict=True))
    found = []
    known = known_devices()
    # in one piece: else each selection goes through as many pieces as there are batches
    trials = trials.combine_chunks()
    for device, experiment in sorted(pairs, key=lambda pair: (pair[0], natural_key(pair[1]))):
        own = trials.filter(
            pc.and_(pc.equal(trials.column("device"), device), pc.equal(trials.column("experiment"), experiment))
        )
        spring = declared_spring(known.get(device), experiment)
        stages = ExperimentStages(processed, device, experiment, *split_trials(own, exclusions), spring)
        stale = [
            stage
            for stage in STAGES
            if stage_file(processed, device, experiment, stage) is not None and not stages.is_stored(stage)
        ]
        found.append(
            ExperimentStatus(
                device=device,
                experiment=experiment,
                trials=own.num_rows,
                rows=int(np.sum(own.column("rows").to_numpy())),
                batches=len(own.column("sample_file").unique()),
                stale=tuple(stale),
            )
        )
    return tuple(found)


def _exclusions(processed: Path, damaged: dict[Path, str]) -> Mapping[Key, Exclusion]:
    try:
        return read_exclusions(processed)
    except StoreError as error:
        damaged[processed / "corrections"] = str(error)
        return {}


def _excluded(trials: pa.Table, exclusions: Mapping[Key, Exclusion]) -> tuple[ExcludedStatus, ...]:
    """Return the exclusions, each as its trial is stored now."""
    now = {one.key: one for one in split_trials(trials, exclusions)[1]}
    return tuple(ExcludedStatus(**now.get(k, one).model_dump(), stored=k in now) for k, one in exclusions.items())


def _reports(processed: Path, reports: Path | None, devices: list[str]) -> tuple[ReportStatus, ...]:
    found = []
    for device in devices if reports is not None else ():
        assert reports is not None
        file = report_of(reports, device)
        if not file.is_file():
            continue
        try:
            plan = compare(device, processed, report=file, dry_run=True).stages
            stale = [f"{name}: {reason}" for name, action, reason in plan if action == RUN]
        except PipelineError as error:
            stale = [str(error)]
        found.append(ReportStatus(report=str(file), device=device, stale=tuple(stale)))
    return tuple(found)


def _sources(trials: pa.Table) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the sources that are gone, and those that changed."""
    single = {profile.name for profile in shipped_profiles() if profile.partner is None}
    columns = ("source_path", "source_size", "source_mtime_ns", "profile")
    removed, changed = [], []
    for key, size, mtime_ns, profile in sorted(set(zip(*(trials.column(c).to_pylist() for c in columns), strict=True))):
        path = path_of_text(key)
        try:
            state = path.stat()
        except OSError:
            # what may not be looked at is not known to have changed; a link that leads nowhere holds no log
            if is_gone(path) or path.is_symlink():
                removed.append(key)
            continue
        whole = profile in single and path.is_file()
        if (whole and (state.st_size, state.st_mtime_ns) != (size, mtime_ns)) or state.st_mtime_ns > mtime_ns:
            changed.append(key)
    return tuple(removed), tuple(changed)
