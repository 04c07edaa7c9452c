"""One log as rows, with the residual of its wall law and what rounding of its printed numbers leaves of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.measured.law.digits import full_resolution, printed, stated_resolution
from pipeline.measured.signal.response import Response
from pipeline.records.batch import Booleans, Floats, TrialBatch

ROUNDINGS = 16.0
"""Units of rounding of the terms of the law up to which its residual is rounding: they are a dozen operations."""

SINGLE_ROUNDINGS = 1.0
"""The same where commands are of single precision: less than its own digit leaves open."""

_EPS, _SINGLE = float(np.finfo(np.float64).eps), float(np.finfo(np.float32).eps)

CAUGHT_UP = 1.3
"""Way in the row after one that was held, relative to the way before it: twice at an even speed."""


@dataclass(frozen=True, eq=False)
class LogRows:
    """One log: rows as arrays of shape (N,), and its conditions.

    ``of_command`` and ``of_position`` are what the digits of a number leave open, ``coarser`` what those of a position
    do if it was rounded, though it may be the reading as it was; ``left_open`` what those of K and B do. ``kept`` are
    the rows that a law must explain.
    """

    stiffness: float
    damping: float
    step: float
    period: float
    edge: int
    floor: float
    quantum: float
    time: Floats
    command: Floats
    position: Floats
    of_command: Floats
    of_position: Floats
    left_open: tuple[float, float]
    arithmetic: float
    kept: Booleans
    coarser: Floats | None = None

    @classmethod
    def of(cls, batch: TrialBatch, response: Response, i: int) -> LogRows:
        """Return the rows of a trial of a batch."""
        rows = slice(0, int(batch.rows[i]))
        command, position = batch.command[i, rows], batch.position[i, rows]
        K, B, T = float(batch.stiffness[i]), float(batch.damping[i]), float(batch.sampling_period_s[i])
        of_command, of_position = printed(command), printed(position)
        exact = full_resolution(position)
        # of positions with fewer digits than a file has room for, the digits are those of the sensor
        finer = of_position.digits < of_command.digits and of_position.decimal > of_command.decimal
        read = of_command.in_full or of_position.in_full or (finer and not of_position.single)
        return cls(
            *(K, B, float(batch.step[i]), T, int(response.edge_row[i])),
            *(float(response.floor[i]), float(response.sensor_quantum[i])),
            *(batch.time[i, rows], command, position, of_command.half, exact if read else of_position.half),
            (stated_resolution(K), stated_resolution(B)),
            ROUNDINGS * _EPS if not of_command.single else SINGLE_ROUNDINGS * _SINGLE,
            np.ones(len(position), dtype=np.bool_),
            of_position.half if read and not of_command.in_full else None,
        )

    @property
    def readings(self) -> Iterator[LogRows]:
        """The log if its positions are what the controller read, where they may be, and if they were rounded."""
        yield self
        if self.coarser is not None:
            yield replace(self, of_position=self.coarser, coarser=None)

    @cached_property
    def change(self) -> Floats:
        """Change of the position since the row before [m, rad]."""
        result: Floats = np.diff(self.position, prepend=self.position[:1])
        return result

    @cached_property
    def displacement(self) -> Floats:
        """Position from where the wall rests [m, rad]."""
        result: Floats = self.position - self.position[0]
        return result

    @cached_property
    def wall(self) -> Floats:
        """Force of the wall by the law [N, Nm]."""
        return self.stiffness * self.displacement + self.damping / self.period * self.change

    @cached_property
    def external(self) -> Floats:
        """What the command holds beside the wall [N, Nm]."""
        return self.command + self.wall

    @cached_property
    def residual(self) -> Floats:
        """What it holds beside wall and step [N, Nm]."""
        return self.external - self.step * self.after

    @cached_property
    def rounding(self) -> Floats:
        """Largest residual that the digits of the log leave open in each row [N, Nm]."""
        K, B = abs(self.stiffness), abs(self.damping) / self.period
        of_displacement = self.of_position + self.of_position[0]
        of_change = self.of_position + np.append(self.of_position[:1], self.of_position[:-1])
        displacement, change = np.abs(self.displacement), np.abs(self.change)
        terms = np.abs(self.command) + abs(self.step) + K * displacement + B * change
        stated = self.left_open[0] * displacement + self.left_open[1] / self.period * change
        result: Floats = self.of_command + K * of_displacement + B * of_change + stated + self.arithmetic * terms
        return result

    @cached_property
    def after(self) -> Booleans:
        """Rows from the edge on."""
        result: Booleans = np.arange(len(self.position)) >= self.edge
        return result

    def without(self, rows: Booleans) -> LogRows:
        """Return the log with rows that no law must explain."""
        return replace(self, kept=self.kept & ~rows)

    def moved(self, rows: int) -> LogRows:
        """Return the log with commands so many rows earlier; its edge is the first row beyond half the step."""
        own = slice(max(rows, 0), len(self.command) + min(rows, 0))
        other = slice(max(-rows, 0), len(self.command) + min(-rows, 0))
        commands = {name: getattr(self, name)[own] for name in ("command", "of_command")}
        others = {name: getattr(self, name)[other] for name in ("time", "position", "of_position")}
        # a row is none of both where either was
        coarser = None if self.coarser is None else self.coarser[other]
        found = replace(self, **commands, **others, kept=self.kept[own] & self.kept[other], coarser=coarser)
        return replace(found, edge=int(np.argmax(found.external * np.sign(self.step) > 0.5 * abs(self.step))))

    def off(self, predicted: NDArray[np.floating[Any]], rows: Booleans | None = None) -> bool:
        """Whether the command is not the predicted one, over some rows or all that are kept."""
        some = self.kept if rows is None else self.kept & rows
        return bool((np.abs(self.command - predicted)[some] > self.rounding[some]).any())


def stands_still(change: Floats, after: Booleans, least: float | Floats) -> Booleans:
    """Return which rows stand still while the device moves by more than ``least`` before and after them."""
    # the row behind makes up for the way of the one that stood still; a device that turns comes back instead
    behind = np.concatenate([change[..., 1:], np.zeros_like(change[..., :1])], axis=-1)
    before = np.where(np.roll(change, 1, axis=-1) != 0, np.roll(change, 1, axis=-1), np.roll(change, 2, axis=-1))
    still = (change == 0) & after & (np.abs(behind) > least) & (np.abs(before) > least) & (behind * before > 0)
    result: Booleans = still & (np.abs(behind) > CAUGHT_UP * np.abs(before))
    return result
