"""Growth from sample to sample of a `pipeline.Loop` by another road: SI, absolute coordinates, matrix exponentials.

The state holds positions and velocities of both masses, the actuator's force, the last positions, the last filtered
velocities, and the last commands. Nothing is shared with `pipeline` but the parameters of the loop.
"""

from __future__ import annotations

from math import floor
from typing import Any

import numpy as np
from scipy.linalg import expm
from scipy.signal import butter

from pipeline import Loop


def filter_of(loop: Loop) -> tuple[np.ndarray, np.ndarray]:
    """Return b and a of the filter of (x_k - x_{k-1})/T in powers of 1/z, a[0] = 1."""
    given: dict[str, Any] = dict(loop.velocity or {"kind": "difference", "samples": 1})
    if given["kind"] == "difference":
        return np.full(given["samples"], 1 / given["samples"]), np.ones(1)
    if given["kind"] == "butterworth":
        return butter(given["order"], given["cutoff_hz"], fs=1 / loop.sampling_period_s)
    return np.array(given["b"]) / given["a"][0], np.array(given["a"]) / given["a"][0]


def continuous(loop: Loop) -> tuple[np.ndarray, int]:
    """Return the matrix of near and far position and velocity and force, with the command as last state; the sensor."""
    mode, hand, lag = dict(loop.mode or {}), dict(loop.operator or {}), loop.actuator_lag_s
    far, of_load = float(mode.get("mass", 0.0)), float(mode.get("load_damping", 0.0))
    near = loop.mass - far + float(hand.get("mass", 0.0))
    held = loop.stiffness + float(hand.get("stiffness", 0.0))
    lost = loop.damping - of_load + float(hand.get("damping", 0.0))
    result = np.zeros((6, 6))
    result[0, 1] = result[2, 3] = 1.0
    result[1, :2] = -held / near, -lost / near
    if mode:
        turn, reduced = 2 * np.pi * mode["frequency_hz"], far * (loop.mass - far) / loop.mass
        spring, damper = reduced * turn**2, 2 * mode["damping_ratio"] * turn * reduced
        pull = np.array([spring, damper, -spring, -damper])
        result[1, :4] -= pull / near
        result[3, :4] += pull / far
        result[3, 3] -= of_load / far
    if lag:
        result[1, 4], result[4, 4], result[4, 5] = 1 / near, -1 / lag, loop.force_gain / lag
    else:
        result[1, 5] = loop.force_gain / near
    return result, 2 if mode.get("sensor") == "load" else 0


def matrix(loop: Loop, stiffness: float, damping: float) -> np.ndarray:
    """Return the matrix that leads the state from one sample to the next."""
    T, (device, sensor), (b, a) = loop.sampling_period_s, continuous(loop), filter_of(loop)
    whole = floor(loop.delay_samples)
    late = loop.delay_samples - whole
    first, second = expm(device * T * late), expm(device * T * (1 - late))
    past, speeds = len(b), len(a) - 1
    n = 5 + past + speeds + whole + 1
    at_position, at_speed, at_command = 5, 5 + past, 5 + past + speeds
    place = np.zeros((past + 1, n))  # x_k, x_{k-1}, ...
    place[0, sensor] = 1.0
    place[1:, at_position:at_speed] = np.eye(past)
    speed = b @ (place[:-1] - place[1:]) / T
    speed[at_speed:at_command] -= a[1:]
    commands = np.zeros((whole + 2, n))  # u_k, u_{k-1}, ..., u_{k-whole-1}
    commands[0] = -stiffness * place[0] - damping * speed
    commands[1:, at_command:] = np.eye(whole + 1)
    now = np.eye(5, n)
    for move, command in ((first, commands[whole + 1]), (second, commands[whole])):
        now = move[:5, :5] @ now + np.outer(move[:5, 5], command)
    rows = [now, place[:-1]] + ([speed[None], np.eye(n)[at_speed : at_command - 1]] if speeds else []) + [commands[:-1]]
    return np.vstack(rows)


def radius(loop: Loop, stiffness: float, damping: float) -> float:
    """Return the largest size of a pole; states of parts that the loop has not are none."""
    full = matrix(loop, stiffness, damping)
    used = np.ones(len(full), bool)
    used[2:4], used[4] = bool(loop.mode), loop.actuator_lag_s > 0
    return float(np.abs(np.linalg.eigvals(full[np.ix_(used, used)])).max())


def largest_stable(loop: Loop, damping: float, top: float, looks: int = 200) -> float:
    """Return the stiffness up to which every softer wall is stable, to a part of ``top``; 0 where no soft one is."""
    shares = np.geomspace(1e-4, 1.0, looks)
    stable = [radius(loop, top * float(share), damping) < 1 for share in shares]
    if not stable[0]:
        return 0.0
    if all(stable):
        return top
    at = stable.index(False)
    low, high = top * float(shares[at - 1]), top * float(shares[at])
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if radius(loop, middle, damping) < 1 else (low, middle)
    return low
