"""Tables of a report about experiments: verdicts, outcomes, and estimates by every method with their intervals."""

from __future__ import annotations

from functools import partial
from typing import Any

from pipeline.base.wording import counted
from pipeline.records.findings import DRIFTS, Estimate
from pipeline.records.loop_records import Parameter, WallReplay
from pipeline.records.models import Motion
from pipeline.records.results import ComparisonResult, TheoryParameters
from pipeline.records.trial_codec import NO_TRIALS, TrialPage
from pipeline.rendering.labels import DIGITS, UNITS, estimate_texts, significant
from pipeline.rendering.table import Cell, Column, Table, missing, number, words

MAIN = ("delay_samples", "mass", "damping", "implied_delay")
"""Quantities that stand beside the experiments; the others stand in the table of methods only."""

NAMES = {
    "delay_samples": "delay d",
    "mass": "mass m",
    "damping": "damping b",
    "implied_delay": "delay implied by the boundary",
    "jitter_samples": "jitter of the delay within a trial",
    "friction": "Coulomb friction",
    "device_stiffness": "stiffness of the device",
    "constant_force": "constant force on the device",
    "boundary_area": "area under the boundary",
}

DRIFT_NOTE = (
    "Drifts with the setting of the wall, so that the model does not hold for all trials; the table of "
    "estimates by every method has the amounts."
)
"""Stands once below the experiments; how much each estimate drifts is a remark in the table of methods."""

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

OUTCOME_NOTES = {
    "settled": "Settled: stays within 2 % of x_0 + F_0/K. More logs come to rest, some of them elsewhere.",
    "disturbed": "Disturbed: a force of 5 % of the step or more acts that neither command nor mass and damping "
    "explain, such as a push or friction.",
}

_TWO = partial(significant, digits=2)
_USUAL = partial(significant, digits=DIGITS)

_count = partial(Column, group="trials")
_median = partial(Column, group="median of the trials", show=_TWO, why="no sensor noise, or no fit")

_MODEL = (
    words("experiment"),
    _count("trials", "all"),
    _count("explained", "explained by the model"),
    _count("left", "leave its noise band"),
    _median("misfit"),
    _median("whiteness", "whiteness p"),
    _median("ghost", "log \N{MINUS SIGN} simulated loop", "%"),
)

_METHODS = (
    words("method"),
    Column("value"),
    Column("low"),
    Column("high"),
    Column("within", "one trial \N{PLUS-MINUS SIGN}", show=_TWO),
    Column("spread", show=_TWO),
    Column("trials", "used"),
    Column("left_out", "left out"),
    words("remark"),
)

_WITH_INTERVAL = "estimated, with 95 % interval"


def experiment_table(result: ComparisonResult, trials: TrialPage = NO_TRIALS) -> Table | None:
    """Return trials, verdicts, estimates with 95 % intervals, and theory parameters of each experiment."""
    verdicts = list(dict.fromkeys(v for e in result.experiments for v in e.verdicts))
    quantities = [q for q in MAIN if any(q in e.estimates for e in result.experiments)]
    units = {q: e.estimates[q].unit for e in reversed(result.experiments) for q in e.estimates}
    columns = [words("experiment"), words("set-up"), Column("trials", "all", group="trials")]
    columns += [Column(v, group="trials") for v in verdicts]
    columns += [
        Column(
            q, quantity_name(q), unit_text(units[q]), "estimated, with 95 % interval", why="not asked for in this scene"
        )
        for q in quantities
    ]
    columns += [words("theory", "theory uses")] if any(e.theory for e in result.experiments) else []
    table = Table("experiments", "Experiments, verdicts on stability and estimated parameters", columns)
    for e in result.experiments:
        operator = f"{e.grip} grip" if e.grip != "none" else "no operator"
        values: dict[str, Any] = {v: e.verdicts.get(v, 0) for v in verdicts}
        shown = e.estimates | {"delay_samples": e.delay}
        values |= {q: estimate_cell(table, shown[q]) for q in quantities if q in e.estimates}
        values |= {"experiment": e.experiment, "trials": e.trials, "theory": _theory_cell(e.theory, result.motion)}
        values["set-up"] = ", ".join(filter(None, [e.configuration, operator]))
        table.add(e.experiment, values)
    return table.filled


def loop_table(result: ComparisonResult, trials: TrialPage = NO_TRIALS) -> Table | None:
    """Return the loop of each experiment and whether it bears statements, or None where none is known."""
    units = UNITS[result.motion]
    columns = [words("experiment"), words("adequate", "adequate loop"), words("reason", "why")]
    columns += [words("source", "parameters by"), words("delay", "delay d [samples]")]
    columns += [words("mass", f"mass m [{units.mass}]"), words("damping", f"damping b [{units.damping}]")]
    columns += [words("replay", "behind walls it was not fitted to"), words("passive", "stiffest passive wall")]
    table = Table("loops", "The loop that all statements about a device rest on, with 95 % intervals", columns)
    for e in result.experiments:
        if e.loop is None:
            continue
        values = {
            "experiment": e.experiment,
            "adequate": "yes" if e.loop.adequate else "no",
            "reason": e.loop.reason,
            "source": e.loop.source,
            "delay": _parameter_text(e.loop.delay_samples),
            "mass": _parameter_text(e.loop.mass),
            "damping": _parameter_text(e.loop.damping),
            "replay": _replay_text(e.replay),
            "passive": (
                f"K = {e.passive.stiffness:.4g} {units.stiffness}, B = {e.passive.damping:.4g} {units.damping}"
                if e.passive
                else "none is named"
            ),
        }
        table.add(e.experiment, values)
    return table.filled


def _replay_text(replay: WallReplay | None) -> str:
    if replay is None or replay.verdicts_same is None:
        return "no wall to replay"
    told = {"limits": replay.limits_off_percent, "settling times": replay.costs_off_percent}
    off = [f"{name} within {percent:.2g} %" for name, percent in told.items() if percent is not None]
    fit = [] if replay.fit_percent is None else [f"motion to {replay.fit_percent:.3g} %"]
    return ", ".join([f"{100 * replay.verdicts_same:.3g} % of {replay.trials} verdicts right", *off, *fit])


def _parameter_text(parameter: Parameter | None) -> str:
    if parameter is None:
        return "not known"
    given = Estimate(**parameter.model_dump(), unit="", method="")
    value, low, high = estimate_texts(given)
    return f"{value} ({low} to {high})" if parameter.low < parameter.high else value


def cause_table(result: ComparisonResult, trials: TrialPage = NO_TRIALS) -> Table | None:
    """Return what logs show directly of a loop that is not ideal, with the evidence; None where they show nothing."""
    columns = [words("code", "cause"), words("sentence", "what it is"), words("evidence")]
    table = Table("causes", "What the logs show beside mass, damping and delay", columns)
    for e in result.experiments:
        for cause in e.causes:
            name = cause.code.replace("_", " ")
            values = {"code": name, "sentence": cause.sentence, "evidence": cause.evidence}
            table.add(f"{e.experiment}/{cause.code}", values, f"experiment {e.experiment}")
    return table.filled


def outcome_table(result: ComparisonResult, trials: TrialPage = NO_TRIALS) -> Table | None:
    """Return how many trials ended how, or None where it is not known."""
    shown = [name for name in OUTCOMES if any(e.outcomes.get(name) for e in result.experiments)]
    columns = (words("experiment"), *(Column(name, OUTCOMES[name]) for name in shown))
    table = Table("outcomes", "What the logs show: number of trials by outcome, each trial by one", columns)
    table.mark(*(OUTCOME_NOTES.get(name) for name in shown))
    for e in result.experiments if shown else ():
        counts = {name: e.outcomes.get(name, 0) for name in shown}
        table.add(e.experiment, {"experiment": e.experiment, **counts})
    return table.filled


def model_table(result: ComparisonResult, trials: TrialPage = NO_TRIALS) -> Table | None:
    """Return how well the fitted model explains the logs, or None where it was not fitted."""
    caption = "Does the model (mass, damping, delay) explain the logs? Misfit is 1 where the sensor explains the errors"
    table = Table("model", caption, _MODEL)
    for e in result.experiments:
        if e.model_check:
            percent = None if e.model_check.ghost is None else 100 * e.model_check.ghost
            table.add(e.experiment, {**dict(e.model_check), "experiment": e.experiment, "ghost": percent})
    return table.filled


def method_table(result: ComparisonResult, trials: TrialPage = NO_TRIALS) -> Table | None:
    """Return the estimates by every method, or None where there is none."""
    table = Table("methods", "Estimates by method, with 95 % intervals", _METHODS)
    for e in result.experiments:
        for quantity, best in e.estimates.items():
            if best.value is None and not best.by_method:
                continue
            for name, value in _methods(best).items():
                block = f"experiment {e.experiment}: {quantity_name(quantity)} [{unit_text(value.unit)}]"
                table.add(f"{e.experiment}/{quantity}/{name}", _method_cells(name, value), block)
    return table.filled


def _methods(best: Estimate) -> dict[str, Estimate]:
    """The value that is used first, then the other methods; those with another unit last."""
    others = {name: value for name, value in best.by_method.items() if value.method != best.method}
    ordered = sorted(others.items(), key=lambda item: item[1].unit != best.unit)
    return {f"{best.method} (used)": best, **dict(ordered)}


def _method_cells(name: str, value: Estimate) -> dict[str, Any]:
    why = value.reason or "the method gives none"
    numbers = (value.value, value.low, value.high)
    printed = [Cell(x, text) if text else missing(why) for x, text in zip(numbers, estimate_texts(value), strict=True)]
    return {
        "method": name.replace("_", " "),
        **dict(zip(("value", "low", "high"), printed, strict=True)),
        "within": number(value.within, _TWO, why),
        "spread": number(value.spread, _TWO, why),
        "trials": value.trials,
        "left_out": len(value.outliers) + value.refused,
        "remark": _remark(value),
    }


def _remark(value: Estimate) -> str:
    parts = [value.reason, value.warning]
    if value.outliers:
        some = ", ".join(value.outliers[:3]) + (" ..." if len(value.outliers) > 3 else "")
        parts.append(f"{counted(len(value.outliers), 'outlier')}: {some}")
    if value.refused:
        parts.append(f"{counted(value.refused, 'trial')} without an interval")
    return "; ".join(part for part in parts if part)


def quantity_name(quantity: str) -> str:
    """Return what a quantity is called in heads of tables."""
    return NAMES.get(quantity, quantity.replace("_", " "))


def unit_text(unit: str) -> str:
    """Return a unit as it is printed."""
    return unit.replace("^2", "\N{SUPERSCRIPT TWO}")


def estimate_cell(table: Table, value: Estimate) -> Cell:
    """Return an estimate with its interval; method, drift and warnings are notes of the table."""
    if value.value is None:
        return missing(value.reason or "", marks=table.mark(value.reason))
    text, low, high = estimate_texts(value)
    clauses = (value.warning or "").split("; ")
    others = "; ".join(clause for clause in clauses if not clause.startswith(DRIFTS))
    drift = DRIFT_NOTE if any(clause.startswith(DRIFTS) for clause in clauses) else None
    marks = table.mark(f"Method: {value.method}.", value.reason, drift, others)
    return Cell(value.value, text, aside=f"{low} to {high}" if low and high else "", marks=marks)


def _theory_cell(theory: TheoryParameters | None, motion: Motion) -> Cell:
    if theory is None:
        return missing("no theory: its parameters could not be had")
    units = UNITS[motion]
    parts = [("m", theory.mass, f" {units.mass}"), ("b", theory.damping, f" {units.damping}")]
    parts += [("k", theory.stiffness, f" {units.stiffness}")] if theory.stiffness else []
    parts.append(("d", theory.delay_samples, ""))
    texts = [f"{symbol} = {significant(value, 3)}{unit}" for symbol, value, unit in parts]
    # a value and its unit stay on one line
    text = ", ".join(text.replace(" ", "\N{NO-BREAK SPACE}") for text in texts)
    return Cell(text, text, numeric=False, aside=theory.source)
