"""Tables of optimal points by theory and experiment in the form of Tables D.1 to D.6."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from statistics import median

from pipeline.records.results import ComparisonResult, ExperimentNumbers
from pipeline.rendering.labels import (
    UNITS,
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
from pipeline.rendering.tables.boundary_tables import experiments_text
from pipeline.rendering.tables.formats import (
    censored_note,
    digits,
    show_at_least,
    show_by,
    show_cost,
    show_damping,
    show_percent,
    show_published,
    show_published_cost,
    show_stiffness,
)

PARTS = (
    "Parts of the deviation. The product of their factors (1 + x/100) gives the whole. Range: theory's optimum is "
    "outside the tested range. Grid: it is between tested walls. Model (95 %): measured cost relative to theory at "
    "tested walls, without scatter. Selection: cost of the best trial relative to the trials around it, which is "
    "negative if the best trial is lucky."
)


TESTED_WALLS = (
    "Walls: cost of theory at the best tested wall, relative to its optimum between or beyond the tested walls. This "
    "part of a deviation is due to the choice of the walls, and is no error of theory."
)

_SIDES = {"theory_discrete": "theory", "theory_damped": "damped"}
"""Columns of the form of Table D.6, by condition. Other conditions are experiments."""

PRINTED = "a row of theory, or no printed measurement"


def optima_tables(
    rows: Sequence[Row], result: ComparisonResult, units: Units, place: Callable[[Row], str]
) -> dict[str, list[Table]]:
    """Return tables like D.1 to D.5, and tables over delay like D.6."""
    found: dict[str, list[Table]] = {"optima": [], "delay_tables": []}
    for name in dict.fromkeys(row["table"] for row in rows):
        own = [dict(row) for row in rows if row["table"] == name]
        swept = is_sweep(own)
        for place_of_row, row in enumerate(own):
            # over delay, each experiment follows its theory
            experiment = next((after["experiment"] for after in own[place_of_row:] if after["experiment"]), None)
            row |= {"reason": row["note"], "raw": row["condition"], "of": experiment}
            row |= {"margin": None} if swept else {}  # a table over delay has no room for it
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
            Column("margin", "limit over K", "", here, _show_margin, why="no limit is known there", optional=True),
            Column("cost", "", "", here, show_cost, linked=True),
            Column(
                "deviation_percent",
                "deviation of the cost",
                "%",
                here,
                show_percent,
                aside=_parts,
                notes=_has_parts,
                why="there is no theoretical cost, or it is zero",
                optional=True,
            ),
            Column(
                "own_deviation_percent",
                "from its own theory",
                "%",
                here,
                show_percent,
                why="the theory of the table is that of the experiment, or its cost is zero",
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
        what = "Walls behind the costs over total delay" if swept else f"Optimal points: {criteria}"
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
            table.mark(*damping_notes(own, result, swept=swept), None if swept else closeness_note(own))
        found["delay_tables" if swept else "optima"] += [table] if table else []
    return found


def _theory_notes(rows: Sequence[Row], units: Units, *, swept: bool) -> list[str]:
    """State the mass, damping and delay with which the rows of theory were computed, once for each device."""
    notes = []
    for row in rows:
        if row["theory_mass"] is None or row["delay_samples"] is None:
            continue
        m, b = significant(row["theory_mass"], 3), significant(row["theory_damping"], 3)
        delay = "the delay d of the row" if swept else f"d = {significant(row['delay_samples'], 3)}"
        experiment = row["raw"].partition("theory_of_")[2]
        whose = f"Theory of experiment {experiment}" if experiment else "Theory"
        notes.append(f"{whose}: m = {m} {units.mass}, b = {b} {units.damping}, {delay} ({row['theory_source']}).")
    return list(dict.fromkeys(notes))


def _show_margin(value: float, row: Row) -> str:
    """Return the limit over the stiffness of a wall. For a trial, it is a lower bound."""
    return significant(value, 3) if row["raw"].startswith("theory") else show_at_least(value, row)


def damping_notes(rows: Sequence[Row], result: ComparisonResult, *, swept: bool) -> list[str]:
    """Describe in sentences how the measured damping changes the deviations of a table.

    The list is empty if theory does not use a device file.

    Parameters
    ----------
    rows : sequence of Row
        Rows of one table in its order, with their condition as ``raw``.
    result : ComparisonResult
    swept : bool
        Whether the table is over delay. Deviations are then summarised by their median size.
    """
    theory = next((row for row in rows if row["raw"] == "theory_discrete"), None)
    if theory is None or not result.known_device:
        return []
    damped = {(row["criterion"], row["delay_samples"]): row for row in rows if row["raw"] == "theory_damped"}
    here = {row["experiment"] for row in rows}
    leaders = [e for e in result.experiments if e.experiment in here and _leads(e, theory)]
    if not damped:
        known = [e.estimates["damping"] for e in leaders if "damping" in e.estimates]
        if not known:
            return []
        if any(each.low is None or each.high is None for each in known):
            return ["The logs do not determine the damping, so its contribution to these deviations is unknown."]
        names = experiments_text([e.experiment for e in leaders], len(result.experiments))
        words = "the damping of the logs agrees with the stated one, so it explains none of these deviations"
        return [f"{names}: {words}."]
    changes = "" if swept else _damping_change(theory, next(iter(damped.values())), UNITS[result.motion].damping)
    texts = {
        name: _changed_deviations([row for row in rows if row["criterion"] == name], damped, swept=swept)
        for name in dict.fromkeys(row["criterion"] for row in rows)
    }
    parts = [f"{criterion_name(name)} {text}" for name, text in texts.items() if text]
    return [f"Deviations of the cost with the damping of the logs{changes}: {'; '.join(parts)}."] if parts else []


def _damping_change(theory: Row, damped: Row, unit: str) -> str:
    """Return the measured and the stated damping of theory in brackets."""
    found, stated = (significant(row["theory_damping"], 3) for row in (damped, theory))
    return f" (b = {found} instead of {stated} {unit})"


def _changed_deviations(rows: Sequence[Row], damped: Mapping[tuple[str, float | None], Row], *, swept: bool) -> str:
    """Return the deviations of one criterion from theory with the measured and with the stated damping, as text.

    The text is empty if there is no such deviation.
    """
    pairs = [
        (row, 100 * (row["cost"] / other["cost"] - 1))
        for row in rows
        if row["deviation_percent"] is not None
        if (other := _damped_row(damped, row, swept=swept)) is not None and other["cost"]
    ]
    if not pairs:
        return ""
    if swept:
        before = median(abs(row["deviation_percent"]) for row, _ in pairs)
        after = median(abs(percent) for _, percent in pairs)
        return f"{significant(after, 2)} % instead of {significant(before, 2)} % (median size)"
    return ", ".join(
        f"{percent_text(percent)} % instead of {percent_text(row['deviation_percent'])} % "
        f"(experiment {row['experiment']})"
        for row, percent in pairs
    )


def _leads(result: ExperimentNumbers, theory: Row) -> bool:
    """Return whether a row of theory has the mass and damping of the device file for an experiment."""
    if result.theory is None:
        return False
    loop = result.theory.loop.apparent()
    return (loop.mass, loop.damping) == (theory["theory_mass"], theory["theory_damping"])


def _damped_row(damped: Mapping[tuple[str, float | None], Row], row: Row, *, swept: bool) -> Row | None:
    """Return the row of theory with the measured damping for a measured row, or None."""
    if swept:
        return damped.get((row["criterion"], row["delay_samples"]))
    return next((each for (criterion, _), each in damped.items() if criterion == row["criterion"]), None)


def closeness_note(rows: Sequence[Row]) -> str | None:
    """State the number of optima of the logs that lie closer to the stability limit than those of theory (6.2.4).

    The note is None if no limit is known.
    """
    counts = {}
    for condition, words in (("theory_discrete", "theory"), ("theory_damped", "theory with the measured damping")):
        of_theory = {row["criterion"]: row["margin"] for row in rows if row["raw"] == condition}
        pairs = [
            (row["margin"], of_theory[row["criterion"]])
            for row in rows
            if not row["raw"].startswith("theory") and row["margin"] is not None and of_theory.get(row["criterion"])
        ]
        if pairs:
            counts[words] = sum(measured < theory for measured, theory in pairs), len(pairs)
    if not counts:
        return None
    if not any(closer for closer, _ in counts.values()):
        return (
            f"By the limit over K, no optimum of the logs lies closer to the limit than that of {' or '.join(counts)}."
        )
    parts = [f"{closer} of {of} may lie closer to it than that of {words}" for words, (closer, of) in counts.items()]
    return f"Optima of the logs and the limit, by the limit over K: {', '.join(parts)}."


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
        side = _SIDES.get(row["condition"], "experiment")
        line[f"{row['criterion']}/{side}"] = row["cost"]
        if side == "experiment":
            line[f"{row['criterion']}/deviation"] = row["deviation_percent"]
            line[f"{row['criterion']}/tested"] = _tested_percent(row)
    columns = [Column("delay", "d", "samples", show=digits(3))]
    for name in criteria:
        show, group = show_by(partial(cost_text, name)), criterion_label(name)
        columns += [Column(f"{name}/{side}", side, "", group, show, why="no cost") for side in ("theory", "experiment")]
        columns.insert(
            -1,
            Column(f"{name}/damped", "with measured damping", "", group, show, why="no other damping", optional=True),
        )
        why, aside = "no theoretical prediction or no cost", partial(_tested_text, name)
        columns.append(Column(f"{name}/deviation", "deviation", "%", group, show_percent, aside=aside, why=why))
    caption = f"{table_label(swept)}: optimal costs of the sampled response over total delay"
    ordered = [lines[delay] for delay in sorted(lines)]
    table = table_of(
        "delay_form", caption[:1].upper() + caption[1:], columns, ordered, lambda row: f"d={row['delay']:g}"
    )
    if table is not None and any(_tested_text(name, line) for name in criteria for line in ordered):
        table.mark(TESTED_WALLS)
    return table


def _tested_percent(row: Row) -> float | None:
    """Return the increase of the cost of theory due to the choice of tested walls alone, in percent. None if
    unknown."""
    if row["grid"] is None or row["range"] is None:
        return None
    return float(100 * ((1 + row["grid"] / 100) * (1 + row["range"] / 100) - 1))


def _tested_text(criterion: str, row: Row) -> str:
    """Return the part of a deviation that is due to the tested walls as text. It is empty if it prints as zero."""
    percent = row.get(f"{criterion}/tested")
    text = percent_text(percent) if percent is not None else ""
    return "" if text in ("", percent_text(0.0)) else f"walls {text}"


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
