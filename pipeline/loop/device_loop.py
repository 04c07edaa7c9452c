"""Loops of devices: from mass, damping, stiffness and parts in SI to the normalised loop.

A gain and an operator change nothing but the mass, damping and stiffness that the wall feels, so they are in the units
(`wall_units`) and leave the loop ideal; filter, lag and mode do not.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from pipeline.base.errors import ParameterError
from pipeline.loop.loop import Loop, Normalised, Vibration
from pipeline.loop.velocity_filter import per_sample

if TYPE_CHECKING:  # its classes take longer to load than a short command to run
    from pipeline.records.loop_parts import LoopParts


def wall_units(mass: float, sampling_period_s: float, parts: LoopParts) -> Normalised:
    """Return the units of a device's wall: its mass with the operator's, per unit of command."""
    held = parts.operator.mass if parts.operator is not None else 0.0
    return Normalised((mass + held) / parts.force_gain, sampling_period_s)


def loop_of(
    mass: float,
    damping: float,
    stiffness: float,
    delay_samples: float,
    sampling_period_s: float,
    parts: LoopParts,
) -> Loop:
    """Return the normalised loop of a device: an ideal one where its parts leave it ideal.

    Parameters
    ----------
    mass, damping, stiffness : float
        Of the device, both sides of a mode together, without operator: m [kg, kg m^2], b [Ns/m, Nms/rad] and
        k [N/m, Nm/rad].
    delay_samples : float
        t_d/T, integer or fractional.
    sampling_period_s : float
        T [s].
    parts : LoopParts
        Friction is no part of a linear loop (`LoopParts.left_out`).

    Raises
    ------
    ParameterError
        If a parameter is out of range, or parts do not fit mass or sampling period.
    """
    mistakes = parts.mistakes(mass, sampling_period_s)
    if mistakes:
        raise ParameterError("; ".join(mistakes))
    operator, mode = parts.operator, parts.mode
    everything = mass
    if operator is not None:
        everything, damping, stiffness = (
            mass + operator.mass,
            damping + operator.damping,
            stiffness + operator.stiffness,
        )
    ideal = Normalised(everything, sampling_period_s).loop(stiffness, damping, delay_samples)
    vibration = None
    if mode is not None:
        # the free-free resonance is that of the device alone, without the operator
        reduced = mode.mass * (mass - mode.mass) / mass / everything
        turn = 2 * math.pi * mode.frequency_hz * sampling_period_s
        vibration = Vibration(
            mode.mass / everything, reduced * turn**2, 2 * mode.damping_ratio * turn * reduced, mode.sensor == "load"
        )
    return Loop(
        ideal.gamma,
        ideal.delta,
        delay_samples,
        parts.actuator_lag_s / sampling_period_s,
        vibration,
        per_sample(parts.velocity, sampling_period_s),
    )
