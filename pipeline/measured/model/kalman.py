"""Kalman filter of a device whose rows, gains or ages of the command in force change: loops over segments and rows.

In sampling periods and standard deviations of a reading, with x the device's state, and a which of A ages the command
in force has (1 for that one, else 0) less how likely each is:

    x[k+1] = F x[k] + G (u[k] + c[k]' a[k] + w[k])     var(w) = q
    a[k+1] = M' a[k] + v[k]                            cov(v) = C - M' C M
    y[k]   = H x[k] + e[k]                             var(e) = 1

Without a jittering delay A is 0. Arrays are padded: only the first ``rows`` (S,) of each segment are computed. Those of
all rows or segments alike have one row or segment.

Source: Anderson and Moore 1979, Optimal Filtering, sec. 3.1.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.base.compiled import compiled
from pipeline.records.batch import Floats, Integers


@compiled(
    "Tuple((f8[:,:,::1],f8[:,::1]))(f8[:,:,:,::1],f8[:,:,::1],f8[::1],f8[:,:,::1],f8[:,::1],f8[:,::1],f8,i8[::1])"
)
def filter_gains(
    F: Floats, G: Floats, H: Floats, c: Floats, M: Floats, C: Floats, q: float, rows: Integers
) -> tuple[Floats, Floats]:
    """Return the gains of a filter that knows the state at the first row, and the spreads of its prediction errors.

    With z = (x, a), z[k+1] = Phi z[k] + ..., cov = Q:

        S = 1 + H P H'     K = P H' / S     P <- Phi (P - K S K') Phi' + Q

    Parameters
    ----------
    F : float64, shape (N or 1, S or 1, n, n)
    G : float64, shape (N or 1, S or 1, n)
    H : float64, shape (n,)
    c : float64, shape (N, S, A)
        Force that each age would make.
    M, C : float64, shape (A, A)
        Chances of an age after another less those of it after any, and covariance of the ages.
    q : float
    rows : int64, shape (S,)

    Returns
    -------
    K : float64, shape (N, S, n + A)
        0 behind a segment's end.
    spread : float64, shape (N, S)
        sqrt(S); 1 behind a segment's end.
    """
    N, S, A = c.shape
    n = len(H)
    m = n + A
    gains, spread = np.zeros((N, S, m)), np.ones((N, S))
    P, moved, seen = np.empty((m, m)), np.empty((m, m)), np.empty(m)
    v = np.empty((A, A))
    for i in range(A):
        for j in range(A):
            v[i, j] = C[i, j]
            for a in range(A):
                for b in range(A):
                    v[i, j] -= M[a, i] * C[a, b] * M[b, j]
    for s in range(S):
        for i in range(m):
            for j in range(m):
                P[i, j] = C[i - n, j - n] if i >= n and j >= n else 0.0
        for k in range(rows[s]):
            f = F[min(k, F.shape[0] - 1), min(s, F.shape[1] - 1)]
            g = G[min(k, G.shape[0] - 1), min(s, G.shape[1] - 1)]
            variance = 1.0
            for i in range(m):
                seen[i] = 0.0
                for j in range(n):
                    seen[i] += P[i, j] * H[j]
            for i in range(n):
                variance += H[i] * seen[i]
            # a prediction is no surer than a reading but by rounding
            if variance < 1.0:
                variance = 1.0
            spread[k, s] = math.sqrt(variance)
            for i in range(m):
                gains[k, s, i] = seen[i] / variance
                for j in range(m):
                    P[i, j] -= seen[i] * seen[j] / variance
            for j in range(m):
                force = 0.0
                for a in range(A):
                    force += c[k, s, a] * P[n + a, j]
                for i in range(n):
                    moved[i, j] = g[i] * force
                    for h in range(n):
                        moved[i, j] += f[i, h] * P[h, j]
                for i in range(A):
                    moved[n + i, j] = 0.0
                    for a in range(A):
                        moved[n + i, j] += M[a, i] * P[n + a, j]
            for i in range(m):
                force = 0.0
                for a in range(A):
                    force += c[k, s, a] * moved[i, n + a]
                for j in range(min(i + 1, n)):
                    P[i, j] = force * g[j]
                    if i < n:
                        P[i, j] += q * g[i] * g[j]
                    for h in range(n):
                        P[i, j] += moved[i, h] * f[j, h]
                    P[j, i] = P[i, j]
                for j in range(n, i + 1):
                    P[i, j] = v[i - n, j - n]
                    for a in range(A):
                        P[i, j] += moved[i, n + a] * M[a, j - n]
                    P[j, i] = P[i, j]
    return gains, spread


@compiled(
    "f8[:,:,::1](f8[:,:,::1],f8[:,:,:,::1],f8[:,:,::1],f8[:,:,:,::1],f8[:,:,::1],f8[::1],f8[:,:,::1],f8[:,:,::1],"
    "f8[:,::1],i8[::1])",
    "c16[:,:,::1](c16[:,:,::1],c16[:,:,:,::1],c16[:,:,::1],c16[:,:,:,::1],c16[:,:,::1],c16[::1],f8[:,:,::1],"
    "f8[:,:,::1],f8[:,::1],i8[::1])",
)
def prediction_errors(
    y: Floats,
    u: Floats,
    x0: Floats,
    F: Floats,
    G: Floats,
    H: Floats,
    K: Floats,
    c: Floats,
    M: Floats,
    rows: Integers,
) -> Floats:
    """Return the prediction errors of columns, which pass the filter each alone.

        e = y[k] - H x     x <- F (x + K e) + G c[k]' a + u[k]     a <- M' (a + K e)

    Parameters
    ----------
    y : float64 or complex128, shape (columns, N, S)
        Readings.
    u : float64 or complex128, shape (columns, N, S, n)
        Motion by the forces of each interval.
    x0 : float64 or complex128, shape (columns, S, n)
        State at the first row.
    F : float64 or complex128, shape (N or 1, S or 1, n, n)
    G : float64 or complex128, shape (N or 1, S or 1, n)
    H : float64 or complex128, shape (n,)
    K : float64, shape (N or 1, S or 1, n + A)
    c : float64, shape (N, S, A)
        Of any N and S where A is 0.
    M : float64, shape (A, A)
    rows : int64, shape (S,)

    Returns
    -------
    float64 or complex128, shape (columns, N, S)
        0 behind a segment's end.
    """
    columns, _, S = y.shape
    n, A = len(H), len(M)
    errors = np.zeros(y.shape, y.dtype)
    x, moved, a, aged = np.empty(n, y.dtype), np.empty(n, y.dtype), np.empty(A, y.dtype), np.empty(A, y.dtype)
    for column in range(columns):
        for s in range(S):
            for i in range(n):
                x[i] = x0[column, s, i]
            for i in range(A):
                a[i] = 0.0
            for k in range(rows[s]):
                f = F[min(k, F.shape[0] - 1), min(s, F.shape[1] - 1)]
                g = G[min(k, G.shape[0] - 1), min(s, G.shape[1] - 1)]
                gain = K[min(k, K.shape[0] - 1), min(s, K.shape[1] - 1)]
                error = y[column, k, s]
                for i in range(n):
                    error -= H[i] * x[i]
                errors[column, k, s] = error
                for i in range(n):
                    x[i] += gain[i] * error
                for i in range(A):
                    a[i] += gain[n + i] * error
                force = 0.0 * error
                for i in range(A):
                    force += c[k, s, i] * a[i]
                    aged[i] = 0.0
                    for j in range(A):
                        aged[i] += M[j, i] * a[j]
                for i in range(n):
                    moved[i] = u[column, k, s, i] + g[i] * force
                    for j in range(n):
                        moved[i] += f[i, j] * x[j]
                x, moved = moved, x
                a, aged = aged, a
    return errors
