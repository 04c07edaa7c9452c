"""Draw single trials, namely the first step response of a report, and a trial with loops that may explain it.

Source: Hulin 2017, Fig. 6.2.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipeline.base.errors import ParameterError
from pipeline.comparison.loops.loop_basis import adequate_theory
from pipeline.comparison.scene.scene import StoredData
from pipeline.device.parameters import is_rotation, unit_of
from pipeline.measured.signal.response import find_response
from pipeline.measured.stages.measured_trial import MeasuredTrial
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.measured.thesis import first_change
from pipeline.measured.wall_command.log_rows import LogRows
from pipeline.records.models import ComparisonRow, Motion
from pipeline.records.results import ExperimentNumbers
from pipeline.records.trials import Booleans, Floats, Trial
from pipeline.rendering.figures.drawing import Figure, Panel, Series, around
from pipeline.rendering.figures.overview import thinned
from pipeline.rendering.labels import (
    UNITS,
    cost_text,
    criterion_label,
    damping_text,
    decimal,
    significant,
    size_text,
    stiffness_text,
)
from pipeline.store.samples import load_trials
from pipeline.store.storage import read_trials
from pipeline.theory.predictions import Theory

LONGEST_SHOWN = 1 << 14
"""Number of rows shown after the command edge, 16 s at 1 kHz. In a longer plot the motion would be invisible."""

CANDIDATES = 8
"""Number of examined trials.

At the lowest stiffness, a log may end before its second maximum. At eight times that stiffness, the period is a third
as long.
"""

CLEAR = 0.05
"""Height above the final position, relative to F_0/K, from which a maximum counts. Sensor steps cause lower maxima."""

BEFORE, AFTER = 2, 6
"""Number of sampling periods in the close-up before the command edge and after the first change."""

REACH = 100.0
"""Threshold for the displacement, relative to that of the log. Above it, a simulated response is not drawn."""

MILLI = 1e3
TIME = "time after the command edge [ms]"


def _length(motion: Motion) -> str:
    return f"displacement [{'mrad' if is_rotation(motion) else 'mm'}]"


def _force(motion: Motion) -> str:
    return unit_of("force", motion)


def trials_of(stages: ExperimentStages) -> tuple[Floats, Floats, np.ndarray]:
    """Return stiffness, damping and verdict of the trials of an experiment."""
    K, B = stages.column("response", "stiffness"), stages.column("response", "damping")
    return K, B, stages.verdicts.verdict


def response_figures(data: StoredData) -> list[Figure]:
    """Return the first response of the first suitable experiment, with a close-up of its onset.

    The list is empty if there is no step. The trial has the lowest stiffness whose log shows two maxima, and the lowest
    stable damping at this stiffness. If no log shows two maxima, it has the lowest stiffness of all. Experiments
    without operator have priority.
    """
    grips = {stages.experiment: set(stages.trials.column("grip").to_pylist()) for stages in data.experiments}
    for stages in sorted(data.experiments, key=lambda stages: grips[stages.experiment] != {"none"}):
        found = list(_candidates(stages))
        for trial, edge, change, period in [*(each for each in found if each[3] is not None), *found][:1]:
            return [_response_figure(stages, trial, edge, change, period, data.motion)]
    return []


def _candidates(stages: ExperimentStages) -> Iterator[tuple[Trial, int, int, tuple[float, float] | None]]:
    """Yield the softest trials.

    Each consists of log, row of the edge, number of rows to the first change, and times of the first two maxima.
    """
    k, b = stages.column("response", "stiffness"), stages.column("response", "damping")
    chosen = softest(k, b, stages.verdicts.verdict == "stable")
    if not len(chosen):
        return
    names = stages.texts("response", "trial_id")
    wanted = pa.array([names[i] for i in chosen])
    rows = stages.trials.filter(pc.is_in(stages.trials.column("trial_id"), value_set=wanted))
    for trial in sorted(load_trials(stages.processed, rows), key=lambda trial: trial.stiffness):
        response = find_response(trial)
        first, edge = first_change(trial, response).first_row, response.edge_row
        if first >= 0:
            shown = slice(edge, edge + LONGEST_SHOWN)
            time, final = trial.time[shown] - trial.time[edge], trial.step / trial.stiffness
            yield trial, edge, first - edge, oscillation_period(time, trial.displacement[shown], final)


def softest(stiffness: Floats, damping: Floats, stable: Booleans) -> np.ndarray:
    """Return at most `CANDIDATES` stable trials with the lowest positive stiffnesses, each at its lowest damping."""
    usable = np.flatnonzero(stable & (stiffness > 0))
    order = usable[np.lexsort((damping[usable], stiffness[usable]))]
    return order[np.diff(stiffness[order], prepend=-np.inf) > 0][:CANDIDATES]


def oscillation_period(time: Floats, displacement: Floats, final: float) -> tuple[float, float] | None:
    """Return the times of the first two maxima of a step response, or None if it has fewer than two.

    A maximum is the middle of the highest samples between two crossings of the final position. Only a complete interval
    above the final position counts.
    """
    relative = displacement / final
    change = np.flatnonzero(np.diff(np.concatenate([[False], relative > 1, [False]]).astype(np.int8)))
    maxima = []
    for start, end in zip(change[::2].tolist(), change[1::2].tolist(), strict=True):
        lobe = relative[start:end]
        if end < len(relative) and lobe.max() >= 1 + CLEAR:  # an interval cut off by the end of the log may still rise
            maxima.append(float(time[start + np.flatnonzero(lobe == lobe.max())].mean()))
    return (maxima[0], maxima[1]) if len(maxima) > 1 else None


def _response_figure(
    stages: ExperimentStages,
    trial: Trial,
    edge: int,
    change: int,
    period: tuple[float, float] | None,
    motion: Motion,
) -> Figure:
    rows = min(trial.rows, edge + LONGEST_SHOWN)
    time, position = MILLI * (trial.time[:rows] - trial.time[edge]), MILLI * trial.displacement[:rows]
    K, B, step = trial.stiffness, trial.damping, MILLI * trial.sampling_period_s
    final = MILLI * trial.step / K
    ends, units, at = np.array([time[0], time[-1]]), UNITS[motion], change * step
    whole = [Series("_log", "log", *thinned(time, position)), Series("_final value", "final", ends, np.full(2, final))]
    words = f"K = {stiffness_text(K)} {units.stiffness}, B = {damping_text(B)} {units.damping}"
    remark = ""
    if period is not None:
        between = MILLI * np.array(period)
        whole.append(Series("oscillation period", "line", between, np.full(2, 0.5 * final)))
        remark = f" The oscillation period is {decimal(between[1] - between[0], 0)} ms."
    near = (time >= -(BEFORE + 0.5) * step) & (time <= at + (AFTER + 0.5) * step)
    spans = Series("_delay", "span", np.array([at - step, at]), np.zeros(2))
    first = Series("first change", "mark", np.array([at]), position[near][np.argmin(np.abs(time[near] - at))][None])
    command = np.repeat(trial.command[:rows][near], 2)[:-1]
    below = Panel(
        "",
        (TIME, f"force [{_force(motion)}]"),
        (Series("_command", "line", np.repeat(time[near], 2)[1:], command), spans),
        "",
        (None, around(command, np.zeros(1))),
    )
    begin = (spans, Series("_log", "log", time[near], position[near]), first)
    panels = (
        Panel("step response", (TIME, _length(motion)), tuple(whole), f"Displacement over time, {words}.{remark}"),
        Panel(
            "beginning",
            ("", _length(motion)),
            begin,
            f"First change of position after {decimal(at, 3)} ms.",
            below=below,
        ),
    )
    caption = (
        f"Trial {trial.trial_id} of experiment {stages.experiment}: {words}.{remark} Right: the onset. The position "
        f"first changes at t_obs = {decimal(at, 3)} ms, so the delay at the onset lies in the shaded period (6.3). "
        "If the delay jitters, it differs between samples."
    )
    return Figure("response", "first-response", "Step response", caption, panels, size=(440.0, 290.0))


def trial_figure(stages: ExperimentStages, result: ExperimentNumbers, trial: str, motion: Motion) -> Figure:
    """Return a trial with theory, fitted loops, and the residual of the wall law.

    Parameters
    ----------
    stages : ExperimentStages
        Stages of its experiment. Missing results, such as those of an excluded trial, are omitted.
    result : ExperimentNumbers
    trial : str
        Id of the trial.
    motion : {"translation", "rotation"}
    """
    stored = read_trials(stages.processed, stages.device, stages.experiment)
    own = stored.filter(pc.equal(stored.column("trial_id"), trial))
    of = MeasuredTrial(load_trials(stages.processed, own)[0])
    edge = max(of.response.edge_row, 0)
    rows = min(of.trial.rows, edge + LONGEST_SHOWN)
    time, measured = MILLI * (of.trial.time[:rows] - of.trial.time[edge]), of.trial.displacement[:rows]
    log = LogRows.of(of.logged, of.response)
    residual, rounding = log.residual[:rows], float(log.rounding.max())
    beside, sentences = _beside(stages, result, of, measured)
    series = [Series("log", "wide log", *thinned(time, MILLI * measured))]
    series += [Series(label, kind, *thinned(time, MILLI * position)) for label, kind, position in beside]
    stiffness, ends = of.trial.stiffness, np.array([time[0], time[-1]])
    if stiffness > 0:
        series.append(Series("_final value", "final", ends, np.full(2, MILLI * of.trial.step / stiffness)))
    limits = (float(ends[0]), float(ends[1]) if ends[1] > ends[0] else float(ends[0]) + 1.0)
    law = [Series("_residual", "log", *thinned(time, residual))]
    law += [
        Series("rounding", "final", ends, np.full(2, rounding)),
        Series("_rounding", "final", ends, np.full(2, -rounding)),
    ]
    command = of.logged.command[:rows]
    force_limits = (limits, around(command, np.zeros(1)))
    names = f"residual [{_force(motion)}]"
    panels = (
        Panel(
            "response",
            (TIME, _length(motion)),
            tuple(series),
            f"Displacement over time: {', '.join(s.label.lstrip('_') for s in series)}.",
            (limits, around(*(s.y for s in series))),
        ),
        Panel(
            "command",
            (TIME, f"force [{_force(motion)}]"),
            (Series("command", "log", *thinned(time, command)),),
            "Logged command over time.",
            force_limits,
        ),
        Panel(
            "command minus wall law",
            (TIME, names),
            tuple(law),
            "Logged command minus that of the wall law over time.",
            (limits, around(residual, np.array([-rounding, rounding]))),
        ),
    )
    sentences.append(_law(stages, trial, residual, rounding, _force(motion)))
    words = ". ".join(text.rstrip(".") for text in sentences) + "."
    simulated = bool(own.column("simulated")[0].as_py())
    return Figure(
        "response", f"trial-{trial}", f"Trial {trial}", words, panels, size=(440.0, 310.0), simulated=simulated
    )


SHOWN_SAMPLES = 150
"""Number of samples after the command edge in this figure. It is three times a settling time with d = 8."""


def wall_figure(stages: ExperimentStages, result: ExperimentNumbers, theory: Theory, best: ComparisonRow) -> Figure:
    """Return the logged and theoretical response of the recommended wall, and the response at theory's optimum.

    Parameters
    ----------
    stages, result
        Stages and result of an experiment with a recommended wall.
    theory : Theory
    best : ComparisonRow
        Optimum of theory for sampled responses.
    """
    assert result.use is not None, "this figure needs a recommended wall"
    point = result.use.point
    (trial,) = load_trials(stages.processed, stages.trials.filter(pc.equal(stages.trials["trial_id"], point.trial_id)))
    edge = max(find_response(trial).edge_row, 0)
    shown = slice(edge, edge + SHOWN_SAMPLES)
    time = MILLI * (trial.time[shown] - trial.time[edge])
    series = [Series("recommended wall, log", "log", time, trial.displacement[shown] * trial.stiffness / trial.step)]
    walls = [("recommended wall, theory", "line", point.stiffness, point.damping)]
    walls += [("optimum by theory", "theory", best.stiffness or 0.0, best.damping or 0.0)]
    for label, kind, K, B in walls:
        motion = response(theory, K, B, np.ones(len(time))) * K
        series.append(Series(label, kind, time, motion))
    u = UNITS[theory.loop.motion]
    recommended, optimum = (
        f"K = {stiffness_text(K)} {u.stiffness}, B = {damping_text(B)} {u.damping}" for _, _, K, B in walls
    )
    cost = f"{criterion_label(best.criterion)} {cost_text(best.criterion, best.cost or 0.0)}"
    caption = (
        f"Recommended, a tested wall: {recommended}. Optimum: {optimum}, {cost}, the fastest of all walls "
        "of the linear loop."
    )
    names = (TIME, "displacement over F_0/K")
    panel = Panel("", names, tuple(series), "Responses over time, relative to the final displacement.")
    return Figure("response", "recommended-wall", "The recommended wall and theory's optimum", caption, (panel,),
                  size=(440.0, 290.0))  # fmt: skip


def overlaid_figure(figures: Sequence[Figure], labels: Sequence[str]) -> Figure:
    """Return the superimposed responses of trials, each with its theoretical response as a dashed line in the same
    colour."""
    series = []
    for number, (figure, label) in enumerate(zip(figures, labels, strict=True)):
        for each in figure.panels[0].series:
            if each.label in ("log", "theory"):
                kind = "theory" if each.label == "theory" else "course"
                series.append(Series("_theory" if kind == "theory" else label, kind, each.x, each.y, number=number))
    names = figures[0].panels[0].names
    words = f"Displacement over time of {len(figures)} trials; dashed: theory."
    panel = Panel("", names, tuple(series), words, (None, around(*(s.y for s in series))))
    return Figure("response", "trials", "Trials", "", (panel,), size=(440.0, 310.0))


def response(theory: Theory, stiffness: float, damping: float, force: Floats) -> Floats:
    """Return the displacement [m, rad] of a loop at each sample, from rest.

    An external force is added to the command.


    Parameters
    ----------
    theory : Theory
    stiffness, damping : float
        Wall: K [N/m, Nm/rad], B [Ns/m, Nms/rad].
    force : float64, shape (n,)
        External force at each sample [N, Nm].

    Raises
    ------
    ParameterError
        If delay and velocity filter together exceed 96 samples.

    Source: Hulin 2017, eqs. 3.9 and 3.18, extended to the parts of a non-ideal loop.
    """
    free, push, position, velocity = theory.normalised.open_loop
    units = theory.units
    wall = stiffness / units.stiffness * position + damping / units.damping * velocity
    closed = free - np.outer(push, wall)
    state, found = np.zeros(len(push)), np.empty(len(force))
    with np.errstate(over="ignore", invalid="ignore"):  # the response of an unstable loop overflows
        for k, pushed in enumerate(force / units.stiffness):
            found[k] = position @ state
            state = closed @ state + push * pushed
    return found


def _beside(
    stages: ExperimentStages, result: ExperimentNumbers, of: MeasuredTrial, measured: Floats
) -> tuple[list[tuple[str, str, Floats]], list[str]]:
    """Return label, kind and displacement of the responses to compare with a log.

    The second result has sentences on their errors, and on the reasons for missing responses.
    """
    trial, edge, rows = of.trial, of.response.edge_row, len(measured)
    if edge < 0:
        return [], ["No step was found in this log, so no loop can be compared with it"]
    force = np.where(np.arange(rows) >= edge, trial.step, 0.0)
    fitted = adequate_theory(result, stages)
    loops = [("fitted loop", "fitted", fitted)] if fitted is not None else []
    if result.theory is not None and (fitted is None or result.theory != fitted.described):
        loops.insert(0, ("theory", "theory", Theory(result.theory)))
    drawn, off, missing = [], [], []
    size = float(np.nanmax(np.abs(measured), initial=0.0)) or 1.0

    def add(label: str, kind: str, source: str, position: Floats) -> None:
        beyond = ~(np.abs(position) <= REACH * size)
        shown = np.where(np.logical_or.accumulate(beyond), np.nan, position)
        error = (measured - shown)[edge:]
        known = error[np.isfinite(error)]
        much = size_text(100 * float(np.sqrt(np.mean(known**2))) / size) if len(known) else "beyond all limits"
        drawn.append((label, kind, shown))
        off.append(f"{label} ({source}): {much}")

    for label, kind, theory in loops:
        try:
            position = response(theory, trial.stiffness, trial.damping, force)
        except ParameterError as error:
            missing.append(f"No {label}: {error}")
        else:
            add(label, kind, theory.source, position)
    if fitted is None:
        why = result.loop.reason if result.loop is not None else "no model was fitted to the logs"
        missing.append(f"No loop is fitted to all logs: {why}")
    summary = "Difference from the log (root mean square, as a share of the log's largest displacement): "
    return drawn, [*([summary + "; ".join(off)] if off else []), *missing]


def _law(stages: ExperimentStages, trial: str, residual: Floats, rounding: float, unit: str) -> str:
    """Return a sentence on how far the command of a log deviates from the wall law.

    If the stage found a reason, it is included.
    """
    largest = float(np.nanmax(np.abs(residual), initial=0.0))
    if largest <= rounding:
        return "The logged command agrees with the wall law, up to rounding"
    ids = stages.texts("response", "trial_id")
    known = trial in ids and stages.is_stored("wall_law")
    why = stages.texts("wall_law", "law_evidence")[ids.index(trial)] if known else ""
    return (
        f"The logged command deviates from the wall law by up to {significant(largest, 3)} {unit}; rounding explains "
        f"{significant(rounding, 2)} {unit}{': ' if why else ''}{why}"
    )
