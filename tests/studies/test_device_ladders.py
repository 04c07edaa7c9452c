"""Truth of the general loop's ladders: against a loop in other states, in SI, by mpmath."""

import ast
import inspect
import math

import mpmath as mp
import numpy as np
import pytest
from general_devices import Example, ManyDigits, characteristic, schur_cohn

from pipeline.records.accuracy import OURS
from pipeline.records.loop_parts import Butterworth, LoopParts, Mode
from pipeline.studies.accuracy import device_ladders as ladders
from pipeline.studies.accuracy import integrated
from pipeline.studies.accuracy.theory_ladders import reference

TURN = math.sqrt(0.5 / 0.21)
"""Free resonance of a spring 0.5 between masses 0.3 and 0.7 [rad/sample]."""


@pytest.fixture(scope="module")
def truth():
    """The loop of the ladders for a mass of 1 kg and a period of 1 s, with 40 digits in force."""
    parts = LoopParts(
        velocity=Butterworth(kind="butterworth", order=2, cutoff_hz=0.08),
        actuator_lag_s=1.5,
        mode=Mode(frequency_hz=TURN / (2 * math.pi), damping_ratio=0.03 / (2 * TURN * 0.21), mass=0.3),
    )
    with mp.workdps(40):
        yield ManyDigits(Example(1.0, 0.006, 0.0, 2.4, 1.0, parts))


def test_limits(truth):
    known = reference()["device"]
    for alpha, beta in zip(known["limit_alpha"][::2], known["limit_beta"][::2], strict=True):
        assert [truth.stable(alpha * (1 + side * 1e-12), beta) for side in (-1, 1)] == [True, False]


def test_radii(truth):
    known = reference()["device"]
    for alpha, beta, radius in list(zip(known["alpha"], known["beta"], known["radius"], strict=True))[::2]:
        matrix = truth.matrix(mp.mpf(alpha), mp.mpf(beta))
        used = [*truth.kept, *range(5, matrix.rows)]
        kept = mp.matrix([[matrix[i, j] for j in used] for i in used])
        circles = [mp.mpf(radius) * (1 + side * mp.mpf("1e-12")) for side in (-1, 1)]
        assert [schur_cohn(characteristic(kept / circle)) for circle in circles] == [False, True]


def test_costs(truth):
    alpha, beta = (reference()["device"][name][1] for name in ("alpha", "beta"))
    matrix = truth.matrix(mp.mpf(alpha), mp.mpf(beta))
    z = mp.zeros(matrix.rows, 1)
    z[0] = z[2] = -1
    for i in range(max(len(truth.b), 1) + truth.segments[0][1]):
        z[5 + i] = -1
    sampled = []
    for _ in range(500):
        sampled.append(float(z[truth.sensor]))
        z = matrix * z
    e, k = np.array(sampled), np.arange(500)
    energy = e**2 + np.diff(e, prepend=e[0]) ** 2 / alpha
    exact = {name: values[1] for name, values in ladders.exact_costs().items()}
    assert exact[ladders.OVERSHOOT] >= e.max()
    for w in range(3):
        assert exact[f"energy, w = {w}, hard loops"] == pytest.approx(float((k**w * energy).sum()), rel=1e-10)


def test_truth_of_costs_shares_nothing_with_what_it_judges():
    tree = ast.parse(inspect.getsource(integrated))
    names = [node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    assert [name for name in names if name.startswith(("pipeline.loop", "pipeline.theory"))] == []


def test_burst_behind_a_long_delay_is_met():
    # settles at 136.19 for who looks at every 16th sample alone, at 203.07 in plain iteration
    found = integrated.followed(integrated.HARD_LOOPS["burst behind 66 samples"])
    assert found["settle"] == pytest.approx(203.067059808488, rel=1e-12)


def test_own_costs_of_hard_loops_are_those_of_the_differential_equations():
    errors = {
        r.quantity: r.error for r in list(ladders.device_ladders())[2].rungs(quick=True, budget=0.0) if r.method == OURS
    }
    assert len(errors) == 5
    assert max(errors.values()) < 1e-11


def test_a_longer_delay_is_no_substitute_and_the_loop_itself_is_exact():
    errors = {r.method: r.error for r in next(ladders.device_ladders()).rungs(quick=True, budget=0.0)}
    assert errors["a longer delay in place of filter and lag"] > 0.1
    assert errors[OURS] < 1e-11
