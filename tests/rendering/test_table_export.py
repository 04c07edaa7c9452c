"""Tables as files: read back by other readers, hostile names, and the count of columns."""

from __future__ import annotations

import csv
import io
import json
import re

import pytest
from report_data import HOSTILE, report_data

from pipeline.base.errors import UsageError
from pipeline.rendering.report.report import PRINTED, tables_of
from pipeline.rendering.table import Cell, Column, Table, words
from pipeline.rendering.table_export import (
    FORMATS,
    csv_text,
    export_tables,
    guarded,
    markdown_text,
    parse_formats,
    tables_folder,
)
from pipeline.rendering.table_latex import latex_text
from pipeline.rendering.table_values import value_tables


def printed_tables(result):
    return [table for name in PRINTED for table in tables_of(name, result)]


FORMULAS = ('=HYPERLINK("http://x")', "+1+cmd|' /C calc'!A0", "-2+3", "@SUM(1)", "\tx", "\r=1")


@pytest.fixture(scope="module")
def result():
    return report_data(full=False).result


@pytest.fixture(scope="module")
def written(result, tmp_path_factory):
    folder = tmp_path_factory.mktemp("export")
    export_tables(result, folder, FORMATS)
    return folder


def test_csv_read_back_by_pythons_csv_has_the_values_and_units(result, written):
    with (written / "D.1.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    expected = [row for row in result.tables if row.table == "D.1"]
    assert len(rows) == len(expected) == 8
    for found, row in zip(rows, expected, strict=True):
        assert found["criterion"] == row.criterion
        assert found["condition"] == row.condition
        assert float(found["stiffness [N/m]"]) == row.stiffness
        assert float(found["damping [Ns/m]"]) == row.damping
        assert float(found["cost"]) == row.cost
        assert found["deviation_percent [%]"] == ("" if row.deviation_percent is None else repr(row.deviation_percent))
        assert found["censored"] == str(row.censored).lower()
        assert found["cost_unit"] == ("samples" if row.criterion.startswith("settle") else "1")


def test_every_boundary_point_and_estimate_is_exported(result, written):
    with (written / "boundary.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    points = [(e.experiment, p) for e in result.experiments for p in e.boundary]
    assert len(rows) == len(points) > 100
    for row, (experiment, point) in zip(rows, points, strict=True):
        assert row["experiment"] == experiment
        stable = row["stable [N/m]"]
        assert (float(stable) if stable else None) == point.stable
    with (written / "estimates.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    by_use = {(r["experiment"], r["quantity"], r["use"]): r for r in rows}
    assert float(by_use["1", "mass", "recommended"]["value"]) == 0.58
    assert by_use["1", "mass", "momentum balance"]["trials"] == "212"
    assert by_use["1", "damping", "recommended"]["value"] == ""
    assert by_use["1", "damping", "recommended"]["reason"].startswith("no logs with K = 0")


def test_scores_are_exported_with_all_digits(falcon_outcome, tmp_path):
    result = falcon_outcome.result
    export_tables(result, tmp_path, ("csv",))
    with (tmp_path / "scores.csv").open(encoding="utf-8", newline="") as stream:
        rows = {(r["experiment"], r["theory"], r["score"]): r["value"] for r in csv.DictReader(stream)}
    scores = result.experiments[0].scores[0]
    assert scores.region is not None
    assert float(rows["1", scores.basis, "region.overlap"]) == scores.region.overlap
    best = scores.optima[0]
    assert float(rows["1", scores.basis, f"optima.{best.criterion}.cost_percent"]) == best.cost_percent
    assert len(rows) == sum(1 for t in value_tables(result) if t.name == "scores" for _ in t.rows)


def test_json_has_the_same_rows_with_units(result, written):
    document = json.loads((written / "tables.json").read_text(encoding="utf-8"))
    tables = {t.name: t for t in value_tables(result)}
    assert set(document) == set(tables)
    for name, table in tables.items():
        assert [c["name"] for c in document[name]["columns"]] == [column.name for column in table.columns]
        values = [tuple(cell.value for cell in row) for row in table.rows]
        assert [tuple(row.values()) for row in document[name]["rows"]] == values
    units = {c["name"]: c["unit"] for c in document["D.1"]["columns"]}
    assert (units["stiffness"], units["damping"], units["criterion"]) == ("N/m", "Ns/m", "")


@pytest.mark.parametrize("text", FORMULAS)
def test_formulas_of_a_spreadsheet_are_disarmed_and_numbers_are_not(text):
    table = Table("x", "", (Column("a"), Column("b", unit="N")))
    table.add("1", {"a": text, "b": -2.5})
    table.add("2", {"a": "-7.5e3"})
    rows = list(csv.reader(io.StringIO(csv_text(table), newline="")))
    assert rows[0] == ["a", "b [N]"]
    assert rows[1] == [f"'{text}", "-2.5"]
    assert rows[2] == ["-7.5e3", ""]


def test_words_that_begin_harmlessly_stay_as_they_are():
    assert [guarded(t) for t in ("", "a=1", "5", "1-2", "–")] == ["", "a=1", "5", "1-2", "–"]


def unescaped(line: str, character: str) -> int:
    return len(re.findall(rf"(?<!\\)(?:\\\\)*{re.escape(character)}", line))


@pytest.mark.parametrize("hostile", [False, True])
def test_markdown_rows_have_as_many_cells_as_heads(hostile):
    for table in printed_tables(report_data(full=False, hostile=hostile).result):
        lines = [line for line in markdown_text(table).splitlines() if line.startswith("|")]
        assert len(lines) == 2 + sum(len(rows) + bool(name) for name, rows in table.blocks)
        assert {unescaped(line, "|") for line in lines} == {len(table.columns) + 1}
        assert "<script>" not in "\n".join(lines)


@pytest.mark.parametrize("hostile", [False, True])
def test_latex_rows_have_as_many_columns_as_the_table(hostile):
    for table in printed_tables(report_data(full=False, hostile=hostile).result):
        text = latex_text(table)
        columns = re.search(r"\\begin\{(?:longtable|tabular)\}\{@\{\}(.+)@\{\}\}", text)
        assert columns is not None
        kinds = re.sub(r">\{[^{}]*\}p\{\d+pt\}", "p", columns[1])
        assert re.fullmatch("[lrp]+", kinds)
        assert len(kinds) == len(table.columns)
        long = "longtable}{" in text
        body = text[text.index(r"\endfoot" if long else r"\midrule") : text.rindex(r"\bottomrule")]
        body = body if not long else text[text.index(r"\endfoot") : text.index(r"\end{longtable}")]
        for line in body.splitlines()[1:]:
            if line == r"\addlinespace":
                continue
            assert line.endswith(r" \\")
            spans = sum(int(n) for n in re.findall(r"\\multicolumn\{(\d+)\}", line))
            singles = unescaped(line, "&") + 1 - len(re.findall(r"\\multicolumn", line))
            assert spans + singles == len(table.columns)
        for group, span in table.groups:
            assert rf"\multicolumn{{{span}}}{{c}}{{" in text, group
        assert text.count("{") - text.count(r"\{") == text.count("}") - text.count(r"\}")


def test_latex_specials_are_escaped_each_in_its_own_way():
    table = Table("t", "50 % of $x_1$ & more", (Column("a", "a_b"), words("b", "#")))
    table.add("r", {"a": Cell(-1.5, "−1.5", marks=table.mark("note {1}")), "b": r"\input{x}^~"})
    text = latex_text(table)
    assert r"\caption{50 \% of \$x\_1\$ \& more}\label{tab:t}" in text
    assert r"a\_b & \# \\" in text
    assert r"$-$1.5\textsuperscript{a} & \textbackslash{}input\{x\}\textasciicircum{}\textasciitilde{} \\" in text
    assert r"\textsuperscript{a}note \{1\}" in text


def test_no_row_of_latex_begins_with_what_a_line_end_would_take():
    table = Table("t", "x", (words("a"),))
    for row, name in enumerate(("*x", "[1pt]", "* y")):
        table.add(str(row), {"a": name})
    body = latex_text(table).split(r"\midrule")[1].splitlines()[1:4]
    assert body == [r"{*}x \\", r"{[}1pt{]} \\", r"{*} y \\"]


def test_latex_says_whether_it_fits_one_column_and_wraps_words_so_that_it_does():
    narrow = Table("t", "x", (words("name"), Column("a"), Column("b")))
    narrow.add("r", {"name": "short", "a": 1.5, "b": 2})
    assert "one column" in latex_text(narrow).splitlines()[0]
    assert r"\begin{table}[t]" in latex_text(narrow)
    wrapped = Table("t", "x", (words("name"), Column("a"), words("reason")))
    wrapped.add("r", {"name": "short", "a": 1.5, "reason": "many words " * 12})
    text = latex_text(wrapped)
    assert "one column" in text.splitlines()[0]
    assert "p{" in text
    numbers = Table("t", "x", [Column(f"quantity {n}") for n in range(5)])
    numbers.add("r", {f"quantity {n}": Cell(n, str(n), aside="from 0.1 to 0.2 and 4") for n in range(5)})
    assert "two columns" in latex_text(numbers).splitlines()[0]
    assert r"\begin{table*}[t]" in latex_text(numbers)
    assert r"\begin{tabular}[t]{@{}r@{}}3 \\ (from 0.1 to 0.2 and \\ 4)\end{tabular}" in latex_text(numbers)
    long = Table("t", "x", (Column("a"),))
    for n in range(60):
        long.add(str(n), {"a": n})
    assert r"\begin{longtable}" in latex_text(long)


def test_hostile_names_become_file_names_and_the_files_can_be_read(tmp_path):
    result = report_data(full=False, hostile=True).result
    names = ["../../up", ".hidden", "=1+1", HOSTILE, "x" * 300]
    rows = tuple(result.tables[0].model_copy(update={"table": name}) for name in names)
    written = export_tables(result.model_copy(update={"tables": rows}), tmp_path / "out", ("csv", "markdown", "latex"))
    assert {p.parent for p in written} == {tmp_path / "out"}
    assert all(p.is_file() and not p.name.startswith(".") for p in written)
    assert sorted(tmp_path.iterdir()) == [tmp_path / "out"]


def test_formats_are_told_where_one_is_not_known():
    assert parse_formats(["latex,csv", "csv"]) == ("csv", "latex")
    with pytest.raises(UsageError, match="'xlsx'; expected some of csv, json, markdown, latex"):
        parse_formats(["csv,xlsx"])


def test_folder_lies_beside_the_report(tmp_path):
    assert tables_folder(tmp_path / "falcon.html") == tmp_path / "falcon-tables"
