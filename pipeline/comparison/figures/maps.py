"""Cost maps of experiments and theory, and the deviation of measured costs from theory.

Source: Hulin 2017, Figs. 6.5 to 6.7, 6.10 and 6.11.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.base.wording import listed
from pipeline.comparison.scene.scene import StoredData, layouts
from pipeline.comparison.scores.deviation import FEWEST
from pipeline.comparison.scores.local_planes import local_planes
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.records.criteria import OVERSHOOT, criterion_of
from pipeline.records.findings import Optimum
from pipeline.records.results import ExperimentNumbers
from pipeline.records.trials import Booleans, Floats
from pipeline.rendering.figures.boundaries import AT_LEAST, by_theory, measured, untested
from pipeline.rendering.figures.drawing import (
    BLUE,
    GREEN,
    INK,
    PAPER,
    STEPS,
    VERMILLION,
    Figure,
    Panel,
    Series,
    dots,
    reach,
)
from pipeline.rendering.labels import (
    Units,
    cost_text,
    criterion_label,
    criterion_name,
    percent_text,
    printed_scale,
    significant,
    table_label,
    with_unit,
)
from pipeline.theory.costs import cost_maps
from pipeline.theory.predictions import Predictions, Theory

if TYPE_CHECKING:
    from matplotlib.axes import Axes

POINTS = 101
"""Number of grid points along each axis of a drawn map. A finer grid does not visibly change the contours."""

FEW_NEIGHBOURS = 9
"""Number of trials used to smooth a cost. A plane fitted to more trials would smooth out valleys."""

FEWEST_DRAWN, LEAST_SHARE = 20, 0.2
"""Smallest number of stable trials with a cost, and smallest share of all stable trials, for which contours are
drawn."""

LINES_PER_DOUBLING, DOUBLINGS = 2, 5
"""Number of contour lines for costs without stated levels, from the lowest cost to 32 times this cost.

Higher lines merge with the stability boundary.
"""

OFTEN = 0.5
"""Smallest number of trials at a stiffness or damping that counts as tested often, relative to the most tested
value."""

FEWEST_OFTEN = 5
"""Smallest number of trials at such a value. With fewer trials, the best trial depends on their random positions."""

_FROM_OPTIMUM = 2 * LINES_PER_DOUBLING
"""Index of the contour level at theory's optimum. The lower levels extend to a quarter of its cost."""

FRONT_RANGE = 4.0
"""Upper end of the front view, as a multiple of the highest optimum. This is the range that matters for a choice."""

LONGEST_EDGE = 2.3
"""Longest side of a triangle for contours, in grid steps. It spans at most one missing trial."""

CELLS = (20, 14)
"""Number of cells along each axis over which deviations from theory are collected.

Each cell is wider than the largest mark and contains at least ten of 2,500 trials, so its median exceeds their scatter.
"""

RATIO_STEPS, OVERSHOOT_STEPS = (1.05, 1.1, 1.25, 1.5), (0.01, 0.02, 0.05, 0.1)
"""Deviations at which marks become larger. They are ratios of costs in either direction, and differences of overshoot.

One sensor step changes the overshoot by one percentage point.
"""

DOT, RING = 2.0, 2.6
"""Size of the dot for no deviation, and width of the ring of an open mark [px]."""


@dataclass(frozen=True, eq=False)
class CostMap:
    """Costs of a criterion over the plane. They are costs of theory on a grid, or smoothed costs of an experiment's
    trials.

    ``stiffness``, ``damping`` and ``cost`` have shape (n,) for points, and shapes (p,), (q,) and (q, p) for a grid.
    ``trials`` contains stiffness, damping and cost of the single trials, shape (3, m). ``tested`` is the largest tested
    damping, which is infinite for theory.
    """

    label: str
    stiffness: Floats
    damping: Floats
    cost: Floats
    boundary: tuple[Series, ...]
    optimum: Optimum | None
    trials: Floats
    tested: float = np.inf

    @property
    def least(self) -> tuple[Floats, Floats]:
        """Return the lowest cost of each stiffness that was tested at many dampings.

        It never exceeds the cost of a single trial.
        """
        if self.cost.ndim == 2:
            found = np.where(np.isfinite(self.cost), self.cost, np.inf).min(axis=0)
            return self.stiffness, np.where(np.isfinite(found), found, np.nan)
        known = np.isfinite(self.trials[2])
        every = _often(self.trials[0][known], self.trials[1][known])
        K = np.concatenate([self.stiffness, self.trials[0]])
        cost = np.concatenate([self.cost, self.trials[2]])
        known = np.isfinite(cost) & np.isin(K, every)
        every, place = np.unique(K[known], return_inverse=True)
        found = np.full(len(every), np.inf)
        np.minimum.at(found, place, cost[known])
        return every, found

    def best(self, along_stiffness: bool) -> tuple[Floats, Floats]:
        """Return stiffness and damping of an optimal curve.

        The curve is the best damping for each stiffness, or the best stiffness for each damping.

        If costs are equal over an interval, its middle is taken. On a grid, a parabola interpolates between points.
        """
        if self.cost.ndim == 2:
            cost, given, other = self.cost, self.stiffness, self.damping
            if not along_stiffness:
                cost, given, other = cost.T, self.damping, self.stiffness
            best = np.array([_lowest(column, other) for column in cost.T])
        else:
            given_of, other_of = (self.stiffness, self.damping) if along_stiffness else (self.damping, self.stiffness)
            given = _often(given_of, other_of)
            rows = [(self.cost[given_of == g], other_of[given_of == g]) for g in given]
            orders = [np.argsort(places) for _, places in rows]
            best = np.array([_lowest(c[o], p[o], refine=False) for (c, p), o in zip(rows, orders, strict=True)])
        known = np.isfinite(best) if len(best) else np.zeros(0, np.bool_)
        return (given[known], best[known]) if along_stiffness else (best[known], given[known])


def _often(given: Floats, other: Floats) -> Floats:
    """Return the values of one parameter that were tested at many values of the other parameter.

    At least half of the largest number of values counts as many.
    """
    pairs = np.unique(np.stack([given, other]), axis=1)
    values, counts = np.unique(pairs[0], return_counts=True)
    return np.asarray(values[counts >= max(OFTEN * counts.max(initial=0), FEWEST_OFTEN)])


def _lowest(cost: Floats, place: Floats, *, refine: bool = True) -> float:
    """Return the position of the minimum of a row of costs. It is NaN without costs, or if the minimum is at an end."""
    known = np.flatnonzero(np.isfinite(cost))
    if len(known) < 3:
        return np.nan
    equal = known[cost[known] <= cost[known].min() * (1 + 1e-9) + 1e-12]
    i = int(equal[len(equal) // 2])
    if i in (known[0], known[-1]):
        return np.nan
    if len(equal) > 1 or not refine or not np.isfinite(cost[[i - 1, i + 1]]).all():
        return float(0.5 * (place[equal[0]] + place[equal[-1]]))
    below, above = cost[i] - cost[i - 1], cost[i + 1] - cost[i]
    return float(place[i] - 0.5 * (place[i + 1] - place[i]) * (above + below) / (above - below))


def map_figures(
    data: StoredData, results: Sequence[ExperimentNumbers], theories: Mapping[str, Theory], predictions: Predictions
) -> list[Figure]:
    """Return a cost figure for each criterion of each table of optima. Theory is drawn first, then each experiment."""
    stages = {e.experiment: e for e in data.experiments}
    found: dict[str, Figure] = {}
    for table in (table for table in layouts(data) if table.kind == "optima"):
        shown = [r for r in results if r.experiment in table.experiments]
        theory = theories.get(table.theory_from)
        maps = _theory_maps(theory, shown, table.criteria, predictions) if theory else {}
        for criterion in table.criteria:
            own = [maps[criterion]] if theory else []
            own += [_measured_map(r, stages[r.experiment], criterion) for r in shown if criterion in r.optimum]
            if own:
                figure = map_figure(table.name, criterion, own, data.units)
                figure = replace(figure, caption=f"{figure.caption}{_other_devices(shown, theory, table.name)}")
                # Experiments "a b" and "a-b" would share an identifier.
                taken = f"-{len(found)}" if figure.identifier in found else ""
                found[figure.identifier + taken] = replace(figure, identifier=figure.identifier + taken)
    return list(found.values())


def _other_devices(shown: Sequence[ExperimentNumbers], theory: Theory | None, table: str) -> str:
    """Name the experiments whose stated device differs from that of theory, in a sentence after a space, or return
    ""."""
    others = [r.experiment for r in shown if theory and r.theory and r.theory.loop != theory.loop]
    where = f"theory of this device is in {table_label(table)}"
    return f" The stated device of experiment {listed(others)} differs from theory; {where}." if others else ""


def _theory_maps(
    theory: Theory, shown: Sequence[ExperimentNumbers], criteria: Sequence[str], predictions: Predictions
) -> dict[str, CostMap]:
    """Return maps of theory by criterion over its stable region and all tested walls."""
    points = [point for result in shown for point in result.boundary]
    loop, border, units = theory.loop, theory.boundary, theory.units
    stiffest = max([border.alpha_max * units.stiffness, *(p.unstable or p.stable or 0.0 for p in points)])
    dampings = [border.beta_max * units.damping, *(p.damping for p in points)]
    K, B = np.linspace(0, stiffest, POINTS), np.linspace(min(0.0, *dampings), max(dampings), POINTS)
    label = f"theory, d = {loop.delay_samples:g}, m = {loop.mass:.3g}, b = {loop.damping:.3g}"
    maps = {}
    for criterion, cost in cost_maps(theory.normalised, K / units.stiffness, B / units.damping, criteria).items():
        found = predictions.get(theory, f"{criterion}_discrete")
        best = None if found is None else Optimum(stiffness=found.stiffness, damping=found.damping, cost=found.cost)
        edge = (replace(by_theory(theory, "_boundary"), kind="edge"),)
        maps[criterion] = CostMap(label, K, B, cost, edge, best, np.empty((3, 0)))
    return maps


def _measured_map(result: ExperimentNumbers, stages: ExperimentStages, criterion: str) -> CostMap:
    """Return the map of an experiment, which contains the smoothed costs of its stable trials and the trials
    themselves."""
    cost = stages.sure_cost(criterion)
    K, B = stages.column("response", "stiffness"), stages.column("response", "damping")
    verdict = stages.verdicts.verdict
    shown, stable = (K > 0) & (verdict != "unstable"), (K > 0) & (verdict == "stable")
    known = stable & np.isfinite(cost)
    drawn = known if known.sum() >= max(FEWEST_DRAWN, LEAST_SHARE * stable.sum()) else np.zeros_like(known)
    name = f"experiment {result.experiment}" + (f", {result.configuration}" if result.configuration else "")
    limit, *bounds = measured(result.boundary, "_boundary", None)
    edge = (replace(limit, kind="edge"), *bounds)
    smooth = _smoothed(K[drawn], B[drawn], cost[drawn], criterion)
    trials = np.stack([K[shown], B[shown], cost[shown]])
    tested = float(B[K > 0].max(initial=0.0))
    return CostMap(name, K[drawn], B[drawn], smooth, edge, result.optimum.get(criterion), trials, tested)


def _smoothed(K: Floats, B: Floats, cost: Floats, criterion: str) -> Floats:
    """Return costs smoothed by planes over neighbouring trials. With few trials, they are returned unchanged."""
    if len(cost) < FEWEST:
        return cost
    if criterion_of(criterion).family.levels:
        return np.maximum(local_planes(K, B, cost, FEW_NEIGHBOURS).of(cost), 0.0)
    values = np.log(np.maximum(cost, np.finfo(np.float64).tiny))
    return np.asarray(np.exp(local_planes(K, B, values, FEW_NEIGHBOURS).of(values)))


def map_figure(table: str, criterion: str, maps: Sequence[CostMap], units: Units) -> Figure:
    """Return maps of a criterion side by side, with the name of the table that lists their optima."""
    family, label = criterion_of(criterion).family, table_label(table)
    edges = [s for each in maps for s in each.boundary]
    limits = (0.0, reach(*(s.x for s in edges), *(m.trials[0] for m in maps))[1]), reach(*(s.y for s in edges))
    lowest = [float(np.nanmin(m.least[1])) for m in maps if np.isfinite(m.least[1]).any()]
    top = family.levels[-1] if family.levels else FRONT_RANGE * max(lowest, default=1.0)
    levels = _levels(criterion, maps)
    lines = (
        f"every 10 percentage points; the heavy line surrounds overshoot up to {100 * family.levels[0]:g} %, the "
        "coarsest resolution of a log that counts; dots: trials without overshoot within the resolution of their log"
        if family is OVERSHOOT
        else f"equal levels in all panels, two for each doubling of {cost_text(criterion, levels[_FROM_OPTIMUM])}"
        if levels.size
        else "none"
    )
    tried = any(m.trials.size for m in maps)
    caption = (
        f"{'Theory left. ' if maps[0].cost.ndim == 2 else ''}Black: stability limit. Green: lines of equal cost, "
        f"{lines}"
        f"{'; measured costs are smoothed over neighbouring trials' if tried else ''}. Plus: optimum as in {label}"
        f"{', for experiments the best single trial' if tried else ''}. Blue: best damping for each stiffness, dashed: "
        f"best stiffness for each damping. Below: least cost for each stiffness"
        f"{' that was tested at many dampings, and all trials' if tried else ''}."
    )
    region = max((float(s.y.max()) for m in maps if m.cost.ndim == 2 for s in m.boundary), default=0.0)
    corner = limits[0][1], limits[1][1]
    shown = [replace(m, boundary=(*untested(m.tested, region, corner), *m.boundary)) for m in maps]
    panels = tuple(_map_panel(each, criterion, limits, top, units, levels) for each in shown)
    drawn = {s.kind for m in shown for s in m.boundary}
    caption += f" {AT_LEAST}" if "bound" in drawn else ""
    caption += " Grey area: dampings that were not tested." if "untested" in drawn else ""
    size = (350.0, 430.0) if len(maps) > 2 else (440.0, 500.0)
    identifier = re.sub(r"[^A-Za-z0-9_-]", "-", f"{table}-{criterion}")
    title = f"Cost maps, {criterion_label(criterion)}"
    return Figure("maps", identifier, title, caption, panels, criterion_name(criterion), f"costs, {label}", size)


def _map_panel(shown: CostMap, criterion: str, limits: Any, top: float, units: Units, levels: Floats) -> Panel:
    factor, family = printed_scale(criterion), criterion_of(criterion).family
    K, B, cost = shown.trials
    inside, best, least = cost <= top, shown.optimum, shown.least
    third = {"value": B[inside], "value_name": f"damping B [{units.damping}]"}
    front = [Series("_trials", "dots", K[inside], cost[inside] * factor, **third)]
    front.append(Series("_least cost", "line", least[0], least[1] * factor))
    map_series, remark = list(shown.boundary), "No optimum is known."
    for kind, along in (("best", True), ("best other", False)):
        x, y = shown.best(along)
        map_series += [Series(f"_{kind}", kind, x, y)] if len(x) > 2 else []
    if family is OVERSHOOT and shown.trials.size:
        free = cost <= 0
        map_series.append(Series("_without overshoot", "dots", K[free], B[free]))
    if best is not None:
        place = np.array([best.stiffness])
        map_series.append(Series("_optimum", "optimum", place, np.array([best.damping])))
        front.append(Series("_optimum", "optimum", place, np.array([best.cost * factor])))
        at = f"{significant(best.stiffness, 4)} {units.stiffness} and {significant(best.damping, 4)} {units.damping}"
        remark = f"Optimum {cost_text(criterion, best.cost)} at {at}."
    words = f"{shown.label}, {criterion_label(criterion)}: lines of equal cost. {remark}"
    names = (f"stiffness K [{units.stiffness}]", f"damping B [{units.damping}]")
    value, axes = partial(_draw_optimum, shown, criterion), (names[0], with_unit(family.title, family.printed_unit))
    below = Panel("", axes, tuple(front), "", (limits[0], (0.0, top * factor)), value)
    contours = partial(_contours, shown, criterion, levels)
    return Panel(shown.label, ("", names[1]), tuple(map_series), words, limits, contours, below)


def _draw_optimum(shown: CostMap, criterion: str, axes: Axes) -> None:
    best, factor = shown.optimum, printed_scale(criterion)
    top = axes.get_ylim()[1] / factor
    if best is None or best.cost > top:
        return
    text = cost_text(criterion, best.cost) + (" %" if factor != 1 else "")
    offset = (0, -15 if best.cost > 0.2 * top else 14)  # otherwise, the value would collide with the axis
    axes.annotate(
        text, (best.stiffness, best.cost * factor), offset, "data", textcoords="offset points",
        color=BLUE, fontweight="bold", ha="center", va="center",
    )  # fmt: skip


def _contours(shown: CostMap, criterion: str, levels: Floats, axes: Axes) -> None:
    """Draw labelled contour lines, heavier at each doubling, so that they can be counted in greyscale.

    Levels below the map's cost at its optimum are skipped, because they would exclude the plus. Single trials may have
    lower costs by chance than the costs around them. The optimum by overshoot is not the least cost, but the stiffest
    wall without overshoot.
    """
    from matplotlib.colors import to_rgb

    known = np.isfinite(shown.cost)
    if not known.any():
        few = "too few trials" if np.isfinite(shown.trials[2]).any() else "no trial"
        axes.text(0.5, 0.94, f"{few} with this cost", transform=axes.transAxes, ha="center")
        return
    opacity = dict(zip(levels.tolist(), np.linspace(1.0, 0.45, max(levels.size, 1)), strict=False))
    edge = criterion_of(criterion).family.levels[:1]
    heavy = dict(zip(levels.tolist(), np.arange(levels.size) % LINES_PER_DOUBLING == 0, strict=True))
    least, most = float(np.nanmin(shown.cost)) if edge else _at_optimum(shown), float(shown.cost[known].max())
    drawn = [x for x in levels.tolist() if least * (1 + 1e-3) < x < most]
    factor = printed_scale(criterion)
    widths = [1.5 if (x <= edge[0] if edge else heavy[x]) else 0.9 for x in drawn]
    colours = [(*to_rgb(GREEN), opacity[x]) for x in drawn]
    lines: Any = None
    if shown.cost.ndim == 2:
        lines = (
            axes.contour(
                shown.stiffness,
                shown.damping,
                _without_steps(shown.cost, criterion),
                drawn,
                linewidths=widths,
                colors=colours,
            )
            if drawn
            else None
        )
    elif (triangles := _triangles(shown.stiffness, shown.damping)) is not None:
        lines = axes.tricontour(triangles, shown.cost, drawn, linewidths=widths, colors=colours) if drawn else None
    if lines is not None:
        numbered = [x for x in drawn if not edge or x > edge[0]][:: 2 if edge else 1][:3]
        axes.clabel(lines, numbered, fmt=lambda level: significant(level * factor, 3), fontsize=10.5, colors=INK)


def _at_optimum(shown: CostMap) -> float:
    """Return the cost of a map at its optimum. For trials, it is smoothed and exceeds the cost of the best trial."""
    least, best = float(np.nanmin(shown.cost)), shown.optimum
    if shown.cost.ndim == 2 or best is None:
        return least
    at = (shown.stiffness == best.stiffness) & (shown.damping == best.damping)
    return float(shown.cost[at].max()) if at.any() else least


def _levels(criterion: str, maps: Sequence[CostMap]) -> Floats:
    """Return the contour levels of all panels. They are the levels of the family, or two levels per doubling from
    theory's optimum.

    Without theory, they start from the lowest optimum. Some levels are lower, because experiments may be better than
    theory.
    """
    levels = np.array(criterion_of(criterion).family.levels)
    if levels.size:
        return levels
    known = [each.optimum.cost for each in maps if each.optimum is not None and each.optimum.cost > 0]
    if not known:
        return np.empty(0)
    first = known[0] if maps[0].cost.ndim == 2 and maps[0].optimum is not None else min(known)
    # A level equal to many costs (settling times are integers) would give frayed lines along plateaus.
    exponents = np.arange(-_FROM_OPTIMUM, DOUBLINGS * LINES_PER_DOUBLING + 1) / LINES_PER_DOUBLING
    return np.asarray(first * 2.0**exponents * (1 + 1e-6))


def _without_steps(cost: Floats, criterion: str) -> Floats:
    """Return a smoothed map of integer costs, whose steps would give frayed contour lines."""
    if not criterion_of(criterion).family.whole:
        return cost
    from scipy.ndimage import gaussian_filter

    known = np.isfinite(cost) & (cost > 0)
    total = gaussian_filter(np.where(known, np.log(np.where(known, cost, 1.0)), 0.0), 1.0)
    weight = gaussian_filter(known.astype(np.float64), 1.0)
    return np.where(known, np.exp(total / np.where(known, weight, 1.0)), np.nan)


def _triangles(K: Floats, B: Floats) -> Any:
    """Triangulate tested walls, with distances in grid steps. Return None if the walls span no area."""
    from matplotlib.tri import Triangulation

    order = np.lexsort((K, B))
    same = np.diff(B[order]) == 0
    steps = np.diff(K[order])[same]
    k_step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0
    b_steps = np.diff(np.unique(B))
    b_step = float(np.median(b_steps)) if b_steps.size else 1.0
    points, first = np.unique(np.column_stack([K / k_step, B / b_step]), axis=0, return_index=True)
    if len(points) < 3 or np.linalg.matrix_rank(points - points[0]) < 2:
        return None
    triangles = Triangulation(K / k_step, B / b_step, first[Triangulation(points[:, 0], points[:, 1]).triangles])
    corners = np.column_stack([triangles.x, triangles.y])[triangles.triangles]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    if (longest > LONGEST_EDGE).all():
        return None
    return Triangulation(K, B, triangles.triangles, mask=longest > LONGEST_EDGE)


def departure_figures(data: StoredData, theories: Mapping[str, Theory], predictions: Predictions) -> list[Figure]:
    """Return a figure for each criterion in the tables.

    It shows the deviation of measured costs from theory at the tested walls.
    """
    asked = {c for table in layouts(data) for c in table.criteria}
    criteria = tuple(c for c in data.scene.criteria if c in asked)
    shown = [e for e in data.experiments if e.experiment in theories]
    points = {e.experiment: (e.column("response", "stiffness"), e.column("response", "damping")) for e in shown}
    edges = {name: replace(by_theory(theories[name], "_boundary"), kind="edge") for name in points}
    x = [float(np.append(edges[name].x, K).max()) for name, (K, _) in points.items()]
    y = [float(np.append(edges[name].y, B).max()) for name, (_, B) in points.items()]
    cell = max(x, default=1.0) / CELLS[0], max(y, default=1.0) / CELLS[1]
    limits = ((0.0, reach(*(e.x for e in edges.values()))[1]), reach(*(e.y for e in edges.values())))
    expected = {name: predictions.costs_at(theories[name], *points[name], criteria) for name in points if criteria}
    figures = []
    for criterion in criteria:
        panels = []
        for stages in shown:
            name = stages.experiment
            found = departures(stages.sure_cost(criterion), expected[name][criterion], criterion)
            found[stages.verdicts.verdict != "stable"] = np.nan
            if np.isfinite(found).any():
                panel = _departure_panel(name, (*points[name], found), criterion, cell, data.units)
                panels.append(replace(panel, series=(edges[name], *panel.series), limits=limits))
        if panels:
            name = criterion_name(criterion)
            differs = criterion_of(criterion).family.levels
            caption = (
                f"Median {'difference in percentage points' if differs else 'deviation in percent'} of measured cost "
                f"from theory over the stable trials of a cell. Filled marks: larger, open marks: smaller, dots: less "
                f"than {_step_texts(criterion)[0]}. Black: limit by theory."
            )
            about = (f"residual-{criterion}", f"Measured against theory, {name}", caption, tuple(panels), name)
            figures.append(Figure("residuals", *about, "measured against theory, all experiments", (350.0, 310.0)))
    return figures


def departures(measured_: Floats, expected: Floats, criterion: str) -> Floats:
    """Return the deviation of measured from theoretical costs.

    It is the difference for costs that may be zero, otherwise the ratio minus one.
    """
    family = criterion_of(criterion).family
    expected = np.where(expected <= family.none, 0.0, expected)
    if family.levels:
        return np.asarray(measured_ - expected)
    positive = (measured_ > 0) & (expected > 0)
    return np.where(positive, np.where(positive, measured_, 1.0) / np.where(positive, expected, 1.0) - 1, np.nan)


def _departure_panel(
    name: str, trials: tuple[Floats, Floats, Floats], criterion: str, cell: tuple[float, float], units: Units
) -> Panel:
    """Return marks of an experiment. ``trials`` are stiffness, damping and deviation, ``cell`` is width and height."""
    import pandas as pd

    differs = bool(criterion_of(criterion).family.levels)
    K, B, departure = trials
    frame = pd.DataFrame({"K": np.floor(K / cell[0]), "B": np.floor(B / cell[1]), "off": departure}).dropna()
    cells = frame.groupby(["B", "K"], as_index=False).median()
    x, y = ((cells[axis].to_numpy() + 0.5) * width for axis, width in zip("KB", cell, strict=True))
    off = cells["off"].to_numpy()
    # Ratios above and below one count equally.
    size = np.abs(off) if differs else np.where(off > 0, 1 + off, 1 / (1 + off))
    step = np.searchsorted(OVERSHOOT_STEPS if differs else RATIO_STEPS, size, side="right")
    classes = (np.sign(off) * step).astype(int)
    unit = "points" if differs else "%"
    middle = f"{percent_text(100 * float(np.median(frame['off'])))} {unit}"
    departures = Series("_measured against theory", "hover", x, y, value=100 * off, value_name=f"departure [{unit}]")
    names = (f"stiffness K [{units.stiffness}]", f"damping B [{units.damping}]")
    above, below = int((classes > 0).sum()), int((classes < 0).sum())
    words = f"Measured against theory in {len(off)} cells: median {middle}; larger in {above}, smaller in {below}."
    title = f"experiment {name}: median {middle}"
    nothing = np.empty(0)
    key = (Series(f"from {step} on", f"step {n}", nothing, nothing) for n, step in enumerate(_step_texts(criterion)))
    return Panel(title, names, (departures, *key), words, paint=partial(_marks, x, y, classes))


def _step_texts(criterion: str) -> list[str]:
    """Return the deviations at which marks become larger as text, such as ``5 %``."""
    if criterion_of(criterion).family.levels:
        return [f"{100 * step:.0f} points" for step in OVERSHOOT_STEPS]
    return [f"{100 * (step - 1):.0f} %" for step in RATIO_STEPS]


def _marks(x: Floats, y: Floats, classes: np.ndarray, axes: Axes) -> None:
    dots(axes, x[classes == 0], y[classes == 0], INK, DOT)
    for value in sorted(set(classes.tolist()) - {0}):
        at: Booleans = classes == value
        size = STEPS[abs(value) - 1]
        dots(axes, x[at], y[at], VERMILLION if value > 0 else BLUE, size, square=True)
        if value < 0:
            dots(axes, x[at], y[at], PAPER, size - RING, square=True)
