"""Conditions that stand inside files: in attributes of groups, columns of a long table, lines above a table."""

import re

import pytest
from wall_logs import wall_log, wall_rows

from pipeline.profiles.profile_files import find_questions, read_profile
from pipeline.shell.profile.conditions import factor_of, proved_unit
from pipeline.shell.profile.draft import draft_profile
from pipeline.store.storage import read_trials

WALLS = [(0.8, 3.0, 4.0), (1.5, 5.0, 6.0), (2.5, 8.0, -4.0), (3.0, 4.0, 6.0), (0.6, 6.0, 4.0)]
"""Stiffness [N/mm], damping [Ns/m], step [N]."""


def rows_of(wall):
    return wall_rows(1e3 * wall[0], wall[1], step=wall[2])


def stored(folder):
    rows = read_trials(folder / "processed").to_pylist()
    return sorted((round(row["stiffness"] / 1e3, 9), row["damping"], row["step"]) for row in rows)


def long_table(path):
    lines = [
        f"{number};{';'.join(map(str, wall))};{t:.3f};{u!r};{x!r}"
        for number, wall in enumerate(WALLS)
        for t, u, x in rows_of(wall).tolist()
    ]
    path.write_text("\n".join(["run;Kw;Bw;F0;t [s];F [N];x [mm]", *lines, ""]))


def test_a_long_table_is_parted_where_its_time_begins_again(call, tmp_path):
    (tmp_path / "bench").mkdir()
    long_table(tmp_path / "bench" / "all.csv")
    text = draft_profile(tmp_path / "bench" / "all.csv")
    assert 'trial_column = "run" # time restarts where this column changes: 5 trials' in text
    assert find_questions(text) == []
    status, _, err = call("start", "bench", "--yes", "--store-only")
    assert status == 0, err
    assert stored(tmp_path) == sorted(WALLS)
    profile = read_profile(tmp_path / "bench.toml")
    assert profile.condition_columns == {"stiffness": "Kw", "damping": "Bw", "step": "F0"}
    assert profile.units.stiffness == "N/mm"


def test_a_table_of_one_trial_has_no_trial_column(tmp_path):
    rows = [line for line in wall_log(800.0, 3.0).splitlines() if line[0].isdigit()]
    (tmp_path / "a.csv").write_text("\n".join(["run;t;F;x", *(f"1;{row}" for row in rows), ""]))
    assert "trial_column" not in draft_profile(tmp_path / "a.csv")


def test_walls_of_groups_are_their_attributes_and_never_the_first_ones(call, tmp_path):
    h5py = pytest.importorskip("h5py")
    (tmp_path / "bench").mkdir()
    with h5py.File(tmp_path / "bench" / "a.h5", "w") as file:
        for number, wall in enumerate(WALLS):
            group = file.create_group(f"trial{number}")
            group.attrs.update(dict(zip(("gain", "damp", "force"), wall, strict=True)))
            for name, values in zip(("t [s]", "F [N]", "x [mm]"), rows_of(wall).T, strict=True):
                group[name] = values
    text = draft_profile(tmp_path / "bench" / "a.h5")
    assert re.search(r'\[attributes\]\nstiffness = "gain" # its numbers agree with 5 commands', text)
    assert "[constants]\ndevice" in text
    assert not re.search(r"^(stiffness|damping|step) = [\d.]", text, re.MULTILINE)
    status, _, err = call("start", "bench", "--yes", "--store-only")
    assert status == 0, err
    assert stored(tmp_path) == sorted(WALLS)


def test_lines_above_a_table_are_conditions_in_the_unit_that_they_state(call, tmp_path):
    (tmp_path / "bench").mkdir()
    for number, (k, b, step) in enumerate(WALLS):
        table = [";".join(map(repr, row)) for row in rows_of((k, b, step)).tolist()]
        head = [f"Wall: {k} N/mm", f"Damper: {b}", f"Push: {step} N", "t [s];F [N];x [mm]"]
        (tmp_path / "bench" / f"run{number}.csv").write_text("\n".join([*head, *table, ""]))
    status, _, err = call("start", "bench", "--yes", "--store-only")
    assert status == 0, err
    assert stored(tmp_path) == sorted(WALLS)
    attributes = read_profile(tmp_path / "bench.toml").attributes
    assert attributes == {"stiffness": "Wall", "damping": "Damper", "step": "Push"}


def test_units_that_are_answered_show_those_of_a_sheet(tmp_path):
    """Numbers of a sheet in Nm/rad, where the columns have no units."""
    from pipeline.shell.start import look_at, made_profile, propose, with_units

    (tmp_path / "knob").mkdir()
    sheet = ["file,gain,damp,push"]
    for number, wall in enumerate(WALLS):
        lines = [" ".join(map(repr, row)) for row in (rows_of(wall) * [1, 1, 1e-3]).tolist()]
        (tmp_path / "knob" / f"run{number}.txt").write_text("\n".join(["time torque angle", *lines, ""]))
        sheet.append(f"run{number},{1e3 * wall[0]},{wall[1]},{wall[2]}")
    (tmp_path / "knob" / "sheet.csv").write_text("\n".join([*sheet, ""]))
    proposal = propose(look_at(tmp_path / "knob"))
    assert set(proposal.open) == {"columns.command.unit", "columns.position.unit"}
    answers = {"columns.command.unit": "Nm", "columns.position.unit": "rad"}
    again = propose(with_units(proposal, answers)).answered(answers)
    assert again.open == {}
    profile = made_profile(again)
    assert (profile.units.stiffness, profile.units.damping, profile.units.step) == ("Nm/rad", "Nms/rad", "Nm")


def test_a_factor_needs_most_numbers_and_ignores_what_is_not_seen():
    assert factor_of([1.0, 2.0, 3.0, 4.0, 50.0], [10.0, 20.0, 30.0, 40.0, 50.0]) == 10.0
    assert factor_of([1.0, 2.0, 3.0], [10.0, 20.0, 3.0]) is None
    # a damping that makes no part of the command that is seen
    assert factor_of([1.0, 2.0, 3.0], [1.0, 0.0, 3.0]) == 1.0
    assert factor_of([1.0, 2.0, 3.0], [1.0, 0.0, 0.0]) is None
    assert factor_of([-1.0, 2.0], [1.0, 2.0]) is None
    assert proved_unit([1.0, 2.0], [1e3, 2e3], "stiffness", "translation") == "N/mm"
    assert proved_unit([1.0, 2.0], [7.0, 14.0], "stiffness", "translation") is None
