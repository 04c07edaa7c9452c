"""Pages of a column in a damaged Parquet file: found by their headers, and read by pyarrow in a file of their own.

pyarrow reads the pages of a column one after the other and stops at the first that is damaged. Here a damaged stretch
is skipped: the next page begins where a header can be read whose checksum fits what follows it. Each page is then put
into a small file, whose footer is that of the damaged one with another number of rows, and pyarrow decodes it.

Source: Apache Parquet, parquet.thrift; Thrift compact protocol.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.records.batch import Booleans

_STOP, _TRUE, _FALSE, _BYTE, _I16, _I64, _DOUBLE, _BINARY, _LIST, _SET, _STRUCT = 0, 1, 2, 3, 4, 6, 7, 8, 9, 10, 12
_SHORT = 15
"""Lists of fewer elements have their number in the first byte."""

Struct = dict[int, tuple[int, Any]]
"""A Thrift structure: type and value of each field, by its number."""


class NoThriftError(ValueError):
    """Bytes hold no Thrift structure."""


@dataclass
class _Reader:
    data: bytes
    at: int

    def byte(self) -> int:
        if self.at >= len(self.data):
            raise NoThriftError("ends early")
        self.at += 1
        return self.data[self.at - 1]

    def varint(self) -> int:
        value = shift = 0
        while True:
            byte = self.byte()
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value
            shift += 7
            if shift > 63:
                raise NoThriftError("number is too long")

    def zigzag(self) -> int:
        value = self.varint()
        return (value >> 1) ^ -(value & 1)

    def bytes(self, count: int) -> bytes:
        if self.at + count > len(self.data):
            raise NoThriftError("ends early")
        self.at += count
        return self.data[self.at - count : self.at]

    def value(self, kind: int) -> Any:
        if kind in (_TRUE, _FALSE):
            return kind == _TRUE
        if kind == _BYTE:
            return self.byte()
        if kind < _DOUBLE:
            return self.zigzag()
        if kind == _DOUBLE:
            return self.bytes(8)
        if kind == _BINARY:
            return self.bytes(self.varint())
        if kind in (_LIST, _SET):
            head = self.byte()
            count = head >> 4 if head >> 4 < _SHORT else self.varint()
            element = head & 0x0F
            if count > len(self.data):
                raise NoThriftError("list is too long")
            return element, [self.byte() if element in (_TRUE, _FALSE) else self.value(element) for _ in range(count)]
        if kind == _STRUCT:
            return self.struct()
        raise NoThriftError(f"unknown type {kind}")

    def struct(self) -> Struct:
        fields: Struct = {}
        number = 0
        while (head := self.byte()) != _STOP:
            number = number + (head >> 4) if head >> 4 else self.zigzag()
            fields[number] = head & 0x0F, self.value(head & 0x0F)
        return fields


def _varint(value: int) -> bytes:
    out = bytearray()
    while value >= 0x80:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _packed(kind: int, value: Any) -> bytes:
    if kind in (_TRUE, _FALSE):
        return b""
    if kind == _BYTE:
        return bytes([value])
    if kind < _DOUBLE:
        return _varint(value << 1 if value >= 0 else (-value << 1) - 1)
    if kind == _DOUBLE:
        return bytes(value)
    if kind == _BINARY:
        return _varint(len(value)) + bytes(value)
    if kind in (_LIST, _SET):
        element, items = value
        head = (
            bytes([len(items) << 4 | element]) if len(items) < _SHORT else bytes([0xF0 | element]) + _varint(len(items))
        )
        return head + b"".join(bytes([i]) if element in (_TRUE, _FALSE) else _packed(element, i) for i in items)
    return b"".join(
        bytes([field_kind]) + _packed(_I16, number) + _packed(field_kind, field)
        for number, (field_kind, field) in value.items()
    ) + bytes([_STOP])


_DATA, _DICTIONARY = 0, 2
"""Kinds of page that are written here."""

_PAGE_START = b"\x15\x00\x15"
"""Header of a data page: its first field is the kind, and the next one is a number, too."""

_MAGIC = b"PAR1"


@dataclass(frozen=True)
class _Page:
    """A page: kind, number of rows, its bytes with the header; None for those of a damaged one."""

    kind: int
    rows: int
    data: bytes | None
    end: int


class DamagedColumns:
    """Columns of a damaged file, by its footer.

    Parameters
    ----------
    content : bytes
        The file up to its pages' end.
    footer : bytes
        With its ending.
    """

    def __init__(self, content: bytes, footer: bytes) -> None:
        self._content = content
        self._footer = _Reader(footer, 0).struct()

    def read(self, group: int, index: int) -> tuple[pa.Array, Booleans]:
        """Return the values of a column in a group of rows, and which of them could be read; null where not."""
        rows_of = self._footer[4][1][1][group]
        rows = rows_of[3][1]
        column = rows_of[1][1][1][index][3][1]
        start = column[11][1] if 11 in column else column[9][1]
        dictionary, placed = _placed(self._content[start : start + column[7][1]], rows)
        values = pa.nulls(0)
        parts: list[pa.Array] = []
        known = np.zeros(rows, np.bool_)
        at = 0
        for first, page in placed:
            try:
                values = self._decoded(index, column, dictionary, page)
            except (pa.ArrowException, OSError, ValueError):  # by a dictionary that is damaged
                continue
            parts += [pa.nulls(first - at, values.type), values]
            at = first + page.rows
            known[first:at] = True
        return pa.concat_arrays([*parts, pa.nulls(rows - at, values.type)]), known

    def _decoded(self, index: int, column: Struct, dictionary: bytes, page: _Page) -> pa.Array:
        root, *columns = self._footer[2][1][1]
        pages = dictionary + (page.data or b"")
        places: Struct = {5: (_I64, page.rows), 7: (_I64, len(pages)), 9: (_I64, len(_MAGIC) + len(dictionary))}
        if dictionary:
            places[11] = (_I64, len(_MAGIC))
        described = dict(sorted(({number: column[number] for number in (1, 2, 3, 4, 6)} | places).items()))
        chunk: Struct = {2: (_I64, 0), 3: (_STRUCT, described)}
        group: Struct = {1: (_LIST, (_STRUCT, [chunk])), 2: (_I64, len(pages)), 3: (_I64, page.rows)}
        schema = [root | {5: (root[5][0], 1)}, columns[index]]
        footer = _packed(
            _STRUCT,
            {
                1: self._footer[1],
                2: (_LIST, (_STRUCT, schema)),
                3: (_I64, page.rows),
                4: (_LIST, (_STRUCT, [group])),
            },
        )
        file = _MAGIC + pages + footer + len(footer).to_bytes(4, "little") + _MAGIC
        return pq.read_table(pa.BufferReader(file)).column(0).combine_chunks()


def _placed(chunk: bytes, rows: int) -> tuple[bytes, list[tuple[int, _Page]]]:
    """Return the dictionary of a column, and its whole data pages with their first row."""
    pages = list(_pages(chunk))
    dictionary = next((page.data or b"" for page in pages if page is not None and page.kind == _DICTIONARY), b"")
    found = [page for page in pages if page is None or page.kind == _DATA]
    gaps = [place for place, page in enumerate(found) if page is None]
    if not gaps and sum(page.rows for page in found if page is not None) != rows:
        gaps = [place for place, page in enumerate(found) if page is not None and page.data is None]
    # rows are counted from the begin up to the first page whose number of rows is not known, and from the end
    head, tail = (found[: gaps[0]], found[gaps[-1] + 1 :]) if gaps else (found, [])
    placed = []
    for first, part in ((0, head), (rows - sum(page.rows for page in tail if page is not None), tail)):
        for page in part:
            assert page is not None, "gaps are cut out"
            if page.data is not None and 0 <= first <= rows - page.rows:
                placed.append((first, page))
            first += page.rows
    return dictionary, placed


def _pages(chunk: bytes) -> Iterator[_Page | None]:
    """Yield the pages of a column; None for a stretch in which no header can be trusted."""
    at = 0
    while at < len(chunk):
        page = _page_at(chunk, at)
        if page is None or (page.data is None and page.end < len(chunk) and _page_at(chunk, page.end) is None):
            yield None
            at = chunk.find(_PAGE_START, at + 1)
            while at >= 0 and ((page := _page_at(chunk, at)) is None or page.data is None):
                at = chunk.find(_PAGE_START, at + 1)
            if at < 0:
                return
            assert page is not None, "the search ends at a page"
        yield page
        at = page.end


def _page_at(chunk: bytes, at: int) -> _Page | None:
    """Return the page that begins at a byte, without its data where its checksum differs; None where none can."""
    reader = _Reader(chunk, at)
    try:
        header = reader.struct()
        kind, size, checksum = (header[number][1] for number in (1, 3, 4))
        rows = header[5 if kind == _DATA else 7][1][1][1]
    except (NoThriftError, KeyError, TypeError, IndexError, RecursionError):
        return None
    end = reader.at + size
    if kind not in (_DATA, _DICTIONARY) or rows < 0 or not reader.at <= end <= len(chunk):
        return None
    whole = zlib.crc32(chunk[reader.at : end]) == checksum & 0xFFFFFFFF
    return _Page(kind, rows, chunk[at:end] if whole else None, end)
