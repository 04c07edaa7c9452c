"""Answers of theory as files: rows equal the JSON document, pictures are drawn, and bad names are refused at once."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from pipeline.base.errors import ParameterError, UsageError
from pipeline.shell.cli import application

POINTS = "alpha,beta,gamma,delta,delay\n0.01,0.1,0,0,2\n9,9,0,0,2\n"


@pytest.fixture
def asked(tmp_path, monkeypatch):
    """What a command of theory prints, in a folder with a file of points."""
    monkeypatch.chdir(tmp_path)
    Path("points.csv").write_text(POINTS)

    def run(words):
        return CliRunner().invoke(application(), ["theory", *words.split()], catch_exceptions=False).output

    return run


def cells(path):
    with open(path, encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


COMMANDS = ["boundary --delay 2", "optimum --criterion settle_2pct_discrete --delay 1", "points points.csv"]


@pytest.mark.parametrize("command", COMMANDS)
def test_a_csv_file_and_parquet_have_the_same_numbers(asked, command):
    asked(f"{command} --out rows.csv")
    asked(f"{command} --out rows.parquet")
    table = pq.read_table("rows.parquet")
    rows = cells("rows.csv")
    assert list(rows[0]) == table.column_names
    for row, stored in zip(rows, table.to_pylist(), strict=True):
        assert row == {name: "" if value is None else str(value) for name, value in stored.items()}


@pytest.mark.parametrize(("command", "names"), [(COMMANDS[0], ("alpha", "beta")), (COMMANDS[1], ("alpha", "cost"))])
def test_rows_are_those_of_the_document(asked, command, names):
    document = json.loads(asked(f"{command} --json --out rows.csv"))
    for name in names:
        values = document[name] if isinstance(document[name], list) else [document[name]]
        assert [float(row[name]) for row in cells("rows.csv")] == [v for v in values if v is not None]


def test_rows_of_points_have_empty_cells_and_a_reason_where_a_point_is_unstable(asked):
    asked("points points.csv --out rows.csv")
    stable, unstable = cells("rows.csv")
    assert (stable["stable"], stable["reason"]) == ("True", "")
    assert float(stable["settle_2pct"]) > 0
    assert (unstable["stable"], unstable["settle_2pct"], unstable["reason"]) == ("False", "", "unstable")


def test_parquet_names_units_of_the_device(asked):
    asked("boundary --device lwr --out rows.parquet")
    units = {field.name: field.metadata[b"unit"].decode() for field in pq.read_schema("rows.parquet")}
    assert units == {"stiffness": "Nm/rad", "damping": "Nms/rad", "region": "1"}


def test_separate_regions_have_numbers(asked):
    asked("boundary --delay 0 --gamma 9 --delta 0 --out rows.csv")
    document = json.loads(asked("boundary --delay 0 --gamma 9 --delta 0 --json"))
    regions = {row["region"] for row in cells("rows.csv")}
    assert len(regions) == 1 + document["alpha"].count(None)


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(("ending", "start"), [("svg", b"<svg"), ("png", b"\x89PNG")])
def test_a_picture_is_drawn(asked, command, ending, start):
    assert f"walls.{ending}: picture" in asked(f"{command} --picture walls.{ending}")
    content = Path(f"walls.{ending}").read_bytes()
    assert content.startswith(start)
    assert ending == "png" or b"limit of stability" in content


@pytest.mark.parametrize("option", ["--out rows.txt", "--picture walls.gif", "--out ."])
def test_a_file_that_cannot_be_written_is_refused_before_anything_is_computed(asked, option):
    with pytest.raises(UsageError, match=option.split()[0]):
        asked(f"optimum --criterion speed --delay 1 {option}")


def test_points_of_several_loops_have_no_picture(asked):
    Path("points.csv").write_text(POINTS + "0.01,0.1,0,0,3\n")
    with pytest.raises(ParameterError, match="one loop, found 2"):
        asked("points points.csv --picture walls.svg")


def test_the_terminal_shows_a_short_table(asked):
    lines = asked("boundary --device falcon").splitlines()
    assert len(lines) < 20
    assert lines[1].split() == ["point", "stiffness", "damping"]
    assert lines[2].startswith("largest stiffness")
