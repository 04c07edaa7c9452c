"""One log as rows, with the residual of its wall law and what rounding of its printed numbers leaves of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.measured.signal.response import Response
from pipeline.records.batch import Booleans, Floats, TrialBatch

ROUNDINGS = 16.0
"""Units of rounding of the terms of the law up to which its residual is rounding: they are a dozen operations."""

ON_GRID = 1e-4
"""Distance from a multiple of a power of ten, relative to that power, of numbers printed with as many decimals."""

MOST_DECIMALS = 9
"""More decimals than these tell a number like one printed in full: its rounding is below every sensor's."""

CAUGHT_UP = 1.3
"""Way in the row after one that was held, relative to the way before it: twice at an even speed."""


@dataclass(frozen=True, eq=False)
class LogRows:
    """One log: rows as arrays of shape (N,), and its conditions."""

    stiffness: float
    damping: float
    step: float
    period: float
    edge: int
    floor: float
    time: Floats
    command: Floats
    position: Floats
    external: Floats
    rounding: float
    change: Floats = field(init=False)
    residual: Floats = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "change", np.diff(self.position, prepend=self.position[:1]))
        object.__setattr__(self, "residual", self.external - self.step * self.after)

    @classmethod
    def of(cls, batch: TrialBatch, response: Response, i: int, external: Floats) -> LogRows:
        """Return the rows of a trial of a batch, with its `external_force`."""
        rows = slice(0, int(batch.rows[i]))
        command, position = batch.command[i, rows], batch.position[i, rows]
        K, B, T = float(batch.stiffness[i]), float(batch.damping[i]), float(batch.sampling_period_s[i])
        of_command = _resolution(command)
        # the difference of two rounded positions is off by twice the rounding of one
        printed = of_command > ROUNDINGS * _rounding(command)
        of_position = _resolution(position) if printed else _rounding(position)
        rounding = ROUNDINGS * _rounding(external[rows]) + of_command + (2 * abs(K) + 2 * abs(B) / T) * of_position
        if not printed:
            rounding *= ROUNDINGS
        return cls(
            *(K, B, float(batch.step[i]), T, int(response.edge_row[i]), float(response.floor[i])),
            *(batch.time[i, rows], command, position, external[rows], rounding),
        )

    @property
    def after(self) -> Booleans:
        """Rows from the edge on."""
        result: Booleans = np.arange(len(self.position)) >= self.edge
        return result

    @property
    def wall(self) -> Floats:
        """Force of the wall by the law [N, Nm]."""
        return self.external - self.command

    def off(self, predicted: NDArray[np.floating[Any]], rows: Booleans | None = None) -> bool:
        """Whether the command is not the predicted one, over some rows or all."""
        error = np.abs(self.command - predicted)
        return bool((error if rows is None else error[rows]).max(initial=0.0) > self.rounding)


def _rounding(values: Floats) -> float:
    return float(np.finfo(np.float64).eps * np.nanmax(np.abs(values), initial=0.0))


def _resolution(values: Floats) -> float:
    """Return half the last digit that numbers were printed with, or rounding where they were printed in full."""
    finite = values[np.isfinite(values)]
    exact = _rounding(finite)
    if np.array_equal(finite.astype(np.float32).astype(np.float64), finite):
        exact = float(np.finfo(np.float32).eps * np.abs(finite).max(initial=0.0))
    for decimals in range(MOST_DECIMALS + 1):
        scaled = finite * 10.0**decimals
        if (np.abs(scaled - np.rint(scaled)) < ON_GRID).all() and len(np.unique(np.rint(scaled))) > 2:
            return max(0.5 * 10.0**-decimals, exact)
    return exact


def stands_still(change: Floats, after: Booleans, least: float | Floats) -> Booleans:
    """Return which rows stand still while the device moves by more than ``least`` before and after them."""
    # the row behind makes up for the way of the one that stood still; a device that turns comes back instead
    behind = np.concatenate([change[..., 1:], np.zeros_like(change[..., :1])], axis=-1)
    before = np.where(np.roll(change, 1, axis=-1) != 0, np.roll(change, 1, axis=-1), np.roll(change, 2, axis=-1))
    still = (change == 0) & after & (np.abs(behind) > least) & (np.abs(before) > least) & (behind * before > 0)
    result: Booleans = still & (np.abs(behind) > CAUGHT_UP * np.abs(before))
    return result
