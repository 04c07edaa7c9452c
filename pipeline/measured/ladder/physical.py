"""The numbers of a fitted device in SI, with what the trials leave open of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.measured.ladder.device import Device
from pipeline.records.batch import Floats

DIFFERENCE = 1e-6
"""Change of a number by which a derivative is taken; all are smooth."""


@dataclass(frozen=True, eq=False)
class Numbers:
    """Numbers of a device by name in SI, and their covariance in the same order."""

    names: tuple[str, ...]
    values: Floats
    covariance: Floats


def in_si(device: Device, covariance: Floats, sampling_period_s: float) -> Numbers:
    """Return mass, damping and all that a device has in SI.

    Parameters
    ----------
    device : Device
    covariance : float64, shape (P, P)
        Of its numbers.
    sampling_period_s : float
        T [s].

    Notes
    -----
    Names are those of a device file, as far as they are in one: ``mass`` and ``damping`` of all that moves, per unit of
    command, ``stiffness``, ``delay_samples``, ``actuator_lag_s``, ``constant_force``; of a mode
    ``frequency_hz`` (free-free), ``damping_ratio``, ``far_mass``; ``force_limit`` of the drive.
    """
    values = _in_si(device, sampling_period_s)
    slopes = np.zeros((len(values), len(device.names)))
    for i in range(len(device.names)):
        changed = device.values
        changed[i] += DIFFERENCE * max(abs(changed[i]), 1e-3)
        other = Device(dict(zip(device.names, changed.tolist(), strict=True)), device.sensor)
        change = np.array(list(_in_si(other, sampling_period_s).values())) - np.array(list(values.values()))
        slopes[:, i] = change / (changed[i] - device.values[i])
    return Numbers(tuple(values), np.array(list(values.values())), slopes @ covariance @ slopes.T)


def _in_si(device: Device, T: float) -> dict[str, float]:
    n = device.numbers
    mass = T**2 / float(np.exp(n["gain"]))
    found = {"mass": mass, "damping": n["delta"] * mass / T, "delay_samples": n["delay"]}
    if "gamma" in n:
        found["stiffness"] = n["gamma"] * mass / T**2
    if "lag" in n:
        found["actuator_lag_s"] = n["lag"] * T
    if "force" in n:
        found["constant_force"] = n["force"]
    if "bound" in n:
        found["force_limit"] = float(np.exp(n["bound"]))
    if device.sensor:
        found["frequency_hz"] = float(np.exp(n["turn"])) / (2 * np.pi * T)
        found["damping_ratio"] = float(np.exp(n["ratio"]))
        found["far_mass"] = mass / (1 + float(np.exp(-n["share"])))
    return found
