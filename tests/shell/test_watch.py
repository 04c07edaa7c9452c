"""A watch loses no log and doubles none, whenever logs come and it is killed; its reports are those of one run."""

import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import pytest
from command_lines import fault
from labs import compare
from locks import is_free
from native_logs import FAULTS, log_text, short_log
from places import ROOT
from report_data import document_without_places

from pipeline.base.provenance import USER_FOLDER_VARIABLE
from pipeline.comparison import compare as comparison
from pipeline.comparison import plan as planning
from pipeline.comparison.scene.scene_file import read_scene
from pipeline.device_data.devices import load_device
from pipeline.intake.check import check
from pipeline.intake.ingest import ingest
from pipeline.intake.quarantine import list_quarantine
from pipeline.intake.sources import find_sources
from pipeline.profiles.profile_files import shipped_profiles
from pipeline.rendering.report.report_parts import take_apart
from pipeline.shell import watch
from pipeline.shell.commands.cli_report import WORDS, line_of
from pipeline.shell.watch import Arrivals, Watched, follow, run_pass, status_of
from pipeline.simulation.sweep import run_sweep, write_sweep
from pipeline.store.storage import read_trials

INTERVAL_S, SETTLE_S, PAUSE_S = 0.1, 0.8, 0.25
"""A half-written log stands still for a pause of several looks, which is shorter than the time to settle."""

A, B = (10, 1, 1), (20, 2, 2)

SCENE = """
device = "lwr"
criteria = ["overshoot"]
figures = []
tables = ["boundary"]
overlays = []
report = "reports/lwr.html"
"""


class Recorder:
    """Drops logs into a folder as a lab would: whole, in two parts, by renaming, at random moments."""

    def __init__(self, logs: list[Path], folder: Path, seconds: float) -> None:
        self.logs, self.folder = logs, folder
        self.random = random.Random(1)
        self.mean_s = seconds / len(logs)
        self.longest_pause_s = 0.0

    def drop(self, logs: list[Path]) -> None:
        for log in logs:
            time.sleep(self.random.uniform(0, 2 * self.mean_s))
            target = self.folder / log.parent.name / log.name
            target.parent.mkdir(exist_ok=True, parents=True)
            manner = self.random.random()
            if manner < 0.1:
                data = log.read_bytes()
                with target.open("wb") as stream:
                    stream.write(data[: len(data) // 2])
                    stream.flush()
                    began = time.monotonic()
                    time.sleep(PAUSE_S)
                    stream.write(data[len(data) // 2 :])
                self.longest_pause_s = max(self.longest_pause_s, time.monotonic() - began)
            elif manner < 0.3:
                hidden = target.with_name(f".{log.name}.part")
                shutil.copy2(log, hidden)  # with its time of long ago
                hidden.rename(target)
            else:
                shutil.copy(log, target)


class Process:
    """A watch as a process, with its events in a file."""

    def __init__(self, folder: Path, *options: str) -> None:
        self.folder = folder
        self.lines = folder / "events.jsonl"
        command = [sys.executable, "-m", "pipeline", "watch", "raw", "--json", *options]
        command += ["--settle", str(SETTLE_S)]
        with self.lines.open("a") as stream:
            self.process = subprocess.Popen(command, cwd=folder, stdout=stream, stderr=subprocess.PIPE, text=True)

    def events(self) -> list[dict]:
        return [json.loads(line) for line in self.lines.read_text().splitlines()]

    def wait_for(self, kind: str, seconds: float, **values: object) -> None:
        ended = time.monotonic() + seconds
        while time.monotonic() < ended:
            if any(e["event"] == kind and values.items() <= e.items() for e in self.events()):
                return
            assert self.process.poll() is None, self.process.communicate()
            time.sleep(0.05)
        raise AssertionError(f"no {kind} with {values} in {self.events()[-5:]}")

    def kill(self) -> None:
        self.process.kill()
        self.process.communicate()

    def stop(self, number: signal.Signals = signal.SIGTERM) -> str:
        self.process.send_signal(number)
        _, err = self.process.communicate(timeout=60)
        assert self.process.returncode == 0, err
        assert self.events()[-1]["event"] == "stopped"
        return err


def course(folder: Path, experiments: tuple[str, ...], coarsen: int) -> list[Path]:
    for name in experiments:
        write_sweep(run_sweep(load_device("lwr"), name, ideal=True, coarsen=coarsen), folder)
    return sorted(folder.rglob("*.csv"))


def cells_of_results(path: Path) -> dict[str, str]:
    found = take_apart(path.read_text(encoding="utf-8")).cells
    return {name: text for name, text in found.items() if name.split("/")[0] not in ("stages", "provenance")}


def follow_a_course(tmp_path: Path, logs: list[Path], seconds: float, options: tuple[str, ...], kills: int) -> None:
    raw = tmp_path / "raw"
    raw.mkdir()
    random.Random(2).shuffle(logs)
    recorder = Recorder(logs, raw, seconds)
    process = Process(tmp_path, *options)
    share = len(logs) // (kills + 1) + 1
    for number in range(kills + 1):
        recorder.drop(logs[number * share : (number + 1) * share])
        if number == 0:
            (raw / "broken.csv").write_text(FAULTS["text cell"][0])
        if number < kills:
            process.kill()
            process = Process(tmp_path, *options)
    process.wait_for("report", 120, trials=len(logs))
    while process.events()[-1]["event"] != "index":  # it comes last, and an end takes what is not written away
        time.sleep(0.05)
        assert process.process.poll() is None
    process.stop()
    events = process.events()

    trials = read_trials(tmp_path / "processed")
    assert Counter(Path(path).name for path in trials.column("source_path").to_pylist()) == Counter(
        log.name for log in logs
    )
    assert [Path(record.path).name for record in list_quarantine(tmp_path / "processed")] == ["broken.csv"]
    assert [e["path"] for e in events if e["event"] == "refused"].count("raw/broken.csv") <= 1 + kills
    assert is_free(tmp_path / "processed")
    if recorder.longest_pause_s < SETTLE_S / 2:  # the machine was not held up so long that a half log seemed whole
        # a watch that was killed between the refusal and its line has not told of it; the record is there, as above
        assert {e["path"] for e in events if e["event"] == "refused"} <= {"raw/broken.csv"}
        assert [e for e in events if e["event"] == "changed"] == []

    # the same logs in one run, and the same report
    ingest([raw], tmp_path / "processed-once")
    scene = read_scene(tmp_path / "scene.toml") if "--scene" in options else None
    compare(
        "lwr",
        tmp_path / "processed-once",
        criteria=scene.chosen_criteria if scene else None,
        shown=scene.shown if scene else None,
        report=tmp_path / "once.html",
    )
    kept, once = tmp_path / "reports" / "lwr.html", tmp_path / "once.html"
    assert document_without_places(kept.with_suffix(".json")) == document_without_places(once.with_suffix(".json"))
    assert cells_of_results(kept) == cells_of_results(once)
    assert len(cells_of_results(kept)) > 20
    index = (tmp_path / "reports" / "index.html").read_text(encoding="utf-8")
    assert f"{len(logs):,}</td>" in index


@pytest.mark.slow
def test_sixty_logs_at_random_moments_give_the_report_of_one_run(tmp_path):
    logs = course(tmp_path / "all", ("delay-6",), 3)[:60]
    assert len(logs) == 60
    (tmp_path / "scene.toml").write_text(SCENE)
    follow_a_course(tmp_path, logs, 2.5, ("--scene", "scene.toml"), kills=1)


@pytest.mark.slow
def test_five_hundred_logs_at_random_moments_give_the_report_of_one_run(tmp_path):
    logs = course(tmp_path / "all", ("delay-2", "delay-3"), 2)[:500]
    assert len(logs) == 500
    # all criteria and tables; figures take most of the time, and JSON and cells do not depend on them
    (tmp_path / "scene.toml").write_text('device = "lwr"\nfigures = []\nreport = "reports/lwr.html"\n')
    follow_a_course(tmp_path, logs, 15.0, ("--scene", "scene.toml"), kills=3)


def write_logs(folder: Path, count: int = 4, **more: object) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        path = folder / f"{more.get('device', 'bench')}{number}.csv"
        path.write_text(log_text(float(number), **more))
        os.utime(path, (1e9, 1e9))


def places(folder: Path, **more: object) -> Watched:
    more = {"settle_s": 0.0} | more
    return Watched((folder / "raw",), folder / "processed", folder / "reports", **more)


@pytest.fixture
def compared(monkeypatch):
    """Reports by device, which hold nothing but its name; an answer that is an exception is raised."""
    asked: dict[str, Path] = {}
    answers: dict[str, object] = {}

    def plan(selection, report):
        asked[selection.device] = report.path
        if selection.device in answers:
            raise answers[selection.device]
        return SimpleNamespace(unchanged=None, device=selection.device, path=report.path)

    def write(finished):
        finished.plan.path.parent.mkdir(exist_ok=True)
        finished.plan.path.write_text(finished.plan.device)

    empty = SimpleNamespace(experiments=())
    monkeypatch.setattr(planning, "plan_comparison", plan)
    monkeypatch.setattr(comparison, "run", lambda planned: SimpleNamespace(plan=planned, document=empty))
    monkeypatch.setattr(comparison, "write_report", write)
    return asked, answers


def kinds(events: list[dict]) -> list[str]:
    return [event["event"] for event in events]


def test_a_report_that_fails_stops_no_other(tmp_path, compared, capsys):
    from pipeline.base.errors import DeviceError

    asked, answers = compared
    for device in ("alpha", "bench", "gamma"):
        write_logs(tmp_path / "raw", device=device)
    answers |= {"alpha": DeviceError("too few logs"), "bench": ZeroDivisionError("a defect")}
    events = list(run_pass(places(tmp_path)))
    assert list(asked) == ["alpha", "bench", "gamma"]
    assert kinds(events) == ["ingest", "failed", "failed", "report", "index"]
    assert [e["reason"] for e in events[1:3]] == [
        "too few logs",
        "defect in the program: ZeroDivisionError('a defect'); please report it",
    ]
    assert "Traceback" in capsys.readouterr().err
    assert status_of(events) == 1


def test_every_device_has_a_report_of_its_own_beside_our_pages(tmp_path, compared):
    reports, _ = compared
    devices = ["index", "Index", "accuracy", "theory", "arm", "ARM", "arm-1-against-2", "con"]
    for device in devices:
        write_logs(tmp_path / "raw", 1, device=device)
    assert status_of(list(run_pass(places(tmp_path)))) == 0
    assert {device: path.read_text() for device, path in reports.items()} == {device: device for device in devices}
    names = [path.name.casefold() for path in reports.values()]
    assert len(set(names)) == len(devices)
    assert not {"index.html", "accuracy.html", "theory.html", "arm-1-against-2.html"} & set(names)
    assert "pipeline index" in (tmp_path / "reports" / "index.html").read_text()
    former = dict(reports)
    list(run_pass(places(tmp_path)))
    assert reports == former


@pytest.mark.slow
def test_a_damaged_experiment_keeps_no_other_report_from_being_renewed(tmp_path):
    logs = course(tmp_path / "raw", ("delay-2", "delay-4"), coarsen=12)
    late = logs[-1].rename(tmp_path / "late.csv")
    scenes = {"whole": ["delay-2", "delay-4"], "sound": ["delay-4"]}
    for name, experiments in scenes.items():
        text = SCENE.replace("reports/lwr", f"{tmp_path}/reports/{name}") + f"experiments = {json.dumps(experiments)}\n"
        (tmp_path / f"{name}.toml").write_text(text)
    asked = places(tmp_path, scenes=tuple(tmp_path / f"{name}.toml" for name in scenes))
    assert status_of(list(run_pass(asked))) == 0
    pages = {name: (tmp_path / "reports" / f"{name}.html").read_bytes() for name in scenes}
    (file,) = (tmp_path / "processed" / "trials" / "lwr" / "delay-2").iterdir()
    file.write_bytes(file.read_bytes()[:-8] + b"no table")
    for log in (path for path in logs if path.parent.name == "delay-2"):
        log.rename(tmp_path / log.name)  # what is there would be stored again
    late.rename(logs[-1])
    events = list(run_pass(asked))
    assert status_of(events) == 1
    failed = {event["what"]: event["reason"] for event in events if event["event"] == "failed"}
    assert failed.keys() == {"store", str(asked.scenes[0])}
    assert all(str(file) in reason and "pipeline check --repair" in reason for reason in failed.values())
    assert [event["ingested"] for event in events if event["event"] == "ingest"] == [1]
    reports = [(event["what"], event["trials"]) for event in events if event["event"] == "report"]
    assert reports == [(str(asked.scenes[1]), read_trials(tmp_path / "processed", "lwr", "delay-4").num_rows)]
    now = {name: (tmp_path / "reports" / f"{name}.html").read_bytes() for name in scenes}
    assert (now["whole"], now["sound"] == pages["sound"]) == (pages["whole"], False)
    assert check(tmp_path / "processed", repair=True).damage[0].remedy == "set aside"
    for log in (path for path in logs if path.parent.name == "delay-2"):
        (tmp_path / log.name).rename(log)
    events = list(run_pass(asked))
    assert status_of(events) == 0
    (renewed,) = (event for event in events if event["event"] == "report")
    assert (renewed["what"], renewed["trials"]) == (str(asked.scenes[0]), len(logs))


def test_young_and_growing_logs_are_left_and_told(tmp_path, compared):
    write_logs(tmp_path / "raw")
    young, growing = (tmp_path / "raw" / name for name in ("young.csv", "growing.csv"))
    young.write_text(log_text(99.0))
    growing.write_text(log_text(98.0))
    os.utime(growing, (1e9, 1e9))
    events = list(run_pass(places(tmp_path, settle_s=60.0), [str(growing)]))
    assert (events[0]["ingested"], sorted(events[0]["waiting"])) == (4, [str(growing), str(young)])
    list(run_pass(places(tmp_path)))
    assert read_trials(tmp_path / "processed").num_rows == 6


# The loop, with passes that do nothing but what is to be tested, and a clock of its own


class Lab:
    """A watch under a clock that goes on by waits alone; what happens in the lab stands by the number of the wait."""

    def __init__(self, tmp_path: Path, monkeypatch, passes, happens=None, **more) -> None:
        self.now, self.waits, self.growing, self.times = 0.0, 0, [], []
        self.passes, self.happens, self.end = passes, happens or {}, 0
        (tmp_path / "raw").mkdir(exist_ok=True)
        self.watched = Watched((tmp_path / "raw",), tmp_path / "processed", tmp_path / "reports", **more)
        # its own, and not that of the servers of this process
        monkeypatch.setattr(watch, "time", SimpleNamespace(monotonic=lambda: self.now, sleep=self.sleep))
        monkeypatch.setattr(watch, "run_pass", self.run_pass)

    def sleep(self, seconds: float) -> None:
        self.now += seconds
        self.waits += 1
        self.happens.get(self.waits, lambda: None)()
        if self.waits == self.end:
            raise InterruptedError

    def run_pass(self, _, growing):
        self.growing.append(list(growing))
        self.times.append(self.now)
        yield from self.passes(len(self.times))

    def events(self, waits: int) -> list[dict]:
        """What is told until so many waits are over."""
        self.end, found = waits, []
        told = follow(self.watched, 2.0)
        with suppress(InterruptedError):
            while True:
                found.append(next(told))
        return found


def test_a_pass_that_fails_is_told_once_and_tried_again_ever_more_rarely(tmp_path, monkeypatch):
    failed = {"event": "failed", "what": "bench", "reason": "full disk"}
    lab = Lab(tmp_path, monkeypatch, lambda number: [failed])
    assert kinds(lab.events(400)) == ["started", "failed"]
    assert [after - before for before, after in pairwise(lab.times)][:3] == pytest.approx([60, 120, 240], abs=2)


def test_failures_are_told_again_after_they_were_gone(tmp_path, monkeypatch):
    failed = {"event": "failed", "what": "bench", "reason": "too few"}
    report = {"event": "report", "what": "bench"}
    log = tmp_path / "raw" / "log.csv"
    happens = {number: lambda number=number: log.write_text("x" * number) for number in (3, 8, 13)}
    lab = Lab(tmp_path, monkeypatch, lambda number: [report] if number == 3 else [failed], happens)
    told = [event["event"] for event in lab.events(20) if event["event"] != "started"]
    assert told == ["failed", "report", "failed"]


def test_nothing_is_done_while_nothing_changes_and_growing_files_are_named(tmp_path, monkeypatch):
    (tmp_path / "raw").mkdir()
    (tmp_path / "raw" / "rests.csv").write_text("x")
    growing = tmp_path / "raw" / "grows.csv"
    happens = {number: lambda number=number: growing.write_text("x" * number) for number in range(1, 9)}
    lab = Lab(tmp_path, monkeypatch, lambda number: [], happens, settle_s=3.0)
    lab.events(60)
    assert lab.growing == [[str(growing)], []], "one as soon as a log rests, one when the other does, and no more"


def test_what_changes_reports_has_a_pass_done(tmp_path, monkeypatch):
    (tmp_path / "devices").mkdir()
    monkeypatch.setenv(USER_FOLDER_VARIABLE, str(tmp_path / "devices"))
    scene = tmp_path / "scene.toml"
    scene.write_text("a")
    happens = {
        5: lambda: (tmp_path / "devices" / "arm.toml").write_text("a"),
        10: lambda: (tmp_path / "devices" / "arm.toml").write_text("ab"),
        15: lambda: scene.write_text("ab"),
        20: lambda: (tmp_path / "raw").rename(tmp_path / "away"),
        25: lambda: (tmp_path / "away").rename(tmp_path / "raw"),
    }
    lab = Lab(tmp_path, monkeypatch, lambda number: [], happens, scenes=(scene,))
    assert kinds(lab.events(30)) == ["started", "failed"]
    assert len(lab.times) == 4


# The command


def test_once_tells_in_words_and_in_json(call, tmp_path, compared):
    write_logs(tmp_path / "raw")
    status, out, _ = call("watch", "raw", "--once")
    assert status == 0
    stamped = r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ "
    lines = out.splitlines()
    assert all(re.match(stamped, line) for line in lines)
    assert "logs: 4 new, 4 in total" in lines[0]
    (tmp_path / "raw" / "broken.csv").write_text(FAULTS["text cell"][0])
    (tmp_path / "raw" / "young.csv").write_text(log_text(99.0))
    os.utime(tmp_path / "raw" / "broken.csv", (1e9, 1e9))
    status, out, _ = call("watch", "raw", "--once", "--json", "--settle", "60")
    events = [json.loads(line) for line in out.splitlines()]
    assert status == 3
    assert kinds(events)[:2] == ["ingest", "refused"]
    assert all(line_of(event) for event in events)
    assert events[0]["waiting"] == ["raw/young.csv"]
    # found = ingested + skipped + quarantined holds here, too
    assert events[0]["found"] == events[0]["ingested"] + events[0]["skipped"] + events[0]["quarantined"] == 5


def test_once_leaves_with_1_where_a_report_failed(call, tmp_path, compared):
    write_logs(tmp_path / "raw")
    compared[1]["bench"] = OSError(28, "No space left on device")
    status, out, _ = call("watch", "raw", "--once")
    assert status == 1
    assert "failed: bench: [Errno 28] No space left on device" in out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["none"], "Directory 'none' does not exist"),
        (["raw", "--settle", "-1"], "--settle -1: expected a time of 0 s or more"),
        ([".", "--once"], "reports: is inside the watched folder"),
        (["raw", "--scene", "none.toml"], "'none.toml' does not exist"),
    ],
)
def test_wrong_usage_is_told_before_anything_is_begun(call, tmp_path, arguments, words):
    for name in ("raw", "processed"):
        (tmp_path / name).mkdir()
    status, out, err = call("watch", *arguments)
    assert (status, out) == (2, "")
    assert words in err
    assert not list((tmp_path / "processed").iterdir())


@pytest.mark.sampled
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_a_watch_with_status_0_and_no_process_left(tmp_path, number):
    write_logs(tmp_path / "raw")
    process = Process(tmp_path)
    process.wait_for("ingest", 60)
    err = process.stop(number)
    assert "Traceback" not in err
    assert is_free(tmp_path / "processed")
    assert read_trials(tmp_path / "processed").num_rows == 4
    assert not list(tmp_path.rglob("*.tmp"))


# What the page on it says


def test_the_command_of_cron_exists():
    text = (ROOT / "docs" / "plan.md").read_text(encoding="utf-8")
    commands = re.findall(r"bin/(pipeline watch .*)$", text, flags=re.MULTILINE)
    assert [fault(command) for command in commands] == [None]


def test_every_event_is_on_the_page_and_has_words():
    source = (ROOT / "pipeline" / "shell" / "watch.py").read_text()
    found = set(re.findall(r'"event": "(\w+)"', source)) | {"unchanged", "stopped", "report"}
    page = (ROOT / "docs" / "plan.md").read_text(encoding="utf-8")
    assert [kind for kind in sorted(found) if f"`{kind}`" not in page] == []
    assert found == set(WORDS)


def test_a_file_is_ready_when_it_was_the_same_for_the_time_asked_for():
    arrivals = Arrivals(settle_s=2.0)
    arrivals.update({"a": A}, 100.0)
    assert not arrivals.ready(101.9)
    assert arrivals.restless(101.9) == {"a": 102.0}
    arrivals.update({"a": A}, 102.0)
    assert arrivals.ready(102.0)
    assert arrivals.restless(102.0) == {}
    arrivals.take(102.0)
    assert not arrivals.ready(200.0)


def test_a_file_that_grows_is_not_ready_and_keeps_no_other_from_being_so():
    arrivals = Arrivals(settle_s=2.0)
    for second in range(10):
        arrivals.update({"grows": (second, second, second), "rests": A}, float(second))
        assert arrivals.ready(float(second)) == (second >= 2)
        assert "grows" in arrivals.restless(float(second))
    arrivals.take(9.0)
    assert not arrivals.ready(9.0)
    arrivals.update({"grows": (9, 9, 9), "rests": A}, 11.0)
    assert arrivals.ready(11.0)


@pytest.mark.parametrize("changed", [(11, 1, 1), (10, 2, 1), (10, 1, 2)], ids=["size", "content", "permissions"])
def test_each_change_makes_a_file_new(changed):
    arrivals = Arrivals(settle_s=0.0)
    arrivals.update({"a": A}, 0.0)
    arrivals.take(0.0)
    arrivals.update({"a": changed}, 1.0)
    assert arrivals.ready(1.0)


def test_a_change_while_a_pass_runs_is_seen_to_by_the_next():
    arrivals = Arrivals(settle_s=1.0)
    arrivals.update({"a": A}, 0.0)
    arrivals.update({"a": A}, 1.0)
    arrivals.take(1.0)
    arrivals.update({"a": B}, 40.0)
    assert not arrivals.ready(40.5)
    arrivals.update({"a": B}, 41.0)
    assert arrivals.ready(41.0)


def test_what_is_not_at_rest_is_not_taken():
    arrivals = Arrivals(settle_s=1.0)
    arrivals.update({"a": A}, 0.0)
    arrivals.take(0.5)
    assert arrivals.ready(1.0)


def test_a_look_sees_the_files_that_an_ingest_would_find(tmp_path):
    logs = tmp_path / "logs"
    processed = logs / "processed"
    elsewhere = tmp_path / "elsewhere"
    for folder in (logs, logs / "deep" / "deeper", logs / ".hidden", processed, elsewhere):
        folder.mkdir(parents=True)
    for number, folder in enumerate((logs, logs / "deep" / "deeper", logs / ".hidden", processed, elsewhere)):
        (folder / f"{number}.csv").write_text(short_log(float(number)))
    (logs / ".partial.csv").write_text("x")
    (logs / "linked.csv").symlink_to(elsewhere / "4.csv")
    (logs / "inside.csv").symlink_to("0.csv")
    (logs / "dangling").symlink_to(elsewhere / "none.csv")
    (logs / "linked-folder").symlink_to(elsewhere)
    arrivals = Arrivals(1.0)
    arrivals.look([logs, tmp_path / "gone"], [tmp_path / "none.toml"], exclude=[processed])
    sources = find_sources([logs], shipped_profiles(), processed)
    found = {source.key for source in sources if source.problem is None}
    assert len(found) == 4
    # a link that leads out is found, and refused when it is read
    seen = arrivals._seen
    assert found == {path for path in seen if path.endswith(".csv")}
    assert list(arrivals.troubles) == [str(tmp_path / "gone")]
    for path, ((size, mtime_ns, _), _) in seen.items():
        status = os.stat(path)
        assert (status.st_size, status.st_mtime_ns) == (size, mtime_ns)
