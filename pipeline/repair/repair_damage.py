"""Repairs what `check` found: nothing that can be read is lost, and what cannot is named and kept beside.

The order is that of all writers: what replaces a damaged file is on the disk before that is moved away, so that a
repair may end at any moment and be begun again.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from itertools import count
from pathlib import Path

import pyarrow as pa

from pipeline.base.disk import move, remove, replacing, sync_folder, write_text
from pipeline.base.errors import StoreError
from pipeline.base.inventory import forget
from pipeline.base.lock import WAIT_S, holder, writing
from pipeline.intake.quarantine import RECORD_FILE
from pipeline.intake.versions import repair as finish_writers
from pipeline.profiles.profile_files import load_profile, shipped_profiles
from pipeline.profiles.profile_model import Profile
from pipeline.records.tables import TABLES
from pipeline.repair.check import (
    DAMAGED_FOLDER,
    BatchPlan,
    CheckReport,
    Damage,
    Findings,
    LostTrial,
    damage_of,
    foreseen,
    look,
    lost_trials,
    nameless,
    plan_batch,
    remedy_of,
    restored_exclusions,
    with_ids,
)
from pipeline.repair.reread import read_again, same_logs
from pipeline.repair.salvage import copy_readable, groups_of, unreadable
from pipeline.store.batch_files import NewBatch, remove_batches
from pipeline.store.storage import FILE, batch_number, newest_versions, read_versions


def check(
    processed: Path,
    repair: bool = False,
    profile: str | Path | None = None,
    progress: Callable[[int, int], None] | None = None,
    wait_s: float = WAIT_S,
    say: Callable[[str], None] | None = None,
) -> CheckReport:
    """Hold every stored file against its checksums, and save what can be saved.

    Parameters
    ----------
    processed : Path
    repair : bool
        Else nothing is changed.
    profile : str or Path, optional
        A profile beside the shipped ones, by which logs that are still there may be read again.
    progress : callable, optional
        Called with (files done, files in all).
    wait_s : float
        How long to wait for another command that writes to `processed` [s].
    say : callable, optional
        Gets a line when waiting begins.

    Returns
    -------
    CheckReport

    Raises
    ------
    ProfileError
        If the profile is wrong.
    StoreError
        If `processed` cannot be written, or another command writes there; nothing is lost then.
    """
    profiles = (*shipped_profiles(), *(() if profile is None else (load_profile(profile),)))
    if not repair:
        findings = look(processed, holder(processed) is None, progress)
        return _report(findings, tuple(foreseen(processed, findings, profiles)), False)
    try:
        with writing(processed, wait_s, say):
            finish_writers(processed)
            findings = look(processed, True, progress)
            damage = tuple(_repaired(processed, findings, profiles))
            # trials files that were restored may hold what was superseded since
            finish_writers(processed)
            forget(processed)
            return _report(findings, damage, True)
    except OSError as error:
        raise StoreError(
            f"{processed}: cannot be written ({error}). Nothing was lost; make room or correct the permissions and run "
            "the command again."
        ) from error


def _report(findings: Findings, damage: tuple[Damage, ...], repaired: bool) -> CheckReport:
    return CheckReport(
        files=findings.files, bytes=findings.bytes, unsealed=findings.unsealed, damage=damage, repaired=repaired
    )


def _repaired(processed: Path, findings: Findings, profiles: Sequence[Profile]) -> Iterator[Damage]:
    for trials, faults in findings.batches.items():
        plan = plan_batch(trials, faults)
        for file, content in ((plan.samples, plan.new_samples), (plan.trials, plan.new_trials)):
            if content is not None:
                with replacing(file) as stream:
                    stream.write(content)
        if plan.table is None:
            lost = nameless(plan)
            _set_aside(processed, plan, lost)
            yield damage_of(processed, faults, "set aside", lost=lost)
        elif plan.data is None:
            yield damage_of(processed, faults, "restore", plan.table.num_rows)
        else:
            again, lost = _save(processed, plan, profiles)
            yield damage_of(processed, faults, "save", plan.table.num_rows, again, lost)
    for fault in findings.others:
        remedy = remedy_of(fault.file)
        if remedy == "restore":
            content = restored_exclusions(fault.file)
            assert content is not None, "what is restored was read"
            with replacing(fault.file) as stream:
                stream.write(content)
        elif remedy == "set aside":
            # a refused log goes with its record: it may be the only copy
            beside = fault.file.parent.iterdir() if fault.file.name == RECORD_FILE else [fault.file]
            for file in sorted(beside):
                move(file, _free(processed, file))
        elif remedy == "remove":
            remove(fault.file)
            sync_folder(fault.file.parent)
        yield damage_of(processed, {fault.file: fault.text}, remedy)


def _save(processed: Path, plan: BatchPlan, profiles: Sequence[Profile]) -> tuple[int, tuple[LostTrial, ...]]:
    """Store what can be read of a damaged batch, and what its logs still hold; move the damaged files away."""
    assert plan.data is not None
    wanted = _current(processed, plan.trials)
    gone = unreadable(groups_of(plan.data, plan.footer), wanted)
    again = read_again(processed, same_logs(with_ids(wanted, gone), profiles).values(), gone)
    lost = {trial: one for trial, one in lost_trials(gone, wanted).items() if trial not in again}
    ids = wanted.column("trial_id").to_pylist()
    readable = {trial for trial in ids if trial not in again and not (trial in lost and lost[trial].whole)}
    _publish_readable(processed, plan, with_ids(wanted, readable))
    if lost:
        _set_aside(processed, plan, tuple(lost.values()))
    else:
        remove_batches(processed, [plan.trials])
    return len(again), tuple(lost.values())


def _current(processed: Path, trials: Path) -> pa.Table:
    """Return the trials of a file that no other file holds, or holds in a newer version."""
    table, files = read_versions(processed, None, None, list(TABLES["trials"]), {})
    own = pa.array(newest_versions(table) & (table.column(FILE).to_numpy() == files.index(trials)))
    return table.filter(own).select(TABLES["trials"])


def _publish_readable(processed: Path, plan: BatchPlan, trials: pa.Table) -> None:
    if not trials.num_rows:
        return
    assert plan.data is not None
    device, experiment, motion = (trials.column(name)[0].as_py() for name in ("device", "experiment", "motion"))
    new = NewBatch(processed, device, experiment, motion)
    try:
        kept = copy_readable(groups_of(plan.data, plan.footer), trials, new)
        columns = {name: kept.column(name) for name in TABLES["trials"] if name != "sample_file"}
        # the number stays, since it tells which version of a trial is the newest; another name sorts behind it
        former = plan.trials.name.partition("-")[2]
        mark = "r" * (len(former) - len(former.lstrip("r")) + 1)
        new.publish(columns, batch_number(plan.trials), mark)
    except BaseException:
        new.discard()
        raise


def _set_aside(processed: Path, plan: BatchPlan, lost: tuple[LostTrial, ...]) -> None:
    """Move both files of a batch away, the one that makes it visible first, beside a list of what was lost."""
    if lost:
        names = [one.model_dump(mode="json") for one in lost]
        write_text(
            _free(processed, plan.trials, ".lost.json"),
            json.dumps({"file": plan.trials.name, "lost": names}, indent=1) + "\n",
        )
    for file in (plan.trials, plan.samples):
        if file.exists():
            move(file, _free(processed, file))


def _free(processed: Path, file: Path, ending: str = "") -> Path:
    """Return an unused place in the folder of damaged files; it ends so that no reader of tables takes it for one."""
    place = processed / DAMAGED_FOLDER / file.relative_to(processed)
    names = (place.with_name(f"{place.name}.{number}{ending}") for number in count(1))
    return next(name for name in names if not name.exists())
