"""Logs of a newcomer, by the commands of the tutorial: headings with units, no profile yet, then a wrong one."""

import json
import re
from pathlib import Path

import pytest
from native_logs import FAULTS
from wall_logs import wall_rows

from pipeline.base.units import unit_in_heading
from pipeline.intake.quarantine import list_quarantine
from pipeline.profiles.profile_files import find_questions
from pipeline.profiles.profile_model import QUANTITIES
from pipeline.shell.cli import run
from pipeline.shell.profile.draft import draft_profile
from pipeline.surface.log_picture import look

PROFILE = """name = "mine"
format = "delimited"
files = ["wall_K*_B*.csv"]
delimiter = ";"
decimal = "."
step_at = "command edge"
name_pattern = "K(?P<stiffness>[0-9]+).*B(?P<damping>[0-9]+)"
[columns]
time = { name = "t/ms", unit = "ms" }
command = { name = "F/N", unit = "N", sign = 1 }
position = { name = "x/mm", unit = "mm", sign = 1 }
[constants]
device = "mybench"
experiment = "1"
step = 1
sampling_period_s = 0.001
"""


def wall_log(stiffness, damping):
    """Return a log of a step of 1 N in row 20, T = 1 ms."""
    samples = wall_rows(stiffness, damping, step=1.0, mass=0.3, rows=300).tolist()
    return "\n".join(["t/ms;x/mm;F/N", *(f"{1e3 * t:.0f};{x:.12g};{force:.12g}" for t, force, x in samples), ""])


@pytest.fixture
def call(capsys, monkeypatch, tmp_path):
    """Run the command line where logs of three walls lie; returns exit status and all that was printed."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "logs").mkdir()
    for stiffness, damping in ((200, 5), (400, 0), (600, 10)):
        (tmp_path / "logs" / f"wall_K{stiffness}_B{damping}.csv").write_text(wall_log(stiffness, damping))
    (tmp_path / "mine.toml").write_text(PROFILE)

    def run_here(*arguments):
        with pytest.raises(SystemExit) as leaving:
            run([str(a) for a in arguments])
        return leaving.value.code or 0, "".join(capsys.readouterr())

    return run_here


@pytest.mark.parametrize(
    ("heading", "role", "expected"),
    [
        ("x/mm", "position", ("x", "mm")),
        ("x (mm)", "position", ("x", "mm")),
        ("x [mm]", "position", ("x", "mm")),
        ("x_mm", "position", ("x", "mm")),
        ("phi / °", "position", ("phi", "°")),
        ("Weg in mm", "position", ("Weg", "mm")),
        ("t/ms", "time", ("t", "ms")),
        ("time_s", "time", ("time", "s")),
        ("F/N", "command", ("F", "N")),
        ("tau_Nm", "command", ("tau", "Nm")),
        ("v_mm/s", "velocity", ("v", "mm/s")),
        ("v/(m/s)", "velocity", ("v", "m/s")),
        ("m_1", "position", ("m_1", "")),
        ("F_m", "command", ("F_m", "")),
        ("force/torque", "command", ("force/torque", "")),
        ("N/m", "position", ("N/m", "")),
        ("/arm/m", "position", ("/arm/m", "")),
    ],
)
def test_a_unit_behind_a_name_is_seen_and_a_ratio_is_none(heading, role, expected):
    assert unit_in_heading(heading, QUANTITIES[role].values()) == expected


def test_a_draft_says_what_the_file_says_and_suggests_each_column_once(call, tmp_path):
    text = draft_profile(tmp_path / "logs" / "wall_K600_B10.csv")
    assert 'files = ["wall_K*_B*.csv"]' in text
    assert re.findall(r'^(?:# )?name = "(.*/.*)"', text, re.MULTILINE) == ["t/ms", "F/N", "x/mm"]
    assert re.findall(r"the file states '(.*?)'", text) == ["ms", "N", "mm"]
    assert '\nunit = "ms" # the file states' in text
    assert find_questions(text) == []
    assert '\nstiffness = "N/m" # by the wall law of the command\n' in text
    pattern = json.loads(re.search(r'^name_pattern = (".*") # ', text, re.MULTILINE)[1])
    found = re.search(pattern, "wall_K1000.5_B20.csv")
    assert tuple(map(float, (found["stiffness"], found["damping"]))) == (1000.5, 20)


def test_time_is_what_rises(call, tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("".join(f"{line}\n" for line in ["pos;u;n", "0.5;1;0.0", "0.5;1;0.1", "0.6;1;0.2", "0.5;1;0.3"]))
    assert re.findall(r'^(?:# )?name = "(.|pos)"', draft_profile(path), re.MULTILINE) == ["a", "n", "u", "pos"]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('unit = "mm"', 'unit = "m"', '[columns.position] unit = "mm"'),
        ('unit = "N"', 'unit = "mN"', '[columns.command] unit = "N"'),
        ('unit = "N", sign = 1', 'unit = "N", sign = -1', "[columns.command] sign = 1"),
        ('unit = "mm", sign = 1', 'unit = "mm", sign = -1', "[columns.position] sign = 1"),
    ],
)
def test_the_wall_law_tells_a_wrong_unit_or_sign(call, tmp_path, old, new, said):
    status, out = call("profile", "check", "mine.toml", "logs")
    assert (status, "warning" in out) == (0, False)
    assert len(out.splitlines()) < 25
    assert "logs/wall_K400_B0.csv: 1 trial would be stored; K = 400, B = 0, 300 rows, step in row 20\n" in out
    assert " -0" not in out
    (tmp_path / "mine.toml").write_text(PROFILE.replace(old, new))
    status, out = call("profile", "check", "mine.toml", "logs")
    assert status == 1
    assert said in out
    samples = json.loads(call("profile", "check", "mine.toml", "logs", "--json")[1])["samples"]
    # each log says so, the first as well as the others
    assert all(said in trial["other_gains"] for sample in samples for trial in sample["trials"])
    assert ("but the file states" in out) == ('unit = "m' in new and "sign" not in new)


def test_equal_reasons_are_told_once_with_what_helps(call):
    hint = "Other columns? pipeline profile draft {}logs/wall_K200_B5.csv"
    status, out = call("ingest", "logs")
    lines = out.splitlines()
    assert (status, len(lines), lines[-1]) == (3, 4, hint.format(""))
    assert lines[2].startswith("3 logs, first logs/wall_K200_B5.csv, row 1: columns must be exactly ")
    _, out = call("quarantine")
    assert len(out.splitlines()) == 3
    assert "3 logs, first " in out
    assert "pipeline profile draft " in out
    assert len(json.loads(call("quarantine", "--json")[1])) == 3
    assert hint.format("") in look(Path("logs/wall_K200_B5.csv")).notes


def test_a_profile_that_does_not_fit_leaves_the_better_reason(call, tmp_path):
    text, _, _ = FAULTS["text cell"]
    (tmp_path / "logs" / "bad.csv").write_text(text)
    (tmp_path / "logs" / "wall_K9_B9.csv").write_text(text)
    call("ingest", "logs")
    before = {record.path: record for record in list_quarantine(tmp_path / "processed")}
    status, out = call("ingest", "logs", "--profile", "mine.toml")
    assert (status, out.splitlines()[1].split()) == (3, ["5", "3", "0", "2"])
    after = list_quarantine(tmp_path / "processed")
    assert after == [before[record.path] for record in after]
    assert len(after) == 2
