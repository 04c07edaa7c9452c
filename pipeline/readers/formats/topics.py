"""Messages of a bag as columns: ``/topic.field.sub[3]``, stamps in ns, several topics on one time axis.

``/topic.header.stamp`` and every other ROS time or duration is a whole number of nanoseconds; ``/topic.@received`` is
when the message was recorded. ``@stamp`` and ``@received`` without a topic are the time of the rows.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import LogError
from pipeline.readers.formats.arrays import LISTED_ELEMENTS, Array, plain_column, unknown_column
from pipeline.readers.formats.recording import LISTED_MESSAGES, Parts, Recording, split
from pipeline.readers.formats.ros_types import Decoder
from pipeline.readers.frame import ColumnInfo, Frame
from pipeline.readers.isolation import isolated_reader
from pipeline.readers.limits import EXACT
from pipeline.readers.safety import check_claim

IMPORTS = ("rosbags.typesys", "lz4.frame")
"""What reading a bag imports."""

SECONDS_PER_BYTE = 4e-6
"""Processor time allowed for a bag: messages are decoded one by one, some 20 us for 60 to 160 bytes; other machines are
six times slower."""

STAMP, RECEIVED = "@stamp", "@received"
_HEADER = "header.stamp"
_DEEPEST = 16
"""Messages inside messages that are listed."""

_STEP = re.compile(r"\.?([^.\[\]]+)|\[(\d+)\]")


ScanFile = Callable[[str, bytes, Recording], None]
"""Walks through the records of one file of a bag, given its name and bytes, and adds them to the recording."""


def bag_reader(kind: str, scan_file: ScanFile) -> tuple[Callable[..., Frame], Callable[..., list[ColumnInfo]]]:
    """Return ``read_frame`` and ``list_columns`` of a format of bags."""
    return isolated_reader(__name__, kind, IMPORTS, scan_file, seconds_per_byte=SECONDS_PER_BYTE)


def _recorded(
    name: str, data: bytes, scan_file: ScanFile, parts: Parts, keep: Callable[[str], bool], most: int | None = None
) -> Recording:
    recording = Recording(keep, most)
    for part_name, part in split(name, data, parts):
        scan_file(part_name, part, recording)
    return recording


def frame_here(name: str, data: bytes, wanted: Sequence[str], scan_file: ScanFile, parts: Parts = ()) -> Frame:
    """Return fields of messages as a frame, in the worker process.

    Columns of one topic keep the order of recording. Columns of several topics stand on the union of their times, in
    order of time, with NaN (an empty text) where a topic has no message; nothing is interpolated. Messages of one
    topic with equal times stay separate rows.

    Parameters
    ----------
    name : str
        The file.
    data : bytes
    wanted : sequence of str
        ``/topic.field``, ``/topic.@received``, and ``@stamp`` or ``@received`` for the time of the rows; with several
        topics the rows are joined by ``@stamp`` (the stamps in the headers) where it is wanted, else by ``@received``.
        Empty means all numbers and texts of all topics.
    scan_file : callable
    parts : tuple of (str, int)
        Name and bytes of each file where ``data`` holds those of a split bag, one behind the other.

    Raises
    ------
    LogError
        If a topic or field is missing, a type is not known, or whole numbers of more than 15 digits would get gaps.
    """
    if STAMP in wanted and RECEIVED in wanted:
        raise LogError(
            f"{name}: both {STAMP!r} and {RECEIVED!r} are wanted; rows have one time. Choose one of them.",
            code="profile-wrong",
        )
    recording = _recorded(
        name, data, scan_file, parts, lambda topic: not wanted or any(key.startswith(f"{topic}.") for key in wanted)
    )
    if not recording.topics:
        cut = "".join(f" The {warning}." for warning in recording.warnings)
        raise LogError(f"{name} holds no topics; expected recorded messages.{cut} Record the log again.", code="empty")
    fields: dict[str, list[str]] = {}
    decoder = Decoder(name, recording.topics, len(data))
    for key in wanted:
        if key not in (STAMP, RECEIVED):
            topic, field = _split(name, recording, key)
            fields.setdefault(topic, []).append(field)
    if not wanted:
        fields = {
            topic: _paths(decoder, recording, topic) for topic in recording.data if decoder.refusal(topic) is None
        }
        if len(fields) > 1:
            # whole nanoseconds cannot be missing; the time of the rows is there for all topics
            fields = {topic: [path for path in paths if path != _HEADER] for topic, paths in fields.items()}
    if not fields:
        raise LogError(
            f"{name}: no column of a topic is wanted. It has the topics {_listing(recording)}.", code="profile-wrong"
        )
    columns = {topic: _read_topic(name, decoder, recording, topic, asked) for topic, asked in fields.items()}
    number = {topic: np.array(recording.number[topic], dtype=np.int64) for topic in fields}
    if len(fields) == 1 and not wanted:
        (table,) = columns.values()
        (rows,) = number.values()
        return Frame(
            {f"{topic}.{f}": c for topic in fields for f, c in table.items()},
            rows,
            "message",
            _info(recording),
            tuple(recording.warnings),
        )
    axis = STAMP if STAMP in wanted else RECEIVED
    times = {topic: _times(name, decoder, recording, topic, axis) for topic in fields}
    frame = _join(name, recording, wanted, axis, times, columns, number, len(data))
    return replace(frame, units=_units(decoder, recording, fields))


def columns_here(name: str, data: bytes, scan_file: ScanFile) -> list[ColumnInfo]:
    """Return the columns of all topics, as their first messages have them, with message types as hints, in the worker.

    Raises
    ------
    LogError
        If a message cannot be decoded.
    """
    recording = _recorded(name, data, scan_file, (), lambda topic: True, LISTED_MESSAGES)
    decoder = Decoder(name, recording.topics, len(data))
    infos = []
    for topic, info in recording.topics.items():
        rows = recording.counts.get(topic, 0)
        refusal = decoder.refusal(topic)
        if refusal is not None or not rows:
            infos.append(ColumnInfo(topic, "text", rows, (), refusal or f"{info.type}; no messages"))
            continue
        paths = [RECEIVED, *_paths(decoder, recording, topic)]
        for path, column in _read_topic(name, decoder, recording, topic, paths).items():
            kind = {"f": "number", "U": "text"}.get(column.dtype.kind, "integer")
            unit = "ns" if path in (RECEIVED, _HEADER) else info.type
            infos.append(ColumnInfo(f"{topic}.{path}", kind, rows, tuple(map(str, column[:LISTED_MESSAGES])), unit))
    return infos


def _split(name: str, recording: Recording, key: str) -> tuple[str, str]:
    """Return topic and field of a column; the longest topic that fits."""
    topic = max((t for t in recording.topics if key.startswith(f"{t}.")), key=len, default=None)
    if topic is None:
        raise LogError(
            f"{name} has no topic for the column {key!r}; it has {_listing(recording)}. A column is called "
            "'/topic.field'. Correct columns.*.name in the profile.",
            code="column-missing",
        )
    if not recording.data.get(topic):
        raise LogError(
            f"{name}: topic {topic!r} has no messages; expected samples. It has {_listing(recording)}.", code="empty"
        )
    return topic, key[len(topic) + 1 :]


def _listing(recording: Recording) -> str:
    return ", ".join(
        f"{topic!r} ({info.type}, {recording.counts.get(topic, 0)} messages)"
        for topic, info in list(recording.topics.items())[:20]
    )


def _info(recording: Recording) -> dict[str, str | float | int]:
    return {f"{topic}@type": info.type for topic, info in recording.topics.items()}


def _paths(decoder: Decoder, recording: Recording, topic: str) -> list[str]:
    """Return the fields of a topic's first message that are numbers or texts."""
    found: list[str] = []
    waiting: list[tuple[str, Any]] = [("", decoder.decode(topic, recording.data[topic][0]))]
    while waiting:
        path, value = waiting.pop()
        if isinstance(value, bool | int | float | str | np.generic):
            found.append(path)
        elif isinstance(value, list | np.ndarray):
            elements = [(f"{path}[{i}]", value[i]) for i in range(min(len(value), LISTED_ELEMENTS))]
            waiting += elements[::-1]
        elif path.count(".") < _DEEPEST:
            inner = value if isinstance(value, dict) else decoder.fields(value)
            waiting += [(f"{path}.{key}" if path else key, part) for key, part in inner.items()][::-1]
    return found


def _units(decoder: Decoder, recording: Recording, fields: dict[str, list[str]]) -> dict[str, str]:
    """Return the unit of each column that holds ROS times or durations."""
    units = {STAMP: "ns", RECEIVED: "ns"}
    for topic, paths in fields.items():
        first = decoder.decode(topic, recording.data[topic][0])
        for path in paths:
            *steps, last = [field or int(index) for field, index in _STEP.findall(path)]
            value = first
            for step in steps:
                value = decoder.part(value, step)
            if path == RECEIVED or decoder.is_time(value, last):
                units[f"{topic}.{path}"] = "ns"
    return units


def _read_topic(
    name: str, decoder: Decoder, recording: Recording, topic: str, asked: Sequence[str]
) -> dict[str, Array]:
    """Return the asked fields of all messages of a topic that were kept."""
    columns: dict[str, Array] = {}
    inside = [path for path in dict.fromkeys(asked) if path != RECEIVED]
    steps = {path: [field or int(index) for field, index in _STEP.findall(path)] for path in inside}
    cells: dict[str, list[Any]] = {path: [] for path in inside}
    # a message has no fixed size, so each is decoded for itself
    for at, data in enumerate(recording.data[topic] if inside else ()):
        message = decoder.decode(topic, data)
        for path in inside:
            value = message
            for step in steps[path]:
                value = decoder.part(value, step)
            if not isinstance(value, bool | int | float | str | np.generic):
                known = _paths(decoder, recording, topic)
                if at == 0 or path not in known:
                    raise unknown_column(name, f"{topic}.{path}", [f"{topic}.{one}" for one in known])
                raise LogError(
                    f"{name}: message of {topic!r} has no {path!r}, which the first one has; expected it in each. "
                    "Take another column, or leave this log out.",
                    recording.number[topic][at],
                    code="column-missing",
                )
            cells[path].append(value)
    for path in asked:
        if path == RECEIVED:
            columns[path] = np.array(recording.received[topic], dtype=np.int64)
        else:
            columns[path] = plain_column(np.array(cells[path]))
    return columns


def _times(name: str, decoder: Decoder, recording: Recording, topic: str, axis: str) -> Array:
    if axis == RECEIVED:
        return np.array(recording.received[topic], dtype=np.int64)
    try:
        return _read_topic(name, decoder, recording, topic, [_HEADER])[_HEADER]
    except LogError as error:
        raise LogError(
            f"{name}: {STAMP!r} is wanted, but messages of {topic!r} have no header. Take time from {RECEIVED!r}.",
            code="column-missing",
        ) from error


def _join(
    name: str,
    recording: Recording,
    wanted: Sequence[str],
    axis: str,
    times: dict[str, Array],
    columns: dict[str, dict[str, Array]],
    number: dict[str, NDArray[np.int64]],
    size: int,
) -> Frame:
    """Return the columns of topics on the union of their times."""
    warnings = list(recording.warnings)
    keys = {}
    for topic, stamps in times.items():
        if len(times) > 1 and (backwards := stamps[1:] < stamps[:-1]).any():
            at = number[topic][int(np.argmax(backwards)) + 1]
            warnings.append(f"{axis} of {topic!r} goes back at message {at}; rows were put in order of time")
        keys[topic] = np.stack([stamps, _repetition(stamps) if len(times) > 1 else np.zeros(len(stamps), np.int64)], 1)
    if len(times) == 1:
        (topic,) = times
        place, rows, time = {topic: np.arange(len(times[topic]))}, number[topic], times[topic]
    else:
        union, inverse = np.unique(np.concatenate(list(keys.values())), axis=0, return_inverse=True)
        parts = np.split(inverse.reshape(-1), np.cumsum([len(key) for key in keys.values()])[:-1])
        place = dict(zip(keys, parts, strict=True))
        rows, time = np.full(len(union), np.iinfo(np.int64).max), union[:, 0]
        for topic, positions in place.items():
            np.minimum.at(rows, positions, number[topic])
    check_claim(name, "the joined table", 8 * len(time) * sum(map(len, columns.values())), size)
    joined: dict[str, Array] = {axis: time}
    for topic, table in columns.items():
        for field, values in table.items():
            joined[f"{topic}.{field}"] = _spread(name, f"{topic}.{field}", values, place[topic], len(time), axis)
    return Frame({key: joined[key] for key in wanted or joined}, rows, "message", _info(recording), tuple(warnings))


def _repetition(stamps: Array) -> NDArray[np.int64]:
    """Return for each time how many equal ones stand before it."""
    order = np.argsort(stamps, kind="stable")
    ordered = stamps[order]
    starts = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]]))
    lengths = np.diff(np.append(starts, len(stamps)))
    result = np.empty(len(stamps), dtype=np.int64)
    result[order] = np.arange(len(stamps)) - np.repeat(starts, lengths)
    return result


def _spread(name: str, key: str, values: Array, place: NDArray[np.intp], rows: int, axis: str) -> Array:
    """Return values at their rows, and NaN or an empty text at the others."""
    if len(values) == rows:
        result = np.empty_like(values)
    elif values.dtype.kind == "U":
        result = np.zeros(rows, dtype=values.dtype)
    elif values.dtype.kind in "iu" and len(values) and max(int(values.max()), -int(values.min())) > EXACT:
        raise LogError(
            f"{name}: {key!r} has whole numbers of more than 15 digits, and the other topics have rows without it; "
            f"expected one time for all rows. Take time from {axis!r} or, for stamps of headers, {STAMP!r}.",
            code="no-value",
        )
    else:
        result = np.full(rows, np.nan)
    result[place] = values
    return result
