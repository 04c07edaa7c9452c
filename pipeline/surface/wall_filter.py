"""Velocity filter identified from recorded walls in logs that are not stored. `compare` finds the same filter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from pipeline.base.wording import counted
from pipeline.comparison.loops.departures import SENTENCES, LawRows, course_filter, law_departures
from pipeline.device.parts import Butterworth, VelocityFilter
from pipeline.measured.experiment.identified_loop import MOST
from pipeline.measured.stages.measured_trial import MeasuredTrial

OPEN = (
    *("velocity_filter", "adaptive_velocity", "position_filter"),
    *("decimated_rows", "several_steps", "unknown"),
)
"""Deviations from the wall law that may be caused by a velocity other than the difference quotient."""

NOT_KNOWN = "The velocity filter of the walls is unknown: {}. The boundary is valid for the difference quotient."


@dataclass(frozen=True)
class WallFilter:
    """The velocity filter in the wall law, as identified from recorded walls.

    Parameters
    ----------
    velocity : VelocityFilter or None
        The filter on which most logs agree. None for the difference quotient, or if the filter is unknown.
    of_logs : tuple of VelocityFilter
        Filters of the individual logs.
    sentence : str
        Description of the filter, or the reason why the filter is unknown.
    left_out : bool
        True if the logs show an adaptive velocity filter, which a linear loop cannot include.
    """

    velocity: VelocityFilter | None
    of_logs: tuple[VelocityFilter, ...]
    sentence: str
    left_out: bool = False

    def at(self, period: float, wall_period: float) -> WallFilter:
        """Return the filter for walls with a sampling period [s] that may differ from the period of the logs."""
        if self.velocity is None or wall_period == period:
            return self
        if isinstance(self.velocity, Butterworth) and self.velocity.cutoff_hz >= 0.5 / wall_period:
            why = (
                f"its cutoff frequency in the logs, {self.velocity.cutoff_hz:g} Hz, is not below half of the sampling "
                "rate of the walls"
            )
            return WallFilter(None, (), NOT_KNOWN.format(why), left_out=True)
        return replace(self, sentence=f"{self.sentence} The filter is assumed to be the same at T = {wall_period:g} s.")


def wall_filter(trials: Sequence[MeasuredTrial]) -> WallFilter | None:
    """Return the velocity filter identified from trials at walls (K > 0), or None without such a trial."""
    walls = [each for each in trials if each.logged.stiffness > 0]
    damped = [each for each in walls if each.logged.damping != 0]
    if not damped:
        return WallFilter(None, (), NOT_KNOWN.format("all walls have a damping of 0")) if walls else None
    rows = LawRows.of_logs(damped)
    if rows.misled:
        return WallFilter(
            None, (), NOT_KNOWN.format("most logs follow a wall that differs from the one in their header")
        )
    if not rows.compared:
        return WallFilter(None, (), NOT_KNOWN.format("no log has a step after which the command shows the wall law"))
    if (common := course_filter(rows)) is not None:
        share = f"{len(common.of_logs)} of {counted(rows.compared, 'log')}"
        return WallFilter(common.velocity, tuple(common.of_logs), f"The wall's velocity {common.words} ({share}).")
    others = sum(not set(OPEN).isdisjoint(codes) for codes in rows.of_stated_wall)
    if rows.compared - others > MOST * rows.compared:
        share = f"{rows.compared - others} of {counted(rows.compared, 'log')}"
        return WallFilter(None, (), f"The wall's velocity is the difference quotient ({share}).")
    departures = [each for each in law_departures(rows) if each.code in OPEN]
    why = f"{others} of {counted(rows.compared, 'log')} deviate from the difference quotient, each differently"
    if departures and departures[0].code == "velocity_filter":
        why = "the logs show different filters"
    elif departures and departures[0].most:
        why = SENTENCES[departures[0].code].rstrip(".")
        why = f"{why[0].lower()}{why[1:]} ({departures[0].shown})"
    return WallFilter(None, (), NOT_KNOWN.format(why), left_out=True)
