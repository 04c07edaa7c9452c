"""Methods of scipy and python-control, measured where they are installed; nothing else of the theory uses them."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np

from pipeline.records.batch import Floats
from pipeline.studies.accuracy.methods import (
    Case,
    Sampled,
    TransferOf,
    generator,
    matrices,
    printed_transfer,
    step_state,
)


def load(name: str) -> Any:
    """Return an optional module, or None where it is not installed."""
    try:
        return import_module(name)
    except ImportError:
        return None


def plant_by_scipy_expm(linalg: ModuleType, gamma: float, delta: float) -> Sampled:
    """Return the sampled plant from `scipy.linalg.expm`."""
    return Sampled.of(linalg.expm(generator(gamma, delta)))


def plant_by_scipy_signal(signal: ModuleType, gamma: float, delta: float) -> Sampled:
    """Return the sampled plant from `scipy.signal.cont2discrete`, zero-order hold."""
    g = generator(gamma, delta)
    a, b, *_ = signal.cont2discrete((g[:2, :2], g[:2, 2:], np.eye(2), np.zeros((2, 1))), 1.0, method="zoh")
    return Sampled(np.asarray(a), np.asarray(b)[:, 0])


def response_by_dlsim(signal: ModuleType, case: Case, alpha: Floats, beta: Floats, samples: int) -> Floats:
    """Return the deviation at the samples of a step from `scipy.signal.dlsim`, shape (samples, n)."""
    rest, start = np.zeros((samples, 1)), step_state(case.delay)
    found = (signal.dlsim(system, rest, x0=start)[1] for system in _systems(case, alpha, beta))
    return np.array([np.asarray(position)[:, 0] for position in found]).T


def plant_by_control(control: ModuleType, gamma: float, delta: float) -> Sampled:
    """Return the sampled plant from `control.c2d`, zero-order hold."""
    g = generator(gamma, delta)
    system = control.c2d(control.ss(g[:2, :2], g[:2, 2:], np.eye(2), np.zeros((2, 1))), 1.0, method="zoh")
    return Sampled(np.asarray(system.A), np.asarray(system.B)[:, 0])


def radius_by_control_states(control: ModuleType, case: Case, alpha: Floats, beta: Floats) -> Floats:
    """Return spectral radii from the poles of python-control state spaces."""
    return np.array([np.abs(control.ss(*system).poles()).max() for system in _systems(case, alpha, beta)])


def radius_by_control_transfer(
    control: ModuleType, case: Case, alpha: Floats, beta: Floats, transfer: TransferOf = printed_transfer
) -> Floats:
    """Return spectral radii from python-control transfer functions with `feedback`."""
    n1, n0, trace, det = transfer(case.gamma, case.delta)
    plant = control.tf([n1, n0], [1.0, -trace, det, *[0.0] * case.delay], 1.0)
    radii = []
    for a, b in zip(alpha.tolist(), beta.tolist(), strict=True):
        loop = control.feedback(plant, control.tf([a + b, -b], [1.0, 0.0], 1.0))
        radii.append(float(np.abs(loop.poles()).max()))
    return np.array(radii)


def response_by_control(control: ModuleType, case: Case, alpha: Floats, beta: Floats, samples: int) -> Floats:
    """Return the deviation at the samples of a step from `control.forced_response`, shape (samples, n)."""
    rest = np.arange(samples), np.zeros(samples), step_state(case.delay)
    found = (control.forced_response(control.ss(*system), *rest) for system in _systems(case, alpha, beta))
    return np.array([np.ravel(motion.outputs) for motion in found]).T


def _systems(case: Case, alpha: Floats, beta: Floats) -> Iterator[tuple[Any, ...]]:
    """State spaces (A, B, C, D, T) of the loop without input, whose output is the position."""
    size = case.delay + 3
    for matrix in matrices(case, alpha, beta):
        yield matrix, np.zeros((size, 1)), np.eye(1, size), np.zeros((1, 1)), 1.0
