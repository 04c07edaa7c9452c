"""Experiments of any kind, recorded by a simulator that shares nothing with the package: scalars, exact between events.

The device is a mass with a damper and Coulomb friction. Between two fine steps its motion under a constant force is
exact; a step in which the velocity changes its sign is cut there, and friction then fixes the mass or lets it slide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, inf
from pathlib import Path

import numpy as np

FINE = 20
"""Fine steps of a sampling period: delays are multiples of a twentieth."""

FAR = 1e6
"""Position in units of the first metre at which a simulation ends: the trial ran away."""


@dataclass(frozen=True)
class Rig:
    """A device and its loop in SI; ``delay`` in samples, ``jitter`` the half width of its scatter."""

    mass: float = 0.5
    damping: float = 3.0
    friction: float = 0.0
    period: float = 1e-3
    delay: float = 2.0
    jitter: int = 0
    resolution: float = 0.0
    noise: float = 0.0
    stop: float = inf


@dataclass(frozen=True)
class Trial:
    """One trial: wall, step of the external force at a row, length, and how it begins."""

    stiffness: float
    damping: float
    step: float
    rows: int = 300
    edge: int = 20
    position: float = 0.0
    velocity: float = 0.0


def slid(rig: Rig, x: float, v: float, force: float, time: float) -> tuple[float, float]:
    """Return position and velocity after a short time under a constant force."""
    m, b, c = rig.mass, rig.damping, rig.friction
    for _ in range(4):
        if v == 0.0 and abs(force) <= c:
            return x, 0.0
        way = 1.0 if v > 0 or (v == 0.0 and force > 0) else -1.0
        net = force - way * c
        if b * time > 1e-9 * m:
            rate, end = b / m, net / b
            decay = exp(-rate * time)
            after = end + (v - end) * decay
            moved = x + end * time + (v - end) * (1 - decay) / rate
        else:
            after, moved = v + net / m * time, x + v * time + 0.5 * net / m * time * time
        if v == 0.0 or after * v >= 0 or c == 0.0:
            return moved, after
        # to where it turns: by a line, whose error is that of the fine step's square
        part = time * v / (v - after)
        x, v, time = x + 0.5 * v * part, 0.0, time - part
    return x, v


def recorded(rig: Rig, trial: Trial, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return time [s], command [N] and position [m] of a trial, each of shape (rows,)."""
    rng = np.random.default_rng(seed)
    T, late = rig.period, round(rig.delay * FINE)
    x, v, before = trial.position, trial.velocity, None
    commands: list[float] = []
    positions: list[float] = []
    arrivals: list[int] = []
    first = trial.position
    for row in range(trial.rows):
        seen = x + rig.noise * rng.standard_normal()
        if rig.resolution:
            seen = round(seen / rig.resolution) * rig.resolution
        first = seen if row == 0 else first
        speed = 0.0 if before is None else (seen - before) / T
        external = trial.step if row >= trial.edge else 0.0
        command = external - trial.stiffness * (seen - first) - trial.damping * speed
        before = seen
        positions.append(seen)
        commands.append(command)
        shift = FINE * int(rng.integers(-rig.jitter, rig.jitter + 1)) if rig.jitter else 0
        arrivals.append(row * FINE + max(late + shift, 0))
        for fine in range(FINE):
            now = row * FINE + fine
            active = 0.0
            for k in range(row, max(row - 2 - late // FINE - 2 * rig.jitter, -1), -1):
                if arrivals[k] <= now:
                    active = commands[k]
                    break
            x, v = slid(rig, x, v, active, T / FINE)
            if abs(x) > rig.stop:
                x, v = rig.stop if x > 0 else -rig.stop, 0.0
        if not abs(x) < FAR:
            break
    n = len(positions)
    return T * np.arange(n), np.array(commands), np.array(positions)


def is_unstable(rig: Rig, K: float, B: float, step: float, rows: int = 1500) -> bool:
    """Return whether a step makes the true device oscillate without end behind a wall, by the end of a long trial.

    Jitter and the sensor are left out: what they keep up is bounded.
    """
    plain = Rig(rig.mass, rig.damping, rig.friction, rig.period, rig.delay)
    _, _, x = recorded(plain, Trial(K, B, step, rows=rows, edge=1))
    if len(x) < rows:
        return True
    way = [float(np.ptp(part)) for part in np.array_split(x[rows // 4 :], 3)]
    return way[2] > 1.05 * way[0] and way[2] > 1e-3 * abs(step) / max(K, 1e-300)


def write_log(path: Path, rig: Rig, trial: Trial, seed: int = 0, lost: Sequence[int] = (), **more: object) -> None:
    """Write a trial as a native log without the rows that are lost; ``more`` are other conditions of its header."""
    head = {
        "device": "dev",
        "experiment": "1",
        "stiffness": trial.stiffness,
        "damping": trial.damping,
        "step": trial.step,
        "sampling_period_s": rig.period,
        **more,
    }
    columns = zip(*(column.tolist() for column in recorded(rig, trial, seed)), strict=True)
    rows = [",".join(map(repr, row)) for number, row in enumerate(columns) if number not in lost]
    lines = [*(f"# {name}: {value}" for name, value in head.items()), "time_s,command,position", *rows]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
