"""`pipeline look`: a log as it was recorded, by a profile and without one."""

import json
from pathlib import Path

import pytest
from native_logs import log_text

from pipeline.surface.log_picture import MOST_COLUMNS, look

PROFILE = """name = "lab"
format = "delimited"
files = ["*.dat"]
delimiter = ";"
decimal = ","
step_at = "command edge"
[columns.time]
name = "zeit"
unit = "ms"
[columns.command]
name = "kraft"
unit = "N"
sign = 1
[columns.position]
name = "weg"
unit = "mm"
sign = 1
[constants]
device = "bench"
experiment = "1"
stiffness = 4000
damping = 2
step = 8
sampling_period_s = 0.001
"""


def foreign(missing=()):
    lines = ["zeit;kraft;weg"]
    for i in range(300):
        if i not in missing:
            moved = 0.0 if i < 52 else 1.5 * (1 - 0.9 ** (i - 52))
            lines.append(f"{i};{0 if i < 50 else 8 - 4 * moved:.4f};{moved:.5f}".replace(".", ","))
    return "\n".join(lines) + "\n"


def test_a_file_that_no_profile_reads_is_shown_as_it_stands(call):
    Path("a.dat").write_text(foreign(missing=range(100, 105)), encoding="utf-8")
    status, out, _ = call("look", "a.dat", "--json")
    found = json.loads(out)
    (trial,) = found["trials"]
    assert status == 0
    assert (trial["rows"], trial["step_row"], trial["gaps"]) == (295, None, [100])
    columns = {column["name"]: column for column in trial["columns"]}
    assert list(columns) == ["zeit", "kraft", "weg"]
    assert columns["kraft"]["jumps"] == [50]
    assert columns["weg"]["rests"][0] == [0, 53]
    assert columns["weg"]["rests"][-1][1] == 295
    assert "Shown as recorded" in found["notes"][0]
    page = Path(found["page"]).read_text(encoding="utf-8")
    assert page.count("<svg") == 3
    assert "rows missing before row 100" in page


def test_by_a_profile_columns_are_in_si_with_the_step(call):
    Path("a.dat").write_text(foreign(), encoding="utf-8")
    Path("lab.toml").write_text(PROFILE, encoding="utf-8")
    status, out, _ = call("look", "a.dat", "--profile", "lab.toml", "--out", "some/a.html", "--json")
    (trial,) = json.loads(out)["trials"]
    assert status == 0
    assert trial["step_row"] == 50
    assert [(column["name"], column["unit"]) for column in trial["columns"]] == [("command", "N"), ("position", "m")]
    assert "position [m]" in Path("some/a.html").read_text(encoding="utf-8")


def test_a_native_log_needs_no_profile(call):
    Path("b.csv").write_text(log_text(), encoding="utf-8")
    status, out, _ = call("look", "b.csv")
    assert status == 0
    assert "Read by profile native" in out


def test_no_more_columns_are_drawn_than_can_be_looked_at(call):
    rows = [",".join(f"c{i}" for i in range(60)), *(",".join(str(i * j) for i in range(60)) for j in range(20))]
    Path("wide.dat").write_text("\n".join(rows) + "\n", encoding="utf-8")
    ((_, columns),) = look(Path("wide.dat")).trials
    assert len(columns) == MOST_COLUMNS


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["nowhere.csv"], "does not exist"),
        (["words.dat"], "no table of numbers"),
        (["two"], "found 2"),
        (["a.dat", "--profile", "other.toml"], "kraft"),
        (["a.dat", "--out", "two"], "--out"),
    ],
)
def test_what_cannot_be_shown_is_refused_in_a_sentence(call, arguments, said):
    Path("a.dat").write_text(foreign(), encoding="utf-8")
    Path("words.dat").write_text("one two\nthree four\nfive six\n", encoding="utf-8")
    Path("other.toml").write_text(PROFILE.replace('"kraft"', '"force"'), encoding="utf-8")
    Path("two").mkdir()
    for name in "ab":
        (Path("two") / f"{name}.csv").write_text(log_text(), encoding="utf-8")
    status, _, err = call("look", *arguments)
    assert status in (1, 2)
    assert said in err
    assert "Traceback" not in err
