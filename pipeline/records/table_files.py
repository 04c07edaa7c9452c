"""Parquet files of the stored tables, which are checked against the dictionary of columns (`tables`).

Units and meanings are added to the metadata of a file when it is written. A file that is damaged, or has different
columns or types, is refused when it is read. The name of a file contains the SHA-256 of its content. This hash is
checked when the complete file is read. When only a part is read, the page checksums of Parquet are checked instead.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.base.disk import hash_in_name
from pipeline.base.errors import REMEDY, StoreError
from pipeline.records.tables import COLUMNS, TABLES

WRITING: dict[str, object] = {"compression": "zstd", "write_page_checksum": True, "write_statistics": False}
"""Options for writing Parquet.

Decompression does not detect a flipped byte, which would be read as a different number. Checksums detect it.
"""


def parquet_bytes(data: pa.Table) -> bytes:
    """Return a table as the bytes of a Parquet file.

    Raises
    ------
    StoreError
        If the table differs from its entry in `TABLES`.
    """
    _check(Path("table"), data.schema)
    sink = io.BytesIO()
    pq.write_table(data, sink, **WRITING)
    return sink.getvalue()


def read_table(path: Path) -> pa.Table:
    """Read a complete stored table after checking content and columns.

    Raises
    ------
    StoreError
        If the file is damaged, or was written with different columns or types.
    """
    with _named_errors(path):
        data = path.read_bytes()
        if hash_in_name(path.name) not in (None, hashlib.sha256(data).hexdigest()):
            raise ValueError("its content does not match the hash in its name")
        table = pq.read_table(pa.BufferReader(data))
    _check(path, table.schema)
    return table


@contextmanager
def open_table(path: Path) -> Iterator[pq.ParquetFile]:
    """Open a stored table to read some of its columns or rows. The errors are those of `read_table`."""
    with _named_errors(path), pq.ParquetFile(path, page_checksum_verification=True) as file:
        _check(path, file.schema_arrow)
        yield file


@contextmanager
def _named_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except (pa.ArrowException, OSError, ValueError) as error:  # a ValueError may be a UnicodeDecodeError
        if isinstance(error, FileNotFoundError):  # the file may have been merged, so the caller searches again
            raise
        raise damaged_file(path, error) from error


def damaged_file(path: Path, error: object) -> StoreError:
    """Return the error for a stored file that cannot be read, with the remedy."""
    return StoreError(f"{path}: is missing or damaged ({error}). {REMEDY}")


def metadata_of(schema: pa.Schema) -> dict[str, str]:
    """Return the metadata that were written into a file."""
    metadata = schema.metadata or {}
    return {key.decode(): value.decode() for key, value in metadata.items() if key.startswith(b"pipeline.")}


def read_metadata(path: Path) -> dict[str, str]:
    """Return the metadata of a stored file, or {} if no metadata can be read."""
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
            f"{path}: columns differ from table {table!r}; missing {missing}, unexpected {surplus}. The file was "
            "written by a different version. Ingest the logs into a new folder (--processed)."
        )
