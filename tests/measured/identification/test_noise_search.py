"""The likeliest noise against a search without derivatives, and devices that cannot be computed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from pipeline.base.errors import ParameterError
from pipeline.device_data.devices import load_device
from pipeline.measured.identification import identified as identification
from pipeline.measured.identification.identified import identified
from pipeline.measured.identification.likelihood import fitted
from pipeline.measured.identification.noise import WHITE
from pipeline.measured.identification.noise_search import (
    JITTERS,
    READINGS,
    NoiseCost,
    noise_and_jitter,
    with_jitter_error,
)
from pipeline.measured.identification.recordings import Recording
from pipeline.simulation.sweep import run_sweep


@pytest.fixture(scope="module")
def fit():
    """Segments of a device whose delay jitters, and the device."""
    course = run_sweep(load_device("falcon"), "1", seed=4, coarsen=8)
    logs = [
        Recording(each.trial_id, each.time, each.command, each.position, 1e-3) for each in list(course.trials)[5:25]
    ]
    choice = identified(logs).choice
    return choice.segments, replace(choice.fit.device, effects=None)


def test_no_other_jitter_is_likelier(fit):
    segments, device = fit
    noise = noise_and_jitter(segments, replace(device, noise=WHITE), jitters=True)
    cost = NoiseCost.of(segments, device)
    reading = device.numbers["gain"] ** 2 / (noise.late * cost.white)
    bounds = np.log([JITTERS, READINGS])

    def lost(logs):
        return cost(noise.force, *np.exp(np.clip(logs, bounds[:, 0], bounds[:, 1])))

    start = np.log([noise.jitter, reading])
    simplex = start + 0.2 * np.array([[0, 0], [1, 0], [0, 1]])
    best = minimize(lost, start, method="Nelder-Mead", options={"initial_simplex": simplex, "xatol": 1e-3})
    assert lost(start) - best.fun < 0.3
    assert noise.jitter == pytest.approx(np.exp(best.x[0]), rel=0.03)


def test_the_error_of_a_jitter_is_that_of_its_likelihood_wherever_the_device_moved(fit):
    segments, device = fit
    noise = noise_and_jitter(segments, replace(device, noise=WHITE), jitters=True)
    errors = []
    for share in (0.95, 1.0, 1.05):
        near = replace(noise, jitter=share * noise.jitter)
        errors.append(with_jitter_error(segments, replace(device, noise=near)).jitter_error / near.jitter)
    assert max(errors) < 2 * min(errors)
    assert 0.01 < errors[1] < 0.15


def test_a_device_that_overflows_has_no_likelihood(fit):
    segments, device = fit
    places = np.empty(0, dtype=np.int64)
    wild = replace(device, numbers=device.numbers | {"delta": -40.0})
    assert fitted(segments, wild, places).likelihood == -np.inf
    assert np.isfinite(fitted(segments, device, places).likelihood)


def test_equations_without_a_solution_are_an_error_with_a_remedy(monkeypatch):
    def unsolvable(_):
        raise np.linalg.LinAlgError("Eigenvalues did not converge.")

    monkeypatch.setattr(identification, "choose_parts", unsolvable)
    time = np.arange(200) * 1e-3
    log = Recording("1", time, np.where(time > 0.02, 1.0, 0.0), time**2, 1e-3)
    with pytest.raises(ParameterError, match=r"no single device fits these logs.*record more trials"):
        identified([log])
