"""Logs that say little, or much of little: what is identified, and the reason where nothing is."""

from __future__ import annotations

import numpy as np
import pytest
from any_experiment import Rig, Trial, recorded

from pipeline.base.errors import ParameterError
from pipeline.measured.identification import likelihood
from pipeline.measured.identification.identified import identified
from pipeline.measured.identification.motion import PlantShape, Transitions
from pipeline.measured.identification.noise import Noise, gains_of
from pipeline.measured.identification.recordings import LogUnits, Recording
from pipeline.measured.identification.search import climbed
from pipeline.measured.identification.segments import segments_of


def motor(command, *, inertia, damping, friction=0.0, delay=0.0, period=2e-3, resolution=0.0, name="a"):
    """A log of a motor that starts at rest, exact between rows while it does not turn; ``delay`` in rows of a tenth."""
    fine = 10
    late = np.concatenate([np.zeros(round(delay * fine)), np.repeat(command, fine)])
    x, v, position = 0.0, 0.0, []
    decay = np.exp(-damping / inertia * period / fine)
    for k in range(len(command) * fine):
        if k % fine == 0:
            position.append(x)
        force = late[k]
        net = force - friction * np.sign(v) if v else np.sign(force) * max(abs(force) - friction, 0.0)
        end = net / damping
        after = end + (v - end) * decay
        x += end * period / fine + (v - end) * (1 - decay) * inertia / damping
        v = 0.0 if v * after < 0 else after
    seen = np.array(position)
    seen = np.round(seen / resolution) * resolution if resolution else seen
    return Recording(name, period * np.arange(len(command)), np.asarray(command, float), seen, period)


def values(found):
    return {name: each.value for name, each in found.parameters.items() if name not in found.unidentifiable}


@pytest.mark.sampled
@pytest.mark.parametrize("rows", [350, 2000])
@pytest.mark.parametrize(("friction", "direction"), [(4.4, 1), (0.0, -1)])
def test_a_long_plateau_says_no_less_than_its_begin(rows, friction, direction):
    truth = {"inertia": 0.0033, "damping": 0.257, "friction": friction, "delay": 1.5}
    sizes = np.array([13.0, 26.0, 39.0, 52.0, 65.0]) * direction
    logs = [motor((np.arange(rows) >= 100) * size, **truth, resolution=0.0015, name=f"{size:g}") for size in sizes]
    found = identified(logs)
    assert values(found)["mass"] == pytest.approx(0.0033, rel=0.01)
    assert values(found)["damping"] == pytest.approx(0.257, rel=1e-3)
    assert values(found)["delay_samples"] == pytest.approx(1.5, rel=0.03)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_wrong_sign_is_named_only_where_the_command_moves_the_device(sign):
    rng = np.random.default_rng(3)
    command = np.repeat(rng.uniform(-4, 4, 10), 40)
    log = motor(command, inertia=0.02, damping=0.1, resolution=1e-4)
    turned = Recording("b", log.time, sign * log.command, log.position, log.period)
    if sign == 1:
        assert values(identified([turned]))["mass"] == pytest.approx(0.02, rel=0.02)
    else:
        with pytest.raises(ParameterError, match="moves against its command"):
            identified([turned])


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("counts", "seed"), [(1, 0), (4, 1), (9, 2)])
def test_a_device_that_friction_fixes_hardly_moves_and_has_no_sign(counts, seed, sign):
    rng = np.random.default_rng(seed)
    command = np.zeros(200)
    command[40:90] = 6.0 * sign
    position = np.where(command != 0, counts * 1e-5, 0.0)
    position[95:] += 1e-5 * rng.integers(0, 2)
    log = Recording("a", 0.015 * np.arange(200), command, position, 0.015)
    with pytest.raises(ParameterError, match=r"hardly moves.*larger commands"):
        identified([log])


@pytest.mark.sampled
@pytest.mark.parametrize(("stiffness", "resolution"), [(37e3, 6e-6), (2e3, 1e-4)])
def test_presliding_gives_reasons_and_no_numbers(stiffness, resolution):
    logs = []
    for size in (6.0, 5.0):
        command = size * np.sin(0.085 * np.arange(500)) * (np.arange(500) > 20)
        # the bristles of friction give way a little
        position = np.round((command / stiffness) * (1 - 0.1 * np.abs(command) / 6) / resolution) * resolution
        logs.append(Recording(f"{size:g}", 0.015 * np.arange(500), command, position, 0.015))
    found = identified(logs)
    assert {"mass", "damping"} <= found.unidentifiable
    assert "hardly moves" in found.reasons["mass"]
    assert set(found.reasons) == found.unidentifiable


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_rows_farther_apart_than_the_time_constant_give_the_speed_per_command(seed):
    rng = np.random.default_rng(seed)
    damping, constant = 10 ** rng.uniform(-2, 0), rng.uniform(1e-3, 2e-3)
    fine = np.repeat(rng.uniform(-0.3, 0.3, 24), 2500)
    log = motor(fine, inertia=constant * damping, damping=damping, period=1e-4)
    rows = np.cumsum(rng.integers(45, 60, 1100))
    position = np.round(log.position[rows], 4)
    found = identified([Recording("a", log.time[rows], fine[rows], position, 5.2e-3)])
    assert "mass" in found.unidentifiable
    assert "longer than the time constant" in found.reasons["mass"]
    interval = found.parameters["damping"]
    assert interval.low <= damping <= interval.high
    assert interval.value == pytest.approx(damping, rel=0.02)


@pytest.mark.parametrize("other", [2e-3, 1.2e-3, 1e-4])
def test_two_sampling_periods_are_named(other):
    rig = Rig()
    logs = [Recording(str(i), *recorded(rig, Trial(0.0, 0.0, 4.0)), rig.period) for i in range(2)]
    logs.append(Recording("other", *recorded(Rig(period=other), Trial(0.0, 0.0, 4.0)), other))
    with pytest.raises(ParameterError, match=rf"2 sampling periods: .*{other:g} s"):
        identified(logs)


@pytest.mark.parametrize("period", [1e-300, 1e300])
def test_periods_without_meaning_are_refused(period):
    log = Recording("a", np.arange(100.0), np.ones(100), np.arange(100.0) ** 2, period)
    with pytest.raises(ParameterError, match="sampling periods"):
        identified([log])


@pytest.mark.parametrize(("rows", "count"), [(2, 6), (3, 12), (9, 3)])
def test_logs_of_few_rows_are_too_short(rows, count):
    rig = Rig()
    logs = [
        Recording(str(i), *recorded(rig, Trial(0.0, 0.0, 4.0, rows=rows, edge=0)), rig.period) for i in range(count)
    ]
    with pytest.raises(ParameterError, match="usable rows"):
        identified(logs)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("friction", "delay", "step", "seed"), [(0.3, 2.4, 4.0, 0), (0.1, 0.5, -2.0, 1), (0.3, 5.0, 4.0, 2)]
)
def test_one_log_with_friction_has_its_delay_or_none(friction, delay, step, seed):
    rig = Rig(friction=friction, delay=delay)
    log = Recording("a", *recorded(rig, Trial(1500.0, 15.0, step), seed), rig.period)
    found = identified([log])
    truth = {"mass": 0.5, "delay_samples": delay, "friction.coulomb": friction}
    identifiable = {name: found.parameters[name] for name in truth if name in found.parameters}
    for name in found.unidentifiable:
        identifiable.pop(name, None)
    assert all(each.low <= truth[name] <= each.high for name, each in identifiable.items())


def test_a_direction_that_never_changes_bounds_no_friction():
    rig = Rig(friction=0.3)
    logs = [
        Recording(str(K), *recorded(rig, Trial(K, 40.0, 1.0, rows=60)), rig.period)
        for K in (20.0, 40.0, 60.0, 80.0, 120.0)
    ]
    found = identified(logs)
    assert found.choice.bounds.get("friction.coulomb", 0.0) <= 1.0
    for name in ("friction.coulomb", "constant_force"):
        each = found.parameters.get(name)
        assert each is None or name in found.unidentifiable or each.high - each.low <= 2.0


@pytest.mark.parametrize("seed", range(6))
def test_a_filter_forgets_its_start_or_is_none(seed):
    """Of devices that run away, with slow modes and any random force; one that doubles do not reach is NaN."""
    rng = np.random.default_rng(seed)
    log = Recording("a", np.arange(60.0), np.ones(60), np.arange(60.0) ** 2, 1.0)
    held = segments_of([log], LogUnits.of([log]), 6, False)
    computed = 0
    for _ in range(150):
        shape = PlantShape(
            delta=rng.uniform(-0.5, 2),
            gamma=rng.choice([-1, 1]) * 10 ** rng.uniform(-6, 0.3),
            mode_frequency=10 ** rng.uniform(-2.7, 0.4),
            mode_damping_ratio=rng.uniform(0, 0.5),
            load_mass_fraction=rng.uniform(0.01, 0.9),
        )
        transitions = Transitions.of(held, shape)
        gain = gains_of(held, transitions, Noise(10 ** rng.uniform(-12, 6)), held.command)[0][0]
        if np.isfinite(gain).all():
            computed += 1
            errors = transitions.motion[1][0] @ (np.eye(4) - np.outer(gain, transitions.motion[5]))
            assert np.abs(np.linalg.eigvals(errors)).max() < 1 + 2e-6
    assert computed > 100


def test_a_device_far_beyond_computing_is_left_as_it_is():
    log = Recording("a", np.arange(60.0), np.ones(60), np.arange(60.0) ** 2, 1.0)
    held = segments_of([log], LogUnits.of([log]), 6, False)
    far = likelihood.Device({"gain": 1.0, "delta": -1e4, "gamma": -1e4}, Noise(0.306))
    assert climbed(held, far, 2).device.numbers == far.numbers


def test_results_do_not_depend_on_how_much_is_computed_together(monkeypatch):
    rig = Rig(noise=1e-6)
    walls = [(500.0, 5.0, 300), (1500.0, 15.0, 120), (3000.0, 20.0, 260), (800.0, 2.0, 60)]
    logs = [
        Recording(str(i), *recorded(rig, Trial(K, B, 4.0, rows=rows), i), rig.period)
        for i, (K, B, rows) in enumerate(walls)
    ]
    together = identified(logs).parameters
    monkeypatch.setattr(likelihood, "TOGETHER", 1)
    apart = identified(logs).parameters
    for name, each in together.items():
        assert apart[name].value == pytest.approx(each.value, rel=1e-7, abs=1e-9)
        assert apart[name].high == pytest.approx(each.high, rel=1e-4, abs=1e-9)


@pytest.mark.slow
def test_the_last_climb_may_go_beyond_all_optima():
    rig = Rig(mass=2.0, damping=0.0, friction=0.5, period=0.005, delay=2.6, noise=1e-6)
    walls = [
        Trial(8e5 / 81, 800 / 9, 0.0, rows=194, edge=0),
        Trial(-5e4 / 81, 400 / 9, 4.0, rows=205, edge=5),
        Trial(1.2e6 / 81, 0.0, 0.3, rows=230),
        Trial(1e5 / 81, 400 / 9, 0.0, rows=264, edge=260, velocity=0.1),
        Trial(1e5 / 81, 400 / 9, 0.0, rows=264, edge=260, velocity=0.1),
        Trial(-5e4 / 81, 50 / 9, -4.0, rows=165, edge=0),
    ]
    logs = [Recording(str(i), *recorded(rig, trial, i), rig.period) for i, trial in enumerate(walls)]
    mass = identified([logs[i] for i in (2, 5, 1, 3, 4, 0)]).parameters["mass"]
    assert mass.low <= 2.0 <= mass.high
