"""Header of a native log: conditions of a step response as `# key: value` lines above the columns.

    # device: lwr
    # experiment: delay-2
    # stiffness: 3200 [Nm/rad]
    ...
    time_s,command,position

All values are in SI. A remark in square brackets may follow a value. A remark that begins with a unit other than SI
(`[N/mm]`) is refused, because the value would be wrong by this factor.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import cast, get_args

from pipeline.base.errors import LogError, ParameterError
from pipeline.base.units import find_unit
from pipeline.device.parameters import unit_of
from pipeline.records.findings import Grip, Motion

COLUMN_LINE = "time_s,command,position"
LONGEST_NAME = 200
"""Longest device or experiment name in characters, as in `findings.Name`."""

_REQUIRED = {
    "device": "the name of the device, such as lwr",
    "experiment": "the name of the experiment, such as delay-2",
    "stiffness": "the virtual stiffness K in N/m (Nm/rad for a rotational device)",
    "damping": "the virtual damping B in Ns/m (Nms/rad for a rotational device)",
    "step": "the size of the external force step in N (Nm for a rotational device), 0 if none was commanded",
    "sampling_period_s": "the sampling period T in s",
}
OF_WALL = ("stiffness", "damping", "step")
"""Conditions of a trial at a wall. A log without a wall and a step omits all of these conditions. They are then 0, and
the trial has no response to judge. The cause of the motion follows from the command.
"""

NOT_STATED = "not stated"
"""Value of ``wall`` in the extra keys of a header that omits all of `OF_WALL`."""

_OPTIONAL = ("added_delay_samples", "grip", "motion")
# These patterns match a run of blanks in only one way. Patterns that match it in several ways would take minutes for a
# line of 10^4 blanks.
_KEY_LINE = re.compile(r"#\s*([A-Za-z_][\w\s.\-/]*):\s*(.*)")
_NOTE_BEHIND_TEXT = re.compile(r"(?:^|\s)\[.*$")
_OPTIONAL_NOTE = re.compile(r"(?<!\s)\s{2,}optional\b.*$")


@dataclass(frozen=True)
class NativeHeader:
    """Conditions of a step response, as stated in a native log.

    Parameters
    ----------
    device, experiment : str
    stiffness : float
        Virtual stiffness K [N/m, Nm/rad].
    damping : float
        Virtual damping B [Ns/m, Nms/rad].
    step : float
        External force step F_0 [N, Nm]. A step of 0 means that none was commanded, and the trial has no response to
        judge.
    sampling_period_s : float
        Sampling period T [s].
    added_delay_samples : int
        Delay that was added on purpose [samples].
    grip : {"none", "comfortable", "firm"}
    motion : Motion or None
        Type of motion. None if the log does not state the motion, which is then taken from the device file.
    simulated : bool
        True if the log contains ``# origin: simulated``.
    extra : dict of str to str
        Other keys of the header, as written. ``step_row`` declares the row of the step, counted from 0.
    """

    device: str
    experiment: str
    stiffness: float
    damping: float
    step: float
    sampling_period_s: float
    added_delay_samples: int = 0
    grip: Grip = "none"
    motion: Motion | None = None
    simulated: bool = False
    extra: dict[str, str] = field(default_factory=dict)


def format_header(header: NativeHeader, motion: Motion | None = None) -> str:
    """Return a header as text, which ends with the line of column names and a line feed.

    Parameters
    ----------
    header : NativeHeader
    motion : Motion, optional
        Motion of the device, which determines the units in remarks and is written. By default, the motion of the header
        is used, or translation if the header has none.

    Raises
    ------
    ParameterError
        If `parse_header` would not return the same header, for example because a name contains a line feed, a number is
        NaN, or the two motions contradict each other.
    """
    chosen: Motion = motion or header.motion or "translation"
    lines = [
        f"# device: {header.device}",
        f"# experiment: {header.experiment}",
        f"# stiffness: {header.stiffness:.17g} [{unit_of('stiffness', chosen)}]",
        f"# damping: {header.damping:.17g} [{unit_of('damping', chosen)}]",
        f"# step: {header.step:.17g} [{unit_of('force', chosen)}]",
        f"# sampling_period_s: {header.sampling_period_s:.17g}",
        f"# added_delay_samples: {header.added_delay_samples}",
        f"# grip: {header.grip}",
        f"# motion: {chosen}",
    ]
    if header.simulated:
        lines.append("# origin: simulated")
    lines += [f"# {key}: {value}" for key, value in header.extra.items()]
    expected = replace(header, motion=header.motion or chosen)
    try:
        found = parse_header(lines)
    except LogError as error:
        raise ParameterError(f"header cannot be written as a native log: {error}") from error
    if found != expected:
        raise ParameterError(f"header cannot be written as a native log: {expected} would be read as {found}")
    return "\n".join((*lines, COLUMN_LINE, ""))


def parse_header(lines: Iterable[str]) -> NativeHeader:
    """Read the header lines of a native log, up to the first line that is neither a header line nor blank.

    Parameters
    ----------
    lines : iterable of str
        First lines of the file, with or without line ends.

    Raises
    ------
    LogError
        If a required key is missing or given twice, or a value is invalid. The error has the line number.
    """
    values, extra = _statements(lines)
    missing = [key for key in _REQUIRED if key not in values]
    if values and set(OF_WALL) <= set(missing):
        values |= dict.fromkeys(OF_WALL, ("0", 1))
        extra["wall"] = NOT_STATED
        missing = [key for key in missing if key not in OF_WALL]
    if missing:
        raise _incomplete(missing, values, extra)
    if "step_row" in extra:
        _count("step_row", extra["step_row"], 1)
    simulated = extra.get("origin") == "simulated"
    if simulated:
        del extra["origin"]
    return NativeHeader(
        device=_name("device", *values["device"]),
        experiment=_name("experiment", *values["experiment"]),
        stiffness=_number("stiffness", *values["stiffness"]),
        damping=_number("damping", *values["damping"]),
        step=_number("step", *values["step"]),
        sampling_period_s=_period(*values["sampling_period_s"]),
        added_delay_samples=_count("added_delay_samples", *values.get("added_delay_samples", ("0", 0))),
        grip=cast(Grip, _choice("grip", get_args(Grip), *values.get("grip", ("none", 0)))),
        motion=cast(Motion, _choice("motion", get_args(Motion), *values["motion"])) if "motion" in values else None,
        simulated=simulated,
        extra=extra,
    )


def _statements(lines: Iterable[str]) -> tuple[dict[str, tuple[str, int]], dict[str, str]]:
    """Return the values of known keys, with their line numbers, and the values of all other keys."""
    values: dict[str, tuple[str, int]] = {}
    extra: dict[str, str] = {}
    for row, line in enumerate(lines, start=1):
        text = line.removeprefix("\ufeff").strip() if row == 1 else line.strip()
        if text and not text.startswith("#"):
            break
        match = _KEY_LINE.fullmatch(text)
        if match is None:
            continue
        key, value = match[1].rstrip(), match[2]
        if key in _REQUIRED or key in _OPTIONAL:
            if key in values:
                first = f"first in line {values[key][1]}; expected only once. Remove the wrong line."
                raise _wrong(f"header gives {key!r} twice, {first}", row)
            values[key] = (value, row)
        else:
            value = _NOTE_BEHIND_TEXT.sub("", value).strip()
            # Repeated remarks are common in logs, and all of them are kept.
            extra[key] = f"{extra[key]}; {value}" if key in extra else value
    return values, extra


def _incomplete(missing: list[str], values: dict[str, tuple[str, int]], extra: dict[str, str]) -> LogError:
    """Return the error for a header with missing keys."""
    found = ", ".join([*values, *extra]) or "no `# key: value` line"
    if not values:
        remedy = "Add a line `# key: <value>` for each of these keys, or describe the file by a profile."
        return LogError(f"header has none of {', '.join(_REQUIRED)}; found {found}. {remedy}", 1, code="header-missing")
    remedy = " ".join(f"Add a line `# {key}: <value>` with {_REQUIRED[key]}." for key in missing)
    lacking = " and no ".join(map(repr, missing))
    return LogError(f"header has no {lacking}; found {found}. {remedy}", 1, code="condition-missing")


def _wrong(reason: str, row: int) -> LogError:
    return LogError(reason, row, code="condition-wrong")


@lru_cache(1024)  # most of these lines are the same in all logs of an experiment
def _name(key: str, value: str, row: int) -> str:
    name = _NOTE_BEHIND_TEXT.sub("", value).strip()
    if not name or len(name) > LONGEST_NAME or not name.isprintable():
        expected = f"a printable name of 1 to {LONGEST_NAME} characters"
        raise _wrong(f"{key} must be {expected}, found {name!r}. Write {_REQUIRED[key]}.", row)
    return name


@lru_cache(1024)
def _number(key: str, value: str, row: int) -> float:
    text, bracket, note = value.partition("[")
    text = text.strip()
    unit = re.split(r"[\s,;\]]", note.strip(), maxsplit=1)[0] if bracket else ""
    known = find_unit(unit)
    if known is not None and known.factor != 1.0:
        remedy = f"Multiply the value by {known.factor:.9g} and correct the note, or describe the file by a profile."
        raise _wrong(f"{key} is stated in {unit}, but values in native logs are in SI (N, m, rad, s). {remedy}", row)
    try:
        # Unlike other readers, float() would also accept 1_000 and digits of every script.
        number = float(text.replace("_", "?")) if text.isascii() else math.nan
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        remedy = f"Write `# {key}: <number>`. A remark must be in square brackets after the number."
        raise _wrong(f"{key} must be a finite number with a decimal point, but the header has {text!r}. {remedy}", row)
    return number


def _period(value: str, row: int) -> float:
    period = _number("sampling_period_s", value, row)
    if period <= 0:
        raise _wrong(
            f"sampling_period_s must be above 0 s, but the header has {period:g}. Write the period, such as 0.001.", row
        )
    return period


@lru_cache(1024)
def _count(key: str, value: str, row: int) -> int:
    number = _number(key, _OPTIONAL_NOTE.sub("", value), row)
    if number < 0 or number != int(number):
        raise _wrong(f"{key} must be an integer number of samples >= 0, found {number:g}.", row)
    return int(number)


@lru_cache(1024)
def _choice(key: str, allowed: tuple[str, ...], value: str, row: int) -> str:
    word = _OPTIONAL_NOTE.sub("", value.partition("[")[0]).strip()
    if word not in allowed:
        raise _wrong(f"{key} must be one of {', '.join(allowed)}; found {word!r}.", row)
    return word
