"""Loops that lose nothing by themselves: a mode without damping, a spring without damper."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from state_matrix import radius

from pipeline import Loop, PipelineError, design

MODE = {"frequency_hz": 60.0, "damping_ratio": 0.0, "mass": 0.15}


def faintly_damped(parts: dict[str, Any]) -> Loop:
    """Return the loop with a loss so small that it moves no limit, yet no pole lies on the circle."""
    mode = dict(parts["mode"]) | {"damping_ratio": 1e-9}
    return Loop(**parts | {"mode": mode, "damping": parts["damping"] + 1e-9 * parts["mass"]})


@pytest.mark.parametrize("damping", [0.0, 1e-12, 1e-9, 1e-7, 1e-5])
def test_the_limit_of_a_mode_without_loss(damping: float) -> None:
    loop = Loop(0.5, damping, 0.001, 2, mode=MODE)
    assert loop.limits([5.0, 10.0])["stiffness"].to_numpy() == pytest.approx([971.56, 1911.84], rel=1e-5)
    assert loop.boundary(40).attrs["stiffness_max"] == pytest.approx(9509.93, rel=1e-5)


@pytest.mark.parametrize("damping", [0.0, 1e-7])
def test_optimum_and_design_with_a_mode_without_loss(damping: float) -> None:
    loop = Loop(0.5, damping, 0.001, 2, mode=MODE)
    best, answer = loop.optimum("energy_step_w0"), design(loop, 1900.0, keep=("mass", "sampling_period_s"))
    assert radius(loop, best.stiffness, best.damping) < 1
    assert answer.reached
    assert radius(loop, 1900.0, answer.wall["damping"] or 0.0) < 1


@pytest.mark.parametrize("seed", range(12))
def test_modes_without_loss_have_the_limits_of_the_state_matrix(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mass, period = float(10 ** rng.uniform(-2, 1)), float(rng.choice([0.002, 0.001, 0.00025]))
    parts: dict[str, Any] = {
        "mass": mass,
        "damping": float(rng.choice([0.0, 1e-7 * mass])),
        "sampling_period_s": period,
        "delay_samples": float(rng.choice([0, 1, 2, 5, rng.uniform(0, 5)])),
        "mode": {
            "frequency_hz": float(10 ** rng.uniform(-2, -0.2)) / period,
            "damping_ratio": 0.0,
            "mass": mass * float(rng.uniform(0.05, 0.8)),
            "sensor": str(rng.choice(["motor", "load"])),
        },
        "actuator_lag_s": period * float(rng.choice([0, 0, 1])),
    }
    loop, other, unit = Loop(**parts), faintly_damped(parts), mass / period
    for B in unit * rng.uniform(0.01, 0.4, 4) / (parts["delay_samples"] + 0.5):
        K = loop.limits(B)["stiffness"][0]
        if np.isnan(K):
            assert radius(other, 1e-5 * unit / period, B) > 1 - 1e-9
        else:
            assert max(radius(other, share * K, B) for share in (0.001, 0.01, 0.1, 0.3, 0.6, 0.9, 0.999)) < 1
            assert radius(other, 1.001 * K, B) > 1


def test_a_load_without_loss_has_a_reason_for_no_wall() -> None:
    loop = Loop(0.5, 0.0, 0.001, 2, mode=MODE | {"sensor": "load"})
    assert all(radius(faintly_damped({**vars_of(loop)}), K, B) > 1 for K in (10.0, 1e3) for B in (0.1, 10.0, 50.0))
    assert loop.limits([0.0, 10.0])["stiffness"].isna().all()
    with pytest.raises(PipelineError, match="no damping stabilises a soft wall"):
        loop.boundary()


def vars_of(loop: Loop) -> dict[str, Any]:
    names = ("mass", "damping", "sampling_period_s", "delay_samples", "mode")
    return {name: getattr(loop, name) for name in names}


def test_a_spring_without_loss_has_a_limit_at_dampings_alone() -> None:
    loop = Loop(0.5, 0.0, 0.001, 2, stiffness=1e4)
    found = loop.limits([-5.0, 0.0, 10.0, 50.0])["stiffness"].to_numpy()
    assert np.isnan(found[:2]).all()
    for K, B in zip(found[2:], (10.0, 50.0), strict=True):
        assert radius(loop, 0.999 * K, B) < 1 < radius(loop, 1.001 * K, B)


def test_a_load_too_light_to_compute_is_refused() -> None:
    with pytest.raises(PipelineError, match=r"loop\.mode\.mass: found 1e-09.*leave the mode out"):
        Loop(0.5, 3.0, 0.001, 2, mode=MODE | {"mass": 1e-9})


@pytest.mark.parametrize("frequency", [1e-9, 1e-4])
def test_a_cost_that_is_rounding_has_a_reason(frequency: float) -> None:
    best = Loop(0.5, 3.0, 0.001, 2, mode=MODE | {"frequency_hz": frequency}).optimum("settle_2pct")
    assert best.cost is None
    assert "within 1e-12 of 1" in (best.reason or "")


@pytest.mark.parametrize("stiffness", [0.0, 1e4, 1e5, 2e5])
@pytest.mark.parametrize("parts", [{}, {"operator": {"mass": 3.0, "damping": 5.0}}], ids=["alone", "held"])
def test_overshoot_of_a_device_with_a_strong_spring(stiffness: float, parts: dict[str, Any]) -> None:
    loop = Loop(0.5, 3.0, 0.001, 2, stiffness=stiffness, **parts)
    best = loop.optimum("overshoot")
    assert best.cost == 0
    assert radius(loop, best.stiffness, best.damping) < 1
    motion = loop.response(best.stiffness, best.damping, 300)["position"].to_numpy()
    assert motion.max() * (best.stiffness + stiffness) < 1 + 1e-9
    assert motion[-1] * (best.stiffness + stiffness) == pytest.approx(1, abs=1e-6)
    assert (best.stiffness < 0) is ("negative" in (best.note or ""))


@pytest.mark.parametrize("stiffness", [1e6, 4e6])
def test_no_wall_without_overshoot_is_a_reason(stiffness: float) -> None:
    with pytest.raises(PipelineError, match="no point without overshoot"):
        Loop(0.5, 3.0, 0.001, 2, stiffness=stiffness).optimum("overshoot")


@pytest.mark.parametrize(
    "parts", [{"stiffness": 4e6}, {"operator": {"mass": 1.0, "stiffness": 2e5}}], ids=["spring", "hand"]
)
def test_an_optimum_with_a_negative_stiffness_says_so(parts: dict[str, Any]) -> None:
    best = Loop(0.5, 3.0, 0.001, 2, **parts).optimum("pole_radius")
    assert best.stiffness < 0
    assert "the stiffness is negative" in (best.note or "")


NO_WALL = {"mode": MODE | {"sensor": "load"}}


@pytest.mark.parametrize(
    "call",
    [
        lambda: Loop(0.5, 0.0, 0.001, 2, **NO_WALL).boundary(),
        lambda: Loop(0.5, 0.0, 0.001, 2, **NO_WALL).optimum("settle_2pct"),
        lambda: Loop(0.5, 0.0, 0.001, 2, **NO_WALL).map(5),
        lambda: design(Loop(0.5, 0.0, 0.001, 2, **NO_WALL), 1000.0),
        lambda: Loop(0.5, 3.0, 0.001, 2, stiffness=1e6).optimum("overshoot"),
        lambda: Loop(0.5, 3.0, 0.001, 2).margins(1e6, 1.0),
        lambda: Loop(0.5, 3.0, 0.001, 300),
        lambda: Loop(0.5, 3.0, 0.001, 2, actuator_lag_s=1e-12),
    ],
)
def test_no_error_prints_an_internal_object(call: Any) -> None:
    with pytest.raises(PipelineError) as error:
        call()
    assert not re.search(r"\w\(\w+=|<.* at 0x", str(error.value))
