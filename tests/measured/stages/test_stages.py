from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import simulated
from stored import replace_table, trials_of

from pipeline.base.errors import StoreError
from pipeline.loop.normalised_loop import LoopUnits, NormalisedLoop
from pipeline.measured import thesis
from pipeline.measured.cost import costs
from pipeline.measured.experiment import boundary
from pipeline.measured.experiment.estimates import damping_estimate, delay_estimate, mass_estimate
from pipeline.measured.signal import response, verdict
from pipeline.measured.stages import stage_rows, stage_tables
from pipeline.measured.stages.stage_needs import NEEDS, required
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.measured.stages.stages import STAGES
from pipeline.records.table_files import read_table
from pipeline.store.storage import stage_file
from pipeline.theory.boundary import stiffness_limit
from pipeline.theory.energy import energy_costs
from pipeline.theory.settling_overshoot import transient_costs

TRUE_MASS, TRUE_DAMPING, DELAY, T = 0.58, 4.0, 4, 1e-3


@pytest.fixture(scope="module")
def ideal(falcon):
    return falcon.stages("1")


@pytest.fixture(scope="module")
def lasting(patient):
    return patient.stages("1")


@pytest.fixture(scope="module")
def decayed(lasting):
    """Stable trials with K > 0 whose motion beyond the log adds less than 1e-10 to any sum, by independent poles."""
    K, B = trials_of(lasting).stiffness, trials_of(lasting).damping
    radius = np.array([simulated.spectral_radius(k, b, **simulated.FALCON) for k, b in zip(K, B, strict=True)])
    counted = trials_of(lasting).rows.max() - 20 - DELAY
    # the energy falls with the square of the radius; k^2 and the sum over the rest add at most counted^3
    chosen = (K > 0) & (radius < 1)
    chosen &= radius ** (2 * counted) * float(counted) ** 3 < 1e-12
    assert chosen.sum() > 40
    return chosen


def normalised(K, B):
    units = LoopUnits(TRUE_MASS, T)
    return NormalisedLoop.ideal(0.0, TRUE_DAMPING / units.damping, DELAY), K / units.stiffness, B / units.damping


@pytest.mark.slow
def test_delay_of_every_ideal_trial_is_that_of_the_simulator(ideal):
    assert set(ideal.column("delay", "first_change_samples")) == {float(DELAY)}
    estimate = delay_estimate(ideal)
    assert (estimate.value, estimate.low, estimate.high) == (4.0, 4.0, 5.0)


@pytest.mark.slow
@pytest.mark.parametrize("samples", range(2, 9))
def test_all_seven_delays_of_the_lwr(sweep, samples):
    of = sweep.stages(f"delay-{samples}")
    assert set(of.column("delay", "first_change_samples")) == {float(samples)}
    assert delay_estimate(of).value == samples
    assert mass_estimate(of).value == pytest.approx(0.19, rel=1e-5)
    assert mass_estimate(of).unit == "kg m^2"
    assert damping_estimate(of).value == pytest.approx(0.0, abs=0.02)


def interval_means(trials, first, last):
    """Mean position and velocity over the interval after row ``last`` of a device that gets the logged commands.

    Twenty steps a sample with the matrix exponential, in exact arithmetic of the plant: no code of the package.
    """
    fine = 20
    A, g = simulated.plant(TRUE_MASS, TRUE_DAMPING, T / fine)
    n = len(trials)
    command = np.array([trial.command[: last + 1] for trial in trials])
    x, v = np.zeros(n), np.zeros(n)
    for row in range(last + 1):
        u = command[:, row - DELAY] if row - DELAY >= first else np.zeros(n)
        path = [x]
        for _ in range(fine):
            x, v = A[0, 0] * x + A[0, 1] * v + g[0] * u, A[1, 0] * x + A[1, 1] * v + g[1] * u
            path.append(x)
    path = np.array(path)
    weight = np.array([1.0, *([4.0, 2.0] * (fine // 2))])  # Simpson's rule
    weight[-1] = 1.0
    return weight @ path / weight.sum(), (path[-1] - path[0]) / T


def test_mass_has_exactly_the_bias_of_viscous_damping(ideal):
    x, v = interval_means(trials_of(ideal), 20, 20 + 15 - 1)
    expected = TRUE_MASS + TRUE_DAMPING * x / v
    found = ideal.column("mass", "mass_momentum")
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    assert np.ptp(expected) > 0.01  # the bias differs from trial to trial, so the test can tell


def test_estimates_of_ideal_logs(ideal):
    mass_found, damping_found = mass_estimate(ideal), damping_estimate(ideal)
    assert mass_found.value == pytest.approx(TRUE_MASS, rel=1e-6)
    balance = mass_found.by_method["thesis_momentum_balance"]
    assert 1.038 < balance.value / TRUE_MASS < 1.095  # known range of the bias over experiment 1
    assert damping_found.value == pytest.approx(TRUE_DAMPING, abs=0.02)
    for method in damping_found.by_method.values():
        assert method.value == pytest.approx(TRUE_DAMPING, abs=0.02)


def test_ideal_logs_obey_the_wall_law(ideal):
    assert set(ideal.texts("wall_law", "law_codes")) == {""}
    residual, rounding = (ideal.column("wall_law", f"law_{name}") for name in ("residual", "rounding"))
    assert np.isfinite(residual).all()
    assert (residual <= rounding).all()
    assert set(ideal.column("wall_law", "law_rows")) == {0}


@pytest.mark.slow
def test_settling_and_overshoot_of_logs_are_those_of_theory(lasting, decayed):
    loop, alpha, beta = normalised(trials_of(lasting).stiffness[decayed], trials_of(lasting).damping[decayed])
    theory = transient_costs(loop, alpha, beta, continuous=False)
    for name in ("settle_1pct", "settle_2pct", "settle_5pct"):
        np.testing.assert_array_equal(lasting.column("settling", name)[decayed], theory[f"{name}_discrete"])
    overshoot = lasting.column("overshoot", "overshoot")[decayed]
    np.testing.assert_allclose(overshoot, theory["overshoot_discrete"], rtol=0, atol=1e-9)
    assert (overshoot > 0.1).any()
    assert (overshoot < 1e-9).any()


@pytest.mark.slow
def test_energy_of_logs_is_that_of_theory(lasting, decayed):
    loop, alpha, beta = normalised(trials_of(lasting).stiffness[decayed], trials_of(lasting).damping[decayed])
    theory = energy_costs(loop, alpha, beta)
    for w in range(3):
        expected = theory[f"energy_step_w{w}_discrete"]
        cost, _ = lasting.cost(f"energy_step_w{w}")
        # with the estimated mass instead of the true one: its error of 5e-7 is all that is added
        np.testing.assert_allclose(cost[decayed], expected, rtol=1e-6)


@pytest.mark.parametrize("grid", ["falcon", "lwr"])
def test_measured_boundary_encloses_the_closed_form_at_every_damping(grid, request):
    lab = request.getfixturevalue(grid)
    seen = 0
    for name, course in lab.courses.items():
        e = course.experiment
        units = LoopUnits(e.mass, T)
        loop = NormalisedLoop.ideal(0.0, e.damping / units.damping, e.delay_samples)
        plant = {"mass": e.mass, "b": e.damping, "delay": int(e.delay_samples)}
        points = lab.stages(name).boundary_points
        assert [p.damping for p in points] == sorted({b for b, k in zip(
            course.trials.damping, course.trials.stiffness, strict=True) if k > 0})  # fmt: skip
        for p in points:
            assert not p.censored
            limit = stiffness_limit(loop, np.array([p.damping / units.damping]))[0] * units.stiffness
            if p.stable is None:
                assert not p.unstable < limit
                continue
            assert p.stable < limit < p.unstable
            assert simulated.spectral_radius(p.stable, p.damping, **plant) < 1
            assert simulated.spectral_radius(p.unstable, p.damping, **plant) > 1
            seen += 1
    assert seen >= 11


@pytest.mark.slow
def test_estimates_of_noisy_logs_hold_the_truth(noisy):
    of = noisy.stages("1")
    delay_found = delay_estimate(of)
    assert delay_found.value in (3, 4, 5)
    # the jitter is spread over 3, 4 and 5: the estimate has to say so
    assert delay_found.low <= 3
    assert delay_found.high >= 5
    mass_found = mass_estimate(of)
    assert mass_found.low < TRUE_MASS < mass_found.high
    assert mass_found.low < mass_found.value < mass_found.high
    assert mass_found.value == pytest.approx(TRUE_MASS, rel=0.05)
    by_limit = damping_estimate(of).by_method["stability_limit"]
    assert by_limit.low <= TRUE_DAMPING <= by_limit.high
    assert damping_estimate(of).low < damping_estimate(of).high


def test_needs_are_those_of_the_definitions():
    # a trial whose command obeys another wall than stated is none of the boundary
    assert required(["boundary"]) == {"boundary", "response", "wall_law"}
    # the gain at rest is that of the wall that the command obeys
    assert required(["overshoot"]) == {"overshoot", "response", "wall_law"}
    assert required(["settling"]) == {"settling", "response", "wall_law", "parts", "device", "model", "delay"}
    assert required(["energy"]) == {"energy", "mass", *required(["settling"])} - {"settling"}
    assert list(NEEDS) == list(STAGES)
    order = {stage: i for i, stage in enumerate(NEEDS)}
    assert all(order[need] < order[stage] for stage, needs in NEEDS.items() for need in needs)


def test_key_changes_with_the_logs_and_the_code_but_not_with_time(falcon, edit):
    def keys(trials=None):
        of = falcon.stages("1")
        if trials is not None:
            of = dataclasses.replace(of, trials=trials)
        return {stage: of.key(stage) for stage in STAGES}

    before = keys()
    assert keys() == before
    assert len(set(before.values())) == len(STAGES)
    trials = falcon.stages("1").trials
    assert all(new != before[s] for s, new in keys(trials.slice(1)).items())
    assert keys(trials.take(pa.array(range(trials.num_rows - 1, -1, -1)))) == before
    edit(thesis)
    assert all(new != before[stage] for stage, new in keys().items())


@pytest.fixture
def copy(falcon, tmp_path):
    """A processed folder of its own, with the stages stored."""
    for stage in STAGES:
        falcon.stages("1").table(stage)
    shutil.copytree(falcon.processed, tmp_path / "processed")
    return tmp_path / "processed"


def forbid(monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("was computed again")

    monkeypatch.setattr(ExperimentStages, "_computed", refuse)
    for module in (boundary, costs, thesis, response, verdict):
        for name in ("measured_boundary", "settling", "overshoot", "energy", "from_trials", "first_change"):
            if hasattr(module, name):
                monkeypatch.setattr(module, name, refuse)
    monkeypatch.setattr(stage_tables, "load_trials", refuse)


def test_stored_stages_are_read_and_not_computed(falcon, copy, monkeypatch):
    forbid(monkeypatch)
    of = falcon.stages("1", copy)
    for stage in STAGES:
        assert of.is_stored(stage)
        assert of.table(stage).equals(read_table(stage_file(falcon.processed, "falcon", "1", stage)))


@pytest.mark.slow
def test_every_flipped_byte_is_noticed(falcon, copy):
    """A stage file that was damaged on the disk is computed anew or refused, and never gives another number."""
    path = stage_file(copy, "falcon", "1", "overshoot")
    sound = path.read_bytes()
    expected = read_table(path)
    outcomes = {"anew": 0, "refused": 0, "the same": 0}
    for at in range(0, len(sound), 23):
        damaged = bytearray(sound)
        damaged[at] ^= 0x55
        path.write_bytes(damaged)
        if not falcon.stages("1", copy).is_stored("overshoot"):
            outcomes["anew"] += 1
            continue
        try:
            table = read_table(path)
        except StoreError:
            outcomes["refused"] += 1
        else:
            assert table.equals(expected)
            outcomes["the same"] += 1
    assert outcomes["anew"] > 10
    assert outcomes["refused"] > 100


@pytest.mark.parametrize("damage", [b"", b"PAR1", b"not parquet at all" * 50])
def test_a_stage_file_without_a_key_is_computed_anew(falcon, copy, damage):
    path = stage_file(copy, "falcon", "1", "boundary")
    path.write_bytes(damage)
    of = falcon.stages("1", copy)
    assert of.why_run("boundary") == "no result is stored"
    assert of.table("boundary").equals(falcon.stages("1").table("boundary"))
    assert read_table(stage_file(copy, "falcon", "1", "boundary")).num_rows > 0


def test_a_stage_of_another_experiment_is_not_taken(falcon, noisy, copy):
    replace_table(stage_file(copy, "falcon", "1", "delay"), noisy.stages("1").table("delay"))
    of = falcon.stages("1", copy)
    assert "changed" in of.why_run("delay")
    assert delay_estimate(of).value == 4


def replaced(trials: pa.Table, name: str, values: list) -> pa.Table:
    index = trials.schema.get_field_index(name)
    return trials.set_column(index, trials.schema.field(name), pa.array(values, trials.schema.field(name).type))


def test_mixed_periods_and_motions_are_refused(falcon):
    of = falcon.stages("1")
    n = of.trials.num_rows
    periods = ExperimentStages(
        of.processed, of.device, "1", replaced(of.trials, "sampling_period_s", [1e-3] * (n - 1) + [2e-3])
    )
    with pytest.raises(StoreError, match=r"'falcon', experiment '1': sampling periods differ.*0\.002"):
        _ = periods.sampling_period_s
    motions = replaced(of.trials, "motion", ["translation"] * (n - 1) + ["rotation"])
    with pytest.raises(StoreError, match=r"'falcon', experiment '1': its logs mix"):
        _ = ExperimentStages(of.processed, of.device, "1", motions).motion


def test_units_of_stored_stages_follow_the_motion(falcon, lwr):
    for lab, name, unit in ((falcon, "1", b"kg"), (lwr, "delay-2", b"kg m^2")):
        lab.stages(name).table("mass")
        path = stage_file(Path(lab.processed), lab.device.name, name, "mass")
        assert read_table(path).schema.field("mass_momentum").metadata[b"unit"] == unit


def test_energy_without_a_mass_says_why(falcon, monkeypatch):
    for stage in STAGES:
        falcon.stages("1").table(stage)
    of = falcon.stages("1")
    nothing = mass_estimate(of).model_copy(update={"value": None, "reason": "no trial moved"})
    monkeypatch.setattr(stage_rows, "by_model", lambda *_: nothing)
    monkeypatch.setattr(of, "is_stored", lambda stage: stage != "energy")
    monkeypatch.setattr(stage_tables, "write_result", lambda *_: None)
    cost, why = of.cost("energy_step_w0")
    assert np.isnan(cost).all()
    assert why == "energy costs require the mass: no trial moved"
    assert of.optimum("energy_step_w0") is None
    assert of.optimum("overshoot") is not None
