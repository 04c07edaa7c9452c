"""What bags have in common: topics, and messages in the order in which they were recorded."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from pipeline.base.errors import LogError

Parts = tuple[tuple[str, int], ...]
"""Name and bytes of each file of a bag."""

LISTED_MESSAGES = 3
"""Messages of a topic that listing its columns looks at."""


def split(name: str, data: bytes, parts: Parts) -> Iterator[tuple[str, bytes]]:
    """Yield name and content of each file of a bag; without parts there is one.

    >>> list(split("bag", b"abc", (("bag_0", 1), ("bag_1", 2))))
    [('bag_0', b'a'), ('bag_1', b'bc')]
    """
    start = 0
    for part, size in parts or ((name, len(data)),):
        yield part, data[start : start + size]
        start += size


@dataclass(frozen=True)
class Topic:
    """A topic of a bag: name, message type, definition of the type and how messages are encoded.

    ``encoding`` is "ros1", "cdr" or "json"; others cannot be read. ``schema`` is "msg", "idl" or empty (not stated).
    """

    name: str
    type: str
    encoding: str
    schema: str = ""
    definition: str = ""


@dataclass
class Recording:
    """Topics and messages of a bag.

    Parameters
    ----------
    keep : callable
        Which topics' messages are kept, by name.
    most : int, optional
        How many messages of a topic are kept.
    topics : dict of str to Topic
    received : dict of str to list of int
        Time of reception of the messages that are kept [ns since 1970], by topic.
    number : dict of str to list of int
        Which message of the bag each is, counted from 1.
    data : dict of str to list of bytes
    counts : dict of str to int
        Number of messages of each topic.
    warnings : list of str
    """

    keep: Callable[[str], bool]
    most: int | None = None
    topics: dict[str, Topic] = field(default_factory=dict)
    received: dict[str, list[int]] = field(default_factory=dict)
    number: dict[str, list[int]] = field(default_factory=dict)
    data: dict[str, list[bytes]] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    total: int = 0

    def add_topic(self, name: str, topic: Topic) -> None:
        """Add a topic; several publishers of one topic must agree on its type.

        Raises
        ------
        LogError
            If they do not.
        """
        known = self.topics.setdefault(topic.name, topic)
        if (known.type, known.encoding, known.definition) != (topic.type, topic.encoding, topic.definition):
            raise LogError(
                f"{name}: topic {topic.name!r} has messages of two types, {known.type!r} and {topic.type!r} (or two "
                "definitions of one); expected one. Filter the bag so that one publisher is left.",
                code="unsupported",
            )

    def add_message(self, topic: str, received: int, data: bytes | memoryview) -> None:
        """Add a message; only counted where its topic is not kept."""
        self.total += 1
        self.counts[topic] = self.counts.get(topic, 0) + 1
        if self.keep(topic) and (self.most is None or self.counts[topic] <= self.most):
            self.received.setdefault(topic, []).append(received)
            self.number.setdefault(topic, []).append(self.total)
            self.data.setdefault(topic, []).append(bytes(data))

    def cut(self, offset: int, name: str) -> None:
        """Note that a file ends inside a record."""
        self.warnings.append(
            f"recording is cut at byte {offset} of {name}: what follows was left out; "
            f"{self.total} messages stand before it"
        )
