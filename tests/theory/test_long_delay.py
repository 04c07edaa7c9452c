"""A delay that is longer than theory is computed for: the measured part of a report stands, without theory."""

import pytest
from labs import compare
from report_data import experiment

from pipeline.base.provenance import USER_FOLDER_VARIABLE, schema_folder
from pipeline.comparison.summary.summary_warnings import too_late
from pipeline.device_data.devices import read_device
from pipeline.intake.ingest import ingest
from pipeline.records.findings import Estimate
from pipeline.simulation.sweep import run_sweep, write_sweep

DELAY = 280


@pytest.mark.parametrize(
    ("value", "high", "late"),
    [(256.0, 256.0, False), (257.0, None, True), (255.0, 257.0, True), (None, None, False), (256.0, None, False)],
)
def test_what_the_interval_leaves_open_counts(value, high, late):
    reason = "not seen" if value is None else None
    delay = Estimate(value=value, low=value, high=high, unit="samples", method="first", reason=reason)
    assert too_late(experiment("1").model_copy(update={"estimates": {"delay_samples": delay}})) is late


@pytest.mark.slow
@pytest.mark.parametrize("known", [True, False])
def test_a_report_without_theory_says_why(known, tmp_path, monkeypatch):
    text = (schema_folder() / "devices" / "lwr.toml").read_text(encoding="utf-8")
    first = text.index("[[experiment]]")
    second = text.index("[[experiment]]", first + 1)
    far = (
        text[:second]
        .replace('name = "lwr"', 'name = "far"', 1)
        .replace("delay_samples = 2\n", f"delay_samples = {DELAY}\n")
    )
    folder = tmp_path / "devices"
    folder.mkdir()
    (folder / "far.toml").write_text(far, encoding="utf-8")
    course = run_sweep(read_device(folder / "far.toml"), "delay-2", coarsen=40, duration_s=0.7)
    write_sweep(course, tmp_path / "logs")
    ingest([tmp_path / "logs"], tmp_path / "processed")
    if known:
        monkeypatch.setenv(USER_FOLDER_VARIABLE, str(folder))
    result = compare("far", tmp_path / "processed", report=tmp_path / "far.html").result
    assert result.known_device is known
    (found,) = result.experiments
    assert found.estimates["delay_samples"].value == DELAY
    assert found.theory is None
    assert any("above the 256 samples that theory covers" in text for text in result.warnings)
    assert any("device file of 'far' has a delay" in text for text in result.warnings) is known
    assert (tmp_path / "far.html").exists()
