"""Panels of chapter 3: parameters of the human arm (3.5), stability boundaries (3.6 to 3.11)."""

from __future__ import annotations

import numpy as np

from pipeline.device_data.human_arm import human_arms
from pipeline.loop.loop import Loop
from pipeline.records.batch import Floats
from pipeline.studies.figure import Note, Panel, Trace
from pipeline.studies.thesis.curves import ALPHA, BETA, DELAY, outline_trace, plane
from pipeline.studies.thesis.outline import outline_in
from pipeline.theory.stability.extent import damping_range, linear_error_crossings, maximum_stiffness, stiffest_point

GAMMA, DELTA = 0.001, 0.02
"""Upper ends of the parameter range (3.17)."""

FAMILY = {0.0: "blue", 0.25: "vermillion", 0.5: "green", 1.0: "purple", 2.0: "orange", 4.0: "sky", 8.0: "ink"}
"""Delay factors of the figures that show a family of boundaries, with their colours."""

LIMITS = {
    (0.0, 0.0): ("blue", "solid"),
    (GAMMA, 0.0): ("vermillion", "dashed"),
    (0.0, DELTA): ("green", "dashdot"),
    (GAMMA, DELTA): ("purple", "dotted"),
}
"""Corners (gamma, delta) of the parameter range (3.17), with their looks."""

DELAY_SWEEP = np.linspace(0.0, 8.0, 65)
"""Delay factors of a curve over delay."""

_LOWEST = 0.7
_FRAMES = (
    (710.0, 14.6, "dashed", "limits (3.15) of all but one"),
    (1000.0, 20.0, "solid", "range considered, 30 % more"),
)
"""Limits (3.15) of k/m [1/s^2] and b/m [1/s] of a human arm, and of the range considered (3.17) at T = 1 ms."""

_PLACES = {
    "Kuchenbecker et al.": ("right", -8.0, -2.0),
    "Lawrence": ("right", -7.0, -2.0),
    "Daniel et al.": ("right", -7.0, 2.0),
    "Tsuji et al.": ("center", 0.0, 11.0),
    "Lakatos et al.": ("left", 7.0, 0.0),
    "Lawrence and Chapel": ("center", 0.0, -12.0),
}
"""Where names in Fig. 3.5 stand so that they do not cover each other; right and below elsewhere."""

_ERRORS = {0.0: ("blue", "o", "error 0 %"), 0.02: ("green", "^", "2 %"), 0.05: ("vermillion", "s", "5 %")}
"""Errors of the linear condition that Fig. 3.11 marks."""


def human_arm() -> Panel:
    """Return the parameters of Table 3.2 by the mass of the arm."""
    arms = human_arms()
    k = np.array([arm.stiffness / arm.mass for arm in arms])
    b = np.array([arm.damping / arm.mass for arm in arms])
    frames = [
        Trace(np.array([_LOWEST, right, right]), np.array([top, top, _LOWEST]), "green", dash, label)
        for right, top, dash, label in _FRAMES
    ]
    marks = Trace(k, b, "blue", "none", "values of Table 3.2", "o")
    notes = [
        Note(x, y, arm.source.removesuffix(" et al."), *_PLACES.get(arm.source, ("left", 7.0, -2.0)))
        for x, y, arm in zip(k, b, arms, strict=True)
    ]
    return Panel(
        "",
        "stiffness by mass k/m [1/s²]",
        "damping by mass b/m [1/s]",
        (_LOWEST, 2e4),
        (_LOWEST, 100.0),
        (*frames, marks),
        notes=tuple(notes),
        logarithmic=True,
    )


def _limit_label(gamma: float, delta: float) -> str:
    return f"γ = {gamma:g}, δ = {delta:g}"


def limits(delay: float) -> Panel:
    """Return the boundaries at the limits of the parameter range."""
    traces = [
        outline_trace(Loop(*corner, delay), colour, _limit_label(*corner), dash=dash)
        for corner, (colour, dash) in LIMITS.items()
    ]
    return plane(Loop(GAMMA, DELTA, delay), f"d = {delay:g}", traces)


def origin(delay: float) -> Panel:
    """Return a close-up around the origin for five values of gamma."""
    x_range, y_range = (-1.4e-3, 4.2e-3), (-0.024, 0.012)
    traces = []
    for gamma, colour in zip(np.linspace(0, GAMMA, 5), FAMILY.values(), strict=False):
        for delta, dash in ((DELTA, "solid"), (0.0, "dashed")):
            line = outline_in(Loop(float(gamma), delta, delay), (*x_range, *y_range))
            traces.append(Trace(*line, colour, dash, f"γ = {gamma * 1e3:g}·10⁻³" if delta else ""))
    return Panel(f"d = {delay:g}", ALPHA, BETA, x_range, y_range, tuple(traces))


def family() -> Panel:
    """Return the boundaries for several delays."""
    traces = [outline_trace(Loop(GAMMA, DELTA, d), colour, f"d = {d:g}") for d, colour in FAMILY.items()]
    delays = np.concatenate([np.linspace(0, 2, 41), np.linspace(2, 8, 31)[1:]])
    ridge = Trace(*maximum_stiffness(delays, GAMMA, DELTA), "ink", "dashdot", "largest stiffness", width=1.1)
    return plane(Loop(GAMMA, DELTA, 0.0), "", [*traces, ridge])


def largest_stiffness() -> Panel:
    """Return the largest stable stiffness over delay."""
    traces = [
        Trace(DELAY_SWEEP, maximum_stiffness(DELAY_SWEEP, *corner)[0], *look, _limit_label(*corner))
        for corner, look in LIMITS.items()
    ]
    return Panel("stiffness", DELAY, "largest stable α", (0.0, 8.0), (0.0, 0.75), tuple(traces))


def largest_damping() -> Panel:
    """Return the largest stable damping over delay."""
    traces = []
    for corner, look in LIMITS.items():
        tops = np.array([damping_range(Loop(*corner, float(d)))[1] for d in DELAY_SWEEP])
        traces.append(Trace(DELAY_SWEEP, tops, *look, _limit_label(*corner)))
    return Panel("damping", DELAY, "largest stable β", (0.0, 8.0), (0.0, 2.1), tuple(traces))


def linear_condition(delay: float) -> Panel:
    """Return the linear condition (3.27) against the boundaries, with marks where its stiffness is off by so much."""
    traces: list[Trace] = []
    for delta in (0.0, 0.005, 0.01, 0.015, 0.02):
        loop, first = Loop(GAMMA, delta, delay), delta == 0
        ends = np.array([-delta - GAMMA * (0.5 + delay), damping_range(loop)[1]])
        line = (ends + delta) / (0.5 + delay)
        traces.append(outline_trace(loop, "ink", "exact" if first else ""))
        traces.append(Trace(line, ends, "purple", "dashed", "linear" if first else "", width=1.1))
        for level, (colour, sign, label) in _ERRORS.items():
            traces.append(Trace(*_crossings(loop, level), colour, "none", label if first else "", sign))
    marks = [trace for trace in traces if trace.marker]
    right, top = (max(0.0, *(float(v) for mark in marks for v in getattr(mark, axis))) for axis in "xy")
    return Panel(f"d = {delay:g}", ALPHA, BETA, (-0.05 * right, 1.12 * right), (-0.025, 1.12 * top), tuple(traces))


def _crossings(loop: Loop, level: float) -> tuple[Floats, Floats]:
    """Places where the linear condition is off by so much, but for the upper branch, far from where it is meant."""
    alpha, beta = linear_error_crossings(loop, level)
    stiffest = stiffest_point(loop)
    near = (alpha < 0.6 * stiffest[0]) & (beta < stiffest[1])
    return alpha[near], beta[near]
