"""Stage `damping`: the viscous damping of each trial by its momentum balance."""

from __future__ import annotations

from pipeline.measured.device import damping
from pipeline.measured.experiment.known_delay import with_delay
from pipeline.measured.stages.stage_columns import conditions, joined_texts
from pipeline.measured.stages.stage_given import Experiment
from pipeline.measured.stages.stage_groups import Columns, Given, TrialGroup


def given_of(of: Experiment) -> Given:
    """Return what the stage takes from the whole experiment."""
    return with_delay(of)


def columns(of: TrialGroup, given: Given) -> Columns:
    """Return the columns of the stage for some trials."""
    begin, _ = of.beginning()
    found = damping.from_trials(begin.batch, begin.found, given["delay"])
    return conditions(of) | {"viscous_damping": found.viscous_damping, "reason": joined_texts(found.reason)}
