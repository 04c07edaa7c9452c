"""The command line: each option is parsed, calls the right function, and prints and exits as promised."""

import inspect
import json
import os
import re
import subprocess
import sys
import time
from contextlib import suppress
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import pyarrow.parquet as pq
import pytest
import typer
from native_logs import FAULTS, log_text

from pipeline import __version__
from pipeline.base.errors import StoreError
from pipeline.base.progress import part_of_work, report
from pipeline.comparison import plan as planning
from pipeline.intake.ingest import ingest
from pipeline.shell import cli, console
from pipeline.shell.cli import app, run


def document(result, status=0):
    assert result[0] == status, result
    return json.loads(result[1])


def leaves(command, words=()):
    """Each command with the words that call it."""
    if not hasattr(command, "commands"):
        return [(words, command)]
    return [leaf for name, below in command.commands.items() for leaf in leaves(below, (*words, name))]


EVERY = [pytest.param(*leaf, id=" ".join(leaf[0])) for leaf in leaves(typer.main.get_command(app))]


@pytest.mark.parametrize(("words", "command"), EVERY)
def test_help_tells_in_a_short_line_then_every_option_in_full(call, words, command):
    first = inspect.cleandoc(command.help).splitlines()[0]
    assert len(first) <= 70
    assert first.endswith(".")
    assert first.split()[0] not in ("The", "A", "Whether", "This")
    status, out, _ = call(*words, "--help")
    assert status == 0
    assert f"Example: pipeline {' '.join(words)}" in out
    shown = "".join(re.sub("[│╭╮╰╯─]", " ", out).split())
    for parameter in (each for each in command.params if not each.hidden):
        assert parameter.param_type_name == "argument" or parameter.opts[0] in shown
        # square brackets would be taken for a style, and vanish
        assert "".join((parameter.help or "").split()) in shown, parameter.name


HEAVY = ["pandas", "scipy", "pydantic", "matplotlib", "jinja2", "rich.progress", "numpy.ma", "pyarrow.dataset", "numba"]
"""What takes longer to load than a short command to run."""

TWICE = ("ingest 0.csv", "ingest 0.csv 1.csv", "compare --device bench")
INGEST = {"pydantic", "numpy", "pyarrow", "pyarrow.parquet"}
LOADED = {
    "--help": set(),
    "--version": set(),
    "ingest --help": set(),
    "theory boundary --delay 2": {"numpy"},
    "theory points cases.csv": {"numpy"},
    "theory optimum --criterion energy_step_w0 --delay 2": {"numpy"},
    "theory map --delay 2 --size 5 --out map.parquet": {"numpy", "pyarrow", "pyarrow.parquet"},
    "ingest 0.csv": INGEST,
    "ingest 0.csv 1.csv": INGEST,
    "compare --device bench": {*INGEST, "numpy.ma", "jinja2"},
    "simulate lwr -e delay-8 --coarsen 8": {"numpy", "numpy.ma", "pydantic", "scipy"},
}
"""What each command, a comparison where nothing changed, may load of these, and of numpy and pyarrow, which would load
pandas where it is installed."""


@pytest.mark.parametrize("command", LOADED)
def test_commands_load_what_they_need(command, tmp_path):
    (tmp_path / "cases.csv").write_text("alpha,beta,gamma,delta,delay\n0.02,0.2,0,0,2\n")
    for number in range(2):
        (tmp_path / f"{number}.csv").write_text(log_text(float(number)))
    if command.startswith("compare"):
        ingest([tmp_path / "0.csv", tmp_path / "1.csv"], tmp_path / "processed")
    watched = [*HEAVY, "numpy", "pyarrow", "pyarrow.parquet"]
    script = (
        "import sys\nfrom pipeline.shell.cli import run\ntry:\n    run()\nfinally:\n"
        f"    print(*[m for m in {watched} if sys.modules.get(m)], sep=' ', file=sys.stderr)"
    )
    # the second time with nothing new, and with its loops compiled
    for turn in range(1 + (command in TWICE or command.startswith("theory"))):
        words = [sys.executable, "-c", script, *command.split()]
        done = subprocess.run(words, capture_output=True, text=True, check=True, cwd=tmp_path)
        if turn or not command.startswith(("compare", "theory")):
            assert set(done.stderr.splitlines()[-1].split()) == LOADED[command]


def test_a_command_alone_is_that_of_the_whole_command_line():
    whole = typer.main.get_command(app)
    for name in {name.split()[0] for name in cli.COMMANDS}:
        alone = typer.main.get_command(cli.application(name))
        assert list(alone.commands) == [name]
        assert [words for words, _ in leaves(alone.commands[name])] == [w for w, _ in leaves(whole.commands[name])]
        assert alone.commands[name].help == whole.commands[name].help


def test_version(call):
    assert call("--version") == (0, f"pipeline {__version__}\n", "")


@pytest.mark.parametrize(
    "arguments",
    [["fly"], ["ingest"], ["ingest", "raw", "--fast"], ["compare"], ["simulate", "falcon", "--seed", "x"], ["theory"]],
)
def test_usage_errors_leave_with_2(call, arguments):
    status, _, err = call(*arguments)
    assert status == 2
    assert "Usage" in err or arguments == ["theory"]


# simulate


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="has no pseudo-terminals")
@pytest.mark.parametrize("more", [[], ["--json"]])
def test_a_terminal_says_once_that_something_is_compiled(tmp_path, more):
    import pty

    reader, terminal = pty.openpty()
    words = [sys.executable, "-c", "from pipeline.shell.cli import run; run()"]
    words += ["simulate", "lwr", "-e", "delay-8", "--coarsen", "8", *more]
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    process = subprocess.Popen(words, cwd=tmp_path, env=environment, stdout=subprocess.DEVNULL, stderr=terminal)
    os.close(terminal)
    text = b""
    with suppress(OSError):  # when nobody writes to it any more
        while more_text := os.read(reader, 10_000):
            text += more_text
    os.close(reader)
    assert process.wait() == 0
    assert text.count(b"compiling, once") == (0 if more else 1)


def test_simulate_writes_logs_and_counts_them(call, tmp_path):
    arguments = ("simulate", "lwr", "--experiment", "delay-8", "--coarsen", "4", "--seed", "3", "--json")
    status, out, err = call(*arguments)
    found = json.loads(out)
    folder = tmp_path / "raw" / "lwr" / "delay-8"
    assert (status, err) == (0, "")
    assert found == {"device": "lwr", "folder": "raw", "seed": 3, "logs": {"delay-8": len(list(folder.glob("*.csv")))}}
    assert found["logs"]["delay-8"] > 20
    assert json.loads((folder / "truth.json").read_text())["seed"] == 3
    assert document(call(*arguments)) == found


def test_simulate_options_reach_the_simulation(call, tmp_path):
    out = tmp_path / "logs"
    document(call("simulate", "falcon", "-e", "4,6", "--coarsen", "8", "--out", out, "--json"))
    assert sorted(p.name for p in (out / "falcon").iterdir()) == ["4", "6"]


def test_simulate_takes_a_device_file(call, tmp_path):
    shipped = Path(planning.__file__).parents[2] / "schemas" / "devices" / "lwr.toml"
    text = shipped.read_text(encoding="utf-8").replace('name = "lwr"', 'name = "mine"', 1)
    (tmp_path / "mine.toml").write_text(text, encoding="utf-8")
    assert document(call("simulate", "mine.toml", "-e", "delay-6", "--coarsen", "8", "--json"))["device"] == "mine"


# ingest


@pytest.fixture
def logs(tmp_path):
    (tmp_path / "logs").mkdir()
    for stiffness in (300, 600):
        (tmp_path / "logs" / f"{stiffness}.csv").write_text(log_text(float(stiffness)))
    return tmp_path / "logs"


def test_ingest_counts_and_stays_quiet(call, logs, tmp_path):
    counts = {"found": 2, "ingested": 2, "skipped": 0}
    counts |= {key: [] for key in ("quarantined", "warnings", "removed", "changed", "waiting", "damaged", "ignored")}
    plan = [{"path": f"logs/{k}.csv", "action": "ingest", "reason": "new"} for k in (300, 600)]
    assert document(call("ingest", "logs", "--dry-run", "--json")) == counts | {"plan": plan}
    assert not (tmp_path / "processed").exists()
    status, out, err = call("ingest", "logs", "--json", "--jobs", "1")
    assert (status, json.loads(out), err) == (0, counts, "")
    again = {**counts, "ingested": 0, "skipped": 2}
    assert document(call("ingest", "logs", "--json")) == again
    assert document(call("ingest", "logs", "--rehash", "--json")) == again
    assert document(call("ingest", "logs", "--processed", "other", "--profile", "native", "--json")) == counts


def test_a_plan_names_action_and_reason(call, logs):
    assert call("ingest", "logs", "--json")[0] == 0
    (logs / "300.csv").write_text(log_text(301.0))
    (logs / "copy.csv").write_text((logs / "600.csv").read_text())
    (logs / "bad.csv").write_text(FAULTS["text cell"][0])
    status, out, _ = call("ingest", "logs", "--dry-run")
    assert status == 3
    assert out.splitlines()[2:] == [
        "ingest (content changed): logs/300.csv",
        "skip (unchanged: size and modification time): logs/600.csv",
        f"skip (same content as {logs / '600.csv'}): logs/copy.csv",
        *(line for line in out.splitlines() if line.startswith("logs/bad.csv, row 17: command must be")),
        "changed: logs/300.csv: its trials were replaced by the trials of the new content",
    ]
    actions = {e["path"]: e["action"] for e in document(call("ingest", "logs", "--dry-run", "--json"), 3)["plan"]}
    assert actions["logs/bad.csv"] == "refuse"


def test_long_lists_are_cut_in_text_alone(call, logs, tmp_path):
    for k in range(30):
        (logs / f"{k}.csv").write_text(log_text(float(k)))
    # the logs share their samples, which is a warning
    lines = [line for line in call("ingest", "logs", "--dry-run")[1].splitlines() if not line.startswith("warning: ")]
    assert lines[2] == "ingest (new): 32"
    assert len(lines) == 2 + 1 + 10 + 1
    assert lines[-1] == "  and 22 more"
    assert len(document(call("ingest", "logs", "--dry-run", "--json"))["plan"]) == 32


def test_a_second_writer_is_refused_and_readers_are_not(call, logs, tmp_path, monkeypatch):
    from pipeline.base import disk
    from pipeline.base.disk import writing

    assert call("ingest", "logs")[0] == 0
    clock = SimpleNamespace(monotonic=count(0, 100).__next__, sleep=time.sleep)  # no minute for this test
    (logs / "new.csv").write_text(log_text(1.0))
    with writing(tmp_path / "processed", 0), monkeypatch.context() as patch:
        patch.setattr(disk, "time", clock)
        for command in (["ingest", "logs"], ["move", "bench", "other"]):
            status, out, err = call(*command)
            assert (status, out) == (1, "")
            assert "is writing there; waited 60 s" in err
        assert call("status")[0] == 0
        assert call("ingest", "logs", "--dry-run")[0] == 0
    assert document(call("ingest", "logs", "--json"))["ingested"] == 1


def test_check_names_what_is_damaged_and_repairs_it(call, logs):
    call("ingest", str(logs))
    status, out, _ = call("check")
    assert (status, out.splitlines()[0].split(": ")[1]) == (0, "none damaged")
    (file,) = Path("processed").glob("trials/**/*.parquet")
    data = bytearray(file.read_bytes())
    data[40] ^= 1
    file.write_bytes(data)
    status, out, _ = call("check", "--json")
    (damage,) = json.loads(out)["damage"]
    assert (status, damage["file"], damage["remedy"]) == (1, file.relative_to("processed").as_posix(), "save")
    assert call("check", "--repair")[0] == 0
    assert call("check")[0] == 0


def test_status_shows_what_is_stored(call, logs):
    (logs / "bad.csv").write_text(FAULTS["text cell"][0])
    assert call("ingest", "logs")[0] == 3
    call("exclude", str(logs / "300.csv"), "--reason", "slipped")
    status, out, _ = call("status")
    columns, row, total, excluded, refused = out.splitlines()
    assert status == 0
    assert columns.split() == ["device", "experiment", "trials", "rows"]
    assert row.split() == ["bench", "1", "2", "60"]
    assert total == "2 trials, 0 in the bin"
    assert excluded.endswith("300.csv): slipped")
    assert refused == "in quarantine, not-a-number: 1"
    found = document(call("status", "--json"))
    assert (found["experiments"][0]["trials"], len(found["excluded"])) == (2, 1)
    assert found["quarantined"] == {"not-a-number": 1}
    assert call("status", "--processed", "nowhere")[0] == 2


def test_quarantine_is_told_and_leaves_with_3(call, logs):
    text, row, _ = FAULTS["text cell"]
    (logs / "bad.csv").write_text(text)
    found = document(call("ingest", "logs", "--json"), status=3)
    assert (found["found"], found["ingested"]) == (3, 2)
    (refusal,) = found["quarantined"]
    assert (refusal["path"], refusal["row"]) == ("logs/bad.csv", row)
    status, out, _ = call("ingest", "logs")
    assert status == 3
    header, counts, reason = out.splitlines()
    assert header.split() == ["found", "ingested", "skipped", "quarantined"]
    assert counts.split() == ["3", "0", "2", "1"]
    assert reason == f"logs/bad.csv, row {row}: {refusal['reason']}"


# compare


@pytest.fixture(scope="module")
def course(tmp_path_factory):
    folder = tmp_path_factory.mktemp("course")
    for arguments in (
        ["simulate", "lwr", "-e", "delay-8", "--coarsen", "3", "--out", str(folder / "raw")],
        ["ingest", str(folder / "raw"), "--processed", str(folder / "processed")],
    ):
        with pytest.raises(SystemExit) as leaving:
            run(arguments)
        assert not leaving.value.code
    return folder / "processed"


def test_the_only_device_of_a_store_needs_no_name(call, course, tmp_path):
    given, named = (call("compare", *words, "--processed", course, "--dry-run") for words in ((), ("--device", "lwr")))
    assert given == named
    status, _, err = call("compare", "--processed", str(tmp_path))
    assert status == 2
    assert "Ingest logs first: pipeline ingest LOGS" in " ".join(re.sub("[│╭╮╰╯─]", " ", err).split())


def test_compare_says_what_it_would_do_and_why(call, course, tmp_path):
    arguments = ("compare", "--device", "lwr", "--processed", course, "--dry-run")
    plan = document(call(*arguments, "--json"))
    assert {frozenset(stage) for stage in plan} == {frozenset(("stage", "action", "reason"))}
    assert {stage["action"] for stage in plan} <= {"run", "reuse", "leave out"}
    status, out, _ = call(*arguments)
    assert status == 0
    assert len(out.splitlines()) == len(plan) + 1
    assert not (tmp_path / "reports").exists()


def test_compare_prints_one_document_and_writes_the_report(call, course, tmp_path):
    options = ("--experiment", "delay-8", "--criteria", "overshoot,settle_5pct", "--processed", course)
    status, out, err = call("compare", "--device", "lwr", *options, "--json")
    found = json.loads(out)
    assert (status, err) == (0, "")
    assert found["criteria"] == ["overshoot", "settle_5pct"]
    assert [e["experiment"] for e in found["experiments"]] == ["delay-8"]
    assert (tmp_path / "reports" / "lwr.html").is_file()
    assert 'href="./lwr.html"' in (tmp_path / "reports" / "index.html").read_text()
    status, out, err = call("compare", "--device", "lwr", *options, "--report", "here.html")
    assert status == 0
    assert out.splitlines()[-1] == "report: here.html"
    assert (tmp_path / "here.html").is_file()
    assert not (tmp_path / "index.html").exists()  # that folder may be anybody's


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        (["--device", "falcon"], 1, "falcon"),
        (["--device", "lwr", "--experiment", "delay-2"], 1, "delay-2"),
        (["--device", "lwr", "--criteria", "overshoot,speed"], 2, "speed"),
        (["--device", "lwr", "--criteria", ""], 2, "criterion ''"),
        (["--device", "lwr", "--report", ""], 2, "is a folder; expected a file"),
        (["--device", "lwr", "--report", "stored"], 2, "is a folder; expected a file"),
        (["--device", "lwr", "--report", "a.json"], 2, "Give a.html."),
        (["--device", "lwr", "--report", "stored/file/new/a.html"], 1, "can be created in stored/file (Not a dir"),
    ],
)
def test_wrong_comparisons_are_refused(call, course, arguments, status, message, tmp_path):
    (tmp_path / "stored").mkdir()
    (tmp_path / "stored" / "file").touch()
    found, out, err = call("compare", *arguments, "--processed", course)
    assert (found, out) == (status, "")
    assert message in err
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["file", "stored"]


@pytest.mark.parametrize(
    "command", ["theory map --delay 1 --out", "profile draft s.csv --out", "compare --device lwr --save-scene"]
)
def test_a_file_that_cannot_be_written_is_told_before_the_work(call, command, tmp_path):
    (tmp_path / "file").touch()
    words = command.split()
    for place, expected, message in (
        (".", 2, f"{words[-1]} .: is a folder"),
        ("file/a.html", 1, "because no file can be created in file (Not a directory)"),
    ):
        status, out, err = call(*words, place)
        assert (status, out) == (expected, "")
        assert message in err
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_reports_that_cannot_be_written_stop_demo_and_comparison_at_once(call, course, tmp_path):
    (tmp_path / "reports").touch()
    for words in (["demo"], ["compare", "--device", "lwr", "--processed", course]):
        status, out, err = call(*words)
        assert (status, out) == (1, "")
        assert "because no file can be created in reports (Not a directory)" in err
    assert [path.name for path in tmp_path.iterdir()] == ["reports"]


@pytest.mark.parametrize(
    "options", ["delay-4 --dry-run", "delay-4 --full", "a.json --export out", "lwr:delay-4 --dry-run"]
)
def test_options_without_effect_on_the_page_of_two_are_refused(call, course, options, tmp_path):
    words = ("compare", "--device", "lwr", "-e", "delay-8", "--against", *options.split())
    status, out, err = call(*words, "--processed", course)
    assert (status, out, list(tmp_path.iterdir())) == (2, "", [])
    assert "cannot be combined" in err


# theory


def test_theory_points(call, tmp_path):
    (tmp_path / "c.csv").write_text("alpha,beta,gamma,delta,delay\n0.3220,0.9800,0,0,0\n9,9,0,0,0\n")
    stable, unstable = document(call("theory", "points", "c.csv", "--json"))
    assert stable["energy_step_w0"] == pytest.approx(2.583, abs=5e-4)  # Table C.1
    assert (unstable["stable"], unstable["energy_step_w0"]) == (False, None)
    status, out, _ = call("theory", "points", "c.csv")
    assert status == 0
    assert [line.split()[5] for line in out.splitlines()] == ["stable", "yes", "no"]
    (tmp_path / "c.csv").write_text("alpha,beta,gamma,delta\n")
    assert call("theory", "points", "c.csv")[0] == 1


def test_theory_boundary(call):
    found = document(call("theory", "boundary", "--delay", "1", "--delta", "0.02", "--json"))
    assert found["alpha_max"] == pytest.approx(0.15480, abs=5e-6)  # Table B.3
    damped = document(call("theory", "boundary", "--delay", "1", "--delta", "0.02", "--gamma", "0.001", "--json"))
    assert damped["alpha_max"] == pytest.approx(0.15433, abs=5e-6)  # Table B.4
    status, out, _ = call("theory", "boundary", "--delay", "1", "--delta", "0.02")
    assert status == 0
    assert [line.split()[:3] for line in out.splitlines()[1:3]] == [
        ["largest", "alpha", f"{found['alpha_max']:.6g}"],
        ["largest", "beta", "0"],
    ]


def test_theory_optimum(call):
    arguments = ("theory", "optimum", "--criterion", "energy_step_w0", "--delay", "2")
    assert document(call(*arguments, "--json"))["cost"] == pytest.approx(8.21, abs=5e-3)  # Table D.5
    discrete = document(call(*arguments, "--signal", "discrete", "--json"))
    assert (discrete["criterion"], discrete["cost"]) == ("energy_step_w0_discrete", pytest.approx(8.690, abs=5e-4))
    status, out, _ = call(*arguments)
    assert status == 0
    header, row = (line.split() for line in out.splitlines()[:2])
    assert header == ["criterion", "alpha", "beta", "cost"]
    assert "with this delay, the cost of every wall is at least" in out
    assert (row[0], row[1][:6]) == ("energy_step_w0", "0.0305")  # 5796 Nm/rad on 0.19 kg m^2


def test_theory_map(call, tmp_path):
    options = ("--delay", "1", "--size", "9", "--criteria", "overshoot, settle_1pct")
    arguments = ("theory", "map", *options, "--out", "m.pq")
    found = document(call(*arguments, "--json"))
    table = pq.read_table(tmp_path / "m.pq")
    assert table.column_names == ["alpha", "beta", "stable", "overshoot", "settle_1pct"]
    stable = sum(table.column("stable").to_pylist())
    assert found == {"columns": table.column_names, "file": "m.pq", "rows": 81, "stable": stable}
    assert call(*arguments)[0] == 0


@pytest.mark.parametrize(
    ("command", "status", "message"),
    [
        ("simulate hammer", 1, "device 'hammer' is not known; known devices are falcon, falcon-real, lwr"),
        ("simulate none.toml", 1, "none.toml: device file cannot be read"),
        ("simulate falcon -e 9", 1, "no experiment '9'"),
        ("simulate falcon --coarsen 0", 1, "coarsen = 0"),
        ("ingest nowhere", 2, "nowhere: does not exist"),
        ("ingest . --jobs 0", 2, "jobs must be at least 1"),
        ("theory boundary --delay -1 --json", 1, "delay = -1"),
        ("theory boundary --delay nan --json", 1, "delay = nan"),
        ("theory boundary --delay 1 --gamma -0.1 --json", 1, "gamma = -0.1"),
        ("theory optimum --delay 1 --criterion speed --json", 1, "expected one of alpha_max"),
        ("theory map --delay 1 --criteria speed --out m.pq", 1, "expected names from settle_1pct"),
        ("theory map --delay -1 --out m.pq", 1, "delay = -1"),
        ("theory points none.csv --json", 1, "cannot be read"),
    ],
)
def test_wrong_values_are_refused_and_nothing_is_written(call, command, status, message, tmp_path):
    found, out, err = call(*command.split())
    assert (found, out) == (status, "")
    assert err.startswith("Error: ") or status == 2
    assert message in err
    assert {path.name for path in tmp_path.iterdir()} <= {"processed"}


# the frame


def test_named_errors_are_messages_and_others_pass(monkeypatch, call, course):
    def damaged(*_, **__):
        raise StoreError("a.parquet: is damaged.")

    monkeypatch.setattr(planning, "plan_comparison", damaged)
    assert call("compare", "--device", "lwr") == (1, "", "Error: a.parquet: is damaged.\n")

    def broken(*_, **__):
        raise ZeroDivisionError("a defect")

    monkeypatch.setattr(planning, "plan_comparison", broken)
    with pytest.raises(ZeroDivisionError, match="a defect"):
        run(["compare", "--device", "lwr"])


def test_progress_is_a_bar_on_a_terminal_and_nothing_with_json(monkeypatch, capsys):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("TERM", "xterm")
    token = console._JSON.set(True)
    with console.progress("ingest", "logs") as advance:
        advance(1, 2)
    console._JSON.reset(token)
    assert capsys.readouterr() == ("", "")
    with console.progress("ingest", "logs") as advance:
        advance(1, 2)
    out, err = capsys.readouterr()
    assert out == ""
    assert "1/2" in err


def test_progress_shows_stage_share_and_time_left(monkeypatch, capsys):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    with console.progress("compare"), part_of_work("experiment 1", 0.0, 1.0):
        report(0.25)
        report(0.1)  # what is shown goes forwards only
    out, err = capsys.readouterr()
    assert out == ""
    assert "compare: experiment 1" in err
    assert re.search(r"25%, \d+ s left", err)
    assert "10%" not in err


def test_without_a_terminal_there_is_no_progress(capsys):
    with console.progress("compare") as advance, part_of_work("experiment 1", 0.0, 1.0):
        report(0.25)
        advance(1, 2)
    assert capsys.readouterr() == ("", "")


def test_table_aligns_and_shows_what_is_missing():
    rows = [{"name": "a", "cost": None, "good": True}, {"name": "long", "cost": 1 / 3, "good": False}]
    assert console.table(rows, ("name", "cost", "good")) == [
        "name  cost      good",
        "a     –         yes",
        "long  0.333333  no",
    ]
