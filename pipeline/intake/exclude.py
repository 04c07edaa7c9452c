"""Corrects stored trials by hand, and undoes it: the only writer of what `store.corrections` reads."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from difflib import get_close_matches
from pathlib import Path

from pipeline.base.errors import StoreError, UsageError
from pipeline.base.file_names import path_of_text, path_text, storable
from pipeline.base.lock import WAIT_S, writing
from pipeline.store.corrections import (
    IDENTITY,
    Correction,
    Exclusion,
    read_corrections,
    read_exclusions,
    split_trials,
    write_corrections,
)
from pipeline.store.storage import read_trials

NEAREST = 5
"""Trials that a message shows."""


def exclude(
    processed: Path, wanted: str, reason: str, wait_s: float = WAIT_S, say: Callable[[str], None] | None = None
) -> Exclusion:
    """Exclude a stored trial; one that is excluded already gets the new reason.

    Parameters
    ----------
    processed : Path
    wanted : str
        Its id, the beginning of its id where only one has it, or the path of its log where that holds one trial.
    reason : str
    wait_s, say
        As for `lock.writing`.

    Raises
    ------
    UsageError
        If the reason is blank, or the words fit no stored trial, or several.
    StoreError
        If a stored file is damaged or cannot be written, or others write there.
    """
    text = _reason(reason)
    with _changing(processed, wait_s, say):
        stored = read_trials(processed, columns=list(IDENTITY)).to_pylist()
        (one,) = _exclude(processed, [stored[_place(processed, wanted, stored, "stored")]], text)
    return one


def exclude_experiment(
    processed: Path,
    device: str,
    experiment: str,
    reason: str,
    wait_s: float = WAIT_S,
    say: Callable[[str], None] | None = None,
) -> list[Exclusion]:
    """Exclude all trials of an experiment that are in use, for one reason; parameters and errors as of `exclude`."""
    text = _reason(reason)
    with _changing(processed, wait_s, say):
        trials = read_trials(processed, device, experiment, list(IDENTITY))
        used, _ = split_trials(trials, read_exclusions(processed))
        return _exclude(processed, used.to_pylist(), text)


def use_again(
    processed: Path, wanted: str, wait_s: float = WAIT_S, say: Callable[[str], None] | None = None
) -> Exclusion:
    """Undo the exclusion of a trial and return it; parameters and errors as those of `exclude`."""
    with _changing(processed, wait_s, say):
        known = list(read_exclusions(processed).values())
        one = known[_place(processed, wanted, [one.model_dump() for one in known], "excluded")]
        _use(processed, [one])
    return one


def use_experiment_again(
    processed: Path, device: str, experiment: str, wait_s: float = WAIT_S, say: Callable[[str], None] | None = None
) -> list[Exclusion]:
    """Undo the exclusion of all trials of an experiment; parameters and errors as those of `exclude`."""
    with _changing(processed, wait_s, say):
        known = read_exclusions(processed).values()
        again = [one for one in known if (one.device, one.experiment) == (device, experiment)]
        _use(processed, again)
    return again


def _use(processed: Path, again: Sequence[Exclusion]) -> None:
    known = read_corrections(processed)
    nothing = {"exclusion_reason": "", "excluded_since": ""}
    write_corrections(processed, [known[one.key].model_copy(update=nothing) for one in again])


def _reason(reason: str) -> str:
    text = storable(" ".join(reason.split()))
    if not text:
        raise UsageError('reason is blank, but every report shows why a trial is excluded. Give --reason "<words>".')
    return text


def _exclude(processed: Path, rows: Sequence[Mapping[str, str]], reason: str) -> list[Exclusion]:
    since = datetime.now(UTC).isoformat(timespec="seconds")
    new = {"exclusion_reason": reason, "excluded_since": since}
    known = read_corrections(processed)
    write_corrections(processed, [_correction(known, row).model_copy(update=new) for row in rows])
    return [Exclusion(**row, **new) for row in rows]


def _correction(known: Mapping[str, Correction], row: Mapping[str, str]) -> Correction:
    """Return what is corrected of a trial; it is given by a row of the trials table, with its present place."""
    return known[row["trial_id"]] if row["trial_id"] in known else Correction(**row)


@contextmanager
def _changing(processed: Path, wait_s: float, say: Callable[[str], None] | None) -> Iterator[None]:
    try:
        with writing(processed, wait_s, say):
            yield
    except OSError as error:
        raise StoreError(
            f"{processed}: cannot be written ({error}). What was excluded before still is; make room or correct the "
            "permissions and run the command again."
        ) from error


def _place(processed: Path, wanted: str, rows: Sequence[Mapping[str, str]], state: str) -> int:
    """Return the place of the one row that is meant by an id, the beginning of one, or a path."""
    path = wanted if path_of_text(wanted) != Path(wanted) else path_text(os.path.abspath(wanted))
    tests: tuple[Callable[[Mapping[str, str]], bool], ...] = (
        lambda row: row["trial_id"] == wanted,
        lambda row: row["source_path"] in (wanted, path),
        lambda row: bool(wanted) and row["trial_id"].startswith(wanted),
    )
    for test in tests:
        found = [place for place, row in enumerate(rows) if test(row)]
        if len(found) == 1:
            return found[0]
        if found:
            raise UsageError(
                f"{wanted}: fits {len(found)} {state} trials: {_shown([rows[place] for place in found])}. Give one id."
            )
    names = [row["trial_id"] for row in rows] + [row["source_path"] for row in rows]
    near = dict.fromkeys(get_close_matches(wanted, names, NEAREST, 0.5) + get_close_matches(path, names, NEAREST, 0.8))
    nearest = _shown([row for name in near for row in rows if name in (row["trial_id"], row["source_path"])])
    raise UsageError(
        f"{wanted}: is no {state} trial of {processed}, by id, beginning of an id, or path of its log. "
        + (f"Nearest: {nearest}." if nearest else f"{len(rows)} are {state}.")
    )


def _shown(rows: Sequence[Mapping[str, str]]) -> str:
    shown = [
        f"{row['trial_id']} ({Path(row['source_path']).name}{', ' + row['label'] if row['label'] else ''})"
        for row in rows[:NEAREST]
    ]
    return ", ".join(shown) + (", ..." if len(rows) > NEAREST else "")
