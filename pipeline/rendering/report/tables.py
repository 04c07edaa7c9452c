"""Define the tables of a report by source frame, order of columns, formatting, and reasons for empty cells."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from pipeline.base.json_object import JsonObject
from pipeline.base.wording import counted
from pipeline.records.findings import DRIFTS, NARROW, Estimate, Optimum, holds
from pipeline.records.results import ComparisonResult, ExperimentResult, SourcedLoop, StraightBound
from pipeline.rendering.frames import flat, frames
from pipeline.rendering.labels import (
    MISSING,
    UNITS,
    Units,
    answer_texts,
    at_least,
    condition_label,
    cost_text,
    criterion_label,
    criterion_name,
    damping_range_text,
    damping_text,
    estimate_texts,
    interval_texts,
    overshoot_note,
    percent_text,
    printed_scale,
    published_text,
    quantity_name,
    range_text,
    share_text,
    significant,
    stiffness_text,
    table_label,
    unit_text,
)
from pipeline.rendering.table import Column, Row, Table, is_sweep, records, table_of
from pipeline.theory.cases import continuous_rules

MAIN = ("delay_samples", "mass", "damping")
"""Quantities in the table of experiments. The other quantities are only in the table of methods."""

CENSORED = "At the edge of the tested range (censored): the true value may lie outside."
UNDECIDED_BELOW = "A trial below it is undecided: look at it, or repeat it."
RANGE_ENDED = "The tested range ended before an unstable trial."
MISSED = "Outside the interval."
PARTS = (
    "Parts of the deviation: the product of their factors (1 + x/100) gives the whole. Range: theory's optimum lies "
    "outside the tested range. Grid: it lies between the tested walls. Model (95 %): measured against theory on the "
    "tested walls, without the scatter of single trials. Selection: the best of many trials is lucky."
)
PRINTED = "a row of theory, or no printed measurement"
DRIFT = "Drifts with the wall: one model does not explain all trials."
OUTCOMES = {
    "settled": "settled",
    "moving": "still moving",
    "limit_cycle": "limit cycle",
    "diverged": "diverged",
    "saturated": "saturated",
    "travel_limit": "hit a limit",
    "too_short": "too short",
    "disturbed": "disturbed",
    "no_step": "no step",
}


@dataclass(frozen=True)
class TrialPage:
    """Trials of all experiments of a report.

    Parameters
    ----------
    content : dict
        Input of the page's script as plain JSON values. The trials of each experiment are packed.
    trials, responses : int
        Number of trials, and number of trials with a response in the page.
    places : dict
        Map of ``(experiment, trial id)`` to the reference of the trial in the page.
    limits : dict
        Map of ``(experiment, damping, stiffness)`` to the reference of that boundary trial. The stiffness is that of
        the table of limits.
    """

    content: JsonObject
    trials: int
    responses: int
    places: dict[tuple[str, str], str] = field(default_factory=dict)
    limits: dict[tuple[str, float, float], str] = field(default_factory=dict)

    def place(self, experiment: str | None, trial_id: str | None) -> str:
        """Return the reference with which tables refer to a trial. It is empty if the page does not show the trial."""
        return self.places.get((experiment or "", trial_id or ""), "")


NO_TRIALS = TrialPage({}, 0, 0)
"""Trial page of a report without trials."""


def _by(show: Callable[[Any], str]) -> Callable[[Any, Row], str]:
    return lambda value, _: show(value)


def digits(count: int) -> Callable[[Any, Row], str]:
    """Return a function that prints a cell with ``count`` significant digits."""
    return lambda value, _: significant(value, count)


_text, _number, _percent = _by(str), _by("{:.0f}".format), _by(percent_text)
_share, _stiffness, _damping = _by(share_text), _by(stiffness_text), _by(damping_text)
_published, _of_share = _by(published_text), _by(lambda share: percent_text(100 * share))


def _at_least(value: float, _: Row) -> str:
    return f"≥ {at_least(value, 3)}"  # as many digits as NARROW


def _yes_or_no(value: bool, _: Row) -> str:
    return "yes" if value else "no"


def _cost(value: float, row: Row) -> str:
    return cost_text(row["criterion"], value)


def _published_cost(value: float, row: Row) -> str:
    return published_text(value * printed_scale(row["criterion"]))


def _of_experiment(row: Row) -> str:
    return f"experiment {row['experiment']}"


def _name(row: Row) -> str:
    return str(row["experiment"])


def _of_what(what: str) -> Callable[[Row], str]:
    return lambda row: f"{row['experiment']}/{row[what]}"


def tables_of(result: ComparisonResult, trials: TrialPage = NO_TRIALS) -> dict[str, list[Table]]:
    """Return the tables of a report by the names used in templates and scenes. A list is empty if there are no data."""
    f = {name: records(frame) for name, frame in frames(result).items()}
    units = UNITS[result.motion]
    place = _place(trials)
    made: dict[str, Table | None] = {
        "overview": _overview(result),
        "scores": _scores(result, units.stiffness),
        "experiments": _experiments(result),
        "measured_optima": _measured_optima(f["optima"], result, units, place),
        "boundary": _boundary(f["boundary"], units, trials),
        "methods": _methods(f["estimates"], result),
        "loops": _loops(result),
        "shapes": _shapes(result),
        **_of_logs(f),
        "rules": _rules(result),
        "outcomes": _outcomes(result),
        "truth": _truth(result),
        "use": _use(result, place),
        **_by_hand(f),
        "header": _header(result),
        "trend": table_of(
            "trend",
            "Limits and estimates with 95 % intervals over the experiments, with header lines that differ",
            (Column("line", "header lines"), interval_column("value", ends=("low", "high"), notes=_at_end)),
            f["trend"],
            lambda row: f"{row['quantity']}/{row['experiment']}",
            lambda row: f"{quantity_name(row['quantity'])} [{unit_text(row['unit'])}]",
        ),
    }
    made["delay_form"] = _delay_form(f["tables"])
    tables = {name: [table] if table else [] for name, table in made.items()}
    return tables | _optima(f["tables"], units, place)


BORDER = "distance from the stability limit"
"""Head of the columns that state how far a wall is from the limit, in stiffness and in damping."""

NEAR_BORDER = (
    "Distances are lower bounds: by the lower end of the limit at this damping, and by the dampings at which this "
    f"stiffness is stable. Close: the limit may be less than {NARROW} times away, so that an error of a quarter in "
    "mass or delay can make the wall unstable."
)


def _measured_optima(
    rows: Sequence[Row], result: ComparisonResult, units: Units, place: Callable[[Row], str]
) -> Table | None:
    best = {(e.experiment, name): found for e in result.experiments for name, found in e.optimum.items()}
    table = table_of(
        "optima",
        "Trials with the least cost",
        (
            Column("criterion_label", "criterion"),
            Column("stiffness", "stiffness", units.stiffness, show=_stiffness, notes=_at_edge, linked=True),
            Column("damping", "damping", units.damping, show=_damping, linked=True),
            Column(
                "cost",
                "cost, 95 %",
                show=_cost,
                ends=("cost_low", "cost_high"),
                linked=True,
                notes=lambda row: [overshoot_note(best[row["experiment"], row["criterion"]])],
            ),
            Column("ties", "equal trials", show=_number),
            Column("trials", "trials with this cost", show=_number),
            Column("near_stiffness", "stiffness", units.stiffness, "within 5 %", show=_text),
            Column("near_damping", "damping", units.damping, "within 5 %", show=_text),
            Column("margin", "limit over K", "", BORDER, _at_least, why="no limit is known there"),
            Column(
                "damping_range_margin",
                "limit over B",
                "",
                BORDER,
                _at_least,
                aside=lambda row: row["stable_dampings"],
                why="no limit is known there, or no damping",
            ),
            Column("at_border", "close to it", "", BORDER, _yes_or_no, why="the tested dampings end too near"),
            Column("scatter_percent", "scatter of one trial", "%", show=digits(2), why="too few trials", optional=True),
            Column("passive", show=_yes_or_no, why="needs an adequate loop", optional=True),
        ),
        [
            row
            | {"criterion_label": criterion_label(row["criterion"])}
            | {f"near_{axis}": _near(row, axis, show) for axis, show in _NEAR_TEXTS.items()}
            | _border(best[row["experiment"], row["criterion"]])
            for row in rows
            if row["cost"] is not None
        ],
        _of_what("criterion"),
        _of_experiment,
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


def _of_logs(f: Mapping[str, list[Row]]) -> dict[str, Table | None]:
    """Return the tables of the devices identified from logs."""
    return {
        "causes": table_of(
            "causes",
            "What the logs show in addition to mass, damping and delay",
            (Column("code", "cause"), Column("sentence", "what it is"), Column("evidence")),
            [row | {"code": row["code"].replace("_", " ")} for row in f["causes"]],
            _of_what("code"),
            _of_experiment,
        ),
        "model": table_of(
            "model",
            "Logs that one device explains, and fit of its free runs to unseen logs",
            (
                Column("experiment"),
                Column("trials", show=_number),
                Column("explained", show=_number),
                Column("fit_percent", "fit of free runs", "%", "median", digits(3), why="no log could be replayed"),
            ),
            f["model"],
            _name,
        ),
    }


def _by_hand(f: Mapping[str, list[Row]]) -> dict[str, Table | None]:
    """Return the tables of missing results, excluded trials and notes."""
    return {
        "missing": table_of(
            "missing",
            "Missing results",
            (Column("experiment"), Column("result"), Column("reason")),
            [row | {"result": criterion_name(row["what"])} for row in f["missing"]],
            _of_what("what"),
        ),
        "excluded": table_of(
            "excluded",
            "Trials excluded by hand; no number uses them",
            (Column("experiment"), Column("trial_id", "trial"), Column("log"), Column("reason"), Column("since")),
            f["excluded"],
            lambda row: str(row["trial_id"]),
        ),
        "notes": table_of(
            "notes",
            "Notes and tags of the lab; no number uses them",
            (Column("trial_id", "trial"), Column("tags", why="no tag"), Column("text", "note", why="no text")),
            [row | {"trial_id": row["trial_id"] or "all"} for row in f["notes"]],
            _of_what("trial_id"),
            _of_experiment,
        ),
    }


GRADES = {"yes": "yes", "partly": "partly", "no": "no", "with_friction": "with friction", None: "not known"}
"""Words that state how well theory predicts a boundary or costs."""


def _overview(result: ComparisonResult) -> Table | None:
    """Return the differences between the answers on several experiments, with one row for each experiment.

    The result is None for one experiment.
    """
    units, rows = UNITS[result.motion], []
    for answer in [e.answer for e in result.experiments if e.answer is not None]:
        predicts, wall, step = answer.predicts, answer.wall, answer.next
        boundary = predicts.code if predicts.code == "with_friction" else predicts.boundary
        row: Row = {"experiment": answer.experiment, "boundary": GRADES[boundary]}
        row["costs"] = GRADES[predicts.optimal_costs]
        row |= {"wall_stiffness": wall and wall.stiffness, "wall_damping": wall and wall.damping}
        row |= {"next_stiffness": step and step.stiffness, "next_damping": step and step.damping}
        for found in answer.estimates:
            row |= {found.name: found.value, f"{found.name}_answer": found}
        rows.append(row)
    mass = "inertia J" if result.motion.startswith("rotation") else "mass m"
    columns = (
        Column("experiment"),
        Column("wall_stiffness", "K", units.stiffness, "wall to use", _stiffness, why="none is recommended"),
        Column("wall_damping", "B", units.damping, "wall to use", _damping, why="none is recommended"),
        Column("boundary", "boundary", group="theory predicts"),
        Column("costs", "costs", group="theory predicts"),
        *(
            Column(name, label, unit, show=_answered(name), aside=_within(name), notes=_notes_on(name), why=why)
            for name, label, unit, why in (
                ("stiffness_max", "largest stable K", units.stiffness, "no stable trial"),
                ("delay_samples", "delay d", "samples", "the logs do not determine it"),
                ("mass", mass, units.mass, "the logs do not determine it"),
            )
        ),
        Column("next_stiffness", "K", units.stiffness, "measure next", _stiffness, why="nothing is left to measure"),
        Column("next_damping", "B", units.damping, "measure next", _damping, why="nothing is left to measure"),
    )
    table = table_of("overview", "The answers about each experiment, with 95 % intervals", columns, rows, _name)
    return table if len(rows) > 1 else None


def _answered(name: str) -> Callable[[float, Row], str]:
    """Return a function that formats the value of an answer without its unit."""
    return lambda value, row: answer_texts(row[f"{name}_answer"])[0].partition(" ")[0]


def _notes_on(name: str) -> Callable[[Row], Iterator[str]]:
    """Return a function that yields the note on an answer: a largest limit may be exceeded beyond the tested range."""

    def notes(row: Row) -> Iterator[str]:
        found = row.get(f"{name}_answer")
        if found is not None and found.at_last_damping:
            yield "At the largest tested damping: beyond it, limits may be larger."

    return notes


def _within(name: str) -> Callable[[Row], str]:
    """Return a function that formats the interval of an answer as text. The text is empty if an end is missing."""

    def text(row: Row) -> str:
        found = row.get(f"{name}_answer")
        return "" if found is None or found.value is None else answer_texts(found)[1].replace(MISSING, "")

    return text


def _place(trials: TrialPage) -> Callable[[Row], str]:
    return lambda row: trials.place(row.get("experiment"), row.get("trial_id"))


def _at_edge(row: Row) -> list[str | None]:
    return [CENSORED if row.get("censored") else None]


def _at_end(row: Row) -> list[str | None]:
    return [RANGE_ENDED if row["bound"] else None]


def _scores(result: ComparisonResult, stiffness: str) -> Table | None:
    rows = []
    for e in result.experiments:
        for scores in e.scores:
            row = {"experiment": e.experiment, "reason": "; ".join(dict.fromkeys(scores.missing.values()))}
            for name in ("region", "distance", "verdicts", "stiffness", "damping"):
                found = getattr(scores, name)
                row |= {f"{name}_{key}": value for key, value in flat(found).items()} if found else {}
            rows.append(row)
    bases = {scores.basis for e in result.experiments for scores in e.scores}

    def at_largest(row: Row) -> str:
        return f"at B = {damping_text(row['distance_largest_damping'])}" if "distance_largest" in row else ""

    columns = (
        Column("experiment"),
        Column("region_overlap", "overlap of the regions", "%", show=_share, ends=_ends("region_overlap")),
        Column("region_covered", "stable part of theory's region", "%", show=_share, ends=_ends("region_covered")),
        interval_column("region_area_ratio", "area, measured : theory"),
        Column(
            "stiffness_deviation_percent",
            "largest stable K",
            "%",
            show=lambda value, row: ("≥ " if row["stiffness_lower_bound"] else "") + percent_text(value),
            aside=lambda row: _ratio(row, "stiffness_measured", "stiffness_theory"),
        ),
        Column(
            "damping_deviation_percent",
            "largest stable B",
            "%",
            show=lambda value, row: ("≥ " if row["damping_lower_bound"] else "") + percent_text(value),
            aside=lambda row: _ratio(row, "damping_measured", "damping_theory"),
        ),
        Column("distance_median", "distance of limits, median", "%", show=_of_share),
        Column("distance_largest", "largest", "%", show=_of_share, aside=at_largest),
        Column("distance_rms", "rms", stiffness, show=digits(3)),
        Column(
            "verdicts_agreement",
            "equal verdicts",
            "%",
            show=_share,
            aside=lambda row: _ratio(row, "verdicts_only_theory_stable", "verdicts_only_log_stable"),
        ),
    )
    basis = " and ".join(f"theory by the {basis}" for basis in sorted(bases))
    return table_of("scores", f"Measured against theory ({basis})", columns, rows, _name)


def _ends(name: str) -> tuple[str, str]:
    return f"{name}_low", f"{name}_high"


def interval_column(
    name: str, label: str = "", unit: str = "", ends: tuple[str, str] | None = None, **others: Any
) -> Column:
    """Return a column of numbers with intervals. Each number has as many digits as its interval justifies."""
    low, high = ends or _ends(name)

    def texts(row: Row) -> tuple[str, str, str]:
        return interval_texts(row[name], row.get(low), row.get(high))

    def beside(row: Row) -> str:
        return "" if row.get(name) is None or row.get(low) is None else " to ".join(texts(row)[1:])

    return Column(name, label, unit, show=lambda _, row: texts(row)[0], aside=beside, **others)


def _ratio(row: Row, first: str, second: str) -> str:
    return "" if row.get(first) is None else f"{row[first]:.0f} : {row[second]:.0f}"


THESIS = {"delay_samples": "first_change", "mass": "thesis_momentum_balance"}
"""Methods of the thesis whose estimates are shown next to those of the model."""


def _thesis_value(estimate: Estimate | None, method: str) -> float | None:
    """Return an estimate by a method of the thesis, or None if there is none."""
    found = None if estimate is None else estimate.by_method.get(method)
    return None if found is None else found.value


def _experiments(result: ComparisonResult) -> Table | None:
    verdicts = list(dict.fromkeys(v for e in result.experiments for v in e.verdicts))
    quantities = [q for q in MAIN if any(q in e.estimates for e in result.experiments)]
    unit_of = {q: e.estimates[q].unit for e in reversed(result.experiments) for q in e.estimates}
    rows = []
    for e in result.experiments:
        grip = f"{e.grip} grip" if e.grip != "none" else "no operator"
        row: Row = {v: e.verdicts.get(v, 0) for v in verdicts}
        row |= {"experiment": e.experiment, "trials": e.trials}
        row |= {"set-up": ", ".join(filter(None, [e.configuration, grip]))}
        row |= {"theory": _theory(e.theory, result), "source": e.theory.source if e.theory else ""}
        row |= {f"thesis_{name}": _thesis_value(e.estimates.get(name), method) for name, method in THESIS.items()}
        rows.append(row | e.estimates | {"delay_samples": e.delay})
    columns = [Column("experiment"), Column("set-up"), Column("trials", "all", group="trials", show=_number)]
    columns += [Column(v, group="trials", show=_number) for v in verdicts]
    columns += [estimate_column(q, unit_of[q], "estimated, with 95 % interval") for q in quantities]
    columns += [
        Column(
            f"thesis_{name}",
            quantity_name(name),
            unit_text(unit_of[name]),
            "by the thesis's methods (6.2 to 6.4)",
            show=digits(3),
            why="no trial allows it",
            optional=True,
        )
        for name in THESIS
        if name in quantities
    ]
    columns += [
        Column("theory", "theory uses", aside=lambda row: row["source"], optional=True, why="no parameters for theory")
    ]
    return table_of("experiments", "Experiments, verdicts on stability and estimated parameters", columns, rows, _name)


def estimate_column(quantity: str, unit: str, group: str = "") -> Column:
    """Return the column of an estimate and its interval, with warnings as notes. The rows contain the record."""

    def texts(row: Row) -> tuple[str, str, str]:
        return estimate_texts(row[quantity])

    def notes(row: Row) -> list[str | None]:
        found: Estimate | None = row.get(quantity)
        clauses = found.warning.split("; ") if found and found.warning else []
        drifts = any(clause.startswith(DRIFTS) for clause in clauses)
        # a value that may be zero is followed by its interval
        others = "; ".join(c.partition(" (95 % interval")[0] for c in clauses if not c.startswith(DRIFTS))
        return [found.reason if found else None, DRIFT if drifts else None, others]

    return Column(
        quantity,
        quantity_name(quantity),
        unit_text(unit),
        group,
        show=lambda _, row: texts(row)[0] or "–",
        aside=lambda row: (
            "" if row.get(quantity) is None or not texts(row)[1] else f"{texts(row)[1]} to {texts(row)[2]}"
        ),
        why="not asked for in this scene",
        notes=notes,
    )


def _theory(theory: SourcedLoop | None, result: ComparisonResult) -> str:
    if theory is None:
        return ""
    units, loop = UNITS[result.motion], theory.loop
    parts = [("m", loop.mass, f" {units.mass}"), ("b", loop.damping, f" {units.damping}")]
    parts += [("k", loop.stiffness, f" {units.stiffness}")] if loop.stiffness else []
    parts.append(("d", loop.delay_samples, ""))
    texts = (f"{symbol} = {significant(value, 3)}{unit}" for symbol, value, unit in parts)
    return ", ".join(text.replace(" ", "\N{NO-BREAK SPACE}") for text in texts)


def _optima(rows: Sequence[Row], units: Units, place: Callable[[Row], str]) -> dict[str, list[Table]]:
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
            Column("condition", notes=lambda row: [row["note"], *_at_edge(row)]),
            Column("stiffness", "stiffness K", units.stiffness, here, _stiffness, aside=_off("stiffness"), linked=True),
            Column("damping", "damping B", units.damping, here, _damping, aside=_off("damping"), linked=True),
            Column("cost", "", "", here, _cost, linked=True),
            Column(
                "deviation_percent",
                "deviation of the cost",
                "%",
                here,
                _percent,
                aside=_parts,
                notes=_has_parts,
                why="no theory, or the cost of theory is zero",
                optional=True,
            ),
            Column("published_stiffness", "K", "", "published", _published, why="not published", optional=True),
            Column("published_damping", "B", "", "published", _published, why="not published", optional=True),
            Column("published_cost", "cost", "", "published", _published_cost, why="not published", optional=True),
            Column("published_deviation_percent", "deviation", "%", "published", _percent, why=PRINTED, optional=True),
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


def _delay_form(rows: Sequence[Row]) -> Table | None:
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
        show, group = _by(partial(cost_text, name)), criterion_label(name)
        columns += [Column(f"{name}/{side}", side, "", group, show, why="no cost") for side in ("theory", "experiment")]
        columns.append(Column(f"{name}/deviation", "deviation", "%", group, _percent, why="no theory or no cost"))
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


def _boundary(rows: Sequence[Row], units: Any, trials: TrialPage) -> Table | None:
    def place(row: Row, name: str) -> str:
        return trials.limits.get((row["experiment"], row["damping"], row[name] or 0.0), "")

    def below(row: Row) -> list[str | None]:
        return [UNDECIDED_BELOW if row["undecided"] else None]

    def ended(row: Row) -> list[str | None]:
        return [RANGE_ENDED if row["censored"] else None]

    def limit(_: Any, row: Row) -> str:
        if row["stiffness"] is not None:
            return stiffness_text(row["stiffness"])
        return f"≥ {stiffness_text(row['low'])}" if row["low"] else f"≤ {stiffness_text(row['high'])}"

    def interval(row: Row) -> str:
        if None in (row["stiffness"], row["low"], row["high"]):
            return ""
        low, high = stiffness_text(row["low"]), stiffness_text(row["high"])
        return "" if low == high else f"{low} to {high}"

    caption = f"Largest stable and smallest unstable stiffness [{units.stiffness}] at each damping, and the limit by "
    caption += "the growth rates of the trials around it"
    if any(row["stiffness_large_motion"] is not None for row in rows):
        caption += "; with friction, both are valid only for this step: under a harder push, walls become unstable at "
        caption += "the linear limit"
    columns = (
        Column("damping", "damping", units.damping, show=_damping),
        Column("stable", show=_stiffness, why="no stable trial", notes=below, link=lambda row: place(row, "stable")),
        Column(
            "unstable", show=_stiffness, why="no unstable trial", notes=ended, link=lambda row: place(row, "unstable")
        ),
        Column("limit", "limit, 95 %", show=limit, aside=interval, why="the growth rates do not determine it"),
        Column("stiffness_large_motion", "harder push", show=_stiffness, why="no limit", optional=True),
        Column("truth", show=_stiffness, why="no truth", optional=True),
    )
    shown = [row | {"limit": row["stiffness"] or row["low"] or row["high"] or None} for row in map(dict, rows)]

    def name(row: Row) -> str:
        # random dampings may be equal when printed
        return f"{row['experiment']}/{row['damping']:.15g}"

    return table_of("boundary", caption, columns, shown, name, _of_experiment)


def _methods(rows: Sequence[Row], result: ComparisonResult) -> Table | None:
    found = {e.experiment: e.estimates for e in result.experiments}
    shown = []
    for row in map(dict, rows):
        best = found[row["experiment"]][row["quantity"]]
        if (best.value is None and not best.by_method) or (not row["recommended"] and row["method"] == best.method):
            continue
        one = best if row["recommended"] else best.by_method[row["method"]]
        texts = dict(zip(("value", "low", "high"), estimate_texts(one), strict=True))
        row |= {name: text or None for name, text in texts.items()} | {"left_out": len(one.outliers) + one.refused}
        outliers = ", ".join(one.outliers[:3]) + (" ..." if len(one.outliers) > 3 else "")
        remarks = [one.reason, one.warning]
        remarks += [f"{counted(len(one.outliers), 'outlier')}: {outliers}" if outliers else None]
        remarks += [f"{counted(one.refused, 'trial')} without an interval" if one.refused else None]
        row |= {"remark": "; ".join(filter(None, remarks)), "method": row["method"].replace("_", " ")}
        shown.append(row | {"used": f"{row['method']} (used)" if row["recommended"] else row["method"]})
    columns = (
        Column("used", "method"),
        *(Column(name, show=_text, why="the method gives none") for name in ("value", "low", "high")),
        Column("within", "one trial ±", show=digits(2), why="the method gives none"),
        Column("spread", show=digits(2), why="the method gives none"),
        Column("trials", "used", show=_number),
        Column("left_out", "left out", show=_number),
        Column("remark", why="no remark"),
    )
    return table_of(
        "methods",
        "Estimates by method, with 95 % intervals",
        columns,
        shown,
        lambda row: f"{row['experiment']}/{row['quantity']}/{row['used']}",
        lambda row: f"experiment {row['experiment']}: {quantity_name(row['quantity'])} [{unit_text(row['unit'])}]",
    )


def _loops(result: ComparisonResult) -> Table | None:
    """Return the loop of each experiment and whether it is adequate."""
    units = UNITS[result.motion]
    rows = []
    for e in result.experiments:
        if e.loop is None:
            continue
        row: Row = {"experiment": e.experiment, "adequate": "yes" if e.loop.adequate else "no"}
        row |= {"why": e.loop.reason, "source": e.loop.source}
        for name in ("delay_samples", "mass", "damping"):
            found = getattr(e.loop, name)
            row[name] = None if found is None else Estimate(**dict(found) | {"unit": ""})
        if e.replay is not None and e.replay.verdicts_same is not None:
            off = {"limits": e.replay.limits_off_percent, "settling times": e.replay.costs_off_percent}
            errors = [f"{name} within {percent:.2g} %" for name, percent in off.items() if percent is not None]
            errors += [] if e.replay.fit_percent is None else [f"motion to {e.replay.fit_percent:.3g} %"]
            right = f"{100 * e.replay.verdicts_same:.3g} % of {e.replay.trials} verdicts right"
            row["replay"] = ", ".join([right, *errors])
        if e.passive:
            K, B = e.passive.stiffness, e.passive.damping
            row["passive"] = f"K = {stiffness_text(K)} {units.stiffness}, B = {damping_text(B)} {units.damping}"
        rows.append(row | {"reason": e.passive_reason})
    columns = [Column("experiment"), Column("adequate", "adequate loop"), Column("why")]
    columns.append(Column("source", "parameters by"))
    parameters = {"delay_samples": "samples", "mass": units.mass, "damping": units.damping}
    columns += [estimate_column(name, unit) for name, unit in parameters.items()]
    columns += [
        Column("replay", "replay of unseen walls", why="no wall to replay"),
        Column("passive", "stiffest passive wall"),
    ]
    return table_of("loops", "Identified loops, with 95 % intervals", columns, rows, _name)


def _shapes(result: ComparisonResult) -> Table | None:
    """Return the implied delay and the fitted line of each measured boundary."""
    units, rows = UNITS[result.motion], []
    for e in result.experiments:
        delays, line = e.implied_delay, e.straight_bound
        if delays is None or (delays.origin.value is None and delays.whole.value is None and line is None):
            continue
        row: Row = {"experiment": e.experiment, "reason": delays.whole.reason}
        for name, each in (("logs", e.delay), ("origin", delays.origin), ("whole", delays.whole)):
            row |= {name: each.value, f"{name}_low": each.low, f"{name}_high": each.high}
        if line is not None:
            row |= {"slope": line.slope, "slope_low": line.slope_low, "slope_high": line.slope_high}
            sign = "+" if line.slope >= 0 else "\N{MINUS SIGN}"
            row["line"] = f"K = {stiffness_text(line.stiffness)} {sign} {significant(abs(line.slope), 3)} B"
            row["dampings"] = f"{line.damping_first:g} to {line.damping_last:g}"
            row |= {"curvature": line.curvature, "curvature_theory": line.curvature_theory, "shape": shape_words(line)}
            row |= {"curvature_low": line.curvature_low, "curvature_high": line.curvature_high}
            row["compared"] = _compared(line)
        rows.append(row)
    stiffest = "limits at or above the damping of the largest limit"
    few = f"fewer than four {stiffest}"
    curved = f"theory has a stable wall at fewer than four of the {stiffest}"
    columns = [Column("experiment")]
    for name, label in (("logs", "by the logs"), ("origin", "near the origin"), ("whole", "by all limits")):
        columns.append(interval_column(name, label, "samples", group="delay d"))
    columns += [
        Column("line", "line", group=stiffest, why=few),
        interval_column("slope", "slope", f"{units.stiffness} per {units.damping}", group=stiffest, why=few),
        Column("dampings", "dampings", units.damping, stiffest, why=few),
        interval_column("curvature", "curvature", f"{units.stiffness} per ({units.damping})²", group=stiffest, why=few),
        Column("curvature_theory", "of theory", group=stiffest, show=digits(3), why=curved),
        Column("shape", "shape", group=stiffest, why=few, aside=lambda row: row.get("compared", "")),
    ]
    table = table_of(
        "shapes", "Delay and line that the measured boundary implies, with 95 % intervals", columns, rows, _name
    )
    if table is not None:
        table.mark(
            "Pure delay with which an ideal loop of this mass and damping has these limits. A lag or a velocity filter "
            "makes it longer than the delay of the logs. Friction makes it shorter, as does jitter near the origin."
        )
    return table


def shape_words(line: StraightBound) -> str | None:
    """Return whether a measured boundary is straight, and whether theory's curvature is excluded, in words.

    The result is None if the curvature is unknown.
    """
    if line.is_straight is None:
        return None
    found = "straight" if line.is_straight else "curved"
    if line.excludes_theory is None:
        return f"{found}; no curvature of theory to compare"
    if line.excludes_theory:
        return f"{found}; theory's curvature is excluded"
    return "straight or curved as theory: not decided" if line.is_straight else "curved as theory"


def _compared(line: StraightBound) -> str:
    """Return up to which damping the curvatures are compared, if theory has no stable wall beyond. Otherwise empty."""
    if line.curvature_last is None or line.curvature_last >= line.damping_last:
        return ""
    return f"up to B = {line.curvature_last:g}: beyond it, theory has no stable wall"


def _rules(result: ComparisonResult) -> Table | None:
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
        Column("K", "K", units.stiffness, of_wall, _stiffness, why="no wall is recommended"),
        Column("B", "B", units.damping, of_wall, _damping, why="no wall is recommended"),
        Column("critical", "critical", units.damping, of_wall, _damping, why="needs a wall and a loop"),
        Column("amplitude", "amplitude optimum", units.damping, of_wall, _damping, why="needs a wall and a loop"),
        Column("best", "least", "samples", of_delay, digits(3), why="no delay is known"),
        Column("reached", "reached", "samples", of_delay, digits(3), why="no trial settled"),
        Column(
            "per_sample", "saved per sample of delay removed", "samples", of_delay, digits(2), why="no delay is known"
        ),
    )
    table = table_of("rules", "Design rules", columns, [row for row in rows if len(row) > 1], _name)
    if table is not None:
        table.mark(
            "Critical damping and damping of the amplitude optimum (damping ratio 0.71) of a loop without delay and "
            "sampling, less the damping of the device (5.17): a guide well below the optimal stiffness only.",
            "Least settling time of a device without damping (5.19). Delay and sampling period together must stay "
            "below 20 % of a wanted settling time (5.5).",
        )
    return table


def _outcomes(result: ComparisonResult) -> Table | None:
    shown = [name for name in OUTCOMES if any(e.outcomes.get(name) for e in result.experiments)]
    rows = [
        {"experiment": e.experiment, **{name: e.outcomes.get(name, 0) for name in shown}} for e in result.experiments
    ]
    columns = [Column("experiment"), *(Column(name, OUTCOMES[name], show=_number) for name in shown)]
    table = table_of("outcomes", "Number of trials by outcome", columns, rows if shown else [], _name)
    if table is not None and "settled" in shown:
        table.mark("Settled: stays within 2 % of x_0 + F_0/K. More logs come to rest, some of them elsewhere.")
    if table is not None and "disturbed" in shown:
        table.mark("Disturbed: a force of 5 % of the step or more acts in addition to command, mass and damping.")
    return table


def _truth(result: ComparisonResult) -> Table | None:
    """Return the truth of simulated experiments next to the estimates."""
    known = [e for e in result.experiments if e.truth and e.truth_held]
    rows = []
    for e in known:
        for name, one in e.estimates.items():
            if one.truth is None:
                continue
            _, low, high = estimate_texts(one)
            ends = one.low or 0.0, one.truth, one.high or 0.0
            outside = None not in (one.value, one.low, one.high) and not holds(*ends)
            row = {"experiment": e.experiment, "quantity": name, "truth": one.truth, "outside": outside}
            row |= {"interval": f"{low} to {high}" if low and high else ""}
            rows.append(row | {"name": f"{quantity_name(name)} [{unit_text(one.unit)}]"})
    reasons = [f"No limits: {e.truth.limit_reason}." for e in known if e.truth and e.truth.limit_reason]
    held = [e.truth_held for e in known if e.truth_held]
    total = sum(one.estimates + one.limits for one in held)
    kept = sum(one.estimates_held + one.limits_held for one in held)
    caption = f"True values of the simulation: {kept} of {total} 95 % intervals contain them, limits included"
    columns = (
        Column("name", "quantity"),
        Column("truth", show=digits(4), notes=lambda row: [MISSED if row["outside"] else None]),
        Column("interval", "95 %", show=_text, why="no interval"),
    )
    table = table_of("truth", caption, columns, rows, _of_what("quantity"), _of_experiment)
    if table is not None:
        table.mark(*reasons)
    return table


def _use(result: ComparisonResult, place: Callable[[Row], str]) -> Table | None:
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
        Column("point_stiffness", "K", units.stiffness, "wall to set", _stiffness, linked=True),
        Column("point_damping", "B", units.damping, "wall to set", _damping, linked=True),
        Column("point_margin", "limit over K, at least", group="wall to set", show=_by(at_least)),
        Column(
            "point_damping_range_margin",
            "limit over B, at least",
            group="wall to set",
            show=_by(at_least),
            aside=lambda row: row.get("stable_dampings", ""),
            why="no limit is known there, or no damping",
        ),
        Column("stiffness_low", "K", units.stiffness, around, between("stiffness", stiffness_text)),
        Column("damping_low", "B", units.damping, around, between("damping", damping_text)),
        Column("trials", group=around, show=_number),
        *(
            Column(name, criterion_label(name), "", around, _cost_of(name), (f"{name}_low", f"{name}_high"))
            for name in names
        ),
        Column("margin", "limit over K, at least", group=around, show=_by(at_least)),
    )
    caption = "Recommended walls, and the good walls around them"
    return table_of("use", caption, columns, rows if names else [], _name, trial=place)


def _cost_of(criterion: str) -> Callable[[Any, Row], str]:
    return lambda value, _: significant(value * printed_scale(criterion), 3)


def use_note(result: ExperimentResult) -> str:
    """Return why the costs of a region did not select the walls to use, or why there are none.

    The text is otherwise empty.
    """
    if not result.use_reason:
        return ""
    return f"{'Chosen by' if result.use else 'None:'} {result.use_reason}."


def _header(result: ComparisonResult) -> Table | None:
    rows = []
    for e in result.experiments:
        for line in e.header:
            texts = [f"{value or 'empty'} ({count})" for value, count in line.values.items()]
            texts += [f"{line.different - len(texts)} more"] if line.different > len(texts) else []
            about = {"experiment": e.experiment, "line": line.key, "trials": line.trials}
            rows.append(about | {"values": "; ".join(texts)})
    columns = (Column("line"), Column("trials", show=_number), Column("values", "values (trials)"))
    caption = "Other header lines of the logs; no number uses them"
    return table_of("header", caption, columns, rows, _of_what("line"), _of_experiment)
