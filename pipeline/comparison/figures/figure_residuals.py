"""Where measured costs depart from theory: residuals at the (K, B) of the trials, gathered in cells of the plane."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from pipeline.comparison.figures.boundary_curves import theory_curve
from pipeline.comparison.scene.scene import SceneData
from pipeline.comparison.tables_d import layouts
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.records.batch import Booleans, Floats
from pipeline.records.criteria import criterion_of
from pipeline.records.figure_records import Curve, Figure, ResidualMap
from pipeline.rendering.labels import criterion_label
from pipeline.theory.predictions import Predictions, Theory

CELLS = (20, 14)
"""Cells along both axes of the largest region: each is wider than the largest mark, and holds ten trials or more of a
course of 2,500, so that its median says more than their scatter."""


def residual_figures(
    data: SceneData, theories: Mapping[str, Theory], predictions: Predictions
) -> tuple[Figure[ResidualMap], ...]:
    """Return one figure a criterion, with a map of each experiment that has a theory; none without common trials.

    Parameters
    ----------
    data : SceneData
    theories : mapping of str to Theory
        By the device file, or by the estimates of a device without one.
    predictions : Predictions

    Notes
    -----
    The criteria are those of the tables of optima. Theory is that of the sampled response at the trials' own
    (K, B), not interpolated from a map, and of each experiment's own parameters.
    """
    asked = {c for table in layouts(data) for c in table.criteria}
    criteria = tuple(c for c in data.scene.criteria if c in asked)
    shown = [e for e in data.experiments if e.experiment in theories]
    if not shown or not criteria:
        return ()
    points = {e.experiment: (e.column("response", "stiffness"), e.column("response", "damping")) for e in shown}
    edges = {e.experiment: theory_curve(theories[e.experiment], "boundary") for e in shown}
    stiffest = max(float(max(edges[n].stiffness.max(), points[n][0].max())) for n in edges)
    highest = max(float(max(edges[n].damping.max(), points[n][1].max())) for n in edges)
    cell = (stiffest / CELLS[0], highest / CELLS[1])
    expected = {name: predictions.costs_at(theories[name], *points[name], criteria) for name in points}
    figures = []
    for criterion in criteria:
        maps = []
        for stages in shown:
            name = stages.experiment
            found = _map(stages, edges[name], points[name], expected[name][criterion], criterion, cell)
            maps += [found] if found.trials else []
        if maps:
            figures.append(_figure(criterion, tuple(maps)))
    return tuple(figures)


def _map(
    stages: ExperimentStages,
    boundary: Curve,
    point: tuple[Floats, Floats],
    expected: Floats,
    criterion: str,
    cell: tuple[float, float],
) -> ResidualMap:
    measured = stages.sure_cost(criterion)
    expected = np.where(expected <= criterion_of(criterion).family.none, 0.0, expected)
    common = (stages.verdicts.verdict == "stable") & np.isfinite(measured) & np.isfinite(expected)
    residual = np.full(len(measured), np.nan)
    residual[common] = residuals(measured[common], expected[common], criterion)
    common &= np.isfinite(residual)
    k, b, middle = cell_medians(point[0], point[1], residual, common, cell)
    return ResidualMap(
        f"experiment {stages.experiment}",
        k,
        b,
        middle,
        boundary,
        int(common.sum()),
        float(np.median(residual[common])) if common.any() else np.nan,
    )


def residuals(measured: Floats, expected: Floats, criterion: str) -> Floats:
    """Return measured against theoretical costs: difference of costs that may be zero, else log2 of the ratio.

    Parameters
    ----------
    measured, expected : float64, shape (n,)
        Finite costs. A ratio with a cost of zero is NaN.
    """
    if criterion_of(criterion).family.levels:
        return measured - expected
    positive = (measured > 0) & (expected > 0)
    return np.where(positive, np.log2(np.where(positive, measured, 1.0) / np.where(positive, expected, 1.0)), np.nan)


def cell_medians(
    stiffness: Floats, damping: Floats, values: Floats, use: Booleans, cell: tuple[float, float]
) -> tuple[Floats, Floats, Floats]:
    """Return centre and median of each cell that holds a point.

    Parameters
    ----------
    stiffness, damping, values : float64, shape (n,)
    use : bool, shape (n,)
        Points that count.
    cell : tuple of float
        Size of a cell; one corner lies at the origin.

    Returns
    -------
    stiffness, damping, median : float64, shape (m,)
    """
    column, row = np.floor(stiffness[use] / cell[0]), np.floor(damping[use] / cell[1])
    order = np.lexsort((values[use], column, row))
    column, row, values = column[order], row[order], values[use][order]
    if not len(values):
        return values, values, values
    new = np.append(True, (np.diff(column) != 0) | (np.diff(row) != 0))
    first = np.flatnonzero(new)
    size = np.diff(np.append(first, len(values)))
    median = 0.5 * (values[first + (size - 1) // 2] + values[first + size // 2])
    return (column[first] + 0.5) * cell[0], (row[first] + 0.5) * cell[1], median


def _figure(criterion: str, maps: tuple[ResidualMap, ...]) -> Figure[ResidualMap]:
    difference = "difference in percentage points" if criterion_of(criterion).family.levels else "ratio"
    return Figure(
        "residuals",
        "residual-" + re.sub(r"[^A-Za-z0-9_-]", "-", criterion),
        f"Measured against theory, {criterion_label(criterion).split(' [')[0]}",
        f"Median {difference} of measured and theoretical cost over the stable trials of each cell, theory at the "
        "trials' own stiffness and damping with each experiment's own parameters.",
        maps,
        criterion,
        "measured against theory, all experiments",
    )
