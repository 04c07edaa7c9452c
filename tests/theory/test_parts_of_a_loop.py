"""Every part of a loop counts in every output: against a state matrix by matrix exponentials (`state_matrix`)."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from state_matrix import largest_stable, radius

from pipeline import Loop, PipelineError, design, published_limits
from pipeline.surface.physical_loop import LoopOptimum

IDEAL = Loop(0.5, 3.0, 0.001, 2)
HAND = {"mass": 0.1, "damping": 9.0, "stiffness": 50.0}
MODE = {"frequency_hz": 60.0, "damping_ratio": 0.02, "mass": 0.15, "load_damping": 1.0}
PARTS: dict[str, dict[str, Any]] = {
    "gain below 1": {"force_gain": 0.4},
    "gain above 1": {"force_gain": 2.0},
    "hand": {"operator": HAND},
    "heavy hand": {"operator": {"mass": 5.0}},
    "lag": {"actuator_lag_s": 0.002},
    "mode at the motor": {"mode": MODE | {"sensor": "motor"}},
    "mode at the load": {"mode": MODE | {"sensor": "load"}},
    "filter": {"velocity": {"kind": "butterworth", "order": 2, "cutoff_hz": 80.0}},
    "window": {"velocity": {"kind": "difference", "samples": 4}},
    "spring": {"stiffness": 400.0},
    "fractional delay": {"delay_samples": 2.4},
    "gain, hand, lag and mode": {
        "force_gain": 2.0,
        "operator": HAND,
        "actuator_lag_s": 0.001,
        "delay_samples": 1.3,
        "mode": MODE | {"sensor": "motor"},
    },
    "gain, filter, spring and mode": {
        "force_gain": 0.4,
        "stiffness": 100.0,
        "mode": MODE | {"sensor": "load"},
        "velocity": {"kind": "butterworth", "order": 1, "cutoff_hz": 120.0},
    },
}


@pytest.fixture(params=PARTS)
def loop(request: pytest.FixtureRequest) -> Loop:
    return replace(IDEAL, **PARTS[request.param])


def clear(loop: Loop, stiffness: float, damping: float) -> bool:
    """Return whether a wall and softer ones are stable."""
    return all(radius(loop, share * stiffness, damping) < 1 + 1e-9 for share in np.linspace(0.02, 1, 40))


def test_limits_and_points_are_those_of_the_state_matrix(loop: Loop) -> None:
    top = loop.boundary(24).attrs
    for share in (0.2, 0.6):
        B = share * top["damping_at_stiffness_max"]
        found, other = loop.limits(B)["stiffness"][0], largest_stable(loop, B, 2 * top["stiffness_max"], looks=60)
        assert found == pytest.approx(other, rel=1e-8) if other else np.isnan(found)
        K = 0.3 * top["stiffness_max"]
        assert loop.points(K, B, ())["spectral_radius"][0] == pytest.approx(radius(loop, K, B), abs=1e-9)


def test_the_stiffest_wall_is_that_of_the_state_matrix(loop: Loop) -> None:
    top = loop.boundary(24).attrs
    K, B = top["stiffness_max"], top["damping_at_stiffness_max"]
    assert clear(loop, 0.9999 * K, B)
    assert radius(loop, 1.001 * K, B) > 1


def test_passive_walls_are_stable_with_hands_that_take_no_energy(loop: Loop) -> None:
    if loop.mode and loop.mode.sensor == "load":
        with pytest.raises(PipelineError, match="no wall is passive"):
            loop.passive()
        return
    attrs = loop.passive().attrs
    K, B = attrs["stiffness_max"], attrs["damping_at_stiffness_max"]
    alone = replace(loop, operator=None)
    hands = [None, *({"mass": m, "damping": 0.0, "stiffness": k} for m, k in product((0.1, 10.0), (0.0, 1e3, 1e5)))]
    assert K > 0
    assert all(radius(replace(alone, operator=hand), K, B) < 1 for hand in hands)


@pytest.mark.parametrize("gain", [0.25, 0.4, 0.5, 2.0, 7.0])
def test_a_gain_is_a_lighter_device(gain: float) -> None:
    device = {"stiffness": 200.0, "operator": HAND, "mode": MODE}
    lighter = {
        "stiffness": 200.0 / gain,
        "operator": {name: value / gain for name, value in HAND.items()},
        "mode": MODE | {name: MODE[name] / gain for name in ("mass", "load_damping")},
    }
    for with_gain, other in (
        (replace(IDEAL, force_gain=gain), Loop(0.5 / gain, 3 / gain, 0.001, 2)),
        (replace(IDEAL, force_gain=gain, **device), Loop(0.5 / gain, 3 / gain, 0.001, 2, **lighter)),
    ):
        for name in ("stiffness_max", "damping_at_stiffness_max"):
            assert with_gain.passive().attrs[name] == pytest.approx(other.passive().attrs[name], rel=1e-9)
        rows = [
            published_limits(each, [0.0, 1.0], coulomb=f, quantum=1e-5)
            for each, f in ((with_gain, 1), (other, 1 / gain))
        ]
        assert rows[0]["stiffness"].to_numpy() == pytest.approx(rows[1]["stiffness"].to_numpy(), rel=1e-9, nan_ok=True)
        wall = [design(each, 2000.0 / gain).wall["stiffness_limit"] for each in (with_gain, other)]
        assert wall[0] == pytest.approx(wall[1], rel=1e-9)


def test_published_limits_take_damping_per_command_without_that_of_a_load() -> None:
    device = Loop(0.5, 3.0, 0.001, 1, force_gain=2.0, mode=MODE | {"sensor": "motor"})
    rows = published_limits(device, [0.0], coulomb=1.0, quantum=1e-3).set_index("condition")["stiffness"]
    assert rows["Colgate and Schenkel 1997"] == pytest.approx(2 * (3.0 - 1.0) / 2 / 0.001)
    assert rows["Hulin et al. 2014"] == pytest.approx((3.0 - 1.0) / 2 / 0.0015)
    assert rows["Minsky et al. 1990"] == pytest.approx(3.0 / 2 / 0.0015)
    assert rows["Abbott and Okamura 2005, Diolaiti et al. 2006"] == pytest.approx(2 * 1.0 / 2 / 1e-3)
    beyond = published_limits(replace(device, mode=MODE | {"sensor": "load"}), [0.0])
    assert beyond.loc[beyond["promises"] == "passivity", "stiffness"].isna().all()
    held = Loop(0.5, 3.0, 0.001, 1, operator={"mass": 5.0})
    heavy = published_limits(held, [100.0]).set_index("condition")["stiffness"]
    assert heavy["Salcudean and Vlaar 1997"] == pytest.approx(65318, rel=1e-4)
    assert published_limits(held, [0.0]).set_index("condition")["stiffness"]["Hulin et al. 2014"] == pytest.approx(
        2000.0
    )


def test_a_tuning_is_stable_or_says_so(loop: Loop) -> None:
    rule = loop.optimum("ziegler_nichols")
    stable = radius(loop, rule.stiffness, rule.damping) < 1
    assert stable is not ("unstable here: spectral radius" in (rule.note or ""))


@pytest.mark.parametrize("name", ["gain above 1", "heavy hand", "lag", "mode at the motor", "spring"])
def test_an_optimum_is_stable(name: str) -> None:
    loop = replace(IDEAL, **PARTS[name])
    best = loop.optimum("energy_step_w0")
    assert best.reason is None
    assert clear(loop, best.stiffness, best.damping)


@pytest.mark.parametrize(
    "parts",
    [
        {"velocity": {"kind": "butterworth", "order": 1, "cutoff_hz": 5.0}},
        {"actuator_lag_s": 0.2},
        {"stiffness": 2e5},
    ],
    ids=["filter", "lag", "spring"],
)
def test_an_unstable_tuning_says_so(parts: dict[str, Any]) -> None:
    device = replace(IDEAL, **parts)
    rule: LoopOptimum = device.optimum("ziegler_nichols")
    assert radius(device, rule.stiffness, rule.damping) > 1
    assert rule.note is not None
    assert "unstable here" in rule.note
    assert IDEAL.optimum("ziegler_nichols").note is None


def test_a_design_is_reached_only_where_softer_walls_are_stable(loop: Loop) -> None:
    most = loop.boundary(24).attrs["stiffness_max"]
    for share in (0.3, 0.8):
        answer = design(loop, share * most, keep=("mass", "damping", "delay_samples", "actuator_lag_s"))
        wall = answer.wall
        assert answer.reached is (wall["stiffness_limit"] is not None and wall["stiffness_limit"] >= share * most)
        if answer.reached:
            assert clear(loop, share * most, wall["damping"] or 0.0)
        for change in answer.changes:
            assert (change.wall["stiffness_limit"] or 0.0) >= share * most * (1 - 1e-9)


@pytest.mark.parametrize(("stiffness", "reached"), [(3000.0, True), (6600.0, True), (6900.0, True), (7100.0, False)])
def test_an_island_reaches_no_design(stiffness: float, reached: bool) -> None:
    rig = replace(IDEAL, mode={"frequency_hz": 60.0, "damping_ratio": 0.02, "mass": 0.15, "sensor": "load"})
    assert radius(rig, 7100.0, 24.0) < 1 < radius(rig, 500.0, 24.0)
    answer = design(rig, stiffness, keep=("mass", "damping", "delay_samples", "sampling_period_s"))
    assert answer.reached is reached
    assert clear(rig, answer.wall["stiffness"] or 0.0, answer.wall["damping"] or 0.0)


ABSURD = (1e-300, 1e300, 10**400)


@pytest.mark.parametrize("name", ["mass", "damping", "stiffness", "sampling_period_s", "delay_samples", "force_gain"])
@pytest.mark.parametrize("value", ABSURD, ids=lambda value: f"{len(str(value))} digits of {str(value)[:6]}")
def test_absurd_parameters_are_an_answer_or_an_error(name: str, value: float) -> None:
    parameters = {"mass": 0.5, "damping": 3.0, "sampling_period_s": 0.001, "delay_samples": 2.0} | {name: value}
    if value == 1e-300 and name in ("damping", "stiffness", "delay_samples"):
        assert np.isfinite(Loop(**parameters).boundary(12).attrs["stiffness_max"])
        return
    with pytest.raises(PipelineError, match=r"expected|must be|should be"):
        Loop(**parameters)


def test_absurd_walls_are_an_error_and_have_no_limit() -> None:
    assert np.isnan(IDEAL.limits([1e300, -1e300])["stiffness"]).all()
    with pytest.raises(PipelineError, match="stiffness: expected at most"):
        IDEAL.points(1e300, 0.0)
    with pytest.raises(PipelineError, match="damping: expected at most"):
        IDEAL.points(0.0, -1e300)
    for wall in ((1e300, 0.0), (0.0, -1e300), (1e6, 1e6)):
        with pytest.raises(PipelineError, match=r"this wall is unstable: its motion overflows after \d+ samples"):
            IDEAL.response(*wall, 600)
        with pytest.raises(PipelineError, match="unstable"):
            IDEAL.margins(*wall)
