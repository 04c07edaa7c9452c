"""The stiffest wall that is guaranteed to be passive and stable over the 95 % range of an adequate loop."""

from __future__ import annotations

from math import floor, log10

import numpy as np

from pipeline.comparison.limits import measured_limits
from pipeline.comparison.loops.causes import FEW
from pipeline.comparison.loops.loop_basis import LoopBasis
from pipeline.device.loop import Loop
from pipeline.loop.normalised_loop import LARGEST_DELAY, LoopUnits, NormalisedLoop
from pipeline.measured.wall_command.log_rows import SET_DIGITS
from pipeline.planning.loop_limits import limits_of
from pipeline.records.results import MeasuredExperiment, PassiveWall
from pipeline.theory.passivity import required_damping, stiffest_passive

SPARE = 1e-4
"""Safety margin, as a fraction of damping and limit. It is a hundred times the error of the frequency grid."""

TRIES = 200
"""Largest number of steps by which a stiffness is lowered.

A step is two units of the last of `SET_DIGITS` digits. All steps together lower the stiffness by 4 %. Rounding lowers
it by 0.1 %.
"""


def passive_wall(basis: LoopBasis, result: MeasuredExperiment) -> tuple[PassiveWall | None, str | None]:
    """Return the stiffest wall that is passive and stable for all loops within intervals and replay error.

    If there is none, return None and the reason.


    Parameters
    ----------
    basis : LoopBasis
    result : MeasuredExperiment
        Experiment whose measured limits bound the wall.

    Notes
    -----
    A passive wall is given only if limits were measured at its damping or on both sides of it, and not for few trials.
    The smallest device damping is the lower end of b, minus the parts of an operator and of the far side of a mode. The
    stiffness is rounded down. The rounded pair is checked against passivity, the limits of theory over all intervals,
    and the measured limits interpolated between the dampings. The stable region is convex there, so its chords lie
    inside.
    """
    if result.trials < FEW:
        return None, f"{result.trials} trials are too few to guarantee stability with any operator; record {FEW}"
    damping = _least_damping(basis)
    if damping <= 0:
        return None, (
            "no wall is passive for the whole range of the device's damping, which may be 0: stability with any "
            "operator is not guaranteed (4.6)"
        )
    if _is_sensed_at_load(basis):
        return None, "the position is sensed beyond the vibration mode: no wall is passive for every operator"
    loops = _loops(basis)
    if not loops:
        return None, "the delay may exceed the largest delay that the theory covers"
    plants = [(LoopUnits.of(loop), NormalisedLoop.of(loop)) for loop in loops]
    walls = [(units, *stiffest_passive(plant, damping / units.damping)) for units, plant in plants]
    highest, wall_damping = min((alpha * units.stiffness, beta * units.damping) for units, alpha, beta in walls)
    wall_damping = float(f"{wall_damping:.{SET_DIGITS}g}")
    measured = _measured(result, wall_damping)
    if measured is None:
        where = f"near a damping of {wall_damping:g}, that of the stiffest passive wall"
        return None, f"no limit was measured {where}: record stable and unstable trials there"
    at = np.array([wall_damping])
    stable = float(basis.band([limits_of(device, at) for device in basis.devices])[0][0]) * (1 - SPARE)
    stiffness = _rounded_down(min(highest, stable, measured))
    # A smaller stiffness at the same damping needs less device damping. In the limit K = 0, it needs the device damping
    # for B alone.
    for _ in range(TRIES):
        if stiffness <= 0 or all(_needed(*plant, stiffness, wall_damping) <= damping for plant in plants):
            break
        stiffness = _rounded_down(stiffness * (1 - 2 * 10.0**-SET_DIGITS))
    else:
        return None, "no passive wall was found at dampings with a measured limit"
    if stiffness <= 0:
        return None, "the logs show no stable wall at the damping of the stiffest passive wall"
    return PassiveWall(stiffness=stiffness, damping=wall_damping), None


def is_passive(basis: LoopBasis, stiffness: float, damping: float) -> bool | None:
    """Return whether a wall [N/m, Nm/rad; Ns/m, Nms/rad] is passive over the whole range of a loop.

    The result is None if a delay exceeds the largest delay that the theory covers.
    """
    least = _least_damping(basis)
    if least <= 0 or _is_sensed_at_load(basis):
        return False
    plants = [(LoopUnits.of(loop), NormalisedLoop.of(loop)) for loop in _loops(basis)]
    return all(_needed(*plant, stiffness, damping) <= least for plant in plants) if plants else None


def _least_damping(basis: LoopBasis) -> float:
    """Return the smallest damping of the device without operator and load, where the wall acts [Ns/m, Nms/rad]."""
    of_load = max(loop.load_damping for loop in basis.loops)
    return (basis.interval("damping").low - basis.operator_damping - of_load) * (1 - SPARE)


def _is_sensed_at_load(basis: LoopBasis) -> bool:
    return any(loop.mode is not None and loop.mode.sensor == "load" for loop in basis.loops)


def _loops(basis: LoopBasis) -> list[Loop]:
    """Return the devices within the range of a loop for which a wall must be passive, or () if a delay is too long.

    The passivity condition is most restrictive at an end of the delay's interval, or at an integer inside it.
    """
    delay = basis.interval("delay_samples")
    low, high = max(delay.low, 0.0), max(delay.high, 0.0)
    if high > LARGEST_DELAY:
        return []
    delays = {low, high, *np.arange(np.ceil(low), floor(high) + 1).tolist()}
    return basis.loops + [basis.loop.replace({"delay_samples": each}) for each in sorted(delays)]


def _rounded_down(value: float) -> float:
    if not value > 0:
        return 0.0
    step = 10.0 ** (floor(log10(value)) - SET_DIGITS + 1)
    return float(f"{floor(value / step) * step:.{SET_DIGITS}g}")


def _measured(result: MeasuredExperiment, damping: float) -> float | None:
    """Return the lower end of the measured limits at a damping, or None outside the dampings with a measured limit.

    If no trial was stable, only the softest unstable trial is known.
    """
    limits = measured_limits(result.boundary)
    ended = limits.known & ~limits.censored
    where = limits.damping[ended]
    if not len(where) or not where[0] <= damping <= where[-1] or not (limits.low[ended] > 0).any():
        return None
    least = np.where(limits.low[ended] > 0, limits.low[ended], limits.high[ended])
    return float(np.interp(damping, where, least))


def _needed(units: LoopUnits, plant: NormalisedLoop, stiffness: float, damping: float) -> float:
    """Return the device damping [Ns/m, Nms/rad] that a wall requires."""
    wall = np.array([stiffness / units.stiffness]), np.array([damping / units.damping])
    return float(required_damping(plant, *wall)[0]) * units.damping
