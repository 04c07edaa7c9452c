"""Data frames with fixed columns in SI; ``attrs["units"]`` names the unit of each column that has one."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from pipeline.records.models import Motion
from pipeline.records.tables import COLUMNS

SAMPLES = ("time_s", "command", "position", "force", "velocity")
"""Columns of a step response; the last two are NaN where a log has none."""

_MOTIONS: tuple[Motion, ...] = ("translation", "rotation")


def units_of(columns: Iterable[str], motions: Collection[str] = _MOTIONS) -> dict[str, str]:
    """Return the units of stored columns, without those that have none; both where motions differ."""
    kinds = [motion for motion in _MOTIONS if motion in motions]
    units = {}
    for name in columns:
        if name in COLUMNS:
            column = COLUMNS[name]
            of = {"translation": column.unit, "rotation": column.unit_rotation}
            units[name] = " or ".join(dict.fromkeys(of[kind] for kind in kinds))
    return {name: unit for name, unit in units.items() if unit}


def frame_of(
    columns: Sequence[str], rows: Iterable[Mapping[str, Any]], numbers: Collection[str], units: Mapping[str, str]
) -> pd.DataFrame:
    """Return records as rows: the columns in this order also where there is no row; None in ``numbers`` is NaN."""
    frame = pd.DataFrame([[row.get(name) for name in columns] for row in rows], columns=list(columns))
    frame = frame.astype({name: np.float64 for name in columns if name in numbers})
    frame.attrs["units"] = dict(units)
    return frame


def frame_of_stored(table: pa.Table) -> pd.DataFrame:
    """Return rows of the trials table, with the units of the motions that occur."""
    frame = table.to_pandas()
    frame.attrs = {"units": units_of(table.column_names, table.column("motion").unique().to_pylist() or _MOTIONS)}
    return frame


def frame_of_response(samples: Mapping[str, Any], motion: Motion, about: Mapping[str, Any]) -> pd.DataFrame:
    """Return one step response, shape (rows, 5), with its conditions in ``attrs``."""
    rows = len(samples["time_s"])
    columns = {name: np.full(rows, np.nan) if samples.get(name) is None else samples[name] for name in SAMPLES}
    frame = pd.DataFrame(columns)
    frame.attrs = {"units": units_of((*SAMPLES, "stiffness", "damping", "step", "sampling_period_s"), {motion})}
    frame.attrs |= {"motion": motion, **about}
    return frame
