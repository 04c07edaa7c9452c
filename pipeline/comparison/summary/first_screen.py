"""Collect the data of a report's first screen.

These are the recommended wall, certainty, agreement with theory, causes, and the next measurement.
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from statistics import median
from typing import Literal

import numpy as np

from pipeline.base.errors import DeviceError, UsageError
from pipeline.base.wording import counted, first_clause, listed
from pipeline.comparison.limits import measured_limits
from pipeline.comparison.loops.departures import other_gains
from pipeline.comparison.loops.loop_basis import identified_device
from pipeline.comparison.loops.recording_faults import unsafe_recording
from pipeline.comparison.scene.scene import StoredData
from pipeline.comparison.scores.agreement import FEWEST_COMPARISONS, boundary_distance
from pipeline.comparison.summary.summary_warnings import NEEDED
from pipeline.device.parameters import unit_of
from pipeline.loop.normalised_loop import LARGEST_DELAY
from pipeline.measured.experiment.boundary import spread_over_plane
from pipeline.measured.identification.identifiability import Recorded
from pipeline.measured.stages.stage_device import recording
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.planning.campaign import TRIALS, Campaign, PlanOptions, campaign_of, forecast_of
from pipeline.planning.planner import NOTES, plan_of
from pipeline.records.findings import MATTERS
from pipeline.records.models import ComparisonRow, Experiment
from pipeline.records.results import (
    REACHED,
    Answer,
    AnswerEstimate,
    Cause,
    DistanceScore,
    ExperimentNumbers,
    NextWall,
    Prediction,
    ReachableCost,
    TestedWall,
)
from pipeline.rendering.labels import (
    Units,
    estimate_texts,
    quantity_name,
    share_text,
    significant,
    unit_text,
)
from pipeline.simulation.simulate import applied_delay_moments
from pipeline.theory.reachable import reachable

COARSE = 5.0
"""Smallest increase of an optimal cost by the grid of the trials [%] for which the grid is reported as coarse."""

MOST_CAUSES = 2
"""Largest number of causes on the first screen. The tables list all."""

DRIFTING = 3
"""Smallest number of parameters that drift with the wall for which no parameter has an interval.

Of six tests at 5 %, one may fail by chance, and many trials reveal a small drift. If the model of the device is wrong,
mass, damping and delay all drift.
"""

WRONG_RECORDING = "the logs were not recorded as required for limits"
"""Reason why no limit is compared, for faulty recordings."""

OTHER_GAINS = "the command follows another wall than the headers state"
"""Reason why a limit in the units of the headers has no meaning."""

WELL = 0.9
"""Smallest overlap of the regions for which theory predicts a boundary. It allows an error of 5 % in both K and B."""

BEYOND = 0.15
"""Distance of the next damping from the largest tested damping, relative to the latter, before the next damping is
rounded up to a multiple of the tested spacing."""

BY_CHANCE = 0.05
"""Expected share of limits that lie outside their 95 % intervals by chance."""

COSTS_WITHIN = (10.0, 30.0)
"""Largest median deviation of costs [%] for which theory predicts them, and for which it predicts them partly."""

CLOSE = 0.05
"""Largest median distance of limits from those of the identified device with friction, for which this device predicts
the limits."""


@dataclass(frozen=True)
class NextStep:
    """Next wall, or the reason why there is none, and the number of required dampings at which verdicts give the
    limit."""

    wall: NextWall | None = None
    reason: str = ""
    limits_known: int = 0
    limits_wanted: int = 0


def most_informative(results: Sequence[ExperimentNumbers]) -> int:
    """Return the index of the experiment to unfold, which is the first with the most answers."""
    return max(range(len(results)), key=lambda i: (_worth(results[i]), -i))


def answer(
    data: StoredData, stages: ExperimentStages, result: ExperimentNumbers, rows: Sequence[ComparisonRow]
) -> Answer:
    """Return the answers about an experiment.

    Parameters
    ----------
    data : StoredData
    stages : ExperimentStages
    result : ExperimentNumbers
        Result of these stages, with scores and walls to use.
    rows : sequence of ComparisonRow
        Rows of all experiments. Their costs are judged together, because a single experiment has too few.
    """
    known = data.device.experiments if data.device else ()
    of_file = next((each for each in known if each.name == result.experiment), None)
    gains = stages.once(other_gains)
    fault = stages.once(unsafe_recording)
    misled = fault is not None or (gains is not None and gains.most)
    first = f"Correct the recording first: {fault.remedy}".rstrip(".") if fault else "Correct the headers first"
    step = NextStep(reason=first) if misled else _next(data, result, of_file, stages)
    causes = [*result.causes, *_other_parameters(result, of_file, data.units)]
    wall = result.use.point if result.use else None
    return Answer(
        experiment=result.experiment,
        wall=wall,
        wall_reason=result.use_reason or "",
        wall_trials=result.use.trials if result.use else 0,
        wall_criterion=result.use.criterion if result.use else "",
        wall_costs=result.use.costs.get(result.use.criterion) if result.use and result.use.trials > 1 else None,
        safest=None if wall is not None or misled else _safest(stages),
        spacing_percent=_spacing(result, rows, stages),
        estimates=_estimates(result, data.units, limit=not misled),
        estimates_reason=_doubt(result),
        predicts=_prediction(result, rows, "" if not misled else WRONG_RECORDING if fault else OTHER_GAINS),
        reachable=None if misled else _reachable(result, rows),
        causes=tuple(causes[:MOST_CAUSES]),
        next=step.wall,
        next_reason=step.reason,
        limits_told=step.limits_known,
        limits_wanted=step.limits_wanted,
    )


def _safest(stages: ExperimentStages) -> TestedWall | None:
    """Return the stable tested wall whose motion decays fastest, or None if no trial with K > 0 is stable."""
    K, B = stages.column("response", "stiffness"), stages.column("response", "damping")
    growth = stages.verdicts.growth_per_s
    calm = np.flatnonzero((stages.verdicts.verdict == "stable") & (K > 0) & np.isfinite(growth))
    if not len(calm):
        return None
    best = int(calm[np.argmin(growth[calm])])
    return TestedWall(stiffness=float(K[best]), damping=float(B[best]), decay_per_s=-float(growth[best]))


def _worth(result: ExperimentNumbers) -> tuple[bool, bool, bool]:
    """Return three flags: an experiment has a limit to compare with theory, a wall to use, and any limit."""
    return bool(result.scores and _known(result)), result.use is not None, bool(result.boundary)


def _known(result: ExperimentNumbers) -> bool:
    """Return whether the region shows where the device becomes unstable. With stable trials only, any overlap is 1."""
    region = result.scores[0].region if result.scores else None
    return region is not None and region.censored < region.dampings


def _spacing(result: ExperimentNumbers, rows: Sequence[ComparisonRow], stages: ExperimentStages) -> float | None:
    """Return the spacing of the tested stiffnesses above the wall to use [%].

    The result is None unless the coarse grid increases the cost considerably.
    """
    parts = [row.deviation for row in rows if row.deviation and row.experiment == result.experiment]
    if result.use is None or max((part.grid or 0.0 for part in parts), default=0.0) < COARSE:
        return None
    K, B = stages.column("response", "stiffness"), stages.column("response", "damping")
    point = result.use.point
    above = K[(point.damping == B) & (point.stiffness < K)]
    return float(100 * (above.min() / point.stiffness - 1)) if len(above) else None


def _estimates(result: ExperimentNumbers, units: Units, *, limit: bool) -> tuple[AnswerEstimate, ...]:
    """Return delay, mass, damping, friction, largest limit and replay, preferably from a device fitted to all
    trials."""
    found, doubt = [], _doubt(result)
    for name in ("delay_samples", "mass", "damping", "friction"):
        estimate = result.estimates.get(name)
        if estimate is None:
            continue
        estimate = result.delay if name == "delay_samples" else estimate.by_method.get("model", estimate)
        unknown = estimate.reason if estimate.missing_code == "not_identifiable" else None
        bounded = name == "friction" and estimate.high is not None and not doubt
        if estimate.value is not None or bounded or unknown:
            ends = (None, None) if doubt else (estimate.low, estimate.high)
            reason = unknown if estimate.value is None and not bounded else None
            unit = unit_text(estimate.unit)
            low, high = ends
            found.append(AnswerEstimate(name=name, value=estimate.value, low=low, high=high, unit=unit, reason=reason))
    point, largest = result.stiffest, result.largest_limit
    if point is not None and largest is not None and limit:
        found.append(
            AnswerEstimate(
                name="stiffness_max",
                value=largest.stiffness,
                low=largest.low,
                high=None if largest.censored else largest.high,
                unit=units.stiffness,
                large_motion=largest.stiffness_large_motion,
                damping=largest.damping,
                at_last_damping=_ends_at_last_damping(result),
                bracketed=point.estimate is None and not largest.censored,
            )
        )
    replay = result.replay
    if replay is not None and replay.verdicts_same is not None and limit:
        found.append(
            AnswerEstimate(
                name="replay",
                value=100 * replay.verdicts_same,
                low=None,
                high=None,
                unit="%",
                limits_off_percent=replay.limits_off_percent,
                limits_known_percent=replay.limits_known_percent if replay.limits_open else None,
            )
        )
    return tuple(found)


def _doubt(result: ExperimentNumbers) -> str:
    """Return why there are no intervals of delay, mass, damping and friction, or "" if there are."""
    doubts = {name: {doubt.code for doubt in result.estimates[name].doubts} for name in NEEDED}
    drifting = [quantity_name(name) for name, codes in doubts.items() if "drift" in codes]
    if len(drifting) >= DRIFTING:
        return f"No intervals, because no single model explains all trials: {listed(drifting)} drift with the wall."
    if all(result.estimates[name].value is None for name in NEEDED):
        why = result.estimates["mass"].reason or "no usable trial"
        return f"{why[0].upper()}{why[1:].rstrip('.')}."
    loop, fitted = result.loop, "model" in result.estimates["delay_samples"].by_method
    if loop is None or loop.adequate or fitted:
        return ""
    return f"No intervals, because the loop is not adequate: {first_clause(loop.reason)}."


def _other_parameters(result: ExperimentNumbers, of_file: Experiment | None, units: Units) -> list[Cause]:
    """Return a cause with the parameters of the device file that differ from the logs.

    They lie more than `MATTERS` outside the intervals from the logs. The list is empty if there are none.
    """
    scores = result.scores[0] if result.scores else None
    if scores is None or scores.basis != "device file" or scores.distance is None:
        return []
    if abs(scores.distance.median) < MATTERS or result.loop is None or not result.loop.adequate:
        return []
    device = scores.parameters.loop.apparent()
    jitter, delay = of_file.jitter_samples if of_file else (), device.delay_samples
    if jitter and result.delay.value is not None and result.delay.value < delay:
        delay = max(applied_delay_moments(jitter)[0], min(delay, result.delay.value))
    stated = (
        ("m", device.mass, result.estimates["mass"], units.mass),
        ("b", device.damping, result.estimates["damping"], units.damping),
        ("d", delay, result.delay, "samples"),
    )
    off = [
        f"{name} = {significant(value, 3)} {unit}, logs {' to '.join(estimate_texts(found)[1:])}"
        for name, value, found, unit in stated
        if found.low is not None
        and found.high is not None
        and max(found.low - value, value - found.high) > MATTERS * abs(value)
    ]
    sentence = "Parameters estimated from the logs differ from the device file."
    return [Cause(code="parameter_range", sentence=sentence, evidence="; ".join(off))] if off else []


def _prediction(result: ExperimentNumbers, rows: Sequence[ComparisonRow], misled: str) -> Prediction:
    """Judge whether theory predicts the device, from the limits of one experiment and the costs of all experiments.

    ``misled`` is the reason why the logs give no limit, or "".
    """
    region = result.scores[0].region if result.scores else None
    distance = result.scores[0].distance if result.scores else None
    if misled:
        return Prediction(code="unknown", reason=misled.rstrip("."))
    costs = [
        abs(row.deviation.model if row.own_model_percent is None else row.own_model_percent)
        for row in rows
        if row.deviation and row.deviation.steady
    ]
    percent = median(costs) if len(costs) >= FEWEST_COMPARISONS else None
    theory = result.scores[0] if result.scores else None
    judged = partial(
        Prediction,
        costs=len(costs),
        costs_percent=percent,
        optimal_costs=None if percent is None else _graded(*(percent <= most for most in COSTS_WITHIN)),
        costs_experiments=len({row.experiment for row in rows if row.deviation and row.deviation.steady}),
        dampings=len(result.boundary),
        delay_samples=None if theory is None else theory.parameters.loop.apparent().delay_samples,
        of_file=theory is not None and theory.basis == "device file",
        **_tested_range(result),
    )
    if region is None and (rubbed := _with_friction(result)) is not None:
        return judged(code="with_friction", percent_with_friction=_percent(rubbed), limits=rubbed.dampings)
    if region is None or distance is None:
        return judged(code="unknown", reason="no theoretical prediction to compare limits with")
    if not _known(result):
        why = (
            f"no trial was unstable at any of {counted(region.dampings, 'tested damping')}; according to theory, "
            f"{share_text(region.overlap, 0)} % of the tested region is stable"
        )
        return judged(code="unknown", reason=why)
    if distance.dampings < FEWEST_COMPARISONS:
        return judged(code="unknown", reason=_too_few_limits(result, distance))
    outside = distance.bounded - distance.agreeing
    rubbed = None if region.overlap >= WELL else _with_friction(result)
    return judged(
        code="yes" if region.overlap >= WELL else "with_friction" if rubbed is not None else "no",
        percent=_percent(distance),
        percent_with_friction=_percent(rubbed),
        limits=distance.dampings,
        bounded=distance.bounded,
        above=distance.above,
        below=distance.bounded - distance.agreeing - distance.above,
        overlap_percent=100 * region.overlap,
        safe=distance.above > 0 and distance.agreeing + distance.above == distance.bounded,
        apart=distance.apart,
        boundary=_graded(outside <= max(BY_CHANCE * distance.bounded, 1), region.overlap >= WELL),
    )


def _tested_range(result: ExperimentNumbers) -> dict[str, float]:
    """Return the largest tested damping and the largest stable damping of theory, if the latter is far larger."""
    damping, tested = result.scores[0].damping if result.scores else None, [p.damping for p in result.boundary]
    if damping is None or max(tested) >= REACHED * damping.theory:
        return {}
    return {"tested_up_to": max(tested), "stable_up_to": damping.theory}


def _too_few_limits(result: ExperimentNumbers, distance: DistanceScore) -> str:
    """State how many limits are known and needed to judge theory, and at which dampings to record more.

    The prediction of the identified loop at one of these dampings is included.
    """
    unknown = [point.damping for point in result.boundary if point.limit is None or point.censored]
    if not unknown and (damping := _untested_damping(result)) is not None:
        unknown = [damping]
    at = f"; record more, for example at B = {listed([f'{B:g}' for B in unknown[:3]])}" if unknown else ""
    near_zero = " (those near K = 0 are left out)" if distance.near_zero else ""
    text = f"{counted(distance.dampings, 'limit')} to compare{near_zero}, {FEWEST_COMPARISONS} are needed{at}"
    if distance.bounded and result.scores[0].basis != "estimates":  # such a theory agrees with its own logs
        text += f". {distance.agreeing} of {distance.bounded} agree with theory within their interval"
    best = max(result.loop_boundary or (), key=lambda limit: limit.stiffness, default=None)
    if best is None:
        return text
    return f"{text}. The identified loop predicts K = {significant(best.stiffness, 3)} at B = {best.damping:g}"


def _untested_damping(result: ExperimentNumbers) -> float | None:
    """Return the untested damping whose limit is most informative, or None if fewer than two dampings are tested.

    If the largest limit is at the largest tested damping, return a larger damping, because the limit may still rise.
    Otherwise, return the middle of the widest gap.
    """
    B = np.array([point.damping for point in result.boundary])
    if len(B) < 2:
        return None
    if _ends_at_last_damping(result):
        spacing = B[-1] - B[-2]
        return float(B[-1] + spacing * np.ceil(BEYOND * B[-1] / spacing))
    widest = int(np.argmax(np.diff(B)))
    return float(0.5 * (B[widest] + B[widest + 1]))


def _ends_at_last_damping(result: ExperimentNumbers) -> bool:
    """Return whether the largest limit is at the largest tested damping."""
    return result.stiffest is not None and result.stiffest.damping == max(p.damping for p in result.boundary)


def _graded(well: bool, partly: bool) -> Literal["yes", "partly", "no"]:
    return "yes" if well else "partly" if partly else "no"


def _reachable(result: ExperimentNumbers, rows: Sequence[ComparisonRow]) -> ReachableCost | None:
    """Return the lowest cost that the delay of an experiment allows, or None if delay or period is unknown.

    The optimum of theory is that of the rows, which includes damping and operator of the loop.
    """
    period, loop = result.sampling_period_s, result.loop
    delay = loop.delay_samples.value if loop is not None and loop.delay_samples is not None else result.delay.value
    if delay is None or period is None:
        return None
    lag = loop.actuator_lag_s.value if loop is not None and loop.actuator_lag_s is not None else None
    whole = delay + (lag or 0.0) / period
    if not 0 <= whole <= LARGEST_DELAY:
        return None
    rule, best = reachable("settle_2pct", whole), result.optimum.get("settle_2pct")
    return ReachableCost(
        delay_samples=whole,
        best=rule.cost,
        reached=None if best is None else best.cost,
        per_sample=rule.per_sample,
        within=rule.within,
        optimum=next(
            (
                row.cost / (1 + deviation / 100)
                for row in rows
                if row.experiment == result.experiment and row.criterion == "settle_2pct" and row.cost is not None
                for deviation in (row.own_deviation_percent, row.deviation_percent)
                if deviation is not None
            ),
            None,
        ),
    )


def _with_friction(result: ExperimentNumbers) -> DistanceScore | None:
    """Return the distance of the limits from those of the identified device with friction, or None if they disagree.

    If the sign of such a small distance depends on one limit, one of two conditions is required: all intervals include
    the device's limits, or the cross-validation of the device is correct.
    """
    if all(cause.code != "coulomb_friction" for cause in result.causes) or not result.loop_boundary:
        return None
    limits = {limit.damping: limit.stiffness for limit in result.loop_boundary}
    points = [point for point in result.boundary if point.damping in limits]
    found = boundary_distance(measured_limits(points), np.array([limits[point.damping] for point in points]))
    if found is None or abs(found.median) > CLOSE or found.dampings < FEWEST_COMPARISONS:
        return None
    replayed = result.replay is not None and result.replay.is_right
    return found if found.steady or found.agreeing == found.bounded or replayed else None


def _percent(distance: DistanceScore | None) -> float | None:
    return 100 * distance.median if distance is not None and distance.steady else None


def _next(
    data: StoredData, result: ExperimentNumbers, of_file: Experiment | None, stages: ExperimentStages
) -> NextStep:
    """Return the next wall that the planner recommends given the verdicts so far, or why there is none."""
    command = f"pipeline plan --device {shlex.quote(data.scene.device)} --experiment {shlex.quote(result.experiment)}"
    wish = PlanOptions()
    try:
        # Limits alone need no device.
        found = stages.once(identified_device) if result.loop is not None else None
        if found is not None and found.may_have_friction:
            found = replace(found, directions=_directions(stages))
        campaign = replace(campaign_of(stages, data.device, of_file, wish), found=found)
        plan = plan_of(campaign, wish)
        beyond = _beyond_tested_dampings(result, campaign, command)
    except (DeviceError, UsageError) as error:
        return NextStep(reason=str(error).rstrip("."))
    if beyond is not None:
        return NextStep(beyond)
    if not plan.next:
        unmeasured = [limit for limit in plan.boundary if limit.note and limit.note != NOTES["no stable wall"]]
        measured, wanted = len(plan.boundary) - len(unmeasured), len(plan.boundary)
        if all(limit.note == NOTES["undecided"] for limit in unmeasured):
            return NextStep(limits_known=measured, limits_wanted=wanted)
        others = "; ".join(f"B = {limit.damping:g}: {limit.note}" for limit in unmeasured)
        reason = f"None: verdicts give the limits at {measured} of {counted(wanted, 'damping')}. {others}"
        return NextStep(None, reason, measured, wanted)
    wall = plan.next[0]
    return NextStep(NextWall(stiffness=wall.stiffness, damping=wall.damping, why=wall.why, command=command))


def _beyond_tested_dampings(result: ExperimentNumbers, campaign: Campaign, command: str) -> NextWall | None:
    """Return the wall beyond the largest tested damping if the largest limit is there, or None.

    It is None also if no device is identified, or if it predicts no larger limit there.
    """
    damping, largest = _untested_damping(result), result.largest_limit
    if damping is None or campaign.found is None or largest is None:
        return None
    if not _ends_at_last_damping(result):
        return None
    plan, forecast = plan_of(campaign, PlanOptions(dampings=(damping,))), forecast_of(campaign, (damping,))
    expected = 0.0 if forecast is None else float(forecast.limit[0])
    if not plan.next or expected <= largest.stiffness:
        return None
    unit = unit_of("stiffness", campaign.motion)
    why = (
        f"the largest limit is at the largest tested damping; beyond it, {significant(expected, 3)} {unit} is expected"
    )
    wall = plan.next[0]
    return NextWall(
        stiffness=wall.stiffness, damping=wall.damping, why=why, command=f"{command} --dampings {damping:g}"
    )


def _directions(stages: ExperimentStages) -> int:
    """Return the number of directions in which the device moves, from logs spread over the walls."""
    stiffness, damping = (stages.column("response", name) for name in ("stiffness", "damping"))
    places = spread_over_plane(stiffness, damping, np.ones(len(stiffness), dtype=np.bool_), TRIALS)
    return Recorded.of(stages.map_trials(recording, places.tolist())).directions
