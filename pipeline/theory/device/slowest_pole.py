"""The slowest pole of a general loop in many digits, and how far it is from the next."""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal

import numpy as np

from pipeline.loop.loop import Loop
from pipeline.loop.many_digits import Digits, as_exact, derivative, many_digits, power, product, total
from pipeline.records.batch import Floats

_NEAR = 1e-4
"""Distance from the largest modulus within which an eigenvalue may be it: a fourfold pole is split so far."""

_STEPS = 80
"""Newton steps; at a double pole, which each only halves the distance to, to 1e-20."""

_FINE = Decimal("1e-20")

Complex = tuple[Decimal, Decimal]


@dataclass(frozen=True)
class SlowestPole:
    """Largest pole modulus, good to a double's last digits where ``separation`` is above some 1e-9.

    ``separation`` is the distance to the nearest other pole, its own conjugate left out: a pole of multiplicity two
    moves by the root of what the parameters are rounded by.
    """

    radius: float
    separation: float


def slowest_poles(loop: Loop, alpha: Floats, beta: Floats) -> list[SlowestPole]:
    """Return the slowest pole of each point, alpha and beta of shape (n,)."""
    found = np.linalg.eigvals(loop.matrix(alpha, beta))
    return [_slowest(loop, a, b, z) for a, b, z in zip(alpha, beta, found, strict=True)]


def characteristic(loop: Loop, alpha: float, beta: float) -> Digits:
    """Return the characteristic polynomial in w = (z - 1)/(z + 1), lowest power first."""
    g = loop.sampled
    with many_digits(loop.digits):
        up, down, two_w = as_exact([1, 1]), as_exact([1, -1]), as_exact([0, 2])
        bottom, top = product(up, g.filter), product(two_w, g.velocity)
        wall = total(Decimal(float(alpha)) * bottom, Decimal(float(beta)) * top)
        return total(product(power(up, g.delay), g.motion, bottom), product(power(down, g.delay), g.force, wall))


def _slowest(loop: Loop, alpha: float, beta: float, poles: np.ndarray) -> SlowestPole:
    size = np.abs(poles)
    candidates = poles[(size >= size.max() * (1 - _NEAR)) & (poles.imag >= 0)]
    polynomial = characteristic(loop, alpha, beta)
    with many_digits(loop.digits):
        slope = derivative(polynomial)
        refined = [_newton(polynomial, slope, z) for z in candidates]
        radius, pole = max((float((z[0] ** 2 + z[1] ** 2).sqrt()), complex(*map(float, z))) for z in refined)
    own = np.argsort(np.minimum(np.abs(poles - pole), np.abs(poles - pole.conjugate())))
    others = np.delete(poles, own[: 2 if abs(pole.imag) > 0 else 1])
    return SlowestPole(radius, float(np.abs(others - pole).min(initial=np.inf)))


def _newton(polynomial: Digits, slope: Digits, start: complex) -> Complex:
    """Return z at the root of a polynomial in w next to a first guess of z."""
    guess = (start - 1) / (start + 1)
    w = (Decimal(guess.real), Decimal(guess.imag))
    for _ in range(_STEPS):
        value, change = _value(polynomial, w), _value(slope, w)
        if not any(value):
            break
        step = _quotient(value, change)
        w = (w[0] - step[0], w[1] - step[1])
        if abs(step[0]) + abs(step[1]) <= _FINE * (abs(w[0]) + abs(w[1])):
            break
    return _quotient((1 + w[0], w[1]), (1 - w[0], -w[1]))


def _value(polynomial: Digits, place: Complex) -> Complex:
    x, y = Decimal(0), Decimal(0)
    for coefficient in polynomial[::-1]:
        x, y = x * place[0] - y * place[1] + coefficient, x * place[1] + y * place[0]
    return x, y


def _quotient(top: Complex, bottom: Complex) -> Complex:
    size = bottom[0] ** 2 + bottom[1] ** 2
    return (
        (top[0] * bottom[0] + top[1] * bottom[1]) / size,
        (top[1] * bottom[0] - top[0] * bottom[1]) / size,
    )
