"""What sample logs prove of themselves, key by key of a profile, with the evidence; and what has to be asked.

The wall law of a command tells its columns, signs, step, and the units of stiffness and damping in file names; a free
motion tells which column it follows; stamps tell their unit and the sampling period; headings and unit lines state
units. What remains changes numbers silently, and is asked.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pipeline.base.units import DRIVES, UNITS, find_unit, unit_between
from pipeline.profiles.profile_model import (
    QUANTITIES,
    Kind,
    conditions_in_name,
    find_groups,
    number_in_name,
    quantity,
    si_unit,
)
from pipeline.readers.obeyed import Law, law_of
from pipeline.recording.motion import free_response
from pipeline.recording.samples import Samples
from pipeline.shell.profile.columns import round_period
from pipeline.shell.profile.samples import SPEEDS, Sample

MOST_TRIED = 8
"""Columns of numbers that are tried as command and position."""

SAME = 0.1
"""Part by which a number may differ from what the command obeys: names are rounded."""

CLEARLY = 3.0
"""Factor by which one pair of columns must explain the motion better than all others to be taken."""

ROUND = 5e-3
"""Part by which a number that the command obeys may differ from a round one that is taken for it."""

FEWER = 1.5
"""Factor by which a command has fewer values than the motion that follows it."""

AGREE = 0.02
"""Part by which the sampling periods of two clocks may differ that are one."""

MOST_LAWS = 12
"""Samples whose wall law is looked for."""


@dataclass(frozen=True)
class Answer:
    """Value of a key of a profile, and what shows it; or the question that has to be answered, with a proposal."""

    value: Any
    evidence: str = ""
    question: str = ""


Answers = dict[str, Answer]


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
_WORDS = {
    "command": r"force|torque|kraft|moment|command|cmd|soll|tau|voltage|spannung|current|strom|effort|actions?",
    "position": r"position|pos|angle|winkel|weg|lage|place|displacement|encoder|velocity|speed|geschwindigkeit",
}
"""Words in the names of columns that belong to a role, where no name is one by itself."""

_ASKED = {
    "time": 'which column holds the time stamps (without any: kind = "sampled")?',
    "command": "which column holds the total force or torque that the controller commands?",
    "position": "which column holds the position that the controller measures?",
}
_NAMED_WALL = re.compile(r"(?<![A-Za-z])([KB])([_=]?)(-?)\d+[.,]?\d*", re.IGNORECASE)
"""Stiffness or damping in the name of a file."""


class WallLaw(NamedTuple):
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
        return {key: near_round(getattr(self.law, key) * factor) for key, factor in factors.items()}


def near_round(value: float) -> float:
    """Return the round number that a value stands for, where one is near; else four digits of it.

    >>> near_round(1200.3), near_round(7.96), near_round(0.12345678), near_round(0)
    (1200.0, 7.96, 0.1235, 0.0)
    """
    for digits in (1, 2, 3):
        rounded = float(f"{value:.{digits}g}")
        if value and abs(rounded / value - 1) <= ROUND * 10 ** (1 - digits):
            return rounded
    return float(f"{value:.4g}")


def answers(samples: Sequence[Sample], paths: Sequence[Path]) -> Answers:
    """Return the keys of a profile that samples of one form show, and those that have to be asked, in their order.

    Parameters
    ----------
    samples : sequence of Sample
        Of one layout; the first is described.
    paths : sequence of Path
        Their files, and those of others, whose names may hold conditions.
    """
    sample = samples[0]
    laws = common_laws(samples)
    law = laws[0] if laws else None
    columns = _columns(sample, law, len(laws))
    names = _names(sample, paths, law)
    walls = _walls(samples, law, laws, names)
    found: Answers = {}
    if "constants.step" in walls or any(key.startswith(("file", "units", "name_pattern")) for key in (*walls, *names)):
        at_once = bool(laws) and all(each.first_row for each in laws)
        told = "the command is at its step in the first row" if at_once else "the step is where the command jumps"
        found["step_at"] = Answer("first row" if at_once else "command edge", told)
    found |= names | columns | _constants(sample, columns, law) | walls
    return dict(sorted(found.items(), key=lambda item: _ORDER.index(item[0].partition(".")[0])))


def common_laws(samples: Sequence[Sample]) -> list[WallLaw]:
    """Return the wall laws of samples in the columns that most of them have: of a wall without damping, command and
    position obey each other's law."""
    laws = [law for each in samples[:MOST_LAWS] if (law := wall_law(each)) is not None]
    counts = Counter(tuple(law.columns.values()) for law in laws)
    if not counts:
        return []
    columns, count = counts.most_common(1)[0]
    alike = [law for law in laws if tuple(law.columns.values()) == columns] if 2 * count > len(laws) else []
    against = 2 * sum(law.law.stiffness < 0 for law in alike) > len(alike)
    # those of the usual direction first
    return sorted(alike, key=lambda law: (law.law.stiffness < 0) != against)


_ORDER = ("step_at", "name_pattern", "columns", "attributes", "constants", "units")
"""Tables in their order."""


def wall_law(sample: Sample) -> WallLaw | None:
    """Return what the numbers of a log show; None where no columns obey a wall law with a stiffness."""
    likely, numbers = _likely(sample), sample.numbers
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
                return WallLaw(law, columns, units, spans[0] * factor, bool(abs(force[0]) > abs(law.step) / 2))
    return None


def _stated(sample: Sample, role: str, name: str) -> str:
    """Return the unit that the file states for a column, where it is one of its role; else an empty text."""
    said = sample.unit(name, role)[1].translate(str.maketrans("µμ", "uu"))
    unit = find_unit(said)
    allowed = {*QUANTITIES[role].values(), *(SPEEDS if role == "position" else DRIVES if role == "command" else ())}
    return said if unit is not None and unit.quantity in allowed else ""


def _plausible(sample: Sample, role: str, name: str, span: float) -> list[str]:
    """Return the units in which the numbers of a column are those of a device; the stated one alone where it is one."""
    _, units, low, high = _ROLES[role]
    fits = [unit for unit in units if low <= span * UNITS[unit].factor <= high]
    stated = _stated(sample, role, name)
    symbol = next((symbol for symbol in UNITS if stated and find_unit(symbol) == find_unit(stated)), "")
    if role != "time" and symbol and UNITS[symbol].quantity not in SPEEDS:
        return [symbol]
    return [stated] if stated in fits else fits


def _likely(sample: Sample) -> dict[str, str]:
    """Return for each role a column that is likely by its name; a clock rises in every row."""
    likely, numbers = dict[str, str](), sample.numbers
    for role, (names, *_) in _ROLES.items():
        left = [name for name in numbers if name not in likely.values()]
        good = [name for name in left if re.fullmatch(names, sample.unit(name, role)[0])]
        if role == "time" and not good:
            good = [name for name in left[:MOST_TRIED] if (np.diff(numbers[name]) > 0).all()]
        likely[role] = next(iter((*good, *left, *numbers)))
    return likely


def _columns(sample: Sample, law: WallLaw | None, laws: int) -> Answers:
    """Return the keys of the columns."""
    if law is not None:
        told = f"the command of {_logs(laws)} obeys a wall law in these columns"
        names = {role: Answer(name, told) for role, name in law.columns.items()}
    else:
        names = _named_roles(sample)
    found: Answers = {}
    by_position = not sample.layout.keys.get("header", True)
    for role, answer in names.items():
        place = f"columns.{role}"
        if answer.value is None:  # no stamps
            found[f"{place}.kind"] = Answer("sampled", answer.evidence)
            continue
        name = str(answer.value)
        column = int(name) if by_position and name.isdecimal() else name
        found[f"{place}.name"] = Answer(column, answer.evidence, answer.question)
        unit = _unit(sample, role, name, law)
        found[f"{place}.unit"] = unit
        if role == "position" and getattr(find_unit(str(unit.value)), "quantity", "") in SPEEDS:
            words = f'{name!r} is a velocity: is the position its integral by differences, or by "trapezoid"?'
            found[f"{place}.integrate"] = Answer("difference", question=words)
        if role != "time":
            found[f"{place}.sign"] = _sign(sample, role, names, law)
    return found


def _logs(count: int) -> str:
    return "the log" if count == 1 else f"{count} logs"


def _named_roles(sample: Sample) -> dict[str, Answer]:
    """Return the column of each role without a wall law: what its name or the motion shows, else the question."""
    numbers, times = sample.numbers, sample.contents.units
    rising = [name for name in numbers if (np.diff(numbers[name]) > 0).all()]
    time = _clock(sample, rising)
    # what rises in every row by equal steps is a counter, what has a unit of time by its type a stamp
    moving = [name for name in numbers if name != time.value and np.ptp(numbers[name]) > 0 and name not in times]
    others = [name for name in moving if name not in rising or np.ptp(np.diff(numbers[name])) > 0]
    others = [name for name in others if not re.fullmatch(_ROLES["time"].names, sample.unit(name, "time")[0])]
    pair, told = _followed(sample, str(time.value), others), "{1!r} moves as {0!r} commands"
    if pair is None:
        pair, told = _changed_first(sample, others), "{0!r} has few values and changes first, then {1!r} moves"
    if pair is not None:
        told = told.format(*pair)
        return {"time": time, "command": Answer(pair[0], told), "position": Answer(pair[1], told)}
    named: dict[str, list[str]] = {}
    for role, words in _WORDS.items():
        whole = [name for name in others if re.fullmatch(_ROLES[role].names, sample.unit(name, role)[0])]
        by_word = [name for name in others if re.search(rf"(?<![a-z])({words})(?![a-z])", name.lower())]
        named[role] = whole or by_word
    sure = {role: names[0] for role, names in named.items() if len(names) == 1}
    if len(set(sure.values())) < len(sure):
        sure = {}
    found = {"time": time}
    for role in _WORDS:
        left = [name for name in others if name not in sure.values()]
        if role in sure:
            found[role] = Answer(sure[role], "by its name, which no other column has")
        elif sure and len(left) == 1:
            found[role] = Answer(left[0], "the only other column that changes")
        else:
            taken = [time.value, *sure.values()]
            order = [name for name in (*named[role], *left, *numbers) if name not in taken]
            found[role] = _asked(role, order or list(numbers))
            # two questions with one proposal would be one answer too many
            if role == "position" and found["command"].question and found["command"].value == found[role].value:
                rest = [name for name in order if name != found["command"].value]
                found[role] = _asked(role, rest or order or list(numbers))
    return found


def _clock(sample: Sample, rising: Sequence[str]) -> Answer:
    """Return the column of time: the only one that rises in every row, or the most regular of clocks that agree."""
    numbers = sample.numbers
    fitting = [name for name in numbers if re.fullmatch(_ROLES["time"].names, sample.unit(name, "time")[0])]
    clocks = [name for name in fitting if name in rising] or list(rising)
    if not clocks and not fitting:
        return Answer(None, "no column rises in every row: there are no stamps")
    if len(clocks) == 1:
        more = ", as its name says" if clocks[0] in fitting else ", as no other column"
        return Answer(clocks[0], f"rises in every row{more}")
    factors = [getattr(find_unit(_stated(sample, "time", name)), "factor", 0.0) for name in clocks]
    paces = [float(np.median(np.diff(numbers[name]))) * factor for name, factor in zip(clocks, factors, strict=True)]
    if clocks and min(paces) > 0 and max(paces) <= (1 + AGREE) * min(paces):
        regular = min(clocks, key=lambda name: float(np.std(np.diff(numbers[name])) / np.mean(np.diff(numbers[name]))))
        return Answer(regular, f"rises in every row, the most regular of {', '.join(clocks)}, which agree")
    return _asked("time", clocks or fitting or list(numbers))


def _asked(role: str, names: Sequence[str]) -> Answer:
    """Return the question which column has a role, with the candidates."""
    candidates = list(dict.fromkeys(names))
    listing = f" Candidates: {', '.join(candidates[:MOST_TRIED])}." if len(candidates) > 1 else ""
    return Answer(candidates[0], question=f"{_ASKED[role]}{listing}")


def _followed(sample: Sample, time: str, names: Sequence[str]) -> tuple[str, str] | None:
    """Return the command and the position that follows it, where one pair explains the motion clearly best."""
    numbers = sample.numbers
    stamps = numbers.get(time)
    if stamps is None or len(names) > MOST_TRIED:
        return None
    pace = float(np.median(np.diff(stamps)))
    scores: dict[tuple[str, str], float] = {}
    for command, position in permutations(names, 2):
        if len({len(stamps), len(numbers[command]), len(numbers[position])}) != 1 or pace <= 0:
            continue
        with suppress(ValueError, ArithmeticError, np.linalg.LinAlgError):
            found = free_response(_free(stamps, numbers[command], numbers[position], pace))
            if found is not None and found.is_driven and found.delay >= 0:
                scores[command, position] = found.residual_undriven / max(found.residual, 1e-300)
    ranked = sorted(scores, key=lambda pair: -scores[pair])
    if not ranked or (len(ranked) > 1 and scores[ranked[0]] < CLEARLY * scores[ranked[1]]):
        return None
    return ranked[0]


def _changed_first(sample: Sample, names: Sequence[str]) -> tuple[str, str] | None:
    """Return command and position of two columns, where one has few values and changes before the other moves."""
    columns = [sample.numbers[name] for name in names]
    if len(columns) != 2 or len(columns[0]) != len(columns[1]):
        return None
    units = {sample.unit(name, "position")[1] for name in names}
    begins = [int(np.argmax(column != column[0])) for column in columns]
    values = [len(np.unique(column)) for column in columns]
    if len(units) == 1 and units != {""}:  # a set-point has the unit of its position
        return None
    for at, other in ((0, 1), (1, 0)):
        if begins[at] < begins[other] and FEWER * values[at] <= values[other]:
            return names[at], names[other]
    return None


def _free(stamps: Any, command: Any, position: Any, pace: float) -> Samples:
    return Samples(stamps, command, position, pace, 0.0, 0.0, 0.0, None)


def _unit(sample: Sample, role: str, name: str, law: WallLaw | None) -> Answer:
    """Return the unit of a column: as the file states it, or as its numbers prove; else the question."""
    stated = _stated(sample, role, name)
    if stated:
        return Answer(stated, f"the file says {stated!r}")
    units = list(law.units[role]) if law else list(_ROLES[role].units)
    if role == "time":
        if law is None:
            pace = float(np.median(np.diff(sample.numbers[name])))
            units = _plausible(sample, role, name, pace)
        if len(units) == 1:
            return Answer(units[0], "no device has another sampling period than this makes")
        return Answer(
            (units or ["s"])[0], question=f"the file does not say it. One of {', '.join(units or ['s', 'ms'])}."
        )
    quantities = {*QUANTITIES[role].values(), *(DRIVES if role == "command" else ())}
    known = [symbol for symbol, unit in UNITS.items() if unit.quantity in quantities and symbol != "count"]
    more = " For counts give counts_per_unit, too." * (role == "position")
    return Answer(units[0], question=f"the file does not say it. One of {', '.join(known)}.{more}")


def _sign(sample: Sample, role: str, names: dict[str, Answer], law: WallLaw | None) -> Answer:
    """Return the sign of a column: 1 but for a position that falls where the command pushes."""
    if role == "command":
        return Answer(1, "the direction of the command counts as positive")
    if law is not None:
        against = law.law.stiffness < 0
        return Answer(
            -1 if against else 1, "its numbers fall where the command pushes" if against else "by the wall law"
        )
    columns = [sample.numbers.get(str(answer.value)) for answer in names.values()]
    if all(column is not None for column in columns) and len({len(c) for c in columns if c is not None}) == 1:
        time, command, position = (column for column in columns if column is not None)
        pace = float(np.median(np.diff(time)))
        with suppress(ValueError, ArithmeticError, np.linalg.LinAlgError):
            found = free_response(_free(time, command, position, pace)) if pace > 0 else None
            if found is not None and found.is_driven:
                against = found.gain < 0
                return Answer(-1 if against else 1, f"it accelerates {'against' if against else 'with'} the command")
    return Answer(1, "a check refuses it where the motion shows the other one")


def _names(sample: Sample, paths: Sequence[Path], law: WallLaw | None) -> Answers:
    """Return the pattern of conditions in the names of files."""
    wall = _wall_in_name(Path(sample.name).stem)
    alike = (path.name for path in paths if path.suffix == Path(sample.name).suffix)
    if not wall or not all(find_groups(wall, name) for name in alike):
        return {}
    return {"name_pattern": Answer(wall, f"as in {sample.name}")}


def _constants(sample: Sample, columns: Answers, law: WallLaw | None) -> Answers:
    """Return names and sampling period."""
    found = {"constants.device": Answer("bench", "any name"), "constants.experiment": Answer("1", "any name")}
    place = "constants.sampling_period_s"
    unit = columns.get("columns.time.unit")
    if unit is None:
        return found | _stated_period(sample)
    stamps = sample.numbers.get(str(columns["columns.time.name"].value))
    factor = getattr(find_unit(str(unit.value)), "factor", 1.0)
    pace = float(np.median(np.diff(stamps))) * factor if stamps is not None else 0.0
    if pace <= 0:
        return found | {place: Answer(0.001, question="sampling period T of the controller [s]?")}
    told = "the time between rows" + (", if the unit of the stamps is right" if unit.question else "")
    return found | {place: Answer(round_period(pace), told)}


def _stated_period(sample: Sample) -> Answers:
    """Return the sampling period of a file without stamps: a value beside the table; else the question."""
    place = "constants.sampling_period_s"
    for name, value in sample.contents.attributes.items():
        word = re.split(r"[./]", name)[-1].lower()
        number = value if isinstance(value, int | float) else 0.0
        if word in _PERIODS and _ROLES["time"].low <= number <= 1.0:
            return {"attributes.sampling_period_s": Answer(name, f"{number:g} s, as the file states")}
        if word.endswith("hz") and 1.0 <= number <= 1 / _ROLES["time"].low:
            return {place: Answer(float(f"{1 / number:.9g}"), f"{name!r} is {number:g} Hz")}
    return {place: Answer(0.001, question="sampling period T of the controller [s]?")}


_PERIODS = ("ts", "dt", "sample_time", "sampletime", "sampling_period", "sampling_period_s", "sampling_time")
"""Names of a value beside a table that is its sampling period."""


def _walls(samples: Sequence[Sample], law: WallLaw | None, laws: Sequence[WallLaw], names: Answers) -> Answers:
    """Return stiffness, damping and step, or their units where the names of files have them."""
    pattern = str(names["name_pattern"].value) if names else ""
    in_names = [_numbers_in_name(pattern, each) if pattern else {} for each in samples[: len(laws) or 1]]
    named = in_names[0]
    if law is None:
        return dict(_asked_walls(named)) if named else {}
    kind: Kind = "rotation" if UNITS[law.units["position"][0]].quantity == "angle" else "translation"
    drive = UNITS[law.units["command"][0]].quantity in DRIVES
    found: Answers = {}
    told = "by the wall law of the command"
    values = [each.in_si for each in laws]
    for key in ("stiffness", "damping", "step"):
        mine = [value[key] if key == "step" else abs(value[key]) for value in values]
        same = max(mine) - min(mine) <= SAME * max(map(abs, mine), default=0.0)
        if key in named:
            # the command obeys the number in the file name in this unit
            pairs = ((value, abs(numbers[key])) for value, numbers in zip(mine, in_names, strict=False))
            ratio = next((value / number for value, number in pairs if value and number), None)
            if ratio is None or drive:
                continue
            si = si_unit(quantity(key, kind))
            unit = si if abs(ratio - 1) <= SAME else unit_between(si, ratio, SAME)
            if unit is None and not (law.units["command"][1:] or law.units["position"][1:]):
                units = [symbol for symbol, known in UNITS.items() if known.quantity == quantity(key, kind)]
                words = f"in which unit is the {key} in the file names? One of {', '.join(units)}."
                found[f"units.{key}"] = Answer(si, question=words)
            elif unit is not None:
                found[f"units.{key}"] = Answer("N/mm" if unit == "kN/m" else unit, told)
        elif same or len(laws) < 2:
            found[f"constants.{key}"] = Answer(mine[0], told if len(laws) == 1 else f"{told}, in {_logs(len(laws))}")
    return found


def _asked_walls(named: dict[str, float]) -> Iterator[tuple[str, Answer]]:
    """Yield what has to be asked of walls whose stiffness the names hold, and whose law no command shows."""
    for key in named:
        units = [symbol for symbol, unit in UNITS.items() if unit.quantity == key]
        words = (
            f"in which unit is the {key} in the file names? One of {', '.join(units)}; of a rotation Nm/rad, Nms/rad."
        )
        yield f"units.{key}", Answer(units[0], question=words)
    if "damping" not in named:
        yield "constants.damping", Answer(0, question="virtual damping B of the wall [Ns/m, Nms/rad]?")
    yield "constants.step", Answer(0, question="size of the external step [N, Nm]; 0 where none was commanded?")


def _numbers_in_name(pattern: str, sample: Sample) -> dict[str, float]:
    """Return the numbers that a pattern takes from the name of a sample; 0 for one that cannot be read."""
    numbers = dict.fromkeys(find_groups(pattern, sample.name) or (), 0.0)
    decimal = str(sample.layout.keys.get("decimal", "."))
    with suppress(ValueError):
        texts = conditions_in_name(pattern, sample.name) or {}
        numbers |= {key: number_in_name(text, decimal) for key, text in texts.items()}
    return numbers


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
