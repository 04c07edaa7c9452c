"""Optimal curves against brute force, the optimal points, and what the thesis prints about its figures."""

from __future__ import annotations

import numpy as np
import pytest
from independent import discrete_settling, settling_bracket, simulate

from pipeline.base.errors import ParameterError
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.theory.boundary import boundary
from pipeline.theory.curves import CURVE_CRITERIA, best_damping, best_stiffness
from pipeline.theory.energy import energy_costs
from pipeline.theory.optimum import optimal_point
from pipeline.theory.poles import damping_ratio, spectral_radius
from pipeline.theory.search import where_stable
from pipeline.theory.settling_overshoot import transient_costs

FREE = [NormalisedLoop.ideal(0.0, 0.0, d) for d in (0, 1, 2)]


def cost_of(loop: NormalisedLoop, criterion: str, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """Cost of points, infinity where unstable; the damping ratio with its sign turned."""
    base = criterion.removesuffix("_discrete")

    def cost(a: np.ndarray, b: np.ndarray, _: float) -> np.ndarray:
        if base == "pole_radius":
            return spectral_radius(loop, a, b)
        if base == "damping":
            return -damping_ratio(loop, a, b)
        if base.startswith("energy"):
            return energy_costs(loop, a, b, base.split("_")[1])[criterion]
        bands = () if base == "overshoot" else (float(base[7]) / 100,)
        found = transient_costs(
            loop, a, b, bands, overshoot=base == "overshoot", longest=400, unfinished_overshoot=True
        )[criterion]
        return np.where(found <= 1e-12, 0.0, found) if base == "overshoot" else found

    return where_stable(loop, cost)(alpha, beta, np.inf)


BRUTE = [
    *(c for c in CURVE_CRITERIA if c not in ("settle_1pct", "settle_5pct")),
    "settle_2pct_discrete",
    "overshoot_discrete",
    "energy_step_w1_discrete",
]


@pytest.mark.sampled
@pytest.mark.parametrize("criterion", BRUTE)
def test_no_point_of_a_line_is_better(criterion: str) -> None:
    loop = NormalisedLoop.ideal(0.001, 0.02, 0.5)
    border = boundary(loop)
    alpha = np.array([0.1, 0.3, 0.55]) * border.alpha_max
    dense = np.linspace(border.beta.min(), border.beta_max, 1501)
    curve = best_damping(loop, criterion, alpha)
    assert curve.found.all()
    sign = -1 if criterion == "damping" else 1
    for i, a in enumerate(alpha):
        brute = cost_of(loop, criterion, np.full(len(dense), a), dense)
        assert sign * curve.cost[i] <= brute.min() + 1e-9 * abs(brute.min()) + 1e-12
        assert sign * curve.cost[i] >= brute.min() - 0.03 * abs(brute.min()) - 1e-3  # and is no invention
        at = cost_of(loop, criterion, np.array([a]), curve.best[i : i + 1])[0]
        assert at == pytest.approx(sign * curve.cost[i], rel=1e-6, abs=1e-12)
    if criterion == "energy_impulse_w0":
        return  # its best stiffness is a limit: below
    beta = np.array([0.25, 0.6]) * border.beta_max
    curve = best_stiffness(loop, criterion, beta)
    dense = np.linspace(-loop.gamma + 1e-4, border.alpha_max, 1501)
    for i, b in enumerate(beta):
        brute = cost_of(loop, criterion, dense, np.full(len(dense), b))
        assert sign * curve.cost[i] <= brute.min() + 1e-9 * abs(brute.min()) + 1e-12


@pytest.mark.sampled
@pytest.mark.parametrize("criterion", BRUTE)
def test_curves_meet_in_the_optimal_point(criterion: str) -> None:
    loop = FREE[1]
    point = optimal_point(loop, criterion)
    if not point.attained:
        return  # the damping ratio with delay; the limits are tested below
    # on the very line of the optimum, a corner or a threefold pole is met to the root of rounding
    rel = 1e-4 if criterion == "pole_radius" else 1e-7
    for curve, given in (
        (best_damping(loop, criterion, point.alpha), "alpha"),
        (best_stiffness(loop, criterion, point.beta), "beta"),
    ):
        assert curve.cost[0] == pytest.approx(point.cost, rel=rel, abs=1e-12), given
        other = point.beta if given == "alpha" else point.alpha
        assert curve.low[0] - 1e-6 <= other <= curve.high[0] + 1e-6


@pytest.mark.parametrize(
    ("loop", "low", "high"), [(FREE[0], 0.828, 0.839), (FREE[1], 0.408, 0.425), (FREE[2], 0.270, 0.292)]
)
def test_printed_range_of_the_impulse_curve(loop: NormalisedLoop, low: float, high: float) -> None:
    # 5.2.3: the curve for given alpha of O_E1 impulse is nearly a horizontal line within these limits
    border = boundary(loop)
    curve = best_damping(loop, "energy_impulse_w1", np.linspace(1e-3, 0.999, 60) * border.alpha_max)
    assert (curve.best.min(), curve.best.max()) == pytest.approx((low, high), abs=1.01e-3)


@pytest.mark.parametrize("loop", [*FREE, NormalisedLoop.ideal(0.001, 0.02, 1.5)])
def test_impulse_energy_is_least_on_the_line(loop: NormalisedLoop) -> None:
    # 5.2.3: for given beta the best stiffness is alpha = -gamma, independent of delay
    beta = np.linspace(0.1, 0.9, 9) * boundary(loop).beta_max
    curve = best_stiffness(loop, "energy_impulse_w0", beta)
    assert (curve.best == -loop.gamma).all()
    for share in (1e-3, 1e-5):
        alpha = -loop.gamma + share * (boundary(loop).alpha_max + loop.gamma)
        near = energy_costs(loop, np.full(9, alpha), beta, "impulse")["energy_impulse_w0"]
        assert (near > curve.cost).all()
        assert near == pytest.approx(curve.cost, rel=300 * share)


def test_first_jump_of_the_settling_curve() -> None:
    # 5.2.1 prints the first discontinuity for d = 0 at alpha = 0.30403; it lies 0.15 % further
    alpha = np.array([0.3035, 0.30403, 0.30446, 0.30449, 0.306])
    curve = best_damping(FREE[0], "settle_2pct", alpha)
    assert np.abs(np.diff(curve.best))[[0, 1, 3]].max() < 0.012
    assert curve.best[3] - curve.best[2] > 0.3
    # stepped through time: beyond the printed place the response still stays inside the band after the earlier entry
    motion = simulate(0.3044, 0.70904824, delay=(0, 1), samples=100, fine=256)
    assert settling_bracket(motion, 0.3044, 0.02 + 1e-5)[1] == pytest.approx(12.05, abs=0.01)


def test_largest_jump_of_the_overshoot_curve() -> None:
    # 5.2.2 prints 1.48 % on both sides of a jump between beta = 1.168 and 0.995 at alpha = 0.3044; it lies at 0.3039
    curve = best_damping(FREE[0], "overshoot", [0.3030, 0.3044])
    assert curve.best == pytest.approx([1.168, 0.995], abs=1.01e-3)
    assert curve.cost == pytest.approx([0.0148, 0.0148], abs=1e-3)
    other = transient_costs(FREE[0], 0.3039, np.array([1.168, 0.9935]), ())["overshoot"]
    assert other[0] == pytest.approx(other[1], abs=5e-5)


@pytest.mark.parametrize("loop", FREE)
def test_radius_curve_ends_in_the_stiffest_point(loop: NormalisedLoop) -> None:
    # 5.1.1: the curve starts at (-gamma, -delta) and passes through the rightmost point of the stable region
    border = boundary(loop)
    curve = best_damping(loop, "pole_radius", np.array([1e-5, 1 - 1e-6]) * border.alpha_max)
    assert curve.best[0] == pytest.approx(0, abs=0.03 * border.beta_max)
    assert curve.best[1] == pytest.approx(border.beta_at_alpha_max, abs=2e-3 * border.beta_max)
    assert curve.cost[1] == pytest.approx(1, abs=1e-3)


def test_damping_curves() -> None:
    # 5.1.2: with delay the curve for given beta is the left stability boundary; without, there is a region of ratio 1
    curve = best_stiffness(FREE[1], "damping", np.linspace(0.1, 0.9, 9) * boundary(FREE[1]).beta_max)
    assert (curve.best == 0).all()
    tip = optimal_point(FREE[0], "damping")
    curve = best_damping(FREE[0], "damping", np.array([0.3, 0.9, 1.05]) * tip.alpha)
    assert curve.cost[:2] == pytest.approx([1, 1], abs=1e-8)
    assert curve.cost[2] < 0.999
    assert (curve.high - curve.low)[:2].min() > 1e-3
    for edge in (curve.low, curve.high):  # all poles real inside of the stretch, one pair complex outside
        middle = 0.5 * (curve.low[0] + curve.high[0])
        inside, outside = (edge[0] + s * (middle - edge[0]) for s in (1e-3, -1e-2))
        polynomials = [[1, -2 + (0.3 * tip.alpha + b) / 2, 1 + 0.3 * tip.alpha / 2, -b / 2] for b in (inside, outside)]
        largest = [float(np.abs(np.roots(p).imag).max()) for p in polynomials]
        assert largest[0] < 1e-9 < largest[1]


@pytest.mark.parametrize("criterion", ["settle_2pct", "settle_2pct_discrete"])
def test_settling_curves_stepped_through_time(criterion: str) -> None:
    alpha = np.array([0.01, 0.04, 0.07])
    curve = best_damping(FREE[1], criterion, alpha)
    for a, b, cost in zip(alpha, curve.best, curve.cost, strict=True):
        motion = simulate(a, b, delay=(1, 1), samples=300, fine=64)
        if criterion.endswith("discrete"):
            assert discrete_settling(motion, a, 0.02) == cost
        else:
            # the best point touches the band, so the bracket is that of a slightly stiffer or softer band
            low, high = settling_bracket(motion, a, 0.0201)[0], settling_bracket(motion, a, 0.0199)[1]
            assert low <= cost <= high


def test_lines_without_a_stable_point_say_so() -> None:
    loop = FREE[1]
    border = boundary(loop)
    curve = best_damping(loop, "energy_step_w0", [-0.01, 0.5 * border.alpha_max, 1.01 * border.alpha_max])
    assert curve.found.tolist() == [False, True, False]
    assert np.isnan(curve.best[[0, 2]]).all()
    assert np.isnan(curve.cost[[0, 2]]).all()
    assert best_stiffness(loop, "pole_radius", []).best.shape == (0,)


def test_wrong_use_is_refused() -> None:
    for criterion in ("speed", "alpha_max", "damping_discrete", "overshoot_at_all"):
        with pytest.raises(ParameterError, match="no optimal curve"):
            best_damping(FREE[0], criterion, 0.1)
    with pytest.raises(ParameterError, match="finite"):
        best_stiffness(FREE[0], "damping", [float("nan")])
