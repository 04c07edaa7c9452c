"""Limits and estimates of a device over its experiments, in the order of a date in their header lines."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from pipeline.records.figure_records import Figure, TrendPanel
from pipeline.records.models import Motion
from pipeline.records.results import ExperimentResult
from pipeline.rendering.labels import UNITS
from pipeline.rendering.report.report_estimates import MAIN, quantity_name, unit_text
from pipeline.rendering.report.report_trend import (
    differing_lines,
    in_order,
    leading_line,
    limit_of,
    line_text,
    stiffest,
)


def trend_figures(results: Sequence[ExperimentResult], motion: Motion) -> tuple[Figure[TrendPanel], ...]:
    """Return the figure of limits and estimates over experiments, none where no header line differs between them."""
    keys = differing_lines(results)
    if not keys:
        return ()
    ordered = in_order(results)
    panels = tuple(panel for panel in _panels(ordered, motion) if any(value is not None for value in panel.value))
    others = f", one of {len(keys)} that differ" if len(keys) > 1 else ""
    told = f"Below each its header line “{leading_line(results)}”{others}."
    return (
        Figure(
            "trend",
            "trend",
            "Limits and estimates over the experiments",
            f"Values with their 95 % intervals, one experiment beside the other. {told} Open marks: the tested range "
            "ended before an unstable trial.",
            panels,
        ),
    )


def _panels(ordered: Sequence[ExperimentResult], motion: Motion) -> Iterator[TrendPanel]:
    key = leading_line(ordered)
    names = tuple((each.experiment, line_text(each, key)) for each in ordered)
    points = [stiffest(each) for each in ordered]
    yield TrendPanel(
        f"stiffest limit [{UNITS[motion].stiffness}]",
        names,
        value=tuple(limit_of(p) for p in points),
        low=tuple(p.low if p else None for p in points),
        high=tuple(p.high if p else None for p in points),
        bound=tuple(bool(p and p.censored) for p in points),
    )
    for quantity in MAIN:
        found = [each.estimates.get(quantity) for each in ordered]
        unit = next((unit_text(each.unit) for each in found if each), "")
        label = f"{quantity_name(quantity)} [{unit}]" if unit else quantity_name(quantity)
        yield TrendPanel(
            label,
            names,
            value=tuple(each.value if each else None for each in found),
            low=tuple(each.low if each else None for each in found),
            high=tuple(each.high if each else None for each in found),
            bound=(False,) * len(ordered),
        )
