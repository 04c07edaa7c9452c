"""Reader of ROS 1 and ROS 2 bags (``.bag``, ``.db3``, ``.mcap``), with columns such as ``/topic.field.sub[3]``.

``/topic.header.stamp`` and every other ROS time or duration is an integer in nanoseconds. ``/topic.@received`` is the
time at which the message was recorded. ``@stamp`` and ``@received`` without a topic are the times of the rows.
"""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.typesys import Stores, get_typestore

from pipeline.base.errors import refusal
from pipeline.profiles.profile_model import Profile
from pipeline.readers.file_columns import LISTED_ELEMENTS, FileColumns, with_gaps
from pipeline.readers.formats.json import column, columns_of
from pipeline.records.trials import Integers

zstd = import_module("compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd")

STAMP, RECEIVED = "@stamp", "@received"
_ZSTD = b"\x28\xb5\x2f\xfd"
_ENDINGS = {b"#ROS": ".bag", b"SQLi": ".db3", b"\x89MCA": ".mcap"}
_TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
_CLOSE = (
    "Repair a recording that was not closed with `rosbag reindex`, `ros2 bag reindex` or `mcap recover`. Convert other "
    "recordings with `ros2 bag convert` on a machine where their message types are installed."
)


class Nanoseconds(int):
    """A ROS time or duration [ns]."""


class _Topic(NamedTuple):
    """Messages of a topic, with their type, their numbers in the bag, their times of reception [ns], and their
    fields."""

    kind: str
    number: list[int]
    received: list[int]
    messages: list[Any]


def read(path: Path, settings: Profile, contents: FileColumns) -> None:
    """Add the fields of messages as columns.

    Columns of a single topic keep the order of recording. For columns of several topics, the rows are the union of
    their times in increasing order, with NaN (or an empty text) if a topic has no message. Nothing is interpolated.
    """
    contents.row_name = "message"
    paths = [
        one.rename(one.with_suffix(_ENDINGS.get(one.read_bytes()[:4], one.suffix)))
        for one in sorted(path.parent.iterdir())
    ]
    topics = _recorded(contents, paths)
    for name, topic in topics.items():
        contents.note(f"{name}@type", topic.kind)
        for key, cells in columns_of(topic.messages).items():
            if contents.wants(path_of := f"{name}.{key}"):
                unit = "ns" if isinstance(next(iter(cells.values())), Nanoseconds) else ""
                array = column(f"{contents.name}: column {path_of!r}", cells, len(topic.messages))
                contents.add(path_of, array, topic.kind, unit)
    if contents.wanted and contents.columns:
        _join(contents, topics)


def _recorded(contents: FileColumns, paths: list[Path]) -> dict[str, _Topic]:
    """Return the topics of a bag. Messages are read only for topics with wanted columns."""
    topics: dict[str, _Topic] = {}
    try:
        with AnyReader(paths, default_typestore=get_typestore(Stores.LATEST)) as bag:
            topics |= {one.topic: _Topic(one.msgtype, [], [], []) for one in bag.connections}
            chosen = {name for name in topics if contents.wants(name)}
            for number, (connection, received, data) in enumerate(bag.messages(), start=1):
                topic = topics[connection.topic]
                topic.number.append(number)
                topic.received.append(received)
                if connection.topic not in chosen:
                    continue
                try:
                    # A valid message does not begin with these bytes, because its first two bytes state the CDR
                    # encoding.
                    data = zstd.decompress(data) if data.startswith(_ZSTD) else data
                    message = bag.deserialize(data, connection.msgtype)
                except (AnyReaderError, KeyError) as error:
                    chosen.discard(connection.topic)
                    topic.messages.clear()
                    reason = f"has messages of type {topic.kind!r} that cannot be read ({error}). {_CLOSE}"
                    contents.refused[connection.topic] = reason
                else:
                    fields = _plain(message, None if contents.wanted else LISTED_ELEMENTS)
                    topic.messages.append({RECEIVED: Nanoseconds(received), **fields})
    except AnyReaderError as error:
        raise refusal("damaged", contents.name, f"cannot be read as a bag: {error}", cure=_CLOSE) from error
    if not topics:
        raise refusal("empty", contents.name, "contains no topics", "recorded messages")
    return topics


def _plain(value: Any, most: int | None) -> Any:
    """Return a message as dicts and lists, with at most the given number of elements of each list."""
    if getattr(value, "__msgtype__", None) in _TIMES:
        return Nanoseconds(value.sec * 10**9 + value.nanosec)
    if hasattr(value, "__dataclass_fields__"):
        return {key: _plain(getattr(value, key), most) for key in value.__dataclass_fields__ if key[:2] != "__"}
    if isinstance(value, np.ndarray):
        return value[:most].tolist()
    return [_plain(part, most) for part in value[:most]] if isinstance(value, list) else value


def _join(contents: FileColumns, topics: dict[str, _Topic]) -> None:
    """Merge columns of several topics on the union of their times, and add the times of the rows."""
    axis = STAMP if STAMP in contents.wanted else RECEIVED
    names = {path: max((name for name in topics if path.startswith(f"{name}.")), key=len) for path in contents.columns}
    used = {name: topics[name] for name in dict.fromkeys(names.values())}
    times = {name: _times(contents.name, axis, name, topic) for name, topic in used.items()}
    place = {name: np.arange(len(found)) for name, found in times.items()}
    if len(times) == 1:
        ((name, time),) = times.items()
        contents.row = np.array(topics[name].number)
    else:
        keys = np.concatenate([_numbered(found) for found in times.values()])
        union, inverse = np.unique(keys, axis=0, return_inverse=True)
        ends = np.cumsum([len(found) for found in times.values()])[:-1]
        place, time = dict(zip(times, np.split(inverse.reshape(-1), ends), strict=True)), union[:, 0]
        contents.row = np.full(len(union), np.iinfo(np.int64).max)
        for name in times:
            np.minimum.at(contents.row, place[name], topics[name].number)
    for path, name in names.items():
        contents.columns[path] = with_gaps(contents.columns[path], place[name], len(contents.row))
    contents.add(axis, time, unit="ns")


def _times(where: str, axis: str, name: str, topic: _Topic) -> Integers:
    """Return the stamps or the times of reception of messages."""
    if axis == RECEIVED:
        return np.array(topic.received, np.int64)
    stamps = [message["header"]["stamp"] for message in topic.messages if "header" in message]
    if not stamps:
        text = f"{STAMP!r} is wanted, but messages of {name!r} have no header"
        raise refusal("column-missing", where, text, cure=f"Take time from {RECEIVED!r}.")
    return np.array(stamps, np.int64)


def _numbered(times: Integers) -> Integers:
    """Return times, each with the number of equal times before it, so that equal times of a topic stay separate
    rows."""
    order = np.argsort(times, kind="stable")
    number = np.empty_like(times)
    number[order] = np.arange(len(times)) - np.searchsorted(times[order], times[order])
    return np.stack([times, number], axis=1)
