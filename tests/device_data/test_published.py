"""The published values that ship with the package are those of the printed tables."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
from places import SHARED
from pydantic import ValidationError

import pipeline.device_data.published as module
from pipeline.base.errors import ParameterError, StoreError
from pipeline.device_data.devices import load_device
from pipeline.device_data.published import (
    THEORY_TABLES,
    PrintedNumber,
    PublishedPoint,
    find,
    published_points,
    published_rows,
)
from pipeline.records.criteria import CRITERIA, with_discrete
from pipeline.theory.optimum import POINT_CRITERIA

TABLES = SHARED / "reference" / "tables"
needs_tables = pytest.mark.skipif(not TABLES.is_dir(), reason="published tables (../shared) are not here")


def read(name: str) -> list[dict[str, str]]:
    with (TABLES / name).open() as stream:
        return list(csv.DictReader(stream))


@needs_tables
def test_every_row_of_d1_to_d5_is_there() -> None:
    rows = read("D_experiments.csv")
    for row in rows:
        found = find(row["table"], row["criterion"], row["condition"])
        assert found is not None, row
        assert found.device == row["device"]
        assert (found.stiffness, found.damping, found.cost) == tuple(
            float(row[name]) for name in ("stiffness", "damping", "cost")
        )
    shipped = [r for r in published_rows() if r.table != "D.6"]
    assert len(shipped) == len(rows)


@needs_tables
def test_every_cell_of_d6_is_there() -> None:
    rows = read("D_6_delay.csv")
    short = {"settle": "settle_2pct", "e0": "energy_step_w0", "e1": "energy_step_w1", "e2": "energy_step_w2"}
    count = 0
    for row in rows:
        for name, criterion in short.items():
            theory = find("D.6", criterion, "theory_discrete", float(row["d"]))
            measured = find("D.6", criterion, "experiment", float(row["d"]))
            assert theory is not None
            assert measured is not None
            assert theory.cost == float(row[f"theory_{name}"])
            assert measured.cost == float(row[f"experiment_{name}"])
            assert theory.stiffness is None
            # the printed deviation holds the two together, up to the rounding of both costs, 0.05 of 11.5
            percent = 100 * (measured.cost / theory.cost - 1)
            assert percent == pytest.approx(float(row[f"deviation_{name}_percent"]), abs=0.9)
            count += 2
    assert count == sum(r.table == "D.6" for r in published_rows())


def test_some_printed_values() -> None:
    row = find("D.1", "settle_2pct", "theory_discrete")
    assert row is not None
    assert (row.stiffness, row.damping, row.cost) == (4469, 73.05, 24)
    assert (row.stiffness_low, row.stiffness_high, row.damping_low, row.damping_high) == (4464, 4474, 73.00, 73.11)
    row = find("D.6", "energy_step_w2", "experiment", 8)
    assert row is not None
    assert row.cost == 7583


def test_errata_of_rows_are_marked_and_nothing_else() -> None:
    marked = {(r.table, r.criterion, r.condition) for r in published_rows() if r.erratum}
    discrete = {(t, c, "theory_discrete") for t in ("D.1", "D.3", "D.4") for c in ("settle_2pct", "overshoot")}
    ridges = {(t, "overshoot", "theory_continuous") for t in ("D.1", "D.3", "D.4")}
    assert marked == discrete | ridges | {(t, "energy_step_w2", "theory_continuous") for t in ("D.2", "D.3", "D.5")}


def test_rows_belong_to_tables_and_experiments_of_the_shipped_devices() -> None:
    for name in ("falcon", "lwr"):
        device = load_device(name)
        tables = {table.name: table for table in device.tables}
        for row in (row for row in published_rows() if row.device == name):
            assert row.criterion in tables[row.table].criteria
            if row.condition.startswith("experiment_"):
                assert row.condition.removeprefix("experiment_") in tables[row.table].experiments


def shipped(*tables: str) -> dict[tuple[object, ...], PublishedPoint]:
    points = published_points(tables)
    found = {(p.table, p.criterion, p.delay, p.gamma, p.delta): p for p in points}
    assert len(found) == len(points), "no point stands twice"
    return found


@needs_tables
def test_every_row_of_b_is_there() -> None:
    rows, found = read("B_maximum_stable.csv"), shipped(*THEORY_TABLES[:4])
    assert len(rows) == 52
    assert len(found) == 2 * len(rows)
    for row in rows:
        place = (float(row["d"]), float(row["gamma"]), float(row["delta"]))
        stiff, damped = (found[(row["table"], name, *place)] for name in ("alpha_max", "beta_max"))
        first = row["alpha_max"], row["beta_at_alpha_max"], row["alpha_max_rel_percent"]
        second = row["alpha_at_beta_max"], row["beta_max"], row["beta_max_rel_percent"]
        for point, printed in ((stiff, first), (damped, second)):
            assert (point.alpha, point.beta, point.percent, point.cost, point.scaling) == (*printed, None, None)


@needs_tables
def test_every_row_of_c_is_there() -> None:
    rows, found = read("C_optimal_values.csv"), shipped("C.1", "C.2", "C.3")
    assert len(rows) == len(found) == 171
    for row in rows:
        point = found[row["table"], row["criterion"], float(row["d"]), float(row["gamma"]), float(row["delta"])]
        assert (point.alpha, point.beta, point.cost or "") == (row["alpha_opt"], row["beta_opt"], row["cost"])
        assert (point.percent, point.scaling) == (None, None)


@needs_tables
def test_every_factor_of_5_1_is_there() -> None:
    rows, found = read("5_1_cost_scaling.csv"), shipped("5.1(a)", "5.1(b)")
    assert len(rows) == len(found) == 15
    for row in rows:
        name = f"{row['criterion']}_w{row['w']}" if row["criterion"].startswith("energy") else row["criterion"]
        name += "_discrete" if row["signal"] == "discrete" else ""
        point = found[f"5.1({row['table'][-1]})", name, 8.0, 0.0, 0.0]
        assert list(point.printed()) == ["scaling"]
        assert point.scaling == row["scaling"]


def test_every_criterion_can_be_computed() -> None:
    known = {*POINT_CRITERIA, *with_discrete(CRITERIA)}
    assert {point.criterion for point in published_points()} - known == set()


def test_errata_of_points_are_marked_and_nothing_else() -> None:
    marked = {(p.table, p.criterion, p.gamma, p.delta): p.erratum_of for p in published_points() if p.erratum}
    corners = [(0.0, 0.0), (0.001, 0.0), (0.0, 0.02), (0.001, 0.02)]
    flat = [("C.1", corner) for corner in corners] + [("C.2", corner) for corner in corners[1:]]
    assert marked == {
        **{(table, "alpha_max", *corner): ("beta",) for table, corner in flat},
        ("C.2", "energy_step_w2", 0.0, 0.02): ("cost",),
        ("C.3", "damping", 0.0, 0.02): ("beta",),
        ("C.3", "overshoot", 0.0, 0.02): ("alpha", "beta"),
        ("C.3", "energy_impulse_w0", 0.001, 0.0): ("cost",),
    }


@pytest.mark.parametrize(
    ("text", "value", "digits", "unit"),
    [("0.68629", 0.68629, 5, 1e-5), ("100.00", 100, 2, 0.01), ("-0.0010", -0.001, 4, 1e-4), ("12", 12, 0, 1.0)],
)
def test_printed_digits_are_kept(text: str, value: float, digits: int, unit: float) -> None:
    number = PrintedNumber(text)
    assert (number.value, number.digits) == (value, digits)
    assert number.unit == pytest.approx(unit, rel=1e-15)


def test_an_erratum_belongs_to_a_printed_number_and_has_a_reason() -> None:
    given = {"table": "C.1", "criterion": "alpha_max", "delay": 0, "gamma": 0, "delta": 0, "alpha": "0.1"}
    assert PublishedPoint.model_validate({**given, "erratum_of": ("alpha",), "erratum": "why"}).erratum == "why"
    for wrong in (
        {"erratum_of": ("beta",), "erratum": "not printed"},
        {"erratum_of": ("alpha",)},
        {"erratum": "of what?"},
        {"alpha": "about 0.1"},
        {"alpha": "nan"},
    ):
        with pytest.raises(ValidationError):
            PublishedPoint.model_validate({**given, **wrong})


def test_an_unknown_table_is_refused_with_the_list() -> None:
    with pytest.raises(ParameterError, match=r"'D\.1'.*B\.1.*5\.1\(b\)"):
        published_points(["B.1", "D.1"])


THEORY = """# note
table,criterion,delay,gamma,delta,alpha,beta,cost,percent,scaling,erratum_of,erratum
B.1,alpha_max,0,0,0,0.7,0.8,,100,,,
B.1,beta_max,0,0,0,0,many,,100,,,
"""


@pytest.mark.parametrize(
    ("asked", "cached", "file", "text", "wrong"),
    [
        (published_rows, published_rows, "hulin-2017.csv",
         "table,device,criterion,condition,cost\nD.1,falcon,overshoot,x,many\n", r"(?s)data row 1.*cost"),
        (published_points, module._all_points, "hulin-2017-theory.csv", THEORY, r"(?s)data row 2.*beta"),
    ],
)  # fmt: skip
def test_a_damaged_or_missing_file_is_named(asked, cached, file, text, wrong, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(module, "schema_folder", lambda: tmp_path)
    cached.cache_clear()
    try:
        with pytest.raises(StoreError, match=file):
            asked()
        (tmp_path / "published").mkdir()
        (tmp_path / "published" / file).write_text(text)
        with pytest.raises(StoreError, match=wrong):
            asked()
    finally:
        cached.cache_clear()
