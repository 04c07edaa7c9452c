"""Which stiffness and damping to use: the best trial, how far it is from the stability limit, and what is passive."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.comparison.scores.overlap import MeasuredLimits, measured_limits
from pipeline.records.criteria import criterion_of
from pipeline.records.findings import Optimum
from pipeline.records.results import ExperimentResult
from pipeline.rendering.labels import (
    Units,
    cost_text,
    criterion_name,
    damping_text,
    significant,
    stiffness_text,
)

PREFERRED = ("settle_2pct", "settle_5pct", "settle_1pct", "energy_step_w1", "energy_step_w0", "energy_step_w2")
"""Criteria by which a point is recommended, the first one that has a cost: how fast a wall comes to rest is what a user
feels. Overshoot alone is no choice: its optimum is a limit, not a best point."""

NARROW = 1.25
"""Stability limit relative to the recommended stiffness below which the point is called close to it: a mass or a delay
that is wrong by a quarter moves the limit that far."""


@dataclass(frozen=True)
class Margin:
    """Limit [N/m, Nm/rad] at the damping of a point, and the dampings [Ns/m, Nms/rad] at which its stiffness is stable.

    ``bound`` says that the limit is a lower bound. ``damping_low`` and ``damping_high`` are tested dampings.
    """

    limit: float
    bound: bool
    damping_low: float
    damping_high: float


def recommended(result: ExperimentResult) -> tuple[str, Optimum] | None:
    """Return criterion and trial that are recommended, or None where no criterion of `PREFERRED` has a cost."""
    return next(((c, result.optimum[c]) for c in PREFERRED if c in result.optimum), None)


def margin(limits: MeasuredLimits, stiffness: float, damping: float) -> Margin | None:
    """Return how far a stable point is from the measured boundary, or None where that is not known.

    Parameters
    ----------
    limits : MeasuredLimits
    stiffness, damping : float
        The point, between the first and the last tested damping.

    Notes
    -----
    Along K by linear interpolation between the limits of the neighbouring dampings; along B the neighbouring tested
    dampings without a gap whose limit lies above K.
    """
    known = limits.known
    B, K, censored = limits.damping[known], limits.limit[known], limits.censored[known]
    if not len(B) or not B[0] <= damping <= B[-1]:
        return None
    near = int(np.argmin(np.abs(B - damping)))
    stable = stiffness < K
    stable[near] = True
    left, right = np.flatnonzero(~stable[:near]), np.flatnonzero(~stable[near:])
    first = int(left[-1]) + 1 if len(left) else 0
    last = near + int(right[0]) - 1 if len(right) else len(B) - 1
    return Margin(float(np.interp(damping, B, K)), bool(censored[near]), float(B[first]), float(B[last]))


def choice(result: ExperimentResult, units: Units) -> str:
    """Return the sentence that says which (K, B) to use and how robust that is; empty without an optimum."""
    found = recommended(result)
    if found is None:
        return ""
    criterion, best = found
    unit = criterion_of(criterion).family.printed_unit
    cost = cost_text(criterion, best.cost) + (f" {unit}" if unit else "")
    text = (
        f"Best trial of experiment {result.experiment}: K = {stiffness_text(best.stiffness)} {units.stiffness}, "
        f"B = {damping_text(best.damping)} {units.damping} ({criterion_name(criterion)}: {cost}"
        + (", at the edge of the tested range)" if best.censored else ")")
    )
    room = margin(measured_limits(result.boundary), best.stiffness, best.damping)
    if room is None or best.stiffness <= 0 or room.limit <= best.stiffness:
        return text + "; how far it is from the stability limit is not known."
    factor = room.limit / best.stiffness
    least = "at least " if room.bound else ""
    ends = f"B = {damping_text(room.damping_low)}"
    if room.damping_high > room.damping_low:
        ends += f" to {damping_text(room.damping_high)}"
    ends += f" {units.damping}" + ("" if room.damping_high > room.damping_low else " only")
    if factor < NARROW:
        return (
            f"{text}; the limit is only {least}{significant(factor, 3)} times as stiff and K is stable for {ends}: "
            "a small change of the device can make it unstable, so take a softer wall."
        )
    return (
        f"{text}; the limit there is {least}{significant(factor, 3)} times as stiff, and this K is stable for {ends}."
    )


def passive_choice(result: ExperimentResult, units: Units) -> str:
    """Return the sentence that names the stiffest passive wall, which is stable with every passive hand, or why none.

    Source: Hulin 2017, eqs. 4.6 and 4.11.
    """
    wall, loop = result.passive, result.loop
    if wall is None:
        return f"No passive wall is named: {result.passive_reason}." if result.passive_reason else ""
    reach = ""
    if loop is not None and loop.damping is not None and loop.delay_samples is not None:
        b, d = loop.damping, loop.delay_samples
        # a hand that lets go takes its damping along
        least = f"b = {significant(b.low, 4)} to {significant(b.high, 4)} {units.damping}"
        own = "the device's own damping" if loop.operator else f"all of {least}"
        reach = f" (4.6, for {own} and d = {significant(d.low, 4)} to {significant(d.high, 4)})"
    return (
        f"A wall that is passive, and so stable with every passive hand, has at most K = {wall.stiffness:.4g} "
        f"{units.stiffness} at B = {wall.damping:.4g} {units.damping}{reach}."
    )
