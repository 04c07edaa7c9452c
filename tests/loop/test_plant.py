"""Plant motion against the matrix exponential in 50 digits, where the printed formula divides by zero or cancels."""

from __future__ import annotations

import math

import mpmath as mp
import numpy as np
import pytest
from independent import DIGITS, NYQUIST, flow_in_many_digits

from pipeline.base.errors import ParameterError
from pipeline.loop.loop import Loop
from pipeline.loop.plant import flow

GAMMA = [0.0, 1e-300, 1e-16, 1e-9, 1e-3, 0.2499, 0.2501, 1.0, 3.0, 9.8]
DELTA = [0.0, 1e-300, 1e-16, 1e-3, 0.2499, 0.2501, 2.0, 10.0, 39.0, 41.0, 100.0, 1e3]
RELATIVE = 1e-13
"""The requirement; rounding alone costs about 1e-14 at gamma = 9.8, where sin(pi - 0.01) cancels three digits."""


def check(gamma: float, delta: float, time: float) -> float:
    """Compare every entry; return the largest relative deviation."""
    got, exact = flow(gamma, delta, time), flow_in_many_digits(gamma, delta, time)
    entries = {
        "position by position": (got.transition[0, 0], exact[0, 0]),
        "position by velocity": (got.transition[0, 1], exact[0, 1]),
        "velocity by position": (got.transition[1, 0], exact[1, 0]),
        "position gain": (got.gain[0], exact[0, 2]),
        "velocity gain": (got.gain[1], exact[1, 2]),
    }
    largest = 0.0
    for name, (value, truth) in entries.items():
        assert abs(value - truth) <= RELATIVE * abs(truth) + 1e-320, (name, gamma, delta, time, value, truth)
        largest = max(largest, float(abs(value - truth) / abs(truth))) if abs(truth) > 1e-300 else largest
    # this entry alone passes through zero inside the range (gamma = delta = 2, say): relative to its two addends there
    scale = abs(exact[1, 1]) + abs(delta * exact[0, 1] / 2)
    assert abs(got.transition[1, 1] - exact[1, 1]) <= RELATIVE * scale, (gamma, delta, time)
    return max(largest, float(abs(got.transition[1, 1] - exact[1, 1]) / scale))


@pytest.mark.parametrize("gamma", GAMMA)
def test_every_entry_has_full_precision(gamma: float) -> None:
    for delta in DELTA:
        check(gamma, delta, 1.0)


def test_random_plants_and_times(record_property) -> None:
    rng = np.random.default_rng(12)
    gamma, delta = 10 ** rng.uniform(-16, 1, 300), 10 ** rng.uniform(-12, 3, 300)
    # only a plant below half a swing in the given time is asked for
    gamma = np.minimum(gamma, NYQUIST)
    time = np.where(rng.random(300) < 0.3, 1.0, rng.uniform(0, 1, 300))
    worst = max(check(*case) for case in zip(gamma.tolist(), delta.tolist(), time.tolist(), strict=True))
    record_property("random", 300)
    record_property("extreme", len(GAMMA) * len(DELTA))
    record_property("deviation", worst)


def split_cases() -> tuple[list[tuple[float, float, float]], int]:
    """300 random loops with fractional delays, then extreme ones: fractions next to 0 and 1, and the number of them."""
    rng = np.random.default_rng(13)
    random = zip(
        np.minimum(10 ** rng.uniform(-16, 1, 300), NYQUIST),
        10 ** rng.uniform(-12, 3, 300),
        rng.uniform(0, 9, 300),
        strict=True,
    )
    extreme = [
        (gamma, delta, delay)
        for gamma, delta in [(0.0, 0.0), (1e-16, 0.0), (NYQUIST, 0.0), (NYQUIST, 1e3), (0.25, 1.0), (0.25, 1 + 1e-9)]
        for delay in [2.0**-40, 1e-6, 0.5, 1 - 1e-6, 1 - 2.0**-40, 1 + 1e-3, 64.5, 255.25, 0.1, 15.9]
    ]
    return [tuple(float(v) for v in case) for case in random] + extreme, len(extreme)


def test_the_input_of_a_fractional_delay_is_split_exactly(record_property) -> None:
    cases, extremes = split_cases()
    worst = 0.0
    for gamma, delta, delay in cases:
        loop = Loop(gamma, delta, delay)
        matrix = loop.matrix(np.array([1.0]), np.array([0.0]))[0]
        with mp.workdps(DIGITS):
            fraction = mp.mpf(delay) - math.floor(delay)
            rate = mp.matrix([[0, 1, 0], [-mp.mpf(gamma), -mp.mpf(delta), 1], [0, 0, 0]])
            first, late = mp.expm(rate * fraction), mp.expm(rate * (1 - fraction))
            whole = math.floor(delay)
            # the older force, of sample k - d - 1, acts first; then that of sample k - d
            older = [late[i, 0] * first[0, 2] + late[i, 1] * first[1, 2] for i in (0, 1)]
            newer = [late[i, 2] for i in (0, 1)]
        # alpha = 1: the column of a position holds minus the gain of the force that it caused
        for row in (0, 1):
            pairs = [(matrix[row, whole + 3], older[row])]
            if whole:
                pairs.append((matrix[row, whole + 2], newer[row]))
            for got, exact in pairs:
                # the addends cancel after half a swing, where sin(pi - 1e-12) keeps four digits of its amplitude
                swing = 1 / math.pi if gamma > 9 and delta < 1 else float(abs(late[1, 1] * first[1, 2])) * row
                scale = float(abs(exact)) + swing
                deviation = float(abs(got - exact)) / scale
                assert deviation < RELATIVE, (gamma, delta, delay, row)
                worst = max(worst, deviation)
    record_property("random", len(cases) - extremes)
    record_property("extreme", extremes)
    record_property("deviation", worst)
    assert len(cases) - extremes >= 300
    assert extremes >= 60


@pytest.mark.parametrize("time", [1e-4, 0.37])
def test_parts_of_an_interval_have_full_precision(time: float) -> None:
    for gamma, delta in [(0.0, 0.0), (1e-12, 50.0), (0.3, 0.0), (9.8, 0.5), (0.2, 0.2), (5.0, 1e3)]:
        check(gamma, delta, time)


@pytest.mark.parametrize("gamma", [1e-14, 2.5e-13, 0.01, 0.26, 1.0, 9.0])
def test_near_critical_damping(gamma: float) -> None:
    for nearness in (0.0, 1e-15, -1e-15, 1e-9, -1e-9, 1e-5, -1e-5):
        check(gamma, 2 * math.sqrt(gamma) * (1 + nearness), 1.0)


def test_the_fast_mode_of_a_strongly_damped_plant_is_kept() -> None:
    got, exact = flow(0.0, 30.0, 1.0), flow_in_many_digits(0.0, 30.0, 1.0)
    assert got.transition[1, 1] == pytest.approx(
        float(exact[1, 1]), rel=RELATIVE, abs=0
    )  # exp(-30): no difference of ones


def test_an_array_of_times_gives_the_motion_of_each() -> None:
    times = np.array([0.0, 0.1, 0.7, 1.0])
    for gamma, delta in [(0.0, 0.0), (0.1, 0.05), (4.0, 1.0)]:
        together = flow(gamma, delta, times)
        assert together.transition.shape == (4, 2, 2)
        np.testing.assert_array_equal(together.transition[0], np.eye(2))
        np.testing.assert_array_equal(together.gain[0], [0.0, 0.0])
        for i, time in enumerate(times):
            single = flow(gamma, delta, float(time))
            np.testing.assert_allclose(together.transition[i], single.transition, rtol=1e-14, atol=0)
            np.testing.assert_allclose(together.gain[i], single.gain, rtol=1e-14, atol=0)


def test_two_halves_make_a_whole() -> None:
    rng = np.random.default_rng(11)
    for gamma, delta, share in rng.uniform([0, 0, 0], [9.8, 5, 1], (100, 3)):
        first, second, whole = flow(gamma, delta, share), flow(gamma, delta, 1 - share), flow(gamma, delta, 1.0)
        np.testing.assert_allclose(second.transition @ first.transition, whole.transition, rtol=0, atol=2e-14)
        np.testing.assert_allclose(second.transition @ first.gain + second.gain, whole.gain, rtol=0, atol=2e-14)


@pytest.mark.parametrize(
    ("gamma", "delta"), [(-1e-9, 0.0), (0.0, -1.0), (math.nan, 0.0), (0.0, math.nan), (math.inf, 0.0), (0.0, math.inf)]
)
def test_negative_or_infinite_parameters_are_refused(gamma: float, delta: float) -> None:
    with pytest.raises(ParameterError, match=r"gamma = .*delta = .*not negative"):
        flow(gamma, delta, 1.0)
