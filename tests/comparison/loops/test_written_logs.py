"""What is said of a course by the way its logs were written: nothing that they leave open, and no unsafe wall."""

from __future__ import annotations

import numpy as np
import pytest
from labs import compare
from logged import FORMATS, RIGS, lab, scattered, write

from pipeline.comparison.loops.departures import LawRows, course_filter, law_departures
from pipeline.intake.ingest import ingest
from pipeline.measured.wall_command.velocity_filter import VelocityFilterFound


def compared(folder, batch, text="%.17g"):
    write(batch, folder / "raw", text=text)
    assert ingest([folder / "raw"], folder / "processed", jobs=1).ingested == len(batch)
    (found,) = compare("bench", folder / "processed", criteria=("settle_2pct",)).result.experiments
    return found


@pytest.mark.parametrize(
    ("rig", "trials", "text"),
    [("robot", 2, "%.17g"), ("falcon", 9, "%.17g"), pytest.param("motor", 25, "%.8g", marks=pytest.mark.slow)],
)
def test_a_command_logged_one_row_late_is_named_and_no_wall_is_passive(tmp_path, rig, trials, text):
    found = compared(tmp_path, lab(RIGS[rig], max(trials, 9), seed=7, late=1).select(range(trials)), text)
    assert found.causes[0].code == "command_shifted"
    assert "velocity_filter" not in {cause.code for cause in found.causes}
    assert (found.loop.adequate, found.passive, found.loop_boundary) == (False, None, None)
    delay = found.estimates["delay_samples"].value
    assert delay is None or delay == pytest.approx(RIGS[rig].delay, abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("rig", RIGS)
@pytest.mark.parametrize("text", [*FORMATS, "scattered"])
def test_a_course_in_few_digits_is_adequate_where_it_is_in_full(tmp_path, rig, text):
    batch = lab(RIGS[rig], 25, seed=8)
    found = compared(tmp_path, *((scattered(batch, seed=8),) if text == "scattered" else (batch, text)))
    assert {cause.code for cause in found.causes} <= {"scattered_stamps", "coarse_sensor"}
    assert found.loop.adequate, found.loop.reason


def course(codes, filters=None):
    """Rows of a course of which nothing is known but what the wall law found."""
    count = len(codes)
    return LawRows(
        [[code] if code else [] for code in codes],
        [f"shown by {code}" if code else "" for code in codes],
        filters or [None] * count,
        np.zeros(count),
        np.full(count, np.nan),
        np.array(["stable"] * count),
    )


@pytest.mark.parametrize(
    ("logs", "of", "named"),
    [(1, 24, False), (2, 24, False), (3, 24, True), (1, 1, True), (2, 2, True), (3, 149, True), (3, 151, False)],
)
def test_one_log_or_two_of_a_course_name_nothing(logs, of, named):
    found = law_departures(course(["repeated_rows"] * logs + [""] * (of - logs)))
    assert [each.code for each in found] == ["repeated_rows"] * named


def recursive(pole):
    return VelocityFilterFound((1 - pole,), (1.0, -pole))


def test_a_filter_is_the_same_in_all_trials_or_none():
    same = [recursive(0.8 + 1e-4 * k) for k in range(9)]
    assert course_filter(course(["velocity_filter"] * 9, same)) is not None
    other = [recursive(0.1 * k) for k in range(1, 10)]
    assert course_filter(course(["velocity_filter"] * 9, other)) is None
    # as far as rounding makes them differ, 5 % of the gain, they are one, and in half of the logs there is none
    for apart, one in ((0.014, True), (0.0205, False)):
        some = [recursive(0.8)] * 3 + [recursive(0.8 + apart + 1e-5 * k) for k in range(4)]
        assert (course_filter(course(["velocity_filter"] * 7, some)) is not None) is one
    assert course_filter(course([*["velocity_filter"] * 4, *[""] * 4], same[:4] + [None] * 4)) is None
