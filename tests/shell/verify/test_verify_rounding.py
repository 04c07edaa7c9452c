"""What counts as equal on another machine, and what does not."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from kernels import WITHOUT, environment

from pipeline.comparison.compare import compare
from pipeline.device_data.devices import load_device
from pipeline.intake.ingest import ingest
from pipeline.shell.demo import run_demo
from pipeline.shell.verify.verify_rounding import same_text, same_value
from pipeline.simulation.course import run_course, write_course


@pytest.mark.parametrize(
    ("a", "b", "same"),
    [
        ("overlap 92.4 % of 2529 trials", "overlap 92.5 % of 2529 trials", True),
        ("overlap 92.4 % of 2529 trials", "overlap 92.6 % of 2529 trials", False),
        ("2529 trials", "2528 trials", False),
        ("0.99", "1.00", True),
        ("0.99", "1.0", False),
        ("1.5e-07", "1.6e-07", False),
        ("1.67e-13", "-4e-14", True),
        ("\N{MINUS SIGN}0.1", "0.1", False),
        ("0.1 N/m", "0.1 Ns/m", False),
        ("", "0", False),
    ],
)
def test_texts_may_differ_by_one_in_the_last_decimal(a, b, same):
    assert same_text(a, b) is same_text(b, a) is same


@pytest.mark.parametrize(
    ("place", "a", "b", "same"),
    [
        ("/boundary/3/low", 6154.0, 6154.00006, True),
        ("/boundary/3/low", 6154.0, 6154.1, False),
        ("/optima/0/stiffness_percent", 0.0, 9e-6, True),
        ("/optima/0/stiffness_percent", 0.0, 1e-4, False),
        ("/trend/0/slope", 0.0, 1e-13, True),
        ("/trend/0/slope", 0.0, 1e-11, False),
        ("/damping/value", 0.0, 1e-13, False),
        ("/trials", 100000, 100001, False),
        ("/stable", True, 1.0, False),
        ("/stable", True, True, True),
        ("/value", None, 1.0, False),
        ("/reason", "6.2 %", "6.3 %", True),
    ],
)
def test_values_may_differ_by_what_flat_optima_leave_open(place, a, b, same):
    assert same_value(place, a, b) is same_value(place, b, a) is same


def verified(report: Path, processed: Path, kernel: str) -> None:
    """Verify a report as on another processor."""
    run = subprocess.run(
        [sys.executable, "-m", "pipeline", "verify", str(report), "--processed", str(processed)],
        env=environment(kernel),
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stdout + run.stderr
    assert "all equal" in run.stdout


@pytest.mark.slow
def test_a_small_report_holds_on_a_processor_of_2008(tmp_path, one_process):
    write_course(run_course(load_device("lwr"), "delay-8", seed=5, coarsen=8), tmp_path / "raw")
    processed, report = tmp_path / "processed", tmp_path / "lwr.html"
    ingest([tmp_path / "raw"], processed)
    compare("lwr", processed, criteria=("settle_2pct", "energy_step_w0"), report=report)
    verified(report, processed, "Nehalem")


@pytest.mark.slow
@pytest.mark.parametrize("kernel", WITHOUT)
def test_the_reports_of_the_demo_hold_with_each_kernel(demonstrated, kernel):
    folder, reports = demonstrated
    assert len(reports) == 3
    for report in reports:
        verified(report, folder / "processed" / "demo", kernel)


@pytest.fixture(scope="module")
def demonstrated(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    return folder, run_demo(folder).reports
