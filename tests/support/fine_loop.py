"""A second simulator of the loop with all its parts: plain loops over fine steps, equations of motion in physical form.

Nothing of `pipeline.simulation` is used. Between two fine steps the motion without friction is integrated by scipy's
DOP853; friction holds or slides by the balance of forces, and scipy finds when it changes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.integrate import solve_ivp
from scipy.signal import butter, lfilter

from pipeline.records.trials import Floats


@dataclass
class Body:
    """Masses, springs, lag and friction in SI; ``coulomb`` = 0 is none."""

    mass: float
    damping: float = 0.0
    stiffness: float = 0.0
    load: float = 0.0
    spring: float = 0.0
    spring_damping: float = 0.0
    lag: float = 0.0
    coulomb: float = 0.0
    stiction: float = 0.0
    stribeck: float = 0.01
    sensor_at_load: bool = False
    load_damping: float = 0.0
    state: Floats = field(default_factory=lambda: np.zeros(5))
    dissipated: float = 0.0

    def friction(self, speed: float) -> float:
        if speed >= self.stribeck:
            return self.coulomb
        return self.stiction - (self.stiction - self.coulomb) * speed / self.stribeck

    def free_force(self, s: Floats, command: float, push: float) -> float:
        actuator = s[4] if self.lag else command
        across = self.spring * (s[0] - s[2]) + self.spring_damping * (s[1] - s[3])
        return actuator + push - self.damping * s[1] - self.stiffness * s[0] - across

    def rates(self, s: Floats, command: float, push: float, side: int) -> Floats:
        force = self.free_force(s, command, push) - side * self.friction(abs(s[1]))
        across = self.spring * (s[0] - s[2]) + self.spring_damping * (s[1] - s[3])
        return np.array(
            [
                s[1] if side else 0.0,
                force / self.mass if side else 0.0,
                s[3] if self.load else 0.0,
                (across - self.load_damping * s[3]) / self.load if self.load else 0.0,
                (command - s[4]) / self.lag if self.lag else 0.0,
            ]
        )

    def move(self, command: float, push: float, time: float) -> None:
        """Move by a time under a constant command, region after region."""
        frictional = self.coulomb > 0 or self.stiction > 0
        begun = 0.0
        for _ in range(100):
            s = self.state
            force = self.free_force(s, command, push)
            if not frictional:
                side, events = 2, []
            elif s[1] == 0 and abs(force) <= self.stiction * (1 + 1e-12):
                side, events = (
                    0,
                    [self._event(lambda s: self.stiction * (1 + 1e-12) - abs(self.free_force(s, command, push)))],
                )
            else:
                side = int(np.sign(s[1] if s[1] != 0 else force))
                slow = abs(s[1]) < self.stribeck
                events = [self._event(lambda s, side=side: side * s[1] if s[1] != 0 else 1e-300)]
                events.append(self._event(lambda s, side=side: side * s[1] - self.stribeck, -1.0 if not slow else 1.0))
            motion = (
                (lambda t, s: self._unhindered(s, command, push))
                if side == 2
                else (lambda t, s, side=side: self.rates(s, command, push, side))
            )
            found = solve_ivp(motion, (begun, time), s, "DOP853", rtol=1e-12, atol=1e-15, events=events)
            self.state = found.y[:, -1].copy()
            begun = float(found.t[-1])
            if found.status == 0:
                return
            if side and len(found.t_events[0]):
                self.state[1] = 0.0
            elif side:
                # just beyond the joint, so that the next region is the one that is entered
                self.state[1] = side * self.stribeck * (1 + 1e-13 * (1 if slow else -1))
            else:
                self.state[1] = 0.0
        raise AssertionError("too many events in one step")

    def _unhindered(self, s: Floats, command: float, push: float) -> Floats:
        result = self.rates(s, command, push, 1)
        result[1] = self.free_force(s, command, push) / self.mass
        return result

    @staticmethod
    def _event(function: Callable[[Floats], float], direction: float = -1.0) -> Callable[[float, Floats], float]:
        def event(_: float, s: Floats) -> float:
            return function(s)

        event.terminal, event.direction = True, direction  # type: ignore[attr-defined]
        return event


def velocity_filter(kind: str | None, T: float, order: int = 1, value: float = 0.0) -> tuple[Floats, Floats]:
    """Return b and a of (x_k - x_{k-1})/T by scipy's own design."""
    if kind == "butterworth":
        b, a = butter(order, value, fs=1 / T)
        return b, a
    if kind == "difference":
        return np.ones(order) / order, np.ones(1)
    return np.ones(1), np.ones(1)


def run(
    body: Body,
    *,
    K: float,
    B: float,
    T: float,
    external: Floats,
    delay: tuple[int, int],
    b: Floats,
    a: Floats,
    gain: float = 1.0,
    limit: float = np.inf,
    one_sided: bool = False,
    true_period: float | None = None,
) -> tuple[Floats, Floats]:
    """Return displacement and command of each row; the delay is p/q samples, q fine steps a sample."""
    p, q = delay
    position, command, sent = [], [], []
    step = (T if true_period is None else true_period) / q
    for row, outside in enumerate(external):
        position.append(body.state[2 if body.sensor_at_load else 0])
        speed = np.diff(position, prepend=position[0]) / T
        wall = K * position[-1] + B * lfilter(b, a, speed)[-1]
        if one_sided and position[-1] * external[-1] <= 0:
            wall = 0.0
        command.append(outside - wall)
        for fine in range(row * q, row * q + q):
            sent.append(gain * float(np.clip(command[-1], -limit, limit)))
            body.move(sent[fine - p] if fine >= p else 0.0, 0.0, step)
    return np.array(position), np.array(command)
