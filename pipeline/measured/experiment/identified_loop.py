"""Read the identified loop of an experiment from the stage `device`, which stores it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from math import inf
from typing import Any, Literal

import numpy as np

from pipeline.device.loop import Loop
from pipeline.device.parameters import PARAMETERS, Motion
from pipeline.device.parts import Friction, Mode, VelocityFilter
from pipeline.loop.normalised_loop import LARGEST_DELAY
from pipeline.measured.experiment.stored import Experiment
from pipeline.measured.identification.first_fit import UNSEEN_FRICTION
from pipeline.measured.identification.identifiability import IdentifiableCombination
from pipeline.measured.identification.intervals import Interval
from pipeline.measured.student import NORMAL_95
from pipeline.records.findings import ROUNDING, Estimate
from pipeline.records.trials import Floats

METHOD = "maximum-likelihood device of all trials"

NOMINAL = (
    *("mass", "damping", "stiffness", "delay_samples", "actuator_lag_s"),
    *("mode.frequency_hz", "mode.damping_ratio", "mode.mass", "mode.load_damping", "friction.coulomb"),
    "constant_force",
)
"""Parameters of a nominal loop, i.e. the loop of a device file."""

ABSENT = ("actuator_lag_s", "constant_force")
"""Parameters of `NOMINAL` that belong to optional parts. A loop in which they are 0 does not have these parts."""

NOT_IDENTIFIABLE = "not identifiable: {}. Record {}"
"""Reason why the logs do not identify a parameter, followed by the remedy."""

ANY_FORCE = (
    "the half-width of its 95 % interval exceeds the largest {} ({:.3g}), because other parts have similar effects"
)
ANY_SPRING = "any spring that is too soft to be visible in these motions explains them equally well"
OPEN = "other parts of the device explain these logs equally well"

MORE = "more logs of several sizes and directions"
"""Remedy if no specific remedy is known."""

FEWEST_LOGS = 3
"""Smallest number of logs with a common property that is not attributed to chance."""

NOT_NEEDED = "the logs are explained equally well without it"
"""Reason for a parameter that the logs do not require."""

MOST = 0.5
"""Smallest share of the logs that must have a property before it is attributed to the experiment: its device, its
filter, or the reason why its device is not identified."""

SMALLEST = 1e-3
"""Smallest value of three ratios: the mass on one side of a mode to the total mass, a positive parameter at an end of
its interval to its value, and the lag to the sampling period. The effect of a smaller ratio on any limit is less than a
thousandth."""


@dataclass(frozen=True, eq=False)
class IdentifiedLoop:
    """Maximum-likelihood loop of all trials, per unit of command, with the covariance of its parameters.

    Parameters
    ----------
    values : dict of str to float
        Parameters in SI by name, in the order of `PARAMETERS`.
    covariance : float64, shape (P, P)
        Covariance of the parameters, including the effect of unmodelled behaviour.
    sampling_period_s : float
        T [s].
    motion : {"translation", "rotation"}
        Kind of motion, which determines the units.
    parts : tuple of str
        Parts in addition to mass, damper and delay: ``friction``, ``spring``, ``saturation``, ``lag``, ``mode``,
        ``load damping``.
    mode_sensor : {"motor", "load"}
        Side of a mode whose position is measured.
    velocity : VelocityFilter, optional
        Velocity filter of the controller.
    explained : int
        Number of trials explained by the loop and its noise.
    trials : tuple of str
        Ids of the fitted trials, in the order of the folds.
    saturated : float
        Share of the stable trials that command more force than the device can produce.
    unidentifiable : tuple of str
        Names of parameters whose values are not identifiable.
    combinations : tuple of IdentifiableCombination
        Identifiable combinations of these parameters.
    scatter : dict of str to float
        Standard deviations of parameters from run to run.
    folds : tuple of dict of str to float
        Values if one fold of the trials is left out (every fifth trial, starting at the first, the second and so on).
        The tuple is empty if they are unknown.
    bounds : dict of str to float
        Upper ends of parameters that the loop does not have. If the delay cannot be separated from a lag below one
        sample, ``bounds`` also contains the other end of the delay.
    jitter : tuple of float
        Standard deviation of the delay within a trial [samples], and its error.
    fit_percent : float or None
        Median fit of free runs to logs that were not used in the fit.
    command, step, travel : float
        Largest command and largest step [N, Nm], and range of the positions [m, rad] of the logs. If unknown, the
        command and the step are infinite, and the range is 0.
    remedy : str
        Recommended recording to separate parts with the same effect.
    directions : int
        Number of directions of motion in the logs, 1 or 2.

    Examples
    --------
    >>> values = {"mass": 0.5, "damping": 3.0, "delay_samples": 4.0}
    >>> device = IdentifiedLoop(values, np.diag([1e-4, 0.01, 0.0025]), 0.001)
    >>> device.loop.mass, round(device.interval("damping").high, 3)
    (0.5, 3.196)
    """

    values: Mapping[str, float]
    covariance: Floats
    sampling_period_s: float
    motion: Motion = "translation"
    parts: tuple[str, ...] = ()
    mode_sensor: Literal["motor", "load"] = "motor"
    velocity: VelocityFilter | None = None
    explained: int = 0
    trials: tuple[str, ...] = ()
    saturated: float = 0.0
    unidentifiable: tuple[str, ...] = ()
    combinations: tuple[IdentifiableCombination, ...] = ()
    scatter: Mapping[str, float] = field(default_factory=dict)
    folds: tuple[Mapping[str, float], ...] = ()
    bounds: Mapping[str, float] = field(default_factory=dict)
    jitter: tuple[float, float] = (0.0, 0.0)
    fit_percent: float | None = None
    command: float = inf
    step: float = inf
    travel: float = 0.0
    remedy: str = MORE
    directions: int = 2

    @cached_property
    def loop(self) -> Loop:
        """Maximum-likelihood loop, with friction and a constant force."""
        return self.at(self.values)

    def at(self, values: Mapping[str, float]) -> Loop:
        """Return the loop with the given parameter values. A negative damping, stiffness or delay is set to 0."""
        mass, damping, mode = values["mass"], max(values["damping"], 0.0), None
        if "mode.mass" in values:
            mode = Mode(
                frequency_hz=values["mode.frequency_hz"],
                damping_ratio=max(values["mode.damping_ratio"], 0.0),
                mass=min(max(values["mode.mass"], SMALLEST * mass), (1 - SMALLEST) * mass),
                sensor=self.mode_sensor,
                load_damping=min(max(values.get("mode.load_damping", 0.0), 0.0), damping),
            )
        lag = max(values.get("actuator_lag_s", 0.0), 0.0)
        coulomb = values.get("friction.coulomb", 0.0) if "friction" in self.parts else 0.0
        return Loop(
            mass,
            damping,
            self.sampling_period_s,
            min(max(values["delay_samples"], 0.0), LARGEST_DELAY),
            max(values.get("stiffness", 0.0), 0.0),
            motion=self.motion,
            velocity=self.velocity,
            actuator_lag_s=lag if lag > SMALLEST * self.sampling_period_s else 0.0,
            mode=mode,
            friction=Friction(coulomb=coulomb) if coulomb > 0 else None,
            constant_force=values.get("constant_force", 0.0),
        )

    @cached_property
    def ends(self) -> tuple[tuple[Loop, Loop], ...]:
        """Loops at both ends of each principal axis of the 95 % region, and a pair with the longest lag that the delay
        may include. The tuple is empty if the parameters are exact."""
        if not self.covariance.any():
            return ()
        ends = [(self.shifted(-axis), self.shifted(axis)) for axis in self.axes]
        if lag := self.bounds.get("actuator_lag_s", 0.0):
            late = self.values["delay_samples"] - lag / self.sampling_period_s
            ends.append((self.loop, self.at({**self.values, "delay_samples": late, "actuator_lag_s": lag})))
        return tuple(ends)

    @cached_property
    def axes(self) -> Floats:
        """Semi-axes of the 95 % region of the parameters in rows, shape (P, P)."""
        scale = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        size = np.where(scale > 0, scale, 1.0)
        variance, axes = np.linalg.eigh(self.covariance / np.outer(size, size))
        return np.asarray(NORMAL_95 * np.sqrt(np.maximum(variance, 0.0))[:, None] * axes.T * size)

    def shifted(self, step: Floats) -> Loop:
        """Return the loop after a step of its parameters, shape (P,). Mass and mode frequency stay positive."""
        now = np.array(list(self.values.values()))
        positive = np.isin(list(self.values), ("mass", "mode.frequency_hz"))
        moved = np.where(positive, np.maximum(now + step, SMALLEST * now), now + step)
        return self.at(dict(zip(self.values, moved.tolist(), strict=True)))

    @property
    def is_reliable(self) -> bool:
        """Whether the loop explains enough trials for its parts to be trusted."""
        return self.explained >= MOST * len(self.trials)

    @property
    def may_have_friction(self) -> bool:
        """Whether the loop has friction, or friction cannot be excluded."""
        unseen = self.bounds.get("friction.coulomb", 0.0)
        return "friction.coulomb" in self.values or unseen > UNSEEN_FRICTION * self.step

    def interval(self, name: str) -> Interval:
        """Return one of the loop's parameters with its 95 % interval."""
        value = self.values[name]
        reach = NORMAL_95 * float(np.sqrt(self.covariance[(place := list(self.values).index(name)), place]))
        end = self.bounds.get(name, value)
        if self.trials:  # the numerical accuracy is a lower bound for a fitted parameter
            reach = max(reach, ROUNDING * abs(value))
        low, high = min(value, end) - reach, max(value, end) + reach
        if not PARAMETERS[name].may_seem_negative and value >= 0:
            low = max(low, 0.0)
        return Interval(value, low, high)

    def why_unknown(self, name: str) -> str:
        """Return why the value of a parameter, or the bound of an absent parameter, is meaningless, with the remedy.

        The text is empty if the value or the bound is meaningful.
        """
        number = self.interval(name) if name in self.values else None
        wide = self.bounds.get(name, 0.0) if number is None else 0.5 * (number.high - number.low)
        if PARAMETERS[name].dimension == "force":
            # a force whose error exceeds the largest force in the logs is unknown
            by, most = ("command", self.command) if name == "force_limit" else ("step", self.step)
            if not wide <= most:
                return NOT_IDENTIFIABLE.format(ANY_FORCE.format(by, most), self.remedy)
        if name == "stiffness" and not wide * self.travel <= self.command:
            return NOT_IDENTIFIABLE.format(ANY_SPRING, "larger motions, or " + self.remedy)
        return ""

    def estimate(self, name: str, unit: str) -> Estimate:
        """Return a parameter as an estimate. If the loop does not have the parameter, the estimate contains at most a
        bound."""
        number, count = self.interval(name) if name in self.values else None, len(self.trials)
        if why := self.why_unknown(name):
            return Estimate(value=None, unit=unit, method=METHOD, reason=why, trials=count)
        if number is None:
            high = self.bounds.get(name)
            low, reason = None if high is None else 0.0, NOT_NEEDED
            return Estimate(value=None, low=low, high=high, unit=unit, method=METHOD, reason=reason, trials=count)
        unknown, warning = name in self.unidentifiable, None
        if not unknown and (hidden := number.value - self.bounds.get(name, number.value)) > 0:
            warning = f"up to {hidden:.2g} {unit} of it may be a lag of the drive: these logs cannot separate the two"
        return Estimate(
            value=None if unknown else number.value,
            low=number.low,
            high=number.high,
            unit=unit,
            method=METHOD,
            reason=NOT_IDENTIFIABLE.format(OPEN, self.remedy) if unknown else None,
            trials=count,
            warning=warning,
        )


def parts_of(gains: Mapping[str, float]) -> tuple[tuple[str, ...], Literal["motor", "load"]]:
    """Return the parts of a loop and the side at which its mode is measured, from the gains of the model's parts."""
    names = [name for name, gain in gains.items() if gain > 0]
    parts = tuple({"stiffness": "spring", "mode at the load": "mode"}.get(name, name) for name in names)
    return parts, "load" if "mode at the load" in names else "motor"


def identified_loop(of: Experiment) -> IdentifiedLoop | None:
    """Return the identified loop of an experiment from its stage `device`, or None if its mass is not identified."""
    (row,) = of.table("device").to_pylist()
    return None if row["parameter_names"] is None else loop_from_row(row, of.sampling_period_s, of.motion)


def loop_from_row(row: Mapping[str, Any], sampling_period_s: float, motion: Motion = "translation") -> IdentifiedLoop:
    """Return the identified loop from a row of the stage `device`."""
    names = row["parameter_names"]
    return IdentifiedLoop(
        dict(zip(names, row["parameter_values"], strict=True)),
        np.array(row["covariance"]).reshape(len(names), -1),
        sampling_period_s,
        motion,
        tuple(row["parts"]),
        row["mode_sensor"],
        explained=row["explained"],
        trials=tuple(row["fitted_trials"]),
        saturated=row["saturated"],
        unidentifiable=tuple(row["unidentifiable"]),
        combinations=tuple(
            IdentifiableCombination(code, tuple(members.split(",")), Interval(*numbers), unit, remedy)
            for code, members, numbers, unit, remedy in zip(
                row["combination_codes"],
                row["combination_members"],
                np.array(row["combination_values"]).reshape(-1, 4).tolist(),
                row["combination_units"],
                row["combination_remedies"],
                strict=True,
            )
        ),
        scatter=dict(zip(row["scatter_names"], row["scatter_values"], strict=True)),
        folds=tuple(
            dict(zip(names, values, strict=True))
            for values in np.array(row["fold_values"]).reshape(-1, len(names)).tolist()
        ),
        bounds=dict(zip(row["bound_names"], row["bound_values"], strict=True)),
        jitter=(row["jitter"], row["jitter_error"]),
        fit_percent=row["fit_percent"],
        command=row["largest_command"],
        step=row["largest_step"],
        travel=row["travel"],
        remedy=row["remedy"],
    )


def nominal_loop(loop: Loop) -> IdentifiedLoop:
    """Return the loop of a file as a loop with exact parameters, which include operator and force gain.

    >>> loop = Loop(mass=0.5, damping=3.0, sampling_period_s=0.001, delay_samples=4, operator={"mass": 0.1})
    >>> nominal_loop(loop).values["mass"], nominal_loop(loop).ends
    (0.6, ())
    """
    device = loop.apparent()
    numbers = ((name, device.value(name)) for name in NOMINAL)
    values = {name: value for name, value in numbers if value is not None and (value or name not in ABSENT)}
    parts = tuple(name for name in ("mode", "friction") if getattr(device, name) is not None)
    return IdentifiedLoop(
        values,
        np.zeros((len(values), len(values))),
        loop.sampling_period_s,
        loop.motion,
        parts,
        device.mode.sensor if device.mode else "motor",
        velocity=device.velocity,
    )
