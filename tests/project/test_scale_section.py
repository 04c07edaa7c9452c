"""The commands that the README has for a cluster and a store, as they stand there, with a small course."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from clusters import free_port
from places import ROOT

HEADING = "## More than a machine holds"
SHORTER = {
    "pipeline simulate lwr ": "pipeline simulate lwr --coarsen 12 --experiment delay-2 --experiment delay-3 ",
    "pipeline compare --device lwr ": "pipeline compare --device lwr --criteria settle_2pct --json ",
}


def script(ports):
    section = (ROOT / "README.md").read_text(encoding="utf-8").split(HEADING)[1].split("\n## ")[0]
    lines = re.findall(r"^ {4}(.*)$", section, flags=re.MULTILINE)
    assert lines[0].startswith("pip install"), "all else comes from packages"
    text = "\n".join(line.split("#")[0] for line in lines[1:])
    for old, new in (SHORTER | ports).items():
        assert old in text, old
        text = text.replace(old, new)
    return text


@pytest.mark.slow
def test_the_commands_of_the_readme_work(tmp_path):
    store, leader = str(free_port()), str(free_port())
    ports = {"5000": store, "8786": leader, "dask scheduler ": f"dask scheduler --port {leader} --no-dashboard "}
    folder = Path(sys.executable).parent
    environment = {**os.environ, "PATH": f"{folder}{os.pathsep}{os.environ['PATH']}", "OPENBLAS_NUM_THREADS": "1"}
    with open(tmp_path / "out", "wb") as out, open(tmp_path / "log", "wb") as log:
        command = ["bash", "-e", "-c", script(ports)]
        process = subprocess.Popen(
            command, cwd=tmp_path, env=environment, stdout=out, stderr=log, start_new_session=True
        )
        try:
            assert process.wait(600) == 0, (tmp_path / "log").read_text()
        finally:
            os.killpg(process.pid, signal.SIGKILL)
    assert '"command": "pipeline compare --device lwr ' in (tmp_path / "out").read_text()
    assert "--processed s3://lab/processed" in (tmp_path / "out").read_text()
    assert (tmp_path / "reports" / "lwr.html").stat().st_size > 100_000
    assert not (tmp_path / "processed").exists()
