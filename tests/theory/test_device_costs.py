"""Costs of general loops: against fine integration with scipy, and long sums in many digits."""

from dataclasses import replace

import mpmath as mp
import numpy as np
import pytest
from general_devices import EXTREMES, ManyDigits, characteristic, random_device, schur_cohn
from scipy.integrate import simpson
from scipy.interpolate import CubicHermiteSpline
from scipy.linalg import eig, expm, norm

from pipeline.loop.loop import Loop, Vibration, loop_of, wall_units
from pipeline.records.loop_parts import Butterworth
from pipeline.theory.boundary import outline
from pipeline.theory.costs import point_costs_by_name
from pipeline.theory.energy import energy_costs
from pipeline.theory.optimum import optimal_point
from pipeline.theory.poles import spectral_radius
from pipeline.theory.settling_overshoot import transient_costs

RICH = Loop(
    *(1e-4, 0.01, 2.4),
    lag=1.5,
    mode=Vibration(0.3, 0.5, 0.01, sensor_far=True),
    velocity=Butterworth(kind="butterworth", order=2, cutoff_hz=0.08),
)


def a_wall(loop, share=0.4):
    found = outline(loop, 16)
    return np.array([share * found.alpha_max]), np.array([found.beta_at_alpha_max])


def fine(loop, alpha, beta, samples, steps=256):
    """Time [samples], sensed position and velocity of a step, at fine steps of scipy's exponential."""
    matrix, push, sensor = loop.device
    both = np.zeros((len(push) + 1,) * 2)
    both[:-1, :-1], both[:-1, -1] = matrix, push
    motion = expm(both / steps)
    b, a = loop.filter_in_z
    state = np.zeros(len(push) + 1)
    speed_row = sensor @ matrix
    force_step = alpha + loop.gamma
    sensed, speeds, forces = [], [], []
    positions, place, speed, time = [], [], [], []
    whole, fraction = int(loop.delay), loop.delay - int(loop.delay)
    for k in range(samples):
        x = sensor @ state[:-1]
        positions.append(x)
        rates = [
            positions[-1 - i] - (positions[-2 - i] if len(positions) > i + 1 else 0) for i in range(len(positions))
        ]
        sensed.append(rates[0])
        v = sum(b[i] * sensed[-1 - i] for i in range(min(len(b), len(sensed))))
        v -= sum(a[i] * speeds[-i] for i in range(1, min(len(a), len(speeds) + 1)))
        speeds.append(v)
        forces.append(-alpha * x - beta * v)
        for j in range(steps):
            age = whole if j >= round(fraction * steps) else whole + 1
            state[-1] = force_step + (forces[-1 - age] if len(forces) > age else 0.0)
            time.append(k + j / steps)
            place.append(sensor @ state[:-1] - 1)
            speed.append(speed_row @ state[:-1])
            state[:-1] = (motion @ state)[:-1]
    return np.array(time), np.array(place), np.array(speed)


@pytest.mark.sampled
@pytest.mark.parametrize("sensor_far", [False, True])
def test_costs_equal_fine_integration(sensor_far):
    # a fraction of 2^-n of a sample lies on the fine steps
    finely_right(Loop(1e-4, 0.01, 2.375, 1.5, Vibration(0.3, 0.5, 0.01, sensor_far), RICH.velocity))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_costs_of_random_devices_equal_fine_integration(seed):
    rng = np.random.default_rng(100 + seed)
    while True:
        loop = loop_of(*random_device(rng).arguments)
        loop = replace(loop, delay=np.floor(64 * loop.delay) / 64)
        if len(outline(loop, 8).beta) and spectral_radius(loop, *a_wall(loop))[0] < 0.97:
            break
    finely_right(loop)


def finely_right(loop):
    alpha, beta = a_wall(loop)
    time, place, speed = fine(loop, alpha[0], beta[0], 700)
    costs = transient_costs(loop, alpha, beta, (0.02,)) | energy_costs(loop, alpha, beta)
    top = max(place.argmax(), 1)
    near = CubicHermiteSpline(time[top - 1 : top + 2], place[top - 1 : top + 2], speed[top - 1 : top + 2])
    peak = near(near.derivative().roots(extrapolate=False)).max(initial=0.0)
    assert costs["overshoot"][0] == pytest.approx(peak, rel=1e-6, abs=1e-9)
    assert costs["overshoot_discrete"][0] == pytest.approx(max(place[::256].max(), 0.0), rel=1e-9, abs=1e-9)
    last = np.flatnonzero(np.abs(place) > 0.02)[-1]
    side, two = np.sign(place[last]), slice(last, last + 2)
    band = CubicHermiteSpline(time[two], side * place[two] - 0.02, side * speed[two])
    assert costs["settle_2pct"][0] == pytest.approx(band.roots(extrapolate=False)[-1], rel=1e-6)
    assert costs["settle_2pct_discrete"][0] == np.flatnonzero(np.abs(place[::256]) > 0.02)[-1] + 1
    rise = point_costs_by_name(loop, alpha, beta, ("rise_time", "rise_time_discrete"), 700)
    for name, share, steps in (("rise_time", place, 256), ("rise_time_discrete", place[::256], 1)):
        first = [np.flatnonzero(share >= level)[0] for level in (-0.9, -0.1)]
        begin, end = (
            k - (share[k] - level) / (share[k] - share[k - 1]) for k, level in zip(first, (-0.9, -0.1), strict=True)
        )
        assert rise[name][0] == pytest.approx((end - begin) / steps, abs=1e-9 if steps == 1 else 1e-4)
    energy = place**2 + speed**2 / (alpha[0] + loop.gamma)
    for w in (0, 1, 2):
        # the force changes on every other fine step alone
        expected = simpson(time[:-1] ** w * energy[:-1], x=time[:-1])
        assert costs[f"energy_step_w{w}"][0] == pytest.approx(expected, rel=1e-6)


def energies_in_many_digits(example, K, B, samples):
    """Discrete step energies by summing samples in mpmath, SI, absolute coordinates."""
    truth = ManyDigits(example)
    matrix = truth.matrix(mp.mpf(K), mp.mpf(B))
    n, oldest = matrix.rows, truth.segments[0][1]
    positions = max(len(truth.b), 1) + oldest
    z = mp.zeros(n, 1)
    z[0] = z[2] = -1
    for i in range(positions):
        z[5 + i] = -1
    z[4] = -truth.stiffness if example.parts.actuator_lag_s > 0 else 0
    total, before = [mp.mpf(0)] * 3, mp.mpf(-1)
    # E/E_0 = e^2 + m v^2/(gain K + k), the wall's force per unit of command being gain K
    inertia = truth.mass / (truth.gain * K + truth.stiffness) / truth.period**2
    for k in range(samples):
        e = z[truth.sensor]
        energy = e**2 + inertia * (e - before) ** 2
        total = [s + mp.mpf(k) ** w * energy for w, s in enumerate(total)]
        before, z = e, matrix * z
    return [float(s) for s in total], float(max(abs(z[i]) for i in truth.kept))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 4])
def test_discrete_energies_equal_long_sums_in_many_digits(seed):
    rng = np.random.default_rng(seed)
    with mp.workdps(40):
        for _ in range(20):
            example = random_device(rng)
            loop = loop_of(*example.arguments)
            if not len(outline(loop, 8).beta):
                continue
            alpha, beta = a_wall(loop, 0.3)
            radius = spectral_radius(loop, alpha, beta)[0]
            if radius < 0.93:
                break
        assert radius < 0.93
        units = wall_units(example.mass, example.sampling_period_s, example.parts)
        K, B = float(alpha[0] * units.stiffness), float(beta[0] * units.damping)
        expected, rest = energies_in_many_digits(example, K, B, 700)
    assert rest < 1e-10
    found = energy_costs(loop, alpha, beta)
    for w in (0, 1, 2):
        assert found[f"energy_step_w{w}_discrete"][0] == pytest.approx(expected[w], rel=1e-9)


@pytest.mark.parametrize("signal", ["step", "impulse"])
def test_general_energies_equal_ideal_ones(signal):
    alpha, beta = np.array([0.002, 0.01, 0.03]), np.array([0.1, 0.15, 0.2])
    for gamma, delta, delay in ((0.0, 0.01, 2.0), (1e-3, 0.05, 1.4)):
        ideal = energy_costs(Loop(gamma, delta, delay), alpha, beta, signal)
        found = energy_costs(Loop(gamma, delta, delay), alpha, beta, signal)
        for name, values in ideal.items():
            np.testing.assert_allclose(found[name], values, rtol=1e-10, err_msg=name)


def test_general_transients_equal_ideal_ones():
    alpha, beta = np.array([0.002, 0.01, 0.03, 0.001]), np.array([0.1, 0.15, 0.2, 0.2])
    for gamma, delta, delay in ((0.0, 0.01, 2.0), (1e-3, 0.05, 1.4)):
        ideal, found = (
            transient_costs(loop, alpha, beta)
            | point_costs_by_name(loop, alpha, beta, ("rise_time", "rise_time_discrete"), 5000)
            for loop in (Loop(gamma, delta, delay), Loop(gamma, delta, delay))
        )
        for name, values in ideal.items():
            np.testing.assert_allclose(found[name], values, rtol=1e-10, atol=1e-12, err_msg=name)


@pytest.mark.parametrize("extreme", ["", *EXTREMES])
def test_slowest_pole_in_many_digits(extreme):
    rng = np.random.default_rng(2)
    for _ in range(6):
        example = random_device(rng, extreme)
        loop = loop_of(*example.arguments)
        if len(outline(loop, 8).beta):
            break
    alpha, beta = a_wall(loop, 0.5)
    units = wall_units(example.mass, example.sampling_period_s, example.parts)
    radius = float(spectral_radius(loop, alpha, beta)[0])
    # what a backward stable solver leaves open: the poles of a filter near Nyquist lie close together
    poles, left, right = eig(loop.matrix(alpha, beta)[0], left=True, right=True)
    slowest = np.abs(poles).argmax()
    condition = 1 / abs(left[:, slowest].conj() @ right[:, slowest])  # both of length 1
    near = 1e-9 + np.finfo(float).eps * norm(loop.matrix(alpha, beta)[0]) * condition
    with mp.workdps(60):
        truth = ManyDigits(example)
        matrix = truth.matrix(mp.mpf(float(alpha[0] * units.stiffness)), mp.mpf(float(beta[0] * units.damping)))
        # |z| below r (1 + near) and not below r (1 - near), by scaling the poles
        used = [*truth.kept, *range(5, matrix.rows)]
        kept = mp.matrix([[matrix[i, j] for j in used] for i in used])
        inside = [schur_cohn(characteristic(kept / (mp.mpf(radius) * (1 + side * mp.mpf(near))))) for side in (1, -1)]
    assert inside == [True, False]


@pytest.mark.slow
@pytest.mark.parametrize("criterion", ["energy_step_w0", "settle_2pct_discrete", "pole_radius"])
def test_no_random_wall_beats_the_optimum(criterion):
    loop = Loop(0.0, 0.02, 1.5, lag=0.7, velocity=Butterworth(kind="butterworth", order=1, cutoff_hz=0.1))
    best = optimal_point(loop, criterion)
    rng = np.random.default_rng(0)
    found = outline(loop, 32)
    alpha = best.alpha * (1 + 0.2 * rng.standard_normal(60))
    beta = best.beta * (1 + 0.2 * rng.standard_normal(60))
    inside = (alpha > 0) & (alpha < 0.8 * np.interp(beta, found.beta, found.alpha, left=0, right=0))
    alpha, beta = alpha[inside], beta[inside]
    if criterion == "pole_radius":
        others = spectral_radius(loop, alpha, beta)
    elif criterion.startswith("energy"):
        others = energy_costs(loop, alpha, beta)[criterion]
    else:
        others = transient_costs(loop, alpha, beta, (0.02,), overshoot=False)[criterion]
    assert len(others) > 20
    assert np.nanmin(others) >= best.cost * (1 - 1e-9)


def test_the_soonest_rise_of_a_general_loop_is_the_ideal_one_along_its_edge():
    ideal, found = (optimal_point(loop(1e-3, 0.02, 1.5), "rise_time") for loop in (Loop, Loop))
    assert found.cost == pytest.approx(ideal.cost, rel=1e-9)
    assert not found.attained
    assert (found.alpha, found.beta) == pytest.approx((ideal.alpha, ideal.beta), rel=1e-5)  # flat there
