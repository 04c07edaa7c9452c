"""What an experiment's logs allow to say of its loop: the loop as it is, its limits, a passive wall, and causes."""

from __future__ import annotations

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
    "no_stable_trial",
    "no_unstable_trial",
    "few_trials",
]


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
        """Linear parts that it has beside mass, damping, stiffness and delay, in words."""
        found = {"velocity filter": self.velocity, "actuator lag": self.actuator_lag_s, "vibration mode": self.mode}
        return [name for name, part in found.items() if part is not None]


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
    causes: tuple[Cause, ...] = Field(default=())
