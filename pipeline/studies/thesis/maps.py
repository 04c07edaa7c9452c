"""Panels of chapter 5 with cost maps and optimal curves: Figs. 5.2 to 5.4, 5.7, 5.8 and 5.10."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from pipeline.loop.loop import Loop
from pipeline.records.batch import Floats
from pipeline.records.criteria import DISCRETE, ENERGY, OVERSHOOT, POLES, SETTLING, criterion_of
from pipeline.studies.figure import Contours, Note, Panel, Trace, mark
from pipeline.studies.thesis import curves
from pipeline.studies.thesis.jumps import Jump, first_settling_jump, largest_overshoot_jump
from pipeline.theory.cost.poles import pole_settling_time
from pipeline.theory.optimum.optimum import optimal_point
from pipeline.theory.optimum.search import OptimalPoint

_SETTLING_STEP = 5.0
"""Samples between two contour lines of Fig. 5.4."""

_SETTLING_LINES = 8
_ENERGY_LINES = 10
"""Lines of a map: beyond them, towards the boundary, they would lie closer than their width."""

_NO_OVERSHOOT_LINE = 1e-3
"""Overshoot of the line around the region without: 1e-12 itself is below what a grid resolves."""

_FRONTS = {
    "pole_radius": ("radius r", (0.5, 1.02), 1.0),
    "damping": ("damping ratio ζ", (0.0, 1.05), 1.0),
    "settle_2pct": ("settling time / T", (0.0, 6.0), 1.0),
    "overshoot": ("overshoot [%]", (-2.0, 60.0), 100.0),
}
"""Costs along the best damping that stand under a map: label, range (of the settling time by the optimum), factor."""

_JUMPS = {"settle_2pct": first_settling_jump, "overshoot": largest_overshoot_jump}
"""Jumps that are marked in the map of the continuous response without delay."""


def cost_map(criterion: str, delay: float) -> Panel:
    """Return the map of a criterion with contour lines, both optimal curves, the optimum, and the cost below."""
    loop, base = curves.plain_loop(delay), criterion_of(criterion)
    best = optimal_point(loop, criterion)
    lines = [curves.outline_trace(loop), *_optimal_curves(loop, criterion), _optimum(best, criterion)]
    if criterion in _JUMPS and delay == 0:
        lines += _jump_marks(_JUMPS[criterion](loop))
    levels, labelled, scale, digits = _levels(criterion, best.cost)
    contours = Contours(*curves.cost_grid(loop, criterion), levels, labelled, scale, digits)
    flat = base.family is OVERSHOOT or (criterion == "damping" and delay == 0)
    return replace(
        curves.plane(loop, _title(criterion, delay), lines),
        contours=(contours,),
        areas=(curves.flat_region(loop, criterion),) if flat else (),
        below=_front(loop, criterion, best) if base.name in _FRONTS else None,
    )


def energy_map(criterion: str) -> Panel:
    """Return the map of an energy criterion without delay, with its least cost written beside the optimum."""
    best = optimal_point(curves.plain_loop(0.0), criterion)
    note = Note(best.alpha, best.beta, f"{best.cost:.2f}", "left", 9.0, 12.0, "green")
    return replace(cost_map(criterion, 0.0), notes=(note,))


def _title(criterion: str, delay: float) -> str:
    base = criterion_of(criterion)
    if base.family is ENERGY:
        return f"{base.signal} response, w = {base.weight}"
    if base.family is POLES:
        return f"d = {delay:g}"
    return f"{'sampled' if criterion.endswith(DISCRETE) else 'continuous'} response, d = {delay:g}"


def _levels(criterion: str, best: float) -> tuple[Floats, tuple[float, ...], float, int]:
    """Levels of a criterion's contour lines, those that are labelled, their scale and decimals."""
    family = criterion_of(criterion).family
    tenths = 0.1 * np.arange(1, 10, dtype=np.float64)
    if criterion == "pole_radius":
        levels = 0.05 * np.arange(np.ceil(best / 0.05 + 1e-9), 20, dtype=np.float64)
        return levels, tuple(levels[-3::2]), 1.0, 2
    if family is POLES:
        return tenths, tuple(tenths[1::2]), 1.0, 1
    if family is OVERSHOOT:
        return np.append(_NO_OVERSHOOT_LINE, tenths), tuple(tenths[0:7:2]), 100.0, 0
    if family is SETTLING:
        # half a sample aside: costs of a sampled response are whole numbers, on which a line would fray
        levels = (np.floor(best / _SETTLING_STEP) + 1 + np.arange(_SETTLING_LINES)) * _SETTLING_STEP
        levels += 0.5 if criterion.endswith(DISCRETE) else 0.0
        return levels, tuple(levels[[0, 2, 4]]), 1.0, 0
    levels = best * 2.0 ** (np.arange(1, _ENERGY_LINES + 1) / 2)
    return levels, tuple(levels[1:6:2]), 1.0, 1 if best < 100 else 0


def _optimal_curves(loop: Loop, criterion: str) -> Iterator[Trace]:
    """Best damping for given stiffness and the reverse; of the sampled settling time both ends of the best values."""
    looks = ("best β for given α", "ink", "solid"), ("best α for given β", "purple", "dashed")
    over_alpha, over_beta = curves.damping_curve(loop, criterion), curves.stiffness_curve(loop, criterion)
    for curve, (label, colour, dash) in zip((over_alpha, over_beta), looks, strict=True):
        strip = criterion == "settle_2pct_discrete"
        edges = {f"limits of {label}": curve.low, "": curve.high} if strip else {label: curve.best}
        for name, edge in edges.items():
            pair = curve.given[curve.found], edge[curve.found]
            place = pair if curve is over_alpha else pair[::-1]
            yield Trace(*place, colour if strip else "ink", dash, name, width=1.2 if strip else 1.5)


def _optimum(best: OptimalPoint, criterion: str) -> Trace:
    if criterion == "settle_2pct_discrete" and best.box is not None:
        corners = np.array(best.box[:2]), np.array(best.box[2:])
        return Trace(*corners, "green", "none", "ends of the optimal region", "+")
    return mark(best.alpha, best.beta, "green", "+", "optimum")


def _jump_marks(found: Jump) -> list[Trace]:
    return [
        mark(found.alpha, found.beta_before, "blue", "o", "before the jump"),
        mark(found.alpha, found.beta_behind, "vermillion", "*", "behind the jump"),
    ]


def _front(loop: Loop, criterion: str, best: OptimalPoint) -> Panel:
    """Cost along the best damping for given stiffness."""
    base = criterion_of(criterion)
    label, (low, high), factor = _FRONTS[base.name]
    top = high * best.cost if base.family is SETTLING else high
    alpha, _, cost = curves.found_points(curves.damping_curve(loop, criterion))
    line = Trace(alpha, cost * factor, "ink", "solid", "", width=1.5)
    traces = (line, mark(best.alpha, best.cost * factor, "green", "+"))
    return Panel("", curves.ALPHA, label, curves.box(loop)[0], (low, top), traces)


def poles_against_response(delay: float) -> Panel:
    """Return optimal curves of pole radius and settling time, with the settling times of both below."""
    loop = curves.plain_loop(delay)
    traces, fronts = [curves.outline_trace(loop)], []
    for criterion, name, colour in (
        ("pole_radius", "pole radius", "vermillion"),
        ("settle_2pct", "settling time", "blue"),
    ):
        alpha, beta, time = curves.found_points(curves.damping_curve(loop, criterion))
        given, best, _ = curves.found_points(curves.stiffness_curve(loop, criterion))
        point = optimal_point(loop, criterion)
        least = point.cost
        if criterion == "pole_radius":
            time, least = pole_settling_time(time), float(pole_settling_time(least)[0])
        traces.append(Trace(alpha, beta, colour, "solid", f"{name}: best β"))
        traces.append(Trace(best, given, colour, "dashed", f"{name}: best α"))
        traces.append(mark(point.alpha, point.beta, colour, "+"))
        fronts += [Trace(alpha, time, colour), mark(point.alpha, least, colour, "+")]
    top = 40.0 * (delay + 1)
    front = Panel("", curves.ALPHA, "settling time / T", curves.box(loop)[0], (0.0, top), tuple(fronts))
    return replace(curves.plane(loop, f"d = {delay:g}", traces), below=front)
