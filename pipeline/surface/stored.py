"""Stored logs, and results from them, as data frames."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from pipeline.base.errors import DeviceError, StoreError, UsageError
from pipeline.comparison.experiment_result import experiment_numbers
from pipeline.comparison.scene.scene import StoredData, needed_stages, open_scene
from pipeline.comparison.stage_pool import compute_stages
from pipeline.device_data.devices import known_devices
from pipeline.device_data.published import HumanArm
from pipeline.device_data.published import human_arms as all_arms
from pipeline.measured.stages.stage_needs import cost_column
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.records.criteria import MEASURED
from pipeline.records.results import ExperimentNumbers
from pipeline.records.table_files import read_table
from pipeline.records.tables import SIGNALS
from pipeline.rendering.frames import FORCED, boundary_frame, estimates_frame, frame_of, optima_frame, units_of
from pipeline.rendering.table import Row
from pipeline.store.samples import load_trials
from pipeline.store.storage import list_devices, list_experiments, read_exclusions, read_trials, stage_file
from pipeline.surface.logs import PathLike, response_frame

_CONDITIONS = (
    *("device", "experiment", "stiffness", "damping", "step", "sampling_period_s", "added_delay_samples", "grip"),
    "simulated",
)
_COSTS = ("experiment", "trial_id", "stiffness", "damping", "verdict", "criterion", "cost", "low", "high", "reason")


def devices(processed: PathLike = "processed") -> pd.DataFrame:
    """Return the devices with stored trials, one row for each.

    Returns
    -------
    pandas.DataFrame
        ``device``, ``title``, ``motion``, ``known`` (True if a device file describes the device), ``experiments`` and
        ``trials`` (counts).

    Raises
    ------
    StoreError
        If the folder is missing, or a stored file is damaged.
    """
    stored, known = experiments(processed), known_devices()
    rows = [
        {
            "device": name,
            "title": known[name].title if name in known else name,
            "motion": " and ".join(sorted(set(of_device["motion"]))),
            "known": name in known,
            "experiments": len(of_device),
            "trials": of_device["trials"].sum(),
        }
        for name, of_device in stored.groupby("device")
    ]
    return frame_of("device title motion known experiments trials", rows, {})


def experiments(processed: PathLike = "processed", device: str | None = None) -> pd.DataFrame:
    """Return the experiments with stored trials, one row for each, in natural order (2 before 10).

    Returns
    -------
    pandas.DataFrame
        ``device``, ``experiment``, ``motion``, ``sampling_period_s`` [s], ``added_delay_samples``, ``grip``,
        ``simulated`` (true if any trial is simulated), ``trials`` (count). If trials differ, the row has the smallest
        period, the smallest delay and the first grip.

    Raises
    ------
    StoreError
        If the folder is missing, or a stored file is damaged.
    DeviceError
        If the device has no trials.
    """
    folder = folder_of(processed)
    columns = ("device", "experiment", "motion", "sampling_period_s", "added_delay_samples", "grip", "simulated")
    trials_ = _frame(_read(folder, device, None, list(columns)))
    rows = []
    for name in [device] if device is not None else list_devices(folder):
        for experiment in list_experiments(folder, name):
            own = trials_[(trials_["device"] == name) & (trials_["experiment"] == experiment)]
            if len(own):
                row = {column: own[column].min() for column in columns[:-1]}
                rows.append({**row, "simulated": bool(own["simulated"].any()), "trials": len(own)})
    return frame_of((*columns, "trials"), rows, units_of(columns))


def trials(processed: PathLike = "processed", device: str | None = None, experiment: str | None = None) -> pd.DataFrame:
    """Return all stored trials, or those of a device or of an experiment.

    Returns
    -------
    pandas.DataFrame
        One row for each trial, with the columns of the stored table: ``trial_id``, ``device``, ``experiment``,
        ``motion``, ``stiffness`` [N/m, Nm/rad], ``damping`` [Ns/m, Nms/rad], ``step`` [N, Nm], ``sampling_period_s``
        [s], ``added_delay_samples``, ``grip``, ``simulated``, ``rows``, ``source_path``, ... In addition,
        ``exclusion_reason`` of manually excluded trials, which no estimate, boundary or cost uses (otherwise "");
        ``verdict`` (stable, unstable or undecided) and ``outcome``, which are None if no comparison has computed them
        (`costs` computes verdicts).

    Raises
    ------
    StoreError
        If the folder is missing, or a stored file is damaged.
    DeviceError
        If the device or experiment has no trials.
    """
    folder = folder_of(processed)
    table, known = _read(folder, device, experiment, None), read_exclusions(folder)
    ids = table.column("trial_id").to_pylist()
    reasons = [known[trial].exclusion_reason if trial in known else "" for trial in ids]
    frame = _frame(table.append_column("exclusion_reason", [reasons]))
    places = dict.fromkeys(zip(frame["device"], frame["experiment"], strict=True))
    for name, stage in (("verdict", "response"), ("outcome", "outcome")):
        files = (stage_file(folder, *place, stage) for place in places)
        tables = [read_table(file) for file in files if file is not None]
        known = {i: v for t in tables for i, v in zip(t["trial_id"].to_pylist(), t[name].to_pylist(), strict=True)}
        frame[name] = pd.Series([known.get(trial) for trial in ids], index=frame.index, dtype=object)
    return frame


def samples(processed: PathLike, trial_id: str) -> pd.DataFrame:
    """Return the samples of a stored trial.

    Returns
    -------
    pandas.DataFrame
        ``time_s`` [s], ``command`` [N, Nm], ``position`` [m, rad], ``force``, ``velocity`` (the last two NaN if the log
        does not contain them), one row for each sample. ``attrs`` has the conditions of the trial, as in `read_log`.

    Raises
    ------
    UsageError
        If there is no trial with this id.
    StoreError
        If the folder is missing, or a stored file is damaged.
    """
    folder = folder_of(processed)
    table = read_trials(folder)
    table = table.take(np.flatnonzero([name == trial_id for name in table.column("trial_id").to_pylist()]))
    if not table.num_rows:
        raise UsageError(f"{folder}: no trial {trial_id!r}. `trials` lists all ids in its column trial_id.")
    (row,) = table.slice(0, 1).to_pylist()
    trial = load_trials(folder, table.slice(0, 1))[0]
    return response_frame(
        {"time_s": trial.time, **{name: getattr(trial, name) for name in SIGNALS[1:]}},
        row["motion"],
        {"trial_id": trial_id, **{name: row[name] for name in _CONDITIONS}},
    )


def estimates(
    processed: PathLike, device: str, experiment: str | None = None, *, all_methods: bool = False
) -> pd.DataFrame:
    """Return delay, mass, damping and all other estimates for one or all experiments of a device.

    Parameters
    ----------
    processed : path
    device : str
    experiment : str, optional
    all_methods : bool
        True if the recommended value is to be followed by the values of the other methods.

    Returns
    -------
    pandas.DataFrame
        ``experiment``, ``quantity`` (``delay_samples``, ``mass``, ``damping``, ...), ``value``, ``low``, ``high`` (95 %
        interval), ``unit``, ``method``, ``recommended``, ``reason`` (why the value is missing, that is, NaN),
        ``trials`` (number of used trials), ``spread``, ``within`` (standard deviation between trials, median error of a
        trial), ``warning``.

    Raises
    ------
    DeviceError
        If the device or experiment has no trials.
    StoreError
        If a stored file is damaged, or trials of an experiment are inconsistent.
    """
    return estimates_frame(_results(_open(processed, device, experiment)), all_methods=all_methods)


def boundary(processed: PathLike, device: str, experiment: str | None = None) -> pd.DataFrame:
    """Return the measured stability boundary of one or all experiments of a device.

    Returns
    -------
    pandas.DataFrame
        One row for each damping: ``experiment``, ``damping`` [Ns/m, Nms/rad], ``unstable`` (smallest unstable
        stiffness) and ``stable`` (largest stable stiffness below it) [N/m, Nm/rad], NaN if missing, ``censored``,
        ``stiffness``, ``low``, ``high`` [N/m, Nm/rad] (limit from the growth rates, 95 % interval), ``trials``,
        ``undecided`` (number of undecided trials below ``stable``), ``stiffness_large_motion`` [N/m, Nm/rad]. If
        friction was found, the other limits are valid only for the applied step; with a larger step, walls may be
        unstable from ``stiffness_large_motion`` on.

    Raises
    ------
    DeviceError, StoreError
        As in `estimates`.
    """
    data = _open(processed, device, experiment)
    return boundary_frame(_results(data), data.motion)


def optima(processed: PathLike, device: str, experiment: str | None = None) -> pd.DataFrame:
    """Return the best trial by each criterion, for one or all experiments of a device.

    Returns
    -------
    pandas.DataFrame
        ``experiment``, ``criterion``, ``stiffness`` [N/m, Nm/rad], ``damping`` [Ns/m, Nms/rad], ``cost`` with its 95 %
        interval ``cost_low`` to ``cost_high``, ``trial_id``, ``ties``, ``censored`` (at the edge of the tested range),
        ``cost_s`` [s], ``reason`` (why there is no best trial, in which case the numbers are NaN). Settling times are
        in samples, and in seconds in ``cost_s``. Overshoot is a fraction.

    Raises
    ------
    DeviceError, StoreError
        As in `estimates`.
    """
    data = _open(processed, device, experiment)
    return optima_frame(_results(data), data.motion)


def costs(processed: PathLike, device: str, experiment: str | None = None) -> pd.DataFrame:
    """Return the verdict and the costs of each trial, for one or all experiments of a device.

    Returns
    -------
    pandas.DataFrame
        One row for each trial and criterion: ``experiment``, ``trial_id``, ``stiffness`` [N/m, Nm/rad], ``damping``
        [Ns/m, Nms/rad], ``verdict`` (stable, unstable or undecided), ``criterion``, ``cost``, ``low``, ``high`` (95 %
        interval), ``reason`` (why the cost is missing or uncertain).

    Raises
    ------
    DeviceError, StoreError
        As in `estimates`.
    """
    data = _computed(_open(processed, device, experiment))
    rows = [row for stages in data.experiments for row in _cost_rows(stages)]
    units = units_of(("stiffness", "damping"), {data.motion})
    return frame_of(_COSTS, rows, units)


def _cost_rows(stages: ExperimentStages) -> Iterator[Row]:
    trial = {
        "trial_id": stages.texts("response", "trial_id"),
        "stiffness": stages.column("response", "stiffness"),
        "damping": stages.column("response", "damping"),
        "verdict": stages.verdicts.verdict.tolist(),
    }
    for criterion in MEASURED:
        low, high = stages.cost_interval(criterion)
        reason = [text or None for text in stages.texts(cost_column(criterion)[0], "reason")]
        columns = {**trial, "cost": stages.cost(criterion)[0], "low": low, "high": high, "reason": reason}
        for row in zip(*columns.values(), strict=True):
            yield {"experiment": stages.experiment, "criterion": criterion, **dict(zip(columns, row, strict=True))}


def _open(processed: PathLike, device: str, experiment: str | None) -> StoredData:
    return open_scene(device, folder_of(processed), None if experiment is None else [experiment], None)


def _computed(data: StoredData) -> StoredData:
    """Compute missing stages. Several processes are used if that saves time."""
    compute_stages(data.experiments, needed_stages(data))
    return data


def _results(data: StoredData) -> Iterator[ExperimentNumbers]:
    return (experiment_numbers(data, stages, None) for stages in _computed(data).experiments)


def folder_of(processed: PathLike) -> Path:
    """Return the folder of stored tables as a path. The folder must exist."""
    folder = Path(processed)
    if not folder.is_dir():
        raise StoreError(f"{folder}: does not exist. Ingest logs first: pipeline.ingest(logs, {str(folder)!r}).")
    return folder


def _read(folder: Path, device: str | None, experiment: str | None, columns: list[str] | None) -> Any:
    """Return rows of the trials table. A device or experiment without stored trials raises an error."""
    if device is None and experiment is not None:
        raise UsageError(f"experiment {experiment!r} is named without its device. Name both.")
    if device is not None and device not in (stored := list_devices(folder)):
        raise DeviceError(
            f"{folder}: there are no trials of device {device!r}. Devices with trials: {', '.join(stored) or 'none'}."
        )
    if device is not None and experiment is not None and experiment not in (own := list_experiments(folder, device)):
        raise DeviceError(
            f"{folder}: there are no trials of {device!r}, experiment {experiment!r}. Experiments with trials: "
            f"{', '.join(own)}."
        )
    return read_trials(folder, device, experiment, columns)


def _frame(table: pa.Table) -> pd.DataFrame:
    """Return rows of the trials table as a data frame, with the units for the motions of the trials."""
    frame = table.to_pandas()
    frame.attrs = {"units": units_of(table.column_names, table.column("motion").unique().to_pylist() or FORCED)}
    return frame


def human_arms() -> pd.DataFrame:
    """Return published parameters of human arms. The values of a row can be passed to `Loop` as ``operator``.

    Returns
    -------
    pandas.DataFrame
        ``source``, ``mass`` [kg], ``stiffness`` [N/m], ``damping`` [Ns/m].

    Source: Hulin 2017, Table 3.2.
    """
    rows = [arm.model_dump() for arm in all_arms()]
    units = {"mass": "kg"} | units_of(("stiffness", "damping"), {"translation"})
    return frame_of(list(HumanArm.model_fields), rows, units)
