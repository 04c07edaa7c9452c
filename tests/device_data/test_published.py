"""The published values that ship with the package are those of the printed tables."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
from places import SHARED

import pipeline.device_data.published
from pipeline.base.errors import StoreError
from pipeline.device_data.devices import load_device
from pipeline.device_data.published import find, published_rows

TABLES = SHARED / "reference" / "tables"
needs_tables = pytest.mark.skipif(not TABLES.is_dir(), reason="published tables (../shared) are not here")


@needs_tables
def test_every_row_of_d1_to_d5_is_there() -> None:
    with (TABLES / "D_experiments.csv").open() as stream:
        rows = list(csv.DictReader(stream))
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
    with (TABLES / "D_6_delay.csv").open() as stream:
        rows = list(csv.DictReader(stream))
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


def test_errata_are_marked_and_nothing_else() -> None:
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


def test_a_damaged_or_missing_file_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline.device_data.published, "schema_folder", lambda: tmp_path)
    pipeline.device_data.published.published_rows.cache_clear()
    try:
        with pytest.raises(StoreError, match=r"hulin-2017\.csv"):
            published_rows()
        folder = tmp_path / "published"
        folder.mkdir()
        (folder / "hulin-2017.csv").write_text("table,device,criterion,condition,cost\nD.1,falcon,overshoot,x,many\n")
        with pytest.raises(StoreError, match=r"(?s)data row 1.*cost"):
            published_rows()
    finally:
        pipeline.device_data.published.published_rows.cache_clear()
