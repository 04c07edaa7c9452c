"""Tables of measured costs: trials with the least cost, recommended walls, and design rules."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from pipeline.records.findings import NARROW, Optimum
from pipeline.records.results import ComparisonResult, ExperimentResult
from pipeline.rendering.frames import flat
from pipeline.rendering.labels import (
    UNITS,
    Units,
    at_least,
    criterion_label,
    damping_range_text,
    damping_text,
    overshoot_note,
    printed_scale,
    range_text,
    significant,
    stiffness_text,
)
from pipeline.rendering.table import Column, Row, Table, table_of
from pipeline.rendering.tables.formats import (
    censored_note,
    digits,
    experiment_block,
    experiment_row,
    row_within_experiment,
    show_at_least,
    show_by,
    show_cost,
    show_damping,
    show_number,
    show_stiffness,
    show_text,
    show_yes_or_no,
)
from pipeline.theory.cases import continuous_rules

BORDER = "distance from the stability limit"
"""Head of the columns with the distance of a wall from the limit, in stiffness and in damping."""


NEAR_BORDER = (
    "Distances are lower bounds. They follow from the lower end of the limit at this damping, and from the dampings at "
    f"which this stiffness is stable. Close: the limit may be less than {NARROW} times away, so an error of a quarter "
    "in mass or delay can make the wall unstable."
)


def measured_optima_table(
    rows: Sequence[Row], result: ComparisonResult, units: Units, place: Callable[[Row], str]
) -> Table | None:
    """Return the trials with the least cost, with their distance from the limit."""
    best = {(e.experiment, name): found for e in result.experiments for name, found in e.optimum.items()}
    table = table_of(
        "optima",
        "Trials with the least cost",
        (
            Column("criterion_label", "criterion"),
            Column("stiffness", "stiffness", units.stiffness, show=show_stiffness, notes=censored_note, linked=True),
            Column("damping", "damping", units.damping, show=show_damping, linked=True),
            Column(
                "cost",
                "cost, 95 %",
                show=show_cost,
                ends=("cost_low", "cost_high"),
                linked=True,
                notes=lambda row: [overshoot_note(best[row["experiment"], row["criterion"]])],
            ),
            Column("ties", "equal trials", show=show_number),
            Column("trials", "trials with this cost", show=show_number),
            Column("near_stiffness", "stiffness", units.stiffness, "within 5 %", show=show_text),
            Column("near_damping", "damping", units.damping, "within 5 %", show=show_text),
            Column("margin", "limit over K", "", BORDER, show_at_least, why="no limit is known there"),
            Column(
                "damping_range_margin",
                "limit over B",
                "",
                BORDER,
                show_at_least,
                aside=lambda row: row["stable_dampings"],
                why="no limit is known there, or no damping",
            ),
            Column("at_border", "close to it", "", BORDER, show_yes_or_no, why="the tested dampings end too near"),
            Column("scatter_percent", "scatter of one trial", "%", show=digits(2), why="too few trials", optional=True),
            Column("passive", show=show_yes_or_no, why="needs an adequate loop", optional=True),
        ),
        [
            row
            | {"criterion_label": criterion_label(row["criterion"])}
            | {f"near_{axis}": _near(row, axis, show) for axis, show in _NEAR_TEXTS.items()}
            | _border(best[row["experiment"], row["criterion"]])
            for row in rows
            if row["cost"] is not None
        ],
        row_within_experiment("criterion"),
        experiment_block,
        place,
    )
    if table is not None:
        table.mark(NEAR_BORDER)
    return table


def _border(best: Optimum) -> Row:
    """Return at which dampings the stiffness of an optimum is stable, and whether it is close to the limit."""
    around = best.damping_range
    return {
        "stable_dampings": f"stable from {damping_range_text(around)}" if around else "",
        "at_border": best.at_border,
    }


_NEAR_TEXTS = {"stiffness": stiffness_text, "damping": damping_text}


def _near(row: Row, axis: str, show: Callable[[float], str]) -> str:
    """Return the range of walls that are nearly as good as an optimum.

    The text is empty for documents of earlier versions.
    """
    if row[f"near_{axis}_low"] is None:
        return ""
    return range_text(show, row[f"near_{axis}_low"], row[f"near_{axis}_high"])


def rules_table(result: ComparisonResult) -> Table | None:
    """Return the results of design rules for each experiment. They are dampings at the recommended stiffness, and the
    cost of delay.

    Source: Hulin 2017, eqs. 5.17 and 5.19, sec. 5.5.
    """
    units, rows = UNITS[result.motion], []
    for e in result.experiments:
        loop = e.theory.loop.apparent() if e.theory else None
        wall, best = e.use.point if e.use else None, e.answer.reachable if e.answer else None
        row: Row = {"experiment": e.experiment}
        if wall is not None:
            row |= {"K": wall.stiffness, "B": wall.damping}
        if loop is not None and wall is not None:
            rules = continuous_rules(loop.mass, loop.damping, loop.stiffness, wall.stiffness)
            row |= {"critical": rules[0], "amplitude": rules[1]}
        if best is not None:
            row |= {"best": best.best, "reached": best.reached, "per_sample": best.per_sample}
        rows.append(row)
    of_wall, of_delay = "wall to use, and damping by the rules for continuous time", "settling time (2 %) by the delay"
    columns = (
        Column("experiment"),
        Column("K", "K", units.stiffness, of_wall, show_stiffness, why="no wall is recommended"),
        Column("B", "B", units.damping, of_wall, show_damping, why="no wall is recommended"),
        Column("critical", "critical", units.damping, of_wall, show_damping, why="needs a wall and a loop"),
        Column("amplitude", "amplitude optimum", units.damping, of_wall, show_damping, why="needs a wall and a loop"),
        Column("best", "least", "samples", of_delay, digits(3), why="no delay is known"),
        Column("reached", "reached", "samples", of_delay, digits(3), why="no trial settled"),
        Column(
            "per_sample", "saved per sample of delay removed", "samples", of_delay, digits(2), why="no delay is known"
        ),
    )
    table = table_of("rules", "Design rules", columns, [row for row in rows if len(row) > 1], experiment_row)
    if table is not None:
        table.mark(
            "Critical damping and damping of the amplitude optimum (damping ratio 0.71) of a loop without delay and "
            "sampling, less the damping of the device (5.17). They are a guide only for stiffnesses well below the "
            "optimal one.",
            "Least settling time of a device without damping (5.19). Delay and sampling period together must stay "
            "below 20 % of the required settling time (5.5).",
        )
    return table


def use_table(result: ComparisonResult, place: Callable[[Row], str]) -> Table | None:
    """Return the walls to use of each experiment with the costs of the trials there."""
    units = UNITS[result.motion]
    names = [name for name in result.criteria if any(e.use and name in e.use.costs for e in result.experiments)]
    rows = []
    for e in result.experiments:
        row: Row = {"experiment": e.experiment, "reason": e.use_reason, "note": use_note(e)}
        if e.use is not None:
            row |= flat(e.use) | {"trial_id": e.use.point.trial_id}
            if stable := e.use.point.damping_range:
                row |= {"stable_dampings": f"stable from {damping_range_text(stable)}"}
            for name, cost in e.use.costs.items():
                row |= {name: cost.median, f"{name}_low": cost.low, f"{name}_high": cost.high}
        rows.append(row)
    around = "walls around it: costs in the median, from the least to the largest"

    def between(name: str, show: Callable[[float], str]) -> Callable[[Any, Row], str]:
        return lambda _, row: range_text(show, row[f"{name}_low"], row[f"{name}_high"])

    columns = (
        Column("experiment", notes=lambda row: [row["note"]]),
        Column("point_stiffness", "K", units.stiffness, "wall to set", show_stiffness, linked=True),
        Column("point_damping", "B", units.damping, "wall to set", show_damping, linked=True),
        Column("point_margin", "limit over K, at least", group="wall to set", show=show_by(at_least)),
        Column(
            "point_damping_range_margin",
            "limit over B, at least",
            group="wall to set",
            show=show_by(at_least),
            aside=lambda row: row.get("stable_dampings", ""),
            why="no limit is known there, or no damping",
        ),
        Column("stiffness_low", "K", units.stiffness, around, between("stiffness", stiffness_text)),
        Column("damping_low", "B", units.damping, around, between("damping", damping_text)),
        Column("trials", group=around, show=show_number),
        *(
            Column(name, criterion_label(name), "", around, _cost_of(name), (f"{name}_low", f"{name}_high"))
            for name in names
        ),
        Column("margin", "limit over K, at least", group=around, show=show_by(at_least)),
    )
    caption = "Recommended walls, and the good walls around them"
    return table_of("use", caption, columns, rows if names else [], experiment_row, trial=place)


def _cost_of(criterion: str) -> Callable[[Any, Row], str]:
    return lambda value, _: significant(value * printed_scale(criterion), 3)


def use_note(result: ExperimentResult) -> str:
    """Return the reason why the costs of a region did not select the walls to use, or why there are none.

    The text is otherwise empty.
    """
    if not result.use_reason:
        return ""
    return f"{'Chosen by' if result.use else 'None:'} {result.use_reason}."
