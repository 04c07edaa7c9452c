"""Local planes that smooth values at scattered points and give outliers little weight.

Source: Cleveland, Robust locally weighted regression (1979), in two dimensions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pipeline.base.compiled import compiled, inlined
from pipeline.records.trials import Floats, Integers

NEIGHBOURS = 40
"""Number of points to which a plane is fitted."""

ROBUST = 3
"""Number of rounds of robust reweighting."""

NO_ERROR = 1e-12
"""Threshold for the magnitude of errors of values. Below it, such errors count as zero."""

LEAST_RATIO = 1e-9
"""Threshold for the ratio of eigenvalues of a plane's normal matrix. Below it, the smaller eigenvalue counts as zero.

Points on a line do not determine the slope across the line.
"""

_SWEEPS = 12
"""Largest number of Jacobi sweeps. A matrix with three rows needs four or five."""


@dataclass(frozen=True)
class LocalPlanes:
    """Planes fitted around n points. Each sums ``values[nearest]`` with ``weight``, both of shape (n, k)."""

    nearest: Integers
    weight: Floats

    def of(self, values: Floats) -> Floats:
        """Return the smoothed values, shape (n,)."""
        result: Floats = np.einsum("nk,nk->n", self.weight, values[self.nearest])
        return result


def local_planes(stiffness: Floats, damping: Floats, values: Floats, neighbours: int = NEIGHBOURS) -> LocalPlanes:
    """Return local planes that smooth values at points.

    Parameters
    ----------
    stiffness, damping, values : float64, shape (n,)
        Coordinates in any units, and values.
    neighbours : int
        Number of points to which a plane is fitted. All points are used if there are fewer.

    Notes
    -----
    A weight is the tricube of the distance in standard deviations times the bisquare of the residual over six times the
    local median residual. Close to the limit of stability, costs of single trials scatter much more than elsewhere.

    Examples
    --------
    >>> x, y = np.meshgrid(np.arange(4.0), np.arange(5.0))
    >>> plane = 2 + 3 * x.ravel() - y.ravel()
    >>> bool(np.allclose(local_planes(x.ravel(), y.ravel(), plane).of(plane), plane))
    True
    """
    from scipy.spatial import cKDTree

    points = np.stack([stiffness, damping], axis=1)
    spread = points.std(axis=0)
    points = points / np.where(spread > 0, spread, 1.0)
    distance, nearest = cKDTree(points).query(points, k=min(neighbours, len(points)))
    reach = np.maximum(distance[:, -1:], np.finfo(np.float64).tiny) * (1 + 1e-9)
    near = (1 - (distance / reach) ** 3) ** 3
    weight, work, matrices = np.empty_like(near), np.empty((3, max(near.shape))), np.empty((2, 3, 3))
    fit_planes(points, near, nearest.astype(np.int64), np.ascontiguousarray(values), weight, work, matrices)
    return LocalPlanes(nearest, weight)


@inlined
def _first_of_inverse(normal: Floats, turned: Floats) -> tuple[float, float, float]:
    """Return the first row of the minimum-norm inverse of a symmetric matrix (3, 3), by Jacobi rotations.

    The matrix is overwritten. ``turned`` is work memory (3, 3).
    """
    for k in range(3):
        for j in range(3):
            turned[k, j] = 1.0 if k == j else 0.0
    for _ in range(_SWEEPS):
        size = abs(normal[0, 0]) + abs(normal[1, 1]) + abs(normal[2, 2])
        if abs(normal[0, 1]) + abs(normal[0, 2]) + abs(normal[1, 2]) <= 1e-18 * size:
            break
        for p in range(2):
            for q in range(p + 1, 3):
                if normal[p, q] == 0:
                    continue
                half = 0.5 * (normal[q, q] - normal[p, p]) / normal[p, q]
                tangent = math.copysign(1.0, half) / (abs(half) + math.hypot(half, 1.0))
                c = 1 / math.hypot(tangent, 1.0)
                s = tangent * c
                for k in range(3):
                    a, b = normal[k, p], normal[k, q]
                    normal[k, p], normal[k, q] = c * a - s * b, s * a + c * b
                for k in range(3):
                    a, b = normal[p, k], normal[q, k]
                    normal[p, k], normal[q, k] = c * a - s * b, s * a + c * b
                    a, b = turned[k, p], turned[k, q]
                    turned[k, p], turned[k, q] = c * a - s * b, s * a + c * b
    least = LEAST_RATIO * max(normal[0, 0], normal[1, 1], normal[2, 2])
    first = (0.0, 0.0, 0.0)
    for k in range(3):
        if normal[k, k] > least:
            share = turned[0, k] / normal[k, k]
            first = (
                first[0] + share * turned[0, k],
                first[1] + share * turned[1, k],
                first[2] + share * turned[2, k],
            )
    return first


@inlined
def _median(values: Floats, count: int) -> float:
    """Return the median of the first ``count`` values. These values are sorted in place."""
    for i in range(1, count):
        value, at = values[i], i
        while at > 0 and values[at - 1] > value:
            values[at] = values[at - 1]
            at -= 1
        values[at] = value
    return float(0.5 * (values[(count - 1) // 2] + values[count // 2]))


@compiled("void(f8[:,::1],f8[:,::1],i8[:,::1],f8[::1],f8[:,::1],f8[:,::1],f8[:,:,::1])")
def fit_planes(
    points: Floats, near: Floats, nearest: Integers, values: Floats, weight: Floats, work: Floats, matrices: Floats
) -> None:
    """Set the weight of each neighbour in the value of the plane at each point, after robust reweighting.

    Parameters
    ----------
    points : float64, shape (n, 2)
    near, nearest : float64, int64, shape (n, k)
        Weights by distance, and indices of the neighbours.
    values : float64, shape (n,)
    weight : float64, shape (n, k)
        Output.
    work, matrices : float64, shape (3, max(n, k)); (2, 3, 3)
        Work memory.
    """
    n, k = near.shape
    error, sure, around, normal = work[0], work[1], work[2], matrices[0]
    for i in range(n):
        sure[i] = 1.0
    for turn in range(ROBUST + 1):
        for i in range(n):
            normal[:] = 0.0
            for j in range(k):
                other = nearest[i, j]
                w = near[i, j] * sure[other]
                x, y = points[other, 0] - points[i, 0], points[other, 1] - points[i, 1]
                normal[0, 0] += w
                normal[0, 1] += w * x
                normal[0, 2] += w * y
                normal[1, 1] += w * x * x
                normal[1, 2] += w * x * y
                normal[2, 2] += w * y * y
            normal[1, 0], normal[2, 0], normal[2, 1] = normal[0, 1], normal[0, 2], normal[1, 2]
            level, by_x, by_y = _first_of_inverse(normal, matrices[1])
            value = 0.0
            for j in range(k):
                other = nearest[i, j]
                x, y = points[other, 0] - points[i, 0], points[other, 1] - points[i, 1]
                weight[i, j] = near[i, j] * sure[other] * (level + by_x * x + by_y * y)
                value += weight[i, j] * values[other]
            error[i] = abs(values[i] - value)
        if turn == ROBUST:
            break
        for i in range(n):
            for j in range(k):
                around[j] = error[nearest[i, j]]
            usual = max(6 * _median(around, k), NO_ERROR)
            sure[i] = (1 - min(error[i] / usual, 1.0) ** 2) ** 2
