"""A first profile for a sample: TOML with what is sure filled in, and questions where nothing must be guessed.

A question stands as ``# QUESTION: key: words`` above the key, which is commented out with a possible answer: to take
the remark sign off the key, and to correct its value, answers it. Where the command obeys a wall law, columns, signs,
step, unit of time and sampling period (devices have 20 us to 0.1 s) and the unit of the stiffness in the file names are
no questions: the law tells them, and `check` holds it against the answers.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.base.errors import LogError, ProfileError, UsageError
from pipeline.base.units import UNITS, find_unit, unit_between, unit_in_heading
from pipeline.profiles.patterns import find_groups
from pipeline.profiles.profile_columns import QUANTITIES
from pipeline.profiles.profile_lines import QUESTION
from pipeline.profiles.profile_model import CONDITION_QUANTITIES, Format, Profile
from pipeline.readers.formats.delimited import PACKED, unpacked
from pipeline.readers.formats.files import read_file
from pipeline.readers.frame import ColumnInfo, Frame
from pipeline.readers.layout import Layout, format_of, text_layout
from pipeline.readers.obeyed import Law, law_of
from pipeline.records.models import Motion

LISTED_CHOICES = 10
"""Columns that a question names; with more it points to the list."""

LONGEST_FIRST = 80
"""Characters of the first values of a column that are shown."""

LISTED_COLUMNS = 24
"""Columns that the draft lists as comments; a robot with seven joints has some thirty, a bag hundreds."""

MOST_TRIED = 8
"""Columns of numbers that are tried as command and position."""

SAME = 0.1
"""Part by which a number may differ from what the command obeys: names are rounded."""

_RANGES = {"time": (2e-5, 0.1), "command": (1e-3, 1e4), "position": (1e-6, 0.8)}
"""Sampling period [s], and range of command [N, Nm] and position [m, rad] in one log of a device."""

_USUAL = {
    "time": ("s", "ms", "us", "ns"),
    "command": ("N", "mN", "Nm", "mNm"),
    "position": ("m", "mm", "um", "rad", "deg"),
}
"""Units in the order in which they are proposed."""

_ROLES = {
    "time": r"t|time|times?tamps?|stamp|zeit|zeitstempel|tout|@stamp|@time",
    "command": r"command|cmd|force[ _-]?(?:command|cmd|desired)|(?:tau|torque)[ _-]?(?:command|cmd|desired)",
    "position": r"position|pos|weg|lage|winkel|angle",
}
"""Names that say beyond doubt what a column is, without their unit; symbols such as x or F do not."""

_LIKELY = {
    "time": r"(?!)",
    "command": r"f|u|tau|m|kraft|moment|force|torque|(?:f|u)[ _-]?(?:cmd|soll|des)",
    "position": r"x|q|s|phi|theta|pos.*|x[ _-]?(?:ist|act|meas)|v|vel|velocity|speed|omega|dx|dq",
}
"""Names that a question gives as its possible answer."""

_NAMED_WALL = re.compile(r"(?<![A-Za-z])([KB])([_=]?)(-?)\d+\.?\d*", re.IGNORECASE)
"""Stiffness or damping in the name of a file."""

_SPEEDS = frozenset(QUANTITIES["velocity"].values())

_SIGN_QUESTIONS = {
    "command": "does a positive command push towards greater positions (1), or against them (-1)?",
    "position": "do its numbers rise in the direction that counts as positive (1), or fall (-1)?",
}


@dataclass(frozen=True, eq=False)
class Sample:
    """A log of which nothing is known: its bytes, format, how its text is laid out, and its columns."""

    name: str
    data: bytes
    kind: Format
    layout: Layout
    infos: list[ColumnInfo]
    refused: tuple[str, ...] = ()
    """What of it is not read, why, and how it is exported."""

    def frame(self, wanted: tuple[str, ...]) -> Frame:
        """Return columns by name as they stand in the file; raises LogError where they do not go together."""
        return read_file(self.profile, (self.name,), (self.data,), wanted).frame()

    @property
    def profile(self) -> Profile:
        """What reads the file as it is."""
        return Profile.model_construct(name="draft", format=self.kind, files=("*",), **self.layout.to_read())


def open_sample(path: Path) -> Sample:
    """Return a log of which nothing is known.

    Raises
    ------
    UsageError
        If the file cannot be read.
    LogError
        If no columns of numbers are found in it.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UsageError(f"{path}: cannot be read ({error.strerror}). Give a log.") from error
    kind = format_of(path.name, data)
    if kind == "delimited" and data.startswith(tuple(PACKED)):
        kind = format_of(path.name, unpacked(path.name, data))
    layout = text_layout(path.name, data) if kind == "delimited" else Layout()
    sample = Sample(path.name, data, kind, layout, [])
    if kind == "native":
        return sample
    contents = read_file(sample.profile, (path.name,), (data,))
    layout.keys |= contents.keys
    infos = contents.listed()
    refused = [f"{info.name} {info.hint}" for info in infos if not info.rows and info.hint]
    infos = [info for info in infos if info.rows > 1 and info.name]
    if all(info.dtype == "text" for info in infos):
        raise LogError(
            "it holds no columns of numbers with several rows. "
            + ("; ".join(refused) or "Export the recorded signals as plain columns."),
            code="empty",
        )
    return replace(sample, infos=infos, refused=tuple(refused))


def draft_profile(path: Path, *others: Path) -> str:
    """Return a first profile for a sample as TOML text, with a line for each other sample that is not of its form.

    Raises
    ------
    UsageError
        If the file cannot be read.
    ProfileError
        If it is a native log, which needs none, or no columns are found in it.
    """
    try:
        sample = open_sample(path)
        if sample.kind == "native":
            raise ProfileError(f"{path} is a native log, which needs no profile: `pipeline ingest {path}` reads it.")
        lines = [*_lines(sample, path, others), *(text for other in others if (text := _difference(sample, other)))]
        return "".join(f"{_printable(line)}\n" for line in lines)
    except LogError as error:
        raise ProfileError(f"{path}: no profile can be drafted: {error.reason}") from error


def _difference(sample: Sample, path: Path) -> str:
    """Return a comment on how another file differs from the sample; empty where one profile reads both."""
    try:
        other = open_sample(path)
    except LogError as error:
        return f"# {path.name} is not of this form: {error.reason}"
    if other.kind != sample.kind:
        return f"# {path.name} is of format {other.kind}, not {sample.kind}: it needs a profile of its own"
    layouts = {**other.layout.keys, **{f"{key} (asked)": "" for key in other.layout.questions}}
    own = {**sample.layout.keys, **{f"{key} (asked)": "" for key in sample.layout.questions}}
    keys = sorted(key for key in layouts.keys() | own.keys() if layouts.get(key) != own.get(key))
    names, mine = [info.name for info in other.infos], [info.name for info in sample.infos]
    columns = [] if names == mine else [f"columns {_toml(names[:LISTED_CHOICES])}"]
    found = [f"{key} = {_toml(layouts.get(key, 'absent'))}" for key in keys] + columns
    return f"# {path.name} is laid out otherwise: {', '.join(found)}" if found else ""


@dataclass(frozen=True)
class Evidence:
    """What the numbers of a log show: the wall law that its command obeys, its columns by role, and their units.

    ``units`` are those that the file states, else the first in which the numbers are plausible.
    """

    law: Law
    columns: dict[str, ColumnInfo]
    units: dict[str, str]
    time_is_sure: bool
    period_s: float
    first_row: bool

    def si(self, key: str) -> float:
        """Return stiffness, damping or step in SI, in the units that are proposed."""
        factor = UNITS[self.units["command"]].factor
        return (
            float(abs(getattr(self.law, key))) * factor / (1 if key == "step" else UNITS[self.units["position"]].factor)
        )


def _evidence(sample: Sample, likely: dict[str, ColumnInfo]) -> Evidence | None:
    """Return what the numbers show; None where no columns obey a wall law with a stiffness."""
    time, *rest = [likely.get("time"), *_numbers(sample.infos)[:MOST_TRIED]]
    pairs = [(a, b) for a in rest for b in rest if a is not b and time is not None and time not in (a, b)]
    own = (likely.get("command"), likely.get("position"))
    for command, position in sorted(pairs, key=lambda pair: pair != own):
        assert time is not None
        try:
            values = sample.frame((time.name, command.name, position.name)).columns.values()
            stamps, force, place = (np.asarray(column, dtype=np.float64) for column in values)
        except (LogError, ValueError):
            return None
        columns = {"time": time, "command": command, "position": position}
        pace = float(np.median(np.diff(stamps)))
        spans = {"time": pace, "command": float(np.ptp(force)), "position": float(np.ptp(place))}
        units = {key: _plausible(key, columns[key], span) for key, span in spans.items()}
        if not all(units.values()):
            continue
        factor = UNITS[units["time"][0]].factor
        law = law_of(stamps * factor, force, place)
        if law is not None and law.stiffness and law.step:
            chosen = {key: found[0] for key, found in units.items()}
            return Evidence(
                law, columns, chosen, len(units["time"]) == 1, pace * factor, abs(force[0]) > abs(law.step) / 2
            )
    return None


def _plausible(key: str, info: ColumnInfo, span: float) -> list[str]:
    """Return the units in which the numbers of a column are those of a device; the stated one alone where it is."""
    low, high = _RANGES[key]
    fits = [unit for unit in _USUAL[key] if low <= span * UNITS[unit].factor <= high]
    stated = _bare(info, key)[1].translate(str.maketrans("µμ", "uu"))
    return [stated] if stated in fits else fits


def _lines(sample: Sample, path: Path, others: Sequence[Path]) -> Iterator[str]:
    """Yield the lines of the draft."""
    name, kind, layout, infos = sample.name, sample.kind, sample.layout, sample.infos
    packed = name.lower().endswith((".gz", ".zst"))
    suffix = "".join(Path(name).suffixes[-2 if packed else -1 :])
    short = re.sub(r"[^a-z0-9]+", "_", Path(name).stem.lower()).strip("_")
    by_position = kind == "delimited" and not layout.keys.get("header", True)
    roles = {} if by_position else _roles(infos)
    likely = _likely(sample, roles)
    seen = None if by_position or _speed(likely.get("position")) else _evidence(sample, likely)
    if seen:
        roles = likely = seen.columns
    yield f"# Draft for {_toml(name)}. Where a question stands: set the key below it."
    yield f"name = {_toml(short or 'lab')}"
    yield f"format = {_toml(kind)}"
    yield f"files = [{_toml(_files(name, suffix))}] # names of the logs"
    for key, value in layout.keys.items():
        yield f"{key} = {_toml(value)}"
    for key, words in layout.questions.items():
        yield from _question(key, words, f"{key} = {_toml(',' if key == 'decimal' else 'latin-1')}")
    if seen:
        yield f'step_at = "{"first row" if seen.first_row else "command edge"}"'
    else:
        words = 'when does the step happen: "command edge" (found in the command; rows before it are recorded) or '
        words += '"first row"? Or give step_row or step_time_s in its place.'
        yield from _question("step_at", words, 'step_at = "command edge"')
    wall = _wall_in_name(name.removesuffix(suffix))
    groups = {key: float(value) for key, value in (find_groups(wall, name) or {}).items()} if wall else {}
    if wall and others and seen and all(find_groups(wall, other.name) for other in others):
        yield f"name_pattern = {_toml(wall)}"
    elif wall:
        given = " and ".join(groups)
        words = f"does the file name hold {given}? Else put it into [constants]."
        yield from _question("name_pattern", words, f"name_pattern = {_toml(wall)}")
    yield ""
    yield "# Columns of the file:"
    for info in infos[:LISTED_COLUMNS]:
        hint = f", the file says {info.hint!r}" if info.hint else ""
        first = ", ".join(info.first)[:LONGEST_FIRST]
        yield f"#   {_toml(info.name)}: {info.dtype}, {info.rows} rows, {first}{hint}"
    yield from (f"# Not read: {text}" for text in sample.refused)
    if len(infos) > LISTED_COLUMNS:
        yield f"#   and {len(infos) - LISTED_COLUMNS} more"
    if seen:
        told = ", ".join(f"{key} {seen.si(key):.4g}" for key in ("stiffness", "damping", "step"))
        yield "# The command obeys a wall law in the columns below, which tells them, the step and the signs (but for"
        yield f"# the direction that counts as positive): {told} in SI, if the units are right."
    frame = _frame(sample, roles)
    for key in ("time", "command", "position"):
        yield from _column(key, roles.get(key), likely.get(key), infos, by_position, frame, seen)
    yield from _units(seen, groups)
    yield from _constants(path, frame, groups, seen)


def _units(seen: Evidence | None, groups: dict[str, float]) -> Iterator[str]:
    """Yield the unit of conditions in file names, where the command tells it."""
    found = {}
    for key, value in groups.items():
        factor = seen.si(key) / abs(value) if seen and value else 1.0
        base = next(symbol for symbol, unit in UNITS.items() if unit == (CONDITION_QUANTITIES[key][_motion(seen)], 1.0))
        if abs(factor - 1) > SAME and (unit := unit_between(base, factor, SAME)):
            found[key] = "N/mm" if unit == "kN/m" else unit
    if found:
        yield ""
        yield "[units] # the command obeys the numbers in the file name in these units"
        yield from (f"{key} = {_toml(unit)}" for key, unit in found.items())


def _motion(seen: Evidence | None) -> Motion:
    turns = seen is not None and UNITS[seen.units["position"]].quantity == "angle"
    return "rotation" if turns else "translation"


def _files(name: str, suffix: str) -> str:
    """Return the pattern of the names of a file and of those beside it, which differ in their numbers."""
    pattern = re.sub(r"-?\d+(?:[.,]\d+)*", "*", re.sub(r"[\[*?]", "?", name.removesuffix(suffix)))
    return (pattern if "*" in pattern else "*") + suffix


def _wall_in_name(stem: str) -> str:
    """Return the pattern of a name that has a stiffness or a damping, each once; empty where it has not."""
    found = [match.groups() for match in _NAMED_WALL.finditer(stem)]
    letters = [letter.upper() for letter, *_ in found]
    if "K" not in letters or len(set(letters)) < len(letters):
        return ""
    groups = {"K": "stiffness", "B": "damping"}
    # a dash behind both letters parts them from their numbers; behind one alone it is its sign
    dashed = len(found) > 1 and all(minus for *_, minus in found)
    return ".*".join(
        f"{letter}{sign}{'-' if dashed else ''}(?P<{groups[letter.upper()]}>-?[0-9]+[.]?[0-9]*)"
        for letter, sign, _ in found
    )


def _printable(line: str) -> str:
    """Return a line with what TOML does not allow, or nobody sees, escaped."""
    return "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in line)


def _toml(value: object) -> str:
    return json.dumps(value, ensure_ascii=False)


def _question(key: str, words: str, answer: str) -> Iterator[str]:
    yield f"{QUESTION} {key}: {words}"
    yield f"# {answer}"


def _bare(info: ColumnInfo, role: str) -> tuple[str, str]:
    """Return the last part of a name without its unit, and the unit that the file states there or in its hint."""
    name, unit = unit_in_heading(info.name, [*QUANTITIES[role].values(), *(_SPEEDS if role == "position" else ())])
    return re.split(r"[./]", name)[-1].strip().lower(), unit or info.hint


def _speed(info: ColumnInfo | None) -> str | None:
    """Return the quantity of a column that states the unit of a velocity."""
    unit = None if info is None else find_unit(unit_in_heading(info.name, _SPEEDS)[1] or info.hint)
    return None if unit is None or unit.quantity not in _SPEEDS else unit.quantity


def _numbers(infos: list[ColumnInfo]) -> list[ColumnInfo]:
    return [info for info in infos if info.dtype != "text"]


def _fitting(role: str, pattern: str, infos: list[ColumnInfo]) -> list[ColumnInfo]:
    return [info for info in _numbers(infos) if re.fullmatch(pattern, _bare(info, role)[0])]


def _roles(infos: list[ColumnInfo]) -> dict[str, ColumnInfo]:
    """Return the columns whose name says what they are, where one alone does."""
    fitting = {role: _fitting(role, pattern, infos) for role, pattern in _ROLES.items()}
    return {role: fits[0] for role, fits in fitting.items() if len(fits) == 1}


def _likely(sample: Sample, roles: dict[str, ColumnInfo]) -> dict[str, ColumnInfo]:
    """Return a column of its own for each role: the one that is known, else one whose name or numbers look like it."""
    found, clocks = dict(roles), [] if "time" in roles else _clocks(sample)
    for role, pattern in _LIKELY.items():
        left = [info for info in _numbers(sample.infos) if info not in found.values()]
        good = clocks if role == "time" else _fitting(role, _ROLES[role], left) + _fitting(role, pattern, left)
        if role not in found and (choice := [*(info for info in good if info in left), *left]):
            found[role] = choice[0]
    return found


def _clocks(sample: Sample) -> list[ColumnInfo]:
    """Return the columns whose numbers rise in every row."""
    numbers = _numbers(sample.infos)[:LISTED_COLUMNS]
    try:
        columns = sample.frame(tuple(info.name for info in numbers)).columns
    except LogError:
        return []
    return [i for i in numbers if i.name in columns and (np.diff(columns[i.name].astype(np.float64)) > 0).all()]


def _frame(sample: Sample, roles: dict[str, ColumnInfo]) -> Frame | None:
    """Return the columns whose role is known, to look at their numbers; None where they do not go together."""
    if not roles:
        return None
    try:
        return sample.frame(tuple(info.name for info in roles.values()))
    except LogError:
        return None


def _column(
    key: str,
    info: ColumnInfo | None,
    likely: ColumnInfo | None,
    infos: list[ColumnInfo],
    by_position: bool,
    frame: Frame | None,
    seen: Evidence | None,
) -> Iterator[str]:
    yield ""
    yield f"[columns.{key}]"
    if info is not None:
        yield f"name = {_toml(info.name)}"
    else:
        part = "column" if by_position else "name"
        numbers = [i.name for i in _numbers(infos)]
        short = len(numbers) <= LISTED_CHOICES
        listed = f"One of 1 to {len(infos)}." if by_position else "One of those above."
        if short and not by_position:
            listed = f"One of {', '.join(map(_toml, numbers))}."
        what = {
            "time": 'the time stamps (without any, give kind = "sampled" in its place)',
            "command": "the total force or torque that the controller commands",
            "position": "the position that the controller measures",
        }[key]
        name = numbers[0] if likely is None else likely.name
        shown = name if by_position else _toml(name)
        yield from _question(f"columns.{key}.{part}", f"which column holds {what}? {listed}", f"{part} = {shown}")
    quantities = set(QUANTITIES[key].values())
    if key == "position" and likely is not None and (moving := _speed(likely)) is not None:
        words = f"{likely.name!r} is a velocity: is the position its integral? By differences, or "
        yield from _question(
            "columns.position.integrate", words + 'by trapezoids ("trapezoid").', 'integrate = "difference"'
        )
        quantities = {moving}
    stated = _bare(likely, key)[1] if likely is not None else ""
    known = [symbol for symbol, unit in UNITS.items() if unit.quantity in quantities]
    match = find_unit(stated) if stated else None
    fits = match is not None and match.quantity in quantities
    said = f"the file says {stated!r}; is it right? " if stated else "the file does not say it. "
    counts = " For counts give counts_per_unit, too." if key == "position" else ""
    answer = stated if fits else seen.units[key] if seen else known[0]
    if seen and key == "time" and seen.time_is_sure:
        yield f"unit = {_toml(answer)}"
    else:
        words = f"{said}One of {', '.join(known)}.{counts}"
        yield from _question(f"columns.{key}.unit", words, f"unit = {_toml(answer)}")
    if seen and key in _SIGN_QUESTIONS:
        yield f"sign = {-1 if key == 'position' and seen.law.stiffness < 0 else 1}"
    elif key in _SIGN_QUESTIONS:
        yield from _question(f"columns.{key}.sign", _SIGN_QUESTIONS[key], "sign = 1")
    if key == "time":
        yield from _time_questions(info, frame)


def _time_questions(info: ColumnInfo | None, frame: Frame | None) -> Iterator[str]:
    """Ask what the numbers of the time column leave open."""
    values = None if info is None or frame is None else frame.columns.get(info.name)
    if values is None or values.dtype.kind not in "iuf" or len(values) < 2:
        return
    # whole numbers such as ns since 1970 lose digits as floats, their distances do not
    steps = np.diff(values - values.min() if values.dtype.kind in "iu" else values).astype(np.float64)
    if np.isnan(steps).any():
        yield from _question(
            "columns.time.blanks", 'some stamps are blank. Leave such rows out ("skip")?', 'blanks = "skip"'
        )
        return
    if (steps > 0).all():
        yield f"# stamps rise by {np.median(steps):.6g} in the median, {steps.min():.6g} to {steps.max():.6g}"
        return
    back, same = int((steps < 0).sum()), int((steps == 0).sum())
    if back:
        words = (
            f'time runs backwards {back} times. Is it a counter that wraps (kind = "counter" and wrap), are they steps '
            '(kind = "steps"), or rows out of order (kind = "absolute" and order = "sort")?'
        )
        yield from _question("columns.time.kind", words, 'kind = "counter"')
    if same:
        words = f'{same} stamps are doubled. Which row stays, "keep first" or "keep last"?'
        words += ' Or were they printed coarsely (kind = "sampled")?'
        yield from _question("columns.time.duplicates", words, 'duplicates = "keep first"')


def _constants(path: Path, frame: Frame | None, groups: dict[str, float], seen: Evidence | None) -> Iterator[str]:
    attributes = {} if frame is None else dict(frame.attributes)
    yield ""
    if attributes:
        yield "# Values beside the table, which [attributes] may take conditions from:"
        shown = list(attributes.items())[:LISTED_COLUMNS]
        yield from (f"#   {_toml(key)}: {_toml(str(value)[:LONGEST_FIRST])}" for key, value in shown)
    yield "# Conditions that differ from file to file may come from name_pattern, [attributes], [condition_columns] or"
    yield "# [[file]]: then put the key there in place of the one below. A log of motion without wall and step has no"
    yield "# stiffness, damping and step."
    numbers = re.findall(r"([A-Za-z]+)[_=-]?(-?\d+(?:\.\d+)?)", path.stem)
    if numbers and not groups:
        pattern = ".*".join(f"{letters}(?P<...>[-0-9.]+)" for letters, _ in numbers)
        yield f"# The file name has numbers; if they are conditions: name_pattern = {_toml(pattern)} (above all tables)"
    yield "[constants]"
    yield from _question("constants.device", "what is the device called?", 'device = "bench"')
    if seen:
        yield f"experiment = {_toml(path.absolute().parent.name or '1')}"
    else:
        yield from _question("constants.experiment", "what is the experiment called?", 'experiment = "1"')
    words = 'is it a "translation" or a "rotation"?'
    yield from _question("constants.motion", words, f"motion = {_toml(_motion(seen))}")
    asked = {
        "stiffness": "virtual stiffness K of the wall, in N/m or Nm/rad (or its unit in [units]); 0 without a wall",
        "damping": "virtual damping B of the wall, in Ns/m or Nms/rad",
        "step": "size of the external step, in N or Nm; 0 where none was commanded",
        "sampling_period_s": "sampling period T of the controller, in s",
    }
    for key, words in asked.items():
        if key in groups:
            continue
        if seen is None:
            proposed = "0.001" if key == "sampling_period_s" else "0"
            yield from _question(f"constants.{key}", f"{words}?", f"{key} = {proposed}")
        elif key == "sampling_period_s" and seen.time_is_sure:
            yield f"{key} = {seen.period_s:.9g} # as the stamps rise in the median"
        elif key == "step":
            yield f"step = {math.copysign(seen.si('step'), seen.law.step):.4g} # the command jumps by it"
        else:
            value = seen.period_s if key == "sampling_period_s" else seen.si(key)
            yield from _question(f"constants.{key}", f"{words}?", f"{key} = {value:.4g}")
