"""What happens to poles at both ends of the unit circle, and for endlessly stiff walls; once for a loop, exact."""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal
from functools import lru_cache
from itertools import pairwise

import numpy as np

from pipeline.loop.loop import Loop
from pipeline.loop.many_digits import Digits, as_exact, many_digits, power, product, total

LOWEST = -82.89306334778564
"""ln s of the smallest s, 1e-36, and minus that of the largest: angles of 2e-18."""

_STIFF = Decimal("1e40")
"""Wall that counts as endlessly stiff: 1/G is below 1e12 where device and wall are those of a machine."""


@dataclass(frozen=True)
class Ends:
    """Ends of the unit circle.

    Parameters
    ----------
    start : float
        beta at which the first branch leaves the line alpha = -gamma, theta -> 0.
    last, slope : float
        alpha at which a pole lies at z = -1 is last - beta slope; infinite where there is none.
    bend : tuple of float
        The pole leaves the circle there as alpha rises where bend[0] + beta bend[1] > 0.
    unstable : int
        Number of unstable poles of an endlessly stiff wall.
    """

    start: float
    last: float
    slope: float
    bend: tuple[float, float]
    unstable: int

    def outward(self, beta: object) -> np.ndarray:
        """Return unstable poles that alpha gains, 1 or -1, by rising through the line of z = -1 at beta."""
        return np.where(self.bend[0] + np.asarray(beta) * self.bend[1] > 0, 1, -1)


@lru_cache(maxsize=512)
def ends(loop: Loop) -> Ends:
    """Return what is known of both ends."""
    with many_digits(loop.digits):
        return Ends(_start(loop), *_at_minus_one(loop), _unstable_when_stiff(loop))


def _start(loop: Loop) -> float:
    """-1/G is -(1 + 2 delay w) motion/force and N is 2 w velocity/filter, both up to w^2."""
    g = loop.sampled
    if not g.velocity[0]:
        return float("nan")
    turn = 2 * g.delay * g.motion[0] / g.force[0] + _slope(g.motion, g.force)
    return float(-turn * g.filter[0] / (2 * g.velocity[0]))


def _at_minus_one(loop: Loop) -> tuple[float, float, tuple[float, float]]:
    """Return value, slope and the two parts of the bend of the line on which a pole lies at z = -1.

    In u = 1/w, z^delay = (-1)^delay (1 + 2 delay u + ...), N = 2 velocity/((1 + u) filter), and z < -1 is u > 0.
    """
    g = loop.sampled
    motion, force, velocity, bottom = (part[::-1] for part in (g.motion, g.force, g.velocity, g.filter))
    if abs(force[0]) <= Decimal(10) ** (30 - loop.digits) * np.abs(force).max():
        return np.inf, 0.0, (1.0, 0.0)  # the device does not answer at half the sampling rate
    value_at = [-((-1) ** g.delay) * motion[0] / force[0], 2 * velocity[0] / bottom[0]]
    change = [
        -((-1) ** g.delay) * (_slope(motion, force) + 2 * g.delay * motion[0] / force[0]),
        2 * (_slope(velocity, bottom) - velocity[0] / bottom[0]),
    ]
    return float(value_at[0]), float(value_at[1]), (float(change[0]), -float(change[1]))


def _slope(top: Digits, bottom: Digits) -> Decimal:
    """Return the derivative at 0 of a ratio."""
    if len(top) == 1:
        return Decimal(0)
    return Decimal((top[1] * bottom[0] - top[0] * bottom[1]) / bottom[0] ** 2)


def _unstable_when_stiff(loop: Loop) -> int:
    """Number of poles outside the circle, the right half of w, of an endlessly stiff wall without damping."""
    g = loop.sampled
    up, down = as_exact([1, 1]), as_exact([1, -1])
    whole = total(product(power(up, g.delay), g.motion), _STIFF * product(power(down, g.delay), g.force))
    return right_half(whole)


def right_half(polynomial: Digits) -> int:
    """Return the number of roots with positive real part: sign changes of Routh's array."""
    upper, lower = polynomial[::-1][::2], polynomial[::-1][1::2]
    first = [upper[0]]
    while len(lower):  # each step takes a coefficient away
        first.append(lower[0])
        rest = np.append(lower[1:], as_exact([0] * (len(upper) - len(lower))))
        upper, lower = lower, upper[1:] - upper[0] / lower[0] * rest
    signs = [entry > 0 for entry in first]
    return sum(a != b for a, b in pairwise(signs))
