"""Exact motion of a device under constant forces, with vibration mode, actuator lag and friction: the one stepper.

Without friction the motion is linear, and a step of time is one product with its exponential. Friction makes it
piecewise linear: the motor's side rests (stick), creeps below the Stribeck velocity, or slides above it. The time at
which it leaves one region for another is found on the exact motion. Between stiction at rest and Coulomb friction at
the Stribeck velocity the force falls linearly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from math import factorial, inf, pi

import numpy as np
from scipy.linalg import expm

from pipeline.device.parts import Friction, LoopParts
from pipeline.records.batch import Booleans, Floats, Integers

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
class Mechanism:
    """Motor's side with damper, spring and friction; perhaps a load on a spring, perhaps a lag before the motor.

    Parameters
    ----------
    mass, damping, stiffness : float
        Of the motor's side [kg, Ns/m, N/m or kg m^2, Nms/rad, Nm/rad]; the spring is relaxed at the start.
    load_mass, spring, spring_damping, load_damping : float
        Far mass, what joins it to the motor's side, and its own damper; no mode where ``load_mass`` is 0.
    lag_s : float
        Time constant of the actuator [s].
    friction : Friction or None
    sensor_at_load : bool
        Whether the load's displacement is sensed.

    Notes
    -----
    The state has a row a quantity, a column a trial: displacement and velocity of the motor, then of the load, then the
    force behind the lag. Rates and motions are of z: the state, command, force beside it, direction of friction.
    """

    mass: float
    damping: float = 0.0
    stiffness: float = 0.0
    load_mass: float = 0.0
    spring: float = 0.0
    spring_damping: float = 0.0
    load_damping: float = 0.0
    lag_s: float = 0.0
    friction: Friction | None = None
    sensor_at_load: bool = False

    @classmethod
    def of(cls, mass: float, damping: float, stiffness: float, parts: LoopParts) -> Mechanism:
        """Return a device with operator, vibration mode, lag and friction; mass, damping, stiffness are its own.

        Of a mode with free-free resonance w, damping ratio z and masses m1 (motor, without operator) and m2, the spring
        is M w^2 and its damping 2 z w M with M = m1 m2/(m1 + m2); the load's own damping is part of the device's.
        """
        motor, friction = mass, parts.friction
        if parts.operator is not None:
            motor, damping = mass + parts.operator.mass, damping + parts.operator.damping
            stiffness += parts.operator.stiffness
        if friction is not None and max(friction.coulomb, friction.stiction or 0.0) == 0:
            friction = None
        device = cls(motor, damping, stiffness, lag_s=parts.actuator_lag_s, friction=friction)
        if parts.mode is None:
            return device
        mode, frequency = parts.mode, 2 * pi * parts.mode.frequency_hz
        reduced = (mass - mode.mass) * mode.mass / mass
        return replace(
            device,
            mass=motor - mode.mass,
            damping=damping - mode.load_damping,
            load_damping=mode.load_damping,
            load_mass=mode.mass,
            spring=reduced * frequency**2,
            spring_damping=2 * mode.damping_ratio * frequency * reduced,
            sensor_at_load=mode.sensor == "load",
        )

    @property
    def sensed(self) -> int:
        """Row of the state that the sensor sees."""
        return 2 if self.sensor_at_load else 0

    @property
    def states(self) -> int:
        """Number of rows of the state."""
        return 2 + 2 * (self.load_mass > 0) + (self.lag_s > 0)

    def rest(self, command: Floats) -> Floats:
        """Return the state at rest, shape (states, n), where the actuator has long had a command [N, Nm]."""
        state = np.zeros((self.states, len(command)))
        if self.lag_s > 0:
            state[-1] = command
        return state

    def advance(self, state: Floats, command: Floats, push: Floats | float, time_s: float) -> Floats:
        """Return the state after a time [s] under a constant command, and a force beside it without lag [N, Nm]."""
        n = self.states
        z = np.zeros((n + 3, state.shape[1]))
        z[:n], z[n], z[n + 1] = state, command, push
        return _motion(self, time_s).advance(z)

    def rates(self) -> list[Floats]:
        """Return A of z' = A z in each region, z being the state without the region; the last row is the direction."""
        n = self.states
        free = np.zeros((n + 3, n + 3))
        free[0, 1] = 1.0
        free[1] = self.motor_force() / self.mass
        if self.load_mass > 0:
            free[2, 3] = 1.0
            free[3, :4] = self.spring, self.spring_damping, -self.spring, -self.spring_damping - self.load_damping
            free[3] /= self.load_mass
        if self.lag_s > 0:
            free[n - 1, n - 1], free[n - 1, n] = -1 / self.lag_s, 1 / self.lag_s
        if self.friction is None:
            return [free]
        coulomb, stiction, slope = self.levels
        stick, creep, slide = free.copy(), free.copy(), free.copy()
        stick[:2] = 0.0
        creep[1, -1] -= stiction / self.mass
        creep[1, 1] += slope / self.mass
        slide[1, -1] -= coulomb / self.mass
        return [stick, creep, slide] if slope else [stick, creep]

    @property
    def levels(self) -> tuple[float, float, float]:
        """Coulomb friction, stiction [N, Nm] and what friction loses a unit of speed below the Stribeck velocity."""
        assert self.friction is not None
        stiction = self.friction.coulomb if self.friction.stiction is None else self.friction.stiction
        return self.friction.coulomb, stiction, (stiction - self.friction.coulomb) / self.friction.stribeck_velocity

    def motor_force(self) -> Floats:
        """Return the row that gives the force on the motor's side without friction [N, Nm] from z."""
        n = self.states
        row = np.zeros(n + 3)
        row[0], row[1] = -self.stiffness - self.spring, -self.damping - self.spring_damping
        if self.load_mass > 0:
            row[2], row[3] = self.spring, self.spring_damping
        row[n - 1 if self.lag_s > 0 else n] += 1.0
        row[n + 1] += 1.0
        return row

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


@dataclass(frozen=True, eq=False)
class _Motion:
    """Exact motion of a mechanism over a time, and what is needed to stop it inside.

    ``whole`` (regions, rows, states + 3) gives the state at its end, then guard and slope of the guard before and
    after. ``grids`` divide it into cells, and a cell of the last one into cells again: state, guard and slope at each
    of their edges, (regions, edges * rows, states + 3). ``series`` is the power series of state and guard in a cell of
    the last. ``low`` and ``high`` (regions) bound the guard; ``force`` gives that on the motor's side from z.
    """

    mechanism: Mechanism
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
        friction, n = self.mechanism.friction, self.mechanism.states
        if friction is None:
            return _by_region(self.whole, z, np.zeros(z.shape[1], dtype=np.int64))
        z[-1] = np.where(z[1] < 0, -1.0, 1.0)
        region: Integers = (z[1] != 0).astype(np.int64)
        if len(self.low) > SLIDE:
            region += np.abs(z[1]) >= friction.stribeck_velocity
        found = _by_region(self.whole, z, region)
        before, after, slope, slope_after = found[n:] * z[-1]
        out = self._left(np.stack((before, after)), np.stack((slope, slope_after)), region, self.time_s)[0]
        hard = np.flatnonzero(out if self.slow else np.ones_like(out))
        if len(hard):
            found[:n, hard] = self._with_events(z[:, hard], region[hard])
        return found[:n]

    def _left(self, guard: Floats, slope: Floats, region: Integers, span: float) -> Booleans:
        """Return between which edges (edges - 1, n) a guard may pass a bound, by values and slopes at all edges."""
        # a guard that turns between two edges is nowhere steeper than at both together
        steep = np.abs(slope[:-1]) + np.abs(slope[1:])
        reach = np.where(slope[:-1] * slope[1:] < 0, span * steep, 0.0)
        least, most = np.minimum(guard[:-1], guard[1:]) - reach, np.maximum(guard[:-1], guard[1:]) + reach
        return np.asarray((least < self.low[region]) | (most > self.high[region]))

    def _with_events(self, z: Floats, region: Integers) -> Floats:
        """Return the state after the time of trials that may change their region."""
        n, cell = self.mechanism.states, 1.0 / CELLS ** len(self.grids)
        left = np.ones(len(region))
        for events in range(MOST_EVENTS + 1):
            busy = np.flatnonzero(left > 0)
            if not len(busy):
                break
            here, kind, rest = z[:, busy], region[busy], left[busy]
            span, columns = 1.0, np.arange(len(busy))
            for grid in self.grids:
                span /= CELLS
                found = _by_region(grid, here, kind).reshape(CELLS + 1, n + 2, -1)
                guard, slope = (found[:, n:] * here[-1]).swapaxes(0, 1)
                passed = self._left(guard, slope, kind, self.time_s * span) & (events < MOST_EVENTS)
                first = np.where(passed.any(axis=0), passed.argmax(axis=0), CELLS)
                first = np.minimum(first, np.maximum(np.ceil(rest / span), 1).astype(np.int64) - 1)
                here[:n] = found[first, :n, columns].T
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
        held = stops & (np.abs(force) <= self.high[STICK])
        return z, np.where(held, STICK, np.where(speeds_up, SLIDE, CREEP))


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
        found, rate = _value(series, time), _value(slopes, time)
        step = np.divide(found, rate, out=np.full_like(rate, inf), where=rate < 0)
        low, high = np.where(found >= 0, time, low), np.where(found >= 0, high, time)
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
def _motion(mechanism: Mechanism, time_s: float) -> _Motion:
    rates, n = mechanism.rates(), mechanism.states
    # velocities are counted per the time of the step, so that entries of a matrix are of one size
    unit = np.ones(n + 3)
    unit[1 : 4 if mechanism.load_mass > 0 else 2 : 2] = time_s
    unit[n - 1 if mechanism.lag_s > 0 else n : n + 2] = time_s**2 / mechanism.mass
    unit[-1] = 1.0 if mechanism.friction is None else time_s**2 * max(mechanism.levels[1], 1e-300) / mechanism.mass
    scaled, back = [rate * unit[:, None] / unit * time_s for rate in rates], unit / unit[:, None]
    if mechanism.friction is None:
        return _Motion(mechanism, (expm(scaled[0]) * back)[None, :n], time_s, True, (), *[np.empty(0)] * 4)
    fastest, levels = max(float(np.abs(np.linalg.eigvals(one[:n, :n]).imag).max()) for one in scaled), 0
    lasts = [float(np.abs(np.linalg.matrix_power(one, TERMS)).sum(axis=0).max()) / factorial(TERMS) for one in scaled]
    while max(lasts) > LEFT_OUT * float(CELLS) ** (TERMS * levels) or fastest > QUARTER * CELLS**levels:
        levels += 1
    guards, whole, series = mechanism.guards(), [], []
    grids: list[list[Floats]] = [[] for _ in range(levels)]
    for rate, one, (guard, _, _) in zip(rates, scaled, guards, strict=True):
        slope = guard @ rate
        for level, grid in enumerate(grids, start=1):
            moves = [np.eye(n + 3), *(expm(one * j / CELLS**level) * back for j in range(1, CELLS + 1))]
            grid.append(np.concatenate([np.vstack((m[:n], guard @ m, slope @ m)) for m in moves]))
        end = expm(one) * back
        whole.append(np.vstack((end[:n], guard, guard @ end, slope, slope @ end)))
        part = one / CELLS**levels
        powers = [np.linalg.matrix_power(part, k) / factorial(k) * back for k in range(TERMS)]
        series.append(np.stack([np.vstack((p[:n], guard @ p)) for p in powers], axis=1).reshape(-1, n + 3))
    low, high = np.array([bounds for _, *bounds in guards]).T
    ways = tuple(np.array(grid) for grid in grids)
    ends = low, high, mechanism.motor_force()
    return _Motion(mechanism, np.array(whole), time_s, fastest <= QUARTER, ways, np.array(series), *ends)
