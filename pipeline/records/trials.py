"""Trials of an experiment: conditions of each trial, and the rows of all trials in flat arrays without padding.

A trial is a view of its rows, and a measurement is a function of one trial.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import sha256

import numpy as np
from numpy.typing import NDArray

from pipeline.base.provenance import digest_all
from pipeline.device.parameters import Motion

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]

NO_STEP_ROW = -1
"""Stored row number for a trial that does not declare its command edge."""


@dataclass(frozen=True, eq=False)
class Trial:
    """A step response.

    Parameters
    ----------
    trial_id : str
    stiffness, damping : float
        Virtual stiffness K [N/m, Nm/rad] and damping B [Ns/m, Nms/rad].
    step : float
        External step F_0 [N, Nm].
    sampling_period_s : float
        Sampling period T [s].
    time, command, position : float64, shape (rows,)
        Time stamps [s], total commanded force before any delay [N, Nm], measured position [m, rad].
    force, velocity : float64, shape (rows,), optional
        Measured force [N, Nm] and logged velocity [m/s, rad/s]. No result is computed from a logged velocity, because
        its filters and lags are unknown.
    step_row : int, optional
        Declared row of the command edge. By default, the edge is detected in the log.
    integrated : bool
        True if positions are integrals of a measured velocity. They are then not on the grid of a position sensor.
    motion : Motion, optional
        Kind of motion, which determines the units. None if it is unknown.

    Examples
    --------
    >>> time = np.arange(4) * 1e-3
    >>> trial = Trial("1", 500.0, 2.0, 1.0, 1e-3, time, np.ones(4), np.array([0.1, 0.1, 0.2, 0.3]))
    >>> trial.rows, trial.displacement.round(3).tolist(), trial.window(1, 2).rows
    (4, [0.0, 0.0, 0.1, 0.2], 2)
    """

    trial_id: str
    stiffness: float
    damping: float
    step: float
    sampling_period_s: float
    time: Floats
    command: Floats
    position: Floats
    force: Floats | None = None
    velocity: Floats | None = None
    step_row: int | None = None
    integrated: bool = False
    motion: Motion | None = None

    @property
    def rows(self) -> int:
        """Number of samples."""
        return len(self.position)

    @property
    def displacement(self) -> Floats:
        """Position relative to the first position, which is the rest position of the wall, shape (rows,) [m, rad]."""
        return self.position - self.position[:1]

    @property
    def samples(self) -> dict[str, Floats]:
        """Arrays of the trial by name. Measured force and velocity are included if available."""
        named = {"time": self.time, "command": self.command, "position": self.position}
        optional = {"force": self.force, "velocity": self.velocity}
        return named | {name: values for name, values in optional.items() if values is not None}

    @cached_property
    def digest(self) -> str:
        """Hash of the name, the conditions and the samples. It depends only on the values, not on their storage."""
        conditions = [self.stiffness, self.damping, self.step, self.sampling_period_s]
        declared = NO_STEP_ROW if self.step_row is None else self.step_row
        result = sha256(self.trial_id.encode())
        result.update(np.array(conditions, dtype=np.float64).data)
        result.update(np.array([self.rows, declared], dtype=np.int64).data)
        if self.integrated:
            result.update(b"integrated")
        for name, values in self.samples.items():
            if not np.isnan(values).all():
                result.update(name.encode())
                result.update(np.ascontiguousarray(values).data)
        return result.hexdigest()[:16]

    def window(self, first: int, rows: int) -> Trial:
        """Return a trial with ``rows`` rows from ``first`` on. A declared step row is counted from ``first``."""
        inside = slice(first, first + rows)
        step_row = None if self.step_row is None else self.step_row - first
        force, velocity = (None if values is None else values[inside] for values in (self.force, self.velocity))
        time, command, position = self.time[inside], self.command[inside], self.position[inside]
        return replace(
            self, step_row=step_row, time=time, command=command, position=position, force=force, velocity=velocity
        )

    def relative_to(self, level: float) -> Trial:
        """Return the trial with command and measured force relative to a level [N, Nm]."""
        force = None if self.force is None else self.force - level
        return replace(self, command=self.command - level, force=force)


@dataclass(frozen=True, eq=False)
class Trials:
    """Trials in the layout of the stored table.

    Parameters
    ----------
    trial_id : tuple of str, length n
    stiffness, damping, step, sampling_period_s : float64, shape (n,)
        As in `Trial`.
    offsets : int64, shape (n + 1,)
        The rows of trial i are ``offsets[i]`` to ``offsets[i + 1]`` of the flat arrays.
    time, command, position : float64, shape (rows of all trials,)
    force, velocity : float64, shape (rows of all trials,), optional
        NaN in the rows of trials without such samples, or None if no trial has any.
    step_row : int64, shape (n,), optional
        Declared row of the command edge of each trial, -1 if it is not declared, or None if no trial declares one.
    integrated : bool, shape (n,), optional
        True for trials whose positions are integrals, or None if there is no such trial.
    motion : Motion, optional
        Kind of motion of all trials. None if it is unknown, or if they differ.

    Examples
    --------
    >>> time = np.arange(3) * 1e-3
    >>> trials = Trials.of([Trial(name, 500.0, 2.0, 1.0, 1e-3, time, time, time) for name in "ab"])
    >>> len(trials), trials[1].trial_id, trials.rows.tolist()
    (2, 'b', [3, 3])
    """

    trial_id: tuple[str, ...]
    stiffness: Floats
    damping: Floats
    step: Floats
    sampling_period_s: Floats
    offsets: Integers
    time: Floats
    command: Floats
    position: Floats
    force: Floats | None = None
    velocity: Floats | None = None
    step_row: Integers | None = None
    integrated: Booleans | None = None
    motion: Motion | None = None

    def __len__(self) -> int:
        return len(self.trial_id)

    def __iter__(self) -> Iterator[Trial]:
        return (self[place] for place in range(len(self)))

    def __getitem__(self, place: int) -> Trial:
        """Return a trial. Its arrays are views."""
        inside = slice(int(self.offsets[place]), int(self.offsets[place + 1]))
        declared = NO_STEP_ROW if self.step_row is None else int(self.step_row[place])
        return Trial(
            trial_id=self.trial_id[place],
            stiffness=float(self.stiffness[place]),
            damping=float(self.damping[place]),
            step=float(self.step[place]),
            sampling_period_s=float(self.sampling_period_s[place]),
            time=self.time[inside],
            command=self.command[inside],
            position=self.position[inside],
            force=None if self.force is None else _present(self.force[inside]),
            velocity=None if self.velocity is None else _present(self.velocity[inside]),
            step_row=None if declared < 0 else declared,
            integrated=self.integrated is not None and bool(self.integrated[place]),
            motion=self.motion,
        )

    @property
    def rows(self) -> Integers:
        """Number of samples of each trial, shape (n,)."""
        return np.diff(self.offsets)

    @cached_property
    def digests(self) -> tuple[str, ...]:
        """Hash of each trial."""
        return tuple(trial.digest for trial in self)

    @cached_property
    def digest(self) -> str:
        """Hash of all trials, in their order."""
        return digest_all(self.digests)

    def select(self, places: Sequence[int] | Integers | Booleans) -> Trials:
        """Return the trials at the given places, in this order, or the trials for which a mask is true."""
        return Trials.of([self[place] for place in np.arange(len(self))[np.asarray(places)].tolist()])

    @classmethod
    def of(cls, trials: Iterable[Trial]) -> Trials:
        """Return trials with their rows concatenated."""
        listed = list(trials)
        declared = np.array([NO_STEP_ROW if each.step_row is None else each.step_row for each in listed], np.int64)
        integrated = np.array([each.integrated for each in listed], np.bool_)
        return cls(
            trial_id=tuple(each.trial_id for each in listed),
            stiffness=np.array([each.stiffness for each in listed], np.float64),
            damping=np.array([each.damping for each in listed], np.float64),
            step=np.array([each.step for each in listed], np.float64),
            sampling_period_s=np.array([each.sampling_period_s for each in listed], np.float64),
            offsets=np.concatenate([[0], np.cumsum([each.rows for each in listed])]).astype(np.int64),
            time=_joined([each.time for each in listed]),
            command=_joined([each.command for each in listed]),
            position=_joined([each.position for each in listed]),
            force=_joined_where_present([each.force for each in listed], listed),
            velocity=_joined_where_present([each.velocity for each in listed], listed),
            step_row=declared if (declared >= 0).any() else None,
            integrated=integrated if integrated.any() else None,
            motion=common_motion(each.motion for each in listed),
        )


def common_motion(motions: Iterable[Motion | None]) -> Motion | None:
    """Return the motion of all trials, or None if their motions differ."""
    found = set(motions)
    return found.pop() if len(found) == 1 else None


def _present(values: Floats) -> Floats | None:
    """Return optional samples of a trial, or None if it has none."""
    return None if np.isnan(values).all() else values


def _joined(parts: Sequence[Floats]) -> Floats:
    return np.concatenate([np.empty(0), *parts])


def _joined_where_present(parts: Sequence[Floats | None], trials: Sequence[Trial]) -> Floats | None:
    """Return optional samples of all trials, with NaN for trials without them, or None if no trial has them."""
    if all(values is None for values in parts):
        return None
    return _joined(
        [np.full(trial.rows, np.nan) if values is None else values for values, trial in zip(parts, trials, strict=True)]
    )
