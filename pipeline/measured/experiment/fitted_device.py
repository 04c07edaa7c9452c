"""The device that was fitted to all trials of an experiment, as the stage `device` stores it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf

import numpy as np

from pipeline.measured.experiment.stored import Stored
from pipeline.measured.student import NORMAL_95
from pipeline.records.batch import Floats
from pipeline.records.findings import ROUNDING, Estimate, Parameter

METHOD = "one device, the likeliest of all trials"

NAMES = {
    "mass": "mass",
    "damping": "damping",
    "stiffness": "stiffness",
    "delay": "delay_samples",
    "friction": "coulomb",
    "constant_force": "constant_force",
    "actuator_lag": "actuator_lag_s",
    "mode_frequency": "frequency_hz",
    "mode_damping_ratio": "damping_ratio",
    "mode_mass": "far_mass",
    "load_damping": "load_damping",
    "force_limit": "force_limit",
}
"""Numbers of a fitted device by those of the model."""

PARTS = {"stiffness": "spring", "mode": "mode at the motor"}
"""Parts of a fitted device by those of the model, where these have other names."""

FORCES = {"coulomb": "step", "constant_force": "step", "force_limit": "command"}
"""Numbers that are forces, and the largest of what they are known by: one that is known to no better is not known."""

SIGNED = ("stiffness", "constant_force")
"""Numbers that may be negative: a device about to tip over has a stiffness below 0. No other one is, at either end."""

NOT_IDENTIFIABLE = "not identifiable: {}. Record {}"
"""Reason of a number that logs leave open, with the remedy."""

ANY_FORCE = "its 95 % interval is wider than the largest {}, {:.3g}, since other parts of the device act alike"
ANY_SPRING = "any spring that is too soft to be seen in these motions explains them as well"
OPEN = "other parts of the device explain these logs as well"

MORE = "more logs of several sizes and directions"
"""Remedy where no better one is known."""

FEWEST_LOGS = 3
"""Logs below which what they show is an accident."""

MOST = 0.5
"""Share of the logs of an experiment from which on what they show is the experiment's: its device, its filter, why it
tells nothing."""


@dataclass(frozen=True, eq=False)
class FittedDevice:
    """The likeliest device of all trials.

    Parameters
    ----------
    parts : tuple of str
        What it has beside mass, damper and delay.
    explained, trials : int, tuple of str
        Number of trials that it explains with its noise; ids of those it was fitted to, in the order of the folds.
    values : dict of str to float
        Its numbers in SI by name.
    covariance : float64, shape (P, P)
        Of these: what the device does not explain is in it.
    saturated : float
        Share of the stable trials that command more force than it has.
    open : tuple of str
        Names of its numbers that the logs leave open.
    scatter : dict of str to float
        Standard deviations from run to run by name.
    folds : tuple of dict of str to float
        Its values by the trials but every fifth from the first, the second ... on; empty where they are not known.
    bounds : dict of str to float
        Upper ends of numbers that it does not have, and the other end of a delay that may be part of a lag of less than
        a sample, or have one as a part.
    jitter : tuple of float
        Standard deviation of the delay within a trial [samples], and the error of it.
    fit_percent : float or None
        Median fit of its free runs to logs that it was not fitted to.
    command, step, travel : float
        Largest command and largest step [N, Nm], and range of the positions [m, rad] of its logs; infinite and 0 where
        not known.
    remedy : str
        What to record so that parts which act alike are separated.
    """

    parts: tuple[str, ...]
    values: dict[str, float]
    covariance: Floats
    explained: int = 0
    trials: tuple[str, ...] = ()
    saturated: float = 0.0
    open: tuple[str, ...] = ()
    scatter: Mapping[str, float] = field(default_factory=dict)
    folds: tuple[Mapping[str, float], ...] = ()
    bounds: Mapping[str, float] = field(default_factory=dict)
    jitter: tuple[float, float] = (0.0, 0.0)
    fit_percent: float | None = None
    command: float = inf
    step: float = inf
    travel: float = 0.0
    remedy: str = MORE

    @property
    def tells(self) -> bool:
        """Whether it explains enough trials for its parts to be real."""
        return self.explained >= MOST * len(self.trials)

    def parameter(self, name: str) -> Parameter | None:
        """Return one of its numbers with its 95 % interval; None where it has none."""
        return self.with_interval(name) if name in self.values else None

    def with_interval(self, name: str) -> Parameter:
        """Return one of the numbers that it has with its 95 % interval."""
        value = self.values[name]
        reach = NORMAL_95 * float(np.sqrt(self.covariance[(place := list(self.values).index(name)), place]))
        end = self.bounds.get(name, value)
        if self.trials:  # no number of a fit is known better than it is computed
            reach = max(reach, ROUNDING * abs(value))
        low, high = min(value, end) - reach, max(value, end) + reach
        if name not in SIGNED and value >= 0:
            low = max(low, 0.0)
        return Parameter(value=value, low=low, high=high)

    def why_unknown(self, name: str) -> str:
        """Return why a number, or the bound of one that it does not have, means nothing, with the remedy; else ''."""
        number = self.parameter(name)
        wide = self.bounds.get(name, 0.0) if number is None else 0.5 * (number.high - number.low)
        if name in FORCES and not wide <= (most := getattr(self, FORCES[name])):
            return NOT_IDENTIFIABLE.format(ANY_FORCE.format(FORCES[name], most), self.remedy)
        if name == "stiffness" and not wide * self.travel <= self.command:
            return NOT_IDENTIFIABLE.format(ANY_SPRING, "larger motions, or " + self.remedy)
        return ""

    def estimate(self, name: str, unit: str) -> Estimate:
        """Return one of its numbers as an estimate; of one that it does not have at most a bound."""
        number, count = self.parameter(name), len(self.trials)
        if why := self.why_unknown(name):
            return Estimate(value=None, unit=unit, method=METHOD, reason=why, trials=count)
        if number is None:
            high = self.bounds.get(name)
            low, reason = None if high is None else 0.0, "the logs are explained as well without it"
            return Estimate(value=None, low=low, high=high, unit=unit, method=METHOD, reason=reason, trials=count)
        found = number.model_dump()
        if name in self.open:
            found |= {"value": None, "reason": NOT_IDENTIFIABLE.format(OPEN, self.remedy)}
        elif (hidden := number.value - self.bounds.get(name, number.value)) > 0:
            found["warning"] = f"up to {hidden:.2g} {unit} of it may be a lag of the drive: logs do not tell which"
        return Estimate(**found, unit=unit, method=METHOD, trials=count)


def fitted_device(of: Stored) -> FittedDevice | None:
    """Return the device of an experiment, None where its logs tell no mass."""
    numbers = json.loads(of.texts("device", "numbers")[0])
    if not numbers["names"]:
        return None
    return FittedDevice(
        tuple(numbers["parts"]),
        dict(zip(numbers["names"], numbers["values"], strict=True)),
        np.array(numbers["covariance"]),
        numbers["explained"],
        tuple(numbers["trials"]),
        numbers["saturated"],
        tuple(numbers["open"]),
        numbers["scatter"],
        tuple(numbers["folds"]),
        numbers["bounds"],
        tuple(numbers["jitter"]),
        numbers["fit_percent"],
        numbers["command"],
        numbers["step"],
        numbers["travel"],
        numbers["remedy"],
    )
