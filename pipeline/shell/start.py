"""Determine for `pipeline start` the contents of a folder, the profile keys that follow from the data, and the open
questions.

The results depend only on the folder. `pipeline.shell.commands.cli_start` asks the user, calls functions and prints.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from glob import escape
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from pipeline.base.errors import LogError, ProfileError, UsageError
from pipeline.base.json_object import JsonObject
from pipeline.base.units import find_unit, unit_in_heading
from pipeline.intake.sources import Notices, find_sources
from pipeline.profiles.profile_files import find_mistakes
from pipeline.profiles.profile_model import IMPLIED, FileEntry, Kind, Profile, number_in_name, quantity, si_unit
from pipeline.readers.sample import Sample, open_sample
from pipeline.readers.sheets import NAMES, SheetTable, conditions_by_name, read_sheet
from pipeline.records.native import OF_WALL
from pipeline.shell.profile.check import IS_UNUSUAL, check_samples
from pipeline.shell.profile.columns import MOST_SAMPLES, numbers_in_names, spread, suffix_of, with_group
from pipeline.shell.profile.conditions import factor_of, proved_unit
from pipeline.shell.profile.evidence import WallLaw, answers, common_laws, near_round, wall_law
from pipeline.shell.profile.roles import Answer, Answers

SHEETS = (".csv", ".tsv", ".txt", ".xlsx", ".ods", ".xls")
"""Extensions of files that may be a sheet with one row per log."""

LEAST_NAMED = 0.5
"""Smallest share of the logs that a sheet must name."""

MOST_CHECKED = 400
"""Largest number of logs whose walls are compared with their commands before storing, which takes a few seconds."""

_OFF = (
    "the number after {0!r} in the names is {2:.4g} times the {1} that the commands follow, and no unit explains this. "
    "Are the units of force, position and time in the files right? If they are, state one {1} for all walls."
)
"""Question about numbers in names that contradict the units of the columns."""


@dataclass(frozen=True)
class Folder:
    """Contents of a folder.

    Parameters
    ----------
    path : Path
    logs : tuple of Path
        Readable files of the most frequent extension.
    others : tuple of Path
        Other files.
    ignored : tuple of Path
        Files that are not logs, such as papers, scripts, settings and pictures.
    sheet : Path or None
    native : bool
        True if the logs are native and need no profile.
    samples : tuple of Sample
        Opened selection of the logs.
    other_layout : tuple of str
        Names of the opened logs whose delimiter, decimal sign, encoding or columns differ from those of `samples`.
    """

    path: Path
    logs: tuple[Path, ...]
    others: tuple[Path, ...]
    ignored: tuple[Path, ...]
    sheet: Path | None
    native: bool
    samples: tuple[Sample, ...]
    other_layout: tuple[str, ...] = ()

    def rows(self) -> list[dict[str, str | int]]:
        """Return the files by kind, as rows of a table."""
        kinds = {
            "logs": self.logs,
            "sheet": () if self.sheet is None else (self.sheet,),
            "other files": self.others,
            "ignored": self.ignored,
        }
        return [
            {"kind": kind, "files": len(files), "first": files[0].name, "endings": _endings(files)}
            for kind, files in kinds.items()
            if files
        ]


def _endings(files: Sequence[Path]) -> str:
    return ", ".join(sorted({suffix_of(file) or "none" for file in files}))


@dataclass(frozen=True)
class Proposal:
    """Proposal for a folder: profile keys with evidence and questions, by place."""

    folder: Folder
    answers: Answers

    @property
    def open(self) -> dict[str, Answer]:
        """The questions."""
        return {place: answer for place, answer in self.answers.items() if answer.question}

    def answered(self, given: Mapping[str, Any]) -> Proposal:
        """Return a proposal that includes the given answers."""
        answers = {place: Answer(value, "as answered") for place, value in given.items()}
        return replace(self, answers=self.answers | answers)


def look_at(path: Path) -> Folder:
    """Return the contents of a folder. For a log, return the contents of its folder.

    Raises
    ------
    UsageError
        If the path does not exist or contains no log.
    """
    notices = Notices()
    everything = Profile.model_construct(name="all", format="delimited", files=("*",))
    sources = find_sources([path], (everything,), notices=notices)
    files = [source.files[0] for source in sources if source.files]
    sheet = _sheet(files)
    files = [file for file in files if file != sheet]
    counts = Counter(map(suffix_of, files))
    native, first = False, None
    for ending, _ in counts.most_common():
        group = [file for file in files if suffix_of(file) == ending]
        opened: list[Sample] = []
        for file in spread(group, MOST_SAMPLES):
            try:
                opened.append(open_sample(file))
            except ProfileError:  # native logs need no profile
                native = True
                break
            except (LogError, UsageError) as error:
                first = first or f"{file}: {error}"
        if native or opened:
            others = tuple(file for file in files if file not in set(group))
            usual = Counter(map(_form, opened)).most_common(1)[0][0] if opened else None
            same = tuple(each for each in opened if _form(each) == usual)
            unlike = tuple(each.name for each in opened if _form(each) != usual)
            return Folder(path, tuple(group), others, tuple(sorted(notices.ignored)), sheet, native, same, unlike)
    raise UsageError(first or f"{path}: no log found. Give a folder with logs.")


def _form(sample: Sample) -> tuple[str, tuple[str, ...], str]:
    signs = {key: sample.layout.keys.get(key) for key in ("delimiter", "decimal", "encoding")}
    return sample.kind, tuple(sample.contents.columns), str(signs)


def _sheet(files: Sequence[Path]) -> Path | None:
    """Return the file whose rows name the other files, or None if there is none."""
    names = {file.name.lower() for file in files}
    stems = {Path(name).stem for name in names}
    for file in files:
        if file.suffix.lower() not in SHEETS or len(files) < 2:
            continue
        try:
            table = read_sheet(file)
        except ProfileError:
            continue
        for name in filter(None, table.names):
            if len(set(_file_names(table, name)) & (names | stems)) >= max(LEAST_NAMED * (len(files) - 1), 1):
                return file
    return None


def _file_names(table: SheetTable, column: str) -> list[str]:
    """Return the cells of a column of a sheet as file names in lower case, without folders."""
    return [str(cell).replace("\\", "/").rpartition("/")[2].lower() for cell in table.column(column)]


def propose(folder: Folder) -> Proposal:
    """Return the profile keys that the logs of a folder prove, and the open questions.

    Conditions come from the sheet, otherwise from the file names. A column of the sheet, or the numbers after a word in
    the names, must agree with the gains of the commands, apart from the factor between two units.
    """
    samples = folder.samples
    found = answers(samples, folder.logs)
    inside = {key for key in OF_WALL if f"attributes.{key}" in found or f"condition_columns.{key}" in found}
    found = {
        place: answer
        for place, answer in found.items()
        if not place.startswith(("units", "name_pattern")) or place.removeprefix("units.") in inside
    }
    layout = samples[0].layout
    found |= {key: Answer(layout.keys[key], evidence) for key, evidence in layout.evidence.items()}
    for key, words in layout.questions.items():
        found[key] = Answer(",", question=words)
    alike = {tuple(law.columns.values()) for law in common_laws(samples)}
    laws = {
        sample.name: law
        for sample in samples
        if (law := wall_law(sample)) is not None and tuple(law.columns.values()) in alike
    }
    table = None if folder.sheet is None else read_sheet(folder.sheet)
    given = _from_sheet(table, laws, samples) if table is not None else {}
    if any(key.startswith("units.") for key in given) and not laws:
        found.pop("kind", None)  # the sheet states walls that no command follows
    named = _from_names(samples, laws, {key for key in OF_WALL if f"units.{key}" in given} | inside)
    found |= given | named
    for key in OF_WALL:
        if f"units.{key}" in found or _is_mapped(found, key):
            found.pop(f"constants.{key}", None)
    if given and folder.sheet is not None:
        found["sheet.file"] = Answer(str(folder.sheet), "its rows name the logs")
    name = folder.path.resolve().name if folder.path.is_dir() else folder.path.resolve().parent.name
    found["constants.device"] = Answer(re.sub(r"[^\w .-]+", "-", name) or "bench", "name of the folder")
    found["constants.experiment"] = Answer("1", "any name")
    if any(key.startswith(("sheet", "name_pattern")) for key in found) or inside or "constants.stiffness" in found:
        kind = found.get("kind")
        without = IMPLIED[kind.value] if kind is not None else ()
        if kind is None:
            found.setdefault("step_at", Answer("command edge", "the command jumps at the step"))
        for key in OF_WALL:
            if key not in without and not _is_mapped(found, key) and f"constants.{key}" not in found:
                found[f"constants.{key}"] = _question_of_all(key, _asked_unit(found, key), laws)
    return Proposal(folder, found)


def _question_of_all(key: str, unit: str, laws: Mapping[str, WallLaw]) -> Answer:
    """Return the question about a condition of all walls. The proposed value is the most frequent one in the
    commands."""
    values = Counter(value for law in laws.values() if (value := law.followed(key)))
    words = f"{key} of all walls [{unit}]? "
    if key != "step" or not values:
        return Answer(0, question=f"{words}Neither the files nor their commands show this value")
    value, count = values.most_common(1)[0]
    return Answer(value, question=f"{words}The commands of {count} of {len(laws)} logs show {value:g}")


def with_units(proposal: Proposal, given: Mapping[str, Any]) -> Folder:
    """Return the folder of a proposal, with the units of columns from the answers, as if the files stated these
    units."""
    units = {}
    for place, value in given.items():
        name = proposal.answers.get(f"{place.rpartition('.')[0]}.name")
        if place.startswith("columns.") and place.endswith(".unit") and name is not None:
            units[str(name.value)] = str(value)
    samples = tuple(
        sample._replace(
            contents=replace(sample.contents, hints=sample.contents.hints | units),
            trials=tuple(replace(trial, hints=trial.hints | units) for trial in sample.trials),
        )
        for sample in proposal.folder.samples
    )
    return replace(proposal.folder, samples=samples)


def _is_mapped(found: Answers, key: str) -> bool:
    columns = found.get("sheet.columns")
    pattern = found.get("name_pattern")
    by_sheet = columns is not None and any(f":{key}" in text for text in columns.value)
    inside = f"attributes.{key}" in found or f"condition_columns.{key}" in found
    return inside or by_sheet or (pattern is not None and f"<{key}>" in pattern.value)


def _followed(laws: Mapping[str, WallLaw], names: Sequence[str], key: str) -> list[float]:
    return [laws[name].followed(key) for name in names]


def _motion(laws: Mapping[str, WallLaw]) -> Kind:
    return next(iter(laws.values())).motion


def _asked_unit(found: Mapping[str, Answer], key: str) -> str:
    """Return the SI unit of a condition for the kind of motion that the unit of the position implies."""
    position = found.get("columns.position.unit")
    unit = find_unit(str(position.value)) if position is not None else None
    rotates = unit is not None and unit.quantity in ("angle", "angular velocity")
    return si_unit(quantity(key, "rotation" if rotates else "translation"))


def _from_names(samples: Sequence[Sample], laws: Mapping[str, WallLaw], known: set[str]) -> Answers:
    """Return the pattern of file names, and the units of the numbers in the names, if the commands prove both."""
    names, words = [sample.name for sample in samples if sample.name in laws], numbers_in_names(samples)
    if not names or not words:
        return {}
    found: Answers = {}
    pattern: str | None = None
    used = set[str]()
    for key in OF_WALL:
        for word in words if key not in known else ():
            numbers = [_number_behind(word, name) for name in names]
            unit = None if word in used else proved_unit(numbers, _followed(laws, names, key), key, _motion(laws))
            if unit is None:
                factor = factor_of(numbers, _followed(laws, names, key))
                if word.lower() in NAMES[key] and factor is not None:
                    proposed = Answer(0, question=_OFF.format(word, key, 1 / factor))
                    found[f"constants.{key}"] = proposed
                continue
            found.pop(f"constants.{key}", None)
            used.add(word)
            pattern = with_group(pattern, words, word, key)
            found[f"units.{key}"] = Answer(unit, f"{word!r} in the names, in {unit}, agrees with {len(names)} commands")
            break
    if pattern is not None:
        found["name_pattern"] = Answer(pattern, "numbers after words in the file names")
    return found


def _number_behind(word: str, name: str) -> float | None:
    match = re.search(rf"(?:^|[^A-Za-z]){re.escape(word)}[_= ]?(-?\d+(?:[.,]\d+)?)", Path(name).stem)
    try:
        return None if match is None else number_in_name(match[1])
    except (UsageError, ValueError):
        return None


def _from_sheet(table: SheetTable, laws: Mapping[str, WallLaw], samples: Sequence[Sample]) -> Answers:
    """Return the columns of a sheet that contain conditions, with the units that the headings state or the commands
    prove."""
    named = _naming(table, samples)
    if named is None:
        return {}
    rows = {name: i for i, name in enumerate(_file_names(table, named))}
    at = {name: rows.get(name.lower(), rows.get(Path(name).stem.lower())) for name in laws}
    logs = [name for name, row in at.items() if row is not None]
    by_name = conditions_by_name([name for name in table.names if name and name != named])
    found: Answers = {}
    mapping: list[str] = []
    taken = set(by_name.values())
    for key in OF_WALL:
        candidates = [by_name[key]] if key in by_name else [n for n in table.names if n and n not in (named, *taken)]
        for column in candidates:
            cells = table.column(column)
            stated = unit_in_heading(column, ())[1]
            unit = stated if stated and find_unit(stated) else None
            evidence = "stated in the heading"
            if unit is None and logs:
                numbers = [_number(cells[row]) if (row := at[name]) is not None else None for name in logs]
                unit = proved_unit(numbers, _followed(laws, logs, key), key, _motion(laws))
                evidence = f"agrees with {len(logs)} commands"
            if unit is None and key in by_name:
                si = si_unit(quantity(key, _motion(laws) if laws else "translation"))
                words = f"what is the unit of the column {column!r} ({key}) of the sheet?"
                found[f"units.{key}"] = Answer(si, question=words)
            elif unit is not None:
                found[f"units.{key}"] = Answer(unit, f"column {column!r} of the sheet: {evidence}")
            else:
                continue
            taken.add(column)
            mapping.append(f"{column}:{key}")
            break
    return found | ({"sheet.columns": Answer(mapping, "columns of the sheet")} if mapping else {})


def _naming(table: SheetTable, samples: Sequence[Sample]) -> str | None:
    names = {sample.name.lower() for sample in samples} | {Path(sample.name).stem.lower() for sample in samples}

    def count(column: str) -> int:
        return sum(name in names for name in _file_names(table, column))

    best = max(filter(None, table.names), key=count, default=None)
    return best if best is not None and count(best) else None


def _number(cell: object) -> float | None:
    try:
        return float(str(cell).replace(",", "."))
    except ValueError:
        return None


def made_profile(proposal: Proposal) -> Profile:
    """Return the profile of a proposal without open questions.

    Raises
    ------
    ProfileError
        If a question is open, or the values contradict each other.
    """
    if proposal.open:
        raise ProfileError("\n".join(f"{place}: {answer.question}" for place, answer in proposal.open.items()))
    sample = proposal.folder.samples[0]
    values: JsonObject = {"format": sample.kind, **sample.layout.keys}
    values["files"] = [f"*{suffix_of(Path(sample.name))}"]
    for place, answer in proposal.answers.items():
        *above, key = place.split(".")
        table = values
        for part in above:
            table = table.setdefault(part, {})
        table["column" if key == "name" and isinstance(answer.value, int) else key] = answer.value
    values["name"] = re.sub(r"\W+", "-", str(values["constants"]["device"])).strip("-") or "lab"
    try:
        return Profile.model_validate(values)
    except ValidationError:
        mistakes = find_mistakes(values, "")
        raise ProfileError("\n".join(dict.fromkeys(mistake.text for mistake in mistakes))) from None


@dataclass(frozen=True)
class Contradiction:
    """A log whose command follows a wall that differs from the stated one, or that has an implausible number.

    Parameters
    ----------
    path : Path
    reason : str
    followed : dict of str to float
        The gain [SI] that the command follows, if only one gain differs from the stated wall. Several gains that differ
        together indicate a wrong unit or sign of a column.
    """

    path: Path
    reason: str
    followed: Mapping[str, float]


def contradictions(profile: Profile, logs: Sequence[Path]) -> tuple[list[Contradiction], int]:
    """Return the logs that contradict a profile, and the number of checked logs."""
    looked, found = spread(logs, MOST_CHECKED), []
    for sample in check_samples(profile, looked):
        path = Path(sample["path"])
        for trial in sample["trials"]:
            unusual = next((text for text in trial["warnings"] if IS_UNUSUAL in text), None)
            if reason := trial["other_gains"] or unusual:
                alone = dict(trial["obeyed"]) if len(trial["obeyed"]) == 1 and trial["label"] is None else {}
                found.append(Contradiction(path, reason, alone))
                break
    return found, len(looked)


def corrected(profile: Profile, found: Sequence[Contradiction]) -> Profile:
    """Return a profile with entries that correct single logs to the gains that their commands follow."""
    entries = list(profile.file)
    for each in found:
        given = {key: near_round(value / profile.condition_factor(key)) for key, value in each.followed.items()}
        entries.append(FileEntry.model_validate({"match": escape(each.path.name), **given}))
    values = profile.model_dump(exclude_defaults=True)
    return Profile.model_validate(values | {"file": [entry.model_dump(exclude_defaults=True) for entry in entries]})
