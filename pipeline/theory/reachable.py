"""Compute the lowest cost that a delay allows. It is a polynomial in the delay with one factor per criterion.

Source: Hulin 2017, sec. 5.4.2, eqs. 5.19 and 5.20, Table 5.1.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

from pipeline.base.errors import ParameterError
from pipeline.loop.normalised_loop import LARGEST_DELAY
from pipeline.records.criteria import CRITERIA, DISCRETE, ENERGY, SETTLING, criterion_of, is_criterion
from pipeline.theory.optimum import scaling_factor

COST_OF_DELAY = tuple(c.name for c in CRITERIA.values() if c.family in (SETTLING, ENERGY))
"""Criteria whose optimal cost is a power of the delay (Table 5.1). For poles, this is the predicted settling time."""

WITHIN = ((2.0, 0.012), (1.0, 0.026), (0.0, 0.091))
"""Pairs of a smallest delay and the largest relative error of the polynomial for such delays (5.20). A test checks
them."""

SAMPLED = 3.0
"""Factor of these errors for costs of samples only."""


@dataclass(frozen=True)
class Reachable:
    """Lowest cost of any wall at a delay, for a device without damping and spring.

    Parameters
    ----------
    criterion : str
    delay_samples : float
        Delay d [samples].
    cost : float
        (d + 1)^(w + 1) times the factor of the criterion, in samples, or 1 for energies.
    per_sample : float
        Reduction of the cost if the delay is shorter by one sample, in the same unit.
    within : float
        Largest relative error of the cost. Damping and a spring of the device can only lower the optimum.
    """

    criterion: str
    delay_samples: float
    cost: float
    per_sample: float
    within: float


def reachable(criterion: str, delay_samples: float) -> Reachable:
    """Return the lowest cost that a delay allows, for any mass and any stiffness and damping of the wall.

    Parameters
    ----------
    criterion : str
        A settling time such as ``settle_2pct``, an energy such as ``energy_step_w0``, or ``pole_radius``, for the
        settling time that it predicts (5.4).
    delay_samples : float
        Delay d, from 0 to 256.

    Raises
    ------
    ParameterError
        If the criterion is unknown, its optimal cost does not depend on the delay, or the delay is out of range.

    Notes
    -----
    The error is at most about 1 % for delays of at least two samples. The effect of sampling equals that of one more
    sample of delay. The time from command to force plus one sampling period must stay below 20 % of the required
    settling time.

    Source: Hulin 2017, eqs. 5.19 and 5.20, Table 5.1.

    Examples
    --------
    >>> best = reachable("settle_2pct", 4.0)
    >>> round(best.cost, 1), round(best.per_sample, 1), best.within
    (24.5, 4.9, 0.012)
    """
    if not 0 <= delay_samples <= LARGEST_DELAY:
        raise ParameterError(f"delay_samples = {delay_samples}: expected a delay from 0 to {LARGEST_DELAY:g} samples.")
    if not is_criterion(criterion, CRITERIA):
        raise ParameterError(f"criterion {criterion!r} is unknown; expected a settling time, an energy or pole_radius.")
    factor, power = _factor(criterion), criterion_of(criterion).weight + 1
    cost = factor * (delay_samples + 1) ** power
    # for a delay below one sample, this is the saving without the remaining delay
    saved = cost - factor * max(delay_samples, 1.0) ** power
    within = next(error for delay, error in WITHIN if delay_samples >= delay)
    if criterion.endswith(DISCRETE):
        # sampled settling times are integers
        within = max(SAMPLED * within, 1 / cost if criterion_of(criterion).family is SETTLING else 0.0)
    return Reachable(criterion, delay_samples, cost, saved, within)


@lru_cache(maxsize=64)
def _factor(criterion: str) -> float:
    """Return the factor of a criterion from its optimum at a delay of eight samples (Table 5.1)."""
    return scaling_factor(criterion)
