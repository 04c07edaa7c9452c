"""The public `Loop` of device and virtual wall in SI units. `pipeline theory` uses normalised parameters instead."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.device import loop as device_loop
from pipeline.loop.normalised_loop import LoopUnits, NormalisedLoop
from pipeline.records.trials import Floats
from pipeline.rendering.labels import UNITS
from pipeline.theory.boundary import boundary, robust_outline, stiffness_limit
from pipeline.theory.cases import POINT_COSTS, Case, best_wall, check_robust, costs_of_walls, named_islands
from pipeline.theory.costs import MAP_DEFAULT, CostMap
from pipeline.theory.curves import Curve, best_damping, best_stiffness
from pipeline.theory.motion import response
from pipeline.theory.passivity import passive_outline, stiffest_passive
from pipeline.theory.poles import Margins, margins
from pipeline.theory.reachable import Reachable, reachable

if TYPE_CHECKING:  # importing these takes longer than computing most results
    import pandas as pd
    from matplotlib.axes import Axes
    from scipy.signal import StateSpace


_FEWEST_SAMPLES = 50
"""Smallest number of samples of a simulated log from which a limit can be estimated."""

_DRAWN_LIMITS = 24
"""Number of dampings at which a limit with friction is computed for a picture."""

_ROUNDING = 1e-15
"""Largest magnitude of a limit that is a rounding error, relative to the stiffness of the device."""


@dataclass(frozen=True)
class LoopOptimum:
    """Best virtual wall of a loop by a criterion.

    ``stiffness`` K [N/m, Nm/rad], ``damping`` B [Ns/m, Nms/rad]. ``cost``: settling times in samples, overshoot as a
    fraction, energies dimensionless; None if the criterion defines no cost. ``reason``: why there is no cost, or a
    statement that the optimum is a limit that no stable wall reaches. ``box``: smallest and largest stiffness, then
    smallest and largest damping, of a region of equally good walls. ``note``: remark on stable walls that were not
    searched, a negative stiffness, or an unstable tuning. ``left_out``: parts of the loop that theory does not include.
    """

    criterion: str
    stiffness: float
    damping: float
    cost: float | None
    reason: str | None = None
    box: tuple[float, float, float, float] | None = None
    note: str | None = None
    left_out: tuple[str, ...] = ()


@dataclass(frozen=True)
class Loop(device_loop.Loop):
    """A device with delay at a virtual wall of stiffness K and damping B.

    Parameters
    ----------
    mass : float
        m of the device [kg, kg m^2], > 0.
    damping : float
        Viscous damping b of the device [Ns/m, Nms/rad], >= 0.
    sampling_period_s : float
        T [s], > 0.
    delay_samples : float
        Delay t_d/T from command to force, 0 to 256, integer or fractional.
    stiffness : float
        Stiffness k of the device [N/m, Nm/rad], >= 0.
    motion : {"translation", "rotation"}
        Motion of the device, which determines the units in data frames.
    velocity : mapping, optional
        Velocity filter with its ``kind`` and parameters. The keys of all parts are those of a device file
        (docs/devices.md).
    actuator_lag_s : float
        Time constant of the drive [s], >= 0.
    force_gain : float
        Ratio of force to command, > 0.
    mode : mapping, optional
        Vibration mode: ``frequency_hz``, ``damping_ratio``, ``mass`` of the load (included in the device's mass),
        ``sensor`` (``motor`` or ``load``), ``load_damping`` (included in the device's damping).
    operator : mapping, optional
        Operator, rigidly attached to the motor: ``mass``, ``damping``, ``stiffness``, which add to those of the device.
    friction : mapping, optional
        Friction on the motor side: ``coulomb``, ``stiction``, ``stribeck_velocity``.
    sensor : mapping, optional
        ``quantum`` (resolution) and ``noise`` of the position sensor [m, rad].
    jitter_samples : sequence of int, optional
        Delays from which the delay of each command is drawn. ``delay_samples`` is their mean.
    constant_force, force_limit : float
        Constant force on the motor, such as gravity, and largest command [N, Nm]. The constant force only shifts the
        rest position, and the force limit only affects large motions. Linear theory includes neither.

    Raises
    ------
    ParameterError
        If a parameter is out of range. The delay and the filter together may be at most 96 samples long.

    Notes
    -----
    Results describe the linear loop. Parts that linear theory cannot include (an adaptive velocity filter, friction or
    jitter) are listed in ``left_out``, and in ``attrs`` of data frames, optima, margins and designs.

    Source: Hulin 2017, Table 3.1 (normalisation), ch. 3 to 5; docs/definitions.md, "Devices that are not ideal".

    Examples
    --------
    >>> loop = Loop(mass=0.58, damping=4.0, sampling_period_s=0.001, delay_samples=4)
    >>> loop.points([3000.0, 30000.0], [20.0, 20.0])["stable"].tolist()
    [True, False]
    >>> best = loop.optimum("settle_2pct")
    >>> bool(loop.points(best.stiffness, best.damping)["stable"].all())
    True
    >>> smooth = {"kind": "butterworth", "order": 2, "cutoff_hz": 80.0}
    >>> filtered = Loop(0.58, 4.0, 0.001, 4, velocity=smooth, actuator_lag_s=0.001)
    >>> filtered.boundary().attrs["stiffness_max"] < loop.boundary().attrs["stiffness_max"]
    True
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        self.units, self.normalised_loop  # noqa: B018 - an invalid parameter raises its error here

    @classmethod
    def of(cls, loop: device_loop.Loop) -> Loop:
        """Return a copy of a loop, such as that of a device file, as an instance of this class."""
        return cls(**{each.name: getattr(loop, each.name) for each in fields(loop)})

    @cached_property
    def units(self) -> LoopUnits:
        """Stiffness and damping that correspond to alpha = 1 and beta = 1."""
        return LoopUnits.of(self)

    @cached_property
    def normalised_loop(self) -> NormalisedLoop:
        """The loop in the normalised parameters used by theory."""
        return NormalisedLoop.of(self)

    def plot_boundary(self, ax: Axes) -> Axes:
        """Draw the stability boundary (abscissa stiffness, ordinate damping), and return the axes."""
        border, units = self.boundary(), UNITS[self.motion]
        ax.plot(border["stiffness"], border["damping"])
        ax.set(xlabel=f"stiffness K [{units.stiffness}]", ylabel=f"damping B [{units.damping}]")
        return ax

    def plot_response(self, ax: Axes, stiffness: float, damping: float, step: float = 1.0, samples: int = 200) -> Axes:
        """Draw the exact motion at a wall after a force step, and return the axes.

        Parameters
        ----------
        ax : matplotlib.axes.Axes
            Time [s] is the abscissa, displacement [m, rad] the ordinate.
        stiffness, damping : float
            K [N/m, Nm/rad], B [Ns/m, Nms/rad].
        step : float
            Force step F_0 [N, Nm].
        samples : int
            Length [samples].

        Raises
        ------
        ParameterError
            If the motion exceeds the range of floating-point numbers.
        """
        motion = self.response(stiffness, damping, samples=samples)
        ax.plot(motion["time_s"], motion["position"] * step)
        ax.set(xlabel="time [s]", ylabel=f"displacement [{motion.attrs['units']['position']}]")
        return ax

    def boundary(self, points: int = 400) -> pd.DataFrame:
        """Return the stability boundary.

        Parameters
        ----------
        points : int
            Approximate number of points, at least 8.

        Returns
        -------
        pandas.DataFrame
            ``damping`` B [Ns/m, Nms/rad] and ``stiffness`` K [N/m, Nm/rad], in order along the boundary. Separate
            regions are separated by a row of nan. ``attrs`` has the extremes ``stiffness_max``,
            ``damping_at_stiffness_max``, ``damping_max`` and ``stiffness_at_damping_max``. It also has ``islands``,
            stable intervals of stiffness beyond an unstable gap (``damping``, ``stiffness_low``, ``stiffness_high``),
            which occur only for loops with filter, lag or mode.

        Raises
        ------
        ParameterError
            If ``points`` is less than 8, or no wall is stable.

        Source: Hulin 2017, sec. 3.4.
        """
        border = boundary(self.normalised_loop, points)
        frame = self._frame(
            {"damping": border.beta * self.units.damping, "stiffness": border.alpha * self.units.stiffness}
        )
        frame.attrs |= {
            "stiffness_max": border.alpha_max * self.units.stiffness,
            "damping_at_stiffness_max": border.beta_at_alpha_max * self.units.damping,
            "damping_max": border.beta_max * self.units.damping,
            "stiffness_at_damping_max": border.alpha_at_beta_max * self.units.stiffness,
            "islands": named_islands(border.islands * (self.units.damping, self.units.stiffness, self.units.stiffness)),
        }
        return frame

    def points(self, stiffness: object, damping: object, criteria: Sequence[str] = POINT_COSTS) -> pd.DataFrame:
        """Return stability and costs of walls.

        Parameters
        ----------
        stiffness, damping : float or array_like, shape (n,)
            K [N/m, Nm/rad] and B [Ns/m, Nms/rad]. A scalar is broadcast to the length of the other array.
        criteria : sequence of str
            Criteria such as ``settle_2pct`` or ``energy_step_w0_discrete``. The default is all costs.

        Returns
        -------
        pandas.DataFrame
            ``stiffness``, ``damping``, ``stable``, ``spectral_radius``, a column for each criterion (NaN if missing),
            and ``reason`` (why a cost is missing). Names of discrete criteria end in ``_discrete``; settling times are
            in samples.

        Raises
        ------
        ParameterError
            If the lengths differ, a value is not finite, or a criterion is unknown.
        """
        K, B = _as_walls(stiffness, damping)
        walls = costs_of_walls(Case(self.normalised_loop, self.units), np.stack([K, B], axis=1), criteria)
        stability = {"stable": walls.stable, "spectral_radius": walls.spectral_radius}
        reason = np.array(walls.reason, np.object_)
        return self._frame({"stiffness": K, "damping": B, **stability, **walls.costs, "reason": reason})

    def limits(self, damping: object, *, step: float | None = None, samples: int = 400) -> pd.DataFrame:
        """Return the limits of stability at given dampings.

        Parameters
        ----------
        damping : float or array_like, shape (n,)
            B of the wall [Ns/m, Nms/rad].
        step : float, optional
            Step F_0 of the command [N, Nm], > 0. If given, the limits with friction and jitter for this step are
            simulated.
        samples : int
            Length of the simulated logs [samples].

        Returns
        -------
        pandas.DataFrame
            ``damping`` B, and ``stiffness`` K [N/m, Nm/rad], accurate to 1e-9. In linear theory, all walls below this K
            are stable. K is nan if no wall is stable. With a ``step``, also ``stiffness_step``, the softest wall that
            is unstable for this step, which reports show with the measured limits, and ``stiffness_step_open``, half of
            the range in which the simulated logs are undecided. ``stiffness_step`` is nan if no unstable wall is found
            in the search, which extends upwards from the linear limit by 1.5 times the largest linear limit. A larger
            step makes softer walls unstable, down to ``stiffness``.

        Raises
        ------
        ParameterError
            If a value is not finite, or the step is not positive.

        Examples
        --------
        >>> rig = Loop(0.5, 3.0, 0.001, 4, friction={"coulomb": 0.5})
        >>> limits = rig.limits([20.0, 60.0], step=8.0)
        >>> bool((limits["stiffness_step"] > limits["stiffness"]).all())
        True
        """
        B = np.atleast_1d(np.asarray(damping, dtype=np.float64))
        columns = {"damping": B, "stiffness": self.linear_limits(B)}
        if step is not None:
            if not 0 < step < np.inf or samples < _FEWEST_SAMPLES:
                raise ParameterError(
                    f"step = {step}, samples = {samples}: expected a positive, finite step and at least "
                    f"{_FEWEST_SAMPLES} samples."
                )
            from pipeline.planning.loop_limits import (  # needed only for simulated limits
                StepTrial,
                step_limits,
            )

            trial = StepTrial(step, samples, self.sensor.quantum, self.value("jitter_samples") or 0.0)
            limits, undecided = step_limits(self, B, trial, np.zeros(len(B)))
            columns |= {"stiffness_step": limits, "stiffness_step_open": undecided}
        return self._frame(columns)

    def linear_limits(self, damping: Floats) -> Floats:
        """Return the column ``stiffness`` of `limits`."""
        alpha = stiffness_limit(self.normalised_loop, damping / self.units.damping)
        some = alpha > _ROUNDING * self.normalised_loop.gamma
        return np.where(some, alpha * self.units.stiffness, np.nan)

    def picture(self, path: str | os.PathLike[str], *, step: float | None = None, samples: int = 400) -> None:
        """Draw the limit of stability over damping, the passive walls, and the limit with friction for a step.

        Parameters
        ----------
        path : path
            File to write: .svg, .pdf or .png.
        step, samples
            As in `limits`. Without a step, only the linear limit is drawn.

        Raises
        ------
        UsageError
            If the file has a different extension.
        ParameterError
            As in `limits`, or if no wall is stable.
        """
        from pipeline.rendering.figures.boundaries import limits_figure, limits_panel
        from pipeline.rendering.figures.drawing import Series, write_picture

        unit = UNITS[self.motion]
        border = self.boundary()
        name = f"limit without {', '.join(self.left_out)}" if self.left_out else "limit of stability"
        series = [Series(name, "theory", *border[["stiffness", "damping"]].to_numpy().T)]
        if self.passive_damping > 0 and not self.normalised_loop.plant.sensor_at_load:
            series.append(Series("passive walls", "passive", *self.passive()[["stiffness", "damping"]].to_numpy().T))
        if step is not None:
            damping = np.linspace(0.0, border.attrs["damping_max"], _DRAWN_LIMITS)
            limits = self.limits(damping, step=step, samples=samples)["stiffness_step"].to_numpy()
            series.append(Series(f"limit for a step of {step:g} {unit.force}", "friction", limits, damping))
        panel = limits_panel("", series, self.motion)
        write_picture(limits_figure("Limit of stability", "", [panel], "loop"), Path(path))

    def optimum(self, criterion: str) -> LoopOptimum:
        """Return the best wall by a criterion, such as ``settle_2pct`` or ``energy_step_w1_discrete``.

        Raises
        ------
        ParameterError
            If the criterion is unknown. The message lists all criteria.

        Source: Hulin 2017, ch. 5.
        """
        best = best_wall(Case(self.normalised_loop, self.units), criterion)
        wall = best.criterion, best.stiffness, best.damping
        return LoopOptimum(*wall, best.cost, best.reason, best.box, best.note, self.left_out)

    def best_damping(self, stiffness: object, criterion: str) -> pd.DataFrame:
        """Return the best damping by a criterion for each stiffness.

        Parameters
        ----------
        stiffness : float or array_like, shape (n,)
            K [N/m, Nm/rad].
        criterion : str
            A criterion such as ``settle_2pct``, ``overshoot_discrete``, ``energy_step_w0``, ``pole_radius``,
            ``damping``.

        Returns
        -------
        pandas.DataFrame
            ``stiffness``, ``damping``, ``cost``, ``damping_low``, ``damping_high`` (ends of the range of equally good
            dampings; ``damping`` is its middle). Values are NaN if no damping makes the wall stable.

        Raises
        ------
        ParameterError
            If the criterion is unknown, or a value is not finite.

        Source: Hulin 2017, secs. 5.1 and 5.2.
        """
        K = np.atleast_1d(np.asarray(stiffness, dtype=np.float64))
        found = best_damping(self.normalised_loop, criterion, K / self.units.stiffness)
        return self._curve("stiffness", "damping", found)

    def best_stiffness(self, damping: object, criterion: str) -> pd.DataFrame:
        """Return the best stiffness for each damping. See `best_damping`, with stiffness and damping exchanged."""
        B = np.atleast_1d(np.asarray(damping, dtype=np.float64))
        found = best_stiffness(self.normalised_loop, criterion, B / self.units.damping)
        return self._curve("damping", "stiffness", found)

    def passive(self) -> pd.DataFrame:
        """Return the boundary of the passive walls, which are stable with every passive operator.

        Returns
        -------
        pandas.DataFrame
            ``damping`` [Ns/m, Nms/rad] and ``stiffness`` [N/m, Nm/rad], in order along the closed boundary. ``attrs``
            has ``stiffness_max`` and ``damping_at_stiffness_max``. All values are zero for a device without damping.

        Raises
        ------
        ParameterError
            If the position is sensed beyond a vibration mode, because then no wall is passive.

        Source: Hulin 2017, ch. 4; for non-integer delays see docs/definitions.md.
        """
        loop, delta = self.normalised_loop, self.passive_damping / self.units.damping
        alpha, beta = passive_outline(loop, delta)
        best = stiffest_passive(loop, delta) if delta > 0 else (0.0, 0.0)
        closed = {"damping": np.append(beta, beta[0]), "stiffness": np.append(alpha, alpha[0])}
        frame = self._frame({name: values * getattr(self.units, name) for name, values in closed.items()})
        frame.attrs["stiffness_max"] = best[0] * self.units.stiffness
        frame.attrs["damping_at_stiffness_max"] = best[1] * self.units.damping
        return frame

    def robust(self) -> pd.DataFrame:
        """Return the boundary of the walls that are stable with any spring in parallel to the device.

        The stiffness of the device is one of these springs. The result therefore does not depend on this stiffness.
        Passive walls are robust in this sense.

        Returns
        -------
        pandas.DataFrame
            ``damping`` [Ns/m, Nms/rad] and ``stiffness`` [N/m, Nm/rad], in order along the boundary, and ``spring``,
            the spring that limits the wall there [N/m, Nm/rad]. ``attrs`` has ``stiffness_max`` and
            ``damping_at_stiffness_max``. The frame is empty for a device without damping.

        Raises
        ------
        ParameterError
            If the loop has parts other than mass, damper, spring and delay, for which the region is unknown.

        Source: Hulin 2017, sec. 4.3.3, eq. 4.15, Fig. 4.5.
        """
        check_robust(self.parts_in_words())
        units = self.units
        alpha, beta, gamma = robust_outline(self.passive_damping / units.damping, self.delay_samples)
        frame = self._frame(
            {"damping": beta * units.damping, "stiffness": alpha * units.stiffness, "spring": gamma * units.stiffness}
        )
        best = int(np.argmax(alpha)) if len(alpha) else None
        frame.attrs["stiffness_max"] = 0.0 if best is None else float(alpha[best]) * units.stiffness
        frame.attrs["damping_at_stiffness_max"] = 0.0 if best is None else float(beta[best]) * units.damping
        return frame

    def reachable(self, criterion: str) -> Reachable:
        """Return the lowest cost that is reachable with the delay of this loop, over all masses and walls.

        Parameters
        ----------
        criterion : str
            A criterion of `theory.reachable.reachable`, such as ``settle_2pct``, ``energy_step_w0`` or ``pole_radius``.

        Raises
        ------
        ParameterError
            If the criterion is unknown, or its optimal cost does not depend on the delay.

        Source: Hulin 2017, eqs. 5.19 and 5.20.

        Examples
        --------
        >>> loop = Loop(mass=0.58, damping=4.0, sampling_period_s=0.001, delay_samples=4)
        >>> best = loop.reachable("settle_2pct")
        >>> round(best.cost, 1), loop.optimum("settle_2pct").cost < best.cost * (1 + best.within)
        (24.5, True)
        """
        return reachable(criterion, self.delay_samples)

    def response(
        self,
        stiffness: float,
        damping: float,
        samples: int = 50,
        *,
        signal: Literal["step", "impulse"] = "step",
        per_sample: int = 20,
    ) -> pd.DataFrame:
        """Return the motion after a unit force step or a unit impulse, exact at and between the samples.

        Time 0 is when the command step (after the delay) or the impact arrives at the device. In `to_state_space`, time
        0 is when the controller sends the command, ``delay_samples`` earlier.

        Parameters
        ----------
        stiffness, damping : float
            K and B of a wall. The wall need not be stable.
        samples : int
            Length in sampling periods.
        signal : {"step", "impulse"}
            A command step of 1 N (1 Nm), or an impact of 1 Ns (1 Nms) on the device.
        per_sample : int
            Number of points per sampling period. ``frame[::per_sample]`` contains the samples.

        Returns
        -------
        pandas.DataFrame
            ``time_s``, ``position`` [m, rad].

        Raises
        ------
        ParameterError
            If the signal is unknown, or a size is out of range.
        """
        alpha, beta = stiffness / self.units.stiffness, damping / self.units.damping
        chi = response(self.normalised_loop, alpha, beta, signal, samples, per_sample)
        # An impact acts on the mass directly, whereas a command is first multiplied by the force gain.
        unit = self.units.stiffness if signal == "step" else self.units.damping * self.force_gain
        time = np.arange(len(chi)) * self.sampling_period_s / per_sample
        import pandas as pd

        from pipeline.rendering.frames import units_of

        frame = pd.DataFrame({"time_s": time, "position": chi / unit})
        frame.attrs["units"] = units_of(("time_s", "position"), {self.motion})
        return frame

    def margins(self, stiffness: float, damping: float) -> Margins:
        """Return the gain margin, phase margin, delay margin and bandwidth of a stable wall.

        Parameters
        ----------
        stiffness, damping : float
            K and B of the wall.

        Returns
        -------
        Margins
            ``gain``, ``gain_down``: factors above and below 1 by which K and B together reach the limit. ``phase``
            [rad] at unit loop gain. ``delay`` [samples] that may be added. ``bandwidth`` [rad/sample] at which the
            position after a command falls to 1/sqrt(2) of its static value; divide it by 2 pi T to obtain Hz. A margin
            is None if there is no limit. ``left_out``: parts of the loop that theory does not include.

        Raises
        ------
        ParameterError
            If the wall is unstable.
        """
        known = margins(self.normalised_loop, stiffness / self.units.stiffness, damping / self.units.damping)
        return replace(known, left_out=self.left_out)

    def to_state_space(self, stiffness: float = 0.0, damping: float = 0.0) -> StateSpace:
        """Return the loop as a discrete scipy system from the command [N, Nm] to the sensed position [m, rad].

        Parameters
        ----------
        stiffness, damping : float
            K and B of the wall that closes the loop. The default is the open loop.

        Returns
        -------
        scipy.signal.StateSpace
            System with ``dt``. ``control.ss(s.A, s.B, s.C, s.D, s.dt)`` converts it to python-control. Gain, delay and
            lag act on the command, as on the command of the wall. Time 0 is when the controller sends the command, so
            the motion starts ``delay_samples`` later. In `response`, time 0 is when the command arrives. The parts in
            ``left_out`` are not included.
        """
        from scipy.signal import StateSpace

        loop, wall = (
            self.normalised_loop,
            np.array([[stiffness / self.units.stiffness], [damping / self.units.damping]]),
        )
        _, push, position, _ = loop.open_loop
        command = push[:, None] / self.units.stiffness
        return StateSpace(loop.matrix(*wall)[0], command, position[None], 0.0, dt=self.sampling_period_s)

    def map(self, size: int = 251, criteria: Sequence[str] = MAP_DEFAULT) -> pd.DataFrame:
        """Return costs on a grid over the bounding box of the stable region, including both ends.

        Parameters
        ----------
        Number of points along each axis, 2 to 4001.
            Points along each axis, 2 to 4001.
        criteria : sequence of str
            Criteria such as ``settle_2pct``, ``overshoot``, ``energy_step_w0`` or ``pole_radius``.

        Returns
        -------
        pandas.DataFrame
            ``stiffness``, ``damping``, ``stable``, and a column for each criterion (NaN without a cost;
            ``damping_ratio`` for the criterion ``damping``). Damping changes slowest:
            ``frame["overshoot"].to_numpy().reshape(size, size)`` has one row for each damping.

        Raises
        ------
        ParameterError
            If a criterion is unknown, or the size is out of range.

        Source: Hulin 2017, ch. 5, footnote 1.
        """
        if isinstance(criteria, str):
            raise ParameterError(f"criteria = {criteria!r}: expected a list of names, such as [{criteria!r}].")
        grid = CostMap(self.normalised_loop, size, criteria)
        blocks = list(grid.blocks())
        costs = {name: np.concatenate([block.costs[name] for block in blocks]) for name in grid.names}
        if "damping" in costs:  # "damping" is also the name of the column with the damping of the walls
            costs["damping_ratio"] = costs.pop("damping")
        return self._frame(
            {
                "stiffness": np.concatenate([block.alpha for block in blocks]) * self.units.stiffness,
                "damping": np.concatenate([block.beta for block in blocks]) * self.units.damping,
                "stable": np.concatenate([block.stable for block in blocks]),
                **costs,
            }
        )

    def _curve(self, given: str, best: str, found: Curve) -> pd.DataFrame:
        """Return a curve of optima in SI units."""
        unit, columns = getattr(self.units, best), {given: found.given * getattr(self.units, given)}
        columns |= {best: found.best * unit, "cost": found.cost}
        return self._frame({**columns, f"{best}_low": found.low * unit, f"{best}_high": found.high * unit})

    def _frame(self, columns: dict[str, np.ndarray]) -> pd.DataFrame:
        import pandas as pd

        from pipeline.rendering.frames import units_of

        frame = pd.DataFrame(columns)
        physical = units_of(("stiffness", "damping"), {self.motion})
        settling = {name: "samples" for name in columns if name.startswith("settle")}
        frame.attrs["units"] = physical | settling
        if self.left_out:
            frame.attrs["left_out"] = list(self.left_out)
        return frame


def _as_walls(stiffness: object, damping: object) -> tuple[Floats, Floats]:
    try:
        K, B = np.broadcast_arrays(
            np.atleast_1d(np.asarray(stiffness, dtype=np.float64)), np.atleast_1d(np.asarray(damping, dtype=np.float64))
        )
    except ValueError as error:
        raise ParameterError(f"stiffness and damping: expected lists of numbers of equal length: {error}.") from error
    if K.ndim != 1 or not (np.isfinite(K).all() and np.isfinite(B).all()):
        raise ParameterError(f"stiffness and damping, shape {K.shape}: expected lists of finite numbers.")
    return K.copy(), B.copy()
