"""The table of scores: what stands in which cell, and that a missing score tells why."""

from __future__ import annotations

import pytest
from report_data import BOUND

from pipeline.records.score_records import MapScore
from pipeline.rendering.report.report_parts import take_apart
from pipeline.rendering.report.report_scores import (
    cost_score_table,
    estimate_score_table,
    rule_score_table,
    score_table,
)


def text(table, name):
    return next(c for _, rows in table.blocks for row in rows for c in row if c.name == f"{table.name}/{name}")


@pytest.fixture
def result(falcon_outcome):
    return falcon_outcome.result


def changed(result, **scores):
    experiment = result.experiments[0]
    first = experiment.scores[0].model_copy(update=scores)
    return result.model_copy(
        update={"experiments": (experiment.model_copy(update={"scores": (first, *experiment.scores[1:])}),)}
    )


def test_table_holds_the_scores_one_row_each(result):
    table, s = score_table(result), result.experiments[0].scores[0]
    assert table.caption == "Measured against theory (theory by the device file)"
    assert [column.head for column in table.columns] == ["score", "1"]
    assert float(text(table, "overlap/1").text) == pytest.approx(100 * s.region.overlap, abs=0.1)
    assert text(table, "overlap/score").text.endswith("[%]")
    assert text(table, "distance_rms/score").text.endswith("[N/m]")
    assert text(table, "band/1").text == "100"
    assert text(table, "delay/1").text == "4.00"
    assert text(table, "bound/1").text == "none"
    assert "cuts off" in text(table, "bound/1").why
    costs = cost_score_table(result)
    for criterion in ("settle_2pct", "energy_step_w0"):
        assert float(text(costs, f"map/{criterion}/1").text) > 0.98
        o = next(o for o in s.optima if o.criterion == criterion)
        printed = text(table, f"optimum/{criterion}/1").text.replace("\N{MINUS SIGN}", "-")
        assert float(printed) == pytest.approx(o.cost_percent, abs=0.05)
    assert text(table, "optimum/overshoot/1").why.startswith("the cost of theory is zero")


def test_first_table_is_short_and_the_rules_stand_apart(result):
    rows = [row[0].row for _, block in score_table(result).blocks for row in block]
    optima = [row for row in rows if row.startswith("scores/optimum/")]
    assert len(optima) == len({o.criterion for o in result.experiments[0].scores[0].optima})
    assert len(rows) == len(optima) + 11, "eleven on stability, one a criterion"
    assert not any("polynomial" in row or "map/" in row for row in rows)
    rules = rule_score_table(result)
    o = next(o for o in result.experiments[0].scores[0].optima if o.criterion == "settle_2pct")
    printed = text(rules, "polynomial/settle_2pct/1").text.replace("\N{MINUS SIGN}", "-")
    assert float(printed) == pytest.approx(o.polynomial_percent, abs=0.05)
    nothing = {"polynomial_percent": None, "damped_percent": None}
    none = [x.model_copy(update=nothing) for x in result.experiments[0].scores[0].optima]
    assert rule_score_table(changed(result, optima=tuple(none))) is None
    assert cost_score_table(changed(result, maps=())) is None


def test_reasons_that_differ_in_numbers_share_one(result):
    first, second = (
        changed(result, bound=None, missing={"bound": f"cuts off {cut} % (chance {chance}): found from 2 % on"})
        for cut, chance in (("0.4", "1"), ("0.2", "2.8e−12"))
    )
    other = second.experiments[0].model_copy(update={"experiment": "2"})
    both = first.model_copy(update={"experiments": (*first.experiments, other)})
    table = score_table(both)
    assert "cuts off 0.2 to 0.4 % (chance 2.8e−12 to 1): found from 2 % on" in table.whys
    assert sum("cuts off" in why for why in table.whys) == 1


def test_second_table_is_that_of_the_estimates(result, unknown_outcome):
    table = estimate_score_table(result)
    assert float(text(table, "overlap/1").text) > 98
    assert not any("optimum" in c.name for _, rows in table.blocks for row in rows for c in row)
    assert estimate_score_table(unknown_outcome.result) is None
    assert "estimates of each experiment" in score_table(unknown_outcome.result).caption


def test_missing_scores_tell_why(result):
    nothing = changed(result, region=None, distance=None, stiffness=None, missing={"region": "one damping only"})
    table = score_table(nothing)
    assert (text(table, "overlap/1").text, text(table, "overlap/1").why) == ("–", "one damping only")
    assert text(table, "distance_rms/1").why == "not available"
    few = MapScore(
        criterion="overshoot", trials=3, rank_correlation=None, median_ratio=1.0, ratios=3, reason="3 trials"
    )
    assert text(cost_score_table(changed(result, maps=(few,))), "map/overshoot/1").why == "3 trials"
    bare = result.experiments[0].model_copy(update={"scores": ()})
    assert score_table(result.model_copy(update={"experiments": (bare,)})) is None


def test_bound_is_printed_with_its_intervals(result):
    cell = text(score_table(changed(result, bound=BOUND)), "bound/1")
    assert cell.text == "38000 \N{MINUS SIGN} 230 B"
    assert cell.aside == "37000 to 39000; 220 to 240; cuts off 20.0 %"


def test_what_is_not_quite_all_is_not_printed_as_all(result):
    s = result.experiments[0].scores[0]
    table = score_table(changed(result, verdicts=s.verdicts.model_copy(update={"agreement": 0.9999})))
    assert text(table, "verdicts/1").text == "99.9"


def test_page_shows_the_scores_with_names(falcon_outcome, result):
    found = take_apart(falcon_outcome.report.read_text(encoding="utf-8")).cells
    table = score_table(result)
    for name in ("scores/overlap/1", "scores-costs/map/settle_2pct/1", "scores-estimates/overlap/1"):
        assert found[name]
    assert found["scores/distance_rms/1"] == text(table, "distance_rms/1").text


def test_an_experiment_may_bear_the_name_of_a_column(result):
    renamed = result.experiments[0].model_copy(update={"experiment": "score"})
    table = score_table(result.model_copy(update={"experiments": (renamed,)}))
    names = [cell.name for _, rows in table.blocks for row in rows for cell in row]
    assert len(names) == len(set(names))
    assert text(table, "band/score").text == "100"
