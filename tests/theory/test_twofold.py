"""Twofold numbers against fractions, and the loop in twofold numbers against matrix exponentials in many digits."""

from __future__ import annotations

from decimal import Decimal, localcontext
from fractions import Fraction

import mpmath as mp
import numpy as np
import pytest
from independent import flow_in_many_digits

from pipeline.loop.loop import Loop
from pipeline.theory.refinement import _matrix_rows, add, from_decimals, multiply, twofold

DIGITS = Fraction(2) ** -102
"""31 digits: a rounding or two in the last bits of the second double."""


def exact(values: np.ndarray) -> list[Fraction]:
    return [Fraction(high) + Fraction(low) for high, low in values.T.tolist()]


def test_sums_and_products_have_twice_the_digits() -> None:
    rng = np.random.default_rng(31)
    a, b = (10 ** rng.uniform(-20, 20, 400) * rng.choice([-1, 1], 400) for _ in range(2))
    b[:100] = -a[:100] * (1 + 1e-12 * rng.uniform(-1, 1, 100))  # sums that cancel
    x, y = (add(twofold(v), twofold(v * rng.uniform(-1, 1, 400) * 2.0**-54)) for v in (a, b))
    for p, q, total, product in zip(exact(x), exact(y), exact(add(x, y)), exact(multiply(x, y)), strict=True):
        assert abs(total - (p + q)) <= (abs(p) + abs(q)) * DIGITS
        assert abs(product - p * q) <= abs(p * q) * DIGITS


def test_decimals_keep_twice_the_digits() -> None:
    with localcontext() as context:
        context.prec = 50
        rows = [[Decimal(n).sqrt() / m for n in (2, 3, 5)] for m in (7, -1)]
    found = from_decimals(rows)
    assert found.shape == (2, 2, 3)
    for part, row in zip(np.moveaxis(found, 1, 0), rows, strict=True):
        for value, true in zip(exact(part), row, strict=True):
            assert abs(value - Fraction(true)) <= abs(Fraction(true)) * DIGITS


@pytest.mark.parametrize(
    "loop", [Loop(9.8, 0.3, 0.25), Loop(0.0, 0.0, 0.0), Loop(1e-16, 1e-16, 3.0), Loop(4.0, 1000.0, 1.7), Loop(3, 9, 2)]
)
def test_rows_of_the_loop_matrix_have_twice_the_digits(loop: Loop) -> None:
    """States: position, velocity, last position, forces."""
    alpha, beta, whole = 0.3, 0.1, int(loop.delay)
    rows, columns = _matrix_rows(loop, np.array([alpha]), np.array([beta]))
    with mp.workdps(50):
        fraction = mp.mpf(loop.delay) - whole
        first, late = (flow_in_many_digits(loop.gamma, loop.delta, time) for time in (fraction, 1 - fraction))
        move = late * first
        pushes = {whole: [late[i, 2] for i in (0, 1)]}
        if fraction:
            pushes[whole + 1] = [late[i, 0] * first[0, 2] + late[i, 1] * first[1, 2] for i in (0, 1)]
        law = {0: -mp.mpf(alpha) - mp.mpf(beta), 2: mp.mpf(beta)}
        truth = {(i, j): move[i, j] for i in (0, 1) for j in (0, 1)} | {(2, 0): mp.mpf(1)}
        for age, push in pushes.items():
            for i in (0, 1):
                terms = {j: push[i] * value for j, value in law.items()} if age == 0 else {2 + age: push[i]}
                for j, term in terms.items():
                    truth[i, j] = truth.get((i, j), mp.mpf(0)) + term
        if len(rows[0, 0]) > 3:
            truth |= {(3, j): value for j, value in law.items()}
        for i, row in enumerate(rows[:, 0].transpose(1, 2, 0).tolist()):
            for column, (high, low) in zip(columns, row, strict=True):
                true = truth.get((i, column), mp.mpf(0))
                assert abs(mp.mpf(high) + mp.mpf(low) - true) <= abs(true) * mp.mpf(10) ** -30, (loop, i, column)
