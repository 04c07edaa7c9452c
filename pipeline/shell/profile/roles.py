"""Identification of the time, command and position columns of a log from names, stated units, and the motion.

If several columns are possible, a question lists the candidates.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import permutations
from typing import Any, NamedTuple

import numpy as np

from pipeline.base.units import DRIVES, UNITS, find_unit
from pipeline.profiles.profile_model import QUANTITIES
from pipeline.readers.sample import SPEEDS, Sample
from pipeline.recording.motion import free_response
from pipeline.recording.samples import Samples
from pipeline.records.trials import Floats

MOST_TRIED = 8
"""Largest number of numeric columns tried as command and position."""

CLEARLY = 3.0
"""Factor by which the selected pair of columns must explain the motion better than any other pair."""

SAME_PERIOD = 0.02
"""Relative tolerance between sampling periods of logs, and of equivalent clocks in a log. Clocks drift by less."""

REGULAR = 0.02
"""Largest relative scatter of the steps of a clock, if other columns also increase in every row."""

IS_RATE = 0.05
"""Largest residual of a motion after subtraction of the integrated velocity, relative to the motion.

This value allows for short logs and filtered velocities.
"""


@dataclass(frozen=True)
class Answer:
    """Value of a profile key with its evidence, or an open question with a proposed value."""

    value: Any
    evidence: str = ""
    question: str = ""


Answers = dict[str, Answer]


class Role(NamedTuple):
    """Usual column names of a role, units in order of proposal, and the plausible range [SI] of the sampling period, or
    of the span of the command or position.
    """

    names: str
    units: tuple[str, ...]
    low: float
    high: float


_SPEED_NAMES = r"v|vel.*|speed|omega|dx|dq|geschwindigkeit"

ROLES = {
    "time": Role(r"t|time|times?tamps?|stamp|zeit|zeitstempel|tout|@stamp|@time", ("s", "ms", "us", "ns"), 2e-5, 0.1),
    "command": Role(
        r"command|f|u|tau|m|kraft|moment|force|torque|((f|u|force|tau|torque)[ _-]?)?(cmd|soll|des(ired)?|command)",
        ("N", "mN", "Nm", "mNm"),
        1e-3,
        1e4,
    ),
    "position": Role(
        rf"pos.*|weg|lage|winkel|angle|x|q|s|phi|theta|x[ _-]?(ist|act|meas)|{_SPEED_NAMES}",
        ("m", "mm", "um", "rad", "deg"),
        1e-6,
        0.8,
    ),
}
_WORDS = {
    "command": r"force|torque|kraft|moment|command|cmd|soll|tau|voltage|spannung|current|strom|effort|actions?",
    "position": r"position|pos|angle|winkel|weg|lage|place|displacement|encoder|velocity|speed|geschwindigkeit",
}
"""Words in column names that indicate a role. These words are used if no full name matches."""

_QUESTIONS = {
    "time": 'which column has the time stamps (if there is none: kind = "sampled")?',
    "command": "which column has the total force or torque that the controller commands?",
    "position": "which column has the position that the controller measures?",
}


def stated_unit(sample: Sample, role: str, name: str) -> str:
    """Return the unit that the file states for a column if the unit fits the role, otherwise an empty text."""
    stated = sample.unit(name, role)[1].translate(str.maketrans("µμ", "uu"))
    unit = find_unit(stated)
    allowed = {*QUANTITIES[role].values(), *(SPEEDS if role == "position" else DRIVES if role == "command" else ())}
    return stated if unit is not None and unit.quantity in allowed else ""


def plausible_units(sample: Sample, role: str, name: str, span: float) -> list[str]:
    """Return the units in which the numbers of a column are plausible. If a stated unit is plausible, it is the only
    result."""
    _, units, low, high = ROLES[role]
    fits = [unit for unit in units if low <= span * UNITS[unit].factor <= high]
    stated = stated_unit(sample, role, name)
    symbol = next((symbol for symbol in UNITS if stated and find_unit(symbol) == find_unit(stated)), "")
    if role != "time" and symbol and UNITS[symbol].quantity not in SPEEDS:
        return [symbol]
    return [stated] if stated in fits else fits


def likely_roles(sample: Sample) -> dict[str, str]:
    """Return the likely column of each role, chosen by name. Without a matching name, the clock is a column that
    increases in every row."""
    likely, numbers = dict[str, str](), sample.numbers
    for role in ROLES:
        left = [name for name in numbers if name not in likely.values()]
        good = _named(sample, role, left)
        if role == "time" and not good:
            good = [name for name in left[:MOST_TRIED] if (np.diff(numbers[name]) > 0).all()]
        likely[role] = next(iter((*good, *left, *numbers)))
    return likely


def _named(sample: Sample, role: str, names: Iterable[str]) -> list[str]:
    """Return the columns whose full name is a usual name of a role."""
    return [name for name in names if re.fullmatch(ROLES[role].names, sample.unit(name, role)[0])]


def named_roles(sample: Sample) -> dict[str, Answer]:
    """Return the column of each role if no wall law is found, identified by name or by the motion, otherwise the
    question."""
    numbers, times = sample.numbers, sample.contents.units
    rising = [name for name in numbers if (np.diff(numbers[name]) > 0).all()]
    time = _clock(sample, rising)
    # A column that increases by equal steps is a counter. A column whose data type is a time has time stamps.
    moving = [name for name in numbers if name != time.value and np.ptp(numbers[name]) > 0 and name not in times]
    others = [name for name in moving if name not in rising or np.ptp(np.diff(numbers[name])) > 0]
    others = [name for name in others if name not in _named(sample, "time", others)]
    constant = _constant_command(sample, str(time.value), [name for name in numbers if name not in moving])
    others = _without_rates(sample, str(time.value), others, 1 if constant else 2)
    if constant is not None and len(others) == 1:
        evidence = f"{others[0]!r} is the only other column that changes, apart from its rate"
        return {"time": time, "command": constant, "position": Answer(others[0], evidence)}
    if constant is not None and not _named(sample, "command", [str(constant.value)]):
        constant = None  # without a matching name, it may be a condition, because several other columns change
    pair, evidence = _followed(sample, str(time.value), others), "the motion {1!r} follows the command {0!r}"
    if pair is None:
        pair, evidence = _changed_first(sample, others), "{0!r} has few values and changes before {1!r} moves"
    if pair is not None:
        evidence = evidence.format(*pair)
        return {"time": time, "command": Answer(pair[0], evidence), "position": Answer(pair[1], evidence)}
    return {"time": time} | _by_names(sample, time, others, constant)


def _by_names(sample: Sample, time: Answer, others: Sequence[str], constant: Answer | None) -> dict[str, Answer]:
    """Return command and position, identified by stated units and names, or questions if several columns remain."""
    named: dict[str, list[str]] = {}
    for role, words in _WORDS.items():
        by_unit = [name for name in others if _has_unit_of(sample, role, name)]
        by_word = [name for name in others if _has_word(sample.title(name).lower(), words)]
        whole = _named(sample, role, others)
        if role == "position":  # a velocity may replace a missing position
            whole = [name for name in whole if not _is_speed(sample, name)] or whole
        named[role] = by_unit or whole or by_word
    sure = {role: names[0] for role, names in named.items() if len(names) == 1}
    if len(set(sure.values())) < len(sure):
        sure = {}
    found: dict[str, Answer] = {} if constant is None else {"command": constant}
    for role in _WORDS:
        left = [name for name in others if name not in sure.values()]
        if role in found:
            continue
        if role in sure:
            kind = "unit" if _has_unit_of(sample, role, sure[role]) else "name"
            found[role] = Answer(sure[role], f"only this column has a matching {kind}")
        elif sure and len(left) == 1:
            found[role] = Answer(left[0], "the only other column that changes")
        else:
            taken = [time.value, *sure.values()]
            order = [name for name in (*named[role], *left, *sample.numbers) if name not in taken]
            found[role] = _role_question(role, order or list(sample.numbers))
            # Two questions must not propose the same column.
            if role == "position" and found["command"].question and found["command"].value == found[role].value:
                rest = [name for name in order if name != found["command"].value]
                found[role] = _role_question(role, rest or order or list(sample.numbers))
    return found


def _has_word(title: str, words: str) -> bool:
    """Return True if a heading contains one of the words, and no word for a switch or a limit."""
    return all(
        (re.search(rf"(?<![a-z])({each})(?![a-z])", title) is not None) == wanted
        for each, wanted in ((words, True), (r"enabled?|limits?|modes?|status|flags?|supply", False))
    )


def _is_speed(sample: Sample, name: str) -> bool:
    return re.fullmatch(_SPEED_NAMES, sample.unit(name, "position")[0]) is not None


def _has_unit_of(sample: Sample, role: str, name: str) -> bool:
    """Return True if the file states a unit of a role outside the column name. For a position, velocity units are
    ignored.

    A suffix after an underscore is ignored, because it may be part of the name, such as the V of a supply voltage.
    """
    unit = find_unit(stated_unit(sample, role, name))
    apart = sample.title(name).rstrip().endswith(("]", ")")) or name in sample.contents.hints
    return unit is not None and unit.quantity not in SPEEDS and apart


def _constant_command(sample: Sample, time: str, still: Sequence[str]) -> Answer | None:
    """Return a command that is constant from the first row onward, identified by its name or by other trials of the
    file."""
    constant = [name for name in still if name != time and sample.numbers[name][0] and not np.ptp(sample.numbers[name])]
    differing = [name for name in constant if len(set(values_of_trials(sample, name))) > 1]
    if len(differing) == 1:
        return Answer(differing[0], "constant in each trial of the file, and different between trials")
    named = _named(sample, "command", constant)
    if len(named) == 1 and not _named(sample, "command", set(sample.numbers) - set(named)):
        return Answer(named[0], "only this column has a matching name; the step is already commanded in the first row")
    return None


def values_of_trials(sample: Sample, name: str) -> list[float]:
    """Return the value of a column in each trial of a file. The list is empty if the column changes within a trial."""
    columns = [trial.columns[name] for trial in sample.trials if name in trial.columns]
    changes = [column for column in columns if column.dtype.kind == "U" or np.ptp(column)]
    return [] if changes else [float(column[0]) for column in columns]


def rate_of(sample: Sample, time: str, place: str) -> tuple[str, float] | None:
    """Return the column that is the rate of another column, and the implied unit of time in seconds. Return None if
    there is no rate.

    A velocity is the change of its position per second. Therefore, the factor between the integral of the velocity over
    the stamps and the position is the unit of the stamps. A rate is returned only if this factor belongs to a known
    unit.
    """
    numbers = sample.numbers
    for name in numbers:
        columns = [numbers.get(key) for key in (time, place, name)]
        if name in (time, place) or any(column is None or len(column) < 4 for column in columns):
            continue
        stamps, motion, speed = (column for column in columns if column is not None)
        if not len(stamps) == len(motion) == len(speed) or not np.ptp(speed) or not np.ptp(motion):
            continue
        integral = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(stamps))])
        moved = motion - motion[0]
        if not integral @ integral:
            continue
        factor = float(integral @ moved / (integral @ integral))
        left = float(np.sqrt(np.mean((moved - factor * integral) ** 2)))
        units = (UNITS[unit].factor for unit in ROLES["time"].units)
        seconds = next((unit for unit in units if abs(factor / unit - 1) <= IS_RATE), None)
        if seconds is not None and left <= IS_RATE * float(np.ptp(moved)):
            return name, seconds
    return None


def _without_rates(sample: Sample, time: str, names: list[str], fewest: int) -> list[str]:
    """Return the columns that are not the rate of another column. At least `fewest` columns are kept."""
    rates: list[str] = []
    for name in names[:MOST_TRIED] if len(names) > fewest else ():
        found = rate_of(sample, time, name) if name not in rates else None
        if found is not None and found[0] in names and found[0] not in _named(sample, "command", names):
            rates.append(found[0])
    left = [name for name in names if name not in rates]
    return left if len(left) >= fewest else names


def _clock(sample: Sample, rising: Sequence[str]) -> Answer:
    """Return the time column.

    This is the only column that increases in every row, or the most regular of several consistent clocks.
    """
    numbers = sample.numbers
    fitting = _named(sample, "time", numbers)
    clocks = [name for name in fitting if name in rising] or list(rising)
    if not clocks and not fitting:
        return Answer(None, "no column increases in every row, so there are no time stamps")
    if len(clocks) == 1:
        more = ", and its name fits" if clocks[0] in fitting else ", unlike all other columns"
        return Answer(clocks[0], f"increases in every row{more}")
    uneven = {name: float(np.std(np.diff(numbers[name])) / np.mean(np.diff(numbers[name]))) for name in clocks}
    factors = [getattr(find_unit(stated_unit(sample, "time", name)), "factor", 0.0) for name in clocks]
    paces = [float(np.median(np.diff(numbers[name]))) * factor for name, factor in zip(clocks, factors, strict=True)]
    if clocks and min(paces) > 0 and max(paces) <= (1 + SAME_PERIOD) * min(paces):
        regular = min(clocks, key=lambda name: uneven[name])
        return Answer(
            regular, f"increases in every row, and is the most regular of the consistent clocks {', '.join(clocks)}"
        )
    regular = min(clocks, key=lambda name: uneven[name], default="")
    others = [uneven[name] for name in clocks if name != regular]
    if others and uneven[regular] <= REGULAR < min(others) / CLEARLY:
        return Answer(regular, "increases in every row by equal steps, unlike all other columns")
    return _role_question("time", clocks or fitting or list(numbers))


def _role_question(role: str, names: Sequence[str]) -> Answer:
    """Return the question about which column has a role, with the candidates."""
    candidates = list(dict.fromkeys(names))
    listing = f" Candidates: {', '.join(candidates[:MOST_TRIED])}." if len(candidates) > 1 else ""
    return Answer(candidates[0], question=f"{_QUESTIONS[role]}{listing}")


def _followed(sample: Sample, time: str, names: Sequence[str]) -> tuple[str, str] | None:
    """Return command and position if one pair of columns explains the motion clearly better than all other pairs."""
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
            found = free_response(free_samples(stamps, numbers[command], numbers[position], pace))
            if found is not None and found.is_driven and found.delay >= 0:
                scores[command, position] = found.residual_undriven / max(found.residual, 1e-300)
    ranked = sorted(scores, key=lambda pair: -scores[pair])
    if not ranked or (len(ranked) > 1 and scores[ranked[0]] < CLEARLY * scores[ranked[1]]):
        return None
    return ranked[0]


def _changed_first(sample: Sample, names: Sequence[str]) -> tuple[str, str] | None:
    """Return command and position if one of two columns has few values and changes before the other one moves."""
    columns = [sample.numbers[name] for name in names]
    if len(columns) != 2 or len(columns[0]) != len(columns[1]):
        return None
    units = {sample.unit(name, "position")[1] for name in names}
    begins = [int(np.argmax(column != column[0])) for column in columns]
    values = [len(np.unique(column)) for column in columns]
    if len(units) == 1 and units != {""}:  # a set-point in the unit of the position is not a command
        return None
    for at, other in ((0, 1), (1, 0)):
        # A noisy reading may return to its previous value before the device moves.
        stays = (columns[at][begins[at] : begins[other] + 1] != columns[at][0]).all()
        if begins[at] < begins[other] and stays and values[at] <= values[other]:
            return names[at], names[other]
    return None


def free_samples(stamps: Floats, command: Floats, position: Floats, pace: float) -> Samples:
    """Return the rows of a motion without a wall, in any units."""
    return Samples(stamps, command, position, pace, 0.0, 0.0, 0.0, None)
