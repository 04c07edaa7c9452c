"""What only the simulator knows of a device: the ``[simulation]`` table of a device file. Absent parts are ideal.

Theory and estimates never read it: it holds what logs of a lab may suffer from without anybody having written it down.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from pipeline.records.loop_parts import Part, named

Share = Annotated[float, Field(ge=0, le=0.5)]
Deviation = Annotated[float, Field(ge=-0.5, le=0.5)]


class LaterStep(Part):
    """A further step of the external force [N, Nm], added from a time [s] of the log on."""

    time_s: Annotated[float, Field(gt=0)]
    size: float


class SimulationParts(Part):
    """The ``[simulation]`` table of a device or an experiment; what it does not name is as stated and complete.

    Parameters
    ----------
    one_sided_wall : bool
        The wall acts only beyond its rest in the direction of the step; outside there is no wall force.
    constant_force : float
        Force on the device beside the command [N, Nm], such as gravity.
    gain_error : float
        Rendered force relative to ``force_gain`` times the command, less 1.
    clock_error : float
        True sampling period relative to the stated one, less 1.
    clipped_command_logged : bool
        The log holds the command after the force limit instead of before it.
    lost_rows : float
        Share of rows that are missing in the log.
    lost_rows_hidden : bool
        Time stamps are numbered anew, so that they do not show which rows are missing.
    held_samples : float
        Share of samples in which the sensor repeats its last value, to the controller too.
    repeated_rows : float
        Share of rows in which the log repeats the position of the row before; the controller had the true one.
    ramp_samples : int
        Samples over which the step rises; 1 is a step.
    later_steps : tuple of LaterStep
        Further steps in the same log.
    """

    one_sided_wall: bool = False
    constant_force: float = 0.0
    gain_error: Deviation = 0.0
    clock_error: Deviation = 0.0
    clipped_command_logged: bool = False
    lost_rows: Share = 0.0
    lost_rows_hidden: bool = False
    held_samples: Share = 0.0
    repeated_rows: Share = 0.0
    ramp_samples: Annotated[int, Field(ge=1, le=10_000)] = 1
    later_steps: tuple[LaterStep, ...] = ()

    def over(self, lower: SimulationParts) -> SimulationParts:
        """Return these parts, with those of another where this one does not name them."""
        return SimulationParts(**{**named(lower), **named(self)})

    def mistakes(self, duration_s: float, force_limit: float | None) -> list[str]:
        """Return what a device with trials of a length [s] and a force limit [N, Nm] cannot have, as sentences."""
        found = [
            f"simulation.later_steps[{i}].time_s: found {step.time_s:g}; must be below duration_s, {duration_s:g}"
            for i, step in enumerate(self.later_steps, start=1)
            if step.time_s >= duration_s
        ]
        if self.clipped_command_logged and force_limit is None:
            found.append("simulation.clipped_command_logged: found true; needs a force limit, limits.force")
        if self.lost_rows_hidden and not self.lost_rows:
            found.append("simulation.lost_rows_hidden: found true; needs lost_rows above 0")
        return found
