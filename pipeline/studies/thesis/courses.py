"""Figures of chapter 5 with step and impulse responses: 5.5, 5.6, 5.9 and 5.11."""

from __future__ import annotations

import numpy as np

from pipeline.studies.panels import Panel, TheoryFigure, Trace
from pipeline.studies.thesis.curves import plain_loop
from pipeline.studies.thesis.jumps import Jump, first_settling_jump, largest_overshoot_jump
from pipeline.studies.thesis.responses import Response, extrema, response
from pipeline.theory.loop import Loop
from pipeline.theory.optimum import optimal_point

TIME, POSITION = "time [samples]", "position χ"
BAND = 0.02
_FINE = 64
"""Points in a sampling interval: an extremum is met to 1e-5 of the final position."""

_TOUCHES = 1e-3
"""Distance from the band, relative to the final position, at which an extremum touches it: the search for the
optimum ends nearer than that, and the next extrema are further off."""


def _line(at: float, end: float, colour: str = "green", dash: str = "dashed", label: str = "") -> Trace:
    return Trace(np.array([0.0, end]), np.array([at, at]), colour, dash, label, width=1.0)


def _sampled(found: Response) -> Trace:
    count = len(found.samples)
    return Trace(np.arange(count, dtype=np.float64), found.samples, "ink", "dashed", "samples", ".", width=0.9)


def figure_5_5() -> TheoryFigure:
    """Step response that settles fastest."""
    loop = plain_loop(0.0)
    best = optimal_point(loop, "settle_2pct")
    found = response(loop, best.alpha, best.beta, "step", 20, _FINE)
    final = 1 / best.alpha
    time, position = extrema(found)
    touch = np.flatnonzero(np.abs(np.abs(position / final - 1) - BAND) < _TOUCHES)
    marks = [
        Trace(time[i : i + 1], position[i : i + 1], colour, "none", f"{which} touch", marker)
        for i, (colour, marker, which) in zip(
            touch, (("blue", "o", "first"), ("vermillion", "*", "second")), strict=False
        )
    ]
    lines = [
        Trace(found.time, found.position, "blue", "solid", "continuous"),
        _sampled(found),
        _line(final * (1 + BAND), 20.0, label="2 % band"),
        _line(final * (1 - BAND), 20.0),
        *marks,
    ]
    return TheoryFigure(
        "5.5",
        "Step response of the shortest settling time",
        f"d = 0, γ = δ = 0, α = {best.alpha:.5f}, β = {best.beta:.5f}; the final position is {final:.3f}. The response "
        f"enters the 2 % band at {best.cost:.3f} samples and then touches its upper edge at its largest maximum "
        "(circle) and its lower edge at a minimum (star). Right: close-up around the final position.",
        (
            Panel("whole", TIME, POSITION, (0.0, 20.0), (0.0, 1.15 * final), tuple(lines)),
            Panel("close-up", TIME, POSITION, (0.0, 20.0), (0.96 * final, 1.04 * final), tuple(lines)),
        ),
    )


def _two_responses(loop: Loop, jump: Jump, end: int) -> list[tuple[str, str, str, Response]]:
    return [
        (f"β = {beta:.3f}, {side} the jump", colour, marker, response(loop, jump.alpha, beta, "step", end, _FINE))
        for side, colour, marker, beta in (
            ("before", "blue", "o", jump.beta_before),
            ("behind", "vermillion", "*", jump.beta_behind),
        )
    ]


def figure_5_6() -> TheoryFigure:
    """Responses on both sides of the first jump of the settling time."""
    loop = plain_loop(0.0)
    jump = first_settling_jump(loop)
    final, end = 1 / jump.alpha, 30
    traces = []
    for label, colour, marker, found in _two_responses(loop, jump, end):
        traces.append(Trace(found.time, found.position, colour, "solid", label))
        time, position = extrema(found)
        touch = np.abs(np.abs(position / final - 1) - BAND) < _TOUCHES
        traces.append(Trace(time[touch], position[touch], colour, "none", "", marker))
    traces += [_line(final * (1 + BAND), end, label="2 % band"), _line(final * (1 - BAND), end)]
    return TheoryFigure(
        "5.6",
        "Step responses on both sides of the first jump of the settling time",
        f"d = 0, γ = δ = 0, α = {jump.alpha:.5f}, final position {final:.3f}. Just before the jump (blue) an extremum "
        "touches the band (circle); for a slightly stiffer wall it cannot be kept inside by any damping, and the best "
        "response is another one (red), of which a later extremum touches the band (star). Right: close-up.",
        (
            Panel("whole", TIME, POSITION, (0.0, end), (0.0, 1.25 * final), tuple(traces)),
            Panel("close-up", TIME, POSITION, (0.0, end), (0.96 * final, 1.04 * final), tuple(traces)),
        ),
    )


def figure_5_9() -> TheoryFigure:
    """Responses on both sides of the largest jump of the overshoot."""
    loop = plain_loop(0.0)
    jump = largest_overshoot_jump(loop)
    final, end = 1 / jump.alpha, 30
    traces = []
    largest = 0.0
    for label, colour, marker, found in _two_responses(loop, jump, end):
        traces.append(Trace(found.time, found.position, colour, "solid", label))
        time, position = extrema(found)
        over = position / final - 1
        largest = max(largest, float(over.max()))
        peak = over > over.max() - 0.02 * over.max()
        traces.append(Trace(time[peak], position[peak], colour, "none", "", marker))
    traces.append(_line(final * (1 + largest), end, label=f"overshoot {100 * largest:.2f} %"))
    traces.append(_line(final, end, "ink", "dotted", "final position"))
    return TheoryFigure(
        "5.9",
        "Step responses on both sides of the largest jump of the overshoot",
        f"d = 0, γ = δ = 0, α = {jump.alpha:.5f}, final position {final:.3f}. Both responses overshoot by the same "
        f"{100 * largest:.2f} %, but with different maxima (marks). Right: close-up. The thesis gives α = 0.3044 and "
        "1.48 % for this jump.",
        (
            Panel("whole", TIME, POSITION, (0.0, end), (0.0, 1.15 * final), tuple(traces)),
            Panel("close-up", TIME, POSITION, (0.0, end), (0.96 * final, 1.03 * final), tuple(traces)),
        ),
    )


def figure_5_11() -> TheoryFigure:
    """Responses in the optima of the energy criteria."""
    loop = plain_loop(0.0)
    panels = []
    looks = (("blue", "solid"), ("vermillion", "dashed"), ("green", "dashdot"))
    for letter, judged in (("a", "step"), ("b", "impulse")):
        for shown, top, low in (("step", 12.0 if judged == "impulse" else 5.0, 0.0), ("impulse", 2.0, -0.8)):
            traces = []
            for w, (colour, dash) in zip((0, 1, 2), looks, strict=True):
                best = optimal_point(loop, f"energy_{judged}_w{w}")
                found = response(loop, best.alpha, best.beta, shown, 16, 16)
                traces.append(Trace(found.time, found.position, colour, dash, f"w = {w}"))
            title = f"({letter}) optima for the {judged}: {shown} response"
            panels.append(Panel(title, TIME, POSITION, (0.0, 16.0), (low, top), tuple(traces)))
    return TheoryFigure(
        "5.11",
        "Responses in the optima of the energy criteria",
        "Step (left) and impulse responses (right) in the optima of Fig. 5.10, d = 0, γ = δ = 0. A larger weight w "
        "makes the response settle faster. The optimum for the impulse with w = 0 has no stiffness, so that its step "
        "response does not come to rest.",
        tuple(panels),
    )


FIGURES = {"5.5": figure_5_5, "5.6": figure_5_6, "5.9": figure_5_9, "5.11": figure_5_11}
