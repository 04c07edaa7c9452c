"""Random devices that are not ideal, and their loops in many digits by another road: SI, absolute coordinates, mpmath.

The state here holds both masses, the actuator's force and the histories of positions and velocities; poles are judged
by the Schur-Cohn recursion of the characteristic polynomial. Nothing is shared with `pipeline` but the device's record.
"""

from __future__ import annotations

from typing import Any

import mpmath as mp
import numpy as np

from pipeline.device.loop import Loop
from pipeline.device.parts import Butterworth, Coefficients, Difference, Mode, Operator


def random_device(rng: np.random.Generator, extreme: str = "") -> Loop:
    """Draw filter x lag x mode x operator x fractional delay; ``extreme`` names a part that is."""
    period = 1 / float(rng.choice([500, 1000, 2000, 4000]))
    mass = float(10 ** rng.uniform(-2, 1))
    filters = (
        None,
        Difference(kind="difference", samples=int(rng.integers(2, 9))),
        Butterworth(
            kind="butterworth", order=int(rng.integers(1, 5)), cutoff_hz=float(10 ** rng.uniform(-2, -0.5) / period)
        ),
        Coefficients(
            kind="coefficients", b=tuple(map(float, rng.uniform(0.1, 1, 3))), a=(1.0, -float(rng.uniform(0, 0.9)))
        ),
    )
    velocity = filters[int(rng.integers(4))]
    lag = float(rng.choice([0.0, 0.3, 1.0, 4.0]) * rng.uniform(0.5, 1.5) * period)
    mode: dict[str, object] = {
        "frequency_hz": float(10 ** rng.uniform(-2, -0.5) / period),
        "damping_ratio": float(10 ** rng.uniform(-3, -0.7)),
        "mass": float(mass * rng.uniform(0.05, 0.8)),
        "sensor": str(rng.choice(["motor", "load"])),
    }
    has_mode = rng.random() < 0.6
    if extreme == "cut-off near Nyquist":
        velocity = Butterworth(
            kind="butterworth", order=int(rng.integers(1, 5)), cutoff_hz=float(rng.uniform(0.49, 0.4999) / period)
        )
    elif extreme == "short lag":
        lag = 1e-6
    elif extreme == "long lag":
        lag = 50 * period
    elif extreme:
        has_mode = True
        mode |= {
            "hardly damped": {"damping_ratio": 1e-4},
            "mode above Nyquist": {"frequency_hz": float(rng.uniform(0.55, 3) / period)},
            "light mass": {"mass": mass * 1e-3},
        }[extreme]
    operator = Operator(
        mass=float(mass * rng.uniform(0.1, 1)), damping=float(rng.uniform(0, 5)), stiffness=float(rng.uniform(0, 500))
    )
    parts: dict[str, Any] = {
        "velocity": velocity,
        "actuator_lag_s": lag,
        "force_gain": float(rng.choice([1.0, 0.8])),
        "mode": Mode.model_validate(mode) if has_mode else None,
        "operator": operator if rng.random() < 0.5 else None,
    }
    delay = float(rng.choice([float(rng.integers(0, 6)), rng.uniform(0, 6)]))
    spring = float(rng.choice([0.0, rng.uniform(0, 100)]))
    damping = float(rng.uniform(0, 0.02) * mass / period)
    loop = Loop(mass, damping, period, delay, spring, **parts)
    if has_mode and rng.random() < 0.5:
        return loop.replace({"mode.load_damping": float(rng.uniform(0, damping))})
    return loop


EXTREMES = ("cut-off near Nyquist", "short lag", "long lag", "hardly damped", "mode above Nyquist", "light mass")


def _coefficients(loop: Loop) -> tuple[list[mp.mpf], list[mp.mpf]]:
    velocity = loop.velocity
    if velocity is None:
        return [mp.mpf(1)], [mp.mpf(1)]
    if isinstance(velocity, Difference):
        return [mp.mpf(1) / velocity.samples] * velocity.samples, [mp.mpf(1)]
    if isinstance(velocity, Coefficients):
        return [mp.mpf(x) / velocity.a[0] for x in velocity.b], [mp.mpf(x) / velocity.a[0] for x in velocity.a]
    n = velocity.order
    edge = 2 * mp.tan(mp.pi * mp.mpf(velocity.cutoff_hz) * mp.mpf(loop.sampling_period_s))
    analog = [edge * mp.expjpi(mp.mpf(2 * k + n + 1) / (2 * n)) for k in range(n)]
    b, a = [mp.mpf(1)], [mp.mpc(1)]
    for pole in ((2 + p) / (2 - p) for p in analog):
        b = [x + y for x, y in zip([*b, 0], [0, *b], strict=True)]
        a = [x - pole * y for x, y in zip([*a, 0], [0, *a], strict=True)]
    a = [mp.re(x) for x in a]
    gain = mp.fsum(a) / mp.fsum(b)
    return [gain * x for x in b], a


class ManyDigits:
    """A loop in the present precision of mpmath."""

    def __init__(self, loop: Loop) -> None:
        mode, operator, lag = loop.mode, loop.operator, mp.mpf(loop.actuator_lag_s)
        self.period = mp.mpf(loop.sampling_period_s)
        self.b, self.a = _coefficients(loop)
        far = mp.mpf(mode.mass) if mode else mp.mpf(0)
        near_alone = mp.mpf(loop.mass) - far
        near = near_alone + (mp.mpf(operator.mass) if operator else 0)
        self.damping = mp.mpf(loop.damping) + (mp.mpf(operator.damping) if operator else 0)
        self.stiffness = mp.mpf(loop.stiffness) + (mp.mpf(operator.stiffness) if operator else 0)
        self.gain, self.mass = mp.mpf(loop.force_gain), near + far
        spring = damper = of_load = mp.mpf(0)
        if mode:
            turn, reduced = 2 * mp.pi * mp.mpf(mode.frequency_hz), far * near_alone / (far + near_alone)
            spring, damper = reduced * turn**2, 2 * mp.mpf(mode.damping_ratio) * turn * reduced
            of_load = mp.mpf(mode.load_damping)
        # states: near position, near velocity, far position, far velocity, actuator's force; last: its input
        m = mp.zeros(6)
        m[0, 1] = m[2, 3] = 1
        m[1, 0], m[1, 1], m[1, 2], m[1, 3] = (
            *(-(self.stiffness + spring) / near, -(self.damping - of_load + damper) / near),
            *(spring / near, damper / near),
        )
        m[1, 4] = 1 / near
        if mode:
            m[3, 0], m[3, 1], m[3, 2], m[3, 3] = spring / far, damper / far, -spring / far, -(damper + of_load) / far
        self.kept = [0, 1, *([2, 3] if mode else []), *([4] if lag > 0 else [])]
        if lag > 0:
            m[4, 4], m[4, 5] = -1 / lag, self.gain / lag
        else:
            m[1, 5], m[1, 4] = self.gain / near, 0
        self.continuous = m
        self.sensor = 2 if mode and mode.sensor == "load" else 0
        delay = mp.mpf(loop.delay_samples)
        whole = int(mp.floor(delay))
        fraction = delay - whole
        self.segments = [(fraction, whole + 1), (1 - fraction, whole)] if fraction else [(mp.mpf(1), whole)]

    def moved(self, share: mp.mpf) -> mp.matrix:
        return mp.expm(self.continuous * (share * self.period), method="taylor")

    def matrix(self, K: mp.mpf, B: mp.mpf) -> mp.matrix:
        oldest = self.segments[0][1]
        positions, speeds = max(len(self.b), 1) + oldest, max(len(self.a) - 1, 0) + oldest
        n = 5 + positions + speeds
        # rows of the position e_{k-i} and of the filtered velocity v_{k-i}, i = 0, 1, ...
        e = [mp.zeros(1, n) for _ in range(positions + 1)]
        e[0][self.sensor] = 1
        for i in range(1, positions + 1):
            e[i][4 + i] = 1
        v = [mp.zeros(1, n) for _ in range(speeds + 1)]
        for i in range(1, speeds + 1):
            v[i][4 + positions + i] = 1
        for i, b in enumerate(self.b):
            v[0] += b * (e[i] - e[i + 1]) / self.period
        for i, a in enumerate(self.a[1:], start=1):
            v[0] -= a * v[i]
        now = mp.zeros(5, n)
        for i in range(5):
            now[i, i] = 1
        for share, age in self.segments:
            motion = self.moved(share)
            wall = -K * e[age] - B * v[age]
            now = motion[:5, :5] * now + motion[:5, 5] * wall
        result = mp.zeros(n)
        for j in range(n):
            for i in range(5):
                result[i, j] = now[i, j]
            for i in range(1, positions + 1):
                result[4 + i, j] = e[i - 1][j]
            for i in range(1, speeds + 1):
                result[4 + positions + i, j] = v[i - 1][j]
        return result

    def stable(self, K: float, B: float) -> bool:
        full = self.matrix(mp.mpf(K), mp.mpf(B))
        used = [*self.kept, *range(5, full.rows)]
        return schur_cohn(characteristic(mp.matrix([[full[i, j] for j in used] for i in used])))


def characteristic(matrix: mp.matrix) -> list[mp.mpf]:
    """Characteristic polynomial, lowest power first, by Faddeev and LeVerrier."""
    n = matrix.rows
    result, adjugate = [mp.mpf(1)], mp.eye(n)
    for k in range(1, n + 1):
        turned = matrix * adjugate
        c = -mp.fsum(turned[i, i] for i in range(n)) / k
        result.append(c)
        for i in range(n):
            turned[i, i] += c
        adjugate = turned
    return result[::-1]


def schur_cohn(polynomial: list[mp.mpf]) -> bool:
    while len(polynomial) > 1:
        first, last = polynomial[0], polynomial[-1]
        if abs(first) >= abs(last):
            return False
        polynomial = [last * p - first * q for p, q in zip(polynomial, polynomial[::-1], strict=True)][1:]
    return True
