"""The answer follows from the scores, the loop and the trials given, and fits on one screen."""

from __future__ import annotations

import re

import pytest

from pipeline.comparison.summary.answer import answer, optimal_costs
from pipeline.records.models import ComparisonRow, Deviation
from pipeline.rendering.labels import UNITS

FALCON = UNITS["translation"]


def told(data, result, **changes):
    """Answer where the scores of the only experiment are changed."""
    experiment = result.experiments[0]
    scores = experiment.scores[0].model_copy(update=changes)
    found = answer(data, [experiment.model_copy(update={"scores": (scores,)})], result.tables, FALCON)
    assert found is not None
    return found


def test_an_ideal_course_has_three_good_marks_and_no_cause(result):
    found = result.answer
    assert [mark.name for mark in found.marks] == ["wall_law", "loop", "limits"]
    assert {mark.state for mark in found.marks} == {"yes"}
    assert found.causes == ()
    assert result.summary[:2] == (found.verdict, found.use)


@pytest.mark.parametrize(("overlap", "word"), [(0.95, "well"), (0.75, "roughly"), (0.3, "poorly")])
def test_words_follow_the_overlap(data, result, overlap, word):
    region = result.experiments[0].scores[0].region.model_copy(update={"overlap": overlap})
    assert told(data, result, region=region).verdict.startswith(f"Theory predicts {word} where this device is stable")


@pytest.mark.parametrize(
    ("median", "words"),
    [
        (0.057, "lie 5.7 % above it in the median"),
        (-0.2, "lie 20 % below it in the median"),
        (0.0002, "differ by less than 0.1 %"),
    ],
)
def test_verdict_tells_how_far_the_limits_are_off(data, result, median, words):
    distance = result.experiments[0].scores[0].distance.model_copy(update={"median": median})
    assert f"limits of experiment 1 {words}" in told(data, result, distance=distance).verdict


def test_without_an_unstable_trial_nothing_is_said_to_be_predicted(data, result):
    """Where each damping is censored the compared window holds stable trials only, and any overlap is 1."""
    region = result.experiments[0].scores[0].region
    open_end = region.model_copy(update={"overlap": 1.0, "censored": 4, "dampings": 4})
    verdict = told(data, result, region=open_end).verdict
    assert verdict.startswith("How well theory predicts where this device becomes unstable is not known")
    assert verdict.endswith("theory calls 100 % of the tested region stable.")


@pytest.mark.parametrize(("agreeing", "state"), [(20, "yes"), (15, "partly"), (5, "no")])
def test_the_mark_of_the_limits_counts_those_that_agree(data, result, agreeing, state):
    changes = {"dampings": 22, "bounded": 20, "agreeing": agreeing, "largest": 0.3, "largest_damping": 40.0}
    distance = result.experiments[0].scores[0].distance.model_copy(update=changes)
    mark = told(data, result, distance=distance).marks[-1]
    assert mark.state == state
    assert mark.text.startswith(f"Theory meets {agreeing} of 20 two-sided limits")
    assert ("(95 % interval, or 2 %); farthest off +30 % at B = 40 Ns/m" in mark.text) == (state != "yes")


def test_limits_without_bounds_on_both_sides_tell_nothing(data, result):
    distance = result.experiments[0].scores[0].distance.model_copy(update={"bounded": 0, "agreeing": 0})
    assert told(data, result, distance=distance).marks[-1].state == "unknown"


@pytest.mark.parametrize(("agreeing", "above", "safe"), [(2, 6, True), (2, 5, False), (8, 0, False)])
def test_theory_is_on_the_safe_side_where_no_limit_lies_below_it(data, result, agreeing, above, safe):
    scores = result.experiments[0].scores[0]
    distance = scores.distance.model_copy(update={"bounded": 8, "agreeing": agreeing, "above": above})
    region = scores.region.model_copy(update={"overlap": 0.3})
    verdict = told(data, result, distance=distance, region=region).verdict
    assert ("but on the safe side" in verdict) == safe


def row(model, percent):
    parts = Deviation(range=0.0, grid=0.0, model=model, selection=0.0, model_low=model - 18, model_high=model + 22.9)
    return ComparisonRow(
        table="D.1",
        criterion="energy_step_w0",
        condition="experiment",
        delay_samples=4,
        stiffness=1,
        damping=1,
        cost=1,
        deviation=parts,
        deviation_percent=percent,
    )


def test_optimal_costs_are_told_with_sign_and_interval_or_why_single_trials_lie_elsewhere():
    one = optimal_costs([row(-24.1, -20.3)])
    assert one == ", the least energy cost, w = 0, 24 % below (95 %: \N{MINUS SIGN}42 to \N{MINUS SIGN}1 %)"
    alone = row(-24.1, -20.3)
    alone = alone.model_copy(update={"deviation": alone.deviation.model_copy(update={"steady": False})})
    assert optimal_costs([alone]) == f"{one}, which rests on few trials"
    assert optimal_costs([alone, row(0.01, 0.2), row(-0.02, 0.1)]).endswith("by less than 0.1 %")
    several = optimal_costs([row(0.01, 20.0), row(-0.02, 104.6)])
    assert "by less than 0.1 %; best trials up to 105 % above theory's optima" in several
    assert optimal_costs([row(0.01, 0.2), row(-0.02, 0.1)]).endswith("by less than 0.1 %")
    assert optimal_costs([]) == ""


def test_marks_say_what_speaks_against_the_loop(data, result):
    experiment = result.experiments[0]
    loop = experiment.loop.model_copy(update={"adequate": False, "reason": "the mass drifts; what would help: more"})
    found = answer(data, [experiment.model_copy(update={"loop": loop})], result.tables, FALCON)
    assert found.marks[1].state == "no"
    assert found.marks[1].text == "One mass, damping and delay do not explain all: the mass drifts."
    bare = answer(data, [experiment.model_copy(update={"loop": None, "scores": ()})], result.tables, FALCON)
    assert [(mark.name, mark.state) for mark in bare.marks] == [("limits", "unknown")]
    assert bare.verdict.startswith("Experiment 1: the largest stable stiffness measured is")


def test_without_limits_there_is_no_answer(data, result):
    nothing = {"scores": (), "boundary": (), "use": None}
    assert answer(data, [result.experiments[0].model_copy(update=nothing)], (), FALCON) is None


def test_the_first_screen_has_at_most_120_words(falcon_outcome):
    page = falcon_outcome.report.read_text(encoding="utf-8")
    block = re.search(r'<div class="answer">(.*?)<figure', page, re.DOTALL)
    words = re.sub(r"<[^>]*>", " ", block[1]).split()
    assert 40 <= len(words) <= 120
