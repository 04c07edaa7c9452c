"""Compute the poles of a wall, quantities derived from them, and the stability margins of the wall.

Source: Hulin 2017, secs. 3.4, 3.5 and 5.1. The margins are not part of the thesis.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from decimal import Decimal
from functools import reduce
from typing import Any

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval

from pipeline.base.errors import ParameterError
from pipeline.loop.many_digits import Digits, as_exact, binomial, many_digits, product, total
from pipeline.loop.normalised_loop import NormalisedLoop, as_points
from pipeline.records.trials import Booleans, Floats
from pipeline.theory import march, modes
from pipeline.theory.crossings import (
    Complexes,
    angle_of,
    bisect,
    circle_condition,
    inverse_and_rate,
    positive_roots,
    squared,
)

_CHUNK = 8192
"""Number of points whose eigenvalues are computed together. It limits memory to about 40 MB at d = 16."""

_FEW = 8
"""Largest number of points for which eigenvalues are faster than the polynomials of a loop."""


def poles(loop: NormalisedLoop, alpha: object, beta: object) -> Complexes:
    """Return all poles z of each point, shape (n, states), complex, unsorted.

    They are roots of the characteristic polynomial, computed from the poles of the previous point. If this fails, and
    for few points, they are computed as eigenvalues.
    """
    a, b = as_points(alpha, beta)
    found, left = np.empty((len(a), loop.states), np.complex128), np.arange(len(a))
    if len(a) > _FEW and len((modal := modes.polynomials(loop)[:2])[0]):
        known = np.empty(len(a), np.bool_)
        with np.errstate(all="ignore"):  # a failing search may overflow
            march.poles_of_walls(modal, (a, b), modes.first_poles(loop), (found, known, np.empty(len(modal[0]))))
        found += 1.0
        left = np.flatnonzero(~known)
    for part in (left[i : i + _CHUNK] for i in range(0, len(left), _CHUNK)):
        found[part] = np.linalg.eigvals(loop.matrix(a[part], b[part]))
    return found


def spectral_radius(loop: NormalisedLoop, alpha: object, beta: object) -> Floats:
    """Return the largest pole modulus r = |z|_max of each point.

    Parameters
    ----------
    loop : NormalisedLoop
    alpha, beta : array_like, shape (n,)
        Normalised virtual stiffness and damping.

    Returns
    -------
    float64, shape (n,)

    Source: Hulin 2017, eq. 5.2.
    """
    radius: Floats = np.abs(poles(loop, alpha, beta)).max(axis=1)
    return radius


def is_stable(loop: NormalisedLoop, alpha: object, beta: object) -> Booleans:
    """Return whether all poles of each point are inside the unit circle.

    Parameters
    ----------
    loop : NormalisedLoop
    alpha, beta : array_like, shape (n,)
        Normalised virtual stiffness and damping.

    Returns
    -------
    bool, shape (n,)

    Source: Hulin 2017, sec. 3.4 (poles of 3.9).
    """
    a, b = as_points(alpha, beta)
    return stable_by_radius(loop, a, spectral_radius(loop, a, b))


def stable_by_radius(loop: NormalisedLoop, alpha: Floats, radius: Floats) -> Booleans:
    """Return whether points with known alpha and spectral radius are stable, shape (n,).

    With alpha + gamma <= 0, there is a real pole at or above z = 1 for any beta. Rounding may move it just below 1. The
    sign of alpha + gamma therefore decides instead of the last bit of an eigenvalue.
    """
    return np.asarray((radius < 1) & (alpha + loop.gamma > 0))


_TIME_CONSTANTS = 4.0
"""Number of time constants of the slowest pole in a settling time (5.4), with exp(-4) = 1.8 %."""

REAL = 1e-7
"""Largest angle of a pole that is treated as real, since rounding splits a double pole by sqrt(1e-16) = 1e-8. Damping
ratios do not depend on it."""

_STEPS = 80
"""Largest number of Newton steps. At a double pole, each step only halves the distance, which is 1e-20 after all
steps."""

_FINE = Decimal("1e-20")

_REACH = 0.04
"""Relative range of z around the slowest pole in which a triple pole is searched for."""


def pole_settling_time(radius: object) -> Floats:
    """Return the settling time [samples] that the largest pole modulus predicts, -4/ln r.

    Parameters
    ----------
    radius : array_like, shape (n,)
        Largest pole modulus r in (0, 1), from `spectral_radius`.

    Raises
    ------
    ParameterError
        If a radius is outside (0, 1). A response that does not decay has no settling time.

    Notes
    -----
    This is an approximation for a band of 2 %. At the optima of C.1 to C.3, the step response takes twice as long
    (5.2.1).

    Source: Hulin 2017, eq. 5.4.
    """
    r = np.atleast_1d(np.asarray(radius, dtype=np.float64))
    if not np.all((r > 0) & (r < 1)):
        raise ParameterError("pole radius: expected numbers between 0 and 1. Use stable points only.")
    return -_TIME_CONSTANTS / np.log(r)


def damping_ratio(loop: NormalisedLoop, alpha: object, beta: object) -> Floats:
    """Return the damping ratio of each point, i.e. the smallest -Re(ln z)/|ln z| of its poles z.

    Parameters
    ----------
    loop : NormalisedLoop
    alpha, beta : array_like, shape (n,)
        Normalised virtual stiffness and damping.

    Returns
    -------
    float64, shape (n,)
        1 if all poles are real and not negative, and 0 or less if the loop is not stable. The logarithm is the
        principal one, so a pole on the negative real axis is an oscillation with a period of two samples.

    Notes
    -----
    A pole at z = 0 (pure delay) has the ratio 1. A pole of multiplicity p has a rounding error of eps^(1/p). A ratio of
    1 at such a pole has the square of this error, 1e-10 for a triple pole.

    Source: Hulin 2017, eqs. 5.5 and 5.6.
    """
    z = poles(loop, alpha, beta)
    size = np.abs(z)
    with np.errstate(divide="ignore", invalid="ignore"):
        decay = -np.log(size)
        ratio = decay / np.hypot(decay, np.angle(z))
    ratio = np.where(size == 0, 1.0, np.nan_to_num(ratio, nan=0.0))  # 0/0 is a pole at z = 1, which does not decay
    return np.asarray(ratio.min(axis=1))


def threefold_pole(loop: NormalisedLoop, near: float) -> tuple[float, float, float] | None:
    """Return alpha, beta and z of the triple real pole close to a modulus, or None if there is none within 4 %.

    Notes
    -----
    The characteristic polynomial is P + alpha W_0 + beta W_1. It has a triple root where the Wronskian of P, W_0 and
    W_1 is zero. alpha and beta follow from value and slope there. An eigenvalue solver splits such poles by eps^(1/3) =
    1e-5, differently on each processor, whereas the root of the Wronskian is simple.
    """
    with many_digits(loop.digits):
        rows = [[part, polyder(part), polyder(polyder(part))] for part in characteristic_parts(loop)]
        (p, dp, ddp), (a, da, dda), (b, db, ddb) = rows
        bend = [product(ddp, a, db), product(ddp, da, b), product(dda, p, db)]
        bend += [product(dda, dp, b), product(ddb, p, da), product(ddb, dp, a)]
        wronskian = reduce(total, (part * (-1) ** k for k, part in zip((0, 1, 1, 0, 0, 1), bend, strict=True)))
        slope, w = polyder(wronskian), Decimal((near - 1) / (near + 1))
        for _ in range(_STEPS):
            step = polyval(w, wronskian) / polyval(w, slope)
            w -= step
            if abs(step) <= _FINE * abs(w):
                break
        z = (1 + w) / (1 - w)
        if abs(float(z) / near - 1) > _REACH:
            return None
        (free, fall), (one, rise), (other, turn) = ([polyval(w, part) for part in row[:2]] for row in rows)
        scale = one * turn - other * rise
        alpha, beta = (other * fall - free * turn) / scale, (free * rise - one * fall) / scale
        return float(alpha), float(beta), float(z)


def characteristic_parts(loop: NormalisedLoop) -> tuple[Digits, Digits, Digits]:
    """Return the characteristic polynomial without a wall, and its factors of alpha and of beta."""
    g, delay = loop.sampled, loop.oldest_force
    bottom, force = product(binomial(1), g.filter), product(binomial(delay, -1), g.force)
    free = product(binomial(delay), g.motion, bottom)
    return free, product(force, bottom), product(force, as_exact([0, 2]), g.velocity)


_HALF_RATE = 82.0
"""Place (ln s) of half the sampling rate."""

_DELAYS = 24
"""Number of delays at which stability is checked, up to the delay margin estimated from the phase margin."""

_FARTHEST = 4.0
"""Largest additional delay, as a multiple of this estimate."""


@dataclass(frozen=True)
class Margins:
    """Margins of a stable wall. A margin is None if there is no limit.

    Parameters
    ----------
    gain : float, optional
        Smallest common factor > 1 of stiffness and damping at which the loop is on the limit.
    gain_down : float, optional
        Largest such factor < 1.
    phase : float, optional
        Smallest phase distance [rad] of the loop's frequency response from -1 at a gain of 1.
    delay : float, optional
        Smallest additional delay [samples] with which the loop is unstable.
    bandwidth : float, optional
        Smallest angle [rad/sample] at which the amplitude of the position, for a given command, is below 1/sqrt(2) of
        its static value.
    left_out : tuple of str
        Parts of the device that its loop does not include.
    """

    gain: float | None
    gain_down: float | None
    phase: float | None
    delay: float | None
    bandwidth: float | None
    left_out: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return the margins as a document."""
        return {**asdict(self), "left_out": list(self.left_out)}


def margins(loop: NormalisedLoop, alpha: float, beta: float) -> Margins:
    """Return the margins of a stable wall.

    Parameters
    ----------
    loop : NormalisedLoop
    alpha, beta : float
        Normalised virtual stiffness and damping.

    Raises
    ------
    ParameterError
        If the wall is not stable.

    Notes
    -----
    The loop response is L = (alpha + beta N) G on the unit circle, with the sampled device G including its delay, and
    the velocity filter N. The delay margin takes into account that the input of the loop switches within a sampling
    interval. It is not the phase margin divided by the frequency.
    """
    if not is_stable(loop, alpha, beta)[0]:
        raise ParameterError("this wall is unstable and has no margins.")

    real, unit, slow = (np.log(roots) for roots in _margin_roots(loop, alpha, beta))

    def response(place: Floats) -> Complexes:
        inverse, rate = inverse_and_rate(loop, place)[0]
        return np.asarray(-(alpha + beta * rate) / inverse)

    with np.errstate(divide="ignore"):
        factors = -1 / response(np.append(real, _HALF_RATE)).real
    factors = factors[np.isfinite(factors)]
    angle, phases = angle_of(unit), np.angle(-response(unit))
    return Margins(
        gain=_first(factors[factors > 1], min),
        gain_down=_first(factors[(factors < 1) & (factors > 0)], max),
        phase=_first(np.abs(phases), min),
        delay=_added_delay(loop, alpha, beta, np.mod(phases, 2 * np.pi) / angle),
        bandwidth=_first(angle_of(slow), min),
    )


def _first(values: Floats, which: Callable[[Floats], float]) -> float | None:
    return float(which(values)) if len(values) else None


def _margin_roots(loop: NormalisedLoop, alpha: float, beta: float) -> Iterator[Floats]:
    """Yield the s at which the loop response is real, the s at which its size is 1, and the s of the bandwidth."""
    c, g = circle_condition(loop), loop.sampled
    with many_digits(loop.digits):
        a, b = Decimal(alpha), Decimal(beta)
        crossing = positive_roots(total(a * c.twist, b * c.rise), loop.digits)
        yield np.append(crossing.passed, [float(root) for root in c.free])
        wall = total(a * product(binomial(1), g.filter), b * product(as_exact([0, 2]), g.velocity))
        unit = total(product(squared(wall), c.size), -product(squared(g.motion), c.filter))
        yield np.array(positive_roots(unit, loop.digits).passed)
        free, stiff, damped = characteristic_parts(loop)
        closed = squared(total(total(free, a * stiff), b * damped))
        rest = product(binomial(c.delay), c.size, c.filter)
        level = 2 * (a + Decimal(loop.gamma)) ** 2
        yield np.array(positive_roots(total(closed, -level * rest), loop.digits).passed)


def _added_delay(loop: NormalisedLoop, alpha: float, beta: float, expected: Floats) -> float | None:
    """Return the smallest additional delay [samples] with which the loop is unstable, near the values ``expected``."""

    def stable(delay: Floats) -> np.ndarray:
        try:
            return spectral_radius(replace(loop, delay=loop.delay + float(delay[0])), alpha, beta) < 1
        except ParameterError:  # the theory does not cover this delay
            return np.array([True])

    if not len(expected):
        return None
    steps = expected.min() * np.linspace(0, _FARTHEST, int(_FARTHEST * _DELAYS) + 1)[:, None]
    bad = next((i for i, step in enumerate(steps) if i and not stable(step)), None)
    return None if bad is None else float(bisect(stable, steps[bad - 1], steps[bad], 40)[0][0])
