"""Where the planner starts: the device file with all that it declares, or a clear word of what is missing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.base.errors import DeviceError, UsageError
from pipeline.device.parts import LoopTable
from pipeline.device_data.devices import load_device
from pipeline.loop.normalised_loop import LoopUnits, NormalisedLoop
from pipeline.planning.campaign import PlanOptions, forecast_of, open_campaign, wanted_dampings
from pipeline.planning.planner import plan, plan_of
from pipeline.theory.boundary import limits
from pipeline.theory.optimum import optimal_point


@pytest.fixture
def begun(tmp_path):
    """A campaign without a log, of a Falcon whose file declares some parts."""

    def campaign(**parts):
        found = open_campaign("falcon", tmp_path / "none", "1", PlanOptions())
        if not parts:
            return found
        return replace(found, device=found.device.model_copy(update={"loop": LoopTable(**parts)}))

    return campaign


@pytest.mark.parametrize("parts", [{}, {"actuator_lag_s": 0.003}, {"velocity": {"kind": "difference", "samples": 8}}])
def test_the_start_is_the_limit_of_the_declared_loop(begun, parts):
    campaign = begun(**parts)
    dampings = wanted_dampings(campaign, PlanOptions())
    start = forecast_of(campaign, dampings)
    loop = campaign.device.loop_for(campaign.of_file)
    units = LoopUnits.of(loop)
    found = limits(NormalisedLoop.of(loop), np.array(dampings) / units.damping)
    expected = np.nan_to_num(found.alpha) * units.stiffness
    assert start.limit == pytest.approx(expected, rel=1e-9)
    assert start.error.max() == pytest.approx(0.1 * expected.max(), rel=1e-6)


def test_a_declared_lag_lowers_the_first_wall(begun):
    options = PlanOptions(dampings=(80.0,))
    ideal, lagging = (plan_of(begun(**parts), options).next[0].stiffness for parts in ({}, {"actuator_lag_s": 0.004}))
    assert lagging < 0.9 * ideal


@pytest.mark.parametrize(
    ("name", "parts"), [("falcon-real", ("friction", "jitter")), ("falcon", ("jitter",)), ("lwr", ())]
)
def test_parts_that_limits_of_a_file_leave_out_are_named_in_words_as_in_json(tmp_path, name, parts):
    answer = plan(name, tmp_path)
    assert answer.left_out == parts
    lines = [line for line in str(answer).splitlines() if line.startswith("not included in linear theory")]
    assert lines == ([f"not included in linear theory: {', '.join(parts)}"] if parts else [])


def test_no_device_and_no_log_says_what_is_needed_by_example(tmp_path):
    with pytest.raises(DeviceError, match=r"mass, delay_samples.*for instance K = 500"):
        plan("nobody", tmp_path)


def test_a_travel_that_no_allowed_wall_keeps_is_refused(begun):
    with pytest.raises(UsageError, match="Allow more travel or stiffness"):
        plan_of(begun(), PlanOptions(travel=1e-4, largest_stiffness=1000.0))


def test_the_first_wall_of_an_optimum_is_the_best_by_the_file(begun):
    answer = plan_of(begun(), PlanOptions(goal="optimum"))
    assert not answer.done
    assert answer.optimum is None
    falcon = load_device("falcon")
    loop = falcon.loop_for(falcon.experiments[0])
    units, best = LoopUnits.of(loop), optimal_point(NormalisedLoop.of(loop), "settle_2pct")
    assert answer.next[0].stiffness == pytest.approx(best.alpha * units.stiffness, rel=0.05)
    assert answer.next[0].damping == pytest.approx(best.beta * units.damping, rel=0.05)
