"""Decodes messages of ROS 1, ROS 2 and JSON into Python objects by the definitions in the bag (library rosbags)."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

from pipeline.base.errors import LogError
from pipeline.readers.formats.json_text import DoubledKeyError, load_json
from pipeline.readers.formats.recording import Topic
from pipeline.readers.safety import allowed_bytes, library

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*)*")
_FIELD = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_IDL_MARK = "=" * 80 + "\n"
_TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
_ENCODINGS = ("ros1", "cdr", "json")
_OLDEST, _NEWEST = "ROS2_FOXY", "ROS2_KILTED"


class Decoder:
    """Decodes the messages of a bag.

    Parameters
    ----------
    name : str
        The file.
    topics : mapping of str to Topic
    size : int
        Bytes of the file; no list in a message is longer than what it may unpack to.
    """

    def __init__(self, name: str, topics: Mapping[str, Topic], size: int) -> None:
        self.name, self.topics, self.size = name, topics, size
        self.stores: dict[str, Any] = {}

    def refusal(self, topic: str) -> str | None:
        """Return why a topic cannot be read, or None."""
        info = self.topics[topic]
        if info.encoding not in _ENCODINGS:
            return f"is encoded as {info.encoding[:40]!r}; expected one of {list(_ENCODINGS)}. Convert the bag."
        if info.encoding != "json" and not info.definition and not self._standard(info.type):
            return (
                f"has messages of type {info.type!r}, which the bag does not define and ROS has no fixed definition "
                "of. Convert the bag where the type is installed: ros2 bag convert, to storage mcap."
            )
        return None

    def decode(self, topic: str, data: bytes) -> Any:
        """Return a message: an object of rosbags, or what JSON holds.

        Raises
        ------
        LogError
            If the topic cannot be read.
        Exception
            What rosbags raises on damage; call it inside `safety.reading`.
        """
        info = self.topics[topic]
        if info.encoding == "json":
            try:
                return load_json(data)
            except DoubledKeyError as error:
                inside = f" ({error.place()})" if error.path else ""
                raise LogError(
                    f"{self.name}: key {error.key!r} stands twice in one object of a message of {topic!r}{inside}; "
                    "expected it once, since nobody can tell which value counts. Leave this log out.",
                    code="damaged",
                ) from error
        if topic not in self.stores:
            reason = self.refusal(topic)
            if reason:
                raise LogError(f"{self.name}: topic {topic!r} {reason}", code="unsupported")
            self.stores[topic] = self._store(info)
        store, title = self.stores[topic]
        return store.deserialize_ros1(data, title) if info.encoding == "ros1" else store.deserialize_cdr(data, title)

    def fields(self, message: Any) -> dict[str, Any]:
        """Return the fields of a message; times and durations are whole nanoseconds."""
        names = getattr(message, "__dataclass_fields__", {})
        return {key: _plain(getattr(message, key)) for key in names if not key.startswith("__")}

    def is_time(self, value: Any, step: str | int) -> bool:
        """Return whether a field or element of a message is a time or duration, which `part` gives in ns."""
        inner = value[step] if isinstance(step, int) else getattr(value, step, None)
        return getattr(inner, "__msgtype__", None) in _TIMES

    def part(self, value: Any, step: str | int) -> Any:
        """Return a field or element of a message, or None where it has none."""
        if isinstance(step, int):
            return _plain(value[step]) if hasattr(value, "__getitem__") and step < len(value) else None
        if isinstance(value, dict):
            return value.get(step)
        return _plain(getattr(value, step, None)) if hasattr(value, "__msgtype__") else None

    def _store(self, info: Topic) -> tuple[Any, str]:
        """Return a type store that knows a topic's type, and the type's name in it."""
        types = library("rosbags.typesys", "rosbags", "bags")
        messages = library("rosbags.typesys.msg", "rosbags", "bags")
        title = messages.normalize_msgtype(info.type)
        if not info.definition:
            return types.get_typestore(types.Stores[_NEWEST]), title
        if info.schema == "idl":
            texts = [text.split("\n", 1)[1] if text.startswith("IDL: ") else text for text in _parts(info.definition)]
            found = {key: value for text in texts for key, value in types.get_types_from_idl(text).items()}
        else:
            found = types.get_types_from_msg(info.definition, info.type)
        # the library runs code that holds these names
        _check_names(self.name, info.type, _NAME, found)
        for constants, fields in found.values():
            _check_names(self.name, info.type, _FIELD, [entry[0] for entry in (*constants, *fields)])
        store = type(types.get_typestore(types.Stores.EMPTY))(
            library("rosbags.typesys.stores.empty", "rosbags", "bags"), max_sequence_length=allowed_bytes(self.size)
        )
        store.register(found)
        return store, title

    def _standard(self, title: str) -> bool:
        """Return whether ROS 2 has defined a type in the same way in all its versions."""
        types = library("rosbags.typesys", "rosbags", "bags")
        oldest, newest = (types.get_typestore(types.Stores[key]).fielddefs for key in (_OLDEST, _NEWEST))
        waiting, seen = [title], set()
        while waiting:
            key = waiting.pop()
            if key not in oldest or key not in newest or oldest[key][1] != newest[key][1]:
                return False
            seen.add(key)
            inner = re.findall(r"'([a-z0-9_]+/msg/[A-Za-z0-9]+)'", repr(oldest[key][1]))
            waiting += set(inner) - seen
        return True


def _parts(definition: str) -> list[str]:
    return definition.split(_IDL_MARK)[1:] if definition.startswith(f"{_IDL_MARK}IDL: ") else [definition]


def _check_names(name: str, title: str, pattern: re.Pattern[str], found: Iterable[str]) -> None:
    for key in found:
        if not pattern.fullmatch(key):
            raise LogError(
                f"{name}: the definition of {title[:80]!r} has the name {key[:80]!r}; expected letters, digits and "
                "underscores. The file is damaged; copy it again.",
                code="damaged",
            )


def _plain(value: Any) -> Any:
    """Return a time or duration as whole nanoseconds, anything else as it is."""
    if getattr(value, "__msgtype__", None) in _TIMES:
        return int(value.sec) * 10**9 + int(value.nanosec)
    return value
