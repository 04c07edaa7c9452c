"""What simulated logs are called in a report, and what is said of the truth."""

from __future__ import annotations

from dataclasses import replace

from report_data import estimate, report_data

from pipeline.records.loop_parts import LoopParts
from pipeline.records.results import TheoryParameters, Truth, TruthHeld
from pipeline.rendering.report import report
from pipeline.rendering.report.report_parts import take_apart
from pipeline.rendering.report.report_truth import MISSED, truth_table

LOOP = TheoryParameters(
    mass=0.58, damping=4, stiffness=0, sampling_period_s=0.001, delay_samples=4, loop=LoopParts(), source="simulator"
)


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


def test_an_interval_that_misses_the_truth_is_marked():
    table = truth_table(known())
    assert table.notes == [MISSED]
    cells = {cell.name.rpartition("/")[2]: cell for cell in table.rows[0]}
    assert cells["mass"].marks == ()
    assert cells["delay_samples"].marks == ("a",)
    assert cells["limits"].text == "1 of 2"
    assert table.caption.endswith(": 2 of 4 intervals of 95 % hold it")


def test_limits_without_truth_have_the_reason():
    table = truth_table(known("the delay jitters"))
    assert "the delay jitters" in table.whys
    assert "1 of 2 intervals" in table.caption


def test_nothing_is_said_of_a_truth_that_is_not_known():
    assert truth_table(report_data(full=False).result) is None


def test_the_share_of_intervals_stands_at_the_truth_and_not_in_the_head():
    data = report_data(full=False)
    page = report.render(replace(data, result=known()))
    head, _, rest = page.partition("</header>")
    assert "intervals of 95 %" not in head
    assert "2 of 4 intervals of 95 % hold it" in rest


def test_every_caption_drawing_and_the_print_head_say_that_logs_are_simulated():
    data = report_data()
    figures = tuple(replace(figure, simulated=True) for figure in data.figures)
    page = report.render(replace(data, figures=figures))
    assert all(drawing.endswith(">simulated</text></svg>") for drawing in take_apart(page).figures.values())
    numbers = [text for text in page.split("<caption>")[1:] if not text.startswith(("Plan of stages", "Origin"))]
    assert len(numbers) > 4
    assert all("(simulated)</caption>" in text[:400] for text in numbers)
    assert "@top-right" in page
    measured = data.result.model_copy(update={"simulated": False})
    plain = report.render(replace(data, result=measured))
    assert "(simulated)" not in plain
    assert "@top-right" not in plain
    assert ">simulated</text>" not in plain
