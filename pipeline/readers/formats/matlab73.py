"""MATLAB 7.3 files, which are HDF5 files: arrays stored transposed, structs as groups, cells as references."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from pipeline.readers.formats.arrays import Array, StoredArray
from pipeline.readers.formats.hdf5 import load_dataset
from pipeline.readers.formats.matlab5 import COMPLEX, SPARSE, MatContents, object_advice
from pipeline.readers.safety import library

_NUMBERS = {"double", "single", "logical", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))}


def collect(name: str, file: Any, size: int) -> MatContents:
    """Return what a MATLAB 7.3 file holds; arrays are loaded when they are asked for.

    Parameters
    ----------
    name : str
        The file.
    file : h5py.File
        Stays open as long as arrays are loaded.
    size : int
        Bytes of the file.

    Raises
    ------
    LogError
        If it claims more arrays than a log has.
    """
    collector = _Collector(name, file, size)
    for key in file:
        if not key.startswith("#"):  # insides of objects: #refs#, #subsystem#, #sigstream#
            collector.add(key, file[key], 0)
    return collector.contents


class _Collector:
    def __init__(self, name: str, file: Any, size: int) -> None:
        self.name, self.file, self.size = name, file, size
        self.h5py = library("h5py", "h5py", "mat")
        self.contents = MatContents(name=name)

    def add(self, path: str, item: Any, depth: int) -> None:
        """Add a variable, a field of a struct or an element of a cell."""
        self.contents.count(depth)
        kind = self._class(item)
        if "MATLAB_object_decode" in item.attrs or (kind not in _NUMBERS | {"char", "cell", "struct", ""}):
            self.contents.refused[path] = object_advice(kind)
        elif "MATLAB_sparse" in item.attrs:
            self.contents.refused[path] = SPARSE
        elif isinstance(item, self.h5py.Group):
            for key in item:
                self.add(f"{path}.{key}", item[key], depth + 1)
        elif item.attrs.get("MATLAB_empty", 0):
            self._array(path, (0,), "number", partial(np.empty, 0))
        elif item.dtype == self.h5py.ref_dtype:
            self._references(path, item, kind, depth)
        elif item.dtype.names:
            self.contents.refused[path] = COMPLEX
        elif kind == "char":
            self._array(path, (item.shape[-1],), "text", partial(self._characters, item))
        elif item.dtype.kind in "fbiu":
            number = "number" if item.dtype.kind == "f" else "integer"
            self._array(path, item.shape[::-1], number, partial(self._transposed, item))
        else:
            self.contents.refused[path] = f"is of type {item.dtype}; expected numbers."

    def _array(self, path: str, shape: tuple[int, ...], kind: str, load: Any) -> None:
        self.contents.keep(path, StoredArray(shape, kind, load))

    def _references(self, path: str, item: Any, kind: str, depth: int) -> None:
        """Add the elements of a cell or, where a struct is an array, of one of its fields."""
        references = load_dataset(self.name, item, self.size).reshape(-1)
        cell = kind == "cell"
        # fields of a struct array are arrays of references: a.b -> a[0].b, a[1].b, ...
        stem, dot, last = ("", "", path) if cell else path.rpartition(".")
        for number, reference in enumerate(references):
            place = f"{path}[{number}]" if cell else f"{stem}[{number}]{dot}{last}"
            self.add(place, self.file[reference], depth + 1)
        if cell:
            self.contents.join_texts(path, len(references))

    def _transposed(self, item: Any) -> Array:
        return load_dataset(self.name, item, self.size).T

    def _characters(self, item: Any) -> Array:
        codes = load_dataset(self.name, item, self.size)
        return np.array(["".join(map(chr, row)).rstrip() for row in codes.reshape(codes.shape[0], -1).T])

    def _class(self, item: Any) -> str:
        value = item.attrs.get("MATLAB_class", b"")
        return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)
