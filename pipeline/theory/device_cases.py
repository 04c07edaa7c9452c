"""Numbers behind the theory commands for a device file: what `theory.cases` says of normalised loops, in SI."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.device_loop import loop_of, wall_units
from pipeline.loop.loop import Loop, Normalised
from pipeline.records.batch import Floats
from pipeline.records.loop_parts import LoopParts
from pipeline.records.models import Device, Experiment
from pipeline.theory.cases import POINT_COSTS, Cases, points_of_loop
from pipeline.theory.cost.theory_map import check_criteria
from pipeline.theory.device.outline import outline
from pipeline.theory.device.slowest_pole import slowest_poles

GRID_DAMPINGS, GRID_STIFFNESSES = 12, 30
"""Grid of walls where a device file states none: dampings over half of the stable ones, stiffnesses up to the limit."""


@dataclass(frozen=True)
class DeviceCase:
    """An experiment of a device: its loop in units of its wall."""

    device: Device
    experiment: Experiment

    @cached_property
    def parts(self) -> LoopParts:
        """What the loop has beside mass, damper and delay."""
        return self.device.loop_of(self.experiment)

    @cached_property
    def units(self) -> Normalised:
        """Factors between SI and the normalised wall."""
        return wall_units(self.experiment.mass, self.device.sampling_period_s, self.parts)

    @cached_property
    def loop(self) -> Loop:
        """Normalised loop; an ideal one where its parts leave it ideal."""
        e = self.experiment
        return loop_of(e.mass, e.damping, e.stiffness, e.delay_samples, self.device.sampling_period_s, self.parts)

    @property
    def names(self) -> dict[str, Any]:
        """What every document says of the device."""
        return {
            "device": self.device.name,
            "experiment": self.experiment.name,
            "delay_samples": self.experiment.delay_samples,
            "parts": self.parts.model_dump(mode="json", exclude_defaults=True, exclude={"friction"}),
            "left_out": self.parts.left_out,
        }


@dataclass(frozen=True)
class Grid:
    """Walls that are tested: dampings [Ns/m, Nms/rad], and the step by which the stiffness [N/m, Nm/rad] climbs."""

    damping_first: float
    damping_last: float
    damping_step: float
    stiffness_step: float


def tested_grid(device: Device, experiment: Experiment) -> Grid:
    """Return the walls that a course tests: as the device file says, and where it does not, over those that are stable.

    Raises
    ------
    ParameterError
        If the file names no grid and no wall is stable.
    """
    e = experiment
    if e.damping_last is None or e.damping_step is None or e.stiffness_step is None:
        case = DeviceCase(device, experiment)
        found = boundary_document(case, GRID_STIFFNESSES)
        last = max(found["damping"]) / 2 if e.damping_last is None else e.damping_last
        last = max(last, e.damping_first)
        step = (last - e.damping_first) / (GRID_DAMPINGS - 1) or case.units.damping
        return Grid(
            e.damping_first,
            last,
            rounded(step) if e.damping_step is None else e.damping_step,
            rounded(found["stiffness_max"] / GRID_STIFFNESSES) if e.stiffness_step is None else e.stiffness_step,
        )
    return Grid(e.damping_first, e.damping_last, e.damping_step, e.stiffness_step)


def rounded(step: float) -> float:
    """Return a step as a person would choose it: 1, 2 or 5 times a power of ten, at most the one given."""
    power = 10.0 ** math.floor(math.log10(step))
    return max(power * nice for nice in (1, 2, 5) if power * nice <= step * (1 + 1e-9))


def boundary_document(case: DeviceCase, points: int = 400) -> dict[str, Any]:
    """Return the limit of a device's walls over damping, as the document that `theory boundary --device` prints.

    Raises
    ------
    ParameterError
        If no wall is stable at any damping.
    """
    found, k, b = outline(case.loop, points), case.units.stiffness, case.units.damping
    if not len(found.beta) and not len(found.islands):
        raise ParameterError(
            f"device {case.device.name!r}, experiment {case.experiment.name!r}: no stiffness and damping stabilise "
            "this loop. Check delay, lag and filter in the device file."
        )
    return {
        **case.names,
        "stiffness_max": float(found.alpha_max * k) if len(found.beta) else None,
        "damping_at_stiffness_max": float(found.beta_at_alpha_max * b) if len(found.beta) else None,
        "stiffness": (found.alpha * k).tolist(),
        "damping": (found.beta * b).tolist(),
        "islands": islands_in_si(found.islands, case.units),
    }


def islands_in_si(islands: Floats, units: Normalised) -> list[dict[str, float]]:
    """Return stable intervals, shape (n, 3) as of `device.outline.Limits`, by name."""
    k, b = units.stiffness, units.damping
    return [
        {"damping": float(beta * b), "stiffness_low": float(low * k), "stiffness_high": float(high * k)}
        for beta, low, high in islands
    ]


def wall_documents(case: DeviceCase, walls: Cases, criteria: Sequence[str] = POINT_COSTS) -> list[dict[str, Any]]:
    """Return stability and costs of each wall of a file with `WALL_COLUMNS`, in order.

    Returns
    -------
    list of dict
        As of `theory.cases.point_costs`, with ``stiffness`` and ``damping`` in SI and ``separation`` (`SlowestPole`)
        in place of the normalised parameters.
    """
    check_criteria(criteria)
    alpha, beta = walls.values[:, 0] / case.units.stiffness, walls.values[:, 1] / case.units.damping
    slowest = slowest_poles(case.loop, alpha, beta)
    radius = np.array([pole.radius for pole in slowest])
    found = points_of_loop(case.loop, alpha, beta, radius, criteria)
    return [
        {
            "stiffness": float(stiffness),
            "damping": float(damping),
            "stable": document["stable"],
            "spectral_radius": pole.radius,
            "separation": pole.separation,
            **{name: document[name] for name in criteria},
            "reason": document["reason"],
            "left_out": case.parts.left_out,
        }
        for (stiffness, damping), pole, document in zip(walls.values, slowest, found, strict=True)
    ]
