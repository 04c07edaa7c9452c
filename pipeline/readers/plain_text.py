"""Bytes of a text file as text: unpacked (gzip, zstd), decoded as the profile says, line ends made one."""

from __future__ import annotations

import codecs

import pyarrow as pa

from pipeline.errors import LogError
from pipeline.profile_text import TextLayout

LARGEST_TEXT = 256 << 20
"""Bytes of text after unpacking, as many as a file may have that is not packed."""

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
        If the file cannot be unpacked, is longer than `LARGEST_TEXT`, or is not encoded as the profile says.
    """
    text = _decode(layout, name, _unpack(name, data))
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    end = len(text.rstrip(" \t\n"))
    if not end:
        return "", True
    # blank cells at the end of the last row stay, blank lines below it go
    last, line_end, _ = text[end:].partition("\n")
    return text[:end] + last + "\n", bool(line_end)


def _unpack(name: str, data: bytes) -> bytes:
    codec = next((codec for magic, codec in _PACKED.items() if data.startswith(magic)), None)
    if codec is None:
        return data
    try:
        with pa.CompressedInputStream(pa.BufferReader(data), codec) as stream:
            text: bytes = stream.read(LARGEST_TEXT + 1)
    except (OSError, pa.ArrowException) as error:
        raise LogError(f"{name} cannot be unpacked ({codec}): {error}. Copy the file again, or unpack it.") from error
    if len(text) > LARGEST_TEXT:
        raise LogError(f"{name} holds more than {LARGEST_TEXT} bytes of text; expected a log. Split the recording.")
    return text


def _decode(layout: TextLayout, name: str, data: bytes) -> str:
    marked = next((encoding for mark, encoding in _MARKS.items() if data.startswith(mark)), None)
    if marked is not None and marked != layout.encoding:
        raise LogError(
            f"{name} begins with the byte order mark of {marked}, but the profile reads {layout.encoding}. "
            f'Add encoding = "{marked}" to the profile.',
            1,
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
        ) from error
