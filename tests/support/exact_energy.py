"""Energy costs by Lyapunov equations in 50 digits, as close to the boundary and as strongly damped as may be."""

from __future__ import annotations

import math
from itertools import pairwise

import mpmath as mp
import numpy as np
from independent import DIGITS
from scipy.linalg import expm


def energies_in_many_digits(case: tuple[float, float, float, float, float], signal: str) -> dict[str, float]:
    """The six energies of (gamma, delta, delay, alpha, beta) by linear (Lyapunov) equations in 50 digits.

    State: position and velocity, position before, and the wall forces on their way. For few states.
    """
    gamma, delta, delay, alpha, beta = case
    whole, part = math.floor(delay), delay - math.floor(delay)
    waiting = whole + (1 if part else 0)
    n = 3 + waiting
    with mp.workdps(DIGITS):
        rate = mp.matrix([[0, 1, 0], [-mp.mpf(gamma), -mp.mpf(delta), 1], [0, 0, 0]])
        wall = [-mp.mpf(alpha) - mp.mpf(beta), mp.mpf(0), mp.mpf(beta), *[mp.mpf(0)] * waiting]
        unit = [[mp.mpf(int(i == j)) for j in range(n)] for i in range(n)]
        forces = [wall, *unit[3:]]  # by age
        moving, pieces, begun = [unit[0], unit[1]], [], 0.0
        for time, age in ((part, whole + 1), (1 - part, whole)) if part else ((1.0, whole),):
            rows = [*moving, forces[age]]
            pieces.append((begun, time, np.array([[float(c) for c in row] for row in rows])))
            step = mp.expm(rate * mp.mpf(time))
            moving = [[sum(step[i, k] * rows[k][j] for k in range(3)) for j in range(n)] for i in (0, 1)]
            begun += time
        matrix = mp.matrix([*moving, unit[0], *forces[:waiting]])
        start = [-1, 0, -1, *[mp.mpf(alpha)] * waiting] if signal == "step" else [0, 1, *[0] * (n - 1)][:n]
        z = mp.matrix(start)
        twice = mp.matrix(n * n, n * n)
        for i in range(n):
            for j in range(n):
                for k in range(n):
                    for m in range(n):
                        twice[i * n + j, k * n + m] = matrix[i, k] * matrix[j, m]
        left = mp.eye(n * n) - twice
        plain = mp.lu_solve(left, mp.matrix([z[i] * z[j] for i in range(n) for j in range(n)]))
        linear = mp.lu_solve(left, twice * plain)
        square = mp.lu_solve(left, twice * (plain + 2 * linear))
        sums = [np.array([[float(s[i * n + j]) for j in range(n)] for i in range(n)]) for s in (plain, linear, square)]
        speeds = [float(c) for c in (matrix[0, j] - (1 if j == 0 else 0) for j in range(n))]
    potential, kinetic = (1.0, 1 / (alpha + gamma)) if signal == "step" else (alpha + gamma, 1.0)
    moments = np.zeros((3, n, n))
    nodes, weights = np.polynomial.legendre.leggauss(20)
    plant = np.array([[0, 1, 0], [-gamma, -delta, 1], [0, 0, 0]])
    for begun, time, moves in pieces:
        # panels that double from 2/delta on: what the plant's own damping ends is integrated where it happens
        edges = time * np.append(0.0, 2.0 ** -np.arange(math.ceil(math.log2(max(0.5 * delta * time, 2.0))), -1.0, -1.0))
        for low, high in pairwise(edges):
            for node, weight in zip(low + 0.5 * (high - low) * (nodes + 1), 0.5 * (high - low) * weights, strict=True):
                place, speed = (expm(plant * node) @ moves)[:2]
                power = weight * (potential * np.outer(place, place) + kinetic * np.outer(speed, speed))
                moments += power * np.array([1, begun + node, (begun + node) ** 2])[:, None, None]
    result = {}
    for w in (0, 1, 2):
        result[f"w{w}"] = sum(math.comb(w, i) * float((moments[i] * sums[w - i]).sum()) for i in range(w + 1))
        steps = sum(math.comb(w, i) * float(speeds @ sums[i] @ np.array(speeds)) for i in range(w + 1))
        result[f"w{w}_discrete"] = potential * float(sums[w][0, 0]) + kinetic * steps
    return result
