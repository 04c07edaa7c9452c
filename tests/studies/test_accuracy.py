"""Error against run time: tables of methods, extreme cases, page and command."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from independent import radius_by_polynomial
from report_data import report_data
from typer.testing import CliRunner

from pipeline.base.wording import duration, error_text
from pipeline.records import accuracy
from pipeline.records.accuracy import OURS, AccuracyReport, Rung
from pipeline.rendering.report import report as comparison_report
from pipeline.rendering.report.report_parts import take_apart
from pipeline.shell import cli
from pipeline.studies.accuracy import extremes, peers, run
from pipeline.studies.accuracy.measure import Row, Table, best_time, mean, median
from pipeline.studies.accuracy.theory import reference, theory_tables

CASE = peers.Case(0.001, 0.02, 4)
EXACT = {"a": np.array([2.0, 4.0]), "b": np.array([5.0])}
QUANTITIES = run.words()["meaning"]


@pytest.fixture(scope="module")
def report() -> AccuracyReport:
    return run.measure(quick=True, measured=False)


# how a row is measured


def rungs_of(*rows: Row, quick: bool = False, **options: object) -> list[Rung]:
    return list(Table(EXACT, rows, **options).rungs(quick, 0.0))  # type: ignore[arg-type]


def test_a_rung_is_one_quantity_at_one_setting() -> None:
    def digits(power: int) -> dict[str, np.ndarray]:
        return {"a": EXACT["a"] * (1 + 10.0**-power), "b": np.array([5.0, 5.0 + 10.0**-power])}

    row = Row("m", digits, "{} digits", (1, 2, 3), 1)
    rungs = rungs_of(row, scale={"b": 1.0})
    assert [(r.quantity, r.setting) for r in rungs] == [(q, f"{n} digits") for n in (1, 2, 3) for q in "ab"]
    assert [r.error for r in rungs] == pytest.approx([0.1, 0.1, 0.01, 0.01, 1e-3, 1e-3])
    assert {r.setting for r in rungs_of(row, quick=True)} == {"1 digits"}


def test_a_method_without_a_number_has_a_rung_without_an_error() -> None:
    def fails() -> dict[str, np.ndarray]:
        raise ZeroDivisionError

    rungs = rungs_of(Row("m", fails))
    assert [(r.quantity, r.error, r.setting) for r in rungs] == [("a", None, "one setting"), ("b", None, "one setting")]
    with pytest.raises(KeyError):  # any other error is a defect of this program
        rungs_of(Row("m", lambda: {"c": np.ones(1)}))


def test_missing_values_are_counted_and_never_averaged() -> None:
    first, second = rungs_of(Row("m", lambda: {"a": np.array([np.nan, 4.4]), "b": np.array([5.5])}))
    assert (first.error, second.error) == (1.0, pytest.approx(0.1))
    assert median(np.array([-1.0, 3.0, np.nan, 2.0])) == mean(np.array([-1.0, 3.0, np.nan, 2.0])) == (2.0, 0.25)
    assert median(np.array([np.nan])) == (None, 1.0)


def test_a_library_that_is_not_installed_leaves_its_row_out() -> None:
    assert rungs_of(Row("m", dict, needs="no_such_library")) == []


def test_time_is_the_least_of_repetitions() -> None:
    calls: list[int] = []
    result, seconds = best_time(lambda: calls.append(1) or len(calls), 0.005)
    assert result == 1
    assert 0 < seconds < 1e-3
    assert len(calls) > 100


# the methods of others


def test_printed_formula_equals_matrix_exponential_where_it_holds() -> None:
    assert peers.printed_numerator(0.3, 0.4) == pytest.approx(peers.numerator(peers.plant_by_expm(0.3, 0.4)), rel=1e-13)
    for loop in ((0.0, 0.4), (0.25, 1.0)):
        with pytest.raises(ZeroDivisionError):
            peers.printed_numerator(*loop)


def test_runge_kutta_is_of_fourth_order() -> None:
    exact = peers.plant_by_expm(0.3, 0.4)
    coarse, fine = (np.abs(peers.plant_by_runge_kutta(0.3, 0.4, n) - exact).max() for n in (8, 16))
    assert coarse / fine == pytest.approx(16, rel=0.1)


@pytest.mark.parametrize("delay", [0, 1, 4])
def test_radii_agree(delay: int) -> None:
    wall, case = (np.array([0.01, 0.02]), np.array([0.1, 0.15])), peers.Case(0.001, 0.02, delay)
    exact = [radius_by_polynomial(0.001, 0.02, delay, a, b) for a, b in zip(*wall, strict=True)]
    assert peers.radius_by_roots(case, *wall) == pytest.approx(exact, rel=1e-11)
    assert peers.radius_by_eigenvalues(case, *wall) == pytest.approx(exact, rel=1e-11)
    assert peers.radius_by_squaring(peers.matrices(case, *wall), 40) == pytest.approx(exact, rel=1e-9)


def test_nelder_mead_finds_the_minimum_of_a_smooth_bowl() -> None:
    found = peers.nelder_mead(lambda a, b: (a - 0.3) ** 2 + 2 * (b - 0.7) ** 2, (0.2, 0.5), 1e-9)
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
    found = peers.radius_by_control(CASE, np.array([row["alpha"]]), np.array([row["beta"]]))
    assert found == pytest.approx([row["radius"]], rel=1e-12)


def test_lyapunov_energies_are_the_sums_of_a_long_recurrence() -> None:
    wall = np.array([0.02]), np.array([0.15])
    assert peers.lyapunov_energy(CASE, *wall) == pytest.approx(peers.truncated_energy(CASE, *wall, 4096), rel=1e-9)


# the measurement


@pytest.mark.slow
def test_every_quantity_is_measured_by_this_package_and_others(report: AccuracyReport) -> None:
    for quantity in QUANTITIES:
        methods = {r.method for r in report.rungs if r.quantity == quantity}
        assert OURS in methods
        assert len(methods) >= 2 or quantity.endswith("hard loops")
    assert {r.quantity for r in report.rungs} == set(QUANTITIES)


@pytest.mark.slow
def test_own_errors_are_as_small_as_promised(report: AccuracyReport) -> None:
    own = {r.quantity: r.error for r in accuracy.own_rungs(report)}
    limits = dict.fromkeys(QUANTITIES, 1e-10) | {"plant": 1e-14, "boundary": 1e-12, "spectral radius": 1e-12}
    limits |= {"optimum of energy": 1e-6, "optimum of settling time": 1e-7}  # flat at the optimum: half the digits
    limits |= {name: 1e-11 for name in QUANTITIES if name.endswith(("hard loops", "general loop"))}
    assert {name: error for name, error in own.items() if error is None or error > limits[name]} == {}


def test_more_work_gives_smaller_errors(report: AccuracyReport) -> None:
    for method, quantity in (("eigenvalues and bisection", "boundary"), ("dense simulation", "energy, w = 1")):
        errors = [r.error for r in report.rungs if (r.method, r.quantity) == (method, quantity)]
        assert None not in errors
        assert errors == sorted(errors, reverse=True)
        assert len(errors) >= 2
    longer = [r.error for r in report.rungs if r.method == "filter and lag as additional delay"]
    assert longer[0] is not None
    assert longer[0] > 0.1  # no substitute


def test_extreme_cases_find_where_each_method_fails(report: AccuracyReport) -> None:
    found = {(s.sweep, s.method): s for s in report.sweeps}
    assert found["gamma", "printed formula (3.7)"].starts == pytest.approx(1e-12, rel=1e3)
    assert found["critical", "printed formula (3.7)"].worst is None  # it divides by zero
    for (path, method), sweep in found.items():
        if method == OURS:
            assert sweep.starts is None, path
            assert not sweep.wrong_verdicts
            assert sweep.worst is not None
            assert sweep.worst <= 1e-10
    assert found["resonant", "polynomial roots"].wrong_verdicts
    assert found["margin", "polynomial roots"].worst  # the path can tell a wrong verdict
    assert set(run.words()["sweeps"]) == {s.sweep for s in report.sweeps}


def test_a_method_is_wrong_from_its_first_missing_number_or_verdict() -> None:
    assert extremes.starts_wrong((1.0, 0.1, 0.01), (0.0, None, 0.0)) == 0.1
    assert extremes.starts_wrong((1.0, 0.1, 0.01), (0.0, 0.0, 1e-5)) == 0.01
    assert extremes.starts_wrong((1.0, 0.1), (0.0, 0.0), (False, True)) == 0.1
    assert extremes.starts_wrong((1.0, 0.1), (0.0, 1e-7)) is None
    assert extremes.worst((1e-3, None)) is None
    assert error_text(2.6e-9) == "3·10⁻⁹"
    assert error_text(1.0) == "1"
    assert duration(4.19e-4) == "419 µs"


def test_quick_and_full_tables_have_the_same_rows() -> None:
    quick, full = (
        {(*of.exact, row.name) for of in theory_tables() for row in of.rows for _ in row.runs(q)} for q in (True, False)
    )
    assert quick == full


# page and command


def test_stored_measurement_is_used_while_code_and_machine_are_the_same(report: AccuracyReport, tmp_path: Path) -> None:
    assert accuracy.stored(tmp_path) is None
    accuracy.store(report, tmp_path)
    assert accuracy.stored(tmp_path) == report
    accuracy.store(report.model_copy(update={"key": "another machine"}), tmp_path)
    assert accuracy.stored(tmp_path) is None
    (tmp_path / accuracy.STORED).write_text("{", encoding="utf-8")
    assert accuracy.stored(tmp_path) is None


def test_page_is_complete_and_self_contained(report: AccuracyReport) -> None:
    text = run.render(report)
    assert re.findall("<(?:script|link|img|iframe)", text) == []
    identifiers = re.findall(r'\bid="([^"]+)"', text)
    assert len(identifiers) == len(set(identifiers)) > 0
    assert len(re.findall('<svg[^>]* role="img"', text)) == 1
    for entry in report.left_out:
        assert entry.reason.split(",")[0] in text
    assert "Quick run" in text
    assert len(text) < 1_500_000


def test_summary_compares_with_the_quickest_good_method() -> None:
    rungs = tuple(
        Rung(quantity="plant", method=method, setting="one setting", error=error, seconds=seconds)
        for method, error, seconds in (
            (OURS, 1e-15, 1e-3),
            ("bad", 1e-2, 1e-9),
            ("slow", 1e-9, 1.0),
            ("good", 1e-7, 1e-2),
        )
    )
    row = run.summary_rows(AccuracyReport(key="", quick=True, measured="", machine={}, rungs=rungs))[0]
    assert (row["other"], row["other time"]) == ("good", duration(1e-2))


def test_command_writes_page_and_json(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, report: AccuracyReport) -> None:
    report = report.model_copy(update={"rungs": report.rungs[:9]})
    monkeypatch.setattr(run, "measure", lambda quick, say: report)
    out, processed = tmp_path / "accuracy.html", tmp_path / "processed"
    places = {"PIPELINE_PROCESSED": str(processed), "PIPELINE_REPORTS": str(tmp_path)}
    result = CliRunner().invoke(cli.app, ["accuracy", "--quick", "--json"], env=places)
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
    own = {r.quantity: r for r in accuracy.own_rungs(report)}
    assert len(table) == 4 * len(QUANTITIES)
    assert duration(own["map"].seconds) in table.values()


@pytest.mark.slow
def test_full_measurement_holds_up_to_the_largest_delay() -> None:
    report = run.measure(measured=False)
    longest = {s.sweep: s for s in report.sweeps if s.method == OURS and s.sweep.startswith("delay")}
    assert all(s.x[-1] == 256 and s.starts is None for s in longest.values())
