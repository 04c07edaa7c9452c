"""Stage `delay`: the delay of each trial by its first position change and by the onset of its motion."""

from __future__ import annotations

from pipeline.measured.device import delay, onset
from pipeline.measured.stages.stage_columns import conditions, joined_texts, row_column
from pipeline.measured.stages.stage_groups import Columns, Given, TrialGroup


def columns(of: TrialGroup, given: Given) -> Columns:
    """Return the columns of the stage for some trials."""
    first = delay.first_change(of.batch, of.found)
    began = onset.motion_onset(of.batch, of.found, first)
    return conditions(of) | {
        "delay_samples": row_column(onset.rounded(first, began)),
        "first_change_samples": row_column(first.delay_samples),
        "onset_samples": began.delay_samples,
        "onset_error": began.standard_error,
        "reason": joined_texts(first.reason),
    }
