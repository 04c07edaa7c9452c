"""Stage `boundary`: the measured stability boundary of an experiment, one row a damping."""

from __future__ import annotations

from pipeline.measured.experiment.boundary_band import boundary_band
from pipeline.measured.stages.stage_given import Experiment
from pipeline.measured.stages.stage_groups import Columns
from pipeline.records.tables import TABLES


def columns(of: Experiment) -> Columns:
    """Return the columns of the stage."""
    points = boundary_band(
        of.column("response", "stiffness"),
        of.column("response", "damping"),
        of.verdicts.verdict,
        of.verdicts.growth_per_s,
    )
    return {name: [getattr(p, name) for p in points] for name in TABLES["boundary"]}
