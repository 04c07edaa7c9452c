"""Matrices of the exact motion of a device under constant forces, with vibration mode, actuator lag and friction.

The compiled loops of `pipeline.loop.closed_loop` use them. Without friction, the motion is that of
`pipeline.loop.state_space`, and a time step is one product with its exponential. With friction, the motion is piecewise
linear. The motor rests (stick), creeps below the Stribeck velocity, or slides above it. The time of a region change is
a zero of the exact motion. Between rest and the Stribeck velocity, friction decreases linearly from stiction to Coulomb
friction.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from math import factorial, inf, pi
from typing import TYPE_CHECKING, Self

import numpy as np

from pipeline.loop.closed_loop import CELLS, TERMS, Interval, advance_states
from pipeline.loop.state_space import Plant, StateSpace, plant_of, state_space
from pipeline.records.trials import Floats

if TYPE_CHECKING:  # loading the classes of this module takes longer than a short command
    from pipeline.device.loop import Loop
    from pipeline.device.parts import Friction

BREAKAWAY = 1e-12
"""Excess of a force over stiction, relative to stiction, that sets a resting device in motion. It exceeds rounding
errors."""

LEFT_OUT = 1e-17
"""Largest truncation error of the power series, relative to the motion."""

QUARTER = pi / 4
"""Largest phase [rad] of the fastest oscillation over an interval for which the end points show whether a region is
left."""


@dataclass(frozen=True)
class FrictionalMotion:
    """Exact motion of motor and load under constant forces, with friction on the motor.

    Parameters
    ----------
    plant : Plant
        Linear motion with forces as inputs, in SI. Its spring is relaxed at the initial position.
    friction : Friction or None
        Coulomb friction and stiction [N, Nm] on the motor.

    Notes
    -----
    The state has one row per quantity and one column per trial: displacement [m, rad] and velocity of the motor, those
    of the load, and the force of the actuator. Rates and motions refer to z, which consists of state, command,
    additional force and direction of friction.

    Examples
    --------
    >>> motion = FrictionalMotion(Plant(mass=2.0, damping=0.0, stiffness=0.0))
    >>> motion.advance(motion.rest(np.zeros(1)), np.array([4.0]), 0.0, 1.0).round(12).tolist()
    [[1.0], [2.0]]
    """

    plant: Plant
    friction: Friction | None = None

    @classmethod
    def of(cls, loop: Loop) -> Self:
        """Return the motion of a device with its operator. The inputs are forces after the gain of the loop."""
        friction = loop.friction
        if friction is not None and max(friction.coulomb, friction.stiction or 0.0) == 0:
            friction = None
        return cls(plant_of(replace(loop, force_gain=1.0)), friction)

    @property
    def motor_mass(self) -> float:
        """Mass of the motor and all parts that are rigidly attached to it [kg, kg m^2]."""
        return self.plant.mass - self.plant.load_mass

    @property
    def sensed(self) -> int:
        """Index of the sensed state."""
        return 2 if self.plant.sensor_at_load else 0

    @property
    def states(self) -> int:
        """Number of rows of the state."""
        return _of_motor_and_load(self.plant).states

    def rest(self, command: Floats) -> Floats:
        """Return the state at rest, shape (states, n), with the actuator settled at a command [N, Nm]."""
        return np.outer(_of_motor_and_load(self.plant).at_rest, command)

    def advance(self, state: Floats, command: Floats, push: Floats | float, time_s: float) -> Floats:
        """Return the state after a time [s] under a constant command and an additional force without lag [N, Nm]."""
        n = self.states
        z = np.zeros((state.shape[1], n + 3))
        z[:, :n], z[:, n], z[:, n + 1] = state.T, command, push
        advance_states(z, self.interval(time_s))
        return np.ascontiguousarray(z[:, :n].T)

    def interval(self, time_s: float) -> Interval:
        """Return the data with which compiled loops advance the state by a time [s]."""
        return _interval(self, time_s)

    def rates(self) -> list[Floats]:
        """Return the matrix A of z' = A z for each region. The last row of z is the direction."""
        n, linear = self.states, _of_motor_and_load(self.plant)
        free = np.zeros((n + 3, n + 3))
        free[:n, : n + 2] = np.column_stack((linear.matrix, linear.command, linear.force))
        if self.friction is None:
            return [free]
        coulomb, stiction, slope = self.levels
        stick, creep, slide = free.copy(), free.copy(), free.copy()
        stick[:2] = 0.0
        creep[1, -1] -= stiction / self.motor_mass
        creep[1, 1] += slope / self.motor_mass
        slide[1, -1] -= coulomb / self.motor_mass
        return [stick, creep, slide] if slope else [stick, creep]

    @property
    def levels(self) -> tuple[float, float, float]:
        """Coulomb friction and stiction [N, Nm], and the decrease of friction per speed below the Stribeck velocity."""
        assert self.friction is not None
        stiction = self.friction.coulomb if self.friction.stiction is None else self.friction.stiction
        return self.friction.coulomb, stiction, (stiction - self.friction.coulomb) / self.friction.stribeck_velocity

    def motor_force(self) -> Floats:
        """Return the row that maps z to the force on the motor without friction [N, Nm]."""
        # the force equals the acceleration of a motor of mass 1
        linear = _of_motor_and_load(replace(self.plant, mass=1.0 + self.plant.load_mass))
        return np.concatenate((linear.matrix[1], [linear.command[1], linear.force[1], 0.0]))

    def guards(self) -> list[tuple[Floats, float, float]]:
        """Return a row C and two bounds for each region. Inside the region, C z times the direction is between the
        bounds."""
        assert self.friction is not None
        velocity = np.zeros(self.states + 3)
        velocity[1] = 1.0
        _, stiction, slope = self.levels
        hold, joint = stiction * (1 + BREAKAWAY), self.friction.stribeck_velocity
        stick = self.motor_force(), -hold, hold
        if not slope:
            return [stick, (velocity, 0.0, inf)]
        return [stick, (velocity, 0.0, joint), (velocity, joint, inf)]


@lru_cache(maxsize=64)
def _of_motor_and_load(plant: Plant) -> StateSpace:
    """Return the state space in coordinates of motor and load. (`state_space` uses the centre of mass.)

    The motor is at x_1 = c - (m_2/m_1) y, and the load at x_2 = c + y. Let s = m_2/m be the fraction of the mass that
    belongs to the load. Then c = (1 - s) x_1 + s x_2 and y = (1 - s)(x_2 - x_1).
    """
    linear = state_space(plant)
    if not plant.has_mode:
        return linear
    share, turn, back = plant.load_mass / plant.mass, np.eye(len(linear.matrix)), np.eye(len(linear.matrix))
    turn[:4, :4] = np.kron([[1.0, -share / (1.0 - share)], [1.0, 1.0]], np.eye(2))
    back[:4, :4] = np.kron([[1.0 - share, share], [share - 1.0, 1.0 - share]], np.eye(2))
    return StateSpace(
        matrix=turn @ linear.matrix @ back,
        command=turn @ linear.command,
        force=turn @ linear.force,
        sensor=linear.sensor @ back,
        at_rest=turn @ linear.at_rest,
        mechanical=linear.mechanical,
    )


@lru_cache(maxsize=64)
def _interval(motion: FrictionalMotion, time_s: float) -> Interval:
    from scipy.linalg import expm

    rates, n = motion.rates(), motion.states
    # velocities are scaled by the step time, so that matrix entries have similar sizes
    unit = np.ones(n + 3)
    mechanical = _of_motor_and_load(motion.plant).mechanical
    unit[1:mechanical:2] = time_s
    unit[mechanical : n + 2] = time_s**2 / motion.motor_mass
    unit[-1] = 1.0 if motion.friction is None else time_s**2 * max(motion.levels[1], 1e-300) / motion.motor_mass
    scaled, back = [rate * unit[:, None] / unit * time_s for rate in rates], unit / unit[:, None]
    if motion.friction is None:
        whole = (expm(scaled[0]) * back)[None, :n]
        return whole, np.empty((0,) * 5), np.empty((0,) * 4), np.empty((2, 0)), np.empty(0), time_s, True
    fastest, levels = max(float(np.abs(np.linalg.eigvals(rate[:n, :n]).imag).max()) for rate in scaled), 0
    lasts = [float(np.abs(np.linalg.matrix_power(rate, TERMS)).sum(axis=0).max()) / factorial(TERMS) for rate in scaled]
    while max(lasts) > LEFT_OUT * float(CELLS) ** (TERMS * levels) or fastest > QUARTER * CELLS**levels:
        levels += 1
    guards, ends, grids, series = motion.guards(), [], [], []
    for rate, step, (guard, *_) in zip(rates, scaled, guards, strict=True):
        slope = guard @ rate
        for level in range(1, levels + 1):
            moves = [np.eye(n + 3), *(expm(step * j / CELLS**level) * back for j in range(1, CELLS + 1))]
            grids.append([np.vstack((move[:n], guard @ move, slope @ move)) for move in moves])
        end = expm(step) * back
        ends.append(np.vstack((end[:n], guard, guard @ end, slope, slope @ end)))
        part = step / CELLS**levels
        powers = [np.linalg.matrix_power(part, k) / factorial(k) * back for k in range(TERMS)]
        series.append(np.stack([np.vstack((p[:n], guard @ p)) for p in powers], axis=1))
    by_region = np.array(grids).reshape(len(rates), levels, CELLS + 1, n + 2, n + 3)
    bounds = np.array([between for _, *between in guards]).T
    return (
        np.array(ends),
        np.ascontiguousarray(by_region.swapaxes(0, 1)),
        np.array(series),
        np.ascontiguousarray(bounds),
        motion.motor_force(),
        time_s,
        bool(fastest <= QUARTER),
    )
