"""Where logs that read without a fault speak against their profile: units, signs."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pipeline.base.units import find_unit, unit_in_heading
from pipeline.profiles.profile_columns import QUANTITIES
from pipeline.profiles.profile_model import Profile
from pipeline.readers import Log
from pipeline.records.models import Motion

FIRST_MOTION = 0.05
"""Part of the largest excursion from which on the first motion after the step counts: above the quantum of coarse
sensors, below the first swing."""

STEP_ROWS = 3
"""Rows from the step on whose median is its size: one may flicker, and later ones may bear the filter of a velocity."""

STEP_TOLERANCE = 0.1
"""Part of the step by which its size may differ: a round number stands for what the controller commands."""

PLAUSIBLE: dict[str, dict[Motion, tuple[float, float]]] = {
    "stiffness": {"translation": (1.0, 1e6), "rotation": (1e-2, 1e5)},
    "damping": {"translation": (1e-2, 1e4), "rotation": (1e-4, 1e3)},
    "step": {"translation": (1e-2, 1e3), "rotation": (1e-4, 1e3)},
    "sampling_period_s": {"translation": (2e-5, 0.1), "rotation": (2e-5, 0.1)},
    "displacement": {"translation": (1e-6, 1.0), "rotation": (1e-6, 100.0)},
    "duration_s": {"translation": (5e-3, 1e3), "rotation": (5e-3, 1e3)},
}
"""Range of each number in SI that devices have: fingers and arms, drives of a watt to a kilowatt; 0 is none."""


def implausible(log: Log, motion: Motion) -> list[str]:
    """Return which numbers of a log no device has, so that a unit may be wrong."""
    found = []
    for key, value in facts(log).items():
        low, high = PLAUSIBLE[key][motion]
        if value and not low <= abs(value) <= high:
            found.append(f"{key} is {value:.4g} [SI]; devices have {low:g} to {high:g}: is its unit right?")
    return found


def facts(log: Log) -> dict[str, float]:
    """Return the numbers of a log that `PLAUSIBLE` knows."""
    conditions = {key: float(getattr(log.header, key)) for key in list(PLAUSIBLE)[:4]}
    return {**conditions, "displacement": float(np.ptp(log.position)), "duration_s": float(np.ptp(log.time))}


def other_units(profile: Profile, said: Mapping[str, str]) -> list[str]:
    """Return where a file states another unit than the profile.

    Parameters
    ----------
    profile : Profile
    said : mapping of str to str
        Unit that the file states of each SI column; where it is empty, what stands behind the column's name is read.
    """
    found = []
    for key, source in profile.column_sources().items():
        if source.unit is None:
            continue
        stated = said.get(key) or unit_in_heading(source.key, QUANTITIES[key].values())[1]
        if (unit := find_unit(stated)) is not None and unit != find_unit(source.unit):
            found.append(f"columns.{key}.unit is {source.unit!r}, but the file says {stated!r}: which is right?")
    return found


def other_step(log: Log, step_row: int | None) -> list[str]:
    """Return where the command jumps by another step, or the position goes against it; rows are counted from 0."""
    step, found = log.header.step, []
    if step_row is None or step == 0:
        return []
    before = log.command[:step_row] if step_row else np.zeros(1)
    jump = float(np.median(log.command[step_row : step_row + STEP_ROWS]) - np.median(before))
    # chatter before the step, fed through a filter of the velocity, shows how well the jump is known
    if abs(jump - step) > STEP_TOLERANCE * abs(step) + float(np.ptp(before)):
        found.append(f"the command jumps by {jump:.4g} in row {step_row}, but the step is {step:.4g}: which is right?")
    moved = (log.position[step_row:] - log.position[step_row]) * np.sign(step)
    # noise is seen before the step; a first motion that stands out of it tells the direction
    noise = float(np.ptp(log.position[: step_row + 1]))
    clear = np.flatnonzero(np.abs(moved) > max(2 * noise, FIRST_MOTION * float(np.abs(moved).max(initial=0.0))))
    if len(clear) and moved[clear[0]] < 0:
        found.append("the position moves against the step at first: check the signs of command, position and step")
    return found
