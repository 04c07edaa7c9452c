"""Parquet and Feather logs, written by pyarrow."""

from io import BytesIO

import numpy as np
import pyarrow as pa
import pytest
from foreign_files import START, arrow_log, arrow_table, list_columns, read_frame, samples
from pyarrow import parquet

from pipeline.base.errors import LogError

KINDS = ["parquet", "lz4", "zstd", "uncompressed"]


def frame(data, *wanted):
    return read_frame("parquet" if data[:4] == b"PAR1" else "feather", "log.parquet", data, wanted)


@pytest.mark.parametrize("kind", KINDS)
def test_every_value_comes_back(kind):
    time, position, counter = samples()
    rows = len(time)
    read = frame(arrow_log(kind))
    expected = {
        "t": time,
        "stamp": START + 1_000_000 * np.arange(rows),
        "n": counter,
        "gap": np.array([np.nan, *range(1, rows)]),
        "label": np.array(["a", "bb"] * (rows // 2)),
        **{f"q[{i}]": position[:, i] for i in range(3)},
        **{f"fixed[{i}]": position[:, i] for i in range(3)},
        "state.w": position[:, 0],
        "state.on": np.ones(rows, dtype=int),
    }
    assert set(read.columns) == set(expected)
    for key, values in expected.items():
        np.testing.assert_array_equal(read.columns[key], values, err_msg=key)
    assert read.columns["n"].dtype.kind == "u"
    assert read.columns["stamp"].dtype == np.int64
    assert read.row.tolist() == list(range(1, rows + 1))
    assert read.attributes == {"device": "arm", "stamp@unit": "ns"}


@pytest.mark.parametrize("kind", KINDS)
def test_wanted_columns_keep_their_order(kind):
    read = frame(arrow_log(kind), "q[2]", "state.w", "t")
    assert list(read.columns) == ["q[2]", "state.w", "t"]


@pytest.mark.parametrize(
    ("wanted", "words"),
    [
        ("tt", "no column 'tt'.*Columns of the file: t, stamp"),
        ("raw", "is binary"),
        ("q", "Name one element"),
        ("q[3]", "Name one element"),
        ("state", "Nearest: state.w"),
    ],
)
def test_columns_that_are_none_are_refused(wanted, words):
    for kind in ("parquet", "lz4"):
        with pytest.raises(LogError, match=words):
            frame(arrow_log(kind), wanted)


def test_lists_of_several_lengths_are_no_columns():
    buffer = BytesIO()
    parquet.write_table(pa.table({"t": [0.0, 1.0], "q": [[1.0], [1.0, 2.0]], "p": [[1.0], None]}), buffer)
    assert list(frame(buffer.getvalue()).columns) == ["t"]


def test_columns_are_listed():
    infos = {info.name: info for info in list_columns("feather", "log.feather", arrow_log("lz4"))}
    assert (infos["stamp"].dtype, infos["stamp"].hint) == ("integer", "ns")
    assert (infos["q[1]"].dtype, infos["q[1]"].rows) == ("number", 40)
    assert infos["label"].first == ("a", "bb", "a")


def test_an_empty_table_has_no_rows():
    buffer = BytesIO()
    parquet.write_table(arrow_table().slice(0, 0), buffer)
    assert len(frame(buffer.getvalue(), "t", "label")) == 0
