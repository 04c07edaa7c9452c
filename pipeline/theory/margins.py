"""How far a wall is from the limit, in the terms of control engineering: gain, phase and delay margin, bandwidth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.loop import Loop
from pipeline.records.batch import Floats
from pipeline.theory.circle import bisect, inverse_and_rate, place_of
from pipeline.theory.poles import is_stable, spectral_radius

_PLACES = 4000
"""Angles over the range of the first look; beside these some at each pole of the open loop."""

_SMALLEST = 1e-7
"""Smallest angle that is looked at [rad/sample]."""

_STEPS = 24
"""Steps up to the delay margin that the phase margin stands for, at which stability is looked at."""

_FARTHEST = 4.0
"""Largest delay that is added, in multiples of that."""


@dataclass(frozen=True)
class Margins:
    """Margins of a stable wall; None where there is no limit.

    Parameters
    ----------
    gain : float, optional
        Smallest factor > 1 of stiffness and damping together at which the loop is on the limit.
    gain_down : float, optional
        Largest factor < 1 at which it is.
    phase : float, optional
        Smallest phase [rad] that the loop's response has left to -1 where its gain is 1.
    delay : float, optional
        Smallest delay [samples] that makes the loop unstable when it is added.
    bandwidth : float, optional
        Smallest angle [rad/sample] at which the position after a command is below 1/sqrt(2) of that at rest.
    """

    gain: float | None
    gain_down: float | None
    phase: float | None
    delay: float | None
    bandwidth: float | None


def margins(loop: Loop, alpha: float, beta: float) -> Margins:
    """Return the margins of a stable wall.

    Parameters
    ----------
    loop : Loop
    alpha, beta : float
        Normalised.

    Raises
    ------
    ParameterError
        If the wall is not stable.

    Notes
    -----
    The loop's response is L = (alpha + beta N) G on the unit circle, with G the sampled device behind its delay and N
    the velocity filter. The delay margin is that of the loop itself, whose input switches within a sampling interval,
    not phase margin over frequency.
    """
    if not is_stable(loop, alpha, beta)[0]:
        raise ParameterError("this wall is unstable: it has no margins.")

    def response(angle: Floats) -> np.ndarray:
        inverse, rate = inverse_and_rate(loop, place_of(angle))[0]
        return np.asarray(-(alpha + beta * rate) / inverse)

    def compliance(angle: Floats) -> Floats:
        inverse, rate = inverse_and_rate(loop, place_of(angle))[0]
        return np.asarray(np.abs((alpha + loop.gamma) / (alpha + beta * rate - inverse)))

    angle = _angles(loop)
    real = response(_crossings(lambda a: response(a).imag, angle)).real
    factors = -1 / np.append(real, response(np.array([np.pi * (1 - 1e-9)])).real)
    factors = factors[_on_limit(loop, alpha, beta, factors)]
    unit = _crossings(lambda a: np.abs(response(a)) - 1, angle)
    phases = np.angle(-response(unit))
    slow = _crossings(lambda a: compliance(a) - np.sqrt(0.5), angle)
    return Margins(
        gain=_first(factors[factors > 1], min),
        gain_down=_first(factors[(factors < 1) & (factors > 0)], max),
        phase=_first(np.abs(phases), min),
        delay=_added_delay(loop, alpha, beta, np.mod(phases, 2 * np.pi) / unit),
        bandwidth=_first(slow, min),
    )


def _first(values: Floats, which: Callable[[Floats], float]) -> float | None:
    return float(which(values)) if len(values) else None


def _angles(loop: Loop) -> Floats:
    poles = np.linalg.eigvals(loop.open_loop[0])
    near = np.abs(np.angle(poles))[:, None] + (1 - np.abs(poles))[:, None] * np.sinh(np.linspace(-6, 6, 41))
    even = np.linspace(0, np.pi, int(64 * (loop.delay + 2)))
    found = np.concatenate([np.geomspace(_SMALLEST, np.pi, _PLACES), even, near.ravel()])
    return np.unique(found[(found >= _SMALLEST) & (found < np.pi * (1 - 1e-9))])


def _crossings(function: Callable[[Floats], Floats], angle: Floats) -> Floats:
    """Return the angles at which a function changes sign."""
    positive = function(angle) > 0
    at = np.flatnonzero(positive[1:] != positive[:-1])
    good, bad = (np.where(positive[at] == side, angle[at], angle[at + 1]) for side in (True, False))
    return np.asarray(bisect(lambda a: function(a) > 0, good, bad)[0])


def _on_limit(loop: Loop, alpha: float, beta: float, factors: Floats) -> np.ndarray:
    """Return which factors put a pole on the unit circle: not changes of sign at poles of the response."""
    usable = np.isfinite(factors) & (factors > 0)
    poles = np.linalg.eigvals(loop.matrix(alpha * factors[usable], beta * factors[usable]))
    result = usable.copy()
    result[usable] = (np.abs(np.abs(poles) - 1) < 1e-6).any(axis=1)
    return result


def _added_delay(loop: Loop, alpha: float, beta: float, expected: Floats) -> float | None:
    """Return the smallest added delay [samples] that makes the loop unstable, next to what phases let expect."""

    def stable(delay: Floats) -> np.ndarray:
        try:
            return spectral_radius(replace(loop, delay=loop.delay + float(delay[0])), alpha, beta) < 1
        except ParameterError:  # beyond the delays that are computed
            return np.array([True])

    if not len(expected):
        return None
    steps = expected.min() * np.linspace(0, _FARTHEST, int(_FARTHEST * _STEPS) + 1)[:, None]
    bad = next((i for i, step in enumerate(steps) if i and not stable(step)), None)
    return None if bad is None else float(bisect(stable, steps[bad - 1], steps[bad], 40)[0][0])
