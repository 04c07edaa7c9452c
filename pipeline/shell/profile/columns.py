"""Conversion of columns named on the command line to an ordinary profile.

All other settings must follow from the logs: the layout of the files, the sampling period, the sign of the position,
and the row of the step. Units are never guessed. Before the profile is used, it is checked against some of the logs.
The profile is refused if their commands do not follow the stated wall.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import ValidationError

from pipeline.base.errors import LogError, ProfileError, UsageError
from pipeline.base.json_object import JsonObject
from pipeline.base.units import find_unit
from pipeline.base.wording import counted
from pipeline.intake.sources import find_sources
from pipeline.profiles.column_text import ColumnText
from pipeline.profiles.profile_files import find_mistakes
from pipeline.profiles.profile_model import IMPLIED, Profile
from pipeline.readers.gain_check import WallGains, common_remedy, wall_gains
from pipeline.readers.sample import Sample, open_sample
from pipeline.readers.sheets import conditions_by_name, read_sheet
from pipeline.records.native import OF_WALL
from pipeline.shell.profile.check import check_samples
from pipeline.shell.profile.roles import SAME_PERIOD, plausible_units

MOST_SAMPLES = 12
"""Largest number of inspected logs, evenly spread. This number is enough to check that all logs have the same form."""

ROUND_PERIOD = 2e-4
"""Largest relative deviation of a sampling period from the round number that replaces it."""

COLUMNS, OPTIONAL = ("time", "command", "position"), ("force",)


@dataclass(frozen=True)
class StatedColumns:
    """Column options of a command line. Each value is a text for `ColumnText`, or None.

    ``period`` is the sampling period of the controller. By default, the period is taken from the time stamps. ``kind``
    is the kind of the trials, as in a profile.
    """

    time: str | None = None
    command: str | None = None
    position: str | None = None
    force: str | None = None
    stiffness: str | None = None
    damping: str | None = None
    step: str | None = None
    kind: str | None = None
    period: str | None = None
    device: str | None = None
    experiment: str | None = None
    gain: str | None = None
    sheet: str | None = None


Item = TypeVar("Item")

OPTIONS = {"sampling_period_s": "period"}
"""Name of the option for each condition, where the two names differ."""


def option_of(place: Sequence[str | int]) -> str:
    """Return the option that sets a key of a profile.

    >>> option_of(("columns", "time", "unit")), option_of(("constants", "sampling_period_s"))
    ('--time', '--period')
    """
    name = next(
        (str(key) for key in place if key in (*COLUMNS, *OPTIONAL, *OF_WALL, "gain", "device", "experiment")), None
    )
    name = name or next((OPTIONS[str(key)] for key in place if key in OPTIONS), str(place[-1]) if place else "")
    return f"--{name.replace('_', '-')}"


def stated_profile(stated: StatedColumns, paths: Sequence[Path], *, walls: bool = True) -> tuple[Profile, list[str]]:
    """Return the profile that column options and logs define, and sentences with the evidence from the logs.

    Parameters
    ----------
    stated : StatedColumns
    paths : sequence of Path
        The logs, or folders that are searched for logs.
    walls : bool
        True if conditions and a device name are required, as for storing logs.

    Raises
    ------
    UsageError
        If a required column is not named or is missing from the files, or a unit is unknown or not stated.
    ProfileError
        If the options contradict each other, or the command of a log follows a different wall.
    """
    for name in ("command", "position"):
        if getattr(stated, name) is None:
            unit = {"command": "N", "position": "mm"}[name]
            raise UsageError(f"--{name} is missing. Name the column and its unit, such as --{name} NAME:{unit}.")
    sheet = None if stated.sheet is None else Path(stated.sheet).resolve()
    files = [file for file in _logs_below(paths) if sheet is None or file.resolve() != sheet]
    chosen, samples = _samples(stated, files)
    maker = _Maker(stated, samples, walls)
    values = maker.values()
    try:
        profile = Profile.model_validate(values)
    except ValidationError:
        mistakes = find_mistakes(values, "")
        lines = (_plain(option_of(each.place), each.text) for each in mistakes)
        raise ProfileError("\n".join(dict.fromkeys(lines))) from None
    _check(profile, stated, chosen)
    return profile, maker.evidence


def _plain(option: str, text: str) -> str:
    """Return the message of a profile error, with profile keys replaced by options."""
    text = re.sub(r"^key '[^']*': ", "", text)
    text = re.sub(r'\[units\] gain = "<number> (N\w*)/(\S+)"', r"--gain '<number> \1/\2'", text)
    text = re.sub(r"Add (\w+) = (.*)", rf"Write {option} with one of these units: \2", text)
    return f"{option}: {text}"


def _logs_below(paths: Sequence[Path]) -> Iterator[Path]:
    """Yield all files below the paths. For the folder of a bag, yield its first file."""
    everything = Profile.model_construct(name="all", format="delimited", files=("*",))
    for source in find_sources(paths, (everything,)):
        if source.files:
            yield source.files[0]


def spread(files: Sequence[Item], most: int) -> list[Item]:
    """Return at most ``most`` of the given items, evenly spread and including the first and the last."""
    if len(files) <= most:
        return list(files)
    return [files[round(i * (len(files) - 1) / (most - 1))] for i in range(most)]


def suffix_of(path: Path) -> str:
    """Return the extension of a file in lower case, including the extension of its compression."""
    parts = [part.lower() for part in path.suffixes]
    return "".join(parts[-2:] if parts[-1:] in ([".gz"], [".zst"]) else parts[-1:])


def _samples(stated: StatedColumns, files: Sequence[Path]) -> tuple[list[Path], list[Sample]]:
    """Return the files of the most frequent extension that have the columns, and the opened samples of some of these
    files.

    Raises
    ------
    UsageError, LogError
        If no file has the columns. The error states the reason for the first file.
    """
    by_ending: dict[str, list[Path]] = {}
    for file in files:
        by_ending.setdefault(suffix_of(file), []).append(file)
    first: Exception | None = None
    for group in sorted(by_ending.values(), key=len, reverse=True):
        opened: list[Sample] = []
        for file in spread(group, MOST_SAMPLES):
            try:
                sample = open_sample(file)
                if opened and sample.kind != opened[0].kind:
                    continue
                for name in (*COLUMNS, *OPTIONAL):
                    if (text := getattr(stated, name)) is not None and _as_constant(name, text, sample) is None:
                        ColumnText.among(f"--{name}", text, list(sample.contents.columns))
            except (LogError, ProfileError, UsageError) as error:
                first = first or type(error)(f"{file}: {str(error).removeprefix(f'{file.name}: ')}")
                continue
            opened.append(sample)
        if opened:
            return group, opened
    raise first or UsageError("no log found. Name log files, or folders that contain logs.")


def _as_constant(name: str, text: str, sample: Sample) -> ColumnText | None:
    """Return the constant that a text states for a column. Only the time can be constant, and only if no column has
    this name."""
    if name != "time" or text in sample.contents.columns:
        return None
    found = ColumnText.constant(text)
    return found if found is not None and found.unit else None


class _Maker:
    """Builder of the values of a profile. ``evidence`` collects sentences with the evidence from the logs."""

    def __init__(self, stated: StatedColumns, samples: Sequence[Sample], walls: bool) -> None:
        self.stated, self.samples, self.walls = stated, samples, walls
        self.sample = next((each for each in samples if not each.layout.questions), samples[0])
        self.evidence: list[str] = []
        self.table = None if stated.sheet is None else read_sheet(Path(stated.sheet))
        self.columns: list[str] = []
        """Columns of the sheet that options map to conditions."""

    def values(self) -> JsonObject:
        """Return the profile as a mapping."""
        sample, stated = self.sample, self.stated
        if questions := sample.layout.questions:
            open_questions = " ".join(questions.values())
            raise UsageError(
                f"{sample.name}: {open_questions} Answer it in a profile: `pipeline profile draft {sample.name}`."
            )
        ending = suffix_of(Path(sample.name))
        values: JsonObject = {"format": sample.kind, "files": [f"*{ending}"], **sample.layout.keys}
        columns = {
            name: self._column(name) for name in (*COLUMNS, *OPTIONAL) if name in COLUMNS or getattr(stated, name)
        }
        values["columns"] = columns
        constants: JsonObject = {"experiment": stated.experiment or "1"}
        if stated.device is not None or not self.walls:
            constants["device"] = stated.device or "device"
        elif self.table is None or "device" not in conditions_by_name(self.table.names):
            raise UsageError("--device is missing: state a name for the device of these logs, such as --device bench.")
        if self._turns(columns["position"]["unit"]):
            constants["motion"] = "rotation"
        values |= {"constants": constants, "units": {}, "attributes": {}, "condition_columns": {}}
        for name in OF_WALL:
            if (text := getattr(stated, name)) is not None:
                self._condition(values, name, text)
        self._period(values)
        if stated.gain is not None:
            values["units"]["gain"] = stated.gain
        self._wall(values)
        if stated.sheet is not None:
            values["sheet"] = {"file": stated.sheet, "columns": self.columns}
        values["name"] = re.sub(r"\W+", "-", stated.device or "columns").strip("-") or "columns"
        return {key: value for key, value in values.items() if value != {}}

    def _column(self, name: str) -> JsonObject:
        """Return the profile table for a column."""
        text = getattr(self.stated, name)
        if text is None:  # only time may be missing
            text = self._clock()
        if (constant := _as_constant(name, text, self.sample)) is not None:
            factor = find_unit(constant.unit)
            if factor is None or factor.quantity != "time" or not (constant.value or 0) > 0:
                raise UsageError(f"--time {text}: expected a column, or the time between two rows, such as '1 ms'.")
            return {"kind": "sampled"}
        found = ColumnText.among(f"--{name}", text, list(self.sample.contents.columns))
        column = found.column or ""
        by_position = not self.sample.layout.keys.get("header", True) and column.isdecimal()
        table: JsonObject = {"column": int(column)} if by_position else {"name": column}
        table["unit"] = found.unit or self._unit(name, column)
        if name != "time":
            table["sign"] = found.sign or 1
        if (known := find_unit(table["unit"])) is not None and known.quantity in ("velocity", "angular velocity"):
            table["integrate"] = "difference"
        return table

    def _clock(self) -> str:
        """Return the time column if no option names one: the only column that increases in every row."""
        numbers = self.sample.numbers
        texts = (getattr(self.stated, name) for name in (*COLUMNS[1:], *OPTIONAL))
        taken = {ColumnText.among("", text, list(numbers)).column for text in texts if text is not None}
        rising = [
            key
            for key, values in numbers.items()
            if key not in taken and len(values) > 2 and (np.diff(values) > 0).all()
        ]
        if len(rising) != 1:
            listing = f"{', '.join(rising)} increase in every row" if rising else "no column increases in every row"
            hint = (
                "Name the column with its unit, such as --time t:s. If the file has no time column, add --time '1 ms'."
            )
            raise UsageError(
                f"--time is missing, and {self.sample.name} does not show which column is the time: {listing}. {hint}"
            )
        self.evidence.append(f"time is {rising[0]!r}, the only column that increases in every row")
        return rising[0]

    def _unit(self, name: str, column: str) -> str:
        """Return the unit of a column if the option states none.

        The unit is stated in the file, or follows from the steps of the column.
        """
        stated = self.sample.unit(column, name)[1]
        if stated and find_unit(stated) is not None:
            self.evidence.append(f"{name} is in {stated}, as {self.sample.name} states")
            return stated
        if name == "time":
            pace = float(np.median(np.diff(self.sample.numbers[column])))
            fits = plausible_units(self.sample, "time", column, pace)
            if len(fits) == 1:
                self.evidence.append(f"time is in {fits[0]}, because consecutive stamps differ by {pace:g}")
                return fits[0]
            either = " or ".join(f"{column}:{unit}" for unit in fits) or f"{column}:s"
            raise UsageError(f"--time {column}: the rows are {pace:g} apart, but no unit is stated. Write {either}.")
        units = {"command": "N, Nm, V, A, counts or %", "position": "mm, m, rad or deg", "force": "N or Nm"}[name]
        example = {"command": "N", "position": "mm", "force": "N"}[name]
        raise UsageError(
            f"--{name} {column}: no unit is stated. Write for example {column}:{example}. Possible units: {units}."
        )

    def _turns(self, unit: str) -> bool:
        known = find_unit(unit)
        return known is not None and known.quantity in ("angle", "angular velocity")

    def _condition(self, values: JsonObject, name: str, text: str) -> None:
        """Store the source of a condition: a constant, a value outside the table, a column, or the name of the file.

        Raises
        ------
        UsageError
            If the condition has none of these sources.
        """
        key = {"period": "sampling_period_s"}.get(name, name)
        if (constant := ColumnText.constant(text)) is not None:
            values["constants"][key] = constant.value
            if constant.unit:
                values["units"][key] = constant.unit
            return
        contents = self.sample.contents
        named = dict.fromkeys(filter(None, self.table.names) if self.table else (), "sheet")
        for label in (*contents.attributes, *contents.columns):
            named.setdefault(label, "attributes" if label in contents.attributes else "condition_columns")
        in_names = numbers_in_names(self.samples)
        for letter in in_names:
            named.setdefault(letter, "name_pattern")
        found = ColumnText.among(f"--{name}", text, list(named))
        column = found.column or ""
        where = named[column]
        if where == "sheet":
            self.columns.append(":".join(filter(None, (column, key, found.unit))))
            self.evidence.append(f"{name} is column {column!r} of {self.stated.sheet}")
            return
        if where == "name_pattern":
            values["name_pattern"] = with_group(values.get("name_pattern"), in_names, column, key)
        else:
            values[where][key] = column
        if found.unit:
            values["units"][key] = found.unit
        place = {
            "attributes": f"the value {column!r} outside the table",
            "condition_columns": f"column {column!r}",
            "name_pattern": f"{column!r} in the names of the files",
        }[where]
        self.evidence.append(f"{name} is {place}")

    def _period(self, values: JsonObject) -> None:
        """Set the sampling period: the stated period, or the time between the rows of all samples."""
        text = self.stated.period
        if text is None and self.stated.time is not None:
            constant = _as_constant("time", self.stated.time, self.sample)
            text = None if constant is None else self.stated.time
        if text is not None:
            self._condition(values, "period", text)
            return
        clock = values["columns"]["time"]
        unit, column = _time_factor(clock), _column_key(clock)
        paces: dict[str, float] = {}
        for sample in self.samples:
            if (stamps := sample.numbers.get(column)) is not None and len(stamps) > 2:
                paces[sample.name] = float(np.median(np.diff(stamps))) * unit
        if not paces or min(paces.values()) <= 0:
            raise UsageError(
                "--period is missing, and the time stamps do not show the period. State the period, such as --period "
                "'1 ms'."
            )
        slow, fast = max(paces, key=lambda name: paces[name]), min(paces, key=lambda name: paces[name])
        if paces[slow] > paces[fast] * (1 + SAME_PERIOD):
            raise UsageError(
                f"the logs have different sampling periods: {paces[fast]:.6g} s in {fast}, {paces[slow]:.6g} s in "
                f"{slow}. Read the logs of each period separately, with a different --experiment, or name the column "
                "of the period with --period."
            )
        period = round_period(float(np.median([*paces.values()])))
        values["constants"]["sampling_period_s"] = period
        self.evidence.append(f"the sampling period is {period:g} s, the time between the rows of {_logs(len(paces))}")

    def _wall(self, values: JsonObject) -> None:
        """Set the keys that follow from the wall law of the commands: the sign of the position and the time of the
        step."""
        kind = self.stated.kind or "step"
        if kind not in IMPLIED:
            raise UsageError(f"--kind {kind}: expected one of {', '.join(IMPLIED)}.")
        values |= {} if kind == "step" else {"kind": kind}
        given = {key for key in OF_WALL if getattr(self.stated, key) is not None}
        for key, column in conditions_by_name(self.table.names).items() if self.table else ():
            if key in OF_WALL and key not in given:
                given.add(key)
                self.evidence.append(f"{key} is column {column!r} of {self.stated.sheet}")
        if not given:
            return
        if missing := [f"--{key}" for key in OF_WALL if key not in {*given, *IMPLIED[kind]}]:
            raise UsageError(
                f"{' and '.join(missing)} missing: a wall needs --stiffness, --damping and --step, each as a column or "
                "as a constant such as '0 N'. For logs without a wall and a step, omit all three options."
            )
        laws = dict(self._laws(values))
        texts = (self.stated.position or "", self.stated.command or "")
        if laws and not any(text[:1] in "+-" for text in texts):
            against = [name for name, law in laws.items() if law.stiffness < 0]
            if len(against) == len(laws):
                values["columns"]["position"]["sign"] = -1
                self.evidence.append(
                    f"sign of the position is -1, because a positive command reduces the position in {_logs(len(laws))}"
                )
        column = _column_key(values["columns"]["command"])
        begun = [
            abs(float(command[0])) > abs(law.step) / 2
            for sample in self.samples
            if (law := laws.get(sample.name)) is not None and (command := sample.numbers.get(column)) is not None
        ]
        if kind == "step":
            values["step_at"] = "first row" if begun and all(begun) else "command edge"

    def _laws(self, values: Mapping[str, Any]) -> Iterator[tuple[str, WallGains]]:
        """Yield the wall law that the command of each sample follows, in the units of the file and in seconds."""
        clock, *pair = (values["columns"][name] for name in COLUMNS)
        for sample in self.samples:
            found = [sample.numbers[key] for key in map(_column_key, pair) if key in sample.numbers]
            if len(found) < 2:
                continue
            # Without time stamps, there is one row per sampling period.
            stamps = sample.numbers.get(_column_key(clock), np.arange(float(len(found[0]))))
            if len({len(column) for column in (stamps, *found)}) != 1:
                continue
            law = wall_gains(stamps * _time_factor(clock), *found)
            if law is not None and law.stiffness and (law.step or values.get("kind")):
                yield sample.name, law


def _column_key(table: Mapping[str, Any]) -> str:
    """Return the name in `FileColumns` for a column of a profile, or "" if there is none."""
    return str(table.get("name", table.get("column", "")))


def _time_factor(table: Mapping[str, Any]) -> float:
    unit = find_unit(table.get("unit", "s"))
    return 1.0 if unit is None else unit.factor


def _logs(count: int) -> str:
    return "the log" if count == 1 else f"all {counted(count, 'log')} that were inspected"


def round_period(seconds: float) -> float:
    """Return the nearest round number of seconds if it is close to the period, otherwise the period to six digits.

    >>> round_period(0.00100013), round_period(1 / 3000), round_period(0.00025)
    (0.001, 0.000333333, 0.00025)
    """
    for digits in (1, 2):
        rounded = float(f"{seconds:.{digits}g}")
        if abs(rounded / seconds - 1) <= ROUND_PERIOD:
            return rounded
    return float(f"{seconds:.6g}")


_IN_NAME = re.compile(r"(?:^|[^A-Za-z])([A-Za-z]{1,12})[_= ]?(-?\d+(?:[.,]\d+)?)")
"""Pattern of a word followed by a number in a file name."""


def numbers_in_names(samples: Sequence[Sample]) -> list[str]:
    """Return the words that precede a number in the name of every sample, in the order of the first sample."""
    found = [[match[1] for match in _IN_NAME.finditer(Path(sample.name).stem)] for sample in samples]
    counts = Counter(word for words in found for word in set(words) if words.count(word) == 1)
    return [word for word in found[0] if counts[word] == len(samples)]


def with_group(pattern: str | None, words: Sequence[str], word: str, key: str) -> str:
    """Return a pattern of file names, extended by a group for the number after a word."""
    group = f"(?:^|[^A-Za-z]){re.escape(word)}[_= ]?(?P<{key}>-?[0-9]+(?:[.,][0-9]+)?)"
    if pattern is None:
        return group
    # The groups are in the order of the words in the names.
    parts = {part: text for text in pattern.split(".*") for part in words if f"]){re.escape(part)}[" in text}
    parts[word] = group
    return ".*".join(parts[part] for part in words if part in parts)


def _check(profile: Profile, stated: StatedColumns, files: Sequence[Path]) -> None:
    """Refuse a profile if the command of a log follows a wall that differs from the stated one.

    Raises
    ------
    ProfileError
        If a log contradicts the profile. The message names the log and the option to correct.
    """
    off, looked = [], 0
    for sample in check_samples(profile, spread(files, MOST_SAMPLES)):
        looked += 1
        for trial in sample["trials"]:
            if trial["other_gains"]:
                off.append((sample["path"], trial["other_gains"]))
    if not off:
        return
    path, why = off[0]
    why = common_remedy(why) if len(off) > 1 else why
    others = f" ({len(off)} of {counted(looked, 'log')} are faulty.)" if looked > 1 else ""
    raise ProfileError(f"{path}: {_in_options(why, stated)}.{others}")


def _parts(text: str) -> tuple[str, str]:
    """Return name and unit of a column as written, without the sign."""
    name, colon, unit = text.lstrip("+-").rpartition(":")
    return (name, unit) if colon and find_unit(unit) else (text.lstrip("+-"), "")


def _in_options(cure: str, stated: StatedColumns) -> str:
    """Return a remedy, with profile lines replaced by options."""

    def name(option: str) -> str:
        return _parts(getattr(stated, option, None) or "")[0]

    def column(match: re.Match[str]) -> str:
        key, sign, unit = match[1], match[2], match[3]
        unit = unit or _parts(getattr(stated, key, None) or "")[1]
        return f"--{key} '{'-' if sign == '-1' else ''}{name(key)}{':' if unit else ''}{unit}'"

    def units(match: re.Match[str]) -> str:
        pairs = re.findall(r'(\w+) = "([^"]*)"', match[1])
        return " ".join(f"--{OPTIONS.get(key, key)} '{name(key)}:{unit}'" for key, unit in pairs)

    text = re.sub(r'\[columns\.(\w+)\](?: sign = (-?1),?)?(?: unit = "([^"]*)")?', column, cure)
    text = re.sub(r"\[units\] ((?:\w+ = \"[^\"]*\"(?:, )?)+)", units, text)
    text = text.replace("the units and signs in the profile", "columns, units and signs")
    return text.replace("the header states", "the options state")
