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


CARTS = {"mass": 0.87, "mode_mass": 0.29, "mode_frequency": 3.028}
"""Two carts on a spring: 0.58 and 0.29 V s^2/m; the frequency is sqrt(70 (1/0.58 + 1/0.29))/(2 pi)."""

REAL: dict[str, tuple[dict[str, float], str]] = {
    "real_fast_motor": ({}, "The sampling period"),
    "real_gain_direction": ({"positive": 1.2e-4 / 0.7, "negative": 1.2e-4 / 0.4}, ""),
    "real_load_damping": (CARTS, ""),
    "real_plateau": ({"damping": 0.257, "mass": 0.00327}, ""),
    "real_ramp_saturated": ({"force_limit": 65.5, "mass": 0.0033}, ""),
    "real_slow_mode": (CARTS, ""),
    "real_slow_mode_no_friction": (CARTS, ""),
    "real_cogging": ({}, "The errors depend on the position"),
}
"""True numbers of the drives behind the folders, and the reason where nothing is identified."""


@pytest.mark.slow
@pytest.mark.parametrize("folder", REAL)
def test_a_drive_is_identified_or_the_true_reason_is_given(folder: str) -> None:
    from pipeline import Loop
    from pipeline.surface.identify import identify

    truth, reason = REAL[folder]
    document = identify([FAULTS / folder]).document
    rows = {row["name"].replace("inertia", "mass"): row for row in document["parameters"]}
    known = rows | (document["drive"] or {})
    for name, value in truth.items():
        found, low, high = (known[name][key] for key in ("value", "low", "high"))
        # folders state two or three digits
        assert low - 0.005 * value <= value <= high + 0.005 * value, (name, found, low, high)
        assert abs(found / value - 1) < 0.02
    reasons = " ".join(row["reason"] or "" for row in rows.values())
    assert reason in reasons
    if folder == "real_ramp_saturated":  # the limit of the linear loop of the README
        limit = Loop(mass=0.0033, damping=0.257, sampling_period_s=0.002, delay_samples=1.5).boundary().stiffness.max()
        assert document["boundary"]["stiffness_max"]["low"] < limit < document["boundary"]["stiffness_max"]["high"]
    if folder in ("real_cogging", "real_gain_direction", "real_fast_motor"):
        assert document["boundary"] is None, "no limit of walls without an adequate device"
