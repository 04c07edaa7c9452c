"""TDMS files of LabVIEW and other National Instruments tools: channels as ``/group/channel``.

``@time`` is the time [s] that the waveform properties of the wanted channels imply: row times ``wf_increment`` plus
``wf_start_offset``. Time stamps are whole nanoseconds since 1970, UTC.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from nptdms import TdmsFile

from pipeline.base.errors import refusal
from pipeline.profiles.profile_model import Profile
from pipeline.readers.frame import Array, Contents

TIME = "@time"
_EPOCH_S = 2_082_844_800
"""Seconds from the start of 1904, where TDMS counts from, to that of 1970."""


def read(path: Path, settings: Profile, contents: Contents) -> None:
    """Add the channels, and their properties as attributes ``/group/channel@property``."""
    with TdmsFile.open(path, raw_timestamps=True) as file:
        _note(contents, "", file.properties)
        for group in file.groups():
            _note(contents, f"/{group.name}@", group.properties)
            for channel in group.channels():
                name = f"/{group.name}/{channel.name}"
                _note(contents, f"{name}@", channel.properties)
                if contents.asks(name) or len(channel) == 1 or contents.wanted == (TIME,):
                    hint = str(channel.properties.get("unit_string", channel.properties.get("Unit", "")))
                    contents.add(name, partial(_values, channel), hint, "ns" if channel.dtype.kind == "M" else "")
    if not contents.wanted or TIME in contents.wanted:
        _add_time(contents)


def _values(channel: Any) -> Array:
    values = channel[:]
    if not hasattr(values, "second_fractions"):
        return np.asarray(values)
    # whole seconds and 2^-64 s; the upper half resolves 0.23 ns
    upper = np.asarray(values.second_fractions, dtype=np.uint64) >> np.uint64(32)
    fraction = (upper * np.uint64(10**9) + np.uint64(1 << 31)) >> np.uint64(32)
    return (np.asarray(values.seconds, dtype=np.int64) - _EPOCH_S) * 10**9 + fraction.astype(np.int64)


def _add_time(contents: Contents) -> None:
    """Add the time of channels whose waveform properties agree."""
    names = [key for key in contents.wanted if key != TIME] or list(contents.columns)
    found = {
        key: (contents.attributes.get(f"{key}@wf_increment"), contents.attributes.get(f"{key}@wf_start_offset", 0.0))
        for key in names
        if key in contents.columns and (contents.wanted or f"{key}@wf_increment" in contents.attributes)
    }
    if len(set(found.values())) == 1 and None not in (waveform := next(iter(found.values()))):
        increment, offset = map(float, waveform)  # type: ignore[arg-type]
        rows = contents.columns[next(iter(found))].size
        contents.add(TIME, offset + np.arange(rows) * increment, "s", "s")
    elif contents.wanted:
        listing = ", ".join(f"{key!r}: {increment}" for key, (increment, _) in list(found.items())[:10])
        text = f"{TIME!r} needs one wf_increment and wf_start_offset for all wanted channels, found {listing or 'none'}"
        cure = "Name a channel of times in columns.time.name instead."
        raise refusal("time-wrong", contents.name, text, cure=cure)


def _note(contents: Contents, prefix: str, properties: dict[str, Any]) -> None:
    for key, value in properties.items():
        contents.note(prefix + key, str(value.as_datetime64()) if hasattr(value, "as_datetime64") else value)
