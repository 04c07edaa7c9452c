"""Reads ROS 1 bags (``.bag``) and the database files of ROS 2 bags (``.db3``), columns as in
`pipeline.readers.formats.topics`.

A ROS 2 bag is a folder; its samples are in the ``.db3`` or ``.mcap`` files in it, which are read one behind the other
(`pipeline.intake.bags` says which). Records are walked in order, so that a
bag that was never closed or indexed is read up to its end.
"""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing

from pipeline.base.errors import LogError
from pipeline.readers.formats.recording import Recording, Topic
from pipeline.readers.formats.topics import bag_reader
from pipeline.readers.safety import allowed_bytes, unpack

_BAG = b"#ROSBAG V2.0\n"
_SQLITE = b"SQLite format 3\0"
_ZSTD = b"\x28\xb5\x2f\xfd"
_CHUNK, _CONNECTION, _MESSAGE = 5, 7, 2
_WAL = slice(18, 20)
"""Bytes of a database that say how it is journalled."""


def scan_file(name: str, data: bytes, recording: Recording) -> None:
    """Add the records of one file to the recording (`topics.ScanFile`)."""
    if data.startswith(_BAG):
        _scan_ros1(name, data, recording)
    elif data.startswith(_SQLITE):
        _scan_ros2(name, data, recording)
    elif data.startswith(_ZSTD):
        raise LogError(f"{name} is packed as a whole. Unpack it: zstd -d {name}", code="unsupported")
    else:
        raise LogError(
            f"{name} is no ROS bag: it begins with {data[:16]!r}; expected a .bag of version 2.0 or a .db3 file. "
            'Correct `format` in the profile (an .mcap file has format = "mcap").',
            code="unsupported",
        )


def _scan_ros1(name: str, data: bytes, recording: Recording) -> None:
    topics: dict[bytes, str] = {}
    left = allowed_bytes(len(data))

    def visit(fields: dict[str, bytes], body: memoryview) -> None:
        nonlocal left
        kind = fields.get("op", b"\0")[0]
        if kind == _CHUNK:
            records = unpack(name, fields["compression"].decode(), body, left, len(data))
            left -= len(records)
            if _walk(memoryview(records), 0, visit) != len(records):
                raise ValueError("a chunk ends inside a record")
        elif kind == _CONNECTION and fields["conn"] not in topics:
            inner = _fields(body)
            topic = topics[fields["conn"]] = fields["topic"].decode()
            definition = inner["message_definition"].decode("utf-8", "replace")
            recording.add_topic(name, Topic(topic, inner["type"].decode(), "ros1", "msg", definition))
        elif kind == _MESSAGE:
            seconds, nanoseconds = struct.unpack("<II", fields["time"])
            recording.add_message(topics[fields["conn"]], seconds * 10**9 + nanoseconds, body)

    end = _walk(memoryview(data), len(_BAG), visit)
    if end != len(data):
        recording.cut(end, name)


def _walk(view: memoryview, at: int, visit: Callable[[dict[str, bytes], memoryview], None]) -> int:
    """Visit header and data of each whole record, and return where the last one ends."""
    while at + 8 <= len(view):
        (head,) = struct.unpack_from("<I", view, at)
        start = at + 8 + head
        if start > len(view):
            break
        (length,) = struct.unpack_from("<I", view, start - 4)
        if start + length > len(view):
            break
        visit(_fields(view[at + 4 : at + 4 + head]), view[start : start + length])
        at = start + length
    return at


def _fields(view: memoryview) -> dict[str, bytes]:
    fields: dict[str, bytes] = {}
    at = 0
    while at < len(view):
        (length,) = struct.unpack_from("<I", view, at)
        if at + 4 + length > len(view):
            raise ValueError(f"a header field claims {length} bytes, but {len(view) - at - 4} follow")
        key, sign, value = bytes(view[at + 4 : at + 4 + length]).partition(b"=")
        if not sign:
            raise ValueError("a header field has no equals sign")
        fields[key.decode()] = value
        at += 4 + length
    return fields


def _scan_ros2(name: str, data: bytes, recording: Recording) -> None:
    # a database in memory cannot be journalled beside itself, whatever the file says
    image = bytearray(data)
    image[_WAL] = b"\x01\x01"
    with closing(sqlite3.connect(":memory:")) as database:
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max(len(data), 10_000))
        database.deserialize(bytes(image))
        database.execute("PRAGMA trusted_schema = OFF")
        _read_database(name, database, recording, len(data))


def _read_database(name: str, database: sqlite3.Connection, recording: Recording, size: int) -> None:
    tables = {row[0] for row in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    if not {"topics", "messages"} <= tables:
        raise LogError(
            f"{name} is a database without the tables of a ROS 2 bag; it has {sorted(tables)[:20]}. "
            "Correct `format` in the profile, or export the tables as CSV.",
            code="unsupported",
        )
    definitions: dict[str, tuple[str, str]] = {}
    if "message_definitions" in tables:
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        definitions = {
            title: (encoding.removeprefix("ros2"), text) for title, encoding, text in database.execute(query)
        }
    topics: dict[int, str] = {}
    for key, topic, title, encoding in database.execute("SELECT id, name, type, serialization_format FROM topics"):
        topics[key] = topic
        schema, definition = definitions.get(title, ("", ""))
        recording.add_topic(name, Topic(topic, title, encoding, schema, definition))
    left = allowed_bytes(size)
    for key, received, message in database.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY id"):
        if message.startswith(_ZSTD):
            # no message begins so: CDR begins with two bytes that say how it is written
            message = unpack(name, "zstd", message, left, size)
        left -= len(message)
        recording.add_message(topics[key], received, message)


read_frame, list_columns = bag_reader("a ROS bag", scan_file)
