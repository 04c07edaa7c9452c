"""Commands where the operating system offers less: what Windows lacks is taken away, in all processes."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys

import pytest
from places import ROOT
from report_data import document_without_places

from pipeline.device_data.devices import load_device
from pipeline.simulation.sweep import run_sweep, write_sweep

MODULES = ("fcntl", "resource", "pwd", "grp", "termios", "tty", "pty", "syslog")
OF_SIGNAL = ("SIGHUP", "SIGALRM", "SIGPROF", "SIGXFSZ", "SIGIO", "SIGUSR1", "alarm", "setitimer", "ITIMER_PROF")
OF_OS = (
    *("fork", "nice", "getuid", "geteuid", "getgid", "pread", "pwrite", "wait4", "killpg", "getpgid", "setsid"),
    *("fchmod", "chown", "mkfifo", "mknod", "statvfs", "sysconf", "sched_getaffinity", "setpgid", "getloadavg"),
    *("O_ASYNC", "O_DIRECTORY", "O_NOFOLLOW", "O_NDELAY", "O_SYNC"),
)
"""Names that Python does not have on Windows, but for those that its own modules need here (`shutil`: O_NONBLOCK)."""

# the libraries that have branches for each system, and the modules of Python that have, are loaded before
SITE = f"""
import os, signal, sys
import asyncio, concurrent.futures.process, ctypes, filelock, logging, multiprocessing.spawn, platform, shutil
import subprocess
import multiprocessing.popen_spawn_posix, multiprocessing.resource_tracker, random, tempfile, threading
for name in {MODULES!r}:
    sys.modules[name] = None
for module, names in ((os, {OF_OS!r}), (signal, {OF_SIGNAL!r})):
    for name in names:
        if hasattr(module, name):
            delattr(module, name)
"""


@pytest.fixture(scope="module")
def poor(tmp_path_factory) -> dict[str, str]:
    """An environment in which every process of Python lacks these names."""
    folder = tmp_path_factory.mktemp("site")
    (folder / "sitecustomize.py").write_text(SITE)
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)])}


def test_the_names_are_taken_away(poor):
    script = "import os, signal\nprint(hasattr(os, 'nice'), hasattr(signal, 'SIGHUP'))\nimport fcntl"
    done = subprocess.run([sys.executable, "-c", script], env=poor, capture_output=True, text=True)
    assert done.stdout == "False False\n"
    assert "No module named 'fcntl'" in done.stderr or "import of fcntl halted" in done.stderr


def test_readers_work_in_processes_of_their_own(poor):
    script = "from pipeline.readers.isolation import isolated\n"
    script += "print([isolated('misbehaving:shout', 'a file', 0, 'log', b'a', 'b') for _ in range(2)])"
    path = os.pathsep.join([poor["PYTHONPATH"], str(ROOT / "tests" / "support")])
    done = subprocess.run(
        [sys.executable, "-c", script], env=poor | {"PYTHONPATH": path}, capture_output=True, text=True
    )
    assert done.stdout == "['ab', 'ab']\n", done.stderr


@pytest.mark.slow
def test_a_course_is_ingested_compared_watched_and_verified(poor, tmp_path):
    for name in ("delay-2", "delay-4"):
        write_sweep(run_sweep(load_device("lwr"), name, ideal=True, coarsen=12), tmp_path / "raw")
    (tmp_path / "scene.toml").write_text(
        'device = "lwr"\ncriteria = ["settle_2pct", "overshoot"]\nfigures = []\ntables = ["boundary", "D.1"]\n'
        'overlays = []\nreport = "reports/lwr.html"\n'
    )

    def call(*arguments: str, env: dict[str, str] = poor) -> subprocess.CompletedProcess[str]:
        done = subprocess.run(
            [sys.executable, "-m", "pipeline", *arguments], cwd=tmp_path, env=env, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        return done

    assert json.loads(call("ingest", "raw", "--json").stdout)["ingested"] > 20
    call("compare", "--scene", "scene.toml", "--json")
    found = document_without_places(tmp_path / "reports" / "lwr.json")
    assert json.loads(call("verify", "reports/lwr.html", "--json").stdout)["equal"]
    assert json.loads(call("status", "--json").stdout)["experiments"]
    shutil.rmtree(tmp_path / "reports")
    line = [sys.executable, "-m", "pipeline", "watch", "raw", "--scene", "scene.toml", "--settle", "0", "--json"]
    with subprocess.Popen(line, cwd=tmp_path, env=poor, stdout=subprocess.PIPE, text=True) as watching:
        assert watching.stdout is not None
        assert any(json.loads(line)["event"] == "index" for line in watching.stdout)
        watching.terminate()
        assert '"stopped"' in watching.stdout.read()
    assert watching.returncode == 0
    assert document_without_places(tmp_path / "reports" / "lwr.json") == found
    assert '"unchanged"' in call("watch", "raw", "--scene", "scene.toml", "--once", "--json").stdout
    rich = os.environ | {"PYTHONPATH": str(ROOT)}
    call(
        *["compare", "--scene", "scene.toml", "--processed", "processed", "--report", "reports/rich.html", "--json"],
        env=rich,
    )
    assert document_without_places(tmp_path / "reports" / "rich.json") == found
