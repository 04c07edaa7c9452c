"""Compute settling time, overshoot and rise time of the step response from the exact motion between samples.

Each response is simulated separately until no requested result can change (`march`). A slow response is simulated for
some samples. Its modes then show the time after which it stays inside a band, and whether it may still exceed its peak.
They also move the response to that time (`modes`). A motion is small only if all states of the device are small, so a
node of a beat is not mistaken for its end.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from pipeline.base.constants import Constants
from pipeline.base.errors import ParameterError
from pipeline.loop.normalised_loop import NormalisedLoop, as_points
from pipeline.records.criteria import DISCRETE, OVERSHOOT
from pipeline.records.trials import Floats, Integers
from pipeline.theory import march, modes
from pipeline.theory.march import Arrays
from pipeline.theory.motion import DEGREE, interval_motion, own_basis

LONGEST = 1 << 18
"""Largest number of samples of a response, after which it has no settling time, for a spectral radius of 1 - 1e-5."""

NO_OVERSHOOT = OVERSHOOT.none
"""Largest overshoot, as a fraction, that is not an overshoot by definition (Hulin 2017, footnote 4 of 5.2.2)."""

QUIET = 0.1 * NO_OVERSHOOT
"""Threshold for the motion of a response. Below it, the response is no longer simulated for overshoot."""

_FIRST, _LOOK = 24, 0.25
"""Number of samples before modes are computed, as a constant and a factor of the squared number of states. A
computation of modes takes about as long."""

_SETTLED = 0.1
"""Threshold for the motion as a share of the band (or of the overshoot). All motion must stay below it for the memory
of the loop."""

_FADED = 0.25
"""Threshold for the motion as a share of the largest deviation from a sample onward. All motion must stay below it for
the memory of the loop."""

_ENTRIES = 1 << 22
"""Number of eigenvector entries that are computed together."""


def transient_costs(
    loop: NormalisedLoop,
    alpha: object,
    beta: object,
    bands: Sequence[float] = (0.01, 0.02, 0.05),
    *,
    overshoot: bool = True,
    continuous: bool = True,
    longest: int = LONGEST,
    quiet: float = QUIET,
    cutoff: float | Floats = np.inf,
    unfinished_overshoot: bool = False,
) -> dict[str, Floats]:
    """Return the settling times and overshoots of the step responses of stable points.

    Parameters
    ----------
    loop : NormalisedLoop
    alpha, beta : array_like, shape (n,)
        Normalised virtual stiffness and damping. Points must be stable with alpha + gamma > 0.
    bands : sequence of float
        Half-widths of the settling bands relative to the final displacement, in (0, 1).
    overshoot : bool
        Whether the overshoot is requested. Without it, responses are simulated only until they have settled.
    continuous : bool
        Whether the motion between samples is requested in addition to the samples.
    longest : int
        Largest number of samples. A point has no result if it still moves after them and its modes are inconclusive.
    quiet : float
        Deviation below which a response without overshoot so far is no longer simulated. A map for a figure needs less
        accuracy than the default.
    cutoff : float, or float64 of shape (n,)
        Settling time [samples] above which a point is irrelevant, e.g. the best value of a search so far. The
        simulation of a response ends at this time if it is outside all bands. Without bands, it is an overshoot.
    unfinished_overshoot : bool
        Whether points that still move after ``longest`` samples have the overshoot up to this time instead of none.

    Returns
    -------
    dict of float64, shape (n,)
        ``settle_<band in percent>pct_discrete`` [samples] is the smallest k for which all samples from k onward are
        inside the band. ``settle_<..>pct`` [samples] is the last entry of the continuous position into the band.
        ``overshoot`` and ``overshoot_discrete`` are the largest excess over the final position relative to the final
        displacement, >= 0. A cost is NaN if the response still moves too much after ``longest`` samples. The settling
        time may be known although the overshoot, which has a finer limit, is not.

    Source: Hulin 2017, eqs. 5.10 to 5.12.
    """
    a, b = as_points(alpha, beta)
    if np.any(a + loop.gamma <= 0):
        raise ParameterError("step responses require alpha + gamma > 0: without stiffness, there is no final position.")
    if any(not 0 < band < 1 for band in bands):
        raise ParameterError(f"bands = {list(bands)}: expected fractions between 0 and 1, such as 0.02.")
    rule = np.array(bands, dtype=np.float64), overshoot, continuous, _memory(loop), _SETTLED, quiet
    cutoffs = np.full(len(a), cutoff, dtype=np.float64)
    costs, status = _followed(loop, (a, b), (rule, cutoffs), longest)
    if not unfinished_overshoot:
        costs[status & march.UNFINISHED > 0, len(bands) :: len(bands) + 1] = np.nan
    names = [f"settle_{100 * band:g}pct" for band in bands] + ["overshoot"]
    columns = dict(zip([f"{name}{kind}" for kind in (DISCRETE, "") for name in names], costs.T, strict=True))
    wanted = names[: len(names) - (not overshoot)]
    return {f"{name}{kind}": columns[f"{name}{kind}"] for kind in ("", DISCRETE)[not continuous :] for name in wanted}


def late_deviation(loop: NormalisedLoop, alpha: object, beta: object, first: object, longest: int) -> Floats:
    """Return the largest deviation of the samples from ``first`` onward, relative to the final displacement.

    A discrete settling time of at most ``first`` is possible if this deviation is inside the band. Unlike the settling
    time, it is continuous in alpha and beta.

    Parameters
    ----------
    loop : NormalisedLoop
    alpha, beta : array_like, shape (n,)
        Normalised virtual stiffness and damping. Points must be stable with alpha + gamma > 0.
    first : array_like, shape (n,)
        First sample that is evaluated, at least 1.
    longest : int
        Number of samples after which the largest deviation so far is returned.
    """
    a, b = as_points(alpha, beta)
    largest, since = np.empty(len(a)), np.broadcast_to(np.asarray(first, dtype=np.float64), a.shape).copy()
    interval, requested = interval_motion(loop, False), (since, longest, _memory(loop), _FADED)
    march.late_deviations(interval, _walls(loop, a, b), requested, (largest, _rows(loop, 0), loop.oldest_force))
    return largest


def first_reached(
    loop: NormalisedLoop, alpha: Floats, beta: Floats, levels: Sequence[float], longest: int, between: bool
) -> tuple[Floats, Floats]:
    """Return the times at which a step response first reaches deviations below zero, shape (levels, n), or nan if
    never.

    The first array is for the exact motion (nan unless ``between``), the second one for linearly interpolated samples.
    """
    time = np.empty((2, len(levels), len(alpha)))
    interval, requested = interval_motion(loop, between), (np.array(levels), longest, between)
    march.rises(interval, _walls(loop, alpha, beta), requested, (time, _rows(loop, 0), loop.oldest_force))
    return time[0], time[1]


def _followed(
    loop: NormalisedLoop, walls: tuple[Floats, Floats], limits: tuple[Arrays, Floats], longest: int
) -> tuple[Floats, Integers]:
    """Return costs and status of responses from `march.step_costs`, for the settings of a march and its cutoffs."""
    (alpha, beta), (rule, cutoffs) = walls, limits
    interval, count, n = interval_motion(loop, rule[2]), len(rule[0]), loop.states
    modal = modes.modal(loop)
    costs, status = np.empty((len(alpha), 2 * count + 2)), np.empty(len(alpha), np.int64)
    work, together = (_rows(loop, count), np.empty((n + 3, n), np.complex128)), max(1, _ENTRIES // n**2)
    marched = (longest, max(_FIRST, int(_LOOK * n**2)), modes.STILL_REPRODUCED)
    with np.errstate(all="ignore"):  # NaN modes are inconclusive
        requested = rule, cutoffs, marched
        march.step_costs(
            interval, modal, _walls(loop, *walls), requested, modes.not_given(loop), (costs, status, *work)
        )
        unknown = np.flatnonzero(status == march.NO_MODES)
        for part in (unknown[i : i + together] for i in range(0, len(unknown), together)):
            of_part, results = (alpha[part], beta[part]), (costs[part], status[part])
            requested = rule, cutoffs[part], marched
            given = modes.first_poles(loop), *modes.by_eigenvectors(loop, *of_part)
            march.step_costs(interval, modal, _walls(loop, *of_part), requested, given, (*results, *work))
            costs[part], status[part] = results
    return costs, status


def _walls(loop: NormalisedLoop, alpha: Floats, beta: Floats) -> Arrays:
    """Return alpha and beta of walls, and the constants of their loop (see `march`)."""
    return alpha, beta, _of_walls(loop)


@lru_cache(maxsize=64)
def _of_walls(loop: NormalisedLoop) -> Constants:
    """Return the part of `_walls` that all walls of a loop share.

    The largest effect of an own state on the position is 1, the lever (the longest time [samples] for which a velocity
    acts), or at most half a period of a mode. It is 0 for filters and the last sample.
    """
    basis, inverse = own_basis(loop)
    own, mechanical, (_, _, *outputs) = len(basis), loop.device.mechanical, loop.open_loop
    effects, short = np.zeros((3, own)), np.inf
    effects[0, 0] = effects[1, 1] = 1.0
    if loop.plant.has_mode:
        load = loop.plant.load_mass
        short = 1 / np.sqrt(loop.plant.spring * (1 / (1 - load) + 1 / load))
        effects[0, 2] = effects[2, 3] = abs(loop.device.sensor[2])
    effects[1, mechanical : loop.device.states] = loop.lag
    start = basis @ loop.starts(np.ones(1), "step")[0, :own]
    limits = loop.gamma, 8 * (loop.delay + loop.lag + 1), float(short)
    return Constants((np.array(outputs)[:, :own] @ inverse, effects @ np.abs(inverse), limits, start))


def _rows(loop: NormalisedLoop, bands: int) -> Floats:
    """Return the work array of a march, whose rows are long enough for all of its contents."""
    n = loop.states
    return np.empty((march.ENTRY + bands + n, max(n - loop.oldest_force + 5, n, DEGREE + 1, bands)))


def _memory(loop: NormalisedLoop) -> int:
    """Return the memory of filter and delay in samples."""
    return loop.oldest_force + len(loop.filter_in_z[0]) + 1
