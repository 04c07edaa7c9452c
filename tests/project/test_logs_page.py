"""docs/logs.md: its files are written and its commands run, in order, in an empty folder with nothing else."""

import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from places import ROOT

from pipeline.profiles.profile_model import (
    ConditionUnits,
    Constants,
    FileEntry,
    Fraction,
    Partner,
    PositionSource,
    Profile,
    StepEntry,
    TimeSource,
    Window,
)
from pipeline.shell.cli import run

STEP = 8.0
TIME_S = np.array([0.0, 0.001, 0.002])
FORCE = np.array([0.0, STEP, STEP])
POSITION_MM = np.array([0.0, 0.0, 0.02])


def parquet() -> None:
    import pyarrow as pa
    from pyarrow import feather
    from pyarrow.parquet import write_table

    table = pa.table({"t_us": [0, 1000, 2000], "F": FORCE, "x": [[x, 1.0] for x in POSITION_MM]})
    write_table(table, "log.parquet")
    feather.write_feather(table, "log.feather")


def matlab() -> None:
    from scipy.io import savemat

    log = {"t": 25.372 + TIME_S, "minus_F": -FORCE, "x": POSITION_MM / 1e3}
    savemat("wall.mat", {"log": log, "K": 300.0})


def bag() -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    names = ("sensor_msgs/msg/JointState", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    joints, header, stamp = (store.types[name] for name in names)
    with Writer(Path("bag"), version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topic = writer.add_connection("/joints", joints.__msgtype__, typestore=store)
        for k, (torque, angle) in enumerate(zip(FORCE, POSITION_MM, strict=True)):
            head = header(stamp=stamp(sec=1700000000, nanosec=1_000_000 * k), frame_id="arm")
            message = joints(head, ["joint"], *(np.array([value]) for value in (angle, 0.0, torque)))
            packed = store.serialize_cdr(message, joints.__msgtype__)
            writer.write(topic, 10**9 * 1700000000 + 1_000_000 * k, packed)


WRITERS: dict[str, Callable[[], None]] = {f"{writer.__name__}.toml": writer for writer in (parquet, matlab, bag)}
"""What writes the sample that a profile of docs/logs.md reads, by the file of the profile."""

PAGE = (ROOT / "docs" / "logs.md").read_text(encoding="utf-8")
CONDITIONS = f"""device = "rig"
experiment = "1"
stiffness = 300
damping = 2
step = {STEP}
sampling_period_s = 0.001
"""
BLOCK = re.compile(r"^```(\w+) ?(\S*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks(text):
    return [match.groups() for match in BLOCK.finditer(text)]


def section(title):
    """Text of a section, up to the next one of its rank."""
    start = PAGE.index(f"{title}\n")
    rank = title.split()[0]
    end = re.search(rf"^#{{1,{len(rank)}}} ", PAGE[start + len(title) :], re.MULTILINE)
    return PAGE[start : start + len(title) + end.start()] if end else PAGE[start:]


def rest_of_a_profile(name, content):
    """What the page leaves out of a profile for a format of its own, whose sample is written on the way."""
    if name not in WRITERS:
        return ""
    assert "[constants]" not in content
    WRITERS[name]()
    motion = 'motion = "rotation"\n' if "rad" in content else ""
    return "\n[constants]\n" + motion + CONDITIONS


def follow(text, capsys):
    """Do what a page says; returns what each command printed."""
    printed = []
    for language, name, content in blocks(text):
        if language != "sh":
            assert name, "a file needs a name"
            Path(name).parent.mkdir(parents=True, exist_ok=True)
            Path(name).write_text(content + rest_of_a_profile(name, content), encoding="utf-8")
            continue
        for line in content.splitlines():
            command, _, expected = line.partition(" # status ")
            words = shlex.split(command)
            if words[0] == "python":
                subprocess.run([sys.executable, *words[1:]], check=True, timeout=60)
                continue
            assert words[0] == "pipeline", line
            with pytest.raises(SystemExit) as leaving:
                run(words[1:])
            out, err = capsys.readouterr()
            assert (leaving.value.code or 0) == int(expected or 0), f"{line}\n{out}\n{err}"
            printed.append((command, out, err))
    return printed


@pytest.fixture(autouse=True)
def empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")


@pytest.mark.slow
def test_from_a_foreign_csv_to_a_report(capsys):
    printed = follow(section("## From a foreign CSV to a report"), capsys)
    outputs = {command: out + err for command, out, err in printed}
    questions = outputs["pipeline profile check lab.toml lab/K4800_B24.csv"]
    assert "would be stored" in questions
    assert "would be stored" in outputs["pipeline profile check draft.toml lab/K4800_B24.csv"]
    # the page shows part of the draft as it is written
    (shown,) = re.findall(r"```text part_of_the_draft.txt\n(\[columns\.position\]\n.*?)```", PAGE, re.DOTALL)
    assert shown in Path("draft.toml").read_text(encoding="utf-8")
    report = Path("reports/bench.html").read_text(encoding="utf-8")
    assert "<svg" in report
    assert "tability boundar" in report
    assert "stability limit" in outputs["pipeline compare --device bench"]
    assert "lab/K100_B1.csv, row 4: " in outputs["pipeline ingest lab --profile lab.toml"]
    assert 'missing = ["--"]' in outputs["pipeline quarantine lab/K100_B1.csv"]
    assert outputs["pipeline ingest lab/K100_B1.csv --profile lab.toml"].splitlines()[1].split() == ["1", "1", "0", "0"]


@pytest.mark.slow
def test_the_foreign_course_gives_the_same_trials_as_the_simulated_logs(capsys):
    from pipeline.intake.ingest import ingest
    from pipeline.store.samples import load_trials
    from pipeline.store.storage import read_trials

    text = section("## From a foreign CSV to a report")
    follow(text[: text.index("**When a log is refused")].replace("pipeline compare --device bench\n", ""), capsys)
    assert ingest([Path("simulated")], Path("native")).quarantined == ()
    found, true = (load_trials(folder, read_trials(folder)) for folder in (Path("processed"), Path("native")))

    def by_condition(trials):
        return sorted(trials, key=lambda trial: (trial.stiffness, trial.damping))

    assert len(found) == len(true) > 80
    for a, b in zip(by_condition(found), by_condition(true), strict=True):
        assert (a.stiffness, a.damping, a.rows) == (b.stiffness, b.damping, b.rows)
        # six digits of mm and N were written
        assert abs(a.position - b.position).max() < 1e-9
        assert abs(a.command - b.command).max() < 1e-6


FAMILIES = re.findall(r"^### (.*)$", section("## One example for each kind of file"), re.MULTILINE)


@pytest.mark.sampled
@pytest.mark.parametrize("title", FAMILIES)
def test_each_family_is_read(title, capsys):
    printed = follow(section(f"### {title}"), capsys)
    assert any("would be stored" in out for _, out, _ in printed)


def test_families_and_their_values(capsys):
    assert len(FAMILIES) == 11
    (_, out, _), *_ = follow(section("### Headerless columns in counts"), capsys)
    # 1000 us over the wrap: 4294967296 - 4294966796 + 500
    assert re.search(r"time +0 to 0\.003 s", out)
    assert "wraps 1" in out
    (_, out, _), *_ = follow(section("### Banner with labels and values"), capsys)
    assert re.search(r"stiffness +32000 N/m +from attributes: 'Gain'", out)
    assert "the last row (line" in out
    (_, out, _), *_ = follow(section("### Several steps in one file, and runs that are disturbed later"), capsys)
    assert re.search(r"trial '8 N'.*step +row 2: declared, at 0\.006 s", out, re.DOTALL)
    _, (_, out, _) = follow(section("### Released, hit, free, or a staircase"), capsys)
    assert re.search(r"step +0 N +from kind = 'release'", out)
    assert "none: the device is released at 0.01 s" in out
    (_, out, _), *_ = follow(section("### A velocity and no position"), capsys)
    # (28.6 + 57.3) deg/s over 1 ms each
    assert re.search(r"position +0 to 0\.0014992\d* rad +from omega \[deg/s, integrate difference\]", out)
    (_, out, _), *_ = follow(section("### Delimited text"), capsys)
    assert re.search(r"stiffness +1145\.9\d* Nm/rad", out)  # 20 Nm/deg 180/pi
    assert "skipped_position 1" in out


def test_every_key_of_a_profile_is_in_the_table():
    table = section("## All keys of a profile")
    models = (Profile, TimeSource, PositionSource, Fraction, Constants, ConditionUnits, FileEntry, StepEntry, Window)
    keys = {key for model in (*models, Partner) for key in model.model_fields}
    parts = set(re.findall(r"[A-Za-z_]+", " ".join(re.findall(r"`([^`]+)`", table))))
    assert keys - parts - {"columns"} == set()
