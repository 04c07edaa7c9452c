"""Maps of costs as Parquet files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipeline.base.disk import replacing
from pipeline.base.errors import PipelineError
from pipeline.base.provenance import stamp
from pipeline.records.trials import Booleans, Floats
from pipeline.theory.boundary import MARGIN
from pipeline.theory.costs import AXES, BLOCK, CostMap, MapBlock

if TYPE_CHECKING:
    import pyarrow as pa


def write_map(
    path: Path, cost_map: CostMap, progress: Callable[[int, int], None] | None = None, points: int = BLOCK
) -> int:
    """Write a map to a Parquet file atomically, and return the number of its stable points.

    Parameters
    ----------
    path : Path
    cost_map : CostMap
    progress : callable, optional
        Function that is called with the number of points done and the total number of points after each block.
    points : int
        Number of points per block. A block is written as a row group, so that the required memory does not grow with
        the map.

    Raises
    ------
    PipelineError
        If the file cannot be written. An earlier file remains unchanged.
    """
    import pyarrow.parquet as pq

    from pipeline.records.table_files import WRITING

    schema = map_schema(cost_map)
    stable = done = 0
    try:
        with (
            replacing(path) as stream,
            pq.ParquetWriter(stream, schema, use_dictionary=list(AXES), **WRITING) as writer,
        ):
            for block in cost_map.blocks(points):
                writer.write_table(block_table(block, schema))
                stable += int(block.stable.sum())
                done += len(block.alpha)
                if progress is not None:
                    progress(done, cost_map.size**2)
    except OSError as error:
        raise PipelineError(
            f"{path}: map cannot be written ({error.strerror or error}). Choose another file (--out)."
        ) from error
    return stable


def map_schema(cost_map: CostMap) -> pa.Schema:
    """Return the columns of the point, of stability and of each criterion, with units and parameters as metadata."""
    import pyarrow as pa

    loop = cost_map.loop
    meaning = (
        f"null where not stable, within {MARGIN:g} of the boundary, or still moving after {cost_map.longest} samples"
    )
    fields = [pa.field(name, pa.float64(), False) for name in AXES]
    fields += [pa.field("stable", pa.bool_(), False)]
    fields += [pa.field(name, pa.float64(), metadata={"unit": "1", "meaning": meaning}) for name in cost_map.names]
    plant = {name: repr(getattr(loop, name)) for name in ("gamma", "delta", "delay", "lag", "plant", "velocity")}
    return pa.schema(fields, metadata=dict(stamp(**plant, size=str(cost_map.size))))


def block_table(block: MapBlock, schema: pa.Schema) -> pa.Table:
    """Return a block as an Arrow table, in which NaN becomes null."""
    import pyarrow as pa

    columns = [_column(block.alpha), _column(block.beta), _bits(block.stable)]
    return pa.table([*columns, *(_column(values) for values in block.costs.values())], schema=schema)


def _column(values: Floats) -> pa.Array:
    """Return floats as a column without copying them. `pa.array` would first load numpy's masked arrays."""
    import pyarrow as pa

    known = ~np.isnan(values)
    valid = None if known.all() else _bits(known).buffers()[1]
    return pa.Array.from_buffers(pa.float64(), len(values), [valid, pa.py_buffer(np.ascontiguousarray(values))])


def _bits(values: Booleans) -> pa.Array:
    import pyarrow as pa

    return pa.Array.from_buffers(pa.bool_(), len(values), [None, pa.py_buffer(np.packbits(values, bitorder="little"))])
