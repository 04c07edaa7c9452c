"""Reference values of `pipeline accuracy`, by methods that share nothing with their script."""

from __future__ import annotations

import math

import mpmath as mp
import numpy as np
import pytest
from general_devices import ManyDigits, characteristic, schur_cohn
from independent import characteristic as ideal
from independent import (
    continuous_energy,
    deviation,
    flow_in_many_digits,
    radius_by_polynomial,
    settling_bracket,
    simulate,
    stable_by_schur_cohn,
)

from pipeline.device.loop import Loop
from pipeline.device.parts import Butterworth, Mode
from pipeline.studies.accuracy.theory import reference

TURN = math.sqrt(0.5 / 0.21)
"""Free resonance of a spring 0.5 between masses 0.3 and 0.7 [rad/sample]."""


@pytest.mark.parametrize("row", range(0, 20, 3))
def test_reference_plants_equal_matrix_exponential(row: int) -> None:
    entry = reference()["plant"][row]
    m = flow_in_many_digits(entry["gamma"], entry["delta"], 1.0)
    assert entry["gain"] == pytest.approx([float(m[0, 2]), float(m[1, 2])], rel=1e-15)


def test_reference_boundary_has_a_pole_on_the_unit_circle() -> None:
    entry = reference()["boundary"]
    for i in (0, 25, 50):
        for factor, stable in ((1 - 1e-13, True), (1 + 1e-13, False)):
            polynomial = ideal(0.001, 0.02, 4, entry["alpha"][i] * factor, entry["beta"][i])
            assert stable_by_schur_cohn(polynomial) == stable


@pytest.mark.parametrize("index", [0, 11, 23, 39])
def test_reference_costs_equal_dense_simulation(index: int) -> None:
    row = reference()["points"]["rows"][index]
    alpha, beta = row["alpha"], row["beta"]
    assert row["radius"] == pytest.approx(radius_by_polynomial(0.001, 0.02, 4, alpha, beta), rel=1e-13)
    samples = int(8 * math.log(10) / -math.log(row["radius"])) + 60
    motion = simulate(alpha, beta, delay=(4, 1), samples=samples, gamma=0.001, delta=0.02, fine=32)
    low, high = settling_bracket(motion, alpha + 0.001, 0.02)
    assert low <= row["settle_2pct"] <= high
    assert high - low < 0.05
    assert row["overshoot"] == pytest.approx(max(deviation(motion, alpha + 0.001).max(), 0), abs=2e-4)
    for w in range(3):
        energy = continuous_energy(motion, alpha + 0.001, 1.0, w, "step")
        assert row[f"energy_step_w{w}"] == pytest.approx(energy, rel=1e-6)


def test_reference_optima_equal_published_ones() -> None:
    entry = reference()["optimum"]
    energy, settle = entry["energy_step_w0"], entry["settle_2pct"]
    assert [energy[k] for k in ("alpha", "beta", "cost")] == pytest.approx([0.070228, 0.471013, 5.428833], abs=6e-7)
    assert [settle[k] for k in ("alpha", "beta", "cost")] == pytest.approx([0.044892, 0.303749, 9.908607], abs=6e-7)


def test_reference_radius_far_out_is_confirmed_by_counting_roots() -> None:
    row = reference()["sweeps"]["delay"][7]
    assert row["delay"] == 64
    found = radius_by_polynomial(row["gamma"], row["delta"], 64, row["alpha"], row["beta"])
    assert row["radius"] == pytest.approx(found, rel=1e-14)


def test_reference_near_the_limit_follows_the_power_law() -> None:
    rows = reference()["sweeps"]["limit"]
    assert [row["radius_gap"] / row["x"] for row in rows] == pytest.approx([1.0] * len(rows), rel=1e-3)
    for w in range(3):  # E_w grows as (1 - radius)^-(w + 1)
        growth = rows[-1][f"energy_step_w{w}"] / rows[-2][f"energy_step_w{w}"]
        assert growth == pytest.approx(10.0 ** (w + 1), rel=1e-3)


@pytest.fixture(scope="module")
def truth():
    """The loop of the ladders for a mass of 1 kg and a period of 1 s, with 40 digits in force."""
    loop = Loop(
        *(1.0, 0.006, 1.0, 2.4),
        velocity=Butterworth(kind="butterworth", order=2, cutoff_hz=0.08),
        actuator_lag_s=1.5,
        mode=Mode(frequency_hz=TURN / (2 * math.pi), damping_ratio=0.03 / (2 * TURN * 0.21), mass=0.3),
    )
    with mp.workdps(40):
        yield ManyDigits(loop)


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
    stored = reference()["hard"][1]
    assert (stored["alpha"], stored["beta"]) == (alpha, beta)
    assert stored["overshoot"] >= e.max()
    for w in range(3):
        assert stored[f"energy_step_w{w}_discrete"] == pytest.approx(float((k**w * energy).sum()), rel=1e-10)


def test_burst_behind_a_long_delay_is_met() -> None:
    # settles at 136.19 for who looks at every 16th sample alone, at 203.07 in plain iteration
    (burst,) = (row for row in reference()["hard"] if row["name"] == "burst behind 66 samples")
    assert burst["settle_1pct"] == pytest.approx(203.067059808488, rel=1e-12)
