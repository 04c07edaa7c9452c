"""Stage `ladder`: one device fitted to all trials of an experiment, where the ideal one does not explain them."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from pipeline.measured.experiment.estimates import FRICTION_GAIN, explains_itself, friction_gain
from pipeline.measured.experiment.rest_forces import rest_forces
from pipeline.measured.explained import EXPLAINED
from pipeline.measured.intervals import NORMAL_95
from pipeline.measured.ladder.device import LIMITS, Device
from pipeline.measured.ladder.ladder import FEWEST_TRIALS, Ladder, Rung, climb
from pipeline.measured.ladder.parts import GROUPS
from pipeline.measured.ladder.physical import in_si
from pipeline.measured.ladder.trials import LadderTrials, spread_over_plane, windowed
from pipeline.measured.stages.stage_given import Experiment
from pipeline.measured.stages.stage_groups import Columns, Given, TrialGroup
from pipeline.measured.stages.stage_likelihood import likeliest
from pipeline.records.batch import Booleans, Floats
from pipeline.records.tables import TABLES

OF_NO_MATTER = {
    *("velocity_filter", "adaptive_velocity", "constant_force"),
    *("step_not_a_step", "several_steps", "scattered_stamps"),
}
"""Departures from the wall law that leave command and readings what they are."""


def columns(of: Experiment) -> Columns:
    """Return the columns of the stage: a row for the best device, and for each like it; none where it is the ideal one.

    Where no linear device explains the trials, the best one is the likeliest, friction and scatter included.
    """
    rest = of.once(rest_forces)
    # what holds a device beside its place against its motion, and is no constant force, no linear device explains
    rubs = rest.tells and not (rest.constant or rest.spring) and friction_gain(of) > FRICTION_GAIN
    found = {"role": []} if rubs else _climbed(of)
    if found["role"]:
        return found
    return {name: [] for name in TABLES["ladder"]} if explains_itself(of) else likeliest(of)


def _climbed(of: Experiment) -> Columns:
    """Return the columns for a device that explains nearly all trials; no row where none does.

    Where the ideal device explains each trial by itself, it may be another one in each: a part that looks like mass,
    damping or delay is looked for then, others are not. Delays longer than those of a search are left alone.
    """
    chosen = _chosen(of)
    usable = _trials(of, chosen) if len(chosen) >= FEWEST_TRIALS else None
    if usable is None or len(usable[0]) < FEWEST_TRIALS:
        return {name: [] for name in TABLES["ladder"]}
    trials, stable = usable
    T = of.sampling_period_s
    explained = np.isfinite(of.column("model", "model_mass_error")).mean() >= EXPLAINED
    mass, damping, delay = (_typical(of, name) for name in ("mass", "damping", "delay"))
    if delay > LIMITS["delay"][1]:
        return {name: [] for name in TABLES["ladder"]}
    start = {"gain": float(np.log(T**2 / mass)), "delta": max(damping, 0.0) * T / mass, "delay": max(delay, 0.0)}
    found = climb(trials, Device(start), GROUPS[:1] if explained else GROUPS)
    if not found.best.holds or (explained and (found.ideal.holds or not found.best.parts)):
        return {name: [] for name in TABLES["ladder"]}
    numbers = in_si(found.best.device, _covering(found), T)
    others = [("alike", rung) for rung in found.alike]
    if found.next_best is not None:
        others.append(("next best", found.next_best))
    rungs = [("best", found.best), *others]
    obeyed = found.best.device.obeyed(trials.command)
    saturated = (obeyed != trials.command).any(axis=1)[stable]
    shown = [
        {
            "names": numbers.names,
            "values": numbers.values.tolist(),
            "covariance": numbers.covariance.tolist(),
            "saturated": float(saturated.mean()) if len(saturated) else 0.0,
        }
    ]
    return {
        "role": [role for role, _ in rungs],
        "parts": [_named(rung) for _, rung in rungs],
        "explained": [rung.explained for _, rung in rungs],
        "held_out": [rung.of for _, rung in rungs],
        "score": [rung.score for _, rung in rungs],
        "numbers": [json.dumps(each) for each in shown] + [None] * len(others),
    }


def _covering(found: Ladder) -> Floats:
    """Return the covariance of the best device's numbers, with a delay that holds those of the devices like it."""
    covariance, place = found.covariance.copy(), found.best.device.names.index("delay")
    delay = found.best.device.numbers["delay"]
    apart = max((abs(rung.device.numbers["delay"] - delay) for rung in found.alike), default=0.0)
    # theirs are known about as well as that of the best
    covariance[place, place] = (np.sqrt(covariance[place, place]) + apart / NORMAL_95) ** 2
    return covariance


def _named(rung: Rung) -> str:
    return ",".join(rung.parts)


def _typical(of: Experiment, name: str) -> float:
    return float(np.nanmedian(of.column("model", f"model_{name}")))


def _chosen(of: Experiment) -> frozenset[str]:
    """Return the ids of the trials that are looked at; none where no trial tells a mass."""
    if not np.isfinite(of.column("model", "model_mass")).any():
        return frozenset()
    codes = [set(filter(None, text.split(","))) for text in of.texts("wall_law", "law_codes")]
    usable = np.array([each <= OF_NO_MATTER for each in codes])
    stiffness, damping = of.column("response", "stiffness"), of.column("response", "damping")
    # without a wall a device does not rest under a force beside the command, and friction looks like one
    usable &= stiffness > 0
    ids = of.texts("response", "trial_id")
    return frozenset(ids[i] for i in spread_over_plane(stiffness, damping, usable))


def _trials(of: Experiment, chosen: frozenset[str]) -> tuple[LadderTrials, Booleans] | None:
    """Return the chosen trials in the order of damping and stiffness, and which are stable; None where none fits."""
    parts = [part for part in of.of_each(windows, chosen=sorted(chosen)) if part is not None]
    if not parts:
        return None
    stiffness, damping = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
    order = np.lexsort((stiffness, damping))
    verdict = dict(zip(of.texts("response", "trial_id"), of.verdicts.verdict.tolist(), strict=True))
    stable = np.array([verdict[name] == "stable" for part in parts for name in part[3]])
    return LadderTrials.joined([part[2] for part in parts]).select(order), stable[order]


def windows(group: TrialGroup, given: Given) -> tuple[Any, Any, LadderTrials, tuple[str, ...]] | None:
    """Return stiffness, damping, windows and names of the chosen trials of a group that can be fitted."""
    of, _ = group.beginning()
    some = np.array([name in set(given["chosen"]) for name in of.batch.trial_id])
    if not some.any():
        return None
    batch = of.batch.select(np.flatnonzero(some))
    good, trials = windowed(batch, of.found.select(np.flatnonzero(some)))
    return None if trials is None else (batch.stiffness[good], batch.damping[good], trials, batch.select(good).trial_id)
