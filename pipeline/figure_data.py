"""Arrays behind the figures: boundaries, cost maps and the delay sweep, measured beside theory."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.aggregate import without_overshoot
from pipeline.batch import Floats
from pipeline.labels import criterion_label
from pipeline.loop import Loop
from pipeline.maps import cost_maps
from pipeline.models import ComparisonRow, Estimate, Experiment, Optimum, TableLayout
from pipeline.predictions import Prediction, Predictions, Request, Theory
from pipeline.results import (
    BoundaryFigure,
    CostFigure,
    CostMap,
    Curve,
    DelayFigure,
    DelayPanel,
    ExperimentResult,
    TheoryParameters,
)
from pipeline.scene import SceneData
from pipeline.stages import ExperimentStages
from pipeline.tables_d import layouts

MAP_POINTS = 101
"""Grid points along each axis of a drawn map; finer ones change no contour visibly."""

NARROW_BAND = 0.01
"""Relative difference of the largest stable stiffness below which two boundaries look the same."""

DAMPED = 0.02
"""Relative damping delta of the second theory curve of Fig. 6.12, the upper end of the range of 3.3."""

_EMPTY = np.empty(0)


def theory_curve(theory: Theory, label: str, kind: str = "theory") -> Curve:
    """Return the theoretical boundary in physical units, closed along K = -k."""
    border, units = theory.boundary, theory.units
    stiffness = np.append(border.alpha, -theory.loop.gamma) * units.stiffness
    damping = np.append(border.beta, border.beta[-1]) * units.damping
    return Curve(label, kind, stiffness, damping)


def measured_curve(result: ExperimentResult) -> Curve:
    """Return the measured boundary: the last stable stiffness at each damping, 0 where none was stable."""
    stable = [p.stable is not None for p in result.boundary]
    # dampings without a stable trial beside those with one close the curve; further ones tell nothing
    points = [p for i, p in enumerate(result.boundary) if any(stable[max(i - 1, 0) : i + 2])]
    return Curve(
        f"experiment {result.experiment}",
        "measured",
        np.array([p.stable or 0.0 for p in points]),
        np.array([p.damping for p in points]),
        np.array([float(p.censored) for p in points]),
    )


def linear_curve(theory: Theory) -> Curve:
    """Return the linear condition K = (b + B)/t_r up to the largest stable stiffness (3.25)."""
    p = theory.parameters
    effective_delay = (p.delay_samples + 0.5) * p.sampling_period_s
    stiffness = np.array([0.0, 0.6 * theory.boundary.alpha_max * theory.units.stiffness])
    return Curve("linear condition (3.25)", "linear", stiffness, stiffness * effective_delay - p.damping)


def requests_of_delay_figure(data: SceneData, theories: Mapping[str, Theory]) -> list[Request]:
    """Return the theoretical optima of the damped curve of the delay figure."""
    return [
        (Loop(0.0, DAMPED, theories[e].parameters.delay_samples), f"{criterion}_discrete")
        for table in layouts(data)
        if table.kind == "delay"
        for e in table.experiments
        if e in theories
        for criterion in table.criteria
    ]


@dataclass(frozen=True)
class FigureBuilder:
    """Builds the figures of a scene from finished results."""

    data: SceneData
    theories: Mapping[str, Theory]
    results: Sequence[ExperimentResult]

    def boundaries(self) -> tuple[BoundaryFigure, ...]:
        """Return boundary figures: without and with operator, over delay, and from the estimates."""
        if self.data.scene.delay_sweep:
            figures = [self._delay_boundaries()]
        else:
            figures = [self._free_boundaries(), *self._operator_boundaries()]
        figures.append(self._estimate_boundaries())
        return tuple(figure for figure in figures if figure is not None)

    def _free_boundaries(self) -> BoundaryFigure | None:
        free = [r for r in self.results if r.grip == "none" and r.experiment in self.theories]
        if not free or self.data.device is None:
            return None
        curves = [measured_curve(r) for r in free]
        settings = {r.experiment: self.theories[r.experiment].parameters for r in free}
        experiments = {e.name: e for e in self.data.device.experiments}
        delays = sorted({d for r in free if r.experiment in experiments for d in _delays(experiments[r.experiment])})
        values = list(dict.fromkeys((p.mass, p.damping, p.stiffness) for p in settings.values()))
        template = next(iter(settings.values()))
        for index, (m, b, k) in enumerate(values):
            for number, d in enumerate(delays or [template.delay_samples]):
                parameters = template.model_copy(
                    update={"mass": m, "damping": b, "stiffness": k, "delay_samples": float(d)}
                )
                label = f"d = {d:g}" if index == 0 else f"theory, b = {b:g}" if number == 0 else "_"
                curves.append(theory_curve(Theory(parameters), label, "band" if index else "theory"))
        curves.append(linear_curve(self.theories[free[0].experiment]))
        m, b, k = values[0]
        others = ", ".join(f"{other[1]:g}" for other in values[1:])
        return BoundaryFigure(
            "boundaries-free",
            "Stability boundaries without operator",
            f"Measured: last stable stiffness at each damping. Theory for m = {m:g}, b = {b:g}, k = {k:g} and the "
            f"delay factors at the curves{f'; thin dots: the same with b = {others}' if others else ''}. "
            "In the manner of Fig. 6.3.",
            (("", tuple(curves)),),
        )

    def _operator_boundaries(self) -> list[BoundaryFigure]:
        held = [r for r in self.results if r.grip != "none" and r.experiment in self.theories]
        if not held:
            return []
        panels = []
        for configuration in dict.fromkeys(r.configuration for r in held):
            shown = [r for r in self.results if r.configuration == configuration and r.experiment in self.theories]
            curves = [measured_curve(r) for r in shown]
            curves += [theory_curve(self.theories[r.experiment], f"theory, {_grip(r.grip)}") for r in shown]
            curves = [
                Curve(f"{c.label}, {_grip(r.grip)}", c.kind, c.stiffness, c.damping, c.censored)
                for c, r in zip(curves[: len(shown)], shown, strict=True)
            ] + curves[len(shown) :]
            panels.append((configuration, tuple(curves)))
        return [
            BoundaryFigure(
                "boundaries-operator",
                "Influence of the operator on the stability boundary",
                "Measured and theoretical boundaries for each grip; theory for the parameters in the table. "
                "In the manner of Fig. 6.4.",
                tuple(panels),
            )
        ]

    def _delay_boundaries(self) -> BoundaryFigure | None:
        theory = [
            theory_curve(self.theories[r.experiment], f"d = {self.theories[r.experiment].parameters.delay_samples:g}")
            for r in self.results
            if r.experiment in self.theories
        ]
        measured = []
        for r in self.results:
            curve = measured_curve(r)
            measured.append(Curve(r.experiment, "measured", curve.stiffness, curve.damping, curve.censored))
        panels = [("theory", tuple(theory))] if theory else []
        return BoundaryFigure(
            "boundaries-delay",
            "Influence of delay on the stability boundary",
            "Theory left, measured right, for each total delay; open markers: tested range ended before a trial was "
            "unstable. In the manner of Fig. 6.9.",
            (*panels, ("measured", tuple(measured))),
        )

    def _estimate_boundaries(self) -> BoundaryFigure | None:
        if not self.data.overlay:
            return None
        panels = []
        for result in self.results:
            theories = band_of_estimates(result, self.theories.get(result.experiment), self._period(result))
            if theories:
                curves = [measured_curve(result), *(theory_curve(t, label, kind) for label, kind, t in theories)]
                panels.append((f"experiment {result.experiment}", tuple(curves)))
        if not panels:
            return None
        return BoundaryFigure(
            "boundaries-estimates",
            "Boundaries predicted from what the logs say",
            "Theory with the estimated mass, damping and delay of each experiment; thin dots: theory for the "
            "ends of the 95 % intervals that give the smallest and the largest region, where these differ.",
            tuple(panels),
        )

    def _period(self, result: ExperimentResult) -> float:
        return next(e.sampling_period_s for e in self.data.experiments if e.experiment == result.experiment)

    def costs(self, predictions: Predictions) -> tuple[CostFigure, ...]:
        """Return one cost figure for each criterion of each table of optima."""
        stages = {e.experiment: e for e in self.data.experiments}
        figures = []
        for table in layouts(self.data):
            if table.kind == "delay":
                continue
            theory = self.theories.get(table.theory_from)
            shown = [r for r in self.results if r.experiment in table.experiments]
            window = self._window(theory, shown)
            maps = _theory_maps(theory, window, table) if theory else {}
            for criterion in table.criteria:
                panels = []
                if theory:
                    optimum = _as_optimum(predictions.get(theory, f"{criterion}_discrete"))
                    panels.append(_theory_panel(theory, window, maps[criterion], optimum))
                panels += [_measured_panel(r, stages[r.experiment], criterion) for r in shown if criterion in r.optimum]
                if not panels:
                    continue
                figures.append(_cost_figure(table, criterion, tuple(panels), theory))
        return tuple(figures)

    def _window(self, theory: Theory | None, shown: Sequence[ExperimentResult]) -> tuple[float, float, float]:
        """Largest stiffness, smallest and largest damping that a cost figure shows."""
        stiffness = [p.unstable or p.stable or 0.0 for r in shown for p in r.boundary]
        damping = [p.damping for r in shown for p in r.boundary]
        if theory:
            stiffness.append(theory.boundary.alpha_max * theory.units.stiffness)
            damping.append(theory.boundary.beta_max * theory.units.damping)
        return max(stiffness, default=1.0), min([0.0, *damping]), max(damping, default=1.0)

    def delays(self, rows: Sequence[ComparisonRow], predictions: Predictions) -> tuple[DelayFigure, ...]:
        """Return the figure of optimal costs over delay, if there is a sweep."""
        figures = []
        for table in layouts(self.data):
            if table.kind != "delay":
                continue
            panels = []
            for criterion in table.criteria:
                of = [r for r in rows if r.table == table.name and r.criterion == criterion]
                delays = sorted({r.delay_samples for r in of if r.delay_samples is not None})
                theory = _by_delay(of, "theory_discrete", delays)
                measured = _by_delay(of, "experiment", delays)
                damped = [self._damped_cost(d, criterion, predictions) for d in delays]
                label = f"theory, δ = {DAMPED:g}"
                panels.append(DelayPanel(criterion, np.array(delays), theory, np.array(damped), label, measured))
            figures.append(
                DelayFigure(
                    "delay",
                    "Optimal costs over delay",
                    "Costs of the sampled response at the optimum, theory and experiment. In the manner of Fig. 6.12.",
                    tuple(panels),
                )
            )
        return tuple(figures)

    def _damped_cost(self, delay: float, criterion: str, predictions: Predictions) -> float:
        parameters = TheoryParameters(
            mass=1.0, damping=DAMPED, stiffness=0.0, sampling_period_s=1.0, delay_samples=delay, source="normalised"
        )
        return predictions.get(Theory(parameters), f"{criterion}_discrete").cost


def band_of_estimates(
    result: ExperimentResult, nominal: Theory | None, sampling_period_s: float
) -> list[tuple[str, str, Theory]]:
    """Return label, kind and theory for the estimates of an experiment, then for the ends of their intervals.

    Empty without estimates; without the ends where they cannot be told apart in a figure.

    The stable region grows with mass and damping and shrinks with delay, so the ends of the intervals give the
    smallest and the largest region. A damping below zero counts as zero: the theory asks for delta >= 0.
    """
    mass, damping, delay = (result.estimates[name] for name in ("mass", "damping", "delay_samples"))
    if mass.value is None or damping.value is None or delay.value is None:
        return []
    stiffness = nominal.parameters.stiffness if nominal else 0.0

    def theory(m: float, b: float, d: float) -> Theory:
        return Theory(
            TheoryParameters(
                mass=m,
                damping=max(b, 0.0),
                stiffness=stiffness,
                sampling_period_s=sampling_period_s,
                delay_samples=max(d, 0.0),
                source="estimates of this experiment",
            )
        )

    found = [("theory from estimates", "theory", theory(mass.value, damping.value, delay.value))]
    (m_low, m_high), (b_low, b_high), (d_low, d_high) = (_interval(e) for e in (mass, damping, delay))
    # the upper end of the delay interval is open (6.3): the largest factor that occurred is one less
    smallest, largest = theory(m_low, b_low, max(d_high - 1, d_low)), theory(m_high, b_high, d_low)
    if _reach(largest) > _reach(smallest) * (1 + NARROW_BAND):
        found += [("smallest region of the intervals", "band", smallest), ("largest", "band", largest)]
    return found


def _reach(theory: Theory) -> float:
    """Largest stable stiffness in physical units."""
    return theory.boundary.alpha_max * theory.units.stiffness


def _interval(estimate: Estimate) -> tuple[float, float]:
    """Interval of an estimate that has a value; the value itself where it has none."""
    value = estimate.value or 0.0
    low = value if estimate.low is None else estimate.low
    return low, value if estimate.high is None else estimate.high


def _delays(experiment: Experiment) -> list[float]:
    jitter = experiment.jitter_samples
    return [float(d) for d in range(min(jitter), max(jitter) + 2)] if jitter else [experiment.delay_samples]


def _grip(grip: str) -> str:
    return "no operator" if grip == "none" else f"{grip} grip"


def _as_optimum(prediction: Prediction) -> Optimum:
    return Optimum(stiffness=prediction.stiffness, damping=prediction.damping, cost=prediction.cost)


def _by_delay(rows: Sequence[ComparisonRow], condition: str, delays: Sequence[float]) -> Floats:
    found = {r.delay_samples: r.cost for r in rows if r.condition == condition and r.cost is not None}
    return np.array([found.get(d, np.nan) for d in delays])


def _theory_maps(theory: Theory, window: tuple[float, float, float], table: TableLayout) -> dict[str, Floats]:
    alpha, beta = _axes(window)
    return cost_maps(theory.loop, alpha / theory.units.stiffness, beta / theory.units.damping, table.criteria)


def _axes(window: tuple[float, float, float]) -> tuple[Floats, Floats]:
    stiffest, lowest, highest = window
    return np.linspace(0, stiffest, MAP_POINTS), np.linspace(lowest, highest, MAP_POINTS)


def _theory_panel(theory: Theory, window: tuple[float, float, float], cost: Floats, optimum: Optimum) -> CostMap:
    p = theory.parameters
    label = f"theory, d = {p.delay_samples:g}, m = {p.mass:.3g}, b = {p.damping:.3g}"
    return CostMap(
        label, "theory", *_axes(window), cost, theory_curve(theory, "boundary"), optimum, _EMPTY, _EMPTY, _EMPTY
    )


def _measured_panel(result: ExperimentResult, stages: ExperimentStages, criterion: str) -> CostMap:
    cost, _ = stages.cost(criterion)
    if criterion == "overshoot":
        cost = np.where(without_overshoot(cost, stages.column("overshoot", "overshoot_floor")), 0.0, cost)
    k, b = stages.column("response", "stiffness"), stages.column("response", "damping")
    shown = (k > 0) & (stages.verdicts.verdict != "unstable")
    k, b, cost = k[shown], b[shown], cost[shown]
    levels = np.unique(b) if len(b) else np.zeros(1)
    optimum = result.optimum.get(criterion)
    axis = _stiffness_axis(k, len(levels), optimum)
    grid = np.full((len(levels), len(axis)), np.nan)
    for row, level in enumerate(levels):
        at = np.flatnonzero((b == level) & np.isfinite(cost))
        if len(at) > 1:
            order = at[np.argsort(k[at], kind="stable")]
            # along K a course is dense enough to interpolate; beyond its first and last trial nothing is claimed
            grid[row] = np.interp(axis, k[order], cost[order], left=np.nan, right=np.nan)
    name = f"experiment {result.experiment}" + (f", {result.configuration}" if result.configuration else "")
    return CostMap(name, "measured", axis, levels, grid, measured_curve(result), optimum, k, b, cost)


def _stiffness_axis(stiffness: Floats, levels: int, optimum: Optimum | None) -> Floats:
    """Stiffness values that were tried at a tenth of the dampings or more, and that of the optimum.

    The second pass of a course refines each column around its own limit only; as grid lines those values would be gaps.
    """
    values, count = np.unique(stiffness, return_counts=True)
    common = values[count >= min(max(2, 0.1 * levels), count.max(initial=1))]
    axis = np.union1d(common, [optimum.stiffness] if optimum else [])
    return axis if len(axis) > 1 else np.array([0.0, 1.0])


def _cost_figure(table: TableLayout, criterion: str, panels: tuple[CostMap, ...], theory: Theory | None) -> CostFigure:
    name = criterion_label(criterion)
    return CostFigure(
        re.sub(r"[^A-Za-z0-9_-]", "-", f"{table.name}-{criterion}"),
        f"Cost maps, {name}",
        f"Costs of the sampled response in the stable region{', theory left' if theory else ''}; below, the least cost "
        f"for each stiffness and all trials. Optima as in Table {table.name}.",
        criterion,
        panels,
    )
