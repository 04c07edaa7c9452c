"""Kinds of trials that a profile names: release, hit, free motion, staircase; found by the draft, judged, checked."""

import json
import re

import numpy as np
import pytest
from released import WAYS, walls

from pipeline.base.errors import ProfileError
from pipeline.profiles.profile_files import find_questions, read_profile
from pipeline.shell.profile.draft import draft_profile
from pipeline.store.storage import read_trials


def write(folder, way):
    """Logs of a lab with K and B in their names; returns trials and spectral radii."""
    folder.mkdir()
    trials, radius = walls("falcon", way)
    for number in range(len(radius)):
        trial = trials[number]
        table = np.column_stack([1e3 * trial.time, trial.command, 1e3 * trial.position]).tolist()
        lines = [f"{t:.3f};{u:.9g};{x:.9g}" for t, u, x in table]
        name = f"K{trial.stiffness / 1e3:g}_B{trial.damping:g}.csv"
        (folder / name).write_text("\n".join(["Zeit [ms];Kraft [N];Weg [mm]", *lines, ""]))
    return trials, radius


@pytest.mark.sampled
@pytest.mark.parametrize("way", WAYS)
def test_a_release_or_hit_is_found_by_the_draft_and_judged_by_its_motion(call, tmp_path, way):
    kind = "release" if "released" in way else "hit"
    _, radius = write(tmp_path / "bench", way)
    status, _, err = call("start", "bench", "--yes", "--store-only")
    assert status == 0, err
    assert f'"{kind}"' in err
    profile = read_profile(tmp_path / "bench.toml")
    assert (profile.kind, profile.units.stiffness, profile.step_at) == (kind, "N/mm", None)
    stored = read_trials(tmp_path / "processed").to_pylist()
    assert {row["step"] for row in stored} == {0.0}
    assert sorted(row["stiffness"] for row in stored) == [200, 500, 900, 6000, 12000]
    assert call("compare", "--device", "bench", "--report", "r.html")[0] == 0
    found = json.loads((tmp_path / "r.json").read_text())["experiments"][0]["verdicts"]
    assert (found.get("stable", 0), found.get("unstable", 0)) == (int((radius < 1).sum()), int((radius > 1).sum()))


@pytest.mark.parametrize("way", WAYS)
def test_a_draft_of_one_log_reads_it(tmp_path, way):
    write(tmp_path / "bench", way)
    log = next((tmp_path / "bench").glob("K0.5_*.csv"))
    text = draft_profile(log)
    kind = "release" if "released" in way else "hit"
    assert re.search(rf'^kind = "{kind}" # the device ', text, re.MULTILINE)
    assert "step" not in text.partition("[columns.time]")[2]
    assert find_questions(text) == []


def test_a_step_from_any_position_is_no_release(tmp_path):
    from wall_logs import wall_log

    lines = [line.split(";") for line in wall_log(1500.0, 5.0).splitlines()[1:]]
    moved = [f"{t},{u},{float(x) + 0.37}" for t, u, x in lines]
    (tmp_path / "a.csv").write_text("\n".join(["t [s],F [N],x [mm]", *moved, ""]))
    text = draft_profile(tmp_path / "a.csv")
    assert "kind" not in text
    assert "step = 8.0 # by the wall law" in text


@pytest.mark.parametrize("way", WAYS)
def test_another_wall_than_stated_is_named_where_there_is_no_step(call, tmp_path, way):
    write(tmp_path / "bench", way)
    (tmp_path / "bench" / "K0.5_B20.csv").rename(tmp_path / "bench" / "K50_B20.csv")
    options = ("--time", "Zeit [ms]", "--command", "Kraft [N]", "--position", "Weg [mm]", "--device", "bench")
    walls_of = ("--stiffness", "K:N/mm", "--damping", "B:Ns/m", "--kind", "hit" if "hit" in way else "release")
    status, _, err = call("ingest", "bench", *options, *walls_of)
    assert status == 1
    assert "K50_B20.csv: the command follows stiffness 500, the options state 5e+04 (factor 0.01)" in err


PROFILE = """
name = "lab"
format = "delimited"
files = ["*.csv"]
delimiter = ";"
decimal = "."
kind = "KIND"
columns.time = { name = "t", unit = "s" }
columns.command = { name = "F", unit = "N", sign = 1 }
columns.position = { name = "x", unit = "m", sign = 1 }
[constants]
device = "bench"
experiment = "1"
sampling_period_s = 0.001
"""


@pytest.mark.parametrize(
    ("kind", "more", "message"),
    [
        (
            "hit",
            "stiffness = 100\ndamping = 2\nstep = 4",
            "'constants.step': step: a trial of kind 'hit' has no such condition",
        ),
        ("free", "stiffness = 100", "'constants.stiffness': stiffness: a trial of kind 'free' has no such condition"),
        ("release", "stiffness = 100", "'constants.damping': missing"),
        ("bang", "", "Input should be 'step', 'release', 'hit', 'free' or 'staircase'|'bang'"),
    ],
)
def test_conditions_that_a_kind_has_not_are_refused(tmp_path, kind, more, message):
    (tmp_path / "lab.toml").write_text(PROFILE.replace("KIND", kind) + more)
    with pytest.raises(ProfileError, match=message):
        read_profile(tmp_path / "lab.toml")


def test_a_stated_row_of_a_step_is_none_of_a_release(tmp_path):
    text = PROFILE.replace("KIND", "release").replace("columns.time", 'step_at = "first row"\ncolumns.time')
    (tmp_path / "lab.toml").write_text(text + "stiffness = 100\ndamping = 2\n")
    with pytest.raises(ProfileError, match="'step_at': a trial of kind 'release' has no declared step"):
        read_profile(tmp_path / "lab.toml")


def test_a_kind_that_the_motion_contradicts_is_warned_of(call, tmp_path):
    trials, _ = walls("falcon", "hit by the controller")
    trial = trials[0]
    lines = [f"{t:.4f};{u:.9g};{x:.9g}" for t, u, x in zip(trial.time, trial.command, trial.position, strict=True)]
    (tmp_path / "a.csv").write_text("\n".join(["t;F;x", *lines, ""]))
    walls_of = f"stiffness = {trial.stiffness}\ndamping = {trial.damping}\n"
    for kind, told in (("release", True), ("hit", False)):
        (tmp_path / "lab.toml").write_text(PROFILE.replace("KIND", kind) + walls_of)
        _, out, _ = call("profile", "check", "lab.toml", "a.csv")
        assert ("kind is 'release', but the log shows a hit. Check which of the two is right" in out) == told
        assert "none: the device is hit at 0.012 s" in out


def stairs(levels, rows=60):
    """Rows of a mass of 0.5 with damping of 4 that follows a force that is constant between steps."""
    force = np.repeat(np.array(levels, float), rows)
    speed = place = 0.0
    lines = ["t;F;x"]
    for row, u in enumerate(force.tolist()):
        lines.append(f"{row / 1000:.3f};{u:g};{place:.12g}")
        speed += 1e-3 * (u - 4 * speed) / 0.5
        place += 1e-3 * speed
    return "\n".join([*lines, ""])


def test_each_step_of_a_staircase_is_a_trial(call, tmp_path):
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "a.csv").write_text(stairs([0, 1, 3, -2]))
    text = draft_profile(tmp_path / "logs" / "a.csv")
    assert 'kind = "staircase" # no wall law was found, and the command has at most 3 steps' in text
    (tmp_path / "lab.toml").write_text(PROFILE.replace("KIND", "staircase"))
    assert call("ingest", "logs", "--profile", "lab.toml")[0] == 0
    rows = read_trials(tmp_path / "processed").to_pylist()
    assert sorted((row["label"], row["stiffness"], row["step"]) for row in rows) == [
        ("1", 0, 1),
        ("2", 0, 2),
        ("3", 0, -5),
    ]
    # identified as one motion: parts share rows
    found = json.loads(call("identify", "logs", "--profile", "lab.toml", "--json")[1])
    assert found["trials"] == 1


def test_a_command_that_goes_on_to_change_is_free_and_no_staircase(call, tmp_path):
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "a.csv").write_text(stairs(np.sin(np.arange(300) / 9), rows=1))
    assert 'kind = "free" # no wall law was found in the command' in draft_profile(tmp_path / "logs" / "a.csv")
    (tmp_path / "lab.toml").write_text(PROFILE.replace("KIND", "staircase"))
    status, out, err = call("ingest", "logs", "--profile", "lab.toml")
    assert (status, "the command changes 299 times, so the log is not split into steps" in out + err) == (0, True)
    (row,) = read_trials(tmp_path / "processed").to_pylist()
    assert (row["stiffness"], row["damping"], row["step"]) == (0, 0, 0)
