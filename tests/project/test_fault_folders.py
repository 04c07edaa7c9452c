"""Inputs that once failed (../shared/faults): the first log of each folder is looked at without a traceback."""

from __future__ import annotations

from pathlib import Path

import pytest
from places import ROOT

FAULTS = ROOT.parent / "shared" / "faults"
LOGS = [next(iter(sorted(folder.rglob("*.csv"))), None) for folder in sorted(FAULTS.glob("*/"))]


@pytest.mark.skipif(not FAULTS.is_dir(), reason="the folder of former faults is not next to the project")
@pytest.mark.parametrize("log", [log for log in LOGS if log], ids=lambda log: log.parent.name)
def test_a_log_that_once_failed_is_shown_or_refused(call, log: Path) -> None:
    status, out, err = call("look", log)
    assert status in (0, 1)
    assert (out or err).strip()
    assert status == 0 or err.startswith("Error: ")
