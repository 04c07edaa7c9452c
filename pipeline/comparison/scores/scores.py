"""Scores of every experiment against theory: by the parameters of its device file, and by its own estimates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from pipeline.base.wording import counted
from pipeline.comparison.compare_experiment import estimated_theories
from pipeline.comparison.loops.departures import other_gains
from pipeline.comparison.loops.told_loop import loop_delay
from pipeline.comparison.scene.scene import SceneData
from pipeline.comparison.scores.agreement import boundary_distance, verdict_agreement
from pipeline.comparison.scores.implied_slope import limits_of
from pipeline.comparison.scores.overlap import MeasuredLimits, Overlap, Stretches, measured_limits, overlap
from pipeline.comparison.scores.score_costs import map_scores, optimum_scores
from pipeline.comparison.scores.theory_band import band_score, parameter_box
from pipeline.comparison.scores.upper_bound import TheoryCurve, upper_bound
from pipeline.measured.experiment.estimates import MODEL_SHARE
from pipeline.measured.experiment.known_delay import LARGEST_OFFSET
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.records.batch import Floats
from pipeline.records.results import ExperimentResult
from pipeline.records.score_records import BoundScore, DelayScore, RegionScore, Scores, StiffnessScore
from pipeline.theory.limits import is_inside, stable_intervals
from pipeline.theory.predictions import Predictions, Theory

CURVE_POINTS = 801
"""Points of the theoretical curve that an upper bound is compared with: off by 1e-5 of the limit between them."""


def add_scores(
    data: SceneData, results: Sequence[ExperimentResult], theories: Mapping[str, Theory], predictions: Predictions
) -> list[ExperimentResult]:
    """Return the results with their scores.

    Parameters
    ----------
    data : SceneData
        Its experiments in the order of ``results``.
    results : sequence of ExperimentResult
    theories : mapping of experiment to Theory
        Theory of the tables: by the device file, or by the estimates of a device without one.
    predictions : Predictions
        Optima of the tables, computed.

    Notes
    -----
    The first scores of an experiment are those against the theory of the tables. The second ones, of a known device,
    are against theory by its estimates, where the scene draws it; they have no optima, since none are computed for
    it. The band belongs to the estimates, implied delay and upper bound stand with the first scores.
    """
    optima = optimum_scores(data, results, theories, predictions)
    estimated = estimated_theories(results, data) if data.overlay else {}
    scored = []
    for result, stages in zip(results, data.experiments, strict=True):
        gains = stages.once(other_gains)
        if gains is not None and gains.most:
            scored.append(result)  # what few trials are left says nothing of the device in these units
            continue
        name = result.experiment
        nominal, own = theories.get(name), estimated.get(name)
        found = []
        if nominal is not None:
            basis = _scores(data, result, stages, nominal, first=True, known=data.device is not None)
            found.append(basis.model_copy(update={"optima": tuple(optima.get(name, ()))}))
        if data.device is not None and own is not None:
            found.append(_scores(data, result, stages, own, first=nominal is None, known=False))
        scored.append(result.model_copy(update={"scores": tuple(found)}))
    return scored


def _scores(
    data: SceneData,
    result: ExperimentResult,
    stages: ExperimentStages,
    theory: Theory,
    *,
    first: bool,
    known: bool,
) -> Scores:
    """Scores against one theory, without optima; ``known`` tells that it is that of the device file."""
    missing: dict[str, str] = {}
    limits = measured_limits(result.boundary)
    predicted = _theory_limits(theory, limits.damping)
    few = f"{counted(len(limits.damping), 'tested damping')}; a region needs two"
    region = _region(limits, predicted, theory) if len(limits.damping) > 1 else None
    if region is None:
        unknown = "no trial is stable, so that no limit is known"
        none = "theory has no stable wall at the tested dampings" if limits.known.any() else unknown
        missing["region"] = few if len(limits.damping) < 2 else none
    distance = boundary_distance(limits, predicted)
    if distance is None:
        missing["distance"] = "no damping with a measured limit and a stable wall in theory"
    K, B = stages.column("response", "stiffness"), stages.column("response", "damping")
    alpha, beta = K / theory.units.stiffness, B / theory.units.damping
    verdicts = verdict_agreement(K, stages.verdicts.verdict, is_inside(theory.loop, alpha, beta))
    if verdicts is None:
        missing["verdicts"] = "no trial at K > 0 with a verdict"
    stiffness = _stiffness(limits, predicted, theory, result)
    if stiffness is None:
        missing["stiffness"] = "no stable trial at K > 0, or none in theory at the tested dampings"
    delay = _delay(result) if first else None
    if first and delay is None:
        missing["delay"] = _why_no_delay(result)
    bound, why = _bound(result, theory) if first else (None, "")
    if why:
        missing["bound"] = why
    band = None
    if not known:
        mass, damping, samples = result.estimates["mass"], result.estimates["damping"], loop_delay(result)
        p, model_holds = theory.parameters, _model_holds(result)
        box = parameter_box(mass, damping, samples, p.sampling_period_s, stiffness=p.stiffness, model_holds=model_holds)
        box = box and replace(box, loop=p.loop)
        band = band_score(limits, box) if box and len(limits.damping) else None
        if band is None:
            missing["band"] = "no measured limit, or no estimate of mass, damping and delay"
    return Scores(
        parameters=theory.parameters,
        basis="device file" if known else "estimates",
        region=region,
        distance=distance,
        verdicts=verdicts,
        stiffness=stiffness,
        maps=tuple(map_scores(data, stages, theory, alpha, beta)),
        delay=delay,
        band=band,
        bound=bound,
        missing=missing,
    )


def _theory_limits(theory: Theory, damping: Floats) -> Floats:
    """Largest stable stiffness [N/m, Nm/rad] at each damping, 0 where there is none."""
    limit: Floats = _theory_stretches(theory, damping).high.max(axis=0, initial=0.0)
    return limit


def _theory_stretches(theory: Theory, damping: Floats) -> Stretches:
    """Stable stiffness K >= 0 of theory at each damping; several stretches where the stable set has gaps."""
    found = stable_intervals(theory.loop, damping / theory.units.damping)
    layer = np.arange(len(found.index)) - np.searchsorted(found.index, found.index)
    shape = (int(layer.max(initial=-1)) + 1, len(damping))
    low, high = np.zeros(shape), np.zeros(shape)
    low[layer, found.index] = np.maximum(found.low, 0.0) * theory.units.stiffness
    high[layer, found.index] = np.maximum(found.high, 0.0) * theory.units.stiffness
    return Stretches(low, high)


def _region(limits: MeasuredLimits, predicted: Floats, theory: Theory) -> RegionScore | None:
    """Overlap of the stable regions inside the tested window, with what the limits' intervals leave open."""
    if not (predicted > 0).any():
        return None
    stretches = _theory_stretches(theory, limits.damping)
    top = np.where(limits.censored | ~limits.known, limits.limit, np.inf)

    def shared(limit: Floats) -> Overlap:
        return overlap(limits.damping, Stretches.up_to(limit), stretches, top)

    value, low, high = shared(limits.limit), shared(limits.low), shared(limits.high)
    if not (value.second > 0 and value.union > 0):
        return None
    return RegionScore(
        overlap=value.shared / value.union,
        overlap_low=low.shared / high.union,
        overlap_high=min(1.0, high.shared / low.union),
        covered=value.shared / value.second,
        covered_low=low.shared / low.second,
        covered_high=high.shared / high.second,
        area_ratio=value.first / value.second,
        area_ratio_low=low.first / low.second,
        area_ratio_high=high.first / high.second,
        measured_area=value.first,
        theory_area=value.second,
        damping_low=float(limits.damping[0]),
        damping_high=float(limits.damping[-1]),
        dampings=len(limits.damping),
        censored=int(limits.censored.sum()),
    )


def _stiffness(
    limits: MeasuredLimits, predicted: Floats, theory: Theory, result: ExperimentResult
) -> StiffnessScore | None:
    stable = [(p.stable, p.damping) for p in result.boundary if p.stable is not None]
    if not stable or not (predicted > 0).any():
        return None
    measured, at = max(stable)
    best = int(np.argmax(predicted))
    return StiffnessScore(
        measured=measured,
        measured_damping=at,
        lower_bound=bool((limits.censored & limits.known).any()),
        theory=float(predicted[best]),
        theory_damping=float(limits.damping[best]),
        anywhere=theory.boundary.alpha_max * theory.units.stiffness,
        anywhere_damping=theory.boundary.beta_at_alpha_max * theory.units.damping,
        deviation_percent=100 * (measured / float(predicted[best]) - 1),
    )


def _delay(result: ExperimentResult) -> DelayScore | None:
    implied, trials = result.estimates.get("implied_delay"), loop_delay(result)
    if implied is None or implied.value is None or implied.low is None or implied.high is None:
        return None
    if trials.value is None or trials.low is None or trials.high is None:
        return None
    return DelayScore(
        implied=implied.value,
        implied_low=implied.low,
        implied_high=implied.high,
        trials=trials.value,
        trials_low=trials.low,
        trials_high=trials.high,
        agree=implied.high >= trials.low - LARGEST_OFFSET and implied.low <= trials.high + LARGEST_OFFSET,
    )


def _why_no_delay(result: ExperimentResult) -> str:
    for name in ("implied_delay", "delay_samples"):
        estimate = result.estimates.get(name)
        if estimate is None:
            return "mass and damping, from which the boundary's delay follows, are not known"
        if estimate.value is None and estimate.reason:
            return estimate.reason
    return "the interval of a delay is not known"


def _model_holds(result: ExperimentResult) -> bool:
    check = result.model_check
    return check is not None and check.trials > 0 and check.explained >= MODEL_SHARE * check.trials


def _bound(result: ExperimentResult, theory: Theory) -> tuple[BoundScore | None, str]:
    border, scale = theory.boundary, theory.units
    if border.alpha_max <= 0:
        return None, "theory has no stable wall"
    beta = np.linspace(float(np.min(border.beta)), border.beta_max, CURVE_POINTS)
    curve = TheoryCurve(beta * scale.damping, _theory_limits(theory, beta * scale.damping))
    return upper_bound(limits_of(result.boundary), curve)
