"""Read files from measuring systems, in the formats HDF5, TDMS (LabVIEW) and MDF (dSPACE, CANape and INCA).

HDF5: columns are paths of datasets (``/arm/q``), fields of compound datasets (``/log.t``), and elements
(``/arm/q[3]``). Values stored in other files (external links) are not read.

TDMS: columns are channels (``/group/channel``). ``@time`` is the time [s] from the waveform properties of the wanted
channels, if they are equal: row times ``wf_increment`` plus ``wf_start_offset``. Stamps are integer nanoseconds since
1970.

MDF: columns are channels with the number of their group (``0/name``). The time is ``0/@time`` [s].
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.base.errors import refusal
from pipeline.base.wording import listed
from pipeline.profiles.profile_model import Profile
from pipeline.readers.file_columns import Array, FileColumns, library

TIME = "@time"
_HINTS = ("unit", "units", "Unit", "Units", "unit_string", "description", "long_name")
_WAVEFORM: dict[str, Any] = {"wf_increment": None, "wf_start_offset": 0.0, "wf_start_time": None}
"""TDMS properties that determine the sample times of a channel, with their defaults."""

_EPOCH_S = 2_082_844_800
"""Seconds from the start of 1904, the origin of TDMS time stamps, to the start of 1970."""


def read_hdf5(path: Path, settings: Profile, contents: FileColumns) -> None:
    """Add the datasets. Wanted columns are paths, with or without the first slash."""
    h5py = library("h5py", "hdf5")

    def values(item: Any, part: str) -> Array:
        if part:
            return np.asarray(item.fields(part)[()])
        text = h5py.check_string_dtype(item.dtype) is not None
        return np.asarray(item.asstr()[()] if text else item[()])

    def add(name: str, item: Any) -> None:
        path = f"/{name}"
        _note(contents, f"{path}@", item.attrs)
        if not isinstance(item, h5py.Dataset):
            return
        if item.shape is None:
            contents.refused[path] = "is empty."
        elif item.external or item.is_virtual:
            contents.refused[path] = (
                "has its values in other files, which are not opened. Export this dataset together with its values."
            )
        elif contents.wants(path) or item.size == 1:
            for part in item.dtype.names or ("",):
                contents.add(f"{path}.{part}" if part else path, partial(values, item, part), _hint(item.attrs))

    with h5py.File(path) as file:
        _note(contents, "", file.attrs)
        file.visititems(add)


def read_tdms(path: Path, settings: Profile, contents: FileColumns) -> None:
    """Add the channels, with their properties as attributes ``/group/channel@property``."""
    with library("nptdms", "tdms").TdmsFile.open(path, raw_timestamps=True) as file:
        _note(contents, "", file.properties)
        for group in file.groups():
            _note(contents, f"/{group.name}@", group.properties)
            for channel in group.channels():
                name = f"/{group.name}/{channel.name}"
                _note(contents, f"{name}@", channel.properties)
                if contents.wants(name) or len(channel) == 1 or contents.wanted == (TIME,):
                    unit = "ns" if channel.dtype.kind == "M" else ""
                    contents.add(name, partial(_of_channel, channel), _hint(channel.properties), unit)
    if settings.trials is not None:
        _add_group_times(contents)
        return
    if contents.wanted and TIME not in contents.wanted:
        return
    names = [key for key in contents.wanted if key != TIME] or list(contents.columns)
    waveforms = {
        key: tuple(contents.attributes.get(f"{key}@{name}", default) for name, default in _WAVEFORM.items())
        for key in names
        if key in contents.columns and (contents.wanted or f"{key}@wf_increment" in contents.attributes)
    }
    waveform = next(iter(waveforms.values()), (None,))
    if len(set(waveforms.values())) == 1 and waveform[0] is not None:
        increment, offset = float(waveform[0]), float(waveform[1])
        rows = contents.columns[next(iter(waveforms))].size
        contents.add(TIME, offset + np.arange(rows) * increment, "s", "s")
    elif contents.wanted:
        differ = next((i for i in range(len(_WAVEFORM)) if len({each[i] for each in waveforms.values()}) > 1), 0)
        named = f"{list(_WAVEFORM)[differ]} " if differ else ""
        listing = ", ".join(f"{key!r}: {named}{each[differ]}" for key, each in list(waveforms.items())[:10])
        found = f"{TIME!r} needs one {listed(list(_WAVEFORM))} for all wanted channels, found {listing or 'none'}"
        cure = "Record the channels in one task, or export a channel of times and state its name in columns.time."
        raise refusal("time-wrong", contents.name, found, cure=cure)


def _add_group_times(contents: FileColumns) -> None:
    """Add the time of each group whose channels have the same waveform properties."""
    groups: dict[str, list[str]] = {}
    for name in list(contents.columns):
        groups.setdefault(name.rpartition("/")[0], []).append(name)
    for group, names in groups.items():
        waveforms = {
            tuple(contents.attributes.get(f"{name}@{key}", default) for key, default in _WAVEFORM.items())
            for name in names
        }
        rows = {len(contents.columns[name]) for name in names}
        increment, offset, *_ = next(iter(waveforms))
        if len(waveforms) == 1 == len(rows) and increment is not None and offset is not None:
            contents.add(f"{group}/{TIME}", float(offset) + np.arange(rows.pop()) * float(increment), "s", "s")


def read_mdf(path: Path, settings: Profile, contents: FileColumns) -> None:
    """Add the channels of all groups with their units. Times are in seconds from the start of the measurement."""
    with library("asammdf", "mdf").MDF(path) as file:
        for number, group in enumerate(file.groups):
            if contents.wants(time := f"{number}/{TIME}"):
                contents.add(time, file.get_master(number), "s", "s")
            master = file.masters_db.get(number)
            for index, channel in enumerate(group.channels):
                name = f"{number}/{channel.name}"
                if index != master and contents.wants(name):
                    signal = file.get(group=number, index=index)
                    contents.add(name, signal.samples, signal.unit or "")


def _of_channel(channel: Any) -> Array:
    values = channel[:]
    if not hasattr(values, "second_fractions"):
        return np.asarray(values)
    # A stamp consists of integer seconds and a 64-bit fraction. The upper 32 bits of the fraction resolve 0.23 ns.
    upper = np.asarray(values.second_fractions, dtype=np.uint64) >> np.uint64(32)
    fraction = (upper * np.uint64(10**9) + np.uint64(1 << 31)) >> np.uint64(32)
    return (np.asarray(values.seconds, dtype=np.int64) - _EPOCH_S) * 10**9 + fraction.astype(np.int64)


def _hint(attributes: Any) -> str:
    return next((str(attributes[key]) for key in _HINTS if key in attributes), "")


def _note(contents: FileColumns, prefix: str, attributes: Any) -> None:
    for key in attributes:
        try:
            value = attributes[key]
        except OSError:
            # Skip attributes of types that h5py cannot read, because they are not conditions of a log.
            continue
        contents.note(prefix + key, str(value.as_datetime64()) if hasattr(value, "as_datetime64") else value)
