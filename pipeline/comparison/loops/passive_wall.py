"""The stiffest passive wall that may be named: passive and stable over the whole 95 % range of an adequate loop."""

from __future__ import annotations

from dataclasses import replace
from math import floor, log10

import numpy as np

from pipeline.comparison.loops.loop_range import LoopPoint, LoopRange
from pipeline.comparison.scores.overlap import measured_limits
from pipeline.loop.device_loop import wall_units
from pipeline.loop.loop import LARGEST_DELAY
from pipeline.records.loop_records import PassiveWall
from pipeline.records.results import ExperimentResult
from pipeline.theory.passivity import required_damping, stiffest_passive

DIGITS = 4
"""Digits with which a passive wall is named; what is named is checked."""

SPARE = 1e-4
"""Part of the damping that is kept back: a hundred times what the frequencies that are looked at can miss."""

FEWEST_TRIALS = 10
"""Trials without which nobody is told that a wall is safe: what differs between trials shows from ten on."""

_TRIES = 200
"""Steps of two units of the last digit by which a stiffness is lowered: 4 % in all, where rounding costs 0.1 %."""


def passive_wall(loop: LoopRange, result: ExperimentResult) -> tuple[PassiveWall | None, str | None]:
    """Return the stiffest wall that is passive and stable whatever the intervals leave open, or None and why.

    Parameters
    ----------
    loop : LoopRange
    result : ExperimentResult
        Its measured limits bound the wall.

    Notes
    -----
    A passive wall is named where limits were measured on both sides of it, or at it, and in no course of few trials.
    The device has the least damping at the lower end of b, less what an operator has of it. The stiffness is rounded
    down and the rounded pair is held against passivity, the limits of theory over all intervals, and the measured
    limits, interpolated between the dampings: the stable region is convex there, so that a chord of it lies inside.
    """
    if result.trials < FEWEST_TRIALS:
        return None, f"{result.trials} trials are too few to promise stability with every hand; record {FEWEST_TRIALS}"
    damping = loop.damping.low - loop.held
    if damping <= 0:
        return None, (
            "no wall is passive for the whole range of the device's damping, which may be 0: stability with every hand "
            "cannot be promised (4.6)"
        )
    if loop.parts.mode is not None and loop.parts.mode.sensor == "load":
        return None, "the position is sensed beyond the vibration mode: no wall is passive for every hand"
    loops = _loops(loop)
    if not loops:
        return None, "the delay may be longer than theory is computed for"
    highest, wall_damping = _stiffest(loops, damping)
    wall_damping = _rounded(wall_damping)
    measured = _measured(result, wall_damping)
    if measured is None:
        where = f"beside a damping of {wall_damping:g}, that of the stiffest passive wall"
        return None, f"no limit was measured {where}: record stable and unstable trials there"
    stiffness = _rounded_down(min(highest, _stable_everywhere(loop, wall_damping), measured))
    # a smaller stiffness at the same damping needs less, down to none but that for B itself
    for _ in range(_TRIES):
        if stiffness <= 0 or _holds(loop, loops, stiffness, wall_damping):
            break
        stiffness = _rounded_down(stiffness * (1 - 2 * 10.0**-DIGITS))
    else:
        return None, "no wall that is passive was found beside the measured limits"
    if stiffness <= 0:
        return None, "the logs show no stable wall at the damping of the stiffest passive one"
    return PassiveWall(stiffness=stiffness, damping=wall_damping), None


def _stiffest(loops: list[LoopPoint], damping: float) -> tuple[float, float]:
    """Return stiffness and damping of the stiffest wall that is passive with all of some loops."""
    found = []
    for each in loops:
        units = wall_units(each.mass, each.sampling_period_s, each.parts)
        alpha, beta = stiffest_passive(each.loop, damping / units.damping)
        found.append((alpha * units.stiffness, beta * units.damping))
    return min(found)


def _loops(loop: LoopRange) -> list[LoopPoint]:
    """Return the loops in the range of one with which a wall must be passive; none where a delay is too long.

    Without other parts the delay alone matters: passivity needs most at one end of its interval or at a whole number
    inside it.
    """
    if loop.apart:
        return [loop.point, *(end for both in loop.apart for end in both)]
    found = [replace(loop.point, delay_samples=delay) for delay in _delays(loop)]
    return found + (_loops(loop.shown) if found and loop.shown else [])


def _delays(loop: LoopRange) -> list[float]:
    low, high = max(loop.delay_samples.low, 0.0), max(loop.delay_samples.high, 0.0)
    if high > LARGEST_DELAY:
        return []
    whole = np.arange(np.ceil(low), floor(high) + 1).tolist()
    return sorted({low, max(loop.delay_samples.value, 0.0), high, *whole})


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")


def _rounded_down(value: float) -> float:
    if not value > 0:
        return 0.0
    step = 10.0 ** (floor(log10(value)) - DIGITS + 1)
    return float(f"{floor(value / step) * step:.{DIGITS}g}")


def _stable_everywhere(loop: LoopRange, damping: float) -> float:
    """Return the least limit of theory at a damping, less what keeps a wall off the limit itself."""
    return float(loop.band(np.array([damping]))[0][0]) * (1 - SPARE)


def _measured(result: ExperimentResult, damping: float) -> float | None:
    """Return the lower end of the measured limits at a damping, None outside those that were tested to their end.

    Where no trial was stable, all that is known is the softest unstable one.
    """
    limits = measured_limits(result.boundary)
    ended = limits.known & ~limits.censored
    where = limits.damping[ended]
    if not len(where) or not where[0] <= damping <= where[-1] or not (limits.low[ended] > 0).any():
        return None
    least = np.where(limits.low[ended] > 0, limits.low[ended], limits.high[ended])
    return float(np.interp(damping, where, least))


def _holds(loop: LoopRange, loops: list[LoopPoint], stiffness: float, damping: float) -> bool:
    least = (loop.damping.low - loop.held) * (1 - SPARE)
    passive = all(_needed(each, stiffness, damping) <= least for each in loops)
    return passive and stiffness <= _stable_everywhere(loop, damping)


def _needed(point: LoopPoint, stiffness: float, damping: float) -> float:
    """Return the damping [Ns/m, Nms/rad] that a wall needs of the device."""
    units = wall_units(point.mass, point.sampling_period_s, point.parts)
    wall = np.array([stiffness / units.stiffness]), np.array([damping / units.damping])
    return float(required_damping(point.loop, *wall)[0]) * units.damping
