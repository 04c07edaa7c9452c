"""Exact energy sums of many points at once from lagged products: no loop over samples, no horizon.

With x = (e, v) the deviation and velocity (and, for a fractional delay, the force before), u the wall force, p the
whole part of the delay, the sums over k >= 0

    X_m = sum k^w x_k e_{k-m},  U_m = sum k^w u_k e_{k-m}  for m = 0 to p,  M = sum k^w x_k x_k'

obey linear equations. The motion over one sample carries X_m and U_m to X_{m+1}; as u_k = -alpha e_{k-p} - beta
(e_{k-p} - e_{k-p-1}), U_m hangs on X_{p-m}. That is a chain of p + 1 equal sites through which X runs to the right and
its mirror image to the left (`pipeline.theory.cost.chain`). Both ends are X_0, a row of M, and M = P M P' + ... closes
the system: six unknowns a point at most, whatever the delay. Sums of lower weight w are inputs of the higher ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import numpy as np

from pipeline.loop.loop import Loop
from pipeline.records.batch import Booleans, Floats, Integers
from pipeline.theory.cost.chain import Chain, Segment, apply

_CELLS = 1 << 14
"""Points times sites at a time: their arrays stay in the cache."""

_WEIGHTS = (0, 1, 2)

_TRUSTED = 1e-8
"""Relative size of a refinement step up to which a solution is taken; all errors found were then below 5e-12."""


@dataclass(frozen=True, eq=False)
class LagSums:
    """Sums over all samples k >= 0.

    Parameters
    ----------
    moments : float64, shape (3, q + 1, q + 1, n)
        Row w holds the sums of k^w (x, u)(x, u)'; the force u acts at the end of the sample's interval, a force before
        it, in x, at its begin.
    trusted : bool, shape (n,)
        False where digits were lost: take another method there.
    """

    moments: Floats
    trusted: Booleans

    def form(self, matrix: Floats, w: int) -> Floats:
        """Return the sum of k^w q' F q with q = (x, u) and a symmetric F."""
        return np.asarray(np.einsum("ij,ijn->n", matrix, self.moments[w]))


@dataclass(frozen=True, eq=False)
class Step:
    """Motion over one sample, x_{k+1} = x_k + change x_k + gain u_k, and the maps from (x, u) to (e, v, force) at the
    begin of each segment of the sample."""

    change: Floats
    gain: Floats
    starts: tuple[Floats, ...]

    @property
    def move(self) -> Floats:
        """Row from (x, u) to e_{k+1} - e_k, without the difference of positions."""
        return np.append(self.change[0], self.gain[0])


def one_step(loop: Loop) -> Step:
    """Return the motion of a loop over one sample."""
    motion = loop.period
    (_, xv), gain = motion.transition[0].tolist(), motion.gain
    # the transition less one, digits kept: e and v change by forces alone
    change = np.array([[-loop.gamma * gain[0], xv], [-loop.gamma * xv, -loop.delta * xv - loop.gamma * gain[0]]])
    if len(loop.segments) == 1:
        return Step(change, gain, (np.eye(3),))
    first, second = loop.flows
    before = second.transition @ first.gain
    change = np.block([[change, before[:, None]], [np.zeros((1, 2)), -np.ones((1, 1))]])
    late = np.zeros((3, 4))
    late[:2, :3] = np.column_stack([first.transition, first.gain])
    late[2, 3] = 1.0
    return Step(change, np.append(second.gain, 1.0), (np.eye(3, 4), late))


def lag_sums(loop: Loop, alpha: Floats, beta: Floats, signal: str) -> LagSums:
    """Return the sums of a loop's step or impulse response.

    Parameters
    ----------
    loop : Loop
    alpha, beta : float64, shape (n,)
        Stable points with alpha + gamma > 0; elsewhere the result has no meaning.
    signal : {"step", "impulse"}
    """
    step = one_step(loop)
    q = len(step.gain)
    moments = np.empty((len(_WEIGHTS), q + 1, q + 1, len(alpha)))
    trusted = np.empty(len(alpha), dtype=np.bool_)
    chunk = max(1, _CELLS // (int(loop.delay) + 1))
    for i in range(0, len(alpha), chunk):
        part = slice(i, i + chunk)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # met by `trusted`
            moments[..., part], trusted[part] = _Solver(loop, step, alpha[part], beta[part], signal).solve()
    return LagSums(moments, trusted)


@dataclass(frozen=True, eq=False)
class _Sums:
    """What sums of higher weight need of one weight; lags come first, points last.

    Parameters
    ----------
    lags : float64, shape (p + 1, q, n)
        X_0 to X_p.
    later : float64, shape (p + 1, q, n)
        Sum of k^w x_{k+1} e_{k+1-m} for m = 1 to p + 1.
    rise, wall : float64, shape (p + 1, n)
        R_{m+1} - R_m and -alpha R_m + beta (R_{m+1} - R_m), with R the first row of X.
    moments, moved : float64, shapes (q + 1, q + 1, n) and (q, q, n)
        Sums of k^w (x_k, u_k)(x_k, u_k)' and of k^w x_{k+1} x_{k+1}'.
    """

    lags: Floats
    later: Floats
    rise: Floats
    wall: Floats
    moments: Floats
    moved: Floats


class _Solver:
    """Equations of one chunk of points; lags come first, points last.

    With C the `Step.change`, g its gain, c its first row and r = beta c - alpha (1, 0, ..), theta = beta g_0:

        X_{m+1} = X_m + C X_m + g U_m + s_m               for m = 0 to p
        U_m = r X_{p-m} + theta U_{p-m} + k_m             for m = 0 to p
        M = M moved by one sample + K,  X_0 = M (1, 0, ..)

    with s, k and K known. `_core` solves these; what rounding leaves of them is solved for again.
    """

    def __init__(self, loop: Loop, step: Step, alpha: Floats, beta: Floats, signal: str) -> None:
        self.p, self.change, self.gain = int(loop.delay), step.change, step.gain
        self.alpha, self.beta = alpha, beta
        q, start = len(step.gain), loop.starts(np.ones(1), signal)[0]  # position, velocity, position before
        self.before = float(start[2])
        self.start = np.zeros((q, len(alpha)))
        self.start[:2] = start[:2, None]
        self.start[2:] = -alpha * self.before
        # -(alpha + beta) R_m + beta R_{m+1} loses a small alpha, -alpha R_m + beta (R_{m+1} - R_m) does not
        self.row = np.multiply.outer(step.change[0], beta)
        self.row[0] -= alpha
        self.theta = beta * step.gain[0]
        self.eta = 1 / (1 - self.theta**2)
        back = self.gain[:, None, None] * (self.eta * self.row)
        self.chain = Chain(Segment((np.eye(q) + self.change)[..., None] + self.theta * back, back), self.p)
        self.pairs = np.triu_indices(q)
        self.factors, self.order = _eliminate(self._closing())

    def solve(self) -> tuple[Floats, Booleans]:
        """Return the moments, shape (3, q + 1, q + 1, n), and where they can be trusted."""
        lower: list[_Sums] = []
        trusted = np.ones(len(self.alpha), dtype=np.bool_)
        for w in _WEIGHTS:
            s, k, square = self._arriving(w, lower), self._force(w, lower), self._square(w, lower)
            k += self.beta * s[::-1, 0]
            square += self._squared(0.0, s[0, 0])
            known = self._begun(w, lower)
            known += self._driven(self.beta * s[-1], square)
            found = self._core(s, k, known)
            change = self._core(*self._left_over(*found, s, k, known))
            with np.errstate(invalid="ignore"):
                small = np.abs(change[2]) <= _TRUSTED * np.abs(found[2])
            trusted &= small[0, 0] & small[1, 1]
            x, u, m = (value + more for value, more in zip(found, change, strict=True))
            lower.append(self._completed(x, u, m, s, square))
        moments = np.array([sums.moments for sums in lower])
        # sums of squares; a negative one means an unstable point or no digit left
        return moments, trusted & (np.einsum("wiin->win", moments) > 0).all(axis=(0, 1))

    def _core(self, s: Floats, k: Floats, known: Floats) -> tuple[Floats, Floats, Floats]:
        """Solve for X_0 to X_p, U_0 to U_p and M."""
        force = self.eta * (k + self.theta * k[::-1])
        inward = s + self.gain[:, None] * force[:, None]
        inputs = self.chain.solve(inward, inward[::-1])
        last = inputs.last[0]
        pull = self.eta * (self.row * last).sum(axis=0)
        ends = force[0] + pull, force[-1] + self.theta * pull
        right = known + self._driven(*self._pushed(np.zeros_like(last), last, *ends))
        m = np.empty_like(known)
        m[self.pairs] = _substitute(self.factors, right[self.pairs][self.order])
        m[self.pairs[::-1]] = m[self.pairs]
        x = inputs.inside(m[None, 0], m[None, 0])[0]
        pull = self.eta * np.einsum("in,min->mn", self.row, x)
        return x, force + pull[::-1] + self.theta * pull, m

    def _closing(self) -> Floats:
        """Coefficients of the equations of M in the entries of its upper triangle, shape (t, t, n)."""
        columns = []
        for i, j in zip(*self.pairs, strict=True):
            m = np.zeros((*self.change.shape, len(self.alpha)))
            m[i, j] = m[j, i] = 1.0
            last = apply(self.chain.to_last, m[None, 0])[0]
            here, there = (self.eta * (self.row * x).sum(axis=0) for x in (m[0], last))
            pushed = self._pushed(m[0], last, there + self.theta * here, here + self.theta * there)
            columns.append(-self._growth(m, *pushed)[self.pairs])
        return np.stack(columns, axis=1)

    def _left_over(
        self, x: Floats, u: Floats, m: Floats, s: Floats, k: Floats, known: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Return what is left of s, k and K; the last lag, which no equation but its own holds, is exact."""
        moved = np.einsum("ij,mjn->min", self.change, x) + self.gain[:, None] * u[:, None]
        s_left = np.zeros_like(s)
        s_left[:-1] = s[:-1] - (x[1:] - x[:-1] - moved[:-1])
        k_left = k - (u - np.einsum("in,min->mn", self.row, x[::-1]) - self.theta * u[::-1])
        return s_left, k_left, known + self._growth(m, *self._pushed(x[0], x[-1], u[0], u[-1]))

    def _pushed(self, first: Floats, last: Floats, first_force: Floats, last_force: Floats) -> tuple[Floats, Floats]:
        """Return sum k^w x_k u_k and sum k^w u_k^2 without known parts, from X_0, X_p, U_0, U_p."""
        mixed = self.beta * (self.change @ last + np.multiply.outer(self.gain, last_force)) - self.alpha * last
        rise = self.change[0] @ first + self.gain[0] * first_force
        return mixed, self._squared(last_force, rise)

    def _squared(self, last_force: Floats | float, rise: Floats) -> Floats:
        """sum k^w u_k^2 = -(alpha + beta) U_p + beta U_{p+1}, with U_{p+1} - U_p = -(alpha + 2 beta) (R_1 - R_0)."""
        return np.asarray(-self.alpha * last_force - self.beta * (self.alpha + 2 * self.beta) * rise)

    def _growth(self, m: Floats, mixed: Floats, square: Floats) -> Floats:
        """Return what one sample changes of the moments M of x; digits are kept where that is little."""
        turned = np.einsum("ij,jkn->ikn", self.change, m)
        second = np.einsum("ijn,kj->ikn", turned, self.change)
        return np.asarray(turned + turned.swapaxes(0, 1) + second + self._driven(mixed, square))

    def _driven(self, mixed: Floats, square: Floats) -> Floats:
        """Return the part of that by the force, from sum k^w x_k u_k and sum k^w u_k^2."""
        push = (mixed + self.change @ mixed + 0.5 * self.gain[:, None] * square)[:, None] * self.gain[:, None]
        return np.asarray(push + push.swapaxes(0, 1))

    def _begun(self, w: int, lower: list[_Sums]) -> Floats:
        """Return K: the first sample, and what a weight of k + 1 in place of k adds."""
        if w == 0:
            return self.start[:, None] * self.start
        return np.asarray(sum(comb(w, i) * lower[i].moved for i in range(w)))

    def _arriving(self, w: int, lower: list[_Sums]) -> Floats:
        """Return s: the same of the lags, shape (p + 1, q, n)."""
        if w == 0:
            return np.repeat(self.before * self.start[None], self.p + 1, axis=0)
        return np.asarray(sum(comb(w, i) * lower[i].later for i in range(w)))

    def _force(self, w: int, lower: list[_Sums]) -> Floats:
        """Return k without its part by s: a shift of k by m samples, and the samples before 0, shape (p + 1, n)."""
        lag = np.arange(self.p + 1.0)
        history = np.cumsum(np.append(0.0, lag[:-1] ** w)) * self.before**2
        result = -np.multiply.outer(history, self.alpha)
        for i in range(w):
            result += comb(w, i) * (lag ** (w - i))[:, None] * lower[i].wall[::-1]
        return result

    def _square(self, w: int, lower: list[_Sums]) -> Floats:
        """Return the same of sum k^w u_k^2: beta (U_{p+1} - U_p) without its part by R_1 - R_0."""
        p, f, b = float(self.p), -(self.alpha + self.beta), self.beta
        result = b * b * self.before**2 * p**w
        for i in range(w):
            shift, rise, own = p ** (w - i), lower[i].rise[0], lower[i].lags[0, 0]
            result += comb(w, i) * b * ((f - b) * shift * rise + b * ((p + 1) ** (w - i) - shift) * own)
        return np.asarray(result)

    def _completed(self, x: Floats, u: Floats, m: Floats, s: Floats, square: Floats) -> _Sums:
        mixed, squared = self._pushed(x[0], x[-1], u[0], u[-1])
        mixed, squared = mixed + self.beta * s[-1], squared + square
        later = x + np.einsum("ij,mjn->min", self.change, x) + self.gain[:, None] * u[:, None]
        rise = np.einsum("j,mjn->mn", self.change[0], x) + self.gain[0] * u + s[:, 0]
        moments = np.concatenate([np.concatenate([m, mixed[:, None]], 1), np.append(mixed, squared[None], 0)[None]])
        moved = m + self._growth(m, mixed, squared)
        return _Sums(x, later, rise, self.beta * rise - self.alpha * x[:, 0], moments, moved)


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
