"""`pipeline profile check | draft` and `pipeline quarantine`."""

import json
import re

import foreign_files
import numpy as np
import pytest
from native_logs import FAULTS, log_text

from pipeline.base.errors import LogError
from pipeline.profiles.profile_files import find_questions, shipped_profiles
from pipeline.readers.formats import format_of
from pipeline.readers.formats.delimited import text_layout
from pipeline.shell.profile.draft import draft_profile

TOML = """name = "lab"
format = "delimited"
files = ["K*.csv"]
delimiter = ";"
decimal = ","
name_pattern = "K(?P<stiffness>[0-9.]+)"
step_at = "command edge"

[columns.time]
name = "t"
unit = "ms"

[columns.command]
name = "F"
unit = "N"
sign = 1

[columns.position]
name = "x"
unit = "mm"
sign = 1

[constants]
device = "bench"
experiment = "1"
damping = 2
step = 8
sampling_period_s = 0.001

[[file]]
match = "K7*"
damping = 3
"""
ROWS = [(0, 0, 0), (1, 0, 0), (2, 8, 0), (3, 8, 0.25), (5, 8, 0.5), (6, 8, 0.75)]
LOG = "t;F;x\n" + "".join(f"{t};{force};{x}\n".replace(".", ",") for t, force, x in ROWS)


@pytest.fixture
def lab(tmp_path):
    (tmp_path / "lab.toml").write_text(TOML, encoding="utf-8")
    (tmp_path / "K300.csv").write_text(LOG, encoding="utf-8")
    return tmp_path


# check


def test_check_shows_values_in_si_and_where_they_come_from(call, lab):
    status, out, err = call("profile", "check", "lab.toml", "K300.csv", "--json")
    assert (status, err) == (0, "")
    document = json.loads(out)
    assert (document["profile"], document["refused"]) == ("lab", 0)
    (sample,) = document["samples"]
    (trial,) = sample["trials"]
    conditions = {c["name"]: (c["value"], c["unit"], c["place"]) for c in trial["conditions"]}
    assert conditions["stiffness"] == (300, "N/m", "name_pattern")
    assert conditions["damping"] == (2, "Ns/m", "constants")
    assert conditions["grip"] == ("none", "", "default")
    assert conditions["motion"] == ("translation", "", "columns.position.unit")
    columns = {c["column"]: (c["source"], c["unit"], c["first"], c["last"], c["unit_si"]) for c in trial["columns"]}
    assert columns["time"] == ("t", "ms", 0, 0.006, "s")
    assert columns["command"] == ("F", "N", 0, 8, "N")
    assert columns["position"] == ("x", "mm", 0, 0.00075, "m")
    assert trial["rows"] == 6
    assert (trial["time"]["gaps"], trial["time"]["dropped"]) == (1, 1)
    # 300 N/m and 2 Ns/m take less than half of 8 N at these positions: the edge is where the command jumps
    assert (trial["step_row"], trial["step"]) == (2, "found in the command, at 0.002 s")
    assert not (lab / "processed").exists()
    status, out, _ = call("profile", "check", "lab.toml", "K300.csv")
    assert status == 0
    assert out.startswith("K300.csv: 1 trial would be stored\n")
    assert re.search(r"stiffness +300 N/m +from name_pattern", out)
    assert re.search(r"position +0 to 0\.00075 m +from x \[mm\]", out)
    assert re.search(r"step +row 2: found in the command", out)


def test_check_shows_what_ingest_stores(call, lab):
    from pipeline.store.samples import load_trials
    from pipeline.store.storage import read_trials

    (trial,) = json.loads(call("profile", "check", "lab.toml", "K300.csv", "--json")[1])["samples"][0]["trials"]
    assert call("ingest", "K300.csv", "--profile", "lab.toml")[0] == 0
    trials = read_trials(lab / "processed")
    (row,) = trials.to_pylist()
    (loaded,) = load_trials(lab / "processed", trials)
    for condition in trial["conditions"][:9]:
        assert row[condition["name"]] == condition["value"], condition["name"]
    for column in trial["columns"]:
        values = getattr(loaded, column["column"])
        assert (values[0], values[-1]) == (column["first"], column["last"])
    quality = json.loads(row["time_quality"])
    assert [each["code"] for each in quality.pop("findings")] == [each["code"] for each in trial["findings"]]
    assert quality == trial["time"]


@pytest.mark.parametrize(
    ("name", "text", "row", "words"),
    [
        ("K300.csv", LOG.replace("8;0,25", "8;0.25"), 5, 'help in the profile: decimal = "."'),
        ("K300.csv", LOG.replace("8;0,25", ";0,25"), 5, 'blanks = "skip"'),
        ("run.csv", LOG, None, "matches none of files = ['K*.csv']"),
        ("Kx.csv", LOG, None, "does not match name_pattern"),
    ],
)
def test_check_shows_the_refusal_that_ingest_would_give(call, lab, name, text, row, words):
    (lab / "K300.csv").unlink()
    (lab / name).write_text(text, encoding="utf-8")
    status, out, _ = call("profile", "check", "lab.toml", name)
    assert status == 3
    place = name if row is None else f"{name}, row {row}"
    assert out.startswith(f"{place}: would be refused: ")
    assert words in out
    document = json.loads(call("profile", "check", "lab.toml", name, "--json")[1])
    assert (document["refused"], document["samples"][0]["row"]) == (1, row)
    status, out, _ = call("ingest", name, "--profile", "lab.toml", "--json")
    assert status == 3
    if row is not None:
        assert json.loads(out)["quarantined"][0]["reason"] == document["samples"][0]["reason"]


def test_check_reads_native_logs_and_shipped_profiles(call, tmp_path):
    (tmp_path / "a.csv").write_text(log_text(300.0))
    status, out, _ = call("profile", "check", "native", "a.csv")
    assert status == 0
    assert re.search(r"stiffness +300 N/m +from header", out)
    assert call("profile", "check", "none", "a.csv")[0] == 1
    assert call("profile", "check", "native", "b.csv")[0] == 2


# draft

ANSWERS = {
    "constants.damping": "2",
    "constants.step": "8",
    "constants.sampling_period_s": "0.001",
    "decimal": '"."',
}


def answer(text, answers):
    """Set the key below each question and remove the line of the question, as a user does."""
    lines = text.splitlines()
    questions = {q.line: ".".join(map(str, q.place)) for q in find_questions(text)}
    for number, key in questions.items():
        value = (ANSWERS | answers)[key]
        assert lines[number].startswith(f"# {key.split('.')[-1]} = "), lines[number]
        lines[number - 1], lines[number] = "", f"{key.split('.')[-1]} = {value}"
    return "\n".join(lines) + "\n"


GERMAN = "Prüfer: Ä\nGain: 32 N/mm\n\nZeit;Kraft;Weg;Notiz;\nms;N;µm;;\n" + "".join(
    f"{t};{force};{x};ja;\n".replace(".", ",") for t, force, x in ROWS
)
TEXTS = {
    "german": (
        GERMAN.encode("latin-1"),
        {"delimiter": ";", "decimal": ",", "trailing_delimiter": True, "unit_line": True, "encoding": "cp1252"},
    ),
    "tabs in UTF-16": (
        LOG.replace(";", "\t").encode("utf-16"),
        {"delimiter": "\t", "decimal": ",", "encoding": "utf-16"},
    ),
    "UTF-16 without mark": (LOG.encode("utf-16-le"), {"encoding": "utf-16", "delimiter": ";"}),
    "commas with BOM": (b"\xef\xbb\xbf" + LOG.replace(",", ".").replace(";", ",").encode(), {"delimiter": ","}),
    "blanks without names": (
        "".join(f" {t}  {f} {x}\n" for t, f, x in ROWS).encode(),
        {"delimiter": "blanks", "header": False},
    ),
    "blank line": (LOG.replace("2;8", "\n2;8").encode(), {"delimiter": ";", "blank_lines": "skip"}),
    "cut last line": (LOG.encode() + b"7;8", {"delimiter": ";", "decimal": ","}),
}


@pytest.mark.parametrize("name", TEXTS)
def test_layout_of_a_text_is_found(name):
    data, expected = TEXTS[name]
    layout = text_layout(name, data)
    assert {key: layout.keys.get(key) for key in expected} == expected
    assert not layout.questions
    if name == "german":
        assert (layout.keys["skip_rows"], layout.keys["labels"]) == (3, ":")


@pytest.mark.parametrize(
    ("cells", "asked"),
    [
        ("1,234 2,345", True),
        ("0,234 2,345", False),
        ("1.5 1,234", True),
        ("12,34 1,5", False),
        ("1 2", True),
        ("0.5 1", False),
    ],
)
def test_a_decimal_mark_that_could_part_thousands_is_asked(cells, asked):
    first, second = cells.split()
    layout = text_layout("x", f"a;b\n{first};{second}\n{first};{second}\n{first};{second}\n".encode())
    assert ("decimal" in layout.questions) == asked
    assert layout.keys.get("decimal") == (None if asked else "," if "," in cells else ".")


def test_a_draft_asks_and_is_refused_until_it_is_answered(call, tmp_path):
    (tmp_path / "K300.csv").write_bytes(GERMAN.encode("latin-1"))
    assert call("profile", "draft", "K300.csv", "--out", "lab.toml") == (0, "lab.toml: 3 questions are open\n", "")
    text = (tmp_path / "lab.toml").read_text(encoding="utf-8")
    assert call("profile", "draft", "K300.csv")[1] == text
    # what the file states is set with where it does, and nothing that would change a number silently
    assert re.findall(r'^unit = "(.*?)" # the file states', text, re.MULTILINE) == ["ms", "N", "um"]
    assert "sampling_period_s = 0.001 # the time between rows" in text
    assert not re.search(r"^(step|stiffness|damping|motion) *=", text, re.MULTILINE)
    for command in (("profile", "check", "lab.toml", "K300.csv"), ("ingest", ".", "--profile", "lab.toml")):
        status, out, err = call(*command)
        assert (status, out) == (1, "")
        assert "3 open questions in this profile" in err
        told = re.findall(r"^lab\.toml:(\d+): key '(.*?)': open question", err, re.MULTILINE)
        assert told == [(str(q.line), ".".join(map(str, q.place))) for q in find_questions(text)]
    status, _, err = call("profile", "draft", "K300.csv", "--out", "lab.toml")
    assert (status, "lab.toml: already exists" in err) == (2, True)
    (tmp_path / "lab.toml").write_text(answer(text, {"units.stiffness": '"N/m"'}), encoding="utf-8")
    status, out, _ = call("profile", "check", "lab.toml", "K300.csv", "--json")
    assert status == 0
    (trial,) = json.loads(out)["samples"][0]["trials"]
    first_last = {c["column"]: (c["first"], c["last"]) for c in trial["columns"]}
    assert first_last == {
        "time": (0, pytest.approx(6e-3, rel=1e-15)),
        "command": (0, 8),
        "position": (0, pytest.approx(0.75e-6, rel=1e-15)),
    }


def test_a_draft_as_one_json_document(call, tmp_path):
    (tmp_path / "K300.csv").write_bytes(GERMAN.encode("latin-1"))
    status, out, err = call("profile", "draft", "K300.csv", "--json")
    document = json.loads(out)
    assert (status, err, document["sample"], document["out"]) == (0, "", "K300.csv", None)
    assert document["profile"] == call("profile", "draft", "K300.csv")[1]
    asked = [(q.line, ".".join(map(str, q.place))) for q in find_questions(document["profile"])]
    assert [(q["line"], q["key"]) for q in document["questions"]] == asked
    assert {key for _, key in asked} == {"units.stiffness", "constants.damping", "constants.step"}
    _, out, _ = call("profile", "draft", "K300.csv", "--out", "lab.toml", "--json")
    assert json.loads(out) == document | {"out": "lab.toml"}
    assert (tmp_path / "lab.toml").read_text(encoding="utf-8") == document["profile"]


WRITTEN = {
    "json": ("a.json", foreign_files.json_log, {"name": "q", "time": "t", "position": "q[0]"}),
    "parquet": ("a.parquet", lambda: foreign_files.arrow_log("parquet"), {"time": "t", "position": "fixed[0]"}),
    "feather": ("a.feather", lambda: foreign_files.arrow_log("zstd"), {"time": "t", "position": "fixed[0]"}),
    "matlab": ("a.mat", lambda: foreign_files.matlab5_log(True), {"time": "t", "position": "log.q[0]"}),
    "hdf5": (
        "a.h5",
        lambda: foreign_files.hdf5_file(foreign_files.hdf5_log),
        {"time": "arm/t", "position": "arm/q[0]"},
    ),
    "tdms": ("a.tdms", foreign_files.tdms_log, {"time": "@time", "position": "/arm/force"}),
    "rosbag": (
        "a.bag",
        lambda: foreign_files.bag_file("bag", foreign_files.joint_log),
        {"time": "/arm/joints.header.stamp", "position": "/arm/joints.position[0]"},
    ),
    "mcap": (
        "a.mcap",
        lambda: foreign_files.bag_file("mcap", foreign_files.joint_log),
        {"time": "/arm/joints.header.stamp", "position": "/arm/joints.position[0]"},
    ),
}


@pytest.mark.parametrize("kind", WRITTEN)
def test_a_draft_of_each_format_reads_its_sample_when_answered(kind, call, tmp_path):
    name, write, columns = WRITTEN[kind]
    data = write()
    assert format_of(name, data) == kind
    (tmp_path / name).write_bytes(data)
    text = draft_profile(tmp_path / name)
    assert f'format = "{kind}"' in text
    answers = {
        "columns.time.name": json.dumps(columns["time"]),
        "columns.time.unit": '"ns"' if "stamp" in columns["time"] else '"s"',
        # the samples have no command: any other column of numbers will do
        "columns.command.name": json.dumps(
            columns["position"].replace("[0]", "[1]").replace("/arm/force", "/arm/count")
        ),
        "columns.command.unit": '"N"',
        "columns.position.name": json.dumps(columns["position"]),
        "columns.position.unit": '"m"',
    }
    assert len(find_questions(text)) <= 5
    text = answer(text, answers)
    for role in ("time", "command", "position"):
        for key in ("name", "unit"):
            line = rf"(?<=\[columns\.{role}\]\n)((?:.+\n)*?)#? ?{key} = .*\n"
            text = re.sub(
                line, lambda found, to=answers[f"columns.{role}.{key}"], k=key: f"{found[1]}{k} = {to}\n", text
            )
    (tmp_path / "lab.toml").write_text(text, encoding="utf-8")
    status, out, err = call("profile", "check", "lab.toml", name, "--json")
    assert status == 0, (out, err, text)
    (trial,) = json.loads(out)["samples"][0]["trials"]
    position = next(c for c in trial["columns"] if c["column"] == "position")
    _, written, _ = foreign_files.samples()
    assert (position["first"], position["last"]) == (written[0, 0], written[-1, 0])


def test_a_native_log_needs_no_draft(call, tmp_path):
    (tmp_path / "a.csv").write_text(log_text(300.0))
    status, out, err = call("profile", "draft", "a.csv")
    assert (status, out) == (1, "")
    assert "needs no profile" in err
    assert call("profile", "draft", "none.csv")[0] == 2


# quarantine


@pytest.fixture
def refused(call, tmp_path):
    """A good log, and a bad one in quarantine; returns the text and the row of the bad one."""
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "good.csv").write_text(log_text(300.0))
    text, row, _ = FAULTS["text cell"]
    (tmp_path / "logs" / "bad.csv").write_text(text)
    assert call("ingest", "logs")[0] == 3
    return text, row


def test_quarantine_is_listed_and_shown(call, refused, tmp_path):
    _, row = refused
    (record,) = json.loads(call("quarantine", "--json")[1])
    assert (record["path"], record["row"], record["profile"]) == (str(tmp_path / "logs" / "bad.csv"), row, "native")
    assert (tmp_path / "processed" / "quarantine" / record["id"]).is_dir()
    status, out, _ = call("quarantine")
    assert status == 0
    line = f"{record['id']}  {record['path']}, row {row} [{record['code']}]: {record['reason']}"
    assert out.splitlines() == [line, "1 in quarantine"]
    by_path = call("quarantine", "logs/bad.csv")
    assert by_path == call("quarantine", record["id"])
    assert f"row      {row}\n" in by_path[1]
    assert json.loads(call("quarantine", record["id"], "--json")[1]) == record
    status, _, err = call("quarantine", "logs/good.csv")
    assert (status, "is not in quarantine" in err) == (2, True)


@pytest.mark.parametrize("words", [[], ["--json"], ["bad.csv"]])
def test_a_mistyped_folder_is_not_one_without_refusals(call, refused, words, tmp_path):
    status, out, err = call("quarantine", *words, "--processed", "procesed")
    assert (status, out) == (2, "")
    assert err.startswith("Error: procesed: folder not found.")
    assert not (tmp_path / "procesed").exists()


# no step


def test_a_trial_without_a_step_is_stored_and_has_no_step_row(call, tmp_path):
    text = re.sub(r"# step: [^\n]*", "# step: 0 [N]", log_text(300.0))
    (tmp_path / "a.csv").write_text(text)
    (tmp_path / "b.csv").write_text(text.replace("# step:", "# step_row: 3\n# step:"))
    status, out, _ = call("profile", "check", "native", "a.csv", "--json")
    assert status == 0
    (trial,) = json.loads(out)["samples"][0]["trials"]
    assert (trial["step_row"], trial["step"]) == (None, "no step was commanded (step is 0)")
    status, out, _ = call("profile", "check", "native", "b.csv")
    assert status == 3
    assert "step is 0 (none was commanded), but the step is declared in row 3" in out


def test_shipped_profiles_claim_no_file_twice():
    names = ("2024-10-26_12h23m42.json", "own_ctrl_pop.mat", "a.simulink.mat", "june.trials.csv", "fri_K1_B1_F1.csv")
    for name in names:
        assert sum(profile.claims(name) for profile in shipped_profiles() if profile.format != "native") == 1, name


def test_simulink_profile_reads_structure_with_time(call, tmp_path):
    from scipy.io import savemat

    signals = np.zeros(2, dtype=[("values", "O"), ("label", "O")])
    signals[0] = (np.array([[0.0], [8.0], [8.0]]), "F")
    signals[1] = (np.array([[0.0], [0.0], [0.02]]), "x")
    scope = {"time": np.array([[0.0], [0.001], [0.002]]), "signals": signals}
    savemat(tmp_path / "a.simulink.mat", {"ScopeData": scope, "K": 300.0, "B": 2.0, "F0": 8.0, "T": 0.001})
    status, out, err = call("profile", "check", "simulink", "a.simulink.mat", "--json")
    assert status == 0, out + err
    (trial,) = json.loads(out)["samples"][0]["trials"]
    assert {c["name"]: c["value"] for c in trial["conditions"]}["stiffness"] == 300
    assert [(c["first"], c["last"]) for c in trial["columns"]] == [(0, 0.002), (0, 8), (0, 0.02)]


@pytest.mark.parametrize("text", ["x\n1.0\n2.0\n3.5\n", "1.0\n2.0\n3.5\n", "0.1;\n0.2;\n0.3;\n"])
def test_a_file_of_one_column_is_called_so(text):
    """It was said to be no table of numbers, to be exported as CSV."""
    with pytest.raises(LogError, match=r"one column of numbers .* needs the command, and the position or velocity"):
        text_layout("one.csv", text.encode())
