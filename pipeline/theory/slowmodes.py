"""The three slowest modes of a response, read from its samples: what is left when all others have died out.

The guess comes from a linear prediction of order three, the poles from the characteristic equation (simultaneous
iteration), the amplitudes from three samples, and nothing is believed that does not reproduce the samples before:
`SlowModes.good`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.loop.loop import Loop
from pipeline.records.batch import Booleans, Floats

Complexes = NDArray[np.complex128]

_ITERATIONS = 3
"""Simultaneous iterations from a guess by three modes, which is close; the convergence is cubic."""

_NOISE = 1e-13
"""Amplitude, relative to the samples, that is rounding."""

_MORE = 10
"""The same where the third pole is searched from afar."""

_THIRD = 0.5 + 0.1j
"""Start of that search."""

_UNUSED = 0.5
"""Pole of a mode without amplitude; any inside the unit circle would do."""

_REPRODUCED = 1e-12
"""Largest deviation from the earlier samples, relative to the largest of them."""

_ROOT = np.exp(2j * np.pi / 3)


@dataclass(frozen=True, eq=False)
class SlowModes:
    """e = sum of c z^t, t samples after the last one that was given.

    Parameters
    ----------
    pole, amplitude : complex128, shape (3, n)
    good : bool, shape (n,)
        Whether the modes reproduce the samples.
    """

    pole: Complexes
    amplitude: Complexes
    good: Booleans

    def part(self, mask: Booleans) -> SlowModes:
        """Return the modes of some points."""
        return SlowModes(self.pole[:, mask], self.amplitude[:, mask], self.good[mask])


def history(loop: Loop) -> int:
    """Return the number of samples that `slow_modes` needs."""
    return 6 * (int(loop.delay) + 1) + 1


def slow_modes(loop: Loop, alpha: Floats, beta: Floats, samples: Floats) -> SlowModes:
    """Return the three slowest modes of responses.

    Parameters
    ----------
    loop : Loop
        With an integer delay.
    alpha, beta : float64, shape (n,)
    samples : float64, shape (>= `history`, n)
        The latest deviations, oldest first.
    """
    with np.errstate(all="ignore"):  # what is no number is not good
        found = _fitted(loop, alpha, beta, samples, three=True)
        rest = np.flatnonzero(~found.good)
        if len(rest):
            again = _fitted(loop, alpha[rest], beta[rest], samples[-history(loop) :, rest], three=False)
            found.pole[:, rest], found.amplitude[:, rest], found.good[rest] = again.pole, again.amplitude, again.good
    return found


def _fitted(loop: Loop, alpha: Floats, beta: Floats, samples: Floats, three: bool) -> SlowModes:
    # d + 1 samples apart: poles of a stable loop near the circle turn by less than pi meanwhile
    apart = int(loop.delay) + 1
    x = [samples[-1 - i * apart] for i in range(6, -1, -1)]
    if three:
        guess = _cubic_roots(*_prediction(x[1:])) ** (1 / apart)
    else:
        # where one pair is left, a third prediction coefficient is noise; the third pole may be any
        two = _quadratic_roots(x[3:]) ** (1 / apart)
        guess = np.concatenate([two, np.full((1, len(alpha)), _THIRD, dtype=np.complex128)])
    pole = _polished(loop, alpha, beta, guess, _ITERATIONS if three else _MORE)
    far = _power(pole, apart)
    last = np.empty_like(pole)  # amplitudes at the last sample
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        value = x[6] - (far[j] + far[k]) * x[5] + far[j] * far[k] * x[4]
        last[i] = value / ((far[i] - far[j]) * (far[i] - far[k])) * (far[i] * far[i])
    scale = np.maximum.reduce([np.abs(value) for value in x])
    back = last / (far * far)
    # a mode that is rounding there would grow without bound on the way back, and its pole may be anywhere
    noise = np.abs(back) <= _NOISE * scale
    back[noise] = last[noise] = 0
    pole[noise], far[noise] = _UNUSED, _UNUSED**apart
    good = np.isfinite(last).all(axis=0) & (np.abs(pole).max(axis=0) < 1)
    good &= np.abs((last / pole).sum(axis=0).real - samples[-2]) <= _REPRODUCED * scale
    for value in (x[3], x[2], x[1], x[0]):
        back /= far
        good &= np.abs(back.sum(axis=0).real - value) <= _REPRODUCED * scale
    return SlowModes(pole, last, np.asarray(good))


def velocity_factor(loop: Loop, alpha: Floats, beta: Floats, pole: Complexes) -> Complexes:
    """Return v/e of modes."""
    (xx, xv), gx = loop.period.transition[0], loop.period.gain[0]
    return np.asarray((pole - xx - gx * force_factor(loop, alpha, beta, pole)) / xv)


def force_factor(loop: Loop, alpha: Floats, beta: Floats, pole: Complexes) -> Complexes:
    """Return u/e of modes, u being the force in the interval after the sample."""
    return np.asarray((beta / pole - (alpha + beta)) / _power(pole, int(loop.delay)))


def _power(base: Complexes, exponent: int) -> Complexes:
    """Whole power by repeated squaring: the general one takes a hundred times as long."""
    result = np.ones_like(base) if exponent % 2 == 0 else base
    while exponent > 1:  # ends: halved each round
        exponent //= 2
        base = base * base
        if exponent % 2:
            result = result * base
    return result


def _prediction(x: list[Floats]) -> tuple[Floats, Floats, Floats]:
    """Coefficients a of x_{j+3} = a_2 x_{j+2} + a_1 x_{j+1} + a_0 x_j, by Cramer's rule."""
    x0, x1, x2, x3, x4, x5 = x
    p, q, r = x1 * x3 - x2 * x2, x0 * x3 - x1 * x2, x0 * x2 - x1 * x1
    s, t = x2 * x4 - x3 * x3, x1 * x4 - x2 * x3
    determinant = x0 * s - x1 * t + x2 * p
    u = x0 * x4 - x2 * x2
    a0 = x3 * s + x4 * -t + x5 * p
    a1 = -x3 * t + x4 * u - x5 * q
    a2 = x3 * p - x4 * q + x5 * r
    return a0 / determinant, a1 / determinant, a2 / determinant


def _cubic_roots(a0: Floats, a1: Floats, a2: Floats) -> Complexes:
    """Roots of w^3 = a_2 w^2 + a_1 w + a_0."""
    third = a2 / 3
    p, q = -a1 - 3 * third**2, -a0 - a1 * third - 2 * third**3
    half = np.sqrt((0.25 * q * q + p**3 / 27).astype(np.complex128))
    cube = np.where(np.abs(half - 0.5 * q) > np.abs(half + 0.5 * q), half - 0.5 * q, -half - 0.5 * q)
    first = cube ** (1 / 3)
    first = np.where(first == 0, 1e-300, first)
    roots = [first, first * _ROOT, first * _ROOT.conjugate()]
    return np.array([third + root - p / (3 * root) for root in roots])


def _quadratic_roots(x: list[Floats]) -> Complexes:
    """Roots of w^2 = a_1 w + a_0 with x_{j+2} = a_1 x_{j+1} + a_0 x_j."""
    determinant = x[1] * x[1] - x[0] * x[2]
    half = 0.5 * (x[1] * x[2] - x[0] * x[3]) / determinant
    spread = np.sqrt((half * half + (x[1] * x[3] - x[2] * x[2]) / determinant).astype(np.complex128))
    return np.array([half + spread, half - spread])


def _polished(loop: Loop, alpha: Floats, beta: Floats, pole: Complexes, iterations: int) -> Complexes:
    """Simultaneous (Ehrlich-Aberth) iteration on the characteristic equation."""
    motion, d = loop.period, int(loop.delay)
    gain, impulse = motion.gain.tolist()
    slip = loop.gamma * gain + loop.delta * impulse
    linear, constant = loop.gamma * gain + slip, loop.gamma * (gain * slip + impulse**2)
    offset = gain * slip + impulse**2
    total = alpha + beta
    for _ in range(iterations):
        zeta = pole - 1
        plant, plant_slope = zeta * (zeta + linear) + constant, 2 * zeta + linear
        power = _power(pole, d)
        plant_slope = power * (plant_slope * pole + (d + 1) * plant)
        plant = plant * (power * pole)
        push, wall = gain * zeta + offset, alpha * pole + beta * zeta
        value = plant + push * wall
        slope = plant_slope + gain * wall + push * total
        newton = slope / value
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            newton[i] -= 1 / (pole[i] - pole[j]) + 1 / (pole[i] - pole[k])
        step = 1 / newton
        pole = np.where(np.isfinite(step), pole - step, pole)
    return pole
