"""The found device behind tested walls that it was not fitted to: what it predicts there, and how far that is off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.base.wording import counted
from pipeline.comparison.loops.fitted_loop import loop_point
from pipeline.comparison.loops.loop_range import LoopPoint, LoopRange
from pipeline.comparison.scores.overlap import measured_limits
from pipeline.loop.motion import Mechanism
from pipeline.measured.cost.costs import settling
from pipeline.measured.experiment.fitted_device import FittedDevice
from pipeline.measured.ladder.trials import spread_over_plane
from pipeline.measured.signal.response import find_response
from pipeline.measured.signal.verdict import judge
from pipeline.measured.stages.stage_groups import Given, TrialGroup
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.records.batch import Floats, Integers, TrialBatch
from pipeline.records.loop_parts import Friction
from pipeline.records.loop_records import LoopLimit, WallReplay
from pipeline.records.models import Experiment
from pipeline.records.results import ExperimentResult
from pipeline.rendering.labels import share_text, significant
from pipeline.simulation.setup import Setup
from pipeline.simulation.simulate import simulate

MOST_WALLS = 150
"""Trials that are replayed, spread over the tested walls: a share of 95 % is then known to 2 %."""

LONGEST = 2000
"""Samples of a simulated log: what neither grows nor decays in them is as near the limit as any log tells."""

FOLDS = 5

QUANTILES = (-1.2816, -0.5244, 0.0, 0.5244, 1.2816)
"""Friction of each fold's trials, in standard deviations of its scatter: the middles of five equal shares."""

LOW = 0.25
"""Limit relative to the largest one below which none is compared in percent: at its ends a boundary tends to zero."""


@dataclass(frozen=True)
class Replayed:
    """A linear loop with the Coulomb friction and the constant force beside it [N, Nm]."""

    point: LoopPoint
    coulomb: float = 0.0
    force: float = 0.0


def setup_of_found(found: Replayed, stages: ExperimentStages) -> Setup:
    """Return a found device before a step of the usual size, without sensor and travel."""
    point = found.point
    friction = Friction(coulomb=found.coulomb) if found.coulomb > 0 else None
    device = Experiment(
        name=stages.experiment,
        mass=point.mass,
        damping=max(point.damping, 0.0),
        stiffness=max(point.stiffness, 0.0),
        delay_samples=max(point.delay_samples, 0.0),
        damping_last=0.0,
        damping_step=1.0,
        stiffness_step=1.0,
    )
    setup = Setup(
        plant=Mechanism.of(
            device.mass, device.damping, device.stiffness, point.parts.model_copy(update={"friction": friction})
        ),
        sampling_period_s=point.sampling_period_s,
        step=float(np.median(stages.step_sizes)),
        rows=min(int(np.median(stages.trials.column("rows").to_numpy())), LONGEST),
        edge_row=1,
        delay_samples=device.delay_samples,
        velocity=point.parts.velocity,
        force_gain=point.parts.force_gain,
    )
    return replace(setup, hidden=setup.hidden.model_copy(update={"constant_force": found.force}))


def wall_replay(
    result: ExperimentResult,
    stages: ExperimentStages,
    loop: LoopRange,
    fitted: FittedDevice | None,
    limits: Sequence[LoopLimit],
) -> WallReplay | None:
    """Return how a found device predicts the tested walls, each by the logs but a fifth; None without a wall.

    Parameters
    ----------
    result : ExperimentResult
    stages : ExperimentStages
    loop : LoopRange
    fitted : FittedDevice or None
        That the loop is of; None for that of single logs.
    limits : sequence of LoopLimit
        That the device predicts by all logs.

    Notes
    -----
    The walls of a fold are simulated with the device that the other folds tell, its friction drawn from its scatter.
    Verdicts are compared where the log and the simulated one are decided.
    """
    K, B = (stages.column("response", name) for name in ("stiffness", "damping"))
    verdict = stages.verdicts.verdict
    usable = (K > 0) & (verdict != "undecided") & np.isnan(stages.column("wall_law", "obeyed_stiffness"))
    chosen = spread_over_plane(K, B, usable, MOST_WALLS)
    if not len(chosen):
        return None
    ids = stages.texts("response", "trial_id")
    fold = _fold_of(fitted, [ids[i] for i in chosen])
    said, fits, costs = np.empty(len(chosen), dtype="<U9"), np.full(len(chosen), np.nan), np.full(len(chosen), np.nan)
    logged = dict(pair for part in stages.of_each(motions, chosen=[ids[i] for i in chosen]) for pair in part)
    for number, device in enumerate(_without_each_fold(stages, loop, fitted)):
        some = np.flatnonzero(fold == number)
        if not len(some):
            continue
        batch = simulate(setup_of_found(device, stages), K[chosen[some]], B[chosen[some]])
        response = find_response(batch)
        verdicts = judge(batch, response)
        said[some] = verdicts.verdict
        fits[some] = [_fit(logged[ids[chosen[i]]], batch, place) for place, i in enumerate(some)]
        delay = int(max(device.point.delay_samples, 0.0))
        costs[some] = settling(batch, response, verdicts, delay)["settle_2pct"].value
    stable = (verdict[chosen] == "stable") & (said == "stable")
    decided = said != "undecided"
    return WallReplay(
        fit_percent=_median(fits[stable]),
        verdicts_same=float((said == verdict[chosen])[decided].mean()) if decided.any() else None,
        limits_off_percent=_limits_off(result, limits),
        costs_off_percent=_costs_off(result, stages, chosen[stable], costs[stable]),
        trials=len(chosen),
    )


def replay_words(replay: WallReplay) -> str:
    """Return how a found device predicts walls, as a clause."""
    verdicts = share_text(replay.verdicts_same or 0.0, 0)
    walls = counted(replay.trials, "wall")
    text = f"behind {walls} that it was not fitted to the found device is right in {verdicts} % of verdicts"
    if replay.limits_off_percent is None:
        return text
    return f"{text}, its limits within {significant(replay.limits_off_percent, 2)} %"


def motions(group: TrialGroup, given: Given) -> list[tuple[str, Floats]]:
    """Return name and positions from the step on, relative to rest, of the chosen trials of a group."""
    batch, found, chosen = group.batch, group.found, set(given["chosen"])
    return [
        (name, batch.position[i, max(int(found.edge_row[i]), 0) : int(batch.rows[i])] - found.position_start[i])
        for i, name in enumerate(batch.trial_id)
        if name in chosen
    ]


def _fit(position: Floats, batch: TrialBatch, trial: int) -> float:
    """Return the fit 100 (1 - |y - found| / |y - mean y|) of a simulated motion to a logged one, NaN without motion."""
    rows = min(len(position), int(batch.rows[trial]) - 1)
    y, found = position[:rows], batch.position[trial, 1 : rows + 1] - batch.position[trial, 0]
    size = float(np.linalg.norm(y - y.mean())) if rows else 0.0
    return 100 * (1 - float(np.linalg.norm(y - found)) / size) if size > 0 else np.nan


def _median(values: Floats) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None


def _fold_of(fitted: FittedDevice | None, chosen: list[str]) -> Integers:
    """Return the fold of each trial: that which a fit left it out in, or the next in turn where none used it."""
    place = {name: i for i, name in enumerate(fitted.trials)} if fitted is not None else {}
    return np.array([place.get(name, i) % FOLDS for i, name in enumerate(chosen)], dtype=np.int64)


def _without_each_fold(stages: ExperimentStages, loop: LoopRange, fitted: FittedDevice | None) -> list[Replayed]:
    """Return the device by the logs of all folds but one.

    That of the ladder stays as it is: it was judged by logs that it was not fitted to.
    """
    if fitted is None:
        return [Replayed(point) for point in _of_single_logs(stages, loop)]
    folds = fitted.folds or ({},) * FOLDS
    period, velocity, found = loop.sampling_period_s, loop.parts.velocity, []
    for fold, quantile in zip(folds, QUANTILES, strict=True):
        values = {**fitted.values, **fold}
        coulomb = values.get("coulomb", 0.0) if "friction" in fitted.parts else 0.0
        coulomb += quantile * fitted.scatter.get("coulomb", 0.0)
        force = values.get("constant_force", 0.0)
        found.append(Replayed(loop_point(fitted, values, period, velocity), max(coulomb, 0.0), force))
    return found


def _of_single_logs(stages: ExperimentStages, loop: LoopRange) -> list[LoopPoint]:
    """Return the loop by the medians of single logs but those of each fold; a delay that is whole stays whole."""
    ids = np.arange(len(stages.column("model", "model_mass")))
    names = {"mass": "mass", "damping": "damping", "delay_samples": "delay"}
    found = []
    for fold in range(FOLDS):
        point = loop.point
        for name, column in names.items():
            values = stages.column("model", f"model_{column}")
            rest, every = _median(values[ids % FOLDS != fold]), _median(values)
            if rest is not None and every is not None:
                point = replace(point, **{name: getattr(point, name) + rest - every})
        found.append(point)
    return found


def _limits_off(result: ExperimentResult, limits: Sequence[LoopLimit]) -> float | None:
    """Return the median error of predicted limits at the dampings at which one was measured [%]."""
    measured = measured_limits(result.boundary)
    known = measured.known & ~measured.censored & (measured.low > 0)
    known &= measured.limit > LOW * measured.limit[known].max(initial=0.0)
    predicted = {each.damping: each.stiffness for each in limits}
    pairs = [
        (predicted[B], limit)
        for B, limit in zip(measured.damping[known], measured.limit[known], strict=True)
        if B in predicted
    ]
    return _median(np.array([100 * abs(value / limit - 1) for value, limit in pairs]))


def _costs_off(result: ExperimentResult, stages: ExperimentStages, chosen: Integers, predicted: Floats) -> float | None:
    """Return the median error of predicted settling times [%], None where none was asked for."""
    if "settle_2pct" not in {*result.optimum, *result.missing}:
        return None
    cost = stages.cost("settle_2pct")[0][chosen]
    with np.errstate(divide="ignore", invalid="ignore"):
        return _median(100 * np.abs(predicted / cost - 1))
