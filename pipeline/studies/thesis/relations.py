"""Figures of chapter 5 that relate criteria to rules and to delay: 5.1 and 5.12 to 5.16."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.records.batch import Floats
from pipeline.studies.panels import Area, Note, Panel, TheoryFigure, Trace
from pipeline.studies.thesis.curves import box, damping_curve, flat_region, found_points, outline_trace, plain_loop
from pipeline.theory.extent import damping_range, stiffest_point
from pipeline.theory.loop import Loop
from pipeline.theory.optimum import optimal_point
from pipeline.theory.rules import approximation_error, critical_damping, marked_point, optimal_cost, optimal_damping

ALPHA, BETA = "stiffness α", "damping β"
DELAYS = tuple(float(d) for d in range(9))

_STEP = tuple(f"energy_step_w{w}" for w in (0, 1, 2))
_IMPULSE = tuple(f"energy_impulse_w{w}" for w in (0, 1, 2))
_GROUPS = (
    ("(a) settling time and overshoot", ("settle_2pct", "overshoot", "pole_radius")),
    ("(b) energy of the step response", _STEP),
    ("(c) energy of the impulse response", _IMPULSE),
)
_LOOKS = (("purple", "o", "solid"), ("blue", "s", "dashed"), ("vermillion", "^", "dashdot"))
_NAMES = {
    "settle_2pct": "settling time",
    "overshoot": "overshoot",
    "pole_radius": "pole radius",
    "damping": "damping ratio",
    **{name: f"energy, w = {name[-1]}" for name in (*_STEP, *_IMPULSE)},
}

_SETTLING_TIMES = (2, 3, 4, 6, 10, 20, 60)
_RATIOS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
_WRITTEN = _RATIOS[::2]
"""Values of the circles and spirals of Fig. 5.1; of the spirals every second has its number."""


def figure_5_1() -> TheoryFigure:
    """Regions of poles."""
    turn = np.linspace(-np.pi, np.pi, 181)
    circle = Trace(np.cos(turn), np.sin(turn), "ink", width=1.2)
    circles, circle_notes = [circle], []
    for samples in _SETTLING_TIMES:
        r = float(np.exp(-4.0 / samples))
        circles.append(Trace(r * np.cos(turn), r * np.sin(turn), "blue", width=1.0))
        circle_notes.append(Note(0.0, r, f"{samples}", "center", 0.0, -6.0))
    spirals, spiral_notes = [circle], []
    angle = np.linspace(0, np.pi, 121)
    for ratio in _RATIOS:
        # ln z = w (-zeta + j sqrt(1 - zeta^2)): the angle grows with w, the logarithm of the radius in proportion
        radius = np.exp(-angle * ratio / np.sqrt(1 - ratio**2))
        x, y = radius * np.cos(angle), radius * np.sin(angle)
        spirals.append(Trace(np.append(x, x[::-1]), np.append(y, -y[::-1]), "vermillion", width=1.0))
        if ratio in _WRITTEN:
            spiral_notes.append(Note(float(x[60]), float(y[60]), f"{ratio:g}", "center", 0.0, -6.0))
    span = (-1.08, 1.08)
    return TheoryFigure(
        "5.1",
        "Regions of poles",
        "Left: circles around the origin; poles inside one stand for a settling time of at most the number of samples "
        "written on it, r = exp(−4/n) (5.4). Right: spirals on which a pole has the damping ratio written on it "
        "(5.5). Numbers are examples.",
        (
            Panel(
                "settling time / T", "Re z", "Im z", span, span, tuple(circles), notes=tuple(circle_notes), square=True
            ),
            Panel(
                "damping ratio ζ", "Re z", "Im z", span, span, tuple(spirals), notes=tuple(spiral_notes), square=True
            ),
        ),
    )


def _rules(loop: Loop) -> list[Trace]:
    alpha = stiffest_point(loop)[0] * np.linspace(0, 1, 81) ** 2
    return [
        Trace(alpha, critical_damping(loop, alpha), "vermillion", "dashed", "critical damping", width=1.1),
        Trace(alpha, optimal_damping(loop, alpha), "green", "dashed", "damping ratio 1/√2", width=1.1),
    ]


def _against_rules(loop: Loop, criteria: Sequence[str], title: str) -> Panel:
    x_range, y_range = box(loop)
    traces = [outline_trace(loop), *_rules(loop)]
    areas: tuple[Area, ...] = ()
    for criterion, (colour, marker) in zip(criteria, (("purple", "o"), ("blue", "D"), ("orange", "^")), strict=False):
        alpha, beta, cost = found_points(damping_curve(loop, criterion))
        best = optimal_point(loop, criterion)
        if criterion == "overshoot":
            areas = (flat_region(loop, criterion),)
            alpha, beta = alpha[cost > 0], beta[cost > 0]
        traces.append(Trace(alpha, beta, colour, "solid", _NAMES[criterion]))
        traces.append(Trace(np.array([best.alpha]), np.array([best.beta]), colour, "none", "", marker))
    return Panel(title, ALPHA, BETA, x_range, y_range, tuple(traces), (), areas)


def figure_5_12() -> TheoryFigure:
    """Rules of continuous time against optimal curves of the responses."""
    rows = (
        ("(a) settling time and overshoot", ("settle_2pct", "overshoot")),
        ("(b) energy, step", _STEP),
        ("(c) energy, impulse", _IMPULSE),
    )
    panels = tuple(
        _against_rules(plain_loop(d), names, f"{title}, d = {d:g}") for title, names in rows for d in (0.0, 1.0)
    )
    return TheoryFigure(
        "5.12",
        "Damping rules of continuous time against optimal curves",
        "Best damping for given stiffness (solid, marks at the optima) beside critical damping β + δ = 2 √(α + γ) and "
        "β + δ = √(2 (α + γ)) (dashed), γ = δ = 0. Up to its optimum the settling time follows the lower rule, and "
        "the energy curves of the step lie between both; critical damping leaves the region without overshoot "
        "(shaded) next to its tip. Nothing of that holds for the impulse.",
        panels,
    )


def figure_5_13() -> TheoryFigure:
    """Rules of continuous time against optimal curves of the poles."""
    return TheoryFigure(
        "5.13",
        "Damping rules of continuous time against the optimal curves of the poles",
        "As Fig. 5.12 for the largest pole radius and the damping ratio: neither follows one of the rules beyond the "
        "origin.",
        tuple(_against_rules(plain_loop(d), ("pole_radius", "damping"), f"d = {d:g}") for d in (0.0, 1.0)),
    )


_NUMBERED = ("pole_radius", "overshoot", "settle_2pct", *_STEP, *_IMPULSE)
"""Criteria in the order of their numbers in Fig. 5.14."""

_BESIDE = {5: (9.0, -3.0), 6: (-2.0, -9.0), 3: (8.0, -4.0), 2: (-6.0, 8.0)}
"""Pixels right and up at which a number stands where up and to the right would cover another point."""


def figure_5_14() -> TheoryFigure:
    """All optima."""
    panels = []
    for d in (0.0, 1.0, 2.0):
        loop = plain_loop(d)
        points = [optimal_point(loop, name) for name in _NUMBERED]
        rule = marked_point(loop, "ziegler_nichols")
        alpha, beta = np.array([p.alpha for p in points]), np.array([p.beta for p in points])
        notes = [
            Note(a, b, str(i), "center", *_BESIDE.get(i, (6.0, 7.0)))
            for i, (a, b) in enumerate(zip(alpha, beta, strict=True), start=1)
        ]
        notes.append(Note(rule.alpha, rule.beta, "ZN", "right", -8.0, 5.0, "vermillion"))
        traces = (
            outline_trace(loop),
            Trace(alpha, beta, "blue", "none", "optima", "."),
            Trace(np.array([rule.alpha]), np.array([rule.beta]), "vermillion", "none", "Ziegler-Nichols", "+"),
        )
        panels.append(Panel(f"d = {d:g}", ALPHA, BETA, *box(loop), traces, notes=tuple(notes)))
    return TheoryFigure(
        "5.14",
        "Optima of all criteria",
        "γ = δ = 0. 1: pole radius; 2: overshoot; 3: settling time; 4 to 6: energy of the step, w = 0, 1, 2; 7 to 9: "
        "energy of the impulse. The Ziegler-Nichols point is near number 5 without delay and near number 6 with it.",
        tuple(panels),
    )


def _ratios(criterion: str) -> tuple[Floats, Floats]:
    """Stiffness and damping of the optimum by the largest stable ones, over delay."""
    points = [optimal_point(plain_loop(d), criterion) for d in DELAYS]
    stiffest = np.array([stiffest_point(plain_loop(d))[0] for d in DELAYS])
    top = np.array([damping_range(plain_loop(d))[1] for d in DELAYS])
    return np.array([p.alpha for p in points]) / stiffest, np.array([p.beta for p in points]) / top


def figure_5_15() -> TheoryFigure:
    """Optimal by largest parameters over delay."""
    panels = []
    for title, criteria in _GROUPS:
        sides: list[tuple[list[Trace], list[Note]]] = [([], []), ([], [])]
        for criterion, (colour, marker, dash) in zip(criteria, _LOOKS, strict=True):
            for (traces, notes), ratio in zip(sides, _ratios(criterion), strict=True):
                traces.append(Trace(np.array(DELAYS), 100 * ratio, colour, dash, _NAMES[criterion], marker))
                notes.append(Note(8.0, 100 * float(ratio[-1]), f"{100 * ratio[-1]:.1f}", "left", 9.0, 0.0, colour))
        for (traces, notes), name, top in zip(sides, ("stiffness", "damping"), (60.0, 75.0), strict=True):
            label = f"optimal by largest {'α' if name == 'stiffness' else 'β'} [%]"
            panels.append(
                Panel(
                    f"{title}: {name}",
                    "delay factor d",
                    label,
                    (-0.2, 8.9),
                    (-2.0, top),
                    tuple(traces),
                    notes=tuple(notes),
                )
            )
    return TheoryFigure(
        "5.15",
        "Optimal by largest stable parameters over delay",
        "Stiffness (left) and damping (right) of the optima as a share of the largest stable ones, γ = δ = 0, integer "
        "delay factors; numbers at the right are those for d = 8. All shares tend to constants; they stay within "
        "about 49 % of the stiffness and 61 % of the damping.",
        tuple(panels),
    )


def figure_5_16() -> TheoryFigure:
    """Optimal costs over delay and their approximation."""
    panels = []
    for title, criteria in _GROUPS:
        names = [name for name in criteria if name != "overshoot"]
        costs, errors = [], []
        energy = names[0].startswith("energy")
        for criterion, (colour, marker, dash) in zip(names, _LOOKS, strict=False):
            cost = np.array([optimal_cost(plain_loop(d), criterion) for d in DELAYS])
            shown = cost / cost[-1] if energy else cost
            costs.append(Trace(np.array(DELAYS), shown, colour, dash, _NAMES[criterion], marker))
            errors.append(
                Trace(
                    np.array(DELAYS),
                    100 * approximation_error(criterion, DELAYS),
                    colour,
                    dash,
                    _NAMES[criterion],
                    marker,
                )
            )
        top = max(float(trace.y.max()) for trace in costs)
        label = "cost by that at d = 8" if energy else "settling time / T"
        title = title if energy else "(a) settling time"
        panels.append(Panel(title, "delay factor d", label, (-0.2, 8.4), (0.0, 1.08 * top), tuple(costs)))
        values = np.concatenate([trace.y for trace in errors])
        low, high = float(values.min()), float(values.max())
        room = 0.12 * (high - low)
        panels.append(
            Panel(
                "relative error of (5.19)",
                "delay factor d",
                "error ρ [%]",
                (-0.2, 8.4),
                (low - room, high + room),
                tuple(errors),
            )
        )
    return TheoryFigure(
        "5.16",
        "Optimal costs over delay, and their polynomial approximation",
        "Left: costs in the optima for γ = δ = 0, the settling time of the pole radius by (5.4), energies relative to "
        "d = 8. Right: relative error of the approximation by (d + 1)^(w+1), scaled to be exact at d = 8 (5.19, "
        "5.20). From d = 2 on it is off by less than 1.2 %. Left out as in the thesis: overshoot, whose optimal cost "
        "is 0 for each delay.",
        tuple(panels),
    )


FIGURES = {
    "5.1": figure_5_1,
    "5.12": figure_5_12,
    "5.13": figure_5_13,
    "5.14": figure_5_14,
    "5.15": figure_5_15,
    "5.16": figure_5_16,
}
