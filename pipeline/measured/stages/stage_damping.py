"""Stage `damping`: the viscous damping of each trial by its momentum balance, and its part of the joint balance."""

from __future__ import annotations

from pipeline.measured.device import damping, forces
from pipeline.measured.experiment.known_delay import with_delay
from pipeline.measured.stages.stage_columns import conditions, joined_texts
from pipeline.measured.stages.stage_given import Experiment, is_open_loop
from pipeline.measured.stages.stage_groups import Columns, Given, TrialGroup


def given_of(of: Experiment) -> Given:
    """Return what the stage takes from the whole experiment."""
    return {**with_delay(of), "pendulum": of.rotation and is_open_loop(of)}


def columns(of: TrialGroup, given: Given) -> Columns:
    """Return the columns of the stage for some trials."""
    begin, _ = of.beginning()
    found = damping.from_trials(begin.batch, begin.found, given["delay"])
    sums = forces.balance_sums(begin.batch, begin.found, given["delay"], pendulum=given["pendulum"])
    return conditions(of) | {
        "viscous_damping": found.viscous_damping,
        "balance_sums": list(sums),
        "reason": joined_texts(found.reason),
    }
