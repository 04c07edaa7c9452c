"""Convert the columns of a foreign log to logs in SI units, with their trials, windows, step and conditions.

The order of operations is: rows of a trial, missing cells, conversion of stamps to seconds, order of time, duplicate
stamps, windows. Nothing is interpolated.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from pipeline.base.errors import LogError, ParameterError, ProfileError, refusal
from pipeline.base.paths import storable
from pipeline.base.units import DRIVES, find_unit, unit_in_heading
from pipeline.profiles.profile_model import (
    CONDITION_QUANTITIES,
    IMPLIED,
    QUANTITIES,
    REQUIRED_CONDITIONS,
    STEP_MISSING,
    ColumnSource,
    CommandSource,
    FileEntry,
    PositionSource,
    Profile,
    StepEntry,
    StepTime,
    Window,
    conditions_in_name,
    number_in_name,
)
from pipeline.readers.file_columns import (
    KEPT_ATTRIBUTES,
    LISTED_NAMES,
    LONGEST_ATTRIBUTE,
    FileColumns,
    Scalar,
    groups_of,
)
from pipeline.readers.formats import refuse_other_kind
from pipeline.readers.isolation import read_file
from pipeline.readers.log import Log, RawLog, check_samples
from pipeline.readers.rows import Table, rows_of
from pipeline.records.native import OF_WALL, NativeHeader, parse_header
from pipeline.records.trials import Floats, Integers

Part = tuple[FileEntry | None, StepEntry | None]
"""Entries of a profile for a file and for a step in this file, if any."""

WINDOW_TOLERANCE = 1e-6
"""Tolerance, in sampling periods, for a stamp outside a window or before the declared time of the step.

For example, rounding makes 3 x 0.1 s exceed 0.3 s, and 501 x 1e-6 s less than 0.000501 s.
"""

MOST_STEPS = 24
"""Largest number of changes of a command that is split into steps. Random sequences have hundreds of changes."""

SHORTEST_STEP = 12
"""Smallest number of rows between two changes of the command for a usable step response."""

LONGEST_STEP = 1.5
"""Largest time between two rows, in sampling periods, without a missing row. The velocity in a longer gap is
unknown."""


def read(profile: Profile, raws: Sequence[RawLog]) -> list[tuple[Log, ...] | LogError]:
    """Read logs of one or two files each.

    Parameters
    ----------
    profile : Profile
        A profile of any format except ``native``.
    raws : sequence of RawLog

    Returns
    -------
    list of tuple of Log, or LogError
        Outcomes in the order of ``raws``. If a trial is refused, its whole file is refused.
    """
    outcomes: list[tuple[Log, ...] | LogError] = []
    for raw in raws:
        try:
            outcomes.append(tuple(_logs_of_file(profile, raw)))
        except LogError as error:
            outcomes.append(error)
        except ProfileError as error:
            # A file that cannot be read must not stop the others.
            outcomes.append(LogError(str(error), code="profile-wrong"))
    return outcomes


def _logs_of_file(profile: Profile, raw: RawLog) -> list[Log]:
    """Return the logs of a file: one log for each group if the groups are trials.

    Raises
    ------
    LogError
        If a log is refused, or no group has the columns.
    """
    if profile.trials is None:
        return logs_of(profile, raw.names, read_frames(profile, raw))
    name = raw.names[0]
    refuse_other_kind(name, profile.format, raw.data[0])
    whole = read_file(profile, raw.names, raw.data)
    wanted = tuple(dict.fromkeys(profile.wanted().values()))
    logs: list[Log] = []
    groups = groups_of(list(whole.columns), wanted)
    if not groups:
        found = f"no group has the columns {', '.join(map(repr, wanted))}"
        listing = ", ".join(list(whole.columns)[:LISTED_NAMES]) or "none"
        raise refusal("column-missing", name, f"{found}. Columns of the file: {listing}")
    for group in groups:
        frame = whole.of_group(group, wanted).frame()
        _check_units(profile, name, "source", frame)
        title = storable(group.strip("/"))
        try:
            found_logs = logs_of(profile, raw.names, [frame])
        except LogError as error:
            raise error.reworded(f"{title}: {error.reason}") from error
        logs += [replace(log, label=title if log.label is None else f"{title}.{log.label}") for log in found_logs]
    return logs


def read_frames(profile: Profile, raw: RawLog) -> list[FileColumns]:
    """Read the columns that a profile needs from each file of a log.

    Raises
    ------
    LogError
        If a file cannot be read, has a different format, does not contain a column, or has a time unit that contradicts
        the profile.
    """
    for name, data in zip(raw.names, raw.data, strict=False):
        refuse_other_kind(name, profile.format, data)
    # Without a partner, several files are the parts of a split bag.
    pairs = [(raw.names, raw.data)]
    if profile.partner is not None:
        pairs = [((name,), (data,)) for name, data in zip(raw.names, raw.data, strict=False)]
    roles: tuple[Literal["source", "partner"], ...] = ("source", "partner")
    frames = []
    for role, (names, data_of) in zip(roles, pairs, strict=False):
        wanted = tuple(dict.fromkeys(profile.wanted(role).values()))
        frame = read_file(profile, names, data_of, wanted).frame()
        _check_units(profile, names[0], role, frame)
        frames.append(frame)
    return frames


def _check_units(profile: Profile, name: str, role: str, frame: FileColumns) -> None:
    """Refuse a unit that contradicts the type of its column. Warn if it contradicts a unit in the file."""
    for key, source in profile.column_sources().items():
        if source.unit is None or source.file != role:
            continue
        typed = frame.units.get(source.key)
        heading = unit_in_heading(source.key, (*QUANTITIES[key].values(), *(DRIVES if key == "command" else ())))[1]
        in_file = typed or next((text for text in (frame.hints.get(source.key, ""), heading) if find_unit(text)), None)
        if in_file is None or find_unit(in_file) == find_unit(source.unit):
            continue
        found = f"columns.{key}.unit is {source.unit!r}, but the file states {in_file!r}"
        if typed:
            raise refusal("profile-wrong", name, found, line=f'[columns.{key}]\nunit = "{typed}"')
        frame.warnings += (f"{found}. Check which of the two is right",)


def logs_of(profile: Profile, names: Sequence[str], frames: Sequence[FileColumns]) -> list[Log]:
    """Return the logs of a recording, which is a file or a pair of files.

    Parameters
    ----------
    profile : Profile
    names : sequence of str
        File names.
    frames : sequence of FileColumns
        Columns of each file.

    Raises
    ------
    LogError
        If the file contradicts the profile. The message states the row, and the line of the profile that would help.
    """
    frame, name = frames[0], names[0]
    for other, other_name in zip(frames[1:], names[1:], strict=False):
        if len(other) != len(frame):
            longer, end = max(frame, other, key=len), min(len(frame), len(other))
            found = f"the files have different numbers of rows ({len(frame)} in {name}, {len(other)} in {other_name})"
            cure = "Check that they were recorded together."
            raise refusal("lengths-differ", "", found, cure=cure, row=int(longer.row[end]))
    entry = entry_of(profile, name)
    step: StepTime = entry if entry is not None and entry.declared else profile
    window = entry.window if entry is not None and entry.window is not None else profile.window
    logs = []
    for label, index in _trials(profile, name, frame):
        where = name if label is None else f"{name}, trial {label!r}"
        # If the profile lists steps, the conditions of the wall are required for each step, not for the file.
        required = ("sampling_period_s",) if profile.steps else REQUIRED_CONDITIONS
        given = conditions_of(profile, (name, where), frame, index, (entry, None), required)
        period = float(given["sampling_period_s"])
        if not 0 < period < np.inf:
            raise refusal("condition-wrong", where, f"sampling_period_s is {period:g}", "a time above 0 s")
        table, counts = rows_of(profile, where, names, frames, index, period)
        source = profile, frame, table, counts
        if not profile.steps:
            log = _log(source, where, given, step, window, label)
            is_cut = step.step_at == "command edge" and log.header.step != 0
            logs += _steps_of(log) if is_cut or profile.kind == "staircase" else [log]
        for part in profile.steps:
            place = f"{where}, step {part.label!r}"
            of_part = conditions_of(profile, (name, place), frame, index, (entry, part))
            logs.append(_log(source, place, of_part, part if part.declared else step, part, part.label))
    return logs


def _steps_of(log: Log) -> list[Log]:
    """Split a log without a wall into its steps, if the command is constant between a few changes."""
    header, changes = log.header, changes_of(log.command)
    if header.stiffness or header.damping or (header.step and len(changes) < 2):
        return [log]
    if not is_staircase(log.command):
        text = f"the command changes {len(changes)} times, so the log is not split into steps; use `pipeline identify`"
        return [replace(log, warnings=(*log.warnings, text))]
    return _parts_of(log)


def changes_of(command: Floats) -> Integers:
    """Return the rows in which a command differs from the row before."""
    return np.flatnonzero(np.diff(command)) + 1


def is_staircase(command: Floats) -> bool:
    """Return True if a command is constant between a few changes, each time long enough for a visible response."""
    changes = changes_of(command)
    return 0 < len(changes) <= MOST_STEPS and min(np.diff([*changes, len(command)])) >= SHORTEST_STEP


def _parts_of(log: Log) -> list[Log]:
    """Return a log for each change of the command, with this change as its step.

    This log begins at the previous change and ends at the next change.
    """
    header, command, changes = log.header, log.command, changes_of(log.command)
    ends = [0, *changes.tolist(), len(command)]
    parts = []
    for number, (first, row, end) in enumerate(zip(ends, ends[1:], ends[2:], strict=False), start=1):
        size = float(command[row] - command[row - 1])
        text = f"step {number} of {len(changes)} found in the command: {size:.4g} in row {row}"
        own = replace(header, step=size, extra={**header.extra, "step_row": str(row - first)})
        cut: Any = {key: values[first:end] for key, values in vars(log).items() if isinstance(values, np.ndarray)}
        label = str(number) if log.label is None else f"{log.label}.{number}"
        parts.append(replace(log, header=own, label=label, warnings=(*log.warnings, text), **cut))
    return parts


def _trials(profile: Profile, name: str, frame: FileColumns) -> Iterator[tuple[str | None, Integers]]:
    """Yield the label and the rows of each trial, in the order in which the trials begin."""
    if profile.trial_column is None:
        yield None, np.arange(len(frame))
        return
    values = frame.columns[profile.trial_column]
    blank = np.isnan(values) if values.dtype.kind == "f" else np.char.strip(values.astype(np.str_)) == ""
    if blank.any():
        found, row = f"column {profile.trial_column!r} (trial_column) is blank", int(frame.row[int(np.argmax(blank))])
        raise refusal("no-value", name, found, "a label of the trial in each row", row=row)
    labels, first, which = np.unique(values, return_index=True, return_inverse=True)
    for at in np.argsort(first):
        label = labels[at].item()
        text = str(int(label)) if isinstance(label, float) and label.is_integer() else str(label)
        yield storable(text), np.flatnonzero(which == at)


def _log(
    source: tuple[Profile, FileColumns, Table, dict[str, int]],
    where: str,
    given: dict[str, Scalar],
    step: StepTime,
    window: Window | StepEntry | None,
    label: str | None,
) -> Log:
    """Return the part of a trial inside a window as a log."""
    profile, frame, whole, counts = source
    if not step.declared and given["step"] != 0:
        found = f"profile {profile.name} does not state the time of the step for this file"
        cure = f"At the top, or in the matching [[file]] or [[steps]]: {STEP_MISSING}."
        raise refusal("condition-missing", where, found, cure=cure, line='step_at = "command edge"')
    period = float(given["sampling_period_s"])
    table = whole if window is None else _inside(window, whole, period)
    time, row = table["time"], table["row"]
    if len(time) < 2:
        limits = "" if window is None else f" inside its window, of {_span(whole['time'])}"
        at = int(frame.row[0]) if len(frame) else None
        raise refusal("too-short", where, f"has {len(time)} samples{limits}", "at least 2", row=at)
    factors, sources = profile.factors(), profile.column_sources()
    columns = {key: table[key] * factors[key] for key in sources if key != "time" and key in table}
    command, position = sources["command"], sources["position"]
    if isinstance(command, CommandSource) and command.value is not None:
        by_row = command.from_row is not None
        began = table["number"] >= command.from_row if by_row else time >= (command.from_s or 0.0)
        columns["command"] = np.where(began, command.value * factors["command"], 0.0)
    extra = _extra(profile, frame, _step_row(where, step, table, period))
    extra |= {} if profile.kind == "step" else {"kind": profile.kind}
    if isinstance(position, PositionSource) and (rule := position.integrate):
        extra["integrated"] = rule
        columns["velocity"] = columns["position"]
        columns["position"] = _integral(where, rule, table, columns["velocity"], period)
    header = header_of(profile, where, given, extra)
    try:
        modulus = None if not isinstance(position, PositionSource) else position.unwrap
        if modulus is not None and not isinstance(modulus, bool):
            modulus *= abs(factors["position"])
        log = check_samples(header, time=time, row=row, unwrap=modulus, **columns)
    except LogError as error:
        raise error.reworded(f"{where}: {error.reason}") from error
    outside = {"outside_window": cut} if (cut := len(whole["time"]) - len(time)) else {}
    raw = table.get("raw_time")
    return replace(log, raw_time=raw, counts=counts | outside, warnings=tuple(frame.warnings), label=label)


def _integral(where: str, rule: str, table: Table, velocity: Floats, period: float) -> Floats:
    """Return the position [m, rad] as the integral of a velocity by the rule of the profile. The position is 0 in the
    first row.
    """
    steps = np.diff(table["time"])
    if (lost := steps > LONGEST_STEP * period).any():
        at = int(np.argmax(lost)) + 1
        found = f"rows are missing before {table['time'][at]:.9g} s, so the integral of the velocity is unknown"
        cure = "Exclude these rows by a window, or omit the log."
        raise refusal("time-wrong", where, found, cure=cure, row=int(table["row"][at]))
    mean = velocity[1:] if rule == "difference" else 0.5 * (velocity[1:] + velocity[:-1])
    return np.concatenate([[0.0], np.cumsum(mean * steps)])


def _span(time: Floats) -> str:
    return f"{len(time)} from {time[0]:.9g} s to {time[-1]:.9g} s" if len(time) else "none"


def _inside(window: Window, table: Table, period: float) -> Table:
    """Return the rows inside a window, including both ends."""
    inside = np.ones(len(table["time"]), dtype=np.bool_)
    by_time, by_row = (window.from_s, window.to_s), (window.from_row, window.to_row)
    for key, (low, high), slack in (("time", by_time, WINDOW_TOLERANCE * period), ("number", by_row, 0.0)):
        inside &= table[key] >= (-np.inf if low is None else low - slack)
        inside &= table[key] <= (np.inf if high is None else high + slack)
    return {key: values[inside] for key, values in table.items()}


def _step_row(where: str, step: StepTime, table: Table, period: float) -> int | None:
    """Return the declared row of the step among the stored rows, or None if the step must be found in the command."""
    time, number, slack = table["time"], table["number"], WINDOW_TOLERANCE * period
    if step.step_at is not None or not step.declared:
        return 0 if step.step_at == "first row" else None
    if step.step_row is not None:
        found, text = np.flatnonzero(number == step.step_row), f"step_row = {step.step_row}"
    else:
        at = step.step_time_s or 0.0
        found, text = np.flatnonzero((time >= at - slack) & (time[0] - slack <= at)), f"step_time_s = {at:g}"
    if not len(found):
        text += f" is not among the samples, {_span(time)} rows {number[0]} to {number[-1]} counted from 0"
        raise refusal(
            "profile-wrong", where, text, cure="Correct the declared step or the window.", row=int(table["row"][0])
        )
    return int(found[0])


def _extra(profile: Profile, frame: FileColumns, step_row: int | None) -> dict[str, str]:
    """Return the additional texts of a trial: the declared step, the origin of the columns, attributes, and
    warnings."""
    extra = {} if step_row is None else {"step_row": str(step_row)}
    for key, source in profile.column_sources().items():
        if source.provenance:
            extra[f"provenance.{key}"] = source.provenance
        if isinstance(source, ColumnSource) and source.stands_for is not None:
            extra[f"stands_for.{key}"] = f"1 {source.unit} stands for 1 {source.stands_for}"
    attributes = list(frame.attributes.items())
    extra |= {f"file.{key}": str(value)[:LONGEST_ATTRIBUTE] for key, value in attributes[:KEPT_ATTRIBUTES]}
    if frame.warnings:
        extra["warnings"] = "; ".join(frame.warnings)
    # Texts of some formats cannot be encoded in UTF-8.
    return {storable(key): storable(value) for key, value in extra.items()}


def entry_of(profile: Profile, name: str) -> FileEntry | None:
    """Return the entry of the profile for a file, or None.

    Raises
    ------
    LogError
        If two entries match the file.
    """
    entries = profile.entries_for(name)
    if len(entries) > 1:
        found = f"matches {len(entries)} [[file]] entries of {profile.name}, match = {[e.match for e in entries]}"
        raise refusal("profile-wrong", name, found, "one entry")
    return entries[0] if entries else None


def statements(profile: Profile, name: str, part: Part) -> dict[str, tuple[str, Any]]:
    """Return the profile key that determines each condition of a trial, and the value, or None if the file contains the
    value.

    The most specific key has priority, in this order: step, file, columns, attributes, file name, constants.

    Raises
    ------
    LogError
        If the file name does not match the pattern of the profile.
    """
    entry, step = part
    found: dict[str, tuple[str, Any]] = dict.fromkeys(IMPLIED[profile.kind], (f"kind = {profile.kind!r}", 0.0))
    found |= {key: ("constants", value) for key, value in profile.constants.given().items()}
    try:
        from_name = {} if profile.name_pattern is None else conditions_in_name(profile.name_pattern, name)
    except ParameterError as error:
        raise refusal("condition-wrong", "", f"file name {name!r}: {error}") from error
    if from_name is None:
        text = f"file name {name!r} does not match name_pattern {profile.name_pattern!r} of {profile.name}"
        raise refusal("profile-wrong", "", text)
    found |= {key: ("name_pattern", value) for key, value in from_name.items()}
    found |= {key: (f"attributes: {attribute!r}", None) for key, attribute in profile.attributes.items()}
    found |= {key: (f"condition_columns: {column!r}", None) for key, column in profile.condition_columns.items()}
    if entry is not None:
        found |= {key: (f"file, match = {entry.match!r}", value) for key, value in entry.given().items()}
    if step is not None:
        found |= {key: (f"steps, label = {step.label!r}", value) for key, value in step.given().items()}
    return found


def conditions_of(
    profile: Profile,
    names: tuple[str, str],
    frame: FileColumns,
    rows: Integers,
    part: Part,
    required: Sequence[str] = REQUIRED_CONDITIONS,
) -> dict[str, Scalar]:
    """Return the conditions of a trial in SI.

    Parameters
    ----------
    profile : Profile
    names : tuple of str
        File name, and the name with the trial for messages.
    frame : FileColumns
    rows : int64
        Rows of the trial, for conditions stated in a column.
    part : FileEntry or None, StepEntry or None
        Entries of the profile for the file and for the step.
    required : sequence of str
        Conditions without which the trial is refused.

    Raises
    ------
    LogError
        If a condition is missing, or is missing from the file name, the attribute or the column from which the profile
        reads it.
    """
    name, where = names
    given: dict[str, Scalar] = {}
    columns, attributes = dict[str, str](**profile.condition_columns), dict[str, str](**profile.attributes)
    for key, (_, value) in statements(profile, name, part).items():
        inside = value is None
        if inside and key in columns:
            value = _of_column(where, frame, rows, key, columns[key])
        elif inside and (value := frame.attributes.get(attributes[key])) is None:
            found = (
                f"has no attribute {attributes[key]!r} for the {key}; its attributes are "
                f"{sorted(frame.attributes)[:40]}"
            )
            raise refusal("condition-missing", where, found)
        given[key] = _in_si(profile, where, key, value, inside)
    # A file without conditions has no wall, unless the profile states walls: then this file may also have a wall.
    if given.keys().isdisjoint(OF_WALL) and profile.conditions().isdisjoint(OF_WALL):
        given |= dict.fromkeys(OF_WALL, 0.0)
    if missing := next((key for key in required if key not in given), None):
        line = f'[[file]]\nmatch = "{name}"\n{missing} = <value>'
        found = f"profile {profile.name} does not state the {missing} of this file"
        if profile.file and not profile.entries_for(name):
            found += ", and no [[file]] entry or row of its sheet names it"
        raise refusal("condition-missing", where, found, line=line)
    return given


def header_of(profile: Profile, where: str, given: Mapping[str, Any], extra: dict[str, str]) -> NativeHeader:
    """Return the conditions as a header.

    The conditions are parsed as lines of a native log, so that the conditions of every format pass the same checks.

    Raises
    ------
    LogError
        If a condition is invalid.
    """
    lines = (f"# {key}: {value}" for key, value in {**given, "motion": profile.motion}.items())
    try:
        header = parse_header(lines)
    except LogError as error:
        reason = f"{where}: with the conditions of profile {profile.name}, {error.reason}"
        # The row of this error is omitted, because it counts lines that were made here and do not exist in the file.
        raise LogError(reason, code=error.code) from error
    if (header.device, header.experiment) != (str(given["device"]), str(given["experiment"])):
        found = f"device {given['device']!r} or experiment {given['experiment']!r} has a part in brackets"
        raise refusal("condition-wrong", where, found, "names without brackets")
    return replace(header, extra=extra)


def _of_column(where: str, frame: FileColumns, rows: Integers, key: str, column: str) -> Scalar:
    values = frame.columns[column][rows]
    if not len(values):
        raise refusal("condition-missing", where, f"column {column!r}, which states the {key}, has no rows")
    other = values != values[0]
    if other.any():
        at = int(np.argmax(other))
        found = f"column {column!r} states the {key}, but changes from {values[0]} to {values[at]}"
        raise refusal("condition-wrong", where, found, "one value for a trial", row=int(frame.row[rows[at]]))
    value: Scalar = values[0].item()
    return value


def _in_si(profile: Profile, where: str, key: str, value: Scalar, inside: bool = False) -> Scalar:
    """Return a condition in SI. A unit after the value in the file has priority.

    ``inside`` is True if the value is in the file. With a decimal comma, a point may then separate thousands.
    """
    if key not in CONDITION_QUANTITIES:
        # A value of 1.0 in a column of floats is the experiment "1".
        return int(value) if isinstance(value, float) and value.is_integer() else value
    factor = profile.condition_factor(key)
    if not isinstance(value, str):
        return value * factor
    text, shown = value.strip(), f"the {key} is {value.strip()[:200]!r}"
    number, _, unit = text.replace("[", " ").replace("(", " ").rstrip(")]").partition(" ")
    if inside and profile.decimal_sign == "," and "." in number:
        found = f"{shown}, but the decimal sign is ',', so the point may separate thousands"
        raise refusal("condition-wrong", where, found)
    try:
        if inside:
            magnitude = float(number.replace(profile.decimal_sign, ".").replace("_", "?"))
        else:
            magnitude = number_in_name(number, profile.decimal_sign)
        unit = unit.strip()
        stated = profile.unit_factor(key, unit) if unit else factor
    except ParameterError as error:
        raise refusal("condition-wrong", where, f"{shown}: {error}") from error
    except ValueError:
        expected = f"a number (decimal sign {profile.decimal_sign!r}), with or without its unit"
        raise refusal("condition-wrong", where, shown, expected) from None
    if stated != factor and getattr(profile.units, key) is not None:
        found = f"{shown}, but units.{key} is {getattr(profile.units, key)!r}"
        raise refusal("condition-wrong", where, found)
    return magnitude * stated
