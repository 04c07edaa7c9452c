"""Tables of optimal points by theory and experiment in the form of Tables D.1 to D.6."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial

from pipeline.rendering.labels import (
    Units,
    condition_label,
    cost_text,
    criterion_label,
    criterion_name,
    percent_text,
    significant,
    table_label,
)
from pipeline.rendering.table import Column, Row, Table, is_sweep, table_of
from pipeline.rendering.tables.formats import (
    censored_note,
    digits,
    show_by,
    show_cost,
    show_damping,
    show_percent,
    show_published,
    show_published_cost,
    show_stiffness,
)

PARTS = (
    "Parts of the deviation: the product of their factors (1 + x/100) gives the whole. Range: theory's optimum lies "
    "outside the tested range. Grid: it lies between the tested walls. Model (95 %): measured against theory on the "
    "tested walls, without the scatter of single trials. Selection: the best of many trials is lucky."
)


PRINTED = "a row of theory, or no printed measurement"


def optima_tables(rows: Sequence[Row], units: Units, place: Callable[[Row], str]) -> dict[str, list[Table]]:
    """Return tables like D.1 to D.5, and tables over delay like D.6."""
    found: dict[str, list[Table]] = {"optima": [], "delay_tables": []}
    for name in dict.fromkeys(row["table"] for row in rows):
        own = [dict(row) for row in rows if row["table"] == name]
        swept = is_sweep(own)
        for row, after in zip(own, [*own[1:], own[-1]], strict=True):
            # over delay, each experiment follows its theory
            row |= {"reason": row["note"], "raw": row["condition"], "of": row["experiment"] or after["experiment"]}
            row["condition"] = condition_label(row["condition"])
            if row["delay_samples"] is not None and (swept or not row["condition"].startswith("theory")):
                row["condition"] += f" (d = {significant(row['delay_samples'], 3)})"
        here = "this report" if any(row["published_cost"] is not None for row in own) else ""
        columns = (
            Column("condition", notes=lambda row: [row["note"], *censored_note(row)]),
            Column(
                "stiffness", "stiffness K", units.stiffness, here, show_stiffness, aside=_off("stiffness"), linked=True
            ),
            Column("damping", "damping B", units.damping, here, show_damping, aside=_off("damping"), linked=True),
            Column("cost", "", "", here, show_cost, linked=True),
            Column(
                "deviation_percent",
                "deviation of the cost",
                "%",
                here,
                show_percent,
                aside=_parts,
                notes=_has_parts,
                why="no theory, or the cost of theory is zero",
                optional=True,
            ),
            Column("published_stiffness", "K", "", "published", show_published, why="not published", optional=True),
            Column("published_damping", "B", "", "published", show_published, why="not published", optional=True),
            Column("published_cost", "cost", "", "published", show_published_cost, why="not published", optional=True),
            Column(
                "published_deviation_percent", "deviation", "%", "published", show_percent, why=PRINTED, optional=True
            ),
        )
        criteria = "; ".join(dict.fromkeys(criterion_name(row["criterion"]) for row in own))
        label = table_label(name)
        what = "Optimal costs over total delay" if swept else f"Optimal points: {criteria}"
        caption = f"{label[:1].upper()}{label[1:]}. {what}"
        order = list(dict.fromkeys(row["criterion"] for row in own))
        own.sort(key=lambda row: order.index(row["criterion"]))
        table = table_of(
            name or "optima-theory",
            caption,
            columns,
            own,
            _named(own),
            lambda row: criterion_label(row["criterion"]),
            place,
        )
        if table is not None:
            table.mark(*_theory_notes(own, units, swept=swept))
        found["delay_tables" if swept else "optima"] += [table] if table else []
    return found


def _theory_notes(rows: Sequence[Row], units: Units, *, swept: bool) -> list[str]:
    """Return with which mass, damping and delay the rows of theory were computed, once for each device."""
    notes = []
    for row in rows:
        if row["theory_mass"] is None or row["delay_samples"] is None:
            continue
        m, b = significant(row["theory_mass"], 3), significant(row["theory_damping"], 3)
        delay = "the delay d of the row" if swept else f"d = {significant(row['delay_samples'], 3)}"
        source = row["theory_source"]
        notes.append(f"Theory: m = {m} {units.mass}, b = {b} {units.damping}, {delay} ({source}).")
    return list(dict.fromkeys(notes))


def delay_form_table(rows: Sequence[Row]) -> Table | None:
    """Return costs over delay in the form of Table D.6.

    There is one row for each delay, with theory, experiment and deviation side by side.
    """
    swept = next(
        (n for n in dict.fromkeys(r["table"] for r in rows) if is_sweep([r for r in rows if r["table"] == n])), None
    )
    own = [row for row in rows if row["table"] == swept and row["delay_samples"] is not None]
    if swept is None or not own:
        return None
    criteria = list(dict.fromkeys(row["criterion"] for row in own))
    lines: dict[float, Row] = {}
    for row in own:
        line = lines.setdefault(row["delay_samples"], {"delay": row["delay_samples"]})
        side = "theory" if row["condition"] == "theory_discrete" else "experiment"
        line[f"{row['criterion']}/{side}"] = row["cost"]
        if side == "experiment":
            line[f"{row['criterion']}/deviation"] = row["deviation_percent"]
    columns = [Column("delay", "d", "samples", show=digits(3))]
    for name in criteria:
        show, group = show_by(partial(cost_text, name)), criterion_label(name)
        columns += [Column(f"{name}/{side}", side, "", group, show, why="no cost") for side in ("theory", "experiment")]
        columns.append(Column(f"{name}/deviation", "deviation", "%", group, show_percent, why="no theory or no cost"))
    caption = f"{table_label(swept)}: optimal costs of the sampled response over total delay"
    ordered = [lines[delay] for delay in sorted(lines)]
    return table_of(
        "delay_form", caption[:1].upper() + caption[1:], columns, ordered, lambda row: f"d={row['delay']:g}"
    )


def _named(rows: Sequence[Row]) -> Callable[[Row], str]:
    """Return the function that names rows.

    A name consists of criterion and condition. Delay and experiment are added if these are not unique.
    """

    def names(row: Row) -> list[str]:
        delay = "" if row["delay_samples"] is None else f"/d={significant(row['delay_samples'], 3)}"
        plain = f"{row['criterion']}/{row['raw']}"
        return [plain, plain + delay, f"{plain}{delay}/{row['of']}"] if delay else [plain, f"{plain}/{row['of']}"]

    counts = Counter(name for row in rows for name in set(names(row)))
    return lambda row: next((name for name in names(row) if counts[name] == 1), names(row)[0])


def _off(axis: str) -> Callable[[Row], str]:
    """Return the deviation of an optimum from that of theory along an axis as text.

    It is empty if there is no deviation.
    """
    name = f"{axis}_deviation_percent"
    return lambda row: "" if row.get(name) is None else f"{percent_text(row[name], 0)} %"


def _parts(row: Row) -> str:
    """Return the parts of a deviation in one line.

    Parts that print as zero are left out, except the part of the model.
    """
    if row["model"] is None:
        return ""
    nothing, low, high = (percent_text(value) for value in (0.0, row["model_low"], row["model_high"]))
    interval = "" if low == high == nothing else f" ({low} to {high})"
    others = {name: percent_text(row[name]) for name in ("range", "grid", "selection")}
    parts = [f"{name} {text}" for name, text in others.items() if text != nothing]
    return ", ".join([f"model {percent_text(row['model'])}{interval}", *parts])


def _has_parts(row: Row) -> list[str | None]:
    return [None if row["model"] is None else PARTS]
