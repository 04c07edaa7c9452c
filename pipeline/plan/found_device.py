"""The device that logs show: the linear loop that it makes with a wall, its limits, and itself behind walls."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pipeline.device.parts import Friction, LoopParts, Mode, VelocityFilter
from pipeline.loop.motion import Mechanism
from pipeline.loop.normalised_loop import LARGEST_DELAY, LoopUnits, NormalisedLoop, loop_of, wall_units
from pipeline.measured.experiment.fitted_device import FittedDevice
from pipeline.measured.signal.verdict import judge
from pipeline.measured.student import NORMAL_95
from pipeline.records.batch import Floats, TrialBatch
from pipeline.records.models import Device, Experiment
from pipeline.simulation.setup import Setup
from pipeline.simulation.simulate import delays_of, simulate
from pipeline.theory.boundary import boundary, stabilises, stiffness_limit

AT_LOAD = "mode at the load"
"""Part of a fitted device whose position is sensed beyond its vibration mode."""

SMALLEST = 1e-3
"""Least share of the mass on a side of a mode, of a positive number at the end of an interval, and of a sample that is
a lag: less moves no limit by a thousandth."""

LONGEST = 2000
"""Samples of a simulated log: what neither grows nor decays in them is as near the limit as any log tells."""

BEYOND = 1.5
"""How far above its linear limit a limit for the step is looked for, in largest linear limits: friction of a tenth of
the step doubles a limit."""

WALLS, ROUNDS = 17, 3
"""Walls of a round between a stable and an unstable one; three rounds tell a limit to 1/2700 of the largest."""

DIRECTIONS = 24
"""Random directions in which a wide range of devices is searched for its lowest limit, in addition to its axes."""

NARROW = 0.2
"""Half width of a limit's interval, relative to it, up to which the interval is taken as linear in the numbers."""

OUTLINE = 60
"""Points of an outline by which the damping of the stiffest wall is found: the limit is flat there."""


IDEAL = LoopParts()


@dataclass(frozen=True)
class LoopPoint:
    """One device: m [kg, kg m^2], b [Ns/m, Nms/rad], delay [samples], k [N/m, Nm/rad], T [s], and its other parts.

    Coulomb friction is in the parts, and no part of the linear loop; ``force`` is a constant one beside the command.
    """

    mass: float
    damping: float
    delay_samples: float
    stiffness: float
    sampling_period_s: float
    parts: LoopParts = IDEAL
    force: float = 0.0

    @property
    def loop(self) -> NormalisedLoop:
        """LoopUnits; a damping, delay or stiffness below zero counts as zero."""
        damping, stiffness = max(self.damping, 0.0), max(self.stiffness, 0.0)
        delay = min(max(self.delay_samples, 0.0), LARGEST_DELAY)
        return loop_of(self.mass, damping, stiffness, delay, self.sampling_period_s, self.parts)

    @property
    def units(self) -> LoopUnits:
        """Units of its walls."""
        return wall_units(self.mass, self.sampling_period_s, self.parts)

    @property
    def coulomb(self) -> float:
        """Coulomb friction [N, Nm]."""
        return self.parts.friction.coulomb if self.parts.friction else 0.0

    def limit(self, wall_damping: Floats) -> Floats:
        """Return the largest stiffness [N/m, Nm/rad] of the linear loop at dampings B, 0 where none is stable."""
        return np.maximum(stiffness_limit(self.loop, wall_damping / self.units.damping), 0.0) * self.units.stiffness

    @property
    def damping_of_stiffest(self) -> float:
        """Damping B [Ns/m, Nms/rad] of the stiffest stable wall; 0 where there is none."""
        loop = self.loop
        damping = max(0.0, boundary(loop, OUTLINE).beta_at_alpha_max) if stabilises(loop) else 0.0
        return damping * self.units.damping

    def behind(self, K: Floats, B: Floats, trial: Trial, repetition: int = 0) -> TrialBatch:
        """Return the device behind walls, without noise and travel; a repetition has another jitter."""
        setup = Setup(
            plant=Mechanism.of(self.mass, max(self.damping, 0.0), max(self.stiffness, 0.0), self.parts),
            sampling_period_s=self.sampling_period_s,
            step=trial.step,
            rows=min(trial.rows, LONGEST),
            edge_row=1,
            delay_samples=max(self.delay_samples, 0.0),
            velocity=self.parts.velocity,
            force_gain=self.parts.force_gain,
            quantum=trial.quantum,
            jitter_samples=delays_of(max(self.delay_samples, 0.0), trial.jitter),
        )
        hidden = setup.hidden.model_copy(update={"constant_force": self.force})
        return simulate(replace(setup, hidden=hidden), K, B, repetition=repetition)

    def step_limits(self, damping: Floats, trial: Trial, softest: Floats) -> tuple[Floats, Floats]:
        """Return the wall at each damping from which on a step makes it unstable, by simulation, and how open it is.

        Parameters
        ----------
        damping : float64, shape (n,)
            B [Ns/m, Nms/rad].
        trial : Trial
        softest : float64, shape (n,)
            Walls above which it is looked for [N/m, Nm/rad]: so far as very soft ones move, friction is none.

        Returns
        -------
        limits, open : float64, shape (n,)
            In the middle of the walls that a log leaves undecided, and half of their range [N/m, Nm/rad]. NaN where no
            wall is unstable up to `BEYOND` times the largest linear limit above the linear one, and where the softest
            one is already. Friction can but raise a limit; jitter moves it either way.
        """
        if not len(damping):
            return np.empty(0), np.empty(0)
        linear = self.limit(damping)
        if not len(damping):
            return linear, linear
        least = linear if self.coulomb and not trial.jitter else 0.5 * linear
        low, high = np.maximum(least, softest), linear + BEYOND * linear.max()
        begin, ends = low, high > low
        for _ in range(ROUNDS):
            K = np.linspace(low, high, WALLS + 1)[1:]
            said = judge(self.behind(K.ravel(), np.tile(damping, WALLS), trial)).verdict.reshape(K.shape)
            grows = said == "unstable"
            ends &= grows.any(axis=0)
            first, step = np.argmax(grows, axis=0), (high - low) / WALLS
            # between the stiffest stable wall below and this one verdicts are open
            stable = (said == "stable") & (np.arange(WALLS)[:, None] < first)
            last = np.where(stable.any(axis=0), WALLS - np.argmax(stable[::-1], axis=0), 0)
            low, high = low + last * step, low + (first + 1) * step
        known = ends & (low > np.where(begin > least, begin, -1.0))
        return np.where(known, 0.5 * (low + high), np.nan), 0.5 * (high - low)


@dataclass(frozen=True)
class Trial:
    """A usual trial: its step F_0 [N, Nm], its rows from the step on, the sensor's quantum [m, rad], and the standard
    deviation of its delay [samples]."""

    step: float
    rows: int
    quantum: float = 0.0
    jitter: float = 0.0


@dataclass(frozen=True, eq=False)
class FoundDevice:
    """A device fitted to logs, with the filter of their wall law.

    ``directions`` is the number of directions in which it moves in these logs, 1 or 2.
    """

    fitted: FittedDevice
    sampling_period_s: float
    velocity: VelocityFilter | None = None
    directions: int = 2

    @property
    def may_rub(self) -> bool:
        """Whether it has friction, or friction cannot be excluded."""
        return "coulomb" in self.fitted.values

    def at(self, values: Mapping[str, float]) -> LoopPoint:
        """Return the device with other numbers; see `FittedDevice.values`."""
        mass, mode = values["mass"], None
        if "far_mass" in values:
            mode = Mode(
                frequency_hz=values["frequency_hz"],
                damping_ratio=max(values["damping_ratio"], 0.0),
                mass=min(max(values["far_mass"], SMALLEST * mass), (1 - SMALLEST) * mass),
                sensor="load" if AT_LOAD in self.fitted.parts else "motor",
                load_damping=min(max(values.get("load_damping", 0.0), 0.0), max(values["damping"], 0.0)),
            )
        lag = max(values.get("actuator_lag_s", 0.0), 0.0)
        coulomb = values.get("coulomb", 0.0) if "friction" in self.fitted.parts else 0.0
        parts = LoopParts(
            velocity=self.velocity,
            actuator_lag_s=lag if lag > SMALLEST * self.sampling_period_s else 0.0,
            mode=mode,
            friction=Friction(coulomb=coulomb) if coulomb > 0 else None,
        )
        numbers = (values["damping"], values["delay_samples"], values.get("stiffness", 0.0))
        return LoopPoint(mass, *numbers, self.sampling_period_s, parts, values.get("constant_force", 0.0))

    @cached_property
    def point(self) -> LoopPoint:
        """The likeliest device."""
        return self.at(self.fitted.values)

    @cached_property
    def ends(self) -> tuple[tuple[LoopPoint, LoopPoint], ...]:
        """Devices at both ends of each principal axis of the 95 % range of its numbers, and that with the longest lag
        that its delay may hold; none where these are exact."""
        if not self.fitted.covariance.any():
            return ()
        found = [(self._shifted(-step), self._shifted(step)) for step in self._axes]
        if lag := self.fitted.bounds.get("actuator_lag_s", 0.0):
            late = self.fitted.values["delay_samples"] - lag / self.sampling_period_s
            found.append((self.point, self.at(self.fitted.values | {"delay_samples": late, "actuator_lag_s": lag})))
        return tuple(found)

    @cached_property
    def _axes(self) -> Floats:
        """Half axes of the 95 % range of the numbers, a row each, shape (P, P)."""
        scale = np.sqrt(np.maximum(np.diag(self.fitted.covariance), 0.0))
        size = np.where(scale > 0, scale, 1.0)
        variance, axes = np.linalg.eigh(self.fitted.covariance / np.outer(size, size))
        return np.asarray(NORMAL_95 * np.sqrt(np.maximum(variance, 0.0))[:, None] * axes.T * size)

    def _shifted(self, step: Floats) -> LoopPoint:
        """Return the device with other numbers, whose mass and frequency stay positive."""
        now = np.array(list(self.fitted.values.values()))
        positive = np.isin(list(self.fitted.values), ("mass", "frequency_hz"))
        moved = np.where(positive, np.maximum(now + step, SMALLEST * now), now + step)
        return self.at(dict(zip(self.fitted.values, moved.tolist(), strict=True)))

    def lowest(self, wall_damping: Floats) -> Floats:
        """Return the lowest linear limit at dampings B of all devices that the logs allow, 95 %, (n,) [N/m, Nm/rad].

        Notes
        -----
        The least limit on the ellipsoid of the numbers whose projections are their 95 % intervals. For a limit that is
        linear in the numbers it is the lower end of the limit's interval. Where the interval is wide, limits are
        computed along the axes, along the steepest descent at each damping, and along random directions.
        """
        limit = self.point.limit(wall_damping)
        if not self.ends:
            return limit
        ends = np.array([[end.limit(wall_damping) for end in both] for both in self.ends])
        reach = np.sqrt(np.sum(np.square(np.abs(ends - limit).max(axis=1)), axis=0))
        if (reach <= NARROW * limit).all():
            return np.asarray(np.minimum(limit - reach, ends.min(axis=(0, 1))))
        axes = self._axes
        slope = 0.5 * (ends[: len(axes), 0] - ends[: len(axes), 1])
        steepest = (slope / np.maximum(np.sqrt(np.sum(slope**2, axis=0)), 1e-300)).T
        random = np.random.default_rng(0).standard_normal((DIRECTIONS, len(axes)))
        random /= np.sqrt(np.sum(random**2, axis=1, keepdims=True))
        others = [self._shifted(weights @ axes).limit(wall_damping) for weights in np.concatenate([steepest, random])]
        return np.asarray(np.minimum(limit, np.minimum(ends.min(axis=(0, 1)), np.min(others, axis=0))))

    def limits(
        self, wall_damping: Floats, trial: Trial | None = None, softest: Floats | float = 0.0
    ) -> tuple[Floats, Floats]:
        """Return the limits at dampings B, and how far the numbers leave them open, 95 %; both (n,) [N/m, Nm/rad].

        They are those of the linear loop; for a trial of a device that is not linear with it those of its step, as
        `LoopPoint.step_limits`, which leave open a share of what friction adds beside. A quantum alone moves no limit:
        what it keeps up ends below it.
        """
        limit = self.point.limit(wall_damping)
        off = [np.abs([end.limit(wall_damping) - limit for end in both]).max(axis=0) for both in self.ends]
        reach = np.sqrt(np.sum(np.square(off), axis=0)) if off else np.zeros(len(wall_damping))
        if trial is None or not (self.point.coulomb or trial.jitter):
            return limit, reach
        own, undecided = self.point.step_limits(wall_damping, trial, np.broadcast_to(softest, limit.shape))
        reach = np.hypot(reach, undecided)
        if self.point.coulomb:
            friction = self.fitted.with_interval("coulomb")
            reach = np.hypot(reach, (own - limit) * (friction.high - friction.low) / (2 * friction.value))
        return own, reach


def stated_device(device: Device, of: Experiment) -> FoundDevice:
    """Return the device that its file states, as the wall feels it: operator and gain are in its numbers."""
    mass, damping, stiffness, parts = device.loop_of(of).felt(of.mass, of.damping, of.stiffness)
    values = {"mass": mass, "damping": damping, "delay_samples": of.delay_samples, "stiffness": stiffness}
    names = []
    if parts.actuator_lag_s:
        values["actuator_lag_s"] = parts.actuator_lag_s
    if parts.mode is not None:
        names.append(AT_LOAD if parts.mode.sensor == "load" else "mode at the motor")
        values |= {"frequency_hz": parts.mode.frequency_hz, "damping_ratio": parts.mode.damping_ratio}
        values |= {"far_mass": parts.mode.mass, "load_damping": parts.mode.load_damping}
    if parts.friction is not None:
        names.append("friction")
        values["coulomb"] = parts.friction.coulomb
    none = np.zeros((len(values), len(values)))
    fitted = FittedDevice(tuple(names), values, none)
    return FoundDevice(fitted, device.sampling_period_s, parts.velocity)
