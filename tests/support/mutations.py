"""Damage to logs, seeded: what disks, transfers, editors, terminals and other people's scripts do to a file."""

from __future__ import annotations

import random
import re
import struct
from collections.abc import Callable

NUMBERS = (
    *["nan", "inf", "-inf", "1e999", "-1e999", "1e-999", "0x10", "1_000", "1,000", "1.5.2", "--1", "1e", "+", "-0"],
    *[
        "9223372036854775808",
        "-9223372036854775809",
        "NULL",
        "#N/A",
        "true",
        "1e308",
        "1d5",
        "12:30",
        "1/2",
        "=1+1",
        "<b>1</b>",
    ],
    *("", " ", '"', "'", "9" * 400, "0." + "1" * 400, "1\u00a0000"),
    *("\u0661\u0662\u0663", "\u22121", "\uff11", "\u00bd"),
)
"""What stands where a number was: not finite, too large, of other scripts, signs and languages, formulas and markup."""

_NUMBER = re.compile(r"[+-]?\d+(?:[.,]\d+)?(?:e[+-]?\d+)?")
_SHORT = 64
"""Bytes of a span that is changed."""

Mutation = Callable[[random.Random, bytes], bytes]


def _span(rng: random.Random, data: bytes, longest: int = _SHORT) -> tuple[int, int]:
    start = rng.randrange(len(data) + 1)
    return start, min(len(data), start + rng.randrange(1, longest))


def flip(rng: random.Random, data: bytes) -> bytes:
    copy = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8, 40)) if copy else 0):
        copy[rng.randrange(len(copy))] = rng.choice((0, 0x0A, 0x22, 0x7F, 0x80, 0xFF, rng.randrange(256)))
    return bytes(copy)


def delete(rng: random.Random, data: bytes) -> bytes:
    start, end = _span(rng, data)
    return data[:start] + data[end:]


def insert(rng: random.Random, data: bytes) -> bytes:
    at = rng.randrange(len(data) + 1)
    new = rng.choice(
        (b"\0", b"\r", b"\n", b"\n\n", b",", b";", b'"', b"\x1b[2J", b"#", rng.randbytes(rng.randrange(1, 40)))
    )
    return data[:at] + new * rng.choice((1, 1, 1, 50)) + data[at:]


def truncate(rng: random.Random, data: bytes) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def double(rng: random.Random, data: bytes) -> bytes:
    start, end = _span(rng, data, max(len(data) // 2, 2))
    return data[:end] + data[start:]


def claim(rng: random.Random, data: bytes) -> bytes:
    """Write a large whole number somewhere, as a length or an offset would be."""
    kind = rng.choice(("<I", "<Q", ">I", ">Q", "<H"))
    limit = 1 << (8 * struct.calcsize(kind))
    number = rng.choice((limit - 1, limit // 2 - 1, limit // 2, limit // 16, 10**12 % limit, 1 << 15))
    at = rng.randrange(len(data) + 1)
    return data[:at] + struct.pack(kind, number) + data[at + struct.calcsize(kind) :]


def swap_lines(rng: random.Random, data: bytes) -> bytes:
    lines = data.split(b"\n")
    a, b = rng.randrange(len(lines)), rng.randrange(len(lines))
    lines[a], lines[b] = lines[b], lines[a]
    return b"\n".join(lines)


def repeat_line(rng: random.Random, data: bytes) -> bytes:
    lines = data.split(b"\n")
    at = rng.randrange(len(lines))
    return b"\n".join(lines[:at] + [lines[at]] * rng.choice((2, 2, 500)) + lines[at:])


def number(rng: random.Random, data: bytes) -> bytes:
    text = data.decode("utf-8", "surrogateescape")
    places = list(_NUMBER.finditer(text))
    for place in rng.sample(places, min(len(places), rng.choice((1, 1, 3)))):
        text = text[: place.start()] + rng.choice(NUMBERS) + text[place.end() :]
        places = list(_NUMBER.finditer(text))
    return text.encode("utf-8", "surrogateescape")


def line_ends(rng: random.Random, data: bytes) -> bytes:
    return data.replace(b"\n", rng.choice((b"\r\n", b"\r", b"\n\r", b"\n\n", b"", b"\x0b", b"\x85", b"\xe2\x80\xa8")))


def encode(rng: random.Random, data: bytes) -> bytes:
    text = data.decode("utf-8", "replace")
    return text.encode(rng.choice(("utf-16", "utf-16-le", "utf-32", "utf-8-sig", "cp1252", "cp500")), "replace")


def widen(rng: random.Random, data: bytes) -> bytes:
    """Give one line, or each, very many cells."""
    lines = data.split(b"\n")
    more = rng.choice((b",", b";", b"\t", b",1", b";1")) * rng.choice((1, 20, 12_000))
    at = rng.randrange(len(lines))
    return b"\n".join(line + more if at == 0 or i == at else line for i, line in enumerate(lines))


def remove_line(rng: random.Random, data: bytes) -> bytes:
    lines = data.split(b"\n")
    del lines[rng.randrange(len(lines))]
    return b"\n".join(lines)


def nest(rng: random.Random, data: bytes) -> bytes:
    """Put lists around what is there, as many as a parser may have to remember."""
    at = rng.randrange(len(data) + 1)
    depth = rng.choice((1, 40, 100_000))
    sign = rng.choice((b"[", b'{"a":', b"("))
    return data[:at] + sign * depth + data[at:]


ANYWHERE: tuple[Mutation, ...] = (flip, flip, delete, insert, truncate, double)
BINARY: tuple[Mutation, ...] = (*ANYWHERE, claim, claim)
TEXT: tuple[Mutation, ...] = (
    *ANYWHERE, swap_lines, repeat_line, number, number, number, line_ends, encode, widen, remove_line, nest,
)  # fmt: skip


def mutated(data: bytes, seed: str, text: bool) -> bytes:
    """Return a damaged copy of a log; the seed decides how."""
    rng = random.Random(seed)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        data = rng.choice(TEXT if text else BINARY)(rng, data)
    return data
