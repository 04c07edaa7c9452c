"""JSON logs: records alone, under a key, one a line, and lists beside each other."""

import json
import math

import numpy as np
import pytest
from foreign_files import json_log, list_columns, read_frame, samples
from places import SHARED

from pipeline.base.errors import LogError

SERVO = SHARED / "real" / "bam_servo"


def frame(text, wanted=(), records=None):
    data = text if isinstance(text, bytes) else text.encode()
    return read_frame("json", "log.json", data, wanted, records=records)


def test_every_value_comes_back():
    time, position, _ = samples()
    read = frame(json_log(), ["t", "q[2]", "on"], "entries")
    assert list(read.columns) == ["t", "q[2]", "on"]
    assert read.columns["t"].tolist() == time.tolist()
    assert read.columns["q[2]"].tolist() == position[:, 2].tolist()
    assert read.columns["on"].tolist() == (time > 0.01).astype(int).tolist()
    assert read.row.tolist() == list(range(1, len(time) + 1))
    assert read.row_name == "record"
    assert read.attributes == {"kp": 32, "motor.name": "ä"}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-32"])
def test_encodings(encoding):
    read = frame('[{"ü": 1.5}, {"ü": -2}]'.encode(encoding))
    assert read.columns["ü"].tolist() == [1.5, -2.0]


def test_nested_keys_and_missing_values():
    read = frame('[{"s": {"q": [1, 2]}, "label": "a", "n": 1}, {"s": null, "n": 2}]')
    assert read.columns["s.q[0]"][0] == 1
    assert math.isnan(read.columns["s.q[1]"][1])
    assert read.columns["label"].tolist() == ["a", ""]
    assert read.columns["n"].dtype == np.int64


def test_counters_keep_their_integers():
    read = frame(f'[{{"n": {2**63 + 1}}}, {{"n": 3}}]')
    assert read.columns["n"].tolist() == [2**63 + 1, 3]


def test_one_record_a_line_with_a_cut_last_line():
    read = frame('{"t": 0, "x": 1}\n\n{"t": 1, "x": 2}\n{"t": 2, "x"')
    assert read.columns["x"].tolist() == [1, 2]
    assert read.row.tolist() == [1, 3]
    assert read.row_name == "line"
    assert read.warnings == ('the last row (line 4) is incomplete and was omitted: \'{"t": 2, "x"\'',)


def test_a_damaged_line_in_between_is_refused_with_its_line():
    with pytest.raises(LogError, match="one record per line") as error:
        frame('{"t": 0}\n{"t" 1}\n{"t": 2}\n')
    assert error.value.row == 2


def test_records_without_names_and_lists_beside_each_other():
    assert frame("[[0, 1.5], [1, 2.5]]", ["2"]).columns["2"].tolist() == [1.5, 2.5]
    read = frame('{"K": 3, "log": {"t": [0, 1], "q": [[1, 2], [3, 4]]}}', ["log.t", "log.q[1]"])
    assert read.columns["log.q[1]"].tolist() == [2, 4]
    assert read.attributes == {"K": 3}
    with pytest.raises(LogError, match=r"different lengths.*'t': 2, 'x': 3"):
        frame('{"t": [0, 1], "x": [1, 2, 3]}')


@pytest.mark.parametrize(
    ("text", "wanted", "records", "words", "row"),
    [
        ("", (), None, "is empty", 1),
        ('[{"t": 1}, {"t"', (), None, "truncated or damaged", 1),
        ('[{"t": 1},\n{"t" 2}]', (), None, "column 6", 2),
        ('{"a": [{"t": 1}], "b": {"c": [{"t": 1}, {"t": 2}]}}', ["t"], None, 'help in the profile: records = "b.c"', 1),
        ('{"a": [{"t": 1}]}', (), "b", "'a' .1 records.*`records`", 1),
        ('[{"t": 1}]', (), "b", "not under 'b'", 1),
        ('[{"time": 1}]', ["tine"], None, "Nearest: time", None),
        ('[{"t": 1}, {"t": "x"}]', ["t"], None, "mixes texts and numbers", 1),
        ('[{"t": 1}, 2]', (), None, "expected an object", 2),
        ("[]", (), None, "no records with values", 1),
        ("3", (), None, "single value", 1),
        ("[" * 100_000, (), None, "recursion", None),
        ('[{"n": ' + "9" * 5000 + "}]", (), None, "integer string", None),
    ],
)
def test_refusals_say_what_to_do(text, wanted, records, words, row):
    with pytest.raises(LogError, match=f"log.json.*{words}") as error:
        frame(text, wanted, records)
    assert error.value.row == row


def test_records_that_share_no_names_take_no_table():
    text = json.dumps([{f"n{i}": i} for i in range(5000)])
    with pytest.raises(LogError, match=r"has more than .* values|needs more memory"):
        frame(text)


def test_columns_are_listed_with_the_line_to_add():
    infos = list_columns("json", "log.json", json_log())
    assert [(i.name, i.dtype, i.rows) for i in infos][:2] == [("t", "number", 40), ("q[0]", "number", 40)]
    assert infos[0].first == ("0.0", "0.001", "0.002")
    mixed = list_columns("json", "log.json", b'[{"a": 1}, {"a": "x"}]')
    assert (mixed[0].rows, "mixes texts and numbers, such as 1" in mixed[0].hint) == (0, True)


@pytest.mark.skipif(not SERVO.is_dir(), reason="recorded logs in ../shared are not there")
def test_servo_log_equals_the_json_module():
    (path,) = SERVO.glob("*.json")
    raw = json.loads(path.read_text())
    wanted = ["timestamp", "position", "goal_position", "torque_enable"]
    read = read_frame("json", path.name, path.read_bytes(), wanted, records="entries")
    assert len(read) == 354
    for key in wanted:
        assert read.columns[key].tolist() == [record[key] for record in raw["entries"]]
    assert read.attributes["length"] == raw["length"] == 0.12
