"""Sheets with one row a log: which column names the logs, what each cell gives, and what is refused."""

import json
import re
from pathlib import Path

import pytest
from packed_sheets import ods, xlsx
from wall_logs import wall_log

from pipeline.base.errors import ProfileError
from pipeline.profiles.profile_files import load_profile
from pipeline.readers.sheets import read_sheet, with_sheet
from pipeline.store.storage import read_trials

WALLS = {"run_a.txt": (1.0, 3.0, 8.0), "run_b.txt": (1.5, 5.0, 8.0), "run_c.txt": (2.5, 8.0, 6.0)}
ROWS = [["Nr", "Datei", "K [N/mm]", "B [Ns/m]", "F0 [N]", "note"]]
ROWS += [[i, name.removesuffix(".txt"), k, b, f, "ok"] for i, (name, (k, b, f)) in enumerate(WALLS.items(), start=1)]
PROFILE = """name = "lab"
format = "delimited"
files = ["*.txt"]
delimiter = ";"
decimal = "."
step_at = "command edge"
columns.time = { name = "t", unit = "s" }
columns.command = { name = "F", unit = "N", sign = 1 }
columns.position = { name = "x", unit = "mm", sign = 1 }
[constants]
device = "bench"
experiment = "1"
sampling_period_s = 0.001
[sheet]
file = "runs.csv"
"""


def text(rows, delimiter=";", decimal=","):
    cells = (
        (str(cell).replace(".", decimal) if isinstance(cell, float) else str(cell) for cell in row) for row in rows
    )
    return "\n".join(delimiter.join(f'"{c}"' if delimiter in c else c for c in row) for row in cells) + "\n"


@pytest.fixture
def lab(tmp_path):
    (tmp_path / "logs").mkdir()
    for name, (k, b, step) in WALLS.items():
        (tmp_path / "logs" / name).write_text(wall_log(1e3 * k, b, step=step))
    (tmp_path / "logs" / "runs.csv").write_text(text(ROWS))
    (tmp_path / "logs" / "lab.toml").write_text(PROFILE)
    return tmp_path


def read(lab, rows=ROWS, profile=PROFILE, **how):
    (lab / "logs" / "runs.csv").write_text(text(rows, **how))
    (lab / "logs" / "lab.toml").write_text(profile)
    return with_sheet(load_profile(lab / "logs" / "lab.toml"), list(WALLS))[0]


def walls_of(profile):
    return {entry.match: (entry.stiffness, entry.damping, entry.step) for entry in profile.file}


@pytest.mark.parametrize(("delimiter", "decimal"), [(";", ","), (",", "."), ("\t", ","), ("|", "."), (",", ",")])
def test_a_sheet_of_any_layout_gives_the_conditions_of_each_log(lab, delimiter, decimal):
    profile = read(lab, delimiter=delimiter, decimal=decimal)
    assert walls_of(profile) == WALLS
    assert profile.units.stiffness == "N/mm"
    assert profile.sheet is None


@pytest.mark.parametrize(("ending", "write"), [(".xlsx", xlsx), (".ods", ods)])
def test_workbooks_are_read_as_csv_is(lab, ending, write):
    pytest.importorskip("python_calamine")
    (lab / "logs" / f"runs{ending}").write_bytes(write(ROWS))
    profile = read(lab, profile=PROFILE.replace("runs.csv", f"runs{ending}"))
    assert walls_of(profile) == WALLS
    table = read_sheet(lab / "logs" / f"runs{ending}")
    assert (table.names[1], table.first_row, table.rows[0][1:4]) == ("Datei", 2, ("run_a", 1.0, 3.0))


def test_a_title_above_the_names_and_blank_rows_are_no_rows(lab):
    rows = [["Versuche 2026"], [""], *ROWS, ["", "", "", "", "", ""]]
    assert walls_of(read(lab, rows)) == WALLS


def test_paths_in_cells_are_names(lab):
    rows = [ROWS[0], *([n, rf"C:\data\{name}.txt", *more] for n, name, *more in ROWS[1:])]
    assert walls_of(read(lab, rows)) == WALLS


def test_a_mapping_names_column_condition_and_unit(lab):
    rows = [["file", "gain", "loss", "push"], *([name, k, b, f] for _, name, k, b, f, _ in ROWS[1:])]
    mapping = 'columns = ["gain:stiffness:N/mm", "loss:damping:Ns/m", "push:step:N"]\n'
    assert walls_of(read(lab, rows, PROFILE + mapping)) == WALLS


@pytest.mark.parametrize(
    ("old", "new", "profile", "message"),
    [
        ("K [N/mm]", "K", "", r"column 'K' has no unit. Write the unit after the name, \"K \[N/mm\]\""),
        ("run_a", "run_b", "", r"row 3 \(run_b\): row 2 also names this log"),
        ("run_", "walk_", "", "no column of the sheet names the logs .such as run_a.txt.. Columns: Nr, Datei"),
        ("1,5", "x", "", r"row 3 \(run_b\): the stiffness is 'x'; expected a number"),
        ("1,5", "1.500,5", "", "points and commas may separate thousands"),
        ("note", "Datei", "", "names 'Datei' twice"),
        ("", "", 'name = "File"', "no column 'File'. Columns: Nr, Datei"),
        ("", "", 'columns = ["K:stiffness:N/mm"]', "names no column of the sheet"),
        ("", "", 'columns = ["Nr:weight"]', "'weight' is not a condition; expected one of device"),
        ("", "", 'columns = ["Nr:stiffness:kg"]', "'kg' is not a unit of the stiffness"),
        ("K [N/mm]", "K [kg]", "", "units.stiffness.*'kg' is not known|has no unit"),
    ],
)
def test_a_sheet_that_does_not_fit_is_refused_with_its_row_or_column(lab, old, new, profile, message):
    (lab / "logs" / "runs.csv").write_text(text(ROWS).replace(old, new) if old else text(ROWS))
    (lab / "logs" / "lab.toml").write_text(PROFILE + profile)
    with pytest.raises(ProfileError, match=message):
        with_sheet(load_profile(lab / "logs" / "lab.toml"), list(WALLS))


@pytest.mark.parametrize("content", [b"", b"\x00\x01\x02", b"PK\x03\x04 no workbook", b"a;b\n"])
def test_what_is_no_sheet_is_refused(tmp_path, content):
    (tmp_path / "runs.csv").write_bytes(content)
    with pytest.raises(ProfileError, match=r"runs\.csv: "):
        read_sheet(tmp_path / "runs.csv")


def test_a_sheet_that_is_not_there_is_refused_by_its_path(call, lab):
    (lab / "logs" / "runs.csv").unlink()
    status, _, err = call("ingest", "logs", "--profile", "logs/lab.toml")
    assert status == 1
    assert "logs/runs.csv: the sheet cannot be read (No such file" in err


# as a command uses it


def test_ingest_stores_what_the_sheet_says_and_ignores_the_sheet(call, lab):
    status, out, _ = call("ingest", "logs", "--profile", "logs/lab.toml", "--json")
    found = json.loads(out)
    assert (status, found["found"], found["ingested"]) == (0, 3, 3)
    assert sorted(Path(path).name for path in found["ignored"]) == ["lab.toml", "runs.csv"]
    rows = read_trials(lab / "processed").to_pylist()
    assert {
        Path(row["source_path"]).name: (row["stiffness"] / 1e3, row["damping"], row["step"]) for row in rows
    } == WALLS
    assert json.loads(call("ingest", "logs", "--profile", "logs/lab.toml", "--json")[1])["skipped"] == 3


def test_a_changed_row_is_read_again(call, lab):
    call("ingest", "logs", "--profile", "logs/lab.toml")
    sheet = lab / "logs" / "runs.csv"
    sheet.write_text(sheet.read_text().replace("run_c;2,5;8,0", "run_c;2,5;9,0"))
    assert call("ingest", "logs", "--profile", "logs/lab.toml")[0] == 0
    rows = read_trials(lab / "processed").to_pylist()
    assert sorted(row["damping"] for row in rows) == [3.0, 5.0, 9.0]


def test_rows_without_a_log_and_logs_without_a_row_are_listed(call, lab):
    (lab / "logs" / "runs.csv").write_text(text([*ROWS[:-1], [9, "run_z", 1.0, 1.0, 8.0, "lost"]]))
    status, out, _ = call("ingest", "logs", "--profile", "logs/lab.toml", "--json")
    found = json.loads(out)
    assert (status, found["ingested"], len(found["quarantined"])) == (3, 2, 1)
    assert "no [[file]] entry or row of its sheet names it" in found["quarantined"][0]["reason"]
    told = [warning["warning"] for warning in found["warnings"]]
    assert told == [
        "1 row without a log: run_z (row 4).",
        "1 log without a row: run_c.txt.",
    ]


def test_columns_and_sheet_on_the_command_line(call, lab):
    columns = ("--time", "t:s", "--command", "F:N", "--position", "x:mm", "--device", "bench")
    status, _, err = call("ingest", "logs", *columns, "--sheet", "logs/runs.csv", "--save-profile", "own/lab.toml")
    assert status == 0, err
    assert "stiffness is column 'K [N/mm]' of logs/runs.csv" in err
    assert re.search(r'\[sheet\]\nfile = "\.\./logs/runs.csv"', (lab / "own" / "lab.toml").read_text())
    _, out, _ = call("ingest", "logs", "--profile", "own/lab.toml", "--json")
    assert json.loads(out)["skipped"] == 3
    rows = read_trials(lab / "processed").to_pylist()
    assert {
        Path(row["source_path"]).name: (row["stiffness"] / 1e3, row["damping"], row["step"]) for row in rows
    } == WALLS


def test_a_wrong_unit_in_a_sheet_is_stopped_with_the_option_to_correct(call, lab):
    (lab / "logs" / "runs.csv").write_text(text([["Nr", "Datei", "K", "B", "F0", "note"], *ROWS[1:]]))
    columns = [
        "--time",
        "t:s",
        "--command",
        "F:N",
        "--position",
        "x:mm",
        "--device",
        "bench",
        "--sheet",
        "logs/runs.csv",
    ]
    rest = ["--damping", "B:Ns/m", "--step", "F0:N"]
    status, _, err = call("ingest", "logs", *columns, *rest)
    assert (status, "column 'K' has no unit" in err) == (1, True)
    status, _, err = call("ingest", "logs", *columns, *rest, "--stiffness", "K:N/m")
    assert (status, "--stiffness 'K:N/mm'" in err) == (1, True)
    assert call("ingest", "logs", *columns, *rest, "--stiffness", "K:N/mm")[0] == 0


def test_a_wrong_row_is_warned_of_with_what_the_command_obeys(call, lab):
    (lab / "logs" / "runs.csv").write_text(text(ROWS).replace("run_b;1,5", "run_b;2,6"))
    _, out, _ = call("ingest", "logs", "--profile", "logs/lab.toml", "--json")
    (warning,) = json.loads(out)["warnings"]
    assert "run_b.txt" in warning["path"]
    assert "follows stiffness 1500, the header states 2600" in warning["warning"]


def test_an_entry_of_a_file_corrects_its_row(call, lab):
    (lab / "logs" / "runs.csv").write_text(text(ROWS).replace("run_b;1,5", "run_b;2,6"))
    (lab / "logs" / "lab.toml").write_text(PROFILE + '\n[[file]]\nmatch = "run_b.txt"\nstiffness = 1.5\n')
    status, out, err = call("ingest", "logs", "--profile", "logs/lab.toml", "--json")
    assert status == 0, err
    assert json.loads(out)["warnings"] == []
    assert 1500.0 in {row["stiffness"] for row in read_trials(lab / "processed").to_pylist()}


def test_a_sheet_with_a_profile_takes_the_place_of_its_own(call, lab):
    (lab / "logs" / "lab.toml").write_text(PROFILE.partition("[sheet]")[0] + "stiffness = 1\ndamping = 1\nstep = 1\n")
    status, _, err = call("ingest", "logs", "--profile", "logs/lab.toml", "--sheet", "logs/runs.csv", "--json")
    assert status == 0, err
    assert sorted(row["damping"] for row in read_trials(lab / "processed").to_pylist()) == [3.0, 5.0, 8.0]
