"""Panels of chapter 5 with step and impulse responses: Figs. 5.5, 5.6, 5.9 and 5.11."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from pipeline.records.batch import Booleans, Floats
from pipeline.studies.figure import Panel, Trace, mark
from pipeline.studies.thesis.curves import plain_loop
from pipeline.studies.thesis.jumps import Jump, first_settling_jump, largest_overshoot_jump
from pipeline.studies.thesis.responses import Response, extrema, response
from pipeline.theory.optimum.optimum import optimal_point

TIME, POSITION = "time [samples]", "position χ"
BAND = 0.02
_FINE = 64
"""Points in a sampling interval: an extremum is met to 1e-5 of the final position."""

_TOUCHES = 1e-3
"""Distance from the band, relative to the final position, at which an extremum touches it: the search for the
optimum ends nearer than that, and the next extrema are further off."""

_BEFORE, _BEHIND = ("blue", "o"), ("vermillion", "*")
"""Looks of what is before and behind a jump."""

Figure = tuple[list[Panel], tuple[float, ...]]
"""Panels, and the numbers that the caption states."""


def _level(at: float, end: float, colour: str = "green", dash: str = "dashed", label: str = "") -> Trace:
    return Trace(np.array([0.0, end]), np.array([at, at]), colour, dash, label, width=1.0)


def _band(final: float, end: float) -> list[Trace]:
    return [_level(final * (1 + BAND), end, label="2 % band"), _level(final * (1 - BAND), end)]


def _touches(position: Floats, final: float) -> Booleans:
    return np.abs(np.abs(position / final - 1) - BAND) < _TOUCHES


def _whole_and_close(traces: Sequence[Trace], final: float, end: float, top: float, upper: float) -> list[Panel]:
    """The same lines twice: the whole of them, and around the final position."""
    ranges = {"whole": (0.0, top * final), "close-up": (0.96 * final, upper * final)}
    return [Panel(title, TIME, POSITION, (0.0, end), ends, tuple(traces)) for title, ends in ranges.items()]


def quickest_settling() -> Figure:
    """Return the step response that settles fastest, with the extrema that touch the band."""
    best = optimal_point(plain_loop(0.0), "settle_2pct")
    found = response(plain_loop(0.0), best.alpha, best.beta, "step", 20, _FINE)
    final, count = 1 / best.alpha, len(found.samples)
    time, position = extrema(found)
    touch = np.flatnonzero(_touches(position, final))
    looks = (*_BEFORE, "first touch"), (*_BEHIND, "second touch")
    traces = [
        Trace(found.time, found.position, "blue", "solid", "continuous"),
        Trace(np.arange(count, dtype=np.float64), found.samples, "ink", "dashed", "samples", ".", width=0.9),
        *_band(final, 20.0),
        *(mark(time[i], position[i], *look) for i, look in zip(touch, looks, strict=False)),
    ]
    return _whole_and_close(traces, final, 20.0, 1.15, 1.04), (best.alpha, best.beta, final, best.cost)


def _beside(jump: Jump, end: int) -> Iterator[tuple[str, str, str, Response]]:
    """Responses on both sides of a jump with label, colour and sign."""
    for side, look, beta in (("before", _BEFORE, jump.beta_before), ("behind", _BEHIND, jump.beta_behind)):
        found = response(plain_loop(0.0), jump.alpha, beta, "step", end, _FINE)
        yield f"β = {beta:.3f}, {side} the jump", *look, found


def settling_jump() -> Figure:
    """Return responses on both sides of the first jump of the settling time."""
    jump = first_settling_jump(plain_loop(0.0))
    final, end = 1 / jump.alpha, 30
    traces = []
    for label, colour, sign, found in _beside(jump, end):
        time, position = extrema(found)
        touch = _touches(position, final)
        traces.append(Trace(found.time, found.position, colour, "solid", label))
        traces.append(Trace(time[touch], position[touch], colour, "none", "", sign))
    return _whole_and_close([*traces, *_band(final, end)], final, end, 1.25, 1.04), (jump.alpha, final)


def overshoot_jump() -> Figure:
    """Return responses on both sides of the largest jump of the overshoot."""
    jump = largest_overshoot_jump(plain_loop(0.0))
    final, end = 1 / jump.alpha, 30
    traces, largest = [], 0.0
    for label, colour, sign, found in _beside(jump, end):
        time, position = extrema(found)
        over = position / final - 1
        largest = max(largest, float(over.max()))
        peak = over > over.max() - 0.02 * over.max()
        traces.append(Trace(found.time, found.position, colour, "solid", label))
        traces.append(Trace(time[peak], position[peak], colour, "none", "", sign))
    traces.append(_level(final * (1 + largest), end, label=f"overshoot {100 * largest:.2f} %"))
    traces.append(_level(final, end, "ink", "dotted", "final position"))
    return _whole_and_close(traces, final, end, 1.15, 1.03), (jump.alpha, final, 100 * largest)


def energy_optima(letter: str, judged: str, shown: str, low: float, top: float) -> Panel:
    """Return step or impulse responses in the optima of the energy criteria of step or impulse."""
    loop = plain_loop(0.0)
    traces = []
    for w, (colour, dash) in enumerate((("blue", "solid"), ("vermillion", "dashed"), ("green", "dashdot"))):
        best = optimal_point(loop, f"energy_{judged}_w{w}")
        found = response(loop, best.alpha, best.beta, shown, 16, 16)
        traces.append(Trace(found.time, found.position, colour, dash, f"w = {w}"))
    title = f"({letter}) optima for the {judged}: {shown} response"
    return Panel(title, TIME, POSITION, (0.0, 16.0), (low, top), tuple(traces))
