from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from simulated import FALCON, LWR, simulate, spectral_radius

from pipeline.base.errors import ParameterError
from pipeline.measured.device.mass import by_momentum, correct
from pipeline.measured.signal.response import find_response

FIRM = {**FALCON, "mass": 1.0, "b": 34.0}


def course(dev, top, spread=13):
    """Stable trials over the whole region of a device."""
    grid = np.meshgrid(np.linspace(200, top, spread), np.linspace(0, 180 if dev["mass"] > 0.5 else 55, spread))
    K, B = (a.ravel() for a in grid)
    stable = np.array([spectral_radius(k, b, **dev) < 1 for k, b in zip(K, B, strict=True)])
    return K[stable], B[stable]


@pytest.mark.parametrize(("dev", "top"), [(FALCON, 13600.0), (FIRM, 29000.0), (LWR, 11800.0)])
def test_corrected_mass_is_the_true_one_over_the_whole_region(dev, top):
    batch = simulate(*course(dev, top), **dev)
    found = by_momentum(batch, find_response(batch), dev["delay"])
    assert set(found.reason) == {""}
    np.testing.assert_allclose(correct(found, dev["b"]), dev["mass"], rtol=1e-5)


def test_uncorrected_mass_has_its_analytic_bias():
    # a free mass under a constant force from t = 0 has v = F/b (1 - exp(-b t/m)); the balance gives F t/v.
    # K = B = 0 keeps the command constant; the last interval lies about t = (15 - 4 - 1/2) samples.
    batch = simulate([0.0], [0.0], **FALCON)
    found = by_momentum(batch, find_response(batch), 4)
    t = (15 - 4 - 0.5) * 1e-3
    bias = (4 / 0.58 * t) / -np.expm1(-4 / 0.58 * t) - 1
    assert found.mass_momentum[0] / 0.58 - 1 == pytest.approx(bias, rel=5e-3)
    assert found.damping_share[0] == pytest.approx((0.58 * bias) / 4, rel=5e-3)


def test_bias_over_experiment_1_is_as_known():
    batch = simulate(*course(FALCON, 13600.0, 25), **FALCON)
    bias = by_momentum(batch, find_response(batch), 4).mass_momentum / 0.58 - 1
    assert bias.min() == pytest.approx(0.038, abs=0.004)
    assert np.median(bias) == pytest.approx(0.05, abs=0.01)


@pytest.mark.parametrize("jitter", [(), (3, 4, 5)])
def test_sensor_and_jitter_leave_the_median(jitter):
    batch = simulate(*course(FALCON, 12000.0, 22), **FALCON, quantum=2e-6, noise=5e-7, jitter=jitter)
    mass = correct(by_momentum(batch, find_response(batch), 4), 4.0)
    # jitter shifts the impulse of a trial by up to a sample of ten
    assert np.nanmedian(mass) == pytest.approx(0.58, rel=0.03 if jitter else 0.01)


def test_scales_with_force():
    light = simulate([3000.0], [50.0], **FALCON)
    heavy = dataclasses.replace(
        light,
        command=3 * light.command,
        stiffness=3 * light.stiffness,
        damping=3 * light.damping,
        step=3 * light.step,
    )
    one, three = (by_momentum(b, find_response(b), 4).mass_momentum for b in (light, heavy))
    np.testing.assert_allclose(three, 3 * one, rtol=1e-12)


def test_reasons():
    batch = simulate([3000.0], [50.0], **FALCON)
    response = find_response(batch)
    no_edge = simulate([3000.0], [50.0], **FALCON, baseline=0)
    assert "no baseline" in by_momentum(no_edge, find_response(no_edge), 4).reason[0]
    short = simulate([3000.0], [50.0], **FALCON, rows=34)
    assert "ends earlier" in by_momentum(short, find_response(short), 4).reason[0]
    assert "fills it" in by_momentum(batch, response, 40).reason[0]
    coarse = simulate([3000.0], [50.0], **FALCON, quantum=5e-5)
    assert "noise threshold" in by_momentum(coarse, find_response(coarse), 4).reason[0]
    time = batch.time.copy()
    time[0, 25:] += 2e-5
    assert "differ from T" in by_momentum(dataclasses.replace(batch, time=time), response, 4).reason[0]
    time = batch.time.copy()
    time[0, 100:] += 2e-5
    assert by_momentum(dataclasses.replace(batch, time=time), response, 4).reason == ("",)
    turned = dataclasses.replace(batch, position=2 * batch.position[:, :1] - batch.position)
    assert "opposite signs" in by_momentum(turned, response, 4).reason[0]
    with pytest.raises(ParameterError):
        by_momentum(batch, response, -1)
