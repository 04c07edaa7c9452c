"""Determine the walls that a series of trials tests, from the device file or otherwise from the range of stable
walls."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.theory.cases import case_of, limits_of_walls

if TYPE_CHECKING:  # importing these classes takes longer than a short command
    from pipeline.records.models import Device, Experiment

GRID_DAMPINGS, GRID_STIFFNESSES = 12, 30
"""Size of the default grid of walls if a device file states no grid. Its dampings span half of the stable range, and
its stiffnesses reach up to the limit."""


@dataclass(frozen=True)
class Grid:
    """Grid of tested walls: the range and the step of the damping [Ns/m, Nms/rad], and the step of the stiffness
    [N/m, Nm/rad]."""

    damping_first: float
    damping_last: float
    damping_step: float
    stiffness_step: float


def tested_grid(device: Device, experiment: Experiment) -> Grid:
    """Return the grid of an experiment. Values that are missing from the device file are derived from the range of
    stable walls.

    Raises
    ------
    ParameterError
        If a value of the grid is missing from the file and no wall is stable.
    """
    e = experiment
    if e.damping_last is None or e.damping_step is None or e.stiffness_step is None:
        case = case_of(device, experiment)
        limits = limits_of_walls(case, points=GRID_STIFFNESSES)
        last = float(np.nanmax(limits.damping)) / 2 if e.damping_last is None else e.damping_last
        last = max(last, e.damping_first)
        step = (last - e.damping_first) / (GRID_DAMPINGS - 1) or case.scale[1]
        return Grid(
            e.damping_first,
            last,
            rounded(step) if e.damping_step is None else e.damping_step,
            rounded(limits.stiffness_max / GRID_STIFFNESSES) if e.stiffness_step is None else e.stiffness_step,
        )
    return Grid(e.damping_first, e.damping_last, e.damping_step, e.stiffness_step)


def rounded(step: float) -> float:
    """Round a step down to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(step))
    return max(power * nice for nice in (1, 2, 5) if power * nice <= step * (1 + 1e-9))
