"""What is said of a loop: nothing of one that is not adequate, and what is said of an adequate one holds."""

from __future__ import annotations

from math import floor

import numpy as np
import pytest
from kinds import kinds, record
from labs import compare

from pipeline.device_data.devices import load_device
from pipeline.intake.ingest import ingest
from pipeline.simulation.radius import spectral_radius
from pipeline.simulation.sweep import SimulatedSweep, write_sweep

KINDS = kinds(load_device("falcon"))
SEED = 71
SMALL = {"coarsen": 8, "duration_s": 0.4}


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """The result of a small course of a kind of device, as of a lab that states nothing of the device."""
    known = {}

    def of(name: str, seed: int = SEED):
        if (name, seed) not in known:
            folder = tmp_path_factory.mktemp("kind")
            course = record(KINDS[name](seed), **SMALL)
            write_sweep(course, folder / "raw")
            ingest([folder / "raw"], folder / "processed", jobs=1)
            result = compare(
                course.device.name, folder / "processed", criteria=("settle_2pct", "energy_step_w0")
            ).result
            known[name, seed] = course, result
        return known[name, seed]

    return of


def radius(course: SimulatedSweep, stiffness: float, damping: float) -> float:
    """Growth of the true loop from sample to sample, at the mean of a jittering delay."""
    return float(spectral_radius(course.setup, np.array([stiffness]), np.array([damping]))[0])


@pytest.mark.sampled
@pytest.mark.parametrize(
    "name",
    [pytest.param("ideal", marks=pytest.mark.slow), "fractional delay", "coarse sensor", "few trials", "only unstable"],
)
def test_an_adequate_loop_is_the_true_one_and_its_passive_wall_is_stable(compared, name):
    course, result = compared(name)
    (found,) = result.experiments
    loop = found.loop
    assert loop.adequate, loop.reason
    assert loop.source == "estimated"
    # a log whose motion is small is left out of what is explained: its rounding is no white noise
    assert loop.explained > 0.85
    truth = course.experiment
    assert loop.mass.value == pytest.approx(truth.mass, rel=2e-3)
    assert loop.damping.value == pytest.approx(truth.damping, rel=2e-2)
    assert loop.delay_samples.value == pytest.approx(course.setup.loop.delay_samples, abs=0.01)
    # the whole factor is that of the same delay, also where a coarse sensor shows the first motion late
    factor = found.estimates["delay_samples"]
    assert (factor.value, factor.high) == (floor(course.setup.loop.delay_samples), factor.value + 1)
    # stability with every hand is promised with limits measured beside the wall, and from ten trials on
    measured = name not in ("few trials", "only unstable")
    assert (found.passive is not None) == measured, found.passive_reason
    if measured:
        assert radius(course, found.passive.stiffness, found.passive.damping) < 1
    for limit in found.loop_boundary:
        assert limit.low <= limit.stiffness <= limit.high
        if limit.stiffness > 1000:  # nearer to either end of the boundary a limit in percent says nothing
            assert (
                radius(course, 0.985 * limit.stiffness, limit.damping)
                < 1
                < radius(course, 1.015 * limit.stiffness, limit.damping)
            )


@pytest.mark.sampled
@pytest.mark.parametrize(
    ("name", "code"),
    [
        pytest.param("clipping in the log", "saturation", marks=pytest.mark.slow),
        pytest.param("one-sided wall", "unilateral_wall", marks=pytest.mark.slow),
        ("lost rows", "missing_rows"),
        pytest.param("hidden rows", "missing_rows", marks=pytest.mark.slow),
        pytest.param("repeated rows", "repeated_rows", marks=pytest.mark.slow),
        ("jitter", "delay_jitter"),
        pytest.param("friction strong", "coulomb_friction", marks=pytest.mark.slow),
        pytest.param("clipping", "saturation", marks=pytest.mark.slow),
    ],
)
def test_what_logs_show_is_named_and_statements_rest_on_the_replay_alone(compared, name, code):
    course, result = compared(name)
    (found,) = result.experiments
    assert {cause.code for cause in found.causes} - {"coarse_sensor"} == {code}
    assert all(cause.evidence for cause in found.causes)
    assert found.loop.adequate == found.replay.is_right
    assert "the identified device predicts" in found.loop.reason
    assert found.loop_boundary
    if found.loop.adequate:
        assert found.loop.mass.value == pytest.approx(course.experiment.mass, rel=0.02)
        assert found.loop.damping.value == pytest.approx(course.experiment.damping, rel=0.1)
        # passivity is known of constant delays alone
        assert found.passive is None or name != "jitter"
        if found.passive:
            assert radius(course, found.passive.stiffness, found.passive.damping) < 1
    else:
        assert (found.passive, found.theory, found.scores) == (None, None, ())
        assert found.passive_reason
        assert result.answer.predicts.code in ("unknown", "with_friction")


@pytest.mark.slow
def test_a_force_of_several_steps_leaves_the_loop_as_it_is(compared):
    course, result = compared("several steps")
    (found,) = result.experiments
    assert found.loop.adequate
    assert found.replay.is_right
    assert {cause.code for cause in found.causes} - {"coarse_sensor"} == {"several_steps"}
    assert found.loop.delay_samples.value == pytest.approx(course.setup.loop.delay_samples, abs=0.01)
    for quantity in ("mass", "damping"):
        estimate, truth = found.estimates[quantity], getattr(course.experiment, quantity)
        assert estimate.low <= truth <= estimate.high


@pytest.mark.slow
@pytest.mark.parametrize("seed", [SEED, 810])
def test_a_step_that_rises_slowly_leaves_the_loop_as_it_is(compared, seed):
    course, result = compared("ramp", seed)
    (found,) = result.experiments
    assert found.loop.adequate, found.loop.reason
    assert found.loop.delay_samples.value == pytest.approx(course.setup.loop.delay_samples, abs=0.01)
    assert found.loop.mass.value == pytest.approx(course.experiment.mass, rel=2e-3)
    assert radius(course, found.passive.stiffness, found.passive.damping) < 1
    assert [cause.code for cause in found.causes] == ["step_not_a_step"]
    assert f"rises over {course.setup.hidden.ramp_samples} rows" in found.causes[0].evidence


@pytest.mark.parametrize(
    ("name", "code"),
    [
        pytest.param("operator", "operator", marks=pytest.mark.slow),
        pytest.param("gravity", "constant_force", marks=pytest.mark.slow),
        # the optima of these loops, for the theory beside them, take seconds
        pytest.param("butterworth filter", "velocity_filter", marks=pytest.mark.slow),
        pytest.param("actuator lag", "actuator_lag", marks=pytest.mark.slow),
        pytest.param("mode at the motor", "vibration_mode", marks=pytest.mark.slow),
        pytest.param("mode at the load", "vibration_mode", marks=pytest.mark.slow),
        pytest.param("filter and lag", "velocity_filter", marks=pytest.mark.slow),
    ],
)
def test_a_linear_part_is_named_and_the_loop_with_it_bears_statements(compared, name, code):
    course, result = compared(name)
    (found,) = result.experiments
    assert found.loop.adequate, found.loop.reason
    assert found.causes[0].code == code
    assert {cause.code for cause in found.causes} <= set(KINDS[name](SEED).truth["causes"])
    largest = max(limit.stiffness for limit in found.loop_boundary)
    for limit in found.loop_boundary:
        if limit.stiffness > 0.1 * largest:
            assert radius(course, 0.99 * limit.stiffness, limit.damping) < 1
            assert radius(course, 1.01 * limit.stiffness, limit.damping) > 1
    # theory is drawn by the same loop
    assert found.theory.loop.mass == found.loop.mass.value
    assert (found.theory.loop.velocity is None) == (found.loop.velocity is None)
    assert found.theory.loop.actuator_lag_s == (found.loop.actuator_lag_s.value if found.loop.actuator_lag_s else 0.0)
    assert (found.theory.loop.mode is None) == (found.loop.mode is None)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "seed"), [("actuator lag", 604), ("filter and lag", 601), ("friction strong", SEED), ("actuator lag", 71)]
)
def test_lag_and_friction_are_no_jitter(compared, name, seed):
    jitter = compared(name, seed)[1].experiments[0].estimates["jitter_samples"]
    assert (jitter.low or 0.0) <= 0


@pytest.mark.slow
def test_an_ideal_loop_has_no_causes(compared):
    _, result = compared("ideal")
    assert result.experiments[0].causes == ()
    assert result.answer.estimates_reason == ""


@pytest.mark.slow
def test_a_force_that_the_logs_do_not_ask_for_is_no_cause(compared):
    _, result = compared("only unstable", 601)
    (found,) = result.experiments
    assert found.loop.adequate
    assert {cause.code for cause in found.causes} == {"no_stable_trial"}
    assert all(found.estimates[f].low <= 0 <= found.estimates[f].high for f in ("friction", "constant_force"))


@pytest.mark.slow
def test_clipping_imitates_no_missing_rows_and_no_steps(compared):
    _, result = compared("clipping in the log", 603)
    assert [cause.code for cause in result.experiments[0].causes] == ["saturation"]


@pytest.mark.slow
def test_theory_takes_the_delay_that_explains_the_logs(compared):
    course, result = compared("fractional delay")
    (found,) = result.experiments
    assert found.theory.loop.delay_samples == pytest.approx(course.setup.loop.delay_samples, abs=0.01)
    (cause,) = found.causes
    assert cause.code == "fractional_delay"
    assert abs(found.scores[0].distance.median) < 0.02
