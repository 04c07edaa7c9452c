"""Error against run time: reference values, the methods measured, what is made of them, page and command."""

import json
import math
import sys
from dataclasses import replace
from html.parser import HTMLParser
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from independent import (
    characteristic,
    continuous_energy,
    deviation,
    flow_in_many_digits,
    radius_by_polynomial,
    settling_bracket,
    simulate,
    stable_by_schur_cohn,
)
from report_data import report_data

from pipeline.base.wording import duration, error_text
from pipeline.records import accuracy
from pipeline.records.accuracy import OURS, AccuracyReport, Rung
from pipeline.rendering.report import report as comparison_report
from pipeline.rendering.report.report_parts import take_apart
from pipeline.studies.accuracy import ladder, methods, page, searches, sweeps
from pipeline.studies.accuracy.device_ladders import DEVICE_QUANTITIES, device_ladders
from pipeline.studies.accuracy.run import left_out, measure, words
from pipeline.studies.accuracy.theory_ladders import IDEAL, reference, theory_ladders

QUANTITIES = (*IDEAL, *DEVICE_QUANTITIES)

CASE = methods.Case(0.001, 0.02, 4)


@pytest.fixture(scope="module")
def report() -> AccuracyReport:
    return measure(quick=True, measured=False)


# reference values, by methods that share nothing with their script


@pytest.mark.parametrize("row", range(0, 20, 3))
def test_reference_plants_equal_matrix_exponential(row: int) -> None:
    entry = reference()["plant"][row]
    m = flow_in_many_digits(entry["gamma"], entry["delta"], 1.0)
    assert entry["gain"] == pytest.approx([float(m[0, 2]), float(m[1, 2])], rel=1e-15)


def test_reference_boundary_has_a_pole_on_the_unit_circle() -> None:
    entry = reference()["boundary"]
    for i in (0, 25, 50):
        for factor, stable in ((1 - 1e-13, True), (1 + 1e-13, False)):
            polynomial = characteristic(0.001, 0.02, 4, entry["alpha"][i] * factor, entry["beta"][i])
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


# the methods that are measured


def test_printed_formula_equals_matrix_exponential_where_it_holds() -> None:
    printed = methods.printed_transfer(0.3, 0.4)
    assert printed == pytest.approx(methods.transfer_by_expm(0.3, 0.4), rel=1e-13)
    with pytest.raises(ZeroDivisionError):
        methods.printed_transfer(0.0, 0.4)
    with pytest.raises(ZeroDivisionError):
        methods.printed_transfer(0.25, 1.0)


def test_runge_kutta_is_of_fourth_order() -> None:
    exact = np.array(methods.plant_by_expm(0.3, 0.4).gain)
    coarse, fine = (np.abs(methods.plant_by_runge_kutta(0.3, 0.4, n).gain - exact).max() for n in (8, 16))
    assert coarse / fine == pytest.approx(16, rel=0.1)


@pytest.mark.parametrize("delay", [0, 1, 4])
def test_radii_agree(delay: int) -> None:
    alpha, beta = np.array([0.01, 0.02]), np.array([0.1, 0.15])
    case, by_expm = methods.Case(0.001, 0.02, delay), methods.transfer_by_expm
    exact = [radius_by_polynomial(0.001, 0.02, delay, a, b) for a, b in zip(alpha, beta, strict=True)]
    assert methods.radius_by_roots(case, alpha, beta, by_expm) == pytest.approx(exact, rel=1e-11)
    assert methods.radius_by_eigenvalues(case, alpha, beta) == pytest.approx(exact, rel=1e-11)
    assert methods.radius_by_squaring(case, alpha, beta, 40) == pytest.approx(exact, rel=1e-9)


def test_settling_is_missing_where_the_response_ends_outside_the_band() -> None:
    position = np.array([[-1.0, -1.0], [0.5, -0.01], [0.1, 0.0]])
    found = methods.settling_of(position, 1, 0.02)
    assert np.isnan(found[0])
    assert found[1] == pytest.approx(0.98 / 0.99)


def test_nelder_mead_finds_the_minimum_of_a_smooth_bowl() -> None:
    found = searches.nelder_mead(lambda a, b: (a - 0.3) ** 2 + 2 * (b - 0.7) ** 2, (0.2, 0.5), 0.2, 1e-9)
    assert found == pytest.approx((0.3, 0.7), rel=1e-6)


class _StandIn:
    """The calls of python-control that are used, by numpy: the library itself is not needed to develop."""

    class System:
        def __init__(self, a: object, b: object, c: object, d: object, dt: float = 0.0) -> None:
            self.A, self.B, self.C = np.asarray(a), np.asarray(b), np.asarray(c)

        def poles(self) -> np.ndarray:
            return np.linalg.eigvals(self.A)

    ss = System


def test_calls_of_python_control_make_the_same_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    row = reference()["points"]["rows"][0]
    monkeypatch.setitem(sys.modules, "control", _StandIn)  # type: ignore[arg-type]
    found = methods.radius_by_control(CASE, np.array([row["alpha"]]), np.array([row["beta"]]))
    assert found == pytest.approx([row["radius"]], rel=1e-12)


def test_lyapunov_energies_are_the_sums_of_a_long_recurrence() -> None:
    wall = np.array([0.02]), np.array([0.15])
    by_equations, summed = methods.lyapunov_energy(CASE, *wall), methods.truncated_energy(CASE, *wall, 4096)
    for w in range(3):
        assert by_equations[w] == pytest.approx(summed[w], rel=1e-9)


# the measurement


def test_every_quantity_is_measured_by_this_package_and_others(report: AccuracyReport) -> None:
    for quantity in QUANTITIES:
        methods = {r.method for r in report.rungs if r.quantity == quantity}
        assert OURS in methods
        assert len(methods) >= 2


def test_own_errors_are_as_small_as_promised(report: AccuracyReport) -> None:
    own = {r.quantity: r.error for r in accuracy.own_rungs(report)}
    assert own["plant"] is not None
    limits = dict.fromkeys(QUANTITIES, 1e-10) | {"plant": 1e-14, "boundary": 1e-12, "spectral radius": 1e-12}
    limits |= {"optimum of energy": 1e-6, "optimum of settling time": 1e-7}  # flat at the optimum: half the digits
    assert {name: error for name, error in own.items() if error is None or error > limits[name]} == {}


def test_more_work_gives_smaller_errors(report: AccuracyReport) -> None:
    for method, quantity in (
        ("simulation (Runge-Kutta)", "plant"),
        ("eigenvalues and bisection", "boundary"),
        ("truncated recurrence", "energy, w = 1"),
        ("dense simulation", "energy, w = 1"),
    ):
        errors = [r.error for r in report.rungs if (r.method, r.quantity) == (method, quantity)]
        assert None not in errors
        assert errors == sorted(errors, reverse=True)
        assert len(errors) >= 2


def test_sweeps_find_where_the_printed_formula_fails(report: AccuracyReport) -> None:
    found = {(s.sweep, s.method): s for s in report.sweeps}
    assert found["gamma", "printed formula (3.7)"].starts == pytest.approx(1e-12, rel=1e3)
    assert found["critical", "printed formula (3.7)"].worst is None  # it divides by zero
    for path in ("gamma", "gamma_damped", "critical", "delta", "delay", "resonant"):
        assert found[path, OURS].starts is None, path
        assert not found[path, OURS].wrong_verdicts
    assert found["resonant", "polynomial roots"].wrong_verdicts
    assert found["margin", OURS].worst == 0
    assert found["margin", "polynomial roots"].worst  # the sweep can tell a wrong verdict
    worst = found["delay_energy", OURS].worst
    assert worst is not None
    assert worst <= 1e-10
    for w in range(3):
        s = found[f"limit_w{w}", OURS]
        good = [e for x, e in zip(s.x, s.error, strict=True) if x >= 1e-4]
        assert max(e for e in good if e is not None) <= 1e-10


def test_left_out_methods_have_reasons() -> None:
    entries = left_out()
    assert all(entry.reason for entry in entries)
    absent = find_spec("control") is None
    assert absent == any(entry.method == "python-control" for entry in entries)


def test_time_is_the_least_of_repetitions() -> None:
    calls: list[int] = []
    result, seconds = ladder.best_time(lambda: calls.append(1) or len(calls), 0.005)
    assert result == 1
    assert 0 < seconds < 1e-3
    assert len(calls) > 100


# what is made of it


def _rung(method: str, error: float | None, seconds: float, setting: str = "one setting") -> Rung:
    return Rung(quantity="plant", method=method, setting=setting, error=error, seconds=seconds)


def test_a_method_is_wrong_from_its_first_missing_number_or_verdict() -> None:
    assert sweeps.starts_wrong((1.0, 0.1, 0.01), (0.0, None, 0.0)) == 0.1
    assert sweeps.starts_wrong((1.0, 0.1, 0.01), (0.0, 0.0, 1e-5)) == 0.01
    assert sweeps.starts_wrong((1.0, 0.1), (0.0, 0.0), (False, True)) == 0.1
    assert sweeps.starts_wrong((1.0, 0.1), (0.0, 1e-7)) is None
    assert sweeps.worst((1e-3, None)) is None
    assert error_text(2.6e-9) == "3·10⁻⁹"
    assert error_text(1.0) == "1"
    assert duration(4.19e-4) == "419 µs"


def test_stored_measurement_is_used_while_code_and_machine_are_the_same(report: AccuracyReport, tmp_path: Path) -> None:
    assert accuracy.stored(tmp_path) is None
    accuracy.store(report, tmp_path)
    assert accuracy.stored(tmp_path) == report
    accuracy.store(report.model_copy(update={"key": "another machine"}), tmp_path)
    assert accuracy.stored(tmp_path) is None
    (tmp_path / accuracy.STORED).write_text("{", encoding="utf-8")
    assert accuracy.stored(tmp_path) is None


class _Page(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.figures = 0
        self.loads: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        if found.get("id"):
            self.ids.append(str(found["id"]))
        self.figures += tag == "svg" and found.get("role") == "img"
        if tag in ("script", "link", "img", "iframe"):
            self.loads.append(tag)


def test_page_is_complete_and_self_contained(report: AccuracyReport, tmp_path: Path) -> None:
    path = tmp_path / "accuracy.html"
    page.write(report, path)
    text = path.read_text(encoding="utf-8")
    shown = _Page(text)
    assert shown.loads == []
    assert len(shown.ids) == len(set(shown.ids))
    assert shown.figures == 1
    assert set(words()["sweeps"]) == {s.sweep for s in report.sweeps}
    assert set(words()["meaning"]) == set(QUANTITIES)
    for entry in report.left_out:
        assert entry.reason.split(",")[0] in text
    assert "Quick run" in text
    assert len(text) < 1_500_000


def test_summary_compares_with_the_quickest_good_method() -> None:
    rungs = (_rung(OURS, 1e-15, 1e-3), _rung("bad", 1e-2, 1e-9), _rung("slow", 1e-9, 1.0), _rung("good", 1e-7, 1e-2))
    empty = AccuracyReport(key="", quick=True, measured="", machine={}, rungs=rungs)
    row = page.summary_rows(empty)[0]
    assert (row["other"], row["other time"]) == ("good", duration(1e-2))


def test_full_ladders_hold_all_rungs_of_the_quick_ones() -> None:
    quick, full = (
        {(*of.exact, m.name) for of in (*theory_ladders(), *device_ladders()) for m in of.methods for _ in m.runs(q)}
        for q in (True, False)
    )
    assert quick == full


def test_command_writes_page_and_json(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, report: AccuracyReport) -> None:
    from typer.testing import CliRunner

    from pipeline.shell import cli
    from pipeline.studies.accuracy import run

    monkeypatch.setattr(run, "measure", lambda quick, say, theory, measured: report)
    out, processed = tmp_path / "page.html", tmp_path / "processed"
    arguments = ["accuracy", "--only", "theory", "--quick", "--json", "--out", str(out), "--processed", str(processed)]
    result = CliRunner().invoke(cli.app, arguments)
    assert result.exit_code == 0
    assert AccuracyReport.model_validate(json.loads(result.stdout)) == report
    assert AccuracyReport.model_validate_json(out.with_suffix(".json").read_text(encoding="utf-8")) == report
    assert accuracy.stored(processed) == report
    assert "Stiff and extreme cases" in out.read_text(encoding="utf-8")


def test_reports_of_comparisons_show_the_stored_measurement(report: AccuracyReport) -> None:
    data = report_data(full=False)
    without, shown = comparison_report.render(data), comparison_report.render(replace(data, accuracy=report))
    assert "were not measured with this version" in without
    assert "were not measured with this version" not in shown
    table = {name: text for name, text in take_apart(shown).cells.items() if name.startswith("accuracy")}
    assert len(table) == 4 * len(QUANTITIES)
    own = {r.quantity: r for r in accuracy.own_rungs(report)}
    assert duration(own["map"].seconds) in table.values()


@pytest.mark.slow
def test_full_measurement_holds_up_to_the_largest_delay() -> None:
    report = measure(measured=False)
    assert report.seconds < 120  # a minute on a quiet core
    longest = {s.sweep: s for s in report.sweeps if s.method == OURS and s.sweep.startswith("delay")}
    assert all(s.x[-1] == 256 and s.starts is None for s in longest.values())
    assert {r.quantity for r in report.rungs} == set(QUANTITIES)
