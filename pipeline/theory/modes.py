"""Modes of a loop's responses: each state at each sample as a sum of powers of the poles.

The loop without its delayed forces is small. Of it the determinant and the adjugate of z - A, as polynomials in
zeta = z - 1, are known once; poles are then roots of a polynomial in zeta and z, found for all points at once
(Ehrlich and Aberth) from those of neighbours, and the eigenvectors follow from the adjugate. Eigenvalues of the whole
matrix serve as first guesses, and alone where the roots do not come out: of poles that meet, and of long filters.
"""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pipeline.loop.loop import Loop
from pipeline.loop.many_digits import as_exact, as_floats, many_digits
from pipeline.records.batch import Booleans, Floats, Integers

Complexes = NDArray[np.complex128]

TOGETHER = 16384
"""Points that are computed together: their states fit a cache."""

_GONE = 1e-30
"""Pole of a motion that ends at once."""

_CANCELLED = 1e3
"""Sizes of all modes over that of their sum from which on they cancel too many digits: rounding grows as the square."""

_REPRODUCED = 1e-12
"""Largest difference of the state at sample 0 and its modes, relative to these."""

_LONGEST = 8
"""States without delayed forces up to which polynomials keep their digits."""

_NEIGHBOURS = 24
"""Points that start from the poles of the same one."""

_STEPS = 30
"""Simultaneous iterations at most: some five from a neighbour's poles, each with three times the digits."""

_FOUND = 1e-12
"""Step, relative to the distance from z = 1, after which a pole is known to rounding."""

_APART = 1e-3
"""Share by which first guesses are turned: real ones would stay real."""

_EIGENVALUE = 1e-14
"""Rounding of eigenvalues that lie apart."""

_CACHED = 1 << 15
"""Entries of the arrays that are computed at a time."""


@dataclass(frozen=True, eq=False)
class Modes:
    """z_k = sum over i of state[:, :, i] pole[:, i]^k for n points.

    Parameters
    ----------
    pole : complex128, shape (n, modes)
    state : complex128, shape (n, states, modes)
        What each mode has of the loop's state at sample 0; nan where modes lie so close together that they cancel.
    rounding : float64, shape (n, modes)
        What rounding may have moved each pole by.
    """

    pole: Complexes
    state: Complexes
    rounding: Floats

    def part(self, which: Integers | Booleans | slice) -> Modes:
        """Return the modes of some points."""
        return Modes(self.pole[which], self.state[which], self.rounding[which])

    @property
    def rate(self) -> Floats:
        """Decay per sample, -ln |pole|; shape (n, modes)."""
        return -np.log(np.maximum(np.abs(self.pole), _GONE))

    def grown(self, sample: Floats) -> Complexes:
        """Return pole^sample, shape (n, modes), of samples of shape (n,)."""
        return np.asarray(np.exp(sample[:, None] * (1j * np.angle(self.pole) - self.rate)))

    def at(self, sample: Floats) -> Floats:
        """Return the state at samples of shape (n,); shape (states, n)."""
        return np.ascontiguousarray((self.state @ self.grown(sample)[:, :, None])[:, :, 0].real.T)


def modes(loop: Loop, alpha: Floats, beta: Floats, signal: str) -> Modes:
    """Return the modes of responses; those of the latest points are kept, as several costs ask for them.

    Parameters
    ----------
    loop : Loop
    alpha, beta : float64, shape (n,)
    signal : {"step", "impulse"}

    Returns
    -------
    Modes
        Of n points; the states are those of `loop.matrix` (position error, its history, delayed commands, device).

    """
    return _modes(loop, alpha.tobytes(), beta.tobytes(), signal)


@lru_cache(maxsize=1)
def _modes(loop: Loop, alpha: bytes, beta: bytes, signal: str) -> Modes:
    a, b = np.frombuffer(alpha), np.frombuffer(beta)
    start, states = loop.starts(a, signal), loop.states
    pole, state = np.empty((len(a), states), np.complex128), np.empty((len(a), states, states), np.complex128)
    rest, rounding = np.ones(len(a), np.bool_), np.full(pole.shape, _EIGENVALUE)
    if states - loop.oldest_force <= _LONGEST:
        zeta, known = _poles(loop, a, b)
        pole, rounding, chunk = zeta.T + 1, _rounding(loop, a, b, zeta).T, max(_NEIGHBOURS, _CACHED // states**2)
        for some in (slice(i, i + chunk) for i in range(0, len(a), chunk)):
            with np.errstate(all="ignore"):  # what is no number is left to eigenvectors
                state[some] = _states(loop, a[some], b[some], zeta[:, some], start[some])
            rest[some] = ~(known[some] & _reproduce(state[some], start[some]))
    last = np.flatnonzero(rest)
    pole[last], state[last] = _by_eigenvectors(loop.matrix(a[last], b[last]), start[last])
    rounding[last] = _EIGENVALUE
    with np.errstate(over="ignore", invalid="ignore"):  # what is no number, or too large for one, is not apart
        apart = np.linalg.norm(state, axis=1).sum(axis=1) <= _CANCELLED * np.linalg.norm(start, axis=1)
        apart &= _reproduce(state, start)
    state[~apart] = np.nan
    return Modes(pole, state, rounding)


def _reproduce(state: Complexes, start: Floats) -> Booleans:
    """Return whose modes make up the state at sample 0; a pole next to z = 0 has lost its digits."""
    with np.errstate(invalid="ignore"):
        off = np.abs(state.sum(axis=2) - start)
        return np.asarray((off <= _REPRODUCED * np.abs(state).sum(axis=2).max(axis=1)[:, None]).all(axis=1))


def _by_eigenvectors(matrix: Floats, start: Floats) -> tuple[Complexes, Complexes]:
    pole, vectors = (part.astype(np.complex128) for part in np.linalg.eig(matrix))
    apart = np.isfinite(np.linalg.slogdet(vectors)[1])
    vectors[~apart] = np.eye(matrix.shape[1])
    amplitude = np.linalg.solve(vectors, start[:, :, None])[:, :, 0]
    amplitude[~apart] = np.nan
    return pole, vectors * amplitude[:, None, :]


@dataclass(frozen=True, eq=False)
class _Resolvent:
    """Determinant D and adjugate of z - A without delayed forces, as polynomials in zeta, lowest power first.

    Parameters
    ----------
    determinant : float64, shape (own + 1,)
    rows : float64, shape (2, own, own)
        Position and velocity times the adjugate: powers, states.
    columns : float64, shape (own + 1, own)
        The adjugate times the gains of the forces, those of the newer one times z: powers, states.
    wall : float64, shape (2, own + 1)
        Position and velocity times the columns: the poles' equation is z^delay D + alpha wall_0 + beta wall_1 = 0.
    gains : float64, shape (2, own)
        Of the oldest force, and of the one after it.
    """

    determinant: Floats
    rows: Floats
    columns: Floats
    wall: Floats
    gains: Floats


@lru_cache(maxsize=64)
def _resolvent(loop: Loop) -> _Resolvent:
    steps, n = loop.own, len(loop.own.free)
    with many_digits(loop.digits):
        one, none = as_exact(np.eye(n)), as_exact(np.zeros((1, n)))
        power, determinant, adjugate = one, [Decimal(1)], []
        for k in range(1, n + 1):  # Faddeev and LeVerrier
            adjugate.append(power)
            moved = (steps.free - one) @ power
            determinant.append(-sum(np.diagonal(moved), Decimal(0)) / k)
            power = moved + determinant[-1] * one
        inverse = np.array(adjugate[::-1])
        older, newer = (steps.gains[0], steps.gains[1] if len(steps.gains) > 1 else none[0])
        columns = np.concatenate([inverse @ (older + newer), none]) + np.concatenate([none, inverse @ newer])
        outputs = np.array([steps.position, steps.velocity])
        rows = np.swapaxes(outputs @ inverse, 0, 1)
        parts = np.array(determinant[::-1]), rows, columns, outputs @ columns.T, np.array([older, newer])
        return _Resolvent(*map(as_floats, parts))


def _poles(loop: Loop, alpha: Floats, beta: Floats) -> tuple[Complexes, Booleans]:
    """Return zeta of all poles, shape (modes, n), and of which points they are known."""
    centre = np.arange(0, len(alpha), _NEIGHBOURS)
    first = np.linalg.eigvals(loop.matrix(alpha[centre], beta[centre])).T - 1.0
    turned = first * (1 + _APART * np.exp(1j * np.arange(1, len(first) + 1)))[:, None]
    zeta = turned[:, np.arange(len(alpha)) // _NEIGHBOURS]
    known, active = np.zeros(len(alpha), np.bool_), np.arange(len(alpha))
    with np.errstate(all="ignore"):  # what is no number is not known
        for _ in range(_STEPS):
            place = zeta[:, active]
            step = _step(loop, alpha[active], beta[active], place)
            zeta[:, active] = place - step
            size = np.abs(step) - _FOUND * np.abs(place)
            known[active] = (size <= 0).all(axis=0)
            active = active[(size > 0).any(axis=0)]
            if not len(active):
                break
    return zeta, known


def _step(loop: Loop, alpha: Floats, beta: Floats, zeta: Complexes) -> Complexes:
    """Return steps of Ehrlich's and Aberth's iteration."""
    value, slope = _characteristic(loop, alpha, beta, zeta)
    others = np.zeros_like(zeta)
    for i in range(len(zeta) - 1):
        away = 1 / (zeta[i] - zeta[i + 1 :])
        others[i] += away.sum(axis=0)
        others[i + 1 :] -= away
    return np.asarray(value / (slope - value * others))


def _characteristic(loop: Loop, alpha: Floats, beta: Floats, zeta: Complexes) -> tuple[Complexes, Complexes]:
    """Return the characteristic equation and its slope."""
    r, delay = _resolvent(loop), loop.oldest_force
    top, top_slope = _value_and_slope(r.determinant, zeta)
    wall, wall_slope = _value_and_slope(r.wall[0][:, None] * alpha + r.wall[1][:, None] * beta, zeta)
    power = (1 + zeta) ** delay
    return power * top + wall, power * (top_slope + delay * top / (1 + zeta)) + wall_slope


def _rounding(loop: Loop, alpha: Floats, beta: Floats, zeta: Complexes) -> Floats:
    """Return what rounding of the equation's terms moves its roots by."""
    r, size = _resolvent(loop), np.abs(zeta)
    walls = np.abs(r.wall[0])[:, None] * np.abs(alpha) + np.abs(r.wall[1])[:, None] * np.abs(beta)
    gross = np.abs(1 + zeta) ** loop.oldest_force * _value_and_slope(np.abs(r.determinant), size)[0]
    with np.errstate(all="ignore"):
        gross = gross + _value_and_slope(walls, size)[0]
        return np.asarray(np.finfo(np.float64).eps * gross / np.abs(_characteristic(loop, alpha, beta, zeta)[1]))


def _value_and_slope(coefficients: Floats, place: Complexes) -> tuple[Complexes, Complexes]:
    value, slope = coefficients[-1] + 0 * place, 0 * place
    for coefficient in coefficients[-2::-1]:
        slope = slope * place + value
        value = value * place + coefficient
    return value, slope


def _states(loop: Loop, alpha: Floats, beta: Floats, zeta: Complexes, start: Floats) -> Complexes:
    """Return what each mode has of the states at sample 0, shape (n, states, modes), by right and left eigenvectors.

    With s the states without forces, G the gains of the oldest force and of z times the newer one: right ones are
    (adj G, D z^(delay - age)), left ones (law adj z^delay, law adj G z^(age - 1)); of the oldest force alone its own
    gain counts.
    """
    r, delay, own = _resolvent(loop), loop.oldest_force, len(_resolvent(loop).gains[0])
    powers = zeta ** np.arange(own + 1)[:, None, None]
    determinant, right = np.tensordot(r.determinant, powers, 1), np.tensordot(r.columns.T, powers, 1)
    by_position, by_velocity = (np.tensordot(rows.T, powers[:-1], 1) for rows in r.rows)
    left = -alpha * by_position - beta * by_velocity
    z = 1 + zeta
    forces = z ** np.arange(delay)[:, None, None]  # z^(delay - age), oldest last in the state
    far = z**delay
    oldest, newer = (np.tensordot(gain, left, 1) for gain in r.gains)
    pushed = oldest + z * newer
    size = far * (left * right).sum(axis=0)
    begun = far * np.einsum("smn,ns->mn", left, start[:, :own])
    if delay:
        ahead = forces[-1]
        size += determinant * ahead * ((delay - 1) * pushed + oldest)
        begun += ahead * oldest * start[:, -1] + pushed * np.einsum("jmn,nj->mn", forces[:-1], start[:, own:-1])
    amplitude = begun / size
    state = np.concatenate([amplitude * right, amplitude * determinant * forces[::-1]])
    return np.asarray(state.transpose(2, 0, 1))
