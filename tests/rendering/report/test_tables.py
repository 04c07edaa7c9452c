"""Tables of a report: trends over header lines that differ, and the truth of a simulation beside what was found."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from report_data import estimate, report_data

from pipeline.device.parts import LoopTable
from pipeline.records.findings import DampingRange, Optimum, Quantity
from pipeline.records.models import Deviation
from pipeline.records.results import (
    Answer,
    AnswerEstimate,
    ComparisonResult,
    CostRange,
    DampingScore,
    HeaderLine,
    ImpliedDelay,
    LoopChange,
    LoopResult,
    MassDeviation,
    Prediction,
    ReachableCost,
    RegionCauses,
    RegionScore,
    Scores,
    SourcedLoop,
    StiffnessScore,
    StraightBound,
    Truth,
    TruthHeld,
    UsePoint,
    UseRegion,
)
from pipeline.rendering.figures.drawing import draw
from pipeline.rendering.figures.overview import delay_figure, sensitivity_figure, trend_figure
from pipeline.rendering.frames import differing_lines, frames, in_order
from pipeline.rendering.labels import MISSING, cost_text, percent_text
from pipeline.rendering.report import report
from pipeline.rendering.table import Table
from pipeline.rendering.tables.boundary_tables import STABLE_ABOVE, measured_damping_notes, region_sentence
from pipeline.rendering.tables.estimate_tables import MISSED, mass_note
from pipeline.rendering.tables.formats import interval_column
from pipeline.rendering.tables.optima_tables import closeness_note, damping_notes
from pipeline.rendering.tables.report_tables import tables_of

DATES = ("2026-05-02", "2026-01-30", "2026-03-11 14:02")
LOOP = SourcedLoop(
    mass=0.58, damping=4, stiffness=0, sampling_period_s=0.001, delay_samples=4, loop=LoopTable(), source="simulator"
)


def line(key: str, *values: str) -> HeaderLine:
    return HeaderLine(key=key, trials=9, different=len(values), values=dict.fromkeys(values, 9 // len(values)))


@pytest.fixture(scope="module")
def result() -> ComparisonResult:
    """Report of three experiments whose logs tell when, with which grease, and by whom."""
    found = report_data().result
    headers = [
        (line("grease", "A" if n else "B"), line("operator", "TH"), line("recorded", DATES[n], "2026-12-01"))
        for n in range(3)
    ]
    changed = [e.model_copy(update={"header": headers[n]}) for n, e in enumerate(found.experiments)]
    return found.model_copy(update={"experiments": tuple(changed)})


def test_lines_that_differ_are_told_and_dates_give_the_order(result: ComparisonResult) -> None:
    keys = differing_lines(result.experiments)
    assert keys == ("recorded", "grease")
    first, second, third = result.experiments
    assert in_order(result.experiments, keys) == [second, third, first]
    (table,) = tables_of(result)["trend"]
    limits = next(rows for block, rows in table.blocks if block.startswith("stiffest limit"))
    assert next(cells[0].text for _, cells in limits) == f"recorded: {DATES[1]} …, grease: A"


def test_limits_and_estimates_are_those_of_the_experiments_in_table_and_figure(result: ComparisonResult) -> None:
    frame = frames(result)["trend"].set_index(["quantity", "experiment"])
    ordered = in_order(result.experiments, differing_lines(result.experiments))
    best = [max(p.limit.stiffness for p in e.boundary if p.limit) for e in ordered]
    assert frame.loc["stiffest limit", "value"].tolist() == best
    assert frame.loc["mass", "value"].tolist() == [e.estimates["mass"].value for e in ordered]
    (figure,) = trend_figure(result)
    shown = np.concatenate([s.y for s in figure.panels[0].series])
    assert sorted(shown) == sorted(best)
    assert len(draw(figure).panels) == len(figure.panels) == 3


def test_nothing_is_shown_where_no_line_differs(result: ComparisonResult) -> None:
    same = [e.model_copy(update={"header": (line("operator", "TH"),)}) for e in result.experiments]
    alike = result.model_copy(update={"experiments": tuple(same)})
    assert tables_of(alike)["trend"] == trend_figure(alike) == []
    assert "trend" not in report.render(replace(report_data(), result=alike, figures=())).partition("<script")[0]


def test_costs_over_delay_are_drawn_of_sweeps_alone(result: ComparisonResult) -> None:
    (figure,) = delay_figure(result.tables)
    panel = figure.panels[0]
    rows = [r for r in result.tables if r.table == "D.6" and r.criterion == "settle_2pct"]
    of = {s.label: s for s in panel.series}
    assert of["theory"].y.tolist() == [r.cost for r in rows if r.condition == "theory_discrete"]
    assert of["experiment"].x.tolist() == list(range(2, 9))
    of = {s.label: s for s in figure.panels[-1].series}
    assert len(of["experiment"].x) == 6, "one has no cost"


def test_costs_over_delay_stand_in_the_form_of_table_d6(result: ComparisonResult) -> None:
    (table,) = tables_of(result)["delay_form"]
    rows = {name: {cell.name: cell.text for cell in row} for _, block in table.blocks for name, row in block}
    assert list(rows) == [f"delay_form/d={delay}" for delay in range(2, 9)]
    of = [r for r in result.tables if r.table == "D.6" and r.criterion == "settle_2pct" and r.delay_samples == 3]
    theory, measured = (next(r for r in of if (r.condition == "theory_discrete") == side) for side in (True, False))
    cells = rows["delay_form/d=3"]
    assert cells["settle_2pct/theory"] == cost_text("settle_2pct", theory.cost)
    assert cells["settle_2pct/experiment"] == cost_text("settle_2pct", measured.cost)
    assert cells["settle_2pct/deviation"] == percent_text(measured.deviation_percent)


def test_the_share_of_the_tested_walls_is_next_to_a_deviation_over_delay(result: ComparisonResult) -> None:
    """As the joint with 8 samples of delay: all of +105 % came from steps of 400 Nm/rad."""
    parts = Deviation(range=0.0, grid=105.0, model=0.0, selection=0.0, model_low=-1.0, model_high=1.0)
    rows = [
        row.model_copy(update={"deviation": parts, "published_cost": 49.0} if row.condition == "experiment" else {})
        for row in result.tables
    ]
    coarse = result.model_copy(update={"tables": tuple(rows)})
    (table,) = tables_of(coarse)["delay_form"]
    deviations = [row["settle_2pct/deviation"] for row in cells(table)]
    assert all(text.endswith("walls +105.0") for text in deviations)
    assert any(note.startswith("Walls: cost of theory at the best tested wall") for note in table.notes)
    (fine,) = tables_of(result)["delay_form"]
    assert not any("walls" in row["settle_2pct/deviation"] for row in cells(fine))
    assert fine.notes == []
    (figure,) = delay_figure(coarse.tables)
    assert "printed in the thesis" in {s.label for s in figure.panels[0].series}
    assert "measured on the real device; they do not depend on these logs" in figure.caption


def known(reason=None):
    """A result whose mass is right, whose delay is not, and which has two limits, one of them right."""
    result = report_data(full=False).result
    first = result.experiments[0]
    estimates = {
        "mass": estimate(0.58, "kg").model_copy(update={"truth": 0.58}),
        "delay_samples": estimate(4.0, "samples").model_copy(update={"truth": 5.0}),
    }
    truth = Truth(loop=LOOP, jitter_samples=0.0, constant_force=0.0, limit_reason=reason)
    limits = 0 if reason else 2
    held = TruthHeld(estimates=2, estimates_held=1, limits=limits, limits_held=limits // 2)
    changed = first.model_copy(update={"estimates": first.estimates | estimates, "truth": truth, "truth_held": held})
    return result.model_copy(update={"experiments": (changed, *result.experiments[1:])})


def test_an_interval_that_misses_the_truth_is_marked() -> None:
    (table,) = tables_of(known())["truth"]
    assert table.notes == [MISSED]
    cells = {name.rpartition("/")[2]: {c.name: c for c in row} for _, rows in table.blocks for name, row in rows}
    assert (cells["mass"]["truth"].marks, cells["delay_samples"]["truth"].marks) == ((), ("a",))
    assert "2 of 4 95 % intervals contain them, limits included" in table.caption
    (without,) = tables_of(known("the delay jitters"))["truth"]
    assert "No limits: the delay jitters." in without.notes
    assert "limits included" not in without.caption
    assert tables_of(report_data(full=False).result)["truth"] == []


def test_the_true_delay_is_compared_with_the_interval_of_the_first_screen() -> None:
    """The integer factor has an interval of 3 to 7 samples, which any delay is in."""
    fitted = estimate(3.9, "samples").model_copy(update={"low": 3.8, "high": 4.0, "by_method": {}})
    about = {"low": 3.0, "high": 7.0, "truth": 5.0, "by_method": {"model": fitted}}
    first = known().experiments[0]
    estimates = first.estimates | {"delay_samples": first.estimates["delay_samples"].model_copy(update=about)}
    loop = LoopResult(source="estimated", adequate=True, reason="")
    changed = first.model_copy(update={"estimates": estimates, "loop": loop})
    (table,) = tables_of(known().model_copy(update={"experiments": (changed,)}))["truth"]
    delay = next(row for row in cells(table) if row["name"].startswith("delay"))
    assert delay["interval"] == "3.80 to 4.00"
    assert table.notes == [MISSED]


def test_the_share_of_intervals_stands_at_the_truth_and_not_in_the_head() -> None:
    page = report.render(replace(report_data(full=False), result=known()))
    head, _, rest = page.partition("</header>")
    assert "intervals of 95 %" not in head
    assert "2 of 4 95 % intervals contain them" in rest


def test_every_caption_drawing_and_the_print_head_say_that_logs_are_simulated() -> None:
    data = report_data()
    figures = tuple(replace(figure, simulated=True) for figure in data.figures)
    page = report.render(replace(data, figures=figures))
    assert page.count(">simulated</text>") == page.count("<svg ")
    numbers = [text for text in page.split("<caption>")[1:] if not text.startswith(("Plan of stages", "Origin"))]
    assert len(numbers) > 4
    assert all("(simulated)</caption>" in text[:400] for text in numbers)
    assert "@top-right" in page
    plain = report.render(replace(data, result=data.result.model_copy(update={"simulated": False})))
    assert "(simulated)" not in plain
    assert "@top-right" not in plain
    assert ">simulated</text>" not in plain


def test_a_limit_below_a_stable_trial_is_explained(result: ComparisonResult) -> None:
    """As a Falcon: stable at 6160 N/m, limit 6000 N/m (6000 to 6801)."""
    first = result.experiments[0]
    at = {"unstable": 6400.0, "estimate": 6000.0, "low": 6000.0, "high": 6801.0, "censored": False}
    notes = {}
    for stable in (6160.0, 5900.0):
        point = first.boundary[1].model_copy(update=at | {"stable": stable})
        changed = first.model_copy(update={"boundary": (point,)})
        (table,) = tables_of(result.model_copy(update={"experiments": (changed,)}))["boundary"]
        notes[stable] = STABLE_ABOVE in table.notes
    assert notes == {6160.0: True, 5900.0: False}


def test_dampings_that_are_printed_alike_have_rows_of_their_own(result: ComparisonResult) -> None:
    first = result.experiments[0]
    pair = [first.boundary[0].model_copy(update={"damping": damping}) for damping in (82.7201, 82.7199)]
    changed = first.model_copy(update={"boundary": tuple(pair)})
    (table,) = tables_of(result.model_copy(update={"experiments": (changed,)}))["boundary"]
    names = [name for _, rows in table.blocks for name, _ in rows]
    assert len(set(names)) == len(names) == 2


@pytest.mark.parametrize(
    ("value", "low", "high", "text", "aside"),
    [
        (2.00003, 1.99995, 2.00011, "2.000030", "1.999950 to 2.000110"),
        (-20.5, -41.8, 0.836, "−20.5", "−41.8 to 0.836"),
        (0.58, None, None, "0.580", ""),
    ],
)
def test_an_interval_gets_the_digits_that_tell_its_ends_apart(value, low, high, text, aside):
    row = {"area": value, "area_low": low, "area_high": high}
    cell = interval_column("area").cell(row, Table("t", "", ()), "")
    assert (cell.text, cell.aside) == (text, aside)


def test_no_interval_of_a_report_is_printed_without_a_width(falcon_outcome):
    found = [cell.aside for tables in tables_of(falcon_outcome.result).values() for t in tables
             for row in t.rows for cell in row if " to " in cell.aside]  # fmt: skip
    assert len(found) > 10
    assert [aside for aside in found if len(set(aside.split(" to "))) == 1] == []


def answer(name: str, **changes: Any) -> Answer:
    """An answer with a wall, two estimates and a prediction."""
    mass = AnswerEstimate(name="mass", value=0.58, low=0.57, high=0.6, unit="kg")
    delay = AnswerEstimate(name="delay_samples", value=4.0, low=3.999999, high=4.000001, unit="samples")
    about = {
        "wall": UsePoint(stiffness=4.5, damping=0.25, trial_id="a", costs={}, margin=2.0),
        "estimates": (delay, mass),
        "predicts": Prediction(code="yes", boundary="partly", optimal_costs="yes"),
        "reachable": ReachableCost(delay_samples=4.0, best=24.5, reached=30.0, per_sample=4.9, within=0.012),
    }
    return Answer(experiment=name, **about | changes)


def answered(result: ComparisonResult) -> ComparisonResult:
    use = UseRegion(criterion="overshoot", stiffness_low=4.0, stiffness_high=5.0, damping_low=0.0, damping_high=1.0,
                    trials=6, costs={}, margin=2.0, bound=False, point=answer("1").wall)  # fmt: skip
    unknown = Prediction(code="unknown", reason="too few limits")
    answers = [answer("1"), answer("2", wall=None, estimates=(), predicts=unknown), answer("3")]
    own = [
        e.model_copy(update={"answer": a, "use": use if a.wall else None})
        for e, a in zip(result.experiments, answers, strict=True)
    ]
    return result.model_copy(update={"experiments": tuple(own)})


def cells(table: Table) -> list[dict[str, str]]:
    return [{c.name: f"{c.text} {c.aside}".strip() for c in row} for row in table.rows]


def test_experiments_are_compared_in_one_table_that_begins_with_wall_and_verdict(result: ComparisonResult) -> None:
    (table,) = tables_of(answered(result))["overview"]
    names = ["experiment", "wall_stiffness", "wall_damping", "boundary", "costs"]
    assert [column.name for column in table.columns][:5] == names
    first, second, _ = cells(table)
    assert [first[name] for name in names] == ["1", "4.5", "0.25", "partly", "yes"]
    assert (first["mass"], first["delay_samples"]) == ("0.580 0.570 to 0.600", "4.000 within 0.001 %")
    assert [second[name] for name in (*names[1:], "mass")] == ["–", "–", "not known", "not known", "–"]
    assert all(cell.why for cell in table.rows[1] if cell.text == "–"), "reasons in place of dashes"
    alone = answered(result).model_copy(update={"experiments": answered(result).experiments[:1]})
    assert tables_of(alone)["overview"] == [], "one experiment is answered by the first screen"


def test_design_rules_are_those_of_the_wall_and_the_delay(result: ComparisonResult) -> None:
    (table,) = tables_of(answered(result))["rules"]
    rows = {row["experiment"]: row for row in cells(table)}
    # roots of m s^2 + (b + B) s + K: equal for critical damping, at 45 degrees for the amplitude optimum (5.17)
    mass, damping, stiffness = 0.58, 4.0, 4.5
    for name, angle in (("critical", 0.0), ("amplitude", np.pi / 4)):
        B = float(rows["1"][name].replace("−", "-"))
        root = np.roots([mass, damping + B, stiffness])[0]
        assert abs(np.angle(-root)) == pytest.approx(angle, abs=0.1), name
    assert (rows["1"]["best"], rows["1"]["reached"], rows["1"]["per_sample"]) == ("24.5", "30", "4.9")
    assert rows["2"]["critical"] == "–"


def test_optima_state_how_far_they_lie_from_those_of_theory(result: ComparisonResult) -> None:
    rows = tuple(
        row.model_copy(update={"stiffness_deviation_percent": -19.5, "damping_deviation_percent": 4.2})
        if row.condition == "experiment_1"
        else row
        for row in result.tables
    )
    table = tables_of(result.model_copy(update={"tables": rows}))["optima"][0]
    shown = {cell.name: cell.aside for name, row in table.blocks[0][1] if "experiment_1" in name for cell in row}
    assert (shown["stiffness"], shown["damping"]) == ("−20 %", "+4 %")


@pytest.mark.parametrize(
    ("curvature", "theory", "words"),
    [
        ((-1.0, 1.0), -2.0, "straight; theory's curvature is excluded"),
        ((-3.0, 1.0), -2.0, "straight or curved as theory: not decided"),
        ((-3.0, -1.0), -2.0, "curved as theory"),
        ((-3.0, -1.0), -5.0, "curved; theory's curvature is excluded"),
        ((-1.0, 1.0), None, "straight; no curvature of theory to compare"),
        ((-3.0, -1.0), None, "curved; no curvature of theory to compare"),
    ],
)
def test_the_shape_of_a_boundary_is_stated_in_words(result: ComparisonResult, curvature, theory, words) -> None:
    low, high = curvature
    line = StraightBound(
        stiffness=38_000,
        slope=-230,
        slope_low=-250,
        slope_high=-210,
        damping_first=96,
        damping_last=160,
        limits=6,
        curvature=0.5 * (low + high),
        curvature_low=low,
        curvature_high=high,
        curvature_theory=theory,
        curvature_last=None if theory is None else 144,
    )
    none = Quantity(value=None, unit="samples")
    bent = result.experiments[0].model_copy(
        update={"straight_bound": line, "implied_delay": ImpliedDelay(origin=none, whole=none)}
    )
    (table,) = tables_of(result.model_copy(update={"experiments": (bent,)}))["shapes"]
    (shown,) = cells(table)
    assert words in shown["shape"]
    assert ("beyond it" in shown["shape"]) is (theory is not None)


def test_a_table_states_once_with_which_device_theory_was_computed(result: ComparisonResult) -> None:
    device = {"theory_mass": 0.58, "theory_damping": 4.0, "theory_source": "device file falcon", "delay_samples": 4.0}
    rows = [row.model_copy(update=device if row.condition.startswith("theory") else {}) for row in result.tables]
    table = tables_of(result.model_copy(update={"tables": tuple(rows)}))["optima"][0]
    about = [note for note in table.notes if note.startswith("Theory:")]
    assert about == ["Theory: m = 0.580 kg, b = 4 Ns/m, d = 4 (device file falcon)."]
    without = tables_of(result)["optima"][0]
    assert not any(note.startswith("Theory:") for note in without.notes)


@pytest.mark.parametrize(("free", "words"), [(True, "Without overshoot: up to 0.92 %"), (False, "No stable trial is")])
@pytest.mark.parametrize("alone", [True, False])
def test_an_optimum_by_overshoot_states_its_threshold(result: ComparisonResult, free, words, alone) -> None:
    best = Optimum(stiffness=6800, damping=128, cost=0.0081, trial_id="a", trials=9, resolution=0.0092,
                   free_of_overshoot=free, is_alone=alone)  # fmt: skip
    first = result.experiments[0].model_copy(update={"optimum": {"overshoot": best}})
    (table,) = tables_of(result.model_copy(update={"experiments": (first,)}))["measured_optima"]
    assert any(note.startswith(words) for note in table.notes)
    assert any("it is no region but a single trial" in note for note in table.notes) == (free and alone)


def test_a_distance_from_the_limit_is_rounded_down_and_agrees_with_its_word(result: ComparisonResult) -> None:
    """1.286 is not close to the limit (1.25), so it must not be printed as 1.2; 1.457 is not at least 1.5."""
    around = DampingRange(low=35.0, high=145.7, low_is_limit=True, high_is_limit=True, margin=1.286)
    best = Optimum(stiffness=7200, damping=113.3, cost=24, trial_id="a", trials=9, margin=1.286, damping_range=around)
    first = answered(result).experiments[0]
    assert first.use is not None
    point = first.use.point.model_copy(update={"margin": 1.457, "damping_range": around})
    costs = {"settle_2pct": CostRange(median=24, low=22, high=30, trials=6)}
    use = first.use.model_copy(update={"point": point, "costs": costs})
    first = first.model_copy(update={"optimum": {"settle_2pct": best}, "use": use})
    tables = tables_of(result.model_copy(update={"experiments": (first,)}))
    (optimum,) = cells(tables["measured_optima"][0])
    assert optimum["margin"] == "≥ 1.28"
    assert optimum["at_border"] == "no"
    (wall,) = cells(tables["use"][0])
    assert wall["point_margin"] == "1.4"
    assert wall["point_damping_range_margin"].startswith("1.2")


DAMPING = {"damping": estimate(4.0, "Ns/m")}


def rows_of_a_table(*, damped: float | None, margins: tuple[float, float, float] = (2.0, 1.9, 1.5)) -> list[dict]:
    """Theory, theory with the measured damping if there is a cost of it, and one trial, by one criterion."""
    about = {"criterion": "settle_2pct", "delay_samples": 4.0, "theory_mass": 0.58, "theory_damping": 4.0}
    row = {**about, "experiment": None, "deviation_percent": None}
    rows = [row | {"raw": "theory_discrete", "cost": 20.0, "margin": margins[0]}]
    if damped is not None:
        rows.append(row | {"raw": "theory_damped", "cost": damped, "margin": margins[1], "theory_damping": 9.0})
    trial = {"raw": "experiment_1", "experiment": "0", "cost": 30.0, "deviation_percent": 50.0, "margin": margins[2]}
    return [*rows, row | trial]


def led(result: ComparisonResult, damping: Any) -> ComparisonResult:
    """A report whose first experiment has the theory of `LOOP`, and a damping from its logs."""
    first = result.experiments[0]
    first = first.model_copy(update={"experiment": "0", "theory": LOOP, "estimates": first.estimates | damping})
    return result.model_copy(update={"experiments": (first,), "known_device": True})


def test_the_part_of_the_measured_damping_in_a_deviation_is_stated(result: ComparisonResult) -> None:
    (note,) = damping_notes(rows_of_a_table(damped=25.0), led(result, DAMPING), swept=False)
    assert "(b = 9 instead of 4 Ns/m)" in note
    assert "+20.0 % instead of +50.0 % (experiment 0)" in note, "30/25 and 30/20"
    (note,) = damping_notes(rows_of_a_table(damped=25.0), led(result, DAMPING), swept=True)
    assert note.endswith("20 % instead of 50 % (median size).")


def test_a_measured_damping_that_agrees_or_is_unknown_explains_nothing(result: ComparisonResult) -> None:
    rows = rows_of_a_table(damped=None)
    (note,) = damping_notes(rows, led(result, DAMPING), swept=False)
    assert "agrees with the stated one" in note
    (note,) = damping_notes(rows, led(result, {"damping": estimate(None, "Ns/m", "no trial")}), swept=False)
    assert "do not determine the damping" in note
    other = led(result, DAMPING).model_copy(update={"known_device": False})
    assert damping_notes(rows, other, swept=False) == []


def test_optima_closer_to_the_limit_than_those_of_theory_are_counted() -> None:
    assert closeness_note(rows_of_a_table(damped=25.0)) == (
        "Optima of the logs and the limit, by the limit over K: 1 of 1 may lie closer to it than that of theory, "
        "1 of 1 may lie closer to it than that of theory with the measured damping."
    )
    note = closeness_note(rows_of_a_table(damped=25.0, margins=(1.2, 1.1, 1.5)))
    assert note.startswith("By the limit over K, no optimum of the logs lies closer")
    assert "1 of 1" in closeness_note(rows_of_a_table(damped=None))
    assert closeness_note([row | {"margin": None} for row in rows_of_a_table(damped=None)]) is None


def test_scores_with_the_measured_damping_are_a_second_row(result: ComparisonResult) -> None:
    first = led(result, DAMPING).experiments[0]
    stated = Scores(parameters=LOOP, basis="device file", damping=damping_score(100.0, 200.0))
    damped = Scores(parameters=LOOP, basis="measured damping", damping=damping_score(100.0, 125.0))
    both = led(result, DAMPING).model_copy(
        update={"experiments": (first.model_copy(update={"scores": (stated, damped)}),)}
    )
    (note,) = measured_damping_notes(both)
    assert note.endswith("changes the scores: largest stable B −50.0 to −20.0 %.")
    (table,) = tables_of(both)["scores"]
    assert [name for _, rows in table.blocks for name, _ in rows] == ["scores/0", "scores/0/measured-damping"]
    assert "theory by the device file" in table.caption
    alone = both.model_copy(update={"experiments": (first.model_copy(update={"scores": (stated,)}),)})
    assert measured_damping_notes(alone) == [
        "Experiment 0: the damping of the logs agrees with the stated one, so it explains no deviation."
    ]
    assert measured_damping_notes(alone.model_copy(update={"known_device": False})) == []


def test_scores_of_limits_are_left_out_where_the_boundary_is_not_judged(result: ComparisonResult) -> None:
    """One limit agrees by chance: an overlap of 99.9 % next to "not known" would be read as a proof."""
    stiffness = StiffnessScore(
        measured=1.0, measured_damping=1.0, lower_bound=True, theory=2.0, theory_damping=1.0, anywhere=2.0,
        anywhere_damping=1.0, deviation_percent=-50.0,
    )  # fmt: skip
    scores = Scores(parameters=LOOP, basis="device file", stiffness=stiffness, damping=damping_score(100.0, 200.0))
    shown = {}
    for e in answered(result).experiments[:2]:
        changed = result.model_copy(update={"experiments": (e.model_copy(update={"scores": (scores,)}),)})
        (table,) = tables_of(changed)["scores"]
        (shown[e.answer.predicts.code],) = cells(table)
        reasons = table.reasons
    assert shown["yes"]["stiffness_deviation_percent"].startswith("≥ −50.0")
    assert shown["unknown"]["stiffness_deviation_percent"] == MISSING
    assert shown["unknown"]["damping_deviation_percent"].startswith("−50.0")
    assert "not judged: too few limits" in reasons


def damping_score(measured: float, theory: float) -> DampingScore:
    percent = 100 * (measured / theory - 1)
    return DampingScore(measured=measured, lower_bound=False, theory=theory, deviation_percent=percent)


def test_costs_with_the_measured_damping_are_drawn_and_listed_over_delay(result: ComparisonResult) -> None:
    damped = [
        row.model_copy(update={"condition": "theory_damped", "cost": 0.5 * row.cost})
        for row in result.tables
        if row.table == "D.6" and row.condition == "theory_discrete"
    ]
    more = result.model_copy(update={"tables": (*result.tables, *damped)})
    (figure,) = delay_figure(more.tables)
    curves = {s.label: s for s in figure.panels[0].series}
    assert curves["theory, measured damping"].y.tolist() == (0.5 * curves["theory"].y).tolist()
    assert "Dashed" in figure.caption
    assert "Dashed" not in delay_figure(result.tables)[0].caption
    (table,) = tables_of(more)["delay_form"]
    assert "settle_2pct/damped" in {cell.name for cell in table.rows[0]}
    assert "settle_2pct/damped" not in {cell.name for cell in tables_of(result)["delay_form"][0].rows[0]}


def region(ratio: float, half: float) -> RegionScore:
    """A measured region whose area is ``ratio`` times that of theory."""
    shares = dict.fromkeys(("overlap", "overlap_low", "overlap_high", "covered", "covered_low", "covered_high"), 0.9)
    areas = {"area_ratio": ratio, "area_ratio_low": ratio - half, "area_ratio_high": ratio + half}
    about = {"measured_area": ratio, "theory_area": 1.0, "damping_low": 0.0, "damping_high": 9.0}
    return RegionScore(**shares, **areas, **about, dampings=9, censored=0)


def smaller(result: ComparisonResult, ratio: float, causes: RegionCauses | None, half: float = 0.05) -> Any:
    """An experiment with this region, and with causes of its size."""
    scores = Scores(parameters=LOOP, basis="device file", region=region(ratio, half))
    loop = LoopResult(source="estimated", adequate=causes is not None, reason="replay fails; more")
    changes = {"scores": (scores,), "region_causes": causes, "loop": loop, "experiment": "0"}
    return result.experiments[0].model_copy(update=changes)


FILTERED = RegionCauses(
    changes=(
        LoopChange(code="velocity_filter", percent=-30.0),
        LoopChange(code="delay", percent=-8.0),
        LoopChange(code="mass", percent=50.0),
    ),
    together_percent=-38.0,
)


@pytest.mark.parametrize(
    ("ratio", "causes", "text"),
    [
        (
            0.6,
            FILTERED,
            "40 % smaller than theory's. According to the logs, the main cause is: velocity filter (−30.0 %).",
        ),
        (0.6, FILTERED, "All numbers and parts of the logs together change it by −38.0 %, which explains it."),
        (0.4, FILTERED, "change it by −38.0 %; the rest is unexplained."),
        (1.4, FILTERED, "40 % larger than theory's. According to the logs, the main cause is: mass (+50.0 %)."),
        (0.6, RegionCauses(changes=(), together_percent=0.0), "No number or part of the logs explains it."),
        (0.6, None, "The cause is unknown: replay fails."),
    ],
)
def test_the_cause_of_a_smaller_or_larger_region_is_named(
    result: ComparisonResult, ratio: float, causes: RegionCauses | None, text: str
) -> None:
    assert text in region_sentence(smaller(result, ratio, causes))


def test_a_region_as_large_as_that_of_theory_needs_no_cause(result: ComparisonResult) -> None:
    same = smaller(result, 0.97, FILTERED)
    assert region_sentence(same) == region_sentence(smaller(result, 0.99, FILTERED, half=0.001)) == ""
    (table,) = tables_of(result.model_copy(update={"experiments": (same,)}))["regions"]
    where = "Experiment 0: over the tested dampings, the measured region is"
    assert table.notes == [f"{where} as large as theory's, within its interval or 2 %."]
    cells = {cell.name: cell.text for cell in table.rows[0]}
    assert (cells["measured"], cells["velocity_filter"], cells["together"]) == ("−3.0", "−30.0", "−38.0")
    assert tables_of(result)["regions"] == []


def test_bars_show_what_limits_each_device(result: ComparisonResult) -> None:
    changes = (LoopChange(code="delay", percent=50.0), LoopChange(code="friction", percent=-20.0))
    first, second, *_ = result.experiments
    known = [
        first.model_copy(update={"sensitivities": changes}),
        second.model_copy(update={"sensitivities": changes[:1]}),
    ]
    (figure,) = sensitivity_figure(known)
    panel = figure.panels[0]
    assert panel.ticks == ("a sample less\nof delay", "without\nfriction")
    assert [s.y.tolist() for s in panel.series] == [[50.0, -20.0], [50.0]]
    # bars of a change are next to each other, centred at its name
    assert np.mean([s.x[0] for s in panel.series]) == pytest.approx(0.0)
    assert panel.series[1].x[0] - panel.series[0].x[0] == pytest.approx(0.4)
    low, high = panel.limits[1]
    assert low < -20.0 < 50.0 < high
    (drawn,) = draw(figure).panels
    assert "without" in drawn
    assert all(f">experiment {e.experiment}</text>" in drawn for e in known)
    alone = draw(sensitivity_figure(known[:1])[0]).panels[0]
    assert f">experiment {known[0].experiment}</text>" not in alone
    assert "a sample less of delay +50.0 %" in panel.words
    assert sensitivity_figure(result.experiments) == []


def weighed(*masses: MassDeviation) -> ComparisonResult:
    found = report_data().result
    first = found.experiments[0].model_copy(update={"masses": masses, "experiment": "0"})
    return found.model_copy(update={"experiments": (first,)})


SAME = MassDeviation(source="device file", stated=0.58, percent=-1.0, low=-3.0, high=1.0, momentum_percent=6.0)
LIGHTER = MassDeviation(source="weighed", section="6.1.2", stated=0.95, percent=-40.0, low=-42.0, high=-38.0)


def test_stated_masses_are_next_to_the_estimated_ones() -> None:
    (table,) = tables_of(weighed(SAME, LIGHTER))["experiments"]
    cells = {cell.name: (cell.text, cell.aside) for cell in table.rows[0]}
    assert cells["stated_mass"] == ("0.580", "logs −1.0 % (−3.0 to +1.0), momentum +6.0 %")
    assert cells["weighed_mass"] == ("0.950", "logs −40.0 % (−42.0 to −38.0)")
    assert "weighed_mass" not in {cell.name for cell in tables_of(weighed(SAME))["experiments"][0].rows[0]}


def test_a_mass_many_times_the_weighed_one_is_a_factor() -> None:
    heavy = MassDeviation(
        source="weighed", stated=0.0057, percent=3233.3, low=3233.0, high=3233.6, momentum_percent=9.0
    )
    (table,) = tables_of(weighed(heavy))["experiments"]
    assert {cell.name: cell.aside for cell in table.rows[0]}["weighed_mass"] == "logs × 33.3, momentum +9.0 %"


def test_a_note_states_whether_the_apparent_mass_differs() -> None:
    assert (
        mass_note(weighed(SAME)) == "The apparent mass of the logs agrees with each stated mass, within its interval."
    )
    note = mass_note(weighed(SAME, LIGHTER))
    assert note.startswith("The apparent mass of the logs differs from the weighed one in 1 of 1 experiment,")
    heavier = LIGHTER.model_copy(update={"source": "device file"})
    assert "from that of the device file in 1 of 1 experiment" in mass_note(weighed(heavier))
    assert mass_note(weighed()) is None
    assert mass_note(weighed(MassDeviation(source="device file", stated=0.58))) is None


def test_an_interval_that_prints_like_its_deviation_is_left_out() -> None:
    exact = MassDeviation(source="device file", stated=0.58, percent=0.001, low=-0.002, high=0.003)
    (table,) = tables_of(weighed(exact))["experiments"]
    assert {cell.name: cell.aside for cell in table.rows[0]}["stated_mass"] == "logs 0.0 %"
