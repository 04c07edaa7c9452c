"""Profiles and units: shipped ones are right, a wrong key, unit or column is named with what was expected."""

import csv
import math
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from places import SHARED

from pipeline.base.errors import LogError, ParameterError, ProfileError
from pipeline.base.units import UNITS, factor_to_si
from pipeline.profiles.profile_files import claim, key_lines, load_profile, read_profile, shipped_profiles
from pipeline.profiles.profile_model import Profile
from pipeline.readers import RawLog, reader_of

PENDULUM = SHARED / "real" / "dfki_pendulum"

TOML = """
name = "lab"
format = "delimited"
files = ["run_*.txt"]
delimiter = ";"
decimal = ","
skip_rows = 1
name_pattern = "K(?P<stiffness>[0-9.]+)"
step_at = "command edge"
[columns.time]
name = "t"
unit = "ms"
[columns.command]
name = "F"
unit = "mN"
sign = -1
[columns.position]
name = "x"
unit = "µm"
sign = 1
[constants]
device = "bench"
experiment = "1"
damping = 2
step = 8
sampling_period_s = 0.001
"""
TEXT = "made by lab\nt;ignored;x;F\n0;a;0,5;1000\n1;b;1;2,5\n2;c;1e3;-4\n"


@pytest.fixture
def profile_file(tmp_path):
    def write(text: str) -> Path:
        path = tmp_path / "lab.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def read_one(profile, *data: str, names=("run_K300.txt", "partner")):
    (outcome,) = reader_of(profile)(profile, [RawLog(tuple(names), tuple(d.encode() for d in data))])
    if isinstance(outcome, LogError):
        return outcome
    (log,) = outcome
    return log


def test_units_are_converted_by_definition():
    assert factor_to_si("deg", ("angle",)) == math.radians(1)
    assert factor_to_si("µm", ("length",)) == 1e-6
    assert factor_to_si("N*m", ("torque",)) == 1
    assert factor_to_si("Nm/deg", ("rotational stiffness",)) == pytest.approx(180 / math.pi, rel=1e-15)
    assert all(unit.factor > 0 for unit in UNITS.values())


def test_a_unit_of_another_quantity_is_refused():
    with pytest.raises(ParameterError, match="measures length; expected angle"):
        factor_to_si("mm", ("angle",))
    with pytest.raises(ParameterError, match=r"'inch' is not known; expected length: one of \['m', 'cm'"):
        factor_to_si("inch", ("length",))


def test_shipped_profiles_are_found_by_name():
    assert {"native", "dfki_pendulum"} <= {p.name for p in shipped_profiles()}
    assert load_profile("native").format == "native"


def test_a_file_name_without_its_constants_is_refused(profile_file):
    error = read_one(load_profile(profile_file(TOML)), TEXT, names=("run_7.txt",))
    assert "does not match name_pattern" in str(error)


def test_files_of_a_pair_need_the_same_rows(profile_file):
    toml = TOML.replace('name = "F"', 'file = "partner"\nname = "F"')
    toml = toml.replace("skip_rows = 1", 'partner = { replace = "_m", by = "_d" }').replace(
        'name_pattern = "K(?P<stiffness>[0-9.]+)"', ""
    )
    toml = toml.replace("[constants]", "[constants]\nstiffness = 0")
    profile = load_profile(profile_file(toml))
    log = read_one(profile, "t;x\n0;1\n1;2\n", "F\n3\n4\n")
    np.testing.assert_allclose(log.command, [-0.003, -0.004])
    assert "different numbers of rows" in str(read_one(profile, "t;x\n0;1\n1;2\n", "F\n3\n"))


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ("decimal", "decimals", 6, "key 'decimals': unknown; did you mean 'decimal'"),
        ("decimal", "origin", 6, "key 'origin': unknown; expected one of .*'decimal'"),
        ('unit = "ms"', 'units = "ms"', 12, "key 'columns.time.units': unknown; did you mean 'unit'"),
        (
            'unit = "ms"',
            "",
            10,
            "key 'columns.time.unit': missing; a unit is never guessed. Add unit = .*'t', one of s, ms, us",
        ),
        ('unit = "ms"', 'unit = "mm"', 12, "key 'columns.time.unit': unit 'mm' measures length; expected time"),
        ('unit = "mN"', 'unit = "lbf"', 15, "'columns.command.unit': unit 'lbf' is not known; expected force"),
        (
            'unit = "mN"',
            'unit = "cnt"',
            15,
            "unit 'cnt' is not known; expected force.*for a drive, use one of .'V', 'mV', 'A'",
        ),
        (
            'unit = "µm"',
            'unit = "count"',
            19,
            "'count' measures counts; expected length.*state counts_per_unit and the unit",
        ),
        ('unit = "mN"', 'unit = "V"', 1, r"'units.stiffness': missing; the command is in V.*Add stiffness = .*V/m"),
        ("step = 8", "", 21, "key 'constants.step': missing. Add step = <number> to .constants., or"),
        ("step = 8", 'step = "x"', 25, "key 'constants.step'.*found 'x'"),
        ("sampling_period_s = 0.001", "sampling_period_s = 0", 26, "key 'constants.sampling_period_s'"),
        ("sign = -1", "sign = 2", 16, "key 'columns.command.sign'"),
        ("sign = -1", 'file = "partner"', 1, r"key 'partner': missing, but columns.command"),
        ("sign = -1", "column = 3", 16, "'columns.command.column': stated together with name"),
        ("sign = -1", "counts_per_unit = 0", 16, "counts_per_unit.*greater than 0, found 0"),
        ('name = "F"', "", 13, "'columns.command.name': missing. Add name = "),
        ("skip_rows = 1", 'header_at = "["', 7, "'header_at': not a valid regular expression"),
        ("skip_rows = 1", 'records = "x"', 7, "'records': only for format json"),
        ("skip_rows = 1", "step_row = 1", 9, "'step_at': stated in addition to step_row"),
        (
            "skip_rows = 1",
            'units.stiffness = "Nm/rad"',
            7,
            "'units.stiffness'.*rotational stiffness; expected stiffness",
        ),
        ("skip_rows = 1", 'file = [{ match = "a", matc = "b" }]', 7, "'file.0.matc': unknown; did you mean 'match'"),
        ("skip_rows = 1", 'attributes = { stifness = "K" }', 7, "'attributes.stifness'.*'stiffness'"),
        (
            'unit = "ms"',
            'unit = "ms"\nblanks = "hold"',
            13,
            "'columns.time.blanks': Input should be 'refuse' or 'skip'",
        ),
        ('format = "delimited"', "", 1, "key 'format': missing"),
        ('format = "delimited"', 'format = "parquet"', 5, "'delimiter': only for format delimited, found parquet"),
        ('format = "delimited"', 'format = "native"', 3, "'format': a native log contains .*'columns'"),
        ("(?P<stiffness>", "(?P<mass>", 8, "are unknown"),
        ("(?P<stiffness>", "(?P<stiffness>(", 8, "not a valid regular expression"),
        ('decimal = ","', 'decimal = ";"', 6, "key 'decimal'"),
        ('name = "lab"', "name = lab", None, "not valid TOML.*line 2"),
    ],
)
def test_a_wrong_profile_is_explained(profile_file, old, new, line, words):
    path = profile_file(TOML.replace(old, new, 1))
    with pytest.raises(ProfileError, match=words) as error:
        read_profile(path)
    assert str(path) in str(error.value)
    if line is not None:
        lines = [text for text in str(error.value).splitlines() if re.search(words, text)]
        assert [text.startswith(f"{path}:{line}: ") for text in lines] == [True], str(error.value)


FIVE = """name = "lab"
format = "delimited"
files = ["run_*.txt"]
step_at = "command edge"
decimals = ","

[columns]
time = { name = "t", unit = "ms" }
command = { name = "F", unit = "N", sign = 1, sentinels = [
    -3276.8,
] }

[columns.position]
name = "x"
sign = 3

[constants]
device = "bench"
experiment = "1"
damping = 2
stiffness = 300
sampling_period_s = "soon"

[[file]]
match = "a*"
step = 8

[[file]]
match = "b*"
step_row = 2
step_time_s = 0.1
"""


def test_all_mistakes_of_a_kind_are_told_at_once(profile_file):
    path = profile_file(FIVE)

    def told():
        with pytest.raises(ProfileError) as error:
            read_profile(path)
        return re.findall(r"lab\.toml:(\d+): key '(.*?)'", str(error.value))

    keys = [("5", "decimals"), ("15", "columns.position.sign"), ("22", "constants.sampling_period_s")]
    assert told() == keys
    right = FIVE.replace("decimals", "decimal").replace("sign = 3", "sign = 1").replace('"soon"', "0.001")
    path.write_text(right, encoding="utf-8")
    assert told() == [("5", "decimal"), ("13", "columns.position.unit"), ("31", "file.1.step_time_s")]
    right = right.replace("sign = 1\n\n[con", 'unit = "mm"\nsign = 1\n\n[con').replace("step_time_s = 0.1", "step = 8")
    path.write_text(right.replace('decimal = ","', 'decimal = ","\ndelimiter = ";"'), encoding="utf-8")
    assert read_profile(path).file[1].step == 8


SILENT = """name = "lab"
format = "delimited"
files = ["run_*.txt"]

[columns.time]
name = "t"
unit = "ms"

[columns.command]
name = "F"
unit = "N"

[columns]
position = { name = "x", unit = "mm" }
force = { name = "g", unit = "N" }
velocity = { name = "v", unit = "mm/s" }

[constants]
device = "bench"
experiment = "1"
stiffness = 300
damping = 2
step = 8
sampling_period_s = 0.001
"""


def missing(path):
    """Line and key of each mistake of a profile; all of them say which line to add."""
    with pytest.raises(ProfileError) as error:
        read_profile(path)
    lines = [line for line in str(error.value).splitlines() if line.startswith(str(path))]
    found = [re.fullmatch(r".*?:(\d+): key '(.*?)': missing; add the line (.*)", line).groups() for line in lines]
    return [(int(line), key, words) for line, key, words in found]


def test_signs_decimal_mark_and_step_are_never_guessed(profile_file):
    path = profile_file(SILENT)
    found = missing(path)
    assert [(line, key) for line, key, _ in found] == [
        (1, "decimal"),
        (1, "step_at"),
        (9, "columns.command.sign"),
        (14, "columns.position.sign"),
        (15, "columns.force.sign"),
        (16, "columns.velocity.sign"),
    ]
    words = {key: text for _, key, text in found}
    assert words["decimal"].startswith('decimal = "." or decimal = ","')
    assert all(words[key].startswith("sign = 1 or sign = -1 (-1 if ") for key in words if key.endswith("sign"))
    for line in ('step_at = "command edge"', 'step_at = "first row"', "step_row = ", "step_time_s = "):
        assert line in words["step_at"]
    # the lines that it asks for are enough
    text = SILENT.replace('"]\n\n', '"]\ndecimal = "."\nstep_at = "command edge"\n\n')
    text = re.sub(r'(name = "[Fxgv]",? ?\n?unit = "[^"]*")( )?', r"\1, sign = 1\2", text)
    path.write_text(text.replace('"N", sign = 1\n\n', '"N"\nsign = 1\n\n'), encoding="utf-8")
    assert read_profile(path).factors()["velocity"] == 1e-3


STEP = """name = "lab"
format = "json"
files = ["*.json"]
TOP
columns.time = { name = "t", unit = "s" }
columns.command = { name = "F", unit = "N", sign = 1 }
columns.position = { name = "x", unit = "m", sign = 1 }
constants = { device = "b", experiment = "1", stiffness = 1, damping = 1, step = 8, sampling_period_s = 0.001 }
ENTRIES
"""
A_FILE, B_FILE = '[[file]]\nmatch = "a*"\n', '[[file]]\nmatch = "b*"\n'
A_STEP, B_STEP = '[[steps]]\nlabel = "a"\nto_row = 9\n', '[[steps]]\nlabel = "b"\nfrom_row = 10\n'


@pytest.mark.parametrize(
    ("top", "entries", "keys"),
    [
        ("", "", ["step_at"]),
        ("step_row = 3", "", []),
        ("step_time_s = 0.1", "", []),
        ('step_at = "first row"', A_FILE, []),
        ("", A_FILE, ["step_at"]),
        ("", A_FILE + "step_row = 3\n", []),
        ("", A_FILE + "step_row = 3\n" + B_FILE + "step = 0\n", []),
        ("", A_STEP + "step_row = 3\n" + B_STEP + 'step_at = "command edge"\n', []),
        ("", A_STEP + B_STEP + A_FILE + "step_row = 3\n", []),
        ("STEP0", "", []),
        ("STEP0", A_FILE + "step = 5\n", ["step_at"]),
        ("STEP0", A_FILE + "step = 5\nstep_row = 0\n", []),
        ('STEP0attributes.step = "F0"', "", ["step_at"]),
    ],
)
def test_the_step_is_told_at_the_top_or_in_every_entry(profile_file, top, entries, keys):
    text = STEP.replace("TOP", top.removeprefix("STEP0")).replace("ENTRIES", entries)
    path = profile_file(text.replace("step = 8", "step = 0") if top.startswith("STEP0") else text)
    if not keys:
        assert read_profile(path).format == "json"
        return
    assert [key for _, key, _ in missing(path)] == keys


def test_lines_of_keys_are_found_in_any_style_of_toml():
    text = '''a = 1
[t]
"b c" = """
x: 1
"""
d.e = [
  { f = 1 },
  { f = 2 },
]
[[s]]
g = 1 # [no]
[[s]]
  [s.u]
  h = 2
'''
    assert tomllib.loads(text)["s"][1]["u"]["h"] == 2
    lines = key_lines(text)
    assert {place: lines[place] for place in lines if place} == {
        ("a",): 1,
        ("t",): 2,
        ("t", "b c"): 3,
        ("t", "d"): 6,
        ("t", "d", "e"): 6,
        ("s",): 10,
        ("s", 0): 10,
        ("s", 0, "g"): 11,
        ("s", 1): 12,
        ("s", 1, "u"): 13,
        ("s", 1, "u", "h"): 14,
    }


def test_an_unknown_profile_lists_the_shipped_ones():
    with pytest.raises(ProfileError, match=r"Expected one of .*dfki_pendulum.*native"):
        load_profile("nativ")


def test_a_specific_profile_claims_before_the_native_one():
    lab = Profile(**load_profile("dfki_pendulum").model_dump() | {"name": "lab", "files": ("run_*.csv",)})
    other = Profile(**lab.model_dump() | {"name": "other", "files": ("*_1.csv",)})
    native = load_profile("native")
    assert claim("run_2.csv", (native, lab, other)) is lab
    assert claim("RUN_2.CSV", (native, lab, other)) is lab
    assert claim("B1_K2.csv", (native, lab, other)) is native
    assert claim("notes.md", (native, lab, other)) is None
    with pytest.raises(ProfileError, match=r"\['lab', 'other'\].*--profile"):
        claim("run_1.csv", (native, lab, other))


def test_title_and_layout_do_not_make_another_profile(profile_file):
    first = read_profile(profile_file(TOML))
    same = read_profile(profile_file('title = "Lab"  # remark\n' + TOML))
    other = read_profile(profile_file(TOML.replace("sign = -1", "sign = 1")))
    assert first.digest == same.digest != other.digest


@pytest.mark.skipif(not PENDULUM.is_dir(), reason="recorded logs in ../shared are not there")
def test_pendulum_equals_a_reading_with_the_csv_module():
    profile = load_profile("dfki_pendulum")
    (measured,) = PENDULUM.glob("*__data_measured.csv")
    desired = profile.partner_of(measured)
    rows = list(csv.DictReader(measured.read_text().splitlines()))
    commands = list(csv.DictReader(desired.read_text().splitlines()))
    log = read_one(profile, measured.read_text(), desired.read_text(), names=(measured.name, desired.name))
    # later the run is disturbed: the profile's window ends at 4 s
    quiet = [i for i, row in enumerate(rows) if float(row["time"]) <= 4]
    assert log.time.tolist() == [float(rows[i]["time"]) for i in quiet]
    assert log.position.tolist() == [float(rows[i]["position"]) for i in quiet]
    assert log.command.tolist() == [float(commands[i]["torque"]) for i in quiet]
    assert (len(rows), len(log.time), log.counts["outside_window"]) == (8000, 797, 7203)
    assert log.header.extra == {"step_row": "0"}


TCLAB = PENDULUM.parent / "tclab" / "step_test_data.csv"


@pytest.mark.skipif(not TCLAB.is_file(), reason="recorded logs in ../shared are not there")
def test_tclab_equals_a_reading_with_the_csv_module():
    rows = list(csv.DictReader(TCLAB.read_text().splitlines()))
    log = read_one(load_profile("tclab"), TCLAB.read_text(), names=(TCLAB.name,))
    assert log.time.tolist() == [float(row["Time"]) for row in rows]
    assert log.command.tolist() == [float(row["Q1"]) for row in rows]
    assert log.position.tolist() == [float(row["T1"]) for row in rows]
    assert log.header.extra["step_row"] == "0"
    assert log.header.extra["stands_for.position"] == "1 degC stands for 1 m"


def test_long_form_holds_many_trials():
    names = "device,experiment,trial,stiffness,damping,step,sampling_period_s,time_s,command,position"
    rows = [
        f"bench,{e},{t},{t * 100},2.5,8,0.001,{k / 1000},{8 * k},{k * t / 1e3}"
        for e, t in (("1", 1), ("1", 2), ("x", 3))
        for k in range(3)
    ]
    profile = load_profile("long_form")
    assert claim("june.trials.csv", shipped_profiles()) is profile
    raw = RawLog(("june.trials.csv",), ("\n".join([names, *rows, ""]).encode(),))
    (logs,) = reader_of(profile)(profile, [raw])
    assert [(log.label, log.header.experiment, log.header.stiffness) for log in logs] == [
        ("1", "1", 100),
        ("2", "1", 200),
        ("3", "x", 300),
    ]
    assert logs[1].position.tolist() == [0, 0.002, 0.004]


def test_a_joint_log_is_read_by_position():
    width = 4 + 4 * 7
    header = ",".join(f"column {i}" for i in range(1, width + 1))
    lines = [",".join(str(1000 * row + column) for column in range(1, width + 1)) for row in range(3)]
    profile = load_profile("kuka_fri")
    log = read_one(profile, "\n".join([header, *lines, ""]), names=("fri_K300_B2.5_F5_a.csv",))
    assert (log.header.stiffness, log.header.damping, log.header.step) == (300, 2.5, 5)
    assert read_one(profile, "\n".join([header, *lines, ""]), names=("fri_K3_B-1_F5.5.csv",)).header.step == 5.5
    for column, at in ((log.time, 2), (log.position, 5), (log.force, 19), (log.command, 26)):
        assert column.tolist() == [at, 1000 + at, 2000 + at]
