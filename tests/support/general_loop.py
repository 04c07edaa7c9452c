"""Normalised loops with lag, vibration mode and velocity filter, by the numbers of Table 3.1."""

from __future__ import annotations

from typing import Any

from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.loop.state_space import Plant


def general_loop(
    gamma: float, delta: float, delay: float, *, lag: float = 0.0, velocity: Any = None, **mode: Any
) -> NormalisedLoop:
    """Return a loop; ``mode`` has the fields of `Plant` that a vibration mode adds."""
    return NormalisedLoop(Plant(1.0, delta, gamma, lag, **mode), delay, velocity)


def vibration(load_mass: float, spring: float, spring_damping: float, sensor_at_load: bool) -> dict[str, Any]:
    """Return the numbers of a vibration mode by name."""
    return {
        "load_mass": load_mass,
        "spring": spring,
        "spring_damping": spring_damping,
        "sensor_at_load": sensor_at_load,
        "load_damping": 0.0,
    }
