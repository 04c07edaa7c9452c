"""Conversion table between the numbers of the estimator and the parameters of a loop.

The estimator works per sample and with mass 1, in `LogUnits`. ``gain`` is the acceleration per unit of command.
``coulomb`` and ``force`` are accelerations, and ``limit`` is a command. All other numbers determine the shape of the
motion (`motion.PlantShape`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import inf, pi

from pipeline.device.parameters import PARAMETERS
from pipeline.measured.identification.motion import PlantShape
from pipeline.measured.identification.recordings import LogUnits

Numbers = dict[str, float]
"""Numbers of the estimator, with their names as keys."""

Quantity = Callable[[Numbers], float]
"""Function that computes a quantity in SI from the numbers of the estimator."""

Conversion = Callable[[Numbers, LogUnits], float]
"""Function that computes a quantity in SI, per unit of command, from the numbers and the units of the logs."""


@dataclass(frozen=True)
class EstimatedParameter:
    """Parameter of a loop that is computed from the numbers of the estimator.

    Parameters
    ----------
    name : str
        Name in `PARAMETERS`.
    number : str
        Name of a number of the estimator. A device has the parameter if it has this number.
    conversion : callable
        Function that computes the value of the parameter.
    key : str
        Name in the document of `pipeline identify`.
    ends_at_zero : bool
        Whether the parameter is nonnegative. The profile likelihood then determines an interval that reaches 0.
    """

    name: str
    number: str
    conversion: Conversion
    key: str
    ends_at_zero: bool = True

    def quantity(self, units: LogUnits) -> Quantity:
        """Return the function that computes the parameter from the numbers."""
        return lambda numbers: self.conversion(numbers, units)

    def unit_size(self, mass: float, units: LogUnits) -> float:
        """Return the size [SI] that scales the numerical error of a value of 0, or 0 for a parameter that must be
        positive."""
        parameter = PARAMETERS[self.name]
        if parameter.positive:
            return 0.0
        return units.command if parameter.dimension == "force" else parameter.normalising_unit(mass, units.period)


def _mass(n: Numbers, units: LogUnits) -> float:
    acceleration = units.position / units.command / units.period**2
    return 1 / (n["gain"] * acceleration) if n["gain"] else inf


def _mode_damping_ratio(n: Numbers, _: LogUnits) -> float:
    if "spring_damping_fraction" in n:
        return n["mode_damping_ratio"] * n["spring_damping_fraction"]
    of_load, ratio = n.get("load_damping", 0.0), n["load_mass_fraction"] / (1 - n["load_mass_fraction"])
    return n["mode_damping_ratio"] - ((n["delta"] - of_load) * ratio + of_load / ratio) / (2 * n["mode_frequency"])


def _per_mass(number: str, power: int) -> Conversion:
    """Return the conversion of a number per sample and unit mass into a damping or a stiffness."""
    return lambda n, units: n[number] / units.period**power * _mass(n, units)


def _force(number: str) -> Conversion:
    """Return the conversion of an acceleration into a force."""
    return lambda n, units: n[number] / n["gain"] * units.command


def _friction(n: Numbers, units: LogUnits) -> float:
    """Return the total friction of both sides of a mode, because logs show the sum better than the share of each
    side."""
    return (n["coulomb"] + n.get("load_coulomb", 0.0)) / n["gain"] * units.command


def _frequency(n: Numbers, units: LogUnits) -> float:
    return n["mode_frequency"] / (2 * pi * units.period)


def _mode_mass(n: Numbers, units: LogUnits) -> float:
    return PlantShape.of(n).load_mass * _mass(n, units)


_ROWS = (
    EstimatedParameter("mass", "gain", _mass, "mass", ends_at_zero=False),
    EstimatedParameter("damping", "delta", _per_mass("delta", 1), "damping"),
    EstimatedParameter("stiffness", "gamma", _per_mass("gamma", 2), "stiffness"),
    EstimatedParameter("delay_samples", "delay", lambda n, _: n["delay"], "delay"),
    EstimatedParameter("actuator_lag_s", "lag", lambda n, units: n["lag"] * units.period, "actuator_lag"),
    EstimatedParameter("mode.frequency_hz", "mode_frequency", _frequency, "mode_frequency", ends_at_zero=False),
    EstimatedParameter("mode.damping_ratio", "mode_damping_ratio", _mode_damping_ratio, "mode_damping_ratio"),
    EstimatedParameter("mode.mass", "mode_frequency", _mode_mass, "mode_mass"),
    EstimatedParameter("mode.load_damping", "load_damping", _per_mass("load_damping", 1), "load_damping"),
    EstimatedParameter("friction.coulomb", "coulomb", _friction, "friction"),
    EstimatedParameter("constant_force", "force", _force("force"), "constant_force", ends_at_zero=False),
    EstimatedParameter(
        "force_limit", "limit", lambda n, units: n["limit"] * units.command, "force_limit", ends_at_zero=False
    ),
)

ESTIMATED: dict[str, EstimatedParameter] = {row.name: row for row in _ROWS}
"""Parameters of a loop that the estimator determines. The keys are names of `PARAMETERS`, in the same order."""


def estimated_names(numbers: Numbers) -> list[str]:
    """Return the names of the parameters of a device with the given numbers."""
    return [name for name, row in ESTIMATED.items() if row.number in numbers]
