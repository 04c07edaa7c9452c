"""Compiled loops over the rows of segments, for transitions, filter gains, prediction errors, and triangular factors.

Time is in sampling periods, and position in standard deviations of a reading. x is the state of the device. Under
jitter, the applied command has one of A ages. The indicator of an age is 1 if the applied command has this age, else 0;
a contains the indicators minus their probabilities. Without jitter, A is 0.

    x[k+1] = F x[k] + u[k] + W (c[k]' a[k] + w[k])     var(w) = q
    a[k+1] = M' a[k] + v[k]                            cov(v) = C - M' C M
    y[k]   = H x[k] + e[k]                             var(e) = 1

u[k] is the motion due to the known forces in an interval, and c[k] contains the force for each age.

These arrays have the same meaning in all functions:

time, command, position : float64, shape (R,)
    Rows of all trials.
first, behind : int64, shape (S,)
    Rows of segment s are ``first[s]`` to ``behind[s]``. ``begin`` is the first row of its trial. Friction keeps the
    device at rest before the row ``edge``, and forces act on it from this row on; `ALWAYS` if they act in all rows.
kind : int64, shape (1,) or (R,)
    Index of the transition among F (m, n, n) for the interval after a row. There is one value if all intervals are
    equal.
offset : int64, shape (2,) or (R + 1,)
    Pieces of the interval after row r are ``offset[r]`` to ``offset[r + 1]``. One command is applied in each piece. It
    is ``back`` rows old, its age has the index ``age``, and it is applied for the share ``width`` of the interval.
    G (Q, n, 2) is the motion in the piece due to a unit command and due to a unit force on the motor.

Source: Anderson and Moore 1979, Optimal Filtering, sec. 3.1.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from pipeline.base.compiled import compiled, inlined
from pipeline.records.trials import Floats, Integers

ALWAYS = -1_000_000_000
"""Marker for a device in motion. Forces act on such a device in all rows."""

TERMS = 14
"""Number of terms in the series of a matrix exponential of norm 1/2. The neglected remainder is about 0.5^15/15!."""


@compiled("f8[:,:,:,::1](f8[:,:,::1],f8[::1])")
def exponentials(matrices: Floats, times: Floats) -> Floats:
    """Return the exponentials of a matrix over several times, with their tangents.

    The Taylor series is scaled and squared. The product of (A, A') and (B, B') is (A B, A' B + A B').

    Parameters
    ----------
    matrices : float64, shape (1 + p, N, N)
        A matrix and its derivatives along p parameters.
    times : float64, shape (m,)

    Returns
    -------
    float64, shape (m, 1 + p, N, N)

    Source: Al-Mohy and Higham 2009, SIAM J. Matrix Anal. Appl. 30, 1639-1657.
    """
    count, N = matrices.shape[0], matrices.shape[1]
    result = np.zeros((len(times), count, N, N))
    small, term, product = np.empty((count, N, N)), np.empty((count, N, N)), np.empty((count, N, N))
    norm, rows, moves = 0.0, 0, np.zeros(count)
    for d in range(count):
        for i in range(N):
            for j in range(N):
                if matrices[d, i, j] != 0.0:
                    rows, moves[d] = max(rows, i + 1), 1.0
    for j in range(N):
        column = 0.0
        for i in range(N):
            column += abs(matrices[0, i, j])
        norm = max(norm, column)
    for at in range(len(times)):
        halvings = 0
        size = norm * abs(times[at])
        while size > 0.5 and halvings < 200:
            size *= 0.5
            halvings += 1
        scale = times[at] * 0.5**halvings
        total = result[at]
        for d in range(count):
            for i in range(N):
                for j in range(N):
                    small[d, i, j] = matrices[d, i, j] * scale
                    term[d, i, j] = small[d, i, j]
                    total[d, i, j] = small[d, i, j]
        for i in range(N):
            total[0, i, i] += 1.0
        # rows of zeros, such as those of the inputs, and derivatives of zero do not change
        for step in range(TERMS - 1 + halvings if scale != 0.0 else 0):
            squaring = step >= TERMS - 1
            left, right = (total, total) if squaring else (term, small)
            factor, inner = (1.0, N) if squaring else (1.0 / (step + 2), rows)
            for d in range(count):
                for i in range(rows if moves[d] > 0.0 else 0):
                    for j in range(N):
                        value = 0.0
                        for h in range(inner):
                            value += left[d, i, h] * right[0, h, j]
                        if d > 0:
                            for h in range(inner):
                                value += left[0, i, h] * right[d, h, j]
                        product[d, i, j] = value * factor
            for d in range(count):
                for i in range(rows if moves[d] > 0.0 else 0):
                    for j in range(N):
                        if squaring:
                            total[d, i, j] = product[d, i, j]
                        else:
                            term[d, i, j] = product[d, i, j]
                            total[d, i, j] += product[d, i, j]
    return result


DOUBLINGS = 60
"""Largest number of doublings of the filter's memory until convergence. The variance converges within 2^40 samples."""

STEADY = 1e-14
"""Relative change of a filter's variance per doubling that is due to rounding."""


@compiled("Tuple((f8[::1],f8))(f8[:,::1],f8[::1],f8[::1],f8)")
def steady_gain(F: Floats, W: Floats, H: Floats, q: float) -> tuple[Floats, float]:
    """Return the gain (n,) of the steady-state filter and the variance of its prediction errors, or NaN if none exists.

    The memory of the initial state is doubled until convergence:

        A <- A (1 + G P)^-1 A     G <- G + A (1 + G P)^-1 G A'     P <- P + A' P (1 + G P)^-1 A

    Source: Anderson and Moore 1979, Optimal Filtering, sec. 6.7 (doubling algorithm).
    """
    n = len(H)
    A, G, P = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    work, left, more, other = np.empty((n, 2 * n)), np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    for i in range(n):
        for j in range(n):
            A[i, j], G[i, j], P[i, j] = F[j, i], H[i] * H[j], q * W[i] * W[j]
    for _ in range(DOUBLINGS):
        for i in range(n):
            for j in range(n):
                work[i, j] = 1.0 if i == j else 0.0
                work[i, n + j] = work[i, j]
                for h in range(n):
                    work[i, j] += G[i, h] * P[h, j]
        for j in range(n):  # inverse of 1 + G P by Gauss and Jordan, with pivots
            pivot = j
            for i in range(j + 1, n):
                if abs(work[i, j]) > abs(work[pivot, j]):
                    pivot = i
            for h in range(2 * n):
                kept = work[j, h]
                work[j, h] = work[pivot, h]
                work[pivot, h] = kept
            top = work[j, j]
            for h in range(2 * n):
                work[j, h] /= top
            for i in range(n):
                factor = work[i, j]
                for h in range(2 * n):
                    if i != j:
                        work[i, h] -= factor * work[j, h]
        for i in range(n):
            for j in range(n):
                left[i, j], other[i, j] = 0.0, 0.0
                for h in range(n):
                    left[i, j] += A[i, h] * work[h, n + j]
                    other[i, j] += P[i, h] * work[h, n + j]
        largest, change = 0.0, 0.0
        for i in range(n):  # P' = A' P (1 + G P)^-1 A
            for j in range(n):
                more[i, j] = 0.0
                for h in range(n):
                    for g in range(n):
                        more[i, j] += A[h, i] * other[h, g] * A[g, j]
        for i in range(n):
            for j in range(n):
                P[i, j] += more[i, j]
                largest, change = max(largest, abs(P[i, j])), max(change, abs(more[i, j]))
        for i in range(n):  # G' = A (1 + G P)^-1 G A'
            for j in range(n):
                other[i, j] = 0.0
                for h in range(n):
                    for g in range(n):
                        other[i, j] += left[i, h] * G[h, g] * A[j, g]
        for i in range(n):
            for j in range(n):
                more[i, j] = 0.0
                for h in range(n):
                    more[i, j] += left[i, h] * A[h, j]
        for i in range(n):
            for j in range(n):
                G[i, j] += other[i, j]
                A[i, j] = more[i, j]
        if not change > STEADY * largest:
            break
    gain, variance = np.zeros(n), 1.0
    for i in range(n):
        for j in range(n):
            gain[i] += P[i, j] * H[j]
        variance += H[i] * gain[i]
    return gain / variance, variance


@inlined
def next_ages(result: Floats, chances: Floats, ages: Floats, top: int, columns: int) -> None:
    """Write the product M' a into ``result`` for the columns of a. The ages start at row ``top``.

    M is described by three numbers per age (see `motion.Ages.ageing`), so that cumulative sums over ages suffice.
    """
    reached, left, chance = chances[0], chances[1], chances[2]
    last = len(chance) - 1
    for col in range(columns):
        result[top + last, col] = ages[top + last, col]
    for i in range(last - 1, -1, -1):
        for col in range(columns):
            result[top + i, col] = result[top + i + 1, col] + ages[top + i, col]
    for i in range(last, 0, -1):
        for col in range(columns):
            result[top + i, col] = (
                reached[i] * result[top + i, col] - chance[i] * result[top, col] + left[i - 1] * ages[top + i - 1, col]
            )
    for col in range(columns):
        result[top, col] *= reached[0] - chance[0]
        # ages beyond the oldest one are counted as the oldest
        result[top + last, col] += left[last] * ages[top + last, col]


@inlined
def advance(result: Floats, P: Floats, F: Floats, m: int, forces: Any) -> None:
    """Write the product Phi P into ``result``, with Phi = [F, W c'; 0, M'], for the transition m."""
    W, c, chances = forces
    n, A, columns = F.shape[1], len(c), P.shape[1]
    for j in range(columns):
        pulled = 0.0
        for a in range(A):
            pulled += c[a] * P[n + a, j]
        for i in range(n):
            value = W[m, i] * pulled
            for h in range(n):
                value += F[m, i, h] * P[h, j]
            result[i, j] = value
    if A:
        next_ages(result, chances, P, n, columns)


@compiled(
    "Tuple((f8[:,::1],f8[::1]))(Tuple((i8[::1],i8[::1],i8[::1],i8[::1])),f8[::1],"
    "Tuple((i8[::1],f8[:,:,::1],f8[:,::1],f8[::1])),Tuple((i8[::1],i8[::1],i8[::1],f8[::1])),"
    "Tuple((f8[:,::1],f8[:,::1])),Tuple((f8,f8)))"
)
def filter_gains(
    segments: Any, command: Floats, motion: Any, pieces: Any, ages: Any, noise: Any
) -> tuple[Floats, Floats]:
    """Return the gains of a filter with a known initial state, and the standard deviations of its prediction errors.

    With z = (x, a), z[k+1] = Phi z[k] + ..., cov = Q:

        S = 1 + H P H'     K = P H' / S     P <- Phi (P - K S K') Phi' + Q

    Parameters
    ----------
    segments : first, behind, begin, edge
    command : float64, shape (R,)
    motion : kind, F, W, H
    pieces : offset, back, age, width
    ages : M, C
        Transition probabilities (3, A) as in `motion.Ages.ageing`, and covariance (A, A) of the indicators of the ages.
    noise : q, late
        Variance of the random force, and standard deviation of the force per unit of command.

    Returns
    -------
    K : float64, shape (rows of all segments, n + A)
    spread : float64, shape (rows of all segments,)
        sqrt(S).
    """
    first, behind, begin, edge = segments
    kind, F, W, H = motion
    offset, back, age, width = pieces
    M, C = ages
    q, late = noise
    n, A = len(H), len(C)
    m = n + A
    rows = 0
    for s in range(len(first)):
        rows += behind[s] - first[s]
    gains, spread = np.zeros((rows, m)), np.ones(rows)
    P, moved, seen, c = np.empty((m, m)), np.empty((m, m)), np.empty(m), np.empty(A)
    forces = (W, c, M)
    v = np.zeros((A, A))
    if A:
        half, whole = np.empty((A, A)), np.empty((A, A))
        next_ages(half, M, C, 0, A)
        for i in range(A):
            for j in range(A):
                v[i, j] = half[j, i]
        next_ages(whole, M, v, 0, A)
        for i in range(A):
            for j in range(A):
                v[i, j] = C[i, j] - whole[j, i]
    place = 0
    for s in range(len(first)):
        for i in range(m):
            for j in range(m):
                P[i, j] = C[i - n, j - n] if i >= n and j >= n else 0.0
        for r in range(first[s], behind[s]):
            at = r if len(kind) > 1 else 0
            g = kind[at]
            variance = 1.0
            for i in range(m):
                value = 0.0
                for j in range(n):
                    value += P[i, j] * H[j]
                seen[i] = value
            for i in range(n):
                variance += H[i] * seen[i]
            # the variance of a prediction error is below that of a reading only by rounding
            if variance < 1.0:
                variance = 1.0
            spread[place], precision = math.sqrt(variance), 1.0 / variance
            for i in range(m):
                gains[place, i] = seen[i] * precision
                for j in range(m):
                    P[i, j] -= seen[i] * seen[j] * precision
            place += 1
            if A:
                for i in range(A):
                    c[i] = 0.0
                for piece in range(offset[at], offset[at + 1]):
                    row = r - back[piece]
                    if row >= edge[s]:
                        c[age[piece]] += late * command[min(max(row, begin[s]), behind[s] - 1)] * width[piece]
            advance(moved, P, F, g, forces)
            for i in range(m):
                for j in range(m):
                    P[i, j] = moved[j, i]
            advance(moved, P, F, g, forces)
            for i in range(m):
                for j in range(i + 1):
                    P[i, j] = moved[i, j]
                    if i < n:
                        P[i, j] += q * W[g, i] * W[g, j]
                    elif j >= n:
                        P[i, j] += v[i - n, j - n]
                    P[j, i] = P[i, j]
    return gains, spread


WIDTH = 4
"""Number of columns that a processor handles at once. Loops over columns are written out for blocks of this size."""


@inlined
def padded(count: int) -> int:
    """Return the number of columns of whole blocks."""
    return (count + WIDTH - 1) // WIDTH * WIDTH


@inlined
def dot(first: Floats, second: Floats, count: int) -> float:
    """Return the product of the first ``count`` elements of two vectors."""
    s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
    whole = count // 4 * 4
    for k in range(0, whole, 4):
        s0 += first[k] * second[k]
        s1 += first[k + 1] * second[k + 1]
        s2 += first[k + 2] * second[k + 2]
        s3 += first[k + 3] * second[k + 3]
    for k in range(whole, count):
        s0 += first[k] * second[k]
    return (s0 + s1) + (s2 + s3)


@inlined
def observe(e: Floats, H: Floats, x: Floats, now: int, position: float) -> None:
    """Write the prediction errors of all columns of the states into ``e``. The reading belongs to the first column."""
    for b in range(0, len(e), 4):
        s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
        for i in range(len(H)):
            s0 -= H[i] * x[now, i, b]
            s1 -= H[i] * x[now, i, b + 1]
            s2 -= H[i] * x[now, i, b + 2]
            s3 -= H[i] * x[now, i, b + 3]
        e[b], e[b + 1], e[b + 2], e[b + 3] = s0, s1, s2, s3
    e[0] += position


@inlined
def propagate(x: Floats, now: int, F: Floats, m: int, inputs: Any) -> None:
    """Write F x + FK e + u of_u + v of_v into the other states of x, for all columns and the transition m."""
    FK, e, u, of_u, v, of_v = inputs
    for i in range(F.shape[1]):
        for b in range(0, len(e), 4):
            s0 = FK[i] * e[b] + u[i] * of_u[b] + v[i] * of_v[b]
            s1 = FK[i] * e[b + 1] + u[i] * of_u[b + 1] + v[i] * of_v[b + 1]
            s2 = FK[i] * e[b + 2] + u[i] * of_u[b + 2] + v[i] * of_v[b + 2]
            s3 = FK[i] * e[b + 3] + u[i] * of_u[b + 3] + v[i] * of_v[b + 3]
            for h in range(F.shape[1]):
                s0 += F[m, i, h] * x[now, h, b]
                s1 += F[m, i, h] * x[now, h, b + 1]
                s2 += F[m, i, h] * x[now, h, b + 2]
                s3 += F[m, i, h] * x[now, h, b + 3]
            x[1 - now, i, b], x[1 - now, i, b + 1], x[1 - now, i, b + 2], x[1 - now, i, b + 3] = s0, s1, s2, s3


@inlined
def shape_tangents(z: Floats, now: int, F: Floats, m: int, corrections: Any) -> None:
    """Write F z + FK e + F' x into the other states of z, which are the state and its tangents. x is corrected."""
    FK, e, F_z, corrected = corrections
    for i in range(F.shape[1]):
        for b in range(0, len(e), 4):
            s0, s1, s2, s3 = FK[i] * e[b], FK[i] * e[b + 1], FK[i] * e[b + 2], FK[i] * e[b + 3]
            for h in range(F.shape[1]):
                s0 += F[m, i, h] * z[now, h, b] + F_z[m, i, h, b] * corrected[h]
                s1 += F[m, i, h] * z[now, h, b + 1] + F_z[m, i, h, b + 1] * corrected[h]
                s2 += F[m, i, h] * z[now, h, b + 2] + F_z[m, i, h, b + 2] * corrected[h]
                s3 += F[m, i, h] * z[now, h, b + 3] + F_z[m, i, h, b + 3] * corrected[h]
            z[1 - now, i, b], z[1 - now, i, b + 1], z[1 - now, i, b + 2], z[1 - now, i, b + 3] = s0, s1, s2, s3


@inlined
def add_inputs(z: Floats, now: int, G: Floats, piece: int, command: float, force: float) -> None:
    """Add the motion due to a command and a force on the motor in a piece, with its tangents, G (Q, n, 2, columns)."""
    for i in range(z.shape[1]):
        for b in range(0, z.shape[2], 4):
            s0 = z[now, i, b] + G[piece, i, 0, b] * command + G[piece, i, 1, b] * force
            s1 = z[now, i, b + 1] + G[piece, i, 0, b + 1] * command + G[piece, i, 1, b + 1] * force
            s2 = z[now, i, b + 2] + G[piece, i, 0, b + 2] * command + G[piece, i, 1, b + 2] * force
            s3 = z[now, i, b + 3] + G[piece, i, 0, b + 3] * command + G[piece, i, 1, b + 3] * force
            z[now, i, b], z[now, i, b + 1], z[now, i, b + 2], z[now, i, b + 3] = s0, s1, s2, s3


@inlined
def jitter_force(a: Floats, now: int, K: Floats, g: int, forces: Any) -> None:
    """Correct the ages a by K e, and write the forces c' a into ``pull``."""
    pull, e, c = forces
    n = K.shape[1] - a.shape[1]
    for b in range(0, len(e), 4):
        s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
        for i in range(a.shape[1]):
            a0 = a[now, i, b] + K[g, n + i] * e[b]
            a1 = a[now, i, b + 1] + K[g, n + i] * e[b + 1]
            a2 = a[now, i, b + 2] + K[g, n + i] * e[b + 2]
            a3 = a[now, i, b + 3] + K[g, n + i] * e[b + 3]
            s0 += c[i] * a0
            s1 += c[i] * a1
            s2 += c[i] * a2
            s3 += c[i] * a3
            a[now, i, b], a[now, i, b + 1], a[now, i, b + 2], a[now, i, b + 3] = a0, a1, a2, a3
        pull[b], pull[b + 1], pull[b + 2], pull[b + 3] = s0, s1, s2, s3


GAIN, COULOMB, FORCE, FIELDS, SHAPE = 0, 1, 2, 3, 6
"""Codes of the columns of `whitened`: acceleration per unit of command, due to Coulomb friction, due to a constant
force, and due to three forces that depend on the position. Codes from SHAPE on denote parameters of the shape, and
negative codes denote parameters of the drive."""


@compiled(
    "Tuple((f8[:,::1],f8[::1],f8))(Tuple((f8[::1],f8[:,::1],f8[::1],f8[:,::1])),"
    "Tuple((i8[::1],i8[::1],i8[::1],i8[::1],f8[::1],f8[:,::1],f8[:,::1])),"
    "Tuple((i8[::1],f8[:,:,::1],f8[:,:,:,::1],f8[:,::1],f8[:,:,::1],f8[::1],f8[:,::1])),"
    "Tuple((i8[::1],i8[::1],i8[::1],f8[::1],f8[:,:,::1],f8[:,:,:,::1])),"
    "Tuple((f8[:,::1],f8[::1],f8[:,::1],f8)),"
    "Tuple((i8[::1],i8[::1],f8[::1],f8[::1])))"
)
def whitened(
    rows: Any, segments: Any, motion: Any, pieces: Any, gains: Any, requested: Any
) -> tuple[Floats, Floats, float]:
    """Return the whitened prediction errors of segments with tangents, after elimination of unknown initial states.

    All columns pass through the same filter. Its gains K do not depend on the parameters:

        e[k] = y[k] - H x[k]     x <- F (x + K e) + W c' a + u     a <- M' (a + K e)

    Along a parameter of the shape, with ' for the derivative,

        e' = -H x' - H' x        x' <- F (x' + K e') + F' (x + K e) + W c' a' + W' c' a + u'

    The unknown initial values z of a segment (states and the lagged actuator force) are additional columns. Rows for
    their prior follow the rows of the errors. The maximum-likelihood values of z are found by least squares (two passes
    of Gram-Schmidt) and subtracted from all columns. Tangents are taken along the motion from this initial state.

    Parameters
    ----------
    rows : time, commands, position, fields
        ``commands`` (1 + D, R) contains the applied command and its derivatives along D parameters of the drive.
        ``fields`` (1 + F, R) contains the acceleration due to forces that depend on the position, in the interval after
        each row, and its derivatives along the F numbers of these forces. It is (1, 0) if there are none.
    segments : first, behind, begin, edge, direction, numbers, shifts
        ``direction`` of motion is -1, 0 or 1. ``numbers`` (S, 3) are accelerations per unit of command, due to friction
        and due to a constant force. ``shifts`` (S, p) are deviations of a segment's numbers from the common numbers.
    motion : kind, F, F', W, W', H, H'
        Derivatives of shape (m, P, n, n), (m, P, n), (P, n) along P parameters of the shape.
    pieces : offset, back, age, width, G, G'
    gains : K, spread, M, late
        K (1 or all rows, n + A), standard deviations of the errors, transition probabilities (3, A) of the ages, and
        standard deviation of the force per unit of command.
    requested : codes, places, constants, sizes
        ``codes`` (p,) of the columns. ``places`` of stiffness, lag and delay among the parameters of the shape, or -1.
        ``constants``: stiffness, lag, delay, variance of a reading, and number of rows before a segment in which
        commands still affect the lagged force. ``sizes`` (q,) of the unknown initial values.

    Returns
    -------
    columns : float64, shape (rows of all segments + S q, p + 1)
        The derivatives -e' for each code, and e. The rows of the prior follow the rows of each segment.
    known : float64, shape (S,)
        Number of unknown initial values that the readings determine.
    lost : float
        Reduction of the log-likelihood due to the standard deviations of the errors and the information on the initial
        states.
    """
    time, commands, position, fields = rows
    first, behind, begin, edge, direction, numbers, shifts = segments
    kind, F, dF, W, dW, H, dH = motion
    offset, back, age, width, G, dG = pieces
    K, spread, M, late = gains
    codes, places, constants, sizes = requested
    n, A, P, p, q, S = len(H), M.shape[1], dF.shape[1], len(codes), len(sizes), len(first)
    gamma, lag, delay, variance, reach = constants[0], constants[1], constants[2], constants[3], int(constants[4])
    command, drive = commands[0], len(commands) - 1
    longest, total, most = 0, 0, 0
    for s in range(S):
        longest = max(longest, behind[s] - first[s])
        total += behind[s] - first[s]
    for at in range(len(offset) - 1):
        most = max(most, offset[at + 1] - offset[at])
    # columns of the first pass: motion due to all forces, linear numbers, unknown initial values
    linear = np.full(p, -1)
    L = 1
    for j in range(p):
        if codes[j] < SHAPE:
            linear[j] = L
            L += 1
    T = L + q
    columns, known, lost = np.zeros((total + S * q, p + 1)), np.zeros(S), 0.0
    E, D, V = np.empty((T, longest + q)), np.empty((P, longest)), np.empty((p + 1, longest + q))
    # columns of a pass are padded to whole blocks
    X, Z = padded(T), padded(1 + P)
    # states of both passes and their ages, at the present and at the next row
    x, a, z, az = np.zeros((2, n, X)), np.zeros((2, A, X)), np.zeros((2, n, Z)), np.zeros((2, A, Z))
    e, e_z, pull, pull_z = np.zeros(X), np.zeros(Z), np.zeros(X), np.zeros(Z)
    of_command, of_force = np.zeros(X), np.zeros(X)
    c, lag_start, corrected, FK = np.zeros(A), np.zeros(3 + drive), np.zeros(n), np.zeros(n)
    driven, acting, resting, changed = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros((drive, n))
    values, acts = np.zeros(most), np.zeros(most)
    triangle, along, fitted = np.zeros((q, q)), np.zeros(q), np.zeros(q)
    filtered, steady, pushed = np.any(K != 0), len(spread) == 1, fields.shape[1] > 0
    senses = np.any(dH != 0)
    # matrices of the second pass: the derivatives along all parameters are neighbours in memory
    F_z, W_z, H_z = np.zeros((len(F), n, n, Z)), np.zeros((len(F), n, Z)), np.zeros((n, Z))
    G_z = np.zeros((len(G) if P else 0, n, 2, Z))
    for j in range(P):
        for i in range(n):
            H_z[i, 1 + j] = dH[j, i]
            for m in range(len(F)):
                W_z[m, i, 1 + j] = dW[m, j, i]
                for h in range(n):
                    F_z[m, i, h, 1 + j] = dF[m, j, i, h]
            for piece in range(len(G)):
                for h in range(2):
                    G_z[piece, i, h, 0] = G[piece, i, h]
                    G_z[piece, i, h, 1 + j] = dG[piece, j, i, h]
    inputs, corrections = (FK, e, driven, of_command, acting, of_force), (FK, e_z, F_z, corrected)
    row_place, out = 0, 0
    for s in range(S):
        N = behind[s] - first[s]
        own_gain, own_coulomb, own_force = numbers[s, 0], numbers[s, 1], numbers[s, 2]
        way, rests = direction[s], edge[s] > ALWAYS
        direct = own_force - own_coulomb * way
        # lagged force at the first row: due to previous commands (value, derivatives along lag, delay and drive), and
        # share that remains of the force before them
        oldest = 1.0
        lag_start[:] = 0.0
        if lag > 0:
            newer, newer_lag, newer_delay = 0.0, 0.0, 0.0
            for j in range(reach + 1):
                r = first[s] - j
                inside = max(r, begin[s])
                since = time[first[s]] - delay - time[inside] + (inside - r)
                left, left_lag, left_delay = 1.0, 0.0, 0.0
                if since > 0:
                    left = math.exp(-since / lag)
                    left_lag, left_delay = left * since / lag**2, left / lag
                if j > 0 and r >= edge[s]:
                    last = 1.0 if j == reach else 0.0
                    lag_start[0] += command[inside] * (newer - left + last * left)
                    lag_start[1] += command[inside] * (newer_lag - left_lag + last * left_lag)
                    lag_start[2] += command[inside] * (newer_delay - left_delay + last * left_delay)
                    for d in range(drive):
                        lag_start[3 + d] += commands[1 + d, inside] * (newer - left + last * left)
                newer, newer_lag, newer_delay = left, left_lag, left_delay
            oldest = newer
        x[:] = 0.0
        a[:] = 0.0
        if lag > 0:
            x[0, n - 1, 0] = own_gain * lag_start[0]
            for j in range(p):
                if codes[j] == GAIN:
                    x[0, n - 1, linear[j]] = lag_start[0]
                elif codes[j] < 0:
                    x[0, n - 1, linear[j]] = own_gain * lag_start[2 - codes[j]]
        for j in range(q):
            if j == 0 or not rests:
                x[0, j, L + j] = oldest if lag > 0 and j == n - 1 else 1.0
        # acceleration in each column due to a command of 1, and due to the force on the motor
        of_command[0], of_force[0] = own_gain, direct
        for j in range(p):
            if codes[j] < SHAPE:
                of_command[linear[j]] = 1.0 if codes[j] == GAIN else 0.0
                of_force[linear[j]] = 1.0 if codes[j] == FORCE else -way if codes[j] == COULOMB else 0.0
        for k in range(N):
            r, now, other = first[s] + k, k % 2, 1 - k % 2
            at = r if len(kind) > 1 else 0
            m, g = kind[at], 0 if steady else row_place + k
            scale = 1.0 / spread[g]
            observe(e, H, x, now, position[r])
            for col in range(T):
                E[col, k] = e[col] * scale
            if k == N - 1:
                break
            if filtered and (k == 0 or not steady or len(kind) > 1):
                for i in range(n):
                    total_gain = 0.0
                    for h in range(n):
                        total_gain += F[m, i, h] * K[g, h]
                    FK[i] = total_gain
            for i in range(A):
                c[i] = 0.0
            low, high = offset[at], offset[at + 1]
            for piece in range(low, high):
                row, place = r - back[piece], piece - low
                acts[place] = 1.0 if row >= edge[s] else 0.0
                inside = min(max(row, begin[s]), behind[s] - 1)
                values[place] = command[inside] * acts[place]
                if A > 0:
                    c[age[piece]] += late * values[place] * width[piece]
            for i in range(n):
                by_command, by_force, at_rest = 0.0, 0.0, 0.0
                for piece in range(low, high):
                    place = piece - low
                    by_command += G[piece, i, 0] * values[place]
                    by_force += G[piece, i, 1] * acts[place]
                    at_rest += G[piece, i, 1] * (1.0 - acts[place])
                driven[i], acting[i], resting[i] = by_command, by_force, at_rest
            if pushed:
                of_force[0] = direct + fields[0, r]
                for j in range(p):
                    if FIELDS <= codes[j] < SHAPE:
                        of_force[linear[j]] = fields[1 + codes[j] - FIELDS, r]
            propagate(x, now, F, m, inputs)
            if q:
                # friction keeps a device at rest against the spring
                for i in range(n):
                    x[other, i, L] += gamma * resting[i]
            if drive:
                for d in range(drive):
                    for i in range(n):
                        changed[d, i] = 0.0
                        for piece in range(low, high):
                            inside = min(max(r - back[piece], begin[s]), behind[s] - 1)
                            changed[d, i] += G[piece, i, 0] * commands[1 + d, inside] * acts[piece - low]
                for j in range(p):
                    if codes[j] < 0:
                        for i in range(n):
                            x[other, i, linear[j]] += changed[-1 - codes[j], i] * own_gain
            if A:
                jitter_force(a, now, K, g, (pull, e, c))
                next_ages(a[other], M, a[now], 0, X)
                for i in range(n):
                    for col in range(X):
                        x[other, i, col] += W[m, i] * pull[col]
        # maximum-likelihood initial state: orthonormalise the columns of its unknowns, including the rows of the prior
        for j in range(q):
            for k in range(N):
                E[L + j, k] = -E[L + j, k]
            for i in range(q):
                E[L + j, N + i] = math.sqrt(variance) / sizes[j] if i == j else 0.0
                triangle[i, j] = 0.0
        for j in range(q):
            for _ in range(2):
                for i in range(j):
                    product = dot(E[L + i], E[L + j], N + q)
                    triangle[i, j] += product
                    for k in range(N + q):
                        E[L + j, k] -= product * E[L + i, k]
            square = dot(E[L + j], E[L + j], N + q)
            triangle[j, j] = math.sqrt(square)
            for k in range(N + q):
                E[L + j, k] /= triangle[j, j]
            information = square * sizes[j] * sizes[j]
            share = max(1.0 - variance / information, 0.0)
            known[s] += share
            lost += 0.5 * (math.log(information) - (1.0 - share) * math.log(variance))
        for k in range(N):
            lost += math.log(spread[0 if steady else row_place + k])
        # tangents along the parameters of the shape, from the maximum-likelihood initial state
        if P:
            for j in range(q - 1, -1, -1):
                value = dot(E[L + j], E[0], N)
                for i in range(j + 1, q):
                    value -= triangle[j, i] * fitted[i]
                fitted[j] = value / triangle[j, j]
            z[:] = 0.0
            az[:] = 0.0
            for j in range(q):
                if j == 0 or not rests:
                    z[0, j, 0] = fitted[j] * (oldest if lag > 0 and j == n - 1 else 1.0)
            start = z[0, 0, 0]
            if lag > 0:
                z[0, n - 1, 0] += own_gain * lag_start[0]
                for j in range(1, 3):
                    if places[j] >= 0:
                        z[0, n - 1, 1 + places[j]] = own_gain * lag_start[j]
            for k in range(N):
                r, now, other = first[s] + k, k % 2, 1 - k % 2
                at = r if len(kind) > 1 else 0
                m, g = kind[at], 0 if steady else row_place + k
                scale = 1.0 / spread[g]
                observe(e_z, H, z, now, position[r])
                if senses:
                    for i in range(n):
                        for j in range(P):
                            e_z[1 + j] -= H_z[i, 1 + j] * z[now, i, 0]
                for j in range(P):
                    D[j, k] = -e_z[1 + j] * scale
                if k == N - 1:
                    break
                force = direct + fields[0, r] if pushed else direct
                for i in range(n):
                    total_gain, corrected[i] = 0.0, z[now, i, 0] + K[g, i] * e_z[0]
                    if filtered:
                        for h in range(n):
                            total_gain += F[m, i, h] * K[g, h]
                    FK[i] = total_gain
                shape_tangents(z, now, F, m, corrections)
                for i in range(A):
                    c[i] = 0.0
                for piece in range(offset[at], offset[at + 1]):
                    row = r - back[piece]
                    active = 1.0 if row >= edge[s] else 0.0
                    value = command[min(max(row, begin[s]), behind[s] - 1)] * active
                    add_inputs(z, other, G_z, piece, value * own_gain, force * active + gamma * (1.0 - active) * start)
                    if A > 0:
                        c[age[piece]] += late * value * width[piece]
                    if places[0] >= 0 and active == 0.0:
                        for i in range(n):
                            z[other, i, 1 + places[0]] += G[piece, i, 1] * start
                if A:
                    jitter_force(az, now, K, g, (pull_z, e_z, c))
                    next_ages(az[other], M, az[now], 0, Z)
                    for i in range(n):
                        for col in range(Z):
                            z[other, i, col] += W[m, i] * pull_z[col] + W_z[m, i, col] * pull_z[0]
        for k in range(N):
            V[p, k] = E[0, k]
        for j in range(p):
            of, sign = (E[linear[j]], -1.0) if codes[j] < SHAPE else (D[codes[j] - SHAPE], 1.0)
            for k in range(N):
                V[j, k] = sign * of[k]
                V[p, k] += shifts[s, j] * V[j, k]
        for j in range(p + 1):
            for i in range(q):
                along[i] = dot(E[L + i], V[j], N)
                V[j, N + i] = 0.0
            for i in range(q):
                for k in range(N + q):
                    V[j, k] -= along[i] * E[L + i, k]
            for k in range(N + q):
                columns[out + k, j] = V[j, k]
        row_place += N
        out += N + q
    return columns, known, lost


BLOCK = 32
"""Number of rows that are added to a triangular factor together."""

NEGLIGIBLE = 1e-290
"""Sum of squares that counts as zero. The inverse of a smaller one overflows, e.g. for a response that has decayed."""


@compiled("void(f8[:,:,::1],f8[:,::1],i8[::1],i8[::1],i8[::1])")
def triangles(factors: Floats, columns: Floats, first: Integers, behind: Integers, unit: Integers) -> None:
    """Append rows to the triangular factors R of units, so that R'R is the Gram matrix of all rows of a unit.

    Parameters
    ----------
    factors : float64, shape (units, c, c)
        Changed in place.
    columns : float64, shape (rows, c)
        Overwritten.
    first, behind, unit : int64, shape (ranges,)
        Ranges of rows, and the unit of each range.

    Source: Golub and Van Loan 2013, Matrix Computations, sec. 5.1 and 6.5.3 (Householder, appended rows).
    """
    c = columns.shape[1]
    for s in range(len(first)):
        R = factors[unit[s]]
        for top in range(first[s], behind[s], BLOCK):
            end = min(top + BLOCK, behind[s])
            for j in range(c):
                square = 0.0
                for k in range(top, end):
                    square += columns[k, j] * columns[k, j]
                if square < NEGLIGIBLE:
                    continue
                norm = math.sqrt(R[j, j] * R[j, j] + square)
                diagonal = -norm if R[j, j] > 0 else norm
                head = R[j, j] - diagonal
                scale = 2.0 / (head * head + square)
                R[j, j] = diagonal
                for i in range(j + 1, c):
                    product = head * R[j, i]
                    for k in range(top, end):
                        product += columns[k, j] * columns[k, i]
                    product *= scale
                    R[j, i] -= product * head
                    for k in range(top, end):
                        columns[k, i] -= product * columns[k, j]


@compiled("void(f8[:,:,:,::1],f8[:,::1],i8[::1],i8[::1],i8[::1],i8[::1])")
def add_products(
    products: Floats, columns: Floats, first: Integers, behind: Integers, unit: Integers, phase: Integers
) -> None:
    """Add the products of columns with all columns and the errors, for each unit and phase of the motion.

    Parameters
    ----------
    products : float64, shape (units, phases, p, p + 1)
        Changed in place.
    columns : float64, shape (rows, p + 1)
    first, behind, unit : int64, shape (ranges,)
        Ranges of rows, and the unit of each range.
    phase : int64, shape (rows of all ranges,)
    """
    row = 0
    for s in range(len(first)):
        for k in range(first[s], behind[s]):
            for i in range(products.shape[2]):
                for j in range(products.shape[3]):
                    products[unit[s], phase[row], i, j] += columns[k, i] * columns[k, j]
            row += 1
