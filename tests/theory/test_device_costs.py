"""Costs of general loops: against fine integration with scipy, long sums in many digits, and plain iteration."""

from __future__ import annotations

from dataclasses import replace

import mpmath as mp
import numpy as np
import pytest
from general_devices import EXTREMES, ManyDigits, characteristic, random_device, schur_cohn
from general_loop import general_loop, vibration
from scipy.integrate import simpson
from scipy.interpolate import CubicHermiteSpline
from scipy.linalg import eig, expm, norm

import pipeline
from pipeline.device.parts import Butterworth
from pipeline.loop.normalised_loop import LoopUnits, NormalisedLoop
from pipeline.theory.boundary import limits, outline, stiffness_limit
from pipeline.theory.costs import point_costs_by_name
from pipeline.theory.energy import energy_costs
from pipeline.theory.optimum import optimal_point
from pipeline.theory.poles import spectral_radius
from pipeline.theory.settling_overshoot import LONGEST, transient_costs

RICH = general_loop(
    *(1e-4, 0.01, 2.4),
    lag=1.5,
    **vibration(0.3, 0.5, 0.01, sensor_at_load=True),
    velocity=Butterworth(kind="butterworth", order=2, cutoff_hz=0.08),
)


def a_wall(loop, share=0.4):
    found = outline(loop, 16)
    return np.array([share * found.alpha_max]), np.array([found.beta_at_alpha_max])


def fine(loop, alpha, beta, samples, steps=256):
    """Time [samples], sensed position and velocity of a step, at fine steps of scipy's exponential."""
    matrix, push, sensor = loop.device.matrix, loop.device.command, loop.device.sensor
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
    finely_right(
        general_loop(1e-4, 0.01, 2.375, lag=1.5, velocity=RICH.velocity, **vibration(0.3, 0.5, 0.01, sensor_far))
    )


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_costs_of_random_devices_equal_fine_integration(seed):
    rng = np.random.default_rng(100 + seed)
    while True:
        loop = NormalisedLoop.of(random_device(rng))
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


@pytest.mark.parametrize("extreme", ["", *EXTREMES])
def test_slowest_pole_in_many_digits(extreme):
    rng = np.random.default_rng(2)
    for _ in range(6):
        example = random_device(rng, extreme)
        loop = NormalisedLoop.of(example)
        if len(outline(loop, 8).beta):
            break
    alpha, beta = a_wall(loop, 0.5)
    units = LoopUnits.of(example)
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
    loop = general_loop(0.0, 0.02, 1.5, lag=0.7, velocity=Butterworth(kind="butterworth", order=1, cutoff_hz=0.1))
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


def iterated(
    near: float, stiffness: float, damping: float, delta: float, wall: tuple[float, float], far: bool, blow: bool
):
    """Discrete energy w = 0 of a response with one sample of delay, from the positions of both masses."""
    with mp.workdps(60):
        m, k, d = mp.mpf(near), mp.mpf(stiffness), mp.mpf(damping)
        rate = mp.matrix(5, 5)  # x1, v1, x2, v2, force on the first
        rate[0, 1] = rate[2, 3] = 1
        rate[1, 0], rate[1, 1], rate[1, 2], rate[1, 3], rate[1, 4] = -k / m, -(d + delta) / m, k / m, d / m, 1 / m
        rate[3, 0], rate[3, 1], rate[3, 2], rate[3, 3] = (v / (1 - m) for v in (k, d, -k, -d))
        step = mp.expm(rate)
        alpha, beta = (mp.mpf(v) for v in wall)
        start = 0 if blow else -1
        state = mp.matrix([start, 1 / m if blow else 0, start, 0])
        before, waiting, total = mp.mpf(start), -alpha * start, mp.mpf(0)
        for _ in range(4000):
            here = state[2 if far else 0]
            force, waiting = waiting, -alpha * here - beta * (here - before)
            state = step[:4, :4] * state + step[:4, 4] * force
            total += here**2 + (state[2 if far else 0] - here) ** 2 / alpha
            before = here
        return float(total * (alpha if blow else 1))


@pytest.mark.parametrize("far", [False, True])
@pytest.mark.parametrize("blow", [False, True])
@pytest.mark.parametrize("near", [1e-5, 0.3])
@pytest.mark.sampled
def test_energies_of_a_light_motor_side(near, blow, far):
    reduced = near * (1 - near)
    stiffness, damping = reduced * 0.3**2, 2 * 0.9 * 0.3 * reduced
    stiffness, damping = (stiffness, damping) if near > 0.1 else (2e-2, 8e-2)
    wall, delta = (1e-3, 0.05), 0.03
    loop = general_loop(0.0, delta, 1.0, **vibration(1 - near, stiffness, damping, far))
    assert np.abs(np.linalg.eigvals(loop.matrix(*(np.array([v]) for v in wall)))).max() < 0.995
    signal = "impulse" if blow else "step"
    found = energy_costs(loop, *wall, signal)[f"energy_{signal}_w0_discrete"][0]
    assert found == pytest.approx(iterated(near, stiffness, damping, delta, wall, far, blow), rel=1e-9)


def test_sums_that_rounding_keeps_from_their_equations_are_none():
    # a radius of 1 - 7e-12: mpmath with 70 digits has 6.311e10, four rounds of refinement told 6.552e12
    device = pipeline.Loop(
        mass=1.0,
        damping=17.250022087330652,
        sampling_period_s=0.001,
        delay_samples=5.0,
        stiffness=0.0,
        velocity={"kind": "butterworth", "order": 3, "cutoff_hz": 243.6823222407204},
        actuator_lag_s=0.0001802570302356224,
    )
    unit = device.units
    wall = [2.2239988459545563e-05 / unit.stiffness], [-17.250021954961706 / unit.damping]
    found = energy_costs(device.normalised_loop, *wall, "impulse")["energy_impulse_w0"]
    assert np.isnan(found[0]) or found[0] == pytest.approx(63110474678.73257, rel=1e-9)


@pytest.mark.slow
@pytest.mark.sampled
@pytest.mark.parametrize(("order", "cutoff"), [(4, 0.01), (4, 0.001), (3, 0.003), (2, 0.3)])
def test_every_wall_of_a_slow_filter_has_costs(order, cutoff):
    loop = general_loop(0, 1e-3, 2.0, velocity=Butterworth(kind="butterworth", order=order, cutoff_hz=cutoff))
    found, rng = outline(loop, 30), np.random.default_rng(17)
    beta = rng.uniform(found.beta[0], found.beta[-1], 35)
    alpha = limits(loop, beta).alpha * rng.uniform(0.05, 0.95, 35)
    radius = spectral_radius(loop, alpha, beta)
    found = energy_costs(loop, alpha, beta) | transient_costs(loop, alpha, beta, (0.02,))
    for name, values in found.items():
        # an overshoot that may still come after so many samples is not told
        assert (np.isfinite(values) | (found["settle_2pct"] > LONGEST) & ("overshoot" in name)).all(), name
    # the energies of a response by its own samples
    quick = np.flatnonzero(radius < 0.999)[:3]
    state, total = loop.starts(alpha[quick], "step"), np.zeros(len(quick))
    matrix = loop.matrix(alpha[quick], beta[quick])
    for _ in range(40_000):
        after = np.einsum("nij,nj->ni", matrix, state)
        total += state[:, 0] ** 2 + (after[:, 0] - state[:, 0]) ** 2 / alpha[quick]
        state = after
    np.testing.assert_allclose(energy_costs(loop, alpha, beta)["energy_step_w0_discrete"][quick], total, rtol=1e-9)


def test_the_soonest_rise_is_a_limit_at_the_edge():
    found = optimal_point(NormalisedLoop.ideal(1e-3, 0.02, 1.5), "rise_time")
    assert not found.attained
    assert found.alpha == pytest.approx(
        float(stiffness_limit(NormalisedLoop.ideal(1e-3, 0.02, 1.5), found.beta)[0]), rel=1e-9
    )


def test_many_bands_at_once_have_the_settling_times_of_each_alone():
    loop = pipeline.Loop(0.2, 0.5, 0.001, 2)
    names = ["overshoot", *(f"settle_{percent}pct_discrete" for percent in range(1, 31))]
    together = loop.points([4000.0], [50.0], names)
    alone = {name: float(loop.points([4000.0], [50.0], [name])[name].iloc[0]) for name in names}
    assert {name: float(together[name].iloc[0]) for name in names} == alone
