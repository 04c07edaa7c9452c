"""Where settled devices rest: at x_0 + F_0/K, or away from it by a force or by a spring on the device."""

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
"""Distance from x_0 + F_0/K, in sensor floors, from which on a device rests elsewhere."""

SLIGHT = 0.1 * MATTERS
"""Force relative to the step that is none, and more than the motion that is left."""

OFTEN = 0.2
"""Share of the logs that come to rest elsewhere, from which on they are no accidents (trials that still move)."""

ALIKE = 0.5
"""Largest relative difference of the displacing forces from their median up to which they are one force: the sensor
adds to them."""

LASTING = 12.0
"""Decay, in time constants over the log, after which nothing of the motion is left in the mean of its last tenth."""


@dataclass(frozen=True)
class RestForces:
    """Forces K (x_end - x_0) - F_0 that displace a device from the rest position of the wall.

    ``typical`` is their median [N, Nm], ``off`` the number of logs of ``of`` that rest farther off than their sensor
    can resolve; ``constant`` means that they are one force, not friction: it acts along the step. ``spring`` is
    the stiffness k [N/m, Nm/rad] of a device whose logs all rest at x_0 + F_0/(K + k), 0 where they do not.
    """

    typical: float
    off: int
    of: int
    constant: bool
    spring: float = 0.0

    @property
    def tells(self) -> bool:
        """Whether so many logs rest elsewhere that the loop has another force, a spring or friction."""
        return _are_many(self.off, self.of)


def rest_forces(of: Experiment) -> RestForces:
    """Return the forces that displace settled devices from x_0 + F_0/K, and the spring that explains all of them.

    Notes
    -----
    A spring pulls by -k (x_end - x_0), less the stiffer the wall is; a constant force and friction do not depend on the
    wall. A spring is reported where it explains what a constant force does not.
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
    """Return the stiffness k [N/m, Nm/rad] of the device: as declared, else by where it rests; 0 for none."""
    return of.spring or of.once(rest_forces).spring


def _are_many(off: int, of: int) -> bool:
    return off >= FEWEST_LOGS and off > OFTEN * of


def _spring(force: Floats, moved: Floats, reach: Floats) -> float:
    """Return k of force = -k moved where that explains the forces and none that is the same in all logs does."""
    weight = 1 / np.maximum(reach, SMALLEST) ** 2
    k = -float((weight * moved) @ force) / float((weight * moved) @ moved)
    # soft walls decide; at one stiffness friction looks like a spring: the constant is theirs, too
    constant = float(weight @ force) / float(weight.sum())
    left, same = (int((np.abs(rest) > reach).sum()) for rest in (force + k * moved, force - constant))
    return k if k > 0 and not _are_many(left, len(force)) and _are_many(same, len(force)) else 0.0


def _settled(of: Experiment) -> Booleans:
    """Which trials have a final position that their motion has reached: stable ones that decayed within their log."""
    rows = dict(zip(*(of.trials.column(name).to_pylist() for name in ("trial_id", "rows")), strict=True))
    duration = np.array([rows[name] for name in of.texts("response", "trial_id")], dtype=np.float64)
    decay = np.nan_to_num(of.column("response", "growth_per_s")) * duration * of.sampling_period_s
    expected = of.column("response", "position_final_expected")
    settled: Booleans = (of.verdicts.verdict == "stable") & np.isfinite(expected) & (decay < -LASTING)
    return settled
