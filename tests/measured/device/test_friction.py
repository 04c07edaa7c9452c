from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from simulated import FALCON, LWR, simulate, spectral_radius

from pipeline.base.errors import ParameterError
from pipeline.measured.device.friction import fit_balance
from pipeline.measured.signal.response import declare_edge, find_response
from pipeline.records.batch import TrialBatch

ALL = ("damping", "friction", "offset", "spring")


def driven(
    n=40, *, mass=0.58, b=4.0, c=0.0, o=0.0, k=0.0, gravity=0.0, T=1e-3, rows=800, edge=20, quantum=0.0, noise=0.0,
    shake=0.0, stamps=0.0, constant=False, seed=0, fine=20,
):  # fmt: skip
    """Open-loop trials under a step plus two sines, with friction, by small steps of a velocity Verlet scheme.

    ``shake`` is the standard deviation of a force that the log does not show, held for 20 rows; ``stamps`` the
    relative scatter of the time between rows.
    """
    random = np.random.default_rng(seed)
    dt = T * (1 + stamps * random.uniform(-1, 1, (n, rows)))
    time = np.cumsum(dt, axis=1) - dt[:, :1]
    turn = random.uniform(0, 2 * np.pi, (2, n, 1))
    swing = 0 * time if constant else 6 * np.sin(40 * time + turn[0]) + 4 * np.sin(97 * time + turn[1])
    force = np.where(np.arange(rows) >= edge, 3.0 + swing, 0.0)
    hidden = np.repeat(shake * random.standard_normal((n, rows // 20 + 1)), 20, axis=1)[:, :rows]
    x, v = np.zeros(n), np.zeros(n)
    position = np.zeros((n, rows))

    def acceleration(x, v, u):
        return (u - b * v - c * np.tanh(v / 1e-4) - o - k * x - gravity * np.sin(x)) / mass

    for i in range(rows):
        seen = x + noise * random.standard_normal(n)
        position[:, i] = np.round(seen / quantum) * quantum if quantum else seen
        if i < edge:
            continue
        h = dt[:, min(i + 1, rows - 1)] / fine
        for _ in range(fine):
            half = v + 0.5 * h * acceleration(x, v, force[:, i] + hidden[:, i])
            x = x + h * half
            v = half + 0.5 * h * acceleration(x, half, force[:, i] + hidden[:, i])
    zero = np.zeros(n)
    return TrialBatch(
        tuple(f"t{i}" for i in range(n)), zero, zero, np.full(n, 3.0), np.full(n, T), np.full(n, rows), time, force,
        position,
    )  # fmt: skip


def fitted(batch, terms, delay=0, **options):
    return fit_balance(batch, declare_edge(batch, find_response(batch), 20), delay, terms=terms, **options)


def course(dev):
    """Stable trials over the region of a device."""
    grid = np.meshgrid(np.linspace(500, 9000, 8), np.linspace(10, 100 if dev["mass"] > 0.5 else 40, 6))
    K, B = (a.ravel() for a in grid)
    stable = np.array([spectral_radius(k, b, **dev) < 0.99 for k, b in zip(K, B, strict=True)])
    return K[stable], B[stable]


@pytest.mark.parametrize("dev", [FALCON, {**FALCON, "mass": 1.0, "b": 34.0}, LWR])
def test_closed_loop_trials_with_damping(dev):
    batch = simulate(*course(dev), **dev)
    found = fit_balance(batch, find_response(batch), dev["delay"], terms=("damping",))
    assert set(found.reason) == {""}
    # the mean position of an interval is right to the fourth order of its motion, 1e-3 at these frequencies
    np.testing.assert_allclose(found.mass, dev["mass"], rtol=1e-3)
    np.testing.assert_allclose(found.coefficients[:, 0], dev["b"], atol=max(0.005 * dev["b"], 0.02))
    assert (found.attenuation == 0).all()
    assert (found.width_rows == 1).all()


TRUTH = {"damping": 4.0, "friction": 1.5, "offset": 0.8, "spring": 120.0}


@pytest.mark.parametrize("stamps", [0.0, 0.3])
def test_every_term_is_found_without_a_sensor(stamps):
    batch = driven(n=25, b=4.0, c=1.5, o=0.8, k=120.0, stamps=stamps, fine=40)
    found = fitted(batch, ALL)
    assert set(found.dropped) == {""}
    # a device that sticks for a few rows at a turning point is not described: single trials scatter about the
    # offset by 0.1, their median by a quarter of it
    np.testing.assert_allclose(np.median(found.mass), 0.58, rtol=0.005)
    np.testing.assert_allclose(np.median(found.coefficients, axis=0), list(TRUTH.values()), rtol=0.04)
    if stamps:
        even = dataclasses.replace(batch, time=np.broadcast_to(np.arange(800) * 1e-3, batch.time.shape))
        wrong = fitted(even, ALL)
        assert np.median(abs(wrong.mass - 0.58)) > 3 * np.median(abs(found.mass - 0.58))


def ratios(terms, truth, **device):
    """Scatter of mass and terms about the truth, in standard errors: 1 where these are right."""
    batch = driven(n=150, quantum=2e-5, noise=5e-6, seed=4, fine=10, **device)
    found = fitted(batch, terms)
    assert set(found.reason) == {""}
    values = np.column_stack([found.mass, found.coefficients])
    z = (values - [0.58, *truth]) / np.column_stack([found.mass_error, found.errors])
    return np.sqrt(np.median(z**2, axis=0) / 0.455)  # the median of a squared normal variable


@pytest.mark.parametrize("shake", [0.0, 0.3])
def test_standard_errors_hold_with_sensor_and_hidden_forces(shake):
    ratio = ratios(("damping", "spring"), [4.0, 120.0], k=120.0, shake=shake)
    # 150 trials tell a ratio to 10 %; a walk is told from one window to no better than 1.7 for what it carries longest
    assert (ratio > 0.5).all(), ratio
    assert (ratio < 1.8).all(), ratio


@pytest.mark.parametrize("shake", [0.0, 0.3])
def test_standard_errors_with_friction_tell_noise_and_not_what_sticks(shake):
    ratio = ratios(("damping", "friction"), [4.0, 1.5], c=1.5, shake=shake)
    assert (ratio > 0.5).all(), ratio
    assert (ratio < (1.4 if shake else 3.3)).all(), ratio


def test_uncorrected_friction_and_offset_show_in_the_mass():
    batch = driven(b=4.0, c=1.5, o=0.8)
    plain = np.median(fitted(batch, ("damping",)).mass)
    corrected = np.median(fitted(batch, ("damping", "friction", "offset")).mass)
    assert corrected == pytest.approx(0.58, rel=0.005)
    assert abs(plain / 0.58 - 1) > 0.03


def test_gravity_of_a_pendulum():
    batch = driven(mass=0.15, b=0.3, gravity=3.3, T=5e-3, rows=400)
    found = fitted(batch, ("damping", "gravity"))
    np.testing.assert_allclose(found.mass, 0.15, rtol=0.02)
    np.testing.assert_allclose(found.coefficients[:, 1], 3.3, rtol=0.02)


def test_a_coarse_quantum_needs_an_average():
    batch = driven(quantum=2e-4, seed=2)
    narrow, wide = fitted(batch, ("damping",), width_rows=1), fitted(batch, ("damping",))
    assert (wide.width_rows > 1).all()
    assert (wide.attenuation <= 0.005).all()
    # the share that the sensor takes is what is missing
    missing = 1 - np.median(narrow.mass) / 0.58
    assert missing > 0.03
    assert np.median(narrow.attenuation) == pytest.approx(missing, rel=0.3)
    assert np.median(wide.mass) == pytest.approx(0.58, rel=0.01)


def test_start_takes_up_an_unknown_delay():
    batch = simulate(*course(FALCON), **{**FALCON, "b": 0.0})
    response = find_response(batch)
    right = fit_balance(batch, response, 4, terms=("start",))
    np.testing.assert_allclose(right.coefficients[:, 0], 0.0, atol=1e-4)
    step = driven(constant=True)
    late = dataclasses.replace(step, position=np.pad(step.position, ((0, 0), (30, 0)))[:, :-30])
    found = fitted(late, ("damping", "start"), window_s=(0.035, np.inf))
    # 3 N for 30 ms; before, the device rests and the momentum that is missing still grows
    np.testing.assert_allclose(found.coefficients[:, 1], 3.0 * 30e-3, rtol=0.02)
    np.testing.assert_allclose(found.mass, 0.58, rtol=0.02)


def test_measured_force_beside_the_command():
    batch = driven()
    doubled = fitted(batch, ("damping",), force=2 * batch.command)
    np.testing.assert_allclose(doubled.mass, 2 * fitted(batch, ("damping",)).mass, rtol=1e-12)
    with pytest.raises(ParameterError, match="shape"):
        fitted(batch, ("damping",), force=batch.command[:, 1:])
    # a force that is read in the middle between two held ones is continuous: the trapezoid of it
    between = batch.command.copy()
    between[:, 1:] = 0.5 * (batch.command[:, 1:] + batch.command[:, :-1])
    read = fitted(batch, ("damping",), force=between, held=False)
    assert np.median(read.mass) == pytest.approx(0.58, rel=0.02)


def test_terms_that_a_trial_does_not_carry_are_dropped_with_a_reason():
    steady = fitted(driven(constant=True), ("damping", "offset"))
    assert all(text.startswith("offset is not told from") for text in steady.dropped)
    alone = fitted(driven(constant=True, n=3), ("offset",))
    assert set(alone.dropped) == {"offset is not told from a force that is nearly constant"}
    np.testing.assert_allclose(steady.mass, 0.58, rtol=0.005)
    # a device that moves one way only has friction and offset in one
    one_way = fitted(driven(constant=True, n=3, k=20.0, rows=200), ("friction", "damping", "spring"))
    assert set(one_way.dropped) == {"friction is not told from a force that is nearly constant"}
    np.testing.assert_allclose(one_way.mass, 0.58, rtol=0.005)
    both = fitted(driven(constant=True, rows=200), ("offset", "friction"))
    assert all("offset" in text for text in both.dropped)
    still = driven(n=1)
    still = dataclasses.replace(still, position=np.zeros_like(still.position))
    found = fitted(still, ALL)
    assert found.reason[0]
    assert "no friction acts" in found.dropped[0]


def test_reasons_and_errors():
    batch = simulate([3000.0], [50.0], **FALCON, baseline=0)
    assert "no baseline" in fit_balance(batch, find_response(batch), 4).reason[0]
    batch = driven(n=2)
    assert "at least 20" in fitted(batch, ("damping",), window_s=(0.0, 0.01)).reason[0]
    turned = dataclasses.replace(batch, position=-batch.position)
    assert "not above 0" in fitted(turned, ("damping",)).reason[0]
    for terms in (("damping", "damping"), ("drag",)):
        with pytest.raises(ParameterError, match="terms"):
            fitted(batch, terms)
    with pytest.raises(ParameterError, match="window"):
        fitted(batch, (), window_s=(0.2, 0.1))
    nothing = batch.select(np.zeros(2, bool))
    empty = fit_balance(nothing, find_response(nothing), 0, terms=ALL)
    assert empty.coefficients.shape == (0, 4)
