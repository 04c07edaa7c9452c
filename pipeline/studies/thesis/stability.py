"""Figures of chapter 3: parameters of the human arm (3.5), stability boundaries (3.6 to 3.11)."""

from __future__ import annotations

import numpy as np

from pipeline.records.batch import Floats
from pipeline.store.human_arm import human_arms
from pipeline.studies.panels import Note, Panel, TheoryFigure, Trace
from pipeline.studies.thesis.curves import box, outline_trace
from pipeline.studies.thesis.outline import outline_in
from pipeline.theory.extent import damping_range, linear_error_crossings, maximum_stiffness, stiffest_point
from pipeline.theory.loop import Loop

ALPHA, BETA = "stiffness α", "damping β"
FAMILY = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Delay factors of the figures that show a family of boundaries."""

FAMILY_COLOURS = ("blue", "vermillion", "green", "purple", "orange", "sky", "ink")
LIMITS = ((0.0, 0.0), (0.001, 0.0), (0.0, 0.02), (0.001, 0.02))
"""Corners (gamma, delta) of the parameter range (3.17)."""

_LIMIT_LOOKS = (("blue", "solid"), ("vermillion", "dashed"), ("green", "dashdot"), ("purple", "dotted"))
DELAY_SWEEP = np.linspace(0.0, 8.0, 65)
"""Delay factors of a curve over delay."""

_LARGEST = (710.0, 14.6)
_WIDENED = (1000.0, 20.0)
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


def limit_label(gamma: float, delta: float) -> str:
    """Return the legend of a corner of the parameter range."""
    return f"γ = {gamma:g}, δ = {delta:g}"


def figure_3_5() -> TheoryFigure:
    """Parameters of the human arm."""
    arms = human_arms()
    k = np.array([arm.stiffness / arm.mass for arm in arms])
    b = np.array([arm.damping / arm.mass for arm in arms])
    lowest = 0.7
    frames = []
    for (right, top), dash, label in (
        (_LARGEST, "dashed", "limits (3.15) of all but one"),
        (_WIDENED, "solid", "range considered, 30 % more"),
    ):
        frames.append(Trace(np.array([lowest, right, right]), np.array([top, top, lowest]), "green", dash, label))
    marks = Trace(k, b, "blue", "none", "values of Table 3.2", "o")
    notes = tuple(
        Note(x, y, arm.source.removesuffix(" et al."), *_PLACES.get(arm.source, ("left", 7.0, -2.0)))
        for x, y, arm in zip(k, b, arms, strict=True)
    )
    panel = Panel(
        "", "stiffness by mass k/m [1/s²]", "damping by mass b/m [1/s]", (lowest, 2e4), (lowest, 100.0),
        (*frames, marks), notes=notes, logarithmic=True,
    )  # fmt: skip
    return TheoryFigure(
        "3.5",
        "Parameters of the human arm by its mass",
        "Stiffness and damping of Table 3.2 divided by the mass of the arm, on logarithmic axes. All but one set lie "
        "within 710/s² and 14.6/s (dashed); the range considered reaches 30 % further, to 1000/s² and 20/s (solid), "
        "which is γ ≤ 0.001 and δ ≤ 0.02 at T = 1 ms. Kuchenbecker et al. strapped the arm and measured the hand "
        "alone.",
        (panel,),
        1,
    )


def _limits_panel(delay: float) -> Panel:
    traces = tuple(
        outline_trace(Loop(gamma, delta, delay), colour, limit_label(gamma, delta), dash=dash)
        for (gamma, delta), (colour, dash) in zip(LIMITS, _LIMIT_LOOKS, strict=True)
    )
    x_range, y_range = box(Loop(0.001, 0.02, delay))
    return Panel(f"d = {delay:g}", ALPHA, BETA, x_range, y_range, traces)


def figure_3_6() -> TheoryFigure:
    """Boundaries without delay and with one sample."""
    return TheoryFigure(
        "3.6",
        "Stability boundaries at the limits of the parameter range",
        "Walls inside a curve are stable; γ is 0 or 0.001 and δ is 0 or 0.02. One sample of delay leaves 21 % of the "
        "largest stiffness. Device damping widens the region; device stiffness is hardly seen here.",
        (_limits_panel(0.0), _limits_panel(1.0)),
    )


def figure_3_7() -> TheoryFigure:
    """Close-up around the origin."""
    x_range, y_range = (-1.4e-3, 4.2e-3), (-0.024, 0.012)
    colours = ("blue", "vermillion", "green", "purple", "orange")
    panels = []
    for delay in (0.0, 1.0):
        traces = []
        for gamma, colour in zip(np.linspace(0, 1e-3, 5), colours, strict=True):
            for delta, dash in ((0.02, "solid"), (0.0, "dashed")):
                line = outline_in(Loop(float(gamma), delta, delay), (*x_range, *y_range))
                label = f"γ = {gamma * 1e3:g}·10⁻³" if delta else ""
                traces.append(Trace(*line, colour, dash, label))
        panels.append(Panel(f"d = {delay:g}", ALPHA, BETA, x_range, y_range, tuple(traces)))
    return TheoryFigure(
        "3.7",
        "Stability boundaries around the origin",
        "Close-up of Fig. 3.6 with five values of γ; δ = 0.02 (solid) and 0 (dashed). The device's stiffness shifts "
        "the left boundary to α = −γ, its damping the lower one by −δ; γ is not seen in the lower one.",
        tuple(panels),
    )


def figure_3_8() -> TheoryFigure:
    """Boundaries for several delays."""
    traces = []
    for delay, colour in zip(FAMILY, FAMILY_COLOURS, strict=True):
        traces.append(outline_trace(Loop(0.001, 0.02, delay), colour, f"d = {delay:g}"))
    delays = np.concatenate([np.linspace(0, 2, 41), np.linspace(2, 8, 31)[1:]])
    ridge = Trace(*maximum_stiffness(delays, 0.001, 0.02), "ink", "dashdot", "largest stiffness", width=1.1)
    x_range, y_range = box(Loop(0.001, 0.02, 0.0))
    return TheoryFigure(
        "3.8",
        "Stability boundaries over delay",
        "γ = 0.001, δ = 0.02, seven delay factors. With delay the stable region shrinks towards the origin; the "
        "dash-dotted line joins the stiffest stable walls of all delays.",
        (Panel("", ALPHA, BETA, x_range, y_range, (*traces, ridge)),),
        1,
    )


def figure_3_9() -> TheoryFigure:
    """Largest stiffness and damping over delay."""
    stiffness, damping = [], []
    for (gamma, delta), (colour, dash) in zip(LIMITS, _LIMIT_LOOKS, strict=True):
        label = limit_label(gamma, delta)
        stiffness.append(Trace(DELAY_SWEEP, maximum_stiffness(DELAY_SWEEP, gamma, delta)[0], colour, dash, label))
        tops = np.array([damping_range(Loop(gamma, delta, float(d)))[1] for d in DELAY_SWEEP])
        damping.append(Trace(DELAY_SWEEP, tops, colour, dash, label))
    over = "delay factor d"
    return TheoryFigure(
        "3.9",
        "Largest stable stiffness and damping over delay",
        "For the limits of γ and δ. From d = 0 to 1 the largest stiffness falls to 21 %, to 2 below 10 %; the largest "
        "damping to 41 % and 27 %. Numbers: Tables B.1 to B.4.",
        (
            Panel("stiffness", over, "largest stable α", (0.0, 8.0), (0.0, 0.75), tuple(stiffness)),
            Panel("damping", over, "largest stable β", (0.0, 8.0), (0.0, 2.1), tuple(damping)),
        ),
    )


def figure_3_10() -> TheoryFigure:
    """Boundaries for two and four samples of delay."""
    return TheoryFigure(
        "3.10",
        "Stability boundaries for longer delays",
        "As Fig. 3.6 for d = 2 and 4. With more delay the same γ shifts the whole boundary visibly to the left, and "
        "the region grows with δ by a larger share.",
        (_limits_panel(2.0), _limits_panel(4.0)),
    )


def _line(loop: Loop, beta: Floats) -> Floats:
    """Stiffness of the linear condition (3.27) at given damping."""
    return (beta + loop.delta) / (0.5 + loop.delay)


def figure_3_11() -> TheoryFigure:
    """Linear condition against the boundaries."""
    panels = []
    for delay in (0.0, 1.0):
        traces = []
        signs = {0.0: ("blue", "o", "error 0 %"), 0.02: ("green", "^", "2 %"), 0.05: ("vermillion", "s", "5 %")}
        reach = [0.0, 0.0, 0.0]
        for delta in (0.0, 0.005, 0.01, 0.015, 0.02):
            loop = Loop(0.001, delta, delay)
            exact = outline_trace(loop, "ink", "exact" if delta == 0 else "")
            ends = np.array([-loop.delta - 0.001 * (0.5 + delay), damping_range(loop)[1]])
            linear = Trace(_line(loop, ends), ends, "purple", "dashed", "linear" if delta == 0 else "", width=1.1)
            traces += [exact, linear]
            for level, (colour, marker, label) in signs.items():
                alpha, beta = linear_error_crossings(loop, level)
                near = alpha < 0.6 * stiffest_point(loop)[0]  # upper branch: far from where the condition is meant
                near &= beta < stiffest_point(loop)[1]
                traces.append(Trace(alpha[near], beta[near], colour, "none", label if delta == 0 else "", marker))
                reach = [
                    max([reach[0], *alpha[near]]),
                    min([reach[1], *beta[near]]),
                    max([reach[2], *beta[near]]),
                ]
        x_range = -0.05 * reach[0], 1.12 * reach[0]
        y_range = -0.025, 1.12 * reach[2]
        panels.append(Panel(f"d = {delay:g}", ALPHA, BETA, x_range, y_range, tuple(traces)))
    return TheoryFigure(
        "3.11",
        "Linear condition against the exact boundary",
        "Exact boundaries (solid) and β + δ = α (1/2 + d) (dashed) for γ = 0.001 and δ = 0, 0.005, 0.01, 0.015, 0.02, "
        "from top to bottom. Marks tell where the linear condition's stiffness is off by 0, 2 and 5 % (3.28). Above "
        "the circles it calls unstable walls stable.",
        tuple(panels),
    )


FIGURES = {
    "3.5": figure_3_5,
    "3.6": figure_3_6,
    "3.7": figure_3_7,
    "3.8": figure_3_8,
    "3.9": figure_3_9,
    "3.10": figure_3_10,
    "3.11": figure_3_11,
}
