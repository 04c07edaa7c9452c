"""A seal inside a Parquet file: checksums of every other byte of the file, and parity by which small damage is undone.

Parquet has checksums of pages at most: a flipped byte in a page's header, in the footer or in the metadata is read as
another value, or as none. A sealed file has, between its last page and its footer, where Parquet allows foreign bytes::

    pages | annex | CRC-32 of each block | parity | trailer | footer

A block is a stretch of all bytes but the seal's own; parity is the exclusive or of every n-th block. So each changed
byte is noticed (a CRC-32 misses no burst up to 32 bits), and n damaged blocks in a row, a bad sector, are restored
byte by byte. Any reader of Parquet skips the seal. The annex holds what the writer wants to have there.
"""

from __future__ import annotations

import io
import os
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, cast

import numpy as np

from pipeline.base.json_seal import DamageError

_MAGIC = b"pl-seal1"

MARK = "pipeline.seal"
"""Key in the metadata of a sealed file, by which a file whose seal is lost differs from one that never had one."""

_TRAILER = struct.Struct("<QQQIII8s")
"""Bytes before the seal, bytes of all but the seal, bytes of the annex, of a block, blocks of parity, CRC-32, magic."""

_LARGEST_BLOCK = 4096
"""Bytes of a sector of most disks: what is lost at once. A CRC-32 of each costs 0.1 %."""

_SMALLEST_BLOCK = 256
"""Below this the checksums of a file of one short trial cost more than its parity."""

_BLOCKS_PER_PARITY = 256
"""One block of parity for so many costs 0.4 % at most, some 25 bytes of a usual trial."""

_BLOCKS_PER_SECTOR = 64
"""Where a block is less than a sector, parity costs up to one for so many, so that a lost sector is restored."""

_MOST_PARITY = 128
"""Blocks of parity while the length of a file is not known; 0.5 MB of memory."""

_PIECE = _LARGEST_BLOCK * 256
"""Bytes that are worked on at once; a whole number of blocks and of `_MOST_PARITY` of them."""

_LAST = b"PAR1"

_ENDING = 8
"""Bytes behind a footer: its length, and `_LAST`."""


@dataclass(frozen=True)
class Seal:
    """The seal of a file.

    Parameters
    ----------
    start : int
        Its place in the file [byte].
    covered : int
        Bytes that it covers: all others.
    annex : int
        Bytes of the annex, which ends where the seal begins.
    block : int
        Bytes of a block.
    checksums : tuple of int
        CRC-32 of each block.
    parity : uint8, shape (n, block)
    """

    start: int
    covered: int
    annex: int
    block: int
    checksums: tuple[int, ...]
    parity: np.ndarray

    @property
    def size(self) -> int:
        """Bytes of the seal."""
        return 4 * len(self.checksums) + self.parity.size + _TRAILER.size

    def pack(self) -> bytes:
        """Return the seal as it stands in the file."""
        body = np.array(self.checksums, "<u4").tobytes() + self.parity.tobytes()
        fields = (self.start, self.covered, self.annex, self.block, len(self.parity))
        return body + _TRAILER.pack(*fields, _own_checksum(body, fields), _MAGIC)


class SealingStream(io.RawIOBase):
    """Passes on what is written to it, and seals it; a Parquet writer closes between `end_pages` and `finish`."""

    def __init__(self, target: BinaryIO) -> None:
        super().__init__()
        self._target = target
        self._size = 0
        self._pending = bytearray()
        self._checksums: list[int] = []
        self._parity = np.zeros((0, _LARGEST_BLOCK), np.uint8)
        self._footer: bytearray | None = None

    def writable(self) -> bool:
        """Return True, as a Parquet writer asks."""
        return True

    def tell(self) -> int:
        """Return the number of bytes that were written to it, but for the seal."""
        return self._size + len(self._footer or b"")

    def write(self, data: object) -> int:
        """Pass bytes on; keep those of the footer."""
        content = cast(bytes, data)
        if self._footer is not None:
            self._footer += content
        else:
            self._target.write(content)
            self._size += len(content)
            self._take(content)
        return len(content)

    def end_pages(self) -> None:
        """What is written from here on is the footer."""
        self._footer = bytearray()

    def finish(self, annex: bytes = b"") -> bytes:
        """Write annex, seal and footer; return the footer."""
        footer = bytes(self._footer or b"")
        self._footer = None
        self.write(annex)
        start = self._size
        self._take(footer)
        seal = self._seal(start, start + len(footer), len(annex))
        self._target.write(seal.pack())
        self._target.write(footer)
        return footer

    def _take(self, data: bytes) -> None:
        self._pending += data
        while len(self._pending) >= _PIECE:
            piece = self._pending[:_PIECE]
            del self._pending[:_PIECE]
            if not len(self._parity):
                self._parity = np.zeros((_MOST_PARITY, _LARGEST_BLOCK), np.uint8)
            self._checksums += _checksums(piece, _LARGEST_BLOCK)
            self._parity ^= _parity(piece, _LARGEST_BLOCK, _MOST_PARITY)

    def _seal(self, start: int, covered: int, annex: int) -> Seal:
        block = _LARGEST_BLOCK if len(self._parity) else _block(covered)
        checksums = (*self._checksums, *_checksums(self._pending, block))
        lanes = _lanes(len(checksums), block)
        parity = _parity(self._pending, block, _MOST_PARITY if len(self._parity) else lanes)
        if len(self._parity):
            parity ^= self._parity
        while len(parity) > lanes:
            half = len(parity) // 2
            parity = parity[:half] ^ parity[half:]
        return Seal(start, covered, annex, block, checksums, parity)


def sealed(data: bytes, annex: bytes = b"") -> bytes:
    """Return a Parquet file with a seal, and an annex that it covers."""
    cut = _footer_start(io.BytesIO(data), len(data))
    target = io.BytesIO()
    stream = SealingStream(target)
    stream.write(data[:cut])
    stream.end_pages()
    stream.write(data[cut:])
    stream.finish(annex)
    return target.getvalue()


def find_seal(stream: BinaryIO) -> Seal | None:
    """Return the seal of an open file, None where it has none that is whole."""
    size = stream.seek(0, os.SEEK_END)
    found = _seal_before(stream, _footer_start(stream, size))
    if found is not None:
        return found
    # the footer's length may be damaged, or the end of the file be lost
    stream.seek(0)
    data = stream.read()
    at = data.rfind(_MAGIC)
    while at >= 0:
        found = _seal_before(stream, at + len(_MAGIC))
        if found is not None:
            return found
        at = data.rfind(_MAGIC, 0, at)
    return None


def damaged_blocks(stream: BinaryIO, seal: Seal) -> list[int]:
    """Return the blocks whose checksum differs, those that are not there included."""
    found = []
    step = _PIECE // seal.block
    for first in range(0, len(seal.checksums), step):
        expected = seal.checksums[first : first + step]
        count = min(len(expected) * seal.block, seal.covered - first * seal.block)
        piece = _covered(stream, seal, first * seal.block, count)
        # what a shorter file lacks has no checksum, which equals no number
        present = [*_checksums(piece, seal.block), *[-1] * len(expected)]
        found += [first + i for i, checksum in enumerate(expected) if checksum != present[i]]
    return found


def verify(path: Path) -> bool:
    """Hold a file against its seal; return whether it has one.

    Raises
    ------
    DamageError
        If a byte is not as it was written.
    OSError
        If it cannot be read.
    """
    with open(path, "rb") as stream:
        size = stream.seek(0, os.SEEK_END)
        start = _footer_start(stream, size)
        seal = _seal_before(stream, start)
        if seal is None:
            stream.seek(max(start, 0))
            footer = stream.read()
            if start > 0 and footer.endswith(_LAST) and MARK.encode() not in footer:
                return False
            raise DamageError(f"its end is not as it was written ({size} bytes)")
        blocks = damaged_blocks(stream, seal)
        if blocks:
            raise DamageError(f"{len(blocks)} of {len(seal.checksums)} blocks differ from their checksums")
        return True


def mended(data: bytes) -> bytes | None:
    """Return the content of a damaged file as it was written, None where the parity does not suffice."""
    stream = io.BytesIO(data)
    seal = find_seal(stream)
    if seal is None:
        return None
    content = bytearray(_covered(stream, seal, 0, seal.covered).ljust(seal.covered, b"\0"))
    lanes = len(seal.parity)
    broken = {block: slice(block * seal.block, (block + 1) * seal.block) for block in damaged_blocks(stream, seal)}
    if len({block % lanes for block in broken}) < len(broken):
        return None
    for place in broken.values():
        content[place] = bytes(len(content[place]))
    missing = _parity(content, seal.block, lanes) ^ seal.parity
    for block, place in broken.items():
        content[place] = missing[block % lanes].tobytes()[: len(content[place])]
        if _checksums(content[place], seal.block) != [seal.checksums[block]]:
            return None
    return bytes(content[: seal.start]) + seal.pack() + bytes(content[seal.start :])


def read_annex(stream: BinaryIO) -> bytes:
    """Return the annex of an open file, empty where it has none; the caller holds it against the seal or its own."""
    seal = find_seal(stream)
    if seal is None:
        return b""
    stream.seek(seal.start - seal.annex)
    return stream.read(seal.annex)


def footer_of(data: bytes) -> bytes:
    """Return the footer of a whole Parquet file, with its ending."""
    return data[_footer_start(io.BytesIO(data), len(data)) :]


def _footer_start(stream: BinaryIO, size: int) -> int:
    stream.seek(max(size - _ENDING, 0))
    return size - _ENDING - int.from_bytes(stream.read(4), "little")


def _seal_before(stream: BinaryIO, end: int) -> Seal | None:
    """Return the seal that ends at a byte of a file, None where none does."""
    if end < _TRAILER.size:
        return None
    stream.seek(end - _TRAILER.size)
    trailer = stream.read(_TRAILER.size)
    if len(trailer) < _TRAILER.size or not trailer.endswith(_MAGIC):
        return None
    *fields, checksum, _ = _TRAILER.unpack(trailer)
    start, covered, annex, block, lanes = fields
    if not block or end - start != 4 * -(-covered // block) + lanes * block + _TRAILER.size:
        return None
    stream.seek(start)
    body = stream.read(end - start - _TRAILER.size)
    if _own_checksum(body, fields) != checksum:
        return None
    parity = np.frombuffer(body[len(body) - lanes * block :], np.uint8).reshape(lanes, block)
    checksums = np.frombuffer(body[: len(body) - lanes * block], "<u4").tolist()
    return Seal(start, covered, annex, block, tuple(checksums), parity)


def _own_checksum(body: bytes, fields: tuple[int, ...] | list[int]) -> int:
    return zlib.crc32(repr(tuple(fields)).encode(), zlib.crc32(body))


def _covered(stream: BinaryIO, seal: Seal, first: int, count: int) -> bytes:
    """Return covered bytes, as many as there are."""
    before = min(max(seal.start - first, 0), count)
    stream.seek(first)
    head = stream.read(before)
    stream.seek(first + before + seal.size)
    return head + stream.read(count - before)


def _checksums(data: bytes | bytearray, block: int) -> list[int]:
    view = memoryview(data)
    return [zlib.crc32(view[i : i + block]) for i in range(0, len(view), block)]


def _parity(data: bytes | bytearray, block: int, lanes: int) -> np.ndarray:
    """Return the exclusive or of every ``lanes``-th block, the last one filled up with zeros; shape (lanes, block)."""
    rows = -(-len(data) // (block * lanes))
    whole = np.zeros(rows * block * lanes, np.uint8)
    whole[: len(data)] = np.frombuffer(data, np.uint8)
    parity: np.ndarray = np.bitwise_xor.reduce(whole.view(np.uint64).reshape(rows, -1), axis=0)
    return parity.view(np.uint8).reshape(lanes, block)


def _block(covered: int) -> int:
    """Return the bytes of a block of a file of less than `_PIECE` bytes."""
    return min(max(_power_of_two(covered // _BLOCKS_PER_PARITY), _SMALLEST_BLOCK), _LARGEST_BLOCK)


def _lanes(blocks: int, block: int) -> int:
    """Return the number of blocks of parity: a power of two where blocks are of full size."""
    # a sector's worth of bytes may touch one block more than it fills
    sector = min(_LARGEST_BLOCK // block + 1, max(blocks // _BLOCKS_PER_SECTOR, 1))
    return max(min(_power_of_two(blocks // _BLOCKS_PER_PARITY), _MOST_PARITY), sector)


def _power_of_two(number: int) -> int:
    """Return the largest power of two up to a number, at least 1."""
    return 1 << max(number.bit_length() - 1, 0)
