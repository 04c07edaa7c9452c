"""Panels of chapter 5 that relate criteria to poles, rules and delay: Figs. 5.1 and 5.12 to 5.16."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from pipeline.loop.loop import Loop
from pipeline.records.batch import Floats
from pipeline.records.criteria import ENERGY, criterion_of
from pipeline.studies.figure import Note, Panel, Trace, mark
from pipeline.studies.thesis import curves
from pipeline.theory.optimum.optimum import optimal_point
from pipeline.theory.optimum.rules import (
    approximation_error,
    critical_damping,
    marked_point,
    optimal_cost,
    optimal_damping,
)
from pipeline.theory.stability.extent import damping_range, stiffest_point

DELAYS = np.arange(9.0)
STEP = tuple(f"energy_step_w{w}" for w in (0, 1, 2))
IMPULSE = tuple(f"energy_impulse_w{w}" for w in (0, 1, 2))
GROUPS = {
    "(a) settling time and overshoot": ("settle_2pct", "overshoot", "pole_radius"),
    "(b) energy of the step response": STEP,
    "(c) energy of the impulse response": IMPULSE,
}
"""Criteria that Figs. 5.15 and 5.16 show together."""

_NAMES = {
    "settle_2pct": "settling time",
    "overshoot": "overshoot",
    "pole_radius": "pole radius",
    "damping": "damping ratio",
    **{name: f"energy, w = {name[-1]}" for name in (*STEP, *IMPULSE)},
}
_LOOKS = (("purple", "o", "solid"), ("blue", "s", "dashed"), ("vermillion", "^", "dashdot"))
_RULED = (("purple", "o"), ("blue", "D"), ("orange", "^"))
"""Looks of the criteria of a panel, in turn."""

_SETTLING_TIMES = (2, 3, 4, 6, 10, 20, 60)
_RATIOS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
"""Values of the circles and spirals of Fig. 5.1; of the spirals every second has its number."""

_NUMBERED = ("pole_radius", "overshoot", "settle_2pct", *STEP, *IMPULSE)
"""Criteria in the order of their numbers in Fig. 5.14."""

_BESIDE = {5: (9.0, -3.0), 6: (-2.0, -9.0), 3: (8.0, -4.0), 2: (-6.0, 8.0)}
"""Pixels right and up at which a number stands where up and to the right would cover another point."""


def _pole_plane(title: str, lines: Sequence[Trace], notes: Sequence[Note]) -> Panel:
    turn = np.linspace(-np.pi, np.pi, 181)
    circle = Trace(np.cos(turn), np.sin(turn), "ink", width=1.2)
    span = (-1.08, 1.08)
    return Panel(title, "Re z", "Im z", span, span, (circle, *lines), notes=tuple(notes), square=True)


def settling_circles() -> Panel:
    """Return circles inside of which poles settle within so many samples."""
    turn = np.linspace(-np.pi, np.pi, 181)
    radii = {samples: float(np.exp(-4.0 / samples)) for samples in _SETTLING_TIMES}
    circles = [Trace(r * np.cos(turn), r * np.sin(turn), "blue", width=1.0) for r in radii.values()]
    notes = [Note(0.0, r, f"{samples}", "center", 0.0, -6.0) for samples, r in radii.items()]
    return _pole_plane("settling time / T", circles, notes)


def damping_spirals() -> Panel:
    """Return spirals on which poles have a damping ratio."""
    angle = np.linspace(0, np.pi, 121)
    spirals, notes = [], []
    for i, ratio in enumerate(_RATIOS):
        # ln z = w (-zeta + j sqrt(1 - zeta^2)): the angle grows with w, the logarithm of the radius in proportion
        radius = np.exp(-angle * ratio / np.sqrt(1 - ratio**2))
        x, y = radius * np.cos(angle), radius * np.sin(angle)
        spirals.append(Trace(np.append(x, x[::-1]), np.append(y, -y[::-1]), "vermillion", width=1.0))
        if i % 2 == 0:
            notes.append(Note(float(x[60]), float(y[60]), f"{ratio:g}", "center", 0.0, -6.0))
    return _pole_plane("damping ratio ζ", spirals, notes)


def _rules(loop: Loop) -> list[Trace]:
    alpha = stiffest_point(loop)[0] * np.linspace(0, 1, 81) ** 2
    return [
        Trace(alpha, critical_damping(loop, alpha), "vermillion", "dashed", "critical damping", width=1.1),
        Trace(alpha, optimal_damping(loop, alpha), "green", "dashed", "damping ratio 1/√2", width=1.1),
    ]


def against_rules(criteria: Sequence[str], title: str, delay: float) -> Panel:
    """Return the damping rules of continuous time beside the best damping for criteria."""
    loop = curves.plain_loop(delay)
    traces = [curves.outline_trace(loop), *_rules(loop)]
    for criterion, (colour, sign) in zip(criteria, _RULED, strict=False):
        alpha, beta, cost = curves.found_points(curves.damping_curve(loop, criterion))
        known = (cost > 0) | (criterion != "overshoot")  # inside the region without the curve is its middle
        best = optimal_point(loop, criterion)
        traces.append(Trace(alpha[known], beta[known], colour, "solid", _NAMES[criterion]))
        traces.append(mark(best.alpha, best.beta, colour, sign))
    areas = (curves.flat_region(loop, "overshoot"),) if "overshoot" in criteria else ()
    return replace(curves.plane(loop, f"{title}d = {delay:g}", traces), areas=areas)


def optima(delay: float) -> Panel:
    """Return the optima of all criteria by number, and the point of Ziegler and Nichols."""
    loop = curves.plain_loop(delay)
    points = [optimal_point(loop, name) for name in _NUMBERED]
    rule = marked_point(loop, "ziegler_nichols")
    notes = [
        Note(p.alpha, p.beta, str(i), "center", *_BESIDE.get(i, (6.0, 7.0))) for i, p in enumerate(points, start=1)
    ]
    notes.append(Note(rule.alpha, rule.beta, "ZN", "right", -8.0, 5.0, "vermillion"))
    places = np.array([p.alpha for p in points]), np.array([p.beta for p in points])
    traces = [
        curves.outline_trace(loop),
        Trace(*places, "blue", "none", "optima", "."),
        mark(rule.alpha, rule.beta, "vermillion", "+", "Ziegler-Nichols"),
    ]
    return replace(curves.plane(loop, f"d = {delay:g}", traces), notes=tuple(notes))


def share_of_largest(title: str, name: str, top: float) -> Panel:
    """Return stiffness or damping of the optima by the largest stable one, over delay."""
    loops = [curves.plain_loop(d) for d in DELAYS.tolist()]
    axis, letter = ("alpha", "α") if name == "stiffness" else ("beta", "β")
    largest = [stiffest_point(loop)[0] if axis == "alpha" else damping_range(loop)[1] for loop in loops]
    traces, notes = [], []
    for criterion, (colour, sign, dash) in zip(GROUPS[title], _LOOKS, strict=True):
        found = [getattr(optimal_point(loop, criterion), axis) for loop in loops]
        share = 100 * (np.array(found) / np.array(largest))
        traces.append(Trace(DELAYS, share, colour, dash, _NAMES[criterion], sign))
        notes.append(Note(8.0, float(share[-1]), f"{share[-1]:.1f}", "left", 9.0, 0.0, colour))
    label = f"optimal by largest {letter} [%]"
    return Panel(f"{title}: {name}", curves.DELAY, label, (-0.2, 8.9), (-2.0, top), tuple(traces), notes=tuple(notes))


def _over_delay(title: str, values: Callable[[str], Floats]) -> list[Trace]:
    """Lines of the criteria of a group over delay, but for overshoot, whose optimal cost is 0."""
    names = [name for name in GROUPS[title] if name != "overshoot"]
    return [
        Trace(DELAYS, values(criterion), colour, dash, _NAMES[criterion], sign)
        for criterion, (colour, sign, dash) in zip(names, _LOOKS, strict=False)
    ]


def _cost(criterion: str) -> Floats:
    """Cost in the optimum over delay, of an energy by that at the largest delay."""
    cost = np.array([optimal_cost(curves.plain_loop(d), criterion) for d in DELAYS.tolist()])
    return cost / cost[-1] if criterion_of(criterion).family is ENERGY else cost


def optimal_costs(title: str) -> Panel:
    """Return the costs in the optima of a group over delay."""
    traces = _over_delay(title, _cost)
    top = 1.08 * max(float(trace.y.max()) for trace in traces)
    energy = "energy" in title
    label = "cost by that at d = 8" if energy else "settling time / T"
    shown = title if energy else "(a) settling time"
    return Panel(shown, curves.DELAY, label, (-0.2, 8.4), (0.0, top), tuple(traces))


def approximation_errors(title: str) -> Panel:
    """Return the relative errors of the polynomial approximation of these costs."""
    traces = _over_delay(title, lambda criterion: 100 * approximation_error(criterion, DELAYS))
    values = np.concatenate([trace.y for trace in traces])
    low, high = float(values.min()), float(values.max())
    room = 0.12 * (high - low)
    ends = low - room, high + room
    return Panel("relative error of (5.19)", curves.DELAY, "error ρ [%]", (-0.2, 8.4), ends, tuple(traces))
