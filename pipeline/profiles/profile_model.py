"""The record of a log profile: files, format, columns, conditions and windows of rows.

If keys contradict each other, `Profile` raises a single error that lists every problem with its place.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from fnmatch import fnmatchcase, translate
from functools import cache, cached_property
from glob import escape
from pathlib import Path
from typing import Annotated, Any, Literal, Self, cast, get_args

import re2
from pydantic import BeforeValidator, Field, model_validator
from pydantic_core import PydanticCustomError

from pipeline.base.errors import ParameterError
from pipeline.base.provenance import sha256
from pipeline.base.units import DRIVES, UNITS, factor_to_si, find_unit, split_quantity
from pipeline.device.parameters import Dimension, is_rotation, unit_of
from pipeline.records.findings import Grip, Motion, Name, Record
from pipeline.records.native import OF_WALL

Kind = Literal["translation", "rotation"]
"""Type of motion of a device. The type does not depend on the quantity of the command."""

QUANTITIES: dict[str, dict[Kind, str]] = {
    "time": {"translation": "time", "rotation": "time"},
    "command": {"translation": "force", "rotation": "torque"},
    "position": {"translation": "length", "rotation": "angle"},
    "force": {"translation": "force", "rotation": "torque"},
    "velocity": {"translation": "velocity", "rotation": "angular velocity"},
}
"""Physical quantity of each column for each type of motion, for a command that is a force or torque."""

Excitation = Literal["step", "release", "hit", "free", "staircase"]
"""Cause of the motion in a trial.

"step": a step of the command at a wall. "release": the release from a position inside a wall, without a step. "hit": a
hit at a wall, without a step. "free": any command without a wall. "staircase": a command without a wall that is
constant between a few steps.
"""

IMPLIED: dict[Excitation, tuple[str, ...]] = {
    "step": (),
    "release": ("step",),
    "hit": ("step",),
    "free": OF_WALL,
    "staircase": OF_WALL,
}
"""Conditions that are always 0 in trials of each kind."""

_DIMENSIONS: dict[str, Dimension] = {
    "time": "time",
    "command": "force",
    "position": "length",
    "velocity": "velocity",
    "stiffness": "stiffness",
    "damping": "damping",
    "step": "force",
    "sampling_period_s": "time",
}
"""Dimension of each column and condition."""


def quantity(key: str, motion: Motion) -> str:
    """Return the physical quantity of a column or condition for a kind of motion.

    >>> quantity("stiffness", "rotation"), quantity("command", "rotation in V"), quantity("force", "rotation in V")
    ('rotational stiffness', 'voltage', 'torque')
    """
    if key == "force":  # a sensor measures a force, regardless of the quantity of the command
        return QUANTITIES[key]["rotation" if is_rotation(motion) else "translation"]
    unit = find_unit(unit_of(_DIMENSIONS[key], motion))
    assert unit is not None, "the units of all dimensions are known"
    return unit.quantity


BLANKS = "blanks"
"""Delimiter of tables whose columns are separated by runs of blanks and tabs."""

Number = Annotated[float, Field(strict=True)]
"""A strict number. "300" in quotation marks and true are errors, not 300 and 1."""

Count = Annotated[int, Field(ge=0, strict=True)]
"""A nonnegative integer."""

Problem = tuple[tuple[str | int, ...], str]
"""Location of an error in a profile, and the message."""


NoTruth = BeforeValidator(lambda value: "true" if value is True else value)
"""Validator that refuses true, because it would otherwise be read as 1."""

_NEGATED = {
    "command": "a positive command accelerates the device towards smaller positions",
    "position": "its numbers decrease when the device moves in the positive direction",
    "force": "its direction is opposite to that of the command",
    "velocity": "its direction is opposite to that of the position",
}
"""Meaning of the sign -1 for each column. The text completes the message "sign = -1 if ..."."""


NUMBERS_IN_NAMES = frozenset({"stiffness", "damping", "step", "sampling_period_s", "added_delay_samples"})
"""Numeric conditions."""

_DECIMAL_COMMA = re.compile(r"(?<=[0-9]),(?=[0-9])")
_CUT_BEHIND = re.compile(r",[0-9](?:[0-9.,]*[0-9])?")
_CUT_BEFORE = re.compile(r"[0-9](?:[0-9.,]*[0-9])?,$")
_THREE_DIGITS = re.compile(r"[+-]?[1-9][0-9]{0,2}![0-9]{3}")
_THOUSANDS = "{} may separate thousands. Write the number without them, with one decimal sign"


@cache
def _compiled(pattern: str) -> Any:
    # re2 is used because regular expressions of Python may backtrack exponentially. For example, ^(a+)+$ would take
    # years for a name of sixty letters.
    options = re2.Options()
    options.log_errors = False  # errors are raised as exceptions
    return re2.compile(pattern, options)


def find_groups(pattern: str, text: str) -> dict[str, str] | None:
    """Return the named groups of the first match of a pattern, or None if there is no match.

    Groups that did not match are omitted. The text must not contain lone surrogates, which `file_names.storable`
    removes.
    """
    match = _compiled(pattern).search(text)
    return None if match is None else {key: value for key, value in match.groupdict().items() if value is not None}


def conditions_in_name(pattern: str, name: str) -> dict[str, str] | None:
    """Return the conditions that a pattern reads from a file name, or None if the pattern does not match. Without a
    match, the pattern is tried again with points in place of commas between digits. A number is always returned
    completely. If the pattern ends a number at a comma between digits, the remaining digits are appended. A comma that
    the pattern requires is a separator.

    Raises
    ------
    ParameterError
        If the number that the pattern reads begins after a comma that the pattern does not require.

    Examples
    --------
    >>> conditions_in_name("K(?P<stiffness>[0-9.]+)_B(?P<damping>[0-9.]+)", "K300_B2.csv")
    {'stiffness': '300', 'damping': '2'}
    >>> conditions_in_name("K(?P<stiffness>[0-9.]+)", "K2,5.csv")
    {'stiffness': '2,5'}
    >>> conditions_in_name("K(?P<stiffness>[0-9.]+),(?P<damping>[0-9.]+)", "K300,2.csv")
    {'stiffness': '300', 'damping': '2'}
    """
    for text in (name, _DECIMAL_COMMA.sub(".", name)):
        if (match := _compiled(pattern).search(text)) is not None:
            break
    else:
        return None
    found: dict[str, str] = {}
    for key, group in sorted(_compiled(pattern).groupindex.items(), key=lambda named: named[1]):
        begin, end = match.span(group)
        if match[group] is None:
            continue
        found[key] = name[begin:end]
        if key not in NUMBERS_IN_NAMES:
            continue
        before = _CUT_BEFORE.search(name[:begin]) if found[key][:1].isdigit() else None
        if before is not None and not _requires_comma(pattern, text, begin - 1, group):
            raise ParameterError(
                f"name_pattern takes {found[key]!r} as the {key} and omits {before[0]!r} before it. If the comma is a "
                "decimal sign, include it in the group. Otherwise, write it before the group"
            )
        behind = _CUT_BEHIND.match(name[end:]) if found[key][-1:].isdigit() else None
        if behind is not None and not _requires_comma(pattern, text, end, group):
            found[key] += behind[0]
        found[key] = found[key].strip().rstrip(".,")
    return found


def _requires_comma(pattern: str, text: str, comma: int, group: int) -> bool:
    """Return True if a pattern requires a comma. A different character in its place then changes the match of the
    group."""
    spans = []
    for tried in (text, f"{text[:comma]}\x01{text[comma + 1 :]}"):
        match = _compiled(pattern).search(tried)
        spans.append(None if match is None else match.span(group))
    return spans[0] != spans[1]


def number_in_name(text: str, decimal: str = ".") -> float:
    """Return a number from a file name, with a point or a comma as the decimal sign.

    Parameters
    ----------
    text : str
    decimal : {".", ","}
        Decimal sign of the profile. A number in which three digits follow the other sign is refused, because that sign
        may separate thousands.

    Raises
    ------
    ParameterError
        If a point or comma may separate thousands.
    ValueError
        If the text is not a number.

    Examples
    --------
    >>> number_in_name("2,5"), number_in_name("-0,125"), number_in_name("1.250"), number_in_name("300")
    (2.5, -0.125, 1.25, 300.0)
    """
    other = "," if decimal == "." else "."
    if text.count(",") + text.count(".") > 1:
        raise ParameterError(_THOUSANDS.format("points and commas"))
    if _THREE_DIGITS.fullmatch(text.replace(other, "!")):
        raise ParameterError(_THOUSANDS.format("the comma" if other == "," else "the point"))
    return float(text.replace(",", ".").replace("_", "?"))


def group_names(pattern: str) -> frozenset[str]:
    """Return the names of the groups of a pattern."""
    return frozenset(_compiled(pattern).groupindex)


def pattern_problem(pattern: str | None) -> str | None:
    """Return the reason why a pattern is invalid, with the remedy, or None if the pattern is valid."""
    try:
        _compiled(pattern or "")
    except re2.error as error:
        found = error.args[0].decode() if isinstance(error.args[0], bytes) else error.args[0]
        return (
            f"not a valid regular expression: {found}. Lookahead, lookbehind and backreferences are not supported. "
            "Write out the text at that place, or state the condition in [[file]]"
        )
    return None


class TextLayout(Record):
    """Layout of a delimited text file. It may be compressed with gzip or zstd, which is detected from its first bytes.

    Parameters
    ----------
    delimiter : str
        One character, or ``"blanks"`` for runs of blanks and tabs.
    decimal : {".", ","}
        Decimal sign. It must be given because "1,234" may mean 1.234 or 1234.
    encoding : {"utf-8", "utf-16", "latin-1", "cp1252"}
        Encoding. A byte order mark is allowed in UTF-8 and UTF-16.
    skip_rows : int
        Number of lines above the table, or above the first line that is compared with `header_at`.
    header : bool
        True if the table begins with a line of column names. Otherwise, columns are selected by position (``column =
        3``).
    header_at : str, optional
        Regular expression. The table begins at the first matching line, for example below a block of header lines.
    unit_line : bool
        True if the line below the names contains units. Checks display these units but never apply them.
    comment : str, optional
        Prefix of lines that are skipped.
    labels : str, optional
        Separator between label and value in lines such as ``Gain: 32``, above the table or between its rows.
    trailing_delimiter : bool
        True if rows end with an additional delimiter.
    row_end : str, optional
        Other character at the end of rows, such as ``;`` if commas separate the cells.
    blank_lines : {"refuse", "skip"}
        Treatment of blank lines between rows. Blank lines at the end of a file are always ignored.
    missing : tuple of str
        Cells that mean "no value", in addition to blank cells.
    """

    delimiter: Annotated[str, Field(min_length=1)] = ","
    decimal: Literal[".", ","] | None = None
    encoding: Literal["utf-8", "utf-16", "latin-1", "cp1252"] = "utf-8"
    skip_rows: Count = 0
    header: bool = True
    header_at: str | None = None
    unit_line: bool = False
    comment: Annotated[str, Field(min_length=1)] | None = None
    labels: Annotated[str, Field(min_length=1)] | None = None
    trailing_delimiter: bool = False
    row_end: Annotated[str, Field(min_length=1, max_length=1)] | None = None
    blank_lines: Literal["refuse", "skip"] = "refuse"
    missing: tuple[str, ...] = ()

    @property
    def decimal_sign(self) -> str:
        """Decimal sign of numbers in texts. In binary formats, the default is a point."""
        return self.decimal or "."

    def layout_problems(self) -> Iterator[Problem]:
        """Yield contradictions in the layout."""
        if len(self.delimiter) != 1 and self.delimiter != BLANKS:
            yield ("delimiter",), f"expected one character or {BLANKS!r}, found {self.delimiter!r}"
        if self.decimal is None:
            yield ("decimal",), """missing; add the line decimal = "." or decimal = ",", depending on the file"""
        if self.delimiter == self.decimal:
            yield ("decimal",), f"{self.decimal!r} is also the delimiter, but the two characters must differ"
        if problem := pattern_problem(self.header_at):
            yield ("header_at",), problem


class Source(Record):
    """A column of a file with the unit of its numbers.

    Parameters
    ----------
    name : str, optional
        Name of the column in the file.
    column : int, optional
        Position of the column in delimited text, counted from 1. Either name or position is required.
    file : {"source", "partner"}
        File of a pair that contains the column.
    unit : str
        Unit of the numbers. There is no default, because a unit is never guessed.
    counts_per_unit : float, optional
        Number of counts per unit, if the numbers are counts (for example, 4096 and ``rev`` for an encoder).
    sentinels : tuple of float
        Numbers that mean "no value".
    blanks : {"refuse", "hold", "skip"}
        Treatment of a row whose cell is blank or a sentinel: refuse the log, repeat the previous value, or omit the
        row.
    provenance : str
        Origin of the values ("motor current", "numerical derivative"), which is stored with each trial.
    """

    name: str | None = None
    column: Annotated[int, Field(ge=1, strict=True)] | None = None
    file: Literal["source", "partner"] = "source"
    unit: Name | None = None
    counts_per_unit: Annotated[Number, Field(gt=0)] | None = None
    sentinels: tuple[Number, ...] = ()
    blanks: Literal["refuse", "hold", "skip"] = "refuse"
    provenance: str = ""

    @property
    def in_file(self) -> bool:
        """True if a column of the file is stated."""
        return self.name is not None or self.column is not None

    @property
    def key(self) -> str:
        """Name of the column in `FileColumns`."""
        return str(self.column) if self.name is None else self.name


class ColumnSource(Source):
    """Column for command, position, force or velocity.

    Parameters
    ----------
    sign : {1, -1}
        -1 if the axis of the column points in the opposite direction. There is no default, because a sign is never
        guessed.
    stands_for : str, optional
        Unit that replaces `unit` in logs of other systems, for example ``N`` for the ``%`` of a heater. This unit is
        stored with each trial.
    """

    sign: Annotated[Literal[1, -1], NoTruth] | None = None
    stands_for: Name | None = None


class CommandSource(ColumnSource):
    """Column of the command, or its value if the file has no such column.

    Parameters
    ----------
    value : float, optional
        The command [`unit`] from `from_row` (counted from 0) or `from_s` (seconds, same origin as the time stamps) on.
        Before, the command is 0.
    from_row, from_s : optional
        Start of the command. Exactly one of the two is required.
    """

    value: Number | None = None
    from_row: Annotated[int, Field(ge=0, strict=True)] | None = None
    from_s: Number | None = None


class PositionSource(ColumnSource):
    """Column of the position, or of a velocity whose integral is the position.

    Parameters
    ----------
    integrate : {"difference", "trapezoid"}, optional
        Rule if the column is a velocity [m/s, rad/s]. The position is its integral over time, from 0 in the first row.
        ``"difference"``: each velocity is the displacement since the previous row divided by the elapsed time, as
        drives compute it from an encoder. The integral is exactly the encoder reading. ``"trapezoid"``: each velocity
        is the instantaneous velocity, for example of a tachometer, and changes linearly between rows.
    unwrap : bool or float, optional
        Treatment of an angle that wraps after a turn. By default, only a rotation with clear wraps is unwrapped. With
        true, an angle is unwrapped whenever jumps show a modulus, and with false never. A number is the modulus in the
        unit of the column.
    """

    integrate: Literal["difference", "trapezoid"] | None = None
    unwrap: bool | Annotated[Number, Field(gt=0)] | None = None


class Fraction(Record):
    """Second part of a time stamp, such as nanoseconds in addition to seconds. Both parts are integers."""

    name: Name
    unit: Literal["s", "ms", "us", "ns"]


class TimeSource(Source):
    """Column of the time stamps.

    Parameters
    ----------
    kind : {"absolute", "steps", "counter", "sampled"}
        Meaning of the stamps. "absolute": time. "steps": time since the previous row, 0 in the first row. "counter": a
        counter; time is counted from the first row. "sampled": one row per sampling period, without stamps; the stamps
        of a given column are kept as raw time and must agree with it.
    wrap : float, optional
        Number of counts after which a counter restarts from 0 (2^32 = 4294967296).
    fraction : Fraction, optional
        Column with the fractional part of the stamp.
    order : {"file", "sort"}
        ``"sort"`` sorts the rows by time stamp. With ``"file"``, decreasing time stamps are refused.
    duplicates : {"refuse", "keep first", "keep last"}
        Treatment of rows with equal stamps.
    """

    blanks: Literal["refuse", "skip"] = "refuse"  # a time stamp must not be repeated
    kind: Literal["absolute", "steps", "counter", "sampled"] = "absolute"
    wrap: Annotated[Number, Field(gt=0)] | None = None
    fraction: Fraction | None = None
    order: Literal["file", "sort"] = "file"
    duplicates: Literal["refuse", "keep first", "keep last"] = "refuse"


class Columns(Record):
    """The three required columns of a log, and two optional columns: measured force and logged velocity."""

    time: TimeSource | None = None
    command: CommandSource | None = None
    position: PositionSource | None = None
    force: ColumnSource | None = None
    velocity: ColumnSource | None = None

    def sources(self) -> dict[str, Source]:
        """Return the stated columns, keyed by SI name."""
        found = {key: getattr(self, key) for key in Columns.model_fields}
        return {key: source for key, source in found.items() if source is not None}


def si_unit(quantity: str) -> str:
    """Return the SI unit of a physical quantity.

    >>> si_unit("rotational stiffness")
    'Nm/rad'
    """
    return next(symbol for symbol, unit in UNITS.items() if unit == (quantity, 1.0))


def quantity_of(key: str, source: Source, motion: Motion) -> str:
    """Return the physical quantity of a column. For a position that is obtained by integration, this is a velocity."""
    integrated = isinstance(source, PositionSource) and source.integrate is not None
    return quantity("velocity" if integrated else key, motion)


def drive_in(source: Source | None) -> str:
    """Return the quantity of a command that is neither force nor torque, such as voltage. Otherwise, return ""."""
    unit = find_unit(getattr(source, "stands_for", None) or source.unit or "") if source else None
    return unit.quantity if unit is not None and unit.quantity in DRIVES else ""


@dataclass(frozen=True)
class Gain:
    """Force [N] or torque [Nm] per unit of a drive.

    Parameters
    ----------
    factor : float
        Force or torque per internal unit of the drive (`base.units.DRIVES`): V, A, counts or %.
    drive : str
        Quantity of the drive, such as voltage.
    """

    factor: float
    drive: str

    @classmethod
    def read(cls, text: str, kind: Kind) -> Self:
        """Read a gain such as ``'2.3 N/V'``.

        Raises
        ------
        ParameterError
            If the text is not a positive number with a unit of force (torque for a rotation) per unit of a drive.
        """
        force, found = QUANTITIES["command"][kind], split_quantity(text)
        units = {f"{force} per {drive}": drive for drive in DRIVES}
        unit = find_unit(found[1]) if found else None
        if found is None or unit is None or unit.quantity not in units or not found[0] > 0:
            example = "N/V, mN/A, N/%, N/counts" if force == "force" else "Nm/V, mNm/A, Nm/%, Nm/counts"
            raise ParameterError(f"the gain is {text!r}; expected a number above 0 with its unit, such as {example}")
        return cls(found[0] * unit.factor, units[unit.quantity])


def factor(key: str, source: Source, motion: Motion, gain: Gain | None = None) -> float:
    """Return the signed factor from the numbers of a column to SI, or to the unit of a drive.

    Raises
    ------
    ParameterError
        If the unit is unknown or does not match the column.
    """
    sign, unit = 1, source.unit
    if isinstance(source, ColumnSource):
        # Only the unit is checked here. A missing sign is reported separately.
        sign, unit = source.sign or 1, source.stands_for or source.unit
    if unit is None:
        raise ParameterError(f"{key} has no unit")
    if gain is not None and key == "command":
        return sign * gain.factor * factor_to_si(unit, (gain.drive,)) / (source.counts_per_unit or 1.0)
    return sign * factor_to_si(unit, (quantity_of(key, source, motion),)) / (source.counts_per_unit or 1.0)


def problems_of(columns: Columns, motion: Motion, gain: Gain | None = None) -> Iterator[Problem]:
    """Yield missing or wrong keys of the columns. Units must match the motion of the device."""
    for key in ("time", "command", "position"):
        if getattr(columns, key) is None:
            yield ("columns", key), f"missing. Add [columns.{key}] with name and unit"
    taken: dict[tuple[str, str], str] = {}
    for key, source in columns.sources().items():
        yield from ((("columns", key, part), words) for part, words in _source_problems(key, source, motion, gain))
        other = taken.setdefault((source.file, source.key), key) if source.in_file else key
        if other != key:
            text = f"{source.key!r} is already used for columns.{other}. Choose a different column"
            if "velocity" in (key, other) and columns.position is not None and columns.position.integrate:
                text = (
                    f"{source.key!r} is already columns.position, which is integrated, and its values are stored as "
                    "the velocity. Remove columns.velocity"
                )
            yield ("columns", key, "column" if source.name is None else "name"), text


def _source_problems(key: str, source: Source, motion: Motion, gain: Gain | None) -> Iterator[tuple[str, str]]:
    """Yield key and message for each missing or wrong key of a column."""
    sampled = isinstance(source, TimeSource) and source.kind == "sampled"
    stated = isinstance(source, CommandSource) and source.value is not None
    if isinstance(source, ColumnSource) and source.sign is None:
        yield "sign", f"missing; add the line sign = 1 or sign = -1 (-1 if {_NEGATED[key]})"
    if source.name is not None and source.column is not None:
        yield "column", "stated together with name; expected only one of them"
    if isinstance(source, CommandSource) and stated == (source.from_row is None and source.from_s is None):
        yield "value", "expected value with either from_row or from_s, or none of the three"
    if stated and source.in_file:
        yield "value", "stated together with the column; expected only one of them"
    if not source.in_file and not sampled and not stated:
        more = " (or, without such a column, value with from_row or from_s)" if key == "command" else ""
        yield "name", f'missing. Add name = "<column in the file>" or column = <position>{more}'
    if sampled and not source.in_file:
        return
    if source.unit is None:
        wanted = {quantity_of(key, source, motion), *(DRIVES if key == "command" else ())}
        units = ", ".join(symbol for symbol, unit in UNITS.items() if unit.quantity in wanted)
        yield "unit", f'missing; a unit is never guessed. Add unit = "..." for column {source.key!r}, one of {units}'
        return
    try:
        factor(key, source, motion, gain)
    except ParameterError as error:
        hint = "; for counts, state counts_per_unit and the unit" if source.unit in ("count", "counts") else ""
        unit = find_unit(source.unit)
        if key == "position" and unit is not None and unit.quantity in QUANTITIES["velocity"].values():
            hint = '; to use a velocity, set integrate = "difference" (encoder) or "trapezoid"'
        if key == "command" and not drive_in(source):
            hint = f"{hint}; for a drive, use one of {[symbol for units in DRIVES.values() for symbol in units]}"
        at = "stands_for" if getattr(source, "stands_for", None) else "unit"
        yield at, f"{error} (motion is {motion}){hint}"


Format = Literal[
    "native", "delimited", "json", "parquet", "feather", "matlab", "hdf5", "rosbag", "mcap", "tdms", "mdf", "npz",
    "sheet",
]  # fmt: skip
Condition = Literal[
    "device", "experiment", "stiffness", "damping", "step", "sampling_period_s", "added_delay_samples", "grip"
]
CONDITIONS: tuple[str, ...] = get_args(Condition)
REQUIRED_CONDITIONS = CONDITIONS[:6]
PROBLEMS = "profile_problems"
"""Type of the validation error that lists all problems of a profile."""

_EXAMPLES = {"device": '"bench"', "experiment": '"1"', "sampling_period_s": "0.001"}
GROUPED: tuple[str, ...] = ("json", "matlab", "hdf5", "tdms", "mdf")
"""Formats whose files may have groups of columns."""

CONDITION_QUANTITIES = ("stiffness", "damping", "step", "sampling_period_s")
"""Conditions that have a unit."""


class Partner(Record):
    """Second file of a log, in the same folder. Its name is that of the first file with a text replaced."""

    replace: Name
    by: Annotated[Name, Field(pattern=r"^[^/\\\x00]+$")]


class Conditions(Record):
    """Conditions of a log, in SI or in the units of [units]. A condition is None if it is stated elsewhere."""

    device: Name | None = None
    experiment: Name | None = None
    stiffness: Number | None = None
    damping: Number | None = None
    step: Number | None = None
    sampling_period_s: Annotated[Number, Field(gt=0)] | None = None
    added_delay_samples: Count | None = None
    grip: Grip | None = None

    def given(self) -> dict[str, str | float]:
        """Return the stated conditions."""
        return {key: value for key in CONDITIONS if (value := getattr(self, key)) is not None}


class Constants(Conditions):
    """Conditions of all files of a profile, and the type of motion. By default, the type of motion follows from the
    unit of the position."""

    motion: Kind | None = None


class ConditionUnits(Record):
    """Units of conditions from all sources. The default is SI.

    ``gain`` is the force per unit of a drive, such as ``"2.3 N/V"``. The gain converts a command in V, A, counts or %,
    and conditions in these units, to force.
    """

    stiffness: Name | None = None
    damping: Name | None = None
    step: Name | None = None
    sampling_period_s: Name | None = None
    gain: Name | None = None


class Window(Record):
    """Range of rows, including both ends: by time [s], or by row, counted from 0 as read from the file."""

    from_s: Number | None = None
    to_s: Number | None = None
    from_row: Count | None = None
    to_row: Count | None = None


class StepTime(Record):
    """Time of the step: found in the command, declared by row (from 0) or time [s], or at the first row."""

    step_row: Count | None = None
    step_time_s: Number | None = None
    step_at: Literal["command edge", "first row"] | None = None

    @property
    def declared(self) -> list[str]:
        """Stated keys for the time of the step. Exactly one is expected."""
        return [key for key in StepTime.model_fields if getattr(self, key) is not None]


STEP_MISSING = (
    'missing; add the line step_at = "command edge" (the step is found in the command, and rows before it are '
    'recorded), step_at = "first row", step_row = <row, counted from 0> or step_time_s = <seconds>'
)


class FileEntry(Conditions, StepTime):
    """Conditions, step and window of the files whose names match a pattern."""

    match: Name
    window: Window | None = None


class Sheet(Record):
    """A table of conditions with one row per log, in CSV, XLSX or ODS.

    Parameters
    ----------
    file : str
        Path of the table, relative to the folder of the profile.
    name : str, optional
        Column that names the logs. By default, this column is found by its content.
    columns : tuple of str
        Columns that contain conditions, such as ``"K:stiffness:N/mm"``. Other columns are identified by their names.
    """

    file: Annotated[str, Field(min_length=1)]
    name: Name | None = None
    columns: tuple[Name, ...] = ()


class StepEntry(Conditions, StepTime, Window):
    """One of several steps in a file, with its rows and the conditions that differ from those of the file."""

    label: Name


class Profile(TextLayout, StepTime):
    """Description of the files of a lab, including the keys of text files (`TextLayout`).

    Parameters
    ----------
    name, title : str
    format : str
        File format. Native logs already state their columns and conditions.
    files : tuple of str
        Patterns of the claimed file names (``*``, ``?``, ``[...]``; case is ignored).
    kind : {"step", "release", "hit", "free", "staircase"}
        Cause of the motion. "release" (from a position inside a wall) and "hit" have no step; their start is found in
        the command. "free" has no wall. "staircase" has no wall and a command that is constant between a few steps,
        each of which becomes a trial.
    records : str, optional
        Key of the list of records inside a JSON file, with dots if it is nested.
    partner : Partner, optional
    columns : Columns
    constants : Constants
    units : ConditionUnits
    name_pattern : str, optional
        Regular expression with named groups that reads conditions from the file name, such as
        ``B(?P<damping>[-0-9.]+)_K(?P<stiffness>[0-9.]+)``.
    attributes, condition_columns : dict
        Mapping of a condition to the attribute of the file (a label of text lines, an HDF5 attribute) or the column
        with its value.
    file : tuple of FileEntry
        Settings for single files. At most one entry may match a file.
    sheet : Sheet, optional
        Table whose rows become such entries when the profile is used (`pipeline.readers.sheets.with_sheet`).
    trial_column : str, optional
        Column of labels, for a file with several trials one after the other. Rows with the same label are one trial.
    trials : {"each group"}, optional
        With "each group", each group of the file (HDF5, TDMS or MDF), or each element of a struct array or record, is a
        trial if it has all columns. Names of columns and attributes are then those inside the group.
    steps : tuple of StepEntry
        Several steps in one file, each a separate trial.
    window : Window, optional
        Range of rows that are stored.
    step_row, step_time_s, step_at
        See `StepTime`. One of them is required, either here or in every entry of ``file`` or ``steps``, unless the
        constant ``step`` is 0.

    Notes
    -----
    A condition is taken from the most specific source that states it: steps, file, condition_columns, attributes,
    name_pattern, constants.
    """

    name: Name
    title: str = ""
    format: Format
    files: Annotated[tuple[Name, ...], Field(min_length=1)]
    kind: Excitation = "step"
    records: Name | None = None
    partner: Partner | None = None
    columns: Columns | None = None
    constants: Constants = Constants()
    units: ConditionUnits = ConditionUnits()
    name_pattern: str | None = None
    attributes: dict[Condition, Name] = Field(default_factory=dict)
    condition_columns: dict[Condition, Name] = Field(default_factory=dict)
    file: tuple[FileEntry, ...] = ()
    sheet: Sheet | None = None
    trial_column: Name | None = None
    trials: Literal["each group"] | None = None
    steps: tuple[StepEntry, ...] = ()
    window: Window | None = None

    @model_validator(mode="after")
    def _parts_fit_together(self) -> Self:
        problems = list(self._problems())
        if problems:
            text = "; ".join(f"key {'.'.join(map(str, place))!r}: {what}" for place, what in problems)
            raise PydanticCustomError(PROBLEMS, "{text}", {"text": text, "problems": problems})
        return self

    def __hash__(self) -> int:
        # The hash uses only names and files, which equal profiles have in common, because dictionaries are not
        # hashable.
        return hash((self.name, self.files))

    def _problems(self) -> Iterator[Problem]:
        if self.format == "native":
            if foreign := self.model_fields_set - {"name", "title", "format", "files"}:
                yield ("format",), f"a native log contains {sorted(foreign)}. Remove the keys, or correct the format"
            return
        given = {key for key in self.model_fields_set if getattr(self, key) is not None}
        for form, keys in (("delimited", set(TextLayout.model_fields)), ("json", {"records"})):
            for key in sorted(keys & given) if form != self.format else ():
                yield (key,), f"only for format {form}, found {self.format}. Remove it"
        if self.trials is not None and self.format not in GROUPED:
            yield ("trials",), f"for formats ({', '.join(GROUPED)}), found {self.format}. Remove it"
        if self.format == "delimited":
            yield from self.layout_problems()
        if self.columns is None:
            yield ("columns",), "missing. Add [columns.time], [columns.command], [columns.position]"
        else:
            yield from self._gain_problems()
            yield from problems_of(self.columns, self.motion, self._gain_or_none())
        partners = [key for key, source in self.column_sources().items() if source.file == "partner"]
        if self.partner is None and partners:
            yield (
                ("partner",),
                f"missing, but columns.{partners[0]} is in the partner. Add [partner] with replace and by",
            )
        if self.partner and (self.partner.replace in self.partner.by or self.partner.by in self.partner.replace):
            yield ("partner", "by"), "'replace' and 'by' must not contain each other"
        yield from self._step_problems()
        yield from self._condition_problems()

    def _step_problems(self) -> Iterator[Problem]:
        """Yield errors in [[steps]], and errors due to missing times of the step."""
        entries = {(key, i): e for key in ("steps", "file") for i, e in enumerate(getattr(self, key))}
        places: list[tuple[tuple[str | int, ...], StepTime]] = [((), self), *entries.items()]
        for place, entry in places:
            if len(given := entry.declared) > 1:
                yield (*place, given[1]), f"stated in addition to {given[0]}; expected only one of them"
        labels = [step.label for step in self.steps]
        for index, step in enumerate(self.steps):
            if step.sampling_period_s is not None:
                words = "expected one value for the file. Move it to [constants]"
                yield ("steps", index, "sampling_period_s"), words
            if labels.index(step.label) != index:
                yield ("steps", index, "label"), f"{step.label!r} occurs twice; expected a unique name"
        if self.steps and (self.trial_column or self.window or any(entry.window for entry in self.file)):
            yield ("steps",), "stated together with trial_column or a window; expected only one of them"
        varies = "step" in self._varying()
        constant = 0.0 if self.conditions().isdisjoint(OF_WALL) else None if varies else self.constants.step
        constant = 0.0 if self.kind != "step" else constant
        if self.kind != "step" and (declared := next(((p, e.declared[0]) for p, e in places if e.declared), None)):
            yield (*declared[0], declared[1]), f"a trial of kind {self.kind!r} has no declared step. Remove this key"
        steps = [constant, *(entry.step for entry in entries.values() if entry.step is not None)]
        # If only some entries state a step, the files of the other entries are refused when they are read.
        if (
            self.sheet is None
            and not any(entry.declared for entry in (self, *entries.values()))
            and any(step != 0 for step in steps)
        ):
            yield ("step_at",), STEP_MISSING

    def conditions(self) -> set[str]:
        """Return the conditions that are stated anywhere in the profile."""
        tables = {key for table in (self.constants, *self.file, *self.steps) for key in table.given()}
        return tables | self._varying() | {*IMPLIED[self.kind]}

    def _varying(self) -> set[str]:
        """Return the conditions that each log states by its name, attributes or columns."""
        return {*self.name_groups(), *self.attributes, *self.condition_columns}

    def _stated(self, key: str) -> set[Any]:
        """Return the values of a condition that the profile itself states, except 0."""
        return {getattr(table, key) for table in (self.constants, *self.file, *self.steps)} - {None, 0.0}

    def _implied_problems(self) -> Iterator[Problem]:
        """Yield errors for conditions that are stated although trials of this kind do not have them."""
        for key in IMPLIED[self.kind]:
            stated = self._stated(key)
            if stated or key in self._varying():
                text = f"a trial of kind {self.kind!r} has no such condition. Remove the condition, or correct `kind`"
                yield ("constants" if stated else "kind", *((key,) if stated else ())), f"{key}: {text}"

    def _condition_problems(self) -> Iterator[Problem]:
        yield from self._implied_problems()
        for key in CONDITION_QUANTITIES:
            try:
                self.condition_factor(key)
            except ParameterError as error:
                yield ("units", key), f"{error} (motion is {self.motion}){self._needs_gain(key)}"
        problem = pattern_problem(self.name_pattern)
        if problem is None and self.name_pattern is not None and not self.name_groups():
            problem = (
                "has no named group, and therefore no condition is read from the name. Write (?P<stiffness>[0-9.]+) "
                "for (...)"
            )
        if unknown := sorted(self.name_groups() - set(CONDITIONS)):
            problem = f"the groups {unknown} are unknown; expected names from {list(CONDITIONS)}"
        if problem:
            yield ("name_pattern",), problem
        given = self.conditions()
        # The conditions of a sheet are unknown until it is read.
        for key in REQUIRED_CONDITIONS if self.sheet is None else ():
            # A log of free motion, without a wall and a step, needs no conditions of a wall.
            if key not in given and not (key in OF_WALL and given.isdisjoint(OF_WALL)):
                line = f"{key} = {_EXAMPLES.get(key, '<number>')}"
                others = "or state it in name_pattern, attributes, condition_columns, [[file]] or [[steps]]"
                yield ("constants", key), f"missing. Add {line} to [constants], {others}"

    @property
    def reads_names(self) -> bool:
        """True if the content of a log depends on the name of the file. A renamed copy may then be a different log."""
        return self.name_pattern is not None or bool(self.file)

    def entries_for(self, name: str) -> list[FileEntry]:
        """Return the entries of the profile for a single file."""
        exact, patterns = self._entries
        lower = name.lower()
        fitting = (entry for entry in patterns if fnmatchcase(lower, entry.match.lower()))
        return [*exact.get(lower, ()), *fitting]

    @cached_property
    def _entries(self) -> tuple[dict[str, list[FileEntry]], list[FileEntry]]:
        """Entries for exact file names, keyed by name, and entries for patterns.

        A sheet may have thousands of exact names.
        """
        exact, patterns = dict[str, list[FileEntry]](), list[FileEntry]()
        for entry in self.file:
            name = re.sub(r"\[([*?[])\]", r"\1", entry.match.lower())
            if escape(name) == entry.match.lower():
                exact.setdefault(name, []).append(entry)
            else:
                patterns.append(entry)
        return exact, patterns

    def name_groups(self) -> frozenset[str]:
        """Return the conditions that are read from the file name."""
        return frozenset() if pattern_problem(self.name_pattern) else group_names(self.name_pattern or "")

    def column_sources(self) -> dict[str, Source]:
        """Return time, command, position, and the optional columns, keyed by their SI names."""
        return {} if self.columns is None else self.columns.sources()

    def wanted(self, file: Literal["source", "partner"] = "source") -> dict[str, str]:
        """Return the columns that the profile needs from a file, as a mapping of profile keys to names in
        `FileColumns`."""
        found = {
            f"columns.{key}": source.key
            for key, source in self.column_sources().items()
            if source.file == file and source.in_file
        }
        time = self.columns.time if self.columns else None
        if time is not None and time.fraction is not None and time.file == file:
            found["columns.time.fraction"] = time.fraction.name
        if file == "source":
            found |= {f"condition_columns.{key}": name for key, name in self.condition_columns.items()}
            if self.trial_column is not None:
                found["trial_column"] = self.trial_column
        return found

    def factors(self) -> dict[str, float]:
        """Return the signed factor to SI for each column with a unit."""
        sources = self.column_sources().items()
        units = ((key, source) for key, source in sources if source.unit is not None)
        return {key: factor(key, source, self.motion, self.gain) for key, source in units}

    @property
    def motion_kind(self) -> Kind:
        """Type of motion of the device, as stated, otherwise from the unit of the position. If the position has no unit
        yet, as in a draft, the unit of the command is used.
        """
        if self.constants.motion is not None:
            return self.constants.motion
        position, command = (self.columns.position, self.columns.command) if self.columns else (None, None)
        stated = (position.stands_for or position.unit) if position else None
        unit = find_unit(stated or (command.unit if command else None) or "")
        turns = unit is not None and unit.quantity in ("angle", "angular velocity", "torque")
        return "rotation" if turns else "translation"

    @property
    def drive(self) -> str:
        """Quantity of a command that is neither force nor torque, such as voltage. Otherwise empty."""
        return drive_in(self.columns.command if self.columns else None)

    @property
    def gain(self) -> Gain | None:
        """Gain from the command of a drive to force, or None if the command is a force or stays in units of the drive.

        Raises
        ------
        ParameterError
            If the gain is invalid.
        """
        return None if self.units.gain is None else Gain.read(self.units.gain, self.motion_kind)

    def _gain_or_none(self) -> Gain | None:
        """Return the gain, or None if it is missing or invalid. An invalid gain is reported separately."""
        with suppress(ParameterError):
            return self.gain if self.drive else None
        return None

    @property
    def motion(self) -> Motion:
        """Type of motion with the unit of the command. Without a gain, the unit is that of the drive."""
        return self.motion_kind if not self.drive or self.units.gain is not None else self._motion_of(self.drive)

    def _motion_of(self, drive: str) -> Motion:
        """Return the type of motion with the unit of a drive."""
        return cast(Motion, f"{self.motion_kind} in {next(iter(DRIVES[drive]))}")

    def unit_factor(self, key: str, unit: str) -> float:
        """Return the factor from a unit of a condition to SI, or to the unit of the drive.

        Raises
        ------
        ParameterError
            If the unit is unknown or belongs to a different quantity.
        """
        allowed, known = quantity(key, self.motion), find_unit(unit)
        gain = self.gain if key in OF_WALL else None
        if gain and known and known.quantity == quantity(key, self._motion_of(gain.drive)):
            return known.factor * gain.factor
        return factor_to_si(unit, (allowed,))

    def condition_factor(self, key: str) -> float:
        """Return the factor that converts a condition to SI, or to the unit of the drive."""
        unit = getattr(self.units, key, None)
        return 1.0 if unit is None else self.unit_factor(key, unit)

    def _gain_problems(self) -> Iterator[Problem]:
        """Yield missing or wrong keys for a command in units of a drive, because such a command must not be mistaken
        for a force."""
        assert self.columns is not None, "this is only called for a profile with columns"
        unit = self.columns.command.unit if self.columns.command else None
        for key in OF_WALL if self.drive else ():
            if getattr(self.units, key) is None and (key in self._varying() or self._stated(key)):
                motions = (self._motion_of(self.drive), self.motion_kind)
                wanted = " or ".join(f'"{unit_of(_DIMENSIONS[key], motion)}"' for motion in motions)
                text = f"missing; the command is in {unit}, so a plain number is ambiguous. Add {key} = {wanted}"
                yield ("units", key), text
        if self.units.gain is None:
            return
        if not self.drive:
            yield (
                ("units", "gain"),
                f"the command is in {unit}, which needs no gain. Remove the gain, or correct the unit",
            )
            return
        try:
            gain = Gain.read(self.units.gain, self.motion_kind)
        except ParameterError as error:
            yield ("units", "gain"), str(error)
            return
        if gain.drive != self.drive:
            yield ("units", "gain"), f"{self.units.gain!r} is per {gain.drive}, but the command is in {unit}"

    def _needs_gain(self, key: str) -> str:
        """Return the remedy for a condition in units of force, if the command is in units of a drive."""
        if not self.drive or self.units.gain is not None or key not in OF_WALL:
            return ""
        unit = next(iter(DRIVES[self.drive]))
        return (
            f". The command is in {unit}, so state the condition in {unit} as well, or add "
            f'[units] gain = "<number> N/{unit}"'
        )

    def claims(self, name: str) -> bool:
        """Return True if a file name belongs to a log (not to a partner) of this profile."""
        return _name_pattern(self.files).match(name.lower()) is not None

    def partner_of(self, path: Path) -> Path | None:
        """Return the partner file of a log, or None if a log is a single file."""
        if self.partner is None:
            return None
        return path.with_name(path.name.replace(self.partner.replace, self.partner.by))

    def log_of_partner(self, path: Path) -> Path | None:
        """Return the log whose partner is the given file, or None if the file is not a partner."""
        if self.partner is None or self.partner.by not in path.name:
            return None
        name = path.name.replace(self.partner.by, self.partner.replace)
        return path.with_name(name) if self.claims(name) else None

    @cached_property
    def digest(self) -> str:
        """SHA-256 of all settings that affect how a file is read. The layout and the title of the TOML text have no
        influence.

        Keys with their default are omitted, so that a new key does not change the hashes of profiles without it.
        """
        values = self.model_dump(mode="json", exclude={"title"}, exclude_defaults=True)
        return sha256(json.dumps(values, sort_keys=True).encode())


@cache
def _name_pattern(files: tuple[str, ...]) -> re.Pattern[str]:
    """Return one pattern for all of `Profile.files`, because thousands of names are matched with each profile."""
    return re.compile("|".join(translate(pattern.lower()) for pattern in files))
