"""Formats of cells, names of rows, and columns with intervals, which all tables of a report share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pipeline.rendering.labels import (
    at_least,
    cost_text,
    damping_text,
    interval_texts,
    percent_text,
    printed_scale,
    published_text,
    share_text,
    significant,
    stiffness_text,
)
from pipeline.rendering.table import Column, Row

CENSORED = "At the edge of the tested range (censored): the true value may lie outside."
RANGE_ENDED = "The tested range ended before an unstable trial."


def show_by(show: Callable[[Any], str]) -> Callable[[Any, Row], str]:
    """Return a function that prints a cell by a function of its value."""
    return lambda value, _: show(value)


def digits(count: int) -> Callable[[Any, Row], str]:
    """Return a function that prints a cell with ``count`` significant digits."""
    return lambda value, _: significant(value, count)


show_text, show_number, show_percent = show_by(str), show_by("{:.0f}".format), show_by(percent_text)
show_share, show_stiffness, show_damping = show_by(share_text), show_by(stiffness_text), show_by(damping_text)
show_published, show_percent_of_share = show_by(published_text), show_by(lambda share: percent_text(100 * share))


def show_at_least(value: float, _: Row) -> str:
    """Return a lower bound, with as many digits as `NARROW`."""
    return f"≥ {at_least(value, 3)}"


def show_yes_or_no(value: bool, _: Row) -> str:
    """Return a word that states whether a statement is true."""
    return "yes" if value else "no"


def show_cost(value: float, row: Row) -> str:
    """Return a cost as printed in Tables D.1 to D.6."""
    return cost_text(row["criterion"], value)


def show_published_cost(value: float, row: Row) -> str:
    """Return a published cost with exactly the published digits."""
    return published_text(value * printed_scale(row["criterion"]))


def experiment_block(row: Row) -> str:
    """Return the heading of the rows of an experiment."""
    return f"experiment {row['experiment']}"


def experiment_row(row: Row) -> str:
    """Return the name of the only row of an experiment."""
    return str(row["experiment"])


def row_within_experiment(what: str) -> Callable[[Row], str]:
    """Return the function that names the rows of an experiment by a column."""
    return lambda row: f"{row['experiment']}/{row[what]}"


def interval_ends(name: str) -> tuple[str, str]:
    """Return the columns with the ends of the interval of a column."""
    return f"{name}_low", f"{name}_high"


def interval_column(
    name: str, label: str = "", unit: str = "", ends: tuple[str, str] | None = None, **others: Any
) -> Column:
    """Return a column of numbers with intervals. Each number has as many digits as its interval justifies."""
    low, high = ends or interval_ends(name)

    def texts(row: Row) -> tuple[str, str, str]:
        return interval_texts(row[name], row.get(low), row.get(high))

    def beside(row: Row) -> str:
        return "" if row.get(name) is None or row.get(low) is None else " to ".join(texts(row)[1:])

    return Column(name, label, unit, show=lambda _, row: texts(row)[0], aside=beside, **others)


def ratio_text(row: Row, first: str, second: str) -> str:
    """Return two numbers as ``first : second``. The text is empty if they are missing."""
    return "" if row.get(first) is None else f"{row[first]:.0f} : {row[second]:.0f}"


def censored_note(row: Row) -> list[str | None]:
    """Return the note on a value at the edge of the tested range."""
    return [CENSORED if row.get("censored") else None]


def range_end_note(row: Row) -> list[str | None]:
    """Return the note on a lower bound."""
    return [RANGE_ENDED if row["bound"] else None]
