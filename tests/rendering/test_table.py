"""The table model: plain values become cells, marks and groups are counted, records keep the values."""

from __future__ import annotations

from pipeline.rendering.table import Cell, Column, Table, footnote, missing, number, word_table, words

COLUMNS = (
    words("name"),
    Column("low", unit="N/m", group="limit", show="{:.1f}".format, why="not tested"),
    Column("high", "upper", group="limit", show="{:.1f}".format),
)


def test_plain_values_become_cells_and_what_is_not_given_has_its_reason() -> None:
    table = Table("t", "c", COLUMNS)
    table.add("a", {"name": "A", "low": 2.25, "high": Cell(3.0, "three", aside="x"), "other": 1})
    table.add("b", {"name": "B"}, "block")
    first, second = table.rows
    assert [cell.text for cell in first] == ["A", "2.2", "three"]
    assert [cell.name for cell in first] == ["t/a/name", "t/a/low", "t/a/high"]
    assert [cell.head for cell in first] == [True, False, False]
    assert [cell.numeric for cell in first] == [False, True, True]
    assert (second[1].text, second[1].why) == ("–", "not tested")
    assert [name for name, _ in table.blocks] == ["", "block"]
    assert table.records == [{"name": "A", "low": 2.25, "high": 3.0}, {"name": "B", "low": None, "high": None}]
    assert [column.head for column in COLUMNS] == ["name", "low [N/m]", "upper"]
    assert table.groups == [("", 1), ("limit", 2)]
    assert Table("t", "c", COLUMNS[:1]).groups == []


def test_a_number_stands_with_its_interval_or_its_reason() -> None:
    show = "{:.0f}".format
    assert number(5.4, show, ends=(4.6, 6.2)).aside == "5 to 6"
    assert number(5.4, show, ends=(4.6, None)).aside == ""
    assert number(5.4, show, ends=(4.6, 6.2), aside="own").aside == "own"
    assert number(None, show, "why not", trial="0-1") == missing("why not")
    assert number(0, show).text == "0", "zero is a value"


def test_equal_notes_share_a_mark_and_marks_go_on_after_z() -> None:
    table = Table("t", "c", COLUMNS)
    assert table.mark("first", None, "second", "first", "") == ("a", "b", "a")
    assert table.mark("second") == ("b",)
    assert table.notes == ["first", "second"]
    assert [footnote(n) for n in (0, 25, 26, 52)] == ["a", "z", "a1", "a2"]


def test_a_table_without_rows_is_none() -> None:
    assert Table("t", "c", COLUMNS).filled is None
    assert word_table("t", "c", ("a", "b"), []) is None
    found = word_table("t", "c", ("a", "b"), [("1", "x")])
    assert found is not None
    assert found.records == [{"a": "1", "b": "x"}]


def test_a_table_of_many_groups_is_shown_in_parts_that_hold_each_cell_once() -> None:
    columns = [Column("damping"), *(Column(f"{e}/{n}", n, group=f"experiment {e}") for e in range(7) for n in "abc")]
    table = Table("t", "All", columns)
    for row in range(5):
        tested = [e for e in range(7) if (row + e) % 4]
        table.add(str(row), {"damping": row} | {f"{e}/{n}": 10 * row + e for e in tested for n in "abc"})
    note = table.mark("said once")
    parts = table.parts
    assert [len(part.columns) for part in parts] == [10, 10, 4]
    assert [part.caption for part in parts] == ["All", "Part 2 of 3. All", "Part 3 of 3. All"]
    assert [part.notes for part in parts] == [[], [], ["said once"]]
    assert note == ("a",)
    names = [cell.name for part in parts for row in part.rows for cell in row if cell.name]
    assert len(names) == len(set(names))
    told = {cell.name for row in table.rows for cell in row if cell.value is not None}
    assert told <= set(names)
    # a row without a value in a part is not in it
    assert all(any(cell.value is not None for cell in row[1:]) for part in parts for row in part.rows)
    few = Table("u", "Few", columns[:7])
    assert few.parts == [few]
