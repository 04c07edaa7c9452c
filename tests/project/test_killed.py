"""Commands that are ended at random moments: no process is left, no reader of their output waits, nothing is lost."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from locks import is_free
from report_data import document_without_places

from pipeline.device_data.devices import load_device
from pipeline.simulation.sweep import run_sweep, write_sweep
from pipeline.store.storage import read_trials

pytestmark = pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="processes are found in /proc")

MARK = "PIPELINE_TEST_MARK"
LATEST_S = 5.0
"""No process outlives its parent by more, nor keeps its output open."""

LONGEST_TURN_S = 1.0
"""Processor time in which a process that only begins sees that its parent is gone, on a machine that lets it wait."""

SCENE = """
device = "lwr"
criteria = ["settle_2pct", "overshoot"]
figures = []
tables = ["boundary", "D.1", "D.2"]
overlays = []
report = "reports/lwr.html"
"""

DEMO = """
from pipeline.shell import demo
from pipeline.shell.cli import run
demo.PARTS = (demo.Part("lwr", ("delay-2", "delay-4"), coarsen=12),)
run(["demo"])
"""

Manner = tuple[signal.Signals, ...]
MANNERS: tuple[Manner, ...] = (
    (signal.SIGKILL,),
    (signal.SIGTERM,),
    (signal.SIGTERM, signal.SIGTERM),
    (signal.SIGINT,),
    (signal.SIGHUP,),
)


def report(folder: Path) -> object:
    return document_without_places(folder / "reports" / "lwr.json")


def results(folder: Path) -> object:
    """The report without its origin: logs that are simulated anew are newer."""
    return {
        key: value
        for key, value in document_without_places(folder / "reports" / "lwr.json").items()
        if key != "provenance"
    }


def stored(folder: Path) -> object:
    """Trials, in whatever files."""
    table = read_trials(folder / "processed").drop_columns(["sample_file", "sample_row"])
    return sorted(map(str, table.to_pylist()))


def printed(out: str) -> Callable[[Path], object]:
    return lambda folder: json.loads((folder / out).read_text())


@dataclass(frozen=True)
class Command:
    """A command that is killed, the one that does what is left, and what that comes to."""

    arguments: tuple[str, ...]
    result: Callable[[Path], object]
    needs: tuple[str, ...] = ("raw",)
    again: tuple[str, ...] | None = None
    program: tuple[str, ...] = ("-m", "pipeline")
    removes: tuple[str, ...] = ()
    seconds: float | None = None
    """Time within which it is killed, where it would go on for ever or for long [s]."""


COMPARE = ("compare", "--scene", "scene.toml", "--json")
COMMANDS = {
    "ingest": Command(("ingest", "raw", "--json"), stored, removes=("processed",)),
    "compare": Command(COMPARE, report, removes=("processed/stages", "processed/theory", "reports")),
    "verify": Command(("verify", "reports/lwr.html", "--json"), printed("out.json")),
    "watch": Command(
        ("watch", "raw", "--scene", "scene.toml", "--settle", "0.1", "--json"),
        report,
        again=("watch", "raw", "--scene", "scene.toml", "--once", "--settle", "0", "--json"),
        removes=("processed", "reports"),
    ),
    "theory tables": Command(("theory", "tables", "C.1", "--json"), printed("out.json"), seconds=8.0),
    "accuracy": Command(
        ("accuracy", "--quick", "--json"),
        lambda folder: sorted(json.loads((folder / "reports" / "accuracy.json").read_text())),
        seconds=8.0,
    ),
    "demo": Command((), results, program=("-c", DEMO), removes=("raw", "processed", "reports")),
}


@pytest.fixture(scope="module")
def ingested(tmp_path_factory) -> Path:
    """A folder with logs, their trials and a scene."""
    folder = tmp_path_factory.mktemp("course")
    for name in ("delay-2", "delay-4"):
        write_sweep(run_sweep(load_device("lwr"), name, ideal=True, coarsen=12), folder / "raw")
    (folder / "scene.toml").write_text(SCENE)
    assert Run(COMMANDS["ingest"], folder).finished() == 0
    return folder


@pytest.fixture(scope="module")
def course(ingested) -> Path:
    """The same with its report."""
    assert Run(COMMANDS["compare"], ingested).finished() == 0
    return ingested


class Run:
    """A command in a process of its own, with all processes that come of it, and a reader of what it prints."""

    def __init__(
        self, command: Command, folder: Path, arguments: tuple[str, ...] | None = None, **options: Any
    ) -> None:
        self.folder = folder
        self.mark = f"{MARK}={folder}-{time.monotonic_ns()}"
        name, value = self.mark.split("=")
        line = [sys.executable, *command.program, *(command.arguments if arguments is None else arguments)]
        self.errors = (folder / "errors.txt").open("wb")
        self.process = subprocess.Popen(
            line, cwd=folder, env=os.environ | {name: value}, stdout=subprocess.PIPE, stderr=self.errors, **options
        )
        self.errors.close()
        self.out = b""
        self.reader = threading.Thread(target=self._read)
        self.reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        with self.process.stdout as stream:
            for line in stream:
                self.out += line

    def finished(self) -> int:
        """Wait for its end, and keep what it printed."""
        status = self.process.wait(600)
        self.reader.join(LATEST_S)
        (self.folder / "out.json").write_bytes(self.out)
        return status

    def had_not_begun(self) -> bool:
        """Whether Python itself was stopped while it began, which ends it with status 1."""
        told = (self.folder / "errors.txt").read_text()
        return "init_import_site" in told or "Could not import runpy module" in told

    def left(self) -> dict[int, str]:
        """Processes that came of it and still run, with their command lines."""
        found = {}
        for place in Path("/proc").iterdir():
            try:
                if place.name.isdigit() and self.mark.encode() in (place / "environ").read_bytes():
                    found[int(place.name)] = (place / "cmdline").read_text().replace("\0", " ")
            except OSError:
                continue
        return found

    def settles(self, ended: Callable[[], bool]) -> bool:
        """Whether something holds after `LATEST_S`; later where the machine lets what is left wait for its turn."""
        began, spent = time.monotonic(), self.spent()
        while not ended():
            if time.monotonic() - began > LATEST_S and (self.spent() - spent > LONGEST_TURN_S or not self.waits()):
                return ended()
            time.sleep(0.05)
        return True

    def spent(self) -> float:
        """Processor time of what is left [s]."""
        return sum(sum(map(int, status[11:13])) for status in self.states()) / os.sysconf("SC_CLK_TCK")

    def waits(self) -> bool:
        """Whether a process that is left waits for a processor."""
        return any(status[0] == "R" for status in self.states())

    def states(self) -> list[list[str]]:
        """State and counts of what is left, as the kernel lists them behind the name."""
        found = []
        for number in self.left():
            with suppress(OSError):
                found.append(Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split())
        return found

    def end(self, manner: Manner) -> int:
        """Send signals, 0.2 s between them; fail where something is left."""
        for number in manner:
            self.process.send_signal(number)
            if number != manner[-1]:
                time.sleep(0.2)
        assert self.settles(lambda: not self.left()), f"{manner}: left after {LATEST_S:g} s: {self.left()}"
        self.reader.join(LATEST_S)
        assert not self.reader.is_alive(), f"{manner}: its output is still open"
        return self.process.wait(LATEST_S)


def begun(name: str, course: Path, folder: Path, **options: Any) -> Run:
    """A command that has processes at work."""
    command = COMMANDS[name]
    shutil.copytree(course, folder)
    for part in command.removes:
        shutil.rmtree(folder / part, ignore_errors=True)
    run = Run(command, folder, **options)
    while not any("spawn_main" in line for line in run.left().values()):
        time.sleep(0.05)
        assert run.process.poll() is None, run.out
    return run


def kill_often(name: str, course: Path, folder: Path, kills: int, seed: int) -> None:
    command = COMMANDS[name]
    again = command.arguments if command.again is None else command.again
    shutil.copytree(course, folder)
    for part in command.removes:
        shutil.rmtree(folder / part, ignore_errors=True)
    began = time.monotonic()
    assert Run(command, folder, again).finished() in (0, 1)
    whole_s = command.seconds or time.monotonic() - began
    expected = command.result(folder)
    moments = random.Random(seed)
    running = 0
    for number in range(kills):
        if number % 5 == 0:
            for part in command.removes:
                shutil.rmtree(folder / part, ignore_errors=True)
        run = Run(command, folder)
        time.sleep(moments.uniform(0, whole_s))
        running += run.process.poll() is None
        manner = MANNERS[number % len(MANNERS)]
        status = run.end(manner)
        assert status in (0, *(-number for number in manner)) or run.had_not_begun(), status
        assert is_free(folder / "processed")
        if number % 5 == 4 or number == kills - 1:
            assert Run(command, folder, again).finished() in (0, 1)
            assert command.result(folder) == expected
    assert running > kills / 4, "few were killed before they had ended"


@pytest.mark.slow
@pytest.mark.sampled
@pytest.mark.parametrize("manner", [(signal.SIGKILL,), (signal.SIGTERM,)])
@pytest.mark.parametrize("name", ["compare", "verify"])
def test_workers_end_with_a_command(name, manner, course, tmp_path):
    run = begun(name, course, tmp_path / "here")
    assert run.end(manner) == -manner[0], run.out


@pytest.mark.slow
@pytest.mark.parametrize("manner", [(signal.SIGKILL,), (signal.SIGTERM, signal.SIGTERM)])
def test_workers_of_a_pass_end_with_a_watch(manner, course, tmp_path):
    run = begun("watch", course, tmp_path / "here")
    assert run.end(manner) in (0, -manner[0])


@pytest.mark.slow
def test_a_watch_goes_on_when_a_worker_of_its_pass_dies(course, tmp_path):
    run = begun("watch", course, tmp_path / "here")
    one = next(process for process, line in run.left().items() if "spawn_main" in line)
    os.kill(one, signal.SIGKILL)
    assert run.settles(lambda: not any("spawn_main" in line for line in run.left().values())), run.left()
    assert run.end((signal.SIGINT,)) == 0
    assert b'"stopped"' in run.out


def test_a_reader_of_files_ends_with_its_parent_whatever_its_library_does(tmp_path):
    note = tmp_path / "pid"
    script = "from pipeline.readers.isolation import isolated\n"
    script += f"isolated('misbehaving:keep', 'a file', 0, 'log', {os.fsencode(note)!r})"
    path = os.pathsep.join(sys.path)
    process = subprocess.Popen([sys.executable, "-c", script], env=os.environ | {"PYTHONPATH": path})
    while not (note.exists() and note.read_text()):
        time.sleep(0.05)
        assert process.poll() is None
    process.kill()
    process.wait()
    until = time.monotonic() + LATEST_S
    while Path(f"/proc/{note.read_text()}").exists() and time.monotonic() < until:
        time.sleep(0.05)
    assert not Path(f"/proc/{note.read_text()}").exists()


def test_a_signal_that_is_ignored_stays_so(ingested, tmp_path):
    """As `nohup` asks for."""
    run = begun("compare", ingested, tmp_path / "here", preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN))
    run.process.send_signal(signal.SIGHUP)
    time.sleep(0.2)
    assert run.process.poll() is None
    assert run.end((signal.SIGTERM,)) == -signal.SIGTERM


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_fifty_ends_leave_no_process_and_lose_nothing(name, course, tmp_path):
    kill_often(name, course, tmp_path / "here", 50, seed=7)
