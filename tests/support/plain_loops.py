"""Loops written down in SI without anything of the package: steps of positions, filter and forces on their way."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import floor

import numpy as np
from scipy.linalg import expm
from scipy.signal import butter

import pipeline

FINE = 48
"""Places of a sample at which the motion is looked at."""


@dataclass
class Plain:
    """A device and its wall law in SI; ``mode`` is far mass, spring, damper, and whether the load is sensed."""

    mass: float
    damping: float
    stiffness: float
    period: float
    delay: float
    lag: float = 0.0
    mode: tuple[float, float, float, bool] | None = None
    b: np.ndarray = field(default_factory=lambda: np.ones(1))
    a: np.ndarray = field(default_factory=lambda: np.ones(1))

    def __post_init__(self) -> None:
        far, spring, damper, load = self.mode or (0.0, 0.0, 0.0, False)
        near = self.mass - far
        # near position and velocity, far position and velocity, force at work, command
        rates = np.zeros((6, 6))
        rates[0, 1] = rates[2, 3] = 1.0
        rates[1, :4] = [-self.stiffness - spring, -self.damping - damper, spring, damper]
        rates[1] /= near
        rates[1, 4 if self.lag else 5] = 1 / near
        if self.mode:
            rates[3, :4] = [spring / far, damper / far, -spring / far, -damper / far]
        if self.lag:
            rates[4, 4:] = -1 / self.lag, 1 / self.lag
        self.rates, self.sensed = rates, 2 if load else 0
        whole = floor(self.delay)
        late = self.delay - whole
        self.holds = [(late, whole + 1), (1 - late, whole)] if late else [(1.0, whole)]
        self.moves = [expm(rates * share * self.period) for share, _ in self.holds]
        self.kept = [0, 1] + [2, 3] * bool(self.mode) + [4] * bool(self.lag)
        self.order = max(len(self.b), len(self.a)) - 1
        self.oldest = self.holds[0][1]

    @property
    def size(self) -> int:
        """States of the device, last position, filter, forces on their way."""
        return 6 + self.order + self.oldest

    def sample(self, state: np.ndarray, K: np.ndarray, B: np.ndarray, step: float) -> list[np.ndarray]:
        """Return device states (with command, n x 6) at the start of each hold, and the next state last; walls (n,)."""
        b, a = (np.pad(c, (0, self.order + 1 - len(c))) for c in (self.b, self.a))
        device, last, held, forces = np.split(state, [5, 6, 6 + self.order], axis=-1)
        position = device[..., self.sensed]
        speed = (position - last[..., 0]) / self.period
        given = b[0] * speed + (held[..., 0] if self.order else 0.0)
        following = np.roll(held, -1, axis=-1)
        if self.order:
            following[..., -1] = 0
            following += b[1:] * speed[..., None] - a[1:] * given[..., None]
        force = -K * position - B * given
        forces = np.concatenate([force[..., None], forces], axis=-1)
        starts = []
        for move, (_, age) in zip(self.moves, self.holds, strict=True):
            now = np.concatenate([device, (step + forces[..., age])[..., None]], axis=-1)
            starts.append(now)
            device = (now @ move.T)[..., :5]
        rest = [position[..., None], following, forces[..., : self.oldest]]
        return [*starts, np.concatenate([device, *rest], axis=-1)]

    def radius(self, K: np.ndarray, B: np.ndarray) -> np.ndarray:
        """Largest modulus of the poles of walls (n,)."""
        unit = np.broadcast_to(np.eye(self.size), (len(K), self.size, self.size))
        rows = self.sample(unit, K[:, None], B[:, None], 0.0)[-1]
        used = [*self.kept, *range(5, self.size)]
        return np.concatenate(
            [np.abs(np.linalg.eigvals(part[:, used][:, :, used])).max(axis=1) for part in np.array_split(rows, 8)]
        )

    def followed(self, K: float, B: float, samples: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return times [samples] and deviations from the end per way, between samples, and those of the samples."""
        step = K + self.stiffness
        state, walls = np.zeros((1, self.size)), (np.array([K]), np.array([B]))
        share = np.arange(1, FINE + 1) / FINE
        paths = [
            np.array([expm(self.rates * duration * s * self.period)[self.sensed] for s in share])
            for duration, _ in self.holds
        ]
        times, away, sampled = [], [], np.empty(samples)
        for k in range(samples):
            sampled[k] = state[0, self.sensed] - 1
            *starts, state = self.sample(state, *walls, step)
            begin = float(k)
            for start, path, (duration, _) in zip(starts, paths, self.holds, strict=True):
                times.append(begin + duration * share)
                away.append(path @ start[0] - 1)
                begin += duration
        return np.concatenate(times), np.concatenate(away), sampled


def drawn(kind: str, seed: int) -> tuple[Plain, pipeline.Loop]:
    """Return a random loop twice, written down here and by the package: ideal, with a part, or with several."""
    rng = np.random.default_rng([80_423, seed, ("ideal", "device", "several").index(kind)])
    period, mass = float(10 ** rng.uniform(-3.5, -2.5)), float(10 ** rng.uniform(-2, 1))
    delay = float(rng.choice([rng.integers(0, 9), rng.uniform(0, 9), rng.integers(0, 3)]))
    damping = float(rng.choice([0.0, 10 ** rng.uniform(-4, -0.5)])) * mass / period
    spring = float(rng.choice([0.0, 0.0, 10 ** rng.uniform(-5, -1.5)])) * mass / period**2
    named = {"damping": damping, "stiffness": spring, "delay_samples": delay}
    if kind == "ideal":
        return Plain(mass, damping, spring, period, delay), pipeline.Loop(mass, sampling_period_s=period, **named)
    parts: dict[str, object] = {}
    plain: dict[str, object] = {}
    which = str(rng.choice(["lag", "mode", "difference", "butterworth"]))
    several = kind == "several" and rng.random() < 0.7
    if which == "lag" or several:
        plain["lag"] = parts["actuator_lag_s"] = float(10 ** rng.uniform(-1.5, 0.7) * period)
    if which == "mode" or several:
        turn, ratio = 2 * np.pi * 10 ** rng.uniform(-2.3, -0.5) / period, float(10 ** rng.uniform(-2.5, -0.5))
        far, load = float(mass * rng.uniform(0.05, 0.8)), bool(rng.random() < 0.5)
        reduced = far * (mass - far) / mass
        plain["mode"] = far, reduced * turn**2, 2 * ratio * turn * reduced, load
        shape = {"frequency_hz": float(turn / (2 * np.pi)), "damping_ratio": ratio, "mass": far}
        parts["mode"] = shape | {"sensor": "load" if load else "motor"}
    if which == "difference":
        count = int(rng.integers(2, 9))
        plain["b"] = np.ones(count) / count
        parts["velocity"] = {"kind": "difference", "samples": count}
    elif which == "butterworth":
        order, cutoff = int(rng.integers(1, 3)), float(10 ** rng.uniform(-1.7, -0.4))
        plain["b"], plain["a"] = butter(order, 2 * cutoff)
        parts["velocity"] = {"kind": "butterworth", "order": order, "cutoff_hz": cutoff / period}
    return Plain(mass, damping, spring, period, delay, **plain), pipeline.Loop(
        mass, sampling_period_s=period, **named, **parts
    )
