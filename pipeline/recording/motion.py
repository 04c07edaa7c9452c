"""Response of a free device to its commands at any delay, a negative one included, by linear regression.

A mass m with damping b and a spring k under a command u that acts a delay d later obeys, integrated twice,
m x + b I(x) + k I(I(x)) + c I(I(sign v)) = I(I(u(t - d))) plus a polynomial of the start,
which is linear in all but d.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from pipeline.recording.samples import Samples
from pipeline.records.trials import Floats

BLOCK = 512
"""Rows of a block, each with its start: over more of them friction and other unmodelled forces add up."""

MOST_ROWS = 4096
"""Rows that are used, from shortly before the first change of the command on."""

LARGEST_SHIFT = 128
"""Largest delay, of either sign, that is looked for [rows]."""

FEWEST = 40
"""Rows below which a regression of six numbers and a delay says little."""

AT_NOISE = 3.0
"""Root mean square of what is left, in standard deviations of the noise, of a model that explains a log."""

ARITHMETIC = 1e-9
"""Residual relative to the motion that a polynomial or friction alone leaves of a motion that has nothing else."""

BY_COMMAND = 4.0
"""Residual without a command relative to that with it from which on the command is seen in the motion."""

LIKELY_SHIFT = 40
"""Largest delay, of either sign, at which signs are compared [rows]: by more of them a command may repeat itself."""

BETWEEN = 4.0
"""Residual on the grid of delays relative to that of the other sign up to which both are refined."""

_DEGREE = 2


@dataclass(frozen=True)
class FreeResponse:
    """How the position follows the command of a log without a wall.

    Parameters
    ----------
    delay : float
        Delay of the best fit [rows]; negative where the position comes first.
    gain : float
        Acceleration a unit of command gives [position/row^2]; negative where the signs differ.
    residual : float
        Root mean square of the residual of the best fit.
    residual_causal : float
        The same for the best delay of 0 and more.
    residual_with, residual_against : float
        The same for the best delay of at most `LIKELY_SHIFT` rows, either way, at which the position follows the
        command in its direction, or against it; infinite where there is none.
    residual_undriven : float
        The same without any command: of a motion that starts by itself.
    largest_jump : float
        Largest jump of the command, in the unit of the gain.
    motion : float
        Root mean square of the motion apart from the polynomial of its start.
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
        """Whether nothing but noise is left, so that the device has no part that the regression does not."""
        return self.residual <= AT_NOISE * self.noise

    @property
    def is_driven(self) -> bool:
        """Whether the motion is seen to be that of the command."""
        return self.residual_undriven > BY_COMMAND * self.residual > ARITHMETIC * self.motion


@lru_cache(maxsize=4)
def free_response(samples: Samples) -> FreeResponse | None:
    """Return how the position follows the command; None behind a wall, without a change of command, or in few rows.

    Notes
    -----
    The regression is solved for each delay of a grid; the best one is refined to a sixtieth of a row.
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
    if by_sign[1] < BETWEEN * by_sign[0]:  # between the delays of the grid either may be better
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
    """Return the regression of a log."""
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
    """Return the delay of the smallest residual, of at least so many rows, to a sixtieth of a row, and what is left.

    With a ``sign`` only delays count at which the position follows the command with it.
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
    """A motion in blocks, without what start, damping, spring and friction explain, and the integrals of its command.

    ``position`` and ``basis`` (count, numbers) are projected on what the polynomials of each block leave.
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
        """Return the regression of a motion and its command, shape (rows,); the last ``reach`` rows are not used."""
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
        """Return the twice integrated command at some rows, (delays, blocks, rows), without start, (delays, rows)."""
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
        """Return the root mean square that is left at each delay, and the gain, shape of ``shifts``."""
        driven = self._driven(self.index[None] - shifts[:, None, None])
        driven -= (driven @ self.basis) @ self.basis.T
        power = np.einsum("ij,ij->i", driven, driven)
        product = driven @ self.position
        gain = np.divide(product, power, out=np.zeros(len(shifts)), where=power > 0)
        total = float(self.position @ self.position)
        left = np.maximum(total - gain * product, 0.0)
        return np.sqrt(left / self.count), gain


def _without_start(values: Floats, polynomial: Floats) -> Floats:
    """Return values row by row without the polynomial of each block."""
    length = len(polynomial)
    part = values[: len(values) // length * length].reshape(-1, length)
    return np.asarray((part - (part @ polynomial) @ polynomial.T).ravel())
