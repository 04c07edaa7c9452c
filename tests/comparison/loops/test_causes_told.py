"""Causes that a course shows in a way of its own, and numbers that stand although no linear loop does."""

from __future__ import annotations

import numpy as np
import pytest
from kinds import kinds, record
from labs import compare

import pipeline
from pipeline.comparison.loops.causes import jitter_cause
from pipeline.comparison.loops.loop_basis import filter_quantities
from pipeline.device.parts import Butterworth, Difference
from pipeline.device_data.devices import load_device
from pipeline.intake.ingest import ingest
from pipeline.records.findings import Estimate
from pipeline.records.models import Device
from pipeline.simulation.sweep import write_sweep
from pipeline.surface.stored import costs

SMALL = {"coarsen": 8, "duration_s": 0.4}


def compared(folder, base: Device, kind: str, seed: int):
    course = record(kinds(base)[kind](seed), **SMALL)
    write_sweep(course, folder / "raw")
    ingest([folder / "raw"], folder / "processed", jobs=1)
    result = compare(course.device.name, folder / "processed", criteria=("settle_2pct", "energy_step_w1")).result
    (found,) = result.experiments
    return course, found


@pytest.mark.slow
def test_two_delays_that_are_as_likely_jitter(tmp_path):
    """In more than half of the trials the motion begins after the same delay: a median calls that no scatter."""
    course, found = compared(tmp_path, load_device("falcon"), "jitter", 9100)
    assert len(course.setup.loop.jitter_samples) == 2
    (cause,) = found.causes
    assert cause.code == "delay_jitter"
    assert cause.evidence.startswith("95 %: ")
    assert found.passive is None


@pytest.mark.slow
def test_friction_with_stiction_is_named_without_a_log_at_rest(tmp_path):
    course, found = compared(tmp_path, load_device("lwr"), "friction with stiction", 9000)
    assert [cause.code for cause in found.causes] == ["coulomb_friction"]
    friction, truth = found.estimates["friction"], course.device.loop_for(course.experiment).friction.coulomb
    assert friction.low <= truth <= friction.high


@pytest.mark.slow
def test_settling_and_energy_of_a_held_device_are_about_its_own_rest(tmp_path):
    """The spring moves soft walls alone, too few of them to tell it by where they rest."""
    course, found = compared(tmp_path, load_device("lwr"), "operator", 9100)
    assert found.loop.adequate, found.loop.reason
    assert "operator" in {cause.code for cause in found.causes}
    true = found.truth.values
    loop = pipeline.Loop(
        true["mass"],
        true["damping"],
        found.sampling_period_s,
        true["delay_samples"],
        stiffness=true["device_stiffness"],
    )
    table = costs(tmp_path / "processed", course.device.name)
    table = table[(table["criterion"] == "energy_step_w1") & table["cost"].notna()]
    assert len(table) >= 15
    walls = loop.points(table["stiffness"].to_numpy(), table["damping"].to_numpy())
    truth = walls["energy_step_w1_discrete"].to_numpy(float)
    inside = (table["low"] <= truth) & (truth <= table["high"])
    assert inside.mean() >= 0.9


def test_a_filter_is_known_as_well_as_single_logs_agree():
    logs = [Butterworth(kind="butterworth", order=2, cutoff_hz=hz) for hz in (49.98, 50.0, 50.0, 50.03)]
    other = [Difference(kind="difference", samples=4), Butterworth(kind="butterworth", order=3, cutoff_hz=90.0)]
    cutoff = filter_quantities(logs[1], [*logs, *other])["cutoff_hz"]
    assert cutoff.value == 50.0
    assert 49.96 < cutoff.low < 49.98 < 50.03 < cutoff.high < 50.05
    # four digits of one number: the filter lies within half of the last one
    cutoff = filter_quantities(logs[1], logs[1:3])["cutoff_hz"]
    assert (cutoff.low, cutoff.high) == pytest.approx((49.995, 50.005))
    # a device file states what it states
    assert filter_quantities(logs[1])["cutoff_hz"].low == 50.0


def test_a_constant_delay_of_theory_outside_that_of_the_logs_is_said_with_the_jitter():
    device = load_device("falcon")
    stated, dampings = device.loop_for(device.experiments[0]), np.arange(0.0, 150.0, 16.0)
    jitter = Estimate(value=0.75, low=0.7, high=0.8, unit="samples", method="test")
    delay = Estimate(value=3.88, low=3.62, high=3.95, unit="samples", method="test")
    found = jitter_cause(jitter, delay, stated, dampings)
    assert found.sentence.startswith(
        "The delay jitters and acts like 3.88 samples, theory uses 4: this changes limits by +"
    )
    plain = jitter_cause(jitter, delay, None, dampings)
    assert found.evidence.endswith(plain.evidence)
    assert plain.evidence == "95 %: 0.70 to 0.80 samples"
    # near the origin, K = B/((d + 1/2) T): a delay of 3.88 instead of 4 raises limits by at least 2.7 %
    change = float(found.sentence.split("by +")[1].split(" %")[0])
    assert 100 * (4.5 / 4.38 - 1) < change < 100 * ((5 / 4.88) ** 2 - 1) + 1
    same = delay.model_copy(update={"low": 3.9, "high": 4.1})
    assert jitter_cause(jitter, same, stated, dampings) == plain, "the delays agree"
    assert plain.sentence == "The delay jitters within a trial: standard deviation 0.75 samples."
