"""Growth rates of the modes in a free motion, from samples alone (matrix pencil).

A sum of modes z_m^k seen through a window of samples spans as many directions as there are modes. Moving the
window multiplies each direction by its mode, so the moduli of the z_m are eigenvalues, and neither plant nor
controller need be known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

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
"""Most windows over a long motion, evenly spread: more cost time and add little."""

DYNAMIC_RANGE = LARGEST_WINDOWS * float(np.finfo(np.float64).eps)
"""Smallest singular value kept relative to the largest, as in `numpy.linalg.matrix_rank`."""

CLEAN_FRACTION = 1e-4
"""Modes below this fraction of the motion at its end are rounding in a signal that few modes explain."""

NOISY_FRACTION = 0.3
"""Modes below this fraction of the motion at its end say nothing about it in a noisy signal."""

WIDE, NARROW = 2, 3
"""Parts of the motion over which a window is spread (a half, a third): two views of a noisy motion."""

NO_MODES = np.empty((0, 0))
"""Directions of a window that no modes span."""

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


@dataclass(frozen=True, eq=False)
class _Windows:
    """Windows of a motion.

    Parameters
    ----------
    values : float64, shape (windows, points)
    late : float64, shape (windows at the end, points)
        Those in which an amplitude is the root mean square at their last point.
    stride : int
        Samples from point to point.
    spread : float
        Largest singular value of noise of 1, sqrt(windows) + sqrt(points); the smallest is some sqrt(windows).
    """

    values: Floats
    late: Floats
    stride: int
    spread: float


@dataclass(frozen=True, eq=False)
class _Span:
    """Directions of a window that modes span.

    Parameters
    ----------
    noise, clean : float, bool
        As of `Growth`.
    basis : float64, shape (points, rank)
        Directions of a window.
    shift : float64, shape (rank, rank)
        What the next point makes of them, whose eigenvalues are the modes.
    """

    noise: float
    clean: bool
    basis: Floats
    shift: Floats


@dataclass(frozen=True, eq=False)
class MotionWindows:
    """A free motion seen through windows of samples, and its modes; what is not asked for is not computed.

    Parameters
    ----------
    signal : float64, shape (samples,)
        Motion without a constant part (differences of positions).
    noise : float
        Standard deviation of the noise of the signal, in its unit; rounding for an ideal log.
    part : int
        A window is spread over the motion divided by this.

    Notes
    -----
    The points of one window lie ``stride`` samples apart, and the eigenvalues are z^stride, whose modulus is
    free of aliasing. A signal whose windows span every direction is no sum of few modes (jitter, friction):
    what is left over is taken as its noise. Fewer than `FEWEST_SAMPLES` samples, or a motion below the noise,
    have no mode.

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

        Modes below ``least_part`` of a noisy motion at its end are not looked at.
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
        # the largest singular value is none of a mode where that of all of them together is not: s_1^4 <= sum s_i^4
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
        shift = np.linalg.lstsq(basis[:-1], basis[1:], rcond=None)[0] if rank else NO_MODES
        return _Span(left_over, clean, basis, shift)

    @cached_property
    def _modes(self) -> tuple[Floats, Floats]:
        """Modulus and amplitude of the modes, shape (rank,) each."""
        basis = self._span.basis
        poles, vectors = np.linalg.eig(self._span.shift)
        projected = (self._windows.late @ basis).T
        try:
            parts = np.linalg.solve(vectors, projected)
        except np.linalg.LinAlgError:  # two of the vectors are the same: the smallest amounts
            parts = np.linalg.pinv(vectors) @ projected
        modulus = np.maximum(np.abs(poles), np.finfo(np.float64).tiny)
        at_first = np.sqrt(np.mean(np.abs(parts * (basis[0] @ vectors)[:, None]) ** 2, axis=1))
        return modulus, at_first * modulus ** (len(basis) - 1)
