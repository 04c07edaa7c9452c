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
from contextlib import suppress
from itertools import permutations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pipeline.base.errors import LogError, ProfileError
from pipeline.base.units import UNITS, find_unit, unit_between
from pipeline.profiles.profile_files import QUESTION
from pipeline.profiles.profile_model import (
    QUANTITIES,
    conditions_in_name,
    find_groups,
    number_in_name,
    quantity,
    si_unit,
)
from pipeline.readers.obeyed import Law, law_of
from pipeline.records.models import Motion
from pipeline.shell.profile.samples import SPEEDS, Sample, open_sample

Keys = dict[str, tuple[Any, str]]
"""Value and question of keys; the question is empty where the value is known, the value None where there is none."""

KEYS: Keys = {
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
_NAMED_WALL = re.compile(r"(?<![A-Za-z])([KB])([_=]?)(-?)\d+[.,]?\d*", re.IGNORECASE)
"""Stiffness or damping in the name of a file."""


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
        {"format": s.kind, **s.layout.keys, **s.layout.questions, "columns": [*s.contents.columns]}
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
    law, table = _law(sample), ""
    keys = KEYS | _of_columns(sample, law) | _of_names(path, others, law)
    keys |= _of_law(law, keys, sample) if law else {}
    for place, (value, question) in keys.items():
        above, _, key = place.rpartition(".")
        if value is None:
            continue
        if above != table:
            yield from (*(() if table else _remarks(sample, law)), f"[{above}]")
            table = above
        key = "column" if isinstance(value, int) and key == "name" else key
        if question:
            yield f"{QUESTION} {f'{above}.{key}' if above else key}: {question}"
        yield f"{'# ' if question else ''}{key} = {_toml(value)}"


def _remarks(sample: Sample, law: _Law | None) -> Iterator[str]:
    contents = sample.contents
    yield "# Columns of the file:"
    for name, values in list(contents.columns.items())[:LISTED]:
        said = contents.units.get(name) or contents.hints.get(name)
        hint = f", the file says {said!r}" if said else ""
        yield f"#   {_toml(name)}: {len(values)} rows, {', '.join(map(str, values[:3]))[:80]}{hint}"
    if len(contents.columns) > LISTED:
        yield f"#   and {len(contents.columns) - LISTED} more"
    yield from (f"# Not read: {key} {reason}" for key, reason in contents.refused.items())
    if attributes := contents.attributes:
        yield "# Values beside the table, which [attributes] may take conditions from:"
        yield from (f"#   {_toml(key)}: {_toml(str(value)[:80])}" for key, value in list(attributes.items())[:LISTED])
    yield "# Conditions that differ from file to file may come from name_pattern, [attributes], [condition_columns] or"
    yield "# [[file]]. A log of motion without wall and step has no stiffness, damping and step."
    if law:
        told = ", ".join(f"{key} {abs(value):.4g}" for key, value in law.in_si.items())
        yield "# The command obeys a wall law in the columns below, which tells them, the step and the signs (but for"
        yield f"# the direction that counts as positive): {told} in SI, if the units are right."


class _Law(NamedTuple):
    """The wall law that the command of a log obeys, its columns by role, and the units in which they are plausible.

    ``first_row`` says whether the command is at its step from the first row on.
    """

    law: Law
    columns: dict[str, str]
    units: dict[str, list[str]]
    period_s: float
    first_row: bool

    @property
    def in_si(self) -> dict[str, float]:
        """Stiffness, damping and step, if the units that are proposed are right."""
        length, force = (UNITS[self.units[role][0]].factor for role in ("position", "command"))
        factors = {"stiffness": force / length, "damping": force / length, "step": force}
        return {key: float(f"{getattr(self.law, key) * factor:.4g}") for key, factor in factors.items()}


def _law(sample: Sample) -> _Law | None:
    """Return what the numbers of a log show; None where no columns obey a wall law with a stiffness."""
    likely, numbers = _roles(sample), sample.numbers
    time, own = likely["time"], (likely["command"], likely["position"])
    pairs = permutations([name for name in list(numbers)[:MOST_TRIED] if name != time], 2)
    for pair in sorted(pairs, key=lambda pair: pair != own):
        columns = dict(zip(_ROLES, (time, *pair), strict=True))
        stamps, force, place = (numbers[name] for name in columns.values())
        if not len(stamps) == len(force) == len(place):
            continue
        spans = float(np.median(np.diff(stamps))), float(np.ptp(force)), float(np.ptp(place))
        units = {role: _plausible(sample, role, name, spans[i]) for i, (role, name) in enumerate(columns.items())}
        counters = [column for column in (force, place) if (np.diff(column) > 0).all()]
        if all(units.values()) and not counters:
            factor = UNITS[units["time"][0]].factor
            law = law_of(stamps * factor, force, place)
            if law is not None and law.stiffness and law.step:
                return _Law(law, columns, units, spans[0] * factor, bool(abs(force[0]) > abs(law.step) / 2))
    return None


def _plausible(sample: Sample, role: str, name: str, span: float) -> list[str]:
    """Return the units in which the numbers of a column are those of a device; the stated one alone where it is."""
    _, units, low, high = _ROLES[role]
    fits = [unit for unit in units if low <= span * UNITS[unit].factor <= high]
    stated = sample.unit(name, role)[1].translate(str.maketrans("µμ", "uu"))
    return [stated] if stated in fits else fits


def _roles(sample: Sample) -> dict[str, str]:
    """Return for each role a column that is likely by its name; a clock rises in every row."""
    likely, numbers = dict[str, str](), sample.numbers
    for role, (names, *_) in _ROLES.items():
        left = [name for name in numbers if name not in likely.values()]
        good = [name for name in left if re.fullmatch(names, sample.unit(name, role)[0])]
        if role == "time" and not good:
            good = [name for name in left[:LISTED] if (np.diff(numbers[name]) > 0).all()]
        likely[role] = next(iter((*good, *left, *numbers)))
    return likely


def _of_columns(sample: Sample, law: _Law | None) -> Keys:
    """Return the keys of the columns: what the law tells, else what their names suggest, and what the file says."""
    keys, by_position = Keys(), not sample.layout.keys.get("header", True)
    for role, name in (law.columns if law else _roles(sample)).items():
        stated = sample.unit(name, role)[1]
        quantity = getattr(find_unit(stated), "quantity", "")
        speed = role == "position" and quantity in SPEEDS
        allowed = {quantity} if speed else {*QUANTITIES[role].values()}
        known = [symbol for symbol, unit in UNITS.items() if unit.quantity in allowed]
        units = law.units[role] if law else [stated if quantity in allowed else known[0]]
        said = f"the file says {stated!r}; is it right? " if stated else "the file does not say it. "
        said += f"One of {', '.join(known)}." + " For counts give counts_per_unit, too." * (role == "position")
        place = f"columns.{role}"
        column = int(name) if by_position and name.isdecimal() else name
        keys[f"{place}.name"] = column, "" if law else KEYS[f"{place}.name"][1]
        keys[f"{place}.unit"] = units[0], "" if law and role == "time" and len(units) == 1 else said
        if speed:
            keys[f"{place}.integrate"] = "difference", f"{name!r} is {KEYS[f'{place}.integrate'][1]}"
    return keys


def _of_names(path: Path, others: Sequence[Path], law: _Law | None) -> Keys:
    """Return the keys that the names of files and of their folder tell; what a name gives is no constant."""
    wall, keys = _wall_in_name(path.stem), Keys()
    if law:
        keys["constants.experiment"] = path.absolute().parent.name or "1", ""
    if wall:
        sure = others and law and all(find_groups(wall, other.name) for other in others)
        keys["name_pattern"] = wall, "" if sure else KEYS["name_pattern"][1]
        keys |= {f"constants.{key}": (None, "") for key in find_groups(wall, path.name) or ()}
    return keys


def _of_law(law: _Law, keys: Keys, sample: Sample) -> Keys:
    """Return the keys that the law of the command tells."""
    motion: Motion = "rotation" if UNITS[law.units["position"][0]].quantity == "angle" else "translation"
    found: Keys = {
        "step_at": ("first row" if law.first_row else "command edge", ""),
        "columns.command.sign": (1, ""),
        "columns.position.sign": (-1 if law.law.stiffness < 0 else 1, ""),
        "constants.motion": (motion, ""),  # another one is refused with the unit of the position
        "constants.step": (law.in_si["step"], ""),
    }
    sure = len(law.units["time"]) == 1
    found["constants.sampling_period_s"] = (
        float(f"{law.period_s:.9g}"),
        "" if sure else KEYS["constants.sampling_period_s"][1],
    )
    named = _numbers_in_name(keys["name_pattern"][0] or "", sample)
    for key in ("stiffness", "damping"):
        value = abs(law.in_si[key])
        if key not in named:
            found[f"constants.{key}"] = value, KEYS[f"constants.{key}"][1]
        elif value and named[key]:
            # the command obeys the number in the file name in this unit
            unit = unit_between(si_unit(quantity(key, motion)), value / abs(named[key]), SAME)
            found |= {f"units.{key}": ("N/mm" if unit == "kN/m" else unit, "")} if unit else {}
    return found


def _numbers_in_name(pattern: str, sample: Sample) -> dict[str, float]:
    """Return the numbers that a pattern takes from the name of a sample; 0 for one that cannot be read."""
    numbers = dict.fromkeys(find_groups(pattern, sample.name) or (), 0.0)
    decimal = str(sample.layout.keys.get("decimal", "."))
    with suppress(ValueError):
        texts = conditions_in_name(pattern, sample.name) or {}
        numbers |= {key: number_in_name(text, decimal) for key, text in texts.items()}
    return numbers


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
    return ".*".join(f"{k}{sign}{dash}(?P<{groups[k.upper()]}>-?[0-9]+[.,]?[0-9]*)" for k, sign, _ in found)


def _toml(value: object) -> str:
    return json.dumps(value, ensure_ascii=False)
