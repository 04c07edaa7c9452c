"""A comparison in a few sentences with numbers, each with the figure or table it rests on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

from pipeline.base.wording import counted
from pipeline.comparison.loops.wall_replay import replay_words
from pipeline.comparison.summary.advice import passive_choice
from pipeline.comparison.summary.answer import MOST_CAUSES
from pipeline.comparison.summary.causes import causes
from pipeline.records.models import ComparisonRow
from pipeline.records.results import Answer, ExperimentResult
from pipeline.rendering.labels import (
    Units,
    criterion_name,
    damping_text,
    estimate_texts,
    percent_text,
    range_text,
    share_text,
    size_text,
    step_words,
    stiffness_text,
)

SCORES, BOUNDARY, COSTS, EXPERIMENTS = "table-scores", "sec-boundaries", "sec-costs", "sec-experiments"
"""Anchors of the page that sentences rest on."""


@dataclass(frozen=True)
class Sentence:
    """A sentence and the anchor of the figure or table it rests on, empty where there is none."""

    text: str
    source: str = ""


def summarise(
    told: Answer | None, results: Sequence[ExperimentResult], rows: Sequence[ComparisonRow], units: Units
) -> tuple[Sentence, ...]:
    """Return what a comparison comes to.

    Parameters
    ----------
    told : Answer or None
        Whose verdict and walls to use come first.
    results : sequence of ExperimentResult
        With their scores.
    rows : sequence of ComparisonRow
    units : Units

    Notes
    -----
    In this order: does theory predict the device, which (K, B) to use, how far off is theory and where, why might
    that be, and what the logs say of the device. Numbers are those of the first experiment that has them, with the
    range over all where there are more.
    """
    scored = [r for r in results if r.scores and r.scores[0].region]
    lead = next((r for r in scored if not all(p.censored for p in r.boundary)), scored[0] if scored else None)
    found = [
        Sentence(told.verdict if told else "", SCORES if scored else BOUNDARY),
        Sentence(told.use if told else "", COSTS),
        Sentence(_region(results), SCORES),
        Sentence(_costs(results, rows), COSTS),
        Sentence(_distance(lead, units) if lead else "", BOUNDARY),
        *(Sentence(text, SCORES) for text in (causes(lead, units)[:MOST_CAUSES] if lead else ())),
        *_loops(results, units),
        Sentence(_saving(results), BOUNDARY),
        Sentence(_device(results), EXPERIMENTS),
    ]
    known = tuple(s for s in found if s.text)
    if known:
        return known
    trials = sum(r.trials for r in results)
    return (
        Sentence(
            f"{counted(trials, 'trial')} {'is' if trials == 1 else 'are'} stored, from which neither parameters nor "
            "costs follow; the reasons are below."
        ),
    )


def _loops(results: Sequence[ExperimentResult], units: Units) -> list[Sentence]:
    """Why there is no theory by the estimates, what the logs show, and the passive wall of the first loop with one."""
    said = []
    doubtful = [r for r in results if r.loop is not None and not r.loop.adequate]
    if doubtful and (first := doubtful[0].loop) is not None:
        others = f" (and {counted(len(doubtful) - 1, 'other experiment')})" if len(doubtful) > 1 else ""
        said.append(
            f"The loop of experiment {doubtful[0].experiment}{others} is not adequate: {first.reason}. So nothing "
            "is said that needs its mass, damping and delay: theory by the estimates, a passive wall, an implied delay."
        )
    shown = next(((r.experiment, r.replay) for r in results if r.replay and r.replay.verdicts_same is not None), None)
    if shown is not None:
        said.append(f"Experiment {shown[0]}: {replay_words(shown[1])}.")
    seen = next((r for r in results if r.causes), None)
    if seen is not None:
        told = " ".join(f"{cause.sentence} ({cause.evidence})" for cause in seen.causes[:MOST_CAUSES])
        said.append(f"Experiment {seen.experiment}: {told}")
    passive = next((r for r in results if r.passive is not None), None)
    if passive is None:  # why a loop is not adequate is said already
        passive = next((r for r in results if r.passive_reason and r.loop is not None and r.loop.adequate), None)
    said.append(passive_choice(passive, units) if passive else "")
    return [Sentence(text, EXPERIMENTS) for text in said]


def _saving(results: Sequence[ExperimentResult]) -> str:
    """How many trials would have been enough."""
    found = next(((r.experiment, r.saving) for r in results if r.saving is not None), None)
    if found is None:
        return ""
    experiment, saving = found
    return (
        f"Of the {counted(saving.trials, 'trial')} of experiment {experiment} with a wall, {saving.enough} would have "
        f"told the limits at {saving.dampings} dampings to {share_text(saving.accuracy, 0)} % of the largest, "
        f"had pipeline plan chosen them: {saving.trials - saving.enough} could have been saved."
    )


def _region(results: Sequence[ExperimentResult]) -> str:
    """How much of the measured and the theoretical stable region is the same."""
    found = [(r.experiment, r.scores[0].region) for r in results if r.scores]
    # without any unstable trial the compared window ends with the stable ones, and both regions fill it
    known = [(name, region) for name, region in found if region is not None and region.censored < region.dampings]
    if not known:
        return ""
    name, first = known[0]
    text = (
        f"The measured region of experiment {name} covers {share_text(first.covered, 0)} % of the theoretical one and "
        f"is {first.area_ratio:.2f} times as large (overlap {share_text(first.overlap, 0)} %"
    )
    if len(known) > 1:
        overlaps = sorted(region.overlap for _, region in known)
        ends = range_text(lambda x: share_text(x, 0), overlaps[0], overlaps[-1])
        text += f"; {ends} % over {len(known)} experiments"
    if not first.censored:
        return f"{text})."
    return (
        f"{text}); at {first.censored} of {first.dampings} dampings no trial was unstable, and only the tested "
        "stiffness is compared there."
    )


def _costs(results: Sequence[ExperimentResult], rows: Sequence[ComparisonRow]) -> str:
    """Does theory predict performance: order of the trials' costs, and costs at the optima."""
    ranks = sorted(
        m.rank_correlation for r in results if r.scores for m in r.scores[0].maps if m.rank_correlation is not None
    )
    parts = []
    if ranks:
        parts.append(
            f"Costs of the trials are ordered as in theory with a rank correlation of {median(ranks):.2f} in "
            f"the median of {counted(len(ranks), 'cost map')} (least {ranks[0]:.2f})"
        )
    deviations = [r for r in rows if r.deviation]
    if deviations:
        largest = max(deviations, key=_size)
        assert largest.deviation is not None, "they are chosen by it"
        found = largest.deviation
        middle = median(_size(r) for r in deviations)
        ends = range_text(percent_text, found.model_low, found.model_high)
        one = f"{percent_text(found.model)} % (95 %: {ends}) for {_named(largest)}"
        several = f"{size_text(middle)} in the median of {len(deviations)} comparisons, most by {one}"
        parts.append(
            f"{'optimal' if parts else 'Optimal'} costs differ from the discrete theory, once range and grid of the "
            f"trials and luck of the best one are taken off, by {one if len(deviations) == 1 else several}"
        )
    return "; ".join(parts) + "." if parts else ""


def _distance(result: ExperimentResult, units: Units) -> str:
    """How far off the boundary is, and where: distance over damping and largest stable stiffness."""
    distance, stiffness = result.scores[0].distance, result.scores[0].stiffness
    parts = []
    if distance is not None:
        most = (
            ""
            if 100 * abs(distance.largest) < 0.1
            else (
                f", most at B = {damping_text(distance.largest_damping)} {units.damping} "
                f"({percent_text(100 * distance.largest)} %)"
            )
        )
        parts.append(
            f"the measured boundary differs from theory by {size_text(100 * distance.median)} in stiffness in the "
            f"median of {counted(distance.dampings, 'damping')}{most}"
        )
    if stiffness is not None:
        least = "at least " if stiffness.lower_bound else ""
        # a lower bound below theory is no deviation
        told = not stiffness.lower_bound or stiffness.deviation_percent > 0
        parts.append(
            f"the largest stable stiffness measured is {least}{stiffness_text(stiffness.measured)} {units.stiffness} "
            f"(at B = {stiffness.measured_damping:g} {units.damping}), theory says "
            f"{stiffness_text(stiffness.theory)} {units.stiffness} at {stiffness.theory_damping:.3g} {units.damping}"
            + (f" ({percent_text(stiffness.deviation_percent)} %)" if told else "")
            + _for_step(result, units)
        )
    return f"Experiment {result.experiment}: {'; '.join(parts)}." if parts else ""


def _for_step(result: ExperimentResult, units: Units) -> str:
    words = step_words(result.stiffest, units.stiffness) if result.stiffest is not None else ""
    return f"; the measured one is stable{words}" if words else ""


def _device(results: Sequence[ExperimentResult]) -> str:
    """What the logs say of the device, and how many of them the model explains."""
    for result in results:
        text = _estimates(result)
        if text:
            return f"Experiment {result.experiment} ({counted(result.trials, 'trial')}): {text}{_explained(result)}."
    return ""


def _explained(result: ExperimentResult) -> str:
    """How many logs the device explains that the estimates are of."""
    check, loop = result.model_check, result.loop
    if loop is not None and loop.explained is not None and "ladder" in result.estimates["delay_samples"].by_method:
        return f"; one device with these numbers explains {share_text(loop.explained)} % of the logs held out"
    return f"; the model explains {check.explained} of {counted(check.trials, 'log')}" if check and check.trials else ""


def _estimates(result: ExperimentResult) -> str:
    names = {"delay_samples": "delay d", "mass": "mass", "damping": "viscous damping"}
    # the intervals rest on the loop
    doubted = result.loop is not None and not result.loop.adequate
    parts = []
    for key, name in names.items():
        # that of the device, where one is fitted to all trials; costs count from a whole number of samples
        estimate = result.estimates[key].by_method.get("ladder", result.estimates[key])
        estimate = result.delay if key == "delay_samples" else estimate
        if estimate.value is None:
            continue
        value, low, high = estimate_texts(estimate)
        text = f"{name} {'about ' if doubted else ''}{value} {estimate.unit.replace('^2', '²')}"
        if low and high and not (doubted or low == value == high):
            text += f" (95 %: {low} to {high})"
        parts.append(text)
    return ", ".join(parts)


def _size(row: ComparisonRow) -> float:
    """Part of the model in the deviation of an optimal cost [%]."""
    return abs(row.deviation.model) if row.deviation else 0.0


def _named(row: ComparisonRow) -> str:
    # several experiments may have the same delay
    return f"{criterion_name(row.criterion)}, experiment {row.experiment}"
