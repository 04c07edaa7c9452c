"""Figures of chapter 4: passive regions beside stable ones."""

from __future__ import annotations

import numpy as np

from pipeline.records.batch import Floats
from pipeline.studies.panels import Area, Panel, TheoryFigure, Trace
from pipeline.studies.thesis.curves import outline_trace
from pipeline.studies.thesis.outline import outline_in
from pipeline.studies.thesis.stability import ALPHA, BETA, DELAY_SWEEP, FAMILY, FAMILY_COLOURS
from pipeline.theory.extent import maximum_stiffness, stiffest_point
from pipeline.theory.loop import Loop
from pipeline.theory.passivity import boundary_angle, maximum_passive_stiffness, passive_boundary, passive_to_stable

_GAMMA, _DELTA = 0.001, 0.02
_SPRINGS = 41
"""Springs of Fig. 4.5, evenly from 0 to the Nyquist limit (4.15)."""

_SPRING_DELAYS = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)


def _passive(delay: float) -> tuple[Floats, Floats]:
    """Closed outline of the passive region in K T/b and B/b."""
    stiffness, damping = passive_boundary(delay, np.linspace(0, boundary_angle(delay), 160))
    return np.concatenate([[0.0], stiffness, [0.0, 0.0]]), np.concatenate([[-1.0], damping, [1.0, -1.0]])


def figure_4_1() -> TheoryFigure:
    """Passive regions."""
    traces = [
        Trace(*_passive(d), colour, "solid", f"d = {d:g}") for d, colour in zip(FAMILY, FAMILY_COLOURS, strict=True)
    ]
    ridge = Trace(*maximum_passive_stiffness(DELAY_SWEEP), "ink", "dashdot", "largest stiffness", width=1.1)
    panel = Panel("", "K T / b", "B / b", (-0.03, 2.1), (-1.08, 1.08), (*traces, ridge))
    return TheoryFigure(
        "4.1",
        "Passive regions over delay",
        "In units of the device's damping b and the sampling period T they do not depend on mass or stiffness. All "
        "end at (0, 1) and (0, −1); the lower parts are straight, K < (b + B)/((1/2 + d) T). Dash-dotted: the "
        "stiffest passive walls of all delays.",
        (panel,),
        1,
    )


def figure_4_2() -> TheoryFigure:
    """Largest passive stiffness over delay."""
    largest = maximum_passive_stiffness(DELAY_SWEEP)[0]
    panel = Panel(
        "", "delay factor d", "largest passive K T / b", (0.0, 8.0), (0.0, 2.1), (Trace(DELAY_SWEEP, largest, "green"),)
    )
    return TheoryFigure(
        "4.2",
        "Largest passive stiffness over delay",
        "It falls to 41 % at d = 1 and 27 % at d = 2 of that without delay: 2 tan(π/(4 (d + 1))) by (4.11).",
        (panel,),
        1,
    )


def figure_4_3() -> TheoryFigure:
    """Passive and stable regions."""
    traces = []
    for delay in FAMILY:
        first = delay == 0
        traces.append(outline_trace(Loop(_GAMMA, _DELTA, delay), "vermillion", "stable" if first else ""))
        alpha, beta = _passive(delay)
        traces.append(Trace(_DELTA * alpha, _DELTA * beta, "green", "dashed", "passive" if first else ""))
    # alpha_max falls with d^-2 and the close-up ends at the passive region of d = 0
    stable = Trace(
        *maximum_stiffness(DELAY_SWEEP, _GAMMA, _DELTA), "vermillion", "dashdot", "stiffest stable", width=1.0
    )
    stiff, damping = maximum_passive_stiffness(DELAY_SWEEP)
    passive = Trace(_DELTA * stiff, _DELTA * damping, "green", "dashdot", "stiffest passive", width=1.0)
    lines = (*traces, stable, passive)
    top = stiffest_point(Loop(_GAMMA, _DELTA, 0.0))[0]
    return TheoryFigure(
        "4.3",
        "Passive inside stable regions",
        "Stable (red) and passive (green, dashed) regions for γ = 0.001, δ = 0.02 and d = 0, 0.25, 0.5, 1, 2, 4, 8 "
        "from the outermost inwards, the whole and a close-up of the origin. For each delay the passive region lies "
        "inside of the stable one and is much smaller.",
        (
            Panel("whole", ALPHA, BETA, (-0.02, 1.04 * top), (-0.1, 2.1), lines),
            Panel("around the origin", ALPHA, BETA, (-0.002, 0.044), (-0.024, 0.05), lines),
        ),
    )


def figure_4_4() -> TheoryFigure:
    """Largest passive and stable stiffness."""
    far = np.concatenate([np.linspace(0, 44, 23), np.linspace(52, 132, 6)])
    over = "delay factor d"
    looks = ((0.0, "solid"), (0.001, "dashed"))
    largest = [Trace(DELAY_SWEEP, _DELTA * maximum_passive_stiffness(DELAY_SWEEP)[0], "green", "dashed", "passive")]
    for gamma, dash in looks:
        alpha = maximum_stiffness(DELAY_SWEEP, gamma, _DELTA)[0]
        largest.append(Trace(DELAY_SWEEP, alpha, "vermillion", dash, f"stable, γ = {gamma:g}"))
    ratios = []
    for delays in (DELAY_SWEEP, far):
        ratios.append(
            tuple(
                Trace(delays, passive_to_stable(delays, gamma, _DELTA), "blue", dash, f"γ = {gamma:g}")
                for gamma, dash in looks
            )
        )
    return TheoryFigure(
        "4.4",
        "Largest passive and stable stiffness over delay",
        "δ = 0.02. Left: the stiffest stable wall is 17.8 times as stiff as the stiffest passive one for d = 0 and "
        "9.3 times for d = 1. Middle and right: the ratio η of the passive to the stable one, on two scales of delay; "
        "up to d = 40 (γ = 0.001) and 120 (γ = 0) it grows to 1, where passivity asks for no more than stability, and "
        "falls again behind.",
        (
            Panel("(a) largest stiffness", over, "largest α", (0.0, 8.0), (0.0, 0.75), tuple(largest)),
            Panel("(b) ratio", over, "η, passive by stable", (0.0, 8.0), (0.0, 0.7), ratios[0]),
            Panel("(c) ratio, longer delays", over, "η, passive by stable", (0.0, 132.0), (0.0, 1.05), ratios[1]),
        ),
        3,
    )


def _springs_panel(delay: float, delta: float, title: str, *, close: bool) -> Panel:
    """Boundaries of all springs, the whole of them or around the origin."""
    unit = _DELTA * float(maximum_passive_stiffness([delay])[0][0])
    window = (-0.6 * unit, 2.2 * unit, -1.7 * _DELTA, 2.6 * _DELTA) if close else _whole_window(delay)
    x_range, y_range = (window[0], window[1]), (window[2], window[3])
    wider = (
        window[0] - 0.05 * (window[1] - window[0]),
        window[1] + 0.05 * (window[1] - window[0]),
        window[2] - 0.05 * (window[3] - window[2]),
        window[3] + 0.05 * (window[3] - window[2]),
    )
    alpha, beta = [], []
    for gamma in (np.pi**2 + delta**2 / 4) * np.linspace(0, 1, _SPRINGS) * (1 - 1e-15):
        part = outline_in(Loop(float(gamma), delta, delay), wider, 900 if close else 2000)
        alpha.append(part[0])
        beta.append(part[1])
    lines = Trace(np.concatenate(alpha), np.concatenate(beta), "vermillion", width=0.7)
    areas: tuple[Area, ...] = ()
    if close and delta:
        stiffness, damping = _passive(delay)
        areas = (Area(delta * stiffness, delta * damping, "green", "passive"),)
    return Panel(title, ALPHA, BETA, x_range, y_range, (lines,), (), areas)


def _whole_window(delay: float) -> tuple[float, float, float, float]:
    """Window around the regions of every fourth spring; with a fractional delay that of the last is much larger."""
    low, high, bottom, top = 0.0, 0.0, 0.0, 0.0
    last = None if delay == int(delay) else -1
    for gamma in np.pi**2 * np.linspace(0, 1, _SPRINGS)[:last:4]:
        alpha, beta = outline_in(Loop(float(gamma), _DELTA, delay), (-12.0, 12.0, -12.0, 12.0), 400)
        inside = np.isfinite(alpha) & (np.abs(beta) < 11.5)
        low, high = min(low, float(alpha[inside].min())), max(high, float(alpha[inside].max()))
        bottom, top = min(bottom, float(beta[inside].min())), max(top, float(beta[inside].max()))
    across, up = 0.04 * (high - low), 0.04 * (top - bottom)
    return low - across, high + across, bottom - up, top + up


def figure_4_5() -> TheoryFigure:
    """Boundaries for springs up to the Nyquist frequency."""
    panels = []
    for delay in _SPRING_DELAYS:
        panels += [
            _springs_panel(delay, _DELTA, f"d = {delay:g}, δ = {_DELTA:g}", close=False),
            _springs_panel(delay, _DELTA, f"d = {delay:g}, δ = {_DELTA:g}, origin", close=True),
            _springs_panel(delay, 0.0, f"d = {delay:g}, δ = 0, origin", close=True),
        ]
    return TheoryFigure(
        "4.5",
        "Stability boundaries for springs up to the Nyquist frequency",
        f"{_SPRINGS} values of γ, evenly from 0 to π² + δ²/4, one row for each delay: whole boundaries for δ = 0.02 "
        "(left), their close-up around the origin with the passive region shaded (middle), and that for δ = 0 "
        "(right). What no line cuts off around the origin is stable with every spring; it holds all of the passive "
        "region and vanishes for δ = 0.",
        tuple(panels),
        3,
    )


FIGURES = {
    "4.1": figure_4_1,
    "4.2": figure_4_2,
    "4.3": figure_4_3,
    "4.4": figure_4_4,
    "4.5": figure_4_5,
}
