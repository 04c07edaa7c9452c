"""Reads HDF5 files: datasets by path (``/arm/q``), fields of compound datasets (``/log.t``), elements (``/arm/q[3]``).

Nothing outside the file is opened: external links and external raw data are refused.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from itertools import count
from math import prod
from typing import Any

import numpy as np

from pipeline.base.errors import LogError
from pipeline.readers.formats.arrays import Array, Contents, StoredArray
from pipeline.readers.frame import ColumnInfo, Frame, Scalar
from pipeline.readers.isolation import isolated_reader, memory_for
from pipeline.readers.limits import MOST_DATASETS
from pipeline.readers.safety import check_claim, library

SIGNATURE = b"\x89HDF\r\n\x1a\n"

_HINTS = ("unit", "units", "Unit", "Units", "description", "long_name")
_LONGEST_TEXT = 1000
"""Characters of an attribute that are kept."""
_IMAGES = count()


read_frame, list_columns = isolated_reader(__name__, "an HDF5 file", ("h5py",))
"""Wanted columns are paths, with or without the first slash; what cannot be read is listed with no rows and the reason.
Attributes are those of the file by name, those of a group or dataset as ``/path@name``, and single values by path."""


def frame_here(name: str, data: bytes, wanted: Sequence[str]) -> Frame:
    """Do what `read_frame` does, in the worker process."""
    _check_signature(name, data)
    with open_image(data, "hdf5") as file:
        full = [key if key.startswith("/") else f"/{key}" for key in wanted]
        frame = _collect(name, file, len(data)).frame(name, full)
        named = {key: frame.columns[path] for key, path in zip(wanted, full, strict=True)}
        return replace(frame, columns=named) if wanted else frame


def columns_here(name: str, data: bytes) -> list[ColumnInfo]:
    """Do what `list_columns` does, in the worker process."""
    _check_signature(name, data)
    with open_image(data, "hdf5") as file:
        return _collect(name, file, len(data)).listed()


def is_hdf5(data: bytes) -> bool:
    """Return whether bytes are an HDF5 file, which allows a foreign header of 512, 1024, ... bytes."""
    return SIGNATURE in {data[at : at + 8] for at in (0, 512, 1024, 2048)}


def _check_signature(name: str, data: bytes) -> None:
    if not is_hdf5(data):
        raise LogError(
            f"{name} is no HDF5 file: its signature is missing. Correct `format` in the profile, or export it again.",
            code="unsupported",
        )


@contextmanager
def open_image(data: bytes, extra: str) -> Iterator[Any]:
    """Open the bytes of an HDF5 file in memory.

    Parameters
    ----------
    data : bytes
    extra : str
        Extra of this package that installs h5py.

    Raises
    ------
    LogError
        If h5py is not installed.
    """
    h5py = library("h5py", "h5py", extra)
    access = h5py.h5p.create(h5py.h5p.FILE_ACCESS)
    access.set_fapl_core(1 << 20, 0)
    access.set_file_image(data)
    # two images open at a time under one name would be taken for one file
    image = b"image %d" % next(_IMAGES)
    with h5py.File(h5py.h5f.open(image, h5py.h5f.ACC_RDONLY, fapl=access)) as file:
        yield file


def load_dataset(name: str, dataset: Any, size: int) -> Array:
    """Return the values of a dataset, after a look at how many it claims.

    Raises
    ------
    LogError
        If it, or one of its chunks, claims more memory than `safety.allowed_bytes`.
    """
    # of one value a whole chunk is unpacked
    parts = {"dataset": dataset.shape, "a chunk of dataset": dataset.chunks or ()}
    claims = {what: prod(shape) * max(dataset.dtype.itemsize, 1) for what, shape in parts.items()}
    for what, claimed in claims.items():
        check_claim(name, f"{what} {dataset.name!r}", claimed, size)
    # what is packed may be more than what is claimed; texts are not claimed, and stand in the file as they are
    with memory_for(sum(claims.values()) + (size if is_text(dataset) else 0)):
        values: Array = dataset.asstr()[()] if is_text(dataset) else dataset[()]
    return np.asarray(values)


def is_text(dataset: Any) -> bool:
    """Return whether a dataset holds strings."""
    return (
        dataset.dtype.kind in "SO" and dataset.id.get_type().get_class() == library("h5py", "h5py", "hdf5").h5t.STRING
    )


def walk(name: str, group: Any) -> Iterator[Any]:
    """Yield all groups and datasets below a group, each once; links to other files are not followed.

    Raises
    ------
    LogError
        If there are more than `MOST_DATASETS`.
    """
    h5py = library("h5py", "h5py", "hdf5")
    seen = {h5py.h5o.get_info(group.id).addr}
    waiting = [group]
    while waiting:
        here = waiting.pop()
        inner = []
        for key in here:
            if not isinstance(here.get(key, getlink=True), h5py.HardLink):
                continue
            item = here[key]
            address = h5py.h5o.get_info(item.id).addr
            if address in seen:
                continue
            seen.add(address)
            if len(seen) > MOST_DATASETS:
                raise LogError(
                    f"{name} has more than {MOST_DATASETS} datasets; expected a log. Export its signals only.",
                    code="too-many-columns",
                )
            yield item
            if isinstance(item, h5py.Group):
                inner.append(item)
        waiting += reversed(inner)


def _collect(name: str, file: Any, size: int) -> Contents:
    contents = Contents()
    _keep_attributes(contents.attributes, "", file)
    for item in walk(name, file):
        _keep_attributes(contents.attributes, f"{item.name}@", item)
        if not hasattr(item, "dtype"):
            continue
        if item.shape is None:
            contents.refused[item.name] = "is empty: it has no values."
            continue
        _add_dataset(name, contents, item, size)
    return contents


def _add_dataset(name: str, contents: Contents, dataset: Any, size: int) -> None:
    path, dtype = dataset.name, dataset.dtype
    hint = next((str(dataset.attrs[key]) for key in _HINTS if key in dataset.attrs), "")[:_LONGEST_TEXT]
    if dataset.external or dataset.is_virtual:
        contents.refused[path] = "has its values in other files, which are not opened. Export it with its values."
    elif dtype.names:
        for part in dtype.names:
            inner = dtype[part].base
            if inner.kind in "fbiu":
                shape = dataset.shape + dtype[part].shape
                contents.arrays[f"{path}.{part}"] = StoredArray(
                    shape, _kind(inner), partial(_load_field, name, dataset, part, size), hint
                )
            else:
                contents.refused[f"{path}.{part}"] = f"is of type {inner}; expected numbers."
    elif dtype.kind in "fbiu" or is_text(dataset):
        load = partial(load_dataset, name, dataset, size)
        contents.keep(path, StoredArray(dataset.shape or (1,), _kind(dtype), load, hint))
    else:
        contents.refused[path] = f"is of type {dtype}; expected numbers or texts."


def _load_field(name: str, dataset: Any, part: str, size: int) -> Array:
    return np.asarray(load_dataset(name, dataset, size)[part])


def _kind(dtype: np.dtype[Any]) -> str:
    return {"f": "number", "S": "text", "O": "text"}.get(dtype.kind, "integer")


def _keep_attributes(attributes: dict[str, Scalar], prefix: str, item: Any) -> None:
    for key, value in _readable(item.attrs):
        if isinstance(value, bytes):
            value = value.decode("utf-8", "replace")
        if isinstance(value, np.ndarray) and value.size == 1:
            value = value.reshape(-1)[0]
        if isinstance(value, np.generic):
            value = value.item()
        if isinstance(value, str | int | float):
            attributes[prefix + key] = value[:_LONGEST_TEXT] if isinstance(value, str) else value


def _readable(attrs: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    for key in attrs:
        try:
            yield key, attrs[key]
        except OSError:
            # an attribute of a type that h5py does not know is no condition of a log; the samples do not need it
            continue
