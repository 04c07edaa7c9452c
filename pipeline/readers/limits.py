"""Limits of what a log file may be, and of what reading it may take; beyond one it is refused, naming the limit."""

from __future__ import annotations

LARGEST_LOG = 256 << 20
"""Bytes above which a file is not read, packed or not: 10^6 times a usual log, so it is something else."""

MOST_VALUES = 1 << 26
"""Values of a file: 10^7 rows of six columns; the worker that reads has no memory for many more."""

SMALL_FILE = 64 << 20
"""Bytes that reading any file may take: 10^6 rows of eight columns; a constant column packs 1000 times and more."""

EXPANSION = 30
"""Times its own size that reading a larger file may take; recorded samples pack 1 to 20 times."""

COPIES, SLACK = 3, 32 << 20
"""Times that reading may hold what its file may unpack to, and the file itself: as read, as numbers, as columns; and
memory that a library takes for itself [byte]: caches, buffers, pieces that its allocator asks for."""

CPU_SECONDS, CPU_SECONDS_PER_BYTE = 0.6, 4e-6
"""Processor time for any file, and more for each byte: libraries take 3e-9, ten times that where it is packed, and
other machines are six times slower. Messages, and objects in text, are made one by one: some 20 us for 60 bytes."""

WALL_FACTOR = 30
"""Longest wait in multiples of the processor time, for machines that are busy with other things."""

LONGEST_HEADER = 1 << 16
"""Bytes searched for the column line; a header is some hundred bytes, a file without one may be huge."""

KEPT_ATTRIBUTES, LONGEST_ATTRIBUTE = 100, 10_000
"""Attributes of a file that are kept beside each of its trials, and characters of each: a workspace dump may hold
thousands, an attribute may be a whole file."""

LISTED_ELEMENTS, LISTED_NAMES = 64, 40
"""Elements of one vector that are listed, and names in a message: a robot has fewer, an image has more."""


def allowed_bytes(size: int) -> int:
    """Return how many bytes a file of this size [byte] may unpack to."""
    return min(4 * LARGEST_LOG, max(SMALL_FILE, EXPANSION * size))
