"""Reads MATLAB files: version 5 (``save``, ``-v6``, ``-v7``) and 7.3 (an HDF5 file with MATLAB's conventions).

Columns are plain arrays by name, fields of structs by dotted path, elements of struct arrays and of matrices in
brackets, counted from 0. A Simulink "Structure with time" is such a struct: ``scope.time``,
``scope.signals[1].values[0]``. Objects (timeseries, table, string, Simulink.SimulationOutput) are refused.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

from pipeline.base.errors import LogError
from pipeline.readers.formats.hdf5 import is_hdf5, open_image
from pipeline.readers.formats.matlab5 import MatContents, collect_version_5
from pipeline.readers.formats.matlab73 import collect
from pipeline.readers.frame import ColumnInfo, Frame
from pipeline.readers.isolation import isolated_reader

read_frame, list_columns = isolated_reader(__name__, "a MATLAB file", ("h5py", "scipy.io"))
"""Single numbers and texts are attributes; objects are listed with no rows and the reason as hint."""


def frame_here(name: str, data: bytes, wanted: Sequence[str]) -> Frame:
    """Read columns by paths such as ``"t"``, ``"log.position"``, ``"scope.signals[1].values[0]"``, in the worker."""
    with _opened(name, data) as contents:
        return contents.frame(name, wanted)


def columns_here(name: str, data: bytes) -> list[ColumnInfo]:
    """List the arrays, in the worker process."""
    with _opened(name, data) as contents:
        return contents.listed()


@contextmanager
def _opened(name: str, data: bytes) -> Iterator[MatContents]:
    if not is_hdf5(data):
        yield _version_5(name, data)
        return
    with open_image(data, "mat") as file:
        yield collect(name, file, len(data))


def _version_5(name: str, data: bytes) -> MatContents:
    if data[126:128] not in (b"IM", b"MI"):
        raise LogError(
            f"{name} is no MATLAB file: expected version 5 or 7.3, found the first bytes {data[:16]!r}. A version 4 "
            "file must be saved again: save('log.mat', 't', 'x', '-v7'). Otherwise correct `format` in the profile.",
            code="unsupported",
        )
    contents = collect_version_5(name, data)
    for path, array in contents.arrays.items():
        # Simulink writes what a signal is beside its values
        label = contents.attributes.get(path.removesuffix("values") + "label") if path.endswith(".values") else None
        if label:
            contents.arrays[path] = replace(array, hint=str(label))
    return contents
