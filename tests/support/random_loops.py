"""Loops with random parts, as entries of a device file: for comparisons of two programs of the same theory."""

from __future__ import annotations

import math
from typing import Any

import numpy as np


def random_loop(rng: np.random.Generator) -> dict[str, Any]:
    """Return the entries of a device file with each part present by chance."""
    period = float(10 ** rng.uniform(-4, -2.3))
    mass = float(10 ** rng.uniform(-1.7, 1.3))
    damping = 0.0 if rng.random() < 0.15 else mass / period * float(10 ** rng.uniform(-3.5, -0.7))
    whole = float(rng.integers(0, 9))
    loop: dict[str, Any] = {
        "mass": mass,
        "damping": damping,
        "stiffness": mass / period**2 * float(10 ** rng.uniform(-5, -2)) if rng.random() < 0.3 else 0.0,
        "sampling_period_s": period,
        "delay_samples": whole + (float(rng.uniform(0.02, 0.98)) if rng.random() < 0.5 else 0.0),
        "motion": "rotation" if rng.random() < 0.3 else "translation",
    }
    parts: dict[str, Any] = {}
    if rng.random() < 0.4:
        parts["actuator_lag_s"] = period * float(10 ** rng.uniform(-1, 0.8))
    if rng.random() < 0.4:
        parts["force_gain"] = float(10 ** rng.uniform(-0.5, 0.5))
    if rng.random() < 0.6:
        parts["velocity"] = _filter(rng, period)
    if rng.random() < 0.4:
        far = mass * float(rng.uniform(0.05, 0.8))
        parts["mode"] = {
            "frequency_hz": float(10 ** rng.uniform(-1.8, -0.5)) / period,
            "damping_ratio": float(10 ** rng.uniform(-2.5, -0.7)),
            "mass": far,
            "sensor": "load" if rng.random() < 0.3 else "motor",
            "load_damping": damping * float(rng.uniform(0, 1)) if rng.random() < 0.5 else 0.0,
        }
    if rng.random() < 0.4:
        parts["operator"] = {
            "mass": mass * float(10 ** rng.uniform(-1.5, 0.3)),
            "damping": mass / period * float(10 ** rng.uniform(-4, -1)),
            "stiffness": mass / period**2 * float(10 ** rng.uniform(-6, -3)),
        }
    return loop | {"loop": parts}


def _filter(rng: np.random.Generator, period: float) -> dict[str, Any]:
    kind = rng.choice(["difference", "butterworth", "coefficients", "kalman"])
    if kind == "difference":
        return {"kind": "difference", "samples": int(rng.integers(1, 9))}
    if kind == "butterworth":
        cutoff = float(10 ** rng.uniform(-2, -0.35)) / period
        return {"kind": "butterworth", "order": int(rng.integers(1, 5)), "cutoff_hz": cutoff}
    if kind == "kalman":
        noise = 1e-6
        return {"kind": "kalman", "acceleration": noise / period**2 * float(10 ** rng.uniform(-2, 1)), "noise": noise}
    radius, angle = float(rng.uniform(0.1, 0.9)), float(rng.uniform(0, math.pi / 2))
    a = [1.0, -2 * radius * math.cos(angle), radius**2]
    b = [float(value) for value in rng.uniform(0.1, 1, 3)]
    return {"kind": "coefficients", "b": [value * sum(a) / sum(b) for value in b], "a": a}
