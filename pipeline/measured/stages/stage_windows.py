"""Stage `windows`: the mass of an experiment over the window of the momentum balance."""

from __future__ import annotations

import numpy as np

from pipeline.base.wording import commonest
from pipeline.measured.device.mass import by_momentum
from pipeline.measured.experiment.known_delay import with_delay
from pipeline.measured.stages.stage_given import Experiment
from pipeline.measured.stages.stage_groups import Columns, Given, TrialGroup
from pipeline.records.batch import Floats
from pipeline.records.tables import TABLES

WINDOWS_S = (0.005, 0.010, 0.015, 0.020, 0.030, 0.040, 0.060, 0.080)
"""Windows of the momentum balance [s] whose masses are compared; the thesis took 15 ms (6.1.2)."""

QUARTILES = 1.349
"""Distance of the quartiles of a normal distribution in standard deviations."""


def columns(of: Experiment) -> Columns:
    """Return the columns of the stage."""
    given = with_delay(of)
    if "missing" in given:
        return {name: [] for name in TABLES["windows"]}
    found = of.of_each(_window_masses, **given)
    masses = np.concatenate([each for each, _ in found])
    trials = np.isfinite(masses).sum(axis=0)
    median, scatter = np.full((2, len(WINDOWS_S)), np.nan)
    for i in np.flatnonzero(trials > 1):
        low, median[i], high = np.nanquantile(masses[:, i], (0.25, 0.5, 0.75))
        scatter[i] = (high - low) / QUARTILES
    return {
        "window_s": np.array(WINDOWS_S),
        "mass_median": median,
        "mass_scatter": scatter,
        "trials": trials,
        "reason": [commonest([t for _, each in found for t in each[i]]) or None for i in range(len(WINDOWS_S))],
    }


def _window_masses(of: TrialGroup, given: Given) -> tuple[Floats, list[tuple[str, ...]]]:
    found = [by_momentum(of.batch, of.found, given["delay"], window_s=window) for window in WINDOWS_S]
    return np.stack([f.mass_momentum for f in found], axis=1), [f.reason for f in found]
