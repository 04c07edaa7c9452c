"""Where to cut a range in which the limit lies, so that the fewest further trials are expected: an optimal search."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.records.batch import Floats


@dataclass(frozen=True)
class Split:
    """Best wall to try: its place among the edges, the chance that it is unstable, and the trials expected in all."""

    place: int
    unstable: float
    trials: float


def best_split(edges: Floats, chance: Floats, width: float, price: float = 1.0) -> Split | None:
    """Return where a trial shortens the search most.

    Parameters
    ----------
    edges : float64, shape (n + 1,)
        Walls that may be tried, rising; the first is known to be stable, the last to be unstable.
    chance : float64, shape (n,)
        Chance that the limit lies between two edges; any positive scale.
    width : float
        The search ends when the limit is known to lie between walls no further apart.
    price : float
        What an unstable trial costs, in stable ones: above 1 the limit is approached from below.

    Returns
    -------
    Split or None
        None where nothing is left to search.

    Notes
    -----
    Least cost V(i, j) of a limit between edges i and j, weighted by its chance: 0 where they are within ``width``,
    else the least over k of the trial's own price and V(i, k) + V(k, j). As optimal search trees (Knuth 1971), with
    prices. About n^3/6 operations, in n steps of numpy.

    Examples
    --------
    >>> best_split(np.arange(5.0), np.ones(4), 1.0)
    Split(place=2, unstable=0.5, trials=2.0)
    >>> best_split(np.arange(5.0), np.array([0.01, 0.01, 0.01, 1.0]), 1.0).place
    3
    """
    n = len(chance)
    total = np.concatenate([[0.0], np.cumsum(chance)])
    if edges[-1] - edges[0] <= width or total[-1] <= 0:
        return None
    cost, trials = np.zeros((n + 1, n + 1)), np.zeros((n + 1, n + 1))
    place = np.zeros((n + 1, n + 1), dtype=np.int64)
    for span in range(2, n + 1):
        i = np.flatnonzero(edges[span:] - edges[:-span] > width)
        j, inner = i + span, i[:, None] + np.arange(1, span)
        paid = (total[j] - total[i])[:, None] + (price - 1) * (total[inner] - total[i][:, None])
        options = cost[i[:, None], inner] + cost[inner, j[:, None]] + paid
        best = np.argmin(options, axis=1)
        k = i + 1 + best
        place[i, j], cost[i, j] = k, options[np.arange(len(i)), best]
        trials[i, j] = trials[i, k] + trials[k, j] + total[j] - total[i]
    first = int(place[0, n])
    if first == 0:  # two edges, too far apart
        return None
    return Split(first, float(total[first] / total[n]), float(trials[0, n] / total[n]))
