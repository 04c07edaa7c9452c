"""Limits of a loop that was fitted to soft walls, all well below them, against the true device's eigenvalues."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from columns import stacked

from pipeline.device.parts import Butterworth, Friction
from pipeline.device_data.devices import load_device
from pipeline.intake.ingest import ingest
from pipeline.measured.experiment.estimates import delay_estimate
from pipeline.measured.experiment.identified_loop import identified_loop
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.planning.loop_limits import limits_of
from pipeline.records.models import Device
from pipeline.records.trials import Trials
from pipeline.simulation.radius import spectral_radius
from pipeline.simulation.setup import setup_of
from pipeline.simulation.simulate import simulate
from pipeline.simulation.sweep import SimulatedSweep, write_sweep

SHARES = (0.15, 0.3, 0.45, 0.58)
"""Stiffness of the tested walls relative to the limit."""

FILTER = {"kind": "butterworth", "order": 2, "cutoff_hz": 70.0}
MODE = {"frequency_hz": 43.0, "damping_ratio": 0.04, "mass": 0.09, "sensor": "motor"}


def true_limits(setup, damping):
    low, high = np.zeros(len(damping)), np.full(len(damping), 1e5)
    for _ in range(50):
        middle = 0.5 * (low + high)
        stable = spectral_radius(setup, middle, damping) < 1
        low, high = np.where(stable, middle, low), np.where(stable, high, middle)
    return low


def simulated(setup, K, B, scatter: float) -> Trials:
    """Trials of one device whose friction is another one in each."""
    if not scatter:
        return simulate(setup, K, B, seed=91)
    coulomb = setup.loop.friction.coulomb * (1 + scatter * np.random.default_rng(91).standard_normal(len(K)))
    setups = [setup.with_loop(friction=Friction(coulomb=max(c, 0.0))) for c in coulomb]
    each = zip(setups, K, B, strict=True)
    return Trials.of(simulate(one, np.array([k]), np.array([b]), seed=91)[0] for one, k, b in each)


def soft_course(parts: dict, folder, scatter=0.0, **experiment) -> tuple[ExperimentStages, SimulatedSweep, np.ndarray]:
    """Trials of a Falcon with other parts against walls below 60 % of the limit at five dampings, ingested."""
    base = load_device("falcon").model_copy(update={"tables": (), "name": "soft"})
    known = base.model_dump(mode="json", by_alias=True, exclude_unset=True)
    entry = known["experiment"][0] | {"mass": 0.47, "damping": 3.1, "jitter_samples": []} | experiment
    device = Device.model_validate(known | {"loop": parts, "experiment": [entry], "duration_s": 0.35})
    (one,) = device.experiments
    setup = setup_of(device, one)
    # as far as softer walls are stable at all
    every = np.linspace(0.5, 40.0, 80)
    highest = every[spectral_radius(setup, np.ones(80), every) < 1].max()
    damping = np.linspace(0.05, 0.8, 5) * highest
    limit = true_limits(setup, damping)
    K, B = np.outer(SHARES, limit).ravel(), np.tile(damping, len(SHARES))
    trials = simulated(setup, K, B, scatter)
    trials = replace(trials, trial_id=tuple(f"soft{i}" for i in range(len(trials))))
    course = SimulatedSweep(device, one, setup, 91, trials, np.ones(len(K), int), np.full(len(K), "stable"))
    write_sweep(course, folder / "raw")
    ingest([folder / "raw"], folder / "processed", jobs=1)
    return ExperimentStages.stored(folder / "processed", "soft", one.name), course, limit


@pytest.mark.sampled
@pytest.mark.parametrize(
    ("parts", "experiment", "expected"),
    [
        pytest.param({"actuator_lag_s": 0.0023}, {"delay_samples": 3.4}, {"lag"}, marks=pytest.mark.slow),
        ({"operator": {"mass": 0.2, "damping": 4.0, "stiffness": 260.0}}, {}, {"spring"}),
        pytest.param({"actuator_lag_s": 0.0016, "velocity": FILTER}, {}, {"lag"}, marks=pytest.mark.slow),
        pytest.param({"mode": MODE}, {}, {"mode"}, marks=pytest.mark.slow),
        pytest.param({"mode": MODE | {"sensor": "load"}}, {}, {"mode at the load"}, marks=pytest.mark.slow),
        pytest.param({"mode": MODE | {"load_damping": 1.5}}, {}, {"mode", "load damping"}, marks=pytest.mark.slow),
        pytest.param({"mode": MODE, "actuator_lag_s": 0.002}, {}, {"lag", "mode"}, marks=pytest.mark.slow),
    ],
)
def test_limits_from_soft_walls_are_those_of_the_device(tmp_path, parts, experiment, expected):
    stages, course, limit = soft_course(parts, tmp_path, **experiment)
    device = identified_loop(stages)
    at = f"mode at the {device.mode_sensor}" if device.mode_sensor == "load" else "mode"
    assert {at if part == "mode" else part for part in device.parts} == expected
    assert device.is_reliable
    velocity = Butterworth(**FILTER) if "velocity" in parts else None
    damping = course.trials.damping[: len(limit)]
    found, reach = limits_of(replace(device, velocity=velocity), damping)
    assert found == pytest.approx(limit, rel=0.05)
    # three half widths, and what the course's bisection and the noise's stand-in leave
    assert (np.abs(found - limit) <= 3 * reach + 1e-3 * limit).all()
    assert (reach <= 0.025 * limit).all()


def test_an_ideal_device_has_no_part(tmp_path):
    stages, _, _ = soft_course({}, tmp_path)
    assert identified_loop(stages).parts == ()


@pytest.mark.slow
def test_mass_and_friction_are_told_where_friction_differs_from_run_to_run(tmp_path):
    stages, _, _ = soft_course({"friction": {"coulomb": 0.6}}, tmp_path, scatter=0.2)
    device = identified_loop(stages)
    assert device.parts == ("friction",)
    for name, true, most in (("mass", 0.47, 0.02), ("damping", 3.1, 0.1), ("friction.coulomb", 0.6, 0.2)):
        number = device.interval(name)
        assert number.low <= true <= number.high, (name, number)
        assert number.high - number.low < 2 * most * true


@pytest.mark.slow
@pytest.mark.parametrize("lag", [0.001, 0.0023])
def test_costs_behind_a_lag_are_counted_from_the_delay_and_not_from_the_motion_that_is_seen(tmp_path, lag):
    """The motion that is seen begins one or two samples late, which takes 4 to 6 % from the energies."""
    stages, course, _ = soft_course({"actuator_lag_s": lag}, tmp_path, delay_samples=3)
    setup, stiffness = course.setup, stages.column("response", "stiffness")
    assert delay_estimate(stages).value == 3  # the lag is a part of its own
    exact = simulate(
        replace(setup.with_loop(sensor={}), rows=3000), stiffness, stages.column("response", "damping"), seed=1
    )
    T, first = setup.loop.sampling_period_s, 3 + int(np.flatnonzero(exact[0].command)[0])
    for weight in (0, 1):
        cost, _ = stages.cost(f"energy_step_w{weight}")
        low, high = stages.cost_interval(f"energy_step_w{weight}")
        x = stacked(exact, "position")[:, first:]
        K, rest = stiffness[:, None], (exact.step / stiffness)[:, None]
        change = np.diff(x, axis=1, prepend=x[:, :1])
        energy = 0.5 * K * (x - x[:, :1] - rest) ** 2 + 0.5 * 0.47 * (change / T) ** 2
        true = (np.arange(x.shape[1]) ** weight * energy).sum(axis=1) / (0.5 * K * rest**2)[:, 0]
        sure = np.isfinite(cost) & ((high - low) < 0.02 * cost)
        assert sure.sum() >= 4
        assert cost[sure] == pytest.approx(true[sure], rel=0.01)
