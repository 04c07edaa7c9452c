"""Lines of a drawing with fewer points: Douglas and Peucker's rule, over all lines of a drawing at once."""

from __future__ import annotations

import numpy as np

from pipeline.records.batch import Booleans, Floats


def needed_points(points: Floats, starts: np.ndarray, tolerance: float) -> Booleans:
    """Return which points lines need so that no left-out point is farther from its line than a tolerance.

    Parameters
    ----------
    points : float64, shape (n, 2)
        Points of all lines, one line behind the other. A closed line repeats its first point.
    starts : int64, shape (m,)
        Index of the first point of each line, increasing, beginning with 0; no line is empty.
    tolerance : float
        Largest distance [unit of the points].

    Returns
    -------
    bool, shape (n,)
        The ends of each line are always kept.

    Notes
    -----
    All chords of a level are split together, so the effort is one pass over the points a level; a line of n points
    has about log2(n) levels.
    """
    count = len(points)
    keep = np.zeros(count, dtype=bool)
    if not count:
        return keep
    keep[starts] = True
    keep[np.append(starts[1:], count) - 1] = True
    while True:
        ends = np.flatnonzero(keep)
        chord = np.cumsum(keep) - 1  # the chord, by its first point, that spans a point
        open_ = np.flatnonzero(~keep)
        if not len(open_):
            return keep
        first = ends[chord[open_]]
        distance = _distances(points[open_], points[first], points[ends[chord[open_] + 1]])
        begin = np.flatnonzero(np.diff(first, prepend=-1))  # open points of one chord stand together
        farthest = np.maximum.reduceat(distance, begin)
        lengths = np.diff(np.append(begin, len(open_)))
        split = (distance == np.repeat(farthest, lengths)) & (distance > tolerance)
        if not split.any():
            return keep
        keep[open_[split]] = True


def _distances(points: Floats, first: Floats, last: Floats) -> Floats:
    """Distances of points from their chords; from the end where a chord has no length, as in a closed line."""
    along = last - first
    to = points - first
    length = np.einsum("ij,ij->i", along, along)
    share = np.clip(np.einsum("ij,ij->i", to, along) / np.where(length > 0, length, 1.0), 0.0, 1.0)
    rest = to - share[:, None] * along
    return np.asarray(np.hypot(rest[:, 0], rest[:, 1]))
