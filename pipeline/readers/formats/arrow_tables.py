"""Reads Parquet and Feather (Arrow IPC) files.

Columns are called by name, fields of structs by dotted path, elements of lists in brackets, counted from 0.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipeline.base.errors import LogError
from pipeline.readers.formats.arrays import LISTED_ELEMENTS, Array, plain_column, unknown_column
from pipeline.readers.frame import ColumnInfo, Frame, Scalar
from pipeline.readers.isolation import isolated_reader
from pipeline.readers.limits import EXACT
from pipeline.readers.safety import check_claim, check_columns

_PARQUET, _ARROW, _FEATHER_1 = b"PAR1", b"ARROW1", b"FEA1"
_LONGEST_TEXT = 1000
"""Characters of a metadata entry that are kept: longer ones are schemas of other tools."""

read_frame, list_columns = isolated_reader(__name__, "a Parquet or Feather file", ("pyarrow.parquet",))
"""Time stamps and durations are integers in nanoseconds, stated as attribute ``<column>@unit``; a null is NaN, or an
empty text. Attributes are the metadata of the file and, as ``<column>@<key>``, of its columns."""


def frame_here(name: str, data: bytes, wanted: Sequence[str]) -> Frame:
    """Do what `read_frame` does, in the worker process."""
    schema = _schema(name, data)
    names = [key for key, _ in _leaves(schema)]
    leaves = dict(_leaves(schema))
    check_columns(name, len(leaves))
    for key in wanted or names:
        if names.count(key) > 1 or schema.names.count(_vector_of(key)) > 1:
            raise LogError(
                f"{name}: column {key!r} stands {names.count(key) or 2} times in the file; expected it once, since "
                "nobody can tell which is meant. Name the columns apart where the file is written.",
                code="header-missing",
            )
    for key in wanted:
        if key not in leaves and _vector_of(key) not in leaves:
            raise unknown_column(name, key, list(leaves))
    table = _read(name, data, schema, wanted)
    columns = dict(_columns(name, table, wanted))
    for key in wanted:
        if key not in columns:
            raise LogError(
                f"{name}: column {key!r} is {leaves.get(key, 'no element of a list of one length')}; expected "
                f"numbers or texts. Correct columns.*.name; readable are {list(columns)[:40]}.",
                code="column-missing",
            )
    columns = {key: columns[key] for key in wanted or columns}
    row = np.arange(1, table.num_rows + 1, dtype=np.int64)
    units = {key: "ns" for key in columns if _is_time(leaves.get(key))}
    return Frame(columns, row, "record", _attributes(schema), units=units)


def columns_here(name: str, data: bytes) -> list[ColumnInfo]:
    """Do what `list_columns` does, in the worker process."""
    schema = _schema(name, data)
    attributes = _attributes(schema)
    infos = []
    for key, column in _columns(name, _read(name, data, schema, ()), ()):
        kind = {"f": "number", "U": "text"}.get(column.dtype.kind, "integer")
        hint = next(
            (str(attributes[f"{key}@{unit}"]) for unit in ("unit", "units") if f"{key}@{unit}" in attributes), ""
        )
        infos.append(ColumnInfo(key, kind, len(column), tuple(map(str, column[:3])), hint))
    return infos


def _schema(name: str, data: bytes) -> pa.Schema:
    if data.startswith(_PARQUET):
        from pyarrow import parquet

        return parquet.ParquetFile(pa.BufferReader(data)).schema_arrow
    if data.startswith(_ARROW):
        return pa.ipc.open_file(pa.BufferReader(data)).schema
    if data.startswith(_FEATHER_1):
        raise LogError(
            f"{name} is a Feather file of version 1; expected version 2. Write it again with a current tool.",
            code="unsupported",
        )
    raise LogError(
        f"{name} is no Parquet or Feather file: it begins with {data[:8]!r}, not {_PARQUET!r} or {_ARROW!r}. "
        "Correct `format` in the profile, or export it again.",
        code="unsupported",
    )


def _leaves(schema: pa.Schema) -> Iterator[tuple[str, pa.DataType]]:
    """Yield all columns with those inside structs."""
    waiting = [(field.name, field.type) for field in schema][::-1]
    while waiting:
        key, kind = waiting.pop()
        yield key, kind
        if pa.types.is_struct(kind):
            waiting += [(f"{key}.{kind.field(i).name}", kind.field(i).type) for i in range(kind.num_fields)][::-1]


def _vector_of(key: str) -> str:
    return key.partition("[")[0]


def _read(name: str, data: bytes, schema: pa.Schema, wanted: Sequence[str]) -> pa.Table:
    """Return the table with at least the wanted columns, its values checked."""
    tops = [
        number
        for number, field in enumerate(schema)
        if not wanted
        or any(key == field.name or key.startswith((f"{field.name}.", f"{field.name}[")) for key in wanted)
    ]
    if data.startswith(_PARQUET):
        from pyarrow import parquet

        file = parquet.ParquetFile(pa.BufferReader(data))
        meta = file.metadata
        check_claim(name, f"a table of {meta.num_rows} rows", 8 * meta.num_rows * len(tops), len(data))
        groups = [meta.row_group(i) for i in range(meta.num_row_groups)]
        check_claim(name, "the column data", sum(group.total_byte_size for group in groups), len(data))
        table = file.read(columns=[schema.names[i] for i in tops], use_threads=False)
    else:
        options = pa.ipc.IpcReadOptions(included_fields=tops, use_threads=False)
        reader = pa.ipc.open_file(pa.BufferReader(data), options=options)
        batches = []
        total = 0
        for number in range(reader.num_record_batches):
            batches.append(reader.get_batch(number))
            total += batches[-1].nbytes
            check_claim(name, "the column data", total, len(data))
        table = pa.Table.from_batches(batches, reader.schema if not batches else batches[0].schema)
    # a damaged file may point outside its own buffers, which only this looks at
    table.validate(full=True)
    return table


def _columns(name: str, table: pa.Table, wanted: Sequence[str]) -> Iterator[tuple[str, Array]]:
    """Yield the columns that are numbers or texts."""
    waiting = [(key, _whole(column)) for key, column in zip(table.column_names, table.columns, strict=True)]
    waiting.reverse()
    while waiting:
        key, column = waiting.pop()
        kind = column.type
        if pa.types.is_struct(kind):
            inner = [(f"{key}.{kind.field(i).name}", part) for i, part in enumerate(column.flatten())]
            waiting += inner[::-1]
        elif pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
            waiting += [(f"{key}[{i}]", part) for i, part in _elements(key, column, wanted)][::-1]
        elif not wanted or key in wanted:
            values = _values(name, key, column)
            if values is not None:
                yield key, values


def _whole(column: Any) -> Any:
    """Return a chunked column as one array."""
    array = column.combine_chunks()
    return pa.concat_arrays(array.chunks) if isinstance(array, pa.ChunkedArray) else array


def _elements(key: str, column: Any, wanted: Sequence[str]) -> list[tuple[int, Any]]:
    """Return the wanted elements of lists that all have one length; none where lengths differ or a list is missing."""
    flat = column.flatten()
    width, rest = divmod(len(flat), len(column)) if len(column) else (0, 0)
    if column.null_count or rest or not width or pc.list_value_length(column).unique().to_pylist() != [width]:
        return []
    asked = {int(match[1]) for name in wanted if (match := re.match(re.escape(key) + r"\[(\d+)\]", name))}
    numbers = sorted(asked & set(range(width))) if wanted else range(min(width, LISTED_ELEMENTS))
    return [(i, flat.take(pa.array(np.arange(i, len(flat), width)))) for i in numbers]


def _values(name: str, key: str, column: Any) -> Array | None:
    kind = column.type
    if pa.types.is_dictionary(kind):
        column = column.dictionary_decode()
        kind = column.type
    if pa.types.is_timestamp(kind) or pa.types.is_duration(kind):
        nanoseconds = pa.timestamp("ns", kind.tz) if pa.types.is_timestamp(kind) else pa.duration("ns")
        column = column.cast(nanoseconds).cast(pa.int64())
    elif pa.types.is_time(kind):
        column = column.cast(pa.time64("ns")).cast(pa.int64())
    elif pa.types.is_decimal(kind):
        column = column.cast(pa.float64())
    kind = column.type
    if pa.types.is_boolean(kind):
        column = column.cast(pa.int8())
    elif pa.types.is_string(kind) or pa.types.is_large_string(kind):
        return np.asarray(column.fill_null("").to_numpy(zero_copy_only=False), dtype=np.str_)
    elif not (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
        return None
    if not column.null_count:
        return plain_column(column.to_numpy(zero_copy_only=False))
    if pa.types.is_integer(column.type):
        bounds = pc.min_max(column)
        if max(abs(bounds["min"].as_py() or 0), abs(bounds["max"].as_py() or 0)) > EXACT:
            at = int(np.argmax(column.is_null().to_numpy(zero_copy_only=False))) + 1
            raise LogError(
                f"{name}: column {key!r} has whole numbers of more than 15 digits and missing ones; expected a value "
                "in each row. Fill or drop these rows, or take another column.",
                at,
                code="no-value",
            )
    return plain_column(np.asarray(column.cast(pa.float64()).to_numpy(zero_copy_only=False)))


def _is_time(kind: pa.DataType | None) -> bool:
    """Return whether values are read as whole nanoseconds."""
    return kind is not None and (pa.types.is_timestamp(kind) or pa.types.is_duration(kind) or pa.types.is_time(kind))


def _attributes(schema: pa.Schema) -> dict[str, Scalar]:
    attributes: dict[str, Scalar] = {}
    for prefix, metadata in [("", schema.metadata), *((f"{field.name}@", field.metadata) for field in schema)]:
        for key, value in (metadata or {}).items():
            text = value.decode("utf-8", "replace")
            if key not in (b"ARROW:schema", b"pandas") and len(text) <= _LONGEST_TEXT:
                attributes[prefix + key.decode("utf-8", "replace")] = text
    for key, kind in _leaves(schema):
        if _is_time(kind):
            attributes[f"{key}@unit"] = "ns"
    return attributes
