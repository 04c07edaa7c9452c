"""Fit a growth of the position towards edges of its command, which no earlier cause can explain.

Before an edge, a device is at rest or continues its motion along a parabola or with a decaying transient. A zero-phase
filter spreads the response over the rows before the edge, where it grows as exp((k - edge)/tau). The start of a motion
whose command was logged late looks similar. Both kinds of growth are compared with a decay from the first of these
rows.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from pipeline.recording.samples import Samples, middle
from pipeline.records.trials import Floats

TIME_CONSTANTS = (1.5, 2.5, 4.0, 6.0, 10.0, 16.0, 25.0, 40.0)
"""Time constants of a growth [rows]. Faster filters spread a response only over one row before an edge."""

MOST_AT_REST = 96
"""Largest number of rows at rest before the first edge that are used, because sensors drift over more rows."""

MOST_EDGES = 60
"""Largest number of edges that are examined, because each edge takes time and a dozen edges give a clear result."""

LARGE = 0.1
"""Smallest jump of a command, relative to the largest one, that is treated as an edge."""

SETTLING = 16
"""Number of rows after an edge in which its response begins. These rows are excluded from the window of the next
edge."""

WINDOW = 5.0
"""Length of the window before an edge, in time constants."""

FEWEST, MOST = 16, 64
"""Smallest and largest number of rows in the window before an edge. Any curve would fit fewer rows, and a parabola
would not fit the motion over more rows."""

BEHIND = 64
"""Number of rows after an edge from which the acceleration due to the edge is estimated."""

SINGULAR = 1e-10
"""Threshold for the ratio of the energies of the two curves of a pair. Below it, the smaller energy is a rounding
error."""

LATEST = 32
"""Largest delay in the estimate of the acceleration due to an edge [rows]."""


@dataclass(frozen=True)
class Growth:
    """Growth of a position towards one or more edges.

    Parameters
    ----------
    score : float
        Log-likelihood ratio of growth to decay, for white noise.
    ratio : float
        Ratio of the residual sums of squares of decay and growth.
    acceleration, error : float
        Acceleration of the growth at the edge with the largest jump, in the direction of the jump, and its standard
        error for white noise [position/row^2].
    time_constant : float
        Time constant of the growth [rows].
    edges : int
        Number of edges that were examined.
    """

    score: float
    ratio: float
    acceleration: float
    error: float
    time_constant: float
    edges: int


def last_at_rest(samples: Samples, edge: int) -> int:
    """Return the last row in which a device at rest must not have moved: the edge, or the row before it if rows are
    polled.

    A controller reads the position before it sends a command, so a command in row k has no effect until row k + 1.
    Between two polled rows, the command may have changed and moved the device before the second row.
    """
    return edge if samples.is_even else edge - 1


def growth_from_rest(samples: Samples, edge: int, *, turning: bool) -> Growth | None:
    """Return the maximum-likelihood growth of a position from rest before an edge, or None if the position is constant.

    With ``turning``, the growth is exp(z) (a cos z + b sin z) with z = (k - edge)/tau, as for second-order filters.
    Otherwise it is a exp(z). In polled logs, the last row before the edge is excluded (`last_at_rest`).
    """
    first = max(edge - MOST_AT_REST, 0)
    x = samples.position[first : last_at_rest(samples, edge) + 1] - samples.position[first]
    if not x.any():
        return None
    jump = float(np.sign(samples.jumps[edge - 1]))
    constants = [each for each in TIME_CONSTANTS if each <= len(x) / 2]
    return _likeliest([_compared([(x, jump, 2)], each, constants, turning) for each in constants])


def growth_before_edges(samples: Samples) -> Growth | None:
    """Return the maximum-likelihood oscillating growth of a free motion before all edges, scaled by their jumps.

    The length of the window before each edge is proportional to the time constant.
    """
    size = np.abs(samples.jumps)
    edges = np.flatnonzero(size > LARGE * size.max()) + 1
    if len(edges) > MOST_EDGES:
        return None
    tried = TIME_CONSTANTS[:-1]
    return _likeliest([_compared(list(_windows(samples, edges.tolist(), each)), each, tried, True) for each in tried])


def acceleration(samples: Samples, edge: int) -> float:
    """Return the acceleration due to an edge, in the direction of its jump [position/row^2], or 0 if there is none.

    The acceleration is estimated at the delay for which the command fits the rows after the edge best. The rest
    position is the median over the first half of the rows before the edge, because a motion that begins too early
    affects only the second half.
    """
    first = max(edge - BEHIND, 0)
    x = samples.position[edge : edge + BEHIND] - middle(samples.position[first : max((first + edge) // 2, first + 1)])
    command = np.concatenate([np.zeros(LATEST), samples.command[edge : edge + BEHIND]])
    velocity = np.concatenate([[0.0], np.cumsum(command)])
    twice = np.concatenate([[0.0], np.cumsum(velocity[:-1] + 0.5 * command)])
    driven = np.lib.stride_tricks.sliding_window_view(twice, len(x))[1 : LATEST + 1]  # the last column is for no delay
    power = np.einsum("ij,ij->i", driven, driven)
    product = driven @ x
    explained = np.divide(product * product, power, out=np.zeros(LATEST), where=power > 0)
    best = int(explained.argmax())
    return float(product[best] / power[best] * abs(samples.jumps[edge - 1])) if power[best] > 0 else 0.0


_Window = tuple[Floats, float, int]
"""Positions up to an edge, jump of the edge relative to the largest jump, and polynomial degree of the motion without
the edge."""


def _windows(samples: Samples, edges: list[int], time_constant: float) -> Iterator[_Window]:
    """Yield the windows before edges, if they have enough rows after the previous edge."""
    rows = int(min(max(WINDOW * time_constant, FEWEST), MOST))
    largest = float(np.abs(samples.jumps).max())
    before = -SETTLING
    for edge in edges:
        first = max(before + SETTLING, edge - rows)
        before = edge
        if edge - first >= max(0.75 * FEWEST, 0.75 * rows if first else 0):
            x = samples.position[first : edge + 1] - samples.position[first]
            yield x, float(samples.jumps[edge - 1]) / largest, 3 if first else 2


def _compared(windows: list[_Window], growth: float, decays: Sequence[float], turning: bool) -> Growth | None:
    """Compare growth with a given time constant with the best of several decays, over all windows."""
    curves_of_each = 2 if turning else 1
    total, freedom = 0.0, 0
    product = np.zeros((1 + len(decays), curves_of_each))
    power = np.zeros((*product.shape, curves_of_each))
    for x, jump, degree in windows:
        basis, curves = _curves(len(x), degree, (growth, *decays), turning)
        rest = x - basis @ (basis.T @ x)
        total += float(rest @ rest)
        freedom += len(x) - degree - 1 - curves_of_each
        product += jump * np.einsum("kij,i->kj", curves, rest)
        power += jump * jump * np.einsum("kij,kil->kjl", curves, curves)
    if not total > 0 or freedom <= 0:
        return None
    inverse = np.linalg.pinv(power, rcond=SINGULAR, hermitian=True)
    ways = np.einsum("kij,kj->ki", inverse, product)
    left = np.maximum(total - np.einsum("ki,ki->k", product, ways), np.finfo(np.float64).eps * total)
    ratio, noise = float(left[1:].min() / left[0]), float(np.sqrt(left[0] / freedom))
    # second derivative at z = 0: 2 b for exp(z) (a cos z + b sin z), a for a exp(z)
    scale = curves_of_each / growth**2
    return Growth(
        score=0.5 * freedom * float(np.log(ratio)),
        ratio=ratio,
        acceleration=scale * float(ways[0, -1]),
        error=scale * noise * float(np.sqrt(inverse[0, -1, -1])),
        time_constant=growth,
        edges=len(windows),
    )


@lru_cache(maxsize=64)
def _curves(rows: int, degree: int, constants: tuple[float, ...], turning: bool) -> tuple[Floats, Floats]:
    """Return an orthonormal polynomial basis, and the growth and the decays projected onto its complement.

    The shapes are (rows, degree + 1) and (constants, rows, 1 or 2). The first constant is for the growth.
    """
    k = np.arange(rows, dtype=np.float64)
    basis, _ = np.linalg.qr(np.polynomial.legendre.legvander(2 * k / (rows - 1) - 1, degree))
    z = np.stack([(k + 1 - rows) / constants[0], *(-k / each for each in constants[1:])])
    curves = np.exp(z)[:, :, None] * (np.stack([np.cos(z), np.sin(z)], axis=2) if turning else 1.0)
    return basis, curves - np.einsum("ij,kjl->kil", basis, np.einsum("ij,kil->kjl", basis, curves))


def _likeliest(found: list[Growth | None]) -> Growth | None:
    return max((each for each in found if each is not None), key=lambda each: each.score, default=None)
