"""Stage `model`: the model fitted to the whole response of each trial, and the loop simulated with it."""

from __future__ import annotations

import numpy as np

from pipeline.measured.fit import fit
from pipeline.measured.fit.ghost import simulate_ghost
from pipeline.measured.signal.response import NO_ROW
from pipeline.measured.stages.stage_columns import conditions, joined_texts, row_column
from pipeline.measured.stages.stage_groups import Columns, Given, TrialGroup


def columns(of: TrialGroup, given: Given) -> Columns:
    """Return the columns of the stage for some trials."""
    begin, first = of.beginning()
    found = fit.fit_trials(begin.batch, begin.found)
    beside = simulate_ghost(of.batch, of.found, found.mass, found.damping, found.delay)
    named = ("mass", "damping", "delay", "jitter")
    return conditions(of) | {
        **{f"model_{name}": getattr(found, name) for name in named},
        **{f"model_{name}_error": getattr(found, f"{name}_error") for name in named},
        "model_start": found.start,
        "misfit": found.misfit,
        "whiteness": found.whiteness,
        "friction_gain": found.friction_gain,
        "leaves_row": row_column(np.where(found.leaves_row < 0, NO_ROW, found.leaves_row + first)),
        "ghost_deviation": beside.deviation,
        "ghost_relative": beside.relative,
        "ghost_row": row_column(beside.leaves_row),
        "reason": joined_texts(found.reason),
    }
