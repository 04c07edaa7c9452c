"""Parquet files of the stored tables, checked against the dictionary of columns (`tables`).

Writing stamps units and meanings into the file's metadata; reading refuses a file that is damaged or whose columns or
types differ. Files appear under their final name only when they are complete.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, Self

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.base.disk import replacing
from pipeline.base.errors import REMEDY, StoreError
from pipeline.base.json_seal import DamageError
from pipeline.base.seal import MARK, SealingStream, verify
from pipeline.records.tables import COLUMNS, TABLES

GROUP_ROWS = 1 << 19
"""Rows of a group, which is written and read as one: some 500 logs, which take 25 MB in memory with all columns."""

WRITING: dict[str, Any] = {"compression": "zstd", "write_page_checksum": True}
"""How Parquet is written. The compression alone does not notice a flipped byte, which would then be read as another
number; checksums do."""


def write_table(path: Path, data: pa.Table, annex: bytes = b"") -> None:
    """Write a table to Parquet so that a reader sees all of it or nothing; the annex of its seal is the caller's.

    Raises
    ------
    StoreError
        If the table does not equal its entry in `TABLES`.
    """
    _check(path, data.schema)
    write_parquet(path, data, annex)


def write_parquet(path: Path, data: pa.Table, annex: bytes = b"") -> None:
    """Write any Arrow table so that a reader sees all of it or nothing; `write_table` checks it too."""
    with replacing(path) as stream, SealedWriter(stream, data.schema) as writer:
        writer.write(data)
        writer.close(annex)


def parquet_bytes(data: pa.Table) -> bytes:
    """Return a table as a Parquet file that is ready to be sealed."""
    sink = io.BytesIO()
    with _writer(sink, data.schema) as writer:
        writer.write_table(data)
    return sink.getvalue()


def _writer(stream: BinaryIO | io.RawIOBase, schema: pa.Schema) -> pq.ParquetWriter:
    return pq.ParquetWriter(stream, schema.with_metadata({**(schema.metadata or {}), MARK: "1"}), **WRITING)


class SealedWriter:
    """Writes tables, one group of rows each, as a sealed Parquet file; nothing of worth without `close`."""

    def __init__(self, stream: BinaryIO, schema: pa.Schema) -> None:
        self._stream = SealingStream(stream)
        self._writer = _writer(self._stream, schema)

    def __enter__(self) -> Self:
        return self

    def write(self, data: pa.Table, group_rows: int = GROUP_ROWS) -> None:
        """Append a table in groups of rows."""
        self._writer.write_table(data, row_group_size=group_rows)

    def close(self, annex: bytes = b"") -> bytes:
        """Write the rest and the seal; return the footer."""
        self._stream.end_pages()
        self._writer.close()
        return self._stream.finish(annex)

    def __exit__(self, *error: object) -> None:
        # the end of a file that nobody wants; on a full disk it cannot be written
        with suppress(OSError, ValueError, pa.ArrowException):
            self._writer.close()


def read_table(path: Path, columns: list[str] | None = None) -> pa.Table:
    """Read a stored table (all or some columns) after checking it against the dictionary.

    Raises
    ------
    StoreError
        If the file is damaged, or was written with other columns or types.
    """
    with open_table(path) as file:
        table = file.read(columns=columns)
    # the mark is the file's and not the table's
    return table.replace_schema_metadata({k: v for k, v in table.schema.metadata.items() if k != MARK.encode()})


@contextmanager
def open_table(path: Path) -> Iterator[pq.ParquetFile]:
    """Open a stored table, whose bytes are held against their checksums once; errors as those of `read_table`."""
    try:
        # a file of an earlier version has checksums of its pages alone
        with pq.ParquetFile(path, page_checksum_verification=not verify(path)) as file:
            _check(path, file.schema_arrow)
            yield file
    except (DamageError, pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise damaged_file(path, error) from error


def damaged_file(path: Path, error: object) -> StoreError:
    """Return the error of a stored file that cannot be read, with what to do."""
    return StoreError(f"{path}: is missing or damaged ({error}). {REMEDY}")


def read_metadata(path: Path) -> dict[str, str]:
    """Return the metadata stamped into a stored file, or an empty dictionary where there is no readable one."""
    try:
        metadata = pq.read_schema(path).metadata or {}
        return {key.decode(): value.decode() for key, value in metadata.items() if key.startswith(b"pipeline.")}
    except (pa.ArrowException, OSError, UnicodeDecodeError):
        return {}


def _check(path: Path, schema: pa.Schema) -> None:
    table = (schema.metadata or {}).get(b"pipeline.table", b"").decode()
    if table not in TABLES:
        raise StoreError(f"{path}: holds no known table (found {table!r}); expected one of {sorted(TABLES)}.")
    found = [(f.name, str(f.type)) for f in schema]
    expected = [(name, str(COLUMNS[name].dtype)) for name in TABLES[table]]
    if found != expected:
        missing = [c for c in expected if c not in found]
        surplus = [c for c in found if c not in expected]
        raise StoreError(
            f"{path}: columns differ from table {table!r}; missing {missing}, not expected {surplus}. "
            "It was written by another version: ingest the logs into a new folder (--processed)."
        )
