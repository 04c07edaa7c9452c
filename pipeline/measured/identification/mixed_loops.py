"""Compiled loops of a mixed-effects regression, for common numbers, variances between units, and weights of units.

Each of T units has a linear regression e_t = X_t (theta + b_t) + noise. The upper triangular factor R_t of its c
whitened columns and its errors represents it, with X'X = R'R. D contains the variances between units. The covariance of
the rotated errors is

    V_t = 1 + C_t D C_t'        C_t = R_t sqrt(w_t / v)

v is the variance of an error, and w_t is the weight of the unit.

Source: Searle, Casella and McCulloch 1992, Variance Components, ch. 8.
"""

from __future__ import annotations

import math
from typing import Any

from pipeline.base.compiled import compiled, inlined, part
from pipeline.records.trials import Floats, Integers

OWN_ROWS = 20.0
"""Degrees of freedom of Student's t for the noise of single trials. A trial with a disturbance is noisier than others
and has less weight."""

ROUNDS = 4
"""Number of alternating updates of the weights and the variances between trials, which depend on each other."""

FLAT = 1e-8
"""Relative change of the noise at which the search for it ends."""

NEWTON = 40
"""Largest number of Newton steps in the search for the noise. Each step changes it by at most a factor of e^2."""

LEAST_SHARE = 1e-6
"""Smallest initial value of the noise, as a share of the mean square. Most units have similar noise."""

RIDGE = 1e-12
"""Threshold for the share of a number's information. Below it, a direction contains only rounding errors, and the step
along it is 0."""

ROUNDED = 1e-16
"""Threshold for the share of a number's information. Below it, a column is a rounding error and its number has no
scatter."""

LEAST_LOG, MOST_LOG = -9.0, 25.0
"""Smallest and largest logarithm of a variance between units, relative to the variance of the number from a typical
unit."""

SCORING = 30
"""Largest number of steps of the search for the variances of the numbers."""

FARTHEST = 3.0
"""Largest change of the logarithm of a variance in one step."""

ENOUGH = 1e-6
"""Threshold for the predicted gain of log-likelihood. Below it, the search for variances ends."""

SWEEPS, NOTHING = 30, 1e-150
"""Largest number of sweeps of rotations for eigenvalues (six are typical), and threshold below which an element counts
as zero."""


@part
def spectrum(matrix: Floats, values: Floats, vectors: Floats) -> None:
    """Compute the eigenvalues and eigenvectors (columns) of a symmetric matrix, and overwrite the matrix.

    Source: Golub and Van Loan 2013, Matrix Computations, sec. 8.5 (cyclic Jacobi).
    """
    n = len(values)
    for i in range(n):
        for j in range(n):
            vectors[i, j] = 1.0 if i == j else 0.0
    for _ in range(SWEEPS):
        off, diagonal = 0.0, 0.0
        for i in range(n):
            diagonal += matrix[i, i] * matrix[i, i]
            for j in range(i):
                off += matrix[i, j] * matrix[i, j]
        if not off > 1e-34 * diagonal:
            break
        for i in range(n - 1):
            for j in range(i + 1, n):
                if abs(matrix[i, j]) < NOTHING:
                    continue
                ratio = (matrix[j, j] - matrix[i, i]) / (2 * matrix[i, j])
                tangent = math.copysign(1.0, ratio) / (abs(ratio) + math.sqrt(ratio * ratio + 1.0))
                cosine = 1.0 / math.sqrt(tangent * tangent + 1.0)
                sine = tangent * cosine
                for h in range(n):
                    left, right = matrix[h, i], matrix[h, j]
                    matrix[h, i], matrix[h, j] = cosine * left - sine * right, sine * left + cosine * right
                for h in range(n):
                    left, right = matrix[i, h], matrix[j, h]
                    matrix[i, h], matrix[j, h] = cosine * left - sine * right, sine * left + cosine * right
                    left, right = vectors[h, i], vectors[h, j]
                    vectors[h, i], vectors[h, j] = cosine * left - sine * right, sine * left + cosine * right
    for i in range(n):
        values[i] = matrix[i, i]


@part
def invert(matrix: Floats, result: Floats, work: Floats) -> float:
    """Compute the pseudo-inverse of an information matrix and return its log determinant.

    The inverse is 0 along directions without information. ``work`` provides at least four matrices of this size.
    """
    n, log = len(matrix), 0.0
    scale, values = work[2, 0], work[3, 0, :n]
    for i in range(n):
        scale[i] = 1 / math.sqrt(matrix[i, i]) if matrix[i, i] > 0 else 1.0
        log -= 2 * math.log(scale[i])
    for i in range(n):
        for j in range(n):
            work[0, i, j] = matrix[i, j] * scale[i] * scale[j]
    spectrum(work[0], values, work[1])
    for i in range(n):
        log += math.log(max(values[i], RIDGE))
        values[i] = 1 / values[i] if values[i] > RIDGE else 0.0
    for i in range(n):
        for j in range(n):
            total = 0.0
            for h in range(n):
                total += work[1, i, h] * values[h] * work[1, j, h]
            result[i, j] = total * scale[i] * scale[j]
    return log


@inlined
def likeliest_noise(squares: Floats, rows: Floats, near: float, least: float) -> float:
    """Return the maximum-likelihood variance of errors of units with the given sums of squares.

    With s_t = squares, n_t = rows and f = `OWN_ROWS`, the variance v solves sum (n_t + f) s_t/(f v + s_t) = sum n_t. It
    is found by Newton steps in ln v from ``near``.
    """
    total, whole = 0.0, 0.0
    for t in range(len(rows)):
        total += rows[t]
        whole += squares[t]
    noise = max(near, whole * LEAST_SHARE / total, least)
    for _ in range(NEWTON):
        off, slope = -total, 0.0
        for t in range(len(rows)):
            ratio = squares[t] / (OWN_ROWS * noise + squares[t])
            off += (rows[t] + OWN_ROWS) * ratio
            slope += (rows[t] + OWN_ROWS) * ratio * (1 - ratio)
        step = min(max(off / max(slope, 1e-3 * total), -2.0), 2.0)
        former, noise = noise, max(noise * math.exp(step), least)
        # the likelihood is flat along the noise: its relative error is squared
        if not abs(noise - former) > FLAT * noise:
            break
    return noise


@part
def whiten(columns: Floats, plain: Floats, variances: Floats, root: Floats) -> float:
    """Whiten columns (T, p, p + 1) by the variances (p,) between units, and return minus half the log determinants."""
    T, p = len(plain), len(variances)
    log, mixed = 0.0, False
    for j in range(p):
        mixed = mixed or variances[j] > 0
    for t in range(T):
        if not mixed:
            for i in range(p):
                for j in range(p + 1):
                    columns[t, i, j] = plain[t, i, j]
            continue
        for i in range(p):
            for j in range(i + 1):
                value = 1.0 if i == j else 0.0
                for h in range(p):
                    if variances[h] > 0:
                        value += plain[t, i, h] * variances[h] * plain[t, j, h]
                for h in range(j):
                    value -= root[i, h] * root[j, h]
                root[i, j] = math.sqrt(value) if i == j else value / root[j, j]
            log -= math.log(root[i, i])
            for j in range(p + 1):
                value = plain[t, i, j]
                for h in range(i):
                    value -= root[i, h] * columns[t, h, j]
                columns[t, i, j] = value / root[i, i]
    return log


@part
def regress(columns: Floats, rest: Floats, known: Floats, outputs: Any, work: Floats) -> float:
    """Compute the maximum-likelihood step for whitened columns with a prior (2, p).

    The results are written to ``outputs``: step (p,), sums of squares (T,) before and after the step, and inverse
    information (p, p). The function returns the log determinant of the information.
    """
    step, before, behind, inverse = outputs
    T, p = len(columns), len(step)
    total, right = work[4], work[5, 0]
    for i in range(p):
        right[i] = known[1, i]
        for j in range(p):
            total[i, j] = known[0, i] if i == j else 0.0
    for t in range(T):
        for i in range(p):
            for j in range(p):
                value = columns[t, i, j]
                right[j] += value * columns[t, i, p]
                for h in range(j + 1):
                    total[j, h] += value * columns[t, i, h]
    for i in range(p):
        for j in range(i):
            total[j, i] = total[i, j]
    log = invert(total, inverse, work)
    for i in range(p):
        step[i] = 0.0
        for j in range(p):
            step[i] += inverse[i, j] * right[j]
    for t in range(T):
        before[t], behind[t] = rest[t], rest[t]
        for i in range(p):
            error = columns[t, i, p]
            before[t] += error * error
            for j in range(p):
                error -= columns[t, i, j] * step[j]
            behind[t] += error * error
    return log


@part
def score_variances(columns: Floats, step: Floats, inverse: Floats, random: Integers, outputs: Any) -> None:
    """Compute slope (r,) and information (r, r) of the restricted likelihood along the variances of random numbers."""
    slope, information, of_unit, rows = outputs
    p, r = len(step), len(random)
    slope[:] = 0.0
    for i in range(r):
        for j in range(r):
            information[i, j] = 0.0
    for t in range(len(columns)):
        for a in range(r):
            for j in range(p):
                rows[a, j] = 0.0
                for i in range(p):
                    rows[a, j] += columns[t, i, random[a]] * columns[t, i, j]
        for a in range(r):
            for b in range(r):
                value = rows[a, random[b]]
                for i in range(p):
                    product = 0.0
                    for j in range(p):
                        product += inverse[i, j] * rows[b, j]
                    value -= rows[a, i] * product
                of_unit[a, b] = value
                information[a, b] += 0.5 * value * value
        for a in range(r):
            score = 0.0
            for i in range(p):
                error = columns[t, i, p]
                for j in range(p):
                    error -= columns[t, i, j] * step[j]
                score += error * columns[t, i, random[a]]
            slope[a] += 0.5 * (score * score - of_unit[a, a])


SPACE = 14
"""Number of work matrices of shape (p + 1, p + 1) for the loops below."""


@compiled(
    "void(Tuple((f8[:,:,::1],f8[::1],i8[::1],f8[:,::1],f8,f8)),Tuple((f8[:,:,::1],f8[:,:,::1],f8[::1],f8[:,:,::1])),"
    "Tuple((f8[::1],f8[::1],f8[::1],f8[::1],f8[::1],f8[:,::1],f8[::1])))"
)
def mixed_effects(given: Any, space: Any, result: Any) -> None:
    """Compute the maximum-likelihood common numbers of units, the variances between units, and the weights of units.

    Three updates alternate. Variances maximise the restricted likelihood, by Fisher scoring in their logarithms with
    steps that are shortened until the likelihood does not fall. Numbers solve a weighted least-squares problem. Noise
    and weights maximise the likelihood of Student's t.

    Parameters
    ----------
    given : factors, rows, random, known, noise, least
        R (T, p + 1, p + 1), degrees of freedom (T,), indices (r,) of the numbers that vary between units, information
        and slope (2, p) of the prior of the numbers, and initial and smallest variance of an error.
    space : plain, columns, rest, work
        Arrays of shape (T, p, p + 1) twice, (T,), and (`SPACE`, p + 1, p + 1). At the end, ``columns`` are whitened by
        all results.
    result : step, variances, weight, before, behind, inverse, sums
        Step (p,), variances (p,), weights (T,), and sums of squares (T,) before and after the step, divided by the
        noise of the unit; inverse information (p, p). ``sums`` are the noise after and before the step, and minus half
        the sum of the log determinants of the units' covariances.
    """
    factors, rows, random, known, noise, least = given
    plain, columns, rest, work = space
    step, variances, weight, before, behind, inverse, sums = result
    T, p, r = len(factors), len(step), len(random)
    small, usual, logs, tried, change = work[:6, :p, :p], work[6, 0], work[6, 1], work[7, 0], work[7, 1]
    nothing, free, information = work[8, :2, :p], work[9, :r, :r], work[10, :r, :r]
    slope, outputs = work[11, 0, :r], (step, before, behind, inverse)
    slopes = (slope, information, work[12, :r, :r], work[13])
    nothing[:] = 0.0
    for t in range(T):
        square = max(factors[t, p, p] * factors[t, p, p], 1e-300)
        weight[t] = (rows[t] + OWN_ROWS) / (OWN_ROWS + square / noise)
    variances[:] = 0.0
    for count in range(ROUNDS):
        for t in range(T):
            root = math.sqrt(weight[t] / noise)
            rest[t] = max((factors[t, p, p] * root) ** 2, 1e-300)
            for i in range(p):
                for j in range(p + 1):
                    plain[t, i, j] = factors[t, i, j] * root
        active = 0
        for a in range(r):
            usual[a] = 0.0
            for t in range(T):
                for i in range(p):
                    usual[a] += plain[t, i, random[a]] ** 2
            usual[a] /= T
            # columns have unit size, so smaller values are rounding errors and have no scatter
            if usual[a] > ROUNDED:
                active += 1
        if active:
            for a in range(r):
                logs[a] = 1.0
                if count > 0:
                    logs[a] = min(max(math.log(max(variances[random[a]] * usual[a], 1e-12)), LEAST_LOG), MOST_LOG)
                variances[random[a]] = math.exp(logs[a]) / usual[a] if usual[a] > ROUNDED else 0.0
            likelihood = whiten(columns, plain, variances, small[0])
            likelihood -= 0.5 * regress(columns, rest, nothing, outputs, small)
            for t in range(T):
                likelihood -= 0.5 * behind[t]
            for _ in range(SCORING):
                score_variances(columns, step, inverse, random, slopes)
                ways = 0
                for a in range(r):
                    slope[a] *= variances[random[a]]
                    if usual[a] <= ROUNDED:
                        slope[a] = 0.0
                    for b in range(r):
                        information[a, b] *= variances[random[a]] * variances[random[b]]
                for a in range(r):
                    inside = (logs[a] > LEAST_LOG or slope[a] > 0) and (logs[a] < MOST_LOG or slope[a] < 0)
                    if not inside or usual[a] <= ROUNDED:
                        slope[a] = 0.0
                        for b in range(r):
                            information[a, b], information[b, a] = 0.0, 0.0
                        information[a, a] = 1.0
                    else:
                        ways += 1
                        information[a, a] = max(information[a, a] * (1 + 1e-6), 1e-18)
                if ways == 0:
                    break
                invert(information, free, small)
                largest, promise = 1e-300, 0.0
                for a in range(r):
                    change[a] = 0.0
                    for b in range(r):
                        change[a] += free[a, b] * slope[b]
                    largest = max(largest, abs(change[a]))
                for a in range(r):
                    change[a] *= min(1.0, FARTHEST / largest)
                    promise += slope[a] * change[a]
                if not promise >= ENOUGH:
                    break
                better = False
                for cut in (1.0, 0.5, 0.25, 0.1, 0.01):
                    for a in range(r):
                        tried[a] = min(max(logs[a] + cut * change[a], LEAST_LOG), MOST_LOG)
                        variances[random[a]] = math.exp(tried[a]) / usual[a] if usual[a] > ROUNDED else 0.0
                    other = whiten(columns, plain, variances, small[0])
                    other -= 0.5 * regress(columns, rest, nothing, outputs, small)
                    for t in range(T):
                        other -= 0.5 * behind[t]
                    if other > likelihood:
                        better = True
                        break
                if not better:
                    break
                likelihood = other
                for a in range(r):
                    logs[a] = tried[a]
            for a in range(r):
                variances[random[a]] = math.exp(logs[a]) / usual[a]
                if usual[a] <= ROUNDED or logs[a] <= LEAST_LOG + 1e-6:
                    variances[random[a]] = 0.0
        sums[2] = whiten(columns, plain, variances, small[0])
        regress(columns, rest, known, outputs, small)
        for t in range(T):
            before[t] *= noise / weight[t]
            behind[t] *= noise / weight[t]
        noise = likeliest_noise(behind, rows, noise, least)
        for t in range(T):
            weight[t] = (rows[t] + OWN_ROWS) / (OWN_ROWS + behind[t] / noise)
    sums[0], sums[1] = noise, likeliest_noise(before, rows, noise, least)
