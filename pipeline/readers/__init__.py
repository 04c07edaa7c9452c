"""Readers, one small module per file format, and what every reader hands on: a log in SI that was checked.

A reader is a function ``read(profile, raws, use_threads) -> list`` with one `Log`, or the `LogError` that
explains its refusal, for each raw log.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np

from pipeline.batch import Floats
from pipeline.errors import LogError
from pipeline.native import NativeHeader
from pipeline.profiles import Profile


@dataclass(frozen=True)
class RawLog:
    """The bytes of a log: of one file, or of both files of a pair."""

    names: tuple[str, ...]
    data: tuple[bytes, ...]


@dataclass(frozen=True, eq=False)
class Log:
    """One step response: conditions, and time [s], command [N, Nm], position [m, rad] of shape (rows,)."""

    header: NativeHeader
    time: Floats
    command: Floats
    position: Floats


Outcome = Log | LogError
Reader = Callable[[Profile, Sequence[RawLog], bool], list[Outcome]]


def reader_of(profile: Profile) -> Reader:
    """Return the reader of a profile's format."""
    module: Any = import_module(f"pipeline.readers.{profile.format}")
    read: Reader = module.read
    return read


def check_samples(header: NativeHeader, time: Floats, command: Floats, position: Floats, first_row: int) -> Log:
    """Return the log if its samples can be a step response.

    Parameters
    ----------
    header : NativeHeader
    time, command, position : float64, shape (rows,)
    first_row : int
        Line number of the first sample in the file, counted from 1; one sample a line.

    Raises
    ------
    LogError
        If there are fewer than two samples, a value is not finite, or time does not increase strictly.
    """
    if len(time) < 2:
        raise LogError(
            f"log has {len(time)} samples; expected at least 2. Was the recording cut off? Record it again.",
            first_row,
        )
    for name, values in (("time", time), ("command", command), ("position", position)):
        finite = np.isfinite(values)
        if not finite.all():
            at = int(np.argmin(finite))
            raise LogError(
                f"{name} is {values[at]}; expected a finite number. Repair the row, or leave this log out.",
                first_row + at,
            )
    increasing = time[1:] > time[:-1]
    if not increasing.all():
        at = int(np.argmin(increasing)) + 1
        raise LogError(
            f"time is {time[at]:.17g} s after {time[at - 1]:.17g} s; expected it to increase row by row. "
            "Sort out doubled or swapped rows, or leave this log out.",
            first_row + at,
        )
    return Log(header, time, command, position)
