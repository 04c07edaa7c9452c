"""The parts that a device may have beside mass, damper and delay, and where a search for each of them starts."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pipeline.measured.ladder.device import Device, Sensor
from pipeline.measured.ladder.search import search
from pipeline.measured.ladder.trials import LadderTrials
from pipeline.records.batch import Floats

FEW_STEPS = 3
"""Steps of a search that only shows whether a start is worth more."""

LAGS = (0.3, 2.0)
"""Lags to start from [samples]: within a sample it looks like a delay, beyond it does not."""

BOUNDS, BELOW = (0.0, 0.3, 0.6), 0.95
"""Shares of the trials whose largest command gives a bound to start from, and how far below it that lies."""

TURNS = np.geomspace(0.02, 1.5, 24)
"""Angles of a mode to start from [rad a sample], 20 % apart, which a step may bridge: 3 to 240 Hz at 1 kHz."""

FAST = np.geomspace(1.2, 4.5, 7)
"""Angles of modes that a lag may be taken for [rad a sample]: 190 to 720 Hz at 1 kHz, which readings hardly show."""

LIGHT, HEAVY = {"share": -1.7}, {"share": 0.0}
"""A far mass to start from, a seventh of all, or a half: what is heavy delays, and the delay is less."""

START_TRIALS, STARTS = 10, 3
"""Trials by which starts are compared, and how many are followed to their end."""


def _spring(trials: LadderTrials, device: Device) -> list[Device]:
    return [device.having(gamma=1e-6)]


def _force(trials: LadderTrials, device: Device) -> list[Device]:
    return [device.having(force=-float(np.median(trials.level)))]


def _lag(trials: LadderTrials, device: Device) -> list[Device]:
    delay = device.numbers["delay"]
    return [device.having(delay=max(delay - lag, 0.0), lag=lag) for lag in LAGS]


def _saturation(trials: LadderTrials, device: Device) -> list[Device]:
    largest = np.abs(trials.command).max(axis=1)
    bounds = BELOW * np.quantile(largest[largest > 0], BOUNDS)
    return [device.having(bound=bound) for bound in np.log(bounds).tolist()]


def _mode(sensor: Sensor, turns: Floats = TURNS) -> Callable[[LadderTrials, Device], list[Device]]:
    def starts(trials: LadderTrials, device: Device) -> list[Device]:
        """Return the likeliest of many starts."""
        numbers = device.numbers
        tried = [
            Device(
                numbers | {"turn": float(np.log(turn)), "ratio": -3.5, **far, "delay": late * numbers["delay"]}, sensor
            )
            for turn in turns
            for far, late in ((LIGHT, 1.0), (HEAVY, 0.5))
        ]
        return likeliest(trials, tried)

    return starts


def likeliest(trials: LadderTrials, starts: list[Device]) -> list[Device]:
    """Return the best of some starts, after a few steps of their search with few trials."""
    if len(starts) <= STARTS:
        return starts
    some = trials.select(np.unique(np.linspace(0, len(trials) - 1, START_TRIALS).astype(np.int64)))
    quick = [search(some, start, FEW_STEPS) for start in starts]
    return [fit.device for fit in sorted(quick, key=lambda fit: fit.cost)[:STARTS]]


PARTS: dict[str, tuple[tuple[str, ...], Callable[[LadderTrials, Device], list[Device]]]] = {
    "spring": (("gamma",), _spring),
    "force": (("force",), _force),
    "lag": (("lag",), _lag),
    "saturation": (("bound",), _saturation),
    "mode at the motor": (("turn", "ratio", "share"), _mode("motor")),
    "mode at the load": (("turn", "ratio", "share"), _mode("load")),
}
"""Names of the numbers of each part, and the starts of a search for it."""

RIVALS = (_mode("motor", FAST),)
"""Starts of what a lag may be the likeness of, for a device without the lag."""

GROUPS = (("spring", "force", "lag"), ("saturation",), ("mode at the motor", "mode at the load"))
"""Parts by the time that they take to look for."""


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
