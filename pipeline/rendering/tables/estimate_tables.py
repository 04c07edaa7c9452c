"""Tables of experiments, estimates and identified loops."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from pipeline.base.wording import counted
from pipeline.records.findings import Estimate, holds
from pipeline.records.results import ComparisonResult, MassDeviation, SourcedLoop
from pipeline.rendering.labels import (
    BEYOND,
    UNITS,
    damping_text,
    estimate_texts,
    percent_text,
    quantity_name,
    significant,
    span,
    stiffness_text,
    unit_text,
)
from pipeline.rendering.table import Column, Row, Table, table_of
from pipeline.rendering.tables.formats import (
    digits,
    experiment_block,
    experiment_row,
    row_within_experiment,
    show_number,
    show_text,
)

MAIN = ("delay_samples", "mass", "damping")
"""Quantities in the table of experiments. The other quantities are only in the table of methods."""


MISSED = "Outside the interval."


DRIFT = "The estimate drifts with the wall, so one model does not explain all trials."


THESIS = {"delay_samples": "first_change", "mass": "thesis_momentum_balance"}
"""Methods of the thesis whose estimates are shown next to those of the model."""


def _thesis_value(estimate: Estimate | None, method: str) -> float | None:
    """Return an estimate by a method of the thesis, or None if there is none."""
    found = None if estimate is None else estimate.by_method.get(method)
    return None if found is None else found.value


def experiments_table(result: ComparisonResult) -> Table | None:
    """Return the verdicts and main estimates of each experiment."""
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
        row |= {_STATED[mass.source]: mass.stated for mass in e.masses}
        row |= {f"{_STATED[mass.source]}_aside": _mass_deviation_text(mass) for mass in e.masses}
        rows.append(row | e.estimates | {"delay_samples": e.delay})
    columns = [Column("experiment"), Column("set-up"), Column("trials", "all", group="trials", show=show_number)]
    columns += [Column(v, group="trials", show=show_number) for v in verdicts]
    columns += [estimate_column(q, unit_of[q], "estimated, with 95 % interval") for q in quantities]
    columns += [
        Column(
            f"thesis_{name}",
            quantity_name(name),
            unit_text(unit_of[name]),
            "by the methods of the thesis (6.2 to 6.4)",
            show=digits(3),
            why="no trial allows it",
            optional=True,
        )
        for name in THESIS
        if name in quantities
    ]
    columns += [
        Column(
            name,
            source,
            unit_text(unit_of["mass"]),
            f"stated {quantity_name('mass')}, and deviation of the logs",
            show=digits(3),
            aside=_stated_aside(name),
            why="not stated",
            optional=True,
        )
        for source, name in _STATED.items()
        if "mass" in quantities
    ]
    columns += [
        Column("theory", "theory uses", aside=lambda row: row["source"], optional=True, why="no parameters for theory")
    ]
    table = table_of(
        "experiments", "Experiments, verdicts on stability and estimated parameters", columns, rows, experiment_row
    )
    if table is not None:
        table.mark(mass_note(result))
    return table


_STATED = {"device file": "stated_mass", "weighed": "weighed_mass"}
"""Columns of the stated masses, by their source."""


def _stated_aside(name: str) -> Callable[[Row], str]:
    return lambda row: row.get(f"{name}_aside") or ""


def _mass_deviation_text(mass: MassDeviation) -> str:
    """Return the deviations of the masses of the logs from a stated one, as text."""
    parts = []
    if mass.percent is not None:
        value, ends = percent_text(mass.percent), span(percent_text, mass.low, mass.high)
        interval = "" if mass.percent > BEYOND or ends in ("", f"{value} to {value}") else f" ({ends})"
        parts.append(f"logs {_percent_or_factor(mass.percent)}{interval}")
    if mass.momentum_percent is not None:
        parts.append(f"momentum {_percent_or_factor(mass.momentum_percent)}")
    return ", ".join(parts)


def _percent_or_factor(percent: float) -> str:
    """Return a deviation in percent, or as a factor if it is very large."""
    return f"{percent_text(percent)} %" if percent <= BEYOND else f"× {significant(1 + percent / 100, 3)}"


def mass_note(result: ComparisonResult) -> str | None:
    """Name the experiments in which the apparent mass of the logs differs from a stated mass (6.3).

    The note is None if no mass is stated, or if the logs give no interval.
    """
    known = [(e.experiment, mass) for e in result.experiments for mass in e.masses if mass.low is not None]
    if not known:
        return None
    parts = []
    for source, name in (("device file", "that of the device file"), ("weighed", "the weighed one")):
        masses = [mass for _, mass in known if mass.source == source]
        if different := sum(mass.differs for mass in masses):
            parts.append(f"from {name} in {different} of {counted(len(masses), 'experiment')}")
    if not parts:
        return "The apparent mass of the logs agrees with each stated mass, within its interval."
    return (
        f"The apparent mass of the logs differs {' and '.join(parts)}, by more than its interval. It includes the "
        "force per command and the controllers of the drive, and is the one that theory needs (6.3)."
    )


def estimate_column(quantity: str, unit: str, group: str = "") -> Column:
    """Return the column of an estimate and its interval, with warnings as notes. The rows contain the record."""

    def texts(row: Row) -> tuple[str, str, str]:
        return estimate_texts(row[quantity])

    def notes(row: Row) -> list[str | None]:
        found: Estimate | None = row.get(quantity)
        doubts = found.doubts if found else ()
        drifts = any(doubt.code == "drift" for doubt in doubts)
        # a value that may be zero is followed by its interval
        others = "; ".join(doubt.text.partition(" (95 % interval")[0] for doubt in doubts if doubt.code != "drift")
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
        why="not requested in this scene",
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


def methods_table(rows: Sequence[Row], result: ComparisonResult) -> Table | None:
    """Return all estimates by their methods."""
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
        *(Column(name, show=show_text, why="the method gives none") for name in ("value", "low", "high")),
        Column("within", "one trial ±", show=digits(2), why="the method gives none"),
        Column("spread", show=digits(2), why="the method gives none"),
        Column("trials", "used", show=show_number),
        Column("left_out", "left out", show=show_number),
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


def loops_table(result: ComparisonResult) -> Table | None:
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
    return table_of("loops", "Identified loops, with 95 % intervals", columns, rows, experiment_row)


def truth_table(result: ComparisonResult) -> Table | None:
    """Return the true values of simulated experiments next to the estimates."""
    known = [e for e in result.experiments if e.truth and e.truth_held]
    rows = []
    for e in known:
        for name, estimate in e.estimates.items():
            if (truth := estimate.truth) is None:
                continue
            one = e.delay if name == "delay_samples" else estimate  # the interval of the first screen
            _, low, high = estimate_texts(one)
            ends = one.low or 0.0, truth, one.high or 0.0
            outside = None not in (one.value, one.low, one.high) and not holds(*ends)
            row = {"experiment": e.experiment, "quantity": name, "truth": truth, "outside": outside}
            row |= {"interval": f"{low} to {high}" if low and high else ""}
            rows.append(row | {"name": f"{quantity_name(name)} [{unit_text(one.unit)}]"})
    reasons = [f"No limits: {e.truth.limit_reason}." for e in known if e.truth and e.truth.limit_reason]
    held = [e.truth_held for e in known if e.truth_held]
    total = sum(one.estimates + one.limits for one in held)
    kept = sum(one.estimates_held + one.limits_held for one in held)
    included = ", limits included" if any(one.limits for one in held) else ""
    caption = f"True values of the simulation: {kept} of {total} 95 % intervals contain them{included}"
    columns = (
        Column("name", "quantity"),
        Column("truth", show=digits(4), notes=lambda row: [MISSED if row["outside"] else None]),
        Column("interval", "95 %", show=show_text, why="no interval"),
    )
    table = table_of("truth", caption, columns, rows, row_within_experiment("quantity"), experiment_block)
    if table is not None:
        table.mark(*reasons)
    return table
