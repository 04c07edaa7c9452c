"""Stage `mass`: the mass of each trial by momentum balances, as those of the thesis and with friction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyarrow as pa

from pipeline.measured.device import friction, mass
from pipeline.measured.experiment.estimates import damping_estimate
from pipeline.measured.experiment.known_delay import with_delay
from pipeline.measured.stages.stage_columns import conditions, joined_texts
from pipeline.measured.stages.stage_given import Experiment, is_open_loop
from pipeline.measured.stages.stage_groups import Columns, Given, TrialGroup

BALANCE_TERMS = ("damping", "friction")
"""Forces that the corrected momentum balance allows for beside the inertia: those of every drive."""

OPEN_LOOP_TERMS = ("damping", "friction", "start")
"""As `BALANCE_TERMS` for logs without a wall: their delay is uncertain, so that momentum may be missing at the start.
A rotating device in the open loop may be a pendulum, for which gravity is added."""


def given_of(of: Experiment) -> Given:
    """Return what the stage takes from the whole experiment."""
    return {**with_delay(of), "open_loop": is_open_loop(of), "rotation": of.rotation}


def columns(of: TrialGroup, given: Given) -> Columns:
    """Return the columns of the stage for some trials."""
    nothing = np.full(len(of.batch), np.nan)
    samples = given["delay"]
    begin, _ = of.beginning()
    found = mass.by_momentum(begin.batch, begin.found, samples)
    terms: tuple[str, ...] = BALANCE_TERMS
    if given["open_loop"]:
        terms = (*OPEN_LOOP_TERMS, "gravity") if given["rotation"] else OPEN_LOOP_TERMS
        samples = 0  # the start term stands for the delay, which friction hides
    balance = _told(friction.fit_balance(begin.batch, begin.found, samples, terms=terms))
    made = conditions(of) | {
        "mass_momentum": found.mass_momentum,
        "damping_share": found.damping_share,
        "mass": nothing,
        "balance_mass": balance.mass,
        "balance_mass_error": balance.mass_error,
        "force_mass": nothing,
        "force_mass_error": nothing,
        "reason": joined_texts(found.reason, balance.reason),
    }
    if begin.batch.force is not None:
        # a force measured at the device has passed the delay already
        force = _told(
            friction.fit_balance(begin.batch, begin.found, 0, terms=terms, force=begin.batch.force, held=False)
        )
        made |= {"force_mass": force.mass, "force_mass_error": force.mass_error}
    return made


def _told(balance: friction.BalanceFit) -> friction.BalanceFit:
    """Return the balance without the masses of which friction may be a part: those of trials that do not tell it."""
    lost = ["friction is not told" in text for text in balance.dropped]
    reason = tuple(
        f"no balance with friction: {text}" if without else ""
        for text, without in zip(balance.dropped, lost, strict=True)
    )
    return replace(balance, mass=np.where(lost, np.nan, balance.mass), reason=reason)


def corrected(of: Experiment, rows: pa.Table) -> Columns:
    """Return the columns that follow from the others by the damping of the whole experiment."""
    plain, share = (rows.column(name).to_numpy() for name in ("mass_momentum", "damping_share"))
    found = mass.Masses(plain, share, ())
    b = of.once(damping_estimate).value
    return {"mass": np.full(rows.num_rows, np.nan) if b is None else mass.correct(found, b)}
