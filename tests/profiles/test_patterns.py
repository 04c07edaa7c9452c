"""Patterns of profiles are found in time that grows with the text alone."""

import re
import time

import pytest

from pipeline.base.errors import ProfileError
from pipeline.intake.ingest import ingest
from pipeline.profiles.profile_files import read_profile, shipped_profiles
from pipeline.profiles.profile_model import find_groups, group_names, pattern_problem

PROFILE = """name = "lab"
format = "delimited"
files = ["*.csv"]
decimal = "."
step_at = "command edge"
PATTERN
columns.time = { name = "t", unit = "ms" }
columns.command = { name = "F", unit = "N", sign = 1 }
columns.position = { name = "x", unit = "mm", sign = 1 }
[constants]
device = "bench"
experiment = "1"
damping = 1
stiffness = 1
step = 1
sampling_period_s = 0.001
"""
HANGING = ["^(a+)+$", "^(a|a)*$", "^(a|aa)+$", "(a*)*b", "(.*a){25}!"]


@pytest.mark.parametrize("pattern", HANGING)
@pytest.mark.parametrize("key", ["name_pattern", "header_at"])
def test_no_pattern_hangs_an_ingest(tmp_path, pattern, key):
    given = f"(?P<grip>x)?{pattern}" if key == "name_pattern" else pattern
    (tmp_path / "lab.toml").write_text(PROFILE.replace("PATTERN", f"{key} = '{given}'"))
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / f"{'a' * 60}!.csv").write_text("a" * 5000 + "?\nt,F,x\n0,0,0\n1,1,0\n")
    began = time.process_time()
    report = ingest([tmp_path / "logs"], tmp_path / "processed", profile=tmp_path / "lab.toml", jobs=1)
    assert report.found == 1
    assert time.process_time() - began < 5


@pytest.mark.parametrize(
    ("pattern", "said"),
    [
        ("(?=K)(?P<stiffness>[0-9]+)", "not a valid regular expression: .*[(][?]=.*Lookahead"),
        ("(?<=K)(?P<stiffness>[0-9]+)", "not a valid regular expression"),
        (r"(?P<stiffness>[0-9]+)_\\1", "not a valid regular expression: .*backreference"),
        ("(?P<stiffness>(a{900}){900})", "not a valid regular expression"),
        ("(?P<stiffness>[0-9]+", "not a valid regular expression: missing"),
    ],
)
def test_what_needs_more_than_one_pass_is_refused_with_line_and_key(tmp_path, pattern, said):
    (tmp_path / "lab.toml").write_text(PROFILE.replace("PATTERN", f'name_pattern = "{pattern}"'))
    with pytest.raises(ProfileError, match=rf"lab.toml:6: key 'name_pattern': {said}"):
        read_profile(tmp_path / "lab.toml")


def test_shipped_patterns_and_usual_ones_find_what_python_finds():
    patterns = [profile.name_pattern for profile in shipped_profiles() if profile.name_pattern]
    patterns += [
        "K(?P<stiffness>[0-9.]+)_B(?P<damping>-?[0-9.]+)\\.csv",
        "run_(?P<experiment>[0-9]+)",
        "^(?P<grip>x)?y",
    ]
    texts = ["fri_K300_B-2.5_F8_a.csv", "fri_K300_B2_F-8.csv", "K1.5_B0.csv", "run_07", "y", "xy", "é K3_B1.csv", ""]
    assert len(patterns) > 3
    for pattern in patterns:
        assert pattern_problem(pattern) is None
        assert group_names(pattern) == set(re.compile(pattern).groupindex)
        for text in texts:
            match = re.search(pattern, text)
            expected = match and {key: value for key, value in match.groupdict().items() if value is not None}
            assert find_groups(pattern, text) == expected


def test_names_of_any_bytes_are_held_against_patterns(tmp_path):
    (tmp_path / "lab.toml").write_text(PROFILE.replace("PATTERN", "name_pattern = '(?P<grip>none)'"))
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "none\udcff.csv").write_text("t,F,x\n0,0,0\n1,1,0\n2,1,1\n")
    report = ingest([tmp_path / "logs"], tmp_path / "processed", profile=tmp_path / "lab.toml", jobs=1)
    assert (report.ingested, report.quarantined) == (1, ())
