"""Simulate the pairs (K, B) of a sweep that a lab would test, and the logs that it would record.

For each damping B, the stiffness K is increased by the stiffness step until a trial is unstable. It is then increased
again from the last stable K, in steps of 20 % of the stiffness step (6.1.1). Trials at K = 0 with decreasing B follow,
which determine the physical damping (6.1.2). As in the lab, the verdict on a trial is based on its log.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import floor, inf
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.base.disk import TEMPORARY_ENDING, write_text
from pipeline.base.errors import ParameterError, PipelineError, UsageError
from pipeline.base.json_object import JsonObject
from pipeline.base.provenance import __version__
from pipeline.device_data.devices import find_experiment
from pipeline.measured.signal.verdict import judge
from pipeline.records.models import Device, Experiment
from pipeline.records.native import NativeHeader, format_header
from pipeline.records.trials import Floats, Integers, Trials
from pipeline.simulation.procedure import Climb, Strings
from pipeline.simulation.radius import spectral_radius
from pipeline.simulation.setup import Setup, idealise, setup_of
from pipeline.simulation.simulate import applied_delay_moments, simulate
from pipeline.simulation.tested_grid import tested_grid
from pipeline.store.names import folder_for

LOWEST_DAMPING = 2.0
"""Largest -B tested at K = 0, relative to the physical damping, unless the grid contains a larger B. The limit of
stability is at 1, but friction or a force limit may hide it."""

LONGEST_TRIAL = 20_000
"""Largest number of samples of a trial: 20 s at 1 kHz, fifty times as long as in the thesis. Each array of a sweep of
2,300 trials then takes 370 MB."""

TRUTH_FILE = "truth.json"


@dataclass(frozen=True, eq=False)
class SimulatedSweep:
    """Trials of a sweep in the order in which a lab would have recorded them, and their ground truth.

    Parameters
    ----------
    device, experiment : Device, Experiment
    setup : Setup
        Simulated conditions, such as loop, step and limits.
    seed : int
    trials : Trials
        Trials, whose ``trial_id`` is the file name of the log without its extension.
    passes : int64, shape (n,)
        Pass of each trial: 1 for the coarse steps, 2 for the fine steps.
    verdict : array of str, shape (n,)
        Verdict on each log: stable, unstable or undecided.
    """

    device: Device
    experiment: Experiment
    setup: Setup
    seed: int
    trials: Trials
    passes: Integers
    verdict: Strings


def run_sweep(
    device: Device,
    experiment: str,
    *,
    seed: int = 0,
    ideal: bool = False,
    duration_s: float | None = None,
    coarsen: int = 1,
    progress: Callable[[int], None] | None = None,
    **changes: Any,
) -> SimulatedSweep:
    """Simulate the sweep of an experiment.

    Parameters
    ----------
    device : Device
    experiment : str
        Name of an experiment of the device.
    seed : int
        Seed of noise and jitter. The same seed gives the same logs.
    ideal : bool
        Whether noise, quantum, jitter, friction and hidden faults are omitted. ``changes`` may restore them.
    duration_s : float, optional
        Duration of a trial [s] instead of the device's, at most `LONGEST_TRIAL` samples.
    coarsen : int
        Factor n for a small sweep: every n-th damping is tested with n times the stiffness step. At K = 0, every
        damping is tested.
    progress : callable, optional
        Function that is called with the number of trials kept so far.
    **changes
        Fields of the `Loop` that replace those of the device, such as ``sensor`` or ``jitter_samples``.

    Raises
    ------
    DeviceError
        If the device has no experiment with this name.
    ParameterError
        If a value is out of range, or if no unstable trial is found within `procedure.LONGEST_CLIMB` steps.

    Notes
    -----
    An undecided trial counts as stable. The fifth fine step would repeat the unstable coarse trial and is omitted.
    If B = 0 is already unstable at K = 0, the fine steps start one damping step above B = 0, so that they still bracket
    the limit.

    Source: Hulin 2017, sec. 6.1.1, 6.1.2, 6.2.1.
    """
    if coarsen < 1:
        raise ParameterError(f"coarsen = {coarsen}: expected 1 (every trial) or a larger integer.")
    conditions = find_experiment(device, experiment)
    setup = _setup(device, conditions, duration_s, ideal=ideal).with_loop(**changes)
    stream = f"{device.name}/{conditions.name}"

    def run(stiffness: Floats, damping: Floats) -> tuple[Trials, Strings]:
        trials = simulate(setup, stiffness, damping, seed=seed, stream=stream)
        return trials, np.array([judge(trial).verdict for trial in trials], dtype=np.str_)

    grid = tested_grid(device, conditions)
    lowest = max(grid.damping_last, LOWEST_DAMPING * conditions.damping)
    climb = Climb(run, coarsen * grid.stiffness_step, grid.damping_step, lowest, progress)
    stride = coarsen * grid.damping_step
    tolerance = 1e-9  # of a step: rounding of a quotient such as 184/4 must not omit the last damping
    count = floor((grid.damping_last - grid.damping_first) / stride + tolerance) + 1
    climb.columns([*(grid.damping_first + j * stride for j in range(count))])
    climb.columns([None])
    kept, passes, verdict = climb.result()
    named = (
        replace(trial, trial_id=_log_name(trial.stiffness, trial.damping, number))
        for trial, number in zip(kept, passes.tolist(), strict=True)
    )
    return SimulatedSweep(device, conditions, setup, seed, Trials.of(named), passes, verdict)


def _setup(device: Device, conditions: Experiment, duration_s: float | None, *, ideal: bool) -> Setup:
    setup = setup_of(device, conditions)
    setup = idealise(setup) if ideal else setup
    if duration_s is None:
        return setup
    longest_s = LONGEST_TRIAL * device.sampling_period_s
    if not 0 < duration_s < inf:
        raise ParameterError(f"duration = {duration_s} s: expected a finite positive duration of a trial.")
    if duration_s > longest_s:
        raise ParameterError(f"duration = {duration_s} s: expected at most {longest_s:g} s ({LONGEST_TRIAL} samples).")
    return replace(setup, rows=round(duration_s / setup.loop.sampling_period_s))


def _log_name(stiffness: float, damping: float, number: int) -> str:
    return f"B{_digits(damping, 3)}_K{_digits(stiffness, 6)}_p{number}"


def _digits(value: float, width: int) -> str:
    """Format a number with leading zeros, so that names sort, and with as many decimals as it needs."""
    text = np.format_float_positional(abs(value), trim="-")
    whole, point, decimals = text.partition(".")
    return ("-" if value < 0 else "") + whole.zfill(width) + point + decimals


def write_sweep(sweep: SimulatedSweep, folder: Path, *, overwrite: bool = False) -> int:
    """Write a sweep as native logs with ``truth.json`` to ``folder/<device>/<experiment>``.

    Parameters
    ----------
    sweep : SimulatedSweep
    folder : Path
        Output folder, which is created if it is missing.
    overwrite : bool
        Whether to replace the logs of an earlier simulation, which are listed in its ``truth.json``. Other files are
        never changed.

    Returns
    -------
    int
        Number of logs that were written.

    Raises
    ------
    UsageError
        If the folder contains an earlier simulation and ``overwrite`` is false, or if an unlisted file has the name
        of a log. Nothing is written in these cases.
    PipelineError
        If a file cannot be written. The logs written so far are complete and listed in ``truth.json``.
    """
    target = folder_for(folder_for(folder, sweep.device.name), sweep.experiment.name)
    names = [f"{name}.csv" for name in sweep.trials.trial_id]
    try:
        earlier = _earlier_logs(target, overwrite)
        foreign = [name for name in names if name not in earlier and (target / name).exists()]
        if foreign:
            raise UsageError(
                f"{target / foreign[0]} ({len(foreign)} such file(s)) is not listed in {TRUTH_FILE} as a log of an "
                "earlier simulation, and is not replaced. Choose another folder (--out)."
            )
        truth = _truth(sweep)
        # files are listed before they are written, so that the next run can replace the files of an interrupted run
        pending = {"complete": False, "logs": [*sorted(earlier), *names]}
        write_text(target / TRUTH_FILE, json.dumps({**truth, **pending}))
        for name in earlier.difference(names):
            (target / name).unlink(missing_ok=True)
        _write_logs(sweep, target, names)
        write_text(target / TRUTH_FILE, json.dumps(truth, indent=1))
    except OSError as error:
        raise PipelineError(
            f"{error.filename or target}: simulated logs cannot be written ({error.strerror or error}). "
            "Make room or choose another folder (--out), then run again."
        ) from error
    return len(names)


def _write_logs(sweep: SimulatedSweep, target: Path, names: Sequence[str]) -> None:
    device, experiment, hidden = sweep.device, sweep.experiment, sweep.setup.hidden
    # logs without missing rows have the same time stamps, which are therefore part of a template
    longest, period = int(sweep.trials.rows.max(initial=0)), sweep.setup.loop.sampling_period_s
    stamped = bool(hidden.lost_rows) and not hidden.lost_rows_hidden
    stamps = ["%.17g" if stamped else "%.17g" % (k * period) for k in range(longest)]
    lines = [f"{stamp},%.17g,%.17g\n" for stamp in stamps]
    templates = {rows: "".join(lines[:rows]) for rows in np.unique(sweep.trials.rows).tolist()}
    temporary = target / f".{os.getpid()}{TEMPORARY_ENDING}"
    try:
        for trial, name in zip(sweep.trials, names, strict=True):
            header = NativeHeader(
                device=device.name,
                experiment=experiment.name,
                stiffness=trial.stiffness,
                damping=trial.damping,
                step=trial.step,
                sampling_period_s=trial.sampling_period_s,
                added_delay_samples=experiment.added_delay_samples,
                grip=experiment.grip,
                motion=device.motion,
                simulated=True,
            )
            cells = np.stack([*((trial.time,) if stamped else ()), trial.command, trial.position], axis=1)
            text = format_header(header, device.motion) + templates[trial.rows] % tuple(cells.ravel().tolist())
            temporary.write_bytes(text.encode())
            temporary.replace(target / name)
    finally:
        temporary.unlink(missing_ok=True)


def _earlier_logs(target: Path, overwrite: bool) -> set[str]:
    """Return the names of the logs that an earlier simulation wrote to a folder."""
    path = target / TRUTH_FILE
    if not path.exists():
        return set()
    if not overwrite:
        raise UsageError(
            f"{target} contains the logs of an earlier simulation. Give overwrite=True to replace them, "
            "or choose another folder (--out)."
        )
    try:
        logs = json.loads(path.read_text(encoding="utf-8"))["logs"]
        names = {str(name) for name in logs}
    except (ValueError, KeyError, TypeError) as error:
        raise UsageError(
            f"{path} is not a list of simulated logs, so nothing here is replaced. "
            "Remove the file or choose another folder (--out)."
        ) from error
    return {name for name in names if Path(name).name == name and name.endswith(".csv")}


def _truth(sweep: SimulatedSweep) -> JsonObject:
    setup, experiment, trials, loop = sweep.setup, sweep.experiment, sweep.trials, sweep.setup.loop
    shortest, longest = loop.delay_range
    radius = spectral_radius(setup, trials.stiffness, trials.damping)
    rows = zip(trials.trial_id, trials.stiffness, trials.damping, sweep.verdict, radius, trials.rows, strict=True)
    return {
        "device": sweep.device.name,
        "experiment": experiment.name,
        "package_version": __version__,
        "seed": sweep.seed,
        "plant": {"mass": experiment.mass, "damping": experiment.damping, "stiffness": experiment.stiffness},
        "delay_samples": setup.mean_delay_samples,
        "delay_samples_low": shortest,
        "delay_samples_high": longest,
        "applied_delay_samples": applied_delay_moments(loop.jitter_samples)[0]
        if loop.jitter_samples
        else loop.delay_samples,
        "jitter_samples": list(loop.jitter_samples),
        "quantum": loop.sensor.quantum,
        "noise": loop.sensor.noise,
        "force_limit": loop.force_limit,
        "loop": sweep.device.loop_table(experiment).model_dump(mode="json"),
        "simulation": setup.hidden.model_dump(mode="json"),
        "step": setup.step,
        "edge_row": setup.edge_row,
        "sampling_period_s": loop.sampling_period_s,
        "spectral_radius_left_out": list(setup.left_out),
        "complete": True,
        "logs": {
            f"{name}.csv": {
                "stiffness": float(K),
                "damping": float(B),
                "verdict": str(verdict),
                "spectral_radius": float(rho),
                "rows": int(count),
            }
            for name, K, B, verdict, rho, count in rows
        },
    }
