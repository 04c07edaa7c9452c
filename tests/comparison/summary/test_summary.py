from __future__ import annotations

import re

import numpy as np
import pytest

from pipeline.comparison.summary.summary import summarise
from pipeline.comparison.summary.summary_warnings import warnings_of
from pipeline.records.findings import Estimate, Optimum, Trend
from pipeline.rendering.labels import UNITS, share_text

FALCON = UNITS["translation"]


def test_summary_answers_in_order(result):
    starts = (
        "Theory predicts well",
        "Set K = ",
        "The measured region",
        "Costs of the trials",
        "Experiment 1: the measured",
        "A wall that is",
    )
    assert [text.startswith(s) for text, s in zip(result.summary, starts, strict=False)] == [True] * len(starts)
    assert result.summary[-1].startswith("Experiment 1 (180 trials): delay d 4 samples, mass 0.580 kg")
    assert 5 <= len(result.summary) <= 8


def test_summary_tells_the_numbers_of_the_result(result):
    experiment = result.experiments[0]
    region, distance = experiment.scores[0].region, experiment.scores[0].distance
    assert f"is {region.area_ratio:.2f} times as large (overlap {share_text(region.overlap, 0)} %)" in result.summary[2]
    assert f"in the median of {distance.dampings} dampings" in result.summary[4]
    stable = max(p.stable for p in experiment.boundary if p.stable is not None)
    measured, at, predicted, where, percent = re.search(
        r"stiffness measured is (\d+) N/m \(at B = (\d+) Ns/m\), theory says (\d+) N/m at (\d+) Ns/m "
        r"\(([+−][\d.]+) %\)",
        result.summary[4],
    ).groups()
    assert float(measured) == stable
    assert any(p.stable == stable and p.damping == float(at) for p in experiment.boundary)
    # Table B.1: alpha_max of d = 4 with delta = 4e-3/0.58 lies a little above the undamped .0229
    assert 0.0229 < float(predicted) * 1e-6 / 0.58 < 0.0240
    # theory is printed in whole N/m of more than 10,000, the percentage with one decimal
    assert float(percent.replace("−", "-")) == pytest.approx(100 * (stable / float(predicted) - 1), abs=0.06)
    assert any(p.damping == float(where) for p in experiment.boundary)


def test_deviations_of_the_summary_are_those_of_the_tables(result):
    text = result.summary[3]
    parts = sorted((r.deviation for r in result.tables if r.deviation), key=lambda part: abs(part.model))
    assert f"in the median of {len(parts)} comparisons" in text
    told, ends = re.search(r"most by (\S+) % \(95 %: ([^)]*)\)", text).groups()
    found = [float(x.replace("−", "-")) for x in (told, *ends.split(" to "))]
    last = parts[-1]
    assert [found[0], found[1], found[-1]] == pytest.approx([last.model, last.model_low, last.model_high], abs=0.06)


@pytest.mark.parametrize(("sizes", "middle"), [((1.0, 2.0, 10.0), "2"), ((1.0, 2.0, 10.0, 40.0), "6")])
def test_median_of_an_even_number_lies_between_both_middle_ones(result, sizes, middle):
    row = next(r for r in result.tables if r.deviation)
    parts = [row.deviation.model_copy(update={"model": -size}) for size in sizes]
    rows = [row.model_copy(update={"deviation": part}) for part in parts]
    costs = next(s.text for s in summarise(None, result.experiments, rows, FALCON) if s.source == "sec-costs")
    assert f"by {middle} % in the median of {len(sizes)} comparisons" in costs


def test_a_region_that_is_almost_all_is_not_called_all(result):
    scores = result.experiments[0].scores[0]
    changes = {"overlap": 0.9997, "covered": 0.996, "censored": 2, "dampings": 5}
    region = scores.region.model_copy(update=changes)
    changed = result.experiments[0].model_copy(update={"scores": (scores.model_copy(update={"region": region}),)})
    text = summarise(None, [changed], result.tables, FALCON)[0].text
    assert "covers 99.6 %" in text
    assert "(overlap 99.9 %)" in text
    assert "at 2 of 5 dampings no trial was unstable" in text


def test_without_an_unstable_trial_no_overlap_is_told(result):
    scores = result.experiments[0].scores[0]
    region = scores.region.model_copy(update={"overlap": 1.0, "censored": 4, "dampings": 4})
    bound = {"lower_bound": True, "measured": 300.0, "deviation_percent": -98.2}
    changes = {"region": region, "stiffness": scores.stiffness.model_copy(update=bound)}
    open_end = result.experiments[0].model_copy(update={"scores": (scores.model_copy(update=changes),)})
    sentences = [s.text for s in summarise(None, [open_end], result.tables, FALCON)]
    assert not any("overlap" in s for s in sentences)
    assert any("at least 300 N/m" in s for s in sentences)
    assert not any("98.2" in s for s in sentences)
    # an experiment with a limit speaks for the device
    other = result.experiments[0].model_copy(update={"experiment": "2"})
    first = summarise(None, [open_end, other], result.tables, FALCON)[0].text
    assert first.startswith("The measured region of experiment 2")


def test_what_does_not_differ_is_not_given_a_place(result):
    scores = result.experiments[0].scores[0]
    distance = scores.distance.model_copy(update={"median": 2e-4, "largest": -4e-4})
    same = result.experiments[0].model_copy(update={"scores": (scores.model_copy(update={"distance": distance}),)})
    text = " ".join(s.text for s in summarise(None, [same], result.tables, FALCON))
    assert f"differs from theory by less than 0.1 % in stiffness in the median of {distance.dampings} dampings;" in text


def test_each_sentence_names_what_it_rests_on(falcon_outcome):
    result = falcon_outcome.result
    assert len(result.summary_sources) == len(result.summary)
    page = falcon_outcome.report.read_text(encoding="utf-8")
    for source in result.summary_sources:
        assert source
        assert f'id="{source}"' in page
        assert f'href="#{source}"' in page


def test_an_ideal_course_inside_its_range_gives_no_warning(result):
    assert result.warnings == ()


def test_summary_leaves_out_what_is_not_known(result):
    nothing = Estimate(value=None, unit="kg", method="none", reason="no trial moved")
    bare = result.experiments[0].model_copy(
        update={
            "estimates": dict.fromkeys(("delay_samples", "mass", "damping"), nothing),
            "boundary": (),
            "scores": (),
            "optimum": {},
            "loop": None,
            "passive": None,
            "saving": None,
        }
    )
    (sentence,) = summarise(None, [bare], (), FALCON)
    assert sentence.source == ""
    assert sentence.text.startswith("180 trials are stored, from which neither parameters nor costs follow")


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
    assert text == "Experiment 1: no mass estimate (no trial moved)."
    left_out = missing.model_copy(update={"reason": "left out: neither a criterion"})
    assert warned(data, result, estimates=experiment.estimates | {"mass": left_out}) == ""
    recorded = experiment.model_copy(update={"experiment": "2", "simulated": False})
    (text,) = warnings_of(data, [experiment, recorded])
    assert text == "Simulated logs stand beside recorded ones: those of experiment 1 are simulated."


def drifting(estimate, change, span):
    """An estimate with a drift as `combine` would have found it."""
    trend = Trend(over="stiffness", slope=change / span, low=0.0, high=0.0, unit="", significant=True, span=span)
    words = f"drifts by {change:g} over the tested stiffness 0 to {span:g} N/m"
    return estimate.model_copy(update={"trend": (trend,), "warning": f"3 of 9 trials are outliers; {words}"})


def test_drifts_of_all_experiments_are_one_short_warning(data, result):
    experiment = result.experiments[0]
    damping = experiment.estimates["damping"].model_copy(update={"value": 4.0, "low": 3.9, "high": 4.1})
    several = []
    for name, change in (("1", -0.2), ("2", -1.0), ("3", 0.4)):
        estimates = experiment.estimates | {"damping": drifting(damping, change, 2000.0)}
        several.append(experiment.model_copy(update={"experiment": name, "estimates": estimates}))
    calm = experiment.model_copy(update={"experiment": "4"})
    drift, others = warnings_of(data, [*several, calm])
    assert "viscous damping over stiffness in experiments 1, 2 and 3 (most in 2: −25.0 %)" in drift
    assert "outliers" not in drift
    assert others.startswith("Viscous damping of experiments 1, 2 and 3: 3 of 9 trials are outliers.")
    assert "drifts" not in others
    drift, _ = warnings_of(data, several)
    assert "in all 3 experiments (most in 2: −25.0 %)" in drift
    # beside a value that may be zero, percent say nothing
    open_end = damping.model_copy(update={"low": -0.1})
    estimates = experiment.estimates | {"damping": drifting(open_end, -0.2, 2000.0)}
    assert "(−0.2 Ns/m)" in warned(data, result, estimates=estimates)


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
    assert text.startswith("Optimal energy costs that are partly extrapolated beyond the logs: experiment 1, w = 2 (")


def test_unknown_device_is_named_in_a_warning(unknown_outcome):
    assert any("'mydevice' has no device file" in text for text in unknown_outcome.result.warnings)


def test_logs_that_contradict_the_device_file_are_named(tmp_path):
    from native_logs import ROWS, log_text

    from pipeline.comparison.compare import compare
    from pipeline.intake.ingest import ingest

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
