"""Scores of theory's prediction of the stability of each experiment, with the device file or with the estimates."""

from __future__ import annotations

import numpy as np

from pipeline.base.wording import counted
from pipeline.comparison.limits import MeasuredLimits, Overlap, Stretches, measured_limits, overlap
from pipeline.comparison.loops.departures import other_gains
from pipeline.comparison.measured_damping import with_measured_damping
from pipeline.comparison.scores.agreement import boundary_distance, verdict_agreement
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.records.results import DampingScore, MeasuredExperiment, RegionScore, ScoreBasis, Scores, StiffnessScore
from pipeline.records.trials import Floats
from pipeline.theory.boundary import is_inside
from pipeline.theory.crossings import stable_intervals
from pipeline.theory.predictions import Theory


def scores_of(
    result: MeasuredExperiment, stages: ExperimentStages, theory: Theory | None, *, by_file: bool
) -> tuple[Scores, ...]:
    """Return the scores of an experiment, with reasons for missing scores.

    The tuple is empty if theory or measured limits are missing. If the measured damping differs from that of the device
    file, a second entry has the scores of theory with the measured damping.

    Parameters
    ----------
    result : MeasuredExperiment
    stages : ExperimentStages
    theory : Theory or None
    by_file : bool
        Whether theory is based on the device file, otherwise on the estimates.
    """
    gains = stages.once(other_gains)
    # If the command follows other walls, the few remaining trials give no evidence about the device in these units.
    if theory is None or (gains is not None and gains.most):
        return ()
    bases: dict[ScoreBasis, Theory] = {"device file" if by_file else "estimates": theory}
    damped = with_measured_damping(theory, result.estimates["damping"]) if by_file else None
    if damped is not None:
        bases["measured damping"] = damped
    return tuple(_scores(result, stages, each, basis) for basis, each in bases.items())


def _scores(result: MeasuredExperiment, stages: ExperimentStages, theory: Theory, basis: ScoreBasis) -> Scores:
    """Return the scores of an experiment against one theory."""
    limits = measured_limits(result.boundary)
    stretches = _theory_stretches(theory, limits.damping)
    predicted = stretches.high.max(axis=0, initial=0.0)
    K, B = stages.column("response", "stiffness"), stages.column("response", "damping")
    inside = is_inside(theory.normalised, K / theory.units.stiffness, B / theory.units.damping)
    found = {
        "region": _region(limits, stretches) if len(limits.damping) > 1 and (predicted > 0).any() else None,
        "distance": boundary_distance(limits, predicted),
        "verdicts": verdict_agreement(K, stages.verdicts.verdict, inside),
        "stiffness": _stiffness(limits, predicted, theory, result),
        "damping": _damping(theory, result),
    }
    few = f"{counted(len(limits.damping), 'tested damping')}; a region needs at least two"
    unstable = "theory has no stable wall at the tested dampings"
    why = {
        "region": few if len(limits.damping) < 2 else unstable if limits.known.any() else "no trial is stable",
        "distance": "no damping with a measured limit and a stable wall in theory",
        "verdicts": "no trial at K > 0 with a verdict",
        "stiffness": "no stable trial at K > 0, or no stable wall in theory at the tested dampings",
        "damping": "no stable trial at K > 0",
    }
    missing = {name: reason for name, reason in why.items() if found[name] is None}
    return Scores.model_validate({"parameters": theory.described, "basis": basis, "missing": missing, **found})


def _theory_stretches(theory: Theory, damping: Floats) -> Stretches:
    """Return theory's stable stiffness K >= 0 at each damping.

    There are several intervals if the stable set has gaps.
    """
    found = stable_intervals(theory.normalised, damping / theory.units.damping)
    layer = np.arange(len(found.index)) - np.searchsorted(found.index, found.index)
    shape = (int(layer.max(initial=-1)) + 1, len(damping))
    low, high = np.zeros(shape), np.zeros(shape)
    low[layer, found.index] = np.maximum(found.low, 0.0) * theory.units.stiffness
    high[layer, found.index] = np.maximum(found.high, 0.0) * theory.units.stiffness
    return Stretches(low, high)


def _region(limits: MeasuredLimits, stretches: Stretches) -> RegionScore | None:
    """Return the overlap of the stable regions inside the tested window.

    Its uncertainty follows from the intervals of the limits.
    """

    def shared(limit: Floats) -> Overlap:
        return overlap(limits.damping, Stretches.up_to(limit), stretches, limits.top)

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
    limits: MeasuredLimits, predicted: Floats, theory: Theory, result: MeasuredExperiment
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


def _damping(theory: Theory, result: MeasuredExperiment) -> DampingScore | None:
    stable = [(point.damping, point.stable) for point in result.boundary if point.stable is not None]
    if not stable:
        return None
    (measured, stiffness), known = max(stable), theory.boundary.beta_max * theory.units.damping
    beyond = [point.unstable for point in result.boundary if point.damping > measured and point.unstable is not None]
    return DampingScore(
        measured=measured,
        lower_bound=min(beyond, default=np.inf) > stiffness,
        theory=known,
        deviation_percent=100 * (measured / known - 1),
    )
