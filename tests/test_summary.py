from __future__ import annotations

import re

import pytest

from pipeline.models import Estimate, Optimum
from pipeline.scene import open_scene
from pipeline.summary import summarise, warnings_of


@pytest.fixture(scope="module")
def data(falcon):
    return open_scene("falcon", falcon.processed, None, None)


@pytest.fixture(scope="module")
def result(falcon_outcome):
    return falcon_outcome.result


def test_summary_tells_the_numbers_of_the_result(result):
    text = " ".join(result.summary)
    experiment = result.experiments[0]
    assert "delay d 4 samples (95 %: 4 to 5), mass 0.580 kg" in text
    stable = max(p.stable for p in experiment.boundary if p.stable is not None)
    measured, at, predicted, where, percent = re.search(
        r"stiffness measured is (\d+) N/m \(at B = (\d+) Ns/m\), theory says (\d+) N/m at (\d+) Ns/m \(([+-]\d+) %\)",
        text,
    ).groups()
    assert float(measured) == stable
    assert any(p.stable == stable and p.damping == float(at) for p in experiment.boundary)
    # Table B.1: alpha_max of d = 4 with delta = 4e-3/0.58 lies a little above the undamped .0229
    assert 0.0229 < float(predicted) * 1e-6 / 0.58 < 0.0240
    assert float(percent) == round(100 * (stable / float(predicted) - 1))
    assert float(where) > 0


def test_deviations_of_the_summary_are_those_of_the_tables(result):
    text = result.summary[-1]
    sizes = sorted(abs(r.deviation_percent) for r in result.tables if r.deviation_percent is not None)
    assert f"in the median of {len(sizes)} comparisons" in text
    found = [float(x) for x in re.findall(r"\(([+-][\d.]+) %\)", text)]
    assert [round(abs(x), 1) for x in found] == [round(sizes[0], 1), round(sizes[-1], 1)]


def test_an_ideal_course_inside_its_range_gives_no_warning(result):
    assert result.warnings == ()


def test_summary_leaves_out_what_is_not_known(data, result):
    nothing = Estimate(value=None, unit="kg", method="none", reason="no trial moved")
    bare = result.experiments[0].model_copy(
        update={"estimates": dict.fromkeys(("delay_samples", "mass", "damping"), nothing), "boundary": ()}
    )
    (text,) = summarise(data, [bare], (), {})
    assert text.startswith("180 trials are stored, from which neither parameters nor costs follow")


def warned(data, result, **changes):
    return " ".join(warnings_of(data, [result.experiments[0].model_copy(update=changes)], result.tables))


def test_warnings(data, result):
    experiment = result.experiments[0]
    assert "Fewer than 30 trials in experiment 1" in warned(data, result, trials=29)
    edge = Optimum(stiffness=1.0, damping=184.0, cost=1.0, censored=True)
    assert "edge of the tested range in experiment 1" in warned(data, result, optimum={"overshoot": edge})
    open_end = experiment.boundary[0].model_copy(update={"censored": True})
    assert "lower bound" in warned(data, result, boundary=(open_end,))
    missing = Estimate(value=None, unit="kg", method="none", reason="no trial moved")
    text = warned(data, result, estimates=experiment.estimates | {"mass": missing})
    assert text == "Experiment 1: no mass estimate (no trial moved)."
    left_out = missing.model_copy(update={"reason": "left out: neither a criterion"})
    assert warned(data, result, estimates=experiment.estimates | {"mass": left_out}) == ""
    recorded = experiment.model_copy(update={"experiment": "2", "simulated": False})
    (text,) = warnings_of(data, [experiment, recorded], result.tables)
    assert text == "Simulated logs stand beside recorded ones: experiments 1 are simulated."


def test_unknown_device_is_named_in_a_warning(unknown_outcome):
    assert any("'mydevice' has no device file" in text for text in unknown_outcome.result.warnings)


def test_logs_that_contradict_the_device_file_are_named(tmp_path):
    from native_logs import ROWS, log_text

    from pipeline.compare import compare
    from pipeline.ingest import ingest

    logs = tmp_path / "logs"
    logs.mkdir()
    slow = log_text(device="falcon", experiment="1").replace("sampling_period_s: 0.001", "sampling_period_s: 0.002")
    times = {f"\n{k * 0.001:.17g},": f"\n{k * 0.002:.17g}!," for k in range(1, ROWS)}
    for old, new in times.items():
        slow = slow.replace(old, new)
    (logs / "slow.csv").write_text(slow.replace("!", ""))
    (logs / "own.csv").write_text(log_text(device="falcon", experiment="my own", seed=2))
    report = ingest([logs], tmp_path / "processed")
    assert report.ingested == 2, report.quarantined
    outcome = compare("falcon", tmp_path / "processed", criteria=["energy_step_w0"])
    text = " ".join(outcome.result.warnings)
    assert "has no experiment my own: its tables have no theory" in text
    assert "Experiment 1 was sampled every 0.002 s, but theory takes 0.001 s" in text
    assert "my own was sampled" not in text
