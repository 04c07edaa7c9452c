"""Find forces or a spring that keep settled devices away from the expected rest position x_0 + F_0/K."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.measured.experiment.identified_loop import FEWEST_LOGS
from pipeline.measured.experiment.stored import Experiment
from pipeline.measured.signal.sensor import sensor_floor
from pipeline.measured.student import SMALLEST
from pipeline.records.findings import MATTERS
from pipeline.records.trials import Booleans, Floats

RESTS = 3.0
"""Smallest distance, in sensor floors, at which a rest position counts as different from x_0 + F_0/K."""

SLIGHT = 0.1 * MATTERS
"""Threshold for the displacing force, relative to the step. Below it, the force is negligible. The threshold exceeds
the effect of residual motion."""

OFTEN = 0.2
"""Smallest share of logs with a displaced rest position that is not attributed to trials that still move."""

ALIKE = 0.5
"""Largest difference of the displacing forces from their median, relative to the median, at which they count as the
same force. It includes the sensor error."""

LASTING = 12.0
"""Length of a log, in time constants of its decay, after which the mean of its last tenth is not affected by the
motion."""


@dataclass(frozen=True)
class RestForces:
    """Forces K (x_end - x_0) - F_0 that displace a device from the expected rest position.

    ``typical`` is their median [N, Nm]. ``off`` of ``of`` logs have a displacement above the sensor resolution.
    ``constant`` states whether the logs show the same force along the step, which is then not friction. ``spring`` is
    the stiffness k [N/m, Nm/rad] of a device that rests at x_0 + F_0/(K + k) in all logs. It is 0 if the logs do not
    show such a spring.
    """

    typical: float
    off: int
    of: int
    constant: bool
    spring: float = 0.0

    @property
    def is_reliable(self) -> bool:
        """Whether enough logs have a displaced rest position to show a further force, a spring or friction."""
        return _are_many(self.off, self.of)


def rest_forces(of: Experiment) -> RestForces:
    """Return the forces that displace settled devices from x_0 + F_0/K, and the spring if one explains these forces.

    Notes
    -----
    A spring exerts the force -k (x_end - x_0), which decreases with the stiffness of the wall. A constant force and
    friction do not depend on the wall. A spring is reported if it explains the forces and a constant force does not.
    """
    settled = _settled(of)
    stiffness = of.column("response", "stiffness")[settled]
    names = ("position_start", "position_final_expected", "position_final_measured")
    start, expected, end = (of.column("response", name)[settled] for name in names)
    floor = sensor_floor(*(of.column("response", f"sensor_{name}")[settled] for name in ("quantum", "noise")))
    force, moved = stiffness * (end - expected), end - start
    reach = stiffness * (RESTS * floor + SLIGHT * np.abs(expected - start))
    off = np.abs(force) > reach
    if not off.any():
        return RestForces(0.0, 0, len(force), False)
    middle = float(np.median(force[off]))
    alike = float(np.abs(force[off] - middle).max()) <= ALIKE * abs(middle)
    along = middle * float(np.median(stiffness * (expected - start))) > 0
    spring = _spring(force, moved, reach) if _are_many(int(off.sum()), len(force)) else 0.0
    return RestForces(middle, int(off.sum()), len(force), alike and along, spring)


def rest_spring(of: Experiment) -> float:
    """Return the stiffness k [N/m, Nm/rad] of the device.

    It is the declared stiffness, or otherwise the stiffness that follows from the rest positions. It is 0 if neither is
    available.
    """
    return of.spring or of.once(rest_forces).spring


def _are_many(off: int, of: int) -> bool:
    return off >= FEWEST_LOGS and off > OFTEN * of


def _spring(force: Floats, moved: Floats, reach: Floats) -> float:
    """Return k of force = -k moved if it explains the forces, and a constant force common to all logs does not."""
    weight = 1 / np.maximum(reach, SMALLEST) ** 2
    k = -float((weight * moved) @ force) / float((weight * moved) @ moved)
    # soft walls have the largest weight, also in the fit of the constant: at a single stiffness, friction looks like a
    # spring
    constant = float(weight @ force) / float(weight.sum())
    left, same = (int((np.abs(rest) > reach).sum()) for rest in (force + k * moved, force - constant))
    return k if k > 0 and not _are_many(left, len(force)) and _are_many(same, len(force)) else 0.0


def _settled(of: Experiment) -> Booleans:
    """Return whether each trial has reached a final position, i.e. is stable and has decayed within its log."""
    rows = dict(zip(*(of.trials.column(name).to_pylist() for name in ("trial_id", "rows")), strict=True))
    duration = np.array([rows[name] for name in of.texts("response", "trial_id")], dtype=np.float64)
    decay = np.nan_to_num(of.column("response", "growth_per_s")) * duration * of.sampling_period_s
    expected = of.column("response", "position_final_expected")
    settled: Booleans = (of.verdicts.verdict == "stable") & np.isfinite(expected) & (decay < -LASTING)
    return settled
