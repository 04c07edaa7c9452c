"""Compute initial devices for the search, by least squares on force balances that are integrated twice."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.measured.identification import kernels
from pipeline.measured.identification.likelihood import CODES, LIMITS, Device
from pipeline.measured.identification.motion import GRAVITY, PlantShape, Transitions
from pipeline.measured.identification.noise import WHITE, gains_of
from pipeline.measured.identification.segments import Segments
from pipeline.records.trials import Floats

ROBUST_ROUNDS = 4
"""Number of iterations of the reweighted least squares."""

ALIKE = 0.7
"""Smallest decrease of the log residual at which a shorter delay is plausible, relative to the largest decrease over
all delays."""

MIRRORED = 2.0
"""Threshold for the decrease of the log residual. Above it, a device counts as moving against its command. The decrease
is 8 or more for a wrong sign, and negative for a correct sign."""

ROUNDED = 1e-12
"""Smallest eigenvalue of the scaled normal equations, relative to the largest. Smaller eigenvalues are rounding
errors."""

SMALLEST_SHARE = 1e-6
"""Threshold for the share of a column. Below it, the column is a rounding error of the other columns (the square root
of the limit that `numpy.linalg.lstsq` uses)."""

VISIBLE = 4.0
"""Threshold for the sum of squares of a segment's deviations from a straight line, relative to its noise. Above it, the
motion is visible. A plateau at constant speed contains no information on the mass, even if it is long."""

RESTING = (
    "no part of a log with a changing position is long enough: static friction or a stop may block the device. "
    "Record larger commands"
)


BALANCED = ("gain", "delta", "gamma", "coulomb", "force", *GRAVITY)
"""Numbers that appear in the force balance."""

MOST_SEGMENTS = 60
"""Largest number of segments in the force balance. They are spread evenly over all segments."""


def first_guesses(segments: Segments, names: Sequence[str], most_delay: float) -> list[Device]:
    """Return initial devices for the search, with the integer delay that fits the force balance best.

    The force balance is integrated twice. With the position y and the prime for an integral from the start of the
    segment, y = start + gain u'' - delta y' - gamma y'' - coulomb s'' + force t^2/2. This equation is linear and hardly
    amplifies reading errors. A second device without a spring is returned if such a device moves along its command.

    Raises
    ------
    ParameterError
        If the device moves against its command.
    """
    some = segments.subset(MOST_SEGMENTS)
    known = [name for name in BALANCED if name in names]
    noise, once = np.asarray(some.rows * some.white, dtype=np.float64), _way(some)
    delays = np.arange(0.0, most_delay + 0.5) if "delay" in names else np.zeros(1)
    products = np.stack([_balances(some, known, delay, once) for delay in delays.tolist()])
    moved = products[0, :, -1, -1]
    seen = moved > (VISIBLE * noise if (moved > VISIBLE * noise).any() else 0.0)
    if not seen.any():
        raise ParameterError(RESTING)
    products, floor = products[:, seen], noise[seen]
    guesses = [_guess(products, known, delays, floor)]
    if "gamma" in known:
        free = [place for place, name in enumerate([*known, "position"]) if name != "gamma"]
        with suppress(ParameterError):
            rigid = [name for name in known if name != "gamma"]
            guesses.append(_guess(products[:, :, free][..., free], rigid, delays, floor))
    start = dict.fromkeys(names, 0.0) | {"gain": 1e-3, "lag": 0.5}
    limits = {name: LIMITS.get(name, (-np.inf, np.inf)) for name in names}
    return [Device({name: float(np.clip((start | each)[name], *limits[name])) for name in names}) for each in guesses]


def _guess(products: Floats, names: list[str], delays: Floats, floor: Floats) -> dict[str, float]:
    """Return the numbers of the balance with the best delay, or an empty dict if no motion follows the command."""
    numbers, lefts, weights = _robust(products)
    gain = names.index("gain")
    signs = np.stack([_left(products, numbers, floor), *np.full((2, len(delays)), np.inf)], axis=1)
    for place in np.flatnonzero(numbers[:, gain] < 0).tolist():
        # a force of opposite sign also explains a motion delayed by half a period, or sampled at widely spaced rows
        fits = np.stack([_bounded(products[place], weights[place], names, sign) for sign in (1.0, -1.0, 0.0)])
        signs[place] = _left(products[place], fits, floor)
        numbers[place] = fits[0]
        lefts[place] = _left(products[place], fits[:1])[0] if fits[0, gain] else np.inf
    along, against, unmoved = signs.min(axis=0).tolist()
    if against < min(along, unmoved, 0.0) - MIRRORED:
        raise ParameterError(
            "the device moves against its command, so the sign of the command or of the position is wrong. Change the "
            "`sign` of columns.command in the profile"
        )
    first = shortest(lefts)
    if not np.isfinite(lefts[first]):
        return {}
    return dict(zip(names, numbers[first].tolist(), strict=True)) | {"delay": float(delays[first])}


def _way(segments: Segments) -> Floats:
    """Return the integral of the position over each segment up to each row.

    The position is relative to the rest position if there is one.
    """
    parts = []
    for first, behind, rests in zip(segments.first, segments.behind, segments.rests, strict=True):
        way = segments.between[first:behind] - segments.position[first] * rests
        parts.append(np.append(0.0, np.cumsum(way[:-1] * np.diff(segments.time[first:behind]))))
    return np.concatenate(parts)


def _balances(segments: Segments, names: list[str], delay: float, once: Floats) -> Floats:
    """Return the products of columns and position of each segment, after elimination of its initial state, (S, k + 1, k
    + 1)."""
    forces = [name for name in names if name != "delta"]
    transitions = Transitions.of(segments, PlantShape(delay=delay))
    fields = np.zeros((2 + len(GRAVITY), len(segments.time)))
    fields[-1] = segments.between
    if GRAVITY[0] in forces:
        fields[1:-1] = -np.sin(segments.angle), -np.cos(segments.angle)
    columns, _, _ = kernels.whitened(
        (segments.time, segments.command[None], segments.position, fields),
        (
            *(segments.first, segments.behind, segments.begin, segments.edge, segments.direction),
            *(np.zeros((len(segments), 3)), np.zeros((len(segments), len(forces)))),
        ),
        transitions.motion,
        transitions.pieces,
        gains_of(segments, transitions, WHITE, segments.command),
        (
            np.array([CODES["spring" if name == "gamma" else name] for name in forces], np.int64),
            np.full(3, -1),
            np.array([0.0, 0.0, delay, 1.0, 0.0]),
            np.empty(0),
        ),
    )
    by_name = dict(zip(forces, columns.T, strict=False)) | {"delta": -once}
    if "gamma" in by_name:
        by_name["gamma"] = -by_name["gamma"]
    since = segments.time[segments.places] - segments.time[segments.first][segments.segment]
    starts = [np.ones(len(once)), np.where(segments.rests[segments.segment], 0.0, since)]
    whole = np.ascontiguousarray(np.stack([*starts, *(by_name[name] for name in names), columns[:, -1]], axis=1))
    ends = np.cumsum(segments.rows)
    factors = np.zeros((len(segments), whole.shape[1], whole.shape[1]))
    kernels.triangles(factors, whole, ends - segments.rows, ends, np.arange(len(segments)))
    left = np.ascontiguousarray(factors[:, len(starts) :, len(starts) :])
    return np.asarray(left.transpose(0, 2, 1) @ left)


def shortest(lefts: Floats) -> int:
    """Return the index of the shortest delay whose residual is close to the smallest residual.

    If a mode dominates the motion, every delay explains little of the motion. A large delay then fits hardly better
    than the true delay.

    >>> shortest(np.array([-0.054, -0.058, -0.057, -0.004, -0.053, -0.064])), shortest(np.array([-2.0, -6.0, -9.0]))
    (1, 2)
    """
    first = int(np.argmax(lefts <= ALIKE * lefts.min()))
    while first + 1 < len(lefts) and lefts[first + 1] < lefts[first]:
        first += 1
    return first


def _robust(products: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the least-squares solution, the logarithm of the residual share of the motion, and the weights.

    For products of shape (D, S, k + 1, k + 1) with D delays, the shapes are (D, k), (D,) and (D, S). A segment with a
    much larger residual than most segments has little weight. The residual share is a weighted mean over segments. The
    weight of a segment is the norm of its motion, limited to the median norm, so that an unbounded motion does not
    dominate.
    """
    way, weight = _ways(products), np.ones(products.shape[:2])
    for _ in range(ROBUST_ROUNDS):
        total = np.einsum("ds,dsij->dij", weight, products)
        # scale columns to unit size: the integrals of long segments differ by many orders of magnitude
        scale = 1 / np.sqrt(np.maximum(np.einsum("dii->di", total)[:, :-1], 1e-300))
        values, vectors = np.linalg.eigh(total[:, :-1, :-1] * scale[:, :, None] * scale[:, None, :])
        known = values > ROUNDED * values.max(axis=1, keepdims=True)
        along = np.einsum("dij,di->dj", vectors, scale * total[:, :-1, -1]) / np.where(known, values, np.inf)
        found = scale * np.einsum("dij,dj->di", vectors, along)
        left = _rest(products, found)
        order = np.argsort(left, axis=1)
        reached = (np.cumsum(np.take_along_axis(way, order, axis=1), axis=1) < 0.5).sum(axis=1, keepdims=True)
        place = np.take_along_axis(order, np.minimum(reached, left.shape[1] - 1), axis=1)
        middle = np.take_along_axis(left, place, axis=1)
        weight = middle / (middle + left)
    return found, _left(products, found), weight


def _rest(products: Floats, found: Floats) -> Floats:
    """Return the residual sum of squares of each segment for coefficients of shape (..., k), shape (..., S)."""
    whole = np.concatenate([-found, np.ones((*found.shape[:-1], 1))], axis=-1)
    return np.asarray(np.maximum(np.einsum("...i,...tij,...j->...t", whole, products, whole), 1e-300))


def _ways(products: Floats) -> Floats:
    """Return the weights of segments in a mean.

    The weights are the norms of the motion, limited to the median norm and normalised to a sum of 1.
    """
    way = np.sqrt(products[..., -1, -1])
    way = np.minimum(way, np.median(way, axis=-1, keepdims=True))
    return np.asarray(way / np.maximum(way.sum(axis=-1, keepdims=True), 1e-300))


def _left(products: Floats, found: Floats, floor: Floats | float = 1e-300) -> Floats:
    """Return the mean logarithm of the residual share of the motion, for each force balance.

    ``floor`` is the smallest residual of each segment, which is due to the noise of readings.
    """
    left, moved = np.maximum(_rest(products, found), floor), np.maximum(products[..., -1, -1], floor)
    return np.asarray((_ways(products) * np.log(left / np.maximum(moved, 1e-300))).sum(axis=-1))


def _bounded(products: Floats, weight: Floats, names: list[str], sign: float) -> Floats:
    """Return the least-squares solution with a gain of the given sign (or 0) and nonnegative friction.

    Damping, stiffness and Coulomb friction are nonnegative. If all signs were reversed, the motion could also be
    explained by a reversed command.
    """
    from scipy.optimize import nnls

    total = (products * weight[:, None, None]).sum(axis=0)
    scale = 1 / np.sqrt(np.maximum(np.diagonal(total), 1e-300))
    values, vectors = np.linalg.eigh(total * scale[:, None] * scale[None, :])
    root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    ways = {"gain": [sign] if sign else [], **{name: [1.0, -1.0] for name in ("force", *GRAVITY)}}
    signed = [(place, way) for place, name in enumerate(names) for way in ways.get(name, [1.0])]
    columns = np.stack([way * root[:, place] for place, way in signed], axis=1)
    # if two columns are equal (friction and a constant force in one direction), the solution with small values is taken
    columns = np.vstack([columns, SMALLEST_SHARE * np.eye(columns.shape[1])])
    amounts, _ = nnls(columns, np.append(root[:, -1], np.zeros(columns.shape[1])))
    found = np.zeros(len(names))
    for (place, way), amount in zip(signed, amounts.tolist(), strict=True):
        found[place] += way * amount * scale[place] / scale[-1]
    return found
