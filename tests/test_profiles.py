"""Profiles and units: shipped ones are right, a wrong key, unit or column is named with what was expected."""

import csv
import math
from pathlib import Path

import numpy as np
import pytest

from pipeline.errors import LogError, ParameterError, ProfileError
from pipeline.profiles import Profile, claim, load_profile, read_profile, shipped_profiles
from pipeline.readers import Log, RawLog, reader_of
from pipeline.units import UNITS, factor_to_si

PENDULUM = Path(__file__).parents[2] / "shared" / "real" / "dfki_pendulum"

TOML = """
name = "lab"
format = "delimited"
files = ["run_*.txt"]
delimiter = ";"
decimal = ","
skip_rows = 1
name_pattern = "K(?P<stiffness>[0-9.]+)"
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
    (outcome,) = reader_of(profile)(profile, [RawLog(tuple(names), tuple(d.encode() for d in data))], False)
    return outcome


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


def test_delimited_log_is_converted_to_si(profile_file):
    log = read_one(load_profile(profile_file(TOML)), TEXT)
    assert isinstance(log, Log)
    np.testing.assert_allclose(log.time, [0, 0.001, 0.002], rtol=1e-15)
    np.testing.assert_allclose(log.command, [-1, -0.0025, 0.004], rtol=1e-15)
    np.testing.assert_allclose(log.position, [0.5e-6, 1e-6, 1e-3], rtol=1e-15)
    assert (log.header.device, log.header.stiffness, log.header.damping) == ("bench", 300.0, 2.0)
    assert log.header.motion == "translation"


@pytest.mark.parametrize(
    ("text", "row", "words"),
    [
        (
            TEXT.replace("x;", "y;"),
            2,
            r"wants column 'x' for columns.position once, found it 0 times among \['t'",
        ),
        (TEXT.replace("ignored", "x"), 2, "found it 2 times"),
        (TEXT.replace("2,5", "much"), 4, "command must be a number .*found 'much'"),
        (TEXT.replace("1;b;", "1;"), 4, "expected 4 values, found 3"),
        (TEXT.replace("1e3", "nan"), 5, "position is nan"),
        (TEXT.replace("2;c", "1;c"), 5, "expected it to increase"),
        ("made by lab\n", 1, "is empty"),
        ("made by lab\nt;ignored;x;F\n", 3, "0 samples"),
    ],
)
def test_a_delimited_log_is_refused_with_its_row(profile_file, text, row, words):
    error = read_one(load_profile(profile_file(TOML)), text)
    assert isinstance(error, LogError)
    assert error.row == row
    with pytest.raises(LogError, match=words):
        raise error


def test_a_file_name_without_its_constants_is_refused(profile_file):
    error = read_one(load_profile(profile_file(TOML)), TEXT, names=("run_7.txt",))
    assert "does not fit name_pattern" in str(error)


def test_files_of_a_pair_need_the_same_rows(profile_file):
    toml = TOML.replace('name = "F"', 'file = "partner"\nname = "F"')
    toml = toml.replace("skip_rows = 1", '[partner]\nreplace = "_m"\nby = "_d"').replace(
        'name_pattern = "K(?P<stiffness>[0-9.]+)"', ""
    )
    toml = toml.replace("[constants]", "[constants]\nstiffness = 0")
    profile = load_profile(profile_file(toml))
    log = read_one(profile, "t;x\n0;1\n1;2\n", "F\n3\n4\n")
    np.testing.assert_allclose(log.command, [-0.003, -0.004])
    assert "different numbers of rows" in str(read_one(profile, "t;x\n0;1\n1;2\n", "F\n3\n"))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("decimal", "decimals", "key 'decimals' is not known; expected one of .*'decimal'"),
        ('unit = "ms"', 'units = "ms"', "key 'columns.time.units' is not known; expected one of .*'unit'"),
        ('unit = "ms"', 'unit = "mm"', "columns.time.unit: unit 'mm' measures length; expected time"),
        ('unit = "mN"', 'unit = "lbf"', "columns.command.unit: unit 'lbf' is not known; expected force"),
        ("step = 8", "", r"\[constants\] has no \['step'\]"),
        ("step = 8", 'step = "x"', "key 'constants.step'.*found 'x'"),
        ("sampling_period_s = 0.001", "sampling_period_s = 0", "key 'constants.sampling_period_s'"),
        ("sign = -1", "sign = 2", "key 'columns.command.sign'"),
        ("sign = -1", 'file = "partner"', r"no \[partner\]"),
        ('format = "delimited"', "", "key 'format' is missing"),
        ('format = "delimited"', 'format = "native"', "remove .*'columns'"),
        ("(?P<stiffness>", "(?P<mass>", "unknown groups"),
        ("(?P<stiffness>", "(?P<stiffness>(", "no regular expression"),
        ('decimal = ","', 'decimal = ";"', "key 'decimal'"),
        ('name = "lab"', "name = lab", "no valid TOML"),
    ],
)
def test_a_wrong_profile_is_explained(profile_file, old, new, words):
    path = profile_file(TOML.replace(old, new, 1))
    with pytest.raises(ProfileError, match=words) as error:
        read_profile(path)
    assert str(path) in str(error.value)


def test_an_unknown_profile_lists_the_shipped_ones():
    with pytest.raises(ProfileError, match=r"expected one of .*dfki_pendulum.*native"):
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
    assert first.digest() == same.digest() != other.digest()


@pytest.mark.skipif(not PENDULUM.is_dir(), reason="recorded logs in ../shared are not there")
def test_pendulum_equals_a_reading_with_the_csv_module():
    profile = load_profile("dfki_pendulum")
    (measured,) = PENDULUM.glob("*__data_measured.csv")
    desired = profile.partner_of(measured)
    rows = list(csv.DictReader(measured.read_text().splitlines()))
    commands = list(csv.DictReader(desired.read_text().splitlines()))
    log = read_one(profile, measured.read_text(), desired.read_text(), names=(measured.name, desired.name))
    assert log.time.tolist() == [float(row["time"]) for row in rows]
    assert log.position.tolist() == [float(row["position"]) for row in rows]
    assert log.command.tolist() == [float(row["torque"]) for row in commands]
    assert len(log.time) == 8000
    assert log.header.extra == {"step_row": "0"}
