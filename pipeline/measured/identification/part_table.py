"""Table of the optional parts of a device, with their parameters and the starting values of the search."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipeline.measured.identification.likelihood import BEFORE, WORTH

Starts = Callable[[dict[str, float]], list[dict[str, float]]]
"""Function that computes starting values for a part from the numbers of the device without the part."""

CLOSER = 20.0
"""Gain of log-likelihood required for each further number of a part, because rounding is not white noise. A mode in
place of a lag of half a sample gained 6 to 38 with two more numbers, whereas a real mode at 300 Hz gained 100."""

NEARBY = (0.86, 0.93, 1.0, 1.07, 1.15)
"""Factors of the best starting value for a second search. Often only one or two rows of each log are clipped."""


@dataclass(frozen=True)
class Part:
    """Optional part of a device.

    Parameters
    ----------
    numbers : tuple of str
        Numbers of the estimator that the part adds.
    starts : callable
        Function that returns candidate values. The search starts at the best candidate.
    size : str
        Name of a number in which the motion is linear and which is 0 without the part, if there is such a number.
    near : str
        Name of the number for which there is a second search near the best start, if there is such a number.
    needs : str
        Name of another part without which this part is not searched for, if there is such a part.
    turning : bool
        Whether only a device that turns may have the part.
    """

    numbers: tuple[str, ...]
    starts: Starts
    size: str = ""
    near: str = ""
    needs: str = ""
    turning: bool = False

    @property
    def threshold(self) -> float:
        """Smallest gain of log-likelihood for which the part is accepted."""
        return WORTH + CLOSER * (len(self.numbers) - 1)


FREQUENCIES = (0.013, 0.018, 0.027, 0.04, 0.06, 0.09, 0.13, 0.2, 0.3, 0.45, 0.7, 1.0, 1.5, 2.2)
"""Initial frequencies [rad/sample] of the search for a mode, with a ratio of about 1.5."""


def _largest_forces(_: dict[str, float]) -> list[dict[str, float]]:
    """Return candidates for the force limit, relative to the largest command."""
    return [{"limit": limit} for limit in (0.1, 0.15, 0.22, 0.33, 0.45, 0.6, 0.75, 0.9)]


def _asymmetries(_: dict[str, float]) -> list[dict[str, float]]:
    """Return candidates for the difference between the gains of the two directions, relative to their mean."""
    return [{"asymmetry": share} for share in (-0.5, -0.2, 0.2, 0.5)]


def _curvatures(_: dict[str, float]) -> list[dict[str, float]]:
    """Return candidates for the share of the force that is missing at the largest command."""
    return [{"curvature": share} for share in (-0.2, 0.1, 0.25)]


def _weights(numbers: dict[str, float]) -> list[dict[str, float]]:
    """Return candidates for gravity, with sizes relative to the largest command and in all directions."""
    turns = np.arange(8) * (np.pi / 4)
    sizes = [share * numbers["gain"] for share in (0.1, 0.3, 0.9)]
    return [
        {"gravity_sine": size * np.cos(turn), "gravity_cosine": size * np.sin(turn)} for size in sizes for turn in turns
    ]


def _lags(numbers: dict[str, float]) -> list[dict[str, float]]:
    """Return candidates for the lag [samples]. Each replaces an equal part of the delay."""
    return [{"lag": lag, "delay": max(numbers["delay"] - lag, 0.0)} for lag in (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)]


def _modes(_: dict[str, float]) -> list[dict[str, float]]:
    """Return candidates for the mode, with a light and with a heavy load."""
    numbers = ("mode_frequency", "mode_damping_ratio", "load_mass_fraction")
    return [dict(zip(numbers, (turn, 0.04, share), strict=True)) for turn in FREQUENCIES for share in (0.05, 0.2)]


def _modes_at_load(numbers: dict[str, float]) -> list[dict[str, float]]:
    """Return candidates for a mode if the position of the load is measured.

    At its resonance, the load lags by a quarter of a period. The candidates therefore include a shorter delay. The lag
    is negligible if the mode is faster.
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
    """Return candidates for the damping that acts on the load."""
    return [{"load_damping": share * numbers["delta"]} for share in (0.2, 0.5, 0.8)]


PARTS: dict[str, Part] = {
    "saturation": Part(("limit",), _largest_forces, near="limit"),
    "gain by direction": Part(("asymmetry",), _asymmetries),
    "gain by size": Part(("curvature",), _curvatures),
    "gravity": Part(("gravity_sine", "gravity_cosine"), _weights, turning=True),
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
"""Parts that forward selection considers. The bounds of their numbers are in `likelihood.LIMITS`."""

DRIVE_PARTS = ("saturation", "gain by direction", "gain by size", "lag")
"""Parts of a drive. A measured force contains their effects."""

OPEN_PARTS = ("gain by direction", "gain by size", "saturation")
"""Parts of a drive that change all parameters per unit of command. They are left open if the likelihood requires them,
but free runs do not confirm them. A lag is not among them, since the delay already includes an unseen lag."""

Decision = Literal[
    "accepted",
    "undecided",
    "imitated",
    "no start",
    "white noise",
    "random force",
    "size",
    "gain",
    "left out",
    "at a limit",
    "command noise",
    "free runs",
    "small errors",
    "no load",
]
"""Result of the test of a part. All except the first two are reasons for a rejection.

``imitated``: another part explains the same motion. ``no start``, ``white noise``, ``random force``: the gain is too
small at the best starting value, with only the measurement noise, or with the random force of the device, respectively.
``size``: the part cannot be distinguished from a part of size 0. ``gain``: the gain is below the required gain. ``left
out``: the gain for logs left out is below the required gain. ``at a limit``: a number of the part is at a limit of its
search. ``command noise``: a force limit would clip only the noise of the command. ``free runs``: the errors of free
runs and the random force do not fall enough. ``small errors``: free runs without the part are as accurate as the
readings. ``no load``: the mass of the load of a mode is not identifiable.
"""


@dataclass(frozen=True)
class TriedPart:
    """Result of the test of a part, with the gain of log-likelihood in the last step of the test, and the required
    gain.

    The gain is NaN if the test ended before a fit with the part.
    """

    decision: Decision
    gain: float
    required: float
