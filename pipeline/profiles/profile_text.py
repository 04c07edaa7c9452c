"""Conversion of a profile to TOML text, from which `read_profile` reads the same record."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.profiles.profile_model import Profile

_PLAIN_KEY = re.compile(r"[A-Za-z0-9_-]+")


def toml_value(value: object) -> str:
    """Return a value as TOML. Control characters are escaped.

    >>> toml_value('F "soll"'), toml_value(0.001), toml_value({"name": "ns", "unit": "ns"})
    ('"F \\\\"soll\\\\""', '0.001', '{ name = "ns", unit = "ns" }')
    """
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{_key(key)} = {toml_value(part)}' for key, part in value.items())} }}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml_value, value))}]"
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _key(key: str) -> str:
    return key if _PLAIN_KEY.fullmatch(key) else toml_value(key)


def profile_toml(profile: Profile, remarks: Sequence[str] = (), folder: Path | None = None) -> str:
    """Return a profile as the text of its file.

    Parameters
    ----------
    profile : Profile
    remarks : sequence of str
        Comment lines above the keys, such as evidence from the data.
    folder : Path, optional
        Folder of the file, to which the path of the sheet is made relative. By default, the path is unchanged.
    """
    dumped = profile.model_dump(mode="json", exclude_defaults=True)
    if profile.sheet is not None and folder is not None:
        dumped["sheet"]["file"] = os.path.relpath(profile.sheet.file, folder)
    values = {key: dumped[key] for key in ("name", "title", "format", "files") if key in dumped} | dumped
    lines = [*(f"# {' '.join(remark.split())}" for remark in remarks), *_table(values, ())]
    return "\n".join(lines) + "\n"


def _table(values: Mapping[str, Any], above: tuple[str, ...]) -> Iterator[str]:
    """Yield the lines of a table: its keys, followed by its subtables."""
    tables = {key: value for key, value in values.items() if _is_table(value, above)}
    yield from (f"{_key(key)} = {toml_value(value)}" for key, value in values.items() if key not in tables)
    for key, value in tables.items():
        place = (*above, key)
        for part in value if isinstance(value, list) else [value]:
            head = ".".join(map(_key, place))
            if not (isinstance(part, Mapping) and part and all(isinstance(v, Mapping) for v in part.values())):
                yield from ("", f"[[{head}]]" if isinstance(value, list) else f"[{head}]")
            yield from _table(part, place)


def _is_table(value: object, above: tuple[str, ...]) -> bool:
    """Return True if a value is written as a table. The entries of the table ``columns`` are written as inline
    tables."""
    if isinstance(value, list):
        return bool(value) and all(isinstance(part, Mapping) for part in value)
    return isinstance(value, Mapping) and len(above) < 1 + (above[:1] == ("columns",))
