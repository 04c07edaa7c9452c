from __future__ import annotations

import numpy as np
import pytest
from labs import compare
from native_logs import ROWS, log_text

from pipeline.comparison.summary.summary_warnings import warnings_of
from pipeline.intake.ingest import ingest
from pipeline.records.findings import Estimate, Optimum


def test_an_ideal_course_inside_its_range_gives_no_warning(result):
    assert result.warnings == ()


def warned(data, result, **changes):
    return " ".join(warnings_of(data, [result.experiments[0].model_copy(update=changes)]))


def test_warnings(data, result):
    experiment = result.experiments[0]
    assert "Fewer than 30 trials in experiment 1" in warned(data, result, trials=29)
    edge = Optimum(stiffness=1.0, damping=184.0, cost=1.0, censored=True)
    assert "edge of the tested range in experiment 1" in warned(data, result, optimum={"overshoot": edge})
    open_end = experiment.boundary[0].model_copy(update={"censored": True})
    assert "lower bound" in warned(data, result, boundary=(open_end,))
    missing = Estimate(value=None, unit="kg", method="none", reason="no trial moved")
    text = warned(data, result, estimates=experiment.estimates | {"mass": missing})
    assert text == "Experiment 1: no estimate of mass m (no trial moved)."
    left_out = missing.model_copy(update={"reason": "left out: neither a requested criterion"})
    assert warned(data, result, estimates=experiment.estimates | {"mass": left_out}) == ""
    recorded = experiment.model_copy(update={"experiment": "2", "simulated": False})
    (text,) = warnings_of(data, [experiment, recorded])
    assert text == "Simulated and recorded logs are mixed: those of experiment 1 are simulated."


def test_drifts_of_all_experiments_are_one_short_warning(data, result):
    experiment = result.experiments[0]
    words = "3 of 9 trials are outliers; drifts by -1 over the tested stiffness 0 to 2000 N/m"
    doubted = experiment.estimates["damping"].model_copy(update={"warning": words})
    estimates = experiment.estimates | {"damping": doubted}
    several = [experiment.model_copy(update={"experiment": name, "estimates": estimates}) for name in "123"]
    drift, others = warnings_of(data, [*several, experiment.model_copy(update={"experiment": "4"})])
    assert drift.endswith("does not explain all trials: damping b in experiments 1, 2 and 3.")
    assert others == "Damping b of experiments 1, 2 and 3: 3 of 9 trials are outliers."
    assert "damping b in all 3 experiments" in warnings_of(data, several)[0]


def test_bad_fits_and_extrapolated_costs_are_named(data, result):
    experiment = result.experiments[0]
    check = experiment.model_check.model_copy(update={"trials": 100, "explained": 60})
    assert "do not explain 40 of 100 logs" in warned(data, result, model_check=check)
    check = check.model_copy(update={"explained": 90})
    assert warned(data, result, model_check=check) == ""
    stages = data.experiments[0]
    share = abs(stages.column("energy", "energy_w2_tail")) / stages.column("energy", "energy_w2")
    worst = int(np.nanargmax(share))
    trial, cost = (stages.table("energy").column(name)[worst].as_py() for name in ("trial_id", "energy_w2"))
    assert share[worst] > 0.05
    long = Optimum(stiffness=1.0, damping=1.0, cost=cost, trial_id=trial)
    text = warned(data, result, optimum={"energy_step_w2": long})
    assert text.startswith("Optimal energy costs are partly extrapolated beyond the logs: experiment 1, w = 2 (")


@pytest.mark.slow
def test_unknown_device_is_named_in_a_warning(unknown_outcome):
    assert any("'mydevice' has no device file" in text for text in unknown_outcome.result.warnings)


def test_logs_that_contradict_the_device_file_are_named(tmp_path):
    logs = tmp_path / "logs"
    logs.mkdir()
    slow = log_text(device="falcon", experiment="1").replace("sampling_period_s: 0.001", "sampling_period_s: 0.002")
    for k in range(1, ROWS):
        slow = slow.replace(f"\n{k * 0.001:.17g},", f"\n{k * 0.002:.17g}!,")
    (logs / "slow.csv").write_text(slow.replace("!", ""))
    (logs / "own.csv").write_text(log_text(device="falcon", experiment="my own", seed=2))
    report = ingest([logs], tmp_path / "processed")
    assert report.ingested == 2, report.quarantined
    outcome = compare("falcon", tmp_path / "processed", criteria=["energy_step_w0"])
    text = " ".join(outcome.result.warnings)
    assert "has no experiment my own, so no theoretical prediction is based on it" in text
    assert "Experiment 1 was sampled every 0.002 s, but theory takes 0.001 s" in text
    assert "my own was sampled" not in text
