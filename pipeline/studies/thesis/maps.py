"""Figures of chapter 5 with cost maps and optimal curves: 5.2 to 5.4, 5.7, 5.8 and 5.10."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pipeline.records.batch import Floats
from pipeline.studies.panels import Contours, Note, Panel, TheoryFigure, Trace
from pipeline.studies.thesis.curves import (
    box,
    cost_grid,
    damping_curve,
    flat_region,
    found_points,
    outline_trace,
    plain_loop,
    stiffness_curve,
)
from pipeline.studies.thesis.jumps import Jump, first_settling_jump, largest_overshoot_jump
from pipeline.theory.loop import Loop
from pipeline.theory.optimum import optimal_point
from pipeline.theory.poles import pole_settling_time
from pipeline.theory.search import OptimalPoint

_DELAYS = (0.0, 1.0)

_SETTLING_STEP = 5.0
"""Samples between two contour lines of Fig. 5.4."""

_SETTLING_LINES = 8
_ENERGY_LINES = 10
"""Lines of a map: beyond them, towards the boundary, they would lie closer than their width."""

_NO_OVERSHOOT_LINE = 1e-3
"""Overshoot of the line around the region without: 1e-12 itself is below what a grid resolves."""

ALPHA, BETA = "stiffness α", "damping β"


def _levels(criterion: str, best: float) -> tuple[Floats, tuple[float, ...], float, int]:
    """Levels of a criterion's contour lines, those that are labelled, their scale and decimals."""
    base = criterion.removesuffix("_discrete")
    if base == "pole_radius":
        levels = 0.05 * np.arange(np.ceil(best / 0.05 + 1e-9), 20, dtype=np.float64)
        return levels, tuple(levels[-3::2]), 1.0, 2
    if base == "damping":
        levels = 0.1 * np.arange(1, 10, dtype=np.float64)
        return levels, tuple(levels[1::2]), 1.0, 1
    if base == "overshoot":
        levels = np.concatenate([[_NO_OVERSHOOT_LINE], 0.1 * np.arange(1, 10, dtype=np.float64)])
        return levels, tuple(levels[1:8:2]), 100.0, 0
    if base.startswith("settle"):
        # half a sample aside: costs of a sampled response are whole numbers, on which a line would fray
        levels = (np.floor(best / _SETTLING_STEP) + 1 + np.arange(_SETTLING_LINES)) * _SETTLING_STEP
        shift = 0.5 if criterion != base else 0.0
        return levels + shift, tuple(levels[[0, 2, 4]] + shift), 1.0, 0
    levels = best * 2.0 ** (np.arange(1, _ENERGY_LINES + 1) / 2)
    return levels, tuple(levels[1:6:2]), 1.0, 1 if best < 100 else 0


def _plane(loop: Loop, criterion: str, title: str, extra: tuple[Trace, ...] = ()) -> Panel:
    """Map with contour lines, both optimal curves and the optimum."""
    best = optimal_point(loop, criterion)
    alpha, beta, cost = cost_grid(loop, criterion)
    levels, labelled, scale, digits = _levels(criterion, best.cost)
    x_range, y_range = box(loop)
    over_alpha, over_beta = damping_curve(loop, criterion), stiffness_curve(loop, criterion)
    traces, areas = [outline_trace(loop)], []
    for curve, turned, dash in ((over_alpha, False, "solid"), (over_beta, True, "dashed")):
        lowest, highest, given = (values[curve.found] for values in (curve.low, curve.high, curve.given))
        label = "best α for given β" if turned else "best β for given α"
        if criterion == "settle_2pct_discrete":
            for edge, name in ((lowest, f"limits of {label}"), (highest, "")):
                pair = (edge, given) if turned else (given, edge)
                traces.append(Trace(*pair, "ink" if not turned else "purple", dash, name, width=1.2))
            continue
        middle = curve.best[curve.found]
        pair = (middle, given) if turned else (given, middle)
        traces.append(Trace(*pair, "ink", dash, label, width=1.5))
    if criterion.startswith("overshoot") or (criterion == "damping" and loop.delay == 0):
        areas.append(flat_region(loop, criterion))
    traces += [*_optimum(best, criterion), *extra]
    contours = Contours(alpha, beta, cost, levels, labelled, scale, digits)
    return Panel(title, ALPHA, BETA, x_range, y_range, tuple(traces), (contours,), tuple(areas))


def _optimum(best: OptimalPoint, criterion: str) -> list[Trace]:
    if criterion == "settle_2pct_discrete" and best.box is not None:
        low_a, high_a, low_b, high_b = best.box
        corners = np.array([low_a, high_a]), np.array([low_b, high_b])
        return [Trace(*corners, "green", "none", "ends of the optimal region", "+")]
    return [Trace(np.array([best.alpha]), np.array([best.beta]), "green", "none", "optimum", "+")]


def _front(loop: Loop, criterion: str, label: str, y_range: tuple[float, float], scale: float = 1.0) -> Panel:
    """Cost along the best damping for given stiffness."""
    best = optimal_point(loop, criterion)
    alpha, _, cost = found_points(damping_curve(loop, criterion))
    mark = Trace(np.array([best.alpha]), np.array([best.cost * scale]), "green", "none", "", "+")
    x_range, _ = box(loop)
    traces = (Trace(alpha, cost * scale, "ink", "solid", "", width=1.5), mark)
    return Panel("", ALPHA, label, x_range, y_range, traces)


def _with_front(panel: Panel, front: Panel) -> Panel:
    return Panel(
        panel.title, panel.x_label, panel.y_label, panel.x_range, panel.y_range, panel.traces, panel.contours,
        panel.areas, panel.notes, below=front,
    )  # fmt: skip


def _delay_title(delay: float) -> str:
    return f"d = {delay:g}"


def figure_5_2() -> TheoryFigure:
    """Map of the pole radius."""
    panels = tuple(
        _with_front(
            _plane(plain_loop(d), "pole_radius", _delay_title(d)),
            _front(plain_loop(d), "pole_radius", "radius r", (0.5, 1.02)),
        )
        for d in _DELAYS
    )
    radii = " and ".join(f"{optimal_point(plain_loop(d), 'pole_radius').cost:.3f}" for d in _DELAYS)
    return TheoryFigure(
        "5.2",
        "Largest pole radius",
        "Lines of equal radius r, 0.05 apart, inside the stable region for γ = δ = 0; best damping for given "
        "stiffness (solid), best stiffness for given damping (dashed), optimum (plus). Below: r along the solid "
        f"curve. The smallest radius is {radii} for d = 0 and 1; from the origin up to it both curves are one.",
        panels,
    )


def figure_5_3() -> TheoryFigure:
    """Map of the damping ratio."""
    panels = tuple(
        _with_front(
            _plane(plain_loop(d), "damping", _delay_title(d)),
            _front(plain_loop(d), "damping", "damping ratio ζ", (0.0, 1.05)),
        )
        for d in _DELAYS
    )
    return TheoryFigure(
        "5.3",
        "Damping ratio of the poles",
        "Lines of equal damping ratio ζ, 0.1 apart, for γ = δ = 0, and curves as in Fig. 5.2. Without delay no pole "
        "oscillates inside the shaded region; its stiffest point is marked. With delay the region is gone, the best "
        "stiffness lies on the left boundary and the optimum in the origin, as a limit.",
        panels,
    )


def _jump_marks(found: Jump, y: tuple[float, float] | None = None) -> tuple[Trace, ...]:
    before, behind = y or (found.beta_before, found.beta_behind)
    at = np.array([found.alpha])
    return (
        Trace(at, np.array([before]), "blue", "none", "before the jump", "o"),
        Trace(at, np.array([behind]), "vermillion", "none", "behind the jump", "*"),
    )


def _pairs(base: str, front: Callable[[Loop, str], Panel], jump: Callable[[Loop], Jump]) -> tuple[Panel, ...]:
    """Maps of the sampled and the continuous response, each for both delays."""
    panels = []
    for criterion, name in ((f"{base}_discrete", "sampled response"), (base, "continuous response")):
        for d in _DELAYS:
            loop = plain_loop(d)
            extra = _jump_marks(jump(loop)) if criterion == base and d == 0 else ()
            plane = _plane(loop, criterion, f"{name}, d = {d:g}", extra)
            panels.append(_with_front(plane, front(loop, criterion)))
    return tuple(panels)


def figure_5_4() -> TheoryFigure:
    """Maps of the settling time."""

    def front(loop: Loop, criterion: str) -> Panel:
        return _front(loop, criterion, "settling time / T", (0.0, 6 * optimal_point(loop, criterion).cost))

    times = [optimal_point(plain_loop(d), f"settle_2pct{s}").cost for s in ("_discrete", "") for d in _DELAYS]
    return TheoryFigure(
        "5.4",
        "Settling time into 2 %",
        "Lines of equal settling time, five samples apart, for γ = δ = 0: of the samples (upper row) and of the "
        "motion between them (lower row). The sampled settling time is a whole number, so its optimal curves are "
        f"strips, of which both limits are drawn, and its optimum is a region. Optimal are {times[0]:.0f} and "
        f"{times[1]:.0f} samples (sampled), {times[2]:.3f} and {times[3]:.3f} (continuous). Behind the optimum the "
        "solid curve jumps wherever an extremum of the response crosses the band; circle and star are both sides of "
        "the first jump (Fig. 5.6).",
        _pairs("settle_2pct", front, first_settling_jump),
    )


def figure_5_7() -> TheoryFigure:
    """Optimal curves of pole radius and settling time, and their costs."""
    panels = []
    for d in _DELAYS:
        loop = plain_loop(d)
        x_range, y_range = box(loop)
        traces, fronts = [outline_trace(loop)], []
        for criterion, colour in (("pole_radius", "vermillion"), ("settle_2pct", "blue")):
            alpha, beta, cost = found_points(damping_curve(loop, criterion))
            given, best, _ = found_points(stiffness_curve(loop, criterion))
            name = "pole radius" if criterion == "pole_radius" else "settling time"
            point = optimal_point(loop, criterion)
            time, least = cost, point.cost
            if criterion == "pole_radius":
                time, least = pole_settling_time(cost), float(pole_settling_time(point.cost)[0])
            traces += [
                Trace(alpha, beta, colour, "solid", f"{name}: best β"),
                Trace(best, given, colour, "dashed", f"{name}: best α"),
                Trace(np.array([point.alpha]), np.array([point.beta]), colour, "none", "", "+"),
            ]
            fronts += [
                Trace(alpha, time, colour),
                Trace(np.array([point.alpha]), np.array([least]), colour, "none", "", "+"),
            ]
        front = Panel("", ALPHA, "settling time / T", x_range, (0.0, 40.0 * (d + 1)), tuple(fronts))
        panels.append(Panel(_delay_title(d), ALPHA, BETA, x_range, y_range, tuple(traces), below=front))
    return TheoryFigure(
        "5.7",
        "Pole radius against settling time",
        "Optimal curves of the largest pole radius (red) and of the 2 % settling time of the response (blue) for γ = "
        "δ = 0. Below: settling times along the solid curves, that of the radius by −4/ln r (5.4). The response "
        "settles best with more than twice the stiffness that the poles ask for.",
        tuple(panels),
    )


def figure_5_8() -> TheoryFigure:
    """Maps of the overshoot."""

    def front(loop: Loop, criterion: str) -> Panel:
        return _front(loop, criterion, "overshoot [%]", (-2.0, 60.0), 100.0)

    edges = [optimal_point(plain_loop(d), "overshoot").alpha for d in _DELAYS]
    return TheoryFigure(
        "5.8",
        "Overshoot",
        "Lines of equal overshoot, every 10 percentage points, and one at 0.1 % around the region without, for γ = δ "
        "= 0: of the samples (upper row) and of the motion between them (lower row). In the shaded region the "
        f"overshoot is at most 1e-12; it reaches up to α = {edges[0]:.3f} and {edges[1]:.3f} (plus) and over nearly "
        "all dampings. Inside of it the curves are its middle. Circle and star are both sides of the largest jump "
        "(Fig. 5.9).",
        _pairs("overshoot", front, largest_overshoot_jump),
    )


def figure_5_10() -> TheoryFigure:
    """Maps of the energy criteria."""
    loop = plain_loop(0.0)
    panels = []
    for signal in ("step", "impulse"):
        for w in (0, 1, 2):
            criterion = f"energy_{signal}_w{w}"
            plane = _plane(loop, criterion, f"{signal} response, w = {w}")
            best = optimal_point(loop, criterion)
            note = Note(best.alpha, best.beta, f"{best.cost:.2f}", "left", 9.0, 12.0, "green")
            panels.append(
                Panel(
                    plane.title, ALPHA, BETA, plane.x_range, plane.y_range, plane.traces, plane.contours, notes=(note,)
                )
            )
    return TheoryFigure(
        "5.10",
        "Energy criteria",
        "Lines of equal energy cost for the step (upper row) and the impulse (lower row), weights w = 0, 1, 2, d = 0, "
        "γ = δ = 0; two lines for each doubling, from the optimum on. The curves do not jump and cross in the "
        "optimum, whose cost is written beside it. For the impulse with w = 0 the best stiffness lies on the left "
        "boundary; with w = 1 the best damping hardly depends on stiffness.",
        tuple(panels),
        3,
    )


FIGURES = {
    "5.2": figure_5_2,
    "5.3": figure_5_3,
    "5.4": figure_5_4,
    "5.7": figure_5_7,
    "5.8": figure_5_8,
    "5.10": figure_5_10,
}
