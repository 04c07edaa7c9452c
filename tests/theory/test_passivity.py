"""Passivity with lag, filter and fractional delay: against sums over aliases, and energies in the time domain."""

from __future__ import annotations

import numpy as np
import pytest
from general_loop import general_loop, vibration
from independent import maximum_passive_stiffness
from scipy import signal

from pipeline.base.errors import ParameterError
from pipeline.device.parts import Butterworth
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.surface.physical_loop import Loop
from pipeline.theory.passivity import passive_outline, required_damping, stiffest_passive


def needed_damping(delay: float, stiffness: list[float], damping: list[float]) -> np.ndarray:
    """What walls of an ideal loop need of the device, T = 1."""
    return required_damping(NormalisedLoop.ideal(0.0, 0.0, delay), np.array(stiffness), np.array(damping))


def by_aliases(delay: float, stiffness: float, damping: float, aliases: int = 4000) -> float:
    """The condition by its sums as they stand, T = 1 (DEVICES: S_0, S_1, S_2)."""
    w = np.linspace(2e-3, np.pi, 1500)
    total = np.zeros((2, len(w)), dtype=complex)
    for n in range(-aliases, aliases + 1):
        wn = w + 2 * np.pi * n
        total += np.stack([1 / wn**2 + 0j, np.exp(-1j * wn * delay) / wn**2])
    y = (1 - np.exp(-1j * w)) * (stiffness + damping * (1 - np.exp(-1j * w)))
    s0, ys1 = total[0].real, y * total[1]
    return float(((ys1.real + np.sqrt(np.abs(y) ** 2 * s0**2 - ys1.imag**2)) / 2).max())


@pytest.mark.sampled
@pytest.mark.parametrize(("delay", "K", "B"), [(0.5, 1.0, 0.0), (2.3, 0.2, 0.3), (3.75, 0.3, 0.1)])
def test_need_is_that_of_the_sums_over_all_aliases(delay, K, B):
    # sums over 4,000 aliases on either side are off by 1/(2 pi^2 4000)
    assert needed_damping(delay, [K], [B])[0] == pytest.approx(by_aliases(delay, K, B), rel=5e-5)


@pytest.mark.parametrize("delay", [0, 1, 2, 4, 8, 64])
def test_whole_delays_give_the_published_wall(delay):
    kappa, ratio = stiffest_passive(NormalisedLoop.ideal(0.0, 0.0, float(delay)), 1.0)
    published, at = (float(value[0]) for value in maximum_passive_stiffness([delay]))
    assert kappa == pytest.approx(published, rel=2e-5)
    assert ratio == pytest.approx(at, abs=5e-3)  # the maximum over B is flat


def test_need_grows_in_proportion_and_delays_out_of_range_are_refused():
    one, two = needed_damping(2.4, [0.1, 0.2], [0.2, 0.4])
    assert two == pytest.approx(2 * one)
    with pytest.raises(ParameterError, match="delay"):
        needed_damping(-0.1, [1.0], [0.0])


@pytest.mark.parametrize("delay", [0.3, 0.5, 1.5, 7.5])
def test_no_wall_on_the_outline_needs_more_than_the_device_has(delay):
    """The form for whole delays is up to 8.8 % too optimistic between them, and was drawn."""
    alpha, beta = passive_outline(NormalisedLoop.ideal(0.0, 0.0, delay), 1.0)
    worst = max(by_aliases(delay, float(k), float(b), 400) for k, b in zip(alpha[20::40], beta[20::40], strict=True))
    assert worst == pytest.approx(1.0, abs=1e-3)


ALIASES = 400


def printed_boundary(d: float, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """K T/b and B/b on the boundary of the passive region (4.8); at d = 0 its corner."""
    if d == 0:
        return np.full(len(w), 2.0), np.zeros(len(w))
    n, bottom = d + 1, np.sin(2 * (d + 1) * w) - 2 * (d + 1) * np.sin(w)
    k = -8 * n * np.sin(n * w) * np.sin(0.5 * w) ** 2 / bottom
    return k, 2 * (d * np.sin(n * w) - n * np.sin(d * w)) / bottom


@pytest.mark.parametrize("delay", [0.0, 1.0, 2.0, 5.0])
def test_integer_delays_need_what_the_thesis_says(delay):
    """(4.6) to (4.11): walls on the boundary need all of the damping."""
    loop, angle = NormalisedLoop.ideal(0.0, 0.1, delay), np.pi / (delay + 1) * np.linspace(0.05, 0.95, 13)
    alpha, beta = (0.1 * side for side in printed_boundary(delay, angle))
    np.testing.assert_allclose(required_damping(loop, alpha, beta), 0.1, rtol=1e-8)
    stiffest = passive_outline(loop, 0.1)[0].max()
    np.testing.assert_allclose(stiffest, 0.1 * maximum_passive_stiffness(delay)[0], rtol=1e-3)


def test_half_a_sample_needs_more_than_the_formula_of_integer_delays():
    assert required_damping(NormalisedLoop.ideal(0.0, 0.1, 0.5), np.ones(1), np.zeros(1))[0] == pytest.approx(
        1.0590, abs=1e-4
    )


def generated(loop, alpha, beta, angle, aliases=ALIASES):
    """Energy per sample that a wall generates, over integral of v^2, for the worst motion of a base frequency.

    The motion is a sum of aliases; the force is followed in time: sampled, filtered, held, delayed, and led through
    the lag over fine steps, until only the periodic part is left.
    """
    n = np.arange(-aliases, aliases + 1)
    w = angle + 2 * np.pi * n
    lagged = np.exp(-1j * w * loop.delay) / (1 + 1j * w * loop.lag)
    u = np.exp(-1j * angle)
    b, a = loop.filter_in_z
    y = (1 - u) * (alpha + beta * (1 - u) * np.polyval(b[::-1], u) / np.polyval(a[::-1], u))
    # power = -Re sum conj(v_n) f_n, v_n = j w_n x_n, f_n = -hold_n L_n y/(1-u) X, X = sum x_n: a form of rank two
    left, right = lagged / w, 1 / w
    form = np.outer(right, np.conj(left)) * np.conj(y)
    form = 0.5 * (form + form.conj().T)
    values, vectors = np.linalg.eigh(form)
    speeds = vectors[:, -1]
    return values[-1], w, speeds


@pytest.mark.slow
@pytest.mark.sampled
@pytest.mark.parametrize(
    "loop",
    [
        NormalisedLoop.ideal(0.0, 0.1, 0.5),
        general_loop(0.0, 0.1, 1.3, lag=0.8),
        general_loop(0.0, 0.1, 0.5, lag=0.3, velocity=Butterworth(kind="butterworth", order=2, cutoff_hz=0.1)),
    ],
)
def test_energy_in_the_time_domain(loop):
    """The worst sum of aliases, driven through the wall in time, generates what the formula says, and no more."""
    alpha, beta = 1.0, 0.4
    needed = required_damping(loop, np.array([alpha]), np.array([beta]))[0]
    worst = max((generated(loop, alpha, beta, angle, 30)[0], angle) for angle in np.linspace(0.02, np.pi, 60))
    angle = worst[1]
    fully = generated(loop, alpha, beta, angle, 30)
    assert 0.9 * needed < fully[0] <= needed * (1 + 1e-9)
    assert energy_in_time(loop, alpha, beta, fully[1], fully[2]) == pytest.approx(fully[0], rel=2e-3)
    rng = np.random.default_rng(1)
    for _ in range(5):
        speeds = fully[2] * (1 + 0.3 * rng.standard_normal(len(fully[2])))
        assert energy_in_time(loop, alpha, beta, fully[1], speeds) < needed


def energy_in_time(loop, alpha, beta, w, speeds, settle=400, samples=400, steps=200):
    """Mean power of the wall's force on a complex motion, over mean |v|^2, by the force's course in time."""
    b, a = loop.filter_in_z
    k = np.arange(settle + samples)
    # complex exponentials of one base frequency: at samples all aliases are one
    x = (speeds / (1j * w)).sum() * np.exp(1j * w[len(w) // 2] * k)
    rate = np.diff(x, prepend=0)
    v = np.zeros_like(rate)
    for i in range(len(k)):
        v[i] = sum(b[j] * rate[i - j] for j in range(len(b)) if i >= j)
        v[i] -= sum(a[j] * v[i - j] for j in range(1, len(a)) if i >= j)
    held = -alpha * x - beta * v
    h, force, power, size = 1 / steps, 0j, 0.0, 0.0
    decay = np.exp(-h / loop.lag) if loop.lag else 0.0
    for i in range(settle - 60, settle + samples):
        t = i + (np.arange(steps) + 0.5) * h
        command = held[np.floor(t - loop.delay + 1e-9).astype(int)]
        course = np.empty(steps, complex)
        for j in range(steps):
            later = command[j] + (force - command[j]) * decay
            course[j], force = 0.5 * (force + later) if loop.lag else command[j], later
        if i >= settle:
            speed = np.exp(1j * np.outer(t, w)) @ speeds
            power += (course * np.conj(speed)).real.sum() * h
            size += (np.abs(speed) ** 2).sum() * h
    return power / size


def test_region_scales_with_the_damping_and_holds_what_is_passive():
    loop = general_loop(0.0, 0.1, 1.3, lag=0.8)
    alpha, beta = passive_outline(loop, 0.1)
    twice = passive_outline(loop, 0.2)
    np.testing.assert_allclose(twice[0], 2 * alpha, rtol=1e-12, atol=1e-15)
    inner = slice(1, -1)
    assert (required_damping(loop, 0.99 * alpha[inner], 0.99 * beta[inner]) < 0.1).all()
    assert (required_damping(loop, 1.01 * alpha[inner], 1.01 * beta[inner]) > 0.1).all()


def test_sensing_beyond_a_mode_is_refused():
    with pytest.raises(ParameterError, match="beyond the vibration mode"):
        required_damping(general_loop(0.0, 0.1, 1.0, **vibration(0.3, 0.5, 0.01, True)), np.ones(1), np.ones(1))


@pytest.mark.sampled
@pytest.mark.parametrize("cutoff", [0.05, 0.1, 0.3, 1.0, 5.0, 30.0])
@pytest.mark.parametrize("order", [1, 2, 4])
def test_behind_a_slow_filter_no_wall_is_called_passive_that_is_unstable(cutoff, order):
    velocity = {"kind": "butterworth", "order": order, "cutoff_hz": cutoff}
    loop = Loop(0.58, 4.0, 0.001, 4, velocity=velocity)
    outline = loop.passive()
    some = outline[outline["stiffness"] > 1e-3 * outline["stiffness"].max()]
    inside = loop.points(0.999 * some["stiffness"], 0.999 * some["damping"], ())
    assert inside["stable"].all()
    assert outline.attrs["stiffness_max"] <= loop.boundary().attrs["stiffness_max"]
    # what a slow motion asks for: sums over the aliases themselves, at angles of the filter's corner and far below
    K, B = outline.attrs["stiffness_max"], outline.attrs["damping_at_stiffness_max"]
    angle = np.geomspace(1e-6, np.pi, 4000)
    b, a = signal.butter(order, 2 * cutoff * 0.001)
    _, gain = signal.freqz(b, a, angle)
    u, omega = np.exp(-1j * angle), angle[:, None] + 2 * np.pi * np.arange(-400, 401)
    y = (1 - u) * (K * 1e-6 / 0.58 + B * 1e-3 / 0.58 * gain * (1 - u))
    L = np.exp(-4j * omega)
    s0, s1, s2 = ((power / omega**2).sum(axis=1) for power in (np.ones_like(omega), L, np.abs(L) ** 2))
    real = (y * s1).real
    needs = 0.5 * (real + np.sqrt(real**2 + np.abs(y) ** 2 * np.maximum(s0 * s2 - np.abs(s1) ** 2, 0)))
    assert needs.max() == pytest.approx(4e-3 / 0.58, rel=2e-3)
