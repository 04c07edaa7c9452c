"""Tables as files: all digits for programs, as printed for people, and nothing in a name that means something there."""

from __future__ import annotations

import csv
import io
import json
import re

import numpy as np
import pandas as pd
import pytest
from report_data import HOSTILE, report_data

from pipeline.rendering.frames import frames
from pipeline.rendering.report.report import printed_tables
from pipeline.rendering.table import Column, table_of
from pipeline.rendering.table_export import (
    csv_text,
    export_tables,
    guarded,
    latex_text,
    markdown_text,
    named_frames,
)


@pytest.fixture(scope="module")
def result():
    return report_data(full=False).result


@pytest.fixture(scope="module")
def written(result, tmp_path_factory):
    folder = tmp_path_factory.mktemp("tables")
    export_tables(result, folder)
    return folder


def rows_of(path):
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def test_every_row_of_the_tables_has_all_digits(result, written):
    rows = [row for name in ("D.1", "D.2", "D.6") for row in rows_of(written / f"{name}.csv")]
    assert len(rows) == len(result.tables) > 70
    for found, row in zip(rows, result.tables, strict=True):
        for name, value in (
            ("cost", row.cost),
            ("stiffness [N/m]", row.stiffness),
            ("deviation_percent [%]", row.deviation_percent),
        ):
            assert found[name] == ("" if value is None else repr(value))
        assert found["censored"] == str(row.censored).lower()


def test_every_boundary_point_and_estimate_is_exported(result, written):
    rows = rows_of(written / "boundary.csv")
    points = [(e.experiment, p) for e in result.experiments for p in e.boundary]
    assert len(rows) == len(points) > 100
    for row, (experiment, point) in zip(rows, points, strict=True):
        assert row["experiment"] == experiment
        assert (float(row["stable [N/m]"]) if row["stable [N/m]"] else None) == point.stable
    by_use = {(r["experiment"], r["quantity"], r["method"]): r for r in rows_of(written / "estimates.csv")}
    assert float(by_use["1", "mass", "corrected momentum"]["value"]) == 0.58
    assert by_use["1", "mass", "momentum balance"]["recommended"] == "false"
    assert by_use["1", "damping", "none"]["reason"].startswith("no logs with K = 0")


def test_json_has_the_rows_of_the_frames_with_units(result, written):
    document = json.loads((written / "tables.json").read_text(encoding="utf-8"))
    found = named_frames(result)
    assert list(document) == list(found)
    for name, frame in found.items():
        assert [c["name"] for c in document[name]["columns"]] == list(frame.columns)
        assert len(document[name]["rows"]) == len(frame)
    units = {c["name"]: c["unit"] for c in document["D.1"]["columns"]}
    assert (units["stiffness"], units["damping"], units["criterion"]) == ("N/m", "Ns/m", "")


def test_frames_have_the_same_columns_and_types_also_without_rows(falcon_outcome):
    result = falcon_outcome.result
    full, empty = frames(result), frames(result.model_copy(update={"experiments": (), "tables": ()}))
    for name in ("tables", "estimates", "boundary", "optima", "scores"):
        assert list(full[name].columns) == list(empty[name].columns)
        assert full[name].attrs["units"] == empty[name].attrs["units"]
    settling = full["optima"].query("criterion == 'settle_2pct'").iloc[0]
    assert settling["cost_s"] == pytest.approx(settling["cost"] * 1e-3)
    scores = full["scores"].set_index(["experiment", "score", "quantity"])
    region = result.experiments[0].scores[0].region
    assert scores.loc[("1", "region", "overlap"), ["value", "low", "high"]].tolist() == [
        region.overlap, region.overlap_low, region.overlap_high,
    ]  # fmt: skip


@pytest.mark.parametrize("text", ["=1+1", "+a", "-a", "@x", "\t=1", "\r1"])
def test_formulas_of_a_spreadsheet_are_disarmed_and_numbers_are_not(text):
    frame = pd.DataFrame({"a": [text, "-7.5e3"], "b": [-2.5, np.nan]})
    frame.attrs["units"] = {"b": "N"}
    rows = list(csv.reader(io.StringIO(csv_text(frame), newline="")))
    assert rows == [["a", "b [N]"], [f"'{text}", "-2.5"], ["-7.5e3", ""]]
    assert [guarded(t) for t in ("", "a=1", "5", "1-2", "–")] == ["", "a=1", "5", "1-2", "–"]


def unescaped(line: str, character: str) -> int:
    return len(re.findall(rf"(?<!\\)(?:\\\\)*{re.escape(character)}", line))


@pytest.mark.parametrize("hostile", [False, True])
def test_rows_of_markdown_and_latex_have_as_many_cells_as_heads(hostile):
    printed = printed_tables(report_data(full=False, hostile=hostile).result)
    for table in (table for of in printed.values() for table in of):
        lines = [line for line in markdown_text(table).splitlines() if line.startswith("|")]
        assert len(lines) == 2 + sum(len(rows) + bool(name) for name, rows in table.blocks)
        assert {unescaped(line, "|") for line in lines} == {len(table.columns) + 1}
        assert "<script>" not in "\n".join(lines)
        text = latex_text(table, table.name)
        assert re.search(r"\{@\{\}([lr]+)@\{\}\}", text)[1] == "".join("r" if c.show else "l" for c in table.columns)
        rows = [line for line in text.splitlines() if line.endswith(r" \\") and not line.startswith("\\")]
        assert {unescaped(line, "&") + 1 for line in rows} == {len(table.columns)}
        assert text.count("{") - text.count(r"\{") == text.count("}") - text.count(r"\}")


def test_latex_specials_are_escaped_each_in_its_own_way():
    columns = (Column("a", "a_b", show=lambda _, row: row["text"], notes=lambda _: ["note {1}"]), Column("b", "#"))
    rows = [{"a": -1.5, "text": "−1.5", "b": r"\input{x}^~"}, {"a": 1, "text": "*x", "b": "[1pt]"}]
    text = latex_text(table_of("t", "50 % of $x_1$ & more", columns, rows, lambda row: str(row["a"])), "t")
    assert r"\caption{50 \% of \$x\_1\$ \& more}" in text
    assert r"\label{tab:t}" in text
    assert r"a\_b & \# \\" in text
    assert r"$-$1.5\textsuperscript{a} & \textbackslash{}input\{x\}\textasciicircum{}\textasciitilde{} \\" in text
    assert r"{*}x\textsuperscript{a} & {[}1pt{]} \\" in text
    assert r"\textsuperscript{a}note \{1\}" in text
    long = table_of("t", "x", columns[1:], [{"b": str(n)} for n in range(60)], lambda row: row["b"])
    assert r"\begin{longtable}" in latex_text(long, "t")


def test_hostile_names_become_file_names_and_the_files_can_be_read(tmp_path):
    result = report_data(full=False, hostile=True).result
    names = ["../../up", ".hidden", "=1+1", HOSTILE, "x" * 300]
    rows = tuple(result.tables[0].model_copy(update={"table": name}) for name in names)
    written = export_tables(result.model_copy(update={"tables": rows}), tmp_path / "out")
    assert {p.parent for p in written} == {tmp_path / "out"}
    assert all(p.is_file() and not p.name.startswith(".") for p in written)
    assert sorted(tmp_path.iterdir()) == [tmp_path / "out"]
