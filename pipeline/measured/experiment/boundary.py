"""Measured stability boundary: per damping, smallest unstable stiffness and largest stable one below it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from pipeline.base.errors import ParameterError
from pipeline.records.batch import Booleans, Floats, Integers
from pipeline.records.findings import BoundaryPoint


def measured_boundary(
    stiffness: Floats, damping: Floats, verdict: Sequence[str] | ArrayLike
) -> tuple[BoundaryPoint, ...]:
    """Return the boundary points of an experiment, ordered by damping.

    Parameters
    ----------
    stiffness, damping : float64, shape (n,)
        Virtual stiffness K [N/m, Nm/rad] and damping B [Ns/m, Nms/rad] of the trials.
    verdict : array of str, shape (n,)
        ``stable``, ``unstable`` or ``undecided``; the last is no evidence for either, and counted below a stable one.

    Returns
    -------
    tuple of BoundaryPoint
        One for each damping with trials at K > 0; censored where none of them is unstable.

    Raises
    ------
    ParameterError
        If the arrays differ in length.

    Notes
    -----
    A pair (K, B) that was tried several times is unstable if it was unstable once. Trials at K <= 0 are no
    boundary points: K = 0 tells the damping of the device. Neither delay nor mass is needed.

    Source: Hulin 2017, secs. 6.1.1 (procedure) and 6.1.3.
    """
    verdicts = np.asarray(verdict, dtype=np.str_)
    if not len(stiffness) == len(damping) == len(verdicts):
        raise ParameterError(
            f"boundary of {len(stiffness)} stiffness values, {len(damping)} damping values and "
            f"{len(verdicts)} verdicts: expected one of each per trial."
        )
    tried = stiffness > 0
    levels, column = np.unique(damping[tried], return_inverse=True)
    k, said = stiffness[tried], verdicts[tried]
    unstable = np.full(len(levels), np.inf)
    np.minimum.at(unstable, column[said == "unstable"], k[said == "unstable"])
    below = (said == "stable") & (k < unstable[column])
    stable = np.full(len(levels), -np.inf)
    np.maximum.at(stable, column[below], k[below])
    undecided = np.bincount(column[(said == "undecided") & (k < stable[column])], minlength=len(levels))
    return tuple(
        BoundaryPoint(
            damping=float(b),
            stable=float(low) if np.isfinite(low) else None,
            unstable=float(high) if np.isfinite(high) else None,
            censored=not np.isfinite(high),
            undecided=int(count),
        )
        for b, low, high, count in zip(levels, stable, unstable, undecided, strict=True)
    )


def spread_over_plane(stiffness: Floats, damping: Floats, usable: Booleans, most: int) -> Integers:
    """Return the indices of at most ``most`` usable trials, evenly from the order of damping and stiffness."""
    index = np.flatnonzero(usable)
    order = index[np.lexsort((stiffness[index], damping[index]))]
    if len(order) <= most:
        return order
    return np.asarray(order[np.round(np.linspace(0, len(order) - 1, most)).astype(np.int64)])
