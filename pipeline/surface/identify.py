"""From logs to the device that made them: `import pipeline; pipeline.identify(paths)`."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd

from pipeline.base.disk import write_text
from pipeline.rendering.frames import frame_of
from pipeline.surface.identified_device import device_text, identified_device, wall_loop
from pipeline.surface.physical_loop import Loop

Place = str | os.PathLike[str]

COLUMNS = ("name", "value", "low", "high", "unit", "told")


@dataclass(frozen=True, eq=False)
class Identified:
    """A device as logs show it.

    ``estimates``: ``name``, ``value``, ``low``, ``high``, ``unit``, ``told`` (whether the logs tell it alone);
    ``replay``: ``log``, ``fit_percent``; ``loop``: the linear loop as `Loop`, None where mass or delay are not told;
    ``document``: what `pipeline identify --json` prints.
    """

    document: dict[str, Any]

    @property
    def estimates(self) -> pd.DataFrame:
        """Parameters with their 95 % intervals."""
        rows = self.document["parameters"]
        return frame_of(COLUMNS, rows, {row["name"]: row["unit"] for row in rows})

    @property
    def replay(self) -> pd.DataFrame:
        """Fit of free runs to held-out logs."""
        return frame_of(("log", "fit_percent"), self.document["replay"]["logs"], {})

    @cached_property
    def loop(self) -> Loop | None:
        """The linear loop of the device, without friction."""
        numbers = wall_loop(self.document)
        return None if numbers is None else Loop(**numbers, motion=self.document["motion"])

    def write(self, path: Place) -> None:
        """Write a device file that theory, simulator and planner take.

        Raises
        ------
        ParameterError
            If mass or delay are not told.
        """
        write_text(Path(path), device_text(self.document, Path(path).stem))


def identify(
    paths: Place | Sequence[Place],
    profile: Place | None = None,
    *,
    period: float | None = None,
    delay: float | None = None,
) -> Identified:
    """Identify a device from any logs with command and position; no wall and no rest are needed.

    Parameters
    ----------
    paths : path, or sequence of them
        Logs, and folders that are searched with all below.
    profile : str or path, optional
        As in `ingest`.
    period : float, optional
        Sampling period T [s] of the wall that the device would render; that of the logs where not given.
    delay : float, optional
        Its delay [samples of T]; that of the logs where not given.

    Raises
    ------
    LogError
        If a log is refused, with path and row.
    ParameterError
        If the logs hold no motion, no command or too few rows, or a value is out of range.
    UsageError
        If a path does not exist, or no log is found.
    """
    places = [paths] if isinstance(paths, (str, os.PathLike)) else list(paths)
    given = profile if profile is None or isinstance(profile, str) else Path(profile)
    return Identified(identified_device([Path(path) for path in places], given, period, delay))
