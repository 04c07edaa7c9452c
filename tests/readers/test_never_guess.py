"""Where file and profile, or parts of a file, contradict each other: refused or warned of, never settled silently."""

import gzip
import json
from io import BytesIO

import numpy as np
import pyarrow as pa
import pytest
import scipy.io
from foreign_files import bag_file, hdf5_file, joint_log, tdms_log
from pyarrow import parquet

from pipeline.base.errors import LogError, ProfileError
from pipeline.profiles.profile_files import read_profile
from pipeline.profiles.profile_model import Profile
from pipeline.readers import Log, RawLog, reader_of
from pipeline.readers.isolation import read_file
from pipeline.shell.profile.check import check_samples
from pipeline.shell.profile.draft import draft_profile

COLUMNS = {
    "time": {"name": "t", "unit": "ms"},
    "command": {"name": "F", "unit": "N", "sign": 1},
    "position": {"name": "x", "unit": "mm", "sign": 1},
}
CONDITIONS = {
    "device": "bench",
    "experiment": "1",
    "stiffness": 300,
    "damping": 2,
    "step": 8,
    "sampling_period_s": 0.001,
}
TEXT = {"format": "delimited", "decimal": "."}
GERMAN = {"format": "delimited", "decimal": ",", "delimiter": ";"}
BANNER = {"labels": ":", "header_at": "^t", "attributes": {"stiffness": "K"}}


def profile(layout, columns=COLUMNS, **more) -> Profile:
    values = {"name": "lab", "files": ["*"], "columns": columns, "constants": CONDITIONS}
    return Profile.model_validate(
        values | ({} if {"step_time_s"} & set(more) else {"step_at": "command edge"}) | layout | more
    )


def read(chosen: Profile, data: bytes | str, name="run") -> Log | LogError:
    raw = RawLog((name,), (data if isinstance(data, bytes) else data.encode(),))
    (outcome,) = reader_of(chosen)(chosen, [raw])
    return outcome if isinstance(outcome, LogError) else outcome[0]


def reason(chosen: Profile, data: bytes | str) -> str:
    outcome = read(chosen, data)
    assert isinstance(outcome, LogError), outcome
    return outcome.reason


def table(rows) -> str:
    return "t,F,x\n" + "".join(f"{','.join(map(str, row))}\n" for row in rows)


RUN = [(k, 8 * (k > 1), k) for k in range(6)]


@pytest.mark.parametrize("value", ["1.200", "1.200 N/m", "0.5 N/mm"])
def test_a_point_in_a_condition_of_a_file_with_decimal_commas_is_refused(value):
    body = "t;F;x{}\n0;0;0,5{}\n1;8;1,5{}\n"
    label = profile(GERMAN | BANNER)
    assert "the point may separate thousands" in reason(label, f"K: {value}\n" + body.format("", "", ""))
    column = profile(GERMAN, condition_columns={"stiffness": "K"})
    cells = body.format(";K", f";{value}", f";{value}")
    assert "the point may separate thousands" in reason(column, cells)
    log = read(column, cells.replace(".", ","))
    assert log.header.stiffness == {"1.200": 1.2, "1.200 N/m": 1.2, "0.5 N/mm": 500.0}[value]


def test_a_point_in_a_file_name_is_decimal():
    chosen = profile(GERMAN, name_pattern=r"K(?P<stiffness>[0-9.]+)_")
    assert read(chosen, "t;F;x\n0;0;0,5\n1;8;1,5\n", "K0.5_1").header.stiffness == 0.5


@pytest.mark.parametrize("text", ["K: 100\nK: 300\n" + table(RUN), "K: 100\n" + table(RUN[:3]) + "K: 300\n3,8,3\n"])
def test_a_label_that_changes_is_no_condition(text):
    chosen = profile(TEXT | BANNER)
    outcome = read(chosen, text)
    assert isinstance(outcome, LogError)
    assert "'K' states the stiffness twice, with the different values '100' and '300'" in outcome.reason
    assert text.splitlines()[outcome.row - 1] == "K: 300"
    assert read(chosen, text.replace("300", "100")).header.stiffness == 100
    # no condition is taken from it: the last value is kept beside the trial
    assert read(profile(TEXT | BANNER | {"attributes": {}}), text).header.extra["file.K"] == "300"


def test_the_declared_time_of_the_step_is_met_by_the_row_that_bears_it():
    # 501 x 1e-6 is below 0.000501 in floats, as for every third stamp in us
    rows = [(k, 8 * (k >= 501), 0) for k in range(495, 510)]
    micro = COLUMNS | {"time": {"name": "t", "unit": "us"}}
    for k in range(495, 510):
        log = read(profile(TEXT, micro, step_time_s=float(f"{k}e-6")), table(rows))
        assert log.header.extra["step_row"] == str(k - 495)
    assert "is not among the samples" in reason(profile(TEXT, micro, step_time_s=510e-6), table(rows))


def stamps(kind) -> bytes:
    buffer = BytesIO()
    times = (
        pa.array(1_700_000_000_000 + np.arange(6)).cast(kind)
        if kind == pa.timestamp("ms")
        else pa.array(range(6), kind)
    )
    parquet.write_table(pa.table({"t": times, "F": [0.0, 0, 8, 8, 8, 8], "x": range(6)}), buffer)
    return buffer.getvalue()


JOINTS = {
    key: {"name": f"/arm/joints.position[{i}]", "unit": unit, "sign": 1}
    for i, (key, unit) in enumerate([("command", "N"), ("position", "m")])
}
CHANNELS = {
    "command": {"name": "/arm/force", "unit": "N", "sign": 1},
    "position": {"name": "/arm/count", "unit": "mm", "sign": 1},
}
TYPED = {
    "timestamp": ("parquet", lambda: stamps(pa.timestamp("ms")), COLUMNS, "t", "ms", "ns"),
    "duration": ("parquet", lambda: stamps(pa.duration("us")), COLUMNS, "t", "us", "ns"),
    "ROS stamp": ("mcap", lambda: bag_file("mcap", joint_log), JOINTS, "/arm/joints.header.stamp", "s", "ns"),
    "ROS part": ("rosbag", lambda: bag_file("db3", joint_log), JOINTS, "/arm/joints.@received", "us", "ns"),
    "waveform": ("tdms", tdms_log, CHANNELS, "@time", "ms", "s"),
    "TDMS stamp": ("tdms", tdms_log, CHANNELS, "/arm/stamp", "s", "ns"),
}


@pytest.mark.parametrize("which", TYPED)
def test_times_whose_type_states_the_unit_take_no_other(which):
    kind, write, columns, name, wrong, right = TYPED[which]
    data = write()

    def of(unit, **more):
        return profile({"format": kind}, columns | {"time": {"name": name, "unit": unit, "kind": "counter"} | more})

    refusal = read(of(wrong), data)
    assert isinstance(refusal, LogError)
    assert refusal.code == "profile-wrong"
    assert f"columns.time.unit is '{wrong}', but the file states '{right}'" in refusal.reason
    assert refusal.profile_line == f'[columns.time]\nunit = "{right}"'
    log = read(of(right), data)
    assert isinstance(log, Log), log


@pytest.mark.parametrize("rows", [3, 4])
def test_a_matrix_alone_has_more_samples_than_signals(rows):
    """As Simulink's "To File" writes it: one signal in each row, time above."""
    signals = np.vstack([np.arange(50.0), 8.0 * (np.arange(50) > 20), np.arange(50) * 0.1, np.ones(50)])[:rows]
    columns = {key: source | {"name": f"ans[{i}]"} for i, (key, source) in enumerate(COLUMNS.items())}
    buffer = BytesIO()
    scipy.io.savemat(buffer, {"ans": signals})
    wide = read(profile({"format": "matlab"}, columns), buffer.getvalue())
    buffer = BytesIO()
    scipy.io.savemat(buffer, {"ans": signals.T})
    for log in (wide, read(profile({"format": "matlab"}, columns), buffer.getvalue())):
        assert log.raw_time.tolist() == signals[0].tolist()
        assert log.command.tolist() == signals[1].tolist()
    write = hdf5_file(lambda file: file.create_dataset("ans", data=signals))
    assert read(profile({"format": "hdf5"}, columns), write).command.tolist() == signals[1].tolist()


def test_stamps_of_another_pace_than_the_sampling_period_are_warned_of():
    seconds = table((k / 1000, force, x) for k, force, x in RUN)

    def periods(text):
        return [each.evidence for each in read(profile(TEXT), text).findings if each.code == "sampling_period"]

    (warning,) = periods(seconds)
    assert warning.startswith("The time stamps are 1e-06 s apart, but the stated sampling period is 0.001 s")
    assert periods(table(RUN)) == []
    (warning,) = periods(table(RUN[::2]))  # half of the samples lost
    assert "0.002 s apart" in warning


@pytest.mark.parametrize("pack", [gzip.compress, lambda data: pa.compress(data, codec="zstd", asbytes=True)])
def test_packed_json_is_read_and_drafted(pack, tmp_path):
    lines = "".join(json.dumps({"t": t, "F": force, "x": x}) + "\n" for t, force, x in RUN)
    log = read(profile({"format": "json"}), pack(lines.encode()))
    assert log.raw_time.tolist() == [0, 1, 2, 3, 4, 5]
    (tmp_path / "a.jsonl.gz").write_bytes(pack(lines.encode()))
    assert 'format = "json"\nfiles = ["*.jsonl.gz"]' in draft_profile(tmp_path / "a.jsonl.gz")


@pytest.mark.parametrize(
    ("data", "kind", "words"),
    [
        (
            json.dumps([{"t": "0", "F": 0, "x": 0}, {"t": "1", "F": 8, "x": 1}]),
            {"format": "json"},
            "time must be a number (column 't', decimal sign '.'), but the cell is '0'",
        ),
        ("t,F,x\n12:00:00.001,0,0\n", TEXT, "dates and times of day are not read"),
        ("t,F,x\n2024-05-01 12:00:00.001,0,0\n", TEXT, "columns.time.unit is 'ms', but the file states 'ns'"),
    ],
)
def test_times_in_words_are_refused_by_what_they_are(data, kind, words):
    assert words in reason(profile(kind), data)


@pytest.mark.parametrize(("cell", "listed"), [("--", True), ("N/A", True), ("12 34", False), ("5 N", False)])
def test_only_words_are_said_to_be_no_value(cell, listed):
    outcome = read(profile(TEXT), f"t,F,x\n0,0,{cell}\n1,8,2\n")
    assert isinstance(outcome, LogError)
    assert outcome.profile_line == (f'missing = ["{cell}"]' if listed else None)
    assert ("missing = [" in outcome.reason) == listed


def test_a_delimiter_behind_the_names_alone_has_its_remedy():
    text = "t;F;x;\n0;0;1,5\n1;8;2\n"
    outcome = read(profile(GERMAN), text)
    assert isinstance(outcome, LogError)
    assert outcome.profile_line == "trailing_delimiter = true"
    assert len(read(profile(GERMAN | {"trailing_delimiter": True}), text).time) == 2


TOML = """name = "lab"
format = "delimited"
files = ["*.csv"]
decimal = "."
step_at = "command edge"
[columns]
time = { name = "t [ms]", unit = "ms" }
command = { name = "F", unit = "N", sign = 1 }
position = { name = "x", unit = "mm", sign = 1 }
[constants]
device = "bench"
experiment = "1"
stiffness = 300
damping = 2
step = 8
sampling_period_s = 0.001
"""


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('name = "x"', 'name = "F"', ":9: key 'columns.position.name': 'F' is already used for columns.command"),
        ("sign = 1 }\nposition", "sign = true }\nposition", ":8: key 'columns.command.sign': Input should be 1 or -1"),
        ("stiffness = 300", 'stiffness = "300"', ":13: key 'constants.stiffness': Input should be a valid number"),
        ("damping = 2", "damping = true", ":14: key 'constants.damping': Input should be a valid number"),
        ("[columns]", 'name_pattern = "K([0-9]+)"\n[columns]', ":6: key 'name_pattern': has no named group"),
        ('["*.csv"]', '"*.csv"', ":3: key 'files': Input should be a list in brackets"),
    ],
)
def test_mistakes_of_kind_and_doubled_columns_are_named(old, new, words, tmp_path):
    assert TOML.count(old) == 1
    (tmp_path / "lab.toml").write_text(TOML.replace(old, new), encoding="utf-8")
    with pytest.raises(ProfileError) as error:
        read_profile(tmp_path / "lab.toml")
    assert words in str(error.value)
    assert str(error.value).count("lab.toml:") == 1


def checked(tmp_path, toml, rows):
    (tmp_path / "lab.toml").write_text(toml, encoding="utf-8")
    (tmp_path / "a.csv").write_text(table(rows).replace("t,F", "t [ms],F"), encoding="utf-8")
    ((sample,),) = [check_samples(read_profile(tmp_path / "lab.toml"), [tmp_path / "a.csv"])]
    (trial,) = sample["trials"]
    return tuple(trial["warnings"])


def test_a_check_warns_of_another_unit_or_step_and_of_a_motion_against_it(tmp_path):
    rows = [(k, 8 * (k > 4), 0.01 * max(k - 6, 0) ** 2) for k in range(40)]
    assert checked(tmp_path, TOML, rows) == ()
    micro = TOML.replace('unit = "ms"', 'unit = "us"').replace("0.001", "1e-6")
    (warning, *implausible) = checked(tmp_path, micro, rows)
    assert [text.split()[0] for text in implausible] == ["sampling_period_s", "duration_s"]
    assert warning == "columns.time.unit is 'us', but the file states 'ms'. Check which of the two is right"
    (warning,) = checked(tmp_path, TOML.replace("step = 8", "step = 9"), rows)
    assert warning == "the command jumps by 8 in row 5, but the stated step is 9. Check which of the two is right"
    (warning,) = checked(tmp_path, TOML.replace('"mm", sign = 1', '"mm", sign = -1'), rows)
    assert warning.startswith("The position moves against its command, first in row")


def test_units_of_a_unit_line_are_known_in_their_brackets(tmp_path):
    text = "t\tF\tx\n[ms]\t(N)\t[mm]\n" + "".join(f"{t}\t{force}\t{x}.5\n" for t, force, x in RUN)
    chosen = profile(TEXT | {"delimiter": "\t", "unit_line": True})
    assert read_file(chosen, ("a",), (text.encode(),)).hints == {"t": "ms", "F": "N", "x": "mm"}
    (tmp_path / "a.txt").write_text(text, encoding="utf-8")
    draft = draft_profile(tmp_path / "a.txt")
    assert "unit = \"ms\" # the file states 'ms'" in draft
    assert "unit = \"N\" # the file states 'N'" in draft


def test_labels_in_remarks_are_read_by_the_draft(tmp_path):
    (tmp_path / "a.csv").write_text("# K = 300\n# made by hand\n" + table(RUN), encoding="utf-8")
    draft = draft_profile(tmp_path / "a.csv")
    assert 'labels = "="\ncomment = "#"' in draft
    assert '#   "K": "300"' in draft
