"""Quantities of a rig that can be changed in a lab."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import expm1

from pipeline.base.errors import ParameterError
from pipeline.device.parameters import PARAMETERS
from pipeline.surface.physical_loop import Loop

_SMALL = 1e-2
"""Reference damping for changes of a device without damping, in m/T."""


@dataclass(frozen=True)
class Quantity:
    """One quantity: its name, its name in words, its smallest and largest factor of change, its name in `PARAMETERS`.

    A logarithmic change of x turns p into p + s (e^x - 1), with s = p unless p is zero. ``zero`` is s for p = 0, in
    m/T; 0 if a zero value cannot be changed. ``change`` returns a rig with another value; by default only that
    parameter changes.
    """

    name: str
    label: str
    factors: tuple[float, float] = (1 / 32, 32.0)
    zero: float = 0.0
    parameter: str = ""
    change: Callable[[Loop, float], Loop] | None = None

    def unit(self, loop: Loop) -> str:
        """Return the unit for a rig."""
        return PARAMETERS[self.parameter or self.name].unit(loop.motion)

    def read(self, loop: Loop) -> float | None:
        """Return the value of a rig; None if it lacks this part."""
        return loop.value(self.parameter or self.name)

    def write(self, loop: Loop, value: float) -> Loop:
        """Return the rig with another value."""
        if self.change is not None:
            return self.change(loop, value)
        return loop.replace({self.parameter or self.name: value})

    def scale(self, loop: Loop) -> float:
        """Return s; 0 if the rig lacks this quantity."""
        return (self.read(loop) or 0.0) or self.zero * loop.mass / loop.sampling_period_s

    def changed(self, loop: Loop, x: float) -> Loop:
        """Return the rig with the quantity changed by x in ln.

        Raises
        ------
        ParameterError
            If the changed rig is invalid.
        """
        return self.write(loop, (self.read(loop) or 0.0) + self.scale(loop) * expm1(x))


def with_damping(loop: Loop, value: float) -> Loop:
    """Return the rig with another damping [Ns/m, Nms/rad], with an unchanged share for the load of a mode."""
    changes: dict[str, float | None] = {"damping": value}
    if loop.mode and loop.damping > 0:
        changes["mode.load_damping"] = min(loop.load_damping / loop.damping, 1.0) * value
    return loop.replace(changes)


QUANTITIES = {
    quantity.name: quantity
    for quantity in (
        Quantity("sampling_period_s", "sampling period T"),
        Quantity("delay_samples", "delay d", (1 / 32, 4.0)),
        Quantity("damping", "damping b of the device", zero=_SMALL, change=with_damping),
        Quantity("mass", "mass m"),
        Quantity("velocity_cutoff_hz", "cut-off of the velocity filter", parameter="velocity.cutoff_hz"),
        Quantity("actuator_lag_s", "lag of the actuator", (1 / 32, 4.0)),
    )
}
"""Quantities by name. The delay is in samples: changing T alone keeps d and changes the delay in seconds."""


def present(loop: Loop, keep: tuple[str, ...] = ()) -> list[Quantity]:
    """Return the quantities that a rig has and that may be changed.

    Raises
    ------
    ParameterError
        If ``keep`` names an unknown quantity.
    """
    unknown = [name for name in keep if name not in QUANTITIES]
    if unknown:
        raise ParameterError(f"keep = {', '.join(unknown)}: expected some of {', '.join(QUANTITIES)}.")
    return [q for q in QUANTITIES.values() if q.name not in keep and q.scale(loop) > 0]
