"""Hard loops and the truth of their costs (make_reference.py): `scipy.integrate.solve_ivp`, hold by hold.

Nothing of the package's own loop or theory is used here: both masses, spring, lag and filter are written down anew, in
absolute positions, and each sampling interval follows from the one before. The loops are those at which a method may
stop too early or lose its digits: bursts behind a long delay, low cut-offs, heavy far masses, fast lags.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import floor

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.signal import butter

from pipeline.records.trials import Floats

_PLACES = 24
"""Places of each hold at which the motion is looked at: it turns at most once between two of them."""

_FAINT = 1e-6
"""Deviation and way between two places below which an extremum is not looked for."""


@dataclass(frozen=True)
class HardLoop:
    """A loop with its wall for a mass of 1 and a period of 1, how long it is followed, and what it has beside these.

    ``far_mass`` hangs on ``spring`` and ``damper``; ``cutoff`` (per sampling rate) and ``order`` are of a Butterworth
    filter.
    """

    alpha: float
    beta: float
    gamma: float
    delta: float
    delay: float
    samples: int
    lag: float = 0.0
    far_mass: float = 0.0
    spring: float = 0.0
    damper: float = 0.0
    cutoff: float = 0.0
    order: int = 2

    @property
    def sections(self) -> Floats:
        """Sections of the velocity filter of order two, rows b and a: poles of low cut-offs keep their digits."""
        return np.asarray(butter(self.order, 2 * self.cutoff, output="sos") if self.cutoff else np.zeros((0, 6)))

    def rates(self) -> Floats:
        """Return the matrix of the rates of position and velocity (both sides), applied force, command."""
        m, force = 1 - self.far_mass, 4 if self.lag else 5
        result = np.zeros((6, 6))
        result[0, 1] = result[2, 3] = 1.0
        result[1] = np.array([-self.gamma, -self.delta, 0, 0, 0, 0]) / m
        result[1, force] += 1 / m
        if self.far_mass:
            pull = np.array([self.spring, self.damper, -self.spring, -self.damper, 0, 0])
            result[1] -= pull / m
            result[3] = pull / self.far_mass
        if self.lag:
            result[4, 4:] = -1 / self.lag, 1 / self.lag
        return result


HARD_LOOPS = {
    "burst behind 66 samples": HardLoop(
        0.1221341147932547, 36.553834416624824, 185.4110375532084, 26.652630181637893, 66.0, 1400
    ),
    "burst behind 31.5 samples": HardLoop(0.02, 6.0, 20.0, 8.0, 31.5, 1400),
    "cut-off 10 Hz of order 4": HardLoop(2e-4, 2e-3, 0.0, 0.02, 1.0, 4000, cutoff=0.01, order=4),
    "heavy far mass": HardLoop(2e-4, 4e-3, 0.0, 0.02, 2.0, 4000, far_mass=0.95, spring=0.02, damper=2e-3),
    "near side of 1e-5": HardLoop(1e-3, 2e-3, 0.0, 0.01, 0.4, 4000, far_mass=1 - 1e-5, spring=0.05, damper=0.02),
    "lag of 0.01 samples": HardLoop(0.05, 0.3, 1e-3, 0.05, 1.3, 1500, lag=0.01),
}
"""By name; each settles within the samples that it is followed."""


def followed(loop: HardLoop, band: float = 0.01, tolerance: float = 1e-13) -> dict[str, float]:
    """Return settling time [samples] and overshoot of the exact motion, and energies of the samples by weight.

    Parameters
    ----------
    loop : HardLoop
    band : float
        Half width of the settling band.
    tolerance : float
        Relative one of the integration; the costs are good to some hundred times that.

    Notes
    -----
    Keys: ``settle``, ``overshoot``, ``energy_w0`` to ``energy_w2``.

    Source: Hulin 2017, eqs. 3.1 to 3.3, 5.10 to 5.14; docs/definitions.md, "Devices that are not ideal".
    """
    whole = floor(loop.delay)
    late = loop.delay - whole
    holds = [(late, whole + 1), (1 - late, whole)] if late else [(1.0, whole)]
    matrix = loop.rates()
    flows = {duration: _flow(matrix, duration, loop.lag, tolerance) for duration, _ in holds}
    sections, state, before = loop.sections, np.zeros(6), 0.0
    held = np.zeros((len(sections), 2))
    forces, step = np.zeros(whole + 2), loop.alpha + loop.gamma
    sampled, settled, largest, entry = [], 0.0, 0.0, None
    for k in range(loop.samples):
        position = state[0]
        sampled.append(position - 1)
        speed, before = position - before, position
        for kept, (b0, b1, b2, _, a1, a2) in zip(held, sections, strict=True):
            given, speed = speed, b0 * speed + kept[0]
            kept[:] = b1 * given - a1 * speed + kept[1], b2 * given - a2 * speed
        forces = np.append(-loop.alpha * position - loop.beta * speed, forces[:-1])
        start = float(k)
        for duration, age in holds:
            places, motion = flows[duration]
            state[5] = step + forces[age]
            path = np.einsum("ipj,j->ip", motion, state)
            away, turns = path[0] - 1, np.flatnonzero(path[1, 1:] * path[1, :-1] < 0)
            found = [*zip(places, away, strict=True)]
            found += [_extreme(matrix, path, places, int(i), tolerance) for i in turns]
            found.sort()
            out = max((i for i, (_, e) in enumerate(found) if abs(e) > band), default=-1)
            if 0 <= out < len(found) - 1:
                entry = state.copy(), start, found[out][0], found[out + 1][0], np.sign(found[out][1]) * band
                settled = np.nan
            elif out >= 0:
                settled = start + duration
            largest = max(largest, max(e for _, e in found))
            state, start = path[:, -1], start + duration
    if np.isnan(settled) and entry is not None:
        last, start, low, high, level = entry
        settled = start + _root(lambda t: float(_moved(matrix, last, t, tolerance)[0] - 1 - level), low, high)
    e, weight = np.array(sampled), np.arange(loop.samples)
    energy = e**2 + np.diff(e, prepend=e[0]) ** 2 / step
    return {"settle": settled, "overshoot": largest, **{f"energy_w{w}": float(weight**w @ energy) for w in range(3)}}


def _flow(matrix: Floats, duration: float, lag: float, tolerance: float) -> tuple[Floats, Floats]:
    """Return places of a hold, denser where a fast lag settles, and the motion up to each, shape (6, places, 6)."""
    share = np.linspace(0, 1, _PLACES + 1)
    places = np.unique(np.append(share, share * min(1.0, 30 * lag / duration) if lag else 1.0)) * duration
    motions = [np.eye(6)]  # from place to place: solve_ivp is less exact between its steps
    for width in np.diff(places):
        motions.append(np.array([_moved(matrix, column, width, tolerance) for column in motions[-1].T]).T)
    return places, np.stack(motions, axis=1)


def _moved(matrix: Floats, state: Floats, time: float, tolerance: float) -> Floats:
    if time == 0:
        return state
    path = solve_ivp(lambda _, x: matrix @ x, (0, time), state, "DOP853", rtol=tolerance, atol=tolerance)
    return np.asarray(path.y[:, -1])


def _extreme(matrix: Floats, path: Floats, places: Floats, i: int, tolerance: float) -> tuple[float, float]:
    """Return time and deviation at which the motion turns after a place; a faint motion counts for no band."""
    start, width = path[:, i], places[i + 1] - places[i]
    if abs(start[0] - 1) + np.abs(path[1, i : i + 2]).max() * width < _FAINT:
        return float(places[i]), float(start[0] - 1)
    time = _root(lambda t: float(_moved(matrix, start, t, tolerance)[1]), 0.0, width)
    return float(places[i] + time), float(_moved(matrix, start, time, tolerance)[0] - 1)


def _root(function: Callable[[float], float], low: float, high: float) -> float:
    """Return the root between two places, or the first where rounding, or a rough tolerance, hides it."""
    return float(brentq(function, low, high, xtol=1e-12)) if function(low) * function(high) < 0 else low
