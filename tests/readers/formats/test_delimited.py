"""Delimited text: the frame holds what stands in the file, by line; what cannot be read is refused with its line."""

import csv
import io

import numpy as np
import pytest

from pipeline.base.errors import LogError
from pipeline.profiles.profile_model import Profile
from pipeline.readers.isolation import read_file

POSITIONS = {"time": (1, "ms"), "position": (2, "mm"), "command": (3, "N")}
CONDITIONS = {"device": "bench", "experiment": "1", "stiffness": 1, "damping": 1, "step": 1, "sampling_period_s": 0.001}


def profile(header=True, names=("t", "x", "F"), **layout) -> Profile:
    columns = {
        key: {"unit": unit}
        | ({} if key == "time" else {"sign": 1})
        | ({"name": name} if header else {"column": column})
        for (key, (column, unit)), name in zip(POSITIONS.items(), names, strict=True)
    }
    values = {"name": "lab", "format": "delimited", "files": ["*"], "columns": columns, "constants": CONDITIONS}
    values |= {"decimal": ".", "step_at": "command edge"}
    return Profile.model_validate(values | {"header": header} | layout)


def read(data, wanted=("t", "x", "F"), **layout):
    text = data if isinstance(data, bytes) else data.encode()
    return read_frame(profile(**layout), "run.txt", text, wanted)


def read_frame(profile, name, data, wanted):
    return read_file(profile, (name,), (data,), wanted).frame()


def values(frame) -> dict[str, list]:
    return {name: column.tolist() for name, column in frame.columns.items()}


EXPECTED = {"t": [0, 1, 2], "x": [0.5, -1.25, 3e-3], "F": [0.0, 8.0, 8.5]}
PLAIN = "t,x,F\n0,0.5,0\n1,-1.25,8\n2,3e-3,8.5\n"


@pytest.mark.parametrize(
    ("text", "layout"),
    [
        (PLAIN, {}),
        (PLAIN.replace(",", "\t"), {"delimiter": "\t"}),
        (PLAIN.replace(",", ";").replace(".", ","), {"delimiter": ";", "decimal": ","}),
        (PLAIN.replace(",", "  \t "), {"delimiter": "blanks"}),
        ("\n".join("   " + line + "  " for line in PLAIN.replace(",", " ").split("\n")), {"delimiter": "blanks"}),
        (PLAIN.replace(",", " , "), {}),
        (PLAIN.replace("\n", ",\n"), {"trailing_delimiter": True}),
        (PLAIN.replace("\n", ",\n"), {}),  # one more column without a name
        ("t,x,F\n" + PLAIN[6:].replace("\n", ",\n"), {"trailing_delimiter": True}),
        (PLAIN.replace("\n", "\r\n"), {}),
        (PLAIN.replace("\n", "\r"), {}),
        (PLAIN + "\n \t\n\n", {}),
        (PLAIN.replace("\n", "\n\n"), {"blank_lines": "skip"}),
        ("# by lab\n" + PLAIN.replace("1,-", "  # paused, 1, 2\n1,-"), {"comment": "#"}),
        ("lab\n\x1b[0m banner\n" + PLAIN, {"skip_rows": 2}),
        ("lab\nxyz,F\n" + PLAIN, {"header_at": "^t,"}),
        (PLAIN.replace("F\n", "F\nms,µm,N\n"), {"unit_line": True}),
        (PLAIN.replace("8.5", "+8.5").replace("0.5", ".5").replace("8\n", "8.\n"), {}),
        ('"t","x","F"\n"0","0.5","0"\n"1","-1.25","8"\n"2","3e-3","8.5"\n', {}),
        (PLAIN.replace(",", "|"), {"delimiter": "|"}),
        (PLAIN.replace("t,", "note,t,").replace("\n0", "\n,0").replace("\n1", "\nä,1").replace("\n2", "\nb,2"), {}),
    ],
)
def test_layouts_hold_the_same_values(text, layout):
    frame = read(text, **layout)
    assert values(frame) == EXPECTED
    assert frame.columns["t"].dtype == np.int64
    assert frame.columns["F"].dtype == np.float64
    lines = [line.strip() for line in text.replace("\r\n", "\n").replace("\r", "\n").split("\n")]
    first = [next(i for i, line in enumerate(lines, 1) if "-1.25" in line.replace("-1,25", "-1.25")), frame.row[1]]
    assert first[0] == first[1], "rows are lines of the file"
    assert (frame.row_name, frame.warnings, len(frame)) == ("line", (), 3)


@pytest.mark.parametrize(
    ("encoding", "layout"),
    [
        ("utf-8", {}),
        ("utf-8-sig", {}),
        ("utf-16", {}),
        ("utf-16-le", {"encoding": "utf-16"}),
        ("latin-1", {"encoding": "latin-1"}),
        ("cp1252", {"encoding": "cp1252"}),
    ],
)
def test_encodings_hold_the_same_names_and_values(encoding, layout):
    text = PLAIN.replace("t,x", "Zeit [ms],Weg [µm] größer")
    frame = read(text.encode(encoding), ("Weg [µm] größer", "F"), names=("Zeit [ms]", "Weg [µm] größer", "F"), **layout)
    assert values(frame) == {"Weg [µm] größer": EXPECTED["x"], "F": EXPECTED["F"]}


def test_columns_without_names_are_taken_by_position():
    frame = read("7\t1.5 \t-3\n8\t2.5\t-4\n", ("1", "3"), header=False, delimiter="blanks")
    assert values(frame) == {"1": [7, 8], "3": [-3, -4]}
    assert frame.row.tolist() == [1, 2]
    with pytest.raises(LogError, match=r"wants column '3' for columns\.command once, but it occurs 0 times") as error:
        read("7 1\n8 2\n", ("1", "3"), header=False, delimiter="blanks")
    assert error.value.row == 1


def test_a_column_of_a_table_with_names_may_be_taken_by_position():
    two = profile().model_copy()
    columns = two.columns.model_copy(
        update={"command": two.columns.command.model_copy(update={"name": None, "column": 3})}
    )
    frame = read_frame(two.model_copy(update={"columns": columns}), "a", b"t,x,x\n0,1,2\n1,2,3\n", ("t", "3"))
    assert values(frame) == {"t": [0, 1], "3": [2, 3]}


def test_a_blank_last_cell_of_a_sparse_column_is_no_cut():
    frame = read("t,x,F\n0,1,\n1,2,3\n2,3,")
    np.testing.assert_array_equal(frame.columns["F"], [np.nan, 3, np.nan])


@pytest.mark.parametrize("tail", ["2,3", "2,3\n", "2", "2,3,", "2,3,8.", "2,3,-", "2,3,8.5e"])
def test_a_cut_last_row_is_left_out_and_kept_verbatim(tail):
    text = PLAIN[: PLAIN.index("2,3e-3")] + tail
    frame = read(text)
    if tail == "2,3,8.":  # is legal: nobody can know, so it is said
        assert frame.warnings == ("the last line (4) has no line end: its last value may be incomplete",)
        assert len(frame) == 3
        return
    assert values(frame) == {key: column[:2] for key, column in EXPECTED.items()}
    assert frame.row.tolist() == [2, 3]
    assert frame.attributes == {"cut_last_row": tail.rstrip("\n")}
    assert frame.warnings == (f"the last row (line 4) is incomplete and was omitted: {tail.rstrip()!r}",)


@pytest.mark.parametrize(("encoding", "cut"), [("utf-8", 1), ("utf-16", 1), ("utf-16", 3)])
def test_a_file_cut_inside_a_character_loses_its_last_row_only(encoding, cut):
    data = (PLAIN.replace("F\n", "F,note\n").replace("0\n", "0,a\n").replace("8\n", "8,b\n") + "3,1,Ω").encode(encoding)
    frame = read(
        data.replace("8.5\n".encode(encoding)[-8:], "8.5,ä\n".encode(encoding)[-10:])[:-cut], encoding=encoding
    )
    assert frame.columns["t"].tolist() == [0, 1, 2]
    assert frame.attributes["cut_last_row"].startswith("3,1")


def test_missing_cells_are_nan_and_text_stays_text():
    text = "t,x,F,who\n0,,1,a\n1,NaN,---,\n2,4,3,b c\n"
    frame = read(text, ("t", "x", "F", "who"), missing=("---",))
    np.testing.assert_array_equal(frame.columns["x"], [np.nan, np.nan, 4])
    np.testing.assert_array_equal(frame.columns["F"], [1, np.nan, 3])
    assert frame.columns["who"].tolist() == ["a", "", "b c"]


def test_counters_of_64_bits_keep_their_integers():
    stamps = [1700000000123456789, 1700000000124456789]
    frame = read("t,x,F\n" + "".join(f"{stamp},0x10,+7\n" for stamp in stamps))
    assert frame.columns["t"].tolist() == stamps
    assert frame.columns["x"].tolist() == ["0x10", "0x10"], "a hexadecimal number is text: nobody said that it is one"
    assert frame.columns["F"].tolist() == [7, 7]


@pytest.mark.parametrize(
    ("data", "layout", "row", "words"),
    [
        (b"", {}, 1, "is empty"),
        (b"\n \n", {}, 1, "is empty"),
        (b"a\nb\n", {"skip_rows": 5}, 1, "empty below skip_rows = 5"),
        (b"a\nb\n", {"header_at": "^start"}, 1, "header_at = '\\^start'"),
        (b"t,x,F\n", {}, 2, "0 samples"),
        (
            PLAIN.encode(),
            {"delimiter": ";"},
            1,
            "in 1 columns: \\['t,x,F'\\]. Correct the delimiter \\(';'\\)",
        ),
        (b"t,x,F,F\n0,1,2,3\n", {}, 1, "'F' for columns.command once, but it occurs 2 times"),
        (b"t,x,F\n0,1,2\n1,2\n2,3,4\n", {}, 3, "expected 3 values, found 2"),
        (b"t,x,F\n0,1,2\n1,2,3,\n2,3,4\n", {}, 3, "found 4.*trailing_delimiter = true"),
        (b"t,x,F\n0,5,1,5,2,5\n0,5,1,5,2,5\n", {}, 2, 'found 6.*decimal = ","'),
        (b"t,x,F\n0,1,2\n\n1,2,3\n", {}, 3, 'blank line.*blank_lines = "skip"'),
        ("t,x,F\n0,1,2\n1,2,µ\n2,3,4\n".encode("latin-1"), {}, 3, 'not UTF-8 text.*0xb5.*encoding = "latin-1"'),
    ],
)
def test_what_cannot_be_read_is_refused_with_its_line(data, layout, row, words):
    with pytest.raises(LogError, match=words) as error:
        read(data, **layout)
    assert error.value.row == row


def test_any_table_of_the_csv_module_is_read_back():
    rng = np.random.default_rng(5)
    for delimiter in ",;\t|":
        table = rng.normal(size=(50, 3)) * 10.0 ** rng.integers(-9, 9, size=(50, 3))
        stream = io.StringIO()
        writer = csv.writer(
            stream, delimiter=delimiter, quoting=csv.QUOTE_ALL if delimiter in ",|" else csv.QUOTE_MINIMAL
        )
        writer.writerow(["t", "x", "F"])
        writer.writerows(table.tolist())
        frame = read(stream.getvalue(), delimiter=delimiter)
        assert np.column_stack(list(frame.columns.values())).tolist() == table.tolist()
