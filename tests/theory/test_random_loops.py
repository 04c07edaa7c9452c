"""Settling time, overshoot and energies of random loops with parts against a fine simulation in SI.

The motion is followed by matrix exponentials from sample to sample; turning points and the last passing into the band
are roots of the exact motion between them, and energies are integrals by Gauss's rule. Of the 2,600 loops
that are drawn some 2,000 have a wall whose motion ends soon; `RANDOM_LOOPS` in the environment draws as many.
"""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np
import pytest
from plain_loops import Plain, drawn
from scipy.linalg import expm
from scipy.optimize import brentq

from pipeline.theory.cases import POINT_COSTS

CHUNK, CHUNKS = 50, int(os.environ.get("RANDOM_LOOPS", "2600")) // 50
FEW = 12
"""Loops of the fast test."""

SLOWEST = 0.998
"""Largest pole radius of a wall: its motion has ended after some 20,000 samples."""

TRIES = 240
"""Walls of a loop among which one is chosen."""

BAND = 0.02
NODES, WEIGHTS = np.polynomial.legendre.leggauss(24)
SHARES = 0.5 * (NODES + 1)
LOOKS = 4
"""Parts of a stretch with constant force in which turning points are looked for, and over which is integrated."""

TOLERANCE = {"settle": 1e-10, "overshoot": 1e-9, "energy": 1e-9}
"""Largest differences relative to a cost, or to 1 where it is less."""


@dataclass
class Stretch:
    """Motion from a device state (with its force) under a constant force, in samples: position and velocity."""

    plain: Plain
    state: np.ndarray
    begin: float
    duration: float

    def at(self, time: float) -> np.ndarray:
        return expm(self.plain.rates * (time * self.plain.period)) @ self.state

    def away(self, time: float) -> float:
        return float(self.at(time)[self.plain.sensed] - 1)

    def speed(self, time: float) -> float:
        return float(self.at(time)[self.plain.sensed + 1]) * self.plain.period


class Simulation:
    """A step or impulse response behind a wall, followed to its end; that of a step ends at 1, of an impulse at 0."""

    def __init__(self, plain: Plain, K: float, B: float, samples: int, signal: str = "step"):
        self.plain, self.signal, self.period = plain, signal, plain.period
        stiff = (K + plain.stiffness) * plain.period**2 / plain.mass
        whole = plain.mass / plain.period  # of a unit momentum, in masses per period
        self.final, self.weights = (1.0, (1.0, 1 / stiff)) if signal == "step" else (0.0, (stiff * whole**2, whole**2))
        wall, nothing, unit = (np.array([K]), np.array([B])), np.zeros((1, plain.size)), np.eye(plain.size)
        *pushes, push = plain.sample(nothing, *wall, (K + plain.stiffness) * self.final)
        *maps, step = plain.sample(unit, *wall, 0.0)
        states = np.zeros((samples, plain.size))
        if signal == "impulse":
            states[0, 1] = 1 / (plain.mass - (plain.mode[0] if plain.mode else 0.0))
        for k in range(samples - 1):
            states[k + 1] = states[k] @ step + push[0]
        self.sampled = states[:, plain.sensed] - self.final
        parts, begins, lengths, begin = [], [], [], np.arange(float(samples))
        for linear, constant, (duration, _) in zip(maps, pushes, plain.holds, strict=True):
            start, length = states @ linear + constant, duration / LOOKS
            for _ in range(LOOKS):
                parts.append(start)
                begins.append(begin)
                lengths.append(np.full(samples, length))
                start, begin = start @ self.moves(length).T, begin + length
        self.states = np.stack(parts, axis=1).reshape(-1, 6)
        self.begins, self.lengths = (np.stack(each, axis=1).ravel() for each in (begins, lengths))

    def stretch(self, index: int) -> Stretch:
        return Stretch(self.plain, self.states[index], self.begins[index], self.lengths[index])

    def moves(self, length: float) -> np.ndarray:
        known = self.__dict__.setdefault("known", {})
        if length not in known:
            known[length] = expm(self.plain.rates * (length * self.period))
        return known[length]

    def costs(self) -> dict[str, float]:
        place = self.states[:, self.plain.sensed] - 1
        speed = self.states[:, self.plain.sensed + 1]
        turns, outside = np.flatnonzero(speed[:-1] * speed[1:] < 0), np.flatnonzero(np.abs(place) > BAND)[-1]
        times, values = list(self.begins), list(place)
        for i in turns:
            stretch = self.stretch(i)
            nearer = max(place[i], place[i + 1]) >= 0.5 * max(place.max(), 1e-11)
            if not nearer and (i < outside or max(abs(place[i]), abs(place[i + 1])) < 0.5 * BAND):
                continue  # decides neither
            turn = brentq(stretch.speed, 0, stretch.duration, xtol=1e-14)
            times.append(stretch.begin + turn)
            values.append(stretch.away(turn))
        order = np.argsort(times)
        times, values = np.array(times)[order], np.array(values)[order]
        last = np.flatnonzero(np.abs(values) > BAND)[-1]
        stretch = self.stretch(int(np.searchsorted(self.begins, times[last], side="right")) - 1)
        level = np.sign(values[last]) * BAND
        low, high = times[last] - stretch.begin, times[last + 1] - stretch.begin
        settle = stretch.begin + brentq(lambda t: stretch.away(t) - level, low, min(high, stretch.duration), xtol=1e-13)
        out = np.flatnonzero(np.abs(self.sampled) > BAND)[-1] + 1
        found = {"settle_2pct": settle, "settle_2pct_discrete": float(out)}
        found |= {"overshoot": max(values.max(), 0.0), "overshoot_discrete": max(self.sampled.max(), 0.0)}
        return found | self.energies()

    def energies(self) -> dict[str, float]:
        k, step, (potential, kinetic) = np.arange(len(self.sampled)), np.diff(self.sampled), self.weights
        discrete, sums = potential * self.sampled**2, np.zeros(3)
        discrete[1:] += kinetic * step**2
        for length in np.unique(self.lengths):
            some = self.lengths == length
            for share, weight in zip(SHARES, 0.5 * WEIGHTS, strict=True):
                states = self.states[some] @ self.moves(length * share).T
                away = states[:, self.plain.sensed] - self.final
                energy = potential * away**2 + kinetic * (states[:, self.plain.sensed + 1] * self.period) ** 2
                sums += [np.sum(weight * length * (self.begins[some] + length * share) ** w * energy) for w in range(3)]
        name = f"energy_{self.signal}_w"
        found = {f"{name}{w}": float(sums[w]) for w in range(3)}
        return found | {f"{name}{w}_discrete": float(k.astype(float) ** w @ discrete) for w in range(3)}


def a_wall(plain: Plain, rng: np.random.Generator) -> tuple[float, float, float] | None:
    """Return a wall whose motion ends soon, and its pole radius; None where no try finds one."""
    K = 10 ** rng.uniform(-4, 0, TRIES) * plain.mass / plain.period**2
    B = 10 ** rng.uniform(-2, 0.3, TRIES) * plain.mass / plain.period
    radius = plain.radius(K, B)
    good = np.flatnonzero(radius < SLOWEST)
    return (float(K[good[0]]), float(B[good[0]]), float(radius[good[0]])) if len(good) else None


def deviations(seed: int) -> dict[str, float]:
    """Return the differences of the costs of a random loop and its simulation."""
    plain, loop = drawn("several", seed)
    wall = a_wall(plain, np.random.default_rng([seed, 3]))
    if wall is None:
        return {}
    K, B, radius = wall
    samples = int(60 + 3 * plain.delay + 34 / -np.log(radius))
    truth, answer = Simulation(plain, K, B, samples).costs(), loop.points(K, B, POINT_COSTS).iloc[0]
    truth |= Simulation(plain, K, B, samples, "impulse").energies()
    return {name: abs(answer[name] - value) / max(1.0, abs(value)) for name, value in truth.items()}


def check(seeds: range) -> None:
    largest: dict[str, float] = {}
    count = 0
    for seed in seeds:
        off_by = deviations(seed)
        count += bool(off_by)
        for name, off in off_by.items():
            largest[name] = max(largest.get(name, 0.0), off)
            assert off <= TOLERANCE[name.split("_")[0]], (seed, name, off)
    print(count, {name: f"{off:.1e}" for name, off in largest.items()})
    assert count > 0.5 * len(seeds)
    assert len(largest) == len(POINT_COSTS)


def test_costs_of_random_loops_equal_a_fine_simulation():
    check(range(FEW))


@pytest.mark.slow
@pytest.mark.parametrize("chunk", range(CHUNKS))
def test_costs_of_many_random_loops_equal_a_fine_simulation(chunk):
    check(range(FEW + chunk * CHUNK, FEW + (chunk + 1) * CHUNK))
