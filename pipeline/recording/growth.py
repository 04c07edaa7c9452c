"""Growth of a position towards edges of its command, which no cause before the edge makes.

Before an edge a device rests or goes on: along a parabola, or with what decays of an earlier motion. A filter of both
directions spreads the answer over the rows before the edge, where it grows as exp((k - edge)/tau); so does, about, the
beginning of a motion whose command was logged late. Either is compared with a decay from the first of these rows.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

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
    amplitude : float
        Way by the growth up to an edge of the largest jump, in the direction of the jump [m, rad].
    time_constant : float
        Of the growth [rows].
    noise : float
        Root mean square that the growth leaves [m, rad].
    edges : int
        Edges before which it was looked for.
    """

    score: float
    ratio: float
    amplitude: float
    time_constant: float
    noise: float
    edges: int


def growth_from_rest(samples: Samples, edge: int) -> Growth | None:
    """Return the likeliest growth of a position from its rest before an edge; None where nothing changes in it."""
    first = max(edge - MOST_AT_REST, 0)
    x = samples.position[first : edge + 1] - samples.position[first]
    if not x.any():
        return None
    jump = float(np.sign(samples.jumps[edge - 1]))
    constants = [each for each in TIME_CONSTANTS if each <= len(x) / 2]
    return _likeliest([_compared([(x, jump, 2)], each, constants) for each in constants])


def growth_before_edges(samples: Samples) -> Growth | None:
    """Return the likeliest growth of a free motion towards all edges, in proportion to their jumps.

    A growth of each time constant has a window of so many rows before each edge.
    """
    size = np.abs(samples.jumps)
    edges = np.flatnonzero(size > LARGE * size.max()) + 1
    if len(edges) > MOST_EDGES:
        return None
    constants = TIME_CONSTANTS[:-1]
    return _likeliest([_compared(list(_windows(samples, edges.tolist(), each)), each, constants) for each in constants])


def acceleration(samples: Samples, edge: int) -> float:
    """Return the acceleration by the jump of an edge, in its direction [position/row^2]; 0 where there is none.

    It is that of the command at the delay that explains the rows behind the edge best.
    """
    x = samples.position[edge : edge + BEHIND] - middle(samples.position[max(edge - BEHIND, 0) : max(edge // 2, 1)])
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


def _compared(windows: list[_Window], time_constant: float, decays: list[float] | tuple[float, ...]) -> Growth | None:
    """Return how much better a growth of a time constant explains windows than the best one of some decays."""
    total, freedom = 0.0, 0
    product, power = np.zeros(1 + len(decays)), np.zeros(1 + len(decays))
    for x, jump, degree in windows:
        rows = len(x)
        basis, curves = _curves(rows, degree, time_constant, tuple(decays))
        rest = x - basis @ (basis.T @ x)
        total += float(rest @ rest)
        freedom += rows - degree - 1
        product += jump * (curves.T @ rest)
        power += jump * jump * np.einsum("ij,ij->j", curves, curves)
    if not total > 0 or not (power > 0).all():
        return None
    left = np.maximum(total - product * product / power, np.finfo(np.float64).eps * total)
    ratio = float(left[1:].min() / left[0])
    amplitude, noise = float(product[0] / power[0]), float(np.sqrt(left[0] / freedom))
    return Growth(0.5 * freedom * float(np.log(ratio)), ratio, amplitude, time_constant, noise, len(windows))


def _curves(rows: int, degree: int, growth: float, decays: tuple[float, ...]) -> tuple[Floats, Floats]:
    """Return an orthonormal basis of polynomials, and a growth and decays without what these explain."""
    k = np.arange(rows, dtype=np.float64)
    basis, _ = np.linalg.qr(np.polynomial.legendre.legvander(2 * k / (rows - 1) - 1, degree))
    curves = np.exp(np.stack([(k + 1 - rows) / growth, *(-k / each for each in decays)], axis=1))
    return basis, curves - basis @ (basis.T @ curves)


def _likeliest(found: list[Growth | None]) -> Growth | None:
    return max((each for each in found if each is not None), key=lambda each: each.score, default=None)
