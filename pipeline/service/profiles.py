"""Profiles of the lab (TOML) in addition to the shipped ones. Profiles are drafted and tried as on the command line.

For drafts and previews, a separate process reads the uploaded files. The process is terminated if it takes too long.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import threading
import time
import tomllib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.base.disk import make_folder, write_text
from pipeline.base.errors import ProfileError
from pipeline.base.provenance import schema_folder
from pipeline.base.wording import counted
from pipeline.profiles.profile_files import find_questions, read_profile, shipped_profiles
from pipeline.records.findings import Record
from pipeline.records.native import OF_WALL
from pipeline.service.problems import Problem
from pipeline.service.settings import Settings

NAME = r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$"
LONGEST = 100_000
"""Largest number of characters of a profile."""

WAIT_S, DRAFT_S = 30.0, 86400.0
"""Time limit of a draft or preview, and retention time of samples [s]."""

_REMARKS = 5
"""Largest number of contradictions that are listed as remarks in a profile."""

_AT_WORK = threading.Lock()


def names(settings: Settings) -> list[str]:
    """Return the names of all profiles, first those of the lab."""
    own = sorted(file.stem for file in (settings.data / "profiles").glob("*.toml"))
    return [*own, *(profile.name for profile in shipped_profiles() if profile.name not in own)]


def profile_path(settings: Settings, name: str) -> str | Path | None:
    """Return a profile in the form that an ingest accepts: the file of a profile of the lab, the name of a shipped
    profile, or None for an empty name.
    """
    own = settings.data / "profiles" / f"{name}.toml"
    if not name or (re.match(NAME, name) and own.is_file()):
        return own if name else None
    if name not in names(settings):
        raise Problem(422, "There is no such profile.", where="profile", expected=names(settings), found=name)
    return name


def text_of(settings: Settings, name: str) -> str:
    """Return the TOML of a profile."""
    for folder in (settings.data, schema_folder()):
        if (file := folder / "profiles" / f"{name}.toml").is_file():
            return file.read_text("utf-8")
    raise Problem(404, "There is no such profile.", where="name", found=name)


def checked_text(settings: Settings, name: str, text: str) -> tuple[str, str]:
    """Return the text of a profile with its new name, and the hash of the profile.

    Raises
    ------
    Problem
        If a shipped profile has the same name, or if the profile is invalid.
    """
    if name in {profile.name for profile in shipped_profiles()}:
        raise Problem(409, "A shipped profile has this name. Choose another one.", where="name", found=name)
    folder = settings.data / "profiles"
    make_folder(folder)
    trial = folder / f".{name}.tmp"
    text = re.sub(r"(?m)^name *=.*$", f'name = "{name}"', text, count=1)
    write_text(trial, text)
    try:
        profile = read_profile(trial)
        refuse_sheet(profile.sheet is not None)
        return text, profile.digest
    except ProfileError as error:
        raise Problem(422, str(error).replace(str(trial), f"{name}.toml"), where="profile") from error
    finally:
        trial.unlink(missing_ok=True)


def refuse_sheet(has_sheet: bool) -> None:
    """Refuse a profile with a sheet, because the path of the sheet would refer to a file on the server.

    Raises
    ------
    Problem
        If the profile has a sheet.
    """
    if has_sheet:
        raise Problem(
            422,
            "A profile in the service cannot name a sheet. Write the rows of the sheet as [[file]] entries, as "
            "`pipeline push --sheet` does.",
            where="sheet",
            expected="[[file]] entries",
            found="[sheet]",
        )


def keep(settings: Settings, name: str, text: str) -> None:
    """Store a checked profile, replacing an earlier profile with the same name."""
    write_text(settings.data / "profiles" / f"{name}.toml", text)


_OF_A_PROFILE = {"sampling_period", "wrong_sign"}
"""Findings on a recording that a wrong profile may cause."""


@dataclass(frozen=True)
class Contradiction:
    """Sample log whose command follows a wall that differs from the one stated in a profile.

    Parameters
    ----------
    where : str
        Name of the log, with the trial if the log has several trials.
    expected : str
        Stiffness, damping and step that the profile states, with units.
    found : str
        Gains that the command follows, and the correction of the profile.
    """

    where: str
    expected: str
    found: str


def contradictions(samples: Sequence[Mapping[str, Any]]) -> list[Contradiction]:
    """Return the contradictions in a preview."""
    found = []
    for sample in samples:
        for trial in sample["trials"]:
            faults = (each["sentence"] for each in trial["findings"] if each["code"] in _OF_A_PROFILE)
            why = trial["other_gains"] or next(faults, None)
            if not why:
                continue
            where = sample["path"] if trial["label"] is None else f"{sample['path']}, trial {trial['label']}"
            named = OF_WALL if trial["other_gains"] else (*OF_WALL, "sampling_period_s")
            stated = {c["name"]: f"{c['value']:.6g} {c['unit']}" for c in trial["conditions"] if c["name"] in named}
            expected = ", ".join(f"{name} {stated[name]}" for name in named if name in stated)
            found.append(Contradiction(where, expected, why))
    return found


def refuse_contradictions(found: Sequence[Contradiction]) -> None:
    """Refuse a profile whose sample contradicts it.

    Raises
    ------
    Problem
        If there is a contradiction. The problem states the logs, the wall of the profile, and the wall that the command
        follows.
    """
    if not found:
        return
    count = len(found)
    raise Problem(
        422,
        f"The profile was not saved: the command of {counted(count, 'sample log')} contradicts the wall that the "
        f"profile states. {found[0].where}: the profile states {found[0].expected}, but {found[0].found}. Correct the "
        "profile, or state why it is right.",
        where=", ".join(one.where for one in found),
        expected=[one.expected for one in found],
        found=[one.found for one in found],
    )  # fmt: skip


def with_confirmation(text: str, words: str, who: str, found: Sequence[Contradiction]) -> str:
    """Return a profile with remarks that state the user who confirmed the contradictions of its sample, the date, and
    the reason given by the user."""
    lines = [f"CONFIRMED by {who or 'unknown'} on {time.strftime('%Y-%m-%d')}: {words}"]
    lines += [f"contradiction, {one.where}: {one.found}" for one in found[:_REMARKS]]
    lines += [f"contradictions in {counted(len(found) - _REMARKS, 'other log')}"] if len(found) > _REMARKS else []
    # a line break or another control character would end the remark
    plain = ("".join(sign if sign.isprintable() else " " for sign in line) for line in lines)
    return text.rstrip("\n") + "\n" + "".join(f"# {line}\n" for line in plain)


def samples_folder(settings: Settings, sample: str) -> Path:
    """Return the folder for the samples of a draft, and remove older folders. The last part of the path is proposed as
    the name of the experiment.
    """
    folder = settings.data / "drafts"
    for old in folder.glob("*"):
        if time.time() - old.stat().st_mtime > DRAFT_S:
            shutil.rmtree(old, ignore_errors=True)
    return folder / sample / "1"


class Question(Record):
    """Open question of a draft, with its line, its key, and the proposal (TOML) that follows it."""

    line: int
    key: str
    question: str
    proposal: str


def draft(folder: Path) -> str:
    """Return the text of a draft profile for samples."""
    text: str = _asked("draft", *map(str, sorted(file for file in folder.rglob("*") if file.is_file())))["profile"]
    return text


def preview(folder: Path, text: str) -> list[Any]:
    """Return a preview of the data that a profile would read from samples. For a refused sample, the preview has the
    reason."""
    with suppress(tomllib.TOMLDecodeError):  # the check below reports the error
        refuse_sheet("sheet" in tomllib.loads(text))
    file = folder.with_suffix(".toml")
    write_text(file, text)
    found = _asked("check", str(file), str(folder))["samples"]
    return [{**sample, "path": Path(sample["path"]).relative_to(folder).as_posix()} for sample in found]


def questions(text: str) -> list[Question]:
    """Return the open questions of a draft."""
    lines = [*text.splitlines(), ""]
    return [
        Question(
            line=q.line,
            key=".".join(map(str, q.place)),
            question=q.text.partition("open question: ")[2].removesuffix(" Set the key below it."),
            proposal=lines[q.line].partition("=")[2].strip() if lines[q.line].startswith("# ") else "",
        )
        for q in find_questions(text)
    ]


def answered(text: str, answers: Mapping[int, str]) -> str:
    """Return a draft in which questions are answered by line. An answer that is not TOML is inserted as a string."""
    lines = text.splitlines()
    for line, answer in sorted(answers.items(), reverse=True):
        if not answer.strip() or line >= len(lines) or not lines[line].startswith("# "):
            continue
        key = lines[line].removeprefix("# ").partition("=")[0].strip()
        try:
            tomllib.loads(f"x = {answer}")
        except tomllib.TOMLDecodeError:
            answer = json.dumps(answer.strip())
        lines[line - 1 : line + 1] = [f"{key} = {answer.strip()}"]
    return "\n".join(lines) + "\n"


def _asked(*words: str) -> Any:
    """Return the output of a profile command. An error of the command becomes a problem."""
    if not _AT_WORK.acquire(timeout=WAIT_S):
        raise Problem(503, "The server is drafting profiles for other users. Try again later.", where="profile")
    try:
        command = [sys.executable, "-m", "pipeline", "profile", *words, "--json"]
        done = subprocess.run(command, capture_output=True, timeout=WAIT_S, check=False, text=True, encoding="utf-8")
    except subprocess.TimeoutExpired:
        raise Problem(504, f"This took more than {WAIT_S:g} s. Send a shorter sample.", where="files") from None
    finally:
        _AT_WORK.release()
    try:
        return json.loads(done.stdout)
    except ValueError:
        told = re.sub(r"/\S*/", "", done.stderr.strip()).removeprefix("error: ")
        raise Problem(422, told[-2000:] or "The sample cannot be read.", where="profile") from None
