"""Trials of one experiment so far, what is asked for, and where it begins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path
from typing import Literal

import numpy as np

from pipeline.base.errors import DeviceError, UsageError
from pipeline.device_data.devices import declared_spring, find_experiment, known_devices, read_device
from pipeline.measured.experiment.boundary import spread_over_plane
from pipeline.measured.intervals import NORMAL_95
from pipeline.measured.model.parts import chosen as look_at_once
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.plan.found_device import FoundDevice, Trial, stated_device
from pipeline.plan.learnt import TRIALS, Learnt, Look, learn
from pipeline.plan.limits import Forecast
from pipeline.plan.requests import NOTHING_ASKED, Requests, Wall, read_requests, requests_folder, walls_of
from pipeline.plan.verdicts import Tried
from pipeline.records.batch import Floats, TrialBatch
from pipeline.records.models import Device, Experiment
from pipeline.store.samples import load_groups
from pipeline.store.storage import list_experiments, read_trials
from pipeline.theory.cases import tested_grid

DAMPINGS = 12
"""Dampings at which limits are looked for where none are named."""

START_ERROR = 0.1
"""Error of limits by the parameters of a device file, relative to the largest."""

RANGE_NEEDED = (
    "a range to start from is needed: a device file with mass, delay_samples, damping_first and damping_last "
    "(pipeline plan --device my-device.toml; schemas/devices/falcon.toml is an example), or logs of some walls "
    "(pipeline ingest LOGS), for instance K = 500, 1000 and 2000 N/m at B = 10 Ns/m"
)


@dataclass(frozen=True)
class Wish:
    """What the planner is asked for; see `limits.Aim` for accuracy and gentleness.

    Parameters
    ----------
    goal : {"boundary", "optimum"}
    criterion : str
        Criterion of the goal ``optimum``.
    count : int
        Walls of a batch.
    dampings : tuple of float
        B at which limits are wanted [Ns/m, Nms/rad]; by default `DAMPINGS` of them over the range.
    largest_stiffness, largest_damping, largest_force, travel : float
        What may be tried: K [N/m, Nm/rad], B [Ns/m, Nms/rad], command [N, Nm] and distance of the start from the
        centre [m, rad].
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


@dataclass(frozen=True, eq=False)
class Course:
    """Trials of one experiment so far, and where it started: the file's experiment where there is one.

    ``found`` is the device that its logs show, with what was ``learnt`` for the next one; ``walls`` are those of all
    logs, and ``requests`` what was asked for.
    """

    name: str
    experiment: str
    tried: Tried
    device: Device | None
    of_file: Experiment | None
    sampling_period_s: float
    trial_s: float
    step: float
    rotation: bool
    found: FoundDevice | None = None
    learnt: Learnt | None = None
    walls: tuple[Wall, ...] = ()
    requests: Requests = NOTHING_ASKED


def open_course(
    name: str,
    processed: Path,
    experiment: str | None,
    wish: Wish,
    known: Learnt | None = None,
    look: Look = look_at_once,
    requests: Requests | None = None,
) -> Course:
    """Return the stored trials of an experiment; errors as of `plan`.

    Parameters
    ----------
    name, processed, experiment, wish
        As of `plan`.
    known : Learnt, optional
        The device that fewer logs have shown.
    look : callable
        What looks for the parts of the device.
    requests : Requests, optional
        What was asked for so far; by default what the store says.
    """
    device = read_device(Path(name)) if name.endswith(".toml") else known_devices().get(name)
    name = device.name if device else name
    stored = list_experiments(processed, name) if processed.is_dir() else []
    chosen = _experiment(name, experiment, stored, device)
    of_file = next((e for e in device.experiments if e.name == chosen), None) if device else None
    requests = requests if requests is not None else read_requests(requests_folder(processed, name, chosen))
    if chosen not in stored:
        if device is None:
            raise DeviceError(f"device {name!r}: no device file and no log of it in {processed}; {RANGE_NEEDED}.")
        of_file = find_experiment(device, chosen)
        nothing = np.empty(0)
        tried = Tried(nothing, nothing, np.empty(0, dtype="<U9"), nothing)
        about = device.sampling_period_s, device.duration_s - device.baseline_s, device.step
        return Course(name, chosen, tried, device, of_file, *about, device.motion == "rotation", requests=requests)
    trials = read_trials(processed, name, chosen)
    stages = ExperimentStages(processed, name, chosen, trials, spring=declared_spring(device, chosen))
    force = None
    if wish.largest_force < inf:
        force = np.full(trials.num_rows, np.nan)
        groups = load_groups(processed, trials)
        for rows, batch in zip(groups.places, groups.parts, strict=True):
            force[rows] = np.nanmax(np.abs(batch.command), axis=1)
    course = course_of(stages, device, of_file, wish, force)
    K, B = (trials.column(key).to_numpy() for key in ("stiffness", "damping"))
    places = spread_over_plane(K, B, K > 0, TRIALS)
    if len(places):
        batch = TrialBatch.joined(list(load_groups(processed, trials.take(places)).parts))
        known = learn(batch, int((K > 0).sum()), known, look)
    found = known.device if known else None
    return replace(course, found=found, learnt=known, requests=requests.answered(course.walls))


def course_of(
    stages: ExperimentStages,
    device: Device | None,
    of_file: Experiment | None,
    wish: Wish,
    force: Floats | None = None,
) -> Course:
    """Return the trials of an experiment as verdicts alone tell of them: no device learnt, nothing asked before.

    ``force`` is the largest absolute command of each trial [N, Nm], where it matters.
    """
    trials = stages.trials
    columns = [stages.column("response", key) for key in ("stiffness", "damping", "growth_per_s")]
    nothing = np.full(trials.num_rows, np.nan)
    cost = stages.cost(wish.criterion)[0] if wish.goal == "optimum" else nothing
    K, B, growth = columns
    tried = Tried(K, B, stages.verdicts.verdict, growth, nothing if force is None else force, cost)
    period = float(np.median(trials.column("sampling_period_s").to_numpy()))
    return Course(
        stages.device,
        stages.experiment,
        tried.select((K > 0) & (B >= 0)),
        device,
        of_file,
        period,
        float(np.median(trials.column("rows").to_numpy())) * period,
        float(np.max(np.abs(trials.column("step").to_numpy()))),
        "rotation" in trials.column("motion").to_pylist(),
        walls=walls_of(K, B),
    )


def _experiment(name: str, asked: str | None, stored: Sequence[str], device: Device | None) -> str:
    if asked is not None:
        return asked
    if len(stored) > 1:
        raise UsageError(f"device {name!r} has logs of experiments {', '.join(stored)}: name one (--experiment).")
    if stored:
        return stored[0]
    return device.experiments[0].name if device else ""


def wanted_dampings(course: Course, wish: Wish) -> tuple[float, ...]:
    """Return the dampings at which limits are looked for: those named, else even ones of the range, or those tried.

    Even ones are moved to dampings that were tried within half their distance, else to steps of the file.
    """
    tried = np.unique(course.tried.damping)
    of_file = course.of_file
    if wish.dampings:
        wanted = np.unique(np.array(wish.dampings, dtype=np.float64))
    elif of_file is not None:
        assert course.device is not None, "of which the experiment was found"
        grid = tested_grid(course.device, of_file)
        even = np.linspace(grid.damping_first, grid.damping_last, DAMPINGS)
        steps = np.round((even - grid.damping_first) / grid.damping_step)
        wanted = np.unique(np.maximum(grid.damping_first + steps * grid.damping_step, 0.0))
        if len(tried):
            near = tried[np.abs(tried - wanted[:, None]).argmin(axis=1)]
            wanted = np.unique(np.where(2 * np.abs(near - wanted) <= even[1] - even[0], near, wanted))
    elif len(tried) > DAMPINGS:
        wanted = tried[np.unique(np.round(np.linspace(0, len(tried) - 1, DAMPINGS)).astype(np.int64))]
    else:
        wanted = tried
    wanted = wanted[wanted <= wish.largest_damping]
    if not len(wanted):
        raise UsageError(f"device {course.name!r}: no damping is left to try. Name some (--dampings 0,20,40).")
    return tuple(wanted.tolist())


def foretold(course: Course, dampings: Sequence[float]) -> Forecast | None:
    """Return the limits by the device that the logs show, for the step, else by its file; None without both."""
    wall = np.array(dampings)
    if course.found is not None:
        step = Trial(course.step, round(course.trial_s / course.sampling_period_s))
        limit, reach = course.found.limits(wall, step)
        linear, linear_reach = course.found.limits(wall)
        known = np.isfinite(limit)
        return Forecast(np.where(known, limit, linear), np.where(known, reach, linear_reach) / NORMAL_95)
    if course.device is None or course.of_file is None:
        return None
    point = stated_device(course.device, course.of_file).point
    limit = point.limit(wall)
    largest = float(limit.max()) or float(point.limit(np.array([point.stiffest]))[0])
    if not largest > 0:
        raise DeviceError(f"device {course.name!r}: by its file no wall is stable; {RANGE_NEEDED}.")
    return Forecast(limit, np.full(len(limit), START_ERROR * largest))
