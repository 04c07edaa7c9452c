"""The trend over experiments: by header lines that differ, in the order of their dates, with limits as measured."""

from __future__ import annotations

from dataclasses import replace

import pytest
from report_data import report_data

from pipeline.comparison.figures.figure_trend import trend_figures
from pipeline.records.results import ComparisonResult, HeaderLine
from pipeline.rendering.figures.trend_panels import trends
from pipeline.rendering.report import report
from pipeline.rendering.report.report_trend import differing_lines, in_order, limit_of, stiffest, trend_table

DATES = ("2026-05-02", "2026-01-30", "2026-03-11 14:02")


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
    changed = [e.model_copy(update={"header": headers[n]}) for n, e in enumerate(found.experiments[:3])]
    assert len(changed) == 3
    return found.model_copy(update={"experiments": tuple(changed)})


def test_lines_that_differ_are_told_and_dates_give_the_order(result: ComparisonResult) -> None:
    assert differing_lines(result.experiments) == ("grease", "recorded")
    first, second, third = result.experiments
    assert in_order(result.experiments) == [second, third, first]
    table = trend_table(result)
    assert table is not None
    assert [row[0].text for row in table.rows] == [e.experiment for e in (second, third, first)]
    assert [record["line/grease"] for record in table.records] == ["A", "A", "B"]
    assert table.records[0]["line/recorded"] == f"{DATES[1]} …"


def test_limits_and_estimates_are_those_of_the_experiments(result: ComparisonResult) -> None:
    table = trend_table(result)
    assert table is not None
    for record, experiment in zip(table.records, in_order(result.experiments), strict=True):
        known = [point for point in experiment.boundary if point.stable is not None]
        best = max(known, key=lambda point: point.stable)
        assert stiffest(experiment) == best
        assert record["limit"] == limit_of(best) == (best.stable if best.censored else best.estimate or best.stable)
        for name in ("mass", "damping"):
            if name in experiment.estimates:
                assert record[name] == experiment.estimates[name].value


def test_figure_shows_the_numbers_of_the_table(result: ComparisonResult) -> None:
    (figure,) = trend_figures(result.experiments, "translation")
    table = trend_table(result)
    assert table is not None
    assert figure.panels[0].value == tuple(record["limit"] for record in table.records)
    assert [line for _, line in figure.panels[0].names] == [f"{date} …" for date in sorted(DATES)]
    drawn = trends(figure)
    assert len(drawn) == len(figure.panels)
    (axes,) = drawn[0].shown["axes"]
    told = {label: y for label, _, y in axes["series"]}
    values = [value for label, ys in told.items() if "95 %" not in label for value in ys]
    assert sorted(values) == pytest.approx(sorted(v for v in figure.panels[0].value if v is not None), rel=1e-3)


def test_nothing_is_shown_where_no_line_differs(result: ComparisonResult) -> None:
    same = [e.model_copy(update={"header": (line("operator", "TH"),)}) for e in result.experiments]
    alike = result.model_copy(update={"experiments": tuple(same)})
    assert trend_table(alike) is None
    assert trend_figures(alike.experiments, "translation") == ()
    assert "trend" not in report.render(replace(report_data(), result=alike, figures=())).partition("<script")[0]
