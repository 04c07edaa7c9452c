"""Express the linear motion of a device as a state space.

Only this module turns the mechanics of a loop into matrices. Theory, estimators, simulator and checks use
`state_space`.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import TYPE_CHECKING

import numpy as np

from pipeline.records.trials import Floats

if TYPE_CHECKING:  # loading the classes of this module takes longer than a short command
    from pipeline.device.loop import Loop

LEAST_RATIO = 1e-12
"""Damping ratio that is assumed for an undamped mode. Without loss, the zeros of the device are on the unit circle, and
doubles cannot separate the crossings next to them. The assumption changes a limit by less than a relative 1e-9, and a
pole by less than its rounding error."""


@dataclass(frozen=True)
class Plant:
    """Parameters of a linear motion in consistent units: SI, or units in which mass and sampling period are 1.

    The parameters are not checked. They may be negative in a search, and complex for derivatives.

    Parameters
    ----------
    mass, damping, stiffness : float
        Parameters m, b and k of the total device, per unit of command if the input is a command.
    lag : float
        Time constant of the actuator, or 0 for no lag.
    load_mass, load_damping : float
        Mass and damping of the load of a vibration mode, which are included in ``mass`` and ``damping``. There is no
        mode if ``load_mass`` is 0.
    spring, spring_damping : float
        Stiffness and damping between load and motor.
    sensor_at_load : bool
        Whether the sensor reads the position of the load instead of the position of the motor.
    """

    mass: float
    damping: float
    stiffness: float
    lag: float = 0.0
    load_mass: float = 0.0
    load_damping: float = 0.0
    spring: float = 0.0
    spring_damping: float = 0.0
    sensor_at_load: bool = False

    @property
    def has_mode(self) -> bool:
        """Whether the plant has a load on a spring."""
        return self.load_mass != 0


def plant_of(loop: Loop) -> Plant:
    """Return the linear motion of a device at the wall, including the operator, per unit of command.

    For a mode with free-free resonance w, damping ratio z, and masses m_1 (motor) and m_2 (load), the spring is M w^2
    and its damping is 2 z w M, with the reduced mass M = m_1 m_2/(m_1 + m_2). Friction is not included.
    """
    device = loop.apparent()
    mode = device.mode
    if mode is None:
        return Plant(device.mass, device.damping, device.stiffness, device.actuator_lag_s)
    turn, reduced = 2 * pi * mode.frequency_hz, mode.mass * (device.mass - mode.mass) / device.mass
    return Plant(
        device.mass,
        device.damping,
        device.stiffness,
        device.actuator_lag_s,
        mode.mass,
        mode.load_damping,
        reduced * turn**2,
        2 * max(mode.damping_ratio, LEAST_RATIO) * turn * reduced,
        mode.sensor == "load",
    )


@dataclass(frozen=True, eq=False)
class StateSpace:
    """State space x' = matrix x + command u + force f, position = sensor x, with delayed command u and motor force f.

    The states are position and velocity of the centre of mass. With a mode, the next states are the distance of the
    load from the centre of mass and the rate of this distance. With a lag, the last state is the force of the actuator.

    Parameters
    ----------
    matrix : ndarray, shape (n, n)
    command, force : ndarray, shape (n,)
        Input columns of the command and of a force on the motor. The command acts through the actuator.
    sensor : ndarray, shape (n,)
        Output row of the sensed position.
    at_rest : ndarray, shape (n,)
        State per unit of a constant actuator force if the device cannot move.
    mechanical : int
        Number of states of the mechanics, which come first. The other states are those of the actuator.
    """

    matrix: Floats
    command: Floats
    force: Floats
    sensor: Floats
    at_rest: Floats
    mechanical: int

    @property
    def states(self) -> int:
        """Number of states."""
        return len(self.sensor)

    @property
    def actuator(self) -> tuple[Floats, Floats, Floats]:
        """Matrices A, B, C of the actuator, x' = A x + B u, f = C x, from command u to force f. An ideal one has no
        states."""
        first = self.mechanical
        inner = self.matrix[first:, first:]
        return inner, self.command[first:], np.eye(1, len(inner))[0]

    @property
    def mean_lag(self) -> float:
        """Delay that the actuator adds to a slow command, C A^-2 B. For a first-order lag, it is the time constant."""
        A, B, C = self.actuator
        return float(C @ np.linalg.solve(A, np.linalg.solve(A, B))) if len(A) else 0.0


def state_space(plant: Plant) -> StateSpace:
    """Return the state space of a linear motion.

    Parameters
    ----------
    plant : Plant
        Real or complex parameters. An imaginary part of 1e-20 gives a derivative (Squire and Trapp 1998).

    Returns
    -------
    StateSpace
        State space in the units of the plant.

    Notes
    -----
    Coordinates are relative to the centre of mass. A unit impulse on the motor then changes each velocity by 1/m, even
    if the motor is light. With the motor at x_c - (m_2/m_1) y and the load at x_c + y, m x_c'' = f - k x_1 - (b - b_l)
    x_1' - b_l x_2'.

    Examples
    --------
    >>> system = state_space(Plant(mass=2.0, damping=4.0, stiffness=0.0))
    >>> system.matrix.tolist(), system.command.tolist()
    ([[0.0, 1.0], [-0.0, -2.0]], [0.0, 0.5])
    """
    mass, count = plant.mass, 4 if plant.has_mode else 2
    load = plant.load_mass / mass
    near = 1.0 - load
    motor = (1.0, -load / near)[: count // 2]
    spring, damper = -plant.stiffness / mass, -(plant.damping - plant.load_damping) / mass
    numbers = (spring, damper, load, plant.load_damping, plant.spring, plant.spring_damping)
    kind = complex if any(isinstance(each, complex) for each in numbers) else float
    matrix, force, sensor = np.zeros((count, count), kind), np.zeros(count), np.zeros(count, kind)
    matrix[0, 1], force[1] = 1.0, 1 / mass
    for place, share in enumerate(motor):
        sensor[2 * place] = share
        matrix[1, 2 * place], matrix[1, 2 * place + 1] = share * spring, share * damper
    if plant.has_mode:
        matrix[2, 3], force[3] = 1.0, -1 / mass
        matrix[3] = -matrix[1]
        matrix[3, 2] -= plant.spring / mass * (1 / load + 1 / near)
        matrix[3, 3] -= plant.spring_damping / mass * (1 / load + 1 / near)
        for row, share in ((1, 1.0), (3, near / load)):
            matrix[row, 1::2] -= share * plant.load_damping / mass
        if plant.sensor_at_load:
            sensor[2] = 1.0
    mechanics = StateSpace(matrix, force, force, sensor, np.zeros(count), count)
    return mechanics if plant.lag == 0 else _behind_lag(mechanics, plant.lag)


def _behind_lag(system: StateSpace, lag: float) -> StateSpace:
    """Return a system with a first-order lag in front of its command."""
    n = system.states
    matrix = np.zeros((n + 1, n + 1), np.result_type(system.matrix, np.asarray(lag)))
    matrix[:n, :n], matrix[:n, n], matrix[n, n] = system.matrix, system.command, -1 / lag
    return StateSpace(
        matrix,
        np.append(np.zeros(n), 1 / lag),
        np.append(system.force, 0.0),
        np.append(system.sensor, 0.0),
        np.append(system.at_rest, 1.0),
        system.mechanical,
    )
