"""Devices that can be simulated: how a force moves them, exactly."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import pi
from typing import Protocol

import numpy as np

from pipeline.loop.plant import Flow, flow
from pipeline.records.batch import Floats
from pipeline.records.loop_parts import LoopParts
from pipeline.records.models import Experiment
from pipeline.simulation.mechanism import Mechanism


class Plant(Protocol):
    """What a device needs to be to be simulated: a state, and its motion under a constant force."""

    @property
    def sensed(self) -> int:
        """Row of the state that the sensor sees: a displacement from the start."""

    def rest(self, command: Floats) -> Floats:
        """Return the state at rest, shape (states, n), where the actuator has long had a command [N, Nm].

        Rows 0 and 1 are displacement from the start and velocity of the side that bears the force.
        """

    def advance(self, state: Floats, command: Floats, push: Floats | float, time_s: float) -> Floats:
        """Return the state after a time [s] under a constant command and a force beside it [N, Nm], shapes (n,)."""


@dataclass(frozen=True)
class MassSpringDamper:
    """Linear device of mass m [kg, kg m^2], viscous damping b and stiffness k; k is relaxed at the start.

    Source: Hulin 2017, eq. 3.3.
    """

    mass: float
    damping: float = 0.0
    stiffness: float = 0.0

    sensed = 0

    def rest(self, command: Floats) -> Floats:
        """Return displacement and velocity of zero, shape (2, n)."""
        return np.zeros((2, len(command)))

    def advance(self, state: Floats, command: Floats, push: Floats | float, time_s: float) -> Floats:
        """Return displacement and velocity after a time under a constant force, exactly."""
        motion = self.motion(time_s)
        acceleration = (command + push) / self.mass
        position, velocity = state
        (xx, xv), (vx, vv) = motion.transition
        return np.stack(
            (
                xx * position + xv * velocity + motion.gain[0] * acceleration,
                vx * position + vv * velocity + motion.gain[1] * acceleration,
            )
        )

    def transition(self, time_s: float) -> tuple[Floats, Floats]:
        """Return the matrix of the state, and what a unit of force adds to it, over a time [s]."""
        motion = self.motion(time_s)
        return motion.transition, motion.gain / self.mass

    def motion(self, time_s: float) -> Flow:
        """Return the exact flow over a time [s] for the input force/m."""
        return _flow(self.stiffness / self.mass, self.damping / self.mass, time_s)


@lru_cache(maxsize=64)
def _flow(gamma: float, delta: float, time_s: float) -> Flow:
    return flow(gamma, delta, time_s)


def plant_of(experiment: Experiment, parts: LoopParts) -> MassSpringDamper | Mechanism:
    """Return the device of an experiment with operator, vibration mode, lag and friction.

    One rigid body without lag and friction keeps its closed form; everything else is a `Mechanism`. Of a mode with
    free-free resonance w, damping ratio z and masses m1 (motor, without operator) and m2, the spring is M w^2 and its
    damping 2 z w M with M = m1 m2/(m1 + m2).
    """
    mass, damping, stiffness = experiment.mass, experiment.damping, experiment.stiffness
    if parts.operator is not None:
        mass, damping = mass + parts.operator.mass, damping + parts.operator.damping
        stiffness += parts.operator.stiffness
    friction = parts.friction if parts.friction is not None and _holds(parts) else None
    if parts.mode is None and parts.actuator_lag_s == 0 and friction is None:
        return MassSpringDamper(mass, damping, stiffness)
    if parts.mode is None:
        return Mechanism(mass, damping, stiffness, lag_s=parts.actuator_lag_s, friction=friction)
    mode = parts.mode
    reduced = (experiment.mass - mode.mass) * mode.mass / experiment.mass
    frequency = 2 * pi * mode.frequency_hz
    return Mechanism(
        mass - mode.mass,
        damping,
        stiffness,
        load_mass=mode.mass,
        spring=reduced * frequency**2,
        spring_damping=2 * mode.damping_ratio * frequency * reduced,
        lag_s=parts.actuator_lag_s,
        friction=friction,
        sensor_at_load=mode.sensor == "load",
    )


def _holds(parts: LoopParts) -> bool:
    """Tell whether there is any friction at all."""
    friction = parts.friction
    return friction is not None and max(friction.coulomb, friction.stiction or 0.0) > 0
