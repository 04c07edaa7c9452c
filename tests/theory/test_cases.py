"""Documents of theory: costs of listed points, boundaries and optima; what overflows is refused by name."""

from pathlib import Path

import numpy as np
import pytest
from independent import (
    between_points,
    characteristic,
    deviation,
    discrete_settling,
    settling_bracket,
    simulate,
    stable_by_schur_cohn,
)
from simulated import spectral_radius

from pipeline.base.errors import ParameterError
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.shell.points_file import read_cases
from pipeline.theory import cases as theory
from pipeline.theory import modes
from pipeline.theory.boundary import robust_outline
from pipeline.theory.cases import LARGEST, Case, Cases, best_wall, costs_of_cases

HEADER = "alpha,beta,gamma,delta,delay\n"


def written(tmp_path, text):
    path = tmp_path / "cases.csv"
    path.write_text(text, encoding="utf-8")
    return path


def points(tmp_path, *rows):
    text = HEADER + "".join(",".join(str(v) for v in row) + "\n" for row in rows)
    return costs_of_cases(read_cases(written(tmp_path, text))).to_json()


def test_a_cost_that_takes_too_long_is_named_and_the_others_stand(tmp_path, monkeypatch):
    monkeypatch.setattr(theory, "LONGEST", 8000)
    monkeypatch.setattr(modes, "STILL_REPRODUCED", -1.0)  # as where modes lie so close together that they tell nothing
    (found,) = points(tmp_path, (1e-4, 0.01, 0, 0.1, 3))
    assert found["settle_2pct"] == pytest.approx(np.log(50) / -np.log(found["spectral_radius"]), abs=15)
    assert found["overshoot"] is None
    assert found["reason"] == "still moves after 8000 samples: no overshoot, overshoot_discrete"


CASES = [(0.05, 0.3, 0, 0.02, 1), (0.02, 0.2, 0, 0.0, 3), (0.4, 0.9, 0, 0.1, 0), (0.1, 0.5, 0, 0.02, 1)]


@pytest.mark.parametrize("case", CASES)
def test_costs_of_points_equal_those_of_a_simulated_response(tmp_path, case):
    alpha, beta, _, delta, delay = case
    (found,) = points(tmp_path, case)
    motion = simulate(alpha, beta, delta=delta, delay=(delay, 1), samples=1000, fine=64)
    e = deviation(motion, alpha)
    x = e[:: motion.every]
    assert found["stable"] is True
    assert found["reason"] is None
    radius = spectral_radius(alpha, beta, mass=1.0, b=delta, delay=delay, T=1.0)
    assert found["spectral_radius"] == pytest.approx(radius, abs=1e-9)
    assert found["settle_2pct_discrete"] == discrete_settling(motion, alpha, 0.02)
    # the samples see the peak only up to rounding of 1 - 1e-16
    assert found["overshoot_discrete"] == pytest.approx(max(x.max(), 0.0), abs=1e-12)
    low, high = settling_bracket(motion, alpha, 0.02)
    assert low - 1e-9 <= found["settle_2pct"] <= high + 1e-9
    assert found["overshoot"] == pytest.approx(max(e.max(), 0.0), abs=between_points(motion))
    k = np.arange(len(x))
    energy = x**2 + np.diff(x, prepend=x[0]) ** 2 / alpha  # over E_0 = alpha/2
    for w in (0, 1, 2):
        assert found[f"energy_step_w{w}_discrete"] == pytest.approx(np.sum(k**w * energy), rel=1e-9)


def test_points_keep_their_order_whatever_plants_they_share(tmp_path):
    rows = [CASES[i] for i in (0, 1, 3, 2)] + [(0.05, 0.3, 0.001, 0.02, 1.5), CASES[0]]
    together = points(tmp_path, *rows)
    for row, document in zip(rows, together, strict=True):
        assert tuple(document[name] for name in theory.CASE_COLUMNS) == row
        alone = points(tmp_path, row)[0]
        assert document.keys() == alone.keys()
        for name, value in alone.items():  # matrix products round by the number of their columns
            assert document[name] == (value if name == "reason" else pytest.approx(value, rel=1e-13)), name


@pytest.mark.parametrize(
    ("case", "reason"),
    [
        ((5.0, 0.1, 0, 0, 2), "unstable"),
        ((0.0, 0.3, 0, 0, 1), "no final position"),
        ((-0.1, 0.3, 0.05, 0.1, 1), "no final position"),
        ((-0.001, 0.1, 0.001, 0.02, 0), "no final position"),
    ],
)
def test_points_without_costs_are_null_with_a_reason(tmp_path, case, reason):
    (found,) = points(tmp_path, case)
    assert found["stable"] is False
    assert found["spectral_radius"] >= 1 - 1e-7  # a double pole at z = 1 is found to the root of rounding
    assert found["reason"].startswith(reason)
    assert [found[name] for name in theory.POINT_COSTS] == [None] * 16


def test_point_on_the_verge_of_stability_gets_no_numbers_made_of_rounding(tmp_path):
    (found,) = points(tmp_path, (1e-14, 0.3, 0, 0, 1))
    assert found["energy_step_w0"] is None
    assert "spectral radius within" in found["reason"]


def test_columns_may_come_in_any_order_with_others_between(tmp_path):
    text = "delay, note,beta,alpha,delta,gamma\n1,a,0.3,0.05,0.02,0\n\n3,b,0.2,0.02,0,0\n"
    cases = read_cases(written(tmp_path, "\ufeff" + text))
    assert cases.values.tolist() == [[0.05, 0.3, 0, 0.02, 1], [0.02, 0.2, 0, 0, 3]]
    assert cases.row == (2, 4)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no column alpha, beta, gamma, delta, delay.*found nothing"),
        ("alpha,beta,gamma,delta\n1,1,1,1\n", "row 1: no column delay"),
        ("alpha,alpha,beta,gamma,delta,delay\n1,1,1,1,1,1\n", "alpha occurs twice"),
        (HEADER + "0.1,0.1,0,0,1\n0.1,abc,0,0,1\n", "row 3, column beta.*'abc'"),
        (HEADER + "0.1,,0,0,1\n", "row 2, column beta.*''"),
        (HEADER + "0.1,0.1,0,nan,1\n", "row 2, column delta.*'nan'"),
        (HEADER + "0.1,0.1,0,0,inf\n", "row 2, column delay.*'inf'"),
        (HEADER + "0.1,0.1,0,0\n", "row 2: expected 5 cells.*found 4"),
        (HEADER + "0.1,0.1,0,0,1\n0.1,0.1,0,0,-1\n", "row 3: delay = -1"),
        (HEADER + "0.1,0.1,-0.5,0,1\n", "row 2: gamma = -0.5"),
        (HEADER + "0.1,0.1,0,-0.5,1\n", "row 2: delta = -0.5"),
        (HEADER + "0.1,0.1,11,0,1\n", r"row 2: gamma = 11.*\(4.15\)"),
    ],
)
def test_wrong_cases_are_named_with_their_row(tmp_path, text, message):
    with pytest.raises(ParameterError, match=r"cases\.csv.*" + message):
        costs_of_cases(read_cases(written(tmp_path, text))).to_json()


def test_missing_and_binary_files_are_named(tmp_path):
    with pytest.raises(ParameterError, match=r"none\.csv: cannot be read"):
        read_cases(tmp_path / "none.csv")
    (tmp_path / "cases.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ParameterError, match="not a CSV file in UTF-8"):
        read_cases(tmp_path / "cases.csv")


def test_header_alone_is_an_empty_list(tmp_path):
    assert points(tmp_path) == []


@pytest.mark.parametrize(
    ("plant_of", "alpha_max", "beta_at", "beta_max"),
    [((0, 0, 1), 0.14447, 0.425, 0.82843), ((0.001, 0.02, 4), 0.02567, 0.178, 0.32929)],  # B.1, B.4
)
def test_boundary_document_reproduces_table_b(plant_of, alpha_max, beta_at, beta_max):
    found = theory.limits_of_walls(Case(NormalisedLoop.ideal(*plant_of))).to_json()
    assert found["alpha_max"] == pytest.approx(alpha_max, abs=5e-6)
    assert found["beta_at_alpha_max"] == pytest.approx(beta_at, abs=1e-3)
    assert found["beta_max"] == pytest.approx(beta_max, abs=5e-6)
    assert max(found["alpha"]) == pytest.approx(found["alpha_max"], rel=1e-12)
    assert len(found["alpha"]) == len(found["beta"])


def test_optima_on_the_boundary_have_no_cost():
    # Table C.1
    largest = best_wall(Case(NormalisedLoop.ideal(0.001, 0.02, 0)), "alpha_max").to_json()
    assert (largest["alpha"], largest["beta"]) == pytest.approx((0.7127, 0.82423), abs=5e-5)
    assert largest["cost"] is None
    assert largest["reason"]
    top = best_wall(Case(NormalisedLoop.ideal(0.001, 0.02, 0)), "beta_max").to_json()
    assert (top["alpha"], top["beta"]) == pytest.approx((-0.001, 2.0270), abs=5e-5)


def test_criteria_without_cost_or_point_say_so():
    tuning = best_wall(Case(NormalisedLoop.ideal(0, 0, 1)), "ziegler_nichols").to_json()
    assert (tuning["alpha"], tuning["beta"]) == pytest.approx((0.056, 0.373), abs=5e-4)  # Table C.2
    assert (tuning["cost"], tuning["reason"]) == (None, "a tuning rule has no cost")
    assert best_wall(Case(NormalisedLoop.ideal(0, 0, 1)), "energy_impulse_w0").to_json()["reason"].startswith("a limit")
    poles = best_wall(Case(NormalisedLoop.ideal(0, 0, 1)), "pole_radius", "discrete").to_json()
    assert (poles["criterion"], poles["cost"]) == ("pole_radius", pytest.approx(0.752, abs=5e-4))
    assert "reason" not in poles


def test_signal_and_suffix_mean_the_same():
    loop = NormalisedLoop.ideal(0, 0, 2)  # the LWR of Table D.5: 8.21 continuous, 8.690 discrete
    by_signal = best_wall(Case(loop), "energy_step_w0", "discrete").to_json()
    assert by_signal == best_wall(Case(loop), "energy_step_w0_discrete").to_json()
    continuous = best_wall(Case(loop), "energy_step_w0").to_json()
    assert continuous["cost"] == pytest.approx(8.21, abs=5e-3)
    assert by_signal["cost"] == pytest.approx(8.690, abs=5e-4)


@pytest.mark.parametrize(
    ("criterion", "signal", "message"),
    [
        ("speed", None, "'speed'; expected one of alpha_max.*energy_step_w2"),
        ("damping_discrete", None, "expected one of"),
        ("alpha_max_discrete", None, "expected one of"),
        ("overshoot_discrete", "continuous", "signal is continuous"),
        ("overshoot", "digital", "expected continuous or discrete"),
    ],
)
def test_unsupported_optima_are_refused(criterion, signal, message):
    with pytest.raises(ParameterError, match=message):
        best_wall(Case(NormalisedLoop.ideal(0, 0, 0)), criterion, signal).to_json()


@pytest.mark.slow
def test_robust_outline_is_the_limit_of_its_worst_spring_and_of_no_other() -> None:
    found = robust_outline(0.03, 1.25)
    assert len(found[0]) > 20
    assert found[1][0] < 0
    assert found[1][-1] > 0.02
    for alpha, beta, worst in list(zip(*found, strict=True))[::9]:
        for factor in (1 - 1e-6, 1 + 1e-6):
            assert stable_by_schur_cohn(characteristic(worst, 0.03, 1.25, alpha * factor, beta)) == (factor < 1)
        for spring in np.linspace(0, np.pi**2, 12):
            assert stable_by_schur_cohn(characteristic(float(spring), 0.03, 1.25, alpha * (1 - 1e-6), beta))
    assert len(robust_outline(0.0, 1.0)[0]) == 0


def cases(*rows):
    return Cases(Path("points"), np.array(rows), tuple(range(1, len(rows) + 1)))


@pytest.mark.parametrize(("alpha", "beta", "column"), [(1e308, 0.1, "alpha"), (0.1, -1e308, "beta")])
def test_points_that_overflow_are_refused_by_name(alpha, beta, column):
    with pytest.raises(ParameterError, match=f"row 2, column {column}"):
        costs_of_cases(cases((0.1, 0.1, 0.0, 0.0, 1.0), (alpha, beta, 0.0, 0.0, 1.0))).to_json()


def test_points_far_outside_are_unstable():
    signs = [(a, b, delta, d) for a in (-1, 1) for b in (-1, 1) for delta in (0.0, 1.0) for d in (0.0, 3.5)]
    rows = [(a * LARGEST, b * LARGEST, 0.0, delta, d) for a, b, delta, d in signs]
    assert {point["stable"] for point in costs_of_cases(cases(*rows)).to_json()} == {False}


def test_optima_say_that_islands_were_not_searched():
    # on an island at (0.2581, -0.2340) this energy is 106.1
    found = best_wall(Case(NormalisedLoop.ideal(1.98, 0.0, 6.42)), "energy_step_w1").to_json()
    assert found["cost"] > 122
    assert "not searched" in found["note"]
    assert "note" not in best_wall(Case(NormalisedLoop.ideal(0.001, 0.02, 1.0)), "energy_step_w1").to_json()
