"""Search for a force limit of a drive, and test whether the commands exceed it by more than their noise."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.measured.identification.first_fit import likelihood_of
from pipeline.measured.identification.first_guess import BALANCED, first_guesses
from pipeline.measured.identification.likelihood import Device
from pipeline.measured.identification.noise import WHITE
from pipeline.measured.identification.recordings import reading_noise
from pipeline.measured.identification.segments import Segments

LIMIT_DELAY, LIMIT_ROWS = 3.0, 4
"""Longest delay [samples] in searches with a clipped command, and number of rows on each side from which a speed is
computed."""

LIMITS_SOUGHT = 0.05, 0.99, 150
"""Smallest and largest limit of the command in the search for a force limit, and number of trial values (2 % apart)."""

CLEARLY, RANDOM_COMMAND = 3.0, 0.3
"""Two thresholds. The first is the smallest rms excess of commands over a force limit, relative to the noise of the
command. The excess of pure noise has an rms of 1. The second is a threshold for the noise of a command, relative to its
standard deviation. Above it, the command itself is random. Independent levels in every row have a noise of about 1, and
the noise of measured currents is below 0.1."""

LIMIT_SPREADS = (0.015, 0.005, 0.0015)
"""Relative steps of the search for a force limit near the best value. The force balances of a ramp far beyond the limit
are accurate only to a percent."""


def exceeds_noise(segments: Segments, limit: float) -> bool:
    """Return whether commands exceed a force limit [units of the command] by more than their noise.

    In a measured command, such as a current, the noise does not drive the device. A limit inside the noise of a plateau
    removes half of the noise, and is more likely than no limit. The noise is estimated from third differences. A
    command that itself changes randomly in every row has no noise in this sense.
    """
    command = segments.command[segments.places]
    noise = reading_noise(command, 0.0)
    beyond = np.abs(command) - limit
    beyond = beyond[beyond > 0]
    if noise > RANDOM_COMMAND * float(np.std(command)) or not len(beyond):
        return True
    return bool(np.sqrt(np.mean(beyond**2)) > CLEARLY * noise)


def saturated(segments: Segments, device: Device) -> Device:
    """Return the most likely device with a force limit, from force balances with a clipped command.

    If most commands exceed the limit, the numbers of a device without a limit are far from the true numbers. The search
    starts at the limit above which the velocity no longer follows the command.
    """
    known = [name for name in (*BALANCED, "delay") if name in device.names]

    def guessed(limit: float) -> tuple[float, Device]:
        clipped = replace(segments, command=np.clip(segments.command, -limit, limit))
        devices = [replace(device, noise=WHITE, effects=None, numbers=device.numbers | {"limit": limit})]
        with suppress(ParameterError):
            for guess in first_guesses(clipped, known, LIMIT_DELAY):
                numbers = devices[0].numbers | {name: guess.numbers[name] for name in known}
                devices.append(replace(devices[0], numbers=numbers))
        return max(((likelihood_of(segments, each), each) for each in devices), key=lambda pair: pair[0])

    best = guessed(_static_limit(segments))
    for reach in LIMIT_SPREADS:
        near = (best[1].numbers["limit"] * (1 + reach * way) for way in (-2, -1, 1, 2))
        best = max([best, *(guessed(limit) for limit in near if limit < 1)], key=lambda pair: pair[0])
    return best[1]


def _static_limit(segments: Segments) -> float:
    """Return the command limit for which the speed is closest to a linear function of the command clipped at this
    limit."""
    ahead = segments.places[LIMIT_ROWS:-LIMIT_ROWS]
    inside = segments.segment[: -2 * LIMIT_ROWS] == segments.segment[2 * LIMIT_ROWS :]
    row = ahead[inside]
    speed = segments.position[row + LIMIT_ROWS] - segments.position[row - LIMIT_ROWS]
    command, limits = segments.command[row], np.geomspace(*LIMITS_SOUGHT)

    def left(limit: float) -> float:
        clipped = np.clip(command, -limit, limit)
        columns = np.stack([clipped, np.sign(speed), np.ones(len(clipped))], axis=1)
        return float(((speed - columns @ np.linalg.lstsq(columns, speed, rcond=None)[0]) ** 2).sum())

    return min(limits.tolist(), key=left) if len(row) else 1.0
