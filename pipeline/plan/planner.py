"""Reads what is stored of an experiment and says which walls to try next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, floor, inf, log10
from pathlib import Path
from typing import Literal

import numpy as np

from pipeline.base.errors import DeviceError, UsageError
from pipeline.device_data.devices import declared_spring, find_experiment, known_devices, read_device
from pipeline.loop.loop import Normalised
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.plan.answer import Limit, Next, Plan
from pipeline.plan.limits import Aim, Column, State, order, state
from pipeline.plan.model import Forecast, Range
from pipeline.plan.optimum import next_walls
from pipeline.plan.verdicts import Tried
from pipeline.records.batch import Floats
from pipeline.records.models import Device, Experiment
from pipeline.store.samples import load_groups
from pipeline.store.storage import list_experiments, read_trials
from pipeline.theory.stability.stability import boundary

DAMPINGS = 12
"""Dampings at which limits are looked for where none are named."""

START_ERROR = 0.1
"""Relative error of a limit by the parameters of a device file."""

FIRST_SHARE = 0.3
"""Share of the limit at which the search for an optimum begins."""

SURE = 0.75
"""Chance from which on a verdict is expected."""

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
    """Trials of one experiment so far, and where it started: the file's experiment where there is one."""

    name: str
    experiment: str
    tried: Tried
    device: Device | None
    of_file: Experiment | None
    sampling_period_s: float
    trial_s: float
    step: float
    rotation: bool


def plan(name: str, processed: Path, experiment: str | None = None, wish: Wish | None = None) -> Plan:
    """Return which walls to try next.

    Parameters
    ----------
    name : str
        Device by name, or a device file.
    processed : Path
        Folder of the stored tables; need not be there yet.
    experiment : str, optional
        By default the only one that is stored, else the first of the device file.
    wish : Wish, optional

    Raises
    ------
    DeviceError
        If neither a device file nor a log tells where to start, or the experiment is not known.
    UsageError
        If several experiments are stored and none is named, or a limit leaves nothing to try.
    """
    wish = wish or Wish()
    course = open_course(name, processed, experiment, wish)
    return plan_of(course, wish)


def plan_of(course: Course, wish: Wish) -> Plan:
    """Return which walls to try next, from trials that are in memory."""
    dampings = wanted_dampings(course, wish)
    aim = Aim(
        dampings,
        wish.accuracy,
        wish.gentle,
        lowest=0.0 if wish.travel == inf else course.step / wish.travel,
        highest=wish.largest_stiffness,
        force=wish.largest_force,
    )
    if aim.lowest >= aim.highest:
        raise UsageError(
            f"a travel of {wish.travel:g} needs K of at least F_0/travel = {aim.lowest:g}, and at most {aim.highest:g} "
            "is allowed: no wall is left to try. Allow more travel or stiffness, or take a smaller step."
        )
    around, start = beginning(course, dampings)
    found = state(course.tried, aim, around, start)
    used = len(course.tried)
    limits = tuple(
        Limit(damping=c.damping, estimate=c.estimate, low=c.bracket.low, high=c.bracket.high) for c in found.columns
    )
    if wish.goal == "optimum":
        # no number says when a search for the best cost is over, so that it does not say so itself
        chosen, done = _optimum(course, wish, found, aim), False
        left = float(len(chosen))
    else:
        chosen = tuple(_next(found.columns[i], found, aim, course) for i in order(found.columns)[: wish.count])
        done, left = found.done, found.trials_left
    return Plan(next=chosen, done=done, boundary=limits, trials_used=used, trials_expected=used + ceil(left))


def open_course(name: str, processed: Path, experiment: str | None, wish: Wish) -> Course:
    """Return the stored trials of an experiment; errors as of `plan`."""
    device = read_device(Path(name)) if name.endswith(".toml") else known_devices().get(name)
    name = device.name if device else name
    stored = list_experiments(processed, name) if processed.is_dir() else []
    chosen = _experiment(name, experiment, stored, device)
    of_file = next((e for e in device.experiments if e.name == chosen), None) if device else None
    if chosen not in stored:
        if device is None:
            raise DeviceError(f"device {name!r}: no device file and no log of it in {processed}; {RANGE_NEEDED}.")
        of_file = find_experiment(device, chosen)
        nothing = np.empty(0)
        tried = Tried(nothing, nothing, np.empty(0, dtype="<U9"), nothing)
        about = device.sampling_period_s, device.duration_s - device.baseline_s, device.step
        return Course(name, chosen, tried, device, of_file, *about, device.motion == "rotation")
    trials = read_trials(processed, name, chosen)
    stages = ExperimentStages(processed, name, chosen, trials, spring=declared_spring(device, chosen))
    columns = {key: stages.column("response", key) for key in ("stiffness", "damping", "growth_per_s")}
    cost = stages.cost(wish.criterion)[0] if wish.goal == "optimum" else np.full(len(columns["stiffness"]), np.nan)
    force = np.full(len(cost), np.nan)
    if wish.largest_force < inf:
        groups = load_groups(processed, trials)
        for rows, batch in zip(groups.places, groups.parts, strict=True):
            force[rows] = np.nanmax(np.abs(batch.command), axis=1)
    tried = Tried(
        columns["stiffness"],
        columns["damping"],
        stages.verdicts.verdict,
        columns["growth_per_s"],
        force,
        cost,
    )
    period = float(np.median(trials.column("sampling_period_s").to_numpy()))
    return Course(
        name,
        chosen,
        tried.select((tried.stiffness > 0) & (tried.damping >= 0)),
        device,
        of_file,
        period,
        float(np.median(trials.column("rows").to_numpy())) * period,
        float(np.max(np.abs(trials.column("step").to_numpy()))),
        "rotation" in trials.column("motion").to_pylist(),
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

    Even ones are moved to dampings that the file's steps reach, or that were tried, where those are near.
    """
    tried = np.unique(course.tried.damping)
    of_file = course.of_file
    if wish.dampings:
        wanted = np.unique(np.array(wish.dampings, dtype=np.float64))
    elif of_file is not None:
        even = np.linspace(of_file.damping_first, of_file.damping_last, DAMPINGS)
        steps = np.round((even - of_file.damping_first) / of_file.damping_step)
        wanted = np.unique(np.maximum(of_file.damping_first + steps * of_file.damping_step, 0.0))
    elif len(tried) > DAMPINGS:
        wanted = tried[np.unique(np.round(np.linspace(0, len(tried) - 1, DAMPINGS)).astype(np.int64))]
    else:
        wanted = tried
    wanted = wanted[wanted <= wish.largest_damping]
    if not len(wanted):
        raise UsageError(f"device {course.name!r}: no damping is left to try. Name some (--dampings 0,20,40).")
    return tuple(wanted.tolist())


def beginning(course: Course, dampings: Sequence[float]) -> tuple[Range, Forecast | None]:
    """Return where limits are looked for, and without any trial what the device file says of them."""
    tried, reach = course.tried, 1.1 * max(*dampings, 0.0, 1e-6) if len(dampings) > 1 else 2 * max(dampings[0], 1e-6)
    about = course.sampling_period_s, course.trial_s
    if len(tried):
        stable = tried.stiffness[tried.verdict == "stable"]
        near = stable.max() if len(stable) else tried.stiffness.max()
        return Range(float(near), reach, *about), None
    assert course.of_file is not None, "without logs there is a device file"
    of = course.of_file
    scale = Normalised(of.mass, course.sampling_period_s)
    curve = boundary(scale.loop(of.stiffness, of.damping, of.delay_samples))
    limit = np.interp(dampings, curve.beta * scale.damping, curve.alpha * scale.stiffness, right=0.0)
    largest = float(curve.alpha_max * scale.stiffness)
    error = START_ERROR * np.maximum(limit, 0.3 * largest)
    return Range(largest, reach, *about), Forecast(np.maximum(limit, 0.0), error, START_ERROR)


def rounded(wall: float, width: float) -> float:
    """Return a stiffness with no more digits than its purpose needs.

    Examples
    --------
    >>> rounded(12345.678, 500.0)
    12350.0
    """
    unit = 10.0 ** floor(log10(max(width, 1e-12) / 20))
    return round(wall / unit) * unit


def _next(column: Column, found: State, aim: Aim, course: Course) -> Next:
    assert column.wall is not None, "what is done is not asked for"
    bracket = column.bracket
    wall = column.wall if bracket.again else rounded(column.wall, aim.accuracy * found.largest)
    wall = min(max(wall, aim.lowest), aim.highest)
    K, B = ("Nm/rad", "Nms/rad") if course.rotation else ("N/m", "Ns/m")
    at = f"B = {column.damping:g} {B}"
    if bracket.again:
        said = ", ".join(f"{value:g}" for value in bracket.again)
        why = (
            f"the verdict at {said} {K} hardly stands out from the noise"
            if column.note == "weak"
            else f"logs contradict each other at {at}: stable above unstable between {min(bracket.again):g} and "
            f"{max(bracket.again):g} {K}; measured again first"
        )
        return Next(stiffness=wall, damping=column.damping, expected="undecided", why=why)
    assert column.split is not None, "a wall comes from a split"
    chance = column.split.unstable
    known = f"stable at {bracket.low:g} {K}" if bracket.low is not None else "no stable wall yet"
    known += f", unstable at {bracket.high:g} {K}" if bracket.high is not None else ", no unstable wall yet"
    basis = (
        f"limit expected at {column.estimate:.4g} {K}"
        if found.forecast.adequate
        else f"bisection alone: no loop explains the limits (misfit {found.forecast.misfit:.0%})"
    )
    lasting = "; stable walls lie above unstable ones, the lowest limit counts" if bracket.lasting else ""
    expected = "unstable" if chance > SURE else "stable" if chance < 1 - SURE else "undecided"
    if aim.gentle and wall < (column.estimate or 0):
        expected = "stable"
    return Next(stiffness=wall, damping=column.damping, expected=expected, why=f"{at}: {known}; {basis}{lasting}")


def _optimum(course: Course, wish: Wish, found: State, aim: Aim) -> tuple[Next, ...]:
    limits: Floats = np.array([column.estimate or 0.0 for column in found.columns])
    if not len(course.tried):
        limits = np.maximum(limits, FIRST_SHARE * found.largest)
    walls = next_walls(course.tried, np.array(aim.dampings), np.minimum(limits, aim.highest), wish.count)
    best = np.nanmin(course.tried.cost) if np.isfinite(course.tried.cost).any() else None
    so_far = "no cost yet" if best is None else f"best {wish.criterion} so far {best:.4g}"
    return tuple(
        Next(
            stiffness=min(max(rounded(K, aim.accuracy * found.largest), aim.lowest), aim.highest),
            damping=rounded(B, 0.02 * aim.dampings[-1]),
            expected="stable",
            why=so_far if best is None else f"{so_far}, {cost:.4g} expected here",
        )
        for K, B, cost in walls
    )
