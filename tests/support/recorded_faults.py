"""Simulated logs with and without a fault of their recording; as a script it prints how many of each are found.

    python tests/support/recorded_faults.py 60 600 30000

The devices have what the checks do not model: two masses on a spring, friction, a lag, delays of any length, noise and
sensors of any step. A log is a `Samples`; its faults have random size and place.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from any_experiment import Rig, Trial, recorded
from numpy.typing import NDArray

from pipeline.recording.check import check_recording
from pipeline.recording.samples import Samples
from pipeline.recording.wrapping import unwrapped

Random = np.random.Generator
Commands = Callable[[Random, str, int, int, float], NDArray[np.float64]]
FINE = 20
"""Fine steps of a sampling period."""


@dataclass(frozen=True, eq=False)
class Recorded:
    """A log, the delay of its device [rows], and its position without noise and steps of the sensor."""

    samples: Samples
    delay: float
    exact: NDArray[np.float64]


def command_of(rng: Random, kind: str, rows: int, rest: int, period: float) -> NDArray[np.float64]:
    """Return a command of a size of 1 that begins at a row."""
    k = np.arange(rows) - rest
    if kind == "square":
        command = np.where((k // int(rng.integers(60, 400))) % 2 == 0, 1.0, -rng.choice([1.0, 0.5]))
    elif kind == "pulse":
        command = np.where(k < int(rng.integers(40, 150)), 1.0, 0.0)
    elif kind == "prbs":
        signs = rng.choice([-1.0, 1.0], size=rows)
        command = signs[np.clip(k // int(rng.integers(3, 25)), 0, None)]
    elif kind == "steps":
        levels = rng.uniform(-1, 1, size=rows)
        command = levels[np.clip(k // int(rng.integers(80, 250)), 0, None)]
    elif kind == "chirp":
        t = k * period
        command = np.sin(2 * np.pi * (t + 0.5 * rng.uniform(5, 30) / (rows * period) * t**2))
    else:
        tones = zip(rng.uniform(0.5, 20, 4), rng.uniform(0, 6, 4), strict=True)
        command = sum(np.sin(2 * np.pi * f * k * period + phase) for f, phase in tones) / 2
    return np.where(k >= 0, command, 0.0)


def free(rng: Random, kind: str = "", command_of: Commands = command_of) -> Recorded:
    """Return a log of a device without a wall."""
    period, mass = float(rng.choice([1e-3, 5e-4, 2e-3])), 10 ** rng.uniform(-2.5, 0.5)
    rows, rest = int(rng.integers(300, 1500)), int(rng.integers(10, 80))
    kind = kind or str(rng.choice(["square", "chirp", "prbs", "pulse", "multisine", "steps"]))
    size = mass * rng.uniform(2, 40)
    command = size * command_of(rng, kind, rows, rest, period)
    damping = mass * rng.uniform(0.5, 15)
    friction = size * rng.uniform(0.02, 0.25) * (rng.random() < 0.4)
    share = rng.uniform(0.1, 0.5) * (rng.random() < 0.35)
    spring = (2 * np.pi * rng.uniform(8, 120)) ** 2 * mass * share * (1 - share)
    damper = 2 * rng.uniform(0.01, 0.1) * np.sqrt(spring * mass * share * (1 - share))
    at_load = bool(share) and rng.random() < 0.3
    lag, delay = float(rng.choice([0, 0, rng.uniform(1, 8)])), rng.uniform(0, 6)
    x = moved(command, period, (mass * (1 - share), mass * share), (damping, friction), (spring, damper), (lag, delay))
    exact = x[int(at_load)]
    reach = float(np.ptp(exact)) or 1.0
    noise, step = (reach * float(rng.choice([0, least, 10 * least, 1e-4])) for least in (1e-6, 1e-5))
    position = exact + noise * rng.standard_normal(rows)
    position = np.round(position / step) * step if step else position
    return Recorded(Samples(period * np.arange(rows), command, position, period), delay + lag, exact)


def moved(
    command: NDArray[np.float64],
    period: float,
    masses: tuple[float, float],
    drag: tuple[float, float],
    joint: tuple[float, float],
    late: tuple[float, float],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the positions of motor and load under a command, in small steps of time."""
    (m1, m2), (b, c), (k, d) = masses, drag, joint
    lag, shift, h = late[0] * period, round(late[1] * FINE), period / FINE
    follows = 1 - np.exp(-h / lag) if lag else 1.0
    x1 = v1 = x2 = v2 = force = 0.0
    first, second = np.zeros(len(command)), np.zeros(len(command))
    commands = command.tolist()
    for row in range(len(command)):
        first[row], second[row] = x1, x2
        for fine in range(FINE):
            at = row * FINE + fine - shift
            force += follows * ((commands[at // FINE] if at >= 0 else 0.0) - force)
            joint_force = k * (x1 - x2) + d * (v1 - v2)
            net = force - b * v1 - joint_force
            way = 1.0 if v1 > 0 or (v1 == 0 and net > 0) else -1.0
            sticks = c > 0 and v1 == 0 and abs(net) <= c
            a = 0.0 if sticks else (net - way * c) / m1
            v1 = 0.0 if c > 0 and v1 != 0 and (v1 + h * a) * v1 < 0 else v1 + h * a
            x1 += h * v1
            if m2:
                v2 += h * joint_force / m2
                x2 += h * v2
    return first, second


def wall(rng: Random) -> Recorded:
    """Return a step response behind a wall, stable or not."""
    mass, period = 10 ** rng.uniform(-1.5, 0.7), float(rng.choice([1e-3, 5e-4]))
    rig = Rig(
        mass=mass,
        damping=mass * rng.uniform(1, 8),
        friction=float(rng.choice([0, 0, 1.0]) * rng.uniform(0.02, 0.4)),
        period=period,
        delay=float(round(rng.uniform(0, 6) * FINE) / FINE),
        jitter=int(rng.choice([0, 0, 0, 1])),
        resolution=float(rng.choice([0, 1e-6, 1e-5])),
        noise=float(rng.choice([0, 1e-6])),
    )
    B = rng.uniform(0, 0.3) * mass / period / (1 + rig.delay)
    K = rng.uniform(0.02, 0.8) * (B + rig.damping) / period / (0.5 + rig.delay)
    trial = Trial(
        K, B, float(rng.choice([1.0, 2.0, 4.0, -2.0])), rows=int(rng.integers(120, 400)), edge=int(rng.integers(10, 40))
    )
    time, command, position = recorded(rig, trial, int(rng.integers(1 << 30)))
    return Recorded(Samples(time, command, position, period, K, B, trial.step), rig.delay, position)


Fault = Callable[[Random, Recorded], "Samples | None"]
"""Makes a log with a fault; None where it would not be seen in this one."""


def other_period(rng: Random, log: Recorded) -> Samples | None:
    factor = float(rng.choice([0.125, 0.25, 0.5, 2, 3, 4, rng.uniform(0.3, 0.9), rng.uniform(1.1, 3)]))
    return replace(log.samples, period=log.samples.period * factor)


def late_command(rng: Random, log: Recorded) -> Samples | None:
    rows, command = int(np.ceil(log.delay)) + int(rng.integers(2, 25)), log.samples.command
    return replace(log.samples, command=np.concatenate([np.full(rows, command[0]), command[:-rows]]))


def zero_phase(rng: Random, log: Recorded) -> Samples | None:
    from scipy.signal import butter, filtfilt

    width = log.delay * rng.uniform(1, 3) + 2
    return replace(log.samples, position=filtfilt(*butter(2, 1 / (np.pi * width)), log.samples.position))


def joined_command(rng: Random, log: Recorded) -> Samples | None:
    rows = np.arange(len(log.samples))
    knots = rows[:: int(rng.integers(3, 40))]
    return replace(log.samples, command=np.interp(rows, knots, log.samples.command[knots]))


def sent_ramps(rng: Random) -> Recorded:
    """Return a log without a fault: its command was sent as ramps of a grid."""

    def ramps(rng: Random, kind: str, rows: int, rest: int, period: float) -> NDArray[np.float64]:
        steps, k = command_of(rng, kind, rows, rest, period), np.arange(rows)
        knots = k[:: int(rng.integers(3, 40))]
        return np.asarray(np.interp(k, knots, steps[knots]))

    return free(rng, str(rng.choice(["square", "steps", "pulse"])), ramps)


def filtered_once(rng: Random, log: Recorded) -> Samples:
    """Return a log without a fault whose position went through a filter of one direction."""
    from scipy.signal import butter, lfilter

    width, x = np.exp(rng.uniform(0, 3)), log.samples.position
    filtered = x[0] + lfilter(*butter(int(rng.integers(1, 5)), 1 / (np.pi * width)), x - x[0])
    return replace(log.samples, position=filtered)


def joined_position(rng: Random, log: Recorded) -> Samples | None:
    rows = np.arange(len(log.samples))
    knots = rows[:: int(rng.integers(2, 12))]
    return replace(log.samples, position=np.interp(rows, knots, log.samples.position[knots]))


def other_sign(rng: Random, log: Recorded) -> Samples | None:
    return replace(log.samples, position=-log.samples.position) if log.samples.range else None


def frozen(rng: Random, log: Recorded) -> Samples | None:
    position, speed = log.samples.position.copy(), np.abs(np.diff(log.exact))
    fast = np.flatnonzero(speed > 0.5 * speed.max())
    fast = fast[(fast > 5) & (fast < len(position) - 70)]
    if not len(fast):
        return None
    first, rows = int(rng.choice(fast)), int(rng.integers(12, 40))
    missed = abs(position[first + rows] - position[first])
    position[first : first + rows] = position[first]
    return None if missed < 0.05 * np.ptp(position) else replace(log.samples, position=position)


def repeated(rng: Random, log: Recorded) -> Samples | None:
    samples = log.samples
    rows = np.flatnonzero(rng.random(len(samples)) < rng.uniform(0.02, 0.1))
    rows = rows[(rows > 2) & (rows < len(samples) - 2)]
    moves = 4 * max(samples.least_change, 3 * samples.noise)
    if np.sum(np.min([samples.size[rows + i] for i in (-2, -1, 0)], axis=0) > moves) < 5:
        return None
    position, command = samples.position.copy(), samples.command.copy()
    position[rows] = position[rows - 1]
    if rng.random() < 0.5:
        command[rows] = command[rows - 1]
    return replace(samples, position=position, command=command)


def lost(rng: Random, log: Recorded) -> Samples | None:
    kept = rng.random(len(log.samples)) > rng.uniform(0.02, 0.1)
    kept[0] = True
    samples = log.samples
    return replace(samples, time=samples.time[kept], command=samples.command[kept], position=samples.position[kept])


def stopped(rng: Random, log: Recorded) -> Samples | None:
    """An end of the travel that the device reaches at speed, and stays at or bounces off a little."""
    x = log.exact - log.exact[0]
    side = float(np.sign(x[np.abs(x).argmax()]))
    stop = side * float(np.abs(x).max()) * rng.uniform(0.3, 0.9)
    beyond = np.flatnonzero(x * side > stop * side)
    if not len(beyond) or beyond[0] < 30 or beyond[0] > len(x) - 12:
        return None
    first, speed = int(beyond[0]), np.abs(np.diff(x))
    if speed[first - 1] < 0.3 * speed[:first].max() or speed[first - 1] < 20 * log.samples.least_change:
        return None
    rest = np.arange(len(x) - first)
    bounce = rng.choice([0.0, 0.3]) * speed[first - 1]
    position = log.samples.position.copy()
    position[first:] = log.exact[0] + stop - side * bounce * np.minimum(rest, 20)
    return replace(log.samples, position=position)


def turning(rng: Random, log: Recorded) -> Samples | None:
    """An angle that is read modulo a turn, or the modulus of another encoder."""
    modulus = float(rng.choice([2 * np.pi, 2 * np.pi, np.pi, rng.uniform(0.5, 40)]))
    x = log.samples.position * modulus * rng.uniform(1.2, 12) / (log.samples.range or 1.0) + rng.uniform(0, modulus)
    read = np.mod(x, modulus) - rng.choice([0.0, 0.5 * modulus])
    is_slow = np.abs(np.diff(x)).max() < 0.35 * modulus and np.abs(np.diff(read)).max() > 0.5 * modulus
    return replace(log.samples, position=read) if is_slow else None


def nothing_moves(rng: Random, log: Recorded) -> Samples | None:
    return replace(log.samples, position=np.full(len(log.samples), log.samples.position[0]))


def no_command(rng: Random, log: Recorded) -> Samples | None:
    return replace(log.samples, command=np.zeros(len(log.samples)))


def few_rows(rng: Random, log: Recorded) -> Samples | None:
    rows, samples = int(rng.integers(2, 8)), log.samples
    return replace(samples, time=samples.time[:rows], command=samples.command[:rows], position=samples.position[:rows])


def coarse(rng: Random, log: Recorded) -> Samples | None:
    step = float(np.ptp(log.exact)) * rng.uniform(0.06, 0.3)
    return replace(log.samples, position=np.round(log.exact / step) * step) if step else None


BOTH = (free, wall)


def steps(rng: Random) -> Recorded:
    return free(rng, str(rng.choice(["square", "steps", "pulse"])))


FAULTS: dict[str, tuple[str, Fault, tuple[Callable[[Random], Recorded], ...]]] = {
    "other period": ("sampling_period", other_period, BOTH),
    "lost rows": ("missing_rows", lost, BOTH),
    "repeated rows": ("repeated_rows", repeated, BOTH),
    "frozen position": ("frozen_position", frozen, (free,)),
    "joined positions": ("interpolated_rows", joined_position, BOTH),
    "joined commands": ("interpolated_rows", joined_command, (steps,)),
    "late command": ("noncausal", late_command, BOTH),
    "zero-phase filter": ("noncausal", zero_phase, (steps,)),
    "modulus": ("wrapped_angle", turning, (free,)),
    "travel stop": ("travel_stop", stopped, (free,)),
    "other sign": ("wrong_sign", other_sign, BOTH),
    "constant position": ("constant_position", nothing_moves, BOTH),
    "no command": ("constant_command", no_command, (wall,)),
    "few rows": ("too_few_rows", few_rows, BOTH),
    "coarse sensor": ("coarse_sensor", coarse, BOTH),
}
"""By name: the code of the finding, what makes the fault, and the logs that may have it."""


def codes(samples: Samples) -> set[str]:
    """Return the codes that are found in a log, as its reader and its check find them."""
    position, joined = unwrapped(samples.position)
    found = {finding.code for finding in check_recording(replace(samples, position=position))}
    return found | ({joined.code} if joined else set())


def found_of(name: str, count: int, seed: int = 0) -> float:
    """Return the share of so many logs with a fault in which it is found."""
    code, fault, kinds = FAULTS[name]
    found = made = 0
    while made < count:
        seed += 1
        rng = np.random.default_rng([seed, len(name)])
        samples = fault(rng, kinds[seed % len(kinds)](rng))
        if samples is not None:
            made += 1
            # a wall's command may be late by less than the position shows
            found += not codes(samples).isdisjoint({code, "command_shifted"} if code == "noncausal" else {code})
    return found / count


def found_without(count: int, seed: int = 0) -> Counter[str]:
    """Return how many findings there are in so many logs without a fault, but for coarse sensors."""
    total: Counter[str] = Counter()
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        total.update(codes(BOTH[number % 2](rng).samples) - {"coarse_sensor"})
    return total


def found_in_filtered(count: int, seed: int = 0) -> Counter[str]:
    """Return how many unsafe findings there are in logs whose position was filtered in one direction alone."""
    total: Counter[str] = Counter()
    for number in range(count):
        rng = np.random.default_rng([seed, number, 1])
        found = check_recording(filtered_once(rng, BOTH[number % 2](rng)))
        total.update(finding.code for finding in found if finding.is_unsafe)
    return total


def found_in_ramps(count: int, seed: int = 0) -> Counter[str]:
    """Return how often each severity is found in logs whose command was sent as ramps of a grid."""
    total: Counter[str] = Counter()
    for number in range(count):
        found = check_recording(sent_ramps(np.random.default_rng([seed, number, 2])).samples)
        total.update({finding.severity for finding in found if finding.code == "interpolated_rows"})
    return total


if __name__ == "__main__":
    with_fault, without, seed = int(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    for name in FAULTS:
        share = found_of(name, with_fault, seed)
        print(f"{name:20} {FAULTS[name][0]:20} {round(with_fault * share):4} of {with_fault}", flush=True)
    print(f"without a fault: {dict(found_without(without, seed))} in {without}")
    print(f"filtered in one direction: {dict(found_in_filtered(without, seed))} in {without}")
    print(f"sent as ramps: {dict(found_in_ramps(without, seed))} in {without}")
