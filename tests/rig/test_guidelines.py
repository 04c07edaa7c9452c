"""Guidelines for a rig: every number against loops that are made by hand."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

import pipeline
from pipeline.rig.guidelines import RANGES, guidelines
from pipeline.shell.cli import application
from pipeline.surface.physical_loop import Loop

RIG = Loop(0.58, 4.0, 0.001, 4)


def change(**numbers):
    """Change of the largest stable stiffness of a loop with other numbers, in percent."""
    most = [Loop(**{"mass": 0.58, "damping": 4.0, "sampling_period_s": 0.001, "delay_samples": 4} | each)
            for each in (numbers, {})]  # fmt: skip
    first, second = (loop.boundary(100).attrs["stiffness_max"] for loop in most)
    return 100 * (first / second - 1)


def test_each_number_is_that_of_the_changed_rig():
    found = guidelines(RIG)
    assert found.delay_percent == pytest.approx(change(delay_samples=3), rel=1e-9)
    # the same 4 ms are eight samples of half the period
    assert found.sampling_percent == pytest.approx(change(sampling_period_s=0.0005, delay_samples=8), rel=1e-9)
    assert found.damping_percent == pytest.approx(change(damping=0.0), rel=1e-9)
    mass, damping, stiffness = found.hand
    # a hand moves with the motor: its mass and damping are the device's (Table 3.2, 3.13)
    assert mass.percent == pytest.approx(change(mass=0.58 + 1.8), rel=1e-6)
    assert damping.percent == pytest.approx(change(damping=4.0 + 26.2), rel=1e-6)
    assert stiffness.percent == pytest.approx(change(stiffness=199.1), rel=1e-6)
    assert found.gamma == pytest.approx(1e-6 * 199.1 / 2.38, rel=1e-9)
    assert found.delta == pytest.approx(1e-3 * 30.2 / 2.38, rel=1e-9)


def test_the_sentences_are_those_of_the_thesis():
    # 3.6: damping contributes marginally, the arm mainly by its mass, its stiffness costs a little
    found = guidelines(RIG)
    assert abs(found.damping_percent) < 10
    mass, damping, stiffness = (each.percent for each in found.hand)
    assert mass > damping > 0 > stiffness > -2
    assert any("contributes little to stability" in sentence for sentence in found.sentences())


def test_a_rig_outside_of_the_ranges_is_told_so():
    slow = guidelines(Loop(0.5, 20.0, 0.005, 1, operator={"mass": 0.15, "damping": 5.0, "stiffness": 300.0}))
    assert slow.gamma > RANGES["gamma"]
    assert slow.delta > RANGES["delta"]
    assert "outside the ranges of (3.17)" in slow.sentences()[-1]
    assert slow.arm == "the operator of the device file"
    inside = guidelines(RIG)
    assert all(inside.within.values())


def test_a_rotation_without_an_operator_has_no_hand():
    found = guidelines(Loop(0.19, 0.1, 0.001, 2, motion="rotation"))
    assert found.hand == ()
    assert not any("hand" in sentence for sentence in found.sentences())


def test_design_prints_them_and_what_the_delay_allows():
    words = ["design", "--device", "falcon", "--stiffness", "5000"]
    document = json.loads(CliRunner().invoke(application("design"), [*words, "--json"]).output)
    assert document["guidelines"]["delay_percent"] == pytest.approx(change(delay_samples=3), rel=1e-6)
    assert document["reachable"]["cost"] == pytest.approx(
        pipeline.Loop(0.58, 4.0, 0.001, 4).reachable("settle_2pct").cost
    )
    text = CliRunner().invoke(application("design"), words).output
    assert "One sample less delay" in text
    assert "must stay below 20 %" in text
