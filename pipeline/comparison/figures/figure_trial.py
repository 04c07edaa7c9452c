"""One trial beside the loops that may explain it: theory, the loop fitted to all logs, the model fitted to this one."""

from __future__ import annotations

import numpy as np
import pyarrow.compute as pc

from pipeline.base.errors import ParameterError
from pipeline.comparison.figures.figure_response import LONGEST_SHOWN
from pipeline.comparison.loops.told_loop import adequate_theory
from pipeline.measured.fit.ghost import simulate_ghost
from pipeline.measured.law.log_rows import LogRows
from pipeline.measured.stages.stage_groups import TrialGroup
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.records.batch import Floats
from pipeline.records.figure_records import Beside, Figure, TrialCourse
from pipeline.records.models import Motion
from pipeline.records.results import ExperimentResult
from pipeline.rendering.labels import UNITS, significant, size_text
from pipeline.store.samples import load_batch
from pipeline.store.storage import read_trials
from pipeline.theory.predictions import Theory

REACH = 100.0
"""Displacement, in that of the log, from which on a simulated response is left out."""


def trial_figure(stages: ExperimentStages, result: ExperimentResult, trial: str, motion: Motion) -> Figure[TrialCourse]:
    """Return a trial beside theory and fitted loops, and the residual of the wall law.

    Parameters
    ----------
    stages : ExperimentStages
        Of its experiment. What these do not hold of the trial, as of one that is excluded, is left out.
    result : ExperimentResult
    trial : str
        Its id.
    motion : {"translation", "rotation"}
    """
    stored = read_trials(stages.processed, stages.device, stages.experiment)
    own = stored.filter(pc.equal(stored.column("trial_id"), trial))
    group = TrialGroup(load_batch(stages.processed, own))
    batch, found = group.batch, group.found
    edge = max(int(found.edge_row[0]), 0)
    rows = min(int(batch.rows[0]), edge + LONGEST_SHOWN)
    log = LogRows.of(group.logged, found, 0)
    beside, missing = _beside(stages, result, trial, group, rows)
    stiffness = float(batch.stiffness[0])
    course = TrialCourse(
        batch.time[0, :rows] - batch.time[0, edge],
        batch.displacement[0, :rows],
        float(batch.step[0]) / stiffness if stiffness > 0 else np.nan,
        tuple(beside),
        log.residual[:rows],
        float(log.rounding.max()),
    )
    simulated = bool(own.column("simulated")[0].as_py())
    law = _law(stages, trial, course.residual, course.rounding, UNITS[motion].stiffness.partition("/")[0])
    words = _words(course, missing, law)
    return Figure("response", f"trial-{trial}", f"Trial {trial}", words, (course,), simulated=simulated)


def response(theory: Theory, stiffness: float, damping: float, force: Floats) -> Floats:
    """Return the displacement of a loop at each sample, from rest, under an external force that is part of the command.

    Parameters
    ----------
    theory : Theory
    stiffness, damping : float
        Of the wall: K [N/m, Nm/rad], B [Ns/m, Nms/rad].
    force : float64, shape (n,)
        External force at each sample [N, Nm].

    Returns
    -------
    float64, shape (n,)
        Displacement [m, rad].

    Raises
    ------
    ParameterError
        If delay and velocity filter together are longer than 96 samples.

    Source: Hulin 2017, eqs. 3.9 and 3.18, with the parts of a loop that is not ideal.
    """
    free, push, position, velocity = theory.loop.open_loop
    units = theory.units
    wall = stiffness / units.stiffness * position + damping / units.damping * velocity
    closed = free - np.outer(push, wall)
    state, found = np.zeros(len(push)), np.empty(len(force))
    with np.errstate(over="ignore", invalid="ignore"):  # an unstable loop grows beyond all numbers
        for k, pushed in enumerate(force / units.stiffness):
            found[k] = position @ state
            state = closed @ state + push * pushed
    return found


def _beside(
    stages: ExperimentStages, result: ExperimentResult, trial: str, group: TrialGroup, rows: int
) -> tuple[list[Beside], list[str]]:
    """Return the responses beside a log, and why others are not there."""
    batch, found = group.batch, group.found
    edge, measured = int(found.edge_row[0]), batch.displacement[0, :rows]
    if edge < 0:
        return [], ["No step was found in this log, so that no loop can be held against it"]
    force = np.where(np.arange(rows) >= edge, float(batch.step[0]), 0.0)
    fitted = adequate_theory(result, stages)
    loops: dict[str, Theory] = {}
    if result.theory is not None and (fitted is None or result.theory != fitted.parameters):
        loops["theory"] = Theory(result.theory)
    if fitted is not None:
        loops["fitted loop"] = fitted
    drawn, missing = [], []
    for label, theory in loops.items():
        try:
            position = response(theory, float(batch.stiffness[0]), float(batch.damping[0]), force)
        except ParameterError as error:
            missing.append(f"No {label}: {error}".rstrip("."))
            continue
        drawn.append(_compared(label, theory.parameters.source, position, measured, edge))
    if fitted is None:
        why = result.loop.reason if result.loop is not None else "no model was fitted to the logs"
        missing.append(f"No loop is fitted to all logs: {why}")
    model = _model(stages, trial)
    if model is not None:
        ghost = simulate_ghost(batch, found, *(np.array([value]) for value in model))
        units = UNITS["rotation" if stages.rotation else "translation"]
        named = zip(("m", "b", "delay"), model, (units.mass, units.damping, "samples"), strict=True)
        source = ", ".join(f"{name} = {significant(value, 3)} {unit}" for name, value, unit in named)
        position = ghost.position[0, :rows] - batch.position[0, 0]
        drawn.append(_compared("model of this log", source, position, measured, edge))
    return drawn, missing


def _compared(label: str, source: str, position: Floats, measured: Floats, edge: int) -> Beside:
    beyond = ~(np.abs(position) <= REACH * np.nanmax(np.abs(measured), initial=0.0))
    shown = np.where(np.logical_or.accumulate(beyond), np.nan, position)
    off = (measured - shown)[edge:]
    known = np.isfinite(off)
    return Beside(label, source, shown, float(np.sqrt(np.mean(off[known] ** 2))) if known.any() else np.nan)


def _model(stages: ExperimentStages, trial: str) -> tuple[float, ...] | None:
    """Return mass, damping and delay of the model fitted to one log; None where there is none."""
    ids = stages.texts("response", "trial_id")
    if trial not in ids or not stages.is_stored("model"):
        return None
    row = ids.index(trial)
    found = tuple(float(stages.column("model", f"model_{name}")[row]) for name in ("mass", "damping", "delay"))
    return found if np.isfinite(found).all() else None


def _law(stages: ExperimentStages, trial: str, residual: Floats, rounding: float, unit: str) -> str:
    """Return in words how far the command of a log is from the wall law, and why where the stage has found that."""
    largest = float(np.nanmax(np.abs(residual), initial=0.0))
    if largest <= rounding:
        return "The logged command is that of the wall law, up to rounding"
    ids = stages.texts("response", "trial_id")
    known = trial in ids and stages.is_stored("wall_law")
    why = stages.texts("wall_law", "law_evidence")[ids.index(trial)] if known else ""
    return (
        f"The logged command is off the wall law by up to {significant(largest, 3)} {unit}, of which rounding is "
        f"{significant(rounding, 2)} {unit}{': ' if why else ''}{why}"
    )


def _words(course: TrialCourse, missing: list[str], law: str) -> str:
    size = float(np.nanmax(np.abs(course.position), initial=0.0)) or 1.0
    told = [
        f"{each.label} ({each.source}) by "
        + (size_text(100 * each.deviation / size) if np.isfinite(each.deviation) else "any amount")
        for each in course.beside
    ]
    off = [f"Off the log, root mean square over its largest displacement: {'; '.join(told)}"] if told else []
    return ". ".join(text.rstrip(".") for text in (*off, *missing, law)) + "."
