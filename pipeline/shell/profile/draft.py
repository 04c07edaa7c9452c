"""Draft a profile for sample logs, as TOML text with the keys that the data prove, their evidence, and questions.

A question is a line ``# QUESTION: key: words`` above the key, which is commented out with a possible answer. To answer
it, uncomment the key and correct its value. There are at most `MOST_QUESTIONS` questions. They concern only keys whose
wrong value would change results silently: columns that neither their names nor the motion identifies, and units that
neither the file nor the wall law of the command shows.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

from pipeline.base.errors import LogError, ProfileError
from pipeline.profiles.profile_files import QUESTION
from pipeline.readers.sample import Sample, open_sample
from pipeline.records.native import OF_WALL
from pipeline.shell.profile.evidence import answers, common_laws, trials_of
from pipeline.shell.profile.roles import Answer, Answers

MOST_QUESTIONS = 5
"""Largest number of questions in a draft. Users do not read more questions, and each answer may lead to further
questions."""

LISTED = 24
"""Largest number of columns, and of values outside the table, listed as comments in a draft. A bag has hundreds."""


def draft_profile(path: Path, *others: Path) -> str:
    """Return a draft profile for a sample as TOML text, with a line for each other sample that has a different form.

    Raises
    ------
    UsageError
        If the file cannot be read.
    ProfileError
        If the file is a native log, which needs no profile, or has no columns.
    """
    try:
        sample = open_sample(path)
    except LogError as error:
        raise ProfileError(f"{path}: no profile can be drafted: {error.reason}") from error
    alike, different = [sample], list[str]()
    for other in others:
        try:
            opened = open_sample(other)
        except (LogError, ProfileError) as error:
            different.append(f"# {other.name} has a different form: {error}")
            continue
        if difference := _difference(sample, opened):
            different.append(difference)
        else:
            alike.append(opened)
    found = answers(alike, [path, *others])
    units = {place: answer for place, answer in found.items() if place.startswith("units.")}
    found = {place: answer for place, answer in found.items() if place not in units} | _differing(alike, found) | units
    lines = [*_lines(sample, found), *different]
    # Characters that are invisible or not allowed in TOML are escaped.
    shown = ("".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in line) for line in lines if line)
    return "".join(f"{line}\n" for line in shown).replace("\n[", "\n\n[")


def _differing(samples: list[Sample], found: Answers) -> Answers:
    """Return questions about conditions that differ between the samples and that no key of the profile reads."""
    pattern = str(found["name_pattern"].value) if "name_pattern" in found else ""
    tables = ("constants", "attributes", "condition_columns", "units")
    missing = [
        key for key in OF_WALL if f"<{key}>" not in pattern and not any(f"{table}.{key}" in found for table in tables)
    ]
    if not missing or len(trials_of(samples)) < 2:
        return {}
    laws = common_laws(samples)
    questions: Answers = {}
    for key in missing:
        values = sorted(law.followed(key) for law in laws if key != "step" or law.kind == "step")
        if len(values) > 1:
            words = (
                f"the commands of these logs follow a {key} of {values[0]:.4g} to {values[-1]:.4g} [SI]. State this "
                "condition in name_pattern, [attributes], [condition_columns], [[file]] or [sheet], not here."
            )
            questions[f"constants.{key}"] = Answer(values[0], question=words)
    return questions


def _difference(sample: Sample, other: Sample) -> str:
    """Return a comment on how another file differs from the sample, or "" if one profile reads both."""
    own, found = (
        {"format": s.kind, **s.layout.keys, **s.layout.questions, "columns": [*s.contents.columns]}
        for s in (sample, other)
    )
    changed = [f"{key} = {_toml(found.get(key))}" for key in own | found if own.get(key) != found.get(key)]
    return f"# {other.name} has a different layout: {', '.join(changed)}" if changed else ""


def _lines(sample: Sample, found: dict[str, Answer]) -> Iterator[str]:
    """Yield the lines of the draft, ordered by table: known keys, and keys with questions."""
    yield (
        f"# Draft for {_toml(sample.name)}. The evidence follows each key. Each question is followed by the key to set."
    )
    short = re.sub(r"[^a-z0-9]+", "_", Path(sample.name).stem.lower()).strip("_")
    yield from (f"name = {_toml(short or 'lab')}", f"format = {_toml(sample.kind)}")
    yield f"files = [{_toml(file_pattern(sample.name))}] # names of the logs"
    for key, value in sample.layout.keys.items():
        evidence = sample.layout.evidence.get(key)
        yield f"{key} = {_toml(value)}" + (f" # {evidence}" if evidence else "")
    questions = 0
    for key, words in sample.layout.questions.items():
        questions += 1
        yield from (f"{QUESTION} {key}: {words}", f"# {key} = {_toml(',')}")
    table = ""
    for place, answer in found.items():
        above, _, key = place.rpartition(".")
        if above != table:
            yield from (*(() if table else _remarks(sample)), f"[{above}]" if "file" not in above else "")
            table = above
        key = "column" if isinstance(answer.value, int) and key == "name" else key
        if answer.question and questions < MOST_QUESTIONS:
            questions += 1
            yield f"{QUESTION} {f'{above}.{key}' if above else key}: {answer.question}"
            yield f"# {key} = {_toml(answer.value)}"
        elif answer.question:
            yield (
                f"# further question, to be answered after the others: {f'{above}.{key}' if above else key}: "
                f"{answer.question}"
            )
        else:
            yield f"{key} = {_toml(answer.value)}" + (f" # {answer.evidence}" if answer.evidence else "")


def _remarks(sample: Sample) -> Iterator[str]:
    contents = sample.contents
    yield "# Columns of the file:"
    for name, values in list(contents.columns.items())[:LISTED]:
        stated = contents.units.get(name) or contents.hints.get(name)
        stated = sample.layout.titles.get(name) or stated
        hint = f", the file states {stated!r}" if stated else ""
        yield f"#   {_toml(name)}: {len(values)} rows, {', '.join(map(str, values[:3]))[:80]}{hint}"
    if len(contents.columns) > LISTED:
        yield f"#   and {len(contents.columns) - LISTED} more"
    yield from (f"# Not read: {key} {reason}" for key, reason in contents.refused.items())
    if attributes := contents.attributes:
        yield "# Values outside the table, from which [attributes] may read conditions:"
        yield from (f"#   {_toml(key)}: {_toml(str(value)[:80])}" for key, value in list(attributes.items())[:LISTED])
    yield "# Conditions that differ between files may come from name_pattern, [attributes], [condition_columns],"
    yield "# [[file]] or [sheet]. A log without a wall and a step has no stiffness, damping and step."


def file_pattern(name: str) -> str:
    """Return a pattern for the name of a file and the names that differ from it only in numbers."""
    suffix = "".join(Path(name).suffixes[-2 if name.lower().endswith((".gz", ".zst")) else -1 :])
    pattern = re.sub(r"-?\d+(?:[.,]\d+)*", "*", re.sub(r"[\[*?]", "?", name.removesuffix(suffix)))
    return (pattern if "*" in pattern else "*") + suffix


def _toml(value: object) -> str:
    return json.dumps(value, ensure_ascii=False)
