"""The table model: rows become cells with text, interval, reason and marks; groups and notes are counted."""

from __future__ import annotations

import numpy as np
import pandas as pd

from pipeline.rendering.table import Column, Table, footnote, table_of, word_table
from pipeline.rendering.table_export import latex_text, markdown_text

COLUMNS = (
    Column("name"),
    Column("low", unit="N/m", group="limit", show=lambda v, _: f"{v:.1f}", why="not tested", linked=True),
    Column("value", "upper", group="limit", show=lambda v, _: f"{v:.0f}", ends=("a", "b"), notes=lambda r: [r["note"]]),
    Column("never", show=lambda v, _: str(v), optional=True),
)


def test_rows_become_cells_with_interval_marks_trial_or_the_reason() -> None:
    frame = pd.DataFrame(
        {"name": ["A", "B"], "low": [2.25, np.nan], "value": [5.4, np.nan], "a": [4.6, np.nan], "b": [6.2, np.nan]}
    ).assign(note=["said", None], reason=[None, "no log"], never=np.nan)
    table = table_of("t", "c", COLUMNS, frame, lambda r: r["name"], lambda r: f"block {r['name']}", lambda _: "0-7")
    assert [column.name for column in table.columns] == ["name", "low", "value"], "nothing to show in the last one"
    (first, [(row, cells)]), (_, [(_, others)]) = table.blocks
    assert (first, row) == ("block A", "t/A")
    assert [cell.text for cell in cells] == ["A", "2.2", "5"]
    assert (cells[2].aside, cells[2].marks, table.notes) == ("5 to 6", ("a",), ["said"])
    assert [cell.trial for cell in cells] == ["", "0-7", ""]
    assert [cell.numeric for cell in cells] == [False, True, True]
    assert [(cell.text, cell.why) for cell in others[1:]] == [("–", "not tested"), ("–", "no log")]
    assert table.whys == ["not tested", "no log"]
    assert [column.head for column in table.columns] == ["name", "low [N/m]", "upper"]
    assert table.groups == [("", 1), ("limit", 2)]


def test_equal_notes_share_a_mark_and_marks_go_on_after_z() -> None:
    table = Table("t", "c", COLUMNS)
    assert table.mark("first", None, "second", "first", "") == ("a", "b", "a")
    assert table.mark("second") == ("b",)
    assert table.notes == ["first", "second"]
    assert [footnote(n) for n in (0, 25, 26, 52)] == ["a", "z", "a1", "a2"]


def test_a_table_without_rows_is_none() -> None:
    assert table_of("t", "c", COLUMNS, [], str) is None
    assert word_table("t", "c", ("a", "b"), []) is None
    found = word_table("t", "c", ("a", "b"), [("1", "x")])
    assert [cell.text for cell in found.rows[0]] == ["1", "x"]


def test_a_note_on_the_whole_table_has_no_mark() -> None:
    """A letter without a reference in a cell would send the reader on a search."""
    columns = [Column("name"), Column("value", show=lambda value, _: f"{value:g}", notes=lambda row: [row["note"]])]
    rows = [{"name": "a", "value": 5.0, "note": "of a cell"}, {"name": "b", "value": 6.0, "note": None}]
    table = table_of("t", "caption", columns, rows, lambda row: row["name"])
    table.mark("of the table")
    assert table.footnotes == [("a", "of a cell"), ("", "of the table")]
    assert markdown_text(table).endswith("a) of a cell  \nof the table\n")
    latex = latex_text(table, "t")
    assert r"\textsuperscript{a}of a cell" in latex
    assert r"\footnotesize of the table" in latex
