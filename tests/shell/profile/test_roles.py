"""Which column is what: by remarks, stated units, rates and the trials of a file."""

import json
import re

import numpy as np
import pytest

from pipeline.profiles.profile_files import find_questions, read_profile
from pipeline.shell.profile.check import check_samples
from pipeline.shell.profile.draft import draft_profile

TIME = np.arange(120) * 0.01


def asked(text):
    return [".".join(map(str, question.place)) for question in find_questions(text)]


def motion(force):
    """Position and velocity of a mass of 0.4 with damping of 3 from rest, in steps that are short for it."""
    speed = force / 3 * (1 - np.exp(-3 / 0.4 * TIME))
    return force / 3 * (TIME - 0.4 / 3 * (1 - np.exp(-3 / 0.4 * TIME))), speed


def both_ways(**more):
    """A document whose two trials are lists of rows: time, command, position, velocity."""
    trials = {"up": 5.0, "down": -5.0}
    rows = {name: np.column_stack([TIME, np.full(120, u), *motion(u)]).tolist() for name, u in trials.items()}
    return {**more, **rows}


def test_trials_as_lists_of_rows_ask_the_unit_of_the_command_alone(tmp_path):
    path = tmp_path / "both.json"
    path.write_text(json.dumps(both_ways(units="Rotations")))
    text = draft_profile(path)
    assert asked(text) == ["columns.command.unit"]
    assert 'name = "[1]" # constant in each trial of the file, and different between trials' in text
    assert "unit = \"Rotations\" # 'units' in the file is 'Rotations'" in text
    text = re.sub(r'# QUESTION.*\n# unit = "N"', 'unit = "V"', text)
    (tmp_path / "lab.toml").write_text(text)
    (sample,) = check_samples(read_profile(tmp_path / "lab.toml"), [path])
    trials = {trial["label"]: {c["column"]: c for c in trial["columns"]} for trial in sample["trials"]}
    assert [*trials] == ["up", "down"]
    assert trials["down"]["command"]["last"] == -5
    assert trials["up"]["position"]["last"] == pytest.approx(2 * np.pi * motion(5.0)[0][-1])
    assert trials["up"]["time"]["last"] == pytest.approx(1.19)


def test_the_velocity_shows_the_unit_of_the_stamps(tmp_path):
    for factor, unit in ((1.0, "s"), (1e3, "ms")):
        document = both_ways()
        for name in ("up", "down"):
            document[name] = [[factor * t, u, x, v] for t, u, x, v in document[name]]
        (tmp_path / "a.json").write_text(json.dumps(document))
        text = draft_profile(tmp_path / "a.json")
        assert f'unit = "{unit}" # ' in text
        assert asked(text) == ["columns.command.unit", "columns.position.unit"]


def test_two_devices_at_the_same_time_are_no_trials(tmp_path):
    position, speed = motion(5.0)
    force = 5.0 * (TIME > 0.1)
    parts = {"arm": (force, position, speed), "leg": (2 * force, -2 * position, -speed)}
    document = {name: np.column_stack([TIME, *columns]).tolist() for name, columns in parts.items()}
    (tmp_path / "a.json").write_text(json.dumps(document))
    assert "each group" not in draft_profile(tmp_path / "a.json")
    # the same columns at other times are trials
    document["leg"] = [[row[0] + 7.5, *row[1:]] for row in document["leg"]]
    (tmp_path / "a.json").write_text(json.dumps(document))
    assert 'trials = "each group" # 2 groups have the same columns: arm, ...' in draft_profile(tmp_path / "a.json")


@pytest.mark.parametrize("reference", ["desired", "x_ref", "Soll"])
def test_what_was_wanted_is_no_trial(tmp_path, reference):
    position, speed = motion(5.0)
    rows = np.column_stack([TIME, np.full(120, 5.0), position, speed])
    later = rows + np.array([0.003, 1.0, 0.0, 0.0])
    (tmp_path / "a.json").write_text(json.dumps({"measured": rows.tolist(), reference: later.tolist()}))
    assert "each group" not in draft_profile(tmp_path / "a.json")
    (tmp_path / "a.json").write_text(json.dumps({"measured": rows.tolist(), "again": later.tolist()}))
    assert "each group" in draft_profile(tmp_path / "a.json")


def test_names_and_units_in_remarks_are_those_of_the_columns(tmp_path):
    force = 0.25 * (TIME > 0.1)
    rows = [f"{t * 1e3:.1f},{u},{x:.4f},{v:.3f};" for t, u, x, v in zip(TIME, force, *motion(1.0), strict=True)]
    head = ["%Date:,29/04/2021", "", "%step,voltage,position,velocity", "%[#],[V],[turns],[turns/s]"]
    (tmp_path / "run1.csv").write_text("\n".join([*head, *rows, ""]))
    text = draft_profile(tmp_path / "run1.csv")
    assert asked(text) == []  # 10 ms: the velocity shows it
    assert "the file states 'voltage [V]'" in text
    (tmp_path / "lab.toml").write_text(text)
    (sample,) = check_samples(read_profile(tmp_path / "lab.toml"), [tmp_path / "run1.csv"])
    columns = {column["column"]: column for column in sample["trials"][0]["columns"]}
    assert columns["position"]["last"] == pytest.approx(2 * np.pi * motion(1.0)[0][-1], abs=1e-3)
    assert columns["command"]["unit"] == "V"


def test_a_supply_in_volts_is_no_command(tmp_path):
    supply = 12.4 + 0.1 * (np.arange(120) % 7 == 3)
    lines = [f"{t:.3f},{v:.1f},{x:.6f},{int(t > 0.5)}" for t, v, x in zip(TIME, supply, motion(1.0)[0], strict=True)]
    (tmp_path / "a.csv").write_text("\n".join(["timestamp,input_volts,position,torque_enable", *lines, ""]))
    text = draft_profile(tmp_path / "a.csv")
    assert "columns.command.name" in asked(text)
    assert "columns.position.name" not in asked(text)


def test_of_two_columns_the_first_to_change_and_stay_is_the_command(tmp_path):
    (tmp_path / "a.csv").write_text("0.000,0,0.1\n0.001,1,0.1\n0.002,1,0.1\n0.003,1,0.2\n")
    text = draft_profile(tmp_path / "a.csv")
    assert asked(text) == ["columns.command.unit", "columns.position.unit"]
    # a reading that flickers before is none
    (tmp_path / "a.csv").write_text("0.000,0.1,0\n0.001,0.2,0\n0.002,0.1,1\n0.003,0.1,1\n0.004,0.2,1\n")
    assert "columns.command.column" in asked(draft_profile(tmp_path / "a.csv"))
