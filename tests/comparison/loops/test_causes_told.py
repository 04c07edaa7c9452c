"""Causes that a course shows in a way of its own, and numbers that stand although no linear loop does."""

from __future__ import annotations

import pytest
from kinds import kinds, record
from labs import compare

import pipeline
from pipeline.comparison.loops.loop_basis import filter_quantities
from pipeline.device.parts import Butterworth, Difference
from pipeline.device_data.devices import load_device
from pipeline.intake.ingest import ingest
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
