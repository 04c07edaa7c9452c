"""The passive wall that may be named: held against loops over its whole range, and never above a measured limit."""

from __future__ import annotations

from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.comparison.loops.loop_basis import LoopBasis
from pipeline.comparison.loops.passive_wall import passive_wall
from pipeline.device.loop import Loop
from pipeline.measured.experiment.identified_loop import IdentifiedLoop
from pipeline.measured.student import NORMAL_95
from pipeline.planning.loop_limits import linear_limits
from pipeline.records.findings import BoundaryPoint
from pipeline.simulation.radius import spectral_radius
from pipeline.simulation.setup import Setup

T = 1e-3
MOTOR, FALCON = (1.2e-4, 7e-5), (0.58, 4.0)  # a small device, whose B of two decimals would be none


def loop(device, delay, share, error=0.0, of_mode=None):
    """A loop whose mass, damping and delay may be off by a share, the delay by ten shares of a sample."""
    values = dict(zip(("mass", "damping", "delay_samples"), (*device, delay), strict=True))
    values |= of_mode or {}
    shares = [device[0] * share, device[1] * share, 10 * share, *(0.0 for _ in of_mode or {})]
    covariance = np.diag(np.square(shares) / NORMAL_95**2)
    return LoopBasis(IdentifiedLoop(values, covariance, T), error=error)


def measured(limit=1e9, trials=20):
    """A course with limits measured at two dampings, far above any passive wall where no other is given."""
    bracket = {"stable": limit, "unstable": limit + 2, "low": limit, "high": limit + 2, "estimate": limit + 1}
    points = tuple(BoundaryPoint(damping=B, censored=False, **bracket) for B in (0.0, 40.0))
    return SimpleNamespace(boundary=points, trials=trials)


def needed_damping(stiffness, damping, delay):
    """b that passivity needs at the frequencies up to Nyquist, from the folded sums themselves (integer or not)."""
    omega = np.linspace(1e-3, 1, 400) * np.pi / T
    waves = omega + 2 * np.pi / T * np.arange(-100, 101)[:, None]
    y = (1 - np.exp(-1j * omega * T)) * (stiffness + damping * (1 - np.exp(-1j * omega * T)) / T)
    late = np.exp(-1j * waves * delay * T)
    alone, both = (1 / waves**2).sum(axis=0), (late / waves**2).sum(axis=0)
    turned = y * both
    return float(np.max(turned.real + np.sqrt(np.abs(y) ** 2 * alone**2 - turned.imag**2)) / (2 * T))


@pytest.mark.parametrize(("device", "delay"), [(MOTOR, 2.0), (MOTOR, 1.4), (FALCON, 4.0), (FALCON, 2.37)])
@pytest.mark.parametrize("share", [1e-3, 0.02])
@pytest.mark.sampled
def test_the_named_wall_is_passive_and_stable_for_all_that_the_intervals_leave_open(device, delay, share):
    found = loop(device, delay, share)
    wall, reason = passive_wall(found, measured())
    assert reason is None
    numbers = [found.interval(name) for name in ("mass", "damping", "delay_samples")]
    corners = product(*((p.low, p.high) for p in numbers))
    for mass, damping, late in corners:
        assert needed_damping(wall.stiffness, wall.damping, late) <= damping
        setup = Setup(Loop(mass, damping, T, late), 1.0, 100, 10)
        assert spectral_radius(setup, np.array([wall.stiffness]), np.array([wall.damping]))[0] < 1
    if share < 0.01:  # and no softer than it need be: 3 % more is passive no longer
        assert needed_damping(1.03 * wall.stiffness, wall.damping, delay) > device[1]


def test_the_damping_of_a_load_is_none_of_a_passive_wall():
    mode = {"mode.frequency_hz": 60.0, "mode.damping_ratio": 0.05, "mode.mass": 0.1}
    found, _ = passive_wall(loop(FALCON, 4.0, 1e-3, of_mode=mode | {"mode.load_damping": 1.0}), measured())
    without, _ = passive_wall(loop(FALCON, 4.0, 1e-3, of_mode=mode), measured())
    assert found.stiffness == pytest.approx(0.75 * without.stiffness, rel=0.01)


def test_the_named_wall_is_never_above_a_measured_limit():
    free, _ = passive_wall(loop(FALCON, 4.0, 1e-3), measured(trials=10))
    limit = 0.8 * free.stiffness
    wall, _ = passive_wall(loop(FALCON, 4.0, 1e-3), measured(limit))
    assert limit * 0.999 < wall.stiffness <= limit


@pytest.mark.slow
def test_a_replay_that_is_off_by_more_than_the_limit_leaves_no_wall():
    free, _ = passive_wall(loop(FALCON, 4.0, 1e-3), measured())
    (limit,) = linear_limits(loop(FALCON, 4.0, 1e-3).loop, np.array([free.damping]))
    off = 1 - 0.5 * free.stiffness / limit
    wall, _ = passive_wall(loop(FALCON, 4.0, 1e-3, error=off), measured())
    assert wall.stiffness == pytest.approx(0.5 * free.stiffness, rel=0.01)
    wall, reason = passive_wall(loop(FALCON, 4.0, 1e-3, error=1.0), measured())
    assert wall is None
    assert "no stable wall" in reason


@pytest.mark.parametrize(
    ("course", "why"),
    [
        (SimpleNamespace(boundary=(), trials=20), "no limit was measured near a damping of"),
        (measured(trials=9), "9 trials are too few"),
    ],
)
def test_no_wall_is_named_without_a_measured_limit_beside_it_or_in_few_trials(course, why):
    wall, reason = passive_wall(loop(FALCON, 4.0, 1e-3), course)
    assert wall is None
    assert why in reason
