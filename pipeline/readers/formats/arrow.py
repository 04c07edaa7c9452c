"""Reader of Parquet and Feather (Arrow IPC) files.

Fields of structs have dotted paths. Elements of lists have an index in brackets, counted from 0. Time stamps and
durations are integers in nanoseconds. A null is NaN, or an empty text.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import feather, parquet

from pipeline.base.errors import refusal
from pipeline.profiles.profile_model import Profile
from pipeline.readers.file_columns import Array, FileColumns, with_gaps


def read(path: Path, settings: Profile, contents: FileColumns) -> None:
    """Add the columns of a table."""
    contents.row_name = "record"
    footer = parquet.read_metadata(path) if path.read_bytes()[:4] == b"PAR1" else None
    schema = footer.schema.to_arrow_schema() if footer else pa.ipc.open_file(pa.OSFile(str(path))).schema
    chosen = [name for name in schema.names if contents.wants(name)]
    for name in chosen:
        if schema.names.count(name) > 1:
            text = f"column {name!r} occurs {schema.names.count(name)} times in the file"
            cure = "Give the columns different names in the program that writes the file."
            raise refusal("header-missing", contents.name, text, "it once, since it is ambiguous", cure)
    # Check the size first: the library crashes if memory runs out, and constant columns are compressed without limit.
    contents.claim(footer.num_rows * len(chosen) if footer else 0)
    read_table = parquet.read_table if footer else feather.read_table
    table = read_table(path, columns=chosen, use_threads=False)
    # The offsets of a damaged file may point outside its buffers. Only this call checks them.
    table.validate(full=True)
    for prefix, metadata in [("", schema.metadata), *((f"{field.name}@", field.metadata) for field in schema)]:
        for key, value in (metadata or {}).items():
            if key not in (b"ARROW:schema", b"pandas"):
                contents.note(prefix + key.decode("utf-8", "replace"), value)
    for name in chosen:
        hints = (contents.attributes.get(f"{name}@{unit}") for unit in ("unit", "units"))
        _add(contents, name, table.column(name).combine_chunks(), str(next(filter(None, hints), "")))


def _add(contents: FileColumns, path: str, column: Any, hint: str = "") -> None:
    column = pa.concat_arrays(column.chunks) if isinstance(column, pa.ChunkedArray) else column
    kind = column.type
    if pa.types.is_struct(kind):
        for number, part in enumerate(column.flatten()):
            _add(contents, f"{path}.{kind.field(number).name}", part)
        return
    timed = pa.types.is_timestamp(kind) or pa.types.is_duration(kind) or pa.types.is_time(kind)
    if timed:
        contents.note(f"{path}@unit", "ns")
    contents.add(path, partial(_values, column), hint, "ns" if timed else "", 0)


def _values(column: Any) -> Array:
    kind = column.type
    if pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
        if column.null_count or len(lengths := pc.list_value_length(column).unique()) > 1:
            raise TypeError(f"is {kind} with lists of different lengths; expected numbers or texts")
        width = lengths[0].as_py() if len(lengths) else 0
        return _values(column.flatten()).reshape(len(column), width)
    if pa.types.is_dictionary(kind):
        column = column.dictionary_decode()
    elif pa.types.is_timestamp(kind):
        column = column.cast(pa.timestamp("ns", kind.tz)).cast(pa.int64())
    elif pa.types.is_duration(kind) or pa.types.is_time(kind):
        column = column.cast(pa.duration("ns") if pa.types.is_duration(kind) else pa.time64("ns")).cast(pa.int64())
    elif pa.types.is_decimal(kind):
        column = column.cast(pa.float64())
    elif pa.types.is_boolean(kind):
        column = column.cast(pa.int8())
    if not any(test(column.type) for test in (pa.types.is_integer, pa.types.is_floating, pa.types.is_string)):
        raise TypeError(f"is {kind}; expected numbers or texts")
    known = np.flatnonzero(column.is_valid().to_numpy(zero_copy_only=False))
    values = column.drop_null().to_numpy(zero_copy_only=False)
    return with_gaps(np.array(values, np.str_) if values.dtype.kind == "O" else values, known, len(column))
