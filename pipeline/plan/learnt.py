"""The device that the logs of an experiment show so far, from one log on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.measured.experiment.fitted_device import NAMES, PARTS, FittedDevice
from pipeline.measured.law.wall_law import wall_law
from pipeline.measured.model.intervals import BOUNDED, NEEDED, Errors, physical
from pipeline.measured.model.parts import Choice, again
from pipeline.measured.model.recordings import Recording
from pipeline.measured.model.told import is_told
from pipeline.measured.signal.response import Response, find_response
from pipeline.plan.found_device import FoundDevice
from pipeline.records.batch import TrialBatch
from pipeline.records.loop_parts import VelocityFilter

TRIALS, ROWS, AHEAD = 16, 300, 10
"""Logs that a device is fitted to, their rows from the step on, and those before it: a number known to 1 % from one log
is known to 0.3 % from these, and a log waits for it."""

AGAIN = 3
"""Parts of a device are looked for anew when there are so many times as many logs."""

Look = Callable[[list[Recording]], Choice | None]
"""What looks for the parts of a device; None as long as that goes on."""


@dataclass(frozen=True, eq=False)
class Learnt:
    """The device of some logs; None where they tell no mass. Its parts were looked for at so many logs."""

    choice: Choice
    device: FoundDevice | None
    looked: int


def learn(batch: TrialBatch, count: int, known: Learnt | None, look: Look) -> Learnt | None:
    """Return the device that trials of an experiment show, from that of fewer.

    Parameters
    ----------
    batch : TrialBatch
        Trials with K > 0: all, or `TRIALS` that are spread over the walls.
    count : int
        Number of all.
    known : Learnt or None
    look : callable
        Asked where the parts of the device are not known yet, or were looked for in a third of the logs.
    """
    order = np.lexsort((batch.stiffness, batch.damping))
    some = order[np.unique(np.linspace(0, len(order) - 1, TRIALS).astype(np.int64))]
    part = batch.select(some)
    response = find_response(part)
    recordings = recordings_of(part, response)
    if not any(np.ptp(each.position) > 0 for each in recordings):
        return known
    choice, looked = (None, 0) if known is None else (known.choice, known.looked)
    if count >= AGAIN * looked and (found := look(recordings)) is not None:
        choice, looked = found, count
    elif choice is not None:
        choice = again(choice, recordings)
    if choice is None:
        return None
    fitted = fitted_of(choice)
    if fitted is None:
        return Learnt(choice, None, looked)
    # a filter shows most where there is most damping
    most = np.array([np.argmax(part.damping)], dtype=np.int64)
    velocity = known.device.velocity if known is not None and known.device is not None else None
    velocity = velocity or filter_of(part.select(most), response.select(most))
    return Learnt(choice, FoundDevice(fitted, float(np.median(batch.sampling_period_s)), velocity), looked)


def recordings_of(batch: TrialBatch, response: Response) -> list[Recording]:
    """Return trials from shortly before the step on, as the model takes them."""
    found = []
    for i in range(len(batch)):
        edge = max(int(response.edge_row[i]), 0)
        rows = slice(max(edge - AHEAD, 0), min(int(batch.rows[i]), edge + ROWS))
        logged = (batch.time[i, rows], batch.command[i, rows], batch.position[i, rows])
        found.append(Recording(str(i), *logged, float(batch.sampling_period_s[i]), edge - rows.start))
    return found


def filter_of(batch: TrialBatch, response: Response) -> VelocityFilter | None:
    """Return the velocity filter that the wall law of the first trial shows."""
    departures = wall_law(batch, response).departures[0]
    found = next((each.filter for each in departures if each.filter is not None), None)
    return None if found is None else found.declared


def fitted_of(choice: Choice) -> FittedDevice | None:
    """Return the numbers of a fit in SI with their covariance; None where it does not tell the mass."""
    errors, quantities = Errors.of(choice.fit), physical(choice.scales)
    names = [name for name, number in NEEDED.items() if number in errors.numbers]
    if not is_told(errors.interval(quantities["mass"], "mass" in BOUNDED)):
        return None
    unit = np.array([1 / choice.scales.period if name == "delay" else 1.0 for name in names])
    covariance = errors.covariance([quantities[name] for name in names]) * np.outer(unit, unit)
    values = {NAMES[name]: quantities[name](errors.numbers) * each for name, each in zip(names, unit, strict=True)}
    late = 0 if "delay_samples" in values else 1
    return FittedDevice(
        tuple(PARTS[name] for name, gain in choice.parts.items() if gain > 0),
        values | ({"delay_samples": 0.0} if late else {}),
        np.pad(covariance, (0, late)),
    )
