"""Residuals of the free runs of an identified device: by position, by command, over time, and their spectrum."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.measured.identification.recordings import Recording
from pipeline.measured.identification.replay import Replay
from pipeline.records.trials import Booleans, Floats

GROUPS = 24
"""Number of groups into which a range of positions, commands or times is divided."""

FEWEST_ROWS = 8
"""Smallest number of rows of a group, because quartiles of fewer rows depend on single rows."""

LONGEST_PIECE, SHORTEST_PIECE = 1024, 16
"""Largest and smallest number of rows of a piece of a free run from which the spectrum is computed."""

COMMAND_BAND = 0.05, 0.95
"""Shares of the power of the command below the lower and the upper end of its band, which thus contains the middle 90 %
of the power."""


@dataclass(frozen=True, eq=False)
class Residuals:
    """Velocity residuals of all free runs, with the conditions of each row. All arrays have the shape (rows,).

    Parameters
    ----------
    residual : float64
        Measured minus simulated velocity [m/s, rad/s], both smoothed as for `Replay`.
    velocity : float64
        Measured velocity [m/s, rad/s].
    position, command : float64
        Position [m, rad] and command [N, Nm].
    time : float64
        Time since the first replayed row of the log [s].
    """

    residual: Floats
    velocity: Floats
    position: Floats
    command: Floats
    time: Floats

    @classmethod
    def of(cls, replay: Sequence[Replay]) -> Residuals:
        """Return the residuals of replayed logs."""
        parts = [np.empty((5, 0))]
        for each in replay:
            for run in each.windows:
                measured, simulated = run.velocities(each.half)
                inside = slice(each.half, each.half + len(measured))
                since = run.time[inside] - each.windows[0].time[0]
                rows = measured - simulated, measured, run.position[inside], run.command[inside], since
                parts.append(np.stack(rows))
        return cls(*np.concatenate(parts, axis=1))


@dataclass(frozen=True, eq=False)
class Quartiles:
    """Medians and quartiles of groups of values, with the centre of each group. All arrays have the shape (groups,)."""

    centre: Floats
    median: Floats
    low: Floats
    high: Floats

    @classmethod
    def of(cls, values: Floats, at: Floats, ends: tuple[float, float], inside: Booleans | None = None) -> Quartiles:
        """Return the quartiles of values in `GROUPS` groups of equal width along ``at``, between the two ends.

        Groups of fewer than `FEWEST_ROWS` rows are left out. ``inside`` selects rows.
        """
        used = np.ones(len(values), dtype=bool) if inside is None else inside
        edges = np.linspace(*ends, GROUPS + 1)
        group = np.clip(np.searchsorted(edges, at, side="right") - 1, 0, GROUPS - 1)
        rows = []
        for number in range(GROUPS):
            own = values[used & (group == number)]
            if len(own) >= FEWEST_ROWS:
                low, median, high = np.percentile(own, (25, 50, 75))
                rows.append((0.5 * (edges[number] + edges[number + 1]), median, low, high))
        return cls(*np.array(rows, dtype=np.float64).reshape(-1, 4).T)


@dataclass(frozen=True, eq=False)
class Spectra:
    """One-sided power spectral densities of the measured velocity and of its residual [(m/s)²/Hz, (rad/s)²/Hz].

    The frequencies [Hz] and both densities have the shape (frequencies,).
    """

    frequency: Floats
    velocity: Floats
    residual: Floats


def spectra_of(replay: Sequence[Replay]) -> Spectra | None:
    """Return spectra averaged over pieces of equal length of all logs, or None if all logs are too short.

    The free runs of a log are joined. Each piece has the median length of the logs, at most `LONGEST_PIECE` rows, and a
    Hann window.

    Source: Welch 1967, "The use of fast Fourier transform for the estimation of power spectra".
    """
    joined = [both for each in replay if (both := _joined(each)).shape[1] >= SHORTEST_PIECE]
    if not joined:
        return None
    rows = min(int(np.median([both.shape[1] for both in joined])), LONGEST_PIECE)
    window, densities = np.hanning(rows + 2)[1:-1], list[Floats]()
    for both in joined:
        for first in range(0, both.shape[1] - rows + 1, rows):
            piece = both[:, first : first + rows]
            densities.append(np.abs(np.fft.rfft((piece - piece.mean(axis=1, keepdims=True)) * window)) ** 2)
    period = float(np.median([np.median(np.diff(run.time)) for each in replay for run in each.windows]))
    velocity, residual = 2 * period / float(window @ window) * np.mean(densities, axis=0)[:, 1:]
    return Spectra(np.asarray(np.fft.rfftfreq(rows, period)[1:], dtype=np.float64), velocity, residual)


def _joined(each: Replay) -> Floats:
    """Return the measured velocity and the residual of a log, shape (2, rows). At both ends of each free run, they are
    constant."""
    parts = [np.empty((2, 0))]
    for run in each.windows:
        measured, simulated = run.velocities(each.half)
        if len(measured):
            parts.append(np.pad(np.stack([measured, measured - simulated]), ((0, 0), (each.half, each.half)), "edge"))
    return np.concatenate(parts, axis=1)


def command_band(recordings: Sequence[Recording]) -> tuple[float, float] | None:
    """Return the ends of the band [Hz] with the middle 90 % of the power of all commands, after subtraction of their
    means.

    The result is None if no command changes.
    """
    frequencies, powers = list[Floats](), list[Floats]()
    for each in recordings:
        power = np.abs(np.fft.rfft(each.command - each.command.mean())) ** 2 / max(len(each.command), 1)
        frequencies.append(np.asarray(np.fft.rfftfreq(len(each.command), each.period)[1:], dtype=np.float64))
        powers.append(np.asarray(power[1:], dtype=np.float64))
    order = np.argsort(np.concatenate(frequencies), kind="stable")
    frequency, power = np.concatenate(frequencies)[order], np.concatenate(powers)[order]
    largest = max((float(np.abs(each.command).max()) for each in recordings), default=0.0)
    if not power.sum() > np.finfo(np.float64).eps * largest**2:
        return None
    share = np.cumsum(power) / power.sum()
    low, high = (float(frequency[np.searchsorted(share, end)]) for end in COMMAND_BAND)
    return low, high


def shown_replays(replay: Sequence[Replay]) -> list[Replay]:
    """Return the logs with the smallest, the median and the largest fit, in this order, without repetition.

    For an even number of logs, the median is the worse of the two logs in the middle. Logs without a fit are left out.
    """
    fits = sorted((each for each in replay if np.isfinite(each.fit_percent)), key=lambda each: each.fit_percent)
    places = dict.fromkeys((0, (len(fits) - 1) // 2, len(fits) - 1)) if fits else {}
    return [fits[place] for place in places]
