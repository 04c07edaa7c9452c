"""What an experiment's logs allow to say of its loop: the loop as it is, its limits, a passive wall, and causes."""

from __future__ import annotations

from math import sqrt
from typing import Literal

from pydantic import Field

from pipeline.records.findings import Record

CauseCode = Literal[
    "other_gains",
    "coulomb_friction",
    "velocity_filter",
    "adaptive_velocity",
    "actuator_lag",
    "vibration_mode",
    "operator",
    "saturation",
    "rate_limit",
    "unilateral_wall",
    "delay_jitter",
    "fractional_delay",
    "constant_force",
    "missing_rows",
    "repeated_rows",
    "command_shifted",
    "scattered_stamps",
    "coarse_sensor",
    "step_not_a_step",
    "several_steps",
    "force_gain",
    "sampling_period",
    "parameter_range",
    "no_stable_trial",
    "no_unstable_trial",
    "few_trials",
]


LIMITS_WITHIN = 5.0
"""Error of predicted limits [%] up to which a device is right: a course brackets a limit by 4 %."""

VERDICTS_RIGHT = 0.95
"""Share of the verdicts that a device must predict."""


class Parameter(Record):
    """A parameter of a loop in SI with its 95 % interval; one that a device file states is its own interval."""

    value: float
    low: float
    high: float


class LoopResult(Record):
    """The loop that theory and all statements about an experiment rest on, and whether it may bear them.

    ``mass``, ``damping`` and ``stiffness`` are what the wall feels, operator included, per unit of command;
    ``delay_samples`` is not rounded. ``velocity``, ``mode`` and ``operator`` hold parameters by name. ``explained`` is
    the share of the logs that the fitted model explains; None where none was fitted.
    """

    source: Literal["device file", "estimated"]
    adequate: bool
    reason: str
    explained: float | None = None
    mass: Parameter | None = None
    damping: Parameter | None = None
    stiffness: Parameter | None = None
    delay_samples: Parameter | None = None
    actuator_lag_s: Parameter | None = None
    velocity: dict[str, Parameter] | None = None
    mode: dict[str, Parameter] | None = None
    operator: dict[str, Parameter] | None = None
    friction: Parameter | None = None

    @property
    def parts_beside(self) -> list[str]:
        """Parts that it has beside mass, damping, stiffness and delay, in words."""
        found = {"velocity filter": self.velocity, "actuator lag": self.actuator_lag_s, "vibration mode": self.mode}
        friction = ["friction"] if self.has_friction else []
        return [*(name for name, part in found.items() if part is not None), *friction]

    @property
    def has_friction(self) -> bool:
        """Whether it surely has friction, which linear theory leaves out."""
        return self.friction is not None and self.friction.low > 0


class LoopLimit(Record):
    """Stiffness [N/m, Nm/rad] up to which a loop is stable at one damping, with the range of its 95 % intervals.

    With friction it holds for the step that was used; ``stiffness_large_motion`` is the linear limit, from which on a
    harder push is unstable.
    """

    damping: float
    stiffness: float
    low: float
    high: float
    stiffness_large_motion: float | None = None


class WallReplay(Record):
    """How the found device, friction and scatter included, predicts tested walls that it was not fitted to.

    ``fit_percent`` of the position behind stable walls, median; ``verdicts_same`` share of the decided verdicts;
    ``limits_off_percent`` and ``costs_off_percent`` median errors of limits and settling times,
    ``limits_known_percent`` that of the measured limits by themselves. None where there is nothing to compare.
    ``trials`` were replayed.
    """

    fit_percent: float | None
    verdicts_same: float | None
    limits_off_percent: float | None
    costs_off_percent: float | None
    trials: int
    limits_known_percent: float | None = None

    @property
    def limits_error_percent(self) -> float:
        """Median error of limits without what the measured ones leave open; 0 where there are none."""
        off, known = self.limits_off_percent or 0.0, self.limits_known_percent or 0.0
        return float(sqrt(max(off**2 - known**2, 0.0)))

    @property
    def is_right(self) -> bool:
        """Whether limits are within 5 %, and 95 % of the verdicts are right."""
        limits = self.limits_error_percent <= LIMITS_WITHIN
        if self.verdicts_same is None:
            return False
        # of few trials one may be chance
        return limits and round((1 - self.verdicts_same) * self.trials) <= max((1 - VERDICTS_RIGHT) * self.trials, 1)


class PassiveWall(Record):
    """The stiffest wall that is passive and stable over the whole 95 % range of a loop."""

    stiffness: float
    damping: float


class Cause(Record):
    """Why an experiment deviates from the ideal loop: a code of the contract, a sentence, and what shows it."""

    code: CauseCode
    sentence: str
    evidence: str


class LoopFindings(Record):
    """Loop, limits, passive wall and causes of one experiment; what is missing is None, and why stands beside it."""

    loop: LoopResult
    loop_boundary: tuple[LoopLimit, ...] | None = None
    passive: PassiveWall | None = None
    passive_reason: str | None = None
    replay: WallReplay | None = None
    causes: tuple[Cause, ...] = Field(default=())
