"""Tables of a report: trends over header lines that differ, and the truth of a simulation beside what was found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from report_data import estimate, report_data

from pipeline.device.parts import LoopTable
from pipeline.records.results import ComparisonResult, HeaderLine, SourcedLoop, Truth, TruthHeld
from pipeline.rendering.figures.drawing import draw
from pipeline.rendering.figures.overview import delay_figure, trend_figure
from pipeline.rendering.frames import differing_lines, frames, in_order, limit_of
from pipeline.rendering.labels import cost_text, percent_text
from pipeline.rendering.report import report
from pipeline.rendering.report.tables import MISSED, interval_column, tables_of
from pipeline.rendering.table import Table

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
    best = [max((p for p in e.boundary if p.stable is not None), key=lambda p: p.stable) for e in ordered]
    assert frame.loc["stiffest limit", "value"].tolist() == [limit_of(point) for point in best]
    assert frame.loc["mass", "value"].tolist() == [e.estimates["mass"].value for e in ordered]
    (figure,) = trend_figure(result)
    shown = np.concatenate([s.y for s in figure.panels[0].series])
    assert sorted(shown) == sorted(limit_of(point) for point in best)
    assert len(draw(figure).panels) == len(figure.panels) == 3


def test_nothing_is_shown_where_no_line_differs(result: ComparisonResult) -> None:
    same = [e.model_copy(update={"header": (line("operator", "TH"),)}) for e in result.experiments]
    alike = result.model_copy(update={"experiments": tuple(same)})
    assert tables_of(alike)["trend"] == trend_figure(alike) == []
    assert "trend" not in report.render(replace(report_data(), result=alike, figures=())).partition("<script")[0]


def test_costs_over_delay_are_drawn_of_sweeps_alone(result: ComparisonResult) -> None:
    (figure,) = delay_figure(result.tables, {})
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
    assert "2 of 4 95 % intervals contain them" in table.caption
    (without,) = tables_of(known("the delay jitters"))["truth"]
    assert "No limits: the delay jitters." in without.notes
    assert tables_of(report_data(full=False).result)["truth"] == []


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
