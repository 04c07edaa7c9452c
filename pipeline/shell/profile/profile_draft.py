"""A first profile for a sample: TOML with what is sure filled in, and questions where nothing must be guessed.

A question stands as ``# QUESTION: key: words`` above the key, which is commented out with a possible answer: to take
the remark sign off the key, and to correct its value, answers it. Where the command obeys a wall law, columns, signs,
step, unit of time and sampling period (devices have 20 us to 0.1 s) and the unit of the stiffness in the file names are
no questions: the law tells them, and `check` holds it against the answers.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pipeline.base.errors import LogError, ProfileError, UsageError
from pipeline.base.units import UNITS, find_unit, unit_between, unit_in_heading
from pipeline.profiles.patterns import find_groups
from pipeline.profiles.profile_columns import QUANTITIES, si_unit
from pipeline.profiles.profile_lines import QUESTION
from pipeline.profiles.profile_model import CONDITION_QUANTITIES, Format, Profile
from pipeline.readers.file_kind import PACKED, format_of
from pipeline.readers.formats.delimited import unpacked
from pipeline.readers.frame import ColumnInfo, Contents
from pipeline.readers.isolation import read_file
from pipeline.readers.layout import Layout, text_layout
from pipeline.readers.obeyed import Law, law_of
from pipeline.records.models import Motion

KEYS: dict[str, tuple[Any, str]] = {
    "step_at": ("command edge", 'when does the step happen: "command edge", "first row", or step_row or step_time_s?'),
    "name_pattern": (None, "does the file name hold these conditions? Else put them into [constants]."),
    "columns.time.name": (None, 'which column holds the time stamps (without any: kind = "sampled")?'),
    "columns.time.unit": ("s", ""),
    "columns.command.name": (None, "which column holds the total force or torque that the controller commands?"),
    "columns.command.unit": ("N", ""),
    "columns.command.sign": (1, "does a positive command push towards greater positions (1), or against them (-1)?"),
    "columns.position.name": (None, "which column holds the position that the controller measures?"),
    "columns.position.integrate": (None, 'a velocity: is the position its integral by differences, or by "trapezoid"?'),
    "columns.position.unit": ("m", ""),
    "columns.position.sign": (1, "do its numbers rise in the direction that counts as positive (1), or fall (-1)?"),
    "constants.device": ("bench", "what is the device called?"),
    "constants.experiment": ("1", "what is the experiment called?"),
    "constants.motion": ("translation", 'is it a "translation" or a "rotation"?'),
    "constants.stiffness": (0, "virtual stiffness K of the wall [N/m, Nm/rad, or as in [units]]; 0 without a wall?"),
    "constants.damping": (0, "virtual damping B of the wall [Ns/m, Nms/rad]?"),
    "constants.step": (0, "size of the external step [N, Nm]; 0 where none was commanded?"),
    "constants.sampling_period_s": (0.001, "sampling period T of the controller [s]?"),
}
"""Keys of a draft in their order: what is proposed where nothing is seen, and the question."""

LISTED = 24
"""Columns, and values beside them, that the draft lists as comments; a bag has hundreds."""

MOST_TRIED = 8
"""Columns of numbers that are tried as command and position."""

SAME = 0.1
"""Part by which a number may differ from what the command obeys: names are rounded."""


class _Role(NamedTuple):
    """Names that a column of this role may have, units in the order in which they are proposed, and the range [SI] of
    sampling period, command and position in one log of a device."""

    names: str
    units: tuple[str, ...]
    low: float
    high: float


_ROLES = {
    "time": _Role(r"t|time|times?tamps?|stamp|zeit|zeitstempel|tout|@stamp|@time", ("s", "ms", "us", "ns"), 2e-5, 0.1),
    "command": _Role(
        r"command|f|u|tau|m|kraft|moment|force|torque|((f|u|force|tau|torque)[ _-]?)?(cmd|soll|des(ired)?|command)",
        ("N", "mN", "Nm", "mNm"),
        1e-3,
        1e4,
    ),
    "position": _Role(
        r"pos.*|weg|lage|winkel|angle|x|q|s|phi|theta|x[ _-]?(ist|act|meas)|v|vel|velocity|speed|omega|dx|dq",
        ("m", "mm", "um", "rad", "deg"),
        1e-6,
        0.8,
    ),
}
_NAMED_WALL = re.compile(r"(?<![A-Za-z])([KB])([_=]?)(-?)\d+\.?\d*", re.IGNORECASE)
"""Stiffness or damping in the name of a file."""

_SPEEDS = frozenset(QUANTITIES["velocity"].values())


@dataclass(frozen=True, eq=False)
class Sample:
    """A log of which nothing is known: its format, layout of text, contents, columns, and what of it is not read."""

    name: str
    kind: Format
    layout: Layout
    contents: Contents
    infos: list[ColumnInfo]
    refused: list[str]

    def columns(self, infos: Sequence[ColumnInfo]) -> list[np.ndarray]:
        """Return columns as floats; none where they do not go together."""
        try:
            found = replace(self.contents, wanted=tuple(info.name for info in infos)).frame()
            return [np.asarray(found.columns[info.name], dtype=np.float64) for info in infos]
        except (LogError, ValueError):
            return []

    @property
    def numbers(self) -> list[ColumnInfo]:
        """Columns of numbers."""
        return [info for info in self.infos if info.dtype != "text"]


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
    packed = data.startswith(tuple(PACKED)) and format_of(path.name, data) == "delimited"
    kind = format_of(path.name, unpacked(path.name, data) if packed else data)
    layout = text_layout(path.name, data) if kind == "delimited" else Layout()
    if kind == "native":
        raise ProfileError(f"{path} is a native log, which needs no profile: `pipeline ingest {path}` reads it.")
    settings = Profile.model_construct(name="draft", format=kind, files=("*",), **layout.to_read())
    contents = read_file(settings, (path.name,), (data,))
    layout.keys |= contents.keys
    infos = contents.listed()
    refused = [f"{info.name} {info.hint}" for info in infos if not info.rows and info.hint]
    sample = Sample(path.name, kind, layout, contents, [i for i in infos if i.rows > 1 and i.name], refused)
    if not sample.numbers:
        cure = "; ".join(refused) or "Export the recorded signals as plain columns."
        raise LogError(f"it holds no columns of numbers with several rows. {cure}", code="empty")
    return sample


class _Draft:
    """Values of the keys of a profile, and the questions about those that the sample does not tell."""

    def __init__(self, sample: Sample) -> None:
        self.sample = sample
        self.values = {key: default for key, (default, _) in KEYS.items()}
        self.asked = {key: question for key, (_, question) in KEYS.items()}

    def tell(self, key: str, value: Any, sure: bool = True, said: str = "") -> None:
        """Set a key; one that is not sure is asked, with what the file says of it."""
        self.values[key] = value
        self.asked.pop(key, None)
        self.asked |= {} if sure else {key: said + KEYS[key][1]}


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
        lines = [*_lines(sample, path, others), *(_difference(sample, other) for other in others)]
    except LogError as error:
        raise ProfileError(f"{path}: no profile can be drafted: {error.reason}") from error
    # what TOML does not allow, or nobody sees, is escaped
    shown = ("".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in line) for line in lines if line)
    return "".join(f"{line}\n" for line in shown).replace("\n[", "\n\n[")


def _difference(sample: Sample, path: Path) -> str:
    """Return a comment on how another file differs from the sample; empty where one profile reads both."""
    try:
        other = open_sample(path)
    except (LogError, ProfileError) as error:
        return f"# {path.name} is not of this form: {error}"
    own, found = (
        {"format": s.kind, **s.layout.keys, **s.layout.questions, "columns": [info.name for info in s.infos]}
        for s in (sample, other)
    )
    told = [f"{key} = {_toml(found.get(key))}" for key in own | found if own.get(key) != found.get(key)]
    return f"# {path.name} is laid out otherwise: {', '.join(told)}" if told else ""


def _lines(sample: Sample, path: Path, others: Sequence[Path]) -> Iterator[str]:
    """Yield the lines of the draft: the keys that are known or asked, by table."""
    yield f"# Draft for {_toml(sample.name)}. Where a question stands: set the key below it."
    short = re.sub(r"[^a-z0-9]+", "_", Path(sample.name).stem.lower()).strip("_")
    yield from (f"name = {_toml(short or 'lab')}", f"format = {_toml(sample.kind)}")
    yield f"files = [{_toml(_files(sample.name))}] # names of the logs"
    yield from (f"{key} = {_toml(value)}" for key, value in sample.layout.keys.items())
    for key, words in sample.layout.questions.items():
        yield from (f"{QUESTION} {key}: {words}", f"# {key} = {_toml(',' if key == 'decimal' else 'latin-1')}")
    draft, table = _Draft(sample), ""
    law = _fill(draft, path, others)
    for place, value in draft.values.items():
        above, _, key = place.rpartition(".")
        if value is None:
            continue
        if above != table:
            yield from (*(() if table else _remarks(sample, law)), f"[{above}]")
            table = above
        key = "column" if isinstance(value, int) and key == "name" else key
        if place in draft.asked:
            yield f"{QUESTION} {f'{above}.{key}' if above else key}: {draft.asked[place]}"
        yield f"{'# ' if place in draft.asked else ''}{key} = {_toml(value)}"


def _remarks(sample: Sample, law: str) -> Iterator[str]:
    yield "# Columns of the file:"
    for info in sample.infos[:LISTED]:
        hint = f", the file says {info.hint!r}" if info.hint else ""
        yield f"#   {_toml(info.name)}: {info.dtype}, {info.rows} rows, {', '.join(info.first)[:80]}{hint}"
    if len(sample.infos) > LISTED:
        yield f"#   and {len(sample.infos) - LISTED} more"
    yield from (f"# Not read: {text}" for text in sample.refused)
    if attributes := sample.contents.attributes:
        yield "# Values beside the table, which [attributes] may take conditions from:"
        yield from (f"#   {_toml(key)}: {_toml(str(value)[:80])}" for key, value in list(attributes.items())[:LISTED])
    yield "# Conditions that differ from file to file may come from name_pattern, [attributes], [condition_columns] or"
    yield "# [[file]]. A log of motion without wall and step has no stiffness, damping and step."
    if law:
        yield "# The command obeys a wall law in the columns below, which tells them, the step and the signs (but for"
        yield f"# the direction that counts as positive): {law} in SI, if the units are right."


def _fill(draft: _Draft, path: Path, others: Sequence[Path]) -> str:
    """Tell what a sample shows: columns, the law that the command obeys, conditions in the name; return the law."""
    sample = draft.sample
    likely, by_position = _roles(sample), not sample.layout.keys.get("header", True)
    speed = _quantity(likely["position"], "position") in _SPEEDS
    seen = None if by_position or speed else _seen(sample, likely)
    likely, units = (seen.columns, seen.units) if seen else (likely, {})
    for role, info in likely.items():
        name = int(info.name) if by_position and info.name.isdecimal() else info.name
        draft.tell(f"columns.{role}.name", name, seen is not None)
        stated, quantity = _bare(info, role)[1], _quantity(info, role)
        allowed = {quantity} if role == "position" and speed else {*QUANTITIES[role].values()}
        known = [symbol for symbol, unit in UNITS.items() if unit.quantity in allowed]
        said = f"the file says {stated!r}; is it right? " if stated else "the file does not say it. "
        counts = " For counts give counts_per_unit, too." if role == "position" else ""
        proposed = units.get(role) or [stated if quantity in allowed else known[0]]
        sure = role == "time" and len(units.get(role, ())) == 1
        draft.tell(f"columns.{role}.unit", proposed[0], sure, f"{said}One of {', '.join(known)}.{counts}")
    integrated, said = ("difference", f"{likely['position'].name!r} is ") if speed else (None, "")
    draft.tell("columns.position.integrate", integrated, False, said)
    wall = _wall_in_name(Path(sample.name).stem)
    groups = {key: float(value) for key, value in (find_groups(wall, sample.name) or {}).items()} if wall else {}
    if wall:
        draft.tell("name_pattern", wall, bool(others and seen and all(find_groups(wall, o.name) for o in others)))
    told = _by_law(draft, seen, groups) if seen else ""
    if seen:
        draft.tell("constants.experiment", path.absolute().parent.name or "1")
    draft.values |= dict.fromkeys(f"constants.{key}" for key in groups)  # what the name gives is no constant
    return told


class _Seen(NamedTuple):
    """The wall law that the command of a log obeys, its columns by role, and the units in which they are plausible.

    ``first_row`` says whether the command is at its step from the first row on.
    """

    law: Law
    columns: dict[str, ColumnInfo]
    units: dict[str, list[str]]
    period_s: float
    first_row: bool


def _by_law(draft: _Draft, seen: _Seen, groups: dict[str, float]) -> str:
    """Tell what the law of the command shows, and return it in words."""
    length, unit = UNITS[seen.units["position"][0]], UNITS[seen.units["command"][0]].factor
    gains = {
        key: float(f"{abs(getattr(seen.law, key)) * unit / length.factor:.4g}") for key in ("stiffness", "damping")
    }
    step = float(f"{seen.law.step * unit:.4g}")
    draft.tell("step_at", "first row" if seen.first_row else "command edge")
    draft.tell("columns.command.sign", 1)
    draft.tell("columns.position.sign", -1 if seen.law.stiffness < 0 else 1)
    draft.tell("constants.step", step)
    draft.tell("constants.sampling_period_s", float(f"{seen.period_s:.9g}"), len(seen.units["time"]) == 1)
    motion: Motion = "rotation" if length.quantity == "angle" else "translation"
    draft.tell("constants.motion", motion)  # another one is refused with the unit of the position
    for key, value in gains.items():
        draft.tell(f"constants.{key}", value, False)
        factor = value / abs(groups[key]) if groups.get(key) else 1.0
        base = si_unit(CONDITION_QUANTITIES[key][motion])
        if abs(factor - 1) > SAME and (stated := unit_between(base, factor, SAME)):
            # the command obeys the number in the file name in this unit
            draft.tell(f"units.{key}", "N/mm" if stated == "kN/m" else stated)
    return ", ".join(f"{key} {abs(value):.4g}" for key, value in {**gains, "step": step}.items())


def _seen(sample: Sample, likely: dict[str, ColumnInfo]) -> _Seen | None:
    """Return what the numbers of a log show; None where no columns obey a wall law with a stiffness."""
    time, own = likely["time"], (likely["command"], likely["position"])
    pairs = permutations([info for info in sample.numbers[:MOST_TRIED] if info is not time], 2)
    for pair in sorted(pairs, key=lambda pair: pair != own):
        columns = dict(zip(_ROLES, (time, *pair), strict=True))
        if not (values := sample.columns([*columns.values()])):
            return None
        stamps, force, place = values
        spans = float(np.median(np.diff(stamps))), float(np.ptp(force)), float(np.ptp(place))
        units = {role: _plausible(role, info, span) for (role, info), span in zip(columns.items(), spans, strict=True)}
        counters = [column for column in (force, place) if (np.diff(column) > 0).all()]
        if all(units.values()) and not counters:
            factor = UNITS[units["time"][0]].factor
            law = law_of(stamps * factor, force, place)
            if law is not None and law.stiffness and law.step:
                return _Seen(law, columns, units, spans[0] * factor, bool(abs(force[0]) > abs(law.step) / 2))
    return None


def _plausible(role: str, info: ColumnInfo, span: float) -> list[str]:
    """Return the units in which the numbers of a column are those of a device; the stated one alone where it is."""
    _, units, low, high = _ROLES[role]
    fits = [unit for unit in units if low <= span * UNITS[unit].factor <= high]
    stated = _bare(info, role)[1].translate(str.maketrans("µμ", "uu"))
    return [stated] if stated in fits else fits


def _roles(sample: Sample) -> dict[str, ColumnInfo]:
    """Return for each role a column that is likely by its name; a clock rises in every row."""
    likely: dict[str, ColumnInfo] = {}
    for role, (names, *_) in _ROLES.items():
        left = [info for info in sample.numbers if info not in likely.values()]
        good = [info for info in left if re.fullmatch(names, _bare(info, role)[0])]
        if role == "time" and not good:
            columns = zip(left, sample.columns(left[:LISTED]), strict=False)
            good = [info for info, values in columns if (np.diff(values) > 0).all()]
        likely[role] = next(iter((*good, *left)), sample.numbers[0])
    return likely


def _bare(info: ColumnInfo, role: str) -> tuple[str, str]:
    """Return the last part of a name without its unit, and the unit that the file states there or in its hint."""
    name, unit = unit_in_heading(info.name, [*QUANTITIES[role].values(), *(_SPEEDS if role == "position" else ())])
    return re.split(r"[./]", name)[-1].strip().lower(), unit or info.hint


def _quantity(info: ColumnInfo, role: str) -> str:
    """Return the quantity of the unit that the file states for a column; empty where it states none."""
    return getattr(find_unit(_bare(info, role)[1]), "quantity", "")


def _files(name: str) -> str:
    """Return the pattern of the names of a file and of those beside it, which differ in their numbers."""
    suffix = "".join(Path(name).suffixes[-2 if name.lower().endswith((".gz", ".zst")) else -1 :])
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
    dash = "-" if len(found) > 1 and all(minus for *_, minus in found) else ""
    return ".*".join(f"{k}{sign}{dash}(?P<{groups[k.upper()]}>-?[0-9]+[.]?[0-9]*)" for k, sign, _ in found)


def _toml(value: object) -> str:
    return json.dumps(value, ensure_ascii=False)
