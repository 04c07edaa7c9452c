"""Reads a file of any format in a process of its own, by the table of formats."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from pipeline.profiles.profile_model import Profile
from pipeline.readers.formats import FORMATS
from pipeline.readers.frame import Contents
from pipeline.readers.isolation import allowed_bytes, isolated, library
from pipeline.readers.limits import MOST_VALUES


def read_file(settings: Profile, names: Sequence[str], data: Sequence[bytes], wanted: Sequence[str] = ()) -> Contents:
    """Return what a file holds, read in a worker process.

    Parameters
    ----------
    settings : Profile
        ``format``, and the keys of that format.
    names, data : sequence of str and bytes
        The file; a split bag has several.
    wanted : sequence of str
        Columns that are asked for; empty means all.

    Raises
    ------
    LogError
        If the file cannot be read.
    """
    form = FORMATS[settings.format]
    place, options = (
        "pipeline.readers.formats.files:read_here",
        (settings, tuple(wanted), tuple(zip(names, map(len, data), strict=False))),
    )
    arguments = place, names[0], form.title, b"".join(data), *options
    contents: Contents = isolated(*arguments, imports=form.libraries, seconds_per_byte=form.seconds_per_byte)
    return contents


def read_here(
    name: str, data: bytes, settings: Profile, wanted: tuple[str, ...], parts: tuple[tuple[str, int], ...]
) -> Contents:
    """Do what `read_file` does, in the worker process; ``parts`` are name and bytes of each file in ``data``."""
    with TemporaryDirectory() as folder:
        paths, start = [], 0
        for number, (part, size) in enumerate(parts):
            paths.append(Path(folder) / f"{number}{Path(part).suffix[:10]}")
            paths[-1].write_bytes(data[start : start + size])
            start += size
        form = FORMATS[settings.format]
        module = library(f"pipeline.readers.formats.{form.module}", form.extra)
        most = min(MOST_VALUES, allowed_bytes(len(data)) // 8)
        contents = Contents(name, wanted, most)
        module.read(paths[0], settings, contents)
        if contents.lacks():
            # the refusal tells what there is
            contents = Contents(name, most=most)
            module.read(paths[0], settings, contents)
            contents.wanted = wanted
    return contents
