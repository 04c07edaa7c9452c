"""Does the command of a log obey the gains that its header states? If not: which it obeys, and the line that cures it.

The wall law is u_k = F_0 - K (x_k - x_0) - B (x_k - x_{k-1})/(t_k - t_{k-1}) from the step on. Other gains are reported
only where the wall law with these gains explains the command. A velocity filter, a clipped or one-sided wall, or a
coarse sensor may leave the question open.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pipeline.base.units import unit_between
from pipeline.profiles.profile_model import Profile, Source, quantity, si_unit
from pipeline.readers.log import Log
from pipeline.records.trials import Booleans, Floats

EXACT = 0.02
"""Largest unexplained share of the command for which each gain is identifiable by itself; a velocity filter or a coarse
sensor leaves more."""

EXPLAINED = 0.02
"""Part of what the header's law leaves that other gains may leave: a velocity filter shifts gains by some percent, and
leaves a quarter."""

NEARLY = 0.3
"""Part that it may leave where gains are a power of ten or a unit off, as seen through a filter."""

FACTOR = 8.0
"""Factor by which K and B together must be off to be reported behind a velocity filter: units differ by at least 10,
and a clipped wall that only pushes looks like one with a quarter of its gains."""

UNIT_TOLERANCE = 0.2
"""Part by which the factor between two units may be off in a log whose velocity is filtered."""

SURE = 6.0
"""Standard errors by which a gain must differ: noise of a sensor is not white."""

TOLERANCE = 0.1
"""Part by which a gain must differ, and by which two factors may that are one."""

SHIFTED_ROWS = 2.0
"""Rows by which command and position of a log may be shifted against each other."""

SHARE = 0.05
"""Least share of the largest command that a gain must contribute to be estimated."""

LIMIT_ROWS = 3
"""Rows at the largest or smallest command from which on it is clipped there."""

LEAST_ROWS = 12

PULSE_PARTS = (0.02, 0.05, 0.1, 0.2, 0.4)
"""Parts of a log after which the pulse of a hit may have ended."""

MOST_EDGES = 4
"""Jumps that are tried as the step: before it, noise and the sensor's step make one or two that stand out."""

STANDS_OUT, SMALL_JUMP = 8.0, 1e-6
"""Factor by which the jump of a step exceeds all before it, which noise and the rounding of a sensor make; and part of
the largest jump below which one is arithmetic."""


@dataclass(frozen=True)
class FollowedGains:
    """Gains that the command obeys [SI] where the header states others, by name; and what the header states."""

    found: dict[str, float]
    stated: dict[str, float]

    @property
    def sentence(self) -> str:
        """What differs, with the factor."""
        times = {
            name: f" (factor {factor:.4g})" if np.isfinite(factor) else "" for name, factor in self.factors.items()
        }
        return "; ".join(
            f"the command obeys {name} {value:.4g}, the header says {self.stated[name]:.4g}{times[name]}"
            for name, value in self.found.items()
        )

    @property
    def factors(self) -> dict[str, float]:
        """By which factor each is other than stated; infinite where 0 is stated."""
        return {name: found / self.stated[name] if self.stated[name] else np.inf for name, found in self.found.items()}


def followed_gains(log: Log) -> FollowedGains | None:
    """Return which other gains the command of a log obeys; None where they are as stated, or not to be seen."""
    header, command = log.header, log.command
    stated = {"stiffness": header.stiffness, "damping": header.damping, "step": header.step}
    gains, size = np.array([*stated.values()]), _size(command)
    terms = _best_terms(log.time, command, log.position, header.extra.get("step_row"))
    off = command - gains @ terms
    if not header.step:
        return _followed_in_motion(log, stated)
    if not size or _size(off) <= EXACT * size:
        return None
    free = _free(command)
    if free.sum() < LEAST_ROWS:
        return None
    largest = float(np.abs(command).max())
    values, error, left = _fit(terms[:, free], command[free])
    if left <= min(EXACT * size, EXPLAINED * _size(off[free])):
        told = np.abs(terms[:, free]).max(axis=1) * np.maximum(np.abs(values), np.abs(gains)) > SHARE * largest
        least = np.maximum(TOLERANCE * np.abs(gains), SURE * error)
        # a position that is logged a row or two before or after its command looks like B + K T
        least[1] += SHIFTED_ROWS * abs(values[0]) * header.sampling_period_s
        other = told & (np.abs(values - gains) > least)
        return (
            FollowedGains({name: float(values[i]) for i, name in enumerate(stated) if other[i]}, stated)
            if any(other)
            else None
        )
    wall = gains[:2] @ terms[:2]
    (factor, step), _, left = _fit(np.stack([wall, terms[2] * header.step])[:, free], command[free])
    if left > NEARLY * size or abs(factor) * np.abs(wall).max() <= SHARE * largest or 1 / FACTOR < factor < FACTOR:
        return None
    found = {name: float(factor * stated[name]) for name in ("stiffness", "damping") if stated[name]}
    return FollowedGains(found | ({} if 1 / FACTOR < step < FACTOR else {"step": float(step * header.step)}), stated)


def _followed_in_motion(log: Log, stated: dict[str, float]) -> FollowedGains | None:
    """Return which other gains the command of a released or hit device obeys, as `followed_gains`."""
    gains = (log.header.stiffness, log.header.damping)
    fitted = _free_fit(log.time, log.command, log.position) if any(gains) else None
    if fitted is None or not fitted[0].stiffness:
        return None
    law, error = fitted
    # a position that is logged a row or two before or after its command looks like B + K T
    slack = (0.0, SHIFTED_ROWS * abs(law.stiffness) * log.header.sampling_period_s)
    found = {
        name: value
        for name, value, gain, more, sigma in zip(("stiffness", "damping"), law[:2], gains, slack, error, strict=False)
        if value and abs(value - gain) > max(TOLERANCE * abs(gain), more, SURE * sigma)
    }
    return FollowedGains(found, stated) if found else None


class WallGains(NamedTuple):
    """Stiffness, damping and step that explain a command, in its numbers, those of the position and seconds.

    What makes no part of the command that is seen is 0.
    """

    stiffness: float
    damping: float
    step: float


def wall_gains(time: Floats, command: Floats, position: Floats) -> WallGains | None:
    """Return the gains that a command follows, or None where no wall law explains it.

    A step of the force is a step or a release, a pulse of it a hit. Where no wall law explains all rows, the gains are
    those of the rows behind the pulse.

    Parameters
    ----------
    time : float64, shape (rows,)
        Seconds.
    command, position : float64, shape (rows,)
        In any unit.
    """
    fitted = _free_fit(time, command, position)
    return None if fitted is None else fitted[0]


def _free_fit(time: Floats, command: Floats, position: Floats) -> tuple[WallGains, Floats] | None:
    """Return the law of a released or hit device and the standard errors of its gains; None where none explains it."""
    if not _may_follow(time, command, position):
        return None
    peak = float(np.abs(command).max())
    fitted = _fitted(_best_terms(time, command, position), command)
    for part in PULSE_PARTS if fitted is None else ():
        behind = slice(int(part * len(time)), None)
        rows = (time[behind], command[behind], position[behind])
        if not _may_follow(*rows) or float(np.abs(command[behind]).max()) < SHARE * peak:
            return None
        # what the position has moved before is a constant part of the command
        fitted = _fitted(_terms(*rows, 0), command[behind])
        if fitted is not None:
            return fitted[0]._replace(step=0.0), fitted[1]
    return fitted


def _may_follow(time: Floats, command: Floats, position: Floats) -> bool:
    """Return whether a law may be seen in some rows."""
    if len(time) < LEAST_ROWS or not (np.diff(time) > 0).all():
        return False
    return bool(np.ptp(command) and np.ptp(position))


def _fitted(terms: Floats, command: Floats) -> tuple[WallGains, Floats] | None:
    """Return the law that explains a command, and the standard errors of its gains; None where none does."""
    free = _free(command)
    if free.sum() < LEAST_ROWS:
        return None
    values, error, left = _fit(terms[:, free], command[free])
    if left > EXACT * _size(command):
        return None
    told = np.abs(terms[:, free]).max(axis=1) * np.abs(values) > SHARE * np.abs(command).max()
    return WallGains(*map(float, np.where(told, values, 0.0))), error


def _edges(command: Floats) -> list[int]:
    """Return the rows in which the step may happen: the largest jump, and the first that stand out from those before.

    The command of an unstable wall jumps by more than its step later on.
    """
    jump = np.abs(command[1:] - command[:-1])
    largest = int(jump.argmax()) + 1
    if abs(command[0]) > 0.5 * jump.max():
        return [0]
    before = np.maximum.accumulate(jump)[:-1]
    out = np.flatnonzero(jump[1:] > STANDS_OUT * np.maximum(before, SMALL_JUMP * jump.max()))
    return list(dict.fromkeys([largest, *(int(row) + 2 for row in out[:MOST_EDGES])]))


def _best_terms(time: Floats, command: Floats, position: Floats, declared: str | None = None) -> Floats:
    """Return the terms of the law whose edge leaves least of the command, shape (3, rows)."""
    edges = [int(declared)] if declared is not None else _edges(command)
    every = [_terms(time, command, position, edge) for edge in edges]
    return min(every, key=lambda terms: _fit(terms, command)[2]) if len(every) > 1 else every[0]


def _terms(time: Floats, command: Floats, position: Floats, edge: int) -> Floats:
    """Return the terms of stiffness, damping and step in the command, shape (3, rows)."""
    terms = np.zeros((3, len(time)))
    terms[0] = position[0] - position
    terms[1, 1:] = (position[:-1] - position[1:]) / (time[1:] - time[:-1])
    terms[2, edge:] = 1.0
    return terms


def _size(values: Floats) -> float:
    """Return the root of the mean square."""
    return float(np.hypot.reduce(values) / np.sqrt(len(values)))  # squares of damaged numbers have no double


def _free(command: Floats) -> Booleans:
    """Return the rows in which the command stands at no limit that it keeps; none where they are less than half."""
    free = np.ones(len(command), dtype=np.bool_)
    for limit in (command.max(), command.min()):
        at = command == limit
        if at.sum() >= LIMIT_ROWS and limit != command[0]:
            free &= ~at
    kept: Booleans = free & (2 * free.sum() >= len(free))
    return kept


def _fit(terms: Floats, command: Floats) -> tuple[Floats, Floats, float]:
    """Return the factors of terms, their standard errors, and what they leave of the command (rms)."""
    scale = np.where(terms.any(axis=1), np.abs(terms).max(axis=1), 1.0)
    scaled = terms.T / scale
    inverse = np.linalg.pinv(scaled.T @ scaled)
    solution, *_ = np.linalg.lstsq(scaled, command, rcond=None)
    left = _size(command - scaled @ solution)
    return solution / scale, left * np.sqrt(np.diag(inverse)) / scale, left


def gain_mismatch(profile: Profile, log: Log) -> str | None:
    """Return which other gains the command of a log obeys, and the line that cures it; None where it does not."""
    found = followed_gains(log)
    if found is None:
        return None
    cure = _native_remedy(found, log) if profile.format == "native" else _remedy(profile, found)
    return f"{found.sentence}. To cure it: {cure}"


def _native_remedy(found: FollowedGains, log: Log) -> str:
    """Return by what a column that is not in SI has to be multiplied, or the lines of the header that agree with it."""
    header = "; ".join(f"# {name}: {value:.4g}" for name, value in found.found.items())
    pace = float(np.median(np.diff(log.time))) / log.header.sampling_period_s
    column, factor = _column(found)
    if [*found.found] == ["damping"] and abs(found.factors["damping"] / pace - 1) <= TOLERANCE:
        column, factor = "time_s", 1 / pace
    return f"{column} times {factor:.4g}, or {header}" if column else header


def _column(found: FollowedGains) -> tuple[str, float]:
    """Return the column whose unit alone explains the gains, and its unit in the stated one; empty where none does."""
    factors = found.factors
    first = next(iter(factors.values()))
    if not first or not all(abs(factor - first) <= TOLERANCE * abs(first) for factor in factors.values()):
        return "", 1.0
    if "step" in factors and len(factors) > 1:
        return "command", 1 / first
    position = {name for name, value in found.stated.items() if value} <= factors.keys() | {"step"}
    return ("position", first) if position and np.isfinite(first) else ("", 1.0)


def _remedy(profile: Profile, found: FollowedGains) -> str:
    """Return the lines of a profile by which header and command would agree."""
    column, factor = _column(found)
    lines = _lines(column, profile.column_sources()[column], factor) if column else []
    units = [f'{name} = "{unit}"' for name, times in found.factors.items() if (unit := _unit(profile, name, times))]
    if len(units) == len(found.factors):
        lines.append(f"[units] {', '.join(units)}")
    values = ", ".join(f"{name} {value:.4g}" for name, value in found.found.items())
    whole = " or ".join(lines) or f"give {values} [SI], or correct units and signs of the profile"
    # several gains that differ together are the unit or the sign of a column
    alone = _alone(profile, found) if len(found.found) == 1 else ""
    return f"{whole}.{ALONE} {alone}" if alone else whole


ALONE = " If this log alone is at fault:"
"""Begin of the part of a cure that is for one log; many that are at fault have one in common."""


def common_remedy(cure: str) -> str:
    """Return a cure without what is for one log alone."""
    return cure.partition(f".{ALONE}")[0]


def _alone(profile: Profile, found: FollowedGains) -> str:
    """Return where a log states what its command contradicts, and by which number; empty where all logs share it."""
    by_file = {key for entry in profile.file for key in entry.given()}
    places = dict.fromkeys(by_file, "its row of the sheet, or [[file]]") | dict.fromkeys(
        profile.name_groups(), "its name"
    )
    places |= {key: f"its column {name!r}" for key, name in profile.condition_columns.items()}
    places |= {key: f"its value {name!r}" for key, name in profile.attributes.items()}
    told = []
    for key, value in found.found.items():
        if key in places:
            unit = getattr(profile.units, key, None) or si_unit(quantity(key, profile.motion))
            told.append(f"{key} {value / profile.condition_factor(key):.4g} {unit} in {places[key]}")
    return ", ".join(told)


def _lines(key: str, source: Source, factor: float) -> list[str]:
    """Return the line that corrects a column whose numbers are so many times as large."""
    parts = [f"sign = {-(getattr(source, 'sign', 1) or 1)}"] if factor < 0 else []
    if abs(abs(factor) - 1) > TOLERANCE:
        unit = unit_between(source.unit or "", abs(factor), UNIT_TOLERANCE)
        if unit is None:
            return []
        parts.append(f'unit = "{unit}"')
    return [f"[columns.{key}] {', '.join(parts)}"]


def _unit(profile: Profile, name: str, factor: float) -> str | None:
    """Return the unit in which a condition seems to be given."""
    stated = getattr(profile.units, name, None) or si_unit(quantity(name, profile.motion))
    unit = unit_between(stated, factor, UNIT_TOLERANCE)
    return "N/mm" if unit == "kN/m" else unit  # the same, and what labs write
