"""Settling time and overshoot of the loop's step response, from the exact motion between samples.

`device.step_response` follows the responses; `march` is quicker for very many points of ideal loops.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.loop import Loop, as_points
from pipeline.records.batch import Floats
from pipeline.theory.device.step_response import Asked, late_sample, step_costs

LONGEST = 1 << 18
"""Samples after which a response that still moves is given up (no settling time): spectral radius about 1 - 1e-5."""

NO_OVERSHOOT = 1e-12
"""Overshoot up to this fraction counts as none. Part of the definition: Hulin 2017, footnote 4 of 5.2.2."""

_FADED = 0.25
"""Motion relative to the largest deviation found below which no larger one follows: the reciprocal of fourfold."""

QUIET = 0.1 * NO_OVERSHOOT
"""Motion below which a response is no longer followed for overshoot, by the same margin."""


def transient_costs(
    loop: Loop,
    alpha: object,
    beta: object,
    bands: Sequence[float] = (0.01, 0.02, 0.05),
    *,
    overshoot: bool = True,
    continuous: bool = True,
    longest: int = LONGEST,
    quiet: float = QUIET,
    cutoff: float = np.inf,
    enough: float = np.inf,
    unfinished_overshoot: bool = False,
) -> dict[str, Floats]:
    """Return settling times and overshoot of the step response of stable points.

    Parameters
    ----------
    loop : Loop
    alpha, beta : array_like, shape (n,)
        Normalised virtual stiffness and damping; stable, alpha + gamma > 0.
    bands : sequence of float
        Half widths of the settling bands relative to the final displacement, in (0, 1).
    overshoot : bool
        Whether the overshoot is asked for; without it responses are followed only until they have settled.
    continuous : bool
        Whether the motion between samples is asked for, besides the samples.
    longest : int
        Samples after which a point that still moves, and of which its modes tell nothing, gets no result.
    quiet : float
        Deviation below which a response without overshoot so far is no longer followed; a map that is only drawn
        does not need the default.
    cutoff : float
        Settling time [samples] from which on a point is of no interest: one still outside all bands then is given
        up. A search knows the best value so far.
    enough : float
        Overshoot above which a point is of no further interest; only for calls without bands.
    unfinished_overshoot : bool
        Whether points that still move after ``longest`` samples get the overshoot found so far instead of none.

    Returns
    -------
    dict of float64, shape (n,)
        ``settle_<band in percent>pct_discrete`` [samples]: smallest k with all samples from k on inside the band;
        ``settle_<..>pct`` [samples]: last entry of the continuous position into the band; ``overshoot`` and
        ``overshoot_discrete``: largest excess over the final position relative to the final displacement, >= 0.
        NaN where the response still moves too much after ``longest`` samples to know; a settling time may be known
        where the overshoot, which has the finer limit, is not.

    Source: Hulin 2017, eqs. 5.10 to 5.12.
    """
    a, b = as_points(alpha, beta)
    if np.any(a + loop.gamma <= 0):
        raise ParameterError("a step response needs alpha + gamma > 0: without stiffness there is no final position.")
    if any(not 0 < band < 1 for band in bands):
        raise ParameterError(f"bands = {list(bands)}: expected fractions between 0 and 1, such as 0.02.")
    asked = Asked(bands, overshoot, continuous, longest, quiet, cutoff, enough, unfinished_overshoot)
    return step_costs(loop, a, b, asked)


def late_deviation(loop: Loop, alpha: object, beta: object, first: int, longest: int) -> Floats:
    """Return the largest deviation of the samples from ``first`` on, relative to the final displacement.

    A discrete settling time of at most ``first`` can be had where this lies inside the band; unlike the settling time
    it is continuous in alpha and beta.

    Parameters
    ----------
    loop : Loop
    alpha, beta : array_like, shape (n,)
        Normalised virtual stiffness and damping; stable, alpha + gamma > 0.
    first : int
        First sample that counts, >= 1.
    longest : int
        Samples after which the largest deviation so far is returned.
    """
    a, b = as_points(alpha, beta)
    return late_sample(loop, a, b, first, longest, _FADED)
