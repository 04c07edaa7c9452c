"""The loop's matrices against an independent loop that is stepped through time, integer and fractional delays alike."""

from __future__ import annotations

import math

import numpy as np
import pytest
from independent import deviation, extreme_cases, random_loops, simulate_many, stable_walls

from pipeline.base.errors import ParameterError
from pipeline.loop.normalised_loop import LARGEST_DELAY, LoopUnits, NormalisedLoop, as_points
from pipeline.theory.motion import response

RANDOM = stable_walls(random_loops(100, seed=5), each=3, seed=6)
EXTREME = extreme_cases()


def trajectory(loop: NormalisedLoop, alpha: float, beta: float, signal: str, samples: int) -> np.ndarray:
    matrix = loop.matrix(np.array([alpha]), np.array([beta]))[0]
    z, out = loop.starts(np.array([alpha]), signal)[0], []
    for _ in range(samples + 1):
        out.append(z[:2].copy())
        z = matrix @ z
    return np.array(out)


@pytest.mark.parametrize("signal", ["step", "impulse"])
def test_samples_are_those_of_a_loop_stepped_through_time(signal: str) -> None:
    cases = RANDOM + EXTREME
    # long delays are stepped until the wall has answered the answer to its own force
    samples = [40 + 2 * math.ceil(case[2] / case[3]) for case in cases]
    motions = simulate_many(cases, samples, signal, fine=1)
    for case, count, motion in zip(cases, samples, motions, strict=True):
        gamma, delta, p, q, alpha, beta = case
        e = deviation(motion, alpha + gamma) if signal == "step" else motion.x
        v = motion.v * (alpha + gamma) if signal == "step" else motion.v
        truth = np.stack([e, v], axis=1)[:: motion.every]
        got = trajectory(NormalisedLoop.ideal(gamma, delta, p / q), alpha, beta, signal, count)
        # rounding of 1e-16 a step, times delta where the velocity is a difference of forces
        np.testing.assert_allclose(got, truth, rtol=0, atol=1e-11, err_msg=str(case))
    assert len(RANDOM) >= 300
    assert len(EXTREME) >= 60
    for some in (RANDOM, EXTREME):
        assert sum(case[2] % case[3] != 0 for case in some) >= len(some) // 4  # fractional delays


@pytest.mark.slow
def test_positions_between_samples_are_those_of_a_loop_stepped_through_time() -> None:
    cases = RANDOM + EXTREME
    for signal in ("step", "impulse"):
        motions = simulate_many(cases, [24] * len(cases), signal, fine=6)
        for case, motion in zip(cases, motions, strict=True):
            gamma, delta, p, q, alpha, beta = case
            found = response(
                NormalisedLoop.ideal(gamma, delta, p / q), alpha, beta, signal, 24, per_sample=motion.every
            )
            scale = 1 / (alpha + gamma) if signal == "step" else np.abs(motion.x).max()
            difference = float(np.abs(found - motion.x).max() / scale)
            assert difference < 1e-11, case


def test_an_integer_delay_is_the_limit_of_fractional_ones() -> None:
    exact = trajectory(NormalisedLoop.ideal(0.001, 0.02, 2), 0.02, 0.2, "step", 30)
    for near in (2 - 1e-9, 2 + 1e-9):
        np.testing.assert_allclose(
            trajectory(NormalisedLoop.ideal(0.001, 0.02, near), 0.02, 0.2, "step", 30), exact, atol=1e-8
        )
    assert np.abs(trajectory(NormalisedLoop.ideal(0.001, 0.02, 2.3), 0.02, 0.2, "step", 30) - exact).max() > 1e-2


def test_size_of_the_state() -> None:
    assert NormalisedLoop.ideal(0, 0, 3).states == 6  # d + 3, eq. 3.18
    assert NormalisedLoop.ideal(0, 0, 2.5).states == 6  # the older of two forces is three samples old


@pytest.mark.parametrize(
    ("values", "what"),
    [
        ((-1e-12, 0.0, 0.0), "gamma"),
        ((0.0, -0.1, 0.0), "delta"),
        ((0.0, 0.0, -1.0), "delay"),
        ((math.nan, 0.0, 0.0), "gamma"),
        ((0.0, math.nan, 0.0), "delta"),
        ((0.0, 0.0, math.nan), "delay"),
        ((0.0, 0.0, math.inf), "delay"),
        ((0.0, 0.0, LARGEST_DELAY + 0.5), "at most 256"),
        ((0.0, 1e300, 0.0), r"delta = 1e\+300: expected at most 1e\+07"),
        ((math.pi**2 * (1 + 1e-12), 0.0, 0.0), r"\(4.15\)"),
        ((math.pi**2 + 1.01, 2.0, 0.0), r"\(4.15\)"),
    ],
)
def test_parameters_out_of_range_are_named(values: tuple[float, float, float], what: str) -> None:
    with pytest.raises(ParameterError, match=what):
        NormalisedLoop.ideal(*values)


def test_extreme_parameters_are_accepted() -> None:
    for values in [(math.pi**2, 0.0, 0.0), (math.pi**2 + 25, 10.0, 64.0), (5e-324, 0.0, 256.0), (0.0, 1e7, 2.0)]:
        assert np.isfinite(NormalisedLoop.ideal(*values).matrix(np.array([0.1]), np.array([0.1]))).all()


@pytest.mark.parametrize("mass", [0.0, -1.0, math.nan, math.inf])
def test_units_need_positive_mass_and_period(mass: float) -> None:
    with pytest.raises(ParameterError, match="mass"):
        LoopUnits(mass, 1e-3)
    with pytest.raises(ParameterError, match="sampling_period_s"):
        LoopUnits(1.0, mass)


@pytest.mark.parametrize("signal", ["ramp", "", "Step"])
def test_unknown_signals_are_refused(signal: str) -> None:
    with pytest.raises(ParameterError, match="expected 'step' or 'impulse'"):
        NormalisedLoop.ideal(0, 0, 0).starts(np.ones(1), signal)


def test_points_must_be_finite_lists() -> None:
    with pytest.raises(ParameterError, match="finite"):
        as_points([0.1, math.nan], [0.1, 0.2])
    with pytest.raises(ParameterError, match="finite"):
        as_points([0.1], [math.inf])
    with pytest.raises(ParameterError, match="dimensions"):
        as_points(np.zeros((2, 2)), np.zeros((2, 2)))
