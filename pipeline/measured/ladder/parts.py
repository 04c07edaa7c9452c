"""The parts that a device may have beside mass, damper and delay, and where a search for each of them starts."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pipeline.measured.ladder.device import Device, Sensor
from pipeline.measured.ladder.search import cost_of, search
from pipeline.measured.ladder.trials import LadderTrials

FEW_STEPS = 4
"""Steps of a search that only shows whether a start is worth more."""

LAGS = (0.3, 2.0)
"""Lags to start from [samples]: within a sample it looks like a delay, beyond it does not."""

TURNS = np.geomspace(0.02, 1.5, 48)
"""Angles of a mode to start from [rad a sample], 10 % apart: 3 to 240 Hz at 1 kHz."""

MODE_TRIALS, MODE_STARTS = 16, 3
"""Trials by which the starts of a mode are compared, and how many of them are followed to their end."""


def _spring(trials: LadderTrials, device: Device) -> list[Device]:
    return [device.having(gamma=1e-6)]


def _force(trials: LadderTrials, device: Device) -> list[Device]:
    return [device.having(force=-float(np.median(trials.level)))]


def _lag(trials: LadderTrials, device: Device) -> list[Device]:
    delay = device.numbers["delay"]
    return [device.having(delay=max(delay - lag, 0.0), lag=lag) for lag in LAGS]


def _friction(trials: LadderTrials, device: Device) -> list[Device]:
    typical = float(np.median(np.abs(trials.command).max(axis=1)))
    return [device.having(coulomb=0.02 * typical)]


def _mode(sensor: Sensor) -> Callable[[LadderTrials, Device], list[Device]]:
    def starts(trials: LadderTrials, device: Device) -> list[Device]:
        """Return the likeliest of many starts, by few trials and without the friction that takes time."""
        some = trials.select(np.unique(np.linspace(0, len(trials) - 1, MODE_TRIALS).astype(np.int64)))
        found = []
        for turn in TURNS:
            start = Device(device.numbers | {"turn": float(np.log(turn)), "ratio": -3.5, "share": -1.7}, sensor)
            quick = search(some, start.without("coulomb"), FEW_STEPS)
            found.append((cost_of(some, quick), Device(device.numbers | quick.numbers, sensor)))
        return [quick for _, quick in sorted(found, key=lambda pair: pair[0])[:MODE_STARTS]]

    return starts


PARTS: dict[str, tuple[tuple[str, ...], Callable[[LadderTrials, Device], list[Device]]]] = {
    "spring": (("gamma",), _spring),
    "force": (("force",), _force),
    "lag": (("lag",), _lag),
    "friction": (("coulomb",), _friction),
    "mode at the motor": (("turn", "ratio", "share"), _mode("motor")),
    "mode at the load": (("turn", "ratio", "share"), _mode("load")),
}
"""Names of the numbers of each part, and the starts of a search for it."""


def parts_of(device: Device) -> tuple[str, ...]:
    """Return the names of a device's parts."""
    found = [name for name, (numbers, _) in PARTS.items() if set(numbers) <= set(device.names)]
    return tuple(name for name in found if not name.startswith("mode") or name == f"mode at the {device.sensor}")


def without(device: Device, part: str) -> Device:
    """Return a device without one of its parts; a lag becomes a delay."""
    left = device.without(*PARTS[part][0])
    if part == "lag":
        left = left.having(delay=device.numbers["delay"] + device.numbers["lag"])
    return left
