"""Holds every stored file against its checksums, and tells of each damaged one what can be saved.

Nothing is changed here; `repair_damage` does what is told.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.base.inventory import missing
from pipeline.base.json_seal import DamageError, unsealed_json
from pipeline.base.provenance import sha256 as hash_of
from pipeline.base.seal import footer_of, mended, sealed, verify
from pipeline.intake.compaction import unseen_trials
from pipeline.intake.quarantine import RECORD_FILE, QuarantineRecord
from pipeline.intake.rerun import NOTE_FILE
from pipeline.profiles.profile_model import Profile
from pipeline.records.findings import Record
from pipeline.records.table_files import parquet_bytes
from pipeline.records.tables import TABLES
from pipeline.repair.reread import same_logs
from pipeline.repair.salvage import NEEDED, groups_of, unreadable
from pipeline.store.batch_files import pack_annex, samples_footer, trials_bytes
from pipeline.store.storage import EXCLUSIONS_FILE, partner_of, read_versions

DAMAGED_FOLDER = "damaged"
"""Folder below `processed` for files of which something could not be saved; nothing there is ever removed."""

DELETED = "was stored and has been deleted: put it back, or ingest its logs again"

Remedy = Literal["restore", "save", "remove", "set aside", "forget"]
"""What is done with a damaged file: made as it was written; its readable trials kept and the others read again from
their logs; removed, since it is computed anew; moved away, where nobody can tell what it said; no longer missed, where
it was deleted."""


class LostTrial(Record):
    """A trial of which something cannot be saved: its id (the start of the log's SHA-256), log, and lost columns."""

    trial_id: str
    source_path: str | None
    columns: tuple[str, ...]

    @property
    def whole(self) -> bool:
        """Whether the trial itself is lost, and not only a column that it can do without."""
        return not set(NEEDED).isdisjoint(self.columns)


class Damage(Record):
    """A damaged file, and what becomes of its trials.

    Parameters
    ----------
    file : str
        Below `processed`; of a batch the samples file, where both are damaged.
    fault : str
    remedy : {"restore", "save", "remove", "set aside", "forget"}
    trials, read_again : int
        Trials that the file holds, and those of them that are read again from their logs.
    lost : tuple of LostTrial
        Those that lose something.
    """

    file: str
    fault: str
    remedy: Remedy
    trials: int = 0
    read_again: int = 0
    lost: tuple[LostTrial, ...] = ()


class CheckReport(Record):
    """What a check found.

    Parameters
    ----------
    files, bytes : int
        Files that were looked at, and their size.
    unsealed : int
        Those written by an earlier version: they have checksums of their pages alone, or none.
    damage : tuple of Damage
    repaired : bool
        Whether it was repaired; else it is told what a repair would do.
    """

    files: int
    bytes: int
    unsealed: int
    damage: tuple[Damage, ...]
    repaired: bool = False


@dataclass(frozen=True)
class Fault:
    """A damaged file and what is wrong with it."""

    file: Path
    text: str


@dataclass(frozen=True)
class Findings:
    """Damaged files by kind: batches by their trials file, others; and what was looked at."""

    batches: dict[Path, dict[Path, str]]
    others: tuple[Fault, ...]
    files: int
    bytes: int
    unsealed: int


@dataclass(frozen=True)
class BatchPlan:
    """How a damaged batch is saved.

    Parameters
    ----------
    trials, samples : Path
    new_trials, new_samples : bytes or None
        Content to be written in place of a damaged file; None where it is whole or cannot be restored.
    table : pyarrow.Table or None
        Its trials; None where nobody can tell.
    data, footer : bytes or None
        The samples file as it is and its footer as it was written, where its readable part has to be saved.
    """

    trials: Path
    samples: Path
    new_trials: bytes | None
    new_samples: bytes | None
    table: pa.Table | None
    data: bytes | None = None
    footer: bytes | None = None


def look(processed: Path, alone: bool, progress: Callable[[int, int], None] | None = None) -> Findings:
    """Read every stored file and return those that are not as they were written.

    Parameters
    ----------
    processed : Path
    alone : bool
        Whether nobody writes there: samples without a trials file are then no batch on its way.
    progress : callable, optional
        Called with (files done, files in all).
    """
    tables = {name: sorted((processed / name).rglob("*.parquet")) for name in ("trials", "samples", "stages")}
    others = sorted((processed / "theory").glob("*.json")) + sorted((processed / "quarantine").glob(f"*/{RECORD_FILE}"))
    single = (processed / name for name in (EXCLUSIONS_FILE, "accuracy.json", NOTE_FILE))
    others += [file for file in single if file.is_file()]
    files = [*tables["trials"], *tables["samples"], *tables["stages"], *others]
    faults: dict[Path, str] = {}
    size = unsealed = 0
    for done, file in enumerate(files, 1):
        try:
            size += file.stat().st_size
            unsealed += not (table_is_sealed(file) if file.suffix == ".parquet" else document_is_sealed(file))
        except FileNotFoundError:  # merged or computed anew meanwhile
            continue
        except (pa.ArrowException, OSError, ValueError) as error:
            faults[file] = str(error) or "cannot be read"
        if progress:
            progress(done, len(files))
    batches = _batches(processed, tables, faults, alone)
    rest = [Fault(file, faults[file]) for file in (*tables["stages"], *others) if file in faults]
    halves = {half for trials in batches for half in (trials, partner_of(trials))}
    deleted = [processed / name for name in missing(processed)]
    rest += [Fault(file, DELETED) for file in deleted if file not in halves]
    return Findings(batches, tuple(rest), len(files), size, unsealed)


def table_is_sealed(file: Path) -> bool:
    """Hold a stored table against its checksums; return whether every byte has one.

    Raises
    ------
    DamageError, pyarrow.ArrowException, OSError
        If it is damaged.
    """
    if verify(file):
        return True
    with pq.ParquetFile(file, page_checksum_verification=True) as table:
        for group in range(table.num_row_groups):
            table.read_row_group(group)
    return False


def document_is_sealed(file: Path) -> bool:
    """Hold a stored JSON document against its checksum; return whether it has one.

    Raises
    ------
    ValueError
        If it is damaged, or a record of quarantine says what none can say, or its copy of the log is another.
    """
    data = file.read_bytes()
    if file.name == NOTE_FILE:  # an object a line
        for line in data.splitlines(keepends=True):
            unsealed_json(line)
        return data.startswith(b'{"checksum"')
    document = unsealed_json(data)
    if file.name == RECORD_FILE:
        sha256 = QuarantineRecord.model_validate(document).sha256
        hashes = [hash_of(copy.read_bytes()) for copy in sorted(file.parent.iterdir()) if copy != file]
        # of a pair it is that of both hashes, in the order of the pair; the order of a bag is not known
        joined = (
            [hash_of((first + second).encode()) for first, second in permutations(hashes)] if len(hashes) == 2 else []
        )
        if sha256 is not None and len(hashes) in (1, 2) and sha256 not in (joined or hashes):
            raise DamageError("the copy of the refused log differs from its SHA-256")
    return data.startswith(b'{"checksum"')


def _batches(
    processed: Path, tables: dict[str, list[Path]], faults: dict[Path, str], alone: bool
) -> dict[Path, dict[Path, str]]:
    """Return the faults of the two files of each damaged batch, those that are missing included."""
    stored: pa.Table | None = None
    found = {}
    for trials in sorted({*tables["trials"], *(partner_of(file) for file in tables["samples"])}):
        samples = partner_of(trials)
        own = {file: faults[file] for file in (trials, samples) if file in faults}
        # a writer makes samples visible first, and removes them last
        absent = [file for file in (samples, trials) if not file.exists()]
        if len(absent) == 2:
            continue
        if absent == [samples]:
            own[samples] = "is missing"
        elif absent and (alone or samples in own):
            if stored is None:
                stored, _ = read_versions(processed, None, None, ["trial_id", "source_path"], {})
            # what an interrupted writer left holds nothing else
            if samples in own or unseen_trials(samples, stored) is not None:
                own[trials] = "is missing, or was not yet written by an interrupted ingest"
        elif not own and (short := _too_short(trials, samples)):
            own[samples] = short
        if own:
            found[trials] = own
    return found


def _too_short(trials: Path, samples: Path) -> str | None:
    table = pq.read_table(trials, columns=["first_row", "rows"])
    needed = int(np.max(table.column("first_row").to_numpy() + table.column("rows").to_numpy(), initial=0))
    present = pq.read_metadata(samples).num_rows
    return f"has {present} rows, its trials {needed}" if present < needed else None


def plan_batch(trials: Path, faults: dict[Path, str]) -> BatchPlan:
    """Return how a damaged batch is saved; files are read, none is changed."""
    samples = partner_of(trials)
    data = samples.read_bytes() if samples.exists() else b""
    new_samples = mended(data) if samples in faults else None
    new_trials = None
    if trials in faults:
        new_trials = _restored_trials(trials, new_samples or data)
    content = new_trials if trials in faults else trials.read_bytes()
    table = None if content is None else pq.read_table(pa.BufferReader(content))
    if samples not in faults or new_samples is not None:
        return BatchPlan(trials, samples, new_trials, new_samples, table)
    footer = None if content is None else samples_footer(content)
    return BatchPlan(trials, samples, new_trials, None, table, data, footer)


def _restored_trials(trials: Path, samples: bytes) -> bytes | None:
    """Return a trials file as it was written: by its parity, by the copy in the samples file, or by its pages."""
    data = trials.read_bytes() if trials.exists() else b""
    whole = mended(data)
    if whole is not None:
        return whole
    table = trials_bytes(samples) or _by_pages(data)
    return None if table is None else sealed(table, pack_annex(footer_of(samples)))


def restored_exclusions(file: Path) -> bytes | None:
    """Return what is excluded as it was written, by the parity or by the pages; None where neither tells."""
    data = file.read_bytes()
    whole = mended(data)
    if whole is None and (table := _by_pages(data)) is not None:
        names = pq.read_schema(pa.BufferReader(table)).names
        whole = sealed(table) if names == list(TABLES["exclusions"]) else None
    return whole


def _by_pages(data: bytes) -> bytes | None:
    """Return a Parquet file of all pages of a damaged one, ready to be sealed; None where one of them is damaged."""
    try:
        with pq.ParquetFile(pa.BufferReader(data), page_checksum_verification=True) as file:
            return parquet_bytes(file.read())
    except (pa.ArrowException, OSError, ValueError):
        return None


def lost_trials(gone: Mapping[str, tuple[str, ...]], trials: pa.Table) -> dict[str, LostTrial]:
    """Return the trials that lose columns, by id."""
    paths = dict(zip(*(trials.column(name).to_pylist() for name in ("trial_id", "source_path")), strict=True))
    return {
        trial: LostTrial(trial_id=trial, source_path=paths[trial], columns=columns) for trial, columns in gone.items()
    }


def nameless(plan: BatchPlan) -> tuple[LostTrial, ...]:
    """Return the trials of a batch whose trials file cannot be restored: the ids are all that is known."""
    ids: dict[str, None] = {}
    with_ids = pa.BufferReader(plan.data or plan.new_samples or plan.samples.read_bytes())
    try:
        with pq.ParquetFile(with_ids, page_checksum_verification=True) as file:
            for batch in file.iter_batches(columns=["trial_id"], use_threads=False):
                ids |= dict.fromkeys(batch.column(0).unique().to_pylist())
    except (pa.ArrowException, OSError, ValueError):  # those before the damage
        pass
    return tuple(LostTrial(trial_id=trial, source_path=None, columns=NEEDED) for trial in ids)


def with_ids(trials: pa.Table, ids: Collection[str]) -> pa.Table:
    """Return the rows of trials whose id is one of these."""
    return trials.filter(pa.array([trial in ids for trial in trials.column("trial_id").to_pylist()], pa.bool_()))


def foreseen(processed: Path, findings: Findings, profiles: Sequence[Profile]) -> Iterator[Damage]:
    """Yield what a repair would do."""
    for trials, faults in findings.batches.items():
        plan = plan_batch(trials, faults)
        if plan.table is None:
            yield damage_of(processed, faults, "set aside", lost=nameless(plan))
            continue
        if plan.data is None:
            yield damage_of(processed, faults, "restore", plan.table.num_rows)
            continue
        gone = unreadable(groups_of(plan.data, plan.footer), plan.table)
        logs = same_logs(with_ids(plan.table, gone), profiles)
        lost = tuple(one for one in lost_trials(gone, plan.table).values() if one.source_path not in logs)
        yield damage_of(processed, faults, "save", plan.table.num_rows, len(gone) - len(lost), lost)
    for fault in findings.others:
        yield damage_of(processed, {fault.file: fault.text}, remedy_of(fault.file))


def remedy_of(file: Path) -> Remedy:
    """Return what is done with a damaged file that is none of a batch."""
    if not file.exists():
        return "forget"
    if file.name == EXCLUSIONS_FILE:
        return "set aside" if restored_exclusions(file) is None else "restore"
    return "set aside" if file.name == RECORD_FILE else "remove"


def damage_of(
    processed: Path,
    faults: dict[Path, str],
    remedy: Remedy,
    trials: int = 0,
    read_again: int = 0,
    lost: tuple[LostTrial, ...] = (),
) -> Damage:
    """Return the record of a damaged file, or of a batch with both."""
    names = {file: os.path.relpath(file, processed) for file in faults}
    (file, text), *rest = reversed(faults.items())
    more = "".join(f"; {names[other]}: {fault}" for other, fault in rest)
    return Damage(
        file=Path(names[file]).as_posix(),
        fault=text + more,
        remedy=remedy,
        trials=trials,
        read_again=read_again,
        lost=lost,
    )
