"""The search for the best settling time, and how far its result is from the best wall in truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.loop.device_loop import DeviceLoop, loop_of, wall_units
from pipeline.loop.loop import Loop, Normalised
from pipeline.plan.course import Wish, wanted_dampings
from pipeline.plan.planner import plan_of
from pipeline.simulation.simulate import simulate
from pipeline.studies.planning.rig import Rig
from pipeline.theory.cost.pointcosts import point_costs_by_name
from pipeline.theory.optimum.optimum import optimal_point

CRITERION = "settle_2pct"

MOST_TRIALS = 80
"""Trials after which the search is given up."""

GRID = 60
"""Walls along each axis among which the best one of a device with friction is looked for: theory has none."""

LONGEST = 20_000
"""Samples within which the exact responses have settled."""


@dataclass(frozen=True)
class FoundBest:
    """Trials of a search, whether it said that it is done, and the cost of its best wall over the least, less 1."""

    trials: int
    done: bool
    above: float


def look_for_best(rig: Rig) -> FoundBest:
    """Run a search for the best settling time."""
    wish = Wish(goal="optimum", criterion=CRITERION)
    while True:
        answer = plan_of(rig.course(costs=True), wish)
        if answer.done or answer.trials_used >= MOST_TRIALS:
            break
        rig.measure(answer.next[0].stiffness, answer.next[0].damping)
    if answer.optimum is None:
        return FoundBest(answer.trials_used, answer.done, float("inf"))
    wall = answer.optimum.stiffness, answer.optimum.damping
    cost = _cost(rig, *wall)
    return FoundBest(answer.trials_used, answer.done, cost / min(_least(rig), cost) - 1)


def _loop(rig: Rig) -> tuple[Loop | DeviceLoop, Normalised] | None:
    device = rig.case.device
    of, period = device.experiments[0], device.sampling_period_s
    parts = device.loop_of(of)
    if parts.friction is not None:
        return None
    return loop_of(of.mass, of.damping, of.stiffness, of.delay_samples, period, parts), wall_units(
        of.mass, period, parts
    )


def _cost(rig: Rig, stiffness: float, damping: float) -> float:
    """Return the cost of a wall: exact, or with friction the measured one."""
    known = _loop(rig)
    K, B = np.array([stiffness]), np.array([damping])
    if known is None:
        return float(rig.settling(simulate(rig.setup, K, B, seed=rig.seed))[0])
    loop, units = known
    return float(point_costs_by_name(loop, K / units.stiffness, B / units.damping, [CRITERION], LONGEST)[CRITERION][0])


def _least(rig: Rig) -> float:
    """Return the least cost of any wall: exact, or with friction the least of a dense grid."""
    known = _loop(rig)
    if known is not None:
        return optimal_point(known[0], CRITERION).cost
    dampings = wanted_dampings(rig.course(), Wish())
    largest = float(rig.truth(dampings)[0].max())
    K, B = np.meshgrid(np.linspace(0, largest, GRID + 1)[1:], np.linspace(dampings[0], dampings[-1], GRID))
    return float(np.nanmin(rig.settling(simulate(rig.setup, K.ravel(), B.ravel(), seed=rig.seed))))
