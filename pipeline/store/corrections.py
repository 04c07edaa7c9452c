"""Correct stored trials manually. Functions that exclude, move or delete trials. Every correction can be undone.

Corrections are stored in ``processed/corrections`` and applied when trials are read (`storage`), so that stored trials
agree with the logs. A correction refers to the content of a log. It remains valid if the same log is ingested, merged
or repaired again. A log with different content is a different trial. Each change writes a new file with all
corrections, then removes the files that were read. Two files written at the same time are both valid.

All functions take a text that selects trials: a device, ``device/experiment`` (as encoded by `names.folder_name`), the
id of a trial or its first characters, or the path of a log with one trial. ``wait_s`` and ``say`` are explained in
`disk.writing`. The functions raise `UsageError` if the text matches nothing or is ambiguous, and `StoreError` if the
store is damaged, cannot be written, or is locked by another process.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from pipeline.base.disk import WAIT_S, new_file, remove_all, writing
from pipeline.base.errors import UsageError
from pipeline.base.paths import path_of_text, path_text, storable
from pipeline.base.provenance import stamp
from pipeline.base.wording import counted
from pipeline.records.table_files import parquet_bytes
from pipeline.records.tables import TABLES, to_arrow
from pipeline.store.batch_files import remaining_rows, rewrite
from pipeline.store.names import name_of_folder
from pipeline.store.storage import (
    IDENTITY,
    TABLE,
    Correction,
    Exclusion,
    corrections_files,
    read_corrections,
    read_exclusions,
    read_rows,
    read_trials,
    same_period,
)

SHOWN = 5
"""Largest number of trials listed in a message."""

Say = Callable[[str], None] | None


def exclude(processed: Path, wanted: str, reason: str, wait_s: float = WAIT_S, say: Say = None) -> list[Exclusion]:
    """Exclude trials. A trial that is already excluded gets the new reason only if the text selects just this trial."""
    text = storable(" ".join(reason.split()))
    if not text:
        raise UsageError(
            'the reason is blank, but every report must show why a trial is excluded. Give --reason "<words>".'
        )
    with writing(processed, wait_s, say):
        rows = _meant(processed, wanted)
        out = read_exclusions(processed)
        rows = [row for row in rows if len(rows) == 1 or row["trial_id"] not in out]
        new = {"exclusion_reason": text, "excluded_since": datetime.now(UTC).isoformat(timespec="seconds")}
        _correct(processed, rows, new)
    return [Exclusion(**row, **new) for row in rows]


def use_again(processed: Path, wanted: str, wait_s: float = WAIT_S, say: Say = None) -> list[Exclusion]:
    """Undo the exclusion of trials, and return the former exclusions."""
    with writing(processed, wait_s, say):
        known = read_exclusions(processed)
        rows = _meant(processed, wanted, "excluded", known.values())
        _correct(processed, rows, {"exclusion_reason": "", "excluded_since": ""})
    return [known[row["trial_id"]] for row in rows]


def move(processed: Path, wanted: str, to: str, wait_s: float = WAIT_S, say: Say = None) -> int:
    """Move trials to a different device, or a different ``device/experiment``, and return their number.

    Raises
    ------
    UsageError
        If the trials at the destination have a different type of motion or a different sampling period.
    """
    place = _place_of(to)
    if len(place) > 2 or not all(place):
        raise UsageError(f"{to}: invalid destination. Write DEVICE, or DEVICE/EXPERIMENT (a slash in a name as %2F).")
    with writing(processed, wait_s, say):
        more = ("motion", "sampling_period_s")
        stored = read_trials(processed, columns=[*IDENTITY, *more]).to_pylist()
        rows = _meant(processed, wanted)
        loops: dict[str, set[tuple[str, float]]] = {}
        moved = {row["trial_id"] for row in rows}
        for row in stored:
            experiment = place[1] if len(place) > 1 else row["experiment"]
            if row["trial_id"] in moved or (row["device"], row["experiment"]) == (place[0], experiment):
                loops.setdefault(experiment, set()).add(tuple(row[name] for name in more))
        for experiment, found in loops.items():
            (motion, period), *others = sorted(found)
            if any(other != motion or not same_period(period, apart) for other, apart in others):
                raise UsageError(
                    f"{wanted}: cannot be moved to {place[0]}, experiment {experiment}, because the motion or the "
                    f"sampling period differs ({', '.join(f'{m}, {1e3 * t:.4g} ms' for m, t in sorted(found))}). "
                    "Choose another name."
                )
        return _correct(processed, rows, dict(zip(("moved_device", "moved_experiment"), place, strict=False)))


def delete(processed: Path, wanted: str, wait_s: float = WAIT_S, say: Say = None) -> int:
    """Move trials to the bin, and return their number. They stay stored but unused until `empty_bin`."""
    with writing(processed, wait_s, say):
        return _correct(processed, _meant(processed, wanted), {"deleted": True})


def restore(processed: Path, wanted: str, wait_s: float = WAIT_S, say: Say = None) -> int:
    """Take trials out of the bin, and return their number.

    Trials that `empty_bin` has removed reappear when their logs are ingested again.
    """
    with writing(processed, wait_s, say):
        return _correct(processed, _meant(processed, wanted, "deleted", deleted(processed)), {"deleted": False})


def deleted(processed: Path) -> list[Exclusion]:
    """Return all deleted trials with their former device and experiment. Their samples may already have been removed
    from the store."""
    return [one.at_place for one in read_corrections(processed).values() if one.deleted]


def in_bin(processed: Path) -> list[Exclusion]:
    """Return the deleted trials that are still stored."""
    if not (gone := deleted(processed)):
        return []
    stored = set(read_rows(processed, ["trial_id"], {}).column("trial_id"))
    return [one for one in gone if one.trial_id in stored]


def empty_bin(processed: Path, wait_s: float = WAIT_S, say: Say = None) -> int:
    """Remove the trials in the bin from the store, and return their number.

    The trials remain marked as deleted. If their logs are ingested again, they return to the bin.
    """
    with writing(processed, wait_s, say):
        gone, rows = {one.trial_id for one in deleted(processed)}, read_rows(processed, ["trial_id"], {})
        kept = remaining_rows(rows, np.array([trial not in gone for trial in rows.column("trial_id")], dtype=np.bool_))
        for file in kept:
            rewrite(processed, [file], kept)
    return len(gone.intersection(rows.column("trial_id")))


def _correct(processed: Path, rows: Sequence[Mapping[str, str]], change: Mapping[str, object]) -> int:
    """Change the corrections of trials, and return the number of trials.

    The rows contain the current device and experiment of each trial.
    """
    known = read_corrections(processed)
    new = []
    for row in rows:
        former = known.get(row["trial_id"])
        now = {name: row[name] for name in IDENTITY} if former is None else former.model_dump()
        new.append(Correction.model_validate({**now, **change}))
    write_corrections(processed, new)
    return len(rows)


def write_corrections(processed: Path, new: Iterable[Correction]) -> None:
    """Add corrections to the stored corrections in one step. The caller must have locked the store."""
    known, former = read_corrections(processed), corrections_files(processed)
    now, added = max([time.time_ns(), *(one.corrected_ns + 1 for one in known.values())]), {o.trial_id: o for o in new}
    rows = [
        {**one.model_dump(), "corrected_ns": now if trial in added else one.corrected_ns}
        for trial, one in (known | added).items()
    ]
    columns = {name: [row[name] for row in rows] for name in TABLES["corrections"]}
    with new_file(processed / "corrections", ending=TABLE) as file:
        file.stream.write(parquet_bytes(to_arrow("corrections", columns, metadata=stamp())))
    remove_all(old for old in former if old != file.path)


def copy_corrections(processed: Path, ids: Mapping[str, str]) -> None:
    """Copy corrections of trials to new ids, because their logs were renamed. ``ids`` maps former ids to new ids."""
    known = read_corrections(processed)
    rows = [(now, known[old].model_dump()) for old, now in ids.items() if old in known]
    if rows:
        write_corrections(processed, [Correction.model_validate({**row, "trial_id": now}) for now, row in rows])


def _place_of(word: str) -> tuple[str, ...]:
    return tuple(map(name_of_folder, word.split("/")))


def _meant(
    processed: Path, wanted: str, state: str = "stored", among: Iterable[Exclusion] | None = None
) -> list[dict[str, str]]:
    """Return the rows of a device or experiment, or the row selected by an id, its first characters, or a path."""
    rows: list[dict[str, str]] = [one.model_dump() for one in among or ()]
    if among is None:
        rows = read_trials(processed, columns=list(IDENTITY)).to_pylist()
    place = _place_of(wanted)
    if own := [row for row in rows if (row["device"], row["experiment"])[: len(place)] == place]:
        return own
    path = wanted if path_of_text(wanted) != Path(wanted) else path_text(os.path.abspath(wanted))
    for found in (
        [row for row in rows if row["trial_id"] == wanted],
        [row for row in rows if row["source_path"] in (wanted, path)],
        [row for row in rows if wanted and row["trial_id"].startswith(wanted)],
    ):
        if len(found) > 1:
            shown = (
                f"{row['trial_id']} ({Path(row['source_path']).name}{', ' + row['label'] if row['label'] else ''})"
                for row in found[:SHOWN]
            )
            more = ", ..." * (len(found) > SHOWN)
            raise UsageError(f"{wanted}: matches {len(found)} {state} trials: {', '.join(shown)}{more}. Give one id.")
        if found:
            return found
    raise UsageError(
        f"{wanted}: not found. No id (or its first characters), log path, device or DEVICE/EXPERIMENT of the {state} "
        f"trials in {processed} matches. {counted(len(rows), 'trial')} {'is' if len(rows) == 1 else 'are'} {state}."
    )
