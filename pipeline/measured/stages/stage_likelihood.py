"""The likeliest device of all logs of an experiment, where no simple one explains them: for the stage `ladder`."""

from __future__ import annotations

import json
from itertools import pairwise
from typing import Any

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.measured.ladder.trials import spread_over_plane
from pipeline.measured.model.identified import Identified, identified
from pipeline.measured.model.recordings import GAP, Recording
from pipeline.measured.model.scatter import FEWEST
from pipeline.measured.stages.stage_given import Experiment
from pipeline.measured.stages.stage_groups import Columns, Given, TrialGroup
from pipeline.records.batch import TrialBatch
from pipeline.records.tables import TABLES

MOST_TRIALS = 40
"""Logs that the device is fitted to: a mass known to 1 % from one is known to 0.2 %, and a log takes a third of a
second."""

MOST_ROWS = 600
"""Rows of a log from shortly before the step on: behind any wall that is of use motion has come to its end."""

AHEAD = 40
"""Rows before the step that are kept."""

LEAST = 1e-300
"""Variance of a number that is known exactly."""

FOLLOWS = 50.0
"""Fit of a free run [%] from which on it follows a log: more than half of the motion is predicted."""

WITHOUT = {"command_shifted"}
"""Departures from the wall law by which a logged command is not the one that drives the device at that time."""

NAMES = {
    "mass": "mass",
    "damping": "damping",
    "stiffness": "stiffness",
    "delay": "delay_samples",
    "friction": "coulomb",
    "constant_force": "constant_force",
    "actuator_lag": "actuator_lag_s",
    "mode_frequency": "frequency_hz",
    "mode_damping_ratio": "damping_ratio",
    "mode_mass": "far_mass",
}
"""Numbers of a fitted device by those of the model."""

PARTS = {"friction": "friction", "stiffness": "spring", "lag": "lag", "mode": "mode at the motor"}
"""Parts of a fitted device by those of the model."""


def likeliest(of: Experiment) -> Columns:
    """Return the columns of the stage `ladder` by the likelihood of all logs; no row where these tell no mass."""
    codes = [set(filter(None, text.split(","))) for text in of.texts("wall_law", "law_codes")]
    stiffness, damping = of.column("response", "stiffness"), of.column("response", "damping")
    usable = np.array([each.isdisjoint(WITHOUT) for each in codes])
    # without a wall a device ends somewhere, and says less of what the walls of the others do
    usable &= (stiffness > 0) | (stiffness <= 0).all()
    ids = of.texts("response", "trial_id")
    chosen = [ids[i] for i in spread_over_plane(stiffness, damping, usable, MOST_TRIALS)]
    parts = of.of_each(recordings, chosen=chosen)
    found = [one for part in parts for one in part]
    place = {name: i for i, name in enumerate(chosen)}
    try:
        device = identified(sorted(found, key=lambda one: place[one.name]))
    except ParameterError:
        device = None
    if device is None or "mass" in device.untold:
        return {name: [] for name in TABLES["ladder"]}
    fits = device.replay.fit[np.isfinite(device.replay.fit)]
    fit = float(np.median(fits)) if len(fits) else np.nan
    if len(found) < FEWEST and not fit >= FOLLOWS:  # no trial without which it was fitted, and none that it follows
        return {name: [] for name in TABLES["ladder"]}
    return {
        "role": ["best"],
        "parts": [",".join(PARTS[name] for name, gain in device.parts.items() if gain > 0)],
        "explained": [int((fits >= FOLLOWS).sum())],
        "held_out": [len(fits)],
        "score": [fit],
        "numbers": [json.dumps(_numbers(device, chosen))],
    }


def _numbers(device: Identified, chosen: list[str]) -> dict[str, Any]:
    """Return the numbers of a device in SI as the stage holds them, with their scatter and those without each fold."""
    unit = {name: 1 / device.scales.period if name == "delay" else 1.0 for name in device.parameters}
    units = np.array(list(unit.values()))
    folds = [{NAMES[name]: value * unit[name] for name, value in fold.items()} for fold in device.folds]
    # a delay that nothing tells is none
    late = set() if "delay" in unit else {"delay_samples"}
    values = {NAMES[name]: each.value * unit[name] for name, each in device.parameters.items()}
    # an interval may be wider than the likelihood alone says
    told = np.sqrt(np.maximum(device.covariance.diagonal(), LEAST))
    wider = units * np.maximum([each.error for each in device.parameters.values()] / told, 1.0)
    covariance = device.covariance * np.outer(wider, wider)
    return {
        "names": [*values, *late],
        "values": [*values.values(), *(0.0 for _ in late)],
        "covariance": np.pad(covariance, (0, len(late))).tolist(),
        "saturated": 0.0,
        "scatter": {NAMES[name]: value * unit.get(name, 1.0) for name, value in device.scatter.items()},
        "open": sorted({NAMES[name] for name in device.untold} | late),
        "folds": folds,
        "trials": chosen,
    }


def recordings(group: TrialGroup, given: Given) -> list[Recording]:
    """Return the chosen trials of a group as the model takes them."""
    some = np.flatnonzero([name in set(given["chosen"]) for name in group.batch.trial_id])
    batch, found = group.batch, []
    for i in some.tolist():
        edge = max(int(group.found.edge_row[i]), 0)
        declared = batch.step_row is not None and int(batch.step_row[i]) >= 0
        first = max(edge - AHEAD, 0)
        rows = _complete(batch, i, slice(first, min(int(batch.rows[i]), first + MOST_ROWS)))
        found.append(
            Recording(
                batch.trial_id[i],
                batch.time[i, rows],
                batch.command[i, rows],
                batch.position[i, rows],
                float(batch.sampling_period_s[i]),
                edge - first if declared and rows.start == first else None,
            )
        )
    return found


def _complete(batch: TrialBatch, trial: int, rows: slice) -> slice:
    """Return the rows between two that are lost in which the device moves most; all where none is lost."""
    time, position = batch.time[trial, rows], batch.position[trial, rows]
    gaps = np.flatnonzero(np.diff(time) > GAP * batch.sampling_period_s[trial]) + 1
    bounds = [0, *gaps.tolist(), len(time)]
    way = [float(np.abs(np.diff(position[a:b])).sum()) for a, b in pairwise(bounds)]
    best = int(np.argmax(way)) if way else 0
    return slice(rows.start + bounds[best], rows.start + bounds[best + 1])
