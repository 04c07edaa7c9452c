"""Reads TDMS files of LabVIEW and other National Instruments tools: channels as ``/group/channel``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from io import BytesIO
from typing import Any

import numpy as np

from pipeline.base.errors import LogError
from pipeline.readers.formats.arrays import Array, StoredArray, frame_of_arrays, list_arrays, stored
from pipeline.readers.frame import ColumnInfo, Frame, Scalar
from pipeline.readers.isolation import isolated_reader
from pipeline.readers.safety import check_claim, library

TIME = "@time"
"""Name of the time that a waveform's properties imply: row times ``wf_increment`` plus ``wf_start_offset`` [s]."""

_SIGNATURE = b"TDSm"
_LONGEST_TEXT = 1000
_EPOCH_S = 2_082_844_800
"""Seconds from the start of 1904, where TDMS counts from, to that of 1970."""

read_frame, list_columns = isolated_reader(__name__, "a TDMS file", ("nptdms",))
"""Wanted are ``/group/channel``, and ``@time`` for the time that the waveform properties of the wanted channels imply
(all must agree). Time stamps are integers in ns since 1970, UTC. Attributes are the properties of the file by name,
those of groups and channels as ``/group/channel@property``."""


def frame_here(name: str, data: bytes, wanted: Sequence[str]) -> Frame:
    """Do what `read_frame` does, in the worker process."""
    with _open(name, data) as file:
        arrays, attributes = _contents(name, file, len(data))
        plain = [key for key in wanted if key != TIME]
        if TIME in wanted:
            arrays[TIME] = _waveform_time(name, plain or list(arrays), arrays, attributes, len(data))
        frame = frame_of_arrays(name, arrays, wanted, attributes)
        channels = [(f"/{group.name}/{one.name}", one) for group in file.groups() for one in group.channels()]
        stamps = {path: "ns" for path, channel in channels if channel.dtype.kind == "M"}
        return replace(frame, units={TIME: "s", **stamps})


def columns_here(name: str, data: bytes) -> list[ColumnInfo]:
    """Do what `list_columns` does, in the worker process."""
    with _open(name, data) as file:
        arrays, attributes = _contents(name, file, len(data))
        timed = [key for key in arrays if f"{key}@wf_increment" in attributes]
        if timed and len({arrays[key].shape for key in timed}) == 1:
            arrays[TIME] = _waveform_time(name, timed, arrays, attributes, len(data))
        return list_arrays(arrays)


def _open(name: str, data: bytes) -> Any:
    if not data.startswith(_SIGNATURE):
        raise LogError(
            f"{name} is no TDMS file: it begins with {data[:4]!r}, not {_SIGNATURE!r}. Correct `format` in the "
            "profile; a .tdms_index file holds no samples.",
            code="unsupported",
        )
    return library("nptdms", "npTDMS", "tdms").TdmsFile.open(BytesIO(data), raw_timestamps=True)


def _contents(name: str, file: Any, size: int) -> tuple[dict[str, StoredArray], dict[str, Scalar]]:
    arrays: dict[str, StoredArray] = {}
    attributes: dict[str, Scalar] = {}
    _keep(attributes, "", file.properties)
    for group in file.groups():
        _keep(attributes, f"/{group.name}@", group.properties)
        for channel in group.channels():
            path = f"/{group.name}/{channel.name}"
            _keep(attributes, f"{path}@", channel.properties)
            kind = {"f": "number", "U": "text", "S": "text", "O": "text"}.get(channel.dtype.kind, "integer")
            hint = str(attributes.get(f"{path}@unit_string", attributes.get(f"{path}@Unit", "")))
            load = partial(_load, name, path, channel, size)
            arrays[path] = StoredArray((len(channel),), kind, load, hint)
    return arrays, attributes


def _load(name: str, path: str, channel: Any, size: int) -> Array:
    # samples are not packed, so more than the file holds is a false claim; texts are checked by their offsets
    check_claim(name, f"channel {path!r}", len(channel) * max(channel.dtype.itemsize, 1), size)
    values = channel[:]
    if hasattr(values, "second_fractions"):
        # whole seconds and 2^-64 s; the upper half resolves 0.23 ns
        upper = np.asarray(values.second_fractions, dtype=np.uint64) >> np.uint64(32)
        fraction = (upper * np.uint64(10**9) + np.uint64(1 << 31)) >> np.uint64(32)
        seconds = np.asarray(values.seconds, dtype=np.int64) - _EPOCH_S
        return np.asarray(seconds * 10**9 + fraction.astype(np.int64))
    values = np.asarray(values)
    if values.dtype.kind == "c":
        raise LogError(
            f"{name}: channel {path!r} holds complex numbers. Export its real and imaginary parts.", code="unsupported"
        )
    return values


def _waveform_time(
    name: str, channels: Sequence[str], arrays: dict[str, StoredArray], attributes: dict[str, Scalar], size: int
) -> StoredArray:
    """Return the time of channels whose waveform properties agree."""
    stated = {
        key: (attributes.get(f"{key}@wf_increment"), attributes.get(f"{key}@wf_start_offset", 0.0), arrays[key].shape)
        for key in channels
        if key in arrays
    }
    values = set(stated.values())
    if len(values) != 1 or None in next(iter(values)):
        listing = ", ".join(f"{key!r}: {increment}" for key, (increment, _, _) in list(stated.items())[:10])
        raise LogError(
            f"{name}: {TIME!r} needs one wf_increment, wf_start_offset and length for all wanted channels; found the "
            f"increments {listing or 'of no channel'}. Name a channel of times in columns.time.name instead.",
            code="time-wrong",
        )
    increment, offset, (rows,) = values.pop()
    check_claim(name, f"{rows} samples", 8 * rows, size)
    return stored(float(offset) + np.arange(rows) * float(increment or 0.0), "s")


def _keep(attributes: dict[str, Scalar], prefix: str, properties: dict[str, Any]) -> None:
    for key, value in properties.items():
        if hasattr(value, "as_datetime64"):
            value = str(value.as_datetime64())
        elif isinstance(value, np.generic):
            value = value.item()
        if isinstance(value, str | int | float):
            attributes[prefix + key] = value[:_LONGEST_TEXT] if isinstance(value, str) else value
