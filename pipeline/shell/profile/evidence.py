"""Profile keys that sample logs prove, with the evidence, and questions about other keys.

The wall law of a command identifies columns, signs, the step, and the units of stiffness and damping in file names. A
free motion identifies the column that moves. Time stamps show their unit and the sampling period. Headings and unit
lines state units. Other keys become questions if a wrong value would change results silently.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import permutations
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipeline.base.units import DRIVES, UNITS, find_unit, unit_between
from pipeline.base.wording import counted
from pipeline.measured.signal.release import find_release
from pipeline.profiles.profile_model import (
    QUANTITIES,
    Excitation,
    Kind,
    conditions_in_name,
    find_groups,
    number_in_name,
    quantity,
    si_unit,
)
from pipeline.readers.gain_check import WallGains, wall_gains
from pipeline.readers.mapping import changes_of, is_staircase
from pipeline.readers.sample import SPEEDS, Sample
from pipeline.readers.sheets import NAMES
from pipeline.recording.motion import free_response
from pipeline.records.native import OF_WALL
from pipeline.records.trials import Floats, Trial
from pipeline.shell.profile.columns import MOST_SAMPLES, round_period, spread
from pipeline.shell.profile.conditions import SAME, numbers_inside, place_of, proved_unit
from pipeline.shell.profile.roles import (
    MOST_TRIED,
    ROLES,
    Answer,
    Answers,
    free_samples,
    likely_roles,
    named_roles,
    plausible_units,
    rate_of,
    stated_unit,
)

ROUND = 5e-3
"""Largest relative deviation of an identified gain from the round number that replaces it."""


_NAMED_WALL = re.compile(r"(?<![A-Za-z])([KB])([_=]?)(-?)\d+[.,]?\d*", re.IGNORECASE)
"""Pattern of stiffness or damping in a file name."""


class WallLaw(NamedTuple):
    """The wall law that the command of a log follows, its columns by role, and their plausible units.

    ``first_row`` is True if the step occurs before the first row. ``kind`` is the excitation of the device.
    """

    law: WallGains
    columns: dict[str, str]
    units: dict[str, list[str]]
    first_row: bool
    kind: Excitation

    @property
    def motion(self) -> Kind:
        """Motion of the device, given by the unit of its position."""
        return "rotation" if UNITS[self.units["position"][0]].quantity == "angle" else "translation"

    def followed(self, key: str) -> float:
        """Return a gain that the command follows [SI]. The sign of the position axis does not affect K and B."""
        value = self.in_si[key]
        return value if key == "step" else abs(value)

    @property
    def in_si(self) -> dict[str, float]:
        """Stiffness, damping and step [SI], assuming that the proposed units are right."""
        length, force = (UNITS[self.units[role][0]].factor for role in ("position", "command"))
        factors = {"stiffness": force / length, "damping": force / length, "step": force}
        return {key: near_round(getattr(self.law, key) * factor) for key, factor in factors.items()}


def near_round(value: float) -> float:
    """Return the nearest round number if it is close to the value, otherwise the value to four digits.

    >>> near_round(1200.3), near_round(7.96), near_round(0.12345678), near_round(0)
    (1200.0, 7.96, 0.1235, 0.0)
    """
    for digits in (1, 2, 3):
        rounded = float(f"{value:.{digits}g}")
        if value and abs(rounded / value - 1) <= ROUND * 10 ** (1 - digits):
            return rounded
    return float(f"{value:.4g}")


def answers(samples: Sequence[Sample], paths: Sequence[Path]) -> Answers:
    """Return the profile keys that samples of one form prove, and questions about the other keys, in order.

    Parameters
    ----------
    samples : sequence of Sample
        Samples with the same layout. The first one is described.
    paths : sequence of Path
        Files of the samples and further files, whose names may contain conditions.
    """
    sample = samples[0]
    laws = common_laws(samples)
    law = laws[0] if laws else None
    columns = _columns(sample, law, len(laws))
    names = _names(sample, paths)
    inside = _inside(samples, laws, names)
    walls = _walls(samples, law, laws, names | inside)
    walls = inside | {place: each for place, each in walls.items() if place.split(".")[-1] not in _keys(inside)}
    found: Answers = {}
    if (kind := _kind_answer(samples, laws, columns, names)) is not None:
        found["kind"] = kind
    elif "constants.step" in walls or any(key.startswith(_WALLS_GIVEN) for key in (*walls, *names)):
        at_once = bool(laws) and all(each.first_row for each in laws)
        evidence = "the step is already commanded in the first row" if at_once else "the command jumps at the step"
        found["step_at"] = Answer("first row" if at_once else "command edge", evidence)
    found |= names | columns | _constants(sample, columns) | walls
    return dict(sorted(found.items(), key=lambda item: _ORDER.index(item[0].partition(".")[0])))


_WALLS_GIVEN = ("units", "name_pattern", "attributes.st", "attributes.damping", "condition_columns")
"""Prefixes of the keys with which a profile states walls."""


def _keys(answers: Answers) -> set[str]:
    return {place.split(".")[-1] for place in answers}


def _inside(samples: Sequence[Sample], laws: Sequence[WallLaw], names: Answers) -> Answers:
    """Return the places in the files that state stiffness, damping and step, with the units that the commands prove."""
    known = {tuple(law.columns.values()) for law in laws}
    pairs = [(each, law) for each in trials_of(samples)[:MOST_SAMPLES] if (law := wall_law(each)) is not None]
    pairs = [(each, law) for each, law in pairs if tuple(law.columns.values()) in known]
    if not pairs:
        return {}
    pattern = str(names["name_pattern"].value) if names else ""
    inside = numbers_inside([each.contents for each, _ in pairs])
    first = pairs[0][1]
    found: Answers = {}
    for key in OF_WALL:
        if f"<{key}>" in pattern or (key == "step" and first.kind != "step"):
            continue
        followed = [law.followed(key) for _, law in pairs]
        place = place_of({at: each for at, each in inside.items() if at[1] not in _values(found)}, followed, NAMES[key])
        if place is None:
            continue
        # These gains are in SI only if the units of the columns are known.
        columns = ("command",) if key == "step" else ("command", "position")
        sure = all(len(first.units[role]) == 1 for role in columns)
        unit = proved_unit(inside[place], followed, key, first.motion) if sure else None
        evidence = f"its numbers agree with {counted(len(pairs), 'command')}"
        found[f"{place[0]}.{key}"] = Answer(place[1], evidence + ("" if unit else ", except for a factor"))
        if unit is not None and unit != si_unit(quantity(key, first.motion)):
            found[f"units.{key}"] = Answer(unit, evidence)
    return found


def _values(answers: Answers) -> set[str]:
    return {str(answer.value) for answer in answers.values()}


_SHOWN = {
    "release": "the device leaves a position other than 0, and from then on the command follows a wall at 0",
    "hit": "the device is hit, and the command follows the wall both before and after the hit",
}
"""Evidence that there is no step."""


def _kind_answer(samples: Sequence[Sample], laws: Sequence[WallLaw], columns: Answers, names: Answers) -> Answer | None:
    """Return the excitation of the samples with the evidence, or None if the excitation is a step."""
    kinds = Counter(law.kind for law in laws).most_common(1)
    if kinds:
        return Answer(kinds[0][0], _SHOWN[kinds[0][0]]) if kinds[0][0] in _SHOWN else None
    command, position = (columns.get(f"columns.{role}.name") for role in ("command", "position"))
    if names or command is None or position is None or command.question or position.question:
        return None
    forces = [each.numbers.get(str(command.value)) for each in samples]
    if all(force is not None and is_staircase(force) for force in forces):
        count = max(len(changes_of(force)) for force in forces if force is not None)
        return Answer("staircase", f"no wall law was found, and the command has at most {counted(count, 'step')}")
    return Answer("free", "no wall law was found in the command")


def trials_of(samples: Sequence[Sample]) -> list[Sample]:
    """Return one sample for each trial. From a file with many trials, only a selection is returned."""
    found: list[Sample] = []
    for each in samples:
        some = spread(each.trials, MOST_SAMPLES)
        found += [each._replace(contents=trial, trials=()) for trial in some] if some else [each]
    return found


def common_laws(samples: Sequence[Sample]) -> list[WallLaw]:
    """Return the wall laws of the samples whose columns are those of the majority.

    Without damping, command and position are interchangeable in the law.
    """
    laws = [law for each in trials_of(samples)[:MOST_SAMPLES] if (law := wall_law(each)) is not None]
    counts = Counter(tuple(law.columns.values()) for law in laws)
    if not counts:
        return []
    columns, count = counts.most_common(1)[0]
    alike = [law for law in laws if tuple(law.columns.values()) == columns] if 2 * count > len(laws) else []
    against = 2 * sum(law.law.stiffness < 0 for law in alike) > len(alike)
    # Laws with the usual direction come first.
    return sorted(alike, key=lambda law: (law.law.stiffness < 0) != against)


_ORDER = ("kind", "step_at", "name_pattern", "columns", "attributes", "condition_columns", "constants", "units")
"""Tables and top-level keys of a profile, in their order."""


def wall_law(sample: Sample) -> WallLaw | None:
    """Return the wall law of a log, or None if no columns follow a law with a stiffness."""
    likely, numbers = likely_roles(sample), sample.numbers
    time, own = likely["time"], (likely["command"], likely["position"])
    tried = [name for name in list(numbers)[:MOST_TRIED] if name != time]
    for pair in sorted(permutations(tried, 2), key=lambda pair: pair != own):
        columns = dict(zip(ROLES, (time, *pair), strict=True))
        stamps, force, place = (numbers[name] for name in columns.values())
        if not len(stamps) == len(force) == len(place):
            continue
        spans = float(np.median(np.diff(stamps))), float(np.ptp(force)), float(np.ptp(place))
        units = {role: plausible_units(sample, role, name, spans[i]) for i, (role, name) in enumerate(columns.items())}
        counters = [column for column in (force, place) if (np.diff(column) > 0).all()]
        if not all(units.values()) or counters:
            continue
        factor = UNITS[units["time"][0]].factor
        law = wall_gains(stamps * factor, force, place)
        # A column that is a multiple of another column follows a law without damping and step.
        sure = law is not None and (law.step or (law.stiffness * law.damping > 0 and (len(tried) == 2 or pair == own)))
        kind = _kind_of(law, stamps * factor, force, place) if law is not None and law.stiffness and sure else None
        if law is not None and kind is not None:
            at_once = bool(abs(force[0]) > abs(law.step) / 2)
            return WallLaw(law, columns, units, at_once, kind)
    return None


def _kind_of(law: WallGains, time: Floats, command: Floats, position: Floats) -> Excitation | None:
    """Return the excitation of a device whose command follows a wall law, or None if no excitation is visible.

    A release from a position looks like a step whose size is the wall force at that position. The motion is treated as
    a release if this implies a wall at position 0, which is unlikely for a step.
    """
    way = float(np.sign(law.stiffness))
    wall = (abs(law.stiffness), way * law.damping, 0.0, float(np.median(np.diff(time))))
    found = find_release(Trial("sample", *wall, time, command, way * position)).kind
    if not law.step:
        return found or None
    at_zero = abs(law.step + law.stiffness * position[0]) <= SAME * abs(law.step)
    return "release" if at_zero and found == "release" else "step"


def _columns(sample: Sample, law: WallLaw | None, laws: int) -> Answers:
    """Return the keys of the columns."""
    if law is not None:
        evidence = f"the command of {_logs(laws)} follows a wall law in these columns"
        names = {role: Answer(name, evidence) for role, name in law.columns.items()}
    else:
        names = named_roles(sample)
    found: Answers = {}
    by_position = not sample.layout.keys.get("header", True)
    for role, answer in names.items():
        place = f"columns.{role}"
        if answer.value is None:  # there are no time stamps
            found[f"{place}.kind"] = Answer("sampled", answer.evidence)
            continue
        name = str(answer.value)
        column = int(name) if by_position and name.isdecimal() else name
        found[f"{place}.name"] = Answer(column, answer.evidence, answer.question)
        unit = _unit(sample, role, name, law, found)
        others = {stated_unit(sample, role, column) for column in sample.numbers} - {""}
        if answer.question and len(others) > 1 and not unit.question:
            unit = Answer(unit.value, question=f"the file states {unit.value!r} for {name!r}. Is this right?")
        found[f"{place}.unit"] = unit
        if role == "position" and getattr(find_unit(str(unit.value)), "quantity", "") in SPEEDS:
            words = (
                f'{name!r} is a velocity. Is it computed from differences of the position ("difference"), or is it an '
                'instantaneous velocity, for example of a tachometer ("trapezoid")?'
            )
            found[f"{place}.integrate"] = Answer("difference", question=words)
        if role != "time":
            found[f"{place}.sign"] = _sign(sample, role, names, law)
    return found


def _logs(count: int) -> str:
    return "the log" if count == 1 else f"{count} logs"


def _unit(sample: Sample, role: str, name: str, law: WallLaw | None, found: Answers) -> Answer:
    """Return the unit of a column, from the file or from its numbers, otherwise the question.

    ``found`` contains the answers for the preceding columns. A position moved by a torque is an angle.
    """
    stated = stated_unit(sample, role, name)
    if stated:
        return Answer(stated, f"the file states {stated!r}")
    units = list(law.units[role]) if law else list(ROLES[role].units)
    if role == "time":
        if law is None:
            pace = float(np.median(np.diff(sample.numbers[name])))
            units = plausible_units(sample, role, name, pace)
        if len(units) == 1:
            return Answer(units[0], "only this unit gives a plausible sampling period")
        if (shown := _unit_by_rate(sample, name)) is not None and shown.value in units:
            return shown
        return Answer(
            (units or ["s"])[0], question=f"the file does not state the unit. One of {', '.join(units or ['s', 'ms'])}."
        )
    if role == "position" and (unit := _unit_of_file(sample)) is not None:
        return unit
    quantities = {*QUANTITIES[role].values(), *(DRIVES if role == "command" else ())}
    if role == "position" and (of_command := found.get("columns.command.unit")) is not None:
        of_force = dict(zip(QUANTITIES["command"].values(), QUANTITIES["position"].values(), strict=True))
        moved = of_force.get(getattr(find_unit(str(of_command.value)), "quantity", ""))
        if moved is not None and not of_command.question:
            quantities = {moved}
    known = [symbol for symbol, unit in UNITS.items() if unit.quantity in quantities and symbol != "count"]
    more = " For counts, also set counts_per_unit." * (role == "position")
    heading = sample.unit(name, role)[1]
    why = f"the file states {heading!r}, which is not a known unit" if heading else "the file does not state the unit"
    return Answer(
        next((unit for unit in units if unit in known), known[0]),
        question=f"{why}. One of {', '.join(known)}.{more}",
    )


def _unit_by_rate(sample: Sample, time: str) -> Answer | None:
    """Return the unit of the time stamps for which the integral of a velocity is its position, because velocities are
    per second."""
    for place in list(sample.numbers)[:MOST_TRIED]:
        found = rate_of(sample, time, place)
        if found is None:
            continue
        unit = next(symbol for symbol in ROLES["time"].units if UNITS[symbol].factor == found[1])
        return Answer(unit, f"{found[0]!r} is the velocity of {place!r}, if the time stamps are in {unit}")
    return None


def _unit_of_file(sample: Sample) -> Answer | None:
    """Return the unit of positions that the file states as ``units``, or None if there is none."""
    for name, value in sample.contents.attributes.items():
        unit = find_unit(str(value)) if re.split(r"[./@]", name)[-1].lower() in ("unit", "units") else None
        if unit is not None and unit.quantity in QUANTITIES["position"].values():
            return Answer(str(value), f"{name!r} in the file is {value!r}")
    return None


def _sign(sample: Sample, role: str, names: dict[str, Answer], law: WallLaw | None) -> Answer:
    """Return the sign of a column. The sign is 1, except for a position that decreases under a positive command."""
    if role == "command":
        return Answer(1, "the direction of the command is positive by definition")
    if law is not None:
        against = law.law.stiffness < 0
        return Answer(
            -1 if against else 1, "the command pushes towards smaller numbers" if against else "by the wall law"
        )
    columns = [sample.numbers.get(str(answer.value)) for answer in names.values()]
    if all(column is not None for column in columns) and len({len(c) for c in columns if c is not None}) == 1:
        time, command, position = (column for column in columns if column is not None)
        pace = float(np.median(np.diff(time)))
        with suppress(ValueError, ArithmeticError, np.linalg.LinAlgError):
            found = free_response(free_samples(time, command, position, pace)) if pace > 0 else None
            if found is not None and found.is_driven:
                against = found.gain < 0
                return Answer(
                    -1 if against else 1, f"the position accelerates {'against' if against else 'with'} the command"
                )
    return Answer(1, "a check refuses this sign if the motion shows the opposite sign")


def _names(sample: Sample, paths: Sequence[Path]) -> Answers:
    """Return the pattern of conditions in the file names."""
    wall = _wall_in_name(Path(sample.name).stem)
    alike = (path.name for path in paths if path.suffix == Path(sample.name).suffix)
    if not wall or not all(find_groups(wall, name) for name in alike):
        return {}
    return {"name_pattern": Answer(wall, f"as in {sample.name}")}


def _constants(sample: Sample, columns: Answers) -> Answers:
    """Return the device name, the experiment name and the sampling period."""
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
    evidence = "the time between rows" + (", if the unit of the stamps is right" if unit.question else "")
    return found | {place: Answer(round_period(pace), evidence)}


def _stated_period(sample: Sample) -> Answers:
    """Return the sampling period of a file without time stamps, from a value outside the table, otherwise the
    question."""
    place = "constants.sampling_period_s"
    stated: dict[str, set[float]] = {}
    for name, value in sample.contents.attributes.items():
        word = re.split(r"[./@]", name)[-1].lower()
        number = value if isinstance(value, int | float) else 0.0
        if word in _PERIODS and ROLES["time"].low <= number <= 1.0:
            stated.setdefault(word, set()).add(number)
            found = Answer(name, f"{number:g} s, as the file states")
            if word != "wf_increment":
                return {"attributes.sampling_period_s": found}
        if word.endswith("hz") and 1.0 <= number <= 1 / ROLES["time"].low:
            return {place: Answer(float(f"{1 / number:.9g}"), f"{name!r} is {number:g} Hz")}
    if len(periods := stated.get("wf_increment", ())) == 1:
        return {place: Answer(min(periods), "the time between the samples of each channel, as the file states")}
    return {place: Answer(0.001, question="sampling period T of the controller [s]?")}


_PERIODS = (
    "ts",
    "dt",
    "sample_time",
    "sampletime",
    "sampling_period",
    "sampling_period_s",
    "sampling_time",
    "wf_increment",
)
"""Names under which files store the sampling period outside the table."""


def _walls(samples: Sequence[Sample], law: WallLaw | None, laws: Sequence[WallLaw], names: Answers) -> Answers:
    """Return stiffness, damping and step, or only their units if the values are in the file names."""
    pattern = str(names["name_pattern"].value) if "name_pattern" in names else ""
    in_names = [_numbers_in_name(pattern, each) if pattern else {} for each in samples[: len(laws) or 1]]
    named = in_names[0]
    if law is None:
        return dict(_wall_questions(named)) if named else {}
    drive = UNITS[law.units["command"][0]].quantity in DRIVES
    found: Answers = {}
    evidence = "by the wall law of the command"
    for key in OF_WALL:
        mine = [each.followed(key) for each in laws]
        same = max(mine) - min(mine) <= SAME * max(map(abs, mine), default=0.0)
        if key == "step" and law.kind != "step":
            continue
        if key in named:
            # The unit is chosen so that the command follows the number in the file name.
            pairs = ((value, abs(numbers[key])) for value, numbers in zip(mine, in_names, strict=False))
            ratio = next((value / number for value, number in pairs if value and number), None)
            if ratio is None or drive:
                continue
            si = si_unit(quantity(key, law.motion))
            unit = si if abs(ratio - 1) <= SAME else unit_between(si, ratio, SAME)
            if unit is None and not (law.units["command"][1:] or law.units["position"][1:]):
                units = [symbol for symbol, known in UNITS.items() if known.quantity == quantity(key, law.motion)]
                words = f"what is the unit of the {key} in the file names? One of {', '.join(units)}."
                found[f"units.{key}"] = Answer(si, question=words)
            elif unit is not None:
                found[f"units.{key}"] = Answer("N/mm" if unit == "kN/m" else unit, evidence)
        elif same or len(laws) < 2:
            of_all = f"{evidence}, in {_logs(len(laws))}" if len(laws) > 1 else f"{evidence}; other logs may differ"
            found[f"constants.{key}"] = Answer(mine[0], of_all)
    return found


def _wall_questions(named: dict[str, float]) -> Iterator[tuple[str, Answer]]:
    """Yield questions about walls whose stiffness is in the file names if no command follows a wall law."""
    for key in named:
        units = [symbol for symbol, unit in UNITS.items() if unit.quantity == key]
        words = f"what is the unit of the {key} in the file names? One of {', '.join(units)}, or Nm/rad, Nms/rad."
        yield f"units.{key}", Answer(units[0], question=words)
    if "damping" not in named:
        yield "constants.damping", Answer(0, question="virtual damping B of the wall [Ns/m, Nms/rad]?")
    yield "constants.step", Answer(0, question="size of the external step [N, Nm] (0 if none was commanded)?")


def _numbers_in_name(pattern: str, sample: Sample) -> dict[str, float]:
    """Return the numbers that a pattern reads from the name of a sample. An unreadable number is 0."""
    numbers = dict.fromkeys(find_groups(pattern, sample.name) or (), 0.0)
    decimal = str(sample.layout.keys.get("decimal", "."))
    with suppress(ValueError):
        texts = conditions_in_name(pattern, sample.name) or {}
        numbers |= {key: number_in_name(text, decimal) for key, text in texts.items()}
    return numbers


def _wall_in_name(stem: str) -> str:
    """Return the pattern of a name that contains the stiffness once, and the damping at most once, otherwise an empty
    text."""
    found = [match.groups() for match in _NAMED_WALL.finditer(stem)]
    letters = [letter.upper() for letter, *_ in found]
    if "K" not in letters or len(set(letters)) < len(letters):
        return ""
    groups = {"K": "stiffness", "B": "damping"}
    # A dash after both letters is a separator. After only one letter, it is a minus sign.
    dash = "-" if len(found) > 1 and all(minus for *_, minus in found) else ""
    return ".*".join(f"{k}{sign}{dash}(?P<{groups[k.upper()]}>-?[0-9]+[.,]?[0-9]*)" for k, sign, _ in found)
