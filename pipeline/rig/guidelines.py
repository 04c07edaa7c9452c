"""Compute guidelines for a rig: the effects of delay, sampling, damping, mass and a hand on the stiffest wall.

Source: Hulin 2017, secs. 3.3 and 3.6, Table 3.2.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace

from pipeline.base.errors import ParameterError
from pipeline.base.json_object import JsonObject
from pipeline.device.parameters import is_rotation
from pipeline.device.parts import Operator
from pipeline.device_data.published import human_arms
from pipeline.rig.wish import stiffness_max
from pipeline.surface.physical_loop import Loop

RANGES = {"gamma": 1e-3, "delta": 20e-3}
"""Largest normalised stiffness and damping of arm and device for sampling periods up to 1 ms (3.17)."""

_NO_MASS = 1e-9
"""Mass [kg] of an operator who adds only damping or stiffness. With zero mass there would be no operator."""

USUAL_ARM = "Tsuji et al."
"""Source of the typical arm, whose mass of 1.8 kg is the median of Table 3.2."""


@dataclass(frozen=True)
class Influence:
    """Value of a parameter of a hand [SI units], and the resulting change in the largest stable K in percent."""

    name: str
    value: float
    percent: float


@dataclass(frozen=True)
class Guidelines:
    """Effects on the stiffest wall of a rig.

    Parameters
    ----------
    delay_percent : float or None
        Change in the largest stable K if the delay is one sample shorter. It is None if the delay is below one sample.
    sampling_percent : float
        Change in the largest stable K if the sampling period is halved and the delay in seconds is unchanged.
    damping_percent : float
        Change in the largest stable K if the device has no damping.
    hand : tuple of Influence
        Changes due to the mass, the damping and the stiffness of a hand, each added separately. The tuple is empty for
        a rotation, because no arms are tabulated for rotations.
    arm : str
        Name of the arm that the hand belongs to.
    gamma, delta : float
        Normalised stiffness and damping of the rig with this hand (3.13).
    """

    delay_percent: float | None
    sampling_percent: float
    damping_percent: float
    hand: tuple[Influence, ...]
    arm: str
    gamma: float
    delta: float

    @property
    def within(self) -> dict[str, bool]:
        """Whether gamma and delta are in the ranges that the thesis considers (3.17)."""
        return {name: getattr(self, name) <= most for name, most in RANGES.items()}

    def document(self) -> JsonObject:
        """Return the numbers and the sentences as a JSON document."""
        return asdict(self) | {"within": self.within, "sentences": self.sentences()}

    def sentences(self) -> list[str]:
        """Return the guidelines of sec. 3.6 with the numbers of this rig."""
        lines = []
        if self.delay_percent is not None:
            lines.append(f"One sample less delay changes the largest stable K by {_signed(self.delay_percent)}.")
        lines.append(
            f"Sampling twice as fast with the same delay in seconds changes it by {_signed(self.sampling_percent)}: "
            "faster sampling is worthwhile if sampling contributes more than the delay."
        )
        lines.append(
            f"Without damping of the device, it would change by {_signed(self.damping_percent)}: this damping "
            f"{'contributes little' if abs(self.damping_percent) < 20 else 'contributes'} to stability."
        )
        if self.hand:
            parts = ", ".join(f"{each.name} {each.value:g} {_signed(each.percent)}" for each in self.hand)
            lines.append(f"Effects of a hand ({self.arm}), one parameter at a time: {parts}.")
        outside = [name for name, inside in self.within.items() if not inside]
        values = f"gamma = {self.gamma:.3g}, delta = {self.delta:.3g}"
        lines.append(
            f"In total, {values} {'lie in' if not outside else 'lie outside'} the ranges of (3.17)"
            + ("." if not outside else f" ({', '.join(f'{name} at most {RANGES[name]:g}' for name in outside)}).")
        )
        return lines


def guidelines(loop: Loop) -> Guidelines:
    """Return the effects of changes to a rig on its stiffest wall.

    Parameters
    ----------
    loop : Loop
        Rig. If the loop has an operator, it is the hand, and it is removed to compute the effect of a hand.

    Raises
    ------
    ParameterError
        If no wall is stable.
    """
    arm = next(arm for arm in human_arms() if arm.source == USUAL_ARM)
    free = replace(loop, operator=None)
    most = stiffness_max(free)
    given = loop.operator or Operator(**arm.model_dump(include={"mass", "damping", "stiffness"}))
    usual = loop.operator is None
    hand = () if usual and is_rotation(loop.motion) else _hand(free, given, most)
    held = replace(free, operator=given).normalised_loop if hand else loop.normalised_loop
    samples = loop.delay_samples
    shorter = replace(free, jitter_samples=(), delay_samples=samples - 1) if samples >= 1 else None
    faster = replace(free, jitter_samples=(), delay_samples=2 * samples, sampling_period_s=0.5 * free.sampling_period_s)
    undamped = replace(free, damping=free.mode.load_damping if free.mode is not None else 0.0)
    return Guidelines(
        delay_percent=None if shorter is None else _percent(stiffness_max(shorter), most),
        sampling_percent=_percent(stiffness_max(faster), most),
        damping_percent=_percent(stiffness_max(undamped), most),
        hand=hand,
        arm=USUAL_ARM if usual else "the operator of the device file",
        gamma=held.gamma,
        delta=held.delta,
    )


def _hand(free: Loop, given: Operator, most: float) -> tuple[Influence, ...]:
    """Compute the effect of each parameter of a hand on the largest stable stiffness."""
    found = []
    for name in ("mass", "damping", "stiffness"):
        value = float(getattr(given, name))
        numbers = {"mass": _NO_MASS, "damping": 0.0, "stiffness": 0.0} | {name: value}
        try:
            largest = stiffness_max(replace(free, operator=Operator(**numbers)))
        except ParameterError:
            largest = math.nan
        found.append(Influence(name, value, _percent(largest, most)))
    return tuple(found)


def _percent(value: float, of: float) -> float:
    return 100 * (value / of - 1)


def _signed(percent: float) -> str:
    return f"{percent:+.3g} %".replace("-", "\N{MINUS SIGN}")
