"""Simulated rigs of the kinds found among public records of real drives: readings with noise and steps of the sensor.

Motion is integrated in small steps with friction as a stiff slope, and knows nothing of the package's own solvers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from pipeline.measured.identification.recordings import Recording
from pipeline.records.trials import Floats

SMALL = 25
"""Integration steps a sample."""


@dataclass(frozen=True)
class Rig:
    """A drive with a motor and perhaps a load: numbers in SI, per unit of command.

    ``cogging`` (relative amplitude, angular frequency along the way) changes the friction by place; ``reading`` and
    ``quantum`` are noise and step of the sensor; ``drift`` is the amplitude of a slow unmodelled force. ``gravity`` is
    the torque of a horizontal arm. The force falls by the share ``curve`` at a command of 1. The drive is ``off``
    for the first rows, and the recorded command has ``command_noise``. A rig that ``slides`` records no angle.
    """

    period: float
    motor: float
    damping: float
    friction: float = 0.0
    spring: float = 0.0
    load: float = 0.0
    coupling: float = 0.0
    coupling_damping: float = 0.0
    load_damping: float = 0.0
    load_friction: float = 0.0
    gains: tuple[float, float] = (1.0, 1.0)
    limit: float = np.inf
    delay: float = 0.0
    cogging: tuple[float, float] = (0.0, 1.0)
    reading: float = 0.0
    quantum: float = 0.0
    drift: float = 0.0
    reads_load: bool = False
    gravity: float = 0.0
    curve: float = 0.0
    off: int = 0
    command_noise: float = 0.0
    slides: bool = False
    truth: dict[str, float] = field(default_factory=dict)

    def log(self, name: str, command: Floats, seed: int = 0) -> Recording:
        """Return the record of a command from rest."""
        rng, T = np.random.default_rng(seed), self.period
        time = np.arange(len(command)) * T
        forced = np.clip(command, -self.limit, self.limit)
        forced = forced * np.where(forced > 0, self.gains[0], self.gains[1])
        forced = forced * (1 - self.curve * forced**2)
        forced[: self.off] = 0.0
        drift = self.drift * np.sin(2 * np.pi * rng.uniform(0.2, 0.6) * time / time[-1] + rng.uniform(0, 6))
        position = _integrated(self, time, forced, drift)
        read = position + self.reading * rng.standard_normal(len(position))
        if self.quantum:
            read = np.round(read / self.quantum) * self.quantum
        command = command + self.command_noise * rng.standard_normal(len(command))
        return Recording(name, time, command, read, T, turns=not self.slides)


def _integrated(rig: Rig, time: Floats, forced: Floats, drift: Floats) -> Floats:
    """Return the sensed positions; both sides stick where friction exceeds all other forces (Karnopp)."""
    h = rig.period / SMALL
    x1 = v1 = x2 = v2 = 0.0
    load, two = rig.load or 1.0, rig.load > 0
    positions = np.empty(len(time))
    late = round(rig.delay / h)
    for k in range(len(time)):
        positions[k] = x2 if rig.reads_load else x1
        for i in range(SMALL):
            at = (k * SMALL + i - late) // SMALL
            u = forced[at] if at >= 0 else forced[0]
            x1, x2 = x1 + 0.5 * h * v1, x2 + 0.5 * h * v2
            pull = rig.coupling * (x1 - x2) + rig.coupling_damping * (v1 - v2) if two else 0.0
            rub = rig.friction * (1 + rig.cogging[0] * np.sin(rig.cogging[1] * x1) ** 2)
            weight = rig.gravity * np.sin(x1)
            v1 = _slid(v1, u + drift[k] - rig.spring * x1 - weight - pull, rig.damping, rub, h / rig.motor)
            if two:
                v2 = _slid(v2, pull, rig.load_damping, rig.load_friction, h / load)
            x1, x2 = x1 + 0.5 * h * v1, x2 + 0.5 * h * v2
    return positions


def _slid(velocity: float, force: float, damping: float, friction: float, step: float) -> float:
    """Return the velocity after a step, by the midpoint rule; friction opposes it and never reverses it."""
    half = 0.5 * damping * step
    free = (velocity * (1 - half) + step * force) / (1 + half)
    rub = step * friction / (1 + half)
    return 0.0 if abs(free) <= rub else free - rub * (1.0 if free > 0 else -1.0)


def square(rng: np.random.Generator, rows: int, half: int, size: float) -> Floats:
    """Return a square wave with half periods of about ``half`` rows, from a few rows of rest."""
    wave = np.zeros(rows)
    at, sign = 10, 1.0
    while at < rows:
        behind = at + int(half * rng.uniform(0.6, 1.4))
        wave[at:behind], at, sign = sign * size, behind, -sign
    return wave


def levels(rng: np.random.Generator, rows: int, hold: int, size: float) -> Floats:
    """Return random levels of both signs, each for some rows."""
    wave = np.repeat(rng.uniform(-size, size, rows // hold + 1), hold)[:rows]
    wave[:10] = 0.0
    return wave


Kind = Callable[[int], tuple[Rig, list[Recording]]]


def _logs(rig: Rig, commands: list[Floats], seed: int) -> tuple[Rig, list[Recording]]:
    return rig, [rig.log(f"run {i}", command, 100 * seed + i) for i, command in enumerate(commands)]


def motor(seed: int) -> tuple[Rig, list[Recording]]:
    """A motor with friction under levels of both signs."""
    rng = np.random.default_rng(seed)
    J, b = 10 ** rng.uniform(-4.5, -2), 0.0
    tau = rng.uniform(0.02, 0.2)
    b, T = J / tau, tau / rng.uniform(15, 40)
    rig = Rig(T, J, b, friction=0.1, delay=rng.uniform(0, 3) * T, quantum=2e-3, truth={"mass": J, "damping": b})
    return _logs(rig, [levels(rng, 1200, 60, 1.0) for _ in range(3)], seed)


def plateau(seed: int) -> tuple[Rig, list[Recording]]:
    """A fast motor whose steps in one direction are mostly a plateau."""
    rng = np.random.default_rng(seed)
    J, tau, T = 0.003, 0.013, 0.002
    rig = Rig(T, J, J / tau, friction=4.0, delay=0.003, quantum=2e-3, truth={"mass": J, "damping": J / tau})
    steps = [np.where(np.arange(1500) < 40, 0.0, size) for size in (20.0, 40.0, 70.0, 100.0)]
    return _logs(rig, [step * rng.uniform(0.9, 1.1) for step in steps], seed)


def by_direction(seed: int) -> tuple[Rig, list[Recording]]:
    """A motor whose drive has two gains."""
    rng = np.random.default_rng(seed)
    J, tau, T = 1e-4, rng.uniform(0.05, 0.5), 1e-3
    gains = rng.uniform(0.5, 1.0), rng.uniform(0.2, 0.45)
    rig = Rig(T, J, J / tau, friction=1e-3, gains=gains, delay=1.5e-3, quantum=1.5e-3)
    rig.truth.update({"positive": J / gains[0], "negative": J / gains[1]})
    size = rng.uniform(0.01, 0.05)
    return _logs(rig, [levels(rng, 2000, 80, size) for _ in range(3)], seed)


def slow(seed: int) -> tuple[Rig, list[Recording]]:
    """A motor with a time constant of hundreds of rows and a ripple of its friction at each turn."""
    rng = np.random.default_rng(seed)
    J, tau, T = 2e-4, rng.uniform(1.0, 2.5), 1e-3
    rig = Rig(T, J, J / tau, friction=0.015, cogging=(0.2, 1.0), quantum=6e-4, truth={"mass": J, "damping": J / tau})
    # the mean friction over a turn
    rig.truth["friction.coulomb"] = 0.015 * 1.1
    return _logs(rig, [square(rng, 6000, 2000, size) for size in rng.uniform(0.02, 0.03, 3)], seed)


def slow_by_direction(seed: int) -> tuple[Rig, list[Recording]]:
    """The same with two gains of its drive; each log has two steps in one direction."""
    rng = np.random.default_rng(seed)
    J, T = 1.2e-4, 1e-3
    gains = rng.uniform(0.6, 0.8), rng.uniform(0.35, 0.45)
    rig = Rig(T, J, 7e-5, friction=0.008, cogging=(0.2, 1.0), gains=gains, quantum=6e-4)
    rig.truth.update({"positive": J / gains[0], "negative": J / gains[1]})
    rows = np.arange(8000)
    steps = [np.where(rows < 4000, 0.035, rng.uniform(0.045, 0.06)) * (1 - 2 * (i % 2)) for i in range(6)]
    return _logs(rig, [np.where(rows < 10, 0.0, step) for step in steps], seed)


def saturated(seed: int) -> tuple[Rig, list[Recording]]:
    """A motor under a ramp beyond the largest force of its drive."""
    rng = np.random.default_rng(seed)
    J, tau, T = 0.003, 0.015, 0.002
    limit = rng.uniform(20, 80)
    rig = Rig(T, J, J / tau, friction=4.0, limit=limit, delay=0.003, quantum=1.5e-3)
    rig.truth.update({"force_limit": limit, "mass": J, "damping": J / tau})
    rows = np.arange(3000)
    ramps = [np.maximum(rows - 300, 0) * limit * over / 2700 for over in rng.uniform(1.6, 4, 2)]
    return _logs(rig, ramps, seed)


def two_carts(
    seed: int,
    *,
    load_friction: bool = False,
    load_damping: bool = True,
    drift: float = 0.0,
    command_noise: float = 0.0,
) -> tuple[Rig, list[Recording]]:
    """Two carts on a soft spring, with friction on the motor, and perhaps on the load and a slow unmodelled force."""
    rng = np.random.default_rng(seed)
    motor_mass, load = rng.uniform(0.4, 0.8), rng.uniform(0.15, 0.5)
    turn = 2 * np.pi * rng.uniform(1.5, 6)
    spring = turn**2 * motor_mass * load / (motor_mass + load)
    b, T = rng.uniform(5, 10), 0.004
    of_load = rng.uniform(0.1, 0.3) * b if load_damping else 0.0
    rig = Rig(
        T,
        motor_mass,
        b - of_load,
        friction=0.5,
        load=load,
        coupling=spring,
        coupling_damping=0.02 * turn * motor_mass * load,
        load_damping=of_load,
        load_friction=0.15 if load_friction else 0.0,
        delay=0.5 * T,
        drift=drift,
        command_noise=command_noise,
        slides=True,
        quantum=5e-6,
    )
    rig.truth.update({"mass": motor_mass + load, "damping": b, "mode.frequency_hz": turn / 2 / np.pi})
    rig.truth.update({"mode.mass": load, "friction.coulomb": 0.5 + rig.load_friction})
    return _logs(rig, [square(rng, 1500, 250, size) for size in (1.5, 2.2)], seed)


def rough(seed: int) -> tuple[Rig, list[Recording]]:
    """A cart on a spring whose friction changes along the way."""
    rng = np.random.default_rng(seed)
    cogging = rng.uniform(3, 10), rng.uniform(100, 600)
    rig = Rig(0.009, 0.4, 0.9, friction=0.18, spring=160.0, cogging=cogging, quantum=5e-6, slides=True)
    rig.truth.update({"mass": 0.4, "stiffness": 160.0, "damping": 0.9})
    return _logs(rig, [levels(rng, 1500, 40, 5.0) for _ in range(2)], seed)


def ground_spring(seed: int) -> tuple[Rig, list[Recording]]:
    """A cart on a spring to ground, with friction."""
    rng = np.random.default_rng(seed)
    mass, turn = rng.uniform(0.3, 1.0), 2 * np.pi * rng.uniform(1.5, 4)
    rig = Rig(0.006, mass, 0.9, friction=0.18, spring=mass * turn**2, quantum=2e-5, reading=1e-5, slides=True)
    rig.truth.update({"mass": mass, "stiffness": mass * turn**2, "damping": 0.9, "friction.coulomb": 0.18})
    return _logs(rig, [square(rng, 1200, 120, size) for size in (2.0, 3.0)], seed)


def drifting(seed: int) -> tuple[Rig, list[Recording]]:
    """A motor with friction and a slow force that no part describes."""
    rng = np.random.default_rng(seed)
    J, tau, T = 2e-3, 0.1, 4e-3
    rig = Rig(T, J, J / tau, friction=0.1, drift=0.06, delay=T, quantum=1e-3, truth={"mass": J, "damping": J / tau})
    return _logs(rig, [levels(rng, 1200, 50, 1.0) for _ in range(3)], seed)


def arm(seed: int) -> tuple[Rig, list[Recording]]:
    """An arm under gravity that swings by up to a radian."""
    rng = np.random.default_rng(seed)
    J, T = rng.uniform(0.05, 0.2), 0.005
    turn = 2 * np.pi * rng.uniform(0.6, 1.2)
    rig = Rig(T, J, 0.6 * J, friction=0.03 * J * turn**2, gravity=J * turn**2, quantum=3e-4, delay=T)
    rig.truth.update({"mass": J, "damping": 0.6 * J, "torque": rig.gravity, "angle": 0.0})
    return _logs(rig, [levels(rng, 1500, 100, size * J * turn**2) for size in (0.4, 0.6)], seed)


def by_size(seed: int) -> tuple[Rig, list[Recording]]:
    """A motor whose force falls with the size of the command; its mass is that of small commands."""
    rng = np.random.default_rng(seed)
    J, tau, T = 1e-3, rng.uniform(0.05, 0.2), 2e-3
    rig = Rig(T, J, J / tau, friction=0.05, curve=rng.uniform(0.05, 0.3), delay=1.3 * T, quantum=1.5e-3)
    rig.truth.update({"mass": J, "damping": J / tau})
    return _logs(rig, [levels(rng, 1500, 60, 1.0) for _ in range(3)], seed)


def measured_command(seed: int) -> tuple[Rig, list[Recording]]:
    """A motor whose measured current, with its noise, is recorded as command."""
    rng = np.random.default_rng(seed)
    J, tau, T = 1e-3, rng.uniform(0.05, 0.2), 2e-3
    rig = Rig(T, J, J / tau, friction=0.08, delay=0.5 * T, quantum=1.5e-3, command_noise=rng.uniform(0.02, 0.1))
    rig.truth.update({"mass": J, "damping": J / tau, "friction.coulomb": 0.08})
    return _logs(rig, [levels(rng, 1500, 60, 1.0) for _ in range(3)], seed)


def switched_on(seed: int) -> tuple[Rig, list[Recording]]:
    """A motor whose drive does not act during the first rows."""
    rng = np.random.default_rng(seed)
    J, tau, T = 1e-3, rng.uniform(0.05, 0.2), 2e-3
    rig = Rig(T, J, J / tau, friction=0.05, off=int(rng.integers(150, 500)), delay=1.3 * T, quantum=1.5e-3)
    rig.truth.update({"mass": J, "damping": J / tau, "friction.coulomb": 0.05})
    return _logs(rig, [levels(rng, 1500, 60, 1.0) for _ in range(3)], seed)


KINDS: dict[str, Kind] = {
    "motor": motor,
    "plateau": plateau,
    "gain by direction": by_direction,
    "slow motor": slow,
    "slow motor by direction": slow_by_direction,
    "saturated": saturated,
    "two carts": lambda seed: two_carts(seed, load_damping=False),
    "load damping": two_carts,
    "load friction": lambda seed: two_carts(seed, load_friction=True),
    "load and drift": lambda seed: two_carts(seed, drift=0.055),
    "measured command of two carts": lambda seed: two_carts(seed, load_friction=True, command_noise=0.04),
    "rough": rough,
    "ground spring": ground_spring,
    "drifting": drifting,
    "arm under gravity": arm,
    "gain by size": by_size,
    "measured command": measured_command,
    "switched on late": switched_on,
}
"""Kinds of rigs, by a seed that chooses their numbers."""
