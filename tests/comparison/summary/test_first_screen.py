"""The first screen answers five questions by codes and numbers, and its words say them."""

from __future__ import annotations

import re

import numpy as np
import pytest

from pipeline.comparison.scores.agreement import is_steady
from pipeline.comparison.summary.first_screen import COARSE, answer
from pipeline.records.findings import BoundaryPoint, Limit
from pipeline.records.models import ComparisonRow, Deviation
from pipeline.records.results import AnswerEstimate, Cause, DampingSpan
from pipeline.rendering.labels import answer_texts, at_least
from pipeline.rendering.report.report import ReportData, answer_lines, render


def told(data, result, rows=None, **changes):
    """Answer where something of the only experiment is changed."""
    experiment = result.experiments[0].model_copy(update=changes)
    return answer(data, data.experiments[0], experiment, result.tables if rows is None else rows)


def lines_of(result):
    """Lines of the first screen of a document."""
    return answer_lines(result.answer, result.motion, result.featured.sampling_period_s)


def scored(result, **changes):
    """Scores of the only experiment, changed."""
    return (result.experiments[0].scores[0].model_copy(update=changes),)


def test_an_ideal_course_has_all_answers(result):
    found = result.answer
    assert list(found.model_dump())[1] == "wall"
    assert found.wall == result.experiments[0].use.point
    names = [each.name for each in found.estimates]
    assert names == ["delay_samples", "mass", "damping", "friction", "stiffness_max", "replay"]
    assert all(each.low <= each.value <= each.high for each in found.estimates[:-1] if each.name != "friction")
    friction = found.estimates[3]
    assert friction.value is None, "there is none"
    assert 0 < friction.high < 1e-6, "and logs without noise say so"
    replay = result.experiments[0].replay
    assert found.estimates[-1].value == 100 * replay.verdicts_same > 90
    assert found.estimates[-1].limits_off_percent == replay.limits_off_percent
    assert found.predicts.code == "yes"
    assert abs(found.predicts.percent) < 2
    assert found.causes == ()
    assert (found.next is None) == (found.next_reason != "" or found.limits_wanted > 0)


def test_lines_stand_in_the_order_of_the_questions(result):
    starts = (
        "Wall: K = ",
        "How sure: delay d 4",
        "Does theory predict it? Boundary: yes. Limits",
        "What deviates: ",
        "Measure next: ",
    )
    assert [line.startswith(start) for line, start in zip(result.summary, starts, strict=True)] == [True] * 5
    point = result.answer.wall
    assert f"K = {point.stiffness:g} N/m, B = {point.damping:g} Ns/m (experiment 1)" in result.summary[0]
    samples = point.costs["settle_2pct"]
    assert f"settling time (2 %) {samples:g} samples = {samples:g} ms" in result.summary[0]
    assert f"stability limit at least {at_least(point.margin)} × K" in result.summary[0]


def test_without_a_device_nothing_deviates_as_far_as_is_known(result):
    assert lines_of(result)[3] == "What deviates: nothing found."
    unknown = result.answer.model_copy(update={"estimates": result.answer.estimates[4:]})
    without = result.model_copy(update={"answer": unknown})
    assert lines_of(without)[3] == "What deviates: unknown, because no device was identified."


@pytest.mark.parametrize(("overlap", "code"), [(0.95, "yes"), (0.75, "no")])
def test_the_code_follows_the_overlap(data, result, overlap, code):
    region = result.experiments[0].scores[0].region.model_copy(update={"overlap": overlap})
    assert told(data, result, scores=scored(result, region=region)).predicts.code == code


@pytest.mark.parametrize(
    ("median", "words"),
    [(0.057, "lie 5.7 % above theory"), (-0.2, "lie 20 % below theory"), (0.0002, "agree with theory within 0.1 %")],
)
def test_words_tell_how_far_the_limits_are_off(data, result, median, words):
    distance = result.experiments[0].scores[0].distance.model_copy(update={"median": median})
    found = told(data, result, scores=scored(result, distance=distance))
    assert found.predicts.percent == pytest.approx(100 * median)
    assert words in lines_of(result.model_copy(update={"answer": found}))[2]


def test_friction_that_explains_the_limits_is_a_code_of_its_own(data, result):
    experiment = result.experiments[0]
    region = experiment.scores[0].region.model_copy(update={"overlap": 0.7})
    limits = tuple(
        Limit(damping=p.damping, stiffness=1.01 * p.estimate, low=0.0, high=2 * p.estimate)
        for p in experiment.boundary
        if p.estimate
    )
    cause = Cause(code="coulomb_friction", sentence="It rubs.", evidence="logs")
    changes = {"scores": scored(result, region=region), "loop_boundary": limits}
    assert told(data, result, causes=(), **changes).predicts.code == "no"
    found = told(data, result, causes=(cause,), **changes).predicts
    assert found.code == "with_friction"
    assert found.percent_with_friction == pytest.approx(-1, abs=0.1)
    changes["loop_boundary"] = tuple(
        limit.model_copy(update={"stiffness": limit.stiffness * (0.98 + 0.02 * (n % 2))})
        for n, limit in enumerate(limits)
    )
    around = told(data, result, causes=(cause,), **changes)
    assert (around.predicts.code, around.predicts.percent_with_friction) == ("with_friction", None)
    assert (
        "Limits scatter about theory with the friction found"
        in lines_of(result.model_copy(update={"answer": around}))[2]
    )


def test_words_say_what_the_tested_walls_leave_open(result):
    *others, largest, replay = result.answer.estimates
    largest = largest.model_copy(update={"at_last_damping": True})
    replay = replay.model_copy(update={"limits_known_percent": 12.0})
    known = result.answer.model_copy(update={"estimates": (*others, largest, replay)})
    line = lines_of(result.model_copy(update={"answer": known}))[1]
    assert ", the largest tested" in line
    assert "limits agree within their uncertainty of ±12 % (median)" in line
    assert "limits off by" not in line


def test_parameters_of_a_file_outside_what_the_logs_tell_are_a_cause(data, result):
    experiment = result.experiments[0]
    distance = experiment.scores[0].distance.model_copy(update={"median": 0.1})
    heavy = experiment.scores[0].parameters
    heavy = heavy.model_copy(update={"loop": heavy.loop.replace({"mass": 0.9})})
    found = told(data, result, scores=scored(result, distance=distance, parameters=heavy)).causes
    assert [cause.code for cause in found] == ["parameter_range"]
    assert found[0].evidence.startswith("m = 0.900 kg, logs 0.5")
    assert told(data, result, scores=scored(result, distance=distance)).causes == (), "those of the file are right"
    assert told(data, result, scores=scored(result, parameters=heavy)).causes == (), "theory predicts the limits"


def test_without_an_unstable_trial_nothing_is_said_to_be_predicted(data, result):
    """Where each damping is censored the compared window holds stable trials only, and any overlap is 1."""
    region = result.experiments[0].scores[0].region
    open_end = region.model_copy(update={"overlap": 1.0, "censored": 4, "dampings": 4})
    found = told(data, result, scores=scored(result, region=open_end)).predicts
    assert (found.code, found.percent) == ("unknown", None)
    assert "according to theory, 100 % of the tested region is stable" in found.reason


def test_a_headline_rests_on_five_comparisons_and_on_no_single_one(data, result):
    assert is_steady(np.array([0.27, 0.28, 0.29, 0.3, 0.31]))
    assert not is_steady(np.array([0.27, 0.28, 0.29, 0.3]))
    assert not is_steady(np.array([-0.3, -0.2, -0.1, 0.15, 0.2, 0.3]))  # the sign
    assert not is_steady(np.array([0.1, 0.1, 0.1, 0.6, 0.6, 0.6]))  # the size
    few = result.experiments[0].scores[0].distance.model_copy(update={"dampings": 4})
    found = told(data, result, scores=scored(result, distance=few)).predicts
    assert found.code == "unknown"
    assert found.reason.startswith(
        "4 limits to compare (those near K = 0 are left out), 5 are needed; record more, for example at B = "
    )
    assert f"{few.agreeing} of {few.bounded} agree with theory within their interval" in found.reason
    best = max(result.experiments[0].loop_boundary, key=lambda limit: limit.stiffness)
    assert f"at B = {best.damping:g}" in found.reason, "what the loop found in the logs predicts"
    unsteady = result.experiments[0].scores[0].distance.model_copy(update={"steady": False})
    assert told(data, result, scores=scored(result, distance=unsteady)).predicts.percent is None


def row(model, grid=0.0, **changes):
    parts = {"range": 0.0, "grid": grid, "model": model, "selection": 0.0, "model_low": -50.0, "model_high": 50.0}
    about = {"table": "D.1", "criterion": "overshoot", "condition": "experiment", "delay_samples": 4.0}
    values = {"stiffness": 1.0, "damping": 1.0, "cost": 1.0, "experiment": "1"}
    return ComparisonRow(**about, **values, deviation=Deviation(**parts | changes))


def test_a_value_at_an_end_of_its_interval_is_printed_once(data, result):
    """The growth rates put the limit below the stiffest surely stable wall: the interval begins there."""
    points = tuple(
        p.model_copy(update={"estimate": p.low, "high": 1.02 * p.low} if p.estimate else {})
        for p in result.experiments[0].boundary
    )
    (limit,) = (e for e in told(data, result, boundary=points).estimates if e.name == "stiffness_max")
    assert limit.value == limit.low < limit.high
    line = lines_of(result.model_copy(update={"answer": result.answer.model_copy(update={"estimates": (limit,)})}))[1]
    assert "(95 %: up to " in line
    assert ", at B = " in line
    # without growth rates the limit is in the middle of the bracket, as in the figure
    points = tuple(p.model_copy(update={"estimate": None, "low": None, "high": None}) for p in points)
    (limit,) = (e for e in told(data, result, boundary=points).estimates if e.name == "stiffness_max")
    assert limit.value == 0.5 * (limit.low + limit.high)


def test_the_largest_stable_stiffness_is_the_largest_limit_and_not_the_limit_of_the_stiffest_trial(data, result):
    """The stiffest trials of several dampings may be equal; their limits are not."""
    of = (
        (20.0, 2080.0, 2139.0, 2130.0, 2148.0),
        (24.0, 2080.0, 2091.0, 2083.0, 2098.0),
        (28.0, 1900.0, 2000.0, 1990.0, 2190.0),
    )
    points = tuple(
        BoundaryPoint(damping=B, stable=K, unstable=2200.0, censored=False, estimate=limit, low=low, high=high)
        for B, K, limit, low, high in of
    )
    (limit,) = (e for e in told(data, result, boundary=points).estimates if e.name == "stiffness_max")
    assert (limit.value, limit.damping) == (2139.0, 20.0)
    assert (limit.low, limit.high) == (2130.0, 2190.0), "the largest may be where the interval is widest"


def test_the_largest_stable_stiffness_has_no_upper_end_where_any_damping_has_none(data, result):
    common = {"unstable": None, "low": None, "high": None}
    points = (
        BoundaryPoint(
            damping=10.0, stable=940.0, unstable=1060.0, censored=False, estimate=1000.0, low=950.0, high=1050.0
        ),
        BoundaryPoint(damping=20.0, stable=999.0, censored=True, estimate=None, **common),
    )
    (limit,) = (e for e in told(data, result, boundary=points).estimates if e.name == "stiffness_max")
    assert (limit.value, limit.low, limit.high, limit.bracketed) == (1000.0, 999.0, None, False)


def test_a_bracket_is_named_beside_limits_with_an_interval(data, result):
    points = (
        BoundaryPoint(damping=10.0, stable=900.0, unstable=1100.0, censored=False, estimate=None, low=None, high=None),
        BoundaryPoint(
            damping=20.0, stable=940.0, unstable=980.0, censored=False, estimate=960.0, low=950.0, high=970.0
        ),
    )
    (limit,) = (e for e in told(data, result, boundary=points).estimates if e.name == "stiffness_max")
    assert (limit.value, limit.low, limit.high, limit.bracketed) == (1000.0, 950.0, 1100.0, True)


def test_a_verdict_states_where_tests_end_far_below_the_largest_damping_of_theory(data, result):
    damping = result.experiments[0].scores[0].damping
    tested = max(point.damping for point in result.experiments[0].boundary)
    near = told(data, result, scores=scored(result, damping=damping.model_copy(update={"theory": 1.05 * tested})))
    assert (near.predicts.tested_up_to, near.predicts.stable_up_to) == (None, None)
    far = told(data, result, scores=scored(result, damping=damping.model_copy(update={"theory": 2 * tested})))
    assert (far.predicts.tested_up_to, far.predicts.stable_up_to) == (tested, 2 * tested)
    words = {name: lines_of(result.model_copy(update={"answer": of}))[2] for name, of in (("near", near), ("far", far))}
    assert "Boundary: yes. Limits" in words["near"]
    assert f"Boundary: yes, tested up to B = {tested:g} of {2 * tested:g} Ns/m. Limits" in words["far"]


def test_words_say_of_how_many_dampings_a_median_is(data, result):
    predicts = result.answer.predicts
    assert predicts.dampings == len(result.experiments[0].boundary)
    assert 0 < predicts.limits < predicts.dampings, "limits near K = 0 are left out"
    assert f"median of {predicts.limits} of {predicts.dampings} dampings)" in lines_of(result)[2]


def test_costs_are_told_by_the_median_of_five_or_more(data, result):
    assert told(data, result, [row(5.0)] * 4).predicts.costs_percent is None
    assert told(data, result, [*[row(-5.0)] * 5, row(90.0, steady=False)]).predicts.costs_percent == 5.0


def test_the_wall_is_named_with_the_range_of_costs_around_it_and_the_least_cost(data, result):
    """47 samples next to 24 of theory and 30 of the best trial: the reader must see why it is none of these."""
    use = result.experiments[0].use
    found = told(data, result)
    assert (found.wall_criterion, found.wall_costs) == (use.criterion, use.costs[use.criterion])
    line = lines_of(result.model_copy(update={"answer": found}))[0]
    low, high = (f"{end:g}" for end in (found.wall_costs.low, found.wall_costs.high))
    assert f"Chosen from {use.trials} good trials ({low} to {high} samples)" in line
    assert f"Least cost, not chosen: {use.point.better}." in line
    alone = told(data, result, use=use.model_copy(update={"trials": 1}))
    assert alone.wall_costs is None


def test_a_coarse_grid_is_said_as_such(data, result):
    assert told(data, result, [row(0.0, grid=COARSE / 2)]).spacing_percent is None
    found = told(data, result, [row(0.0, grid=2 * COARSE)])
    K = np.unique(data.experiments[0].column("response", "stiffness"))
    assert found.spacing_percent == pytest.approx(100 * (K[found.wall.stiffness < K][0] / found.wall.stiffness - 1))
    assert "; tested K: " in lines_of(result.model_copy(update={"answer": found}))[0]


def test_intervals_are_left_out_where_the_loop_does_not_hold(data, result):
    experiment = result.experiments[0]
    loop = experiment.loop.model_copy(update={"adequate": False, "reason": "the mass drifts; what would help: more"})
    without = {n: e.model_copy(update={"by_method": {}}) for n, e in experiment.estimates.items()}
    found = told(data, result, loop=loop, estimates=without)
    assert {(e.low, e.high) for e in found.estimates[:3]} == {(None, None)}
    assert found.estimates_reason == "No intervals, because the loop is not adequate: the mass drifts."
    (limit,) = (each for each in found.estimates if each.name == "stiffness_max")
    assert limit.low is not None


@pytest.mark.parametrize(
    ("names", "doubted"), [(["mass", "damping"], False), (["mass", "damping", "delay_samples"], True)]
)
def test_intervals_are_left_out_where_several_estimates_drift(data, result, names, doubted):
    """One model with one wrong number drifts in several: its interval would be as wrong, and narrow."""
    estimates = dict(result.experiments[0].estimates)
    for name in names:
        estimates[name] = estimates[name].model_copy(update={"warning": "drifts by -3 over the tested damping"})
    found = told(data, result, estimates=estimates)
    assert ("drift with the wall" in found.estimates_reason) is doubted
    assert [each.low is None for each in found.estimates[:3]] == [doubted] * 3


def test_without_limits_the_answers_say_why(data, result):
    found = told(data, result, (), scores=(), boundary=(), use=None, use_reason="no stability limit is known")
    assert (found.wall, found.predicts.code) == (None, "unknown")
    lines = lines_of(result.model_copy(update={"answer": found}))
    safest = found.safest
    wall = f"K = {safest.stiffness:g} N/m, B = {safest.damping:g} Ns/m"
    assert lines[0].startswith(f"Wall: None recommended. Of the stable tested walls, {wall} decays fastest.")
    assert lines[0].endswith("No stability limit is known.")
    trial = next(t for t in walls_of(data) if (t[0], t[1]) == (safest.stiffness, safest.damping))
    assert trial[2] == "stable"
    assert safest.decay_per_s == pytest.approx(
        max(-growth for *_, verdict, growth in walls_of(data) if verdict == "stable")
    )


def walls_of(data):
    """Stiffness, damping, verdict and growth rate of the trials of the only experiment."""
    stages = data.experiments[0]
    columns = [stages.column("response", name) for name in ("stiffness", "damping", "growth_per_s")]
    K, B, growth = (values.tolist() for values in columns)
    return list(zip(K, B, stages.texts("response", "verdict"), growth, strict=True))


def test_boundary_and_costs_are_judged_apart(data, result):
    distance = result.experiments[0].scores[0].distance
    bent = distance.model_copy(update={"bounded": 20, "agreeing": 11, "above": 9})
    found = told(data, result, [row(4.0)] * 5, scores=scored(result, distance=bent)).predicts
    assert (found.code, found.boundary, found.optimal_costs) == ("yes", "partly", "yes")
    assert (found.above, found.below, found.bounded) == (9, 0, 20)
    few = told(data, result, [], scores=scored(result, distance=bent))
    line = lines_of(result.model_copy(update={"answer": few}))[2]
    assert "Boundary: partly. Limits agree with theory within 0.1 % (device file, d = 4; median of " in line
    assert "; 9 of 20 deviate by more than their interval (9 above)." in line
    assert "Costs: not known. Needs 5 costs, has 0." in line
    straight = distance.model_copy(update={"bounded": 20, "agreeing": 19, "above": 0})
    found = told(data, result, [row(40.0)] * 5, scores=scored(result, distance=straight)).predicts
    assert (found.boundary, found.optimal_costs, found.below) == ("yes", "no", 1)
    region = result.experiments[0].scores[0].region.model_copy(update={"overlap": 0.7})
    scores = (result.experiments[0].scores[0].model_copy(update={"region": region, "distance": bent}),)
    assert told(data, result, scores=scores).predicts.boundary == "no"


def test_the_best_settling_time_is_that_of_the_delay(data, result):
    found = result.answer.reachable
    assert found.delay_samples == pytest.approx(4.0, abs=1e-6)
    # five samples for each sample of delay and one (5.19, Table 5.1)
    assert found.best == pytest.approx(4.9 * 5, abs=0.05)
    assert found.reached == result.experiments[0].optimum["settle_2pct"].cost
    # the printed optimum is that of theory for this loop (Table C.2, d = 4), not that of the rule
    assert found.optimum == pytest.approx(24.0)
    assert "Theory's optimum: 24 samples = 24 ms." in lines_of(result)[0]
    without = result.answer.model_copy(update={"reachable": told(data, result, []).reachable})
    assert "Theory's optimum: 24.5 samples = 24.5 ms." in lines_of(result.model_copy(update={"answer": without}))[0]
    assert told(data, result, sampling_period_s=None).reachable is None


def test_every_experiment_has_its_own_answer(result):
    assert [each.answer.experiment for each in result.experiments] == ["1"]
    assert result.experiments[0].answer == result.answer


def test_the_first_screen_has_at_most_200_words(falcon_outcome):
    page = falcon_outcome.report.read_text(encoding="utf-8")
    block = re.search(r'<div class="answer">(.*?)<figure', page, re.DOTALL)
    words = re.sub(r"<[^>]*>", " ", block[1]).split()
    assert 60 <= len(words) <= 200, " ".join(words)


def test_a_damping_or_friction_that_may_be_zero_is_none_with_its_bound():
    of = {"unit": "Ns/m", "low": 0.0, "high": 3.0}
    assert answer_texts(AnswerEstimate(name="damping", value=0.1, **of)) == ("none", "below 3 Ns/m")
    assert answer_texts(AnswerEstimate(name="damping", value=1.5, **of)) == ("1.50 Ns/m", "0 to 3.00")
    assert answer_texts(AnswerEstimate(name="delay_samples", value=0.1, **of))[1] == "0 to 3.00"


def test_the_wall_to_measure_next_lies_beyond_the_last_damping_if_the_largest_limit_is_there(data, result):
    """Without the trials at large damping, the largest limit is at the last one, and the device predicts a larger."""
    assert "beyond it" not in result.answer.next.why, "the limits have a maximum"
    *lower, before, last = (point for point in result.experiments[0].boundary if point.damping <= 48)
    boundary = (*lower, before.model_copy(update={"damping": 41.0}), last)
    found = told(data, result, boundary=boundary).next
    assert (last.damping, found.damping) == (48.0, 62.0)
    assert found.stiffness > last.limit.stiffness
    assert "the largest limit is at the largest tested damping; beyond it" in found.why
    assert found.command.endswith(f"--dampings {found.damping:g}")


@pytest.mark.parametrize(
    ("span", "text"),
    [
        (DampingSpan(low=72.0), "(9 above; mainly from B = 72 Ns/m upward)."),
        (DampingSpan(high=72.0), "(9 above; mainly up to B = 72 Ns/m)."),
        (DampingSpan(low=24.0, high=72.0), "(9 above; mainly from B = 24 to 72 Ns/m)."),
        (DampingSpan(), "(9 above)."),
        (None, "(9 above)."),
    ],
)
def test_the_dampings_at_which_theory_and_limits_part_are_named(data, result, span, text):
    distance = result.experiments[0].scores[0].distance
    bent = distance.model_copy(update={"bounded": 20, "agreeing": 11, "above": 9, "apart": span})
    found = told(data, result, scores=scored(result, distance=bent))
    assert found.predicts.apart == span
    assert text in lines_of(result.model_copy(update={"answer": found}))[2]


def test_measured_numbers_are_distinguished_from_predicted_ones(result):
    line = lines_of(result)[0]
    assert "Measured: settling time (2 %)" in line
    assert "(predicted)" not in line
    assert "(measured)" not in lines_of(result)[1], "no number next to it is predicted"
    estimates = [
        each.model_copy(update={"large_motion": 9000.0}) if each.name == "stiffness_max" else each
        for each in result.answer.estimates
    ]
    both = result.answer.model_copy(update={"estimates": tuple(estimates)})
    second = lines_of(result.model_copy(update={"answer": both}))[1]
    assert "(measured), at B = " in second
    assert "for a much harder push 9000 (predicted)" in second
    wall = result.answer.wall.model_copy(update={"margin_large_motion": 1.31})
    pushed = lines_of(result.model_copy(update={"answer": result.answer.model_copy(update={"wall": wall})}))[0]
    assert "; for a much harder push 1.3 × K (predicted)." in pushed


def short_lines(result, answer):
    """The answers in short, as on a phone."""
    page = render(ReportData(result.model_copy(update={"answer": answer})))
    block = re.search(r'<ul class="short".*?</ul>', page, re.DOTALL)[0]
    return [" ".join(re.sub(r"<[^>]*>", " ", item).split()) for item in re.findall(r"<li>(.*?)</li>", block, re.DOTALL)]


def test_the_answers_in_short_are_five_lines(data, result):
    answer = result.answer
    wall, step = answer.wall, answer.next
    assert [line.replace("\N{NO-BREAK SPACE}", " ") for line in short_lines(result, answer)] == [
        f"Wall: K = {wall.stiffness:g} N/m, B = {wall.damping:g} Ns/m",
        f"Sure: {answer.wall_trials} good trials, limit at least {at_least(wall.margin)} × K",
        "Theory: boundary yes, costs not known",
        "Deviates: nothing found",
        f"Next: K = {step.stiffness:g} N/m, B = {step.damping:g} Ns/m",
    ]


def test_the_answers_in_short_name_causes_and_what_is_missing(data, result):
    causes = (
        Cause(code="coulomb_friction", sentence="", evidence=""),
        Cause(code="few_trials", sentence="", evidence=""),
    )
    none = {"wall": None, "next": None, "causes": causes, "estimates": (), "estimates_reason": "No loop."}
    lines = short_lines(result, result.answer.model_copy(update=none))
    assert lines[:2] == ["Wall: none recommended", "Sure: no estimates; no intervals"]
    assert lines[3:] == ["Deviates: Coulomb friction, few trials", "Next: no wall"]
    alone = short_lines(result, result.answer.model_copy(update={"wall_trials": 1}))
    assert alone[1].startswith("Sure: chosen by itself, limit at least")
