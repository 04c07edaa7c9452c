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
    """One step response: conditions, and time [s], command [N, Nm], position [m, rad] of shape (rows,).

    ``force`` [N, Nm] and ``velocity`` [m/s, rad/s] are there where the log has them.
    """

    header: NativeHeader
    time: Floats
    command: Floats
    position: Floats
    force: Floats | None = None
    velocity: Floats | None = None


Outcome = Log | LogError
Reader = Callable[[Profile, Sequence[RawLog], bool], list[Outcome]]


def reader_of(profile: Profile) -> Reader:
    """Return the reader of a profile's format."""
    module: Any = import_module(f"pipeline.readers.{profile.format}")
    read: Reader = module.read
    return read


def check_samples(
    header: NativeHeader,
    time: Floats,
    command: Floats,
    position: Floats,
    first_row: int,
    force: Floats | None = None,
    velocity: Floats | None = None,
) -> Log:
    """Return the log if its samples can be a step response.

    Parameters
    ----------
    header : NativeHeader
    time, command, position : float64, shape (rows,)
    first_row : int
        Line number of the first sample in the file, counted from 1; one sample a line.
    force, velocity : float64, shape (rows,), optional

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
    step_row = int(header.extra.get("step_row", 0))
    if step_row >= len(time):
        raise LogError(
            f"step_row is {step_row}, but the log has {len(time)} samples. Count from 0; correct header or profile.",
            first_row,
        )
    columns = {"time": time, "command": command, "position": position, "force": force, "velocity": velocity}
    for name, values in columns.items():
        if values is None:
            continue
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
    return Log(header, time, command, position, force, velocity)
