"""Stage `windows`: the mass of an experiment over the window of the momentum balance."""

from __future__ import annotations

import numpy as np

from pipeline.measured.device.mass import by_momentum, scan_of
from pipeline.measured.experiment.known_delay import with_delay
from pipeline.measured.stages.stage_given import Experiment
from pipeline.measured.stages.stage_groups import Columns, Given, TrialGroup
from pipeline.records.batch import Floats
from pipeline.records.tables import TABLES

WINDOWS_S = (0.005, 0.010, 0.015, 0.020, 0.030, 0.040, 0.060, 0.080)
"""Windows of the momentum balance [s] whose masses are compared; the thesis took 15 ms (6.1.2)."""


def columns(of: Experiment) -> Columns:
    """Return the columns of the stage."""
    given = with_delay(of)
    if "missing" in given:
        return {name: [] for name in TABLES["windows"]}
    found = of.of_each(_window_masses, **given)
    reasons = [[text for _, each in found for text in each[i]] for i in range(len(WINDOWS_S))]
    scan = scan_of(np.array(WINDOWS_S), np.concatenate([masses for masses, _ in found]), reasons)
    return {
        "window_s": scan.window_s,
        "mass_median": scan.median,
        "mass_scatter": scan.scatter,
        "trials": scan.trials,
        "reason": [text or None for text in scan.reason],
    }


def _window_masses(of: TrialGroup, given: Given) -> tuple[Floats, list[tuple[str, ...]]]:
    found = [by_momentum(of.batch, of.found, given["delay"], window_s=window) for window in WINDOWS_S]
    return np.stack([f.mass_momentum for f in found], axis=1), [f.reason for f in found]
