"""Bytes of a text file as text: unpacked (gzip, zstd), decoded as the profile says, line ends made one."""

from __future__ import annotations

import codecs

import numpy as np
import pyarrow as pa

from pipeline.base.errors import LogError
from pipeline.profiles.profile_text import TextLayout
from pipeline.readers.limits import LARGEST_TEXT, LONGEST_LINE
from pipeline.readers.safety import check_claim

_BLOCK = 1 << 22
"""Bytes that are searched for line ends at once."""

LONGEST_CHARACTER = 4
"""Bytes of the longest character in UTF-8 and UTF-16: a cut file lacks fewer than that."""

_PACKED = {b"\x1f\x8b": "gzip", b"\x28\xb5\x2f\xfd": "zstd"}
"""First bytes of packed files."""

_MARKS = {codecs.BOM_UTF8: "utf-8", codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}
"""Byte order marks, and the encoding that each stands for."""


def plain_text(layout: TextLayout, name: str, data: bytes) -> tuple[str, bool]:
    """Return the text of a file without blanks at its end, and whether the last line had a line end.

    Lines are parted by one line feed each, and the last one ends with one.

    Raises
    ------
    LogError
        If the file cannot be unpacked, is longer than `LARGEST_TEXT`, has a line longer than `LONGEST_LINE`, or is not
        encoded as the profile says.
    """
    raw = unpacked(name, data)
    check_lines(name, raw)
    text = _decode(layout, name, raw)
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    end = len(text.rstrip(" \t\n"))
    if not end:
        return "", True
    # blank cells at the end of the last row stay, blank lines below it go
    last, line_end, _ = text[end:].partition("\n")
    return text[:end] + last + "\n", bool(line_end)


def is_packed(data: bytes) -> bool:
    """Return whether a file begins as packed ones do."""
    return data.startswith(tuple(_PACKED))


def unpacked(name: str, data: bytes) -> bytes:
    """Return the bytes of a text file, unpacked where it is packed by gzip or zstd.

    Raises
    ------
    LogError
        If it cannot be unpacked, or holds more than its size makes likely (`safety.allowed_bytes`) or `LARGEST_TEXT`.
    """
    codec = next((codec for magic, codec in _PACKED.items() if data.startswith(magic)), None)
    if codec is None:
        return data
    parts: list[bytes] = []
    total = 0
    try:
        with pa.CompressedInputStream(pa.BufferReader(data), codec) as stream:
            while part := stream.read(_BLOCK):
                parts.append(part)
                total += len(part)
                check_claim(name, "packed text", total, len(data), LARGEST_TEXT)
    except (OSError, pa.ArrowException) as error:
        raise LogError(
            f"{name} cannot be unpacked ({codec}): {error}. Copy the file again, or unpack it.", code="damaged"
        ) from error
    return b"".join(parts)


def check_lines(name: str, data: bytes) -> None:
    """Refuse a text with a line longer than `LONGEST_LINE`.

    Raises
    ------
    LogError
        With the number of that line.
    """
    if len(data) <= LONGEST_LINE:
        return
    last, lines = -1, 0
    for start in range(0, len(data), _BLOCK):
        block = np.frombuffer(data, np.uint8, min(_BLOCK, len(data) - start), start)
        ends = np.flatnonzero((block == ord("\n")) | (block == ord("\r"))) + start
        lengths = np.diff(ends, prepend=last, append=start + len(block)) - 1
        if (lengths > LONGEST_LINE).any():
            at = int(np.argmax(lengths > LONGEST_LINE))
            row = lines + data.count(b"\n", start, int(ends[at - 1]) + 1 if at else start) + 1
            raise LogError(
                f"{name} has a line of more than {LONGEST_LINE} bytes; expected one line for each sample. If it is no "
                "text, correct `format` in the profile; otherwise export it with line ends.",
                row,
                code="too-long-line",
            )
        last = int(ends[-1]) if len(ends) else last
        lines += data.count(b"\n", start, start + len(block))


def _decode(layout: TextLayout, name: str, data: bytes) -> str:
    marked = next((encoding for mark, encoding in _MARKS.items() if data.startswith(mark)), None)
    if marked is not None and marked != layout.encoding:
        raise LogError(
            f"{name} begins with the byte order mark of {marked}, but the profile reads {layout.encoding}. "
            f'Add encoding = "{marked}" to the profile.',
            1,
            code="encoding",
            profile_line=f'encoding = "{marked}"',
        )
    codec = "utf-8-sig" if layout.encoding == "utf-8" else layout.encoding
    try:
        return data.decode(codec)
    except UnicodeDecodeError as error:
        if error.end >= len(data) and error.start > max(len(data) - LONGEST_CHARACTER, 0):
            # the recording was cut inside a character; its row is found to be cut, too
            return data[: error.start].decode(codec)
        raise LogError(
            f"{name} is no {layout.encoding.upper()} text ({error.reason}, byte {data[error.start]:#04x} at "
            f'{error.start}). If it was written on Windows or by an older tool, add encoding = "latin-1" (or "cp1252", '
            '"utf-16") to the profile; otherwise repair the line.',
            data.count(b"\n", 0, error.start) + 1,
            code="encoding",
            profile_line='encoding = "latin-1"',
        ) from error
