"""High-precision values for the limits in `theory_limits`: nothing here uses a formula of the package.

The plant is its closed form in many digits; energies are plain sums of the loop's motion in integers of fixed point,
which takes as many steps as the response has samples, whatever the delay.
"""

from __future__ import annotations

import math
from collections import deque
from itertools import pairwise
from math import comb

import mpmath as mp
import numpy as np
from independent import characteristic

DIGITS = 120
"""The plant's closed form divides by gamma and delta, down to 1e-16 each; this leaves 60 digits and more."""

BITS = 128
"""Fixed point: 3e-39, far below rounding in doubles also after 1e6 samples and in velocities for alpha = 1e-11."""

NODES = 32
"""Gauss points over a part in which the fastest motion falls by less than exp(8): exact to rounding of doubles."""

EXPONENT = 40.0
"""The energy has fallen by exp(-40) when a sum ends: with the weight k^2 what is left out is below 1e-14."""

Row = list[mp.mpf]


def motion(gamma: float, delta: float, time: mp.mpf) -> tuple[Row, Row]:
    """Return position and velocity after a time, each as a row over (x, v, u)."""
    with mp.workdps(DIGITS):
        g, half, t = mp.mpf(gamma), mp.mpf(delta) / 2, mp.mpf(time)
        root = mp.sqrt(mp.mpc(half * half - g))
        decay = mp.exp(-half * t)
        impulse = decay * (mp.sinh(root * t) / root if root else t).real
        stay = decay * mp.cosh(root * t).real + half * impulse
        if gamma:
            gain = (1 - stay) / g
        elif delta:
            gain = (t - impulse) / (2 * half)
        else:
            gain = t * t / 2
        return [stay, impulse, gain], [-g * impulse, stay - 2 * half * impulse, impulse]


def forms(gamma: float, delta: float, offset: mp.mpf, time: mp.mpf) -> list[list[np.ndarray]]:
    """Return for w = 0, 1, 2 the integrals of (offset + tau)^w p p' over a time, p the row of position or velocity."""
    halvings = max(0, math.ceil(math.log2(delta * float(time) / 4))) if delta else 0
    edges = [mp.mpf(0)] + [time / 2**k for k in range(halvings, -1, -1)]
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    result = [[np.full((3, 3), mp.mpf(0)) for _ in range(2)] for _ in range(3)]
    for low, high in pairwise(edges):
        for node, weight in zip(nodes.tolist(), weights.tolist(), strict=True):
            tau = low + (high - low) * (1 + mp.mpf(node)) / 2
            for i, row in enumerate(motion(gamma, delta, tau)):
                product = np.outer(row, row) * (mp.mpf(weight) * (high - low) / 2)
                for w in range(3):
                    result[w][i] = result[w][i] + product * (offset + tau) ** w
    return result


class Energies:
    """Energy costs of points of one loop, the definitions (5.7) and (5.14) summed directly."""

    def __init__(self, gamma: float, delta: float, delay: float) -> None:
        self.gamma, self.whole = gamma, math.floor(delay)
        fraction = mp.mpf(delay) - self.whole
        # the older force acts first, for the fractional part of a sample
        parts = [(fraction, self.whole + 1), (1 - fraction, self.whole)] if fraction else [(mp.mpf(1), self.whole)]
        self.ages = [age for _, age in parts]
        self.flows = [[[fixed(c) for c in row] for row in motion(gamma, delta, time)] for time, _ in parts]
        offsets = [mp.mpf(0), fraction]
        self.forms = [forms(gamma, delta, offset, time) for offset, (time, _) in zip(offsets, parts, strict=False)]

    def costs(self, alpha: float, beta: float, signal: str, radius: float) -> dict[str, float]:
        """Return the costs of `pipeline.theory.cost.energy.energy_costs` for one point of a given spectral radius."""
        samples = int(EXPONENT / (-2 * math.log(radius))) + 40 * (self.whole + 2)
        products, squares = self._sums(alpha, beta, signal, samples)
        stiffness = mp.mpf(alpha) + mp.mpf(self.gamma)
        scale = (mp.mpf(1), 1 / stiffness) if signal == "step" else (stiffness, mp.mpf(1))
        result = {}
        for w in range(3):
            total = mp.mpf(0)
            for form, sums in zip(self.forms, products, strict=True):
                for i in range(w + 1):
                    combined = scale[0] * form[i][0] + scale[1] * form[i][1]
                    pairs = [combined[a][b] * (1 if a == b else 2) for a in range(3) for b in range(a, 3)]
                    total += comb(w, i) * mp.fsum(c * s[w - i] for c, s in zip(pairs, sums, strict=True))
            result[f"energy_{signal}_w{w}"] = float(total)
            result[f"energy_{signal}_w{w}_discrete"] = float(scale[0] * squares[0][w] + scale[1] * squares[1][w])
        return result

    def _sums(self, alpha: float, beta: float, signal: str, samples: int) -> tuple[list[list[Row]], list[Row]]:
        """Sums of k^w times the products of (e, v, u) at the start of each part, and of e^2 and of steps of e."""
        one = 1 << BITS
        a, b = fixed(mp.mpf(alpha)), fixed(mp.mpf(beta))
        both = a + b
        x, v, held = (-one, 0, a) if signal == "step" else (0, one, 0)
        before = x
        forces = deque([held] * (self.whole + 2), maxlen=self.whole + 2)
        # c0 adds up the products, c1 the sums so far, c2 those: the weights k and k^2 follow at the end, see `weighted`
        count = 6 * len(self.ages) + 1
        c0, c1, c2 = [0] * count, [0] * count, [0] * count
        steps = list(zip([-1 - age for age in self.ages], self.flows, strict=True))
        for _ in range(samples):
            forces.append((b * before - both * x) >> BITS)
            step = x - before
            before = x
            found = [step * step]
            for age, ((xx, xv, xu), (vx, vv, vu)) in steps:
                u = forces[age]
                found += (x * x, x * v, x * u, v * v, v * u, u * u)
                x, v = (xx * x + xv * v + xu * u) >> BITS, (vx * x + vv * v + vu * u) >> BITS
            for i, value in enumerate(found):
                s = c0[i] = c0[i] + value
                s = c1[i] = c1[i] + s
                c2[i] += s
        rows = [weighted(*entry, samples) for entry in zip(c0, c1, c2, strict=True)]
        return [rows[1 + 6 * i : 7 + 6 * i] for i in range(len(steps))], [rows[1], rows[0]]


def fixed(value: mp.mpf) -> int:
    with mp.workdps(DIGITS):
        return int(mp.floor(mp.ldexp(value, BITS) + mp.mpf(1) / 2))


def weighted(c0: int, c1: int, c2: int, samples: int) -> Row:
    """Return the sums of k^w p_k, w = 0, 1, 2, from repeated sums of p: these hold (n - k) and (n - k)(n - k + 1)/2."""
    n = samples
    first = n * c0 - c1
    square = 2 * c2 - c1  # sum of (n - k)^2 p_k
    with mp.workdps(DIGITS):
        return [mp.ldexp(mp.mpf(s), -2 * BITS) for s in (c0, first, square - n * n * c0 + 2 * n * first)]


def limit_of_alpha(gamma: float, delta: float, delay: float, alpha: float, beta: float) -> mp.mpf:
    """Return the alpha next to a given one at which a pole lies on the unit circle, for a given beta."""
    with mp.workdps(50):
        free = characteristic(gamma, delta, delay, 0.0, beta)
        slope = [x - y for x, y in zip(characteristic(gamma, delta, delay, 1.0, beta), free, strict=True)]

        def level(theta: mp.mpf) -> mp.mpc:
            z = mp.expj(theta)
            return -mp.polyval(free, z) / mp.polyval(slope, z)

        roots = np.roots([float(x + mp.mpf(alpha) * y) for x, y in zip(free, slope, strict=True)])
        start = abs(float(np.angle(roots[np.argmin(np.abs(np.abs(roots) - 1))])))
        if start > math.pi - 1e-7:  # a real pole at z = -1; angles of double poles there are good to the root of 1e-15
            return level(mp.pi).real
        theta = mp.findroot(lambda t: level(t).imag, (mp.mpf(start), mp.mpf(start) * (1 + mp.mpf(10) ** -9)))
        return level(theta).real
