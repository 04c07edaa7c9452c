"""Measured limits of stability over damping, regions below limits, and the overlap of two regions.

A region consists of intervals of stiffness at each damping, linear between the dampings. All functions use arrays only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.base.wording import counted
from pipeline.records.findings import BoundaryPoint
from pipeline.records.trials import Booleans, Floats


@dataclass(frozen=True, eq=False)
class Stretches:
    """Stable stiffness [N/m, Nm/rad] from ``low`` to ``high`` at each damping, shape (layers, n) each.

    Layers do not overlap. If a layer does not exist at a damping, it is empty there (low = high).
    """

    low: Floats
    high: Floats

    @classmethod
    def up_to(cls, limit: Floats) -> Stretches:
        """Return the region from K = 0 to a limit, shape (n,). A negative limit gives an empty region."""
        high = np.maximum(limit, 0.0)[None, :]
        return cls(np.zeros_like(high), high)


@dataclass(frozen=True, eq=False)
class MeasuredLimits:
    """Limits of a measured boundary [N/m, Nm/rad] over damping [Ns/m, Nms/rad], shape (n,) each.

    ``low`` and ``high`` are the ends of the interval of a limit. If the limit is censored, all three values are the
    stiffest stable trial, which is a lower bound. ``known`` is False if no lower bound exists or no trial is stable. In
    the second case, ``high`` is an upper bound and the other values are 0.
    """

    damping: Floats
    limit: Floats
    low: Floats
    high: Floats
    censored: Booleans
    known: Booleans

    @property
    def top(self) -> Floats:
        """Stiffness above which nothing was tested, shape (n,) [N/m, Nm/rad]. It is infinite above a known limit."""
        return np.where(self.censored | ~self.known, self.limit, np.inf)


@dataclass(frozen=True)
class Overlap:
    """Areas of two regions, of their intersection and of their union, in stiffness times damping."""

    first: float
    second: float
    shared: float

    @property
    def union(self) -> float:
        """Area of the union of both regions."""
        return self.first + self.second - self.shared


def measured_limits(points: Sequence[BoundaryPoint]) -> MeasuredLimits:
    """Return the limits of a measured boundary, with the uncertainty due to verdicts or growth rates.

    Parameters
    ----------
    points : sequence of BoundaryPoint
        Points in order of damping.

    Notes
    -----
    The limits are those of `BoundaryPoint.limit`. If there is none, the softest unstable trial is an upper bound.
    """
    rows = [
        (limit.stiffness, limit.low, limit.high)
        if (limit := point.limit) is not None
        else (0.0, 0.0, 0.0 if point.censored else np.nan if point.unstable is None else point.unstable)
        for point in points
    ]
    value, low, high = np.array(rows, dtype=np.float64).reshape(-1, 3).T
    return MeasuredLimits(
        np.array([point.damping for point in points], dtype=np.float64),
        value,
        low,
        high,
        np.array([point.censored for point in points], dtype=np.bool_),
        np.array([point.limit is not None for point in points], dtype=np.bool_),
    )


def overlap(damping: Floats, first: Stretches, second: Stretches, top: Floats | None = None) -> Overlap:
    """Return the areas of two regions and of their intersection.

    Parameters
    ----------
    damping : float64, shape (n,)
        Strictly increasing dampings of the regions [Ns/m, Nms/rad]. Areas lie between the first and the last damping.
    first, second : Stretches
    top : float64, shape (n,), optional
        Stiffness above which areas are not counted. It is infinite if there is no upper end.

    Raises
    ------
    ParameterError
        If there are fewer than two dampings, or they do not increase.

    Notes
    -----
    All ends are linear between two dampings. If two ends cross there, a damping is added. Between the resulting
    dampings, the lengths of the intervals and of their intersections vary linearly, so the trapezoidal rule is exact.
    An infinite top next to a finite one is replaced by the upper end of the higher region.
    """
    if len(damping) < 2 or not (np.diff(damping) > 0).all():
        raise ParameterError(
            f"overlap of regions at {counted(len(damping), 'damping')}: expected at least two increasing values."
        )
    ends = [first.low, first.high, second.low, second.high]
    if top is not None:
        most = np.maximum(first.high.max(axis=0), second.high.max(axis=0))
        ends.append(np.where(np.isfinite(top), top, most)[None, :])
    B, rows = _with_crossings(damping, np.concatenate(ends))
    parts = np.split(rows, np.cumsum([len(e) for e in ends])[:-1], axis=0)
    if top is not None:
        parts = [np.minimum(p, parts[4]) for p in parts[:4]]
    a_low, a_high, b_low, b_high = parts
    common = np.minimum(a_high[:, None], b_high[None]) - np.maximum(a_low[:, None], b_low[None])
    lengths = [(a_high - a_low).sum(axis=0), (b_high - b_low).sum(axis=0), np.maximum(common, 0.0).sum(axis=(0, 1))]
    return Overlap(*(float(np.trapezoid(length, B)) for length in lengths))


def _with_crossings(B: Floats, rows: Floats) -> tuple[Floats, Floats]:
    """Add the dampings at which two of the rows cross. Rows have shape (m, n) and are linear between dampings."""
    added = [B]
    for one, other in combinations(range(len(rows)), 2):
        gap = rows[one] - rows[other]
        cell = np.flatnonzero(gap[:-1] * gap[1:] < 0)
        added.append(B[cell] + np.diff(B)[cell] * gap[cell] / (gap[cell] - gap[cell + 1]))
    nodes = np.unique(np.concatenate(added))
    return nodes, np.stack([np.interp(nodes, B, row) for row in rows])
