"""Reads MCAP files with messages of ROS 1, ROS 2 (CDR) or JSON; columns as in `pipeline.readers.formats.topics`.

The records are walked here in order and not by the reader of rosbags, which needs the index at the end (missing where a
recording was cut), takes only the profile "ros2", and unpacks without a bound.
"""

from __future__ import annotations

import struct
from zlib import crc32

from pipeline.base.errors import LogError
from pipeline.readers.formats.recording import Recording, Topic
from pipeline.readers.formats.topics import bag_reader
from pipeline.readers.safety import allowed_bytes, unpack

MAGIC = b"\x89MCAP0\r\n"
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _FOOTER = 0x03, 0x04, 0x05, 0x06, 0x02
_SCHEMAS = {"ros1msg": "msg", "ros2msg": "msg", "ros2idl": "idl", "omgidl": "idl"}


def scan_file(name: str, data: bytes, recording: Recording) -> None:
    """Add the records of one file to the recording (`topics.ScanFile`)."""
    if not data.startswith(MAGIC):
        raise LogError(
            f"{name} is no MCAP file: it begins with {data[:8]!r}, not {MAGIC!r}. Correct `format` in the profile.",
            code="unsupported",
        )
    scanner = _Scanner(name, data, recording)
    end = scanner.walk(memoryview(data), len(MAGIC), True)
    if data[end : end + 1] != bytes([_FOOTER]):
        recording.cut(end, name)


class _Scanner:
    def __init__(self, name: str, data: bytes, recording: Recording) -> None:
        self.name, self.size, self.recording = name, len(data), recording
        self.left = allowed_bytes(len(data))
        self.schemas: dict[int, tuple[str, str, str]] = {}
        self.channels: dict[int, str] = {}

    def walk(self, view: memoryview, at: int, outside: bool) -> int:
        """Walk through the records of the file, or of a chunk in it, and return where the last whole one ends."""
        while at + 9 <= len(view):
            kind, length = struct.unpack_from("<BQ", view, at)
            if kind == _FOOTER and outside:
                return at
            body = view[at + 9 : at + 9 + length]
            if len(body) < length:
                break
            if kind == _SCHEMA:
                self._schema(body)
            elif kind == _CHANNEL:
                self._channel(body)
            elif kind == _MESSAGE:
                channel, _, received, _ = struct.unpack_from("<HIQQ", body)
                self.recording.add_message(self.channels[channel], received, body[22:])
            elif kind == _CHUNK and outside:
                self._chunk(body)
            at += 9 + length
        return at

    def _schema(self, body: memoryview) -> None:
        (key,) = struct.unpack_from("<H", body)
        title, at = _text(body, 2)
        encoding, at = _text(body, at)
        definition, _ = _text(body, at)
        self.schemas[key] = (title, encoding, definition)

    def _channel(self, body: memoryview) -> None:
        key, schema = struct.unpack_from("<HH", body)
        topic, at = _text(body, 4)
        encoding, _ = _text(body, at)
        title, written, definition = self.schemas.get(schema, ("", "", ""))
        self.channels[key] = topic
        self.recording.add_topic(self.name, Topic(topic, title, encoding, _SCHEMAS.get(written, ""), definition))

    def _chunk(self, body: memoryview) -> None:
        _, _, size, checksum = struct.unpack_from("<QQQI", body)
        packing, at = _text(body, 28)
        (length,) = struct.unpack_from("<Q", body, at)
        if len(body) < at + 8 + length:
            raise ValueError(f"a chunk claims {length} bytes, but {len(body) - at - 8} follow")
        records = unpack(self.name, packing, body[at + 8 : at + 8 + length], self.left, self.size)
        self.left -= len(records)
        if len(records) != size or (checksum and crc32(records) != checksum):
            raise ValueError("a chunk does not have the size and checksum that it states")
        if self.walk(memoryview(records), 0, False) != len(records):
            raise ValueError("a chunk ends inside a record")


def _text(body: memoryview, at: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", body, at)
    if at + 4 + length > len(body):
        raise ValueError(f"a text claims {length} bytes, but {len(body) - at - 4} follow")
    return bytes(body[at + 4 : at + 4 + length]).decode(), at + 4 + length


read_frame, list_columns = bag_reader("an MCAP file", scan_file)
