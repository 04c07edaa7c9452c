"""Functions that store, read or simulate logs."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pipeline.base.errors import LogError, UsageError
from pipeline.device_data.devices import known_devices, load_device
from pipeline.intake.ingest import IngestReport
from pipeline.intake.ingest import ingest as ingest_logs
from pipeline.intake.sources import find_sources, logs_of, motion_of, requested_profiles
from pipeline.readers import Log
from pipeline.records.models import Motion
from pipeline.records.tables import SIGNALS
from pipeline.records.trials import Trial
from pipeline.rendering.frames import units_of
from pipeline.simulation.sweep import SimulatedSweep, run_sweep, write_sweep

PathLike = str | os.PathLike[str]


def ingest(
    paths: PathLike | Sequence[PathLike], processed: PathLike = "processed", profile: PathLike | None = None
) -> IngestReport:
    """Store all new logs of files and folders, as `pipeline ingest` does.

    Parameters
    ----------
    paths : path, or sequence of them
        Files, and folders that are searched recursively.
    processed : path
        Folder of the stored tables. It is created if it does not exist.
    profile : str or path, optional
        Name of a shipped profile, or a TOML file. By default, a shipped profile is chosen for each file.

    Returns
    -------
    IngestReport
        ``found``, ``ingested``, ``skipped`` (counts), ``quarantined`` (rejected logs with ``path``, ``reason``,
        ``row``), ``warnings``. A rejected log does not raise an exception.

    Raises
    ------
    UsageError
        If a path does not exist.
    ProfileError
        If the profile is invalid, or two profiles match one file.
    StoreError
        If ``processed`` is damaged or cannot be written, or another command is writing there.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     ingest([], folder).found
    0
    """
    places = [paths] if isinstance(paths, (str, os.PathLike)) else paths
    return ingest_logs([Path(path) for path in places], Path(processed), _profile(profile))


def read_log(path: PathLike, profile: PathLike | None = None, label: str | None = None) -> pd.DataFrame:
    """Read a single step response in SI units. Nothing is stored.

    Parameters
    ----------
    path : path
        Log in any format that `ingest` reads. The folder of a ROS 2 bag is a single log.
    profile : str or path, optional
        As for `ingest`.
    label : str, optional
        Label of the trial. The label is required if the file contains several trials.

    Returns
    -------
    pandas.DataFrame
        ``time_s`` [s], ``command`` [N, Nm] (before any delay), ``position`` [m, rad], ``force`` [N, Nm] and
        ``velocity`` [m/s, rad/s] (the last two NaN if the log does not contain them), one row per sample. ``attrs``:
        ``units``, and ``device``, ``experiment``, ``stiffness``, ``damping``, ``step``, ``sampling_period_s``,
        ``added_delay_samples``, ``grip``, ``motion``, ``simulated``, ``label``, ``warnings``, ``findings`` (faults of
        the recording, each with ``code``, ``first_row``, ``rows``, ``evidence``, ``remedy``, ``severity``).

    Raises
    ------
    LogError
        If the log is rejected. The message names the faulty row.
    UsageError
        If the path does not exist or is not a single log, or if no trial of the file has this label.
    """
    given = _profile(profile)
    sources = find_sources([Path(path)], requested_profiles(given, [Path(path)]).profiles)
    if len(sources) != 1:
        raise UsageError(
            f"{path}: expected one log, found {len(sources)}. Name a single file, or store all logs with `ingest`."
        )
    (source,) = sources
    try:
        log = _chosen(logs_of(source)[2], label, path)
        motion = motion_of(log, {name: device.motion for name, device in known_devices().items()})
    except LogError as error:
        row = "" if error.row is None else f", row {error.row}"
        raise error.reworded(f"{path}{row}: {error.reason}") from error
    names = {"time_s": "time", **{name: name for name in SIGNALS[1:]}}
    conditions = {name: value for name, value in vars(log.header).items() if name not in ("motion", "extra")}
    return response_frame(
        {column: getattr(log, name) for column, name in names.items()},
        motion,
        {**conditions, "label": log.label, "warnings": log.warnings, "findings": log.findings},
    )


def simulate(
    device: str,
    experiment: str,
    seed: int = 0,
    *,
    ideal: bool = False,
    coarsen: int = 1,
    duration_s: float | None = None,
    out: PathLike | None = None,
    overwrite: bool = False,
) -> list[pd.DataFrame]:
    """Simulate all trials of an experiment, as `pipeline simulate` does.

    Parameters
    ----------
    device : str
        Name of a known device.
    experiment : str
        Name of one of its experiments.
    seed : int
        Seed of noise and jitter. The same seed gives the same logs.
    ideal : bool
        True for a simulation without noise, quantisation and jitter.
    coarsen : int
        Use every n-th damping, and n times the stiffness step, for a small experiment.
    duration_s : float, optional
        Length of a trial [s]. The default is the length that the device states.
    out : path, optional
        Folder to which the logs and the ground truth are also written. `ingest` can read it.
    overwrite : bool
        True to replace the logs of an earlier simulation in ``out``.

    Returns
    -------
    list of pandas.DataFrame
        One data frame for each trial, in the order of recording, like the result of `read_log`. Its ``attrs`` also have
        the ``trial`` (name of the log) and the ``verdict``.

    Raises
    ------
    DeviceError
        If the device or the experiment is unknown.
    ParameterError
        If a value is out of range.
    UsageError
        If ``out`` contains an earlier simulation.

    Examples
    --------
    >>> logs = simulate("lwr", "delay-2", coarsen=16, duration_s=0.1)
    >>> logs[0].attrs["units"]["position"], logs[0].attrs["stiffness"] > 0
    ('rad', True)
    """
    sweep = run_sweep(load_device(device), experiment, seed=seed, ideal=ideal, coarsen=coarsen, duration_s=duration_s)
    if out is not None:
        write_sweep(sweep, Path(out), overwrite=overwrite)
    trials = zip(sweep.trials, sweep.verdict.tolist(), strict=True)
    return [_frame(sweep, trial, verdict) for trial, verdict in trials]


def response_frame(samples: Mapping[str, Any], motion: Motion, about: Mapping[str, Any]) -> pd.DataFrame:
    """Return a step response, shape (rows, 5), with its conditions in ``attrs``."""
    rows = len(samples["time_s"])
    columns = {name: np.full(rows, np.nan) if samples.get(name) is None else samples[name] for name in SIGNALS}
    frame = pd.DataFrame(columns)
    frame.attrs = {"units": units_of((*SIGNALS, "stiffness", "damping", "step", "sampling_period_s"), {motion})}
    frame.attrs |= {"motion": motion, **about}
    return frame


def _frame(sweep: SimulatedSweep, trial: Trial, verdict: str) -> pd.DataFrame:
    experiment = sweep.experiment
    samples = {"time_s": trial.time, "command": trial.command, "position": trial.position}
    about = {
        "trial": trial.trial_id,
        "device": sweep.device.name,
        "experiment": experiment.name,
        **{name: getattr(trial, name) for name in ("stiffness", "damping", "step", "sampling_period_s")},
        "added_delay_samples": experiment.added_delay_samples,
        "grip": experiment.grip,
        "simulated": True,
        "verdict": verdict,
    }
    return response_frame(samples, sweep.device.motion, about)


def _chosen(logs: Sequence[Log], label: str | None, path: PathLike) -> Log:
    """Return the log with the given label, or the only log of the file."""
    if label is None and len(logs) == 1:
        return logs[0]
    labels = ", ".join(str(log.label) for log in logs)
    named = [log for log in logs if label is not None and log.label == label]
    if len(named) != 1:
        raise UsageError(f"{path}: contains the trials {labels}. Expected one of these labels, found {label!r}.")
    return named[0]


def _profile(profile: PathLike | None) -> str | Path | None:
    return profile if profile is None or isinstance(profile, str) else Path(profile)
