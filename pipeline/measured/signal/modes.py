"""Estimate the growth rates of the modes of a free motion from samples (matrix pencil).

A motion is a sum of modes z_m^k. Windows of its samples span as many directions as there are modes. If the windows are
shifted by a sample, each direction is multiplied by its mode. The z_m are therefore eigenvalues of the shift. Neither
plant nor controller need be known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pipeline.measured.student import SIGMAS
from pipeline.records.trials import Floats

WINDOW_POINTS = 16
"""Number of points of a window. It exceeds the number of modes of a loop with 12 samples of delay. 2,300 trials take
0.5 s."""

SHORT_WINDOW_POINTS = WINDOW_POINTS // 2
"""Number of points of a window if the motion has too few samples for `WINDOW_POINTS`."""

FEWEST_SAMPLES = 12
"""Smallest number of samples of a motion: for a pair of modes and a drift, and as many again to check them."""

LARGEST_WINDOWS = 256
"""Largest number of windows of a long motion, spread evenly. More windows cost time and add little information."""

DYNAMIC_RANGE = LARGEST_WINDOWS * float(np.finfo(np.float64).eps)
"""Smallest singular value that is kept, relative to the largest singular value (as in `numpy.linalg.matrix_rank`)."""

CLEAN_FRACTION = 1e-4
"""Threshold for the amplitude of a mode at the end of the motion, relative to the motion, if few modes explain the
signal. Smaller modes are rounding errors."""

NOISY_FRACTION = 0.3
"""Threshold for the amplitude of a mode at the end of the motion, relative to the motion, in a noisy signal. Smaller
modes contain no information."""

WIDE, NARROW = 2, 3
"""Divisors of the length of a motion that give the lengths of its windows (a half and a third), for two views of a
noisy motion."""

SINGULAR = 0.01
"""Threshold for the smallest eigenvalue of a Gram matrix. Below it, the inverse of the matrix increases rounding errors
a hundred times or more."""

NO_MODES = np.empty((0, 0))
"""Empty set of directions, for a window without visible modes."""

UPPER = np.triu(np.ones((WINDOW_POINTS, WINDOW_POINTS)))
"""Mask of the factor R in the result of a Householder decomposition."""


@dataclass(frozen=True)
class Growth:
    """Fastest growing visible mode of a motion. All values are NaN if no mode is visible.

    Parameters
    ----------
    per_sample : float
        ln|z| of the mode; negative if it decays.
    amplitude : float
        Root mean square of the mode at the end of the fit.
    noise : float
        Standard deviation of the residual of all modes, with the given noise as a lower bound.
    clean : bool
        Whether few modes explain the signal up to rounding errors.
    """

    per_sample: float
    amplitude: float
    noise: float
    clean: bool


@dataclass(frozen=True, eq=False)
class _Windows:
    """Windows of a motion.

    Parameters
    ----------
    values : float64, shape (windows, points)
    late : float64, shape (windows at the end, points)
        Windows at the end of the motion. The rms at their last points is the amplitude of a mode.
    stride : int
        Number of samples between points.
    spread : float
        Largest singular value for unit noise, sqrt(windows) + sqrt(points). The smallest singular value is about
        sqrt(windows).
    """

    values: Floats
    late: Floats
    stride: int
    spread: float


@dataclass(frozen=True, eq=False)
class _Span:
    """Directions of a window that the modes span.

    Parameters
    ----------
    noise, clean : float, bool
        As in `Growth`.
    basis : float64, shape (points, rank)
        Directions of a window.
    shift : float64, shape (rank, rank)
        Matrix that maps the directions to the next point. Its eigenvalues are the modes.
    """

    noise: float
    clean: bool
    basis: Floats
    shift: Floats


@dataclass(frozen=True, eq=False)
class MotionWindows:
    """Windows of samples of a free motion, and its modes, which are computed on demand.

    Parameters
    ----------
    signal : float64, shape (samples,)
        Motion without a constant part (differences of positions).
    noise : float
        Standard deviation of the noise of the signal, in its unit. For an ideal log, it is the rounding error.
    part : int
        Divisor of the length of the motion for the length of a window.

    Notes
    -----
    The points of one window are ``stride`` samples apart, and the eigenvalues are z^stride, whose modulus is free of
    aliasing. If the windows of a signal span every direction, the signal is not a sum of few modes (jitter, friction),
    and the residual is treated as noise. A motion of fewer than `FEWEST_SAMPLES` samples, or below the noise, has no
    mode.

    Examples
    --------
    >>> swing = 0.97 ** np.arange(100) * np.cos(0.3 * np.arange(100))
    >>> windows = MotionWindows(swing, 1e-12)
    >>> growth = windows.fastest_growth()
    >>> bool(np.isclose(growth.per_sample, np.log(0.97))), growth.clean, windows.grows
    (True, True, False)
    """

    signal: Floats
    noise: float
    part: int = WIDE

    def fastest_growth(self, least_part: float = NOISY_FRACTION) -> Growth:
        """Return the growth of the fastest growing mode that is visible at the end of the motion.

        Modes below ``least_part`` of a noisy motion at its end are ignored.
        """
        span = self._span
        if not len(span.shift):
            return Growth(np.nan, np.nan, span.noise, span.clean)
        modulus, size = self._modes
        end = self.signal[math.ceil(0.75 * len(self.signal)) :]
        motion = math.sqrt(float(end @ end) / len(end))
        visible = size > max((CLEAN_FRACTION if span.clean else least_part) * motion, span.noise)
        if not visible.any():
            return Growth(np.nan, np.nan, span.noise, span.clean)
        fastest = int(np.argmax(np.where(visible, modulus, 0.0)))
        growth = float(np.log(modulus[fastest]) / self._windows.stride)
        return Growth(growth, float(size[fastest]), span.noise, span.clean)

    @cached_property
    def grows(self) -> bool:
        """Whether any mode grows, visible or not."""
        if len(self.signal) < FEWEST_SAMPLES:
            return False
        windows, spread = self._windows.values, self._windows.spread
        # there is no mode if the largest singular value s_1 is below the noise; s_1 is bounded by s_1^4 <= sum s_i^4
        if np.linalg.norm(windows.T @ windows) <= (self.noise * spread * SIGMAS) ** 2:
            return False
        shift = self._span.shift
        return len(shift) > 0 and bool((np.abs(np.linalg.eigvals(shift)) > 1).any())

    @cached_property
    def _windows(self) -> _Windows:
        length = len(self.signal)
        points = SHORT_WINDOW_POINTS if length < 3 * WINDOW_POINTS else WINDOW_POINTS
        stride = max(length // (self.part * points), 1)
        rows = length - stride * (points - 1)
        step = max(rows // LARGEST_WINDOWS, 1)
        values = self.signal[np.arange(0, rows, step)[:, None] + stride * np.arange(points)]
        spread = math.sqrt(len(values)) + math.sqrt(points)
        return _Windows(values, values[math.ceil(0.75 * rows / step) :], stride, spread)

    @cached_property
    def _span(self) -> _Span:
        noise = self.noise
        if len(self.signal) < FEWEST_SAMPLES:
            return _Span(noise, False, NO_MODES, NO_MODES)
        windows, spread = self._windows.values, self._windows.spread
        points = windows.shape[1]
        reflected = np.linalg.qr(windows, mode="raw")[0].T[:points]
        _, values, right = np.linalg.svd(reflected * UPPER[: len(reflected), :points])
        largest, smallest = float(values[0]), float(values[-1])
        level = max(noise * spread * SIGMAS, DYNAMIC_RANGE * largest)
        left_over = max(noise, smallest / math.sqrt(len(windows)))
        explained = smallest <= level
        clean = explained and level < CLEAN_FRACTION * 1e-3 * largest
        level = level if explained else left_over * spread * SIGMAS
        rank = min(int((values > level).sum()), points - 1)
        basis = right[:rank].T
        return _Span(left_over, clean, basis, _shift(basis) if rank else NO_MODES)

    @cached_property
    def _modes(self) -> tuple[Floats, Floats]:
        """Return the modulus and amplitude of the modes, shape (rank,) each."""
        basis = self._span.basis
        poles, vectors = np.linalg.eig(self._span.shift)
        projected = (self._windows.late @ basis).T
        try:
            parts = np.linalg.solve(vectors, projected)
        except np.linalg.LinAlgError:  # two eigenvectors coincide: use minimum-norm amplitudes
            parts = np.linalg.pinv(vectors) @ projected
        modulus = np.maximum(np.abs(poles), np.finfo(np.float64).tiny)
        at_first = np.sqrt(np.mean(np.abs(parts * (basis[0] @ vectors)[:, None]) ** 2, axis=1))
        return modulus, at_first * modulus ** (len(basis) - 1)


def _shift(basis: Floats) -> Floats:
    """Return the least-squares solution of basis[:-1] shift = basis[1:] for orthonormal columns.

    The Gram matrix of basis[:-1] is I - v v', with the last row v, and its inverse is I + v v'/(1 - v'v).
    """
    last, shift = basis[-1], basis[:-1].T @ basis[1:]
    free = 1 - float(last @ last)
    if free < SINGULAR:
        return np.asarray(np.linalg.lstsq(basis[:-1], basis[1:], rcond=None)[0])
    return shift + np.outer(last / free, last @ shift)
