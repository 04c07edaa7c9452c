"""Growth from sample to sample of a `pipeline.Loop` by another road: SI, absolute coordinates, matrix exponentials.

The state holds positions and velocities of both masses, the actuator's force, the last positions, the last filtered
velocities, and the last commands. Nothing is shared with `pipeline` but the parameters of the loop.
"""

from __future__ import annotations

from math import floor
from typing import Any

import numpy as np
from scipy.linalg import expm, solve_discrete_are
from scipy.signal import butter, ss2tf

from pipeline import Loop


def filter_of(loop: Loop) -> tuple[np.ndarray, np.ndarray]:
    """Return b and a of the filter of (x_k - x_{k-1})/T in powers of 1/z, a[0] = 1; none if adaptive."""
    given: dict[str, Any] = dict(loop.velocity or {"kind": "foaw"})
    if given["kind"] in ("foaw", "levant"):
        return np.ones(1), np.ones(1)
    if given["kind"] == "difference":
        return np.full(given["samples"], 1 / given["samples"]), np.ones(1)
    if given["kind"] == "butterworth":
        return butter(given["order"], given["cutoff_hz"], fs=1 / loop.sampling_period_s)
    if given["kind"] == "kalman":
        return _kalman(loop.sampling_period_s, given["acceleration"], given["noise"])
    return np.array(given["b"]) / given["a"][0], np.array(given["a"]) / given["a"][0]


def _kalman(T: float, acceleration: float, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the filter by its Riccati equation: a white acceleration, held over each sample, and white noise."""
    push, turn, sensor = np.array([[T**2 / 2], [T]]), np.array([[1.0, T], [0.0, 1.0]]), np.array([[1.0, 0.0]])
    ahead = solve_discrete_are(turn.T, sensor.T, acceleration**2 * push @ push.T, np.array([[noise**2]]))
    gain = ahead @ sensor.T / (sensor @ ahead @ sensor.T + noise**2)
    # v = (0 1) of the corrected state, driven by positions: (I - gain sensor) turn
    loop = (np.eye(2) - gain @ sensor) @ turn
    b, a = ss2tf(loop, gain, loop[1:2], gain[1:2])
    return np.polydiv(b[0], [1 / T, -1 / T])[0], a  # over the difference (1 - 1/z)/T, of which b has the zero


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


def added_force(loop: Loop) -> np.ndarray:
    """Return the column by which a command in addition to the wall's leads to the next state."""
    device, whole = continuous(loop)[0] * loop.sampling_period_s, floor(loop.delay_samples)
    b, a = filter_of(loop)
    result = np.zeros(5 + len(b) + len(a) - 1 + whole + 1)
    result[5 + len(b) + len(a) - 1] = 1.0
    if whole == 0:
        result[:5] = expm(device * (1 - loop.delay_samples))[:5, 5]
    return result


def used_states(loop: Loop, count: int) -> np.ndarray:
    """Return which states a loop has."""
    used = np.ones(count, bool)
    used[2:4], used[4] = bool(loop.mode), loop.actuator_lag_s > 0
    return used


def step_response(loop: Loop, stiffness: float, damping: float, rows: int) -> np.ndarray:
    """Return the sensed position at each sample after a unit step of the command at sample 0, shape (rows,)."""
    turn, push, sensor = matrix(loop, stiffness, damping), added_force(loop), continuous(loop)[1]
    state, result = np.zeros(len(turn)), []
    for _ in range(rows):
        result.append(state[sensor])
        state = turn @ state + push
    return np.array(result)


def radius(loop: Loop, stiffness: float, damping: float) -> float:
    """Return the largest size of a pole; states of parts that the loop has not are none."""
    full = matrix(loop, stiffness, damping)
    used = used_states(loop, len(full))
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


def needed_damping(loop: Loop, stiffness: float, damping: float, angles: int = 240, aliases: int = 400) -> float:
    """Return the damping of the motor that makes a wall passive, by sums over aliases; right to 0.1 %.

    Position and delayed force meet in samples, so that a motion of the frequency w answers with all w + 2 pi n/T
    (docs/definitions.md, Hulin 2017, ch. 4).
    """
    T, (b, a), d = loop.sampling_period_s, filter_of(loop), loop.delay_samples
    w = np.linspace(0.02, np.pi, angles)  # rad/sample
    u = np.exp(-1j * w)
    rate = (1 - u) / T * np.polyval(b[::-1], u) / np.polyval(a[::-1], u)
    y = loop.force_gain * (1 - u) * (stiffness + damping * rate)
    all_w = w[:, None] + 2 * np.pi * np.arange(-aliases, aliases + 1)
    late = np.exp(-1j * all_w * d) / (1 + 1j * all_w * loop.actuator_lag_s / T)
    s0, s1, s2 = ((each / all_w**2).sum(axis=1) for each in (np.ones_like(all_w), late, np.abs(late) ** 2))
    real = (y * s1).real
    return float(np.max(0.5 * (real + np.sqrt(real**2 + np.abs(y) ** 2 * (s0 * s2 - np.abs(s1) ** 2)))) * T)
