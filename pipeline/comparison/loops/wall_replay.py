"""Replay the identified device at tested walls that were left out of its fit, and compute the errors of the
predictions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from statistics import NormalDist

import numpy as np

from pipeline.base.progress import report
from pipeline.base.wording import counted
from pipeline.comparison.limits import measured_limits
from pipeline.comparison.loops.loop_basis import LoopBasis, identified_device
from pipeline.device.loop import Loop
from pipeline.measured.cost.costs import settling
from pipeline.measured.experiment.boundary import spread_over_plane
from pipeline.measured.experiment.identified_loop import IdentifiedLoop
from pipeline.measured.identification.scatter import FOLDS
from pipeline.measured.signal.release import find_release
from pipeline.measured.signal.response import find_response
from pipeline.measured.signal.verdict import judge
from pipeline.measured.stages.measured_trial import MeasuredTrial, about
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.planning.loop_limits import StepTrial, linear_limits, simulate_behind
from pipeline.records.findings import MATTERS, Limit
from pipeline.records.results import LoopFindings, MeasuredExperiment, ReplayResiduals, WallReplay
from pipeline.records.trials import Booleans, Floats, Integers, Trial
from pipeline.rendering.labels import share_text, significant

MOST_WALLS = 150
"""Largest number of replayed trials, spread over the tested walls. A share of 95 % is then accurate to 2 %."""

REPEATS = 4
"""Number of runs for each wall of a device with jitter. A verdict counts only if all runs agree."""

QUANTILES = [NormalDist().inv_cdf((fold + 0.5) / FOLDS) for fold in range(FOLDS)]
"""Friction in the trials of each fold, in standard deviations of its scatter, at equally probable quantiles."""

LOW = 0.25
"""Smallest limit, relative to the largest, that is compared in percent. A boundary tends to zero at its ends."""


def usual_trial(result: MeasuredExperiment, stages: ExperimentStages) -> StepTrial:
    """Return the usual trial of an experiment, with the jitter of its logs, and the sensor resolution if it matters."""
    jitter, share = result.estimates.get("jitter_samples"), coarse(stages)
    matters = len(share) and float(np.median(share)) > MATTERS
    return StepTrial(
        step=usual_step(stages),
        rows=int(np.median(stages.trials.column("rows").to_numpy())),
        quantum=float(np.nanmedian(stages.column("response", "sensor_quantum"))) if matters else 0.0,
        jitter=(jitter.value or 0.0) if jitter is not None and (jitter.low or 0.0) > 0 else 0.0,
    )


def usual_step(stages: ExperimentStages) -> float:
    """Return the usual size of a step [N, Nm], > 0. Steps in both directions count by their magnitudes.

    For trials without a step, it is the equivalent force of the excitation, or 1 if that is unknown.
    """
    size = np.abs(stages.step_sizes)
    size = size[size > 0]
    if not len(size):
        size = np.array(stages.map_trials(excitation))
        size = size[np.isfinite(size) & (size > 0)]
    return float(np.median(size)) if len(size) else 1.0


def excitation(of: MeasuredTrial) -> float:
    """Return the equivalent force of the excitation of a trial without a step [N, Nm], or NaN if unknown."""
    return find_release(of.trial).size


def softest(result: MeasuredExperiment, stages: ExperimentStages) -> Floats:
    """Return half the stiffness of the softest tested wall at each tested damping [N/m, Nm/rad]."""
    K, B = (stages.column("response", name) for name in ("stiffness", "damping"))
    least = np.array([K[(K > 0) & (each.damping == B)].min(initial=np.inf) for each in result.boundary])
    return 0.5 * np.where(np.isfinite(least), least, 0.0)


def coarse(stages: ExperimentStages) -> Floats:
    """Return the sensor resolution relative to the final displacement of each stable trial, shape (n,)."""
    moved = stages.column("response", "position_final_expected") - stages.column("response", "position_start")
    stable = (stages.verdicts.verdict == "stable") & np.isfinite(moved) & (moved != 0)
    return np.asarray(stages.column("response", "sensor_quantum")[stable] / np.abs(moved[stable]), dtype=np.float64)


def wall_replay(
    result: MeasuredExperiment, stages: ExperimentStages, device: IdentifiedLoop, limits: Floats, trial: StepTrial
) -> WallReplay | None:
    """Return the cross-validated predictions of an identified device at the tested walls, or None without a wall.

    Parameters
    ----------
    result : MeasuredExperiment
    stages : ExperimentStages
    device : IdentifiedLoop
    limits : float64, shape (n,)
        Limits at the tested dampings, as predicted by the device that was identified from all logs.
    trial : StepTrial

    Notes
    -----
    The walls of a fold are simulated with the device identified from the other folds, with friction drawn from its
    scatter. Verdicts are compared if both log and simulation are decided. Two kinds of walls are left out: walls within
    the interval of a measured limit, and walls at which jitter changes the simulated verdict between runs.
    """
    K, B = (stages.column("response", name) for name in ("stiffness", "damping"))
    verdict = stages.verdicts.verdict
    usable = (K > 0) & (verdict != "undecided") & np.isnan(stages.column("wall_law", "obeyed_stiffness"))
    usable &= ~_of_chance(result, K, B)
    chosen = spread_over_plane(K, B, usable, MOST_WALLS)
    if not len(chosen):
        return None
    ids = stages.texts("response", "trial_id")
    place = {name: i for i, name in enumerate(device.trials)}
    # Use the fold whose fit left the trial out. Trials that no fit used are assigned to the folds in turn.
    fold = np.array([place.get(ids[i], number) % FOLDS for number, i in enumerate(chosen)])
    predicted_verdict, fits, costs = (
        np.empty(len(chosen), dtype="<U9"),
        np.full(len(chosen), np.nan),
        np.full(len(chosen), np.nan),
    )
    steps = stages.step_sizes
    repeats = REPEATS if trial.jitter else 1
    logged = stages.map_trials(motion, chosen.tolist())
    for number, loop in enumerate(_without_each_fold(device)):
        some = np.flatnonzero(fold == number)
        report(number / FOLDS)
        if not len(some):
            continue
        walls = chosen[some]
        runs = [_behind(loop, K[walls], B[walls], steps[walls], trial, run) for run in range(repeats)]
        for i, simulated, *others in zip(some.tolist(), *runs, strict=True):
            # With a spring on the device, it comes to rest at x_0 + F_0/(K + k).
            simulated = replace(simulated, stiffness=simulated.stiffness + loop.stiffness)
            response = find_response(simulated)
            judged = judge(simulated, response)
            same = all(judge(other).verdict == judged.verdict for other in others)
            predicted_verdict[i] = judged.verdict if same else "undecided"
            fits[i] = _fit(logged[i], simulated)
            counted_about = about(response, stages.measuring.final)
            costs[i] = settling(simulated, counted_about, judged, int(loop.delay_samples))["settle_2pct"].value
    stable = (verdict[chosen] == "stable") & (predicted_verdict == "stable")
    decided = predicted_verdict != "undecided"
    off, known, outside = _limit_errors(result, limits)
    return WallReplay(
        fit_percent=median(fits[stable]),
        verdicts_same=float((predicted_verdict == verdict[chosen])[decided].mean()) if decided.any() else None,
        limits_off_percent=median(off),
        limits_known_percent=median(known),
        limits_error_percent=float(np.quantile(outside, 0.95)) if len(outside) else None,
        costs_off_percent=_costs_off(result, stages, chosen[stable], costs[stable]),
        trials=int(decided.sum()),
        residuals=_residuals(K[chosen[stable]], B[chosen[stable]], 100 - fits[stable]),
    )


def _residuals(K: Floats, B: Floats, percent: Floats) -> ReplayResiduals:
    """Return the known residuals of a replay, rounded to three digits."""
    known = np.isfinite(percent)
    rounded = [float(f"{value:.3g}") for value in percent[known].tolist()]
    return ReplayResiduals(stiffness=tuple(K[known].tolist()), damping=tuple(B[known].tolist()), percent=tuple(rounded))


def _behind(loop: Loop, K: Floats, B: Floats, steps: Floats, trial: StepTrial, run: int) -> list[Trial]:
    """Return simulated trials of a device at walls.

    Each has the step of its log, because friction and a constant force are nonlinear. A log without a step has the
    usual step.
    """
    steps = np.where(steps != 0, steps, trial.step)
    trials: dict[int, Trial] = {}
    for step in np.unique(steps):
        some = np.flatnonzero(steps == step)
        simulated = simulate_behind(loop, K[some], B[some], replace(trial, step=float(step)), run)
        trials |= dict(zip(some.tolist(), simulated, strict=True))
    return [trials[place] for place in range(len(steps))]


def _of_chance(result: MeasuredExperiment, K: Floats, B: Floats) -> Booleans:
    """Return a mask of the walls within the interval of the limit measured at their damping, shape (n,)."""
    limits = measured_limits(result.boundary)
    ends = dict(zip(limits.damping.tolist(), zip(limits.low.tolist(), limits.high.tolist(), strict=True), strict=True))
    low, high = np.array([ends.get(each, (0.0, 0.0)) for each in B.tolist()]).reshape(-1, 2).T
    return np.asarray((low < K) & (high > K))


def _without_each_fold(device: IdentifiedLoop) -> list[Loop]:
    """Return the device identified with each fold left out in turn, with friction at a different quantile per fold."""
    name, loops = "friction.coulomb", []
    for fold, quantile in zip(device.folds or ({},) * FOLDS, QUANTILES, strict=True):
        values: Mapping[str, float] = {**device.values, **fold}
        scattered = values.get(name, 0.0) + quantile * device.scatter.get(name, 0.0)
        loops.append(device.at({**values, name: max(scattered, 0.0)}))
    return loops


def replay_error(replay: WallReplay | None) -> float:
    """Return the 95 % quantile of the relative error of replayed limits, or 0 without a replay."""
    return (replay.limits_error_percent or 0.0) / 100 if replay is not None else 0.0


def replay_words(replay: WallReplay) -> str:
    """Return a clause that states how well an identified device predicts walls."""
    verdicts = share_text(replay.verdicts_same or 0.0, 0)
    walls = counted(replay.trials, "wall")
    text = f"at {walls} left out of its fit, the identified device predicts {verdicts} % of verdicts"
    off, known = replay.limits_off_percent, replay.limits_known_percent
    if off is None:
        return text
    if known is not None and replay.limits_open:
        return f"{text} and limits within the brackets of the tested walls, {significant(known, 2)} % to either side"
    return f"{text} and limits within {significant(off, 2)} %"


def limits_with_intervals(
    result: MeasuredExperiment, basis: LoopBasis, limits: Sequence[tuple[Floats, Floats]]
) -> tuple[Limit, ...]:
    """Return the limits of a loop at the tested dampings with their intervals.

    If the limits of the linear loop differ, they are included.
    """
    damping = np.array([each.damping for each in result.boundary])
    stiffness, linear, (low, high) = limits[0][0], linear_limits(basis.loop, damping), basis.band(limits)
    apart = not np.array_equal(stiffness, linear)
    rows = zip(damping.tolist(), stiffness.tolist(), low.tolist(), high.tolist(), linear.tolist(), strict=True)
    return tuple(
        Limit(damping=B, stiffness=K, low=a, high=b, stiffness_large_motion=far if apart else None)
        for B, K, a, b, far in rows
        if np.isfinite(K)
    )


def large_motion_limits(
    measured: MeasuredExperiment, findings: LoopFindings, stages: ExperimentStages
) -> dict[float, float | None]:
    """Return the linear limit at each tested damping, or {} if the logs show no friction.

    The effect of Coulomb friction decreases with the size of a motion, and is negligible for a large motion.
    """
    has_friction = any(cause.code == "coulomb_friction" for cause in findings.causes)
    device = stages.once(identified_device) if has_friction else None
    if device is None:
        return {}
    B = [point.damping for point in measured.boundary]
    linear = dict(zip(B, linear_limits(device.loop, np.array(B)).tolist(), strict=True)) if B else {}
    return linear | {each.damping: each.stiffness_large_motion for each in findings.loop_boundary or ()}


def limits_off(result: MeasuredExperiment, predicted: Floats) -> float | None:
    """Return the median error of predicted limits at the dampings with a measured limit [%]."""
    return median(_limit_errors(result, predicted)[0])


def _limit_errors(result: MeasuredExperiment, predicted: Floats) -> tuple[Floats, Floats, Floats]:
    """Return errors of predicted limits, half widths of measured intervals, and distances outside intervals [%]."""
    measured = measured_limits(result.boundary)
    some = measured.known & ~measured.censored & (measured.low > 0)
    some &= measured.limit > LOW * measured.limit[some].max(initial=0.0)
    at = dict(zip([each.damping for each in result.boundary], predicted.tolist(), strict=True))
    ahead = np.array([at.get(B, np.nan) for B in measured.damping[some].tolist()])
    limit, low, high = (each[some] for each in (measured.limit, measured.low, measured.high))
    outside = np.maximum(np.maximum(low - ahead, ahead - high), 0.0)
    off, known, outside = (100 * each / limit for each in (np.abs(ahead - limit), 0.5 * (high - low), outside))
    return off, known, outside[np.isfinite(outside)]


def motion(of: MeasuredTrial) -> Floats:
    """Return the positions of a trial from the step onward, relative to rest, shape (rows,) [m, rad]."""
    return of.trial.position[max(of.response.edge_row, 0) :] - of.response.position_start


def _fit(position: Floats, simulated: Trial) -> float:
    """Return the fit 100 (1 - |y - found| / |y - mean y|) of a simulated to a logged motion, or NaN without motion."""
    rows = min(len(position), simulated.rows - 1)
    y, found = position[:rows], simulated.displacement[1 : rows + 1]
    size = float(np.linalg.norm(y - y.mean())) if rows else 0.0
    return 100 * (1 - float(np.linalg.norm(y - found)) / size) if size > 0 else np.nan


def median(values: Floats) -> float | None:
    """Return the median of the known values, or None if there are none."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None


def _costs_off(
    result: MeasuredExperiment, stages: ExperimentStages, chosen: Integers, predicted: Floats
) -> float | None:
    """Return the median error of predicted settling times [%], or None if they are not requested."""
    if "settle_2pct" not in {*result.optimum, *result.missing}:
        return None
    cost = stages.cost("settle_2pct")[0][chosen]
    with np.errstate(divide="ignore", invalid="ignore"):
        return median(100 * np.abs(predicted / cost - 1))
