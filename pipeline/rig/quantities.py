"""Quantities of a rig that a lab can change."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import expm1

from pipeline.base.errors import ParameterError
from pipeline.surface.physical_loop import Loop

_SMALL = 1e-2
"""Damping of its own from which a device without any is changed, in m/T."""


@dataclass(frozen=True)
class Quantity:
    """One quantity: its name in documents and words, its unit, the factors it is changed by at most, and how.

    ``read`` returns its value, None where the rig has no such part. A change by x in ln leads from p to
    p + s (e^x - 1), s = p but for what is zero.
    """

    name: str
    label: str
    unit: Callable[[Loop], str]
    read: Callable[[Loop], float | None]
    write: Callable[[Loop, float], Loop]
    factors: tuple[float, float] = (1 / 32, 32.0)
    zero: Callable[[Loop], float] = lambda loop: 0.0

    def scale(self, loop: Loop) -> float:
        """Return s; 0 where the rig has no such quantity to change."""
        return (self.read(loop) or 0.0) or self.zero(loop)

    def changed(self, loop: Loop, x: float) -> Loop:
        """Return the rig with the quantity changed by x in ln.

        Raises
        ------
        ParameterError
            If no rig is like that.
        """
        return self.write(loop, (self.read(loop) or 0.0) + self.scale(loop) * expm1(x))


def _cutoff(loop: Loop) -> float | None:
    value = (loop.velocity or {}).get("cutoff_hz")
    return float(value) if isinstance(value, (int, float)) else None


def _with_cutoff(loop: Loop, value: float) -> Loop:
    return replace(loop, velocity={**(loop.velocity or {}), "cutoff_hz": value})


def _in(translation: str, rotation: str) -> Callable[[Loop], str]:
    return lambda loop: translation if loop.motion == "translation" else rotation


QUANTITIES = {
    quantity.name: quantity
    for quantity in (
        Quantity(
            "sampling_period_s",
            "sampling period T",
            _in("s", "s"),
            lambda loop: loop.sampling_period_s,
            lambda loop, value: replace(loop, sampling_period_s=value),
        ),
        Quantity(
            "delay_samples",
            "delay d",
            _in("samples", "samples"),
            lambda loop: loop.delay_samples,
            lambda loop, value: replace(loop, delay_samples=value),
            factors=(1 / 32, 4.0),
        ),
        Quantity(
            "damping",
            "damping b of the device",
            _in("Ns/m", "Nms/rad"),
            lambda loop: loop.damping,
            lambda loop, value: replace(loop, damping=value),
            zero=lambda loop: _SMALL * loop.mass / loop.sampling_period_s,
        ),
        Quantity(
            "mass",
            "mass m",
            _in("kg", "kg m^2"),
            lambda loop: loop.mass,
            lambda loop, value: replace(loop, mass=value),
        ),
        Quantity("velocity_cutoff_hz", "cut-off of the velocity filter", _in("Hz", "Hz"), _cutoff, _with_cutoff),
        Quantity(
            "actuator_lag_s",
            "lag of the actuator",
            _in("s", "s"),
            lambda loop: loop.actuator_lag_s,
            lambda loop, value: replace(loop, actuator_lag_s=value),
            factors=(1 / 32, 4.0),
        ),
    )
}
"""By name. The delay is in samples: a change of T alone keeps d and shortens the delay in seconds."""


def present(loop: Loop, keep: tuple[str, ...] = ()) -> list[Quantity]:
    """Return the quantities that a rig has and that may be changed.

    Raises
    ------
    ParameterError
        If ``keep`` names one that there is not.
    """
    unknown = [name for name in keep if name not in QUANTITIES]
    if unknown:
        raise ParameterError(f"keep = {', '.join(unknown)}: expected some of {', '.join(QUANTITIES)}.")
    return [q for q in QUANTITIES.values() if q.name not in keep and q.scale(loop) > 0]
