"""Theory of a report rests on the loop of its device file: filter, lag and mode move boundary, optima and passivity."""

import pytest

from pipeline.device.parts import LoopTable
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.records.results import SourcedLoop
from pipeline.rendering.figures.boundaries import by_theory, conditions
from pipeline.theory.optimum import optimal_point
from pipeline.theory.predictions import Theory

PARTS = LoopTable.model_validate(
    {
        "velocity": {"kind": "butterworth", "order": 1, "cutoff_hz": 40.0},
        "actuator_lag_s": 0.001,
        "mode": {"frequency_hz": 120.0, "damping_ratio": 0.1, "mass": 0.05},
        "friction": {"coulomb": 0.2},
    }
)


def theory(parts: LoopTable = LoopTable()) -> Theory:  # noqa: B008
    return Theory(
        SourcedLoop(
            mass=0.58, damping=4.0, stiffness=0.0, sampling_period_s=0.001, delay_samples=4.0, source="test", loop=parts
        )
    )


def test_boundary_and_optimum_are_those_of_the_loop_with_its_parts():
    ideal, real = theory(), theory(PARTS)
    assert (type(ideal.normalised), type(real.normalised)) == (NormalisedLoop, NormalisedLoop)
    assert by_theory(real, "").x.max() < 0.6 * by_theory(ideal, "").x.max()
    best = [one.physical(optimal_point(one.normalised, "energy_step_w0")) for one in (ideal, real)]
    assert best[1].stiffness < 0.8 * best[0].stiffness
    assert best[1].cost > best[0].cost


@pytest.mark.slow
def test_passive_region_and_linear_condition_know_the_lag():
    ideal, real = theory(), theory(PARTS)
    first, second = ({s.kind: s for s in conditions(one)} for one in (ideal, real))
    assert second["passive"].x.max() < first["passive"].x.max()
    slopes = [(s["linear"].y[1] + 4.0) / s["linear"].x[1] for s in (first, second)]
    assert slopes[1] - slopes[0] == pytest.approx(0.001)
    assert set(second) == {"linear", "passive"}, "what is robust is known of an ideal loop alone"


def test_the_passive_region_is_that_of_the_near_side_alone():
    mode = {"frequency_hz": 120.0, "damping_ratio": 0.05, "mass": 0.05}
    damped, whole = (theory(LoopTable.model_validate({"mode": mode | more})) for more in ({"load_damping": 1.0}, {}))
    assert damped.passive_outline[0].max() == pytest.approx(0.75 * whole.passive_outline[0].max())


def test_words_name_the_parts_and_what_is_left_out():
    real = theory(PARTS).loop
    assert real.parts_in_words() == (
        "velocity filter (Butterworth, order 1, 40 Hz), actuator lag 1 ms, "
        "vibration mode at 120 Hz, sensed at the motor"
    )
    assert real.left_out == ("friction",)
    assert theory().loop.parts_in_words() == ""
    far = PARTS.model_copy(update={"mode": PARTS.mode.model_copy(update={"sensor": "load"})})
    assert theory(far).passive_outline is None
