"""The answer on one screen: does theory predict the device, which walls to use, and what that rests on."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median

from pipeline.base.wording import counted, first_clause
from pipeline.comparison.loops.log_evidence import law_departures
from pipeline.comparison.loops.other_gains import other_gains
from pipeline.comparison.scene.scene import SceneData
from pipeline.comparison.summary.advice import use_text
from pipeline.comparison.summary.causes import causes
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.records.models import ComparisonRow
from pipeline.records.results import Answer, ExperimentResult, Mark
from pipeline.records.score_records import DistanceScore
from pipeline.rendering.labels import (
    Units,
    criterion_name,
    damping_text,
    percent_text,
    range_text,
    share_text,
    size_text,
    step_words,
    stiffness_text,
)

FAR_OFF = 5.0
"""Percent by which a best single trial costs more than theory's optimum from which on it is told why."""

MOST_CAUSES = 2
"""Causes that are named: with more nobody reads on, and the tables hold all."""

WELL, ROUGHLY = 0.9, 0.7
"""Overlap of the regions from which on theory predicts a boundary well, and roughly: with equal shapes 0.9 is an error
of 5 % in both K and B, 0.7 one of 16 %. Words only; the numbers stand beside."""

ALL, SOME = 0.9, 0.5
"""Share of the limits that agree with theory from which on they are said to, and to do so in part: the intervals of
one in twenty miss by chance, and a course has some twenty dampings."""


def answer(
    data: SceneData, results: Sequence[ExperimentResult], rows: Sequence[ComparisonRow], units: Units
) -> Answer | None:
    """Return the answer of a comparison, about the first experiment that has most of it; None where nothing is known.

    Parameters
    ----------
    data : SceneData
        Its experiments in the order of ``results``.
    results : sequence of ExperimentResult
        With their scores and regions to use.
    rows : sequence of ComparisonRow
    units : Units
    """
    lead = max(range(len(results)), key=lambda i: (_worth(results[i]), -i))
    result, stages = results[lead], data.experiments[lead]
    gains = stages.once(other_gains)
    verdict = gains.cause.sentence if gains and gains.most else _verdict(results, result, rows, units)
    if not verdict:
        return None
    shown = [cause.sentence for cause in result.causes] + causes(result, units)
    return Answer(
        experiment=result.experiment,
        verdict=verdict,
        use=use_text(result, units),
        marks=tuple(_marks(result, stages, units)),
        causes=tuple(shown[:MOST_CAUSES]),
    )


def _worth(result: ExperimentResult) -> tuple[bool, bool, bool]:
    """What an experiment can tell: a limit beside theory, walls to use, any limit."""
    return bool(result.scores and _known(result)), result.use is not None, bool(result.boundary)


def _known(result: ExperimentResult) -> bool:
    """Whether the region says where the device gets unstable: with stable trials only, any overlap is 1."""
    region = result.scores[0].region if result.scores else None
    return region is not None and region.censored < region.dampings


def _verdict(
    results: Sequence[ExperimentResult], lead: ExperimentResult, rows: Sequence[ComparisonRow], units: Units
) -> str:
    """Does theory predict the device: limits of the leading experiment, costs of all."""
    region = lead.scores[0].region if lead.scores else None
    if region is None:
        return _stiffest(results, units)
    if not _known(lead):
        return (
            f"How well theory predicts where this device becomes unstable is not known: in experiment "
            f"{lead.experiment} no trial was unstable at any of {counted(region.dampings, 'tested damping')}; theory "
            f"calls {share_text(region.overlap, 0)} % of the tested region stable."
        )
    word = "well" if region.overlap >= WELL else "roughly" if region.overlap >= ROUGHLY else "poorly"
    distance = lead.scores[0].distance
    if distance is None:
        return f"Theory predicts {word} where this device is stable."
    safe = ", but on the safe side," if word != "well" and _is_safe(distance) else ""
    held = ""
    if (point := lead.stiffest) is not None and (large := step_words(point, units.stiffness)):
        wall = f"{stiffness_text(point.stable or 0.0)} {units.stiffness}"
        held = f". At B = {damping_text(point.damping)} {units.damping}, {wall} are stable{large}"
    told = f"{_limits(lead, distance)}{optimal_costs(rows)}{held}"
    return f"Theory predicts {word}{safe} where this device is stable: {told}."


def _is_safe(distance: DistanceScore) -> bool:
    """Whether all limits that do not agree lie above theory: walls that it calls stable are."""
    return distance.above > 0 and distance.agreeing + distance.above == distance.bounded


def optimal_costs(rows: Sequence[ComparisonRow]) -> str:
    """Return how far optimal costs are off theory, as a clause; empty where none is known apart from the trials' grid.

    Of several costs the size in the median, and where single trials lie farther off, why.
    """
    told = [(row, row.deviation) for row in rows if row.deviation]
    if not told:
        return ""
    if len(told) == 1:
        row, parts = told[0]
        ends = range_text(lambda percent: percent_text(percent, 0), parts.model_low, parts.model_high)
        return (
            f", the least {criterion_name(row.criterion).partition(' (')[0]}, {size_text(parts.model)} "
            f"{'above' if parts.model > 0 else 'below'} (95 %: {ends} %){'' if parts.steady else _FEW}"
        )
    steady = [abs(parts.model) for _, parts in told if parts.steady]
    middle = median(steady or [abs(parts.model) for _, parts in told])
    most = max((row.deviation_percent or 0.0 for row, _ in told), default=0.0)
    far = f"; best trials up to {size_text(most)} above theory's optima, which no wall meets"
    few = "" if steady else _FEW
    return f", costs on tested walls by {size_text(middle)}{few}{far if most >= FAR_OFF else ''}"


_FEW = ", which rests on few trials"
FEW = 5
"""Limits below which their median is one that a single trial may move."""


def _limits(lead: ExperimentResult, distance: DistanceScore) -> str:
    side = "above" if distance.median > 0 else "below"
    if 100 * abs(distance.median) < 0.1:
        return f"limits of experiment {lead.experiment} differ by less than 0.1 %"
    few = f" of {distance.dampings} only" if distance.dampings < FEW else ""
    return f"limits of experiment {lead.experiment} lie {size_text(100 * distance.median)} {side} it in the median{few}"


def _stiffest(results: Sequence[ExperimentResult], units: Units) -> str:
    """Largest stable stiffness of the first experiment with a boundary, where there is no theory to compare it with."""
    for result in results:
        if (point := result.stiffest) is not None:
            least = "at least " if any(p.censored for p in result.boundary) else ""
            return (
                f"Experiment {result.experiment}: the largest stable stiffness measured is {least}"
                f"{stiffness_text(point.stable or 0.0)} {units.stiffness} (at B = {damping_text(point.damping)} "
                f"{units.damping}){step_words(point, units.stiffness)}."
            )
    return ""


def _marks(result: ExperimentResult, stages: ExperimentStages, units: Units) -> list[Mark]:
    """What the answer rests on: the wall law, the loop, and the limits."""
    if result.loop is None:
        return [_limit_mark(result, units)]
    departures, gains = law_departures(stages), stages.once(other_gains)
    if gains is not None and gains.most:
        return [Mark(name="wall_law", state="no", text="The logs do not follow the wall that they state.")]
    if gains is not None:
        law = Mark(name="wall_law", state="partly", text=gains.cause.sentence)
    elif departures:
        law = Mark(
            name="wall_law", state="no", text=f"Logs do not follow the wall law: {_clause(departures[0].sentence)}."
        )
    else:
        law = Mark(name="wall_law", state="yes", text="The logs follow the wall law.")
    loop, check = result.loop, result.model_check
    share = f"{check.explained} of {counted(check.trials, 'log')}" if check else "the logs"
    if loop.adequate:
        model = Mark(name="loop", state="yes", text=f"Mass, damping and delay explain {share}.")
    else:
        reason = first_clause(loop.reason)
        told = f"{reason[:1].upper()}{reason[1:]}" if reason.startswith(_EXPLAINED) else f"{_NOT_ALL}: {reason}"
        model = Mark(name="loop", state="no", text=f"{told}.")
    return [law, model, _limit_mark(result, units)]


_EXPLAINED, _NOT_ALL = "mass, damping and delay", "One mass, damping and delay do not explain all"
"""How a reason begins that says by itself what is not explained, and what stands before the others."""


def _clause(sentence: str) -> str:
    return sentence[:1].lower() + sentence[1:].rstrip(".")


def _limit_mark(result: ExperimentResult, units: Units) -> Mark:
    distance = result.scores[0].distance if result.scores else None
    if distance is None:
        return Mark(name="limits", state="unknown", text="There is no theory to hold the limits against.")
    if not distance.bounded:
        return Mark(name="limits", state="unknown", text="No limit has bounds on both sides to hold theory against.")
    share = distance.agreeing / distance.bounded
    state = "yes" if share >= ALL else "partly" if share >= SOME else "no"
    worst = (
        ""
        if state == "yes"
        else (
            f" (95 % interval, or 2 %); farthest off {percent_text(100 * distance.largest, 0)} % at B = "
            f"{damping_text(distance.largest_damping)} {units.damping}"
        )
    )
    kind = "two-sided limit" if distance.bounded < distance.dampings else "limit"
    met = f"{distance.agreeing} of {counted(distance.bounded, kind)}"
    text = f"Theory meets {met}{worst}."
    return Mark.model_validate({"name": "limits", "state": state, "text": text})
