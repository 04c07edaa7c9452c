"""Scores of costs: measured maps and optima against theory, the polynomial approximation and the damped curve."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pipeline.comparison.figures.figure_data import DAMPED, shows_damped
from pipeline.comparison.scene.scene import SceneData
from pipeline.comparison.scores.agreement import rank_agreement
from pipeline.comparison.tables_d import layouts
from pipeline.device_data.published_theory import published_points
from pipeline.loop.loop import Loop
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.records.batch import Floats
from pipeline.records.criteria import criterion_of
from pipeline.records.findings import Optimum
from pipeline.records.results import ExperimentResult
from pipeline.records.score_records import MapScore, OptimumScore
from pipeline.theory.costs import point_costs_by_name
from pipeline.theory.limits import is_well_inside
from pipeline.theory.optimum import approximate_cost
from pipeline.theory.predictions import Predictions, Theory

CLOSE_TO_BOUNDARY = 1e-3
"""Distance from the theoretical boundary, relative to K, up to which costs are not compared: a response there lasts for
thousands of samples, which no log holds."""

LONGEST = 1000
"""Samples after which a theoretical response that still moves has no cost to compare: more than a log holds (400)."""

QUIET = 1e-9
"""Deviation below which overshoot is no longer looked for: a thousandth of what the sensors of the devices tell."""


def map_scores(
    data: SceneData, stages: ExperimentStages, theory: Theory, alpha: Floats, beta: Floats
) -> list[MapScore]:
    """Return measured against theoretical costs of the trials that both call stable, one score a criterion.

    Parameters
    ----------
    data : SceneData
    stages : ExperimentStages
    theory : Theory
        Its costs are those of the sampled response at the (K, B) of the trials, not interpolated from a map.
    alpha, beta : float64, shape (n,)
        Stiffness and damping of the trials, normalised by the parameters of ``theory``.
    """
    common = (alpha > 0) & (stages.verdicts.verdict == "stable")
    common[common] = is_well_inside(theory.loop, alpha[common], beta[common], CLOSE_TO_BOUNDARY)
    names = [f"{criterion}_discrete" for criterion in data.scene.criteria]
    predicted = (
        point_costs_by_name(theory.loop, alpha[common], beta[common], names, LONGEST, QUIET) if common.any() else {}
    )
    found = []
    for criterion, name in zip(data.scene.criteria, names, strict=True):
        measured = stages.sure_cost(criterion)[common]
        expected = predicted.get(name, np.empty(0))
        expected = np.where(expected <= criterion_of(criterion).family.none, 0.0, expected)
        both = np.isfinite(measured) & np.isfinite(expected)
        agreement = rank_agreement(measured[both], expected[both])
        found.append(
            MapScore(
                criterion=criterion,
                trials=int(both.sum()),
                rank_correlation=agreement.correlation,
                median_ratio=agreement.median_ratio,
                ratios=agreement.ratios,
                reason=agreement.reason,
            )
        )
    return found


def optimum_scores(
    data: SceneData, results: Sequence[ExperimentResult], theories: Mapping[str, Theory], predictions: Predictions
) -> dict[str, list[OptimumScore]]:
    """Return for each experiment how its optima deviate from the theory of the first table that holds them.

    Parameters
    ----------
    data : SceneData
    results : sequence of ExperimentResult
    theories : mapping of experiment to Theory
    predictions : Predictions
        Must hold the optima of the tables, and for a sweep those of the damped curve where it is shown.

    Notes
    -----
    The polynomial takes the factors printed in Table 5.1(b), made for k = b = 0; with damping it is an upper
    estimate (5.5).

    Source: Hulin 2017, eq. 5.19, Tables 5.1(b) and D.6, Fig. 6.12.
    """
    measured = {r.experiment: r for r in results}
    found: dict[str, dict[str, OptimumScore]] = {}
    for table in layouts(data):
        for experiment in table.experiments:
            swept = table.kind == "delay"
            damped_curve = swept and shows_damped(data)
            theory = theories.get(experiment if swept else table.theory_from)
            if theory is None:
                continue
            for criterion in table.criteria:
                optimum = measured[experiment].optimum.get(criterion)
                if optimum is not None:
                    score = _optimum(optimum, criterion, theory, predictions, table.name, damped_curve=damped_curve)
                    earlier = found.setdefault(experiment, {}).get(criterion)
                    if (
                        earlier is not None
                    ):  # its own table says where the optimum lies; the sweep adds the damped curve
                        damped = {"damped": score.damped, "damped_percent": score.damped_percent}
                        score = earlier.model_copy(update=damped) if score.damped is not None else earlier
                    found[experiment][criterion] = score
    return {experiment: list(of.values()) for experiment, of in found.items()}


def _optimum(
    optimum: Optimum, criterion: str, theory: Theory, predictions: Predictions, table: str, *, damped_curve: bool
) -> OptimumScore:
    prediction = predictions.get(theory, f"{criterion}_discrete")
    p = theory.parameters
    factor = _printed_factors().get(f"{criterion}_discrete")
    polynomial = float(approximate_cost(criterion, p.delay_samples, factor)[0]) if factor else None
    damped = None
    if damped_curve:
        damped = predictions.cost(Loop(0.0, DAMPED, p.delay_samples), f"{criterion}_discrete")
    return OptimumScore(
        criterion=criterion,
        reference=table,
        stiffness_percent=_percent(optimum.stiffness, None if prediction is None else prediction.stiffness),
        damping_percent=_percent(optimum.damping, None if prediction is None else prediction.damping),
        cost_percent=_percent(optimum.cost, None if prediction is None else prediction.cost),
        censored=optimum.censored,
        polynomial=polynomial,
        polynomial_percent=_percent(optimum.cost, polynomial),
        polynomial_valid=p.damping == 0 and p.stiffness == 0,
        damped=damped,
        damped_percent=_percent(optimum.cost, damped),
    )


def _printed_factors() -> dict[str, float]:
    """Scaling factors of the discrete costs for (5.19), as printed in Table 5.1(b)."""
    return {p.criterion: p.printed()["scaling"].value for p in published_points(("5.1(b)",))}


def _percent(measured: float, theory: float | None) -> float | None:
    """Deviation in percent of theory; None where theory is zero or missing."""
    return 100 * (measured - theory) / theory if theory else None
