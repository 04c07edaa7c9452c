"""Stage `boundary`: the measured stability boundary of an experiment, one row a damping."""

from __future__ import annotations

import numpy as np

from pipeline.measured.experiment.boundary_band import boundary_band
from pipeline.measured.stages.stage_given import Experiment
from pipeline.measured.stages.stage_groups import Columns
from pipeline.records.tables import TABLES


def columns(of: Experiment) -> Columns:
    """Return the columns of the stage, of the trials whose command obeys the stated wall."""
    stated = np.isnan(of.column("wall_law", "obeyed_stiffness"))
    points = boundary_band(
        of.column("response", "stiffness")[stated],
        of.column("response", "damping")[stated],
        of.verdicts.verdict[stated],
        of.verdicts.growth_per_s[stated],
    )
    return {name: [getattr(p, name) for p in points] for name in TABLES["boundary"]}
