"""Parts of a device in addition to a mass, a damper and a delay: their numbers, and where they are looked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.measured.identification.likelihood import BEFORE, WORTH

Starts = Callable[[dict[str, float]], list[dict[str, float]]]
"""Numbers from which a search for a part starts, of those of the device without it."""

CLOSER = 20.0
"""Gain of log-likelihood that each number but the first of a part must bring, as rounding is no white noise: a mode in
the place of a lag of half a sample gained 6 to 38 with two more, a real mode at 300 Hz 100."""

NEARBY = (0.86, 0.93, 1.0, 1.07, 1.15)
"""Factors of the best start for a second search: what is clipped is often a row or two of each log."""


@dataclass(frozen=True)
class Part:
    """A part of a device.

    Parameters
    ----------
    numbers : tuple of str
        Numbers of the estimator that it adds.
    starts : callable
        Where they are looked for; the best is where a search starts.
    size : str
        The number, if there is one, that is 0 without the part and in which the motion is linear.
    near : str
        The number, if there is one, that is looked for again near the best start.
    needs : str
        Part without which it is not looked for.
    """

    numbers: tuple[str, ...]
    starts: Starts
    size: str = ""
    near: str = ""
    needs: str = ""

    @property
    def threshold(self) -> float:
        """Gain of log-likelihood from which on there is such a part."""
        return WORTH + CLOSER * (len(self.numbers) - 1)


FREQUENCIES = (0.06, 0.09, 0.13, 0.2, 0.3, 0.45, 0.7, 1.0, 1.5, 2.2)
"""Frequencies [rad a sample] from which a mode is looked for, a factor of 1.5 apart."""


def _largest_forces(_: dict[str, float]) -> list[dict[str, float]]:
    """Return largest forces, relative to the largest command."""
    return [{"limit": limit} for limit in (0.1, 0.15, 0.22, 0.33, 0.45, 0.6, 0.75, 0.9)]


def _lags(numbers: dict[str, float]) -> list[dict[str, float]]:
    """Return lags [samples] each of which the next one resembles, in the place of as much of the delay."""
    return [{"lag": lag, "delay": max(numbers["delay"] - lag, 0.0)} for lag in (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)]


def _modes(_: dict[str, float]) -> list[dict[str, float]]:
    """Return modes with a light and a heavy load."""
    numbers = ("mode_frequency", "mode_damping_ratio", "load_mass_fraction")
    return [dict(zip(numbers, (turn, 0.04, share), strict=True)) for turn in FREQUENCIES for share in (0.05, 0.2)]


def _modes_at_load(numbers: dict[str, float]) -> list[dict[str, float]]:
    """Return modes whose load is read.

    Where such a mode vibrates most the load is a quarter of a period late; a faster one is hardly late at all.
    """
    share = BEFORE["spring_damping_fraction"][0]
    modes = [
        {"mode_frequency": turn, "mode_damping_ratio": 0.04, "spring_damping_fraction": share}
        for turn in FREQUENCIES
        if turn <= 1
    ]
    late = [{"delay": max(numbers["delay"] - np.pi / 2 / each["mode_frequency"], 0.0)} for each in modes]
    return modes + [mode | each for mode, each in zip(modes, late, strict=True)]


def _load_dampings(numbers: dict[str, float]) -> list[dict[str, float]]:
    """Return parts of the damping that act on the load."""
    return [{"load_damping": share * numbers["delta"]} for share in (0.2, 0.5, 0.8)]


PARTS: dict[str, Part] = {
    "saturation": Part(("limit",), _largest_forces, near="limit"),
    "lag": Part(("lag",), _lags, size="lag"),
    "mode": Part(
        ("mode_frequency", "mode_damping_ratio", "load_mass_fraction"),
        _modes,
        size="load_mass_fraction",
        near="mode_frequency",
    ),
    "mode at the load": Part(
        ("mode_frequency", "mode_damping_ratio", "spring_damping_fraction"), _modes_at_load, near="mode_frequency"
    ),
    "load damping": Part(("load_damping",), _load_dampings, size="load_damping", needs="mode"),
}
"""Parts that forward selection looks for; bounds of their numbers are in `likelihood.LIMITS`."""
