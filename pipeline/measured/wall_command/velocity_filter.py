"""Identify the velocity filter of a wall law from its input and output.

The input is the change of position dx_k = x_k - x_{k-1} in the log. The output is the filtered change,
T/B (F_k - K (x_k - x_0) - u_k). Both are exact, so the correct filter has no residual.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.base.compiled import compiled
from pipeline.device.parts import Butterworth, Coefficients, Difference, VelocityFilter
from pipeline.measured.wall_command.log_rows import SET_DIGITS
from pipeline.records.trials import Booleans, Floats

HIGHEST_ORDER = 4
"""Largest order of a recursive velocity filter in the search. The thesis and drives use 1 or 2."""

LONGEST_WINDOW = 64
"""Largest number of samples of a difference or of an adaptive window in the search."""

ROUNDED_CUTOFF = 2.0
"""Largest residual, in rounding units, of a filter with a cut-off of `SET_DIGITS` digits."""

FITTED_ROWS = 400
"""Number of rows from the edge to which a filter is fitted. Ten rows are sufficient, since there is no noise."""


@dataclass(frozen=True)
class VelocityFilterFound:
    """Filter b(z)/a(z) of the backward difference, with a[0] = 1.

    ``difference`` is N for a mean over N samples. ``cutoff_hz`` is the cut-off frequency of a Butterworth filter.
    """

    b: tuple[float, ...]
    a: tuple[float, ...] = (1.0,)
    difference: int | None = None
    cutoff_hz: float | None = None

    @property
    def free(self) -> int:
        """Number of free parameters. A mean over samples has none, and a Butterworth filter has one (the cut-off)."""
        return 0 if self.difference else 1 if self.cutoff_hz else len(self.a) + len(self.b) - 2

    @property
    def declared(self) -> VelocityFilter:
        """Filter as declared in a device file."""
        if self.difference:
            return Difference(kind="difference", samples=self.difference)
        if self.cutoff_hz:
            return Butterworth(kind="butterworth", order=len(self.a) - 1, cutoff_hz=self.cutoff_hz)
        return Coefficients(kind="coefficients", b=self.b, a=self.a)

    def gain(self, angles: Floats) -> NDArray[np.complex128]:
        """Return the complex gain at the given frequencies [rad/sample]."""
        from numpy.polynomial.polynomial import polyval

        delay = np.exp(-1j * angles)
        # a pole may equal 1 up to rounding
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(polyval(delay, self.b) / polyval(delay, self.a))

    def words(self) -> str:
        """Return a phrase that describes the effect of the filter on the velocity."""
        if self.difference:
            return f"is the mean over {self.difference} samples"
        order = len(self.a) - 1
        if self.cutoff_hz:
            return f"has a Butterworth filter of order {order}, {self.cutoff_hz:.4g} Hz"
        return f"has a recursive filter of order {order}"


def find_filter(
    change: Floats, output: Floats, rows: Booleans, tolerance: Floats, sampling_period_s: float
) -> VelocityFilterFound | None:
    """Return the filter from a change of position to its filtered value, or None if no filter explains the rows.

    Parameters
    ----------
    change, output : float64, shape (N,)
        Change of position dx, and the value that the wall law uses instead [m, rad]. Both start at rest.
    rows : bool, shape (N,)
        Rows with a known output, i.e. with a command that is not clipped.
    tolerance : float64, shape (N,)
        Rounding error of the output [m, rad].
    sampling_period_s : float
        T [s].

    Notes
    -----
    At constant speed, a filter returns this speed, because its static gain is 1. A different static gain means that the
    wall law differs.
    """
    result = _difference(change, output, rows, tolerance) or _recursive(change, output, rows, tolerance)
    if result is None or result.difference:
        return result
    return _butterworth(change, output, rows, result, tolerance, sampling_period_s) or result


def _difference(change: Floats, output: Floats, rows: Booleans, tolerance: Floats) -> VelocityFilterFound | None:
    displacement = np.cumsum(change)
    for samples in range(2, min(LONGEST_WINDOW, len(output) - 1) + 1):
        mean = (displacement - _delayed(displacement, samples)) / samples
        if (np.abs(output - mean) <= tolerance)[rows].all():
            return VelocityFilterFound((1 / samples,) * samples, difference=samples)
    return None


def _recursive(change: Floats, output: Floats, known: Booleans, tolerance: Floats) -> VelocityFilterFound | None:
    """Return the filter of lowest order with y_k - dx_k = sum a_i (dx_k - y_{k-i}) + sum b_j (dx_{k-j} - dx_k).

    This is the equation of a filter with a static gain of 1, b_0 = 1 + sum a_i - sum b_j.
    """
    for order in range(1, HIGHEST_ORDER + 1):
        back = range(1, order + 1)
        terms = np.stack(
            [change - _delayed(output, i) for i in back] + [_delayed(change, j) - change for j in back], axis=1
        )
        unknown = np.any([_delayed((~known).astype(np.float64), i) > 0 for i in (0, *back)], axis=0)
        rows = np.flatnonzero(~unknown)
        if len(rows) < 4 * terms.shape[1] or (np.abs(output - change) <= tolerance)[rows].all():
            return None
        # weight each row by its resolution
        fitted = rows[rows >= np.argmax(change != 0)][:FITTED_ROWS]
        if not len(fitted):  # all known rows lie before the motion
            return None
        error_sizes = tolerance[fitted]
        coefficients = least_squares(terms[fitted] / error_sizes[:, None], (output - change)[fitted] / error_sizes)
        error = np.abs(terms @ coefficients - (output - change))
        feedback, forward = coefficients[:order], coefficients[order:]
        a, b = (1.0, *feedback.tolist()), (float(1 + feedback.sum() - forward.sum()), *forward.tolist())
        # one rounding unit in each term of the sum
        allowed = (1 + abs(b[0])) * tolerance + sum((abs(a[i]) + abs(b[i])) * _delayed(tolerance, i) for i in back)
        if (error <= allowed)[rows].all() and np.abs(np.roots(a)).max(initial=0.0) < 1:
            return VelocityFilterFound(b, a)
    return None


def _butterworth(
    change: Floats, output: Floats, rows: Booleans, near: VelocityFilterFound, tolerance: Floats, period: float
) -> VelocityFilterFound | None:
    """Return a Butterworth filter near a recursive filter, of equal or higher order, or None if none explains all rows.

    For low cut-off frequencies, the equations of a recursive filter are ill-conditioned, so a filter of lower order
    also explains the rows. A simulation of the filter along the log avoids this.
    """
    from scipy.optimize import minimize_scalar

    angles = np.linspace(0.0, np.pi, 2048, endpoint=False)
    gain = np.abs(near.gain(angles))
    below = np.flatnonzero(gain < np.sqrt(0.5) * gain[0])
    if not len(below) or below[0] == 0:
        return None
    nyquist, middle = 0.5 / period, float(np.log(angles[below[0]] / np.pi))
    bounds = (middle - np.log(2.0), min(middle + np.log(2.0), 0.0))

    def error(logarithm: float, order: int) -> float:
        output_of = filtered(*butterworth(order, min(np.exp(logarithm), 1 - 1e-9)), change)
        return float((np.abs(output_of - output) / tolerance)[rows].max(initial=0.0))

    for order in range(len(near.a) - 1, HIGHEST_ORDER + 1):
        best = minimize_scalar(error, bounds=bounds, args=(order,), method="bounded", options={"xatol": 1e-10})
        exact = np.exp(best.x) * nyquist
        for cutoff in (float(f"{exact:.{SET_DIGITS}g}"), float(f"{exact:.8g}")):
            if error(np.log(cutoff / nyquist), order) <= ROUNDED_CUTOFF:
                b, a = butterworth(order, cutoff / nyquist)
                return VelocityFilterFound(tuple(b.tolist()), tuple(a.tolist()), cutoff_hz=cutoff)
    return None


def butterworth(order: int, cutoff: float) -> tuple[Floats, Floats]:
    """Return b and a of a Butterworth low-pass filter from the bilinear transform, prewarped at the cut-off.

    The cut-off is relative to half the sampling frequency.

    Examples
    --------
    >>> b, a = butterworth(1, 0.5)
    >>> b.round(3).tolist(), (a.round(3) + 0.0).tolist()
    ([0.5, 0.5], [1.0, 0.0])
    """
    poles = -np.tan(0.5 * np.pi * cutoff) * np.exp(0.5j * np.pi * np.arange(1 - order, order, 2) / order)
    gain = float(np.prod(-poles / (1 - poles)).real)
    b = gain * np.array([math.comb(order, i) for i in range(order + 1)])
    return b, np.asarray(np.poly((1 + poles) / (1 - poles)).real, np.float64)


def filtered(b: Sequence[float] | Floats, a: Sequence[float] | Floats, x: Floats) -> Floats:
    """Return the response of a filter b(z)/a(z), with a[0] = 1, to a signal (N,) from rest.

    Examples
    --------
    >>> filtered([0.5, 0.5], [1.0], np.array([1.0, 1.0, 0.0])).tolist()
    [0.5, 1.0, 0.5]
    """
    order = max(len(b), len(a))
    padded = [np.append(part, np.zeros(order - len(part))) for part in (b, a)]
    return _filtered(padded[0], padded[1], np.ascontiguousarray(x))


@compiled("f8[::1](f8[::1], f8[::1], f8[::1])")
def _filtered(b: Floats, a: Floats, x: Floats) -> Floats:
    """Return y = b(z)/a(z) x, shape (N,): y_k = b_0 x_k + z_0, z_i = z_{i+1} + b_{i+1} x_k - a_{i+1} y_k.

    ``b`` and ``a`` have the same length, and a[0] = 1.

    Source: Oppenheim and Schafer, Discrete-Time Signal Processing, transposed direct form II.
    """
    y = np.empty_like(x)
    z = np.zeros(len(b))
    for k in range(len(x)):
        y[k] = b[0] * x[k] + z[0]
        for i in range(len(b) - 1):
            z[i] = z[i + 1] + b[i + 1] * x[k] - a[i + 1] * y[k]
    return y


def least_squares(terms: Floats, values: Floats) -> Floats:
    """Return the coefficients of terms (N, terms) whose sum is closest to the values, or 0 for a term of zeros."""
    size = np.abs(terms).max(axis=0)
    size[size == 0] = 1.0
    result: Floats = np.linalg.lstsq(terms / size, values, rcond=None)[0] / size
    return result


def _delayed(values: Floats, samples: int) -> Floats:
    """Return values delayed by some samples, with 0 before the log."""
    return np.concatenate([np.zeros(samples), values[: len(values) - samples]]) if samples else values
