"""Stage `settling`: the settling times of each trial with their intervals."""

from __future__ import annotations

from math import floor

from pipeline.measured.cost import costs
from pipeline.measured.cost.cost_intervals import settling_interval
from pipeline.measured.cost.step_metrics import TOOLS, reconcile
from pipeline.measured.experiment.estimates import explaining_delay
from pipeline.measured.experiment.known_delay import delay_estimate, delay_range, whole_delay, with_delay
from pipeline.measured.stages.stage_columns import conditions, integer_column, joined_texts
from pipeline.measured.stages.stage_given import Experiment
from pipeline.measured.stages.stage_groups import Columns, Given, TrialGroup
from pipeline.measured.stages.stage_overshoot import error_of, sensor_of
from pipeline.records.findings import SETTLING_BANDS


def given_of(of: Experiment) -> Given:
    """Return what the stage takes from the whole experiment."""
    found = with_delay(of)
    if "missing" in found:
        return found
    first, last = delay_range(of.once(delay_estimate))
    samples = found["delay"]
    model = of.once(explaining_delay)
    if model is not None and model.value is not None:
        samples, first, last = (floor(whole_delay(model, end)) for end in (model.value, model.low, model.high))
    return {**sensor_of(of, samples), "delay_range": (min(first, samples), max(last, samples))}


def columns(of: TrialGroup, given: Given) -> Columns:
    """Return the columns of the stage for some trials."""
    samples = given["delay"]
    found = costs.settling(of.batch, of.found, of.verdicts, samples)
    interval = settling_interval(
        *(of.batch, of.found, error_of(of, given), found, samples), delay_range=tuple(given["delay_range"])
    )
    made = conditions(of) | {"reason": joined_texts(found.reason, interval.reason)}
    others = reconcile(of.batch, of.found, of.verdicts, samples).settling
    made |= {f"settle_{tool}": others[tool].value for tool in TOOLS}
    for name in SETTLING_BANDS:
        made[name] = integer_column(found.samples[name])
        made[f"{name}_low"], made[f"{name}_high"] = (
            integer_column(interval.low[name]),
            integer_column(interval.high[name]),
        )
    return made
