"""Rules of thumb beside the exact optima: continuous-time damping, Ziegler-Nichols, polynomial cost approximation.

Also the extreme points of the stable region, which like the Ziegler-Nichols point have no cost.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.loop import Loop
from pipeline.records.batch import Floats
from pipeline.records.criteria import OVERSHOOT, criterion_of
from pipeline.theory.cost.poles import pole_settling_time
from pipeline.theory.optimum.optimum import optimal_point
from pipeline.theory.stability.boundary import boundary

POINT_CRITERIA = ("alpha_max", "beta_max", "ziegler_nichols")
"""Points of the plane that are no optimum of a cost."""

REFERENCE_DELAY = 8.0
"""Delay factor at which the scaling factors of Table 5.1 were taken."""


@dataclass(frozen=True)
class MarkedPoint:
    """Normalised stiffness and damping of a point that has no cost."""

    alpha: float
    beta: float


def marked_point(loop: Loop, name: str) -> MarkedPoint:
    """Return the stable point of largest stiffness or damping, or the Ziegler-Nichols point.

    Parameters
    ----------
    loop : Loop
    name : {"alpha_max", "beta_max", "ziegler_nichols"}

    Raises
    ------
    ParameterError
        For another name.

    Notes
    -----
    Ziegler-Nichols for a PI controller of the velocity: critical gain beta_max, at which the loop oscillates with a
    period of T_u = 2 pi/theta samples; 0.45 of it is the gain, T_u/1.2 the time of integration, so
    alpha = 0.54 beta_max/T_u. T_u = 4, 8, 12 for d = 0, 1, 2 without physical stiffness and damping.

    Source: Hulin 2017, secs. 3.4 and 5.3 (Fig. 5.14); Tables C.1 to C.3.
    """
    if name not in POINT_CRITERIA:
        raise ParameterError(f"point {name!r} is unknown; expected one of {list(POINT_CRITERIA)}.")
    border = boundary(loop)
    if name == "alpha_max":
        return MarkedPoint(border.alpha_max, border.beta_at_alpha_max)
    if name == "beta_max":
        return MarkedPoint(border.alpha_at_beta_max, border.beta_max)
    top = np.nanargmax(np.where(np.isnan(border.theta), np.nan, border.beta))
    period = 2 * np.pi / float(border.theta[top])
    return MarkedPoint(0.54 * border.beta_max / period, 0.45 * border.beta_max)


def cost_exponent(criterion: str) -> int:
    """Return the exponent w + 1 with which the optimal cost of a criterion grows with d + 1 (5.19)."""
    return criterion_of(criterion).weight + 1


def optimal_cost(loop: Loop, criterion: str) -> float:
    """Return the cost at the optimum; for the pole radius the settling time it stands for (5.4).

    Raises
    ------
    ParameterError
        For an unknown criterion, and for overshoot and damping ratio, whose optimal costs do not depend on delay.
    """
    if criterion == "damping" or criterion_of(criterion).family is OVERSHOOT:
        raise ParameterError(f"criterion {criterion!r}: its optimal cost does not depend on delay (5.4.2).")
    cost = optimal_point(loop, criterion).cost
    return float(pole_settling_time(cost)[0]) if criterion == "pole_radius" else cost


def scaling_factor(criterion: str, reference: float = REFERENCE_DELAY, gamma: float = 0.0, delta: float = 0.0) -> float:
    """Return the scaling factor of the polynomial cost approximation: optimal cost/(d + 1)^(w + 1) at one delay.

    Parameters
    ----------
    criterion : str
        Pole radius, settling time or energy, responses also with ``_discrete`` appended.
    reference : float
        Delay factor at which the approximation is made exact.
    gamma, delta : float
        Of the device; the table has 0.

    Source: Hulin 2017, eq. 5.19 and Table 5.1.
    """
    return optimal_cost(Loop(gamma, delta, reference), criterion) / (reference + 1) ** cost_exponent(criterion)


def approximate_cost(criterion: str, delay: object, factor: float | None = None) -> Floats:
    """Return the polynomial approximation of the optimal cost: (d + 1)^(w + 1) times the scaling factor.

    Parameters
    ----------
    criterion : str
    delay : array_like, shape (n,)
        Delay factors d >= 0.
    factor : float, optional
        Scaling factor; that of `scaling_factor` if not given.

    Raises
    ------
    ParameterError
        If a delay is negative.

    Notes
    -----
    For gamma = delta = 0, and an upper estimate otherwise (5.5). Off by at most 1.2 % for d >= 2, 2.6 % for d = 1,
    9.1 % for d = 0.

    Source: Hulin 2017, eq. 5.19.
    """
    d = np.atleast_1d(np.asarray(delay, dtype=np.float64))
    if not np.all(d >= 0):
        raise ParameterError("delay: expected numbers that are not negative.")
    scale = scaling_factor(criterion) if factor is None else factor
    return np.asarray((d + 1) ** cost_exponent(criterion) * scale)
