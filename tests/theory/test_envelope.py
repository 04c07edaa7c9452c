"""Bounds of what slow modes still do, against the modes' motion itself."""

import numpy as np
import pytest

from pipeline.loop.loop import Loop
from pipeline.theory.ahead import envelope_end, excess, untouched
from pipeline.theory.map import bounding_box
from pipeline.theory.poles import spectral_radius
from pipeline.theory.slowmodes import SlowModes, velocity_factor

LOOPS = [Loop(0, 0, 0), Loop(0, 0, 1), Loop(0, 0, 4), Loop(0, 0, 16), Loop(0.01, 0.05, 2), Loop(1.0, 0.5, 3)]
LOOPS += [Loop(9.0, 0.0, 1), Loop(0, 5.0, 3), Loop(3.0, 100.0, 1), Loop(2.0, 2.8284, 2)]


def poles_of(loop, count, seed):
    """All poles of stable random points, one pole a column; points are drawn until there are enough."""
    rng = np.random.default_rng(seed)
    box = bounding_box(loop)
    alpha, beta = rng.uniform(*box[:2], 20 * count), rng.uniform(*box[2:], 20 * count)
    inside = np.flatnonzero((spectral_radius(loop, alpha, beta) < 1) & (alpha + loop.gamma > 0))[:count]
    alpha, beta = alpha[inside], beta[inside]
    poles = np.linalg.eigvals(loop.matrix(alpha, beta)).T
    keep = np.abs(poles) > 0.05
    point = np.broadcast_to(np.arange(len(alpha)), poles.shape)[keep]
    return alpha[point], beta[point], poles[keep][None].astype(complex)


@pytest.mark.parametrize("loop", LOOPS, ids=str)
def test_no_mode_exceeds_its_bound_between_samples(loop):
    """The motion from the sampled state by the plant's exact solution, at 64 instants, real and imaginary part."""
    alpha, beta, pole = poles_of(loop, 150, 5)
    assert pole.size >= 300
    bound = excess(loop, alpha, beta, pole)
    speed = velocity_factor(loop, alpha, beta, pole)
    force = (beta / pole - alpha - beta) * pole ** -int(loop.delay)
    largest = np.zeros(pole.shape)
    for t in np.linspace(0, 1, 65):
        when = np.full(pole.shape, t)
        real = loop.position_after(when, np.ones(pole.shape), speed.real, force.real)
        imaginary = loop.position_after(when, np.zeros(pole.shape), speed.imag, force.imag)
        largest = np.maximum(largest, np.hypot(real, imaginary) / np.abs(pole) ** t - 1)
    # rounding of the state: the speed of a mode is a difference of numbers of order 1/|transition|
    assert np.all(largest <= bound + 1e-9)


def test_bound_of_a_slow_mode_is_within_twice_the_truth():
    """On the unit circle the parabola's largest excess is (1 - cos)^2/(2 cos) of half the angle."""
    half = np.linspace(0.02, 0.7, 50)
    truth = (1 - np.cos(half)) ** 2 / (2 * np.cos(half))
    pole = np.exp(2j * half)[None]
    bound = excess(Loop(0, 0, 0), np.zeros(50), np.zeros(50), pole)[0]
    assert np.all(bound >= truth)
    assert np.all(bound <= 2 * truth)


def test_constants_of_the_double_integrator_hold_on_a_dense_grid():
    size, turn = (g.ravel() for g in np.meshgrid(np.linspace(0, 1.6, 161), np.linspace(0, 1.6, 161)))
    w = (-size + 1j * turn)[(np.hypot(size, turn) <= 1.6) & (np.hypot(size, turn) > 1e-3)]
    s = np.linspace(-0.5, 0.5, 201)[:, None]
    sinh, cosh = np.sinh(w / 2), np.cosh(w / 2)
    parabola = 1 / cosh + sinh**2 / (2 * cosh) + 2 * sinh * s + 2 * sinh**2 / cosh * s**2
    np.testing.assert_allclose(parabola[[0, -1]], np.exp(w * s[[0, -1]]), rtol=1e-12)
    truth = np.abs(parabola * np.exp(-w * s)).max(axis=0) - 1
    bound = excess(Loop(0, 0, 0), np.zeros(len(w)), np.zeros(len(w)), np.exp(w)[None])[0]
    assert np.all(truth <= bound + 1e-15)


def random_modes(count, seed):
    rng = np.random.default_rng(seed)
    angle, radius = rng.uniform(0.05, 0.6, count), np.exp(-(10 ** rng.uniform(-3, -1, count)))
    real = np.exp(-(10 ** rng.uniform(-3, -1, count)))
    pair = radius * np.exp(1j * angle)
    weight = 10 ** rng.uniform(-6, 0, count) * np.exp(1j * rng.uniform(0, 2 * np.pi, count))
    lead = -(10 ** rng.uniform(-3, 0, count)) + 0j
    pole, amplitude = np.array([real, pair, pair.conj()]), np.array([lead, weight, weight.conj()])
    return SlowModes(pole, amplitude, np.ones(count, bool))


@pytest.mark.slow
def test_no_deviation_exceeds_the_peak_before_the_time_told():
    modes = random_modes(2000, 1)
    size, rate = np.abs(modes.amplitude), -np.log(np.abs(modes.pole))
    peak = np.full(2000, 1e-9)
    free = untouched(modes, size, rate, np.zeros_like(size), peak)
    assert 100 < np.isinf(free).sum() < 1900
    assert ((free > 0) & np.isfinite(free)).sum() > 100
    higher = np.zeros(2000)
    first = np.full(2000, np.inf)
    for t in np.arange(0, 3000, 0.5):
        motion = (modes.amplitude * modes.pole**t).sum(axis=0).real
        first = np.where((motion > peak) & (first == np.inf), t, first)
        higher = np.maximum(higher, motion)
    assert np.all(first >= free)
    # and it is not told too early: those told a time are soon overtaken, at most half a turn of the pair later
    told = (free > 0) & np.isfinite(free) & (free < 2000)
    half_turn = np.pi / np.angle(modes.pole[1])
    late = first[told] - free[told] > 4 * half_turn[told] + 5
    assert late.mean() < 0.1


def test_motion_is_inside_the_band_after_the_end_of_the_envelope():
    modes = random_modes(500, 2)
    size, rate = np.abs(modes.amplitude), -np.log(np.abs(modes.pole))
    end = envelope_end(size, rate, 0.02)
    inside = (size * np.exp(-rate * end)).sum(axis=0)
    assert np.all(inside <= 0.02)
    before = (size * np.exp(-rate * np.maximum(end - 3, 0))).sum(axis=0)
    assert np.all((before > 0.02) | (end == 0))
