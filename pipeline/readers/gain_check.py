"""Check whether the command of a log follows the gains in its header.

If it does not, the gains that it does follow are found, with the line to correct. The wall law is u_k = F_0 - K (x_k
- x_0) - B (x_k - x_{k-1})/(t_k - t_{k-1}) from the step onward. Different gains are reported only if the wall law with
these gains explains the command. With a velocity filter, a clipped or one-sided wall, or a coarse sensor, the check may
be inconclusive.
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
"""Largest unexplained share of the command for which the gains can be estimated individually.

The residual due to a velocity filter or a coarse sensor is larger.
"""

EXPLAINED = 0.02
"""Largest residual of the wall law with the estimated gains, relative to the residual with the stated gains.

A velocity filter shifts gains by a few percent and leaves a quarter of the residual.
"""

NEARLY = 0.3
"""Largest unexplained share of the command for which a common wrong factor (a power of ten or a unit) is reported if
the velocity is filtered."""

FACTOR = 8.0
"""Smallest factor by which both K and B must be wrong to be reported, if the velocity is filtered.

The factor between two units is at least 10. A clipped one-sided wall looks like a wall with a quarter of its gains.
"""

UNIT_TOLERANCE = 0.2
"""Relative tolerance of the factor between two units in a log with filtered velocity."""

SURE = 6.0
"""Smallest deviation of a gain that is reported, in standard errors. The threshold is high because sensor noise is not
white."""

TOLERANCE = 0.1
"""Smallest relative deviation of a gain that is reported, and tolerance between two factors that count as equal."""

SHIFTED_ROWS = 2.0
"""Largest offset between command and position of a log [rows]."""

SHARE = 0.05
"""Smallest share of the largest command that the term of a gain must contribute for the gain to be estimated. Where
gains are not stated, a share of the largest command so far suffices if the gain is significant."""

LIMIT_ROWS = 3
"""Smallest number of rows at the largest or smallest command for which the command counts as clipped."""

LEAST_ROWS = 12

PULSE_PARTS = (0.02, 0.05, 0.1, 0.2, 0.4)
"""Fractions of a log after which the pulse of a hit may be over. They are tried in turn."""

MOST_EDGES = 4
"""Largest number of jumps tried as the step. Noise and sensor resolution cause one or two large jumps before the
step."""

STANDS_OUT, SMALL_JUMP = 8.0, 1e-6
"""Factor by which the jump of a step exceeds all earlier jumps, which are due to noise and quantization. Size of a
rounding error, relative to the largest jump."""


@dataclass(frozen=True)
class FollowedGains:
    """Gains [SI] that the command follows and that differ from the header, keyed by name, and the values in the
    header."""

    found: dict[str, float]
    stated: dict[str, float]

    @property
    def sentence(self) -> str:
        """Sentence with the gains that differ, each with its factor."""
        times = {
            name: f" (factor {factor:.4g})" if np.isfinite(factor) else "" for name, factor in self.factors.items()
        }
        return "; ".join(
            f"the command follows {name} {value:.4g}, the header states {self.stated[name]:.4g}{times[name]}"
            for name, value in self.found.items()
        )

    @property
    def factors(self) -> dict[str, float]:
        """Ratio of each gain to the stated gain. The ratio is infinite if the stated gain is 0."""
        return {name: found / self.stated[name] if self.stated[name] else np.inf for name, found in self.found.items()}


def followed_gains(log: Log) -> FollowedGains | None:
    """Return the gains that the command follows if they differ from the stated gains.

    The result is None if the gains agree with the stated gains or are not identifiable.
    """
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
        visible = np.abs(terms[:, free]).max(axis=1) * np.maximum(np.abs(values), np.abs(gains)) > SHARE * largest
        least = np.maximum(TOLERANCE * np.abs(gains), SURE * error)
        # A position that is logged a row or two before or after its command looks like B + K T.
        least[1] += SHIFTED_ROWS * abs(values[0]) * header.sampling_period_s
        other = visible & (np.abs(values - gains) > least)
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
    """Return the same as `followed_gains` for the command of a released or hit device."""
    gains = (log.header.stiffness, log.header.damping)
    fitted = _free_fit(log.time, log.command, log.position) if any(gains) else None
    if fitted is None or not fitted[0].stiffness:
        return None
    law, error = fitted
    # A position that is logged a row or two before or after its command looks like B + K T.
    slack = (0.0, SHIFTED_ROWS * abs(law.stiffness) * log.header.sampling_period_s)
    found = {
        name: value
        for name, value, gain, more, sigma in zip(("stiffness", "damping"), law[:2], gains, slack, error, strict=False)
        if value and abs(value - gain) > max(TOLERANCE * abs(gain), more, SURE * sigma)
    }
    return FollowedGains(found, stated) if found else None


class WallGains(NamedTuple):
    """Stiffness, damping and step that explain a command, in the units of the columns and in seconds.

    A gain whose contribution is always small, compared with the largest command so far, is 0.
    """

    stiffness: float
    damping: float
    step: float


def wall_gains(time: Floats, command: Floats, position: Floats) -> WallGains | None:
    """Return the gains that a command follows, or None if no wall law explains it.

    The motion may begin with a step of the force, with a release, or with a hit (a force pulse). If no wall law
    explains all rows, the gains are estimated from the rows after the pulse.

    Parameters
    ----------
    time : float64, shape (rows,)
        Time [s].
    command, position : float64, shape (rows,)
        Command and position, each in any unit.
    """
    fitted = _free_fit(time, command, position)
    return None if fitted is None else fitted[0]


def _free_fit(time: Floats, command: Floats, position: Floats) -> tuple[WallGains, Floats] | None:
    """Return the wall law of a device after a step, a release or a hit, and the standard errors of its gains, or None
    if no wall law fits."""
    if not _may_follow(time, command, position):
        return None
    peak = float(np.abs(command).max())
    fitted = _fitted(_best_terms(time, command, position), command)
    for part in PULSE_PARTS if fitted is None else ():
        behind = slice(int(part * len(time)), None)
        rows = (time[behind], command[behind], position[behind])
        if not _may_follow(*rows) or float(np.abs(command[behind]).max()) < SHARE * peak:
            return None
        # The displacement before these rows adds a constant to the command.
        fitted = _fitted(_terms(*rows, 0), command[behind])
        if fitted is not None:
            return fitted[0]._replace(step=0.0), fitted[1]
    return fitted


def _may_follow(time: Floats, command: Floats, position: Floats) -> bool:
    """Return True if a wall law can be identified from the given rows."""
    if len(time) < LEAST_ROWS or not (np.diff(time) > 0).all():
        return False
    return bool(np.ptp(command) and np.ptp(position))


def _fitted(terms: Floats, command: Floats) -> tuple[WallGains, Floats] | None:
    """Return the wall law that explains a command, and the standard errors of its gains, or None if no wall law
    does."""
    free = _free(command)
    if free.sum() < LEAST_ROWS:
        return None
    values, error, left = _fit(terms[:, free], command[free])
    if left > EXACT * _size(command):
        return None
    # the step of an unstable wall is visible before the motion has grown
    parts, before = np.abs(values[:, None] * terms[:, free]), np.maximum.accumulate(np.abs(command[free]))
    sure = np.abs(values) > SURE * error
    visible = (parts.max(axis=1) > SHARE * before[-1]) | (sure & (parts > SHARE * before).any(axis=1))
    return WallGains(*map(float, np.where(visible, values, 0.0))), error


def _edges(command: Floats) -> list[int]:
    """Return candidate rows of the step: the largest jump, and the first jumps that are much larger than all earlier
    jumps.

    The largest jump alone is not enough, because later jumps of the command at an unstable wall may exceed the step.
    """
    jump = np.abs(command[1:] - command[:-1])
    largest = int(jump.argmax()) + 1
    if abs(command[0]) > 0.5 * jump.max():
        return [0]
    before = np.maximum.accumulate(jump)[:-1]
    out = np.flatnonzero(jump[1:] > STANDS_OUT * np.maximum(before, SMALL_JUMP * jump.max()))
    return list(dict.fromkeys([largest, *(int(row) + 2 for row in out[:MOST_EDGES])]))


def _best_terms(time: Floats, command: Floats, position: Floats, declared: str | None = None) -> Floats:
    """Return the terms of the wall law, shape (3, rows), for the row of the step with the smallest residual."""
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
    """Return the root mean square."""
    return float(np.hypot.reduce(values) / np.sqrt(len(values)))  # avoids overflow of the squares of damaged numbers


def _free(command: Floats) -> Booleans:
    """Return the rows in which the command is not clipped, or no rows if more than half are clipped."""
    free = np.ones(len(command), dtype=np.bool_)
    for limit in (command.max(), command.min()):
        at = command == limit
        if at.sum() >= LIMIT_ROWS and limit != command[0]:
            free &= ~at
    kept: Booleans = free & (2 * free.sum() >= len(free))
    return kept


def _fit(terms: Floats, command: Floats) -> tuple[Floats, Floats, float]:
    """Return the factors of the terms, their standard errors, and the rms residual of the command."""
    scale = np.where(terms.any(axis=1), np.abs(terms).max(axis=1), 1.0)
    scaled = terms.T / scale
    inverse = np.linalg.pinv(scaled.T @ scaled)
    solution, *_ = np.linalg.lstsq(scaled, command, rcond=None)
    left = _size(command - scaled @ solution)
    return solution / scale, left * np.sqrt(np.diag(inverse)) / scale, left


def gain_mismatch(profile: Profile, log: Log) -> str | None:
    """Return a sentence with the gains that the command follows, if they differ from the stated gains, and the line
    that corrects the stated gains."""
    found = followed_gains(log)
    if found is None:
        return None
    cure = _native_remedy(found, log) if profile.format == "native" else _remedy(profile, found)
    return f"{found.sentence}. Remedy: {cure}"


def _native_remedy(found: FollowedGains, log: Log) -> str:
    """Return a remedy: the factor that converts a column to SI, or the header lines that agree with the command."""
    header = "; ".join(f"# {name}: {value:.4g}" for name, value in found.found.items())
    pace = float(np.median(np.diff(log.time))) / log.header.sampling_period_s
    column, factor = _column(found)
    if [*found.found] == ["damping"] and abs(found.factors["damping"] / pace - 1) <= TOLERANCE:
        column, factor = "time_s", 1 / pace
    return f"{column} times {factor:.4g}, or {header}" if column else header


def _column(found: FollowedGains) -> tuple[str, float]:
    """Return the column whose wrong unit explains all gains, and the factor of the unit. If there is no such column,
    its name is empty.
    """
    factors = found.factors
    first = next(iter(factors.values()))
    if not first or not all(abs(factor - first) <= TOLERANCE * abs(first) for factor in factors.values()):
        return "", 1.0
    if "step" in factors and len(factors) > 1:
        return "command", 1 / first
    position = {name for name, value in found.stated.items() if value} <= factors.keys() | {"step"}
    return ("position", first) if position and np.isfinite(first) else ("", 1.0)


def _remedy(profile: Profile, found: FollowedGains) -> str:
    """Return a remedy: the lines of a profile with which conditions and command agree."""
    column, factor = _column(found)
    lines = _lines(column, profile.column_sources()[column], factor) if column else []
    units = [f'{name} = "{unit}"' for name, times in found.factors.items() if (unit := _unit(profile, name, times))]
    if len(units) == len(found.factors):
        lines.append(f"[units] {', '.join(units)}")
    values = ", ".join(f"{name} {value:.4g}" for name, value in found.found.items())
    whole = " or ".join(lines) or f"state {values} [SI], or correct the units and signs in the profile"
    # If several gains differ together, the unit or the sign of a column is wrong.
    alone = _alone(profile, found) if len(found.found) == 1 else ""
    return f"{whole}.{ALONE} {alone}" if alone else whole


ALONE = " If only this log is wrong:"
"""Beginning of the part of a remedy that applies to a single log. It is omitted if many logs are faulty, because they
have a common cause."""


def common_remedy(cure: str) -> str:
    """Return a remedy without the part for a single log."""
    return cure.partition(f".{ALONE}")[0]


def _alone(profile: Profile, found: FollowedGains) -> str:
    """Return the place where a log states the contradicted value, with the correct value, or "" if all logs share this
    value."""
    by_file = {key for entry in profile.file for key in entry.given()}
    places = dict.fromkeys(by_file, "its row of the sheet, or [[file]]") | dict.fromkeys(
        profile.name_groups(), "its name"
    )
    places |= {key: f"its column {name!r}" for key, name in profile.condition_columns.items()}
    places |= {key: f"its value {name!r}" for key, name in profile.attributes.items()}
    parts = []
    for key, value in found.found.items():
        if key in places:
            unit = getattr(profile.units, key, None) or si_unit(quantity(key, profile.motion))
            parts.append(f"{key} {value / profile.condition_factor(key):.4g} {unit} in {places[key]}")
    return ", ".join(parts)


def _lines(key: str, source: Source, factor: float) -> list[str]:
    """Return the line that corrects a column whose numbers are too large by a factor."""
    parts = [f"sign = {-(getattr(source, 'sign', 1) or 1)}"] if factor < 0 else []
    if abs(abs(factor) - 1) > TOLERANCE:
        unit = unit_between(source.unit or "", abs(factor), UNIT_TOLERANCE)
        if unit is None:
            return []
        parts.append(f'unit = "{unit}"')
    return [f"[columns.{key}] {', '.join(parts)}"]


def _unit(profile: Profile, name: str, factor: float) -> str | None:
    """Return the unit in which a condition seems to be stated, or None."""
    stated = getattr(profile.units, name, None) or si_unit(quantity(name, profile.motion))
    unit = unit_between(stated, factor, UNIT_TOLERANCE)
    return "N/mm" if unit == "kN/m" else unit  # the same unit in the spelling that labs use
