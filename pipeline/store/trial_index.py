"""Index of trials. The index is a single file with a copy of a few columns of all trial files, because reading one file
is faster than reading thousands.

The index is local to this machine, and any reader may rewrite it. The copied columns of a trial file are valid as long
as the size and the modification time of the file are unchanged.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.base.disk import if_writable, new_file, shared_mode
from pipeline.records.table_files import WRITING
from pipeline.records.tables import arrow_schema

INDEX = ".trials.parquet"
"""Name of the index file in the folder of a store."""

INDEXED = (
    *("trial_id", "device", "experiment", "rows"),
    *("source_path", "source_sha256", "source_mtime_ns", "profile_sha256"),
)
"""Columns in the index. They identify trials, their versions and their experiments."""

MIN_INDEXED_FILES = 100
"""Smallest number of trial files for which an index is written. Opening fewer files takes less than 0.2 s."""

_FILES = b"pipeline.files"


class FileRows(NamedTuple):
    """Rows of a trial file (selected columns), and the stems of the files that it replaces, separated by spaces."""

    table: pa.Table
    replaces: str


def indexed_rows(
    processed: Path, files: Sequence[Path], read: Callable[[Path, Sequence[str]], FileRows | None]
) -> dict[Path, FileRows]:
    """Return the copied columns of trial files, from the index where it is current.

    Parameters
    ----------
    processed : Path
    files : sequence of Path
    read : callable
        Function that reads the columns of a file that is not in the index. It returns None if the file is damaged.
    """
    states = {file: (status.st_size, status.st_mtime_ns) for file in files if (status := file.stat())}
    root = len(os.fspath(processed)) + 1
    names = {file: os.fspath(file)[root:].replace(os.sep, "/") for file in files}
    stored = _read(processed)
    if stored.keys() == set(names.values()) and all(stored[names[file]][0] == states[file] for file in files):
        return {file: stored[names[file]][1] for file in files}
    result, new = dict[Path, FileRows](), 0
    for file in files:
        state, part = stored.get(names[file], (None, None))
        if part is None or state != states[file]:
            part = read(file, INDEXED)
            new += part is not None
        if part is not None:
            result[file] = part
    # Reading a few new files is faster than writing the index.
    if new >= MIN_INDEXED_FILES or new > 0.1 * len(files):
        _write(processed, {names[file]: (states[file], part) for file, part in result.items()}, files)
    return result


def _schema() -> pa.Schema:
    whole = arrow_schema("trials")
    return pa.schema([whole.field(name) for name in INDEXED])


def _read(processed: Path) -> dict[str, tuple[tuple[int, int], FileRows]]:
    """Return size, time and rows of each file in the index, by file name.

    The result is empty if the index is damaged.
    """
    try:
        table = pq.read_table(processed / INDEX, page_checksum_verification=True, use_threads=False)
        entries = json.loads((table.schema.metadata or {})[_FILES])
        if table.schema.names != list(INDEXED) or sum(entry[3] for entry in entries) != len(table):
            return {}
    except (pa.ArrowException, OSError, ValueError, KeyError):
        return {}
    table, first = table.replace_schema_metadata(None).combine_chunks(), 0
    stored = {}
    for name, size, mtime_ns, rows, replaces in entries:
        stored[name] = ((size, mtime_ns), FileRows(table.slice(first, rows), replaces))
        first += rows
    return stored


def _write(processed: Path, parts: dict[str, tuple[tuple[int, int], FileRows]], files: Sequence[Path]) -> None:
    entries = [[name, *state, len(part.table), part.replaces] for name, (state, part) in parts.items()]
    schema = _schema().with_metadata({_FILES: json.dumps(entries)})
    table = pa.Table.from_batches(
        [batch for _, part in parts.values() for batch in part.table.to_batches()], schema=_schema()
    ).replace_schema_metadata(schema.metadata)
    with if_writable(), new_file(processed, name=INDEX, mode=shared_mode([f.stat() for f in files], processed)) as new:
        pq.write_table(table, new.stream, **WRITING)
