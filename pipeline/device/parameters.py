"""Table of the parameters of a `pipeline.device.loop.Loop`, with symbol, unit, bounds, label and meaning.

`PARAMETERS` defines the keys of device files and JSON documents, the stored columns, the units, the labels and the
order of a covariance. A new part of the loop needs a row here for each of its numbers, a field of `Loop`, and its
equations in `pipeline.loop.state_space`.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Literal, get_args

from pipeline.base.units import drive_unit

Motion = Literal[
    "translation",
    "rotation",
    "translation in V",
    "rotation in V",
    "translation in A",
    "rotation in A",
    "translation in counts",
    "rotation in counts",
    "translation in %",
    "rotation in %",
]
"""Type of motion of a device. If commands are not forces or torques but signals of a drive with unknown gain, the type
includes the unit of the commands. The type determines the units of all parameters, which are then per volt, ampere,
count or percent."""

MOTIONS: tuple[Motion, ...] = get_args(Motion)


def is_rotation(motion: str) -> bool:
    """Return True if the device rotates, whatever the unit of its commands.

    >>> is_rotation("rotation in V"), is_rotation("translation")
    (True, False)
    """
    return motion.startswith("rotation")


def drive_of(motion: str) -> str:
    """Return the unit of the commands of a drive, or an empty text if commands are forces or torques.

    >>> drive_of("rotation in V"), drive_of("rotation")
    ('V', '')
    """
    return motion.partition(" in ")[2]


Dimension = Literal[
    "mass", "damping", "stiffness", "force", "length", "velocity", "acceleration", "time", "frequency", "ratio"
]

UNITS: dict[Dimension, tuple[str, str]] = {
    "mass": ("kg", "kg m^2"),
    "damping": ("Ns/m", "Nms/rad"),
    "stiffness": ("N/m", "Nm/rad"),
    "force": ("N", "Nm"),
    "length": ("m", "rad"),
    "velocity": ("m/s", "rad/s"),
    "acceleration": ("m/s^2", "rad/s^2"),
    "time": ("s", "s"),
    "frequency": ("Hz", "Hz"),
    "ratio": ("", ""),
}
"""SI units of each dimension for translation and rotation."""

_PER_COMMAND: dict[str, str] = {"mass": "s^2/{}", "damping": "s/{}", "stiffness": "/{}", "force": ""}
"""Suffix that turns the unit of a command into the unit of each dimension that contains a force."""


def unit_of(dimension: Dimension, motion: Motion) -> str:
    """Return the unit of a dimension for a type of motion. The unit of a drive replaces N or Nm in the SI unit.

    >>> unit_of("mass", "rotation"), unit_of("mass", "translation in V"), unit_of("damping", "rotation in counts")
    ('kg m^2', 'Vs^2/m', 'counts s/rad')
    """
    rotational, drive = is_rotation(motion), drive_of(motion)
    if not drive or dimension not in _PER_COMMAND:
        return UNITS[dimension][rotational]
    return drive_unit(drive, _PER_COMMAND[dimension].format("rad" if rotational else "m"))


def unit_in(unit: str, motion: Motion) -> str:
    """Convert ``unit``, the SI unit for translation, to the unit for a type of motion.

    >>> unit_in("N/m", "rotation"), unit_in("N/m", "translation in V"), unit_in("s", "rotation in V")
    ('Nm/rad', 'V/m', 's')
    """
    dimension = next((name for name, (linear, _) in UNITS.items() if linear == unit and linear), None)
    return unit if dimension is None else unit_of(dimension, motion)


POWERS: dict[Dimension, tuple[int, int]] = {
    "mass": (1, 0),
    "damping": (1, -1),
    "stiffness": (1, -2),
    "force": (1, -2),
    "length": (0, 0),
    "velocity": (0, -1),
    "acceleration": (0, -2),
    "time": (0, 1),
    "frequency": (0, -1),
    "ratio": (0, 0),
}
"""Powers of mass and time of each dimension. Quantities with a power of the mass are per unit of command at the wall.
In units of mass and sampling period, the powers give the factors of Table 3.1 (Hulin 2017)."""


@dataclass(frozen=True)
class Parameter:
    """Parameter of a loop with its names, unit and bounds.

    Parameters
    ----------
    name : str
        Path in the record, in the ``[loop]`` table of a device file and in JSON, such as ``mode.frequency_hz``.
    symbol : str
        Symbol of the thesis, or else of the documentation.
    dimension : Dimension
        Dimension, which determines the SI units for translation and rotation (`UNITS`).
    label : str
        Short noun for tables and figures.
    meaning : str
        Description without a full stop.
    positive : bool
        Whether values must be greater than ``lower``.
    lower : float
        Lower bound, which is excluded if ``positive``.
    may_seem_negative : bool
        Whether an estimate may be negative. For example, the stiffness is negative near an unstable equilibrium.
    unit_name : str
        Unit that replaces the unit of the dimension, such as ``samples``.
    """

    name: str
    symbol: str
    dimension: Dimension
    label: str
    meaning: str
    positive: bool = False
    lower: float = 0.0
    may_seem_negative: bool = False
    unit_name: str = ""

    @property
    def part(self) -> str:
        """Part of the loop that contains the number, such as ``mode``; empty for a number of the loop itself."""
        return self.name.rpartition(".")[0]

    @property
    def key(self) -> str:
        """Name within the part."""
        return self.name.rpartition(".")[2]

    def unit(self, motion: Motion) -> str:
        """Return the unit for a type of motion.

        >>> PARAMETERS["damping"].unit("rotation"), PARAMETERS["delay_samples"].unit("translation")
        ('Nms/rad', 'samples')
        """
        return self.unit_name or unit_of(self.dimension, motion)

    def normalising_unit(self, mass: float, time: float) -> float:
        """Return the divisor mass^a time^b that normalises the parameter to units of mass and time.

        >>> PARAMETERS["stiffness"].normalising_unit(0.5, 1e-3)
        500000.0
        """
        of_mass, of_time = POWERS[self.dimension]
        unit = mass if of_mass else 1.0
        return unit * time**of_time if of_time >= 0 else unit / time**-of_time


def _rows() -> tuple[Parameter, ...]:
    velocity = "of the velocity filter"
    return (
        Parameter(
            "mass", "m", "mass", "mass", "moving mass of the device, including the load of a mode", positive=True
        ),
        Parameter(
            "damping", "b", "damping", "damping", "viscous damping of the device, including the damping of the load"
        ),
        Parameter(
            "stiffness", "k", "stiffness", "stiffness", "stiffness of a spring to ground", may_seem_negative=True
        ),
        Parameter("sampling_period_s", "T", "time", "sampling period", "time between two samples", positive=True),
        Parameter("delay_samples", "d", "ratio", "delay", "delay from the command to the force", unit_name="samples"),
        Parameter(
            "jitter_samples",
            "s_d",
            "ratio",
            "jitter",
            "standard deviation of the delay from command to command",
            unit_name="samples",
        ),
        Parameter("force_gain", "g", "ratio", "force gain", "force per unit of command", positive=True),
        Parameter("actuator_lag_s", "tau", "time", "actuator lag", "time constant of the first-order actuator lag"),
        Parameter("velocity.cutoff_hz", "f_f", "frequency", "cut-off", f"cut-off frequency {velocity}", positive=True),
        Parameter("velocity.order", "n", "ratio", "order", f"order {velocity}", positive=True),
        Parameter(
            "velocity.samples", "N", "ratio", "window", f"number of samples in the difference {velocity}", positive=True
        ),
        Parameter(
            "velocity.acceleration",
            "a_f",
            "acceleration",
            "acceleration",
            f"acceleration in the model {velocity}",
            positive=True,
        ),
        Parameter(
            "velocity.noise",
            "s_f",
            "length",
            "noise of the filter",
            f"sensor noise in the model {velocity}",
            positive=True,
        ),
        Parameter(
            "velocity.bound",
            "e_f",
            "length",
            "bound",
            "largest distance of positions from the line of the velocity filter",
            positive=True,
        ),
        Parameter("velocity.longest", "L", "ratio", "longest window", f"longest window {velocity}", positive=True),
        Parameter(
            "mode.frequency_hz",
            "f_v",
            "frequency",
            "mode frequency",
            "resonance frequency of motor and load on the spring, with both ends free",
            positive=True,
        ),
        Parameter(
            "mode.damping_ratio", "zeta_v", "ratio", "mode damping ratio", "damping ratio of the resonance of the mode"
        ),
        Parameter(
            "mode.mass",
            "m_l",
            "mass",
            "load mass",
            "mass of the load, a part of the moving mass",
            positive=True,
        ),
        Parameter("mode.load_damping", "b_l", "damping", "load damping", "part of the damping that acts on the load"),
        Parameter(
            "operator.mass",
            "m_h",
            "mass",
            "operator mass",
            "mass of the operator's hand or arm, which is rigidly attached to the motor",
            positive=True,
        ),
        Parameter("operator.damping", "b_h", "damping", "operator damping", "damping of the operator"),
        Parameter("operator.stiffness", "k_h", "stiffness", "operator stiffness", "stiffness of the operator"),
        Parameter("friction.coulomb", "f_c", "force", "Coulomb friction", "Coulomb friction on the motor side"),
        Parameter("friction.stiction", "f_s", "force", "stiction", "force that sets the motor in motion from rest"),
        Parameter(
            "friction.stribeck_velocity",
            "v_s",
            "velocity",
            "Stribeck velocity",
            "speed at which friction has fallen from stiction to Coulomb friction",
            positive=True,
        ),
        Parameter(
            "constant_force",
            "f_0",
            "force",
            "constant force",
            "force on the motor in addition to the command, such as gravity",
            lower=-inf,
            may_seem_negative=True,
        ),
        Parameter(
            "force_limit", "F_max", "force", "largest force", "magnitude at which the command is clipped", positive=True
        ),
        Parameter("sensor.quantum", "q", "length", "quantum", "resolution of the position sensor"),
        Parameter("sensor.noise", "s_x", "length", "noise", "standard deviation of the noise of the position sensor"),
    )


PARAMETERS: dict[str, Parameter] = {parameter.name: parameter for parameter in _rows()}
"""All parameters of a loop by name, in the order of files, tables and covariances."""

ESTIMATE_PARAMETERS = {"friction": "friction.coulomb", "device_stiffness": "stiffness"}
"""`PARAMETERS` name for each key of ``estimates`` in the comparison document, where the two differ."""
