"""Panels of chapter 4: passive regions beside stable ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.loop.loop import Loop
from pipeline.records.batch import Floats
from pipeline.studies.figure import Area, Panel, Trace
from pipeline.studies.thesis.curves import ALPHA, BETA, DELAY, outline_trace
from pipeline.studies.thesis.outline import Window, outline_in
from pipeline.studies.thesis.stability import DELAY_SWEEP, DELTA, FAMILY, GAMMA
from pipeline.theory.stability.extent import maximum_stiffness, stiffest_point
from pipeline.theory.stability.passivity import (
    boundary_angle,
    maximum_passive_stiffness,
    passive_boundary,
    passive_to_stable,
)

SPRINGS = 41
"""Springs of Fig. 4.5, evenly from 0 to the Nyquist limit (4.15)."""

SPRING_DELAYS = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)
FAR = np.concatenate([np.linspace(0, 44, 23), np.linspace(52, 132, 6)])
"""Delay factors over which the passive stiffness reaches the stable one."""

_GAMMAS = {0.0: "solid", GAMMA: "dashed"}
_RATIO = "η, passive by stable"


def _passive(delay: float, unit: float = 1.0) -> tuple[Floats, Floats]:
    """Closed outline of the passive region in K T/b and B/b, times a unit."""
    stiffness, damping = passive_boundary(delay, np.linspace(0, boundary_angle(delay), 160))
    k, b = np.concatenate([[0.0], stiffness, [0.0, 0.0]]), np.concatenate([[-1.0], damping, [1.0, -1.0]])
    return unit * k, unit * b


def regions() -> Panel:
    """Return the passive regions over delay."""
    traces = [Trace(*_passive(d), colour, "solid", f"d = {d:g}") for d, colour in FAMILY.items()]
    ridge = Trace(*maximum_passive_stiffness(DELAY_SWEEP), "ink", "dashdot", "largest stiffness", width=1.1)
    return Panel("", "K T / b", "B / b", (-0.03, 2.1), (-1.08, 1.08), (*traces, ridge))


def largest() -> Panel:
    """Return the largest passive stiffness over delay."""
    line = Trace(DELAY_SWEEP, maximum_passive_stiffness(DELAY_SWEEP)[0], "green")
    return Panel("", DELAY, "largest passive K T / b", (0.0, 8.0), (0.0, 2.1), (line,))


def whole() -> Panel:
    """Return passive regions inside the stable ones."""
    top = stiffest_point(Loop(GAMMA, DELTA, 0.0))[0]
    return Panel("whole", ALPHA, BETA, (-0.02, 1.04 * top), (-0.1, 2.1), _nested())


def around_origin() -> Panel:
    """Return a close-up of the same."""
    return Panel("around the origin", ALPHA, BETA, (-0.002, 0.044), (-0.024, 0.05), _nested())


def _nested() -> tuple[Trace, ...]:
    traces = []
    for delay in FAMILY:
        first = delay == 0
        traces.append(outline_trace(Loop(GAMMA, DELTA, delay), "vermillion", "stable" if first else ""))
        traces.append(Trace(*_passive(delay, DELTA), "green", "dashed", "passive" if first else ""))
    stable = maximum_stiffness(DELAY_SWEEP, GAMMA, DELTA)
    stiff, damping = maximum_passive_stiffness(DELAY_SWEEP)
    traces.append(Trace(*stable, "vermillion", "dashdot", "stiffest stable", width=1.0))
    traces.append(Trace(DELTA * stiff, DELTA * damping, "green", "dashdot", "stiffest passive", width=1.0))
    return tuple(traces)


def both_largest() -> Panel:
    """Return the largest passive and stable stiffness over delay."""
    passive = DELTA * maximum_passive_stiffness(DELAY_SWEEP)[0]
    traces = [Trace(DELAY_SWEEP, passive, "green", "dashed", "passive")]
    for gamma, dash in _GAMMAS.items():
        alpha = maximum_stiffness(DELAY_SWEEP, gamma, DELTA)[0]
        traces.append(Trace(DELAY_SWEEP, alpha, "vermillion", dash, f"stable, γ = {gamma:g}"))
    return Panel("(a) largest stiffness", DELAY, "largest α", (0.0, 8.0), (0.0, 0.75), tuple(traces))


def ratio(title: str, delays: Floats, top: float) -> Panel:
    """Return the largest passive by the largest stable stiffness over delay."""
    traces = [
        Trace(delays, passive_to_stable(delays, gamma, DELTA), "blue", dash, f"γ = {gamma:g}")
        for gamma, dash in _GAMMAS.items()
    ]
    return Panel(title, DELAY, _RATIO, (0.0, float(delays[-1])), (0.0, top), tuple(traces))


def springs(delay: float) -> Panel:
    """Return the whole boundaries of all springs up to the Nyquist frequency."""
    return _springs(delay, DELTA, _whole_window(delay), f"d = {delay:g}, δ = {DELTA:g}", 2000)


def springs_close(delay: float) -> Panel:
    """Return a close-up of the boundaries of all springs around the origin, with the passive region."""
    area = Area(*_passive(delay, DELTA), "green", "passive")
    return replace(_springs_close(delay, DELTA), areas=(area,))


def undamped_springs(delay: float) -> Panel:
    """Return the same close-up for a device without damping, which has no passive region."""
    return _springs_close(delay, 0.0)


def _springs_close(delay: float, delta: float) -> Panel:
    unit = DELTA * float(maximum_passive_stiffness([delay])[0][0])
    window = -0.6 * unit, 2.2 * unit, -1.7 * DELTA, 2.6 * DELTA
    return _springs(delay, delta, window, f"d = {delay:g}, δ = {delta:g}, origin", 900)


def _springs(delay: float, delta: float, window: Window, title: str, points: int) -> Panel:
    x_range, y_range = window[:2], window[2:]
    wider = (*_widened(x_range, 0.05), *_widened(y_range, 0.05))
    parts = [
        outline_in(Loop(float(gamma), delta, delay), wider, points)
        for gamma in (np.pi**2 + delta**2 / 4) * np.linspace(0, 1, SPRINGS) * (1 - 1e-15)
    ]
    alpha, beta = (np.concatenate(values) for values in zip(*parts, strict=True))
    return Panel(title, ALPHA, BETA, x_range, y_range, (Trace(alpha, beta, "vermillion", width=0.7),))


def _widened(ends: tuple[float, float], share: float) -> tuple[float, float]:
    room = share * (ends[1] - ends[0])
    return ends[0] - room, ends[1] + room


def _whole_window(delay: float) -> Window:
    """Window around the regions of every fourth spring; with a fractional delay that of the last is much larger."""
    last = None if delay == int(delay) else -1
    reach = [(0.0, 0.0)]
    for gamma in np.pi**2 * np.linspace(0, 1, SPRINGS)[:last:4]:
        alpha, beta = outline_in(Loop(float(gamma), DELTA, delay), (-12.0, 12.0, -12.0, 12.0), 400)
        inside = np.isfinite(alpha) & (np.abs(beta) < 11.5)
        reach += zip(alpha[inside].tolist(), beta[inside].tolist(), strict=True)
    low, bottom = np.min(reach, axis=0).tolist()
    high, top = np.max(reach, axis=0).tolist()
    return (*_widened((low, high), 0.04), *_widened((bottom, top), 0.04))
