"""Exact motion of a device under constant forces, with vibration mode, actuator lag and friction: the one stepper.

Without friction the motion is that of `pipeline.loop.state_space`, and a step of time is one product with its
exponential. Friction makes it piecewise linear: the motor rests (stick), creeps below the Stribeck velocity, or slides
above it. The time at which it leaves one region for another is found on the exact motion. Between stiction at rest and
Coulomb friction at the Stribeck velocity the force falls linearly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from math import factorial, inf, pi
from typing import TYPE_CHECKING, Self

import numpy as np
from scipy.linalg import expm

from pipeline.loop.state_space import Plant, StateSpace, plant_of, state_space
from pipeline.records.batch import Booleans, Floats, Integers

if TYPE_CHECKING:  # its classes take longer to load than a short command to run
    from pipeline.device.loop import Loop
    from pipeline.device.parts import Friction

STICK, CREEP, SLIDE = 0, 1, 2
"""Regions of friction. Without a Stribeck effect there is no `SLIDE`: every motion is a `CREEP` at constant force."""

BREAKAWAY = 1e-12
"""Force beyond stiction, relative to it, that sets a resting device in motion: rounding alone must not."""

CELLS = 32
"""Cells of a grid in time on which a change of region is looked for."""

TERMS = 17
"""Terms of the power series within a cell."""

LEFT_OUT = 1e-17
"""Share of a motion that its power series may leave out."""

QUARTER = pi / 4
"""Largest phase [rad] of the fastest oscillation over a time of which the ends alone are looked at."""

BLOCK = 64
"""Trials that a matrix product takes together."""

MOST_EVENTS = 400
"""Changes of region and cells looked into, after which a motion stays in its region: an end to any chatter."""

SETTLED = 2.0**-50
"""Newton's step, relative to a cell, that is rounding."""


@dataclass(frozen=True)
class FrictionalMotion:
    """Exact motion of motor and load under constant forces, with friction on the motor.

    Parameters
    ----------
    plant : Plant
        Linear motion with forces as inputs, in SI; its spring is relaxed at the start.
    friction : Friction or None
        Coulomb friction and stiction [N, Nm] on the motor.

    Notes
    -----
    The state has a row a quantity, a column a trial: displacement [m, rad] and velocity of the motor, then of the load,
    then the actuator's force. Rates and motions are of z: the state, command, force beside it, direction of friction.

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
        """Return the motion of a device with its operator; its inputs are forces, behind the gain of the loop."""
        friction = loop.friction
        if friction is not None and max(friction.coulomb, friction.stiction or 0.0) == 0:
            friction = None
        return cls(plant_of(replace(loop, force_gain=1.0)), friction)

    @property
    def motor_mass(self) -> float:
        """Mass of the motor and all that moves with it rigidly [kg, kg m^2]."""
        return self.plant.mass - self.plant.load_mass

    @property
    def sensed(self) -> int:
        """Row of the state that the sensor sees."""
        return 2 if self.plant.sensor_at_load else 0

    @property
    def states(self) -> int:
        """Number of rows of the state."""
        return _of_motor_and_load(self.plant).states

    def rest(self, command: Floats) -> Floats:
        """Return the state at rest, shape (states, n), where the actuator has long had a command [N, Nm]."""
        return np.outer(_of_motor_and_load(self.plant).at_rest, command)

    def advance(self, state: Floats, command: Floats, push: Floats | float, time_s: float) -> Floats:
        """Return the state after a time [s] under a constant command, and a force beside it without lag [N, Nm]."""
        n = self.states
        z = np.zeros((n + 3, state.shape[1]))
        z[:n], z[n], z[n + 1] = state, command, push
        return _interval(self, time_s).advance(z)

    def rates(self) -> list[Floats]:
        """Return A of z' = A z in each region, z being the state without the region; the last row is the direction."""
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
        """Coulomb friction, stiction [N, Nm] and what friction loses a unit of speed below the Stribeck velocity."""
        assert self.friction is not None
        stiction = self.friction.coulomb if self.friction.stiction is None else self.friction.stiction
        return self.friction.coulomb, stiction, (stiction - self.friction.coulomb) / self.friction.stribeck_velocity

    def motor_force(self) -> Floats:
        """Return the row that gives the force on the motor without friction [N, Nm] from z."""
        # the acceleration of a motor with a mass of 1
        linear = _of_motor_and_load(replace(self.plant, mass=1.0 + self.plant.load_mass))
        return np.concatenate((linear.matrix[1], [linear.command[1], linear.force[1], 0.0]))

    def guards(self) -> list[tuple[Floats, float, float]]:
        """Return for each region a row C and two bounds: C z times the direction lies between them inside."""
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
    """Return the state space with positions and velocities of motor and load, which `state_space` has about the centre.

    The motor is at x_1 = c - (m_2/m_1) y, the load at x_2 = c + y, so that with the load's share s of the mass
    c = (1 - s) x_1 + s x_2 and y = (1 - s)(x_2 - x_1).
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


@dataclass(frozen=True, eq=False)
class _Interval:
    """Exact motion over a time, and what is needed to stop it inside.

    ``whole`` (regions, rows, states + 3) gives the state at its end, then guard and slope of the guard before and
    after. ``grids`` divide it into cells, and a cell of the last one into cells again: state, guard and slope at each
    of their edges, (regions, edges * rows, states + 3). ``series`` is the power series of state and guard in a cell of
    the last. ``low`` and ``high`` (regions) bound the guard; ``force`` gives that on the motor's side from z.
    """

    motion: FrictionalMotion
    whole: Floats
    time_s: float
    slow: bool
    grids: tuple[Floats, ...]
    series: Floats
    low: Floats
    high: Floats
    force: Floats

    def advance(self, z: Floats) -> Floats:
        """Return the state after the time, shape (states, n)."""
        friction, n = self.motion.friction, self.motion.states
        if friction is None:
            return _by_region(self.whole, z, np.zeros(z.shape[1], dtype=np.int64))
        z[-1] = np.where(z[1] < 0, -1.0, 1.0)
        region: Integers = (z[1] != 0).astype(np.int64)
        if len(self.low) > SLIDE:
            region += np.abs(z[1]) >= friction.stribeck_velocity
        end = _by_region(self.whole, z, region)
        before, after, slope, slope_after = end[n:] * z[-1]
        out = self._left(np.stack((before, after)), np.stack((slope, slope_after)), region, self.time_s)[0]
        hard = np.flatnonzero(out if self.slow else np.ones_like(out))
        if len(hard):
            end[:n, hard] = self._with_events(z[:, hard], region[hard])
        return end[:n]

    def _left(self, guard: Floats, slope: Floats, region: Integers, span: float) -> Booleans:
        """Return between which edges (edges - 1, n) a guard may pass a bound, by values and slopes at all edges."""
        # a guard that turns between two edges is nowhere steeper than at both together
        steep = np.abs(slope[:-1]) + np.abs(slope[1:])
        reach = np.where(slope[:-1] * slope[1:] < 0, span * steep, 0.0)
        least, most = np.minimum(guard[:-1], guard[1:]) - reach, np.maximum(guard[:-1], guard[1:]) + reach
        return np.asarray((least < self.low[region]) | (most > self.high[region]))

    def _with_events(self, z: Floats, region: Integers) -> Floats:
        """Return the state after the time of trials that may change their region."""
        n, cell = self.motion.states, 1.0 / CELLS ** len(self.grids)
        left = np.ones(len(region))
        for events in range(MOST_EVENTS + 1):
            busy = np.flatnonzero(left > 0)
            if not len(busy):
                break
            here, kind, rest = z[:, busy], region[busy], left[busy]
            span, columns = 1.0, np.arange(len(busy))
            for grid in self.grids:
                span /= CELLS
                edges = _by_region(grid, here, kind).reshape(CELLS + 1, n + 2, -1)
                guard, slope = (edges[:, n:] * here[-1]).swapaxes(0, 1)
                passed = self._left(guard, slope, kind, self.time_s * span) & (events < MOST_EVENTS)
                first = np.where(passed.any(axis=0), passed.argmax(axis=0), CELLS)
                first = np.minimum(first, np.maximum(np.ceil(rest / span), 1).astype(np.int64) - 1)
                here[:n] = edges[first, :n, columns].T
                rest -= first * span
            series = np.ascontiguousarray(_by_region(self.series, here, kind).T).reshape(len(busy), n + 1, TERMS)
            bounds = (self.low[kind], self.high[kind]) if events < MOST_EVENTS else (rest - inf, rest + inf)
            time, way = _exit(series[:, n] * here[-1][:, None], *bounds, np.minimum(rest / cell, 1.0))
            here[:n] = _value(series[:, :n], time).T
            gone = np.flatnonzero(way)
            here[:, gone], kind[gone] = self._beyond(here[:, gone], kind[gone], way[gone] > 0)
            z[:, busy], region[busy] = here, kind
            left[busy] = np.where(rest - time * cell > SETTLED * cell, rest - time * cell, 0.0)
        return z[:n]

    def _beyond(self, z: Floats, region: Integers, above: Booleans) -> tuple[Floats, Integers]:
        """Return state and region of trials whose guard has reached its lower bound, or its upper one."""
        creeps = region == CREEP
        stops, speeds_up = creeps & ~above, creeps & above
        slow = stops | (region == STICK)
        z[1] = np.where(slow, np.where(stops, 0.0, z[1]), self.high[CREEP] * z[-1])
        force = np.vecdot(z.T, self.force)
        z[-1] = np.where(slow, np.where(force < 0, -1.0, 1.0), z[-1])
        sticks = stops & (np.abs(force) <= self.high[STICK])
        return z, np.where(sticks, STICK, np.where(speeds_up, SLIDE, CREEP))


def _value(series: Floats, time: Floats) -> Floats:
    """Return polynomials, shape (n, ..., terms) with the lowest power first, at a time of each."""
    powers = np.empty((len(time), series.shape[-1]))
    powers[:, 0], powers[:, 1:] = 1.0, time[:, None]
    np.multiply.accumulate(powers, axis=1, out=powers)
    return np.asarray(np.vecdot(series, powers[:, None] if series.ndim > 2 else powers))


def _slopes(series: Floats) -> Floats:
    """Return the derivatives of polynomials, shape (n, terms - 1)."""
    return np.asarray(series[:, 1:] * np.arange(1, series.shape[1]))


def _zero(series: Floats, end: Floats) -> Floats:
    """Return where polynomials, not negative at 0 and negative at an end, become negative for good; shape (n,)."""
    slopes, low, high = _slopes(series), np.zeros_like(end), end
    # from the parabola through value and slope at 0 and value at the end
    first, rate = series[:, 0], series[:, 1] * end
    bend = np.minimum(_value(series, end), 0.0) - first - rate
    divisor = np.sqrt(np.maximum(rate * rate - 4 * bend * first, 0.0)) - rate
    time = end * np.divide(2 * first, divisor, out=np.ones_like(first), where=divisor > 2 * first)
    for _ in range(60):  # bisection alone needs 53 for a double
        value, rate = _value(series, time), _value(slopes, time)
        step = np.divide(value, rate, out=np.full_like(rate, inf), where=rate < 0)
        low, high = np.where(value >= 0, time, low), np.where(value >= 0, high, time)
        settled = (np.abs(step) <= SETTLED) | (high - low <= SETTLED)
        if settled.all():
            break
        ahead = time - step
        ahead = np.where((ahead > low) & (ahead < high), ahead, 0.5 * (low + high))
        time = np.where(settled, time, ahead)
    return time


def _exit(series: Floats, low: Floats, high: Floats, span: Floats) -> tuple[Floats, Integers]:
    """Return when polynomials first leave their bounds within [0, span], and whether downwards (-1) or upwards (1).

    One that does not leave (0) has the span as its time. One that starts on a bound is judged by how it goes on. Within
    the span it may turn once.
    """
    start, slope, slopes, until = series[:, 0], series[:, 1], _slopes(series), span.copy()
    turns = np.flatnonzero(slope * _value(slopes, span) < 0)
    if len(turns):
        turn = _zero(slopes[turns] * np.sign(slope[turns])[:, None], span[turns])
        there = _value(series[turns], turn)
        until[turns] = np.where((there < low[turns]) | (there > high[turns]), turn, span[turns])
    end = _value(series, until)
    below, above = ((start - b) * s > 0 for b, s in ((low, -1), (high, 1)))
    below, above = below | ((start == low) & (slope < 0)), above | ((start == high) & (slope > 0))
    at_once = below | above
    way = np.where(above, 1, np.where(below, -1, np.where(end > high, 1, np.where(end < low, -1, 0))))
    time = np.where(at_once, 0.0, span)
    search = np.flatnonzero((way != 0) & ~at_once)
    if len(search):
        inward = -way[search][:, None] * series[search]
        inward[:, 0] += np.where(way > 0, high, -low)[search]
        time[search] = _zero(inward, until[search])
    return time, way


def _by_region(matrices: Floats, z: Floats, region: Integers) -> Floats:
    """Return the product of each trial's z with the matrix of its region, shape (rows, n).

    It is made in blocks of one shape: a product of all trials would round by how many there are.
    """
    result = np.empty((matrices.shape[1], z.shape[1]))
    for number, matrix in enumerate(matrices):
        here = np.flatnonzero(region == number)
        padded = np.zeros((len(z), -(-len(here) // BLOCK) * BLOCK))
        padded[:, : len(here)] = z[:, here]
        blocks = matrix @ padded.reshape(len(z), -1, BLOCK).swapaxes(0, 1)
        result[:, here] = blocks.swapaxes(0, 1).reshape(len(matrix), -1)[:, : len(here)]
    return result


@lru_cache(maxsize=64)
def _interval(motion: FrictionalMotion, time_s: float) -> _Interval:
    rates, n = motion.rates(), motion.states
    # velocities are counted per the time of the step, so that entries of a matrix are of one size
    unit = np.ones(n + 3)
    mechanical = _of_motor_and_load(motion.plant).mechanical
    unit[1:mechanical:2] = time_s
    unit[mechanical : n + 2] = time_s**2 / motion.motor_mass
    unit[-1] = 1.0 if motion.friction is None else time_s**2 * max(motion.levels[1], 1e-300) / motion.motor_mass
    scaled, back = [rate * unit[:, None] / unit * time_s for rate in rates], unit / unit[:, None]
    if motion.friction is None:
        return _Interval(motion, (expm(scaled[0]) * back)[None, :n], time_s, True, (), *[np.empty(0)] * 4)
    fastest, levels = max(float(np.abs(np.linalg.eigvals(rate[:n, :n]).imag).max()) for rate in scaled), 0
    lasts = [float(np.abs(np.linalg.matrix_power(rate, TERMS)).sum(axis=0).max()) / factorial(TERMS) for rate in scaled]
    while max(lasts) > LEFT_OUT * float(CELLS) ** (TERMS * levels) or fastest > QUARTER * CELLS**levels:
        levels += 1
    guards, whole, series = motion.guards(), [], []
    grids: list[list[Floats]] = [[] for _ in range(levels)]
    for rate, step, (guard, _, _) in zip(rates, scaled, guards, strict=True):
        slope = guard @ rate
        for level, grid in enumerate(grids, start=1):
            moves = [np.eye(n + 3), *(expm(step * j / CELLS**level) * back for j in range(1, CELLS + 1))]
            grid.append(np.concatenate([np.vstack((m[:n], guard @ m, slope @ m)) for m in moves]))
        end = expm(step) * back
        whole.append(np.vstack((end[:n], guard, guard @ end, slope, slope @ end)))
        part = step / CELLS**levels
        powers = [np.linalg.matrix_power(part, k) / factorial(k) * back for k in range(TERMS)]
        series.append(np.stack([np.vstack((p[:n], guard @ p)) for p in powers], axis=1).reshape(-1, n + 3))
    low, high = np.array([bounds for _, *bounds in guards]).T
    ways = tuple(np.array(grid) for grid in grids)
    ends = low, high, motion.motor_force()
    return _Interval(motion, np.array(whole), time_s, fastest <= QUARTER, ways, np.array(series), *ends)
