"""A JSON document that begins with a checksum of its rest, by which a changed byte is noticed."""

from __future__ import annotations

import json
import zlib
from typing import Any

_CHECKSUM = b'{"checksum": "'
"""How a sealed JSON document begins."""


class DamageError(ValueError):
    """A file is not as it was written."""


def sealed_json(text: str) -> str:
    """Return a JSON object with the CRC-32 of what follows as its first value."""
    rest = text[1:]
    return f'{_CHECKSUM.decode()}{zlib.crc32(rest.encode()):08x}",{rest}'


def unsealed_json(data: bytes) -> dict[str, Any]:
    """Return the content of a JSON object, held against its checksum where it has one, without it.

    Raises
    ------
    ValueError
        If it is none, or a byte is not as it was written (`DamageError`).
    """
    digits, comma, rest = data.removeprefix(_CHECKSUM).partition(b'",')
    if data.startswith(_CHECKSUM) and (not comma or digits != b"%08x" % zlib.crc32(rest)):
        raise DamageError("its checksum differs")
    document = json.loads(data)
    if not isinstance(document, dict):
        raise DamageError("is no JSON object")
    document.pop("checksum", None)
    return document
