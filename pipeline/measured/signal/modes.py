"""Growth rates of the modes in a free motion, from samples alone (matrix pencil).

A sum of modes z_m^k seen through a window of samples spans as many directions as there are modes. Moving the
window multiplies each direction by its mode, so the moduli of the z_m are eigenvalues, and neither plant nor
controller need be known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pipeline.measured.student import SIGMAS
from pipeline.records.trials import Floats

WINDOW_POINTS = 16
"""Points of a window, more than the modes of a loop with 12 samples of delay; 2,300 trials cost 0.5 s."""

SHORT_WINDOW_POINTS = WINDOW_POINTS // 2
"""Points of a window where the motion lasted for too few samples for `WINDOW_POINTS`."""

FEWEST_SAMPLES = 12
"""Shortest motion: a pair of modes, a drift and as many samples again to check them."""

LARGEST_WINDOWS = 256
"""Windows that a long motion is seen through, evenly spread: more cost time and tell little more."""

DYNAMIC_RANGE = LARGEST_WINDOWS * float(np.finfo(np.float64).eps)
"""Smallest singular value kept relative to the largest, as in `numpy.linalg.matrix_rank`."""

CLEAN_FRACTION = 1e-4
"""Modes below this fraction of the motion at its end are rounding in a signal that few modes explain."""

NOISY_FRACTION = 0.3
"""Modes below this fraction of the motion at its end say nothing about it in a noisy signal."""

WIDE, NARROW = 2, 3
"""Parts of the motion over which a window is spread (a half, a third): two views of a noisy motion."""


UPPER = np.triu(np.ones((WINDOW_POINTS, WINDOW_POINTS)))
"""Of what a decomposition by reflections returns, the part that is R."""


@dataclass(frozen=True)
class Growth:
    """Fastest growing visible mode of a motion; NaN where no mode is visible.

    Parameters
    ----------
    per_sample : float
        ln|z| of that mode; negative where it decays.
    amplitude : float
        Root mean square of that mode at the end of the fit.
    noise : float
        Standard deviation of what the modes do not explain: the noise given, or more where there is more.
    clean : bool
        Whether few modes explain the signal down to rounding.
    """

    per_sample: float
    amplitude: float
    noise: float
    clean: bool


def fastest_growth(signal: Floats, noise: float, window_part: int = WIDE, least_part: float = NOISY_FRACTION) -> Growth:
    """Return the growth of the fastest growing mode that is visible at the end of a free motion.

    Parameters
    ----------
    signal : float64, shape (samples,)
        Motion without a constant part (differences of positions).
    noise : float
        Standard deviation of the noise of the signal, in its unit; rounding for an ideal log.
    window_part : int
        The window is spread over the motion divided by this.
    least_part : float
        Modes below this part of a noisy motion at its end are not looked at.

    Notes
    -----
    The points of one window lie ``stride`` samples apart, and the eigenvalues are z^stride, whose modulus is
    free of aliasing. A signal whose windows span every direction is no sum of few modes (jitter, friction):
    what is left over is taken as its noise. Fewer than `FEWEST_SAMPLES` samples, or a motion below the noise,
    give NaN.

    Examples
    --------
    >>> swing = 0.97 ** np.arange(100) * np.cos(0.3 * np.arange(100))
    >>> growth = fastest_growth(swing, 1e-12)
    >>> bool(np.isclose(growth.per_sample, np.log(0.97))), growth.clean
    (True, True)
    """
    length = len(signal)
    if length < FEWEST_SAMPLES:
        return Growth(np.nan, np.nan, noise, False)
    points = SHORT_WINDOW_POINTS if length < 3 * WINDOW_POINTS else WINDOW_POINTS
    stride = max(length // (window_part * points), 1)
    rows = length - stride * (points - 1)
    row = np.arange(0, rows, max(rows // LARGEST_WINDOWS, 1))
    hankel = signal[row[:, None] + stride * np.arange(points)]
    reflected = np.linalg.qr(hankel, mode="raw")[0].T[:points]
    _, values, right = np.linalg.svd(reflected * UPPER[: len(reflected), :points])
    # of a noise matrix: largest singular value is sigma (sqrt(windows) + sqrt(points)), smallest sigma sqrt(windows)
    spread = np.sqrt(len(row)) + np.sqrt(points)
    level = max(noise * spread * SIGMAS, DYNAMIC_RANGE * values[0])
    left_over = max(noise, float(values[-1] / np.sqrt(len(row))))
    explained = values[-1] <= level
    clean = bool(explained and level < CLEAN_FRACTION * 1e-3 * values[0])
    level = level if explained else left_over * spread * SIGMAS
    rank = min(int((values > level).sum()), points - 1)
    if rank == 0:
        return Growth(np.nan, np.nan, left_over, clean)
    late = hankel[int(np.argmax(row >= 0.75 * rows)) :]
    modulus, size = _modes(right[:rank].T, late)
    end = signal[math.ceil(0.75 * length) :]
    motion = math.sqrt(float(end @ end) / len(end))
    visible = size > max((CLEAN_FRACTION if clean else least_part) * motion, left_over)
    if not visible.any():
        return Growth(np.nan, np.nan, left_over, clean)
    fastest = int(np.argmax(np.where(visible, modulus, 0.0)))
    return Growth(float(np.log(modulus[fastest]) / stride), float(size[fastest]), left_over, clean)


def _modes(basis: Floats, late: Floats) -> tuple[Floats, Floats]:
    """Return modulus and amplitude of the modes of a motion, shape (rank,) each.

    Parameters
    ----------
    basis : float64, shape (points, rank)
        Directions of a window that the modes span.
    late : float64, shape (windows, points)
        Windows at the end of the motion, in which the amplitude is the root mean square at their last point.
    """
    poles, vectors = np.linalg.eig(np.linalg.lstsq(basis[:-1], basis[1:], rcond=None)[0])
    projected = (late @ basis).T
    try:
        parts = np.linalg.solve(vectors, projected)
    except np.linalg.LinAlgError:  # two of the vectors are the same: the smallest amounts
        parts = np.linalg.pinv(vectors) @ projected
    modulus = np.maximum(np.abs(poles), np.finfo(np.float64).tiny)
    at_first = np.sqrt(np.mean(np.abs(parts * (basis[0] @ vectors)[:, None]) ** 2, axis=1))
    return modulus, at_first * modulus ** (len(basis) - 1)
