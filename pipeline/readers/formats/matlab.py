"""Reads MATLAB files: version 5 (``save``, ``-v6``, ``-v7``) and 7.3 (an HDF5 file with MATLAB's conventions).

Columns are plain arrays by name, fields of structs by dotted path, elements of struct arrays and of matrices in
brackets, counted from 0. A Simulink "Structure with time" is such a struct: ``scope.time``,
``scope.signals[1].values[0]``. Objects (timeseries, table, string, Simulink.SimulationOutput) are refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from pipeline.base.errors import LogError
from pipeline.profiles.profile_model import Profile
from pipeline.readers.formats.arrays import frame_of_arrays, list_arrays
from pipeline.readers.formats.hdf5 import is_hdf5, open_image
from pipeline.readers.formats.matlab5 import HEADER, MatContents, parse_mat5
from pipeline.readers.formats.matlab73 import collect
from pipeline.readers.frame import ColumnInfo, Frame
from pipeline.readers.isolation import isolated
from pipeline.readers.safety import reading

KIND = "a MATLAB file"


def read_frame(profile: Profile, name: str, data: bytes, wanted: Sequence[str]) -> Frame:
    """Read columns of a MATLAB file.

    Parameters
    ----------
    profile : Profile
        Not used: the file names its arrays.
    name : str
        File name, for messages.
    data : bytes
    wanted : sequence of str
        Paths such as ``"t"``, ``"log.position"``, ``"scope.signals[1].values[0]"``; empty means all.

    Returns
    -------
    Frame
        Rows are samples. Single numbers and texts are the attributes.

    Raises
    ------
    LogError
        If the file is damaged, an array is missing or an object, or lengths differ.
    """
    if is_hdf5(data):
        frame: Frame = isolated(f"{__name__}:frame_here", name, KIND, data, tuple(wanted), imports=("h5py",))
        return frame
    with reading(name, KIND):
        return _frame(name, _version_5(name, data), wanted)


def list_columns(name: str, data: bytes, profile: Profile | None = None) -> list[ColumnInfo]:
    """Return the arrays of a MATLAB file; objects are listed with no rows and the reason as hint.

    Raises
    ------
    LogError
        If the file is damaged.
    """
    if is_hdf5(data):
        infos: list[ColumnInfo] = isolated(f"{__name__}:columns_here", name, KIND, data, imports=("h5py",))
        return infos
    with reading(name, KIND):
        return _infos(_version_5(name, data))


def frame_here(name: str, data: bytes, wanted: Sequence[str]) -> Frame:
    """Do what `read_frame` does with a version 7.3 file, in the worker process."""
    with reading(name, KIND), open_image(data, "mat") as file:
        return _frame(name, collect(name, file, len(data)), wanted)


def columns_here(name: str, data: bytes) -> list[ColumnInfo]:
    """Do what `list_columns` does with a version 7.3 file, in the worker process."""
    with reading(name, KIND), open_image(data, "mat") as file:
        return _infos(collect(name, file, len(data)))


def _version_5(name: str, data: bytes) -> MatContents:
    if len(data) < HEADER or data[126:128] not in (b"IM", b"MI"):
        raise LogError(
            f"{name} is no MATLAB file: expected version 5 or 7.3, found the first bytes {data[:16]!r}. A version 4 "
            "file must be saved again: save('log.mat', 't', 'x', '-v7'). Otherwise correct `format` in the profile.",
            code="unsupported",
        )
    contents = parse_mat5(name, data)
    for path, array in contents.arrays.items():
        # Simulink writes what a signal is beside its values
        label = contents.attributes.get(path.removesuffix("values") + "label") if path.endswith(".values") else None
        if label:
            contents.arrays[path] = replace(array, hint=str(label))
    return contents


def _frame(name: str, contents: MatContents, wanted: Sequence[str]) -> Frame:
    arrays = contents.arrays
    if not wanted:
        # single numbers and texts are attributes; columns are what is longer
        arrays = {path: array for path, array in arrays.items() if path not in contents.attributes}
    return frame_of_arrays(name, arrays, wanted, contents.attributes, contents.refused)


def _infos(contents: MatContents) -> list[ColumnInfo]:
    refused = [ColumnInfo(path, "text", 0, (), reason) for path, reason in contents.refused.items()]
    return list_arrays(contents.arrays) + refused
