"""The ladder against devices that another simulator moves in small steps: the part that is there, with its numbers."""

from __future__ import annotations

import numpy as np
import pytest
from not_ideal import simulate

from pipeline.measured.ladder.device import Device
from pipeline.measured.ladder.ladder import Ladder, Rung, climb
from pipeline.measured.ladder.physical import in_si
from pipeline.measured.ladder.trials import LadderTrials, spread_over_plane
from pipeline.measured.stages.stage_groups import TrialGroup
from pipeline.measured.stages.stage_ladder import _covering, windows

MASS, DAMPING, DELAY, T = 0.5, 3.0, 3.0, 1e-3
WALLS = [(K, B) for B in (5.0, 15.0, 25.0, 35.0) for K in (300.0, 700.0, 1500.0, 2500.0)]
NOISE, QUANTUM = 3e-6, 1e-5
MODE = (45.0, 0.03, 0.12)
MODE_NUMBERS = {"frequency_hz": 45.0, "damping_ratio": 0.03, "far_mass": 0.12}


def trials_of(**parts) -> LadderTrials:
    K, B = np.array(WALLS).T
    batch = simulate(K, B, mass=MASS, b=DAMPING, delay=DELAY, T=T, noise=NOISE, quantum=QUANTUM, rows=350, **parts)
    found = windows(TrialGroup(batch), {"chosen": list(batch.trial_id)})
    assert found is not None
    return found[2]


def start(mass: float = 1.2 * MASS, delay: float = DELAY + 1) -> Device:
    return Device({"gain": float(np.log(T**2 / mass)), "delta": DAMPING * T / mass, "delay": delay})


@pytest.mark.parametrize(
    ("parts", "expected", "numbers"),
    [
        ({}, (), {}),
        ({"lag": 0.0025}, ("lag",), {"actuator_lag_s": 0.0025}),
        ({"most": 7.0}, ("saturation",), {"force_limit": 7.0}),
        ({"most": 8.1}, ("saturation",), {"force_limit": 8.1}),
        pytest.param({"mode": MODE}, ("mode at the motor",), MODE_NUMBERS, marks=pytest.mark.slow),
        pytest.param(
            {"mode": MODE, "lag": 0.003},
            ("lag", "mode at the motor"),
            MODE_NUMBERS | {"actuator_lag_s": 0.003},
            marks=pytest.mark.slow,
        ),
    ],
)
def test_the_part_that_is_there_is_found_with_its_numbers(parts, expected, numbers):
    trials = trials_of(seed=3, **parts)
    found = climb(trials, start())
    assert found.best.parts == expected
    assert found.best.holds
    told = in_si(found.best.device, found.covariance, T)
    values = dict(zip(told.names, told.values, strict=True))
    # the simulator's steps of T/20 make a lag, a stop and a mode late by a part of a step
    for name, true in {"mass": MASS, **numbers}.items():
        assert values[name] == pytest.approx(true, rel=0.02), name
    assert values["delay_samples"] == pytest.approx(DELAY, abs=0.06)
    assert values["damping"] == pytest.approx(DAMPING, rel=0.02)


def test_a_command_that_is_clipped_as_logged_is_no_part_of_the_device():
    found = climb(trials_of(seed=4, limit=8.05), start())
    assert found.best.parts == ()
    assert found.best.holds


@pytest.mark.slow
def test_friction_and_a_lag_together_do_not_hold_as_something_else():
    assert not climb(trials_of(seed=4, friction=0.1, lag=0.002), start()).best.holds


@pytest.mark.slow
def test_two_modes_are_not_one():
    """A second vibration, added to the position of a device with one, is explained by no rung."""
    trials = trials_of(seed=5, mode=MODE)
    time = np.arange(trials.position.shape[1]) * T
    ringing = 4e-4 * np.exp(-20 * time) * np.sin(2 * np.pi * 83 * time)
    moved = trials.position + np.where(trials.weight > 0, np.roll(ringing, 24) * (time > 0.024), 0.0)
    other = LadderTrials(**{**{n: getattr(trials, n) for n in trials.__dataclass_fields__}, "position": moved})
    assert not climb(other, start()).best.holds


def test_trials_are_taken_evenly_from_the_plane():
    K, B = (axis.ravel() for axis in np.meshgrid(np.arange(40.0), np.arange(30.0)))
    usable = K != 7
    chosen = spread_over_plane(K, B, usable, most=100)
    assert len(set(chosen.tolist())) == 100
    assert usable[chosen].all()
    assert set(B[chosen]) == set(B)
    assert spread_over_plane(K[:5], B[:5], np.ones(5, bool)).tolist() == [0, 1, 2, 3, 4]


def _climbed(n, seed, **features):
    random = np.random.default_rng(seed)
    K, B = random.uniform(500, 9000, n), random.uniform(5, 60, n)
    batch = simulate(K, B, delay=3.0, quantum=1e-6, noise=1e-6, rows=300, travel=0.5, seed=seed, **features)
    K, B, trials, _ = windows(TrialGroup(batch), {"chosen": list(batch.trial_id)})
    ideal = {"gain": float(np.log(1e-6 / 0.58)), "delta": 4e-3 / 0.58, "delay": 3.3}
    return climb(trials.select(np.lexsort((K, B))), Device(ideal))


@pytest.mark.parametrize(("n", "seed", "mode"), [(8, 15, (320.0, 0.05, 0.1)), (25, 13, (400.0, 0.03, 0.15))])
def test_a_fast_mode_at_the_motor_is_not_called_a_lag_with_confidence(n, seed, mode):
    found = _climbed(n, seed, mode=mode)
    devices = [found.best, *found.alike]
    # semi-implicit steps of a twentieth of a sample are 0.025 samples late
    assert any("mode at the motor" in rung.parts for rung in devices)
    delays = [rung.device.numbers["delay"] for rung in devices]
    assert min(delays) - 0.05 <= 3.0 <= max(delays) + 0.05


@pytest.mark.parametrize(("n", "seed", "lag"), [(25, 16, 0.002), (25, 17, 0.001)])
def test_a_lag_stays_a_lag(n, seed, lag):
    found = _climbed(n, seed, lag=lag)
    assert found.best.parts == ("lag",)
    assert found.alike == ()


def test_the_delay_holds_those_of_devices_that_are_alike():
    """A lag with a delay of 2.64 and a mode with one of 2.98, each known to 0.02: the interval reaches past 2.98."""
    lag, mode = (Device({"gain": -13.0, "delta": 0.007, "delay": delay}) for delay in (2.64, 2.98))
    one, other = (Rung(device, 4, 4, -187.0) for device in (lag, mode))
    place = lag.names.index("delay")
    known = Ladder(one, np.diag([1e-6, 1e-6, 1e-4]), one, None, (other,))
    half_width = 1.96 * np.sqrt(_covering(known)[place, place])
    assert half_width == pytest.approx(0.34 + 1.96 * np.sqrt(known.covariance[place, place]), rel=1e-3)
    alone = Ladder(one, known.covariance, one, None, ())
    np.testing.assert_array_equal(_covering(alone), known.covariance)
