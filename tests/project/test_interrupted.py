"""What an ingest has stored when it is stopped counts, and the next one finds the rest."""

import os
import signal
import subprocess
import sys
import time

import pytest
from native_logs import FAULTS, log_text
from stored import stored_rows

from pipeline.intake import ingest as ingest_module
from pipeline.intake.ingest import ingest

COMMAND = [sys.executable, "-c", "from pipeline.shell.cli import run; run()", "ingest", "logs", "--jobs", "1"]


def test_an_interrupted_ingest_is_finished_by_the_next(tmp_path, monkeypatch):
    (tmp_path / "logs").mkdir()
    for number in range(6):
        (tmp_path / "logs" / f"{number}.csv").write_text(log_text(float(number + 1)))
    (tmp_path / "logs" / "0bad.csv").write_text(FAULTS["text cell"][0])
    monkeypatch.setattr(ingest_module, "PENDING_BYTES", 3 * 30 * 24)  # three logs

    def stop(done, found):
        if done == 6:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ingest([tmp_path / "logs"], tmp_path / "processed", jobs=1, progress=stop)
    stored = stored_rows(tmp_path / "processed").total()
    assert 0 < stored < 6
    again = ingest([tmp_path / "logs"], tmp_path / "processed", jobs=1)
    assert (again.ingested, again.skipped, len(again.quarantined)) == (6 - stored, stored, 1)


def test_ctrl_c_is_answered_on_stderr(tmp_path):
    (tmp_path / "logs").mkdir()
    for number in range(3000):
        (tmp_path / "logs" / f"{number}.csv").write_text(log_text(float(number + 1), rows=200))
    process = subprocess.Popen(COMMAND, cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
    while not (tmp_path / "processed" / ".lock").exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    time.sleep(0.5)  # until it reads logs
    os.kill(process.pid, signal.SIGINT)
    _, told = process.communicate(timeout=60)
    assert process.returncode != 0
    assert "Traceback" not in told
    assert "Each file is complete or as it was before: run the command again for what is left." in told
