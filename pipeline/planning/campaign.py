"""Trials of an experiment so far, the requested limits, and the starting point of a plan."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from math import floor, inf, log10
from pathlib import Path
from typing import Literal

import numpy as np

from pipeline.base.errors import DeviceError, ParameterError, UsageError
from pipeline.device.loop import Loop
from pipeline.device.parameters import Motion
from pipeline.device.parts import VelocityFilter
from pipeline.device_data.devices import declared_spring, find_experiment, known_devices, read_device
from pipeline.measured.experiment.boundary import spread_over_plane
from pipeline.measured.experiment.identified_loop import IdentifiedLoop, identified_loop, loop_from_row, nominal_loop
from pipeline.measured.identification.final_fit import fit_parts
from pipeline.measured.identification.identifiability import Recorded
from pipeline.measured.identification.identified import check_recordings, described
from pipeline.measured.identification.parts import ChosenParts
from pipeline.measured.identification.parts import choose_parts as look_at_once
from pipeline.measured.identification.recordings import Recording
from pipeline.measured.signal.response import find_response
from pipeline.measured.stages.measured_trial import MeasuredTrial
from pipeline.measured.stages.stage_device import (
    chosen_by_row,
    device_row,
    recording,
    recording_findings,
    usable_recordings,
)
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.measured.student import NORMAL_95
from pipeline.measured.wall_command.wall_law import wall_law
from pipeline.planning.loop_limits import (
    NARROW,
    StepTrial,
    damping_of_stiffest,
    limits_of,
    linear_limits,
    lowest_limits,
)
from pipeline.planning.next_wall import Forecast, TriedWalls
from pipeline.planning.requests import AnsweredWall, stored_requests
from pipeline.records.criteria import MEASURED
from pipeline.records.findings import unsafe_reason
from pipeline.records.models import Device, Experiment
from pipeline.records.trials import Floats, Trials
from pipeline.simulation.tested_grid import tested_grid
from pipeline.store.samples import in_order, load_trials
from pipeline.store.storage import list_experiments, read_trials

DAMPINGS = 12
"""Default number of dampings at which limits are searched for."""

TRIALS = 16
"""Number of logs to which a device is fitted.

A parameter that is accurate to 1 % from one log is accurate to 0.3 % from this number. More logs would take longer to
fit, and the user waits for the result.
"""

FEW = 3
"""Threshold for the number of logs. Below it, a device with friction is not identified reliably, because a different
delay may explain the logs equally well."""

UNSURE = 0.5
"""Threshold for the lowest limit that is consistent with the logs, relative to the limit of the most likely device.

Both are compared at the damping where the most likely device has its largest limit. Below the threshold, the device
counts as unknown.
"""

RANGE = 1.5
"""Default of the largest damping, relative to the damping of the stiffest wall."""

AGAIN = 3
"""Factor by which the number of logs must grow before the parts of the device are selected again."""

Look = Callable[[list[Recording]], ChosenParts | None]
"""Function that selects the parts of a device. It returns None while a selection is running."""

SAME = 0.002
"""Tolerance, relative to the largest damping, within which two dampings count as equal. The tolerance is a tenth of the
usual accuracy."""

AS_SET = 0.25
"""Largest difference between the set and the requested damping, relative to the spacing of the requested dampings."""

START_ERROR = 0.1
"""Error of limits that are predicted from the parameters of a device file, relative to the largest limit."""

NOT_IDENTIFIED = (
    "no device can be identified from the logs: mass and force gain cannot be separated. Record the next "
    "wall, longer logs, or {}."
)
"""Reason and remedy if logs are usable but no device can be identified from them."""

RANGE_NEEDED = (
    "an initial range is needed: give a device file with mass, delay_samples, damping_first and damping_last "
    "(pipeline plan --device my-device.toml; schemas/devices/falcon.toml is an example), or logs of a few walls "
    "(pipeline ingest LOGS), for instance K = 500, 1000 and 2000 N/m at B = 10 Ns/m"
)


@dataclass(frozen=True, eq=False)
class LearntDevice:
    """Parts of the device, the device identified from logs (None if mass or delay is not identifiable), and the number
    of logs when the parts were selected."""

    chosen: ChosenParts
    device: IdentifiedLoop | None
    looked: int


@dataclass(frozen=True)
class PlanOptions:
    """Options of a plan. See `next_wall.PlanGoal` for accuracy and gentleness.

    Parameters
    ----------
    goal : {"boundary", "optimum"}
    criterion : str
        Criterion for the goal ``optimum``.
    count : int
        Number of walls in a batch.
    dampings : tuple of float
        B at which limits are wanted [Ns/m, Nms/rad]. By default, `DAMPINGS` dampings cover the range.
    largest_stiffness, largest_damping, largest_force, travel : float
        Bounds of K [N/m, Nm/rad], of B [Ns/m, Nms/rad], of the command [N, Nm], and of the distance of the start from
        the centre [m, rad].
    """

    goal: Literal["boundary", "optimum"] = "boundary"
    criterion: str = "settle_2pct"
    count: int = 1
    dampings: tuple[float, ...] = ()
    accuracy: float = 0.02
    gentle: bool = False
    largest_stiffness: float = inf
    largest_damping: float = inf
    largest_force: float = inf
    travel: float = inf


BOUNDS = {
    "stiffness": "largest_stiffness",
    "damping": "largest_damping",
    "force": "largest_force",
    "travel": "travel",
}
"""Quantities that bound the trials, with their names in `PlanOptions`."""


def plan_options(
    goal: str, count: int, dampings: Sequence[float], gentle: bool, limits: Mapping[str, float]
) -> PlanOptions:
    """Return the options of a plan for a goal: ``boundary``, ``optimum`` (by settle_2pct), or a criterion.

    Raises
    ------
    UsageError
        If the goal is unknown, a bound is not in `BOUNDS` or not above 0, the number of walls is 0, or a damping is
        negative.
    """
    criterion = "settle_2pct" if goal in ("boundary", "optimum") else goal
    if criterion not in MEASURED:
        raise UsageError(f"goal {goal}: expected boundary, optimum or a criterion: {', '.join(MEASURED)}.")
    if count < 1:
        raise UsageError(f"{count} walls: expected at least 1.")
    for name, value in limits.items():
        if name not in BOUNDS:
            raise UsageError(f"limit of {name}: expected one of {', '.join(BOUNDS)}.")
        if not value > 0:
            raise UsageError(f"limit of {name}: expected a number above 0, found {value:g}.")
    if not all(0 <= B < inf for B in dampings):
        raise UsageError(f"dampings {', '.join(f'{B:g}' for B in dampings)}: expected numbers of 0 or more.")
    kind: Literal["boundary", "optimum"] = "boundary" if goal == "boundary" else "optimum"
    bounds = {BOUNDS[name]: float(value) for name, value in limits.items()}
    return PlanOptions(kind, criterion, count, tuple(map(float, dampings)), gentle=gentle, **bounds)


@dataclass(frozen=True, eq=False)
class Campaign:
    """Trials of an experiment so far, and the starting point of its plan: the experiment in the device file, if any.

    ``found`` is the device identified from its logs, with ``learnt`` as input for the next plan. Without a device,
    ``unknown`` is the reason. ``undecided`` contains the reason for each undecided verdict. ``free`` is the number of
    trials without a wall (K <= 0). ``walls`` are K and B of all trials. ``answers`` are the requested walls with the
    walls that the rig set.
    """

    name: str
    experiment: str
    tried: TriedWalls
    device: Device | None
    of_file: Experiment | None
    sampling_period_s: float
    trial_s: float
    step: float
    motion: Motion
    found: IdentifiedLoop | None = None
    learnt: LearntDevice | None = None
    unknown: str = ""
    undecided: tuple[str, ...] = ()
    free: int = 0
    walls: tuple[tuple[float, float], ...] = ()
    answers: tuple[AnsweredWall, ...] = ()

    @property
    def is_sure(self) -> bool:
        """Whether the logs identify a device reliably. A device that may have friction requires at least `FEW` logs,
        with motion in both directions."""
        if self.found is None:
            return False
        return not self.found.may_have_friction or (not self.few and self.found.directions > 1)

    @property
    def few(self) -> bool:
        """Whether there are fewer than `FEW` logs."""
        logs = self.found.trials if self.found is not None else ()
        return (len(logs) or len(self.tried) + self.free) < FEW


def open_campaign(
    name: str,
    processed: Path,
    experiment: str | None,
    options: PlanOptions,
    known: LearntDevice | None = None,
    look: Look = look_at_once,
) -> Campaign:
    """Return the stored trials of an experiment and the device identified from them. The errors are those of `plan`.

    Parameters
    ----------
    name, processed, experiment, options
        As for `plan`.
    known : LearntDevice, optional
        Device that was identified earlier from fewer logs.
    look : callable
        Function that selects the parts of the device.
    """
    device = read_device(Path(name)) if name.endswith(".toml") else known_devices().get(name)
    name = device.name if device else name
    stored = list_experiments(processed, name) if processed.is_dir() else []
    chosen = _experiment(name, experiment, stored, device)
    of_file = next((e for e in device.experiments if e.name == chosen), None) if device else None
    if chosen not in stored:
        if device is None:
            raise DeviceError(f"device {name!r}: no device file, and no log in {processed}; {RANGE_NEEDED}.")
        of_file = find_experiment(device, chosen)
        nothing = np.empty(0)
        tried = TriedWalls(nothing, nothing, np.empty(0, dtype="<U9"), nothing)
        about = device.sampling_period_s, device.duration_s - device.baseline_s, device.step
        return Campaign(name, chosen, tried, device, of_file, *about, device.motion)
    trials = in_order(read_trials(processed, name, chosen))  # the stages have the same order of rows
    stages = ExperimentStages(processed, name, chosen, trials, spring=declared_spring(device, chosen))
    force = None
    if options.largest_force < inf:
        force = np.array([np.abs(trial.command).max() for trial in load_trials(processed, trials)])
    campaign = campaign_of(stages, device, of_file, options, force)
    K, B = (trials.column(key).to_numpy() for key in ("stiffness", "damping"))
    findings = recording_findings(stages)
    unsafe = np.array([any(each.is_unsafe for each in some) for some in findings], dtype=np.bool_)
    if reason := unsafe_reason(findings):
        raise ParameterError(f"device {name!r}, experiment {chosen!r}: {reason}")
    # Without a wall, the device may reach an end stop. Logs without a wall are used only if no trial has a wall.
    fitted = ~unsafe & ((K > 0) | (not (K > 0).any()))
    fitted = fitted if fitted.any() else ~unsafe
    places = spread_over_plane(K, B, fitted, TRIALS)
    spread = load_trials(processed, trials.take(places))
    if stages.is_stored("device"):
        known = _compared(stages, spread, int(fitted.sum())) or known
    else:
        known = learn(spread, int(fitted.sum()), known, look)
    found = known.device if known else None
    unknown = ""
    if found is None:
        recordings = _recordings(spread)
        unknown = unusable(recordings) or NOT_IDENTIFIED.format(Recorded.of(recordings).remedy())
    walls = tuple(zip(K.tolist(), B.tolist(), strict=True))
    answers = stored_requests(processed, name, chosen).answered(walls)
    return replace(campaign, found=found, learnt=known, unknown=unknown, walls=walls, answers=answers)


def campaign_of(
    stages: ExperimentStages,
    device: Device | None,
    of_file: Experiment | None,
    options: PlanOptions,
    force: Floats | None = None,
) -> Campaign:
    """Return the trials of an experiment with their verdicts, without identifying the device.

    ``force`` is the largest absolute command of each trial [N, Nm]. It is needed only if the command is bounded.
    """
    trials = stages.trials
    columns = [stages.column("response", key) for key in ("stiffness", "damping", "growth_per_s")]
    nothing = np.full(trials.num_rows, np.nan)
    cost = stages.cost(options.criterion)[0] if options.goal == "optimum" else nothing
    K, B, growth = columns
    tried = TriedWalls(K, B, stages.verdicts.verdict, growth, nothing if force is None else force, cost)
    period = float(np.median(trials.column("sampling_period_s").to_numpy()))
    walls = (K > 0) & (B >= 0)
    reasons = stages.verdicts.reason
    return Campaign(
        stages.device,
        stages.experiment,
        tried.select(walls),
        device,
        of_file,
        period,
        float(np.median(trials.column("rows").to_numpy())) * period,
        float(np.max(np.abs(trials.column("step").to_numpy()))),
        next(iter(trials.column("motion").to_pylist()), "translation"),
        undecided=tuple(reasons[i] for i in np.flatnonzero(walls & (tried.verdict == "undecided"))),
        free=int((~walls).sum()),
    )


def _experiment(name: str, requested: str | None, stored: Sequence[str], device: Device | None) -> str:
    if requested is not None:
        return requested
    if len(stored) > 1:
        raise UsageError(
            f"device {name!r} has logs of experiments {', '.join(stored)}. Name an experiment (--experiment)."
        )
    if stored:
        return stored[0]
    return device.experiments[0].name if device else ""


def wanted_dampings(campaign: Campaign, options: PlanOptions) -> tuple[float, ...]:
    """Return the dampings at which limits are wanted: stated dampings, or otherwise evenly spaced or tried dampings.

    Each evenly spaced damping is moved to a nearby damping that was tried, or that is on the grid of the device file.
    A damping that the rig replaced is replaced here in the same way.
    """
    tried = np.unique(campaign.tried.damping)
    of_file = campaign.of_file
    if options.dampings:
        wanted = np.unique(np.array(options.dampings, dtype=np.float64))
    elif of_file is not None:
        assert campaign.device is not None, "the experiment is that of a device file"
        grid = tested_grid(campaign.device, of_file)
        even = np.linspace(grid.damping_first, grid.damping_last, DAMPINGS)
        steps = np.round((even - grid.damping_first) / grid.damping_step)
        wanted = settable_dampings(np.unique(np.maximum(grid.damping_first + steps * grid.damping_step, 0.0)), tried)
    elif len(tried) > DAMPINGS:
        wanted = tried[np.unique(np.round(np.linspace(0, len(tried) - 1, DAMPINGS)).astype(np.int64))]
    elif not len(tried) and campaign.found is not None:
        wanted = damping_range(campaign.found.loop)
    else:
        wanted = tried
    if not len(wanted):
        reason = campaign.unknown or "its logs contain no trial with a wall"
        raise UsageError(f"device {campaign.name!r}: {reason.rstrip('.')}; {RANGE_NEEDED}.")
    wanted = _as_answered(wanted, campaign.answers)
    wanted = wanted[wanted <= options.largest_damping]
    if not len(wanted):
        raise UsageError(
            f"device {campaign.name!r}: no wanted damping is within the bound of B. State smaller dampings "
            "(--dampings 0,20,40), or a larger bound."
        )
    return tuple(wanted.tolist())


def damping_range(loop: Loop) -> Floats:
    """Return dampings over the range of a device [Ns/m, Nms/rad], up to `RANGE` times the damping of its stiffest
    wall."""
    last = RANGE * damping_of_stiffest(loop)
    if not last > 0:
        return np.empty(0)
    unit = 10.0 ** floor(log10(last / DAMPINGS))
    return np.arange(DAMPINGS, dtype=np.float64) * unit * max(round(last / (DAMPINGS - 1) / unit), 1)


def settable_dampings(wanted: Floats, tried: Floats) -> Floats:
    """Return the wanted dampings.

    A wanted damping is replaced by the nearest tried damping if the rig may have set the tried damping instead.
    """
    if not len(tried) or len(wanted) < 2:
        return wanted
    nearest = tried[np.argmin(np.abs(tried[:, None] - wanted), axis=0)]
    return np.unique(np.where(np.abs(nearest - wanted) <= AS_SET * np.diff(wanted).min(), nearest, wanted))


def _as_answered(wanted: Floats, answers: Sequence[AnsweredWall]) -> Floats:
    """Return the wanted dampings. A damping that the rig set instead is used if it is near, or was set twice."""
    near = 0.5 * float(np.diff(wanted).min()) if len(wanted) > 1 else AS_SET * float(wanted.max(initial=0.0))
    result = wanted.copy()
    for place, damping in enumerate(wanted.tolist()):
        got = [answer.got[1] for answer in answers if answer.damping_off and answer.asked[1] == damping]
        if got and (abs(got[-1] - damping) <= near or got.count(got[-1]) > 1):
            result[place] = got[-1]
    return np.unique(result)


def snapped(tried: TriedWalls, dampings: Sequence[float]) -> TriedWalls:
    """Return the trials with each damping rounded to a wanted damping next to it."""
    wanted = np.array(dampings)
    nearest = wanted[np.argmin(np.abs(tried.damping[:, None] - wanted), axis=1)] if len(tried) else tried.damping
    near = np.abs(nearest - tried.damping) <= SAME * float(wanted.max(initial=0.0))
    return replace(tried, damping=np.where(near, nearest, tried.damping))


def forecast_of(campaign: Campaign, dampings: Sequence[float]) -> Forecast | None:
    """Predict the limits for the step from the device identified from the logs, or otherwise from the device file.

    The result is None if neither device is available, or if the limits of the devices consistent with the logs differ
    too much.
    """
    wall = np.array(dampings)
    if campaign.found is not None:
        return _by_logs(campaign, campaign.found, wall)
    if campaign.device is None or campaign.of_file is None:
        return None
    loop = nominal_loop(campaign.device.loop_for(campaign.of_file)).loop
    limit = linear_limits(loop, wall)
    largest = float(limit.max()) or _stiffest(loop)
    if not largest > 0:
        raise DeviceError(f"device {campaign.name!r}: according to its file, no wall is stable; {RANGE_NEEDED}.")
    error = np.full(len(limit), START_ERROR * largest)
    # Without trials, no margin is needed, because the first wall is only a fraction of the limit.
    low = np.maximum(limit - NORMAL_95 * error, 0.0) if len(campaign.tried) else limit
    return Forecast(limit, error, low=low, scale=largest)


def _stiffest(loop: Loop) -> float:
    """Return the largest stable stiffness of the linear loop [N/m, Nm/rad], or 0 if there is none."""
    return float(linear_limits(loop, np.array([damping_of_stiffest(loop)]))[0])


def _by_logs(campaign: Campaign, device: IdentifiedLoop, wall: Floats) -> Forecast | None:
    trial = StepTrial(campaign.step, round(campaign.trial_s / campaign.sampling_period_s))
    limit, reach = limits_of(device, wall, trial)
    linear, linear_reach = limits_of(device, wall)
    # The step of future trials is unknown until there is a trial with a wall.
    known = np.isfinite(limit) & (len(campaign.tried) > 0 or not campaign.free)
    limit, reach = np.where(known, limit, linear), np.where(known, reach, linear_reach)
    lowest, best = lowest_limits(device, wall), int(np.argmax(linear))
    unsure = bool(lowest[best] < UNSURE * linear[best])
    if unsure and len(campaign.tried):
        return None
    if campaign.is_sure and not unsure:
        # Known friction raises the limit for the step.
        by_friction = np.sqrt(np.maximum(reach**2 - linear_reach**2, 0.0))
        raised = limit - np.hypot(linear - lowest, by_friction)
        # If the linear limit is uncertain, its increase by friction is also uncertain.
        lowest = np.where(linear - lowest <= NARROW * linear, np.maximum(raised, lowest), lowest)
    scale = float(limit.max())
    if not scale > 0 and not len(campaign.tried):
        scale = _stiffest(device.loop)
        if not scale > 0:
            raise DeviceError(f"device {campaign.name!r}: according to its logs, no wall is stable; {RANGE_NEEDED}.")
    return Forecast(limit, reach / NORMAL_95, low=np.minimum(lowest, limit), scale=scale)


def learn(trials: Trials, count: int, known: LearntDevice | None, look: Look) -> LearntDevice | None:
    """Identify the device from trials of an experiment, starting from the device identified from fewer trials.

    Parameters
    ----------
    trials : Trials
        Trials with K > 0 or, if there are none, trials without a wall. All stored trials of this kind are given, or
        `TRIALS` of them that are spread over the walls.
    count : int
        Number of stored trials of this kind.
    known : LearntDevice or None
    look : callable
        Function that is called if the parts of the device are unknown, or were selected from at most a third of the
        logs.
    """
    order = np.lexsort((trials.stiffness, trials.damping))
    spread = trials.select(order[np.unique(np.linspace(0, len(order) - 1, TRIALS).astype(np.int64))])
    recordings = _recordings(spread)
    if unusable(recordings):
        return known
    chosen, looked = (None, 0) if known is None else (known.chosen, known.looked)
    try:
        fresh = look(recordings) if count >= AGAIN * looked else None
        chosen, looked = (chosen, looked) if fresh is None else (fresh, count)
        if chosen is None:
            return None
        found = described(recordings, fit_parts(recordings, chosen))
    except (ParameterError, np.linalg.LinAlgError):
        # If the fit fails, the device known so far is kept.
        return known
    if found.unidentifiable & {"mass", "delay_samples"}:
        return LearntDevice(chosen, None, looked)
    row = device_row(found, Recorded.of(recordings).remedy(), float(np.abs(trials.step).max(initial=0.0)))
    device = loop_from_row(asdict(row), float(np.median(trials.sampling_period_s)))
    velocity = known.device.velocity if known is not None and known.device is not None else None
    velocity = _velocity_filter(spread) if velocity is None else velocity
    device = replace(device, velocity=velocity, directions=Recorded.of(recordings).directions)
    return LearntDevice(chosen, device, looked)


def _compared(stages: ExperimentStages, spread: Trials, count: int) -> LearntDevice | None:
    """Return the device that a comparison has identified from the same trials, or None if it has no mass or delay.

    A plan then expects the limits that the report of this comparison states.
    """
    (row,) = stages.table("parts").to_pylist()
    device = stages.once(identified_loop)
    if row["reason"] or device is None or "delay_samples" in device.unidentifiable:
        return None
    directions = Recorded.of(_recordings(spread)).directions
    return LearntDevice(
        chosen_by_row(row), replace(device, velocity=_velocity_filter(spread), directions=directions), count
    )


def _velocity_filter(trials: Trials) -> VelocityFilter | None:
    """Return the velocity filter that the trial with the largest damping shows best, or None if it shows none."""
    most = trials[int(np.argmax(trials.damping))]
    shown = wall_law(most, find_response(most)).filter
    return None if shown is None else shown.declared


def unusable(recordings: list[Recording]) -> str:
    """Return why no device can be identified from recordings, with the remedy, or "" if a device can be identified."""
    try:
        check_recordings(recordings)
    except ParameterError as error:
        return str(error)
    return ""


def _recordings(trials: Trials) -> list[Recording]:
    """Return usable trials as input of the estimator, sorted by rank. If none is usable, return all."""
    measured = [MeasuredTrial(trial) for trial in trials]
    return sorted(usable_recordings(measured) or map(recording, measured), key=lambda each: each.rank)
