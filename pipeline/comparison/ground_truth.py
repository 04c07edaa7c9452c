"""Ground truth of simulated experiments, which is compared with estimates and limits.

The simulator writes ``truth.json`` next to its logs. No estimate uses it.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from pipeline.base.errors import ParameterError
from pipeline.device.loop import Loop
from pipeline.device.parts import LoopTable
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.records.findings import BoundaryPoint, Estimate, holds
from pipeline.records.results import SourcedLoop, Truth, TruthHeld
from pipeline.simulation.simulate import applied_delay_moments
from pipeline.theory.boundary import stiffness_limit
from pipeline.theory.predictions import Theory

TRUTH_FILE = "truth.json"

_MOVES_THE_LIMIT = ("one_sided_wall", "clock_error", "held_samples")
"""Options of a simulation with which the loop differs from the linear loop of its device file."""


def truths(stages: tuple[ExperimentStages, ...], given: Mapping[str, Truth]) -> dict[str, Truth]:
    """Return the ground truth of each simulated experiment, from its file or otherwise from ``given``."""
    found = {each.experiment: _truth(each) or given.get(each.experiment) for each in stages}
    return {name: truth for name, truth in found.items() if truth is not None}


def _truth(stages: ExperimentStages) -> Truth | None:
    """Return the truth in the folder of an experiment's logs, or None if the file does not list all of them."""
    if not all(stages.trials.column("simulated").to_pylist()):
        return None
    paths = stages.trials.column("source_path").to_pylist()
    folders = {os.path.dirname(path) for path in paths}
    if len(folders) != 1:
        return None
    try:
        document = json.loads(Path(folders.pop(), TRUTH_FILE).read_text(encoding="utf-8"))
        known = {os.path.basename(path) for path in paths} <= set(document["logs"])
        return truth_of(document) if known else None
    except (OSError, ValueError, KeyError, TypeError, ValidationError):
        return None  # the file is optional; it may be incomplete or written by another program


def truth_of(document: Mapping[str, Any]) -> Truth:
    """Return the truth from a document of the simulator.

    Raises
    ------
    KeyError, ValueError
        If the document has another form.
    """
    hidden, jitter = document["simulation"], document["jitter_samples"]
    table = LoopTable.model_validate(document["loop"])
    doubts = ["the delay jitters"] if jitter else []
    doubts += ["there is friction"] if table.friction else []
    doubts += [f"the simulation has {name.replace('_', ' ')}" for name in _MOVES_THE_LIMIT if hidden[name]]
    delay, spread = applied_delay_moments(jitter) if jitter else (document["delay_samples"], 0.0)
    parts = dict(table) | {"force_gain": table.force_gain * (1 + hidden["gain_error"])}
    period = document["sampling_period_s"]
    loop = Loop(**document["plant"], sampling_period_s=period, delay_samples=delay, **parts)
    known = SourcedLoop(loop=loop, source="simulator")
    reason = f"{' and '.join(doubts)}: linear theory gives no limit for this loop" if doubts else None
    try:
        Theory(known).normalised  # noqa: B018
    except ParameterError as error:
        reason = reason or str(error)
    return Truth(
        loop=known,
        jitter_samples=spread,
        constant_force=hidden["constant_force"],
        limit_reason=reason,
    )


def true_limits(truth: Truth | None, dampings: Sequence[float]) -> list[float | None]:
    """Return the largest stable stiffness of the true loop at each damping.

    A stiffness is 0 if no wall is stable. The result is None if the true loop is unknown.
    """
    if truth is None or truth.limit_reason or not dampings:
        return [None] * len(dampings)
    theory = Theory(truth.loop)
    limit = stiffness_limit(theory.normalised, np.array(dampings) / theory.units.damping) * theory.units.stiffness
    return [float(each) for each in np.maximum(limit, 0.0)]


def truth_held(estimates: Iterable[Estimate], boundary: Iterable[BoundaryPoint]) -> TruthHeld:
    """Return the number of intervals with a known truth, and the number of those that contain it."""
    judged = [held for held in map(_holds, estimates) if held is not None]
    seen = [held for held in map(_holds, boundary) if held is not None]
    return TruthHeld(estimates=len(judged), estimates_held=sum(judged), limits=len(seen), limits_held=sum(seen))


def _holds(found: Estimate | BoundaryPoint) -> bool | None:
    """Return whether a 95 % interval contains the truth, or None if the interval or the truth is missing."""
    value = found.estimate if isinstance(found, BoundaryPoint) else found.value
    if value is None or found.truth is None or found.low is None or found.high is None:
        return None
    return holds(found.low, found.truth, found.high)
