"""Boundary, verdicts, costs and optima of random loops against a dense scan: eigenvalues and plain simulation in SI.

Nothing of the package's loop or theory is used for the truth (`plain_loops`): a sample of the loop is a linear step,
whose matrix has the poles and whose powers are the motion.
`SCANNED_LOOPS=400` in the environment scans as many loops of each kind.
"""

from __future__ import annotations

import os

import numpy as np
import pytest
from matplotlib.path import Path
from plain_loops import FINE, Plain, drawn

import pipeline

LOOPS = int(os.environ.get("SCANNED_LOOPS", "24"))
FIRST = int(os.environ.get("SCANNED_FROM", "0"))
FAST = 1
WALLS = 1200
"""Walls of a loop whose poles are told."""

LONGEST = 6000
"""Samples that a response is followed; walls that take longer are not simulated."""


def check_boundary(plain: Plain, loop: pipeline.Loop, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Hold the boundary against eigenvalues all over a box around it; return stable walls well inside."""
    border = loop.boundary(600)
    stiffest, damped = border.attrs["stiffness_max"], border.attrs["damping_max"]
    # islands may lie far off
    levels = border["damping"].dropna().to_numpy()
    lowest = levels[loop.limits(levels)["stiffness"].notna()].min()
    width = damped - lowest
    K = rng.uniform(0, 1.25 * stiffest, WALLS)
    B = rng.uniform(lowest - 0.2 * width, damped + 0.25 * width, WALLS)
    radius = plain.radius(K, B)
    told = loop.points(K, B, ())
    clear = np.abs(radius - 1) > 1e-9
    assert (told["stable"][clear] == (radius[clear] < 1)).all(), loop
    np.testing.assert_allclose(told["spectral_radius"], radius, atol=1e-6)
    # scaled, so that "near the line" means the same along both axes
    ends = (border["damping"].iloc[[-1, 0]] - lowest) / width
    line = np.column_stack([(border["damping"] - lowest) / width, border["stiffness"] / stiffest])
    base = -plain.stiffness / stiffest if border["stiffness"].min() < 0 else 0.0
    outline = Path(np.vstack([line, np.column_stack([ends, [base, base]]), line[:1]]))
    walls = np.column_stack([(B - lowest) / width, K / stiffest])
    far = np.nanmin(np.hypot(*(walls[:, None] - line[None]).transpose(2, 0, 1)), axis=1) > 0.02
    # of a boundary that mostly lies at negative stiffness few points are left here
    several = bool(border["stiffness"].isna().any()) or stiffest < plain.stiffness
    several |= bool(border.attrs["islands"])
    held = loop.limits(B)["stiffness"].fillna(0.0) > K if several else outline.contains_points(walls)
    inside = np.asarray(held) & (walls[:, 1] > 0.01)
    assert (radius[inside & far] < 1 + 1e-9).all(), (loop, "unstable inside", K[inside & far & (radius > 1)][:3])
    outside = far & ~inside & (walls[:, 1] > 0.01) & (radius < 1 - 1e-9)
    islands = np.array([one["damping"] for one in border.attrs["islands"]])
    if len(islands):
        outside &= (islands.min() > B) | (islands.max() < B)
    assert not outside.any(), (loop, "stable outside", K[outside][:3], B[outside][:3])
    good = inside & far & (radius < 1 - 1e-6)
    return K[good], B[good]


def check_costs(plain: Plain, loop: pipeline.Loop, K: float, B: float, radius: float) -> None:
    """Hold settling, overshoot and energies of a wall against its plain simulation."""
    samples = int(min(LONGEST, 60 + 3 * plain.delay + 25 / -np.log(radius)))
    if 25 / -np.log(radius) > LONGEST:
        return
    told = loop.points(K, B).iloc[0]
    times, away, sampled = plain.followed(K, B, samples)
    assert np.abs(away[-FINE:]).max() < 1e-6, loop
    settle = told["settle_2pct"]
    after, before = np.abs(away[times > settle]), np.abs(away[(times <= settle) & (times > settle - 2 / FINE)])
    assert after.max(initial=0) <= 0.02 * (1 + 1e-6), (loop, K, B, settle)
    assert before.max(initial=1.0 if settle <= 1 / FINE else 0.0) >= 0.02 * (1 - 1e-2), (loop, K, B, settle)
    out = np.flatnonzero(np.abs(sampled) > 0.02)
    if np.abs(np.abs(sampled) - 0.02).min() > 1e-9:
        assert told["settle_2pct_discrete"] == out[-1] + 1, (loop, K, B)
    assert away.max() <= told["overshoot"] + 1e-9 <= away.max() + 0.003 * (1 + away.max()), (loop, K, B)
    assert told["overshoot_discrete"] == pytest.approx(max(sampled.max(), 0), abs=1e-9), (loop, K, B)
    stiff = (K + plain.stiffness) * plain.period**2 / plain.mass
    energy = sampled**2 + np.diff(sampled, prepend=sampled[0]) ** 2 / stiff
    for w in range(3):
        expected = float(np.arange(samples) ** w @ energy)
        assert told[f"energy_step_w{w}_discrete"] == pytest.approx(expected, rel=1e-7), (loop, K, B, w)


def check_optimum(loop: pipeline.Loop, criterion: str, K: np.ndarray, B: np.ndarray) -> None:
    """Hold an optimum against stable walls: none is better, and its cost is that of its wall."""
    best = loop.optimum(criterion)
    cost = loop.points(K, B, (criterion,))[criterion]
    assert best.cost is not None, (loop, criterion, best.reason)
    assert cost.min() >= best.cost * (1 - 1e-7), (loop, criterion, best, K[cost.argmin()], B[cost.argmin()])
    if best.reason is None:
        own = loop.points(best.stiffness, best.damping, (criterion,))[criterion][0]
        assert own == pytest.approx(best.cost, rel=1e-6), (loop, criterion, best)


def scan(kind: str, seed: int) -> None:
    plain, loop = drawn(kind, seed)
    rng = np.random.default_rng([seed, 7])
    try:
        loop.boundary(8)
    except pipeline.ParameterError:  # says that no wall is stable
        beta = rng.uniform(0, 2, 400) * plain.mass / plain.period
        alpha = 10 ** rng.uniform(-8, 0, 400) * plain.mass / plain.period**2
        assert (plain.radius(alpha, beta) > 1 - 1e-9).all(), (loop, "has stable walls")
        return
    K, B = check_boundary(plain, loop, rng)
    radius = plain.radius(K, B)
    for i in range(min(12, len(K))):
        check_costs(plain, loop, K[i], B[i], radius[i])
    for criterion in ("settle_2pct", "energy_step_w1_discrete"):
        check_optimum(loop, criterion, K, B)


@pytest.mark.parametrize("kind", ["ideal", pytest.param("device", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "seed", [pytest.param(n, marks=[pytest.mark.slow] if n >= FAST else []) for n in range(FIRST, FIRST + LOOPS)]
)
def test_a_dense_scan_agrees(kind, seed):
    scan(kind, seed)
