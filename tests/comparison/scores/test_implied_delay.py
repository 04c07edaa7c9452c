from __future__ import annotations

import numpy as np
import pytest

from pipeline.base.errors import ParameterError
from pipeline.comparison.scores.implied_delay import implied_delay
from pipeline.comparison.scores.implied_slope import DeviceParameters, implied_by_slope
from pipeline.loop.motion import Mechanism
from pipeline.records.findings import BoundaryPoint
from pipeline.simulation.radius import spectral_radius
from pipeline.simulation.setup import Setup

FALCON = DeviceParameters(mass=0.58, viscous_damping=4.0, sampling_period_s=1e-3)
FIRM = DeviceParameters(mass=1.0, viscous_damping=34.0, sampling_period_s=1e-3)
LWR = DeviceParameters(mass=0.19, viscous_damping=0.0, sampling_period_s=1e-3)


def limits(device, delay, damping):
    """Largest stable stiffness by bisection of the simulator's loop matrix, which shares no code with theory."""
    plant = Mechanism(device.mass, device.viscous_damping)
    setup = Setup(plant, device.sampling_period_s, 8.0, 100, 10, delay)
    low, high = np.zeros(len(damping)), np.full(len(damping), 4 * device.mass / device.sampling_period_s**2)
    for _ in range(50):
        middle = 0.5 * (low + high)
        stable = spectral_radius(plant, setup, middle, damping) < 1
        low, high = np.where(stable, middle, low), np.where(stable, high, middle)
    return low


def points(damping, limit, width=20.0, shift=None, censored=None):
    """Boundary with intervals of a width, their middles off by ``shift``."""
    shift = np.zeros(len(damping)) if shift is None else shift
    censored = np.zeros(len(damping), dtype=bool) if censored is None else censored
    found = []
    for B, k, off, end in zip(damping, limit, shift, censored, strict=True):
        known = {} if end else {"estimate": k + off, "high": k + off + 0.5 * width}
        found.append(
            BoundaryPoint(damping=B, stable=None, unstable=None, censored=end, low=k + off - 0.5 * width, **known)
        )
    return tuple(found)


def grid(device, delay, count=20):
    """Dampings from 0 to nearly the largest one that is stable with some stiffness."""
    largest = np.linspace(0, 2 * device.mass / device.sampling_period_s, 400)
    known = largest[
        limits(device, delay, largest) > 0.02 * device.mass / device.sampling_period_s**2 / (delay + 1) ** 2
    ]
    return np.linspace(0.0 if device.viscous_damping else 0.05 * known[-1], 0.95 * known[-1], count)


@pytest.mark.parametrize("device", [FALCON, FIRM, LWR], ids=["falcon", "firm", "lwr"])
@pytest.mark.parametrize("delay", [0.0, 0.5, 2.0, 3.3, 4.0])
def test_whole_boundary_gives_the_delay(device, delay):
    B = grid(device, delay)
    limit = limits(device, delay, B)
    found = implied_delay(points(B, limit, width=1e-3 * limit.max()), device)
    assert found.value == pytest.approx(delay, abs=0.01)  # interpolation of the table: 0.002 samples and less
    assert found.trials == 20
    assert found.warning is None


@pytest.mark.parametrize(
    ("device", "tolerance"),
    [(FALCON, 0.03), (LWR, 0.03), (FIRM, 0.05)],  # as the docstring says; the correction for b is of second order
    ids=["falcon", "lwr", "firm"],
)
@pytest.mark.parametrize("delay", [0.5, 2.0, 3.3, 4.0])
def test_slope_gives_the_delay(device, tolerance, delay):
    B = grid(device, delay, 40)
    limit = limits(device, delay, B)
    found = implied_by_slope(points(B, limit, width=1e-3 * limit.max()), device)
    assert found.value == pytest.approx(delay, abs=tolerance)
    assert found.trials >= 6
    assert "parabola" in found.method
    # the line through the origin ignores that the boundary bends
    assert found.by_method["line_through_origin"].value > found.value + 0.1


def test_slope_of_the_linear_condition_itself():
    # (3.25): K = (b + B)/t_r with a heavy device, for which it is exact
    B = np.linspace(0, 40, 21)
    heavy = DeviceParameters(mass=1e6, viscous_damping=4.0, sampling_period_s=1e-3)
    found = implied_by_slope(points(B, (B + 4.0) / 4.5e-3), heavy)
    assert found.value == pytest.approx(4.0, abs=1e-6)
    assert found.by_method["line_through_origin"].value == pytest.approx(4.0, abs=1e-9)


@pytest.mark.parametrize("method", ["whole", "slope"])
def test_interval_covers_with_noisy_limits(method):
    random = np.random.default_rng(5)
    B = np.arange(0, 184, 4.0)
    limit = limits(FALCON, 3.3, B)
    inside, off = [], []
    for _ in range(40):
        noisy = points(B, limit, width=400.0, shift=random.uniform(-200, 200, len(B)))
        found = implied_delay(noisy, FALCON) if method == "whole" else implied_by_slope(noisy, FALCON)
        inside.append(found.low <= 3.3 <= found.high)
        off.append(abs(found.value - 3.3))
    # 95 %; 40 repetitions scatter by 3.4 %
    assert np.mean(inside) > 0.84
    assert np.median(off) > 1e-3
    if method == "whole":
        assert max(off) < 0.05


def test_errors_of_mass_and_damping_widen_the_interval():
    B = np.arange(0, 184, 4.0)
    boundary = points(B, limits(FALCON, 4.0, B))
    sure = implied_delay(boundary, FALCON)
    unsure = implied_delay(boundary, DeviceParameters(0.58, 4.0, 1e-3, mass_error=0.0116, damping_error=0.0))
    wrong = implied_delay(boundary, DeviceParameters(0.58 * 1.02, 4.0, 1e-3))
    half = 0.5 * (unsure.high - unsure.low)
    assert 0.5 * (sure.high - sure.low) < 0.01
    # a mass that is wrong by one standard error moves the delay by one standard error
    assert half == pytest.approx(1.96 * abs(wrong.value - sure.value), rel=0.05)
    slope = implied_by_slope(boundary, FALCON)
    less = implied_by_slope(boundary, DeviceParameters(0.58, 4.0, 1e-3, damping_error=0.5))
    assert less.high - less.low > 2 * (slope.high - slope.low)


def test_a_boundary_of_two_delays_is_told():
    # as the thesis saw it: near the origin that of d = 3, as a whole between those of 3 and 5 (6.1.3)
    B = np.arange(0, 150, 4.0)
    limit = limits(FALCON, 3.0, B)
    slow = B > 60
    limit[slow] = limits(FALCON, 4.5, B[slow])
    found = implied_delay(points(B, limit), FALCON)
    assert 3.0 < found.value < 4.5
    assert "no single delay explains the boundary" in found.warning
    assert "imply 3.00 to 4.50 samples" in found.warning
    near = found.by_method["slope_near_origin"]
    assert near.value == pytest.approx(3.0, abs=0.1)
    assert found.high - found.low > 0.2


def test_censored_limits_are_lower_bounds():
    B = np.arange(0, 184, 4.0)
    limit = limits(FALCON, 4.0, B)
    ended = limit > 8000
    below = points(B, np.minimum(limit, 8000.0), censored=ended)
    assert implied_delay(below, FALCON).value == pytest.approx(4.0, abs=0.01)
    # a bound above the limit of theory does count
    above = points(B, np.where(ended, 1.3 * limit, limit), censored=ended)
    found = implied_delay(above, FALCON)
    assert found.value < 3.97  # the limits at large damping hold it near 4: they change most with the delay
    assert "no single delay" in found.warning
    nothing = implied_delay(points(B, limit, censored=np.ones(len(B), dtype=bool)), FALCON)
    assert nothing.value is None
    assert "0 dampings with a limit" in nothing.reason
    assert nothing.by_method["slope_near_origin"].value is None


def test_too_few_points():
    B = np.array([0.0, 100.0, 120.0, 140.0])
    found = implied_delay(points(B, limits(FALCON, 4.0, B)), FALCON)
    assert found.value == pytest.approx(4.0, abs=0.01)
    assert "1 limit of stability" in found.by_method["slope_near_origin"].reason
    assert implied_delay((), FALCON).value is None


def test_wrong_device():
    B = np.arange(0, 100, 20.0)
    with pytest.raises(ParameterError, match="mass"):
        implied_delay(points(B, limits(FALCON, 4.0, B)), DeviceParameters(-1.0, 4.0, 1e-3))


def test_stiffer_than_theory_without_delay():
    B = np.arange(0, 100, 20.0)
    stiff = points(B, 20 * limits(FALCON, 0.0, B))
    found = implied_delay(stiff, FALCON)
    assert found.value == 0.0
    assert "5 of 5 limits lie above theory even without delay" in found.warning


def test_a_delay_below_none_is_no_delay():
    # twice the slope that a device without delay has
    B = np.linspace(0, 40, 21)
    found = implied_by_slope(points(B, (B + 4.0) / 0.25e-3), FALCON)
    for estimate in (found, found.by_method["line_through_origin"]):
        assert estimate.value is None
        assert "steeper than without any delay" in estimate.reason


def test_limits_that_the_sensor_shifts_alike_leave_the_delay_of_an_ideal_loop_in_the_interval():
    B = np.arange(0, 184, 4.0)
    limit = limits(FALCON, 3.0, B)
    # by 0.3 % of each: 2.994 +- 0.004 was said to show that something beside delay acts
    found = implied_delay(points(B, 1.003 * limit, width=20.0), FALCON)
    assert found.low <= 3.0 <= found.high
