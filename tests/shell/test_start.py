"""`pipeline start`: from a folder to a report, by what the data prove, and by questions in a terminal."""

import json
import re
import sys

import numpy as np
import pytest
from packed_sheets import xlsx
from places import docs_script
from wall_logs import wall_rows

from pipeline.profiles.profile_files import read_profile
from pipeline.store.storage import read_trials

WALLS = [(1.0, 3.0, 4.0), (1.5, 5.0, 6.0), (2.5, 8.0, 4.0), (3.0, 4.0, 6.0), (0.75, 6.0, 4.0)]


def write(folder, heading="Zeit [ms];Kraft [N];Weg [mm]", *, named="K{0:g}_B{1:g}", sheet="F0 [N]"):
    """Logs of a lab: cp1252, decimal commas, positions that fall; K and B in the names, steps in a sheet."""
    folder.mkdir()
    rows = []
    for number, (k, b, step) in enumerate(WALLS):
        samples = wall_rows(1e3 * k, b, step=step).tolist()
        lines = [f"{1e3 * t:.1f};{u:.9f};{-x:.9f}".replace(".", ",") for t, u, x in samples]
        name = f"run{number} {named.format(k, b)}".replace(".", ",") + ".csv"
        (folder / name).write_text("\n".join(["Prüfstand", heading, *lines, ""]), encoding="cp1252")
        rows.append([name, k, b, step])
    if sheet:
        cells = [";".join(str(cell).replace(".", ",") if cell != row[0] else cell for cell in row) for row in rows]
        head = f"Datei;Kw;Bw;{sheet}"
        (folder / "runs.csv").write_text("\n".join([head, *cells, ""]), encoding="cp1252")
    return rows


def walls_of(folder):
    rows = read_trials(folder / "processed").to_pylist()
    return sorted((row["stiffness"] / 1e3, row["damping"], row["step"]) for row in rows)


def test_a_folder_is_stored_by_what_its_data_prove(call, tmp_path):
    write(tmp_path / "bench")
    (tmp_path / "bench" / "README.md").write_text("x")
    status, out, err = call("start", "bench", "--yes", "--store-only")
    assert status == 0, err
    assert walls_of(tmp_path) == sorted(WALLS)
    assert "pipeline ingest bench --profile bench.toml" in out
    assert re.search(r"sheet +1 +runs\.csv", err)
    assert re.search(r"ignored +1 +README\.md", err)
    assert "the command pushes towards smaller numbers" in err
    profile = read_profile(tmp_path / "bench.toml")
    assert (profile.columns.position.sign, profile.units.stiffness, profile.constants.device) == (-1, "N/mm", "bench")
    # the printed command knows the logs
    assert json.loads(call("ingest", "bench", "--profile", "bench.toml", "--json")[1])["skipped"] == 5


def test_the_unit_of_a_sheet_is_proved_by_the_wall_law(call, tmp_path):
    write(tmp_path / "bench", named="x")
    status, _, err = call("start", "bench", "--yes", "--store-only")
    assert status == 0, err
    assert walls_of(tmp_path) == sorted(WALLS)
    assert "column 'Kw' of the sheet: agrees with 5 commands" in err


def test_a_workbook_is_a_sheet_too(call, tmp_path):
    pytest.importorskip("python_calamine")
    rows = write(tmp_path / "bench", named="x", sheet="")
    (tmp_path / "bench" / "runs.xlsx").write_bytes(xlsx([["Datei", "K", "B", "F0"], *rows]))
    status, _, err = call("start", "bench", "--yes", "--store-only")
    assert status == 0, err
    assert walls_of(tmp_path) == sorted(WALLS)


def write_turned(folder, walls, *, semicolon=()):
    """Logs of a motor in Nm, with angles in a unit that the heading states in German; K and B [SI] in the names."""
    folder.mkdir()
    for number, (k, b) in enumerate(walls):
        samples = wall_rows(k, b, step=4.0).tolist()
        rows = [f"{1e3 * t:.1f},{u:.9f},{np.degrees(x / 1e3):.9f}" for t, u, x in samples]
        text = "\n".join(["t [ms],M [Nm],Winkel [Grad]", *rows, ""])
        if number in semicolon:
            text = text.replace(",", ";").replace(".", ",")
        (folder / f"K{k:g}_B{b:g}.csv").write_text(text)


TURNED = [(600.0, 3.0), (800.0, 4.0), (1000.0, 5.0), (1200.0, 6.0), (1500.0, 4.0)]


def test_an_unknown_unit_in_a_heading_is_quoted_and_a_torque_moves_an_angle(call, tmp_path):
    write_turned(tmp_path / "motor", TURNED)
    status, _, err = call("start", "motor", "--yes", "--store-only")
    assert status == 2
    assert "columns.position.unit: the file states 'Grad', which is not a known unit. One of rad, mrad, " in err
    assert "Enter accepts" not in err


def test_logs_of_another_layout_are_named(call, tmp_path):
    write_turned(tmp_path / "motor", TURNED, semicolon=(1, 3))
    err = call("start", "motor", "--yes", "--store-only")[2]
    assert "warning: 2 of 5 inspected logs have a different layout, the first of them K1200_B6.csv." in err


@pytest.mark.skipif(sys.platform == "win32", reason="has no pseudo-terminals")
def test_a_unit_that_is_answered_settles_the_units_of_the_walls(tmp_path):
    write_turned(tmp_path / "motor", TURNED)
    status, shown, left = in_terminal(tmp_path, ["deg"], "motor", "--store-only")
    assert (status, left) == (0, []), shown
    rows = read_trials(tmp_path / "processed").to_pylist()
    assert sorted((row["stiffness"], row["damping"], row["step"]) for row in rows) == [(k, b, 4.0) for k, b in TURNED]


def test_what_is_open_is_listed_and_nothing_is_done(call, tmp_path):
    write(tmp_path / "bench", "Zeit;Kraft;Weg")
    status, out, err = call("start", "bench", "--yes")
    assert (status, out) == (2, "")
    assert "2 open questions:\n  columns.command.unit: " in err
    assert "columns.position.unit: " in err
    assert not (tmp_path / "processed").exists()
    assert not (tmp_path / "bench.toml").exists()


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("Kraft [N]", "Kraft [mN]", "'B' in the names is 1000 times the damping that the commands follow"),
        ("Weg [mm]", "Weg [m]", "Are the units of force, position and time in the files right"),
        ("F0 [N]", "F0 [mN]", "follows step"),
        ("Kraft [N];Weg [mm]", "Weg [mm];Kraft [N]", "open|obeys"),
    ],
)
def test_a_wrong_unit_is_stopped(call, tmp_path, old, new, told):
    write(tmp_path / "bench")
    for path in (tmp_path / "bench").iterdir():
        path.write_text(path.read_text(encoding="cp1252").replace(old, new), encoding="cp1252")
    status, _, err = call("start", "bench", "--yes", "--store-only")
    assert status in (1, 2)
    assert re.search(told, err)
    assert not (tmp_path / "processed").exists()


def many(folder):
    """Ten logs of walls, of which run7 has a stiffness in its name that its command does not obey."""
    folder.mkdir()
    for number in range(10):
        k, b = 0.8 + 0.3 * number, 3.0 + number
        rows = wall_rows(1e3 * k, b, step=4.0).tolist()
        name = f"run{number} K{10 * k if number == 7 else k:g}_B{b:g}.csv"
        (folder / name).write_text("\n".join(["t [s],F [N],x [mm]", *(",".join(map(repr, row)) for row in rows), ""]))


def test_a_log_that_contradicts_its_name_is_left_out_with_the_cure(call, tmp_path):
    many(tmp_path / "bench")
    status, out, err = call("start", "bench", "--yes", "--store-only")
    assert status == 3
    assert len(read_trials(tmp_path / "processed")) == 9
    assert "run7 K29_B10.csv: the command follows stiffness 2900, the header states 2.9e+04 (factor 0.1)" in err
    assert "If only this log is wrong: stiffness 2.9 N/mm in its name" in err
    assert out.startswith("Warning: 1 log omitted: run7 K29_B10.csv\n")
    assert "pipeline ingest bench --profile bench.toml --ignore 'run7 K29_B10.csv'" in out
    assert (
        json.loads(call("ingest", "bench", "--profile", "bench.toml", "--ignore", "run7*", "--json")[1])["skipped"] == 9
    )


def test_a_log_that_contradicts_its_name_is_named_by_a_comparison_and_not_used(call, tmp_path):
    many(tmp_path / "bench")
    call("start", "bench", "--yes", "--store-only")
    # whoever ingests it nevertheless
    assert call("ingest", "bench", "--profile", "bench.toml")[0] == 0
    assert len(read_trials(tmp_path / "processed")) == 10
    status, out, _ = call("compare", "--device", "bench", "--report", "r.html")
    assert status == 0
    (line,) = [line for line in out.splitlines() if "left out" in line]
    assert line.startswith(
        "Warning: 1 of 10 logs of experiment 1 left out, as its command obeys another wall than stated"
    )
    assert "run7 K29_B10.csv" in line
    assert "stiffness 2.9 N/mm in its name" in line
    document = json.loads((tmp_path / "r.json").read_text())["experiments"][0]
    assert sum(point["stable"] == 29000 for point in document["boundary"]) == 0


def test_logs_without_a_wall_are_identified(call, tmp_path):
    (tmp_path / "motor").mkdir()
    rng = np.random.default_rng(1)
    for number in range(4):
        force = np.repeat(rng.choice([-2.0, 0.0, 1.0, 3.0], 8), 50)
        x, v, lines = 0.0, 0.0, ["t [s],u [V],phi [rad]"]
        for row, u in enumerate(force):
            lines.append(f"{row / 1000:.3f},{u:g},{x + 1e-6 * rng.normal():.8f}")
            v += 1e-3 * (force[max(row - 2, 0)] - 0.4 * v) / 0.05
            x += 1e-3 * v
        (tmp_path / "motor" / f"run{number}.csv").write_text("\n".join([*lines, ""]))
    status, out, err = call("start", "motor", "--yes")
    assert status == 0, err
    assert re.search(r"inertia +0\.0[45]\d+ .* Vs\^2/rad", out)
    assert "pipeline identify motor --profile motor.toml --out motor-device.toml" in out


def test_native_logs_need_no_profile(call, tmp_path):
    from native_logs import log_text

    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "a.csv").write_text(log_text(300.0))
    status, out, _ = call("start", "logs", "--yes", "--store-only")
    assert status == 0
    assert "  pipeline ingest logs\n" in out
    assert call("start", "nowhere")[0] == 2


def in_terminal(folder, answers, *words):
    """Run start in a pseudo-terminal, as the docs do; returns exit status, what was shown, and answers left over."""
    return docs_script("make_tutorial").in_terminal(folder, ["start", *words], answers)


@pytest.mark.skipif(sys.platform == "win32", reason="has no pseudo-terminals")
def test_a_terminal_asks_what_is_open_and_enter_accepts(tmp_path):
    write(tmp_path / "bench", "Zeit;Kraft;Weg")
    status, shown, left = in_terminal(tmp_path, ["", "mm"], "bench", "--store-only")
    assert (status, left) == (0, []), shown
    assert "2 open questions. Enter accepts the proposal in brackets." in shown
    assert "columns.command.unit: the file does not state the unit." in shown
    assert walls_of(tmp_path) == sorted(WALLS)
    assert "To repeat these steps without questions:\n  pipeline ingest bench --profile bench.toml" in shown


@pytest.mark.skipif(sys.platform == "win32", reason="has no pseudo-terminals")
def test_a_wrong_answer_is_stopped_by_the_wall_law(tmp_path):
    write(tmp_path / "bench", "Zeit;Kraft;Weg")
    status, shown, _ = in_terminal(tmp_path, ["kN", "mm"], "bench", "--store-only")
    assert status in (1, 2)
    assert "follows step" in shown
    assert not (tmp_path / "processed").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="has no pseudo-terminals")
def test_what_a_command_obeys_may_be_taken_for_a_wrong_number(tmp_path):
    many(tmp_path / "bench")
    status, shown, left = in_terminal(tmp_path, ["y"], "bench", "--store-only")
    assert (status, left) == (0, []), shown
    assert (
        "1 log with a wrong number. Store the gains that the command follows? If not, the logs are omitted [y/N]: y"
        in shown
    )
    stored = {row["damping"]: row["stiffness"] for row in read_trials(tmp_path / "processed").to_pylist()}
    assert (len(stored), stored[10.0]) == (10, 2900.0)
    assert read_profile(tmp_path / "bench.toml").file[0].stiffness == 2.9
