"""Inputs that once failed (../shared/faults): each native log is checked as a recording, the first is looked at."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from places import ROOT

from pipeline.recording.check import check_recording
from pipeline.recording.samples import Samples

FAULTS = ROOT.parent / "shared" / "faults"
LOGS = sorted(FAULTS.rglob("*.csv"))
FIRST = {log.parent: log for log in reversed(LOGS)}
HEADER = "time_s,command,position"

pytestmark = pytest.mark.skipif(not LOGS, reason="the folder of former faults is not next to the project")


def native_logs() -> list[Path]:
    return [log for log in LOGS if HEADER in log.read_text(encoding="utf-8", errors="replace").splitlines()[:20]]


def test_every_motion_is_checked_to_its_end() -> None:
    checked = 0
    for log in native_logs():
        lines = log.read_text(encoding="utf-8").splitlines()
        rows = lines[lines.index(HEADER) + 1 :]
        try:
            time, command, position = np.array([row.split(",") for row in rows], dtype=np.float64).T
        except ValueError:  # a damaged row is refused by the reader
            continue
        if len(time) < 2 or not (np.diff(time) > 0).all():
            continue
        assert all(finding.evidence for finding in check_recording(Samples(time, command, position, 1e-3)))
        checked += 1
    assert checked >= 50


@pytest.mark.parametrize("log", FIRST.values(), ids=lambda log: log.relative_to(FAULTS).parent.as_posix())
def test_a_log_that_once_failed_is_shown_or_refused(call, log: Path) -> None:
    status, out, err = call("look", log)
    assert status in (0, 1)
    assert (out or err).strip()
    assert status == 0 or err.startswith("Error: ")
