"""Stage `response`: edge, final position, resolution and verdict of each trial."""

from __future__ import annotations

import numpy as np

from pipeline.measured.signal import verdict
from pipeline.measured.stages.stage_columns import conditions, joined_texts, row_column
from pipeline.measured.stages.stage_groups import Columns, Given, TrialGroup


def columns(of: TrialGroup, given: Given) -> Columns:
    """Return the columns of the stage for some trials."""
    found = of.found
    judged = verdict.judge(of.batch, found)
    # whatever it shows, it shows of another wall
    other = np.array([bool(text) for text in of.other_walls.reason])
    return conditions(of) | {
        "verdict": list(np.where(other, "undecided", judged.verdict)),
        "reason": joined_texts(of.other_walls.reason, judged.reason, found.reason),
        "growth_per_s": np.where(other, np.nan, judged.growth_per_s),
        "edge_row": row_column(found.edge_row),
        **{name: getattr(found, name) for name in ("position_start", "position_final_expected")},
        **{name: getattr(found, name) for name in ("position_final_measured", "sensor_quantum", "sensor_noise")},
    }
