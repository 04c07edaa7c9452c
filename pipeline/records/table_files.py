"""Parquet files of the stored tables, checked against the dictionary of columns (`tables`).

Writing adds units and meanings to the file's metadata; reading refuses a file that is damaged or whose columns or types
differ. The name of a file contains the SHA-256 of its content, which is checked when the file is read as a whole. When
it is read in part, Parquet's checksums of the pages are checked.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.base.disk import hash_in_name
from pipeline.base.errors import REMEDY, StoreError
from pipeline.records.tables import COLUMNS, TABLES

WRITING: dict[str, Any] = {"compression": "zstd", "write_page_checksum": True, "write_statistics": False}
"""Options for writing Parquet. Compression alone does not detect a flipped byte, which would be read as another number;
checksums do."""


def parquet_bytes(data: pa.Table) -> bytes:
    """Return a table as a Parquet file.

    Raises
    ------
    StoreError
        If the table does not equal its entry in `TABLES`.
    """
    _check(Path("table"), data.schema)
    sink = io.BytesIO()
    pq.write_table(data, sink, **WRITING)
    return sink.getvalue()


def read_table(path: Path) -> pa.Table:
    """Read a stored table as a whole after checking content and columns.

    Raises
    ------
    StoreError
        If the file is damaged, or was written with other columns or types.
    """
    with _told(path):
        data = path.read_bytes()
        if hash_in_name(path.name) not in (None, hashlib.sha256(data).hexdigest()):
            raise ValueError("its content is not that of its name")
        table = pq.read_table(pa.BufferReader(data))
    _check(path, table.schema)
    return table


@contextmanager
def open_table(path: Path) -> Iterator[pq.ParquetFile]:
    """Open a stored table of which some columns or rows are read; errors as in `read_table`."""
    with _told(path), pq.ParquetFile(path, page_checksum_verification=True) as file:
        _check(path, file.schema_arrow)
        yield file


@contextmanager
def _told(path: Path) -> Iterator[None]:
    try:
        yield
    except (pa.ArrowException, OSError, ValueError) as error:  # UnicodeDecodeError of foreign bytes included
        if isinstance(error, FileNotFoundError):  # the reader looks again: the file may have been merged
            raise
        raise damaged_file(path, error) from error


def damaged_file(path: Path, error: object) -> StoreError:
    """Return the error of a stored file that cannot be read, with what to do."""
    return StoreError(f"{path}: is missing or damaged ({error}). {REMEDY}")


def metadata_of(schema: pa.Schema) -> dict[str, str]:
    """Return the metadata written into a file."""
    metadata = schema.metadata or {}
    return {key.decode(): value.decode() for key, value in metadata.items() if key.startswith(b"pipeline.")}


def read_metadata(path: Path) -> dict[str, str]:
    """Return the metadata of a stored file, or an empty dictionary if there is no readable one."""
    try:
        return metadata_of(pq.read_schema(path))
    except (pa.ArrowException, OSError, UnicodeDecodeError):
        return {}


def _check(path: Path, schema: pa.Schema) -> None:
    table = (schema.metadata or {}).get(b"pipeline.table", b"").decode()
    if table not in TABLES:
        raise StoreError(f"{path}: expected one of the tables {sorted(TABLES)}, found {table!r}.")
    found = [(f.name, str(f.type)) for f in schema]
    expected = [(name, str(COLUMNS[name].dtype)) for name in TABLES[table]]
    if found != expected:
        missing = [c for c in expected if c not in found]
        surplus = [c for c in found if c not in expected]
        raise StoreError(
            f"{path}: columns differ from table {table!r}; missing {missing}, not expected {surplus}. "
            "It was written by another version: ingest the logs into a new folder (--processed)."
        )
