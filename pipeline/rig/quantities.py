"""Quantities of a rig that can be changed in a lab."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import expm1

from pipeline.base.errors import ParameterError
from pipeline.device.parameters import PARAMETERS
from pipeline.surface.physical_loop import Loop

_SMALL = 1e-2
"""Scale of a change of the damping of a device without damping, in m/T."""


@dataclass(frozen=True)
class Quantity:
    """Changeable quantity with name, label, smallest and largest factor of a change, and name in `PARAMETERS`.

    A logarithmic change of x changes p to p + s (e^x - 1). The scale s is p unless p is 0. For p = 0, it is ``zero``
    times m/T. If ``zero`` is 0, a value of 0 cannot be changed. ``change`` returns a rig with a new value. By default,
    only the parameter itself changes.
    """

    name: str
    label: str
    factors: tuple[float, float] = (1 / 32, 32.0)
    zero: float = 0.0
    parameter: str = ""
    change: Callable[[Loop, float], Loop] | None = None

    def unit(self, loop: Loop) -> str:
        """Return the unit of the quantity for a rig."""
        return PARAMETERS[self.parameter or self.name].unit(loop.motion)

    def read(self, loop: Loop) -> float | None:
        """Return the value of the quantity for a rig, or None if the rig does not have the part to which the quantity
        belongs."""
        return loop.value(self.parameter or self.name)

    def write(self, loop: Loop, value: float) -> Loop:
        """Return the rig with a new value of the quantity."""
        if self.change is not None:
            return self.change(loop, value)
        return loop.replace({self.parameter or self.name: value})

    def scale(self, loop: Loop) -> float:
        """Return the scale s of a change, or 0 if the rig does not have the quantity."""
        return (self.read(loop) or 0.0) or self.zero * loop.mass / loop.sampling_period_s

    def changed(self, loop: Loop, x: float) -> Loop:
        """Return the rig after a logarithmic change x of the quantity.

        Raises
        ------
        ParameterError
            If the changed rig is invalid.
        """
        return self.write(loop, (self.read(loop) or 0.0) + self.scale(loop) * expm1(x))


QUANTITIES = {
    quantity.name: quantity
    for quantity in (
        Quantity("sampling_period_s", "sampling period T"),
        Quantity("delay_samples", "delay d", (1 / 32, 4.0)),
        Quantity("damping", "damping b of the device", zero=_SMALL, change=Loop.with_damping),
        Quantity("mass", "mass m"),
        Quantity("velocity_cutoff_hz", "cut-off of the velocity filter", parameter="velocity.cutoff_hz"),
        Quantity("actuator_lag_s", "lag of the actuator", (1 / 32, 4.0)),
    )
}
"""Quantities by name. The delay is in samples. If only T is changed, d is kept, and the delay in seconds changes."""


def present(loop: Loop, keep: tuple[str, ...] = ()) -> list[Quantity]:
    """List the quantities of a rig that may be changed.

    Raises
    ------
    ParameterError
        If ``keep`` contains an unknown name.
    """
    unknown = [name for name in keep if name not in QUANTITIES]
    if unknown:
        raise ParameterError(f"keep = {', '.join(unknown)}: expected some of {', '.join(QUANTITIES)}.")
    return [q for q in QUANTITIES.values() if q.name not in keep and q.scale(loop) > 0]
