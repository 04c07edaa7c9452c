"""Parts of a device in addition to mass, damper and delay: parameters, and starting values for the search."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.measured.identification.likelihood import BEFORE, WORTH

Starts = Callable[[dict[str, float]], list[dict[str, float]]]
"""Function that returns starting values for a part from the numbers of the device without it."""

CLOSER = 20.0
"""Gain of log-likelihood required for each further number of a part, because rounding is not white noise: a mode
instead of a lag of half a sample gained 6 to 38 with two more numbers, a real mode at 300 Hz gained 100."""

NEARBY = (0.86, 0.93, 1.0, 1.07, 1.15)
"""Factors of the best starting value for a second search: often only a row or two of each log are clipped."""


@dataclass(frozen=True)
class Part:
    """Part of a device.

    Parameters
    ----------
    numbers : tuple of str
        Numbers of the estimator that it adds.
    starts : callable
        Function that returns candidate values; a search starts at the best of them.
    size : str
        The number, if any, that is 0 without the part and in which the motion is linear.
    near : str
        The number, if any, that is searched for again near the best start.
    needs : str
        Part that is required before this one is searched for.
    """

    numbers: tuple[str, ...]
    starts: Starts
    size: str = ""
    near: str = ""
    needs: str = ""

    @property
    def threshold(self) -> float:
        """Smallest gain of log-likelihood for which the part is accepted."""
        return WORTH + CLOSER * (len(self.numbers) - 1)


FREQUENCIES = (0.013, 0.018, 0.027, 0.04, 0.06, 0.09, 0.13, 0.2, 0.3, 0.45, 0.7, 1.0, 1.5, 2.2)
"""Initial frequencies [rad a sample] of the search for a mode, a factor of 1.5 apart."""


def _largest_forces(_: dict[str, float]) -> list[dict[str, float]]:
    """Return candidates of the largest force, relative to the largest command."""
    return [{"limit": limit} for limit in (0.1, 0.15, 0.22, 0.33, 0.45, 0.6, 0.75, 0.9)]


def _asymmetries(_: dict[str, float]) -> list[dict[str, float]]:
    """Return differences of the gains of both directions, relative to their mean."""
    return [{"asymmetry": share} for share in (-0.5, -0.2, 0.2, 0.5)]


def _lags(numbers: dict[str, float]) -> list[dict[str, float]]:
    """Return lags [samples], each similar to the next one, that replace an equal part of the delay."""
    return [{"lag": lag, "delay": max(numbers["delay"] - lag, 0.0)} for lag in (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)]


def _modes(_: dict[str, float]) -> list[dict[str, float]]:
    """Return modes with a light and a heavy load."""
    numbers = ("mode_frequency", "mode_damping_ratio", "load_mass_fraction")
    return [dict(zip(numbers, (turn, 0.04, share), strict=True)) for turn in FREQUENCIES for share in (0.05, 0.2)]


def _modes_at_load(numbers: dict[str, float]) -> list[dict[str, float]]:
    """Return modes whose position is measured at the load.

    At the resonance of such a mode the load lags by a quarter of a period; with a faster mode it hardly lags.
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
    "gain by direction": Part(("asymmetry",), _asymmetries),
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
"""Parts that forward selection considers; bounds of their numbers are in `likelihood.LIMITS`."""
