"""Limits of what a log file may be, and of what reading it may take; beyond one it is refused, naming the limit."""

from __future__ import annotations

LARGEST_LOG = 256 << 20
"""Bytes above which a file is not read, packed or not: 10^6 times a usual log, so it is something else."""

MOST_VALUES = 1 << 26
"""Values of a file: 10^7 rows of six columns; the worker that reads has no memory for many more."""

MOST_ARRAYS = 10_000
"""Columns and arrays of a file: motion capture has some thousands; a damaged file may claim millions of empty ones."""

SMALL_FILE = 64 << 20
"""Bytes that reading any file may take: 10^6 rows of eight columns; a constant column packs 1000 times and more."""

EXPANSION = 30
"""Times its own size that reading a larger file may take; recorded samples pack 1 to 20 times."""

COPIES = 3
"""Times that reading may hold what its file may unpack to, and the file itself: as read, as numbers, as columns."""

SLACK = 32 << 20
"""Memory that a library takes for itself [byte]: caches, buffers, pieces that its allocator asks for."""

CPU_SECONDS, CPU_SECONDS_PER_BYTE = 0.6, 4e-6
"""Processor time for any file, and more for each byte: libraries take 3e-9, ten times that where it is packed, and
other machines are six times slower. Messages, and objects in text, are made one by one: some 20 us for 60 bytes."""

WALL_FACTOR = 30
"""Longest wait in multiples of the processor time, for machines that are busy with other things."""

GRACE_SECONDS = 2.0
"""Wait for a worker to end by itself once its pipes are closed; ending takes some milliseconds."""

LONGEST_LINE = 1 << 20
"""Bytes of a line: 10^4 columns of 17 digits take a fifth of it; a file without line ends has one line."""

LONGEST_HEADER = 1 << 16
"""Bytes searched for the column line; a header is some hundred bytes, a file without one may be huge."""

LONGEST_HEADER_LINE = 1 << 14
"""Bytes of a header line; remarks are some hundred."""

LONGEST_QUANTITY = 200
"""Characters of a number with its unit."""

KEPT_ATTRIBUTES = 100
"""Attributes of a file that are kept beside each of its trials; a workspace dump may hold thousands."""

LONGEST_ATTRIBUTE = 10_000
"""Characters of an attribute that are kept; a remark or a cut row is far shorter, an attribute may be a whole file."""

LISTED_ELEMENTS = 64
"""Elements of one vector that are listed: a robot has fewer, an image has more and is no column."""

LISTED_NAMES = 40
"""Names that a message lists."""

EXACT = 1 << 53
"""Whole numbers up to this one are floats without loss."""

LARGEST = {"time": 1e12, "command": 1e7, "position": 1e5, "force": 1e7, "velocity": 1e6}
"""Largest size of a reading [SI]: more than 100 km or 16,000 turns, 1,000 t and 1,000 km/s are no readings but signs of
missing values (1e20, 3.4e38) or numbers in another unit; one such cell would spoil the numbers of a whole device."""

LARGEST_CONDITION = 1e12
"""Largest stiffness, damping and step [SI]: steel of a metre has 1e11 N/m."""


def allowed_bytes(size: int) -> int:
    """Return how many bytes a file of this size [byte] may unpack to."""
    return min(4 * LARGEST_LOG, max(SMALL_FILE, EXPANSION * size))
