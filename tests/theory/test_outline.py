"""Outlines of general loops are whole: the ends, the stiffest wall and the islands, against eigenvalues."""

from __future__ import annotations

import numpy as np
import pytest
from general_devices import random_device
from general_loop import general_loop, vibration

import pipeline
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.theory.boundary import boundary, outline

LONG = {
    "lag": ({"damping": 10, "delay_samples": 0, "actuator_lag_s": 1.5e-3}, 142_313, 1_166.7),
    "difference": (
        {"damping": 2, "delay_samples": 0, "velocity": {"kind": "difference", "samples": 2}},
        345_264,
        1_335.8,
    ),
    "first order": (
        {"damping": 1, "delay_samples": 1, "velocity": {"kind": "butterworth", "order": 1, "cutoff_hz": 380}},
        122_351,
        752.8,
    ),
    "second order": (
        {"damping": 2, "delay_samples": 0.5, "velocity": {"kind": "butterworth", "order": 2, "cutoff_hz": 200}},
        112_536,
        645.5,
    ),
}
"""Loops of 1 kg at 1 kHz whose region is a long horn: stiffest wall [N/m], largest damping [Ns/m]."""


def radius(loop: NormalisedLoop, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """Largest pole modulus of each point."""
    return np.abs(np.linalg.eigvals(loop.matrix(alpha, beta))).max(axis=1)


def random_loops(count: int, seed: int) -> list[NormalisedLoop]:
    """Random devices of all kinds that some wall stabilises."""
    rng, found = np.random.default_rng(seed), []
    while len(found) < count:
        loop = NormalisedLoop.of(random_device(rng, ""))
        if len(outline(loop, 8).beta):
            found.append(loop)
    return found


@pytest.mark.parametrize("name", LONG)
def test_the_boundary_of_a_long_horn_is_whole(name):
    arguments, stiffest, most_damped = LONG[name]
    boundary = pipeline.Loop(mass=1, sampling_period_s=0.001, **arguments).boundary()
    assert boundary.attrs["stiffness_max"] == pytest.approx(stiffest, rel=1e-5)
    assert boundary.attrs["damping_max"] == pytest.approx(most_damped, rel=1e-3)
    assert boundary["stiffness"].max() == boundary.attrs["stiffness_max"]


def check_whole(loop: NormalisedLoop, seed: int) -> None:
    """No soft wall outside the told dampings, none between them that is not, and no wall stiffer than the stiffest."""
    found, rng = outline(loop, 60), np.random.default_rng(seed)
    low, high = found.beta[0], found.beta[-1]
    tried = np.concatenate([rng.uniform(low - (high - low), high + 3 * (high - low), 300), np.linspace(low, high, 100)])
    soft = 1e-7 * (found.alpha_max + loop.gamma)
    inside = np.isfinite(np.interp(tried, found.beta, found.alpha, left=np.nan, right=np.nan))
    stable = radius(loop, np.full(len(tried), soft), tried)
    assert not (stable[~inside] < 1 - 1e-9).any(), loop
    # up from softer walls at each damping: the first that is unstable is not beyond the stiffest that is told
    alpha = np.linspace(0, 1.3 * found.alpha_max, 160)[1:]
    beta = rng.uniform(low, high, 40)
    moduli = radius(loop, np.tile(alpha, 40), np.repeat(beta, 159)).reshape(40, 159)
    unstable = moduli > 1 - 1e-9
    first = np.where(unstable.any(axis=1), alpha[unstable.argmax(axis=1)], np.inf)
    assert (first <= found.alpha_max + 2 * (alpha[1] - alpha[0])).all(), loop
    limit = np.interp(beta, found.beta, found.alpha)
    soft_ones = stable[inside & (tried > low + 1e-3 * (high - low)) & (tried < high - 1e-3 * (high - low))]
    if len(np.flatnonzero(np.diff(found.beta) > 0.2 * (high - low))) == 0:
        assert (soft_ones < 1 + 1e-9).all(), loop
    assert (limit >= 0).all()


@pytest.mark.slow
def test_outlines_of_300_random_devices_are_whole():
    for number, loop in enumerate(random_loops(300, 7)):
        check_whole(loop, number)


def test_no_optimum_lies_on_an_island_or_beside_a_better_one():
    """The settling optimum of a horn, once told at 18.0 samples, is at most that of a wall told beside it."""
    loop = pipeline.Loop(1, 1, 0.001, 1, velocity={"kind": "butterworth", "order": 1, "cutoff_hz": 380})
    best = loop.optimum("settle_2pct")
    beside = float(loop.points(37606.076, 272.07807)["settle_2pct"].iloc[0])
    assert best.cost <= beside < 10.85


@pytest.mark.parametrize(
    ("loop", "gaps"),
    [
        (
            NormalisedLoop.ideal(9.0, 0.01, 3.3),
            0,
        ),  # soft walls are stable at some dampings only, but all that is stable is of one piece
        (
            general_loop(0.000273, 0.0693, 6.0, **vibration(0.4, 0.0011, 0.0092, False)),
            4,
        ),  # two regions join
    ],
)
def test_an_edge_is_drawn_without_jumps(loop: NormalisedLoop, gaps: int) -> None:
    border = boundary(loop)
    step = np.hypot(
        np.diff(border.alpha) / np.ptp(border.alpha[np.isfinite(border.alpha)]),
        np.diff(border.beta) / np.ptp(border.beta[np.isfinite(border.beta)]),
    )
    assert np.nanmax(step) < 0.06
    assert np.isnan(border.alpha).sum() == gaps
