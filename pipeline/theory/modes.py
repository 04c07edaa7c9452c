"""Modes of a loop's responses: each state at each sample as a sum of powers of the poles.

The loop without its delayed forces is small. Of it the determinant and the adjugate of z - A, as polynomials in
zeta = z - 1, are known once; poles are then roots of a polynomial in zeta and z, found for all points at once
(Ehrlich and Aberth) from those of neighbours, and the eigenvectors follow from the adjugate. Eigenvalues of the whole
matrix serve as first guesses, and alone where the roots do not come out: of poles that meet, and of long filters.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from math import comb

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray

from pipeline.loop.many_digits import as_exact, as_floats, many_digits, resolvent
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.records.trials import Booleans, Floats, Integers
from pipeline.theory.circle import bisect
from pipeline.theory.motion import DEGREE, Motion, joined, pieces, starts

Complexes = NDArray[np.complex128]

TOGETHER = 12288
"""Points that are computed together: their states fit a cache."""

_GONE = 1e-30
"""Pole of a motion that ends at once."""

_CANCELLED = 1e3
"""Sizes of all modes over that of their sum from which on they cancel too many digits: rounding grows as the square."""

_ROUNDED = 1e-12
"""What rounding may leave: of a pole's step relative to its distance from z = 1, of a real one's imaginary part, and of
the difference of the state at sample 0 and its modes, relative to these."""

_LONGEST = 8
"""States without delayed forces up to which polynomials keep their digits."""

_NEIGHBOURS = 24
"""Points that start from the poles of the same one."""

_STEPS = 30
"""Simultaneous iterations at most: some five from a neighbour's poles, each with three times the digits."""

_APART = 1e-3
"""Share by which first guesses are turned: real ones would stay real."""

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
    """

    pole: Complexes
    state: Complexes

    def part(self, which: Integers | Booleans | slice) -> Modes:
        """Return the modes of some points."""
        return Modes(self.pole[which], self.state[which])

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


def modes(loop: NormalisedLoop, alpha: Floats, beta: Floats) -> Modes:
    """Return the modes of step responses; those of the latest points are kept, as several costs ask for them.

    Parameters
    ----------
    loop : NormalisedLoop
    alpha, beta : float64, shape (n,)

    Returns
    -------
    Modes
        Of n points; the states are those of `loop.matrix` (position error, its history, delayed commands, device).

    """
    return _modes(loop, alpha.tobytes(), beta.tobytes())


@lru_cache(maxsize=1)
def _modes(loop: NormalisedLoop, alpha: bytes, beta: bytes) -> Modes:
    return _fresh(loop, np.frombuffer(alpha), np.frombuffer(beta))


def _fresh(loop: NormalisedLoop, a: Floats, b: Floats) -> Modes:
    start, states = loop.starts(a, "step"), loop.states
    pole, state = np.empty((len(a), states), np.complex128), np.empty((len(a), states, states), np.complex128)
    rest = np.ones(len(a), np.bool_)
    if states - loop.oldest_force <= _LONGEST:
        zeta, known = _poles(loop, a, b)
        pole, chunk = zeta.T + 1, max(_NEIGHBOURS, _CACHED // states**2)
        for some in (slice(i, i + chunk) for i in range(0, len(a), chunk)):
            with np.errstate(all="ignore"):  # what is no number is left to eigenvectors
                state[some] = _states(loop, a[some], b[some], zeta[:, some], start[some])
            rest[some] = ~(known[some] & _reproduce(state[some], start[some]))
    last = np.flatnonzero(rest)
    pole[last], state[last] = _by_eigenvectors(loop.matrix(a[last], b[last]), start[last])
    with np.errstate(over="ignore", invalid="ignore"):  # what is no number, or too large for one, is not apart
        apart = np.linalg.norm(state, axis=1).sum(axis=1) <= _CANCELLED * np.linalg.norm(start, axis=1)
        apart &= _reproduce(state, start)
    pole.imag[np.abs(pole.imag) < _ROUNDED] = 0.0
    state[~apart] = np.nan
    return Modes(pole, state)


def _reproduce(state: Complexes, start: Floats) -> Booleans:
    """Return whose modes make up the state at sample 0; a pole next to z = 0 has lost its digits."""
    with np.errstate(invalid="ignore"):
        off = np.abs(state.sum(axis=2) - start)
        return np.asarray((off <= _ROUNDED * np.abs(state).sum(axis=2).max(axis=1)[:, None]).all(axis=1))


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
def _resolvent(loop: NormalisedLoop) -> _Resolvent:
    steps, n = loop.own, len(loop.own.free)
    with many_digits(loop.digits):
        none = as_exact(np.zeros((1, n)))
        determinant, inverse = resolvent(steps.free - as_exact(np.eye(n)))
        older, newer = (steps.gains[0], steps.gains[1] if len(steps.gains) > 1 else none[0])
        columns = np.concatenate([inverse @ (older + newer), none]) + np.concatenate([none, inverse @ newer])
        outputs = np.array([steps.position, steps.velocity])
        rows = np.swapaxes(outputs @ inverse, 0, 1)
        parts = determinant, rows, columns, outputs @ columns.T, np.array([older, newer])
        return _Resolvent(*map(as_floats, parts))


def _poles(loop: NormalisedLoop, alpha: Floats, beta: Floats) -> tuple[Complexes, Booleans]:
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
            size = np.abs(step) - _ROUNDED * np.abs(place)
            known[active] = (size <= 0).all(axis=0)
            active = active[(size > 0).any(axis=0)]
            if not len(active):
                break
    return zeta, known


def _step(loop: NormalisedLoop, alpha: Floats, beta: Floats, zeta: Complexes) -> Complexes:
    """Return steps of Ehrlich's and Aberth's iteration."""
    value, slope = _characteristic(loop, alpha, beta, zeta)
    others = np.zeros_like(zeta)
    for i in range(len(zeta) - 1):
        away = 1 / (zeta[i] - zeta[i + 1 :])
        others[i] += away.sum(axis=0)
        others[i + 1 :] -= away
    return np.asarray(value / (slope - value * others))


def _characteristic(loop: NormalisedLoop, alpha: Floats, beta: Floats, zeta: Complexes) -> tuple[Complexes, Complexes]:
    """Return the characteristic equation and its slope."""
    r, delay = _resolvent(loop), loop.oldest_force
    top, top_slope = _value_and_slope(r.determinant, zeta)
    wall, wall_slope = _value_and_slope(r.wall[0][:, None] * alpha + r.wall[1][:, None] * beta, zeta)
    power = (1 + zeta) ** delay
    return power * top + wall, power * (top_slope + delay * top / (1 + zeta)) + wall_slope


def _value_and_slope(coefficients: Floats, place: Complexes) -> tuple[Complexes, Complexes]:
    value, slope = coefficients[-1] + 0 * place, 0 * place
    for coefficient in coefficients[-2::-1]:
        slope = slope * place + value
        value = value * place + coefficient
    return value, slope


def _states(loop: NormalisedLoop, alpha: Floats, beta: Floats, zeta: Complexes, start: Floats) -> Complexes:
    """Return what each mode has of the states at sample 0, shape (n, states, modes), by right and left eigenvectors.

    With s the states without forces, G the gains of the oldest force and of z times the newer one: right ones are
    (adj G, D z^(delay - age)), left ones (law adj z^delay, law adj G z^(age - 1)); of the oldest force alone its own
    gain counts.
    """
    r, delay, own = _resolvent(loop), loop.oldest_force, len(_resolvent(loop).gains[0])
    determinant, right = polyval(zeta, r.determinant), polyval(zeta, r.columns)
    by_position, by_velocity = (polyval(zeta, rows) for rows in r.rows)
    left = -alpha * by_position - beta * by_velocity
    z = 1 + zeta
    forces = z ** np.arange(delay)[:, None, None]  # z^(delay - age), oldest last in the state
    far = z**delay
    oldest, newer = (np.einsum("s,smn->mn", gain, left) for gain in r.gains)
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


_STILL_REPRODUCED = 1e-11
"""Largest difference of a state and its modes, relative to its motion; as much again every `_ROUNDED_AWAY` samples."""

_ROUNDED_AWAY = 64
"""Samples: a pole's rounding turns its mode a little further with each."""

_STRIDES = 60
"""Strides back from the end of an envelope at most."""

_SHORTEST = 2.0
"""Samples of a stride, or of motion that is known ahead, that are no quicker than following them."""

WINDOW = 12.0
"""Samples in front of the end that are followed."""

_FEW_STATES = 32
"""States up to which modes of 4,096 points fit a memory of some 100 MB."""

_ROUNDING = 0.99
"""Share of a leading negative mode that all others together may have for it to keep its sign."""


class Outlook:
    """What modes tell of points that move.

    Parameters
    ----------
    run : Motion
        The points.
    past : Modes
        Theirs.

    Notes
    -----
    ``run`` are those of which modes tell, ``unknown`` the others.
    """

    def __init__(self, run: Motion, past: Modes) -> None:
        known = _told(run, past)
        known &= (past.rate > 0).all(axis=1)  # one that rounding leaves no decay never ends
        self.run, self.unknown, self.past = run.part(known), run.part(~known), past.part(known)
        self.pole, self.rate = self.past.pole, self.past.rate
        seen = run.loop.seen(run.loop.law(self.run.alpha, self.run.beta), self.past.state)
        seen *= self.past.grown(self.run.sample)[:, None, :]
        # real times complex, as two real ones
        self.sensed = (_bernstein(run.loop) @ seen.view(np.float64)).view(np.complex128)
        """Coefficients of each mode's motion in the next interval, shape (n, coefficients, modes)."""
        self.size = np.abs(self.sensed).max(axis=1)

    def before_the_end(self, band: float) -> Motion:
        """Return the points a few samples before the first from which on modes tell that they stay in the band."""
        run = self.run.part(slice(None))
        run.since, run.begun = run.sample, run.state
        run.stop = run.sample + _envelope_end(self.size.T, self.rate.T, band) + 1
        return self.before(run, band, WINDOW)

    def before(self, run: Motion, band: float, window: float) -> Motion:
        """Return points so many samples before the first from which on they stay in the band up to their stop."""
        run.stop = run.sample + self._settled(run.stop - run.sample - 1, band) + 1
        return _placed(run, self.past, np.maximum(np.floor(run.stop - window), run.since))

    def _settled(self, end: Floats, band: float) -> Floats:
        """Return a time from now [samples] from which on the motion is inside a band for sure, as it is from an end on.

        From the end backwards: by where the motion is, which way it goes, and how much all modes
        together can bend it, a stride is known in which it stays inside. Strides shorten towards where it is left.
        """
        place, turn = self.sensed[:, 0], 1j * np.angle(self.pole) - self.rate
        within, bend = np.abs(self.sensed - place[:, None]).max(axis=1), np.abs(place * turn**2)
        result, some = end.copy(), np.flatnonzero(end > WINDOW)

        def stride(before: Floats, room: Floats, away: Floats) -> Floats:
            """Return how far back the motion stays inside, if that is not before a time: of both sides of the band."""
            left = np.exp(-self.rate[some] * before[:, None])
            free = np.maximum(room - (within[some] * left).sum(axis=1), 0.0)
            curve = (bend[some] * left).sum(axis=1)
            return np.asarray((2 * free / (away + np.sqrt(away**2 + 2 * curve * free) + _GONE)).min(axis=0))

        for _ in range(_STRIDES):
            if not len(some):
                break
            time = result[some]
            parts = place[some] * np.exp(turn[some] * time[:, None])
            at, slope = parts.sum(axis=1).real, (parts * turn[some]).sum(axis=1).real
            room, away = band - np.array([at, -at]), np.array([-slope, slope])
            first = np.minimum(stride(time, room, away), time)
            length = np.minimum(first, stride(time - first, room, away))
            result[some] = time - length
            some = some[length >= _SHORTEST]
        return result

    def before_a_peak(self, peak: Floats) -> Motion:
        """Return the points whose motion may exceed a peak, shape (n,), at a sample before it does."""
        with np.errstate(all="ignore"):  # of no motion at all nothing is finite
            free = np.nan_to_num(self._below(peak), nan=0.0, posinf=np.inf)
        may = np.flatnonzero(np.isfinite(free))
        sample = self.run.sample[may] + np.where(free[may] >= _SHORTEST, np.floor(free[may]), 0.0)
        return _placed(self.run.part(may), self.past.part(may), sample)

    def _below(self, peak: Floats) -> Floats:
        """Return samples in which the envelopes keep the motion below a peak; infinity where they always do.

        They do where all modes that may rise above the final position are smaller than the peak; also while a real mode
        below it outweighs them. The ratio of a sum of exponentials to one exponential is convex in time: it suffices to
        know it now and where the others are below the peak.
        """
        # what a motion below zero keeps of itself within an interval
        least = np.maximum(-self.sensed.real.max(axis=1), 0.0)
        below = (self.pole.imag == 0) & (self.pole.real > 0) & (least > 0)
        others = np.where(below, 0.0, self.size)
        total = others.sum(axis=1)
        result = np.where(total <= peak, np.inf, 0.0)
        lead = np.argmax(np.where(below, self.size, -1.0), axis=1)[:, None]
        decay, outweighs = (np.take_along_axis(values, lead, 1) for values in (self.rate, _ROUNDING * least))
        some = np.flatnonzero((total > peak) & (total <= outweighs[:, 0]))
        others, faster, outweighs = others[some], self.rate[some] - decay[some], outweighs[some, 0]
        slowest = np.where(others > 0, self.rate[some], np.inf).min(axis=1)

        def holds(time: Floats) -> Booleans:
            return np.asarray((others * np.exp(-faster * time[:, None])).sum(axis=1) <= outweighs)

        span = np.log(total[some] / peak[some]) / slowest
        result[some] = np.where(holds(span), np.inf, bisect(holds, np.zeros(len(some)), span, 24)[0])
        return result


def outlooks(run: Motion, everyone: Motion) -> Iterator[Outlook]:
    """Yield what modes tell of points, of which some may be unknown; ``everyone`` are all that were started with them.

    Modes of few states are those of everyone, since energies take them too; of many states they would fill the memory.
    """
    states = run.loop.states
    if states <= _FEW_STATES:
        yield Outlook(run, modes(run.loop, everyone.alpha, everyone.beta).part(run.index - everyone.index[0]))
        return
    together = max(1, TOGETHER * _FEW_STATES**2 // (4 * states**2))
    for first in range(0, len(run.index), together):
        some = run.part(slice(first, first + together))
        yield Outlook(some, modes(run.loop, some.alpha, some.beta))


def earlier(run: Motion, band: float, window: float) -> Motion:
    """Return points that are inside a band from where they are up to their stop, so many samples before they must be.

    Those of which modes tell no more return from where samples were left out.
    """
    parts = [run]
    for first in range(0, len(run.index), TOGETHER):
        part = run.part(slice(first, first + TOGETHER))
        part.sample, part.stop, part.state = part.since, part.sample + 1, part.begun
        view = Outlook(part, _fresh(part.loop, part.alpha, part.beta))  # those of everyone stay kept
        parts += [view.before(view.run, band, window), view.unknown]
    return joined(parts[1:] or parts)


def _told(run: Motion, past: Modes) -> Booleans:
    """Return which points are where their modes say."""
    off = np.abs(past.at(run.sample) - run.state)[: len(run.scale)]
    limit = _STILL_REPRODUCED * (1 + run.sample / _ROUNDED_AWAY)
    return np.asarray((off * run.scale).sum(axis=0) <= limit * run.size())  # nan compares false


def _placed(run: Motion, past: Modes, sample: Floats) -> Motion:
    """Return points at other samples; where that is none, as they are."""
    moved = sample != run.sample
    run.state, run.sample = np.where(moved, past.at(sample), run.state), sample
    return run


@lru_cache(maxsize=64)
def _bernstein(loop: NormalisedLoop) -> Floats:
    """Return the coefficients of the sensed position over all pieces, (13 pieces, q), for `NormalisedLoop.seen`."""
    change = [[comb(j, i) / comb(DEGREE, i) for i in range(DEGREE + 1)] for j in range(DEGREE + 1)]
    return np.concatenate(
        [np.array(change) @ piece.place @ given for piece, given in zip(pieces(loop), starts(loop), strict=True)]
    )


def _envelope_end(size: Floats, rate: Floats, band: float) -> Floats:
    """Return a time from which on the sum of size exp(-rate t) is inside the band, at most a sample too late."""
    time = np.zeros(size.shape[1])
    log_band = np.log(band)
    for _ in range(30):
        parts = size * np.exp(-rate * time)
        total = parts.sum(axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            # Newton's method on the logarithm, a convex function, comes from below
            step = (np.log(total) - log_band) * total / (rate * parts).sum(axis=0)
        step = np.where(total > band, step, 0.0)
        time += step
        if not (step > 0.5).any():
            break
    return np.where(time > 0, time + 1, 0.0)
