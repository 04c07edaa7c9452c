"""Estimate the response of a free device to its commands by linear regression, for positive and negative delays.

A mass m with damping b and spring k responds to a command u after a delay d. After double integration, the equation of
motion is m x + b I(x) + k I(I(x)) + c I(I(sign v)) = I(I(u(t - d))) plus a polynomial of the initial state. This
equation is linear in all parameters except d.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from pipeline.recording.samples import Samples
from pipeline.records.trials import Floats

BLOCK = 512
"""Number of rows of a block. Each block has a separate initial state, because friction and other unmodelled forces
accumulate over more rows."""

MOST_ROWS = 4096
"""Largest number of rows that are used, from shortly before the first change of the command."""

LARGEST_SHIFT = 128
"""Largest delay, with either sign, in the search [rows]."""

FEWEST = 40
"""Smallest number of rows for a regression with six parameters and a delay."""

AT_NOISE = 3.0
"""Largest rms residual, in standard deviations of the noise, for which a model explains a log."""

ARITHMETIC = 1e-9
"""Threshold for the residual, relative to the motion, after a fit of a polynomial and friction. Below it, only rounding
errors remain."""

BY_COMMAND = 4.0
"""Threshold for the ratio of the residuals without and with the command. Above it, the motion is attributed to the
command."""

LIKELY_SHIFT = 40
"""Largest absolute delay at which the two signs of the gain are compared [rows]. At longer delays, a periodic command
may match itself."""

BETWEEN = 4.0
"""Largest ratio of the residuals for the two signs of the gain on the delay grid for which both are refined."""

_DEGREE = 2


@dataclass(frozen=True)
class FreeResponse:
    """Response of the position to the command of a log without a wall.

    Parameters
    ----------
    delay : float
        Delay of the best fit [rows]. Negative if the position leads the command.
    gain : float
        Acceleration per unit of command [position/row^2]. Negative if the signs differ.
    residual : float
        Root mean square of the residual of the best fit.
    residual_causal : float
        Root mean square of the residual for the best non-negative delay.
    residual_with, residual_against : float
        Root mean square of the residual if the gain must be positive or must be negative, for the best delay of at most
        `LIKELY_SHIFT` rows with either sign. It is infinite if no delay gives such a gain.
    residual_undriven : float
        Root mean square of the residual without a command, i.e. for a motion due to its initial state only.
    largest_jump : float
        Largest jump of the command, in the unit of the gain.
    motion : float
        Root mean square of the motion after subtraction of the polynomial of its initial state.
    noise : float
        Standard deviation of a reading.
    rows : int
    """

    delay: float
    gain: float
    residual: float
    residual_causal: float
    residual_with: float
    residual_against: float
    residual_undriven: float
    largest_jump: float
    motion: float
    noise: float
    rows: int

    @property
    def is_at_noise(self) -> bool:
        """True if only noise remains. The regression then models all parts of the device."""
        return self.residual <= AT_NOISE * self.noise

    @property
    def is_driven(self) -> bool:
        """True if the command causes the motion."""
        return self.residual_undriven > BY_COMMAND * self.residual > ARITHMETIC * self.motion


@lru_cache(maxsize=4)
def free_response(samples: Samples) -> FreeResponse | None:
    """Return the response of the position to the command, or None for a log with a wall, a constant command, or too few
    rows.

    Notes
    -----
    The regression is solved for each delay of a grid. The best delay is refined to a sixtieth of a row.
    """
    fit = _prepared(samples)
    if fit is None:
        return None
    reach = fit.reach
    coarse = np.unique(np.concatenate([np.arange(-reach, reach + 1, 4.0), np.arange(-6.0, 7.0)]))
    left, signs = fit.residuals(coarse)
    best, causal = _refined(fit, coarse, left, -reach), _refined(fit, coarse, left, 0)
    gain = float(fit.residuals(np.array([best[0]]))[1][0])
    likely = np.abs(coarse) <= LIKELY_SHIFT
    by_sign = [float(left[likely & (sign * signs > 0)].min(initial=np.inf)) for sign in (1, -1)]
    if (
        by_sign[1] < BETWEEN * by_sign[0]
    ):  # between the delays of the grid, either sign of the gain may have the smaller residual
        for place, sign in enumerate((1, -1)):
            own = likely & (sign * signs > 0)
            by_sign[place] = _refined(fit, coarse[own], left[own], -reach, sign)[1] if own.any() else np.inf
    return FreeResponse(
        delay=best[0],
        gain=gain,
        residual=best[1],
        residual_causal=causal[1],
        residual_with=by_sign[0],
        residual_against=by_sign[1],
        residual_undriven=float(np.sqrt(np.mean(fit.position**2))),
        largest_jump=float(np.abs(samples.jumps).max() / np.abs(samples.command).max()),
        motion=fit.size,
        noise=samples.noise,
        rows=fit.count,
    )


def _prepared(samples: Samples) -> _Regression | None:
    """Return the regression of a log, or None if the log is not suitable."""
    if not samples.is_free or not len(samples.jumps) or not samples.jumps.any():
        return None
    first = max(int(np.flatnonzero(samples.jumps)[0]) - LARGEST_SHIFT, 0)
    rows = slice(first, min(first + MOST_ROWS, len(samples)))
    x, u = samples.position[rows], samples.command[rows]
    reach = min(LARGEST_SHIFT, len(x) // 4)
    if len(x) - reach < FEWEST:
        return None
    return _Regression.of(x - x[0], u / np.abs(samples.command).max(), reach)


def _refined(fit: _Regression, shifts: Floats, left: Floats, least: float, sign: int = 0) -> tuple[float, float]:
    """Return the delay with the smallest residual, accurate to a sixtieth of a row, and its residual.

    The delay is at least ``least``. With a ``sign``, only delays at which the gain has this sign are used.
    """
    allowed = shifts >= least
    best, value = float(shifts[allowed][np.argmin(left[allowed])]), float(left[allowed].min())
    for width, step in ((3.0, 1.0), (0.75, 0.25), (0.1875, 0.0625), (0.046875, 0.015625)):
        near = np.unique(np.clip(np.arange(best - width, best + width + step / 2, step), least, None))
        found, gains = fit.residuals(near)
        if sign:
            found = np.where(sign * gains > 0, found, np.inf)
        if found.min() <= value:
            best, value = float(near[np.argmin(found)]), float(found.min())
    return best, value


@dataclass(frozen=True, eq=False)
class _Regression:
    """Regression of a motion, divided into blocks, on the integrals of its command, after removal of initial state,
    damping, spring and friction.

    ``position`` and ``basis`` (count, numbers) are projected onto the complement of the polynomials of each block.
    """

    position: Floats
    basis: Floats
    polynomial: Floats
    index: Floats
    velocity: Floats
    twice: Floats
    command: Floats
    size: float
    reach: int

    @classmethod
    def of(cls, x: Floats, u: Floats, reach: int) -> _Regression:
        """Return the regression of a motion and its command, shape (rows,). The last ``reach`` rows are not used."""
        used = len(x) - reach
        blocks = max(used // BLOCK, 1)
        length = used // blocks
        index = np.arange(blocks * length, dtype=np.float64).reshape(blocks, length)
        t = np.linspace(-1.0, 1.0, length)
        polynomial, _ = np.linalg.qr(np.stack([t**n for n in range(_DEGREE + 1)], axis=1))
        once = np.concatenate([[0.0], np.cumsum(0.5 * (x[1:] + x[:-1]))])
        twice = np.concatenate([[0.0], np.cumsum(0.5 * (once[1:] + once[:-1]))])
        way = np.sign(np.diff(x, prepend=x[0]))
        friction = np.cumsum(np.cumsum(way))

        columns = [_without_start(each, polynomial) for each in (once, twice, friction)]
        columns = [each / norm for each in columns if (norm := float(np.linalg.norm(each))) > 0]
        basis, _ = np.linalg.qr(np.stack(columns, axis=1)) if columns else (np.zeros((blocks * length, 0)), None)
        moved = _without_start(x, polynomial)
        left = moved - basis @ (basis.T @ moved)
        velocity = np.concatenate([[0.0], np.cumsum(u)])
        double = np.concatenate([[0.0], np.cumsum(velocity[:-1] + 0.5 * u)])
        size = float(np.sqrt(np.mean(moved * moved)))
        return cls(left, basis, polynomial, index, velocity, double, u, size, reach)

    def _driven(self, at: Floats) -> Floats:
        """Integrate the command twice, and return it at the fractional rows ``at``, shape (delays, blocks, rows). The
        result has the shape (delays, blocks * rows).

        The part due to the initial position and velocity is removed.
        """
        k = np.clip(np.floor(at).astype(np.int64), 0, len(self.command) - 1)
        part = at - k
        double = self.twice[k] + self.velocity[k] * part + 0.5 * self.command[k] * part * part
        double -= (double @ self.polynomial) @ self.polynomial.T
        return np.asarray(double.reshape(len(at), -1))

    @property
    def count(self) -> int:
        """Number of rows."""
        return len(self.position)

    def residuals(self, shifts: Floats) -> tuple[Floats, Floats]:
        """Return the rms residual and the gain for each delay, both with the shape of ``shifts``."""
        driven = self._driven(self.index[None] - shifts[:, None, None])
        driven -= (driven @ self.basis) @ self.basis.T
        power = np.einsum("ij,ij->i", driven, driven)
        product = driven @ self.position
        gain = np.divide(product, power, out=np.zeros(len(shifts)), where=power > 0)
        total = float(self.position @ self.position)
        left = np.maximum(total - gain * product, 0.0)
        return np.sqrt(left / self.count), gain


def _without_start(values: Floats, polynomial: Floats) -> Floats:
    """Return values row by row, without the polynomial of each block."""
    length = len(polynomial)
    part = values[: len(values) // length * length].reshape(-1, length)
    return np.asarray((part - (part @ polynomial) @ polynomial.T).ravel())
