"""Limits of general loops against poles in many digits, by another road (`general_devices`)."""

from dataclasses import replace
from decimal import Decimal

import mpmath as mp
import numpy as np
import pytest
from general_devices import EXTREMES, ManyDigits, random_device
from general_loop import general_loop

from pipeline.base.errors import ParameterError
from pipeline.device.loop import Loop
from pipeline.device.parts import Coefficients, Difference
from pipeline.loop.many_digits import as_exact, many_digits, product
from pipeline.loop.normalised_loop import LoopUnits, NormalisedLoop
from pipeline.theory import crossings
from pipeline.theory.boundary import boundary, is_inside, limits, outline
from pipeline.theory.crossings import branches, positive_roots, right_half, turning_dampings
from pipeline.theory.poles import spectral_radius


@pytest.fixture(autouse=True)
def many():
    with mp.workdps(60):
        yield


def checked(example: Loop, rng: np.random.Generator) -> int:
    """Hold the limit at a random damping; returns whether there was one."""
    loop, units = (NormalisedLoop.of(example), LoopUnits.of(example))
    found = outline(loop, 8)
    if not len(found.beta):
        return 0
    beta = found.beta[0] + (found.beta[-1] - found.beta[0]) * rng.uniform(0.05, 0.95)
    alpha = limits(loop, np.array([beta])).alpha[0]
    if not np.isfinite(alpha):
        return 0
    truth, K, B = ManyDigits(example), float(alpha * units.stiffness), float(beta * units.damping)
    assert [truth.stable(K * (1 + side * 1e-9), B) for side in (-1, 1)] == [True, False], (example, K, B)
    return 1


@pytest.mark.slow
def test_limits_of_random_devices_are_right_to_1e_9():
    rng = np.random.default_rng(17)
    assert sum(checked(random_device(rng), rng) for _ in range(300)) > 250
    assert sum(checked(random_device(rng, extreme), rng) for extreme in EXTREMES for _ in range(10)) > 40


@pytest.mark.parametrize("extreme", EXTREMES)
def test_limits_of_extreme_devices_are_right_to_1e_9(extreme):
    rng = np.random.default_rng(len(extreme))
    assert checked(random_device(rng, extreme), rng) + checked(random_device(rng, extreme), rng) > 0


@pytest.mark.slow
def test_stable_stretches_are_those_of_the_poles():
    """Verdicts over the plane, islands included, against eigenvalues."""
    rng, islands = np.random.default_rng(3), 0
    for _ in range(40):
        loop = NormalisedLoop.of(random_device(rng))
        found = outline(loop, 8)
        top = found.alpha_max if len(found.beta) else 0.1
        islands += len(found.islands) > 0
        low, high = (found.beta[0], found.beta[-1]) if len(found.beta) else (-0.1, 0.5)
        alpha = rng.uniform(0, 1.5 * top, 200)
        beta = rng.choice(rng.uniform(low - 0.1 * (high - low), high + 0.1 * (high - low), 20), 200)
        radius = spectral_radius(loop, alpha, beta)
        clear = np.abs(radius - 1) > 1e-9
        assert np.array_equal(is_inside(loop, alpha, beta)[clear], (radius < 1)[clear])
    assert islands > 0


@pytest.mark.parametrize(
    ("gamma", "delta", "delay"), [(0, 0.01, 2.0), (1e-3, 0.05, 3.4), (0, 0, 0.6), (0.02, 0.3, 0.0)]
)
def test_general_loop_equals_the_ideal_one(gamma, delta, delay):
    """By the angle along the one branch, and by dampings."""
    loop = NormalisedLoop.ideal(gamma, delta, delay)
    border, found = boundary(loop), outline(loop)
    assert found.alpha_max == pytest.approx(border.alpha_max, rel=1e-10)
    assert found.beta_at_alpha_max == pytest.approx(border.beta_at_alpha_max, rel=1e-6)


def test_gain_and_operator_leave_the_loop_ideal():
    operator = {"mass": 0.15, "damping": 5.0, "stiffness": 300.0}
    device = Loop(0.5, 3.0, 1e-3, 2.0, 10.0, force_gain=0.8, operator=operator)
    loop, units = NormalisedLoop.of(device), LoopUnits.of(device)
    assert units.mass == pytest.approx(0.65 / 0.8)
    assert (loop.gamma, loop.delta) == pytest.approx((310 * 1e-6 / 0.65, 8 * 1e-3 / 0.65))


def test_a_loop_that_nothing_stabilises_has_an_empty_outline():
    of_change = Coefficients(kind="coefficients", b=(1.0, -1.0), a=(1.0,))  # no damping at low frequencies
    found = outline(general_loop(0.0, 0.0, 5.0, lag=3.0, velocity=of_change))
    assert len(found.beta) == 0
    assert np.isnan(found.alpha_max)


@pytest.mark.parametrize(
    "arguments",
    [
        {"lag": -1.0},
        {"velocity": Difference(kind="difference", samples=98)},
        {"delay": 257.0},
        {"lag": 1e-9},
        {"delta": np.nan},
    ],
)
def test_loops_out_of_range_are_refused(arguments):
    with pytest.raises(ParameterError, match="expected"):
        general_loop(**{"gamma": 0.0, "delta": 0.01, "delay": 2.0, **arguments})


def test_all_positive_roots_are_found():
    """Close, tiny, huge roots and those at halves of the intervals, among complex and negative ones."""
    wanted = ["1e-20", "0.1716", "0.1716000001", "0.5", "1", "3", "7e15"]
    with many_digits(150):
        factors = [np.array([-Decimal(root), Decimal(1)], dtype=object) for root in wanted]
        polynomial = product(*factors, as_exact([5, 1]), as_exact([2, 1, 1]), as_exact([4.01, -4, 1]))
        found = positive_roots(polynomial, 150)
    np.testing.assert_allclose(found.value, [float(r) for r in wanted], rtol=1e-13)
    assert set(found.multiplicity) == {1}


def test_repeated_roots_are_one_each():
    """Also where rounding has split or lifted them."""
    with many_digits(100):
        simple, double, lifted = as_exact([-7, 1]), as_exact([-1, 1]), as_exact([9 + Decimal("1e-60"), -6, 1])
        split = product(as_exact([-2, 1]), as_exact([-2 - Decimal("1e-15"), 1]), as_exact([-2, 1]))
        found = positive_roots(product(simple, double, double, lifted, split), 100)
    np.testing.assert_allclose(found.value, [1, 2, 3, 7], rtol=1e-13)
    assert found.multiplicity.tolist() == [2, 3, 2, 1]
    assert found.passed == found.value[1::2].tolist()


def test_right_half_counts_roots():
    with many_digits(60):
        assert right_half(product(as_exact([-1, 1]), as_exact([2, 1]), as_exact([5, -2, 1]))) == 3
        assert right_half(product(as_exact([1, 1]), as_exact([5, 2, 1]))) == 0


DEVICES = [replace(NormalisedLoop.of(random_device(np.random.default_rng(seed))), delay=7.3) for seed in range(6)]


@pytest.mark.parametrize(
    "loop", [*DEVICES, NormalisedLoop.ideal(0.0, 0.0, 4), NormalisedLoop.ideal(0.5, 0.01, 20.5)], ids=str
)
def test_doubles_isolate_the_roots_that_integers_do(loop, monkeypatch):
    """Integers alone, which know no rounding, find the same crossings and turns."""
    caches = [
        getattr(crossings, name)
        for name in ("circle_condition", "branches", "stiffness_turns", "level_passings", "turning_dampings")
    ]

    def found():
        for cache in caches:
            cache.cache_clear()
        return branches(loop).cells, turning_dampings(loop)

    (*cells, gain), turns = found()
    monkeypatch.setattr(crossings, "_isolated", lambda *_: None)
    (*exact_cells, exact_gain), exact_turns = found()
    np.testing.assert_array_equal(gain, exact_gain)
    for ours, exact in zip([*cells, turns], [*exact_cells, exact_turns], strict=True):
        np.testing.assert_allclose(ours, exact, rtol=1e-9, atol=1e-12)


def test_coefficients_that_doubles_cannot_decide_are_decided_by_integers(monkeypatch):
    """Roots that differ by 1e-9 behind a cloud of complex ones: no bound of rounding leaves a sign."""
    decided = []
    isolated = crossings._isolated
    monkeypatch.setattr(
        crossings, "_isolated", lambda *given: decided.append(isolated(*given) is not None) or isolated(*given)
    )
    with many_digits(200):
        factors = [as_exact([-Decimal(root), Decimal(1)]) for root in ("0.3", "0.3000000001", "0.30000000021")]
        cloud = [as_exact([Decimal(9) / 100 + Decimal(k) / 10**6, Decimal(-3) / 5, Decimal(1)]) for k in range(1, 12)]
        found = positive_roots(product(*factors, *cloud), 200)
    np.testing.assert_allclose(found.value, [0.3, 0.3000000001, 0.30000000021], rtol=1e-13)
    assert False in decided


@pytest.mark.parametrize(("samples", "delay", "gamma"), [(5, 2.0, 2e-4), (4, 1.5, 0.0), (9, 4.0, 2e-4), (3, 19.0, 0.0)])
def test_a_filter_may_hide_a_motion_that_the_delay_turns_by_half_a_circle(samples, delay, gamma):
    """Each damping then has a crossing at one angle: a device without damping, delay + 1/2 such angles half turns."""
    loop = general_loop(gamma=gamma, delta=0.0, delay=delay, velocity=Difference(kind="difference", samples=samples))
    found = outline(loop, 24)
    beta = np.linspace(0.02, 1.3, 24) * found.ends[1]
    level = limits(loop, beta).alpha
    known = np.isfinite(level)
    assert known.any()
    assert not known[-1]
    for factor, stable in ((0.01, True), (1 - 1e-6, True), (1 + 1e-6, False)):
        poles = np.linalg.eigvals(loop.matrix(level[known] * factor, beta[known]))
        assert ((np.abs(poles).max(axis=1) < 1) == stable).all(), factor
    soft = loop.matrix(np.full(24, 1e-3 * found.alpha_max), beta)[~known]
    assert (np.abs(np.linalg.eigvals(soft)).max(axis=1) > 1).all()


@pytest.mark.parametrize(
    ("samples", "times", "delay", "delta", "pole"),
    [
        (4, 2, 2.0, 0.005, 0.0),  # a double zero
        (3, 3, 2.0, 0.0005, 0.0),  # a triple one
        (4, 2, 2.0, 0.0, 0.0),  # and the delay hides the same motion
        (4, 3, 3.5, 0.0, 0.0),
        (4, 2, 3.7, 0.0, 0.273),  # split by rounding, 1e-16
        (4, 2, 3.7, 0.005, 0.5176916288587802),
        (5, 4, 48.5, 0.005, 0.687),
    ],
)
def test_a_filter_may_have_repeated_zeros_on_the_circle(samples, times, delay, delta, pole):
    mean = np.array([1 - pole])
    for _ in range(times):
        mean = np.convolve(mean, np.full(samples, 1 / samples))
    loop = general_loop(
        0.0, delta, delay, velocity=Coefficients(kind="coefficients", b=tuple(mean.tolist()), a=(1.0, -pole))
    )
    beta = np.linspace(0.05, 0.95, 7) * outline(loop, 24).ends[1]
    alpha = limits(loop, beta).alpha
    for factor, stable in ((0.5, True), (1 - 1e-6, True), (1 + 1e-6, False)):
        poles = np.linalg.eigvals(loop.matrix(factor * alpha, beta))
        assert ((np.abs(poles).max(axis=1) < 1) == stable).all()
