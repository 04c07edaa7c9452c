"""Growth of a position towards edges of its command, which no cause before the edge makes.

Before an edge a device rests or goes on: along a parabola, or with what decays of an earlier motion. A filter of both
directions spreads the answer over the rows before the edge, where it grows as exp((k - edge)/tau); so does, about, the
beginning of a motion whose command was logged late. Either is compared with a decay from the first of these rows.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from pipeline.recording.samples import Samples, middle
from pipeline.records.trials import Floats

TIME_CONSTANTS = (1.5, 2.5, 4.0, 6.0, 10.0, 16.0, 25.0, 40.0)
"""Time constants of a growth [rows]: filters of less spread an answer over the row before an edge alone."""

MOST_AT_REST = 96
"""Rows at rest before the first edge that are used: over more of them sensors drift."""

MOST_EDGES = 60
"""Edges that are looked at: each more costs time, and a dozen are clear."""

LARGE = 0.1
"""Jump of a command relative to the largest one from which on it is an edge."""

SETTLING = 16
"""Rows behind an edge that its answer takes to begin: they are left out before the next one."""

WINDOW = 5.0
"""Rows before an edge that are used, in time constants."""

FEWEST, MOST = 16, 64
"""The same in rows: fewer are explained by any curve, over more a parabola is none of the motion."""

BEHIND = 64
"""Rows behind an edge from which the acceleration by it is taken."""

SINGULAR = 1e-10
"""Power of a curve relative to that of the other one of a pair that is nothing but rounding."""

LATEST = 32
"""Largest delay of that acceleration [rows]."""


@dataclass(frozen=True)
class Growth:
    """How a position grows towards one edge or several.

    Parameters
    ----------
    score : float
        Logarithm of the likelihood of a growth relative to that of a decay, for white noise.
    ratio : float
        Sum of squares that the decay leaves relative to that of the growth.
    acceleration, error : float
        Of the growth in the row of an edge of the largest jump, in the direction of the jump, and its standard error
        for white noise [position/row^2].
    time_constant : float
        Of the growth [rows].
    edges : int
        Edges before which it was looked for.
    """

    score: float
    ratio: float
    acceleration: float
    error: float
    time_constant: float
    edges: int


def last_at_rest(samples: Samples, edge: int) -> int:
    """Return the last row in which a device at rest may not move: that of the edge, or the one before if polled.

    A controller reads the position before it commands, so that a command in row k moves nothing until row k + 1.
    Between two polled rows the command may have changed, and moved the device, before the second one.
    """
    return edge if samples.is_even else edge - 1


def growth_from_rest(samples: Samples, edge: int, *, turning: bool) -> Growth | None:
    """Return the likeliest growth of a position from its rest before an edge; None where nothing changes in it.

    A ``turning`` one is exp(z) (a cos z + b sin z) with z = (k - edge)/tau, as the filters of second order make it; the
    other one is a exp(z). Of polled rows the last one before the edge is left out (`last_at_rest`).
    """
    first = max(edge - MOST_AT_REST, 0)
    x = samples.position[first : last_at_rest(samples, edge) + 1] - samples.position[first]
    if not x.any():
        return None
    jump = float(np.sign(samples.jumps[edge - 1]))
    constants = [each for each in TIME_CONSTANTS if each <= len(x) / 2]
    return _likeliest([_compared([(x, jump, 2)], each, constants, turning) for each in constants])


def growth_before_edges(samples: Samples) -> Growth | None:
    """Return the likeliest growth, a turning one, of a free motion towards all edges, in proportion to their jumps.

    A growth of each time constant has a window of so many rows before each edge.
    """
    size = np.abs(samples.jumps)
    edges = np.flatnonzero(size > LARGE * size.max()) + 1
    if len(edges) > MOST_EDGES:
        return None
    tried = TIME_CONSTANTS[:-1]
    return _likeliest([_compared(list(_windows(samples, edges.tolist(), each)), each, tried, True) for each in tried])


def acceleration(samples: Samples, edge: int) -> float:
    """Return the acceleration by the jump of an edge, in its direction [position/row^2]; 0 where there is none.

    It is that of the command at the delay that explains the rows behind the edge best. The position at rest is the
    median over the first half of the rows before the edge, which a motion that begins too early does not reach.
    """
    first = max(edge - BEHIND, 0)
    x = samples.position[edge : edge + BEHIND] - middle(samples.position[first : max((first + edge) // 2, first + 1)])
    command = np.concatenate([np.zeros(LATEST), samples.command[edge : edge + BEHIND]])
    velocity = np.concatenate([[0.0], np.cumsum(command)])
    twice = np.concatenate([[0.0], np.cumsum(velocity[:-1] + 0.5 * command)])
    driven = np.lib.stride_tricks.sliding_window_view(twice, len(x))[1 : LATEST + 1]  # the last one without a delay
    power = np.einsum("ij,ij->i", driven, driven)
    product = driven @ x
    explained = np.divide(product * product, power, out=np.zeros(LATEST), where=power > 0)
    best = int(explained.argmax())
    return float(product[best] / power[best] * abs(samples.jumps[edge - 1])) if power[best] > 0 else 0.0


_Window = tuple[Floats, float, int]
"""Positions up to an edge, its jump relative to the largest one, and the degree of the motion without an edge."""


def _windows(samples: Samples, edges: list[int], time_constant: float) -> Iterator[_Window]:
    """Yield the windows before the edges that have enough rows behind the edge before."""
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
    """Return how much better a growth of a time constant explains windows than the best one of some decays."""
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
    # of exp(z) (a cos z + b sin z) the second derivative is 2 b at z = 0, of a exp(z) it is a
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
    """Return an orthonormal basis of polynomials, and a growth and decays without what these explain.

    Shapes (rows, degree + 1) and (constants, rows, 1 or 2); the first constant is that of the growth.
    """
    k = np.arange(rows, dtype=np.float64)
    basis, _ = np.linalg.qr(np.polynomial.legendre.legvander(2 * k / (rows - 1) - 1, degree))
    z = np.stack([(k + 1 - rows) / constants[0], *(-k / each for each in constants[1:])])
    curves = np.exp(z)[:, :, None] * (np.stack([np.cos(z), np.sin(z)], axis=2) if turning else 1.0)
    return basis, curves - np.einsum("ij,kjl->kil", basis, np.einsum("ij,kil->kjl", basis, curves))


def _likeliest(found: list[Growth | None]) -> Growth | None:
    return max((each for each in found if each is not None), key=lambda each: each.score, default=None)
