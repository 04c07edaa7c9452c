"""Which files a writer left in `processed/`, so that one that somebody deletes is missed.

What is computed anew when it is gone (results of stages) is not listed. Without the list, as after an interruption,
nothing is missed until the next writer has ended.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pipeline.base.disk import write_text

INVENTORY_FILE = ".stored.json"

LISTED = ("trials", "samples")
"""Folders whose tables are listed."""

LISTED_FILES = ("exclusions.parquet",)


@contextmanager
def listed(processed: Path) -> Iterator[None]:
    """List what is stored when the block ends; for who holds the lock."""
    file = processed / INVENTORY_FILE
    gone = missing(processed)
    # what an interrupted block removes is not missed
    _write(file, set(), set(gone))
    try:
        yield
    except BaseException:
        with suppress(OSError):  # a full disk: nothing is missed
            _note(processed, file)
        raise
    _note(processed, file)


def _note(processed: Path, file: Path) -> None:
    found = _present(processed)
    _write(file, found, set(missing(processed)) - found)


def missing(processed: Path) -> tuple[str, ...]:
    """Return the stored files, below `processed`, that somebody has deleted."""
    try:
        known = json.loads((processed / INVENTORY_FILE).read_text())
        names = {str(name) for key in ("files", "gone") for name in known[key]}
    except (OSError, ValueError, KeyError, TypeError):
        return ()
    return tuple(sorted(name for name in names if not os.path.lexists(processed / name)))


def forget(processed: Path) -> None:
    """Take what is there for all that was stored; for who holds the lock."""
    (processed / INVENTORY_FILE).unlink(missing_ok=True)


def _write(file: Path, files: set[str], gone: set[str]) -> None:
    if files or gone:
        write_text(file, json.dumps({"files": sorted(files), "gone": sorted(gone)}) + "\n")
    else:
        file.unlink(missing_ok=True)


def _present(processed: Path) -> set[str]:
    found = {name for name in LISTED_FILES if (processed / name).exists()}
    for part in LISTED:
        for here, _, names in os.walk(processed / part):
            place = os.path.relpath(here, processed)
            found.update(Path(place, name).as_posix() for name in names if name.endswith(".parquet"))
    return found
