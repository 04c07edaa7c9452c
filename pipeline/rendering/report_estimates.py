"""Tables of a report about experiments: verdicts, outcomes, and estimates by every method with their intervals."""

from __future__ import annotations

from pipeline.base.wording import counted
from pipeline.records.models import DRIFTS, Estimate, Motion
from pipeline.records.results import ComparisonResult, TheoryParameters
from pipeline.records.trial_records import TrialPage
from pipeline.rendering.labels import DIGITS, MISSING, UNITS, criterion_label, estimate_texts, significant
from pipeline.rendering.report_tables import Cell, Head, Table, missing_cell, text_cell

MAIN = ("delay_samples", "mass", "damping", "implied_delay")
"""Quantities that stand beside the experiments; the others stand in the table of methods only."""

NAMES = {
    "delay_samples": "delay d",
    "mass": "mass m",
    "damping": "damping b",
    "implied_delay": "delay implied by the boundary",
    "jitter_samples": "jitter of the delay within a trial",
    "boundary_area": "area under the boundary",
}

DRIFT_NOTE = (
    "Drifts with the setting of the wall, so that the model does not hold for all trials; the table of "
    "estimates by every method has the amounts."
)
"""Stands once below the experiments; how much each estimate drifts is a remark in the table of methods."""

OUTCOME_NAMES = {
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


def experiment_table(result: ComparisonResult) -> Table:
    """Return trials, verdicts, estimates with 95 % intervals, and theory parameters of each experiment."""
    verdicts = list(dict.fromkeys(v for e in result.experiments for v in e.verdicts))
    quantities = [q for q in MAIN if any(q in e.estimates for e in result.experiments)]
    theory = any(e.theory for e in result.experiments)
    units = {q: e.estimates[q].unit for e in reversed(result.experiments) for q in e.estimates}
    heads = [Head("experiment", numeric=False), Head("set-up", numeric=False), Head("all", "trials")]
    heads += [Head(v, "trials") for v in verdicts]
    heads += [Head(f"{_name(q)} [{_unit(units[q])}]", "estimated, with 95 % interval") for q in quantities]
    heads += [Head("theory uses", numeric=False)] if theory else []
    table = Table("experiments", "Experiments, verdicts on stability and estimated parameters", tuple(heads))
    for e in result.experiments:
        setup = ", ".join(filter(None, [e.configuration, f"{e.grip} grip" if e.grip != "none" else "no operator"]))
        cells = [text_cell(e.experiment), text_cell(setup), Cell(str(e.trials))]
        cells += [Cell(str(e.verdicts.get(v, 0))) for v in verdicts]
        cells += [_estimate_cell(table, e.estimates.get(q)) for q in quantities]
        columns = ["experiment", "set-up", "trials", *verdicts, *quantities]
        if theory:
            cells.append(_theory_cell(e.theory, result.motion))
            columns.append("theory")
        table.add("", e.experiment, columns, cells)
    return table


def outcome_table(result: ComparisonResult) -> Table | None:
    """Return how many trials ended how, or None where it is not known."""
    shown = [name for name in OUTCOME_NAMES if any(e.outcomes.get(name) for e in result.experiments)]
    if not shown:
        return None
    heads = (Head("experiment", numeric=False), *(Head(OUTCOME_NAMES[name]) for name in shown))
    table = Table("outcomes", "What the logs show: number of trials by outcome", heads)
    for e in result.experiments:
        cells = [text_cell(e.experiment), *(Cell(str(e.outcomes.get(name, 0))) for name in shown)]
        table.add("", e.experiment, ("experiment", *shown), cells)
    return table


def model_table(result: ComparisonResult) -> Table | None:
    """Return how well the fitted model explains the logs, or None where it was not fitted."""
    checked = [(e.experiment, e.model_check) for e in result.experiments if e.model_check]
    if not checked:
        return None
    heads = (
        Head("experiment", numeric=False),
        *(Head(text, "trials") for text in ("all", "explained by the model", "leave its noise band")),
        *(
            Head(text, "median of the trials")
            for text in ("misfit", "whiteness p", "log \N{MINUS SIGN} simulated loop [%]")
        ),
    )
    caption = "Does the model (mass, damping, delay) explain the logs? Misfit is 1 where the sensor explains the errors"
    table = Table("model", caption, heads)
    columns = ("experiment", "trials", "explained", "left", "misfit", "whiteness", "ghost")
    for name, check in checked:
        counts = [Cell(str(n)) for n in (check.trials, check.explained, check.left)]
        percent = None if check.ghost is None else 100 * check.ghost
        numbers = [
            missing_cell("no sensor noise, or no fit") if x is None else Cell(significant(x, 2))
            for x in (check.misfit, check.whiteness, percent)
        ]
        table.add("", name, columns, [text_cell(name), *counts, *numbers])
    return table


def method_table(result: ComparisonResult) -> Table | None:
    """Return the estimates by every method, or None where there is none."""
    numbers = ("value", "low", "high", "one trial \N{PLUS-MINUS SIGN}", "spread", "used", "left out")
    heads = (Head("method", numeric=False), *(Head(text) for text in numbers), Head("remark", numeric=False))
    table = Table("methods", "Estimates by method, with 95 % intervals", heads)
    columns = ("method", "value", "low", "high", "within", "spread", "trials", "left_out", "remark")
    for e in result.experiments:
        for quantity, best in e.estimates.items():
            if best.value is None and not best.by_method:
                continue
            for name, value in _methods(best).items():
                block = f"experiment {e.experiment}: {_name(quantity)} [{_unit(value.unit)}]"
                table.add(block, f"{e.experiment}/{quantity}/{name}", columns, _method_cells(name, value))
    return table if table.blocks else None


def window_table(result: ComparisonResult) -> Table | None:
    """Return the mass over the window of the momentum balance, or None where no mass was asked for."""
    shown = [e for e in result.experiments if e.mass_windows]
    if not shown:
        return None
    heads = [Head("window [ms]")]
    columns = ["window"]
    for e in shown:
        heads += [Head(text, f"experiment {e.experiment}") for text in ("mass", "scatter", "trials")]
        columns += [f"{e.experiment}/{name}" for name in ("mass", "scatter", "trials")]
    unit = UNITS[result.motion].mass
    caption = f"Mass [{unit}] by the momentum balance (6.4) over its window: median and scatter of the trials"
    table = Table("windows", caption, tuple(heads))
    for window in sorted({w.window_s for e in shown for w in e.mass_windows}):
        cells = [Cell(f"{1e3 * window:g}")]
        for e in shown:
            found = next((w for w in e.mass_windows if w.window_s == window), None)
            numbers = (None, None) if found is None else (found.mass, found.scatter)
            cells += [
                missing_cell("fewer than two trials allow it") if x is None else Cell(significant(x, DIGITS))
                for x in numbers
            ]
            cells.append(Cell(str(found.trials if found else 0)))
        table.add("", f"{1e3 * window:g}", columns, cells)
    return table


def definition_table(result: ComparisonResult, trials: TrialPage | None = None) -> Table | None:
    """Return the best trials by the definitions of other tools, or None where settling or overshoot is left out."""
    groups = ("settling time, 2 % [samples]", "overshoot [%]")
    heads = (
        Head("best trial by", numeric=False),
        *(Head(text, groups[0]) for text in ("this report", "MATLAB", "MATLAB, peak error", "python-control")),
        *(Head(text, groups[1]) for text in ("this report", "about the last sample")),
    )
    table = Table("definitions", "The best trials by the definitions of other tools", heads)
    names = (
        *("settle_2pct", "settle_matlab_final_value", "settle_matlab_peak_error", "settle_python_control"),
        *("overshoot", "overshoot_last_sample"),
    )
    for e in result.experiments:
        for best in e.other_definitions:
            trial = trials.places.get((e.experiment, best.trial_id), "") if trials else ""
            cells = [text_cell(criterion_label(best.criterion))]
            for name in names:
                value = getattr(best, name)
                percent = name.startswith("overshoot")
                text = "" if value is None else f"{100 * value:.1f}" if percent else f"{value:.4g}"
                cells.append(
                    Cell(text, trial=trial) if text else missing_cell("not settled, or not told by this definition")
                )
            table.add(f"experiment {e.experiment}", f"{e.experiment}/{best.criterion}", ("criterion", *names), cells)
    if not table.blocks:
        return None
    table.mark(
        [
            "Other tools count from the command edge and take the last sample for the final value; this report counts "
            "from the first sample that the command can move, and takes x_0 + F_0/K."
        ]
    )
    return table


def _methods(best: Estimate) -> dict[str, Estimate]:
    """The value that is used first, then the other methods; those with another unit last."""
    others = {name: value for name, value in best.by_method.items() if value.method != best.method}
    ordered = sorted(others.items(), key=lambda item: item[1].unit != best.unit)
    return {f"{best.method} (used)": best, **dict(ordered)}


def _method_cells(name: str, value: Estimate) -> list[Cell]:
    without = value.reason or "the method gives none"
    numbers = [Cell(text) if text else missing_cell(without) for text in estimate_texts(value)]
    errors = [Cell(significant(x, 2)) if x is not None else missing_cell(without) for x in (value.within, value.spread)]
    counts = [Cell(str(value.trials)), Cell(str(len(value.outliers) + value.refused))]
    return [text_cell(name.replace("_", " ")), *numbers, *errors, *counts, text_cell(_remark(value))]


def _remark(value: Estimate) -> str:
    parts = [value.reason, value.warning]
    if value.outliers:
        some = ", ".join(value.outliers[:3]) + (" ..." if len(value.outliers) > 3 else "")
        parts.append(f"{counted(len(value.outliers), 'outlier')}: {some}")
    if value.refused:
        parts.append(f"{counted(value.refused, 'trial')} without an interval")
    return "; ".join(part for part in parts if part)


def _name(quantity: str) -> str:
    return NAMES.get(quantity, quantity.replace("_", " "))


def _unit(unit: str) -> str:
    return unit.replace("^2", "\N{SUPERSCRIPT TWO}")


def _estimate_cell(table: Table, value: Estimate | None) -> Cell:
    if value is None:
        return missing_cell("not asked for in this scene")
    if value.value is None:
        return Cell(MISSING, why=value.reason or "", marks=table.mark([value.reason]))
    text, low, high = estimate_texts(value)
    clauses = (value.warning or "").split("; ")
    others = "; ".join(clause for clause in clauses if not clause.startswith(DRIFTS))
    drift = DRIFT_NOTE if any(clause.startswith(DRIFTS) for clause in clauses) else None
    marks = table.mark([f"Method: {value.method}.", value.reason, drift, others])
    return Cell(text, aside=f"{low} to {high}" if low and high else "", marks=marks)


def _theory_cell(theory: TheoryParameters | None, motion: Motion) -> Cell:
    if theory is None:
        return missing_cell("no theory: its parameters could not be had")
    units = UNITS[motion]
    parts = [
        f"m = {significant(theory.mass, 3)} {units.mass}",
        f"b = {significant(theory.damping, 3)} {units.damping}",
    ]
    if theory.stiffness:
        parts.append(f"k = {significant(theory.stiffness, 3)} {units.stiffness}")
    parts.append(f"d = {significant(theory.delay_samples, 3)}")
    # a value and its unit stay on one line
    text = ", ".join(part.replace(" ", "\N{NO-BREAK SPACE}") for part in parts)
    return Cell(text, numeric=False, aside=theory.source)
