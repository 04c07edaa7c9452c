"""What the logs cannot tell apart: the combination that is known, and what to record for more."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.base.wording import counted
from pipeline.measured.model.intervals import Errors, Interval, Numbers, Quantity
from pipeline.measured.model.parts import Choice
from pipeline.measured.model.recordings import Recording
from pipeline.records.batch import Floats

WIDE = 0.5
"""Half width of an interval, relative to its value, from which on a quantity counts as not told: it may be three times
as large at one end as at the other."""


@dataclass(frozen=True)
class Combination:
    """A combination that is known where its members are not, in SI, with its unit as a power of [s], and a remedy."""

    code: str
    members: tuple[str, ...]
    interval: Interval
    unit: str
    record: str


@dataclass(frozen=True)
class Recorded:
    """What was recorded: most sizes of the command in one direction, directions of it and of the motion, trials."""

    sizes: int
    signs: int
    directions: int
    trials: int

    @classmethod
    def of(cls, recordings: list[Recording]) -> Recorded:
        """Return what a set of recordings holds."""
        largest = max(float(np.abs(each.command).max()) for each in recordings) or 1.0
        usual = np.round(
            [20 * float(np.median(each.command[len(each.command) // 4 :])) / largest for each in recordings]
        )
        ways = {np.sign(each.position[-1] - each.position[0]) for each in recordings}
        turns = any(_turns(each.position) for each in recordings)
        several = any(len(np.unique(np.round(20 * each.command / largest))) > 2 for each in recordings)
        signs = {np.sign(level) for level in usual} - {0.0}
        sizes = max((len({level for level in usual if level * sign > 0}) for sign in signs), default=0)
        return cls(
            max(sizes, 2 if several else 0),
            2 if several else len(signs),
            2 if turns else len(ways - {0.0}),
            len(recordings),
        )

    def remedy(self) -> str:
        """Return what to record so that friction, a constant force and the mass are told apart."""
        if self.sizes < 2:
            return "steps of two sizes in one direction"
        if self.directions < 2 or self.signs < 2:
            return "the same steps in the other direction, or one that turns back in motion"
        return f"more than {counted(self.trials, 'run')} of several sizes and directions"


def _turns(position: Floats) -> bool:
    """Return whether a log goes there and back by a tenth of its range."""
    way = float(np.ptp(position))
    ahead = np.maximum.accumulate(position) - position
    behind = position - np.minimum.accumulate(position)
    return bool(way > 0 and min(ahead.max(), behind.max()) > 0.1 * way)


def is_told(interval: Interval) -> bool:
    """Return whether an interval is narrow enough to be a value."""
    return bool(np.isfinite(interval.error) and interval.high - interval.low < 2 * WIDE * abs(interval.value))


def combinations(choice: Choice, errors: Errors, recorded: Recorded, untold: set[str]) -> list[Combination]:
    """Return the known combinations of quantities that are not told."""
    scales, numbers = choice.scales, errors.numbers
    acceleration = scales.position / scales.period**2
    level = _usual_level(choice)
    found: list[Combination] = []

    def add(code: str, members: tuple[str, ...], quantity: Quantity, unit: str, record: str) -> None:
        interval = errors.interval(quantity)
        if is_told(interval):
            found.append(Combination(code, members, interval, unit, record))

    if "mass" in untold:
        remedy = recorded.remedy()

        def driven(n: Numbers) -> float:
            against = n.get("coulomb", 0.0) * np.sign(level)
            return float((n["gain"] * level - against + n.get("force", 0.0)) * acceleration)

        members = ("mass", *(("friction",) if "coulomb" in numbers else ()), "constant_force")
        add("acceleration", members, driven, "acceleration", remedy)
        add("damping_per_mass", ("damping", "mass"), lambda n: n["delta"] / scales.period, "1/s", remedy)
        if "gamma" in numbers:
            add("stiffness_per_mass", ("stiffness", "mass"), lambda n: n["gamma"] / scales.period**2, "1/s^2", remedy)
    elif "friction" in untold and "force" in numbers:

        def against(n: Numbers) -> float:
            return float((n["coulomb"] - np.sign(level) * n["force"]) / n["gain"] * scales.command)

        add("friction_less_force", ("friction", "constant_force"), against, "force", recorded.remedy())
    if "delay" in choice.bounds or ("delay" in untold and "lag" in numbers):
        add(
            "delay_and_lag",
            ("delay", "actuator_lag"),
            lambda n: (n["delay"] + n.get("lag", 0.0)) * scales.period,
            "s",
            "steps of the command at a higher sampling rate, or with a finer sensor",
        )
    return found


def _usual_level(choice: Choice) -> float:
    """Return the largest of the usual commands of the stretches, in units of `Scales`, with its sign."""
    held = choice.held
    usual = np.median(held.command[held.lead :], axis=0)
    return float(usual[np.argmax(np.abs(usual))]) if len(usual) else 1.0
