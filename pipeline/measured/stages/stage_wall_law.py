"""Stage `wall_law`: whether the logged command of each trial obeys the wall law, and why not."""

from __future__ import annotations

import json
from dataclasses import asdict

from pipeline.measured.law.candidates import Departure
from pipeline.measured.signal.lag import lags_of
from pipeline.measured.stages.stage_columns import conditions
from pipeline.measured.stages.stage_groups import Columns, Given, TrialGroup


def columns(of: TrialGroup, given: Given) -> Columns:
    """Return the columns of the stage for some trials."""
    law, lags, obeyed = of.law, lags_of(of.logged), of.other_walls.obeyed
    return conditions(of) | {
        "law_residual": law.residual,
        "law_rounding": law.rounding,
        "law_codes": [",".join(each.code for each in found) for found in law.departures],
        "law_evidence": ["; ".join(each.evidence for each in found) for found in law.departures],
        "law_rows": [max((each.rows for each in found), default=0) for found in law.departures],
        **{f"obeyed_{name}": obeyed[:, i] for i, name in enumerate(("stiffness", "damping", "step"))},
        "velocity_filter": [_filter(found) for found in law.departures],
        "velocity_lag": [each.lag_s for each in lags],
        "velocity_lag_error": [each.standard_error_s for each in lags],
    }


def _filter(found: tuple[Departure, ...]) -> str | None:
    return next((json.dumps(asdict(each.filter)) for each in found if each.filter is not None), None)
