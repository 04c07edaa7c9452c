"""Passive walls behind a delay that is no whole number of samples.

A force that switches inside a sampling interval drives the device at frequencies above the Nyquist frequency, too, so
that (4.6) with a fractional d asks for too little near the origin (1.000 K T for 1.059 K T at d = 1/2) and too much
elsewhere. Summed over all aliases the condition is exact; with a whole d it is (4.6).
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.loop.loop import as_points
from pipeline.records.batch import Floats
from pipeline.theory.stability.passivity import boundary_angle

_ANGLES = 1500
"""Frequencies up to 4 pi/(d + 1), where K decides: the largest need is missed by less than 1e-5 of it."""

_PER_TURN = 32
"""Frequencies per turn of the delay above them, where what is needed for K has fallen and B alone is left."""

_RATIOS = 200
"""Dampings among which the best one is first looked for; `_ROUNDS` of as many between its neighbours follow."""

_ROUNDS = 3


def needed_damping(delay: float, stiffness: object, damping: object) -> Floats:
    """Return the damping that a device must have for a wall to be passive, shape (n,).

    Parameters
    ----------
    delay : float
        Delay factor d, 0 <= d <= 256, whole or not.
    stiffness, damping : array_like, shape (n,)
        K T and B, or in units of any damping: the result has the same unit.

    Raises
    ------
    ParameterError
        If the delay is out of range, or lengths differ.

    Notes
    -----
    b >= max over w of [Re(y S_1) + sqrt(|y|^2 S_0 S_2 - Im^2(y S_1))]/(2 T) with the wall y = (1 - 1/z)(K + B (1 -
    1/z)/T) and, over the aliases w_n = w + 2 pi n/T, S_0 = S_2 = sum 1/w_n^2 and S_1 = sum exp(-i w_n t_d)/w_n^2. As
    a function of t_d the last one is linear between whole samples, since its second derivative vanishes there; so
    S_1 = S_0 G with G = z^-k ((1 - f) + f/z) for d = k + f, and 1 - |G|^2 = 4 f (1 - f) sin^2(w T/2).

    Source: Hulin 2017, eq. 4.6 for whole d; for others ours, after Colgate and Schenkel 1997.
    """
    boundary_angle(delay)  # refuses a delay that is out of range
    k, b = as_points(stiffness, damping)
    whole = math.floor(delay)
    part = delay - whole
    near = min(4 * boundary_angle(delay), np.pi)
    rest = np.linspace(near, np.pi, int(_PER_TURN * (delay + 1)) + 1)[1:]
    w = np.concatenate([np.linspace(0.0, near, _ANGLES + 1)[1:], rest])
    back = np.exp(-1j * w)
    gain = back**whole * ((1 - part) + part * back)
    half = np.sin(0.5 * w) ** 2
    y = (1 - back) * (k[:, None] + b[:, None] * (1 - back))
    real = (y * gain).real
    root = np.sqrt(np.abs(y) ** 2 * (4 * part * (1 - part) * half) + real**2)
    result: Floats = ((real + root) / (8 * half)).max(axis=1)
    return result


def stiffest_passive(delay: float) -> tuple[float, float]:
    """Return the largest passive K T/b and its B/b.

    Raises
    ------
    ParameterError
        If the delay is out of range.

    Notes
    -----
    What a wall needs grows in proportion with K and B together, so that only B/(K T) has to be found.
    """
    low, high = 0.0, 2.0 * (delay + 1)
    for _ in range(_ROUNDS):
        ratio = np.linspace(low, high, _RATIOS + 1)
        need = needed_damping(delay, np.ones_like(ratio), ratio)
        best = int(np.argmin(need))
        low, high = float(ratio[max(best - 1, 0)]), float(ratio[min(best + 1, _RATIOS)])
    return 1 / float(need[best]), float(ratio[best]) / float(need[best])
