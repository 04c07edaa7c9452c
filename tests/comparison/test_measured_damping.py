"""Theory with the damping of the logs in place of the stated one."""

from __future__ import annotations

import pytest

from pipeline.comparison.measured_damping import with_measured_damping
from pipeline.device.loop import Loop
from pipeline.device.parts import Mode, Operator
from pipeline.records.findings import Estimate
from pipeline.records.results import SourcedLoop
from pipeline.theory.predictions import Theory

HAND = Operator(mass=0.4, damping=20.0, stiffness=0.0)


def theory(**parts):
    loop = Loop(mass=0.58, damping=4.0, sampling_period_s=0.001, delay_samples=4, **parts)
    return Theory(SourcedLoop(loop=loop, source="test"))


def measured(value, half=0.5):
    return Estimate(value=value, low=value - half, high=value + half, unit="Ns/m", method="test")


@pytest.mark.parametrize(
    ("parts", "damping"),
    [({}, 9.0), ({"operator": HAND}, 30.0), ({"force_gain": 2.0}, 9.0), ({"operator": HAND, "force_gain": 0.5}, 60.0)],
    ids=["alone", "hand", "gain", "hand and gain"],
)
def test_the_wall_feels_the_measured_damping(parts, damping):
    stated = theory(**parts)
    damped = with_measured_damping(stated, measured(damping))
    assert damped.loop.apparent().damping == pytest.approx(damping, rel=1e-12)
    assert damped.loop.apparent().mass == stated.loop.apparent().mass
    assert damped.normalised.delay == stated.normalised.delay


def test_the_load_of_a_mode_keeps_its_share():
    mode = Mode(frequency_hz=60.0, damping_ratio=0.05, mass=0.1, load_damping=1.0)
    damped = with_measured_damping(theory(mode=mode), measured(8.0))
    assert (damped.loop.damping, damped.loop.mode.load_damping) == (8.0, 2.0)


@pytest.mark.parametrize(
    "damping",
    [
        measured(4.3),
        Estimate(value=9.0, unit="Ns/m", method="test"),
        Estimate(value=None, unit="Ns/m", method="none", reason="no trial"),
    ],
    ids=["agrees", "no interval", "unknown"],
)
def test_a_damping_that_agrees_or_is_unknown_gives_no_other_theory(damping):
    assert with_measured_damping(theory(), damping) is None


def test_a_measured_damping_below_zero_counts_as_zero():
    assert with_measured_damping(theory(), measured(-3.0)).loop.damping == 0.0
