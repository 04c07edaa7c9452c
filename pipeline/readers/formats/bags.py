"""Bags of ROS 1 and ROS 2 (``.bag``, ``.db3``, ``.mcap``) as columns ``/topic.field.sub[3]``, stamps in ns.

``/topic.header.stamp`` and every other ROS time or duration is a whole number of nanoseconds; ``/topic.@received`` is
when the message was recorded. ``@stamp`` and ``@received`` without a topic are the time of the rows.
"""

from __future__ import annotations

import re
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.typesys import Stores, get_typestore

from pipeline.base.errors import LogError
from pipeline.profiles.profile_model import Profile
from pipeline.readers.frame import Array, Contents, with_gaps
from pipeline.readers.limits import LISTED_ELEMENTS
from pipeline.readers.refusals import refusal
from pipeline.records.batch import Integers

zstd = import_module("compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd")

STAMP, RECEIVED = "@stamp", "@received"
_ZSTD = b"\x28\xb5\x2f\xfd"
_HEADER = "header.stamp"
_ENDINGS = ((b"#ROSBAG", ".bag"), (b"SQLite", ".db3"), (b"\x89MCAP", ".mcap"))
_STEP = re.compile(r"\.?([^.\[\]]+)|\[(\d+)\]")
_TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
_CLOSE = (
    "A recording that was not closed is mended by `rosbag reindex`, `ros2 bag reindex` or `mcap recover`; others are "
    "converted by `ros2 bag convert` where their message types are installed."
)


class _Topic:
    """Messages of a topic: number in the bag, time of reception, and the message."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.number: list[int] = []
        self.received: list[int] = []
        self.messages: list[Any] = []


def read(path: Path, settings: Profile, contents: Contents) -> None:
    """Add the fields of messages.

    Columns of one topic keep the order of recording. Columns of several topics that are wanted stand on the union of
    their times, in order of time, with NaN (an empty text) where a topic has no message; nothing is interpolated.
    """
    contents.row_name = "message"
    if STAMP in contents.wanted and RECEIVED in contents.wanted:
        text = f"both {STAMP!r} and {RECEIVED!r} are wanted; rows have one time"
        raise refusal("profile-wrong", contents.name, text, cure="Choose one of them.")
    topics = _recorded(contents, [_named(file) for file in sorted(path.parent.iterdir())])
    fields: dict[str, list[str]] = {}
    for key in contents.wanted or topics:
        topic = max((t for t in topics if key == t or key.startswith(f"{t}.")), key=len, default=None)
        if topic is not None and topics[topic].messages:
            part = key[len(topic) + 1 :]
            fields.setdefault(topic, []).extend([part] if part else [RECEIVED, *_paths(topics[topic].messages[0])])
        elif key not in (STAMP, RECEIVED) and contents.wanted:
            listing = ", ".join(f"{t!r} ({one.kind}, {len(one.number)} messages)" for t, one in topics.items())
            text = f"has no topic with messages for the column {key!r}; it has {listing}"
            raise refusal("column-missing", contents.name, text, cure="A column is called '/topic.field'.")
    if not fields:
        raise refusal("profile-wrong", contents.name, f"no column of a topic is wanted; topics are {sorted(topics)}")
    for topic, paths in fields.items():
        for one in paths:
            times, values = _column(topics[topic], one)
            if values is None:
                continue
            contents.add(f"{topic}.{one}", values, topics[topic].kind, "ns" if times else "")
    if contents.wanted:
        _join(contents, {topic: topics[topic] for topic in fields})


def _named(path: Path) -> Path:
    """Give a file the ending by which the library knows it."""
    with path.open("rb") as file:
        head = file.read(8)
    return path.rename(path.with_suffix(next((end for magic, end in _ENDINGS if head.startswith(magic)), path.suffix)))


def _recorded(contents: Contents, paths: list[Path]) -> dict[str, _Topic]:
    topics: dict[str, _Topic] = {}
    try:
        with AnyReader(paths, default_typestore=get_typestore(Stores.LATEST)) as bag:
            for connection in bag.connections:
                known = topics.setdefault(connection.topic, _Topic(connection.msgtype))
                if known.kind != connection.msgtype:
                    text = (
                        f"topic {connection.topic!r} has messages of two types, {known.kind} and {connection.msgtype}"
                    )
                    raise refusal("unsupported", contents.name, text, "one", "Filter the bag to one publisher.")
                contents.attributes[f"{connection.topic}@type"] = connection.msgtype
            for number, (connection, received, data) in enumerate(bag.messages(), start=1):
                topic = topics[connection.topic]
                topic.number.append(number)
                topic.received.append(received)
                if not contents.wanted or any(key.startswith(f"{connection.topic}.") for key in contents.wanted):
                    try:
                        # no message begins so: CDR begins with two bytes that say how it is written
                        data = zstd.decompress(data) if data.startswith(_ZSTD) else data
                        topic.messages.append(bag.deserialize(data, connection.msgtype))
                    except (AnyReaderError, KeyError) as error:
                        reason = f"has messages of type {connection.msgtype!r} that cannot be read ({error}). {_CLOSE}"
                        if contents.wanted:
                            raise LogError(
                                f"{contents.name}: topic {connection.topic!r} {reason}", code="unsupported"
                            ) from error
                        contents.refused[connection.topic] = reason
    except AnyReaderError as error:
        raise refusal("damaged", contents.name, f"cannot be read as a bag: {error}", cure=_CLOSE) from error
    if not topics:
        raise refusal("empty", contents.name, "holds no topics", "recorded messages")
    return topics


def _plain(value: Any) -> Any:
    """Return a time or duration as whole nanoseconds, anything else as it is."""
    return value.sec * 10**9 + value.nanosec if getattr(value, "__msgtype__", None) in _TIMES else value


def _paths(message: Any, path: str = "") -> list[str]:
    """Return the fields of a message that are numbers or texts."""
    value = _plain(message)
    if isinstance(value, bool | int | float | str | np.generic):
        return [path]
    if isinstance(value, list | np.ndarray):
        return [p for i, part in enumerate(value[:LISTED_ELEMENTS]) for p in _paths(part, f"{path}[{i}]")]
    names = [name for name in getattr(value, "__dataclass_fields__", ()) if not name.startswith("__")]
    return [p for name in names for p in _paths(getattr(value, name), f"{path}.{name}" if path else name)]


def _column(topic: _Topic, path: str) -> tuple[bool, Any]:
    """Return whether a field holds times, and its values."""
    if path == RECEIVED:
        return True, np.array(topic.received, np.int64)
    steps = [(name, int(index or 0)) for name, index in _STEP.findall(path)]

    def part(message: Any) -> Any:
        for name, index in steps:
            message = getattr(message, name) if name else message[index]
        return message

    try:
        values = [part(message) for message in topic.messages]
        return getattr(values[0], "__msgtype__", None) in _TIMES, np.array([_plain(value) for value in values])
    except (AttributeError, IndexError, TypeError, ValueError):
        return False, None


def _join(contents: Contents, topics: dict[str, _Topic]) -> None:
    """Put the columns of topics on the union of their times."""
    axis = STAMP if STAMP in contents.wanted else RECEIVED
    times: dict[str, Integers] = {}
    for name, topic in topics.items():
        found = _column(topic, _HEADER if axis == STAMP else RECEIVED)[1]
        if found is None or found.dtype.kind != "i":
            text = f"{STAMP!r} is wanted, but messages of {name!r} have no header"
            raise refusal("column-missing", contents.name, text, cure=f"Take time from {RECEIVED!r}.")
        times[name] = found
    keys = {name: np.stack([found, _repetition(found)], axis=1) for name, found in times.items()}
    union, inverse = np.unique(np.concatenate(list(keys.values())), axis=0, return_inverse=True)
    place = dict(zip(keys, np.split(inverse.reshape(-1), np.cumsum([len(k) for k in keys.values()])[:-1]), strict=True))
    time, rows = union[:, 0], np.full(len(union), np.iinfo(np.int64).max)
    if len(topics) == 1:
        ((name, found),) = times.items()
        place, time, rows = {name: np.arange(len(found))}, found, np.array(topics[name].number)
    else:
        for name, topic in topics.items():
            if (back := np.diff(times[name]) < 0).any():
                at = topic.number[int(np.argmax(back)) + 1]
                contents.warnings.append(
                    f"{axis} of {name!r} goes back at message {at}; rows were put in order of time"
                )
            np.minimum.at(rows, place[name], topic.number)
    contents.row = rows
    for key in contents.columns:
        name = max((t for t in topics if key.startswith(f"{t}.")), key=len)
        where = f"{contents.name}: {key!r} (take time from {axis!r} or, for stamps of headers, {STAMP!r})"
        contents.columns[key] = with_gaps(where, contents.columns[key], place[name], len(rows))
    contents.add(axis, time, unit="ns")


def _repetition(stamps: Array) -> Integers:
    """Return for each time how many equal ones stand before it."""
    order = np.argsort(stamps, kind="stable")
    starts = np.flatnonzero(np.diff(stamps[order], prepend=stamps[order][:1] - 1))
    result = np.empty(len(stamps), np.int64)
    result[order] = np.arange(len(stamps)) - np.repeat(starts, np.diff(np.append(starts, len(stamps))))
    return result
