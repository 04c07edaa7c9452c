"""Express velocity filters exactly as ratios of polynomials, in w = (z - 1)/(z + 1) or in powers of 1/z."""

from __future__ import annotations

import math
from decimal import Decimal
from typing import TYPE_CHECKING

import numpy as np

from pipeline.loop.many_digits import Digits, as_exact, bilinear, shifted

if TYPE_CHECKING:  # loading the classes of this module takes longer than a short command
    from pipeline.device.parts import LinearFilter, VelocityFilter


def filter_order(velocity: VelocityFilter | None) -> int:
    """Return the memory of a filter in samples, or 0 for a nonlinear filter."""
    if velocity is not None and velocity.kind == "kalman":
        return 2
    if velocity is not None and (velocity.kind == "foaw" or velocity.kind == "levant"):
        return 0
    if velocity is not None and velocity.kind == "difference":
        return velocity.samples - 1
    if velocity is not None and velocity.kind == "butterworth":
        return velocity.order
    return max(len(velocity.b), len(velocity.a)) - 1 if velocity is not None else 0


def per_sample(velocity: VelocityFilter | None, sampling_period_s: float) -> LinearFilter | None:
    """Return the filter with its cut-off relative to the sampling rate, or None for a difference or nonlinear
    filter."""
    if velocity is None or velocity.kind == "foaw" or velocity.kind == "levant":
        return None
    if velocity.kind == "difference" and velocity.samples == 1:
        return None
    if velocity.kind == "kalman":
        return velocity.coefficients(sampling_period_s)
    if velocity.kind == "butterworth":
        # the class is that of the filter, because its module is not loaded here
        cutoff = velocity.cutoff_hz * sampling_period_s
        return type(velocity)(kind=velocity.kind, order=velocity.order, cutoff_hz=cutoff)
    return velocity


def filter_in_w(velocity: LinearFilter | None) -> tuple[Digits, Digits]:
    """Return numerator and denominator of a velocity filter as polynomials in w of equal degree."""
    if velocity is None:
        return as_exact([1]), as_exact([1])
    if velocity.kind == "butterworth":
        root = Decimal(2).sqrt()
        side = (4 + 2 * root).sqrt()
        by_order: dict[int, list[int | Decimal]] = {
            1: [1, 1],
            2: [1, root, 1],
            3: [1, 2, 2, 1],
            4: [1, side, 2 + root, side, 1],
        }
        edge = Decimal(math.tan(math.pi * velocity.cutoff_hz))
        bottom = as_exact([Decimal(c) / edge**k for k, c in enumerate(by_order[velocity.order])])
        return as_exact([1] + [0] * velocity.order), bottom
    n = filter_order(velocity)
    if velocity.kind == "difference":
        b, a = as_exact([Decimal(1) / velocity.samples] * velocity.samples), as_exact([1])
    else:
        b, a = as_exact(velocity.b), as_exact(velocity.a)
    # reversed polynomials in 1/z = (1 - w)/(1 + w) are polynomials in z divided by z^n
    top, bottom = (bilinear(np.append(c, as_exact([0] * (n + 1 - len(c))))[::-1], n) for c in (b, a))
    return top, bottom


def filter_in_z(velocity: LinearFilter | None) -> tuple[Digits, Digits]:
    """Return numerator and denominator of a velocity filter in powers of 1/z, normalised to a[0] = 1."""
    # since w = (1 - 1/z)/(1 + 1/z), the same substitution gives powers of -1/z
    b, a = (
        bilinear(part, len(part) - 1) * as_exact([(-1) ** k for k in range(len(part))])
        for part in filter_in_w(velocity)
    )
    return b / a[0], a / a[0]


def filter_steps(velocity: LinearFilter | None) -> tuple[Digits, Digits, float, float]:
    """Return a realisation by states s_i: v = b_0 u + s_1 and s_i(k + 1) = keep s_i + rise s_{i+1} + b_i u - a_i v.

    The realisation in powers of 1/z has keep = 0 and rise = 1. It loses all digits for a low cut-off frequency, whose
    poles are close to z = 1. A Butterworth filter is therefore realised in powers of z - 1, with states in units of the
    cut-off.
    """
    b, a = filter_in_z(velocity)
    if velocity is None or velocity.kind != "butterworth":
        return b, a, 0.0, 1.0
    n = len(a) - 1
    moved = [shifted(part[::-1], 1) for part in (b, a)]  # in powers of z - 1, lowest first
    rise = float(abs(moved[1][0])) ** (1 / n)
    unit = as_exact([1, *(Decimal(rise) ** (i - 1) for i in range(1, n + 1))])
    return moved[0][::-1] / unit, moved[1][::-1] / unit, 1.0, rise
