"""Exact motion of a device with vibration mode, actuator lag and friction, between two changes of its input.

Without friction the whole is one linear system, and a step of time is one product with its exponential. Friction makes
it three: the motor's side rests (stick), creeps below the Stribeck velocity, or slides above it. In each the motion is
linear and exact; the time at which it leaves for another is found on the exact motion, to the last digits. Between
stiction at rest and Coulomb friction at the Stribeck velocity the force falls linearly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from math import ceil, inf, pi

import numpy as np

from pipeline.records.batch import Booleans, Floats, Integers
from pipeline.records.loop_parts import Friction
from pipeline.simulation.crossing import first_exit, powers
from pipeline.simulation.exponential import exponential, series, terms_needed

STICK, CREEP, SLIDE = 0, 1, 2
"""Regions of friction. Without a Stribeck effect there is no `SLIDE`: every motion is a `CREEP` at constant force."""

BREAKAWAY = 1e-12
"""Force beyond stiction, relative to it, that sets a resting device in motion: rounding alone must not."""

MOST_TERMS = 17
"""Terms of a power series over a piece of time; where more are needed the piece is halved first."""

LEFT_OUT = 1e-17
"""Share of a motion that its power series may leave out."""

QUARTER = pi / 4
"""Largest phase [rad] of the fastest oscillation within a piece: an end must not hide two minima before it."""

BLOCK = 64
"""Trials that a matrix product takes together."""

MOST_EVENTS = 64
"""Changes of region within a piece, after which the rest of it passes in the region reached: an end to any chatter."""


@dataclass(frozen=True)
class Mechanism:
    """Motor's side with damper, spring and friction; perhaps a load on a spring, perhaps a lag before the motor.

    Parameters
    ----------
    mass, damping, stiffness : float
        Of the motor's side [kg, Ns/m, N/m or kg m^2, Nms/rad, Nm/rad]; the spring is relaxed at the start.
    load_mass, spring, spring_damping : float
        Far mass and what joins it to the motor's side; no mode where ``load_mass`` is 0.
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
    lag_s: float = 0.0
    friction: Friction | None = None
    sensor_at_load: bool = False

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
        motion, n = _motion(self, time_s), self.states
        z = np.zeros((n + 3, state.shape[1]))
        z[:n], z[n], z[n + 1] = state, command, push
        for _ in range(motion.pieces):
            z[:n] = motion.advance(z)
        return z[:n]

    def transition(self, time_s: float) -> tuple[Floats, Floats]:
        """Return the matrix of the state, and what a unit of command adds to it, over a time [s]; without friction."""
        free, n = replace(self, friction=None), self.states
        if time_s == 0:
            return np.eye(n), np.zeros(n)
        matrix = _motion(free, time_s).steps[0, 0]
        return matrix[:, :n], matrix[:, n]

    def rates(self) -> list[Floats]:
        """Return A of z' = A z in each region, z being the state without the region; the last row is the direction."""
        n = self.states
        free = np.zeros((n + 3, n + 3))
        free[0, 1] = 1.0
        free[1] = self.motor_force() / self.mass
        if self.load_mass > 0:
            free[2, 3] = 1.0
            free[3, :4] = np.array([self.spring, self.spring_damping, -self.spring, -self.spring_damping])
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

    def regions(self, z: Floats) -> Integers:
        """Return the region of friction of each trial, and bring the direction in z up to date."""
        assert self.friction is not None
        velocity = z[1]
        z[-1] = np.where(velocity < 0, -1.0, 1.0)
        region: Integers = (velocity != 0).astype(np.int64)
        if self.levels[2]:
            region += np.abs(velocity) >= self.friction.stribeck_velocity
        return region

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
    """Exact motion of a mechanism over a piece of time, and what is needed to stop it inside.

    ``steps`` (regions, levels, rows, states + 3) moves the state by the piece halved 0, 1, ... times, and gives what
    guards the region, before and after, and its slopes; ``terms`` (regions, rows * terms, states + 3) is the power
    series of state and guard over the last part. ``low`` and ``high`` (regions) bound the guard. ``force`` gives that
    on the motor's side from z.
    """

    mechanism: Mechanism
    pieces: int
    piece_s: float
    steps: Floats
    terms: Floats
    low: Floats
    high: Floats
    force: Floats

    def advance(self, z: Floats) -> Floats:
        """Return the state after a piece of time, shape (states, n)."""
        if self.mechanism.friction is None:
            return _product(self.steps[0, 0], z)
        region = self.mechanism.regions(z)
        ahead, out = self._step(z, region, 0)
        hard = out.nonzero()[0]
        if len(hard):
            ahead[:, hard] = self._with_events(z[:, hard], region[hard])
        return ahead

    def _step(self, z: Floats, region: Integers, level: int) -> tuple[Floats, Booleans]:
        """Return the state after a halved piece, and whether a bound may have been passed on the way."""
        n, span = self.mechanism.states, self.piece_s * 0.5**level
        found = _by_region(self.steps[:, level], z, region)
        before, after, slope, slope_after = found[n:] * z[-1]
        # between its ends a guard that turns is nowhere steeper than at both together
        reach = np.where(slope * slope_after < 0, span * (np.abs(slope) + np.abs(slope_after)), 0.0)
        least, most = np.minimum(before, after) - reach, np.maximum(before, after) + reach
        out: Booleans = (least < self.low[region]) | (most > self.high[region])
        return found[:n], out

    def _with_events(self, z: Floats, region: Integers) -> Floats:
        """Return the state after a piece in which trials may change their region."""
        n, levels = self.mechanism.states, self.steps.shape[1] - 1
        whole = 2.0**levels
        left, busy = np.full(len(region), whole), np.arange(len(region))
        for events in range(MOST_EVENTS + levels):
            here, kind = z[:, busy], region[busy]
            for level in range(1, levels + 1):
                part = whole * 0.5**level
                ahead, out = self._step(here, kind, level)
                fits = (left[busy] >= part) & ~out
                here[:n] = np.where(fits, ahead, here[:n])
                left[busy[fits]] -= part
            span = np.minimum(left[busy], 1.0)
            # a product a trial: one of all of them would round by how many there are
            series = (self.terms[kind] @ here.T[:, :, None]).reshape(len(busy), n + 1, -1)
            time, exits, above = first_exit(series[:, n] * here[-1][:, None], self.low[kind], self.high[kind], span)
            if events >= MOST_EVENTS:
                time, exits = span, np.zeros_like(exits)
            here[:n] = np.vecdot(series[:, :n], powers(time, series.shape[2])[:, None]).T
            left[busy] -= time
            gone = exits.nonzero()[0]
            if len(gone):
                here[:, gone], kind[gone] = self._beyond(here[:, gone], kind[gone], above[gone])
            z[:, busy], region[busy] = here, kind
            busy = (left > 0).nonzero()[0]
            if not len(busy):
                break
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


def _product(matrix: Floats, z: Floats) -> Floats:
    """Return matrix @ z in blocks of one shape: a product of all trials would round by how many there are."""
    blocks = -(-z.shape[1] // BLOCK)
    padded, result = np.zeros((len(z), blocks * BLOCK)), np.empty((len(matrix), blocks * BLOCK))
    padded[:, : z.shape[1]] = z
    one, other = (columns.reshape(-1, blocks, BLOCK).swapaxes(0, 1) for columns in (padded, result))
    np.matmul(matrix, one, out=other)
    return result[:, : z.shape[1]]


def _by_region(matrices: Floats, z: Floats, region: Integers) -> Floats:
    """Return the product of each trial's z with the matrix of its region, shape (rows, n)."""
    result = np.empty((matrices.shape[1], z.shape[1]))
    for number, matrix in enumerate(matrices):
        here = (region == number).nonzero()[0]
        if len(here) == z.shape[1]:
            return _product(matrix, z)
        if len(here):
            result[:, here] = _product(matrix, z[:, here])
    return result


@lru_cache(maxsize=64)
def _motion(mechanism: Mechanism, time_s: float) -> _Motion:
    rates = mechanism.rates()
    n = mechanism.states
    # velocities are counted per the time of the step, so that entries of a matrix are of one size
    unit = np.ones(n + 3)
    unit[1 : 4 if mechanism.load_mass > 0 else 2 : 2] = time_s
    unit[n - 1 if mechanism.lag_s > 0 else n : n + 2] = time_s**2 / mechanism.mass
    unit[-1] = 1.0 if mechanism.friction is None else time_s**2 * max(mechanism.levels[1], 1e-300) / mechanism.mass
    scaled = [rate * unit[:, None] / unit for rate in rates]
    back = unit / unit[:, None]
    fastest = max(float(np.abs(np.linalg.eigvals(rate[:n, :n]).imag).max()) for rate in rates)
    pieces = max(1, ceil(fastest * time_s / QUARTER))
    piece = time_s / pieces
    if mechanism.friction is None:
        whole = (exponential(scaled[0], time_s) * back)[None, None, :n]
        return _Motion(mechanism, 1, time_s, whole, *[np.empty(0)] * 4)
    levels = 0
    while (count := _most_terms(scaled, piece * 0.5**levels)) is None:
        levels += 1
    steps, terms, guards = [], [], mechanism.guards()
    for rate, (guard, _, _), one in zip(rates, guards, scaled, strict=True):
        slope = guard @ rate
        moves = [exponential(one, piece * 0.5**level) * back for level in range(levels + 1)]
        steps.append([np.vstack((m[:n], guard, guard @ m, slope, slope @ m)) for m in moves])
        powers_of = series(one, piece * 0.5**levels, count) * back
        rows = np.concatenate((powers_of[:, :n], (guard @ powers_of)[:, None]), axis=1)
        terms.append(rows.swapaxes(0, 1).reshape(-1, n + 3))
    low, high = np.array([bounds for _, *bounds in guards]).T
    return _Motion(mechanism, pieces, piece, np.array(steps), np.array(terms), low, high, mechanism.motor_force())


def _most_terms(rates: list[Floats], time_s: float) -> int | None:
    needed = [terms_needed(rate, time_s, MOST_TERMS, LEFT_OUT) for rate in rates]
    return None if None in needed else max(count for count in needed if count is not None)
