"""The apparent mass of the logs, next to masses that a device file and the thesis state."""

from __future__ import annotations

import pytest

from pipeline.comparison.stated_masses import mass_deviations
from pipeline.device.parts import Operator
from pipeline.device_data.devices import load_device
from pipeline.device_data.published import published_mass
from pipeline.records.findings import Estimate
from pipeline.records.results import MeasuredExperiment


def mass(value, low, high, momentum=None):
    by_method = {"thesis_momentum_balance": momentum} if momentum else {}
    reason = "no trial" if value is None else None
    return Estimate(value=value, low=low, high=high, unit="kg", method="test", by_method=by_method, reason=reason)


def experiment(estimate, grip="none"):
    return MeasuredExperiment.model_construct(estimates={"mass": estimate}, grip=grip)


def deviations(estimate, name="falcon", grip="none"):
    device = load_device(name)
    return mass_deviations(experiment(estimate, grip), device, device.loop_for(device.experiments[0]))


def test_masses_of_the_thesis_are_those_of_its_text():
    """Parts of 0.41 kg and three motors of 0.18 kg; 3 % of 0.19 kg m^2."""
    motor = 1e-5 / 0.0074**2
    assert motor == pytest.approx(0.18, abs=0.005)
    assert published_mass("falcon").mass == pytest.approx(0.41 + 3 * 0.18, abs=0.005)
    assert published_mass("lwr").mass == pytest.approx(0.03 * 0.19)
    assert published_mass("another") is None


def test_the_momentum_mass_of_the_thesis_deviates_by_what_the_thesis_prints():
    file, weighed = deviations(mass(0.58, 0.57, 0.60, mass(0.66, 0.6, 0.7)))
    assert (file.source, weighed.source, weighed.section) == ("device file", "weighed", "6.1.2")
    assert (file.stated, weighed.stated) == (0.58, 0.95)
    assert weighed.percent == pytest.approx(-38.9, abs=0.05)
    assert (weighed.low, weighed.high) == (pytest.approx(-40.0), pytest.approx(-36.842, abs=1e-3))
    assert weighed.momentum_percent == pytest.approx(100 * (0.66 / 0.95 - 1))
    assert (file.differs, weighed.differs) == (False, True)


def test_a_weighed_mass_is_that_of_the_device_without_a_hand():
    assert [each.source for each in deviations(mass(1.0, 0.9, 1.1), grip="firm")] == ["device file"]


def test_a_device_that_is_published_as_another_has_its_weighed_mass():
    assert [each.stated for each in deviations(mass(0.5, 0.4, 0.6), "falcon-real")] == [0.456, 0.95]


def test_the_stated_mass_is_that_at_the_wall():
    device = load_device("falcon")
    loop = device.loop_for(device.experiments[0])
    held = loop.replace({"force_gain": 2.0, "operator.mass": 0.4})
    assert held.operator == Operator(mass=0.4)
    (first, *_) = mass_deviations(experiment(mass(0.49, 0.48, 0.50)), device, held)
    assert first.stated == pytest.approx(0.49)


@pytest.mark.parametrize("value", [None, 0.5])
def test_without_a_stated_mass_there_is_no_deviation(value):
    assert mass_deviations(experiment(mass(value, None, None)), None, None) == ()
    device = load_device("falcon")
    unknown = mass_deviations(experiment(mass(None, None, None)), device, device.loop_for(device.experiments[0]))
    assert [(each.percent, each.differs) for each in unknown] == [(None, False)] * 2
