"""HDF5 files: datasets by path (``/arm/q``), fields of compound datasets (``/log.t``), elements (``/arm/q[3]``).

Nothing outside the file is opened: links to other files are not followed, values in other files are refused.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from pipeline.profiles.profile_model import Profile
from pipeline.readers.frame import Array, Contents

_HINTS = ("unit", "units", "Unit", "Units", "description", "long_name")


def read(path: Path, settings: Profile, contents: Contents) -> None:
    """Add the datasets; wanted columns are paths, with or without the first slash."""
    with h5py.File(path) as file:
        _note(contents, "", file)
        file.visititems(partial(_add, contents))


def _add(contents: Contents, name: str, item: Any) -> None:
    path = f"/{name}"
    _note(contents, f"{path}@", item)
    if not isinstance(item, h5py.Dataset):
        return
    if item.shape is None:
        contents.refused[path] = "is empty: it has no values."
    elif item.external or item.is_virtual:
        contents.refused[path] = "has its values in other files, which are not opened. Export it with its values."
    elif contents.asks(path) or item.size == 1:
        hint = next((str(item.attrs[key]) for key in _HINTS if key in item.attrs), "")
        for part in item.dtype.names or ("",):
            contents.add(f"{path}.{part}" if part else path, partial(_values, item, part), hint)


def _values(item: Any, part: str) -> Array:
    if part:
        return np.asarray(item.fields(part)[()])
    text = h5py.check_string_dtype(item.dtype) is not None
    return np.asarray(item.asstr()[()] if text else item[()])


def _note(contents: Contents, prefix: str, item: Any) -> None:
    for key in item.attrs:
        try:
            contents.note(prefix + key, item.attrs[key])
        except OSError:
            # an attribute of a type that h5py does not know is no condition of a log; the samples do not need it
            continue
