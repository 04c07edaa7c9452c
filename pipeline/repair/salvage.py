"""What can be read of a damaged samples file: page by page of each column in each group.

Nothing is trusted that no checksum covers: pages have one each. The footer is taken from the trials file, which holds a
copy, so that groups in front of the place where a file was cut off are found without the end of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.base.seal import footer_of
from pipeline.records.batch import Booleans, Integers
from pipeline.records.tables import TABLES, to_arrow
from pipeline.repair.parquet_pages import DamagedColumns
from pipeline.store.batch_files import NewBatch

NEEDED = ("time_s", "command", "position")
"""Columns without which a trial is lost."""

SPARED = tuple(name for name in TABLES["samples"] if name not in ("trial_id", *NEEDED))
"""Columns without which it is still a trial. The ids stand in the trials file, too."""


@dataclass(frozen=True)
class Group:
    """What can be read of a group of rows: its first row in the file, and of each column values and where they are."""

    first: int
    rows: int
    columns: dict[str, tuple[pa.Array, Booleans]]

    def missing(self, first: Integers, rows: Integers) -> dict[str, Booleans]:
        """Return which trials, by their first row in the file and number of rows, have not all of a column."""
        begin = np.clip(first - self.first, 0, self.rows)
        end = np.clip(begin + rows, 0, self.rows)
        found = {}
        for name, (_, known) in self.columns.items():
            count = np.concatenate([[0], np.cumsum(known)])
            found[name] = count[end] - count[begin] < rows
        return found


def groups_of(data: bytes, footer: bytes | None) -> Iterator[Group]:
    """Yield what can be read of each group of a samples file.

    Parameters
    ----------
    data : bytes
        The file as it is.
    footer : bytes or None
        Its footer as it was written; None takes the one in the file.
    """
    footer = footer_of(data) if footer is None else footer
    try:
        content = data.ljust(_pages_end(footer), b"\0")
        damaged = DamagedColumns(content, footer)
        file = pq.ParquetFile(pa.BufferReader(content + footer), page_checksum_verification=True)
    except (pa.ArrowException, OSError, ValueError, RecursionError):
        return
    first = 0
    for index in range(file.num_row_groups):
        rows = file.metadata.row_group(index).num_rows
        names = [name for name in (*NEEDED, *SPARED) if name in file.schema_arrow.names]
        yield Group(first, rows, {name: _readable(file, damaged, index, name) for name in names})
        first += rows


def unreadable(groups: Iterator[Group], trials: pa.Table) -> dict[str, tuple[str, ...]]:
    """Return the columns that a trial has lost, by its id; those that have all of them are left out."""
    first, rows = (trials.column(name).to_numpy().astype(np.int64) for name in ("first_row", "rows"))
    ids = trials.column("trial_id").to_pylist()
    lost: dict[str, tuple[str, ...]] = dict.fromkeys(ids, NEEDED)
    for group in groups:
        missing = group.missing(first, rows)
        for row in np.flatnonzero((first >= group.first) & (first + rows <= group.first + group.rows)):
            lost[ids[row]] = tuple(name for name, gone in missing.items() if gone[row])
    return {trial: names for trial, names in lost.items() if names}


def copy_readable(groups: Iterator[Group], trials: pa.Table, new: NewBatch) -> pa.Table:
    """Write the samples of trials whose needed columns can be read; return their rows with the new first row."""
    trials = trials.sort_by("first_row")
    first, rows = (trials.column(name).to_numpy().astype(np.int64) for name in ("first_row", "rows"))
    kept, places = [], []
    for group in groups:
        missing = group.missing(first, rows)
        inside = (first >= group.first) & (first + rows <= group.first + group.rows)
        own = np.flatnonzero(inside & ~np.logical_or.reduce([missing[name] for name in NEEDED]))
        if not len(own):
            continue
        places += (new.rows + np.cumsum(rows[own]) - rows[own]).tolist()
        kept += own.tolist()
        taken = pa.array(np.concatenate([np.arange(first[i], first[i] + rows[i]) for i in own]) - group.first)
        ids = pa.array(np.repeat(np.array(trials.column("trial_id").to_pylist(), dtype=object)[own], rows[own]))
        columns = {name: values.take(taken) for name, (values, _) in group.columns.items()}
        new.write(to_arrow("samples", {"trial_id": ids, **columns}))
    at = trials.schema.get_field_index("first_row")
    return trials.take(pa.array(kept, pa.int64())).set_column(at, trials.schema.field(at), pa.array(places, pa.int64()))


def _readable(file: pq.ParquetFile, damaged: DamagedColumns, group: int, name: str) -> tuple[pa.Array, Booleans]:
    rows = file.metadata.row_group(group)
    index = file.schema_arrow.get_field_index(name)
    whole = np.ones(rows.num_rows, np.bool_)
    statistics = rows.column(index).statistics
    if statistics is not None and statistics.null_count == rows.num_rows:
        return pa.nulls(rows.num_rows, file.schema_arrow.field(name).type), whole
    try:
        return file.read_row_group(group, columns=[name], use_threads=False).column(0).combine_chunks(), whole
    except (pa.ArrowException, OSError, ValueError):
        values, known = damaged.read(group, index)
        return values.cast(file.schema_arrow.field(name).type), known


def _pages_end(footer: bytes) -> int:
    """Return where the pages that a footer tells of end."""
    # the footer alone is a file whose pages are missing, with the magic number in front
    metadata = pq.read_metadata(pa.BufferReader(b"PAR1" + footer))
    groups = (metadata.row_group(index) for index in range(metadata.num_row_groups))
    chunks = (group.column(index) for group in groups for index in range(group.num_columns))
    starts = ((c.dictionary_page_offset or c.data_page_offset, c.total_compressed_size) for c in chunks)
    return max((start + size for start, size in starts), default=4)
