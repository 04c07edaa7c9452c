"""A device as numbers that a search may vary: names, limits, and the loop that they make."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pipeline.loop.loop import Loop, Vibration
from pipeline.records.batch import Floats

Sensor = Literal["", "motor", "load"]

ALWAYS = ("gain", "delta", "delay")
"""Numbers of the ideal device: T^2/m, b T/m and delay [samples]."""

LIMITS = {
    "gain": (-np.inf, np.inf),
    "delta": (0.0, 1.0),
    "delay": (0.0, 64.0),
    "gamma": (0.0, 1.0),
    "lag": (1e-3, 64.0),
    "force": (-np.inf, np.inf),
    "turn": (-6.0, 1.6),
    "ratio": (-9.0, 0.0),
    "share": (-3.5, 3.5),
    "bound": (-np.inf, np.inf),
}
"""Least and largest value of each number. ``gain``, ``turn`` (of the mode [rad] a sample), ``ratio`` (its damping
ratio) and ``bound`` (of the force) are logarithms, ``share`` (of the far mass) that of its odds: a search then makes no
step beyond what can be."""

LARGEST_STEP = {
    "gain": 0.5,
    "delay": 1.5,
    "lag": 1.5,
    "turn": 0.3,
    "ratio": 1.0,
    "share": 1.0,
    "delta": 0.1,
    "bound": 0.3,
}
"""Change of a number in one step within which the response is near a straight line."""


@dataclass(frozen=True)
class Device:
    """A device: the parts that it has, and its numbers by name.

    ``sensor`` is the side of the mode on which the position is sensed, empty without one.
    """

    numbers: dict[str, float]
    sensor: Sensor = ""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its numbers in the order of a search."""
        return tuple(self.numbers)

    def without(self, *names: str) -> Device:
        """Return the device without some parts."""
        left = {name: value for name, value in self.numbers.items() if name not in names}
        return Device(left, self.sensor if "turn" in left else "")

    def having(self, **more: float) -> Device:
        """Return the device with more numbers, or others."""
        return replace(self, numbers=self.numbers | more)

    def at(self, values: Floats) -> Device:
        """Return the device with its numbers replaced, each within its limits."""
        pairs = zip(self.names, values.tolist(), strict=True)
        return replace(self, numbers={name: float(np.clip(value, *LIMITS[name])) for name, value in pairs})

    @property
    def values(self) -> Floats:
        """Its numbers."""
        return np.array(list(self.numbers.values()))

    def obeyed(self, command: Floats) -> Floats:
        """Return what its drive makes of commands [N, Nm]: no more than it can."""
        if "bound" not in self.numbers:
            return command
        largest = float(np.exp(self.numbers["bound"]))
        return np.clip(command, -largest, largest)

    @property
    def loop(self) -> Loop:
        """Its loop without gain, force and what is not linear."""
        n = self.numbers
        mode = None
        if self.sensor:
            far = 1 / (1 + np.exp(-n["share"]))
            reduced, turn = far * (1 - far), np.exp(n["turn"])
            damping = 2 * np.exp(n["ratio"]) * turn * reduced
            mode = Vibration(float(far), float(reduced * turn**2), float(damping), self.sensor == "load")
        return Loop(n.get("gamma", 0.0), n["delta"], n["delay"], n.get("lag", 0.0), mode)
