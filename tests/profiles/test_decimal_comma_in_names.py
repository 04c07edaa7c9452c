"""Numbers in file names with a decimal comma: read whole, or refused where they could mean two numbers."""

import re

import numpy as np
import pytest
from wall_logs import profile_text, wall_log

from pipeline.base.errors import ParameterError
from pipeline.intake.ingest import ingest
from pipeline.profiles.profile_files import read_profile
from pipeline.profiles.profile_model import conditions_in_name, number_in_name
from pipeline.shell.profile.check import check_samples
from pipeline.shell.profile.draft import draft_profile
from pipeline.store.storage import read_trials

PATTERNS = (
    r"K(?P<stiffness>[0-9.]+)_B(?P<damping>[0-9.]+)",
    r"K(?P<stiffness>[0-9]+[.]?[0-9]*).*B(?P<damping>[0-9]+[.]?[0-9]*)",
    r"K(?P<stiffness>\d+).*B(?P<damping>\d+)",
    r"K(?P<stiffness>[^_]+)_B(?P<damping>[0-9.,]+)",
    r"K(?P<stiffness>[0-9,]+)_B(?P<damping>[0-9]+)",
)


def stored(folder, name, pattern, decimal="."):
    """Stiffness and damping of a log under a name, or why it is refused."""
    (folder / "logs").mkdir()
    (folder / "logs" / name).write_text(wall_log(2500.0, 4.0, rows=60))
    text = re.sub("(?m)^name_pattern.*$", lambda _: f"name_pattern = '{pattern}'", profile_text(unit="N/mm"))
    (folder / "lab.toml").write_text(text.replace('decimal = "."', f'decimal = "{decimal}"'))
    report = ingest([folder / "logs"], folder / "processed", folder / "lab.toml", jobs=1)
    if report.quarantined:
        return report.quarantined[0].reason
    table = read_trials(folder / "processed")
    return table.column("stiffness")[0].as_py() / 1e3, table.column("damping")[0].as_py()


@pytest.mark.parametrize("pattern", PATTERNS)
def test_any_pattern_reads_a_decimal_comma_whole(pattern):
    rng = np.random.default_rng(len(pattern))
    for k, b in rng.uniform((0.5, 0.1), (4000.0, 60.0), (40, 2)):
        stiffness, damping = f"{k:.{rng.integers(1, 3)}f}", f"{b:.{rng.integers(1, 3)}f}"
        name = f"run_K{stiffness}_B{damping}.csv".replace(".", ",", 2)
        found = conditions_in_name(pattern, name)
        assert [number_in_name(found[key]) for key in ("stiffness", "damping")] == [float(stiffness), float(damping)]


@pytest.mark.parametrize(
    ("name", "pattern", "expected"),
    [
        ("K300,2.csv", r"K(?P<stiffness>[0-9.]+),(?P<damping>[0-9.]+)", ("300", "2")),
        ("K300,B2.csv", r"K(?P<stiffness>[0-9.]+),B(?P<damping>[0-9.]+)", ("300", "2")),
        ("K2,5,0,1.csv", r"K(?P<stiffness>[0-9]+,[0-9]+),(?P<damping>[0-9.,]+)", ("2,5", "0,1")),
        ("7,K2,5_B-0,1.csv", r"K(?P<stiffness>[0-9.]+)_B(?P<damping>-?[0-9.]+)", ("2,5", "-0,1")),
        ("K2.5_B0.1.csv", r"K(?P<stiffness>[0-9.]+)_B(?P<damping>[0-9.]+)", ("2.5", "0.1")),
        ("é2,K2,5_B0,1", r"K(?P<stiffness>[0-9.]+)_B(?P<damping>[0-9.]+)", ("2,5", "0,1")),
    ],
)
def test_a_comma_that_the_pattern_asks_for_is_a_separator(name, pattern, expected):
    found = conditions_in_name(pattern, name)
    assert (found["stiffness"], found["damping"]) == expected


def test_a_number_that_begins_behind_a_comma_is_refused():
    with pytest.raises(ParameterError, match="omits '2,' before it"):
        conditions_in_name(r"(?P<stiffness>[0-9.]+)N", "K2,5N.csv")
    assert conditions_in_name(r"2,(?P<stiffness>[0-9.]+)N", "K2,5N.csv") == {"stiffness": "5"}


def test_an_experiment_is_no_number():
    assert conditions_in_name(r"E(?P<experiment>[0-9]+)", "E1,2.csv") == {"experiment": "1"}


@pytest.mark.parametrize("text", ["1.000,5", "1,000.5", "1,000,000", "1.000.000", "12,345", "-1,000"])
def test_separators_of_thousands_are_refused(text):
    with pytest.raises(ParameterError, match="may separate thousands"):
        number_in_name(text)


def test_three_digits_are_clear_by_the_sign_of_the_profile():
    assert (number_in_name("1.250"), number_in_name("0,125"), number_in_name("1,2345")) == (1.25, 0.125, 1.2345)
    assert number_in_name("1,250", ",") == 1.25
    with pytest.raises(ParameterError, match="the point may separate thousands"):
        number_in_name("1.250", ",")


@pytest.mark.parametrize(
    ("name", "decimal", "expected"),
    [
        ("K2,5_B4.txt", ".", (2.5, 4.0)),
        ("K2,5_B0,1.txt", ".", (2.5, 0.1)),
        ("K2.5_B4,25.txt", ".", (2.5, 4.25)),
        ("K1.000,5_B4.txt", ".", "may separate thousands"),
        ("K1,000_B4.txt", ".", "may separate thousands"),
    ],
)
def test_a_log_is_stored_with_the_wall_of_its_name(tmp_path, name, decimal, expected):
    pattern = r"K(?P<stiffness>[0-9.]+).*B(?P<damping>[0-9.]+)"
    found = stored(tmp_path, name, pattern, decimal)
    if isinstance(expected, str):
        assert expected in found
        assert name in found or "stiffness" in found
    else:
        assert found == pytest.approx(expected)


def test_names_that_differ_in_the_decimal_sign_are_one_trial(tmp_path):
    (tmp_path / "logs").mkdir()
    for name in ("K2,5_B4.txt", "K2.5_B4.txt"):
        (tmp_path / "logs" / name).write_text(wall_log(2500.0, 4.0, rows=60))
    (tmp_path / "lab.toml").write_text(profile_text(unit="N/mm"))
    report = ingest([tmp_path / "logs"], tmp_path / "processed", tmp_path / "lab.toml", jobs=1)
    assert (report.ingested, report.skipped) == (1, 1)


def test_a_draft_takes_the_decimal_comma_of_names(tmp_path):
    for k in (2.5, 0.75):
        (tmp_path / f"K{k:g}_B4,5.txt".replace(".", ",", 1)).write_text(wall_log(1e3 * k, 4.5))
    samples = sorted(tmp_path.glob("*.txt"))
    lines = []
    for line in draft_profile(*samples).splitlines():
        lines.append(line.removeprefix("# ") if lines and lines[-1].startswith("# QUESTION") else line)
    (tmp_path / "lab.toml").write_text("\n".join(lines).replace('"m"', '"mm"'))
    profile = read_profile(tmp_path / "lab.toml")
    for sample in check_samples(profile, samples):
        assert sample["reason"] is None
        (trial,) = sample["trials"]
        assert trial["other_gains"] is None
        values = {c["name"]: c["value"] for c in trial["conditions"]}
        assert values["stiffness"] == pytest.approx(750.0 if "0,75" in sample["path"] else 2500.0)
        assert values["damping"] == pytest.approx(4.5)
