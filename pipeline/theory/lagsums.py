"""Exact energy sums of many points at once from lagged products, for integer delays: no loop over samples, no horizon.

With e the deviation, v the velocity and u = f e_{k-d} + b e_{k-d-1} the wall force (f = -(alpha + beta), b = beta), the
sums

    R_m = sum k^w e_k e_{k-m},  S_m = sum k^w v_k e_{k-m},  U_m = sum k^w u_k e_{k-m},  V = sum k^w v_k^2   over k >= 0

obey linear equations: the motion over one sample carries (R, S)_{m-1} and U_{m-1} to (R, S)_m with constants of the
plant; U_m is a sum of two R; and the squares (e, v)_{k+1} close the system. What is left are d + 4 unknowns a point,
R_0, S_0, V and U_0 to U_d, with the same matrix for each weight w. It is solved by elimination with arrays over points
as its elements, which takes a microsecond a point where doubling of matrices takes tens.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import numpy as np

from pipeline.records.batch import Booleans, Floats, Integers
from pipeline.theory.loop import Loop

LARGEST_DELAY = 12
"""Delay up to which elimination, growing as d^3, pays against the doubling of `pipeline.theory.energy`."""

_CHUNK = 4096
"""Points at a time: their matrices stay in the cache."""

_WEIGHTS = (0, 1, 2)

_TRUSTED = 1e-12
"""Relative size of a refinement step up to which a solution is taken; all errors found were then below 6e-11."""


@dataclass(frozen=True, eq=False)
class LagSums:
    """Sums over all samples k >= 0, each of shape (3, n): row w holds the weight k^w.

    Parameters
    ----------
    ee, ev, vv, eu, vu, uu : float64, shape (3, n)
        Products of deviation e, velocity v and wall force u of the same sample.
    trusted : bool, shape (n,)
        False where the elimination lost digits: take another method there.
    """

    ee: Floats
    ev: Floats
    vv: Floats
    eu: Floats
    vu: Floats
    uu: Floats
    trusted: Booleans

    def square(self, e: float, v: float, u: float, w: int) -> Floats:
        """Return the sum of k^w (e e_k + v v_k + u u_k)^2 for three factors."""
        mixed = e * v * self.ev[w] + e * u * self.eu[w] + v * u * self.vu[w]
        return np.asarray(e * e * self.ee[w] + v * v * self.vv[w] + u * u * self.uu[w] + 2 * mixed)

    def form(self, matrix: Floats, w: int) -> Floats:
        """Return the sum of k^w q' M q with q = (e, v, u) and a symmetric M, shape (3, 3)."""
        own = matrix[0, 0] * self.ee[w] + matrix[1, 1] * self.vv[w] + matrix[2, 2] * self.uu[w]
        mixed = matrix[0, 1] * self.ev[w] + matrix[0, 2] * self.eu[w] + matrix[1, 2] * self.vu[w]
        return np.asarray(own + 2 * mixed)


def lag_sums(loop: Loop, alpha: Floats, beta: Floats, signal: str) -> LagSums:
    """Return the sums of a loop's step or impulse response.

    Parameters
    ----------
    loop : Loop
        With an integer delay.
    alpha, beta : float64, shape (n,)
        Stable points with alpha + gamma > 0; elsewhere the result has no meaning.
    signal : {"step", "impulse"}
    """
    sums = np.empty((6, len(_WEIGHTS), len(alpha)))
    trusted = np.empty(len(alpha), dtype=np.bool_)
    for i in range(0, len(alpha), _CHUNK):
        part = slice(i, i + _CHUNK)
        sums[:, :, part], trusted[part] = _Solver(loop, alpha[part], beta[part], signal).solve()
    ee, ev, vv, eu, vu, uu = sums
    return LagSums(ee, ev, vv, eu, vu, uu, trusted)


class _Solver:
    """Equations of one chunk of points; arrays over points come last, lags m = 0 to d + 1 first."""

    def __init__(self, loop: Loop, alpha: Floats, beta: Floats, signal: str) -> None:
        self.d = int(loop.delay)
        motion = loop.period
        (self.xx, self.xv), (self.vx, self.vv) = motion.transition.tolist()
        self.gx, self.gv = motion.gain.tolist()
        self.a, self.f, self.b = alpha, -(alpha + beta), beta
        start = loop.initial(signal)
        self.e0, self.v0, self.before = float(start[0]), float(start[1]), float(start[2])
        self.n = self.d + 4
        self.rows_r, self.rows_s = self._lag_rows()
        self.known_r: list[Floats] = []
        self.known_s: list[Floats] = []
        self.known_u: list[Floats] = []
        self.products: list[list[Floats]] = []  # ee, ev, vv, eu, vu, uu of each weight

    def _lag_rows(self) -> tuple[Floats, Floats]:
        """Coefficients of R_m and S_m in the unknowns."""
        r, s = np.zeros((2, self.d + 2, self.n))
        r[0, 0] = s[0, 1] = 1.0
        for m in range(1, self.d + 2):
            r[m] = self.xx * r[m - 1] + self.xv * s[m - 1]
            s[m] = self.vx * r[m - 1] + self.vv * s[m - 1]
            r[m, 2 + m] += self.gx
            s[m, 2 + m] += self.gv
        return r, s

    def solve(self) -> tuple[Floats, Booleans]:
        """Return the sums, shape (6, 3, points), and where they can be trusted."""
        d, f, b = self.d, self.f, self.b
        matrix = self._matrix()
        factors, order = _eliminate(matrix)
        trusted = np.ones(len(f), dtype=np.bool_)
        for w in _WEIGHTS:
            r, s = self._known_lags(w)
            vu, uu = f * s[d] + b * s[d + 1], b * (f * (r[1] + self._shifted(w, d, 1)) + b * self._shifted(w, d + 1, 0))
            right = self._right_side(w, r, vu, uu)
            y = _substitute(factors, right[order])
            # rows are ordered for one point of the chunk; refinement gives back what that costs the others
            left = sum(matrix[:, j] * y[j] for j in range(self.n))
            change = _substitute(factors, (right - left)[order])
            with np.errstate(invalid="ignore"):
                trusted &= (np.abs(change[[0, 2]]) <= _TRUSTED * np.abs(y[[0, 2]])).all(axis=0)
            y += change
            own = self.rows_s[d:] @ y
            vu += f * own[0] + b * own[1]
            uu += f * y[3 + d] + b * (f * (self.rows_r[1] @ y) + b * y[0])
            if w != _WEIGHTS[-1]:
                self.known_r.append(r + self.rows_r @ y)
                self.known_s.append(s + self.rows_s @ y)
                self.known_u.append(y[3:])
            self.products.append([y[0], y[1], y[2], y[3], vu, uu])
        sums = np.array(self.products).transpose(1, 0, 2)
        # sums of squares; a negative one means an unstable point or no digit left
        return sums, trusted & (sums[[0, 2, 5]] > 0).all(axis=(0, 1))

    def _matrix(self) -> Floats:
        """Coefficients of the d + 4 equations, shape (n, n, points)."""
        f, b, d = self.f, self.b, self.d
        result = np.zeros((self.n, self.n, len(f)))
        vu = self._forced(self.rows_s[d], self.rows_s[d + 1])
        uu = np.multiply.outer(self.rows_r[1], b * f)
        uu[0] += b * b
        uu[3 + d] += f
        for row, (p, q) in enumerate(self._pairs()):
            result[row, row] += 1.0
            result[row, 0] -= p[0] * q[0]
            result[row, 1] -= p[0] * q[1] + p[1] * q[0]
            result[row, 2] -= p[1] * q[1]
            result[row, 3] -= p[0] * q[2] + p[2] * q[0]
            result[row] -= (p[1] * q[2] + p[2] * q[1]) * vu + p[2] * q[2] * uu
        for m in range(d + 1):
            result[3 + m] -= self._forced(self.rows_r[d - m], self.rows_r[d + 1 - m])
            result[3 + m, 3 + m] += 1.0
        return result

    def _forced(self, now: Floats, before: Floats) -> Floats:
        """Coefficients of f now + b before as -alpha now - beta (now - before): f + b alone loses a small alpha."""
        return np.asarray(np.multiply.outer(now, -self.a) - np.multiply.outer(now - before, self.b))

    def _pairs(self) -> tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...]:
        """Factors on (e, v, u) of the two quantities whose next product is R_0, S_0, V."""
        e, v = (self.xx, self.xv, self.gx), (self.vx, self.vv, self.gv)
        return (e, e), (e, v), (v, v)

    def _known_lags(self, w: int) -> tuple[Floats, Floats]:
        """Parts of R_m and S_m that do not depend on the unknowns of weight w."""
        r, s = np.zeros((2, self.d + 2, len(self.f)))
        if w == 0:
            r[1:], s[1:] = self.e0 * self.before, self.v0 * self.before
        for i in range(w):
            factor, u = comb(w, i), self.known_u[i]
            r[1:] += factor * (self.xx * self.known_r[i][:-1] + self.xv * self.known_s[i][:-1] + self.gx * u)
            s[1:] += factor * (self.vx * self.known_r[i][:-1] + self.vv * self.known_s[i][:-1] + self.gv * u)
        for m in range(1, self.d + 2):
            r[m] += self.xx * r[m - 1] + self.xv * s[m - 1]
            s[m] += self.vx * r[m - 1] + self.vv * s[m - 1]
        return r, s

    def _right_side(self, w: int, r: Floats, vu: Floats, uu: Floats) -> Floats:
        f, b, d = self.f, self.b, self.d
        right = np.empty((self.n, len(f)))
        starts = (self.e0 * self.e0, self.e0 * self.v0, self.v0 * self.v0)
        for row, (p, q) in enumerate(self._pairs()):
            factors = (
                *(p[0] * q[0], p[0] * q[1] + p[1] * q[0], p[1] * q[1], p[0] * q[2] + p[2] * q[0]),
                *(p[1] * q[2] + p[2] * q[1], p[2] * q[2]),
            )
            right[row] = factors[4] * vu + factors[5] * uu
            if w == 0:
                right[row] += starts[row]
            for i in range(w):
                for factor, product in zip(factors, self.products[i], strict=True):
                    if factor:
                        right[row] += comb(w, i) * factor * product
        by = np.arange(d + 1)
        # lags d - m and d + 1 - m of the forces' two terms, for m = 0 to d
        right[3:] = f * (r[d::-1] + self._shifted(w, by, slice(d, None, -1)))
        right[3:] += b * (r[:0:-1] + self._shifted(w, by, slice(None, 0, -1)))
        return right

    def _shifted(self, w: int, by: int | Integers, lag: int | slice) -> Floats:
        """Sum of k^w e_{k-by} e_{k-by-lag} without its part R_lag of weight w; of several shifts, one a lag."""
        shift = np.asarray(by, dtype=np.float64)
        history = sum((np.where(shift > q, float(q) ** w, 0.0) for q in range(self.d + 1)), np.zeros_like(shift))
        result = (self.before**2 * history)[..., None]
        for i in range(w):
            result = result + (comb(w, i) * shift ** (w - i))[..., None] * self.known_r[i][lag]
        return result


def _eliminate(matrix: Floats) -> tuple[Floats, Integers]:
    """Return triangular factors of matrices (n, n, points) and the row order of the middle point's pivots."""
    n = len(matrix)
    sample = matrix[:, :, matrix.shape[2] // 2].copy()
    order = np.arange(n)
    for k in range(n):
        pivot = k + int(np.argmax(np.abs(sample[k:, k])))
        order[[k, pivot]] = order[[pivot, k]]
        sample[[k, pivot]] = sample[[pivot, k]]
        sample[k + 1 :, k:] -= np.outer(sample[k + 1 :, k] / sample[k, k], sample[k, k:])
    factors = matrix[order]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # met by `trusted`
        for k in range(n):
            factors[k, k] = 1 / factors[k, k]
            for i in range(k + 1, n):
                factors[i, k] *= factors[k, k]
                factors[i, k + 1 :] -= factors[i, k] * factors[k, k + 1 :]
    return factors, order


def _substitute(factors: Floats, right: Floats) -> Floats:
    y = right.copy()
    n = len(y)
    with np.errstate(invalid="ignore", over="ignore"):
        for k in range(n):
            y[k + 1 :] -= factors[k + 1 :, k] * y[k]
        for k in range(n - 1, -1, -1):
            y[k] *= factors[k, k]
            y[:k] -= factors[:k, k] * y[k]
    return y
