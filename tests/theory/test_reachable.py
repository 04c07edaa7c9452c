"""The best cost that a delay allows against the optima of theory, and walls that are stable with every spring."""

from __future__ import annotations

import numpy as np
import pytest
import state_matrix

import pipeline
from pipeline.base.errors import ParameterError
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.theory.optimum import optimal_point
from pipeline.theory.poles import pole_settling_time
from pipeline.theory.reachable import WITHIN, reachable

DELAYS = np.concatenate([np.linspace(0.0, 4.0, 17), np.geomspace(4.5, 60.0, 23)])


def optimal_cost(criterion: str, delay: float) -> float:
    cost = optimal_point(NormalisedLoop.ideal(0.0, 0.0, delay), criterion).cost
    return float(pole_settling_time(cost)[0]) if criterion == "pole_radius" else cost


def errors_of(criterion: str, delays) -> list[tuple[float, float]]:
    found = ((delay, reachable(criterion, float(delay))) for delay in delays)
    return [(best.cost / optimal_cost(criterion, float(delay)) - 1, best.within) for delay, best in found]


@pytest.mark.slow
def test_reachable_energies_are_those_of_the_optima_at_40_delays():
    for error, within in errors_of("energy_step_w0", DELAYS):
        assert abs(error) < within


@pytest.mark.slow
@pytest.mark.parametrize(
    "criterion", ["settle_2pct", "settle_5pct", "pole_radius", "energy_step_w2", "energy_impulse_w1"]
)
def test_reachable_costs_are_those_of_the_optima(criterion):
    for error, within in errors_of(criterion, DELAYS[DELAYS < 24]):
        assert abs(error) < within


def test_a_sample_less_of_delay_saves_five_samples_of_settling():
    best = reachable("settle_2pct", 4.0)
    assert best.per_sample == pytest.approx(4.9, abs=0.01)
    assert best.cost == pytest.approx(5 * best.per_sample, rel=1e-12)
    assert best.cost - reachable("settle_2pct", 3.0).cost == pytest.approx(best.per_sample, rel=1e-12)
    # the delay and one sampling period are a fifth of it
    assert (4 + 1) / best.cost == pytest.approx(0.2, abs=0.01)
    assert reachable("settle_2pct", 0.5).per_sample == pytest.approx(0.5 * 4.9, abs=0.01)


def test_costs_without_a_delay_in_them_are_refused():
    for criterion in ("overshoot", "damping", "fun"):
        with pytest.raises(ParameterError):
            reachable(criterion, 2.0)
    with pytest.raises(ParameterError, match="delay_samples"):
        reachable("settle_2pct", -1.0)
    assert [error for _, error in WITHIN] == sorted(error for _, error in WITHIN)


def test_a_robust_wall_is_stable_with_every_spring():
    mass, damping, delay, period = 0.4, 12.0, 2, 1e-3
    loop = pipeline.Loop(mass, damping, period, delay)
    walls = loop.robust()
    assert walls.stiffness.max() == walls.attrs["stiffness_max"] > loop.passive().attrs["stiffness_max"]
    rng = np.random.default_rng(4)
    springs = mass / period**2 * np.concatenate([np.linspace(0.0, np.pi**2, 40), rng.uniform(0, np.pi**2, 40)])

    def largest_radius(K, B, at):
        return max(state_matrix.radius(loop.replace({"stiffness": float(k)}), K, B) for k in at)

    for wall in walls.iloc[5:-5:7].itertuples():
        assert largest_radius(0.98 * wall.stiffness, wall.damping, springs) < 1
        assert largest_radius(1.03 * wall.stiffness, wall.damping, [wall.spring]) > 1


def test_robust_walls_of_other_parts_are_refused_and_without_damping_there_are_none():
    with pytest.raises(ParameterError, match="lag"):
        pipeline.Loop(0.4, 12.0, 1e-3, 2, actuator_lag_s=0.001).robust()
    assert pipeline.Loop(0.4, 0.0, 1e-3, 2).robust().attrs["stiffness_max"] == 0.0
