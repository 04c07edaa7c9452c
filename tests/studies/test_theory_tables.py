"""The theory tables are recomputed without a gap, and each mark says what it promises."""

from __future__ import annotations

import json

import independent
import numpy as np
import pytest

import pipeline.studies.thesis_tables as module
from pipeline.device_data.published import THEORY_TABLES, PublishedPoint, published_points
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.shell.console import table
from pipeline.studies.thesis_tables import (
    FLAT,
    LIMIT,
    ROUNDING,
    Entry,
    TheoryRow,
    count_marks,
    recompute,
    summary_line,
    table_lines,
)
from pipeline.theory.boundary import boundary
from pipeline.theory.energy import energy_costs
from pipeline.theory.search import where_stable


def printed(criterion: str, table: str, gamma: float = 0.0, delta: float = 0.0) -> PublishedPoint:
    (point,) = (
        p
        for p in published_points([table])
        if (p.criterion, p.gamma, p.delta) == (criterion, gamma, delta) and not (table[0] == "B" and p.delay)
    )
    return point


def entry(point: PublishedPoint, name: str, **changes: object) -> Entry:
    (found,) = (e for e in recompute(point.model_copy(update=changes)).entries if e.name == name)
    return found


def test_tables_b_have_every_number_and_an_explanation_for_each() -> None:
    # all of B is computed here; C and 5.1 take a minute and are below, marked slow
    count = 0
    for name, size, rows in module.recomputed_tables(THEORY_TABLES[:4]):
        found = list(rows)
        assert len(found) == size == 26
        assert all(row.table == name for row in found)
        count += sum(len(row.entries) for row in found)
        assert count_marks(found) == {
            "equal": 77 if name == "B.3" else 78,
            "within": 1 if name == "B.3" else 0,
            "erratum": 0,
            "unexplained": 0,
        }
    assert count == 4 * 13 * 6


@pytest.mark.parametrize("delay", [0, 1, 3, 12])
def test_extreme_points_lie_on_the_boundary_of_an_independent_loop(delay: int) -> None:
    for point in published_points(["B.4"]):
        if point.delay != delay or point.criterion != "alpha_max":
            continue
        values = {e.name: e.computed for e in recompute(point).entries}
        for factor, stable in ((1 - 1e-7, True), (1 + 1e-7, False)):
            place = (point.gamma, point.delta, delay, factor * values["alpha"], values["beta"])
            assert independent.stable_by_schur_cohn(independent.characteristic(*place)) is stable


@pytest.mark.parametrize(
    ("text", "mark", "tolerance"),
    [  # the largest stable beta for d = 2, gamma = delta = 0 is 4 - 2 sqrt(3) = 0.535898...
        ("0.5359", "equal", None),
        ("0.53590", "equal", None),
        ("0.5358", "within", ROUNDING),
        ("0.5360", "unexplained", None),
        ("0.54", "equal", None),
        ("0.53", "within", ROUNDING),
        ("0.6359", "unexplained", None),
        ("-0.5359", "unexplained", None),
    ],
)
def test_a_number_is_judged_by_its_printed_digits(text: str, mark: str, tolerance: str | None) -> None:
    point = printed("beta_max", "C.3")
    found = entry(point, "beta", beta=text)
    assert found.computed == pytest.approx(4 - 2 * np.sqrt(3), rel=1e-12)
    assert (found.printed, found.mark, found.tolerance) == (text, mark, tolerance)
    if mark == "unexplained":
        excused = entry(point, "beta", beta=text, erratum_of=("beta",), erratum="why")
        assert (excused.mark, excused.reason) == ("erratum", "why")
        other = entry(point, "beta", beta=text, erratum_of=("alpha",), erratum="why")
        assert (other.mark, other.reason) == ("unexplained", None)
    else:
        # a reason that is kept does not turn a number that fits into an erratum
        kept = entry(point, "beta", beta=text, erratum_of=("beta",), erratum="why")
        assert (kept.mark, kept.reason) == (mark, None)


def test_flat_means_that_the_printed_point_costs_the_same() -> None:
    point = printed("energy_step_w2", "C.2", delta=0.02)
    found = entry(point, "beta")
    assert (found.mark, found.tolerance) == ("within", FLAT)
    assert found.reason is not None
    assert "79.46" in found.reason
    # away from the optimum the cost is larger, and there is no excuse
    assert entry(point, "beta", beta="0.3886").mark == "unexplained"
    # a cost printed with more digits tells the two points apart
    assert entry(point, "beta", cost="79.4689822").mark == "unexplained"


def test_a_limit_may_have_been_printed_from_a_point_beside_it() -> None:
    point = printed("energy_impulse_w0", "C.3")
    row = recompute(point)
    assert row.attained is False
    limit = row.entries[2].computed
    beside = independent.simulate(4e-5, 0.2938, delay=(2, 1), samples=60000, signal="impulse", fine=4)
    near = independent.continuous_energy(beside, 4e-5, 1.0, 0, "impulse")
    assert limit < near
    found = entry(point, "cost", cost=f"{near:.4f}")
    assert (found.mark, found.tolerance) == ("within", LIMIT)
    assert entry(point, "cost", cost=f"{limit - 0.01:.4f}").mark == "unexplained"
    assert entry(point, "cost", cost=f"{limit + 0.01:.4f}").mark == "unexplained"
    # where the optimum is inside the region there is no limit to speak of
    assert entry(printed("energy_step_w0", "C.3"), "cost", cost="8.220").mark == "unexplained"


@pytest.mark.slow
class TestErrata:
    """What the file states about each erratum is so, by a second method where there is one."""

    @pytest.mark.parametrize(
        "point",
        [p for p in published_points() if p.erratum and p.criterion == "alpha_max"],
        ids=lambda p: f"{p.table}-{p.gamma}-{p.delta}",
    )
    def test_flat_maximum_of_alpha(self, point: PublishedPoint) -> None:
        assert "less than 4e-8" in (point.erratum or "")
        values = {e.name: e for e in recompute(point).entries}
        assert values["beta"].mark == "erratum"
        place = (values["alpha"].computed - 4e-8, point.printed()["beta"].value)
        polynomial = independent.characteristic(point.gamma, point.delta, point.delay, *place)
        assert independent.stable_by_schur_cohn(polynomial)

    def test_printed_point_overshoots(self) -> None:
        point = printed("overshoot", "C.3", delta=0.02)
        motion = independent.simulate(0.046, 0.32, delay=(2, 1), samples=400, delta=0.02)
        assert independent.deviation(motion, 0.046).max() == pytest.approx(0.18, abs=0.005)
        assert {e.mark for e in recompute(point).entries if e.name != "cost"} == {"erratum"}

    def test_printed_point_is_on_the_edge_of_the_region(self) -> None:
        polynomial = np.array(independent.characteristic(0.0, 0.02, 2, 0.0, -0.02), dtype=float)
        assert abs(np.polyval(polynomial, 1.0)) < 1e-15
        assert abs(np.polyval(np.polyder(polynomial), 1.0)) < 1e-15
        assert entry(printed("damping", "C.3", delta=0.02), "beta").mark == "erratum"

    def test_no_stable_point_is_as_good_as_the_printed_cost(self) -> None:
        point = printed("energy_step_w2", "C.2", delta=0.02)
        assert entry(point, "cost").mark == "erratum"
        motion = independent.simulate(0.0625, 0.3786, delay=(1, 1), samples=400, delta=0.02)
        assert independent.continuous_energy(motion, 0.0625, 1.0, 2, "step") == pytest.approx(79.4695, abs=2e-3)
        loop, rng = NormalisedLoop.ideal(0.0, 0.02, 1.0), np.random.default_rng(5)
        border = boundary(loop)
        alpha = np.concatenate([rng.uniform(0, border.alpha_max, 4000), rng.normal(0.0625, 0.003, 1000)])
        beta = np.concatenate([rng.uniform(-0.02, border.beta_max, 4000), rng.normal(0.3785, 0.01, 1000)])
        cost = where_stable(loop, lambda a, b, _: energy_costs(loop, a, b)["energy_step_w2"])(alpha, beta, np.inf)
        assert np.isfinite(cost).sum() > 2000
        assert cost.min() > 79.46

    def test_one_digit_of_the_impulse_cost(self) -> None:
        found = entry(printed("energy_impulse_w0", "C.3", gamma=0.001), "cost")
        assert (found.printed, found.mark) == ("6.397", "erratum")
        assert f"{found.computed:.3f}" == "6.387"
        beside = independent.simulate(
            5e-5 - 0.001, 0.2926, gamma=0.001, delay=(2, 1), samples=40000, signal="impulse", fine=4
        )
        # by then the response has decayed to exp(-6), its square and so the rest of the sum to 1 in 1e5
        assert independent.continuous_energy(beside, 5e-5, 1.0, 0, "impulse") < 6.3965


@pytest.mark.slow
def test_every_row_has_a_mark_and_none_is_unexplained() -> None:
    rows: list[TheoryRow] = []
    for name, size, of_table in module.recomputed_tables():
        found = list(of_table)
        assert len(found) == size, name
        rows += found
    points = published_points()
    keys = [(r.table, r.criterion, r.delay, r.gamma, r.delta) for r in rows]
    assert sorted(keys) == sorted((p.table, p.criterion, p.delay, p.gamma, p.delta) for p in points)
    assert sum(len(row.entries) for row in rows) == sum(len(p.printed()) for p in points) == 813
    unexplained = [(row, e) for row in rows for e in row.entries if e.mark == "unexplained"]
    assert unexplained == []
    # each reason that the file keeps is needed, and nothing else is an erratum
    errata = {(*key, e.name) for key, row in zip(keys, rows, strict=True) for e in row.entries if e.mark == "erratum"}
    assert errata == {(p.table, p.criterion, p.delay, p.gamma, p.delta, n) for p in points for n in p.erratum_of}
    assert count_marks(rows)["equal"] > 750


ROWS = (
    TheoryRow(
        *("C.9", "energy_impulse_w0", 1.0, 0.001, 0.02, False),
        (
            Entry("alpha", "-0.0010", -0.001, "equal"),
            Entry("beta", "0.4439", 0.44380, "within", FLAT, "the cost is the same"),
            Entry("cost", "4.007", 4.00615, "within", ROUNDING),
        ),
    ),
    TheoryRow(
        *("C.9", "damping", 1.0, 0.0, 0.0, True),
        (
            Entry("alpha", "0.1000", -1e-12, "erratum", None, "misprint"),
            Entry("beta", "0.1000", 0.0, "erratum", None, "misprint"),
            Entry("cost", "1.000", 0.9, "unexplained"),
        ),
    ),
)


def test_lines_show_computed_beside_printed_with_reasons_below() -> None:
    lines = table_lines("C.9", ROWS, table)
    assert lines[0] == "Table C.9: 1 equal, 2 within, 2 erratum, 1 unexplained"
    assert lines[2].split() == [
        *("energy_impulse_w0", "1", "0.001", "0.02", "-0.001000", "-0.0010"),
        *("0.443800", "~", "0.4439", "4.00615", "~", "4.007"),
    ]
    assert lines[3].split()[4:] == ["0.000000", "!", "0.1000", "0.000000", "!", "0.1000", "0.90000", "?", "1.000"]
    assert lines[4:] == [
        "  energy_impulse_w0, d = 1, gamma = 0.001, delta = 0.02: beta: flat optimum, the cost is the same",
        "  damping, d = 1, gamma = 0, delta = 0: alpha and beta: misprint",
        "  damping, d = 1, gamma = 0, delta = 0: cost: printed 1.000, computed 0.9",
        "",
    ]
    assert summary_line(ROWS).startswith("6 printed numbers: 1 equal, 2 within, 2 erratum, 1 unexplained.")


def test_command_prints_tables_and_summary(call):
    status, out, _ = call("theory", "tables", "B.2", "B.1")
    assert status == 0
    assert out.index("Table B.2: 78 equal") < out.index("Table B.1: 78 equal")
    assert out.count("alpha_max  ") == 26
    assert out.splitlines()[-1].startswith("156 printed numbers: 156 equal, 0 within, 0 erratum, 0 unexplained.")


def test_command_prints_one_json_document_and_nothing_else(call):
    status, out, err = call("theory", "tables", "B.3", "--json")
    assert (status, err) == (0, "")
    assert json.loads(out)["count"] == {"equal": 77, "within": 1, "erratum": 0, "unexplained": 0}


def test_command_refuses_an_unknown_table(call):
    status, out, err = call("theory", "tables", "D.9")
    assert (status, out) == (1, "")
    assert "B.1" in err
    assert "D.6" in err
