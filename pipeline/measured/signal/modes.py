"""Growth rates of the modes in a free motion, from samples alone (matrix pencil, vectorised over trials).

A sum of modes z_m^k seen through a window of samples spans as many directions as there are modes. Moving the
window multiplies each direction by its mode, so the moduli of the z_m are eigenvalues, and neither plant nor
controller need be known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.measured.student import SIGMAS
from pipeline.records.batch import Booleans, Floats, Integers

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


@dataclass(frozen=True, eq=False)
class Growth:
    """Fastest growing visible mode of each trial, shape (n,); NaN where no mode is visible.

    Parameters
    ----------
    per_sample : float64
        ln|z| of that mode; negative where it decays.
    amplitude : float64
        Root mean square of that mode at the end of the fit.
    noise : float64
        Standard deviation of what the modes do not explain: the noise given, or more where there is more.
    clean : bool
        Whether few modes explain the signal down to rounding.
    """

    per_sample: Floats
    amplitude: Floats
    noise: Floats
    clean: Booleans


def fastest_growth(
    signal: Floats, length: Integers, noise: Floats, window_part: int = WIDE, least_part: float = NOISY_FRACTION
) -> Growth:
    """Return the growth of the fastest growing mode that is visible at the end of a free motion.

    Parameters
    ----------
    signal : float64, shape (n, N)
        Motion without a constant part (differences of positions); what lies beyond ``length`` is not read.
    length : int64, shape (n,)
        Number of samples of each trial.
    noise : float64, shape (n,)
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
    """
    n = len(signal)
    per_sample, amplitude, left_over = np.full(n, np.nan), np.full(n, np.nan), noise.copy()
    clean = np.zeros(n, dtype=np.bool_)
    for points, chosen in (
        (SHORT_WINDOW_POINTS, (length >= FEWEST_SAMPLES) & (length < 3 * WINDOW_POINTS)),
        (WINDOW_POINTS, length >= 3 * WINDOW_POINTS),
    ):
        index = np.flatnonzero(chosen)
        if len(index):
            found = _grow(signal[index], length[index], noise[index], points, window_part, least_part)
            per_sample[index], amplitude[index], left_over[index], clean[index] = found
    return Growth(per_sample, amplitude, left_over, clean)


def _solved(vectors: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the amounts of eigenvectors in some columns; the smallest where two of a trial's vectors are the same."""
    try:
        return np.linalg.solve(vectors, right)
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.pinv(vectors) @ right)


def _grow(
    signal: Floats, length: Integers, noise: Floats, points: int, window_part: int, least_part: float
) -> tuple[Floats, Floats, Floats, Booleans]:
    stride = np.maximum(length // (window_part * points), 1)
    rows = length - stride * (points - 1)
    hop = np.maximum(rows // LARGEST_WINDOWS, 1)
    windows = -(-rows // hop)
    row = np.arange(int(windows.max()))[None, :] * hop[:, None]
    inside = row < rows[:, None]
    begin = row + signal.shape[1] * np.arange(len(signal))[:, None]
    # a window beyond the motion may reach into another trial's: it is set to 0
    hankel = signal.ravel().take(begin[:, :, None] + (stride[:, None] * np.arange(points))[:, None, :], mode="clip")
    hankel *= inside[:, :, None]
    _, values, right = np.linalg.svd(np.linalg.qr(hankel, mode="r"))
    # of a noise matrix: largest singular value is sigma (sqrt(windows) + sqrt(points)), smallest sigma sqrt(windows)
    spread = np.sqrt(windows) + np.sqrt(points)
    level = np.maximum(noise * spread * SIGMAS, DYNAMIC_RANGE * values[:, 0])
    clean = (values[:, -1] <= level) & (level < CLEAN_FRACTION * 1e-3 * values[:, 0])
    left_over = np.maximum(noise, values[:, -1] / np.sqrt(windows))
    level = np.where(values[:, -1] <= level, level, left_over * spread * SIGMAS)
    rank = np.minimum((values > level[:, None]).sum(axis=1), points - 1)
    at_end = (np.arange(signal.shape[1])[None, :] >= (0.75 * length)[:, None]) & (
        np.arange(signal.shape[1])[None, :] < length[:, None]
    )
    motion = np.sqrt(np.where(at_end, signal**2, 0.0).sum(axis=1) / np.maximum(at_end.sum(axis=1), 1))
    visible = np.maximum(np.where(clean, CLEAN_FRACTION, least_part) * motion, left_over)
    rate, amplitude = np.full(len(signal), np.nan), np.full(len(signal), np.nan)
    last_quarter = inside & (row >= (0.75 * rows)[:, None])
    for r in np.unique(rank[rank > 0]):
        index = np.flatnonzero(rank == r)
        basis = np.swapaxes(right[index, :r, :], 1, 2)
        shifted = np.linalg.pinv(basis[:, :-1]) @ basis[:, 1:]
        poles, vectors = np.linalg.eig(shifted)
        late = last_quarter[index]
        since = int(np.argmax(late.any(axis=0)))
        late = late[:, since:]
        course = hankel[index, since:] @ basis
        parts = np.swapaxes(_solved(vectors, np.swapaxes(course, 1, 2).astype(np.complex128)), 1, 2)
        first_point = (basis[:, :1] @ vectors)[:, 0, :]
        squares = np.where(late[:, :, None], np.abs(parts * first_point[:, None, :]) ** 2, 0.0)
        at_row = np.sqrt(squares.sum(axis=1) / late.sum(axis=1)[:, None])
        modulus = np.maximum(np.abs(poles), np.finfo(np.float64).tiny)
        size = at_row * modulus ** (points - 1)
        growth = np.where(size > visible[index][:, None], np.log(modulus) / stride[index][:, None], -np.inf)
        pick = (np.arange(len(index)), np.argmax(growth, axis=1))
        rate[index] = np.where(np.isfinite(growth[pick]), growth[pick], np.nan)
        amplitude[index] = np.where(np.isfinite(growth[pick]), size[pick], np.nan)
    return rate, amplitude, left_over, clean
